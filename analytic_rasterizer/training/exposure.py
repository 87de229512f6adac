"""A colour correction for each training photograph, whose exposure and white balance may differ from the others'.

Of a rendered colour c it makes A c + b, with A 3x3 and b (3,), as the program of 3DGS of 2024 does. What is learned is
what a photograph has beyond all of them together: the mean over the photographs is kept at the identity. Photographs of
the test have no correction; `corrected_psnr` asks how good a picture would be with the best one.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from .optimizer import TrainingAdam

# The share of the training that is over before anything is learned: the corrections of a scene without shape would hide
# its errors. Where the start is measured they may begin earlier.
BEGIN, BEGIN_MEASURED = 0.3, 0.1
RATE, RATE_END = 3e-3, 3e-4  # learning rates then and at the end, exponential in between
# Of sRGB: stored values are nearly (1 + OFFSET) light^(1 / POWER) - OFFSET.
POWER, OFFSET = 2.4, 0.055


class Exposures:
    """The corrections of V photographs, and their optimizer.

    Attributes:
        matrices: (V, 3, 4) float32, (A | b) of each.
        begin: The share of the training after which they are learned.
    """

    def __init__(self, count: int, device: torch.device):
        self.identity = torch.eye(3, 4, dtype=torch.float32, device=device)
        self.matrices = self.identity.repeat(count, 1, 1)
        self.optimizer = TrainingAdam([self.matrices])
        self.begin = BEGIN

    def start(self, stops: Tensor) -> None:
        """Starts from what was measured.

        Args:
            stops: (V, 3) how much more light of red, green and blue each photograph has, in powers of two; rows with
                NaN are not known, and start at the identity.
        """
        known = stops.isfinite().all(1)
        if not known.any():
            return
        gains = 2 ** (stops[known] / POWER)
        gains = gains / gains.mean(0)
        matrices = torch.cat([torch.diag_embed(gains), OFFSET * (gains - 1)[:, :, None]], 2)
        self.matrices[known.to(self.matrices.device)] = matrices.to(self.matrices)
        self.begin = BEGIN_MEASURED

    def update(self, gradients: dict[int, Tensor], share: float) -> None:
        """Takes a step with gradients (3, 4) of some photographs, when `share` of the training is over."""
        if share < self.begin:
            return
        learned = min((share - self.begin) / (1 - self.begin), 1.0)
        self.optimizer.param_groups[0]["lr"] = RATE * (RATE_END / RATE) ** learned
        grad = torch.zeros_like(self.matrices)
        rows = torch.zeros(len(grad), dtype=torch.bool, device=grad.device)
        for view, gradient in gradients.items():
            grad[view] += gradient
            rows[view] = True
        self.matrices.grad = grad
        self.optimizer.update(rows)
        self.matrices.grad = None
        self.matrices += self.identity - self.matrices.mean(0)

    def state_dict(self) -> dict[str, Any]:
        return {"matrices": self.matrices, "begin": self.begin, "optimizer": self.optimizer.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.matrices.copy_(state["matrices"].to(self.matrices))
        self.begin = state.get("begin", BEGIN)  # older files have none
        self.optimizer.load_state_dict(state["optimizer"])


class _Corrected(torch.autograd.Function):
    """By the formulas of csrc/torch/picture.cpp, for the same bits."""

    @staticmethod
    def forward(ctx, image: Tensor, exposure: Tensor) -> Tensor:
        ctx.save_for_backward(image, exposure)
        matrix = exposure[:, :3].reshape(3, 3, 1, 1)
        return matrix.mul(image[None]).sum(1) + exposure[:, 3].reshape(3, 1, 1)

    @staticmethod
    def backward(ctx, dL_dcorrected: Tensor) -> tuple[Tensor, Tensor]:
        image, exposure = ctx.saved_tensors
        matrix = exposure[:, :3].t().reshape(3, 3, 1, 1)
        dL_dimage = matrix.mul(dL_dcorrected[None]).sum(1)
        of_matrix = dL_dcorrected[:, None].mul(image[None]).sum((2, 3))
        return dL_dimage, torch.cat([of_matrix, dL_dcorrected.sum((1, 2))[:, None]], 1)


def corrected(image: Tensor, exposure: Tensor | None) -> Tensor:
    """A rendered picture (3, H, W) as a photograph with this exposure (3, 4) would have it."""
    return image if exposure is None else _Corrected.apply(image, exposure)


@torch.no_grad()
def best_exposure(image: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    """(3, 4) that brings the picture nearest to its target by least squares, in float64; of what a mask counts."""
    pixels, wanted = (t.flatten(1).double() for t in (image, target))
    weights = torch.ones_like(pixels[:1]) if mask is None else mask.flatten()[None].double()
    rows = torch.cat([pixels, torch.ones_like(pixels[:1])]) * weights
    # A flat picture leaves the solution open; the identity is then as good as any other.
    damping = 1e-9 * weights.square().sum() * torch.eye(4, dtype=rows.dtype, device=rows.device)
    identity = torch.eye(3, 4, dtype=rows.dtype, device=rows.device)
    found = torch.linalg.solve(rows @ rows.T + damping, rows @ (wanted * weights).T + damping @ identity.T)
    return found.T.to(image.dtype)
