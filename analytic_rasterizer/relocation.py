"""Splitting a Gaussian into several at one place that look as it did: the relocation of 3DGS-MCMC.

[MCMC] Kheradmand et al., 3D Gaussian Splatting as Markov Chain Monte Carlo, 2024.
"""

from __future__ import annotations

import functools
import math

import torch

from .checks import whole_number

_MOST = 1000  # whose binomials fit a float64


@functools.lru_cache(maxsize=8)
def _coefficients(n_max: int) -> torch.Tensor:
    """(n_max + 1, n_max): entry (N, k) is binom(N, k + 1) (-1)^k / sqrt(k + 1), float64.

    [MCMC, Eq. 9] sums binom(i - 1, k) over i = 1 to N, which is binom(N, k + 1).
    """
    rows = [[math.comb(n, k + 1) * (-1) ** k / math.sqrt(k + 1) for k in range(n_max)] for n in range(n_max + 1)]
    return torch.tensor(rows, dtype=torch.float64, device="cpu")


@torch.no_grad()
def compute_relocation(
    opacity_old: torch.Tensor,
    scale_old: torch.Tensor,
    N: torch.Tensor,
    binoms: torch.Tensor | None = None,
    n_max: int = 51,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Opacity and scale of N Gaussians in the place of one. Without gradient, on any device.

    Computed in float64: the sum of the scale's denominator has alternating terms, and cancels.

    Args:
        opacity_old: (P,) or (P, 1), 0 to 1; 1 is taken as the largest float32 below it.
        scale_old: (P, 3), or of any shape whose leading dimension is P.
        N: (P,) or (P, 1) integers, how many there will be, the old one counted; taken as 1 to n_max.
        binoms: Table of binomials of the original interface. Not read: they are computed exactly here.
        n_max: Largest N.

    Returns:
        Opacities and scales, of the shapes and dtypes of the old ones.

    Raises:
        TypeError: Not a tensor, N is not of integers, or the others are of integers.
        ValueError: Wrong shape or device, or n_max is not a whole number from 1 to 1000.

    Source: [MCMC, Eq. 9].
    """
    for name, tensor in (("opacity_old", opacity_old), ("scale_old", scale_old), ("N", N)):
        if not isinstance(tensor, torch.Tensor):
            raise TypeError(f"{name} must be a tensor, got {type(tensor).__name__}")
        if tensor.device != opacity_old.device:
            raise ValueError(f"{name} must be on the device of opacity_old, {opacity_old.device}, got {tensor.device}")
    count = opacity_old.numel()
    for name, tensor in (("opacity_old", opacity_old), ("N", N)):
        if tensor.shape not in ((count,), (count, 1)):
            raise ValueError(f"{name} must have shape ({count},) or ({count}, 1), got {tuple(tensor.shape)}")
    if scale_old.dim() < 1 or len(scale_old) != count:
        raise ValueError(f"scale_old must have shape ({count}, 3), got {tuple(scale_old.shape)}")
    for name, tensor in (("opacity_old", opacity_old), ("scale_old", scale_old)):
        if not tensor.is_floating_point():  # new opacities and scales would be rounded to integers
            raise TypeError(f"{name} must have a floating-point dtype, got {tensor.dtype}")
    if N.is_floating_point() or N.is_complex():
        raise TypeError(f"N must be of integers, got {N.dtype}")
    n_max = whole_number("n_max", n_max)
    if n_max < 1:
        raise ValueError(f"n_max must be at least 1, got {n_max}")
    if n_max > _MOST:
        raise ValueError(f"n_max must be at most {_MOST}, got {n_max}")
    times = N.reshape(-1).long().clamp(1, n_max)
    old = opacity_old.reshape(-1).double().clamp(max=1 - 2.0**-24)
    new = -torch.expm1(torch.log1p(-old) / times)
    table = _coefficients(n_max).to(new.device)
    denominator, power = torch.zeros_like(new), new.clone()
    for k in range(n_max):
        denominator += table[times, k] * power
        power *= new
    factor = torch.where((times == 1) | (old == 0), 1.0, old / denominator)
    scale = scale_old * factor.reshape(-1, *[1] * (scale_old.dim() - 1)).to(scale_old.dtype)
    return new.reshape(opacity_old.shape).to(opacity_old.dtype), scale
