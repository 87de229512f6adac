"""A check of single numbers, for modules that the others import."""

from __future__ import annotations

import math
from numbers import Real

import torch


def check_number(name: str, value, at_least: float = -math.inf, above: float = -math.inf) -> None:
    """Raises TypeError or ValueError unless the value is a finite number within the bounds, or a tensor with one."""
    if isinstance(value, torch.Tensor):
        if value.numel() != 1:
            raise ValueError(f"{name} must be one number, got a tensor of shape {tuple(value.shape)}")
        return  # the value is not examined: on a device that would have to be waited for
    if isinstance(value, bool) or not isinstance(value, Real):  # numpy's are Real too
        raise TypeError(f"{name} must be a number, got {value!r}")
    if not (_is_finite(value) and value >= at_least and value > above):
        limit = f" and above {above}" if above > -math.inf else f" and at least {at_least}" if at_least == 0 else ""
        raise ValueError(f"{name} must be finite{limit}, got {value}")


def _is_finite(value: Real) -> bool:
    try:
        return math.isfinite(value)
    except OverflowError:  # an integer of hundreds of digits, as JSON may have
        return False
