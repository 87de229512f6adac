"""Rows of splats on their way between ranks, and their gradients on the way back."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
import torch.distributed as dist
from torch.autograd.function import once_differentiable

from ..stages import Splats

DIFFERENTIABLE = ("means2d", "cov2d", "opacities", "depths", "colors")  # what is sent of a splat
_FIXED = ("dets", "gaussian_ids")  # and what follows it
_PARTS = len(DIFFERENTIABLE) + len(_FIXED)
ID_OF = {torch.float32: torch.int32, torch.float64: torch.int64}  # integers as wide as the numbers they travel among


@dataclass(frozen=True)
class Route:
    """Which rows go where.

    A rank sends the rows of the cameras of rank 0 first, then those of rank 1, and so on; of a rank camera after
    camera, of a camera tensor after tensor. What it receives of a camera it puts in the order of the ranks, which makes
    global ids ascend: `bin` draws splats of equal depth in this order.

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

    def forth(self, tensors: Sequence[torch.Tensor], shapes: list[torch.Size]) -> list[torch.Tensor]:
        """From the Gaussians to the cameras.

        Args:
            tensors: As many as there are shapes, those of a row, for each camera in `order`.

        Returns:
            The same for each camera of this rank, with the rows of all ranks.
        """
        own, widths = self.own, [shape.numel() for shape in shapes]
        received = self.send(torch.cat([t.reshape(-1) for t in tensors]), sum(widths), True)
        pieces = received.split([of_rank[c] * width for of_rank in self.counts for c in own for width in widths])
        columns = len(own) * len(widths)  # of the table of pieces, which has a line for each rank
        joined = [torch.cat(pieces[k::columns]) for k in range(columns)]
        return _shaped(joined, [n for n in self.sizes for _ in shapes], shapes)

    def back(self, tensors: Sequence[torch.Tensor], shapes: list[torch.Size]) -> list[torch.Tensor]:
        """From the cameras to the Gaussians: the opposite of `forth`. Of a rank without cameras an empty tensor."""
        own, widths = self.own, [shape.numel() for shape in shapes]
        lines = [[of_rank[c] for of_rank in self.counts] for c in own for _ in shapes]
        pieces = [t.split(line) for t, line in zip(tensors, lines)]
        of_ranks = [line[rank].reshape(-1) for rank in range(len(self.counts)) for line in pieces]
        flat = torch.cat(of_ranks or list(tensors))
        sizes = [self.counts[self.rank][c] for c in self.order for _ in shapes]
        numbers = [size * widths[k % len(widths)] for k, size in enumerate(sizes)]
        return _shaped(self.send(flat, sum(widths), False).split(numbers), sizes, shapes)

    def rows(self, forth: bool) -> tuple[list[int], list[int]]:
        """How many this rank receives from each rank and sends to each, on the way to the cameras or back."""
        sent = [sum(self.counts[self.rank][c] for c in cameras) for cameras in self.cameras]
        received = [sum(of_rank[c] for c in self.own) for of_rank in self.counts]
        return (received, sent) if forth else (sent, received)

    def send(self, flat: torch.Tensor, width: int, forth: bool) -> torch.Tensor:
        """Sends rows of `width` numbers to the cameras or back, in whatever order within those for a rank."""
        received, sent = ([width * n for n in numbers] for numbers in self.rows(forth))
        out = flat.new_empty(sum(received))
        kept, last = sent[self.rank], len(sent) - 1
        if self.rank not in (0, last):
            dist.all_to_all_single(out, flat, received, sent, group=self.group)
            return out
        # What stays, which lies at an end, is copied meanwhile: NCCL is slower at it.
        received[self.rank] = sent[self.rank] = 0
        at_start = self.rank == 0
        parts = [(t[:kept], t[kept:]) if at_start else (t[len(t) - kept :], t[: len(t) - kept]) for t in (out, flat)]
        (stays_to, comes), (stays, goes) = parts
        work = dist.all_to_all_single(comes, goes, received, sent, group=self.group, async_op=True)
        stays_to.copy_(stays)
        work.wait()
        return out


def _shaped(flat: Sequence[torch.Tensor], sizes: list[int], shapes: list[torch.Size]) -> list[torch.Tensor]:
    """As (size, *shape), the shapes taking turns."""
    return [t.view(size, *shapes[k % len(shapes)]) for k, (t, size) in enumerate(zip(flat, sizes))]


class _Exchange(torch.autograd.Function):
    """Sends rows to the owners of the cameras, and their gradients back.

    Args:
        absolute: Whether there are tensors for absolute gradients.
        join: A tensor that requires a gradient where any rank needs one, so that all take part in the way back.
        tensors: For each camera of the step, in the order of the route, those that DIFFERENTIABLE and _FIXED name; then
            for each one (n, 2) that takes absolute gradients. The latter are not sent: zeros stand for them at the
            owners, and their gradient comes back.

    Returns:
        The anchor, and the same tensors for each camera of this rank.
    """

    @staticmethod
    def forward(
        ctx: Any, route: Route, absolute: bool, join: torch.Tensor | None, *tensors: torch.Tensor
    ) -> tuple[torch.Tensor, ...]:
        ctx.set_materialize_grads(False)
        tensors = tensors[: _PARTS * len(route.order)]
        shapes = [t.shape[1:] for t in tensors[:_PARTS]]
        own = route.forth(tensors, shapes)
        ctx.mark_non_differentiable(*(t for k, t in enumerate(own) if k % _PARTS >= len(DIFFERENTIABLE)))
        ctx.route, ctx.like = route, tensors[0].new_empty(0)
        ctx.shapes = shapes[: len(DIFFERENTIABLE)] + ([torch.Size([2])] if absolute else [])
        return ctx.like.new_zeros(()), *own, *(ctx.like.new_zeros(size, 2) for size in route.sizes if absolute)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, _: torch.Tensor | None, *gradients: torch.Tensor | None):
        route, shapes, count = ctx.route, ctx.shapes, len(DIFFERENTIABLE)
        absolute = gradients[_PARTS * len(route.sizes) :]
        given = []
        for k, size in enumerate(route.sizes):
            of_camera = (*gradients[_PARTS * k :][:count], *absolute[k : k + 1])
            given += [ctx.like.new_zeros(size, *shape) if t is None else t for t, shape in zip(of_camera, shapes)]
        returned = route.back(given or [ctx.like], shapes)  # of a rank without cameras: nothing, of dtype and device
        cameras = [returned[k : k + len(shapes)] for k in range(0, len(returned), len(shapes))]
        rows = [t for of_camera in cameras for t in (*of_camera[:count], *[None] * len(_FIXED))]
        return None, None, None, *rows, *(t for of_camera in cameras for t in of_camera[count:])


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
    like, tensors = shard[0].means2d, []
    for of_camera in (shard[c] for c in route.order):
        ids = of_camera.gaussian_ids.to(ID_OF[like.dtype]) + first_id
        tensors += [getattr(of_camera, name) for name in DIFFERENTIABLE]
        tensors += [of_camera.dets.detach(), ids.view(like.dtype)]  # the bits of ids, never numbers
    tensors += [absolute[c] for c in route.order if absolute]
    joined = like.new_zeros((), requires_grad=True) if join else None
    anchor, *made = _Exchange.apply(route, bool(absolute), joined, *tensors)
    splats, cameras = [], route.cameras[route.rank]
    for k, camera in enumerate(cameras):
        columns = dict(zip((*DIFFERENTIABLE, *_FIXED), made[_PARTS * k :]))
        ids = columns["gaussian_ids"].view(ID_OF[like.dtype]).int()
        given = columns | {
            "gaussian_ids": ids,
            "camera_ids": torch.zeros_like(ids),
            "radii": ids.new_empty(0),
            "row_splits": torch.tensor([0, len(ids)]),
            **{name: getattr(shard[camera], name) for name in ("width", "height", "footprint", "option")},
        }
        splats.append(Splats(**given))
    return splats, made[_PARTS * len(cameras) :] if absolute else None, anchor
