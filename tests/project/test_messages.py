"""What messages advise: every option that one names is there in the command that prints it."""

import ast
import re
from functools import cache
from pathlib import Path

import pytest
import train_extra  # noqa: F401

import analytic_rasterizer
from analytic_rasterizer import cli, io
from analytic_rasterizer.cli.arguments import KNOWN_OPTIONS
from analytic_rasterizer.io.errors import OPTION, SceneWarning

PACKAGE = Path(analytic_rasterizer.__file__).parent
(COMMANDS,) = (action.choices for action in cli.build_parser()._actions if action.choices)
OPTIONS = {name: frozenset(parser._option_string_actions) for name, parser in COMMANDS.items()}
SCENES = ("render", "view", "bake", "inspect", "pareto")
READERS = ("train", "evaluate", "inspect")  # of captures; `view` drops all advice

# Which commands print what a module says; the first entry that fits. Where a text names its command ("bake X --out"),
# that one has to have the option. A new module that names an option is a row here.
PRINTED_BY = {
    "cli/launch.py": ("train", "evaluate"),
    "cli/photographs.py": ("view",),
    "cli/scenes.py": SCENES,
    "cli/__init__.py": tuple(COMMANDS),
    "cli/arguments.py": tuple(COMMANDS),
    **{f"cli/{name}.py": (name,) for name in COMMANDS},
    **{f"captures/{name}.py": ("train",) for name in ("source", "depth")},
    "captures/": READERS,
    "training/survey.py": READERS,
    "training/report.py": (),  # what looks like options is its style sheet
    "training/": ("train",),
    "reconstruction/": ("train",),
    "io/appearance.py": ("evaluate", "render", "view", "bake", "inspect"),
    "io/": tuple(COMMANDS),
    "analysis/planner.py": ("inspect",),
    "installation.py": (),  # options of pip
    "": tuple(COMMANDS),
}
# Texts that not all commands of their module print, by a part of them.
ONLY = {
    "--device cuda: no CUDA device": tuple(name for name in COMMANDS if name not in ("convert", "report")),
    "larger numbers in --scales": ("render", "inspect", "pareto"),
    "use --scales, which takes reductions": ("train", "evaluate", "render", "bake", "inspect", "pareto"),
    "{} on the GPU (--picture-memory-gpu)": ("train",),
    "{} in memory (--picture-memory-host)": ("train",),
    "at the border (--lens undistort)": ("train", "evaluate"),
}
# Options of other programs.
FOREIGN = {"3DGS's `--optimizer_type"}
ADVISED = {"SceneError": 1, "SceneWarning": 1, "of": 3, "warn_of": 2, "within": 1}  # arguments before the advice


def texts_of(tree: ast.Module) -> list[tuple[str, bool]]:
    """The texts of a module that may be printed, and whether they are advice, which commands choose from.

    Numbers and names in f-strings are {}.
    """
    advice, docs = set(), set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            called = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", None)
            for argument in node.args[ADVISED.get(called, len(node.args)) :]:
                advice.update(map(id, ast.walk(argument)))
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            docs.add(id(node.value))
    found, inside = [], set()
    for node in ast.walk(tree):  # from the outside to the inside
        if isinstance(node, ast.JoinedStr):
            inside.update(map(id, node.values))
            parts = (part.value if isinstance(part, ast.Constant) else "{}" for part in node.values)
            found.append(("".join(parts), id(node) in advice))
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and not {id(node)} & (docs | inside):
            found.append((node.value, id(node) in advice))
    name = re.compile(r"--[a-z][\w-]*(=\{\})?")  # alone: an option that is added, or put into another text
    return [(text, advised) for text, advised in found if OPTION.search(text) and not name.fullmatch(text)]


def commands_of(module: str, text: str) -> tuple[str, ...]:
    special = next((commands for part, commands in ONLY.items() if part in text), None)
    return special or next(commands for start, commands in PRINTED_BY.items() if module.startswith(start))


def unknown_options(module: str, text: str, advised: bool) -> list[str]:
    """Options that the text names and a command that prints it does not have."""
    if any(part in text for part in FOREIGN):
        return []
    wrong = []
    for match in OPTION.finditer(text):
        named = re.findall(rf"\b({'|'.join(COMMANDS)})\b[^;:]*$", text[: match.start()])
        commands = named[-1:] or commands_of(module, text)
        there = [match.group() in OPTIONS[command] for command in commands]
        if not (any(there) if advised else all(there)):
            wrong.append(match.group())
    return wrong


@cache
def messages() -> dict[str, list]:
    found = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        module = str(path.relative_to(PACKAGE))
        if texts := texts_of(ast.parse(path.read_text())):
            found[module] = texts
    return found


@pytest.mark.parametrize("module", messages())
def test_options_in_messages_are_those_of_their_commands(module):
    texts = messages()[module]
    assert {text: wrong for text, advised in texts if (wrong := unknown_options(module, text, advised))} == {}


def test_the_messages_are_found():
    """Those of loaders are among them, as advice, and a wrong one is noticed."""
    found = messages()
    assert ("--missing skip leaves them out", True) in found["captures/loading.py"]
    assert sum(map(len, found.values())) > 60
    assert unknown_options("cli/render.py", "give --masks none", False) == ["--masks"]
    assert unknown_options("cli/render.py", "bake {} --out FILE or bake {} --masks none", False) == ["--masks"]
    assert unknown_options("captures/loading.py", "--missing skip leaves them out", False) == ["--missing"]
    assert unknown_options("captures/loading.py", "--missing skip leaves them out", True) == []
    assert unknown_options("captures/loading.py", "--mising skip leaves them out", True) == ["--mising"]


@pytest.mark.parametrize("command", COMMANDS)
def test_advice_that_a_command_cannot_follow_is_left_out(command):
    given = {
        "train": "C --out D",
        "evaluate": "D",
        "view": "S",
        "inspect": "S",
        "pareto": "S",
        "convert": "S D.ply",
        "report": "D",
    }
    words = f"{command} {given.get(command, 'S --out D')}".split()
    known = getattr(cli.build_parser().parse_args(words), KNOWN_OPTIONS)
    assert known == OPTIONS[command]
    advice = ("--missing skip leaves them out", "look into the folder", "--size W H gives it")
    for kind in (io.SceneError, SceneWarning):
        said = kind("a: 2 of 9 pictures are missing", *advice)
        followed = [text for text in advice if not text.startswith("--") or text.split()[0] in known]
        assert said.told(known) == "; ".join(["a: 2 of 9 pictures are missing", *followed])
        assert str(said) == "; ".join(["a: 2 of 9 pictures are missing", *advice])


def test_commands_print_no_more_advice_than_they_can_follow(tmp_path, capsys):
    (tmp_path / "scene.json").write_text('{"frames": [{"file_path": "a.png"}], "camera_angle_x": 1}')
    (tmp_path / "transforms.json").write_text((tmp_path / "scene.json").read_text())
    assert cli.main(["train", str(tmp_path), "--out", str(tmp_path / "out"), "--device", "cpu"]) == 2
    assert "or a size given by the caller\n" in capsys.readouterr().err
    assert cli.main(["inspect", str(tmp_path)]) == 2
    assert "or a size given by the caller; --size W H gives it\n" in capsys.readouterr().err
