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
