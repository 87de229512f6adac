"""Lenses: the map is that of COLMAP, and what is resampled is the picture of the pinhole."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from analytic_rasterizer import io

pytest.importorskip("PIL.Image", reason="needs the train extra")

from analytic_rasterizer.training import lenses

EYE = torch.eye(4, dtype=torch.float64)
CAMERA = io.View("a", 96, 64, 80.0, 82.0, EYE, 47.0, 33.5)


def lens_of(model="OPENCV", **coefficients):
    return lenses.lens_of(model, coefficients, "a camera")


LENSES = {
    "barrel": lens_of("SIMPLE_RADIAL", k1=-0.2),
    "pincushion": lens_of("RADIAL", k1=0.25, k2=0.1),
    "both": lens_of("OPENCV", k1=-0.3, k2=0.4),
    "tangential": lens_of("OPENCV", k1=0.02, k2=-0.01, p1=0.02, p2=-0.03),
    "rational": lens_of("FULL_OPENCV", k1=0.4, k2=-0.1, p1=0.002, p2=0.001, k3=0.05, k4=0.3, k5=0.1, k6=-0.04),
}


def pixels(generator, height=64, width=96, alpha=False):
    rgba = torch.randint(256, (height, width, 4), dtype=torch.uint8, generator=generator)
    if not alpha:
        rgba[..., 3] = 255
    return rgba


@pytest.mark.parametrize("model", lenses.MODELS)
def test_the_map_is_that_of_pycolmap(model):
    """To 1e-6 px, with coefficients of both signs and of random sizes."""
    pycolmap = pytest.importorskip("pycolmap", reason="compares with COLMAP")
    generator = np.random.default_rng(0)
    names = lenses.MODELS[model]
    for _ in range(20):
        values = generator.uniform(-0.1, 0.1, len(names))
        focal = [3000.0] if model in ("SIMPLE_RADIAL", "RADIAL") else [3000.0, 3100.0]
        camera = pycolmap.Camera(model=model, width=4000, height=3000, params=[*focal, 2010.0, 1490.0, *values])
        points = generator.uniform(-0.6, 0.6, (200, 2))
        expected = camera.img_from_cam(np.concatenate([points, np.ones((200, 1))], 1))
        a, b = lenses.lens_of(model, dict(zip(names, values.tolist())), "").distorted(points[:, 0], points[:, 1])
        got = np.stack([focal[0] * a + 2010, focal[-1] * b + 1490], 1)
        assert np.abs(got - np.array(expected)).max() < 1e-6


def test_the_fourth_coefficient_of_nerfstudio_goes_on_the_polynomial():
    a, _ = lens_of("OPENCV", k1=0.1, k2=0.2, k3=0.3, k4=0.4).distorted(np.array(0.5), np.array(0.0))
    assert a == pytest.approx(0.5 * (1 + 0.1 / 4 + 0.2 / 16 + 0.3 / 64 + 0.4 / 256))
    a, _ = lens_of("FULL_OPENCV", k4=0.4).distorted(np.array(0.5), np.array(0.0))
    assert a == pytest.approx(0.5 / (1 + 0.4 / 4))


def test_no_coefficients_are_no_lens():
    assert lens_of("OPENCV", k1=0.0, k2=0, p1=-0.0, p2=None) is None
    for wrong in (math.nan, math.inf, "much", True, [0.1]):
        with pytest.raises(io.SceneError, match="a camera: k1 must be a finite number, got"):
            lens_of("OPENCV", k1=wrong)


def sources(lens, view, window, grown=0):
    """Where in the photograph the centres of the outermost pixels of a window are, in float64, px."""
    left, top, right, bottom = (
        window.left - grown, window.top - grown,
        window.left + window.width + grown, window.top + window.height + grown,
    )  # fmt: skip
    x, y = np.arange(left, right) + 0.5, np.arange(top, bottom) + 0.5
    border = [(x, np.full_like(x, top + 0.5)), (x, np.full_like(x, bottom - 0.5))]
    border += [(np.full_like(y, left + 0.5), y), (np.full_like(y, right - 0.5), y)]
    for u, v in border:
        a, b = lens.distorted((u - view.cx) / view.fx, (v - view.cy) / view.fy)
        yield view.fx * a + view.cx, view.fy * b + view.cy


def is_inside(view, places) -> bool:
    return all(((u >= 0) & (u <= view.width) & (v >= 0) & (v <= view.height)).all() for u, v in places)


@pytest.mark.parametrize("name", LENSES)
@pytest.mark.parametrize("size", [1, 10])
def test_the_window_is_the_largest_whose_pixels_are_in_the_photograph(name, size):
    lens = LENSES[name]
    numbers = (size * value for value in (96, 64, 80.0, 82.0, 47.0, 33.5))
    view = replace(CAMERA, **dict(zip(("width", "height", "fx", "fy", "cx", "cy"), numbers)))
    window = lenses.window_of(lens, view)
    assert is_inside(view, sources(lens, view, window))
    assert not is_inside(view, sources(lens, view, window, grown=1))
    assert 0.85 < window.kept <= 1
    assert window.left < view.cx < window.left + window.width


def test_the_window_ends_before_the_polynomial_folds_back():
    """A wild fit: near the border the picture would come back mirrored."""
    lens = lens_of("OPENCV", k1=0.3, k2=-5.9)
    view = io.View("a", 5184, 3888, 4500.0, 4500.0, EYE, 2592.0, 1944.0)
    window = lenses.window_of(lens, view)
    corner = math.hypot(window.width / 2 / view.fx, window.height / 2 / view.fy)
    radii = np.linspace(0, corner, 1000)
    assert (np.diff(radii * lens.factor(radii**2)) > 0).all()
    assert 0.25 < window.kept < 0.5
    with pytest.raises(io.SceneError, match="distortion of OPENCV folds back inside the picture: 14% of it can be"):
        lenses.window_of(lens, replace(view, fx=3000.0, fy=3000.0))


def test_a_divisor_that_vanishes_ends_the_window():
    lens = lens_of("FULL_OPENCV", k4=-2.0)  # at a radius of 0.7, where the photograph has 0.72
    window = lenses.window_of(lens, replace(CAMERA, fx=80.0, fy=80.0))
    assert is_inside(replace(CAMERA, fx=80.0, fy=80.0), sources(lens, replace(CAMERA, fx=80.0, fy=80.0), window))


def test_a_principal_point_outside_of_the_picture_is_refused():
    with pytest.raises(io.SceneError, match=r"principal point must be in the picture of 96 x 64 px .* got -3, 33\.5"):
        lenses.window_of(LENSES["barrel"], replace(CAMERA, cx=-3.0))


def test_the_middle_stays_as_it_is():
    """Its pixels are those of the photograph: nothing is scaled, or moved by a part of a pixel."""
    view = io.View("a", 301, 201, 400.0, 400.0, EYE, 150.5, 100.5)
    rgba = pixels(torch.Generator().manual_seed(0), 201, 301)
    for name in ("barrel", "pincushion"):
        window = lenses.window_of(LENSES[name], view)
        found, resampled = lenses.without_lens(rgba, view, LENSES[name])
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
        view = replace(CAMERA, width=192, height=128, fx=160.0, fy=164.0, cx=94.0, cy=67.0)
        # Directions of the photograph's pixels: the map, inverted by Newton's method with differences.
        y, x = np.mgrid[0.5:128, 0.5:192]
        a_seen, b_seen = (x - view.cx) / view.fx, (y - view.cy) / view.fy
        a, b = a_seen.copy(), b_seen.copy()
        for _ in range(50):
            u, v = lens.distorted(a, b)
            a, b = a - (u - a_seen), b - (v - b_seen)
        photograph = torch.full((128, 192, 4), 255, dtype=torch.uint8)
        known = np.isfinite(a) & np.isfinite(b)
        photograph[..., :3] = torch.from_numpy(colors(np.where(known, a, 0), np.where(known, b, 0)).round()).to(
            torch.uint8
        )
        found, resampled = lenses.without_lens(photograph.to(device), view, lens)
        y, x = np.mgrid[0.5 : found.height, 0.5 : found.width]
        expected = colors((x - found.cx) / found.fx, (y - found.cy) / found.fy)
        error = np.abs(resampled[1:-1, 1:-1, :3].cpu().numpy() - expected[1:-1, 1:-1])
        assert error.max() < 1 + 2 * 127 * (11 / 160) ** 2 / 8 * 1.6, name


def test_where_the_lens_shrinks_the_mean_over_the_area_is_taken():
    """Stripes of a pixel become grey where neighbours are two pixels apart, and stay stripes where they are one."""
    lens = lens_of("SIMPLE_RADIAL", k1=4)
    view = io.View("a", 400, 100, 400.0, 400.0, EYE, 200.0, 50.0)
    photograph = torch.full((100, 400, 4), 255, dtype=torch.uint8)
    photograph[:, ::2, :3] = 0
    found, resampled = lenses.without_lens(photograph, view, lens)
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
        _, resampled = lenses.without_lens(rgba, CAMERA, LENSES[name])
        color, alpha = resampled.split([3, 1], 2)
        assert (color.amin(2)[alpha[..., 0] > 0] == 255).all() and 0 < alpha.float().mean() < 255


def test_places_are_right_to_a_thousandth_of_a_pixel():
    """In float32, at the size of the largest photographs: ramps show where their colours come from."""
    view = io.View("a", 6000, 8, 4500.0, 4500.0, EYE, 3000.5, 4.0)
    x = torch.arange(6000, dtype=torch.float32) + 0.5
    planes = x.expand(1, 1, 8, 6000)
    lens = lens_of("OPENCV", k1=-0.08, k2=0.03, p1=1e-3, p2=-1e-3)
    columns = torch.arange(100, 5900, dtype=torch.float32) + 0.5
    rows = torch.arange(2, 6, dtype=torch.float32)[:, None] + 0.5
    u, v = lens.distorted((columns - view.cx) / view.fx, (rows - view.cy) / view.fy)
    got = lenses._averages(planes, view.fx * u + view.cx, view.fy * v + view.cy)[0]
    u, _ = lens.distorted((columns.double() - view.cx) / view.fx, (rows.double() - view.cy) / view.fy)
    assert (got - (view.fx * u + view.cx)[1:-1, 1:-1]).abs().max() < 1.5e-3


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
        lens = lens_of("SIMPLE_RADIAL", k1=k)
        view = io.View("a", 320, 240, 300.0, 300.0, EYE, 160.0, 120.0)
        found, ours = lenses.without_lens(torch.from_numpy(photograph), view, lens)
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
