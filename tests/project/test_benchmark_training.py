"""Programs in benchmarks/ that train, and captures for them."""

import dataclasses
import importlib
import json
import math
import sys

import numpy as np
import pytest
import torch
import wall
from benchmark_files import written
from capture_files import circle, write_nerf_synthetic
from processes import python_path

import analytic_rasterizer as ar
from analytic_rasterizer import io, training

pytestmark = pytest.mark.usefixtures("imports_of_benchmarks")


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
