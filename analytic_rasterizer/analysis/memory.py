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
    ("/sys/fs/cgroup", "memory.max", "memory.current"),
    ("/sys/fs/cgroup/memory", "memory.limit_in_bytes", "memory.usage_in_bytes"),
)


def free_memory(device: str | torch.device) -> int | None:
    """Bytes that this process can still have on the device, None where the system does not tell.

    On CUDA what torch keeps for later is counted too. On the host it is what Linux can give without swapping, within
    the limit of a container; elsewhere half of all memory.
    """
    device = torch.device(device)
    if device.type == "cuda":
        index = torch.cuda.current_device() if device.index is None else device.index  # torch 2.4 needs one
        kept = torch.cuda.memory_reserved(index) - torch.cuda.memory_allocated(index)
        return torch.cuda.mem_get_info(index)[0] + kept
    found = []
    with suppress(OSError, ValueError, IndexError):
        lines = Path("/proc/meminfo").read_text().splitlines()
        found += [1024 * int(line.split()[1]) for line in lines if line.startswith("MemAvailable:")]
    for folder, limit, used in CGROUPS:
        with suppress(OSError, ValueError):  # the limit may be the word "max"
            most, taken = (int(Path(folder, name).read_text()) for name in (limit, used))
            found.append(max(0, most - taken + _files_read(folder)))
    if not found:
        with suppress(OSError, ValueError, AttributeError):  # Windows has no sysconf
            found.append(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") // 2)
    return min(found, default=None)


def _files_read(folder: str) -> int:
    """Bytes of files that a container has read: they count as used, and give way."""
    with suppress(OSError, ValueError):
        statistics = dict(line.split() for line in Path(folder, "memory.stat").read_text().splitlines())
        return int(statistics.get("inactive_file", 0))
    return 0


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
