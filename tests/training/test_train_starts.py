"""What a training starts from: random points, points of a capture or a file, a scene."""

import functools

import commands
import pytest
import runs
import torch
import train_extra  # noqa: F401
from commands import refused
from ply_files import ply, vertices

from analytic_rasterizer import io, training
from analytic_rasterizer.training import TrainingOptions, files

make_run = functools.partial(runs.make_run, **runs.SHORT)


@pytest.mark.parametrize("density", ["absgrad", "mcmc"])
def test_random_points_keep_to_the_limit(synthetic, tmp_path, density):
    """By default there are as many as it allows, and those of a start with so many."""
    run = make_run(synthetic, tmp_path, density=density, max_gaussians=130, random_points=0, iterations=75)
    assert run.options.random_points == 130 and run.points_found is None
    assert torch.equal(run.trainer.gaussians.means.detach(), training.random_points(130, 0)[0])
    counts = []
    while run.progress.share < 1:
        run.trainer.step()
        counts.append(run.count())
    assert counts[0] == max(counts) == 130


def test_number_of_random_points():
    def number(**given):
        return TrainingOptions(**given).random_points

    assert number() == number(max_gaussians=0) == TrainingOptions.preset("3dgs").random_points == 100_000
    assert number(max_gaussians=99_999) == 99_999 and number(random_points=200_000) == 200_000
    # As files of trainings have it that began before this was refused; they can still be evaluated and resumed.
    earlier = TrainingOptions.from_dict({"random_points": 500, "max_gaussians": 300})
    assert earlier.random_points == 500
    with pytest.raises(ValueError, match="random_points must be at most max_gaussians, 300, got 500"):
        training.starting_gaussians(earlier, None)


@pytest.mark.parametrize("given", [False, True], ids=["of the capture", "given"])
def test_of_more_points_than_the_limit_some_are_drawn(capture, tmp_path, capsys, given):
    fixed = ["--images photographs --iterations 1 --sh-degree 0 --no-evaluate"]
    fixed += ["--means-rate 1e-30 --means-rate-end 1e-30"]
    points, _ = training.random_points(60, seed=5)
    if given:
        points = points + 1
        (tmp_path / "p.ply").write_bytes(ply(vertices("xyz", points, "double"), layout="ascii"))
        fixed += ["--points", tmp_path / "p.ply"]

    def start(name, *extra):
        assert commands.train(capture, tmp_path / name, *fixed, *extra) == 0
        state = files.read_checkpoint(tmp_path / name / files.CHECKPOINT)
        return state["gaussians"]["means"], "drawn at random" in capsys.readouterr().err

    everything, said = start("60", "--max-gaussians 60")
    assert torch.equal(everything, points) and not said
    some, said = start("40", "--max-gaussians 40")
    assert len(some) == 40 and said
    places = [torch.where((points == row).all(1))[0].item() for row in some]
    assert places == sorted(set(places)) and places != list(range(40))
    assert torch.equal(start("again", "--max-gaussians 40")[0], some)
    assert not torch.equal(start("seed", "--max-gaussians 40 --seed 1")[0], some)


def test_a_scene_of_more_gaussians_than_the_limit_is_refused(synthetic, trained, tmp_path, capsys):
    count, path = len(io.load_scene(trained / files.SCENE).means), trained / files.SCENE
    error = refused(capsys, commands.train, synthetic, tmp_path / "out", "--max-gaussians 30 --points", path)
    assert error == f"error: max_gaussians must be at least {count}, the Gaussians of {path}, or 0, got 30\n"
    assert not (tmp_path / "out").exists()


def test_training_starts_from_a_scene(synthetic, trained, tmp_path):
    options = TrainingOptions(iterations=1, sh_degree=2, density="none")
    run = training.Run(synthetic, tmp_path / "out", options, points=trained / files.SCENE)
    expected = io.load_scene(trained / files.SCENE)
    torch.testing.assert_close(run.trainer.gaussians.means.detach(), expected.means)
    torch.testing.assert_close(run.trainer.gaussians.shs[:, :4].detach(), expected.shs)
    assert run.trainer.gaussians.shs.shape[1] == 9 and (run.trainer.gaussians.shs[:, 4:] == 0).all()


def test_training_does_not_start_from_a_scene_without_gaussians(synthetic, trained, tmp_path, capsys):
    scene = io.load_scene(trained / files.SCENE)
    io.save_scene(tmp_path / "none.ply", scene.rows(slice(0)))
    error = refused(capsys, commands.train, synthetic, tmp_path / "out", "--points", tmp_path / "none.ply")
    assert error == f"error: {tmp_path / 'none.ply'}: the scene has no Gaussians\n"
