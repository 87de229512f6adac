"""Accuracy against time: every footprint on a trained scene, compared with the integral over the pixel.

`run()` renders a scene at several scales with every method, measures how far each picture is from the
box integral of the image and what it costs, and writes a table, plots with the Pareto front, and JSON.
A *method* is a footprint, or a footprint in a picture rendered n times larger and averaged ("@n").
"""

from __future__ import annotations

import json
import math
import statistics
import time
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from . import measure, report
from .accuracy import RMSE_SHARE, UNFILTERED, Refined, image_errors, refine, supersampled
from .footprints import BOX_SAMPLES, FOOTPRINTS, resolve_footprint
from .io import Scene, View, optional_import

EXACT = "exact"  # the footprint without a weight error: what remains is blending's
BASE = "box:samples=1"  # times on the CPU are ratios to this
SECOND_ESTIMATE = "box:samples=16"  # another way to the reference's limit
MAX_FILTERED_PIXELS = 2**25  # of its pictures, which come in one piece
SUPERSAMPLING = (2, 3, 4)
ROUNDS = {"cpu": 5, "cuda": 20}
SLOW = 20  # times as long as the base, and the CPU times a method only once
WARM_UP = 20  # passes over the views before timing on CUDA: 40 frames, the first 32 of a size wait for the device
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
        """Whether a pixel sees each splat through one number, so that `exact` is its ideal."""
        spec = resolve_footprint(self.footprint)
        many = spec.name == "adaptive" or (spec.name == "box" and dict(spec.options)["samples"] > 1)
        return self.supersampling == 1 and not many


def parse_method(text: str) -> Method:
    """The method of "NAME[:k=v,..][@N]". Raises ValueError for a bad footprint or N."""
    footprint, at, factor = text.partition("@")
    resolve_footprint(footprint)
    if at and not (factor.isdecimal() and int(factor) >= 1):
        raise ValueError(f"supersampling must be a positive whole number, got {factor!r} in {text!r}")
    return Method(footprint, int(factor) if at else 1)


def default_methods() -> list[Method]:
    """Every footprint, `box` with every number of samples, and supersampled `point`, which is 3DGS-SS."""
    names = []
    for name in FOOTPRINTS:
        names += [f"box:samples={n}" for n in BOX_SAMPLES] if name == "box" else [name]
    names += [f"{point}@{n}" for point in ("point", UNFILTERED) for n in SUPERSAMPLING]
    return [parse_method(name) for name in names]


def framed(view: View, scale: int, crop: tuple[int, int] | None = None) -> View:
    """The view at 1/`scale` of its size, or the middle `crop` = (width, height) of that.

    Pixels stay `scale` times as large as those of the view: where its size is not a multiple of `scale`,
    the remainder at the right and at the bottom is cut off. A crop that is larger than the picture
    leaves it whole. A cropped view is a narrower camera, not a part of a picture.
    """
    size = [max(1, length // scale) for length in (view.width, view.height)]
    wanted = size if crop is None else [min(pair) for pair in zip(size, crop)]
    centre = (view.width / 2 if view.cx is None else view.cx, view.height / 2 if view.cy is None else view.cy)
    cx, cy = (c / scale - (have - want) // 2 for c, have, want in zip(centre, size, wanted))
    width, height = wanted
    return replace(view, width=width, height=height, fx=view.fx / scale, fy=view.fy / scale, cx=cx, cy=cy)


def run(
    out,
    scene: Scene,
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
        scales: Reductions: 8 is 1/8 of the views' size. See `framed`.
        methods: None is `default_methods()`.
        crop: (width, height) px, at every scale.
        background: RGB.
        rounds: Timed rounds after one that warms up; None is ROUNDS of the device.
        max_density: Of the reference, see `refine`.
        cpu_time: On the CPU count the seconds that the process computed, of all threads together, not those
            that went by: on a machine that others use too, and with one thread.
        name: Of the scene, for the titles.

    Returns:
        What pareto.json holds. Errors are over all channels of all pixels of all views.

    Raises:
        ValueError: No views, methods or scales, or one of them twice.
        ImportError: Without the `analysis` extra.
    """
    methods = default_methods() if methods is None else methods
    names = [method.name for method in methods]
    for what, given in (("views", [view.name for view in views]), ("methods", names), ("scales", list(scales))):
        if not given or len(set(given)) < len(given):
            raise ValueError(f"{what} must be given, and each once, got {', '.join(map(str, given)) or 'none'}")
    for module in ("matplotlib.figure", "torchmetrics.functional.image"):
        optional_import(module, "analysis")  # now rather than after the first scale
    out = Path(out)
    device = scene.means.device.type
    rounds = ROUNDS[device] if rounds is None else rounds
    results = {
        "scene": name,
        "gaussians": len(scene.means),
        "sh_degree": scene.sh_degree,
        "views": [view.name for view in views],
        "background": list(background),
        "crop": None if crop is None else list(crop),
        "device": device,
        "machine": measure.describe_machine(device),
        "rounds": rounds,
        "clock": "CUDA events" if device == "cuda" else "CPU time" if cpu_time else "wall",
        "base": BASE if BASE in names else names[0],
        "scales": [],
    }
    for scale in scales:
        small = [framed(view, scale, crop) for view in views]
        measured = _measure_scale(scene, small, methods, background, rounds, max_density, cpu_time, results["base"])
        results["scales"].append({"scale": scale, "sizes": [[v.width, v.height] for v in small], **measured})
        report.save_figure(_plot(results, results["scales"][-1]), out, f"pareto_{scale}")
        # After every scale, so that a long run that is stopped leaves what it has.
        (out / "pareto.json").write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
        (out / "pareto.md").write_text(to_markdown(results), encoding="utf-8")
    return results


# ---------------------------------------------------------------------------------- measuring


def _measure_scale(scene, views, methods, background, rounds, max_density, cpu_time, base) -> dict:
    """Reference and methods at one scale."""
    tqdm = optional_import("tqdm").tqdm
    cases = {
        method.name: [measure.Case(scene, view, method.footprint, method.supersampling, background) for view in views]
        for method in methods
    }
    with tqdm(total=len(methods), desc="render", unit="method", disable=None) as bar:
        pictures = {}
        for name, of_name in cases.items():
            pictures[name] = {view.name: case.forward() for view, case in zip(views, of_name)}
            bar.update()
    exact = None
    if any(method.has_single_weight for method in methods):
        exact = pictures.get(EXACT)
        if exact is None:
            exact = {v.name: measure.Case(scene, v, EXACT, 1, background).forward() for v in views}

    refined = refine(
        lambda density: {v.name: supersampled(scene, v, density, background=background) for v in views},
        lambda truth: {
            v.name: min(image_errors(of_name[v.name], truth[v.name])["rmse"] for of_name in pictures.values())
            for v in views
        },
        limit=max_density,
    )
    truth = refined.pictures
    reference = _describe_reference(scene, views, background, refined)
    times = _times(cases, rounds, base, time.process_time if cpu_time else time.perf_counter)
    rows = []
    for method in methods:
        of_name = pictures[method.name]
        row = {
            "method": method.name,
            "footprint": str(resolve_footprint(method.footprint)),
            "supersampling": method.supersampling,
            **image_errors(_flat(of_name), _flat(truth)),
            "ssim": _mean([_ssim(of_name[v.name], truth[v.name]) for v in views]),
            **times[method.name],
            "extra_bytes": _mean([_positive(case.extra_bytes()) for case in cases[method.name]]),
            **_split(method, of_name, exact, truth),
            "per_view": {v.name: image_errors(of_name[v.name], truth[v.name]) for v in views},
        }
        row["resolved"] = reference["residual"]["rmse"] <= RMSE_SHARE * row["rmse"]
        rows.append(row)
    for passes in PASSES:
        front = pareto_front([(row[f"{passes}_ratio"], row["rmse"]) for row in rows])
        for row, on_front in zip(rows, front):
            row[f"{passes}_front"] = on_front
    return {"reference": reference, "methods": rows}


def _describe_reference(scene, views, background, refined: Refined) -> dict:
    """How the reference was made, and three estimates of its own error, over all views.

    residual: change from half the density, which bounds the error where halving more than halves the
    error. expected_rmse: the error that follows from the order seen over the last two doublings
    (Richardson), if it is positive. second_estimate: distance from another sampler with the same limit.
    """
    density, truth = refined.density, refined.pictures
    sizes = {v.name: v.width * v.height for v in views}
    pooled = {n: _pool(by_view, sizes) for n, by_view in refined.residuals.items()}
    before, last = pooled.get(density // 2), pooled[density]
    order = math.log2(before / last) if before and last else None
    # A sample of the second estimate is a square of 1/16 of its pixel: a quarter of the density suffices.
    second = max(1, density // 4)
    while second > 1 and second**2 * max(sizes.values()) > MAX_FILTERED_PIXELS:
        second //= 2
    other = {v.name: supersampled(scene, v, second, SECOND_ESTIMATE, background) for v in views}
    return {
        "footprint": UNFILTERED,
        "density": density,
        "samples_per_pixel": density**2,
        "residual": image_errors(_flat(refined.half), _flat(truth)),
        "residual_rmse": {str(n): value for n, value in pooled.items()},
        "order": order,
        "expected_rmse": last / (2**order - 1) if order is not None and order > 0 else None,
        "second_estimate": {
            "footprint": SECOND_ESTIMATE,
            "density": second,
            "rmse": image_errors(_flat(other), _flat(truth))["rmse"],
        },
        "resolves_rmse_from": last / RMSE_SHARE,
    }


def _split(method: Method, pictures: dict, exact: dict | None, truth: dict) -> dict:
    """The error of a footprint with one weight per splat as that of its weight plus that of blending:
    rmse^2 = weight_rmse^2 + blending_rmse^2 + 2 correlation weight_rmse blending_rmse."""
    if exact is None or not method.has_single_weight:
        return {"weight_rmse": None, "blending_rmse": None, "correlation": None}
    weight = (_flat(pictures).double() - _flat(exact)).flatten()
    blending = (_flat(exact).double() - _flat(truth)).flatten()
    weight_rmse, blending_rmse = (part.square().mean().sqrt().item() for part in (weight, blending))
    scale = weight_rmse * blending_rmse
    correlation = (weight * blending).mean().item() / scale if scale else 0.0
    return {"weight_rmse": weight_rmse, "blending_rmse": blending_rmse, "correlation": correlation}


def _times(cases: dict[str, list[measure.Case]], rounds: int, base: str, timer=time.perf_counter) -> dict[str, dict]:
    """Seconds per view of both passes, and their ratio to the base.

    On the CPU methods take turns, and the fastest of a view's rounds counts: what else the machine does
    only ever adds. A method that is SLOW in the round that warms up is not timed again. On CUDA a method's
    frames are timed by themselves, because the room for its pairs follows the frames before, and the
    median counts. `_usual` is the median round, which tells how much is added.
    """
    device = next(iter(cases.values()))[0].dL_dcolor.device
    with optional_import("tqdm").tqdm(desc="time", unit="case", disable=None) as bar:

        def clock(case):
            bar.update()
            if device.type == "cuda":
                seconds = (measure.median_seconds(measure.event_seconds, call, rounds) for call in _calls(case))
            else:
                seconds = (_seconds(call, timer) for call in _calls(case))
            return dict(zip(PASSES, seconds))

        samples = {}
        for name, of_name in cases.items():
            if device.type == "cuda":
                measure.warm_up_cuda(of_name, WARM_UP)
            samples[name] = [[clock(case)] for case in of_name]
        if device.type != "cuda":  # that was the round that warms up
            slowest = SLOW * sum(taken[0]["forward_backward"] for taken in samples[base])
            quick = {
                name: of_name
                for name, of_name in cases.items()
                if sum(taken[0]["forward_backward"] for taken in samples[name]) <= slowest
            }
            samples |= measure.in_turn(quick, clock, range(1, rounds + 1))
    times = {name: {} for name in samples}
    for passes in PASSES:
        for kind, choose in (("", min), ("_usual", statistics.median)):
            for name, of_name in samples.items():
                seconds = _mean([choose(sample[passes] for sample in taken) for taken in of_name])
                times[name][f"{passes}{kind}_seconds"] = seconds
        for of_name in times.values():
            for kind in ("", "_usual"):
                of_name[f"{passes}{kind}_ratio"] = of_name[f"{passes}{kind}_seconds"] / times[base][f"{passes}_seconds"]
    return times


def _calls(case: measure.Case) -> list:
    return [getattr(case, passes) for passes in PASSES]


def _seconds(call, timer) -> float:
    start = timer()
    call()
    return timer() - start


def pareto_front(points: list[tuple[float, float]]) -> list[bool]:
    """Which (cost, error) no other point beats: none is as good in both and better in one."""

    def beats(a, b):
        return a[0] <= b[0] and a[1] <= b[1] and a != b

    return [not any(beats(other, point) for other in points) for point in points]


def _ssim(color: torch.Tensor, truth: torch.Tensor) -> float | None:
    """Structural similarity with a Gaussian window of 1.5 px, the border mirrored, for colours in 0 to 1."""
    if min(color.shape[1:]) < SSIM_WINDOW:
        return None
    ssim = optional_import("torchmetrics.functional.image", "analysis").structural_similarity_index_measure
    return ssim(color[None].double(), truth[None], data_range=1.0).item()


def _flat(pictures: dict[str, torch.Tensor]) -> torch.Tensor:
    """All values of the pictures of all views."""
    return torch.cat([picture.flatten() for picture in pictures.values()])


def _pool(rmse: dict[str, float], sizes: dict[str, int]) -> float:
    """RMSE over pictures of these sizes."""
    return math.sqrt(sum(sizes[key] * value**2 for key, value in rmse.items()) / sum(sizes[key] for key in rmse))


def _mean(values: list) -> float | None:
    return None if None in values else statistics.mean(values)


def _positive(value: int) -> int | None:
    """Memory, where the system says how much."""
    return value if value > 0 else None


# ---------------------------------------------------------------------------------- reporting


def to_table(results: dict, at_scale: dict) -> tuple[list[str], list[list]]:
    """(header, rows) of one scale. Times are ratios on the CPU, milliseconds on CUDA."""
    on_cuda = results["device"] == "cuda"
    unit, key, factor = ("ms", "seconds", 1e3) if on_cuda else ("ratio", "ratio", 1)
    header = ["method", "PSNR [dB]", "RMSE", "bias", "99.9%", "max", "SSIM"]
    header += [f"forward [{unit}]", f"with backward [{unit}]", "memory [MiB]", "weight RMSE", "blending RMSE", "front"]
    rows = []
    for row in at_scale["methods"]:
        front = "".join(letter for letter, passes in zip("FB", PASSES) if row[f"{passes}_front"])
        rows.append(
            [
                row["method"],
                ("" if row["resolved"] else "~") + f"{row['psnr']:.2f}",
                *(f"{row[error]:.2e}" for error in ("rmse", "bias", "p999", "max")),
                None if row["ssim"] is None else f"{row['ssim']:.5f}",
                *(f"{row[f'{passes}_{key}'] * factor:.2f}" for passes in PASSES),
                None if row["extra_bytes"] is None else f"{row['extra_bytes'] / 2**20:.0f}",
                *(None if row[part] is None else f"{row[part]:.2e}" for part in ("weight_rmse", "blending_rmse")),
                front or None,
            ]
        )
    return header, rows


def describe(results: dict, at_scale: dict) -> list[str]:
    """What the numbers of one scale rest on, in lines."""
    reference, base = at_scale["reference"], results["base"]
    lines = [f"scale {_what(at_scale)}"]
    row = next(row for row in at_scale["methods"] if row["method"] == base)
    if results["device"] != "cuda":
        seconds = " / ".join(f"{1e3 * row[f'{passes}_seconds']:.1f}" for passes in PASSES)
        clock = " of CPU time" if results["clock"] == "CPU time" else ""
        lines.append(
            f"times are ratios to {base}, {seconds} ms{clock}; the fastest of {results['rounds']} rounds in turn"
        )
    residual, second = reference["residual"], reference["second_estimate"]
    order = "" if reference["order"] is None else f" (order {reference['order']:.1f})"
    lines.append(
        "reference: {0}x{0} unfiltered samples per pixel; from half that density it changes by RMSE {rmse:.1e}{order}, "
        "bias {bias:.0e}, at most {max:.1e}; from {1} at {2}x{2} it differs by RMSE {3:.1e}".format(
            reference["density"], second["footprint"], second["density"], second["rmse"], order=order, **residual
        )
    )
    unresolved = [row["method"] for row in at_scale["methods"] if not row["resolved"]]
    if unresolved:
        lines.append(
            f"~ not converged: the reference resolves RMSE from {reference['resolves_rmse_from']:.1e}; below it, and "
            f"uncertain: {', '.join(unresolved)}"
        )
    return lines


def _what(at_scale: dict) -> str:
    count = len(at_scale["sizes"])
    sizes = ", ".join(sorted({f"{w} x {h}" for w, h in at_scale["sizes"]}))
    return f"1/{at_scale['scale']}, {count} view{'s' * (count > 1)} of {sizes}"


def to_markdown(results: dict) -> str:
    """All tables."""
    degree = results["sh_degree"]
    parts = [f"{results['scene']}: {results['gaussians']} Gaussians of SH degree {degree}. {results['machine']}."]
    for at_scale in results["scales"]:
        title, *notes = describe(results, at_scale)
        notes = [note[0].upper() + note[1:] + "." for note in notes]
        parts += [f"## {title[0].upper() + title[1:]}", *notes, report.markdown_table(*to_table(results, at_scale))]
    return "\n\n".join(parts) + "\n"


def _plot(results: dict, at_scale: dict):
    """Accuracy over time, for both passes, with the front."""
    key, factor = ("seconds", 1e3) if results["device"] == "cuda" else ("ratio", 1)
    unit = "ms" if results["device"] == "cuda" else f"times {results['base']}"
    rows = at_scale["methods"]
    figure, axes = report.new_figure(13, 5.6, 2, sharey=True)
    for ax, (passes, title) in zip(axes[0], PASSES.items()):
        time_key = f"{passes}_{key}"
        points = {row["method"]: (row[time_key] * factor, row["psnr"]) for row in rows}
        _plot_front(ax, sorted(points[row["method"]] for row in rows if row[f"{passes}_front"]))
        for label, members in _families(rows).items():
            look = _family_look(members)
            if len(members) > 1:
                ax.plot(*zip(*(points[row["method"]] for row in members)), color=look["color"], linewidth=1, zorder=2)
            for row in members:
                x, y = points[row["method"]]
                if key == "ratio":
                    ax.plot([x, row[f"{passes}_usual_ratio"]], [y, y], color=look["color"], linewidth=1, alpha=0.5)
                faded = {} if row["resolved"] else {"markerfacecolor": "white"}
                (dot,) = ax.plot(x, y, **{**look, "linestyle": ""}, markersize=8, zorder=3, **faded)
                ax.annotate(_short_label(row), (x, y), (0, 7), textcoords="offset points", fontsize=8, ha="center")
            dot.set_label(label)
        ax.margins(0.07)
        ax.set_xlabel(f"{title} [{unit}]")
        report.plain_log_ticks(ax)
    for ax in axes[0]:
        _plot_limits(ax, at_scale)
    axes[0, 0].set_ylabel("PSNR against the pixel integral [dB]")
    _rmse_axis(axes[0, 1])
    bars = "" if key == "seconds" else f"; bars: from the fastest to the median of {results['rounds']} rounds"
    figure.suptitle(f"{results['scene']} at {_what(at_scale)} px: accuracy against time{bars}", fontsize=11)
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right center", frameon=False, fontsize=9)
    return figure


def _plot_front(ax, front: list[tuple[float, float]]) -> None:
    """The best accuracy that each time buys: flat until the next method of the front."""
    times, psnr = zip(*front)
    look = {"color": "#ffd43b", "linewidth": 5, "alpha": 0.7, "zorder": 1}
    ax.plot(times, psnr, drawstyle="steps-post", label="Pareto front", **look)


def _plot_limits(ax, at_scale: dict) -> None:
    """Where blending one weight per splat ends, and where the reference does."""
    floor = next((row["blending_rmse"] for row in at_scale["methods"] if row["blending_rmse"]), None)
    if floor:
        ax.axhline(_psnr_of(floor), color="black", linewidth=0.9, linestyle=":", label="floor of one exact weight")
    limit, top = _psnr_of(at_scale["reference"]["resolves_rmse_from"]), ax.get_ylim()[1]
    if limit < top:
        ax.axhspan(limit, top, color="#f1f3f5", zorder=0, label="not resolved by the reference")
        ax.set_ylim(top=top)


def _psnr_of(rmse: float) -> float:
    return -20 * math.log10(max(rmse, 1e-15))


def _rmse_axis(ax) -> None:
    """The same scale as RMSE, at the right."""
    low, high = ax.get_ylim()
    for digits in ((1, 3), (1, 1.5, 2, 3, 5, 7)):  # the second where the first gives too few
        ticks = [(_psnr_of(d * 10.0**-e), f"{d:g}e-{e}") for e in range(12) for d in digits]
        ticks = [tick for tick in ticks if low <= tick[0] <= high]
        if len(ticks) > 2:
            break
    right = ax.twinx()
    right.set_ylim(low, high)
    right.set_yticks([place for place, _ in ticks], [text for _, text in ticks])
    right.spines[["top", "left"]].set_visible(False)
    right.set_ylabel("RMSE")


def _families(rows: list[dict]) -> dict[str, list[dict]]:
    """Methods that differ only in how many samples they take, in order, by label."""
    families = {}
    for row in rows:
        footprint = row["method"].partition("@")[0]
        label = "box, S samples" if footprint.startswith("box") else footprint
        if row["supersampling"] > 1:
            label = f"{footprint}, supersampled"
        families.setdefault(label, []).append(row)
    return families


def _family_look(members: list[dict]) -> dict:
    """Colour and marker of a family; supersampled ones have crosses, dark where they are not dilated."""
    if members[0]["supersampling"] == 1:
        many = members[0]["footprint"].startswith("box")
        return report.style("box:samples=4" if many else members[0]["footprint"])
    look = {**report.style(members[0]["footprint"]), "marker": "X"}
    if members[0]["footprint"].startswith("point"):
        look["color"] = "#adb5bd" if resolve_footprint(members[0]["footprint"]).option else "#343a40"
    return look


def _short_label(row: dict) -> str:
    if row["supersampling"] > 1:
        return "{0}x{0}".format(row["supersampling"])
    return str(dict(resolve_footprint(row["footprint"]).options).get("samples", ""))
