"""The .splat format: 32 bytes for each Gaussian, and nothing else.

Scales and positions are float32; colours, opacities and quaternions have 8 bits a number. There is no header, so that a
file holds neither harmonics beyond degree 0 nor metadata. The format is that of antimatter15's viewer.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..gaussians import SH_C0
from .errors import SceneError

ROW = np.dtype([("means", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("rotations", "u1", 4)])
OTHERS = {b"ply\n": ".ply", b"ply\r": ".ply", b"\x1f\x8b\x08": ".spz", b"NGSP": ".spz", b"PK\x03\x04": ".sog"}
"""How files of other formats begin, which would be read as numbers where their size is a multiple of a row's."""


def read_splat(path) -> dict[str, np.ndarray]:
    """The parameters of a .splat, by the names of the fields of `Gaussians`; harmonics have degree 0.

    An opacity of 0 or 1 is kept off these by 1e-6, where its logit is infinite.

    Raises SceneError, which names the file, for a size that is no multiple of 32 bytes, and OSError.
    """
    content = Path(path).read_bytes()
    if other := next((name for start, name in OTHERS.items() if content.startswith(start)), None):
        raise SceneError(f"{path}: a {other}, and no .splat: rename it")
    if len(content) % ROW.itemsize:
        raise SceneError(f"{path}: cut short: expected a multiple of {ROW.itemsize} bytes, got {len(content)}")
    rows = np.frombuffer(content, ROW)
    rgba = rows["rgba"].astype(np.float64) / 255
    opacities = rgba[:, 3:].clip(1e-6, 1 - 1e-6)
    with np.errstate(divide="ignore", invalid="ignore"):  # a scale of 0 has the logarithm -inf, a negative one NaN
        log_scales = np.log(rows["scales"])
    return {
        "means": rows["means"],
        "log_scales": log_scales,
        "rotations": (rows["rotations"].astype(np.float32) - 128) / 128,
        "logit_opacities": np.log(opacities / (1 - opacities)),
        "shs": (rgba[:, None, :3] - 0.5) / SH_C0,
    }


def to_splat(fields: dict[str, np.ndarray]) -> bytes:
    """The content of a .splat.

    Args:
        fields: As from `read_splat`, finite but for scales of 0, with unit quaternions. Of the harmonics degree 0 is
            written, and colours are clamped to [0, 1].
    """
    rows = np.zeros(len(fields["means"]), ROW)
    rows["means"] = fields["means"]
    rows["scales"] = np.exp(fields["log_scales"])
    with np.errstate(over="ignore"):
        opacities = 1 / (1 + np.exp(-fields["logit_opacities"].astype(np.float64)))
    colors = 0.5 + SH_C0 * fields["shs"][:, 0].astype(np.float64)
    rows["rgba"] = np.rint(255 * np.concatenate([colors, opacities], 1)).clip(0, 255)
    rows["rotations"] = np.rint(128 * fields["rotations"] + 128).clip(0, 255)
    return rows.tobytes()
