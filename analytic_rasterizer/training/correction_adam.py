"""The optimizer of what a training learns of photographs and cameras: Adam, at a rate of its own."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from .. import ops  # noqa: F401  (registers the fake kernels)

# Until so much of the training is over nothing is learned: corrections of a scene that has no shape yet would hide its
# errors. docs/internals/training.md has what was tried.
BEGIN = 0.1
RATE = 3e-3  # learning rate when it begins; it falls exponentially
RATE_END = 0.1  # of it, at the end
BETAS, EPS = (0.9, 0.999), 1e-8

_adam = torch.ops.analytic_rasterizer.adam_.default


class CorrectionAdam:
    """Adam with one count of steps for all corrections of a kind.

    Args:
        values: (N, ...) float32, a row per photograph or camera; changed in place.
    """

    def __init__(self, values: Tensor):
        self.values = values
        self.moments = [torch.zeros_like(values) for _ in BETAS]
        self.steps = 0

    def step(self, gradient: Tensor, share: float, rows: int | slice = slice(None)) -> None:
        """Takes a step of some rows with their gradient, when `share` of the training is over, BEGIN or more."""
        rate = RATE * RATE_END ** min((share - BEGIN) / (1 - BEGIN), 1.0)
        self.steps += 1
        moments = ([moment[rows]] for moment in self.moments)
        _adam([self.values[rows]], [gradient], *moments, [rate], [self.steps], *BETAS, EPS)

    def state_dict(self, name: str) -> dict[str, Any]:
        """Values, as `name`, and what the next step needs."""
        return {name: self.values, "moments": self.moments, "steps": self.steps}

    def load_state_dict(self, name: str, state: dict[str, Any]) -> None:
        """Takes what `state_dict` of the same `name` gave."""
        self.values.copy_(state[name])
        for own, moment in zip(self.moments, state["moments"]):
            own.copy_(moment)
        self.steps = state["steps"]
