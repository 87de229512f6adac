"""Gaussian splatting with every Gaussian integrated over the pixel, not sampled at its centre.

A drop-in replacement for `diff_gaussian_rasterization`. See the README for how to choose a footprint.
"""

import torch  # noqa: F401  (its libraries must be loaded before the extension's)

from ._C import instruction_set
from .analysis.planner import SceneReport, inspect_scene, plan
from .camera import moved
from .effects import Defocus, Effects, GaussianStats, Motion, Outputs, normalized
from .filters import apply_3d_filter, compute_3d_filter
from .footprints import (
    FOOTPRINTS,
    Footprint,
    footprint_weight,
    get_default_footprint,
    resolve_footprint,
    set_default_footprint,
)
from .io import camera_settings
from .ops import TILE
from .rasterizer import (
    GaussianRasterizationSettings,
    GaussianRasterizer,
    Stages,
    rasterize_gaussians,
    render_stages,
)
from .sh import needed_sh_degree

__version__ = "0.1.0"

__all__ = [
    "FOOTPRINTS",
    "TILE",
    "Defocus",
    "Effects",
    "Footprint",
    "GaussianRasterizationSettings",
    "GaussianRasterizer",
    "GaussianStats",
    "Motion",
    "Outputs",
    "SceneReport",
    "Stages",
    "apply_3d_filter",
    "camera_settings",
    "compute_3d_filter",
    "footprint_weight",
    "get_default_footprint",
    "inspect_scene",
    "instruction_set",
    "moved",
    "needed_sh_degree",
    "normalized",
    "plan",
    "rasterize_gaussians",
    "render_stages",
    "resolve_footprint",
    "set_default_footprint",
]
