"""Trained scenes that do not ship with the project."""

import importlib.util
import json

import pytest
import torch
from places import SHARED


def shared_scene(name):
    """A trained scene that does not ship with the project: (inputs float32, list of views)."""
    data, reader = SHARED / "data", SHARED / "tools" / "qsplat.py"
    if not (reader.exists() and (data / f"{name}.npz").exists()):
        pytest.skip("needs the optional ../shared scenes next to the project")
    spec = importlib.util.spec_from_file_location("qsplat", reader)
    qsplat = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(qsplat)
    stored = {k: torch.from_numpy(v) for k, v in qsplat.load(str(data / f"{name}.npz")).items()}
    inputs = {
        "means3D": stored["means"],
        "means2D": torch.zeros_like(stored["means"]),
        "opacities": torch.sigmoid(stored["logit_opacity"])[:, None],
        "shs": stored["sh"],
        "scales": torch.exp(stored["log_scales"]),
        "rotations": stored["quats"],
    }
    views = json.loads((data / f"{name}_lo.json").read_text())
    return {name: value.float().contiguous() for name, value in inputs.items()}, views
