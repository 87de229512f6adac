"""How the Gaussians that are trained are rendered and differentiated, and where they start without points."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from .. import distributed
from ..filters import apply_3d_filter
from ..gaussians import Gaussians
from ..losses import l1_ssim
from ..render.rasterizer import rasterize_gaussians
from ..render.settings import GaussianRasterizationSettings
from .exposure import corrected

if TYPE_CHECKING:
    from torch.distributed import ProcessGroup

HALF_EDGE = 1.3  # of the cube of random points; NeRF-synthetic objects fit in it


def render(
    gaussians: dict[str, Tensor],
    settings: GaussianRasterizationSettings,
    means2D: Tensor | None = None,
    supersampling: int = 1,
) -> tuple[Tensor, Tensor]:
    """The picture (3, H, W), and the radii (P,) int32 in px, 0 for what is not seen.

    Args:
        gaussians: `Gaussians.arguments`, so that several pictures share them.
        means2D: Receives the gradient with respect to the projected means.
        supersampling: Render so many times larger, and average over squares of pixels. Radii, and the pixels of
            the footprint, are those of the larger picture.
    """
    picture, radii = rasterize_gaussians(
        gaussians["means3D"],
        means2D,
        gaussians["shs"],
        None,
        gaussians["opacities"],
        gaussians["scales"],
        gaussians["rotations"],
        None,
        enlarged(settings, supersampling),
    )
    return averaged(picture, supersampling), radii


def render_together(
    gaussians: dict[str, Tensor],
    settings: list[GaussianRasterizationSettings],
    supersampling: int = 1,
    means2d_abs: bool = False,
    group: ProcessGroup | None = None,
) -> distributed.Batch:
    """The pictures of several ranks, each of which has a part of the Gaussians: see `distributed.rasterize`.

    Args:
        gaussians, supersampling: As in `render`. The splats are those of the larger pictures, and alpha is.
    """
    larger = [enlarged(of_camera, supersampling) for of_camera in settings]
    batch = distributed.rasterize(larger, **gaussians, means2d_abs=means2d_abs, group=group)
    renderings = (shown._replace(image=averaged(shown.image, supersampling)) for shown in batch.renderings)
    return replace(batch, renderings=tuple(renderings))


@torch.enable_grad()
def gradients_by_autograd(
    gaussians: Gaussians,
    settings: GaussianRasterizationSettings,
    *,
    mean_columns: int,
    target: Tensor,
    dL_dloss: Tensor,
    exposure: Tensor | None = None,
    mask: Tensor | None = None,
    ssim_weight: float = 0.2,
    filter_3d: Tensor | None = None,
    supersampling: int = 1,
    opacity_weight: float = 0.0,
    scale_weight: float = 0.0,
) -> tuple[Tensor, Tensor, Tensor, list[Tensor]]:
    """What the op `picture_gradients` returns, for every lens.

    The op has no equirectangular lens, for which splats are copied between its parts (seam.py).

    Args:
        settings: Of a picture of the size of the target.
        others: As of the op (csrc/torch/arguments.h).
    """
    leaves = gaussians.map(lambda field: field.detach().requires_grad_())
    means = leaves.means
    means2D = means.new_empty(len(means), mean_columns, requires_grad=True) if mean_columns else None
    exposure = None if exposure is None else exposure.detach().requires_grad_()
    arguments = leaves.arguments()
    image, radii = render(filtered(arguments, filter_3d), settings, means2D, supersampling)
    image = corrected(image, exposure)
    loss = l1_ssim(image, target, ssim_weight, mask)
    for weight, name in ((opacity_weight, "opacities"), (scale_weight, "scales")):
        if weight:
            loss = loss + weight * arguments[name].mean()
    wanted = [leaf for leaf in (*leaves, means2D, exposure) if leaf is not None]
    # In this thread: otherwise one of the device's does it, and handing over and back takes longer than the kernels of
    # a small picture.
    with torch.autograd.set_multithreading_enabled(False):
        gradients = torch.autograd.grad(loss, wanted, dL_dloss)
    return loss.detach(), image.detach(), radii, list(gradients)


def filtered(gaussians: dict[str, Tensor], filter_3d: Tensor | None) -> dict[str, Tensor]:
    """`Gaussians.arguments` with the 3D filter (N,) where there is one."""
    if filter_3d is None:
        return gaussians
    scales, opacities = apply_3d_filter(gaussians["scales"], gaussians["opacities"], filter_3d)
    return gaussians | {"scales": scales, "opacities": opacities}


def enlarged(settings: GaussianRasterizationSettings, times: int) -> GaussianRasterizationSettings:
    """Those of a picture so many times as large."""
    if times == 1:
        return settings  # as they are: making others takes longer than all checks of a step
    return settings._replace(image_height=times * settings.image_height, image_width=times * settings.image_width)


def averaged(picture: Tensor, times: int) -> Tensor:
    """Means over squares of so many pixels, (3, H / times, W / times)."""
    return avg_pool2d(picture, times) if times > 1 else picture


def random_points(count: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Positions (count, 3) in the cube from -1.3 to 1.3, where NeRF-synthetic scenes are, and grey, (count, 3) of 0.5.

    Drawn by `seed`, on the CPU. Random colours, of which nothing is known, would only have to be unlearned.
    """
    generator = torch.Generator().manual_seed(seed)
    uniform = torch.rand(count, 3, generator=generator, dtype=torch.float32, device="cpu")
    return HALF_EDGE * (2 * uniform - 1), torch.full_like(uniform, 0.5)
