"""Which dialect is meant: by whom it was chosen, or by the keywords of settings and of forward."""

from __future__ import annotations

from typing import Any

from ..render.settings import GaussianRasterizationSettings as LibrarySettings

_from_settings: dict[str, type] = {}  # keyword of settings: the settings that have it
_from_arguments: dict[str, type] = {}  # keyword of forward: the settings whose rasterizer has it
_without: dict[str, type] = {}  # keyword of settings: the settings that lack it
_known_fields = dict.fromkeys(LibrarySettings._fields)  # of all dialects, in order
_chosen: type | None = None  # settings of the dialect that was chosen for the process


def register(settings: type) -> None:
    """Enters what a class of settings states of itself: its fields, and what it is inferred from."""
    stated = vars(settings)
    _known_fields.update(dict.fromkeys(stated.get("fields", ())))
    _from_settings.update(dict.fromkeys(stated.get("inferred_from", ()), settings))
    _from_arguments.update(dict.fromkeys(stated.get("inferred_from_arguments", ()), settings))
    _without.update(dict.fromkeys(stated.get("inferred_without", ()), settings))


def choose(settings: type | None) -> None:
    """Makes `GaussianRasterizationSettings` of 3DGS 2023, wherever it was imported, make those of another dialect."""
    global _chosen
    _chosen = settings


def meant_by_settings(positional: int, keywords: dict[str, Any]) -> type | None:
    """The settings that are meant by so many positional fields and these keywords; None: those of 3DGS 2023.

    Raises:
        TypeError: The keywords are those of several dialects.
    """
    if _chosen is not None:
        return _chosen
    found = {_from_settings[name] for name in keywords if name in _from_settings}
    if len(found) > 1:
        names = sorted(f"{name} ({_from_settings[name].dialect})" for name in keywords if name in _from_settings)
        raise TypeError(f"settings must be of one dialect, got {', '.join(names)}")
    if found:
        return found.pop()
    for name, settings in _without.items():
        if name not in keywords and positional <= LibrarySettings._fields.index(name):
            return settings
    return None


def meant_by_arguments(names: dict[str, Any]) -> type | None:
    """The settings whose rasterizer has these arguments beside those of 3DGS 2023; None where no dialect has all."""
    found = {_from_arguments.get(name) for name in names}
    return found.pop() if len(found) == 1 else None


def known_fields() -> tuple[str, ...]:
    """The settings of all dialects."""
    return tuple(_known_fields)
