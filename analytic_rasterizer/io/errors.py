"""What readers say of files that cannot be right, and of libraries that are missing.

A reader that cannot use a file raises SceneError, and one that has a doubt warns of it with SceneWarning. Either says
which file, what was expected, what was found, and as advice what to do. Advice may name an option of commands; a
command leaves out the advice that names an option which it does not have (`told`).
"""

from __future__ import annotations

import importlib
import re
import warnings
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

OPTION = re.compile(r"(?<![\w-])--[a-z][a-z0-9-]*")
POINTER = b"version https://git-lfs"  # how a pointer of Git LFS begins


class _Advised:
    """A message with advice.

    Args:
        message: Which file, what was expected, and what was found.
        *advice: What to do: "--missing skip leaves them out".
    """

    def __init__(self, message: str, *advice: str):
        super().__init__("; ".join((message, *advice)))
        self.message, self.advice = message, advice

    def told(self, options: Collection[str]) -> str:
        """The text for a command that has these options: without advice that names another one."""
        return "; ".join((self.message, *(text for text in self.advice if set(OPTION.findall(text)) <= set(options))))


class SceneError(_Advised, ValueError):
    """A file that cannot be used. The message names the file and what is wrong."""

    @classmethod
    def of(cls, where, expected: str, got, *advice: str) -> SceneError:
        """The error of a file or a part of it, `where`: what was `expected`, what it has `got`, and `advice`."""
        return cls(f"{where}: expected {expected}, got {got}", *advice)

    def within(self, where) -> SceneError:
        """The same, with `where` it was in front."""
        return SceneError(f"{where}: {self.message}", *self.advice)


class SceneWarning(_Advised, UserWarning):
    """Of a file that can be used, and may not be what was meant."""


def warn_of(where, text: str, *advice: str, stacklevel: int = 1) -> None:
    """Warns of a file or a part of it, `where`; `stacklevel` counts from the caller."""
    warnings.warn(SceneWarning(f"{where}: {text}", *advice), stacklevel=stacklevel + 1)


def counted_files(bad: Sequence[Path], count: int, what: str, problem: str) -> str:
    """That some of so many files have a problem: "2 of 9 pictures are missing, the first is images/a.png"."""
    return f"{len(bad)} of {count} {what} {problem}, the first is {bad[0]}"


def check_content(path) -> None:
    """Raises SceneError for a pointer of Git LFS that stands for a file. Whether there is a file is not looked at."""
    try:
        with Path(path).open("rb") as file:
            start = file.read(len(POINTER))
    except OSError:
        return  # which who reads the file says
    if start == POINTER:
        raise SceneError.of(path, "the content of the file", "a pointer of Git LFS", "`git lfs pull` fetches it")


@contextmanager
def naming(path) -> Iterator[None]:
    """Puts the file's name in front of the message of a SceneError."""
    try:
        yield
    except SceneError as error:
        raise error.within(path) from None


@contextmanager
def unreadable() -> Iterator[None]:
    """Turns whatever a reader raises for a broken file into a SceneError, and lets a missing library pass."""
    try:
        yield
    except (SceneError, ImportError):
        raise
    except Exception as error:  # libraries raise a different type for every way in which a file can be broken
        raise SceneError(why_unreadable(error)) from None


def why_unreadable(error: Exception) -> str:
    """What is wrong with a file, by the error of who read it: the reason of the system, or else that it is broken."""
    if isinstance(error, OSError) and error.strerror:  # libraries raise OSError without one for broken files
        return f"unreadable ({error.strerror})"
    return f"unreadable or cut short ({first_line(error) or type(error).__name__})"


def optional_import(name: str, extra: str = "cli"):
    """The module `name`.

    Raises:
        ImportError: It is missing; the message names the `extra` of this package that installs it.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        package = name.split(".")[0]
        raise ImportError(f'this needs {package}: pip install "analytic_rasterizer[{extra}]" ({error})') from None


def first_line(error: BaseException) -> str:
    """Of what an error says."""
    return str(error).partition("\n")[0]
