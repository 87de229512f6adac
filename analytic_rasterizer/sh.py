"""Spherical harmonics: how much each band adds to the colours of a scene, and which degree is needed."""

from __future__ import annotations

import math

import torch
from torch.utils.weak import WeakTensorKeyDictionary

from .checks import check_tensors, one_number
from .render.effects import AUTO, MAX_SH_DEGREE, Effects


@torch.no_grad()
def sh_band_bounds(shs: torch.Tensor) -> list[float]:
    """The most that each band of spherical harmonics adds to a colour of the scene, seen from anywhere.

    A band of degree l with coefficients c_m adds sum_m c_m Y_m, at most |c| sqrt((2l + 1) / (4 pi)): Cauchy and
    Schwarz, and the addition theorem. Blending weights add up to 1 at most, so that no pixel changes by more than a
    Gaussian does.

    Args:
        shs: (P, M, 3) coefficients, M = 1, 4, 9, 16 or 25.

    Returns:
        One bound per degree from 0 on, in units of colour.

    Raises:
        TypeError: Not a tensor of floating-point numbers.
        ValueError: Wrong shape.
    """
    check_tensors(None, shs=shs)
    if not shs.is_floating_point():
        raise TypeError(f"shs must have a floating-point dtype, got {shs.dtype}")
    degree = math.isqrt(shs.shape[1]) - 1 if shs.dim() == 3 else -1
    if shs.dim() != 3 or shs.shape[2] != 3 or not 0 <= degree <= MAX_SH_DEGREE or (degree + 1) ** 2 != shs.shape[1]:
        raise ValueError(f"shs must have shape (P, M, 3) with M = 1, 4, 9, 16 or 25, got {tuple(shs.shape)}")
    if len(shs) == 0:
        return [0.0] * (degree + 1)
    norms = torch.stack([shs[:, band**2 : (band + 1) ** 2].norm(dim=1).max() for band in range(degree + 1)])
    return [math.sqrt((2 * band + 1) / (4 * math.pi)) * norm for band, norm in enumerate(norms.tolist())]


def needed_sh_degree(shs: torch.Tensor, tolerance: float = 1 / 255) -> int:
    """The smallest degree whose colours are within the tolerance of those of all coefficients, for any view.

    Set it as `sh_degree` of the settings to save reading and computing the bands above it. Call it once per scene,
    because it waits for the device.

    Args:
        shs: (P, M, 3) coefficients, M = 1, 4, 9, 16 or 25.
        tolerance: Largest change of a colour, 0 to 1.

    Returns:
        The degree, 0 to 4.

    Raises:
        TypeError: Not a tensor of floating-point numbers, or a tolerance that is no number.
        ValueError: Wrong shape, or a tolerance that is negative or not finite.
    """
    if not 0 <= one_number("tolerance", tolerance) < math.inf:
        raise ValueError(f"tolerance must be finite and not negative, got {tolerance}")
    bounds = sh_band_bounds(shs)
    if not math.isfinite(sum(bounds)):
        return len(bounds) - 1  # such Gaussians are culled, which a lower degree might not see
    degree, left_out = len(bounds) - 1, 0.0
    while degree > 0 and left_out + bounds[degree] <= tolerance:
        left_out += bounds[degree]
        degree -= 1
    return degree


# By tensor of coefficients: its version, the degree that was asked for, and the degree that is needed.
_needed_degrees = WeakTensorKeyDictionary()


def used_sh_degree(effects: Effects | str, degree: int, shs: torch.Tensor | None) -> int:
    """The degree of spherical harmonics to evaluate, at most the one that the settings ask for.

    With `AUTO` it is the smallest degree that makes no visible difference (`needed_sh_degree`). That is computed once
    per tensor and version of the coefficients, because it waits for the device. Coefficients that are being trained,
    or that were made in inference mode, are used in full. A change through `shs.data` does not raise the tensor's
    version, and so goes unnoticed.
    """
    if effects != AUTO:
        return degree if effects.sh_degree is None else min(degree, effects.sh_degree)
    if shs is None or degree < 0 or shs.dim() != 3 or (shs.requires_grad and torch.is_grad_enabled()):
        return degree
    used = shs[:, : (degree + 1) ** 2]
    if used.shape[1] < (degree + 1) ** 2 or shs.is_inference():  # a tensor of inference mode has no version
        return degree
    known = _needed_degrees.get(shs)
    if known is None or known[:2] != (shs._version, degree):
        known = _needed_degrees[shs] = (shs._version, degree, needed_sh_degree(used))
    return known[2]
