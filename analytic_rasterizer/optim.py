"""Optimisers for Gaussians, beside those of torch: a step on all parameters at once, in one kernel on CUDA.

`replace_rows` gives the parameters of any optimiser other rows when the number of Gaussians changes.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

import torch
from torch import Tensor

from . import ops  # noqa: F401  (registers the fake kernels)
from .checks import check_tensors
from .footprints import check_device

__all__ = ["FusedAdam", "SparseGaussianAdam", "clear_moments", "replace_rows"]

_adam = torch.ops.analytic_rasterizer.adam_.default


class FusedAdam(torch.optim.Optimizer):
    """torch.optim.Adam, with one kernel for the parameters of all groups on CUDA, and little work of the host.

    Of a parameter p with gradient g, after t steps on it:

        m = b1 m + (1 - b1) g;  v = b2 v + (1 - b2) g^2
        p = p - lr / (1 - b1^t) * m / (sqrt(v) / sqrt(1 - b2^t) + eps)

    [Kingma and Ba, "Adam", 2015, with eps outside of the root as in torch.] Parameters without a gradient are left as
    they are. There is no weight decay, no AMSGrad and no `maximize`. The state of a parameter is that of torch, `step`,
    `exp_avg` and `exp_avg_sq`, except that `step` is an int. A `state_dict` of torch.optim.Adam can be loaded; for the
    other way round `step` has to be made a tensor. A CUDA graph of a step repeats the `step` and the
    learning rates that it was captured with.

    A group may have two learning rates: with "head" and "head_lr" the first `head` entries along the second dimension
    of its parameters learn at `head_lr`, and the others at `lr`. So the harmonics of Gaussians (P, K, 3), of which the
    constant learns faster, can be one parameter, which need not be concatenated for the rasterizer.

    Args:
        params: Tensors or groups, as every optimiser of torch takes them: float32 or float64, all of one dtype and on
            one device, the CPU or a CUDA device. Tensors may be empty. They may have any strides and are updated in
            place; one that is not contiguous is copied in every step, before the kernel and back after it. An expanded
            one, several of whose numbers share memory, is refused.
        lr: Learning rate of groups that name none; each group may have its own.
        betas: Decay rates of the first and the second moment, each in [0, 1), the same in all groups.
        eps: Added to the root of the second moment, at least 0, the same in all groups.

    Raises:
        ValueError: A number is out of its range.
    """

    def __init__(self, params, lr: float = 1e-3, betas: tuple[float, float] = (0.9, 0.999), eps: float = 1e-8):
        if not (math.isfinite(lr) and lr >= 0):
            raise ValueError(f"lr must be finite and not negative, got {lr}")
        if len(betas) != 2 or not all(0 <= beta < 1 for beta in betas):
            raise ValueError(f"betas must be two numbers in [0, 1), got {betas}")
        if not (math.isfinite(eps) and eps >= 0):
            raise ValueError(f"eps must be finite and not negative, got {eps}")
        super().__init__(params, {"lr": lr, "betas": betas, "eps": eps})

    @torch.no_grad()
    def step(self, closure=None, *, rows: Tensor | None = None):
        """Takes one step. Nothing waits for the device.

        Args:
            closure: Computes the loss and its gradients anew, as for every optimiser of torch.
            rows: (P,) bool or uint8, on the device of the parameters. Only rows of the parameters, along their first
                dimension of size P, whose number is not 0 are updated; the others keep their values and moments. The
                bias is corrected for the steps of the optimiser, not for those of a row.

        Returns:
            What `closure` returned, or None.

        Raises:
            TypeError: A parameter is neither float32 nor float64, or not of the dtype of the others; a gradient is of
                another dtype; rows is not a tensor of bool or uint8.
            ValueError: Parameters are not on one device, share memory with each other or within themselves, or do not
                have P rows; a gradient is sparse; groups differ in betas or eps; a learning rate is not finite or
                negative; a parameter has fewer than `head` entries along its second dimension, or none.
            RuntimeError: CUDA tensors, and an extension without CUDA.
        """
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        self.update(rows)
        return loss

    @torch.no_grad()
    def update(self, rows: Tensor | None = None) -> None:
        """`step` with `rows`, without what torch puts around it for hooks and its profiler, which takes as long again.

        Raises:
            TypeError, ValueError, RuntimeError: As `step`.
        """
        _update(self, rows, betas=_common(self, "betas"))

    def zero_grad(self, set_to_none: bool = True) -> None:
        """Forgets the gradients, or sets them to zero where not `set_to_none`."""
        if not set_to_none:
            super().zero_grad(set_to_none=False)
            return
        for group in self.param_groups:
            for parameter in group["params"]:
                parameter.grad = None

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Takes over what `state_dict` gave, of this class or of torch.optim.Adam.

        Raises:
            ValueError: Groups or parameters do not fit, or a group has weight decay, AMSGrad or `maximize`.
        """
        for group in state_dict["param_groups"]:
            for name in ("weight_decay", "amsgrad", "maximize"):
                if group.get(name):
                    raise ValueError(f"FusedAdam has no {name}, but the state has {name} = {group[name]}")
        # torch's state has no heads; those of the groups stay.
        heads = [{k: group[k] for k in ("head", "head_lr") if k in group} for group in self.param_groups]
        super().load_state_dict(state_dict)
        for group, head, given in zip(self.param_groups, heads, state_dict["param_groups"]):
            group.update({k: value for k, value in head.items() if k not in given})


class SparseGaussianAdam(torch.optim.Adam):
    """Adam that moves the Gaussians in the picture only, with decays 0.9 and 0.999 and without correction of bias.

    Args:
        params: Groups of one tensor each, whose leading dimension is that of the Gaussians. What `FusedAdam` asks of
            parameters is asked here too.
        lr: Learning rate of groups that name none.
        eps: Added to the root of the second moment, the same in all groups.
    """

    def __init__(self, params, lr: float, eps: float):
        super().__init__(params=params, lr=lr, eps=eps)

    @torch.no_grad()
    def step(self, visibility: Tensor, N: int) -> None:
        """Moves the rows of visible Gaussians; all others keep their values and their moments.

        Args:
            visibility: (N,) bool.
            N: Number of Gaussians.

        Raises:
            TypeError, ValueError, RuntimeError: As from `FusedAdam.step`; visibility has another shape, a group has
                several tensors, or a tensor is not made of N rows.
        """
        check_tensors(None, visibility=visibility)
        if visibility.shape != (N,):
            raise ValueError(f"visibility must have shape ({N},), got {tuple(visibility.shape)}")
        for group in self.param_groups:
            if len(group["params"]) != 1:
                raise ValueError(f"a group must have one tensor, got {len(group['params'])}")
            (parameter,) = group["params"]
            if parameter.grad is not None and len(parameter) != N:
                raise ValueError(f"parameters must have {N} rows, got shape {tuple(parameter.shape)}")
        _update(self, visibility.bool(), betas=(0.9, 0.999), bias_correction=False)


MOMENTS = ("exp_avg", "exp_avg_sq")  # of Adam, in the state of a parameter


@torch.no_grad()
def replace_rows(
    optimizer: torch.optim.Optimizer, tensors: Mapping[str, Tensor], kept: Tensor, added: Mapping[str, Tensor]
) -> dict[str, Tensor]:
    """Removes and adds rows of tensors that have one row per Gaussian, and of the optimiser's state for them.

    A parameter of the optimiser is replaced by a new leaf in the same group. Tensors of its state that have the shape
    of the parameter, such as both moments of Adam, keep the rows of `kept`, and get zeros for the rows of `added`. All
    else in the state, such as the number of steps, stays as it is. A parameter without state gets none. Tensors that
    are no parameters, such as labels, only get the new rows.

    Args:
        optimizer: Any optimiser of torch, `FusedAdam` and `SparseGaussianAdam` among them. Its parameters that are not
            in `tensors` stay.
        tensors: Tensors by name, each (P, ...).
        kept: (P,) bool, the rows to keep, or (n,) int64, their numbers.
        added: Rows to put after the kept ones, by the same names, each (m, ...); `tensor[:0]` where there are none.

    Returns:
        The new tensors by name, each (n + m, ...). They have no gradients.

    Raises:
        ValueError: The names differ, or a tensor requires a gradient and is in none of the optimiser's groups. Nothing
            has been changed then.
    """
    if tensors.keys() != added.keys():
        raise ValueError(f"added must have the names {', '.join(tensors)}, got {', '.join(added)}")
    positions = {name: parameter_index(optimizer, name, tensor) for name, tensor in tensors.items()}
    replaced = {name: torch.cat([old.detach()[kept], added[name].detach()]) for name, old in tensors.items()}
    for name, old in tensors.items():
        if positions[name] is None:
            continue
        group, index = positions[name]
        new = replaced[name].requires_grad_(old.requires_grad)
        if isinstance(old, torch.nn.Parameter):
            new = replaced[name] = torch.nn.Parameter(new, old.requires_grad)
        state = optimizer.state.pop(old, None)
        if state:
            zeros = torch.zeros_like(added[name])
            rows = {key: torch.cat([value[kept], zeros]) for key, value in _row_states(old, state)}
            optimizer.state[new] = state | rows
        group["params"][index] = new
    return replaced


@torch.no_grad()
def clear_moments(optimizer: torch.optim.Optimizer, parameter: Tensor, rows: Tensor | slice = slice(None)) -> None:
    """Sets what the optimiser remembers of the gradients of some rows of a parameter to zero.

    Args:
        optimizer: Any optimiser of torch.
        parameter: (P, ...). What the optimiser has no state for is left alone.
        rows: (P,) bool, (n,) int64, or a slice. By default all.
    """
    for _, value in _row_states(parameter, optimizer.state.get(parameter, {})):
        value[rows] = 0


def parameter_index(optimizer: torch.optim.Optimizer, name: str, tensor: Tensor) -> tuple[dict, int] | None:
    """The group of the optimiser that a tensor is in, and its index there; None: it is in none, and needs no gradient.

    Raises:
        ValueError: It is in none, but requires a gradient. The message calls it `name`.
    """
    for group in optimizer.param_groups:
        for index, parameter in enumerate(group["params"]):
            if parameter is tensor:
                return group, index
    if tensor.requires_grad:
        raise ValueError(f"{name} must be a parameter of the optimizer, or require no gradient: no group has it")
    return None


def _row_states(parameter: Tensor, state: dict[str, Any]) -> Iterator[tuple[str, Tensor]]:
    """What the state of a parameter has for each of its elements."""
    for key, value in state.items():
        if isinstance(value, Tensor) and value.shape == parameter.shape:
            yield key, value


def _common(optimizer: torch.optim.Optimizer, name: str) -> Any:
    """The option that all groups have.

    Raises:
        ValueError: They differ.
    """
    first, *others = (group[name] for group in optimizer.param_groups)
    for other in others:
        if other != first:
            raise ValueError(f"{name} must be the same in all groups, got {first} and {other}")
    return first


def _head_size(parameter: Tensor, head: int) -> int:
    """How many numbers of a row the first `head` entries along the second dimension are.

    Raises:
        ValueError: There are not so many.
    """
    if parameter.dim() < 2 or not 0 <= head <= parameter.shape[1]:
        raise ValueError(f"head is {head}, but a parameter has shape {tuple(parameter.shape)}")
    return head * math.prod(parameter.shape[2:])


def _update(
    optimizer: torch.optim.Optimizer, rows: Tensor | None, betas: tuple[float, float], bias_correction: bool = True
) -> None:
    """A step on all parameters that have a gradient."""
    eps = _common(optimizer, "eps")
    if rows is not None and not isinstance(rows, Tensor):
        raise TypeError(f"rows must be a tensor, got {type(rows).__name__}")
    # Made anew in every step, which takes a few microseconds: density control may replace parameters and state.
    parameters, gradients, means, squares, rates, steps, states = [], [], [], [], [], [], []
    heads, head_rates = [], []
    for group in optimizer.param_groups:
        rate, head = group["lr"], group.get("head", 0)
        if head and "head_lr" not in group:
            raise ValueError(f"a group with head needs head_lr, the learning rate of the head, got head {head} alone")
        head_rate = group.get("head_lr", 0.0)
        for parameter in group["params"]:
            gradient = parameter.grad
            if gradient is None:
                continue
            if gradient.layout is not torch.strided:
                raise ValueError(f"gradients must be dense, got layout {gradient.layout}")
            state = optimizer.state[parameter]
            if not state:
                state["step"] = 0
                state["exp_avg"] = torch.zeros_like(parameter)
                state["exp_avg_sq"] = torch.zeros_like(parameter)
            parameters.append(parameter)
            gradients.append(gradient)
            means.append(state["exp_avg"])
            squares.append(state["exp_avg_sq"])
            rates.append(rate)
            heads.append(_head_size(parameter, head) if head else 0)
            head_rates.append(head_rate)
            steps.append(int(state["step"]) + 1)  # a tensor in states of torch.optim.Adam
            states.append(state)
    if not parameters:
        return
    device = parameters[0].device
    check_device(device)
    if rows is not None and rows.device != device:  # the op would do nothing for rows on the meta device
        raise ValueError(f"rows must be on the device of the parameters, {device}, got {rows.device}")
    _adam(parameters, gradients, means, squares, rates, steps, *betas, eps, rows, bias_correction, heads, head_rates)
    for state, step in zip(states, steps):
        state["step"] = step
