"""What a training learns of photographs beside the scene: their exposures, and the vignetting of their cameras."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from .. import io
from .exposure import Exposures
from .falloff import Falloffs, Known, known_falloffs
from .files import EXPOSURES, VIGNETTING, write_json
from .options import TrainingOptions


class Corrections:
    """The corrections of photographs that the options ask for.

    Attributes:
        exposures, falloffs: None: not asked for.
    """

    def __init__(self, options: TrainingOptions, views: Sequence[io.View], device: torch.device):
        self.views = views
        self.exposures = Exposures(len(views), device) if options.exposure == "affine" else None
        self.falloffs = Falloffs(views, device) if options.vignetting == "polynomial" else None
        self._of_exposures: dict[int, Tensor] = {}
        self._of_falloffs: dict[int, Tensor] = {}

    def arguments(self, place: int, target: Tensor) -> dict[str, Any]:
        """For a picture (3, H, W) of a photograph, by the names of the ops."""
        given = {"exposure": None if self.exposures is None else self.exposures.matrices[place]}
        if self.falloffs is None:
            return given | {"vignetting": None, "center": []}
        return given | self.falloffs.arguments(place, target.shape[2], target.shape[1])

    def observe(self, place: int, gradients: list[Tensor]) -> None:
        """Takes the last of the gradients of a picture of a photograph: those of its corrections.

        A step may have a photograph at several scales.
        """
        if self.falloffs is not None and self.falloffs.camera[place] is not None:
            _add(self._of_falloffs, place, gradients.pop())
        if self.exposures is not None:
            _add(self._of_exposures, place, gradients.pop())

    def update(self, share: float) -> None:
        """Takes a step with what was observed since the last, when `share` of the training is over."""
        for learned, gradients in ((self.exposures, self._of_exposures), (self.falloffs, self._of_falloffs)):
            if learned is not None:
                learned.update(gradients, share)
            gradients.clear()

    def state_dict(self) -> dict[str, Any]:
        learned = {"exposures": self.exposures, "falloffs": self.falloffs}
        return {name: None if value is None else value.state_dict() for name, value in learned.items()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        if self.exposures is not None:
            self.exposures.load_state_dict(state["exposures"])
        if self.falloffs is not None:
            self.falloffs.load_state_dict(state["falloffs"])

    def known(self) -> list[Known]:
        """The vignetting of cameras as it is at present."""
        return [] if self.falloffs is None else known_falloffs(self.falloffs.to_json())

    def write(self, folder: Path) -> None:
        """Their files. Raises OSError."""
        if self.exposures is not None:
            names = [view.name for view in self.views]
            write_json(folder / EXPOSURES, dict(zip(names, self.exposures.matrices.tolist())))
        if self.falloffs is not None:
            write_json(folder / VIGNETTING, self.falloffs.to_json())


def _add(gradients: dict[int, Tensor], place: int, gradient: Tensor) -> None:
    earlier = gradients.get(place)
    gradients[place] = gradient if earlier is None else earlier + gradient
