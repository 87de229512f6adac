"""What a training says while it runs: a bar in a terminal, lines elsewhere, and TensorBoard."""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path
from typing import Any

from .. import io

LINE_SECONDS = 10  # at least, between two lines
TENSORBOARD = "tensorboard"  # the folder


class Display:
    """Progress on the screen. A context manager.

    Where stdout and stderr are terminals it is a bar. Elsewhere there are lines: one soon after the start, then one
    every ten seconds or with every look, whichever is later, and one at the end. Both are on stderr: stdout is for
    results.

    Args:
        steps: In all; None: the training goes by `seconds`.
        seconds: In all, where it does.
        step: At which it starts.
        shown: Whether anything is; of several processes one shows something.
    """

    def __init__(self, steps: int | None, seconds: float, step: int, shown: bool = True):
        self.steps, self.seconds, self.shown = steps, seconds, shown
        self.bar = None
        self.line = time.monotonic(), step  # when the last one was printed, and at which step
        self.started = False
        if shown and sys.stdout.isatty() and sys.stderr.isatty():
            self.bar = io.optional_import("tqdm", "train").tqdm(total=steps, initial=step, unit="step")

    def __enter__(self) -> Display:
        return self

    def __exit__(self, *_) -> None:
        if self.bar is not None:
            self.bar.close()

    def show(self, entry: dict[str, Any], last: bool) -> None:
        """Shows an entry of the log, at most as often as it is due; the last one always."""
        if self.bar is not None:
            self.bar.update(entry["step"] - self.bar.n)
            self.bar.set_postfix(figures_of(entry))
        elif self.shown:
            now, (before, step) = time.monotonic(), self.line
            if last or not self.started or now - before >= LINE_SECONDS:
                pace = (now - before) / max(entry["step"] - step, 1)
                print(f"{self._place(entry, pace)}: {describe(entry)}", file=sys.stderr, flush=True)
                self.line, self.started = (now, entry["step"]), True

    def _place(self, entry: dict[str, Any], pace: float) -> str:
        """How far the training is, and how long it still takes with so many seconds per step."""
        if self.steps is None:
            share, left, step = entry["seconds"] / self.seconds, self.seconds - entry["seconds"], f"{entry['step']:,}"
        else:
            share, left = entry["step"] / self.steps, pace * (self.steps - entry["step"])
            step = f"{entry['step']:,} of {self.steps:,}"
        return f"step {step} ({min(share, 1):.0%}, {duration(max(left, 0))} left)"

    def warn(self, text: str) -> None:
        """Says something on stderr."""
        if self.bar is not None:
            self.bar.write(f"warning: {text}", file=sys.stderr)
        elif self.shown:
            print(f"warning: {text}", file=sys.stderr, flush=True)


def figures_of(entry: dict[str, Any]) -> dict[str, str]:
    """Loss, PSNR and number of Gaussians of an entry of the log, as they are shown; the footprint where it changes."""
    quality = "" if entry["psnr"] is None else f"{entry['psnr']:.1f}"
    figures = {"loss": f"{entry['loss']:.4f}", "PSNR": quality, "Gaussians": f"{entry['gaussians']:,}"}
    return figures | ({"footprint": entry["footprint"]} if "footprint" in entry else {})


def describe(entry: dict[str, Any]) -> str:
    """The same as a text."""
    return ", ".join(f"{name} {value}" for name, value in figures_of(entry).items())


def duration(seconds: float) -> str:
    """A time to wait: 12 s, 3:40 min or 1:05 h."""
    seconds = round(seconds)
    if seconds < 60:
        return f"{seconds} s"
    if seconds < 3600:
        return f"{seconds // 60}:{seconds % 60:02} min"
    return f"{seconds // 3600}:{seconds // 60 % 60:02} h"


def process_age() -> float | None:
    """Seconds since this process began, where Linux says so."""
    try:
        began = int(Path("/proc/self/stat").read_text().rpartition(")")[2].split()[19]) / os.sysconf("SC_CLK_TCK")
        return time.clock_gettime(time.CLOCK_BOOTTIME) - began
    except (OSError, ValueError, IndexError, AttributeError):
        return None


class TensorBoard:
    """The numbers of the log for TensorBoard, in a folder of the results.

    Raises:
        ImportError: It is not installed; names the extra that brings it.
    """

    def __init__(self, folder: Path, step: int):
        io.optional_import("tensorboard", "tensorboard")  # torch's module does not say which package is missing
        module = io.optional_import("torch.utils.tensorboard", "tensorboard")
        # What an interrupted training wrote after its checkpoint is not shown.
        self.writer = module.SummaryWriter(str(folder / TENSORBOARD), purge_step=step + 1)

    def add(self, entry: dict[str, Any]) -> None:
        for name in ("loss", "psnr", "gaussians", "seconds"):
            if entry[name] is not None:
                self.writer.add_scalar(f"training/{name}", entry[name], entry["step"])
        self.writer.flush()

    def close(self) -> None:
        self.writer.close()
