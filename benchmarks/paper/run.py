"""Trains and tests what a table needs, and nothing twice.

In the folder of the results, TRAINING/ROW/SCENE has what `train` writes: tables that test the same trainings share it.
metrics.json there says that the training is complete, test-TABLE.json holds its test, and TABLE.md and TABLE.json in
the folder itself are written anew after every scene.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, NamedTuple

from analytic_rasterizer import io
from analytic_rasterizer.analysis.timing import describe_machine
from analytic_rasterizer.captures.loading import load_capture
from analytic_rasterizer.captures.pictures import load_pictures
from analytic_rasterizer.captures.source import CaptureSource
from analytic_rasterizer.training.evaluation import Perceptual, evaluate
from analytic_rasterizer.training.files import CHECKPOINT, METRICS, OPTIONS, SCENE, write_json, write_text
from analytic_rasterizer.training.options import TrainingOptions, preset_values
from analytic_rasterizer.training.run import Run
from analytic_rasterizer.training.start import background_of

from .protocols import Row, Table
from .report import Results, as_dict, markdown

# What makes a row what it is.
FIXED = ("effects", "footprint", "scales", "scale_repeats", "downsampling", "filter_3d", "supersampling")


class Job(NamedTuple):
    """One scene of one row."""

    row: Row
    scene: str
    place: Path  # of the capture
    folder: Path  # of the results
    options: TrainingOptions

    def __str__(self) -> str:
        return f"{self.row.name}, {self.scene}"


def run_table(
    table: Table,
    data,
    out,
    *,
    scenes: Sequence[str] = (),
    rows: Sequence[str] = (),
    device: str = "cpu",
    preset: str = "3dgs",
    lpips: Perceptual | None = None,
    say: Callable[[str], None] = print,
    **changes: Any,
) -> Results:
    """Trains and tests every scene of a table that is there, and writes the table.

    What is complete is not done again, and a training that was interrupted goes on from its checkpoint, so that the
    same call takes up where it ended. Checkpoints of complete trainings are removed. Nothing is downloaded.

    Args:
        table: One of TABLES.
        data: Folder with the scenes, see `Data.folders`.
        out: Folder for the results, made if it is missing.
        scenes, rows: Names; none: all.
        device: "cpu" or "cuda".
        preset: Of `TrainingOptions.preset`. The protocol wins over it.
        lpips: From `load_lpips`; None: LPIPS is left out.
        say: Is told about every scene before it is trained or tested.
        **changes: Further `TrainingOptions`, noted in the table; not those that make a row what it is.

    Returns:
        What was measured; also in TABLE.json and TABLE.md.

    Raises:
        ValueError: An unknown scene or row, a bad option, or results in `out` that were trained with other options or
            on other pictures; before anything is written.
        io.SceneError, OSError: None of the scenes is there, or one is broken; likewise.
        KeyboardInterrupt: The training was interrupted, and saved.
    """
    _check_names("scenes", scenes, table.data.scenes)
    _check_names("rows", rows, [row.name for row in table.rows])
    fixed = [name for name in changes if name in FIXED]
    if fixed:
        raise ValueError(f"{fixed[0]} is set by the rows of {table.name} and cannot be changed")
    chosen = [row for row in table.rows if row.name in (rows or [row.name])]
    jobs, skipped = [], []
    for row in chosen:
        for scene in (scene for scene in table.data.scenes if scene in (scenes or [scene])):
            place = table.data.find(Path(data).resolve(), scene)
            missing = _missing(table, row, scene, place)
            if missing:
                skipped.append(missing)
                continue
            values = preset_values(preset, table.options["scales"]) | changes | table.training_options(row, scene)
            values |= {"effects": "none", "pixels_per_gaussian": 0.0}  # of no protocol
            folder = Path(out) / table.training / row.name / scene
            jobs.append(Job(row, scene, place, folder, TrainingOptions(**values)))
    skipped = list(dict.fromkeys(skipped))
    if not jobs:
        raise io.SceneError(f"{data}: nothing of {table.name} is there: {'; '.join(skipped) or 'no scenes'}")
    _check(jobs, table)
    results = Results(table, describe_machine(device), preset, changes, skipped)
    for line in skipped:
        say(f"skipped: {line}")
    for number, job in enumerate(jobs, 1):
        measured = _stored_test(job, table, lpips)
        if measured is None:
            say(f"[{number}/{len(jobs)}] {job}")
            if not _train(job, table, device):
                say(f"stopped and saved: the same call goes on with {job}")
                raise KeyboardInterrupt
            measured = _test(job, table, device, lpips)
        results.tests.setdefault(job.row.name, {})[job.scene] = measured
        _write(results, Path(out))
    return results


def _check_names(what: str, names: Sequence[str], known) -> None:
    for name in names:
        if name not in known:
            raise ValueError(f"{what} must be among {', '.join(known)}; got {name}")


def _missing(table: Table, row: Row, scene: str, place: Path | None) -> str | None:
    """What a scene lacks, in words, or None."""
    if place is None:
        looked = ", ".join(folder for folder in table.data.folders if folder != ".")
        return f"{scene} is not there (nor in {looked})"
    if (place / "metadata.json").exists() or (place / "transforms_train.json").exists():
        return None
    needed = (table.images(row, scene), table.test_images(row, scene))
    absent = next((name for name in needed if not (place / name).is_dir()), None)
    return absent and f"{scene} has no folder {absent}{', for the bicubic rows' if row.bicubic else ''}"


def _check(jobs: list[Job], table: Table) -> None:
    """Raises for captures that cannot be used, and for results of other options or pictures."""
    used = {(job.place, images(job.row, job.scene)) for job in jobs for images in (table.images, table.test_images)}
    for place, images in sorted(used):
        if not load_capture(place, images).test:
            raise io.SceneError(f"{place}: there are no test pictures")
    for job in jobs:
        if not (job.folder / OPTIONS).exists():
            continue
        described = _read(job.folder / OPTIONS)
        try:
            trained_on, images = described["source"]["scene"], described["source"]["images"]
            stored = TrainingOptions.from_dict(described["options"])
        except (KeyError, TypeError, ValueError) as error:
            raise io.SceneError(f"{job.folder / OPTIONS}: not what `train` writes ({error})") from None
        same_place = os.path.abspath(trained_on) == os.path.abspath(job.place)
        if not same_place or images != table.images(job.row, job.scene):
            raise ValueError(f"{job.folder} was trained on {trained_on}; choose another --out")
        differing = [f.name for f in fields(stored) if getattr(stored, f.name) != getattr(job.options, f.name)]
        if differing:
            raise ValueError(f"{job.folder} was trained with other {', '.join(differing)}; choose another --out")


def _train(job: Job, table: Table, device: str) -> bool:
    """Trains, unless that was done before. Returns whether it came to the end; otherwise it was interrupted."""
    if (job.folder / METRICS).exists():
        return True
    source = CaptureSource(job.place, images=table.images(job.row, job.scene))
    run = Run(source, job.folder, job.options, device=device, resume=(job.folder / CHECKPOINT).exists())
    if not run.train():
        return False
    write_json(job.folder / METRICS, run.summary())
    (job.folder / CHECKPOINT).unlink()
    return True


def _test(job: Job, table: Table, device: str, lpips: Perceptual | None) -> dict[str, Any]:
    """Measures the trained scene, and keeps what was measured."""
    capture = load_capture(job.place, table.test_images(job.row, job.scene))
    background = background_of(job.options, capture.background) or capture.background
    scales = table.test_scales(job.row, job.scene)
    pictures = load_pictures(capture.test, scales, background, device, job.options.downsampling)
    scene = io.load_scene(job.folder / SCENE).to(device)
    options = {"supersampling": job.options.supersampling}
    test = evaluate(scene, pictures, job.options.footprint, lpips, **options)
    for of_scale in test.values():
        for name in ("views", "measured"):
            of_scale.pop(name, None)
    finest = pictures.settings[min(scales)][0]
    measured = _read(job.folder / METRICS) | {
        "views": len(pictures.views),
        "size": [finest.image_width, finest.image_height],
        "test": test,
    }
    write_json(_test_file(job, table), measured)
    return measured


def _stored_test(job: Job, table: Table, lpips: Perceptual | None) -> dict[str, Any] | None:
    """What `_test` kept, unless LPIPS is wanted and was not measured."""
    path = _test_file(job, table)
    if not path.exists():
        return None
    stored = _read(path)
    return stored if lpips is None or "lpips" in stored["test"]["mean"] else None


def _test_file(job: Job, table: Table) -> Path:
    return job.folder / f"test-{table.name}.json"


def _read(path: Path) -> dict[str, Any]:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise io.SceneError(f"{path}: not what `tables` writes ({error})") from None


def _write(results: Results, out: Path) -> None:
    write_json(out / f"{results.table.name}.json", as_dict(results))
    text = markdown(results)
    write_text(out / f"{results.table.name}.md", text)
