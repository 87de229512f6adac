"""What a training starts from: pictures and points, or a checkpoint, with its options or another length."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from pathlib import Path
from typing import Any

from .. import io
from ..gaussians import Gaussians
from .captures import IMAGES, TEST_PERIOD, Capture
from .health import FAINTEST
from .options import TrainingOptions
from .trainer import starting_gaussians
from .unused import check_effect


def source_of(images: str | None, test_every: int | None, points, state: dict[str, Any] | None) -> dict[str, Any]:
    """Where pictures and points come from: as given or usual, or as in the checkpoint of a training that is resumed.

    Raises ValueError for another source than it began with: it would go on with other pictures, or points of no effect.
    """
    given = {"images": images, "test_every": test_every, "points": points and str(Path(points).resolve())}
    usual = {"images": IMAGES, "test_every": TEST_PERIOD, "points": None}
    if state is not None:
        usual = given | state["source"]  # which has no points in earlier versions: nobody knows them
    chosen = {name: usual[name] if value is None else value for name, value in given.items()}
    for name, value in chosen.items():
        if state is not None and value != usual[name]:
            expected = "None" if usual[name] is None else f"{usual[name]} or None"
            raise ValueError(f"{name} must be {expected} where a training is resumed, got {value}")
    return chosen


def of_length(
    stored: TrainingOptions, iterations: int | None, seconds: float | None, step: int, elapsed: float
) -> TrainingOptions:
    """The options of a checkpoint, or the same for another number of steps or seconds in all.

    Args:
        stored: Of the checkpoint.
        iterations, seconds: In all; None: as stored.
        step, elapsed: Steps and seconds that are over.

    Raises:
        ValueError: Less than is over, or steps for a training that goes by the clock, or the other way round.
    """
    if iterations is not None and iterations != stored.iterations:
        if stored.seconds:
            raise ValueError("iterations: this training goes by the clock; give seconds instead")
        if iterations < step:
            raise ValueError(f"iterations must be at least {step}, the steps that are over, got {iterations}")
        return replace(stored, iterations=iterations)
    if seconds is not None and seconds != stored.seconds:
        if not stored.seconds:
            raise ValueError("seconds: this training goes by its steps; give iterations instead")
        if not seconds >= elapsed:
            raise ValueError(f"seconds must be at least {elapsed:.1f}, those that are over, got {seconds}")
        return replace(stored, seconds=seconds)
    return stored


def first_gaussians(
    options: TrainingOptions, capture: Capture, points, given: Collection[str] = ()
) -> tuple[Gaussians, int | None]:
    """From a .ply if one is given, a scene or points; otherwise from the capture's points, or at random places.

    Also returns how many points there were, of which `starting_gaussians` takes at most `max_gaussians`; None where the
    Gaussians are those of a scene, or random.

    Raises:
        ValueError: A scene without Gaussians, or with more than `max_gaussians`; what `starting_gaussians` raises; an
            option among those `given` that has no effect.
    """
    if points is not None and io.is_scene(points):
        check_effect(options, given, "a scene")
        scene = io.load_scene(points)
        if not len(scene.means):  # from which nothing would ever grow
            raise io.SceneError(f"{points}: the scene has no Gaussians")
        if len(scene.means) > options.gaussian_limit:
            expected = f"at least {len(scene.means)}, the Gaussians of {points}, or 0"
            raise ValueError(f"max_gaussians must be {expected}, got {options.max_gaussians}")
        if not (scene.opacities >= FAINTEST).any():
            raise io.SceneError(f"{points}: all Gaussians are transparent (opacities below 1/255), none can learn")
        return scene.with_sh_degree(options.sh_degree).trainable(), None
    check_effect(options, given, "nothing" if points is None and capture.points is None else "points")
    found = capture.points if points is None else io.load_points(points)
    return starting_gaussians(options, found), None if found is None else len(found[0])
