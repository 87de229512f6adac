"""Trains one capture with several variants of the options, from several seeds, and compares what they reach.

    python benchmarks/training.py lego --iterations 7000 --scales 1,2,4,8 --seeds 0 1 2 --json results.json
    python benchmarks/training.py lego --variants default 3dgs --footprint box:samples=4 --seconds 12
    python benchmarks/training.py lego --more variants.json

VARIANTS below names them; `--more` adds others from a JSON file, {name: {option: value}}, with the options of
`analytic_rasterizer.training.TrainingOptions`. Options that are given on the command line are common to all variants.
All variants of a seed see the same pictures in the same order, unless they change what an order is made of.

A row of the table is a variant: PSNR [dB] of the test pictures per scale and their mean, ± the standard deviation over
seeds of that mean; SSIM; Gaussians in the end; seconds of training alone, without reading pictures and testing, and the
median time of a step, from looks at the clock every 100 steps; peaks of what torch's allocator had in use and reserved
on CUDA, pictures and test included: compare with PYTORCH_ALLOC_CONF=expandable_segments:True, which `train` sets. The
JSON file holds every run with its options and its
history, and is rewritten after each of them. Variants follow each other within a seed, so that a machine that slows
down slows all of them.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
from captures import add_capture, load_train_and_test, train_to_end
from common import has_cuda, peaks_of_memory, start_peaks

from analytic_rasterizer.analysis.tables import format_table
from analytic_rasterizer.analysis.timing import describe_machine
from analytic_rasterizer.training import Trainer, TrainingOptions, evaluate, load_capture
from analytic_rasterizer.training.files import write_json
from analytic_rasterizer.training.options import PRESETS, preset_values
from analytic_rasterizer.training.parts import DOWNSAMPLINGS
from analytic_rasterizer.training.start import background_of, starting_gaussians

RATES_OF_3DGS = {name: value for name, value in PRESETS["3dgs"].values.items() if name.endswith("_rate")}
VARIANTS: dict[str, dict[str, Any]] = {
    "default": {},
    "3dgs": preset_values("3dgs", (1, 2, 4, 8)),
    "gradient 2e-4": {"gradient": 2e-4},
    "gradient 4e-4": {"gradient": 4e-4},
    "gradient 6e-4": {"gradient": 6e-4},
    "limit 300k": {"max_gaussians": 300_000},
    "limit 600k": {"max_gaussians": 600_000},
    "signed gradients": {"density": "3dgs", "gradient": 1e-4},
    "gradients of all scales": {"gradient_scales": "all"},
    "split above 0.01": {"split_above": 0.01},
    "split above 0.001": {"split_above": 0.001},
    "grow until 0.5": {"densify_until": 0.5},
    "no resets": {"reset_every": 0},
    "rates of 3DGS": RATES_OF_3DGS,
    "opacity rate 0.1": {"opacity_rate": 0.1},
    "opacity rate 0.025": {"opacity_rate": 0.025},
    "color rate 0.01": {"color_rate": 1e-2},
    "means rate x 2": {"means_rate": 6.4e-4},
    "rates stay": {"rates_half_life": 0},
    "finest once": {"scale_repeats": (1, 1, 1, 1)},
    "finest three times": {"scale_repeats": (3, 1, 1, 1)},
    "SSIM 0.1": {"ssim_weight": 0.1},
    "4 pictures a step": {"pictures_per_step": 4},
    "sparse Adam": {"sparse_adam": True},
    "mcmc 300k": {"density": "mcmc", "max_gaussians": 300_000},
    "mcmc 600k": {"density": "mcmc", "max_gaussians": 600_000},
}


def main() -> int:
    args = parse_arguments()
    torch.backends.cudnn.allow_tf32 = False  # as in Run
    variants = VARIANTS | (json.loads(args.more.read_text()) if args.more else {})
    chosen = args.variants or list(variants)
    unknown = [name for name in chosen if name not in variants]
    if unknown:
        print(f"error: variants must be among {', '.join(variants)}; got {', '.join(unknown)}", file=sys.stderr)
        return 2
    options = {name: TrainingOptions(**(args.common | fitting(variants[name], args.common))) for name in chosen}
    capture = load_capture(args.scene, args.images)
    if not capture.test:
        print(f"error: {args.scene}: there are no test pictures", file=sys.stderr)
        return 2
    _, train, test = load_train_and_test(args, capture, TrainingOptions(**args.common))
    report = {"machine": describe_machine(args.device), "torch": torch.__version__, "scene": str(args.scene)}
    report["runs"] = runs = []
    for seed in args.seeds:
        for name in chosen:
            runs.append({"variant": name, "seed": seed, **train_once(options[name], seed, capture, train, test, args)})
            if args.json:
                write_json(args.json, report)
    print(format_runs(runs, args.common["scales"]))
    return 0


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    add = parser.add_argument
    add_capture(parser)
    add("--variants", nargs="+", metavar="NAME", help="(default: all)")
    add("--more", type=Path, metavar="FILE.json", help="further variants")
    add("--seeds", type=int, nargs="+", default=[0])
    add("--scales", default="1,2,4,8", help="(default: %(default)s)")
    add("--downsampling", choices=DOWNSAMPLINGS, default=TrainingOptions.downsampling, help="(default: %(default)s)")
    add("--footprint", default=TrainingOptions.footprint)
    add("--iterations", type=int, default=7000)
    add("--seconds", type=float, default=0.0, help="instead of iterations")
    points = "(default: 100000, or the limit of the variant where that is less)"
    add("--random-points", type=int, default=TrainingOptions.random_points, metavar="N", help=points)
    add("--device", choices=("cpu", "cuda"), default="cuda" if has_cuda() else "cpu")
    add("--json", type=Path, metavar="FILE", help="every run")
    args = parser.parse_args()
    given = ("footprint", "iterations", "seconds", "random_points", "downsampling")
    args.common = {name: getattr(args, name) for name in given}
    args.common["scales"] = tuple(int(scale) for scale in args.scales.split(","))
    return args


def fitting(variant: dict[str, Any], common: dict[str, Any]) -> dict[str, Any]:
    """The variant with as many `scale_repeats` as there are scales."""
    if "scale_repeats" not in variant:
        return variant
    return variant | {"scale_repeats": tuple(variant["scale_repeats"])[: len(common["scales"])]}


def train_once(options: TrainingOptions, seed: int, capture, train, test, args) -> dict[str, Any]:
    """One training and its test."""
    options = TrainingOptions.from_dict(options.to_dict() | {"seed": seed})
    background = background_of(options, capture.background)
    start_peaks(args.device)
    trainer = Trainer(options, starting_gaussians(options, capture.points), train, background, args.device)
    seconds, history = train_to_end(trainer)
    paces = [(b[1] - a[1]) / (b[0] - a[0]) for a, b in pairwise(history)] or [history[0][1] / history[0][0]]
    results = evaluate(trainer.scene(), test, options.footprint, supersampling=options.supersampling)
    for values in results.values():
        values.pop("views", None)
    return {
        "options": options.to_dict(),
        "steps": trainer.progress.step,
        "seconds": seconds,
        "ms_per_step": 1e3 * statistics.median(paces),
        "gaussians": len(trainer.gaussians.means),
        **peaks_of_memory(args.device),
        "test": results,
        "history": history,
    }


def format_runs(runs: list[dict], scales: tuple[int, ...]) -> str:
    rows = []
    for name in dict.fromkeys(run["variant"] for run in runs):
        of_variant = [run for run in runs if run["variant"] == name]
        means = [run["test"]["mean"]["psnr"] for run in of_variant]
        spread = f" ± {statistics.stdev(means):.2f}" if len(means) > 1 else ""
        rows.append(
            [
                name,
                *(f"{statistics.mean(run['test'][str(scale)]['psnr'] for run in of_variant):.2f}" for scale in scales),
                f"{statistics.mean(means):.2f}{spread}",
                f"{statistics.mean(run['test']['mean']['ssim'] for run in of_variant):.4f}",
                round(statistics.mean(run["gaussians"] for run in of_variant)),
                f"{statistics.mean(run['seconds'] for run in of_variant):.1f}",
                f"{statistics.mean(run['ms_per_step'] for run in of_variant):.2f}",
                *(max(run[key] or 0 for run in of_variant) or None for key in ("used_mib", "reserved_mib")),
            ]
        )
    header = ["variant", *(f"1/{scale}" for scale in scales), "mean", "SSIM", "Gaussians", "seconds", "ms/step"]
    header += ["used MiB", "reserved MiB"]
    return format_table(header, rows)


if __name__ == "__main__":
    sys.exit(main())
