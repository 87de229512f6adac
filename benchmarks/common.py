"""The command line and the medians that the benchmarks share."""

from __future__ import annotations

import argparse
import json
import statistics

import torch

import analytic_rasterizer as ar
from analytic_rasterizer import io
from analytic_rasterizer.analysis.timing import describe_machine

ROUNDS = {"cpu": 5, "cuda": 30}
UNITS = {"cpu": ("s", 1.0), "cuda": ("ms", 1e3)}  # in which times are printed, and how many are in a second
WARM_UP = 15  # passes over the views before timing on CUDA


def make_parser(description: str, footprints: list[str]) -> argparse.ArgumentParser:
    """A parser of what every benchmark takes: a scene, views, footprints, and how to measure."""
    parser = argparse.ArgumentParser(description=description)
    add = parser.add_argument
    add("scene", help="trained scene: .ply, compressed .ply, .spz, or .npz (see scene_files.py)")
    add("--views", required=True, help="file of views")
    add("--footprints", nargs="+", default=footprints, metavar="NAME[:k=v]")
    device = "cuda" if has_cuda() else "cpu"
    add("--device", choices=("cpu", "cuda"), default=device, help="(default here: %(default)s)")
    add("--rounds", type=int, help="timed rounds after warming up (default: 5, with CUDA 30)")
    add("--threads", type=int, default=torch.get_num_threads(), help="of the CPU")
    add("--json", help="also write everything measured to this file")
    return parser


def parse(parser: argparse.ArgumentParser) -> argparse.Namespace:
    """The arguments, on a device that is there; sets the number of threads."""
    args = parser.parse_args()
    if args.device == "cuda" and not has_cuda():
        parser.error("--device cuda: no CUDA device, or analytic_rasterizer was built without CUDA")
    args.rounds = args.rounds or ROUNDS[args.device]
    torch.set_num_threads(args.threads)
    return args


def has_cuda() -> bool:
    return torch.cuda.is_available() and ar._C.has_cuda


def print_setup(scene: io.Scene, views: list[io.View], device: str) -> None:
    gaussians = f"{len(scene.means)} Gaussians of SH degree {scene.sh_degree}"
    print(f"{gaussians}, {len(views)} views of {views[0].width}x{views[0].height}, {describe_machine(device)}")


def save_json(args: argparse.Namespace, results: dict) -> None:
    """Writes the results with the machine and the arguments to --json, if that was given."""
    if args.json:
        with open(args.json, "w") as f:
            json.dump({"machine": describe_machine(args.device), "arguments": vars(args), **results}, f, indent=2)


def median_of(samples: list[dict]) -> dict:
    """The median of every key."""
    return {key: statistics.median(sample[key] for sample in samples) for key in samples[0]}


def mean_of(samples: list[dict]) -> dict:
    """The mean of every key."""
    return {key: statistics.mean(sample[key] for sample in samples) for key in samples[0]}
