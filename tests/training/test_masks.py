"""Masks: pixels that do not count teach nothing, and are not measured."""

import functools
import json

import commands
import numpy as np
import pytest
import runs
import torch
from capture_files import circle, draw_picture, write_colmap
from cli_extra import image
from training_step import check_next_step

from analytic_rasterizer import io, training
from analytic_rasterizer.captures import photographs, pictures
from analytic_rasterizer.losses import l1_ssim
from analytic_rasterizer.training import files

SIZE = (40, 36)
POINTS = torch.rand(60, 3, generator=torch.Generator().manual_seed(0)) - 0.5


def write_capture(folder, paint, masked=True, coefficients=None):
    """Nine photographs, each with a rectangle that is painted; the mask leaves it out."""
    views = circle(9, SIZE)
    (folder / "images").mkdir(parents=True)
    (folder / "masks").mkdir()
    for k, view in enumerate(views):
        picture, mask = draw_picture(view, opaque=True).copy(), np.full((SIZE[1], SIZE[0]), 255, np.uint8)
        hole = np.s_[3 + k : 17 + k, 5 : 21 + k]
        picture[hole] = paint(picture[hole].shape)
        mask[hole] = 0
        image.fromarray(picture).save(folder / "images" / f"{view.name}.png")
        if masked:
            image.fromarray(mask).save(folder / "masks" / f"{view.name}.png.png")
    model, numbers = (1, None) if coefficients is None else (2, coefficients)
    write_colmap(folder / "sparse" / "0", views, POINTS, torch.full((60, 3), 128, dtype=torch.int32), model, numbers)


def black(shape):
    return np.zeros(shape, np.uint8)


def wild(shape):
    return np.random.default_rng(1).integers(0, 256, shape, np.uint8)


run_of = functools.partial(runs.trained, iterations=60, densify_every=20, densify_from=10, max_gaussians=200)


@pytest.mark.parametrize(
    "options, lens, coefficients",
    [
        ({}, None, None),
        ({"scales": (1, 2, 4)}, None, None),
        ({"scales": (2,), "downsampling": "bicubic"}, None, None),
        ({"density": "mcmc"}, None, None),
        ({}, "keep", [-0.1]),
        ({"scales": (1, 2)}, "undistort", [-0.1]),
    ],
    ids=str,
)
def test_what_is_masked_teaches_nothing(tmp_path, options, lens, coefficients):
    """Painted wild or black, what it hides makes no difference to any bit; without masks it does."""
    written, measured = {}, {}
    for name, paint, masked in (("black", black, True), ("wild", wild, True), ("unmasked", wild, False)):
        write_capture(tmp_path / name, paint, masked, coefficients)
        run = run_of(tmp_path / name, tmp_path / f"{name}_out", lens=lens, **options)
        written[name] = (tmp_path / f"{name}_out" / files.SCENE).read_bytes()
        measured[name] = run.evaluate()["test"]
    assert written["black"] == written["wild"] != written["unmasked"]
    assert measured["black"] == measured["wild"]
    assert measured["wild"]["mean"]["psnr"] > measured["unmasked"]["mean"]["psnr"] + 1


@pytest.mark.parametrize("options", [{}, {"pictures_per_step": 2, "supersampling": 2}], ids=str)
def test_a_step_has_the_gradients_of_autograd(tmp_path, options):
    write_capture(tmp_path / "scene", wild)
    check_next_step(run_of(tmp_path / "scene", tmp_path / "out", iterations=30, **options).trainer)


def test_the_loss_of_what_counts(device):
    generator = torch.Generator().manual_seed(0)
    shown, target = (torch.rand(3, 20, 24, generator=generator, dtype=torch.float64).to(device) for _ in range(2))
    mask = torch.ones(20, 24, dtype=torch.float64, device=device)
    assert torch.equal(l1_ssim(shown, target, 0.2, mask), l1_ssim(shown, target, 0.2))
    mask[4:15, 3:20], mask[:, 22] = 0, 0.5
    leaf = shown.clone().requires_grad_()
    loss = l1_ssim(leaf, target, 0.2, mask)
    loss.backward()
    assert torch.equal(loss, l1_ssim(shown * mask, target * mask, 0.2))
    assert (leaf.grad[:, mask == 0] == 0).all() and (leaf.grad[:, mask == 1] != 0).all()
    levels = (255 * target).round().byte()
    assert torch.equal(l1_ssim(shown, levels, 0.2, mask), l1_ssim(shown, levels.double() / 255, 0.2, mask))
    other = torch.where(mask == 0, 17.0, shown)
    assert torch.equal(l1_ssim(other, target, 0.2, mask), loss)


@pytest.mark.parametrize(
    "mask, error, message",
    [
        (torch.ones(20, 23), ValueError, r"mask must have shape \(H, W\) = \(20, 24\), got \(20, 23\)"),
        (torch.ones(20, 24, dtype=torch.uint8), TypeError, "mask must have the dtype of image, torch.float32"),
        (0.5, TypeError, "mask must be a tensor"),
    ],
)
def test_masks_that_are_none(mask, error, message):
    with pytest.raises(error, match=message):
        l1_ssim(torch.rand(3, 20, 24), torch.rand(3, 20, 24), 0.2, mask)


@pytest.mark.parametrize("downsampling", ["box", "bicubic", "blender"])
def test_coarse_pictures_are_means_of_what_counts(downsampling):
    rgba = torch.full((8, 8, 4), 255, dtype=torch.uint8)
    rgba[..., :3] = 40
    mask = torch.full((8, 8), 255, dtype=torch.uint8)
    rgba[:4, :3, :3], mask[:4, :3] = 255, 0
    color, share = pictures.reduce(rgba, 2, (0.0, 0.0, 0.0), downsampling, mask)
    assert (share[:2, 0] == 0).all() or downsampling == "bicubic"
    assert (color[:, share == 0] == 0).all() and (color[:, share > 0].int() - 40).abs().max() <= 1
    if downsampling != "bicubic":
        assert share.tolist() == [[0, 128, 255, 255]] * 2 + [[255] * 4] * 2
    color, share = pictures.reduce(rgba, 1, (0.0, 0.0, 0.0), downsampling, mask)
    assert torch.equal(share, mask) and (color[:, mask == 0] == 0).all() and (color[:, mask == 255] == 40).all()


def test_files_of_masks(tmp_path):
    levels = np.zeros((6, 8), np.uint8)
    levels[:3] = 1
    image.fromarray(levels).save(tmp_path / "ones.png")
    assert photographs.read_mask(tmp_path / "ones.png", 8, 6).tolist() == [[255] * 8] * 3 + [[0] * 8] * 3
    half = photographs.read_mask(tmp_path / "ones.png", 4, 3)
    assert half.tolist() == [[255] * 4, [128] * 4, [0] * 4]
    assert photographs.read_mask(tmp_path / "ones.png", 16, 12).tolist() == [[255] * 16] * 6 + [[0] * 16] * 6
    image.fromarray(np.zeros((6, 8), np.uint8)).save(tmp_path / "none.png")
    assert (photographs.read_mask(tmp_path / "none.png", 8, 6) == 0).all()
    wrong = r"ones.png: expected a mask of the shape of its picture, 8 x 8 px, got 8 x 6"
    with pytest.raises(io.SceneError, match=wrong):
        photographs.read_mask(tmp_path / "ones.png", 8, 8)
    (tmp_path / "broken.png").write_bytes(b"nothing")
    with pytest.raises(io.SceneError, match=r"broken.png: unreadable"):
        photographs.read_mask(tmp_path / "broken.png", 8, 8)


def test_alpha_may_be_a_mask(tmp_path):
    """Whatever the colours under transparent pixels, and on any background."""
    written = []
    for name, paint in (("black", black), ("wild", wild)):
        folder = tmp_path / name
        write_capture(folder, paint)
        for path in (folder / "masks").iterdir():
            picture = image.open(folder / "images" / path.stem)
            picture.putalpha(image.open(path))
            picture.save(folder / "images" / path.stem)
            path.unlink()
        out = tmp_path / f"{name}_out"
        assert runs.trained(folder, out, alpha="mask", iterations=30).source["alpha"] == "mask"
        written.append((out / files.SCENE).read_bytes())
        (item, *_) = training.load_capture(folder, alpha="mask").train
        loaded = training.load_pictures([item], (1,), (1.0, 1.0, 1.0), "cpu")
        mask = loaded.mask(1, 0)
        assert mask.unique().tolist() == [0.0, 1.0] and (loaded.truth(1, 0)[:, mask == 0] == 0).all()
    assert written[0] == written[1]


def test_the_command_knows_masks(tmp_path, capsys):
    write_capture(tmp_path / "scene", wild)
    said = "9 of 9 photographs have a mask, whose black pixels do not count"
    assert commands.train(tmp_path / "scene", tmp_path / "auto", "--iterations 2") == 0
    assert said in capsys.readouterr().err
    assert commands.evaluate(tmp_path / "auto") == 0
    assert said in capsys.readouterr().err
    assert commands.train(tmp_path / "scene", tmp_path / "none", "--iterations 2 --masks none") == 0
    assert said not in capsys.readouterr().err
    source = json.loads((tmp_path / "none" / "options.json").read_text())["source"]
    assert source["masks"] == "none" and source["alpha"] == "background"
