"""One page about a training: how it went, how good the scene is, and what its capture calls for."""

from __future__ import annotations

import base64
import json
from collections.abc import Iterable, Sequence
from html import escape
from io import BytesIO
from pathlib import Path
from typing import Any

from .. import io
from ..analysis.plots import Draw, capture_plots, evaluation_plots, log_plots, to_svg
from ..captures.evidence import interval_ranges
from .files import EVALUATION, LOG, METRICS, OPTIONS
from .options import TrainingOptions, value_in_words
from .plan import CapturePlan, plan_capture
from .reports import duration

MOST_PICTURES, WIDEST, QUALITY = 8, 1800, 88  # pictures, px, of JPEG

STYLE = """
:root { color-scheme: light dark; --ink: #1c1e21; --paper: #fff; --line: #d9dce1; }
@media (prefers-color-scheme: dark) { :root { --ink: #e6e8eb; --paper: #16181c; --line: #3a3f47; } }
body { margin: 2rem auto; max-width: 72rem; padding: 0 1rem; font: 16px/1.5 sans-serif; color: var(--ink);
  background: var(--paper); }
h1, h2 { font-weight: 600; line-height: 1.2; }
.plots { display: flex; flex-wrap: wrap; gap: 1rem; }
.plots svg { flex: 1 1 18rem; min-width: 16rem; max-width: 30rem; height: auto; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: 0.9rem; }
th, td { border-bottom: 1px solid var(--line); padding: 0.25rem 0.8rem 0.25rem 0; text-align: left;
  vertical-align: top; }
figure { margin: 1rem 0; } figure img { width: 100%; height: auto; } figcaption { font-size: 0.9rem; }
"""


def plots_of_capture(plan: CapturePlan) -> list[Draw]:
    """What a capture looks like: exposures, sampling intervals, masks; what is not known is left out."""
    if plan.survey is None:
        return []
    evidence = plan.survey.evidence
    names = [item.files[1].name for item in plan.survey.looked_at]
    stops = {path.name: value.tolist() for path, value in plan.stops.items()}
    counted = {} if evidence.counted is None else dict(zip(names, evidence.counted.tolist()))
    return capture_plots(stops, interval_ranges(evidence).tolist(), counted)


def plots_of_training(folder: Path) -> list[Draw]:
    """How a training went, and how good its scene is.

    Raises:
        io.SceneError: The folder holds no training, or files that `train` did not write.
    """
    history = _history(folder)
    results, names = _results(folder, _described(folder)[0])
    return [*log_plots(history), *(evaluation_plots(results, names) if results else [])]


def write_report(folder, path, with_capture: bool = True) -> None:
    """Writes a page (HTML, one file that needs nothing else) about a training.

    Args:
        folder: That `train` wrote.
        path: Of the page.
        with_capture: Also look at the photographs; where they are gone a line says so.

    Raises:
        ImportError: There is no matplotlib or no Pillow; names the extra.
        io.SceneError: As `plots_of_training`.
        OSError: A file cannot be read or written.
    """
    folder = Path(folder)
    history, (options, source, device) = _history(folder), _described(folder)
    results, names = _results(folder, options)
    parts = [
        f"<p>{_sentence(options, source, device, history[-1])}</p>",
        "<h2>Training</h2>",
        _plots(log_plots(history)),
        "<h2>Test</h2>",
        *(_test(results, names) if results else ["<p>It was not tested: <code>evaluate</code> does it.</p>"]),
        *_pictures(folder / EVALUATION),
        *(_capture(source) if with_capture else []),
        "<h2>Options</h2><p>Those that are not the default.</p>",
        _table(["option", "value"], _changed(options)),
    ]
    title = escape(folder.resolve().name)
    head = '<meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">'
    page = f'<!doctype html>\n<html lang="en"><head>{head}<title>{title}</title><style>{STYLE}</style></head>\n'
    io.write_text(path, f"{page}<body><h1>{title}</h1>\n" + "\n".join(parts) + "\n</body></html>\n")


def _text(path: Path) -> str:
    if not path.is_file():
        raise io.SceneError(f"{path.parent}: no training, {path.name} is missing", "give the folder that `train` wrote")
    return path.read_text(encoding="utf-8")


def _read(path: Path) -> Any:
    text = _text(path)
    try:
        return json.loads(text)
    except ValueError as error:
        raise io.SceneError(f"{path}: not what `train` writes ({error})") from None


def _history(folder: Path) -> list[dict]:
    path, history = folder / LOG, []
    for number, line in enumerate(_text(path).splitlines(), 1):
        try:
            entry = json.loads(line)
            history.append({name: entry[name] for name in ("step", "seconds", "loss", "psnr", "gaussians")})
            history[-1]["footprint"] = entry.get("footprint")
        except (ValueError, KeyError, TypeError) as error:
            raise io.SceneError(f"{path}: line {number} is not what `train` writes ({error!r})") from None
    if not history:
        raise io.SceneError(f"{path}: the training has not logged anything yet")
    return history


def _described(folder: Path) -> tuple[TrainingOptions, dict[str, Any], str]:
    """The options, where the pictures are from, and the device."""
    described = _read(folder / OPTIONS)
    try:
        options = TrainingOptions.from_dict(described["options"])
        return options, described["source"], described.get("device", "an unknown device")
    except (KeyError, TypeError, ValueError) as error:
        raise io.SceneError(f"{folder / OPTIONS}: not what `train` writes ({error})") from None


def _results(folder: Path, options: TrainingOptions) -> tuple[dict[str, dict], list[str] | None]:
    """What the test said, by footprint, and names of the views: of `evaluate`, or else of `train`."""
    path = folder / f"{EVALUATION}.json"
    if path.is_file():
        found = _read(path)
        results, names = found.get("results"), found.get("views")
    else:
        metrics = _read(folder / METRICS) if (folder / METRICS).is_file() else {}
        results, names = {options.footprint: metrics["test"]} if "test" in metrics else {}, None
    return results or {}, names


def _sentence(options: TrainingOptions, source: dict, device: str, last: dict) -> str:
    code = f"<code>{escape(str(options.footprint))}</code>"
    capture = escape(str(Path(source.get("scene", "")).name))
    return (
        f"{last['gaussians']:,} Gaussians after {last['step']:,} steps in {duration(last['seconds'])} on "
        f"{escape(device)}, from the capture {capture}, for the footprint {code}."
    )


def _plots(plots: Iterable[Draw]) -> str:
    return f'<div class="plots">{"".join(map(to_svg, plots))}</div>'


def _table(header: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    def line(cells: Sequence[Any], tag: str) -> str:
        return "<tr>" + "".join(f"<{tag}>{escape(str(cell))}</{tag}>" for cell in cells) + "</tr>"

    body = "".join(line(row, "td") for row in rows)
    return f'<div class="wide"><table><thead>{line(header, "th")}</thead><tbody>{body}</tbody></table></div>'


def _test(results: dict[str, dict], names: list[str] | None) -> list[str]:
    rows = []
    for footprint, measured in results.items():
        for scale, values in measured.items():
            size = "mean" if scale == "mean" else f"1/{scale}"
            shown = (values.get(name) for name in ("psnr", "psnr_color_corrected", "ssim", "lpips"))
            digits = (2, 2, 4, 4)
            rows.append([footprint, size, *("-" if v is None else f"{v:.{n}f}" for v, n in zip(shown, digits))])
    header = ["footprint", "size", "PSNR [dB]", "after the best affine colour", "SSIM", "LPIPS"]
    return [_table(header, rows), _plots(evaluation_plots(results, names))]


def _pictures(folder: Path) -> list[str]:
    """Pictures that `evaluate` wrote, made smaller."""
    files = sorted(folder.glob("*.png"))
    if not files:
        return ["<p><code>evaluate</code> adds pictures: truth, rendering, and their difference.</p>"]
    image, shown = io.optional_import("PIL.Image", "cli"), []
    for path in files[:MOST_PICTURES]:
        with image.open(path) as picture:
            small = picture.convert("RGB")
        small.thumbnail((WIDEST, WIDEST))
        small.save(in_memory := BytesIO(), "JPEG", quality=QUALITY)
        data = base64.b64encode(in_memory.getvalue()).decode()
        name = escape(path.stem)
        picture = f'<img alt="{name}" src="data:image/jpeg;base64,{data}">'
        shown.append(f"<figure>{picture}<figcaption>{name}</figcaption></figure>")
    left = len(files) - len(shown)
    more = f" {left} more are in the folder {EVALUATION}." if left else ""
    return [f"<p>Truth, rendering, and their difference, enlarged.{more}</p>", *shown]


def _capture(source: dict) -> list[str]:
    parts = ["<h2>Capture</h2>"]
    try:
        plan = plan_capture(source["scene"], source["images"], cameras=source.get("cameras"))
    except (KeyError, OSError, ValueError) as error:  # SceneError is one
        return [*parts, f"<p>It cannot be looked at: {escape(str(error))}</p>"]
    rows = [[each.effect, each.verdict, each.reason, each.option] for each in plan.findings]
    return [*parts, _plots(plots_of_capture(plan)), _table(["effect", "matters", "why", "option"], rows)]


def _changed(options: TrainingOptions) -> list[tuple[str, str]]:
    default, given = TrainingOptions().to_dict(), options.to_dict()
    return [(name, value_in_words(value)) for name, value in given.items() if value != default[name]]
