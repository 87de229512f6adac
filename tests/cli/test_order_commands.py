"""`--order` of the commands: trainings say it, and what shows a scene follows."""

import json

import commands
import numpy as np
import pytest
import torch
from commands import command, refused
from train_extra import image

import analytic_rasterizer as ar
from analytic_rasterizer import io, training
from analytic_rasterizer.distributed.ranks import Ranks
from analytic_rasterizer.render.order import CENTER, RAY
from analytic_rasterizer.training import files


@pytest.fixture(scope="module")
def trained(synthetic, tmp_path_factory):
    """A few steps along rays."""
    out = tmp_path_factory.mktemp("trained")
    options = "--iterations 30 --random-points 60 --effects none --density none --no-evaluate --order ray"
    assert commands.train(synthetic, out, options, "--footprint box:samples=1") == 0
    return out


def test_a_training_says_its_order(trained):
    assert json.loads((trained / files.OPTIONS).read_text())["options"]["order"] == RAY
    assert io.read_metadata(trained / files.SCENE).order == RAY
    assert "analytic_rasterizer order ray" in (trained / files.SCENE).read_bytes().split(b"end_header")[0].decode()


def test_steps_are_those_of_the_order(synthetic, tmp_path):
    """The gradients of the order, which the picture of a step has too: the two orders part from the first step on."""
    found = {}
    for order in (CENTER, RAY):
        options = training.TrainingOptions(
            iterations=3, random_points=60, effects="none", density="none", footprint="box:samples=1", order=order
        )
        run = training.Run(synthetic, tmp_path / order, options)
        run.train()
        found[order] = run.trainer.gaussians.means.detach().clone()
    assert not torch.equal(found[CENTER], found[RAY])


def test_what_shows_a_scene_follows(trained, tmp_path, capsys):
    assert command("render", trained, "--device cpu --out", tmp_path / "own") == 0
    assert "order ray: scene.ply says so" in capsys.readouterr().err.splitlines()
    assert command("render", trained, "--device cpu --order center --out", tmp_path / "center") == 0
    assert "order center: as given" not in capsys.readouterr().err
    view = io.find_scene(trained).load_views()[0]
    scene = io.load_scene(trained / files.SCENE)
    for folder, order in (("own", RAY), ("center", CENTER)):
        background = io.find_scene(trained).background[0]
        settings = view.settings(1, background, scene.sh_degree, "box:samples=1", effects=ar.Effects(order=order))
        with torch.no_grad():
            expected = ar.GaussianRasterizer(settings)(means2D=None, **scene.arguments())[0]
        pixels = np.asarray(image.open(tmp_path / folder / f"{view.name}.png")).copy()
        written = torch.from_numpy(pixels).permute(2, 0, 1)[:3] / 255
        assert (written - expected.clamp(0, 1)).abs().max() <= 0.5 / 255 + 1e-6


def test_evaluate_follows(trained, capsys):
    assert commands.evaluate(trained) == 0
    assert "order ray: scene.ply says so" in capsys.readouterr().err
    own = json.loads((trained / "evaluation.json").read_text())
    assert own["order"] == {"box:samples=1": RAY}
    assert commands.evaluate(trained, "--order center --footprint box:samples=1 cumulant") == 0
    other = json.loads((trained / "evaluation.json").read_text())
    assert other["order"] == {"box:samples=1": CENTER, "cumulant": CENTER}
    values = [found["results"]["box:samples=1"]["mean"]["psnr"] for found in (own, other)]
    assert values[0] != values[1] and abs(values[0] - values[1]) < 3


def test_what_cannot_be_combined_is_refused(trained, tmp_path, capsys):
    error = refused(capsys, command, "render", trained, "--order ray --footprint cumulant --out", tmp_path / "out")
    assert error.startswith("error: footprint must be one of point, mip, analytic, box:samples=1")
    error = refused(capsys, command, "view", trained, "--no-browser --order ray")
    assert error == "error: --order ray is for --server: the browser draws in the order of center\n"
    with pytest.raises(ValueError, match=r"footprint must be one of .* with order 'ray', got box:samples=16"):
        training.TrainingOptions(order=RAY, footprint="box:samples=16")
    with pytest.raises(ValueError, match="order must be one of center, ray, ray:32, got last"):
        training.TrainingOptions(order="last")


def test_several_processes_are_refused(synthetic, tmp_path):
    """Before anything is read or written."""
    options = training.TrainingOptions(order=RAY, footprint="box:samples=1")
    with pytest.raises(ValueError, match="order must be center for 2 processes, got ray"):
        training.Run(synthetic, tmp_path / "out", options, ranks=Ranks(world=2))
    assert not (tmp_path / "out").exists()


def test_the_page_says_what_it_does_not_draw(trained, tmp_path, capsys):
    assert command("view", trained, "--export", tmp_path / "page.html") == 0
    assert "scene.ply was trained in order ray, which --server shows" in capsys.readouterr().err
