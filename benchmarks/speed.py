"""What each footprint costs: time per stage and memory, on any scene and views, on the CPU or with CUDA.

    python benchmarks/speed.py SCENE --views VIEWS [--footprints box:samples=1 analytic ...] [--device cuda]

The table gives medians over rounds, averaged over views, and the ratio to the first footprint.
"forward" is without gradient; "forward+backward" differentiates sum(image * w) for fixed random w in
all inputs, means2D among them. "extra" is the memory that a forward and backward pass needs beyond
inputs, image and gradients: peak less what is there before, less image and gradients.

On the CPU footprints are timed in turn, round after round, so that a machine that slows down slows
them all, and memory is the resident memory of the process.

With CUDA footprints are warmed up and timed one after another, because the room for pairs follows the
frames before. Times are between two events around a call on an idle device: the longer of launching
and computing. "host" is the time until a call returns, without waiting for the device: the op itself
and `GaussianRasterizer`, both without gradient, and forward and backward of the latter. Memory is what
torch's allocator handed out; room for pairs follows the largest of the footprint's views of one size,
with reserve.

Stages are those of `render_stages`, without gradient; "backward" is forward+backward less forward, so
it also holds what forward does only for its sake.
"""

from __future__ import annotations

import argparse
from functools import partial

import torch
from common import CLOCKS, make_parser, mean_of, measure, parse, print_setup, save_json
from scene_files import load_scene, pad_sh

import analytic_rasterizer as ar
from analytic_rasterizer import io
from analytic_rasterizer.analysis.tables import format_table
from analytic_rasterizer.analysis.timing import Case, seconds_of

FOOTPRINTS = ["box:samples=1", "point", "mip", "cumulant", "analytic", "box:samples=2", "box:samples=4"]
STAGES = ("project", "bin", "blend")
HOST = ("host op", "host rasterizer", "host f+b")


def main() -> None:
    args = parse_arguments()
    scene = load_scene(args.scene)
    if args.sh_degree is not None:
        if args.sh_degree < scene.sh_degree:
            raise SystemExit(f"--sh-degree {args.sh_degree} is below the scene's, {scene.sh_degree}")
        scene = pad_sh(scene, args.sh_degree)
    scene = scene.to(args.device)
    views = io.load_views(args.views)
    cases = {name: [SpeedCase(scene, view, name) for view in views] for name in args.footprints}
    together = [{name: of_name} for name, of_name in cases.items()] if args.device == "cuda" else [cases]
    measured = {}
    for part in together:
        measured |= measure(part, partial(time_round, device=args.device), args.device, args.rounds)
    for name, of_name in cases.items():
        for case, result in zip(of_name, measured[name]):
            result["extra_share"] = result["extra_bytes"] / case.budget(result["pairs"])
    results = {name: summarize(per_view) for name, per_view in measured.items()}
    print_setup(scene, views, args.device)
    print(format_results(results, args.device))
    print("B/budget: extra memory over 120 B per Gaussian + 64 B per pair + 64 B per pixel")
    save_json(args, {"results": results, "per_view": measured})


def parse_arguments() -> argparse.Namespace:
    parser = make_parser(__doc__.split("\n")[0], FOOTPRINTS)
    parser.add_argument(
        "--sh-degree", type=int, choices=range(4), help="pad the SH with zeros to this degree, as trainers hold them"
    )
    return parse(parser)


def format_results(results: dict[str, dict], device: str) -> str:
    base = next(iter(results.values()))
    parts = [*STAGES, "backward", *HOST] if device == "cuda" else [*STAGES, "backward"]
    header = ["footprint", "forward ms", "forward+backward ms", "ratio", "ratio f+b"]
    rows = []
    for name, r in results.items():
        ratios = [r[key] / base[key] for key in ("forward", "forward_backward")]
        seconds = [1e3 * r[key] for key in ("forward", "forward_backward", *parts)]
        memory = [r["extra_bytes"] / 2**20, r["extra_share"]]
        rows.append([name, *seconds[:2], *ratios, *seconds[2:], round(r["pairs"]), *memory])
    return format_table([*header, *parts, "pairs", "extra MiB", "B/budget"], rows)


class SpeedCase(Case):
    """A case whose stages and op can be run by themselves."""

    def __init__(self, scene: io.Scene, view: io.View, footprint: str):
        super().__init__(scene, view, footprint)
        footprint = self.settings.footprint
        given = {**self.gaussians, **self.settings._asdict(), "footprint": footprint.key}
        given["option"] = footprint.option
        schema = torch.ops.analytic_rasterizer.rasterize.default._schema
        required = [a.name for a in schema.arguments if not a.has_default_value()]
        self.op_arguments = {name: given.get(name) for name in required}

    def stages(self) -> ar.Stages:
        return ar.render_stages(self.settings, **self.gaussians)

    @torch.no_grad()
    def op(self) -> None:
        torch.ops.analytic_rasterizer.rasterize(**self.op_arguments)

    def budget(self, pairs: int) -> int:
        """Bytes that the extra memory is compared with."""
        pixels = self.settings.image_height * self.settings.image_width
        return 120 * len(self.gaussians["means3D"]) + 64 * pairs + 64 * pixels


def time_round(case: SpeedCase, device: str) -> dict:
    """Seconds of the stages, of a forward pass without gradient, and of one with its backward pass; with CUDA also
    until calls return when the device has nothing else to do."""
    clock, stages = CLOCKS[device], case.stages()
    result = {**stages.seconds, "pairs": len(stages.pairs)}
    del stages
    result |= {"forward": clock(case.forward), "forward_backward": clock(case.forward_backward)}
    result["backward"] = result["forward_backward"] - result["forward"]
    if device == "cuda":
        for name, call in zip(HOST, (case.op, case.forward, case.forward_backward)):
            result[name] = seconds_of(call)
            torch.cuda.synchronize()
    return result


def summarize(per_view: list[dict]) -> dict:
    """Means over views; of the share of the memory budget the worst."""
    return {**mean_of(per_view), "extra_share": max(view["extra_share"] for view in per_view)}


if __name__ == "__main__":
    main()
