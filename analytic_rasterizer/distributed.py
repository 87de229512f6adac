"""Gaussians sharded over the ranks of torch.distributed: what is projected travels to the rank that owns the camera.

Every rank holds a part of the Gaussians, its shard, projects it into all cameras of a step, sends the splats to the
ranks that own the cameras, and blends the cameras of its own. Gradients travel back the same way. The shards are
consecutive: global ids count the Gaussians of rank 0 first, then those of rank 1, and so on.

    batch = distributed.rasterize(settings, means3D, opacities, shs=shs, scales=scales, rotations=rotations)
    loss = batch.anchor + sum(loss_of(view.image, photographs[view.camera]) for view in batch.views)
    loss.backward()  # on every rank

docs/distributed.md has the method and how much is sent.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
import torch.distributed as dist
from torch.autograd.function import once_differentiable

from .arguments import camera_arguments, check_tensors
from .effects import AUTO
from .settings import GaussianRasterizationSettings
from .stages import Splats, bin, blend, project

_DIFFERENTIABLE = {"means2d": 2, "cov2d": 3, "opacities": 1, "depths": 1, "colors": 3}  # columns of a row that is sent
_FIXED = {"dets": 1, "gaussian_ids": 1}  # and what follows them
_KINDS = (("cpu", torch.float32), ("cpu", torch.float64), ("cuda", torch.float32))  # that `project` takes
_ID_OF = {torch.float32: torch.int32, torch.float64: torch.int64}  # integers as wide as the numbers they travel among
_MAX_GAUSSIANS = torch.iinfo(torch.int32).max


class View(NamedTuple):
    """A camera of this rank.

    Attributes:
        camera: Its place in the settings.
        image: (3, H, W).
        alpha: (1, H, W), 1 - transmittance, in 0 to 1.
        splats: What all ranks sent: a batch of this one camera, with global gaussian_ids. With more than one rank its
            radii are empty, (0,): they are in `Batch.shard`, where the Gaussians are.
    """

    camera: int
    image: torch.Tensor
    alpha: torch.Tensor
    splats: Splats


@dataclass(frozen=True)
class Batch:
    """What `rasterize` made of a step.

    Attributes:
        views: The cameras of this rank, ascending; empty where it has none.
        shard: For every camera of the step the splats of the Gaussians of this rank, with ids that count within the
            shard. `radii` are those of density control; after the backward pass `means2d.grad` (n, 2) is dL/d(projected
            mean), per px.
        means2d_abs: For every camera (n, 2), a row per row of `shard`, whose `grad` is the sum over pixels of the
            absolute values of dL/dmeans2d; empty unless asked for.
        first_id: Global id of the first Gaussian of this rank.
        count: Number of Gaussians of all ranks.
        anchor: () zero. Gradients return by a collective operation, so every rank has to run the backward pass, also
            one without cameras: add this to its loss.
    """

    views: tuple[View, ...]
    shard: tuple[Splats, ...]
    means2d_abs: tuple[torch.Tensor, ...]
    first_id: int
    count: int
    anchor: torch.Tensor


def rasterize(
    settings: Sequence[GaussianRasterizationSettings],
    means3D: torch.Tensor,
    opacities: torch.Tensor,
    *,
    shs: torch.Tensor | None = None,
    colors_precomp: torch.Tensor | None = None,
    scales: torch.Tensor | None = None,
    rotations: torch.Tensor | None = None,
    cov3D_precomp: torch.Tensor | None = None,
    owners: Sequence[int] | None = None,
    means2d_abs: bool = False,
    group: dist.ProcessGroup | None = None,
) -> Batch:
    """Renders the cameras of a step from Gaussians that are sharded over ranks. Every rank of the group calls it.

    The images are those of one rank with all Gaussians, bit for bit; the gradients are, to rounding. One rank, or
    torch.distributed without a process group, makes what `project`, `bin` and `blend` make of camera after camera, bit
    for bit, and sends nothing. Differentiable in what `project` is differentiable in, and in the backgrounds. The
    gradient with respect to a camera is, on each rank, the part of the rank's own Gaussians: the sum over the ranks is
    the whole. Waits for the device.

    Args:
        settings: Of all cameras, the same on every rank, bit for bit. Image sizes and footprints may differ. bg is
            (3,), and only that on the camera's owner is read; a 3D filter is that of the rank's own Gaussians. Outputs
            of effects are not made, except for alpha.
        means3D: (P, 3) centres of the Gaussians of this rank, world units; P may be 0.
        opacities: (P, 1) or (P,).
        shs: (P, M, 3) spherical harmonics; or colors_precomp (P, 3).
        scales: (P, 3) standard deviations, world units, with rotations (P, 4) (w, x, y, z); or cov3D_precomp (P, 6).
        owners: The rank within the group that blends each camera; None: camera c belongs to rank c modulo the number
            of ranks.
        means2d_abs: Whether to make `Batch.means2d_abs`.
        group: Of torch.distributed; None: the default group, and this process alone where there is none.

    Raises:
        TypeError, ValueError: Wrong arguments, also those of another rank: what is wrong on one rank raises the same
            error on all of them, which names the rank. Ranks that disagree in settings, dtype or kind of device.
        RuntimeError: Another error on some rank, up to the moment when splats are sent.
    """
    rank, world = place_in(group)
    error = mine = None
    try:
        cameras, owners = _checked_cameras(settings, owners, world, shs, colors_precomp)
        gaussians = {"shs": shs, "colors_precomp": colors_precomp, "scales": scales, "rotations": rotations}
        shard = tuple(project(s, means3D, opacities, cov3D_precomp=cov3D_precomp, **gaussians) for s in cameras)
        absolute = tuple(torch.zeros_like(s.means2d, requires_grad=True) for s in shard) if means2d_abs else ()
        if world > 1:
            mine = _facts(cameras, owners, means3D, shs, shard, absolute, group)
    except Exception as raised:
        if world == 1:
            raise
        error = raised  # the others must hear of it before they wait for splats
    if world == 1:
        first_id, count = 0, len(means3D)
        own, own_absolute, anchor = shard, absolute, means3D.new_zeros(())
    else:
        facts = _agreed_facts(error, mine, rank, world, group)
        first_id, count = sum(f.gaussians for f in facts[:rank]), sum(f.gaussians for f in facts)
        route = _route(shard, owners, rank, world, group)
        join = any(f.requires_grad for f in facts)
        own, own_absolute, anchor = _exchange(route, shard, absolute, first_id, join)
    for splats in shard:
        if splats.means2d.requires_grad:
            splats.means2d.retain_grad()
    views = []
    for k, camera in enumerate(c for c in range(len(cameras)) if owners[c] == rank):
        bg = cameras[camera].bg
        lists = bin(own[k], background=bg.detach(), keep=torch.is_grad_enabled())
        of_means = own_absolute[k] if means2d_abs else None
        image, alpha = blend(own[k], lists, background=bg, means2d_abs=of_means)
        views.append(View(camera, image[0], alpha[0], own[k]))
    return Batch(tuple(views), shard, absolute, first_id, count, anchor)


def place_in(group: dist.ProcessGroup | None) -> tuple[int, int]:
    """Rank of this process in the group, and number of ranks."""
    if group is None and not (dist.is_available() and dist.is_initialized()):
        return 0, 1
    rank = dist.get_rank(group)
    if rank < 0:
        raise ValueError(f"group must hold this process, got one without rank {dist.get_rank()}")
    return rank, dist.get_world_size(group)


def _checked_cameras(
    settings: Any, owners: Any, world: int, shs: Any, colors_precomp: Any
) -> tuple[list[GaussianRasterizationSettings], list[int]]:
    """Cameras and owners as lists; raises for what `project` does not look at."""
    if isinstance(settings, GaussianRasterizationSettings):
        raise TypeError("settings must be a sequence with the settings of each camera, got those of one camera")
    cameras = list(settings)
    if not cameras:
        raise ValueError("settings must hold at least one camera, got none")
    for camera, s in enumerate(cameras):
        if not isinstance(s, GaussianRasterizationSettings):
            raise TypeError(f"settings must hold GaussianRasterizationSettings, got {type(s).__name__} at {camera}")
        check_tensors(None, viewmatrix=s.viewmatrix, bg=s.bg)
        check_tensors(s.viewmatrix.device, bg=s.bg)
        if s.bg.dtype != s.viewmatrix.dtype:
            raise TypeError(f"bg must have dtype {s.viewmatrix.dtype}, got {s.bg.dtype} of camera {camera}")
        if s.bg.shape != (3,):
            raise ValueError(f"bg must have shape (3,), got {tuple(s.bg.shape)} of camera {camera}")
        if isinstance(s.effects, str) and s.effects == AUTO:
            raise ValueError(f'effects must not be "auto", which looks at all Gaussians, got it of camera {camera}')
    if all(c is None or (torch.is_tensor(c) and c.shape == (0,)) for c in (shs, colors_precomp)):
        raise ValueError("shs or colors_precomp must be given, got neither")
    owners = [camera % world for camera in range(len(cameras))] if owners is None else list(owners)
    if len(owners) != len(cameras):
        raise ValueError(f"owners must hold a rank for each of {len(cameras)} cameras, got {len(owners)}")
    for camera, owner in enumerate(owners):
        if isinstance(owner, bool) or not isinstance(owner, int) or not 0 <= owner < world:
            raise ValueError(f"owners must be ranks from 0 to {world - 1}, got {owner!r} for camera {camera}")
    return cameras, owners


# --- what the ranks tell each other before splats are sent ------------------------------------------


class _Facts(NamedTuple):
    """What every rank must know of every other, as integers."""

    failed: int
    cameras: int
    settings: int  # digest
    kind: int  # place in _KINDS
    gaussians: int
    grad_enabled: int
    requires_grad: int


def _facts(
    cameras: list[GaussianRasterizationSettings],
    owners: list[int],
    means3D: torch.Tensor,
    shs: torch.Tensor | None,
    shard: tuple[Splats, ...],
    absolute: tuple[torch.Tensor, ...],
    group: dist.ProcessGroup | None,
) -> _Facts:
    devices = _devices_of(group)
    if means3D.device.type not in devices:
        raise ValueError(f"means3D must be on a device of the group, {' or '.join(devices)}, got {means3D.device}")
    if means3D.is_cuda and means3D.device.index != torch.cuda.current_device():
        current = f"cuda:{torch.cuda.current_device()}"  # what NCCL goes by
        raise ValueError(f"means3D must be on the current device, {current}, got {means3D.device}")
    differentiable = [getattr(s, name) for s in shard for name in _DIFFERENTIABLE]
    requires_grad = any(t.requires_grad for t in (*differentiable, *absolute))
    return _Facts(
        failed=0,
        cameras=len(cameras),
        settings=_digest(cameras, owners, means3D, shs, bool(absolute)),
        kind=_KINDS.index((means3D.device.type, means3D.dtype)),
        gaussians=len(means3D),
        grad_enabled=int(torch.is_grad_enabled()),
        requires_grad=int(requires_grad and torch.is_grad_enabled()),
    )


def _digest(
    cameras: list[GaussianRasterizationSettings],
    owners: list[int],
    means3D: torch.Tensor,
    shs: torch.Tensor | None,
    absolute: bool,
) -> int:
    """64 bits of everything that all ranks must have in common, also whether cameras require gradients (`lens`)."""
    numbers, tensors = [owners, absolute], []
    for settings in cameras:
        for name, value in camera_arguments(settings, means3D, shs).items():
            (tensors if torch.is_tensor(value) else numbers).append(value if torch.is_tensor(value) else (name, value))
    digest = hashlib.blake2b(repr(numbers).encode(), digest_size=8)
    digest.update(
        torch.cat([t.detach().reshape(-1) for t in tensors]).cpu().numpy().tobytes()
    )  # one copy from the device
    return int.from_bytes(digest.digest(), "little", signed=True)


def _agreed_facts(
    error: Exception | None, mine: _Facts | None, rank: int, world: int, group: dist.ProcessGroup | None
) -> list[_Facts]:
    """The facts of every rank. Raises the same on all of them if one failed, or if they disagree."""
    if error is not None:
        mine = _Facts(1, *[0] * (len(_Facts._fields) - 1))
    facts = [_Facts(*row) for row in _gather(list(mine), world, group)]
    if any(f.failed for f in facts):
        reports: list[Any] = [None] * world
        kind = next((k for k in (TypeError, ValueError) if isinstance(error, k)), RuntimeError)
        dist.all_gather_object(reports, None if error is None else (kind, str(error)), group=group)
        failed = next(r for r in range(world) if reports[r] is not None)
        kind, message = reports[failed]
        raise kind(f"on rank {failed}: {message}") from error
    requirements = {
        "cameras": "settings must hold as many cameras on every rank",
        "kind": "means3D must have one dtype and one kind of device on every rank",
        "grad_enabled": "gradients must be enabled on every rank or on none",
        "settings": "settings, owners and means2d_abs must be the same on every rank",
    }
    for name, requirement in requirements.items():
        for other, f in enumerate(facts):
            if getattr(f, name) != getattr(facts[0], name):
                values = "" if name == "settings" else f": {_text(name, facts[0])} and {_text(name, f)}"
                raise ValueError(f"{requirement}, got a difference between ranks 0 and {other}{values}")
    count = sum(f.gaussians for f in facts)
    if count > _MAX_GAUSSIANS:
        raise ValueError(f"means3D must have at most {_MAX_GAUSSIANS} rows on all ranks together, got {count}")
    return facts


def _text(name: str, facts: _Facts) -> str:
    value = getattr(facts, name)
    return " on ".join(str(part) for part in reversed(_KINDS[value])) if name == "kind" else str(value)


def _devices_of(group: dist.ProcessGroup | None) -> list[str]:
    """Kinds of devices whose tensors the group can send."""
    return [pair.partition(":")[0] for pair in dist.get_backend_config(group).split(",")]


def _gather(numbers: list[int], world: int, group: dist.ProcessGroup | None) -> list[list[int]]:
    """The same number of integers from every rank."""
    device = "cpu" if "cpu" in _devices_of(group) else torch.device("cuda", torch.cuda.current_device())
    sent = torch.tensor(numbers, dtype=torch.int64, device=device)
    received = [torch.empty_like(sent) for _ in range(world)]
    dist.all_gather(received, sent, group=group)
    return torch.stack(received).tolist()


# --- what is sent -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Route:
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
        route: _Route,
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


def _route(
    shard: tuple[Splats, ...], owners: list[int], rank: int, world: int, group: dist.ProcessGroup | None
) -> _Route:
    counts = _gather([len(s.means2d) for s in shard], world, group)
    cameras = [[c for c, owner in enumerate(owners) if owner == r] for r in range(world)]
    return _Route(counts, cameras, rank, group)


def _exchange(
    route: _Route, shard: tuple[Splats, ...], absolute: tuple[torch.Tensor, ...], first_id: int, join: bool
) -> tuple[list[Splats], list[torch.Tensor] | None, torch.Tensor]:
    """The splats of all ranks for each camera of this one, what stands for `absolute` there, and the anchor."""
    order = [c for cameras in route.cameras for c in cameras]
    dtype = shard[0].means2d.dtype
    rows = torch.cat([_columns(*(getattr(shard[c], name) for name in _DIFFERENTIABLE)) for c in order])
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
        columns = _named(of_rows, _DIFFERENTIABLE) | _named(of_fixed, _FIXED)
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


def _columns(*tensors: torch.Tensor) -> torch.Tensor:
    """(n, K) from columns (n,) and (n, k)."""
    return torch.cat([t[:, None] if t.dim() == 1 else t for t in tensors], 1)


def _named(rows: torch.Tensor, widths: dict[str, int]) -> dict[str, torch.Tensor]:
    """The opposite, by name."""
    columns = rows.split(list(widths.values()), 1)
    return {name: (t[:, 0] if width == 1 else t).contiguous() for (name, width), t in zip(widths.items(), columns)}
