"""Trains on a capture, and on spoiled copies of it with `--effects auto` and without, and tests on clean photographs.

    python benchmarks/capture_effects.py lego bonsai fox --out effects --device cuda
    python benchmarks/capture_effects.py lego --out effects --device cpu --reduce 4 --iterations 50

Every capture is written three times, as nerfstudio's files: clean, masked and spoiled. Of the spoiled copy

- the *training* photographs have uneven exposure (evenly spread over ±`--stops`) and white balance (red against green
  against blue, ±`--balance` percent), of linear light and clipped at white. The mean factor of the stored values is 1,
  since the colours of the scene are those of the mean photograph.
- A share of them (`--blurred`) is blurred, none by default.
- A rectangle of each (`--masked`, a share of its pixels) is painted over with noise, and has a mask.
- One camera is thrown far away.

They are made in this order. The masked copy has the rectangles and the camera alone, and so says what masks hide.

Photographs for the test are the same in all copies: those of the capture, clean, without masks. They would not tell
how good a scene is if their exposure were another one. The table has their PSNR as they are, and after the best affine
map of the colours of each picture, which forgives a scene with another mean exposure; both with ± over seeds.

Pictures with alpha, such as lego's, are on black, as is usual for these files. White behind them would be the same in
every photograph, whatever its exposure, which an affine map of all colours does not bring together with the object.

Photographs must be those of pinholes. Needs `pip install ".[train]"`.
"""

from __future__ import annotations

import argparse
import json
import shutil
import statistics
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from common import has_cuda
from lens_training import frame_of, write_points
from PIL import Image, ImageFilter

from analytic_rasterizer import io
from analytic_rasterizer.analysis.tables import format_table
from analytic_rasterizer.analysis.timing import describe_machine
from analytic_rasterizer.training import (
    Capture,
    CaptureSource,
    Run,
    TrainingOptions,
    evaluate,
    extent_of,
    load_capture,
    load_pictures,
)
from analytic_rasterizer.training.evaluation import COLOR_CORRECTED
from analytic_rasterizer.training.files import write_json

FAR = 1000  # extents, at which the camera is that is thrown far away
COPIES = ("clean", "masked", "spoiled")
GAMMA = 2.2  # of stored values, nearly
BLUR = 2.0  # px, radius


class Row(NamedTuple):
    """A training: on which copy, with which effects and masks."""

    copy: str
    effects: str
    masks: str | None = None


ROWS = {
    "clean": Row("clean", "none"),
    "clean, auto": Row("clean", "auto"),
    "masked, auto": Row("masked", "auto"),
    "spoiled, auto": Row("spoiled", "auto"),
    "spoiled": Row("spoiled", "none"),
    "spoiled, masks ignored": Row("spoiled", "none", "none"),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    add = parser.add_argument
    add("captures", nargs="+", type=Path, help="folders of captures")
    add("--out", required=True, type=Path, help="folder for copies, trainings and results.json")
    add("--footprints", nargs="+", default=[TrainingOptions.footprint])
    add("--seeds", nargs="+", type=int, default=[0], help="of the trainings (that of the copies is 0)")
    add("--rows", nargs="+", choices=list(ROWS), default=list(ROWS))
    add("--iterations", type=int, default=TrainingOptions.preset("quick").iterations)
    add("--stops", type=float, default=0.5, help="exposures are evenly spread over ± this")
    add("--balance", type=float, default=10.0, metavar="PERCENT", help="of red over green, and of green over blue")
    add("--masked", type=float, default=0.1, metavar="SHARE", help="of the pixels of each photograph")
    add("--blurred", type=float, default=0.0, metavar="SHARE", help="of the photographs")
    add("--reduce", type=int, default=1, help="photographs are made so many times smaller")
    add("--device", choices=("cpu", "cuda"), default="cuda" if has_cuda() else "cpu")
    args = parser.parse_args()
    measured: list[dict[str, Any]] = []
    for folder in args.captures:
        write_copies(folder, args.out / folder.name, args)
        for seed in args.seeds:
            for footprint in args.footprints:
                for name in args.rows:
                    common = {"capture": folder.name, "footprint": footprint, "seed": seed, "row": name}
                    values = {"iterations": args.iterations, "footprint": footprint, "seed": seed}
                    out = args.out / folder.name / f"{name.replace(', ', '_').replace(' ', '_')}_{footprint}_{seed}"
                    options = TrainingOptions(**values, effects=ROWS[name].effects)
                    measured.append(common | train(args.out / folder.name, out, ROWS[name], options, args.device))
                    print(measured[-1], flush=True)
                    report = {"machine": describe_machine(args.device), "arguments": vars(args), "runs": measured}
                    write_json(args.out / "results.json", json.loads(json.dumps(report, default=str)))
    print(describe(measured))


def train(copies: Path, out: Path, row: Row, options: TrainingOptions, device: str) -> dict[str, Any]:
    """Trains and tests."""
    shutil.rmtree(out, ignore_errors=True)
    run = Run(CaptureSource(copies / row.copy, masks=row.masks), out, options, device=device, save_every=0)
    run.train()
    test = load_pictures(run.capture.test, (1,), run.capture.background, device)
    found = evaluate(run.trainer.scene(), test, options.footprint, color_corrected=True)["mean"]
    numbers = {name: found[name] for name in ("psnr", COLOR_CORRECTED)}
    return numbers | run.summary() | {"look_s": run.phases["look"], "taken": run.source["taken"]}


def describe(measured: list[dict[str, Any]]) -> str:
    """A row for each capture, footprint and kind of training."""
    rows: dict[tuple, list[dict]] = {}
    for run in measured:
        rows.setdefault((run["capture"], run["footprint"], run["row"]), []).append(run)
    lines = []
    for labels, runs in rows.items():
        taken = " ".join(f"--{name} {value}" for name, value in runs[0]["taken"].items())
        lines.append(
            [
                *labels,
                taken,
                *(_spread([run[name] for run in runs]) for name in ("psnr", COLOR_CORRECTED)),
                f"{statistics.median(run['ms_per_step'] for run in runs):.2f}",
                f"{statistics.median(run['look_s'] for run in runs):.1f}",
                f"{round(statistics.mean(run['gaussians'] for run in runs)):,}",
            ]
        )
    heads = ["capture", "footprint", "training", "takes", "PSNR [dB]", "best affine colour [dB]", "ms per step"]
    return format_table([*heads, "look [s]", "Gaussians"], lines)


def _spread(values: list[float]) -> str:
    return f"{statistics.mean(values):.2f}" + (f" ± {statistics.stdev(values):.2f}" if len(values) > 1 else "")


# ------------------------------------------------------------------------------------ copies


def write_copies(folder: Path, out: Path, args: argparse.Namespace) -> None:
    """Writes the folders of COPIES."""
    capture = load_capture(folder, lens="refuse", masks="none", offset=(0.0, 0.0, 0.0))
    shutil.rmtree(out, ignore_errors=True)
    for name in COPIES:
        write_copy(out / name, capture, args, name)


def write_copy(folder: Path, capture: Capture, args: argparse.Namespace, copy: str) -> None:
    """A copy of COPIES as nerfstudio's files."""
    for name in ("images", "masks"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    random = np.random.default_rng(0)
    count = len(capture.train)
    exposure = evenly(count, args.stops, random)
    balance = evenly(count, float(np.log2(1 + args.balance / 100)), random)
    stops = np.stack([exposure + balance, exposure, exposure - balance], 1)
    stops -= GAMMA * np.log2(np.mean(2 ** (stops / GAMMA), axis=0))
    blurred = random.permutation(count) < round(args.blurred * count)
    frames, names = [], {"train": [], "test": []}
    for split, items in (("train", capture.train), ("test", capture.test)):
        for place, item in enumerate(items):
            with Image.open(item.files[1]) as opened:
                picture = opened.convert("RGBA" if "A" in opened.getbands() else "RGB")
            picture = shrunk(picture, args.reduce)
            view, name = item.view.resized(*picture.size), f"images/{split}_{place:04d}.png"
            frame = frame_of(view, name)
            if copy == "spoiled" and split == "train":
                picture = exposed(picture, stops[place])
                picture = picture.filter(ImageFilter.GaussianBlur(BLUR)) if blurred[place] else picture
            if copy != "clean" and split == "train":
                if args.masked > 0:
                    picture, mask = painted(picture, args.masked, random)
                    frame["mask_path"] = name.replace("images", "masks")
                    mask.save(folder / frame["mask_path"])
                if place == count // 2:
                    points = None if capture.points is None else capture.points[0]
                    frame |= frame_of(thrown(view, extent_of([i.view for i in capture.train], points)), name)
            picture.save(folder / name, compress_level=1)
            frames.append(frame)
            names[split].append(name)
    lists = {f"{split}_filenames": found for split, found in names.items()}
    (folder / "transforms.json").write_text(json.dumps({"frames": frames, **lists}))
    if capture.points is not None:
        write_points(folder / "sparse_pc.ply", *capture.points)


def evenly(count: int, half: float, random: np.random.Generator) -> np.ndarray:
    """(count,) numbers from -half to half at equal distances, in random order."""
    return random.permutation(np.linspace(-half, half, count))


def shrunk(picture: Image.Image, factor: int) -> Image.Image:
    """By means over squares, in which colours count by their alpha."""
    if factor == 1:
        return picture
    if picture.mode == "RGBA":
        return picture.convert("RGBa").reduce(factor).convert("RGBA")
    return picture.reduce(factor)


def exposed(picture: Image.Image, stops: np.ndarray) -> Image.Image:
    """With so many stops (3,) more of red, green and blue light."""
    levels = np.array(picture)
    stored = np.arange(256) / 255
    light = np.where(stored <= 0.04045, stored / 12.92, ((stored + 0.055) / 1.055) ** 2.4)
    for channel, stop in enumerate(stops):
        more = np.clip(light * 2**stop, 0, 1)
        after = np.where(more <= 0.0031308, 12.92 * more, 1.055 * np.maximum(more, 1e-9) ** (1 / 2.4) - 0.055)
        levels[:, :, channel] = np.round(255 * after).astype(np.uint8)[levels[:, :, channel]]
    return Image.fromarray(levels)


def painted(picture: Image.Image, share: float, random: np.random.Generator) -> tuple[Image.Image, Image.Image]:
    """With noise in a rectangle of this share of the pixels; and the mask, which is black there."""
    levels = np.array(picture)
    mask = np.full(levels.shape[:2], 255, np.uint8)
    height, width = (max(round(share**0.5 * size), 1) for size in mask.shape)
    top, left = (random.integers(size - part + 1) for size, part in zip(mask.shape, (height, width)))
    window = slice(top, top + height), slice(left, left + width)
    levels[window] = 255  # opaque
    levels[(*window, slice(3))] = random.integers(256, size=(height, width, 3))
    mask[window] = 0
    return Image.fromarray(levels), Image.fromarray(mask)


def thrown(view: io.View, extent: float) -> io.View:
    """The camera FAR extents away from where it was."""
    w2c = view.w2c.clone()
    w2c[2, 3] += FAR * extent
    return replace(view, w2c=w2c)


if __name__ == "__main__":
    main()
