"""Lenses in hard cases: random lenses of every model against formulas in all pixels, odd numbers, and every op."""

import math

import pytest
import reference
import scenes
import torch
from test_lens import LENSES, SIGNS, SPHERE, each_lens, settings_of

import analytic_rasterizer as ar
from analytic_rasterizer import _C

BENT = tuple(LENSES)  # models with coefficients
WIDE = ("fisheye", "rad_tan_fisheye")


def uniform(generator, *shape, low=0.0, high=1.0):
    return low + (high - low) * torch.rand(*shape, dtype=torch.float64, generator=generator)


def random_lens(model, seed, size=0.1):
    """Coefficients of both signs, up to `size`; of a fov lens anything that it may have."""
    generator = torch.Generator().manual_seed(seed)
    numbers = uniform(generator, 12, low=-size, high=size)
    if model == "fov":
        return ar.Lens.fov(0.05 + 2.8 * torch.rand((), generator=generator).item())
    parts = (numbers[:6] if model != "fisheye" else numbers[:4], numbers[6:8] / 5, numbers[8:] / 5)
    return getattr(ar.Lens, model)(*(part.tolist() for part in parts))


def at_reach(lens, points):
    """Points as they are, or if farther from the axis than `reach` at this angle: where Jacobians are taken."""
    x, y, z = points.unbind(1)
    rho, size = torch.hypot(x, y), points.norm(dim=1)
    if lens.model in WIDE:
        far, across, ahead = torch.atan2(rho, z) > lens.reach, size * math.sin(lens.reach), size * math.cos(lens.reach)
    else:
        far, across, ahead = rho > math.tan(lens.reach) * z, math.tan(lens.reach) * z, z
    turned = torch.stack([across * x / rho, across * y / rho, ahead], 1)
    return torch.where(far[:, None], turned, points)


def in_all_pixels(scene, settings, width, height):
    """Alpha (H, W) of `point` with a dilation of 0.3, every Gaussian that the lens sees in every pixel."""
    lens = settings.effects.lens
    view = torch.cat([scene["means3D"], torch.ones(len(scene["means3D"]), 1)], 1) @ settings.viewmatrix
    points = view[:, :3]
    seen, _ = lens.project(points)
    shown = (lens.depths(points) > settings.effects.near) & ~seen[:, 0].isnan()
    points, seen = points[shown], seen[shown]
    focal = torch.tensor([width / (2 * settings.tanfovx), height / (2 * settings.tanfovy)], dtype=torch.float64)
    slopes = _C.lens_points(lens.model, list(lens.numbers()), at_reach(lens, points))[1]
    to_pixel = focal[:, None] * slopes @ settings.viewmatrix[:3, :3].T
    spread = reference.covariance_3d(scene["scales"][shown], scene["rotations"][shown], 1.0)
    cov = to_pixel @ spread @ to_pixel.mT
    cov2d = torch.stack([cov[:, 0, 0], cov[:, 0, 1], cov[:, 1, 1]], 1)
    center = torch.tensor([25.0, 19.0], dtype=torch.float64)
    means, opacities = focal * seen + center - 0.5, scene["opacities"][shown, 0]
    y, x = torch.meshgrid(torch.arange(height).double(), torch.arange(width).double(), indexing="ij")
    light = torch.ones(height, width, dtype=torch.float64)
    for i in lens.depths(points).argsort(stable=True).tolist():
        offset = torch.stack([x - means[i, 0], y - means[i, 1]], -1)
        alpha = (opacities[i] * reference.weight(offset, cov2d[i], "point")).clamp(max=0.99)
        alpha = torch.where((alpha >= 1 / 255) & (light * (1 - alpha) >= 1e-4), alpha, 0.0)
        light = light * (1 - alpha)
    return 1 - light


def towards(generator, count, lens, scene):
    """The scene in all directions that the lens sees and some beyond, half of it about the edge of the picture."""
    angle = uniform(generator, count) * min(1.2 * lens.fold, math.pi)
    angle[: count // 2] = lens.reach / 1.3 * uniform(generator, count // 2, low=0.85, high=1.35)
    turn = 2 * math.pi * uniform(generator, count)
    rays = torch.stack([angle.sin() * turn.cos(), angle.sin() * turn.sin(), angle.cos()], 1)
    return scene | {"means3D": rays * torch.exp(uniform(generator, count, 1, low=math.log(0.15), high=math.log(20)))}


@pytest.mark.parametrize("model", BENT)
@pytest.mark.parametrize("seed", range(6))
def test_no_pixel_of_a_lens_is_missed(model, seed):
    """Random lenses, tiny and huge splats near the border of the field of view and beyond, against all splats in all
    pixels. Opacities are low: most pixels are not full."""
    lens = random_lens(model, seed, size=(0.02, 0.1, 0.3)[seed % 3])
    focal = (10.0, 40.0)[seed % 2]
    w2c = ar.moved(torch.eye(4, dtype=torch.float64), torch.tensor([0.1, -0.2, 0.15, 0.4, -0.7, 0.2]).double())
    settings = settings_of(lens, w2c=w2c, fx=focal, fy=1.1 * focal)._replace(footprint="point")
    generator = torch.Generator().manual_seed(seed)
    scene = scenes.random_scene(seed, 150, degree=1, opacity=(0.01, 0.2), sigma=(1e-3, 5.0))
    scene = towards(generator, 150, settings.effects.lens, scene)
    scene["means3D"] = (scene["means3D"] - w2c[:3, 3]) @ w2c[:3, :3]
    settings = settings._replace(effects=ar.Effects(lens=settings.effects.lens, alpha=True))
    _, _, outputs = ar.GaussianRasterizer(settings)(**scene)
    expected = in_all_pixels(scene, settings, 48, 36)
    assert (expected > 0.1).double().mean() > 0.05
    torch.testing.assert_close(outputs.alpha[0], expected, rtol=0, atol=1e-9)
