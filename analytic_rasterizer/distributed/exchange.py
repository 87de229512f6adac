"""Rows of splats on their way between ranks, and their gradients on the way back."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
import torch.distributed as dist
from torch.autograd.function import once_differentiable

from ..stages import Splats

DIFFERENTIABLE = ("means2d", "cov2d", "opacities", "depths", "colors")  # what a row that is sent holds
_FIXED = ("dets", "gaussian_ids")  # and what follows it
_ID_OF = {torch.float32: torch.int32, torch.float64: torch.int64}  # integers as wide as the numbers they travel among


@dataclass(frozen=True)
class Route:
    """Which rows go where.

    A rank sends the rows of the cameras of rank 0 first, then those of rank 1, and so on; of a rank camera after
    camera. What it receives it puts in the order of its cameras; of a camera rank after rank, which makes global ids
    ascend: `bin` draws splats of equal depth in this order.

    Attributes:
        counts: (ranks, cameras) rows that a rank has of a camera.
        cameras: The cameras of each rank.
    """

    counts: list[list[int]]
    cameras: list[list[int]]
    rank: int
    group: dist.ProcessGroup | None

    @property
    def sent(self) -> list[int]:
        """Rows for each rank."""
        return [sum(self.counts[self.rank][c] for c in cameras) for cameras in self.cameras]

    @property
    def received(self) -> list[int]:
        """Rows from each rank."""
        return [sum(of_rank[c] for c in self.cameras[self.rank]) for of_rank in self.counts]

    def forth(self, rows: torch.Tensor) -> torch.Tensor:
        """From the Gaussians to the cameras."""
        own = self.cameras[self.rank]
        received = self._send(rows, self.sent, self.received)
        return _transposed(received, [[of_rank[c] for c in own] for of_rank in self.counts])

    def back(self, rows: torch.Tensor) -> torch.Tensor:
        """From the cameras to the Gaussians."""
        own = self.cameras[self.rank]
        rows = _transposed(rows, [[of_rank[c] for of_rank in self.counts] for c in own])
        return self._send(rows, self.received, self.sent)

    def _send(self, rows: torch.Tensor, sent: list[int], received: list[int]) -> torch.Tensor:
        out = rows.new_empty(sum(received), rows.shape[1])
        dist.all_to_all_single(out, rows.contiguous(), received, sent, group=self.group)
        return out


def _transposed(rows: torch.Tensor, sizes: list[list[int]]) -> torch.Tensor:
    """Blocks of rows that lie as in `sizes`, row after row, brought into the order of its columns."""
    if len(sizes) < 2 or len(sizes[0]) < 2:
        return rows
    blocks = rows.split([size for line in sizes for size in line])
    width = len(sizes[0])
    return torch.cat([blocks[line * width + column] for column in range(width) for line in range(len(sizes))])


class _Exchange(torch.autograd.Function):
    """Sends rows to the owners of the cameras, and their gradients back.

    `absolute`, (n, 2) or None, is not sent: zeros stand for it at the owners, and their gradient comes back. `join` is
    a tensor that requires a gradient where any rank needs one, so that all take part in the way back.
    """

    @staticmethod
    def forward(
        ctx: Any,
        route: Route,
        rows: torch.Tensor,
        fixed: torch.Tensor,
        absolute: torch.Tensor | None,
        join: torch.Tensor | None,
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor | None]:
        ctx.route, ctx.absolute, ctx.columns = route, absolute is not None, rows.shape[1]
        received = route.forth(torch.cat([rows, fixed], 1))
        own, own_fixed = (t.contiguous() for t in received.split([rows.shape[1], fixed.shape[1]], 1))
        ctx.mark_non_differentiable(own_fixed)
        return own, own_fixed, rows.new_zeros(len(own), 2) if ctx.absolute else None

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, dL_drows: torch.Tensor, _: torch.Tensor, dL_dabsolute: torch.Tensor | None):
        gradients = torch.cat([dL_drows, dL_dabsolute], 1) if ctx.absolute else dL_drows
        returned = ctx.route.back(gradients)
        dL_drows, dL_dabsolute = returned[:, : ctx.columns], returned[:, ctx.columns :] if ctx.absolute else None
        return None, dL_drows, None, dL_dabsolute, None


def exchange(
    route: Route, shard: tuple[Splats, ...], absolute: tuple[torch.Tensor, ...], first_id: int, join: bool
) -> tuple[list[Splats], list[torch.Tensor] | None, torch.Tensor]:
    """The splats of all ranks for each camera of this one, what stands for `absolute` there, and the anchor.

    Args:
        shard: The splats of this rank in each camera of the step; colors may have any number of channels, the same on
            all ranks.
        absolute: (n, 2) for each camera, or none.
        first_id: Global id of the first Gaussian of this rank.
        join: Whether any rank needs a gradient.
    """
    order = [c for cameras in route.cameras for c in cameras]
    dtype = shard[0].means2d.dtype
    differentiable = _widths(shard[0], DIFFERENTIABLE)
    rows = torch.cat([_columns(*(getattr(shard[c], name) for name in DIFFERENTIABLE)) for c in order])
    ids = [(shard[c].gaussian_ids.to(_ID_OF[dtype]) + first_id).view(dtype) for c in order]  # bits, never numbers
    fixed = torch.cat([_columns(shard[c].dets.detach(), i) for c, i in zip(order, ids)])
    own, own_fixed, own_absolute = _Exchange.apply(
        route,
        rows,
        fixed,
        torch.cat([absolute[c] for c in order]) if absolute else None,
        rows.new_zeros((), requires_grad=True) if join else None,
    )
    cameras = route.cameras[route.rank]
    sizes = [sum(of_rank[c] for of_rank in route.counts) for c in cameras]
    splats = []
    for camera, of_rows, of_fixed in zip(cameras, own.split(sizes), own_fixed.split(sizes)):
        columns = _named(of_rows, differentiable) | _named(of_fixed, _widths(shard[0], _FIXED))
        ids = columns["gaussian_ids"].view(_ID_OF[dtype]).int()
        of_camera = shard[camera]
        given = columns | {
            "gaussian_ids": ids,
            "camera_ids": torch.zeros_like(ids),
            "radii": ids.new_empty(0),
            "row_splits": torch.tensor([0, len(ids)]),
            **{name: getattr(of_camera, name) for name in ("width", "height", "footprint", "option")},
        }
        splats.append(Splats(**given))
    return splats, None if own_absolute is None else own_absolute.split(sizes), own[:0].sum()


def _widths(splats: Splats, names: tuple[str, ...]) -> dict[str, int | None]:
    """Columns of each; None: a vector."""
    return {name: (t.shape[1] if t.dim() == 2 else None) for name in names for t in [getattr(splats, name)]}


def _columns(*tensors: torch.Tensor) -> torch.Tensor:
    """(n, K) from columns (n,) and (n, k)."""
    return torch.cat([t[:, None] if t.dim() == 1 else t for t in tensors], 1)


def _named(rows: torch.Tensor, widths: dict[str, int | None]) -> dict[str, torch.Tensor]:
    """The opposite, by name."""
    columns = rows.split([1 if width is None else width for width in widths.values()], 1)
    return {name: (t[:, 0] if width is None else t).contiguous() for (name, width), t in zip(widths.items(), columns)}
