"""The loss of 3D Gaussian Splatting, its structural similarity exactly, in one kernel forward and one backward.

[SSIM] Wang et al., Image Quality Assessment: From Error Visibility to Structural Similarity, 2004.
"""

from __future__ import annotations

from numbers import Real
from typing import Any

import torch

from . import ops  # noqa: F401  (registers the fake kernels)
from .checks import check_tensors
from .footprints import check_device

__all__ = ["l1_ssim", "ssim"]

REDUCTIONS = ("mean", "none")


def l1_ssim(
    image: torch.Tensor, target: torch.Tensor, ssim_weight: float = 0.2, mask: torch.Tensor | None = None
) -> torch.Tensor:
    """(1 - ssim_weight) * mean |image - target| + ssim_weight * (1 - mean similarity), the training loss of 3DGS.

    The similarity is that of `ssim`. The derivative of |x| at 0 is taken as 0. NaN in the images makes the loss NaN.
    Nothing waits for the device, and the result is the same bit for bit in every run and for any number of threads.

    Args:
        image: (C, H, W) or (B, C, H, W), float32 or float64, of values in [0, 1]; the mean is over everything. Any
            sizes from 1 on, also smaller than the window.
        target: Of the same shape and device, of the dtype of image, or uint8, which is read as target / 255. It has no
            gradient.
        ssim_weight: In [0, 1].
        mask: (H, W) of the dtype and device of image, in [0, 1]: the share of each pixel that counts. Both images are
            multiplied by it, so that a pixel of 0 has no gradient, whatever the images are there. The mean is still
            over all pixels. None: all of them count.

    Returns:
        () of the dtype of image, differentiable once with respect to image. For the backward pass three numbers per
        number of the image are kept.

    Raises:
        TypeError: A wrong dtype, or something is no tensor or no number.
        ValueError: A wrong shape or device, an image without pixels, a target that requires a gradient, or a weight
            outside [0, 1].
        RuntimeError: CUDA tensors, and an extension without CUDA.

    Source: Kerbl et al., 3D Gaussian Splatting for Real-Time Radiance Field Rendering, 2023, Eq. 7; [SSIM, Eq. 13].
    """
    _check(image, target)
    if not isinstance(ssim_weight, Real):
        raise TypeError(f"ssim_weight must be a number, got {type(ssim_weight).__name__}")
    if not 0 <= ssim_weight <= 1:
        raise ValueError(f"ssim_weight must be in [0, 1], got {ssim_weight}")
    weight = float(ssim_weight)
    image, target = counted(image, target, mask)
    return torch.ops.analytic_rasterizer.l1_ssim(image, target, 1 - weight, -weight, weight)[0]


def counted(image: torch.Tensor, target: torch.Tensor, mask: torch.Tensor | None) -> tuple[torch.Tensor, torch.Tensor]:
    """Both images times the mask, see `l1_ssim`; without a mask as they are."""
    if mask is None:
        return image, target
    check_tensors(image.device, mask=mask)
    if mask.dtype != image.dtype:
        raise TypeError(f"mask must have the dtype of image, {image.dtype}, got {mask.dtype}")
    if mask.shape != image.shape[-2:]:
        raise ValueError(f"mask must have shape (H, W) = {tuple(image.shape[-2:])}, got {tuple(mask.shape)}")
    if not target.is_floating_point():
        target = target.to(image.dtype) / 255
    return image * mask, target * mask


def ssim(image: torch.Tensor, target: torch.Tensor, reduction: str = "mean") -> torch.Tensor:
    """Structural similarity of two images, as 3DGS computes it for its loss and its tables.

    In every channel by itself: means, variances and the covariance under a Gaussian window of 11 x 11 pixels with a
    standard deviation of 1.5 px, zeros outside the image, C1 = 0.01^2, C2 = 0.03^2. (Other libraries leave out the
    pixels near the border, or mirror the image there, and give other numbers.)

    In float32 the variances are differences of rounded numbers, in 3DGS as here. That shows where images are flat and
    bright: there the similarity of a pixel is good to 2e-3, and the mean to 1e-4; docs/losses.md has what was measured.

    Args:
        image: As in `l1_ssim`.
        target: As in `l1_ssim`.
        reduction: "mean" over all pixels and channels, or "none".

    Returns:
        () or of the shape of image, of the dtype of image, differentiable once with respect to image.

    Raises:
        TypeError, ValueError, RuntimeError: As `l1_ssim`; ValueError also for another reduction.

    Source: [SSIM, Eq. 13].
    """
    _check(image, target)
    if reduction not in REDUCTIONS:
        raise ValueError(f"reduction must be one of {REDUCTIONS}, got {reduction!r}")
    if reduction == "none":
        return torch.ops.analytic_rasterizer.ssim_map(image, target)[0]
    return torch.ops.analytic_rasterizer.l1_ssim(image, target, 0.0, 1.0, 0.0)[0]


def _check(image: Any, target: Any) -> None:
    """What the ops cannot check; they check shapes, dtypes and devices."""
    for name, tensor in (("image", image), ("target", target)):
        if not isinstance(tensor, torch.Tensor):
            raise TypeError(f"{name} must be a tensor, got {type(tensor).__name__}")
        check_device(tensor.device)
    if target.requires_grad and torch.is_grad_enabled():
        raise ValueError("target must not require a gradient, it gets none: pass target.detach()")
