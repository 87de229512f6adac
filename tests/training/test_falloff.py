"""Vignetting that a training learns, for each camera: what it is, what it starts from, and what it brings."""

import copy
import json
import math
from dataclasses import replace

import commands
import numpy as np
import pytest
import runs
import torch
from capture_files import circle
from commands import refused
from test_vignetting import FOURTH, SQUARE, darker, near_and_far
from training_step import falloff
from wall import COUNT, write_wall

from analytic_rasterizer import Lens, io, training
from analytic_rasterizer.distributed.ranks import Ranks
from analytic_rasterizer.training import files
from analytic_rasterizer.training.exposure import GAMMA, corrected
from analytic_rasterizer.training.falloff import Falloffs, falloff_of, known_falloffs, polynomial_of, read_falloffs

CPU = torch.device("cpu")


def two_cameras() -> list[io.View]:
    """Four photographs of one camera, of which one is upright, then two of another and one of a sphere."""
    first = circle(7, (60, 40))
    upright = replace(first[1], width=40, height=60)
    sphere = replace(first[6], lens=Lens.equirectangular(), fx=60 / (2 * math.pi), fy=40 / math.pi)
    return [first[0], upright, *first[2:4], *(replace(view, fx=300.0, fy=300.0) for view in first[4:6]), sphere]


def test_photographs_of_a_camera_share_a_polynomial():
    falloffs = Falloffs(two_cameras(), CPU)
    assert falloffs.camera == [0, 0, 0, 0, 1, 1, None]
    assert falloffs.arguments(6, 60, 40) == {"vignetting": None, "center": []}
    for step in range(20):
        falloffs.update({step % 6: torch.tensor([1.0, -1.0])}, step / 20)
    assert (falloffs.coefficients[:, 0] < 0).all() and (falloffs.coefficients[:, 1] > 0).all()
    again = Falloffs(two_cameras(), CPU)
    again.load_state_dict(copy.deepcopy(falloffs.state_dict()))
    for each in (falloffs, again):
        each.update({1: torch.ones(2)}, 0.5)
    assert torch.equal(falloffs.coefficients, again.coefficients)


@pytest.mark.parametrize("size", [(60, 40), (40, 60), (31, 31)])
def test_the_mean_over_a_picture_is_kept(size):
    """Of any principal point, and at any size of the picture; to the error of the midpoint rule."""
    width, height = size
    view = replace(circle(1, size)[0], cx=0.4 * width, cy=0.7 * height)
    falloffs = Falloffs([view], CPU)
    falloffs.coefficients[0] = torch.tensor([-0.5, 0.3])
    white = torch.ones(3, 8 * height, 8 * width, dtype=torch.float64)
    given = falloffs.arguments(0, 8 * width, 8 * height)
    shown = corrected(white, None, given["vignetting"].double(), given["center"])
    assert shown.mean().item() == pytest.approx(1, abs=1e-4)
    assert torch.allclose(shown[0], falloff(8 * height, 8 * width, given["vignetting"].double(), given["center"]))
    coarse = corrected(white[:, :height, :width].contiguous(), None, given["vignetting"].double(), view.middle)
    # The curvature of the polynomial over a pixel.
    assert (torch.nn.functional.avg_pool2d(shown, 8) - coarse).abs().max() < 5 / min(size) ** 2


def test_a_measured_start_is_the_falloff_of_stored_values():
    view = circle(1, (60, 40))[0]
    falloffs, slopes = Falloffs([view, view], CPU), torch.tensor([SQUARE, FOURTH], dtype=torch.float64)
    falloffs.start({})
    assert not falloffs.coefficients.any()
    falloffs.start({1: (slopes, 0.9)})
    assert torch.equal(falloffs.coefficients[0].double(), polynomial_of(slopes, 0.9, view).float().double())
    factors = falloff(40, 60, falloffs.coefficients[0].double(), view.middle)
    x, y = np.arange(60) + 0.5 - 30, np.arange(40) + 0.5 - 20
    half = math.hypot(30, 20)
    expected = torch.from_numpy(darker(x / half, y[:, None] / half) ** (1 / GAMMA))
    ratio = factors / expected
    assert (ratio / ratio.mean() - 1).abs().max() < 0.01


def test_cameras_are_found_again(tmp_path):
    falloffs = Falloffs(two_cameras(), CPU)
    falloffs.coefficients.copy_(torch.tensor([[-0.25, 0.5], [0.75, -0.5]]))
    files.write_json(tmp_path / "v.json", falloffs.to_json())
    known, (first, upright, *_, second, _, sphere) = read_falloffs(tmp_path / "v.json"), two_cameras()
    assert known == known_falloffs(falloffs.to_json())
    assert falloff_of(first, known) == falloff_of(upright, known) == (-0.25, 0.5)
    assert falloff_of(first.resized(30, 20), known) == (-0.25, 0.5)
    assert falloff_of(second, known) == (0.75, -0.5)
    for other in (sphere, replace(first, fx=150.0, fy=150.0), replace(first, width=80)):
        assert falloff_of(other, known) is None
    assert falloff_of(first, []) is None
    (tmp_path / "v.json").write_text('[{"width": 3}]')
    with pytest.raises(io.SceneError, match=r"v.json: not what `train` writes"):
        read_falloffs(tmp_path / "v.json")


@pytest.fixture(scope="module")
def dark(tmp_path_factory):
    """A capture with tracks, of one camera."""
    return write_wall(tmp_path_factory.mktemp("dark") / "wall", near_and_far(), falloff=darker)


KNOWN = {"iterations": 400, "density": "none", "footprint": "box:samples=1", "effects": "none"}


def test_vignetting_is_learned(dark, tmp_path):
    """From nothing. Also in the test, whose cameras have it too; the scene has none."""
    made = {name: runs.make_run(dark, tmp_path / name, vignetting=name, **KNOWN) for name in ("none", "polynomial")}
    falloffs = made["polynomial"].trainer.corrections.falloffs
    (measured,) = falloffs.coefficients.clone()
    falloffs.coefficients.zero_()
    psnr = {}
    for name, run in made.items():
        run.train()
        psnr[name] = run.evaluate()["test"]["mean"]["psnr_color_corrected"]
    assert psnr["polynomial"] > psnr["none"] + 0.1
    (learned,) = falloffs.coefficients
    darkest = [falloff(120, 160, numbers.double(), (80, 60)).min() for numbers in (measured, learned)]
    assert 1 - darkest[1] > 0.5 * (1 - darkest[0])
    (camera,) = json.loads((tmp_path / "polynomial" / files.VIGNETTING).read_text())
    assert camera["coefficients"] == learned.tolist() and len(camera["photographs"]) == COUNT - 2
    assert not (tmp_path / "none" / files.VIGNETTING).exists()


def test_a_resumed_training_has_the_same_bits(dark, tmp_path):
    options = KNOWN | {"iterations": 60, "exposure": "affine", "vignetting": "polynomial", "scales": (1, 2)}
    runs.trained(dark, tmp_path / "whole", **options)
    run = runs.make_run(dark, tmp_path / "parts", **options)
    for _ in range(25):
        run.trainer.step()
    run.save()
    training.Run(dark, tmp_path / "parts", resume=True).train()
    names = (files.SCENE, files.EXPOSURES, files.VIGNETTING)
    assert all((tmp_path / "whole" / name).read_bytes() == (tmp_path / "parts" / name).read_bytes() for name in names)


def test_the_command(dark, tmp_path, capsys):
    """It starts from what was measured, by itself; the test says what it compares; several processes refuse."""
    out = tmp_path / "out"
    assert commands.train(dark, out, "--iterations 3 --first-footprint none") == 0
    shown = capsys.readouterr()
    assert "--effects auto takes --vignetting polynomial" in shown.err
    assert "after the vignetting of their cameras and the best affine colour" in shown.out
    (camera,) = json.loads((out / files.VIGNETTING).read_text())
    k2, k4 = camera["coefficients"]
    # Stops of stored values from the middle to 0.6 of the way to the corners.
    assert GAMMA * math.log2(1 - (k2 * 0.36 + k4 * 0.36**2)) == pytest.approx(-math.log2(darker(0.6, 0.0)), abs=0.1)
    assert commands.evaluate(out) == 0
    assert "after the vignetting of their cameras" in capsys.readouterr().out
    (out / files.VIGNETTING).unlink()
    assert files.VIGNETTING in refused(capsys, commands.evaluate, out)
    assert "vignetting" in refused(capsys, commands.train, dark, out, "--iterations 3 --vignetting round")
    with pytest.raises(ValueError, match="vignetting must be none for 2 processes, got polynomial"):
        training.Run(dark, out, training.TrainingOptions(vignetting="polynomial"), ranks=Ranks(0, 2))
