"""Arguments under torch.autocast: those of 16 bits are used in float32, as torch's own operators do that need float32.

The operators cast by themselves (csrc/torch/autocast.cpp). This is for what Python computes with arguments before.
"""

from __future__ import annotations

from typing import Any

import torch

_HALVES = torch.float16, torch.bfloat16


def widened(value: Any) -> Any:
    """A tensor of 16 bits in float32 where autocast is on for its device, differentiable; anything else as it is."""
    if not isinstance(value, torch.Tensor) or value.dtype not in _HALVES:
        return value
    device = value.device.type
    return value.float() if device in ("cpu", "cuda") and torch.is_autocast_enabled(device) else value


def widened_settings(settings: Any) -> Any:
    """Settings whose tensors are widened."""
    tensors = {name: getattr(settings, name) for name in ("bg", "viewmatrix", "projmatrix", "campos")}
    changed = {name: wide for name, tensor in tensors.items() if (wide := widened(tensor)) is not tensor}
    return settings._replace(**changed) if changed else settings


def way_out_of(dtype: torch.dtype) -> str:
    """What to do with numbers of 16 bits, for the end of a message; nothing for others."""
    if dtype not in _HALVES:
        return ""
    return ": call .float() on it, or use torch.autocast, under which this happens by itself"
