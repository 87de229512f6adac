"""OpenUSD with ParticleField3DGaussianSplat (from 26.03): .usd, .usda, .usdc, and .usdz to be read.

Every such prim holds Gaussians: scales and opacities as they are, quaternions, and for each Gaussian its harmonics one
after the other. The transforms of prims, and a z-axis that is up, are applied. Stages are written y-up. usd-core reads
and writes. Schema: openusd.org/release/user_guides/schemas/usdVol/ParticleField3DGaussianSplat.html.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .errors import SceneError, naming, optional_import, unreadable
from .turning import Z_UP_TO_Y_UP, joined, placed

PRIM = "ParticleField3DGaussianSplat"
OWN = "analytic_rasterizer"  # the key of customLayerData that holds lines, those of a .ply's comments
LARGEST_DEGREE = 3
HARMONICS = "radiance:sphericalHarmonics"


def pxr(name: str) -> Any:
    """A module of usd-core. Raises ImportError, which names the extra that installs it."""
    return optional_import(f"pxr.{name}", "usd")


def read_usd(path: Path) -> dict[str, np.ndarray]:
    """The parameters of all Gaussians of the stage, by the names of the fields of `Gaussians`, y-up.

    Opacities of 0 and 1 are moved by 1e-6, as their logits are infinite.

    Raises SceneError, which names the file, for a broken one or for what is not read; ImportError without usd-core.
    """
    usd, geometry = pxr("Usd"), pxr("UsdGeom")
    with naming(path), unreadable():
        stage = usd.Stage.Open(str(path))
        up = Z_UP_TO_Y_UP if geometry.GetStageUpAxis(stage) == "Z" else np.eye(4)
        cache = geometry.XformCache()
        # USD multiplies rows by matrices from the right.
        parts = [
            placed(_gaussians(prim), up @ np.array(cache.GetLocalToWorldTransform(prim)).T)
            for prim in stage.Traverse()
            if prim.GetTypeName() == PRIM
        ]
        if not parts:
            raise SceneError(f"its stage has no {PRIM}")
        return joined(parts)


def _gaussians(prim) -> dict[str, np.ndarray]:
    """Those of a prim, as they are stored: in float, or else in half."""

    def numbers(name: str, width: int) -> np.ndarray:
        for attribute in (prim.GetAttribute(name), prim.GetAttribute(f"{name}h")):
            if attribute and attribute.Get() is not None:
                return np.array(attribute.Get(), np.float32).reshape(-1, width)
        raise SceneError(f"{prim.GetPath()}: missing attribute {name}")

    means = numbers("positions", 3)
    degree = prim.GetAttribute(f"{HARMONICS}Degree").Get()
    if not 0 <= degree <= LARGEST_DEGREE:
        raise SceneError(f"harmonics must have degree 0 to {LARGEST_DEGREE}, got {degree}")
    count, bands = len(means), (degree + 1) ** 2
    shs = numbers(f"{HARMONICS}Coefficients", 3)[: count * bands].reshape(count, bands, 3)
    opacities = numbers("opacities", 1).astype(np.float64)
    opacities = np.where(opacities <= 0, 1e-6, np.where(opacities >= 1, 1 - 1e-6, opacities))
    with np.errstate(divide="ignore", invalid="ignore"):  # a scale of 0 has the logarithm -inf, a negative one NaN
        log_scales = np.log(numbers("scales", 3).astype(np.float64))
    fields = {
        "means": means,
        "log_scales": log_scales,
        "rotations": numbers("orientations", 4)[:, [3, 0, 1, 2]],  # an array of USD has x, y, z, w
        "logit_opacities": np.log(opacities / (1 - opacities)),
        "shs": shs,
    }
    if len({len(field) for field in fields.values()}) != 1:
        raise SceneError(f"{prim.GetPath()}: attributes must have one length")
    return fields


def read_lines(path: Path) -> list[str]:
    """The lines that `write_usd` wrote. Raises SceneError, which names the file; ImportError without usd-core."""
    usd = pxr("Usd")
    with naming(path), unreadable():
        stage = usd.Stage.Open(str(path))  # kept, or its metadata is gone
        lines = (stage.GetMetadata("customLayerData") or {}).get(OWN, [])
        return [line for line in lines if isinstance(line, str)]


def write_usd(temporary: Path, fields: dict[str, np.ndarray], lines: Sequence[str]) -> None:
    """Writes a .usd, .usda or .usdc.

    Args:
        temporary: The file, see `write_safely`.
        fields: As from `read_usd`, float32 and finite but for scales of 0, with unit quaternions.
        lines: Text for customLayerData.

    Raises OSError, and ImportError without usd-core.
    """
    usd, geometry, volumes, arrays = (pxr(name) for name in ("Usd", "UsdGeom", "UsdVol", "Vt"))
    stage = usd.Stage.CreateNew(str(temporary))
    geometry.SetStageUpAxis(stage, "Y")
    geometry.SetStageMetersPerUnit(stage, 1.0)
    splat = volumes.ParticleField3DGaussianSplat.Define(stage, "/Splat")
    stage.SetDefaultPrim(splat.GetPrim())
    vectors = lambda field: arrays.Vec3fArray.FromNumpy(np.ascontiguousarray(field, np.float32).reshape(-1, 3))  # noqa: E731
    means, scales = fields["means"], np.exp(fields["log_scales"].astype(np.float64))
    rotations = np.ascontiguousarray(fields["rotations"][:, [1, 2, 3, 0]], np.float32)
    opacities = 1 / (1 + np.exp(-fields["logit_opacities"][:, 0].astype(np.float64)))
    splat.CreatePositionsAttr(vectors(means))
    splat.CreateScalesAttr(vectors(scales))
    splat.CreateOrientationsAttr(arrays.QuatfArray.FromNumpy(rotations))
    splat.CreateOpacitiesAttr(arrays.FloatArray.FromNumpy(opacities.astype(np.float32)))
    splat.CreateRadianceSphericalHarmonicsDegreeAttr(int(np.sqrt(fields["shs"].shape[1])) - 1)
    splat.CreateRadianceSphericalHarmonicsCoefficientsAttr(vectors(fields["shs"]))
    reach = 3 * scales.max(1, keepdims=True)  # standard deviations, as 3DGS draws them
    splat.CreateExtentAttr(vectors(np.stack([(means - reach).min(0), (means + reach).max(0)])))
    stage.GetRootLayer().customLayerData = {OWN: arrays.StringArray(list(lines))} if lines else {}
    if not stage.GetRootLayer().Save():
        raise OSError("usd-core could not write it")
