"""What a training writes. Every file gets a temporary name first, so that a full disk never costs the one before."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import torch

from .. import io
from ..footprints import resolve_footprint
from ..gaussians import Gaussians

CHECKPOINT, SCENE, CAMERAS = "checkpoint.pt", "scene.ply", "cameras.json"
MIP_SCENE = "point_cloud_mip.ply"
OPTIONS, METRICS, LOG = "options.json", "metrics.json", "log.jsonl"
CHECKPOINT_FORMAT = 3


def results_folder(path) -> Path:
    """The folder `path`, made if it is missing. Raises NotADirectoryError for a file, OSError if it cannot be made."""
    folder = Path(path)
    if folder.is_file():
        raise NotADirectoryError(f"{folder}: expected a folder for the results, got a file")
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def write_safely(path: Path, write: Callable[[Path], None]) -> None:
    """Lets `write` fill a file beside `path`, and gives it that name once it is complete and on the disk.

    Raises OSError, naming the file, if it cannot be written; an earlier file of this name is then still there.
    """
    # The suffix stays: writers tell formats by it.
    temporary = path.with_name(f".{path.stem}.partial{path.suffix}")
    try:
        write(temporary)
        with temporary.open("rb+") as file:
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except (OSError, RuntimeError) as error:  # torch.save raises RuntimeError when the disk is full
        reason = getattr(error, "strerror", None) or str(error).partition("\n")[0]
        raise OSError(f"{path}: cannot be written ({reason}); an earlier file of this name is unchanged") from error
    finally:
        with suppress(OSError):  # where files cannot be removed either, the first error is the one to report
            temporary.unlink(missing_ok=True)


def write_json(path: Path, value: Any) -> None:
    """Numbers that are not finite, such as the PSNR of a picture without any error, become null."""
    text = json.dumps(_as_json(value), indent=1, allow_nan=False) + "\n"
    write_safely(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))


def _as_json(value: Any) -> Any:
    """What JSON has a word for: it has none for infinity and NaN, and other programs refuse files with Python's."""
    if isinstance(value, dict):
        return {key: _as_json(of_key) for key, of_key in value.items()}
    if isinstance(value, (list, tuple)):
        return [_as_json(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def write_log(path: Path, entries: list[dict]) -> None:
    """One JSON object per line, with null as in `write_json`."""
    text = "".join(json.dumps(_as_json(entry), allow_nan=False) + "\n" for entry in entries)
    write_safely(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))


def write_scene(path: Path, scene: Gaussians, footprint: str) -> None:
    """A 3DGS .ply. Unless it was trained with `point`, a comment tells viewers that pixels were integrated."""
    antialiased = resolve_footprint(footprint).name != "point"
    comments = ["SplatRenderMode: mip"] if antialiased else []
    write_safely(path, lambda temporary: io.save_scene(temporary, scene, comments))


def write_cameras(path: Path, views: list[io.View]) -> None:
    """3DGS's cameras.json, which viewers and `io.load_views` read."""
    entries = []
    for i, view in enumerate(views):
        c2w = torch.linalg.inv(view.w2c)
        entry = {"id": i, "img_name": view.name, "width": view.width, "height": view.height}
        entry |= {"position": c2w[:3, 3].tolist(), "rotation": c2w[:3, :3].tolist(), "fx": view.fx, "fy": view.fy}
        entry |= {key: getattr(view, key) for key in ("cx", "cy") if getattr(view, key) is not None}
        entries.append(entry)
    write_json(path, entries)


def write_checkpoint(path: Path, state: dict[str, Any]) -> None:
    write_safely(path, lambda temporary: torch.save({"format": CHECKPOINT_FORMAT, **state}, temporary))


def read_checkpoint(path: Path, device: str | torch.device = "cpu", mapped: bool = False) -> dict[str, Any]:
    """What `write_checkpoint` wrote. Raises io.SceneError for a file that is missing or something else.

    Args:
        mapped: Leave tensors in the file until they are read, for who needs a part of them; on the CPU.
    """
    if not path.is_file():
        raise io.SceneError(f"{path}: no such file; there is no training to resume")
    try:
        state = torch.load(path, map_location=device, weights_only=True, mmap=mapped)
    except Exception as error:  # torch.load raises a different type for every way in which a file can be broken
        raise io.SceneError(f"{path}: not a checkpoint, or cut short ({type(error).__name__})") from None
    if not isinstance(state, dict) or state.get("format") != CHECKPOINT_FORMAT:
        found = state.get("format") if isinstance(state, dict) else type(state).__name__
        raise io.SceneError(f"{path}: expected a checkpoint of format {CHECKPOINT_FORMAT}, got {found}")
    return state
