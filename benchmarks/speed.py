"""What each footprint costs: time per stage and memory, on any scene and views, on the CPU or with CUDA.

    python benchmarks/speed.py SCENE --views VIEWS [--footprints box:samples=1 analytic ...] [--device cuda]
                               [--against gsplat,module:NAME ...] [--queued]

The table gives medians over rounds, averaged over views, and the ratio to the first footprint. NAME@N is a footprint
in a picture of N times the width and height, averaged over N x N pixels.
"forward" is without gradient; "forward+backward" differentiates sum(image * w) for fixed random w in
all inputs, means2D among them. "extra" is the memory that a forward and backward pass needs beyond
inputs, image and gradients: peak less what is there before, less image and gradients.

On the CPU footprints are timed in turn, round after round, so that a machine that slows down slows
them all, and memory is the resident memory of the process.

With CUDA footprints are warmed up and timed one after another, because the room for pairs follows the
frames before. Times are between two events around a call on an idle device: the longer of launching
and computing. With --queued the device is busy with other work until a call has been launched, so that only computing
counts; stages are timed as ever. Of a peer that waits for the device within a call that cannot leave out all of the
host's time. "host" is the time until a call returns, without waiting for the device: the op itself
and `GaussianRasterizer`, both without gradient, and forward and backward of the latter. Memory is what
torch's allocator handed out; room for pairs follows the largest of the footprint's views of one size,
with reserve.

With --against, other rasterizers that are installed are timed beside ours (peers.py says which and how): all of them
in turn with the footprints, also with CUDA, where the room for pairs then is that of the footprint that has most. Of a
peer only the whole pass is timed. "differs" is the mean absolute difference of its pictures from ours.

Stages are those of `render_stages`, without gradient; "backward" is forward+backward less forward, so
it also holds what forward does only for its sake.
"""

from __future__ import annotations

import argparse
from functools import partial

import torch
from common import CLOCKS, add_sh_degree, make_parser, mean_of, measure, parse, print_setup, save_json
from peers import find_peers, mean_difference
from scene_files import load_padded

import analytic_rasterizer as ar
from analytic_rasterizer import io
from analytic_rasterizer.analysis.pareto import parse_method
from analytic_rasterizer.analysis.tables import format_table
from analytic_rasterizer.analysis.timing import Case, event_seconds, seconds_of
from analytic_rasterizer.gaussians import Gaussians

FOOTPRINTS = ["box:samples=1", "point", "mip", "cumulant", "analytic", "box:samples=4"]
STAGES = ("project", "list_tiles", "blend")
HOST = ("host op", "host rasterizer", "host f+b")


def main() -> None:
    args = parse_arguments()
    scene, views = load_padded(args.scene, args.sh_degree).to(args.device), io.load_views(args.views)
    results, per_view = measure_scene(args, scene, views)
    print_setup(scene, views, args.device)
    print(format_results(results, args.device))
    print("B/budget: extra memory over 120 B per Gaussian + 64 B per pair + 64 B per pixel")
    save_json(args, {"results": results, "per_view": per_view})


def parse_arguments() -> argparse.Namespace:
    parser = make_parser(__doc__.split("\n")[0], FOOTPRINTS)
    add_sh_degree(parser)
    add_against_and_queued(parser)
    return parse(parser)


def add_against_and_queued(parser: argparse.ArgumentParser) -> None:
    """Adds --against, a list of names, empty without it; and --queued."""
    add, split = parser.add_argument, lambda text: text.split(",")
    add("--against", type=split, default=[], metavar="PEER[,PEER...]", help="other rasterizers: peers.py")
    add("--queued", action="store_true", help="with CUDA, leave out the time that the host takes")


def measure_scene(args: argparse.Namespace, scene: Gaussians, views: list[io.View]) -> tuple[dict, dict]:
    """(means over the views, numbers of every view), each by footprint and peer; seconds and bytes."""
    peers = find_peers(args.against, args.device)
    cases = {name: [SpeedCase(scene, view, name) for view in views] for name in args.footprints}
    cases |= {name: [make(scene, view) for view in views] for name, make in peers.items()}
    by_themselves = args.device == "cuda" and not peers
    together = [{name: of_name} for name, of_name in cases.items()] if by_themselves else [cases]
    measured = {}
    for part in together:
        measured |= measure(part, partial(time_round, device=args.device, queued=args.queued), args.device, args.rounds)
    for name, of_name in cases.items():
        for case, view, result in zip(of_name, views, measured[name]):
            if name in peers:
                result["difference"] = mean_difference(case, scene, view)
            else:
                result["extra_share"] = result["extra_bytes"] / case.budget(result["pairs"])
    return {name: summarize(per_view) for name, per_view in measured.items()}, measured


def format_results(results: dict[str, dict], device: str) -> str:
    base = next(iter(results.values()))
    parts = [*STAGES, "backward", *HOST] if device == "cuda" else [*STAGES, "backward"]
    header = ["footprint", "forward ms", "forward+backward ms", "ratio", "ratio f+b"]
    further = ["pairs", "extra MiB", "B/budget"]
    with_peers = any("difference" in r for r in results.values())
    rows = []
    for name, r in results.items():
        ratios = [r[key] / base[key] for key in ("forward", "forward_backward")]
        seconds = [1e3 * r[key] if key in r else None for key in ("forward", "forward_backward", *parts)]
        pairs = round(r["pairs"]) if "pairs" in r else None
        rows.append([name, *seconds[:2], *ratios, *seconds[2:], pairs, r["extra_bytes"] / 2**20, r.get("extra_share")])
        rows[-1] += [r.get("difference")] if with_peers else []
    return format_table([*header, *parts, *further, *(["differs"] if with_peers else [])], rows)


class SpeedCase(Case):
    """A case whose stages and op can be run by themselves, of a footprint or NAME@N."""

    def __init__(self, scene: Gaussians, view: io.View, method: str):
        method = parse_method(method)
        super().__init__(scene, view, method.footprint, method.supersampling)
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


def time_round(case: Case, device: str, queued: bool = False) -> dict:
    """Seconds of the stages, of a forward pass without gradient, and of one with its backward pass; with CUDA also
    until calls return when the device has nothing else to do. Of a peer's case only those of whole passes."""
    clock, result = CLOCKS[device], {}
    if queued and device == "cuda":
        clock = partial(event_seconds, queued=True)
    own = isinstance(case, SpeedCase)
    if own:
        stages = case.stages()
        result = {**stages.seconds, "pairs": len(stages.pairs)}
        del stages
    result |= {"forward": clock(case.forward), "forward_backward": clock(case.forward_backward)}
    result["backward"] = result["forward_backward"] - result["forward"]
    if device == "cuda":
        calls = [case.op if own else None, case.forward, case.forward_backward]
        for name, call in zip(HOST, calls):
            if call is not None:
                result[name] = seconds_of(call)
                torch.cuda.synchronize()
    return result


def summarize(per_view: list[dict]) -> dict:
    """Means over views; of the share of the memory budget the worst."""
    summary = mean_of(per_view)
    if "extra_share" in summary:
        summary["extra_share"] = max(view["extra_share"] for view in per_view)
    return summary


if __name__ == "__main__":
    main()
