"""Cameras from a pose and focal lengths, with gradients to both."""

from __future__ import annotations

import torch

from .effects import Effects
from .rasterizer import GaussianRasterizationSettings

_DEPTH_RANGE = (0.01, 100.0)  # of clip-space z, which nothing reads


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
    **options,
) -> GaussianRasterizationSettings:
    """Settings of a pinhole camera, or with `Effects(orthographic=True)` of an orthographic one.

    With `Effects(camera_gradients=True)` gradients flow to every tensor given, on the CPU or a device. The matrices
    are put together in float64 and rounded once.

    Args:
        world_to_camera: (4, 4), acts on column vectors; camera axes x right, y down, z forward. Its upper left
            3x3 may be any matrix that can be inverted, which matters to the derivative, not to a rotation.
        width, height: Size of the image, px.
        fx, fy: Focal lengths, px; of an orthographic camera px per world unit. Numbers, or tensors with one.
        cx, cy: Principal point, px, the image spanning [0, width] x [0, height]; None: its centre.
        bg: As in the settings; None: black.
        sh_degree, scale_modifier, debug: As in the settings.
        dtype, device: Of the tensors of the settings: those of the scene. No device: that of world_to_camera.
        effects, **options: As in the settings, the footprint among them.

    Raises:
        ValueError: world_to_camera has a wrong shape, or a focal length that is a number is not positive.
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
    # In clip space the principal point is where it is in the image, whose halves are 1 long.
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
    return GaussianRasterizationSettings(
        image_height=height,
        image_width=width,
        tanfovx=tangents[0],
        tanfovy=tangents[1],
        bg=torch.zeros(3, **to) if bg is None else bg.to(**to),
        scale_modifier=scale_modifier,
        viewmatrix=view.T.to(**to).contiguous(),
        projmatrix=(projection @ view).T.to(**to).contiguous(),
        sh_degree=sh_degree,
        campos=position.to(**to),
        prefiltered=False,
        debug=debug,
        effects=effects,
        **options,
    )


def moved(world_to_camera: torch.Tensor, tangent: torch.Tensor) -> torch.Tensor:
    """The camera after a small motion, exp(tangent) @ world_to_camera: the tangent-space form of a pose.

    Differentiable, at zero too: optimise `tangent` from zeros, and the pose stays rigid.

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
