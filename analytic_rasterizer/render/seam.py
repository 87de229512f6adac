"""The seam of equirectangular pictures: their left and right borders are the same line of the sphere.

The kernels draw a splat at one place. So that a splat across the seam shows at both borders, its row is repeated a
turn further to the left or right, between the stages `project` and `list_tiles` (docs/internals/numerics.md,
"Equirectangular pictures").
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from torch.autograd.function import once_differentiable

from .. import _C
from ..cameras.lens import SPHERE
from ..checks import one_number, whole_number
from .effects import Effects

# Standard deviations along a row of pixels, in turns. Wider splats are narrowed to the first: their copies together
# vary by 2% at most around the turn. Narrower than the second, copies do not overlap: exp(-32) is rounding.
_WIDEST, _OVERLAPPING = 0.75, 0.125
_OPAQUE = 1 - 1e-6  # the logarithm of 1 - opacity has to be finite
_STEPS = 6  # of Newton's method, for the opacity of copies


def has_seam(settings: Any) -> bool:
    """Whether the picture is one of the sphere."""
    effects = getattr(settings, "effects", None)
    return isinstance(effects, Effects) and effects.lens is not None and effects.lens.model == SPHERE


def turns_of(cameras: Sequence[Any], like: torch.Tensor) -> torch.Tensor | None:
    """(C,) px of a turn of each camera, infinite without a seam; None if no camera has one. Reads the tangents.

    Raises:
        ValueError: A picture would be wider than a turn.
    """
    if not any(has_seam(s) for s in cameras):
        return None
    turns = []
    for s in cameras:
        if not has_seam(s):
            turns.append(like.new_tensor(math.inf))
            continue
        tangent = s.tanfovx
        number = one_number("tanfovx", tangent.detach() if isinstance(tangent, torch.Tensor) else tangent)
        if number > math.pi * (1 + 1e-6):
            raise ValueError(f"tanfovx of an equirectangular picture must be at most pi, a turn, got {number}")
        tangent = tangent if isinstance(tangent, torch.Tensor) else like.new_tensor(number)
        turns.append(math.pi * whole_number("image_width", s.image_width) / tangent.reshape(()).to(like))
    return torch.stack(turns)


class _Repeated(torch.autograd.Function):
    """`tensor[rows]` for ascending rows, each `counts` times. Gradients are summed in order: the same bits in every
    run."""

    @staticmethod
    def forward(ctx, tensor, rows, counts):
        ctx.save_for_backward(counts)
        return tensor.index_select(0, rows)

    @staticmethod
    @once_differentiable
    def backward(ctx, gradient):
        (counts,) = ctx.saved_tensors
        return torch.segment_reduce(gradient.contiguous(), "sum", lengths=counts, unsafe=True), None, None


def with_copies(
    splats: Any, turns: torch.Tensor, beside: torch.Tensor | None = None
) -> tuple[Any, torch.Tensor | None]:
    """Splats with a row for every place at which one may show. Differentiable in what `Splats` is, and in the turns.

    Copies follow the row that they repeat. A splat that is wider than the turn overlaps itself: its opacity is lowered,
    so that all of its copies together are as opaque as it was at its centre.

    Args:
        splats: `Splats`.
        turns: What `turns_of` returned.
        beside: (N, K) a row per splat, or None.

    Returns:
        The splats, and the repeated rows of `beside`.
    """
    s = splats
    turn = turns[s.camera_ids.long()]
    xx, xy, yy = s.cov2d.unbind(1)
    wide = xx > (_WIDEST * turn) ** 2
    narrowing = torch.where(wide, _WIDEST * turn / torch.where(wide, xx, 1).sqrt(), 1)
    cov2d = torch.stack([xx * narrowing**2, xy * narrowing, yy], 1)
    dets = s.dets * narrowing.detach() ** 2
    opacities = _of_one_copy(s.opacities, cov2d[:, 0], turn)
    with torch.no_grad():
        first, last = _places(s, cov2d[:, 0], turn)
        counts = last - first + 1
        ends = counts.cumsum(0)
        rows = torch.arange(len(counts), device=counts.device).repeat_interleave(counts)
        place = first[rows] + torch.arange(len(rows), device=counts.device) - (ends - counts)[rows]
        splits = torch.cat([ends.new_zeros(1), ends])[s.row_splits.to(ends.device)].cpu()

    def repeated(tensor: torch.Tensor) -> torch.Tensor:
        return _Repeated.apply(tensor, rows, counts) if tensor.is_floating_point() else tensor.index_select(0, rows)

    shift = repeated(torch.where(turn.isfinite(), turn, 0)) * place
    copies = replace(
        s,
        means2d=repeated(s.means2d) + torch.stack([shift, torch.zeros_like(shift)], 1),
        cov2d=repeated(cov2d),
        opacities=repeated(opacities),
        colors=repeated(s.colors) if len(s.colors) == len(counts) else s.colors,
        dets=dets.index_select(0, rows),
        row_splits=splits,
        **{name: repeated(getattr(s, name)) for name in ("depths", "radii", "gaussian_ids", "camera_ids")},
    )
    return copies, None if beside is None else repeated(beside)


def _of_one_copy(opacities: torch.Tensor, xx: torch.Tensor, turn: torch.Tensor) -> torch.Tensor:
    """The opacity o with prod_k (1 - o w_k) = 1 - opacity, where w_k is the splat's falloff at k turns.

    In x = -ln(1 - o) the logarithm of the product is concave: Newton's method rises to the solution.
    """
    overlap = xx > (_OVERLAPPING * turn) ** 2
    if not overlap.any():
        return opacities
    square = torch.where(overlap, turn**2 / torch.where(overlap, 2 * xx, 1), 1)
    falloff = torch.stack([(-(k**2) * square).exp() for k in range(1, 5)])
    wanted = -torch.log1p(-opacities.clamp(max=_OPAQUE))

    def newton(x: torch.Tensor) -> torch.Tensor:
        light = (-x).exp()
        left = 1 - falloff * (1 - light)
        slope = 1 + 2 * (falloff * light / left).sum(0)
        return x + (wanted - x + 2 * left.log().sum(0)) / slope.detach()

    with torch.no_grad():
        x = wanted / (1 + 2 * falloff.sum(0))
        for _ in range(_STEPS):
            x = newton(x)
    return torch.where(overlap, -torch.expm1(-newton(x)), opacities)  # the last step has the derivative


def _places(s: Any, xx: torch.Tensor, turn: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """First and last place, in turns from that of the row, at which a splat may show."""
    variance, level, margin = _C.reach_bounds(s.footprint, s.option)
    levels = level + 2 * s.opacities.clamp(min=1).log()
    reach = 2 + margin * ((xx + variance) * levels).sqrt()
    x = s.means2d[:, 0]
    first, last = ((-0.5 - reach - x) / turn).ceil(), ((s.width - 0.5 + reach - x) / turn).floor()
    return first.clamp(max=0).long(), last.clamp(min=0).long()
