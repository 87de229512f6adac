"""What is found of a capture: an effect, a number, a verdict, and the option that acts on it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from .options import as_words

YES, NO, NOT_KNOWN = "yes", "no", "not known"
"""Verdicts: whether a capture has an effect to an extent that matters."""

NAMED = 5  # photographs in a line


@dataclass(frozen=True)
class Finding:
    """An effect of a capture.

    Attributes:
        effect: Its name.
        number: What was measured; None: nothing could be, or it is not finite.
        unit: Of the number.
        verdict: YES, NO or NOT_KNOWN: whether the effect matters here.
        reason: What the number is, and what follows.
        options: The option of `train` that acts on it, and its value: {"scales": (1, 2)}. Empty where there is none, or
            none is needed.
        photographs: Names of files that it is about.
    """

    effect: str
    number: float | None
    unit: str
    verdict: str
    reason: str
    options: dict[str, Any] = field(default_factory=dict, hash=False)
    photographs: tuple[str, ...] = ()

    @property
    def option(self) -> str:
        """`options` as the command line spells them: "--scales 1,2"."""
        return as_words(self.options)

    def to_text(self) -> str:
        """One line."""
        shown = "" if self.number is None else f"{self.number:.3g} {self.unit} "
        named = ", ".join(self.photographs[:NAMED]) + (", .." if len(self.photographs) > NAMED else "")
        parts = [f"{shown}{self.reason}", named, self.option]
        return f"{self.effect:<16} {self.verdict:<9}  {'; '.join(filter(None, parts))}"

    def to_json(self) -> dict[str, Any]:
        """Everything, as JSON holds it; the option in words."""
        names = ("effect", "number", "unit", "verdict", "option", "reason", "photographs")
        return {name: getattr(self, name) for name in names}
