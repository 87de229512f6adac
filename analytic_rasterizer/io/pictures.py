"""Finds the pictures that a file of cameras names, also as other systems spell the names."""

from __future__ import annotations

import re
import unicodedata
from pathlib import Path

PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp", ".exr", ".avif")


class PictureFiles:
    """The pictures of a folder, by the names that a file of cameras has for them.

    The file of cameras may come from another system. Where no picture has exactly the name in it, a name also fits
    with the backslash for "/", in another case, in another Unicode spelling of its letters, and with the suffix of
    another picture format or none. Of an absolute name, the end is enough.
    """

    def __init__(self, folder: Path):
        self.folder = folder
        self._listed: dict[Path, dict[str, list[Path]]] = {}  # files of a folder by their plain names

    def find(self, name: str) -> Path:
        """The file of a picture; where there is none, a path without a file, for messages."""
        exact = self.folder / name
        if exact.is_file():
            return exact
        parts = [part for part in re.split(r"[/\\]", name) if part not in ("", ".")]
        is_absolute = re.match(r"[/\\]|[A-Za-z]:", name) is not None
        for first in range(len(parts) if is_absolute else min(1, len(parts))):
            found = self._find(self.folder, parts[first:])
            if found is not None:
                return found
        return exact if exact.suffix.lower() in PICTURE_SUFFIXES else Path(f"{exact}.png")

    def _find(self, folder: Path, parts: list[str]) -> Path | None:
        *folders, name = parts
        for part in folders:
            if part == ".." or (folder / part).is_dir():
                folder = folder / part
                continue
            folder = next((path for path in self._list(folder).get(_plain(part), []) if path.is_dir()), None)
            if folder is None:
                return None
        listed = self._list(folder)
        files = [path for path in listed.get(_plain(name), []) if path.is_file()]
        if files:
            return files[0]
        stem, suffix = Path(name).stem, Path(name).suffix.lower()
        for base in (name, *([stem] if suffix in PICTURE_SUFFIXES else [])):
            others = [path for end in PICTURE_SUFFIXES for path in listed.get(_plain(base + end), [])]
            if others:
                return others[0]
        return None

    def _list(self, folder: Path) -> dict[str, list[Path]]:
        if folder not in self._listed:
            entries: dict[str, list[Path]] = {}
            for path in sorted(folder.iterdir()) if folder.is_dir() else []:
                entries.setdefault(_plain(path.name), []).append(path)
            self._listed[folder] = entries
        return self._listed[folder]


def _plain(name: str) -> str:
    """The same for all spellings of a name."""
    return unicodedata.normalize("NFC", name).casefold()
