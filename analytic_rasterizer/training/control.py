"""What the options of a training say about Gaussians as a whole: density control, and regularizers."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from ..density import FixedDensity, GradientDensity, MonteCarloDensity, MonteCarloOptions
from ..density.options import USUAL_EXTENT
from ..distributed.ranks import ALONE, Ranks
from ..gaussians import Gaussians
from .options import TrainingOptions


def make_density(
    options: TrainingOptions,
    gaussians: Gaussians,
    optimizer: torch.optim.Optimizer,
    extent: float,
    white_background: bool = False,
    ranks: Ranks = ALONE,
    extra: dict[str, Tensor] | None = None,
) -> FixedDensity:
    """The density control that `options.density` names, with what the options say about it."""
    told, common = options.control, {"seed": options.seed, "ranks": ranks, "extra": extra}
    if told is None:
        return FixedDensity(gaussians, optimizer, **common)
    if isinstance(told, MonteCarloOptions):
        return MonteCarloDensity(gaussians, optimizer, told, extent, **common)
    told = replace(told, white_background=white_background)
    return GradientDensity(gaussians, optimizer, extent, told, **common)


def regularizers_of(options: TrainingOptions, extent: float) -> tuple[float, float]:
    """Weights of mean opacity and mean scale in the loss. Scales count in units of the extent, so that a capture in
    other units trains alike."""
    opacity_weight, scale_weight = options.regularizers
    return opacity_weight, scale_weight * USUAL_EXTENT / extent
