"""Checks of arguments that more than one module makes."""

from __future__ import annotations

import math
from collections.abc import Iterable
from numbers import Real
from typing import Any

import numpy as np
import torch


def check_tensors(device: torch.device | None, **tensors: Any) -> None:
    """Raises unless all are tensors, and on `device` if it is given."""
    for name, tensor in tensors.items():
        if not isinstance(tensor, torch.Tensor):
            raise TypeError(f"{name} must be a tensor, got {type(tensor).__name__}")
        if device is not None and tensor.device != device:
            raise ValueError(f"{name} must be on the device of means3D, {device}, got {tensor.device}")


def check_finite(**tensors: torch.Tensor) -> None:
    """Raises ValueError with the place of the first number that is not finite. Waits for the device of tensors."""
    for name, tensor in tensors.items():
        finite = tensor.detach().isfinite()
        if not finite.all():
            place = tuple((~finite).nonzero()[0].tolist())
            raise ValueError(f"{name} must be finite, got {tensor[place].item()} at {place}")


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


def whole_number(name: str, value: Any) -> int:
    """The whole number that `value` is: an int, or what programs have in its place, such as 24.0 or a tensor of one.

    Raises:
        TypeError: It is not one number.
        ValueError: It is not whole.
    """
    if type(value) is int:
        return value

    def wrong(error: type[Exception]) -> Exception:  # made where it is raised: a tensor's text waits for its device
        return error(f"{name} must be a whole number, got {value!r}")

    if isinstance(value, (str, bytes, bool)):
        raise wrong(TypeError)
    try:
        number = int(value)
    except (TypeError, RuntimeError):  # of tensors with several numbers, with some versions of torch
        raise wrong(TypeError) from None
    except (ValueError, OverflowError):  # of NaN and infinity
        raise wrong(ValueError) from None
    if number != value:
        raise wrong(ValueError)
    return number


def one_number(name: str, value: Any) -> float:
    """The number that `value` is: a float, or what programs have in its place, such as a tensor of one.

    Raises:
        TypeError: It is not one number.
        ValueError: It is larger than any float.
    """
    try:
        return float(value)
    except OverflowError:
        raise ValueError(f"{name} must be a number that a float can hold, got a larger one") from None
    except (TypeError, ValueError, RuntimeError):  # which of them depends on the type and on the version of torch
        raise TypeError(f"{name} must be a number, got {value!r}") from None


def plain_value(name: str, value: Any, kind: type) -> Any:
    """The value as Python's own `kind`; sequences, as JSON and the command line have them, become tuples of int.

    Raises:
        TypeError: It is none.
        ValueError: A number that is not whole where it has to be.
    """
    if kind is int:
        return whole_number(name, value)
    if kind is tuple:
        if isinstance(value, (str, bytes)) or not hasattr(value, "__iter__"):
            raise TypeError(f"{name} must be a sequence of whole numbers, got {value!r}")
        items = tuple(value)
        try:
            return tuple(whole_number(name, item) for item in items)
        except (TypeError, ValueError) as error:
            raise type(error)(f"{name} must be whole numbers, got {items}") from None
    if kind is bool and isinstance(value, np.bool_):
        return bool(value)
    if kind is float and hasattr(value, "__float__") and not isinstance(value, (bool, np.bool_)):
        return float(value)
    if not isinstance(value, kind):
        expected = {float: "a number", bool: "a bool", str: "a string"}[kind]
        raise TypeError(f"{name} must be {expected}, got {value!r}")
    return value


def check_value(name: str, fits: bool, expected: str, got: Any) -> None:
    """Raises ValueError, naming an option, unless its value fits."""
    if not fits:
        raise ValueError(f"{name} must be {expected}, got {got}")


def did_you_mean(names: Iterable[str], between: str = " or ") -> str:
    """How an error goes on that knows what may have been meant; "" where it knows nothing."""
    near = between.join(names)
    return f"; did you mean {near}?" if near else ""


def _is_finite(value: Real) -> bool:
    try:
        return math.isfinite(value)
    except OverflowError:  # an integer of hundreds of digits, as JSON may have
        return False
