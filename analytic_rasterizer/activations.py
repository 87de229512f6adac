"""From the parameters of Gaussians, as they are optimised and stored, to what the rasterizer takes."""

from __future__ import annotations

import torch

from . import ops  # noqa: F401  (registers the fake kernels)
from .footprints import check_device

__all__ = ["activate"]


def activate(
    log_scales: torch.Tensor, quats: torch.Tensor, logit_opacities: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """exp(log_scales), quats / |quats| and sigmoid(logit_opacities): one kernel on CUDA, and one for the gradients.

    Values and gradients are those of torch's functions, within a few roundings. Quaternions shorter than 1e-12 are
    divided by 1e-12 (torch.nn.functional.normalize), so that zero stays zero, which the rasterizer takes as the
    identity. In float32 quaternions longer than 1e19 become zero. NaN stays NaN. The backward pass computes the values
    again from the parameters; nothing is kept for it.

    Args:
        log_scales: (N, 3) natural logarithms of the standard deviations in world units, float32 or float64. N = 0 is
            valid.
        quats: (N, 4) rotations as (w, x, y, z), of any length.
        logit_opacities: (N, 1) logits.

    Returns:
        scales (N, 3), rotations (N, 4), opacities (N, 1), of the same dtype and device, differentiable once.

    Raises:
        TypeError: A wrong dtype, or something is no tensor.
        ValueError: A wrong shape or device.
        RuntimeError: CUDA tensors, and an extension without CUDA.
    """
    for name, tensor in (("log_scales", log_scales), ("quats", quats), ("logit_opacities", logit_opacities)):
        if not isinstance(tensor, torch.Tensor):
            raise TypeError(f"{name} must be a tensor, got {type(tensor).__name__}")
        check_device(tensor.device)
    return torch.ops.analytic_rasterizer.activate(log_scales, quats, logit_opacities)[:3]
