"""The error of a pixel's weight: the paper's analysis [AS, Sec. 2.4], and the same for every footprint.

`run()` measures three things and writes each as CSV and as plots:

- window: the paper's logistic window along one axis against the Gaussian's integral.
- rotation: what turning the pixel into the splat's eigenframe costs, against Monte Carlo integration as
  in the paper and against the exact integral.
- footprints: the weight of every footprint and its gradients, over rotations, anisotropies and offsets.

All of it is computed in float64. [AS] is the paper with its supplement, see docs/numerics.md.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import torch

from . import report
from .footprints import BOX_SAMPLES, FOOTPRINTS, footprint_weight
from .io import optional_import

PAPER_SIGMAS = (0.3, 6.6)  # px, the range of [AS, Sec. 2.4]
SIGMAS = (0.02, 20.0)  # px, ours
PER_DECADE = 10
REACH = 3.0  # deviations: the paper's ||x|| < 3 sigma
RATIO = 100.0  # the largest anisotropy
SAMPLES = 4096  # splats of one deviation
MONTE_CARLO = 65536  # samples in a pixel, as in the paper
ROTATION_SAMPLES = 64  # splats of one deviation, each integrated by Monte Carlo
THRESHOLDS = (1e-2, 1e-3, 1e-4)
TABLE_SIGMAS = (0.02, 0.05, 0.1, 0.2, 0.3, 0.5, 1.0, 2.0, 5.0)
PAPER_GRADIENT = "analytic:frame_gradient=paper"
GRADIENTS = {"offset": "dI/d offset", "cov2d": "dI/d covariance"}


def run(out, samples: int = SAMPLES, monte_carlo: int = MONTE_CARLO, rotation_samples: int | None = None) -> dict:
    """Measures all three and writes CSV, PNG and SVG files and summary.md to `out`, a folder that exists.

    Args:
        out: Folder.
        samples: Splats of each deviation, for the footprints. Maxima are over these splats, and so lower
            bounds.
        monte_carlo: Samples in a pixel.
        rotation_samples: Splats of each deviation, for the rotation; None is ROTATION_SAMPLES.

    Returns:
        {"window": rows, "rotation": rows, "footprints": rows, "summary": Markdown}.

    Raises:
        ImportError: Without the `analysis` extra.
        ValueError: This build has no `exact` or `erf` footprint.
    """
    for module in ("matplotlib.figure", "scipy.special"):
        optional_import(module, "analysis")  # now rather than after the first measurement
    out = Path(out)
    cases = all_cases()
    with optional_import("tqdm").tqdm(total=2 + len(cases), desc="errors", disable=None) as bar:
        window = window_errors()
        bar.update()
        rotation = rotation_errors(rotation_samples or ROTATION_SAMPLES, monte_carlo)
        bar.update()
        footprints = footprint_errors(cases, samples, bar.update)
    results = {"window": window, "rotation": rotation, "footprints": footprints}
    figures = {
        "window": _plot_window(window),
        "rotation": _plot_rotation(rotation),
        "footprints_weight": _plot_weight(footprints),
        "footprints_gradient": _plot_gradients(footprints),
    }
    for name, rows in results.items():
        report.save_csv(out / f"{name}.csv", rows)
    for name, figure in figures.items():
        report.save_figure(figure, out, name)
    summary = summarize(results, samples, monte_carlo)
    (out / "summary.md").write_text(summary, encoding="utf-8")
    return {**results, "summary": summary}


def all_cases() -> list[str]:
    """Every footprint that gives a weight, with the options that change it or its gradient."""
    cases = []
    for name in FOOTPRINTS:
        if name == "box":
            cases += [f"box:samples={n}" for n in BOX_SAMPLES]
        elif name not in ("exact", "adaptive"):  # the truth; and samples chosen by the tile, not by the splat
            cases.append(name)
        if name == "point":
            cases.append("point:dilation=0")
        if name == "analytic":
            cases.append(PAPER_GRADIENT)
    return cases


# ------------------------------------------------------------------------------- (a) one axis


def logistic_cdf(x: np.ndarray) -> np.ndarray:
    """S(x), the paper's stand-in for the normal CDF [AS, Eq. 5]."""
    return optional_import("scipy.special", "analysis").expit(1.6 * x + 0.07 * x**3)


def normal_cdf(x: np.ndarray) -> np.ndarray:
    """The normal CDF, through scipy's erf as in the paper."""
    return (1 + optional_import("scipy.special", "analysis").erf(x / math.sqrt(2))) / 2


def window_errors(sigmas: int = 200, offsets: int = 2001) -> list[dict]:
    """Errors of the window S((x + 1/2)/sigma) - S((x - 1/2)/sigma) [AS, Eq. 7] by deviation.

    `sigmas` deviations, log-uniform in PAPER_SIGMAS; `offsets` x, uniform in |x| <= 3 sigma. A row holds
    sigma, the maximum and RMS error of the window (the density integrated over the pixel), and the
    same times sqrt(2 pi) sigma: of a splat of peak 1, which is what enters its weight [AS, Eq. 8].
    """
    rows = []
    for sigma in np.geomspace(*PAPER_SIGMAS, sigmas):
        x = np.linspace(-REACH * sigma, REACH * sigma, offsets)
        high, low = (x + 0.5) / sigma, (x - 0.5) / sigma
        error = (logistic_cdf(high) - logistic_cdf(low)) - (normal_cdf(high) - normal_cdf(low))
        largest, rms = _max_rms(error)
        peak = math.sqrt(2 * math.pi) * sigma
        rows.append(
            {
                "sigma": float(sigma),
                "window_max": largest,
                "window_rms": rms,
                "weight_max": peak * largest,
                "weight_rms": peak * rms,
            }
        )
    return rows


# ------------------------------------------------------------------------------- (b) rotation


def rotation_errors(samples: int, monte_carlo: int, sigmas: int = 40) -> list[dict]:
    """Errors of integrating over the turned pixel, with the exact CDF (the footprint `erf`), by deviation.

    `sigmas` smaller deviations, log-uniform in PAPER_SIGMAS; for each `samples` splats: anisotropy
    log-uniform in 1 to RATIO, any rotation, offsets uniform in the ellipse of 3 sigma. References: the mean
    of `monte_carlo` uniform samples in the pixel, and `exact`. A row holds sigma, maximum and RMS of
    erf - exact (`exact_`), of erf - Monte Carlo (`monte_carlo_`) and of Monte Carlo - exact
    (`references_`), the RMS standard error of Monte Carlo, and z_rms, the RMS of (Monte Carlo - exact) over
    that standard error: 1 where the references agree. The standard error is itself exact, not
    estimated: the integrand's square is a splat with half the covariance.
    """
    random = torch.Generator().manual_seed(0)
    unit = _unit_samples(samples)
    rows = []
    for sigma in np.geomspace(*PAPER_SIGMAS, sigmas):
        offset, cov2d = _splats(unit, float(sigma), blur=0.0)
        turned, exact = (footprint_weight(offset, cov2d, name) for name in ("erf", "exact"))
        square = footprint_weight(offset, cov2d / 2, "exact")
        standard_error = ((square - exact**2).clamp_min(0) / monte_carlo).sqrt()
        sampled = torch.stack([_monte_carlo(d, c, monte_carlo, random) for d, c in zip(offset, cov2d)])
        row = {"sigma": float(sigma)}
        for name, error in (
            ("exact", turned - exact),
            ("monte_carlo", turned - sampled),
            ("references", sampled - exact),
        ):
            row[f"{name}_max"], row[f"{name}_rms"] = _max_rms(error)
        row["standard_error"] = _max_rms(standard_error)[1]
        row["z_rms"] = _max_rms((sampled - exact) / standard_error)[1]
        rows.append(row)
    return rows


def _monte_carlo(offset: torch.Tensor, cov2d: torch.Tensor, samples: int, random: torch.Generator) -> torch.Tensor:
    """Mean of exp(-q/2) over uniform samples in the unit pixel around offset (2,)."""
    d = offset + torch.rand(samples, 2, generator=random, dtype=torch.float64) - 0.5
    xx, xy, yy = cov2d
    q = (yy * d[:, 0] ** 2 - 2 * xy * d[:, 0] * d[:, 1] + xx * d[:, 1] ** 2) / (xx * yy - xy**2)
    return torch.exp(-q / 2).mean()


# ----------------------------------------------------------------------------- (c) footprints


def footprint_errors(cases: list[str], samples: int, progress=lambda: None) -> list[dict]:
    """Errors of the weight and its gradients against `exact`, by footprint and deviation.

    The smaller deviation is log-uniform in SIGMAS, PER_DECADE to a decade; for each `samples` splats, the
    same for every footprint: anisotropy log-uniform in 1 to RATIO, any rotation, offsets uniform in the
    3 sigma ellipse of Sigma + I/12. A row holds maximum and RMS of the error of the weight I, and of the norm
    of the error of dI/d offset [1/px] and of dI/dSigma, whitened by Sigma: L^T (dI/dSigma) L with
    Sigma = L L^T, that is per relative change of Sigma. `_true_rms` is the RMS of the exact value's norm,
    which makes errors relative. The gradient is what autograd gives, which for `analytic` is not the derivative of the
    weight unless frame_gradient is "paper".
    """
    unit = _unit_samples(samples)
    count = round(PER_DECADE * math.log10(SIGMAS[1] / SIGMAS[0])) + 1
    sigmas = np.geomspace(*SIGMAS, count)
    splats = [_splats(unit, float(sigma), blur=1 / 12) for sigma in sigmas]
    truth = [_weight_and_gradients(*splat, "exact") for splat in splats]
    rows = []
    for case in cases:
        for sigma, splat, exact in zip(sigmas, splats, truth):
            row = {"footprint": case, "sigma": float(sigma)}
            for name, value, true in zip(("weight", *GRADIENTS), _weight_and_gradients(*splat, case), exact):
                error = (value - true).flatten(1).norm(dim=1)
                row[f"{name}_max"], row[f"{name}_rms"] = _max_rms(error)
                row[f"{name}_true_rms"] = _max_rms(true.flatten(1).norm(dim=1))[1]
            rows.append(row)
        progress()
    return rows


def _weight_and_gradients(offset: torch.Tensor, cov2d: torch.Tensor, footprint: str) -> list[torch.Tensor]:
    """Weight (n, 1), gradient of offset (n, 2), whitened gradient of the covariance (n, 2, 2)."""
    offset, cov2d = offset.clone().requires_grad_(), cov2d.clone().requires_grad_()
    weight = footprint_weight(offset, cov2d, footprint)
    by_offset, by_cov2d = torch.autograd.grad(weight.sum(), (offset, cov2d))
    xx, xy, yy = by_cov2d.unbind(-1)
    matrix = torch.stack(
        [torch.stack([xx, xy / 2], -1), torch.stack([xy / 2, yy], -1)], -2
    )  # xy stands for two entries
    factor = torch.linalg.cholesky(_matrix(cov2d.detach()))
    return [weight.detach()[:, None], by_offset, factor.mT @ matrix @ factor]


def _unit_samples(count: int) -> torch.Tensor:
    """(count, 4) float64 in [0, 1): anisotropy, rotation, and offset in polar coordinates; always the same."""
    return torch.quasirandom.SobolEngine(4, scramble=True, seed=0).draw(count, dtype=torch.float64)


def _splats(unit: torch.Tensor, sigma: float, blur: float) -> tuple[torch.Tensor, torch.Tensor]:
    """(offset (n, 2) [px], cov2d (n, 3) [px^2]) of splats whose smaller deviation is sigma.

    Offsets are uniform in the ellipse of REACH deviations of Sigma + blur I.
    """
    ratio, turn, radius, angle = unit.unbind(-1)
    large, small = (sigma * RATIO**ratio) ** 2, torch.full_like(ratio, sigma**2)
    cos, sin = torch.cos(math.pi * turn), torch.sin(math.pi * turn)
    cov2d = torch.stack(
        [large * cos**2 + small * sin**2, (large - small) * cos * sin, large * sin**2 + small * cos**2], -1
    )
    reach = REACH * radius.sqrt()
    u = reach * (large + blur).sqrt() * torch.cos(2 * math.pi * angle)
    v = reach * (small + blur).sqrt() * torch.sin(2 * math.pi * angle)
    return torch.stack([cos * u - sin * v, sin * u + cos * v], -1), cov2d


def _matrix(cov2d: torch.Tensor) -> torch.Tensor:
    xx, xy, yy = cov2d.unbind(-1)
    return torch.stack([torch.stack([xx, xy], -1), torch.stack([xy, yy], -1)], -2)


def _max_rms(error) -> tuple[float, float]:
    error = torch.as_tensor(error)
    return error.abs().max().item(), error.square().mean().sqrt().item()


# ---------------------------------------------------------------------------------- reporting


def summarize(results: dict, samples: int, monte_carlo: int) -> str:
    """The tables, as Markdown."""
    window, rotation = results["window"], results["rotation"]
    worst = max(window, key=lambda row: row["window_max"])
    peak = max(window, key=lambda row: row["weight_max"])
    turned = max(rotation, key=lambda row: row["exact_max"])
    z = math.sqrt(sum(row["z_rms"] ** 2 for row in rotation) / len(rotation))
    low, high = PAPER_SIGMAS
    parts = [
        "# Errors of the pixel's weight",
        f"## One axis: the logistic window, sigma in [{low}, {high}] px, |x| <= 3 sigma",
        f"Largest error of the window {worst['window_max']:.2e} (sigma {worst['sigma']:.2f}), of a splat of peak 1 "
        f"{peak['weight_max']:.2e} (sigma {peak['sigma']:.2f}).",
        f"## The pixel turned into the splat's frame, sigma in [{low}, {high}] px, anisotropy 1 to {RATIO:.0f}",
        report.markdown_table(
            ["sigma [px]", "against exact, max / RMS", f"against {monte_carlo} samples", "the two references", "z"],
            [
                [
                    f"{row['sigma']:.2f}",
                    *(
                        f"{row[f'{name}_max']:.1e} / {row[f'{name}_rms']:.1e}"
                        for name in ("exact", "monte_carlo", "references")
                    ),
                    f"{row['z_rms']:.2f}",
                ]
                for row in rotation[:: max(1, len(rotation) // 8)]
            ],
        ),
        f"Largest error {turned['exact_max']:.2e} (sigma {turned['sigma']:.2f}). z is the RMS difference of the two "
        f"references over the standard error of Monte Carlo: {z:.3f} over all splats, 1 where they agree.",
        f"## Every footprint, {samples} splats of each sigma, anisotropy 1 to {RATIO:.0f}, any rotation, offset to "
        "3 deviations",
        "Error of the weight, max / RMS, by smaller deviation [px]:",
        _by_sigma(_of_weight(results["footprints"]), lambda r: f"{r['weight_max']:.1e} / {r['weight_rms']:.1e}"),
        "RMS error of dI/d offset, relative to the RMS of the exact one:",
        _by_sigma(results["footprints"], lambda r: f"{r['offset_rms'] / r['offset_true_rms']:.1e}"),
        "RMS error of dI/dSigma, whitened, relative to the RMS of the exact one:",
        _by_sigma(results["footprints"], lambda r: f"{r['cov2d_rms'] / r['cov2d_true_rms']:.1e}"),
        "Smallest deviation [px] from which on the worst error of the weight stays below:",
        _by_threshold(_of_weight(results["footprints"])),
        "Maxima are over the splats of the sample, and so lower bounds.",
    ]
    return "\n\n".join(parts) + "\n"


def _of_weight(rows: list[dict]) -> list[dict]:
    """Without the case that differs in its gradient alone."""
    return [row for row in rows if row["footprint"] != PAPER_GRADIENT]


def _of_footprint(rows: list[dict]) -> dict[str, list[dict]]:
    by_footprint = {}
    for row in rows:
        by_footprint.setdefault(row["footprint"], []).append(row)
    return by_footprint


def _by_sigma(rows: list[dict], text) -> str:
    by_footprint = _of_footprint(rows)
    some = next(iter(by_footprint.values()))
    columns = [min(range(len(some)), key=lambda i: abs(math.log(some[i]["sigma"] / s))) for s in TABLE_SIGMAS]
    header = ["footprint", *(f"{some[i]['sigma']:.2g}" for i in columns)]
    return report.markdown_table(header, [[name, *(text(of[i]) for i in columns)] for name, of in by_footprint.items()])


def _by_threshold(rows: list[dict]) -> str:
    table = []
    for name, of_name in _of_footprint(rows).items():
        table.append([name])
        for threshold in THRESHOLDS:
            above = [row["sigma"] for row in of_name if row["weight_max"] > threshold]
            later = [row["sigma"] for row in of_name if not above or row["sigma"] > max(above)]
            whole = len(later) == len(of_name)
            table[-1].append(f"{'<= ' * whole}{later[0]:.2g}" if later else f"> {SIGMAS[1]:.2g}")
    return report.markdown_table(["footprint", *(f"{t:.0e}" for t in THRESHOLDS)], table)


def _plot_window(rows: list[dict]):
    figure, axes = report.new_figure(10, 4.2, 2, sharex=True, sharey=True)
    sigma = [row["sigma"] for row in rows]
    for ax, key, title in zip(
        axes[0],
        ("window", "weight"),
        ("integral of the density", r"weight of a splat of peak 1 ($\sqrt{2\pi}\,\sigma$ times)"),
    ):
        ax.plot(sigma, [row[f"{key}_max"] for row in rows], color=report.COLORS["analytic"], label="maximum")
        ax.plot(sigma, [row[f"{key}_rms"] for row in rows], color=report.COLORS["analytic"], ls="--", label="RMS")
        ax.set(yscale="log", ylim=(5e-5, 5e-3), title=title)
        ax.set(xlabel="standard deviation [px]", ylabel="absolute error")
        report.plain_log_ticks(ax)
        ax.title.set_fontsize(10)
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside right center", frameon=False)
    figure.suptitle("The logistic window against erf, |x| within 3 deviations", fontsize=11)
    return figure


def _plot_rotation(rows: list[dict]):
    figure, axes = report.new_figure(11, 4.2, 2, sharex=True)
    sigma = [row["sigma"] for row in rows]
    ax = axes[0, 0]
    for name, color, label in (
        ("exact", report.COLORS["analytic"], "turned pixel - exact"),
        ("monte_carlo", report.COLORS["mip"], "turned pixel - Monte Carlo"),
        ("references", report.COLORS["point"], "Monte Carlo - exact"),
    ):
        ax.plot(sigma, [row[f"{name}_max"] for row in rows], color=color, label=f"{label}, maximum")
        ax.plot(sigma, [row[f"{name}_rms"] for row in rows], color=color, ls="--", label=f"{label}, RMS")
    ax.plot(
        sigma, [row["standard_error"] for row in rows], color="black", ls=":", label="standard error of Monte Carlo"
    )
    ax.set(yscale="log", xlabel="smaller standard deviation [px]", ylabel="absolute error of the weight")
    ax = axes[0, 1]
    ax.axhline(1, color="black", linewidth=0.9, linestyle=":")
    ax.plot(sigma, [row["z_rms"] for row in rows], color=report.COLORS["point"], marker="o", markersize=3)
    ax.set(ylim=(0, 2), xlabel="smaller standard deviation [px]")
    ax.set_ylabel("RMS of (Monte Carlo - exact) / standard error")
    for ax in axes[0]:
        report.plain_log_ticks(ax)
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside right center", frameon=False, fontsize=8)
    figure.suptitle("The pixel turned into the splat's frame, against two references", fontsize=11)
    return figure


def _plot_curves(axes, rows: list[dict], keys: list[str], relative: bool) -> None:
    """A curve of every footprint into each of the axes."""
    for ax, key in zip(axes.flat, keys):
        for footprint, of_name in _of_footprint(rows).items():
            look = {**report.style(footprint), "marker": None, "linewidth": 1.6}
            true = f"{key.rpartition('_')[0]}_true_rms"
            # Errors of zero have no logarithm: they are off the plot.
            values = [max(row[key] / (row[true] if relative else 1), 1e-16) for row in of_name]
            ax.plot([row["sigma"] for row in of_name], values, label=footprint, **look)
        ax.set_yscale("log")
        report.plain_log_ticks(ax)


def _plot_weight(rows: list[dict]):
    figure, axes = report.new_figure(13, 5.2, 2, sharex=True, sharey=True)
    _plot_curves(axes, _of_weight(rows), ["weight_max", "weight_rms"], relative=False)
    for ax, title in zip(axes[0], ("maximum", "RMS")):
        ax.set(ylim=(1e-10, 1.5), xlabel="smaller standard deviation [px]", ylabel=f"{title} error of the weight")
    return _finish(figure, axes, "Weight of a splat of peak 1 against the exact integral")


def _plot_gradients(rows: list[dict]):
    figure, axes = report.new_figure(13, 9, 2, 2, sharex=True, sharey=True)
    keys = [f"{name}_{kind}" for name in GRADIENTS for kind in ("max", "rms")]
    _plot_curves(axes, rows, keys, relative=True)
    labels = [f"{kind} error of {name}" for name in GRADIENTS.values() for kind in ("maximum", "RMS")]
    for ax, label in zip(axes.flat, labels):
        ax.set(ylim=(1e-9, 1e4), ylabel=f"{label}, relative")
    for ax in axes[1]:
        ax.set_xlabel("smaller standard deviation [px]")
    return _finish(figure, axes, "Gradients against those of the exact integral, relative to their RMS")


def _finish(figure, axes, title: str):
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside right center", frameon=False, fontsize=9)
    figure.suptitle(f"{title}; anisotropy 1 to {RATIO:.0f}", fontsize=11)
    return figure
