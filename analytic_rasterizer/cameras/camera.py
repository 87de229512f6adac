"""Cameras: `View`; settings from a pose and focal lengths, differentiable in both."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace

import numpy as np
import torch

from .. import _C
from ..checks import check_finite, check_tensors, one_number, whole_number
from ..ops import Op
from ..render.autocast import widened
from ..render.effects import AUTO, NEAR, Effects
from ..render.settings import GaussianRasterizationSettings
from .lens import Lens
from .rotations import product

_prepare = Op("prepare_cameras")


def camera_settings(
    world_to_camera: torch.Tensor,
    width: int,
    height: int,
    fx: float | torch.Tensor,
    fy: float | torch.Tensor,
    cx: float | torch.Tensor | None = None,
    cy: float | torch.Tensor | None = None,
    *,
    bg: torch.Tensor | None = None,
    sh_degree: int = 3,
    scale_modifier: float = 1.0,
    debug: bool = False,
    dtype: torch.dtype = torch.float32,
    device: torch.device | str | None = None,
    effects: Effects | str | None = None,
    lens: Lens | None = None,
    **options,
) -> GaussianRasterizationSettings:
    """Settings of a camera: a pinhole, one with a lens, or with `Effects(orthographic=True)` an orthographic one.

    Gradients flow to every tensor that is given and requires one. The matrices are computed in float64 and rounded
    once.

    Args:
        world_to_camera: (4, 4), acts on column vectors; camera axes x right, y down, z forward. Its upper left
            3x3 need not be a rotation, only invertible, so that it can be differentiated entry by entry.
        width, height: Size of the image, px.
        fx, fy: Focal lengths, px; of an orthographic camera px per world unit. Numbers, or tensors with one.
        cx, cy: Principal point, px, the image spanning [0, width] x [0, height]; None: its centre.
        bg: As in the settings; None: black.
        sh_degree, scale_modifier, debug: As in the settings.
        dtype, device: Of the tensors of the settings: those of the scene. No device: that of world_to_camera.
        effects, **options: As in the settings, the footprint among them.
        lens: Becomes that of the effects, which have no other; None: a pinhole, or that of the effects.

    Raises:
        TypeError: world_to_camera or bg is no tensor, or one of the numbers is none, or the lens.
        ValueError: Effects with another lens; world_to_camera has a wrong shape, a focal length that is a number is not
            positive and finite, a principal point that is one is not finite, or width or height is not a whole number;
            on the CPU world_to_camera is not finite (elsewhere the host would have to wait for the device).
    """
    width, height = whole_number("width", width), whole_number("height", height)
    check_tensors(None, world_to_camera=world_to_camera, **({} if bg is None else {"bg": bg}))
    if world_to_camera.shape != (4, 4):
        raise ValueError(f"world_to_camera must have shape (4, 4), got {tuple(world_to_camera.shape)}")
    if world_to_camera.device.type == "cpu" and not torch.compiler.is_compiling():
        check_finite(world_to_camera=world_to_camera)
    _check_intrinsics(fx=fx, fy=fy, cx=cx, cy=cy)
    if lens is not None:
        effects = _with_lens(effects, lens)
    view = world_to_camera.double()
    cx, cy = width / 2 if cx is None else cx, height / 2 if cy is None else cy
    orthographic = isinstance(effects, Effects) and effects.orthographic
    known = not any(isinstance(value, torch.Tensor) for value in (fx, fy, cx, cy))
    where = "cpu" if known else view.device
    fx, fy, cx, cy = (torch.as_tensor(v, dtype=torch.float64, device=where).reshape(()) for v in (fx, fy, cx, cy))
    tangents = width / (2 * fx), height / (2 * fy)
    if isinstance(effects, Effects) and effects.lens is not None and known:
        middle = (width / 2 - cx) / fx, (height / 2 - cy) / fy
        effects = replace(effects, lens=effects.lens.with_reach(tangents, middle, height))
    matrices = _matrices(view, (fx, fy, cx, cy), (width, height), "orthographic" if orthographic else "pinhole")
    # Numbers, unless their gradient may be asked for: reading them later makes the host wait for the device.
    asked_for = isinstance(effects, Effects) and effects.camera_gradients
    if not (asked_for or any(t.requires_grad for t in tangents)):
        tangents = tuple(t.item() for t in tangents)
    to = {"dtype": dtype, "device": view.device if device is None else device}
    viewmatrix, projmatrix, campos = (matrix.to(**to) for matrix in matrices)
    return GaussianRasterizationSettings(
        image_height=height,
        image_width=width,
        tanfovx=tangents[0],
        tanfovy=tangents[1],
        bg=torch.zeros(3, **to) if bg is None else bg.to(**to),
        scale_modifier=scale_modifier,
        viewmatrix=viewmatrix,
        projmatrix=projmatrix,
        sh_degree=sh_degree,
        campos=campos,
        prefiltered=False,
        debug=debug,
        effects=effects,
        **options,
    )


def _check_intrinsics(**numbers: float | torch.Tensor | None) -> None:
    """Raises TypeError or ValueError for what is no focal length or principal point.

    The value of a tensor is not examined: on a device the host would have to wait.
    """
    for name, value in numbers.items():
        if isinstance(value, torch.Tensor):
            if value.numel() != 1:
                raise ValueError(f"{name} must be one number, got a tensor of shape {tuple(value.shape)}")
        elif name in ("fx", "fy"):
            if not 0 < one_number(name, value) < math.inf:
                raise ValueError(f"{name} must be positive and finite, got {value}")
        elif value is not None and not math.isfinite(one_number(name, value)):
            raise ValueError(f"{name} must be finite, got {value}")


def _matrices(
    view: torch.Tensor, intrinsics: tuple[torch.Tensor, ...], size: tuple[int, int], model: str
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """viewmatrix (4, 4), projmatrix (4, 4) and campos (3,) as the settings have them, float64.

    Args:
        view: (4, 4) float64, world to camera.
        intrinsics: fx, fy, cx, cy, each () float64, px.
        size: (width, height), px.
        model: "pinhole" or "orthographic".
    """
    fx, fy, cx, cy = intrinsics
    zero, one = fx.new_zeros(()), fx.new_ones(())
    matrix = torch.stack([fx, zero, cx, zero, fy, cy, zero, zero, one]).reshape(1, 3, 3).to(view.device)
    camera = {"views": view[None], "intrinsics": matrix, "coefficients": None, "model": model}
    viewmatrix, projmatrix, campos, _ = _prepare(**camera, width=size[0], height=size[1], near=NEAR, far=math.inf)
    return viewmatrix[0], projmatrix[0], campos[0]


def _with_lens(effects: Effects | str | None, lens: Lens) -> Effects | str:
    """The effects of a camera with a lens. Harmonics of "auto" are used in full then."""
    if effects is None or effects == AUTO:
        return Effects(lens=lens)
    if not isinstance(effects, Effects):
        return effects  # which the settings refuse
    if effects.lens is not None and effects.lens != lens:
        raise ValueError(f"effects.lens must be None where the camera has a lens, got {effects.lens}")
    return replace(effects, lens=lens)


def moved(world_to_camera: torch.Tensor, tangent: torch.Tensor) -> torch.Tensor:
    """The camera after a small motion, exp(tangent) @ world_to_camera: a pose in the tangent space of SE(3).

    Differentiable, also at zero: optimise `tangent` from zeros, and the pose stays rigid.

    Args:
        world_to_camera: (4, 4).
        tangent: (6,) of se(3) along and around the camera's axes: translation, world units, then rotation, rad.

    Raises:
        TypeError: Not a tensor, or world_to_camera is of integers.
        ValueError: Wrong shapes.
    """
    check_tensors(None, world_to_camera=world_to_camera, tangent=tangent)
    if not world_to_camera.is_floating_point():  # they would round the motion away
        raise TypeError(f"world_to_camera must have a floating-point dtype, got {world_to_camera.dtype}")
    if world_to_camera.shape != (4, 4) or tangent.shape != (6,):
        raise ValueError(
            "world_to_camera must have shape (4, 4) and tangent (6,), got "
            f"{tuple(world_to_camera.shape)} and {tuple(tangent.shape)}"
        )
    x, y, z, rx, ry, rz = tangent.to(world_to_camera)
    zero = torch.zeros_like(x)
    rows = ((zero, -rz, ry, x), (rz, zero, -rx, y), (-ry, rx, zero, z), (zero,) * 4)
    twist = torch.stack([torch.stack(row) for row in rows])
    # Its matrix products are rounded like others, except in float64.
    motion = torch.linalg.matrix_exp(twist.double()).to(twist)
    return product(motion, world_to_camera)


def view_center(view: torch.Tensor, proj: torch.Tensor) -> torch.Tensor:
    """(2,) x/z and y/z at the centre of the picture, where clip_x = p_xx x + p_xz z is zero. Without gradient."""
    view, proj = widened(view.detach()), widened(proj.detach())
    view, proj = view.reshape(4, 4)[:3, :3], proj.reshape(4, 4)[:3, :2]  # transposed: they act on row vectors
    p = product(view.T, proj) / (view**2).sum(0)[:, None]
    return -p[2] / p.diagonal()


def is_orthographic(settings) -> bool:
    """Whether w of clip space is the same everywhere."""
    w = settings.projmatrix.detach().reshape(4, 4)[:, 3]
    return (w[:3].abs().max() <= 1e-6 * w[3].abs()).item()


def is_off_center(settings) -> bool:
    """Whether an edge of the picture is more than FRUSTUM_CLAMP half pictures away from the optical axis."""
    center = view_center(settings.viewmatrix.double(), settings.projmatrix.double())
    tangents = center.new_tensor([float(settings.tanfovx), float(settings.tanfovy)])
    return (1 + (center / tangents).abs().max() > _C.FRUSTUM_CLAMP + 1e-6).item()


@dataclass(frozen=True)
class View:
    """A camera with the size of its picture.

    Attributes:
        name: Of the picture, without directory and suffix.
        width, height: Size of the picture, px.
        fx, fy: Focal lengths, px.
        w2c: (4, 4) float64, world to camera; x right, y down, z forward (OpenCV).
        cx, cy: Principal point, px, the picture spanning [0, width] x [0, height]; None: its centre.
        offset: (x, y, z), world units: positions in the world are those of w2c plus this. None: they are the same.
        lens: How its picture differs from that of a pinhole; None: not at all.
    """

    name: str
    width: int
    height: int
    fx: float
    fy: float
    w2c: torch.Tensor
    cx: float | None = None
    cy: float | None = None
    offset: tuple[float, float, float] | None = None
    lens: Lens | None = None

    def __post_init__(self):
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, np.generic):  # which JSON does not hold
                object.__setattr__(self, field.name, value.item())

    def __eq__(self, other) -> bool:  # that of a dataclass fails at the tensor
        if not isinstance(other, View):
            return NotImplemented
        same_pose = self.w2c is other.w2c or torch.equal(self.w2c, other.w2c)
        return same_pose and self._other_fields() == other._other_fields()

    def __hash__(self) -> int:
        return hash(self._other_fields())

    def _other_fields(self) -> tuple:
        return tuple(getattr(self, field.name) for field in fields(self) if field.name != "w2c")

    @property
    def middle(self) -> tuple[float, float]:
        """(cx, cy), px."""
        return self.width / 2 if self.cx is None else self.cx, self.height / 2 if self.cy is None else self.cy

    def pixels_of(self, points: torch.Tensor) -> torch.Tensor:
        """(N, 2) where points (N, 3) in the camera's frame are in the picture, px, float64; NaN where nowhere."""
        points = points.double()
        if self.lens is None:
            positions = torch.where(points[:, 2:] > 0, points[:, :2] / points[:, 2:], math.nan)
        else:
            positions = self.lens.project(points)[0].to(points.device)
        return positions * points.new_tensor([self.fx, self.fy]) + points.new_tensor(self.middle)

    def rays_of(self, pixels: torch.Tensor) -> torch.Tensor:
        """(N, 3) unit vectors in the camera's frame that pixels (N, 2) show, float64; NaN for pixels that show none."""
        pixels = pixels.double()
        positions = (pixels - pixels.new_tensor(self.middle)) / pixels.new_tensor([self.fx, self.fy])
        if self.lens is None:
            return torch.nn.functional.normalize(torch.cat([positions, torch.ones_like(positions[:, :1])], 1), dim=1)
        return self.lens.unproject(positions).to(pixels.device)

    def depths_of(self, points: torch.Tensor) -> torch.Tensor:
        """(N,) depths of points (N, 3) in the camera's frame, world units.

        They are z, or with a fisheye or an equirectangular lens the distance from the camera.
        """
        return points[:, 2] if self.lens is None else self.lens.depths(points)

    def in_frame(self, offset: tuple[float, float, float] | None) -> View:
        """The same camera with positions relative to another offset, as those of a scene with this offset are.

        Offsets are in world units; None is zero.
        """
        zero = (0.0, 0.0, 0.0)
        if (self.offset or zero) == (offset or zero):
            return self
        shift = [to - of for to, of in zip(offset or zero, self.offset or zero)]
        w2c = self.w2c.double().clone()
        w2c[:3, 3] += w2c[:3, :3] @ w2c.new_tensor(shift)
        return replace(self, w2c=w2c, offset=offset)

    def size(self, scale: float = 1.0) -> tuple[int, int]:
        """(width, height) of the picture at `scale`: rounded, at least 1."""
        return max(1, round(self.width * scale)), max(1, round(self.height * scale))

    def scaled(self, scale: float) -> View:
        """The view with `size(scale)` pixels over the same field of view.

        Raises:
            ValueError: A scale that is not positive and finite.
        """
        if not (math.isfinite(scale) and scale > 0):
            raise ValueError(f"scale must be positive and finite, got {scale}")
        return self.resized(*self.size(scale))

    def resized(self, width: int, height: int) -> View:
        """The view with `width` x `height` pixels over the same field of view."""
        x, y = width / self.width, height / self.height
        cx, cy = (c if c is None else c * factor for c, factor in ((self.cx, x), (self.cy, y)))
        return replace(self, width=width, height=height, fx=x * self.fx, fy=y * self.fy, cx=cx, cy=cy)

    def framed(self, scale: int, crop: tuple[int, int] | None = None) -> View:
        """The view at 1/`scale` of its size, or the middle `crop` = (width, height) of that.

        Pixels become `scale` times as large: where the size is not a multiple of `scale`, the remainder at the right
        and at the bottom is cut off. A crop larger than the picture has no effect. A cropped view is a narrower
        camera, not a part of a picture.
        """
        size = [max(1, length // scale) for length in (self.width, self.height)]
        width, height = size if crop is None else map(min, size, crop)
        cx, cy = (c / scale - (have - want) // 2 for c, have, want in zip(self.middle, size, (width, height)))
        return replace(self, width=width, height=height, fx=self.fx / scale, fy=self.fy / scale, cx=cx, cy=cy)

    def settings(
        self,
        scale: float = 1.0,
        background=(0.0, 0.0, 0.0),
        sh_degree: int = 3,
        footprint: str | None = None,
        *,
        device="cpu",
        **options,
    ) -> GaussianRasterizationSettings:
        """Settings that render this view with `size(scale)` pixels over the same field of view.

        Args:
            scale: Of the picture.
            background: (r, g, b) in [0, 1].
            sh_degree, footprint, options: As in `camera_settings`; no footprint: the default.
            device: Of the tensors of the settings.

        Raises:
            ValueError: A scale that is not positive, and what the settings raise.
        """
        view = self.scaled(scale)
        return camera_settings(
            view.w2c,
            view.width,
            view.height,
            view.fx,
            view.fy,
            view.cx,
            view.cy,
            bg=torch.tensor(background, dtype=torch.float32, device="cpu"),
            sh_degree=sh_degree,
            footprint=footprint,
            device=device,
            lens=view.lens,
            **options,
        )
