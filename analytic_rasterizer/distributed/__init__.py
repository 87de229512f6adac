"""Gaussians sharded over the ranks of torch.distributed: no rank holds all of them.

`rasterize` renders the cameras of a step, each on the rank that owns it; `rasterize_bands` one camera, each rank a band
of its rows. docs/internals/distributed.md has the method and how much is sent.
"""

from .bands import Band, rasterize_bands
from .cameras import Batch, Rendering, rasterize
from .rows import OwnSplats

__all__ = ["Band", "Batch", "OwnSplats", "Rendering", "rasterize", "rasterize_bands"]
