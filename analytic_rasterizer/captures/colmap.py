"""Reads the cameras and points of a COLMAP reconstruction, binary or text.

The layout is that of https://colmap.github.io/format.html. Binary files are little-endian, each a count and then its
records. The three files are read here rather than with pycolmap because that is a large dependency for little.
"""

from __future__ import annotations

import math
import re
import struct
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from .. import io
from ..cameras.rotations import rotation_matrices
from ..io.errors import check_content
from ..io.lenses import lens_of_colmap
from ..io.views import checked_pixels, with_distinct_names


class Model(NamedTuple):
    """A camera model of COLMAP: its number in binary files, its name in texts, and how many parameters it has."""

    number: int
    name: str
    parameters: int


MODELS = (
    Model(0, "SIMPLE_PINHOLE", 3),
    Model(1, "PINHOLE", 4),
    Model(2, "SIMPLE_RADIAL", 4),
    Model(3, "RADIAL", 5),
    Model(4, "OPENCV", 8),
    Model(5, "OPENCV_FISHEYE", 8),
    Model(6, "FULL_OPENCV", 12),
    Model(7, "FOV", 5),
    Model(8, "SIMPLE_RADIAL_FISHEYE", 4),
    Model(9, "RADIAL_FISHEYE", 5),
    Model(10, "THIN_PRISM_FISHEYE", 12),
    Model(11, "RAD_TAN_THIN_PRISM_FISHEYE", 16),
    Model(12, "SIMPLE_DIVISION", 4),
    Model(13, "DIVISION", 5),
    Model(14, "SIMPLE_FISHEYE", 3),
    Model(15, "FISHEYE", 4),
    Model(16, "EUCM", 6),
    Model(17, "EQUIRECTANGULAR", 2),
)
BY_NUMBER = {model.number: model for model in MODELS}
BY_NAME = {model.name: model for model in MODELS}

CAMERAS, IMAGES, POINTS = "cameras", "images", "points3D"
SUFFIXES = (".bin", ".txt")
OBSERVATION = np.dtype([("x", "<f8"), ("y", "<f8"), ("point3D", "<u8")])
POINT = np.dtype(
    [("point3D", "<u8"), ("position", "<f8", 3), ("color", "u1", 3), ("error", "<f8"), ("track", "<u8")]
)  # a track is as long as its number


class Registered(NamedTuple):
    """A picture with its camera."""

    name: str  # of the file, below the folder of the pictures
    view: io.View
    camera: str  # and its model, for messages


def is_reconstruction(folder: Path) -> bool:
    """Whether the folder holds cameras and images, both binary or both text. Points may be missing."""
    return _suffix(folder) is not None


def parts_of(folder: Path) -> list[str]:
    """Names of the files of a reconstruction that are in a folder, complete or not."""
    names = (f"{name}{suffix}" for suffix in SUFFIXES for name in (CAMERAS, IMAGES, POINTS))
    return [name for name in names if (folder / name).is_file()]


def incomplete(folder: Path) -> io.SceneError:
    """The error of a folder that is no reconstruction: what is expected, and what is there."""
    expected = f"COLMAP's {CAMERAS} and {IMAGES}, both {' or both '.join(SUFFIXES)}"
    return io.SceneError.of(folder, expected, ", ".join(parts_of(folder)) or "none of them")


def _suffix(folder: Path) -> str | None:
    complete = (s for s in SUFFIXES if all((folder / f"{name}{s}").is_file() for name in (CAMERAS, IMAGES)))
    return next(complete, None)


def count_pictures(folder: Path) -> int:
    """How many pictures are registered. Raises as `load_views`."""
    return sum(1 for _ in _images(folder))


def load_views(folder: Path) -> list[Registered]:
    """Every registered picture with its camera, sorted by name.

    Views are named after their files, without folder and suffix; where files in several folders have the same name, the
    views of all but the first have _2, _3, ... behind it. What cameras are that no picture was taken by is not looked
    at.

    Raises io.SceneError for a file that is cut short or holds numbers that are not finite, and for cameras of models
    that `io.lenses` does not know, OSError for a missing file.
    """
    cameras = {camera: rest for camera, *rest in _cameras(folder)}
    intrinsics: dict = {}
    found = []
    for file_name, pose, camera, _ in _images(folder):
        if camera not in cameras:
            raise io.SceneError(f"{folder}/images: {file_name} was taken by camera {camera}, which cameras lacks")
        if camera not in intrinsics:
            intrinsics[camera] = _intrinsics(f"{folder}/cameras: camera {camera}", *cameras[camera])
        if not all(map(math.isfinite, pose)) or not any(pose[:4]):
            raise io.SceneError(f"{folder}/images: the pose of {file_name} must be finite, got {pose}")
        w2c = torch.eye(4, dtype=torch.float64, device="cpu")
        w2c[:3, :3] = rotation_matrices(torch.tensor(pose[:4], dtype=torch.float64, device="cpu"))
        w2c[:3, 3] = torch.tensor(pose[4:], dtype=torch.float64, device="cpu")
        view = io.View(name=_view_name(file_name), w2c=w2c, **intrinsics[camera])
        found.append(Registered(file_name, view, f"camera {camera} ({cameras[camera][0]})"))
    found.sort(key=lambda item: item.name)
    views = with_distinct_names([item.view for item in found])
    return [item._replace(view=view) for item, view in zip(found, views)]


def _intrinsics(where: str, model: str, width: int, height: int, parameters: list[float]) -> dict[str, Any]:
    """Members of `View`. Raises io.SceneError, which begins with `where`, the camera."""
    width, height = (checked_pixels(size, f"{where}: {name}") for name, size in (("width", width), ("height", height)))
    pinhole, lens = lens_of_colmap(model, parameters, where)
    return {"width": width, "height": height, "lens": lens, **pinhole}


def _view_name(file_name: str) -> str:
    """The name of a file without folder and suffix, as text that every program can write."""
    return re.sub("[\ud800-\udfff]", "_", Path(file_name.replace("\\", "/")).stem)


def load_points(folder: Path) -> tuple[Tensor, Tensor] | None:
    """Positions (P, 3) float64, world units, and colours (P, 3) float32 in [0, 1]; None where there are no points.

    Raises as `load_views`.
    """
    path, _, points = _points(folder)
    finite = _are_finite(points)
    if not finite.all():
        left_out = f"{int((~finite).sum())} of {len(points)} points are not finite and left out"
        warnings.warn(f"{path}: {left_out}", stacklevel=3)
        points = points[finite]
    return (points[:, :3].contiguous(), points[:, 3:].float() / 255) if len(finite) else None


def load_tracks(folder: Path) -> dict[str, Tensor]:
    """Which points the matching of COLMAP found in which photographs.

    Returns:
        By the names of the views of `load_views`: rows of the points of `load_points`, (O,) int64, each once. None is
        there where the files have no points, or observe none.

    Raises as `load_views`.
    """
    path, identifiers, points = _points(folder)
    identifiers = _whole(path, identifiers)[_are_finite(points).numpy()]
    order = np.argsort(identifiers, kind="stable")
    ascending = identifiers[order]
    observed = {}
    for file_name, _, _, observations in _images(folder):
        observations = observations.split()[2::3] if isinstance(observations, str) else observations
        wanted = np.unique(_whole(f"{folder}/images", observations))
        place = np.searchsorted(ascending, wanted)
        place[place == len(ascending)] = 0
        known = ascending[place] == wanted if len(ascending) else np.zeros(len(wanted), dtype=bool)
        observed[file_name] = torch.from_numpy(order[place[known]].astype(np.int64))
    return {item.view.name: observed[item.name] for item in load_views(folder) if len(observed[item.name])}


def _points(folder: Path) -> tuple[Path | None, Sequence, Tensor]:
    """The file of the points, or None; their P identifiers; and positions and colours, (P, 6) float64."""
    preferred = _suffix(folder) or SUFFIXES[0]
    files = (folder / f"{POINTS}{suffix}" for suffix in sorted(SUFFIXES, key=lambda suffix: suffix != preferred))
    path = next((path for path in files if path.is_file()), None)
    if path is not None and path.suffix == ".bin":
        points = _binary_points(path)
        numbers = np.concatenate([points["position"], points["color"]], axis=1)
        return path, points["point3D"], torch.from_numpy(numbers)
    rows = [] if path is None else [(words[0], *_floats(path, words[1:7])) for words in _lines(path)]
    if any(len(row) != 7 for row in rows):
        raise io.SceneError(f"{path}: cut short")
    numbers = np.array([row[1:] for row in rows], dtype=np.float64).reshape(-1, 6)
    return path, [row[0] for row in rows], torch.from_numpy(numbers)


def _are_finite(points: Tensor) -> Tensor:
    return points.float().isfinite().all(1)


def _cameras(folder: Path) -> Iterator[tuple]:
    """The camera's name in the file, its model's name, width, height, and parameters."""
    path = folder / f"{CAMERAS}{_suffix(folder) or SUFFIXES[0]}"
    return _binary_cameras(path) if path.suffix == ".bin" else _text_cameras(path)


def _images(folder: Path) -> Iterator[tuple]:
    """The picture's name, its pose (a quaternion w, x, y, z and a translation), its camera, and the identifiers of
    the points that it observes, as `_whole` takes them."""
    path = folder / f"{IMAGES}{_suffix(folder) or SUFFIXES[0]}"
    return _binary_images(path) if path.suffix == ".bin" else _text_images(path)


# ------------------------------------------------------------------------------------- binary


def _binary_cameras(path: Path) -> Iterator[tuple]:
    records = _Records(path)
    for _ in range(records.count):
        camera, number, width, height = records.take("iiQQ")
        model = BY_NUMBER.get(number)
        if model is None:  # how long its record is, nobody knows
            raise io.SceneError(f"{path}: camera {camera} has a model that is not known here, number {number}")
        yield camera, model.name, width, height, records.take(f"{model.parameters}d")


def _binary_images(path: Path) -> Iterator[tuple]:
    records = _Records(path)
    for _ in range(records.count):
        _, *pose, camera = records.take("i7di")
        file_name = records.text()
        (count,) = records.take("Q")
        observations = np.frombuffer(records.data, OBSERVATION, count, records.skip(OBSERVATION.itemsize * count))
        yield file_name, pose, camera, observations["point3D"]


def _binary_points(path: Path) -> np.ndarray:
    """All as `POINT`. Files may have millions, so that little is done for each."""
    records = _Records(path)
    data, start, found = records.data, records.position, []
    to_track, size, track_of = POINT.fields["track"][1], POINT.itemsize, struct.Struct("<Q").unpack_from
    try:
        for _ in range(records.count):
            found.append(data[start : start + size])
            start += size + 8 * track_of(data, start + to_track)[0]  # picture, observation in it
    except struct.error:
        start = len(data) + 1
    records.skip(start - records.position)  # raises where the file is cut short
    return np.frombuffer(b"".join(found), POINT)


class _Records:
    """A binary file, read from front to back."""

    def __init__(self, path: Path):
        check_content(path)
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
        return self.data[start:end].decode("utf-8", "surrogateescape")  # a name of a file may be no UTF-8

    def skip(self, size: int) -> int:
        """Passes over `size` bytes and returns where they start."""
        start, self.position = self.position, self.position + size
        if self.position > len(self.data):
            raise io.SceneError(f"{self.path}: cut short")
        return start


# --------------------------------------------------------------------------------------- text


def _text_lines(path: Path) -> list[str]:
    """The lines of a file, which may begin with a byte order mark, and have line ends of any system."""
    check_content(path)
    return path.read_text(encoding="utf-8-sig", errors="surrogateescape").split("\n")


def _is_content(line: str) -> bool:
    """Whether the line is neither empty nor a comment."""
    return bool(line.strip()) and not line.startswith("#")


def _lines(path: Path) -> Iterator[list[str]]:
    """The words of every line that is neither empty nor a comment."""
    return (line.split() for line in _text_lines(path) if _is_content(line))


def _whole(path: Path | str | None, identifiers: Sequence) -> np.ndarray:
    """Identifiers, numbers or words, as uint64. -1, for what is observed and no point, is as in binary files."""
    if isinstance(identifiers, np.ndarray):
        return identifiers
    try:
        return np.array([int(word) % 2**64 for word in identifiers], dtype=np.uint64)
    except ValueError as error:
        raise io.SceneError(f"{path}: {error}") from None


def _floats(path: Path, words: list[str]) -> list[float]:
    try:
        return [float(word) for word in words]
    except ValueError as error:
        raise io.SceneError(f"{path}: {error}") from None


def _text_cameras(path: Path) -> Iterator[tuple]:
    for words in _lines(path):
        camera, model, *numbers = words if len(words) > 1 else (*words, "")
        expected = 2 + BY_NAME[model].parameters if model in BY_NAME else 2
        if len(numbers) < expected:
            raise io.SceneError(f"{path}: cut short")
        if model in BY_NAME and len(numbers) > expected:
            raise io.SceneError(f"{path}: expected {expected} numbers of a {model} camera, got {len(numbers)}")
        for size in numbers[:2]:
            if not size.isdecimal():
                raise io.SceneError(f"{path}: expected width and height in pixels, got {' '.join(numbers[:2])}")
        yield camera, model, int(numbers[0]), int(numbers[1]), _floats(path, numbers[2:])


def _text_images(path: Path) -> Iterator[tuple]:
    lines = _text_lines(path)
    at = 0
    while at < len(lines):
        line = lines[at]
        at += 1
        if not _is_content(line):
            continue
        words = line.split(maxsplit=9)
        if len(words) != 10:
            raise io.SceneError(f"{path}: cut short")
        # The observations of a picture are in a second line, which may be empty, and which some programs leave out.
        observed = ""
        if at < len(lines) and not _is_picture(lines[at]):
            observed = lines[at] if _is_content(lines[at]) else ""
            at += 1
        yield words[9].strip(), _floats(path, words[1:8]), words[8], observed


def _is_picture(line: str) -> bool:
    """Whether a line of images.txt is that of a picture, which ends with a name, and not numbers in threes."""
    words = line.split(maxsplit=10)
    if not _is_content(line) or len(words) < 10:
        return False
    try:
        float(words[9])
    except ValueError:
        return True
    return len(line.split()) % 3 != 0
