"""What a training of this package writes beside its scene, as far as who shows the scene has to read it.

`training` builds on this module, and not the other way round: it writes these files, and reads options.json in full.
"""

from __future__ import annotations

import json
import math
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..footprints import Footprint, resolve_footprint
from .images import BACKGROUNDS, BLACK

SCENE, OPTIONS, CAMERAS = "scene.ply", "options.json", "cameras.json"


@dataclass(frozen=True)
class TrainingRecord:
    """What options.json says.

    Attributes:
        content: All of it.
        footprint: The scene was trained with it.
        finest: The smallest of its scales: 1 is the size of the photographs, 2 half of it.
        background: (r, g, b) in [0, 1], behind the scene; None where it does not say.
        is_early: Of a training before files of scenes named their footprint, and options.json the background.
    """

    content: dict[str, Any]
    footprint: Footprint
    finest: int
    background: tuple[float, float, float] | None
    is_early: bool

    @property
    def source(self) -> dict[str, Any]:
        """Where the pictures are from: `scene`, a folder, with further arguments of `training.load_capture`."""
        return self.content.get("source", {})

    @property
    def options(self) -> dict[str, Any]:
        """`training.TrainingOptions.to_dict`."""
        return self.content["options"]


def read_record(path: Path) -> TrainingRecord | None:
    """The record in a file; None where there is no file, or the options.json of another program, with a warning."""
    if not path.is_file():
        return None
    try:
        described = json.loads(path.read_text(encoding="utf-8-sig"))
        options = described["options"]
        footprint, scales = resolve_footprint(options["footprint"]), options["scales"]
        color = described.get("background", BLACK)
        good = bool(scales) and all(type(scale) is int and scale >= 1 for scale in scales)
        if not good or len(color) != 3 or not all(0 <= value <= 1 and math.isfinite(value) for value in color):
            raise ValueError
        is_early = "background" not in described
        background = BACKGROUNDS.get(options.get("background")) if is_early else tuple(map(float, color))
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        warnings.warn(f"{path}: ignored, it is not what `train` writes", stacklevel=3)
        return None
    return TrainingRecord(described, footprint, min(scales), background, is_early)
