"""What the numbers of a test are over: every pixel counts by its mask, once, and what has no value is left out."""

import json
import math
import re

import commands
import numpy as np
import pytest
import torch
from capture_files import circle, draw_picture, truth_gaussians, write_colmap
from cli_extra import image

from analytic_rasterizer import training
from analytic_rasterizer.losses import ssim
from analytic_rasterizer.training import evaluation
from analytic_rasterizer.training.exposure import best_exposure, corrected

SIZE = (40, 36)
POINTS = torch.rand(60, 3, generator=torch.Generator().manual_seed(0)) - 0.5
BLACK, GREY, WHITE = 0.0, 0.25, 1.0


def rand(*shape, seed=0):
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def parts(*levels):
    """(12, 24) with columns of these levels."""
    return torch.tensor(levels, dtype=torch.float64).repeat_interleave(24 // len(levels)).repeat(12, 1)


MASKS = {
    "white": parts(WHITE),
    "black and white": parts(BLACK, WHITE),
    "grey everywhere": parts(GREY),
    "grey and white": parts(GREY, WHITE),
    "all levels": parts(BLACK, GREY, 0.5, WHITE),
    "soft": rand(12, 24, seed=3),
}


@pytest.mark.parametrize("name", MASKS)
def test_a_pixel_counts_by_its_mask_once(name):
    """The mean with weights, as anybody would write it."""
    mask, truth = MASKS[name], rand(3, 12, 24)
    shown = (truth + 0.2 * rand(3, 12, 24, seed=1) - 0.1).clamp(0, 1)
    weights = (mask / mask.sum()).numpy()
    error = ((shown - truth) ** 2).mean(0).numpy()
    assert evaluation.psnr(shown, truth, mask).item() == pytest.approx(-10 * math.log10((weights * error).sum()))
    black = mask == 0  # what windows see there
    similar = ssim(shown.where(~black, 0), truth.where(~black, 0), "none").mean(0).numpy()
    assert evaluation._mean_ssim(shown, truth, mask).item() == pytest.approx((weights * similar).sum())
    # Least squares with these weights, by another solver; the damping of ours is 1e-9 of the weights.
    roots = np.sqrt(weights).reshape(-1, 1)
    rows = np.concatenate([shown.flatten(1).T.numpy(), np.ones((288, 1))], 1)
    expected = np.linalg.lstsq(roots * rows, roots * truth.flatten(1).T.numpy(), rcond=None)[0].T
    found = best_exposure(shown, truth, mask)
    np.testing.assert_allclose(found.numpy(), expected, atol=1e-6)
    best = evaluation.psnr(corrected(shown.float(), found.float()), truth.float(), mask.float())
    assert best >= evaluation.psnr(shown, truth, mask)


@pytest.mark.parametrize("levels, counts", [((GREY,), 3), ((WHITE,), 3), ((BLACK,), 0)], ids=str)
def test_masks_of_one_level_change_no_number(levels, counts):
    """That of nothing leaves none, and the identity for a correction."""
    truth, shown = rand(3, 12, 24), rand(3, 12, 24, seed=1)
    mask = parts(*levels)
    numbers = [evaluation.psnr(shown, truth, mask), evaluation._mean_ssim(shown, truth, mask)]
    if counts:
        plain = [evaluation.psnr(shown, truth), evaluation._mean_ssim(shown, truth, None)]
        assert torch.allclose(torch.stack(numbers), torch.stack(plain))
        assert torch.allclose(best_exposure(shown, truth, mask), best_exposure(shown, truth), atol=1e-6)
    else:
        assert all(number.isnan() for number in numbers)
        identity = torch.eye(3, 4, dtype=torch.float64)
        assert torch.allclose(best_exposure(shown, truth, mask), identity, atol=1e-12)


def write_capture(folder, masks):
    """Nine photographs; masks by the number of the photograph, as levels of 8 bits."""
    views = circle(9, SIZE)
    (folder / "images").mkdir(parents=True)
    (folder / "masks").mkdir()
    for k, view in enumerate(views):
        image.fromarray(draw_picture(view, opaque=True)).save(folder / "images" / f"{view.name}.png")
        if k in masks:
            image.fromarray(masks[k]).save(folder / "masks" / f"{view.name}.png.png")
    write_colmap(folder / "sparse" / "0", views, POINTS, torch.full((60, 3), 128, dtype=torch.int32))


def of_level(level):
    return np.full(SIZE[::-1], level, np.uint8)


def half():
    levels = of_level(255)
    levels[:, :20] = 0
    return levels


@pytest.fixture(scope="module")
def spoiled(tmp_path_factory):
    """Nothing counts in one of the three test pictures, and half of another."""
    folder = tmp_path_factory.mktemp("spoiled") / "scene"
    write_capture(folder, {0: of_level(0), 4: half()})
    return folder


def test_pictures_without_a_value_are_left_out_of_means(spoiled):
    capture = training.load_capture(spoiled, test_every=4)
    pictures = training.load_pictures(capture.test, (1, 2), (0.0, 0.0, 0.0), "cpu")
    scene = truth_gaussians().map(torch.Tensor.detach)
    scene = scene._replace(means=scene.means + 0.02)
    black = lambda image, truth: (image - truth).square().mean()  # noqa: E731 - a distance that is 0 of black pictures
    found = evaluation.evaluate(scene, pictures, "exact", black, color_corrected=True)
    for scale in ("1", "2"):
        views = found[scale]["views"]
        assert found[scale]["measured"] == 2 and len(views) == 3
        for name in ("psnr", "ssim", "lpips", "psnr_color_corrected"):
            assert math.isnan(views[0][name]) and found[scale][name] == np.mean([view[name] for view in views[1:]])
    assert found["mean"]["psnr"] == (found["1"]["psnr"] + found["2"]["psnr"]) / 2
    only = evaluation.evaluate(scene, training.load_pictures(capture.test[:1], (1,), (0.0,) * 3, "cpu"), "exact")
    assert only["1"]["measured"] == 0 and math.isnan(only["mean"]["psnr"])


def test_commands_say_over_what_a_mean_is(spoiled, tmp_path, capsys):
    """And print both numbers, the corrected one first where exposures are corrected, with one line why."""
    common = "--test-every 4 --iterations 3 --sh-degree 0 --effects none"
    over = "2 of 3 pictures, nothing counts in the others"
    for exposure in ("none", "affine"):
        out = tmp_path / exposure
        assert commands.train(spoiled, out, common, f"--exposure {exposure}") == 0
        printed = capsys.readouterr().out.splitlines()
        plain, best = r"PSNR [\d.]+ dB, SSIM [\d.]+", r"after the best affine colour of each picture: PSNR [\d.]+ dB"
        numbers = f"{best}; as rendered: {plain}" if exposure == "affine" else f"{plain}; {best}"
        assert sum(re.fullmatch(f"test, 1/1, {over}: {numbers}", line) is not None for line in printed) == 1
        assert sum("best affine colour of each picture counts" in line for line in printed) == (exposure == "affine")
        assert sum("leaves out differences of exposure" in line for line in printed) == (exposure == "none")
        measured = json.loads((out / "metrics.json").read_text())["test"]["1"]
        assert measured["measured"] == 2 and measured["views"][0]["psnr"] is None and measured["psnr"] > 0
        assert commands.evaluate(out) == 0
        table = capsys.readouterr().out
        first, last = ("best affine colour", "PSNR  ") if exposure == "affine" else ("PSNR  ", "best affine colour")
        assert "nan" not in table and table.index(first) < table.rindex(last)
        assert f"means over {over}" in table and about(exposure) in table.splitlines()


def about(exposure):
    return evaluation.about_correction(exposure == "affine")


def test_pictures_of_errors_are_black_where_nothing_counts(spoiled, tmp_path):
    capture = training.load_capture(spoiled, test_every=4)
    pictures = training.load_pictures(capture.test, (1,), (0.0, 0.0, 0.0), "cpu")
    scene = truth_gaussians().map(torch.Tensor.detach)
    scene = scene._replace(means=scene.means + 0.1)
    drawn = evaluation.save_pictures(tmp_path, scene, pictures, "exact", 3)
    nothing, half_, all_ = (np.array(image.open(path))[:, 2 * SIZE[0] :] for path in drawn)
    assert not nothing.any() and not half_[:, :20].any() and half_[:, 20:].any() and all_[:, :20].any()
