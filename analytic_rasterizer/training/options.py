"""What a training is told: one dataclass, the same for the command line, for programs and for checkpoints."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, fields
from typing import Any, NamedTuple

from ..checks import check_value as _check
from ..checks import plain_value as _plain
from ..footprints import RECOMMENDED, resolve_footprint
from ..io.common import BACKGROUNDS

DOWNSAMPLINGS = ("box", "bicubic", "blender")
EFFECTS = ("auto", "none")
EXPOSURES = ("none", "affine")
DENSITIES = ("3dgs", "absgrad", "mcmc", "none")
RANDOM_BACKGROUND = "random"


TIMES = ("densify_from", "densify_until", "rates_from")  # options that are one
RANDOM_POINTS = 100_000  # by default, where the limit of Gaussians is not below that
FINEST_REPEATS = 2  # how often the finest of several scales occurs by default, where the others occur once


class Preset(NamedTuple):
    """Values of `TrainingOptions` that belong together; the other options keep their defaults."""

    values: dict[str, Any]
    finest_repeats: int = FINEST_REPEATS  # scale_repeats of the finest of several scales; the others have 1


PRESETS = {
    "quick": Preset({"iterations": 7000}),
    "3dgs": Preset(
        {
            "effects": "none",
            "density": "3dgs",
            "gradient_scales": "all",
            "densify_until": 0.5,
            "split_above": 0.01,
            "max_gaussians": 0,
            "means_rate": 1.6e-4,
            "color_rate": 2.5e-3,
            "scale_rate": 5e-3,
            "rotation_rate": 1e-3,
            "rates_half_life": 0,
        },
        finest_repeats=1,
    ),
}
"""By name: "quick", the defaults with 7,000 steps, and "3dgs", the recipe of 3DGS. docs/internals/training.md has what
each of them reaches."""


def preset_values(name: str, scales: tuple[int, ...]) -> dict[str, Any]:
    """What a preset sets among `TrainingOptions`, `scale_repeats` for these scales included.

    Raises:
        ValueError: No preset of this name.
    """
    _check("preset", name in PRESETS, f"one of {', '.join(PRESETS)}", name)
    preset = PRESETS[name]
    return preset.values | {"scale_repeats": repeats_of(scales, preset.finest_repeats)}


def repeats_of(scales: tuple[int, ...], finest_repeats: int) -> tuple[int, ...]:
    """`scale_repeats` with which the finest of several scales occurs so often, and the others once."""
    several = len(scales) > 1
    return tuple(finest_repeats if several and scale == min(scales) else 1 for scale in scales)


def flag(name: str) -> str:
    """An option as the command line spells it."""
    return "--" + name.replace("_", "-")


def value_in_words(value: Any) -> str:
    """A value as the command line spells it: "1,2,4" for (1, 2, 4)."""
    return ",".join(map(str, value)) if isinstance(value, tuple) else str(value)


def as_words(options: dict[str, Any]) -> str:
    """Options with their values as the command line spells them: "--scales 1,2 --exposure affine"."""
    return " ".join(f"{flag(name)} {value_in_words(value)}" for name, value in options.items())


def is_time(value: float) -> bool:
    """Whether a number is a time of `TrainingOptions`."""
    return 0 <= value <= 1 or (1 < value < math.inf and value == int(value))


def check_scales(scales: tuple[int, ...], name: str = "scales") -> None:
    """Raises ValueError, naming the argument, unless there are scales, all of them whole numbers of at least 1."""
    whole = all(scale >= 1 and scale % 1 == 0 for scale in scales)
    _check(name, len(scales) > 0 and whole, "whole numbers of at least 1", scales)


@dataclass(frozen=True)
class TrainingOptions:
    """How to train. A *time* is a number of steps, or up to 1 a share of the training: 0.5 is when half of it is over.

    The defaults are what measured best in trainings of 7,000 steps on two scenes (docs/training.md);
    `TrainingOptions.preset` has the recipe of 3DGS [Kerbl et al. 2023].

    Attributes:
        footprint: One of `FOOTPRINTS`, with options: "box:samples=4".
        scales: Reductions to train at: 1 is the full size, 2 half of it.
        scale_repeats: How often every picture of a scale occurs in one pass over the pictures; one number per scale.
            Empty: twice for the finest of several scales, once for the others.
        downsampling: How coarse pictures are made: "box", means over squares of pixels, or "bicubic", with the kernel
            widened to the scale; in both, colours count by their alpha. "blender": means of colours and of alpha apart,
            as the files of the multi-scale Blender set were made.
        iterations: Steps of the optimizer.
        seconds: Time to train, s, by the clock, instead of a number of steps; 0: go by `iterations`.
        pictures_per_step: Pictures whose mean loss makes one step.
        supersampling: How many times larger pictures are rendered before squares of pixels are averaged; the footprint
            is evaluated in the small pixels. 1: not at all.
        sh_degree: Highest degree of the spherical harmonics, 0 to 3.
        sh_every: Steps between two degrees, at most; never more than a tenth of the training.
        background: "black", "white", "random" (drawn anew for every step; needs pictures with alpha), or "" for white
            where the pictures have alpha by convention (NeRF-synthetic), and black for photographs.
        filter_3d: Whether Gaussians are widened by the 3D filter of Mip-Splatting.
        effects: "auto": `Run` looks at the capture first, by `plan_capture`, and takes what it calls for; not options
            that differ from their default here, or are among its `chosen`. "none": nobody looks at the capture.
        exposure: "affine": learn a colour correction (3x4) for each training photograph, for captures whose exposure or
            white balance varies. It is applied before the loss; the scene has no correction. "none": none.
        seed: Of the starting points, the order of the pictures, and everything else that is drawn; -2^39 to 2^40 - 1.
        random_points: Gaussians at the start where the capture has no points; not more than `max_gaussians`. 0:
            100,000, or `max_gaussians` where that is less.
        ssim_weight: Share of 1 - SSIM in the loss, next to the mean absolute error.
        initial_opacity: Of the first Gaussians.
        initial_scale: Of the first Gaussians, in distances to their neighbours.
        means_rate: Learning rate of the means at the start, per unit of the scene's extent.
        means_rate_end: The same at the end; in between it falls exponentially.
        means_rate_steps: Steps after which the rate of the means has reached its end, whatever the length of the
            training (3DGS: 30,000); 0: when the training ends.
        color_rate: Learning rate of the constant of the harmonics; the others learn at 1/20 of it.
        opacity_rate: Learning rate of the logit opacities.
        scale_rate: Learning rate of the log scales.
        rotation_rate: Learning rate of the quaternions.
        rates_from: Time after which the learning rates other than that of the means begin to fall.
        rates_half_life: Steps in which they then fall to a half, exponentially; 0: they stay.
        sparse_adam: Whether a step of the optimizer updates only the Gaussians that at least one of its pictures shows
            (3DGS's radii > 0), as 3DGS's `--optimizer_type sparse_adam` does. The others keep parameters and moments,
            whatever regularizers would do to them.
        deterministic: Whether every run has the same bits on CUDA too, whose frames with a sudden rise of pairs else
            may differ in the last bits: torch's deterministic mode is on during every step, so that the host waits for
            the number of pairs. Operators of torch without a deterministic algorithm would warn.
        density: "3dgs": clone and split by the gradient of the projected means; "absgrad": the same by the sum of its
            absolute values over pixels [AbsGS]; "mcmc": relocate and add by opacity [3DGS-MCMC]; "none".
        densify_from: Time before the first change; -1: 500 steps, or a fourteenth of a training of fewer than 7,000. In
            a training of fewer than 150 nothing changes, unless this or `densify_every` is given.
        densify_until: Time after which the number of Gaussians stays.
        densify_every: Steps between changes; 0: 100, or a seventieth of a training of fewer than 7,000, but
            at least 10.
        gradient: Mean norm above which a Gaussian is cloned or split, by normalized device coordinates; 0: 2e-4 for
            "3dgs", 3e-4 for "absgrad".
        gradient_scales: Which scales the mean is over: "all", or "finest", the largest pictures alone.
        reset_every: Steps between resets of the opacities ("3dgs" and "absgrad"); 0: never.
        prune_opacity: Least opacity that is kept.
        split_above: Scale above which a Gaussian is split rather than cloned, in extents of the scene.
        prune_above: Scale above which a Gaussian is pruned after the first reset, in extents of the scene.
        max_gaussians: Most Gaussians, at the start too; 0: no limit, which "mcmc" does not take. With "3dgs" and
            "absgrad" the limit rises evenly from the number at the start to this, until `densify_until`, and those with
            the largest gradients grow first; with "mcmc" the number rises by `grow_share` until it is reached.
        grow_share: Of "mcmc": Gaussians that are added at a time, as a share of those that are there.
        noise: Of "mcmc": strength of the noise on the means, in learning rates of the means.
        opacity_weight: Weight of the mean opacity in the loss; -1: 0.01 for "mcmc", otherwise 0.
        scale_weight: Weight of the mean scale in the loss; -1: 0.01 for "mcmc", otherwise 0.

    Numbers of NumPy and tensors with one number become those of Python, which the files of a training can hold.

    Raises:
        TypeError: A value of another type, naming the option.
        ValueError: A value outside its range, naming the option.
    """

    footprint: str = RECOMMENDED
    scales: tuple[int, ...] = (1,)
    scale_repeats: tuple[int, ...] = ()
    downsampling: str = "box"
    iterations: int = 30_000
    seconds: float = 0.0
    pictures_per_step: int = 1
    supersampling: int = 1
    sh_degree: int = 3
    sh_every: int = 1000
    background: str = ""
    filter_3d: bool = False
    effects: str = "auto"
    exposure: str = "none"
    seed: int = 0
    random_points: int = 0
    ssim_weight: float = 0.2
    initial_opacity: float = 0.1
    initial_scale: float = 1.0
    means_rate: float = 3.2e-4
    means_rate_end: float = 1.6e-6
    means_rate_steps: int = 0
    color_rate: float = 5e-3
    opacity_rate: float = 0.05
    scale_rate: float = 1e-2
    rotation_rate: float = 2e-3
    rates_from: float = 7000.0
    rates_half_life: int = 7000
    sparse_adam: bool = False
    deterministic: bool = False
    density: str = "absgrad"
    densify_from: float = -1.0
    densify_until: float = 0.75
    densify_every: int = 0
    gradient: float = 0.0
    gradient_scales: str = "finest"
    reset_every: int = 3000
    prune_opacity: float = 0.005
    split_above: float = 0.0025
    prune_above: float = 0.1
    max_gaussians: int = 1_000_000
    grow_share: float = 0.05
    noise: float = 5e5
    opacity_weight: float = -1.0
    scale_weight: float = -1.0

    def __post_init__(self):
        object.__setattr__(self, "footprint", str(resolve_footprint(str(self.footprint))))
        for field in fields(self):
            object.__setattr__(self, field.name, _plain(field.name, getattr(self, field.name), type(field.default)))
        object.__setattr__(self, "scale_repeats", self.scale_repeats or repeats_of(self.scales, FINEST_REPEATS))
        for name in ("iterations", "pictures_per_step", "supersampling", "sh_every"):
            _check(name, getattr(self, name) >= 1, "at least 1", getattr(self, name))
        steps = ("densify_every", "reset_every", "means_rate_steps", "rates_half_life")
        for name in (*steps, "max_gaussians", "random_points"):
            _check(name, getattr(self, name) >= 0, "at least 0", getattr(self, name))
        for name in TIMES:
            value, usual = getattr(self, name), name == "densify_from" and getattr(self, name) == -1
            explained = f"{value:g} (a share of the training; above 1 it is a whole number of steps)"
            _check(name, usual or is_time(value), "0 to 1", explained)
        # More than the limit is refused where the points are made: options of finished trainings can still be read.
        object.__setattr__(self, "random_points", self.random_points or min(RANDOM_POINTS, self.gaussian_limit))
        check_scales(self.scales)
        check_scales(self.scale_repeats, "scale_repeats")
        _check("scales", len(set(self.scales)) == len(self.scales), "different from each other", self.scales)
        # The order of a pass is drawn from seed * 2^24 + its number, in 64 bits with or without a sign.
        _check("seed", -(2**39) <= self.seed < 2**40, "-2^39 to 2^40 - 1", self.seed)
        fits = len(self.scale_repeats) == len(self.scales)
        _check("scale_repeats", fits, f"{len(self.scales)} numbers, one per scale", self.scale_repeats)
        _check("sh_degree", 0 <= self.sh_degree <= 3, "0 to 3", self.sh_degree)
        known = ("", *BACKGROUNDS, RANDOM_BACKGROUND)
        _check("background", self.background in known, f"one of {', '.join(known[1:])}", self.background)
        expected = f"one of {', '.join(DOWNSAMPLINGS)}"
        _check("downsampling", self.downsampling in DOWNSAMPLINGS, expected, self.downsampling)
        _check("effects", self.effects in EFFECTS, f"one of {', '.join(EFFECTS)}", self.effects)
        _check("exposure", self.exposure in EXPOSURES, f"one of {', '.join(EXPOSURES)}", self.exposure)
        _check("density", self.density in DENSITIES, f"one of {', '.join(DENSITIES)}", self.density)
        limited = self.density != "mcmc" or self.max_gaussians > 0
        _check(
            "max_gaussians", limited, 'at least 1 with density "mcmc", which grows up to it (the preset 3dgs has 0)', 0
        )
        _check("gradient_scales", self.gradient_scales in ("all", "finest"), "all or finest", self.gradient_scales)
        for name in ("ssim_weight", "grow_share"):
            _check(name, 0 <= getattr(self, name) <= 1, "0 to 1", getattr(self, name))
        _check("initial_opacity", 0 < self.initial_opacity < 1, "above 0 and below 1", self.initial_opacity)
        positive = ("initial_scale", "means_rate", "means_rate_end", "color_rate", "opacity_rate", "scale_rate")
        for name in (*positive, "rotation_rate", "split_above", "prune_above"):
            value = getattr(self, name)
            _check(name, 0 < value < math.inf, "positive and finite", value)
        for name in ("seconds", "gradient", "prune_opacity", "noise"):
            value = getattr(self, name)
            _check(name, 0 <= value < math.inf, "finite and not negative", value)
        for name in ("opacity_weight", "scale_weight"):
            value = getattr(self, name)
            _check(name, value == -1 or 0 <= value < math.inf, "finite and not negative, or -1", value)

    @property
    def growth_gradient(self) -> float:
        """The threshold of `gradient`, settled."""
        return self.gradient or (3e-4 if self.density == "absgrad" else 2e-4)

    @property
    def gaussian_limit(self) -> float:
        """The limit of `max_gaussians`, settled."""
        return int(self.max_gaussians) or math.inf

    @property
    def regularizers(self) -> tuple[float, float]:
        """Weights of mean opacity and mean scale, settled."""
        usual = 0.01 if self.density == "mcmc" else 0.0
        return tuple(usual if weight == -1 else weight for weight in (self.opacity_weight, self.scale_weight))

    @classmethod
    def preset(cls, name: str, **given: Any) -> TrainingOptions:
        """The options of the preset `name` of `PRESETS`.

        What is `given` wins over the preset, which wins over the defaults.

        Raises:
            TypeError: A name in `given` that is no option.
            ValueError: No preset of this name, or a value outside its range.
        """
        return cls(**(preset_values(name, given.get("scales", cls.scales)) | given))

    def to_dict(self) -> dict[str, Any]:
        """Names and values that JSON can hold."""
        return asdict(self)

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> TrainingOptions:
        """The options whose `values` `to_dict` gave.

        Raises:
            ValueError: A name that there is not.
        """
        unknown = set(values) - {field.name for field in fields(cls)}
        if unknown:
            raise ValueError(f"options must be among those of TrainingOptions, got {', '.join(sorted(unknown))}")
        return cls(**({"effects": "none"} | values))  # of earlier versions, which looked at no capture
