"""What gsplat's `rasterization` returns beside the images: rows of splats, as `meta` holds them."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import torch

from ..._C import ALPHA_MIN
from ...footprints import COMPENSATED, DILATED, Footprint
from ...stages import Splats
from .arguments import Sizes

_EXTENT = 3.33  # standard deviations in gsplat's radii at most: there an opacity of 1 has fallen to ALPHA_MIN
# px^2, of a square pixel. The weight of every footprint but `point` and `mip` is an integral over the pixel, whatever
# its samples. Around the mean its covariance is that of the Gaussian plus this (tests/test_gsplat.py measures it). Its
# peak is below 1, which the radii leave out: they are bounds.
_PIXEL_VARIANCE = 1 / 12
_LARGEST_RADIUS = 1e9  # px, fits an int32

ROWS = ("means2d", "cov2d", "opacities", "depths", "colors", "radii", "gaussian_ids", "camera_ids", "dets")
"""Fields of `Splats` with a row per splat; colors may have none."""


@dataclass(frozen=True)
class Measures:
    """What `meta` says of splats beside what they are. Without gradient, a row per splat.

    Attributes:
        drawn: (R,) bool, whether gsplat would draw it.
        radii: (R, 2) int32, px; 0 where it is not drawn.
        conics: (R, 3), 1/px^2.
        opacities: (R,).
    """

    drawn: torch.Tensor
    radii: torch.Tensor
    conics: torch.Tensor
    opacities: torch.Tensor


@torch.no_grad()
def measure(
    splats: Splats, footprint: Footprint, radius_clip: float, depths: tuple[float, float] | None = None
) -> Measures:
    """Radii by gsplat's definition: half the width and height, in whole px, of the ellipse where alpha is 1/255.

    A splat whose rectangle misses the image is not drawn, as in gsplat. This hides nothing: the centre of the nearest
    pixel is half a pixel further away, so that alpha is below 1/255 there also where the weight is an integral over
    the pixel.

    Args:
        depths: What is not between these is not drawn; None: `project` has looked at it.
    """
    variance = footprint.option if footprint.name in (DILATED, COMPENSATED) else _PIXEL_VARIANCE
    xx, xy, yy = splats.cov2d.unbind(1)
    det = splats.dets + variance * (xx + yy) + variance**2  # without the cancellation of computing it from entries
    xx, yy = xx + variance, yy + variance
    conics = torch.stack([yy / det, -xy / det, xx / det], 1)
    opacities = splats.opacities
    if footprint.name == COMPENSATED:
        opacities = opacities * (splats.dets / det).sqrt()
    extent = (2 * (opacities / ALPHA_MIN).log()).clamp(min=0).sqrt().clamp(max=_EXTENT)
    rx, ry = ((extent * v.sqrt()).ceil().clamp(max=_LARGEST_RADIUS) for v in (xx, yy))
    x, y = (splats.means2d + 0.5).unbind(1)
    on_image = (x + rx > 0) & (x - rx < splats.width) & (y + ry > 0) & (y - ry < splats.height)
    drawn = on_image & (rx > 0) & (ry > 0) & ((rx > radius_clip) | (ry > radius_clip))
    if depths is not None:
        drawn &= (splats.depths > depths[0]) & (splats.depths < depths[1])
    radii = torch.where(drawn[:, None], torch.stack([rx, ry], 1), 0).int()
    return Measures(drawn, radii, conics, opacities)


def without_culled(splats: Splats, measures: Measures) -> tuple[Splats, Measures]:
    """Only what is drawn. Waits for the device."""
    kept = measures.drawn.nonzero()[:, 0]
    before = torch.nn.functional.pad(measures.drawn.cumsum(0), (1, 0))  # rows kept before each row
    row_splits = before[splats.row_splits.to(before.device)].cpu()
    rows = {name: getattr(splats, name) for name in ROWS}
    rows = {name: values.index_select(0, kept) if len(values) else values for name, values in rows.items()}
    measured = (getattr(measures, field.name).index_select(0, kept) for field in dataclasses.fields(measures))
    return dataclasses.replace(splats, row_splits=row_splits, **rows), Measures(*measured)


@dataclass(frozen=True)
class Layout:
    """How `meta` holds rows: as they are, or in a table with a place for every Gaussian in every camera.

    Attributes:
        shape: (..., C, N) of the table.
        places: (R,) int64, where in the flattened table each row is; None: packed.
    """

    shape: tuple[int, ...]
    places: torch.Tensor | None

    @classmethod
    def of(cls, splats: Splats, sizes: Sizes, packed: bool) -> Layout:
        """For the rows of `splats`."""
        places = None if packed else splats.camera_ids.long() * sizes.gaussians + splats.gaussian_ids.long()
        return cls((*sizes.batch, sizes.cameras, sizes.gaussians), places)

    def to_meta(self, rows: torch.Tensor) -> torch.Tensor:
        """Rows as `meta` holds them, zero where there is none."""
        if self.places is None:
            return rows
        table = rows.new_zeros(math.prod(self.shape), *rows.shape[1:])
        return table.index_copy(0, self.places, rows).reshape(*self.shape, *rows.shape[1:])

    def to_rows(self, held: torch.Tensor) -> torch.Tensor:
        """The rows of what `to_meta` made."""
        if self.places is None:
            return held
        return held.flatten(0, len(self.shape) - 1).index_select(0, self.places)


class KeepAbsolute(torch.autograd.Function):
    """Passes means2d on, with a second tensor that takes the sums of absolute gradients for `means2d.absgrad`."""

    @staticmethod
    def forward(ctx, means2d: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """means2d, and zeros."""
        ctx.means2d = means2d
        return means2d.view_as(means2d), torch.zeros_like(means2d)

    @staticmethod
    def backward(ctx, dL_dmeans2d: torch.Tensor, absolute: torch.Tensor) -> torch.Tensor:
        """The gradient of means2d as it came; the other one becomes the attribute."""
        ctx.means2d.absgrad = absolute
        return dL_dmeans2d
