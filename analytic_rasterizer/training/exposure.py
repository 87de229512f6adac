"""A colour correction for each training photograph, whose exposure and white balance may differ from the others'.

Of a rendered colour c it makes A c + b, with A 3x3 and b (3,), as the program of 3DGS of 2024 does. What is learned is
what a photograph has beyond all of them together: the mean over the photographs is kept at the identity. Photographs of
the test have no correction; `best_exposure` finds what would bring a picture nearest to its photograph.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from .. import ops  # noqa: F401  (registers the fake kernels)
from .correction_adam import BEGIN, CorrectionAdam

GAMMA = 2.2  # stored values are nearly light^(1 / GAMMA), and black stays black


class Exposures:
    """The corrections of V photographs, and their optimizer.

    Attributes:
        matrices: (V, 3, 4) float32, (A | b) of each.
    """

    def __init__(self, count: int, device: torch.device):
        self.matrices = torch.eye(3, 4, dtype=torch.float32, device=device).repeat(count, 1, 1)
        self.optimizer = CorrectionAdam(self.matrices)

    def start(self, stops: Tensor) -> None:
        """Starts from what was measured.

        Args:
            stops: (V, 3) how much more light of red, green and blue each photograph has, in powers of two; rows with
                NaN are not known, and start at the identity.
        """
        known = stops.isfinite().all(1)
        if not known.any():
            return
        gains = 2 ** (stops[known] / GAMMA)
        gains = torch.diag_embed((gains / gains.mean(0)).to(self.matrices))
        self.matrices[known.to(gains.device), :, :3] = gains

    def update(self, gradients: dict[int, Tensor], share: float) -> None:
        """Takes a step with gradients (3, 4) of some photographs, when `share` of the training is over."""
        if share < BEGIN:
            return
        for view, gradient in gradients.items():
            before = self.matrices[view].clone()
            self.optimizer.step(gradient, share, view)
            # So the mean stays where it was.
            self.matrices.add_(before.sub_(self.matrices[view]), alpha=1 / len(self.matrices))

    def state_dict(self) -> dict[str, Any]:
        return self.optimizer.state_dict("matrices")

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.optimizer.load_state_dict("matrices", state)


def corrected(
    image: Tensor, exposure: Tensor | None, vignetting: Tensor | None = None, center: Sequence[float] = ()
) -> Tensor:
    """A rendered picture (3, H, W) as a photograph with this exposure (3, 4) would have it, of a camera with such
    vignetting: coefficients (2,) of `Falloffs`, about the principal point `center` [px]."""
    if exposure is None and vignetting is None:
        return image
    return torch.ops.analytic_rasterizer.correct_colors(image, exposure, vignetting, center)


@torch.no_grad()
def best_exposure(image: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    """(3, 4) that brings the picture nearest to its target by least squares, in float64.

    The error of each pixel counts by the mask (H, W), once; the identity where nothing counts.
    """
    pixels, wanted = (t.flatten(1).double() for t in (image, target))
    weights = torch.ones_like(pixels[:1]) if mask is None else mask.flatten()[None].double()
    rows = torch.cat([pixels, torch.ones_like(pixels[:1])])
    weighted = rows * weights
    # A flat picture leaves the solution open; the identity is then as good as any other.
    damping = 1e-9 * weights.sum().clamp_min(1) * torch.eye(4, dtype=rows.dtype, device=rows.device)
    identity = torch.eye(3, 4, dtype=rows.dtype, device=rows.device)
    found = torch.linalg.solve(weighted @ rows.T + damping, weighted @ wanted.T + damping @ identity.T)
    return found.T.to(image.dtype)
