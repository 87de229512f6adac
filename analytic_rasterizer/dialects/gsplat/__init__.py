"""gsplat's `rasterization` over the stages of this package: its arguments, its returns, its `meta`.

    from analytic_rasterizer.dialects.gsplat import rasterization  # in place of gsplat's

or, in programs that stay as they are, before they import gsplat's:

    from analytic_rasterizer.dialects import gsplat
    gsplat.patch()

Only `patch` needs gsplat to be installed. What is served, what differs and what is refused: docs/gsplat.md.
"""

from __future__ import annotations

from .patching import compute_relocation, patch, quat_scale_to_covar_preci, rasterization_2dgs
from .rendering import RASTERIZE_MODES, RENDER_MODES, rasterization

__all__ = [
    "RASTERIZE_MODES",
    "RENDER_MODES",
    "compute_relocation",
    "patch",
    "quat_scale_to_covar_preci",
    "rasterization",
    "rasterization_2dgs",
]
