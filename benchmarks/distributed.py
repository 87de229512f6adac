"""What several ranks render and differentiate per second, against one, and what a model expects of more of them.

    python benchmarks/distributed.py SCENE --views VIEWS --ranks 1 2 [--footprint box:samples=4] [--device cuda]

One process per rank is started on this machine, with NCCL and a device each, or with gloo on the CPU. A step on N ranks
renders N cameras, one per rank, with `analytic_rasterizer.distributed.rasterize` from Gaussians that are spread evenly
over the ranks, and differentiates sum(image * w) for fixed random w in all of them. All N take turns, round after
round; the first round warms up, and columns are medians of the slowest rank:

- images/s, and how often as many that is as on the first N of the list;
- memory: of this rank's Gaussians, and what a step needs beyond them at most, gradients included;
- MB sent by a rank to others in a step, forth and back, and what the documentation's formula gives for it;
- exchange: time of these two exchanges alone, started together, with the step's own sizes, in ms;
- model: images/s by t(N) = t(1) + sent / bandwidth, the bandwidth being that of the largest N's exchange.

The model is for ranks that have a device each and projections that are spread evenly; it leaves out what waiting for
the slowest rank and small messages cost. It is printed for 4, 8 and 64 ranks as well. Where processes share the cores
of one CPU, as with gloo here, its premise does not hold: compare only bytes and exchange then.
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

from analytic_rasterizer import distributed, io
from analytic_rasterizer.analysis.tables import format_table
from analytic_rasterizer.analysis.timing import added_memory, fixed_weights
from analytic_rasterizer.training.ranks import Ranks, even_counts

PREDICTED = (4, 8, 64)
BYTES_OF_A_SPLAT = 88  # forth and back, docs/distributed.md
COLUMNS = ("seconds", "exchange", "sent", "own_bytes", "extra_bytes")


def main() -> None:
    args = parse_arguments()
    scene, views = load_scene(args.scene), io.load_views(args.views)
    world = max(args.ranks)
    if args.device == "cuda" and world > torch.cuda.device_count():
        raise SystemExit(f"--ranks {world}: there are {torch.cuda.device_count()} CUDA devices")
    with tempfile.TemporaryDirectory() as folder:
        torch.multiprocessing.start_processes(work, (folder, args), world, start_method="spawn")
        results = torch.load(f"{folder}/results.pt")
    print_setup(scene, views, args.device)
    if args.device == "cpu":
        print(f"the processes share this machine's cores, with {args.threads} threads each")
    expected = model_of(results)
    print(format_results(results, expected))
    save_json(args, {"results": results, "model": expected})


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    add = parser.add_argument
    add("scene", help="trained scene: .ply, compressed .ply, .spz, or .npz (see scene_files.py)")
    add("--views", required=True, help="file of views")
    add("--ranks", type=int, nargs="+", default=[1, 2], metavar="N", help="(default: 1 2)")
    add("--footprint", default="box:samples=4", metavar="NAME[:k=v]")
    add("--scale", type=float, default=1.0, help="resolution, as a factor")
    add_measuring(parser)
    return parse(parser)


# --- the processes ----------------------------------------------------------------------------------


def work(rank: int, folder: str, args: argparse.Namespace) -> None:
    """What a process does; the first one writes the results."""
    torch.set_num_threads(args.threads)
    device = torch.device("cpu")
    if args.device == "cuda":
        device = torch.device("cuda", rank)
        torch.cuda.set_device(device)
    backend = "gloo" if args.device == "cpu" else "cpu:gloo,cuda:nccl"
    world = max(args.ranks)
    dist.init_process_group(backend, init_method=f"file://{folder}/rendezvous", rank=rank, world_size=world)
    groups = {count: dist.new_group(list(range(count))) for count in args.ranks}
    cases = {n: Step(args, Ranks.of_group(group), device) for n, group in groups.items() if rank < n}
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
        splats = Ranks.of_group().from_first(cases[count].splats if count in cases else None)
        results[count] |= {"splats": splats, "images_per_second": count / results[count]["seconds"]}
    if rank == 0:
        torch.save(results, f"{folder}/results.pt")
    dist.destroy_process_group()


class Step:
    """A step on the ranks of a group.

    Attributes:
        splats: Mean number of splats of a camera, over all ranks, in the last step.
    """

    def __init__(self, args: argparse.Namespace, ranks: Ranks, device: torch.device):
        self.ranks, self.device, self.footprint, self.scale = ranks, device, args.footprint, args.scale
        scene = load_scene(args.scene)
        rows = ranks.part_of(even_counts(len(scene.means), ranks.world))
        own = io.Scene(*(field[rows] for field in scene[:-1]), scene.sh_degree).to(device)
        self.leaves = {name: value.clone().requires_grad_() for name, value in own.arguments().items()}
        self.sh_degree, self.views, self.number, self.splats = scene.sh_degree, io.load_views(args.views), 0, 0.0

    def run(self) -> distributed.Batch:
        """The next cameras, forward and backward."""
        world, options = self.ranks.world, {"footprint": self.footprint, "sh_degree": self.sh_degree}
        views = [self.views[(self.number + k) % len(self.views)] for k in range(world)]
        self.number += world
        settings = [view.settings(self.scale, device=self.device, **options) for view in views]
        batch = distributed.rasterize(settings, **self.leaves, group=self.ranks.group)
        loss = batch.anchor
        for view in batch.views:
            loss = loss + (view.image * fixed_weights(*view.image.shape[1:], self.device)).sum()
        loss.backward()
        return batch

    def measure(self) -> dict[str, float]:
        """Seconds of a step, and of its exchanges; bytes sent, of this rank's Gaussians, and needed beyond them."""
        self._together()
        start = time.perf_counter()
        batch = self.run()
        self._wait()
        seconds = time.perf_counter() - start
        in_all = sum(self.ranks.exchange(sum(len(splats.gaussian_ids) for splats in batch.shard)))
        self.splats = in_all / self.ranks.world
        del batch
        self._forget()
        with mock.patch.object(dist, "all_to_all_single", wraps=dist.all_to_all_single) as calls:
            _, extra = added_memory(self.run, self.device)
        self._forget()
        sizes = [call.args[1:4] for call in calls.call_args_list]  # what is sent, rows received and sent by rank
        own = sum(leaf.nbytes for leaf in self.leaves.values())
        return {"seconds": seconds, "own_bytes": own, "extra_bytes": extra} | self._exchange(sizes)

    def _exchange(self, calls: list[tuple[torch.Tensor, list[int], list[int]]]) -> dict[str, float]:
        """The exchanges of a step by themselves."""
        seconds, sent = 0.0, 0
        for rows, received, given in calls:
            sent += (len(rows) - given[self.ranks.rank]) * rows[:1].nbytes
            out = rows.new_empty(sum(received), rows.shape[1])
            self._together()
            start = time.perf_counter()
            dist.all_to_all_single(out, rows.detach().contiguous(), received, given, group=self.ranks.group)
            self._wait()
            seconds += time.perf_counter() - start
        return {"exchange": seconds, "sent": sent}

    def _together(self) -> None:
        self._wait()
        self.ranks.exchange(None)

    def _wait(self) -> None:
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)

    def _forget(self) -> None:
        for leaf in self.leaves.values():
            leaf.grad = None


# --- the model --------------------------------------------------------------------------------------


def bytes_sent(splats: float, ranks: int) -> float:
    """Of a rank in a step with a camera per rank, each of which sees so many splats (docs/distributed.md)."""
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
    base, rows = results[min(results)]["images_per_second"], []
    for ranks, model in expected.items():
        model_rate = f"{model['images_per_second']:.2f}" if "images_per_second" in model else "-"
        cells = [None] * 6
        if ranks in results:
            r = results[ranks]
            rate, memory = r["images_per_second"], [f"{r[key] / 2**20:.1f}" for key in ("own_bytes", "extra_bytes")]
            cells = [
                f"{rate:.2f}",
                f"{rate / base:.2f}",
                *memory,
                f"{r['sent'] / 1e6:.2f}",
                f"{1e3 * r['exchange']:.2f}",
            ]
        rows.append([ranks, *cells, f"{model['sent'] / 1e6:.2f}", model_rate])
    header = ["ranks", "images/s", "ratio", "Gaussians MiB", "step MiB", "MB sent", "exchange ms"]
    return format_table([*header, "model MB", "model images/s"], rows)


if __name__ == "__main__":
    main()
