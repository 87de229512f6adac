"""Rendering with an equirectangular lens: `render` of rasterizer.py from the stages, between which seam.py works."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch.autograd.function import once_differentiable

from .. import _C
from ..checks import check_tensors, whole_number
from . import advice
from .autocast import way_out_of, widened
from .effects import Effects, Outputs
from .outputs import before_background, named_summary, split_background
from .seam import with_copies
from .settings import check_settings
from .stages import Splats, TileLists, blend, list_tiles, project_once


class _MeansGradient(torch.autograd.Function):
    """Zeros beside means2d and its absolute sums, (V, 2) each: their gradients become that of means2D."""

    @staticmethod
    def forward(ctx, means2D, ids, half_size, sums_in_z):
        ctx.save_for_backward(ids, half_size)
        ctx.shape, ctx.sums_in_z = means2D.shape, sums_in_z
        zeros = means2D.new_zeros(len(ids), 2)
        return zeros, zeros.clone()

    @staticmethod
    @once_differentiable
    def backward(ctx, by_means, by_sums):
        ids, half_size = ctx.saved_tensors
        gradient = by_means.new_zeros(ctx.shape)
        gradient[ids, :2] = half_size * by_means
        if ctx.shape[1] == 4:
            gradient[ids, 2:] = half_size * by_sums
        elif ctx.sums_in_z:
            gradient[ids, 2] = (half_size * by_sums).sum(1)
        return gradient, None, None, None


def render_sphere(
    settings: Any,
    outputs: Effects,
    means3D: torch.Tensor,
    means2D: torch.Tensor | None,
    opacities: torch.Tensor,
    shs: torch.Tensor | None,
    colors_precomp: torch.Tensor | None,
    scales: torch.Tensor | None,
    rotations: torch.Tensor | None,
    cov3D_precomp: torch.Tensor | None,
    features: torch.Tensor | None = None,
) -> tuple:
    """As `render` of rasterizer.py. The host waits for the device, which counts the splats.

    Raises:
        ValueError: Also for `gaussian_stats`, `debug` and `means2d_z` "sum_norm", which this lens does not have.
    """
    check_settings(settings)
    outputs = outputs.with_outputs_of(settings.effects)
    _check_composes(settings, outputs)
    means3D, bg = widened(means3D), widened(settings.bg)
    means2D, shs, colors_precomp, features = (
        None if isinstance(t, torch.Tensor) and t.dim() == 1 and t.numel() == 0 else widened(t)
        for t in (means2D, shs, colors_precomp, features)
    )
    _check_tensors(means3D, bg, means2D, shs, colors_precomp, features)
    size = whole_number("image_height", settings.image_height), whole_number("image_width", settings.image_width)
    bg, bg_image = split_background(bg, colors_precomp, size)
    three = colors_precomp is None or colors_precomp.shape[1] == 3
    given = [t for t in (None if three else colors_precomp, features) if t is not None]
    fits = isinstance(opacities, torch.Tensor) and opacities.numel() == len(means3D)  # else `project` raises
    for tensor in given if fits else ():  # a row that is not finite culls its Gaussian
        opacities = torch.where(tensor.isfinite().all(1).reshape(opacities.shape), opacities, 0)
    splats, turns = project_once(
        [settings],
        means3D,
        opacities,
        shs=shs,
        colors_precomp=colors_precomp if three else None,
        scales=scales,
        rotations=rotations,
        cov3D_precomp=cov3D_precomp,
    )
    radii = torch.zeros(len(means3D), dtype=torch.int32, device=means3D.device)
    radii[splats.gaussian_ids.long()] = splats.radii
    splats, sums = _with_means_gradient(splats, means2D, size, settings.means2d_z == "sum_abs")
    splats, sums = with_copies(splats, turns, sums)
    lists = list_tiles(splats, keep=torch.is_grad_enabled())

    ids, depth = splats.gaussian_ids.long(), splats.depths[:, None]
    channels = ([splats.colors] if three else []) + [t[ids] for t in given]
    colors = sum(c.shape[1] for c in channels)
    channels += [depth] * outputs.depth + [1 / depth] * outputs.inverse_depth
    background = torch.nn.functional.pad(bg, (0, sum(c.shape[1] for c in channels) - len(bg)))
    image, alpha = blend(splats, lists, torch.cat(channels, 1), background, means2d_abs=sums)
    color, others = image[0, :colors], list(image[0, colors:, None])
    if bg_image is not None:
        color = before_background(color, alpha[0], bg_image)
    if advice.is_due and settings.footprint is None:
        advice.give(settings)
    if not outputs.has_outputs:
        return color, radii
    made = {"alpha": alpha[0]} if outputs.alpha else {}
    made |= zip((name for name in ("depth", "inverse_depth") if getattr(outputs, name)), others)
    if outputs.median_depth or outputs.dominant_index:
        made |= _summary(outputs, splats, lists, size)
    return color, radii, Outputs(**made)


def _with_means_gradient(
    splats: Splats, means2D: torch.Tensor | None, size: tuple[int, int], sums_in_z: bool
) -> tuple[Splats, torch.Tensor | None]:
    """Splats through which means2D gets its gradient, and (V, 2) for absolute sums; None: not wanted.

    Args:
        splats: V of them.
        means2D: (P, 3) or (P, 4).
        size: (height, width), px.
        sums_in_z: Column 2 of the gradient is the total of the sums, otherwise they are columns 2 and 3 of four.
    """
    if means2D is None or not means2D.requires_grad or not torch.is_grad_enabled():
        return splats, None
    half_size = splats.means2d.new_tensor([size[1] / 2, size[0] / 2])
    nothing, sums = _MeansGradient.apply(means2D, splats.gaussian_ids.long(), half_size, sums_in_z)
    splats = replace(splats, means2d=splats.means2d + nothing)
    return splats, sums if sums_in_z or means2D.shape[1] == 4 else None


def _summary(outputs: Effects, splats: Splats, lists: TileLists, size: tuple[int, int]) -> dict[str, torch.Tensor]:
    """Median depth and dominant index, (1, H, W) each, as far as wanted, by the names of `Outputs`."""
    wanted = {name: getattr(outputs, name) for name in _C.SUMMARIES}
    summary = torch.ops.analytic_rasterizer.inspect(
        list(lists.tensors), splats.depths.detach(), *size, splats.footprint, splats.option, **wanted
    )
    made = named_summary(outputs, summary)
    if outputs.dominant_index:
        ids = torch.cat([splats.gaussian_ids, splats.gaussian_ids.new_tensor([-1])])  # row -1: nothing
        made["dominant_index"] = ids[made["dominant_index"].long()]
    return made


def _check_composes(settings: Any, outputs: Effects) -> None:
    """Raises ValueError for what this way of rendering does not have."""
    wrong = {"gaussian_stats": outputs.gaussian_stats, "debug": bool(settings.debug)}
    for name, on in wrong.items():
        if on:
            raise ValueError(f"{name} must be False with an equirectangular lens, got True")
    if settings.means2d_z not in ("zero", "sum_abs"):
        raise ValueError(
            "means2D must get no sum over lengths of gradients with an equirectangular lens, got means2d_z = "
            f"{settings.means2d_z!r}"
        )


def _check_tensors(means3D: Any, bg: Any, means2D: Any, shs: Any, colors_precomp: Any, features: Any) -> None:
    """Raises TypeError and ValueError for what `project` does not look at."""
    check_tensors(None, means3D=means3D)
    check_tensors(means3D.device, bg=bg)
    if (shs is None) == (colors_precomp is None):
        got = "neither" if shs is None else "both"
        raise ValueError(f"exactly one of shs and colors_precomp must be given, got {got}")
    channels = range(1, _C.MAX_CHANNELS + 1)
    expected = {
        "means2D": (means2D, (3, 4), "(P, 3) or (P, 4)"),
        "colors_precomp": (colors_precomp, channels, f"(P, C) with C from 1 to {_C.MAX_CHANNELS}"),
        "features": (features, channels[:-3], f"(P, K) with K from 1 to {_C.MAX_CHANNELS - 3}"),
    }
    count = len(means3D) if means3D.dim() else 0
    for name, (tensor, columns, shape) in expected.items():
        if tensor is None:
            continue
        check_tensors(means3D.device, **{name: tensor})
        _check_dtype(name, tensor, means3D)
        if tensor.dim() != 2 or len(tensor) != count or tensor.shape[1] not in columns:
            raise ValueError(f"{name} must have shape {shape} with P = {count}, got {tuple(tensor.shape)}")
    _check_dtype("bg", bg, means3D)
    wide = 3 if colors_precomp is None else colors_precomp.shape[1]
    if bg.dim() < 3 and bg.shape != (wide,):
        raise ValueError(f"bg must have shape ({wide},), got {tuple(bg.shape)}")


def _check_dtype(name: str, tensor: torch.Tensor, means3D: torch.Tensor) -> None:
    if tensor.dtype != means3D.dtype:
        got = f"{tensor.dtype}{way_out_of(tensor.dtype)}"
        raise TypeError(f"{name} must have the dtype of means3D, {means3D.dtype}, got {got}")
