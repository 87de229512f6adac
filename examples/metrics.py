"""How far pictures are from the truth."""

from __future__ import annotations

import re
from pathlib import Path

import torch
from torch import Tensor
from torch.nn import functional

from analytic_rasterizer import io
from dataset import Split
from gaussians import Gaussians


def training_loss(image: Tensor, truth: Tensor) -> Tensor:
    """That of 3DGS: 0.8 of the mean absolute error, 0.2 of 1 - SSIM."""
    return 0.8 * (image - truth).abs().mean() + 0.2 * (1 - ssim(image, truth))


def ssim(image: Tensor, truth: Tensor) -> Tensor:
    """Structural similarity of two (3, H, W) images in [0, 1]: Gaussian window of 11 px, zeros outside,
    as in the loss of 3DGS."""
    moments = torch.stack([image, truth, image * image, truth * truth, image * truth])
    mean_x, mean_y, xx, yy, xy = blur(moments)
    variance_x, variance_y, covariance = xx - mean_x**2, yy - mean_y**2, xy - mean_x * mean_y
    c1, c2 = 0.01**2, 0.03**2
    similarity = (2 * mean_x * mean_y + c1) * (2 * covariance + c2)
    return (similarity / ((mean_x**2 + mean_y**2 + c1) * (variance_x + variance_y + c2))).mean()


def blur(images: Tensor, radius: int = 5, sigma: float = 1.5) -> Tensor:
    """(N, 3, H, W) convolved with a Gaussian, rows and columns in turn."""
    x = torch.arange(-radius, radius + 1, device=images.device, dtype=images.dtype)
    weights = torch.softmax(-(x**2) / (2 * sigma**2), dim=0).repeat(3, 1)
    images = functional.conv2d(images, weights[:, None, None, :], padding=(0, radius), groups=3)
    return functional.conv2d(images, weights[:, None, :, None], padding=(radius, 0), groups=3)


@torch.no_grad()
def evaluate(gaussians: Gaussians, split: Split, footprint: str, sh_degree: int) -> dict[str, dict[int, float]]:
    """PSNR [dB] and SSIM by scale, means over views."""
    psnr, similarity = {}, {}
    for scale, of_scale in split.resolve(footprint, sh_degree).items():
        errors, similarities = [], []
        for view, settings in enumerate(of_scale):
            image, truth = gaussians.render(settings)[0].clamp(0, 1), split.truth(scale, view)
            errors.append((image - truth).square().mean())
            similarities.append(ssim(image, truth))
        psnr[scale] = (-10 * torch.stack(errors).log10()).mean().item()
        similarity[scale] = torch.stack(similarities).mean().item()
    return {"psnr": psnr, "ssim": similarity}


@torch.no_grad()
def save_pictures(folder: Path, gaussians: Gaussians, split: Split, footprint: str, sh_degree: int, count: int) -> None:
    """The rendering beside the truth, for `count` views spread over the split."""
    name = re.sub(r"\W+", "_", footprint)
    count = min(count, len(split.views))
    for scale, of_scale in split.resolve(footprint, sh_degree).items():
        for view in (i * len(split.views) // count for i in range(count)):
            pair = torch.cat([gaussians.render(of_scale[view])[0], split.truth(scale, view)], dim=2)
            io.to_image(pair).save(folder / f"{name}_{scale}_{split.views[view].name}.png")
