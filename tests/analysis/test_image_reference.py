"""The reference of an image, how it converges, and the distance from it."""

import math

import cli_extra  # noqa: F401
import numpy as np
import pytest
import torch

import demo
from analytic_rasterizer import io
from analytic_rasterizer.analysis import reference
from analytic_rasterizer.gaussians import Gaussians

special = pytest.importorskip("scipy.special")

FOCAL, DEPTH = 40.0, 4.0


def one_gaussian(sigma, mean, opacity, color, width=24, height=20):
    """(scene, view): an isotropic splat of deviation `sigma` [px] at `mean` [px, centres at integers]."""
    x, y = ((m + 0.5 - size / 2) * DEPTH / FOCAL for m, size in zip(mean, (width, height)))
    scale = sigma * DEPTH / FOCAL
    scene = Gaussians.from_activated(
        torch.tensor([[x, y, DEPTH]]),
        torch.tensor([[scale, scale, 1e-6]]),
        torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        torch.tensor([[opacity]]),
        ((torch.tensor([[color]]) - 0.5) / math.sqrt(1 / (4 * math.pi))),
    )
    return scene, io.View("one", width, height, FOCAL, FOCAL, torch.eye(4, dtype=torch.float64))


@pytest.mark.parametrize("sigma", [0.15, 0.6, 2.5])
def test_reference_of_one_gaussian_is_its_integral(sigma):
    """Per pixel opacity * product of erf differences; in total 2 pi sigma^2 (opacity - 1/255), because
    alpha below 1/255, outside of a disc, is not drawn."""
    mean, opacity, color = (11.3, 8.85), 0.9, (0.8, 0.5, 0.25)
    scene, view = one_gaussian(sigma, mean, opacity, color)
    image = reference.supersampled(scene, view, 32)
    assert image.shape == (3, 20, 24)
    assert image.dtype == torch.float64

    def axis(size, centre):
        edges = (np.arange(size + 1) - 0.5 - centre) / (sigma * math.sqrt(2))
        return sigma * math.sqrt(math.pi / 2) * np.diff(special.erf(edges))

    weight = opacity * np.outer(axis(20, mean[1]), axis(24, mean[0]))
    for channel, value in zip(image, color):
        assert np.abs(channel.numpy() - value * weight).max() < 1.05 * value / 255
        total = 2 * math.pi * sigma**2 * (opacity - 1 / 255) * value
        assert channel.sum().item() == pytest.approx(total, rel=2e-3)


def test_reference_sees_the_background():
    scene, view = one_gaussian(1.0, (5.0, 5.0), 0.5, (1.0, 0.0, 0.0))
    image = reference.supersampled(scene, view, 2, background=(0.25, 0.5, 1.0))
    assert image[:, -1, -1].tolist() == [0.25, 0.5, 1.0]


@pytest.mark.parametrize("centre", [(None, None), (7.25, 12.0)])
@pytest.mark.parametrize("density, pieces", [(8, 4), (6, 9), (6, 4)])
def test_reference_from_shifted_renders_is_that_of_one_large_render(monkeypatch, centre, density, pieces):
    scene, _ = demo.make_target()
    view = io.View("part", 96, 64, 115.0, 115.0, torch.eye(4, dtype=torch.float64), *centre)
    whole = reference.supersampled(scene, view, density)
    sizes = []
    rasterizer = reference.GaussianRasterizer
    monkeypatch.setattr(
        reference, "GaussianRasterizer", lambda s: sizes.append((s.image_width, s.image_height)) or rasterizer(s)
    )
    monkeypatch.setattr(reference, "MAX_PIXELS", (density**2 // pieces) * 96 * 64)
    parts = reference.supersampled(scene, view, density)
    fine = density // math.isqrt(pieces)
    assert sizes == [(96 * fine, 64 * fine)] * pieces
    # The same samples; a coordinate that rounds differently can cross the 1/255 cut of a splat.
    assert (whole - parts).abs().max() < 2 / 255
    assert (whole - parts).abs().mean() < 1e-5


def test_filtered_samples_are_rendered_in_one_piece(monkeypatch):
    """A footprint with a filter is as wide as a pixel of the picture it is in: shifted pictures would overlap."""
    scene, view = one_gaussian(0.6, (11.3, 8.85), 0.9, (0.8, 0.5, 0.25))
    whole = reference.supersampled(scene, view, 4, "box:samples=16")
    monkeypatch.setattr(reference, "MAX_PIXELS", view.width * view.height)
    assert torch.equal(reference.supersampled(scene, view, 4, "box:samples=16"), whole)
    assert (reference.supersampled(scene, view, 16) - whole).abs().max() < 2 / 255


def test_denser_samples_approach_the_integral():
    scene, view = one_gaussian(0.3, (11.3, 8.85), 0.9, (1.0, 1.0, 1.0))
    total = 2 * math.pi * 0.09 * (0.9 - 1 / 255)
    errors = [abs(reference.supersampled(scene, view, n)[0].sum().item() - total) for n in (1, 4, 16)]
    assert errors[0] > 10 * errors[1]
    assert errors[1] > errors[2]


def halving(error_at_one=1.0):
    """Pictures whose error is `error_at_one`/density, and the densities asked for."""
    asked = []

    def sample(density):
        asked.append(density)
        return {"a": torch.full((3, 2, 2), error_at_one / density, dtype=torch.float64)}

    return sample, asked


def test_refinement_stops_when_the_change_is_a_tenth_of_the_smallest_error():
    sample, asked = halving()
    refined = reference.refine(sample, lambda truth: {"a": 0.7}, start=2, limit=1024)
    # From n/2 to n the picture changes by 1/n: 1/8 is too much, 1/16 is not.
    assert asked == [2, 4, 8, 16]
    assert refined.residuals[16] == {"a": pytest.approx(1 / 16)}
    assert list(refined.residuals) == [4, 8, 16]
    assert refined.density == 16
    assert refined.pictures["a"][0, 0, 0].item() == 1 / 16
    assert refined.half["a"][0, 0, 0].item() == 1 / 8


def test_refinement_that_does_not_settle_stops_at_its_limit():
    sample, asked = halving()
    refined = reference.refine(sample, lambda truth: {"a": 1e-9}, start=2, limit=9)
    assert asked == [2, 4, 8]
    assert refined.density == 8


def test_errors_of_a_picture():
    truth = torch.zeros(3, 20, 50, dtype=torch.float64)
    color = torch.full((3, 20, 50), 0.01)
    color[0, 0, 0] = -0.5
    color[1, 3, :2] = 0.2
    errors = reference.image_errors(color, truth)
    square = (0.25 + 2 * 0.04 + 2997 * 1e-4) / 3000
    assert errors["rmse"] == pytest.approx(math.sqrt(square), rel=1e-6)
    assert errors["psnr"] == pytest.approx(10 * math.log10(1 / square), rel=1e-6)
    assert errors["bias"] == pytest.approx((-0.5 + 0.4 + 29.97) / 3000, rel=1e-6)
    assert errors["max"] == 0.5
    assert errors["p999"] == pytest.approx(0.01)  # 3 of 3000 exceed it
    color[2, 5, 0] = 0.3
    assert reference.image_errors(color, truth)["p999"] == pytest.approx(0.2)
    assert reference.image_errors(truth, truth)["psnr"] == 300


def test_point_samples_and_a_filtered_footprint_have_one_limit():
    """`box` with 16 samples shrinks to a point as the density grows, by another route."""
    scene, view = demo.make_target()
    view = io.View("part", 48, 32, 57.5, 57.5, view.w2c)
    point = reference.supersampled(scene, view, 32)
    box = reference.supersampled(scene, view, 8, "box:samples=16")
    coarse = reference.supersampled(scene, view, 4)
    assert reference.image_errors(box, point)["rmse"] < 0.1 * reference.image_errors(coarse, point)["rmse"]
