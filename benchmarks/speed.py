"""What each footprint costs: time per stage and memory, on any scene and views.

    python benchmarks/speed.py SCENE --views VIEWS [--footprints box:samples=1 analytic ...]

Footprints are timed in turn, round after round, so that a machine that slows down slows them all;
the table gives medians over rounds, averaged over views, and the ratio to the first footprint.
"extra" is the memory that a forward and backward pass needs beyond inputs, image and gradients.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import platform
import statistics
import sys
import time

import torch

import analytic_rasterizer as ar
from analytic_rasterizer import io
from analytic_rasterizer.cli import format_table

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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("scene", help="trained scene: .ply, compressed .ply or .spz")
    parser.add_argument("--views", required=True, help="file of views")
    parser.add_argument("--footprints", nargs="+", default=FOOTPRINTS, metavar="NAME[:k=v]")
    parser.add_argument("--rounds", type=int, default=5, help="timed rounds after one to warm up (default 5)")
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--shuffle", action="store_true", help="randomise the order of the Gaussians")
    parser.add_argument("--json", help="also write everything measured to this file")
    args = parser.parse_args()
    torch.set_num_threads(args.threads)

    scene = io.load_scene(args.scene)
    if args.shuffle:
        order = torch.randperm(len(scene.means), generator=torch.Generator().manual_seed(0))
        scene = scene._replace(**{k: v[order] for k, v in scene._asdict().items() if torch.is_tensor(v)})
    views = io.load_views(args.views)

    samples = {name: [[] for _ in views] for name in args.footprints}
    for round_ in range(args.rounds + 1):
        for name in args.footprints:
            for i, view in enumerate(views):
                measured = measure(scene, view, name)
                if round_ > 0:
                    samples[name][i].append(measured)

    results = {name: summarize(per_view) for name, per_view in samples.items()}
    for name, result in results.items():
        extra, share = zip(*(extra_memory(scene, view, name) for view in views))
        result.update(extra_bytes=statistics.mean(extra), extra_share=max(share))
    base = results[args.footprints[0]]
    header = [
        "footprint",
        "forward s",
        "forward+backward s",
        "ratio",
        "ratio f+b",
        *STAGES,
        "pairs",
        "extra MiB",
        "B/budget",
    ]
    rows = [
        [
            name,
            f"{r['forward']:.3f}",
            f"{r['forward_backward']:.3f}",
            f"{r['forward'] / base['forward']:.2f}",
            f"{r['forward_backward'] / base['forward_backward']:.2f}",
            *(f"{r[s]:.3f}" for s in STAGES),
            f"{r['pairs']:.0f}",
            f"{r['extra_bytes'] / 2**20:.0f}",
            f"{r['extra_share']:.2f}",
        ]
        for name, r in results.items()
    ]
    size = f"{views[0].width}x{views[0].height}"
    print(f"{len(scene.means)} Gaussians, {len(views)} views of {size}, {machine()}")
    print(format_table(header, rows))
    print("B/budget: extra memory over 120 B per Gaussian + 64 B per pair + 64 B per pixel")
    if args.json:
        with open(args.json, "w") as f:
            json.dump({"machine": machine(), "arguments": vars(args), "results": results}, f, indent=2)


def machine() -> str:
    cpu = platform.processor() or platform.machine()
    if sys.platform == "linux":
        with open("/proc/cpuinfo") as f:
            cpu = next((line.split(":")[1].strip() for line in f if line.startswith("model name")), cpu)
    threads = torch.get_num_threads()
    return f"{cpu}, {threads} threads, {ar.instruction_set()}, torch {torch.__version__}"


def measure(scene: io.Scene, view: io.View, footprint: str) -> dict:
    """Seconds of one forward pass without gradient, by stage, and of one with its backward pass."""
    settings = view.settings(sh_degree=scene.sh_degree, footprint=footprint)
    start = time.perf_counter()
    stages = ar.render_stages(settings, **scene.arguments())
    forward = time.perf_counter() - start
    pairs, seconds = len(stages.pairs), stages.seconds
    del stages
    start = time.perf_counter()
    forward_backward(scene, settings)
    return {
        "forward": forward,
        "forward_backward": time.perf_counter() - start,
        "pairs": pairs,
        **seconds,
    }


def forward_backward(scene: io.Scene, settings: ar.GaussianRasterizationSettings) -> list[torch.Tensor]:
    """Renders, differentiates the sum of the image, and returns everything that went in or came out."""
    dL_dcolor = torch.ones(3, settings.image_height, settings.image_width)
    inputs = {k: v.detach().requires_grad_() for k, v in scene.arguments().items()}
    means2d = torch.zeros_like(scene.means, requires_grad=True)
    color, _ = ar.GaussianRasterizer(settings)(means2D=means2d, **inputs)
    color.backward(dL_dcolor)
    return [dL_dcolor, color, means2d, means2d.grad, *(v.grad for v in inputs.values())]


def extra_memory(scene: io.Scene, view: io.View, footprint: str) -> tuple[int, float]:
    """Bytes that forward and backward need beyond what goes in and comes out, and their share of
    120 B per Gaussian + 64 B per pair + 64 B per pixel."""
    settings = view.settings(sh_degree=scene.sh_degree, footprint=footprint)
    pairs = len(ar.render_stages(settings, **scene.arguments()).pairs)
    before = reset_peak_memory()
    results = forward_backward(scene, settings)
    extra = peak_memory() - before - sum(t.numel() * t.element_size() for t in results)
    budget = 120 * len(scene.means) + 64 * pairs + 64 * settings.image_height * settings.image_width
    return extra, extra / budget


def summarize(per_view: list[list[dict]]) -> dict:
    keys = per_view[0][0]
    return {k: statistics.mean(statistics.median(m[k] for m in view) for view in per_view) for k in keys}


def return_freed_memory() -> None:
    """Makes glibc hand freed blocks back to the system, so that peaks can be compared."""
    if sys.platform == "linux":
        libc = ctypes.CDLL(None)
        libc.mallopt(-3, 1 << 16)  # M_MMAP_THRESHOLD: blocks above 64 KiB go back when freed
        libc.malloc_trim(0)


def reset_peak_memory() -> int:
    """Resident memory now, bytes, from which the peak starts again. Linux only; elsewhere 0."""
    return_freed_memory()
    try:
        with open("/proc/self/clear_refs", "w") as f:
            f.write("5")
    except OSError:
        return 0
    return _status("VmRSS")


def peak_memory() -> int:
    """Highest resident memory since the last reset, bytes."""
    return _status("VmHWM")


def _status(key: str) -> int:
    try:
        with open("/proc/self/status") as f:
            return next(1024 * int(line.split()[1]) for line in f if line.startswith(key))
    except OSError:
        return 0


if __name__ == "__main__":
    main()
