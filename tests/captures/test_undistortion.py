"""Photographs of cameras with a lens, resampled to those of pinholes."""

import math
from dataclasses import replace

import cli_extra  # noqa: F401
import numpy as np
import pytest
import torch

import analytic_rasterizer as ar
from analytic_rasterizer import io
from analytic_rasterizer.captures import undistortion

EYE = torch.eye(4, dtype=torch.float64)
CAMERA = io.View("a", 96, 64, 80.0, 82.0, EYE, 47.0, 33.5)


LENSES = {
    "barrel": ar.Lens.perspective((-0.2,)),
    "pincushion": ar.Lens.perspective((0.25, 0.1)),
    "both": ar.Lens.perspective((-0.3, 0.4)),
    "tangential": ar.Lens.perspective((0.02, -0.01), (0.02, -0.03)),
    "rational": ar.Lens.perspective((0.4, -0.1, 0.05, 0.3, 0.1, -0.04), (0.002, 0.001)),
    "fisheye": ar.Lens.fisheye((0.05, -0.01)),
}


def distorted(lens, a, b):
    a, b = np.broadcast_arrays(a, b)
    shown = lens.project(torch.from_numpy(np.stack([a, b, np.ones_like(a)], -1).reshape(-1, 3)))[0].numpy()
    return shown[:, 0].reshape(a.shape), shown[:, 1].reshape(a.shape)


def pixels(generator, height=64, width=96, alpha=False):
    rgba = torch.randint(256, (height, width, 4), dtype=torch.uint8, generator=generator)
    if not alpha:
        rgba[..., 3] = 255
    return rgba


def sources(view, window, grown=0):
    """Where in the photograph the centres of the outermost pixels of a window are, in float64, px."""
    left, top, right, bottom = (
        window.left - grown, window.top - grown,
        window.left + window.width + grown, window.top + window.height + grown,
    )  # fmt: skip
    x, y = np.arange(left, right) + 0.5, np.arange(top, bottom) + 0.5
    border = [(x, np.full_like(x, top + 0.5)), (x, np.full_like(x, bottom - 0.5))]
    border += [(np.full_like(y, left + 0.5), y), (np.full_like(y, right - 0.5), y)]
    for u, v in border:
        a, b = distorted(view.lens, (u - view.cx) / view.fx, (v - view.cy) / view.fy)
        yield view.fx * a + view.cx, view.fy * b + view.cy


def is_inside(view, places) -> bool:
    return all(((u >= 0) & (u <= view.width) & (v >= 0) & (v <= view.height)).all() for u, v in places)


@pytest.mark.parametrize("name", LENSES)
@pytest.mark.parametrize("size", [1, 10])
def test_the_window_is_the_largest_whose_pixels_are_in_the_photograph(name, size):
    numbers = (size * value for value in (96, 64, 80.0, 82.0, 47.0, 33.5))
    view = replace(CAMERA, **dict(zip(("width", "height", "fx", "fy", "cx", "cy"), numbers)), lens=LENSES[name])
    window = undistortion.window_of(view)
    assert is_inside(view, sources(view, window))
    # Whole pixels lose less than one, and their centres are half a pixel inside.
    assert not is_inside(view, sources(view, window, grown=2))
    assert 0.85 < window.kept <= 1
    assert window.left < view.cx < window.left + window.width


def test_the_window_ends_before_the_polynomial_folds_back():
    """A wild fit: near the border the picture would come back mirrored."""
    lens = ar.Lens.perspective((0.3, -5.9))
    view = io.View("a", 5184, 3888, 4500.0, 4500.0, EYE, 2592.0, 1944.0, lens=lens)
    window = undistortion.window_of(view)
    corner = math.hypot(window.width / 2 / view.fx, window.height / 2 / view.fy)
    radii = np.linspace(0, corner, 1000)
    assert (np.diff(distorted(lens, radii, 0 * radii)[0]) > 0).all()
    assert 0.25 < window.kept < 0.5
    with pytest.raises(io.SceneError, match="perspective lens is too wide: 14% of the picture can be undistorted"):
        undistortion.window_of(replace(view, fx=3000.0, fy=3000.0))


def test_a_divisor_that_vanishes_ends_the_window():
    lens = ar.Lens.perspective((0, 0, 0, -2.0))  # at a radius of 0.7, where the photograph has 0.72
    view = replace(CAMERA, fx=80.0, fy=80.0, lens=lens)
    assert is_inside(view, sources(view, undistortion.window_of(view)))


def test_a_principal_point_outside_of_the_picture_is_refused():
    with pytest.raises(io.SceneError, match=r"principal point must be in the picture of 96 x 64 px .* got -3, 33\.5"):
        undistortion.window_of(replace(CAMERA, cx=-3.0, lens=LENSES["barrel"]))


def test_the_middle_stays_as_it_is():
    """Its pixels are those of the photograph: nothing is scaled, or moved by a part of a pixel."""
    rgba = pixels(torch.Generator().manual_seed(0), 201, 301)
    for name in ("barrel", "pincushion"):
        view = io.View("a", 301, 201, 400.0, 400.0, EYE, 150.5, 100.5, lens=LENSES[name])
        window = undistortion.window_of(view)
        found, resampled = undistortion.without_lens(rgba, view)
        assert found.lens is None
        assert (found.fx, found.fy) == (400.0, 400.0) and resampled.shape == (found.height, found.width, 4)
        middle = resampled[95 - window.top : 106 - window.top, 145 - window.left : 156 - window.left]
        assert (middle.int() - rgba[95:106, 145:156].int()).abs().max() <= 2
        assert (found.cx, found.cy) == (150.5 - window.left, 100.5 - window.top)


def test_smooth_pictures_are_those_of_the_pinhole(device):
    """A picture that is a function of the direction, taken through the lens and without it; by bilinear interpolation
    of a function with curvature c it may be c / 8 off in each direction, and by two roundings."""

    def colors(a, b):
        waves = (np.sin(9 * a + 2 * b), np.cos(5 * a - 7 * b), np.sin(11 * b))
        return np.stack([127.5 + 127 * wave for wave in waves], -1)

    for name, lens in LENSES.items():
        view = replace(CAMERA, width=192, height=128, fx=160.0, fy=164.0, cx=94.0, cy=67.0, lens=lens)
        y, x = np.mgrid[0.5:128, 0.5:192]
        rays = view.rays_of(torch.from_numpy(np.stack([x, y], -1).reshape(-1, 2))).numpy().reshape(128, 192, 3)
        a, b = rays[..., 0] / rays[..., 2], rays[..., 1] / rays[..., 2]
        photograph = torch.full((128, 192, 4), 255, dtype=torch.uint8)
        known = np.isfinite(a) & np.isfinite(b)
        photograph[..., :3] = torch.from_numpy(colors(np.where(known, a, 0), np.where(known, b, 0)).round()).to(
            torch.uint8
        )
        found, resampled = undistortion.without_lens(photograph.to(device), view)
        y, x = np.mgrid[0.5 : found.height, 0.5 : found.width]
        expected = colors((x - found.cx) / found.fx, (y - found.cy) / found.fy)
        error = np.abs(resampled[1:-1, 1:-1, :3].cpu().numpy() - expected[1:-1, 1:-1])
        assert error.max() < 1 + 2 * 127 * (11 / 160) ** 2 / 8 * 1.6, name


def test_where_the_lens_shrinks_the_mean_over_the_area_is_taken():
    """Stripes of a pixel become grey where neighbours are two pixels apart, and stay stripes where they are one."""
    view = io.View("a", 400, 100, 400.0, 400.0, EYE, 200.0, 50.0, lens=ar.Lens.perspective((4,)))
    photograph = torch.full((100, 400, 4), 255, dtype=torch.uint8)
    photograph[:, ::2, :3] = 0
    found, resampled = undistortion.without_lens(photograph, view)
    row = resampled[int(found.cy), :, 0].float()
    radius = ((torch.arange(found.width) + 0.5 - found.cx) / found.fx).abs()
    spacing = 1 + 3 * 4 * radius**2
    assert (row[spacing > 1.9] - 127.5).abs().max() < 30 and (spacing > 1.9).sum() > 20
    assert (row[spacing < 1.002] - 127.5).abs().min() > 100


def test_colors_count_by_their_alpha():
    """White on transparent black stays white, whatever is averaged."""
    rgba = pixels(torch.Generator().manual_seed(0), alpha=True)
    rgba[..., 3] = torch.where(rgba[..., 3] < 128, 0, rgba[..., 3])
    rgba[..., :3] = torch.where(rgba[..., 3:] > 0, 255, 0)
    for name in ("barrel", "pincushion"):
        _, resampled = undistortion.without_lens(rgba, replace(CAMERA, lens=LENSES[name]))
        color, alpha = resampled.split([3, 1], 2)
        assert (color.amin(2)[alpha[..., 0] > 0] == 255).all() and 0 < alpha.float().mean() < 255


def test_places_are_right_to_a_thousandth_of_a_pixel():
    """Also at the size of the largest photographs: ramps show where their colours come from."""
    lens = ar.Lens.perspective((-0.08, 0.03), (1e-3, -1e-3))
    view = io.View("a", 6000, 8, 4500.0, 4500.0, EYE, 3000.5, 4.0, lens=lens)
    planes = (torch.arange(6000, dtype=torch.float32) + 0.5).expand(1, 1, 8, 6000)
    columns, rows = torch.arange(100, 5900).double() + 0.5, torch.arange(2, 6).double()[:, None] + 0.5
    u, v = distorted(lens, ((columns - view.cx) / view.fx).numpy(), ((rows - view.cy) / view.fy).numpy())
    u, v = (torch.from_numpy(of) for of in (view.fx * u + view.cx, view.fy * v + view.cy))
    got = undistortion._averages(planes, u.float(), v.float())[0]
    assert (got - u[1:-1, 1:-1]).abs().max() < 1.5e-3


def test_pictures_are_those_of_pycolmap():
    """In the same directions, the picture that its own program writes differs by interpolation alone."""
    pycolmap = pytest.importorskip("pycolmap", reason="compares with COLMAP")
    y, x = np.mgrid[0:240, 0:320]
    waves = [127.5 + 127 * np.sin(x / p + y / q) for p, q in ((9, 11), (-13, 8), (17, -15))]
    photograph = np.stack([*waves, np.full_like(waves[0], 255)], -1).round().astype(np.uint8)
    for k in (-0.15, 0.15):
        camera = pycolmap.Camera(model="SIMPLE_RADIAL", width=320, height=240, params=[300.0, 160.0, 120.0, k])
        bitmap = pycolmap.Bitmap.from_array(np.ascontiguousarray(photograph[..., :3]))
        result, pinhole = pycolmap.undistort_image(pycolmap.UndistortCameraOptions(), bitmap, camera)
        theirs = result.to_array()
        view = io.View("a", 320, 240, 300.0, 300.0, EYE, 160.0, 120.0, lens=ar.Lens.perspective((k,)))
        found, ours = undistortion.without_lens(torch.from_numpy(photograph), view)
        assert pinhole.focal_length_x == 300.0
        # Ours where their pixels are: principal points differ by parts of a pixel.
        y, x = np.mgrid[0.5 : pinhole.height, 0.5 : pinhole.width]
        x, y = x - pinhole.principal_point_x + found.cx, y - pinhole.principal_point_y + found.cy
        places = torch.from_numpy(np.stack([2 * x / found.width - 1, 2 * y / found.height - 1], -1))[None]
        planes = ours[..., :3].permute(2, 0, 1)[None].double()
        there = torch.nn.functional.grid_sample(planes, places, align_corners=False)[0].permute(1, 2, 0).numpy()
        inside = (x > 1) & (x < found.width - 1) & (y > 1) & (y < found.height - 1)
        assert inside.mean() > 0.9
        assert np.abs(there - theirs)[inside].mean() < 0.6 and np.abs(there - theirs)[inside].max() < 4
