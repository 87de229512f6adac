"""What rendering costs in time and memory, on the CPU or with CUDA."""

from __future__ import annotations

import ctypes
import functools
import platform
import statistics
import sys
from collections.abc import Callable, Iterable

import torch

from . import _C, io
from .rasterizer import GaussianRasterizer


class Case:
    """One view of a scene, ready to render with one footprint.

    With `supersampling` n the picture is rendered n times larger and averaged over n x n, as a whole:
    the footprint sees the pixels of the larger picture.
    """

    def __init__(
        self, scene: io.Scene, view: io.View, footprint: str, supersampling: int = 1, background=(0.0, 0.0, 0.0)
    ):
        device = scene.means.device
        self.supersampling = supersampling
        self.settings = view.settings(supersampling, background, scene.sh_degree, footprint, device=device)
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
        if self.supersampling > 1:
            color = torch.nn.functional.avg_pool2d(color[None], self.supersampling)[0]
        return color

    def extra_bytes(self) -> int:
        """Bytes that forward and backward need beyond what goes in and comes out."""
        device = self.dL_dcolor.device
        before = reset_peak_memory(device)
        results = self.forward_backward()
        return peak_memory(device) - before - sum(t.numel() * t.element_size() for t in results)


@functools.cache
def fixed_weights(height: int, width: int, device: torch.device, channels: int = 3) -> torch.Tensor:
    return torch.rand(channels, height, width, generator=torch.Generator().manual_seed(0)).to(device)


def describe_machine(device: str) -> str:
    if device == "cuda":
        gpu = torch.cuda.get_device_properties(0)
        memory = f"{gpu.multi_processor_count} SMs, {gpu.total_memory / 2**30:.0f} GiB"
        return f"{gpu.name} ({gpu.major}.{gpu.minor}, {memory}), CUDA {torch.version.cuda}, torch {torch.__version__}"
    cpu = platform.processor() or platform.machine()
    if sys.platform == "linux":
        with open("/proc/cpuinfo") as f:
            cpu = next((line.split(":")[1].strip() for line in f if line.startswith("model name")), cpu)
    threads = torch.get_num_threads()
    return f"{cpu}, {threads} threads, {_C.instruction_set()}, torch {torch.__version__}"


# -------------------------------------------------------------------------------------- times


def in_turn(
    cases: dict[str, list[Case]], measure: Callable[[Case], dict], rounds: Iterable[int]
) -> dict[str, list[list[dict]]]:
    """What `measure` says of every case, round after round, by name, view and round.

    A machine that slows down slows all of them. Round 0, if it is among them, warms up and is left out.
    """
    samples = {name: [[] for _ in of_name] for name, of_name in cases.items()}
    for round_ in rounds:
        for name, of_name in cases.items():
            for case, taken in zip(of_name, samples[name]):
                measured = measure(case)
                if round_ > 0:
                    taken.append(measured)
    return samples


def warm_up_cuda(cases: list[Case], passes: int) -> None:
    """Renders the cases of one footprint until room for its pairs follows its own frames alone."""
    _C.force_pair_capacity(0)
    for _ in range(passes):
        for case in cases:
            case.forward()
            case.forward_backward()


def event_seconds(call: Callable[[], object]) -> float:
    """Time on the CUDA device from before a call to after it."""
    start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
    start.record()
    call()
    end.record()
    torch.cuda.synchronize()
    return start.elapsed_time(end) * 1e-3


def median_seconds(clock: Callable[[Callable], float], call: Callable[[], object], rounds: int) -> float:
    """Median of `clock(call)` on an idle CUDA device."""
    torch.cuda.synchronize()
    clock(call)
    return statistics.median(clock(call) for _ in range(rounds))


def median_of(samples: list[dict]) -> dict:
    return {key: statistics.median(sample[key] for sample in samples) for key in samples[0]}


# -------------------------------------------------------------------------------------- memory


def return_freed_memory() -> None:
    """Makes glibc hand freed blocks back to the system, so that peaks can be compared."""
    if sys.platform == "linux":
        libc = ctypes.CDLL(None)
        libc.mallopt(-3, 1 << 16)  # M_MMAP_THRESHOLD: blocks above 64 KiB go back when freed
        libc.malloc_trim(0)


def reset_peak_memory(device: torch.device) -> int:
    """Memory in use now, bytes, from which the peak starts again. On the CPU Linux only; elsewhere 0."""
    if device.type == "cuda":
        torch.cuda.synchronize()
        torch.cuda.reset_peak_memory_stats()
        return torch.cuda.memory_allocated()
    return_freed_memory()
    try:
        with open("/proc/self/clear_refs", "w") as f:
            f.write("5")
    except OSError:
        return 0
    return _status("VmRSS")


def peak_memory(device: torch.device) -> int:
    """Highest memory in use since the last reset, bytes."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated()
    return _status("VmHWM")


def _status(key: str) -> int:
    try:
        with open("/proc/self/status") as f:
            return next(1024 * int(line.split()[1]) for line in f if line.startswith(key))
    except OSError:
        return 0
