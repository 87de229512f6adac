"""How Python calls the operators (`Op`), and their fake kernels: shapes and dtypes for torch.compile and torch.export.

Schemas, kernels and gradients are in csrc/torch. Names, their order, and widths of rows are read from the schemas and
from `_C`.
"""

from __future__ import annotations

import math
from functools import partial
from types import SimpleNamespace
from typing import Any

import torch
from torch.overrides import has_torch_function

from . import _C


class Op:
    """An operator, called by names of arguments in a fraction of the time of torch.ops.

    The quicker way is not known to torch.compile, nor to what overrides functions of torch, which get the other one.

    Attributes:
        results: Names of what it returns, in order.
    """

    def __init__(self, name: str):
        self._name, self._quick = name, _C.Call(name)
        schema = getattr(torch.ops.analytic_rasterizer, name).default._schema
        self.results = tuple(result.name for result in schema.returns)

    def __call__(self, **arguments: Any) -> tuple:
        if torch.compiler.is_compiling() or has_torch_function(tuple(arguments.values())):
            results = getattr(torch.ops.analytic_rasterizer, self._name)(**arguments)
            return results if isinstance(results, tuple) else (results,)
        return self._quick(**arguments)


_SAMPLES = {footprint["key"]: footprint["samples"] for footprint in _C.footprints()}


def _samples(a) -> int:
    return _SAMPLES.get(a.footprint.partition(_C.RAY_MARK)[0], 1)


def _is_along_rays(a) -> bool:
    """Whether splats are ordered along rays."""
    return _C.RAY_MARK in a.footprint


def _arguments(name: str) -> list[torch.Argument]:
    """The arguments of an op, by its schema."""
    return getattr(torch.ops.analytic_rasterizer, name).default._schema.arguments


def _is_tensor(type_: torch.Type) -> bool:
    """Whether an argument is a tensor, or an optional one."""
    return str(type_) in ("Tensor", "Optional[Tensor]")


def _register(name: str):
    """Registers a fake kernel that takes the op's arguments as a namespace."""
    names = [argument.name for argument in _arguments(name)]
    defaults = {argument.name: argument.default_value for argument in _arguments(name)}

    def register(kernel):
        @torch.library.register_fake(f"analytic_rasterizer::{name}")
        def fake(*args, **kwargs):
            return kernel(SimpleNamespace(**{**defaults, **dict(zip(names, args)), **kwargs}))

        return kernel

    return register


def _in_order(names: list[str], tensors: dict[str, torch.Tensor]) -> list[torch.Tensor]:
    """The tensors in the order of `names`, which are those of a struct of csrc/torch."""
    return [tensors[name] for name in names]


def _lists(like: torch.Tensor, rows: int, a, keep: bool) -> list[torch.Tensor]:
    """What `bin` makes of `rows` splats of one camera: ListTensors of csrc/torch/backend.h."""
    context = torch.library.get_ctx()
    on_cuda = like.device.type == "cuda"
    side = _C.tile_size(a.footprint, a.option, a.image_width, a.image_height, on_cuda)
    tiles = -(-a.image_height // side) * -(-a.image_width // side)
    pairs, width = context.new_dynamic_size(), _C.WIDTHS
    ints, longs = {"dtype": torch.int32}, {"dtype": torch.int64}
    tensors = {
        "splats": like.new_empty(rows, width["splats"]),
        "ids": like.new_empty(rows, **ints),
        "tile_offsets": like.new_empty(tiles + 1, **longs),
        "rays": like.new_empty(rows, width["rays"]) if _is_along_rays(a) else like.new_empty(0),
    }
    if on_cuda:
        tensors |= {
            "pairs": like.new_empty(pairs, width["pairs"] if keep else 1, **ints),
            "splat_offsets": like.new_empty(rows, width["splat_offsets"], **ints),
            "positions": like.new_empty(0, **longs),
            "counts": like.new_empty(width["counts"], **longs),
        }
    else:
        tensors |= {
            "pairs": like.new_empty(pairs, **ints),
            "splat_offsets": like.new_empty(rows + 1 if keep else 0, **longs),
            "positions": like.new_empty(pairs if keep else 0, **longs),
            "counts": like.new_empty(0, **longs),
        }
    return _in_order(_C.LISTS, tensors)


def _state(like: torch.Tensor, a) -> list[torch.Tensor]:
    """What `blend` saves for its adjoint: BlendState of csrc/torch/backend.h."""
    planes = _samples(a), a.image_height, a.image_width
    ints = {"dtype": torch.int32}
    tensors = {"transmittance": like.new_empty(planes), "last": like.new_empty(planes, **ints)}
    if like.device.type == "cuda":
        context = torch.library.get_ctx()
        tensors["checkpoints"] = like.new_empty(context.new_dynamic_size())
        tensors["chunks"] = like.new_empty(context.new_dynamic_size(), _C.WIDTHS["chunks"], **ints)
    else:
        tensors |= {"checkpoints": like.new_empty(0), "chunks": like.new_empty(0, **ints)}
    return _in_order(_C.STATE, tensors)


def _summary(like: torch.Tensor, count: int, a) -> list[torch.Tensor]:
    """What is wanted of SummaryTensors of csrc/torch/backend.h, as ops return it."""
    image, ints = (1, a.image_height, a.image_width), {"dtype": torch.int32}
    tensors = {"median": like.new_empty(image)} if a.median_depth else {}
    tensors |= {"dominant": like.new_empty(image, **ints)} if a.dominant_index else {}
    if a.gaussian_stats:
        tensors |= {name: like.new_empty(count, **ints) for name in ("touched", "in_front", "dominated")}
        tensors |= {"largest": like.new_empty(count, dtype=torch.float32), "total": like.new_empty(count)}
    return _in_order([name for name in _C.SUMMARY if name in tensors], tensors)


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
    radii = like.new_empty(like.shape[0], dtype=torch.int32)
    return like.new_empty(channels, *size), images, radii, _summary(like, like.shape[0], a), saved


@_register("rasterize_timed")
def _(a):
    *rasterized, saved = torch.ops.analytic_rasterizer.rasterize(**vars(a))
    if not a.keep:
        saved = _lists(a.means3D, _splat_count(a), a, False)
    return *rasterized, saved, torch.empty(3, dtype=torch.float64, device="cpu")


_LENS_WIDTH = sum(size for _, size in _C.LENS)


@_register("prepare_cameras")
def _(a):
    count, like = a.views.shape[0], a.views
    return tuple(like.new_empty(count, *rest) for rest in ((4, 4), (4, 4), (3,), (_LENS_WIDTH,)))


@_register("prepare_lens")
def _(a):
    return a.viewmatrix.new_empty(_LENS_WIDTH)


@_register("prepare_lens_vjp")
def _(a):
    for name in ("viewmatrix", "projmatrix"):  # may have one dimension more, of size 1
        setattr(a, name, getattr(a, name).reshape(4, 4))
    return _gradients(a, "prepare_lens")


@_register("project")
def _(a):
    like, cameras = a.means3D, a.viewmatrix.shape[0] if a.viewmatrix.dim() == 3 else 1
    count, ints = like.shape[-2], {"dtype": torch.int32}
    rows = cameras * count if a.table else torch.library.get_ctx().new_dynamic_size()
    sizes = a.table or [rows]
    colors = 3 if a.shs is not None or a.colors_precomp is not None else 0
    columns = colors + (0 if a.values is None else a.values.shape[-1]) + (a.shown != "none")
    floats = [like.new_empty(*shape) for shape in ((*sizes, 2), (rows, 3), sizes, sizes, (rows, columns))]
    radii = like.new_empty((*sizes, 2) if a.measured else rows, **ints)
    ids = [like.new_empty(0 if a.table else rows, **ints) for _ in range(2)]
    splits = [torch.empty(cameras + 1, dtype=torch.int64, device="cpu") for _ in range(2)]
    measured = like.new_empty((*sizes, 3) if a.measured else 0)
    shown = like.new_empty(sizes if a.measured and a.compensated else 0)
    slopes = like.new_empty((*sizes, 2) if _is_along_rays(a) else 0)
    saved = []
    if a.keep:
        saved = [radii.new_empty(radii.shape if a.table else (cameras, count)), splits[1]]
        saved += [ids[0].new_empty(rows)] if a.values is not None and not a.table else []
    return *floats, radii, *ids, splits[0], like.new_empty(rows), measured, shown, slopes, saved


@_register("composite")
def _(a):
    cameras, size, like = a.row_splits.shape[0] - 1, (a.image_height, a.image_width), a.means2d
    context, saved = torch.library.get_ctx(), []
    total = math.prod(like.shape[:-1])
    rows = [total] if cameras == 1 else [context.new_dynamic_size() for _ in range(cameras)]
    for n in rows if a.keep else ():
        saved += [*_lists(like, n, a, True), *_state(like, a)]
    if a.keep and a.expected:
        saved += [like.new_empty(cameras, *size) for _ in range(2)]
    return like.new_empty(cameras, *size, a.features.shape[1]), like.new_empty(cameras, *size, 1), saved


@_register("composite_vjp")
def _(a):
    pairs = dict.fromkeys(("means2d", "means2d_abs", "slopes"), (2,))
    rows = pairs | {"cov2d": (3,), "opacities": (), "dets": (), "depths": ()}
    for name, rest in rows.items():
        if getattr(a, name) is not None:
            setattr(a, name, getattr(a, name).reshape(-1, *rest))
    if a.background is not None:
        a.background = a.background.reshape(-1, a.background.shape[-1])
    return _gradients(a, "composite")


@_register("repeat_at_seam")
def _(a):
    context = torch.library.get_ctx()
    rows = context.new_dynamic_size()
    names = (
        "means2d",
        "cov2d",
        "opacities",
        "depths",
        "colors",
        "beside",
        "radii",
        "gaussian_ids",
        "camera_ids",
        "dets",
    )
    given = [getattr(a, name) for name in names]
    made = [a.means2d.new_empty(0) if t is None else t.new_empty(rows, *t.shape[1:]) for t in given]
    if a.colors.shape[0] == 0:
        made[names.index("colors")] = a.colors.new_empty(a.colors.shape)
    count, longs = a.means2d.shape[0], {"dtype": torch.int64}
    saved = []
    if a.keep:
        saved = [a.means2d.new_empty(n, **longs) for n in (count, rows)]
        saved += [a.means2d.new_empty(context.new_dynamic_size())]
    return *made, a.row_splits.new_empty(a.row_splits.shape), saved


@_register("count_rows")
def _(a):
    return a.means3D.new_empty(a.viewmatrix.shape[0], a.means3D.shape[0], dtype=torch.int32)


@_register("pack_rows_vjp")
def _(a):
    return _gradients(a, "count_rows")


@_register("blend_rows")
def _(a):
    n, size, saved = a.rows.shape[0], (a.image_height, a.image_width), []
    if a.keep:
        kept = {"covs": a.rows.new_empty(n, _C.WIDTHS["covs"]), "opacities": a.rows.new_empty(n)}
        saved = [*_lists(a.rows, n, a, True), *_state(a.rows, a), *_in_order(_C.KEPT_ROWS, kept)]
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


def _gradients(a, op: str) -> list[torch.Tensor]:
    """What the adjoint of `op` returns: a gradient for each of its tensors, empty for those that want none."""
    tensors = [getattr(a, argument.name) for argument in _arguments(op) if _is_tensor(argument.type)]
    like = tensors[0]
    return [like.new_empty(t.shape if need and t is not None else 0) for t, need in zip(tensors, a.needs)]


@_register("rasterize_vjp")
def _(a):
    for name, dims in {"viewmatrix": 2, "projmatrix": 2, "campos": 1, "bg": 1}.items():  # may have one more, of size 1
        tensor = getattr(a, name)
        setattr(a, name, tensor.reshape(tensor.shape[-dims:]))
    return _gradients(a, "rasterize")


@_register("inspect")
def _(a):
    return _summary(a.depths, a.depths.shape[0], a)


@_register("footprint_weight")
def _(a):
    return a.offset.new_empty(a.offset.shape[:-1])


@_register("footprint_weight_vjp")
def _(a):
    return [a.offset.new_empty(a.offset.shape), a.cov2d.new_empty(a.cov2d.shape)]


def _partials(a) -> list[torch.Tensor]:
    """What ssim_map and l1_ssim save for their adjoints: derivatives of csrc/core/ssim.h."""
    return [a.image.new_empty(_C.WIDTHS["partials"], *a.image.shape)] if a.keep else []


@_register("ssim_map")
def _(a):
    return a.image.new_empty(a.image.shape), _partials(a)


@_register("l1_ssim")
def _(a):
    return a.image.new_empty(()), _partials(a)


@_register("activate")
def _(a):
    penalty = a.log_scales.new_empty(() if a.opacity_weight or a.scale_weight else 0)
    return *(t.new_empty(t.shape) for t in (a.log_scales, a.quats, a.logit_opacities)), penalty


@_register("apply_3d_filter")
def _(a):
    return a.scales.new_empty(a.scales.shape), a.opacities.new_empty(a.opacities.shape)


@_register("correct_colors")
def _(a):
    return a.image.new_empty(a.image.shape)


@_register("picture_gradients")
def _(a):
    gradients = [t.new_empty(t.shape) for t in (a.means, a.log_scales, a.quats, a.logit_opacities, a.shs)]
    gradients += [a.means.new_empty(a.means.shape[0], a.mean_columns)] if a.mean_columns else []
    gradients += [a.means.new_empty(t.shape) for t in (a.exposure, a.vignetting) if t is not None]
    image = a.means.new_empty(a.target.shape)
    radii = a.means.new_empty(a.means.shape[0], dtype=torch.int32)
    return a.means.new_empty(()), image, radii, gradients


@_register("rows_picture_gradients")
def _(a):
    rows = a.rows.new_empty(a.rows.shape[0], _C.ROW_GRAD_WIDTHS[int(a.absolute)])
    return a.rows.new_empty(()), a.rows.new_empty(a.target.shape), rows


for _name in (
    "prepare_cameras",
    "repeat_at_seam",
    "project",
    "blend",
    "ssim_map",
    "l1_ssim",
    "activate",
    "apply_3d_filter",
    "correct_colors",
):
    _register(f"{_name}_vjp")(partial(_gradients, op=_name))
for _name in ("pack_rows_", "observe_", "add_noise_", "adam_"):  # which only write
    _register(_name)(lambda a: None)
