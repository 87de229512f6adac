"""What each footprint costs: time per stage and memory, on any scene and views, on the CPU or with CUDA.

    python benchmarks/speed.py SCENE --views VIEWS [--footprints box:samples=1 analytic ...] [--device cuda]

The table gives medians over rounds, averaged over views, and the ratio to the first footprint.
"forward" is without gradient; "forward+backward" differentiates sum(image * w) for fixed random w in
all inputs, means2D among them. "extra" is the memory that a forward and backward pass needs beyond
inputs, image and gradients: peak less what is there before, less image and gradients.

On the CPU footprints are timed in turn, round after round, so that a machine that slows down slows
them all, and memory is the resident memory of the process.

With CUDA every footprint is warmed up on all views, then timed view by view. Times are between two
events around a call on an idle device: the longer of launching and computing. Stages are those of
`render_stages`, without gradient; "backward" is forward+backward less forward, so it also holds what
forward does only for its sake. "host" is the time until a call returns, without waiting for the device:
the op itself and `GaussianRasterizer`, both without gradient, and forward and backward of the latter.
Memory is what torch's allocator handed out; room for pairs follows the largest of the footprint's views
of one size, with reserve.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable

import torch
from common import UNITS, WARM_UP, make_parser, median_of, median_seconds, parse, print_setup, save_json
from scene_files import load_scene

import analytic_rasterizer as ar
from analytic_rasterizer import io
from analytic_rasterizer.analysis.tables import format_table
from analytic_rasterizer.analysis.timing import (
    Case,
    event_seconds,
    in_turn,
    seconds_of,
    warm_up_cuda,
)

FOOTPRINTS = [
    "box:samples=1",
    "point",
    "mip",
    "cumulant",
    "analytic",
    "box:samples=2",
    "box:samples=4",
]
STAGES = ("project", "bin", "blend")
HOST = ("host op", "host rasterizer", "host f+b")


def main() -> None:
    args = parse_arguments()
    scene = pad_sh(load_scene(args.scene), args.sh_degree)
    if args.shuffle:
        order = torch.randperm(len(scene.means), generator=torch.Generator().manual_seed(0))
        scene = scene._replace(**{k: v[order] for k, v in scene._asdict().items() if torch.is_tensor(v)})
    scene = scene.to(args.device)
    views = io.load_views(args.views)
    cases = {name: [SpeedCase(scene, view, name) for view in views] for name in args.footprints}

    measured = (measure_cuda if args.device == "cuda" else measure_cpu)(cases, args.rounds)
    results = {name: summarize(per_view) for name, per_view in measured.items()}
    print_setup(scene, views, args.device)
    print(format_results(results, args.device))
    print("B/budget: extra memory over 120 B per Gaussian + 64 B per pair + 64 B per pixel")
    save_json(args, {"results": results, "per_view": measured})


def parse_arguments() -> argparse.Namespace:
    parser = make_parser(__doc__.split("\n")[0], FOOTPRINTS)
    parser.add_argument("--shuffle", action="store_true", help="randomise the order of the Gaussians")
    parser.add_argument(
        "--sh-degree", type=int, choices=range(4), help="pad the SH with zeros to this degree, as trainers hold them"
    )
    return parse(parser)


def pad_sh(scene: io.Scene, degree: int | None) -> io.Scene:
    """The scene with zeros for its missing coefficients up to `degree`; None leaves it alone."""
    if degree is None or degree == scene.sh_degree:
        return scene
    if degree < scene.sh_degree:
        raise SystemExit(f"--sh-degree {degree} is below the scene's, {scene.sh_degree}")
    missing = (degree + 1) ** 2 - scene.shs.shape[1]
    shs = torch.nn.functional.pad(scene.shs, (0, 0, 0, missing))
    return scene._replace(shs=shs, sh_degree=degree)


def format_results(results: dict[str, dict], device: str) -> str:
    base = next(iter(results.values()))
    unit, per_second = UNITS[device]
    parts = [*STAGES, "backward", *HOST] if device == "cuda" else STAGES
    header = ["footprint", f"forward {unit}", f"forward+backward {unit}", "ratio", "ratio f+b"]
    header += [*parts, "pairs", "extra MiB", "B/budget"]
    rows = [
        [
            name,
            f"{r['forward'] * per_second:.3f}",
            f"{r['forward_backward'] * per_second:.3f}",
            f"{r['forward'] / base['forward']:.2f}",
            f"{r['forward_backward'] / base['forward_backward']:.2f}",
            *(f"{r[part] * per_second:.3f}" for part in parts),
            f"{r['pairs']:.0f}",
            f"{r['extra_bytes'] / 2**20:.0f}",
            f"{r['extra_share']:.2f}",
        ]
        for name, r in results.items()
    ]
    return format_table(header, rows)


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

    def extra_memory(self, pairs: int) -> dict:
        """Bytes that forward and backward need beyond what goes in and comes out, and their share of
        120 B per Gaussian + 64 B per pair + 64 B per pixel."""
        extra = self.extra_bytes()
        pixels = self.settings.image_height * self.settings.image_width
        budget = 120 * len(self.gaussians["means3D"]) + 64 * pairs + 64 * pixels
        return {"extra_bytes": extra, "extra_share": extra / budget}


# --------------------------------------------------------------------------------- times, CPU


def measure_cpu(cases: dict[str, list[SpeedCase]], rounds: int) -> dict[str, list[dict]]:
    """Seconds and bytes by footprint and view."""
    samples = in_turn(cases, time_round, rounds + 1)
    medians = {name: [median_of(taken[1:]) for taken in of_name] for name, of_name in samples.items()}
    for name, of_name in cases.items():
        for case, result in zip(of_name, medians[name]):
            result.update(case.extra_memory(result["pairs"]))
    return medians


def time_round(case: SpeedCase) -> dict:
    """Seconds of one forward pass without gradient, by stage, and of one with its backward pass."""
    start = time.perf_counter()
    stages = case.stages()
    forward = time.perf_counter() - start
    pairs, by_stage = len(stages.pairs), stages.seconds
    del stages
    return {"forward": forward, "forward_backward": seconds_of(case.forward_backward), "pairs": pairs, **by_stage}


# -------------------------------------------------------------------------------- times, CUDA


def measure_cuda(cases: dict[str, list[SpeedCase]], rounds: int) -> dict[str, list[dict]]:
    """Seconds and bytes by footprint and view."""
    results = {}
    for name, of_name in cases.items():
        warm_up_cuda([call for case in of_name for call in (case.forward, case.forward_backward)], WARM_UP)
        results[name] = [time_case(case, rounds) for case in of_name]
    return results


def time_case(case: SpeedCase, rounds: int) -> dict:
    for _ in range(WARM_UP):
        case.forward()
        case.forward_backward()
    forward = median_seconds(event_seconds, case.forward, rounds)
    forward_backward = median_seconds(event_seconds, case.forward_backward, rounds)
    calls = (case.op, case.forward, case.forward_backward)
    host = {key: median_seconds(host_seconds, call, rounds) for key, call in zip(HOST, calls)}
    stages = []
    for _ in range(min(rounds, 10) + 1):
        made = case.stages()
        stages.append({**made.seconds, "pairs": len(made.pairs)})
        del made
    by_stage = median_of(stages[1:])
    return {
        "forward": forward,
        "forward_backward": forward_backward,
        "backward": forward_backward - forward,
        **host,
        **by_stage,
        **case.extra_memory(by_stage["pairs"]),
    }


def host_seconds(call: Callable[[], object]) -> float:
    """Time until a call returns, of a device that has nothing else to do."""
    seconds = seconds_of(call)
    torch.cuda.synchronize()
    return seconds


# -------------------------------------------------------------------------------------- means


def summarize(per_view: list[dict]) -> dict:
    """Means over views; of the share of the memory budget the worst."""
    means = {key: statistics.mean(view[key] for view in per_view) for key in per_view[0]}
    return {**means, "extra_share": max(view["extra_share"] for view in per_view)}


if __name__ == "__main__":
    main()
