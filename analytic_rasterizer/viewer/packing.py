"""A scene in the form that the page reads: one JSON object and two arrays of numbers.

Also which footprints the page can draw, and the camera with which it begins where a scene has no views.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from typing import Any

import torch

from .. import io
from ..cameras.rotations import rotation_matrices
from ..cameras.up import mean_up
from ..footprints import (
    DILATED,
    FASTEST,
    NEAREST_TO_EXACT,
    PAPER,
    RECOMMENDED,
    Footprint,
    footprint_variants,
    get_default_footprint,
    resolve_footprint,
    stated,
)
from ..gaussians import Gaussians
from .compact import LARGEST_HALF, compact_geometry, compact_harmonics

NEEDS_WEBGPU = ("moving", "cumulants")
"""kPage of footprints that WebGL 2 does not draw."""


def _page_entry(name: str) -> dict[str, Any]:
    """What the page needs to draw a footprint; see `PackedScene.meta`."""
    footprint = resolve_footprint(name)
    of_header, samples = stated(footprint), footprint.samples
    text = f"{footprint.name}, {samples} sample{'s' * (samples > 1)}" if ":" in name else name
    return {
        "name": name,
        "text": text,
        "family": footprint.name,
        "is_default": of_header["is_default"],
        "kind": of_header["page"],
        "samples": samples,
        "variance": of_header["variance"],
        "option": of_header["option"] if of_header["value"] is None else None,
        "instead": FASTEST if samples > 1 or of_header["page"] in NEEDS_WEBGPU else None,
    }


PAGE_ENTRIES = tuple(entry for name in footprint_variants() if (entry := _page_entry(name))["kind"] is not None)
PAGE_FOOTPRINTS = tuple(entry["name"] for entry in PAGE_ENTRIES)
"""What the page can draw. Options that are numbers may have any value."""

MAX_SH_DEGREE = 3
GEOMETRY_WIDTH = 12
"""Numbers of a Gaussian in `PackedScene.geometry`."""
Z_IS_UP = 3.0
"""How much more than y, in what faces it and in flatness together, the axis z must have to be up; see `upright`."""
PICTURE = 0.95
"""The part of a picture, by area, that faces its viewer."""
DOWN = math.radians(15)
"""How far a camera without views looks down: it stands above the floor."""
MARGIN = 1.3
"""How much larger than the scene's radius the picture of such a camera is."""
DEFAULT_SIZE = (1280, 720)
DEFAULT_FOCAL = 1100.0  # px: a vertical field of view of 36 degrees in a picture of the default size


@dataclass(frozen=True)
class PackedScene:
    """What the page needs of a scene.

    Attributes:
        meta: JSON: name, count, sh_degree, footprint, background, views (each with name, width, height, fx, fy, cx, cy
            in pixels, the 16 numbers of w2c by rows, and whether it has a lens), center and radius (of most of the
            Gaussians, world units), and up (a unit vector). `compact` is null, or the unit of the scales of a compact
            scene; `photographs` are the numbers of views with a photograph, which a server has. `footprints` is what
            the page offers: name, text for people, family (the name without options) and whether it is the family's
            default, kind (kPage of its header), samples, variance of its Gaussians [px^2], and the name of its option
            where that is another variance. `instead` is what is drawn while the camera moves, and where there is no
            WebGPU; null: the footprint itself. `compared` are names of footprints that the key C compares with: the
            first that can be drawn and is not chosen. An exported file adds `compressed` (`compressed.py`).
        geometry: float32, little endian, 12 numbers per Gaussian: mean, opacity, scales, 0, unit quaternion (w, x, y,
            z).
        harmonics: float16, little endian. Per Gaussian the coefficients of spherical harmonics, each as (r, g, b),
            filled up with zeros to a multiple of four numbers.

    Both are smaller where the scene is compact; see `compact.py`.
    """

    meta: dict
    geometry: bytes
    harmonics: bytes

    def meta_json(self) -> bytes:
        """`meta` as UTF-8."""
        return json.dumps(self.meta, allow_nan=False).encode()


class PageFootprintError(ValueError):
    """A footprint that the page cannot draw."""


def page_footprint(footprint: Footprint) -> str:
    """The footprint as the page writes it, such as `box:samples=4`.

    Raises:
        PageFootprintError: The page cannot draw it.
    """
    if stated(footprint)["page"] is None:
        known = ", ".join(PAGE_FOOTPRINTS)
        raise PageFootprintError(f"footprint must be one that the viewer can draw ({known}), got {footprint}")
    if str(footprint) in PAGE_FOOTPRINTS:
        return str(footprint)
    is_number = stated(footprint)["value"] is None  # other options concern gradients only
    return str(footprint) if is_number and footprint != resolve_footprint(footprint.name) else footprint.name


def nearest_page_footprint(footprint: Footprint) -> Footprint:
    """The footprint itself where the page can draw it, otherwise the nearest that it can (docs/accuracy.md)."""
    try:
        page_footprint(footprint)
        return footprint
    except PageFootprintError:
        return resolve_footprint(NEAREST_TO_EXACT)


def pack_scene(
    scene: Gaussians,
    views: list[io.View] | None = None,
    *,
    name: str = "scene",
    footprint: str | None = None,
    background=(0.0, 0.0, 0.0),
    compact: bool = False,
) -> PackedScene:
    """Brings a scene into the form that the page reads.

    Args:
        scene: Gaussians, on any device.
        views: Cameras to jump to. Without any there is one, which sees most of the scene.
        name: What the page calls the scene.
        footprint: One of `PAGE_FOOTPRINTS`; None takes the library's default.
        background: (r, g, b) in [0, 1].
        compact: Half of the memory, for WebGPU only: harmonics of 8 bits, rotations of 10.

    Raises:
        ValueError: A scene without Gaussians or with numbers that are not finite, harmonics beyond degree 3, or a
            footprint that the page cannot draw.
    """
    count = len(scene.means)
    if count == 0:
        raise ValueError(f"{name}: the scene has no Gaussians")
    if scene.sh_degree > MAX_SH_DEGREE:
        raise ValueError(f"{name}: the viewer draws spherical harmonics up to degree 3, got {scene.sh_degree}")
    chosen = get_default_footprint() if footprint is None else resolve_footprint(footprint)
    chosen_name = page_footprint(chosen)
    for field in ("means", "scales", "rotations", "opacities", "shs"):
        if not bool(getattr(scene, field).isfinite().all()):
            raise ValueError(f"{name}: {field} must be finite")

    scene = scene.to("cpu")
    unit = None
    if compact:
        geometry, unit = compact_geometry(scene, _unit_quaternions(scene.rotations))
        harmonics = compact_harmonics(scene)
    else:
        geometry, harmonics = _geometry(scene), _harmonics(scene)

    center, radius = extent(scene)
    if views:
        up = mean_up(views).tolist()
    else:
        axis, ahead, down = upright(scene, center, radius)
        views, up = [overview(center, radius, axis, ahead, down)], axis.tolist()
    meta = {
        "name": name,
        "count": count,
        "sh_degree": scene.sh_degree,
        "compact": unit,
        "footprint": chosen_name,
        "footprints": list(PAGE_ENTRIES),
        "compared": [DILATED, RECOMMENDED, PAPER],
        "background": [float(value) for value in background],
        "views": [_view_entry(view) for view in views],
        "photographs": [],
        "center": center.tolist(),
        "radius": radius,
        "up": up,
    }
    return PackedScene(meta, geometry, harmonics)


def _geometry(scene: Gaussians) -> bytes:
    geometry = torch.zeros(len(scene.means), GEOMETRY_WIDTH, dtype=torch.float32, device="cpu")
    geometry[:, 0:3] = scene.means
    geometry[:, 3:4] = scene.opacities
    geometry[:, 4:7] = scene.scales
    geometry[:, 8:12] = _unit_quaternions(scene.rotations)
    return geometry.numpy().astype("<f4").tobytes()


def _harmonics(scene: Gaussians) -> bytes:
    count, used = len(scene.means), 3 * (scene.sh_degree + 1) ** 2
    harmonics = torch.zeros(count, -(-used // 4) * 4, dtype=torch.float16, device="cpu")
    harmonics[:, :used] = scene.shs.reshape(count, -1)[:, :used].clamp(-LARGEST_HALF, LARGEST_HALF)
    return harmonics.numpy().astype("<f2").tobytes()


def _unit_quaternions(rotations: torch.Tensor) -> torch.Tensor:
    """Quaternions of any length, normalised; zero becomes the identity, as in the rasterizer."""
    wide = rotations.double()
    length = wide.norm(dim=1, keepdim=True)
    identity = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=torch.float64, device="cpu")
    return torch.where(length > 0, wide / length.clamp_min(torch.finfo(torch.float64).tiny), identity).float()


def extent(scene: Gaussians) -> tuple[torch.Tensor, float]:
    """Centre and radius of most of the Gaussians that can be seen; far outliers are left out."""
    visible = scene.means[scene.opacities[:, 0] > 0.05]
    means = (visible if len(visible) else scene.means).double()
    means = means[:: max(1, len(means) // 100_000)]
    center = means.median(dim=0).values
    distance = (means - center).norm(dim=1)
    largest = scene.scales.max().item() if len(scene.means) == 1 else 0.0
    return center, max(distance.quantile(0.8).item(), 2 * largest, 1e-3)


def upright(scene: Gaussians, center: torch.Tensor, radius: float) -> tuple[torch.Tensor, torch.Tensor, float]:
    """The directions, float64 (3,), that are probably up in a scene and away from a viewer who stands before it, and
    the angle by which this viewer looks down, from above the floor.

    Two conventions are common: -y is up where photographs were taken (COLMAP), +z in models (Blender). Scenes in which
    z is up are flat along z, and have their floors across it. What faces z everywhere is a picture: it hangs, and is
    looked at from -z.
    """
    step = max(1, len(scene.means) // 100_000)
    means, scales, opacities = scene.means[::step].double(), scene.scales[::step].double(), scene.opacities[::step]
    # Rows y and z of the rotations: column k is what axis k of a Gaussian has of that direction.
    _, of_y, of_z = rotation_matrices(_unit_quaternions(scene.rotations[::step]).double(), unit=True).unbind(1)
    thinnest = scales.argmin(dim=1, keepdim=True)
    small, middle, large = scales.sort(dim=1).values.unbind(1)
    near = (means - center).norm(dim=1) < 1.5 * radius
    axes = torch.eye(3, dtype=torch.float64, device="cpu")
    if not near.any():
        return -axes[1], axes[2], 0.0
    area = near * opacities[:, 0].double() * middle * large * (1 - small / middle.clamp_min(1e-30))
    facing_y, facing_z = ((area * rows.gather(1, thinnest)[:, 0] ** 2).sum() for rows in (of_y, of_z))
    spread_y, spread_z = (
        (means[near, k].quantile(0.9) - means[near, k].quantile(0.1)).clamp_min(1e-6 * radius) for k in (1, 2)
    )
    is_picture = facing_z > PICTURE * area.sum()
    if not is_picture and facing_z * spread_y > Z_IS_UP * facing_y * spread_z:
        return axes[2], axes[1], DOWN
    return -axes[1], axes[2], 0.0 if is_picture else DOWN


def overview(center: torch.Tensor, radius: float, up: torch.Tensor, ahead: torch.Tensor, angle: float) -> io.View:
    """A camera that looks at the centre with most of the scene in the picture: along `ahead`, and down by an angle.

    Args:
        center, up, ahead: (3,), the last two of length 1 and orthogonal.
        radius: World units.
        angle: Radians.
    """
    width, height = DEFAULT_SIZE
    forward = math.cos(angle) * ahead - math.sin(angle) * up
    down = -math.sin(angle) * ahead - math.cos(angle) * up
    w2c = torch.eye(4, dtype=torch.float64, device="cpu")
    w2c[:3, :3] = torch.stack([torch.linalg.cross(down, forward), down, forward])
    w2c[:3, 3] = -w2c[:3, :3] @ center
    w2c[2, 3] += MARGIN * 2 * radius * DEFAULT_FOCAL / height + 0.2
    return io.View("overview", width, height, DEFAULT_FOCAL, DEFAULT_FOCAL, w2c)


def _view_entry(view: io.View) -> dict:
    entry = {key: getattr(view, key) for key in ("name", "width", "height", "fx", "fy")}
    entry["lens"] = view.lens is not None  # the page has pinholes, and says so
    entry["cx"], entry["cy"] = view.middle
    return entry | {"w2c": view.w2c.flatten().tolist()}
