"""Trains from photographs of a distorted lens, and of a fisheye, and compares on pictures of pinholes.

    python benchmarks/lens_training.py scene.ply --views cameras.json --out lenses --iterations 7000 --device cuda

The photographs are made of a trained scene, but not with the lenses of the library: the faces of a cube around each
camera are rendered with four times the resolution, and every pixel is the mean of 16 rays, whose directions come from
the textbook's formulas, inverted here. Captures with the same poses and held-out pinholes: pinholes of the same focal
length; OpenCV's lens, rendered with it and undistorted first; and a fisheye. Needs `pip install ".[train]"`.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from scene_files import load_scene
from torch import Tensor

import analytic_rasterizer as ar
from analytic_rasterizer import io, training
from analytic_rasterizer.gaussians import Gaussians
from analytic_rasterizer.io.images import BACKGROUNDS

FINER = 4  # pixels of a face, and rays, along a pixel of the photographs
MARGIN = 1.02  # of a face's half width, for interpolation at its border
TEST_PERIOD = 8
K, P = (-0.25, 0.08), (2e-3, -1.5e-3)  # of OPENCV
FISHEYE = (0.03, -0.01, 0.004, -0.001)
STEPS = 200  # of the inversions


def opencv_rays(a: Tensor, b: Tensor) -> Tensor:
    """Directions (..., 3) that OpenCV's lens shows at (a, b), by fixed-point iteration."""
    x, y = a, b
    for _ in range(STEPS):
        r2 = x * x + y * y
        radial = 1 + r2 * (K[0] + r2 * K[1])
        dx, dy = 2 * P[0] * x * y + P[1] * (r2 + 2 * x * x), P[0] * (r2 + 2 * y * y) + 2 * P[1] * x * y
        x, y = (a - dx) / radial, (b - dy) / radial
    return torch.stack([x, y, torch.ones_like(x)], -1)


def fisheye_rays(a: Tensor, b: Tensor) -> Tensor:
    """Directions (..., 3) that OpenCV's fisheye shows at (a, b), by Newton's method."""
    theta = distance = torch.hypot(a, b)
    powers = [(3 + 2 * k, value) for k, value in enumerate(FISHEYE)]
    for _ in range(STEPS):
        value = theta + sum(k * theta**n for n, k in powers)
        slope = 1 + sum(n * k * theta ** (n - 1) for n, k in powers)
        theta = theta - (value - distance) / slope
    along = theta.sin() / distance.clamp_min(1e-12)
    return torch.stack([a * along, b * along, theta.cos()], -1)


def pinhole_rays(a: Tensor, b: Tensor) -> Tensor:
    return torch.stack([a, b, torch.ones_like(a)], -1)


@lru_cache(maxsize=1)  # most views have the same
def rays_of(
    width: int, height: int, fx: float, fy: float, cx: float, cy: float, inverse: Callable, device: str
) -> Tensor:
    """(FINER * height, FINER * width, 3) directions of the rays of a photograph, float32."""
    y, x = ((torch.arange(FINER * length, dtype=torch.float64, device=device) + 0.5) / FINER
            for length in (height, width))  # fmt: skip
    b, a = torch.meshgrid((y - cy) / fy, (x - cx) / fx, indexing="ij")
    return inverse(a, b).float()


# The camera's axes x, y, z of the faces.
AXES = torch.eye(3, dtype=torch.float64)
FACES = [
    torch.stack([right, torch.linalg.cross(forward, right), forward])
    for right, forward in (
        (AXES[0], AXES[2]),
        (-AXES[2], AXES[0]),
        (AXES[2], -AXES[0]),
        (AXES[0], AXES[1]),
        (AXES[0], -AXES[1]),
        (-AXES[0], -AXES[2]),
    )
]


class Renderer:
    """Makes photographs of a scene."""

    def __init__(self, scene: Gaussians, device: str, footprint: str, background: tuple[float, float, float]):
        self.gaussians = scene.to(device).arguments()
        self.degree, self.device, self.footprint, self.background = scene.sh_degree, device, footprint, background

    @torch.no_grad()
    def photograph(self, view: io.View, inverse: Callable) -> Tensor:
        """(3, height, width) uint8 of a camera at the pose of `view`, whose rays `inverse` gives."""
        intrinsics = view.width, view.height, view.fx, view.fy, *view.middle
        rays = rays_of(*intrinsics, inverse, self.device)
        half = FINER * view.fx  # px of half a face
        side = 2 * round(half * MARGIN)
        picture = rays.new_zeros((3, *rays.shape[:2]))
        for axes in FACES:
            x, y, z = (rays @ axes.T.to(rays)).unbind(-1)
            # Each ray is seen by the face whose axis is nearest.
            here = (z > 0) & (x.abs() <= z) & (y.abs() <= z)
            if not here.any():
                continue
            w2c = view.w2c.clone()
            w2c[:3] = axes @ w2c[:3]
            face = replace(view, width=side, height=side, fx=half, fy=half, cx=None, cy=None, w2c=w2c, lens=None)
            settings = face.settings(1.0, self.background, self.degree, self.footprint, device=self.device)
            image, _ = ar.GaussianRasterizer(settings)(means2D=None, **self.gaussians)
            at = torch.stack([x[here] / z[here], y[here] / z[here]], -1) * (2 * half / side)
            seen = torch.nn.functional.grid_sample(image[None], at[None, None], align_corners=False)[0, :, 0]
            picture[:, here] = seen
        color = torch.nn.functional.avg_pool2d(picture, FINER).clamp(0, 1)
        return (255 * color).round().byte().cpu()


def write_capture(folder: Path, train: list[tuple], test: list[tuple], points: Tensor, colors: Tensor) -> None:
    """A nerfstudio capture of (view, picture, members of the frame)."""
    (folder / "images").mkdir(parents=True, exist_ok=True)
    frames, images, paths = [], [], []
    for view, picture, members in (*train, *test):
        name = f"images/{view.name}.png"
        frames.append(frame_of(view, name) | members)
        images.append(Image.fromarray(picture.permute(1, 2, 0).numpy()))
        paths.append(folder / name)
    with ThreadPoolExecutor() as pool:
        list(pool.map(Image.Image.save, images, paths))  # raises what one of them raises
    names = {f"{split}_filenames": [f"images/{item[0].name}.png" for item in items]
             for split, items in (("train", train), ("test", test))}  # fmt: skip
    (folder / "transforms.json").write_text(json.dumps({"frames": frames, **names}))
    write_points(folder / "sparse_pc.ply", points, colors)


def frame_of(view: io.View, name: str) -> dict:
    """A view and the name of its picture as nerfstudio's transforms.json has them."""
    c2w = torch.linalg.inv(view.w2c)
    c2w[:3, 1:3] *= -1
    cx, cy = view.middle
    size = {"w": view.width, "h": view.height, "fl_x": view.fx, "fl_y": view.fy, "cx": cx, "cy": cy}
    return {"file_path": name, "transform_matrix": c2w.tolist(), **size}


def write_points(path: Path, points: Tensor, colors: Tensor) -> None:
    """Points (P, 3) and their colours (P, 3), 0 to 1."""
    rows = torch.cat([points, (255 * colors).round()], 1).tolist()
    header = ["ply", "format ascii 1.0", f"element vertex {len(rows)}"]
    header += [f"property {kind} {name}" for kind, names in (("float", "xyz"), ("uchar", ("red", "green", "blue")))
               for name in names]  # fmt: skip
    lines = [f"{x:.9g} {y:.9g} {z:.9g} {r:.0f} {g:.0f} {b:.0f}" for x, y, z, r, g, b in rows]
    path.write_text("\n".join([*header, "end_header", *lines, ""]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    add = parser.add_argument
    add("scene", help="trained scene, of which photographs are made")
    add("--views", required=True, help="file of views: poses, and focal length and size of the pinholes")
    add("--out", required=True, type=Path, help="folder for captures and results")
    add("--wide", type=float, help="degrees that pinholes see from side to side (default: as the views)")
    add("--scale", type=float, default=1.0, help="of the views")
    add("--limit-views", type=int, help="use only so many of them")
    add("--points", type=int, default=20000, help="of the scene's Gaussians, to start from (default: %(default)s)")
    add("--iterations", type=int, default=7000)
    add("--footprint", default="moment:samples=4")
    add("--background", choices=BACKGROUNDS, default="black")
    add("--seeds", type=int, nargs="+", default=[0])
    add("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    args = parser.parse_args()
    scene = load_scene(args.scene)
    views = [view.scaled(args.scale) for view in io.load_views(args.views)][: args.limit_views]
    if args.wide:
        focal = [view.width / 2 / np.tan(np.radians(args.wide / 2)) for view in views]
        views = [replace(view, fx=f, fy=f) for view, f in zip(views, focal)]
    renderer = Renderer(scene, args.device, "box:samples=4", BACKGROUNDS[args.background])
    drawn = torch.randperm(scene.count, generator=torch.Generator().manual_seed(0))[: args.points]
    points, colors = scene.means[drawn], (0.5 + 0.2820948 * scene.shs[drawn, 0]).clamp(0, 1)
    lenses = {
        "pinhole": (pinhole_rays, {}),
        "opencv": (opencv_rays, dict(zip(("k1", "k2", "p1", "p2"), (*K, *P))) | {"camera_model": "OPENCV"}),
        "fisheye": (
            fisheye_rays,
            dict(zip(("k1", "k2", "k3", "k4"), FISHEYE)) | {"camera_model": "OPENCV_FISHEYE"},
        ),
    }
    held_out = views[::TEST_PERIOD]
    trained = [view for k, view in enumerate(views) if k % TEST_PERIOD]
    test = [(view, renderer.photograph(view, pinhole_rays), {}) for view in held_out]
    for name, (inverse, members) in lenses.items():
        train = [(view, renderer.photograph(view, inverse), members) for view in trained]
        write_capture(args.out / name, train, test, points, colors)
    results: dict[str, list[float]] = {}
    for name, lens in (("pinhole", "keep"), ("opencv", "keep"), ("opencv", "undistort"), ("fisheye", "keep")):
        for seed in args.seeds:
            options = training.TrainingOptions(
                iterations=args.iterations,
                footprint=args.footprint,
                seed=seed,
                background=args.background,
                effects="none",
            )
            out = args.out / f"{name}_{lens}_{seed}"
            run = training.Run(training.CaptureSource(args.out / name, lens=lens), out, options, device=args.device)
            run.train()
            results.setdefault(f"{name}, {lens}", []).append(run.evaluate()["test"]["mean"]["psnr"])
    print("| photographs | PSNR of held-out pinholes, dB |\n|---|---|")
    for row, values in results.items():
        print(f"| {row} | {' '.join(f'{value:.2f}' for value in values)} |")
    (args.out / "results.json").write_text(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()
