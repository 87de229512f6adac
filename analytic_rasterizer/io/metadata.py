"""Metadata of scenes: for which footprint and order a scene was made, and the offset of its positions.

A .ply holds metadata in comments, an .spz in a flag and an extension, a .sog in its meta.json (extras), a glTF in
its asset.extras, a USD in its customLayerData. A .splat holds none.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ..footprints import COMPENSATED, DILATED, resolve_footprint
from ..render.order import CENTER, check_order
from . import gltf, ply, sog, spz, usd
from .axes import axes_in, axes_of_format, checked_axes
from .errors import first_line
from .formats import scene_file

OWN = "analytic_rasterizer"  # the first word of lines that only this package reads
ANTIALIASED = "SplatRenderMode: mip"  # the line that other programs read


@dataclass(frozen=True)
class SceneMetadata:
    """What a file of a scene says beside its Gaussians. None where it says nothing.

    Attributes:
        footprint: The footprint that the scene was trained with or baked for, such as "moment:samples=4". Only files of
            this package say it.
        antialiased: Whether the scene wants pixels that are integrated. Other programs say so too, after a training
            with an antialiasing filter. In an .spz, False is also what programs write that know nothing about it.
        offset: (x, y, z), world units. Positions in the world are those that `load_scene` returns plus this.
        comments: Other lines of text.
        background: (r, g, b) in [0, 1], the colour that the scene is to be seen in front of.
        order: The `Effects.order` that the scene was trained with. "center" is not written.
    """

    footprint: str | None = None
    antialiased: bool | None = None
    offset: tuple[float, float, float] | None = None
    comments: tuple[str, ...] = ()
    background: tuple[float, float, float] | None = None
    order: str | None = None

    def checked(self) -> SceneMetadata:
        """The same as it is written: the footprint with all of its options, and `antialiased` as that footprint is.

        Raises:
            ValueError: An unknown footprint or order, an offset that is not three finite numbers, a background that is
                not three numbers from 0 to 1, or comments that are not single lines of ASCII.
        """
        found = replace(self, comments=tuple(self.comments))
        for comment in found.comments:
            if not comment.isascii() or not comment.isprintable():
                raise ValueError(f"comments must be single lines of ASCII, got {comment!r}")
        if found.offset is not None:
            offset = tuple(float(value) for value in found.offset)
            if len(offset) != 3 or not all(math.isfinite(value) for value in offset):
                raise ValueError(f"offset must be three finite numbers, got {self.offset}")
            found = replace(found, offset=offset)
        if found.background is not None:
            background = tuple(float(value) for value in found.background)
            if len(background) != 3 or not all(0 <= value <= 1 for value in background):
                raise ValueError(f"background must be three numbers from 0 to 1, got {self.background}")
            found = replace(found, background=background)
        if found.order is not None:
            check_order(found.order)
        if found.footprint is not None:
            footprint = resolve_footprint(found.footprint)
            found = replace(found, footprint=str(footprint), antialiased=footprint.name != DILATED)
        return found

    def lines(self) -> list[str]:
        """The comments of a .ply that say this."""
        lines = [ANTIALIASED] if self.antialiased else []
        if self.footprint is not None:
            lines.append(f"{OWN} footprint {self.footprint}")
        if self.order not in (None, CENTER):
            lines.append(f"{OWN} order {self.order}")
        if self.offset is not None:
            lines.append(f"{OWN} offset {' '.join(repr(value) for value in self.offset)}")
        if self.background is not None:
            lines.append(f"{OWN} background {' '.join(repr(value) for value in self.background)}")
        return [*lines, *self.comments]

    def lost(self) -> list[str]:
        """What is lost with a file that holds no metadata, in words. `point` is what is assumed of such a file."""
        lost = []
        if self.antialiased:
            chosen = self.footprint or COMPENSATED
            lost.append(f"the footprint (`render --footprint {chosen}` shows it)")
        if self.order not in (None, CENTER):
            lost.append(f"the order (`render --order {self.order}` shows it)")
        if self.offset is not None and any(self.offset):
            lost.append(f"the offset {self.offset} of its positions")
        if self.background is not None:
            lost.append(f"the background {self.background}")
        return lost


def metadata_of(lines: Sequence[str], where) -> SceneMetadata:
    """What the comments of a .ply say. Warns, naming the file `where`, of lines of ours that make no sense."""
    fields: dict[str, Any] = {}
    others = []
    for line in lines:
        words = line.split()
        if words[:1] == ["SplatRenderMode:"] and len(words) == 2:  # Brush, PlayCanvas
            fields["antialiased"] = words[1] == "mip"
        elif words in (["antialiased", "0"], ["antialiased", "1"]):  # Postshot
            fields["antialiased"] = words[1] == "1"
        elif words[:1] == [OWN] and words[1:2] in (["footprint"], ["order"], ["offset"], ["background"], ["axes"]):
            try:
                fields |= _own_field(*words[1:])
            except (ValueError, TypeError) as error:
                warnings.warn(f"{where}: '{line}' is not understood ({first_line(error)})", stacklevel=3)
        else:
            others.append(line.strip())
    if "footprint" in fields:
        fields["antialiased"] = SceneMetadata(fields["footprint"]).checked().antialiased
    return SceneMetadata(**fields, comments=tuple(others))


def _own_field(name: str, *words: str) -> dict[str, Any]:
    """The field of `SceneMetadata` that a line of ours gives; none of axes, which are of the file and not of the scene.

    Raises ValueError or TypeError for what makes no sense.
    """
    if name == "axes":
        checked_axes(" ".join(words))
        return {}
    value = " ".join(words) if name in ("footprint", "order") else tuple(map(float, words))
    return {name: getattr(SceneMetadata(**{name: value}).checked(), name)}


def read_metadata(path) -> SceneMetadata:
    """What the file `path` of a scene says beside its Gaussians, which are not read.

    Warns of lines of this package that it does not understand: they are ignored.

    Raises:
        SceneError: The file, which is named, is not there or unreadable, or has the suffix of no format that
            `load_scene` reads.
    """
    path, kind = scene_file(path)
    antialiased, lines, _ = _read_lines(path, kind)
    found = metadata_of(lines, path)
    return found if antialiased is None else replace(found, antialiased=antialiased)


def read_axes(path) -> str:
    """The axes of the numbers in the file `path` of a scene, such as "rub": what it says, or those of its format.

    `load_scene` turns them to RDF. Of a .ply, .splat or .sog that says nothing they are RDF, of an .spz or USD RUB, and
    of a glTF LUF. An .spz may also be z-up, such as "rfu". Before axes were written, this package wrote RDF into an
    .spz and RUB into a glTF. Such files are known by our lines in them, but for an .spz without metadata.

    Raises:
        SceneError: As `read_metadata`.
    """
    path, kind = scene_file(path)
    return axes_said(path, kind) or axes_of_format(kind)


def axes_said(path: Path, kind: str) -> str | None:
    """The axes that a file of a scene says, of a format of FORMATS; None where it says none. Raises as `read_axes`."""
    _, lines, axes = _read_lines(path, kind)
    return axes or axes_in(lines)


def _read_lines(path: Path, kind: str) -> tuple[bool | None, Sequence[str], str | None]:
    """What a file says of antialiasing by its own means, its lines of text, and axes that it says by its own means."""
    if kind == "spz":
        return spz.read_metadata(path)
    if kind == "sog":
        return *sog.read_metadata(path), None
    if kind == "gltf":
        return None, gltf.read_lines(path), None
    if kind == "usd":
        return None, usd.read_lines(path), None
    if kind == "splat":
        return None, [], None
    return None, ply.read_header(path).comments, None
