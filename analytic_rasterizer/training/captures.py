"""Captures: photographs with cameras, and where they come from.

Read are NeRF-synthetic scenes (transforms_train.json), the multi-scale Blender set (metadata.json), COLMAP
reconstructions (sparse/0, sparse or colmap/sparse/0; binary or text) and nerfstudio captures (transforms.json).
"""

from __future__ import annotations

import json
import os
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from .. import io
from ..io import load_points
from ..io.views import checked_pixels, checked_pose, checked_positive
from . import colmap
from .extent import OUTLYING, is_one_pose, outliers_of

BLACK, WHITE = (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)
IMAGES, TEST_PERIOD = "images", 8
RECONSTRUCTIONS = ("sparse/0", "sparse", "colmap/sparse/0")
# What a transforms file may say of the lens; nothing, or zeros, for a pinhole.
DISTORTION = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2", "distortion_params", "is_fisheye")


class Photograph(NamedTuple):
    """A camera, and the files of its picture by scale: 1 is always there, and makes the scales that are not."""

    view: io.View
    files: dict[int, Path]


class Capture(NamedTuple):
    """What a folder holds."""

    train: list[Photograph]
    test: list[Photograph]
    background: tuple[float, float, float]  # by convention, behind pictures with alpha
    points: tuple[Tensor, Tensor] | None  # (P, 3) on the CPU: positions, float32 or float64, and colours in [0, 1]


def load_capture(folder, images: str = IMAGES, test_every: int = TEST_PERIOD) -> Capture:
    """Reads the cameras of a folder, and looks whether all of its pictures are there.

    Args:
        folder: With one of the layouts of this module.
        images: Folder in it of the photographs of a COLMAP reconstruction.
        test_every: Where the capture does not say what is for the test: one in so many pictures, the first by name
            among them; 0 for none.

    Warns of masks in a nerfstudio capture, which are ignored, and of photographs that are left out because their
    cameras are far from all others.

    Raises:
        io.SceneError: No such layout; missing pictures; no pictures to train with; all cameras with one pose; lens
            distortion.
        OSError: A file that cannot be read.
        ValueError: test_every is negative or 1.
    """
    if test_every < 0 or test_every == 1:
        raise ValueError(f"test_every must be 0 or at least 2, got {test_every}")
    folder = Path(folder)
    if not folder.is_dir():
        raise io.SceneError(f"{folder}: no such folder")
    sparse = next((folder / name for name in RECONSTRUCTIONS if colmap.is_reconstruction(folder / name)), None)
    others = sparse is not None or any(
        (folder / name).exists() for name in ("transforms_train.json", "transforms.json")
    )
    if (folder / "metadata.json").exists() and not (others and not _has_splits(folder / "metadata.json")):
        train, test = (multi_scale_blender(folder, split) for split in ("train", "test"))
        capture = Capture(train, test, WHITE, None)
    elif (folder / "transforms_train.json").exists():
        test_file = folder / "transforms_test.json"
        test = transforms(test_file)[0] if test_file.exists() else []
        capture = Capture(transforms(folder / "transforms_train.json")[0], test, WHITE, initial_points(folder))
    elif sparse is not None:
        named = [Photograph(view, {1: folder / images / name}) for name, view in colmap.load_views(sparse)]
        capture = Capture(*_split(named, test_every), BLACK, colmap.load_points(sparse))
    elif (folder / "transforms.json").exists():
        capture = nerfstudio(folder / "transforms.json", test_every)
    else:
        raise io.SceneError(
            f"{folder}: expected transforms_train.json, metadata.json, transforms.json, or COLMAP's cameras, images "
            "and points3D (.bin or .txt) in sparse/0"
        )
    capture = without_outliers(folder, capture)
    check_capture(folder, capture)
    return capture


def check_capture(folder: Path, capture: Capture) -> None:
    """Raises io.SceneError for pictures that are missing, and where there is too little to train with."""
    files = [path for item in (*capture.train, *capture.test) for path in item.files.values()]
    missing = [path for path in files if not path.is_file()]
    if missing:
        raise io.SceneError(f"{folder}: {len(missing)} of {len(files)} pictures are missing, the first is {missing[0]}")
    if len(capture.train) < 2:
        raise io.SceneError(f"{folder}: training needs at least 2 pictures, got {len(capture.train)}")
    if is_one_pose([item.view for item in capture.train]):
        raise io.SceneError(
            f"{folder}: training needs cameras in different directions, or cameras at different places, got all "
            f"{len(capture.train)} at one place in one direction"
        )


def without_outliers(folder: Path, capture: Capture) -> Capture:
    """The capture without photographs whose cameras are far from all others, see `outliers_of`. A warning names each.

    A wrong pose teaches nothing, and would spoil the mean of a test.
    """
    items = [*capture.train, *capture.test]
    points = None if capture.points is None else capture.points[0]
    outliers = outliers_of([item.view for item in items], points)
    for place, distance in outliers.items():
        warnings.warn(
            f"{folder}: {items[place].files[1].name} is left out: its camera is {distance:.3g} from the middle of the "
            f"cameras, more than {OUTLYING} times as far as all others, so that its pose must be wrong",
            stacklevel=3,
        )
    kept = [item for place, item in enumerate(items) if place not in outliers]
    count = sum(place not in outliers for place in range(len(capture.train)))
    return capture._replace(train=kept[:count], test=kept[count:])


def transforms(path: Path) -> tuple[list[Photograph], dict[str, Any]]:
    """The views of a transforms file and where their pictures are, in the order of the file; and all that it says.

    Raises io.SceneError for what `io.load_views` refuses, for lists of cameras, which it reads too, and for lens
    distortion, which it ignores.
    """
    views = io.load_views(path)
    data = json.loads(path.read_text(encoding="utf-8-sig"))
    if not isinstance(data, dict):
        raise io.SceneError(f"{path}: expected a transforms file, which says where pictures are, got a list of cameras")
    found = []
    for i, (view, frame) in enumerate(zip(views, data["frames"])):
        check_lens(data | frame, f"{path}: frame {i}")
        found.append(Photograph(view, {1: _picture(path.parent, str(frame.get("file_path", "")))}))
    return found, data


def _picture(folder: Path, name: str) -> Path:
    """The file that a transforms file names."""
    file = folder / name
    # NeRF-synthetic leaves out the suffix, and its names may hold points.
    return file if file.is_file() else Path(f"{file}.png")


def nerfstudio(path: Path, test_every: int) -> Capture:
    """The capture of a transforms.json: its pictures by name, and the points of the file that it names.

    Which pictures to train with and to test with is what its lists train_filenames, val_filenames and test_filenames
    say, if it has any. The test takes the last, or where that is missing the one before. Without the first, the
    training takes the pictures that neither of the others has. Without ply_file_path, points are looked for under their
    usual names.

    Warns of masks, which are ignored.

    Raises io.SceneError for what `transforms` and `load_points` refuse, for lists of anything but pictures of the file,
    and for points that are not there.
    """
    items, data = transforms(path)
    points_file = data.get("ply_file_path")
    if points_file is None:
        points = initial_points(path.parent)
    elif isinstance(points_file, str) and (path.parent / points_file).is_file():
        points = load_points(path.parent / points_file)
    else:
        raise io.SceneError(f"{path}: ply_file_path must name a file beside it, got {points_file!r}")
    items.sort(key=lambda item: str(item.files[1]))
    masks = sum(frame.get("mask_path") is not None for frame in data["frames"])
    if masks:
        warnings.warn(f"{path}: the masks of {masks} pictures are ignored, all of their pixels count", stacklevel=3)
    files, lists = [os.path.normpath(item.files[1]) for item in items], {}
    for split in ("train", "val", "test"):
        names = data.get(f"{split}_filenames") or []
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise io.SceneError(f"{path}: {split}_filenames must be a list of names, got {names!r}")
        lists[split] = {os.path.normpath(_picture(path.parent, name)): name for name in names}
        unknown = [name for file, name in lists[split].items() if file not in files]
        if unknown:
            raise io.SceneError(f"{path}: {split}_filenames must name pictures of the frames, got {unknown[0]}")
    if not any(lists.values()):
        return Capture(*_split(items, test_every), BLACK, points)
    train = lists["train"] or set(files) - lists["val"].keys() - lists["test"].keys()
    test = lists["test"] or lists["val"]
    chosen = ([item for file, item in zip(files, items) if file in names] for names in (train, test))
    return Capture(*chosen, BLACK, points)


def check_lens(entry: dict, where: str) -> None:
    """Raises io.SceneError for a view of a transforms file whose lens is not that of a pinhole camera."""
    for name in DISTORTION:
        value = entry.get(name)
        if any(value if isinstance(value, list) else [value]):
            got = f"{name} = {value}"
            raise io.SceneError(f"{where}: cameras must be pinholes, got {got}; undistort the pictures first")


def _has_splits(path: Path) -> bool:
    """Whether a metadata.json may be that of the multi-scale Blender set: other programs write files of this name."""
    try:
        return {"train", "test"} <= set(json.loads(path.read_text(encoding="utf-8-sig")))
    except (ValueError, TypeError):
        return False


def multi_scale_blender(folder: Path, split: str) -> list[Photograph]:
    """A split of the multi-scale Blender set: pictures of one camera at several sizes follow each other.

    metadata.json has for each split lists with an entry per picture: file_path, cam2world (OpenGL axes), width,
    height, and focal in px.
    """
    path = folder / "metadata.json"
    try:
        data = json.loads(path.read_text(encoding="utf-8-sig"))[split]
        rows = list(zip(*(data[key] for key in ("file_path", "cam2world", "width", "height", "focal"))))
    except (ValueError, KeyError, TypeError) as error:
        raise io.SceneError(f"{path}: not the metadata of the multi-scale Blender set ({error!r})") from None
    found: list[Photograph] = []
    for name, pose, width, height, focal in rows:
        if not isinstance(name, str):
            raise io.SceneError(f"{path}: file_path must be names of pictures, got {name!r}")
        c2w = checked_pose(pose, f"{path}: cam2world of {name}")
        width, height = (
            checked_pixels(value, f"{path}: {key} of {name}") for key, value in (("width", width), ("height", height))
        )
        focal = checked_positive(focal, f"{path}: focal of {name}")
        c2w[:3, 1:3] *= -1
        w2c = torch.linalg.inv(c2w)
        largest = found[-1].view if found else None
        if largest is not None and largest.width > width and torch.equal(largest.w2c, w2c):
            found[-1].files[round(largest.width / width)] = folder / name
        else:
            view = io.View(Path(name).stem, width, height, focal, focal, w2c)
            found.append(Photograph(view, {1: folder / name}))
    return found


def initial_points(folder: Path) -> tuple[Tensor, Tensor] | None:
    """The points that 3DGS's and nerfstudio's folders may hold beside the cameras."""
    for name in ("points3d.ply", "points3D.ply", "sparse_pc.ply"):
        if (folder / name).is_file():
            return load_points(folder / name)
    return None


def _split(items: list[Photograph], test_every: int) -> tuple[list[Photograph], list[Photograph]]:
    """Pictures to train with and to test with."""
    if test_every == 0:
        return items, []
    return [item for i, item in enumerate(items) if i % test_every], items[::test_every]
