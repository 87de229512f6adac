"""What gsplat's `rasterization` is given: checked before anything is rendered."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from types import SimpleNamespace
from typing import Any

import torch

from ..._C import MAX_CHANNELS
from ...checks import check_finite, one_number, whole_number
from ...footprints import COMPENSATED, DILATED, Footprint, chosen_footprint, resolve_footprint
from ...render.autocast import way_out_of
from ...render.effects import MAX_SH_DEGREE
from ...render.order import CENTER, check_order

RENDER_MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED", "d", "Ed", "RGB-d", "RGB-Ed")
"""What `rasterization` renders: colours, accumulated or expected depth, distance along the ray, or both kinds."""
RASTERIZE_MODES = ("classic", "antialiased")
"""Filters of `rasterization`, where no footprint was chosen."""
CAMERA_MODELS = ("pinhole", "ortho", "fisheye")
"""Cameras of `rasterization`; the first and the last may have coefficients of a lens."""

LENS = ("radial_coeffs", "tangential_coeffs", "thin_prism_coeffs")
"""Arguments that hold coefficients of lenses."""
CAMERAS = ("viewmats", "Ks", *LENS)
"""Arguments that describe cameras."""
TENSORS = ("means", "quats", "scales", "opacities", "colors", "covars", "backgrounds", "extra_signals", *CAMERAS)
"""Arguments that are tensors."""

_RADIAL = {"pinhole": 6, "fisheye": 4}  # coefficients
_NOT_CAMERAS = ("ftheta", "lidar")  # of gsplat
_REFUSED = {
    "sparse_grad": "gradients are dense tensors",
    "with_eval3d": "Gaussians are evaluated in the image, not along rays",
    "rays": "rays are those of the camera",
    "ftheta_coeffs": "lenses are those of OpenCV",
    "lidar_coeffs": "cameras are pinhole, ortho or fisheye",
    "external_distortion_coeffs": "nothing but the lens bends rays",
    "viewmats_rs": "the shutter is global",
    "ut_params": "the unscented transform of 3DGUT is not implemented",
}
"""Arguments of gsplat that are refused, and why."""


@dataclass(frozen=True)
class Sizes:
    """Leading dimensions, and how many cameras and Gaussians there are for each of their indices."""

    batch: tuple[int, ...]
    cameras: int
    gaussians: int


@dataclass(frozen=True)
class Mode:
    """What a render mode asks for.

    Attributes:
        colors, depth: Whether there are channels of colours, and one of depth.
        distance: Whether depth is the distance along the ray.
        expected: Whether depth is divided by alpha.
    """

    colors: bool
    depth: bool
    distance: bool
    expected: bool

    @classmethod
    @lru_cache
    def of(cls, render_mode: str) -> Mode:
        """Of one of `RENDER_MODES`."""
        depth = render_mode.removeprefix("RGB").lstrip("+-")
        return cls(render_mode.startswith("RGB"), bool(depth), depth.endswith("d"), depth.startswith("E"))


@dataclass(frozen=True)
class Call:
    """A call of `rasterization`, whose arguments are right.

    Attributes:
        given: The arguments by their names.
        colors, extra: What Gaussians carry, or None.
    """

    given: SimpleNamespace
    sizes: Sizes
    mode: Mode
    colors: Signal | None
    extra: Signal | None
    footprint: Footprint


def checked(given: SimpleNamespace) -> Call:
    """Raises what `rasterization` does for wrong arguments, before anything is rendered."""
    g = given
    refuse(g)
    check_choice("render_mode", g.render_mode, RENDER_MODES)
    check_choice("rasterize_mode", g.rasterize_mode, RASTERIZE_MODES)
    check_numbers(g.width, g.height, g.near_plane, g.far_plane, g.radius_clip, g.eps2d)
    sizes = check_scene(g.means, g.quats, g.scales, g.opacities, g.covars, g.viewmats, g.Ks)
    check_lens(g, sizes)
    check_order(g.order)
    if g.distributed and g.order != CENTER:
        raise NotImplementedError(f"order must be {CENTER!r} with distributed=True, got {g.order!r}")
    colors = check_colors(g.means, sizes, g.colors, g.backgrounds, g.sh_degree, g.render_mode)
    if g.return_normals and g.covars is not None:
        raise ValueError("covars must be None where return_normals is True: normals are axes of quats")
    mode = Mode.of(g.render_mode)
    others = (colors.channels if colors is not None and mode.colors else 0) + mode.depth + 3 * bool(g.return_normals)
    extra = check_extra(g.means, sizes, g.extra_signals, g.extra_signals_sh_degree, others)
    if g.distributed:
        check_distributed(sizes, colors=colors, extra_signals=extra)
    return Call(g, sizes, mode, colors, extra, settle_footprint(g.footprint, g.rasterize_mode, g.eps2d))


def refuse(given: SimpleNamespace) -> None:
    """Raises NotImplementedError for what gsplat renders and this package does not.

    `with_ut` is what gsplat demands for a lens. Here a lens needs no unscented transform, so that it may be asked for.
    """
    for name, why in _REFUSED.items():
        value = getattr(given, name)
        if value is not None and value is not False:
            raise NotImplementedError(f"{name} is not supported: {why}")
    camera_model, rolling_shutter = given.camera_model, given.rolling_shutter
    if given.with_ut and camera_model != "fisheye" and all(getattr(given, name) is None for name in LENS):
        raise NotImplementedError(
            "with_ut is not supported: the unscented transform of 3DGUT is not implemented; with a lens it may be "
            "True, and the lens is exact"
        )
    if rolling_shutter is not None and getattr(rolling_shutter, "name", rolling_shutter) != "GLOBAL":
        raise NotImplementedError(f"rolling_shutter is not supported: the shutter is global; got {rolling_shutter}")
    if camera_model in _NOT_CAMERAS:
        raise NotImplementedError(
            f"camera_model {camera_model!r} is not supported: cameras are {', '.join(CAMERA_MODELS)}"
        )
    check_choice("camera_model", camera_model, CAMERA_MODELS)


def check_lens(given: SimpleNamespace, sizes: Sizes) -> None:
    """Raises for coefficients that are none of the camera's."""
    for name, count in zip(LENS, (_RADIAL.get(given.camera_model), 2, 4)):
        tensor = getattr(given, name)
        if tensor is None:
            continue
        if given.camera_model == "ortho":
            raise ValueError(f"{name} must be None where camera_model is 'ortho'")
        _check_tensor(name, tensor, given.means, (*sizes.batch, sizes.cameras, count))


def check_distributed(sizes: Sizes, **signals: Signal | None) -> None:
    """Raises ValueError for what ranks cannot share."""
    if sizes.batch:
        raise ValueError(f"means must have no leading dimensions where distributed is True, got {sizes.batch}")
    for name, signal in signals.items():
        if signal is not None and signal.per_camera:
            raise ValueError(f"{name} must be shared by the cameras where distributed is True, got {name} per camera")


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
    if Ks.device.type == "cpu" and not torch.compiler.is_compiling():  # on CUDA it would wait for the device
        numbers = Ks.detach().flatten().tolist()
        for focal in (*numbers[0::9], *numbers[4::9]):
            if focal <= 0:
                raise ValueError(f"Ks must have positive focal lengths, got {focal}")
    return sizes


def check_finite_cameras(viewmats: torch.Tensor, Ks: torch.Tensor) -> None:
    """Raises ValueError with the place of the first number that is not finite, of those that are read."""
    check_finite(viewmats=viewmats[..., :3, :], Ks=Ks[..., :2, :])


@dataclass(frozen=True)
class Signal:
    """What Gaussians carry: colours, or extra signals.

    Attributes:
        values: (..., N, D), or of harmonics (..., N, K, D); with C before N if `per_camera`.
        degree: Of the harmonics in use; None: there are none.
        per_camera: Whether every camera has values of its own.
    """

    values: torch.Tensor
    degree: int | None
    per_camera: bool

    @property
    def channels(self) -> int:
        """D."""
        return self.values.shape[-1]


def check_signal(
    name: str, means: torch.Tensor, sizes: Sizes, values: Any, degree: Any, degree_name: str, channels: int | None
) -> Signal:
    """The signal, after checking it. Harmonics without leading dimensions serve every batch index, as in gsplat 1.6.

    Args:
        channels: How many harmonics must have; None: any number.
    """
    if not isinstance(values, torch.Tensor):
        raise TypeError(f"{name} must be a tensor, got {type(values).__name__}")
    last = tuple(values.shape[-1:])
    if degree is not None:
        last = (*values.shape[-2:-1], *(last if channels is None else (channels,)))
    of_all = sizes.gaussians, *last
    shapes = [(*sizes.batch, *of_all), (*sizes.batch, sizes.cameras, *of_all)]
    if degree is not None and sizes.batch:
        shapes.append(of_all)
    if degree is not None and values.shape not in shapes:
        of_one = f"{sizes.gaussians}, K, {channels or 'E'}"
        of_batch = "".join(f"{size}, " for size in sizes.batch)
        expected = f"({of_batch}{of_one}) or ({of_batch}{sizes.cameras}, {of_one}) of K harmonics"
        raise ValueError(f"{name} must have shape {expected}, got {tuple(values.shape)}")
    _check_tensor(name, values, means, *shapes)
    if degree is not None:
        if degree not in range(MAX_SH_DEGREE + 1):
            raise ValueError(f"{degree_name} must be 0 to {MAX_SH_DEGREE}, got {degree}")
        if last[0] < (degree + 1) ** 2:
            raise ValueError(f"{name} must have {(degree + 1) ** 2} harmonics of degree {degree}, got {last[0]}")
    per_camera = values.shape == shapes[1]
    if not per_camera and values.shape != shapes[0]:
        values = values.expand(shapes[0])
    return Signal(values, degree, per_camera)


def check_colors(
    means: torch.Tensor, sizes: Sizes, colors: Any, backgrounds: Any, sh_degree: int | None, render_mode: str
) -> Signal | None:
    """The colours, after checking them; None where there are none, which depth alone allows."""
    mode = Mode.of(render_mode)
    if colors is None and not mode.colors:
        return None
    signal = check_signal("colors", means, sizes, colors, sh_degree, "sh_degree", 3)
    most = MAX_CHANNELS - mode.depth
    if sh_degree is None and mode.colors and not 1 <= signal.channels <= most:
        raise ValueError(f"colors must have 1 to {most} channels in render_mode {render_mode}, got {signal.channels}")
    if backgrounds is not None:
        _check_tensor("backgrounds", backgrounds, means, (*sizes.batch, sizes.cameras, signal.channels))
    return signal


def check_extra(
    means: torch.Tensor, sizes: Sizes, extra_signals: Any, degree: int | None, others: int
) -> Signal | None:
    """The extra signals, after checking them, beside as many other channels; None where there are none."""
    if extra_signals is None:
        if degree is not None:
            raise ValueError(f"extra_signals_sh_degree must be None without extra_signals, got {degree}")
        if others > MAX_CHANNELS:
            raise ValueError(f"channels must be at most {MAX_CHANNELS}, depth and normals included, got {others}")
        return None
    name = "extra_signals_sh_degree"
    signal = check_signal("extra_signals", means, sizes, extra_signals, degree, name, None)
    if not 1 <= signal.channels <= MAX_CHANNELS - others:
        most = MAX_CHANNELS - others
        raise ValueError(f"extra_signals must have 1 to {most} channels beside the others, got {signal.channels}")
    return signal


def settle_footprint(footprint: str | Footprint | None, rasterize_mode: str, eps2d: float) -> Footprint:
    """The footprint of a call: as `rasterization` says of its argument. Raises ValueError for one that is not known."""
    if footprint is not None:
        return resolve_footprint(footprint)
    if (chosen := chosen_footprint()) is not None:
        return chosen
    return _filter(rasterize_mode, eps2d)


@lru_cache
def _filter(rasterize_mode: str, eps2d: float) -> Footprint:
    """gsplat's own, of a mode."""
    if rasterize_mode == "classic":
        return resolve_footprint(DILATED, dilation=eps2d)
    return resolve_footprint(COMPENSATED, variance=eps2d)
