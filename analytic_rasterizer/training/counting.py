"""Gaussians that no photograph counts: wherever they are shown, masks leave it out.

Nothing ever moves them, so that they would stay as fog beside what is trained.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ..captures.pictures import Pictures
from ..density import FixedDensity
from ..gaussians import Gaussians
from .health import Trainer
from .options import TrainingOptions

COUNTED = "counted"  # the rows among `FixedDensity.extra`


class Counting:
    """Looks for such Gaussians while their number may change, over one whole pass of the pictures at least.

    The gradient of a mean tells: of a pixel that does not count it is zero, to the bit.

    Args:
        per_pass: Pictures of a pass.

    Attributes:
        begun: The number of the first picture of this look.
        pruned: How many Gaussians were taken away, of all ranks.
    """

    def __init__(self, per_pass: int):
        self.per_pass, self.begun, self.pruned = per_pass, 0, 0

    @staticmethod
    def called_for(options: TrainingOptions, pictures: Pictures) -> bool:
        """Whether masks leave out something, and the number of Gaussians may change."""
        return options.density != "none" and min(pictures.shares, default=1) < 1

    @torch.no_grad()
    def observe(self, trainer: Trainer) -> None:
        """Looks at the gradients of a step."""
        if trainer.progress.share < trainer.density.options.densify_until:
            trainer.density.extra[COUNTED] |= trainer.gaussians.means.grad.any(1)

    @torch.no_grad()
    def drop(self, trainer: Trainer) -> None:
        """Takes away what no picture of a whole pass has counted, and begins anew; nothing within a pass. Collective.

        Waits for the device.

        Raises:
            RuntimeError: No picture counts any Gaussian.
        """
        shown = trainer.progress.step * trainer.options.pictures_per_step
        first = -(-self.begun // self.per_pass)  # pass that began in this look
        if shown // self.per_pass <= first:
            return
        kept = trainer.density.extra[COUNTED] > 0
        lost = sum(trainer.ranks.exchange(len(kept) - int(kept.sum())))
        if lost == trainer.count:
            raise RuntimeError(
                f"masks leave out all that the {lost:,} Gaussians show by step {trainer.progress.step:,}, so that "
                f"nothing can be learned any more: --points may be elsewhere; --masks none ignores masks"
            )
        if lost:
            trainer.keep(kept)
        self.pruned += lost
        self.begun = shown
        trainer.density.extra[COUNTED].zero_()

    def state_dict(self, density: FixedDensity) -> dict[str, Any]:
        return {COUNTED: density.extra[COUNTED], "begun": self.begun, "pruned": self.pruned}

    def load_state_dict(self, density: FixedDensity, state: dict[str, Any]) -> None:
        """Goes on from the `state` that `state_dict` gave, where the density control has as many Gaussians."""
        density.extra[COUNTED] = state[COUNTED].to(density.gaussians.means.device, copy=True)
        self.begun, self.pruned = state["begun"], state["pruned"]


def no_rows(gaussians: Gaussians) -> dict[str, Tensor]:
    """`FixedDensity.extra` before anything was counted."""
    means = gaussians.means
    return {COUNTED: torch.zeros(len(means), dtype=torch.uint8, device=means.device)}
