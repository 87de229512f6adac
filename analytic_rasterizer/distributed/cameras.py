"""Gaussians sharded over the ranks of torch.distributed: what is projected travels to the rank that owns the camera.

Every rank holds a part of the Gaussians, its shard, projects it into all cameras of a step, sends the splats to the
ranks that own the cameras, and blends the cameras of its own. Gradients travel back the same way. The shards are
consecutive: global ids count the Gaussians of rank 0 first, then those of rank 1, and so on.

    batch = distributed.rasterize(settings, means3D, opacities, shs=shs, scales=scales, rotations=rotations)
    loss = batch.anchor + sum(loss_of(shown.image, photographs[shown.camera]) for shown in batch.renderings)
    loss.backward()  # on every rank

docs/internals/distributed.md has the method and how much is sent.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
import torch.distributed as dist

from ..checks import check_tensors
from ..render.autocast import way_out_of, widened, widened_settings
from ..render.effects import AUTO
from ..render.order import CENTER
from ..render.seam import has_seam
from ..render.settings import GaussianRasterizationSettings
from ..render.stages import Splats, blend, list_tiles, project
from .agreement import REQUIREMENTS, Facts, agree, digest_of, facts_of, place_in
from .exchange import Route
from .rows import OwnSplats, Shard, Step, agreeing, rendered, together

_REQUIREMENTS = {
    "cameras": "settings must hold as many cameras on every rank",
    **REQUIREMENTS,
    "settings": "settings, owners and means2d_abs must be the same on every rank",
}


class Rendering(NamedTuple):
    """What a camera of this rank shows.

    Attributes:
        camera: Its place in the settings.
        image: (3, H, W).
        alpha: (1, H, W), 1 - transmittance, in 0 to 1.
        splats: What all ranks sent: a batch of this one camera, with global gaussian_ids. With more than one rank they
            have no gradient, and radii are empty, (0,): they are in `Batch.shard`, where the Gaussians are.
    """

    camera: int
    image: torch.Tensor
    alpha: torch.Tensor
    splats: Splats


@dataclass(frozen=True)
class Batch:
    """What `rasterize` made of a step.

    Attributes:
        renderings: The cameras of this rank, ascending; empty where it has none.
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

    renderings: tuple[Rendering, ...]
    shard: tuple[OwnSplats, ...]
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
    torch.distributed without a process group, makes what `project`, `list_tiles` and `blend` make of camera after
    camera, bit for bit, and sends nothing. Differentiable in what `project` is differentiable in, and in the
    backgrounds. The gradient with respect to a camera is, on each rank, the part of the rank's own Gaussians: the sum
    over the ranks is the whole. The host waits once for the device, for the numbers of rows (twice with more than 57
    cameras). On several
    ranks the backward pass runs once, retain_graph or not.

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
        RuntimeError: Another error on some rank, up to the message with the counts; later ones end in the time-out of
            the group.
    """
    _, world = place_in(group)
    means3D, opacities = widened(means3D), widened(opacities)
    gaussians = {
        "shs": widened(shs),
        "colors_precomp": widened(colors_precomp),
        "scales": widened(scales),
        "rotations": widened(rotations),
        "cov3D_precomp": widened(cov3D_precomp),
    }
    if world == 1:
        cameras, _ = _checked_cameras(settings, owners, world, shs, colors_precomp)
        return _of_one_rank(cameras, means3D, opacities, means2d_abs, gaussians)
    step, count = agreed_step(settings, means3D, opacities, gaussians, owners, means2d_abs, group)
    anchor, images, alphas = rendered(step)
    shard, received = step.take()
    renderings = tuple(Rendering(*of_camera) for of_camera in zip(step.route.own, images, alphas, received))
    return Batch(renderings, shard, step.means2d_abs, step.first_id, count, anchor)


def agreed_step(
    settings: Sequence[GaussianRasterizationSettings],
    means3D: torch.Tensor,
    opacities: torch.Tensor,
    gaussians: dict[str, Any],
    owners: Sequence[int] | None = None,
    means2d_abs: bool = False,
    group: dist.ProcessGroup | None = None,
) -> tuple[Step, int]:
    """The step that all ranks, of which there are several, have agreed on, and the number of their Gaussians.

    Args and errors: As of `rasterize`.
    """
    rank, world = place_in(group)

    def make() -> tuple[tuple, Facts, torch.Tensor]:
        shs, colors = gaussians["shs"], gaussians["colors_precomp"]
        cameras, settled = _checked_cameras(settings, owners, world, shs, colors)
        groups = together(cameras, means3D, opacities, **gaussians)
        cameras_of = [[c for c, owner in enumerate(settled) if owner == r] for r in range(world)]
        own = Shard(groups, [c for of_rank in cameras_of for c in of_rank])  # the device counts meanwhile
        digest = digest_of([(g.cameras, g.batch) for g in groups], [settled, means2d_abs])
        tensors = [t for of_group in groups for t in of_group.tensors if t is not None] + [s.bg for s in cameras]
        facts = {"cameras": len(cameras), "settings": digest, **facts_of(means3D, tensors, group)}
        if means2d_abs:
            facts["requires_grad"] = facts["grad_enabled"]
        return (cameras, cameras_of, own), facts, own.counts

    (cameras, cameras_of, own), agreed = agree(make, _REQUIREMENTS, group, meanwhile=lambda made: made[-1].begin())
    first_id, count, join = summary_of(agreed.facts, rank)
    route = Route(agreed.counts, cameras_of, rank, group)
    return Step(own, route, first_id, join, means2d_abs, [cameras[c].bg for c in route.own]), count


def _of_one_rank(
    cameras: list[GaussianRasterizationSettings],
    means3D: torch.Tensor,
    opacities: torch.Tensor,
    means2d_abs: bool,
    gaussians: dict[str, Any],
) -> Batch:
    shard = _projected(cameras, means3D, opacities, **gaussians)
    absolute = tuple(torch.zeros_like(s.means2d, requires_grad=True) for s in shard) if means2d_abs else ()
    renderings = []
    for camera, splats in enumerate(shard):
        if splats.means2d.requires_grad:
            splats.means2d.retain_grad()
        bg = cameras[camera].bg
        lists = list_tiles(splats, keep=torch.is_grad_enabled())
        image, alpha = blend(splats, lists, background=bg, means2d_abs=absolute[camera] if means2d_abs else None)
        renderings.append(Rendering(camera, image[0], alpha[0], splats))
    own = tuple(OwnSplats(s.means2d, s.radii, s.gaussian_ids, s.width, s.height) for s in shard)
    return Batch(tuple(renderings), own, absolute, 0, len(means3D), means3D.new_zeros(()))


def _projected(
    cameras: list[GaussianRasterizationSettings], means3D: torch.Tensor, opacities: torch.Tensor, **gaussians: Any
) -> tuple[Splats, ...]:
    """The splats of each camera. Cameras that may share a call of `project` do: it adds up their gradients in place."""
    shard: dict[int, Splats] = {}
    for group in agreeing(cameras).values():
        splats = project([cameras[camera] for camera in group], means3D, opacities, **gaussians)
        shard |= zip(group, splats.split())
    return tuple(shard[camera] for camera in range(len(cameras)))


def summary_of(facts: list[Facts], rank: int) -> tuple[int, int, bool]:
    """Global id of the rank's first Gaussian, the number of Gaussians of all ranks, and whether one needs gradients."""
    counts = [of_rank["gaussians"] for of_rank in facts]
    return sum(counts[:rank]), sum(counts), any(of_rank["requires_grad"] for of_rank in facts)


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
        cameras[camera] = s = widened_settings(s)
        check_camera(s, f" of camera {camera}")
    check_colors(shs, colors_precomp)
    owners = [camera % world for camera in range(len(cameras))] if owners is None else list(owners)
    if len(owners) != len(cameras):
        raise ValueError(f"owners must hold a rank for each of {len(cameras)} cameras, got {len(owners)}")
    for camera, owner in enumerate(owners):
        if isinstance(owner, bool) or not isinstance(owner, int) or not 0 <= owner < world:
            raise ValueError(f"owners must be ranks from 0 to {world - 1}, got {owner!r} for camera {camera}")
    return cameras, owners


def check_camera(settings: GaussianRasterizationSettings, name: str = "") -> None:
    """Raises for settings that several ranks cannot render; `name` ends the message."""
    bg = settings.bg
    check_tensors(None, viewmatrix=settings.viewmatrix, bg=bg)
    check_tensors(settings.viewmatrix.device, bg=bg)
    if bg.dtype != settings.viewmatrix.dtype:
        got = f"{bg.dtype}{name}{way_out_of(bg.dtype)}"
        raise TypeError(f"bg must have dtype {settings.viewmatrix.dtype}, got {got}")
    if bg.shape != (3,):
        raise ValueError(f"bg must have shape (3,), got {tuple(bg.shape)}{name}")
    if has_seam(settings):
        raise ValueError(f"lens must not be equirectangular, which is not distributed, got it{name}")
    if isinstance(settings.effects, str) and settings.effects == AUTO:
        raise ValueError(f'effects must not be "auto", which looks at all Gaussians, got it{name}')
    order = getattr(settings.effects, "order", CENTER)
    if order != CENTER:  # rows that are sent have no slopes
        raise ValueError(f"order must be {CENTER!r} where Gaussians are distributed, got {order!r}{name}")


def check_colors(shs: Any, colors_precomp: Any) -> None:
    """Raises ValueError where there are no colours."""
    if all(c is None or (torch.is_tensor(c) and c.shape == (0,)) for c in (shs, colors_precomp)):
        raise ValueError("shs or colors_precomp must be given, got neither")
