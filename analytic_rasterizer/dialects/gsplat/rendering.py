"""gsplat's `rasterization`: its arguments, its returns, its `meta`."""

from __future__ import annotations

import dataclasses
import math
from types import SimpleNamespace
from typing import Any

import torch

from ..._C import TILE
from ...footprints import Footprint
from ...render.autocast import widened
from ...render.order import CENTER
from .arguments import RASTERIZE_MODES, RENDER_MODES, TENSORS, Call, check_finite_cameras, checked
from .cameras import flat_cameras, prepared_cameras
from .ranks import Sharing
from .scene import KeepAbsolute, Scene, composite, named, upper_triangle

__all__ = ["RASTERIZE_MODES", "RENDER_MODES", "rasterization", "upper_triangle"]


def rasterization(
    means: torch.Tensor,
    quats: torch.Tensor | None,
    scales: torch.Tensor | None,
    opacities: torch.Tensor,
    colors: torch.Tensor | None,
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
    tile_size: int | None = 16,
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
    return_normals: bool = False,
    global_z_order: bool = True,
    rays: torch.Tensor | None = None,
    lidar_coeffs: Any = None,
    external_distortion_coeffs: Any = None,
    ut_params: Any = None,
    extra_signals: torch.Tensor | None = None,
    extra_signals_sh_degree: int | None = None,
    renderer_config: Any = None,
    footprint: str | Footprint | None = None,
    order: str = CENTER,
) -> tuple[torch.Tensor, torch.Tensor, dict[str, Any]]:
    """Renders N Gaussians into C cameras, for every index of the leading dimensions `...`, of which there may be none.

    The arguments up to viewmats_rs are those of gsplat 1.5.3, in its order. Those behind are what gsplat 1.6 added,
    footprint and order. Differentiable in all tensors, also in viewmats, Ks and coefficients of lenses. Floating
    tensors share one device and dtype (float32; float64 on the CPU).

    Args:
        means: (..., N, 3) centres, world units.
        quats: (..., N, 4) quaternions (w, x, y, z) of any length.
        scales: (..., N, 3) standard deviations, world units.
        opacities: (..., N) 0 to 1.
        colors: (..., N, D) or, for every camera, (..., C, N, D): colours or features, at most 512 channels, depth
            included. With sh_degree: (..., N, K, 3), (N, K, 3) or (..., C, N, K, 3) spherical harmonics. None: depth
            alone is rendered.
        viewmats: (..., C, 4, 4) world to camera; x right, y down, z forward.
        Ks: (..., C, 3, 3) focal lengths and principal points, px, the image spanning [0, width] x [0, height]. Of an
            orthographic camera the focal lengths are px per world unit.
        width, height: Size of the images, px.
        near_plane, far_plane: Camera-space z between which Gaussians are drawn, world units; of a fisheye with
            global_z_order=False the distance from the camera.
        radius_clip: A splat whose radii are at most this many px is not drawn.
        eps2d: Variance of the filter, px^2: `point:dilation=eps2d` in the mode "classic", `mip:variance=eps2d` in
            the mode "antialiased". Not read where a footprint was chosen.
        sh_degree: Degree of the harmonics in use, 0 to 4; None: colors are colours.
        packed: Whether `meta` has a row per splat, or a place for every Gaussian in every camera.
        tile_size: Ignored: tiles have the size that suits the footprint.
        backgrounds: (..., C, D) colours behind the Gaussians; None: zero. There is no depth behind them.
        render_mode: "RGB" for colours, "D" for accumulated depth, "ED" for expected depth, "RGB+D", "RGB+ED"; with "d"
            and "Ed", "RGB-d" and "RGB-Ed" depth is the distance of the Gaussian's centre along its ray.
        absgrad: Let the backward pass set `meta["means2d"].absgrad`: sums over pixels of absolute gradients.
        rasterize_mode: "classic" or "antialiased".
        channel_chunk, segmented: Ignored: all channels are blended in one pass, and sorting has one way.
        camera_model: "pinhole", "ortho" or "fisheye" (equidistant).
        covars: (..., N, 3, 3) covariances in place of quats and scales, world units^2; the upper triangle is read.
        distributed: Whether the ranks of torch.distributed's default group render together: each gives Gaussians and
            cameras of its own, as many cameras as every other, and gets the images of its cameras from the Gaussians of
            all. There are no leading dimensions then, and colors are shared by the cameras. Every rank has to run the
            backward pass. Without a process group, or with one rank, it changes nothing.
        radial_coeffs: (..., C, 6) k1 to k6 of OpenCV's lens, or for a fisheye (..., C, 4) k1 to k4; see `ar.Lens`.
        tangential_coeffs: (..., C, 2) p1, p2.
        thin_prism_coeffs: (..., C, 4) s1 to s4.
        with_ut: With a lens, or a fisheye, it may be True, and changes nothing: means go through the exact map,
            covariances through its Jacobian. Without one it is refused.
        sparse_grad, with_eval3d, ftheta_coeffs, rolling_shutter, viewmats_rs: Refused unless they ask for nothing.
        rays, lidar_coeffs, external_distortion_coeffs, ut_params: Likewise.
        return_normals: Render the Gaussians' third axes, turned towards the camera, in the axes of the world.
        global_z_order: Draw, and show as depth, by camera-space z; False: by the distance from the camera. A fisheye
            sees beyond 90 degrees from its axis with False alone.
        extra_signals: (..., N, E) or (..., C, N, E), rendered like colours into meta, without a background. With
            extra_signals_sh_degree: (..., N, K, E), (N, K, E) or (..., C, N, K, E) spherical harmonics, whose sum plus
            1/2 is rendered, not clamped. They are projected twice more for every three channels.
        extra_signals_sh_degree: Degree of these harmonics in use, 0 to 4, or None.
        renderer_config: Ignored: it chooses an implementation.
        footprint: See `resolve_footprint`. None: the one that `set_default_footprint` or the environment variable
            ANALYTIC_RASTERIZER_FOOTPRINT chose, or else the filter of rasterize_mode and eps2d.
        order: "center", or along rays, see `Effects.order`.

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
            tile_height, n_batches, n_cameras: numbers. Where they were asked for, render_extra_signals
            (..., C, height, width, E) and normals (..., C, height, width, 3). With `distributed` the rows, and C of a
            table, are those of the rank's own Gaussians in the cameras of all ranks: gaussian_ids count within the
            rank, camera_ids over all ranks; n_cameras is that of the rank. gsplat's lists of tiles (tiles_per_gauss,
            isect_ids, flatten_ids, isect_offsets) are missing.

    Raises:
        NotImplementedError: What this package does not render; the message names it.
        TypeError: Not a tensor, or a wrong dtype.
        ValueError: Wrong shape, device or value. The numbers of cameras and lenses are looked at on the CPU only: on
            CUDA nothing is seen through a lens that is no map.
        RuntimeError: CUDA tensors, and an extension without CUDA; or on the CPU a pose in viewmats that is singular.
    """
    given = SimpleNamespace(**{name: widened(v) if name in TENSORS else v for name, v in locals().items()})
    call, sharing = Sharing.agreed(given) if distributed else (checked(given), None)
    mode = call.mode
    scene = _scene(call, sharing)
    as_rows = packed or sharing is not None
    try:
        rows, channels = scene.rows(mode, call.colors, call.extra, bool(return_normals), as_rows)
    except ValueError:  # of matrices by their names in 3DGS
        check_finite_cameras(given.viewmats, given.Ks)
        raise
    held = rows if packed or sharing is None else sharing.as_table(rows, scene.sizes)
    means2d, absolute = held["means2d"], None
    if absgrad and means2d.requires_grad:
        means2d, absolute = KeepAbsolute.apply(means2d)
    if sharing is None:
        rows = rows | {"means2d": means2d}
    else:
        rows, absolute = sharing.send(rows, means2d, absolute, scene)
    background = given.backgrounds if mode.colors else None  # there is none behind the other channels
    images, alphas = composite(rows, scene, background, absolute, mode.expected)
    made = {}
    if call.sizes.batch:
        images, alphas = (t.unflatten(0, (*call.sizes.batch, call.sizes.cameras)) for t in (images, alphas))
    if not channels.keys() <= {"colors", "depth"}:
        made = dict(zip(channels, images.split(list(channels.values()), -1)))
        images = torch.cat([made[name] for name in ("colors", "depth") if name in made], -1)
    meta = named(held, scene.sizes, packed) | {
        "width": scene.width,
        "height": scene.height,
        "tile_size": TILE,
        "tile_width": math.ceil(scene.width / TILE),
        "tile_height": math.ceil(scene.height / TILE),
        "n_batches": math.prod(call.sizes.batch),
        "n_cameras": call.sizes.cameras,
    }
    for key, name in (("render_extra_signals", "extra"), ("normals", "normals")):
        if name in made:
            meta[key] = made[name].contiguous()
    return images, alphas, meta


def _scene(call: Call, sharing: Sharing | None) -> Scene:
    """What is rendered: the cameras of all ranks, where there are several."""
    given, sizes = call.given, call.sizes
    viewmats, intrinsics, coefficients = flat_cameras(given)
    if sharing is not None:
        viewmats, intrinsics, coefficients = sharing.all_cameras(viewmats, intrinsics, coefficients)
        sizes = dataclasses.replace(sizes, cameras=len(viewmats))
    width, height, by_z = int(given.width), int(given.height), bool(given.global_z_order)
    # `project` cuts a fisheye by the distance.
    cut_later = given.camera_model == "fisheye" and by_z
    planes = given.near_plane, given.far_plane
    far = math.inf if cut_later else given.far_plane
    cameras = prepared_cameras(
        viewmats, intrinsics, coefficients, (width, height), given.camera_model, given.near_plane, far
    )
    if given.covars is None:
        covariances = {"scales": given.scales, "rotations": given.quats}
    else:
        covariances = {"cov3D_precomp": upper_triangle(given.covars)}
    return Scene(
        sizes=sizes,
        gaussians={"means3D": given.means, "opacities": given.opacities, **covariances},
        cameras=cameras,
        width=width,
        height=height,
        camera_model=given.camera_model,
        by_z=by_z,
        planes=planes if cut_later else (-math.inf, math.inf),
        radius_clip=given.radius_clip,
        footprint=call.footprint,
        order=given.order,
    )
