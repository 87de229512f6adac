"""Depth maps beside photographs: where they are, and what their files hold.

Two conventions. 3DGS of 2024 has a folder `depths` of grey PNGs, which hold inverse depths up to a scale and a shift,
and beside the cameras depth_params.json with both for each photograph: inverse depth = scale * stored / 2^16 + offset.
They have 16 bits, or the 8 in each of three channels that Depth Anything writes, which 3DGS divides by 2^16 as well.
nerfstudio has depth_file_path in the frames of a transforms.json: a 16-bit PNG or a .npy with depths in units of its
depth_unit_scale_factor, in which 0 stands for what was not measured.

Here both are *raw* inverse depths, to which a scale and a shift belong. A depth is that of the camera model: z, or with
fisheyes and spheres the distance from the camera.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from .. import io
from ..io.errors import check_content, why_unreadable
from ..io.images import opened_picture
from ..io.pictures import PictureFiles
from .photographs import is_reduced

DEPTHS, CONFIDENCES, PARAMETERS = "depths", "confidences", "depth_params.json"
UNIT = 1e-3  # world units of 1 in the files of nerfstudio by default: millimetres
LEVELS = 2**16  # that inverse depths of 3DGS are divided by


class DepthFile(NamedTuple):
    """The depth map of a photograph, of the shape of its camera's picture.

    Attributes:
        path: A 16-bit PNG, one of inverse depths with 8 bits, or a .npy.
        is_inverse: Whether it holds inverse depths, divided by 2^16, or depths.
        scale, shift: Inverse depths are scale * raw + shift, 1 / world units. None: the files do not say.
        confidence: A picture of how much each pixel counts, the brightest most, black not at all; None: all alike.
    """

    path: Path
    is_inverse: bool
    scale: float | None
    shift: float = 0.0
    confidence: Path | None = None


class DepthFolder:
    """The maps of a reconstruction, as 3DGS of 2024 has them.

    Args:
        folder: Of the capture, with the folders `depths` and, if there are any, `confidences`.
        sparse: Of the cameras, with depth_params.json.

    Raises io.SceneError for a depth_params.json that is none.
    """

    def __init__(self, folder: Path, sparse: Path):
        self._maps, self._confidences = PictureFiles(folder / DEPTHS), PictureFiles(folder / CONFIDENCES)
        self._known = _parameters(sparse / PARAMETERS) if (folder / DEPTHS).is_dir() else {}

    def find(self, name: str) -> DepthFile | None:
        """The map of a photograph, by the name of its file; None where there is none."""
        stem = name.rpartition(".")[0] or name
        path = _first_file(self._maps, stem, name)
        if path is None:
            return None
        scale, shift = self._known.get(stem, (None, 0.0))
        return DepthFile(path, True, scale, shift, _first_file(self._confidences, stem, name))


def _first_file(files: PictureFiles, *names: str) -> Path | None:
    found = (files.find(f"{name}.png") for name in names)
    return next((path for path in found if path.is_file()), None)


def _parameters(path: Path) -> dict[str, tuple[float, float]]:
    """Scales and shifts by the names of photographs without suffix. Without those that cannot be right."""
    if not path.is_file():
        return {}
    try:
        told = json.loads(path.read_text(encoding="utf-8-sig"))
        entries = {name: entry for name, entry in told.items() if isinstance(entry, dict)}
        found = {name: (float(entry["scale"]), float(entry["offset"])) for name, entry in entries.items()}
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        expected = 'an object with "scale" and "offset" for each photograph'
        raise io.SceneError.of(
            path, expected, repr(error), "without this file scales are fitted to the points"
        ) from None
    return {name: pair for name, pair in found.items() if all(map(math.isfinite, pair)) and pair[0] > 0}


def depth_of_frame(frame: dict[str, Any], files: PictureFiles, where: str) -> DepthFile | None:
    """The map that a frame of a transforms.json names, there or not; None where it names none.

    Raises io.SceneError, which begins with `where`.
    """
    paths = {}
    for key in ("depth_file_path", "confidence_file_path"):
        name = frame.get(key)
        if name is not None and not isinstance(name, str):
            raise io.SceneError(f"{where}: {key} must name a file, got {name!s}")
        exact = None if name is None else files.folder / name.replace("\\", "/")
        paths[key] = exact if exact is None or exact.suffix.lower() == ".npy" else files.find(name)
    depth, confidence = paths.values()
    return None if depth is None else DepthFile(depth, False, 1 / UNIT, 0.0, confidence)


def read_depth(file: DepthFile, view: io.View) -> tuple[Tensor, Tensor]:
    """Raw inverse depths of a map and how much each pixel counts, 0 to 1: (h, w) float32 each, of the map's size.

    Where nothing was measured both are 0.

    Raises:
        io.SceneError: A file that cannot be read, or of another kind; another shape than that of the view.
    """
    stored = _read_array(file.path) if file.path.suffix.lower() == ".npy" else _read_png(file.path, file.is_inverse)
    height, width = stored.shape
    if not is_reduced(width, height, view.width, view.height):
        expected = f"a depth map of the shape of its camera's picture, {view.width} x {view.height} px"
        raise io.SceneError.of(file.path, expected, f"{width} x {height}")
    known = np.isfinite(stored) if file.is_inverse else np.isfinite(stored) & (stored > 0)
    raw = np.where(known, stored, 1)
    raw = raw / LEVELS if file.is_inverse else 1 / raw
    shares = torch.from_numpy(known.astype(np.float32))
    if file.confidence is not None:
        shares *= _confidence(file.confidence, width, height)
    return torch.from_numpy(np.where(known, raw, 0).astype(np.float32)), shares


def _read_png(path: Path, is_inverse: bool) -> np.ndarray:
    """(h, w) float64 of a grey picture. Depths need more than 8 bits, which end at 255 units."""
    with opened_picture(path, "train") as opened:
        mode = opened.mode
        is_deep = mode == "F" or mode.startswith("I")
        stored = np.array(opened if is_deep else opened.convert("RGB"))
    if is_deep:
        return stored.astype(np.float64)
    is_grey = bool((stored == stored[:, :, :1]).all())
    if not is_inverse or not is_grey:
        expected = "a depth map: a grey picture of 16 bits" + ("" if is_inverse else ", or .npy")
        raise io.SceneError.of(path, expected, f"one of mode {mode}{'' if is_grey else ' in colours'}")
    return stored[:, :, 0].astype(np.float64)


def _read_array(path: Path) -> np.ndarray:
    """(h, w) float64."""
    try:
        array = np.load(path, allow_pickle=False)
        array = array[..., 0] if array.ndim == 3 and array.shape[2] == 1 else array
        numbers = array.astype(np.float64)
    except (OSError, ValueError, TypeError, EOFError) as error:
        check_content(path)
        raise io.SceneError(f"{path}: {why_unreadable(error)}") from None
    if array.ndim != 2:
        raise io.SceneError.of(path, "a depth map of shape (H, W)", array.shape)
    return numbers


def _confidence(path: Path, width: int, height: int) -> Tensor:
    """(h, w) float32 in 0 to 1, of this size: levels over the largest."""
    with opened_picture(path, "train") as opened:
        levels = torch.from_numpy(np.array(opened if opened.mode[0] in "IFL1" else opened.convert("L")))
    if tuple(levels.shape[:2]) != (height, width):
        got = " x ".join(map(str, levels.shape[1::-1]))
        raise io.SceneError.of(path, f"a confidence for each pixel of the depth map, {width} x {height}", got)
    levels = levels.float()
    return levels.clamp_min(0) / levels.max().clamp_min(1e-9)
