"""Rows of splats on their way between ranks, and their gradients on the way back."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
import torch.distributed as dist
from torch.autograd.function import once_differentiable

from ..stages import Splats

DIFFERENTIABLE = ("means2d", "cov2d", "opacities", "depths", "colors")  # what a row that is sent holds
_FIXED = ("dets", "gaussian_ids")  # and what follows it
_PARTS = len(DIFFERENTIABLE) + len(_FIXED)
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

    @property
    def sizes(self) -> list[int]:
        """Rows of each camera of this rank, from all ranks."""
        return [sum(of_rank[c] for of_rank in self.counts) for c in self.cameras[self.rank]]

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

    Args:
        route: Whose cameras come in the order in which their rows are sent.
        absolute: Whether there are tensors for absolute gradients.
        join: A tensor that requires a gradient where any rank needs one, so that all take part in the way back.
        tensors: For each camera of the step those that DIFFERENTIABLE and _FIXED name; then of each camera one (n, 2)
            that takes absolute gradients. The latter are not sent: zeros stand for them at the owners, and their
            gradient comes back.

    Returns:
        The anchor, and the same tensors for each camera of this rank.
    """

    @staticmethod
    def forward(
        ctx: Any, route: Route, absolute: bool, join: torch.Tensor | None, *tensors: torch.Tensor
    ) -> tuple[torch.Tensor, ...]:
        ctx.set_materialize_grads(False)
        cameras = sum(map(len, route.cameras))
        blocks = [tensors[k * _PARTS : (k + 1) * _PARTS] for k in range(cameras)]
        shapes = [t.shape[1:] for t in blocks[0]]
        rows = route.forth(_packed(blocks, [len(block[0]) for block in blocks], shapes, tensors[0]))
        sizes = route.sizes
        own = [t.contiguous() for block in _unpacked(rows, sizes, shapes) for t in block]
        ctx.mark_non_differentiable(*(own[k] for k in range(len(own)) if k % _PARTS >= len(DIFFERENTIABLE)))
        ctx.route, ctx.like = route, rows.new_empty(0)
        ctx.shapes = [*shapes[: len(DIFFERENTIABLE)], *([torch.Size([2])] if absolute else [])]
        ctx.sent = [len(block[0]) for block in blocks]
        return rows.new_zeros(()), *own, *(rows.new_zeros(size, 2) for size in sizes if absolute)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, _: torch.Tensor | None, *gradients: torch.Tensor | None):
        own, count = len(ctx.route.sizes), len(DIFFERENTIABLE)
        blocks = [
            [*gradients[k * _PARTS : k * _PARTS + count], *gradients[own * _PARTS :][k : k + 1]] for k in range(own)
        ]
        rows = ctx.route.back(_packed(blocks, ctx.route.sizes, ctx.shapes, ctx.like))
        returned = _unpacked(rows, ctx.sent, ctx.shapes)
        given = [grad for block in returned for grad in (*block[:count], *[None] * len(_FIXED))]
        absolute = [grad for block in returned for grad in block[count:]]
        return None, None, None, *given, *absolute


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
    like = shard[0].means2d
    tensors = []
    for of_camera in (shard[c] for c in order):
        ids = of_camera.gaussian_ids.to(_ID_OF[like.dtype]) + first_id
        tensors += [getattr(of_camera, name) for name in DIFFERENTIABLE]
        tensors += [of_camera.dets.detach(), ids.view(like.dtype)]  # the bits of ids, never numbers
    joined = like.new_zeros((), requires_grad=True) if join else None
    anchor, *made = _Exchange.apply(route, bool(absolute), joined, *tensors, *(absolute[c] for c in order if absolute))
    splats, cameras = [], route.cameras[route.rank]
    for k, camera in enumerate(cameras):
        columns = dict(zip((*DIFFERENTIABLE, *_FIXED), made[k * _PARTS : (k + 1) * _PARTS]))
        ids = columns["gaussian_ids"].view(_ID_OF[like.dtype]).int()
        given = columns | {
            "gaussian_ids": ids,
            "camera_ids": torch.zeros_like(ids),
            "radii": ids.new_empty(0),
            "row_splits": torch.tensor([0, len(ids)]),
            **{name: getattr(shard[camera], name) for name in ("width", "height", "footprint", "option")},
        }
        splats.append(Splats(**given))
    return splats, made[len(cameras) * _PARTS :] if absolute else None, anchor


def _packed(
    blocks: list[Sequence[torch.Tensor | None]], sizes: list[int], shapes: list[torch.Size], like: torch.Tensor
) -> torch.Tensor:
    """Blocks of `sizes` rows one after the other, in each its tensors side by side; None: zeros."""
    widths = [shape.numel() for shape in shapes]
    rows = like.new_empty(sum(sizes), sum(widths))
    for block, of_block in zip(blocks, rows.split(sizes)):
        for tensor, column in zip(block, of_block.split(widths, 1)):
            column.zero_() if tensor is None else column.copy_(tensor.reshape(column.shape))
    return rows


def _unpacked(rows: torch.Tensor, sizes: list[int], shapes: list[torch.Size]) -> list[list[torch.Tensor]]:
    """The opposite: views of the rows."""
    widths = [shape.numel() for shape in shapes]
    return [
        [column if shape else column[:, 0] for column, shape in zip(of_block.split(widths, 1), shapes)]
        for of_block in rows.split(sizes)
    ]
