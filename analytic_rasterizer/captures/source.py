"""Where a training gets its pictures, cameras and points from."""

from __future__ import annotations

import os
import warnings
from collections.abc import Collection
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from .loading import CHOICES, IMAGES, TEST_PERIOD, Capture, load_capture, load_photographs

READING = ("images", "test_every", "cameras", *CHOICES)  # arguments of `load_capture`
USUAL = {"images": IMAGES, "test_every": TEST_PERIOD} | {name: choices[0] for name, choices in CHOICES.items()}


@dataclass(frozen=True)
class CaptureSource:
    """The capture that a training reads, and how. None: as is usual there, or as when a training began.

    Attributes:
        folder: Of the capture, see `load_capture`.
        images, test_every, cameras, lens, missing, masks, alpha: As of `load_capture`.
        points: A .ply to start from: a 3DGS scene, or points with colours. None: what the capture has.
    """

    folder: str | Path
    images: str | None = None
    test_every: int | None = None
    points: str | Path | None = None
    cameras: str | None = None
    lens: str | None = None
    missing: str | None = None
    masks: str | None = None
    alpha: str | None = None

    @classmethod
    def of(cls, scene: CaptureSource | str | Path, **reading: Any) -> CaptureSource:
        """The source itself, or that of the folder `scene`, read as `reading` says by the names of attributes.

        Raises:
            TypeError: Another name, or a source that says already how it is read.
        """
        if not isinstance(scene, CaptureSource):
            return cls(scene, **reading)
        if reading:
            raise TypeError(f"{', '.join(reading)} must be in the CaptureSource, and not beside it")
        return scene

    @classmethod
    def from_dict(cls, described: dict[str, Any]) -> CaptureSource:
        """The source that is `described` in options.json. Raises KeyError for what `train` did not write."""
        known = {name: described[name] for name in ("points", "cameras", *CHOICES) if name in described}
        return cls(described["scene"], described["images"], described["test_every"], **known)

    def to_dict(self) -> dict[str, Any]:
        """What options.json holds of a settled source. Paths are absolute: `evaluate` is called from anywhere."""
        own = vars(self) | {"points": self.points and str(Path(self.points).resolve())}
        return {"scene": os.path.abspath(own.pop("folder")), **own}

    def settled(self, before: dict[str, Any] | None = None) -> CaptureSource:
        """The same with what is usual in place of None, or as it was when a training began that is resumed.

        Args:
            before: Of that training, what `to_dict` gave.

        Raises:
            ValueError: Another source than it began with: it would go on with other pictures, or points of no effect.
        """
        if before is None:
            return replace(self, **{name: value for name, value in USUAL.items() if getattr(self, name) is None})
        given = self.to_dict()
        # Checkpoints of earlier versions have no points: nobody knows them.
        began = USUAL | {"cameras": None, "points": given["points"]} | before
        for name, value in given.items():
            if name != "scene" and value not in (None, began[name]):
                expected = "None" if began[name] is None else f"{began[name]} or None"
                raise ValueError(f"{name} must be {expected} where a training is resumed, got {value}")
        return replace(self, **{name: began[name] for name in given if name != "scene"})

    def load(self, **offset: Any) -> Capture:
        """What `load_capture` reads, with its `offset`. Warns, and raises, as there."""
        return load_capture(self.folder, **self._reading(), **offset)

    def load_photographs(self) -> Capture:
        """What `load_photographs` reads: no points, and in world coordinates."""
        return load_photographs(self.folder, **self._reading())

    def _reading(self) -> dict[str, Any]:
        settled = self.settled()
        return {name: getattr(settled, name) for name in READING}

    def check_out(self, out: str | Path, capture: Capture | None = None) -> None:
        """Raises ValueError for a folder of results that is the capture's own, or one of its pictures.

        Args:
            out: The folder.
            capture: What was loaded; None: nothing yet, and folders of pictures are not known.
        """
        items = () if capture is None else (*capture.train, *capture.test)
        files = [path for item in items for path in item.files.values()]
        own = {Path(self.folder).resolve(), *(path.parent.resolve() for path in files)}
        if Path(out).resolve() in own:
            raise ValueError(f"--out must be another folder than the capture and those of its pictures, got {out}")

    def check_effect(self, capture: Capture, chosen: Collection[str]) -> None:
        """Raises ValueError if `images` or `test_every` are among the options `chosen`, and change nothing.

        Args:
            capture: What was loaded.
        """
        folder, settled = Path(self.folder), self.settled()
        files = [path for item in (*capture.train, *capture.test) for path in item.files.values()]
        if "images" in chosen and not any(path.is_relative_to(folder / settled.images) for path in files):
            raise ValueError(f"--images has no effect: {folder} itself says where its pictures are, as in {files[0]}")
        if "test_every" in chosen:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # which have been said
                without = replace(settled, test_every=0).load()
            if without.test:
                raise ValueError(f"--test-every has no effect: {folder} itself says which pictures are for the test")
