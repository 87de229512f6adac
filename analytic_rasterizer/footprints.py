"""The footprints: their names, options and defaults, and the weight of one splat in one pixel.

A footprint is the rule that turns a projected Gaussian into its weight in a pixel (docs/footprints.md).
"""

from __future__ import annotations

import difflib
import os
import re
from dataclasses import dataclass
from typing import Any

import torch

from . import _C  # loads the ops
from .checks import did_you_mean
from .render.autocast import widened

_VARIANTS: dict[str, list[dict[str, Any]]] = {}  # what the headers say, by public name, in the order of the registry
for _variant in _C.footprints():
    _VARIANTS.setdefault(_variant["name"], []).append(_variant)

FOOTPRINTS = tuple(_VARIANTS)
"""Public names of the footprints, in the order of the registry: those of csrc/core/footprint/registry.h."""

# The footprints that the library means where nobody names one. No other module names a footprint
# (tests/project/test_footprint_names.py); docs/footprints.md says why these are recommended.
PAPER = "analytic"  # the default, for parity with Analytic-Splatting
PAPER_GRADIENT = f"{PAPER}:frame_gradient=paper"
DILATED = "point"  # of 3DGS: what most repositories render with, and most files were trained with
UNFILTERED = f"{DILATED}:dilation=0"  # samples without a filter, also for Gaussians that hold the pixel already
COMPENSATED = "mip"  # of Mip-Splatting, and of the modes that others call antialiased
RECOMMENDED = "moment:samples=4"  # for training, and for scenes that were baked
FASTEST = "box:samples=1"  # that integrates over the pixel
INTEGRATING = (PAPER, "box", "moment")  # names of those for whose trainings FASTEST can begin
FOUR_SAMPLES = "box:samples=4"
SIXTEEN_SAMPLES = "box:samples=16"
EXACT = "exact"  # the weight without an error
NEAREST_TO_EXACT = "cumulant"  # of the footprints with one weight for a splat and a pixel
TURNED = "erf"  # the window of PAPER with the exact CDF

ADVICE = {
    "a new training": f"`{RECOMMENDED}`",
    "a scene that 3DGS trained": f"`bake` it, then `{RECOMMENDED}` (untouched: `{DILATED}`)",
    "speed": f"`{FASTEST}`",
    "parity with the paper": f"`{PAPER}`, the default",
}
"""Which footprint to take where. README.md, docs and messages have these words (tests/project/test_docs.py)."""
ADVICE_IN_WORDS = "; ".join(f"{where}: {which}" for where, which in ADVICE.items()).replace("`", "")

REFERENCE_FOOTPRINTS = tuple(name for name, variants in _VARIANTS.items() if variants[0]["reference"])
"""Footprints that are meant to compare others with, and are slow."""


def _value_of(text: str) -> int | str:
    return int(text) if text.isdigit() else text


def option_values(name: str) -> tuple:
    """The values that the option of a footprint may have; empty where it is a number, or where there is no option.

    Raises:
        KeyError: `name` is none of `FOOTPRINTS`.
    """
    return tuple(_value_of(v["value"]) for v in _VARIANTS[name] if v["value"] is not None)


def footprint_variants() -> tuple[str, ...]:
    """Every footprint, and one that takes samples with every number of them: "point", ..., "box:samples=16"."""
    return tuple(
        f"{name}:samples={variant['samples']}" if variant["option"] == "samples" else name
        for name, variants in _VARIANTS.items()
        for variant in (variants if variants[0]["option"] == "samples" else variants[:1])
    )


def sampled_footprints() -> tuple[str, ...]:
    """The footprints that take samples, with every number of them, the fewest first.

    With more samples each comes nearer to the integral over the pixel.
    """
    sampled = [name for name in footprint_variants() if ":" in name]
    return tuple(sorted(sampled, key=lambda name: resolve_footprint(name).samples))


def _default_options(name: str) -> dict[str, Any]:
    default = next(v for v in _VARIANTS[name] if v["is_default"])
    if default["option"] is None:
        return {}
    return {default["option"]: default["number"] if default["value"] is None else _value_of(default["value"])}


OPTIONS = {name: options for name in FOOTPRINTS if (options := _default_options(name))}
"""Options of the footprints that have any, and their defaults."""

ENVIRONMENT_VARIABLE = "ANALYTIC_RASTERIZER_FOOTPRINT"


@dataclass(frozen=True)
class Footprint:
    """A footprint with all its options filled in, as `resolve_footprint` returns it.

    Attributes:
        name: One of `FOOTPRINTS`.
        options: Every option of that footprint, as a tuple of (name, value) pairs.
        key: Name under which it is registered (csrc/core/footprint/registry.h): "box4".
        option: The number that it takes at run time: dilation or variance; 0 where there is none.
        samples: Samples of a pixel.
    """

    name: str
    options: tuple[tuple[str, Any], ...]
    key: str
    option: float
    samples: int

    def __str__(self) -> str:
        options = ",".join(f"{k}={v}" for k, v in self.options)
        return f"{self.name}:{options}" if options else self.name


def _number(name: str, value: Any) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError):
        raise ValueError(f"{name} must be a number, got {value!r}") from None
    if not 0.0 <= number <= torch.finfo(torch.float32).max:  # above it the kernels would have infinity
        raise ValueError(f"{name} must be finite in float32 and not negative, got {number}")
    return number


_GONE = {"adaptive": "take box with 16 samples or moment with 4"}  # footprints of earlier versions, and what to take


def _nearest(option: str, value: Any, values: tuple) -> str:
    """Of an option whose values are numbers: a hint at those next to a number that is none of them, else ""."""
    try:
        number = float(value)
        below, above = [v for v in values if v < number], [v for v in values if v > number]
    except (TypeError, ValueError):
        return ""
    nearest = [str(v) for v in (*sorted(below)[-1:], *sorted(above)[:1])]
    return f"; nearest: {option}={' or '.join(nearest)}" if nearest else ""


def _meant(name: str) -> str:
    """Of a name that no footprint has: a hint at what was meant, or ""."""
    if name in _GONE:
        return f"; {_GONE[name]}"
    first = re.match(r"\w*", name)[0]
    if first != name and first in FOOTPRINTS:
        return f"; options follow a colon, as in {RECOMMENDED}"
    return did_you_mean(difflib.get_close_matches(name.lower(), FOOTPRINTS, n=1))


def resolve_footprint(name: str | Footprint, **options: Any) -> Footprint:
    """Settles a footprint's options.

    Args:
        name: One of `FOOTPRINTS`, optionally followed by options: `"box:samples=16"`,
            `"point:dilation=0"`. Or a `Footprint`.
        **options: The same as keywords; they win over those in `name`.
            point: `dilation` (px^2 added to the covariance, default 0.3).
            mip: `variance` (px^2, default 0.1).
            analytic: `frame_gradient`, `"frozen"` (default) or `"paper"`.
            box, moment: `samples`, 1, 4 (default) or 16.

    Raises:
        ValueError: Unknown name, unknown option, or a value outside its domain.
    """
    if isinstance(name, Footprint):
        if not options:
            return name
        name = str(name)
    if not isinstance(name, str):
        raise ValueError(f"footprint must be one of {', '.join(FOOTPRINTS)}, got {name!r}")
    name, _, text = name.partition(":")
    if name not in FOOTPRINTS:
        raise ValueError(f"footprint must be one of {', '.join(FOOTPRINTS)}, got {name!r}{_meant(name)}")
    settled = dict(OPTIONS.get(name, {}))
    given = dict(item.partition("=")[::2] for item in text.split(",")) if text else {}
    given.update(options)
    for option, value in given.items():
        if option not in settled:
            known = ", ".join(settled) or "no options"
            raise ValueError(f"options of footprint {name} must be among: {known}; got {option!r}")
        settled[option] = value
    variant, number = _VARIANTS[name][0], 0.0
    for option, value in settled.items():  # there is one at most
        values = option_values(name)
        if not values:
            number = settled[option] = _number(option, value)
        elif str(value) in map(str, values):
            variant = _VARIANTS[name][[str(v) for v in values].index(str(value))]
            settled[option] = _value_of(variant["value"])
        else:
            known = ", ".join(map(str, values))
            raise ValueError(f"{option} must be one of {known}, got {value!r}{_nearest(option, value, values)}")
    return Footprint(name, tuple(settled.items()), variant["key"], number, variant["samples"])


_PAPER = resolve_footprint(PAPER)
_default: Footprint | None = None


def stated(footprint: Footprint) -> dict[str, Any]:
    """What the header of a footprint states: see describe() in csrc/torch/ops.cpp."""
    return next(v for v in _VARIANTS[footprint.name] if v["key"] == footprint.key)


def set_default_footprint(name: str | Footprint | None, **options: Any) -> None:
    """Chooses the footprint of settings that name none, for the whole process.

    `None` returns to the environment variable ANALYTIC_RASTERIZER_FOOTPRINT, or else to the filter of the dialect that
    the settings are of (docs/dialects.md), or else to `analytic`, for parity with the paper. `footprints.ADVICE` says
    which footprint to take.

    Raises:
        ValueError: As `resolve_footprint()`; or options of no footprint.
    """
    global _default
    if name is None and options:
        raise ValueError(f"name must be a footprint where options are given, got None with {', '.join(options)}")
    _default = None if name is None else resolve_footprint(name, **options)


def chosen_footprint() -> Footprint | None:
    """What the user chose for the process, by `set_default_footprint` or the environment variable; None: nothing.

    Raises:
        ValueError: The environment variable holds no footprint.
    """
    if _default is not None:
        return _default
    name = os.environ.get(ENVIRONMENT_VARIABLE)
    if not name:
        return None
    try:
        return resolve_footprint(name)
    except ValueError as error:
        raise ValueError(f"environment variable {ENVIRONMENT_VARIABLE}={name!r}: {error}") from None


def get_default_footprint() -> Footprint:
    """The footprint of settings that name none: the chosen one, or `analytic`. Settings of a dialect may differ.

    Raises:
        ValueError: The environment variable holds no footprint.
    """
    return chosen_footprint() or _PAPER


def check_device(device: torch.device) -> None:
    """Raises RuntimeError for CUDA tensors where the extension was built without CUDA."""
    if device.type == "cuda" and not _C.has_cuda:
        raise RuntimeError(
            f"tensors are on {device}, but analytic_rasterizer was built without CUDA: install it again where "
            "torch has CUDA and the CUDA toolkit is found (CUDA_HOME)"
        )


def footprint_weight(
    offset: torch.Tensor, cov2d: torch.Tensor, footprint: str | Footprint = PAPER, **options: Any
) -> torch.Tensor:
    """Weight I(d, Sigma) of a splat of peak 1 in one pixel. Differentiable.

    `exact` is the true integral over the pixel, of the Gaussian it is given, within 12 (3 + 0.74 s1/s2)
    roundings: 1.4e-14 in float64 and 7.5e-6 in float32 up to an anisotropy s1/s2 of 10. It costs 20 or
    72 exponentials, and for splats narrower than half a pixel up to 224 values of erfc. `erf` is the
    window of `analytic` with the exact CDF; its gradient holds the frame, as that of `analytic` does by
    default.

    For `box` and `moment` the weight is the mean over the samples; in an image each sample is composited
    on its own, which the mean of the weights does not show. Those of `moment` are at rest here: in an image
    nearer splats move them.

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

    Source: point, mip, cumulant, box, exact: docs/internals/numerics.md; analytic, erf: [AS, Eq. 2-9].
    """
    spec = resolve_footprint(footprint, **options)
    offset, cov2d = widened(offset), widened(cov2d)  # before they are expanded, which adds gradients up
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
