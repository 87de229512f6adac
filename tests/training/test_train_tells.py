"""What a training says, on the screen, in its log and for TensorBoard; when it does what; for how long it goes on."""

import functools
import json
import re
import sys

import commands
import pytest
import runs
import torch
import train_extra  # noqa: F401
from capture_files import circle, write_nerf_synthetic
from commands import refused
from ply_files import ply, vertices
from processes import run_python

from analytic_rasterizer import io, training
from analytic_rasterizer.density import GradientDensity
from analytic_rasterizer.training import TrainingOptions, files, reports, schedule
from analytic_rasterizer.training.unused import without_effect

TINY = ["--random-points", "60", "--sh-degree", "0", "--footprint", "box:samples=1", "--max-gaussians", "300"]


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scene")
    write_nerf_synthetic(folder, circle(6), circle(2))
    return folder


def train(scene, out, *options) -> int:
    return commands.train(scene, out, *TINY, *map(str, options))


USUAL = {"random_points": 60, "sh_degree": 0, "footprint": "box:samples=1", "max_gaussians": 300}
make_run = functools.partial(runs.make_run, **USUAL)


def log_of(out) -> list[dict]:
    return [json.loads(line) for line in (out / files.LOG).read_text().splitlines()]


# ----------------------------------------------------------------------------------- what it says


def lines_of(steps, seconds, entries, monkeypatch, capsys) -> list[str]:
    """What is printed of looks at (time, step), the last one of which is the end."""
    clock = iter([0.0, *(time for time, _ in entries)])
    monkeypatch.setattr(reports.time, "monotonic", lambda: next(clock))
    with reports.Display(steps, seconds, 0) as display:
        for time, step in entries:
            entry = {"step": step, "seconds": time, "loss": 0.125, "psnr": 20.0, "gaussians": 12345}
            display.show(entry, last=step == entries[-1][1])
    shown = capsys.readouterr()
    assert shown.out == ""
    return shown.err.splitlines()


def test_lines_come_with_every_look_or_every_ten_seconds(monkeypatch, capsys):
    """Whichever is later; besides, the first look and the last have one."""
    quick = [(0.1, 10), *((0.41 * i, 100 * i) for i in range(1, 61)), (25, 6050)]
    lines = lines_of(6050, 0, quick, monkeypatch, capsys)
    assert [re.match(r"step ([\d,]+) of 6,050", line)[1] for line in lines] == ["10", "2,500", "5,000", "6,050"]
    slow = [(3.0, 10), (30.0, 100), (60.0, 200), (90.0, 300)]
    lines = lines_of(300, 0, slow, monkeypatch, capsys)
    begun = ("10 of 300 (3%, 1:27 min", "100 of 300 (33%, 1:00 min", "200 of 300 (67%, 30 s", "300 of 300 (100%, 0 s")
    assert lines == [f"step {text} left): loss 0.1250, PSNR 20.0, Gaussians 12,345" for text in begun]


def test_lines_of_a_training_by_the_clock(monkeypatch, capsys):
    lines = lines_of(None, 7200, [(60.0, 400), (3660.0, 24400)], monkeypatch, capsys)
    assert lines[0].startswith("step 400 (1%, 1:59 h left): loss")
    assert lines[1].startswith("step 24,400 (51%, 59:00 min left): loss")


def test_without_a_terminal_there_are_lines(scene, tmp_path, capsys):
    assert train(scene, tmp_path / "out", "--iterations", 130) == 0
    shown = capsys.readouterr()
    lines = [line for line in shown.err.splitlines() if re.match(r"step \d+ of 130 \(\d+%, .* left\): loss ", line)]
    assert len(lines) >= 2 and lines[-1].startswith("step 130 of 130 (100%, 0 s left)")
    assert not any("step " in line and "left" in line for line in shown.out.splitlines())


def test_in_a_terminal_there_is_a_bar(scene, tmp_path, capsys, monkeypatch):
    for stream in (sys.stdout, sys.stderr):
        monkeypatch.setattr(stream, "isatty", lambda: True)
    make_run(scene, tmp_path, iterations=20).train()
    shown = capsys.readouterr().err
    assert "20/20" in shown and "step/s" in shown and "left" not in shown and "Gaussians=60" in shown


def test_the_log_grows_with_every_look(scene, tmp_path, monkeypatch):
    """Whatever happens to the process."""
    run, found = make_run(scene, tmp_path, iterations=250), {}
    (tmp_path / files.LOG).write_text('{"step": 7}\n')  # of another training

    def look(trainer):
        found[trainer.progress.step] = [entry["step"] for entry in log_of(tmp_path)]

    runs.around_steps(monkeypatch, look)
    run.train()
    assert found[9] == [] and found[99] == [10] and found[100] == [10, 100] and found[249] == [10, 100, 200]
    assert log_of(tmp_path) == run.history and run.history[-1]["step"] == 250


def test_a_resumed_log_goes_on_from_the_checkpoint(scene, tmp_path, monkeypatch):
    """What was logged after it happens once more."""
    run = make_run(scene, tmp_path, iterations=250)
    run.save_every = 120

    def kill(trainer):
        if trainer.progress.step == 210:
            raise KeyboardInterrupt

    runs.around_steps(monkeypatch, kill)
    with pytest.raises(KeyboardInterrupt):
        run.train()
    monkeypatch.undo()
    assert [entry["step"] for entry in log_of(tmp_path)] == [10, 100, 200]
    resumed = make_run(scene, tmp_path, resume=True)
    assert resumed.progress.step == 120
    resumed.train()
    assert [entry["step"] for entry in log_of(tmp_path)] == [10, 100, 200, 250]


def test_a_log_on_a_full_disk_is_said_once_and_complete_later(scene, tmp_path, capsys, monkeypatch):
    run = make_run(scene, tmp_path, iterations=350)
    usual, write_text = type(tmp_path).open, files.write_text

    def opened(path, *arguments, **others):
        fail_if_full(path)
        return usual(path, *arguments, **others)

    def written(path, text):
        fail_if_full(path)
        write_text(path, text)

    def fail_if_full(path):
        if path.name == files.LOG and 90 < run.progress.step < 250:
            raise OSError(28, "No space left on device", str(path))

    monkeypatch.setattr(type(tmp_path), "open", opened)
    monkeypatch.setattr(files, "write_text", written)
    assert run.train()
    assert capsys.readouterr().err.count("No space left on device") == 1
    assert [entry["step"] for entry in log_of(tmp_path)] == [10, 100, 200, 300, 350]


def test_tensorboard_has_what_the_log_has(scene, tmp_path):
    pytest.importorskip("tensorboard")
    events = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    assert train(scene, tmp_path, "--iterations", 120, "--tensorboard", "--no-evaluate") == 0
    found = events.EventAccumulator(str(tmp_path / reports.TENSORBOARD)).Reload()
    for name in ("loss", "psnr", "gaussians"):
        scalars = [(event.step, event.value) for event in found.Scalars(f"training/{name}")]
        assert scalars == [(entry["step"], pytest.approx(entry[name])) for entry in log_of(tmp_path)]


def test_without_tensorboard_the_extra_is_named(scene, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "tensorboard", None)
    error = refused(capsys, train, scene, tmp_path / "out", "--tensorboard")
    assert error.startswith('error: this needs tensorboard: pip install "analytic_rasterizer[tensorboard]"')
    assert not (tmp_path / "out").exists()


def test_where_the_time_went(scene, tmp_path, capsys):
    assert train(scene, tmp_path, "--iterations", 20) == 0
    phases = json.loads((tmp_path / files.METRICS).read_text())["phases"]
    names = ["load", "warm up", "steps", "write", "evaluate"]
    assert list(phases)[-5:] == names and all(seconds >= 0 for seconds in phases.values()) and phases["steps"] > 0
    assert re.search(", ".join(rf"{name} [\d.]+ s" for name in names) + "$", capsys.readouterr().err.strip())


def test_training_does_not_import_the_compiler_of_torch():
    """Which takes seconds."""
    code = """
import sys
import torch
from analytic_rasterizer.training.optimizer import TrainingAdam

parameter = torch.zeros(3, requires_grad=True)
parameter.grad = torch.ones(3)
optimizer = TrainingAdam([{"params": [parameter]}])
optimizer.step()
optimizer.zero_grad()
optimizer.load_state_dict(optimizer.state_dict())
assert "torch._dynamo" not in sys.modules
"""
    run_python(code)


# ---------------------------------------------------------------------------- when it does what


@pytest.mark.parametrize(
    "steps, options, expected",
    [
        (30_000, {}, (500, 0.75, 100)),
        (7000, {}, (500, 0.75, 100)),
        (7001, {}, (500, 0.75, 100)),
        (600, {}, (43, 0.75, 10)),
        (3500, {}, (250, 0.75, 50)),
        (149, {}, (149, 0.75, 10)),
        (149, {"densify_every": 20}, (11, 0.75, 20)),
        (600, {"densify_from": 500}, (500, 0.75, 10)),
        (600, {"densify_from": 0.25, "densify_until": 300, "densify_every": 7}, (150, 0.5, 7)),
        (600, {"densify_from": 0, "densify_until": 1}, (0, 1, 10)),
        (600, {"densify_until": 15_000}, (43, 1, 10)),
    ],
)
def test_times_are_steps_or_shares(steps, options, expected):
    times = TrainingOptions(iterations=steps, **options).growth.times(steps)
    assert tuple(times[name] for name in ("densify_from", "densify_until", "densify_every")) == expected


def test_times_of_the_preset_are_those_of_3dgs():
    """Its program grows from 500 to 15,000 of 30,000 steps, every 100."""
    options = TrainingOptions.preset("3dgs")
    assert list(schedule.changes_at(options, 30_000)) == list(range(600, 15_000, 100))
    assert (options.iterations, options.reset_every) == (30_000, 3000)
    in_steps = TrainingOptions.preset("3dgs", densify_from=500, densify_until=15_000, densify_every=100)
    assert in_steps.growth.times(30_000) == options.growth.times(30_000)


@pytest.mark.parametrize("steps, options", [(600, {}), (7000, {}), (40, {"densify_from": 3, "densify_every": 4})])
def test_steps_at_which_the_number_may_change(steps, options):
    """Are those at which density control says that it has."""
    parameters = training.starting_gaussians(TrainingOptions(random_points=5), None)
    parameters = parameters.map(lambda field: field.requires_grad_())
    optimizer = torch.optim.Adam([{"params": [field]} for field in parameters])
    options = TrainingOptions(iterations=steps, prune_opacity=0.0, **options)
    control = training.control.make_density(options, parameters, optimizer, 1.0)
    changed = [step for step in range(1, steps + 1) if control.after_step(step, step / steps)]
    assert isinstance(control, GradientDensity) and changed == list(schedule.changes_at(options, steps))


def test_a_short_training_grows(scene, tmp_path):
    """Growth began after 500 steps and ended after three quarters of 600, so that there was none."""
    run = make_run(scene, tmp_path, iterations=600)
    run.train()
    counts = [entry["gaussians"] for entry in run.history]
    assert counts[0] == 60 and max(counts) > 120


def test_a_short_training_by_the_clock_grows(scene, tmp_path, monkeypatch):
    """How many steps it has is known after the first ones."""
    run = make_run(scene, tmp_path, seconds=4.0)
    monkeypatch.setattr(schedule.Clock, "_now", lambda clock: 0.01 * run.progress.step)
    run.train()
    assert run.progress.step == 400 and run.trainer.density.options.densify_from == 29
    assert run.history[-1]["gaussians"] > 120


def test_rates_fall_after_steps_or_a_share():
    def factor(step, time):
        options = TrainingOptions(iterations=1000, rates_from=time, rates_half_life=10)
        return schedule.rates_factor_at(step, options)

    assert factor(500, 0.5) == factor(500, 500) == 1 and factor(510, 0.5) == factor(510, 500) == 0.5


@pytest.mark.parametrize(
    "options, message",
    [
        (["--noise", 1], "--noise has no effect: it is for the density control mcmc, got absgrad"),
        (["--grow-share", 0.1, "--density", "3dgs"], "--grow-share has no effect: it is for the density control mcmc"),
        (["--gradient", 1e-4, "--density", "mcmc"], "--gradient has no effect: it is for the density controls"),
        (["--reset-every", 100, "--density", "none"], "--reset-every has no effect: it is for the density controls"),
        (["--prune-opacity", 0.1, "--density", "none"], "--prune-opacity has no effect: the density control none"),
        (["--densify-every", 10, "--densify-until", 0], "--densify-every has no effect: densify_until is 0"),
        (["--densify-from", 500, "--iterations", 600], "the first change would be at step 510, and growth ends at 450"),
        (["--densify-from", 0.8], "--densify-from has no effect: the number of Gaussians never changes"),
        (["--densify-every", 400, "--iterations", 500], "--densify-every has no effect: the number of Gaussians never"),
        (["--reset-every", 5250, "--preset", "quick"], "the first would be after step 5,250, and growth ends at 5,250"),
        (["--prune-above", 1, "--reset-every", 0], "--prune-above has no effect: sizes are limited after a reset"),
        (["--prune-above", 1, "--iterations", 3000], "the first is after step 3,000, and growth ends at 2,250"),
        (["--gradient-scales", "all"], "--gradient-scales has no effect: there is one scale"),
        (["--downsampling", "bicubic"], "--downsampling has no effect: the pictures are trained on at their full size"),
        (["--sh-every", 10], "--sh-every has no effect: sh_degree is 0"),
        (["--sh-every", 800, "--sh-degree", 2, "--preset", "quick"], "a degree is added every 700 steps, a tenth of"),
        (["--rates-from", 10, "--rates-half-life", 0], "--rates-from has no effect: rates_half_life is 0"),
        (["--rates-half-life", 10, "--iterations", 7000], "rates fall from step 7,000 on, and the training has 7,000"),
        (["--rates-from", 1], "--rates-from has no effect"),
    ],
)
def test_an_option_without_effect_is_an_error(scene, tmp_path, capsys, options, message):
    error = refused(capsys, train, scene, tmp_path / "out", *options)
    assert error.startswith("error: --") and message in error
    assert not (tmp_path / "out").exists()


def test_an_option_without_effect_on_the_start_is_an_error(scene, tmp_path, capsys):
    io.save_scene(tmp_path / "start.ply", training.starting_gaussians(TrainingOptions(random_points=9), None))
    (tmp_path / "points.ply").write_bytes(ply(vertices("xyz", torch.eye(3)[:2]), layout="ascii"))
    for start, option in (("start", "initial-opacity"), ("start", "initial-scale"), ("points", "random-points")):
        value = "50" if option == "random-points" else "0.5"
        given = (f"--{option}", value, "--points", tmp_path / f"{start}.ply")
        error = refused(capsys, commands.train, scene, tmp_path / "out", *given)
        assert f"--{option} has no effect: the training starts from" in error


def test_defaults_and_presets_are_no_options_without_effect(scene, tmp_path):
    """Nobody chose them."""
    assert without_effect(TrainingOptions(iterations=50, density="none", rates_half_life=0))
    assert train(scene, tmp_path, "--preset", "3dgs", "--iterations", 2, "--density", "none") == 0


def test_options_with_effect_are_not_refused():
    effective = {"gradient", "densify_from", "densify_until", "densify_every", "reset_every", "prune_above", "sh_every"}
    assert not effective & without_effect(TrainingOptions()).keys()
    assert {"densify_every", "split_above"}.isdisjoint(without_effect(TrainingOptions(iterations=600)))
    assert {"noise", "grow_share", "prune_opacity"}.isdisjoint(without_effect(TrainingOptions(density="mcmc")))
    by_clock = without_effect(TrainingOptions(seconds=5.0, iterations=10))
    assert {"densify_from", "rates_from", "sh_every", "reset_every"}.isdisjoint(by_clock)


# ---------------------------------------------------------------------------- for how long


def test_a_training_goes_on_to_another_length(scene, tmp_path, capsys):
    arguments = ["--densify-until", 0.9]
    assert train(scene, tmp_path, "--iterations", 200, *arguments) == 0
    before = files.read_checkpoint(tmp_path / files.CHECKPOINT)
    capsys.readouterr()
    assert train(scene, tmp_path, "--resume", "--iterations", 400) == 0
    said = capsys.readouterr().err
    assert "goes on after step 200 to 400 steps in all instead of 200: the learning rate of the means is" in said
    assert "the number of Gaussians changes until step 360, where that was 180" in said
    after = files.read_checkpoint(tmp_path / files.CHECKPOINT)
    assert before["progress"]["step"] == 200 and after["progress"]["step"] == 400 and after["progress"]["share"] == 1
    assert after["options"] == before["options"] | {"iterations": 400}
    assert json.loads((tmp_path / files.OPTIONS).read_text())["options"]["iterations"] == 400
    counts = {entry["step"]: entry["gaussians"] for entry in log_of(tmp_path)}
    assert list(counts) == [10, 100, 200, 300, 400] and counts[400] != counts[200]  # growth had ended, and goes on
    assert train(scene, tmp_path, "--resume") == 0  # it now has that length
    assert "goes on after" not in capsys.readouterr().err


def test_schedules_of_another_length(scene, tmp_path):
    run = make_run(scene, tmp_path, iterations=100)
    run.train()
    longer = make_run(scene, tmp_path, resume=True, more={"iterations": 400})
    assert (longer.progress.share, longer.options.iterations, longer.trainer.density.growing) == (0.25, 400, True)
    longer.trainer.step()
    rate = schedule.means_rate_at(100, 0.25, longer.options) * longer.trainer.extent
    assert longer.trainer.optimizer.param_groups[0]["lr"] == pytest.approx(rate)
    shorter = make_run(scene, tmp_path, resume=True, more={"iterations": 100})
    assert (shorter.progress.share, shorter.notes) == (1, [])


def test_a_training_by_the_clock_goes_on_to_another_length(scene, tmp_path, monkeypatch):
    def timed(run):
        monkeypatch.setattr(schedule.Clock, "_now", lambda clock: 0.01 * run.progress.step)
        assert run.train()
        return run

    timed(make_run(scene, tmp_path, seconds=1.0))
    run = make_run(scene, tmp_path, resume=True, more={"seconds": 3.0})
    assert run.progress.share == pytest.approx(1 / 3)
    assert run.notes[-1].startswith("goes on after step 100 to 3 s in all instead of 1: ")
    assert timed(run).progress.step == 300


@pytest.mark.parametrize(
    "options, message",
    [
        (["--iterations", 19], "iterations must be at least 20, the steps that are over, got 19"),
        (["--seconds", 5], "seconds: this training goes by its steps; give iterations instead"),
        (["--iterations", 30, "--seed", 3], "--seed: a resumed training keeps the options of its checkpoint"),
        (["--preset", "quick"], "--iterations: a resumed training keeps the options of its checkpoint"),
    ],
)
def test_lengths_that_a_training_cannot_go_on_to(scene, tmp_path, capsys, options, message):
    assert train(scene, tmp_path, "--iterations", 20, "--no-evaluate") == 0
    before = (tmp_path / files.CHECKPOINT).read_bytes()
    capsys.readouterr()
    assert message in refused(capsys, commands.train, scene, tmp_path, "--resume", *map(str, options))
    assert (tmp_path / files.CHECKPOINT).read_bytes() == before


def test_another_length_is_for_a_training_that_is_resumed(scene, tmp_path):
    with pytest.raises(ValueError, match="iterations and seconds of Run are for resume"):
        make_run(scene, tmp_path / "out", more={"iterations": 5})


def test_options_of_a_capture_that_says_it_itself_are_errors(scene, tmp_path, capsys):
    told = {"--images": "where its pictures are", "--test-every": "which pictures are for the test"}
    for option, message in told.items():
        error = refused(capsys, train, scene, tmp_path / "out", option, "7", "--iterations", 1)
        assert re.search(rf"error: {option} has no effect: .* itself says {message}", error)
        assert not (tmp_path / "out").exists()
