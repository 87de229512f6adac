"""gsplat's `distributed=True`: every rank has Gaussians and cameras of its own, and gets the images of its cameras."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import torch
import torch.distributed as dist
from torch.autograd.function import once_differentiable

from ...distributed.agreement import REQUIREMENTS, agree, facts_of, gather, place_in
from ...distributed.cameras import summary_of
from ...distributed.exchange import Route, exchange
from ...stages import Splats

_REQUIREMENTS = REQUIREMENTS | {
    "kind": "means must have one dtype and one kind of device on every rank",
    "cameras": "viewmats must hold as many cameras on every rank",
    "settings": "all arguments but tensors must be the same on every rank",
    "moving": None,
}

Checked = TypeVar("Checked")


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
    def agreed(
        cls, check: Callable[[], Checked], tensors: dict[str, Any], settings: tuple
    ) -> tuple[Checked, Sharing | None]:
        """What `check` returns, and the ranks; None for the latter where this process is alone.

        Args:
            check: Raises for wrong arguments, which then raises on every rank. The last of what it returns, the
                footprint, must be the same on every rank too.
            tensors: Arguments of `rasterization` that may require gradients; not looked at before `check` has passed.
            settings: Its other arguments.
        """
        rank, world = place_in(None)
        if world == 1:
            return check(), None

        def make() -> tuple[Checked, dict[str, int], None]:
            checked = check()
            given = [t for t in tensors.values() if t is not None]
            digest = hashlib.blake2b(repr((settings, str(checked[-1]))).encode(), digest_size=8).digest()
            names = ("viewmats", "Ks", "radial_coeffs", "tangential_coeffs", "thin_prism_coeffs")
            cameras = [tensors[name] for name in names if tensors[name] is not None]
            facts = facts_of(tensors["means"], given, None, "means") | {
                "cameras": len(tensors["viewmats"]),
                "settings": int.from_bytes(digest, "little", signed=True),
                "moving": int(torch.is_grad_enabled() and any(t.requires_grad for t in cameras)),
            }
            return checked, facts, None

        checked, (facts, _) = agree(make, _REQUIREMENTS, None)
        first_id, _, join = summary_of(facts, rank)
        moving = any(of_rank["moving"] for of_rank in facts)
        return checked, cls(rank, world, facts[0]["cameras"], first_id, join, moving)

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

    def send(
        self, splats: Splats, features: torch.Tensor, absolute: torch.Tensor | None
    ) -> tuple[Splats, torch.Tensor | None]:
        """The splats of all ranks for the cameras of this one, with features in place of colors, and global ids.

        Args:
            splats: Of the Gaussians of this rank in the cameras of all ranks.
            features: (R, D), a row per splat; D may be 0.
            absolute: (R, 2) or None, what takes the absolute gradients.

        Returns:
            The splats, and what takes the absolute gradients of all of them.
        """
        counts = gather(splats.row_splits.diff().tolist(), self.world, None)
        owned = [list(range(r * self.cameras, (r + 1) * self.cameras)) for r in range(self.world)]
        route = Route(counts, owned, self.rank, None)
        of_means = [] if absolute is None else [absolute]
        own, of_own_means, _ = exchange(route, [replace(splats, colors=features)], of_means, self.first_id, self.join)
        return own, of_own_means


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
