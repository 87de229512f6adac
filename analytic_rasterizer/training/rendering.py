"""How the Gaussians that are trained are rendered: larger and averaged, or by several ranks together."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from torch import Tensor
from torch.nn.functional import avg_pool2d

from .. import distributed
from ..render.rasterizer import rasterize_gaussians
from ..render.settings import GaussianRasterizationSettings

if TYPE_CHECKING:
    from torch.distributed import ProcessGroup


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
    group: ProcessGroup | None = None,
) -> distributed.Batch:
    """The pictures of several ranks, each of which has a part of the Gaussians: see `distributed.rasterize`.

    Args:
        gaussians, supersampling: As in `render`. The splats are those of the larger pictures, and alpha is.
    """
    larger = [enlarged(of_camera, supersampling) for of_camera in settings]
    batch = distributed.rasterize(larger, **gaussians, group=group)
    renderings = (shown._replace(image=averaged(shown.image, supersampling)) for shown in batch.renderings)
    return replace(batch, renderings=tuple(renderings))


def enlarged(settings: GaussianRasterizationSettings, times: int) -> GaussianRasterizationSettings:
    """Those of a picture so many times as large."""
    if times == 1:
        return settings  # as they are: making others takes longer than all checks of a step
    return settings._replace(image_height=times * settings.image_height, image_width=times * settings.image_width)


def averaged(picture: Tensor, times: int) -> Tensor:
    """Means over squares of so many pixels, (3, H / times, W / times)."""
    return avg_pool2d(picture, times) if times > 1 else picture
