"""Limits of lenses by a search in Python: the reference of csrc/core/camera/limits.h."""

import math
from functools import lru_cache

import torch

from analytic_rasterizer import _C
from analytic_rasterizer.cameras.lens import WIDE

DIRECTIONS, ANGLES = 64, 512


def rays_of(angles):
    """Unit vectors (angles, directions, 3) from the axis, and their derivatives along the angle and across."""
    turns = torch.arange(DIRECTIONS, dtype=torch.float64) * (2 * math.pi / DIRECTIONS)
    angle, turn = torch.meshgrid(angles, turns, indexing="ij")
    sine, cosine, x, y, zero = angle.sin(), angle.cos(), turn.cos(), turn.sin(), torch.zeros_like(angle)
    return (
        torch.stack([sine * x, sine * y, cosine], -1),
        torch.stack([cosine * x, cosine * y, -sine], -1),
        torch.stack([-y, x, zero], -1),
    )


@lru_cache
def fold_of(model, coefficients):
    first, last = 0.0, math.pi - 1e-3 if model in WIDE else math.radians(89.5)
    for _ in range(2):  # the second time between two neighbours of the first
        angles = torch.linspace(first, last, ANGLES + 1, dtype=torch.float64)
        ray, along, across = rays_of(angles)
        slopes = _C.lens_points(model, list(coefficients), ray.reshape(-1, 3))[1].reshape(*ray.shape[:2], 2, 3)
        u, v = (slopes * along[..., None, :]).sum(-1), (slopes * across[..., None, :]).sum(-1)
        area = u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]
        outwards = u[..., 0] * across[..., 1] - u[..., 1] * across[..., 0]
        good = ((area > 0) & area.isfinite() & (outwards > 0)).all(1).tolist()
        if all(good):
            return last
        k = good.index(False)
        first, last = float(angles[max(k - 1, 0)]), float(angles[k])
    return first


def reach_of(model, coefficients, tan_x, tan_y, x, y):
    fold = fold_of(model, coefficients)
    angles = torch.linspace(0, fold, ANGLES + 1, dtype=torch.float64)
    ray = rays_of(angles)[0]
    seen = _C.lens_points(model, list(coefficients), ray.reshape(-1, 3))[0].reshape(*ray.shape[:2], 2)
    inside = (seen.norm(dim=2) <= math.hypot(abs(x) + tan_x, abs(y) + tan_y)).any(1).nonzero()
    largest = float(angles[min(int(inside[-1]) + 1, ANGLES)]) if len(inside) else fold
    clamp = _C.FRUSTUM_CLAMP
    return min(fold, clamp * largest if model in WIDE else math.atan(clamp * math.tan(largest)))


def textbook(lens, points):
    """The formulas of OpenCV and COLMAP (https://colmap.github.io/cameras.html), for (N, 3) points."""
    x, y, z = points.unbind(1)
    k = lens.coefficients
    if lens.model == "equirectangular":
        return torch.stack([torch.atan2(x, z), torch.asin(y / points.norm(dim=1))], 1)
    if lens.model in ("perspective", "fov"):
        a, b = x / z, y / z
    else:
        rho = torch.hypot(x, y)
        theta = torch.atan2(rho, z)
        a, b = theta * x / rho, theta * y / rho
    r2 = a * a + b * b
    if lens.model == "fov":
        r = r2.sqrt()
        scale = torch.atan(2 * r * math.tan(k[0] / 2)) / (k[0] * r)
        return torch.stack([scale * a, scale * b], 1)
    if lens.model == "rad_tan_fisheye":
        scale = 1 + sum(c * r2 ** (i + 1) for i, c in enumerate(k[:6]))
        u, v = scale * a, scale * b
        r2 = u * u + v * v
        p0, p1, s0, s1, s2, s3 = k[6:]
        return torch.stack(
            [
                u + 2 * (u * p0 + v * p1) * u + r2 * p0 + s0 * r2 + s1 * r2**2,
                v + 2 * (u * p0 + v * p1) * v + r2 * p1 + s2 * r2 + s3 * r2**2,
            ],
            1,
        )
    if lens.model == "perspective":
        scale = (1 + k[0] * r2 + k[1] * r2**2 + k[2] * r2**3) / (1 + k[3] * r2 + k[4] * r2**2 + k[5] * r2**3)
    else:
        scale = 1 + k[0] * r2 + k[1] * r2**2 + k[2] * r2**3 + k[3] * r2**4
    p1, p2, s1, s2, s3, s4 = k[6:]
    return torch.stack(
        [
            a * scale + 2 * p1 * a * b + p2 * (r2 + 2 * a * a) + s1 * r2 + s2 * r2**2,
            b * scale + p1 * (r2 + 2 * b * b) + 2 * p2 * a * b + s3 * r2 + s4 * r2**2,
        ],
        1,
    )
