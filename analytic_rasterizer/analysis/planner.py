"""What a scene calls for, seen from some views: bounds and measurements of what leaving an effect out changes.

`inspect_scene` reports on every effect, `plan` returns only the `Effects`. Their tolerance is the root mean square over
the pixels and channels of a view, in units of colour (0 to 1), between the recommendation and everything switched on:
REFERENCE, all bands of the harmonics, and the 3D filter where a view calls for it. How far REFERENCE itself is from the
true integral is measured in docs/accuracy.md.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial, reduce

import torch

from .._C import FRUSTUM_CLAMP
from ..cameras.camera import View, is_off_center, is_orthographic
from ..filters import apply_3d_filter, compute_3d_filter, sampling_interval
from ..footprints import sampled_footprints
from ..gaussians import Gaussians
from ..render.effects import NEAR, Effects
from ..render.order import CENTER, RAY
from ..render.outputs import depths
from ..render.rasterizer import GaussianRasterizer
from ..render.seam import has_seam
from ..render.settings import GaussianRasterizationSettings
from ..render.stages import Splats, Stages, project, render_stages
from ..sh import needed_sh_degree, sh_band_bounds
from . import timing
from .affine import LIMIT, bends
from .inspection import BINS, NARROW, Candidate, EffectFinding, SceneReport, ViewReport, in_255, percent, share
from .orders import OrderDifference

LADDER = sampled_footprints()  # what is tried
BASE, REFERENCE = LADDER[0], LADDER[-1]  # the cheapest, and what the others are compared with
SH_SHARE = 0.5  # of the tolerance, at most, for the harmonics left out
FILTER_SHARE = 0.25  # of the tolerance: below it the 3D filter is left out
FINER = 1.1  # a view calls for the 3D filter if it samples so many times as finely as in training
FINER_SHARE = 0.01  # more than this share of what it shows
BENT_SHARE = 0.01  # of the Gaussians that a view shows: with more, their splats are said to be wrong
SAME = 1.05  # ratio of times up to which the candidate listed first is taken
TIMED_VIEWS = 2
PATIENCE = 4.0  # seconds of a timing on the CPU, about: what takes long needs few rounds


@torch.no_grad()
def plan(
    scene: Gaussians,
    views: Sequence[View | GaussianRasterizationSettings],
    tolerance: float = 1 / 255,
    training_views: Sequence[View | GaussianRasterizationSettings] | None = None,
) -> Effects:
    """The `Effects` that these views of a scene call for: those of `inspect_scene`, without measuring footprints.

    Arguments and errors are those of `inspect_scene`.
    """
    cameras, training = _check(scene, views, tolerance, training_views)
    return _choose_effects(scene, cameras, tolerance, training).effects


@torch.no_grad()
def inspect_scene(
    scene: Gaussians,
    views: Sequence[View | GaussianRasterizationSettings],
    tolerance: float = 1 / 255,
    training_views: Sequence[View | GaussianRasterizationSettings] | None = None,
    *,
    scale: float = 1.0,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    rounds: int | None = None,
    progress: Callable[[str], object] = lambda what: None,
) -> SceneReport:
    """Which effects and which footprint these views of a scene call for, what each changes, and what it costs.

    The choice is the cheapest of a few footprints that, with the chosen effects, stays within the tolerance of
    everything switched on in every view: REFERENCE, all bands of the harmonics, and the 3D filter where it is called
    for. That is measured in these views, and is for showing this scene: `footprints.ADVICE` is the general advice. For
    the bands of harmonics that are left out it is a bound, which holds for any view. Renders every view several times.

    Args:
        scene: P Gaussians on the device to measure on.
        views: What it will be seen from, at least one. Footprint and effects of settings are ignored, but for lenses.
        tolerance: Root mean square over the pixels and channels of each view, in units of colour, not negative.
        training_views: What the scene was trained from, at their size; None: the 3D filter is not examined.
        scale: Resolution of `io.View`s among the views, as a factor.
        background: Colour behind the scene in `io.View`s.
        rounds: Timed rounds; None: 5, of which the fastest counts, with CUDA 20, of which the median. Fewer where they
            would take long.
        progress: Called with what begins, `steps_of(views)` times.

    Raises:
        TypeError: scene, a view or the tolerance has a wrong type.
        ValueError: No views, a tolerance that is negative or not finite, or perspective and orthographic views at once.
    """
    cameras, training = _check(scene, views, tolerance, training_views, scale, background)
    if rounds is not None and not (isinstance(rounds, int) and rounds >= 1):
        raise ValueError(f"rounds must be a positive whole number, got {rounds!r}")
    chosen = _choose_effects(scene, cameras, tolerance, training)
    found = _compare(scene, cameras, chosen, tolerance, progress)
    timed = cameras[:: -(-len(cameras) // TIMED_VIEWS)]
    tried = {name: (scene, name, chosen.effects) for name in dict.fromkeys([BASE, *found.fitting])}
    progress("time footprints")
    seconds = _seconds(tried, timed, rounds)
    cheapest = min(seconds[name] for name in found.fitting)
    footprint = next(name for name in found.fitting if seconds[name] <= SAME * cheapest)
    costs = {name: of_name / seconds[BASE] for name, of_name in seconds.items()}
    candidates = {
        name: Candidate(name, max(rms), name in found.fitting, costs.get(name)) for name, rms in found.rms.items()
    }
    reports = []
    for i, camera in enumerate(cameras):
        progress("look at views")
        name = getattr(views[i], "name", f"view_{i:03d}")
        reports.append(_view_report(scene, chosen, i, name, camera, found.seen[i], found.rms[footprint][i]))
    progress("time effects")
    costs = _effect_costs(scene, timed, footprint, chosen.effects, found.shown, rounds)
    orders = _order_difference(scene, cameras, chosen.effects)
    findings = (
        _footprint_finding(candidates, footprint, reports),
        _sh_finding(scene, chosen, found.top_band, costs.get("sh")),
        _filter_finding(chosen, costs.get("filter_3d")),
        _cull_finding(scene, cameras, found.shown, found.on_image, costs["culls"]),
        _order_finding(orders, tolerance, costs.get("order")),
        _affine_finding(scene, cameras, found.seen, [report.name for report in reports]),
        *_other_findings(chosen, costs["outputs"]),
    )
    machine = timing.describe_machine(scene.means.device.type)
    choice = (chosen.effects, footprint, findings, tuple(candidates.values()), tuple(reports), found.shown)
    return SceneReport(len(scene.means), scene.sh_degree, tolerance, machine, *choice)


def steps_of(views: Sequence) -> int:
    """How often `inspect_scene` calls `progress`."""
    return 2 * len(views) + 2


def _check(scene, views, tolerance, training_views, *options) -> tuple[list, list | None]:
    """Settings of the views and of those of training. `options`: scale and background of `View.settings`."""
    if not isinstance(scene, Gaussians):
        raise TypeError(f"scene must be Gaussians, got {type(scene).__name__}")
    if isinstance(tolerance, bool) or not isinstance(tolerance, (int, float)):
        raise TypeError(f"tolerance must be a number, got {tolerance!r}")
    if not 0 <= tolerance < math.inf:
        raise ValueError(f"tolerance must be finite and not negative, got {tolerance}")
    device = scene.means.device
    cameras = _cameras("views", views, device, *options)
    return cameras, None if training_views is None else _cameras("training_views", training_views, device)


def _cameras(what: str, views, device, *options) -> list[GaussianRasterizationSettings]:
    if not isinstance(views, Sequence):
        raise TypeError(f"{what} must be a list of views, got {type(views).__name__}")
    for view in views:
        if not isinstance(view, (View, GaussianRasterizationSettings)):
            raise TypeError(f"{what} must hold io.View or GaussianRasterizationSettings, got {type(view).__name__}")
    if not views:
        raise ValueError(f"{what} must hold at least one view, got none")
    return [view.settings(*options, device=device) if isinstance(view, View) else view for view in views]


@dataclass(frozen=True, eq=False)
class _ChosenEffects:
    """The choice of effects, and what it is based on."""

    effects: Effects  # recommended
    everything: Effects  # what the tolerance is measured against
    bounds: list[float]  # of `sh_band_bounds`
    ratios: list[torch.Tensor]  # per view, of the Gaussians that training saw too: interval in training over the view's
    filter_change: float | None  # largest RMS of the 3D filter over the views; None where no view calls for it
    off_center: list[bool]  # which views are


def _choose_effects(scene: Gaussians, cameras: list, tolerance: float, training: list | None) -> _ChosenEffects:
    orthographic = [is_orthographic(camera) for camera in cameras]
    if any(orthographic) != all(orthographic):
        raise ValueError(
            f"views must be all perspective or all orthographic, got {sum(orthographic)} of {len(cameras)} orthographic"
        )
    off_center = [not orthographic[0] and is_off_center(camera) for camera in cameras]
    everything = Effects(orthographic=orthographic[0], off_center=any(off_center))
    ratios, filter_change = [], None
    if training is not None:
        finest = reduce(torch.minimum, (sampling_interval(scene.means, camera) for camera in training))
        intervals = [sampling_interval(scene.means, camera) for camera in cameras]
        ratios = [(finest / own)[finest.isfinite() & own.isfinite()] for own in intervals]
        if any(share(ratio > FINER) > FINER_SHARE for ratio in ratios):
            filtered = replace(everything, filter_3d=compute_3d_filter(scene.means, training))
            filter_change = max(
                _rms(*(_stages(scene, camera, REFERENCE, effects) for effects in (everything, filtered)))
                for camera in cameras
            )
            everything = filtered
    shs = scene.shs[:, : (scene.sh_degree + 1) ** 2]
    degree = needed_sh_degree(shs, SH_SHARE * tolerance)
    effects = replace(
        everything,
        sh_degree=degree if degree < scene.sh_degree else None,
        filter_3d=everything.filter_3d if (filter_change or 0) > FILTER_SHARE * tolerance else None,
    )
    return _ChosenEffects(effects, everything, sh_band_bounds(shs), ratios, filter_change, off_center)


@dataclass(eq=False)
class _Comparison:
    """How the footprints of LADDER render the views, beside REFERENCE with everything switched on."""

    rms: dict[str, list[float]]  # by footprint, of the views up to the first beyond the tolerance
    fitting: list[str]  # footprints within the tolerance in all views
    seen: list[torch.Tensor]  # (P,) bool of each view: which Gaussians touch it
    shown: torch.Tensor  # (P,) bool: those of any view, with any footprint
    on_image: torch.Tensor  # (P,) bool: those with a radius in any view
    top_band: float  # RMS that the last band of the harmonics changes


def _compare(scene: Gaussians, cameras: list, chosen: _ChosenEffects, tolerance: float, progress) -> _Comparison:
    nothing = torch.zeros(len(scene.means), dtype=torch.bool, device=scene.means.device)
    found = _Comparison({footprint: [] for footprint in LADDER}, list(LADDER), [], nothing, nothing, 0.0)
    for camera in cameras:
        progress("compare footprints")
        reference = _stages(scene, camera, REFERENCE, chosen.everything)
        found.seen.append(_touching(reference))
        found.shown, found.on_image = found.shown | found.seen[-1], found.on_image | (reference.radii > 0)
        for footprint in list(found.fitting):
            stages = _stages(scene, camera, footprint, chosen.effects)
            found.rms[footprint].append(_rms(stages, reference))
            found.shown = found.shown | _touching(stages)
            if found.rms[footprint][-1] > tolerance:
                found.fitting.remove(footprint)
        if chosen.effects.sh_degree is None and scene.sh_degree > 0:
            fewer = replace(chosen.everything, sh_degree=scene.sh_degree - 1)
            found.top_band = max(found.top_band, _rms(_stages(scene, camera, REFERENCE, fewer), reference))
    return found


def _prepare(scene: Gaussians, camera, footprint: str, effects: Effects) -> tuple[GaussianRasterizationSettings, dict]:
    """Settings, and Gaussians after the 3D filter, for these effects."""
    gaussians = scene.arguments()
    if effects.filter_3d is not None:
        filtered = apply_3d_filter(scene.scales, scene.opacities, effects.filter_3d)
        gaussians["scales"], gaussians["opacities"] = filtered
    lens = camera.effects.lens if isinstance(camera.effects, Effects) else None  # of the camera, and no choice
    effects = replace(effects, filter_3d=None, lens=lens)
    options = {"footprint": footprint, "sh_degree": scene.sh_degree, "effects": effects}
    return camera._replace(**options), gaussians


def _stages(scene: Gaussians, camera, footprint: str, effects: Effects) -> Stages:
    settings, gaussians = _prepare(scene, camera, footprint, effects)
    return render_stages(settings, **gaussians)


def _touching(stages: Stages) -> torch.Tensor:
    """(P,) bool: which Gaussians are in the list of a tile."""
    touching = torch.zeros_like(stages.radii, dtype=torch.bool)
    touching[stages.ids[stages.pairs.long()].long()] = True
    return touching


def _rms(stages: Stages, reference: Stages) -> float:
    return (stages.color.double() - reference.color).square().mean().sqrt().item()


def _seconds(cases: dict[str, tuple], cameras: list, rounds: int | None) -> dict[str, float]:
    """Seconds of the forward passes of all cameras, by case: (scene, footprint, effects)."""
    passes, device = {}, cameras[0].viewmatrix.device.type
    for name, (scene, footprint, effects) in cases.items():
        prepared = (_prepare(scene, camera, footprint, effects) for camera in cameras)
        passes[name] = [partial(GaussianRasterizer(s), means2D=None, **gaussians) for s, gaussians in prepared]
    samples = timing.time_calls(passes, device, rounds, patience=PATIENCE)
    return {name: sum(timing.best_of(taken, device) for taken in of) for name, of in samples.items()}


def _effect_costs(scene: Gaussians, cameras, footprint, effects: Effects, shown, rounds) -> dict[str, float]:
    """Time with an effect over that without, by effect."""
    only_shown = scene.rows(shown)
    filter_of_shown = None if effects.filter_3d is None else effects.filter_3d[shown]
    cases = {
        "plain": (scene, footprint, effects),
        "shown": (only_shown, footprint, replace(effects, filter_3d=filter_of_shown)),
        "outputs": (scene, footprint, replace(effects, alpha=True, depth=True)),
    }
    with_and_without = {"culls": ("plain", "shown"), "outputs": ("outputs", "plain")}
    if scene.sh_degree > 0:
        cases["bands"], cases["no bands"] = ((scene, footprint, replace(effects, sh_degree=n)) for n in (None, 0))
        with_and_without["sh"] = ("bands", "no bands")
    if effects.filter_3d is not None:
        cases["no filter"] = (scene, footprint, replace(effects, filter_3d=None))
        with_and_without["filter_3d"] = ("plain", "no filter")
    if not has_seam(cameras[0]):
        cases["rays"], cases["centers"] = ((scene, BASE, replace(effects, order=o)) for o in (RAY, CENTER))
        with_and_without["order"] = ("rays", "centers")
    seconds = _seconds(cases, cameras, rounds)
    return {name: seconds[on] / seconds[off] for name, (on, off) in with_and_without.items()}


def _footprint_finding(candidates: dict[str, Candidate], footprint: str, views: list[ViewReport]) -> EffectFinding:
    narrow = sum(v.narrow * v.shown for v in views) / max(1, sum(v.shown for v in views))
    best = candidates[footprint]
    reason = (
        f"{percent(narrow)} of the Gaussians are narrower than a pixel in these views (standard deviation below "
        f"{NARROW:g} px); pictures are within {in_255(best.rms)}/255 of the most exact ones"
    )
    return EffectFinding("footprint", footprint != BASE, candidates[BASE].rms, "measured", best.cost, footprint, reason)


def _sh_finding(scene: Gaussians, chosen: _ChosenEffects, top_band: float, cost: float | None) -> EffectFinding:
    name, degree = "spherical harmonics", chosen.effects.sh_degree
    if scene.sh_degree == 0:
        return EffectFinding(name, False, 0.0, "bound", None, "degree 0", "its colours are the same from all sides")
    bounds = ", ".join(in_255(bound) for bound in chosen.bounds[1:])
    reason = f"seen from another side, bands 1 to {scene.sh_degree} change a colour by at most {bounds} /255"
    if degree is None:
        reason += "; the last exceeds half the tolerance, and the change is what the views lose without it"
        return EffectFinding(name, True, top_band, "measured", cost, f"degree {scene.sh_degree}", reason)
    reason += f"; left out: those above {degree}"
    return EffectFinding(name, degree > 0, sum(chosen.bounds[degree + 1 :]), "bound", cost, f"degree {degree}", reason)


def _filter_finding(chosen: _ChosenEffects, cost: float | None) -> EffectFinding:
    if not chosen.ratios:
        reason = "not examined: that needs the views of the training (--training-views)"
        return EffectFinding("3D filter", None, None, None, None, "none", reason)
    needed, change = chosen.effects.filter_3d is not None, chosen.filter_change
    reason = (
        f"in the view with most of them, {percent(max(share(ratio > FINER) for ratio in chosen.ratios))} of the "
        f"Gaussians are seen more than {FINER:g} times as large as in any view of the training"
    )
    reason += "; it changes less than a quarter of the tolerance" * (change is not None and not needed)
    kind = None if change is None else "measured"
    return EffectFinding("3D filter", needed, change, kind, cost, "filter_3d" if needed else "none", reason)


def _cull_finding(scene: Gaussians, cameras: list, shown, on_image, cost: float) -> EffectFinding:
    behind = reduce(torch.logical_and, (depths(scene.means, camera.viewmatrix) <= NEAR for camera in cameras))
    hidden, faint = ~shown & ~behind, on_image | (scene.opacities.reshape(-1) < 1 / 255)
    count, *parts = (int(which.sum()) for which in (~shown, behind, hidden & faint, hidden & ~faint))
    reason = (
        f"{count} of {len(shown)} Gaussians touch no pixel of these views: {parts[0]} behind every camera or "
        f"right before it, {parts[1]} too faint or too small, {parts[2]} beside every picture or not finite; the cost "
        "is that of rendering them too, and other views may show them"
    )
    return EffectFinding("hidden Gaussians", False, 0.0, "bound", cost, f"drop {count}", reason)


def _order_difference(scene: Gaussians, cameras: list, effects: Effects) -> OrderDifference | None:
    """How far BASE in the order of centres is from BASE along rays; None where that cannot be rendered."""
    if any(has_seam(camera) for camera in cameras):
        return None
    in_orders = [replace(effects, order=order) for order in (CENTER, RAY)]
    return OrderDifference.of([[_stages(scene, camera, BASE, e).color for e in in_orders] for camera in cameras])


def _order_finding(found: OrderDifference | None, tolerance: float, cost: float | None) -> EffectFinding:
    if found is None:
        reason = "not examined: the order along rays is for other pictures than equirectangular ones"
        return EffectFinding("order", None, None, None, None, CENTER, reason)
    needed = found.rms > tolerance
    reason = (
        f"pictures in the order of centres are {found.psnr:.1f} dB from those along rays ({BASE}), and "
        f"{percent(found.share)} of their pixels differ by more than 1/255; what differs pops when the camera moves"
    )
    advice = f"render --order {RAY}" if needed else CENTER
    return EffectFinding("order", needed, found.rms, "measured", cost, advice, reason)


def _affine_finding(scene: Gaussians, cameras: list, seen: list[torch.Tensor], names: list[str]) -> EffectFinding:
    """Whether splats are the pictures of their Gaussians: the view in which most of them are not."""
    shares = [share(bends(scene.rows(of), camera)) for camera, of in zip(cameras, seen)]
    largest = max(shares)
    needed = largest > BENT_SHARE
    view = names[shares.index(largest)]
    reason = (
        f"{percent(largest)} of the Gaussians that {view} shows are so large and near that a flat splat is a poor "
        f"picture of them (affine_error above {LIMIT}, docs/accuracy.md)"
    )
    advice = "pictures of narrower views" if needed else "as it is"
    return EffectFinding("affine picture", needed, None, None, None, advice, reason)


def _other_findings(chosen: _ChosenEffects, cost_of_outputs: float) -> tuple[EffectFinding, ...]:
    """Orthographic views, views whose axis is off centre, and outputs."""
    flat, off = chosen.effects.orthographic, sum(chosen.off_center)
    size = f"in these views far things look {'as large as near ones' if flat else 'smaller than near ones, as usual'}"
    edge = (
        f"in {off} of {len(chosen.off_center)} views the camera looks so far past the middle of the picture that an "
        f"edge is more than {FRUSTUM_CLAMP} half pictures away"
    )
    outputs = (
        "alpha, depth, other outputs, camera gradients, defocus and motion are off until you ask for them; the cost is "
        "that of alpha and depth together"
    )
    return (
        EffectFinding("orthographic", flat, None, None, None, "on" if flat else "off", size),
        EffectFinding("off-centre clamp", off > 0, None, None, None, "on" if off else "off", edge),
        EffectFinding("outputs", False, None, None, cost_of_outputs, "off", outputs),
    )


def _smaller_sigmas(splats: Splats) -> torch.Tensor:
    """(N,) smaller standard deviation of every splat, px, before the footprint."""
    xx, xy, yy = splats.cov2d.unbind(1)
    largest = (xx + yy) / 2 + torch.hypot((xx - yy) / 2, xy)  # eigenvalue
    return torch.where(largest > 0, (splats.dets / largest).sqrt(), 0)


def _view_report(scene, chosen: _ChosenEffects, i: int, name: str, camera, shown, rms: float) -> ViewReport:
    settings, gaussians = _prepare(scene, camera, BASE, chosen.effects)
    names = ("means3D", "opacities", "scales", "rotations")
    sigmas = _smaller_sigmas(project(settings, **{name: gaussians[name][shown] for name in names}))
    bins = torch.bucketize(sigmas, sigmas.new_tensor(BINS[1:-1]))
    ratio = chosen.ratios[i] if chosen.ratios else None
    return ViewReport(
        name=name,
        width=camera.image_width,
        height=camera.image_height,
        shown=len(sigmas),
        narrow=share(sigmas < NARROW),
        sigmas=tuple(torch.bincount(bins, minlength=len(BINS) - 1).tolist()),
        finer=None if ratio is None else share(ratio > FINER),
        finest=None if ratio is None or not len(ratio) else ratio.max().item(),
        rms=rms,
    )
