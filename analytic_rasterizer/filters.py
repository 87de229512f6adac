"""The 3D smoothing filter of Mip-Splatting: no Gaussian is finer than its training pictures could have shown.

`bake_pixel` widens Gaussians likewise, by the pixel itself, for viewers that do not integrate over it. `bake_dilation`
serves the opposite case: footprints that integrate, and scenes that were trained with `point`, which does not.

Source: Yu et al., Mip-Splatting: Alias-free 3D Gaussian Splatting, CVPR 2024, Eq. 6-9.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch

from . import ops  # noqa: F401  (registers the fake kernels)
from .cameras.camera import view_center
from .cameras.rotations import rotation_matrices
from .checks import check_tensors
from .footprints import DILATED, check_device, resolve_footprint
from .render.autocast import way_out_of, widened
from .render.effects import Effects
from .render.outputs import depths
from .render.seam import has_seam
from .render.settings import GaussianRasterizationSettings

VARIANCE = 0.2  # of the filter, in squares of the finest sampling interval
PIXEL_VARIANCE = 1 / 12  # of the square pixel along an axis, in squares of its width
DILATION = resolve_footprint(DILATED).option  # px^2, that of 3DGS
MARGIN = 0.15  # of the image around it in which a Gaussian still counts as seen


@torch.no_grad()
def compute_3d_filter(means3D: torch.Tensor, cameras: Sequence[Any], variance: float = VARIANCE) -> torch.Tensor:
    """Standard deviation of every Gaussian's filter, from the camera that samples it most finely.

    A camera samples a point at depth z at intervals of z / focal length, in world units; an orthographic camera at
    intervals of 1 / focal length. Where a view scales, they are divided by the length of its axes. A point takes the
    smallest interval among the cameras that see it, with a margin around the image. A point that no camera sees takes
    the largest interval of all other points.

    Args:
        means3D: (P, 3) centres, world units.
        cameras: `GaussianRasterizationSettings` of the training views, at least one. Size, field of view, matrices and
            the near and far planes of the effects are read.
        variance: Variance of the filter, in squares of the sampling interval.

    Returns:
        (P,) world units, of the dtype and device of means3D.

    Raises:
        TypeError: means3D is no tensor, or a camera is something else.
        ValueError: No cameras, or means3D has a wrong shape, or the variance is negative or not finite.
    """
    check_means(means3D)
    cameras = checked_cameras(cameras)
    if not 0 <= variance < math.inf:
        raise ValueError(f"variance must be finite and not negative, got {variance}")
    interval = means3D.new_full((len(means3D),), torch.inf)
    for camera in cameras:
        interval = torch.minimum(interval, sampling_interval(means3D, camera))
    seen = interval.isfinite()
    largest = interval[seen].max() if seen.any() else interval.new_zeros(())
    return torch.where(seen, interval, largest) * math.sqrt(variance)


def check_means(means3D: torch.Tensor) -> None:
    check_tensors(None, means3D=means3D)
    if means3D.dim() != 2 or means3D.shape[1] != 3:
        raise ValueError(f"means3D must have shape (P, 3), got {tuple(means3D.shape)}")


def checked_cameras(cameras: Any) -> list[GaussianRasterizationSettings]:
    """The settings of the views.

    Raises:
        TypeError: They are not settings, or those of one view that are in no sequence.
        ValueError: There are none.
    """
    if isinstance(cameras, GaussianRasterizationSettings):  # a tuple, too
        raise TypeError("cameras must be a sequence with the settings of each view, got those of one view")
    cameras = list(cameras or ())
    if not cameras:
        raise ValueError("cameras must hold the settings of at least one view, got none")
    for camera in cameras:
        if not isinstance(camera, GaussianRasterizationSettings):
            raise TypeError(f"cameras must hold GaussianRasterizationSettings, got {type(camera).__name__}")
    return cameras


def sampling_interval(means3D: torch.Tensor, camera: Any) -> torch.Tensor:
    """(P,) world units between samples, z / focal length; infinite for a point that the camera does not see.

    `camera` is a `GaussianRasterizationSettings`.
    """
    effects = camera.effects if isinstance(camera.effects, Effects) else Effects()
    if has_seam(camera):
        raise ValueError("cameras must have no equirectangular lens, whose sampling interval is not known, got one")
    if effects.lens is not None:
        return _interval_of_lens(means3D, camera, effects)
    clip = camera.projmatrix.reshape(4, 4).to(means3D)
    z = depths(means3D, camera.viewmatrix.to(means3D))
    columns = means3D.split(1, dim=1)  # not `@`, which autocast and TF32 round
    projected = columns[0] * clip[0] + columns[1] * clip[1] + columns[2] * clip[2] + clip[3]
    inside = (projected[:, :2].abs() <= (1 + 2 * MARGIN) * projected[:, 3:].abs()).all(1)
    # Of the finer of the two axes, pixels per world unit at z = 1. A view may scale: its rows, the columns of the
    # transposed matrix, then are no unit vectors.
    scales = camera.viewmatrix.detach().reshape(4, 4).to(means3D)[:3, :2].norm(dim=0)
    in_x = scales[0] * (camera.image_width / (2 * camera.tanfovx))
    in_y = scales[1] * (camera.image_height / (2 * camera.tanfovy))
    focal = torch.maximum(in_x, in_y)
    inside &= (z > effects.near) & (z < effects.far)
    return torch.where(inside, (torch.ones_like(z) if effects.orthographic else z) / focal, torch.inf)


def _interval_of_lens(means3D: torch.Tensor, camera: Any, effects: Effects) -> torch.Tensor:
    """The same for a camera with a lens, computed in float64 on the CPU.

    It is the inverse of the Jacobian's smaller singular value: the interval in the direction in which samples are
    farthest apart, as z / focal length is for a pinhole.
    """
    view = camera.viewmatrix.detach().reshape(4, 4).to("cpu", torch.float64)
    points = widened(means3D.detach()).to("cpu", torch.float64)
    points = points @ view[:3, :3] + view[3, :3]
    positions, derivatives = effects.lens.project(points)
    middle = view_center(camera.viewmatrix, camera.projmatrix).to(positions)
    tangents = positions.new_tensor([float(camera.tanfovx), float(camera.tanfovy)])
    inside = ((positions - middle).abs() <= (1 + 2 * MARGIN) * tangents).all(1)
    depth = effects.lens.depths(points)
    inside &= (depth > effects.near) & (depth < effects.far)
    focal = max(camera.image_width / (2 * float(camera.tanfovx)), camera.image_height / (2 * float(camera.tanfovy)))
    rows = derivatives @ view[:3, :3].T
    xx, yy, xy = rows[:, 0].square().sum(1), rows[:, 1].square().sum(1), (rows[:, 0] * rows[:, 1]).sum(1)
    larger = (xx + yy) / 2 + torch.hypot((xx - yy) / 2, xy)  # the larger eigenvalue of the rows' products
    smaller = (xx * yy - xy * xy).clamp_min(0) / larger
    return torch.where(inside, torch.rsqrt(smaller) / focal, torch.inf).to(means3D)


def apply_3d_filter(
    scales: torch.Tensor, opacities: torch.Tensor, filter_3d: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Scales and opacities of Gaussians convolved with their filters. Differentiable once, also by the filter.

    The covariance gains filter_3d^2 along every axis; the opacity falls with the peak, so that the mass of a Gaussian
    stays what it was.

    Args:
        scales: (P, 3) standard deviations, world units, float32 or float64.
        opacities: (P, 1) or (P,).
        filter_3d: (P,) world units, from `compute_3d_filter`; 0 where there is none. Where it is negative or not a
            number, the scales become NaN, so that the Gaussian is culled, or named where the settings ask for debug.

    Returns:
        (scales, opacities) of the same shapes.

    Raises:
        TypeError: Something is no tensor, a wrong dtype, or the dtypes differ.
        ValueError: The shapes or devices do not fit.
        RuntimeError: CUDA tensors, and an extension without CUDA.
    """
    check_tensors(None, scales=scales, opacities=opacities, filter_3d=filter_3d)
    scales, opacities, filter_3d = widened(scales), widened(opacities), widened(filter_3d)
    if scales.dim() != 2 or scales.shape[1] != 3 or filter_3d.shape != scales.shape[:1]:
        raise ValueError(
            f"scales must have shape (P, 3) and filter_3d (P,), got {tuple(scales.shape)} and {tuple(filter_3d.shape)}"
        )
    if opacities.shape not in ((len(scales),), (len(scales), 1)):
        raise ValueError(f"opacities must have shape (P, 1) or (P,), got {tuple(opacities.shape)}")
    for name, tensor in (("opacities", opacities), ("filter_3d", filter_3d)):
        if tensor.dtype != scales.dtype:
            wanted, way_out = scales.dtype, way_out_of(tensor.dtype)
            raise TypeError(f"{name} must have the dtype of scales, {wanted}, got {tensor.dtype}{way_out}")
        if tensor.device != scales.device:
            raise ValueError(f"{name} must be on the device of scales, {scales.device}, got {tensor.device}")
    check_device(scales.device)
    return torch.ops.analytic_rasterizer.apply_3d_filter(scales, opacities, filter_3d)


@torch.no_grad()
def bake_pixel(
    means3D: torch.Tensor,
    scales: torch.Tensor,
    rotations: torch.Tensor,
    opacities: torch.Tensor,
    cameras: Sequence[Any],
) -> tuple[torch.Tensor, torch.Tensor]:
    """Scales and opacities of Gaussians that contain the integration over a pixel, for viewers that sample.

    The covariance of a Gaussian gains, along every axis, the variance of a pixel of the camera that samples it most
    finely: `PIXEL_VARIANCE` squares of the sampling interval of `compute_3d_filter`. A projection then has the variance
    that integrating over such a pixel gives it. Its mass is kept by a lower opacity: by the factor between the areas
    sqrt(det) of the projections along the line of sight before and after, which is averaged over the cameras that see
    the Gaussian. (The opacity of `apply_3d_filter` keeps the mass in space instead, which lowers it too far: the
    third axis, along the line of sight, does not count in a picture, and for flat Gaussians it has the smallest factor
    of all.) A Gaussian that no camera sees stays as it is.

    This is no substitute for integration. At other distances a pixel has another size than the one that is baked: from
    further away pictures alias, less than without it, and from nearby they are blurred.

    Args:
        means3D: (P, 3) centres, world units.
        scales: (P, 3) standard deviations, world units.
        rotations: (P, 4) quaternions (w, x, y, z).
        opacities: (P, 1) or (P,).
        cameras: As in `compute_3d_filter`.

    Returns:
        (scales, opacities) of the same shapes.

    Raises:
        TypeError, ValueError: As `compute_3d_filter` and `apply_3d_filter`.
    """
    cameras = checked_cameras(cameras)  # a list: they are gone through twice
    width = compute_3d_filter(means3D, cameras, PIXEL_VARIANCE)
    widened, _ = apply_3d_filter(scales, opacities, width)  # checks the shapes
    check_rotations(rotations, len(scales))
    share, seen = mean_area_ratio(means3D, rotations, scales, widened, cameras)
    return torch.where(seen[:, None], widened, scales), opacities * share.reshape(opacities.shape)


@torch.no_grad()
def bake_dilation(
    means3D: torch.Tensor,
    scales: torch.Tensor,
    rotations: torch.Tensor,
    opacities: torch.Tensor,
    cameras: Sequence[Any],
    dilation: float = DILATION,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Scales and opacities of a scene that was trained with `point`, for footprints that integrate over the pixel.

    `point` adds its dilation to the covariance of every projection, without lowering the peak. The Gaussians that a
    training with it ends in are therefore thinner than its pictures show them, by that many px^2 of the training views.
    Here the dilation becomes part of them. For a single camera, a projection that integrates over the pixel then has
    the variance and the mass that `point` gave it; other distances and resolutions show the same object.

    - The covariance gains, along every axis, `dilation` - `PIXEL_VARIANCE` squares of the sampling interval h; the
      pixel itself contributes the rest. In space a Gaussian has one width, where each camera has a dilation of its own:
      1/h^2 is the mean of 1/h_c^2 over the cameras c that see the Gaussian, with the interval h_c of
      `compute_3d_filter`.
    - The opacity is multiplied by the area sqrt(det) of the projection with `dilation` squares of h, over that with
      `dilation` - `PIXEL_VARIANCE` squares, averaged over these cameras. The result is limited to 1: where it would be
      more, mass is lost.

    A Gaussian that no camera sees stays as it is.

    Args:
        means3D: (P, 3) centres, world units.
        scales: (P, 3) standard deviations, world units.
        rotations: (P, 4) quaternions (w, x, y, z).
        opacities: (P, 1) or (P,).
        cameras: Those that the scene was trained from, as in `compute_3d_filter`.
        dilation: Of the training, px^2.

    Returns:
        (scales, opacities) of the same shapes.

    Raises:
        TypeError, ValueError: As `compute_3d_filter` and `apply_3d_filter`.
        ValueError: The dilation is less than `PIXEL_VARIANCE`, or not finite.
    """
    check_means(means3D)
    cameras = checked_cameras(cameras)  # a list: they are gone through twice
    if not PIXEL_VARIANCE <= dilation < math.inf:
        raise ValueError(f"dilation must be finite and at least 1/12, the variance of a pixel, got {dilation}")
    density, count = torch.zeros_like(means3D[:, 0]), torch.zeros_like(means3D[:, 0])  # density: samples per area
    for camera in cameras:
        interval = sampling_interval(means3D, camera)
        density += interval**-2  # 0 where the camera does not see it
        count += interval.isfinite()
    interval = torch.where(count > 0, torch.rsqrt(density / count.clamp_min(1)), 0)
    widened, _ = apply_3d_filter(scales, opacities, interval * math.sqrt(dilation - PIXEL_VARIANCE))
    dilated, _ = apply_3d_filter(scales, opacities, interval * math.sqrt(dilation))
    check_rotations(rotations, len(scales))
    share, _ = mean_area_ratio(means3D, rotations, dilated, widened, cameras)
    share = share.clamp_max(torch.finfo(share.dtype).max)  # infinite where a projection without width gets none
    return widened, (opacities * share.reshape(opacities.shape)).clamp_max(1)


def check_rotations(rotations: torch.Tensor, count: int) -> None:
    check_tensors(None, rotations=rotations)
    if rotations.shape != (count, 4):
        raise ValueError(f"rotations must have shape ({count}, 4), got {tuple(rotations.shape)}")


def mean_area_ratio(
    means3D: torch.Tensor, rotations: torch.Tensor, scales: torch.Tensor, others: torch.Tensor, cameras: list
) -> tuple[torch.Tensor, torch.Tensor]:
    """How large projections with `scales` are beside those with `others`, along the lines of sight of cameras.

    Args:
        means3D: (P, 3) centres, world units.
        rotations: (P, 4) quaternions (w, x, y, z).
        scales, others: (P, 3) standard deviations, world units.
        cameras: As in `compute_3d_filter`, checked.

    Returns:
        share: (P,) the area with `scales` divided by that with `others`, averaged over the cameras that see the
            Gaussian; 1 where there is none.
        seen: (P,) bool, whether there is one.
    """
    axes = rotation_matrices(rotations)  # their columns
    total, count = torch.zeros_like(means3D[:, 0]), torch.zeros_like(means3D[:, 0])
    for camera in cameras:
        seen = sampling_interval(means3D, camera).isfinite()
        if isinstance(camera.effects, Effects) and camera.effects.orthographic:
            sight = camera.viewmatrix.reshape(4, 4)[:3, 2].to(means3D).expand_as(means3D)
        else:
            sight = torch.nn.functional.normalize(means3D - camera.campos.to(means3D).reshape(1, 3), dim=1)
        sight = (axes * sight[:, :, None]).sum(1)  # in the frames of the Gaussians; not by einsum, as above
        total += torch.where(seen, projected_area(scales, sight) / projected_area(others, sight), 0)
        count += seen
    return torch.where(count > 0, total / count.clamp_min(1), 1), count > 0


def projected_area(scales: torch.Tensor, direction: torch.Tensor) -> torch.Tensor:
    """sqrt(det) of the covariance of a Gaussian that is projected in parallel along a direction, (P,).

    It is det(S) |S^-1 d| for covariance S^2, without the division by a scale that may vanish.

    Args:
        scales: (P, 3) standard deviations.
        direction: (P, 3) unit vectors d in the frames of the Gaussians.
    """
    x, y, z = scales.unbind(1)
    return torch.linalg.vector_norm(direction * torch.stack([y * z, x * z, x * y], dim=1), dim=1)
