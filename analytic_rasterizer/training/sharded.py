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

from ..distributed import OwnSplats
from ..distributed.ranks import Ranks, even_counts
from ..gaussians import Gaussians
from ..losses import l1_ssim
from ..optim import MOMENTS
from .extent import extent_of
from .model import filtered, render_together
from .trainer import Trainer

BETAS = (0.9, 0.999)  # of one process, the defaults of FusedAdam
UNEVEN = 1.1  # the largest shard, in means of all, above which Gaussians move to other ranks


class Seen(NamedTuple):
    """A picture of a step that density control looks at, and where its gradients are."""

    ids: Tensor  # (n,) int32, the Gaussians of this rank that it shows
    means2d: Tensor  # (n, 2) whose grad is with respect to their projected means, px, or sums of absolute values
    size: tuple[int, int]  # width and height of the rendering, px


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

    @torch.enable_grad()  # whatever the caller has switched off
    def _differentiate(self) -> tuple[Tensor, Tensor | None]:
        """As of `Trainer`, by autograd, which sends gradients to the ranks that they belong to."""
        loss, seen, rows = self._loss()
        with torch.autograd.set_multithreading_enabled(False):  # as in gradients_by_autograd
            loss.backward()
        self._observe(seen)
        return loss.detach(), rows

    def _loss(self) -> tuple[Tensor, list[Seen], Tensor | None]:
        """This rank's part of the loss, whose sum over the ranks is the loss of the step; what `_observe` takes; and
        with `sparse_adam` the rows that the optimizer updates.

        A picture of any rank shows what is to be updated: this rank has projected its own Gaussians into all of them.
        """
        options, shown = self.options, self._next()
        gaussians = self.gaussians.arguments()
        batch = render_together(
            filtered(gaussians, self.filter_3d),
            [picture.settings for picture in shown],
            options.supersampling,
            means2d_abs=options.density == "absgrad",
            group=self.ranks.group,
        )
        loss = batch.anchor
        for rendering in batch.renderings:
            picture = shown[rendering.camera]
            truth = self.pictures.target(picture.scale, picture.view, picture.background)
            mask = self.pictures.mask(picture.scale, picture.view)
            loss = loss + l1_ssim(rendering.image, truth, options.ssim_weight, mask) / len(shown)
            self._last = rendering.image.detach(), truth, mask
        opacity_weight, scale_weight = options.regularizers
        if opacity_weight:
            loss = loss + opacity_weight * gaussians["opacities"].sum() / batch.count
        if scale_weight:
            loss = loss + scale_weight * gaussians["scales"].sum() / (3 * batch.count)
        rows = self._visible(batch.shard) if options.sparse_adam else None
        # What else there is of the batch is let go of, before the backward pass needs the memory.
        seen = []
        for camera, (picture, splats) in enumerate(zip(shown, batch.shard)):
            if self._watches(picture.scale):
                leaf = batch.means2d_abs[camera] if batch.means2d_abs else splats.means2d
                seen.append(Seen(splats.gaussian_ids, leaf, (splats.width, splats.height)))
        return loss, seen, rows

    def _visible(self, shard: Sequence[OwnSplats]) -> Tensor:
        """Which Gaussians of this rank at least one of the pictures shows, (P,) bool. Waits for no device."""
        means = self.gaussians.means
        rows = torch.zeros(len(means), dtype=torch.bool, device=means.device)
        for splats in shard:
            rows[splats.gaussian_ids.long()] |= splats.radii > 0  # a picture has each of them once
        return rows

    def _observe(self, seen: list[Seen]) -> None:
        """Density control sees the gradients that each picture would have in one process."""
        for ids, leaf, size in seen:
            if len(ids) == 0:
                continue
            # From px to normalized device coordinates, and from the mean over all ranks' pictures to that over one's.
            # Column by column: a tensor of two numbers from the host would wait for the device.
            columns = [leaf.grad[:, k] * (size[k] / 2 * self.stride) for k in range(2)]
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
        self.density.forget()

    @torch.enable_grad()
    def warm_up(self) -> None:
        """Renders and differentiates the pictures of the first step without taking it."""
        state = self.generator.get_state()
        self._loss()[0].backward()
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
        super().load_state_dict(state | own)


def shards_of(state: dict[str, Any], ranks: Ranks) -> list[int] | None:
    """How many Gaussians of a checkpoint each rank has, where it is of as many ranks; None: it is not."""
    counts = state.get("shards", [])
    return counts if len(counts) == ranks.world else None
