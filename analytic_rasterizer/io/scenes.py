"""Files of scenes: .ply, compressed .ply, .spz, .sog, .splat and glTF."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from ..gaussians import HIGHEST_LOGIT, SH_C0, Gaussians
from . import gltf, ply, sog, splat, spz, usd
from .axes import axes_of_format, axes_written, checked_axes, flipped, with_axes
from .compressed import is_compressed, read_compressed, to_compressed
from .errors import SceneError, first_line, naming
from .formats import SOG_META, check_harmonics, scene_file, suffix_of
from .metadata import SceneMetadata, read_axes
from .points import AXES as POSITION
from .points import has_colors, read_colors
from .sog_writer import write_sog
from .writing import write_safely

BASE_COLOR = ("f_dc_0", "f_dc_1", "f_dc_2")
SCALES, ROTATIONS = [f"scale_{i}" for i in range(3)], [f"rot_{i}" for i in range(4)]
PLY_COLUMNS = [*POSITION, *BASE_COLOR, "opacity", *SCALES, *ROTATIONS]
"""Properties that a vertex of a 3DGS .ply must have; harmonics beyond the constant follow as f_rest_0, f_rest_1, ..."""
WRITTEN = {
    ".ply": "ply",
    ".ply_compressed": "compressed",
    ".spz": "spz",
    ".sog": "sog",
    SOG_META: "sog",
    ".splat": "splat",
    ".glb": "glb",
    ".gltf": "gltf",
    ".usd": "usd",
    ".usda": "usd",
    ".usdc": "usd",
}
WRITTEN_IN_WORDS = ".ply, .compressed.ply, .spz, .sog, .splat, .glb, .gltf, .usd, .usda, .usdc or meta.json"
FILTER_3D = "filter_3D"  # of files of Mip-Splatting and of Analytic-Splatting, which only some of them want applied
LARGEST_SHIFT = 0.1  # of a Gaussian's size: rounding of positions beyond it is told


def load_scene(path, strict: bool = False, axes: str | None = None) -> Gaussians:
    """Reads a scene from a file of one of these formats.

    A 3DGS .ply, a compressed .ply or .sog (PlayCanvas), an .spz (Niantic), a .splat, a glTF (.glb, .gltf), or OpenUSD
    with Gaussians (.usd, .usda, .usdc, .usdz).

    A .ply may be text or have either byte order, any types, and any other elements and properties. Red, green and blue
    are read where there are no harmonics, as those of degree 0.

    Gaussians that have a number that is not finite are left out, and a warning counts them. Another warning says where
    positions of double precision lose what matters in float32. The axes of the result are RDF: x right, y down,
    z forward (see `read_axes`).

    Args:
        path: The file. Its suffix, in any case, says which format it has.
        strict: Refuse a file with numbers that are not finite.
        axes: Those of the file, such as "rub", if it says nothing or not the truth; None: `read_axes` of it.

    Returns:
        float32, on the CPU. Scales of 0, and in a .ply opacities of 0 and 1, have infinite parameters.

    Raises:
        SceneError: The file is not there, or no scene, or cut short, or no Gaussian of it is finite. The message names
            the file.
        ValueError: Unknown axes.
        ImportError: The extra `cli` is missing, which formats other than .ply, .splat and glTF need, or `usd`.
    """
    path, kind = scene_file(path)
    axes = None if axes is None else checked_axes(axes)
    readers = {
        "ply": _read_ply,
        "spz": spz.read_spz,
        "sog": sog.read_sog,
        "splat": splat.read_splat,
        "gltf": gltf.read_gltf,
        "usd": usd.read_usd,
    }
    try:
        fields = flipped(readers[kind](path), axes or read_axes(path))
    except OSError as error:
        raise SceneError(f"{path}: unreadable ({error.strerror or first_line(error)})") from None
    scene = Gaussians(**{name: _tensor(field) for name, field in fields.items()})
    return _finite(path, scene, strict)


def _tensor(field: np.ndarray) -> torch.Tensor:
    """The field as a float32 tensor, copied where it has another type or cannot be changed."""
    with np.errstate(over="ignore"):  # what float32 does not hold becomes infinite, and is left out
        found = np.require(field, np.float32, ["C", "O", "W"])
    return torch.from_numpy(found)


def _finite(path: Path, scene: Gaussians, strict: bool) -> Gaussians:
    """The Gaussians all of whose numbers are finite."""
    good = torch.ones(scene.count, dtype=torch.bool, device="cpu")
    bad = {}
    for name, field in numbers_of(scene).items():
        if field.sum(dtype=torch.float64).isfinite():  # then all of them are: no sum of float32 leaves float64
            continue
        finite = field.flatten(1).isfinite().all(1)
        bad[name] = scene.count - int(finite.sum())
        good &= finite
    if not bad:
        return scene
    if strict or not good.any():
        name, number = next(iter(bad.items()))
        raise SceneError(f"{path}: {name} must be finite, got {number} of {scene.count} rows not")
    left_out = f"{scene.count - int(good.sum())} of {scene.count} Gaussians are left out"
    where = ", ".join(f"{name} of {number}" for name, number in bad.items())
    warnings.warn(f"{path}: {left_out}: {where} are not finite", stacklevel=3)
    return scene.rows(good)


def numbers_of(scene: Gaussians) -> dict[str, torch.Tensor]:
    """What must be finite: scales and opacities rather than their parameters, which may be infinite."""
    return {
        "means": scene.means,
        "scales": scene.scales,
        "rotations": scene.rotations,
        "opacities": scene.opacities,
        "shs": scene.shs,
    }


def _read_ply(path: Path) -> dict[str, np.ndarray]:
    """The parameters of a .ply, compressed or not. Raises SceneError, which names the file."""
    if is_compressed(ply.read_header(path)):
        return read_compressed(path)
    _, elements = ply.read_rows(path, ["vertex"])
    with naming(path):
        if "vertex" not in elements:
            raise SceneError("expected vertices, but the .ply has none; is it a 3DGS scene?")
        rows = elements["vertex"]
        colored = has_colors(rows) and not set(BASE_COLOR) & set(rows.names)
        missing = [name for name in PLY_COLUMNS if name not in rows.names and not (colored and name in BASE_COLOR)]
        if missing:
            raise SceneError(f"missing vertex properties {', '.join(missing)}; is it a 3DGS scene?")
        count = sum(name.startswith("f_rest_") for name in rows.names)
        check_harmonics(count)
        shs = np.empty((len(rows), 1 + count // 3, 3), np.float32)
        if colored:
            shs[:, 0] = (read_colors(rows) - 0.5) / SH_C0
        else:
            shs[:, 0] = rows.columns(BASE_COLOR, np.float32)
        # All bands of red come first, then those of green, then those of blue.
        rest = rows.columns([f"f_rest_{i}" for i in range(count)], np.float32)
        shs[:, 1:] = rest.reshape(len(rows), 3, count // 3).transpose(0, 2, 1)
        fields = {
            "means": rows.columns(POSITION),
            "log_scales": rows.columns(SCALES, np.float32),
            "rotations": rows.columns(ROTATIONS, np.float32),
            "logit_opacities": rows.columns(["opacity"], np.float32),
            "shs": shs,
        }
    _warn_of_rounding(path, fields["means"], fields["log_scales"])
    if FILTER_3D in rows.names:
        fused = "fuse it into the scales and opacities first, as Mip-Splatting's create_fused_ply.py does"
        warnings.warn(f"{path}: the column {FILTER_3D}, a 3D filter, is not applied: {fused}", stacklevel=4)
    return fields


def _warn_of_rounding(path: Path, means: np.ndarray, log_scales: np.ndarray) -> None:
    """Says where float32 moves Gaussians by more than their size allows."""
    if means.dtype == np.float32 or not len(means):
        return
    with np.errstate(over="ignore", invalid="ignore"):
        shift = np.abs(means - means.astype(np.float32)).max(1)
        moved = shift > LARGEST_SHIFT * np.exp(log_scales.max(1))
    if moved.mean() > 0.01:  # single specks are none of the scene's
        which = f"{int(moved.sum())} of {len(means)} Gaussians, by up to {shift[moved].max():.2g}"
        warnings.warn(f"{path}: float32 moves {which}: subtract an offset from the file's positions", stacklevel=4)


def written_format(path) -> str:
    """The format that `save_scene` writes under the name `path`: "ply", "compressed", "spz", "sog", "splat", "glb",
    "gltf" or "usd".

    Raises:
        SceneError: It writes none under this name.
    """
    path = Path(path)
    if path.name.lower().endswith(".compressed.ply"):
        return "compressed"
    if suffix_of(path) not in WRITTEN:
        raise SceneError(f"{path}: expected a {WRITTEN_IN_WORDS} name, got {path.suffix or 'no suffix'!r}")
    return WRITTEN[suffix_of(path)]


def save_scene(path, scene: Gaussians, metadata: SceneMetadata | None = None, axes: str | None = None) -> None:
    """Writes a scene as .ply, .compressed.ply, .spz (version 3), .sog (version 2), .splat, .glb, .gltf or
    .usd, by its name.

    A .ply holds the parameters as they are, but for infinite logits: opacities are then kept off 0 and 1 by 1e-6. The
    other formats round (docs/library.md says how), and hold unit quaternions. A .sog changes the order of the
    Gaussians; meta.json is an unbundled one, with pictures beside it. A .splat has no place for metadata and for
    harmonics beyond degree 0: where they matter a warning says what is lost.

    Args:
        path: The file, which is replaced once the new one is complete.
        scene: float32 or float64, on any device.
        metadata: What the file says beside the Gaussians, such as `SceneMetadata(footprint="moment")`.
        axes: Those of the file, such as "rub" with y up; None: those of other programs (see `read_axes`). `load_scene`
            turns the scene back, unless the file is a .splat, which does not say its axes.

    Raises:
        SceneError: Before a file is touched. Another suffix; tensors of other shapes than those of `Gaussians`;
            harmonics of degree 4 in an .spz, .sog, glTF or USD; no Gaussians in these but .spz; metadata or axes that
            cannot be written; in all formats but .ply numbers that are not finite, and in an .spz means beyond 2^22.
        TypeError: Before a file is touched. `scene` is no `Gaussians`, or `metadata` is something else.
        OSError: The file cannot be written; an earlier one is then unchanged.
        ImportError: The extra `cli` is missing, which .compressed.ply, .spz and .sog need, or `usd`.
    """
    path, kind = Path(path), written_format(path)
    if not isinstance(scene, Gaussians):
        raise TypeError(f"scene must be Gaussians, got {type(scene).__name__}")
    if not isinstance(metadata, (SceneMetadata, type(None))):
        raise TypeError(f"metadata must be a SceneMetadata or None, got {type(metadata).__name__}")
    try:
        metadata = (metadata or SceneMetadata()).checked()
        axes = axes_written(kind) if axes is None else checked_axes(axes)
    except (ValueError, TypeError) as error:
        raise SceneError(f"{path}: {first_line(error)}") from None
    scene = scene.map(lambda field: field.detach().to("cpu", torch.float32))
    scene = scene._replace(logit_opacities=scene.logit_opacities.reshape(-1, 1))
    with naming(path):
        _check(scene, kind)
    logits = scene.logit_opacities
    kept = logits.clamp(-HIGHEST_LOGIT, HIGHEST_LOGIT)
    fields = scene._replace(logit_opacities=torch.where(logits.isinf(), kept, logits))
    fields = flipped({name: field.numpy() for name, field in fields._asdict().items()}, axes)
    lines = _lines(kind, metadata, axes)
    if kind == "ply":
        columns, comments = _columns(fields), lines
        write_safely(path, lambda temporary: ply.write(temporary, "vertex", columns, comments))
        return
    fields["rotations"] = _unit(fields["rotations"])
    if kind == "compressed":
        content = to_compressed(fields, lines)
        write_safely(path, lambda temporary: temporary.write_bytes(content))
    elif kind in ("glb", "gltf"):
        with naming(path):
            content = gltf.to_gltf(fields, lines, kind == "glb")
        write_safely(path, lambda temporary: temporary.write_bytes(content))
    elif kind == "spz":
        with naming(path):
            spz.fractional_bits(fields["means"])  # raises
        write_safely(path, lambda temporary: spz.write_spz(temporary, fields, bool(metadata.antialiased), lines, axes))
    elif kind == "usd":
        usd.pxr("UsdVol")  # raises
        write_safely(path, lambda temporary: usd.write_usd(temporary, fields, lines))
    elif kind == "sog":
        write_sog(path, fields, metadata.antialiased, lines)
    else:
        content = splat.to_splat(fields)
        _warn_of_loss(path, scene, metadata, axes)
        write_safely(path, lambda temporary: temporary.write_bytes(content))


def _lines(kind: str, metadata: SceneMetadata, axes: str) -> list[str]:
    """The text of a file, with its axes where they are in doubt: in a format that this package wrote with others."""
    lines = (replace(metadata, antialiased=None) if kind in ("spz", "sog") else metadata).lines()  # which have a flag
    if kind == "spz":  # which says them by its own means
        return lines
    return with_axes(lines, axes) if kind in ("glb", "gltf") or axes != axes_of_format(kind) else lines


def _check(scene: Gaussians, kind: str) -> None:
    """What would be written without a word, into a file that cannot be read or holds other numbers."""
    count, bands = scene.count, (scene.sh_degree + 1) ** 2
    rows = {"means": (3,), "log_scales": (3,), "rotations": (4,), "logit_opacities": (1,), "shs": (bands, 3)}
    for name, row in rows.items():
        field = getattr(scene, name)
        if field.shape != (count, *row):
            raise SceneError(f"{name} must have shape {(count, *row)}, got {tuple(field.shape)}")
    if scene.sh_degree > 4 or (kind in ("spz", "sog", "glb", "gltf", "usd") and scene.sh_degree > 3):
        raise SceneError(f"harmonics of degree {scene.sh_degree} have no place in this format; a .ply holds degree 4")
    if kind in ("sog", "glb", "gltf", "usd") and not count:
        name = {"sog": ".sog", "usd": "USD"}.get(kind, "glTF")
        raise SceneError(f"a {name} has no place for a scene without Gaussians; a .ply has")
    for name, field in numbers_of(scene).items() if kind != "ply" else ():
        good = field.flatten(1).isfinite().all(1)
        if not good.all():
            raise SceneError(f"{name} must be finite, got {count - int(good.sum())} of {count} rows not")


def _columns(fields: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The columns of a .ply as 3DGS writes it, without normals: views of the fields."""
    shs = fields["shs"]
    # All bands of red come first, then those of green, then those of blue.
    rest = [shs[:, band, color] for color in range(3) for band in range(1, shs.shape[1])]
    columns = dict(zip(POSITION, fields["means"].T)) | dict(zip(BASE_COLOR, shs[:, 0].T))
    columns |= {f"f_rest_{i}": column for i, column in enumerate(rest)}
    columns["opacity"] = fields["logit_opacities"][:, 0]
    return columns | dict(zip(SCALES, fields["log_scales"].T)) | dict(zip(ROTATIONS, fields["rotations"].T))


def _unit(rotations: np.ndarray) -> np.ndarray:
    """Quaternions of length 1; zero becomes the identity, as in the rasterizer."""
    wide = rotations.astype(np.float64)
    length = np.linalg.norm(wide, axis=1, keepdims=True)
    identity = np.array([1.0, 0.0, 0.0, 0.0])
    return np.where(length > 0, wide / np.where(length > 0, length, 1), identity).astype(np.float32)


def _warn_of_loss(path: Path, scene: Gaussians, metadata: SceneMetadata, axes: str) -> None:
    """Says what a .splat cannot hold."""
    lost = metadata.lost()
    if axes != axes_of_format("splat"):
        lost.append(f"its axes ({axes})")
    if scene.shs[:, 1:].any():
        lost.append(f"harmonics beyond degree 0 (the scene has degree {scene.sh_degree})")
    if lost:
        warnings.warn(f"{path}: a .splat does not hold {', nor '.join(lost)}; a .ply does", stacklevel=3)
