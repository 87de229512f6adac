"""What scenes, views and pictures need in common."""

from __future__ import annotations

import importlib

import torch


class SceneError(ValueError):
    """A scene or views file that cannot be used; the message names the file and what is wrong."""


def optional_import(name: str, extra: str = "cli"):
    """The module `name`; ImportError naming the extra that installs it when it is missing."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        package = name.split(".")[0]
        raise ImportError(f"this needs {package}: pip install analytic_rasterizer[{extra}] ({error})") from None


def to_image(color: torch.Tensor):
    """A Pillow image of color (3, H, W): clamped to [0, 1], rounded to 8 bits."""
    pixels = color.detach().clamp(0, 1).mul(255).round().to("cpu", torch.uint8)
    return optional_import("PIL.Image").fromarray(pixels.permute(1, 2, 0).contiguous().numpy())


def first_line(error: BaseException) -> str:
    """Of what an error says."""
    return str(error).partition("\n")[0]
