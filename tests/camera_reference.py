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
