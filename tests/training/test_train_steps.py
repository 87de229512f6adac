"""Steps of a training: that it learns, what a step moves, and what changes no bit of it."""

import functools
import json

import commands
import pytest
import runs
import torch
import train_extra  # noqa: F401
from capture_files import circle, truth_gaussians
from commands import refused
from marks import needs_cuda
from runs import cpu_test_pictures, rows_shown, scatter
from training_step import check_next_step

from analytic_rasterizer import optim, training
from analytic_rasterizer.gaussians import Gaussians
from analytic_rasterizer.training import files, schedule
from analytic_rasterizer.training import rendering as g
from analytic_rasterizer.training.evaluation import evaluate

make_run = functools.partial(runs.make_run, **runs.SHORT)


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"density": "3dgs", "gradient_scales": "all"},
        {"density": "mcmc"},
        {"density": "none"},
        {"supersampling": 2, "footprint": "point"},
    ],
    ids=str,
)
def test_psnr_rises_and_the_results_say_so(device, synthetic, tmp_path, options):
    run = make_run(synthetic, tmp_path, device, **options)
    assert run.train()
    metrics = run.evaluate()
    log = [json.loads(line) for line in (tmp_path / files.LOG).read_text().splitlines()]
    assert [entry["step"] for entry in log] == [10, 100, 120]
    assert log[-1]["loss"] < 0.5 * log[0]["loss"]
    start = evaluate(Gaussians.from_points(*training.random_points(150, 0), 1), cpu_test_pictures(synthetic), "box")
    assert metrics["test"]["mean"]["psnr"] > start["mean"]["psnr"] + 3
    assert metrics["steps"] == 120 and metrics == json.loads((tmp_path / files.METRICS).read_text())
    assert {"1", "2", "mean"} == metrics["test"].keys() and len(metrics["test"]["1"]["views"]) == 3
    if options.get("density") != "none":
        assert 150 < metrics["gaussians"] <= 400


@torch.no_grad()
def state_of(trainer) -> list[torch.Tensor]:
    """Copies of parameters and moments, a row for each Gaussian."""
    moments = [trainer.optimizer.state[field].get(m) for field in trainer.gaussians for m in optim.MOMENTS]
    return [t.detach().clone() for t in (*trainer.gaussians, *(m for m in moments if m is not None))]


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"pictures_per_step": 3},
        {"supersampling": 2, "footprint": "point"},
        {"filter_3d": True},
        {"opacity_weight": 0.1, "scale_weight": 0.1},
        {"density": "mcmc", "noise": 0.0},
    ],
    ids=str,
)
def test_a_sparse_step_moves_what_its_pictures_show(device, synthetic, tmp_path, options):
    """The first step as one on all Gaussians does; the others keep parameters and moments in every step."""
    common = {"density": "none", "densify_from": 1000, **options}
    dense, sparse = (make_run(synthetic, tmp_path, device, sparse_adam=s, **common).trainer for s in (False, True))
    for trainer in (dense, sparse):
        scatter(trainer.gaussians)
    # Of Gaussians that this step's pictures do not show, some have been moved before.
    had_moments = False
    for step in range(8):
        shown = rows_shown(sparse)
        rows, before = torch.stack(shown).any(0), state_of(sparse)
        assert 0 < rows.sum() < 100 and (len(shown) == 1 or not torch.equal(rows, shown[0]))
        sparse.step()
        after = state_of(sparse)
        if step == 0:
            start = before[0].new_zeros(())
            dense.step()
            for expected, got in zip(state_of(dense), after):
                assert torch.equal(expected[rows], got[rows])
            assert all((moment[~rows] == start).all() for moment in after[5:])
            moved = [not torch.equal(new[~rows], old[~rows]) for new, old in zip(dense.gaussians, before)]
            assert any(moved) == any(sparse.options.regularizers)
        for old, new in zip(before, after):
            assert torch.equal(old[~rows], new[~rows])
        assert not torch.equal(before[0][rows], after[0][rows]) and not torch.equal(before[3][rows], after[3][rows])
        had_moments = had_moments or (step > 0 and bool((before[-1][~rows] != 0).any()))
    assert had_moments


def test_supersampled_pictures_are_means_of_larger_ones(device):
    """With the gradient of the mean; within what the two cameras' roundings to float32 differ by."""
    view = circle(3)[0]
    pictures, gradients = [], []
    for scale, supersampling in ((3, 1), (1, 3)):
        gaussians = truth_gaussians().map(lambda field: field.to(device).requires_grad_())
        settings = view.settings(scale, sh_degree=0, footprint="point", device=device)
        picture, radii = g.render(gaussians.arguments(), settings, supersampling=supersampling)
        pictures.append(torch.nn.functional.avg_pool2d(picture, 3 // supersampling))
        pictures[-1].square().sum().backward()
        gradients.append(gaussians.means.grad)
        assert radii.max() > 20  # px of the large picture
    assert pictures[1].shape == (3, 32, 32)
    torch.testing.assert_close(pictures[1], pictures[0], rtol=0, atol=1e-4)
    torch.testing.assert_close(gradients[1], gradients[0], rtol=1e-3, atol=1e-3 * gradients[0].abs().max().item())


def test_a_step_renders_supersampled_pictures(device, synthetic, tmp_path):
    run = make_run(synthetic, tmp_path, device, supersampling=4, footprint="point")
    view, scale = run.trainer.order(0)
    settings = run.trainer.pictures.settings[scale][view]._replace(sh_degree=0, footprint="point")
    with torch.no_grad():
        expected, plain = (g.render(run.trainer.gaussians.arguments(), settings, supersampling=n)[0] for n in (4, 1))
    run.trainer.step()
    torch.testing.assert_close(run.trainer.last[0], expected, rtol=0, atol=1e-6)
    assert (plain - expected).abs().max() > 1e-3


@pytest.mark.filterwarnings("error:.*deterministic")
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"density": "3dgs", "supersampling": 2, "filter_3d": True},
        {"density": "mcmc", "background": "random", "pictures_per_step": 2, "sparse_adam": True},
    ],
    ids=["absgrad", "3dgs", "mcmc"],
)
def test_a_deterministic_training_counts_every_frame(device, synthetic, tmp_path, monkeypatch, options):
    """In torch's deterministic mode, without operators that would break it, and with the bits of other trainings."""
    common = {"iterations": 75, "densify_until": 0.9, **options}  # changes after steps 40 and 60
    runs = [make_run(synthetic, tmp_path / str(on), device, deterministic=on, **common) for on in (False, True)]
    modes, following = [], schedule.PictureOrder.__call__
    note = lambda order, n: (modes.append(torch.get_deterministic_debug_mode()), following(order, n))[1]  # noqa: E731
    monkeypatch.setattr(schedule.PictureOrder, "__call__", note)
    for run, mode in zip(runs, (0, 1)):
        modes.clear()
        run.train()
        assert len(modes) >= 75 and set(modes) == {mode}
        assert torch.get_deterministic_debug_mode() == 0
    assert len(runs[0].trainer.gaussians.means) != 150
    for name, one, other in zip(Gaussians._fields, *(run.trainer.gaussians for run in runs)):
        assert torch.equal(one, other), name


def test_a_deterministic_step_leaves_the_mode_of_the_program(synthetic, tmp_path, monkeypatch):
    """A stricter one stays on in the step, and an error ends what the step has switched on."""
    run = make_run(synthetic, tmp_path, deterministic=True)
    modes = []
    monkeypatch.setattr(run.trainer, "_set_rates", lambda: modes.append(torch.get_deterministic_debug_mode()) or 1 / 0)
    for before in (0, 2):
        torch.set_deterministic_debug_mode(before)
        try:
            with pytest.raises(ZeroDivisionError):
                run.trainer.step()
            assert torch.get_deterministic_debug_mode() == before
        finally:
            torch.set_deterministic_debug_mode(0)
    assert modes == [1, 2]


def test_the_command_takes_deterministic(synthetic, tmp_path, capsys):
    error = refused(capsys, commands.train, synthetic, tmp_path, "--deterministic --seconds 5")
    assert "--deterministic has no effect: by the clock, every run has another number" in error
    small = "--iterations 3 --random-points 50 --no-evaluate"
    assert commands.train(synthetic, tmp_path, "--deterministic", small) == 0
    assert json.loads((tmp_path / files.OPTIONS).read_text())["options"]["deterministic"] is True


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"density": "3dgs", "gradient_scales": "all"},
        {"density": "none", "sh_degree": 0},
        {"background": "random"},
        {"density": "mcmc"},
        {"pictures_per_step": 5, "gradient_scales": "all"},
        {"supersampling": 2},
        {"filter_3d": True},
        {"exposure": "affine"},
        {"vignetting": "polynomial"},
        {"exposure": "affine", "vignetting": "polynomial", "supersampling": 2, "scales": (1, 2)},
        {"opacity_weight": 0.1, "scale_weight": 0.2, "filter_3d": True, "supersampling": 3, "pictures_per_step": 3},
    ],
    ids=str,
)
def test_a_step_has_the_gradients_of_autograd(device, synthetic, tmp_path, options):
    run = make_run(synthetic, tmp_path, device, **options)
    for _ in range(3):  # Balls have no gradient by their rotation.
        run.trainer.step()
    check_next_step(run.trainer)


@pytest.mark.parametrize("options", [{}, {"density": "mcmc"}, {"background": "random", "filter_3d": True}], ids=str)
def test_another_default_dtype_changes_nothing(synthetic, tmp_path, options):
    measured = []
    for name, dtype in (("single", torch.float32), ("double", torch.float64)):
        torch.set_default_dtype(dtype)
        try:
            run = make_run(synthetic, tmp_path / name, iterations=60, **options)
            run.train()
            measured.append(run.evaluate()["test"])
        finally:
            torch.set_default_dtype(torch.float32)
    assert measured[0] == measured[1]
    scenes = [(tmp_path / name / files.SCENE).read_bytes() for name in ("single", "double")]
    assert scenes[0] == scenes[1]


@pytest.mark.parametrize("options", [{}, {"density": "mcmc"}], ids=str)
def test_training_where_gradients_are_switched_off(synthetic, tmp_path, options):
    with torch.no_grad():
        run = make_run(synthetic, tmp_path / "off", iterations=40, **options)
        run.train()
    make_run(synthetic, tmp_path / "on", iterations=40, **options).train()
    scenes = [(tmp_path / name / files.SCENE).read_bytes() for name in ("off", "on")]
    assert scenes[0] == scenes[1]


def test_training_by_time_on_a_capture(capture, tmp_path, monkeypatch):
    """By a clock on which every step takes 0.02 s, for how many a machine does in a given time is not known."""
    run = make_run(capture, tmp_path, seconds=0.59, density="none", footprint="cumulant")
    monkeypatch.setattr(schedule.Clock, "_now", lambda clock: 0.02 * run.progress.step)
    assert run.train()
    assert run.clock.total >= 0.59 and run.progress.share >= 1 and run.progress.step == 30
    assert len(run.trainer.gaussians.means) == 60
    assert run.trainer.pictures.settings[2][0].image_width == 17


@pytest.mark.parametrize(
    "kind", [pytest.param(k, id=f"cuda-{k}", marks=needs_cuda) for k in ("3dgs", "absgrad", "mcmc")]
)
@pytest.mark.parametrize("sparse", [pytest.param(False, id="dense"), pytest.param(True, id="sparse")])
def test_steps_do_not_wait_for_the_device(synthetic, tmp_path, kind, sparse):
    """Outside of the steps that change the number of Gaussians, once the frames of every size are known."""
    run = make_run(synthetic, tmp_path, "cuda", iterations=1000, density=kind, densify_from=900, sparse_adam=sparse)
    for _ in range(100):
        run.trainer.step()
    torch.cuda.set_sync_debug_mode("error")
    try:
        for _ in range(20):
            run.trainer.step()
    finally:
        torch.cuda.set_sync_debug_mode("default")
