"""Density control: how many Gaussians there are, and where, during training.

[3DGS] Kerbl et al., "3D Gaussian Splatting for Real-Time Radiance Field Rendering", 2023, section 5.2. Gaussians whose
projected mean would like to move, by the average norm of dL/d(mean) over the views that saw them, are *grown*: small
ones are cloned, large ones split into two that are 1.6 times smaller. Transparent ones, and after the first reset of
opacities also those that are large in the world, are pruned. At times all opacities are lowered, so that those which
matter rise again and the others are pruned.

The gradient is that by normalized device coordinates, which span 2 over the picture: dL/dx is W/2 times the derivative
by pixels, dL/dy H/2 times. The loss is a mean over the picture, so that as a function of these coordinates it does not
depend on the resolution, but for the detail that coarse pixels lose. Views at all scales therefore may enter one
average, with one threshold; but where one Gaussian covers several details of a coarse pixel, only the finest pictures
still ask for more of them (`gradient_scales`).

[AbsGS] Ye et al., "AbsGS: Recovering Fine Details for 3D Gaussian Splatting", 2024: over a large Gaussian, gradients of
different pixels cancel. Summing their absolute values instead finds those that should be split.

[MCMC] Kheradmand et al., "3D Gaussian Splatting as Markov Chain Monte Carlo", 2024: transparent Gaussians move to where
opaque ones are, in a way that leaves the picture as it was, as many are added until a limit is reached, and noise on
the means of transparent Gaussians explores.

Where [3DGS] leaves a choice: a clone stays where its original is, and the momentum that only the original has takes
them apart; size in the picture is no reason to prune, as it would depend on the resolution; and on a white background
opacities are also lowered when growth begins, since white Gaussians in front of the object cost nothing there.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from . import ops  # noqa: F401  (registers the fake kernels)
from .distributed.ranks import ALONE, Ranks
from .gaussians import Gaussians
from .relocation import compute_relocation
from .rotations import rotation_matrices

if TYPE_CHECKING:
    from .training.options import TrainingOptions

_observe = torch.ops.analytic_rasterizer.observe_.default

SHRINKAGE = 1.6  # of the two halves of a Gaussian
RESET_OPACITY = 0.01
NOISE_SHARPNESS, NOISE_OPACITY = 100, 0.005  # noise fades out around this opacity [MCMC, Eq. 8]
MOMENTS = ("exp_avg", "exp_avg_sq")
DRAW_UNITS = 2**30  # probabilities are counted in whole units, whose sums are the same in every run


class FixedDensity:
    """Changes nothing; the interface of the others.

    Args:
        gaussians: The parameters, in the order of the optimizer's groups, the first of which has the means.
        extent: Radius of the scene, world units.
        white_background: Whether opacities are also lowered when growth begins.
        ranks: Those that have the other Gaussians. Every rank decides about its own; the limit is that of all.

    Attributes:
        gaussians: May be other tensors after `after_step`.
        pruned: How many were pruned the last time, by cause: "opacity" and "size", one-element tensors.
        row_state: Names of the attributes that have a row per Gaussian.
    """

    row_state: tuple[str, ...] = ()

    def __init__(
        self,
        gaussians: Gaussians,
        optimizer: torch.optim.Optimizer,
        extent: float,
        options: TrainingOptions,
        white_background: bool = False,
        ranks: Ranks = ALONE,
    ):
        self.gaussians, self.optimizer, self.ranks = gaussians, optimizer, ranks
        self.extent, self.options, self.white_background = extent, options, white_background
        self.pruned: dict[str, Tensor] = {}
        self.generator = torch.Generator(gaussians.means.device).manual_seed(options.seed)

    def watches(self, scale: int) -> bool:
        """Whether gradients of pictures of this scale are looked at."""
        return False

    @property
    def columns(self) -> int:
        """Columns of the gradients that `observe` takes: 3, or 4 with sums of absolute values."""
        return 3

    def leaf(self, scale: int) -> Tensor | None:
        """What to render a picture of this scale with as means2D, so that it gets the gradients that `observe` takes.

        None where nobody looks at them."""
        if not self.watches(scale):
            return None
        means = self.gaussians.means
        # The values are not read, and need not be written.
        return means.new_empty(len(means), self.columns, requires_grad=True)

    def observe_rows(self, rows: Tensor, gradients: Tensor) -> None:
        """As `observe`, for a picture whose gradients are known by row.

        Args:
            rows: (n,) int64, the Gaussians that the picture shows, each once.
            gradients: (n, 2) with respect to their means in normalized device coordinates; with the density control
                "absgrad" the sums of absolute values.
        """

    def forget(self) -> None:
        """Begins new averages, of as many Gaussians as there are now."""

    @torch.no_grad()
    def keep(self, kept: Tensor) -> None:
        """Takes away all Gaussians but those of the mask (P,); averages of the others go on. Not before a step."""
        old = self.gaussians
        self.gaussians = replace_rows(old, self.optimizer, kept, old.rows(slice(0)))
        for name in self.row_state:
            setattr(self, name, getattr(self, name)[kept])

    def observe(self, gradients: Tensor, radii: Tensor) -> None:
        """Looks at the gradients of a picture, (P, columns), and at its radii. Nothing here waits for the device."""

    def after_step(self, step: int, share: float, stride: int = 1) -> bool:
        """Acts where it is time; to be called after every step of the optimizer.

        Args:
            step: Steps taken, this one included.
            share: Of the training that is over, 0 to 1.
            stride: Steps that the last step of the optimizer stood for.

        Returns:
            Whether there are other Gaussians now.
        """
        return False

    def state_dict(self) -> dict[str, Any]:
        """All that decides what happens next, beside the Gaussians and the optimizer."""
        return {"generator": self.generator.get_state()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Goes on from what `state_dict` gave."""
        self.generator.set_state(state["generator"].cpu())


class GradientDensity(FixedDensity):
    """[3DGS] with signed gradients, or [AbsGS] with sums of absolute values."""

    row_state = ("gradient_sums", "views")

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self.absolute = self.options.density == "absgrad"
        self.growing = self.options.densify_until > 0
        self.first_count = sum(self.ranks.exchange(len(self.gaussians.means)))
        self.forget()

    def watches(self, scale: int) -> bool:
        return self.growing and (self.options.gradient_scales != "finest" or scale == min(self.options.scales))

    @property
    def columns(self) -> int:
        return 4 if self.absolute else 3

    def observe(self, gradients: Tensor, radii: Tensor) -> None:
        # Columns 2 and 3 of four are the sums of absolute values.
        _observe(self.gradient_sums, self.views, gradients, radii, 2 if self.absolute else 0)

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
            self._prune(too_large=step > options.reset_every > 0)
            self.forget()
        begins = step - stride < options.densify_from <= step
        if options.reset_every and (passes(step, options.reset_every, stride) or (self.white_background and begins)):
            self._lower_opacities()
        return changes

    def state_dict(self) -> dict[str, Any]:
        own = {"growing": self.growing, "gradient_sums": self.gradient_sums, "views": self.views}
        own["first_count"] = self.first_count
        return super().state_dict() | own

    def load_state_dict(self, state: dict[str, Any]) -> None:
        super().load_state_dict(state)
        self.growing, self.first_count = state["growing"], state["first_count"]
        self.gradient_sums = state["gradient_sums"].to(self.gradient_sums.device)
        self.views = state["views"].to(self.views.device)

    def forget(self) -> None:
        means = self.gaussians.means
        self.gradient_sums = torch.zeros(len(means), dtype=torch.float32, device=means.device)
        self.views = torch.zeros(len(means), dtype=torch.int32, device=means.device)

    def _grow(self, gradients: Tensor, over: float) -> None:
        """Clones and splits by the average norms (P,); each of them adds one Gaussian.

        Args:
            over: Share of the time of growth that is over, 0 to 1.
        """
        old = self.gaussians
        grown = gradients >= self.options.growth_gradient
        if self.options.gaussian_limit < math.inf:
            # If all room were taken at once, Gaussians would go where the first, blurred pictures ask for them.
            limit = self.options.gaussian_limit
            if limit > self.first_count:
                limit = self.first_count + int(over * (limit - self.first_count))
            room = self.ranks.allowed(limit, len(grown), int(grown.sum()))
            chosen = torch.where(grown, gradients, -1).topk(room).indices
            grown = torch.zeros_like(grown).index_fill_(0, chosen, True)
        large = old.log_scales.amax(1).exp() > self.options.split_above * self.extent
        clones = old.rows(grown & ~large)
        halves = split(old.rows(grown & large), self.generator)
        added = Gaussians(*(torch.cat(fields) for fields in zip(clones, halves)))
        self.gaussians = replace_rows(old, self.optimizer, ~(grown & large), added)

    def _prune(self, too_large: bool) -> None:
        old, options = self.gaussians, self.options
        kept = opaque = old.logit_opacities[:, 0].sigmoid() >= options.prune_opacity
        if too_large:
            kept = opaque & (old.log_scales.amax(1).exp() <= options.prune_above * self.extent)
        self.pruned = {"opacity": (~opaque).sum(), "size": (opaque & ~kept).sum()}
        self.gaussians = replace_rows(old, self.optimizer, kept, old.rows(slice(0)))

    def _lower_opacities(self) -> None:
        logits = self.gaussians.logit_opacities
        logits.clamp_(max=math.log(RESET_OPACITY / (1 - RESET_OPACITY)))
        for moment in MOMENTS:
            self.optimizer.state[logits][moment].zero_()


class MonteCarloDensity(FixedDensity):
    """[MCMC]"""

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
        for field in self.gaussians:
            field[rows] = field[sources]
            for moment in MOMENTS:
                self.optimizer.state[field][moment][rows] = 0

    def _add(self) -> None:
        """Adds Gaussians where others are."""
        old = self.gaussians
        count = len(old.means)
        wanted = int((1 + self.options.grow_share) * count) - count
        more = self.ranks.allowed(self.options.gaussian_limit, count, wanted)
        if more == 0:
            return
        sources = draw(old.logit_opacities[:, 0].sigmoid(), more, self.generator)
        self._share(sources)
        everything = torch.ones(count, dtype=torch.bool, device=old.means.device)
        self.gaussians = replace_rows(old, self.optimizer, everything, old.rows(sources))

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
        for field in fields:
            for moment in MOMENTS:
                self.optimizer.state[field][moment][rows] = 0

    def _add_noise(self) -> None:
        """Moves means at random, along with their covariance, the more the more transparent they are [MCMC, Eq. 8]."""
        means, log_scales, rotations, logits = self.gaussians[:4]
        strength = torch.sigmoid(NOISE_SHARPNESS * (NOISE_OPACITY - logits.sigmoid()))
        strength = strength * (self.options.noise * self.optimizer.param_groups[0]["lr"])
        noise = strength * normal_numbers(means, self.generator)
        axes = rotation_matrices(rotations)
        along = (2 * log_scales).exp() * (axes * noise[:, :, None]).sum(1)  # in the Gaussian's frame
        means += (axes * along[:, None, :]).sum(2)


def passes(step: int, period: int, stride: int = 1) -> bool:
    """Whether there is a multiple of `period` among the `stride` steps that end with `step`."""
    return step // period > (step - stride) // period


def make_density(options: TrainingOptions, *args, **kwargs) -> FixedDensity:
    """The control that `options.density` names; the other arguments are those of `FixedDensity`."""
    kinds = {"3dgs": GradientDensity, "absgrad": GradientDensity, "mcmc": MonteCarloDensity, "none": FixedDensity}
    gaussians, optimizer, extent, *white_background = args
    return kinds[options.density](gaussians, optimizer, extent, options, *white_background, **kwargs)


def split(parents: Gaussians, generator: torch.Generator) -> Gaussians:
    """Two Gaussians for each parent, drawn from its distribution, smaller and otherwise like it."""
    twice = parents.map(lambda field: torch.cat([field, field]))
    normal = normal_numbers(twice.means, generator)
    along = twice.log_scales.exp() * normal
    offsets = (rotation_matrices(twice.rotations) * along[:, None, :]).sum(2)
    return twice._replace(means=twice.means + offsets, log_scales=twice.log_scales - math.log(SHRINKAGE))


def normal_numbers(like: Tensor, generator: torch.Generator) -> Tensor:
    """As many numbers from a normal distribution, of the same dtype."""
    return torch.randn(like.shape, generator=generator, dtype=like.dtype, device=like.device)


def draw(weights: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """`count` rows (count,) int64, each with a probability in proportion to its weight in [0, 1], (P,).

    Sums of floating-point numbers may differ from run to run on CUDA; these are sums of integers.
    """
    upper = (weights.double() * DRAW_UNITS).long().cumsum(0)
    places = torch.rand(count, dtype=torch.float64, generator=generator, device=weights.device) * upper[-1]
    return torch.searchsorted(upper, places.long(), right=True).clamp_max(len(weights) - 1)


def replace_rows(old: Gaussians, optimizer: torch.optim.Optimizer, kept: Tensor, added: Gaussians) -> Gaussians:
    """The rows of `old` that the mask `kept` (P,) names, then those of `added`, as the parameters of `optimizer`.

    Moments of kept rows are kept, those of added ones are zero. The optimizer has taken a step before.
    """
    new = Gaussians(*(torch.cat([field[kept], more]).requires_grad_() for field, more in zip(old, added)))
    for group, before, after, more in zip(optimizer.param_groups, old, new, added):
        state = optimizer.state.pop(before)
        for moment in MOMENTS:
            state[moment] = torch.cat([state[moment][kept], torch.zeros_like(more)])
        optimizer.state[after] = state
        group["params"] = [after]
    return new
