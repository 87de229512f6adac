"""What each kind of density control is told."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any

from ..checks import check_value, plain_value


@dataclass(frozen=True)
class GradientOptions:
    """When and where `GradientDensity` grows and prunes.

    The defaults are those of this package's own training. The recipe of [3DGS] is `GradientOptions(absolute=False,
    densify_until=0.5, split_above=0.01, max_gaussians=0)`.

    Attributes:
        absolute: Whether gradients are summed as absolute values over pixels [AbsGS], or with their signs [3DGS].
        gradient: Mean norm above which a Gaussian is cloned or split, by normalized device coordinates; 0: 3e-4 for
            absolute values, 2e-4 with signs.
        densify_from: Steps before the first change.
        densify_until: Share of the training, 0 to 1, after which the number of Gaussians stays.
        densify_every: Steps between changes, at least 1.
        reset_every: Steps between resets of the opacities; 0: never.
        prune_opacity: Least opacity that is kept.
        split_above: Scale above which a Gaussian is split rather than cloned, in extents of the scene.
        prune_above: Scale above which a Gaussian is pruned after the first reset, in extents of the scene.
        max_gaussians: Most Gaussians; 0: no limit. The limit rises evenly from the number at the start to this, until
            `densify_until`, and those with the largest gradients grow first.
        white_background: Whether opacities are also lowered when growth begins, which a white background calls for.

    Raises:
        TypeError: A value of another type, naming the option.
        ValueError: A value outside its range, naming the option.
    """

    absolute: bool = True
    gradient: float = 0.0
    densify_from: int = 500
    densify_until: float = 0.75
    densify_every: int = 100
    reset_every: int = 3000
    prune_opacity: float = 0.005
    split_above: float = 0.0025
    prune_above: float = 0.1
    max_gaussians: int = 1_000_000
    white_background: bool = False

    def __post_init__(self):
        _settle(self)
        for name in ("split_above", "prune_above"):
            value = getattr(self, name)
            check_value(name, 0 < value < math.inf, "positive and finite", value)
        check_value("gradient", 0 <= self.gradient < math.inf, "finite and not negative", self.gradient)

    @property
    def growth_gradient(self) -> float:
        """The threshold of `gradient`, settled."""
        return self.gradient or (3e-4 if self.absolute else 2e-4)


@dataclass(frozen=True)
class MonteCarloOptions:
    """When `MonteCarloDensity` moves and adds Gaussians, and how strong its noise is.

    Attributes:
        densify_from: Steps before the first change.
        densify_until: Share of the training, 0 to 1, after which the number of Gaussians stays.
        densify_every: Steps between changes, at least 1.
        prune_opacity: Opacity up to which a Gaussian moves to where others are.
        max_gaussians: Most Gaussians, at least 1.
        grow_share: Gaussians that are added at a time, as a share of those that are there, 0 to 1.
        noise: Strength of the noise on the means, in learning rates of the means; 0: none.

    Raises:
        TypeError: A value of another type, naming the option.
        ValueError: A value outside its range, naming the option.
    """

    densify_from: int = 500
    densify_until: float = 0.75
    densify_every: int = 100
    prune_opacity: float = 0.005
    max_gaussians: int = 1_000_000
    grow_share: float = 0.05
    noise: float = 5e5

    def __post_init__(self):
        _settle(self)
        check_value("max_gaussians", self.max_gaussians >= 1, "at least 1", self.max_gaussians)
        check_value("grow_share", 0 <= self.grow_share <= 1, "0 to 1", self.grow_share)
        check_value("noise", 0 <= self.noise < math.inf, "finite and not negative", self.noise)


def _settle(options: GradientOptions | MonteCarloOptions) -> None:
    """Makes the values plain ones of Python, and checks what both kinds of options have."""
    for field in fields(options):
        value = plain_value(field.name, getattr(options, field.name), type(field.default))
        object.__setattr__(options, field.name, value)
        if type(field.default) is int:
            least = int(field.name == "densify_every")
            check_value(field.name, value >= least, f"at least {least}", value)
    check_value("densify_until", 0 <= options.densify_until <= 1, "0 to 1", options.densify_until)
    check_value("prune_opacity", 0 <= options.prune_opacity < 1, "at least 0 and below 1", options.prune_opacity)


def options_of(kind: type, options: Any) -> Any:
    """The options, or the defaults of their class. Raises TypeError for those of another class."""
    if options is None:
        return kind()
    if not isinstance(options, kind):
        raise TypeError(f"options must be {kind.__name__}, got {type(options).__name__}")
    return options
