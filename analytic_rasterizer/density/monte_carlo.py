"""Gaussians as samples of a Markov chain: relocation, addition and noise [MCMC]."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from .. import ops  # noqa: F401  (registers the fake kernels)
from ..checks import check_value, plain_value
from ..gaussians import Gaussians
from ..optim import clear_moments, parameter_index
from ..relocation import compute_relocation
from .control import FixedDensity, normal_numbers, passes
from .options import USUAL_EXTENT, MonteCarloOptions, options_of

_add_noise = torch.ops.analytic_rasterizer.add_noise_.default

DRAW_UNITS = 2**30  # probabilities are counted in whole units, whose sums are the same in every run


class MonteCarloDensity(FixedDensity):
    """Moves transparent Gaussians to opaque ones, adds more up to a limit, and moves means at random [MCMC].

    The paper also adds 0.01 times the mean opacity and 0.01 times the mean scale to the loss, without which hardly any
    Gaussian becomes transparent; that is the loop's part.

    Args:
        options: None: the defaults.
        extent: Of the scene, world units. The noise grows with the cube of lengths, so that it is divided by the square
            of `extent` over the default: a scene in other units is moved alike. With the default it is the paper's.
        others: As of `FixedDensity`.

    Raises:
        TypeError, ValueError: As of `FixedDensity`; the extent is not positive and finite.
    """

    def __init__(
        self,
        gaussians: Gaussians,
        optimizer: torch.optim.Optimizer,
        options: MonteCarloOptions | None = None,
        extent: float = USUAL_EXTENT,
        **others: Any,
    ):
        self.options = options_of(MonteCarloOptions, options)
        self.extent = plain_value("extent", extent, float)
        check_value("extent", 0 < self.extent < math.inf, "positive and finite", extent)
        super().__init__(gaussians, optimizer, **others)

    @torch.no_grad()
    def after_step(self, step: int, share: float, stride: int = 1) -> bool:
        options = self.options
        changes = step > options.densify_from and passes(step, options.densify_every, stride)
        changes = changes and share < options.densify_until
        if changes:
            self._relocate()
            self._add()
        if options.noise > 0:
            self._add_noise()
        return changes

    def _relocate(self) -> None:
        """Moves transparent Gaussians to where others are."""
        opacities = self.gaussians.logit_opacities[:, 0].sigmoid()
        dead = opacities <= self.options.prune_opacity
        rows = dead.nonzero()[:, 0]
        if len(rows) in (0, len(dead)):
            return
        sources = draw(torch.where(dead, 0, opacities), len(rows), self.generator)
        self._share(sources)
        for tensor in self._tensors().values():
            tensor[rows] = tensor[sources]
            clear_moments(self.optimizer, tensor, rows)

    def _add(self) -> None:
        """Adds Gaussians where others are."""
        old = self.gaussians
        count = len(old.means)
        wanted = int((1 + self.options.grow_share) * count) - count
        more = self.ranks.allowed(self.options.max_gaussians, count, wanted)
        if more == 0:
            return
        sources = draw(old.logit_opacities[:, 0].sigmoid(), more, self.generator)
        self._share(sources)
        everything = torch.ones(count, dtype=torch.bool, device=old.means.device)
        self._replace(everything, {name: tensor[sources] for name, tensor in self._tensors().items()})

    def _share(self, sources: Tensor) -> None:
        """Gives Gaussians the opacity and scale of one of as many as will be in their place: 1 + how often each occurs
        in `sources`. Their moments start anew."""
        fields = self.gaussians
        rows, times = sources.unique(return_counts=True)
        opacities, scales = compute_relocation(
            fields.logit_opacities[rows].sigmoid(), fields.log_scales[rows].exp(), times + 1
        )
        lowest = self.options.prune_opacity  # what is shared is not transparent at once
        fields.logit_opacities[rows] = opacities.clamp_min(lowest).logit(eps=1e-6)
        fields.log_scales[rows] = scales.log()
        for tensor in self._tensors().values():
            clear_moments(self.optimizer, tensor, rows)

    def _add_noise(self) -> None:
        """Moves means at random, along with their covariance, the more the more transparent they are [MCMC, Eq. 8]."""
        means = self.gaussians.means
        group, _ = parameter_index(self.optimizer, "means", means)
        strength = self.options.noise * float(group["lr"]) * (USUAL_EXTENT / self.extent) ** 2
        _add_noise(*self.gaussians[:4], normal_numbers(means, self.generator), strength)


def draw(weights: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """`count` rows (count,) int64, each with a probability in proportion to its weight in [0, 1], (P,).

    Sums of floating-point numbers may differ from run to run on CUDA; these are sums of integers.
    """
    upper = (weights.double() * DRAW_UNITS).long().cumsum(0)
    places = torch.rand(count, dtype=torch.float64, generator=generator, device=weights.device) * upper[-1]
    return torch.searchsorted(upper, places.long(), right=True).clamp_max(len(weights) - 1)
