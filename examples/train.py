"""Trains 3D Gaussians at several resolutions with one footprint after another, and compares them.

    python examples/train.py DATA --out DIR --steps 7000 --seeds 0 1 2
    python examples/train.py DATA --out DIR --seconds 60 --footprints analytic box:samples=4

DATA is a scene of the NeRF-synthetic set (transforms_train.json, transforms_test.json, the RGBA PNGs they name; on
white) or a capture (photographs in images/, COLMAP's sparse/0/*.bin with pinhole cameras; every eighth photograph by
name is for the test; on black). It needs pillow and tqdm: `pip install analytic_rasterizer[cli]`.

Every step renders one training view at one scale; all pairs of them pass in random order, then again in another.
All footprints of a seed start from the same Gaussians, 100,000 at random places or those at COLMAP's points, and see
the same pairs in the same order. Losses and learning rates are those of 3DGS, and so is the density control
(densify.py), which `--no-densify` leaves out. Spherical harmonics gain a degree every 1,000 steps, or every tenth
of a shorter training.

Footprints differ in time per step, so that there are two fair comparisons, each a training of its own. With
`--steps` all take as many steps. With `--seconds` all train for as long, by the wall clock and without evaluations:
the learning rate and the end of growth follow the share of time that is over, so that each footprint goes through a
complete schedule. (Reading equal times off the curves of equal steps would compare trainings that were cut off.) The
clock is read after 10 steps and then every 100, where the host waits for the device; in between the share grows at the
pace of the steps before. Periods of the density control stay in steps, as they are there to gather gradients from many
views; a training by time should therefore last for thousands of steps.

The table gives means over seeds, and ± the standard deviation over seeds of the mean over scales.

DIR receives pictures/FOOTPRINT_SCALE_VIEW.png of the first seed, the rendering on the left and the truth on the
right, and results.json, rewritten after every run. Its "runs" hold

    footprint, seed
    steps, seconds, ms_per_step, gaussians   of the training; its evaluations are not timed
    psnr [dB], ssim                          by scale, means over test views, at the end
    checkpoints                              steps, seconds, gaussians, psnr, ssim, every --evaluate-every steps
    loss                                     means of 10 steps each, the last of what is left
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from statistics import mean, stdev

import torch
from tqdm import tqdm

import analytic_rasterizer as ar
import dataset
from analytic_rasterizer.analysis.tables import format_table
from analytic_rasterizer.cli import Parser
from analytic_rasterizer.footprints import resolve_footprint
from densify import DensityControl, DensityOptions
from gaussians import Gaussians, gaussians_at, make_optimizer, means_rate, random_points
from metrics import evaluate, save_pictures, training_loss

FOOTPRINTS = ["point", "mip", "analytic", "cumulant", "box:samples=1", "box:samples=4"]
RANDOM_POINTS = 100_000
SH_STEPS, SH_SHARE = 1000, 0.1  # a degree is added after so many steps, or this share of the training
CHECK_PERIOD = 100  # steps between looks at the loss and the clock, each of which waits for the device
LOSS_PERIOD = 10  # steps that make one number in the report


def main(argv: list[str] | None = None) -> int:
    """Returns the exit code: 0, or 2 after an error, which is one line."""
    args = parse_arguments(argv)
    try:
        compare(args)
    except (ValueError, OSError, FloatingPointError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


def compare(args: argparse.Namespace) -> None:
    """Trains every footprint from every seed and reports."""
    torch.backends.cudnn.allow_tf32 = False  # the variances of SSIM are small differences
    data = dataset.load(args.data, args.images, args.scales, args.device)
    pictures = args.out / "pictures"
    pictures.mkdir(parents=True, exist_ok=True)
    arguments = {name: str(value) if isinstance(value, Path) else value for name, value in vars(args).items()}
    report = {"device": describe_device(args.device), "torch": torch.__version__, "arguments": arguments, "runs": []}
    for seed in args.seeds:
        start = starting_gaussians(data, args, seed)
        for footprint in args.footprints:
            gaussians, run = train(start, data, footprint, seed, args)
            if seed == args.seeds[0]:
                save_pictures(pictures, gaussians, data.test, footprint, args.sh_degree, args.pictures)
            report["runs"].append({"footprint": footprint, "seed": seed, **run})
            (args.out / "results.json").write_text(json.dumps(report) + "\n", encoding="utf-8")
    print(f"{args.data}, {report['device']}, torch {torch.__version__}, seeds {args.seeds}")
    print(format_runs(report["runs"], args.scales))


def parse_arguments(argv: list[str] | None) -> argparse.Namespace:
    has_cuda = torch.cuda.is_available() and ar._C.has_cuda
    parser = Parser(description=__doc__.split("\n")[0])
    add = parser.add_argument
    add("data", type=Path, metavar="DATA", help="folder of a NeRF-synthetic scene or of a COLMAP capture")
    add("--images", default="images", metavar="NAME", help="folder in DATA of a capture's photographs")
    add("--out", type=Path, required=True, metavar="DIR", help="folder for the results")
    add("--footprints", nargs="+", default=FOOTPRINTS, metavar="NAME[:k=v]")
    budget = parser.add_mutually_exclusive_group()
    budget.add_argument("--steps", type=positive_int, help="that every footprint takes (default: 7000)")
    budget.add_argument("--seconds", type=positive_float, help="that every footprint trains, instead of --steps")
    add("--seeds", type=int, nargs="+", default=[0], help="of starts, order of views and splits (default: 0)")
    add("--gaussians", type=positive_int, metavar="N", help="at the start (default: 100000, or a capture's points)")
    add("--scales", type=positive_int, nargs="+", default=[1, 2, 4, 8], help="reductions (default: 1 2 4 8)")
    add("--sh-degree", type=int, choices=range(4), default=3)
    add("--evaluate-every", type=positive_int, metavar="STEPS", help="besides the end")
    add("--pictures", type=int, default=2, help="views to draw per footprint and scale (default: 2)")
    add("--device", choices=("cpu", "cuda"), default="cuda" if has_cuda else "cpu")
    default = DensityOptions()
    add = parser.add_argument_group("density control").add_argument
    add("--no-densify", action="store_true", help="keep the Gaussians of the start")
    add("--densify-from", type=int, default=default.start, metavar="STEP")
    add("--densify-until", type=float, default=default.until, metavar="SHARE", help="of the training (default: 0.5)")
    add("--densify-every", type=positive_int, default=default.every, metavar="STEPS")
    add("--reset-every", type=positive_int, default=default.reset_every, metavar="STEPS", help="opacities")
    add("--gradient", type=positive_float, default=default.gradient, help="that makes Gaussians grow (default: 2e-4)")
    add("--max-gaussians", type=positive_int, metavar="N", help="grow no further than this")
    args = parser.parse_args(argv)
    if args.steps is None and args.seconds is None:
        args.steps = 7000
    args.scales = list(dict.fromkeys(args.scales))
    if args.device == "cuda" and not has_cuda:
        parser.error("--device cuda: no CUDA device, or analytic_rasterizer was built without CUDA")
    if args.gaussians is not None and args.gaussians < 4:
        parser.error(f"--gaussians must be at least 4, got {args.gaussians}")
    try:
        for footprint in args.footprints:
            resolve_footprint(footprint)
    except ValueError as error:
        parser.error(str(error))
    return args


def positive_int(text: str) -> int:
    if (value := int(text)) < 1:
        raise argparse.ArgumentTypeError(f"must be at least 1, got {value}")
    return value


def positive_float(text: str) -> float:
    if not 0 < (value := float(text)) < float("inf"):
        raise argparse.ArgumentTypeError(f"must be positive and finite, got {value}")
    return value


def density_options(args: argparse.Namespace) -> DensityOptions:
    return DensityOptions(
        start=args.densify_from,
        until=0 if args.no_densify else args.densify_until,
        every=args.densify_every,
        reset_every=args.reset_every,
        gradient=args.gradient,
        most=args.max_gaussians,
    )


def describe_device(device: str) -> str:
    return torch.cuda.get_device_name() if device == "cuda" else f"CPU, {torch.get_num_threads()} threads"


def format_runs(runs: list[dict], scales: list[int]) -> str:
    """A row per footprint: means over seeds, and with several the standard deviation of the mean PSNR."""
    rows = []
    for footprint in dict.fromkeys(run["footprint"] for run in runs):
        of_seeds = [run for run in runs if run["footprint"] == footprint]
        means = [mean(run["psnr"].values()) for run in of_seeds]
        spread = f" ± {stdev(means):.2f}" if len(means) > 1 else ""
        rows.append(
            [
                footprint,
                *(f"{mean(run['psnr'][scale] for run in of_seeds):.2f}" for scale in scales),
                f"{mean(means):.2f}{spread}",
                f"{mean(value for run in of_seeds for value in run['ssim'].values()):.4f}",
                round(mean(run["gaussians"] for run in of_seeds)),
                round(mean(run["steps"] for run in of_seeds)),
                f"{mean(run['seconds'] for run in of_seeds):.1f}",
                f"{mean(run['ms_per_step'] for run in of_seeds):.2f}",
            ]
        )
    header = ["footprint", *(f"PSNR 1/{scale}" for scale in scales), "mean", "SSIM"]
    return format_table([*header, "Gaussians", "steps", "seconds", "ms/step"], rows)


# ------------------------------------------------------------------------------------ training


def starting_gaussians(data: dataset.Dataset, args: argparse.Namespace, seed: int) -> Gaussians:
    points, colors = data.points or random_points(args.gaussians or RANDOM_POINTS, seed)
    if args.gaussians is not None and args.gaussians < len(points):
        chosen = torch.randperm(len(points), generator=torch.Generator().manual_seed(seed))[: args.gaussians]
        points, colors = points[chosen], colors[chosen]
    return gaussians_at(points.to(args.device), colors.to(args.device), args.sh_degree)


def endless_schedule(views: int, scales: list[int], seed: int) -> Iterator[tuple[int, int]]:
    """View and scale of each step: all pairs in random order, again and again."""
    generator = torch.Generator().manual_seed(seed)
    pairs = [(view, scale) for view in range(views) for scale in scales]
    while True:
        for chosen in torch.randperm(len(pairs), generator=generator).tolist():
            yield pairs[chosen]


def train(
    start: Gaussians, data: dataset.Dataset, footprint: str, seed: int, args: argparse.Namespace
) -> tuple[Gaussians, dict]:
    """Trains a copy of `start`; returns it and what the report says of the run.

    Nothing in a step waits for the device but densification, and every CHECK_PERIOD steps the losses and the clock.

    Raises FloatingPointError when the loss is not finite.
    """
    gaussians = Gaussians(*(field.clone().requires_grad_() for field in start))
    optimizer = make_optimizer(gaussians, data.extent)
    white = data.background == dataset.WHITE
    control = DensityControl(gaussians, optimizer, data.extent, density_options(args), white, seed)
    schedule = endless_schedule(len(data.train.views), args.scales, seed)
    settings = data.train.resolve(footprint, 0)
    for scale, of_scale in settings.items():  # so that the first run does not pay for loading kernels
        training_loss(gaussians.render(of_scale[0])[0], data.train.truth(scale, 0)).backward()
    optimizer.zero_grad(set_to_none=True)

    clock, progress = Clock(args.device), Progress(args.steps, args.seconds)
    losses, unchecked, checkpoints, degree = [], [], [], 0
    bar = tqdm(total=args.steps, desc=f"{footprint}, seed {seed}", unit="step", disable=None)
    while progress.share < 1:
        wanted = min(args.sh_degree, max(progress.step // SH_STEPS, int(progress.share / SH_SHARE)))
        if wanted > degree:
            degree, settings = wanted, data.train.resolve(footprint, wanted)
        optimizer.param_groups[0]["lr"] = means_rate(progress.share, data.extent)
        view, scale = next(schedule)
        image, radii = control.gaussians.render(settings[scale][view], control.means2D)
        loss = training_loss(image, data.train.truth(scale, view))
        loss.backward()
        optimizer.step()
        optimizer.zero_grad(set_to_none=True)
        unchecked.append(loss.detach())
        progress.advance()
        control.after_step(progress.step, progress.share, radii)
        if progress.step % CHECK_PERIOD == 0 or progress.step == LOSS_PERIOD or progress.share >= 1:
            losses += checked(unchecked, footprint, progress.step)
            bar.update(len(unchecked))
            unchecked.clear()
            progress.measure(clock.read())
        if progress.share >= 1 or (args.evaluate_every and progress.step % args.evaluate_every == 0):
            clock.stop()
            checkpoints.append(
                {"steps": progress.step, "seconds": clock.read(), "gaussians": len(control.gaussians.means)}
                | evaluate(control.gaussians, data.test, footprint, degree)
            )
            clock.start()
    bar.close()
    end = checkpoints[-1]
    return control.gaussians, {
        **end,
        "ms_per_step": 1e3 * end["seconds"] / end["steps"],
        "checkpoints": checkpoints,
        "loss": losses,
    }


class Progress:
    """The share of the training that is over, by steps or else by seconds."""

    def __init__(self, steps: int | None, seconds: float | None):
        self.steps, self.seconds = steps, seconds
        self.step, self.share = 0, 0.0
        self.measured = (0, 0.0)  # step and share where the clock was last read
        self.pace = 0.0  # share per step, by the clock

    def advance(self) -> None:
        self.step += 1
        self.share = self.step / self.steps if self.steps else self.share + self.pace

    def measure(self, elapsed: float) -> None:
        """Corrects the share by the seconds of training so far."""
        if self.seconds:
            step, share = self.measured
            self.share = elapsed / self.seconds
            self.pace = (self.share - share) / (self.step - step)
            self.measured = (self.step, self.share)


class Clock:
    """Wall time of training in seconds, work on the device included. Runs from the start."""

    def __init__(self, device: str):
        self.device, self.total = device, 0.0
        self.start()

    def start(self) -> None:
        self.since = self._now()

    def stop(self) -> None:
        self.total, self.since = self.read(), None

    def read(self) -> float:
        return self.total + (0.0 if self.since is None else self._now() - self.since)

    def _now(self) -> float:
        if self.device == "cuda":
            torch.cuda.synchronize()
        return time.perf_counter()


def checked(losses: list[torch.Tensor], footprint: str, step: int) -> list[float]:
    """Means of LOSS_PERIOD losses each, the last of which is that of `step`."""
    values = torch.stack(losses).tolist()
    if not all(map(math.isfinite, values)):
        raise FloatingPointError(f"{footprint}: the loss is not finite within the {len(losses)} steps before {step}")
    return [mean(values[i : i + LOSS_PERIOD]) for i in range(0, len(values), LOSS_PERIOD)]


if __name__ == "__main__":
    sys.exit(main())
