"""The footprint models: their names, options and defaults, and the weight of one splat in one pixel."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any

import torch

from . import _C  # loads the ops

BOX_SAMPLES = (1, 2, 4, 8, 16)
FRAME_GRADIENTS = ("frozen", "paper")

# Options of the footprints that have any, and their defaults.
OPTIONS: dict[str, dict[str, Any]] = {
    "point": {"dilation": 0.3},
    "mip": {"variance": 0.1},
    "analytic": {"frame_gradient": "frozen"},
    "box": {"samples": 4},
    "adaptive": {"tolerance": 1 / 255},
}

# Kernels that an option chooses.
_CHOSEN = {"analytic_paper": "analytic", **{f"box{samples}": "box" for samples in BOX_SAMPLES}}

FOOTPRINTS = tuple(dict.fromkeys(_CHOSEN.get(key, key) for key in _C.footprints()))
"""Public names of the footprints, in the order of the registry: those of csrc/core/footprint/registry.h."""

ENVIRONMENT_VARIABLE = "ANALYTIC_RASTERIZER_FOOTPRINT"


@dataclass(frozen=True)
class Footprint:
    """A footprint with all its options settled.

    Attributes:
        name: One of `FOOTPRINTS`.
        options: Every option of that footprint, as a tuple of (name, value) pairs.
        key: Name of the kernel that computes it.
        option: The number that the kernel takes: dilation, variance or tolerance; 0 where there is none.
    """

    name: str
    options: tuple[tuple[str, Any], ...]
    key: str
    option: float

    def __str__(self) -> str:
        options = ",".join(f"{k}={v}" for k, v in self.options)
        return f"{self.name}:{options}" if options else self.name


def _number(name: str, value: Any) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError):
        raise ValueError(f"{name} must be a number, got {value!r}") from None
    if not 0.0 <= number < float("inf"):
        raise ValueError(f"{name} must be finite and not negative, got {number}")
    return number


def resolve_footprint(name: str, **options: Any) -> Footprint:
    """Settles a footprint's options.

    Args:
        name: One of `FOOTPRINTS`, optionally followed by options: `"box:samples=8"`,
            `"point:dilation=0"`.
        **options: The same as keywords; they win over those in `name`.
            point: `dilation` (px^2 added to the covariance, default 0.3).
            mip: `variance` (px^2, default 0.1).
            analytic: `frame_gradient`, `"frozen"` (default) or `"paper"`.
            box: `samples`, 1, 2, 4 (default), 8 or 16.
            adaptive: `tolerance`, of the image, in units of colour (default 1/255): `box` with 1, 4, 8 or 16
                samples, chosen for every tile of 16x16 pixels.

    Raises:
        ValueError: Unknown name, unknown option, or a value outside its domain.
    """
    if not isinstance(name, str):
        raise ValueError(f"footprint must be one of {', '.join(FOOTPRINTS)}, got {name!r}")
    name, _, text = name.partition(":")
    if name not in FOOTPRINTS:
        raise ValueError(f"footprint must be one of {', '.join(FOOTPRINTS)}, got {name!r}")
    settled = dict(OPTIONS.get(name, {}))
    given = dict(item.partition("=")[::2] for item in text.split(",")) if text else {}
    given.update(options)
    for option, value in given.items():
        if option not in settled:
            known = ", ".join(settled) or "no options"
            raise ValueError(f"options of footprint {name} must be among: {known}; got {option!r}")
        settled[option] = value
    key, number = name, 0.0
    if name == "point":
        number = settled["dilation"] = _number("dilation", settled["dilation"])
    elif name == "mip":
        number = settled["variance"] = _number("variance", settled["variance"])
    elif name == "analytic":
        if settled["frame_gradient"] not in FRAME_GRADIENTS:
            raise ValueError(
                f"frame_gradient must be one of {', '.join(FRAME_GRADIENTS)}, got {settled['frame_gradient']!r}"
            )
        key = "analytic" if settled["frame_gradient"] == "frozen" else "analytic_paper"
    elif name == "box":
        if str(settled["samples"]) not in map(str, BOX_SAMPLES):
            raise ValueError(f"samples must be one of {', '.join(map(str, BOX_SAMPLES))}, got {settled['samples']!r}")
        settled["samples"] = int(settled["samples"])
        key = f"box{settled['samples']}"
    elif name == "adaptive":
        number = settled["tolerance"] = _number("tolerance", settled["tolerance"])
    return Footprint(name, tuple(settled.items()), key, number)


_default: Footprint | None = None


def set_default_footprint(name: str | None, **options: Any) -> None:
    """Chooses the footprint of settings that name none, for the whole process.

    `None` returns to the environment variable ANALYTIC_RASTERIZER_FOOTPRINT, or else `analytic`.

    Raises:
        ValueError: As `resolve_footprint()`.
    """
    global _default
    _default = None if name is None else resolve_footprint(name, **options)


def get_default_footprint() -> Footprint:
    """The footprint of settings that name none.

    Raises:
        ValueError: The environment variable holds no footprint.
    """
    if _default is not None:
        return _default
    name = os.environ.get(ENVIRONMENT_VARIABLE) or "analytic"
    try:
        return resolve_footprint(name)
    except ValueError as error:
        raise ValueError(f"environment variable {ENVIRONMENT_VARIABLE}={name!r}: {error}") from None


def check_device(device: torch.device) -> None:
    """Raises RuntimeError for CUDA tensors where the extension was built without CUDA."""
    if device.type == "cuda" and not _C.has_cuda:
        raise RuntimeError(
            f"tensors are on {device}, but analytic_rasterizer was built without CUDA: install it again where "
            "torch has CUDA and the CUDA toolkit is found (CUDA_HOME)"
        )


def footprint_weight(
    offset: torch.Tensor, cov2d: torch.Tensor, footprint: str = "analytic", **options: Any
) -> torch.Tensor:
    """Weight I(d, Sigma) of a splat of peak 1 in one pixel. Differentiable.

    `exact` is the true integral over the pixel, of the Gaussian it is given, within 12 (3 + 0.74 s1/s2)
    roundings: 1.4e-14 in float64 and 7.5e-6 in float32 up to an anisotropy s1/s2 of 10. It costs 20 or
    72 exponentials, and for splats narrower than half a pixel up to 224 values of erfc. `erf` is the
    window of `analytic` with the exact CDF; its gradient holds the frame, as that of `analytic` does by
    default.

    For `box` the weight is the mean over its samples; in an image each sample is composited on its
    own, which the mean of the weights does not show.

    Args:
        offset: (..., 2) pixel centre minus projected mean, px; float32 or float64.
        cov2d: (..., 3) projected covariance (xx, xy, yy), px^2; broadcasts against `offset`.
            A covariance that is not positive definite gives an undefined weight.
        footprint: One of `FOOTPRINTS`, see `resolve_footprint()`.
        **options: Options of the footprint.

    Returns:
        (...) weights, of the dtype of `offset`.

    Raises:
        TypeError: Wrong or unequal dtypes.
        ValueError: Wrong shape, device, footprint or option.

    Source: point, mip, cumulant, box, exact: docs/numerics.md; analytic, erf: [AS, Eq. 2-9].
    """
    spec = resolve_footprint(footprint, **options)
    for name, tensor, last in (("offset", offset, 2), ("cov2d", cov2d, 3)):
        if not isinstance(tensor, torch.Tensor):
            raise TypeError(f"{name} must be a tensor, got {type(tensor).__name__}")
        if tensor.device != offset.device:
            raise ValueError(f"{name} must be on the device of offset, {offset.device}, got {tensor.device}")
        if tensor.dim() < 1 or tensor.shape[-1] != last:
            raise ValueError(f"{name} must have shape (..., {last}), got {tuple(tensor.shape)}")
    try:
        shape = torch.broadcast_shapes(offset.shape[:-1], cov2d.shape[:-1])
    except RuntimeError:
        raise ValueError(
            "offset and cov2d must have leading sizes that broadcast, got "
            f"{tuple(offset.shape)} and {tuple(cov2d.shape)}"
        ) from None
    check_device(offset.device)
    return torch.ops.analytic_rasterizer.footprint_weight(
        offset.expand(*shape, 2), cov2d.expand(*shape, 3), spec.key, spec.option
    )
