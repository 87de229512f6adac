"""Gaussian splatting with every Gaussian integrated over the pixel, not sampled at its centre.

A drop-in replacement for `diff_gaussian_rasterization`. Where to look:

- `Gaussians`, `View`: what is rendered, and from where (docs/library.md).
- `GaussianRasterizationSettings`, `GaussianRasterizer`: rendering, with the interface of 3DGS 2023.
- `FOOTPRINTS`, `set_default_footprint`, `footprint_weight`: the weight of a Gaussian in a pixel (docs/footprints.md).
- `Effects`, `Outputs`, `Lens`, `Defocus`, `Motion`, `camera_settings`: depth, alpha, cameras (docs/effects.md).
- `project`, `list_tiles`, `blend`: the three stages of a rendering, each on its own (docs/library.md).
- `losses`, `activations`, `optim`: the other parts of a training step (docs/losses.md).
- `density`: how many Gaussians there are, in a training loop of one's own (docs/density.md).
- `inspect_scene`, `plan`: what a scene calls for (docs/command-line.md).

In modules of their own: `training`, `distributed`, `viewer`, `analysis`, `dialects` and `io` (docs/).
"""

import torch  # noqa: F401  (its libraries must be loaded before the extension's)

from .installation import warn_if_built_for_another, warn_if_replaced, why_not_loaded

try:
    from ._C import BUILT_FOR, TILE, instruction_set
except ImportError as error:
    raise ImportError(why_not_loaded(error)) from error

from . import _old_names, activations, density, losses, optim
from .analysis.planner import SceneReport, inspect_scene, plan
from .cameras.camera import View, camera_settings, moved
from .cameras.lens import Lens
from .filters import apply_3d_filter, bake_dilation, bake_pixel, compute_3d_filter
from .footprints import (
    FOOTPRINTS,
    Footprint,
    footprint_weight,
    get_default_footprint,
    resolve_footprint,
    set_default_footprint,
)
from .gaussians import Gaussians
from .relocation import compute_relocation
from .render.effects import Defocus, Effects, GaussianStats, Motion, Outputs
from .render.outputs import normalized
from .render.rasterizer import GaussianRasterizer, rasterize_gaussians
from .render.settings import GaussianRasterizationSettings
from .render.stages import Splats, Stages, TileLists, blend, list_tiles, project, render_stages
from .sh import needed_sh_degree

__version__ = "0.2.0"

__all__ = [
    "FOOTPRINTS",
    "TILE",
    "Defocus",
    "Effects",
    "Footprint",
    "GaussianRasterizationSettings",
    "GaussianRasterizer",
    "GaussianStats",
    "Gaussians",
    "Lens",
    "Motion",
    "Outputs",
    "SceneReport",
    "Splats",
    "Stages",
    "TileLists",
    "View",
    "activations",
    "apply_3d_filter",
    "bake_dilation",
    "bake_pixel",
    "blend",
    "camera_settings",
    "compute_3d_filter",
    "compute_relocation",
    "density",
    "footprint_weight",
    "get_default_footprint",
    "inspect_scene",
    "instruction_set",
    "list_tiles",
    "losses",
    "moved",
    "needed_sh_degree",
    "normalized",
    "optim",
    "plan",
    "project",
    "rasterize_gaussians",
    "render_stages",
    "resolve_footprint",
    "set_default_footprint",
]

_old_names.keep(__name__)
warn_if_built_for_another(BUILT_FOR)
warn_if_replaced()
