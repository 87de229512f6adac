"""Sends splats of one camera to the ranks that blend its bands, and their gradients back: for `rasterize_bands`.

`Route`, which says which rows go where, serves rows.py too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import accumulate
from typing import Any

import torch
import torch.distributed as dist
from torch.autograd.function import once_differentiable

from ..render.stages import Splats

DIFFERENTIABLE = ("means2d", "cov2d", "opacities", "depths", "colors")  # what is sent of a splat
ID_OF = {torch.float32: torch.int32, torch.float64: torch.int64}  # integers as wide as the numbers they travel among


@dataclass(frozen=True)
class Route:
    """Which rows go where.

    A rank sends the rows of the cameras of rank 0 first, then those of rank 1, and so on; of a rank camera after
    camera. What it receives of a camera it puts in the order of the ranks, which makes global ids ascend: `list_tiles`
    draws splats of equal depth in this order.

    Attributes:
        counts: (ranks, cameras) rows that a rank has of a camera.
        cameras: The cameras of each rank.
    """

    counts: list[list[int]]
    cameras: list[list[int]]
    rank: int
    group: dist.ProcessGroup | None

    @property
    def order(self) -> list[int]:
        """The cameras in the order in which their rows are sent."""
        return [c for cameras in self.cameras for c in cameras]

    @property
    def own(self) -> list[int]:
        """The cameras of this rank."""
        return self.cameras[self.rank]

    @property
    def sizes(self) -> list[int]:
        """Rows of each camera of this rank, from all ranks."""
        return [sum(of_rank[c] for of_rank in self.counts) for c in self.own]

    def by_camera(self, received: torch.Tensor) -> torch.Tensor:
        """What this rank receives, rank after rank, in the order of its cameras, and in that of the ranks for each."""
        own = self.own
        if len(own) <= 1:
            return received
        blocks = received.split([of_rank[c] for of_rank in self.counts for c in own])
        return torch.cat([block for k in range(len(own)) for block in blocks[k :: len(own)]])

    def by_rank(self, rows: Sequence[torch.Tensor]) -> torch.Tensor:
        """The opposite: rows of each camera of this rank, of which it has one or more, in the order of the ranks."""
        if len(rows) == 1:
            return rows[0]
        blocks = [of_camera.split([n[c] for n in self.counts]) for c, of_camera in zip(self.own, rows)]
        return torch.cat([of_camera[rank] for rank in range(len(self.counts)) for of_camera in blocks])

    def rows(self, forth: bool) -> tuple[list[int], list[int]]:
        """How many this rank receives from each rank and sends to each, on the way to the cameras or back."""
        sent = [sum(self.counts[self.rank][c] for c in cameras) for cameras in self.cameras]
        received = [sum(of_rank[c] for c in self.own) for of_rank in self.counts]
        return (received, sent) if forth else (sent, received)

    def send(self, rows: torch.Tensor, forth: bool) -> torch.Tensor:
        """Sends a matrix of rows to the cameras or back, in whatever order within those for a rank."""
        received, sent = self.rows(forth)
        out = rows.new_empty(sum(received), rows.shape[1])
        kept, last = sent[self.rank], len(sent) - 1
        if self.rank not in (0, last):
            dist.all_to_all_single(out, rows, received, sent, group=self.group)
            return out
        # What stays, which lies at an end, is copied meanwhile: NCCL is slower at it.
        received[self.rank] = sent[self.rank] = 0
        at_start = self.rank == 0
        parts = [(t[:kept], t[kept:]) if at_start else (t[len(t) - kept :], t[: len(t) - kept]) for t in (out, rows)]
        (stays_to, comes), (stays, goes) = parts
        work = dist.all_to_all_single(comes, goes, received, sent, group=self.group, async_op=True)
        stays_to.copy_(stays)
        work.wait()
        return out


class _Exchange(torch.autograd.Function):
    """Sends rows to the owners of the cameras, and their gradients back.

    Args:
        join: A tensor that requires a gradient where any rank needs one, so that all take part in the way back.
        absolute: (n, 2) that takes absolute gradients, or (n, 0). It is not sent: zeros stand for it at the owners, and
            their gradient comes back.
        fixed: (n, 2) numbers that travel behind the columns and have no gradient.
        columns: Matrices of n rows, in the order in which they are sent, of k columns together.

    Returns:
        The anchor, (m, k + 2) rows of the cameras of this rank, and what stands for `absolute`.
    """

    @staticmethod
    def forward(
        ctx: Any,
        route: Route,
        join: torch.Tensor | None,
        absolute: torch.Tensor,
        fixed: torch.Tensor,
        *columns: torch.Tensor,
    ) -> tuple[torch.Tensor, ...]:
        received = route.by_camera(route.send(torch.cat([*columns, fixed], 1), True))
        ctx.route, ctx.widths = route, [t.shape[1] for t in columns]
        return fixed.new_zeros(()), received, fixed.new_zeros(len(received), absolute.shape[1])

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, _: torch.Tensor, dL_drows: torch.Tensor, dL_dabsolute: torch.Tensor):
        gradient = torch.cat([dL_drows[:, : sum(ctx.widths)], dL_dabsolute], 1)
        returned = ctx.route.send(ctx.route.by_rank(gradient.split(ctx.route.sizes)), False)
        *columns, absolute = returned.split([*ctx.widths, dL_dabsolute.shape[1]], 1)
        return None, None, absolute, None, *columns


def exchange(
    route: Route, parts: Sequence[Splats], absolute: Sequence[torch.Tensor], first_id: int, join: bool
) -> tuple[Splats, torch.Tensor | None, torch.Tensor]:
    """The splats of all ranks for the cameras of this one, what stands for `absolute` there, and the anchor.

    Args:
        parts: The splats of this rank, which together are in the order in which they are sent; colors may have any
            number of channels, the same on all ranks.
        absolute: (n, 2) for each part, or none.
        first_id: Global id of the first Gaussian of this rank.
        join: Whether any rank needs a gradient.
    """

    def joined(name: str) -> torch.Tensor:
        return torch.cat([getattr(part, name) for part in parts])

    columns = [joined(name) for name in DIFFERENTIABLE]
    like, shapes = columns[0], [t.shape[1:] for t in columns]
    matrices = [t.reshape(len(t), shape.numel()) for t, shape in zip(columns, shapes)]
    ids = joined("gaussian_ids").to(ID_OF[like.dtype]) + first_id
    fixed = torch.stack([joined("dets").detach(), ids.view(like.dtype)], 1)  # the bits of ids, never numbers
    of_means = torch.cat(list(absolute)) if absolute else like.new_empty(len(like), 0)
    anchor, received, of_own_means = _Exchange.apply(
        route, like.new_zeros((), requires_grad=True) if join else None, of_means, fixed, *matrices
    )
    *own, dets, ids = received.split([*(shape.numel() for shape in shapes), 1, 1], 1)
    ids = ids.detach()[:, 0].contiguous().view(ID_OF[like.dtype]).int()
    splats = replace(
        parts[0],
        **{n: t.reshape(len(t), *shape).contiguous() for n, t, shape in zip(DIFFERENTIABLE, own, shapes)},
        dets=dets.detach()[:, 0].contiguous(),
        gaussian_ids=ids,
        camera_ids=torch.cat([ids.new_full((size,), k) for k, size in enumerate(route.sizes)]),
        radii=ids.new_empty(0),
        row_splits=torch.tensor([0, *accumulate(route.sizes)], device="cpu"),
    )
    return splats, of_own_means if absolute else None, anchor
