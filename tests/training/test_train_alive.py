"""Trainings do not die in silence: captures that are hard train, and what is left of a training can be read."""

import functools
import json
import math
import re
import shutil
from dataclasses import replace

import commands
import pytest
import runs
import torch
from capture_files import circle, tripod, truth_gaussians, write_colmap, write_nerf_synthetic, write_pictures
from commands import refused
from train_extra import image

from analytic_rasterizer import io, training
from analytic_rasterizer.captures import extent
from analytic_rasterizer.training import TrainingOptions, extent_of, files

QUICK = {"sh_degree": 0, "footprint": "box:samples=1", "max_gaussians": 400}
FAR = 1e5  # of a camera with a wrong pose


def write_capture(folder, views, points=None):
    """A reconstruction with 96 points on the Gaussians, 4 away from the cameras."""
    if points is None:
        points = truth_gaussians().means.repeat(8, 1)
        points = points + 0.1 * torch.randn(points.shape, generator=torch.Generator().manual_seed(0))
    write_colmap(folder / "sparse" / "0", views, points, torch.full((len(points), 3), 128, dtype=torch.int))
    write_pictures(folder / "images", views, opaque=True)
    return folder


def moved_far(view, name="wrong"):
    """The same camera with a wrong position."""
    w2c = view.w2c.clone()
    w2c[0, 3] = FAR
    return replace(view, name=name, w2c=w2c)


@pytest.fixture(scope="module")
def orbit(tmp_path_factory):
    return write_capture(tmp_path_factory.mktemp("orbit"), circle(10))


make_run = functools.partial(runs.make_run, iterations=200, densify_from=20, densify_every=20, **QUICK)


# ------------------------------------------------------------------- the extent, and cameras


def test_extent_of_cameras_around_an_object_is_that_of_3dgs():
    views, points = circle(10), truth_gaussians().means
    centers = torch.stack([torch.linalg.inv(view.w2c)[:3, 3] for view in views])
    assert extent_of(views, points) == extent_of(views) == 1.1 * (centers - centers.mean(0)).norm(dim=1).max().item()


@pytest.mark.parametrize("baseline", [0.0, 0.1])
def test_extent_of_cameras_at_one_place_follows_what_they_see(baseline):
    views, points = tripod(12, baseline), truth_gaussians().means
    assert extent_of(views, points) == pytest.approx(0.5 * 4, rel=0.2)  # the Gaussians are about 4 away
    moved = [replace(view, w2c=view.w2c.clone()) for view in views]
    for view in moved:
        view.w2c[:3, 3] *= 10
    assert extent_of(moved, 10 * points) == pytest.approx(10 * extent_of(views, points))


def test_extent_where_nothing_is_seen_is_not_zero():
    assert extent_of(tripod(3)) == extent_of([tripod(3)[0]] * 2, torch.zeros(0, 3)) == 1.0


@pytest.mark.parametrize(
    "kind, count, expected",
    [("orbit", 10, 1), ("orbit", 12, 2), ("tripod", 10, 1), ("orbit", 3, 1), ("orbit", 12, 4), ("orbit", 5, 2)],
)
def test_cameras_far_from_all_others_are_outliers(kind, count, expected):
    views, points = {"orbit": circle, "tripod": tripod}[kind](count), truth_gaussians().means
    assert extent.outliers_of(views, points) == {}
    for i in range(expected):
        views[3 * i] = moved_far(views[3 * i])
    found = extent.outliers_of(views, points)
    assert found == {3 * i: pytest.approx(FAR, rel=1e-3) for i in range(expected)}
    if kind == "orbit":  # without points to show, more than a fifth may be an overview
        assert extent.outliers_of(views) == (found if expected <= max(count // 5, 1) else {})


def test_points_that_no_picture_shows_end_a_training_before_it_begins(tmp_path):
    """As of a reconstruction in another world; it was blamed on the learning rate after some steps."""
    folder = write_capture(tmp_path / "data", circle(6), torch.randn(50, 3) + torch.tensor([0.0, 500.0, 0.0]))
    with pytest.raises(io.SceneError, match="no picture shows any of the 50 points of the capture"):
        training.Run(folder, tmp_path / "out", TrainingOptions(iterations=10, **QUICK))
    assert not (tmp_path / "out").exists()


def test_points_of_a_reconstruction_that_are_not_finite_are_left_out(tmp_path):
    points = truth_gaussians().means.clone()
    points[3, 1] = math.nan
    folder = write_capture(tmp_path / "data", circle(6), points)
    with pytest.warns(UserWarning, match=r"points3D.bin: 1 of 12 points are not finite and left out"):
        found = training.load_capture(folder)
    assert len(found.points[0]) == 11


def test_evaluation_on_the_capture_of_another_world_is_told(tmp_path, capsys):
    folder = write_capture(tmp_path / "data", circle(9))
    scene = truth_gaussians().map(torch.Tensor.detach)
    io.save_scene(tmp_path / "here.ply", scene)
    io.save_scene(tmp_path / "there.ply", scene._replace(means=scene.means + 500))
    for name, told in (("here", False), ("there", True)):
        assert commands.evaluate(tmp_path / f"{name}.ply", "--data", folder, "--device cpu") == 0
        assert ("no test picture shows any Gaussian" in capsys.readouterr().err) == told


def test_photographs_of_one_colour_are_told(tmp_path):
    folder = write_capture(tmp_path / "data", circle(6))
    for path in (folder / "images").iterdir():
        image.new("RGB", image.open(path).size).save(path)
    with pytest.warns(UserWarning, match="all 5 photographs are of one colour"):
        training.Run(folder, tmp_path / "out", TrainingOptions(iterations=10, **QUICK))


def test_pictures_that_are_too_small_are_told(tmp_path):
    folder = write_capture(tmp_path / "data", circle(6))  # of 32x32 px
    for scales, told in (((1, 2), False), ((1, 4, 8), True)):
        notes = training.Run(folder, tmp_path / "out", TrainingOptions(iterations=10, scales=scales, **QUICK)).notes
        warned = [note for note in notes if note.startswith("warning: pictures are small")]
        assert len(warned) == told
    assert "(8x8 px at 1/4, 4x4 px at 1/8), and below 11 px there is little to learn; --scales" in warned[0]


def test_cameras_of_two_distances_are_no_outliers():
    """Overviews from far away beside pictures from near, more of them than one in five, or not so far."""
    near, points = circle(10), truth_gaussians().means
    far = [replace(view, w2c=view.w2c.clone()) for view in circle(4)]
    for view in far:
        view.w2c[2, 3] = 200
    assert extent.outliers_of(near + far, points) == {}
    far[0].w2c[2, 3] = 30
    assert extent.outliers_of(near + far[:1], points) == {}


def test_a_camera_that_is_far_from_all_others_is_named_and_changes_nothing(orbit, tmp_path):
    views = circle(10)
    folder = write_capture(tmp_path / "scene", [*views[:4], moved_far(views[4], views[4].name), *views[5:]])
    with pytest.warns(UserWarning, match=r"r_4\.png is left out: its camera is 1e\+05 from the middle of the cameras"):
        found = training.load_capture(folder)
    names = [item.view.name for item in (*found.train, *found.test)]
    assert sorted(names) == sorted(view.name for view in views if view.name != "r_4")
    with pytest.warns(UserWarning, match="r_4"):
        run = make_run(folder, tmp_path / "out", iterations=100)
    usual = make_run(orbit, tmp_path / "usual", iterations=100)
    assert run.trainer.extent == pytest.approx(usual.trainer.extent, rel=0.1)
    run.train()
    usual.train()
    assert run.evaluate()["test"]["mean"]["psnr"] > usual.evaluate()["test"]["mean"]["psnr"] - 3


@pytest.mark.parametrize("baseline", [0.0, 0.1], ids=["tripod", "forward-facing"])
@pytest.mark.parametrize("points", [True, False], ids=["points", "no points"])
def test_cameras_at_one_place_train(tmp_path, baseline, points):
    """All Gaussians were pruned after the first reset, because they were larger than a tenth of the cameras' extent."""
    if points:
        folder = write_capture(tmp_path / "scene", tripod(12, baseline))
    else:
        write_nerf_synthetic(tmp_path / "scene", tripod(12, baseline), tripod(3, baseline))
        folder = tmp_path / "scene"
    run = make_run(folder, tmp_path / "out", iterations=300, reset_every=100, random_points=200)
    assert run.train() and run.count() > 50
    assert run.evaluate()["test"]["mean"]["psnr"] > 25


def test_cameras_with_one_pose_are_refused(tmp_path, capsys):
    folder = write_capture(tmp_path / "scene", [replace(circle(3)[1], name=f"r_{i}") for i in range(4)])
    assert "got all 3 at one place in one direction" in refused(capsys, commands.train, folder, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_resumed_training_has_the_extent_of_its_start(tmp_path):
    """Not that of the Gaussians that it has become."""
    run = make_run(write_capture(tmp_path / "scene", tripod(12)), tmp_path / "out", iterations=5)
    run.train()
    state = files.read_checkpoint(tmp_path / "out" / files.CHECKPOINT)
    state["gaussians"]["means"] *= 10
    files.write_checkpoint(tmp_path / "out" / files.CHECKPOINT, state)
    resumed = training.Run(tmp_path / "scene", tmp_path / "out", resume=True)
    assert resumed.trainer.extent == run.trainer.extent


# ----------------------------------------------------------------------- numbers outside of float32


BROKEN = {
    "means": math.nan,
    "log_scales": 200.0,  # its exponential is infinite
    "rotations": -math.inf,
    "logit_opacities": math.nan,
    "shs": math.inf,
}


def break_rows(trainer, name, rows):
    with torch.no_grad():
        getattr(trainer.gaussians, name)[rows] = BROKEN[name]


# The weights of mcmc take means of opacities and scales, and one that is not finite makes the loss so.
@pytest.mark.parametrize(
    "name, density",
    [(name, density) for name in BROKEN for density in ("absgrad", "none")] + [("means", "mcmc"), ("shs", "mcmc")],
)
def test_gaussians_outside_of_float32_go_and_are_counted(orbit, tmp_path, capsys, monkeypatch, name, density):
    """While the loss stays finite: the rasterizer leaves them out."""
    run = make_run(orbit, tmp_path, density=density, iterations=130)

    def spoil(trainer):
        if trainer.progress.step in (50, 125):
            break_rows(trainer, name, [1, 7])

    runs.around_steps(monkeypatch, after=spoil)
    assert run.train()
    scene = io.load_scene(tmp_path / files.SCENE)
    assert scene.count == run.count() > 80 and run.trainer.dropped == 4
    log = [json.loads(line) for line in (tmp_path / files.LOG).read_text().splitlines()]
    assert [entry["dropped"] for entry in log] == [0, 2, 4]
    said = re.findall("warning: 2 of .* have (.*) outside of float32 by .* away; a lower (.*)", capsys.readouterr().err)
    rate = {"log_scales": "scale", "rotations": "rotation", "logit_opacities": "opacity", "shs": "color"}.get(
        name, name
    )
    assert len(said) == 1 and name in said[0][0] and f"--{rate}-rate" in said[0][1]
    resumed = training.Run(orbit, tmp_path, resume=True)
    assert resumed.trainer.dropped == run.trainer.dropped


@pytest.mark.parametrize("filter_3d", [False, True])
def test_gaussians_go_with_all_that_has_their_rows(orbit, tmp_path, filter_3d):
    run = make_run(orbit, tmp_path, filter_3d=filter_3d)
    trainer = run.trainer
    for _ in range(5):
        trainer.step()
    before = trainer.gaussians.map(lambda field: field.detach().clone())
    sums = trainer.density.gradient_sums.clone()
    break_rows(trainer, "means", [0, 4])
    trainer.check()
    kept = torch.ones(before.count, dtype=torch.bool)
    kept[[0, 4]] = False
    for old, new in zip(before, trainer.gaussians):
        assert torch.equal(old[kept], new)
        assert all(len(trainer.optimizer.state[new][name]) == before.count - 2 for name in ("exp_avg", "exp_avg_sq"))
    assert torch.equal(trainer.density.gradient_sums, sums[kept]) and trainer.dropped == 2
    assert not filter_3d or len(trainer.filter_3d) == before.count - 2
    trainer.step()


def test_most_gaussians_outside_of_float32_end_the_training(orbit, tmp_path, capsys, monkeypatch):
    run = make_run(orbit, tmp_path)
    run.trainer.step()
    run.save()

    def spoil(trainer):
        if trainer.progress.step == 60:
            break_rows(trainer, "means", slice(50, None))

    runs.around_steps(monkeypatch, after=spoil)
    assert commands.train(orbit, tmp_path, "--resume") == 2
    error = capsys.readouterr().err.splitlines()[-1]
    assert error.startswith("error: ") and "Gaussians have means outside of float32 by step 80" in error
    assert error.endswith("the training diverges; a lower --means-rate may help")
    assert not (tmp_path / files.SCENE).exists()
    assert files.read_checkpoint(tmp_path / files.CHECKPOINT)["progress"]["step"] == 1


def test_a_checkpoint_has_no_gaussians_outside_of_float32(orbit, tmp_path):
    run = make_run(orbit, tmp_path)
    for _ in range(3):
        run.trainer.step()
    break_rows(run.trainer, "shs", [2])
    run.save()
    state = files.read_checkpoint(tmp_path / files.CHECKPOINT)
    assert all(field.isfinite().all() for field in state["gaussians"].values()) and state["dropped"] == 1


def test_no_file_holds_what_a_filter_makes_of_very_large_gaussians(orbit, tmp_path):
    run = make_run(orbit, tmp_path, iterations=5)
    run.trainer.step()
    with torch.no_grad():
        run.trainer.gaussians.log_scales[3] = 80.0
    assert run.train()
    with pytest.warns(UserWarning, match=r"1 Gaussians outside of float32 are left out of point_cloud_mip\.ply"):
        run.export_mip()
    assert io.load_scene(tmp_path / files.SCENE).count == run.count()
    assert io.load_scene(tmp_path / files.MIP_SCENE).count == run.count() - 1


# ----------------------------------------------------------------------------- nothing is left


@pytest.mark.parametrize(
    "options, cause",
    [
        ({"prune_above": 1e-6, "reset_every": 30}, r"0 were pruned for opacities below 0\.005 .*, \d+ for scales"),
        ({"prune_opacity": 0.99}, r"\d+ were pruned for opacities below 0\.99 \(--prune-opacity, .*, 0 for scales"),
    ],
    ids=["size", "opacity"],
)
def test_no_gaussians_left_is_an_error(orbit, tmp_path, capsys, options, cause):
    given = QUICK | {"iterations": 200, "densify_every": 20, "densify_from": 21, "save_every": 30} | options
    words = [f"--{name.replace('_', '-')} {value}" for name, value in given.items()]
    assert commands.train(orbit, tmp_path, *words) == 2
    error = capsys.readouterr().err.splitlines()[-1]
    assert error.startswith("error: no Gaussians are left after step 40: ")
    assert re.search(cause, error) and "--prune-above" in error
    assert not (tmp_path / files.SCENE).exists()
    assert files.read_checkpoint(tmp_path / files.CHECKPOINT)["progress"]["step"] == 30


def test_next_to_no_gaussians_left_is_said(orbit, tmp_path, capsys):
    run = make_run(orbit, tmp_path, iterations=60, gradient=1e9)
    with torch.no_grad():
        run.trainer.gaussians.logit_opacities[4:] = -9
    run.train()
    assert run.count() < 10
    assert "warning: step 40 has left 4 of 96 Gaussians: 92 were pruned for opacities" in capsys.readouterr().err


@pytest.mark.parametrize("density", ["none", "mcmc"])
def test_nothing_but_transparent_gaussians_is_an_error(orbit, tmp_path, density):
    run = make_run(orbit, tmp_path, density=density)
    with torch.no_grad():
        run.trainer.gaussians.logit_opacities.fill_(-9)
    option = "--opacity-rate or --opacity-weight" if density == "mcmc" else "--opacity-rate"
    with pytest.raises(RuntimeError, match=rf"all \d+ Gaussians are transparent after step 100 .* {option} may help"):
        run.train()


def test_nothing_in_any_picture_is_an_error(orbit, tmp_path):
    run = make_run(orbit, tmp_path, density="none")
    with torch.no_grad():
        run.trainer.gaussians.means.add_(1e6)
    with pytest.raises(RuntimeError, match=r"no picture shows any of the 96 Gaussians after step 100, .* --means-rate"):
        run.train()


def test_a_picture_without_gaussians_is_none(orbit, tmp_path):
    """As long as another one has some."""
    run = make_run(orbit, tmp_path, density="none", iterations=100)
    run.trainer.step()
    run.trainer._last = torch.zeros(3, 32, 32), *run.trainer._last[1:]
    run.trainer.check()


def test_a_start_from_transparent_gaussians_is_refused(orbit, tmp_path, capsys):
    scene = truth_gaussians()
    io.save_scene(tmp_path / "glass.ply", scene._replace(logit_opacities=torch.full((scene.count, 1), -math.inf)))
    error = refused(capsys, commands.train, orbit, tmp_path / "out", "--points", tmp_path / "glass.ply")
    assert "glass.ply: all Gaussians are transparent (opacities below 1/255)" in error
    assert not (tmp_path / "out").exists()


def test_a_disk_too_full_for_the_checkpoint_does_not_cost_the_scene(orbit, tmp_path, monkeypatch):
    def full_disk(state, path):
        raise OSError(28, "No space left on device")

    run = make_run(orbit, tmp_path, iterations=20)
    monkeypatch.setattr(torch, "save", full_disk)
    with pytest.raises(OSError, match=r"checkpoint\.pt"):
        run.train()
    assert io.load_scene(tmp_path / files.SCENE).count == run.count()


@pytest.mark.parametrize("density", ["absgrad", "none"])
def test_pictures_with_nothing_in_them_are_said(orbit, tmp_path, density):
    """The Gaussians fade."""
    for picture in (orbit / "images").iterdir():
        pixels = torch.zeros(3, 32, 32)
        (tmp_path / "scene" / "images").mkdir(parents=True, exist_ok=True)
        io.to_image(pixels).save(tmp_path / "scene" / "images" / picture.name)
    shutil.copytree(orbit / "sparse", tmp_path / "scene" / "sparse")
    run = make_run(tmp_path / "scene", tmp_path / "out", density=density, iterations=400, opacity_weight=1.0)
    with pytest.raises(RuntimeError, match="there is nothing in the pictures, each of which has one colour"):
        run.train()
