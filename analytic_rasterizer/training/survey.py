"""A look at a capture: its cameras, the headers of all pictures, and the pixels of some. Broken files are left out."""

from __future__ import annotations

import warnings
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import torch

from .. import io
from ..captures import colmap
from ..captures.depth import Measured, measure_maps
from ..captures.evidence import BrokenPictures, Evidence, gather, object_stops, spread_out, stops_of
from ..captures.extent import outliers_of
from ..captures.layouts import Capture, Photograph
from ..captures.loading import check_capture, read_cameras, without_files
from ..captures.photographs import Header, read_header

UNREADABLE = "cannot be read"


class Survey(NamedTuple):
    """What is known of a capture after a look at it."""

    capture: Capture
    items: list[Photograph]  # all of them
    outliers: dict[int, float]  # places and distances of outlying cameras
    kept: list[Photograph]  # the others
    headers: dict[Path, Header]
    looked_at: list[Photograph]
    tracked: bool  # tracks say what is visible
    evidence: Evidence  # of what was looked at
    stops: dict[Path, torch.Tensor]  # of what was looked at
    maps: list[Measured]  # depth maps of what was looked at

    @property
    def shown_by(self) -> float | None:
        """How many photographs of the capture show the median point; None: there is none in what was looked at."""
        seen = self.evidence.seen[self.evidence.seen > 0]
        return seen.double().median().item() * len(self.kept) / len(self.looked_at) if len(seen) else None

    @property
    def points(self) -> torch.Tensor | None:
        return None if self.capture.points is None else self.capture.points[0]


def survey(folder: Path, images: str, cameras: str | None, most: int, among: set[Path] | None = None) -> Survey:
    """Reads at most `most` photographs, of all or of those `among` which they are to be, without broken ones."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # findings say it
        capture = read_cameras(folder, images, 0, cameras, "skip")
    check_capture(folder, capture)
    with ThreadPoolExecutor() as pool:
        files = [item.files[1] for item in (*capture.train, *capture.test)]
        headers = dict(zip(files, pool.map(_header, files)))
    capture = without_files(capture, {path for path, header in headers.items() if header is None}, UNREADABLE)
    while True:
        check_capture(folder, capture)
        try:
            return _look_at(capture, headers, most, among)
        except BrokenPictures as error:  # beyond their headers
            capture = without_files(capture, error.files, UNREADABLE)


def _header(path: Path) -> Header | None:
    try:
        return read_header(path)
    except io.SceneError:
        return None


def _look_at(capture: Capture, headers: dict[Path, Header], most: int, among: set[Path] | None) -> Survey:
    """`survey` of a capture. Raises BrokenPictures."""
    items = sorted([*capture.train, *capture.test], key=lambda item: str(item.files[1]))
    points = None if capture.points is None else capture.points[0]
    outliers = outliers_of([item.view for item in items], points)
    kept = [item for place, item in enumerate(items) if place not in outliers]
    wanted = [item for item in kept if among is None or item.files[1] in among]
    fitting = [item for item in wanted if headers[item.files[1]].fits(item.view)]
    looked_at = spread_out(fitting or wanted, most)
    from_colmap = points is not None and capture.source is not None and capture.source.is_dir()
    tracks = colmap.load_tracks(capture.source) if from_colmap else {}
    evidence = gather(looked_at, points, tracks)
    if evidence.points:
        stops = stops_of(evidence, bool(tracks))
    else:
        stops = object_stops(evidence, torch.stack([item.view.w2c[2, :3] for item in looked_at]))
    stops_by_file = dict(zip((item.files[1] for item in looked_at), stops))
    maps = measure_maps(looked_at, points, tracks)
    return Survey(capture, items, outliers, kept, headers, looked_at, bool(tracks), evidence, stops_by_file, maps)
