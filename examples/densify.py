"""Adaptive density control of Gaussians during training.

[3DGS] Kerbl et al., "3D Gaussian Splatting for Real-Time Radiance Field Rendering", 2023, section 5.2. Every 100 steps
in the first half of the training

- Gaussians whose projected mean would like to move, by the average norm of dL/d(mean) over the views that saw them, are
  *grown*: small ones are cloned, large ones split into two that are 1.6 times smaller;
- transparent ones, and after the first reset of opacities also those that are large in the world, are pruned.

Every 3,000 steps all opacities are lowered, so that those which matter rise again and the others are pruned.

The gradient is that by normalized device coordinates, which span 2 over the picture: dL/dx is W/2 times the derivative
by pixels, dL/dy H/2 times. The loss is a mean over the picture, so that as a function of these coordinates it does not
depend on the resolution, but for the detail that coarse pixels lose. Views at all scales therefore enter one average,
with one threshold, as they would in the trainer of 3DGS.

Where the paper leaves a choice: a clone stays where its original is, and the momentum that only the original has takes
them apart; size in the picture is no reason to prune, as it would depend on the resolution; and on a white background
opacities are also lowered when growth begins, since white Gaussians in front of the object cost nothing there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from gaussians import Gaussians, rotate

SHRINKAGE = 1.6  # of the two halves of a Gaussian
RESET_OPACITY = 0.01


@dataclass(frozen=True)
class DensityOptions:
    """When and what to grow and prune; defaults are those of 3DGS."""

    start: int = 500  # no growth up to this step
    until: float = 0.5  # of the training
    every: int = 100  # steps
    reset_every: int = 3000  # steps
    gradient: float = 2e-4  # average norm above which a Gaussian is grown
    split_above: float = 0.01  # largest scale that is cloned rather than split, in extents of the scene
    prune_above: float = 0.1  # largest scale that is kept, in extents of the scene
    opacity: float = 0.005  # least that is kept
    most: int | None = None  # Gaussians; the largest gradients go first


class DensityControl:
    """Grows and prunes the Gaussians that `optimizer` trains.

    Call `after_step` after every step of the optimizer, having rendered with `means2D`. Both `gaussians` and
    `means2D` may be others afterwards.

    Args:
        gaussians: The parameters, in the order of the optimizer's groups.
        extent: Radius of the scene, world units.
        white_background: Whether opacities are also lowered at the start.
        seed: Of the places of split Gaussians.

    Attributes:
        means2D: (P, 3), receives the gradient of the projected means; None once nothing is to be grown any more.
    """

    def __init__(
        self,
        gaussians: Gaussians,
        optimizer: torch.optim.Adam,
        extent: float,
        options: DensityOptions,
        white_background: bool = False,
        seed: int = 0,
    ):
        self.gaussians, self.optimizer = gaussians, optimizer
        self.extent, self.options, self.white_background = extent, options, white_background
        self.generator = torch.Generator().manual_seed(seed)
        self.means2D: Tensor | None = None
        if options.until > 0:
            self._forget()

    @torch.no_grad()
    def after_step(self, step: int, progress: float, radii: Tensor) -> None:
        """Looks at the gradients of a step, and acts where it is time.

        Args:
            step: Steps taken, this one included.
            progress: Share of the training that is over, 0 to 1.
            radii: (P,) of the picture that was rendered.
        """
        if self.means2D is None:
            return
        options = self.options
        if progress >= options.until:
            self.means2D = None
            return
        seen = radii > 0
        self.gradient_sums += seen * self.means2D.grad[:, :2].norm(dim=1)
        self.views += seen
        self.means2D.grad = None
        if step > options.start and step % options.every == 0:
            self._grow(self.gradient_sums / self.views.clamp_min(1))
            self._prune(too_large=step > options.reset_every)
            self._forget()
        if step % options.reset_every == 0 or (self.white_background and step == options.start):
            self._lower_opacities()

    def _forget(self) -> None:
        """Begins new averages."""
        count, device = len(self.gaussians.means), self.gaussians.means.device
        self.means2D = torch.zeros(count, 3, device=device, requires_grad=True)
        self.gradient_sums = torch.zeros(count, device=device)
        self.views = torch.zeros(count, dtype=torch.int32, device=device)

    def _grow(self, gradients: Tensor) -> None:
        """Clones and splits by the average norms (P,); each of them adds one Gaussian."""
        old = self.gaussians
        grown = gradients >= self.options.gradient
        if self.options.most is not None:
            room = min(int(grown.sum()), max(self.options.most - len(grown), 0))
            chosen = torch.where(grown, gradients, -1).topk(room).indices
            grown = torch.zeros_like(grown).index_fill_(0, chosen, True)
        large = old.log_scales.amax(1).exp() > self.options.split_above * self.extent
        clones = select(old, grown & ~large)
        halves = split(select(old, grown & large), self.generator)
        added = Gaussians(*(torch.cat(fields) for fields in zip(clones, halves)))
        self.gaussians = replace_rows(old, self.optimizer, ~(grown & large), added)

    def _prune(self, too_large: bool) -> None:
        old, options = self.gaussians, self.options
        kept = old.logit_opacities[:, 0].sigmoid() >= options.opacity
        if too_large:
            kept &= old.log_scales.amax(1).exp() <= options.prune_above * self.extent
        self.gaussians = replace_rows(old, self.optimizer, kept, select(old, slice(0)))

    def _lower_opacities(self) -> None:
        logits = self.gaussians.logit_opacities
        logits.clamp_(max=math.log(RESET_OPACITY / (1 - RESET_OPACITY)))
        for moment in ("exp_avg", "exp_avg_sq"):
            self.optimizer.state[logits][moment].zero_()


def select(gaussians: Gaussians, rows: Tensor | slice) -> Gaussians:
    return Gaussians(*(field[rows] for field in gaussians))


def split(parents: Gaussians, generator: torch.Generator) -> Gaussians:
    """Two Gaussians for each parent, drawn from its distribution, smaller and otherwise like it."""
    twice = Gaussians(*(torch.cat([field, field]) for field in parents))
    normal = torch.randn(len(twice.means), 3, generator=generator).to(twice.means.device)
    offsets = rotate(twice.rotations, twice.log_scales.exp() * normal)
    return twice._replace(means=twice.means + offsets, log_scales=twice.log_scales - math.log(SHRINKAGE))


def replace_rows(old: Gaussians, optimizer: torch.optim.Adam, kept: Tensor, added: Gaussians) -> Gaussians:
    """The rows of `old` that the mask `kept` (P,) names, then those of `added`, as the parameters of `optimizer`.

    Moments of kept rows are kept, those of added ones are zero. The optimizer has taken a step before.
    """
    new = Gaussians(*(torch.cat([field[kept], more]).requires_grad_() for field, more in zip(old, added)))
    for group, before, after, more in zip(optimizer.param_groups, old, new, added):
        state = optimizer.state.pop(before)
        for moment in ("exp_avg", "exp_avg_sq"):
            state[moment] = torch.cat([state[moment][kept], torch.zeros_like(more)])
        optimizer.state[after] = state
        group["params"] = [after]
    return new
