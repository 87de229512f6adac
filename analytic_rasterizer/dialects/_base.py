"""What all dialects share: settings that know how the rasterizer of their repository is called and what it returns."""

from __future__ import annotations

import inspect
from collections import namedtuple
from functools import lru_cache
from typing import Any

import torch

from .. import _C
from ..checks import check_tensors
from ..footprints import PAPER, Footprint, chosen_footprint, resolve_footprint
from ..render.effects import Effects, Outputs
from ..render.rasterizer import NOTHING, render
from ..render.rasterizer import GaussianRasterizer as LibraryRasterizer
from ..render.settings import GaussianRasterizationSettings as LibrarySettings
from ..render.stages import project
from ._refused import refusal, refuse

FIELDS = LibrarySettings._fields
"""The settings of 3DGS 2023, in its order."""
ARGUMENTS = (
    "means3D", "means2D", "opacities", "shs", "colors_precomp", "scales", "rotations", "cov3D_precomp",
)  # fmt: skip
"""The arguments of forward of 3DGS 2023, in its order."""

_resolved = lru_cache(maxsize=64)(resolve_footprint)
_inferred_from: dict[str, type] = {}  # keyword of settings: the settings that have it
_inferred_from_arguments: dict[str, type] = {}  # keyword of forward: the settings whose rasterizer has it
_inferred_without: dict[str, type] = {}  # keyword of settings: the settings that lack it
_known_fields = dict.fromkeys(FIELDS)  # of all dialects, in order
_chosen: type | None = None  # settings of the dialect that was chosen for the process
_companion_filter: str | None = None  # of a program that trains through another module of ours


def choose(settings_class: type | None) -> None:
    """Makes `GaussianRasterizationSettings` of 3DGS 2023, wherever it was imported, make those of another dialect."""
    global _chosen
    _chosen = settings_class


def use_filter_of_companion(name: str) -> None:
    """Makes settings of 3DGS 2023 render with this footprint where the user chose none.

    For a program that trains through a second module, with that module's filter, and evaluates through this one.
    """
    global _companion_filter
    _companion_filter = name


class GaussianRasterizationSettings(LibrarySettings):
    """How to render, as 3DGS 2023 has it; or, where the keywords are those of another dialect, as that one has it.

    The arguments are those of `analytic_rasterizer.GaussianRasterizationSettings`. Further ones that belong to one
    dialect alone, such as `antialiasing` or `kernel_size`, make settings of that dialect. Where a dialect was chosen
    for the process with `set_dialect` or ANALYTIC_RASTERIZER_DIALECT, settings of that one are made.

    A dialect is a subclass, in a file of its own, with some of these attributes:

    Attributes:
        dialect: Its name, that of the file.
        repositories: Names of repositories that speak it, by which it can be chosen, too.
        fields: Names of its settings, in the order of its repository.
        optional: Settings that may be left out, and what they are then.
        inferred_from: Keywords of settings that no other dialect has.
        inferred_from_arguments: Keywords of forward that no other dialect has, where the settings cannot tell.
        inferred_without: Settings of 3DGS 2023 that it lacks, where nothing else can tell.
        filter: The footprint that its repository renders with, for whoever chose none; None: the library's default,
            `analytic`.
        means2d_z: Third column of the gradient of means2D, "zero", "sum_abs" or "sum_norm".
        outputs: An `Effects` with the outputs that its rasterizer returns.

    Raises:
        TypeError: A field is missing or unknown, keywords are those of several dialects, or they belong to an algorithm
            that this package does not have.
        ValueError: As `analytic_rasterizer.GaussianRasterizationSettings`.
    """

    dialect = "gs2023"
    repositories: tuple[str, ...] = (
        "3DGS 2023",
        "SuGaR",
        "pixelSplat",
        "MVSplat",
        "DepthSplat",
        "InstantSplat",
        "GaussianAvatars",
        "Mini-Splatting",
        "gaussian-splatting-lightning",
    )
    optional: dict[str, Any] = {}  # noqa: RUF012
    filter: str | None = None
    outputs = NOTHING

    def __init_subclass__(cls, **kwargs: Any):
        super().__init_subclass__(**kwargs)
        stated = vars(cls)
        if "fields" in stated:
            made = namedtuple("GaussianRasterizationSettings", stated["fields"])  # checks the names
            for name in ("_fields", "_make", "__match_args__", *made._fields):
                setattr(cls, name, vars(made)[name])
            cls.__signature__ = inspect.signature(made)
            _known_fields.update(dict.fromkeys(made._fields))
        _inferred_from.update(dict.fromkeys(stated.get("inferred_from", ()), cls))
        _inferred_from_arguments.update(dict.fromkeys(stated.get("inferred_from_arguments", ()), cls))
        _inferred_without.update(dict.fromkeys(stated.get("inferred_without", ()), cls))

    def __new__(
        cls, *args: Any, footprint: str | Footprint | None = None, effects: Effects | str | None = None, **kwargs: Any
    ):
        refuse(kwargs)
        if cls is GaussianRasterizationSettings:
            cls = _class_of(len(args), kwargs)
        if len(args) > len(cls._fields):
            raise TypeError(
                f"settings of dialect {cls.dialect} have {len(cls._fields)} fields, got {len(args)} by position: name "
                "them, or choose the dialect (docs/dialects.md)"
            )
        values, missing = list(args), []
        for name in cls._fields[len(args) :]:
            if name in kwargs:
                values.append(kwargs.pop(name))
            elif name in cls.optional:
                values.append(cls.optional[name])
            else:
                missing.append(name)
        if missing:
            raise TypeError(f"settings of dialect {cls.dialect} must have {', '.join(missing)}, which are missing")
        self = tuple.__new__(cls, values)
        self._set_keywords(footprint, effects, kwargs)
        return self

    def own_footprint(self) -> Footprint:
        """The footprint to render with where the user chose none."""
        return _resolved(self._own_filter() or PAPER)

    def _own_filter(self) -> str | None:
        of_2023 = type(self) is GaussianRasterizationSettings
        return self.filter or (_companion_filter if of_2023 else None)

    def takes_default(self) -> bool:
        """Whether the footprint is the library's default: nobody chose one, and the dialect has no filter either."""
        return self._own_filter() is None and super().takes_default()

    def footprint_in_use(self) -> Footprint:
        """The footprint to render with: of the settings, or chosen for the process, or else the dialect's own.

        Raises:
            ValueError: The environment variable ANALYTIC_RASTERIZER_FOOTPRINT holds no footprint.
        """
        return self.footprint or chosen_footprint() or self.own_footprint()

    def render(
        self,
        means3D: torch.Tensor,
        means2D: torch.Tensor | None,
        opacities: torch.Tensor,
        shs: torch.Tensor | None = None,
        colors_precomp: torch.Tensor | None = None,
        scales: torch.Tensor | None = None,
        rotations: torch.Tensor | None = None,
        cov3D_precomp: torch.Tensor | None = None,
        **further: torch.Tensor,
    ) -> tuple:
        """Renders as the rasterizer of the dialect. A dialect whose forward has other arguments overrides it.

        Arguments, units and errors are those of `analytic_rasterizer.GaussianRasterizer.forward`. Where the effects of
        the settings ask for outputs, `Outputs` come after the dialect's own values.
        """
        arguments = means3D, means2D, opacities, shs, colors_precomp, scales, rotations, cov3D_precomp
        if further:
            return self._inferred(further).render(**dict(zip(ARGUMENTS, arguments)), **further)
        return self.values(*render(self, self.outputs, *arguments))

    def values(self, color: torch.Tensor, radii: torch.Tensor, outputs: Outputs | None = None) -> tuple:
        """What the rasterizer returns, made of what `render` made."""
        values = self.returned(color, radii, outputs)
        if isinstance(self.effects, Effects) and self.effects.has_outputs:
            values = *values, outputs
        return values

    def returned(self, color: torch.Tensor, radii: torch.Tensor, outputs: Outputs | None) -> tuple:
        """The tuple that the repository unpacks. A dialect overrides it."""
        return color, radii

    def _inferred(self, arguments: dict[str, Any]) -> GaussianRasterizationSettings:
        """The same settings in the dialect whose rasterizer has these further arguments.

        Raises:
            TypeError: There is none, or its settings have other fields than these.
        """
        refuse(arguments)
        names = ", ".join(arguments)
        found = {_inferred_from_arguments.get(name) for name in arguments}
        cls = found.pop() if len(found) == 1 else None
        if cls is None:
            raise TypeError(
                f"the rasterizer of dialect {self.dialect} does not take {names}: remove it, or choose the dialect of "
                "your repository (docs/dialects.md)"
            )
        if cls._fields != self._fields or self.dialect not in ("gs2023", "gs2024"):
            raise TypeError(
                f"{names} belongs to dialect {cls.dialect}, and the settings are those of {self.dialect}: choose the "
                "dialect with set_dialect or ANALYTIC_RASTERIZER_DIALECT (docs/dialects.md)"
            )
        made = tuple.__new__(cls, self)
        made._set_keywords(self.footprint, self.effects, {})
        return made


def _class_of(positional: int, keywords: dict[str, Any]) -> type:
    """The settings that are meant by so many positional fields and these keywords."""
    if _chosen is not None:
        return _chosen
    found = {_inferred_from[name] for name in keywords if name in _inferred_from}
    if len(found) > 1:
        names = sorted(f"{name} ({_inferred_from[name].dialect})" for name in keywords if name in _inferred_from)
        raise TypeError(f"settings must be of one dialect, got {', '.join(names)}")
    if found:
        return found.pop()
    for name, cls in _inferred_without.items():
        if name not in keywords and positional <= FIELDS.index(name):
            return cls
    return GaussianRasterizationSettings


def as_settings(settings: Any) -> LibrarySettings:
    """Settings themselves, or those that an object with attributes of their names stands for.

    The originals read attributes and nothing else, so that programs get by with a class of their own. `footprint` and
    `effects` are read too, if it has them.

    Raises:
        TypeError: A field is missing, see `GaussianRasterizationSettings`.
    """
    if isinstance(settings, LibrarySettings):
        return settings
    known = [*_known_fields, "footprint", "effects"]
    return GaussianRasterizationSettings(**{n: getattr(settings, n) for n in known if hasattr(settings, n)})


def forward_like(render_method):
    """`forward` of a rasterizer, with the signature of its settings' `render`; it follows the settings it is given."""

    def forward(self, *args, **kwargs):
        settings = as_settings(self.raster_settings)
        if isinstance(settings, GaussianRasterizationSettings):
            return settings.render(*args, **kwargs)
        return LibraryRasterizer.forward(self, *args, **kwargs)  # settings of the library itself

    signature = inspect.signature(render_method)
    named = [p for p in signature.parameters.values() if p.kind is not inspect.Parameter.VAR_KEYWORD]
    forward.__signature__ = signature.replace(parameters=named)  # code probes it to tell dialects apart
    forward.__doc__ = render_method.__doc__
    return forward


class GaussianRasterizer(LibraryRasterizer):
    """Renders 3D Gaussians as the dialect of the settings does that it holds."""

    forward = forward_like(GaussianRasterizationSettings.render)

    @torch.no_grad()
    def visible_filter(
        self,
        means3D: torch.Tensor,
        scales: torch.Tensor | None = None,
        rotations: torch.Tensor | None = None,
        cov3D_precomp: torch.Tensor | None = None,
    ) -> torch.Tensor:
        """Radii of Gaussians in the picture, without rendering; of Scaffold-GS, and the same in every dialect.

        Args:
            means3D, scales, rotations, cov3D_precomp: As in `forward`.

        Returns:
            (P,) int32, px; 0 for a Gaussian that is culled.

        Raises:
            TypeError, ValueError, RuntimeError: As `forward`.
        """
        check_tensors(None, means3D=means3D)
        if means3D.dim() != 2 or means3D.shape[1] != 3:
            raise ValueError(f"means3D must have shape (P, 3), got {tuple(means3D.shape)}")
        splats = project(
            as_settings(self.raster_settings),
            means3D,
            means3D.new_ones(len(means3D)),
            scales=scales,
            rotations=rotations,
            cov3D_precomp=cov3D_precomp,
        )
        radii = torch.zeros(len(means3D), dtype=torch.int32, device=means3D.device)
        radii[splats.gaussian_ids.long()] = splats.radii
        return radii

    def __getattr__(self, name: str):
        sentence = refusal(name)
        if sentence is not None:
            raise AttributeError(sentence)
        return super().__getattr__(name)


def rasterize_gaussians(
    means3D: torch.Tensor,
    means2D: torch.Tensor | None,
    sh: torch.Tensor | None,
    colors_precomp: torch.Tensor | None,
    opacities: torch.Tensor,
    scales: torch.Tensor | None,
    rotations: torch.Tensor | None,
    cov3Ds_precomp: torch.Tensor | None,
    raster_settings: LibrarySettings,
) -> tuple:
    """The functional form of `GaussianRasterizer.forward`; it returns what the dialect of the settings returns."""
    return render_by(
        raster_settings, means3D, means2D, opacities, sh, colors_precomp, scales, rotations, cov3Ds_precomp
    )


def render_by(raster_settings: Any, *arguments: torch.Tensor | None, **further: torch.Tensor | None) -> tuple:
    """Renders as settings of any kind say; what the functional forms of the dialects share.

    Args:
        raster_settings: Of a dialect, of the library, or what `as_settings` takes.
        *arguments: `ARGUMENTS`, in that order.
        **further: What a dialect takes besides, or None.

    Raises:
        TypeError: Something further for settings that do not take it.
    """
    settings = as_settings(raster_settings)
    further = {name: tensor for name, tensor in further.items() if tensor is not None}
    if isinstance(settings, GaussianRasterizationSettings):
        return settings.render(**dict(zip(ARGUMENTS, arguments)), **further)
    if further:
        raise TypeError(f"settings must be of a dialect that takes {', '.join(further)}, got those of the library")
    return render(settings, NOTHING, *arguments)


def feature_rows(name: str, features: torch.Tensor) -> torch.Tensor:
    """(P, K) of an argument (P, 1, K) or (P, K). Raises TypeError or ValueError, naming it, for anything else."""
    check_tensors(None, **{name: features})
    if features.dim() not in (2, 3):
        raise ValueError(f"{name} must have shape (P, 1, K) or (P, K), got {tuple(features.shape)}")
    return features.flatten(1)


def with_channels(
    settings: GaussianRasterizationSettings,
    features: torch.Tensor,
    means3D: torch.Tensor,
    means2D: torch.Tensor | None,
    opacities: torch.Tensor,
    shs: torch.Tensor | None,
    colors_precomp: torch.Tensor | None,
    scales: torch.Tensor | None,
    rotations: torch.Tensor | None,
    cov3D_precomp: torch.Tensor | None,
) -> tuple:
    """Renders colours and features; the features lie on zero, not on the background.

    One pass takes up to 509 channels beside the colours. More than that, such as the 512 of CLIP, take further passes.

    Args:
        settings: Whose outputs are made too.
        features: (P, K) of at least 1 channel.
        means3D to cov3D_precomp: As in `render`.

    Returns:
        Image of the features (K, H, W), and what the dialect returns besides: `values` of the settings.

    Raises:
        TypeError, ValueError: As `render`, or features have another shape.
    """
    gaussians = means3D, means2D, opacities
    shape = scales, rotations, cov3D_precomp
    most, further = _C.MAX_CHANNELS - 3, ()
    if isinstance(features, torch.Tensor) and features.dim() == 2 and features.shape[1] > most:
        features, *further = features.split(most, dim=1)
    image, radii, *outputs = render(settings, settings.outputs, *gaussians, shs, colors_precomp, *shape, features)
    color, *images = image.tensor_split((3,))
    for channels in further:
        on_zero = settings._replace(bg=color.new_zeros(channels.shape[1]))
        images.append(render(on_zero, NOTHING, *gaussians, None, channels, *shape)[0])
    of_features = torch.cat(images) if further else images[0]
    return of_features, settings.values(color, radii, *outputs)


def given(tensor: torch.Tensor | None) -> bool:
    """Whether an input is there: 3DGS passes those that are not as None or as an empty tensor."""
    missing = isinstance(tensor, torch.Tensor) and tensor.dim() == 1 and tensor.numel() == 0
    return tensor is not None and not missing
