"""The Gaussians that are trained: how they start, are rendered and optimized."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import normalize

import analytic_rasterizer as ar

HALF_EDGE = 1.3  # of the cube of random points; NeRF-synthetic objects fit in it
SH_C0 = 0.28209479177387814  # value of the constant spherical harmonic
FIRST_OPACITY = 0.1
MEANS_RATE, FINAL_MEANS_RATE = 1.6e-4, 1.6e-6  # learning rates per unit of the scene's extent
RATES = {"log_scales": 5e-3, "rotations": 1e-3, "logit_opacities": 0.05, "sh_dc": 2.5e-3, "sh_rest": 1.25e-4}


class Gaussians(NamedTuple):
    """What is trained: unconstrained float32 parameters, one row each."""

    means: Tensor  # (P, 3) world units
    log_scales: Tensor  # (P, 3) logarithms of standard deviations in world units
    rotations: Tensor  # (P, 4) quaternions (w, x, y, z) of any length
    logit_opacities: Tensor  # (P, 1)
    sh_dc: Tensor  # (P, 1, 3) spherical harmonics, the constant
    sh_rest: Tensor  # (P, K - 1, 3) and the others

    def render(
        self, settings: ar.GaussianRasterizationSettings, means2D: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """The picture (3, height, width) and the radii (P,) in px, 0 for what is not seen."""
        return ar.GaussianRasterizer(settings)(
            means3D=self.means,
            means2D=means2D,
            opacities=self.logit_opacities.sigmoid(),
            shs=torch.cat([self.sh_dc, self.sh_rest], dim=1),
            scales=self.log_scales.exp(),
            rotations=self.rotations,
        )


def random_points(count: int, seed: int) -> tuple[Tensor, Tensor]:
    """Positions (count, 3) in the cube of NeRF-synthetic scenes and colours (count, 3) in [0, 1]."""
    generator = torch.Generator().manual_seed(seed)
    means = HALF_EDGE * (2 * torch.rand(count, 3, generator=generator) - 1)
    return means, torch.rand(count, 3, generator=generator)


def gaussians_at(points: Tensor, colors: Tensor, sh_degree: int) -> Gaussians:
    """Round, rather transparent Gaussians at (P, 3) points, about as large as the gaps between them."""
    count, device = len(points), points.device
    return Gaussians(
        points,
        neighbour_distance(points).log()[:, None].repeat(1, 3),
        torch.tensor([[1.0, 0, 0, 0]], device=device).repeat(count, 1),
        torch.full((count, 1), FIRST_OPACITY, device=device).logit(),
        (colors[:, None] - 0.5) / SH_C0,
        torch.zeros(count, (sh_degree + 1) ** 2 - 1, 3, device=device),
    )


def neighbour_distance(points: Tensor, neighbours: int = 3, rows: int = 1024) -> Tensor:
    """Mean distance of each point to its nearest neighbours, (P,)."""
    means, points = [], points.double()  # cdist multiplies matrices: float32 would lose near neighbours
    for chunk in points.split(rows):
        distances = torch.cdist(chunk, points)
        nearest = distances.topk(neighbours + 1, largest=False).values
        means.append(nearest[:, 1:].mean(1))  # the nearest is the point itself
    return torch.cat(means).float().clamp_min(1e-7)


def make_optimizer(gaussians: Gaussians, extent: float) -> torch.optim.Adam:
    """Adam with the learning rates of 3DGS; a group for each field, in their order."""
    rates = {"means": MEANS_RATE * extent, **RATES}
    groups = [{"params": [getattr(gaussians, name)], "lr": rates[name]} for name in Gaussians._fields]
    return torch.optim.Adam(groups, eps=1e-15, fused=gaussians.means.is_cuda)


def means_rate(progress: float, extent: float) -> float:
    """Learning rate of the means, falling exponentially as `progress` goes from 0 to 1."""
    return extent * MEANS_RATE * (FINAL_MEANS_RATE / MEANS_RATE) ** progress


def rotate(quaternions: Tensor, vectors: Tensor) -> Tensor:
    """(N, 3) vectors turned by (N, 4) quaternions (w, x, y, z) of any length but 0."""
    w, axis = normalize(quaternions, dim=1).split([1, 3], dim=1)
    across = torch.linalg.cross(axis, vectors)
    return vectors + 2 * (w * across + torch.linalg.cross(axis, across))
