"""Where the pictures of a training are: on its device, in memory, or in their files until steps need them.

What the files say of sizes decides it, before anything is decoded. The smallest pictures come first to the device, and
then to memory: their steps are the shortest, and files of large photographs take as long to decode for them. Threads
fetch the others ahead, in the order of the steps. The bits of a picture are the same wherever it was.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Collection, Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import nullcontext
from threading import Lock
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from .. import io
from ..analysis.memory import free_memory as free_on
from ..checks import check_value
from ..distributed.ranks import Ranks

GIB = 1 << 30
UNKNOWN = 8 * GIB  # of the host, where the system does not tell what is free
DEVICE, HOST, FILE = "device", "host", "file"
DEVICE_SHARE, SHARDED_SHARE = 1 / 4, 1 / 16  # of the device's free memory, alone and with several processes
HOST_SHARE = 1 / 2  # of the free memory of the host
LEAST_AHEAD = 2  # pictures
IN_USE = 2  # the picture of a step, and that of the last one, which the trainer keeps
MOST_THREADS = 16
DECODING = 12  # bytes per pixel of a photograph, in each thread
MAKING = 64  # bytes per pixel of one photograph at a time, while pictures are made of it
DECODING_SHARE = 1 / 8  # of free memory, for all threads

Key = tuple[int, int]  # scale, and place among the views


class PictureMemory(NamedTuple):
    """How much memory pictures may take.

    Attributes:
        gpu: GiB on a CUDA device, pictures that are fetched ahead included; at least a few are. None: a quarter of what
            is free, or a sixteenth with several processes.
        host: GiB in memory; the rest stays in its files. None: half of what is free, shared by the processes.
        processes: Of this host that train together.
    """

    gpu: float | None = None
    host: float | None = None
    processes: int = 1

    def check(self, device: torch.device) -> None:
        """Raises ValueError for what is not a size, and for `gpu` where `device` is none."""
        for name, value in (("picture_memory_gpu", self.gpu), ("picture_memory_host", self.host)):
            check_value(name, value is None or 0 <= value < math.inf, "finite and not negative", value)
        check_value("picture_memory_gpu", self.gpu is None or device.type == "cuda", "None on a CPU", self.gpu)

    def less(self, plan: Plan, device: torch.device) -> PictureMemory:
        """What is left of limits that were given, beside the pictures of a `plan` for a `device`."""
        places = {"gpu": DEVICE, "host": HOST if device.type == "cuda" else DEVICE}
        left = {name: (getattr(self, name), plan.taken[place] / GIB) for name, place in places.items()}
        return self._replace(
            **{name: max(0.0, most - taken) for name, (most, taken) in left.items() if most is not None}
        )


def processes_here(ranks: Ranks) -> int:
    """How many of the ranks are on this host, as torchrun says it; all of them where it does not."""
    return min(ranks.world, int(os.environ.get("LOCAL_WORLD_SIZE", ranks.world)))


class Bytes(NamedTuple):
    """Of the device and of the host; a CPU has the host's in `device`."""

    device: int
    host: int


def free_memory(device: torch.device) -> Bytes:
    """What is free, see analysis/memory.py."""
    host = free_on("cpu")
    host = UNKNOWN if host is None else host
    return Bytes(free_on(device) if device.type == "cuda" else host, host)


def limits_of(memory: PictureMemory, free: Bytes, device: torch.device) -> Bytes:
    """The limits that were given, or shares of what is free; on a CPU `device` has that of the host."""
    usual = free.host * HOST_SHARE / memory.processes
    host = int(usual if memory.host is None else memory.host * GIB)
    if device.type != "cuda":
        return Bytes(host, 0)
    usual = free.device * (DEVICE_SHARE if memory.processes == 1 else SHARDED_SHARE)
    return Bytes(int(usual if memory.gpu is None else memory.gpu * GIB), host)


class Plan(NamedTuple):
    """Where every picture is.

    Attributes:
        places: DEVICE, HOST or FILE by scale and view.
        taken: Bytes by place; on the device those that are fetched ahead and in use too.
        ahead: How many pictures are fetched ahead.
        threads: That decode.
    """

    places: dict[Key, str]
    taken: dict[str, int]
    ahead: int
    threads: int


def plan_places(
    sizes: dict[Key, int], pixels: int, limits: Bytes, free: Bytes, device: torch.device, processes: int = 1
) -> Plan:
    """Where pictures of these `sizes` (bytes) go within the limits.

    Args:
        pixels: Of the largest photograph.
        free: Memory, which has to suffice.
        processes: Of this host that train together.

    Raises io.SceneError if it does not, with the numbers and what helps.
    """
    most = max(1, int(free.host * DECODING_SHARE / processes / (DECODING * max(pixels, 1))))
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    threads = max(1, min(cores // processes, MOST_THREADS, most))
    places, taken, ahead = dict.fromkeys(sizes, DEVICE), {DEVICE: sum(sizes.values()), HOST: 0, FILE: 0}, 0
    if taken[DEVICE] > limits.device:
        largest = max(sizes.values())
        # Half of the limit at most: what stays on the device needs not be fetched.
        ahead = max(LEAST_AHEAD, min(threads + LEAST_AHEAD, limits.device // (2 * largest) - IN_USE))
        taken[DEVICE] = (ahead + IN_USE) * largest
        for key in sorted(sizes, key=lambda key: (sizes[key], key)):
            fits = ((place, limit) for place, limit in ((DEVICE, limits.device), (HOST, limits.host)))
            places[key] = next((place for place, limit in fits if taken[place] + sizes[key] <= limit), FILE)
            taken[places[key]] += sizes[key]
    plan = Plan(places, taken, ahead, threads)
    on_cpu, making = device.type != "cuda", MAKING * pixels
    on_host = processes * (taken[HOST] + threads * DECODING * pixels + (taken[DEVICE] + making if on_cpu else 0))
    if on_host > free.host:
        raise _too_much(len(sizes), on_host, "memory", free.host, "--picture-memory-host")
    if not on_cpu and taken[DEVICE] + making > free.device:
        raise _too_much(len(sizes), taken[DEVICE] + making, "the GPU", free.device, "--picture-memory-gpu")
    return plan


def _too_much(count: int, needed: int, where: str, free: int, option: str) -> io.SceneError:
    numbers = f"{needed / GIB:.3g} GiB of {where}, where {free / GIB:.3g} GiB are free"
    message = f"the {count} pictures of these photographs at their scales need {numbers}"
    helps = "larger --scales or smaller photographs (--images) may help"
    return io.SceneError(message, helps, f"a lower {option} may help")


def described(plan: Plan, device: torch.device) -> str:
    """Where pictures are that are not all on the device, in a sentence."""
    sizes = {place: f"{taken / GIB:.3g} GiB" for place, taken in plan.taken.items()}
    if device.type == "cuda":
        kept = f"{sizes[DEVICE]} on the GPU (--picture-memory-gpu), {sizes[HOST]} in memory (--picture-memory-host)"
    else:
        kept = f"{sizes[DEVICE]} in memory (--picture-memory-host)"
    return f"pictures are {kept}, and {sizes[FILE]} are decoded ahead of the steps that show them"


class Made(NamedTuple):
    """A picture at a scale."""

    color: Tensor  # as in `Pictures.colors`
    mask: Tensor | None  # as in `Pictures.masks`
    depth: Tensor | None = None  # as in `Pictures.depths`

    def map(self, change: Callable[[Tensor], Tensor]) -> Made:
        """With other tensors."""
        return Made(*(None if tensor is None else change(tensor) for tensor in self))


class Store:
    """Pictures of which some wait in memory or in their files. Threads fetch those that are expected.

    To be used by one thread.

    Args:
        device: Of the pictures that it gives.
        plan: Where they are.
        kept: Those on the device and in memory.
        read: Reads what is needed of the files for a picture, and applies a function to its tensors, which pins memory.
            Called in threads, several at a time.
        make: Makes a picture of what `read` returned, with a function that moves tensors to the device. One at a time.

    Attributes:
        plan, kept: See above.
        horizon: Of so many pictures in a row, those that wait are about as many as are fetched ahead.
    """

    def __init__(
        self,
        device: torch.device,
        plan: Plan,
        kept: dict[Key, Made],
        read: Callable[[Key, Callable[[Tensor], Tensor]], Any],
        make: Callable[[Key, Any, Callable[[Tensor], Tensor]], Made],
    ):
        self.device, self.plan, self.kept, self._read, self._make = device, plan, kept, read, make
        self._pool: ThreadPoolExecutor | None = None
        self._fetched: dict[Key, Future] = {}  # or on their way
        self._expected: list[Key] = []
        self._shown: tuple[Key, Made] | None = None  # the last: its mask is asked for after its colour
        self._lock = Lock()
        waiting = sum(place != DEVICE for place in plan.places.values())
        self.horizon = -(-plan.ahead * len(plan.places) // max(waiting, 1))
        self._stream = torch.cuda.Stream(device) if device.type == "cuda" and plan.ahead else None

    def get(self, key: Key) -> Made:
        """A picture, on the device. Raises what reading its file raises."""
        if self.plan.places[key] == DEVICE:
            return self.kept[key]
        if self._shown is not None and self._shown[0] == key:
            return self._shown[1]
        future = self._fetched.pop(key, None) or self._submit(key)
        if key in self._expected:
            self._expected.remove(key)
        made, event = future.result()
        if event is not None:
            current = torch.cuda.current_stream(self.device)
            current.wait_event(event)
            # They were allocated for the other stream, which must not use their memory again before this one is done.
            for tensor in made:
                if tensor is not None:
                    tensor.record_stream(current)
        self._shown = key, made
        self._fill()
        return made

    def expect(self, keys: Iterable[Key]) -> None:
        """Tells what will be asked for next, in its order, in place of what was expected before."""
        self._expected = [key for key in keys if self.plan.places[key] != DEVICE]
        for key in self._fetched.keys() - set(self._expected):
            self._fetched.pop(key).cancel()
        self._fill()

    def close(self) -> None:
        """Ends the threads, after what they are at. The next picture starts others."""
        self._expected = []
        self._fetched.clear()
        if self._pool is not None:
            self._pool.shutdown(wait=True, cancel_futures=True)
            self._pool = None

    def _fill(self) -> None:
        before = None if self._shown is None else self._shown[0]
        for key in self._expected:
            if len(self._fetched) >= self.plan.ahead:
                return
            if key not in self._fetched and key != before:
                self._fetched[key] = self._submit(key)
            before = key

    def _submit(self, key: Key) -> Future:
        if self._pool is None:
            self._pool = ThreadPoolExecutor(self.plan.threads, "pictures")
        return self._pool.submit(self._fetch, key)

    def _fetch(self, key: Key) -> tuple[Made, torch.cuda.Event | None]:
        """A picture on the device, and on CUDA the event after which it is there. Runs in a thread."""
        waiting = self.plan.places[key] == HOST
        with nullcontext() if self._stream is None else torch.cuda.stream(self._stream):  # of this thread
            source = self.kept[key].map(self._pinned) if waiting else self._read(key, self._pinned)
            with self._lock:  # one at a time, for the memory that it takes while it is made
                made = source.map(self._moved) if waiting else self._make(key, source, self._moved)
                return made, None if self._stream is None else self._stream.record_event()

    def _pinned(self, tensor: Tensor) -> Tensor:
        """A copy in memory from which a device fetches while the host goes on, where there is one.

        torch keeps such memory until copies from it are over, and then takes it again.
        """
        if self._stream is None:
            return tensor
        pinned = torch.empty(tensor.shape, dtype=tensor.dtype, device="cpu", pin_memory=True)
        np.copyto(pinned.numpy(), tensor.numpy())  # in this thread alone, where torch would start others
        return pinned

    def _moved(self, tensor: Tensor) -> Tensor:
        return tensor.to(self.device, non_blocking=True)


class Column(Sequence):
    """The colours, masks or depths of all views at a scale: each is fetched when it is asked for."""

    def __init__(self, store: Store, scale: int, views: int, field: int):
        self._store, self._scale, self._views, self._field = store, scale, views, field

    def __len__(self) -> int:
        return self._views

    def __getitem__(self, view: int) -> Tensor | None:
        if not -self._views <= view < self._views:
            raise IndexError(f"view must be below {self._views}, got {view}")
        return self._store.get((self._scale, view % self._views))[self._field]


def columns(store: Store, scales: Collection[int], views: int) -> list[dict[int, Column]]:
    """`Pictures.colors`, `Pictures.masks` and `Pictures.depths` of a store."""
    return [{scale: Column(store, scale, views, field) for scale in scales} for field in range(len(Made._fields))]
