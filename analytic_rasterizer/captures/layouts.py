"""The layouts of captures: what each of them says of its photographs.

They are NeRF-synthetic scenes (transforms_train.json), the multi-scale Blender set (metadata.json), COLMAP
reconstructions (folders of binary or text files) and nerfstudio captures (transforms.json).
"""

from __future__ import annotations

import json
import os
import re
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from .. import io
from ..io import BLACK, WHITE, load_points
from ..io.pictures import PICTURE_SUFFIXES, PictureFiles
from ..io.views import checked_pixels, checked_pose, checked_positive, read_views
from . import colmap
from .depth_files import DepthFile, DepthFolder, depth_of_frame

MASKS = "masks"  # COLMAP's folder of them, beside that of the pictures
# Of folders, as Masks or dynamic_masks, and of files, as a_mask.jpg or a.jpg.mask.png.
MASK_FOLDER = re.compile(r"([^a-z]|^)(masks?|segmentations?|mattes?|silhouettes?)([^a-z]|$)", re.IGNORECASE)
MASK_FILE = re.compile(r"([^a-z]|^)masks?([^a-z]|$)", re.IGNORECASE)


class Photograph(NamedTuple):
    """A camera, and the files of its picture.

    Attributes:
        view: The camera, of the size of the whole picture.
        files: By scale, where 2 is half the size. 1 is always there, and makes the scales that are not.
        undistort: Whether `load_pictures` resamples the picture to that of a pinhole.
        mask: The file of its mask, whose black pixels do not count; None: all pixels count.
        alpha_is_mask: Whether transparent pixels do not count; otherwise a background is seen through them.
        depth: Its depth map, there or not; None: the capture has none of it.
    """

    view: io.View
    files: dict[int, Path]
    undistort: bool = False
    mask: Path | None = None
    alpha_is_mask: bool = False
    depth: DepthFile | None = None


class Capture(NamedTuple):
    """What a folder holds.

    Attributes:
        train, test: The photographs.
        background: (r, g, b) in [0, 1], by convention, for pictures with alpha.
        points: Positions and colours in [0, 1], (P, 3) float32 each, on the CPU; None where there are none.
        offset: (x, y, z), world units: positions in the world are those of views and points plus this. None: they are
            the same.
        starts_in_view: Whether random points belong in the views, where there are no others, or in the cube of
            NeRF-synthetic.
        ignored_masks: How many files of masks there are that belong to no convention.
        about_masks: Which of them was found, and what was expected; "" where there are none.
        notes: Sentences of what was chosen, for the user.
        missing: Pictures without a file, or whose file cannot be read, whose photographs were left out.
        missing_masks: The same of masks, whose photographs count everywhere.
        source: The file or folder that the cameras come from; None: unknown.
    """

    train: list[Photograph]
    test: list[Photograph]
    background: tuple[float, float, float]
    points: tuple[Tensor, Tensor] | None
    offset: tuple[float, float, float] | None = None
    starts_in_view: bool = False
    ignored_masks: int = 0
    notes: tuple[str, ...] = ()
    missing: tuple[Path, ...] = ()
    source: Path | None = None
    about_masks: str = ""
    missing_masks: tuple[Path, ...] = ()


def read_layout(folder: Path, place: Path, images: str, test_every: int, with_points: bool = True) -> Capture:
    """The capture whose cameras are in this file or folder."""
    if place.is_dir():
        return reconstruction(folder, place, images, test_every, with_points)
    if not place.is_file():
        raise io.SceneError(f"{place}: no such file or folder of cameras")
    if place.name == "metadata.json":
        train, test = (multi_scale_blender(folder, split) for split in ("train", "test"))
        return Capture(train, test, WHITE, None)
    if place.name == "transforms_train.json":
        test_file = place.with_name("transforms_test.json")
        test = transforms(test_file)[0] if test_file.exists() else []
        train, data = transforms(place)
        return Capture(train, test, WHITE, _points_beside(place, data.get("ply_file_path")) if with_points else None)
    return nerfstudio(place, test_every, with_points)


def reconstruction(folder: Path, sparse: Path, images: str, test_every: int, with_points: bool = True) -> Capture:
    """The capture of a COLMAP reconstruction whose pictures are in a folder `images` of `folder`.

    Raises io.SceneError for what `colmap.load_views` refuses.
    """
    if not colmap.is_reconstruction(sparse):
        raise colmap.incomplete(sparse)
    registered = colmap.load_views(sparse)
    if not registered:
        raise io.SceneError(f"{sparse}: there are no pictures in the reconstruction")
    if not (folder / images).is_dir():
        there = sorted(path.name for path in folder.iterdir() if path.is_dir() and count_pictures(path))
        other = f"--images NAME takes another folder ({', '.join(there) or 'none'} with pictures)"
        raise io.SceneError(f"{folder / images}: no such folder", other)
    files = PictureFiles(folder / images)
    masks, depths = PictureFiles(folder / MASKS), DepthFolder(folder, sparse)
    items = [
        Photograph(view, {1: files.find(name)}, mask=mask_of(masks, name), depth=depths.find(name))
        for name, view, _ in registered
    ]
    points = colmap.load_points(sparse) if with_points else None
    if points is None and with_points:
        points = initial_points(sparse)
    name = registered[0].name
    expected = f"{MASKS}/{name}.png or {MASKS}/{name} for the photograph {name}"
    ignored = _ignored_masks(items, expected, folder, folder / images)
    return Capture(*_split(folder, items, test_every), BLACK, points, starts_in_view=True, **ignored)


def mask_of(masks: PictureFiles, name: str) -> Path | None:
    """The mask of a picture as COLMAP names it, NAME.png, or of the same name; None where there is none."""
    found = (masks.find(candidate) for candidate in (f"{name}.png", name))
    return next((path for path in found if path.is_file()), None)


def transforms(path: Path) -> tuple[list[Photograph], dict[str, Any]]:
    """The views of a transforms file and where their pictures are, in the order of the file; and all that it says.

    Raises io.SceneError for what `io.load_views` refuses, and for lists of cameras, which it reads too.
    """
    views, data = read_views(path)
    if not isinstance(data, dict):
        raise io.SceneError(f"{path}: expected a transforms file, which says where pictures are, got a list of cameras")
    files = PictureFiles(path.parent)
    found = []
    for i, (view, frame) in enumerate(zip(views, data["frames"])):
        mask = frame.get("mask_path")
        if mask is not None and not isinstance(mask, str):
            raise io.SceneError(f"{path}: frame {i}: mask_path must name a picture beside the file, got {mask!s}")
        mask, depth = None if mask is None else files.find(mask), depth_of_frame(frame, files, f"{path}: frame {i}")
        found.append(Photograph(view, {1: files.find(str(frame.get("file_path", "")))}, mask=mask, depth=depth))
    return found, data


def nerfstudio(path: Path, test_every: int, with_points: bool = True) -> Capture:
    """The capture of a transforms.json: its pictures by name, and the points of the file that it names.

    Which pictures to train with and to test with is what its lists train_filenames, val_filenames and test_filenames
    say, if it has any. The test takes the last, or where that is missing the one before. Without the first, the
    training takes the pictures that neither of the others has. Without ply_file_path, points are looked for under their
    usual names.

    Raises io.SceneError for what `transforms` and `load_points` refuse, for lists of anything but pictures of the file,
    and for points that are not there.
    """
    items, data = transforms(path)
    points = _points_beside(path, data.get("ply_file_path")) if with_points else None
    items.sort(key=lambda item: str(item.files[1]))
    ignored = _ignored_masks(items, "mask_path in the frames", path.parent)
    pictures, lists = PictureFiles(path.parent), {}
    files = [os.path.normpath(item.files[1]) for item in items]
    for split in ("train", "val", "test"):
        names = data.get(f"{split}_filenames") or []
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise io.SceneError(f"{path}: {split}_filenames must be a list of names, got {names!r}")
        lists[split] = {os.path.normpath(pictures.find(name)): name for name in names}
        unknown = [name for file, name in lists[split].items() if file not in files]
        if unknown:
            raise io.SceneError(f"{path}: {split}_filenames must name pictures of the frames, got {unknown[0]}")
    if any(lists.values()):
        train = lists["train"] or set(files) - lists["val"].keys() - lists["test"].keys()
        test = lists["test"] or lists["val"]
        splits = [[item for file, item in zip(files, items) if file in names] for names in (train, test)]
    else:
        splits = _split(path.parent, items, test_every)
    return Capture(*splits, BLACK, points, starts_in_view=True, **ignored)


def _points_beside(path: Path, name: Any) -> tuple[Tensor, Tensor] | None:
    """The points of a transforms.json that names their file, or None as that."""
    if name is None:
        return initial_points(path.parent)
    if isinstance(name, str) and (file := path.parent / name.replace("\\", "/")).is_file():
        return load_points(file)
    raise io.SceneError(f"{path}: ply_file_path must name a file beside it, got {name!r}")


def has_splits(path: Path) -> bool:
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


def _split(folder: Path, items: list[Photograph], test_every: int) -> tuple[list[Photograph], list[Photograph]]:
    """Pictures to train with and to test with. Raises io.SceneError where the test leaves fewer than two."""
    if test_every == 0:
        return items, []
    train = [item for i, item in enumerate(items) if i % test_every]
    if len(train) < 2 <= len(items):
        raise io.SceneError(
            f"{folder}: training needs at least 2 pictures, got {len(train)} of {len(items)}, for the others are kept "
            "for the test",
            "--test-every 0 trains with all",
        )
    return train, items[::test_every]


def count_pictures(folder: Path) -> int:
    """Files of pictures in a folder and those below it."""
    return len(_pictures_in(folder))


def _pictures_in(folder: Path) -> list[Path]:
    return [path for path in folder.rglob("*") if _is_picture(path)]


def _is_picture(path: Path) -> bool:
    return path.suffix.lower() in PICTURE_SUFFIXES


def _ignored_masks(items: list[Photograph], expected: str, *folders: Path) -> dict[str, Any]:
    """`ignored_masks` and `about_masks` of a capture: masks that no photograph has, in the fullest folder of masks
    right below one of the folders or of those of the pictures, or else beside the pictures."""
    if any(item.mask for item in items):
        return {}
    pictures = {item.files[1] for item in items}
    folders += tuple(sorted({path.parent for path in pictures}))
    listed = [path for folder in dict.fromkeys(folders) if folder.is_dir() for path in sorted(folder.iterdir())]
    below = [path for path in listed if path not in folders and path.is_dir() and MASK_FOLDER.search(path.name)]
    found = max((sorted(_pictures_in(path)) for path in below), key=len, default=[])
    found = found or [path for path in listed if _is_picture(path) and MASK_FILE.search(path.stem)]
    found = [path for path in found if path not in pictures]
    return {"ignored_masks": len(found), "about_masks": f"found {found[0]}, expected {expected}" if found else ""}
