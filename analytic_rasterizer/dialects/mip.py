"""Mip-Splatting: (color, radii), and the third column of means2D's gradient is the sum over pixels of |gx| + |gy|.

Repositories: autonomousvision/mip-splatting, TRELLIS. `kernel_size` is the variance of the filter, px^2.
Deviates: `subpixel_offset` must be zero, so pixels cannot be jittered one by one.
"""

from __future__ import annotations

import torch

from ..footprints import Footprint
from ._base import FIELDS, GaussianRasterizer, _resolved, rasterize_gaussians
from ._base import GaussianRasterizationSettings as Settings

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer", "rasterize_gaussians"]

_seen: set = set()  # sizes and devices of offsets that were looked at


class GaussianRasterizationSettings(Settings):
    """Those of 3DGS 2023, with `kernel_size`, px^2, and `subpixel_offset` (H, W, 2), px, after tanfovy."""

    dialect = "mip"
    repositories = ("Mip-Splatting", "TRELLIS")
    fields = (*FIELDS[:4], "kernel_size", "subpixel_offset", *FIELDS[4:])
    optional = {"subpixel_offset": None}  # noqa: RUF012
    inferred_from = ("kernel_size", "subpixel_offset")
    filter = "mip"
    means2d_z = "sum_abs"

    def own_footprint(self) -> Footprint:
        return _resolved("mip", variance=float(self.kernel_size))

    def render(self, *arguments, **further) -> tuple:
        self._check_offset()
        return super().render(*arguments, **further)

    def _check_offset(self) -> None:
        """Raises ValueError unless subpixel_offset is zero.

        Looking at it on CUDA waits for the device: there it is looked at once per size, and always with debug=True.
        """
        offset = self.subpixel_offset
        if not isinstance(offset, torch.Tensor):
            return
        key = offset.shape, offset.device
        if offset.is_cuda and key in _seen and not self.debug:
            return
        if offset.any():
            raise ValueError("subpixel_offset must be zero: dialect mip does not move pixels one by one")
        _seen.add(key)
