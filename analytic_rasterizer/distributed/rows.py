"""A step of `rasterize` on one rank: projects its Gaussians, sends splats to the ranks of the cameras, and blends.

The gradients go back the same way. A row is a splat in one piece (PackedRow in csrc/core/stages.h). Rows are written
where they are sent from and blended where they arrive, and so are their gradients. With one camera per rank they are
not copied in between.
"""

from __future__ import annotations

import weakref
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import accumulate
from typing import Any, ClassVar, NamedTuple

import torch
from torch.autograd.function import once_differentiable

from .. import _C
from ..render.settings import GaussianRasterizationSettings
from ..render.stages import Splats, project_arguments
from .exchange import ID_OF, Route

_OPS = torch.ops.analytic_rasterizer
_TENSORS = ("means3D", "opacities", "shs", "colors_precomp", "scales", "rotations", "cov3D_precomp")
_CAMERA_TENSORS = ("viewmatrix", "projmatrix", "campos", "lens")
_IMAGE = ("image_height", "image_width", "footprint", "option")
_GUESSES = 16  # that are kept at most


class OwnSplats(NamedTuple):
    """The splats of this rank's Gaussians in one camera, as far as density control needs them.

    Attributes:
        means2d: (n, 2) px. After the backward pass `grad` is the gradient with respect to it, per px.
        radii: (n,) int32, px. On several ranks 0 of a Gaussian whose colour is not finite.
        gaussian_ids: (n,) int32, the row of each splat's Gaussian on this rank, ascending.
        width, height: Of the image, px.
    """

    means2d: torch.Tensor
    radii: torch.Tensor
    gaussian_ids: torch.Tensor
    width: int
    height: int


@dataclass(frozen=True)
class Together:
    """Cameras that the ops take together, and the Gaussians of this rank for them.

    Attributes:
        cameras: Their places in the settings.
        gaussians, batch: Arguments of the ops.
    """

    cameras: list[int]
    gaussians: dict[str, Any]
    batch: dict[str, Any]

    @property
    def tensors(self) -> list[torch.Tensor | None]:
        """Those that the rows depend on, some of which are missing."""
        return [self.gaussians[name] for name in _TENSORS] + [self.batch[name] for name in _CAMERA_TENSORS]

    def arguments(self, tensors: Sequence[torch.Tensor | None]) -> dict[str, Any]:
        """All arguments, with such tensors in the place of `tensors`."""
        return self.gaussians | self.batch | dict(zip((*_TENSORS, *_CAMERA_TENSORS), tensors))


def together(
    cameras: list[GaussianRasterizationSettings], means3D: torch.Tensor, opacities: torch.Tensor, **gaussians: Any
) -> list[Together]:
    """The cameras by what they have in common."""
    return [
        Together(places, *project_arguments([cameras[c] for c in places], means3D, opacities, **gaussians))
        for places in agreeing(cameras).values()
    ]


def agreeing(cameras: list[GaussianRasterizationSettings]) -> dict[tuple, list[int]]:
    """The places of cameras that may share a call of `project`, which adds up their gradients in place."""
    groups: dict[tuple, list[int]] = {}
    for camera, s in enumerate(cameras):
        moves = any(getattr(t, "requires_grad", False) for t in (s.viewmatrix, s.projmatrix, s.campos))
        size = s.image_height, s.image_width
        key = (*size, s.scale_modifier, s.sh_degree, str(s.footprint), id(s.effects), moves)
        groups.setdefault(key, []).append(camera)
    return groups


def _at(values: torch.Tensor, places: Sequence[int]) -> torch.Tensor:
    """The values at these places of a vector. Without an index, for which the host would wait until it is copied."""
    if list(places) == list(range(len(values))):
        return values
    return torch.stack([values[place] for place in places])


class Shard:
    """The rows of this rank's Gaussians in all cameras, in the order in which they are sent.

    They can be written before the host knows how many they are: where each camera's begin is known on the device, and
    how much room they need is guessed from the steps before. What has been guessed wrong is written again. Waits for no
    device.

    Attributes:
        groups: All cameras.
        counts: (C,) int64, rows of each camera, on the device.
    """

    # Room, and id of the first Gaussian, by how many cameras and Gaussians there are. A wrong guess costs time or
    # memory, not more: `finish` checks it.
    _guesses: ClassVar[dict[tuple, tuple[int, int]]] = {}

    def __init__(self, groups: list[Together], order: list[int]):
        self.groups = groups
        means3D = groups[0].gaussians["means3D"]
        with torch.no_grad():
            # (C, P) int32 of each group: how many Gaussians, up to each one, have a row of each camera.
            self._ends = [_OPS.count_rows(**group.gaussians, **group.batch) for group in groups]
        counts = [ends[:, -1].long() if len(means3D) else ends.new_zeros(len(ends)).long() for ends in self._ends]
        grouped = [c for group in groups for c in group.cameras]
        self.counts = _at(torch.cat(counts), [grouped.index(c) for c in range(len(order))])
        sent = _at(self.counts, order)
        firsts = _at(sent.cumsum(0) - sent, [order.index(c) for c in grouped])
        self._firsts = firsts.split([len(group.cameras) for group in groups])
        self._key = len(order), len(means3D), means3D.device
        self._most = len(order) * len(means3D)
        self._made: tuple[torch.Tensor, ...] | None = None
        self._first_id = 0

    def begin(self) -> None:
        """Writes rows as far as they can be guessed. Does not raise: what fails here, `finish` does again."""
        guess = self._guesses.get(self._key)
        if guess is None:
            return
        room, first_id = guess
        with suppress(Exception):
            self._write(min(room, self._most), first_id)

    def finish(self, total: int, first_id: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """All rows (total, ROW_WIDTH), their radii and ids (total,), the ids in the rows counting from `first_id`."""
        if self._made is None or len(self._made[0]) < total or self._first_id != first_id:
            self._made = None
            self._write(total, first_id)
        last, _ = self._guesses.pop(self._key, (0, 0))
        self._guesses[self._key] = max(total + total // 16, last * 15 // 16), first_id
        if len(self._guesses) > _GUESSES:
            del self._guesses[next(iter(self._guesses))]  # not used for longest: density control changes the key
        rows, radii, ids = (t[:total] for t in self._made)
        self._made, self._ends = None, []
        return rows, radii, ids

    @torch.no_grad()
    def _write(self, room: int, first_id: int) -> None:
        like = self.groups[0].gaussians["means3D"]
        rows = like.new_empty(room, _C.ROW_WIDTH)
        radii, ids = (like.new_empty(room, dtype=torch.int32) for _ in range(2))
        for group, ends, firsts in zip(self.groups, self._ends, self._firsts):
            arguments = group.gaussians | group.batch
            _OPS.pack_rows_(rows, radii, ids, **arguments, ends=ends, firsts=firsts, first_id=first_id)
        self._made, self._first_id = (rows, radii, ids), first_id


@dataclass
class Step:
    """A step between its agreement and its backward pass.

    Attributes:
        shard: The rows of this rank's Gaussians.
        route: Which rows go where.
        first_id: Global id of the first Gaussian of this rank.
        join: Whether any rank needs a gradient, so that all take part in the backward pass.
        absolute: Whether sums of absolute gradients are wanted.
        backgrounds: (3,) of the cameras of this rank.
        own: Made by the forward pass: the splats of this rank's Gaussians, by camera.
        received: The splats of this rank's cameras.
        means2d_abs: (n, 2) for each camera, which the backward pass gives gradients; empty unless wanted.
    """

    shard: Shard
    route: Route
    first_id: int
    join: bool
    absolute: bool
    backgrounds: list[torch.Tensor]
    own: tuple[OwnSplats, ...] = ()
    received: tuple[Splats, ...] = ()
    means2d_abs: tuple[torch.Tensor, ...] = ()

    def __post_init__(self):
        self.groups = self.shard.groups
        self._images = {c: {n: group.batch[n] for n in _IMAGE} for group in self.groups for c in group.cameras}
        counts = self.route.counts[self.route.rank]
        ends = accumulate(counts[c] for c in self.route.order)
        sent = {c: slice(end - counts[c], end) for c, end in zip(self.route.order, ends)}
        self._sent = [sent[c] for c in range(len(sent))]  # the rows of each camera among those that are sent
        self._ids: torch.Tensor | None = None
        self._blended: list[list[torch.Tensor]] | None = []  # what is saved of each camera; None: it has been used
        self._means2d: dict[int, weakref.ref] = {}

    def take(self) -> tuple[tuple[OwnSplats, ...], tuple[Splats, ...]]:
        """What the forward pass made of splats, own and received, which the step then lets go of."""
        made = self.own, self.received
        self.own = self.received = ()
        return made

    def places(self, group: Together) -> dict[str, list[int]]:
        """Where the rows of cameras are, by the names of the ops."""
        counts = self.route.counts[self.route.rank]
        return {"firsts": [self._sent[c].start for c in group.cameras], "counts": [counts[c] for c in group.cameras]}

    def exchange(self) -> list[tuple[torch.Tensor, torch.Tensor, dict[str, Any]]]:
        """Of this rank's cameras the rows of all ranks, the background, and size and footprint by names of the ops."""
        sent = self._rows_of_shard()
        rows = self.route.by_camera(self.route.send(sent, True))
        images = [self._images[camera] for camera in self.route.own]
        return list(zip(rows.split(self.route.sizes), self.backgrounds, images))

    def run(self) -> tuple[torch.Tensor, ...]:
        """Images (3, H, W) of this rank's cameras, and then their alphas (1, H, W)."""
        images, alphas, received = [], [], []
        for of_camera, background, image in self.exchange():
            color, alpha, saved = _OPS.blend_rows(of_camera, background.detach(), **image, keep=self.join)
            images.append(color)
            alphas.append(alpha[None])
            self._blended.append(saved)
            received.append(_splats_of(of_camera, image))
        self.received = tuple(received)
        return *images, *alphas

    def _rows_of_shard(self) -> torch.Tensor:
        """The rows of this rank's Gaussians in all cameras, in the order in which they are sent."""
        rows, radii, self._ids = self.shard.finish(sum(self.route.counts[self.route.rank]), self.first_id)
        own = []
        for camera, part in enumerate(self._sent):
            means2d = rows[part, _C.ROW_COLUMNS["means2d"]].contiguous()  # the rows go when they have been sent
            image = self._images[camera]
            own.append(OwnSplats(means2d, radii[part], self._ids[part], image["image_width"], image["image_height"]))
        self.own = tuple(own)
        if self.absolute:
            self.means2d_abs = tuple(rows.new_zeros(()).expand(len(s.means2d), 2) for s in own)
        for group in self.groups:
            if self.join and any(t is not None and t.requires_grad for t in group.tensors):
                self._means2d |= {c: weakref.ref(own[c].means2d) for c in group.cameras}
        return rows

    def run_back(
        self, dL_dimages: Sequence[Any], dL_dalphas: Sequence[Any], needs: Sequence[bool], tensors: list[Any]
    ) -> list[Any]:
        """Gradients with respect to the backgrounds and then `tensors`, those of group after group; `needs` are theirs.

        Gives own means2d and means2d_abs their gradients.
        """
        blended, self._blended = self._blended, None
        if blended is None:
            raise RuntimeError("the backward pass of distributed.rasterize runs once: it overwrites what was saved")
        width = _C.ROW_GRAD_WIDTHS[int(self.absolute)]
        of_backgrounds, by_camera = [], []
        for k, (camera, bg) in enumerate(zip(self.route.own, self.backgrounds)):
            saved, blended[k] = blended[k], []
            rows = saved[0].view(-1)[: len(saved[0]) * width].view(-1, width)  # in the place of splats
            of_bg = _OPS.blend_rows_vjp_(
                rows,
                dL_dimages[k],
                None if dL_dalphas[k] is None else dL_dalphas[k][0],
                bg.detach(),
                **self._images[camera],
                saved=saved,
                needs_background=needs[k],
            )
            of_backgrounds.append(of_bg if needs[k] else None)
            by_camera.append(rows)
            del saved, rows
        own = self.exchange_back(by_camera)
        self._give(own)
        found, step = [], len(_TENSORS) + len(_CAMERA_TENSORS)
        for k, group in enumerate(self.groups):
            part = slice(step * k, step * (k + 1))
            found += self._gradients_of(group, own, tensors[part], needs[len(self.backgrounds) :][part])
        return [*of_backgrounds, *found]

    def exchange_back(self, by_camera: list[torch.Tensor]) -> torch.Tensor:
        """Gradients with respect to the rows of this rank's Gaussians.

        Args:
            by_camera: Those with respect to the rows of this rank's cameras. The list is emptied.
        """
        like, width = self.groups[0].gaussians["means3D"], _C.ROW_GRAD_WIDTHS[int(self.absolute)]
        sent = self.route.by_rank(by_camera) if by_camera else like.new_empty(0, width)
        by_camera.clear()
        return self.route.send(sent, False)

    def _gradients_of(
        self, group: Together, own: torch.Tensor, tensors: Sequence[torch.Tensor | None], needs: Sequence[bool]
    ) -> list[torch.Tensor | None]:
        """Gradients with respect to the tensors of some cameras, from those with respect to their rows."""
        if not any(needs):
            return [None] * len(needs)
        arguments = group.arguments(tensors)
        made = _OPS.pack_rows_vjp(own, **arguments, ids=self._ids, **self.places(group), needs=needs)
        return [t.view_as(tensor) if need else None for t, tensor, need in zip(made, tensors, needs)]

    def gradients(self, own: torch.Tensor) -> dict[str, torch.Tensor]:
        """Gradients with respect to the Gaussians of this rank, of all that are given, by the names of the ops.

        Args:
            own: What `exchange_back` returned.
        """
        total: dict[str, torch.Tensor] = {}
        for group in self.groups:
            needs = [
                name in _TENSORS and t is not None for name, t in zip((*_TENSORS, *_CAMERA_TENSORS), group.tensors)
            ]
            made = self._gradients_of(group, own, group.tensors, needs)
            for name, gradient in zip(_TENSORS, made):
                if gradient is not None:
                    total[name] = total[name] + gradient if name in total else gradient
        return total

    def means_gradients(self, own: torch.Tensor) -> list[torch.Tensor]:
        """Of every camera (n, 2), per px: dL/dmeans2d of this rank's splats; with `absolute`, sums over pixels."""
        columns = _C.ROW_GRAD_COLUMNS["means2d_abs" if self.absolute else "means2d"]
        return [own[part, columns] for part in self._sent]

    def _give(self, own: torch.Tensor) -> None:
        """Gives what the batch holds its gradients, from those with respect to the rows of this rank's Gaussians."""
        for camera, part in enumerate(self._sent):
            rows = own[part]
            means2d = self._means2d.get(camera, lambda: None)()
            if means2d is not None:
                means2d.grad = rows[:, _C.ROW_GRAD_COLUMNS["means2d"]]
            if self.absolute:
                self.means2d_abs[camera].grad = rows[:, _C.ROW_GRAD_COLUMNS["means2d_abs"]]


class _Rasterize(torch.autograd.Function):
    """The step as one node. `join` requires a gradient where any rank needs one, so that all take part in the way back.

    Returns:
        The anchor, the images and the alphas of this rank's cameras.
    """

    @staticmethod
    def forward(ctx: Any, step: Step, join: torch.Tensor | None, *tensors: torch.Tensor | None):
        ctx.set_materialize_grads(False)
        ctx.step = step
        ctx.save_for_backward(*tensors[len(step.backgrounds) :])
        anchor = step.groups[0].gaussians["means3D"].new_zeros(())
        return anchor, *step.run()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, _: torch.Tensor | None, *gradients: torch.Tensor | None):
        step, count = ctx.step, len(gradients) // 2
        needs = list(ctx.needs_input_grad[2:])
        found = step.run_back(gradients[:count], gradients[count:], needs, list(ctx.saved_tensors))
        return None, None, *found


def rendered(step: Step) -> tuple[torch.Tensor, list[torch.Tensor], list[torch.Tensor]]:
    """The anchor, and image (3, H, W) and alpha (1, H, W) of this rank's cameras."""
    like = step.groups[0].gaussians["means3D"]
    join = like.new_zeros((), requires_grad=True) if step.join else None
    tensors = [t for group in step.groups for t in group.tensors]
    anchor, *made = _Rasterize.apply(step, join, *step.backgrounds, *tensors)
    count = len(made) // 2
    return anchor, made[:count], made[count:]


def _splats_of(rows: torch.Tensor, image: dict[str, Any]) -> Splats:
    """Rows of one camera by the names of their columns, without copying them."""
    columns = {name: rows[:, place] for name, place in _C.ROW_COLUMNS.items()}
    ids = columns.pop("gaussian_ids").view(ID_OF[rows.dtype]).int()
    return Splats(
        **columns,
        radii=ids.new_empty(0),
        gaussian_ids=ids,
        camera_ids=ids.new_zeros(1).expand(len(rows)),
        row_splits=torch.tensor([0, len(rows)], device="cpu"),
        width=image["image_width"],
        height=image["image_height"],
        footprint=image["footprint"],
        option=image["option"],
    )
