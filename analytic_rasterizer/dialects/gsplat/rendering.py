"""gsplat's `rasterization`: its arguments, its returns, its `meta`."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import torch

from ..._C import TILE
from ...autocast import widened
from ...camera import camera_matrices
from ...effects import Effects
from ...footprints import Footprint
from ...settings import GaussianRasterizationSettings
from ...stages import Splats, blend, list_tiles, project
from .arguments import (
    RASTERIZE_MODES,
    RENDER_MODES,
    Sizes,
    check_choice,
    check_colors,
    check_distributed,
    check_numbers,
    check_scene,
    refuse,
    settle_footprint,
)
from .meta import ROWS, KeepAbsolute, Layout, measure, without_culled
from .ranks import Sharing

_SMALLEST_ALPHA = 1e-10  # that an accumulated depth is divided by, as in gsplat


def rasterization(
    means: torch.Tensor,
    quats: torch.Tensor | None,
    scales: torch.Tensor | None,
    opacities: torch.Tensor,
    colors: torch.Tensor,
    viewmats: torch.Tensor,
    Ks: torch.Tensor,
    width: int,
    height: int,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    sh_degree: int | None = None,
    packed: bool = True,
    tile_size: int = 16,
    backgrounds: torch.Tensor | None = None,
    render_mode: str = "RGB",
    sparse_grad: bool = False,
    absgrad: bool = False,
    rasterize_mode: str = "classic",
    channel_chunk: int = 32,
    distributed: bool = False,
    camera_model: str = "pinhole",
    segmented: bool = False,
    covars: torch.Tensor | None = None,
    with_ut: bool = False,
    with_eval3d: bool = False,
    radial_coeffs: torch.Tensor | None = None,
    tangential_coeffs: torch.Tensor | None = None,
    thin_prism_coeffs: torch.Tensor | None = None,
    ftheta_coeffs: Any = None,
    rolling_shutter: Any = None,
    viewmats_rs: torch.Tensor | None = None,
    *,
    footprint: str | Footprint | None = None,
) -> tuple[torch.Tensor, torch.Tensor, dict[str, Any]]:
    """Renders N Gaussians into C cameras, for every index of the leading dimensions `...`, of which there may be none.

    Differentiable in all tensors, also in viewmats and Ks. Floating tensors share one device and dtype (float32;
    float64 on the CPU).

    Args:
        means: (..., N, 3) centres, world units.
        quats: (..., N, 4) quaternions (w, x, y, z) of any length.
        scales: (..., N, 3) standard deviations, world units.
        opacities: (..., N) 0 to 1.
        colors: (..., N, D) or, for every camera, (..., C, N, D): colours or features, at most 512 channels, depth
            included. With sh_degree: (..., N, K, 3) or (..., C, N, K, 3) spherical harmonics.
        viewmats: (..., C, 4, 4) world to camera; x right, y down, z forward.
        Ks: (..., C, 3, 3) focal lengths and principal points, px, the image spanning [0, width] x [0, height]. Of an
            orthographic camera the focal lengths are px per world unit.
        width, height: Size of the images, px.
        near_plane, far_plane: Camera-space z between which Gaussians are drawn, world units.
        radius_clip: A splat whose radii are at most this many px is not drawn.
        eps2d: Variance of the filter, px^2: `point:dilation=eps2d` in the mode "classic", `mip:variance=eps2d` in
            the mode "antialiased". Not read where a footprint was chosen.
        sh_degree: Degree of the harmonics in use, 0 to 4; None: colors are colours.
        packed: Whether `meta` has a row per splat, or a place for every Gaussian in every camera.
        tile_size: Ignored: tiles have the size that suits the footprint.
        backgrounds: (..., C, D) colours behind the Gaussians; None: zero. There is no depth behind them.
        render_mode: "RGB" for colours, "D" for accumulated depth, "ED" for expected depth, "RGB+D", "RGB+ED".
        absgrad: Let the backward pass set `meta["means2d"].absgrad`: sums over pixels of absolute gradients.
        rasterize_mode: "classic" or "antialiased".
        channel_chunk, segmented: Ignored: all channels are blended in one pass, and sorting has one way.
        camera_model: "pinhole" or "ortho".
        covars: (..., N, 3, 3) covariances in place of quats and scales, world units^2; the upper triangle is read.
        distributed: Whether the ranks of torch.distributed's default group render together: each gives Gaussians and
            cameras of its own, as many cameras as every other, and gets the images of its cameras from the Gaussians of
            all. There are no leading dimensions then, and colors are shared by the cameras. Every rank has to run the
            backward pass. Without a process group, or with one rank, it changes nothing.
        sparse_grad, with_ut, with_eval3d: Refused unless they ask for nothing.
        radial_coeffs, tangential_coeffs, thin_prism_coeffs, ftheta_coeffs, rolling_shutter, viewmats_rs: Likewise.
        footprint: See `resolve_footprint`. None: the one that `set_default_footprint` or the environment variable
            ANALYTIC_RASTERIZER_FOOTPRINT chose, or else the filter of rasterize_mode and eps2d.

    Returns:
        render_colors: (..., C, height, width, X): D channels, one of depth, or both.
        render_alphas: (..., C, height, width, 1).
        meta: A dictionary. Its rows are (R, ...) of R splats if packed, else (..., C, N, ...), where they mean
            something if the radii are positive: means2d (2,) px with pixel centres at 0.5, through which gradients of
            the images flow, so that `retain_grad` works; depths, differentiable; radii (2,) int32, px along x and y;
            conics (3,), the inverse of the covariance with the filter's variance (1/12 px^2 for footprints other than
            `point` and `mip`); opacities, in mode "antialiased" with the amplitude of `mip`; the last three without
            gradient, but for opacities in mode "classic", which are those given. batch_ids,
            camera_ids, gaussian_ids: (R,) int64 if packed, else None. width, height, tile_size, tile_width,
            tile_height, n_batches, n_cameras: numbers. With `distributed` the rows, and C of a table, are those of the
            rank's own Gaussians in the cameras of all ranks: gaussian_ids count within the rank, camera_ids over all
            ranks; n_cameras is that of the rank. gsplat's lists of tiles (tiles_per_gauss, isect_ids,
            flatten_ids, isect_offsets) are missing.

    Raises:
        NotImplementedError: What this package does not render; the message names it.
        TypeError: Not a tensor, or a wrong dtype.
        ValueError: Wrong shape, device or value. The numbers of cameras are looked at on the CPU only.
        RuntimeError: CUDA tensors, and an extension without CUDA; or a pose in viewmats that is singular.
    """
    means, quats, scales, opacities, covars = map(widened, (means, quats, scales, opacities, covars))
    colors, viewmats, Ks, backgrounds = map(widened, (colors, viewmats, Ks, backgrounds))
    asked = {
        "sparse_grad": sparse_grad,
        "with_ut": with_ut,
        "with_eval3d": with_eval3d,
        "radial_coeffs": radial_coeffs,
        "tangential_coeffs": tangential_coeffs,
        "thin_prism_coeffs": thin_prism_coeffs,
        "ftheta_coeffs": ftheta_coeffs,
        "viewmats_rs": viewmats_rs,
    }

    def check() -> tuple[Sizes, bool, Footprint]:
        refuse(asked, camera_model, rolling_shutter)
        check_choice("render_mode", render_mode, RENDER_MODES)
        check_choice("rasterize_mode", rasterize_mode, RASTERIZE_MODES)
        check_numbers(width, height, near_plane, far_plane, radius_clip, eps2d)
        sizes = check_scene(means, quats, scales, opacities, covars, viewmats, Ks)
        per_camera = check_colors(means, sizes, colors, backgrounds, sh_degree, render_mode)
        if distributed:
            check_distributed(sizes, per_camera)
        return sizes, per_camera, settle_footprint(footprint, rasterize_mode, eps2d)

    sharing = None
    if distributed:
        tensors = {"means": means, "quats": quats, "scales": scales, "opacities": opacities, "colors": colors}
        tensors |= {"viewmats": viewmats, "Ks": Ks, "covars": covars}
        numbers = (width, height, near_plane, far_plane, radius_clip, eps2d, sh_degree, packed, render_mode, absgrad)
        with_channels = colors.shape[-1] if isinstance(colors, torch.Tensor) and colors.dim() else None
        chosen = rasterize_mode, camera_model, with_channels
        (own_sizes, per_camera, settled), sharing = Sharing.agreed(check, tensors, (*numbers, *chosen))
    else:
        own_sizes, per_camera, settled = check()
    sizes = own_sizes
    if sharing is not None:
        viewmats, Ks = sharing.all_cameras(viewmats, Ks)
        sizes = dataclasses.replace(own_sizes, cameras=len(viewmats))
    width, height = int(width), int(height)
    settings = _camera_settings(
        viewmats,
        Ks,
        width,
        height,
        near=near_plane,
        far=far_plane,
        orthographic=camera_model == "ortho",
        sh_degree=sh_degree or 0,
        footprint=settled,
    )
    with_colors, with_depth = "RGB" in render_mode, render_mode != "RGB"
    shs = colors if with_colors and sh_degree is not None else None
    if covars is None:
        covariances = {"scales": scales, "rotations": quats}
    else:
        covariances = {"cov3D_precomp": upper_triangle(covars)}
    gaussians = {"means3D": means, "opacities": opacities, **covariances}
    splats = _project(sizes, settings, gaussians, shs, per_camera)
    measures = measure(splats, settled, radius_clip)
    if packed:
        splats, measures = without_culled(splats, measures)
    else:
        splats = dataclasses.replace(splats, opacities=torch.where(measures.drawn, splats.opacities, 0))
    layout = Layout.of(splats, sizes, packed)

    means2d = layout.to_meta(splats.means2d + 0.5)
    through, absolute = means2d, None
    if absgrad and means2d.requires_grad:
        through, absolute = KeepAbsolute.apply(means2d)
        absolute = layout.to_rows(absolute)
    splats = dataclasses.replace(splats, means2d=layout.to_rows(through) - 0.5)

    features = splats.means2d.new_empty(len(splats.means2d), 0)
    if with_colors:
        features = _colors_of_rows(splats, sizes, colors, per_camera) if shs is None else splats.colors
    blended = splats
    if sharing is not None:
        blended, absolute = sharing.send(splats, features, absolute)
        features = blended.colors  # of any number of channels, which `list_tiles` does not take
        blended = dataclasses.replace(blended, colors=features.new_empty(0, 3))
    if with_depth:
        features = torch.cat([features, blended.depths[:, None]], 1)
    images, alphas = _blend(blended, features, _backgrounds(backgrounds, with_colors, with_depth), absolute)
    if render_mode.endswith("ED"):
        images = torch.cat([images[..., :-1], images[..., -1:] / alphas.clamp(min=_SMALLEST_ALPHA)], -1)

    meta = {
        "batch_ids": splats.camera_ids.long() // sizes.cameras if packed else None,
        "camera_ids": splats.camera_ids.long() % sizes.cameras if packed else None,
        "gaussian_ids": splats.gaussian_ids.long() if packed else None,
        "radii": layout.to_meta(measures.radii),
        "means2d": means2d,
        "depths": layout.to_meta(splats.depths),
        "conics": layout.to_meta(measures.conics),
        "opacities": layout.to_meta(measures.opacities),
        "width": width,
        "height": height,
        "tile_size": TILE,
        "tile_width": math.ceil(width / TILE),
        "tile_height": math.ceil(height / TILE),
        "n_batches": math.prod(sizes.batch),
        "n_cameras": own_sizes.cameras,
    }
    dims = (*sizes.batch, own_sizes.cameras)
    return images.unflatten(0, dims), alphas.unflatten(0, dims), meta


# --- projection --------------------------------------------------------------------------------------


def _camera_settings(
    viewmats: torch.Tensor,
    Ks: torch.Tensor,
    width: int,
    height: int,
    *,
    near: float,
    far: float,
    orthographic: bool,
    sh_degree: int,
    footprint: Footprint,
) -> list[GaussianRasterizationSettings]:
    """Settings of all cameras, in the order of their leading dimensions, for `project`."""
    effects = Effects(
        camera_gradients=True,  # keeps the focal lengths on the device
        off_center=True,  # the clamp of x/z and y/z is around the centre of the picture, as in gsplat
        near=near,
        far=far,
        orthographic=orthographic,
    )
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
            sh_degree=sh_degree,
            campos=position,
            prefiltered=False,
            debug=False,
            effects=effects,
            footprint=str(footprint),
        )
        for view, projection, position, tangent in zip(viewmats.reshape(-1, 4, 4), projections, positions, tangents)
    ]


def _project(
    sizes: Sizes,
    settings: list[GaussianRasterizationSettings],
    gaussians: dict[str, torch.Tensor],
    shs: torch.Tensor | None,
    per_camera: bool,
) -> Splats:
    """Splats of all Gaussians in all cameras; the cameras of batch b are b * C to b * C + C - 1.

    One `project` serves the cameras that see the same Gaussians: those of a batch, unless harmonics are per camera.
    """
    batches, dims = math.prod(sizes.batch), len(sizes.batch)
    flat = {name: value.reshape(batches, *value.shape[dims:]) for name, value in gaussians.items()}
    if shs is not None:
        shs = shs.reshape(len(settings) if per_camera else batches, *shs.shape[-3:])
    together = 1 if shs is not None and per_camera else sizes.cameras
    parts = []
    for first in range(0, len(settings), together):
        batch = first // sizes.cameras
        of_batch = {name: value[batch] for name, value in flat.items()}
        if shs is not None:
            of_batch["shs"] = shs[first if per_camera else batch]
        parts.append(project(settings[first : first + together], **of_batch))
    return _join(parts)


def upper_triangle(matrices: torch.Tensor) -> torch.Tensor:
    """(..., 6) of (..., 3, 3)."""
    return torch.stack([matrices[..., row, column] for row in range(3) for column in range(row, 3)], -1)


def _join(parts: list[Splats]) -> Splats:
    """Splats of several projections as of one, camera after camera."""
    if len(parts) == 1:
        return parts[0]
    cameras = [0]
    splits = [parts[0].row_splits[:1]]
    for part in parts:
        cameras.append(cameras[-1] + part.cameras)
        splits.append(splits[-1][-1] + part.row_splits[1:])
    rows = {name: torch.cat([getattr(part, name) for part in parts]) for name in ROWS}
    rows["camera_ids"] = torch.cat([part.camera_ids + first for part, first in zip(parts, cameras)])
    return dataclasses.replace(parts[0], row_splits=torch.cat(splits), **rows)


# --- blending ----------------------------------------------------------------------------------------


def _colors_of_rows(splats: Splats, sizes: Sizes, colors: torch.Tensor, per_camera: bool) -> torch.Tensor:
    """(R, D) of colours that are given per Gaussian, or per camera and Gaussian."""
    table = splats.camera_ids.long()
    if not per_camera:
        table = table // sizes.cameras
    rows = table * sizes.gaussians + splats.gaussian_ids.long()
    return colors.flatten(0, -2).index_select(0, rows)


def _backgrounds(backgrounds: torch.Tensor | None, with_colors: bool, with_depth: bool) -> torch.Tensor | None:
    """(B * C, K) of all channels: there is no depth behind the Gaussians."""
    if backgrounds is None or not with_colors:
        return None
    flat = backgrounds.flatten(0, -2)
    return torch.nn.functional.pad(flat, (0, 1)) if with_depth else flat


def _blend(
    splats: Splats, features: torch.Tensor, backgrounds: torch.Tensor | None, absolute: torch.Tensor | None
) -> tuple[torch.Tensor, torch.Tensor]:
    """Images (B * C, H, W, K) and alphas (B * C, H, W, 1)."""
    lists = list_tiles(splats, keep=torch.is_grad_enabled())
    images, alphas = blend(splats, lists, features, backgrounds, means2d_abs=absolute)
    return images.permute(0, 2, 3, 1).contiguous(), alphas.permute(0, 2, 3, 1).contiguous()
