"""Checks of arguments that more than one module makes."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from .settings import whole_number


def check_tensors(device: torch.device | None, **tensors: Any) -> None:
    """Raises unless all are tensors, and on `device` if it is given."""
    for name, tensor in tensors.items():
        if not isinstance(tensor, torch.Tensor):
            raise TypeError(f"{name} must be a tensor, got {type(tensor).__name__}")
        if device is not None and tensor.device != device:
            raise ValueError(f"{name} must be on the device of means3D, {device}, got {tensor.device}")


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
