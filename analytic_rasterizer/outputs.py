"""What a rendering returns besides its colours."""

from __future__ import annotations

from typing import NamedTuple

import torch

from . import _C
from .effects import Effects

BLENDED = ("alpha", "depth", "inverse_depth")
"""Outputs that the op returns as images, in its order."""


class GaussianStats(NamedTuple):
    """How much of every Gaussian a picture shows. Its weight in a pixel is what its colour is multiplied with there.

    Attributes:
        pixels: (P,) int32, pixels in which its weight is not zero.
        max_weight: (P,) largest weight, 0 to 1, float32.
        sum_weight: (P,) sum of weights over all pixels, in steps of 2^-32.
    """

    pixels: torch.Tensor
    max_weight: torch.Tensor
    sum_weight: torch.Tensor


class Outputs(NamedTuple):
    """What `Effects` asked for; None for the rest. The first three are differentiable in every input of the rasterizer.

    Attributes:
        alpha: (1, H, W) in 0 to 1.
        depth: (1, H, W) sum of weight times z, world units; divided by alpha it is the mean depth of what is seen.
        inverse_depth: (1, H, W) sum of weight over z, 1 / world units.
        median_depth: (1, H, W) world units; 0 where half of the light gets through.
        dominant_index: (1, H, W) int32, the Gaussian of the largest weight, of equal ones the nearest; -1 for none.
        gaussian_stats: `GaussianStats`.
    """

    alpha: torch.Tensor | None = None
    depth: torch.Tensor | None = None
    inverse_depth: torch.Tensor | None = None
    median_depth: torch.Tensor | None = None
    dominant_index: torch.Tensor | None = None
    gaussian_stats: GaussianStats | None = None


def normalized(blended: torch.Tensor, alpha: torch.Tensor, smallest: float = 1e-6) -> torch.Tensor:
    """Mean over what is seen of a blended output: `blended` / `alpha`, and 0 where alpha is below `smallest`.

    Args:
        blended: (..., H, W), `Outputs.depth` for one.
        alpha: (1, H, W) of the same picture.
        smallest: Alpha below which there is nothing to see.
    """
    seen = alpha > smallest
    return torch.where(seen, blended / torch.where(seen, alpha, 1), 0)


def depths(means3D: torch.Tensor, view: torch.Tensor) -> torch.Tensor:
    """Camera-space z, (P,)."""
    view = view.reshape(4, 4)
    return means3D @ view[:3, 2] + view[3, 2]


@torch.no_grad()
def summaries(
    effects: Effects, saved: list[torch.Tensor], z: torch.Tensor, size: tuple[int, int], footprint: str, option: float
) -> dict:
    """The outputs without a gradient that `effects` asks for, by name.

    Args:
        effects: What to make.
        saved: What `rasterize` saved.
        z: (P,) camera-space z of the Gaussians, world units.
        size: Height and width of the image, px.
        footprint, option: Key and number of the footprint that it was rendered with.
    """
    median, dominant, pixels, largest, total = torch.ops.analytic_rasterizer.inspect(
        saved, len(z), *size, footprint, option
    )
    outputs = {}
    if effects.median_depth:
        of_pixel = z[median.clamp_min(0).long()] if len(z) else z.new_zeros(median.shape)
        outputs["median_depth"] = torch.where(median < 0, 0, of_pixel)[None]
    if effects.dominant_index:
        outputs["dominant_index"] = dominant[None]
    if effects.gaussian_stats:
        sums = (total.double() * _C.WEIGHT_UNIT).to(z.dtype)
        outputs["gaussian_stats"] = GaussianStats(pixels, largest, sums)
    return outputs
