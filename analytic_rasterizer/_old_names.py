"""Modules under the names that they had before they moved into folders: programs and pickles may have these names."""

import importlib
import sys

MOVED = {
    "advice": "render.advice",
    "arguments": "render.arguments",
    "autocast": "render.autocast",
    "camera": "cameras.camera",
    "camera_path": "cameras.path",
    "effects": "render.effects",
    "lens": "cameras.lens",
    "outputs": "render.outputs",
    "rasterizer": "render.rasterizer",
    "rotations": "cameras.rotations",
    "seam": "render.seam",
    "settings": "render.settings",
    "sphere": "render.sphere",
    "stages": "render.stages",
}


def keep(package: str) -> None:
    """Makes every old name mean the module that it is now: the same object, not a copy."""
    for old, new in MOVED.items():
        module = importlib.import_module(f"{package}.{new}")
        sys.modules[f"{package}.{old}"] = module  # where `import` looks first
        setattr(sys.modules[package], old, module)
