"""How cost and memory grow with Gaussians, pixels and threads, on synthetic scenes, on the CPU or with CUDA.

    python benchmarks/scaling.py --out DIR [--json FILE] [--device cuda]
    python benchmarks/scaling.py --device cpu --gaussians 1e4,1e5 --sizes 240x135,960x540 --threads 1,2,4 --out DIR

Two series are measured. "gaussians": every number of `--gaussians` at `--size`. "pixels": every size of `--sizes`, with
`--density` Gaussians per pixel, so that pairs grow with pixels. All splats are round with a standard deviation of 2 px
and an opacity of 0.02, whatever the size of the image: a Gaussian has as many (tile, splat) pairs in every row, and no
pixel is so full that blending stops early (5.9 nats at 3e7 Gaussians in 1920x1080, of 9.2 at which it stops). So the
cost per pair of one row can be compared with that of another.

The table has the number of pairs, the time of each stage per pair, and memory per pair and per pixel. Stages and clocks
are those of `speed.py`; medians of the rounds, one row after another. Memory is with CUDA the peak of torch's allocator
during forward and backward, less inputs, image and gradients; on the CPU the bytes of the tensors that the forward pass
keeps for the backward pass. A row that does not fit into memory says so.

With several numbers of `--threads` the stages of the row of `--count` Gaussians at `--size` are also timed with each of
them, in turn, on the CPU; the other rows take the largest number.

`--out DIR` gets the figures, scaling.png and .svg and threads.png and .svg (they need the extra `analysis`).
"""

from __future__ import annotations

import argparse
import gc
import statistics
import textwrap
from functools import partial
from pathlib import Path

import torch
from common import add_measuring, measure, parse_size, save_json, settle
from speed import STAGES, SpeedCase, time_round

from analytic_rasterizer import io
from analytic_rasterizer.analysis import tables
from analytic_rasterizer.analysis.timing import describe_machine, in_turn
from analytic_rasterizer.gaussians import Gaussians

GAUSSIANS = {"cpu": "1e4,3e4,1e5,3e5", "cuda": "1e5,3e5,1e6,3e6,1e7,3e7"}
SIZES = {"cpu": "240x135,480x270,960x540,1920x1080", "cuda": "240x135,480x270,960x540,1920x1080,3840x2160,7680x4320"}
SIGMA, OPACITY = 2.0, 0.02  # px
FOCAL = 4.0  # of the width: off the axis splats are at most 1.6% wider
DEPTHS = 2.0, 12.0
PARTS = (*STAGES, "backward")
SERIES = ("gaussians", "pixels")
COLORS = dict(zip(PARTS, ("#1c7ed6", "#e08214", "#2b8a3e", "#c2255c")))
MIB = 2**20


def main() -> None:
    args = parse_arguments()
    print(f"{args.footprint}, SH degree {args.sh_degree}, {describe_machine(args.device)}\n")
    rows = [{"series": "gaussians", **measure_row(args, count, args.size)} for count in args.gaussians]
    for width, height in args.sizes:
        count = max(1, round(args.density * width * height))
        rows.append({"series": "pixels", **measure_row(args, count, (width, height))})
    print(format_rows(rows))
    print(f"memory: {memory_name(args.device)}")
    by_threads = {}
    if len(args.threads) > 1:
        by_threads = measure_threads(args)
        print(f"\n{args.count} Gaussians, {args.size[0]}x{args.size[1]}\n{format_threads(by_threads)}")
    save_json(args, {"rows": rows, "threads": by_threads})
    if args.out:
        out = Path(args.out)
        out.mkdir(parents=True, exist_ok=True)
        if any("error" not in row for row in rows):
            figure = plot_rows(rows, describe_machine(args.device), memory_name(args.device))
            tables.save_figure(figure, out, "scaling")
        if by_threads:
            tables.save_figure(plot_threads(by_threads), out, "threads")


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0], conflict_handler="resolve")
    add = parser.add_argument
    add_measuring(parser)
    add("--threads", type=list_of(int), default=[torch.get_num_threads()], metavar="N,...", help="of the CPU")
    add("--gaussians", type=list_of(parse_count), metavar="N,...", help="such as 1e5,1e6")
    add("--sizes", type=list_of(parse_size), metavar="WxH,...")
    add(
        "--size", type=parse_size, default=(1920, 1080), metavar="WxH", help="where Gaussians grow (default: 1920x1080)"
    )
    add("--density", type=float, default=0.5, help="Gaussians per pixel where the size grows (default: %(default)s)")
    add("--count", type=parse_count, default=100_000, help="Gaussians where threads grow (default: %(default)s)")
    add("--footprint", default="box:samples=1")
    add("--sh-degree", type=int, choices=range(4), default=3)
    add("--out", metavar="DIR", help="folder for the figures")
    args = parser.parse_args()
    settle(parser, args)
    args.gaussians = args.gaussians or list_of(parse_count)(GAUSSIANS[args.device])
    args.sizes = args.sizes or list_of(parse_size)(SIZES[args.device])
    if len(args.threads) > 1 and args.device == "cuda":
        parser.error("several numbers of --threads are for --device cpu")
    torch.set_num_threads(max(args.threads))
    return args


def list_of(parse_one):
    """Reads members that are separated by commas."""

    def parse_list(text: str) -> list:
        return [parse_one(member) for member in text.split(",")]

    return parse_list


def parse_count(text: str) -> int:
    """A positive whole number, also as 1e5."""
    value = float(text)
    if not (value >= 1 and value.is_integer()):
        raise argparse.ArgumentTypeError(f"must be a positive whole number, got {text}")
    return int(value)


# ----------------------------------------------------------------------------------------- what is timed


def make_scene(count: int, view: io.View, sh_degree: int, device: str) -> Gaussians:
    """Round Gaussians all over the view, at random depths, each SIGMA px wide there."""
    generator = torch.Generator(device).manual_seed(0)

    def draw(*shape: int) -> torch.Tensor:
        return torch.rand(count, *shape, generator=generator, device=device)

    depths = DEPTHS[0] + (DEPTHS[1] - DEPTHS[0]) * draw(1)
    pixels = draw(2) * torch.tensor([view.width, view.height], device=device)
    from_axis = pixels - torch.tensor([view.width / 2, view.height / 2], device=device)
    return Gaussians.from_activated(
        means=torch.cat([from_axis / view.fx * depths, depths], dim=1),
        scales=(SIGMA / view.fx * depths).expand(count, 3).contiguous(),
        rotations=torch.tensor([1.0, 0.0, 0.0, 0.0], device=device).repeat(count, 1),
        opacities=torch.full((count, 1), OPACITY, device=device),
        shs=draw((sh_degree + 1) ** 2, 3) - 0.5,
    )


def make_case(args: argparse.Namespace, count: int, size: tuple[int, int]) -> SpeedCase:
    view = io.View("synthetic", *size, FOCAL * size[0], FOCAL * size[0], torch.eye(4, dtype=torch.float64))
    return SpeedCase(make_scene(count, view, args.sh_degree, args.device), view, args.footprint)


def measure_row(args: argparse.Namespace, count: int, size: tuple[int, int]) -> dict:
    """Seconds of the stages, pairs and bytes; or what was said where memory did not suffice."""
    row = {"gaussians": count, "width": size[0], "height": size[1]}
    try:
        case = make_case(args, count, size)
        time_this = partial(time_round, device=args.device)
        [[result]] = measure({"row": [case]}, time_this, args.device, args.rounds).values()
        memory = result["extra_bytes"] if args.device == "cuda" else state_bytes(case)
    except (RuntimeError, MemoryError) as error:
        if not is_out_of_memory(error):
            raise
        row["error"] = f"out of memory: {str(error).splitlines()[0]}"
    else:
        row |= {name: result[name] for name in (*PARTS, "forward", "forward_backward")}
        row |= {"pairs": round(result["pairs"]), "memory_bytes": memory}
    case = None
    gc.collect()
    if args.device == "cuda":
        torch.cuda.empty_cache()
    return row


def is_out_of_memory(error: Exception) -> bool:
    """Whether memory did not suffice: of torch's allocators only that of CUDA raises a class of its own."""
    return isinstance(error, (torch.cuda.OutOfMemoryError, MemoryError)) or "can't allocate memory" in str(error)


@torch.no_grad()
def state_bytes(case: SpeedCase) -> int:
    """Bytes of what a forward pass keeps for the backward pass."""
    *_, saved = torch.ops.analytic_rasterizer.rasterize(**case.op_arguments, keep=True)
    return sum(tensor.numel() * tensor.element_size() for tensor in saved)


def memory_name(device: str) -> str:
    return "peak beyond inputs, image and gradients" if device == "cuda" else "kept for the backward pass"


def measure_threads(args: argparse.Namespace) -> dict[int, dict]:
    """Median seconds of the stages by number of threads, timed in turn after a round that warms up."""
    case = make_case(args, args.count, args.size)

    def measure_with(threads: int) -> dict:
        torch.set_num_threads(threads)
        return time_round(case, args.device)

    taken = in_turn({threads: [threads] for threads in args.threads}, measure_with, args.rounds + 1)
    names = (*PARTS, "forward", "forward_backward")
    medians = {
        threads: {name: statistics.median(of_round[name] for of_round in rounds[1:]) for name in names}
        for threads, [rounds] in taken.items()
    }
    torch.set_num_threads(max(args.threads))
    return medians


# ------------------------------------------------------------------------------------------ what is shown


def per_pair(row: dict, name: str) -> float:
    """Nanoseconds or bytes of a row per pair."""
    return row[name] * (1 if name == "memory_bytes" else 1e9) / max(row["pairs"], 1)


def format_rows(rows: list[dict]) -> str:
    header = ["series", "gaussians", "size", "pairs", *(f"{part} ns/pair" for part in PARTS), "f+b ms"]
    header += ["memory MiB", "B/pair", "B/pixel"]
    lines = []
    for row in rows:
        line = [row["series"], row["gaussians"], f"{row['width']}x{row['height']}"]
        if "error" in row:
            lines.append([*line, "out of memory", *[None] * (len(header) - 4)])
            continue
        memory = row["memory_bytes"]
        line += [row["pairs"], *(per_pair(row, part) for part in PARTS), 1e3 * row["forward_backward"]]
        lines.append([*line, memory / MIB, per_pair(row, "memory_bytes"), memory / (row["width"] * row["height"])])
    return tables.format_table(header, lines)


def format_threads(by_threads: dict[int, dict]) -> str:
    """Milliseconds, and how many times as fast as with the first number of threads."""
    base = next(iter(by_threads.values()))
    header = ["threads", *(f"{name} ms" for name in base), *(f"{name} x" for name in ("forward", "forward_backward"))]
    rows = []
    for threads, seconds in by_threads.items():
        ratios = [base[name] / seconds[name] for name in ("forward", "forward_backward")]
        rows.append([threads, *(1e3 * value for value in seconds.values()), *ratios])
    return tables.format_table(header, rows)


def plot_rows(rows: list[dict], machine: str, memory: str):
    """Above: time per pair. Below: memory per pair and per pixel. Left: as Gaussians grow. Right: as pixels do.

    `machine` is the title, `memory` what memory is meant. Of a series of which no row fitted into memory there is no
    column; at least one row must have.
    """
    kept_of = {name: [row for row in rows if row["series"] == name and "error" not in row] for name in SERIES}
    kept_of = {name: kept for name, kept in kept_of.items() if kept}
    figure, axes = tables.new_figure(4 * len(kept_of), 6, len(kept_of), 2, sharex="col", sharey="row")
    for column, (series, kept) in enumerate(kept_of.items()):
        pixels = [row["width"] * row["height"] for row in kept]
        x = pixels if series == "pixels" else [row["gaussians"] for row in kept]
        above, below = axes[:, column]
        for part in PARTS:
            above.plot(x, [per_pair(row, part) for row in kept], "o-", color=COLORS[part], label=part)
        per_pixel = [row["memory_bytes"] / area for row, area in zip(kept, pixels)]
        below.plot(x, per_pixel, "D-", color="#7a7f87", label="per pixel")
        below.plot(x, [per_pair(row, "memory_bytes") for row in kept], "s-", color="#7048e8", label="per pair")
        count, width, height = (kept[-1][key] for key in ("gaussians", "width", "height"))
        density = f"pixels, {count / (width * height):.2g} Gaussians in each"
        below.set_xlabel(density if series == "pixels" else f"Gaussians in {width}x{height}")
    for ax in axes.flat:
        ax.set(xscale="log", yscale="log")
        ax.yaxis.set_major_formatter("{x:g}")
        ax.tick_params("x", which="minor", labelbottom=False)
        for axis in (ax.xaxis, ax.yaxis):
            low, high = axis.get_view_interval()
            if high < 12 * low:  # perhaps without a power of ten
                tables.label_log_axis(axis)
    for [ax, *_], label in zip(axes, ("time per pair [ns]", textwrap.fill(f"memory [bytes]: {memory}", 22))):
        ax.set_ylabel(label)
    for ax in axes[:, -1]:
        ax.legend(frameon=False, fontsize=9, reverse=True)
    figure.suptitle(machine, fontsize=11)
    return figure


def plot_threads(by_threads: dict[int, dict]):
    """How many times as fast each stage becomes, beside the line that would be perfect."""
    figure, axes = tables.new_figure(6.5, 4)
    [[ax]] = axes
    threads = list(by_threads)
    base = by_threads[threads[0]]
    for part in PARTS:
        speedups = [base[part] / by_threads[count][part] for count in threads]
        ax.plot(threads, speedups, "o-", color=COLORS[part], label=part)
    ax.plot(threads, [count / threads[0] for count in threads], "--", color="#495057", label="perfect")
    ax.set_ylabel(f"times as fast as with {threads[0]}")
    tables.add_titles(figure, axes, describe_machine("cpu"), "threads")
    return figure


if __name__ == "__main__":
    main()
