"""The .ply container: the header of any file, and the rows of its elements as NumPy structured arrays.

A .ply begins with lines of text that name its elements (vertices, faces, whatever a program adds), how many rows each
has, and the type of every property. The rows follow in the order of the header: as text, or as numbers of either byte
order. A property may be a list, which says its own length in every row. The format was described by Greg Turk, "The PLY
Polygon File Format" (1994).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from .errors import SceneError, check_content, naming

# NumPy's codes of the types, which have two names each.
TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"), **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"), **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"), **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"), **dict.fromkeys(("double", "float64"), "f8"),
}  # fmt: skip
BYTE_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
HEADER_LIMIT = 1 << 20  # bytes; a file that never ends its header is not read whole
ROWS_AT_ONCE = 4096
MOST_DIGITS = 18  # of a number of rows, so that it is a sensible integer

_END = re.compile(rb"[\r\n][ \t]*end_header[ \t]*(\r\n|\n|\r|\Z)")
_NO_NUMBER = re.compile(rb"nan\([^\s()]*\)|1\.#(?:(INF)|IND|[QS]NAN)\d*", re.IGNORECASE)
"""How C on Windows, and others, write NaN and infinity."""


class Property(NamedTuple):
    """A column of an element. Types are words of the file, which `TYPES` may not know."""

    name: str
    kind: str
    length_kind: str | None = None  # of a list: the type of the number in front of its items


class Element(NamedTuple):
    name: str
    count: int  # rows
    properties: tuple[Property, ...]

    @property
    def names(self) -> list[str]:
        return [column.name for column in self.properties]


class Header(NamedTuple):
    layout: str  # one of BYTE_ORDERS
    elements: tuple[Element, ...]
    comments: tuple[str, ...]  # without the word "comment"; those of obj_info are left out
    size: int  # bytes, after which the rows begin

    def element(self, name: str) -> Element | None:
        """The element of this name, or None."""
        return next((element for element in self.elements if element.name == name), None)


def read_header(path) -> Header:
    """The header of a .ply. Raises SceneError, which names the file, where it is none, and OSError."""
    check_content(path)
    with Path(path).open("rb") as file:
        start = file.read(HEADER_LIMIT)
    with naming(path):
        return parse_header(start)


def parse_header(start: bytes) -> Header:
    """The header that these first bytes of a file hold. Raises SceneError, which says what is wrong with it.

    Lines may end as on any system. Text of comments that is not UTF-8 is replaced.
    """
    if not re.match(rb"(\xef\xbb\xbf)?ply[ \t]*(\r|\n|\Z)", start):  # editors put a byte order mark in front
        raise SceneError("not a PLY file: it does not begin with 'ply'")
    end = _END.search(start)
    if end is None:
        raise SceneError("the PLY header has no end_header")
    text = start[: end.start() + 1]
    size = end.end()
    if b"\n" not in text and end[1] == b"\r\n":
        size -= 1  # where all lines end with \r, this \n is the first byte of the rows
    layout, elements, comments = "none", [], []
    for line in re.split(r"\r\n|\r|\n", text.decode("utf-8", "replace")):
        words = line.split()
        if words[:1] == ["format"] and len(words) > 1:
            layout = words[1]
        elif words[:1] == ["comment"]:
            comments.append(line.strip()[len("comment") :].strip())
        elif words[:1] == ["element"]:
            elements.append(_element(words))
        elif words[:1] == ["property"]:
            if not elements:
                raise SceneError(f"expected an element in front of the line '{_shorten(line)}'")
            elements[-1] = elements[-1]._replace(properties=(*elements[-1].properties, _property(words)))
    if layout not in BYTE_ORDERS:
        raise SceneError(f"expected format {', '.join(BYTE_ORDERS)}, got {layout}")
    return Header(layout, tuple(elements), tuple(comments), size)


def _element(words: list[str]) -> Element:
    name = words[1] if len(words) > 1 else ""
    count = words[2] if len(words) > 2 else "none"
    if not re.fullmatch(f"[0-9]{{1,{MOST_DIGITS}}}", count):
        raise SceneError(f"expected a number of {_rows_of(name)}, got {_shorten(count)}")
    return Element(name, int(count), ())


def _rows_of(name: str) -> str:
    return "vertices" if name == "vertex" else f"rows of the element {name}"


def _property(words: list[str]) -> Property:
    is_list = words[1:2] == ["list"]
    if len(words) < (5 if is_list else 3):
        raise SceneError(f"expected the type and the name of a property, got '{_shorten(' '.join(words))}'")
    return Property(words[4], words[3], words[2]) if is_list else Property(words[2], words[1])


def _shorten(text: str) -> str:
    return text if len(text) <= 60 else f"{text[:57]}..."


class Rows:
    """The rows of one element, column by column.

    A property that the element has twice is there once, as what stands first; `column` refuses it. Lists are left out.
    """

    def __init__(self, element: Element, rows: np.ndarray):
        self.names = [column.name for column in element.properties if column.length_kind is None]
        self._rows = rows  # structured, with the field names of `_fields`

    def __len__(self) -> int:
        return len(self._rows)

    def column(self, name: str) -> np.ndarray:
        """The numbers of a property, (rows,), as they are in the file; fractions of a text are float64.

        Raises SceneError for a property that is not there, or twice.
        """
        number = self.names.count(name)
        if number != 1:
            raise SceneError(f"expected the property {name} once, got it {number} times")
        return self._rows[name]

    def columns(self, names: Sequence[str], dtype=None) -> np.ndarray:
        """Several properties as one array (rows, names), in the byte order of this machine.

        Without `dtype` the array has a type that holds all of the properties. Raises SceneError for a property that is
        not there, or twice.
        """
        kinds = [self.column(name).dtype for name in names]
        result = np.empty((len(self), len(names)), dtype or (np.result_type(*kinds) if kinds else np.float32))
        fields = self._rows.dtype.names
        places = [fields.index(name) for name in names]
        first = places[0] if places else 0
        beside = places == list(range(first, first + len(places)))
        alike = {self._rows.dtype[field] for field in fields}
        (kind,) = alike if len(alike) == 1 else (None,)
        together = kind is not None and self._rows.dtype.itemsize == len(fields) * kind.itemsize
        for start in range(0, len(self), ROWS_AT_ONCE):  # by parts that fit the processor's cache
            part = slice(start, start + ROWS_AT_ONCE)
            rows = self._rows[part]
            with np.errstate(over="ignore"):  # what float32 does not hold becomes infinite, which readers look for
                if together:
                    matrix = rows.view(kind).reshape(len(rows), len(fields))
                    result[part] = matrix[:, first : first + len(places)] if beside else matrix[:, places]
                else:
                    for i, name in enumerate(names):
                        result[part, i] = rows[name]
        return result


def read_rows(path, names: Sequence[str]) -> tuple[Header, dict[str, Rows]]:
    """The header of a .ply, and the rows of the elements with these names. Elements that the file lacks are left out.

    All other elements are skipped.

    Raises:
        SceneError: The file is no .ply, or it is cut short, or a number cannot be read. The message names the file.
        OSError: The file cannot be read.
    """
    check_content(path)
    content = Path(path).read_bytes()
    with naming(path):
        header = parse_header(content[:HEADER_LIMIT])
        wanted = [element.name for element in header.elements if element.name in names]
        reader = _Text(content, header) if header.layout == "ascii" else _Numbers(content, header)
        found: dict[str, Rows] = {}
        for element in header.elements:
            if len(found) == len(set(wanted)):
                break
            if element.name in names and element.name not in found:
                found[element.name] = Rows(element, reader.read(element))
            else:
                reader.skip(element)
    return header, found


def write(temporary: Path, element: str, columns: dict[str, np.ndarray], comments: Sequence[str] = ()) -> None:
    """Writes a .ply with one element, of float32 properties, for `write_safely`. Raises OSError.

    Args:
        temporary: The file to write.
        columns: The numbers of each property by its name, (rows,) each.
    """
    count = len(next(iter(columns.values())))
    lines = ["ply", "format binary_little_endian 1.0", *(f"comment {comment}" for comment in comments)]
    lines += [f"element {element} {count}", *(f"property float {name}" for name in columns), "end_header", ""]
    with temporary.open("wb") as file:
        file.write("\n".join(lines).encode())
        rows = np.empty((min(count, ROWS_AT_ONCE), len(columns)), "<f4")
        for start in range(0, count, ROWS_AT_ONCE):  # so that no copy of all rows is made
            part = rows[: count - start]
            for i, column in enumerate(columns.values()):
                part[:, i] = column[start : start + ROWS_AT_ONCE]
            file.write(part)


def with_comments(content: bytes, comments: Sequence[str]) -> bytes:
    """A .ply, whose lines end with \\n, with further comments behind the line of its format."""
    start = content.index(b"\n", content.index(b"format ")) + 1
    return content[:start] + "".join(f"comment {comment}\n" for comment in comments).encode() + content[start:]


def _unique_names(element: Element) -> list[str]:
    """Names of fields: those of the properties, and others for lists and where a name comes again."""
    names: list[str] = []
    for i, column in enumerate(element.properties):
        taken = column.name in names or column.length_kind is not None
        names.append(f"{column.name} {i}" if taken else column.name)
    return names


def _scalars(element: Element) -> list[tuple[str, Property]]:
    """The fields that are numbers, and their properties."""
    pairs = zip(_unique_names(element), element.properties)
    return [(name, column) for name, column in pairs if column.length_kind is None]


def _code(kind: str) -> str:
    """NumPy's code of a type, without a byte order."""
    if kind not in TYPES:
        raise SceneError(f"expected a type of PLY ({', '.join(TYPES)}), got {_shorten(kind)}")
    return TYPES[kind]


class _Text:
    """Rows as lines of words."""

    def __init__(self, content: bytes, header: Header):
        rows = _NO_NUMBER.sub(lambda found: b"inf" if found[1] else b"nan", content[header.size :])
        self.lines = [line for line in rows.splitlines() if line.strip()]
        self.next = 0

    def skip(self, element: Element) -> None:
        self.next += element.count if element.properties else 0

    def read(self, element: Element) -> np.ndarray:
        """The numbers of every line; further words are passed over."""
        scalars = _scalars(element)
        # Text may have more digits than the float32 of its header: they are kept.
        dtype = np.dtype([(name, _code(column.kind).replace("f4", "f8")) for name, column in scalars])
        lines = self.lines[self.next : self.next + element.count]
        self.skip(element)
        if scalars and len(lines) < element.count:
            raise SceneError(f"cut short: expected {element.count} {_rows_of(element.name)}, got {len(lines)}")
        if not scalars or not lines:
            return np.zeros(0, dtype)
        try:
            if len(scalars) < len(element.properties):
                lines = [_without_lists(line.split(), element) for line in lines]
            text = [line.decode("ascii") for line in lines]
            return np.loadtxt(text, dtype, comments=None, usecols=range(len(scalars)), ndmin=1)
        except (ValueError, OverflowError, IndexError) as error:  # too few words, or words that are no such numbers
            reason = str(error).partition("\n")[0]
            raise SceneError(f"expected {len(scalars)} numbers in every row ({reason})") from None


def _without_lists(words: list[bytes], element: Element) -> bytes:
    kept, at = [], 0
    for column in element.properties:
        if column.length_kind is None:
            kept.append(words[at])
            at += 1
        else:
            at += 1 + int(words[at])
    return b" ".join(kept)


class _Numbers:
    """Rows as numbers of a byte order, without gaps."""

    def __init__(self, content: bytes, header: Header):
        self.content, self.next = content, header.size
        self.order = BYTE_ORDERS[header.layout]

    def skip(self, element: Element) -> None:
        self.read(element)

    def read(self, element: Element) -> np.ndarray:
        scalars = np.dtype([(name, self.order + _code(column.kind)) for name, column in _scalars(element)])
        smallest = sum(np.dtype(_code(column.length_kind or column.kind)).itemsize for column in element.properties)
        left = len(self.content) - self.next
        if smallest * element.count > left:
            number = f"a number of {_rows_of(element.name)}"
            raise SceneError(f"cut short: expected {number} that fits {left} bytes, got {element.count}")
        if smallest == 0 or element.count == 0:
            return np.zeros(0, scalars)
        if len(scalars) == len(element.properties):
            rows = np.frombuffer(self.content, np.uint8, element.count * scalars.itemsize, self.next)
            self.next += len(rows)
            return rows.copy().view(scalars)  # where numbers are aligned: reading them takes a third of the time
        return self._read_lists(element, scalars)

    def _read_lists(self, element: Element, scalars: np.dtype) -> np.ndarray:
        """The numbers of rows that have lists too."""
        lengths, end = self._walk(element, self.next, [])
        # All lists of an element mostly have one length, as those of triangles do. Then rows have one size.
        fields: list[tuple] = []
        for i, (name, column) in enumerate(zip(_unique_names(element), element.properties)):
            kind = self.order + _code(column.kind)
            if column.length_kind is None:
                fields.append((name, kind))
            else:
                fields += [(f"{i} length", self.order + _code(column.length_kind)), (name, kind, (lengths[i],))]
        if (end - self.next) * element.count <= len(self.content) - self.next:
            rows = np.frombuffer(self.content, fields, element.count, self.next)
            if all((rows[f"{i} length"] == length).all() for i, length in lengths.items()):
                self.next += rows.nbytes
                return rows[list(scalars.names)]
        kept: list[bytes] = []
        for _ in range(element.count):
            _, self.next = self._walk(element, self.next, kept)
        return np.frombuffer(b"".join(kept), scalars) if scalars.names else np.zeros(0, scalars)

    def _walk(self, element: Element, at: int, kept: list[bytes]) -> tuple[dict[int, int], int]:
        """Lengths of the lists of the row at `at`, by property, and where it ends. Its numbers are added to `kept`."""
        lengths = {}
        for i, column in enumerate(element.properties):
            size = np.dtype(_code(column.kind)).itemsize
            if column.length_kind is None:
                kept.append(self.content[at : at + size])
                at += size
                continue
            kind = np.dtype(self.order + _code(column.length_kind))
            length = int.from_bytes(
                self.content[at : at + kind.itemsize], "big" if self.order == ">" else "little", signed=kind.kind == "i"
            )
            if kind.kind == "f" or length < 0:
                raise SceneError(f"expected lists of {_rows_of(element.name)} with whole lengths, got {length}")
            lengths[i] = length
            at += kind.itemsize + length * size
        if at > len(self.content):
            raise SceneError(f"cut short: the file ends in {_rows_of(element.name)}")
        return lengths, at
