"""What a training is told: one dataclass, the same for the command line, for programs and for checkpoints."""

from __future__ import annotations

import math
from dataclasses import Field, dataclass, fields
from typing import Any, NamedTuple

from ..checks import check_value
from ..declared import add_attributes, declared, settled
from ..density import GradientOptions, MonteCarloOptions
from .parts import (
    FINEST_REPEATS,
    NO_FOOTPRINT,
    GradientGrowth,
    GrowthOptions,
    LengthOptions,
    LossOptions,
    PictureOptions,
    RateOptions,
    SceneOptions,
    StartOptions,
    repeats_of,
)


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
            "pixels_per_gaussian": 0.0,
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
    check_value("preset", name in PRESETS, f"one of {', '.join(PRESETS)}", name)
    preset = PRESETS[name]
    return preset.values | {"scale_repeats": repeats_of(scales, preset.finest_repeats)}


def flag(name: str) -> str:
    """An option as the command line spells it."""
    return "--" + name.replace("_", "-")


def value_in_words(value: Any) -> str:
    """A value as the command line spells it: "1,2,4" for (1, 2, 4)."""
    return ",".join(map(str, value)) if isinstance(value, tuple) else str(value)


def as_words(options: dict[str, Any]) -> str:
    """Options with their values as the command line spells them: "--scales 1,2 --exposure affine"."""
    return " ".join(f"{flag(name)} {value_in_words(value)}" for name, value in options.items())


PARTS = {
    "scene": SceneOptions,
    "pictures": PictureOptions,
    "length": LengthOptions,
    "start": StartOptions,
    "loss": LossOptions,
    "rates": RateOptions,
    "growth": GrowthOptions,
}
"""Classes of the parts of `TrainingOptions`, by its attributes. One part more, `control`, is of a class of CONTROLS."""

CONTROLS = {"3dgs": GradientGrowth, "absgrad": GradientGrowth, "mcmc": MonteCarloOptions}
"""By density controls, the classes of what they are told. "none" is told nothing."""


def _declarations() -> dict[str, tuple[str, Field]]:
    """By the names of all options: their part, and the field that declares them."""
    found = {each.name: (part, each) for part, kind in PARTS.items() for each in fields(kind)}
    found |= {each.name: ("control", each) for kind in reversed(CONTROLS.values()) for each in _own(kind)}
    return found


def _own(kind: type) -> list[Field]:
    """The options of a class of CONTROLS that neither are in another part, nor follow from the rest."""
    elsewhere = {each.name for part in PARTS.values() for each in fields(part)}
    return [each for each in fields(kind) if each.name not in elsewhere | {"absolute", "white_background"}]


DECLARATIONS = _declarations()


def controls_of(name: str) -> list[str]:
    """The density controls that are told an option. None where it holds without density control too."""
    general = {each.name for each in fields(StartOptions)}
    told = {density: {each.name for each in fields(kind)} - general for density, kind in CONTROLS.items()}
    return [density for density, names in told.items() if name in names]


def of_other_control(name: str, density: str) -> str | None:
    """Why the option `name` has no effect with a density control, in words; None where it has one."""
    told = controls_of(name)
    if not told or density in told:
        return None
    if len(told) == len(CONTROLS):
        return "the density control none changes nothing"
    return f"it is for the density control{'s' if len(told) > 1 else ''} {' and '.join(told)}, got {density}"


def text_of(name: str) -> str:
    """What an option is, in words."""
    text, told = declared(DECLARATIONS[name][1]).text, controls_of(name)
    if len(told) in (0, len(CONTROLS)):
        return text
    named = " and ".join(f'"{density}"' for density in told)
    return f"Of {named}: {text[:1].lower()}{text[1:]}"


class _InPart:
    """An option as an attribute of the whole: the value in its part. Where the part has none, and of the class, the
    default."""

    def __init__(self, part: str, name: str, default: Any):
        self.part, self.name, self.default = part, name, default

    def __get__(self, options: TrainingOptions | None, _owner: type) -> Any:
        return self.default if options is None else getattr(getattr(options, self.part), self.name, self.default)


@dataclass(frozen=True)
class TrainingOptions:
    """How to train. A *time* is a number of steps, or up to 1 a share of the training: 0.5 is when half of it is over.

    The defaults are what measured best in trainings of 7,000 steps on two scenes (docs/training.md);
    `TrainingOptions.preset` has the recipe of 3DGS [Kerbl et al. 2023].

    The options are kept in parts, by what they are about: `scene`, `pictures`, `length`, `start`, `loss`, `rates`,
    `growth`, and `control`, which is what the density control is told. Those of another density control are left out:
    they have their defaults. Numbers of NumPy and tensors with one number become those of Python, which the files of a
    training can hold.

    Raises:
        TypeError: A value of another type, naming the option.
        ValueError: A value outside its range, naming the option.
    """

    footprint: str = SceneOptions.footprint
    first_footprint: str = SceneOptions.first_footprint
    footprint_from: float = SceneOptions.footprint_from
    scales: tuple[int, ...] = PictureOptions.scales
    scale_repeats: tuple[int, ...] = PictureOptions.scale_repeats
    downsampling: str = PictureOptions.downsampling
    iterations: int = LengthOptions.iterations
    seconds: float = LengthOptions.seconds
    pictures_per_step: int = PictureOptions.pictures_per_step
    supersampling: int = PictureOptions.supersampling
    sh_degree: int = SceneOptions.sh_degree
    sh_every: int = SceneOptions.sh_every
    background: str = PictureOptions.background
    filter_3d: bool = SceneOptions.filter_3d
    order: str = SceneOptions.order
    effects: str = PictureOptions.effects
    exposure: str = PictureOptions.exposure
    vignetting: str = PictureOptions.vignetting
    seed: int = LengthOptions.seed
    random_points: int = StartOptions.random_points
    ssim_weight: float = LossOptions.ssim_weight
    initial_opacity: float = StartOptions.initial_opacity
    initial_scale: float = StartOptions.initial_scale
    means_rate: float = RateOptions.means_rate
    means_rate_end: float = RateOptions.means_rate_end
    means_rate_steps: int = RateOptions.means_rate_steps
    color_rate: float = RateOptions.color_rate
    opacity_rate: float = RateOptions.opacity_rate
    scale_rate: float = RateOptions.scale_rate
    rotation_rate: float = RateOptions.rotation_rate
    rates_from: float = RateOptions.rates_from
    rates_half_life: int = RateOptions.rates_half_life
    sparse_adam: bool = RateOptions.sparse_adam
    deterministic: bool = LengthOptions.deterministic
    density: str = GrowthOptions.density
    densify_from: float = GrowthOptions.densify_from
    densify_until: float = GrowthOptions.densify_until
    densify_every: int = GrowthOptions.densify_every
    gradient: float = GradientGrowth.gradient
    gradient_scales: str = GradientGrowth.gradient_scales
    reset_every: int = GradientGrowth.reset_every
    prune_opacity: float = GradientGrowth.prune_opacity
    split_above: float = GradientGrowth.split_above
    prune_above: float = GradientGrowth.prune_above
    max_gaussians: int = StartOptions.max_gaussians
    pixels_per_gaussian: float = StartOptions.pixels_per_gaussian
    grow_share: float = MonteCarloOptions.grow_share
    noise: float = MonteCarloOptions.noise
    opacity_weight: float = LossOptions.opacity_weight
    scale_weight: float = LossOptions.scale_weight
    depth: str = LossOptions.depth
    depth_weight: float = LossOptions.depth_weight
    depth_weight_end: float = LossOptions.depth_weight_end
    depth_fit: str = LossOptions.depth_fit
    depth_unit: float = LossOptions.depth_unit

    def __post_init__(self):
        given = dict(vars(self))
        parts = {part: kind(**{each.name: given[each.name] for each in fields(kind)}) for part, kind in PARTS.items()}
        for kind in CONTROLS.values():  # a value that is left out may not be wrong either
            for each in _own(kind):
                given[each.name] = settled(each, given[each.name])
        vars(self).clear()
        vars(self).update(parts)
        vars(self)["control"] = self._control(given)

    def _control(self, given: dict[str, Any]) -> GradientGrowth | MonteCarloOptions | None:
        """What the density control is told, in a training of so many steps; None: there is no control."""
        kind = CONTROLS.get(self.density)
        if kind is None:
            return None
        limited = self.density != "mcmc" or self.max_gaussians > 0
        expected = 'at least 1 with density "mcmc", which grows up to it (the preset 3dgs has 0)'
        check_value("max_gaussians", limited, expected, 0)
        told = {each.name: given[each.name] for each in _own(kind)} | self.growth.times(self.iterations)
        if kind is GradientGrowth:
            told["absolute"] = self.density == "absgrad"
        return kind(**told, max_gaussians=self.max_gaussians)

    @property
    def growth_gradient(self) -> float:
        """The threshold of `gradient`, settled."""
        return GradientOptions(absolute=self.density == "absgrad", gradient=self.gradient).growth_gradient

    @property
    def gaussian_limit(self) -> float:
        """The limit of `max_gaussians`, settled."""
        return int(self.max_gaussians) or math.inf

    @property
    def regularizers(self) -> tuple[float, float]:
        """Weights of mean opacity and mean scale, settled."""
        usual = 0.01 if self.density == "mcmc" else 0.0
        return tuple(usual if weight == -1 else weight for weight in (self.opacity_weight, self.scale_weight))

    @property
    def begins_with(self) -> str | None:
        """The footprint until `footprint_from`; None: there is no other than `footprint`."""
        return None if self.first_footprint in ("", NO_FOOTPRINT, self.footprint) else self.first_footprint

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
        return {each.name: getattr(self, each.name) for each in fields(self)}

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> TrainingOptions:
        """The options whose `values` `to_dict` gave.

        Raises:
            ValueError: A name that there is not.
        """
        unknown = set(values) - {each.name for each in fields(cls)}
        if unknown:
            raise ValueError(f"options must be among those of TrainingOptions, got {', '.join(sorted(unknown))}")
        return cls(**({"effects": "none"} | values))  # of earlier versions, which looked at no capture


add_attributes(TrainingOptions, {each.name: text_of(each.name) for each in fields(TrainingOptions)})
for _each in fields(TrainingOptions):
    setattr(TrainingOptions, _each.name, _InPart(DECLARATIONS[_each.name][0], _each.name, _each.default))
