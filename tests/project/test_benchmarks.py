"""The programs in benchmarks/ run, on a scene so small that their numbers mean nothing."""

import collections
import dataclasses
import importlib
import inspect
import json
import math
import os
import re
import shutil
import subprocess
import sys
import types
from typing import Any

import numpy as np
import originals
import pages
import pytest
import scenes
import torch
import wall
from capture_files import circle, write_nerf_synthetic
from places import ROOT
from processes import DEADLINE, python_path

import analytic_rasterizer as ar
from analytic_rasterizer import _C, io, training
from analytic_rasterizer.analysis.timing import added_memory
from analytic_rasterizer.dialects import DIALECTS
from analytic_rasterizer.dialects.gsplat import rasterization
from analytic_rasterizer.gaussians import Gaussians


@pytest.fixture(autouse=True)
def imports_of_benchmarks(monkeypatch):
    """benchmarks/ can be imported from."""
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))


@pytest.fixture
def run(monkeypatch, capsys):
    """A function that runs a program or the one of a name, which ends with `code`, and returns what it printed; run.err
    is what it said."""

    def run(program, *arguments, code=None):
        program = importlib.import_module(program) if isinstance(program, str) else program
        monkeypatch.setattr(sys, "argv", [f"{program.__name__}.py", *map(str, arguments)])
        assert program.main() == code
        out, run.err = capsys.readouterr()
        return out

    return run


def written(folder):
    """What a program wrote to out.json there."""
    return json.loads((folder / "out.json").read_text())


@pytest.fixture
def small_scene(tmp_path):
    """Files of a scene and of views."""
    made = scenes.cast(scenes.random_scene(3, 50, degree=1), torch.float32)
    fields = {"means": made["means3D"], **{k: made[k] for k in ("scales", "rotations", "opacities", "shs")}}
    importlib.import_module("scene_files").save_npz(tmp_path / "scene.npz", Gaussians.from_activated(**fields))
    camera = scenes.Camera().world_to_camera()
    io.save_views(tmp_path / "views.json", [io.View(name, 40, 30, 33.0, 30.0, camera, 21.0) for name in "ab"])
    return tmp_path


def files_of(folder):
    return [folder / "scene.npz", "--views", folder / "views.json", "--json", folder / "out.json"]


def test_effects(device, small_scene, run):
    """Every row, with numbers in all of its columns."""
    effects = importlib.import_module("effects")
    options = ["--footprints", "box:samples=4", "--rounds", "1", "--scales", "2", "--threads", "1", "--device", device]
    table = run(effects, *files_of(small_scene), *options)
    results = written(small_scene)["results"]["box:samples=4"]
    assert list(results) == list(effects.ROWS)
    for name, result in results.items():
        assert f"| {name} |" in table
        for side in ("off", "on"):
            assert all(math.isfinite(value) for value in result[side].values())
            assert min(result[side]["forward"], result[side]["forward_backward"]) > 0


def test_footprint_figure(tmp_path, run):
    """It is drawn, and what it draws of moving samples is what the library blends (the program compares)."""
    pytest.importorskip("matplotlib", reason="needs the analysis extra")
    figure = importlib.import_module("footprint_figure")
    run(figure, "--out", tmp_path)
    for name in ("one", "two"):
        assert 10_000 < (tmp_path / f"footprints_{name}.png").stat().st_size < 80_000
    moment, one_weight = map(figure.shares, ("moment:samples=4", "exact"))
    truth = figure.shares(figure.UNFILTERED, figure.FINE)
    assert (moment - truth).abs().max() < 0.02 < (one_weight - truth).abs().max()


def test_accuracy_figure(tmp_path, run):
    """The figures have the numbers of the documents' tables: a row that is renamed, or gone, is missed here."""
    pytest.importorskip("matplotlib", reason="needs the analysis extra")
    figure = importlib.import_module("accuracy_figure")
    run(figure, "--out", tmp_path)
    assert all((tmp_path / name).stat().st_size > 10_000 for name in ("accuracy_time.png", "errors_weight.png"))
    for psnr_column, time_column, _ in figure.SCENES:
        shown = {name: (time, psnr) for name, time, psnr in figure.points(psnr_column, time_column)}
        assert len(shown) == 10 and shown["moment, 4"][1] > shown["box, 1"][1] + 10 > shown["point"][1] + 20
    text = (figure.DOCS / "performance.md").read_text()
    assert f"{shown['moment, 4'][0]} / " in text  # of a cell with two numbers the first
    assert set(figure.LINES) <= set(figure.table(figure.DOCS / "accuracy.md", "The weight"))


def test_dialects(run):
    """A row for every dialect, and both calls of each make the same images."""
    benchmark = importlib.import_module("dialects")
    rows = run(benchmark, "--rounds", "2").splitlines()[4:]
    assert [row.split()[1] for row in rows] == list(DIALECTS)
    assert all(float(cell) < math.inf for row in rows for cell in row.strip("|").split("|")[1:])
    for name in DIALECTS:
        calls = benchmark.calls_of(name)
        own, library = calls["dialect"](), calls["library"]()
        color = own[2] if name == "lightgaussian" else own[0]
        assert torch.equal(color, library[0][:3]) and (color > 0).any()
        if len(library) == 3 and library[2].gaussian_stats is None:  # the others are arranged in many ways
            made = [image for image in library[2] if image is not None]
            assert name == "luiten" or all(any(torch.equal(image, value) for value in own) for image in made)


def test_speed(device, small_scene, run):
    """A row for every footprint, with numbers in all of its columns."""
    footprints = ["box:samples=1", "mip", "mip@2"]
    options = ["--rounds", "1", "--queued", "--sh-degree", "2", "--threads", "1", "--device", device]
    lines = run("speed", *files_of(small_scene), *options, "--footprints", *footprints).splitlines()
    assert "50 Gaussians of SH degree 2, 2 views of 40x30" in lines[0]
    assert [line.split()[0] for line in lines[2:5]] == footprints
    found = written(small_scene)
    assert list(found["results"]) == footprints
    for name, result in found["results"].items():
        assert all(math.isfinite(value) for value in result.values())
        assert min(result["forward"], result["forward_backward"], result["pairs"]) > 0
        assert len(found["per_view"][name]) == 2


def check_doors(text, doors, path, rows):
    """A row for each, with numbers in all columns but those of gsplat."""
    lines = [line for line in text.splitlines() if line.startswith("| ")][2:]
    results = json.loads(path.read_text())["results"]
    assert [line.split("|")[1].strip() for line in lines] == list(results) == rows
    for line, (name, result) in zip(lines, results.items()):
        assert all(math.isfinite(value) for value in result.values())
        assert min(result["forward"], result["forward_backward"]) > 0
        base = results[doors.DOORS[name].base if name in doors.DOORS else "plain"]
        assert float(line.split("|")[3]) == pytest.approx(result["forward"] / base["forward"], rel=1e-3)
    return results


def test_doors(device, small_scene, monkeypatch, run):
    """Every row, beside gsplat where it is; calls with the same options make the same images."""
    doors = importlib.import_module("doors")
    calls = add_peers(monkeypatch)
    options = ["--rounds", "1", "--threads", "1", "--limit-views", "1", "--scales", "2", "--device", device]
    printed = run(doors, *files_of(small_scene), *options)
    rows = [*doors.DOORS, *doors.PEERS]
    results = check_doors(printed, doors, small_scene / "out.json", rows)
    assert device == "cpu" or all(result["events_forward"] > 0 for result in results.values())
    for options in doors.CALLS.values():  # gsplat's own function was called with the options of each row
        wanted = {name: value for name, value in options.items() if name not in ("cameras", "coefficients")}
        wanted |= {"with_ut": True} if "coefficients" in options else {}
        found = [kwargs for _, kwargs in calls if wanted.items() <= kwargs.items()]
        assert any(len(kwargs["Ks"]) == options.get("cameras", 1) for kwargs in found)


def test_doors_of_a_tiny_scene(small_scene, capsys, run):
    """Needs no files, and rows that others are compared with are there too."""
    doors = importlib.import_module("doors")
    options = ["--tiny", "--rounds", "2", "--doors", "defocus", "gsplat", "--json", str(small_scene / "out.json")]
    out = run(doors, *options)
    assert "10 Gaussians of SH degree 1, 1 views of 32x32" in out and ", 1 threads," in out
    check_doors(out, doors, small_scene / "out.json", ["plain", "plain, as defocus", "defocus", "gsplat"])
    with pytest.raises(SystemExit):
        run(doors, "scene.ply", *options)
    assert "either a scene and --views, or --tiny" in capsys.readouterr().err


# Those of a fork of 3DGS: two more than ours.
OfficialSettings = collections.namedtuple("OfficialSettings", [*originals.BASE, "antialiasing", "kernel_size"])


class OfficialRasterizer:
    """Renders as 3DGS does, and returns a depth map besides."""

    def __init__(self, settings: OfficialSettings):
        assert (settings.antialiasing, settings.kernel_size) == (False, 0.1)
        self.rasterizer = ar.GaussianRasterizer(ar.GaussianRasterizationSettings(*settings[:12], footprint="point"))

    def __call__(self, means3D, means2D, opacities, shs, scales, rotations) -> tuple[Any, ...]:
        color, radii = self.rasterizer(means3D, means2D, opacities, shs=shs, scales=scales, rotations=rotations)
        return color, radii, color[:1]


def add_peers(monkeypatch):
    """Modules that look like other rasterizers, and the calls of gsplat's that are made."""
    calls = []

    def recorded(*args, **kwargs):
        calls.append((args, kwargs))
        return rasterization(*args, **kwargs)

    modules = {
        "gsplat": {"rasterization": recorded},
        "official": {"GaussianRasterizer": OfficialRasterizer, "GaussianRasterizationSettings": OfficialSettings},
        "strange": {},
    }
    for name, content in modules.items():
        module = types.ModuleType(name)
        vars(module).update(content)
        monkeypatch.setitem(sys.modules, name, module)
    peers = importlib.import_module("peers")
    for case in (peers.GsplatCase, peers.ModuleCase):
        monkeypatch.setattr(case, "needs_cuda", False)
    return calls


def test_speed_against(device, small_scene, monkeypatch, run):
    """A row for every peer that is there, whose picture is ours of the same footprint; the others are named."""
    calls = add_peers(monkeypatch)
    names = ["gsplat", "gsplat_antialiased", "official", "module:official=mip", "not_there"]
    options = ["--rounds", "1", "--threads", "1", "--device", device, "--footprints", "box:samples=1"]
    lines = run("speed", *files_of(small_scene), *options, "--against", ",".join(names)).splitlines()
    assert lines[0].startswith("not_there: left out, for it is not installed")
    assert [line.split()[0] for line in lines[3:8]] == ["box:samples=1", *names[:-1]]
    results = written(small_scene)["results"]
    assert list(results) == ["box:samples=1", *names[:-1]]
    assert "difference" not in results["box:samples=1"] and results["box:samples=1"]["pairs"] > 0
    for name in names[:-1]:
        assert all(math.isfinite(value) for value in results[name].values())
        assert min(results[name]["forward"], results[name]["forward_backward"]) > 0
    # One rounding for each of 50 splats that a pixel may show, of colours up to 1.
    assert results["gsplat"]["difference"] < 50 * 2**-23 and results["gsplat_antialiased"]["difference"] < 50 * 2**-23
    assert results["official"]["difference"] == 0.0 < 1e-3 < results["module:official=mip"]["difference"]
    assert {kwargs["rasterize_mode"] for _, kwargs in calls} == {"classic", "antialiased"}


def test_gsplat_is_called_as_it_can_be(small_scene, monkeypatch):
    """With arguments that gsplat's own function has."""
    real = pytest.importorskip("gsplat", reason="needs gsplat").rasterization
    calls = add_peers(monkeypatch)
    scene = importlib.import_module("scene_files").load_scene(str(small_scene / "scene.npz"))
    [view, _] = io.load_views(small_scene / "views.json")
    importlib.import_module("peers").GsplatCase(scene, view).forward()
    [(args, kwargs)] = calls
    inspect.signature(real).bind(*args, **kwargs)


@pytest.mark.parametrize(
    "name, sentence",
    [
        ("diff_gaussian_rasterization", "this is this package"),
        ("module:diff_gaussian_rasterization", "this is this package"),
        ("strange", "strange has no GaussianRasterizer"),
    ],
)
def test_what_is_no_peer_is_refused(small_scene, monkeypatch, name, sentence):
    add_peers(monkeypatch)
    with pytest.raises(SystemExit, match=f"--against {name}: {sentence}"):
        importlib.import_module("peers").find_peers([name], "cuda")


def test_peers_that_need_cuda_are_left_out_without(small_scene, monkeypatch, capsys):
    add_peers(monkeypatch)
    peers = importlib.import_module("peers")
    monkeypatch.setattr(peers.GsplatCase, "needs_cuda", True)
    assert list(peers.find_peers(["gsplat", "official"], "cpu")) == ["official"]
    assert capsys.readouterr().out == "gsplat: left out, for it needs CUDA\n"
    assert list(peers.find_peers(["gsplat", "official"], "cuda")) == ["gsplat", "official"]


def test_table(device, small_scene, monkeypatch, capsys, run):
    """A column for every scene, a row for every footprint and peer."""
    add_peers(monkeypatch)
    columns = [f"{label}={small_scene}/scene.npz,{small_scene}/views.json" for label in ("first", "second one")]
    options = ["--rounds", "1", "--threads", "1", "--device", device, "--against", "official"]
    arguments = [*columns, *options, "--footprints", "mip", "analytic", "--json", str(small_scene / "out.json")]
    lines = run("table", *arguments).splitlines()
    results = written(small_scene)["results"]
    assert lines[2] == "| forward / forward + backward, ms | first | second one |"
    for line, name in zip(lines[4:7], ("mip", "analytic", "official"), strict=True):
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        expected = [
            " / ".join(f"{1e3 * results[label][name][key]:.3g}" for key in ("forward", "forward_backward"))
            for label in ("first", "second one")
        ]
        assert cells == [name, *expected]
    assert lines[7] == "first, official: mean absolute difference from our picture 0"
    with pytest.raises(SystemExit):
        run("table", "scene.npz")
    assert "must be LABEL=SCENE,VIEWS, got scene.npz" in capsys.readouterr().err


def run_scaling(run, device, folder, *options):
    """What scaling.py prints and writes for 100 and 400 Gaussians and for three sizes."""
    given = ["--gaussians", "1e2,4e2", "--size", "96x64", "--sizes", "48x32,96x64,192x128", "--rounds", "1"]
    given += ["--density", "0.05", "--count", "200", "--device", device, "--json", folder / "out.json", *options]
    return run("scaling", *given), written(folder)


def test_scaling(device, tmp_path, run):
    """Two series whose pairs grow as the Gaussians do, and the figure of them."""
    pytest.importorskip("matplotlib", reason="needs the analysis extra")
    printed, found = run_scaling(run, device, tmp_path, "--threads", "1", "--out", tmp_path / "figures")
    rows = found["rows"]
    assert [row["gaussians"] for row in rows] == [100, 400, 77, 307, 1229]
    assert [row["series"] for row in rows] == ["gaussians"] * 2 + ["pixels"] * 3
    for row in rows:
        # A splat reaches 3.6 px, or 4.1 with a pixel: from its pairs in a large image, or with those cut off at edges.
        assert 1.0 <= row["pairs"] / row["gaussians"] <= 4.0
        assert all(math.isfinite(value) for value in row.values() if not isinstance(value, str))
        assert min(row["project"], row["list_tiles"], row["blend"], row["memory_bytes"]) > 0
    assert rows[1]["pairs"] / rows[0]["pairs"] == pytest.approx(4, rel=0.1)
    assert found["threads"] == {}
    lines = printed.splitlines()
    assert [line.split()[2] for line in lines[3:8]] == ["96x64", "96x64", "48x32", "96x64", "192x128"]
    assert sorted(path.name for path in (tmp_path / "figures").iterdir()) == ["scaling.png", "scaling.svg"]


def test_scaling_says_what_does_not_fit_into_memory(device, tmp_path, monkeypatch, run):
    """A row, not the end of the program; any other error ends it."""
    scaling = importlib.import_module("scaling")
    original = scaling.make_case

    def make_case(args, count, size):
        if count == 400:
            raise torch.cuda.OutOfMemoryError("no room\nfor a long trace")
        if count == 307:
            return torch.empty(2**60)  # what torch raises on the CPU
        return original(args, count, size)

    monkeypatch.setattr(scaling, "make_case", make_case)
    printed, found = run_scaling(run, device, tmp_path, "--threads", "1")
    assert ["error" in row for row in found["rows"]] == [False, True, False, True, False]
    assert found["rows"][1]["error"] == "out of memory: no room"
    assert sum("out of memory" in line for line in printed.splitlines()) == 2

    def fail(*_):
        raise RuntimeError("something else")

    monkeypatch.setattr(scaling, "make_case", fail)
    with pytest.raises(RuntimeError, match="something else"):
        run_scaling(run, device, tmp_path, "--threads", "1")


def test_scaling_with_threads(tmp_path, monkeypatch, run):
    """A row for every number of threads, timed with that many in turn; the other rows with the largest."""
    pytest.importorskip("matplotlib", reason="needs the analysis extra")
    asked = []  # and not set: threads that wait for each other take long on a busy machine
    monkeypatch.setattr(torch, "set_num_threads", asked.append)
    options = ["--threads", "1,2", "--gaussians", "50", "--sizes", "48x32", "--out", tmp_path / "figures"]
    printed, found = run_scaling(run, "cpu", tmp_path, *options)
    assert asked == [2, 1, 2, 1, 2, 2]  # at first, in a round that warms up, in the timed one, and at the end
    assert list(found["threads"]) == ["1", "2"]
    assert all(0 < value["forward"] < math.inf for value in found["threads"].values())
    assert "200 Gaussians, 96x64" in printed
    assert {path.name for path in (tmp_path / "figures").iterdir()} >= {"scaling.png", "threads.png", "threads.svg"}


def test_synthetic_splats_keep_their_size():
    """In px, whatever the image; so every Gaussian has as many pairs, and none is culled."""
    scaling = importlib.import_module("scaling")
    for width, height in ((240, 135), (960, 540)):
        view = io.View("", width, height, 4.0 * width, 4.0 * width, torch.eye(4, dtype=torch.float64))
        scene = scaling.make_scene(500, view, 1, "cpu")
        splats = ar.project(view.settings(sh_degree=1), **scene.arguments())
        assert len(splats.means2d) == 500
        cov_xx, _, cov_yy = splats.cov2d.unbind(1)
        # Off the axis by x / z, at most half a width over four widths, a splat is sqrt(1 + (x / z)^2) times as wide.
        widest = 1 + 0.125**2
        for variance in (cov_xx, cov_yy):
            share = variance / scaling.SIGMA**2
            assert (share >= 1 - 1e-4).all() and (share < widest + 1e-4).all()
        assert (splats.means2d.amax(0) > 0.95 * torch.tensor([width, height])).all()


def test_losses(device, tmp_path, run):
    """Every row, with a time in all of its columns."""
    options = ["--sizes", "20x10", "--gaussians", "30", "--rounds", "1", "--threads", "1", "--device", device]
    table = run("losses", *options, "--json", str(tmp_path / "out.json"))
    results = written(tmp_path)["results"]
    assert len(results) == 11
    for name, result in results.items():
        assert f"| {name} |" in table
        times = [result["call"]] + ([result["device"]] if device == "cuda" else [])
        assert all(0 < value < math.inf for value in times)


def test_busy(tmp_path, monkeypatch, run):
    """Rows alone and beside loops, with one thread and with two in turn; no loop is left, and torch's setting stays."""
    busy = importlib.import_module("busy")
    started, asked, alive = [], [], []

    def start(*args, **kwargs):
        started.append(subprocess.Popen(*args, **kwargs))
        return started[-1]

    def ask(count):
        asked.append(count)
        alive.append(sum(loop.poll() is None for loop in started))

    monkeypatch.setattr(busy, "subprocess", types.SimpleNamespace(Popen=start, PIPE=subprocess.PIPE))
    monkeypatch.setattr(torch, "set_num_threads", ask)
    options = ["--loops", "2", "--threads", "2", "--gaussians", "30", "--sizes", "20x10", "--rounds", "1"]
    table = run(busy, *options, "--json", str(tmp_path / "out.json"))
    rows = written(tmp_path)["results"]
    expected = [(name, loops) for loops in (0, 2) for name in ("forward", "with backward")]
    assert [(row["pass"], row["loops"]) for row in rows] == expected
    assert asked == [1, 2, 1, 2, torch.get_num_threads()] * 4
    assert alive == [0] * 10 + [2] * 10
    assert len(started) == 2 and all(loop.returncode for loop in started)
    for row in rows:
        assert row["ratio"] == pytest.approx(row["all_threads_ms"] / row["one_thread_ms"])
        assert f"| {row['size']} | {row['pass']} | {row['loops']} |" in table


def test_training(device, tmp_path, run):
    """A row for every variant, and a run for every variant and seed."""
    pytest.importorskip("PIL.Image", reason="needs the train extra")
    pytest.importorskip("scipy", reason="needs the train extra")
    write_nerf_synthetic(tmp_path, circle(2, (16, 16)), circle(2, (16, 16)))
    (tmp_path / "more.json").write_text(json.dumps({"mine": {"scale_repeats": [3, 1, 1, 1], "density": "mcmc"}}))
    arguments = [tmp_path, "--more", tmp_path / "more.json", "--json", tmp_path / "out.json", "--device", device]
    names = ["default", "mine", "3dgs"]
    options = ["--variants", *names, "--seeds", "0", "1", "--scales", "1,2", "--iterations", "12"]
    lines = run("training", *arguments, *options, "--random-points", "20", code=0).splitlines()
    assert [line.split()[0] for line in lines[2:]] == names and all("±" in line for line in lines[2:])
    runs = written(tmp_path)["runs"]
    assert [(run["variant"], run["seed"]) for run in runs] == [(v, s) for s in (0, 1) for v in names]
    assert all(run["steps"] == 12 and math.isfinite(run["test"]["mean"]["psnr"]) for run in runs)
    assert runs[1]["options"]["scale_repeats"] == [3, 1]
    assert (runs[2]["options"]["scale_repeats"], runs[2]["options"]["density"]) == ([1, 1], "3dgs")
    run("training", tmp_path, "--variants", "none", code=2)
    (tmp_path / "transforms_test.json").unlink()
    run("training", tmp_path, code=2)  # before anything is trained
    assert run.err == f"error: {tmp_path}: there are no test pictures\n"


def test_few_photographs(tmp_path, run):
    """A row for every number of photographs and every kind of depths; points that fewer than two show are left out."""
    pytest.importorskip("PIL.Image", reason="needs the train extra")
    pytest.importorskip("scipy", reason="needs the train extra")
    wall.write_wall(tmp_path / "wall")
    options = ["--device", "cpu", "--iterations", "10", "--max-gaussians", "1000", "--json", tmp_path / "out.json"]
    numbers = ["--photographs", "3", "5", "--depth", "none", "points", "maps"]
    run("few_photographs", tmp_path / "wall", *options, *numbers, code=0)
    runs = written(tmp_path)["runs"]
    assert list(runs) == [f"{count}, {depth}" for count in (3, 5) for depth in ("none", "points", "maps")]
    assert all(math.isfinite(row["psnr"]) and row["gaussians"] > 0 for row in runs.values())
    assert len({row["psnr"] for row in runs.values()}) == 6

    program = importlib.import_module("few_photographs")
    capture = training.load_capture(tmp_path / "wall")
    positions, colors = capture.points
    behind = -torch.linalg.inv(capture.train[0].view.w2c)[:3, 2].float() + positions[:1]  # no photograph shows it
    capture = capture._replace(points=(torch.cat([positions, 100 * behind]), torch.cat([colors, colors[:1]])))
    few = program.with_few(capture, 3)
    assert [capture.train.index(item) for item in few.train] == [1, 4, 6]
    shown = sum(program.shown_points(item.view, capture.points[0]).long() for item in few.train)
    assert torch.equal(few.points[0], capture.points[0][shown >= 2]) and 0 < len(few.points[0]) < len(shown)

    write_nerf_synthetic(tmp_path / "balls", circle(2, (16, 16)), circle(2, (16, 16)))
    run("few_photographs", tmp_path / "balls", *options, code=2)
    assert run.err == f"error: {tmp_path / 'balls'}: --depth points needs a capture with points\n"


def test_gsplat_training(tmp_path, monkeypatch, run):
    """Its strategy grows Gaussians from our call, and the error of the pictures falls; what is missing is said."""
    arguments = [tmp_path, "--device", "cpu", "--random-points", "300", "--json", tmp_path / "out.json"]
    with monkeypatch.context() as without:
        without.setitem(sys.modules, "gsplat", None)
        run("gsplat_training", *arguments, code=2)
    assert run.err.startswith("error: gsplat, whose strategy this runs, is not installed")
    pytest.importorskip("gsplat", reason="needs gsplat")
    pytest.importorskip("PIL.Image", reason="needs the train extra")
    pytest.importorskip("scipy", reason="needs the train extra")
    run("gsplat_training", *arguments, "--rasterizer", "gsplat", code=2)
    assert run.err == "error: --rasterizer gsplat: needs CUDA\n"
    write_nerf_synthetic(tmp_path, circle(3), circle(2))
    found = {}
    for steps, options in ((1, []), (60, []), (20, ["--packed", "--absgrad", "--antialiased"])):
        options = [*options, "--iterations", steps, "--refine-start", "5", "--refine-every", "10"]
        [header, row] = run("gsplat_training", *arguments, *options, code=0).splitlines()[1:]
        assert header.split()[:4] == ["rasterizer", "seconds", "PSNR", "Gaussians"] and row.split()[0] == "ours"
        found[steps] = written(tmp_path)["runs"]["ours"]
    assert found[60]["psnr"] > found[1]["psnr"] and found[60]["gaussians"] != found[1]["gaussians"] == 300


def run_on_ranks(name, small_scene, *options):
    """What a benchmark prints and writes that starts one process, and then two."""
    options = ["--ranks", "1", "2", "--rounds", "2", "--threads", "1", "--device", "cpu", *options]
    done = subprocess.run(
        [sys.executable, ROOT / "benchmarks" / name, *map(str, files_of(small_scene)), *options],
        cwd=small_scene, capture_output=True, text=True, timeout=DEADLINE,
        env=os.environ | {"PYTHONPATH": python_path()},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout, written(small_scene)


def test_distributed(small_scene):
    """Measured numbers for every number of ranks, and the model's for more; as many bytes as the formula says."""
    printed, found = run_on_ranks("distributed.py", small_scene, "--times", "3")
    rows = [line.split() for line in printed.splitlines()[4:]]
    assert [row[0] for row in rows] == ["1", "2", "4", "8", "64"] and {len(row) for row in rows} == {10}
    assert all(cell != "-" for row in rows[:2] for cell in row) and rows[2][1:8] == ["-"] * 7
    assert all(math.isfinite(value) for of_ranks in found["results"].values() for value in of_ranks.values())
    one, two = (found["results"][ranks] for ranks in ("1", "2"))
    assert one["sent"] == one["exchange"] == 0 < two["exchange"] and one["state_bytes"] == 2 * two["state_bytes"]
    assert one["peak_bytes"] > one["state_bytes"] and two["peak_bytes"] > two["state_bytes"]
    # Exact where each rank has half of the splats of each camera; here each has at most all of them.
    assert 0 < two["sent"] <= 2 * found["model"]["2"]["sent"]
    assert found["model"]["64"]["images_per_second"] > found["model"]["4"]["images_per_second"] > 0


def test_bands(small_scene):
    """A row for every number of ranks; two of them hold half of the scene each, and the last all of the image."""
    printed, found = run_on_ranks("bands.py", small_scene, "--times", "3", "--copies", "2", "--scales", "0.0625")
    assert "in 2 copies: 300\n" in printed
    one, two = (found["results"][ranks] for ranks in ("1", "2"))
    assert min(*one.values(), *two.values()) > 0
    assert one["scene_bytes"] == 2 * two["scene_bytes"]
    if added_memory(lambda: torch.ones(2**20), torch.device("cpu"))[1] > 0:  # where memory can be measured
        image = 640 * 480 * 4 * 4  # of 3 channels and alpha; the system may count some pages late
        assert min(of_ranks["peak_bytes"] - of_ranks["scene_bytes"] for of_ranks in (one, two)) > 0.8 * image


def test_bands_say_what_does_not_fit_whichever_rank_is_heard_of(small_scene, monkeypatch):
    """A scene that does not fit has no numbers; any other error ends the program."""
    bands = importlib.import_module("bands")

    def raise_of_rank(text):
        def start_processes(*_, **__):
            raise torch.multiprocessing.ProcessRaisedException(text, 0, 1)

        monkeypatch.setattr(torch.multiprocessing, "start_processes", start_processes)
        return bands.measure(2, None)

    assert raise_of_rank("torch.OutOfMemoryError: CUDA out of memory. Tried to allocate 9 GiB") is None
    assert raise_of_rank("RuntimeError: on rank 1: CUDA out of memory. Tried to allocate 9 GiB") is None
    with pytest.raises(torch.multiprocessing.ProcessRaisedException, match="something else"):
        raise_of_rank("RuntimeError: something else")


def test_formats(small_scene, run):
    """A row for every format and for the file of another program; what rounds less shows less."""
    benchmark, scene_files = importlib.import_module("formats"), importlib.import_module("scene_files")
    io.save_scene(small_scene / "other.ply", scene_files.load_scene(small_scene / "scene.npz"))
    options = ["--also", str(small_scene / "other.ply"), "--device", "cpu", "--footprint", "box:samples=1"]
    table = run(benchmark, *files_of(small_scene), *options)
    results = {row["file"]: row for row in written(small_scene)["results"]}
    assert list(results) == [*(f"scene.{suffix}" for suffix in benchmark.FORMATS), "other.ply"]
    assert all(f"| {name.removeprefix('scene')} |" in table for name in results)
    assert results["scene.ply"]["psnr"] == results["other.ply"]["psnr"] == 300
    assert results["scene.glb"]["psnr"] > 100 > results["scene.spz"]["psnr"] > results["scene.splat"]["psnr"] > 10
    assert results["scene.glb"]["rotations"][0] < 1e-4 < 0.01 < results["scene.spz"]["rotations"][0] < 0.3


def test_approximations(small_scene, run):
    """The program's first picture is the library's, and what is approximated changes it (no ray of it is dark)."""
    benchmark = importlib.import_module("approximations")
    options = ["--scales", "1", "--crop", "24", "20", "--samples", "2", "--limit-views", "1", "--threads", "1"]
    assert "| a | 1/1 |" in run(benchmark, *files_of(small_scene), *options)
    [result] = written(small_scene)["results"]
    # One of the 1920 samples on the other side of a threshold by rounding: 1/255/4 in one of 480 pixels.
    assert result["library"] > -20 * math.log10(1 / 255 / 4 / math.sqrt(480))
    changed = [name for name in benchmark.VARIANTS if name != "0.9999"]
    assert all(0 < result[name] < 0.9 * result["library"] for name in changed)


def test_perspective_is_that_of_sampling_along_rays(small_scene):
    """Maximum and integral of a Gaussian along a ray, by their closed forms and at 1,001 points of the ray."""
    benchmark = importlib.import_module("approximations")
    scene = importlib.import_module("scene_files").load_scene(small_scene / "scene.npz")
    splats = benchmark.Splats(scene, io.load_views(small_scene / "views.json")[0])
    ids = torch.arange(8)
    rays = torch.tensor([[0.0, 0.0, 1.0], [0.2, -0.3, 1.0], [-0.5, 0.4, 1.0]], dtype=torch.float64)
    straight = splats.centre[ids] / splats.centre[ids, 2:]  # through the centre of each

    def along(rays):
        """(M, N, 1001) density relative to the peak, and distances of the points from the camera."""
        at = torch.linspace(-1, 1, 1001, dtype=torch.float64)
        whitened = (splats.whiten[ids] @ rays.T).permute(2, 0, 1)
        centre = (splats.whiten[ids] @ splats.centre[ids, :, None])[..., 0]
        square = whitened.square().sum(-1)
        t = (whitened * centre).sum(-1)[..., None] / square[..., None] + 8 * at / square[..., None].sqrt()
        d = t[..., None] * whitened[:, :, None] - centre[None, :, None]
        return torch.exp(-d.square().sum(-1) / 2), t * rays.norm(dim=1)[:, None, None]

    density, distance = along(rays)
    through_centres = torch.trapezoid(*along(straight), dim=-1).diagonal()
    expected = {"maximum": density.amax(-1), "integral": torch.trapezoid(density, distance, dim=-1) / through_centres}
    for projection, sampled in expected.items():
        alpha, depth = benchmark.alphas_and_depths(splats, ids, rays, projection)
        front = depth > 0
        assert front.any() and (alpha[~front] == 0).all()
        torch.testing.assert_close(alpha[front], (splats.opacity[ids] * sampled)[front], rtol=1e-9, atol=1e-15)


def test_order_of_each_ray(small_scene):
    """Two plates that cross: on each side another one is in front, whichever has the nearer centre."""
    benchmark = importlib.import_module("approximations")
    turn = math.pi / 8  # half of the angle between plate and picture
    scene = Gaussians.from_activated(
        means=torch.tensor([[0.0, 0.0, 4.0], [0.0, 0.0, 4.01]]),
        scales=torch.tensor([[1.0, 1.0, 0.01]]).repeat(2, 1),
        rotations=torch.tensor([[math.cos(turn), 0, math.sin(turn), 0], [math.cos(turn), 0, -math.sin(turn), 0]]),
        opacities=torch.full((2, 1), 0.99),
        shs=torch.tensor([[[1.5, -1.5, -1.5]], [[-1.5, 1.5, -1.5]]]),
    )
    view = io.View("a", 32, 16, 30.0, 30.0, torch.eye(4, dtype=torch.float64))
    splats = benchmark.Splats(scene, view)
    by_center, by_ray = (
        benchmark.render(splats, (0, 0), (32, 16), 2, benchmark.Variant(central_order=central))
        for central in (True, False)
    )
    left, right = (slice(None), 8, 11), (slice(None), 8, 20)
    assert by_center[left][0] > by_center[left][1] and by_center[right][0] > by_center[right][1]
    assert (by_ray[left][0] > by_ray[left][1]) != (by_ray[right][0] > by_ray[right][1])


def test_stillness(small_scene, run):
    """Its exact order is that of the library for windows as long as lists, and its film is small."""
    image = pytest.importorskip("PIL.Image", reason="needs the train extra")
    benchmark = importlib.import_module("stillness")
    options = ["--scales", "1", "--crop", "24", "20", "--samples", "2", "--steps", "2", "--threads", "1"]
    film = ["--film", str(small_scene / "film.png"), "--film-frames", "3", "--film-size", "24", "16"]
    table = run(benchmark, *files_of(small_scene), *options, *film)
    [result] = written(small_scene)["results"]
    assert all(f"| 1/1 | {name} |" in table for name in benchmark.FOOTPRINTS)
    for found in result["footprints"].values():
        error, moves = zip(*(found["popping"][order] for order in benchmark.ORDERS))
        assert all(math.isfinite(value) for value in (*error, *moves, *found["aliasing"]))
        assert error[1] <= error[0] and max(error[1:]) < 1
        assert all(of <= all_of for of, all_of in zip(moves, error))  # a deviation is at most the error itself
    with image.open(small_scene / "film.png") as shown:
        assert shown.n_frames == 4 and shown.size == (48, 16)
    with pytest.raises(ValueError, match="footprints must be among point, mip, box:samples=1 and moment"):
        benchmark.Filter.of("cumulant")


def test_lens_accuracy(tmp_path, small_scene, run):
    """Rows with numbers; the library's samples are the program's; pictures; the number predicts errors of weights."""
    benchmark = importlib.import_module("lens_accuracy")
    sizes = ["--size", "24", "16", "--samples", "2", "--gaussians", "60", "--threads", "1", "--fovs", "90", "150"]
    options = ["--sigmas", "2", "--scenes", "1", "--out", str(tmp_path / "out"), "--json", str(tmp_path / "out.json")]
    run(benchmark, *sizes, *options)
    results = written(tmp_path)
    rows = {(row["camera"], row["field of view"]): row for row in results["pictures"]}
    assert list(rows) == [("fisheye", "90"), ("perspective", "90"), ("pinhole", "90"), ("fisheye", "150")]
    assert all(math.isfinite(row[name]) for row in rows.values() for name in ("affine", *benchmark.FOOTPRINTS, "above"))
    assert rows["fisheye", "90"]["affine"] > rows["fisheye", "150"]["affine"] + 3
    assert 1 >= rows["fisheye", "90"]["kept"] > rows["fisheye", "150"]["kept"] > 0.5
    assert sum(row[kind][0] for row in results["weights"] for kind in benchmark.CAMERAS if kind in row) <= 180
    assert (tmp_path / "out" / "fisheye_150_2_affine_x10.png").exists()
    files = [str(small_scene / "scene.npz"), "--views", str(small_scene / "views.json"), "--fovs", "100"]
    assert "| fisheye | 100 | the scene |" in run(benchmark, *files, *sizes[:-3])


def test_lens_accuracy_approximates_what_the_library_renders(small_scene):
    """Its affine picture is that of the library's own unfiltered samples, in the library's order."""
    benchmark = importlib.import_module("lens_accuracy")
    view = benchmark.camera("fisheye", 100, (24, 16))
    scene = benchmark.random_scene(1, 100, 2.0, (24, 16))
    splats = benchmark.LensSplats(scene, view, benchmark.CAMERAS["fisheye"])
    affine = benchmark.render_whole(splats, "affine", 1)
    own = benchmark.library_picture(scene, view, benchmark.CAMERAS["fisheye"], "point:dilation=0")
    # One of the 384 samples may be on the other side of a threshold by rounding.
    assert (affine - own).abs().flatten().sort().values[:-6].max() < 1e-6 and (affine - own).abs().max() < 2 / 255


def test_unscented_of_a_linear_map_is_affine(small_scene):
    """Far away and small Gaussians: all three pictures of a splat are the same."""
    benchmark = importlib.import_module("lens_accuracy")
    view, lens = benchmark.camera("fisheye", 100, (24, 16)), benchmark.CAMERAS["fisheye"]
    scene = benchmark.random_scene(1, 100, 2.0, (24, 16))
    scene = scene._replace(log_scales=scene.log_scales - math.log(1e4))
    splats = benchmark.LensSplats(scene, view, lens)
    mean, covariance = splats.mean, splats.covariance
    drawn = mean[:, 0] < benchmark.NOWHERE
    for options in benchmark.UNSCENTED.values():
        splats.project()
        splats.transform_unscented(*options)
        torch.testing.assert_close(splats.mean[drawn], mean[drawn], rtol=0, atol=1e-6)
        torch.testing.assert_close(splats.covariance[drawn], covariance[drawn], rtol=1e-3, atol=1e-12)


def test_affine_error_predicts_errors_of_weights(small_scene):
    """For every camera: the error is no more than the number, and mostly a quarter of it or more."""
    benchmark = importlib.import_module("lens_accuracy")
    for kind in benchmark.CAMERAS:
        error, worst = benchmark.weight_errors(kind, 60, 2)
        wide = (error > 0.03) & (error < 1)
        assert wide.sum() > 10
        assert (worst[wide] < 1.1 * error[wide]).all()
        assert (worst[wide] / error[wide]).median() > 0.25


def test_timeline_of_a_trace(small_scene):
    """What is no kernel, and what the pass was queued behind, is left out; * marks what runs beside something else."""
    timeline = importlib.import_module("timeline")
    events = [
        ("at::native::spin_kernel(long)", 7, 50.0, 30.0),
        ("void ar::cuda::blend_kernel<ar::Point, 3>(ar::cuda::BlendParams)", 7, 100.0, 40.0),
        ("ar::cuda::zero_kernel(int)", 13, 110.0, 60.0),
        ("ar::cuda::project_kernel(int)", 7, 139.0, 5.0),
        ("ar::cuda::last_kernel(int)", 7, 169.5, 8.5),
    ]
    trace = [{"cat": "kernel", "name": n, "ts": ts, "dur": d, "args": {"stream": s}} for n, s, ts, d in events]
    trace = {"traceEvents": [{"cat": "cpu_op", "name": "x", "ts": 0.0}, {"name": "process_name"}, *trace[::-1]]}
    header, *rows = timeline.format_kernels(timeline.kernels_of(trace)).split("\n")
    assert header.split() == ["kernel", "begins", "ends", "takes", "stream"]
    assert [row.rsplit(maxsplit=4)[1:] for row in rows] == [
        ["0.0", "40.0", "40.0", "7*"],
        ["10.0", "70.0", "60.0", "13*"],
        ["39.0", "44.0", "5.0", "7*"],
        ["69.5", "78.0", "8.5", "7"],
    ]
    assert rows[0].startswith("blend_kernel<Point, 3>(BlendParams)")
    assert timeline.kernels_of({"traceEvents": []}) == []


def test_timeline(small_scene, capsys, run):
    """Also without a device, where it says so."""
    timeline = importlib.import_module("timeline")
    arguments = [small_scene / "scene.npz", "--views", small_scene / "views.json", "--view", 1, "--sh-degree", 3]
    if not torch.cuda.is_available() or not ar._C.has_cuda:
        with pytest.raises(SystemExit):
            run(timeline, *arguments)
        assert "no CUDA device" in capsys.readouterr().err
        return
    printed = run(timeline, *arguments)
    for footprint in timeline.FOOTPRINTS:
        assert footprint in printed
    for kernel in ("project_kernel", "blend", "project_vjp_kernel"):
        assert printed.count(kernel) >= len(timeline.FOOTPRINTS)
    assert timeline.SLEEPER not in printed


def test_viewer_gpu(small_scene, run):
    """The page's shaders under OpenGL draw what the rasterizer does, also from a prepared file; other pictures are
    noticed."""
    pytest.importorskip("moderngl", reason="needs moderngl")
    if shutil.which("node") is None:
        pytest.skip("needs node, which reads the shaders out of the page")
    benchmark = importlib.import_module("viewer_gpu")
    try:
        benchmark.create_context().release()
    except SystemExit as error:
        pytest.skip(str(error))

    shaders, job, file = (small_scene / name for name in ("shaders.json", "job.npz", "out.json"))
    given = [small_scene / "scene.npz", "--views", small_scene / "views.json", "--sizes", "40x30,20x15"]
    run(benchmark, "--write-shaders", shaders)
    run(benchmark, *given, "--shaders", shaders, "--prepare", job)
    rounds = ["--rounds", "2", "--json", file]
    for scene in (given, [job]):
        out = run(benchmark, *scene, *rounds)
        results = written(small_scene)
        assert list(results["differences"]) == list(pages.WEBGL_FOOTPRINTS)
        for name, of_bits in results["differences"].items():
            assert f"| {name} " in out
            # Some devices cut half floats off where others round.
            assert of_bits["32-bit floats"]["largest"] <= 1 and of_bits["16-bit floats"]["largest"] <= 2
        count = len(pages.WEBGL_FOOTPRINTS)
        assert [row["size"] for row in results["rows"]] == ["40x30"] * count + ["20x15"] * count
        for row in results["rows"]:
            assert row["rounds"] == 2 and row["clock_ms"] > 0 and row["clock_ratio"] > 0
            assert len(row["ms"]) == 2 and all(len(view) == 2 for view in row["ms"])

    prepared = benchmark.Job.load(job)
    dataclasses.replace(prepared, expected=lambda _: prepared.expected("point")).save(job, ["analytic"])
    run(benchmark, job, *rounds, "--footprints", "analytic")
    assert written(small_scene)["differences"]["analytic"]["32-bit floats"]["largest"] > 1


def test_viewer_webgpu(small_scene, monkeypatch, run):
    """The page's passes in wgpu draw what the rasterizer does, also from a plan and a prepared file; other pictures are
    noticed."""
    pytest.importorskip("wgpu", reason="needs wgpu")
    if shutil.which("node") is None:
        pytest.skip("needs node, which records what the page does")
    benchmark = importlib.import_module("viewer_webgpu")
    monkeypatch.setattr(benchmark, "PAIRS", 1000)
    monkeypatch.setattr(benchmark, "WARM_UP", 0.0)
    try:
        benchmark.open_device({"buffers": [[16, 0]]})
    except SystemExit as error:
        pytest.skip(str(error))

    plan, job, file = (small_scene / name for name in ("plan.json", "job.npz", "out.json"))
    scene = [small_scene / "scene.npz", "--views", small_scene / "views.json", "--sizes", "40x30,20x15"]
    names = ["analytic", "moment:samples=4", "mip:variance=0.3"]
    options = ["--footprints", *names, "--timed", "moment:samples=4", "--rounds", "2", "--repeat", "2"]
    run(benchmark, *scene, *options, "--write-plan", plan)
    run(benchmark, *scene, *options, "--plan", plan, "--prepare", job)
    for given in ([*scene, "--plan", plan], [job]):
        out = run(benchmark, *given, *options, "--json", file)
        results = written(small_scene)
        assert list(results["differences"]) == names
        for name, found in results["differences"].items():
            assert f"  {name}: largest difference" in out
            assert found["largest"] <= 1 and found["changed"] == 0 and found["values"] == 2 * 3 * 40 * 30
        expected = [(size, "moment:samples=4") for size in ("40x30", "20x15")]
        assert [(row["size"], row["footprint"]) for row in results["rows"]] == expected
        for row in results["rows"]:
            assert row["clock"] > 0 and row["pairs"] > 0 and len(row["views"]) == 2

    prepared = benchmark.Job.load(job)
    dataclasses.replace(prepared, expected=lambda _: prepared.expected("mip:variance=0.3")).save(job, names)
    run(benchmark, job, *options, "--json", file)
    assert written(small_scene)["differences"]["analytic"]["largest"] > 1
    with pytest.raises(SystemExit, match="another number of Gaussians, other views or other sizes"):
        run(benchmark, *scene[:-1], "40x30", *options, "--plan", plan)
    with pytest.raises(SystemExit, match="has no point at 40x30"):
        run(benchmark, *scene, *options, "--plan", plan, "--footprints", "point")


def test_every_kernel(device, monkeypatch, run):
    """The program for compute-sanitizer ends; the parts that render footprints are alike, so that one will do here."""
    program = importlib.import_module("every_kernel")
    of_footprints = [scenes.name_of(variant) for variant in scenes.VARIANTS if scenes.name_of(variant) != "box-4"]
    for name in (*of_footprints, "largest"):
        monkeypatch.delitem(program.PARTS, name)
    parts = list(program.PARTS)  # so that it is an error if one of the operators is not called
    if device == "cuda":  # where kernels of the parts that are left out must be launched as well
        monkeypatch.setattr(program, "kernels_of_library", lambda: set(_C.launched_kernels()))
    lines = run(program, *parts, "--device", device).splitlines()
    assert [line for line in lines if line in parts] == parts
    assert device == "cpu" or lines[-1].endswith(" kernels were launched")


@pytest.mark.parametrize("footprint, options", scenes.PATHS, ids=map(scenes.name_of, scenes.PATHS))
def test_every_kernel_has_images_that_need_it(footprint, options):
    """What its comment says of lists and of pixels that close."""
    program = importlib.import_module("every_kernel")
    long_list = re.search(r"kLongList = (\d+);", (ROOT / "csrc" / "cuda" / "moment" / "policy.h").read_text())[1]
    longest, most_in_tile, closed, short = {}, {}, {}, {}
    for name, image in program.IMAGES.items():
        settings = image.camera().settings(torch.float32, footprint=footprint, **options)._replace(sh_degree=3)
        leaves = scenes.leaves(image.scene("cpu"))
        del leaves["means2D"]
        splats = ar.project(settings, **leaves)
        lists = ar.list_tiles(splats)
        of_camera = lists.of_camera()
        ar.blend(splats, lists)[0].sum().backward()
        lists = of_camera["tile_offsets"].diff()
        longest[name], short[name] = int(lists.max()), int(((lists > 0) & (lists < int(long_list))).sum())
        # With its mean in a tile, of the smallest that there are, a splat that has pairs has one with that tile.
        side = 8 if name.startswith("large") else 4
        listed = splats.means2d.detach()[of_camera["pairs"].long().unique()]
        tiles = ((listed + 0.5) / side).floor()
        most_in_tile[name] = int(tiles.unique(dim=0, return_counts=True)[1].max())
        # Splats as large as a pixel, of opacities of 0.3 and above, that have a pixel and no gradient: all are closed.
        inside = ((splats.means2d > 0) & (splats.means2d < torch.tensor([image.width - 1, image.height - 1]))).all(1)
        closed[name] = int((inside & (leaves["opacities"].grad[splats.gaussian_ids.long(), 0] == 0)).sum())
    large = [image for name, image in program.IMAGES.items() if name.startswith("large")]
    assert all((image.width // 8) * (image.height // 8) >= 4096 for image in large)
    assert (program.LARGEST.width // 16) * (program.LARGEST.height // 16) >= 4096
    assert most_in_tile["small"] > int(long_list) and longest["small"] > int(long_list)
    assert most_in_tile["large, few tiles"] > int(long_list) and short["large, few tiles"] > 100
    assert closed["large, opaque"] > 100 and closed["small, opaque"] > 100


def test_lens_training(tmp_path, small_scene, run):
    """Its formulas are those of the library, a photograph is the library's picture, and every training has a number."""
    pytest.importorskip("PIL.Image", reason="needs the train extra")
    program = importlib.import_module("lens_training")
    a, b = (torch.linspace(-x, x, n, dtype=torch.float64) for x, n in ((0.4, 9), (0.3, 7)))
    a, b = torch.meshgrid(a, b, indexing="xy")
    lenses = {
        program.opencv_rays: ar.Lens.perspective(program.K, program.P),
        program.fisheye_rays: ar.Lens.fisheye(program.FISHEYE),
        program.pinhole_rays: None,
    }
    for inverse, lens in lenses.items():
        seen = (lens or ar.Lens.perspective()).project(inverse(a, b).reshape(-1, 3))[0]
        assert (seen - torch.stack([a, b], -1).reshape(-1, 2)).abs().max() < 1e-9
    scene = importlib.import_module("scene_files").load_scene(str(small_scene / "scene.npz"))
    # Not splats that fill the picture, whose affine picture is not that of rays.
    scene.log_scales.clamp_(max=math.log(0.05))
    renderer = program.Renderer(scene, "cpu", "box:samples=4", (0.0, 0.0, 0.0))
    (view, _) = io.load_views(small_scene / "views.json")
    for inverse, lens in lenses.items():
        made = renderer.photograph(view, inverse) / 255
        settings = dataclasses.replace(view, lens=lens).settings(sh_degree=1, footprint="box:samples=16")
        image, _ = ar.GaussianRasterizer(settings)(means2D=None, **scene.arguments())
        assert image.std() > 0.01
        error = (made - image).square().mean().sqrt()
        assert error < 0.1 * image.std(), (lens, error, image.std())
    views = [dataclasses.replace(view, name=f"{k}", w2c=view.w2c.clone()) for k in range(10)]
    for k, each in enumerate(views):
        each.w2c[0, 3] += 0.1 * k
    io.save_views(small_scene / "views.json", views)
    given = [small_scene / "scene.npz", "--views", small_scene / "views.json", "--out", tmp_path / "out"]
    printed = run(program, *given, "--iterations", "2", "--points", "30", "--device", "cpu")
    results = json.loads((tmp_path / "out" / "results.json").read_text())
    assert list(results) == ["pinhole, keep", "opencv, keep", "opencv, undistort", "fisheye, keep"]
    assert all(math.isfinite(value) for values in results.values() for value in values)
    assert "| fisheye, keep |" in printed


def test_large_capture(tmp_path, monkeypatch, run):
    """The photographs are those of the cameras, and trainings from every place have a row, and the same bits."""
    numpy = pytest.importorskip("numpy")
    pytest.importorskip("tqdm", reason="needs the train extra")
    image = pytest.importorskip("PIL.Image", reason="needs the train extra")
    monkeypatch.setenv("PYTHONPATH", python_path())
    program = importlib.import_module("large_capture")
    folder, results = tmp_path / "capture", tmp_path / "out.json"
    monkeypatch.setattr(program, "WARM_UP", 2)
    sizes = ["--count", "5", "--size", "64x48", "--points", "300", "--steps", "6", "--scales", "1,2"]
    options = ["--footprint", "box:samples=1", "--device", "cpu", "--threads", "1", "--folder", folder]
    assert "the trained Gaussians have the same bits" in run(program, *sizes, *options, "--json", results, code=0)
    on_device, in_files = json.loads(results.read_text())["places"]
    assert on_device["ahead"] == 0 < in_files["ahead"]
    whole = sum(3 * (64 // scale) * (48 // scale) for scale in (1, 2) for _ in range(5)) / 2**30
    assert on_device["pictures_gib"] == whole and 0 < in_files["pictures_gib"] < whole
    # The points have the colours of the pixels that they are seen in.
    capture = training.load_capture(folder, test_every=0)
    positions, colors = capture.points
    for item in capture.train[:2]:
        seen = positions.double() @ item.view.w2c[:3, :3].T + item.view.w2c[:3, 3]
        at = (seen[:, :2] / seen[:, 2:] * item.view.fx + torch.tensor(item.view.middle)).floor().long()
        within = ((at >= 0) & (at < torch.tensor([64, 48]))).all(1)
        pixels = numpy.array(image.open(item.files[1]))[at[within, 1], at[within, 0]] / 255
        error = abs(pixels - colors[within].numpy()).mean()
        assert within.sum() > 50 and error < 0.05 < abs(pixels - pixels.mean(0)).mean()


def test_capture_effects(tmp_path, run):
    """Copies have what their docstring says, and every training a row. The numbers mean nothing."""
    pytest.importorskip("tqdm", reason="needs the train extra")
    image = pytest.importorskip("PIL.Image", reason="needs the train extra")
    training = importlib.import_module("analytic_rasterizer.training")
    effects = importlib.import_module("capture_effects")
    wall.write_wall(tmp_path / "wall")
    options = ["--iterations", "2", "--device", "cpu", "--stops", "0.8", "--balance", "0", "--footprints", "box"]
    with pytest.warns(UserWarning, match="train_0004.png is left out"):
        table = run(effects, tmp_path / "wall", "--out", tmp_path / "out", *options)
    runs = json.loads((tmp_path / "out" / "results.json").read_text())["runs"]
    assert [run["row"] for run in runs] == list(effects.ROWS) and all(f" {name} " in table for name in effects.ROWS)
    taken = {run["row"]: run["taken"] for run in runs}
    assert taken["spoiled, auto"] == {"exposure": "affine", "masks": "auto"} and taken["clean, auto"] == {}
    assert taken["masked, auto"] == {"masks": "auto"} and taken["spoiled"] == {}
    assert all(math.isfinite(run["psnr"]) for run in runs)
    clean, spoiled = (training.load_capture(tmp_path / "out" / "wall" / name) for name in ("clean", "spoiled"))
    assert (len(clean.train), len(spoiled.train), len(spoiled.test)) == (8, 7, 2)
    pixels = {path: np.asarray(image.open(path), dtype=float) for item in (*clean.train, *clean.test, *spoiled.train)
              for path in item.files.values()}  # fmt: skip
    for item in clean.test:
        path = spoiled.test[0].files[1].with_name(item.files[1].name)
        assert path.read_bytes() == item.files[1].read_bytes()
    whole = {item.files[1].name: item for item in clean.train}
    factors = []
    for item in spoiled.train:
        kept = np.asarray(image.open(item.mask)) > 0
        assert 1 - kept.mean() == pytest.approx(0.1, abs=0.01)
        before, after = pixels[whole[item.files[1].name].files[1]][kept], pixels[item.files[1]][kept]
        factors.append(after.mean() / before.mean())
    assert min(factors) < 0.85 and max(factors) > 1.15


def test_room(tmp_path, run):
    """Its photographs show the points where the cameras say, in their colours."""
    image = pytest.importorskip("PIL.Image", reason="needs the train extra")
    program = importlib.import_module("room")
    folder = tmp_path / "room"
    run(program, folder, "--count", "4", "--size", "60x40", "--points", "200")
    capture = training.load_capture(folder, test_every=0)
    points, colors = capture.points
    assert len(capture.train) == 4 and len(points) == 200
    assert ((points >= -1e-4) & (points <= torch.tensor(program.ROOM[1]) + 1e-4)).all()
    errors = []
    for item in capture.train:
        picture = torch.from_numpy(np.array(image.open(item.files[1]), dtype=np.float32)) / 255
        in_camera = points.double() @ item.view.w2c[:3, :3].double().T + item.view.w2c[:3, 3].double()
        pixels = item.view.pixels_of(in_camera)
        shown = (in_camera[:, 2] > 0) & (pixels >= 0).all(1) & (pixels < torch.tensor([60, 40])).all(1)
        column, row = pixels[shown].long().unbind(1)
        errors.append((picture[row, column] - colors[shown]).abs().amax(1))
    # Half of the points or more are not hidden; textures vary within a pixel. Mirrored pictures have 0.13.
    assert torch.cat(errors).quantile(0.4) < 0.07
