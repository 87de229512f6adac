"""Cameras: the matrices of a pose and focal lengths, with gradients to both, and the numbers that the ops read."""

from __future__ import annotations

from typing import Any

import torch

from .effects import Defocus, Effects, Motion

FRUSTUM_CLAMP = 1.3  # half pictures from the optical axis: kFrustumClamp of csrc/core/constants.h
_DEPTH_RANGE = (0.01, 100.0)  # of clip-space z, which nothing reads


def camera_fields(
    world_to_camera: torch.Tensor,
    width: int,
    height: int,
    fx: float | torch.Tensor,
    fy: float | torch.Tensor,
    cx: float | torch.Tensor | None = None,
    cy: float | torch.Tensor | None = None,
    *,
    dtype: torch.dtype = torch.float32,
    device: torch.device | str | None = None,
    effects: Effects | str | None = None,
) -> dict[str, Any]:
    """The fields of `GaussianRasterizationSettings` that describe a camera; `camera_settings` makes settings of them.

    Arguments and errors are those of `camera_settings`.

    Returns:
        image_height, image_width: As given.
        tanfovx, tanfovy: Tangents of half the field of view: numbers, or with `Effects(camera_gradients=True)` float64
            tensors on the device of world_to_camera.
        viewmatrix, projmatrix: (4, 4), transposed.
        campos: (3,).
    """
    if world_to_camera.shape != (4, 4):
        raise ValueError(f"world_to_camera must have shape (4, 4), got {tuple(world_to_camera.shape)}")
    for name, value in (("fx", fx), ("fy", fy)):
        if not isinstance(value, torch.Tensor) and not value > 0:
            raise ValueError(f"{name} must be positive, got {value}")
    view = world_to_camera.double()
    fx, fy, cx, cy = (
        torch.as_tensor(v, dtype=torch.float64, device=view.device).reshape(())
        for v in (fx, fy, width / 2 if cx is None else cx, height / 2 if cy is None else cy)
    )
    orthographic = isinstance(effects, Effects) and effects.orthographic
    tangents = width / (2 * fx), height / (2 * fy)
    zero, one = view.new_zeros(()), view.new_ones(())
    near, far = _DEPTH_RANGE
    # The principal point in clip space, where the image spans [-1, 1] x [-1, 1].
    x, y = 2 * cx / width - 1, 2 * cy / height - 1
    along = (zero, zero, x, y) if orthographic else (x, y, zero, zero)
    projection = torch.stack([
        torch.stack([1 / tangents[0], zero, along[0], along[2]]),
        torch.stack([zero, 1 / tangents[1], along[1], along[3]]),
        view.new_tensor([0, 0, far / (far - near), -far * near / (far - near)]),
        torch.stack([zero, zero, zero, one] if orthographic else [zero, zero, one, zero]),
    ])  # fmt: skip
    if not (isinstance(effects, Effects) and effects.camera_gradients):
        tangents = tuple(t.item() for t in tangents)
    position = -torch.linalg.solve(view[:3, :3], view[:3, 3])
    to = {"dtype": dtype, "device": view.device if device is None else device}
    return {
        "image_height": height,
        "image_width": width,
        "tanfovx": tangents[0],
        "tanfovy": tangents[1],
        "viewmatrix": view.T.to(**to).contiguous(),
        "projmatrix": (projection @ view).T.to(**to).contiguous(),
        "campos": position.to(**to),
    }


def moved(world_to_camera: torch.Tensor, tangent: torch.Tensor) -> torch.Tensor:
    """The camera after a small motion, exp(tangent) @ world_to_camera: a pose in the tangent space of SE(3).

    Differentiable, also at zero: optimise `tangent` from zeros, and the pose stays rigid.

    Args:
        world_to_camera: (4, 4).
        tangent: (6,) of se(3) along and around the camera's axes: translation, world units, then rotation, rad.

    Raises:
        ValueError: Wrong shapes.
    """
    if world_to_camera.shape != (4, 4) or tangent.shape != (6,):
        raise ValueError(
            "world_to_camera must have shape (4, 4) and tangent (6,), got "
            f"{tuple(world_to_camera.shape)} and {tuple(tangent.shape)}"
        )
    x, y, z, rx, ry, rz = tangent.to(world_to_camera)
    zero = torch.zeros_like(x)
    rows = ((zero, -rz, ry, x), (rz, zero, -rx, y), (-ry, rx, zero, z), (zero,) * 4)
    twist = torch.stack([torch.stack(row) for row in rows])
    return torch.linalg.matrix_exp(twist) @ world_to_camera


def make_lens(effects: Effects, settings, like: torch.Tensor) -> torch.Tensor:
    """The op's argument `lens`: the numbers of `Lens` in csrc/core/lens.h, in its order.

    Args:
        effects: What the projection has beyond a pinhole.
        settings: A `GaussianRasterizationSettings`.
        like: A tensor whose dtype and device the result takes.
    """
    tangents = (settings.tanfovx, settings.tanfovy)
    if not effects.camera_gradients:
        tangents = (float(t) for t in tangents)
    center = (0.0, 0.0)
    if effects.off_center:
        center = (view_center(settings.viewmatrix, settings.projmatrix, effects.camera_gradients),)
    defocus, motion = effects.defocus or Defocus(0.0, 1.0), effects.motion or Motion(0.0)
    streaks = [
        _times(motion.exposure, value, length)
        for value, length in ((motion.velocity, 3), (motion.angular_velocity, 3), (motion.screen_velocity, 2))
    ]
    numbers = (
        *tangents, *center, defocus.aperture, defocus.focus, *streaks, effects.near, effects.far,
        float(effects.orthographic),
    )  # fmt: skip
    # Neighbouring numbers are copied to the device together; the last three are never tensors.
    parts, floats = [], []
    for number in numbers:
        if isinstance(number, torch.Tensor):
            parts += [_copied(floats, like)] if floats else []
            parts.append(number.to(like).reshape(-1))
            floats = []
        else:
            floats += number if isinstance(number, list) else [float(number)]
    last = _copied(floats, like)
    return torch.cat([*parts, last]) if parts else last


def _copied(numbers: list[float], like: torch.Tensor) -> torch.Tensor:
    """A tensor like `like`. It is copied from pinned memory: otherwise the host would wait for all earlier work."""
    if like.is_cuda and torch.cuda.is_current_stream_capturing():
        # A replay would copy from host memory that has been reused since.
        raise RuntimeError("effects of the camera cannot be captured in a CUDA graph")
    host = torch.tensor(numbers, dtype=like.dtype, pin_memory=like.is_cuda)
    return host.to(like.device, non_blocking=True)


def _times(exposure, velocity, length: int):
    """exposure * velocity, `length` numbers: a tensor if one of the two is a tensor, otherwise a list."""
    if velocity is None:
        return [0.0] * length
    if isinstance(exposure, torch.Tensor) and not isinstance(velocity, torch.Tensor):
        velocity = exposure.new_tensor(velocity)
    if isinstance(velocity, torch.Tensor):
        exposure = exposure.to(velocity).reshape(()) if isinstance(exposure, torch.Tensor) else exposure
        return exposure * velocity
    return [exposure * v for v in velocity]


def view_center(view: torch.Tensor, proj: torch.Tensor, with_gradient: bool) -> torch.Tensor:
    """(2,) x/z and y/z at the centre of the picture, where clip_x = p_xx x + p_xz z is zero."""
    view, proj = view.reshape(4, 4)[:3, :3], proj.reshape(4, 4)[:3, :2]  # transposed: they act on row vectors
    if not with_gradient:
        view, proj = view.detach(), proj.detach()
    p = view.T @ proj / (view**2).sum(0)[:, None]
    return -p[2] / p.diagonal()


def is_orthographic(settings) -> bool:
    """Whether w of clip space is the same everywhere."""
    w = settings.projmatrix.detach().reshape(4, 4)[:, 3]
    return (w[:3].abs().max() <= 1e-6 * w[3].abs()).item()


def is_off_center(settings) -> bool:
    """Whether an edge of the picture is more than FRUSTUM_CLAMP half pictures away from the optical axis."""
    center = view_center(settings.viewmatrix.double(), settings.projmatrix.double(), with_gradient=False)
    tangents = center.new_tensor([float(settings.tanfovx), float(settings.tanfovy)])
    return (1 + (center / tangents).abs().max() > FRUSTUM_CLAMP + 1e-6).item()


def projected_sigmas(settings, means3D: torch.Tensor, scales: torch.Tensor, rotations: torch.Tensor) -> torch.Tensor:
    """(P,) smaller standard deviation of every Gaussian in the image, px, before the footprint [EWA, Eq. 29-31].

    This repeats the projection of csrc/core/project.h, with its clamp around the optical axis, because no op returns
    the projected covariance. It is the square root of the smaller eigenvalue of that.
    """
    view = settings.viewmatrix.detach().reshape(4, 4)
    x, y, z = (means3D @ view[:3, :3] + view[3, :3]).unbind(1)
    flat = isinstance(settings.effects, Effects) and settings.effects.orthographic
    depth, side = (torch.ones_like(z), 0) if flat else (z, FRUSTUM_CLAMP)
    # Row i of the axes: s_i times column i of the rotation of the quaternion (w, u).
    w, u = torch.nn.functional.normalize(rotations, dim=1)[:, None].split([1, 3], -1)
    axes = torch.diag_embed(scales)
    u = u.expand_as(axes)
    turn = 2 * torch.linalg.cross(u, axes)
    axes = settings.scale_modifier * (axes + w * turn + torch.linalg.cross(u, turn)) @ view[:3, :3]
    rows = []
    for a, b, tan, size in (
        (0, x, settings.tanfovx, settings.image_width),
        (1, y, settings.tanfovy, settings.image_height),
    ):
        slope = (b / z).clamp(-side * tan, side * tan)[:, None]
        rows.append(size / (2 * tan) * (axes[:, :, a] - slope * axes[:, :, 2]) / depth[:, None])
    xx, xy, yy = (rows[0] ** 2).sum(1), (rows[0] * rows[1]).sum(1), (rows[1] ** 2).sum(1)
    largest = (xx + yy) / 2 + torch.hypot((xx - yy) / 2, xy)
    area = torch.linalg.cross(rows[0], rows[1]).norm(dim=1)
    return torch.where(largest > 0, area / largest.sqrt(), 0)
