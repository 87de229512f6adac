"""The seam of equirectangular pictures: their left and right borders are the same line of the sphere.

The kernels draw a splat at one place. So that a splat across the seam shows at both borders, its row is repeated a
turn further to the left or right, between the stages `project` and `list_tiles`, by the op `repeat_at_seam`
(csrc/torch/seam.cpp; docs/internals/numerics.md, "Equirectangular pictures").
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch

from ..cameras.lens import SPHERE
from ..checks import one_number, whole_number
from ..ops import Op
from .effects import Effects

_repeat = Op("repeat_at_seam")
_ROWS = tuple(name for name in _repeat.results if name not in ("beside", "saved"))


def has_seam(settings: Any) -> bool:
    """Whether the picture is one of the sphere."""
    effects = getattr(settings, "effects", None)
    return isinstance(effects, Effects) and effects.lens is not None and effects.lens.model == SPHERE


def turn_of(settings: Any) -> float:
    """px of a turn of a picture with a seam; 0 without one. Reads the tangent.

    Raises:
        ValueError: The picture would be wider than a turn.
    """
    if not has_seam(settings):
        return 0.0
    tangent = settings.tanfovx
    number = one_number("tanfovx", tangent.detach() if isinstance(tangent, torch.Tensor) else tangent)
    if number > math.pi * (1 + 1e-6):
        raise ValueError(f"tanfovx of an equirectangular picture must be at most pi, a turn, got {number}")
    return math.pi * whole_number("image_width", settings.image_width) / number


def turns_of(cameras: Sequence[Any], like: torch.Tensor) -> torch.Tensor | None:
    """(C,) px of a turn of each camera, infinite without a seam; None if no camera has one. Reads the tangents.

    Raises:
        ValueError: A picture would be wider than a turn.
    """
    numbers = [turn_of(s) for s in cameras]
    if not any(numbers):
        return None
    turns = []
    for s, turn in zip(cameras, numbers):
        if turn and isinstance(s.tanfovx, torch.Tensor):  # which may require a gradient
            turns.append(math.pi * whole_number("image_width", s.image_width) / s.tanfovx.reshape(()).to(like))
        else:
            turns.append(like.new_tensor(turn or math.inf))
    return torch.stack(turns)


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
    rows = {name: getattr(splats, name) for name in _ROWS}
    made = dict(zip(_repeat.results, _repeat(**rows, turns=turns, beside=beside, **splats.size)))
    return replace(splats, **{name: made[name] for name in _ROWS}), None if beside is None else made["beside"]
