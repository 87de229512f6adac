"""gsplat's `distributed=True`: every rank has Gaussians and cameras of its own, and gets the images of its cameras."""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import torch
import torch.distributed as dist
from torch.autograd.function import once_differentiable

from ...distributed.agreement import REQUIREMENTS, agree, facts_of, gather, place_in
from ...distributed.cameras import summary_of
from ...distributed.exchange import Route, exchange
from ...render.stages import ROWS, Splats
from .arguments import CAMERAS, LENS, TENSORS, Call, Sizes, checked
from .scene import Scene

_REQUIREMENTS = REQUIREMENTS | {
    "kind": "means must have one dtype and one kind of device on every rank",
    "cameras": "viewmats must hold as many cameras on every rank",
    "settings": "all arguments but tensors must be the same on every rank",
    "moving": None,
}

_SIGNALS = ("colors", "extra_signals")
_NOT_COMPARED = ("footprint", "renderer_config", "tile_size", "channel_chunk", "segmented")  # arguments of ranks


@dataclass(frozen=True)
class Sharing:
    """The ranks that render together.

    Attributes:
        rank, world: Of this process, and how many there are.
        cameras: Of each rank.
        first_id: Global id of the first Gaussian of this rank.
        join: Whether any rank needs a gradient.
        moving: Whether any rank needs one with respect to its cameras.
    """

    rank: int
    world: int
    cameras: int
    first_id: int
    join: bool
    moving: bool

    @classmethod
    def agreed(cls, given: SimpleNamespace) -> tuple[Call, Sharing | None]:
        """The call, after checking its arguments on all ranks: wrong ones of one rank raise on every rank. And the
        ranks; None where this process is alone."""
        rank, world = place_in(None)
        if world == 1:
            return checked(given), None

        def make() -> tuple[Call, dict[str, int], None]:
            call = checked(given)
            tensors = {name: getattr(given, name) for name in TENSORS}
            others = {name: value for name, value in vars(given).items() if name not in (*TENSORS, *_NOT_COMPARED)}
            others["widths"] = [None if tensors[name] is None else tensors[name].shape[-1] for name in _SIGNALS]
            others["absent"] = [name for name in LENS if tensors[name] is None]
            digest = hashlib.blake2b(repr((others, str(call.footprint))).encode(), digest_size=8).digest()
            differentiable = [t for name, t in tensors.items() if t is not None and name != "backgrounds"]
            cameras = [tensors[name] for name in CAMERAS if tensors[name] is not None]
            facts = facts_of(given.means, differentiable, None, "means") | {
                "cameras": call.sizes.cameras,
                "settings": int.from_bytes(digest, "little", signed=True),
                "moving": int(torch.is_grad_enabled() and any(t.requires_grad for t in cameras)),
            }
            return call, facts, None

        call, (facts, _) = agree(make, _REQUIREMENTS, None)
        first_id, _, join = summary_of(facts, rank)
        moving = any(of_rank["moving"] for of_rank in facts)
        return call, cls(rank, world, facts[0]["cameras"], first_id, join, moving)

    def all_cameras(
        self, viewmats: torch.Tensor, Ks: torch.Tensor, coefficients: torch.Tensor | None
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor | None]:
        """(N C, 4, 4), (N C, 3, 3) and, where there are lenses, their (N C, 12) of all N ranks. Differentiable."""
        of_lens = viewmats.new_empty(len(viewmats), 0) if coefficients is None else coefficients
        own = torch.cat([viewmats.flatten(1), Ks.flatten(1), of_lens], 1)
        join = own.new_zeros((), requires_grad=True) if self.moving else None
        every = _AllCameras.apply(own, self.world, join)
        views, intrinsics, of_lens = every.split([16, 9, of_lens.shape[1]], 1)
        return views.reshape(-1, 4, 4), intrinsics.reshape(-1, 3, 3), None if coefficients is None else of_lens

    @staticmethod
    def as_table(rows: dict[str, torch.Tensor], sizes: Sizes) -> dict[str, torch.Tensor]:
        """Packed rows as the table (C, N, ...) of `meta`, zero where there is no row."""
        shape, places = (sizes.cameras, sizes.gaussians), _places(rows, sizes)
        table = {}
        for name in ("radii", "means2d", "depths", "conics", "opacities", "shown_opacities"):
            values = rows[name]
            if len(values) == len(places):
                empty = values.new_zeros(math.prod(shape), *values.shape[1:])
                values = empty.index_copy(0, places, values).reshape(*shape, *values.shape[1:])
            table[name] = values
        return table

    def send(
        self, rows: dict[str, torch.Tensor], means2d: torch.Tensor, absolute: torch.Tensor | None, scene: Scene
    ) -> tuple[dict[str, torch.Tensor], torch.Tensor | None]:
        """The rows of all ranks for the cameras of this one, by the names of `composite`.

        Args:
            rows: Of the Gaussians of this rank in the cameras of all ranks.
            means2d: (R, 2) of the rows, or (C, N, 2) of their table.
            absolute: Likewise, what takes the absolute gradients; or None.

        Returns:
            The rows, and what takes the absolute gradients of all of them.
        """
        counts = gather(rows["row_splits"].diff().tolist(), self.world, None)
        owned = [list(range(r * self.cameras, (r + 1) * self.cameras)) for r in range(self.world)]
        route = Route(counts, owned, self.rank, None)
        if means2d.dim() > 2:
            places = _places(rows, scene.sizes)
            means2d, absolute = (
                None if t is None else t.flatten(0, 1).index_select(0, places) for t in (means2d, absolute)
            )
        splats = Splats(
            **{name: rows[name] for name in ROWS if name not in ("means2d", "colors")},
            means2d=means2d,
            colors=rows["features"],
            width=scene.width,
            height=scene.height,
            footprint=scene.footprint.key,
            option=scene.footprint.option,
        )
        of_means = [] if absolute is None else [absolute]
        own, absolute, _ = exchange(route, [splats], of_means, self.first_id, self.join)
        return {name: getattr(own, name) for name in ROWS} | {"features": own.colors}, absolute


def _places(rows: dict[str, torch.Tensor], sizes: Sizes) -> torch.Tensor:
    """(R,) int64, where in the flattened table each packed row is."""
    return rows["camera_ids"].long() * sizes.gaussians + rows["gaussian_ids"].long()


class _AllCameras(torch.autograd.Function):
    """Rows of all ranks; the gradient of a row is the sum over the ranks, added up in their order.

    `join` requires a gradient where any rank needs one, so that all take part in the way back.
    """

    @staticmethod
    def forward(ctx: Any, own: torch.Tensor, world: int, join: torch.Tensor | None) -> torch.Tensor:
        ctx.world = world
        rows = [torch.empty_like(own) for _ in range(world)]
        dist.all_gather(rows, own.contiguous())
        return torch.cat(rows)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, dL_drows: torch.Tensor) -> tuple[torch.Tensor, None, None]:
        parts = torch.empty_like(dL_drows)
        dist.all_to_all_single(parts, dL_drows.contiguous())
        return parts.unflatten(0, (ctx.world, -1)).sum(0), None, None
