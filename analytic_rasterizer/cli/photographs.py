"""The photographs that a scene was trained with, as PNG, for `view`: its page compares them with the rendering."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from io import BytesIO
from pathlib import Path

from ..captures.loading import Photograph
from ..captures.pictures import load_pictures
from ..captures.source import CaptureSource
from ..io import FoundScene, SceneError, View, to_image
from ..training.options import TrainingOptions


def find_photographs(found: FoundScene, views: list[View]) -> tuple[dict[int, Callable[[], bytes]], list[str]]:
    """The photographs of a training's capture by the numbers of their views, and what to say of them.

    Views with a lens have none, since the page draws them without it. A photograph is read when its function is
    called, which returns a PNG of what the training saw: reduced, cut and on the background as there.
    """
    if found.training is None or not views:
        return {}, []
    try:
        source = CaptureSource.from_dict(found.training.source)
        options = TrainingOptions.from_dict(found.training.options)
        capture = source.load_photographs()  # in world coordinates: views are known by their names
    except (OSError, ValueError, KeyError, TypeError, ImportError) as error:
        # No option of `view` says how a capture is read.
        return {}, [f"no photographs: {error.told(()) if isinstance(error, SceneError) else error}"]
    items = {item.view.name: item for item in (*capture.train, *capture.test)}
    background = (found.background or (capture.background, ""))[0]

    def reader(item: Photograph) -> Callable[[], bytes]:
        return lambda: png(item, options, background)

    made = {k: reader(items[view.name]) for k, view in enumerate(views) if view.name in items and view.lens is None}
    return made, [f"{len(made)} photographs of {Path(source.folder)} to compare with"]


def png(item: Photograph, options: TrainingOptions, background: tuple[float, float, float]) -> bytes:
    """A photograph as the training saw it, at its finest scale."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        pictures = load_pictures([item], options.scales, background, "cpu", options.downsampling)
    in_memory = BytesIO()
    to_image(pictures.truth(min(options.scales), 0)[:3]).save(in_memory, "PNG", compress_level=1)
    return in_memory.getvalue()
