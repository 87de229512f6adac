"""Training on several ranks: every rank holds a shard of the Gaussians with its part of the optimizer's state.

A step on N ranks renders the pictures of N steps of one process, each rank those of one of them, from the Gaussians of
all ranks (`analytic_rasterizer.distributed`). It counts as N steps: schedules, the order of the pictures and periods
are where they would be in one process, and a checkpoint means the same on any number of ranks.

The optimizer is scaled for the larger batch as in [Grendel] Zhao et al., "On Scaling Up 3D Gaussian Splatting
Training", 2024: learning rates times sqrt(N), and decay rates to the power of N.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from .. import _C
from ..captures.extent import extent_of
from ..distributed import OwnSplats
from ..distributed.cameras import agreed_step
from ..distributed.ranks import Ranks, even_counts
from ..gaussians import Gaussians
from ..optim import MOMENTS
from .control import regularizers_of
from .counting import COUNTED
from .rendering import enlarged
from .trainer import Trainer

_OPS = torch.ops.analytic_rasterizer
_activate, _apply_3d_filter, _rows_picture_gradients = map(
    _C.Call, ("activate", "apply_3d_filter", "rows_picture_gradients")
)

BETAS = (0.9, 0.999)  # of one process, the defaults of FusedAdam
UNEVEN = 1.1  # the largest shard, in means of all, above which Gaussians move to other ranks


class Seen(NamedTuple):
    """A picture of a step that density control looks at, and where its gradients are."""

    ids: Tensor  # (n,) int32, the Gaussians of this rank that it shows
    gradient: Tensor  # (n, 2) with respect to their projected means, per px, or sums of absolute values
    size: tuple[int, int]  # width and height of the rendering, px


class Shapes:
    """The activations of this rank's Gaussians, with the 3D filter, and the way back to the parameters.

    Attributes:
        arguments: Scales (N, 3) and rotations (N, 4), by the names of the ops.
        opacities: (N, 1).
        penalty: () float32, this rank's part of the regularizers; None: there are none.
    """

    def __init__(self, gaussians: Gaussians, filter_3d: Tensor | None, regularizers: tuple[float, float], count: int):
        self._gaussians, self._filter_3d = gaussians, filter_3d
        opacity_weight, scale_weight = regularizers
        self._weights = opacity_weight / count, scale_weight / (3 * count)
        scales, rotations, opacities, penalty = _activate(*gaussians[1:4], *self._weights)
        self._unfiltered = scales, opacities
        if filter_3d is not None:
            scales, opacities = _apply_3d_filter(scales, opacities, filter_3d)
        self.arguments, self.opacities = {"scales": scales, "rotations": rotations}, opacities
        self.penalty = penalty if any(self._weights) else None

    def differentiate(self, gradients: dict[str, Tensor]) -> None:
        """Gives the parameters their gradients, from those of what was rendered, by the names of the ops."""
        scales, opacities = gradients["scales"], gradients["opacities"]
        if self._filter_3d is not None:
            scales, opacities, _ = _OPS.apply_3d_filter_vjp(
                [scales, opacities], *self._unfiltered, self._filter_3d, [], [True, True, False]
            )
        given = [scales, gradients["rotations"], opacities, None if self.penalty is None else scales.new_ones(())]
        made = _OPS.activate_vjp(given, *self._gaussians[1:4], *self._weights, [], [True] * 3)
        for field, gradient in zip(self._gaussians, (gradients["means3D"], *made, gradients["shs"])):
            field.grad = gradient


class ShardedTrainer(Trainer):
    """A `Trainer` whose Gaussians are spread over ranks. Every method is collective, except where it says otherwise.

    Gaussians have the order of one process: those of rank 0 first, then those of rank 1, and so on. Density control is
    that of each rank, and draws from a generator of its own. When the shards have become uneven, the first and last
    Gaussians of ranks move to their neighbours, which leaves the order as it is.

    Args:
        start: All Gaussians, on the CPU; the rank takes its own.
        ranks: More than one.
        counts: Gaussians of each rank; None: as many for each.
        others: As of `Trainer`.

    Attributes:
        gaussians: Those of this rank.
    """

    def __init__(self, options, start: Gaussians, pictures, background, device, ranks: Ranks, counts=None):
        self.counts = even_counts(len(start.means), ranks.world) if counts is None else list(counts)
        rows = ranks.part_of(self.counts)
        extent = extent_of(pictures.views, start.means)  # of all Gaussians, on every rank
        super().__init__(options, start.rows(rows), pictures, background, device, ranks, extent)

    @property
    def count(self) -> int:
        return sum(self.counts)

    @property
    def stride(self) -> int:
        """Of every rank a step; fewer in the end, where fewer are left."""
        steps = self.progress.steps
        return self.ranks.world if steps is None else min(self.ranks.world, steps - self.progress.step)

    def step(self) -> None:
        """Takes one step of the optimizer on all ranks."""
        # What is drawn depends on seed, step and rank alone: there is no state of several ranks to be saved.
        drawn = np.random.SeedSequence([self.options.seed % 2**64, self.ranks.rank, self.progress.step])
        self.density.generator.manual_seed(int(drawn.generate_state(1)[0]))
        super().step()

    def _set_rates(self) -> None:
        super()._set_rates()
        for group in self.optimizer.param_groups:
            group["lr"] *= math.sqrt(self.stride)
            group["betas"] = tuple(beta**self.stride for beta in BETAS)
        self.optimizer.param_groups[-1]["head_lr"] *= math.sqrt(self.stride)

    @torch.no_grad()
    def _differentiate(self) -> tuple[Tensor, Tensor | None]:
        """As of `Trainer`; gradients go to the ranks that they belong to. The loss is this rank's part."""
        loss, seen, rows = self._differentiate_together()
        self._observe(seen)
        return loss, rows

    def _differentiate_together(self) -> tuple[Tensor, list[Seen], Tensor | None]:
        """This rank's part of the loss, whose sum over the ranks is the loss of the step; what `_observe` takes; and
        with `sparse_adam` the rows that the optimizer updates.

        A picture of any rank shows what is to be updated: this rank has projected its own Gaussians into all of them.
        """
        options, shown = self.options, self._next()
        shapes = Shapes(self.gaussians, self.filter_3d, regularizers_of(options, self.extent), self.count)
        step, _ = agreed_step(
            [enlarged(picture.settings, options.supersampling) for picture in shown],
            self.gaussians.means,
            shapes.opacities,
            {"shs": self.gaussians.shs, "colors_precomp": None, "cov3D_precomp": None, **shapes.arguments},
            means2d_abs=options.density == "absgrad",
            group=self.ranks.group,
        )
        by_camera, losses = [], [] if shapes.penalty is None else [shapes.penalty]
        for camera, (rows, background, image) in zip(step.route.own, step.exchange()):
            compared = self._comparison(shown[camera])
            loss, drawn, dL_drows = _rows_picture_gradients(
                rows=rows,
                dL_dloss=self.dL_dloss / self.stride,
                bg=background,
                absolute=step.absolute,
                **compared,
                **image,
            )
            by_camera.append(dL_drows)
            losses.append(loss / len(shown))
            self._last = drawn, compared["target"], compared["mask"]
        own = step.exchange_back(by_camera)
        shapes.differentiate(step.gradients(own))
        splats = step.own
        visible = self._visible(splats) if options.sparse_adam else None
        seen = [
            Seen(of_camera.gaussian_ids, gradient, (of_camera.width, of_camera.height))
            for picture, of_camera, gradient in zip(shown, splats, step.means_gradients(own))
            if self._watches(picture.scale)
        ]
        nothing = torch.zeros((), dtype=torch.float32, device=self.device)
        return torch.stack(losses).sum() if losses else nothing, seen, visible

    def _visible(self, shard: Sequence[OwnSplats]) -> Tensor:
        """Which Gaussians of this rank at least one of the pictures shows, (P,) bool. Waits for no device."""
        means = self.gaussians.means
        rows = torch.zeros(len(means), dtype=torch.bool, device=means.device)
        for splats in shard:
            rows[splats.gaussian_ids.long()] |= splats.radii > 0  # a picture has each of them once
        return rows

    def _observe(self, seen: list[Seen]) -> None:
        """Density control sees the gradients that each picture would have in one process."""
        for ids, gradient, size in seen:
            if len(ids) == 0:
                continue
            # From px to normalized device coordinates, and from the mean over all ranks' pictures to that over one's.
            # Column by column: a tensor of two numbers from the host would wait for the device.
            columns = [gradient[:, k] * (size[k] / 2 * self.stride) for k in range(2)]
            self.density.observe_rows(ids.long(), torch.stack(columns, 1))

    def _rebalance(self) -> None:
        """Moves Gaussians, with their moments, to neighbouring ranks if the largest shard is much above the mean."""
        before = self.ranks.exchange(len(self.gaussians.means))
        total, world = sum(before), self.ranks.world
        if max(before) * world > UNEVEN * total:
            self.counts = even_counts(total, world)
            self._redistribute(before, self.counts)
        else:
            self.counts = before

    @torch.no_grad()
    def _redistribute(self, before: list[int], after: list[int]) -> None:
        """To be called when density control has just begun new averages, which do not move."""

        def moved(rows: Tensor) -> Tensor:
            return self.ranks.move_rows(rows.detach().contiguous(), before, after)

        old, optimizer = self.gaussians, self.optimizer
        new = old.map(lambda field: moved(field).requires_grad_())
        for group, of_old, of_new in zip(optimizer.param_groups, old, new):
            state = optimizer.state.pop(of_old)
            optimizer.state[of_new] = state | {moment: moved(state[moment]) for moment in MOMENTS}
            group["params"] = [of_new]
        self.density.gaussians = new
        self.density.extra = {name: moved(tensor) for name, tensor in self.density.extra.items()}
        self.density.forget()

    @torch.no_grad()
    def warm_up(self) -> None:
        """Renders and differentiates the pictures of the first step without taking it."""
        state = self.generator.get_state()
        self._differentiate_together()
        self.generator.set_state(state)
        self.optimizer.zero_grad(set_to_none=True)

    def take_losses(self) -> list[float]:
        """As of `Trainer`: the losses of all ranks together."""
        parts = self.ranks.exchange(torch.stack(self.losses).tolist() if self.losses else [])
        self.losses = [torch.tensor(math.fsum(of_step), dtype=torch.float64, device="cpu") for of_step in zip(*parts)]
        return super().take_losses()

    def state_dict(self) -> dict[str, Any]:
        """On rank 0 that of one process with all Gaussians, on the CPU, and `shards`, how many each rank has.

        On the other ranks it has no rows. The optimizer's steps and decay rates are those of one process.
        """
        state, whole = super().state_dict(), self.ranks.gather_rows
        state["gaussians"] = {name: whole(rows) for name, rows in state["gaussians"].items()}
        state["optimizer"]["state"] = {
            key: {moment: whole(of_field[moment]) for moment in MOMENTS} | {"step": self.progress.step}
            for key, of_field in state["optimizer"]["state"].items()
        }
        for group in state["optimizer"]["param_groups"]:
            group["betas"] = BETAS
        state["density"] |= {name: whole(state["density"][name]) for name in self.density.row_state}
        if self.filter_3d is not None:
            state["filter_3d"] = whole(self.filter_3d)
        if self.counting is not None:
            state["counting"][COUNTED] = whole(state["counting"][COUNTED])
        return state | {"shards": self.ranks.exchange(len(self.gaussians.means))}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Goes on from what `state_dict` of any number of ranks gave. Not collective.

        Args:
            state: With all Gaussians, as many as the trainer was made for; the rank takes its own.
        """
        rows = self.ranks.part_of(self.counts)

        def part(tensor: Tensor) -> Tensor:
            return tensor[rows].clone()  # else the memory of all rows would be kept

        optimizer, density = state["optimizer"], state["density"]
        steps = round(state["progress"]["step"] / self.ranks.world)
        of_fields = {
            key: of_field | {moment: part(of_field[moment]) for moment in MOMENTS} | {"step": steps}
            for key, of_field in optimizer["state"].items()
        }
        own = {
            "gaussians": {name: part(field) for name, field in state["gaussians"].items()},
            "optimizer": optimizer | {"state": of_fields},
            "density": density | {name: part(density[name]) for name in self.density.row_state},
            "filter_3d": None if state["filter_3d"] is None else part(state["filter_3d"]),
        }
        if state.get("counting") is not None:
            own["counting"] = state["counting"] | {COUNTED: part(state["counting"][COUNTED])}
        super().load_state_dict(state | own)


def shards_of(state: dict[str, Any], ranks: Ranks) -> list[int] | None:
    """How many Gaussians of a checkpoint each rank has, where it is of as many ranks; None: it is not."""
    counts = state.get("shards", [])
    return counts if len(counts) == ranks.world else None
