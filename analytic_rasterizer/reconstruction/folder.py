"""Photographs without cameras: what a folder of them holds, as far as names of files and headers of pictures say."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from .. import io
from ..captures.layouts import MASK_FILE, MASK_FOLDER, MASKS, mask_of
from ..captures.loading import IMAGES, is_capture, reconstruction_below
from ..io.errors import counted_files
from ..io.images import opened_picture
from ..io.pictures import PICTURE_SUFFIXES, PictureFiles
from .pairs import in_order

FILMS = (".mp4", ".mov", ".m4v", ".mkv", ".avi", ".webm", ".mpg", ".mpeg", ".mts", ".m2ts", ".3gp")
LEAST = 3  # photographs: of two, one would be for the test
# Tags of EXIF.
MAKER, CAMERA, DETAILS, PLACE = 0x010F, 0x0110, 0x8769, 0x8825
FOCAL_LENGTH, FOCAL_LENGTH_35MM = 0x920A, 0xA405
LATITUDE, LONGITUDE, HEIGHT, BELOW = (2, 1), (4, 3), 6, 5  # with the tags of N or S, and E or W


class Shot(NamedTuple):
    """A photograph.

    Attributes:
        name: Of its file, below the folder of the photographs.
        camera: What is the same for all photographs of a camera: width and height in px, maker, model, focal lengths.
        position: Latitude and longitude in degrees, height in m, of EXIF; None: not known.
    """

    name: str
    camera: tuple
    position: tuple[float, float, float] | None = None

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, px, as stored."""
        return self.camera[:2]


@dataclass(frozen=True)
class Photographs:
    """Photographs without cameras, or a film.

    Attributes:
        source: The folder, or the film, that was asked for.
        folder: That of the pictures; of a film, the one that holds it.
        names: Of the files in `folder`, in the order of the numbers in them; of a film, its own.
        masks: The folder of their masks; None: there is none.
    """

    source: Path
    folder: Path
    names: tuple[str, ...]
    masks: Path | None = None

    @property
    def is_film(self) -> bool:
        """Whether it is a film, whose pictures are not there yet."""
        return is_film(self.source)

    def sizes(self) -> dict[str, int]:
        """Bytes of each file: what tells other photographs from these."""
        return {name: (self.folder / name).stat().st_size for name in self.names}

    def mask(self, name: str) -> Path | None:
        """The file of the mask of the photograph `name`; None: there is none."""
        return None if self.masks is None else mask_of(PictureFiles(self.masks), name)

    def shots(self) -> list[Shot]:
        """Reads the headers of all files. Raises io.SceneError, which counts those that cannot be read."""
        with ThreadPoolExecutor() as pool:
            read = list(pool.map(self._shot, self.names))
        broken = [error for error in read if isinstance(error, io.SceneError)]
        if broken:
            bad = [self.folder / name for name, shot in zip(self.names, read) if isinstance(shot, io.SceneError)]
            counted = counted_files(bad, len(read), "photographs", "cannot be read")
            raise io.SceneError(f"{self.source}: {counted}", "remove them, or restore them")
        return read

    def _shot(self, name: str) -> Shot | io.SceneError:
        try:
            with opened_picture(self.folder / name, "train") as opened:
                return Shot(name, (*opened.size, *_camera_of(opened)), _position_of(opened))
        except io.SceneError as error:
            return error


def is_film(path: Path) -> bool:
    """Whether a path is a film, by its name."""
    return path.suffix.lower() in FILMS and path.is_file()


def find_photographs(source, images: str | None = None, masks: str | None = None) -> Photographs | None:
    """The photographs of a folder without cameras, or a film; None for anything else.

    They are in `images`, or else right in the folder, or else in all folders below it but those of masks.

    Args:
        source: The folder or the film.
        images: The folder of photographs in it; None: "images" where that is there.
        masks: "none": masks are not looked for.

    Raises:
        io.SceneError: A folder with a film, and without photographs.
    """
    source = Path(source)
    if is_film(source):
        return Photographs(source, source.parent, (source.name,))
    if not source.is_dir() or is_capture(source) or reconstruction_below(source) is not None:
        return None
    folder = next((source / name for name in (images or IMAGES,) if (source / name).is_dir()), source)
    files = [path for path in folder.iterdir() if _is_photograph(path)] or [
        path
        for path in folder.rglob("*")
        if _is_photograph(path) and not any(_is_aside(part) for part in path.relative_to(folder).parent.parts)
    ]
    # Masks beside the pictures; a name that all have is that of what they show.
    files = [path for path in files if not MASK_FILE.search(path.stem)] or files
    if not files:
        films = sorted(path for path in folder.iterdir() if is_film(path))
        if films:
            raise io.SceneError(f"{source}: expected photographs, got a film: give the file itself, {films[0]}")
        return None
    names = tuple(in_order([path.relative_to(folder).as_posix() for path in files]))
    found = Photographs(source, folder, names)
    if masks != "none":
        for place in dict.fromkeys((source / MASKS, folder.parent / MASKS)):
            own = Photographs(source, folder, names, place)
            if place.is_dir() and any(map(own.mask, names)):
                return own
    return found


def _is_photograph(path: Path) -> bool:
    return path.suffix.lower() in PICTURE_SUFFIXES and not path.name.startswith(".") and path.is_file()


def _is_aside(name: str) -> bool:
    """Whether a folder of this name holds no photographs."""
    return name.startswith(".") or MASK_FOLDER.search(name) is not None


def check_photographs(found: Photographs, out: Path) -> None:
    """Raises what is wrong before anything is done.

    Args:
        found: The photographs.
        out: A folder that will be written.

    Raises:
        io.SceneError: Too few photographs.
        ValueError: `out` is a folder of the photographs.
    """
    if not found.is_film and len(found.names) < LEAST:
        raise io.SceneError(f"{found.source}: expected at least {LEAST} photographs, got {len(found.names)}")
    own = {found.folder, *((found.folder / name).parent for name in found.names)}
    own = own if found.is_film else own | {found.source}
    if not found.is_film and Path(out).resolve() in {path.resolve() for path in own}:
        raise ValueError(f"--out must be another folder than the capture and those of its pictures, got {out}")


def sizes_in_words(shots: Sequence[Shot]) -> str:
    """The sizes of photographs, and how many have each."""
    sizes = [shot.size for shot in shots]
    counted = sorted({size: sizes.count(size) for size in sizes}.items(), key=lambda entry: -entry[1])
    return ", ".join(f"{count} of {width} x {height} px" for (width, height), count in counted)


def _exif_of(opened):
    # Pillow decodes a .png that has no EXIF before its pixels, to look behind them.
    return {} if opened.format == "PNG" and "exif" not in opened.info else opened.getexif()


def _camera_of(opened) -> tuple:
    """Maker, model and focal lengths of EXIF, whatever is there."""
    try:
        exif = _exif_of(opened)
        details = exif.get_ifd(DETAILS)
        focal = (_number(details.get(tag)) for tag in (FOCAL_LENGTH, FOCAL_LENGTH_35MM))
        return (*(str(exif.get(tag, "")).strip() for tag in (MAKER, CAMERA)), *focal)
    except Exception:  # whatever is wrong with EXIF, the picture is good
        return ("", "", None, None)


def _position_of(opened) -> tuple[float, float, float] | None:
    try:
        place = _exif_of(opened).get_ifd(PLACE)
        latitude, longitude = (
            _degrees(place[tag]) * (-1 if str(place.get(side, "")).upper() in ("S", "W") else 1)
            for tag, side in (LATITUDE, LONGITUDE)
        )
        below = place.get(BELOW) in (1, b"\x01")
        return latitude, longitude, (-1 if below else 1) * (_number(place.get(HEIGHT)) or 0.0)
    except Exception:
        return None


def _degrees(parts: Sequence[Any]) -> float:
    degrees, minutes, seconds = map(float, parts)
    return degrees + minutes / 60 + seconds / 3600


def _number(value: Any) -> float | None:
    """A number of EXIF, to a thousandth; None: none, or nought over nought."""
    number = None if value is None else float(value)
    return round(number, 3) if number is not None and number == number else None
