"""`FixedDensity`, the density control that changes nothing, and the base of the others.

It holds what all share: it replaces rows of the Gaussians, of the optimizer's state and of further tensors.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from ..distributed.ranks import ALONE, Ranks
from ..gaussians import Gaussians
from ..optim import parameter_index, replace_rows


class FixedDensity:
    """Changes nothing, and has the methods and attributes of the other controls.

    Args:
        gaussians: What is trained: leaves that require gradients, each in a group of the optimizer. Fields other
            than the means may also require no gradient and be in no group; they are not trained, but split, reset and
            pruned with the others.
        optimizer: Any of torch, or of `optim`, that has these parameters. It need not have made a step, and may have
            other parameters, which stay as they are.
        extra: More tensors that have a row for each Gaussian, (N, ...), by name, such as features or labels: leaves in
            the optimizer's groups, or tensors without gradient. Their rows are cloned, split, moved and pruned with
            those of the Gaussians, without change of their values.
        seed: Of what is drawn.
        ranks: For trainings on several processes, each of which has other Gaussians. Every rank decides about its own;
            the limit is that of all.

    Attributes:
        gaussians: Those to render in the next step. `after_step` replaces the tensors, in the optimizer as well.
        extra: The same of `extra`.
        pruned: How many were pruned the last time, by cause: "opacity" and "size", one-element tensors.
        row_state: Names of the attributes that have a row per Gaussian.

    Raises:
        TypeError: An argument is of another type.
        ValueError: A tensor that requires a gradient is in none of the optimizer's groups, or is no leaf; tensors have
            different numbers of rows or are on different devices; a name of `extra` is that of a field.
    """

    row_state: tuple[str, ...] = ()

    def __init__(
        self,
        gaussians: Gaussians,
        optimizer: torch.optim.Optimizer,
        *,
        extra: Mapping[str, Tensor] | None = None,
        seed: int = 0,
        ranks: Ranks = ALONE,
    ):
        extra = dict(extra or {})
        _check_parameters(gaussians, optimizer, extra)
        self.gaussians, self.optimizer, self.extra, self.ranks = gaussians, optimizer, extra, ranks
        self.pruned: dict[str, Tensor] = {}
        self.generator = torch.Generator(gaussians.means.device).manual_seed(seed)

    @property
    def watches(self) -> bool:
        """Whether it still wants to see gradients."""
        return False

    @property
    def columns(self) -> int:
        """Columns of the gradients that it takes: 3, or 4 with sums of absolute values."""
        return 3

    def leaf(self) -> Tensor | None:
        """What to render the next picture with as `means2D`, so that it gets the gradient that `observe` reads.

        (N, columns), uninitialized, for its values are not read. Every picture of a step needs its own. None where the
        control wants no gradients; the rasterizer accepts that."""
        if not self.watches:
            return None
        means = self.gaussians.means
        return means.new_empty(len(means), self.columns, requires_grad=True)

    @torch.no_grad()
    def keep(self, kept: Tensor) -> None:
        """Takes away all Gaussians but those of the mask `kept` (N,) bool. Averages over the others go on."""
        self._replace(kept, {name: tensor[:0] for name, tensor in self._tensors().items()})
        for name in self.row_state:
            setattr(self, name, getattr(self, name)[kept])

    def observe(self, leaf: Tensor | None, radii: Tensor) -> None:
        """Looks at one picture, after the backward pass and before the optimizer's step. Nothing waits for the device.

        Args:
            leaf: What `leaf` gave for this picture; with None nothing is done.
            radii: (N,) int32, px, that the rasterizer returned. Only Gaussians with a radius above 0 count as seen.

        Raises:
            ValueError: There is no gradient, or the Gaussians have changed since `leaf`.
        """
        if leaf is None:
            return
        if leaf.grad is None:
            raise ValueError("leaf has no gradient: render with means2D=leaf, and call backward before observe")
        self.observe_gradients(leaf.grad, radii)

    def observe_gradients(self, gradients: Tensor, radii: Tensor) -> None:
        """As `observe`, with `radii`, by the `gradients` (N, columns) themselves."""

    def observe_rows(self, rows: Tensor, gradients: Tensor) -> None:
        """As `observe`, for a picture whose gradients are known by row.

        Args:
            rows: (n,) int64, the Gaussians that the picture shows, each once.
            gradients: (n, 2) with respect to their means in normalized device coordinates; where `columns` is 4, the
                sums of absolute values.
        """

    def forget(self) -> None:
        """Begins new averages, of as many Gaussians as there are now."""

    def after_step(self, step: int, share: float, stride: int = 1) -> bool:
        """Changes the Gaussians where it is time; to be called after every step of the optimizer.

        Where Gaussians change, the new tensors have no gradients.

        Args:
            step: Steps taken, this one included.
            share: Of the training that is over, 0 to 1: `step / steps`.
            stride: Steps that the last step of the optimizer stands for, where it stands for several. A period ends
                if one of them is a multiple of it.

        Returns:
            Whether there are other Gaussians now.

        Raises:
            ValueError: The optimizer no longer has the parameters of `gaussians` or `extra`.
        """
        return False

    def state_dict(self) -> dict[str, Any]:
        """All that decides what happens next, beside the Gaussians, `extra` and the optimizer."""
        return {"generator": self.generator.get_state()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Goes on from the `state` that `state_dict` gave, with the Gaussians and the optimizer of that moment.

        Raises:
            ValueError: It is of another number of Gaussians.
        """
        self.generator.set_state(state["generator"].cpu())

    def _tensors(self) -> dict[str, Tensor]:
        """All that has a row per Gaussian, by name."""
        return self.gaussians._asdict() | self.extra

    def _replace(self, kept: Tensor, added: dict[str, Tensor]) -> None:
        """Keeps the rows of the mask, and adds others after them."""
        rows = replace_rows(self.optimizer, self._tensors(), kept, added)
        self.extra = {name: rows.pop(name) for name in self.extra}
        self.gaussians = Gaussians(**rows)


def passes(step: int, period: int, stride: int = 1) -> bool:
    """Whether there is a multiple of `period` among the `stride` steps that end with `step`."""
    return step // period > (step - stride) // period


def normal_numbers(like: Tensor, generator: torch.Generator) -> Tensor:
    """As many numbers from a normal distribution, of the same dtype."""
    return torch.randn(like.shape, generator=generator, dtype=like.dtype, device=like.device)


def _check_parameters(gaussians: Any, optimizer: Any, extra: dict[str, Any]) -> None:
    """Raises unless these are the optimizer's, as `FixedDensity` has it."""
    if not isinstance(gaussians, Gaussians):
        raise TypeError(f"gaussians must be Gaussians, got {type(gaussians).__name__}")
    if not isinstance(optimizer, torch.optim.Optimizer):
        raise TypeError(f"optimizer must be a torch.optim.Optimizer, got {type(optimizer).__name__}")
    known = gaussians._asdict()
    if known.keys() & extra.keys():
        raise ValueError(f"extra must not have the name of a field of Gaussians, got {', '.join(known & extra.keys())}")
    means = gaussians.means
    for name, tensor in (known | extra).items():
        if not isinstance(tensor, Tensor):
            raise TypeError(f"{name} must be a tensor, got {type(tensor).__name__}")
        if tensor.dim() == 0 or len(tensor) != len(means) or tensor.device != means.device:
            expected = f"{len(means)} rows on {means.device}, as the means"
            raise ValueError(f"{name} must have {expected}, got shape {tuple(tensor.shape)} on {tensor.device}")
        if not tensor.is_leaf:
            raise ValueError(f"{name} must be a leaf of the graph: give {name}.detach().requires_grad_() to both")
        index = parameter_index(optimizer, name, tensor)
        if tensor is means and (index is None or not means.requires_grad):
            raise ValueError("means must be a parameter of the optimizer that requires a gradient")
