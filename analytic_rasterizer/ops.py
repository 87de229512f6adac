"""The ops' fake kernels. Their gradients are in csrc/torch/autograd.cpp."""

from __future__ import annotations

import torch

from . import _C  # noqa: F401  (loads the ops)
from .footprints import BOX_SAMPLES

TILE = 16
"""Edge of a square tile, px."""

_SAMPLES = {f"box{s}": s for s in BOX_SAMPLES} | {"adaptive": max(BOX_SAMPLES)}
_SPLAT_WIDTH = 12


def _tiles(height: int, width: int) -> int:
    return ((height + TILE - 1) // TILE) * ((width + TILE - 1) // TILE)


@torch.library.register_fake("analytic_rasterizer::rasterize")
def _(
    means3D, means2D, opacities, shs, colors_precomp, scales, rotations, cov3D_precomp, bg,
    viewmatrix, projmatrix, campos, lens, image_height, image_width, tanfovx, tanfovy, scale_modifier,
    sh_degree, footprint, option, keep, alpha, debug,
):  # fmt: skip
    context = torch.library.get_ctx()
    covered = [means3D.new_empty(image_height, image_width)] if alpha else []
    samples = _SAMPLES.get(footprint, 1) if keep else 0
    ints, longs = {"dtype": torch.int32}, {"dtype": torch.int64}
    chosen = _tiles(image_height, image_width) if footprint == "adaptive" else 0
    tile_samples = means3D.new_empty(chosen, **ints)
    if means3D.device.type == "cuda":
        kept = means3D.shape[0] if keep else 0
        room = context.new_dynamic_size() if keep else 0
        checkpoints = (context.new_dynamic_size(), TILE * TILE, 4) if keep else (0,)
        return (
            means3D.new_empty(3, image_height, image_width),
            means3D.new_empty(means3D.shape[0], **ints),
            means3D.new_empty((kept, _SPLAT_WIDTH) if keep else (0,)),
            means3D.new_empty(kept, **ints),
            means3D.new_empty((room, 2) if keep else (0,), **ints),
            means3D.new_empty(_tiles(image_height, image_width) + 1 if keep else 0, **longs),
            means3D.new_empty((kept, 2) if keep else (0,), **ints),
            means3D.new_empty(0, **ints),
            means3D.new_empty(samples, image_height, image_width),
            means3D.new_empty(samples, image_height, image_width, **ints),
            means3D.new_empty(checkpoints),
            means3D.new_empty((context.new_dynamic_size(), 3) if keep else (0,), **ints),
            means3D.new_empty(12 if keep else 0, **longs),
            tile_samples,
            covered,
        )
    splats, pairs = context.new_dynamic_size(), context.new_dynamic_size()
    return (
        means3D.new_empty(3, image_height, image_width),
        means3D.new_empty(means3D.shape[0], **ints),
        means3D.new_empty(splats, _SPLAT_WIDTH),
        means3D.new_empty(splats, **ints),
        means3D.new_empty(pairs, **ints),
        means3D.new_empty(_tiles(image_height, image_width) + 1, **longs),
        means3D.new_empty(splats + 1 if keep else 0, **longs),
        means3D.new_empty(pairs if keep else 0, **longs),
        means3D.new_empty(samples, image_height, image_width),
        means3D.new_empty(samples, image_height, image_width, **ints),
        means3D.new_empty(0),
        means3D.new_empty(0, **ints),
        means3D.new_empty(0, **longs),
        tile_samples,
        covered,
    )


@torch.library.register_fake("analytic_rasterizer::rasterize_vjp")
def _(
    dL_dcolor, dL_dalpha, means3D, means2D, opacities, shs, colors_precomp, scales, rotations, cov3D_precomp, bg,
    viewmatrix, projmatrix, campos, lens, *rest,
):  # fmt: skip
    needs = rest[-2]

    def made(tensors, needs):
        return [means3D.new_empty(t.shape if need and t is not None else 0) for t, need in zip(tensors, needs)]

    gaussians = (means3D, means2D, opacities, shs, colors_precomp, scales, rotations, cov3D_precomp)
    of_camera = made((viewmatrix.reshape(4, 4), projmatrix.reshape(4, 4), campos.reshape(3), lens), needs[8:])
    return (*made(gaussians, needs[:8]), of_camera if lens is not None and any(needs[8:]) else [])


@torch.library.register_fake("analytic_rasterizer::rasterize_stages")
def _(
    means3D, opacities, shs, colors_precomp, scales, rotations, cov3D_precomp, bg, viewmatrix,
    projmatrix, campos, lens, image_height, image_width, *rest,
):  # fmt: skip
    context = torch.library.get_ctx()
    splats, pairs = context.new_dynamic_size(), context.new_dynamic_size()
    ints, longs = {"dtype": torch.int32}, {"dtype": torch.int64}
    return (
        means3D.new_empty(3, image_height, image_width),
        means3D.new_empty(means3D.shape[0], **ints),
        means3D.new_empty(splats, **ints),
        means3D.new_empty(splats),
        means3D.new_empty(splats, 2),
        means3D.new_empty(pairs, **ints),
        means3D.new_empty(_tiles(image_height, image_width) + 1, **longs),
        torch.empty(3, dtype=torch.float64),
    )


@torch.library.register_fake("analytic_rasterizer::rasterize_channels")
def _(colors, bg, image_height, image_width, footprint, option, splats, ids, pairs, tile_offsets, counts, *rest):
    on_cuda = colors.device.type == "cuda"
    ints = {"dtype": torch.int32}
    context = torch.library.get_ctx()
    return (
        colors.new_empty(3, image_height, image_width),
        colors.new_empty((context.new_dynamic_size(), TILE * TILE, 4) if on_cuda else (0,)),
        colors.new_empty((context.new_dynamic_size(), 3) if on_cuda else (0,), **ints),
        counts.new_empty(counts.shape),
    )


@torch.library.register_fake("analytic_rasterizer::inspect")
def _(splats, ids, pairs, tile_offsets, counts, tile_samples, count, image_height, image_width, footprint):
    return (
        ids.new_empty(image_height, image_width),
        ids.new_empty(image_height, image_width),
        ids.new_empty(count),
        splats.new_empty(count, dtype=torch.float32),
        tile_offsets.new_empty(count),
    )


@torch.library.register_fake("analytic_rasterizer::footprint_weight")
def _(offset, cov2d, footprint, option):
    return offset.new_empty(offset.shape[:-1])


@torch.library.register_fake("analytic_rasterizer::footprint_weight_vjp")
def _(dL_dweight, offset, cov2d, footprint, option):
    return offset.new_empty(offset.shape), cov2d.new_empty(cov2d.shape)
