"""The dialects of diff_gaussian_rasterization: how each repository calls its rasterizer, and what it unpacks.

A dialect is a file of this package, and its name is the file's. `set_dialect` or the environment variable
ANALYTIC_RASTERIZER_DIALECT chooses one for the process. Adding one: docs/internals/adding-a-dialect.md.
`gsplat` is no dialect but another interface, which takes cameras in batches.
"""

from __future__ import annotations

import importlib
import os
import pkgutil
from types import ModuleType

from . import _registry

ENVIRONMENT_VARIABLE = "ANALYTIC_RASTERIZER_DIALECT"
DEFAULT = "gs2023"

_MODULES = {
    name: importlib.import_module(f"{__name__}.{name}")
    for _, name, _ in pkgutil.iter_modules(__path__)
    if not name.startswith("_") and name != "gsplat"
}

DIALECTS = tuple(_MODULES)
"""Names of the dialects: those of the files."""

_chosen: str | None = None


def _plain(name: str) -> str:
    """A name without case and punctuation, which people write differently."""
    return "".join(letter for letter in name.lower() if letter.isalnum())


_NAMES = {}  # dialect by plain name of dialect or repository
for _name, _module in _MODULES.items():
    _NAMES[_plain(_name)] = _name
    _NAMES.update(dict.fromkeys(map(_plain, _module.GaussianRasterizationSettings.repositories), _name))


def _dialect_named(name: str, source: str) -> str:
    found = _NAMES.get(_plain(name)) if isinstance(name, str) else None
    if found is None:
        raise ValueError(f"{source} must be one of {', '.join(DIALECTS)}, or a repository of theirs, got {name!r}")
    return found


def set_dialect(name: str | None) -> None:
    """Chooses the dialect of the module diff_gaussian_rasterization, for the whole process.

    From then on the names of the module are those of the dialect: what it exports, `_fields` and signatures answer as
    those of the repository. Classes that were imported before follow where they can: the settings of 3DGS 2023 make
    settings of the chosen dialect, and a rasterizer does what its settings say. Settings that were made before stay
    what they are, and so do classes that were imported from another dialect than 3DGS 2023.

    Args:
        name: One of `DIALECTS`, or the name of a repository that a dialect lists, in any spelling. None: that of the
            environment variable ANALYTIC_RASTERIZER_DIALECT as it was when this package was imported, or else 3DGS
            2023. Under 3DGS 2023 other dialects are inferred from settings and arguments where that is possible.

    Raises:
        ValueError: No such dialect.
    """
    global _chosen
    _chosen = _FROM_ENVIRONMENT if name is None else _dialect_named(name, "dialect")
    # Under 3DGS 2023 other dialects are inferred all the same.
    _registry.choose(None if get_dialect() == DEFAULT else _MODULES[_chosen].GaussianRasterizationSettings)


def get_dialect() -> str:
    """Name of the dialect that the module diff_gaussian_rasterization speaks."""
    return _chosen or DEFAULT


def dialect_module(name: str | None = None) -> ModuleType:
    """The module with the names that a dialect exports, in `__all__`; None: of the dialect that is spoken.

    Raises:
        ValueError: No such dialect.
    """
    return _MODULES[get_dialect() if name is None else _dialect_named(name, "dialect")]


def exporters(name: str) -> list[str]:
    """The dialects that export a name."""
    return [dialect for dialect, module in _MODULES.items() if name in module.__all__]


_FROM_ENVIRONMENT = os.environ.get(ENVIRONMENT_VARIABLE) or None
if _FROM_ENVIRONMENT is not None:
    _FROM_ENVIRONMENT = _dialect_named(_FROM_ENVIRONMENT, f"environment variable {ENVIRONMENT_VARIABLE}")
set_dialect(None)
