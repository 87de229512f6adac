"""nerfstudio's splatfacto with this package's rasterizer: the method `splatfacto-analytic` of `ns-train`.

nerfstudio finds it by the entry point in pyproject.toml. Nothing else imports this module, which needs nerfstudio. The
model is nerfstudio's own, and so are its options, its density control and its optimisers; only its calls of gsplat's
`rasterization` go to this package. Use: docs/nerfstudio.md.
"""

from __future__ import annotations

import copy
import dataclasses
import functools
from collections.abc import Callable
from contextvars import ContextVar
from typing import Any

from nerfstudio.models import splatfacto

from ...footprints import RECOMMENDED, resolve_footprint
from .patching import rasterization_of_installed

NAME = "splatfacto-analytic"

_FOOTPRINT: ContextVar[str | None] = ContextVar("_FOOTPRINT", default=None)
"""Of the model that is rendering, which the viewer does in a thread of its own. None: a model of another class."""


@dataclasses.dataclass
class SplatfactoAnalyticModelConfig(splatfacto.SplatfactoModelConfig):
    """Options of splatfacto, and the footprint.

    Attributes:
        footprint: Weight of a Gaussian in a pixel: a footprint of analytic_rasterizer, with its options. It replaces
            rasterize_mode, which must be left as it is.
        first_footprint: Cheaper one for the steps before, such as "box:samples=1"; None: `footprint` from the start.
        footprint_from: Share of the training from which on `footprint` is used, 0 to 1.

    Raises:
        ValueError: No such footprint, a share outside its range, or a `rasterize_mode` that would not be read.
    """

    _target: type = dataclasses.field(default_factory=lambda: SplatfactoAnalyticModel)
    footprint: str = RECOMMENDED
    first_footprint: str | None = None
    footprint_from: float = 0.9

    def __post_init__(self) -> None:
        for footprint in filter(None, (self.footprint, self.first_footprint)):
            resolve_footprint(footprint)
        if not 0 <= self.footprint_from <= 1:
            raise ValueError(f"footprint_from must be 0 to 1, got {self.footprint_from}")
        default = splatfacto.SplatfactoModelConfig.rasterize_mode
        if self.rasterize_mode != default:
            raise ValueError(
                f"rasterize_mode must be {default!r} with {NAME}, whose option is footprint, "
                f"got {self.rasterize_mode!r}"
            )


class SplatfactoAnalyticModel(splatfacto.SplatfactoModel):
    """Splatfacto whose images this package renders.

    Raises:
        ImportError: A nerfstudio whose splatfacto does not call gsplat's `rasterization`.
    """

    config: SplatfactoAnalyticModelConfig
    _dear_from: float = 0.0  # step from which on pictures of a training have the footprint of the end

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        _redirect()
        super().__init__(*args, **kwargs)

    def get_training_callbacks(self, training_callback_attributes: Any) -> Any:
        """As splatfacto's. Learns how long the training is."""
        trainer = training_callback_attributes.trainer
        self._dear_from = self.config.footprint_from * (0 if trainer is None else trainer.config.max_num_iterations)
        return super().get_training_callbacks(training_callback_attributes)

    def get_outputs(self, camera: Any) -> Any:
        """As splatfacto's. `camera` is one of nerfstudio's."""
        first = self.config.first_footprint
        cheap = first is not None and self.training and self.step < self._dear_from
        token = _FOOTPRINT.set(first if cheap else self.config.footprint)
        try:
            return super().get_outputs(camera)
        finally:
            _FOOTPRINT.reset(token)


def _redirect() -> None:
    """Puts a function in the place of the `rasterization` that splatfacto calls: ours within a model of ours."""
    theirs: Callable | None = getattr(splatfacto, "rasterization", None)
    if theirs is None:
        raise ImportError(
            f"{NAME} needs a nerfstudio whose splatfacto calls gsplat's rasterization, such as 1.1.5; yours does not"
        )
    if hasattr(theirs, "_redirected"):
        return
    ours = rasterization_of_installed()

    @functools.wraps(theirs)
    def either(*args: Any, **kwargs: Any) -> Any:
        footprint = _FOOTPRINT.get()
        return theirs(*args, **kwargs) if footprint is None else ours(*args, footprint=footprint, **kwargs)

    either._redirected = True  # type: ignore[attr-defined]
    splatfacto.rasterization = either


def _method() -> Any:
    """The method splatfacto as nerfstudio defines it, with the model above."""
    from nerfstudio.configs.method_configs import method_configs
    from nerfstudio.plugins.types import MethodSpecification

    config = copy.deepcopy(method_configs["splatfacto"])
    config.method_name = NAME
    theirs = config.pipeline.model
    options = {field.name: getattr(theirs, field.name) for field in dataclasses.fields(theirs)}
    config.pipeline.model = SplatfactoAnalyticModelConfig(**options | {"_target": SplatfactoAnalyticModel})
    return MethodSpecification(config, "Splatfacto, rendered by analytic_rasterizer")


def __getattr__(name: str) -> Any:
    # Not made at import: nerfstudio asks for it while its methods are being defined, and defining them asks for it.
    if name == "method":
        return _method()
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
