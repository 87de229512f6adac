"""Colour corrections of photographs: what they are, and what they bring where exposure varies."""

import copy
import functools
import json
import math

import commands
import numpy as np
import pytest
import runs
import torch
from capture_files import circle, draw_picture, write_nerf_synthetic
from cli_extra import image
from commands import refused
from training_step import check_next_step, falloff

from analytic_rasterizer import training
from analytic_rasterizer.training import files
from analytic_rasterizer.training.exposure import Exposures, best_exposure, corrected

OP = torch.ops.analytic_rasterizer.correct_colors


# Fewer pixels than a block has threads, and several blocks, the last of which is not full.
@pytest.mark.parametrize("vignetted", [False, True])
@pytest.mark.parametrize("size", [(1, 1), (5, 7), (91, 77)], ids=str)
def test_a_correction_and_its_gradients(device, size, vignetted):
    generator = torch.Generator().manual_seed(0)
    shown, given = (torch.rand(3, *size, generator=generator, dtype=torch.float64) for _ in range(2))
    exposure = torch.rand(3, 4, generator=generator, dtype=torch.float64)
    vignetting, center = torch.tensor([-0.4, 0.2], dtype=torch.float64), (0.4 * size[1], 0.7 * size[0])
    leaves = [shown.requires_grad_(), exposure.requires_grad_(), vignetting.requires_grad_()][: 2 + vignetted]
    dark = shown * falloff(*size, vignetting, center) if vignetted else shown
    expected = torch.einsum("ij,jhw->ihw", exposure[:, :3], dark) + exposure[:, 3, None, None]
    gradients = torch.autograd.grad(expected, leaves, given)
    for dtype, epsilon in ((torch.float64, 2.0**-52), (torch.float32, 2.0**-23)):
        moved = [t.detach().to(device, dtype).requires_grad_() for t in leaves]
        found = corrected(*moved, center=center if vignetted else ())
        of_leaves = torch.autograd.grad(found, moved, given.to(device, dtype))
        # Colours are below 4. A sum of n numbers below 1 is good to n * epsilon / 2 of at most n, in any order.
        pixels = size[0] * size[1]
        for a, b, bound in zip((expected, *gradients), (found, *of_leaves), (8, 8, *[max(8, pixels**2)] * 2)):
            assert (a - b.double().cpu()).abs().max() < bound * epsilon
    assert corrected(shown, None) is shown


def test_opcheck_of_corrections(device):
    shown, exposure = torch.rand(3, 4, 5, device=device), torch.rand(3, 4, device=device)
    torch.library.opcheck(OP.default, (shown.clone().requires_grad_(), exposure.clone().requires_grad_()))
    dark = torch.tensor([-0.1, 0.05], device=device, requires_grad=True), [2.0, 1.0]
    torch.library.opcheck(OP.default, (shown.clone().requires_grad_(), None, *dark))
    vjp = torch.ops.analytic_rasterizer.correct_colors_vjp.default
    for needs in ([True, True, False], [True, False, False], [False, True, False]):
        torch.library.opcheck(vjp, ([torch.rand_like(shown)], shown, exposure, None, [], [], needs))
    for matrix, needs in ((exposure, [True] * 3), (exposure, [False, False, True]), (None, [True, False, True])):
        given = shown, matrix, dark[0].detach(), dark[1]
        torch.library.opcheck(vjp, ([torch.rand_like(shown)], *given, [], needs))


@pytest.mark.parametrize(
    "changed, error, message",
    [
        ({"image": torch.zeros(4, 2, 2)}, ValueError, r"image must have shape \(3, H, W\), got \(4, 2, 2\)"),
        ({"image": torch.zeros(3, 0, 2)}, ValueError, "image must have at least one pixel"),
        ({"image": torch.zeros(3, 2, 2, dtype=torch.int32)}, TypeError, "image must have dtype"),
        ({"matrix": torch.zeros(4, 3)}, ValueError, r"matrix must have shape \(3, 4\), got \(4, 3\)"),
        ({"matrix": torch.zeros(3, 4, dtype=torch.float64)}, TypeError, "matrix must have the dtype of image"),
    ],
)
def test_errors_of_corrections(changed, error, message):
    with pytest.raises(error, match=message):
        OP(**({"image": torch.zeros(3, 2, 2), "matrix": torch.zeros(3, 4)} | changed))


def test_the_best_correction_is_found():
    generator = torch.Generator().manual_seed(0)
    shown = torch.rand(3, 20, 30, generator=generator)
    exposure = torch.eye(3, 4) + 0.1 * torch.randn(3, 4, generator=generator)
    target, mask = corrected(shown, exposure), torch.ones(20, 30)
    assert torch.allclose(best_exposure(shown, target), exposure, atol=1e-5)
    mask[:10] = 0
    target[:, :10] = 9.0
    assert torch.allclose(best_exposure(shown, target, mask), exposure, atol=1e-5)
    flat = torch.full((3, 4, 4), 0.5)
    assert torch.allclose(corrected(flat, best_exposure(flat, flat + 0.1)), flat + 0.1, atol=1e-5)


def test_the_mean_stays_at_the_identity():
    exposures = Exposures(4, torch.device("cpu"))
    for step in range(20):
        exposures.update({step % 4: torch.randn(3, 4, generator=torch.Generator().manual_seed(step))}, step / 20)
    assert torch.allclose(exposures.matrices.mean(0), torch.eye(3, 4), atol=1e-6)
    assert (exposures.matrices - torch.eye(3, 4)).abs().max() > 1e-3
    again = Exposures(4, torch.device("cpu"))
    again.load_state_dict(copy.deepcopy(exposures.state_dict()))
    for each in (exposures, again):
        each.update({1: torch.ones(3, 4)}, 0.5)
    assert torch.equal(exposures.matrices, again.matrices)


def test_a_measured_start():
    """Gains of stored values, whose mean is 1; photographs that are not known are left alone."""
    stops = torch.tensor([[1.0, 0.0, -1.0], [-0.5, 0.0, 0.5], [math.nan, 0.0, 0.0]], dtype=torch.float64)
    exposures = Exposures(3, torch.device("cpu"))
    exposures.start(torch.full((3, 3), math.nan))
    assert torch.equal(exposures.matrices, torch.eye(3, 4).expand(3, 3, 4))
    exposures.start(stops)
    assert torch.allclose(exposures.matrices.mean(0), torch.eye(3, 4), atol=1e-6)
    assert torch.equal(exposures.matrices[2], torch.eye(3, 4))
    grey = torch.full((3, 1, 1), 0.4)
    shown = [corrected(grey, exposure).flatten() for exposure in exposures.matrices[:2]]
    # 1.5 stops more light of red, and of blue the other way round.
    factor = 2 ** (1.5 / 2.2)
    assert torch.allclose(shown[0] / shown[1], torch.tensor([factor, 1.0, 1 / factor]))
    again = Exposures(3, torch.device("cpu"))
    again.load_state_dict(copy.deepcopy(exposures.state_dict()))
    assert torch.equal(again.matrices, exposures.matrices)


@pytest.fixture
def uneven(tmp_path):
    """NeRF-synthetic pictures of which the training's have gains of 0.7 to 1.3."""
    folder = tmp_path / "uneven"
    write_nerf_synthetic(folder, circle(12), circle(3))
    for k, view in enumerate(circle(12)):
        (path,) = folder.glob(f"train/{view.name}.png")
        rgba = draw_picture(view, opaque=False).astype(np.float64)
        rgba[..., :3] = (rgba[..., :3] * (0.7 + 0.6 * (5 * k % 12) / 11)).clip(0, 255)
        image.fromarray(rgba.round().astype(np.uint8)).save(path)
    return folder


KNOWN = {"iterations": 200, "random_points": 300, "density": "none", "background": "black"}
run_of = functools.partial(runs.trained, **KNOWN)


@pytest.mark.parametrize("options", [{}, {"scales": (1, 2), "pictures_per_step": 40, "supersampling": 2}], ids=str)
def test_a_step_has_the_gradients_of_autograd(uneven, tmp_path, options):
    """Also where a view is in a step several times."""
    run = run_of(uneven, tmp_path / "out", iterations=12, exposure="affine", **options)
    assert (run.trainer.corrections.exposures.matrices != torch.eye(3, 4)).any()
    check_next_step(run.trainer)


def test_uneven_exposure_is_learned(uneven, tmp_path):
    plain, affine = (run_of(uneven, tmp_path / name, exposure=name) for name in ("none", "affine"))
    without, with_it = plain.evaluate()["test"]["mean"], affine.evaluate()["test"]["mean"]
    assert without["psnr_color_corrected"] >= without["psnr"]
    assert with_it["psnr_color_corrected"] > without["psnr"] + 0.3 and with_it["psnr"] > without["psnr"]
    stored = json.loads((tmp_path / "affine" / files.EXPOSURES).read_text())
    gains = [np.diag(np.array(matrix)[:, :3]).mean() for matrix in stored.values()]
    given = [0.7 + 0.6 * (5 * k % 12) / 11 for k in range(12)]
    assert np.corrcoef(gains, given)[0, 1] > 0.9
    assert not (tmp_path / "none" / files.EXPOSURES).exists()


def test_a_resumed_training_has_the_same_bits(uneven, tmp_path):
    run_of(uneven, tmp_path / "whole", iterations=60, exposure="affine")
    run = runs.make_run(uneven, tmp_path / "parts", **KNOWN | {"iterations": 60, "exposure": "affine"})
    for _ in range(25):
        run.trainer.step()
    run.save()
    again = training.Run(uneven, tmp_path / "parts", resume=True)
    again.train()
    names = (files.SCENE, files.EXPOSURES)
    assert all((tmp_path / "whole" / name).read_bytes() == (tmp_path / "parts" / name).read_bytes() for name in names)


def test_the_command(uneven, tmp_path, capsys):
    out = tmp_path / "out"
    assert commands.train(uneven, out, "--iterations 3 --exposure affine") == 0
    assert "after the best affine colour of each picture: PSNR" in capsys.readouterr().out
    assert commands.evaluate(out) == 0
    assert "PSNR, best affine colour" in capsys.readouterr().out
    assert "exposure" in refused(capsys, commands.train, uneven, out, "--iterations 3 --exposure curve")
