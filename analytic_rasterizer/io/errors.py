"""What readers raise: of broken files, and of libraries that are missing."""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from contextlib import contextmanager


class SceneError(ValueError):
    """A scene or views file that cannot be used; the message names the file and what is wrong."""


@contextmanager
def naming(path) -> Iterator[None]:
    """Puts the file's name in front of the message of a SceneError."""
    try:
        yield
    except SceneError as error:
        raise SceneError(f"{path}: {error}") from None


@contextmanager
def unreadable() -> Iterator[None]:
    """Turns whatever a reader raises for a broken file into a SceneError, and lets a missing library pass."""
    try:
        yield
    except (SceneError, ImportError):
        raise
    except Exception as error:  # libraries raise a different type for every way in which a file can be broken
        reason = first_line(error) or type(error).__name__
        raise SceneError(f"unreadable or cut short ({reason})") from None


def optional_import(name: str, extra: str = "cli"):
    """The module `name`.

    Raises:
        ImportError: It is missing; the message names the `extra` of this package that installs it.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        package = name.split(".")[0]
        raise ImportError(f"this needs {package}: pip install analytic_rasterizer[{extra}] ({error})") from None


def first_line(error: BaseException) -> str:
    """Of what an error says."""
    return str(error).partition("\n")[0]
