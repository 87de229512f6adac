"""Fake kernels of the operators: shapes and dtypes of what they return, for tracing (torch.compile, torch.export).

The operators' schemas, kernels and gradients are in csrc/torch.
"""

from __future__ import annotations

from types import SimpleNamespace

import torch

from . import _C

_SAMPLES = {footprint["key"]: footprint["samples"] for footprint in _C.footprints()}


def _register(name: str):
    """Registers a fake kernel that takes the op's arguments as a namespace."""
    op = getattr(torch.ops.analytic_rasterizer, name).default
    names = [argument.name for argument in op._schema.arguments]
    defaults = {argument.name: argument.default_value for argument in op._schema.arguments}

    def register(kernel):
        @torch.library.register_fake(f"analytic_rasterizer::{name}")
        def fake(*args, **kwargs):
            return kernel(SimpleNamespace(**{**defaults, **dict(zip(names, args)), **kwargs}))

        return kernel

    return register


def _lists(like: torch.Tensor, rows: int, a, keep: bool, ids=None) -> list[torch.Tensor]:
    """What `list_tiles` makes of `rows` splats of one camera: ListTensors of csrc/torch/backend.h."""
    context = torch.library.get_ctx()
    on_cuda = like.device.type == "cuda"
    side = _C.tile_size(a.footprint, a.option, a.image_width, a.image_height, on_cuda)
    tiles = -(-a.image_height // side) * -(-a.image_width // side)
    pairs = context.new_dynamic_size()
    ints, longs = {"dtype": torch.int32}, {"dtype": torch.int64}
    return [
        like.new_empty(rows, _C.SPLAT_WIDTH),
        like.new_empty(rows, **ints),
        like.new_empty((pairs, 2 if keep else 1) if on_cuda else (pairs,), **ints),
        like.new_empty(tiles + 1, **longs),
        like.new_empty((rows, 2), **ints) if on_cuda else like.new_empty(rows + 1 if keep else 0, **longs),
        like.new_empty(pairs if keep and not on_cuda else 0, **longs),
        like.new_empty(context.new_dynamic_size() if on_cuda else 0, **longs),
    ]


def _state(like: torch.Tensor, a) -> list[torch.Tensor]:
    """What `blend` leaves for its adjoint: BlendState of csrc/torch/backend.h."""
    planes = _SAMPLES.get(a.footprint, 1), a.image_height, a.image_width
    ints = {"dtype": torch.int32}
    if like.device.type != "cuda":
        return [like.new_empty(planes), like.new_empty(planes, **ints), like.new_empty(0), like.new_empty(0, **ints)]
    context = torch.library.get_ctx()
    checkpoints, chunks = context.new_dynamic_size(), context.new_dynamic_size()
    return [
        like.new_empty(planes),
        like.new_empty(planes, **ints),
        like.new_empty(checkpoints),
        like.new_empty(chunks, 3, **ints),
    ]


def _channels(a) -> int:
    features = 0 if a.features is None else a.features.shape[1]
    return features + (a.shs.shape[-1] if a.colors_precomp is None else a.colors_precomp.shape[1])


def _splat_count(a):
    """Splats of rasterize: on CUDA the Gaussians, on the CPU those that the view shows."""
    return a.means3D.shape[0] if a.means3D.device.type == "cuda" else torch.library.get_ctx().new_dynamic_size()


@_register("rasterize")
def _(a):
    like, size, channels = a.means3D, (a.image_height, a.image_width), _channels(a)
    saved = []
    if a.keep:
        extra = a.depth + a.inverse_depth
        made = like.new_empty(like.shape[0], channels + extra) if extra or a.features is not None else like.new_empty(0)
        saved = [*_lists(like, _splat_count(a), a, True), *_state(like, a), made]
    images = [like.new_empty(size) for name in _C.IMAGES if getattr(a, name)]
    return like.new_empty(channels, *size), images, like.new_empty(like.shape[0], dtype=torch.int32), saved


@_register("rasterize_timed")
def _(a):
    *rasterized, saved = torch.ops.analytic_rasterizer.rasterize(**vars(a))
    if not a.keep:
        saved = _lists(a.means3D, _splat_count(a), a, False)
    return *rasterized, saved, torch.empty(3, dtype=torch.float64, device="cpu")


@_register("project")
def _(a):
    like = a.means3D
    rows, cameras = torch.library.get_ctx().new_dynamic_size(), a.viewmatrix.shape[0]
    colored = a.shs is not None or a.colors_precomp is not None
    ints = [like.new_empty(rows, dtype=torch.int32) for _ in range(4)]
    splits = [torch.empty(cameras + 1, dtype=torch.int64, device="cpu") for _ in range(2)]
    floats = [like.new_empty(rows, *rest) for rest in ((2,), (3,), (), ())]
    colors = like.new_empty(rows if colored else 0, 3)
    return *floats, colors, *ints[:3], splits[0], [like.new_empty(rows), ints[3], splits[1]]


@_register("count_rows")
def _(a):
    return a.means3D.new_empty(a.viewmatrix.shape[0], a.means3D.shape[0], dtype=torch.int32)


@_register("pack_rows_")
def _(a):
    return None


@_register("pack_rows_vjp")
def _(a):
    return _scene_gradients(a)


@_register("blend_rows")
def _(a):
    n, size, saved = a.rows.shape[0], (a.image_height, a.image_width), []
    if a.keep:
        saved = [*_lists(a.rows, n, a, True), *_state(a.rows, a), a.rows.new_empty(n, 4), a.rows.new_empty(n)]
    return a.rows.new_empty(3, *size), a.rows.new_empty(size), saved


@_register("blend_rows_vjp_")
def _(a):
    return a.background.new_empty(3 if a.needs_background else 0)


@_register("bin")
def _(a):
    context = torch.library.get_ctx()
    cameras = a.row_splits.shape[0] - 1
    rows = [a.means2d.shape[0]] if cameras == 1 else [context.new_dynamic_size() for _ in range(cameras)]
    return [tensor for n in rows for tensor in _lists(a.means2d, n, a, a.keep)]


@_register("blend")
def _(a):
    cameras, size = a.row_splits.shape[0] - 1, (a.image_height, a.image_width)
    saved = [tensor for _ in range(cameras) for tensor in _state(a.means2d, a)] if a.keep else []
    return (
        a.means2d.new_empty(cameras, a.features.shape[1], *size),
        a.means2d.new_empty(cameras, *size),
        saved,
    )


def _gradients(a, tensors) -> list[torch.Tensor]:
    """One like each of the tensors that want a gradient, and an empty one for the others."""
    like = tensors[0]
    return [like.new_empty(t.shape if need and t is not None else 0) for t, need in zip(tensors, a.needs)]


def _scene_gradients(a) -> list[torch.Tensor]:
    """Of the Gaussians and, with a lens, of the cameras."""
    camera = (a.viewmatrix, a.projmatrix, a.campos, a.lens) if a.lens is not None else (None,) * 4
    gaussians = (a.means3D, a.opacities, a.shs, a.colors_precomp, a.scales, a.rotations, a.cov3D_precomp)
    return _gradients(a, (*gaussians, *camera))


@_register("rasterize_vjp")
def _(a):
    camera = (a.viewmatrix.reshape(4, 4), a.projmatrix.reshape(4, 4), a.campos.reshape(3), a.lens)
    camera = camera if a.lens is not None else (None,) * 4
    gaussians = (a.means3D, a.means2D, a.opacities, a.shs, a.colors_precomp, a.scales, a.rotations, a.cov3D_precomp)
    return _gradients(a, (*gaussians, *camera, a.bg.reshape(-1), a.features))


@_register("project_vjp")
def _(a):
    return _scene_gradients(a)


@_register("blend_vjp")
def _(a):
    tensors = (a.means2d, a.cov2d, a.opacities, a.features, a.background, a.means2d_abs)
    return _gradients(a, (*tensors, a.dets, None))


@_register("inspect")
def _(a):
    (splats, ids), count = a.saved[:2], a.depths.shape[0]
    image = [ids.new_empty(a.image_height, a.image_width) for _ in range(2)]
    return [
        *image,
        ids.new_empty(count),
        splats.new_empty(count, dtype=torch.float32),
        ids.new_empty(count, dtype=torch.int64),
        *(ids.new_empty(count) for _ in range(2)),
    ]


@_register("footprint_weight")
def _(a):
    return a.offset.new_empty(a.offset.shape[:-1])


@_register("footprint_weight_vjp")
def _(a):
    return [a.offset.new_empty(a.offset.shape), a.cov2d.new_empty(a.cov2d.shape)]


def _partials(a) -> list[torch.Tensor]:
    """What ssim_map and l1_ssim leave for their adjoints: kSsimPartials planes of csrc/core/ssim.h."""
    return [a.image.new_empty(3, *a.image.shape)] if a.keep else []


@_register("ssim_map")
def _(a):
    return a.image.new_empty(a.image.shape), _partials(a)


@_register("l1_ssim")
def _(a):
    return a.image.new_empty(()), _partials(a)


@_register("ssim_map_vjp")
def _(a):
    return _gradients(a, (a.image, a.target))


@_register("l1_ssim_vjp")
def _(a):
    return _gradients(a, (a.image, a.target))


@_register("activate")
def _(a):
    return tuple(t.new_empty(t.shape) for t in (a.log_scales, a.quats, a.logit_opacities))


@_register("activate_vjp")
def _(a):
    return _gradients(a, (a.log_scales, a.quats, a.logit_opacities))


@_register("picture_gradients")
def _(a):
    gradients = [t.new_empty(t.shape) for t in (a.means, a.log_scales, a.quats, a.logit_opacities, a.shs)]
    gradients += [a.means.new_empty(a.means.shape[0], a.mean_columns)] if a.mean_columns else []
    image = a.means.new_empty(3, a.image_height, a.image_width)
    radii = a.means.new_empty(a.means.shape[0], dtype=torch.int32)
    return a.means.new_empty(()), image, radii, gradients


@_register("observe_")
def _(a):
    return None


@_register("adam_")
def _(a):
    return None
