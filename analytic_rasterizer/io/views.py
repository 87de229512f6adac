"""Files of views: JSON in three forms."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from ..cameras.camera import View
from .errors import SceneError, check_content, first_line
from .images import opened_picture
from .lenses import SPHERICAL, lens_from_json, lens_of_transforms, lens_to_json, model_name, sphere_of
from .pictures import PictureFiles
from .writing import write_json, write_text

SIZE, FOCAL = {"w", "h"}, {"fl_x", "camera_angle_x"}  # of an entry of a transforms file


def load_views(path, size: tuple[int, int] | None = None) -> list[View]:
    """Reads the cameras of the JSON file `path`, in any of three forms:

    - 3DGS `cameras.json`: a list of {id, img_name, width, height, position, rotation, fx, fy} with
      the camera-to-world rotation;
    - Blender or nerfstudio `transforms.json`: {frames: [{file_path, transform_matrix}]}, camera to
      world with OpenGL axes; camera_angle_x, or fl_x with fl_y, cx, cy, or the matrix K; w, h; globally or by frame;
    - a list of {width, height, fx, fy, w2c} with w2c world-to-camera, 16 numbers by rows or 4 x 4.

    cx, cy are optional everywhere (the image spans [0, width]; the centre is width / 2). The first and the last may
    have `offset`, which positions are relative to, see `View`, and `lens`: {model, coefficients}, as of `Lens`. The
    second may have a lens by camera_model and k1, k2, ... as nerfstudio has, globally or by frame. Views of a
    transforms file that states no image size have `size` = (width, height), or that of their pictures; where a picture
    is missing, that of the first that exists.

    Raises:
        SceneError: Something is missing, malformed, not finite or not positive, or the list is empty. The message names
            the file and the entry.
    """
    return read_views(path, size)[0]


def read_views(path, size: tuple[int, int] | None = None) -> tuple[list[View], Any]:
    """What `load_views` returns, with the content of the file. Raises as that does."""
    path = Path(path)
    if path.is_dir():
        raise SceneError(
            f"{path}: expected a file of views, got a folder",
            "of a capture, io.save_views(FILE, [item.view for item in training.load_capture(FOLDER).train]) writes one",
        )
    check_content(path)
    try:
        data = json.loads(path.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise SceneError(f"{path}: {error.strerror}") from None
    except (ValueError, RecursionError) as error:
        raise SceneError(f"{path}: not valid JSON: {first_line(error)}") from None
    try:
        views = _views(data, path.parent, size)
    except SceneError as error:
        raise error.within(path) from None
    return with_distinct_names(views), data


def save_views(path, views: list[View]) -> None:
    """Writes `views` to the file `path`, as the plain list of `load_views`.

    Raises:
        OSError: It cannot be written. An earlier file is then unchanged.
    """
    entries = [{"name": view.name, **_camera(view), "w2c": view.w2c.flatten().tolist()} for view in views]
    write_text(path, json.dumps(entries, indent=1) + "\n")


def write_cameras(path, views: list[View]) -> None:
    """Writes `views` to the file `path`, as 3DGS's cameras.json, which viewers read. Raises as `save_views`."""
    entries = []
    for i, view in enumerate(views):
        c2w = torch.linalg.inv(view.w2c)
        pose = {"position": c2w[:3, 3].tolist(), "rotation": c2w[:3, :3].tolist()}
        entries.append({"id": i, "img_name": view.name, **pose, **_camera(view)})
    write_json(path, entries)


def _camera(view: View) -> dict[str, Any]:
    """What is not the pose. Programs that do not know `offset` and `lens` leave them unread."""
    entry = {key: getattr(view, key) for key in ("width", "height", "fx", "fy")}
    entry |= {key: getattr(view, key) for key in ("cx", "cy", "offset") if getattr(view, key) is not None}
    return entry if view.lens is None else entry | {"lens": lens_to_json(view.lens)}


def _views(data, folder: Path, size) -> list[View]:
    if isinstance(data, dict) and "frames" in data:
        frames = _entries(data["frames"], "frames")
        sizes = [size] * len(frames)
        if size is None and not SIZE & data.keys():
            sizes = _picture_sizes(folder, frames)
        return [_transforms_view(i, frame, data, size) for i, (frame, size) in enumerate(zip(frames, sizes))]
    if not isinstance(data, list):
        raise SceneError(f"expected a list of views or an object with 'frames', got {_kind(data)}")
    return [_listed_view(i, entry) for i, entry in enumerate(_entries(data, "the list of views"))]


def _entries(data, name: str) -> list[dict]:
    if not isinstance(data, list) or not data:
        got = "an empty list" if data == [] else _kind(data)
        raise SceneError(f"{name} must be a list with at least one view, got {got}")
    for i, entry in enumerate(data):
        if not isinstance(entry, dict):
            raise SceneError(f"view {i} must be an object, got {_kind(entry)}")
    return data


def _listed_view(i: int, entry: dict) -> View:
    """A view of cameras.json or of the plain list."""
    where = f"view {i}"
    if "w2c" in entry:
        w2c = checked_pose(entry["w2c"], f"{where}: w2c")
    elif "rotation" in entry:
        w2c = torch.eye(4, dtype=torch.float64, device="cpu")
        w2c[:3, :3] = _numbers(entry["rotation"], (3, 3), f"{where}: rotation").T
        position = _numbers(_get(entry, "position", where), (3,), f"{where}: position")
        w2c[:3, 3] = -w2c[:3, :3] @ position
        _check_rotation(w2c, f"{where}: rotation")
    else:
        raise SceneError(f"{where}: expected 'w2c', or 'rotation' and 'position', got {', '.join(entry) or '{}'}")
    name = entry.get("img_name", entry.get("name", ""))
    return View(
        name=_picture_name(name, i),
        width=checked_pixels(_get(entry, "width", where), f"{where}: width"),
        height=checked_pixels(_get(entry, "height", where), f"{where}: height"),
        fx=checked_positive(_get(entry, "fx", where), f"{where}: fx"),
        fy=checked_positive(_get(entry, "fy", where), f"{where}: fy"),
        w2c=w2c,
        cx=_optional(entry, "cx", where),
        cy=_optional(entry, "cy", where),
        offset=None if entry.get("offset") is None else checked_offset(entry["offset"], f"{where}: offset"),
        lens=None if entry.get("lens") is None else lens_from_json(entry["lens"], f"{where}: lens"),
    )


def _transforms_view(i: int, frame: dict, shared: dict, size) -> View:
    where = f"frame {i}"
    entry = shared | frame  # a frame's own intrinsics go before the shared ones
    if "fl_x" not in frame and ("K" in frame or ("K" in shared and not FOCAL & entry.keys())):
        entry |= _of_matrix(entry["K"], f"{where}: K")
    lens = lens_of_transforms(entry, where)
    if "w" in entry or "h" in entry:
        width = checked_pixels(_get(entry, "w", where), f"{where}: w")
        height = checked_pixels(_get(entry, "h", where), f"{where}: h")
    elif size is not None:
        width, height = (checked_pixels(number, "size") for number in size)
    else:
        raise SceneError(
            f"{where}: no image size: expected 'w' and 'h', a picture at 'file_path', or a size given by the caller",
            "--size W H gives it",
        )
    if model_name(entry) == SPHERICAL:
        intrinsics = sphere_of(width, height)
    else:
        fx = _focal(entry, "fl_x", "camera_angle_x", width, where)
        if fx is None:
            raise SceneError(f"{where}: expected 'fl_x', 'camera_angle_x' or 'K'")
        fy = _focal(entry, "fl_y", "camera_angle_y", height, where)
        intrinsics = {"fx": fx, "fy": fx if fy is None else fy}
        intrinsics |= {name: _optional(entry, name, where) for name in ("cx", "cy")}
    matrix = f"{where}: transform_matrix"
    c2w = checked_pose(_get(entry, "transform_matrix", where), matrix)
    c2w[:3, 1:3] *= -1  # OpenGL looks along -z with y up
    return View(
        name=_picture_name(entry.get("file_path", ""), i),
        width=width,
        height=height,
        w2c=torch.linalg.inv(c2w),
        lens=lens,
        **intrinsics,
    )


def _of_matrix(value, where: str) -> dict[str, float]:
    """fl_x, fl_y, cx and cy of a matrix K, px, by rows or 9 numbers. Raises SceneError, which begins with `where`."""
    flat = isinstance(value, list) and len(value) == 9
    (fx, skew, cx), (below, fy, cy), last = _numbers(value, (9,) if flat else (3, 3), where).reshape(3, 3).tolist()
    if skew or below or last != [0, 0, 1]:
        raise SceneError(f"{where} must be fx 0 cx, 0 fy cy, 0 0 1 by rows, got {_shorten(value)}")
    return {"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy}


def _focal(entry: dict, length: str, angle: str, extent: int, where: str) -> float | None:
    """Focal length in pixels, from itself or from the angle that `extent` pixels span."""
    if length in entry:
        return checked_positive(entry[length], f"{where}: {length}")
    if angle not in entry:
        return None
    value = checked_positive(entry[angle], f"{where}: {angle}")
    if value >= math.pi:
        raise SceneError(f"{where}: {angle} must be below pi (radians), got {value}")
    return extent / (2 * math.tan(value / 2))


def _picture_sizes(folder: Path, frames: list[dict]) -> list[tuple[int, int] | None]:
    """Sizes of the pictures of frames that state none; of those that do not exist, that of the first that does, or
    None."""
    files = PictureFiles(folder)
    sizes = [None if SIZE & frame.keys() else _picture_size(files, frame.get("file_path")) for frame in frames]
    usual = next((size for size in sizes if size is not None), None)
    return [usual if size is None else size for size in sizes]


def _picture_size(files: PictureFiles, name) -> tuple[int, int] | None:
    picture = files.find(name) if isinstance(name, str) else None
    if picture is None or not picture.is_file():
        return None
    with opened_picture(picture) as opened:
        return opened.size


def _picture_name(name, i: int) -> str:
    """A file name without directory and picture suffix, whatever the views file says."""
    if isinstance(name, str):
        last = re.split(r"[/\\]", name)[-1]
        last = re.sub(r"\.(png|jpe?g|webp|exr|tiff?|bmp|avif)$", "", last, flags=re.IGNORECASE)
        last = re.sub(r"[^\w.-]+", "_", last).strip(".")
        if last:
            return last
    return f"view_{i:03d}"


def with_distinct_names(views: list[View]) -> list[View]:
    """Appends _2, _3, ... to names met before, so that no picture overwrites another."""
    taken: set[str] = set()
    for i, view in enumerate(views):
        name, n = view.name, 1
        while name in taken:
            n += 1
            name = f"{view.name}_{n}"
        taken.add(name)
        views[i] = replace(view, name=name)
    return views


def checked_pose(value, where: str) -> torch.Tensor:
    """A rigid transform of a file: 4 x 4, or 16 numbers by rows. Raises SceneError, which begins with `where`."""
    flat = isinstance(value, list) and len(value) == 16
    pose = _numbers(value, (16,) if flat else (4, 4), where).reshape(4, 4)
    if not torch.allclose(pose[3], pose.new_tensor([0, 0, 0, 1]), atol=1e-4):
        raise SceneError(f"{where}: the last row must be 0 0 0 1, got {pose[3].tolist()}")
    _check_rotation(pose, where)
    return pose


def _check_rotation(pose: torch.Tensor, where: str) -> None:
    rotation = pose[:3, :3]
    error = (rotation @ rotation.T - torch.eye(3, dtype=pose.dtype, device=pose.device)).abs().max().item()
    if error <= 1e-2 and torch.linalg.det(rotation) < 0:
        raise SceneError(
            f"{where} must hold a rotation, got a mirrored one (determinant -1): {rotation.tolist()}",
            "one axis of the camera or of the world has the wrong sign, or two are swapped",
        )
    if error > 1e-2:  # files are rounded to a few digits
        raise SceneError(f"{where} must hold a rotation, got {rotation.tolist()}")


def _numbers(value, shape: tuple[int, ...], where: str) -> torch.Tensor:
    """A nested list of finite numbers as a float64 tensor of exactly this shape."""

    def fits(part, shape) -> bool:
        if not shape:
            return _is_number(part)
        return isinstance(part, list) and len(part) == shape[0] and all(fits(item, shape[1:]) for item in part)

    if not fits(value, shape):
        size = " x ".join(map(str, shape))
        raise SceneError(f"{where} must hold {size} finite numbers, got {_shorten(value)}")
    return torch.tensor(value, dtype=torch.float64, device="cpu")


def _is_number(value) -> bool:
    """A JSON number that float32 can hold, with room to multiply; not NaN, nor infinite."""
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) < 1e30


def checked_offset(value, where: str) -> tuple[float, float, float]:
    """Three finite numbers of a file. Raises SceneError, whose message begins with `where`."""
    return tuple(_numbers(value, (3,), where).tolist())


def checked_positive(value, where: str) -> float:
    """A positive number of a file. Raises SceneError, whose message begins with `where`."""
    if not _is_number(value) or value < 1e-6:
        raise SceneError(f"{where} must be a positive finite number, got {_shorten(value)}")
    return float(value)


def checked_pixels(value, where: str) -> int:
    """A width or height of a file, px. Raises SceneError, whose message begins with `where`."""
    if not _is_number(value) or value < 1 or value != int(value) or value > 2**20:
        raise SceneError(f"{where} must be a whole number from 1 to 2^20, got {_shorten(value)}")
    return int(value)


def _optional(entry: dict, key: str, where: str) -> float | None:
    value = entry.get(key)
    if value is not None and not _is_number(value):
        raise SceneError(f"{where}: {key} must be a finite number, got {_shorten(value)}")
    return value


def _get(entry: dict, key: str, where: str):
    if key not in entry:
        raise SceneError(f"{where}: missing '{key}', got {', '.join(entry) or '{}'}")
    return entry[key]


def _kind(value) -> str:
    kinds = {dict: "an object", list: "a list", str: "a string", type(None): "null"}
    return kinds.get(type(value), _shorten(value))


def _shorten(value) -> str:
    text = json.dumps(value)
    return text if len(text) <= 80 else f"{text[:77]}..."
