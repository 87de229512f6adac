"""The error of a pixel's weight: the paper's analysis [AS, Sec. 2.4], and the same for every footprint.

`run()` measures three things, in float64, and writes each as CSV and as plots:

- window: the paper's logistic window along one axis against the Gaussian's integral.
- rotation: the error of turning the pixel into the splat's eigenframe, against Monte Carlo integration as in the
  paper and against the exact integral.
- footprints: the weight of every footprint and its gradients, over rotations, anisotropies and offsets.

[AS] is the paper with its supplement, see docs/internals/numerics.md.
"""

from __future__ import annotations

import math
from pathlib import Path

import torch

from analytic_rasterizer.analysis import tables
from analytic_rasterizer.footprints import (
    EXACT,
    PAPER_GRADIENT,
    TURNED,
    UNFILTERED,
    footprint_variants,
    footprint_weight,
)
from analytic_rasterizer.io import optional_import, write_text

PAPER_SIGMAS = (0.3, 6.6)  # px, the range of [AS, Sec. 2.4]
SIGMAS = (0.02, 20.0)  # px, ours
PER_DECADE = 10
REACH = 3.0  # standard deviations: the paper's ||x|| < 3 sigma
RATIO = 100.0  # the largest anisotropy
SAMPLES = 4096  # splats of one standard deviation
MONTE_CARLO = 65536  # samples in a pixel, as in the paper
ROTATION_SAMPLES = 64  # splats of one standard deviation, each integrated by Monte Carlo
THRESHOLDS = (1e-2, 1e-3, 1e-4)
TABLE_SIGMAS = (0.02, 0.05, 0.1, 0.2, 0.3, 0.5, 1.0, 2.0, 5.0)
GRADIENTS = {"offset": "dI/d offset", "cov2d": "dI/d covariance"}


def run(out, samples: int = SAMPLES, monte_carlo: int = MONTE_CARLO) -> dict:
    """Measures all three and writes CSV, PNG and SVG files and summary.md to `out`, a folder that exists.

    Args:
        out: Folder.
        samples: Splats of each standard deviation, for the footprints. Maxima are over these splats, and so they are
            lower bounds.
        monte_carlo: Samples in a pixel.

    Returns:
        {"window": rows, "rotation": rows, "footprints": rows, "summary": Markdown}.

    Raises:
        ImportError: Without the `analysis` extra.
        ValueError: This build has no `exact` or `erf` footprint.
    """
    for module in ("matplotlib.figure", "tqdm"):
        optional_import(module, "analysis")  # raises before anything is measured
    results = {
        "window": window_errors(),
        "rotation": rotation_errors(ROTATION_SAMPLES, monte_carlo),
        "footprints": footprint_errors(all_cases(), samples),
    }
    out, summary = Path(out), summarize(results, samples, monte_carlo)
    for name, rows in results.items():
        tables.save_csv(out / f"{name}.csv", rows)
    for name, figure in _figures(results).items():
        tables.save_figure(figure, out, name)
    write_text(out / "summary.md", summary)
    return {**results, "summary": summary}


def all_cases() -> list[str]:
    """Every footprint that has a weight of its own, with the options that change the weight or its gradient."""
    cases = [case for case in footprint_variants() if case != EXACT]  # that is the truth
    return [*cases, UNFILTERED, PAPER_GRADIENT]


def logistic_cdf(x: torch.Tensor) -> torch.Tensor:
    """S(x), the paper's approximation of the normal CDF [AS, Eq. 5]."""
    return torch.sigmoid(1.6 * x + 0.07 * x**3)


def window_errors(sigmas: int = 200, offsets: int = 2001) -> list[dict]:
    """Errors of the window S((x + 1/2)/sigma) - S((x - 1/2)/sigma) [AS, Eq. 7] by standard deviation.

    `sigmas` standard deviations, log-uniform in PAPER_SIGMAS; `offsets` x, uniform in |x| <= 3 sigma. A row holds
    sigma, the maximum and RMS error of the window (the density integrated over the pixel), and the same times
    sqrt(2 pi) sigma: for a splat of peak 1, as the window enters its weight [AS, Eq. 8].
    """
    rows = []
    for sigma in _log_uniform(PAPER_SIGMAS, sigmas):
        x = sigma * torch.linspace(-REACH, REACH, offsets, dtype=torch.float64)
        high, low = (x + 0.5) / sigma, (x - 0.5) / sigma
        error = (logistic_cdf(high) - logistic_cdf(low)) - (torch.special.ndtr(high) - torch.special.ndtr(low))
        peak = math.sqrt(2 * math.pi) * sigma
        rows.append({"sigma": sigma} | _max_rms("window", error) | _max_rms("weight", peak * error))
    return rows


def rotation_errors(samples: int, monte_carlo: int, sigmas: int = 40) -> list[dict]:
    """Errors of integrating over the turned pixel, with the exact CDF (the footprint `erf`), by standard deviation.

    `sigmas` smaller standard deviations, log-uniform in PAPER_SIGMAS; for each `samples` splats: anisotropy
    log-uniform in 1 to RATIO, any rotation, offsets uniform in the ellipse of 3 sigma. References: the mean of
    `monte_carlo` uniform samples in the pixel, and `exact`. A row holds sigma, maximum and RMS of erf - exact
    (`exact_`), of erf - Monte Carlo (`monte_carlo_`) and of Monte Carlo - exact (`references_`), the RMS standard
    error of Monte Carlo, and z_rms, the RMS of (Monte Carlo - exact) over that standard error: 1 where the references
    agree. The standard error is not estimated but exact: the integrand's square is a splat with half the covariance.
    """
    random = torch.Generator().manual_seed(0)
    unit = _unit_samples(samples)
    rows = []
    for sigma in _log_uniform(PAPER_SIGMAS, sigmas):
        offset, cov2d = _splats(unit, sigma, blur=0.0)
        turned, exact = (footprint_weight(offset, cov2d, name) for name in (TURNED, EXACT))
        square = footprint_weight(offset, cov2d / 2, EXACT)
        standard_error = ((square - exact**2).clamp_min(0) / monte_carlo).sqrt()
        sampled = torch.empty_like(exact)
        for i, conic in enumerate(_matrix(cov2d).inverse()):
            d = offset[i] + torch.rand(monte_carlo, 2, generator=random, dtype=torch.float64) - 0.5
            sampled[i] = torch.exp(-(d @ conic * d).sum(1) / 2).mean()
        row = {"sigma": sigma} | _max_rms(EXACT, turned - exact) | _max_rms("monte_carlo", turned - sampled)
        row |= _max_rms("references", sampled - exact) | {"standard_error_rms": _rms(standard_error)}
        rows.append(row | {"z_rms": _rms((sampled - exact) / standard_error)})
    return rows


def footprint_errors(cases: list[str], samples: int) -> list[dict]:
    """Errors of the weight and its gradients against `exact`, by footprint and standard deviation.

    The smaller standard deviation is log-uniform in SIGMAS, PER_DECADE to a decade; for each `samples` splats, the
    same for every footprint: anisotropy log-uniform in 1 to RATIO, any rotation, offsets uniform in the 3 sigma
    ellipse of Sigma + I/12. A row holds maximum and RMS of the error of the weight I, and of the norm of the error of
    dI/d offset [1/px] and of dI/dSigma, whitened by Sigma: L^T (dI/dSigma) L with Sigma = L L^T, that is per relative
    change of Sigma; `_relative_` over the RMS norm of the exact value. The gradient is what autograd gives, which for
    `analytic` is not the derivative of the weight unless frame_gradient is "paper".
    """
    unit = _unit_samples(samples)
    sigmas = _log_uniform(SIGMAS, round(PER_DECADE * math.log10(SIGMAS[1] / SIGMAS[0])) + 1)
    splats = [_splats(unit, sigma, blur=1 / 12) for sigma in sigmas]
    truth = [_weight_and_gradients(*splat, EXACT) for splat in splats]
    rows = []
    for case in optional_import("tqdm", "analysis").tqdm(cases, desc="footprints", disable=None):
        for sigma, splat, exact in zip(sigmas, splats, truth):
            row = {"footprint": case, "sigma": sigma}
            for name, value, true in zip(("weight", *GRADIENTS), _weight_and_gradients(*splat, case), exact):
                error, size = (value - true).flatten(1).norm(dim=1), _rms(true.flatten(1).norm(dim=1))
                row |= _max_rms(name, error) | _max_rms(f"{name}_relative", error / size)
            rows.append(row)
    return rows


def _weight_and_gradients(offset: torch.Tensor, cov2d: torch.Tensor, footprint: str) -> list[torch.Tensor]:
    """Weight (n, 1), gradient with respect to the offset (n, 2), whitened one to the covariance (n, 2, 2)."""
    inputs = offset.clone().requires_grad_(), cov2d.clone().requires_grad_()
    weight = footprint_weight(*inputs, footprint)
    dL_doffset, dL_dcov2d = torch.autograd.grad(weight.sum(), inputs)
    factor = torch.linalg.cholesky(_matrix(cov2d))
    halved = dL_dcov2d * dL_dcov2d.new_tensor([1, 0.5, 1])  # xy stands for two entries of the matrix
    return [weight.detach()[:, None], dL_doffset, factor.mT @ _matrix(halved) @ factor]


def _unit_samples(count: int) -> torch.Tensor:
    """(count, 4) float64 in [0, 1): anisotropy, rotation, and offset in polar coordinates; always the same."""
    return torch.quasirandom.SobolEngine(4, scramble=True, seed=0).draw(count, dtype=torch.float64)


def _splats(unit: torch.Tensor, sigma: float, blur: float) -> tuple[torch.Tensor, torch.Tensor]:
    """(offset (n, 2) [px], cov2d (n, 3) [px^2]) of splats whose smaller standard deviation is sigma.

    Offsets are uniform in the ellipse of REACH standard deviations of Sigma + blur I.
    """
    ratio, turn, radius, angle = unit.unbind(-1)
    large, small = (sigma * RATIO**ratio) ** 2, torch.full_like(ratio, sigma**2)
    cos, sin = torch.cos(math.pi * turn), torch.sin(math.pi * turn)
    xx, yy = large * cos**2 + small * sin**2, large * sin**2 + small * cos**2
    reach = REACH * radius.sqrt()
    u = reach * (large + blur).sqrt() * torch.cos(2 * math.pi * angle)
    v = reach * (small + blur).sqrt() * torch.sin(2 * math.pi * angle)
    offset = torch.stack([cos * u - sin * v, sin * u + cos * v], -1)
    return offset, torch.stack([xx, (large - small) * cos * sin, yy], -1)


def _matrix(cov2d: torch.Tensor) -> torch.Tensor:
    """(..., 2, 2) of (..., 3) as (xx, xy, yy)."""
    return cov2d[..., [0, 1, 1, 2]].unflatten(-1, (2, 2))


def _log_uniform(limits: tuple[float, float], count: int) -> list[float]:
    low, high = map(math.log, limits)
    return torch.linspace(low, high, count, dtype=torch.float64).exp().tolist()


def _max_rms(name: str, error: torch.Tensor) -> dict[str, float]:
    return {f"{name}_max": error.abs().max().item(), f"{name}_rms": _rms(error)}


def _rms(error: torch.Tensor) -> float:
    return error.square().mean().sqrt().item()


def summarize(results: dict, samples: int, monte_carlo: int) -> str:
    """The tables, as Markdown."""
    window, rotation = results["window"], results["rotation"]
    worst, peak = (max(window, key=lambda row: row[key]) for key in ("window_max", "weight_max"))
    turned = max(rotation, key=lambda row: row["exact_max"])
    z = math.sqrt(sum(row["z_rms"] ** 2 for row in rotation) / len(rotation))
    low, high = PAPER_SIGMAS
    of_rotation = []
    for row in rotation[:: max(1, len(rotation) // 8)]:
        errors = [_max_rms_text(row, name) for name in (EXACT, "monte_carlo", "references")]
        of_rotation.append([f"{row['sigma']:.2f}", *errors, f"{row['z_rms']:.2f}"])
    header = ["sigma [px]", "against exact, max / RMS", f"against {monte_carlo} samples", "the two references", "z"]
    footprints, weights = _by_footprint(results["footprints"])
    parts = [
        "# Errors of the pixel's weight",
        f"## One axis: the logistic window, sigma in [{low}, {high}] px, |x| <= 3 sigma",
        f"Largest error of the window {worst['window_max']:.2e} (sigma {worst['sigma']:.2f}), of a splat of peak 1 "
        f"{peak['weight_max']:.2e} (sigma {peak['sigma']:.2f}).",
        f"## The pixel turned into the splat's frame, sigma in [{low}, {high}] px, anisotropy 1 to {RATIO:.0f}",
        tables.markdown_table(header, of_rotation),
        f"Largest error {turned['exact_max']:.2e} (sigma {turned['sigma']:.2f}). z is the RMS difference of the two "
        f"references over the standard error of Monte Carlo: {z:.3f} over all splats, 1 where they agree.",
        f"## Every footprint, {samples} splats of each sigma, anisotropy 1 to {RATIO:.0f}, any rotation, offset to "
        "3 standard deviations",
        "Error of the weight, max / RMS, by smaller standard deviation [px]:",
        _by_sigma(weights, lambda row: _max_rms_text(row, "weight")),
        "RMS error of dI/d offset, relative to the RMS of the exact one:",
        _by_sigma(footprints, lambda row: f"{row['offset_relative_rms']:.1e}"),
        "RMS error of dI/dSigma, whitened, relative to the RMS of the exact one:",
        _by_sigma(footprints, lambda row: f"{row['cov2d_relative_rms']:.1e}"),
        "Smallest standard deviation [px] from which on the worst error of the weight stays below:",
        tables.markdown_table(
            ["footprint", *(f"{threshold:.0e}" for threshold in THRESHOLDS)],
            [[name, *(_smallest_sigma(rows, t) for t in THRESHOLDS)] for name, rows in weights.items()],
        ),
        "Maxima are over the splats of the sample, and so they are lower bounds.",
    ]
    return "\n\n".join(parts) + "\n"


def _by_footprint(rows: list[dict]) -> tuple[dict[str, list[dict]], dict[str, list[dict]]]:
    """The rows of every footprint, and of those whose weight is their own: PAPER_GRADIENT has that of `analytic`."""
    by_footprint = {}
    for row in rows:
        by_footprint.setdefault(row["footprint"], []).append(row)
    return by_footprint, {name: of_name for name, of_name in by_footprint.items() if name != PAPER_GRADIENT}


def _max_rms_text(row: dict, name: str) -> str:
    return f"{row[f'{name}_max']:.1e} / {row[f'{name}_rms']:.1e}"


def _by_sigma(by_footprint: dict[str, list[dict]], text) -> str:
    """A table of `text(row)` at the deviations nearest to TABLE_SIGMAS."""
    sigmas = [row["sigma"] for row in next(iter(by_footprint.values()))]
    shown = [min(range(len(sigmas)), key=lambda i: abs(math.log(sigmas[i] / sigma))) for sigma in TABLE_SIGMAS]
    lines = [[name, *(text(rows[i]) for i in shown)] for name, rows in by_footprint.items()]
    return tables.markdown_table(["footprint", *(f"{sigmas[i]:.2g}" for i in shown)], lines)


def _smallest_sigma(rows: list[dict], threshold: float) -> str:
    """The deviation from which on the weight's error stays below the threshold."""
    above = max((row["sigma"] for row in rows if row["weight_max"] > threshold), default=0)
    later = [row["sigma"] for row in rows if row["sigma"] > above]
    return f"{'' if above else '<= '}{later[0]:.2g}" if later else f"> {SIGMAS[1]:.2g}"


def _figures(results: dict) -> dict:
    """The figures, by name."""
    columns = {"max": "maximum error", "rms": "RMS error"}
    window = {"density integrated over the pixel": "window_", "weight of a splat of peak 1": "weight_"}
    rotation = {"turned pixel - exact": "exact_", "turned pixel - Monte Carlo": "monte_carlo_"}
    rotation |= {"Monte Carlo - exact": "references_", "standard error of Monte Carlo": "standard_error_"}
    rotation["(Monte Carlo - exact) / standard error"] = "z_"

    def lines(kind: str, prefixes: dict[str, str]) -> list[tuple]:
        named = enumerate(prefixes.items())
        return [(label, results[kind], prefix, tables.line_style(i)) for i, (label, prefix) in named]

    footprints, weights = _by_footprint(results["footprints"])
    of_weight = [(name, rows, "weight_", tables.style(name)) for name, rows in weights.items()]
    of_gradients = [(name, rows, "", tables.style(name)) for name, rows in footprints.items()]
    gradients = {f"{of}_relative_{kind}": f"{columns[kind]} of {GRADIENTS[of]}" for of in GRADIENTS for kind in columns}
    frame = "The pixel turned into the splat's frame, against two references"
    relative = "Gradients against those of the exact integral, relative to their RMS"
    return {
        "window": _figure("The logistic window against erf", columns, lines("window", window)),
        "rotation": _figure(frame, columns, lines("rotation", rotation)),
        "footprints_weight": _figure("Weight of a splat of peak 1 against the exact integral", columns, of_weight),
        "footprints_gradient": _figure(relative, gradients, of_gradients),
    }


def _figure(title: str, columns: dict[str, str], lines: list[tuple]):
    """Axes for every column of the rows and its label; a line is its label, rows, prefix of the column, and style."""
    figure, axes = tables.new_figure(12, 0.6 + 2.2 * len(columns), 2, len(columns) // 2, sharex=True, sharey=True)
    for ax, (column, label) in zip(axes.flat, columns.items()):
        for name, rows, prefix, style in lines:
            if prefix + column in rows[0]:
                values = [max(row[prefix + column], 1e-16) for row in rows]  # zeros have no logarithm
                ax.plot([row["sigma"] for row in rows], values, **style | {"marker": None, "label": name})
        ax.set(yscale="log", ylabel=label)
    ax.set_ylim(bottom=max(ax.get_ylim()[0], 1e-10))
    tables.add_titles(figure, axes, title, "smaller standard deviation [px]")
    return figure
