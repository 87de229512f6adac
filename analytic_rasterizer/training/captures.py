"""Captures: photographs with cameras, and where they come from.

Read are NeRF-synthetic scenes (transforms_train.json), the multi-scale Blender set (metadata.json), COLMAP
reconstructions (sparse/0, sparse or colmap/sparse/0; binary or text) and nerfstudio captures (transforms.json). Cameras
are pinholes, or have a lens of `lenses`.
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
from ..io.pictures import PICTURE_SUFFIXES, PictureFiles
from ..io.views import checked_pixels, checked_pose, checked_positive, distortion_of, read_views
from . import colmap
from .lenses import RATIONAL, Lens, lens_of, window_of
from .placement import offset_of

BLACK, WHITE = (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)
IMAGES, TEST_PERIOD = "images", 8
RECONSTRUCTIONS = ("sparse/0", "sparse", "colmap/sparse/0")
LENS_CHOICES = ("undistort", "refuse")
MASK_FOLDERS = ("masks", "mask")
SEARCH_DEPTH = 3  # folders below SCENE where an error looks for reconstructions


class Photograph(NamedTuple):
    """A camera, and the files of its picture by scale: 1 is always there, and makes the scales that are not."""

    view: io.View  # without the lens, and of the size of the whole picture
    files: dict[int, Path]
    lens: Lens | None = None  # which `load_pictures` removes from the picture


class Capture(NamedTuple):
    """What a folder holds."""

    train: list[Photograph]
    test: list[Photograph]
    background: tuple[float, float, float]  # by convention, behind pictures with alpha
    points: tuple[Tensor, Tensor] | None  # positions and colours in [0, 1], (P, 3) float32 each, on the CPU
    # (x, y, z), world units: positions in the world are those of views and points plus this. None: they are the same.
    offset: tuple[float, float, float] | None = None
    # Where random points belong if there are no others: in the views, or in the cube of NeRF-synthetic.
    starts_in_view: bool = False
    masks: int = 0  # of pictures, which are ignored
    notes: tuple[str, ...] = ()  # sentences of what was chosen, for the user


def load_capture(
    folder,
    images: str = IMAGES,
    test_every: int = TEST_PERIOD,
    *,
    cameras: str | None = None,
    lens: str = "undistort",
    offset: tuple[float, float, float] | None = None,
) -> Capture:
    """Reads the cameras of a folder, and looks whether all of its pictures are there.

    Of several reconstructions in `sparse` the one with the most pictures is read. Where a transforms.json is beside a
    reconstruction, the one without lens distortion is read, or else the reconstruction; one that cannot be used is
    passed over. `Capture.notes` say what was chosen.

    Args:
        folder: With one of the layouts of this module.
        images: Folder in it of the photographs of a COLMAP reconstruction.
        test_every: Where the capture does not say what is for the test: one in so many pictures, the first by name
            among them; 0 for none.
        cameras: The file or folder in `folder` to read the cameras from, such as "transforms.json" or "sparse/1"; None:
            chosen as above.
        lens: "undistort": photographs of cameras with lens distortion are resampled to pinholes; "refuse": they are an
            error.
        offset: What to take off all positions, so that they are those of a scene with this offset. None: what
            `offset_of` finds, which is nothing unless coordinates are far from zero.

    Warns of masks, which are ignored.

    Raises:
        io.SceneError: No such layout; missing pictures; no pictures to train with; all cameras at one place; a lens
            that cannot be undistorted.
        OSError: A file that cannot be read.
        ValueError: test_every is negative or 1; no such `lens`.
    """
    if test_every < 0 or test_every == 1:
        raise ValueError(f"test_every must be 0 or at least 2, got {test_every}")
    if lens not in LENS_CHOICES:
        raise ValueError(f"lens must be one of {', '.join(LENS_CHOICES)}, got {lens}")
    folder = Path(folder)
    if not folder.is_dir():
        raise io.SceneError(f"{folder}: no such folder")
    capture = read_cameras(folder, images, test_every, cameras)
    check_capture(folder, capture)
    if capture.masks:
        warnings.warn(
            f"{folder}: the masks of {capture.masks} pictures are ignored, all of their pixels count", stacklevel=2
        )
    photographs = [*capture.train, *capture.test]
    distorted = [item for item in photographs if item.lens is not None]
    if distorted and lens == "refuse":
        raise io.SceneError(
            f"{folder}: {len(distorted)} of {len(photographs)} photographs have lens distortion, the first is "
            f"{distorted[0].files[1]} ({distorted[0].lens.model}): leave out --lens refuse, or undistort them first"
        )
    notes = list(capture.notes)
    if distorted:
        notes.append(_about_lenses(distorted, len(photographs)))
    if offset is None:
        positions = None if capture.points is None else capture.points[0]
        offset = offset_of([item.view for item in photographs], positions)
        if offset is not None:
            where = ", ".join(f"{number:.15g}" for number in offset)
            notes.append(f"coordinates are far from zero: positions are stored relative to ({where})")
    return _relative_to(capture, offset)._replace(notes=tuple(notes))


def read_cameras(folder: Path, images: str, test_every: int, cameras: str | None) -> Capture:
    """The capture in world coordinates, as far as files of cameras and points say. Arguments as `load_capture`."""
    if cameras is not None:
        return _read(folder, folder / cameras, images, test_every)
    places = _places(folder)
    if not places:
        raise io.SceneError(
            f"{folder}: expected transforms_train.json, metadata.json, transforms.json, or COLMAP's cameras and images "
            f"(.bin or .txt) in sparse/0{_elsewhere(folder)}"
        )
    if len(places) == 1:
        capture, others = _read(folder, places[0], images, test_every), []
        chosen = places[0]
    else:
        found, errors = {}, {}
        for place in places:
            try:
                found[place] = _read(folder, place, images, test_every)
                check_capture(folder, found[place])
            except io.SceneError as error:
                found.pop(place, None)
                errors[place] = error
        if not found:
            raise errors[places[0]]
        plain = (place for place, read in found.items() if all(item.lens is None for item in (*read.train, *read.test)))
        chosen = next(plain, next(iter(found)))
        capture, others = found[chosen], [place for place in places if place != chosen]
    models = [model for model in _models_beside(chosen) if model != chosen] if chosen.is_dir() else []
    names = [str(place.relative_to(folder)) for place in (*others, *models)]
    if not names:
        return capture
    return capture._replace(
        notes=(f"cameras are those of {chosen.relative_to(folder)}; --cameras takes {' or '.join(names)} instead",)
    )


def _places(folder: Path) -> list[Path]:
    """The files and folders that cameras can be read from: one, or a reconstruction and a transforms.json."""
    sparse = next((folder / name for name in RECONSTRUCTIONS if colmap.is_reconstruction(folder / name)), None)
    if sparse is None:  # without a model 0 there may be others
        parents = [(folder / name).parent for name in RECONSTRUCTIONS if "/" in name]
        sparse = next((models[0] for models in map(_models_in, parents) if models), None)
    if sparse is not None:
        sparse = max(_models_beside(sparse), key=colmap.count_pictures)
    several = [place for place in (sparse, folder / "transforms.json") if place is not None and place.exists()]
    synthetic, metadata = folder / "transforms_train.json", folder / "metadata.json"
    others = several or synthetic.exists()
    if metadata.exists() and not (others and not _has_splits(metadata)):
        return [metadata]
    return [synthetic] if synthetic.exists() else several


def _models_beside(model: Path) -> list[Path]:
    """The reconstructions of COLMAP's mapper, which writes one for each part that it could not join: 0, 1, 2, .."""
    return _models_in(model.parent) if model.name.isdecimal() else [model]


def _models_in(folder: Path) -> list[Path]:
    numbered = [path for path in folder.iterdir() if path.name.isdecimal()] if folder.is_dir() else []
    return sorted(filter(colmap.is_reconstruction, numbered), key=lambda path: int(path.name))


def _elsewhere(folder: Path) -> str:
    """How an error that finds nothing in a folder goes on: with the reconstructions in the folders below."""
    below = [folder / "/".join("*" * depth) for depth in range(1, SEARCH_DEPTH + 1)]
    found = [
        path.relative_to(folder)
        for pattern in below
        for path in sorted(folder.glob(str(pattern.relative_to(folder))))
        if path.is_dir() and colmap.is_reconstruction(path)
    ]
    return f"; there is a reconstruction in {found[0]} (--cameras {found[0]}, --images FOLDER)" if found else ""


def _read(folder: Path, place: Path, images: str, test_every: int) -> Capture:
    """The capture whose cameras are in this file or folder."""
    if place.is_dir():
        return reconstruction(folder, place, images, test_every)
    if not place.is_file():
        raise io.SceneError(f"{place}: no such file or folder of cameras")
    if place.name == "metadata.json":
        train, test = (multi_scale_blender(folder, split) for split in ("train", "test"))
        return Capture(train, test, WHITE, None)
    if place.name == "transforms_train.json":
        test_file = place.with_name("transforms_test.json")
        test = transforms(test_file)[0] if test_file.exists() else []
        return Capture(transforms(place)[0], test, WHITE, initial_points(folder))
    return nerfstudio(place, test_every)


def reconstruction(folder: Path, sparse: Path, images: str, test_every: int) -> Capture:
    """The capture of a COLMAP reconstruction whose pictures are in a folder `images` of `folder`.

    Raises io.SceneError for what `colmap.load_views` refuses, and for lenses that cannot be undistorted.
    """
    if not colmap.is_reconstruction(sparse):
        raise io.SceneError(f"{sparse}: expected COLMAP's cameras and images (.bin or .txt)")
    registered = colmap.load_views(sparse)
    if not registered:
        raise io.SceneError(f"{sparse}: there are no pictures in the reconstruction")
    if not (folder / images).is_dir():
        there = sorted(path.name for path in folder.iterdir() if path.is_dir() and _count_pictures(path))
        expected = f"--images NAME takes another folder ({', '.join(there) or 'none'} with pictures)"
        raise io.SceneError(f"{folder / images}: no such folder; {expected}")
    files = PictureFiles(folder / images)
    items = []
    for item in registered:
        _check_lens(item.lens, item.view, f"{sparse}/cameras: {item.camera}")
        items.append(Photograph(item.view, {1: files.find(item.name)}, item.lens))
    points = colmap.load_points(sparse)
    masks = _count_masks(folder)
    return Capture(
        *_split(folder, items, test_every),
        BLACK,
        initial_points(sparse) if points is None else points,
        starts_in_view=True,
        masks=masks,
    )


def _check_lens(lens: Lens | None, view: io.View, where: str) -> None:
    """Raises io.SceneError, which begins with `where`, for a lens that cannot be undistorted."""
    if lens is None:
        return
    try:
        window_of(lens, view)
    except io.SceneError as error:
        raise io.SceneError(f"{where}: {error}; undistort the pictures first, with another model") from None


def _about_lenses(distorted: list[Photograph], number: int) -> str:
    """What is done with photographs that have a lens, in a sentence."""
    lost = [1 - window_of(item.lens, item.view).kept for item in distorted]
    low, high = (f"{100 * share:.1f}" for share in (min(lost), max(lost)))
    models = ", ".join(sorted({item.lens.model for item in distorted}))
    return (
        f"{len(distorted)} of {number} photographs ({models}) are resampled to pinholes, for tests too, and lose "
        f"{low if low == high else f'{low} to {high}'}% of their area at the border (--lens undistort)"
    )


def _relative_to(capture: Capture, offset: tuple[float, float, float] | None) -> Capture:
    """The capture with positions relative to an offset, those of points in float32."""
    offset = offset if offset is not None and any(offset) else None
    points = capture.points
    if points is not None:
        positions = points[0] if offset is None else points[0].double() - torch.tensor(offset, dtype=torch.float64)
        points = positions.float(), points[1]
    train, test = (
        [item._replace(view=item.view.in_frame(offset)) for item in items] for items in (capture.train, capture.test)
    )
    return capture._replace(train=train, test=test, points=points, offset=offset)


def _count_pictures(folder: Path) -> int:
    """Files of pictures in a folder and those below it."""
    return sum(path.suffix.lower() in PICTURE_SUFFIXES for path in folder.rglob("*"))


def _count_masks(folder: Path) -> int:
    """How many masks are beside the pictures."""
    return next((_count_pictures(folder / name) for name in MASK_FOLDERS if (folder / name).is_dir()), 0)


def check_capture(folder: Path, capture: Capture) -> None:
    """Raises io.SceneError for pictures that are missing, and where there is too little to train with."""
    files = [path for item in (*capture.train, *capture.test) for path in item.files.values()]
    missing = [path for path in files if not path.is_file()]
    if missing:
        raise io.SceneError(f"{folder}: {len(missing)} of {len(files)} pictures are missing, the first is {missing[0]}")
    if len(capture.train) < 2:
        raise io.SceneError(f"{folder}: training needs at least 2 pictures, got {len(capture.train)}")
    if not extent_of([item.view for item in capture.train]) > 0:
        raise io.SceneError(
            f"{folder}: training needs cameras at different places, got all {len(capture.train)} at one"
        )


def extent_of(views: list[io.View]) -> float:
    """The radius around the cameras that 3DGS scales the learning rate of the means by, world units."""
    centers = torch.stack([torch.linalg.inv(view.w2c)[:3, 3] for view in views])
    return 1.1 * (centers - centers.mean(0)).norm(dim=1).max().item()


def transforms(path: Path) -> tuple[list[Photograph], dict[str, Any]]:
    """The views of a transforms file and where their pictures are, in the order of the file; and all that it says.

    Raises io.SceneError for what `io.load_views` refuses, for lists of cameras, which it reads too, and for lenses that
    cannot be undistorted.
    """
    views, data = read_views(path)
    if not isinstance(data, dict):
        raise io.SceneError(f"{path}: expected a transforms file, which says where pictures are, got a list of cameras")
    found = []
    files = PictureFiles(path.parent)
    for i, (view, frame) in enumerate(zip(views, data["frames"])):
        where = f"{path}: frame {i}"
        lens = _lens_of_frame(data | frame, where)
        _check_lens(lens, view, where)
        found.append(Photograph(view, {1: files.find(str(frame.get("file_path", "")))}, lens))
    return found, data


def _lens_of_frame(entry: dict[str, Any], where: str) -> Lens | None:
    """The lens of a frame of a transforms file, with what all frames share. Raises io.SceneError."""
    said = distortion_of(entry)
    model = entry.get("camera_model") or "OPENCV"
    unknown = {"distortion_params", "is_fisheye"} | (set() if model == RATIONAL else {"k5", "k6"})
    for name in unknown & said.keys():
        raise io.SceneError(
            f"{where}: lenses must be those of OpenCV (k1, k2, k3, k4, p1, p2), got {name} = {said[name]}; undistort "
            "the pictures first"
        )
    return lens_of(model, said, where)


def nerfstudio(path: Path, test_every: int) -> Capture:
    """The capture of a transforms.json: its pictures by name, and the points of the file that it names.

    Which pictures to train with and to test with is what its lists train_filenames, val_filenames and test_filenames
    say, if it has any. The test takes the last, or where that is missing the one before. Without the first, the
    training takes the pictures that neither of the others has. Without ply_file_path, points are looked for under their
    usual names.

    Raises io.SceneError for what `transforms` and `load_points` refuse, for lists of anything but pictures of the file,
    and for points that are not there.
    """
    items, data = transforms(path)
    points_file = data.get("ply_file_path")
    if points_file is None:
        points = initial_points(path.parent)
    elif isinstance(points_file, str) and (path.parent / points_file.replace("\\", "/")).is_file():
        points = load_points(path.parent / points_file.replace("\\", "/"))
    else:
        raise io.SceneError(f"{path}: ply_file_path must name a file beside it, got {points_file!r}")
    items.sort(key=lambda item: str(item.files[1]))
    masks = sum(frame.get("mask_path") is not None for frame in data["frames"]) or _count_masks(path.parent)
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
    return Capture(*splits, BLACK, points, starts_in_view=True, masks=masks)


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

    if test_every == 0:
        return items, []
    train = [item for i, item in enumerate(items) if i % test_every]
    if len(train) < 2 <= len(items):
        raise io.SceneError(
            f"{folder}: training needs at least 2 pictures, got {len(train)} of {len(items)}, for the others are kept "
            "for the test; --test-every 0 trains with all"
        )
    return train, items[::test_every]
