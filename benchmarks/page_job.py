"""What the benchmarks of the viewer's page share: a scene in the form that the page has it, and its modules in node."""

from __future__ import annotations

import argparse
import functools
import json
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np


def add_scene(parser: argparse.ArgumentParser) -> None:
    """Adds a scene, its views and their sizes, and what is written."""
    add = parser.add_argument
    add("scene", nargs="?", help=".ply, compressed .ply, .spz, .npz of scene_files.py, or what --prepare wrote")
    add("--views", help="file of views")
    add("--limit-views", type=int, help="use only so many of them")
    add("--sizes", default="512x384,1920x1080", help="of the pictures; the first is compared (default: %(default)s)")
    add("--footprints", nargs="+", metavar="NAME", help="those of the page (default: all that it draws so)")
    add("--rounds", type=int, default=30, help="timed rounds after warming up (default: %(default)s)")
    add("--json", help="also write everything measured to this file")
    add("--prepare", metavar="FILE", help="write all that measuring needs to this .npz, and end")


def check_scene(parser: argparse.ArgumentParser, args: argparse.Namespace) -> None:
    """Ends the program where a scene or its views are missing."""
    if args.scene is None:
        parser.error("a scene is needed")
    if not is_prepared(args.scene) and args.views is None:
        parser.error("--views is needed")


@dataclass(frozen=True)
class Camera:
    """A pinhole of the page: lengths in pixels, `w2c` 16 numbers by rows."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    w2c: list[float]


@dataclass(frozen=True)
class Job:
    """What is to be drawn, in the form that the page has it.

    Attributes:
        meta: Of the scene, `viewer.PackedScene.meta`.
        geometry, harmonics: float32 (P, 12) and float16 (P, numbers), as `viewer.PackedScene` describes them.
        cameras: By size, "WxH", one for each view.
        expected: By footprint, the CPU rasterizer's pictures of all views at the first size, uint8 (views, 3, height,
            width); None where there are none.
        source: The scene and its views, as the library has them; None for a prepared file.
        page: What node has read out of the page.
    """

    meta: dict
    geometry: np.ndarray
    harmonics: np.ndarray
    cameras: dict[str, list[Camera]]
    expected: Callable[[str], np.ndarray | None]
    source: tuple[Any, list] | None = None
    page: dict | None = None

    def __str__(self) -> str:
        return f"{self.meta['name']}: {len(self.geometry)} Gaussians of SH degree {self.meta['sh_degree']}"

    def save(self, path: str, footprints: list[str]) -> None:
        """Writes what `load` reads, with pictures of these footprints."""
        cameras = {size: [vars(camera) for camera in of_size] for size, of_size in self.cameras.items()}
        given = {"meta": self.meta, "cameras": cameras, "page": self.page}
        arrays = {"geometry": self.geometry, "harmonics": self.harmonics}
        pictures = {f"expected {name}": self.expected(name) for name in footprints}
        arrays |= {key: value for key, value in pictures.items() if value is not None}
        with open(path, "wb") as file:
            np.savez_compressed(file, job=np.array(json.dumps(given)), **arrays)

    @staticmethod
    def load(path: str) -> Job:
        with np.load(path) as file:
            given = json.loads(str(file["job"]))
            given["cameras"] = {size: [Camera(**c) for c in of_size] for size, of_size in given["cameras"].items()}
            prefix = "expected "
            expected = {key.removeprefix(prefix): file[key] for key in file if key.startswith(prefix)}
            return Job(**given, geometry=file["geometry"], harmonics=file["harmonics"], expected=expected.get)


def is_prepared(path: str) -> bool:
    if Path(path).suffix != ".npz":
        return False
    with np.load(path) as file:
        return "job" in file


def resized(view: Any, size: str) -> Any:
    """A view as a picture of this size, "WxH"."""
    width, height = map(int, size.split("x"))
    x, y, (cx, cy) = width / view.width, height / view.height, view.middle
    return replace(view, width=width, height=height, fx=x * view.fx, fy=y * view.fy, cx=x * cx, cy=y * cy)


def read_job(args: argparse.Namespace) -> Job:
    """The job of a scene and its views, or that of a prepared file."""
    if is_prepared(args.scene):
        return Job.load(args.scene)
    from scene_files import load_scene

    from analytic_rasterizer import io, render_stages, viewer

    scene, views = load_scene(args.scene), io.load_views(args.views)[: args.limit_views]
    packed, count = viewer.pack_scene(scene, views, name=Path(args.scene).name), len(scene.means)

    def camera(view: io.View) -> Camera:
        lens = {key: getattr(view, key) for key in ("width", "height", "fx", "fy", "cx", "cy")}
        return Camera(**lens, w2c=view.w2c.flatten().tolist())

    sizes = args.sizes.split(",")

    @functools.cache
    def expected(name: str) -> np.ndarray:
        at_size = [resized(view, sizes[0]) for view in views]
        settings = [view.settings(sh_degree=scene.sh_degree, footprint=name) for view in at_size]
        return np.stack([to_bytes(render_stages(of_view, **scene.arguments()).color.numpy()) for of_view in settings])

    return Job(
        packed.meta,
        np.frombuffer(packed.geometry, "<f4").reshape(count, -1),
        np.frombuffer(packed.harmonics, "<f2").reshape(count, -1),
        {size: [camera(resized(view, size)) for view in views] for size in sizes},
        expected,
        (scene, views),
    )


def run_node(script: str, given: dict) -> dict:
    """What a script prints, a module beside those of the page; `given` is given.json there."""
    from analytic_rasterizer.viewer import pages

    with tempfile.TemporaryDirectory() as folder:
        files = {name: pages.page_file(name) for name in pages.MODULES}
        files |= {"package.json": '{"type": "module"}', "given.json": json.dumps(given), "script.js": script}
        for name, text in files.items():
            (Path(folder) / name).write_text(text, encoding="utf-8")
        try:
            done = subprocess.run(["node", "script.js"], cwd=folder, stdout=subprocess.PIPE, text=True, check=True)
        except FileNotFoundError:
            sys.exit("The page is read by node, which is not installed: --help says what can be written elsewhere.")
        except subprocess.CalledProcessError:  # which has said why
            sys.exit("node could not read the page.")
    return json.loads(done.stdout)


def to_bytes(picture: np.ndarray) -> np.ndarray:
    return np.rint(255 * picture.clip(0, 1)).astype(np.uint8)


def difference(ours: np.ndarray, expected: np.ndarray) -> dict[str, float]:
    """Of two pictures of bytes: the largest difference, its 99.99th percentile, and how many values differ."""
    levels = np.abs(ours.astype(np.int16) - expected)
    largest, most = int(levels.max()), float(np.quantile(levels, 0.9999))
    return {"largest": largest, "99.99%": most, "off": int((levels > 0).sum()), "values": levels.size}


def table(header: list[str], rows: list[list]) -> str:
    cells = [header, *([str(cell) for cell in row] for row in rows)]
    widths = [max(len(row[k]) for row in cells) for k in range(len(header))]
    lines = ["| " + " | ".join(cell.ljust(width) for cell, width in zip(row, widths)) + " |" for row in cells]
    return "\n".join([lines[0], "|" + "|".join("-" * (width + 2) for width in widths) + "|", *lines[1:]])
