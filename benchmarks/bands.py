"""How long one large view takes on several ranks, and how much memory on each, against one.

    python benchmarks/bands.py SCENE --views VIEWS --ranks 1 2 --scales 0.25 [--times 8] [--copies 3] [--device cuda]

renders the first view with `distributed.rasterize_bands`, without gradients, and gathers the picture on rank 0. The
ranks are processes of this machine, with NCCL and a device each, or with gloo on the CPU, where they share the cores:
compare memory alone there. Columns, each of the rank with the most:

- ms: of a picture, median of the rounds after one that warms up;
- scene: MiB of this rank's Gaussians; peak: the most that is in use, scene included.

`--times K` replaces each Gaussian by K smaller ones. `--copies K` puts K - 1 copies of the scene beside it, out of most
views: a large scene has most of its Gaussians outside of a picture. What does not fit the devices is said so.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time

import torch
import torch.distributed as dist
from common import print_setup, save_json
from distributed import BLACK, densified, join_group, make_rank_parser, parse_ranks
from scene_files import load_scene

from analytic_rasterizer import io
from analytic_rasterizer.analysis.tables import format_table
from analytic_rasterizer.analysis.timing import added_memory
from analytic_rasterizer.distributed import rasterize_bands
from analytic_rasterizer.distributed.ranks import Ranks, even_counts
from analytic_rasterizer.gaussians import Gaussians

COLUMNS = ("seconds", "scene_bytes", "peak_bytes")


def main() -> None:
    args = parse_arguments()
    results = {ranks: measure(ranks, args) for ranks in args.ranks}
    scene, view = load_scene(args.scene), io.load_views(args.views)[0].scaled(1 / args.scales)
    print_setup(scene, [view], args.device)
    if args.times * args.copies > 1:
        print(f"each Gaussian as {args.times}, in {args.copies} copies: {args.times * args.copies * len(scene.means)}")
    rows = []
    for ranks, result in results.items():
        cells = ["does not fit", "-", "-"]
        if result:
            sizes = (f"{result[name] / 2**20:.1f}" for name in COLUMNS[1:])
            cells = [f"{1e3 * result['seconds']:.2f}", *sizes]
        rows.append([ranks, *cells])
    print(format_table(["ranks", "ms", "scene MiB", "peak MiB"], rows))
    save_json(args, {"results": results})


def parse_arguments() -> argparse.Namespace:
    parser = make_rank_parser(__doc__.split("\n")[0], "box:samples=1")
    parser.add_argument("--copies", type=int, default=1, metavar="K", help="of the scene, side by side (default: 1)")
    return parse_ranks(parser)


def measure(ranks: int, args: argparse.Namespace) -> dict[str, float] | None:
    """The columns; None where the scene does not fit."""
    with tempfile.TemporaryDirectory() as folder:
        try:
            torch.multiprocessing.start_processes(work, (ranks, folder, args), ranks, start_method="spawn")
        except torch.multiprocessing.ProcessRaisedException as error:
            # Whichever rank ends first is reported: the one that lacks memory, by its OutOfMemoryError, or another
            # one, which has been told of it and raises a RuntimeError: "on rank 1: CUDA out of memory".
            if "out of memory" not in str(error).lower():
                raise
            return None
        return torch.load(f"{folder}/results.pt")


def work(rank: int, world: int, folder: str, args: argparse.Namespace) -> None:
    """What a process does; the first one writes the results."""
    device = join_group(rank, world, folder, args)
    ranks = Ranks.of_group()
    scene, view = load_scene(args.scene), io.load_views(args.views)[0].scaled(1 / args.scales)
    own = shard_of(scene, ranks, args, device)
    settings = view.settings(1.0, BLACK, device=device, sh_degree=scene.sh_degree, footprint=args.footprint)

    @torch.no_grad()
    def render() -> float:
        """Seconds until the picture is there."""
        if device.type == "cuda":
            torch.cuda.synchronize()
        ranks.exchange(None)
        start = time.perf_counter()
        names = ("shs", "scales", "rotations")
        band = rasterize_bands(settings, own.means, own.opacities, **{name: getattr(own, name) for name in names})
        band.whole()
        if device.type == "cuda":
            torch.cuda.synchronize()
        return time.perf_counter() - start

    _, extra = added_memory(render, device)
    seconds = statistics.median([render() for _ in range(args.rounds)])
    scene_bytes = sum(field.nbytes for field in own)
    results = ranks.exchange(dict(zip(COLUMNS, (seconds, scene_bytes, scene_bytes + extra))))
    if rank == 0:
        torch.save({name: max(of_rank[name] for of_rank in results) for name in COLUMNS}, f"{folder}/results.pt")
    dist.destroy_process_group()


def shard_of(scene: Gaussians, ranks: Ranks, args: argparse.Namespace, device: torch.device) -> Gaussians:
    """What a rank holds of all copies."""
    rows = ranks.part_of(even_counts(len(scene.means), ranks.world))
    own = densified(scene.rows(rows).to(device), args.times)
    width = scene.means[:, 0].max() - scene.means[:, 0].min()
    aside = torch.arange(args.copies, device=device).repeat_interleave(len(own.means)) * width.to(device)
    copies = own.map(lambda field: field.repeat(args.copies, *[1] * (field.dim() - 1)))
    copies.means[:, 0] += aside
    return copies


if __name__ == "__main__":
    main()
