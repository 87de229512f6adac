"""What a scene calls for, seen from some views: bounds and measurements of what leaving an effect out would change.

`inspect_scene` reports on every effect, `plan` returns only the `Effects`. Their tolerance is the root mean square over
the pixels and channels of a view, in units of colour (0 to 1), between the recommendation and everything switched on:
REFERENCE, all bands of the harmonics, and the 3D filter where a view calls for it. REFERENCE is itself within what
docs/accuracy.md measures of the true integral.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial, reduce

import torch

from . import io, measure, report
from .effects import NEAR, Effects, depths
from .filters import apply_3d_filter, compute_3d_filter, sampling_interval
from .harmonics import needed_sh_degree, sh_band_bounds
from .lens import view_center
from .ops import TILE
from .rasterizer import (
    GaussianRasterizationSettings,
    GaussianRasterizer,
    Stages,
    _settings_arguments,
    render_stages,
)

INPUTS = ("means3D", "means2D", "opacities", "shs", "colors_precomp", "scales", "rotations", "cov3D_precomp")
REFERENCE = "box:samples=16"
BASE = "box:samples=1"
ADAPTIVE = (8, 4, 2, 1)  # tolerances to try, in that of the plan: on two trained scenes the RMS is at most a quarter
SH_SHARE = 0.5  # of the tolerance, at most, for the harmonics left out
FILTER_SHARE = 0.25  # of the tolerance: below it the 3D filter is left out
FINER = 1.1  # times as finely as in training: a view that shows so more than FINER_SHARE of what it shows calls for it
FINER_SHARE = 0.01
CLAMP = 1.3  # half pictures from the optical axis: kFrustumClamp of csrc/core/constants.h
NARROW = 0.5  # px
BINS = tuple(2.0 ** (i / 4) for i in range(-40, 41))  # edges of the histogram of standard deviations, px
TILE_SAMPLES = (1, 4, 8, 16)  # what `adaptive` chooses from
SAME = 1.05  # ratio of times up to which the candidate listed first is taken
DRAWN = 8  # views in the histogram
TIMED_VIEWS = 2
ROUNDS = {"cpu": 4, "cuda": 20}
WARM_UP = 40  # frames before timing on CUDA: the first 32 of a size wait for the device


@dataclass(frozen=True)
class Finding:
    """What was found about one effect.

    Attributes:
        name: Of the effect.
        needed: Whether these views call for it; None where that was not looked at.
        change: What leaving it out would change at most, in units of colour; None where there is nothing to leave out.
        kind: "bound": no pixel changes by more; "measured": the largest RMS over a view; None without a change.
        cost: Time of a forward pass with it over that without it, measured; None where it was not.
        recommendation: The setting.
        reason: A sentence.
    """

    name: str
    needed: bool | None
    change: float | None
    kind: str | None
    cost: float | None
    recommendation: str
    reason: str


@dataclass(frozen=True)
class Candidate:
    """A footprint that was tried with the recommended effects.

    Attributes:
        footprint: Its name with options.
        rms: Largest RMS over a view against everything switched on, in units of colour; a candidate that fails in one
            view is not rendered in the next.
        fits: Whether that is within the tolerance.
        cost: Time of a forward pass over that of BASE; None where it was not measured, as it does not fit.
    """

    footprint: str
    rms: float
    fits: bool
    cost: float | None


@dataclass(frozen=True, eq=False)
class ViewReport:
    """What one view shows.

    Attributes:
        name: Of the view.
        width, height: px.
        shown: Gaussians that touch a tile.
        narrow: Share of them whose smaller standard deviation in the image is below 1/2 px.
        sigmas: How many of them lie between BINS, by that deviation; the outer bins hold what is beyond.
        finer: Share of those seen in training too that this view samples more than 1.1 times as finely as any training
            view; None without training views.
        finest: Largest such ratio of intervals; None likewise, and where there are none.
        rms: Of the recommendation against everything switched on, in units of colour.
        tile_samples: (rows, columns) int32 on the CPU, samples that `adaptive` takes in each tile at the tolerance.
    """

    name: str
    width: int
    height: int
    shown: int
    narrow: float
    sigmas: tuple[int, ...]
    finer: float | None
    finest: float | None
    rms: float
    tile_samples: torch.Tensor

    @property
    def tile_shares(self) -> dict[int, float]:
        """Share of the tiles that needs so many samples."""
        return {samples: _share(self.tile_samples == samples) for samples in TILE_SAMPLES}


@dataclass(frozen=True, eq=False)
class SceneReport:
    """What `inspect_scene` found.

    Attributes:
        gaussians, sh_degree: Of the scene.
        tolerance: As asked for.
        machine: On which times were measured.
        effects: The recommended `Effects`.
        footprint: The recommended footprint, as `GaussianRasterizationSettings` takes it.
        findings: One per effect.
        candidates: The footprints that were tried.
        views: One `ViewReport` per view.
        shown: (P,) bool, on the scene's device: Gaussians that touch a tile of some view. The others change no pixel
            of these views.
    """

    gaussians: int
    sh_degree: int
    tolerance: float
    machine: str
    effects: Effects
    footprint: str
    findings: tuple[Finding, ...]
    candidates: tuple[Candidate, ...]
    views: tuple[ViewReport, ...]
    shown: torch.Tensor

    def to_json(self) -> dict:
        """All but the tensors, of which it gives shares and counts, as numbers, strings, lists and dicts."""
        views = []
        for view in self.views:
            fields = vars(view) | {
                "sigmas": list(view.sigmas),
                "tile_shares": {str(samples): share for samples, share in view.tile_shares.items()},
            }
            del fields["tile_samples"]
            views.append(fields)
        return {
            "gaussians": self.gaussians,
            "sh_degree": self.sh_degree,
            "tolerance": self.tolerance,
            "machine": self.machine,
            "recommendation": {
                "footprint": self.footprint,
                "sh_degree": self.effects.sh_degree,
                "filter_3d": self.effects.filter_3d is not None,
                "orthographic": self.effects.orthographic,
                "off_center": self.effects.off_center,
            },
            "findings": [asdict(finding) for finding in self.findings],
            "candidates": [asdict(candidate) for candidate in self.candidates],
            "shown": int(self.shown.sum()),
            "sigma_edges": list(BINS),
            "views": views,
        }

    def to_text(self) -> str:
        """Tables and sentences. Changes and RMS in units of 1/255."""
        found = [
            [f.name, _YES_NO[f.needed], _in_255(f.change), f.kind, _ratio(f.cost), f.recommendation]
            for f in self.findings
        ]
        tried = [[c.footprint, _in_255(c.rms), _YES_NO[c.fits], _ratio(c.cost)] for c in self.candidates]
        header = ["view", "size", "shown", "< 1/2 px", "RMS [1/255]"]
        header += [f"{n} sample{'s' * (n > 1)}" for n in TILE_SAMPLES]
        views = [
            [v.name, f"{v.width}x{v.height}", v.shown, _percent(v.narrow), _in_255(v.rms)]
            + [_percent(share) for share in v.tile_shares.values()]
            for v in self.views
        ]
        if self.views[0].finer is not None:
            header += ["finer than trained", "at most"]
            views = [[*row, _percent(v.finer), _ratio(v.finest)] for row, v in zip(views, self.views)]
        parts = [
            f"{self.gaussians} Gaussians of SH degree {self.sh_degree}; {self.machine}\n"
            f"tolerance: RMS of {_in_255(self.tolerance)}/255 in every view",
            f"recommended: footprint {self.footprint}, {_describe(self.effects)}",
            report.format_table(["effect", "needed", "change [1/255]", "", "cost", "recommendation"], found),
            "\n".join(f"{f.name}: {f.reason}" for f in self.findings),
            report.format_table(["footprint", "RMS [1/255]", "fits", "cost"], tried),
            report.format_table(header, views),
        ]
        return "\n\n".join(parts)

    def save_picture(self, path) -> None:
        """Writes a histogram of deviations in the image per view, beside a map of samples per tile of the first two.

        Raises ImportError without matplotlib, OSError where the file cannot be written, ValueError for a suffix that
        matplotlib does not know.
        """
        _draw(self).savefig(path, dpi=140)


@torch.no_grad()
def plan(
    scene: io.Scene,
    views: Sequence[io.View | GaussianRasterizationSettings],
    tolerance: float = 1 / 255,
    training_views: Sequence[io.View | GaussianRasterizationSettings] | None = None,
) -> Effects:
    """The `Effects` that these views of a scene call for: those of `inspect_scene`, without measuring footprints.

    Arguments and errors are those of `inspect_scene`.
    """
    cameras, training = _check(scene, views, tolerance, training_views)
    return _survey(scene, cameras, tolerance, training).effects


@torch.no_grad()
def inspect_scene(
    scene: io.Scene,
    views: Sequence[io.View | GaussianRasterizationSettings],
    tolerance: float = 1 / 255,
    training_views: Sequence[io.View | GaussianRasterizationSettings] | None = None,
    *,
    scale: float = 1.0,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    rounds: int | None = None,
) -> SceneReport:
    """Which effects and which footprint these views of a scene call for, what each changes, and what it costs.

    The recommendation is the cheapest of a few footprints that, with the recommended effects, stays within the
    tolerance of everything switched on in every view: REFERENCE, all bands of the harmonics, and the 3D filter where it
    is called for. That is measured in these views; of the bands left out alone it is a bound, whatever the view.
    Renders every view several times.

    Args:
        scene: P Gaussians on the device to measure on.
        views: What it will be seen from, at least one. Footprint and effects of settings are not looked at.
        tolerance: Root mean square over the pixels and channels of each view, in units of colour, not negative.
        training_views: What the scene was trained from, at their size; None: the 3D filter is not looked at.
        scale: Resolution of `io.View`s among the views, as a factor.
        background: Colour behind the scene in `io.View`s.
        rounds: Timed rounds; None: 4, of which the fastest counts, with CUDA 20, of which the median.

    Raises:
        TypeError: scene, a view or the tolerance has a wrong type.
        ValueError: No views, a tolerance that is negative or not finite, or perspective and orthographic views at once.
    """
    cameras, training = _check(scene, views, tolerance, training_views, scale, background)
    if rounds is not None and not (isinstance(rounds, int) and rounds >= 1):
        raise ValueError(f"rounds must be a positive whole number, got {rounds!r}")
    survey = _survey(scene, cameras, tolerance, training)
    names = [getattr(view, "name", f"view_{i:03d}") for i, view in enumerate(views)]
    ladder = [BASE, "box:samples=4", *(f"adaptive:tolerance={k * tolerance:.4g}" for k in ADAPTIVE), "box:samples=8"]
    rms = {footprint: [] for footprint in dict.fromkeys([*ladder, REFERENCE])}
    fits = dict.fromkeys(rms, True)
    in_views, on_image = [], torch.zeros(len(scene.means), dtype=torch.bool, device=scene.means.device)
    shown, top_band = on_image.clone(), []
    for camera in cameras:
        reference = _stages(scene, camera, REFERENCE, survey.everything)
        in_views.append(_touching(reference))
        shown |= in_views[-1]
        on_image |= reference.radii > 0
        for footprint in rms:
            if fits[footprint]:
                stages = _stages(scene, camera, footprint, survey.effects)
                rms[footprint].append(_rms(stages.color, reference.color))
                fits[footprint] = rms[footprint][-1] <= tolerance
                shown |= _touching(stages)
        if survey.effects.sh_degree is None and scene.sh_degree > 0:
            fewer = replace(survey.everything, sh_degree=scene.sh_degree - 1)
            top_band.append(_rms(_stages(scene, camera, REFERENCE, fewer).color, reference.color))

    timed = cameras[:: -(-len(cameras) // TIMED_VIEWS)]
    fitting = [name for name in rms if fits[name]]
    tried = dict.fromkeys([BASE, *fitting])
    seconds = _seconds({name: _passes(scene, timed, name, survey.effects) for name in tried}, scene, rounds)
    costs = {name: of_name / seconds[BASE] for name, of_name in seconds.items()}
    cheapest = min(costs[name] for name in fitting)
    footprint = next(name for name in fitting if costs[name] <= SAME * cheapest)
    candidates = tuple(Candidate(name, max(rms[name]), fits[name], costs.get(name)) for name in rms)
    effect_costs = _effect_costs(scene, timed, footprint, survey, shown, rounds)

    reports = tuple(
        _view_report(scene, survey, i, name, camera, in_views[i], rms[footprint][i], tolerance)
        for i, (name, camera) in enumerate(zip(names, cameras))
    )
    findings = (
        _footprint_finding(candidates, footprint, reports),
        _sh_finding(scene, survey, top_band, effect_costs.get("sh")),
        _filter_finding(survey, effect_costs.get("filter_3d")),
        _cull_finding(scene, cameras, shown, on_image, effect_costs["culls"]),
        *_camera_findings(survey),
        _output_finding(effect_costs["outputs"]),
    )
    return SceneReport(
        gaussians=len(scene.means),
        sh_degree=scene.sh_degree,
        tolerance=tolerance,
        machine=measure.describe_machine(scene.means.device.type),
        effects=survey.effects,
        footprint=footprint,
        findings=findings,
        candidates=candidates,
        views=reports,
        shown=shown,
    )


# ------------------------------------------------------------------------- what is called for


@dataclass(frozen=True, eq=False)
class _Survey:
    """The choice of effects, and what it rests on.

    Attributes:
        effects: Recommended.
        everything: All that the tolerance counts from.
        bounds: Of `sh_band_bounds`.
        ratios: Per view, training interval over the view's, of the Gaussians that both see; empty without training.
        filter_change: Largest RMS of the 3D filter over the views; None where no view calls for it.
        orthographic: Whether the views are.
        off_center: Which views are.
    """

    effects: Effects
    everything: Effects
    bounds: list[float]
    ratios: list[torch.Tensor]
    filter_change: float | None
    orthographic: bool
    off_center: list[bool]


def _check(scene, views, tolerance, training_views, *options):
    """(settings of the views, those of training or None). `options`: scale and background of `io.View.settings`."""
    if not isinstance(scene, io.Scene):
        raise TypeError(f"scene must be an io.Scene, got {type(scene).__name__}")
    if isinstance(tolerance, bool) or not isinstance(tolerance, (int, float)):
        raise TypeError(f"tolerance must be a number, got {tolerance!r}")
    if not 0 <= tolerance < math.inf:
        raise ValueError(f"tolerance must be finite and not negative, got {tolerance}")
    cameras = _cameras("views", views, scene, *options)
    return cameras, None if training_views is None else _cameras("training_views", training_views, scene)


def _cameras(what: str, views, scene: io.Scene, *options) -> list[GaussianRasterizationSettings]:
    if not isinstance(views, Sequence):
        raise TypeError(f"{what} must be a list of views, got {type(views).__name__}")
    for view in views:
        if not isinstance(view, (io.View, GaussianRasterizationSettings)):
            raise TypeError(f"{what} must hold io.View or GaussianRasterizationSettings, got {type(view).__name__}")
    if not views:
        raise ValueError(f"{what} must hold at least one view, got none")
    device = scene.means.device
    return [view.settings(*options, device=device) if isinstance(view, io.View) else view for view in views]


def _survey(scene: io.Scene, cameras: list, tolerance: float, training: list | None) -> _Survey:
    orthographic = [_is_orthographic(camera) for camera in cameras]
    if any(orthographic) != all(orthographic):
        raise ValueError(
            f"views must be all perspective or all orthographic, got {sum(orthographic)} of {len(cameras)} orthographic"
        )
    off_center = [not flat and _is_off_center(camera) for flat, camera in zip(orthographic, cameras)]
    everything = Effects(orthographic=all(orthographic), off_center=any(off_center))
    ratios, filter_change = [], None
    if training is not None:
        finest = reduce(torch.minimum, (sampling_interval(scene.means, camera) for camera in training))
        ratios = [_ratios(finest, sampling_interval(scene.means, camera)) for camera in cameras]
        if any(_share(ratio > FINER) > FINER_SHARE for ratio in ratios):
            filtered = replace(everything, filter_3d=compute_3d_filter(scene.means, training))
            filter_change = max(
                _rms(*(_stages(scene, camera, REFERENCE, effects).color for effects in (everything, filtered)))
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
    return _Survey(effects, everything, sh_band_bounds(shs), ratios, filter_change, all(orthographic), off_center)


def _ratios(finest: torch.Tensor, interval: torch.Tensor) -> torch.Tensor:
    """The ratios of intervals, where both are finite."""
    return (finest / interval)[finest.isfinite() & interval.isfinite()]


def _is_orthographic(camera: GaussianRasterizationSettings) -> bool:
    """Whether w of clip space is the same everywhere."""
    w = camera.projmatrix.detach().reshape(4, 4)[:, 3]
    return (w[:3].abs().max() <= 1e-6 * w[3].abs()).item()


def _is_off_center(camera: GaussianRasterizationSettings) -> bool:
    """Whether an edge of the picture is more than CLAMP half pictures away from the optical axis."""
    center = view_center(camera.viewmatrix.double(), camera.projmatrix.double(), with_gradient=False)
    tangents = center.new_tensor([float(camera.tanfovx), float(camera.tanfovy)])
    return (1 + (center / tangents).abs().max() > CLAMP + 1e-6).item()


# ------------------------------------------------------------------------------------- rendering


def _prepare(scene: io.Scene, cameras: list, footprint: str, effects: Effects) -> tuple[list, dict]:
    """Settings for every camera, and Gaussians that have been through the 3D filter, for these effects."""
    gaussians = scene.arguments()
    if effects.filter_3d is not None:
        filtered = apply_3d_filter(scene.scales, scene.opacities, effects.filter_3d)
        gaussians["scales"], gaussians["opacities"] = filtered
    options = {"sh_degree": scene.sh_degree, "effects": replace(effects, filter_3d=None)}
    return [camera._replace(footprint=footprint, **options) for camera in cameras], gaussians


def _stages(scene: io.Scene, camera, footprint: str, effects: Effects) -> Stages:
    (settings,), gaussians = _prepare(scene, [camera], footprint, effects)
    return render_stages(settings, **gaussians)


def _touching(stages: Stages) -> torch.Tensor:
    """(P,) bool: which Gaussians are in the list of a tile."""
    touching = torch.zeros(len(stages.radii), dtype=torch.bool, device=stages.radii.device)
    touching[stages.ids[stages.pairs.long()].long()] = True
    return touching


def _rms(color: torch.Tensor, reference: torch.Tensor) -> float:
    return (color.double() - reference).square().mean().sqrt().item()


@torch.no_grad()
def tile_samples(settings: GaussianRasterizationSettings, gaussians: dict[str, torch.Tensor]) -> torch.Tensor:
    """(rows, columns) int32 on the CPU: the samples that `adaptive`, the footprint of `settings`, takes in every tile.

    `gaussians` are the keywords of `GaussianRasterizer.forward`.
    """
    inputs = [gaussians.get(name) for name in INPUTS]
    options = _settings_arguments(settings, gaussians["means3D"], gaussians.get("shs"))
    chosen = torch.ops.analytic_rasterizer.rasterize(*inputs, *options, False, False, False)[-2]
    return chosen.reshape(-(-settings.image_height // TILE), -1).cpu()


# --------------------------------------------------------------------------------------- costs


def _passes(scene: io.Scene, cameras: list, footprint: str, effects: Effects) -> list[Callable[[], object]]:
    """A forward pass for every camera."""
    each, gaussians = _prepare(scene, cameras, footprint, effects)
    return [partial(GaussianRasterizer(settings), means2D=None, **gaussians) for settings in each]


def _seconds(passes: dict[str, list[Callable]], scene: io.Scene, rounds: int | None) -> dict[str, float]:
    """Seconds over all cameras. On the CPU in turn, of the fastest round each: what else the machine does only ever
    adds. On CUDA, where the room for pairs follows the frames before, each by itself, of the median round."""
    device = scene.means.device.type
    rounds = rounds or ROUNDS[device]
    if device == "cuda":
        for call in (call for calls in passes.values() for call in calls):
            for _ in range(WARM_UP):
                call()
        median = partial(measure.median_seconds, measure.event_seconds, rounds=rounds)
        return {name: sum(map(median, calls)) for name, calls in passes.items()}

    def clock(call):
        start = time.perf_counter()
        call()
        return {"seconds": time.perf_counter() - start}

    samples = measure.in_turn(passes, clock, range(1, rounds + 1))
    return {name: sum(min(s["seconds"] for s in taken) for taken in of) for name, of in samples.items()}


def _effect_costs(scene, cameras, footprint, survey: _Survey, shown, rounds) -> dict[str, float]:
    """Time with an effect over that without, by effect."""
    effects = survey.effects
    only_shown = io.Scene(*(field[shown] for field in scene[:-1]), scene.sh_degree)
    masked = effects if effects.filter_3d is None else replace(effects, filter_3d=effects.filter_3d[shown])
    passes = {
        "plain": _passes(scene, cameras, footprint, effects),
        "shown": _passes(only_shown, cameras, footprint, masked),
        "outputs": _passes(scene, cameras, footprint, replace(effects, alpha=True, depth=True)),
    }
    if scene.sh_degree > 0:
        passes["bands"] = _passes(scene, cameras, footprint, replace(effects, sh_degree=None))
        passes["no bands"] = _passes(scene, cameras, footprint, replace(effects, sh_degree=0))
    if effects.filter_3d is not None:
        passes["no filter"] = _passes(scene, cameras, footprint, replace(effects, filter_3d=None))
    seconds = _seconds(passes, scene, rounds)
    pairs = {
        "culls": ("plain", "shown"),
        "outputs": ("outputs", "plain"),
        "sh": ("bands", "no bands"),
        "filter_3d": ("plain", "no filter"),
    }
    return {name: seconds[a] / seconds[b] for name, (a, b) in pairs.items() if a in seconds and b in seconds}


# ------------------------------------------------------------------------------------- findings


def _footprint_finding(candidates: tuple[Candidate, ...], footprint: str, views: tuple[ViewReport, ...]) -> Finding:
    base = next(c for c in candidates if c.footprint == BASE)
    chosen = next(c for c in candidates if c.footprint == footprint)
    narrow = sum(v.narrow * v.shown for v in views) / max(1, sum(v.shown for v in views))
    tiles = torch.cat([v.tile_samples.flatten() for v in views])
    shares = ", ".join(f"{n} for {_percent(_share(tiles == n))}" for n in TILE_SAMPLES)
    reason = (
        f"{_percent(narrow)} of the splats have a deviation below {NARROW:g} px; samples that tiles need: {shares}; "
        f"{footprint} is within {_in_255(chosen.rms)}/255 of everything on"
    )
    return Finding("footprint", footprint != BASE, base.rms, "measured", chosen.cost, footprint, reason)


def _sh_finding(scene: io.Scene, survey: _Survey, top_band: list, cost: float | None) -> Finding:
    name, degree = "spherical harmonics", survey.effects.sh_degree
    bounds = ", ".join(_in_255(bound) for bound in survey.bounds[1:])
    if scene.sh_degree == 0:
        return Finding(name, False, 0.0, "bound", None, "degree 0", "the scene has none beyond degree 0")
    if degree is None:
        reason = (
            f"bands 1 to {scene.sh_degree} add at most {bounds} /255 to a colour, the last of them more than half the "
            "tolerance; the change is that of leaving it out"
        )
        return Finding(name, True, max(top_band), "measured", cost, f"degree {scene.sh_degree}", reason)
    left_out = sum(survey.bounds[degree + 1 :])
    reason = f"bands 1 to {scene.sh_degree} add at most {bounds} /255 to a colour; left out: those above {degree}"
    return Finding(name, degree > 0, left_out, "bound", cost, f"degree {degree}", reason)


def _filter_finding(survey: _Survey, cost: float | None) -> Finding:
    name = "3D filter"
    if not survey.ratios:
        return Finding(name, None, None, None, None, "none", "not looked at: no training views were given")
    needed, change = survey.effects.filter_3d is not None, survey.filter_change
    share = max(_share(ratio > FINER) for ratio in survey.ratios)
    reason = (
        f"in the view with most of them, {_percent(share)} of the Gaussians are sampled more than {FINER:g} times as "
        "finely as in any training view"
    )
    if change is not None and not needed:
        reason += "; it changes less than a quarter of the tolerance"
    kind = None if change is None else "measured"
    return Finding(name, needed, change, kind, cost, "filter_3d" if needed else "none", reason)


def _cull_finding(scene: io.Scene, cameras: list, shown, on_image, cost: float) -> Finding:
    behind = torch.ones_like(shown)
    for camera in cameras:
        behind &= depths(scene.means, camera.viewmatrix) <= NEAR
    hidden, faint = ~shown & ~behind, on_image | (scene.opacities.reshape(-1) < 1 / 255)
    count, *parts = (int(which.sum()) for which in (~shown, behind, hidden & faint, hidden & ~faint))
    reason = (
        f"{count} of {len(shown)} Gaussians touch no pixel of these views: {parts[0]} behind the near plane of every "
        f"view, {parts[1]} too faint or too small, {parts[2]} beside every picture or not finite; `shown` is the mask "
        "of the others, the cost that of keeping all"
    )
    return Finding("hidden Gaussians", False, 0.0, "bound", cost, f"drop {count}", reason)


def _camera_findings(survey: _Survey) -> tuple[Finding, Finding]:
    flat, off = survey.orthographic, sum(survey.off_center)
    reason = f"w of clip space {'does not depend' if flat else 'depends'} on the position"
    crop = (
        f"in {off} of {len(survey.off_center)} views an edge of the picture is more than {CLAMP} half pictures away "
        "from the optical axis"
    )
    return (
        Finding("orthographic", flat, None, None, None, "on" if flat else "off", reason),
        Finding("off-centre clamp", off > 0, None, None, None, "on" if off else "off", crop),
    )


def _output_finding(cost: float) -> Finding:
    reason = (
        "no scene calls for alpha, depth, other outputs, camera gradients, defocus or motion: off until asked for; the "
        "cost is that of alpha and depth together"
    )
    return Finding("outputs", False, None, None, cost, "off", reason)


def _view_report(scene, survey: _Survey, i: int, name: str, camera, shown, rms: float, tolerance: float) -> ViewReport:
    (settings,), gaussians = _prepare(scene, [camera], f"adaptive:tolerance={tolerance}", survey.effects)
    sigmas = _projected_sigmas(settings, {key: value[shown] for key, value in gaussians.items()}, survey.orthographic)
    edges = torch.tensor(BINS[1:-1], dtype=sigmas.dtype, device=sigmas.device)
    counts = torch.bincount(torch.bucketize(sigmas, edges), minlength=len(BINS) - 1)
    ratio = survey.ratios[i] if survey.ratios else None
    return ViewReport(
        name=name,
        width=camera.image_width,
        height=camera.image_height,
        shown=len(sigmas),
        narrow=_share(sigmas < NARROW),
        sigmas=tuple(counts.tolist()),
        finer=None if ratio is None else _share(ratio > FINER),
        finest=None if ratio is None or not len(ratio) else ratio.max().item(),
        rms=rms,
        tile_samples=tile_samples(settings, gaussians),
    )


def _projected_sigmas(camera: GaussianRasterizationSettings, gaussians: dict, orthographic: bool) -> torch.Tensor:
    """(P,) smaller standard deviation in the image, px, before the footprint [EWA, Eq. 29-31]."""
    view = camera.viewmatrix.detach().reshape(4, 4)
    x, y, z = (gaussians["means3D"] @ view[:3, :3] + view[3, :3]).unbind(1)
    depth, side = (torch.ones_like(z), 0) if orthographic else (z, CLAMP)
    w, i, j, k = torch.nn.functional.normalize(gaussians["rotations"], dim=1).unbind(1)
    # Columns of the rotation.
    axes = (
        (1 - 2 * (j * j + k * k), 2 * (i * j + w * k), 2 * (i * k - w * j)),
        (2 * (i * j - w * k), 1 - 2 * (i * i + k * k), 2 * (j * k + w * i)),
        (2 * (i * k + w * j), 2 * (j * k - w * i), 1 - 2 * (i * i + j * j)),
    )
    axes = torch.stack([torch.stack(axis, 1) for axis in axes], 1) * gaussians["scales"][:, :, None]
    turned = camera.scale_modifier * axes @ view[:3, :3]  # (P, 3 axes, 3), camera space
    rows = []
    for a, b, tan, size in ((0, x, camera.tanfovx, camera.image_width), (1, y, camera.tanfovy, camera.image_height)):
        slope = (b / z).clamp(-side * tan, side * tan)[:, None]
        rows.append(size / (2 * tan) * (turned[:, :, a] - slope * turned[:, :, 2]) / depth[:, None])
    xx, xy, yy = (rows[0] ** 2).sum(1), (rows[0] * rows[1]).sum(1), (rows[1] ** 2).sum(1)
    largest = (xx + yy) / 2 + torch.hypot((xx - yy) / 2, xy)
    area = torch.linalg.cross(rows[0], rows[1]).norm(dim=1)
    return torch.where(largest > 0, area / largest.sqrt(), 0)


# ----------------------------------------------------------------------------------- in words

_YES_NO = {True: "yes", False: "no", None: None}


def _describe(effects: Effects) -> str:
    options = [f"sh_degree={effects.sh_degree}"] if effects.sh_degree is not None else []
    options += [f"{name}=True" for name in ("orthographic", "off_center") if getattr(effects, name)]
    options += ["filter_3d=..."] if effects.filter_3d is not None else []
    return f"Effects({', '.join(options)})"


def _ratio(value: float | None) -> str | None:
    return None if value is None else f"{value:.2f}"


def _in_255(value: float | None) -> str | None:
    return None if value is None else f"{255 * value:.3g}"


def _percent(share: float | None) -> str | None:
    return None if share is None else f"{100 * share:.1f}%"


def _share(which: torch.Tensor) -> float:
    return which.sum().item() / max(1, which.numel())


def _draw(found: SceneReport):
    """Histogram of deviations, and maps of samples per tile of the first two views."""
    colors = [report.BOX_COLORS[samples] for samples in TILE_SAMPLES]
    matplotlib_colors = io.optional_import("matplotlib.colors", "analysis")
    maps = found.views[:2]
    figure, axes = report.new_figure(5 + 5 * len(maps), 3.8, 1 + len(maps))
    ax = axes[0, 0]
    occupied = [BINS.index(NARROW)]
    for view in found.views[:DRAWN]:
        ax.stairs([100 * count / max(1, view.shown) for count in view.sigmas], BINS, label=view.name, linewidth=1.4)
        occupied += [i for i, count in enumerate(view.sigmas) if count > 1e-3 * view.shown]
    ax.axvline(NARROW, color="black", linewidth=0.9, linestyle=":")
    ax.set_xscale("log", base=2)
    ax.set_xlim(BINS[min(occupied)], BINS[max(occupied) + 1])
    ax.xaxis.set_major_formatter(lambda value, _: f"{value:g}" if value >= 1 else f"1/{1 / value:g}")
    ax.set_xlabel("smaller standard deviation in the image [px]")
    ax.set_ylabel("Gaussians shown [%]")
    ax.legend(frameon=False, fontsize=8)
    for ax, view in zip(axes[0, 1:], maps):
        rows, columns = view.tile_samples.shape
        ax.imshow(
            torch.bucketize(view.tile_samples, torch.tensor(TILE_SAMPLES)).numpy(),
            cmap=matplotlib_colors.ListedColormap(colors),
            norm=matplotlib_colors.BoundaryNorm([-0.5, 0.5, 1.5, 2.5, 3.5], len(colors)),
            extent=(0, TILE * columns, TILE * rows, 0),
            interpolation="nearest",
        )
        ax.set_xlabel("px")
        ax.set_xlim(0, view.width)
        ax.set_ylim(view.height, 0)
        ax.grid(False)
        ax.set_title(f"{view.name}: samples per tile", fontsize=10)
        for samples, color in zip(TILE_SAMPLES, colors):
            ax.plot([], [], "s", color=color, label=f"{samples}: {_percent(view.tile_shares[samples])}")
        ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.2), ncols=4, frameon=False, fontsize=8)
    return figure
