"""Options that change nothing beside the others: a training raises ValueError if one was chosen, and says why."""

from __future__ import annotations

from collections.abc import Collection

from ..density import GradientOptions
from .options import DECLARATIONS, TrainingOptions, controls_of, flag, of_other_control
from .parts import steps_at
from .schedule import SH_SHARE, changes_at


def check_effect(options: TrainingOptions, given: Collection[str], start: str, inverse_maps: bool = False) -> None:
    """Raises ValueError for the first of the options `given` that has no effect, and says why.

    Args:
        start: What the training starts from: "a scene", "points", or "nothing".
        inverse_maps: Whether the depth maps of the capture all hold inverse depths.
    """
    reasons = without_effect(options, start, inverse_maps)
    for name in given:
        reason = of_other_control(name, options.density) or reasons.get(name)
        if reason is not None:
            raise ValueError(f"{flag(name)} has no effect: {reason}")


def without_effect(options: TrainingOptions, start: str = "nothing", inverse_maps: bool = False) -> dict[str, str]:
    """The names of all options that have no effect beside the others, with the reason.

    Of a training by the clock nobody knows the steps, so that they are no reason.
    """
    reasons: dict[str, str] = {}

    def note(names: Collection[str], reason: str) -> None:
        for name in names:
            reasons.setdefault(name, reason)

    if start != "nothing":
        note(["random_points"], f"the training starts from {start}")
    if start == "a scene":
        note(["initial_opacity", "initial_scale"], "the training starts from a scene")
    if options.max_gaussians != TrainingOptions.max_gaussians:
        note(["pixels_per_gaussian"], f"max_gaussians is {options.max_gaussians:,}, which holds in its place")
    if options.densify_until == 0:
        note(growth_of(options) - {"densify_until"}, "densify_until is 0, so that nothing changes")
    if len(options.scales) == 1:
        note(["gradient_scales"], "there is one scale")
        if options.scales == (1,):
            note(["downsampling"], "the pictures are trained on at their full size")
    if options.begins_with is None:
        note(["footprint_from"], f"the footprint is {options.footprint} from the start")
    if options.depth == "none":
        note(["depth_weight", "depth_weight_end"], "depth is none")
    if options.depth != "maps":
        note(["depth_fit", "depth_unit"], f"it is for depth maps, and depth is {options.depth}")
    if inverse_maps:
        note(["depth_unit"], "all depth maps hold inverse depths, which have none")
    if options.sh_degree == 0:
        note(["sh_every"], "sh_degree is 0")
    if options.rates_half_life == 0:
        note(["rates_from"], "rates_half_life is 0, so that no rate falls")
    if options.seconds:
        note(["deterministic"], "by the clock, every run has another number of steps")
    else:
        _note_times(options, note)
    return reasons


def growth_of(options: TrainingOptions) -> set[str]:
    """The options that say when and how density control changes the number of Gaussians."""
    return {name for name in DECLARATIONS if options.density in controls_of(name)} - {"noise"}


def _note_times(options: TrainingOptions, note) -> None:
    """What comes after the end, by the steps of the training."""
    steps = options.iterations
    of_training = f"the training has {steps:,} steps"
    if options.sh_every > SH_SHARE * steps:
        note(["sh_every"], f"a degree is added every {SH_SHARE * steps:g} steps, a tenth of the training, anyway")
    if steps_at(options.rates_from, steps) >= steps:
        note(["rates_from", "rates_half_life"], f"rates fall from step {options.rates_from:,g} on, and {of_training}")
    if options.control is None or options.densify_until == 0:
        return
    changes, end = changes_at(options, steps), options.growth.times(steps)["densify_until"] * steps
    if not changes:
        reason = (
            f"the number of Gaussians never changes: the first change would be at step {changes.start:,}, and growth "
            f"ends at {end:,g}"
        )
        note(growth_of(options), f"{reason} ({of_training})")
    if not isinstance(options.control, GradientOptions):
        return
    if options.reset_every >= end:
        note(["reset_every"], f"the first would be after step {options.reset_every:,}, and growth ends at {end:,g}")
    if options.reset_every == 0 or options.reset_every >= max(changes, default=0):
        reset = f"the first is after step {options.reset_every:,}" if options.reset_every else "reset_every is 0"
        note(["prune_above"], f"sizes are limited after a reset of the opacities, {reset}, and growth ends at {end:,g}")
