"""Options that say everything in one place: their default, what values they take, and the text that explains them.

    @described
    @dataclass(frozen=True)
    class LossOptions(Options):
        \"""What the loss is made of.\"""

        ssim_weight: float = option(0.2, "Share of 1 - SSIM in the loss.", SHARE, metavar="SHARE")

A value of another type or outside its range is an error that names the option. `described` lists the options in the
docstring, and the command line makes its help from them.
"""

from __future__ import annotations

import inspect
import math
import textwrap
from collections.abc import Callable, Iterable, Mapping
from dataclasses import Field, dataclass, field, fields
from typing import Any, NamedTuple

from .checks import check_value, plain_value


class Range(NamedTuple):
    """What values an option takes."""

    fits: Callable[[Any], bool]
    expected: str  # in words: "must be .."
    hint: str = ""  # what the error says of a value that does not fit


class Declared(NamedTuple):
    """What is said of an option beside its default."""

    text: str  # one sentence or more
    range: Range
    metavar: str  # what a help shows for a value; "": by its type
    main: bool  # of those that a help shows first


ANY = Range(lambda value: True, "")
POSITIVE = Range(lambda value: 0 < value < math.inf, "positive and finite")
NOT_NEGATIVE = Range(lambda value: 0 <= value < math.inf, "finite and not negative")
SHARE = Range(lambda value: 0 <= value <= 1, "0 to 1")


def at_least(least: int) -> Range:
    """Numbers from `least` on."""
    return Range(lambda value: value >= least, f"at least {least}")


def one_of(names: Iterable[str]) -> Range:
    """These names."""
    known = tuple(names)
    return Range(lambda value: value in known, f"one of {', '.join(known)}")


def option(default: Any, text: str, range: Range = ANY, *, metavar: str = "", main: bool = False) -> Any:
    """A field of a dataclass that derives from `Options`; its type is that of the default.

    Args:
        default: A number, a string, a bool, or a tuple of whole numbers.
        text, range, metavar, main: As of `Declared`.
    """
    return field(default=default, metadata={"declared": Declared(text, range, metavar, main)})


def declared(each: Field) -> Declared:
    """What `option` said of a field."""
    return each.metadata["declared"]


def settled(each: Field, value: Any) -> Any:
    """The value of an option as a plain one of Python.

    Raises:
        TypeError: A value of another type, naming the option.
        ValueError: A value outside its range, naming the option.
    """
    value = plain_value(each.name, value, type(each.default))
    fits, expected, hint = declared(each).range
    check_value(each.name, fits(value), expected, f"{value:g}{hint}" if hint else value)
    return value


@dataclass(frozen=True)
class Options:
    """Base of dataclasses whose fields are made by `option`: settles every value."""

    def __post_init__(self):
        for each in fields(self):
            object.__setattr__(self, each.name, settled(each, getattr(self, each.name)))


def described(kind: type) -> type:
    """The class, with its options in the docstring."""
    add_attributes(kind, {each.name: declared(each).text for each in fields(kind)})
    return kind


def add_attributes(kind: type, texts: Mapping[str, str]) -> None:
    """Adds the section "Attributes" to the docstring of a class, before what it raises; nothing with python -OO."""
    if not kind.__doc__:
        return
    as_entry = {"width": 116, "initial_indent": "    ", "subsequent_indent": "        "}
    entries = (textwrap.fill(f"{name}: {text}", **as_entry) for name, text in texts.items())
    head, raises, rest = inspect.cleandoc(kind.__doc__).partition("Raises:\n")
    kind.__doc__ = "\n".join([head.rstrip(), "", "Attributes:", *entries, *(["", raises + rest] if raises else [])])
