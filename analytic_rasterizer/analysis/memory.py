"""How much memory there is, and whether pictures fit into it."""

from __future__ import annotations

import os
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

import torch

from ..cameras.camera import View

BYTES_PER_PIXEL = 64  # of a picture that is rendered without gradients and written: measured, rounded up
LARGEST_SIDE = 2**20  # px, as in files of views
CGROUPS = (  # limits of a container, and what it uses: version 2, version 1
    ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory.current"),
    ("/sys/fs/cgroup/memory/memory.limit_in_bytes", "/sys/fs/cgroup/memory/memory.usage_in_bytes"),
)


def free_memory(device: str | torch.device) -> int | None:
    """Bytes that this process can still have on the device; None where the system does not tell."""
    device = torch.device(device)
    if device.type == "cuda":
        index = torch.cuda.current_device() if device.index is None else device.index
        unused = torch.cuda.memory_reserved(index) - torch.cuda.memory_allocated(index)
        return torch.cuda.mem_get_info(index)[0] + unused
    found = []
    with suppress(OSError, ValueError, IndexError):
        lines = Path("/proc/meminfo").read_text().splitlines()
        found += [1024 * int(line.split()[1]) for line in lines if line.startswith("MemAvailable:")]
    for limit, used in CGROUPS:
        with suppress(OSError, ValueError):  # the limit may be the word "max"
            found.append(int(Path(limit).read_text()) - int(Path(used).read_text()))
    if not found:
        with suppress(OSError, ValueError, AttributeError):
            found.append(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    return min(found, default=None)


def check_sizes(views: Iterable[View], device: str | torch.device, way_out: str) -> None:
    """Raises ValueError for the largest of the views if its picture does not fit into the memory of the device.

    Args:
        way_out: What makes pictures smaller, for the message.
    """
    largest = max(views, key=lambda view: view.width * view.height)
    size = f"pictures of {largest.width} x {largest.height} px"
    if max(largest.width, largest.height) > LARGEST_SIDE:
        raise ValueError(f"{size} are too large, a side may have {LARGEST_SIDE} px; {way_out}")
    needed, free = largest.width * largest.height * BYTES_PER_PIXEL, free_memory(device)
    if free is not None and needed > free:
        raise ValueError(f"{size} need {needed / 1e9:.3g} GB, and {free / 1e9:.3g} GB are free on {device}; {way_out}")
