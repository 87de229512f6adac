"""That nothing is lost where a training ends early: interruptions, full disks, checkpoints, and going on."""

import functools
import json
import math
import shutil
import signal

import commands
import pytest
import runs
import torch
import train_extra  # noqa: F401
from commands import refused
from runs import around_steps, scatter

from analytic_rasterizer import io, training
from analytic_rasterizer.gaussians import Gaussians
from analytic_rasterizer.training import TrainingOptions, files

make_run = functools.partial(runs.make_run, **runs.SHORT)


@pytest.mark.parametrize(
    "options",
    [
        {"density": "3dgs", "gradient_scales": "all"},
        {"density": "absgrad", "gradient_scales": "finest", "filter_3d": True, "scale_repeats": (2, 1)},
        {"density": "mcmc", "background": "random", "pictures_per_step": 2},
        {"density": "3dgs", "sh_degree": 0},
        {"footprint_from": 0.8},
        {"sh_degree": 0, "density": "mcmc"},
        {"sparse_adam": True},
        {"sparse_adam": True, "density": "mcmc", "pictures_per_step": 2},
    ],
    ids=["3dgs", "absgrad", "mcmc", "3dgs-constant-colors", "cheap", "mcmc-constant-colors", "sparse", "sparse-mcmc"],
)
def test_resumed_training_gives_the_same_bits(device, synthetic, tmp_path, options):
    """Through a file, at a step between two changes of density, and against a run without a break."""
    common = {"iterations": 75, "densify_until": 0.9, **options}  # changes after steps 40 and 60
    whole, part = (make_run(synthetic, tmp_path / name, device, **common) for name in ("whole", "part"))
    if whole.options.sparse_adam:
        for run in (whole, part):
            scatter(run.trainer.gaussians)
    whole.train()
    for _ in range(47):
        part.trainer.step()
    part.save()
    again = make_run(synthetic, tmp_path / "part", device, resume=True)
    assert again.options == whole.options and again.progress.step == 47
    again.train()
    assert len(part.trainer.gaussians.means) != 150 and len(again.trainer.gaussians.means) != 150
    for name, expected, got in zip(Gaussians._fields, whole.trainer.gaussians, again.trainer.gaussians):
        assert torch.equal(expected, got), name
    assert (tmp_path / "whole" / files.SCENE).read_bytes() == (tmp_path / "part" / files.SCENE).read_bytes()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_and_sigterm_save_and_training_resumes(synthetic, tmp_path, capsys, monkeypatch, number):
    """The step that runs is completed; the end is the same as without the interruption."""
    whole, part, small = tmp_path / "whole", tmp_path / "part", "--iterations 60 --random-points 50 --sh-degree 0"
    assert commands.train(synthetic, whole, small) == 0

    def interrupt(trainer):
        if trainer.progress.step == 33:
            signal.raise_signal(number)

    around_steps(monkeypatch, interrupt)
    before = signal.getsignal(number)
    assert commands.train(synthetic, part, small) == 130
    assert signal.getsignal(number) is before
    assert "stopped after 34 steps and saved; go on with --resume" in capsys.readouterr().out
    assert (part / files.SCENE).exists()
    monkeypatch.undo()
    assert "go on with --resume" in refused(capsys, commands.train, synthetic, part, small)
    error = refused(capsys, commands.train, synthetic, part, small, "--seed 3 --resume")
    assert "--seed: a resumed training keeps the options of its checkpoint" in error
    assert commands.train(synthetic, part, small, "--resume") == 0
    assert (whole / files.SCENE).read_bytes() == (part / files.SCENE).read_bytes()


def test_a_second_ctrl_c_ends_at_once(synthetic, tmp_path, monkeypatch):
    run = make_run(synthetic, tmp_path)
    around_steps(monkeypatch, after=lambda trainer: [signal.raise_signal(signal.SIGINT) for _ in range(2)])
    with pytest.raises(KeyboardInterrupt):
        run.train()


def test_a_second_sigterm_kills(synthetic, tmp_path, monkeypatch):
    run, handlers = make_run(synthetic, tmp_path, iterations=3), []

    def kill(trainer):
        signal.raise_signal(signal.SIGTERM)
        handlers.append(signal.getsignal(signal.SIGTERM))

    around_steps(monkeypatch, after=kill)
    assert not run.train() and handlers == [signal.SIG_DFL]


def test_a_handler_of_the_program_for_sigterm_stays(synthetic, tmp_path, monkeypatch):
    run, received = make_run(synthetic, tmp_path, iterations=3), []
    around_steps(monkeypatch, after=lambda trainer: signal.raise_signal(signal.SIGTERM))
    before = signal.signal(signal.SIGTERM, lambda number, _: received.append(number))
    try:
        assert run.train() and len(received) == 3
    finally:
        signal.signal(signal.SIGTERM, before)


def test_a_folder_that_became_read_only_is_reported_by_the_name_of_the_file(tmp_path, monkeypatch):
    def read_only(path, **_):
        raise OSError(30, "Read-only file system", str(path))

    monkeypatch.setattr(type(tmp_path), "unlink", read_only)
    with pytest.raises(OSError, match=r"options\.json: cannot be written \(Read-only file system\)"):
        files.write_safely(tmp_path / files.OPTIONS, read_only)


def full_disk(state, path) -> None:
    path.write_bytes(b"half of it")
    raise OSError(28, "No space left on device")


def test_full_disk_on_the_way_is_reported_and_at_the_end_keeps_what_was_there(synthetic, tmp_path, capsys, monkeypatch):
    run = make_run(synthetic, tmp_path, iterations=30)
    run.save_every = 10
    save, calls = torch.save, []

    def fails_after_the_first(state, path):
        calls.append(state["progress"]["step"])
        (save if len(calls) == 1 else full_disk)(state, path)

    monkeypatch.setattr(torch, "save", fails_after_the_first)
    with pytest.raises(OSError, match=r"checkpoint.pt: the disk is full; an earlier file of this name is unchanged"):
        run.train()
    assert calls == [10, 20, 30]
    assert "checkpoint.pt: the disk is full" in capsys.readouterr().err
    assert files.read_checkpoint(tmp_path / files.CHECKPOINT)["progress"]["step"] == 10
    assert not [path for path in tmp_path.iterdir() if "partial" in path.name]


def test_a_loss_that_is_not_finite_ends_with_an_error(synthetic, tmp_path, capsys, monkeypatch):
    run = make_run(synthetic, tmp_path)
    for _ in range(3):
        run.trainer.step()
    run.save()

    def without_loss(*fields, op=training.trainer._picture_gradients, **others):
        loss, *results = op(*fields, **others)
        return math.nan * loss, *results

    monkeypatch.setattr(training.trainer, "_picture_gradients", without_loss)
    with pytest.raises(FloatingPointError, match=r"the loss of step 4 is nan"):
        run.train()
    assert commands.train(synthetic, tmp_path, "--resume") == 2
    assert capsys.readouterr().err.endswith("error: the loss of step 4 is nan; lower learning rates may help\n")
    assert files.read_checkpoint(tmp_path / files.CHECKPOINT)["progress"]["step"] == 3


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 nonsense", b"\x80\x04K\x01."])
def test_a_broken_checkpoint_is_one_line(synthetic, tmp_path, capsys, content):
    (tmp_path / files.CHECKPOINT).write_bytes(content)
    assert "checkpoint.pt: " in refused(capsys, commands.train, synthetic, tmp_path, "--resume")


def test_a_checkpoint_of_an_earlier_format(tmp_path):
    torch.save({"format": 1}, tmp_path / files.CHECKPOINT)
    with pytest.raises(io.SceneError, match="expected a checkpoint of format 3, got 1"):
        files.read_checkpoint(tmp_path / files.CHECKPOINT)


def test_the_command_takes_a_preset_and_resumes_with_it(synthetic, tmp_path, capsys):
    arguments = synthetic, tmp_path, "--iterations 3 --random-points 50 --sh-degree 0 --no-evaluate --preset 3dgs"
    assert commands.train(*arguments, "--scales 1,2 --color-rate 0.001") == 0
    stored = TrainingOptions.from_dict(json.loads((tmp_path / files.OPTIONS).read_text())["options"])
    given = {"scales": (1, 2), "color_rate": 1e-3, "iterations": 3, "random_points": 50, "sh_degree": 0}
    assert stored == TrainingOptions.preset("3dgs", **given) and stored.scale_repeats == (1, 1)
    # The same options once more are no contradiction, with or without the scales; others are.
    assert commands.train(*arguments, "--color-rate 0.001 --resume") == 0
    error = refused(capsys, commands.train, *arguments, "--resume")
    assert error == "error: --color-rate: a resumed training keeps the options of its checkpoint\n"


def older_checkpoint(folder, part, name) -> None:
    """One from before it held something."""
    state = files.read_checkpoint(folder / files.CHECKPOINT)
    del state[part][name]
    files.write_checkpoint(folder / files.CHECKPOINT, state)


def test_the_command_takes_sparse_adam_and_resumes_with_it(synthetic, tmp_path, capsys):
    start = Gaussians.from_points(*training.random_points(60, 0), 0)
    scatter(start)
    io.save_scene(tmp_path / "start.ply", start)
    small = ["--points", tmp_path / "start.ply", "--iterations 12 --sh-degree 0 --no-evaluate"]
    dense, sparse = ((synthetic, tmp_path / name, *small) for name in ("dense", "sparse"))
    assert commands.train(*dense) == 0 and commands.train(*sparse, "--sparse-adam") == 0
    for name in ("dense", "sparse"):
        stored = json.loads((tmp_path / name / files.OPTIONS).read_text())["options"]
        assert stored["sparse_adam"] is (name == "sparse")
    scenes = [(tmp_path / name / files.SCENE).read_bytes() for name in ("dense", "sparse")]
    assert scenes[0] != scenes[1]
    # Whether or not it is given once more; a dense training does not become a sparse one.
    assert commands.train(*sparse, "--resume") == 0 and commands.train(*sparse, "--resume --sparse-adam") == 0
    error = refused(capsys, commands.train, *dense, "--resume --sparse-adam")
    assert error == "error: --sparse-adam: a resumed training keeps the options of its checkpoint\n"
    # A checkpoint from before there was the option.
    older_checkpoint(tmp_path / "dense", "options", "sparse_adam")
    assert commands.train(*dense, "--resume") == 0
    assert (tmp_path / "dense" / files.SCENE).read_bytes() == scenes[0]


def test_resuming_takes_the_points_of_the_start_or_none(synthetic, trained, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shutil.copy(trained / files.SCENE, "a.ply")
    shutil.copy(trained / files.SCENE, "b.ply")
    small = "--iterations 2 --sh-degree 1 --no-evaluate"
    began, alone = ((synthetic, name, small) for name in ("began", "alone"))
    assert commands.train(*began, "--points a.ply") == 0
    assert commands.train(*alone, "--random-points 50") == 0
    assert json.loads((tmp_path / "began" / files.OPTIONS).read_text())["source"]["points"] == str(tmp_path / "a.ply")
    for again in ([], ["--points", tmp_path / "a.ply"], ["--points a.ply"]):
        assert commands.train(*began, "--resume", *again) == 0
    written = {path: path.read_bytes() for folder in ("began", "alone") for path in (tmp_path / folder).iterdir()}
    for arguments, expected in ((began, f"{tmp_path / 'a.ply'} or None"), (alone, "None")):
        error = refused(capsys, commands.train, *arguments, "--resume --points b.ply")
        wrong = f"points must be {expected} where a training is resumed, got {tmp_path / 'b.ply'}"
        assert error == f"error: {wrong}\n"
    assert all(path.read_bytes() == content for path, content in written.items())
    # A checkpoint from before they were noted.
    older_checkpoint(tmp_path / "alone", "source", "points")
    assert commands.train(*alone, "--resume --points b.ply") == 0


def test_resuming_takes_the_pictures_of_the_start_or_none(capture, tmp_path, capsys):
    """A training that was resumed without its --images went on with the pictures of another folder."""
    folder, out = tmp_path / "scene", tmp_path / "out"
    shutil.copytree(capture, folder)
    shutil.copytree(folder / "photographs", folder / "images")
    command = folder, out, "--iterations 2 --no-evaluate"
    chosen = ["--images photographs --test-every 4"]
    assert commands.train(*command, *chosen) == 0
    for again in ([], chosen):
        assert commands.train(*command, "--resume", *again) == 0
        source = json.loads((out / files.OPTIONS).read_text())["source"]
        assert (source["images"], source["test_every"]) == ("photographs", 4)
    written = {path: path.read_bytes() for path in out.iterdir()}
    wrong = {"--images": ("images", "photographs", "images"), "--test-every": ("test_every", "4", "8")}
    for option, (name, before, given) in wrong.items():
        error = refused(capsys, commands.train, *command, "--resume", option, given)
        assert error == f"error: {name} must be {before} or None where a training is resumed, got {given}\n"
    assert {path: path.read_bytes() for path in out.iterdir()} == written
