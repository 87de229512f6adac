"""The processes that train one scene together, and what they tell each other besides splats.

On CUDA the process group needs a backend for the CPU too, as in init_process_group("cpu:gloo,cuda:nccl"): what is no
tensor of the device goes that way.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import Any

import torch.distributed as dist
from torch import Tensor

from .agreement import gather, place_in


@dataclass(frozen=True)
class Ranks:
    """The processes of a training. By default this one alone, which sends nothing.

    All methods but `part_of` are collective: every rank of the group calls them in the same order.

    Attributes:
        rank: Of this process within the group.
        world: How many there are.
        group: Of torch.distributed; None: the default group.
    """

    rank: int = 0
    world: int = 1
    group: dist.ProcessGroup | None = None

    @classmethod
    def of_group(cls, group: dist.ProcessGroup | None = None) -> Ranks:
        """The ranks of a process group that was made; None: the default group."""
        return cls(*place_in(group), group)

    @property
    def is_first(self) -> bool:
        """Whether this is the process that writes files and prints."""
        return self.rank == 0

    def exchange(self, value: Any) -> list[Any]:
        """The values of all ranks, in their order."""
        if self.world == 1:
            return [value]
        values: list[Any] = [None] * self.world
        dist.all_gather_object(values, value, group=self.group)
        return values

    def any_of(self, flag: bool) -> bool:
        """Whether the flag is set on any rank. Quicker than `exchange`."""
        return flag if self.world == 1 else any(row[0] for row in gather([int(flag)], self.world, self.group))

    def from_first(self, value: Any) -> Any:
        """The value of rank 0, on all ranks."""
        return self.exchange(value)[0]

    def allowed(self, limit: float, count: int, wanted: int) -> int:
        """How many of the `wanted` Gaussians this rank may add to its `count`, so that all ranks stay within `limit`.

        What is allowed to all ranks together is divided in proportion to what they want.
        """
        rows = self.exchange((count, wanted))
        of_all = sum(w for _, w in rows)
        room = min(of_all, max(limit - sum(c for c, _ in rows), 0))
        before = sum(w for _, w in rows[: self.rank])
        return 0 if of_all == 0 else room * (before + wanted) // of_all - room * before // of_all

    def part_of(self, counts: Sequence[int]) -> slice:
        """The rows of this rank in a tensor of the rows of all ranks, which have `counts` of them."""
        return slice(sum(counts[: self.rank]), sum(counts[: self.rank + 1]))

    def move_rows(self, rows: Tensor, before: Sequence[int], after: Sequence[int]) -> Tensor:
        """Distributes rows anew: the order over all ranks stays, rank r has `after[r]` of them instead of `before[r]`.

        Args:
            rows: (before[rank], ...) contiguous, on a device that the group sends.

        Returns:
            (after[rank], ...).
        """
        if self.world == 1:
            return rows
        moved = rows.new_empty(after[self.rank], *rows.shape[1:])
        old, new = _bounds(before), _bounds(after)
        sent = [_overlap(old[self.rank], of_rank) for of_rank in new]
        received = [_overlap(of_rank, new[self.rank]) for of_rank in old]
        dist.all_to_all_single(moved, rows, received, sent, group=self.group)
        return moved

    def gather_rows(self, rows: Tensor) -> Tensor:
        """The rows of all ranks on rank 0, on the CPU; on the others none, (0, ...). Alone: `rows` as they are."""
        if self.world == 1:
            return rows
        counts = self.exchange(len(rows))
        return self.move_rows(rows.detach().cpu().contiguous(), counts, [sum(counts), *[0] * (self.world - 1)])


ALONE = Ranks()


def even_counts(total: int, world: int) -> list[int]:
    """Rows of each of `world` ranks that differ by one at most."""
    return [total * (rank + 1) // world - total * rank // world for rank in range(world)]


def _bounds(counts: Sequence[int]) -> list[tuple[int, int]]:
    """First row of each rank, and the one after its last."""
    ends = list(accumulate(counts))
    return [(end - count, end) for count, end in zip(counts, ends)]


def _overlap(a: tuple[int, int], b: tuple[int, int]) -> int:
    return max(min(a[1], b[1]) - max(a[0], b[0]), 0)
