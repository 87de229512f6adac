"""Scenes in half of the memory, for WebGPU: 24 bytes of geometry, and harmonics of 8 bits."""

from __future__ import annotations

import numpy as np
import torch

from ..gaussians import Gaussians

LARGEST_HALF = 65504.0
STEPS = 511  # of a component of a quaternion on either side of 0


def compact_geometry(scene: Gaussians, quaternions: torch.Tensor) -> tuple[bytes, float]:
    """Geometry in 24 bytes per Gaussian, and the unit of its scales, world units.

    Words of 32 bits, little endian: the mean as three floats; scales x, y, z by the unit, and opacity, as four half
    floats; the unit quaternion. Its largest component is positive and left out: bits 30 and 31 are the number of this
    component, and the others follow it, round from the last to the first, in 10 bits each, x = sqrt(1/2) (n / 511 - 1).

    Args:
        scene: On the CPU.
        quaternions: (N, 4), of length 1.
    """
    unit = max(scene.scales.max().item() / LARGEST_HALF, torch.finfo(torch.float32).tiny)
    halves = torch.cat([scene.scales / unit, scene.opacities], dim=1).clamp(0, LARGEST_HALF).half()
    largest = quaternions.abs().argmax(dim=1, keepdim=True)
    positive = quaternions * torch.where(quaternions.gather(1, largest) < 0, -1.0, 1.0)
    others = positive.gather(1, (largest + torch.arange(1, 4, device="cpu")) % 4) * 2**0.5
    steps = ((others.clamp(-1, 1) + 1) * STEPS).round().long()
    turn = steps[:, 0] | steps[:, 1] << 10 | steps[:, 2] << 20 | largest[:, 0] << 30
    words = np.empty((len(scene.means), 6), "<u4")
    words[:, :3] = scene.means.numpy().astype("<f4").view("<u4")
    words[:, 3:5] = halves.numpy().astype("<f2").view("<u4")
    words[:, 5] = turn.numpy()
    return words.tobytes(), unit


def compact_harmonics(scene: Gaussians) -> bytes:
    """Per Gaussian three half floats, its coefficient of degree 0; one that is the largest magnitude of the others; and
    these, by it, as bytes from -127 to 127, filled up to whole words.

    Args:
        scene: On the CPU.
    """
    count, used = len(scene.means), 3 * (scene.sh_degree + 1) ** 2
    numbers = scene.shs.reshape(count, -1)[:, :used].clamp(-LARGEST_HALF, LARGEST_HALF)
    first, rest = numbers[:, :3], numbers[:, 3:]
    largest = rest.abs().amax(dim=1, keepdim=True) if used > 3 else torch.zeros(count, 1, device="cpu")
    largest = (largest * (1 + 2**-10)).clamp(max=LARGEST_HALF).half()  # no number is beyond it once it is rounded
    made = np.zeros((count, 8 + -(-(used - 3) // 4) * 4), "u1")
    made[:, :8] = torch.cat([first.half(), largest], dim=1).numpy().astype("<f2").view("u1")
    levels = (127 * rest / largest.float().clamp_min(1e-30)).round().clamp(-127, 127)
    made[:, 8 : 5 + used] = levels.numpy().astype("i1").view("u1")
    return made.tobytes()
