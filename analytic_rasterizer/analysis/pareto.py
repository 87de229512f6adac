"""Accuracy against time: every footprint on a trained scene, compared with the integral over the pixel.

`run()` renders a scene at several scales with every method, measures how far each picture is from the box integral of
the image and what it costs, and writes a table, plots with the Pareto front, and JSON. A *method* is a footprint, or a
footprint in a picture rendered n times larger and averaged ("@n").
"""

from __future__ import annotations

import json
import math
import statistics
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import torch

from ..cameras.camera import View
from ..footprints import (
    DILATED,
    EXACT,
    FASTEST,
    SIXTEEN_SAMPLES,
    UNFILTERED,
    footprint_variants,
    resolve_footprint,
)
from ..gaussians import Gaussians
from ..io import optional_import, write_text
from ..render.order import RAY
from ..render.seam import has_seam
from . import tables, timing
from .orders import OrderDifference
from .reference import RMSE_SHARE, Refined, finite_decibels, image_errors, refine, supersampled

BASE = FASTEST  # times on the CPU are ratios to this
SECOND_ESTIMATE = SIXTEEN_SAMPLES  # another way to the reference's limit
MAX_FILTERED_PIXELS = 2**25  # of a picture of SECOND_ESTIMATE, which is rendered in one piece
SUPERSAMPLING = (2, 3, 4)
SSIM_WINDOW = 11  # px; smaller pictures have no SSIM
PASSES = {"forward": "forward", "forward_backward": "forward + backward"}


@dataclass(frozen=True)
class Method:
    """A way to render: a footprint, in a picture `supersampling` times larger that is averaged."""

    footprint: str
    supersampling: int = 1

    @property
    def name(self) -> str:
        return self.footprint + (f"@{self.supersampling}" if self.supersampling > 1 else "")

    @property
    def has_single_weight(self) -> bool:
        """Whether every splat has one weight per pixel, so that the best such method is `exact`."""
        spec = resolve_footprint(self.footprint)
        return self.supersampling == 1 and spec.samples == 1


def parse_method(text: str) -> Method:
    """The method of "NAME[:k=v,..][@N]". Raises ValueError for a bad footprint or N."""
    footprint, at, factor = text.partition("@")
    resolve_footprint(footprint)
    if at and not (factor.isdecimal() and int(factor) >= 1):
        raise ValueError(f"supersampling must be a positive whole number, got {factor!r} in {text!r}")
    return Method(footprint, int(factor) if at else 1)


def default_methods() -> list[Method]:
    """Every footprint with every number of samples, and supersampled `point`, which is 3DGS-SS."""
    supersampled_points = [Method(point, n) for point in (DILATED, UNFILTERED) for n in SUPERSAMPLING]
    return [Method(name) for name in footprint_variants()] + supersampled_points


def check_given(views: list[View], scales, methods: list[Method] | None = None) -> None:
    """Raises what `run` raises for its arguments, before anything is measured."""
    methods = default_methods() if methods is None else methods
    names, view_names = [method.name for method in methods], [view.name for view in views]
    for what, given in (("views", view_names), ("methods", names), ("scales", list(scales))):
        if not given or len(set(given)) < len(given):
            raise ValueError(f"{what} must be given, and each once, got {', '.join(map(str, given)) or 'none'}")
    for module in ("matplotlib.figure", "torchmetrics.functional.image"):
        optional_import(module, "analysis")


def run(
    out,
    scene: Gaussians,
    views: list[View],
    scales=(1, 2, 4, 8),
    methods: list[Method] | None = None,
    *,
    crop: tuple[int, int] | None = None,
    background=(0.0, 0.0, 0.0),
    rounds: int | None = None,
    max_density: int | None = None,
    cpu_time: bool = False,
    name: str = "scene",
) -> dict:
    """Measures every method at every scale and writes `out`/pareto.json, pareto.md and pareto_SCALE.png, .svg.

    Args:
        out: Folder, which must exist.
        scene: On the device to measure.
        views: At least one.
        scales: Reductions: 8 is 1/8 of the views' size. See `View.framed`.
        methods: None is `default_methods()`.
        crop: (width, height) px, at every scale.
        background: RGB.
        rounds: Timed rounds after one that warms up; None is `timing.ROUNDS` of the device.
        max_density: Of the reference, see `refine`.
        cpu_time: On the CPU count the seconds of computation of all threads together instead of those that went by:
            with one thread, on a machine that is used for other work too.
        name: Of the scene, for the titles.

    Returns:
        What pareto.json holds. Errors are over all channels of all pixels of all views.

    Raises:
        ValueError: No views, methods or scales, or one of them twice.
        ImportError: Without the `analysis` extra.
    """
    methods = default_methods() if methods is None else methods
    check_given(views, scales, methods)
    names, view_names = [method.name for method in methods], [view.name for view in views]
    out, device = Path(out), scene.means.device.type
    results = {
        "scene": name,
        "gaussians": len(scene.means),
        "sh_degree": scene.sh_degree,
        "views": view_names,
        "background": list(background),
        "crop": None if crop is None else list(crop),
        "device": device,
        "machine": timing.describe_machine(device),
        "rounds": rounds or timing.ROUNDS[device],
        "clock": "CUDA events" if device == "cuda" else "CPU time" if cpu_time else "wall",
        "base": BASE if BASE in names else names[0],
        "scales": [],
    }
    for scale in scales:
        framed = [view.framed(scale, crop) for view in views]
        sizes = [[view.width, view.height] for view in framed]
        at_scale = {"scale": scale, "sizes": sizes, **_measure(scene, framed, methods, results, max_density)}
        results["scales"].append(at_scale)
        tables.save_figure(_plot(results, at_scale), out, f"pareto_{scale}")
        # After every scale, so that a long run that is stopped leaves what it has.
        write_text(out / "pareto.json", json.dumps(results, indent=1) + "\n")
        write_text(out / "pareto.md", to_markdown(results))
    return results


def _measure(
    scene: Gaussians, views: list[View], methods: list[Method], results: dict, max_density: int | None
) -> dict:
    """Reference and methods at one scale; `results` are those of `run`. A picture is known by the name of its view."""
    background = results["background"]
    names = [view.name for view in views]

    def cases_of(method: Method) -> list[timing.Case]:
        return [timing.Case(scene, view, method.footprint, method.supersampling, background) for view in views]

    def sample(density: int, footprint: str = UNFILTERED) -> dict[str, torch.Tensor]:
        return {view.name: supersampled(scene, view, density, footprint, background) for view in views}

    cases = {method.name: cases_of(method) for method in methods}
    rendered = dict(cases)
    if any(method.has_single_weight for method in methods):
        rendered.setdefault(EXACT, cases_of(Method(EXACT)))
    with optional_import("tqdm").tqdm(rendered.items(), desc="render", unit="method", disable=None) as progress:
        pictures = {name: dict(zip(names, (case.forward() for case in of_name))) for name, of_name in progress}

    def smallest_error(truth: dict[str, torch.Tensor]) -> dict[str, float]:
        return {key: min(image_errors(pictures[name][key], truth[key])["rmse"] for name in cases) for key in names}

    refined = refine(sample, smallest_error, limit=max_density)
    truth = refined.pictures
    reference = _describe_reference(refined, sample)
    clock = time.process_time if results["clock"] == "CPU time" else time.perf_counter
    times = _times(cases, results["rounds"], results["base"], clock)
    all_truth, rows = _flat(truth), []
    for method in methods:
        of_name = pictures[method.name]
        errors = image_errors(_flat(of_name), all_truth)
        memory = [case.extra_bytes() for case in cases[method.name]]
        ssim = [_ssim(of_name[key], truth[key]) for key in names]
        row = {
            "method": method.name,
            "footprint": str(resolve_footprint(method.footprint)),
            "supersampling": method.supersampling,
            **errors,
            "ssim": None if None in ssim else statistics.mean(ssim),
            **times[method.name],
            "extra_bytes": statistics.mean(memory) if min(memory) > 0 else None,  # not every system tells
            **dict.fromkeys(("weight_rmse", "blending_rmse", "correlation")),
            "per_view": {key: image_errors(of_name[key], truth[key]) for key in names},
            "resolved": reference["residual"]["rmse"] <= RMSE_SHARE * errors["rmse"],
        }
        if method.has_single_weight:
            row |= _split(_flat(of_name), _flat(pictures[EXACT]), all_truth)
        rows.append(row)
    for passes in PASSES:
        front = pareto_front([(row[f"{passes}_ratio"], row["rmse"]) for row in rows])
        for row, on_front in zip(rows, front):
            row[f"{passes}_front"] = on_front
    return {"reference": reference, "methods": rows, "order": _order_difference(scene, views, background)}


def _order_difference(scene: Gaussians, views: list[View], background) -> dict | None:
    """How far pictures of BASE in the order of centres, which all methods and the reference have, are from those along
    rays (`OrderDifference`); None where these cannot be rendered."""
    centers = [timing.Case(scene, view, BASE, 1, background) for view in views]
    if any(has_seam(case.settings) for case in centers):
        return None
    rays = [timing.Case(scene, view, BASE, 1, background, RAY) for view in views]
    return asdict(OrderDifference.of([[case.forward() for case in pair] for pair in zip(centers, rays)]))


def _describe_reference(refined: Refined, sample: Callable[..., dict]) -> dict:
    """How the reference was made, and three estimates of its own error, over all views.

    residual: change from half the density, which bounds the error where every doubling at least halves it.
    expected_rmse: the error that follows from the order of convergence over the last two doublings (Richardson), where
    that is positive. second_estimate: distance from another sampler with the same limit.
    """
    density, truth = refined.density, refined.pictures
    all_truth = _flat(truth)
    pixels = {key: picture[0].numel() for key, picture in truth.items()}
    pooled = {}
    for n, by_view in refined.residuals.items():
        pooled[str(n)] = math.sqrt(sum(pixels[key] * by_view[key] ** 2 for key in truth) / sum(pixels.values()))
    before, last = pooled.get(str(density // 2)), pooled[str(density)]
    order = math.log2(before / last) if before and last else None
    # A sample of the second estimate is a square of 1/16 of its pixel: a quarter of the density suffices.
    second = max(1, min(density // 4, math.isqrt(MAX_FILTERED_PIXELS // max(pixels.values()))))
    distance = image_errors(_flat(sample(second, SECOND_ESTIMATE)), all_truth)["rmse"]
    return {
        "footprint": UNFILTERED,
        "density": density,
        "samples_per_pixel": density**2,
        "residual": image_errors(_flat(refined.half), all_truth),
        "residual_rmse": pooled,
        "order": order,
        "expected_rmse": last / (2**order - 1) if order is not None and order > 0 else None,
        "second_estimate": {"footprint": SECOND_ESTIMATE, "density": second, "rmse": distance},
        "resolves_rmse_from": last / RMSE_SHARE,
    }


def _split(picture: torch.Tensor, exact: torch.Tensor, truth: torch.Tensor) -> dict[str, float]:
    """Splits the error of a footprint with one weight per splat into that of its weight and that of blending:
    rmse^2 = weight_rmse^2 + blending_rmse^2 + 2 correlation weight_rmse blending_rmse."""
    weight, blending = picture.double() - exact, exact - truth
    weight_rmse, blending_rmse = (part.square().mean().sqrt().item() for part in (weight, blending))
    scale = weight_rmse * blending_rmse
    correlation = (weight * blending).mean().item() / scale if scale else 0.0
    return {"weight_rmse": weight_rmse, "blending_rmse": blending_rmse, "correlation": correlation}


def _times(cases: dict[str, list[timing.Case]], rounds: int, base: str, clock=time.perf_counter) -> dict[str, dict]:
    """Seconds per view of both passes, and their ratio to the base, of the round that counts (`timing.best_of`).

    `_usual` is the median round, which tells how much other work adds.
    """
    device = next(iter(cases.values()))[0].dL_dcolor.device.type
    calls = {name: [getattr(case, passes) for passes in PASSES for case in of] for name, of in cases.items()}
    with optional_import("tqdm").tqdm(desc="time", unit="call", disable=None) as bar:
        samples = timing.time_calls(calls, device, rounds, clock, base, bar.update)
    times = {name: {} for name in [base, *cases]}  # the base first: the others are divided by it
    for name, of_name in times.items():
        views = len(cases[name])
        for passes, taken in zip(PASSES, (samples[name][:views], samples[name][views:])):
            of_name[f"{passes}_seconds"] = statistics.mean(timing.best_of(of_view, device) for of_view in taken)
            of_name[f"{passes}_usual_seconds"] = statistics.mean(map(statistics.median, taken))
            for kind in (passes, f"{passes}_usual"):
                of_name[f"{kind}_ratio"] = of_name[f"{kind}_seconds"] / times[base][f"{passes}_seconds"]
    return times


def pareto_front(points: list[tuple[float, float]]) -> list[bool]:
    """Which (cost, error) no other point beats: none is as good in both and better in one."""
    return [not any(o != p and o[0] <= p[0] and o[1] <= p[1] for o in points) for p in points]


def _ssim(color: torch.Tensor, truth: torch.Tensor) -> float | None:
    """Structural similarity with a Gaussian window of 1.5 px, the border mirrored, for colours in 0 to 1."""
    if min(color.shape[1:]) < SSIM_WINDOW:
        return None
    ssim = optional_import("torchmetrics.functional.image", "analysis").structural_similarity_index_measure
    return ssim(color[None].double(), truth[None], data_range=1.0).item()


def _flat(pictures: dict[str, torch.Tensor]) -> torch.Tensor:
    """All values of the pictures of all views."""
    return torch.cat([picture.flatten() for picture in pictures.values()])


def to_table(results: dict, at_scale: dict) -> tuple[list[str], list[list]]:
    """(header, rows) of one scale. Times are ratios on the CPU, milliseconds on CUDA."""
    _, time_key, factor = _time_unit(results)
    unit = "ms" if time_key == "seconds" else time_key
    columns = [  # header, key of a row, format, factor
        ("RMSE", "rmse", ".2e", 1),
        ("bias", "bias", ".2e", 1),
        ("99.9%", "p999", ".2e", 1),
        ("max", "max", ".2e", 1),
        ("SSIM", "ssim", ".5f", 1),
        (f"forward [{unit}]", f"forward_{time_key}", ".2f", factor),
        (f"with backward [{unit}]", f"forward_backward_{time_key}", ".2f", factor),
        ("memory [MiB]", "extra_bytes", ".0f", 2**-20),
        ("weight RMSE", "weight_rmse", ".2e", 1),
        ("blending RMSE", "blending_rmse", ".2e", 1),
    ]
    rows = []
    for row in at_scale["methods"]:
        cells = [None if row[key] is None else f"{row[key] * by:{digits}}" for _, key, digits, by in columns]
        psnr = ("" if row["resolved"] else "~") + f"{row['psnr']:.2f}"
        front = "F" * row["forward_front"] + "B" * row["forward_backward_front"]
        rows.append([row["method"], psnr, *cells, front or None])
    return ["method", "PSNR [dB]", *(header for header, *_ in columns), "front"], rows


def _time_unit(results: dict) -> tuple[str, str, float]:
    """How times are shown: the unit, the key of a row, and a factor."""
    return ("ms", "seconds", 1e3) if results["device"] == "cuda" else (f"times {results['base']}", "ratio", 1)


def describe(results: dict, at_scale: dict) -> list[str]:
    """What the numbers of one scale are based on, in lines."""
    reference, base = at_scale["reference"], results["base"]
    lines = [f"scale {_scale_and_sizes(at_scale)}"]
    if results["device"] != "cuda":
        row = next(row for row in at_scale["methods"] if row["method"] == base)
        seconds = " / ".join(f"{1e3 * row[f'{passes}_seconds']:.1f}" for passes in PASSES)
        clock = " of CPU time" if results["clock"] == "CPU time" else ""
        rounds = f"the fastest of {results['rounds']} rounds in turn, and of more where these do not agree"
        lines.append(f"times are ratios to {base}, {seconds} ms{clock}; {rounds}")
    density, second, change = reference["density"], reference["second_estimate"], reference["residual"]
    order = "" if reference["order"] is None else f" (order {reference['order']:.1f})"
    lines.append(
        f"reference: {density}x{density} unfiltered samples per pixel; from half that density it changes by RMSE "
        f"{change['rmse']:.1e}{order}, bias {change['bias']:.0e}, at most {change['max']:.1e}; "
        f"from {second['footprint']} at {second['density']}x{second['density']} it differs by RMSE {second['rmse']:.1e}"
    )
    if at_scale["order"] is not None:
        psnr, share = (at_scale["order"][key] for key in ("psnr", "share"))
        lines.append(
            f"pictures along rays (render --order {RAY}) are {psnr:.1f} dB from these, in the order of centres; "
            f"{100 * share:.1f}% of their pixels differ by more than 1/255"
        )
    unresolved = [row["method"] for row in at_scale["methods"] if not row["resolved"]]
    if unresolved:
        lines.append(
            f"~ not converged: the reference resolves RMSE from {reference['resolves_rmse_from']:.1e}; below it, and "
            f"uncertain: {', '.join(unresolved)}"
        )
    return lines


def _scale_and_sizes(at_scale: dict) -> str:
    count = len(at_scale["sizes"])
    sizes = ", ".join(sorted({f"{w} x {h}" for w, h in at_scale["sizes"]}))
    return f"1/{at_scale['scale']}, {count} view{'s' * (count > 1)} of {sizes}"


def to_markdown(results: dict) -> str:
    """All tables of the results of `run`, as Markdown."""
    degree = results["sh_degree"]
    parts = [f"{results['scene']}: {results['gaussians']} Gaussians of SH degree {degree}. {results['machine']}."]
    for at_scale in results["scales"]:
        title, *notes = (line[0].upper() + line[1:] for line in describe(results, at_scale))
        table = tables.markdown_table(*to_table(results, at_scale))
        parts += [f"## {title}", *(f"{note}." for note in notes), table]
    return "\n\n".join(parts) + "\n"


def _plot(results: dict, at_scale: dict):
    """Accuracy over time, for both passes, with the front."""
    unit, key, factor = _time_unit(results)
    figure, axes = tables.new_figure(13, 5.6, 2, sharey=True)
    for ax, (passes, title) in zip(axes[0], PASSES.items()):
        _plot_methods(ax, at_scale["methods"], f"{passes}_front", f"{passes}_{key}", f"{passes}_usual_{key}", factor)
        _plot_limits(ax, at_scale)
        ax.set_xlabel(f"{title} [{unit}]")
    axes[0, 0].set_ylabel("PSNR against the pixel integral [dB]")
    right = axes[0, 1].secondary_yaxis("right")
    right.yaxis.set_major_formatter(lambda psnr, _: f"{10 ** (-psnr / 20):.1e}")
    right.set_ylabel("RMSE")
    bars = f"; bars: from the fastest to the median of {results['rounds']} rounds" if key == "ratio" else ""
    tables.add_titles(figure, axes, f"{results['scene']} at {_scale_and_sizes(at_scale)} px: accuracy over time{bars}")
    return figure


def _plot_methods(ax, rows: list[dict], front: str, time: str, usual: str, factor: float) -> None:
    """Accuracy over time, a line per family of methods. `front`, `time` and `usual` are keys of rows; times get a
    factor."""
    fastest = sorted((row[time] * factor, row["psnr"]) for row in rows if row[front])
    wide = {"color": "#ffd43b", "linewidth": 5, "alpha": 0.7, "zorder": 1}
    ax.plot(*zip(*fastest), drawstyle="steps-post", label="Pareto front", **wide)
    for label, family in _families(rows).items():
        style = tables.style(family[-1]["footprint"]) | {"linestyle": "-", "linewidth": 1, "markersize": 8}
        if family[-1]["supersampling"] > 1:
            style["marker"] = "X"
        x, y = [row[time] * factor for row in family], [row["psnr"] for row in family]
        added = [row[usual] * factor - at for row, at in zip(family, x)]
        ax.errorbar(x, y, xerr=[[0] * len(x), added], label=label, **style)
        for row, *place in zip(family, x, y):
            if not row["resolved"]:
                ax.plot(*place, **style, markerfacecolor="white")
            samples = dict(resolve_footprint(row["footprint"]).options).get("samples", "")
            text = samples if row["supersampling"] == 1 else "{0}x{0}".format(row["supersampling"])
            ax.annotate(text, place, (0, 7), textcoords="offset points", fontsize=8, ha="center")


def _plot_limits(ax, at_scale: dict) -> None:
    """Accuracies that no method here can exceed, or that the reference cannot tell apart."""
    floor = next((row["blending_rmse"] for row in at_scale["methods"] if row["blending_rmse"]), None)
    if floor:
        label = "floor of one exact weight"
        ax.axhline(finite_decibels(floor**2), color="black", linewidth=0.9, linestyle=":", label=label)
    if at_scale["order"] is not None:
        label = "pictures in the order along rays"
        ax.axhline(at_scale["order"]["psnr"], color="#868e96", linewidth=0.9, linestyle="--", label=label)
    limit, top = finite_decibels(at_scale["reference"]["resolves_rmse_from"] ** 2), ax.get_ylim()[1]
    if limit < top:
        ax.axhspan(limit, top, color="#f1f3f5", zorder=0, label="not resolved by the reference")


def _families(rows: list[dict]) -> dict[str, list[dict]]:
    """Methods that differ only in the number of samples, in order, by label."""
    families = {}
    for row in rows:
        spec = resolve_footprint(row["footprint"])
        label = f"{spec.name}, S samples" if "samples" in dict(spec.options) else row["method"].partition("@")[0]
        families.setdefault(label + ", supersampled" * (row["supersampling"] > 1), []).append(row)
    return families
