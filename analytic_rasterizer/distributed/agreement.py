"""What the ranks tell each other before splats are sent, so that what is wrong on one of them raises on all.

It is one message of each rank to all others, of integers that may come from the device. It travels between the devices
where the group serves them, and the host waits for it once.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Sequence
from functools import lru_cache
from typing import Any, NamedTuple, TypeVar

import torch
import torch.distributed as dist

_KINDS = (("cpu", torch.float32), ("cpu", torch.float64), ("cuda", torch.float32))  # that `project` takes
_MAX_GAUSSIANS = torch.iinfo(torch.int32).max
_DIGESTS = ("settings",)  # facts whose values say nothing
_ROOM = 64  # integers of a message

Made = TypeVar("Made")
Facts = dict[str, Any]  # integers, or () int64 tensors

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


class Agreed(NamedTuple):
    """What the ranks told each other.

    Attributes:
        facts: Of every rank.
        counts: Of every rank, as many for all; empty where `agree` was given none.
    """

    facts: list[dict[str, int]]
    counts: list[list[int]]


def agree(
    make: Callable[[], tuple[Made, Facts, torch.Tensor | None]],
    requirements: dict[str, str | None],
    group: dist.ProcessGroup | None,
    meanwhile: Callable[[Made], None] = lambda _: None,
) -> tuple[Made, Agreed]:
    """What `make` returns on this rank, and what all ranks told each other. For several ranks. The host waits once.

    Args:
        make: Returns what it made, the facts that `requirements` names, and None or counts, a vector of int64 whose
            length is the fact "cameras".
        requirements: By fact what to say of ranks that differ in it; None: they may.
        meanwhile: Called with what was made while the message is on its way, to give the device something to do. It
            must not raise, for the other ranks would not hear of it.

    Raises:
        TypeError, ValueError, RuntimeError: On every rank the same, if `make` raised on one of them, which the message
            names, or if they differ in what they must not.
    """
    world = dist.get_world_size(group)
    error = made = counts = None
    try:
        made, facts, counts = make()
    except Exception as raised:  # the others must hear of it before they wait for splats
        error, facts = raised, dict.fromkeys(requirements, 0)
    numbers = [facts[name] for name in requirements]
    room = _ROOM - 1 - len(numbers)
    message = _message([int(error is not None), *numbers], counts if counts is None else counts[:room], group)
    wait = _begin_gathering(message, world, group)
    if error is None:
        meanwhile(made)
    rows = wait().tolist()
    if any(row[0] for row in rows):
        reports: list[Any] = [None] * world
        kind = next((k for k in (TypeError, ValueError) if isinstance(error, k)), RuntimeError)
        dist.all_gather_object(reports, None if error is None else (kind, str(error)), group=group)
        failed = next(r for r in range(world) if reports[r] is not None)
        kind, text = reports[failed]
        raise kind(f"on rank {failed}: {text}") from error
    of_ranks = [dict(zip(requirements, row[1:])) for row in rows]
    for name, requirement in requirements.items():
        for other, of_rank in enumerate(of_ranks):
            if requirement is not None and of_rank[name] != of_ranks[0][name]:
                values = "" if name in _DIGESTS else f": {_text(name, of_ranks[0])} and {_text(name, of_rank)}"
                raise ValueError(f"{requirement}, got a difference between ranks 0 and {other}{values}")
    count = sum(of_rank["gaussians"] for of_rank in of_ranks)
    if count > _MAX_GAUSSIANS:
        raise ValueError(f"all ranks together must have at most {_MAX_GAUSSIANS} Gaussians, got {count}")
    return made, Agreed(of_ranks, _counts_of(rows, counts, room, world, group))


def _counts_of(
    rows: list[list[int]], counts: torch.Tensor | None, room: int, world: int, group: dist.ProcessGroup | None
) -> list[list[int]]:
    """The counts of every rank, of whose messages `room` numbers hold the first ones."""
    if counts is None:
        return [[] for _ in rows]
    first = [row[_ROOM - room :][: len(counts)] for row in rows]
    if len(counts) <= room:
        return first
    rest = _gathered(counts[room:].to(_channel(group)), world, group)
    return [a + b for a, b in zip(first, rest)]


def _message(numbers: list[Any], counts: torch.Tensor | None, group: dist.ProcessGroup | None) -> torch.Tensor:
    """(_ROOM,) int64, the numbers and behind them the counts. Waits for no device."""
    device = _channel(group)
    on_host = [0 if torch.is_tensor(number) else number for number in numbers]
    filled = on_host + [0] * (_ROOM - len(on_host))
    on_host = torch.tensor(filled, pin_memory=device.type == "cuda", device="cpu")
    message = on_host.to(device, non_blocking=True)
    for place, number in enumerate(numbers):
        if torch.is_tensor(number):
            message[place] = number
    if counts is not None:
        message[len(numbers) : len(numbers) + len(counts)] = counts
    return message


def facts_of(
    means3D: torch.Tensor,
    differentiable: Iterable[torch.Tensor],
    group: dist.ProcessGroup | None,
    name: str = "means3D",
) -> Facts:
    """What REQUIREMENTS names. Raises ValueError for a device that the group does not serve; `name` is of the means."""
    devices = _backends_of(group)
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


def digest_of(cameras: Iterable[tuple[Sequence[int], dict[str, Any]]], others: Any) -> torch.Tensor:
    """() int64, of `others` and of what is said of each camera: tensors bit for bit. The same however cameras are
    grouped. On the device of the tensors, for which nobody waits.

    Args:
        cameras: Of each group the places of its cameras, and by name what is said of them: a tensor or a list with an
            entry for each of them, or something else for all.
    """
    numbers: dict[int, list] = {}
    digest: Any = 0
    for places, arguments in cameras:
        for k, place in enumerate(places):
            numbers[place] = [
                (name, v.shape[1:] if torch.is_tensor(v) else v[k] if isinstance(v, list) else v)
                for name, v in arguments.items()
            ]
        tensors = [v.detach().flatten(1) for v in arguments.values() if torch.is_tensor(v)]
        bits = torch.cat(tensors, 1).view(torch.int32).long()
        digest = digest + (bits * _weights(tuple(places), bits.shape[1], bits.device)).sum()
    text = repr((others, sorted(numbers.items())))
    return digest + int.from_bytes(hashlib.blake2b(text.encode(), digest_size=8).digest(), "little", signed=True)


@lru_cache(maxsize=64)
def _weights(places: tuple[int, ...], width: int, device: torch.device) -> torch.Tensor:
    """(places, width) int64, odd and without order, a row for each place whatever the others are: so that sums of their
    products with other bits, modulo 2^64, differ."""
    rows = [torch.arange(1, width + 1, device=device) + (place << 32) for place in places]
    weights = torch.stack(rows) * -7046029254386353131
    weights = (weights ^ (weights >> 29)) * -4658895280553007687
    return weights | 1


def _text(name: str, facts: dict[str, int]) -> str:
    value = facts[name]
    return " on ".join(str(part) for part in reversed(_KINDS[value])) if name == "kind" else str(value)


def _backends_of(group: dist.ProcessGroup | None) -> dict[str, str]:
    """The backend of each kind of device whose tensors the group can send."""
    return dict(pair.split(":", 1) for pair in dist.get_backend_config(group).split(","))


def _channel(group: dist.ProcessGroup | None) -> torch.device:
    """Where messages are that hold numbers of the device, the same kind of device on every rank."""
    backends = _backends_of(group)  # gloo serves both kinds of device, and then the host is the quicker way
    by_device = backends.get("cuda") == "nccl" or "cpu" not in backends
    if by_device and torch.cuda.is_available():
        return torch.device("cuda", torch.cuda.current_device())
    return torch.device("cpu")


def _begin_gathering(message: torch.Tensor, world: int, group: dist.ProcessGroup | None) -> Callable[[], torch.Tensor]:
    """A function, to be called once, that waits for the messages of all ranks and returns them, (world, integers) on
    the CPU. On CUDA it does not wait for what the device is given between this call and that one."""
    received = message.new_empty(world, len(message))
    work = dist.all_gather(list(received.unbind()), message, group=group, async_op=True)
    if not received.is_cuda:
        work.wait()
        return lambda: received
    on_host = torch.empty(received.shape, dtype=received.dtype, pin_memory=True, device="cpu")
    arrived = torch.cuda.Event()
    with torch.cuda.stream(_side_stream(received.device)):
        work.wait()  # lets the stream wait, not the host
        on_host.copy_(received, non_blocking=True)
        arrived.record()
    in_use = [message, received, work]  # until then

    def wait() -> torch.Tensor:
        arrived.synchronize()
        in_use.clear()
        return on_host

    return wait


@lru_cache(maxsize=16)
def _side_stream(device: torch.device) -> torch.cuda.Stream:
    return torch.cuda.Stream(device)


def _gathered(message: torch.Tensor, world: int, group: dist.ProcessGroup | None) -> list[list[int]]:
    """The integers of every rank, as many from each."""
    return _begin_gathering(message, world, group)().tolist()


def gather(numbers: list[int], world: int, group: dist.ProcessGroup | None) -> list[list[int]]:
    """The same number of integers of the host from every rank: through the host where the group serves it."""
    device = "cpu" if "cpu" in _backends_of(group) else _channel(group)
    return _gathered(torch.tensor(numbers, dtype=torch.int64, device=device), world, group)
