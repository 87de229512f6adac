"""Rotations of Gaussians and of cameras, and products of small matrices."""

from __future__ import annotations

import torch


def product(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Matrix product (..., m, n) of (..., m, k) and (..., k, n), in the precision of its factors. For small matrices.

    `a @ b` is rounded to 8 or 10 bits where a program allows that for its networks, under autocast or with TF32, and
    with it every pose and depth would be.
    """
    return (a.unsqueeze(-1) * b.unsqueeze(-3)).sum(-2)


def rotation_matrices(quaternions: torch.Tensor, unit: bool = False) -> torch.Tensor:
    """(..., 3, 3) of quaternions (..., 4) (w, x, y, z) of any length; zero is the identity. Differentiable.

    Args:
        unit: They have length 1, and are taken as they are.
    """
    if not unit:
        quaternions = torch.nn.functional.normalize(quaternions, dim=-1)
    w, x, y, z = quaternions.unbind(-1)
    entries = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(entries, -1).unflatten(-1, (3, 3))


def quaternion(rotation: torch.Tensor) -> torch.Tensor:
    """(4,) unit quaternion (w, x, y, z), float64, of a rotation (3, 3), or of the rotation nearest to a rounded one.

    Of its two signs it has any. Source: Bar-Itzhack, New Method for Extracting the Quaternion from a Rotation Matrix,
    JGCD 2000.
    """
    (a, b, c), (d, e, f), (g, h, i) = rotation.double().tolist()
    rows = [
        [a + e + i, h - f, c - g, d - b],
        [h - f, a - e - i, b + d, c + g],
        [c - g, b + d, e - a - i, f + h],
        [d - b, c + g, f + h, i - a - e],
    ]
    return torch.linalg.eigh(torch.tensor(rows, dtype=torch.float64, device="cpu"))[1][:, -1]
