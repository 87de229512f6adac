"""COLMAP in a process of its own, whose progress is shown, and whose crash is a message."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

from .. import io
from ..training.reports import LINE_SECONDS, duration

WORKER = Path(__file__).with_name("worker.py")
STAGES = {
    "film": "photographs of the film",
    "features": "features",
    "pairs": "pairs compared",
    "placed": "photographs placed",
}
LIBRARY = "pycolmap"
LOG = "log.txt"
FIRST_LOOK = 5  # s: a line soon after the start
END = 5  # s in which a process ends that was told to


@dataclass(frozen=True)
class Job:
    """What the worker does.

    Attributes:
        database: The file, which may hold a part of it already.
        images: The folder of the pictures.
        output: The folder for the models, 0, 1, ..
        groups: Photographs of a camera each: {"model": a camera model of COLMAP, "names": files in `images`}.
        names: Of the photographs, by those of their files in `images`.
        pairs: Of these files, to compare.
        masks: The folder of masks, a.jpg.png of a.jpg, whose black pixels do not count; None: there are none.
        threads: How many.
        largest: Px of the longer side, to which pictures are reduced.
        features: The most of a picture.
    """

    database: str
    images: str
    output: str
    groups: Sequence[dict[str, Any]]
    names: dict[str, str]
    pairs: Sequence[tuple[str, str]]
    masks: str | None
    threads: int
    largest: int
    features: int


class Found(NamedTuple):
    """What the worker found."""

    models: list[list[str]]  # names of photographs, of the largest model first
    matched: int  # pairs that show the same points


def is_installed() -> bool:
    """Whether pycolmap is. It is not imported: see `worker`."""
    return find_spec(LIBRARY) is not None


def check_installed(source: Path) -> None:
    """Raises ImportError without pycolmap: what to install, or to run."""
    if not is_installed():
        raise ImportError(missing_library(source))


def missing_library(source: Path) -> str:
    """What to do without pycolmap."""
    return (
        f'{source}: photographs without cameras need pycolmap: pip install "analytic_rasterizer[colmap]", or find the '
        "cameras with COLMAP's own program, colmap automatic_reconstructor"
    )


def run_worker(job: Job, what: str) -> Found:
    """Runs the job, and shows its progress on stderr.

    Args:
        what: In front of lines of progress.

    Raises:
        RuntimeError: COLMAP failed or crashed; names the file of what it said. What it had done stays in the database.
    """
    log, stage, last = Path(job.database).with_name(LOG), "features", {}
    environment = os.environ | {"OMP_NUM_THREADS": str(job.threads)}
    with log.open("ab") as said, Stages(what) as display:
        process = subprocess.Popen(
            [sys.executable, str(WORKER)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=said,
            env=environment,
            text=True,
        )
        try:
            with suppress(BrokenPipeError):  # it ended at once, and the log says why
                process.stdin.write(json.dumps(asdict(job)) + "\n")
                process.stdin.flush()
            for line in process.stdout:
                last = json.loads(line)
                if "stage" in last:
                    stage = last["stage"]
                    display.show(stage, last["done"], last["of"])
            code = process.wait()
        finally:
            _end(process)
    if "models" in last:
        return Found(last["models"], last["matched"])
    reason = last.get("error") or (f"it ended with signal {-code}" if code < 0 else f"it ended with code {code}")
    raise RuntimeError(f"COLMAP failed ({STAGES[stage]}): {reason}; {log} has what it said, and a second run goes on")


def _end(process: subprocess.Popen) -> None:
    """Ends a process that still runs, after Ctrl-C for example."""
    with suppress(BrokenPipeError):
        process.stdin.close()
    process.stdout.close()
    if process.poll() is None:
        process.terminate()
        try:
            process.wait(END)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


class Stages:
    """Progress of stages, one after the other, on stderr: a bar in a terminal, elsewhere lines as of a training."""

    def __init__(self, what: str):
        self.what, self.stage, self.bar = what, "", None
        self.in_terminal = sys.stdout.isatty() and sys.stderr.isatty()

    def __enter__(self) -> Stages:
        return self

    def __exit__(self, *_) -> None:
        if self.bar is not None:
            self.bar.close()

    def say(self, lines: Sequence[str]) -> None:
        """Lines before the first stage."""
        for line in lines:
            print(line, file=sys.stderr, flush=True)

    def show(self, stage: str, done: int, of: int) -> None:
        """So many are done, of a stage that is a key of STAGES. Of the last of them there is always a line."""
        now = time.monotonic()
        if stage != self.stage:
            self.stage, self.began, self.first, self.line = stage, now, done, now - LINE_SECONDS + FIRST_LOOK
            if self.in_terminal:
                self.__exit__()
                tqdm = io.optional_import("tqdm", "train").tqdm
                self.bar = tqdm(total=of, initial=done, desc=STAGES[stage])
        if self.bar is not None:
            self.bar.update(done - self.bar.n)
        elif done == of or now - self.line >= LINE_SECONDS:
            self.line = now
            pace = (now - self.began) / max(done - self.first, 1)
            left = f", {duration(pace * (of - done))} left" if self.first < done < of else ""
            text = f"{self.what}: {STAGES[stage]}: {done:,} of {of:,} ({done / max(of, 1):.0%}{left})"
            print(text, file=sys.stderr, flush=True)
