"""What the ranks tell each other before splats are sent, so that what is wrong on one of them raises on all."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import torch
import torch.distributed as dist

from ..arguments import camera_arguments
from ..settings import GaussianRasterizationSettings
from ..stages import Splats
from .exchange import DIFFERENTIABLE

_KINDS = (("cpu", torch.float32), ("cpu", torch.float64), ("cuda", torch.float32))  # that `project` takes
_MAX_GAUSSIANS = torch.iinfo(torch.int32).max
_DIGESTS = ("settings",)  # facts whose values say nothing

Made = TypeVar("Made")
Facts = dict[str, int]

REQUIREMENTS = {
    "kind": "means3D must have one dtype and one kind of device on every rank",
    "grad_enabled": "gradients must be enabled on every rank or on none",
    "gaussians": None,
    "requires_grad": None,
}
"""Facts of `facts_of`, and what must hold of them; None: they may differ."""


def place_in(group: dist.ProcessGroup | None) -> tuple[int, int]:
    """Rank of this process in the group, and number of ranks."""
    if group is None and not (dist.is_available() and dist.is_initialized()):
        return 0, 1
    rank = dist.get_rank(group)
    if rank < 0:
        raise ValueError(f"group must hold this process, got one without rank {dist.get_rank()}")
    return rank, dist.get_world_size(group)


def agree(
    make: Callable[[], tuple[Made, Facts]], requirements: dict[str, str | None], group: dist.ProcessGroup | None
) -> tuple[Made, list[Facts]]:
    """What `make` returns on this rank, and the facts of all ranks. For several ranks.

    Args:
        make: Returns what it made, and the facts that `requirements` names.
        requirements: By fact what to say of ranks that differ in it; None: they may.

    Raises:
        TypeError, ValueError, RuntimeError: On every rank the same, if `make` raised on one of them, which the message
            names, or if they differ in what they must not.
    """
    world = dist.get_world_size(group)
    error = made = None
    try:
        made, facts = make()
    except Exception as raised:  # the others must hear of it before they wait for splats
        error, facts = raised, dict.fromkeys(requirements, 0)
    rows = gather([int(error is not None), *(facts[name] for name in requirements)], world, group)
    if any(row[0] for row in rows):
        reports: list[Any] = [None] * world
        kind = next((k for k in (TypeError, ValueError) if isinstance(error, k)), RuntimeError)
        dist.all_gather_object(reports, None if error is None else (kind, str(error)), group=group)
        failed = next(r for r in range(world) if reports[r] is not None)
        kind, message = reports[failed]
        raise kind(f"on rank {failed}: {message}") from error
    of_ranks = [dict(zip(requirements, row[1:])) for row in rows]
    for name, requirement in requirements.items():
        for other, of_rank in enumerate(of_ranks):
            if requirement is not None and of_rank[name] != of_ranks[0][name]:
                values = "" if name in _DIGESTS else f": {_text(name, of_ranks[0])} and {_text(name, of_rank)}"
                raise ValueError(f"{requirement}, got a difference between ranks 0 and {other}{values}")
    count = sum(of_rank["gaussians"] for of_rank in of_ranks)
    if count > _MAX_GAUSSIANS:
        raise ValueError(f"all ranks together must have at most {_MAX_GAUSSIANS} Gaussians, got {count}")
    return made, of_ranks


def facts_of(
    means3D: torch.Tensor,
    differentiable: Sequence[torch.Tensor],
    group: dist.ProcessGroup | None,
    name: str = "means3D",
) -> Facts:
    """What REQUIREMENTS names. Raises ValueError for a device that the group does not serve; `name` is of the means."""
    devices = _devices_of(group)
    if means3D.device.type not in devices:
        raise ValueError(f"{name} must be on a device of the group, {' or '.join(devices)}, got {means3D.device}")
    if means3D.is_cuda and means3D.device.index != torch.cuda.current_device():
        current = f"cuda:{torch.cuda.current_device()}"  # what NCCL goes by
        raise ValueError(f"{name} must be on the current device, {current}, got {means3D.device}")
    requires_grad = any(t.requires_grad for t in differentiable)
    return {
        "kind": _KINDS.index((means3D.device.type, means3D.dtype)),
        "grad_enabled": int(torch.is_grad_enabled()),
        "gaussians": len(means3D),
        "requires_grad": int(requires_grad and torch.is_grad_enabled()),
    }


def rows_of(shard: Sequence[Splats]) -> list[torch.Tensor]:
    """The tensors of splats that gradients flow through."""
    return [getattr(splats, name) for splats in shard for name in DIFFERENTIABLE]


def digest_of(
    cameras: list[GaussianRasterizationSettings],
    others: Any,
    means3D: torch.Tensor,
    shs: torch.Tensor | None,
) -> int:
    """64 bits of `others` and of everything that all ranks must have in common, also whether cameras require gradients
    (`lens`)."""
    numbers, tensors = [others], []
    for settings in cameras:
        for name, value in camera_arguments(settings, means3D, shs).items():
            (tensors if torch.is_tensor(value) else numbers).append(value if torch.is_tensor(value) else (name, value))
    digest = hashlib.blake2b(repr(numbers).encode(), digest_size=8)
    digest.update(
        torch.cat([t.detach().reshape(-1) for t in tensors]).cpu().numpy().tobytes()
    )  # one copy from the device
    return int.from_bytes(digest.digest(), "little", signed=True)


def _text(name: str, facts: Facts) -> str:
    value = facts[name]
    return " on ".join(str(part) for part in reversed(_KINDS[value])) if name == "kind" else str(value)


def _devices_of(group: dist.ProcessGroup | None) -> list[str]:
    """Kinds of devices whose tensors the group can send."""
    return [pair.partition(":")[0] for pair in dist.get_backend_config(group).split(",")]


def gather(numbers: list[int], world: int, group: dist.ProcessGroup | None) -> list[list[int]]:
    """The same number of integers from every rank."""
    device = "cpu" if "cpu" in _devices_of(group) else torch.device("cuda", torch.cuda.current_device())
    sent = torch.tensor(numbers, dtype=torch.int64, device=device)
    received = [torch.empty_like(sent) for _ in range(world)]
    dist.all_gather(received, sent, group=group)
    return torch.stack(received).tolist()
