"""Opacities and scales of Gaussians that share the place of one: 3DGS as Markov chain Monte Carlo."""

from __future__ import annotations

import torch


@torch.no_grad()
def compute_relocation(
    opacity_old: torch.Tensor, scale_old: torch.Tensor, N: torch.Tensor, binoms: torch.Tensor, n_max: int
) -> tuple[torch.Tensor, torch.Tensor]:
    """Opacity and scales with which N copies of a Gaussian at its place look like the Gaussian did alone.

    The new opacity is o' = 1 - (1 - o)^(1/N), and the scales are multiplied with o over the sum over i = 1 to N and
    k = 0 to i - 1 of binom(i - 1, k) (-1)^k o'^(k + 1) / sqrt(k + 1). The sum alternates, and is taken in float64.

    Args:
        opacity_old: (P,) or (P, 1), 0 to 1.
        scale_old: (P, 3) world units.
        N: (P,) or (P, 1) of integers: how many Gaussians take the place; taken to 1 to n_max.
        binoms: (n_max, n_max) with n over k in row n, column k.
        n_max: Size of the table.

    Returns:
        New opacities in the shape of opacity_old, and new scales (P, 3).

    Raises:
        TypeError: Not a tensor.
        ValueError: Wrong shape.

    Source: [MCMC, Eq. 9]: Kheradmand et al., 3D Gaussian Splatting as Markov Chain Monte Carlo, NeurIPS 2024.
    """
    given = {"opacity_old": opacity_old, "scale_old": scale_old, "N": N, "binoms": binoms}
    for name, tensor in given.items():
        if not isinstance(tensor, torch.Tensor):
            raise TypeError(f"{name} must be a tensor, got {type(tensor).__name__}")
    count = len(opacity_old)
    for name, shapes in (
        ("opacity_old", ((count,), (count, 1))),
        ("scale_old", ((count, 3),)),
        ("N", ((count,), (count, 1))),
        ("binoms", ((n_max, n_max),)),
    ):
        if given[name].shape not in shapes:
            raise ValueError(f"{name} must have shape {' or '.join(map(str, shapes))}, got {tuple(given[name].shape)}")
    # At an opacity of exactly 1 the terms of many copies grow beyond what float64 can add up.
    old, copies = opacity_old.reshape(-1).double().clamp(0, 1 - 2**-24), N.reshape(-1).long().clamp(1, n_max)
    new = -torch.expm1(torch.log1p(-old) / copies)
    # The sum over i has the same o'^(k + 1) in all its terms: row N of the table's running sums.
    of_power = binoms.double().cumsum(0)[copies - 1]
    k = torch.arange(n_max, dtype=torch.float64, device=old.device)
    signs = 1 - 2 * (k % 2)
    total = (of_power * signs / (k + 1).sqrt() * new[:, None] ** (k + 1)).sum(1)
    scale = scale_old * (old / total).to(scale_old)[:, None]
    return new.to(opacity_old).reshape(opacity_old.shape), scale
