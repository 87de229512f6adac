"""How to render: the settings of 3DGS 2023, with a footprint and effects."""

from __future__ import annotations

import inspect
from dataclasses import replace
from difflib import get_close_matches
from typing import Any, NamedTuple

import torch

from ..checks import did_you_mean
from ..footprints import Footprint, chosen_footprint, get_default_footprint, resolve_footprint
from .effects import AUTO, Effects


class _Fields(NamedTuple):
    image_height: int
    image_width: int
    tanfovx: float
    tanfovy: float
    bg: torch.Tensor
    scale_modifier: float
    viewmatrix: torch.Tensor
    projmatrix: torch.Tensor
    sh_degree: int
    campos: torch.Tensor
    prefiltered: bool
    debug: bool


class GaussianRasterizationSettings(_Fields):
    """How to render: a tuple of the 12 fields of 3DGS 2023 in its order. Footprint and effects are further attributes.

    Settings are equal where both their tuples and their attributes are. Tuples compare tensors of several numbers by
    identity, and raise a RuntimeError where two of them are not the same object.

    Args:
        image_height, image_width: Size of the image, px.
        tanfovx, tanfovy: Tangent of half the field of view.
        bg: Background: (3,) a colour, (C,) of C channels, or (C, H, W) an image. Differentiable.
        scale_modifier: Factor on all scales.
        viewmatrix: (4, 4) or (1, 4, 4) world to camera, transposed (for row vectors).
        projmatrix: (4, 4) or (1, 4, 4) world to clip space, transposed. The principal point is wherever
            it puts it.
        sh_degree: Degree of the spherical harmonics in use, 0 to 4.
        campos: (3,) camera centre, world units.
        prefiltered: Accepted for compatibility; culling does not depend on it.
        debug: Raise a ValueError, naming tensor, index and value, for a Gaussian that is not finite, has an opacity
            outside [0, 1] or a negative scale or variance; without `debug` such a Gaussian is culled or taken as it is.
            On failure write the arguments to snapshot_fw.dump or snapshot_bw.dump and re-raise. On CUDA wait for every
            stage, so that the stage that failed is the one that raises, and check that the camera is finite, which is
            not checked there otherwise.
        footprint: One of `FOOTPRINTS`, optionally with options (`"box:samples=16"`). None: the default at
            the time of rendering, see `set_default_footprint`, of which a program that trains nothing is warned once.
        effects: What the rendering has beyond three colours of a pinhole camera, see `Effects`; None: nothing. "auto":
            spherical harmonics only up to the degree above which they change no colour by more than 1/255. That degree
            is found once for every tensor of coefficients (`needed_sh_degree`); coefficients that require a gradient
            are used in full.
        **options: Options of the footprint, see `resolve_footprint`.

    Attributes:
        footprint: The `Footprint` with its options filled in, or None.
        effects: The `Effects`, "auto", or None.

    Raises:
        ValueError: Unknown footprint or option.
        TypeError: `effects` is none of these, or a keyword is unknown.
    """

    # Class attributes, because methods of tuple make instances without calling __new__.
    footprint: Footprint | None = None
    effects: Effects | str | None = None
    means2d_z = "zero"
    """What the third column of the gradient of means2D (P, 3) holds: "zero"; "sum_abs", the sum over pixels of
    |gx| + |gy|; or "sum_norm", that of the length of (gx, gy), where (gx, gy) is what a pixel adds to the first two
    columns. Some dialects have another value than "zero"."""

    def __new__(
        cls, *args: Any, footprint: str | Footprint | None = None, effects: Effects | str | None = None, **kwargs: Any
    ):
        fields = {k: kwargs.pop(k) for k in _Fields._fields[len(args) :] if k in kwargs}
        self = super().__new__(cls, *args, **fields)
        self._set_keywords(footprint, effects, kwargs)
        return self

    def _set_keywords(
        self, footprint: str | Footprint | None, effects: Effects | str | None, options: dict[str, Any]
    ) -> None:
        """Checks and keeps what is not in the tuple."""
        if footprint is not None:
            self.footprint = resolve_footprint(footprint, **options)
        elif options:
            known = (*self._fields, "footprint", "effects")
            names = (*self._names_of_fields(), *known)
            near = [name for given in options if given not in names for name in get_close_matches(given, names, 1)]
            said = f"settings must be among: {', '.join(known)}; got {', '.join(options)}"
            raise TypeError(said + did_you_mean(near, ", "))
        if effects is not None:
            if not isinstance(effects, Effects) and effects != AUTO:
                raise TypeError(f'effects must be an Effects or "auto", got {effects!r}')
            self.effects = effects

    def _names_of_fields(self) -> tuple[str, ...]:
        """Fields that may be meant by a misspelt keyword."""
        return self._fields

    def footprint_in_use(self) -> Footprint:
        """The footprint to render with: that of the settings, or else the default.

        Raises:
            ValueError: The environment variable ANALYTIC_RASTERIZER_FOOTPRINT holds no footprint.
        """
        return self.footprint or get_default_footprint()

    def takes_default(self) -> bool:
        """Whether nobody and nothing chose the footprint to render with, so that it is the library's default."""
        return self.footprint is None and chosen_footprint() is None

    def __eq__(self, other: object) -> bool:
        if isinstance(other, GaussianRasterizationSettings) and self._attributes() != other._attributes():
            return False
        return super().__eq__(other)

    def __ne__(self, other: object) -> bool:  # tuple has one of its own
        return not self == other

    __hash__ = _Fields.__hash__

    def _attributes(self) -> tuple:
        """What is not in the tuple."""
        return self.footprint, self.effects, self.means2d_z

    def _replace(self, **kwargs: Any) -> GaussianRasterizationSettings:
        fields = [kwargs.pop(name, value) for name, value in zip(self._fields, self)]
        made = tuple.__new__(type(self), fields)
        made._set_keywords(kwargs.pop("footprint", self.footprint), kwargs.pop("effects", self.effects), kwargs)
        return made

    __replace__ = _replace  # what copy.replace calls

    def __reduce__(self):
        footprint = None if self.footprint is None else str(self.footprint)
        return _unpickle_settings, (type(self), tuple(self), footprint, self.effects)

    def __repr__(self) -> str:
        fields = ", ".join(f"{k}={v!r}" for k, v in self._asdict().items())
        effects = "" if self.effects is None else f", effects={self.effects}"
        return f"{type(self).__name__}({fields}, footprint={str(self.footprint)!r}{effects})"


def in_order(settings: GaussianRasterizationSettings, order: str) -> GaussianRasterizationSettings:
    """The settings with one of `ORDERS` among their effects, and the other effects as they are.

    Raises:
        TypeError, ValueError: As `Effects` for its `order`.
    """
    effects = settings.effects if isinstance(settings.effects, Effects) else Effects()
    return settings if order == effects.order else settings._replace(effects=replace(effects, order=order))


def check_settings(settings: Any) -> None:
    """Raises TypeError unless it is a `GaussianRasterizationSettings`."""
    if not isinstance(settings, GaussianRasterizationSettings):
        raise TypeError(f"settings must be a GaussianRasterizationSettings, got {type(settings).__name__}")


# Downstream code probes the signature to tell dialects apart: it must be 3DGS 2023's.
GaussianRasterizationSettings.__signature__ = inspect.signature(_Fields)


def _unpickle_settings(
    cls: type, fields: tuple, footprint: str | None, effects: Effects | str | None
) -> GaussianRasterizationSettings:
    made = tuple.__new__(cls, fields)
    made._set_keywords(footprint, effects, {})
    return made
