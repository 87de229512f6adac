"""Fixtures of tests of the programs in benchmarks/."""

import importlib
import sys

import pytest
import scenes
import torch
from places import ROOT

from analytic_rasterizer import io
from analytic_rasterizer.gaussians import Gaussians


@pytest.fixture
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


@pytest.fixture
def small_scene(tmp_path):
    """Files of a scene and of views."""
    made = scenes.cast(scenes.random_scene(3, 50, degree=1), torch.float32)
    fields = {"means": made["means3D"], **{k: made[k] for k in ("scales", "rotations", "opacities", "shs")}}
    importlib.import_module("scene_files").save_npz(tmp_path / "scene.npz", Gaussians.from_activated(**fields))
    camera = scenes.Camera().world_to_camera()
    io.save_views(tmp_path / "views.json", [io.View(name, 40, 30, 33.0, 30.0, camera, 21.0) for name in "ab"])
    return tmp_path
