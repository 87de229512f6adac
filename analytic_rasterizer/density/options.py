"""What each kind of density control is told."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from ..declared import NOT_NEGATIVE, POSITIVE, SHARE, Options, Range, at_least, described, option

USUAL_EXTENT = 5.0
"""World units: the extent of the scenes for which noise and weight of scales are told, as of Mip-NeRF 360's."""
OPACITY = Range(lambda value: 0 <= value < 1, "at least 0 and below 1")


@described
@dataclass(frozen=True)
class GradientOptions(Options):
    """When and where `GradientDensity` grows and prunes.

    The defaults are those of this package's own training. The recipe of [3DGS] is `GradientOptions(absolute=False,
    densify_until=0.5, split_above=0.01, max_gaussians=0)`.

    Raises:
        TypeError: A value of another type, naming the option.
        ValueError: A value outside its range, naming the option.
    """

    absolute: bool = option(
        True, "Whether gradients are summed as absolute values over pixels [AbsGS], or with their signs [3DGS]."
    )
    gradient: float = option(
        0.0,
        "Mean norm above which a Gaussian is cloned or split, by normalized device coordinates; 0: 3e-4 for absolute "
        "values, 2e-4 with signs.",
        NOT_NEGATIVE,
        metavar="NORM",
    )
    densify_from: int = option(500, "Steps before the first change.", at_least(0))
    densify_until: float = option(
        0.75, "Share of the training, 0 to 1, after which the number of Gaussians stays.", SHARE
    )
    densify_every: int = option(100, "Steps between changes, at least 1.", at_least(1))
    reset_every: int = option(3000, "Steps between resets of the opacities; 0: never.", at_least(0))
    prune_opacity: float = option(0.005, "Least opacity that is kept.", OPACITY, metavar="OPACITY")
    split_above: float = option(
        0.0025,
        "Scale above which a Gaussian is split rather than cloned, in extents of the scene.",
        POSITIVE,
        metavar="EXTENTS",
    )
    prune_above: float = option(
        0.1,
        "Scale above which a Gaussian is pruned after the first reset, in extents of the scene.",
        POSITIVE,
        metavar="EXTENTS",
    )
    max_gaussians: int = option(
        1_000_000,
        "Most Gaussians; 0: no limit. The limit rises evenly from the number at the start to this, until "
        "`densify_until`, and those with the largest gradients grow first.",
        at_least(0),
    )
    white_background: bool = option(
        False, "Whether opacities are also lowered when growth begins, which a white background calls for."
    )

    @property
    def growth_gradient(self) -> float:
        """The threshold of `gradient`, settled."""
        return self.gradient or (3e-4 if self.absolute else 2e-4)


@described
@dataclass(frozen=True)
class MonteCarloOptions(Options):
    """When `MonteCarloDensity` moves and adds Gaussians, and how strong its noise is.

    Raises:
        TypeError: A value of another type, naming the option.
        ValueError: A value outside its range, naming the option.
    """

    densify_from: int = option(500, "Steps before the first change.", at_least(0))
    densify_until: float = option(
        0.75, "Share of the training, 0 to 1, after which the number of Gaussians stays.", SHARE
    )
    densify_every: int = option(100, "Steps between changes, at least 1.", at_least(1))
    prune_opacity: float = option(
        0.005, "Opacity up to which a Gaussian moves to where others are.", OPACITY, metavar="OPACITY"
    )
    max_gaussians: int = option(1_000_000, "Most Gaussians, at least 1.", at_least(1))
    grow_share: float = option(
        0.05,
        "How many Gaussians are added at a time, as a share of those there are, 0 to 1.",
        SHARE,
        metavar="SHARE",
    )
    noise: float = option(
        5e5,
        "Strength of the noise on the means, in learning rates of the means; 0: none.",
        NOT_NEGATIVE,
        metavar="FACTOR",
    )


def options_of(kind: type, options: Any) -> Any:
    """The options, or the defaults of their class. Raises TypeError for those of another class."""
    if options is None:
        return kind()
    if not isinstance(options, kind):
        raise TypeError(f"options must be {kind.__name__}, got {type(options).__name__}")
    return options
