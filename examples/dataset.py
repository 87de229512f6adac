"""Photographs with cameras, at several scales, from a NeRF-synthetic scene or a COLMAP capture."""

from __future__ import annotations

import json
import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from PIL import Image
from torch import Tensor
from torch.nn import functional

import analytic_rasterizer as ar
import colmap
from analytic_rasterizer import io

BLACK, WHITE = (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)
TEST_PERIOD = 8  # of a capture every so many pictures are for the test


class Split(NamedTuple):
    """Views and their pictures, all of them on the device. By scale: 2 is half the size."""

    views: list[io.View]  # at scale 1
    settings: dict[int, list[ar.GaussianRasterizationSettings]]  # made once, they hold tensors
    pictures: dict[int, list[Tensor]]  # (3, height, width) uint8

    def truth(self, scale: int, view: int) -> Tensor:
        """(3, height, width) float32 in [0, 1]."""
        return self.pictures[scale][view].float() / 255

    def resolve(self, footprint: str, sh_degree: int) -> dict[int, list[ar.GaussianRasterizationSettings]]:
        """The settings with this footprint and degree."""
        return {
            scale: [s._replace(footprint=footprint, sh_degree=sh_degree) for s in of_scale]
            for scale, of_scale in self.settings.items()
        }


class Dataset(NamedTuple):
    train: Split
    test: Split
    background: tuple[float, float, float]
    extent: float  # radius around the training cameras, world units
    points: tuple[Tensor, Tensor] | None  # positions and colours (P, 3) of a capture, on the CPU


def load(folder: Path, images: str, scales: list[int], device: str) -> Dataset:
    """Reads a folder with transforms_train.json, or one with sparse/0 and the folder `images`.

    Raises io.SceneError or OSError for what is missing or malformed.
    """
    if (folder / "transforms_train.json").exists():
        train, test = ([*transforms(folder / f"transforms_{name}.json")] for name in ("train", "test"))
        background, points = WHITE, None
    elif (folder / "sparse" / "0").exists():
        named = [(folder / images / name, view) for name, view in colmap.load_views(folder / "sparse" / "0")]
        train = [item for i, item in enumerate(named) if i % TEST_PERIOD]
        test = named[::TEST_PERIOD]
        background, points = BLACK, colmap.load_points(folder / "sparse" / "0")
    else:
        raise io.SceneError(f"{folder}: holds neither transforms_train.json nor sparse/0")
    if not (train and test):
        raise io.SceneError(f"{folder}: there must be pictures both to train and to test")
    train, test = (load_split(items, background, scales, device) for items in (train, test))
    return Dataset(train, test, background, extent_of(train.views), points)


def transforms(path: Path) -> list[tuple[Path, io.View]]:
    """The views of a transforms file and where their pictures are."""
    views = io.load_views(path)
    names = (
        path.parent / frame.get("file_path", "") for frame in json.loads(path.read_text(encoding="utf-8"))["frames"]
    )
    return [(name if name.suffix else name.with_suffix(".png"), view) for name, view in zip(names, views)]


def load_split(items: list[tuple[Path, io.View]], background, scales: list[int], device: str) -> Split:
    views, settings, pictures = [], {scale: [] for scale in scales}, {scale: [] for scale in scales}
    with ThreadPoolExecutor() as pool:
        for view, rgba in pool.map(lambda item: load_picture(*item, math.lcm(*scales)), items):
            views.append(view)
            levels = reduce(rgba.to(device), background, scales)
            for scale in scales:
                settings[scale].append(view.settings(1 / scale, background, device=device))
                pictures[scale].append(levels[scale])
    return Split(views, settings, pictures)


def load_picture(path: Path, view: io.View, multiple: int) -> tuple[io.View, Tensor]:
    """The picture, (height, width, 4) uint8 of straight alpha, and its view.

    Both are cut about the centre to multiples of `multiple` px, so that all scales see the same; the principal
    point moves along. Where the picture is not of the size that the view states, the view is scaled.
    """
    with Image.open(path) as image:
        rgba = torch.from_numpy(np.array(image.convert("RGBA")))
    height, width = rgba.shape[:2]
    x, y = width / view.width, height / view.height
    cx = x * (view.width / 2 if view.cx is None else view.cx)
    cy = y * (view.height / 2 if view.cy is None else view.cy)
    left, top = width % multiple // 2, height % multiple // 2
    size = (width - width % multiple, height - height % multiple)
    if not all(size):
        raise io.SceneError(f"{path}: {width} x {height} px are too few for these scales")
    view = replace(view, width=size[0], height=size[1], fx=x * view.fx, fy=y * view.fy, cx=cx - left, cy=cy - top)
    return view, rgba[top : top + size[1], left : left + size[0]]


def reduce(rgba: Tensor, background, scales: list[int]) -> dict[int, Tensor]:
    """The picture at each scale, (3, height, width) uint8.

    As in the multi-scale Blender set the stored straight RGBA values are averaged over squares of pixels and then
    composited.
    """
    full = rgba.permute(2, 0, 1).float() / 255
    behind = full.new_tensor(background)[:, None, None]
    levels = {}
    for scale in scales:
        color, alpha = functional.avg_pool2d(full, scale).split([3, 1])
        levels[scale] = (255 * (color * alpha + behind * (1 - alpha))).round().to(torch.uint8)
    return levels


def extent_of(views: list[io.View]) -> float:
    """The radius around the cameras that 3DGS scales the learning rate of the means by."""
    centers = torch.stack([torch.linalg.inv(view.w2c)[:3, 3] for view in views])
    return 1.1 * (centers - centers.mean(0)).norm(dim=1).max().item()
