"""One warning for programs that only render and choose no footprint: models of 3DGS's own rasterizer need another one.

A program that trains here renders with the footprint that it trained with, so that it needs no advice.
"""

from __future__ import annotations

import os
import sys
import warnings
from pathlib import Path

import torch

from .. import _C
from ..footprints import DILATED, ENVIRONMENT_VARIABLE, PAPER, RECOMMENDED, chosen_footprint
from .settings import GaussianRasterizationSettings

TEXT = (
    f"no footprint was chosen, so this renders with the default, {PAPER}, for parity with the paper of "
    "Analytic-Splatting. A model that was trained with 3DGS's own rasterizer looks right untouched with "
    f"{DILATED}: set {ENVIRONMENT_VARIABLE}={DILATED}, or footprint='{DILATED}' in the settings. Better: bake it "
    f"(python -m analytic_rasterizer bake), then take {RECOMMENDED}. (Choosing {PAPER} changes nothing but this "
    "warning. See docs/footprints.md.)"
)

is_due = True
"""Whether `give` may still have something to say."""


def give(settings: GaussianRasterizationSettings) -> None:
    """Warns, once per process, if these settings take the default and no call of this process has required a gradient.

    To be called after the operator, which notes whether it was asked for a gradient. Costs nothing once there is
    nothing more to say.
    """
    global is_due
    if _C.gradient_was_required() or chosen_footprint() is not None:
        is_due = False
    elif settings.takes_default():
        is_due = False  # before the warning, which a program may turn into an error
        warnings.warn(TEXT, stacklevel=_level_of_program())


def _level_of_program() -> int:
    """Of the frame that warnings.warn names: the first one outside of this package, its namesakes and torch."""
    root = Path(os.path.abspath(__file__)).parents[2]
    names = "analytic_rasterizer", "diff_gaussian_rasterization", "diff_gaussian_rasterization_ms"
    ours = tuple(os.path.join(root, name, "") for name in names)
    ours += (os.path.join(os.path.dirname(os.path.abspath(torch.__file__)), ""),)
    level, frame = 2, sys._getframe(2)
    while frame.f_back is not None and os.path.abspath(frame.f_code.co_filename).startswith(ours):
        level, frame = level + 1, frame.f_back
    return level
