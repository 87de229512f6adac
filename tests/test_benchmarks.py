"""The programs in benchmarks/ run, on a scene so small that their numbers mean nothing."""

import importlib
import json
import math
import sys

import pytest
import scenes
import torch
from conftest import ROOT

from analytic_rasterizer import io
from analytic_rasterizer.dialects import DIALECTS


@pytest.fixture
def small_scene(tmp_path, monkeypatch):
    """Files of a scene and of views; benchmarks/ can be imported from."""
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    made = scenes.cast(scenes.random_scene(3, 50, degree=1), torch.float32)
    fields = {"means": made["means3D"], **{k: made[k] for k in ("scales", "rotations", "opacities", "shs")}}
    importlib.import_module("scene_files").save_npz(tmp_path / "scene.npz", io.Scene(**fields, sh_degree=1))
    camera = scenes.Camera().world_to_camera()
    io.save_views(tmp_path / "views.json", [io.View(name, 40, 30, 33.0, 30.0, camera, 21.0) for name in "ab"])
    return tmp_path


def test_effects(device, small_scene, monkeypatch, capsys):
    """Every row, with numbers in all of its columns."""
    effects = importlib.import_module("effects")
    arguments = [small_scene / "scene.npz", "--views", small_scene / "views.json", "--json", small_scene / "out.json"]
    options = ["--footprints", "box:samples=4", "--rounds", "1", "--scale", "0.5", "--threads", "1", "--device", device]
    monkeypatch.setattr(sys, "argv", ["effects.py", *map(str, arguments), *options])
    effects.main()
    table = capsys.readouterr().out
    results = json.loads((small_scene / "out.json").read_text())["results"]["box:samples=4"]
    assert list(results) == list(effects.ROWS)
    for name, result in results.items():
        assert f"| {name} |" in table
        for side in ("off", "on"):
            assert all(math.isfinite(value) for value in result[side].values())
            assert min(result[side]["forward"], result[side]["forward_backward"]) > 0


def test_dialects(monkeypatch, capsys):
    """A row for every dialect, and both calls of each make the same images."""
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    benchmark = importlib.import_module("dialects")
    monkeypatch.setattr(sys, "argv", ["dialects.py", "--rounds", "2"])
    benchmark.main()
    rows = capsys.readouterr().out.splitlines()[4:]
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


def test_speed(device, small_scene, monkeypatch, capsys):
    """A row for every footprint, with numbers in all of its columns."""
    speed = importlib.import_module("speed")
    footprints = ["box:samples=1", "mip"]
    arguments = [small_scene / "scene.npz", "--views", small_scene / "views.json", "--json", small_scene / "out.json"]
    options = ["--rounds", "1", "--sh-degree", "2", "--threads", "1", "--device", device]
    monkeypatch.setattr(sys, "argv", ["speed.py", *map(str, arguments), *options, "--footprints", *footprints])
    speed.main()
    lines = capsys.readouterr().out.splitlines()
    assert "50 Gaussians of SH degree 2, 2 views of 40x30" in lines[0]
    assert [line.split()[0] for line in lines[2:4]] == footprints
    written = json.loads((small_scene / "out.json").read_text())
    assert list(written["results"]) == footprints
    for name, result in written["results"].items():
        assert all(math.isfinite(value) for value in result.values())
        assert min(result["forward"], result["forward_backward"], result["pairs"]) > 0
        assert len(written["per_view"][name]) == 2


def test_losses(device, tmp_path, monkeypatch, capsys):
    """Every row, with a time in all of its columns."""
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    losses = importlib.import_module("losses")
    options = ["--sizes", "20x10", "--gaussians", "30", "--rounds", "1", "--threads", "1", "--device", device]
    monkeypatch.setattr(sys, "argv", ["losses.py", *options, "--json", str(tmp_path / "out.json")])
    losses.main()
    table = capsys.readouterr().out
    results = json.loads((tmp_path / "out.json").read_text())["results"]
    assert len(results) == 11
    for name, result in results.items():
        assert f"| {name} |" in table
        times = [result["call"]] + ([result["device"]] if device == "cuda" else [])
        assert all(0 < value < math.inf for value in times)


def test_training(device, tmp_path, monkeypatch, capsys):
    """A row for every variant, and a run for every variant and seed, on pictures of noise."""
    image = pytest.importorskip("PIL.Image", reason="needs the train extra")
    pytest.importorskip("scipy", reason="needs the train extra")
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    training = importlib.import_module("training")
    pixels = torch.randint(256, (16, 16, 4), dtype=torch.uint8, generator=torch.Generator().manual_seed(0)).numpy()
    image.fromarray(pixels).save(tmp_path / "a.png")
    frames = []
    for x in (0.0, 1.0):
        pose = torch.eye(4)
        pose[0, 3], pose[2, 3] = x, 4.0
        frames.append({"file_path": "a", "transform_matrix": pose.tolist()})
    for split in ("train", "test"):
        content = {"camera_angle_x": 0.7, "frames": frames}
        (tmp_path / f"transforms_{split}.json").write_text(json.dumps(content))
    (tmp_path / "more.json").write_text(json.dumps({"mine": {"scale_repeats": [3, 1, 1, 1], "density": "mcmc"}}))
    arguments = [tmp_path, "--more", tmp_path / "more.json", "--json", tmp_path / "out.json", "--device", device]
    names = ["plain", "mine", "quick"]
    options = ["--variants", *names, "--seeds", "0", "1", "--scales", "1,2", "--iterations", "12"]
    monkeypatch.setattr(sys, "argv", ["training.py", *map(str, arguments), *options, "--random-points", "20"])
    assert training.main() == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines[2:]] == names and all("±" in line for line in lines[2:])
    runs = json.loads((tmp_path / "out.json").read_text())["runs"]
    assert [(run["variant"], run["seed"]) for run in runs] == [(v, s) for s in (0, 1) for v in names]
    assert all(run["steps"] == 12 and math.isfinite(run["test"]["mean"]["psnr"]) for run in runs)
    assert runs[1]["options"]["scale_repeats"] == [3, 1]
    assert (runs[2]["options"]["scale_repeats"], runs[2]["options"]["density"]) == ([2, 1], "absgrad")
    monkeypatch.setattr(sys, "argv", ["training.py", str(tmp_path), "--variants", "none"])
    assert training.main() == 2


def test_approximations(small_scene, monkeypatch, capsys):
    """The program's first picture is the library's, and what is approximated changes it (no ray of it is dark)."""
    benchmark = importlib.import_module("approximations")
    arguments = [small_scene / "scene.npz", "--views", small_scene / "views.json", "--json", small_scene / "out.json"]
    options = ["--scales", "1", "--crop", "24", "20", "--samples", "2", "--limit-views", "1", "--threads", "1"]
    monkeypatch.setattr(sys, "argv", ["approximations.py", *map(str, arguments), *options])
    benchmark.main()
    assert "| a | 1/1 |" in capsys.readouterr().out
    [result] = json.loads((small_scene / "out.json").read_text())["results"]
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
    scene = io.Scene(
        means=torch.tensor([[0.0, 0.0, 4.0], [0.0, 0.0, 4.01]]),
        scales=torch.tensor([[1.0, 1.0, 0.01]]).repeat(2, 1),
        rotations=torch.tensor([[math.cos(turn), 0, math.sin(turn), 0], [math.cos(turn), 0, -math.sin(turn), 0]]),
        opacities=torch.full((2, 1), 0.99),
        shs=torch.tensor([[[1.5, -1.5, -1.5]], [[-1.5, 1.5, -1.5]]]),
        sh_degree=0,
    )
    view = io.View("a", 32, 16, 30.0, 30.0, torch.eye(4, dtype=torch.float64))
    splats = benchmark.Splats(scene, view)
    by_center, by_ray = (
        benchmark.render(splats, view, (0, 0), (32, 16), 2, benchmark.Variant(central_order=central))
        for central in (True, False)
    )
    left, right = (slice(None), 8, 11), (slice(None), 8, 20)
    assert by_center[left][0] > by_center[left][1] and by_center[right][0] > by_center[right][1]
    assert (by_ray[left][0] > by_ray[left][1]) != (by_ray[right][0] > by_ray[right][1])
