"""How much the bands of spherical harmonics add to the colours of a scene."""

from __future__ import annotations

import math

import torch

from .effects import MAX_SH_DEGREE


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
        ValueError: Wrong shape.
    """
    degree = math.isqrt(shs.shape[1]) - 1 if shs.dim() == 3 else -1
    if shs.dim() != 3 or shs.shape[2] != 3 or not 0 <= degree <= MAX_SH_DEGREE or (degree + 1) ** 2 != shs.shape[1]:
        raise ValueError(f"shs must have shape (P, M, 3) with M = 1, 4, 9, 16 or 25, got {tuple(shs.shape)}")
    if len(shs) == 0:
        return [0.0] * (degree + 1)
    norms = torch.stack([shs[:, band**2 : (band + 1) ** 2].norm(dim=1).max() for band in range(degree + 1)])
    return [math.sqrt((2 * band + 1) / (4 * math.pi)) * norm for band, norm in enumerate(norms.tolist())]


def needed_sh_degree(shs: torch.Tensor, tolerance: float = 1 / 255) -> int:
    """The smallest degree that renders within the tolerance of all of them, whatever the view.

    Set as `sh_degree` of the settings it saves reading and computing the bands above. Waits for the device: to be
    called once per scene.

    Args:
        shs: (P, M, 3) coefficients, M = 1, 4, 9, 16 or 25.
        tolerance: In units of colour.

    Raises:
        ValueError: Wrong shape, or a tolerance that is negative or not finite.
    """
    if not 0 <= tolerance < math.inf:
        raise ValueError(f"tolerance must be finite and not negative, got {tolerance}")
    bounds = sh_band_bounds(shs)
    if not math.isfinite(sum(bounds)):
        return len(bounds) - 1  # such Gaussians are culled, which a lower degree might not see
    degree, left_out = len(bounds) - 1, 0.0
    while degree > 0 and left_out + bounds[degree] <= tolerance:
        left_out += bounds[degree]
        degree -= 1
    return degree
