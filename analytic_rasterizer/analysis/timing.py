"""What rendering costs in time and memory, on the CPU or with CUDA."""

from __future__ import annotations

import ctypes
import functools
import math
import platform
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from .. import _C
from ..cameras.camera import View
from ..gaussians import Gaussians
from ..render.order import CENTER
from ..render.rasterizer import GaussianRasterizer
from ..render.settings import in_order

ROUNDS = {"cpu": 5, "cuda": 20}
SLOW = 20  # calls that take so many times as long as the base are timed only twice on the CPU
AGREE = 1.1  # ratio up to which two times are the same
MORE = 2  # how many times as many rounds are added, at most, where those so far do not agree
QUEUED_BEHIND = 50_000_000  # clock cycles of a CUDA device, longer than the host takes to launch a pass
WARM_UP = 40  # calls before timing on CUDA: the first 32 frames of a size wait for the device


class Case:
    """One view of a scene, ready to render with one footprint, in an `Effects.order`.

    With `supersampling` n the whole picture is rendered n times larger and averaged over n x n pixels: the
    footprint is evaluated in the pixels of the larger picture.
    """

    def __init__(
        self,
        scene: Gaussians,
        view: View,
        footprint: str,
        supersampling: int = 1,
        background=(0.0, 0.0, 0.0),
        order: str = CENTER,
    ):
        device = scene.means.device
        self.supersampling = supersampling
        settings = view.settings(supersampling, background, scene.sh_degree, footprint, device=device)
        self.settings = in_order(settings, order)
        self.rasterizer = GaussianRasterizer(self.settings)
        self.gaussians = scene.arguments()
        self.inputs = {k: v.detach().requires_grad_() for k, v in self.gaussians.items()}
        self.inputs["means2D"] = torch.zeros_like(scene.means, requires_grad=True)
        self.dL_dcolor = fixed_weights(view.height, view.width, device)

    @torch.no_grad()
    def forward(self) -> torch.Tensor:
        """The image (3, H, W), without gradient."""
        return self.image(means2D=None, **self.gaussians)

    def forward_backward(self) -> list[torch.Tensor]:
        """The image, and the gradients of sum(image * dL_dcolor) with respect to all inputs."""
        color = self.image(**self.inputs)
        return [color, *torch.autograd.grad(color, list(self.inputs.values()), self.dL_dcolor)]

    def image(self, **gaussians) -> torch.Tensor:
        color, _ = self.rasterizer(**gaussians)
        n = self.supersampling
        return torch.nn.functional.avg_pool2d(color[None], n)[0] if n > 1 else color

    def extra_bytes(self) -> int:
        """Bytes that forward and backward need in addition to inputs, outputs and gradients; below 0 where unknown."""
        results, added = added_memory(self.forward_backward, self.dL_dcolor.device)
        return added - sum(t.numel() * t.element_size() for t in results)


@functools.cache
def fixed_weights(height: int, width: int, device: torch.device, channels: int = 3) -> torch.Tensor:
    """(channels, height, width) in [0, 1), always the same: a gradient with respect to a picture."""
    return torch.rand(channels, height, width, generator=torch.Generator().manual_seed(0)).to(device)


def describe_machine(device: str) -> str:
    """The processor and the version of torch, in words."""
    if device == "cuda":
        gpu = torch.cuda.get_device_properties(0)
        memory = f"{gpu.multi_processor_count} SMs, {gpu.total_memory / 2**30:.0f} GiB"
        return f"{gpu.name} ({gpu.major}.{gpu.minor}, {memory}), CUDA {torch.version.cuda}, torch {torch.__version__}"
    cpu = platform.processor() or platform.machine()
    if sys.platform == "linux":
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        cpu = next((line.split(":")[1].strip() for line in lines if line.startswith("model name")), cpu)
    return f"{cpu}, {torch.get_num_threads()} threads, {_C.instruction_set()}, torch {torch.__version__}"


def in_turn(cases: dict[Any, list], measure: Callable[[Any], Any], rounds: int) -> dict[Any, list[list]]:
    """`measure(case)` of every case of every key, round after round: by key, a list of rounds for every case.

    A machine that slows down for a while slows down all of them.
    """
    samples = {key: [[] for _ in of_key] for key, of_key in cases.items()}
    for _ in range(rounds):
        for key, of_key in cases.items():
            for case, taken in zip(of_key, samples[key]):
                taken.append(measure(case))
    return samples


def time_calls(
    calls: dict[Any, list[Callable[[], object]]],
    device: str,
    rounds: int | None = None,
    clock: Callable[[], float] = time.perf_counter,
    base: Any = None,
    progress: Callable[[], object] = lambda: None,
    patience: float = math.inf,
) -> dict[Any, list[list[float]]]:
    """Seconds of every call, by key: a list of rounds for every call of a key.

    On the CPU the calls take turns after a round that warms up. On CUDA the calls of a key are warmed up and timed by
    themselves, because the room for their pairs follows the frames before them. Where the rounds of a call do not agree
    (`agree`), its key is timed again for up to MORE times as many rounds: other work on the machine is no result.

    Args:
        calls: What to time.
        device: "cpu" or "cuda".
        rounds: Timed rounds; None is ROUNDS of the device.
        clock: On the CPU, in seconds.
        base: A key. Where the calls of another take SLOW times as long in the round that warms up, that round counts
            and they are timed only once more. CPU only; None: all are timed in every round.
        progress: Called before every timed call.
        patience: Seconds. Where so many rounds would take longer there are fewer, at least one, and none again; where
            it is one, the round that warms up counts too. CPU only.
    """
    rounds = rounds or ROUNDS[device]

    def measure(call):
        progress()
        return event_seconds(call) if device == "cuda" else seconds_of(call, clock)

    def until_they_agree(samples, keys):
        for _ in range(MORE * rounds):
            doubtful = {key: calls[key] for key in keys if not all(agree(taken, device) for taken in samples[key])}
            if not doubtful:
                break
            for key, added in in_turn(doubtful, measure, 1).items():
                samples[key] = [[*taken, *more] for taken, more in zip(samples[key], added)]
        return samples

    if device == "cuda":
        samples = {}
        for key, of_key in calls.items():
            warm_up_cuda(of_key, WARM_UP)
            samples |= until_they_agree(in_turn({key: of_key}, measure, rounds), [key])
        return samples
    first = in_turn(calls, measure, 1)
    totals = {key: sum(taken[0] for taken in of_key) for key, of_key in first.items()}
    if (fitting := patience / sum(totals.values())) < rounds:
        samples = in_turn(calls, measure, max(1, int(fitting)))
        if fitting >= 2:
            return samples
        return {key: [[*a, *b] for a, b in zip(of_key, samples[key])] for key, of_key in first.items()}
    slow = {key for key in calls if base is not None and totals[key] > SLOW * totals[base]}
    samples = in_turn({key: of for key, of in calls.items() if key not in slow}, measure, rounds)
    once_more = in_turn({key: calls[key] for key in slow}, measure, 1)
    for key, again in once_more.items():
        samples[key] = [[*taken, *more] for taken, more in zip(first[key], again)]
    return until_they_agree(samples, list(calls))


def agree(samples: list[float], device: str) -> bool:
    """Whether rounds say how long a call takes: on the CPU the fastest two, on CUDA the middle half, within AGREE."""
    if len(samples) < 2:
        return False
    if device == "cuda":
        low, _, high = statistics.quantiles(samples, n=4)
        return high <= AGREE * low
    fastest, next_one = sorted(samples)[:2]
    return next_one <= AGREE * fastest


def best_of(samples: list[float], device: str) -> float:
    """Seconds of the round that counts: on the CPU the fastest, since other work only adds time; on CUDA the median."""
    return statistics.median(samples) if device == "cuda" else min(samples)


def seconds_of(call: Callable[[], object], clock: Callable[[], float] = time.perf_counter) -> float:
    """Seconds until a call returns, by a clock that counts them."""
    start = clock()
    call()
    return clock() - start


def event_seconds(call: Callable[[], object], queued: bool = False) -> float:
    """Seconds on the CUDA device from before a call to after it. Waits for the device.

    With `queued` the device is kept busy until the host has launched the call, so that the host's time does not count;
    but what a call launches after it has itself waited for the device is not queued.
    """
    start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
    if queued:
        torch.cuda._sleep(QUEUED_BEHIND)
    start.record()
    call()
    end.record()
    torch.cuda.synchronize()
    return start.elapsed_time(end) * 1e-3


def warm_up_cuda(calls: list[Callable[[], object]], passes: int) -> None:
    """Renders with one footprint until the room for its pairs depends on these frames alone."""
    _C.force_pair_capacity(0)
    for _ in range(passes):
        for call in calls:
            call()
    torch.cuda.synchronize()


def added_memory(call: Callable[[], Any], device: torch.device) -> tuple[Any, int]:
    """What a call returns, and the most bytes in use during it beyond those before it; 0 where that is unknown."""
    if device.type == "cuda":
        torch.cuda.synchronize()
        torch.cuda.reset_peak_memory_stats()
        before = torch.cuda.memory_allocated()
        return call(), torch.cuda.max_memory_allocated() - before
    if sys.platform != "linux":
        return call(), 0
    libc = ctypes.CDLL(None)  # glibc is told to hand freed blocks back to the system, so that peaks can be compared
    libc.mallopt(-3, 1 << 16)  # M_MMAP_THRESHOLD: blocks above 64 KiB go back when freed
    libc.malloc_trim(0)
    try:
        Path("/proc/self/clear_refs").write_text("5")  # the peak starts again from what is in use now
    except OSError:
        return call(), 0
    before = _status("VmRSS")
    return call(), _status("VmHWM") - before


def _status(key: str) -> int:
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(1024 * int(line.split()[1]) for line in lines if line.startswith(key))
