"""Mip-Splatting: (color, radii), and the third column of means2D's gradient is the sum over pixels of |gx| + |gy|.

Repositories: autonomousvision/mip-splatting, TRELLIS. `kernel_size` is the variance of the filter, px^2.
Deviates: `subpixel_offset` must be the same for all pixels, so pixels cannot be jittered one by one.
"""

from __future__ import annotations

import weakref

import torch

from ..checks import check_tensors
from ..footprints import COMPENSATED, Footprint
from ..render.autocast import widened
from ._base import FIELDS, GaussianRasterizer, _resolved, rasterize_gaussians
from ._base import GaussianRasterizationSettings as Settings
from ._later import LaterFlags

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer", "rasterize_gaussians"]

_LOOKS = 8
"""On CUDA, where looking at an offset waits for the device, one is taken for zero after so many that were. A later call
raises if it was not."""
_looks_left = _LOOKS  # infinite once one was not zero
_not_zero = LaterFlags()  # of offsets that were taken for zero: whether they were not

# By id of a tensor of offsets: a reference to it, its version, and the offset that all pixels have. Looking a tensor up
# in torch's WeakTensorKeyDictionary takes ten times as long, a fifth of what a call of the dialect may take.
_known: dict[int, tuple[weakref.ref, int | None, tuple[float, float]]] = {}


class GaussianRasterizationSettings(Settings):
    """Those of 3DGS 2023, with `kernel_size`, px^2, and `subpixel_offset` (H, W, 2), px, after tanfovy."""

    dialect = "mip"
    repositories = ("Mip-Splatting", "TRELLIS")
    fields = (*FIELDS[:4], "kernel_size", "subpixel_offset", *FIELDS[4:])
    optional = {"subpixel_offset": None}  # noqa: RUF012
    inferred_from = ("kernel_size", "subpixel_offset")
    filter = COMPENSATED
    means2d_z = "sum_abs"

    def own_footprint(self) -> Footprint:
        return _resolved(COMPENSATED, variance=float(self.kernel_size))

    def render(self, *arguments, **further) -> tuple:
        """As 3DGS 2023. `subpixel_offset` moves the centres of the pixels, all of them alike.

        Raises:
            TypeError: subpixel_offset is neither a tensor nor None.
            ValueError: subpixel_offset has another shape, or differs from pixel to pixel; or that of an earlier call
                was not zero, see `_offset_of`.
        """
        _raise_for_an_earlier_call()
        settings = self
        if self.subpixel_offset is not None:
            check_tensors(None, subpixel_offset=self.subpixel_offset)
            offset = _offset_of(self.subpixel_offset, (self.image_height, self.image_width, 2), self.debug)
            if offset != (0.0, 0.0):
                settings = self._moved(*offset)
        return super(GaussianRasterizationSettings, settings).render(*arguments, **further)

    def _moved(self, x: float, y: float) -> GaussianRasterizationSettings:
        """These settings with a principal point that is moved by (-x, -y) px, which moves pixels by (x, y)."""
        column = widened(self.projmatrix).reshape(4, 4).unbind(1)
        moved = (
            column[0] - 2 * x / self.image_width * column[3],
            column[1] - 2 * y / self.image_height * column[3],
        )
        return self._replace(projmatrix=torch.stack([*moved, *column[2:]], 1))


def _offset_of(offset: torch.Tensor, shape: tuple[int, int, int], debug: bool) -> tuple[float, float]:
    """The offset that all pixels have, px.

    A tensor is looked at once, and again after it was changed. On CUDA looking waits for the device, and programs make
    a new tensor of zeros in every frame: once `_LOOKS` tensors were zero and none was not, further ones there are taken
    for zero, but for debug. The device is asked whether they are, and `_raise_for_an_earlier_call` looks at its answer.

    Raises:
        ValueError: It has another shape, not all pixels have the same, or it would have to be looked at while a CUDA
            graph is captured.
    """
    global _looks_left
    version = None if offset.is_inference() else offset._version  # a tensor of inference mode has no version
    key = id(offset)
    known = _known.get(key)
    if version is not None and known is not None and known[0]() is offset and known[1] == version:
        return known[2]
    if tuple(offset.shape) != shape:
        raise ValueError(f"subpixel_offset must have shape {shape}, got {tuple(offset.shape)}")
    if _looking_waits(offset):
        if torch.cuda.is_current_stream_capturing():
            raise ValueError(
                "subpixel_offset must be None while a CUDA graph is captured, for it cannot be looked at then, got a "
                "tensor that is new or was changed"
            )
        if _looks_left <= 0 and not debug:
            _not_zero.send(offset.detach().any())  # of NaN, too
            return 0.0, 0.0
    low, high = torch.stack(offset.detach().reshape(-1, 2).aminmax(dim=0)).tolist()
    if low != high:
        _looks_left = float("inf")
        raise ValueError(
            "subpixel_offset must be the same for all pixels, for dialect mip does not move pixels one by one "
            f"(ray_jitter), got x from {low[0]} to {high[0]} and y from {low[1]} to {high[1]}"
        )
    x, y = low
    _looks_left = float("inf") if (x, y) != (0.0, 0.0) else _looks_left - 1
    _known[key] = weakref.ref(offset, lambda _, forget=_known.pop: forget(key, None)), version, (x, y)
    return x, y


def _looking_waits(offset: torch.Tensor) -> bool:
    """Whether the host has to wait for the device before it can read the tensor."""
    return offset.is_cuda


def _raise_for_an_earlier_call() -> None:
    """Raises ValueError if an offset that was taken for zero was not. Waits for nothing."""
    global _looks_left
    if _not_zero.any_set():
        _looks_left = float("inf")
        raise ValueError(
            f"subpixel_offset of an earlier call was not zero, which was not waited for after {_LOOKS} that were: that "
            "call was rendered without it. Further offsets are looked at at once; with debug=True all are"
        )
