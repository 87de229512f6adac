"""What a training starts from: Gaussians from a scene, from points or at random places; and the background.

Also the options of a checkpoint that goes on to another length.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import torch
from torch import Tensor

from .. import io
from ..captures.evidence import READERS
from ..captures.extent import seen_distance
from ..captures.loading import Capture, Photograph
from ..captures.photographs import counted_pixels
from ..captures.pictures import read_sizes
from ..captures.placement import focus_of, points_in_view, random_points
from ..gaussians import Gaussians
from .health import FAINTEST
from .options import TrainingOptions
from .parts import BACKGROUNDS, RANDOM_BACKGROUND
from .unused import check_effect

FEWEST = 1000  # Gaussians that any training may have


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


def pixel_limit(options: TrainingOptions, sizes: Sequence[tuple[int, int]], chosen: Collection[str] = ()) -> int | None:
    """As many Gaussians as pictures of these sizes [px] can show, by `pixels_per_gaussian`.

    None where another limit was chosen, or this one is no lower.
    """
    usual = options.max_gaussians == TrainingOptions.max_gaussians and "max_gaussians" not in chosen
    if not usual or options.pixels_per_gaussian == 0 or options.density == "none":
        return None
    finest = min(options.scales)
    pixels = sum((width // finest) * (height // finest) for width, height in sizes)
    limit = max(round(pixels / options.pixels_per_gaussian), FEWEST)
    return limit if limit < options.max_gaussians else None


def begin(
    options: TrainingOptions, capture: Capture, points, chosen: Collection[str] = ()
) -> tuple[Gaussians, int | None, TrainingOptions, list[str]]:
    """As `first_gaussians`; and the options, with a limit of Gaussians by what the pictures can show, and what to say.

    It is no less than twice the Gaussians of the start: fewer learn worse, also of random ones.
    """
    # Of the files: photographs are often smaller than their cameras say, as those of images_4 are.
    limit = pixel_limit(options, [header[:2] for _, header in read_sizes(capture.train)], chosen)
    start, found = first_gaussians(options, capture, points, chosen)
    said = []
    if limit is not None:
        options = replace(options, max_gaussians=max(limit, min(2 * start.count, options.max_gaussians)))
        shown = f"one for {options.pixels_per_gaussian:g} pixels of {len(capture.train)} pictures"
        told = f"at most {options.max_gaussians:,} Gaussians, {shown}, or twice those of the start"
        said.append(f"{told} (--pixels-per-gaussian, --max-gaussians)")
    if points is None and capture.points is None and capture.starts_in_view:
        said.append(f"no points in the capture: starts from {start.count:,} random ones in the views (--points)")
    return start, found, options, said


def first_gaussians(
    options: TrainingOptions, capture: Capture, points, given: Collection[str] = ()
) -> tuple[Gaussians, int | None]:
    """From a .ply if one is given, a scene or points; otherwise from the capture's points, or at random places.

    Also returns how many points there were, of which `starting_gaussians` takes at most `max_gaussians`; None where the
    Gaussians are those of a scene, or random.

    Raises:
        io.SceneError: No picture shows any of the points.
        ValueError: A scene without Gaussians, or with more than `max_gaussians`; what `starting_gaussians` raises; an
            option among those `given` that has no effect.
    """
    maps = [item.depth for item in capture.train if item.depth is not None]
    inverse_maps = bool(maps) and all(file.is_inverse for file in maps)
    offset = torch.tensor(capture.offset or (0.0, 0.0, 0.0), dtype=torch.float64, device="cpu")
    if points is not None and io.is_scene(points):
        check_effect(options, given, "a scene", inverse_maps)
        scene = io.load_scene(points)
        if not len(scene.means):  # from which nothing would ever grow
            raise io.SceneError(f"{points}: the scene has no Gaussians")
        if len(scene.means) > options.gaussian_limit:
            expected = f"at least {len(scene.means)}, the Gaussians of {points}, or 0"
            raise ValueError(f"max_gaussians must be {expected}, got {options.max_gaussians}")
        own = offset.new_tensor(io.read_metadata(points).offset or (0.0, 0.0, 0.0))
        if not torch.equal(own, offset):
            scene = scene._replace(means=(scene.means.double() + own - offset).to(scene.means.dtype))
        if not (scene.opacities >= FAINTEST).any():
            raise io.SceneError(f"{points}: all Gaussians are transparent (opacities below 1/255), none can learn")
        return scene.with_sh_degree(options.sh_degree).trainable(), None
    check_effect(options, given, "nothing" if points is None and capture.points is None else "points", inverse_maps)
    found = capture.points
    if points is not None:
        positions, colors = io.load_points(points)
        found = (positions.double() - offset).float(), colors
    views = [item.view for item in capture.train]
    start = starting_gaussians(options, found, views if capture.starts_in_view else None, _masks(found, capture))
    if found is None and not capture.starts_in_view and capture.offset is not None:
        # The cube of NeRF-synthetic scenes is about the world's zero, which is far from this one.
        focus, _ = focus_of(views)
        start = start._replace(means=start.means + (0.0 if focus is None else focus.float()))
    if found is not None and not seen_distance(views, start.means):
        source = "the capture" if points is None else points
        raise io.SceneError(
            f"no picture shows any of the {len(found[0])} points of {source}: the cameras must see them"
        )
    return start, None if found is None else len(found[0])


def _masks(points, capture: Capture) -> list[Tensor | None] | None:
    """Where the photographs count that random points are placed by; None where no points are."""
    if points is not None or not capture.starts_in_view:
        return None

    def counted(item: Photograph) -> Tensor | None:  # in the camera of its view
        return None if item.undistort else counted_pixels(item.files[1], item.mask)

    with ThreadPoolExecutor(READERS) as pool:
        return list(pool.map(counted, capture.train))


def starting_gaussians(
    options: TrainingOptions,
    points: tuple[Tensor, Tensor] | None,
    views: list[io.View] | None = None,
    masks: list[Tensor | None] | None = None,
) -> Gaussians:
    """Gaussians at points, or at random positions where there are none. On the CPU.

    Args:
        options: Of the training. Where there are more points than `max_gaussians`, that many are drawn by the seed,
            and stay in the order of the points.
        points: Positions and colours, (P, 3) each; None: random.
        views: In whose pictures random positions are; None: in the cube of NeRF-synthetic scenes.
        masks: Where their pixels count, as of `points_in_view`.

    Raises:
        io.SceneError: Fewer than two points.
        ValueError: More random points than `max_gaussians`.
    """
    limit = options.gaussian_limit
    if points is None:
        if options.random_points > limit:
            raise ValueError(f"random_points must be at most max_gaussians, {limit}, got {options.random_points}")
        if views is None:
            means, colors = random_points(options.random_points, options.seed)
        else:
            means, colors = points_in_view(views, options.random_points, options.seed, masks)
    else:
        means, colors = points
        if len(means) > limit:
            generator = torch.Generator().manual_seed(options.seed)
            rows = torch.randperm(len(means), generator=generator, device="cpu")[:limit].sort().values
            means, colors = means[rows], colors[rows]
    if len(means) < 2:
        because = " (max_gaussians)" if limit < 2 else ""
        raise io.SceneError(f"training needs at least 2 points to start from, got {len(means)}{because}")
    # Distances are those of the positions as they are given, float64 too.
    colors, first = colors.to(means.dtype), (options.sh_degree, options.initial_opacity, options.initial_scale)
    return Gaussians.from_points(means, colors, *first).map(Tensor.float)


def background_of(options: TrainingOptions, convention: tuple[float, float, float]) -> tuple | None:
    """The colour of the options, or that of the capture's convention; None for random ones."""
    if options.background == RANDOM_BACKGROUND:
        return None
    return BACKGROUNDS.get(options.background, convention)


def background_shown(options: TrainingOptions, convention: tuple[float, float, float]) -> tuple[float, float, float]:
    """What a scene is shown and tested on: in place of random colours, which have no truth, the convention's."""
    return background_of(options, convention) or convention
