"""Reads the cameras and points of a COLMAP reconstruction, `sparse/0/*.bin`.

The layout is that of https://colmap.github.io/format.html: little-endian, each file a count and then its records.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from analytic_rasterizer import io
from gaussians import rotate

PINHOLES = {0: 3, 1: 4}  # the parameters of SIMPLE_PINHOLE: f, cx, cy; of PINHOLE: fx, fy, cx, cy


def load_views(folder: Path) -> list[tuple[str, io.View]]:
    """(name of the picture's file, view) of every registered picture, sorted by name.

    Raises io.SceneError for a file that is cut short and for cameras with lens distortion, OSError for a missing file.
    """
    cameras = _read_cameras(_Records(folder / "cameras.bin"))
    records = _Records(folder / "images.bin")
    views = []
    for _ in range(records.count):
        _, *pose, camera = records.take("i7di")
        file_name = records.text()
        (observations,) = records.take("Q")
        records.skip(24 * observations)  # x, y, point
        if camera not in cameras:
            raise io.SceneError(f"{records.path}: {file_name} was taken by camera {camera}, which cameras.bin lacks")
        w2c = torch.eye(4, dtype=torch.float64)
        turn = torch.tensor(pose[:4], dtype=torch.float64)
        w2c[:3, :3] = rotate(turn.expand(3, 4), w2c[:3, :3]).T
        w2c[:3, 3] = torch.tensor(pose[4:], dtype=torch.float64)
        views.append((file_name, io.View(name=Path(file_name).stem, w2c=w2c, **cameras[camera])))
    return sorted(views, key=lambda item: item[0])


def load_points(folder: Path) -> tuple[Tensor, Tensor]:
    """Positions (P, 3) float32, world units, and colours (P, 3) float32 in [0, 1]. Raises as `load_views`."""
    records = _Records(folder / "points3D.bin")
    points = np.empty((records.count, 6))
    for row in points:
        _, *row[:], _, track = records.take("Q3d3BdQ")
        records.skip(8 * track)  # picture, observation in it
    points = torch.from_numpy(points).float()
    return points[:, :3].contiguous(), points[:, 3:] / 255


def _read_cameras(records: _Records) -> dict[int, dict]:
    """The intrinsics of a View by camera."""
    cameras = {}
    for _ in range(records.count):
        camera, model, width, height = records.take("iiQQ")
        if model not in PINHOLES:
            raise io.SceneError(f"{records.path}: cameras must be pinholes; undistort the pictures first")
        *focal, cx, cy = records.take(f"{PINHOLES[model]}d")
        cameras[camera] = {"width": width, "height": height, "fx": focal[0], "fy": focal[-1], "cx": cx, "cy": cy}
    return cameras


class _Records:
    """A binary file, read from front to back."""

    def __init__(self, path: Path):
        self.path, self.data, self.position = path, path.read_bytes(), 0
        (self.count,) = self.take("Q")

    def take(self, layout: str) -> tuple:
        """The next values, by the letters of `struct`."""
        start = self.skip(struct.calcsize("<" + layout))
        return struct.unpack_from("<" + layout, self.data, start)

    def text(self) -> str:
        """The next string, which ends with a zero."""
        start, end = self.position, self.data.find(b"\0", self.position)
        if end < 0:
            raise io.SceneError(f"{self.path}: cut short")
        self.position = end + 1
        return self.data[start:end].decode("utf-8", "replace")

    def skip(self, size: int) -> int:
        """Passes over `size` bytes and returns where they start."""
        start, self.position = self.position, self.position + size
        if self.position > len(self.data):
            raise io.SceneError(f"{self.path}: cut short")
        return start
