"""Tests on machines without a GPU, of programs that ask for CUDA by name.

`cuda_on_cpu` is a context manager, and a pytest fixture in `analytic_rasterizer.testing.fixtures`. What it covers, and
what a program has to change itself: docs/ci.md.
"""

from __future__ import annotations

import contextlib
import importlib
import time
from collections.abc import Callable, Iterator
from typing import Any
from unittest import mock

import torch
from torch.overrides import TorchFunctionMode

__all__ = ["cuda_on_cpu"]

_TENSOR_TYPES = ("Float", "Double", "Half", "BFloat16", "Byte", "Char", "Short", "Int", "Long", "Bool")


def _moved(value: Any) -> Any:
    """The CPU in place of a CUDA device, by name or as a torch.device; any other value as it is."""
    if isinstance(value, str) and (value == "cuda" or value.startswith("cuda:")):
        return "cpu"
    if isinstance(value, torch.device) and value.type == "cuda":
        return torch.device("cpu")
    return value


def _moved_device(value: Any) -> Any:
    """As _moved, where a whole number is the index of a CUDA device."""
    return "cpu" if isinstance(value, int) and not isinstance(value, bool) else _moved(value)


class _CudaToCpu(TorchFunctionMode):
    """Replaces CUDA devices among the arguments of torch's functions."""

    def __torch_function__(
        self, func: Callable, types: Any, args: tuple = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        kwargs = {name: _moved(value) for name, value in (kwargs or {}).items()}
        if func in (torch.Tensor.cuda, torch.Tensor.pin_memory):
            return torch.Tensor.cpu(args[0])
        if "device" in kwargs:
            kwargs["device"] = _moved_device(kwargs["device"])
        if kwargs.get("pin_memory"):
            kwargs["pin_memory"] = False
        if func is torch.Tensor.to:
            args = (args[0], *map(_moved_device, args[1:2]), *args[2:])
        if func is torch.Tensor.type and len(args) > 1 and isinstance(args[1], str):
            args = (args[0], args[1].replace("torch.cuda.", "torch."), *args[2:])
        return func(*args, **kwargs)


class _Event:
    """torch.cuda.Event by the clock of the host, on which work on the CPU is done when its call returns."""

    def __init__(self, enable_timing: bool = False, blocking: bool = False, interprocess: bool = False):
        self._recorded: float | None = None

    def record(self, stream: Any = None) -> None:
        self._recorded = time.perf_counter()

    def elapsed_time(self, end_event: _Event) -> float:
        """Milliseconds from this event to `end_event`. Raises RuntimeError where one was not recorded."""
        if self._recorded is None or end_event._recorded is None:
            raise RuntimeError("both events must be recorded before elapsed_time is asked for")
        return 1000 * (end_event._recorded - self._recorded)

    def synchronize(self) -> None:
        pass

    def wait(self, stream: Any = None) -> None:
        pass

    def query(self) -> bool:
        return True


def _nothing(*_: Any, **__: Any) -> None:
    pass


@contextlib.contextmanager
def _no_device(*_: Any) -> Iterator[None]:
    yield


def _replacements() -> dict[tuple[Any, str], Any]:
    """What torch's functions over tensors do not reach, by owner and name."""
    load, set_default_device = torch.load, torch.set_default_device

    def load_on_cpu(f: Any, map_location: Any = None, *args: Any, **kwargs: Any) -> Any:
        return load(f, "cpu" if map_location is None else _moved(map_location), *args, **kwargs)

    cuda = torch.cuda
    return {
        (torch, "load"): load_on_cpu,
        (torch, "set_default_device"): lambda device: set_default_device(_moved(device)),
        (cuda, "Event"): _Event,
        (cuda, "device"): _no_device,
        (cuda, "set_device"): _nothing,
        (cuda, "synchronize"): _nothing,
        (cuda, "empty_cache"): _nothing,
        (cuda, "reset_peak_memory_stats"): _nothing,
        (cuda, "current_device"): lambda: 0,
        **{(cuda, f"{name}Tensor"): getattr(torch, f"{name}Tensor") for name in _TENSOR_TYPES},
    }


@contextlib.contextmanager
def cuda_on_cpu() -> Iterator[None]:
    """Within it, this thread's requests for CUDA give tensors on the CPU, on machines with and without a GPU.

    For tests of programs that say `.cuda()` and `device="cuda"`. Sent to the CPU are devices among the arguments of
    torch's functions and of the methods of tensors and modules; pinned memory becomes plain memory; torch.load reads to
    the CPU; torch.cuda.set_device, synchronize, empty_cache, reset_peak_memory_stats and device do nothing;
    torch.cuda.Event measures with the host's clock; torch.cuda.FloatTensor and its like are those of the CPU.

    Not covered: torch.cuda.is_available() and Tensor.is_cuda, which tell the truth; other threads and processes;
    torch.Generator(device="cuda"); streams and graphs; TorchScript; extensions that have CUDA kernels only. Code that
    a module runs when it is imported needs the context around the import.
    """
    # torch.compile keeps a table of torch's functions, and torch.optim imports it: made now, it has the true ones.
    importlib.import_module("torch._dynamo")
    with contextlib.ExitStack() as stack:
        for (owner, name), replacement in _replacements().items():
            stack.enter_context(mock.patch.object(owner, name, replacement))
        stack.enter_context(_CudaToCpu())
        yield
