"""The name under which existing 3DGS repositories import their rasterizer.

Its names are those of a dialect (docs/dialects.md): of 3DGS 2023, or of the one chosen with `set_dialect` or the
environment variable ANALYTIC_RASTERIZER_DIALECT.
"""

import sys as _sys

from analytic_rasterizer.dialects import _native as _C  # noqa: N812  (its name in the original)
from analytic_rasterizer.dialects import dialect_module as _dialect_module
from analytic_rasterizer.dialects import exporters as _exporters
from analytic_rasterizer.dialects import get_dialect as get_dialect
from analytic_rasterizer.dialects import set_dialect as set_dialect
from analytic_rasterizer.dialects._refused import refusal as _refusal

# Another rasterizer that was installed before may have left its compiled _C in this folder, which would come first.
_sys.modules[__name__ + "._C"] = _C

_PROBED = ("SparseGaussianAdam",)  # code asks whether it is there; that it is not must look as in the original


def __getattr__(name: str):
    """What the dialect exports, looked up when it is asked for, for set_dialect changes it."""
    module = _dialect_module()
    if name == "__all__":
        return [*module.__all__, "get_dialect", "set_dialect"]
    if name in module.__all__:
        return getattr(module, name)
    sentence = _refusal(name)
    elsewhere = _exporters(name)
    if sentence is None and elsewhere and name not in _PROBED:
        sentence = f"{name} is exported under dialect {elsewhere[0]}: set ANALYTIC_RASTERIZER_DIALECT={elsewhere[0]}"
    if sentence is not None:
        raise ImportError(sentence)  # `from ... import` would swallow the sentence of an AttributeError
    raise AttributeError(f"module {__name__!r}, which speaks dialect {get_dialect()}, has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *_dialect_module().__all__})
