"""What a picture takes on a busy CPU: with one thread and with all, alone and beside loops that do nothing else.

    python benchmarks/busy.py [--loops 8] [--gaussians 5000 50000] [--sizes 240x135 960x540] [--threads N]

Every row is timed with one thread and with `--threads` in turn, round after round; medians. "ratio" is the second time
in parts of the first. The scenes are those of `scaling.py`. The loops are processes of Python, started and ended here;
all processes on the machine share its cores with them meanwhile.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import statistics
import subprocess
import sys
from collections.abc import Callable, Iterator

import torch
from common import parse_size, save_json
from scaling import FOCAL, make_scene

from analytic_rasterizer import View
from analytic_rasterizer.analysis.tables import markdown_table
from analytic_rasterizer.analysis.timing import Case, describe_machine, in_turn, seconds_of

# A loop ends by itself when the process that started it is gone.
LOOP = """
import os
parent = os.getppid()
print("started", flush=True)
while os.getppid() == parent:
    for _ in range(1_000_000):
        pass
"""


def main() -> None:
    args = parse_arguments()
    print(f"{args.footprint}, {describe_machine('cpu')}\n")
    results = []
    for loops in dict.fromkeys((0, args.loops)):
        with busy_loops(loops):
            results += [measure(args, loops, *row) for row in itertools.product(args.gaussians, args.sizes)]
    results = [row for rows in results for row in rows]
    header = ["Gaussians", "size", "pass", "loops", "one thread, ms", f"{args.threads} threads, ms", "ratio"]
    print(markdown_table(header, [[*row.values()] for row in results]))
    save_json(args, {"results": results})


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    add = parser.add_argument
    add("--loops", type=int, default=8, help="beside which the pictures are made as well (default: %(default)s)")
    add("--gaussians", type=int, nargs="+", default=[5000, 50_000], metavar="N")
    add("--sizes", type=parse_size, nargs="+", default=[(240, 135), (960, 540)], metavar="WxH")
    add("--footprint", default="analytic", metavar="NAME[:k=v]")
    add("--rounds", type=int, default=50, help="timed rounds (default: %(default)s)")
    add("--threads", type=int, default=torch.get_num_threads(), help="(default here: %(default)s)")
    add("--json", metavar="FILE", help="also write everything measured to this file")
    return parser.parse_args(namespace=argparse.Namespace(device="cpu"))


@contextlib.contextmanager
def busy_loops(count: int) -> Iterator[None]:
    """Has so many processes that use a core each, or what they get of one."""
    with contextlib.ExitStack() as stack:
        loops = []
        for _ in range(count):
            loops.append(subprocess.Popen([sys.executable, "-c", LOOP], stdout=subprocess.PIPE))
            stack.callback(loops[-1].communicate)
            stack.callback(loops[-1].kill)
        for loop in loops:
            loop.stdout.readline()
        yield


def measure(args: argparse.Namespace, loops: int, count: int, size: tuple[int, int]) -> list[dict]:
    """The rows of a scene and a size: forward, and with backward."""
    view = View("synthetic", *size, FOCAL * size[0], FOCAL * size[0], torch.eye(4, dtype=torch.float64))
    case = Case(make_scene(count, view, 3, "cpu"), view, args.footprint)
    rows = []
    for name, call in (("forward", case.forward), ("with backward", case.forward_backward)):
        one, all_ = median_times(call, args.threads, args.rounds)
        row = {"gaussians": count, "size": f"{size[0]}x{size[1]}", "pass": name, "loops": loops}
        rows.append(row | {"one_thread_ms": 1e3 * one, "all_threads_ms": 1e3 * all_, "ratio": all_ / one})
    return rows


def median_times(call: Callable[[], object], threads: int, rounds: int) -> tuple[float, float]:
    """Seconds of a call with one thread and with `threads`, after a round that warms up."""

    def seconds_with(count: int) -> float:
        torch.set_num_threads(count)
        return seconds_of(call)

    before = torch.get_num_threads()
    samples = in_turn({"threads": [1, threads]}, seconds_with, rounds + 1)["threads"]
    torch.set_num_threads(before)
    one, all_ = (statistics.median(taken[1:]) for taken in samples)
    return one, all_


if __name__ == "__main__":
    main()
