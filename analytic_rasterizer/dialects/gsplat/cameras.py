"""The cameras of gsplat's `rasterization`, as the operators take them."""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace

import torch

from ...arguments import camera_arguments
from ...camera import camera_matrices
from ...effects import Effects
from ...footprints import Footprint
from ...lens import SIZE, Lens
from ...settings import GaussianRasterizationSettings
from .arguments import LENS

_LENSES = {"pinhole": "perspective", "fisheye": "fisheye"}  # by camera_model
_BEFORE = (0, 6, 8)  # where radial, tangential and thin prism coefficients begin in both (csrc/core/camera/)


def flat_cameras(given: SimpleNamespace) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor | None]:
    """(B * C, 4, 4) poses, (B * C, 3, 3) intrinsics and (B * C, 12) coefficients of lenses in the order of `Lens`.

    None for the latter where there are no lenses.
    """
    viewmats, intrinsics = (t if t.dim() == 3 else t.flatten(0, -3) for t in (given.viewmats, given.Ks))
    parts = [getattr(given, name) for name in LENS]
    if given.camera_model != "fisheye" and all(part is None for part in parts):
        return viewmats, intrinsics, None
    columns = list(viewmats.new_zeros(SIZE, len(viewmats)))
    for part, first in zip(parts, _BEFORE):
        if part is not None:
            columns[first : first + part.shape[-1]] = part.reshape(-1, part.shape[-1]).unbind(1)
    return viewmats, intrinsics, torch.stack(columns, 1)


def prepared_cameras(viewmats, Ks, coefficients, width, height, camera_model, near, far) -> dict[str, torch.Tensor]:
    from ...footprints import resolve_footprint

    settings = settings_of(
        viewmats,
        Ks,
        width,
        height,
        near=near,
        far=far,
        camera_model=camera_model,
        coefficients=coefficients,
        footprint=resolve_footprint("point"),
    )
    args = [camera_arguments(s, viewmats, None, full=True) for s in settings]
    return {n: torch.stack([a[n] for a in args]) for n in ("viewmatrix", "projmatrix", "campos", "lens")}


def settings_of(
    viewmats: torch.Tensor,
    Ks: torch.Tensor,
    width: int,
    height: int,
    *,
    near: float,
    far: float,
    camera_model: str,
    coefficients: torch.Tensor | None,
    footprint: Footprint,
) -> list[GaussianRasterizationSettings]:
    """Settings of all cameras, in the order of their leading dimensions, for `project`.

    Raises:
        ValueError: Coefficients that are not finite, or with which a lens is no map.
    """
    orthographic = camera_model == "ortho"
    background = viewmats.new_zeros(3)  # which `project` does not read
    views, intrinsics = viewmats.reshape(-1, 4, 4).double(), Ks.reshape(-1, 3, 3).double()
    # gsplat reads no more of a view than its first three rows. The last one is w of an orthographic camera.
    last = torch.eye(4, dtype=views.dtype, device=views.device)[3].expand(len(views), 1, 4)
    views = torch.cat([views[:, :3], last], 1)
    fx, fy, cx, cy = (intrinsics[:, row, column] for row, column in ((0, 0), (1, 1), (0, 2), (1, 2)))
    scale = torch.stack([2 * fx / width, 2 * fy / height], 1)
    center = torch.stack([2 * cx / width - 1, 2 * cy / height - 1], 1)
    projections, positions = camera_matrices(views, scale, center, orthographic)
    projections, positions, tangents = (t.to(viewmats.dtype) for t in (projections.mT, positions, 1 / scale))
    lenses: Sequence[Lens | None] = [None] * len(views)
    if coefficients is not None:
        lenses = _lenses(_LENSES[camera_model], coefficients, scale, center)
    return [
        GaussianRasterizationSettings(
            image_height=height,
            image_width=width,
            tanfovx=tangent[0],
            tanfovy=tangent[1],
            bg=background,
            scale_modifier=1.0,
            viewmatrix=view.mT,
            projmatrix=projection,
            sh_degree=0,  # `Scene.project` sets it
            campos=position,
            prefiltered=False,
            debug=False,
            effects=Effects(
                camera_gradients=True,  # keeps the focal lengths on the device
                off_center=True,  # the clamp of x/z and y/z is around the centre of the picture, as in gsplat
                near=near,
                far=far,
                orthographic=orthographic,
                lens=lens,
            ),
            footprint=str(footprint),
        )
        for view, projection, position, tangent, lens in zip(
            viewmats.reshape(-1, 4, 4), projections, positions, tangents, lenses
        )
    ]


def _lenses(model: str, coefficients: torch.Tensor, scale: torch.Tensor, center: torch.Tensor) -> list[Lens]:
    """One per camera. Coefficients that need no gradient are numbers. All numbers are read at once."""
    known = torch.cat([1 / scale, -center / scale, coefficients], 1).detach().cpu()
    differentiable = coefficients.requires_grad and torch.is_grad_enabled()
    lenses = []
    for camera, (tan_x, tan_y, x, y, *numbers) in enumerate(known.tolist()):
        lens = Lens(model, numbers).with_reach((tan_x, tan_y), (x, y))  # also checks the numbers
        lenses.append(Lens(model, coefficients[camera], lens.reach) if differentiable else lens)
    return lenses
