"""The .sog format (PlayCanvas): a ZIP archive of pictures whose pixels are Gaussians, and a meta.json about them."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from .common import SceneError, naming, optional_import, unreadable
from .with_gsply import fields_of, gsply

CODEBOOK = 256  # numbers that a byte of a picture chooses from


def read_sog(path: Path) -> dict[str, np.ndarray]:
    """The parameters of a .sog, by the names of the fields of `Gaussians`.

    Raises SceneError, which names the file, for a broken one; ImportError without gsply and imagecodecs.
    """
    read = gsply().sogread
    optional_import("imagecodecs")
    meta = _read_meta(path)
    with naming(path):
        _check(meta)
        with unreadable():
            data = read(path)
    return fields_of(data)


def is_antialiased(path: Path) -> bool | None:
    """Whether the file says that pixels are to be integrated; None where it says nothing. Raises SceneError."""
    meta = _read_meta(path)
    if "model" in meta:
        return meta["model"] == "antialiased"
    found = meta.get("antialias")  # of earlier files
    return found if isinstance(found, bool) else None


def _read_meta(path: Path) -> dict[str, Any]:
    with naming(path), unreadable(), zipfile.ZipFile(path) as archive:
        meta = json.loads(archive.read("meta.json"))
        if not isinstance(meta, dict):
            raise SceneError(f"meta.json must hold an object, got {type(meta).__name__}")
        return meta


def _check(meta: dict[str, Any]) -> None:
    """What gsply would look up beyond the end of a codebook."""
    if "version" not in meta:
        return  # the first version has none
    for name in ("scales", "sh0"):
        entry = meta.get(name)
        book = entry.get("codebook") if isinstance(entry, dict) else None
        if not isinstance(book, list) or len(book) != CODEBOOK:
            raise SceneError(f"meta.json: expected a codebook of {CODEBOOK} numbers for {name}")
