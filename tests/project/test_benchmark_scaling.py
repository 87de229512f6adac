"""Programs in benchmarks/ that measure more of something: Gaussians, pixels, threads, ranks, load."""

import importlib
import math
import os
import subprocess
import sys
import types

import pytest
import torch
from benchmark_files import files_of, written
from places import ROOT
from processes import DEADLINE, python_path

import analytic_rasterizer as ar
from analytic_rasterizer import io
from analytic_rasterizer.analysis.timing import added_memory

pytestmark = pytest.mark.usefixtures("imports_of_benchmarks")


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
