"""What all dialects share: settings that know how the rasterizer of their repository is called and what it returns."""

from __future__ import annotations

import inspect
from collections import namedtuple
from functools import lru_cache
from typing import Any

import torch

from ..checks import check_tensors
from ..footprints import PAPER, Footprint, chosen_footprint, resolve_footprint
from ..render.effects import Effects, Outputs
from ..render.rasterizer import NOTHING, render
from ..render.rasterizer import GaussianRasterizer as LibraryRasterizer
from ..render.settings import GaussianRasterizationSettings as LibrarySettings
from ..render.stages import project
from ._refused import refusal, refuse
from ._registry import known_fields, meant_by_arguments, meant_by_settings, register

FIELDS = LibrarySettings._fields
"""The settings of 3DGS 2023, in its order."""
ARGUMENTS = (
    "means3D", "means2D", "opacities", "shs", "colors_precomp", "scales", "rotations", "cov3D_precomp",
)  # fmt: skip
"""The arguments of forward of 3DGS 2023, in its order."""

_resolved = lru_cache(maxsize=64)(resolve_footprint)
_companion_filter: str | None = None  # of a program that trains through another module of ours


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
        register(cls)

    def __new__(
        cls, *args: Any, footprint: str | Footprint | None = None, effects: Effects | str | None = None, **kwargs: Any
    ):
        refuse(kwargs)
        if cls is GaussianRasterizationSettings:
            cls = meant_by_settings(len(args), kwargs) or cls
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

    def _names_of_fields(self) -> tuple[str, ...]:
        # Those of 3DGS 2023 are what is meant by keywords of no dialect, so that one of any dialect may be misspelt.
        return known_fields() if type(self) is GaussianRasterizationSettings else self._fields

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
        names, cls = ", ".join(arguments), meant_by_arguments(arguments)
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


def as_settings(settings: Any) -> LibrarySettings:
    """Settings themselves, or those that an object with attributes of their names stands for.

    The originals read attributes and nothing else, so that programs get by with a class of their own. `footprint` and
    `effects` are read too, if it has them.

    Raises:
        TypeError: A field is missing, see `GaussianRasterizationSettings`.
    """
    if isinstance(settings, LibrarySettings):
        return settings
    known = [*known_fields(), "footprint", "effects"]
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
        means3D, means2D, sh, colors_precomp, opacities, scales, rotations, cov3Ds_precomp, raster_settings
    )


def render_by(
    means3D, means2D, sh, colors_precomp, opacities, scales, rotations, cov3Ds_precomp, raster_settings, **further
) -> tuple:
    """Renders as settings of any kind say; what the functional forms of the dialects share.

    Args:
        raster_settings: Of a dialect, of the library, or what `as_settings` takes.
        **further: What a dialect takes besides, or None.

    Raises:
        TypeError: Something further for settings that do not take it.
    """
    settings = as_settings(raster_settings)
    further = {name: tensor for name, tensor in further.items() if tensor is not None}
    arguments = means3D, means2D, opacities, sh, colors_precomp, scales, rotations, cov3Ds_precomp
    if isinstance(settings, GaussianRasterizationSettings):
        return settings.render(**dict(zip(ARGUMENTS, arguments)), **further)
    if further:
        raise TypeError(f"settings must be of a dialect that takes {', '.join(further)}, got those of the library")
    return render(settings, NOTHING, *arguments)
