"""`--effects`: what a training takes of what its capture calls for, by itself."""

import json
import math
import shutil
import warnings
from dataclasses import replace

import commands
import pytest
import torch
import train_extra  # noqa: F401
from capture_files import circle, write_nerf_synthetic
from commands import refused
from wall import cameras, write_wall

from analytic_rasterizer import io, training
from analytic_rasterizer.distributed.ranks import Ranks
from analytic_rasterizer.training import CaptureSource, TrainingOptions, automatic, files, plan, schedule

TINY = {"sh_degree": 0, "footprint": "box:samples=1", "max_gaussians": 300, "density": "none"}
WORDS = [f"--{name.replace('_', '-')}={value}" for name, value in TINY.items()]


@pytest.fixture(scope="module")
def even(tmp_path_factory):
    return write_wall(tmp_path_factory.mktemp("even") / "wall")


@pytest.fixture(scope="module")
def uneven(tmp_path_factory):
    """Every second photograph is one stop brighter."""
    return write_wall(tmp_path_factory.mktemp("uneven") / "wall", gains=lambda i: (2 ** (0.5 - i % 2),) * 3)


def train(folder, out, *options) -> int:
    return commands.train(folder, out, "--iterations 3", *WORDS, *map(str, options))


def described(out) -> dict:
    return json.loads((out / files.OPTIONS).read_text())


DEFAULT = {"footprint": TrainingOptions.footprint}
BEGINNING = {"first_footprint": "box:samples=1", "footprint_from": 0.9}  # of photographs of one size


def settle(folder, options=None, given=None, chosen=(), ranks=None):
    source = CaptureSource(folder, **(given or {}))
    return automatic.settle(source, options or TrainingOptions(), chosen, ranks or Ranks())


def test_an_uneven_capture_is_trained_with_corrections(uneven, tmp_path, capsys):
    """By itself, and test and resumption know it."""
    assert train(uneven, tmp_path) == 0
    shown = capsys.readouterr()
    first = [*plan.plan_capture(uneven).to_lines(), "--effects auto takes --exposure affine"]
    assert shown.err.splitlines()[: len(first)] == first
    assert "after the best affine colour" in shown.out
    found = described(tmp_path)
    assert (found["options"]["exposure"], found["options"]["effects"]) == ("affine", "auto")
    assert found["source"]["taken"] == {"exposure": "affine"}
    assert (tmp_path / files.EXPOSURES).exists()
    assert commands.evaluate(tmp_path) == 0
    assert "best affine colour" in capsys.readouterr().out


def test_a_resumed_training_does_not_look_again(uneven, tmp_path, capsys, monkeypatch):
    assert train(uneven, tmp_path, "--no-evaluate") == 0
    capsys.readouterr()
    monkeypatch.setattr(automatic, "plan_capture", None)
    arguments = uneven, tmp_path, "--resume --no-evaluate"
    assert commands.train(*arguments, "--iterations 5") == 0
    assert "--effects" not in capsys.readouterr().err
    assert described(tmp_path)["options"]["exposure"] == "affine"
    assert described(tmp_path)["source"]["taken"] == {"exposure": "affine"}
    for option, value in (("effects", "none"), ("exposure", "none")):
        error = refused(capsys, commands.train, *arguments, f"--{option}", value)
        assert f"--{option}: a resumed training keeps the options" in error


def test_none_does_not_look(uneven, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(automatic, "plan_capture", None)
    assert train(uneven, tmp_path / "none", "--effects", "none", "--no-evaluate") == 0
    assert not capsys.readouterr().err.startswith(str(uneven))
    assert described(tmp_path / "none")["options"]["exposure"] == "none"
    assert TrainingOptions.preset("3dgs").effects == "none"  # for comparisons


def test_a_switch_wins(uneven, tmp_path, capsys):
    """Also that of the default."""
    assert train(uneven, tmp_path / "out", "--exposure", "none", "--no-evaluate") == 0
    line = next(line for line in capsys.readouterr().err.splitlines() if line.startswith("--effects"))
    assert line == "--effects auto takes nothing, and not --exposure affine: another value is given"
    assert described(tmp_path / "out")["options"]["exposure"] == "none"
    settled = settle(uneven, TrainingOptions(exposure="affine"))
    assert (settled.taken, settled.options.exposure) == ({}, "affine")
    assert settled.lines[-2] == "--effects auto takes nothing"


def test_a_capture_without_evidence_trains_to_the_same_bits(even, tmp_path):
    scenes = []
    for effects in ("auto", "none"):
        options = TrainingOptions(**TINY, effects=effects, iterations=20, first_footprint="none")
        run = training.Run(even, tmp_path / effects, options)
        run.train()
        scenes.append(io.load_scene(tmp_path / effects / files.SCENE))
        assert described(tmp_path / effects)["source"]["taken"] == {}
    assert all(torch.equal(a, b) for a, b in zip(*scenes))


def test_scales_that_photographs_call_for(tmp_path):
    """With as many repeats as are usual."""
    views = cameras(lambda i: 4.0 if i % 2 else 19.0)
    settled = settle(write_wall(tmp_path, views))
    assert settled.taken == {"scales": (1, 2, 4, 8)} and settled.source.lens is None
    assert settled.options == TrainingOptions(scales=(1, 2, 4, 8))
    assert settle(tmp_path, TrainingOptions(scales=(1, 2))).taken == {}
    assert settle(tmp_path, chosen=["scales"]).options == TrainingOptions()


@pytest.mark.parametrize(
    "given, expected",
    [
        ({}, ("box:samples=1", 0.9)),
        ({"scales": (1, 2)}, ("box:samples=1", 0.5)),
        ({"footprint": "analytic"}, ("box:samples=1", 0.9)),
        ({"footprint": "box:samples=16"}, ("box:samples=1", 0.9)),
        ({"footprint": "box:samples=1"}, (None, 0.9)),
        ({"footprint": "mip"}, (None, 0.9)),  # another picture, and as quick
        ({"footprint_from": 0.3}, ("box:samples=1", 0.3)),
        ({"first_footprint": "point"}, ("point:dilation=0.3", 0.9)),
        ({"first_footprint": "none"}, (None, 0.9)),
        ({"effects": "none"}, (None, 0.9)),
    ],
    ids=str,
)
def test_what_a_training_begins_with(even, tmp_path, given, expected, capsys):
    run = training.Run(even, tmp_path, TrainingOptions(**TINY | DEFAULT | {"iterations": 20} | given))
    assert (run.options.begins_with, run.options.footprint_from) == expected
    said = [line for line in capsys.readouterr().err.splitlines() if line.startswith("begins with ")]
    if expected[0] and "first_footprint" not in given:
        footprint, share = run.options.footprint, f"{expected[1]:.0%}"
        told = f"begins with {expected[0]}, and goes on with {footprint} when {share} is over"
        assert said == [f"{told} (--first-footprint none: does not)"]
    else:
        assert said == []
    until = math.ceil(20 * expected[1]) if expected[0] else 0
    seen = []
    for _ in range(20):
        seen.append(run.trainer.footprint)
        run.trainer.step()
    assert seen == [expected[0]] * until + [run.options.footprint] * (20 - until)


def begun(folder, out, **given) -> tuple[training.Run, list[str], dict]:
    """A training that begins with `box`; the footprints of its steps, and of its log by the number of the step."""
    first = {"first_footprint": "box:samples=1", "effects": "none", "scales": (4,)}
    run, seen = training.Run(folder, out, TrainingOptions(**TINY | DEFAULT | first | given)), []
    step = run.trainer.step
    run.trainer.step = lambda: (seen.append(run.trainer.footprint), step())
    run.train()
    return run, seen, {entry["step"]: entry["footprint"] for entry in run.history}


def test_the_log_says_what_its_steps_had(even, tmp_path):
    """And the file the footprint that the scene is for, where no step had it, too."""
    _, seen, logged = begun(even, tmp_path / "a", iterations=110, footprint_from=100)
    assert logged == {step: seen[step - 1] for step in (10, 100, 110)}
    assert seen == ["box:samples=1"] * 100 + ["moment:samples=4"] * 10
    _, seen, logged = begun(even, tmp_path / "b", iterations=20, footprint_from=1)
    assert {*seen, *logged.values()} == {"box:samples=1"}
    assert io.read_metadata(tmp_path / "b" / files.SCENE).footprint == "moment:samples=4"


def test_a_training_by_the_clock_changes_too(even, tmp_path, monkeypatch):
    """By a clock on which every step takes 0.01 s. The first steps, before it is read, count nothing."""
    steps, advance = [], schedule.Progress.advance
    monkeypatch.setattr(schedule.Clock, "_now", lambda clock: 0.01 * len(steps))
    monkeypatch.setattr(schedule.Progress, "advance", lambda self, stride=1: (steps.append(1), advance(self, stride)))
    _, seen, _ = begun(even, tmp_path, seconds=0.6, footprint_from=0.49)
    assert seen == ["box:samples=1"] * 30 + ["moment:samples=4"] * 30


def test_a_longer_training_says_that_it_has_the_first_footprint_again(even, tmp_path):
    begun(even, tmp_path, iterations=10, footprint_from=0.5)
    run = training.Run(even, tmp_path, resume=True, iterations=40)
    assert "; pictures have box:samples=1 until 50%" in run.notes[-1] and run.trainer.footprint == "box:samples=1"
    assert "pictures have" not in training.Run(even, tmp_path, resume=True, iterations=12).notes[-1]


@pytest.mark.parametrize("share, begins", [(20.0, True), (70.0, False), (None, False)])
def test_photographs_that_show_points_at_many_sizes_do_not_begin_with_it(even, share, begins):
    """Nor those without points, of which nobody knows."""
    found = plan.plan_capture(even)
    findings = [replace(f, number=share) if f.effect == "sampling" else f for f in found.findings]
    beginning = replace(found, findings=tuple(findings)).beginning("moment:samples=4", (1,))
    assert beginning == (BEGINNING if begins else {})


def test_photographs_with_alpha_begin_with_it_for_a_shorter_time(tmp_path):
    write_nerf_synthetic(tmp_path, circle(6), circle(2))
    assert settle(tmp_path).options == TrainingOptions(**BEGINNING | {"footprint_from": 0.5})


def test_missing_pictures_and_cameras_far_away(tmp_path, capsys):
    """The lines agree with what happens."""
    views = cameras()
    far = views[4].w2c.clone()
    far[2, 3] += 1000
    write_wall(tmp_path / "wall", [*views[:4], io.View(**vars(views[4]) | {"w2c": far}), *views[5:]])
    (tmp_path / "wall" / "images" / "p_7.png").unlink()
    with pytest.warns(UserWarning, match="p_4.png is left out"):
        assert train(tmp_path / "wall", tmp_path / "out") == 0
    lines = capsys.readouterr().err.splitlines()
    assert lines[0].startswith(f"{tmp_path / 'wall'}: looked at 8 of 9")
    assert "--effects auto takes --missing skip" in lines
    assert any(line.startswith("outlying cameras yes") and "p_4.png" in line for line in lines)
    assert described(tmp_path / "out")["source"]["missing"] == "skip"
    error = refused(capsys, train, tmp_path / "wall", tmp_path / "refused", "--missing", "refuse")
    assert "1 of 9 pictures are missing" in error


def test_a_capture_that_cannot_be_looked_at(even, tmp_path, capsys, monkeypatch):
    """Its loader says what is wrong, if anything is."""
    shutil.copytree(even, tmp_path / "wall")
    (tmp_path / "wall" / "images" / "p_3.png").write_bytes(b"no picture")
    where = tmp_path / "wall", tmp_path / "out"
    assert "p_3.png: unreadable" in refused(capsys, train, *where, "--missing", "refuse")
    assert train(*where, "--no-evaluate") == 0
    assert "1 of 10 pictures cannot be read and left out" in capsys.readouterr().err

    def fail(*args, **options):
        raise RuntimeError("a look went wrong")

    monkeypatch.setattr(automatic, "plan_capture", fail)
    assert train(even, tmp_path / "trained", "--no-evaluate") == 0
    assert f"{even}: not looked at, --effects auto takes nothing: a look went wrong" in capsys.readouterr().err


def test_errors_and_warnings_around_the_lines(capsys):
    """Warnings are not lost with an error, lines are not said."""
    with pytest.warns(UserWarning, match="careful"), automatic.said_first(["a line"]):
        warnings.warn("careful", stacklevel=1)
        assert capsys.readouterr().err == ""
    assert capsys.readouterr().err == "a line\n"
    with pytest.warns(UserWarning, match="careful"), pytest.raises(ValueError), automatic.said_first(["a line"]):
        warnings.warn("careful", stacklevel=1)
        raise ValueError
    assert capsys.readouterr().err == ""


class _Several(Ranks):
    """Two processes, as far as one of them can tell."""

    heard: dict = {}  # noqa: RUF012

    def exchange(self, value):
        if self.is_first:
            self.heard["value"] = value
        return [self.heard["value"], value]


def test_several_processes_take_what_the_first_finds(uneven, monkeypatch):
    first = settle(uneven, ranks=_Several(0, 2))
    monkeypatch.setattr(automatic, "plan_capture", None)
    second = settle(uneven, ranks=_Several(1, 2))
    assert first.options == second.options == TrainingOptions(**BEGINNING) and first.taken == second.taken == {}
    assert second.lines == []
    expected = "--effects auto takes nothing, and not --exposure affine, which 2 processes cannot learn: train on one"
    assert first.lines[-2] == expected


def test_a_capture_without_points_takes_nothing(tmp_path):
    write_nerf_synthetic(tmp_path, circle(6), circle(2))
    assert settle(tmp_path).taken == {}
