"""Footprints are known by name in csrc/core/footprint, and to Python's footprints.py, alone.

Elsewhere a quoted name is a second list that a new footprint would have to be added to.
"""

import ast
import re

import pytest
from places import ROOT

import analytic_rasterizer as ar
from analytic_rasterizer import _C

NAMES = sorted({*ar.FOOTPRINTS, *(variant["key"] for variant in _C.footprints())})
NAMED = re.compile(rf"({'|'.join(NAMES)})(:.*)?")  # with options or without
# The same words for other things.
OTHERS = {
    "analytic_rasterizer/cli/train.py": {"mip"},  # --export: a file for viewers that do not integrate
    "analytic_rasterizer/dialects/analytic.py": {"analytic"},  # the dialects' names
    "analytic_rasterizer/dialects/mip.py": {"mip"},
    "analytic_rasterizer/io/metadata.py": {"mip"},  # what Brush writes into files
    "analytic_rasterizer/training/parts.py": {"box"},  # downsampling
    "analytic_rasterizer/captures/pictures.py": {"box"},
    "analytic_rasterizer/captures/reduction.py": {"box"},
}


def python_strings(text):
    """(line, text) of the strings of a module, without docstrings."""
    tree = ast.parse(text)
    statements = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in statements:
            yield node.lineno, node.value


def quoted_strings(text):
    """(line, text) of names in quotes in C++, HTML or JavaScript, without comments, also inside other quotes."""
    for number, line in enumerate(text.split("\n"), 1):
        code = re.sub(r"(^|\s)(//|\*|/\*).*", "", line)
        for _, quoted in re.findall(rf"(['\"`])((?:{'|'.join(NAMES)})(?::[^'\"`]*)?)\1", code):
            yield number, quoted


def sources():
    """(path from the root, its strings) of what may not name footprints."""
    for package in ("analytic_rasterizer", "diff_gaussian_rasterization", "diff_gaussian_rasterization_ms"):
        for path in sorted((ROOT / package).rglob("*.py")):
            if path != ROOT / "analytic_rasterizer" / "footprints.py":
                yield path, python_strings
    for pattern in ("analytic_rasterizer/viewer/page/*.js", "analytic_rasterizer/viewer/page/*.html", "csrc/**/*"):
        for path in sorted(ROOT.glob(pattern)):
            if path.suffix in (".js", ".html", ".h", ".cpp", ".cu", ".cuh") and path.parent.name != "footprint":
                yield path, quoted_strings


def named_in(text, strings):
    """(line, text) of the strings that are names of footprints."""
    return [(line, quoted) for line, quoted in strings(text) if NAMED.fullmatch(quoted)]


def test_no_other_source_names_a_footprint():
    found, excused, count = [], set(), 0
    for path, strings in sources():
        name, count = path.relative_to(ROOT).as_posix(), count + 1
        for line, quoted in named_in(path.read_text(encoding="utf-8"), strings):
            if quoted in OTHERS.get(name, ()):
                excused.add((name, quoted))
            else:
                found.append(f"{name}:{line}: {quoted!r}")
    assert count > 200
    assert not found, (
        "take a constant of analytic_rasterizer/footprints.py, or an attribute that the header states:\n"
        + ("\n".join(found))
    )
    assert excused == {(name, word) for name, words in OTHERS.items() for word in words}, "an exception without a use"


@pytest.mark.parametrize(
    ("text", "strings", "lines"),
    [
        ('"""point"""\nx = "mip"\ny = f"{x}" + "box:samples=4"\n"box"\nz = "a point"', python_strings, [2, 3]),
        ("a = 'point';\n// 'mip'\nb = `${c === 'analytic' ? 1 : 2}`; // 'box'", quoted_strings, [1, 3]),
        ('f("moment4");\n/// "box"\nint x;  // "mip"\ng("points", "exact");', quoted_strings, [1, 4]),
    ],
    ids=["python", "page", "csrc"],
)
def test_names_are_found(text, strings, lines):
    assert [line for line, _ in named_in(text, strings)] == lines
