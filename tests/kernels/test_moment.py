"""`moment`: what holds for it beyond what every footprint has to satisfy."""

import dataclasses

import pytest
import reference
import scenes
import torch
from marks import each_precision
from scenes import Camera

import analytic_rasterizer as ar

CELLS = (1, 4, 16)


def image_of(camera, scene, device="cpu", **footprint):
    inputs = scenes.cast(scene, torch.float32 if device == "cuda" else torch.float64, device)
    return camera.render(inputs, **footprint)[0].double().cpu()


def integral_of(camera, scene, density):
    """The mean of density x density unfiltered samples in every pixel: an image that is so much larger, averaged."""
    width, height = camera.image_width, camera.image_height
    fine = dataclasses.replace(camera, image_width=width * density, image_height=height * density)
    samples = image_of(fine, scene, footprint="point:dilation=0")
    return samples.reshape(3, height, density, width, density).mean((2, 4))


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_nearer_to_the_integral_than_standing_nodes(device, seed):
    """Opaque layers finer than a pixel, where light is left in one side of a cell.

    RMSE relative to that of `box` with as many samples, over six seeds: 0.38 to 0.42 with one, 0.13 to 0.16 with four,
    0.24 to 0.30 with sixteen.
    """
    camera = Camera(image_width=33, image_height=31, bg=(0.2, 0.5, 0.9))
    scene = scenes.random_scene(seed, count=600, opacity=(0.5, 0.98), sigma=(0.03, 0.12), spread=1.6)
    truth = integral_of(camera, scene, 32)

    def error(**footprint):
        return (image_of(camera, scene, device, **footprint) - truth).square().mean().sqrt()

    moving = {n: error(footprint="moment", samples=n) for n in CELLS}
    still = {n: error(footprint="box", samples=n) for n in CELLS}
    for n, ratio in {1: 0.5, 4: 0.2, 16: 0.4}.items():
        assert moving[n] < ratio * still[n], (n, moving, still)
    assert moving[1] > moving[4] > moving[16]


@pytest.mark.parametrize("samples", CELLS)
def test_one_splat_is_its_weight(device, best, samples):
    """Nothing is in front of a single splat: its picture is opacity times the weight at rest."""
    camera = Camera(image_width=20, image_height=18).facing_z()
    cov2d = torch.tensor([[3.0, 1.0, 2.0]], dtype=torch.float64)
    mean = torch.tensor([[9.3, 8.1]], dtype=torch.float64)
    scene = scenes.cast(scenes.splat_scene(camera, mean, cov2d, [0.8], [2.0]), best, device) | {"means2D": None}
    color = camera.render(scene, footprint="moment", samples=samples)[0].double().cpu()
    y, x = torch.meshgrid(torch.arange(18.0), torch.arange(20.0), indexing="ij")
    offset = torch.stack([x, y], -1).double() - mean[0]
    alphas = 0.8 * reference.sample_weights(offset, cov2d[0], "moment", samples=samples)
    expected = torch.where(alphas >= reference.ALPHA_MIN, alphas, 0).mean(0)
    clear = ((alphas / reference.ALPHA_MIN - 1).abs() > 1e-3).all(0)
    assert clear.double().mean() > 0.95
    assert (color - expected).abs()[:, clear].max() < (1e-12 if best == torch.float64 else 1e-5)


@each_precision
@pytest.mark.parametrize("samples", [1, 16])
def test_long_lists(device, dtype, samples):
    """The backward pass composites a list again, in parts where it is long: the parts change nothing.

    A picture of one tile, and the corner of it as a picture of its own, whose list has as many pairs but changes so
    much less that it is done in one part. Every sample composites more than a thousand splats.
    """
    camera = Camera(image_width=16, image_height=16, bg=(0.3, 0.6, 0.1)).facing_z()
    g, count = torch.Generator().manual_seed(5), 1500
    means = scenes.rand(g, count, 2, low=-4, high=20)
    cov2d = scenes.random_cov2d(g, count, (20.0, 30.0), (1.0, 2.0))
    opacities, depths = scenes.rand(g, count, low=0.0055, high=0.007), scenes.rand(g, count, low=1.0, high=3.0)
    colors = scenes.rand(g, count, 3)
    scene = scenes.splat_scene(camera, means, cov2d, opacities, depths, colors)
    scene = scenes.without(scenes.cast(scene, dtype, device), "means2D")
    splats = ar.project(camera.settings(dtype, device, footprint="moment", samples=samples), **scene)
    results = []
    for size in (16, 3):
        part = dataclasses.replace(splats, width=size, height=size)
        rows = {"means2d": part.means2d, "cov2d": part.cov2d, "opacities": part.opacities}
        rows = {name: value.detach().clone().requires_grad_() for name, value in rows.items()}
        part = dataclasses.replace(part, **rows)
        lists = ar.list_tiles(part)
        assert lists.of_camera()["tile_offsets"].diff().max() > 1024
        image, alpha = ar.blend(part, lists, background=torch.tensor(camera.bg, dtype=dtype, device=device))
        weights = torch.arange(1.0, 28.0, dtype=dtype, device=device).reshape(3, 3, 3).sin()
        loss = (image[0, :, :3, :3] * weights).sum()
        results.append((image[0, :, :3, :3], *torch.autograd.grad(loss, list(rows.values()))))
        assert (alpha < 1 - 1e-4).all() and (alpha > 0.99).all()
    for whole, corner in zip(*results, strict=True):
        # The same numbers for the same pixels, and zeros for the others; sums over a pack or a warp may be in another
        # order, of at most 9 terms.
        scale = corner.abs().max()
        assert scale > 0
        assert (whole - corner).abs().max() <= 16 * torch.finfo(dtype).eps * scale


def test_samples_are_named_in_errors():
    for wrong in (2, 9, 25, "four"):
        with pytest.raises(ValueError, match=rf"samples must be one of 1, 4, 16, got '?{wrong}"):
            ar.resolve_footprint("moment", samples=wrong)
    assert ar.resolve_footprint("moment").samples == 4
    assert ar.resolve_footprint("moment:samples=16").samples == 16
