"""tests/mutants.py: every mistake can be made and judged, and the program says what became of it."""

import sys

import pytest
from places import ROOT

sys.path.append(str(ROOT / "tests"))
import mutants
from mutants import MUTANTS, BrokenError, Mutant

ROOMS = (
    "csrc/core/", "csrc/core/footprint/", "csrc/core/camera/", "csrc/cpu/", "csrc/cuda/", "csrc/torch/",
    *(f"analytic_rasterizer/{room}/" for room in ("analysis", "cameras", "captures", "cli", "density", "dialects")),
    *(f"analytic_rasterizer/{room}/" for room in ("distributed", "io", "render", "training", "viewer")),
)  # fmt: skip


@pytest.mark.parametrize("mutant", MUTANTS, ids=lambda mutant: mutant.name)
def test_a_mistake_can_be_made_and_judged(mutant):
    assert (ROOT / mutant.file).read_text(encoding="utf-8").count(mutant.old) == 1
    assert mutant.new not in (mutant.old, "")
    file, chosen = mutant.tests
    text = mutants.find(file).read_text(encoding="utf-8")
    assert all(mutants.find(source).is_file() for source in mutant.sources)
    words = chosen.replace("*", " ").split() if file.endswith(".cpp") else chosen.split(" or ")
    assert all(word in text for word in words)


def test_there_are_21_from_every_room():
    assert len({mutant.name for mutant in MUTANTS}) == len(MUTANTS) == 21
    for room in ROOMS:
        assert any(mutant.file.startswith(room) for mutant in MUTANTS), room
    built = [mutant.is_built for mutant in MUTANTS]
    assert built == sorted(built)  # the last ones: those before run on the extension that is there


@pytest.fixture
def project(tmp_path, monkeypatch):
    """A project of one function and its test, with mistakes."""
    (tmp_path / "tests").mkdir()
    (tmp_path / "half.py").write_text("def half(x):\n    return x / 2 + 0 * x\n")
    (tmp_path / "tests" / "test_half.py").write_text("import half\n\n\ndef test_it():\n    assert half.half(4) == 2\n")
    mutants.run(["git", "init", "-q"], tmp_path)
    made = (
        Mutant("divisor", "half.py", "x / 2", "x / 3", ("test_half.py", "it")),
        Mutant("nothing", "half.py", "0 * x", "0", ("test_half.py", "it")),
        Mutant("old", "half.py", "x / 7", "x", ("test_half.py", "it")),
        Mutant("red", "half.py", "x / 2", "x", ("test_half.py", "red")),
    )
    monkeypatch.setattr(mutants, "ROOT", tmp_path)
    monkeypatch.setattr(mutants, "MUTANTS", made)
    return tmp_path


def passes(mutant, tree):
    """The test of the project, without a process, or one that fails always."""
    names = {}
    exec((tree / "half.py").read_text(), names)
    (tree / "output.txt").write_text("what it said")
    return names["half"](4) == 2 and mutant.tests[1] != "red"


def test_verdicts(project, capsys, monkeypatch):
    """What cannot be judged is not taken for caught."""
    monkeypatch.setattr(mutants, "passes_python", passes)
    text = (project / "half.py").read_text()
    assert mutants.main([]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split() == ["divisor", "half.py", "caught"]
    assert lines[1].split() == ["nothing", "half.py", "SURVIVED"]
    assert lines[2].endswith("BROKEN: half.py: expected once, found 0 times: x / 7")
    assert lines[3].endswith("BROKEN: test_half.py fails without it:")
    assert lines[-1] == "1 of 4 caught"
    assert mutants.main(["divisor"]) == 0
    assert (project / "half.py").read_text() == text


def test_python_tests_judge(project):
    mutant = mutants.MUTANTS[0]
    assert mutants.passes_python(mutant, project)
    (project / "half.py").write_text("def half(x):\n    return x / 3\n")
    assert not mutants.passes_python(mutant, project)
    with pytest.raises(BrokenError, match=r"test_half.py -k 'whole' did not run"):
        mutants.passes_python(mutant._replace(tests=("test_half.py", "whole")), project)


def test_names_that_are_none(project, capsys):
    with pytest.raises(SystemExit):
        mutants.main(["third"])
    assert "unknown: third" in capsys.readouterr().err
    with pytest.raises(BrokenError, match="expected one file"):
        mutants.find("test_other.py")
