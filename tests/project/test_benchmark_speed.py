"""Programs in benchmarks/ that measure times of the library and of others, on a tiny scene."""

import collections
import importlib
import inspect
import json
import math
import sys
import types
from typing import Any

import originals
import pytest
import torch
from benchmark_files import files_of, written

import analytic_rasterizer as ar
from analytic_rasterizer import io
from analytic_rasterizer.dialects.gsplat import rasterization

pytestmark = pytest.mark.usefixtures("imports_of_benchmarks")


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
