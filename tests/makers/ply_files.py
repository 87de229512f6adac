"""Files in the .ply container, of whatever elements."""

import numpy as np

CODES = {"float": "f4", "double": "f8", "uchar": "u1", "char": "i1", "short": "i2", "ushort": "u2", "int": "i4"}
CODES |= {"uint": "u4", "float32": "f4", "float64": "f8", "uint8": "u1", "int16": "i2"}
ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}


class Element:
    """An element of a .ply: properties as (type, name), or (type of the length, type, name) for lists; and its rows."""

    def __init__(self, name, properties, rows):
        self.name, self.properties, self.rows = name, properties, rows

    def header(self):
        lines = [f"element {self.name} {len(self.rows)}"]
        return lines + [f"property {'list ' * (len(words) == 3)}{' '.join(words)}" for words in self.properties]

    def body(self, layout):
        """Bytes of the rows."""
        parts = []
        for row in self.rows:
            words = []
            for (*lengths, kind, _), value in zip(self.properties, row):
                values = value if lengths else [value]
                kinds = [*lengths, *[kind] * len(values)]
                words += [(k, v) for k, v in zip(kinds, [len(values)] * len(lengths) + list(values))]
            if layout == "ascii":
                parts.append(" ".join(repr(float(v) if CODES[k][0] == "f" else int(v)) for k, v in words) + "\n")
            else:
                parts += [np.array(value, ORDERS[layout] + CODES[kind]).tobytes() for kind, value in words]
        return "".join(parts).encode() if layout == "ascii" else b"".join(parts)


def ply(*elements, layout="binary_little_endian", lines=(), newline="\n", after=b""):
    """A .ply; `lines` come behind that of the format, as bytes or text."""
    header = ["ply", f"format {layout} 1.0", *lines]
    header += [line for element in elements for line in element.header()] + ["end_header", ""]
    text = newline.encode().join(line if isinstance(line, bytes) else line.encode() for line in header)
    return text + b"".join(element.body(layout) for element in elements) + after


def vertices(columns, rows, kind="float", more=()):
    """The vertices of a table: all of one type, and further properties with one value for all rows."""
    properties = [(kind, name) for name in columns] + [words for words, _ in more]
    return Element("vertex", properties, [[*row, *(value for _, value in more)] for row in rows.tolist()])


def write_points(path, rows, kind="float", colors=None):
    """A .ply in ASCII of rows of x, y, z, and where their type is given of red, green, blue."""
    columns = [(kind, axis) for axis in "xyz"] + [(colors, name) for name in ("red", "green", "blue") if colors]
    path.write_bytes(ply(Element("vertex", columns, rows), layout="ascii"))


CAMERA = Element("camera", [("float", "elevation"), ("float", "radius")], [[0.1, 0.2], [0.3, 0.4]])
FLAGS = Element("flags", [("uchar", "a"), ("short", "b")], [[1, -2], [3, -4], [5, -6]])
NOTHING = Element("nothing", [("double", "a")], [])
TRIANGLES = Element("face", [("uchar", "int", "vertex_indices"), ("uchar", "flag")], [[[0, 1, 2], 7], [[2, 3, 4], 8]])
POLYGONS = Element("face", [("uchar", "int", "vertex_index")], [[[0, 1, 2]], [[]], [[0, 1, 2, 3]]])
STRIPS = Element("strip", [("int", "a"), ("ushort", "float", "b"), ("uchar", "uchar", "c")], [[1, [0.5], [1, 2]]])
