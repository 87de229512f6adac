"""For dialects whose `forward` has more arguments than in 3DGS 2023: its signature, and features that are blended."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from typing import Any

import torch

from .. import _C
from ..checks import check_tensors
from ..render.rasterizer import NOTHING, render
from ._base import GaussianRasterizationSettings, rasterize_gaussians, render_by


def adds(**after: str) -> Callable:
    """Declares arguments that `forward` of a dialect has besides, each with the argument that it follows.

    Decorates `render` of the dialect's settings, which is written as `render(self, name=None, ..., **gaussians)` with
    these arguments, and passes the others on. What callers see, and may give by position, is the signature of the
    repository.
    """

    def decorate(method: Callable) -> Callable:
        signature = _with(after, inspect.signature(GaussianRasterizationSettings.render), default=None)
        order = [name for name, p in signature.parameters.items() if p.kind is p.POSITIONAL_OR_KEYWORD][1:]

        @functools.wraps(method)
        def render(self, *positional: Any, **named: Any) -> tuple:
            if not positional:
                return method(self, **named)
            if len(positional) > len(order):
                raise TypeError(f"forward takes {len(order)} arguments, got {len(positional)}: {', '.join(order)}")
            return method(self, **dict(zip(order, positional)), **named)

        render.__signature__ = signature
        return render

    return decorate


def function_that_adds(module: str, **after: str) -> Callable:
    """The function `rasterize_gaussians` of a module, with further arguments, each after the argument that it names."""
    signature = _with(after, inspect.signature(rasterize_gaussians), default=inspect.Parameter.empty)
    expected = signature.parameters.keys()

    def function(*positional: Any, **named: Any) -> tuple:
        given = dict(zip(expected, positional)) | named
        if len(positional) + len(named) != len(expected) or given.keys() != expected:
            signature.bind(*positional, **named)  # raises what Python raises for such a call
        return render_by(**given)

    function.__name__ = function.__qualname__ = rasterize_gaussians.__name__
    function.__module__, function.__signature__ = module, signature
    function.__doc__ = "The functional form of `GaussianRasterizer.forward`."
    return function


def _with(after: dict[str, str], signature: inspect.Signature, default: Any) -> inspect.Signature:
    """The signature with further parameters, each after the one that it names."""
    parameters = list(signature.parameters.values())
    for name, before in after.items():
        place = [p.name for p in parameters].index(before) + 1
        parameters.insert(place, inspect.Parameter(name, inspect.Parameter.POSITIONAL_OR_KEYWORD, default=default))
    return signature.replace(parameters=parameters)


def feature_rows(name: str, features: torch.Tensor) -> torch.Tensor:
    """(P, K) of an argument (P, 1, K) or (P, K). Raises TypeError or ValueError, naming it, for anything else."""
    check_tensors(None, **{name: features})
    if features.dim() not in (2, 3):
        raise ValueError(f"{name} must have shape (P, 1, K) or (P, K), got {tuple(features.shape)}")
    return features.flatten(1)


def with_channels(
    settings: GaussianRasterizationSettings, features: torch.Tensor, **gaussians: torch.Tensor | None
) -> tuple:
    """Renders colours and features; the features lie on zero, not on the background.

    One pass takes up to 509 channels beside the colours. More than that, such as the 512 of CLIP, take further passes.

    Args:
        settings: Whose outputs are made too.
        features: (P, K) of at least 1 channel.
        gaussians: `ARGUMENTS`, by name.

    Returns:
        Image of the features (K, H, W), and what the dialect returns besides: `values` of the settings.

    Raises:
        TypeError, ValueError: As `render`, or features have another shape.
    """
    most, further = _C.MAX_CHANNELS - 3, ()
    if isinstance(features, torch.Tensor) and features.dim() == 2 and features.shape[1] > most:
        features, *further = features.split(most, dim=1)
    image, radii, *outputs = render(settings, settings.outputs, **gaussians, features=features)
    color, *images = image.tensor_split((3,))
    for channels in further:
        on_zero = settings._replace(bg=color.new_zeros(channels.shape[1]))
        images.append(render(on_zero, NOTHING, **gaussians | {"shs": None, "colors_precomp": channels})[0])
    of_features = torch.cat(images) if further else images[0]
    return of_features, settings.values(color, radii, *outputs)


def given(tensor: torch.Tensor | None) -> bool:
    """Whether an input is there: 3DGS passes those that are not as None or as an empty tensor."""
    missing = isinstance(tensor, torch.Tensor) and tensor.dim() == 1 and tensor.numel() == 0
    return tensor is not None and not missing
