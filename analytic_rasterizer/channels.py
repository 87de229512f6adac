"""Colours of any number of channels, backgrounds and outputs, from the op that renders three colours.

Depth and further channels are blended like colours, three at a time, by the kernels and over the lists of the colours:
a group of three costs a blend, not a projection or a sort, and no other kernel had to be made, or pays for it. Alpha is
what the blend of the colours has left over, and costs no more than its plane.
"""

from __future__ import annotations

import torch

from .effects import Effects, GaussianStats, Outputs, depths

MAX_CHANNELS = 512
_GROUP = 3  # channels that are blended at once
_UNIT = 2.0**-32  # of sums of weights
_COLOR = slice(9, 12)  # of a row of splats: kSplatColor in csrc/core/params.h


def is_plain(effects: Effects | None, colors: torch.Tensor | None, bg: torch.Tensor) -> bool:
    """Whether three colours on one background is all there is to render."""
    wide = isinstance(colors, torch.Tensor) and colors.dim() == 2 and colors.shape[1] != _GROUP
    image = isinstance(bg, torch.Tensor) and bg.dim() == 3
    return not (wide or image or (effects is not None and effects.has_outputs))


def render(rasterize, gaussians: tuple, settings: tuple, effects: Effects, debug: bool):
    """(color, radii, `Outputs`) of colours with any number of channels, on a background of as many, and of effects.

    Args:
        rasterize: The op, or what stands for it: its arguments to its outputs, all in one row.
        gaussians: means3D, means2D, opacities, shs, colors_precomp, scales, rotations, cov3D_precomp.
        settings: The op's arguments after these, up to `keep`; bg first.
        effects: What to add.
        debug: Passed on.

    Raises:
        ValueError: colors_precomp or bg has a wrong shape.
    """
    means3D, means2D, opacities, shs, colors, *shape = gaussians
    bg, view, *rest = settings
    height, width = rest[3], rest[4]
    channels = _GROUP if colors is None else _count_channels(colors, len(means3D))
    bg, bg_image = _split_background(bg, channels, height, width)
    if channels > _GROUP and opacities.numel() == len(means3D):
        # A row that is not finite would spread to its pixels: such a Gaussian is culled, as one with a bad colour is.
        finite = colors.detach().isfinite().all(1, keepdim=True)
        opacities = torch.where(finite.reshape(opacities.shape), opacities, torch.nan)

    first = colors if colors is None else _padded(colors[:, :_GROUP])
    extra, extra_bg = [], []
    if channels > _GROUP:
        extra.append(colors[:, _GROUP:])
        extra_bg.append(bg[_GROUP:])
    features = _features(effects, means3D, view)
    camera = (view, *rest[:3])
    extra += features.values()
    extra_bg.append(bg.new_zeros(len(features)))

    inputs = (means3D, means2D, opacities, shs, first, *shape)
    looks = effects.median_depth or effects.dominant_index or effects.gaussian_stats
    keep = torch.is_grad_enabled() and any(t is not None and t.requires_grad for t in (*inputs, *camera))
    main_bg = _padded(bg[None, :_GROUP])[0].contiguous()
    with_alpha = effects.alpha or bg_image is not None
    color, radii, *saved = rasterize(*inputs, main_bg, view, *rest, keep or bool(extra) or looks, with_alpha, debug)
    alpha = saved.pop() if with_alpha else None
    planes = [color[:channels]]
    if extra:
        table, table_bg = _padded(torch.cat(extra, 1)), _padded(torch.cat(extra_bg)[None])[0]
        geometry = (means3D, means2D, opacities, *shape)
        for i in range(0, table.shape[1], _GROUP):
            group, group_bg = table[:, i : i + _GROUP].contiguous(), table_bg[i : i + _GROUP].contiguous()
            planes.append(_Channels.apply(group, group_bg, *geometry, *camera, rest[3:], debug, *saved))
    image = torch.cat(planes) if len(planes) > 1 else planes[0]
    color, outputs = image[:channels], dict(zip(features, image[channels:].split(1)))
    if bg_image is not None:
        color = color + (1 - alpha) * bg_image
    if effects.alpha:
        outputs["alpha"] = alpha[None]
    if looks:
        outputs |= _look(effects, means3D, view, saved, height, width, footprint=rest[-2])
    return color, radii, Outputs(**outputs)


@torch.no_grad()
def _look(effects: Effects, means3D: torch.Tensor, view: torch.Tensor, saved: list, height, width, footprint) -> dict:
    """The outputs without a gradient, by name."""
    splats, ids, pairs, offsets, *_, counts, samples = saved
    median, dominant, pixels, largest, total = torch.ops.analytic_rasterizer.inspect(
        splats, ids, pairs, offsets, counts, samples, len(means3D), height, width, footprint
    )
    outputs = {}
    if effects.median_depth:
        z = depths(means3D, view)
        of_pixel = z[median.clamp_min(0).long()] if len(z) else z.new_zeros(median.shape)
        outputs["median_depth"] = torch.where(median < 0, 0, of_pixel)[None]
    if effects.dominant_index:
        outputs["dominant_index"] = dominant[None]
    if effects.gaussian_stats:
        outputs["gaussian_stats"] = GaussianStats(pixels, largest, (total.double() * _UNIT).to(means3D.dtype))
    return outputs


def _features(effects: Effects, means3D: torch.Tensor, view: torch.Tensor) -> dict:
    """A column (P, 1) for every output that is blended like a colour, by name."""
    if not (effects.depth or effects.inverse_depth):
        return {}
    z = depths(means3D, view)[:, None]
    z = torch.where(z > effects.near, z, 1)  # the others are culled, and 0 times infinity would not be
    features = {"depth": z} if effects.depth else {}
    return features | ({"inverse_depth": 1 / z} if effects.inverse_depth else {})


def _count_channels(colors: torch.Tensor, count: int) -> int:
    if colors.dim() != 2 or colors.shape[0] != count or not 1 <= colors.shape[1] <= MAX_CHANNELS:
        raise ValueError(
            f"colors_precomp must have shape ({count}, C) with C from 1 to {MAX_CHANNELS}, got {tuple(colors.shape)}"
        )
    return colors.shape[1]


def _split_background(bg: torch.Tensor, channels: int, height: int, width: int):
    """(one value per channel, an image or None)."""
    if bg.dim() == 3:
        if bg.shape != (channels, height, width):
            raise ValueError(f"bg must have shape ({channels}, {height}, {width}), got {tuple(bg.shape)}")
        return bg.new_zeros(channels), bg
    if bg.shape != (channels,):
        raise ValueError(f"bg must have shape ({channels},) or that of the image, got {tuple(bg.shape)}")
    return bg, None


def _padded(table: torch.Tensor) -> torch.Tensor:
    """With columns of zeros up to whole groups."""
    missing = -table.shape[1] % _GROUP
    return torch.nn.functional.pad(table, (0, missing)) if missing else table


class _Channels(torch.autograd.Function):
    """Other colours (P, 3) over the lists that `rasterize` has kept: `saved` is what it returned between the radii and
    alpha."""

    @staticmethod
    def forward(
        ctx, colors, bg, means3D, means2D, opacities, scales, rotations, cov3D, view, proj, campos, lens, numbers,
        debug, *saved,
    ):  # fmt: skip
        height, width, *_, footprint, option = numbers
        splats, ids, pairs, offsets, splat_offsets, positions, transmittance, last, _, _, counts, samples = saved
        image, *own = torch.ops.analytic_rasterizer.rasterize_channels(
            colors, bg, height, width, footprint, option, splats, ids, pairs, offsets, counts, samples,
            any(ctx.needs_input_grad), debug,
        )  # fmt: skip
        ctx.save_for_backward(
            means3D, means2D, opacities, colors, scales, rotations, cov3D, bg, view, proj, campos, lens,
            splats, *own, ids, pairs, offsets, splat_offsets, positions, transmittance, last, samples,
        )  # fmt: skip
        ctx.numbers, ctx.debug = numbers, debug
        return image

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, dL_dimage):
        (
            means3D, means2D, opacities, colors, scales, rotations, cov3D, bg, view, proj, campos, lens,
            splats, checkpoints, chunks, counts, ids, pairs, offsets, splat_offsets, positions, transmittance, last,
            samples,
        ) = ctx.saved_tensors  # fmt: skip
        splats = splats.clone()  # with the colours again, rather than kept for every group
        splats[:, _COLOR] = colors if splats.is_cuda else colors[ids.long()]
        inputs = (means3D, means2D, opacities, None, colors, scales, rotations, cov3D)
        wanted = ctx.needs_input_grad
        needs = [wanted[2], wanted[3], wanted[4], False, wanted[0], *wanted[5:8]]
        needs += [lens is not None and want for want in wanted[8:12]]
        *grads, of_camera = torch.ops.analytic_rasterizer.rasterize_vjp(
            dL_dimage, None, *inputs, bg, view, proj, campos, lens, *ctx.numbers,
            splats, ids, pairs, offsets, splat_offsets, positions, transmittance, last, checkpoints, chunks, counts,
            samples, needs, ctx.debug,
        )  # fmt: skip
        grads = [grad if need else None for grad, need in zip([*grads, *(of_camera or [None] * 4)], needs)]
        of_camera = [None if g is None else g.view_as(t) for g, t in zip(grads[8:], (view, proj, campos, lens))]
        return (grads[4], None, *grads[:3], *grads[5:8], *of_camera, None, None, *[None] * 12)
