"""The formats of scenes, by the suffix of a file."""

from __future__ import annotations

from pathlib import Path

from .errors import SceneError, check_content

SOG_META = "meta.json"
FORMATS = {
    ".ply": "ply",
    ".ply_compressed": "ply",
    ".spz": "spz",
    ".sog": "sog",
    SOG_META: "sog",
    ".splat": "splat",
    ".glb": "gltf",
    ".gltf": "gltf",
    ".usd": "usd",
    ".usda": "usd",
    ".usdc": "usd",
    ".usdz": "usd",
}
"""Formats of scenes, by `suffix_of`."""
HARMONICS = [3 * ((degree + 1) ** 2 - 1) for degree in range(5)]  # numbers beyond the base colour, by degree


def scene_file(path) -> tuple[Path, str]:
    """The path of a file of a scene, and its format, one of FORMATS. Suffixes may have any case.

    Raises SceneError where the file is not there, or has another suffix.
    """
    path = Path(path)
    if path.is_dir():
        raise SceneError(f"{path}: expected a file of a scene, got a folder")
    if not path.is_file():
        raise SceneError(f"{path}: no such file")
    suffix = suffix_of(path)
    if suffix not in FORMATS:
        expected = "a .ply, .spz, .sog, .splat, .glb, .gltf, .usd file or a meta.json"
        raise SceneError(f"{path}: expected {expected}, got {path.suffix or 'no suffix'!r}")
    check_content(path)
    return path, FORMATS[suffix]


def suffix_of(path: Path) -> str:
    """The suffix in lower case; that of an unbundled .sog is the whole name of its meta.json."""
    return SOG_META if path.name.lower() == SOG_META else path.suffix.lower()


def check_harmonics(count: int) -> None:
    """Raises SceneError for another number of properties f_rest_0, f_rest_1, .. than a degree has."""
    if count not in HARMONICS:
        raise SceneError(f"expected 0, 9, 24, 45 or 72 f_rest properties (SH degree 0 to 4), got {count}")
