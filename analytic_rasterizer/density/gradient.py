"""Growth where the gradients of projected means are large, and pruning [3DGS], [AbsGS]."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from .. import ops  # noqa: F401  (registers the fake kernels)
from ..cameras.rotations import rotation_matrices
from ..checks import check_value, plain_value
from ..gaussians import Gaussians
from ..optim import clear_moments
from .control import FixedDensity, normal_numbers, passes
from .options import GradientOptions, options_of

_observe = torch.ops.analytic_rasterizer.observe_.default

SHRINKAGE = 1.6  # of the two halves of a Gaussian
RESET_OPACITY = 0.01


class GradientDensity(FixedDensity):
    """Clones and splits where the gradients are large, and prunes what is transparent or too large.

    [3DGS] with signed gradients, or [AbsGS] with sums of absolute values.

    Args:
        extent: Radius of the scene, world units, positive: `training.extent_of` takes it from
            the cameras, as 3DGS does, and from what they see.
        options: None: the defaults.
        others: As of `FixedDensity`.

    Raises:
        TypeError, ValueError: As of `FixedDensity`, or extent is not positive and finite.
    """

    row_state = ("gradient_sums", "views")

    def __init__(
        self,
        gaussians: Gaussians,
        optimizer: torch.optim.Optimizer,
        extent: float,
        options: GradientOptions | None = None,
        **others: Any,
    ):
        self.options = options_of(GradientOptions, options)
        self.extent = plain_value("extent", extent, float)
        check_value("extent", 0 < self.extent < math.inf, "positive and finite", extent)
        super().__init__(gaussians, optimizer, **others)
        self.growing = self.options.densify_until > 0
        self.first_count = sum(self.ranks.exchange(len(gaussians.means)))
        self.forget()

    @property
    def watches(self) -> bool:
        return self.growing

    @property
    def columns(self) -> int:
        return 4 if self.options.absolute else 3

    def observe_gradients(self, gradients: Tensor, radii: Tensor) -> None:
        # Columns 2 and 3 of four are the sums of absolute values.
        _observe(self.gradient_sums, self.views, gradients, radii, 2 if self.options.absolute else 0)

    @torch.no_grad()
    def observe_rows(self, rows: Tensor, gradients: Tensor) -> None:
        self.gradient_sums[rows] += torch.linalg.vector_norm(gradients, dim=1)
        self.views[rows] += 1

    @torch.no_grad()
    def after_step(self, step: int, share: float, stride: int = 1) -> bool:
        options = self.options
        if not self.growing or share >= options.densify_until:
            self.growing = False
            return False
        changes = step > options.densify_from and passes(step, options.densify_every, stride)
        if changes:
            self._grow(self.gradient_sums / self.views.clamp_min(1), share / options.densify_until)
            self.forget()
            self._prune(too_large=step > options.reset_every > 0)
        begins = step - stride < options.densify_from <= step
        if options.reset_every and (passes(step, options.reset_every, stride) or (options.white_background and begins)):
            self._lower_opacities()
        return changes

    def state_dict(self) -> dict[str, Any]:
        own = {"growing": self.growing, "gradient_sums": self.gradient_sums, "views": self.views}
        own["first_count"] = self.first_count
        return super().state_dict() | own

    def load_state_dict(self, state: dict[str, Any]) -> None:
        count, found = len(self.gaussians.means), len(state["views"])
        if count != found:
            raise ValueError(f"state must be of {count} Gaussians, as many as there are, got {found}")
        super().load_state_dict(state)
        self.growing, self.first_count = state["growing"], state["first_count"]
        self.gradient_sums = state["gradient_sums"].to(self.gradient_sums.device, copy=True)
        self.views = state["views"].to(self.views.device, copy=True)

    def forget(self) -> None:
        means = self.gaussians.means
        self.gradient_sums = torch.zeros(len(means), dtype=means.dtype, device=means.device)
        self.views = torch.zeros(len(means), dtype=torch.int32, device=means.device)

    def _grow(self, gradients: Tensor, over: float) -> None:
        """Clones and splits by the average norms (N,); each of them adds one Gaussian.

        Args:
            over: Share of the time of growth that is over, 0 to 1.
        """
        old = self.gaussians
        grown = gradients >= self.options.growth_gradient
        limit = self.options.max_gaussians
        if limit:
            # If all room were taken at once, Gaussians would go where the first, blurred pictures ask for them.
            if limit > self.first_count:
                limit = self.first_count + int(over * (limit - self.first_count))
            room = self.ranks.allowed(limit, len(grown), int(grown.sum()))
            chosen = torch.where(grown, gradients, -1).topk(room).indices
            grown = torch.zeros_like(grown).index_fill_(0, chosen, True)
        large = old.log_scales.amax(1).exp() > self.options.split_above * self.extent
        cloned, parents = grown & ~large, grown & large
        added = split(old.rows(parents), self.generator)._asdict()
        added |= {name: torch.cat([tensor[parents]] * 2) for name, tensor in self.extra.items()}
        added = {name: torch.cat([tensor[cloned], added[name]]) for name, tensor in self._tensors().items()}
        self._replace(~parents, added)

    def _prune(self, too_large: bool) -> None:
        old, options = self.gaussians, self.options
        kept = opaque = old.logit_opacities[:, 0].sigmoid() >= options.prune_opacity
        if too_large:
            kept = opaque & (old.log_scales.amax(1).exp() <= options.prune_above * self.extent)
        self.pruned = {"opacity": (~opaque).sum(), "size": (opaque & ~kept).sum()}
        self.keep(kept)

    def _lower_opacities(self) -> None:
        logits = self.gaussians.logit_opacities
        logits.clamp_(max=math.log(RESET_OPACITY / (1 - RESET_OPACITY)))
        clear_moments(self.optimizer, logits)


def split(parents: Gaussians, generator: torch.Generator) -> Gaussians:
    """Two Gaussians for each parent, drawn from its distribution, smaller and otherwise like it."""
    twice = parents.map(lambda field: torch.cat([field, field]))
    normal = normal_numbers(twice.means, generator)
    along = twice.log_scales.exp() * normal
    offsets = (rotation_matrices(twice.rotations) * along[:, None, :]).sum(2)
    return twice._replace(means=twice.means + offsets, log_scales=twice.log_scales - math.log(SHRINKAGE))
