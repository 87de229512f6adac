"""Reads the cameras and points of a COLMAP reconstruction, binary or text.

The layout is that of https://colmap.github.io/format.html. Binary files are little-endian, each a count and then its
records. The three files are read here rather than with pycolmap because that is a large dependency for little.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from .. import io
from ..io.views import with_distinct_names
from ..rotations import rotation_matrices

# Model ids and names, with the number of parameters: f, cx, cy or fx, fy, cx, cy.
PINHOLES = {0: 3, 1: 4, "SIMPLE_PINHOLE": 3, "PINHOLE": 4}
FILES = ("cameras", "images", "points3D")


def is_reconstruction(folder: Path) -> bool:
    """Whether the folder holds the three files, all binary or all text."""
    return any(all((folder / f"{name}{suffix}").is_file() for name in FILES) for suffix in (".bin", ".txt"))


def load_views(folder: Path) -> list[tuple[str, io.View]]:
    """(name of the picture's file, view) of every registered picture, sorted by name.

    Views are named after their files, without folder and suffix; where files in several folders have the same name, the
    views of all but the first have _2, _3, ... behind it.

    Raises io.SceneError for a file that is cut short or holds numbers that are not finite, and for cameras with lens
    distortion, OSError for a missing file.
    """
    if (folder / "images.bin").exists():
        cameras, images = _binary_cameras(folder / "cameras.bin"), _binary_images(folder / "images.bin")
    else:
        cameras, images = _text_cameras(folder / "cameras.txt"), _text_images(folder / "images.txt")
    intrinsics, views = {}, []
    for camera, model, width, height, parameters in cameras:
        if model not in PINHOLES:
            raise io.SceneError(f"{folder}/cameras: cameras must be pinholes; undistort the pictures first")
        *focal, cx, cy = parameters
        if not all(map(math.isfinite, parameters)) or min(focal) <= 0 or width < 1 or height < 1:
            raise io.SceneError(f"{folder}/cameras: camera {camera} must have a positive size and focal length")
        intrinsics[camera] = {"width": width, "height": height, "fx": focal[0], "fy": focal[-1], "cx": cx, "cy": cy}
    for file_name, pose, camera in images:
        if camera not in intrinsics:
            raise io.SceneError(f"{folder}/images: {file_name} was taken by camera {camera}, which cameras lacks")
        if not all(map(math.isfinite, pose)) or not any(pose[:4]):
            raise io.SceneError(f"{folder}/images: the pose of {file_name} must be finite, got {pose}")
        w2c = torch.eye(4, dtype=torch.float64, device="cpu")
        w2c[:3, :3] = rotation_matrices(torch.tensor(pose[:4], dtype=torch.float64, device="cpu"))
        w2c[:3, 3] = torch.tensor(pose[4:], dtype=torch.float64, device="cpu")
        views.append((file_name, io.View(name=Path(file_name).stem, w2c=w2c, **intrinsics[camera])))
    views.sort(key=lambda item: item[0])
    return list(zip([name for name, _ in views], with_distinct_names([view for _, view in views])))


def load_points(folder: Path) -> tuple[Tensor, Tensor]:
    """Positions (P, 3) float32, world units, and colours (P, 3) float32 in [0, 1]. Raises as `load_views`."""
    if (folder / "points3D.bin").exists():
        rows = list(_binary_points(folder / "points3D.bin"))
    else:
        rows = [_floats(folder / "points3D.txt", words[1:7]) for words in _lines(folder / "points3D.txt")]
        if any(len(row) != 6 for row in rows):
            raise io.SceneError(f"{folder / 'points3D.txt'}: cut short")
    points = torch.from_numpy(np.array(rows, dtype=np.float64).reshape(-1, 6)).float()
    if not points.isfinite().all():
        raise io.SceneError(f"{folder}/points3D: points must be finite")
    return points[:, :3].contiguous(), points[:, 3:] / 255


# ------------------------------------------------------------------------------------- binary


def _binary_cameras(path: Path) -> Iterator[tuple]:
    records = _Records(path)
    for _ in range(records.count):
        camera, model, width, height = records.take("iiQQ")
        # The length of an unknown model's record is unknown too; the caller raises before the next one.
        yield camera, model, width, height, records.take(f"{PINHOLES.get(model, 0)}d")


def _binary_images(path: Path) -> Iterator[tuple]:
    records = _Records(path)
    for _ in range(records.count):
        _, *pose, camera = records.take("i7di")
        file_name = records.text()
        (observations,) = records.take("Q")
        records.skip(24 * observations)  # x, y, point
        yield file_name, pose, camera


def _binary_points(path: Path) -> Iterator[list[float]]:
    records = _Records(path)
    for _ in range(records.count):
        _, *row, _, track = records.take("Q3d3BdQ")
        records.skip(8 * track)  # picture, observation in it
        yield row


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


# --------------------------------------------------------------------------------------- text


def _lines(path: Path) -> Iterator[list[str]]:
    """The words of every line that is neither empty nor a comment."""
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        if line.strip() and not line.startswith("#"):
            yield line.split()


def _floats(path: Path, words: list[str]) -> list[float]:
    try:
        return [float(word) for word in words]
    except ValueError as error:
        raise io.SceneError(f"{path}: {error}") from None


def _text_cameras(path: Path) -> Iterator[tuple]:
    for words in _lines(path):
        camera, model, *numbers = words if len(words) > 1 else (*words, "")
        expected = 2 + PINHOLES.get(model, 0)
        if len(numbers) < expected:
            raise io.SceneError(f"{path}: cut short")
        if model in PINHOLES and len(numbers) > expected:
            raise io.SceneError(f"{path}: expected {expected} numbers of a {model} camera, got {len(numbers)}")
        for size in numbers[:2]:
            if not size.isdecimal():
                raise io.SceneError(f"{path}: expected width and height in pixels, got {' '.join(numbers[:2])}")
        yield camera, model, int(numbers[0]), int(numbers[1]), _floats(path, numbers[2:])


def _text_images(path: Path) -> Iterator[tuple]:
    lines = iter(path.read_text(encoding="utf-8", errors="replace").splitlines())
    for line in lines:
        if not line.strip() or line.startswith("#"):
            continue
        next(lines, None)  # every picture has a second line, with its observations, which may be empty
        words = line.split(maxsplit=9)
        if len(words) != 10:
            raise io.SceneError(f"{path}: cut short")
        yield words[9], _floats(path, words[1:8]), words[8]
