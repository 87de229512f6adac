"""Trains on large photographs that are on the GPU, in memory, or in their files, and says what each place costs.

    python benchmarks/large_capture.py --count 300 --size 4000x3000 --device cuda

The photographs are JPEGs of a textured wall, from cameras that move along it; points on the wall are what the training
starts from. Each place has a process of its own, so that its peak of memory is its own. The bits of the trained
Gaussians have to be the same. Needs `pip install ".[train]"`.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import resource
import subprocess
import sys
import tempfile
import threading
import time
import weakref
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import torch
from common import add_measuring, parse, parse_size
from PIL import Image

from analytic_rasterizer import training
from analytic_rasterizer.analysis.timing import describe_machine
from analytic_rasterizer.captures.store import DEVICE, FILE, HOST, Made, Store

PLENTY = 1e6  # GiB
WALL = 4.0  # from the cameras, whose focal length is the width of a picture
OCTAVES, NOISE = (400, 60, 9), 6.0  # px of the patches of the texture, and levels of the sensor's noise
WARM_UP = 20  # steps
QUALITY = 90  # of the JPEGs


def make_capture(folder: Path, count: int, size: tuple[int, int], points: int) -> None:
    """A nerfstudio capture: photographs are cut out of one texture, half as wide and as high again as they are."""
    (folder / "images").mkdir(parents=True)
    rng = np.random.default_rng(0)
    width, height = size
    wide, high = 3 * width // 2, 3 * height // 2
    wall = rng.normal(0, NOISE, (high, wide, 1)).astype(np.float32)
    for patch in OCTAVES:
        coarse = rng.integers(0, 256, (high // patch + 2, wide // patch + 2, 3), np.uint8)
        wall = wall + np.asarray(Image.fromarray(coarse).resize((wide, high), Image.BICUBIC), np.float32) / len(OCTAVES)
    wall = wall.clip(0, 255).astype(np.uint8)
    corners = [(int(rng.integers(0, wide - width + 1)), int(rng.integers(0, high - height + 1))) for _ in range(count)]
    unit = WALL / width  # of the world, along a pixel

    def photograph(i: int) -> dict:
        left, top = corners[i]
        name = f"images/{i:04}.jpg"
        Image.fromarray(wall[top : top + height, left : left + width]).save(folder / name, quality=QUALITY)
        pose = np.diag([1.0, -1.0, -1.0, 1.0])
        pose[:2, 3] = (left + width / 2) * unit, (top + height / 2) * unit
        return {"file_path": name, "transform_matrix": pose.tolist()}

    with ThreadPoolExecutor() as pool:
        frames = [*pool.map(photograph, range(count))]
    camera = {"w": width, "h": height, "fl_x": width, "fl_y": width, "cx": width / 2, "cy": height / 2}
    (folder / "transforms.json").write_text(json.dumps({**camera, "ply_file_path": "points.ply", "frames": frames}))
    x, y = rng.integers(0, wide, points), rng.integers(0, high, points)
    rows = np.zeros(points, [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1")])
    rows["x"], rows["y"], rows["z"] = (x + 0.5) * unit, (y + 0.5) * unit, WALL
    for channel, color in enumerate(("red", "green", "blue")):
        rows[color] = wall[y, x, channel]
    kinds = {"<f4": "float", "|u1": "uchar"}
    properties = [f"property {kinds[rows.dtype[name].str]} {name}" for name in rows.dtype.names]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {points}", *properties, "end_header", ""]
    (folder / "points.ply").write_bytes("\n".join(header).encode() + rows.tobytes())


class Counted:
    """Counts the bytes of pictures on the device that a store keeps or has fetched, as long as they live."""

    def __init__(self, store: Store):
        self.lock, self.now, self.peak = threading.RLock(), 0, 0
        for key, made in store.kept.items():
            if store.plan.places[key] == DEVICE:
                self.add(made)
        fetch = store._fetch

        def fetched(key):
            made, event = fetch(key)
            self.add(made)
            return made, event

        store._fetch = fetched

    def add(self, made: Made) -> None:
        for tensor in made:
            if tensor is not None:
                self.change(tensor.nbytes)
                weakref.finalize(tensor, self.change, -tensor.nbytes)

    def change(self, size: int) -> None:
        with self.lock:
            self.now += size
            self.peak = max(self.peak, self.now)


def train(folder: Path, place: str, args: argparse.Namespace) -> dict:
    """What a training costs whose pictures are in a place."""
    on_cuda = args.device == "cuda"
    # On a CPU the device's memory is the host's.
    limits = {
        DEVICE: (PLENTY if on_cuda else None, PLENTY),
        HOST: (args.gpu, PLENTY),
        FILE: (args.gpu if on_cuda else None, 0.0),
    }
    memory = training.PictureMemory(*limits[place])
    options = training.TrainingOptions(
        iterations=WARM_UP + args.steps, scales=args.scales, footprint=args.footprint, density="none"
    )
    began = time.perf_counter()
    with tempfile.TemporaryDirectory() as out:
        source = training.CaptureSource(folder, test_every=0)
        run = training.Run(source, out, options, device=args.device, memory=memory, save_every=0)
        loaded = time.perf_counter() - began
        pictures, trainer = run.trainer.pictures, run.trainer
        counted, seconds, slowest, losses = Counted(pictures.store), 0.0, 0.0, []
        trainer.warm_up()
        for step in range(WARM_UP + args.steps):
            if step == WARM_UP:
                synchronize(args.device)
                began = time.perf_counter()
            before = time.perf_counter()
            trainer.step()
            if step >= WARM_UP:
                slowest = max(slowest, time.perf_counter() - before)
        synchronize(args.device)
        seconds = time.perf_counter() - began
        pictures.close()
        losses = trainer.take_losses()
    digest = hashlib.sha256(b"".join(field.detach().cpu().numpy().tobytes() for field in trainer.gaussians))
    return {
        "place": place,
        "load_s": loaded,
        "ms_per_step": 1e3 * seconds / args.steps,
        "slowest_ms": 1e3 * slowest,
        "peak_rss_gib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
        "pictures_gib": counted.peak / 2**30,
        "allocated_gib": torch.cuda.max_memory_allocated() / 2**30 if on_cuda else None,
        "reserved_gib": torch.cuda.max_memory_reserved() / 2**30 if on_cuda else None,
        "loss": sum(losses[-100:]) / len(losses[-100:]),
        "bits": digest.hexdigest()[:16],
        "ahead": pictures.store.plan.ahead,
        "threads": pictures.store.plan.threads,
    }


def synchronize(device: str) -> None:
    if device == "cuda":
        torch.cuda.synchronize()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    add = parser.add_argument
    add("--count", type=int, default=12, help="photographs (default: %(default)s)")
    add("--size", type=parse_size, default="320x240", help="px (default: %(default)s)")
    add("--scales", default="1", help="(default: %(default)s)")
    add("--steps", type=int, default=40, help="timed, after 20 others (default: %(default)s)")
    add("--points", type=int, default=2000, help="to start from; so many stay (default: %(default)s)")
    add("--footprint", default=training.TrainingOptions.footprint)
    add("--gpu", type=float, default=2.0, help="GiB for pictures that are not all on the GPU (default: %(default)s)")
    add("--places", nargs="+", choices=(DEVICE, HOST, FILE), help="(default: all; on a CPU without host)")
    add("--folder", type=Path, help="keep the photographs here, and take those that are there (default: a new one)")
    add("--one", choices=(DEVICE, HOST, FILE), help=argparse.SUPPRESS)
    add_measuring(parser)
    args = parse(parser)
    args.scales = tuple(int(scale) for scale in str(args.scales).split(","))
    if args.one:
        print(json.dumps(train(args.folder, args.one, args)))
        return 0
    with tempfile.TemporaryDirectory() as temporary:
        folder = args.folder or Path(temporary) / "capture"
        began = time.perf_counter()
        if not (folder / "transforms.json").exists():
            make_capture(folder, args.count, args.size, args.points)
        files = [path.stat().st_size for path in (folder / "images").iterdir()]
        made = f"{len(files)} photographs, {sum(files) / len(files) / 1e6:.2f} MB each"
        print(f"{made}, made in {time.perf_counter() - began:.1f} s; {describe_machine(args.device)}", flush=True)
        columns = ("place", "load, s", "ms per step", "to the first", "slowest, ms", "peak RSS, GiB", "pictures, GiB")
        print(f"| {' | '.join(columns)} |\n|{'---|' * len(columns)}")
        report = []
        for place in args.places or ((DEVICE, HOST, FILE) if args.device == "cuda" else (DEVICE, FILE)):
            command = [sys.executable, __file__, *sys.argv[1:], "--folder", str(folder), "--one", place]
            done = subprocess.run(command, stdout=subprocess.PIPE, text=True)
            if done.returncode:
                return done.returncode
            report.append(json.loads(done.stdout.splitlines()[-1]))
            print(format_row(report[-1], report[0]), flush=True)
        same = len({of_place["bits"] for of_place in report}) == 1
        print(f"the trained Gaussians have {'the same' if same else 'OTHER'} bits")
        if args.json:
            result = {"machine": describe_machine(args.device), "places": report}
            Path(args.json).write_text(json.dumps(result, indent=1))
    return 0 if same else 1


def format_row(row: dict, first: dict) -> str:
    numbers = [f"{row['load_s']:.1f}", f"{row['ms_per_step']:.2f}", f"{row['ms_per_step'] / first['ms_per_step']:.3f}"]
    numbers += [f"{row[key]:.2f}" for key in ("slowest_ms", "peak_rss_gib", "pictures_gib")]
    return f"| {row['place']} | {' | '.join(numbers)} |"


if __name__ == "__main__":
    sys.exit(main())
