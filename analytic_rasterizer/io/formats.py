"""The formats of scenes, by the suffix of a file."""

from __future__ import annotations

from pathlib import Path

from .errors import SceneError, check_content

FORMATS = {
    ".ply": "ply",
    ".ply_compressed": "ply",
    ".spz": "spz",
    ".sog": "sog",
    ".splat": "splat",
    ".glb": "gltf",
    ".gltf": "gltf",
}
"""Formats of scenes, by suffix."""


def scene_file(path) -> tuple[Path, str]:
    """The path of a file of a scene, and its format, one of FORMATS. Suffixes may have any case.

    Raises SceneError where the file is not there, or has another suffix.
    """
    path = Path(path)
    if path.is_dir():
        raise SceneError(f"{path}: expected a file of a scene, got a folder")
    if not path.is_file():
        raise SceneError(f"{path}: no such file")
    suffix = path.suffix.lower()
    if suffix not in FORMATS:
        raise SceneError(
            f"{path}: expected a .ply, .spz, .sog, .splat, .glb or .gltf file, got {path.suffix or 'no suffix'!r}"
        )
    check_content(path)
    return path, FORMATS[suffix]
