"""The cameras of gsplat's `rasterization`, as the operators take them."""

from __future__ import annotations

from types import SimpleNamespace

import torch

from ...cameras.lens import SIZE
from ...ops import Op
from .arguments import LENS

_prepare = Op("prepare_cameras")
_MODELS = {"pinhole": "pinhole", "ortho": "orthographic"}  # by camera_model, as are those with coefficients
_LENSES = {"pinhole": "perspective", "fisheye": "fisheye"}
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


def prepared_cameras(
    viewmats: torch.Tensor,
    intrinsics: torch.Tensor,
    coefficients: torch.Tensor | None,
    size: tuple[int, int],
    camera_model: str,
    near: float,
    far: float,
) -> dict[str, torch.Tensor]:
    """What the operators take of the cameras that `flat_cameras` returned, by their names.

    Args:
        size: Width and height of the images, px.

    Raises:
        ValueError: On the CPU, coefficients that are not finite, or with which a lens is no map.
        RuntimeError: On the CPU, a pose that is singular.
    """
    model = _MODELS[camera_model] if coefficients is None else _LENSES[camera_model]
    made = _prepare(
        views=viewmats,
        intrinsics=intrinsics,
        coefficients=coefficients,
        width=size[0],
        height=size[1],
        model=model,
        near=near,
        far=far,
    )
    return dict(zip(_prepare.results, made))
