"""Accuracy against time: errors, split, reference and front against independent computations."""

import json
import math
import sys
import time

import numpy as np
import pytest
import torch
from cli_extra import image
from commands import refused, words_of
from gaussians import of_inputs
from places import SHARED

import analytic_rasterizer as ar
import demo
from analytic_rasterizer import cli, io
from analytic_rasterizer.analysis import pareto, reference, tables, timing

pytest.importorskip("torchmetrics", reason="needs the analysis extra")
pytest.importorskip("matplotlib", reason="needs the analysis extra")

METHODS = ["analytic", "mip", "box:samples=1", "box:samples=4", "point:dilation=0@2"]
PAPER = demo.PAPER
SIZE = (97, 65)  # not a multiple of 2


def target(width=SIZE[0], height=SIZE[1]):
    """(scene, views): the demo's target, small, and a view of it that is off centre."""
    scene, view = demo.make_target()
    focal = view.fx * width / view.width
    straight = io.View("straight", width, height, focal, focal, view.w2c)
    return scene, [straight, io.View("shifted", width - 8, height - 4, focal, focal, view.w2c, cx=30.0, cy=40.0)]


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    """(folder, results) of two scales."""
    out = tmp_path_factory.mktemp("pareto")
    scene, views = target()
    methods = [pareto.parse_method(text) for text in METHODS]
    torch.set_num_threads(1)
    return out, pareto.run(out, scene, views, [1, 2], methods, background=PAPER, rounds=1, name="target")


def rendered(scene, view, footprint):
    settings = view.settings(1, PAPER, 0, footprint)
    return ar.render_stages(settings, **scene.arguments()).color.double()


# ------------------------------------------------------------------------------------ methods


def test_methods_cover_every_footprint():
    methods = pareto.default_methods()
    names = [method.name for method in methods]
    assert {method.footprint.partition(":")[0] for method in methods} == set(ar.FOOTPRINTS)
    assert [name for name in names if "box" in name] == [f"box:samples={n}" for n in (1, 4, 16)]
    for n in (2, 3, 4):
        assert {f"point@{n}", f"point:dilation=0@{n}"} <= set(names)
    assert len(set(names)) == len(names)


@pytest.mark.parametrize(
    ("text", "footprint", "factor", "single"),
    [
        ("mip", "mip", 1, True),
        ("box:samples=1", "box:samples=1", 1, True),
        ("box", "box", 1, False),
        ("point:dilation=0@3", "point:dilation=0", 3, False),
        ("mip@1", "mip", 1, True),
    ],
)
def test_method_of_a_text(text, footprint, factor, single):
    method = pareto.parse_method(text)
    assert (method.footprint, method.supersampling, method.has_single_weight) == (footprint, factor, single)


@pytest.mark.parametrize("text", ["mip@", "mip@0", "mip@-2", "mip@1.5", "mip@x"])
def test_bad_supersampling(text):
    with pytest.raises(ValueError, match="supersampling must be a positive whole number"):
        pareto.parse_method(text)


def test_supersampled_case_averages_the_large_picture():
    scene, (view, _) = target()
    case = timing.Case(scene, view, "mip", 3, PAPER)
    large = rendered(scene, io.View("x", 3 * 97, 3 * 65, 3 * view.fx, 3 * view.fy, view.w2c), "mip")
    expected = large.reshape(3, 65, 3, 97, 3).mean((2, 4))
    assert (case.forward() - expected).abs().max() < 1e-6
    color, *gradients = case.forward_backward()
    assert color.shape == (3, 65, 97)
    # The same as spreading the adjoint of a pixel over the nine that it averages.
    inputs = {name: value.clone().requires_grad_() for name, value in scene.arguments().items()}
    settings = view.settings(3, PAPER, 0, "mip")
    color, _ = ar.GaussianRasterizer(settings)(means2D=None, **inputs)
    spread = case.dL_dcolor.repeat_interleave(3, 1).repeat_interleave(3, 2) / 9
    expected = torch.autograd.grad(color, list(inputs.values()), spread)
    for found, wanted in zip(gradients[: len(expected)], expected):
        assert (found - wanted).abs().max() <= 1e-5 * wanted.abs().max()


# -------------------------------------------------------------------------------------- views


def test_framed_view_has_pixels_of_the_scale():
    _, (view, shifted) = target()
    half = view.framed(2)
    assert (half.width, half.height) == (48, 32)  # of 97 x 65
    assert (half.fx, half.cx, half.cy) == (view.fx / 2, 97 / 4, 65 / 4)
    assert shifted.framed(2).cx == 15
    tiny = view.framed(1000)
    assert (tiny.width, tiny.height) == (1, 1)
    whole = view.framed(1, (500, 10))
    assert (whole.width, whole.height) == (97, 10)


@pytest.mark.parametrize("scale", [1, 2])
def test_crop_is_the_middle_of_the_picture(scale):
    scene, views = target()
    for view in views:
        whole = rendered(scene, view.framed(scale), "box")
        part = rendered(scene, view.framed(scale, (20, 11)), "box")
        top, left = (whole.shape[1] - 11) // 2, (whole.shape[2] - 20) // 2
        difference = (part - whole[:, top : top + 11, left : left + 20]).abs()
        assert difference.max() < 2 / 255  # a splat at the 1/255 cut
        assert difference.mean() < 1e-5


def test_remainder_of_a_scale_is_cut_off():
    """A pixel of the smaller picture is the mean of the pixels of the larger that it covers."""
    scene, (view, _) = target()
    large = reference.supersampled(scene, view, 8, background=PAPER)[:, :64, :96]
    small = reference.supersampled(scene, view.framed(2), 16, background=PAPER)
    assert (small - large.reshape(3, 32, 2, 48, 2).mean((2, 4))).abs().mean() < 1e-5


# ------------------------------------------------------------------------------------ results


def test_errors_by_hand(measured):
    _, results = measured
    scene, views = target()
    small = [view.framed(2) for view in views]
    assert [at["scale"] for at in results["scales"]] == [1, 2]
    at_scale = results["scales"][1]
    assert at_scale["sizes"] == [[48, 32], [44, 30]]
    density = at_scale["reference"]["density"]
    truth = [reference.supersampled(scene, view, density, background=PAPER).numpy() for view in small]
    for row in at_scale["methods"]:
        if row["supersampling"] > 1:
            continue
        pictures = [rendered(scene, view, row["method"]).numpy() for view in small]
        error = np.concatenate([(p - t).ravel() for p, t in zip(pictures, truth)])
        assert row["rmse"] == pytest.approx(np.sqrt((error**2).mean()), rel=1e-4)
        assert row["psnr"] == pytest.approx(10 * np.log10(1 / (error**2).mean()), rel=1e-4)
        assert row["bias"] == pytest.approx(error.mean(), rel=1e-3, abs=1e-7)
        assert row["max"] == pytest.approx(np.abs(error).max(), rel=1e-4)
        assert row["p999"] == pytest.approx(np.quantile(np.abs(error), 0.999, method="inverted_cdf"), rel=1e-4)
        assert row["ssim"] == pytest.approx(np.mean([ssim(p, t) for p, t in zip(pictures, truth)]), abs=1e-5)
        for view, picture, true in zip(views, pictures, truth):
            rmse = math.sqrt(((picture - true) ** 2).mean())
            assert row["per_view"][view.name]["rmse"] == pytest.approx(rmse, rel=1e-4)


def ssim(left, right):
    """Structural similarity [Wang et al. 2004]: Gaussian windows of 1.5 px, 11 px wide, the border mirrored."""
    taps = np.exp(-((np.arange(11) - 5) ** 2) / 4.5)
    kernel = torch.tensor(np.outer(taps, taps) / taps.sum() ** 2)[None, None]

    def local(values):
        mirrored = np.pad(values, ((0, 0), (5, 5), (5, 5)), mode="reflect")
        return torch.nn.functional.conv2d(torch.tensor(mirrored)[:, None], kernel)

    a, b = local(left), local(right)
    aa, bb, ab = local(left * left) - a * a, local(right * right) - b * b, local(left * right) - a * b
    c1, c2 = 0.01**2, 0.03**2
    values = (2 * a * b + c1) * (2 * ab + c2) / ((a * a + b * b + c1) * (aa + bb + c2))
    return values.mean().item()


def test_split_into_weight_and_blending_is_consistent(measured):
    _, results = measured
    scene, views = target()
    pictures = {name: [rendered(scene, view, name) for view in views] for name in ("mip", "exact")}
    expected = torch.cat([(a - b).flatten() for a, b in zip(*pictures.values())]).square().mean().sqrt().item()
    for at_scale in results["scales"]:
        split = {row["method"]: row for row in at_scale["methods"]}
        floors = set()
        for name, row in split.items():
            if name in ("box:samples=4", "point:dilation=0@2"):
                assert row["weight_rmse"] is row["blending_rmse"] is row["correlation"] is None
                continue
            weight, blending = row["weight_rmse"], row["blending_rmse"]
            whole = weight**2 + blending**2 + 2 * row["correlation"] * weight * blending
            assert whole == pytest.approx(row["rmse"] ** 2, rel=1e-9)
            assert -1 <= row["correlation"] <= 1
            floors.add(blending)
        assert len(floors) == 1
    assert results["scales"][0]["methods"][1]["weight_rmse"] == pytest.approx(expected, rel=1e-4)


def test_reference_is_converged(measured):
    _, results = measured
    for at_scale in results["scales"]:
        reference = at_scale["reference"]
        smallest = min(row["rmse"] for row in at_scale["methods"])
        assert reference["residual"]["rmse"] <= 0.1 * smallest
        assert reference["second_estimate"]["rmse"] <= 0.1 * smallest
        assert all(row["resolved"] for row in at_scale["methods"])
        residuals = list(reference["residual_rmse"].values())
        assert reference["residual"]["rmse"] == pytest.approx(residuals[-1])
        assert reference["order"] == pytest.approx(math.log2(residuals[-2] / residuals[-1]))
        assert reference["expected_rmse"] == pytest.approx(residuals[-1] / (2 ** reference["order"] - 1))
        assert not any("~" in line for line in pareto.describe(results, at_scale))


def test_coarse_reference_is_called_unresolved(tmp_path):
    scene, views = target()
    methods = [pareto.parse_method(text) for text in ("point", "point:dilation=0@4")]
    results = pareto.run(tmp_path, scene, views[:1], [2], methods, background=PAPER, rounds=1, max_density=8)
    (at_scale,) = results["scales"]
    dilated, fine = at_scale["methods"]
    assert at_scale["reference"]["density"] == 8
    assert at_scale["reference"]["order"] is None  # one residual has no order
    assert dilated["resolved"]
    assert not fine["resolved"]
    assert pareto.describe(results, at_scale)[-1].startswith("~ not converged")
    assert pareto.describe(results, at_scale)[-1].endswith("uncertain: point:dilation=0@4")
    assert [row[1][0] == "~" for row in pareto.to_table(results, at_scale)[1]] == [False, True]
    assert dilated["weight_rmse"] is not None


def test_ranking_is_that_of_the_demo(measured):
    _, results = measured
    psnr = {row["method"]: row["psnr"] for row in results["scales"][0]["methods"]}
    assert psnr["box:samples=4"] > max(psnr["analytic"], psnr["mip"], psnr["box:samples=1"]) + 2


def test_front_by_hand():
    points = [(1.0, 5.0), (2.0, 3.0), (2.5, 3.0), (3.0, 4.0), (4.0, 1.0), (4.0, 1.0), (1.0, 6.0)]
    assert pareto.pareto_front(points) == [True, True, False, False, True, True, False]


def test_times_are_those_of_the_fastest_round_in_turn(monkeypatch):
    scene, views = target()
    cases = {name: [timing.Case(scene, view, name) for view in views] for name in ("mip", "analytic")}
    calls = []

    def clock(call, timer):
        assert timer is time.process_time
        case = call.__self__
        name, second_view = case.settings.footprint.name, case.settings.image_width != SIZE[0]
        calls.append((name, second_view, call.__name__))
        round_ = (len(calls) - 1) // 8  # two methods, two views, two passes
        slower = (0.1, 4.0, 1.0, 1.05, 9.0)[round_]  # the first, which warms up, does not count
        seconds = slower * {"mip": 1.0, "analytic": 3.0}[name] * (3.0 if second_view else 1.0)
        return seconds * (5.0 if call.__name__ == "forward_backward" else 1.0)

    monkeypatch.setattr(timing, "seconds_of", clock)
    times = pareto._times(cases, 4, "mip", time.process_time)
    assert len(calls) == 5 * 8
    assert [name for name, *_ in calls[:8]] == ["mip"] * 4 + ["analytic"] * 4
    assert times["mip"]["forward_seconds"] == 2  # mean of views of 1 and 3 s
    assert times["mip"]["forward_usual_seconds"] == pytest.approx(2 * 2.525)  # median of 4, 1, 1.05, 9
    assert times["analytic"]["forward_backward_seconds"] == 30
    assert [times[name]["forward_ratio"] for name in times] == [1, 3]
    assert times["analytic"]["forward_usual_ratio"] == pytest.approx(3 * 2.525)


def test_time_is_what_the_clock_says_before_and_after_a_call():
    now = [3.0]
    assert timing.seconds_of(lambda: now.append(5.5), lambda: now[-1]) == 2.5


def timed(monkeypatch, seconds, rounds, base="base", device="cpu", **options):
    """Samples of calls by key, whose times are taken from lists, the last for good; and how many calls there were."""
    taken = {key: iter([*of_key, *[of_key[-1]] * 99]) for key, of_key in seconds.items()}
    counts = dict.fromkeys(seconds, 0)

    def clock(call, *_):
        counts[call] += 1
        return next(taken[call])

    monkeypatch.setattr(timing, "seconds_of", clock)
    monkeypatch.setattr(timing, "event_seconds", clock)
    monkeypatch.setattr(timing, "warm_up_cuda", lambda calls, passes: None)
    samples = timing.time_calls({key: [key] for key in seconds}, device, rounds, base=base, **options)
    return {key: timing.best_of(of_key[0], device) for key, of_key in samples.items()}, counts


def test_slow_calls_are_timed_twice(monkeypatch):
    best, counts = timed(monkeypatch, {"base": [1.0], "slow": [timing.SLOW + 1.0]}, 5)
    assert counts == {"base": 6, "slow": 2}
    assert best["slow"] == timing.SLOW + 1


@pytest.mark.parametrize(("patience", "calls", "best"), [(11.0, 3, 2.0), (5.0, 2, 3.0), (0.1, 2, 3.0), (99.0, 6, 1.0)])
def test_patience_takes_rounds_away(monkeypatch, patience, calls, best):
    """Rounds of 4 s: two, one, at least one, all five. Of fewer than two the one that warms up counts."""
    found, counts = timed(monkeypatch, {"base": [1.0], "other": [3.0, 4.0, 2.0, 1.0]}, 5, patience=patience)
    assert counts == {"base": calls, "other": calls} and found == {"base": 1.0, "other": best}


@pytest.mark.parametrize(
    ("device", "seconds", "expected"),
    [
        ("cpu", [99.0, 1.0, 1.0], 1.0),  # of a call that is not slow, the round that warms up
        ("cpu", [1.0, 50.0, 1.0, 1.0], 1.0),
        ("cpu", [1.0, 9.0, 7.0, 5.0, 1.0, 1.02], 1.0),  # all of the rounds: more are taken
        ("cpu", [3.0, 9.0, 2.0, 5.0, 1.0, 1.02], 1.0),
        ("cuda", [1.0, 9.0, 1.0, 1.0, 1.0, 1.0], 1.0),
        ("cuda", [9.0, 9.0, 5.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0], 1.0),
    ],
)
def test_a_hiccup_is_no_result(monkeypatch, device, seconds, expected):
    best, counts = timed(monkeypatch, {"base": [1.0], "other": seconds}, 3, device=device)
    assert best == {"base": 1.0, "other": pytest.approx(expected)}
    assert counts["base"] == (4 if device == "cpu" else 3)


def test_a_machine_that_never_rests_is_given_up(monkeypatch):
    _, counts = timed(monkeypatch, {"base": [1.0], "other": [2.0**i for i in range(99)]}, 3)
    assert counts["other"] == 1 + 3 + timing.MORE * 3


def test_files_of_a_run(measured):
    out, results = measured
    assert json.loads((out / "pareto.json").read_text()) == results
    assert sorted(path.name for path in out.iterdir()) == sorted(
        ["pareto.json", "pareto.md", *(f"pareto_{n}.{kind}" for n in (1, 2) for kind in ("png", "svg"))]
    )
    text = (out / "pareto.md").read_text()
    for at_scale in results["scales"]:
        assert (np.asarray(image.open(out / f"pareto_{at_scale['scale']}.png").convert("L")) < 128).mean() > 0.002
        header, rows = pareto.to_table(results, at_scale)
        assert tables.markdown_table(header, rows) in text
        assert [row[0] for row in rows] == METHODS
        assert all(len(row) == len(header) for row in rows)
        assert any("F" in str(row[-1]) for row in rows)
    base = next(row for row in results["scales"][0]["methods"] if row["method"] == "box:samples=1")
    assert base["forward_ratio"] == base["forward_backward_ratio"] == 1
    assert results["base"] == "box:samples=1"


def test_small_pictures_have_no_ssim(tmp_path):
    scene, views = target()
    methods = [pareto.parse_method("mip")]
    results = pareto.run(tmp_path, scene, views[:1], [1], methods, crop=(10, 8), rounds=1, max_density=8)
    (row,) = results["scales"][0]["methods"]
    assert row["ssim"] is None
    assert results["base"] == "mip"
    assert pareto.to_table(results, results["scales"][0])[1][0][6] is None


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"views": []}, "views must be given, and each once, got none"),
        ({"scales": [2, 2]}, "scales must be given, and each once, got 2, 2"),
        ({"methods": ["mip", "mip@1"]}, "methods must be given, and each once, got mip, mip"),
    ],
)
def test_nothing_is_measured_twice(tmp_path, changed, message):
    scene, views = target()
    given = {"views": views, "scales": [1], "methods": ["mip"]} | changed
    methods = [pareto.parse_method(text) for text in given["methods"]]
    with pytest.raises(ValueError, match=message):
        pareto.run(tmp_path, scene, given["views"], given["scales"], methods)
    assert list(tmp_path.iterdir()) == []


# -------------------------------------------------------------------------------- the command


@pytest.fixture
def files(tmp_path):
    scene, views = target()
    io.save_scene(tmp_path / "scene.ply", scene)
    io.save_views(tmp_path / "views.json", views)
    return tmp_path


def arguments(files, *extra):
    scene, views, out = files / "scene.ply", files / "views.json", files / "out"
    return words_of("pareto", scene, "--views", views, "--out", out, "--device cpu", *extra)


def test_command_prints_a_table_for_every_scale(files, capsys):
    extra = "--scales 2,4 --footprints box:samples=1 mip@2 --limit-views 1 --background 1 1 1 --cpu-time"
    assert cli.main(arguments(files, extra, "--crop 30 20 --rounds 1 --max-density 8")) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("10991 Gaussians of SH degree 0")
    assert "scale 1/2, 1 view of 30 x 20" in lines
    assert "scale 1/4, 1 view of 24 x 16" in lines
    assert sum(line.startswith("mip@2 ") for line in lines) == 2
    results = json.loads((files / "out" / "pareto.json").read_text())
    assert (results["views"], results["crop"], results["rounds"]) == (["straight"], [30, 20], 1)
    assert results["background"] == [1, 1, 1]
    assert results["clock"] == "CPU time"
    assert any("ms of CPU time; the fastest of 1 rounds" in line for line in lines)
    assert results["scene"] == "scene"


@pytest.mark.parametrize(
    ("extra", "message"),
    [
        ("--footprints circle", "circle"),
        ("--footprints box:samples=3@2", "samples"),
        ("--footprints mip@two", "supersampling must be a positive whole number, got 'two' in 'mip@two'"),
        ("--footprints mip mip", "methods must be given, and each once"),
        ("--scales 0", "argument --scales: must be reductions, positive whole numbers (2 is half the size), with"),
        ("--scales 1.5", "with commas between them, got 1.5"),
        ("--scales 1 2", "unrecognized arguments: 2; lists have commas and no spaces: 1,2,4"),
        ("--crop 20", "argument --crop: expected 2 arguments"),
        ("--max-density 4", "argument --max-density: must be a whole number from 8, got 4"),
        ("--limit-views 0", "must be a positive whole number, got 0"),
    ],
)
def test_errors_are_one_line(files, capsys, extra, message):
    assert message in refused(capsys, cli.main, arguments(files, extra), prints=False)


@pytest.mark.parametrize("module", ["torchmetrics.functional.image", "matplotlib.figure"])
def test_missing_library_names_the_extra(files, capsys, monkeypatch, module):
    monkeypatch.setitem(sys.modules, module, None)
    assert cli.main(arguments(files)) == 2
    assert 'pip install "analytic_rasterizer[analysis]"' in capsys.readouterr().err


def test_trained_scene(tmp_path, plant):
    """Four samples go beyond what one weight per splat can, on a scene that was not made for it."""
    inputs, _ = plant
    scene = of_inputs(inputs)
    views = io.load_views(SHARED / "data" / "plant_sh3_lo.json")
    methods = [pareto.parse_method(text) for text in ("analytic", "box:samples=1", "box:samples=4")]
    results = pareto.run(tmp_path, scene, views[:1], [1], methods, crop=(96, 64), rounds=1)
    rows = {row["method"]: row for row in results["scales"][0]["methods"]}
    assert all(row["resolved"] for row in rows.values())
    assert rows["box:samples=4"]["psnr"] > rows["analytic"]["psnr"] + 8
    assert abs(rows["box:samples=1"]["psnr"] - rows["analytic"]["psnr"]) < 3
