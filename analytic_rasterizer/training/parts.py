"""The parts of `TrainingOptions`, each with its options: what they are by default, their range, and what they do.

A *time* is a number of steps, or up to 1 a share of the training: 0.5 is when half of it is over.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from ..captures.depth_files import UNIT
from ..captures.reduction import SCALES
from ..checks import check_value
from ..declared import NOT_NEGATIVE, POSITIVE, SHARE, Options, Range, at_least, described, one_of, option
from ..density import GradientOptions
from ..footprints import RECOMMENDED, resolve_footprint
from ..io.images import BACKGROUNDS
from ..render.order import CENTER, ORDERS, key_of

DOWNSAMPLINGS = ("box", "bicubic", "blender")
EFFECTS = ("auto", "none")
EXPOSURES = ("none", "affine")
VIGNETTINGS = ("none", "polynomial")
DEPTHS = ("none", "points", "maps")
DEPTH_FITS = ("auto", "none")
DENSITIES = ("3dgs", "absgrad", "mcmc", "none")
RANDOM_BACKGROUND = "random"
NO_FOOTPRINT = "none"  # of the beginning, other than that of the end

RANDOM_POINTS = 100_000  # by default, where the limit of Gaussians is not below that
FINEST_REPEATS = 2  # how often the finest of several scales occurs by default, where the others occur once
FIRST_CHANGE, CHANGE_PERIOD = 500, 100  # steps, of density control in a training that is not short
LEAST_PERIOD = 10  # steps, whose pictures make an average
SHORT = 7000  # steps of the shortest training that is not
TOO_SHORT = 150  # steps, in fewer than which new Gaussians do not learn enough

WEIGHT = Range(lambda weight: weight == -1 or 0 <= weight < math.inf, "finite and not negative, or -1")
BACKGROUND = Range(
    lambda name: name in ("", *BACKGROUNDS, RANDOM_BACKGROUND), f"one of {', '.join([*BACKGROUNDS, RANDOM_BACKGROUND])}"
)


def is_time(value: float) -> bool:
    """Whether a number is a time."""
    return 0 <= value <= 1 or (1 < value < math.inf and value == int(value))


TIME = Range(is_time, "0 to 1", " (a share of the training; above 1 it is a whole number of steps)")
TIME_OR_USUAL = TIME._replace(fits=lambda value: value == -1 or is_time(value))


def steps_at(time: float, steps: float) -> float:
    """A time in steps, of `steps` in all."""
    return time if time > 1 else time * steps


def repeats_of(scales: tuple[int, ...], finest_repeats: int) -> tuple[int, ...]:
    """`scale_repeats` with which the finest of several scales occurs so often, and the others once."""
    several = len(scales) > 1
    return tuple(finest_repeats if several and scale == min(scales) else 1 for scale in scales)


@dataclass(frozen=True)
class SceneOptions(Options):
    """What is trained, and how it is seen."""

    footprint: str = option(
        RECOMMENDED,
        'How a pixel sees a splat, by name and options, as in "box:samples=4"; `FOOTPRINTS` has the names.',
        metavar="NAME[:k=v,..]",
        main=True,
    )
    first_footprint: str = option(
        "",
        "Footprint until `footprint_from`, cheaper than the one that is trained for. "
        '"none": `footprint` from the start. Without any: as `effects` find.',
        metavar="NAME[:k=v,..]",
        main=True,
    )
    footprint_from: float = option(
        0.9, "Time from which on pictures are rendered with `footprint`.", TIME, metavar="T", main=True
    )
    sh_degree: int = option(
        3,
        "Highest degree of the spherical harmonics, 0 to 3.",
        Range(lambda degree: 0 <= degree <= 3, "0 to 3"),
        main=True,
    )
    sh_every: int = option(
        1000, "Steps between two degrees, at most; never more than a tenth of the training.", at_least(1)
    )
    order: str = option(
        CENTER,
        'Order of splats: "center", by the depth of their centres; or along the rays of pixels, so that nothing pops '
        'when the camera moves: "ray", or "ray:32", which is nearer to the exact order. The last two take several '
        "times as long.",
        one_of(ORDERS),
        main=True,
    )
    filter_3d: bool = option(False, "Whether Gaussians are widened by the 3D filter of Mip-Splatting.", main=True)

    def __post_init__(self):
        object.__setattr__(self, "footprint", str(resolve_footprint(str(self.footprint))))
        if self.first_footprint not in ("", NO_FOOTPRINT):
            try:
                object.__setattr__(self, "first_footprint", str(resolve_footprint(str(self.first_footprint))))
            except ValueError as error:
                raise ValueError(f"first_footprint: {error}") from None
        super().__post_init__()
        for name in {self.footprint, self.first_footprint} - {"", NO_FOOTPRINT}:
            key_of(resolve_footprint(name), self.order)  # raises for what cannot be combined


@dataclass(frozen=True)
class PictureOptions(Options):
    """What becomes of the photographs."""

    scales: tuple[int, ...] = option(
        (1,), "Reductions to train at: 1 is the full size, 2 half of it.", SCALES, main=True
    )
    scale_repeats: tuple[int, ...] = option(
        (),
        "How often every picture of a scale occurs in one pass over the pictures, one number per scale. Without any: "
        "twice for the finest of several scales, once for the others.",
        Range(lambda repeats: not repeats or SCALES.fits(repeats), SCALES.expected),
        main=True,
    )
    downsampling: str = option(
        "box",
        'How coarse pictures are made: "box", means over squares of pixels, or "bicubic", with the kernel widened to '
        'the scale; in both, colours count by their alpha. "blender": means of colours and of alpha apart, as the '
        "files of the multi-scale Blender set were made.",
        one_of(DOWNSAMPLINGS),
        main=True,
    )
    pictures_per_step: int = option(1, "Pictures whose mean loss makes one step.", at_least(1), main=True)
    supersampling: int = option(
        1,
        "How many times larger pictures are rendered before squares of pixels are averaged; the footprint is evaluated "
        "in the small pixels. 1: not at all.",
        at_least(1),
        main=True,
    )
    background: str = option(
        "",
        'Colour behind the pictures: "black", "white", or "random" (drawn anew for every step; needs pictures with '
        "alpha). Without any: white where the pictures have alpha by convention (NeRF-synthetic), and black for "
        "photographs.",
        BACKGROUND,
        main=True,
    )
    effects: str = option(
        "auto",
        '"auto": look at the capture first, as `plan_capture` and the command `inspect` do, and take the options that '
        'it calls for, but for those that are given. "none": do not look.',
        one_of(EFFECTS),
        main=True,
    )
    exposure: str = option(
        "none",
        '"affine": learn a colour correction (3x4) for each training photograph, for captures whose exposure or white '
        'balance varies. It is applied before the loss; the scene has no correction. "none": none.',
        one_of(EXPOSURES),
    )
    vignetting: str = option(
        "none",
        '"polynomial": learn for each camera how much darker it shows what is far from its principal point, an even '
        'polynomial of the radius. It is applied before the loss; the scene has none. "none": none.',
        one_of(VIGNETTINGS),
    )

    def __post_init__(self):
        super().__post_init__()
        different = len(set(self.scales)) == len(self.scales)
        check_value("scales", different, "different from each other", self.scales)
        object.__setattr__(self, "scale_repeats", self.scale_repeats or repeats_of(self.scales, FINEST_REPEATS))
        fits = len(self.scale_repeats) == len(self.scales)
        check_value("scale_repeats", fits, f"{len(self.scales)} numbers, one per scale", self.scale_repeats)


@dataclass(frozen=True)
class LengthOptions(Options):
    """How long to train, and whether twice the same."""

    iterations: int = option(
        30_000, "Steps of the optimizer in all, also where a training is resumed.", at_least(1), main=True
    )
    seconds: float = option(
        0.0,
        "Time to train, s, by the clock, instead of a number of steps; 0: go by `iterations`.",
        NOT_NEGATIVE,
        metavar="SECONDS",
        main=True,
    )
    # The order of a pass is drawn from seed * 2^24 + its number, in 64 bits with or without a sign.
    seed: int = option(
        0,
        "Of the starting points, the order of the pictures, and everything else that is drawn; -2^39 to 2^40 - 1.",
        Range(lambda seed: -(2**39) <= seed < 2**40, "-2^39 to 2^40 - 1"),
        main=True,
    )
    deterministic: bool = option(
        False,
        "Whether every run has the same bits on CUDA too, whose frames with a sudden rise of pairs else may differ in "
        "the last bits; on a CPU they always are the same. Slower: torch's deterministic mode is on during every step, "
        "so that the host waits for the number of pairs. Operators of torch without a deterministic algorithm would "
        "warn.",
        main=True,
    )


@dataclass(frozen=True)
class StartOptions(Options):
    """The first Gaussians, and how many there may be."""

    random_points: int = option(
        0,
        "How many Gaussians to start with where the capture has no points; not more than `max_gaussians`. 0: 100,000, "
        "or `max_gaussians` where that is less.",
        at_least(0),
        main=True,
    )
    initial_opacity: float = option(
        0.1,
        "Opacity of the first Gaussians.",
        Range(lambda opacity: 0 < opacity < 1, "above 0 and below 1"),
        metavar="OPACITY",
    )
    initial_scale: float = option(
        1.0, "Scale of the first Gaussians, in distances to their neighbours.", POSITIVE, metavar="FACTOR"
    )
    max_gaussians: int = option(
        1_000_000,
        'Most Gaussians, at the start too; 0: no limit, which "mcmc" does not take. With "3dgs" and "absgrad" the '
        "limit rises evenly from the number at the start to this, until `densify_until`, and those with the largest "
        'gradients grow first; with "mcmc" the number rises by `grow_share` until it is reached.',
        at_least(0),
        main=True,
    )

    pixels_per_gaussian: float = option(
        16.0,
        "Pixels of all training pictures, at the finest scale, for each Gaussian: a lower limit than the default of "
        "`max_gaussians` where pictures are few or small. It is no less than twice the Gaussians of the start, and "
        "holds only where `max_gaussians` has its default. 0: no such limit.",
        NOT_NEGATIVE,
        metavar="PIXELS",
    )

    def __post_init__(self):
        super().__post_init__()
        # More than the limit is refused where the points are made: options of finished trainings can still be read.
        usual = min(RANDOM_POINTS, self.max_gaussians or RANDOM_POINTS)
        object.__setattr__(self, "random_points", self.random_points or usual)


@dataclass(frozen=True)
class LossOptions(Options):
    """What is made small. The weights of -1 depend on the density control."""

    ssim_weight: float = option(
        0.2, "Share of 1 - SSIM in the loss, next to the mean absolute error.", SHARE, metavar="SHARE"
    )
    opacity_weight: float = option(
        -1.0, 'Weight of the mean opacity in the loss; -1: 0.01 for "mcmc", otherwise 0.', WEIGHT, metavar="WEIGHT"
    )
    scale_weight: float = option(
        -1.0,
        'Weight of the mean scale in the loss, in fifths of the extent; -1: 0.01 for "mcmc", otherwise 0.',
        WEIGHT,
        metavar="WEIGHT",
    )
    depth: str = option(
        "none",
        'Measured depths that inverse depths of the rendering are compared with: "points", those of the points that '
        'each photograph shows; "maps", the depth maps beside the photographs; "none".',
        one_of(DEPTHS),
        main=True,
    )
    depth_weight: float = option(
        0.1,
        "Weight in the loss, at the start, of the mean difference of inverse depths, times the median depth of each "
        "photograph.",
        NOT_NEGATIVE,
        metavar="WEIGHT",
    )
    depth_weight_end: float = option(
        0.01,
        "The same at the end; in between it changes exponentially, or evenly where one of the two is 0.",
        NOT_NEGATIVE,
        metavar="WEIGHT",
    )
    depth_fit: str = option(
        "auto",
        '"auto": scale and shift of the inverse depths of each map are fitted to the points that its photograph shows, '
        'where it shows 20 or more. "none": they are those of the files.',
        one_of(DEPTH_FITS),
    )
    depth_unit: float = option(
        UNIT,
        "World units of 1 in the depth maps that transforms.json names, `depth_unit_scale_factor` of nerfstudio. Maps "
        "of inverse depths have none.",
        POSITIVE,
        metavar="LENGTH",
    )


@dataclass(frozen=True)
class RateOptions(Options):
    """Learning rates, and the optimizer."""

    means_rate: float = option(
        3.2e-4,
        "Learning rate of the means at the start, per unit of the scene's extent.",
        POSITIVE,
        metavar="RATE",
    )
    means_rate_end: float = option(
        1.6e-6, "The same at the end; in between it falls exponentially.", POSITIVE, metavar="RATE"
    )
    means_rate_steps: int = option(
        0,
        "Steps after which the rate of the means has reached its end, whatever the length of the training (3DGS: "
        "30,000); 0: when the training ends.",
        at_least(0),
    )
    color_rate: float = option(
        5e-3,
        "Learning rate of the constant of the harmonics; the others learn at 1/20 of it.",
        POSITIVE,
        metavar="RATE",
    )
    opacity_rate: float = option(0.05, "Learning rate of the logit opacities.", POSITIVE, metavar="RATE")
    scale_rate: float = option(1e-2, "Learning rate of the log scales.", POSITIVE, metavar="RATE")
    rotation_rate: float = option(2e-3, "Learning rate of the quaternions.", POSITIVE, metavar="RATE")
    rates_from: float = option(
        7000.0,
        "Time after which the learning rates other than that of the means begin to fall.",
        TIME,
        metavar="T",
    )
    rates_half_life: int = option(
        7000, "Steps in which they then fall to a half, exponentially; 0: they stay.", at_least(0)
    )
    sparse_adam: bool = option(
        False,
        "Whether a step of the optimizer updates only the Gaussians that at least one of its pictures shows (3DGS's "
        "radii > 0), as 3DGS's `--optimizer_type sparse_adam` does. The others keep parameters and moments, whatever "
        "regularizers would do to them.",
        main=True,
    )


@dataclass(frozen=True)
class GrowthOptions(Options):
    """Which density control there is, and when it changes the number of Gaussians."""

    density: str = option(
        "absgrad",
        'Density control. "3dgs": clone and split by the gradient of the projected means; "absgrad": the same by the '
        'sum of its absolute values over pixels [AbsGS]; "mcmc": relocate and add by opacity [3DGS-MCMC]; "none".',
        one_of(DENSITIES),
        main=True,
    )
    densify_from: float = option(
        -1.0,
        "Time before the first change; -1: 500 steps, or a fourteenth of a training of fewer than 7,000. In a training "
        "of fewer than 150 nothing changes, unless this or `densify_every` is given.",
        TIME_OR_USUAL,
        metavar="T",
    )
    densify_until: float = option(0.75, "Time after which the number of Gaussians stays.", TIME, metavar="T")
    densify_every: int = option(
        0,
        "Steps between changes; 0: 100, or a seventieth of a training of fewer than 7,000, but at least 10.",
        at_least(0),
    )

    def times(self, steps: float) -> dict[str, float]:
        """When density control acts in a training of `steps`, as it is told: a share for `densify_until`, else steps.

        What is left open comes sooner in a short training, in proportion, and never in one that is too short.
        """
        pace = min(steps / SHORT, 1)
        start, until = self.densify_from, self.densify_until
        if start == -1:
            start = steps if steps < TOO_SHORT and self.densify_every == 0 else FIRST_CHANGE * pace
        return {
            "densify_from": round(steps_at(start, steps)),
            "densify_until": until if until <= 1 else min(until / steps, 1.0),
            "densify_every": self.densify_every or max(round(CHANGE_PERIOD * pace), LEAST_PERIOD),
        }


@described
@dataclass(frozen=True)
class GradientGrowth(GradientOptions):
    """`GradientOptions` of a training, which may have pictures of several scales."""

    gradient_scales: str = option(
        "finest",
        'Which scales the mean of the gradients is over: "all", or "finest", the largest pictures alone.',
        Range(lambda name: name in ("all", "finest"), "all or finest"),
    )
