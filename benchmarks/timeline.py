"""When every CUDA kernel of a pass begins and ends: what runs beside what, and what begins late.

    python benchmarks/timeline.py SCENE --views VIEWS [--view 0] [--footprints box:samples=1 ...] [--sh-degree 3]

A pass is a picture and the gradients of sum(image * w) with respect to all inputs, for fixed random w. It is queued
behind other work, so that the kernels follow each other as fast as the device allows and the host does not count.
Times are those of torch's profiler, in microseconds from the beginning of the first kernel.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path
from typing import NamedTuple

import torch
from common import add_scene, add_sh_degree, has_cuda
from scene_files import load_padded

from analytic_rasterizer import io
from analytic_rasterizer.analysis.tables import format_table
from analytic_rasterizer.analysis.timing import QUEUED_BEHIND, WARM_UP, Case, describe_machine

FOOTPRINTS = ["box:samples=1", "moment:samples=4"]
SLEEPER = "spin_kernel"  # the kernel of torch that takes them
LAUNCH = 2.0  # microseconds by which a kernel may begin before the one that it waits for has ended


class Kernel(NamedTuple):
    """Microseconds."""

    name: str
    stream: int
    begin: float
    end: float


def main() -> None:
    args = parse_arguments()
    scene, view = load_padded(args.scene, args.sh_degree).to("cuda"), io.load_views(args.views)[args.view]
    print(f"{len(scene.means)} Gaussians, {view.width}x{view.height}, {describe_machine('cuda')}")
    for footprint in args.footprints:
        print(f"\n{footprint}\n{format_kernels(record(Case(scene, view, footprint)))}")


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    add_scene(parser, FOOTPRINTS)
    add_sh_degree(parser)
    parser.add_argument("--view", type=int, default=0, help="number of the view (default: %(default)s)")
    args = parser.parse_args()
    if not has_cuda():
        parser.error("no CUDA device, or analytic_rasterizer was built without CUDA")
    return args


def record(case: Case) -> list[Kernel]:
    """The kernels of one pass with backward."""
    for _ in range(WARM_UP):  # the first frames of a size wait for the device
        case.forward_backward()
    torch.cuda.synchronize()
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CUDA]) as profiler:
        torch.cuda._sleep(QUEUED_BEHIND)
        case.forward_backward()
        torch.cuda.synchronize()
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "trace.json"
        profiler.export_chrome_trace(str(file))
        return kernels_of(json.loads(file.read_text()))


def kernels_of(trace: dict) -> list[Kernel]:
    """The kernels of a trace in Chrome's format, in the order in which they begin, from time 0 on."""
    events = [event for event in trace["traceEvents"] if event.get("cat") == "kernel" and SLEEPER not in event["name"]]
    events.sort(key=lambda event: event["ts"])
    first = events[0]["ts"] if events else 0.0
    return [
        Kernel(event["name"], event["args"]["stream"], event["ts"] - first, event["ts"] + event["dur"] - first)
        for event in events
    ]


def format_kernels(kernels: list[Kernel]) -> str:
    """A row for each; * where another kernel runs at the same time, beyond what launches that overlap bring."""
    rows = []
    for kernel in kernels:
        others = (other for other in kernels if other is not kernel)
        beside = any(min(kernel.end, other.end) - max(kernel.begin, other.begin) > LAUNCH for other in others)
        name = kernel.name.replace("ar::", "").replace("cuda::", "").removeprefix("void ")
        times = (f"{time:.1f}" for time in (kernel.begin, kernel.end, kernel.end - kernel.begin))
        rows.append([name[:70], *times, f"{kernel.stream}{'*' if beside else ''}"])
    return format_table(["kernel", "begins", "ends", "takes", "stream"], rows)


if __name__ == "__main__":
    main()
