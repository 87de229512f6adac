"""How many images per second several ranks train with, against one, and what a model expects of more of them.

    python benchmarks/distributed.py SCENE --views VIEWS --ranks 1 2 [--times 8] [--device cuda]

One process per rank is started on this machine, with NCCL and a device each, or with gloo on the CPU. What is measured
are training steps as `train` takes them, on pictures of noise and without density control: by `Trainer` on one rank,
which is the plain path, and by `ShardedTrainer` on more. A step on N ranks shows N pictures, one per rank. All N take
turns, round after round; the first round warms up, and columns are medians of the slowest rank:

- images/s, and how often as many that is as on the first N of the list;
- state: memory of this rank's Gaussians and their moments; peak: the most that is in use during a step, state included,
  and what share that is of the first N's;
- MB sent by a rank to others in a step, forth and back, and what the documentation's formula gives for it;
- exchange: time of these two exchanges alone, started together, with the step's own sizes, in ms;
- model: images/s by t(N) = t(1) + sent / bandwidth, the bandwidth being that of the largest N's exchange.

The model is for ranks that have a device each and projections that are spread evenly; it leaves out what waiting for
the slowest rank and small messages cost. It is printed for 4, 8 and 64 ranks as well. Where processes share the cores
of one CPU, as with gloo here, its premise does not hold: compare only bytes and exchange then. `--times K` makes a
larger scene of a small one: K Gaussians in the place of each, drawn from it, with its covariance divided by K.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from typing import Any
from unittest import mock

import torch
import torch.distributed as dist
from common import add_measuring, parse, print_setup, save_json
from scene_files import load_scene

from analytic_rasterizer import io
from analytic_rasterizer.analysis.tables import format_table
from analytic_rasterizer.analysis.timing import added_memory
from analytic_rasterizer.cameras.rotations import rotation_matrices
from analytic_rasterizer.captures.pictures import Pictures
from analytic_rasterizer.cli.arguments import add_scales, reduction
from analytic_rasterizer.cli.launch import make_group
from analytic_rasterizer.distributed.exchange import Route
from analytic_rasterizer.distributed.ranks import Ranks, even_counts
from analytic_rasterizer.gaussians import Gaussians
from analytic_rasterizer.training import TrainingOptions
from analytic_rasterizer.training.sharded import ShardedTrainer
from analytic_rasterizer.training.trainer import Trainer

PREDICTED = (4, 8, 64)
BYTES_OF_A_SPLAT = 84  # forth and back, docs/internals/distributed.md
BLACK = (0.0, 0.0, 0.0)
COLUMNS = ("seconds", "exchange", "sent", "state_bytes", "peak_bytes")


def main() -> None:
    args = parse_arguments()
    scene, views = load_scene(args.scene), io.load_views(args.views)
    world = max(args.ranks)
    with tempfile.TemporaryDirectory() as folder:
        torch.multiprocessing.start_processes(work, (folder, args), world, start_method="spawn")
        results = torch.load(f"{folder}/results.pt")
    print_setup(scene, views, args.device)
    if args.times > 1:
        print(f"each Gaussian as {args.times}, {args.times * len(scene.means)} in all")
    if args.device == "cpu":
        print(f"the processes share this machine's cores, with {args.threads} threads each")
    expected = model_of(results)
    print(format_results(results, expected))
    save_json(args, {"results": results, "model": expected})


def parse_arguments() -> argparse.Namespace:
    parser = make_rank_parser(__doc__.split("\n")[0], "box:samples=4")
    parser.add_argument(
        "--steps", type=int, default=5, metavar="N", help="that are timed together in a round (default: 5)"
    )
    return parse_ranks(parser)


def make_rank_parser(description: str, footprint: str) -> argparse.ArgumentParser:
    """A parser of what benchmarks of several ranks take, for `parse_ranks`."""
    parser = argparse.ArgumentParser(description=description)
    add = parser.add_argument
    add("scene", help="trained scene: .ply, compressed .ply, .spz, or .npz (see scene_files.py)")
    add("--views", required=True, help="file of views")
    add("--ranks", type=int, nargs="+", default=[1, 2], metavar="N", help="(default: 1 2)")
    add("--footprint", default=footprint, metavar="NAME[:k=v]", help="(default: %(default)s)")
    add_scales(parser, reduction, "of the views: 2 is half the size (default: 1)", 1.0)
    add("--times", type=int, default=1, metavar="K", help="replace each Gaussian by K smaller ones (default: 1)")
    add_measuring(parser)
    return parser


def parse_ranks(parser: argparse.ArgumentParser) -> argparse.Namespace:
    """The arguments. Ends the program where there are not as many devices as ranks."""
    args = parse(parser)
    world = max(args.ranks)
    if args.device == "cuda" and world > torch.cuda.device_count():
        raise SystemExit(f"--ranks {world}: there are {torch.cuda.device_count()} CUDA devices")
    return args


# --- the processes ----------------------------------------------------------------------------------


def join_group(rank: int, world: int, folder: str, args: argparse.Namespace) -> torch.device:
    """Makes this process one of `world` ranks that meet in the folder; the rank's device."""
    torch.set_num_threads(args.threads)
    device = torch.device("cpu")
    if args.device == "cuda":
        device = torch.device("cuda", rank)
        torch.cuda.set_device(device)
    backend = "gloo" if args.device == "cpu" else "cpu:gloo,cuda:nccl"
    make_group(backend, init_method=f"file://{folder}/rendezvous", rank=rank, world_size=world)
    return device


def work(rank: int, folder: str, args: argparse.Namespace) -> None:
    """What a process does; the first one writes the results."""
    device = join_group(rank, max(args.ranks), folder, args)
    groups = {count: dist.new_group(list(range(count))) for count in args.ranks}
    cases = {n: Case(args, Ranks.of_group(group), device) for n, group in groups.items() if rank < n}
    measured: dict[int, list[dict[str, float]]] = {count: [] for count in args.ranks}
    for _ in range(args.rounds + 1):
        for count, case in cases.items():
            measured[count].append(case.measure())
        dist.barrier()
    results = {}
    for count, rounds in measured.items():
        own = {key: statistics.median(of_round[key] for of_round in rounds[1:]) for key in COLUMNS} if rounds else None
        of_ranks = [r for r in Ranks.of_group().exchange(own) if r is not None]
        results[count] = {key: max(r[key] for r in of_ranks) for key in COLUMNS}
        of_cases = Ranks.of_group().exchange(cases[count].splats if count in cases else 0.0)
        splats = max(of_cases)
        results[count] |= {"splats": splats, "images_per_second": count / results[count]["seconds"]}
    if rank == 0:
        torch.save(results, f"{folder}/results.pt")
    dist.destroy_process_group()


class Shard(ShardedTrainer):
    """A `ShardedTrainer` that is given the Gaussians of its rank alone, so that nobody has to hold all of them."""

    def __init__(self, options, start: Gaussians, pictures, background, device, ranks: Ranks):
        self.counts = ranks.exchange(len(start.means))
        Trainer.__init__(self, options, start, pictures, background, device, ranks)


class Case:
    """A training on the ranks of a group.

    Attributes:
        splats: Mean number of splats of a camera, over all ranks, in the last step that was looked at.
    """

    def __init__(self, args: argparse.Namespace, ranks: Ranks, device: torch.device):
        self.ranks, self.device, self.steps, self.splats = ranks, device, args.steps, 0.0
        scene = load_scene(args.scene)
        rows = ranks.part_of(even_counts(len(scene.means), ranks.world))
        own = scene.rows(rows).to(device)
        start = densified(own, args.times).trainable()
        # All degrees of the harmonics from the first step on, and no last step.
        options = {"sh_degree": scene.sh_degree, "sh_every": 1, "iterations": 2**30, "density": "none"}
        options = TrainingOptions(footprint=args.footprint, **options)
        pictures = pictures_of_noise(io.load_views(args.views), args.scales, device)
        if ranks.world == 1:
            self.trainer = Trainer(options, start, pictures, BLACK, device)
        else:
            self.trainer = Shard(options, start, pictures, BLACK, device, ranks)
        self.trainer.progress.step = scene.sh_degree

    def measure(self) -> dict[str, float]:
        """Seconds of a step, and of its exchanges; bytes sent, of the state of this rank, and in use at most."""
        self._together()
        start = time.perf_counter()
        for _ in range(self.steps):
            self.trainer.step()
        self._wait()
        seconds = (time.perf_counter() - start) / self.steps
        calls, rows, send, route_rows = [], [], dist.all_to_all_single, Route.rows

        def noted(out, flat, received, sent, **others):
            calls.append((received, sent, flat.shape[1:]))  # not the tensors, whose memory is counted
            return send(out, flat, received, sent, **others)

        def noted_rows(route, forth):
            received, sent = route_rows(route, forth)
            rows.append(sum(sent))
            return received, sent

        with mock.patch.object(dist, "all_to_all_single", noted), mock.patch.object(Route, "rows", noted_rows):
            _, extra = added_memory(self.trainer.step, self.device)
        self.trainer.losses.clear()
        if rows:
            self.splats = sum(self.ranks.exchange(rows[0])) / self.ranks.world
        gaussians = self.trainer.gaussians
        moments = (t for field in gaussians for t in self.trainer.optimizer.state[field].values() if torch.is_tensor(t))
        state = sum(t.nbytes for t in (*gaussians, *moments))
        return {"seconds": seconds, "state_bytes": state, "peak_bytes": state + extra} | self._exchange(calls)

    def _exchange(self, calls: list[tuple[list[int], list[int], torch.Size]]) -> dict[str, float]:
        """The exchanges of a step by themselves. Calls: rows received and sent by rank, and the shape of a row."""
        seconds, bytes_sent = 0.0, 0
        for received, sent, shape in calls:
            flat, out = (torch.zeros(sum(counts), *shape, device=self.device) for counts in (sent, received))
            bytes_sent += flat[sent[self.ranks.rank] :].nbytes
            self._together()
            start = time.perf_counter()
            dist.all_to_all_single(out, flat, received, sent, group=self.ranks.group)
            self._wait()
            seconds += time.perf_counter() - start
        return {"exchange": seconds, "sent": bytes_sent}

    def _together(self) -> None:
        self._wait()
        self.ranks.exchange(None)

    def _wait(self) -> None:
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)


def densified(scene: Gaussians, times: int) -> Gaussians:
    """So many Gaussians in the place of each, drawn from it, whose covariances with that of their means make its own.

    Each rank draws anew.
    """
    if times == 1:
        return scene
    several = scene.map(lambda field: field.repeat_interleave(times, 0))
    means, generator = several.means, torch.Generator(scene.means.device).manual_seed(0)
    normal = torch.randn(means.shape, generator=generator, device=means.device)
    along = (1 - 1 / times) ** 0.5 * several.scales * normal
    means = means + (rotation_matrices(several.rotations) * along[:, None, :]).sum(2)
    return several._replace(means=means).with_activated(scales=several.scales / times**0.5)


def pictures_of_noise(views: list[io.View], reduction: float, device: torch.device) -> Pictures:
    settings = [view.settings(1 / reduction, BLACK, device=device) for view in views]
    generator = torch.Generator().manual_seed(0)
    sizes = [(3, s.image_height, s.image_width) for s in settings]
    colors = [torch.randint(256, size, dtype=torch.uint8, generator=generator).to(device) for size in sizes]
    return Pictures(views, {1: settings}, {1: colors})


# --- the model --------------------------------------------------------------------------------------


def bytes_sent(splats: float, ranks: int) -> float:
    """Of a rank in a step with a camera per rank, each of which sees so many splats (docs/internals/distributed.md)."""
    return BYTES_OF_A_SPLAT * splats * (ranks - 1) / ranks


def model_of(results: dict[int, dict[str, Any]]) -> dict[int, dict[str, float]]:
    """What is expected of the numbers of ranks that were measured, and of more."""
    one, largest = results[min(results)], results[max(results)]
    bandwidth = largest["sent"] / largest["exchange"] if largest["sent"] else None
    expected = {}
    for ranks in sorted({*results, *PREDICTED}):
        sent = bytes_sent(largest["splats"], ranks)
        expected[ranks] = {"sent": sent}
        if min(results) == 1 and (bandwidth or ranks == 1):
            seconds = one["seconds"] + (sent / bandwidth if bandwidth else 0.0)
            expected[ranks] |= {"seconds": seconds, "images_per_second": ranks / seconds}
    return expected


def format_results(results: dict[int, dict[str, Any]], expected: dict[int, dict[str, float]]) -> str:
    base, rows = results[min(results)], []
    for ranks, model in expected.items():
        model_rate = f"{model['images_per_second']:.2f}" if "images_per_second" in model else "-"
        cells = [None] * 7
        if ranks in results:
            r = results[ranks]
            cells = [
                f"{r['images_per_second']:.2f}",
                f"{r['images_per_second'] / base['images_per_second']:.2f}",
                f"{r['state_bytes'] / 2**20:.1f}",
                f"{r['peak_bytes'] / 2**20:.1f}",
                f"{r['peak_bytes'] / base['peak_bytes']:.2f}",
                f"{r['sent'] / 1e6:.2f}",
                f"{1e3 * r['exchange']:.2f}",
            ]
        rows.append([ranks, *cells, f"{model['sent'] / 1e6:.2f}", model_rate])
    header = ["ranks", "images/s", "ratio", "state MiB", "peak MiB", "ratio", "MB sent", "exchange ms"]
    return format_table([*header, "model MB", "model images/s"], rows)


if __name__ == "__main__":
    main()
