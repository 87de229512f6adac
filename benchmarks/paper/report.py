"""A table as text, as Markdown and as JSON: our rows, and below each the row of the paper that it repeats."""

from __future__ import annotations

from dataclasses import dataclass, field
from statistics import mean
from typing import Any

from analytic_rasterizer.analysis.tables import format_table, markdown_table
from analytic_rasterizer.training.evaluation import MEASURES

from .protocols import Table
from .published import AVERAGE, FOUR_SCALES, PUBLISHED, Number, Published

UNITS = {"psnr": "PSNR [dB]", "ssim": "SSIM", "lpips": "LPIPS"}
DECIMALS = {"psnr": 2, "ssim": 3, "lpips": 3}
MEAN = "mean"


@dataclass
class Results:
    """What was measured for a table.

    Attributes:
        machine: The device, in words.
        preset, changes: How the trainings depart from the protocol.
        skipped: What was absent, in words.
        tests: By row and scene: "test" (by scale, and "mean" over scales, the measures), "views" that were tested,
            their "size" [px] at the finest scale, and "steps", "seconds" and "gaussians" of the training.
    """

    table: Table
    machine: str
    preset: str
    changes: dict[str, Any]
    skipped: list[str]
    tests: dict[str, dict[str, dict[str, Any]]] = field(default_factory=dict)

    @property
    def scenes(self) -> list[str]:
        """Those of which any row was measured, in the table's order."""
        return [scene for scene in self.table.data.scenes if any(scene in row for row in self.tests.values())]

    @property
    def measures(self) -> list[str]:
        """Those that every test has."""
        means = [test["test"]["mean"] for row in self.tests.values() for test in row.values()]
        return [measure for measure in MEASURES if all(measure in values for values in means)]

    @property
    def scales(self) -> tuple[str, ...]:
        """Of the blocks: the mean over scales, and where there are several, each."""
        return (MEAN, *map(str, self.table.scales)) if len(self.table.scales) > 1 else (MEAN,)


def text(results: Results) -> str:
    """The `results` as text: a block per measure and scale, with what has to be known for reading them."""
    blocks = [f"{heading}\n{format_table(header, rows)}" for heading, header, rows in _blocks(results)]
    return "\n\n".join([results.table.title, *blocks, "\n".join(_remarks(results))])


def markdown(results: Results) -> str:
    """The `results` as Markdown."""
    blocks = [f"## {heading}\n\n{markdown_table(header, rows)}" for heading, header, rows in _blocks(results)]
    remarks = "\n".join(f"- {remark}" for remark in _remarks(results))
    return "\n\n".join([f"# {results.table.title}", *blocks, "## Remarks", remarks]) + "\n"


def as_dict(results: Results) -> dict[str, Any]:
    """The `results` as JSON can hold them: all that was measured, and all that the paper prints."""
    published = PUBLISHED.get(results.table.name)
    return {
        "table": results.table.name,
        "title": results.table.title,
        "machine": results.machine,
        "preset": results.preset,
        "changes": results.changes,
        "remarks": _remarks(results),
        "results": results.tests,
        "published": {} if published is None else _with_names(published),
    }


def _with_names(published: Published) -> dict[str, Any]:
    """The source, and each number as {"value", "doubtful"}."""
    numbers: dict = {}
    for measure, methods in published.numbers.items():
        for method, scales in methods.items():
            for scale, scenes in scales.items():
                cells = {scene: number._asdict() for scene, number in scenes.items()}
                numbers.setdefault(measure, {}).setdefault(method, {})[scale] = cells
    return {"source": published.source, "numbers": numbers}


def _blocks(results: Results) -> list[tuple[str, list[str], list[list[str]]]]:
    """Heading, header and rows, for every measure and scale."""
    header = ["", *results.scenes, MEAN]
    blocks = []
    for measure in results.measures:
        for scale in results.scales:
            heading = UNITS[measure]
            if len(results.scales) > 1:
                heading += ", mean over scales" if scale == MEAN else f", scale 1/{scale}"
            blocks.append((heading, header, _rows(results, measure, scale)))
    return blocks


def _rows(results: Results, measure: str, scale: str) -> list[list[str]]:
    """Ours, each followed by the paper's of the same method, and then the paper's other methods."""
    published = PUBLISHED.get(results.table.name)
    methods = list(published.numbers.get(measure, {})) if published else []
    rows, repeated = [], set()
    for row in results.table.rows:
        if row.name not in results.tests:
            continue
        values = [_measured(results, row.name, scene, measure, scale) for scene in results.scenes]
        average = None if None in values else mean(values)
        rows.append([row.name, *(_cell(measure, Number(value)) for value in (*values, average))])
        if row.published in methods:
            repeated.add(row.published)
            rows += _published_row(published, measure, row.published, scale, results.scenes)
    for method in methods:
        if method not in repeated:
            rows += _published_row(published, measure, method, scale, results.scenes)
    return rows


def _measured(results: Results, row: str, scene: str, measure: str, scale: str) -> float | None:
    of_scene = results.tests[row].get(scene)
    return None if of_scene is None else of_scene["test"][scale][measure]


def _published_row(published: Published, measure: str, method: str, scale: str, scenes: list[str]) -> list[list[str]]:
    """The row, or none where the paper has nothing for this scale."""
    of_method = published.numbers[measure][method]
    numbers = [_number(of_method, scale, scene) for scene in scenes]
    if all(number.value is None for number in numbers):
        return []
    of_scale = of_method.get(scale, {})
    everything = set(of_scale) - {AVERAGE} == set(scenes)
    average = of_scale[AVERAGE] if AVERAGE in of_scale and everything else _mean(numbers)
    return [[f"paper: {method}", *(_cell(measure, number) for number in (*numbers, average))]]


def _number(of_method: dict[str, dict[str, Number]], scale: str, scene: str) -> Number:
    """The printed number, or the mean over scales where only the scales are printed."""
    if scale == MEAN and MEAN not in of_method:
        return _mean([of_method.get(s, {}).get(scene, Number(None)) for s in FOUR_SCALES])
    return of_method.get(scale, {}).get(scene, Number(None))


def _mean(numbers: list[Number]) -> Number:
    """Unknown if one is, doubtful if one is."""
    if any(number.value is None for number in numbers):
        return Number(None)
    return Number(mean(number.value for number in numbers), any(number.doubtful for number in numbers))


def _cell(measure: str, number: Number) -> str:
    if number.value is None:
        return "-"
    return f"{number.value:.{DECIMALS[measure]}f}{'?' if number.doubtful else ''}"


def _views(results: Results, scene: str) -> str:
    """How many were tested, and their size."""
    test = next(row[scene] for row in results.tests.values() if scene in row)
    return f"{test['views']} of {test['size'][0]}x{test['size'][1]} px"


def _remarks(results: Results) -> list[str]:
    """Whatever makes these numbers differ from those of the protocol, or the paper's doubtful."""
    table, remarks = results.table, [f"Measured on {results.machine}."]
    published = PUBLISHED.get(table.name)
    if published is None:
        remarks.append("The paper's supplement has no such table.")
    else:
        remarks.append(f"Rows of the paper: Analytic-Splatting, supplement, {published.source}. ?: doubtful.")
    changes = [f"preset {results.preset}"] if results.preset != "3dgs" else []
    changes += [f"{name} = {value}" for name, value in results.changes.items()]
    if changes:
        remarks.append(f"Departs from the protocol: {', '.join(changes)}.")
    if len(results.scenes) < len(table.data.scenes):
        remarks.append(f"Means, the paper's too, are over {len(results.scenes)} of {len(table.data.scenes)} scenes.")
    views = {scene: _views(results, scene) for scene in results.scenes}
    remarks.append(f"Views that were tested: {', '.join(f'{scene} {tested}' for scene, tested in views.items())}.")
    if table.data.views and set(views.values()) != {table.data.views}:
        remarks.append(f"The paper tests {table.data.views} of every scene.")
    if "lpips" not in results.measures:
        remarks.append("LPIPS is left out.")
    remarks += [f"Skipped: {line}." for line in results.skipped]
    return remarks + list(published.notes if published else ())
