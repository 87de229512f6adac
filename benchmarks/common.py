"""The command line and the measuring that the benchmarks share."""

from __future__ import annotations

import argparse
import json
import statistics
from collections.abc import Callable

import torch

import analytic_rasterizer as ar
from analytic_rasterizer import io
from analytic_rasterizer.analysis.timing import (
    Case,
    describe_machine,
    event_seconds,
    in_turn,
    seconds_of,
    warm_up_cuda,
)
from analytic_rasterizer.gaussians import Gaussians

ROUNDS = {"cpu": 5, "cuda": 30}
CLOCKS = {"cpu": seconds_of, "cuda": event_seconds}  # seconds of a call
WARM_UP = 15  # passes over the views before timing on CUDA


def make_parser(description: str, footprints: list[str]) -> argparse.ArgumentParser:
    """A parser of what every benchmark takes: a scene, views, footprints, and how to measure."""
    parser = argparse.ArgumentParser(description=description)
    add_scene(parser, footprints)
    add_measuring(parser)
    return parser


def add_scene(parser: argparse.ArgumentParser, footprints: list[str]) -> None:
    """Adds a scene, views and footprints."""
    add = parser.add_argument
    add("scene", help="trained scene: .ply, compressed .ply, .spz, or .npz (see scene_files.py)")
    add("--views", required=True, help="file of views")
    add("--footprints", nargs="+", default=footprints, metavar="NAME[:k=v]")


def add_sh_degree(parser: argparse.ArgumentParser) -> None:
    """Adds a degree for `scene_files.load_padded`."""
    text = "pad the SH with zeros to this degree, as trainers hold them"
    parser.add_argument("--sh-degree", type=int, choices=range(4), help=text)


def add_measuring(parser: argparse.ArgumentParser) -> None:
    """Adds how to measure, which `parse` reads."""
    add = parser.add_argument
    device = "cuda" if has_cuda() else "cpu"
    add("--device", choices=("cpu", "cuda"), default=device, help="(default here: %(default)s)")
    add("--rounds", type=int, help="timed rounds after warming up (default: 5, with CUDA 30)")
    add("--threads", type=int, default=torch.get_num_threads(), help="of the CPU")
    add("--json", help="also write everything measured to this file")


def parse(parser: argparse.ArgumentParser) -> argparse.Namespace:
    """The arguments, settled; sets the number of threads."""
    args = parser.parse_args()
    settle(parser, args)
    torch.set_num_threads(args.threads)
    return args


def settle(parser: argparse.ArgumentParser, args: argparse.Namespace) -> None:
    """Sets the number of rounds if it was not given. Ends the program where the device is not there."""
    if args.device == "cuda" and not has_cuda():
        parser.error("--device cuda: no CUDA device, or analytic_rasterizer was built without CUDA")
    args.rounds = args.rounds or ROUNDS[args.device]


def parse_size(text: str) -> tuple[int, int]:
    """(width, height) of "WxH"."""
    width, height = map(int, text.split("x"))
    return width, height


def has_cuda() -> bool:
    return torch.cuda.is_available() and ar._C.has_cuda


def print_setup(scene: Gaussians, views: list[io.View], device: str) -> None:
    gaussians = f"{len(scene.means)} Gaussians of SH degree {scene.sh_degree}"
    print(f"{gaussians}, {len(views)} views of {views[0].width}x{views[0].height}, {describe_machine(device)}")


def save_json(args: argparse.Namespace, results: dict) -> None:
    """Writes the results with the machine and the arguments to --json, if that was given."""
    if args.json:
        with open(args.json, "w") as f:
            json.dump({"machine": describe_machine(args.device), "arguments": vars(args), **results}, f, indent=2)


def measure(
    cases: dict[str, list[Case]], time_round: Callable[[Case], dict], device: str, rounds: int
) -> dict[str, list[dict]]:
    """Medians of the numbers of `time_round` over rounds in turn, after one that warms up, and the bytes that a forward
    and backward pass needs in addition, by key and case."""
    if device == "cuda":
        each = [case for of_key in cases.values() for case in of_key]
        warm_up_cuda([call for case in each for call in (case.forward, case.forward_backward)], WARM_UP)
    measured = in_turn(cases, time_round, rounds + 1)
    for key, of_key in cases.items():
        for i, case in enumerate(of_key):
            taken = measured[key][i][1:]
            medians = {name: statistics.median(of_round[name] for of_round in taken) for name in taken[0]}
            measured[key][i] = medians | {"extra_bytes": case.extra_bytes()}
    return measured


def start_peaks(device: str) -> None:
    """Peaks of memory start again, from an emptied cache."""
    if device == "cuda":
        torch.cuda.synchronize()
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats()


def peaks_of_memory(device: str) -> dict[str, float | None]:
    """MiB that torch's allocator has had in use and reserved, at most; None on the CPU."""
    if device == "cpu":
        return {"used_mib": None, "reserved_mib": None}
    torch.cuda.synchronize()
    peaks = {"used_mib": torch.cuda.max_memory_allocated(), "reserved_mib": torch.cuda.max_memory_reserved()}
    return {name: peak / 2**20 for name, peak in peaks.items()}


def mean_of(samples: list[dict]) -> dict:
    """The mean of every key."""
    return {key: statistics.mean(sample[key] for sample in samples) for key in samples[0]}
