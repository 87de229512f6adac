"""How much the bands of harmonics add."""

import math

import pytest
import reference
import scenes
import torch
from scenes import Camera

import analytic_rasterizer as ar
from analytic_rasterizer.sh import sh_band_bounds


def scene_with_bands(seed, scales, count=60):
    """A scene whose band of degree l has coefficients of the size scales[l]."""
    scene = scenes.random_scene(seed, count, degree=len(scales) - 1)
    factors = torch.cat([torch.full((2 * band + 1,), scale) for band, scale in enumerate(scales)])
    scene["shs"] = scene["shs"] * factors[:, None]
    return scene


def test_bounds_hold_for_every_direction_and_are_reached():
    """A band whose coefficients are the harmonics of one direction adds the most there."""
    shs = torch.randn(40, 16, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    directions = torch.nn.functional.normalize(torch.randn(2000, 3, dtype=torch.float64), dim=1)
    basis = reference.spherical_harmonics(3, directions)
    bounds = sh_band_bounds(shs)
    for band, bound in enumerate(bounds):
        used = slice(band**2, (band + 1) ** 2)
        added = torch.einsum("dk,pkc->dpc", basis[:, used], shs[:, used])
        assert added.abs().max() <= bound * (1 + 1e-12)
        aligned = basis[7, used] / basis[7, used].norm()
        alone = torch.zeros(1, 16, 3, dtype=torch.float64)
        alone[0, used, 1] = aligned
        assert math.isclose(sh_band_bounds(alone)[band], (basis[7, used] @ aligned).item(), rel_tol=1e-9)


@pytest.mark.parametrize(
    "scales", [(1, 1e-4, 1e-5, 1e-5), (1, 0.3, 1e-4, 1e-4), (1, 0.3, 0.3, 1e-4), (1, 0.3, 0.3, 0.3)]
)
def test_needed_degree_renders_within_the_tolerance(device, best, scales):
    scene = scenes.cast(scene_with_bands(3, scales), best)
    degree = ar.needed_sh_degree(scene["shs"])
    assert degree == [scale > 1e-4 for scale in scales].count(True) - 1
    images = {}
    for used in {degree, 3, max(0, degree - 1)}:
        camera = Camera(image_height=29, image_width=37, sh_degree=used)
        images[used] = camera.render(scenes.to(scene, device), footprint="box")[0]
    assert (images[degree] - images[3]).abs().max() <= 1 / 255
    if degree > 0:  # and one degree less shows
        assert (images[degree - 1] - images[3]).abs().max() > 1 / 255


def test_a_scene_of_one_colour_per_gaussian_needs_no_band():
    scene = scenes.random_scene(1, 20, degree=3)
    scene["shs"][:, 1:] = 0
    assert ar.needed_sh_degree(scene["shs"], tolerance=0) == 0
    assert ar.needed_sh_degree(scene["shs"][:, :1], tolerance=0) == 0
    assert ar.needed_sh_degree(scene["shs"][:0]) == 0


def test_fourth_degree():
    shs = torch.randn(20, 25, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    largest = shs[:, 16:].norm(dim=1).max().item()
    assert math.isclose(sh_band_bounds(shs)[4], largest * math.sqrt(9 / (4 * math.pi)), rel_tol=1e-12)
    assert ar.needed_sh_degree(shs) == 4
    shs[:, 16:] *= 1e-4
    assert ar.needed_sh_degree(shs) == 3


def test_bad_numbers_and_arguments():
    shs = torch.zeros(5, 16, 3)
    shs[2, 12, 0] = torch.nan
    assert ar.needed_sh_degree(shs) == 3
    shapes = r"shs must have shape \(P, M, 3\) with M = 1, 4, 9, 16 or 25, got \(5, 8, 3\)"
    for arguments, error, message in (
        ((shs[:, :8],), ValueError, shapes),
        ((shs, -1), ValueError, "tolerance must be finite and not negative, got -1"),
        ((shs, None), TypeError, "tolerance must be a number, got None"),
        (([1.0],), TypeError, "shs must be a tensor, got list"),
        ((shs.long(),), TypeError, "shs must have a floating-point dtype, got torch.int64"),
    ):
        with pytest.raises(error, match=message):
            ar.needed_sh_degree(*arguments)


def test_a_negative_degree_is_named_under_auto():
    settings = Camera(sh_degree=-1).settings(effects="auto")
    with pytest.raises(ValueError, match="sh_degree must be 0 to 4, got -1"):
        ar.GaussianRasterizer(settings)(**scenes.random_scene(1, 5))
