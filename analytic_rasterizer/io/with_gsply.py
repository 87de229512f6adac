"""Gaussians from and to gsply, which packs the bits of compressed formats. It is imported on first use."""

from __future__ import annotations

from typing import Any

import numpy as np

from .errors import optional_import


def gsply() -> Any:
    """The module. Raises ImportError, which names the extra that installs it."""
    return optional_import("gsply")


def fields_of(data) -> dict[str, np.ndarray]:
    """The parameters in gsply's container, by the names of the fields of `Gaussians`."""
    base = data.sh0[:, None]
    has_more = data.shN is not None and data.shN.size
    return {
        "means": data.means,
        "log_scales": data.scales,
        "rotations": data.quats,
        "logit_opacities": data.opacities.reshape(-1, 1),
        "shs": np.concatenate([base, data.shN], 1) if has_more else base,
    }


def data_of(fields: dict[str, np.ndarray]):
    """gsply's container of such parameters, float32."""
    return gsply().GSData.from_arrays(
        means=fields["means"],
        scales=fields["log_scales"],
        quats=fields["rotations"],
        opacities=fields["logit_opacities"].reshape(-1),
        sh0=fields["shs"][:, 0],
        shN=fields["shs"][:, 1:],
        format="ply",
    )
