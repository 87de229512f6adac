"""The vignetting of each camera as a training learns it, and as `evaluate` applies it.

A camera shows colours times v = 1 + k2 (r^2 - its mean) + k4 (r^4 - its mean), whose mean over the picture is 1. r is
the distance from the principal point, in halves of the diagonal. All photographs of a camera have one polynomial, those
of the test too; the scene has none.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from .. import io
from ..cameras.lens import SPHERE
from ..captures.vignetting import ONE_LENS, POWERS, cameras_of
from .correction_adam import BEGIN, CorrectionAdam
from .exposure import GAMMA

SAMPLES = 64  # of the squares of radii to which a polynomial is fitted
SAME_SHAPE = 0.01  # share by which proportions of pictures of one camera may differ, cut to a multiple of the scale


class Falloffs:
    """The polynomials of the cameras that took V photographs, and their optimizer.

    Args:
        views: Of the photographs.

    Attributes:
        cameras: Indices of the photographs of each of the C cameras.
        camera: By photograph, the index of its camera; None: a sphere has no radius.
        coefficients: (C, 2) float32, k2 and k4.
    """

    def __init__(self, views: Sequence[io.View], device: torch.device):
        flat = [place for place, view in enumerate(views) if view.lens is None or view.lens.model != SPHERE]
        self.cameras = [[flat[i] for i in places] for places in cameras_of([views[place] for place in flat])]
        self.camera: list[int | None] = [None] * len(views)
        for number, places in enumerate(self.cameras):
            for place in places:
                self.camera[place] = number
        self.views = views
        self.coefficients = torch.zeros(len(self.cameras), len(POWERS), dtype=torch.float32, device=device)
        self.optimizer = CorrectionAdam(self.coefficients)

    def start(self, measured: Mapping[int, tuple[Tensor, float]]) -> None:
        """Starts from what was measured.

        Args:
            measured: By photograph: slopes (2,) of `vignetting.Falloff`, and the radius up to which they hold.
        """
        for number, places in enumerate(self.cameras):
            known = [measured[place] for place in places if place in measured]
            if known:
                self.coefficients[number] = polynomial_of(*known[0], self.views[places[0]]).to(self.coefficients)

    def arguments(self, place: int, width: int, height: int) -> dict[str, Any]:
        """For a picture of this size of a photograph, by the names of the ops."""
        camera, view = self.camera[place], self.views[place]
        if camera is None:
            return {"vignetting": None, "center": []}
        cx, cy = view.middle
        center = [cx * width / view.width, cy * height / view.height]
        return {"vignetting": self.coefficients[camera], "center": center}

    def update(self, gradients: Mapping[int, Tensor], share: float) -> None:
        """Takes a step with gradients (2,) by photograph, when `share` of the training is over."""
        if share < BEGIN or not gradients:
            return
        summed = torch.zeros_like(self.coefficients)
        for place, gradient in gradients.items():
            summed[self.camera[place]] += gradient
        self.optimizer.step(summed, share)

    def state_dict(self) -> dict[str, Any]:
        return self.optimizer.state_dict("coefficients")

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.optimizer.load_state_dict("coefficients", state)

    def to_json(self) -> list[dict[str, Any]]:
        """What `read_falloffs` reads: for each camera its picture and focal length [px], and its photographs."""
        found = []
        for places, coefficients in zip(self.cameras, self.coefficients.tolist()):
            view = self.views[places[0]]
            size = {"width": view.width, "height": view.height, "focal_length": math.sqrt(view.fx * view.fy)}
            names = [self.views[place].name for place in places]
            found.append(size | {"coefficients": coefficients, "photographs": names})
        return found


class Known(NamedTuple):
    """A camera whose vignetting is known."""

    proportions: float  # of the longer side to the shorter
    focal: float  # natural logarithm of the focal length in diagonals
    coefficients: tuple[float, ...]


def known_falloffs(written: list[dict[str, Any]]) -> list[Known]:
    """The cameras of `Falloffs.to_json`."""
    return [
        Known(*_kind(camera["width"], camera["height"], camera["focal_length"]), tuple(camera["coefficients"]))
        for camera in written
    ]


def read_falloffs(path: Path) -> list[Known]:
    """Those of a file of `Falloffs.to_json`. Raises io.SceneError for a file that is missing or something else."""
    if not path.is_file():
        raise io.SceneError(f"{path}: no such file, and the training learned vignetting")
    try:
        return known_falloffs(json.loads(path.read_text()))
    except (ValueError, TypeError, KeyError) as error:
        raise io.SceneError(f"{path}: not what `train` writes ({error})") from None


def falloff_of(view: io.View, known: Sequence[Known]) -> tuple[float, ...] | None:
    """Coefficients of the camera of a view among those that are known; None: it is another one."""
    if view.lens is not None and view.lens.model == SPHERE:
        return None
    proportions, focal = _kind(view.width, view.height, math.sqrt(view.fx * view.fy))
    same = [camera for camera in known if abs(camera.proportions / proportions - 1) <= SAME_SHAPE]
    nearest = min(same, key=lambda camera: abs(camera.focal - focal), default=None)
    return nearest.coefficients if nearest and abs(nearest.focal - focal) <= ONE_LENS else None


def _kind(width: int, height: int, focal: float) -> tuple[float, float]:
    return max(width, height) / min(width, height), math.log(focal / math.hypot(width, height))


def polynomial_of(slopes: Tensor, radius: float, view: io.View) -> Tensor:
    """(2,) float64 coefficients for stored values of the light 2^(slopes of POWERS) up to a radius, by least squares
    over the area."""
    squares = torch.linspace(0, radius**2, SAMPLES, dtype=torch.float64)
    terms = torch.stack([squares ** (power / 2) for power in POWERS], 1)
    stored = 2 ** (terms @ slopes.double().cpu() / GAMMA)
    middle, *found = torch.linalg.lstsq(torch.cat([torch.ones_like(terms[:, :1]), terms], 1), stored[:, None]).solution
    found = torch.cat(found)
    x, y = (length**2 / (view.width**2 + view.height**2) for length in (view.width, view.height))
    # Means of powers of the radius about the middle of a picture.
    means = found.new_tensor([(x + y) / 3, x**2 / 5 + 2 * x * y / 9 + y**2 / 5])
    return found / (middle + found @ means)
