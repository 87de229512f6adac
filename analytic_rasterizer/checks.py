"""Checks of arguments that more than one module makes."""

from __future__ import annotations

from typing import Any

import torch


def check_tensors(device: torch.device | None, **tensors: Any) -> None:
    """Raises unless all are tensors, and on `device` if it is given."""
    for name, tensor in tensors.items():
        if not isinstance(tensor, torch.Tensor):
            raise TypeError(f"{name} must be a tensor, got {type(tensor).__name__}")
        if device is not None and tensor.device != device:
            raise ValueError(f"{name} must be on the device of means3D, {device}, got {tensor.device}")
