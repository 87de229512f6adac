"""What a picture should be, the integral over every pixel, and how far another picture is from it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import torch

from ..cameras.camera import View
from ..footprints import UNFILTERED, resolve_footprint
from ..gaussians import Gaussians
from ..io import optional_import
from ..render.rasterizer import GaussianRasterizer

RMSE_SHARE = 0.1  # a reference is refined until it changes by at most this share of the smallest error
LARGEST_PSNR = 300.0  # dB, of pictures that are the same
MAX_DENSITY = 64  # samples along a pixel's side beyond which a reference is not refined
MAX_PIXELS = 2**23  # of one render of unfiltered samples; more pixels are split over several renders


def supersampled(
    scene: Gaussians, view: View, density: int, footprint: str = UNFILTERED, background=(0.0, 0.0, 0.0)
) -> torch.Tensor:
    """The mean of density x density samples in every pixel of a view, on a regular grid.

    The samples are the pixels of a picture `fine` times larger. Unfiltered samples may also come from
    `shifts` x `shifts` such pictures whose principal point is moved by a fraction of a pixel, which bounds the
    memory. A footprint with a filter is as wide as the pixels it is rendered in: shifted pictures would overlap.

    Args:
        scene: On any device.
        view: Its size is the size of the result.
        density: Samples along a pixel's side, at least 1.
        footprint: Evaluated in the pixels of the larger picture: see `resolve_footprint`.
        background: RGB.

    Returns:
        (3, H, W) float64 on the scene's device.
    """
    fine = density
    if resolve_footprint(footprint) == resolve_footprint(UNFILTERED):
        divisors = [n for n in range(1, density + 1) if density % n == 0]
        fine = max((n for n in divisors if n * n * view.width * view.height <= MAX_PIXELS), default=1)
    shifts = density // fine
    cx, cy = view.middle
    total = torch.zeros(3, view.height, view.width, dtype=torch.float64, device=scene.means.device)
    for i in range(shifts**2):
        column, row = ((n + 0.5) / shifts - 0.5 for n in (i % shifts, i // shifts))
        shifted = replace(view, cx=cx - column / fine, cy=cy - row / fine)
        settings = shifted.settings(fine, background, scene.sh_degree, footprint, device=scene.means.device)
        with torch.no_grad():
            color, _ = GaussianRasterizer(settings)(means2D=None, **scene.arguments())
        total += torch.nn.functional.avg_pool2d(color[None].double(), fine)[0]
    return total / shifts**2


class Refined(NamedTuple):
    """Pictures of a converged reference, by key."""

    pictures: dict[Any, torch.Tensor]
    half: dict[Any, torch.Tensor]  # the pictures at half the density
    residuals: dict[int, dict[Any, float]]  # by density: RMSE against the pictures at half of it

    @property
    def density(self) -> int:
        return max(self.residuals)


def refine(
    sample: Callable[[int], dict], smallest_error: Callable[[dict], dict], start: int = 4, limit: int | None = None
) -> Refined:
    """Doubles the density until that changes the pictures by at most RMSE_SHARE of the smallest error.

    The error of a midpoint grid at least halves with every doubling where it converges, and then the last change
    bounds the error that is left. The caller reports which errors the last residual does not resolve.

    Args:
        sample: The pictures at a density, by any key.
        smallest_error: Given the pictures as truth, the smallest RMSE that will be reported, by key.
        start: The coarsest density.
        limit: The largest density; None is MAX_DENSITY.
    """
    limit = MAX_DENSITY if limit is None else limit
    density, coarse, residuals = start, sample(start), {}
    with optional_import("tqdm").tqdm(desc="reference", unit=" densities", disable=None) as bar:
        while True:
            density *= 2
            truth = sample(density)
            bar.update()
            residuals[density] = {key: image_errors(coarse[key], truth[key])["rmse"] for key in truth}
            smallest = smallest_error(truth)
            if 2 * density > limit or all(residuals[density][key] <= RMSE_SHARE * smallest[key] for key in truth):
                return Refined(truth, coarse, residuals)
            coarse = truth


def decibels(mean_square: torch.Tensor) -> torch.Tensor:
    """PSNR [dB] of a mean square error, for colours from 0 to 1; infinite where there is no error."""
    return -10 * mean_square.log10()


def finite_decibels(mean_square: float) -> float:
    """`decibels` of a number, `LARGEST_PSNR` at most."""
    return min(LARGEST_PSNR, decibels(torch.tensor(mean_square, dtype=torch.float64, device="cpu")).item())


def image_errors(color: torch.Tensor, truth: torch.Tensor) -> dict[str, float]:
    """How far a picture is from the truth, over all channels of all pixels, for colours from 0 to 1, not clamped.

    Returns:
        psnr (dB, peak 1; 300 where the mean square is below 1e-30), rmse, bias (mean of color - truth), p999 (the
        absolute error that 99.9% of the values do not exceed) and max.
    """
    error = (color.double() - truth).flatten()
    mse = error.square().mean().item()
    size = error.abs()
    return {
        "psnr": finite_decibels(mse),
        "rmse": math.sqrt(mse),
        "bias": error.mean().item(),
        "p999": size.kthvalue(math.ceil(0.999 * size.numel())).values.item(),
        "max": size.max().item(),
    }
