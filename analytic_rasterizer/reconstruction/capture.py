"""A capture of photographs and of the cameras that COLMAP finds for them."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from .. import io
from ..captures.layouts import MASKS
from ..captures.loading import IMAGES
from ..captures.photographs import read_mask
from ..io.images import opened_picture
from ..io.writing import write_json
from ..training.files import results_folder
from .films import about_film, take_photographs
from .folder import LEAST, Photographs, Shot, check_photographs, find_photographs
from .forecast import FEATURES, LARGEST, forecast, groups_of
from .pairs import pairs_of
from .process import Found, Job, Stages, check_installed, run_worker

RECORD = "photographs.json"  # of whose photographs the cameras are
WORK = "colmap"  # what is there until the cameras are found
SPARSE = "sparse"
READ_BY_COLMAP = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp")
LEAST_SHARE = 0.5  # of the photographs that have to be placed
NAMED = 5  # photographs in a sentence


class Reconstructed(NamedTuple):
    """A capture.

    Attributes:
        folder: Of the capture.
        notes: Sentences of what was found, for the user.
    """

    folder: Path
    notes: tuple[str, ...]


def reconstruct(
    source, folder, images: str | None = None, *, masks: str = "auto", missing: str = "refuse", threads: int = 0
) -> Reconstructed:
    """Finds the cameras of photographs, and writes a capture of both: images, masks and sparse.

    The photographs stay where they are, and are linked; those of a film are written. A capture of the same photographs
    that is there already is taken, and a part of one is gone on with. Shows progress on stderr.

    Args:
        source: A folder of photographs, or a film, see `find_photographs`.
        folder: For the capture.
        images: The folder of the photographs in `source`, as of `load_capture`.
        masks: "auto": black pixels of masks have no features; "none": masks are ignored.
        missing: "refuse": less than half of the photographs with a camera is an error; "skip": they are enough.
        threads: For COLMAP; 0: as many as torch has.

    Raises:
        io.SceneError: No photographs, too few, too few with cameras; or the capture is of other photographs.
        ImportError: Without the extra `colmap`; without `video`, of a film.
        OSError: What cannot be read or written.
        RuntimeError: COLMAP failed.
    """
    found, folder = find_photographs(source, images, masks), Path(folder)
    if found is None:
        raise io.SceneError(f"{source}: expected photographs without cameras, or a film")
    check_photographs(found, folder)
    record, before = _record_of(found), read_record(folder)
    if before is not None and _same(before, record) and "models" in before:
        _link(found, folder)
        notes = (f"cameras are those that COLMAP found before, in {folder}", *_about(before))
        _check_share(folder, before, missing)
        return Reconstructed(folder, notes)
    check_installed(found.source)
    if before is None and folder.is_dir() and any(folder.iterdir()):
        raise io.SceneError(f"{folder}: expected a capture that train made, got another folder; choose another --out")
    if before is not None and not _same(before, record):
        if "models" in before:
            raise io.SceneError(
                f"{folder}: expected the photographs of {found.source}, got cameras of {len(before['files'])} others "
                f"({before['photographs']}); remove this folder, or choose another --out"
            )
        shutil.rmtree(folder / WORK, ignore_errors=True)
    threads = threads or torch.get_num_threads()
    said = [] if found.is_film else forecast(found, threads).lines  # raises for what cannot be read
    if found.is_film:
        said = [f"{found.source}: {about_film(found.source)[2]}"]
    results_folder(folder)
    write_json(folder / RECORD, record)
    notes = _find_cameras(found, folder, threads, record, said)
    _check_share(folder, record, missing)
    return Reconstructed(folder, notes)


def read_record(folder: Path) -> dict[str, Any] | None:
    """What a capture that is made here says of its photographs; None: there is none."""
    try:
        record = json.loads((folder / RECORD).read_text(encoding="utf-8"))
        return record if {"photographs", "files"} <= set(record) else None
    except (OSError, ValueError, TypeError):
        return None


def is_finished(source, folder, images: str | None = None) -> bool:
    """Whether `folder` has the cameras of these photographs. Arguments as of `reconstruct`."""
    found, before = find_photographs(source, images, "none"), read_record(Path(folder))
    return found is not None and before is not None and "models" in before and _same(before, _record_of(found))


def _record_of(found: Photographs) -> dict[str, Any]:
    return {"photographs": str(found.source.resolve()), "files": found.sizes()}


def _same(before: dict[str, Any], record: dict[str, Any]) -> bool:
    """Whether two records are of the same photographs, which may have moved."""
    return before["files"] == record["files"]


def _link(found: Photographs, folder: Path) -> None:
    """Links of the capture to photographs and masks, where they are now."""
    if found.is_film:
        return
    for name, place in ((IMAGES, found.folder), (MASKS, found.masks)):
        link = folder / name
        if link.is_symlink():
            link.unlink()
        if place is not None and not link.exists():
            link.symlink_to(place.resolve(), target_is_directory=True)


def _find_cameras(
    found: Photographs, folder: Path, threads: int, record: dict[str, Any], said: Sequence[str]
) -> tuple[str, ...]:
    """The rest of `reconstruct`. Adds to `record` what was found, and returns sentences."""
    work = folder / WORK
    work.mkdir(exist_ok=True)
    with Stages(str(found.source)) as display:
        display.say(said)
        if found.is_film and not (folder / IMAGES).is_dir():
            frames = work / IMAGES
            shutil.rmtree(frames, ignore_errors=True)
            frames.mkdir()
            take_photographs(found.source, frames, lambda done, of: display.show("film", done, of))
            frames.rename(folder / IMAGES)
    _link(found, folder)
    photographs = found
    if found.is_film:
        photographs = find_photographs(folder / IMAGES, masks="none")
        if photographs is None or len(photographs.names) < LEAST:
            raise io.SceneError(f"{found.source}: expected at least {LEAST} pictures in the film")
    shots = photographs.shots()
    shutil.rmtree(work / SPARSE, ignore_errors=True)
    models = _run(photographs, shots, work, threads)
    if not models.models:
        shutil.rmtree(folder)  # which holds links, and nothing that a second run would want
        raise io.SceneError(
            f"{found.source}: COLMAP placed none of {len(shots)} photographs, "
            + (f"though {models.matched} pairs show the same points" if models.matched else "no two show the same")
            + ": photographs have to overlap by half or more, from places that differ"
        )
    shutil.rmtree(folder / SPARSE, ignore_errors=True)
    (work / SPARSE).rename(folder / SPARSE)
    without = sorted({shot.name for shot in shots} - set(models.models[0]))
    record |= {"models": [len(names) for names in models.models], "of": len(shots), "without_camera": without}
    write_json(folder / RECORD, record)
    shutil.rmtree(work, ignore_errors=True)
    return _about(record)


def _run(photographs: Photographs, shots: Sequence[Shot], work: Path, threads: int) -> Found:
    """Has COLMAP find the cameras, and write models to SPARSE in `work`."""
    pictures, masks = work / "pictures", work / MASKS
    for made in (pictures, masks):
        shutil.rmtree(made, ignore_errors=True)
        made.mkdir()
    files = {shot.name: _picture(photographs.folder / shot.name, pictures, k) for k, shot in enumerate(shots)}
    masked = [_write_mask(photographs, shot, masks / f"{files[shot.name]}.png") for shot in shots]
    pairs = pairs_of([shot.name for shot in shots], [shot.position for shot in shots])
    job = Job(
        database=str(work / "database.db"),
        images=str(pictures),
        output=str(work / SPARSE),
        groups=[{"model": model, "names": [files[shot.name] for shot in group]} for model, group in groups_of(shots)],
        names={file: name for name, file in files.items()},
        pairs=[(files[first], files[second]) for first, second in pairs],
        masks=str(masks) if any(masked) else None,
        threads=threads,
        largest=LARGEST,
        features=FEATURES,
    )
    return run_worker(job, str(photographs.source))


def _picture(path: Path, folder: Path, number: int) -> str:
    """A link to a photograph under a plain name, which COLMAP's lists of pairs want; a copy of what it cannot read."""
    if path.suffix.lower() in READ_BY_COLMAP:
        name = f"{number:05}{path.suffix.lower()}"
        (folder / name).symlink_to(path.resolve())
        return name
    name = f"{number:05}.png"
    with opened_picture(path, "train") as opened:
        io.write_safely(folder / name, lambda temporary: opened.convert("RGB").save(temporary))
    return name


def _write_mask(photographs: Photographs, shot: Shot, path: Path) -> bool:
    """Writes the mask of a photograph, as this package reads it. Returns whether there is one."""
    mask = photographs.mask(shot.name)
    if mask is None:
        return False
    counts: Tensor = read_mask(mask, *shot.size).float() / 255
    io.save_image(path, counts.round().expand(3, -1, -1))
    return True


def _check_share(folder: Path, record: dict[str, Any], missing: str) -> None:
    """Raises io.SceneError where too few photographs have a camera."""
    placed, count = record["models"][0], record["of"]
    if placed < LEAST_SHARE * count and missing != "skip":
        raise io.SceneError(f"{folder}: {'; '.join(_about(record))}", "--missing skip trains with these")


def _about(record: dict[str, Any]) -> tuple[str, ...]:
    """Sentences: how many photographs have cameras, and which have none."""
    models, count, without = record["models"], record["of"], record["without_camera"]
    said = [f"COLMAP found the cameras of {models[0]} of {count} photographs"]
    if len(models) > 1:
        others = " and ".join(map(str, models[1:]))
        said.append(f"COLMAP could not join {len(models)} models: the largest is used, the others have {others}")
    if without:
        named = ", ".join(without[:NAMED]) + (", .." if len(without) > NAMED else "")
        said.append(f"{len(without)} photographs have no camera and are left out: {named}")
    return tuple(said)
