"""Trains a capture with few of its photographs, with and without depths, and compares what they reach.

    python benchmarks/few_photographs.py bonsai --photographs 12 24 48 --depth none points maps
    python benchmarks/few_photographs.py maryrose --photographs 12 24 --depth none maps --iterations 1000

The photographs to train with are spread evenly over those of the capture; the test is the whole one. Of the capture's
points those are left that two of the photographs show (where no nearer point hides them, also if there are tracks):
the start, and what `points` compares. Maps are median depths of a training with all photographs, with noise, and with a
wrong scale where points can mend it.

A row is a training, from the same seed: PSNR [dB] of the test photographs as rendered and after the best affine colour,
Gaussians, and seconds of the steps alone.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

import numpy as np
import torch
from captures import add_capture, train_to_end
from common import has_cuda

import analytic_rasterizer as ar
from analytic_rasterizer.analysis.tables import format_table
from analytic_rasterizer.analysis.timing import describe_machine
from analytic_rasterizer.captures.depth import points_in
from analytic_rasterizer.captures.depth_files import DepthFile
from analytic_rasterizer.training import Capture, Trainer, TrainingOptions, evaluate, load_capture, load_pictures
from analytic_rasterizer.training.depth_targets import depths_of
from analytic_rasterizer.training.evaluation import COLOR_CORRECTED
from analytic_rasterizer.training.files import write_json
from analytic_rasterizer.training.start import background_of, begin

DEPTHS = ("none", "points", "maps")


def main() -> int:
    args = parse_arguments()
    torch.backends.cudnn.allow_tf32 = False
    capture = load_capture(args.scene, args.images, missing="skip")
    if "points" in args.depth and capture.points is None:
        print(f"error: {args.scene}: --depth points needs a capture with points", file=sys.stderr)
        return 2
    print(f"{args.scene}, {describe_machine(args.device)}")
    rows = {}
    with tempfile.TemporaryDirectory() as folder:
        if "maps" in args.depth:
            dense, _ = train(args, capture, "none")
            capture = with_maps(args, capture, dense, Path(folder))
        for count in args.photographs:
            few = with_few(capture, count)
            rows |= {f"{count}, {depth}": results_of(args, few, *train(args, few, depth)) for depth in args.depth}
    header = ["photographs, depths", "PSNR", "after the best colour", "Gaussians", "seconds"]
    print(format_table(header, [[name, *row.values()] for name, row in rows.items()]))
    if args.json:
        write_json(args.json, {"machine": describe_machine(args.device), "runs": rows})
    return 0


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    add_capture(parser)
    add = parser.add_argument
    add("--photographs", type=int, nargs="+", default=[12, 24, 48], help="to train with (default: %(default)s)")
    add("--depth", nargs="+", choices=DEPTHS, default=["none", "points"], help="(default: none points)")
    add("--noise", type=float, default=0.05, help="of maps, as a share of the inverse depth (default: %(default)s)")
    add("--wrong-scale", type=float, default=1.7, help="of maps, where there are points (default: %(default)s)")
    add("--scale", type=int, default=1, help="of the pictures: 2 is half the size (default: %(default)s)")
    add("--iterations", type=int, default=7000, help="(default: %(default)s)")
    add("--max-gaussians", type=int, default=TrainingOptions.max_gaussians, help="(default: %(default)s)")
    add("--seed", type=int, default=0)
    add("--device", choices=("cpu", "cuda"), default="cuda" if has_cuda() else "cpu")
    add("--json", metavar="FILE")
    args = parser.parse_args()
    names = ("iterations", "max_gaussians", "seed")
    args.common = {name: getattr(args, name) for name in names}
    args.common |= {
        "scales": (args.scale,),
        "first_footprint": "box:samples=1",
    }
    return args


def with_few(capture: Capture, count: int) -> Capture:
    """The capture with `count` of its photographs, and the points that two of them show.

    Without its source, whose tracks number all points.
    """
    every = len(capture.train) / count
    chosen = [capture.train[int((k + 0.5) * every)] for k in range(count)]
    if capture.points is None:
        return capture._replace(train=chosen, source=None)
    positions, colors = capture.points
    shown_by = sum(shown_points(item.view, positions).long() for item in chosen)
    rows = shown_by >= 2
    return capture._replace(train=chosen, points=(positions[rows], colors[rows]), source=None)


def shown_points(view: ar.View, positions: torch.Tensor) -> torch.Tensor:
    """(P,) bool: the points (P, 3) that a view shows. `points_in` says at which pixels and depths, in their order."""
    of_camera = positions.double() @ view.w2c[:3, :3].double().T + view.w2c[:3, 3].double()
    inverse = view.depths_of(of_camera).reciprocal()
    return torch.isin(inverse, points_in([view], positions, {})[0].inverse)


def with_maps(args, capture: Capture, dense: Trainer, folder: Path) -> Capture:
    """The capture with maps in `folder`: the median depths of a scene, with noise and scale of the arguments."""
    generator, scene = torch.Generator().manual_seed(args.seed), dense.scene()
    wrong = 1.0 if capture.points is None else args.wrong_scale
    of_views = dense.pictures.resolve(
        footprint="box:samples=1", sh_degree=scene.sh_degree, effects=ar.Effects(median_depth=True)
    )[args.scale]
    items = []
    for number, (item, settings) in enumerate(zip(capture.train, of_views)):
        with torch.no_grad():
            depth = ar.GaussianRasterizer(settings)(means2D=None, **scene.arguments())[-1].median_depth[0].cpu()
        noise = 1 + args.noise * torch.randn(depth.shape, generator=generator)
        path = folder / f"{number}.npy"
        np.save(path, torch.where(noise > 0.1, wrong * depth / noise, 0).numpy())
        items.append(item._replace(depth=DepthFile(path, is_inverse=False, scale=1.0)))
    return capture._replace(train=items)


def train(args, capture: Capture, depth: str) -> tuple[Trainer, float]:
    """A training to its end, and the seconds of its steps."""
    options = TrainingOptions(**args.common, depth=depth)
    start, _, options, _ = begin(options, capture, None, set(args.common))
    background = background_of(options, capture.background)
    depths = depths_of(options, capture)
    pictures = load_pictures(
        capture.train, options.scales, background, args.device, options.downsampling, maps=depths.maps
    )
    targets = depths.targets(pictures, torch.device(args.device))
    trainer = Trainer(options, start, pictures, background, args.device, depths=targets)
    return trainer, train_to_end(trainer)[0]


def results_of(args, capture: Capture, trainer: Trainer, seconds: float) -> dict[str, float | int]:
    """A row of the table, by what it says."""
    background = background_of(trainer.options, capture.background)
    test = load_pictures(capture.test, (args.scale,), background, args.device, trainer.options.downsampling)
    found = evaluate(trainer.scene(), test, trainer.options.footprint, color_corrected=True)["mean"]
    return {
        "psnr": found["psnr"],
        "corrected": found[COLOR_CORRECTED],
        "gaussians": trainer.count,
        "seconds": round(seconds, 1),
    }


if __name__ == "__main__":
    sys.exit(main())
