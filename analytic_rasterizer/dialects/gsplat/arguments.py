"""What gsplat's `rasterization` is given: checked before anything is rendered."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch

from ..._C import MAX_CHANNELS
from ...autocast import way_out_of
from ...effects import MAX_SH_DEGREE
from ...footprints import COMPENSATED, DILATED, Footprint, chosen_footprint, resolve_footprint
from ...settings import one_number, whole_number

RENDER_MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")
"""What `rasterization` renders: colours, accumulated depth, expected depth, or both kinds."""
RASTERIZE_MODES = ("classic", "antialiased")
"""Filters of `rasterization`, where no footprint was chosen."""

_REFUSED = {
    "sparse_grad": "gradients are dense tensors",
    "with_ut": "the unscented transform of 3DGUT is not implemented",
    "with_eval3d": "Gaussians are evaluated in the image, not along rays",
    "radial_coeffs": "lenses without distortion only, undistort the images",
    "tangential_coeffs": "lenses without distortion only, undistort the images",
    "thin_prism_coeffs": "lenses without distortion only, undistort the images",
    "ftheta_coeffs": "lenses without distortion only, undistort the images",
    "viewmats_rs": "the shutter is global",
}
"""Arguments of gsplat that are refused, and why."""


@dataclass(frozen=True)
class Sizes:
    """Leading dimensions, and how many cameras and Gaussians there are for each of their indices."""

    batch: tuple[int, ...]
    cameras: int
    gaussians: int


def refuse(asked: dict[str, Any], camera_model: str, rolling_shutter: Any) -> None:
    """Raises NotImplementedError for what gsplat renders and this package does not."""
    for name, value in asked.items():
        if value is not None and value is not False:
            raise NotImplementedError(f"{name} is not supported: {_REFUSED[name]}")
    if rolling_shutter is not None and getattr(rolling_shutter, "name", rolling_shutter) != "GLOBAL":
        raise NotImplementedError(f"rolling_shutter is not supported: the shutter is global; got {rolling_shutter}")
    if camera_model in ("fisheye", "ftheta"):
        raise NotImplementedError(f"camera_model {camera_model!r} is not supported: cameras are pinhole or ortho")
    check_choice("camera_model", camera_model, ("pinhole", "ortho"))


def check_distributed(sizes: Sizes, per_camera: bool) -> None:
    """Raises ValueError for what ranks cannot share."""
    if sizes.batch:
        raise ValueError(f"means must have no leading dimensions where distributed is True, got {sizes.batch}")
    if per_camera:
        raise ValueError("colors must be shared by the cameras where distributed is True, got colors per camera")


def check_choice(name: str, value: str, choices: Sequence[str]) -> None:
    """Raises ValueError for anything else."""
    if value not in choices:
        raise ValueError(f"{name} must be one of {', '.join(choices)}, got {value!r}")


def check_numbers(
    width: int, height: int, near_plane: float, far_plane: float, radius_clip: float, eps2d: float
) -> None:
    """Raises ValueError for numbers that no picture can be rendered with, TypeError for what is no number."""
    for name, value in (("width", width), ("height", height)):
        if whole_number(name, value) < 1:
            raise ValueError(f"{name} must be a positive integer, got {value}")
    if not 0 < one_number("near_plane", near_plane) < one_number("far_plane", far_plane):
        raise ValueError(f"near_plane must be above 0 and below far_plane, got {near_plane} and {far_plane}")
    for name, value in (("radius_clip", radius_clip), ("eps2d", eps2d)):
        if not 0 <= one_number(name, value) < math.inf:
            raise ValueError(f"{name} must be finite and not negative, got {value}")


def _check_tensor(name: str, tensor: Any, like: torch.Tensor, *shapes: tuple[int, ...]) -> None:
    """Raises unless it is a tensor of one of these shapes, of the dtype and on the device of the means."""
    if not isinstance(tensor, torch.Tensor):
        raise TypeError(f"{name} must be a tensor, got {type(tensor).__name__}")
    if tensor.shape not in shapes:
        raise ValueError(f"{name} must have shape {' or '.join(map(str, shapes))}, got {tuple(tensor.shape)}")
    if tensor.device != like.device:
        raise ValueError(f"{name} must be on the device of means, {like.device}, got {tensor.device}")
    if tensor.dtype != like.dtype:
        got = f"{tensor.dtype}{way_out_of(tensor.dtype)}"
        raise TypeError(f"{name} must have the dtype of means, {like.dtype}, got {got}")


def check_scene(means: Any, quats: Any, scales: Any, opacities: Any, covars: Any, viewmats: Any, Ks: Any) -> Sizes:
    """The sizes that means and viewmats have, after checking all against them."""
    for name, tensor, last in (("means", means, (3,)), ("viewmats", viewmats, (4, 4))):
        if not isinstance(tensor, torch.Tensor):
            raise TypeError(f"{name} must be a tensor, got {type(tensor).__name__}")
        dims = len(last) + 1
        if tensor.dim() < dims or tensor.shape[1 - dims :] != last:
            counted = "N" if name == "means" else "C"
            shape = ", ".join(("...", counted, *map(str, last)))
            raise ValueError(f"{name} must have shape ({shape}), got {tuple(tensor.shape)}")
    sizes = Sizes(tuple(means.shape[:-2]), viewmats.shape[-3], means.shape[-2])
    of_gaussians, of_cameras = (*sizes.batch, sizes.gaussians), (*sizes.batch, sizes.cameras)
    if math.prod(of_cameras) == 0:
        raise ValueError(f"viewmats must hold at least one camera, got shape {tuple(viewmats.shape)}")
    if covars is None:
        _check_tensor("quats", quats, means, (*of_gaussians, 4))
        _check_tensor("scales", scales, means, (*of_gaussians, 3))
    else:
        _check_tensor("covars", covars, means, (*of_gaussians, 3, 3))
    _check_tensor("opacities", opacities, means, of_gaussians)
    _check_tensor("viewmats", viewmats, means, (*of_cameras, 4, 4))
    _check_tensor("Ks", Ks, means, (*of_cameras, 3, 3))
    focal = Ks.detach().diagonal(dim1=-2, dim2=-1)[..., :2]
    if not Ks.is_cuda and (focal <= 0).any():  # on CUDA it would wait for the device
        raise ValueError(f"Ks must have positive focal lengths, got {focal[focal <= 0][0].item()}")
    return sizes


def check_colors(
    means: torch.Tensor, sizes: Sizes, colors: Any, backgrounds: Any, sh_degree: int | None, render_mode: str
) -> bool:
    """Whether every camera has colours of its own, after checking them."""
    if not isinstance(colors, torch.Tensor):
        raise TypeError(f"colors must be a tensor, got {type(colors).__name__}")
    last = tuple(colors.shape[-1:]) if sh_degree is None else (*colors.shape[-2:-1], 3)
    shared, own = (
        (*sizes.batch, sizes.gaussians, *last),
        (*sizes.batch, sizes.cameras, sizes.gaussians, *last),
    )
    _check_tensor("colors", colors, means, shared, own)
    most = MAX_CHANNELS if render_mode == "RGB" else MAX_CHANNELS - 1
    if sh_degree is None and "RGB" in render_mode and not 1 <= last[0] <= most:
        raise ValueError(f"colors must have 1 to {most} channels in render_mode {render_mode}, got {last[0]}")
    if sh_degree is not None:
        if sh_degree not in range(MAX_SH_DEGREE + 1):
            raise ValueError(f"sh_degree must be 0 to {MAX_SH_DEGREE}, got {sh_degree}")
        if last[0] < (sh_degree + 1) ** 2:
            raise ValueError(f"colors must have {(sh_degree + 1) ** 2} harmonics of degree {sh_degree}, got {last[0]}")
    if backgrounds is not None:
        _check_tensor("backgrounds", backgrounds, means, (*sizes.batch, sizes.cameras, last[-1]))
    return colors.shape == own


def settle_footprint(footprint: str | Footprint | None, rasterize_mode: str, eps2d: float) -> Footprint:
    """The footprint of a call: as `rasterization` says of its argument. Raises ValueError for one that is not known."""
    if footprint is not None:
        return resolve_footprint(footprint)
    if (chosen := chosen_footprint()) is not None:
        return chosen
    if rasterize_mode == "classic":
        return resolve_footprint(DILATED, dilation=eps2d)
    return resolve_footprint(COMPENSATED, variance=eps2d)
