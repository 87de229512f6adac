"""One camera over several ranks: the image is cut into bands of rows of tiles, and each rank blends one of them."""

from __future__ import annotations

import dataclasses
from bisect import bisect_left
from dataclasses import dataclass
from itertools import accumulate, pairwise

import torch
import torch.distributed as dist

from .._C import tile_size
from ..render.arguments import camera_arguments
from ..render.autocast import widened, widened_settings
from ..render.settings import GaussianRasterizationSettings
from ..render.stages import Splats, blend, list_tiles, project
from .agreement import REQUIREMENTS, Facts, agree, digest_of, facts_of, gather, place_in
from .cameras import check_camera, check_colors, summary_of
from .exchange import DIFFERENTIABLE, Route, exchange

_REQUIREMENTS = REQUIREMENTS | {"settings": "settings and means2d_abs must be the same on every rank"}
_ATTEMPTS = 3  # at lists whose room was guessed, each time better


@dataclass(frozen=True)
class Band:
    """What `rasterize_bands` made on this rank.

    Attributes:
        rows: (first, end) rows of the image of every rank's band; first == end where a rank has none.
        rank: Of this process, in `rows`.
        image: (3, rows of this band, W).
        alpha: (1, rows of this band, W), 1 - transmittance, in 0 to 1.
        shard: The splats of the Gaussians of this rank in the whole image. After the backward pass `means2d.grad`
            (n, 2) is the gradient with respect to the projected means, per px.
        means2d_abs: (n, 2), as in `Batch.means2d_abs`; None unless asked for.
        first_id: Global id of the first Gaussian of this rank.
        count: Number of Gaussians of all ranks.
        anchor: () zero, to be added to the loss of every rank, as in `Batch`.
        group: Of torch.distributed.
    """

    rows: tuple[tuple[int, int], ...]
    rank: int
    image: torch.Tensor
    alpha: torch.Tensor
    shard: Splats
    means2d_abs: torch.Tensor | None
    first_id: int
    count: int
    anchor: torch.Tensor
    group: dist.ProcessGroup | None

    def whole(self) -> tuple[torch.Tensor, torch.Tensor] | None:
        """Image (3, H, W) and alpha (1, H, W) on rank 0, None on the others. Without gradient; all ranks call it."""
        if len(self.rows) == 1:
            return self.image.detach(), self.alpha.detach()
        own = torch.cat([self.image, self.alpha]).detach().movedim(1, 0).contiguous()
        sizes = [end - first for first, end in self.rows]
        received = sizes if self.rank == 0 else [0] * len(sizes)
        out = own.new_empty(sum(received), *own.shape[1:])
        dist.all_to_all_single(out, own, received, [len(own), *[0] * (len(sizes) - 1)], group=self.group)
        whole = out.movedim(0, 1)
        return (whole[:3].contiguous(), whole[3:].contiguous()) if self.rank == 0 else None


def rasterize_bands(
    settings: GaussianRasterizationSettings,
    means3D: torch.Tensor,
    opacities: torch.Tensor,
    *,
    shs: torch.Tensor | None = None,
    colors_precomp: torch.Tensor | None = None,
    scales: torch.Tensor | None = None,
    rotations: torch.Tensor | None = None,
    cov3D_precomp: torch.Tensor | None = None,
    means2d_abs: bool = False,
    group: dist.ProcessGroup | None = None,
) -> Band:
    """Renders one camera from Gaussians that are sharded over ranks, each rank a band of rows of the image.

    For images and scenes that are too large for one device. Every rank of the group calls it. The bands have about as
    many pairs of a tile and a splat as each other; a splat is sent to every rank whose band it touches.

    The bands together are the image of one rank with all Gaussians, bit for bit, on CUDA where lists are long and with
    some footprints to rounding (docs/internals/distributed.md); gradients are the same up to the order in which bands
    are added up. Differentiable in what `project` is differentiable in, and in the background. Gradients with respect
    to the camera and the background are on each rank a part: their sum over the ranks is the whole. Waits for the
    device.

    Args:
        settings: Of the camera, the same on every rank, bit for bit; background and 3D filter as in `rasterize`.
        group, others: As of `rasterize`.

    Raises:
        TypeError, ValueError, RuntimeError: As `rasterize`.
    """
    rank, world = place_in(group)
    means3D, opacities, shs, colors_precomp = map(widened, (means3D, opacities, shs, colors_precomp))
    scales, rotations, cov3D_precomp = map(widened, (scales, rotations, cov3D_precomp))
    if isinstance(settings, GaussianRasterizationSettings):
        settings = widened_settings(settings)

    def make() -> tuple[tuple, Facts | None, None]:
        if not isinstance(settings, GaussianRasterizationSettings):
            raise TypeError(f"settings must be GaussianRasterizationSettings, got {type(settings).__name__}")
        check_camera(settings)
        check_colors(shs, colors_precomp)
        gaussians = {"shs": shs, "colors_precomp": colors_precomp, "scales": scales, "rotations": rotations}
        shard = project(settings, means3D, opacities, cov3D_precomp=cov3D_precomp, **gaussians)
        absolute = torch.zeros_like(shard.means2d, requires_grad=True) if means2d_abs else None
        if world == 1:
            return (shard, absolute, None), None, None
        differentiable = [getattr(shard, name) for name in DIFFERENTIABLE] + [absolute] * means2d_abs
        facts = facts_of(means3D, [*differentiable, settings.bg], group)
        camera = camera_arguments(settings, means3D, shs)
        camera = {name: value[None] if torch.is_tensor(value) else value for name, value in camera.items()}
        facts["settings"] = digest_of([([0], camera)], means2d_abs)
        return (shard, absolute, _touched(shard)), facts, None

    if world == 1:
        (shard, absolute, _), *_ = make()
        rows = ((0, shard.height),)
        own, of_means, anchor = shard, absolute, means3D.new_zeros(())
        first_id, count = 0, len(means3D)
    else:
        (shard, absolute, touched), agreed = agree(make, _REQUIREMENTS, group)
        first_id, count, join = summary_of(agreed.facts, rank)
        pairs = [sum(of_row) for of_row in zip(*gather(touched.pairs, world, group))]
        bands = balanced_bands(pairs, world)
        places = [((touched.first < end) & (touched.last >= first)).nonzero()[:, 0] for first, end in bands]
        parts = tuple(_part(shard, of_band) for of_band in places)
        counts = gather([len(of_band) for of_band in places], world, group)
        route = Route(counts, [[r] for r in range(world)], rank, group)
        sent = () if absolute is None else tuple(absolute.index_select(0, of_band) for of_band in places)
        own, of_means, anchor = exchange(route, parts, sent, first_id, join)
        rows = tuple(tuple(min(cut * touched.side, shard.height) for cut in band) for band in bands)
        # Rows below the band are left out. Those above stay, because moving the origin would round positions.
        own = dataclasses.replace(own, height=max(rows[rank][1], 1))
    if shard.means2d.requires_grad:
        shard.means2d.retain_grad()
    bg = settings.bg
    lists = list_tiles(own, keep=torch.is_grad_enabled())
    images, alphas = blend(own, lists, background=bg, means2d_abs=of_means)
    first, end = rows[rank]
    image, alpha = images[0, :, first:end], alphas[0, :, first:end]
    return Band(rows, rank, image, alpha, shard, absolute, first_id, count, anchor, group)


@dataclass(frozen=True)
class _Touched:
    """Which rows of tiles the splats of this rank touch.

    Attributes:
        first, last: (n,) int64, of every splat; first > last where it touches none.
        pairs: How many pairs of a tile and a splat each row of tiles has.
        side: Of a tile, px.
    """

    first: torch.Tensor
    last: torch.Tensor
    pairs: list[int]
    side: int


def _touched(splats: Splats) -> _Touched:
    """By the lists of `list_tiles`, so that no splat is missed, whatever the footprint."""
    for _ in range(_ATTEMPTS):
        lists = list_tiles(splats, keep=False).of_camera()
        pairs, offsets = lists["pairs"], lists["tile_offsets"]
        if not pairs.is_cuda or int(lists["counts"][0]) <= len(pairs):
            break  # on CUDA there may have been more pairs than were expected, and then tiles share lists
    else:
        raise RuntimeError("the lists of tiles did not fit the memory that was guessed for them")
    side = tile_size(splats.footprint, splats.option, splats.width, splats.height, pairs.is_cuda)
    columns, rows = -(-splats.width // side), -(-splats.height // side)
    of_rows = offsets.diff().view(rows, columns).sum(1)
    pairs = (pairs if pairs.dim() == 1 else pairs[:, 0])[: offsets[-1]].long()
    row = torch.arange(rows, device=offsets.device).repeat_interleave(of_rows)
    n = len(splats.means2d)
    first, last = row.new_full((n,), rows), row.new_full((n,), -1)
    first.scatter_reduce_(0, pairs, row, "amin")
    last.scatter_reduce_(0, pairs, row, "amax")
    return _Touched(first, last, of_rows.tolist(), side)


def balanced_bands(pairs: list[int], world: int) -> list[tuple[int, int]]:
    """(first, end) rows of tiles of each rank, one after the other, of about as many pairs each.

    Args:
        pairs: Of every row of tiles; where there are none at all, rows count alike.
    """
    before = [0, *accumulate(pairs if any(pairs) else [1] * len(pairs))]
    cuts = [0]
    for k in range(1, world):
        wanted = before[-1] * k / world
        cut = bisect_left(before, wanted)
        if cut > 0 and wanted - before[cut - 1] < before[cut] - wanted:
            cut -= 1
        cuts.append(max(cut, cuts[-1]))
    cuts.append(len(pairs))
    return list(pairwise(cuts))


def _part(splats: Splats, rows: torch.Tensor) -> Splats:
    """Those rows, of one camera."""
    names = ("means2d", "cov2d", "opacities", "depths", "colors", "radii", "gaussian_ids", "camera_ids", "dets")
    taken = {name: getattr(splats, name).index_select(0, rows) for name in names}
    return dataclasses.replace(splats, row_splits=torch.tensor([0, len(rows)], device="cpu"), **taken)
