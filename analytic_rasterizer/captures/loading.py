"""Captures: photographs with cameras, from a folder of any of the `layouts`."""

from __future__ import annotations

import warnings
from collections.abc import Collection
from pathlib import Path

import torch

from .. import io
from ..io.errors import counted_files, warn_of
from ..render.effects import NEAR
from . import colmap
from .extent import OUTLYING, is_one_pose, outliers_of, seen_distance
from .layouts import BLACK, MASKS, WHITE, Capture, Photograph, count_pictures, has_splits, read_layout
from .lenses import about_folds, about_lenses, about_lost_area
from .photographs import broken_files
from .placement import offset_of
from .undistortion import window_of

__all__ = ["BLACK", "WHITE", "Capture", "Photograph", "load_capture"]

IMAGES, TEST_PERIOD = "images", 8
RECONSTRUCTIONS = ("sparse/0", "sparse", "colmap/sparse/0")
CHOICES = {
    "lens": ("keep", "undistort", "refuse"),
    "missing": ("refuse", "skip"),
    "masks": ("auto", "none"),
    "alpha": ("background", "mask"),
}
"""Of arguments of `load_capture`, which are options of `train` too; the first is the default."""
SEARCH_DEPTH = 3  # folders below SCENE where an error looks for reconstructions


def load_capture(
    folder,
    images: str = IMAGES,
    test_every: int = TEST_PERIOD,
    *,
    cameras: str | None = None,
    lens: str = "keep",
    missing: str = "refuse",
    masks: str = "auto",
    alpha: str = "background",
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
        lens: "keep": the renderer has the lenses of the photographs; "undistort": photographs of cameras with a lens
            are resampled to pinholes; "refuse": they are an error.
        missing: "refuse": pictures that are not there, or cannot be read, are an error; "skip": their cameras are left
            out, and where it is the mask, all pixels count.
        masks: "auto": black pixels of masks do not count, neither in training nor in tests. Masks are pictures in
            COLMAP's folder `masks` with the name of the photograph, and .png after it or not, or nerfstudio's
            mask_path. "none": masks are ignored.
        alpha: "background": a background is seen through transparent pixels; "mask": they do not count.
        offset: What to take off all positions, so that they are those of a scene with this offset. None: what
            `offset_of` finds, which is nothing unless coordinates are far from zero.

    Warns of masks elsewhere, which are ignored, of photographs that are left out because their cameras are far from all
    others, and of points so near to the cameras that they are not drawn. Says how much of a picture a lens shows that
    folds back inside it.

    Raises:
        io.SceneError: No such layout; missing pictures; no pictures to train with; all cameras with one pose; a lens
            that cannot be undistorted.
        OSError: A file that cannot be read.
        ValueError: test_every is negative or 1; no such `lens`, `missing`, `masks` or `alpha`.
    """
    folder = _checked(folder, test_every, lens=lens, missing=missing, masks=masks, alpha=alpha)
    capture = read_cameras(folder, images, test_every, cameras, missing, masks)
    if missing == "skip":
        capture = _without_broken(capture)
    capture = without_outliers(folder, capture)
    check_capture(folder, capture)
    if capture.ignored_masks and masks == "auto":
        warn_of(
            folder,
            f"{capture.ignored_masks} masks are ignored, all pixels count: masks of photographs belong in "
            f"{folder / MASKS}, or mask_path names them: {capture.about_masks}",
            "--masks none ignores them without a word",
            stacklevel=2,
        )
    capture = _with_alpha(capture, alpha)
    photographs = [*capture.train, *capture.test]
    _warn_of_near(folder, photographs, capture.points)
    distorted = [item for item in photographs if item.view.lens is not None]
    if distorted and lens == "refuse":
        raise io.SceneError(
            f"{folder}: {len(distorted)} of {len(photographs)} photographs have a lens, the first is "
            f"{distorted[0].files[1]} ({distorted[0].view.lens.model})",
            "leave out --lens refuse, or undistort them first",
        )
    notes = list(capture.notes)
    masked = sum(item.mask is not None for item in photographs)
    if masked:
        notes.append(f"{masked} of {len(photographs)} photographs have a mask, whose black pixels do not count")
    if distorted and lens == "undistort":
        _check_windows(folder, distorted)
        notes.append(about_lost_area(distorted, len(photographs)))
        capture = _undistorted(capture)
    elif distorted:
        notes.append(about_lenses(distorted, len(photographs)))
        notes += about_folds(distorted)
    if offset is None:
        positions = None if capture.points is None else capture.points[0]
        offset = offset_of([item.view for item in photographs], positions)
        if offset is not None:
            where = ", ".join(f"{number:.15g}" for number in offset)
            notes.append(f"coordinates are far from zero: positions are stored relative to ({where})")
    return _relative_to(capture, offset)._replace(notes=tuple(notes))


def load_photographs(
    folder,
    images: str = IMAGES,
    test_every: int = TEST_PERIOD,
    *,
    cameras: str | None = None,
    lens: str = "keep",
    missing: str = "refuse",
    masks: str = "auto",
    alpha: str = "background",
) -> Capture:
    """What `load_capture` reads, but without points, and in world coordinates. Nothing is warned of or left out.

    Arguments, and what is raised, as there.
    """
    folder = _checked(folder, test_every, lens=lens, missing=missing, masks=masks, alpha=alpha)
    capture = read_cameras(folder, images, test_every, cameras, missing, masks, with_points=False)
    check_capture(folder, capture)
    capture = _with_alpha(capture, alpha)
    return _undistorted(capture) if lens == "undistort" else capture


def _checked(folder, test_every: int, **choices: str) -> Path:
    """The folder, where this and other arguments of `load_capture` are right. Raises as it says."""
    if test_every < 0 or test_every == 1:
        raise ValueError(f"test_every must be 0 or at least 2, got {test_every}")
    for name, value in choices.items():
        if value not in CHOICES[name]:
            raise ValueError(f"{name} must be one of {', '.join(CHOICES[name])}, got {value}")
    folder = Path(folder)
    if not folder.is_dir():
        raise io.SceneError(f"{folder}: no such folder")
    return folder


def read_cameras(
    folder: Path,
    images: str,
    test_every: int,
    cameras: str | None,
    missing: str,
    masks: str = "auto",
    with_points: bool = True,
) -> Capture:
    """The capture in world coordinates, as far as files of cameras and points say. Arguments as `load_capture`."""

    def read(place: Path) -> Capture:
        capture = read_layout(folder, place, images, test_every, with_points)._replace(source=place)
        capture = _each(capture, mask=None) if masks == "none" else capture
        return _without_missing(capture) if missing == "skip" else capture

    if cameras is not None:
        return read(folder / cameras)
    places, parts = _places(folder), _parts(folder)
    if not places and parts is not None:
        raise colmap.incomplete(parts)
    if not places:
        raise _no_cameras(folder)
    found, passed_over = {}, {}
    for place in places:
        try:
            found[place] = read(place)
            if len(places) > 1:
                check_capture(folder, found[place])
        except io.SceneError as error:
            found.pop(place, None)
            passed_over[place] = error
    if not found:
        raise passed_over[places[0]]
    plain = (place for place, its in found.items() if all(item.view.lens is None for item in (*its.train, *its.test)))
    chosen = next(plain, next(iter(found)))
    others = [place for place in (*found, *_models_beside(chosen)) if place != chosen]
    notes = []
    if others or passed_over:
        offered = " or ".join(str(place.relative_to(folder)) for place in others)
        instead = f"; --cameras takes {offered} instead" if others else ""
        notes.append(f"cameras are those of {chosen.relative_to(folder)}{instead}")
    errors = [*passed_over.values(), *([] if parts is None else [colmap.incomplete(parts)])]
    notes += [f"passed over: {error.message}" for error in errors]
    return found[chosen]._replace(notes=(*found[chosen].notes, *notes))


def _no_cameras(folder: Path) -> io.SceneError:
    """Of a folder in which nothing says where cameras are; advises what is there to go on with."""
    below, pictures = reconstruction_below(folder), count_pictures(folder)
    found = f", got {pictures} pictures without cameras" if pictures else ""
    above = next((outer for outer in folder.absolute().parents[:2] if is_capture(outer)), None)  # of sparse/0, two
    advice = []
    if above is not None:
        advice = [f"{above} is a capture: name that folder"]
    elif below is not None:
        advice = [f"there is a reconstruction in {below} (--cameras {below}, --images FOLDER)"]
    elif pictures:
        advice = ["train SCENE --out DIR finds the cameras of photographs with COLMAP"]
    return io.SceneError(
        f"{folder}: expected transforms_train.json, metadata.json, transforms.json, or COLMAP's cameras and images "
        f"(.bin or .txt) in sparse/0{found}",
        *advice,
    )


def _without_missing(capture: Capture) -> Capture:
    """The capture without photographs of which a file is not there, and without masks that are not there; with notes
    that count them."""
    files = {path for item in (*capture.train, *capture.test) for path in (*item.files.values(), item.mask) if path}
    return without_files(capture, {path for path in files if not path.is_file()}, "are missing")


def _without_broken(capture: Capture) -> Capture:
    """The same for files that cannot be read. Reads all of them."""
    files = [path for item in (*capture.train, *capture.test) for path in (*item.files.values(), item.mask) if path]
    return without_files(capture, broken_files(files).keys(), "cannot be read")


def without_files(capture: Capture, bad: Collection[Path], problem: str) -> Capture:
    """The capture without photographs of which a file is `bad`, and without masks that are; with notes of that."""
    if not bad:
        return capture
    items = [*capture.train, *capture.test]
    pictures = tuple(path for item in items for path in item.files.values() if path in bad)
    masks = tuple(dict.fromkeys(item.mask for item in items if item.mask in bad))
    train, test = (
        [
            item._replace(mask=None if item.mask in bad else item.mask)
            for item in split
            if bad.isdisjoint(item.files.values())
        ]
        for split in (capture.train, capture.test)
    )
    notes, left_out = list(capture.notes), len(items) - len(train) - len(test)
    if left_out:
        notes.append(f"{left_out} of {len(items)} pictures {problem} and left out")
    if masks:
        affected = sum(item.mask in bad for item in items)
        notes.append(f"the masks of {affected} of {len(items)} pictures {problem}: all of their pixels count")
    missing, without_mask = (*capture.missing, *pictures), (*capture.missing_masks, *masks)
    return capture._replace(train=train, test=test, notes=tuple(notes), missing=missing, missing_masks=without_mask)


def is_capture(folder: Path) -> bool:
    """Whether a folder holds cameras in one of the layouts, as far as the names of its files tell."""
    return folder.is_dir() and (bool(_places(folder)) or _parts(folder) is not None)


def _places(folder: Path) -> list[Path]:
    """The files and folders that cameras can be read from: one, or a reconstruction and a transforms.json."""
    sparse = next((folder / name for name in RECONSTRUCTIONS if colmap.is_reconstruction(folder / name)), None)
    if sparse is None:  # without a model 0 there may be others
        parents = [(folder / name).parent for name in RECONSTRUCTIONS if "/" in name]
        sparse = next((models[0] for models in map(_models_in, parents) if models), None)
    if sparse is not None:
        sparse = max(_models_beside(sparse), key=_count_registered)
    several = [place for place in (sparse, folder / "transforms.json") if place is not None and place.exists()]
    synthetic, metadata = folder / "transforms_train.json", folder / "metadata.json"
    others = several or synthetic.exists()
    if metadata.exists() and not (others and not has_splits(metadata)):
        return [metadata]
    return [synthetic] if synthetic.exists() else several


def _parts(folder: Path) -> Path | None:
    """Where there is a part of a reconstruction, and no whole one."""
    places = [folder / name for name in RECONSTRUCTIONS]
    if any(map(colmap.is_reconstruction, places)) or any(_models_in(place) for place in places):
        return None
    return next((place for place in places if colmap.parts_of(place)), None)


def _models_beside(model: Path) -> list[Path]:
    """The reconstructions of COLMAP's mapper, which writes one for each part that it could not join: 0, 1, 2, .."""
    return _models_in(model.parent) if model.is_dir() and model.name.isdecimal() else [model]


def _count_registered(model: Path) -> int:
    """How many pictures a reconstruction has; 0 for a broken one, whose error is that of reading it."""
    try:
        return colmap.count_pictures(model)
    except io.SceneError:
        return 0


def _models_in(folder: Path) -> list[Path]:
    numbered = [path for path in folder.iterdir() if path.name.isdecimal()] if folder.is_dir() else []
    return sorted(filter(colmap.is_reconstruction, numbered), key=lambda path: int(path.name))


def reconstruction_below(folder: Path) -> Path | None:
    """A reconstruction in a folder below, where nobody looks for one, relative to `folder`."""
    below = [path for depth in range(1, SEARCH_DEPTH + 1) for path in sorted(folder.glob("/".join("*" * depth)))]
    return next((path.relative_to(folder) for path in below if colmap.is_reconstruction(path)), None)


def check_capture(folder: Path, capture: Capture) -> None:
    """Raises io.SceneError for pictures and masks that are missing, and where there is too little to train with."""
    items = [*capture.train, *capture.test]
    files = [path for item in items for path in item.files.values()]
    masks = list(dict.fromkeys(item.mask for item in items if item.mask is not None))
    missing, without_mask = ([path for path in paths if not path.is_file()] for paths in (files, masks))
    if missing:
        counted = counted_files(missing, len(files), "pictures", "are missing")
        raise io.SceneError(f"{folder}: {counted}", "--missing skip leaves them out")
    if without_mask:
        counted = counted_files(without_mask, len(masks), "masks that mask_path names", "are missing")
        raise io.SceneError(
            f"{folder}: {counted}",
            "--masks none ignores masks",
            "--missing skip lets all pixels count where a mask is missing",
        )
    if len(capture.train) < 2:
        few, away = f"{folder}: training needs at least 2 pictures, got {len(capture.train)}", capture.missing
        if not away:
            raise io.SceneError(few)
        counted = counted_files(away, len(files) + len(away), "pictures", "are missing or cannot be read")
        raise io.SceneError(f"{few}: {counted}", "--images NAME takes another folder")
    if is_one_pose([item.view for item in capture.train]):
        raise io.SceneError(
            f"{folder}: training needs cameras in different directions, or cameras at different places, got all "
            f"{len(capture.train)} at one place in one direction"
        )


def without_outliers(folder: Path, capture: Capture) -> Capture:
    """The capture without photographs whose cameras are far from all others, see `outliers_of`. A warning names each.

    A wrong pose teaches nothing, and would spoil the mean of a test.
    """
    # By name, so that they are the same for every choice of the test, and for `plan_capture`.
    items = sorted([*capture.train, *capture.test], key=lambda item: str(item.files[1]))
    points = None if capture.points is None else capture.points[0]
    outliers = outliers_of([item.view for item in items], points)
    for place, distance in outliers.items():
        warnings.warn(
            f"{folder}: {items[place].files[1].name} is left out: its camera is {distance:.3g} from the middle of the "
            f"cameras, more than {OUTLYING} times as far as all others, so that its pose must be wrong",
            stacklevel=3,
        )
    far = {items[place].files[1] for place in outliers}
    train, test = ([item for item in split if item.files[1] not in far] for split in (capture.train, capture.test))
    return capture._replace(train=train, test=test)


def _warn_of_near(
    folder: Path, photographs: list[Photograph], points: tuple[torch.Tensor, torch.Tensor] | None
) -> None:
    """Warns where most of what cameras see is behind the near plane, as in a capture of too large a unit."""
    seen = 0.0 if points is None else seen_distance([item.view for item in photographs], points[0])
    if 0 < seen <= NEAR:
        warnings.warn(
            f"{folder}: most points are {seen:.2g} from their cameras or less, and nearer than {NEAR:g} nothing is "
            f"drawn: scale the capture up, with COLMAP's model_transformer for example",
            stacklevel=3,
        )


def _with_alpha(capture: Capture, alpha: str) -> Capture:
    """The capture with what this argument of `load_capture` says of its photographs."""
    return _each(capture, alpha_is_mask=True) if alpha == "mask" else capture


def _each(capture: Capture, **changes) -> Capture:
    """The capture with other fields of every photograph."""
    train, test = ([item._replace(**changes) for item in items] for items in (capture.train, capture.test))
    return capture._replace(train=train, test=test)


def _check_windows(folder: Path, distorted: list[Photograph]) -> None:
    """Raises io.SceneError for photographs that cannot be undistorted."""
    for item in distorted:
        try:
            window_of(item.view)
        except io.SceneError as error:
            raise io.SceneError(f"{folder}: {item.files[1]}: {error.message}", "leave out --lens undistort") from None


def _undistorted(capture: Capture) -> Capture:
    train, test = (
        [item._replace(undistort=item.view.lens is not None) for item in items]
        for items in (capture.train, capture.test)
    )
    return capture._replace(train=train, test=test)


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
