"""`FusedAdam` for trainings: its first step does not import torch's compiler, which would take seconds."""

from __future__ import annotations

from torch.optim import Optimizer

from ..optim import FusedAdam


def _unwrapped(method):
    return getattr(method, "__wrapped__", method)


class _Plain(Optimizer):
    """An optimizer whose methods the compiler would trace.

    torch hides them from its compiler, and the first call of one imports the compiler for it, which takes seconds.
    Nothing is compiled here.
    """

    add_param_group = _unwrapped(Optimizer.add_param_group)
    state_dict = _unwrapped(Optimizer.state_dict)
    load_state_dict = _unwrapped(Optimizer.load_state_dict)


class TrainingAdam(FusedAdam, _Plain):
    """`FusedAdam`, which does not import torch's compiler."""
