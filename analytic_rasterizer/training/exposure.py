"""A colour correction for each training photograph, whose exposure and white balance may differ from the others'.

Of a rendered colour c it makes A c + b, with A 3x3 and b (3,), as the program of 3DGS of 2024 does. What is learned is
what a photograph has beyond all of them together: the mean over the photographs is kept at the identity. Photographs of
the test have no correction; `best_exposure` finds what would bring a picture nearest to its photograph.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from .optimizer import TrainingAdam

# Until so much of the training is over nothing is learned: corrections of a scene that has no shape yet would hide its
# errors. Even later they may take for exposure what a photograph shows from its direction. So what was measured is
# changed more slowly than what is unknown.
BEGIN = 0.3
RATE, RATE_MEASURED = 3e-3, 1e-3  # learning rates when it begins; they fall exponentially
RATE_END = 0.1  # of them, at the end
GAMMA = 2.2  # stored values are nearly light^(1 / GAMMA), and black stays black


class Exposures:
    """The corrections of V photographs, and their optimizer.

    Attributes:
        matrices: (V, 3, 4) float32, (A | b) of each.
        rate: The learning rate when learning begins.
    """

    def __init__(self, count: int, device: torch.device):
        self.identity = torch.eye(3, 4, dtype=torch.float32, device=device)
        self.matrices = self.identity.repeat(count, 1, 1)
        self.optimizer = TrainingAdam([self.matrices])
        self.rate = RATE

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
        self.rate = RATE_MEASURED

    def update(self, gradients: dict[int, Tensor], share: float) -> None:
        """Takes a step with gradients (3, 4) of some photographs, when `share` of the training is over."""
        if share < BEGIN:
            return
        self.optimizer.param_groups[0]["lr"] = self.rate * RATE_END ** min((share - BEGIN) / (1 - BEGIN), 1.0)
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
        return {"matrices": self.matrices, "rate": self.rate, "optimizer": self.optimizer.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.matrices.copy_(state["matrices"].to(self.matrices))
        self.rate = state.get("rate", RATE)  # older files have none
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
