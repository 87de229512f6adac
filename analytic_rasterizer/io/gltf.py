"""glTF with KHR_gaussian_splatting (Khronos): .glb, and .gltf with buffers inside or beside it.

Gaussians are points of a mesh, their numbers attributes of it: scales and opacities as they are, quaternions (x, y, z,
w). The axes are those of the file (see `axes`). What the extension leaves open, we do not interpret: it names no filter
of pixels.
"""

from __future__ import annotations

import base64
import json
import struct
from collections import deque
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
import torch

from ..cameras.rotations import rotation_matrices
from ..gaussians import SH_C0
from .axes import with_axes
from .errors import SceneError, naming, unreadable
from .turning import joined, placed

NAME = "KHR_gaussian_splatting"
KERNEL, COLORS = "ellipse", "srgb_rec709_display"
READ = (NAME, "KHR_mesh_quantization")  # extensions that a file may require
LARGEST_DEGREE = 3
MAGIC, JSON_CHUNK, BINARY_CHUNK = b"glTF", b"JSON", b"BIN\0"
HEADER, CHUNK = struct.Struct("<4sII"), struct.Struct("<I4s")
OWN = "analytic_rasterizer"  # the key of asset.extras that holds lines, those of a .ply's comments
TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5126: "<f4"}
SIGNED, UNSIGNED, ANY = (5126, 5120, 5122), (5126, 5121, 5123), tuple(TYPES)
WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
FEWEST_BYTES = 16  # of a Gaussian: what a file shows more often than that is refused, before memory is taken
AXES_BEFORE = "rub"  # of files of versions that did not write their axes


def read_gltf(path: Path) -> dict[str, np.ndarray]:
    """The parameters of all Gaussians that the scene shows, by the names of the fields of `Gaussians`.

    Opacities of 0 and 1 are moved by 1e-6, as their logits are infinite.

    Raises SceneError, which names the file, for a broken one or for what is not read, and OSError.
    """
    with naming(path), unreadable():
        return _Reader(path).fields()


def read_lines(path: Path) -> list[str]:
    """The lines that `to_gltf` wrote, with the axes of earlier versions. Raises SceneError, which names the file."""
    with naming(path), unreadable():
        asset = _Reader(path).json["asset"]
        extras = asset.get("extras")
        lines = extras.get(OWN) if isinstance(extras, dict) else None
        found = [line for line in lines if isinstance(line, str)] if isinstance(lines, list) else []
        return with_axes(found, AXES_BEFORE) if asset.get("generator") == OWN else found


class _Reader:
    """An open file. Whatever it lacks raises KeyError, IndexError or another error of Python."""

    def __init__(self, path: Path):
        self.path, self.binary = path, b""
        content = path.read_bytes()
        if content.startswith(MAGIC):
            content = self._chunks(content)
        self.json = json.loads(content.decode("utf-8-sig"))
        if not isinstance(self.json, dict) or not isinstance(self.json.get("asset"), dict):
            raise SceneError("not a glTF: it has no asset")
        if not str(self.json["asset"].get("version")).startswith("2."):
            raise SceneError(f"expected glTF 2, got version {self.json['asset'].get('version')!r}")
        self.buffers: dict[str | None, bytes] = {}  # by URI

    def _chunks(self, content: bytes) -> bytes:
        """The JSON of a .glb; keeps its binary part."""
        _, version, length = HEADER.unpack_from(content)
        if version != 2 or length > len(content):
            raise SceneError(f"expected glTF 2 of {length} bytes, got version {version} and {len(content)} bytes")
        chunks, start = {}, HEADER.size
        while start + CHUNK.size <= length:
            size, kind = CHUNK.unpack_from(content, start)
            start += CHUNK.size
            if start + size > length:
                raise SceneError(f"cut short: a chunk has {size} bytes, and {length - start} are left")
            chunks.setdefault(kind, content[start : start + size])
            start += size
        self.binary = chunks.get(BINARY_CHUNK, b"")
        return chunks[JSON_CHUNK]

    def fields(self) -> dict[str, np.ndarray]:
        for name in self.json.get("extensionsRequired", []):
            if name not in READ:
                raise SceneError(f"the extension {name} is not read")
        shown = [
            (matrix, primitive)
            for matrix, mesh in self._meshes()
            for primitive in self._item("meshes", mesh)["primitives"]
            if NAME in primitive.get("extensions", {})
        ]
        if not shown:
            raise SceneError(f"its scene shows no Gaussians: no mesh has the extension {NAME}")
        rows = sum(_natural(self._item("accessors", each["attributes"]["POSITION"]), "count") for _, each in shown)
        for index in range(len(self.json["buffers"])):
            self._buffer(index)
        size = sum(map(len, self.buffers.values()))
        if rows > size / FEWEST_BYTES:
            raise SceneError(f"cut short: {rows} Gaussians are too many for {size} bytes")
        parts = [placed(self._gaussians(primitive), matrix) for matrix, primitive in shown]
        return joined(parts)

    def _item(self, kind: str, index: Any) -> dict[str, Any]:
        if type(index) is not int or not 0 <= index < len(self.json[kind]):
            raise SceneError(f"it has no {kind}[{index}]")
        return self.json[kind][index]

    def _meshes(self) -> Iterator[tuple[np.ndarray, int]]:
        """Every mesh that the scene shows, with the (4, 4) matrix of its node."""
        nodes = self.json.get("nodes", [])
        if "scenes" in self.json:
            roots = self._item("scenes", self.json.get("scene", 0)).get("nodes", [])
        else:
            roots = sorted(set(range(len(nodes))) - {child for node in nodes for child in node.get("children", [])})
        waiting, seen = deque((np.eye(4), root) for root in roots), set()
        while waiting:
            above, index = waiting.popleft()
            node = self._item("nodes", index)
            if index in seen:
                raise SceneError(f"nodes[{index}] has two parents, or itself above it")
            seen.add(index)
            matrix = above @ _matrix(node)
            if "mesh" in node:
                yield matrix, node["mesh"]
            waiting += [(matrix, child) for child in node.get("children", [])]

    def _gaussians(self, primitive: dict[str, Any]) -> dict[str, np.ndarray]:
        """Those of a primitive, as they are stored."""
        extension, found = primitive["extensions"][NAME], primitive["attributes"]
        for name in extension.get("extensions", {}):
            raise SceneError(f"the extension {name} is not read")
        for name, wanted in (("kernel", KERNEL), ("colorSpace", COLORS)):
            if extension.get(name) != wanted:
                raise SceneError(f"{name} must be {wanted!r}, got {extension.get(name)!r}")
        if primitive.get("mode", 4) != 0:
            raise SceneError(f"Gaussians must be points (mode 0), got mode {primitive.get('mode', 4)}")
        degree = next(degree for degree in (3, 2, 1, 0) if f"{NAME}:SH_DEGREE_{degree}_COEF_0" in found or not degree)
        wanted = [("POSITION", "VEC3", ANY), (f"{NAME}:ROTATION", "VEC4", SIGNED), (f"{NAME}:SCALE", "VEC3", SIGNED)]
        wanted += [(f"{NAME}:OPACITY", "SCALAR", UNSIGNED)]
        wanted += [(name, "VEC3", SIGNED) for name in _harmonics(degree)]
        if missing := [name for name, *_ in wanted if name not in found]:
            raise SceneError(f"missing attributes {', '.join(missing)}")
        columns = [self._numbers(name, found[name], *kinds) for name, *kinds in wanted]
        if len({len(column) for column in columns}) != 1:
            raise SceneError("attributes must have one length")
        means, rotations, scales, opacities, *shs = columns
        opacities = opacities.astype(np.float64)
        opacities = np.where(opacities <= 0, 1e-6, np.where(opacities >= 1, 1 - 1e-6, opacities))
        with np.errstate(divide="ignore", invalid="ignore"):  # a scale of 0 has the logarithm -inf, a negative one NaN
            log_scales = np.log(scales.astype(np.float64))
        return {
            "means": means,
            "log_scales": log_scales,
            "rotations": rotations[:, [3, 0, 1, 2]],
            "logit_opacities": np.log(opacities / (1 - opacities)),
            "shs": np.stack(shs, 1),
        }

    def _numbers(self, name: str, index: Any, kind: str, types: Sequence[int]) -> np.ndarray:
        """The (rows, width) float numbers of an accessor."""
        accessor = self._item("accessors", index)
        if "sparse" in accessor or "bufferView" not in accessor:
            raise SceneError(f"{name}: a sparse accessor is not read")
        code = accessor["componentType"]
        if accessor["type"] != kind or code not in types:
            raise SceneError(f"{name}: expected {kind} of types {types}, got {accessor['type']} of {code}")
        view = self._item("bufferViews", accessor["bufferView"])
        for extension in view.get("extensions", {}):
            raise SceneError(f"{name}: the extension {extension} is not read")
        buffer = self._buffer(view["buffer"])
        dtype, count, begin = np.dtype(TYPES[code]), _natural(accessor, "count"), _natural(view, "byteOffset", 0)
        row = dtype.itemsize * WIDTHS[kind]
        stride, offset = _natural(view, "byteStride", row), _natural(accessor, "byteOffset", 0)
        room = min(_natural(view, "byteLength"), len(buffer) - begin)
        if count < 1 or stride < row or offset + (count - 1) * stride + row > room:
            raise SceneError(f"{name}: cut short: {count} rows, {stride} bytes apart, in {room - offset} bytes")
        shape, strides = (count, WIDTHS[kind]), (stride, dtype.itemsize)
        numbers = np.ndarray(shape, dtype, buffer, begin + offset, strides).astype(np.float32)
        if dtype.kind != "f" and accessor.get("normalized") is True:
            numbers = np.maximum(numbers / np.iinfo(dtype).max, -1)
        return numbers

    def _buffer(self, index: Any) -> bytes:
        entry = self._item("buffers", index)
        uri = entry.get("uri")
        if uri not in self.buffers:
            if uri is None:
                content = self.binary
            elif uri.startswith("data:"):
                content = base64.b64decode(uri.partition(";base64,")[2], validate=True)
            else:
                file = Path(unquote(uri))
                if file.name != str(file) or not (self.path.parent / file).is_file():
                    raise SceneError(f"expected a buffer in a file beside it, got {uri!r}")
                content = (self.path.parent / file).read_bytes()
            self.buffers[uri] = content
        found = self.buffers[uri]
        if len(found) < _natural(entry, "byteLength"):
            raise SceneError(f"cut short: buffers[{index}] has {len(found)} of {entry['byteLength']} bytes")
        return found


def _natural(entry: dict[str, Any], name: str, default: int | None = None) -> int:
    value = entry[name] if default is None else entry.get(name, default)
    if type(value) is not int or not 0 <= value < 1 << 53:
        raise SceneError(f"{name} must be a natural number, got {value!r}")
    return value


def _harmonics(degree: int) -> list[str]:
    return [f"{NAME}:SH_DEGREE_{band}_COEF_{i}" for band in range(degree + 1) for i in range(2 * band + 1)]


def _matrix(node: dict[str, Any]) -> np.ndarray:
    """The (4, 4) matrix of a node, to its parent's space."""
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    x, y, z, w = np.array(node.get("rotation", [0, 0, 0, 1]), np.float64)
    rotation = rotation_matrices(torch.tensor([w, x, y, z], dtype=torch.float64, device="cpu"), unit=True).numpy()
    matrix = np.eye(4)
    matrix[:3, :3] = rotation * np.array(node.get("scale", [1, 1, 1]), np.float64).reshape(3)
    matrix[:3, 3] = node.get("translation", [0, 0, 0])
    return matrix


def to_gltf(fields: dict[str, np.ndarray], lines: Sequence[str], binary: bool) -> bytes:
    """The content of a .glb, or of a .gltf that holds its buffer.

    Args:
        fields: As from `read_gltf`, finite but for scales of 0, at least one, with unit quaternions.
        lines: Text for asset.extras, with the line of its axes.
        binary: Whether it is a .glb.
    """
    opacities = 1 / (1 + np.exp(-fields["logit_opacities"].astype(np.float64)))
    degree = int(np.sqrt(fields["shs"].shape[1])) - 1
    columns = {
        "POSITION": fields["means"],
        f"{NAME}:ROTATION": fields["rotations"][:, [1, 2, 3, 0]],
        f"{NAME}:SCALE": np.exp(fields["log_scales"].astype(np.float64)),
        f"{NAME}:OPACITY": opacities,
    }
    columns |= {name: fields["shs"][:, i] for i, name in enumerate(_harmonics(degree))}
    columns = {name: np.ascontiguousarray(column, "<f4") for name, column in columns.items()}
    columns["COLOR_0"] = _fallback(fields["shs"][:, 0], opacities)
    views, accessors, start = [], [], 0
    for name, column in columns.items():
        kind = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}[column.shape[1]]
        views.append({"buffer": 0, "byteOffset": start, "byteLength": column.nbytes, "target": 34962})
        accessors.append({"bufferView": len(accessors), "componentType": 5126, "count": len(column), "type": kind})
        start += column.nbytes
        if name == "POSITION":
            accessors[-1] |= {"min": column.min(0).tolist(), "max": column.max(0).tolist()}
    accessors[-1] |= {"componentType": 5121, "normalized": True}
    content = b"".join(column.tobytes() for column in columns.values())
    primitive = {
        "mode": 0,
        "attributes": {name: i for i, name in enumerate(columns)},
        "extensions": {NAME: {"kernel": KERNEL, "colorSpace": COLORS}},
    }
    asset: dict[str, Any] = {"version": "2.0", "generator": OWN}
    if lines:
        asset["extras"] = {OWN: list(lines)}
    buffer: dict[str, Any] = {"byteLength": len(content)}
    if not binary:
        buffer["uri"] = "data:application/octet-stream;base64," + base64.b64encode(content).decode()
    text = {
        "asset": asset,
        "extensionsUsed": [NAME],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [buffer],
    }
    header = json.dumps(text, separators=(",", ":")).encode()
    if not binary:
        return header
    header += b" " * (-len(header) % 4)
    chunks = CHUNK.pack(len(header), JSON_CHUNK) + header + CHUNK.pack(len(content), BINARY_CHUNK) + content
    return HEADER.pack(MAGIC, 2, HEADER.size + len(chunks)) + chunks


def _fallback(base: np.ndarray, opacities: np.ndarray) -> np.ndarray:
    """Colours (N, 4) for programs that show points: linear, 8 bits, with opacity."""
    colors = (0.5 + SH_C0 * base.astype(np.float64)).clip(0, 1)
    linear = np.where(colors <= 0.04045, colors / 12.92, ((colors + 0.055) / 1.055) ** 2.4)
    return np.rint(255 * np.concatenate([linear, opacities], 1)).astype(np.uint8)
