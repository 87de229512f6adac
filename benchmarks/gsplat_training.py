"""Trains a capture through gsplat's call with gsplat's DefaultStrategy, the call imported from here or from gsplat.

    python benchmarks/gsplat_training.py bonsai [--rasterizer ours gsplat] [--scale 2] [--iterations 7000] [--absgrad]

The loop is that of a program that was written for gsplat: six parameters with an Adam each, the rates and the schedule
of 3DGS, L1 and SSIM, a random picture a step. Pictures, their split, first Gaussians and loss are those of
`analytic_rasterizer.training`, the same for both. gsplat must be installed; its own `rasterization` needs CUDA.

A row is a rasterizer, trained from the same seed: seconds of the steps alone, PSNR [dB] of the test pictures, Gaussians
in the end, and the peaks of what torch's allocator had in use and reserved while training, pictures included.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

import torch
from captures import add_capture, load_train_and_test
from common import has_cuda, peaks_of_memory, start_peaks

from analytic_rasterizer.analysis.tables import format_table
from analytic_rasterizer.analysis.timing import describe_machine
from analytic_rasterizer.captures.extent import extent_of
from analytic_rasterizer.dialects import gsplat as ours
from analytic_rasterizer.io import View
from analytic_rasterizer.losses import l1_ssim
from analytic_rasterizer.training import TrainingOptions, load_capture
from analytic_rasterizer.training.evaluation import psnr
from analytic_rasterizer.training.files import write_json
from analytic_rasterizer.training.schedule import Clock, PictureOrder
from analytic_rasterizer.training.start import starting_gaussians

RATES = {"means": 1.6e-4, "scales": 5e-3, "quats": 1e-3, "opacities": 5e-2, "sh0": 2.5e-3, "shN": 2.5e-3 / 20}
"""Of 3DGS; that of the means per unit of the extent, and falling to a hundredth."""
DEGREE, DEGREE_EVERY = 3, 1000


def main() -> int:
    args = parse_arguments()
    try:
        import gsplat
    except ImportError as error:
        print(f"error: gsplat, whose strategy this runs, is not installed ({error})", file=sys.stderr)
        return 2
    calls = {"gsplat": gsplat.rasterization}  # before `patch`
    ours.patch()
    calls["ours"] = gsplat.rasterization
    if "gsplat" in args.rasterizer and args.device == "cpu":
        print("error: --rasterizer gsplat: needs CUDA", file=sys.stderr)
        return 2
    torch.backends.cudnn.allow_tf32 = False
    capture = load_capture(args.scene, args.images, lens="undistort", masks="none")
    options = TrainingOptions(
        iterations=args.iterations, scales=(args.scale,), seed=args.seed, random_points=args.random_points
    )
    background, train, test = load_train_and_test(args, capture, options)
    rows = {
        name: Training(calls[name], options, capture, train, background, args).run(test) for name in args.rasterizer
    }
    header = ["rasterizer", "seconds", "PSNR", "Gaussians", "used MiB", "reserved MiB"]
    print(format_table(header, [[name, *row.values()] for name, row in rows.items()]))
    if args.json:
        write_json(args.json, {"machine": describe_machine(args.device), "gsplat": gsplat.__version__, "runs": rows})
    return 0


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    add = parser.add_argument
    add_capture(parser)
    add("--rasterizer", nargs="+", choices=("ours", "gsplat"), default=["ours"], help="(default: %(default)s)")
    add("--scale", type=int, default=1, help="of the pictures: 2 is half the size (default: %(default)s)")
    add("--iterations", type=int, default=7000, help="(default: %(default)s)")
    add("--seed", type=int, default=0)
    add("--random-points", type=int, default=TrainingOptions.random_points, help="where the capture has none")
    add("--refine-start", type=int, default=500, help="of the strategy (default: %(default)s)")
    add("--refine-every", type=int, default=100, help="of the strategy (default: %(default)s)")
    add("--packed", action="store_true")
    add("--absgrad", action="store_true", help="the strategy reads sums of absolute gradients, from 0.0008 on")
    add("--antialiased", action="store_true")
    add(
        "--device", choices=("cpu", "cuda"), default="cuda" if has_cuda() else "cpu", help="(default here: %(default)s)"
    )
    add("--json", type=Path, metavar="FILE")
    return parser.parse_args()


class Training:
    """Six parameters, and what renders and changes them."""

    def __init__(self, rasterization: Callable, options: TrainingOptions, capture, train, background, args):
        from gsplat import DefaultStrategy

        self.rasterization, self.options, self.args, self.pictures = rasterization, options, args, train
        self.device, self.on_cuda = torch.device(args.device), args.device == "cuda"
        self.background = torch.tensor([background or (0.0, 0.0, 0.0)], device=self.device)
        start = starting_gaussians(options, capture.points)
        values = {
            "means": start.means,
            "scales": start.log_scales,
            "quats": start.rotations,
            "opacities": start.logit_opacities[:, 0],
            "sh0": start.shs[:, :1],
            "shN": start.shs[:, 1:],
        }
        extent = extent_of(train.views, None if capture.points is None else capture.points[0])
        self.params = torch.nn.ParameterDict({k: torch.nn.Parameter(v.to(self.device)) for k, v in values.items()})
        rates = RATES | {"means": RATES["means"] * extent}
        self.optimizers = {
            name: torch.optim.Adam([{"params": p, "lr": rates[name], "name": name}], eps=1e-15, fused=self.on_cuda)
            for name, p in self.params.items()
        }
        growth = {"absgrad": True, "grow_grad2d": 0.0008} if args.absgrad else {}
        self.strategy = DefaultStrategy(refine_start_iter=args.refine_start, refine_every=args.refine_every, **growth)
        self.strategy.check_sanity(self.params, self.optimizers)
        self.state = self.strategy.initialize_state(scene_scale=extent)
        self.options_of_call = {
            "packed": args.packed,
            "absgrad": args.absgrad,
            "rasterize_mode": "antialiased" if args.antialiased else "classic",
        }

    def render(self, view: View, degree: int) -> tuple[torch.Tensor, dict]:
        """The image (3, H, W), and `meta`."""
        p = self.params
        intrinsics = [[view.fx, 0.0, view.middle[0]], [0.0, view.fy, view.middle[1]], [0.0, 0.0, 1.0]]
        images, _, meta = self.rasterization(
            p["means"],
            p["quats"],
            p["scales"].exp(),
            p["opacities"].sigmoid(),
            torch.cat([p["sh0"], p["shN"]], 1),
            view.w2c[None].to(p["means"]),
            torch.tensor([intrinsics]).to(p["means"]),
            view.width,
            view.height,
            sh_degree=degree,
            backgrounds=self.background,
            **self.options_of_call,
        )
        return images[0].permute(2, 0, 1), meta

    def step(self, step: int, number: int) -> None:
        scale = self.args.scale
        common = self.params, self.optimizers, self.state, step
        image, meta = self.render(self.pictures.views[number].scaled(1 / scale), min(step // DEGREE_EVERY, DEGREE))
        self.strategy.step_pre_backward(*common, meta)
        l1_ssim(image, self.pictures.target(scale, number)).backward()
        for optimizer in self.optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        for group in self.optimizers["means"].param_groups:
            group["lr"] *= 0.01 ** (1 / self.options.iterations)
        self.strategy.step_post_backward(*common, meta, packed=self.args.packed)

    def run(self, test) -> dict[str, float | int | None]:
        """A row of the table, by what it says."""
        torch.manual_seed(self.options.seed)
        start_peaks(self.args.device)
        order, clock = PictureOrder(len(self.pictures.views), self.options), Clock(self.device)
        clock.start()
        for step in range(self.options.iterations):
            self.step(step, order(step)[0])
        clock.stop()
        memory = peaks_of_memory(self.args.device)
        return {
            "seconds": clock.read(),
            "psnr": self.psnr(test),
            "gaussians": len(self.params["means"]),
            **memory,
        }

    @torch.no_grad()
    def psnr(self, test) -> float | None:
        scale, found = self.args.scale, []
        for number, view in enumerate(test.views):
            image, _ = self.render(view.scaled(1 / scale), DEGREE)
            found.append(psnr(image.clamp(0, 1), test.truth(scale, number)))
        return torch.stack(found).mean().item() if found else None


if __name__ == "__main__":
    sys.exit(main())
