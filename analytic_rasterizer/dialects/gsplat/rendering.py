"""gsplat's `rasterization`: its arguments, its returns, its `meta`."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import torch

from ..._C import TILE
from ...autocast import widened
from ...footprints import Footprint
from ...stages import Splats, blend, list_tiles
from .arguments import (
    RASTERIZE_MODES,
    RENDER_MODES,
    Mode,
    Signal,
    Sizes,
    check_choice,
    check_colors,
    check_distributed,
    check_extra,
    check_lens,
    check_numbers,
    check_scene,
    refuse,
    settle_footprint,
)
from .cameras import lens_coefficients, settings_of
from .meta import KeepAbsolute, Layout, measure, without_culled
from .ranks import Sharing
from .scene import Scene

_SMALLEST_ALPHA = 1e-10  # that an accumulated depth is divided by, as in gsplat


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
) -> tuple[torch.Tensor, torch.Tensor, dict[str, Any]]:
    """Renders N Gaussians into C cameras, for every index of the leading dimensions `...`, of which there may be none.

    The arguments up to viewmats_rs are those of gsplat 1.5.3, in its order. Those behind are what gsplat 1.6 added, and
    footprint. Differentiable in all tensors, also in viewmats, Ks and coefficients of lenses. Floating tensors share
    one device and dtype (float32; float64 on the CPU).

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
        ValueError: Wrong shape, device or value. The numbers of cameras are looked at on the CPU only, those of lenses
            everywhere.
        RuntimeError: CUDA tensors, and an extension without CUDA; or a pose in viewmats that is singular.
    """
    means, quats, scales, opacities, covars = map(widened, (means, quats, scales, opacities, covars))
    colors, viewmats, Ks, backgrounds, extra_signals = map(widened, (colors, viewmats, Ks, backgrounds, extra_signals))
    lens = tuple(map(widened, (radial_coeffs, tangential_coeffs, thin_prism_coeffs)))
    asked = {
        "sparse_grad": sparse_grad,
        "with_eval3d": with_eval3d,
        "rays": rays,
        "ftheta_coeffs": ftheta_coeffs,
        "lidar_coeffs": lidar_coeffs,
        "external_distortion_coeffs": external_distortion_coeffs,
        "viewmats_rs": viewmats_rs,
        "ut_params": ut_params,
    }
    has_lens = any(part is not None for part in lens)

    def check() -> tuple[Sizes, Signal | None, Signal | None, Footprint]:
        refuse(asked, camera_model, rolling_shutter, with_ut, has_lens)
        check_choice("render_mode", render_mode, RENDER_MODES)
        check_choice("rasterize_mode", rasterize_mode, RASTERIZE_MODES)
        check_numbers(width, height, near_plane, far_plane, radius_clip, eps2d)
        sizes = check_scene(means, quats, scales, opacities, covars, viewmats, Ks)
        check_lens(means, sizes, camera_model, *lens)
        signal = check_colors(means, sizes, colors, backgrounds, sh_degree, render_mode)
        if return_normals and covars is not None:
            raise ValueError("covars must be None where return_normals is True: normals are axes of quats")
        mode = Mode.of(render_mode)
        others = (signal.channels if signal is not None and mode.colors else 0) + mode.depth + 3 * bool(return_normals)
        extra = check_extra(means, sizes, extra_signals, extra_signals_sh_degree, others)
        if distributed:
            check_distributed(sizes, colors=signal, extra_signals=extra)
        return sizes, signal, extra, settle_footprint(footprint, rasterize_mode, eps2d)

    sharing = None
    if distributed:
        tensors = {"means": means, "quats": quats, "scales": scales, "opacities": opacities, "colors": colors}
        tensors |= {"viewmats": viewmats, "Ks": Ks, "covars": covars, "extra_signals": extra_signals}
        tensors |= dict(zip(("radial_coeffs", "tangential_coeffs", "thin_prism_coeffs"), lens))
        numbers = (width, height, near_plane, far_plane, radius_clip, eps2d, sh_degree, packed, render_mode, absgrad)
        channels = [t.shape[-1] if isinstance(t, torch.Tensor) and t.dim() else None for t in (colors, extra_signals)]
        chosen = (
            rasterize_mode,
            camera_model,
            *channels,
            extra_signals_sh_degree,
            bool(return_normals),
            global_z_order,
        )
        chosen += tuple(part is None for part in lens)
        (own_sizes, signal, extra, settled), sharing = Sharing.agreed(check, tensors, (*numbers, *chosen))
    else:
        own_sizes, signal, extra, settled = check()
    sizes = own_sizes
    coefficients = lens_coefficients(viewmats, camera_model, *lens)
    if sharing is not None:
        viewmats, Ks, coefficients = sharing.all_cameras(viewmats, Ks, coefficients)
        sizes = dataclasses.replace(own_sizes, cameras=len(viewmats))
    width, height = int(width), int(height)
    mode, by_z = Mode.of(render_mode), bool(global_z_order)
    # `project` cuts a fisheye by the distance.
    planes = (near_plane, far_plane) if camera_model == "fisheye" and by_z else None
    settings = settings_of(
        viewmats,
        Ks,
        width,
        height,
        near=near_plane,
        far=far_plane if planes is None else math.inf,
        camera_model=camera_model,
        coefficients=coefficients,
        footprint=settled,
    )
    if covars is None:
        covariances = {"scales": scales, "rotations": quats}
    else:
        covariances = {"cov3D_precomp": upper_triangle(covars)}
    gaussians = {"means3D": means, "opacities": opacities, **covariances}
    scene = Scene(sizes, gaussians, viewmats, settings, camera_model, by_z)
    splats = scene.ordered(scene.project(signal if mode.colors and sh_degree is not None else None))
    measures = measure(splats, settled, radius_clip, planes)
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

    features = scene.features(splats, mode, signal, extra, bool(return_normals))
    channels = {name: rows.shape[1] for name, rows in features.items()}
    rows = torch.cat(list(features.values()), 1) if len(features) > 1 else next(iter(features.values()))
    blended = splats
    if sharing is not None:
        blended, absolute = sharing.send(splats, rows, absolute)
        rows = blended.colors  # of any number of channels, which `list_tiles` does not take
        blended = dataclasses.replace(blended, colors=rows.new_empty(0, 3))
    background = None
    if backgrounds is not None and mode.colors:  # there is none behind the other channels
        background = torch.nn.functional.pad(backgrounds.flatten(0, -2), (0, rows.shape[1] - channels["colors"]))
    images, alphas = _blend(blended, rows, background, absolute)
    dims = (*sizes.batch, own_sizes.cameras)
    images, alphas = images.unflatten(0, dims), alphas.unflatten(0, dims)
    made = dict(zip(channels, images.split(list(channels.values()), -1)))
    if mode.expected:
        made["depth"] = made["depth"] / alphas.clamp(min=_SMALLEST_ALPHA)
    if mode.expected or not made.keys() <= {"colors", "depth"}:
        images = torch.cat([made[name] for name in ("colors", "depth") if name in made], -1)

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
    for key, name in (("render_extra_signals", "extra"), ("normals", "normals")):
        if name in made:
            meta[key] = made[name].contiguous()
    return images, alphas, meta


def upper_triangle(matrices: torch.Tensor) -> torch.Tensor:
    """(..., 6) of (..., 3, 3)."""
    return torch.stack([matrices[..., row, column] for row in range(3) for column in range(row, 3)], -1)


def _blend(
    splats: Splats, features: torch.Tensor, backgrounds: torch.Tensor | None, absolute: torch.Tensor | None
) -> tuple[torch.Tensor, torch.Tensor]:
    """Images (B * C, H, W, K) and alphas (B * C, H, W, 1)."""
    lists = list_tiles(splats, keep=torch.is_grad_enabled())
    images, alphas = blend(splats, lists, features, backgrounds, means2d_abs=absolute)
    return images.permute(0, 2, 3, 1).contiguous(), alphas.permute(0, 2, 3, 1).contiguous()
