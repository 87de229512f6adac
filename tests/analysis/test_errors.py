"""benchmarks/paper_errors.py, the error analysis: its numbers against independent ones, its files, and how it fails."""

import csv
import math
import sys

import numpy as np
import pytest
import reference
import torch
from cli_extra import image
from commands import refused
from places import ROOT

import analytic_rasterizer as ar
from analytic_rasterizer.analysis import tables

sys.path.append(str(ROOT / "benchmarks"))
import paper_errors
from paper import errors

pytest.importorskip("matplotlib", reason="needs the analysis extra")


def erf_weight(offset, cov2d):
    return reference.rotated_window(offset, cov2d, "frozen", reference.normal_window, reference.normal_pdf)


FORMULAS = {"exact": reference.exact_weight, "erf": erf_weight}


@pytest.mark.parametrize("name", FORMULAS)
def test_footprints_of_the_analysis_are_the_suites_formulas(name):
    for sigma in (0.02, 0.3, 3.0):
        offset, cov2d = errors._splats(errors._unit_samples(128), sigma, blur=1 / 12)
        expected = FORMULAS[name](offset, cov2d)
        assert (ar.footprint_weight(offset, cov2d, name) - expected).abs().max() < 1e-9
        gradients = []
        for function in (FORMULAS[name], lambda d, c: ar.footprint_weight(d, c, name)):
            inputs = offset.clone().requires_grad_(), cov2d.clone().requires_grad_()
            gradients.append(torch.autograd.grad(function(*inputs).sum(), inputs))
        for wanted, found in zip(*gradients):
            assert (found - wanted).abs().max() < 1e-6 * wanted.abs().max()


# ------------------------------------------------------------------------------- (a) one axis


def test_window_errors_against_the_standard_library():
    rows = errors.window_errors(sigmas=5, offsets=41)
    assert [row["sigma"] for row in rows] == pytest.approx([0.3 * 22 ** (i / 4) for i in range(5)])
    for row in rows:
        sigma, found = row["sigma"], []
        for i in range(41):
            x = (-3 + 6 * i / 40) * sigma
            edges = ((x - 0.5) / sigma, (x + 0.5) / sigma)
            low, high = (1 / (1 + math.exp(-1.6 * z - 0.07 * z**3)) for z in edges)
            true = (math.erf(edges[1] / math.sqrt(2)) - math.erf(edges[0] / math.sqrt(2))) / 2
            found.append(abs(high - low - true))
        assert row["window_max"] == pytest.approx(max(found), rel=1e-9)
        assert row["window_rms"] == pytest.approx(math.sqrt(sum(e * e for e in found) / 41), rel=1e-9)
        assert row["weight_max"] == pytest.approx(max(found) * sigma * math.sqrt(2 * math.pi), rel=1e-9)


def test_window_error_of_a_wide_splat_is_the_slope_at_its_centre():
    """S'(0) = 1.6/4 stands for 1/sqrt(2 pi), whatever the deviation: an error that never falls."""
    widest = errors.window_errors()[-1]
    assert widest["weight_max"] == pytest.approx(1.6 / 4 * math.sqrt(2 * math.pi) - 1, rel=0.02)


def test_window_is_that_of_the_analytic_footprint():
    s1, s2, x, y = 0.9, 0.4, 0.7, -0.3
    cov2d = torch.tensor([s1**2, 0.0, s2**2], dtype=torch.float64)
    found = ar.footprint_weight(torch.tensor([x, y], dtype=torch.float64), cov2d, "analytic").item()

    def window(u, sigma):
        low, high = errors.logistic_cdf(
            torch.tensor([(u - 0.5) / sigma, (u + 0.5) / sigma], dtype=torch.float64)
        ).tolist()
        return high - low

    assert found == pytest.approx(2 * math.pi * s1 * s2 * window(x, s1) * window(y, s2), rel=1e-12)


# ------------------------------------------------------------------------------- (b) rotation


def test_the_two_references_agree_within_the_monte_carlo_error():
    rows = errors.rotation_errors(samples=32, monte_carlo=4096, sigmas=8)
    z = math.sqrt(sum(row["z_rms"] ** 2 for row in rows) / len(rows))
    assert 0.85 < z < 1.15  # of 256 splats; the standard deviation of this number is about 0.05
    for row in rows:
        assert row["references_rms"] == pytest.approx(row["standard_error_rms"], rel=0.7)
    turned = [row["exact_max"] for row in rows]
    assert turned == sorted(turned, reverse=True)


def test_a_wrong_reference_is_noticed(monkeypatch):
    right = ar.footprint_weight
    wrong = lambda d, c, name: right(d, c, name) * (1.02 if name == "exact" else 1.0)  # noqa: E731
    monkeypatch.setattr(errors, "footprint_weight", wrong)
    rows = errors.rotation_errors(samples=32, monte_carlo=4096, sigmas=4)
    assert max(row["z_rms"] for row in rows) > 2


def test_rotation_errors_are_those_of_the_splats():
    row = errors.rotation_errors(samples=16, monte_carlo=64, sigmas=3)[0]
    offset, cov2d = errors._splats(errors._unit_samples(16), 0.3, blur=0.0)
    difference = (erf_weight(offset, cov2d) - reference.exact_weight(offset, cov2d)).abs()
    assert row["exact_max"] == pytest.approx(difference.max().item(), rel=1e-6)
    assert row["exact_rms"] == pytest.approx(difference.square().mean().sqrt().item(), rel=1e-6)


# ----------------------------------------------------------------------------- (c) footprints


def test_splats_are_what_they_are_said_to_be():
    offset, cov2d = errors._splats(errors._unit_samples(512), 0.5, blur=0.25)
    values = torch.linalg.eigvalsh(errors._matrix(cov2d))
    torch.testing.assert_close(values[:, 0], torch.full((512,), 0.25, dtype=torch.float64), rtol=1e-9, atol=0)
    ratio = (values[:, 1] / values[:, 0]).sqrt()
    assert 1 <= ratio.min() < 1.1
    assert 90 < ratio.max() <= 100
    blurred = reference.add_variance(cov2d, 0.25)
    q = reference.quadratic(offset, blurred).sqrt()
    assert 2.9 < q.max() <= 3 + 1e-9
    assert (q < 1.5).double().mean().item() == pytest.approx(0.25, abs=0.03)  # uniform in area


def test_errors_of_a_footprint_by_hand():
    rows = errors.footprint_errors(["cumulant"], samples=64)
    row = rows[10]
    assert row["sigma"] == pytest.approx(0.2)
    offset, cov2d = errors._splats(errors._unit_samples(64), row["sigma"], blur=1 / 12)
    error = reference.cumulant(offset, cov2d) - reference.exact_weight(offset, cov2d)
    assert row["weight_max"] == pytest.approx(error.abs().max().item(), rel=1e-6)
    assert row["weight_rms"] == pytest.approx(error.square().mean().sqrt().item(), rel=1e-6)
    step = 1e-5
    shift = torch.eye(2, dtype=torch.float64) * step

    def slope(function):
        return torch.stack([(function(offset + s, cov2d) - function(offset - s, cov2d)) / (2 * step) for s in shift], 1)

    error = (slope(reference.cumulant) - slope(reference.exact_weight)).norm(dim=1)
    assert row["offset_max"] == pytest.approx(error.max().item(), rel=1e-4)
    true = slope(reference.exact_weight).norm(dim=1)
    assert row["offset_relative_max"] == pytest.approx(row["offset_max"] / true.square().mean().sqrt().item(), rel=1e-4)


def test_whitened_gradient_is_the_derivative_along_relative_changes():
    """Sigma -> L (1 + t H) L^T changes I by t trace(L^T G L H), for any symmetric H."""
    offset, cov2d = errors._splats(errors._unit_samples(32), 0.4, blur=1 / 12)
    _, _, gradient = errors._weight_and_gradients(offset, cov2d, "cumulant")
    factor = torch.linalg.cholesky(errors._matrix(cov2d))
    for entries in ([1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.3, -0.7, 2.0]):
        direction = errors._matrix(torch.tensor(entries, dtype=torch.float64))
        change = factor @ direction @ factor.mT * 1e-6
        change = torch.stack([change[:, 0, 0], change[:, 0, 1], change[:, 1, 1]], -1)
        up, down = (ar.footprint_weight(offset, cov2d + s * change, "cumulant") for s in (1, -1))
        expected = (gradient @ direction).diagonal(dim1=1, dim2=2).sum(1)
        torch.testing.assert_close((up - down) / 2e-6, expected, rtol=1e-5, atol=1e-8)


def test_the_truth_has_no_error_and_cases_cover_the_footprints():
    for row in errors.footprint_errors(["exact"], samples=8):
        assert row["weight_max"] == row["offset_max"] == row["cov2d_max"] == 0
    named = {case.partition(":")[0] for case in errors.all_cases()}
    assert named == set(ar.FOOTPRINTS) - {"exact"}


# ---------------------------------------------------------------------------------- reporting


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """(folder, results) of a run on few splats."""
    out = tmp_path_factory.mktemp("errors")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(errors, "all_cases", lambda: ["point", "analytic", errors.PAPER_GRADIENT, "cumulant"])
        patch.setattr(errors, "ROTATION_SAMPLES", 4)
        return out, errors.run(out, samples=32, monte_carlo=128)


def test_files_of_a_run(small):
    out, results = small
    for name in ("window", "rotation", "footprints"):
        with (out / f"{name}.csv").open(newline="") as file:
            written = list(csv.DictReader(file))
        assert len(written) == len(results[name])
        for row, expected in zip(written, results[name]):
            assert {key: type(expected[key])(value) for key, value in row.items()} == expected
    for name in ("window", "rotation", "footprints_weight", "footprints_gradient"):
        picture = np.asarray(image.open(out / f"{name}.png").convert("L"))
        assert (picture < 128).mean() > 0.002  # something is drawn
        assert (out / f"{name}.svg").read_text().startswith("<?xml")
    assert (out / "summary.md").read_text() == results["summary"]
    rows = results["footprints"]
    assert len(rows) == 4 * 31
    assert [rows[0]["sigma"], rows[30]["sigma"]] == pytest.approx([0.02, 20])


def test_summary_says_from_where_on_an_error_stays_small(small):
    _, results = small
    table = results["summary"].partition("stays below:")[2].splitlines()
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in table if "|" in line]
    cells = {name: row for name, *row in rows}
    assert cells["footprint"] == ["1e-02", "1e-03", "1e-04"]
    assert set(cells) == {"footprint", "---", "point", "analytic", "cumulant"}
    assert cells["analytic"][1:] == ["> 20", "> 20"]
    for row in results["footprints"]:
        if row["footprint"] == "cumulant" and row["sigma"] > 0.99 * float(cells["cumulant"][1]):
            assert row["weight_max"] <= 1e-3


def test_plots_are_the_same_every_time(tmp_path):
    rows = errors.window_errors(sigmas=5, offsets=41)
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        lines = [("a", rows, "window_", tables.style("mip"))]
        tables.save_figure(errors._figure("title", {"max": "y", "rms": "y"}, lines), tmp_path / name, "window")
    for suffix in ("png", "svg"):
        first, second = (tmp_path / name / f"window.{suffix}" for name in ("a", "b"))
        assert first.read_bytes() == second.read_bytes()


def test_the_program_prints_the_summary(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(errors, "_figures", lambda results: {})  # those of `small`
    monkeypatch.setattr(errors, "all_cases", lambda: ["cumulant"])
    monkeypatch.setattr(errors, "ROTATION_SAMPLES", 2)
    out = tmp_path / "new"
    assert paper_errors.main(["--out", str(out), "--samples", "8", "--monte-carlo", "64"]) == 0
    printed = capsys.readouterr().out
    assert printed.startswith((out / "summary.md").read_text())
    assert "8 splats of each sigma" in printed


@pytest.mark.parametrize("module", ["matplotlib.figure", "tqdm"])
def test_missing_library_names_the_extra(monkeypatch, tmp_path, capsys, module):
    monkeypatch.setitem(sys.modules, module, None)
    assert paper_errors.main(["--out", str(tmp_path)]) == 2
    assert 'pip install "analytic_rasterizer[analysis]"' in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("args", "message"),
    [
        ([], "the following arguments are required: --out"),
        (["--out", ".", "--samples", "0"], "--samples: must be a positive whole number, got 0"),
        (["--out", ".", "--monte-carlo", "x"], "--monte-carlo: must be a positive whole number, got x"),
    ],
)
def test_wrong_arguments_are_one_line(args, message, capsys):
    assert message in refused(capsys, paper_errors.main, args)
