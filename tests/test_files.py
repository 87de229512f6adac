"""Files: whatever writes a .ply, its vertices are read; every format says what it holds; writing loses nothing.

The tables are lists of files: the next case is a row.
"""

import gzip
import io as memory
import json
import math
import struct
import zipfile

import numpy as np
import pytest
import torch

from analytic_rasterizer import Gaussians, io

gsply = pytest.importorskip("gsply", reason="needs the cli extra")
image = pytest.importorskip("PIL.Image", reason="needs the cli extra")

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


SCENE_COLUMNS = [
    *("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", *(f"f_rest_{i}" for i in range(9)), "opacity"),
    *("scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
]
POINT_COLUMNS = ["x", "y", "z", "red", "green", "blue"]


def table(columns, count=5):
    rows = np.random.default_rng(7).uniform(0.1, 0.9, (count, len(columns))).astype(np.float32)
    rows[0, 0] = struct.unpack("<f", b"\n\r\n\x41")[0]  # bytes that a reader of lines may trip over
    return rows


CAMERA = Element("camera", [("float", "elevation"), ("float", "radius")], [[0.1, 0.2], [0.3, 0.4]])
FLAGS = Element("flags", [("uchar", "a"), ("short", "b")], [[1, -2], [3, -4], [5, -6]])
NOTHING = Element("nothing", [("double", "a")], [])
TRIANGLES = Element("face", [("uchar", "int", "vertex_indices"), ("uchar", "flag")], [[[0, 1, 2], 7], [[2, 3, 4], 8]])
POLYGONS = Element("face", [("uchar", "int", "vertex_index")], [[[0, 1, 2]], [[]], [[0, 1, 2, 3]]])
STRIPS = Element("strip", [("int", "a"), ("ushort", "float", "b"), ("uchar", "uchar", "c")], [[1, [0.5], [1, 2]]])
BESIDE = [(("uchar", "red8"), 200), (("int", "id"), -5), (("double", "time"), 1e300)]
LISTS = [(("uchar", "float", "weights"), [0.25, 0.5])]

FILES = {
    "nothing else": lambda c, r: ply(vertices(c, r)),
    "floats behind": lambda c, r: ply(vertices(c, r), CAMERA),
    "floats before": lambda c, r: ply(CAMERA, vertices(c, r)),
    "small numbers before": lambda c, r: ply(FLAGS, vertices(c, r), CAMERA),
    "an empty element before": lambda c, r: ply(NOTHING, vertices(c, r)),
    "an element without properties": lambda c, r: ply(Element("x", [], [[]] * 3), vertices(c, r)),
    "triangles before": lambda c, r: ply(TRIANGLES, vertices(c, r)),
    "triangles behind": lambda c, r: ply(vertices(c, r), TRIANGLES),
    "polygons before": lambda c, r: ply(POLYGONS, vertices(c, r)),
    "several lists before": lambda c, r: ply(STRIPS, TRIANGLES, vertices(c, r)),
    "lists of the vertices": lambda c, r: ply(vertices(c, r, more=LISTS), TRIANGLES),
    "big endian": lambda c, r: ply(vertices(c, r), layout="binary_big_endian"),
    "big endian, polygons before": lambda c, r: ply(FLAGS, POLYGONS, vertices(c, r), layout="binary_big_endian"),
    "text": lambda c, r: ply(vertices(c, r), layout="ascii"),
    "text, others before": lambda c, r: ply(POLYGONS, NOTHING, CAMERA, vertices(c, r), FLAGS, layout="ascii"),
    "text, others beside": lambda c, r: ply(vertices(c, r, more=[*LISTS, *BESIDE]), layout="ascii"),
    "text without its last line end": lambda c, r: ply(vertices(c, r), layout="ascii")[:-1],
    "text with empty lines": lambda c, r: ply(vertices(c, r), layout="ascii").replace(b"\n0.", b"\n \n\n0."),
    "text with other line ends": lambda c, r: ply(vertices(c, r), layout="ascii").replace(b"\n", b"\r\n"),
    "text with old line ends": lambda c, r: ply(vertices(c, r), layout="ascii").replace(b"\n", b"\r"),
    "double": lambda c, r: ply(vertices(c, r, "double")),
    "float32": lambda c, r: ply(vertices(c, r, "float32")),
    "float64, big endian": lambda c, r: ply(vertices(c, r, "float64"), layout="binary_big_endian"),
    "others beside": lambda c, r: ply(vertices(c, r, more=BESIDE)),
    "normals": lambda c, r: ply(vertices(c, r, more=[(("float", f"n{axis}"), 0) for axis in "xyz"])),
    "a property twice that nobody needs": lambda c, r: ply(vertices(c, r, more=[(("float", "nx"), 0)] * 2)),
    "in another order": lambda c, r: ply(vertices(c[::-1], r[:, ::-1])),
    "comments": lambda c, r: ply(vertices(c, r), lines=["comment element vertex 99", "obj_info element a 3"]),
    "comments in UTF-8": lambda c, r: ply(vertices(c, r), lines=["comment größe \u2028 \x85 \x0b 中文", "obj_info ü"]),
    "comments in Latin-1": lambda c, r: ply(vertices(c, r), lines=["comment größe \x85".encode("latin-1")]),
    "a comment with end_header": lambda c, r: ply(vertices(c, r), lines=["comment end_header", "comment"]),
    "a long comment": lambda c, r: ply(vertices(c, r), lines=["comment " + "element vertex 1 " * 5000]),
    "many comments": lambda c, r: ply(vertices(c, r), lines=["comment a"] * 3000),
    "other line ends": lambda c, r: ply(vertices(c, r), newline="\r\n"),
    "old line ends": lambda c, r: ply(vertices(c, r), newline="\r"),
    "only end_header with another line end": lambda c, r: ply(vertices(c, r)).replace(b"end_header\n", b"end_header\r\n"),
    "spaces": lambda c, r: ply(vertices(c, r)).replace(b"property float x", b"  property   float\tx  "),
    "bytes behind": lambda c, r: ply(vertices(c, r), after=b"\0" * 9),
}  # fmt: skip


@pytest.mark.parametrize("name", FILES)
def test_scenes_whatever_the_file(tmp_path, name):
    rows = table(SCENE_COLUMNS)
    path = tmp_path / "Scene.PLY"
    path.write_bytes(FILES[name](SCENE_COLUMNS, rows))
    assert io.is_scene(path)
    scene = io.load_scene(path, strict=True)
    column = dict(zip(SCENE_COLUMNS, torch.from_numpy(rows.T.copy())))
    expected = Gaussians(
        torch.stack([column[axis] for axis in "xyz"], 1),
        torch.stack([column[f"scale_{i}"] for i in range(3)], 1),
        torch.stack([column[f"rot_{i}"] for i in range(4)], 1),
        column["opacity"][:, None],
        torch.stack(
            [
                torch.stack([column[f"f_dc_{channel}"], *(column[f"f_rest_{3 * channel + i}"] for i in range(3))], 1)
                for channel in range(3)
            ],
            2,
        ),
    )
    for found, wanted in zip(scene, expected):
        assert found.dtype == torch.float32 and found.is_contiguous()
        assert torch.equal(found, wanted)


@pytest.mark.parametrize("name", FILES)
def test_points_whatever_the_file(tmp_path, name):
    rows = table(POINT_COLUMNS)
    path = tmp_path / "points.ply"
    path.write_bytes(FILES[name](POINT_COLUMNS, rows))
    assert not io.is_scene(path)
    points, colors = io.load_points(path, strict=True)
    assert points.dtype == torch.float64 and colors.dtype == torch.float32
    assert torch.equal(points, torch.from_numpy(rows[:, :3]).double())
    assert torch.equal(colors, torch.from_numpy(rows[:, 3:].copy()))


def test_a_scene_in_every_number_type(tmp_path):
    """Each column is of another type, and so is what stands between them."""
    kinds = ["float", "double", "short", "uchar", "char", "ushort", "int", "uint"]
    properties = [(kinds[i % len(kinds)], name) for i, name in enumerate(SCENE_COLUMNS)]
    rows = [[i + j for j in range(len(properties))] for i in range(3)]
    for layout in (*ORDERS, "ascii"):
        (tmp_path / "a.ply").write_bytes(ply(Element("vertex", properties, rows), layout=layout))
        scene = io.load_scene(tmp_path / "a.ply")
        assert scene.means.tolist() == [[i, i + 1, i + 2] for i in range(3)]
        assert scene.rotations.tolist() == [[i + j for j in range(19, 23)] for i in range(3)]


@pytest.mark.parametrize("layout", [*ORDERS, "ascii"])
def test_positions_far_from_zero_keep_their_digits(tmp_path, layout):
    """float32 has steps of a quarter there; text may have more digits than the float of its header."""
    far = np.array([[500000.123456, 4200000.654321, 0.5], [500001.25, 4200001.75, 1.5]])
    kind = "float" if layout == "ascii" else "double"
    (tmp_path / "a.ply").write_bytes(ply(vertices(["x", "y", "z"], far, kind), layout=layout))
    points, colors = io.load_points(tmp_path / "a.ply")
    assert points.tolist() == far.tolist() and (colors == 0.5).all()
    rows = table(SCENE_COLUMNS, 2).astype(np.float64)
    rows[:, :3] = far
    rows[:, SCENE_COLUMNS.index("scale_0") :][:, :3] = -5  # sizes of 7 mm
    (tmp_path / "a.ply").write_bytes(ply(vertices(SCENE_COLUMNS, rows, kind), layout=layout))
    with pytest.warns(
        UserWarning, match=r"a\.ply: float32 moves \d of 2 Gaussians, by up to 0\.1.*: subtract an offset"
    ):
        scene = io.load_scene(tmp_path / "a.ply")
    assert torch.equal(scene.means, torch.tensor(far, dtype=torch.float32))


@pytest.mark.parametrize(
    "kind, whole", [("uchar", 255), ("ushort", 65535), ("float", 1), ("float", 255), ("double", 1)]
)
@pytest.mark.parametrize("layout", [*ORDERS, "ascii"])
def test_colours_of_a_scene_without_harmonics(tmp_path, kind, whole, layout):
    colors = [[whole, 0, whole], [0, whole, 0]]
    shape = [name for name in SCENE_COLUMNS if not name.startswith("f_")]
    properties = [("float", name) for name in shape] + [(kind, name) for name in ("red", "green", "blue")]
    rows = [[*table(shape)[i].tolist(), *color] for i, color in enumerate(colors)]
    (tmp_path / "a.ply").write_bytes(ply(Element("vertex", properties, rows), layout=layout))
    scene = io.load_scene(tmp_path / "a.ply")
    assert io.is_scene(tmp_path / "a.ply") and scene.sh_degree == 0
    shown = 0.5 + 0.28209479177387814 * scene.shs[:, 0]
    torch.testing.assert_close(shown, torch.tensor(colors) / whole, rtol=0, atol=1e-6)


def test_harmonics_go_before_colours(tmp_path):
    rows = table(SCENE_COLUMNS)
    colors = [((kind, name), 255) for kind, name in zip(["uchar"] * 3, ("red", "green", "blue"))]
    (tmp_path / "a.ply").write_bytes(ply(vertices(SCENE_COLUMNS, rows, more=colors)))
    assert torch.equal(io.load_scene(tmp_path / "a.ply").shs[:, 0], torch.from_numpy(rows[:, 3:6]))


@pytest.mark.parametrize("degree", range(5))
@pytest.mark.parametrize("end", ["end_header", "end_header\n", "end_header\r\n"])
def test_files_without_vertices(tmp_path, degree, end):
    names = [*SCENE_COLUMNS[:6], *(f"f_rest_{i}" for i in range(3 * ((degree + 1) ** 2 - 1))), *SCENE_COLUMNS[15:]]
    content = ply(vertices(names, np.zeros((0, len(names)), np.float32))).replace(b"end_header\n", end.encode())
    (tmp_path / "a.ply").write_bytes(content)
    scene = io.load_scene(tmp_path / "a.ply")
    assert (scene.count, scene.sh_degree) == (0, degree)
    assert io.load_points(tmp_path / "a.ply")[0].shape == (0, 3)


SCENE = vertices(SCENE_COLUMNS, table(SCENE_COLUMNS))
REFUSED = {
    "nothing": (b"", "does not begin with 'ply'"),
    "another file": (b"plyx\n", "does not begin with 'ply'"),
    "no end": (ply(SCENE).partition(b"end_header")[0], "no end_header"),
    "an endless header": (b"ply\n" + b"comment a\n" * 200_000, "no end_header"),
    "no format": (ply(SCENE).replace(b"format binary_little_endian 1.0\n", b""), "expected format ascii, .*, got none"),
    "another format": (ply(SCENE).replace(b"_little_", b"_middle_"), "got binary_middle_endian"),
    "no vertices": (ply(CAMERA), "expected vertices, but the .ply has none"),
    "one byte too few": (ply(SCENE)[:-1], r"expected a number of vertices that fits \d+ bytes, got 5"),
    "one line too few": (ply(SCENE, layout="ascii").rsplit(b"\n", 2)[0], "cut short: expected 5 vertices, got 4"),
    "one word too few": (ply(SCENE, layout="ascii").rsplit(b" ", 1)[0], "expected 23 numbers in every row"),
    "no number": (ply(SCENE, layout="ascii").replace(b"\n0.", b"\nfour 0."), "expected 23 numbers in every row"),
    "too large a number": (
        ply(vertices(SCENE_COLUMNS, table(SCENE_COLUMNS), more=[(("uchar", "c"), 255)]), layout="ascii").replace(b" 255\n", b" 256\n"),
        "expected 24 numbers in every row",
    ),
    "a huge number of vertices": (ply(SCENE).replace(b"vertex 5", b"vertex 4000000000"), "that fits .* got 4000000000"),
    "a number that is none": (ply(SCENE).replace(b"vertex 5", b"vertex many"), "expected a number of vertices, got many"),
    "a negative number": (ply(SCENE).replace(b"vertex 5", b"vertex -5"), "expected a number of vertices, got -5"),
    "no number at all": (ply(SCENE).replace(b"vertex 5", b"vertex"), "expected a number of vertices, got none"),
    "endless digits": (ply(SCENE).replace(b"vertex 5", b"vertex " + b"9" * 6000), "expected a number of vertices, got 999"),
    "huge lists before": (
        ply(TRIANGLES, SCENE).replace(b"list uchar", b"list uint"),
        "cut short: the file ends in rows of the element face",
    ),
    "negative lists before": (
        ply(Element("a", [("char", "float", "b")], [[[]]]), SCENE).replace(b"end_header\n\0", b"end_header\n\xff"),
        "expected lists of rows of the element a with whole lengths, got -1",
    ),
    "a huge element before": (ply(CAMERA, SCENE).replace(b"camera 2", b"camera 99999999"), "rows of the element camera"),
    "an unknown type": (ply(SCENE).replace(b"property float x", b"property half x"), "expected a type of PLY .*got half"),
    "an unknown type before": (ply(CAMERA, SCENE).replace(b"float radius", b"half radius"), "got half"),
    "a property without a name": (ply(SCENE).replace(b"float x", b"float"), "type and the name of a property"),
    "a property of nothing": (ply(SCENE, lines=["property float a"]), "expected an element in front of"),
    "x twice": (ply(SCENE).replace(b"float f_dc_0", b"float x"), "missing vertex properties f_dc_0|x once"),
    "opacity twice": (
        ply(vertices([*SCENE_COLUMNS, "opacity"], table([*SCENE_COLUMNS, "opacity"]))),
        "expected the property opacity once, got it 2 times",
    ),
    "points": (ply(vertices(["x", "y", "z"], table(["x", "y", "z"]))), "missing vertex properties f_dc_0, .*rot_3"),
    "surfels": (ply(vertices(["x"], table(["x"]))), "missing vertex properties y, z"),
    "too few harmonics": (ply(vertices(SCENE_COLUMNS[:-8][:-2] + SCENE_COLUMNS[-8:], table(SCENE_COLUMNS)[:, :-2])), "got 7"),
    "harmonics with a gap": (ply(SCENE).replace(b"f_rest_8", b"f_rest_9"), "expected the property f_rest_8 once"),
    "colours out of range": (
        ply(vertices([*(n for n in SCENE_COLUMNS if n[0] != "f"), "red", "green", "blue"], 300 * table(range(17)))),
        "expected colours from 0 to 255, got ",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_files_that_are_no_scene(tmp_path, name):
    content, message = REFUSED[name]
    (tmp_path / "a.ply").write_bytes(content)
    with pytest.raises(io.SceneError, match=message) as caught:
        io.load_scene(tmp_path / "a.ply")
    assert str(caught.value).startswith(f"{tmp_path / 'a.ply'}: ") and "\n" not in str(caught.value)
    assert len(str(caught.value)) < 500


@pytest.mark.parametrize("name", [name for name in REFUSED if name not in ("opacity twice", "points")])
def test_files_that_hold_no_points(tmp_path, name):
    """All that cannot be read as a scene for the sake of its container cannot be read as points either."""
    content, message = REFUSED[name]
    if "missing" in message or "f_rest" in message or "colours" in message or "got 7" in message:
        pytest.skip("about Gaussians")
    (tmp_path / "a.ply").write_bytes(content)
    with pytest.raises(io.SceneError, match=message) as caught:
        io.load_points(tmp_path / "a.ply")
    assert str(caught.value).startswith(f"{tmp_path / 'a.ply'}: ")


# -------------------------------------------------------------------- numbers that are not finite


@pytest.mark.parametrize("layout", [*ORDERS, "ascii"])
@pytest.mark.parametrize(
    "column, value, named",
    [
        ("y", math.nan, "means"),
        ("z", math.inf, "means"),
        ("scale_1", math.nan, "scales"),
        ("scale_1", 1000.0, "scales"),
        ("rot_2", -math.inf, "rotations"),
        ("opacity", math.nan, "opacities"),
        ("f_dc_0", math.nan, "shs"),
        ("f_rest_8", math.nan, "shs"),
    ],
)
def test_gaussians_that_are_not_finite_are_left_out(tmp_path, layout, column, value, named):
    rows = table(SCENE_COLUMNS)
    (tmp_path / "a.ply").write_bytes(ply(vertices(SCENE_COLUMNS, rows), layout=layout))
    whole = io.load_scene(tmp_path / "a.ply")
    rows[[1, 3], SCENE_COLUMNS.index(column)] = value
    (tmp_path / "a.ply").write_bytes(ply(vertices(SCENE_COLUMNS, rows), layout=layout))
    with pytest.warns(UserWarning, match=rf"a\.ply: 2 of 5 Gaussians are left out: {named} of 2 are not finite"):
        scene = io.load_scene(tmp_path / "a.ply")
    for found, wanted in zip(scene, whole):
        assert torch.equal(found, wanted[[0, 2, 4]])
    with pytest.raises(io.SceneError, match=rf"a\.ply: {named} must be finite, got 2 of 5 rows not"):
        io.load_scene(tmp_path / "a.ply", strict=True)
    rows[:, SCENE_COLUMNS.index(column)] = value
    (tmp_path / "a.ply").write_bytes(ply(vertices(SCENE_COLUMNS, rows), layout=layout))
    with pytest.raises(io.SceneError, match=f"{named} must be finite, got 5 of 5 rows not"):
        io.load_scene(tmp_path / "a.ply")


@pytest.mark.parametrize("column", ["x", "green"])
def test_points_that_are_not_finite_are_left_out(tmp_path, column):
    rows = table(POINT_COLUMNS)
    rows[[0, 2], POINT_COLUMNS.index(column)] = [math.nan, math.inf]
    (tmp_path / "a.ply").write_bytes(ply(vertices(POINT_COLUMNS, rows)))
    with pytest.warns(UserWarning, match=r"a\.ply: 2 of 5 points are left out: their numbers are not finite"):
        points, colors = io.load_points(tmp_path / "a.ply")
    assert torch.equal(points, torch.from_numpy(rows[[1, 3, 4], :3]).double())
    assert torch.equal(colors, torch.from_numpy(rows[[1, 3, 4], 3:]))
    with pytest.raises(io.SceneError, match=r"a\.ply: expected (5 finite points, got 3|colours from 0 to 255)"):
        io.load_points(tmp_path / "a.ply", strict=True)


# ------------------------------------------------------------------------------- other formats


def random_scene(count=40, degree=3):
    g = torch.Generator().manual_seed(3)

    def normal(*size):
        return torch.randn(*size, generator=g)

    rotations = torch.nn.functional.normalize(normal(count, 4), dim=1)
    shs = 0.2 * normal(count, (degree + 1) ** 2, 3)
    return Gaussians(normal(count, 3), 0.5 * normal(count, 3) - 3, rotations, 2 * normal(count, 1), shs)


def close(found, wanted):
    """Whether scenes agree as far as 8 bits a number allow."""
    assert found.count == wanted.count and found.sh_degree == wanted.sh_degree
    assert (found.means - wanted.means).abs().max() < 5e-3
    assert (found.log_scales - wanted.log_scales).abs().max() < 0.04
    assert (found.opacities - wanted.opacities).abs().max() < 3e-3
    turned = torch.nn.functional.normalize(found.rotations, dim=1) * torch.nn.functional.normalize(
        wanted.rotations, dim=1
    )
    assert (1 - turned.sum(1).abs()).max() < 1e-4
    assert (found.shs - wanted.shs).abs().max() < 0.04


def test_a_ply_comes_back_to_the_bit(tmp_path):
    """Parameters as they are: quaternions of any length, large logits, scales of 0."""
    scene = random_scene()
    scene = scene._replace(rotations=3 * scene.rotations, logit_opacities=20 * scene.logit_opacities)
    scene.log_scales[0, 1] = -math.inf
    scene.rotations[1] = 0
    scene.means[2] = torch.tensor([-0.0, 1e-42, 3e38])
    scene.shs[3] = torch.nextafter(torch.tensor(1.0), torch.tensor(2.0))
    for again in (1, 2):
        io.save_scene(tmp_path / f"{again}.ply", scene)
        found = io.load_scene(tmp_path / f"{again}.ply", strict=True)
        for field, wanted in zip(found, scene):
            assert field.numpy().tobytes() == wanted.contiguous().numpy().tobytes()
    assert (tmp_path / "1.ply").read_bytes() == (tmp_path / "2.ply").read_bytes()
    scene.logit_opacities[:2, 0] = torch.tensor([math.inf, -math.inf])  # other programs make NaN of them
    io.save_scene(tmp_path / "a.ply", scene)
    kept = io.load_scene(tmp_path / "a.ply").logit_opacities[:2, 0]
    torch.testing.assert_close(kept, torch.tensor([13.8155, -13.8155]), rtol=0, atol=1e-4)


@pytest.mark.parametrize("name", ["a.compressed.ply", "a.spz", "a.splat"])
def test_scales_of_zero_and_zero_quaternions_spoil_nothing(tmp_path, name):
    """In a compressed .ply a logarithm of -inf made NaN of the scales of 256 Gaussians."""
    scene = random_scene(degree=0)
    scene.log_scales[0, 1] = -math.inf
    scene.rotations[1] = 0
    io.save_scene(tmp_path / name, scene)
    found = io.load_scene(tmp_path / name, strict=True)
    assert found.scales[0, 1] < 1e-4
    assert found.rotations[1, 0] > 0.99 and found.rotations[1, 1:].abs().max() < 1e-2
    rest = torch.arange(scene.count) > 1
    assert (found.scales - scene.scales)[rest].abs().max() < 0.05


def test_a_splat_by_hand(tmp_path):
    """32 bytes: position, scales, colour with opacity, quaternion."""
    row = struct.pack("<6f8B", 1, -2, 3, 0.5, 0.25, 0.125, 255, 0, 51, 204, 128, 0, 192, 128)
    (tmp_path / "a.SPLAT").write_bytes(3 * row)
    scene = io.load_scene(tmp_path / "a.SPLAT")
    assert (scene.count, scene.sh_degree) == (3, 0)
    assert scene.means[0].tolist() == [1, -2, 3]
    torch.testing.assert_close(scene.scales[1], torch.tensor([0.5, 0.25, 0.125]))
    assert scene.rotations[2].tolist() == [0, -1, 0.5, 0]
    torch.testing.assert_close(scene.opacities[0], torch.tensor([0.8]))
    torch.testing.assert_close(0.5 + 0.28209479177387814 * scene.shs[0, 0], torch.tensor([1.0, 0.0, 0.2]))
    io.save_scene(tmp_path / "b.splat", scene)
    assert (tmp_path / "b.splat").stat().st_size == 96
    assert (tmp_path / "b.splat").read_bytes()[:28] == row[:28]
    again = io.load_scene(tmp_path / "b.splat")
    turned = torch.nn.functional.normalize(again.rotations, dim=1) * torch.nn.functional.normalize(
        scene.rotations, dim=1
    )
    assert (turned.sum(1) > 1 - 1e-4).all()
    (tmp_path / "a.splat").write_bytes(3 * row + b"1")
    with pytest.raises(io.SceneError, match=r"a\.splat: cut short: expected a multiple of 32 bytes, got 97"):
        io.load_scene(tmp_path / "a.splat")
    broken = struct.pack("<6f8B", math.nan, -2, 3, 0.5, -0.25, 0.125, *[128] * 8)
    (tmp_path / "a.splat").write_bytes(row + broken)
    with pytest.warns(UserWarning, match="1 of 2 Gaussians are left out: means of 1, scales of 1 are not finite"):
        assert io.load_scene(tmp_path / "a.splat").count == 1


def test_a_splat_round_trip(tmp_path):
    scene = random_scene(degree=0)
    io.save_scene(tmp_path / "a.splat", scene)
    close(io.load_scene(tmp_path / "a.splat"), scene)
    scene.shs[:2, 0] = torch.tensor([[9.0], [-9.0]])  # clamped, and not wrapped around
    scene.logit_opacities[:2, 0] = torch.tensor([math.inf, -math.inf])
    io.save_scene(tmp_path / "a.splat", scene)
    rgba = np.frombuffer((tmp_path / "a.splat").read_bytes(), "u1").reshape(-1, 32)[:2, 24:28]
    assert rgba.tolist() == [[255] * 4, [0] * 4]
    assert io.load_scene(tmp_path / "a.splat").logit_opacities.isfinite().all()


def spz_parts(scene):
    """The parts of an .spz, by the description of the format: 24, 8, 8, 8, 10 and 8 bits a number."""
    fixed = np.rint(scene.means.numpy().astype(np.float64) * 4096).astype("<i4")
    positions = fixed.reshape(-1, 3, 1).view("u1").reshape(-1, 3, 4)[:, :, :3]
    byte = lambda values: np.rint(values.numpy()).clip(0, 255).astype("u1")  # noqa: E731
    turned = torch.nn.functional.normalize(scene.rotations, dim=1)[:, [1, 2, 3, 0]].numpy()
    packed = []
    for q in turned:
        largest = int(np.abs(q).argmax())
        word = largest
        for i in range(4):
            if i != largest:
                value = q[i] * np.sign(q[largest])
                word = word << 10 | int(value < 0) << 9 | round(511 * abs(float(value)) * math.sqrt(2))
        packed.append(word)
    return [
        positions.tobytes(),
        byte(255 * scene.opacities).tobytes(),
        byte(38.25 * scene.shs[:, 0] + 127.5).tobytes(),
        byte(16 * (scene.log_scales + 10)).tobytes(),
        np.array(packed, "<u4").tobytes(),
        byte(128 * scene.shs[:, 1:] + 128).tobytes(),
    ]


def spz_file(scene, version, flags=0, records=b""):
    """An .spz with these flags and records of extensions."""
    header = struct.pack("<4sIIBBB", b"NGSP", version, scene.count, scene.sh_degree, 12, flags)
    parts = [part for part in spz_parts(scene) if part]
    if version < 4:
        return gzip.compress(header + b"\0" + b"".join(parts) + records)
    zstandard = pytest.importorskip("zstandard", reason="needs the cli extra")
    compressed = [zstandard.ZstdCompressor().compress(part) for part in parts]
    header += struct.pack("<BI12x", len(parts), 32 + len(records))
    sizes = b"".join(struct.pack("<QQ", len(small), len(part)) for small, part in zip(compressed, parts))
    return header + records + sizes + b"".join(compressed)


def record(kind, content):
    return struct.pack("<II", kind, len(content)) + content


OURS = record(0x41520001, b"analytic_rasterizer footprint moment:samples=9\nanalytic_rasterizer offset 1.5 -2.0 3.0")


@pytest.mark.parametrize("version", [3, 4])
@pytest.mark.parametrize("degree", [0, 1, 3])
@pytest.mark.parametrize("flags, records", [(0, b""), (1, b""), (3, record(0xADBE0002, b"\1" * 12) + OURS)])
def test_an_spz_by_hand(tmp_path, version, degree, flags, records):
    scene = random_scene(degree=degree)
    (tmp_path / "a.Spz").write_bytes(spz_file(scene, version, flags, records))
    close(io.load_scene(tmp_path / "a.Spz"), scene)
    metadata = io.read_metadata(tmp_path / "a.Spz")
    assert metadata.antialiased is bool(flags & 1)
    assert metadata.footprint == ("moment:samples=9" if records else None)
    assert metadata.offset == ((1.5, -2.0, 3.0) if records else None)


@pytest.mark.parametrize("version", [3, 4])
def test_a_broken_spz(tmp_path, version):
    whole = spz_file(random_scene(), version)
    (tmp_path / "a.spz").write_bytes(whole)
    io.load_scene(tmp_path / "a.spz")
    for size in (0, 3, 10, 20, 33, 60, len(whole) // 2, len(whole) - 1):
        (tmp_path / "a.spz").write_bytes(whole[:size])
        with pytest.raises(io.SceneError, match=r"a\.spz: unreadable or cut short \("):
            io.load_scene(tmp_path / "a.spz")
        if size < 16:
            with pytest.raises(io.SceneError, match=r"a\.spz: "):
                io.read_metadata(tmp_path / "a.spz")
    if version == 4:
        (tmp_path / "a.spz").write_bytes(whole[:100] + bytes(byte ^ 0x55 for byte in whole[100:]))
        with pytest.raises(io.SceneError, match=r"a\.spz: unreadable or cut short \("):
            io.load_scene(tmp_path / "a.spz")


def test_a_library_that_is_missing_is_named_with_its_extra(tmp_path, monkeypatch):
    (tmp_path / "a.spz").write_bytes(spz_file(random_scene(degree=0), 4))
    (tmp_path / "a.sog").write_bytes(sog_file(random_scene(degree=0)))
    for module, name in (("zstandard", "a.spz"), ("imagecodecs", "a.sog")):
        monkeypatch.setitem(__import__("sys").modules, module, None)
        with pytest.raises(ImportError, match=rf"{module}: pip install analytic_rasterizer\[cli\]"):
            io.load_scene(tmp_path / name)


def webp(pixels):
    """A lossless picture of (H, W, C) bytes."""
    file = memory.BytesIO()
    image.fromarray(pixels).save(file, "WEBP", lossless=True, exact=True)
    return file.getvalue()


def sog_file(scene, **meta):
    """A .sog of version 2, by its specification: pictures of one row, codebooks of 256 numbers."""
    count, files = scene.count, {}
    logs = (scene.means.sign() * scene.means.abs().log1p()).numpy().astype(np.float64)
    low, high = logs.min(0), logs.max(0)
    means = np.rint((logs - low) / (high - low) * 65535).astype(np.uint16)[None]

    def coded(values):
        book = np.linspace(values.min(), values.max(), 256)
        return book, np.rint((values - book[0]) / (book[-1] - book[0]) * 255).astype(np.uint8)

    scale_book, scales = coded(scene.log_scales.numpy())
    color_book, colors = coded(scene.shs[:, 0].numpy())
    quats = np.zeros((1, count, 4), np.uint8)
    for i, q in enumerate(torch.nn.functional.normalize(scene.rotations, dim=1).numpy()):
        largest = int(np.abs(q).argmax())
        rest = np.delete(q * np.sign(q[largest]), largest)
        quats[0, i] = [*np.rint((rest * math.sqrt(2) + 1) / 2 * 255), 252 + largest]
    alpha = np.rint(255 * scene.opacities.numpy()).astype(np.uint8)
    files["means_l.webp"], files["means_u.webp"] = ((means & 255).astype(np.uint8), (means >> 8).astype(np.uint8))
    files["scales.webp"], files["quats.webp"] = scales[None], quats
    files["sh0.webp"] = np.concatenate([colors, alpha], 1)[None]
    content = {
        "version": 2,
        "count": count,
        "means": {"mins": low.tolist(), "maxs": high.tolist(), "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": scale_book.tolist(), "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": color_book.tolist(), "files": ["sh0.webp"]},
    }
    if scene.sh_degree:  # every Gaussian has a centroid of its own
        rest = scene.shs[:, 1:].numpy()
        book, labels = coded(rest)
        bands = rest.shape[1]
        centroids = np.zeros((-(-count // 64), 64 * bands, 3), np.uint8)
        for i in range(count):
            centroids[i // 64, i % 64 * bands : (i % 64 + 1) * bands] = labels[i]
        files["shN_centroids.webp"] = centroids
        index = np.arange(count)
        files["shN_labels.webp"] = np.stack([index & 255, index >> 8, 0 * index], 1).astype(np.uint8)[None]
        content["shN"] = {"count": count, "bands": scene.sh_degree, "codebook": book.tolist()}
        content["shN"]["files"] = ["shN_centroids.webp", "shN_labels.webp"]
    archive = memory.BytesIO()
    with zipfile.ZipFile(archive, "w") as file:
        file.writestr("meta.json", json.dumps(content | meta))
        for name, pixels in files.items():
            file.writestr(name, webp(pixels))
    return archive.getvalue()


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_a_sog_by_hand(tmp_path, degree):
    pytest.importorskip("imagecodecs", reason="needs the cli extra")
    scene = random_scene(count=80, degree=degree)
    (tmp_path / "a.SOG").write_bytes(sog_file(scene))
    close(io.load_scene(tmp_path / "a.SOG"), scene)


@pytest.mark.parametrize(
    "meta, antialiased",
    [({}, None), ({"antialias": True}, True), ({"antialias": False}, False), ({"model": "antialiased"}, True),
     ({"model": "2dgs"}, False), ({"antialias": "?"}, None)],
)  # fmt: skip
def test_the_tag_of_a_sog(tmp_path, meta, antialiased):
    (tmp_path / "a.sog").write_bytes(sog_file(random_scene(degree=0), **meta))
    assert io.read_metadata(tmp_path / "a.sog") == io.SceneMetadata(antialiased=antialiased)


@pytest.mark.parametrize(
    "meta",
    [{"version": 3}, {"count": 10**9}, {"count": "many"}, {"scales": {"codebook": [0.5]}}, {"sh0": 3}, {"means": {}}],
)
def test_a_broken_sog(tmp_path, meta):
    pytest.importorskip("imagecodecs", reason="needs the cli extra")
    (tmp_path / "a.sog").write_bytes(sog_file(random_scene(degree=0), **meta))
    with pytest.raises(io.SceneError, match=r"a\.sog: (unreadable or cut short|meta\.json: expected)"):
        io.load_scene(tmp_path / "a.sog")
    for content in (b"", b"no archive", sog_file(random_scene(degree=0))[:-30]):
        (tmp_path / "a.sog").write_bytes(content)
        for read in (io.load_scene, io.read_metadata):
            with pytest.raises(io.SceneError, match=r"a\.sog: unreadable or cut short"):
                read(tmp_path / "a.sog")


def rearranged(path, change):
    """A compressed .ply as `change` makes it of its elements."""
    from analytic_rasterizer.io.ply import TYPES, read_header, read_rows

    header = read_header(path)
    _, rows = read_rows(path, [element.name for element in header.elements])
    types = {code: kind for kind, code in TYPES.items() if kind in CODES}
    elements = []
    for element in header.elements:
        values = np.stack([rows[element.name].column(name) for name in element.names], 1)
        elements.append(
            Element(element.name, [(types[TYPES[p.kind]], p.name) for p in element.properties], values.tolist())
        )
    path.write_bytes(change(*elements))


def without_limits_of_colours(chunk, vertex, sh):
    """As earlier programs write it: colours are between 0 and 1."""
    return ply(Element("chunk", chunk.properties[:12], [row[:12] for row in chunk.rows]), vertex, sh)


COMPRESSED = {
    "others before and behind": lambda c, v, s: ply(CAMERA, TRIANGLES, c, v, FLAGS, s, CAMERA),
    "another order": lambda c, v, s: ply(s, v, c),
    "big endian": lambda c, v, s: ply(c, v, s, layout="binary_big_endian"),
    "text": lambda c, v, s: ply(c, v, s, layout="ascii"),
    "comments": lambda c, v, s: ply(c, v, s, lines=["comment größe", "comment größe".encode("latin-1"), "obj_info ü"]),
    "other line ends": lambda c, v, s: ply(c, v, s, newline="\r\n"),
    "others beside": lambda c, v, s: ply(
        c, Element("vertex", [("uchar", "a"), *v.properties], [[1, *row] for row in v.rows]), s
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", COMPRESSED)
def test_compressed_scenes_whatever_the_file(tmp_path, name):
    """gsply takes elements for what it expects at their place, and text for ASCII."""
    path = tmp_path / "a.compressed.ply"
    io.save_scene(path, random_scene(count=300, degree=1))
    expected = io.load_scene(path)
    rearranged(path, COMPRESSED[name])
    assert io.is_scene(path)
    for found, wanted in zip(io.load_scene(path), expected):
        assert torch.equal(found, wanted)


def test_a_compressed_scene_without_limits_of_colours(tmp_path):
    scene = random_scene(count=30, degree=1)
    scene = scene._replace(shs=scene.shs.clamp(-1.7, 1.7))
    scene.shs[:2, 0] = torch.tensor([[0.5], [-0.5]]) / 0.28209479177387814  # so that the limits are 0 and 1
    path = tmp_path / "a.ply"
    io.save_scene(tmp_path / "a.compressed.ply", scene)
    (tmp_path / "a.compressed.ply").rename(path)  # the header says what it is
    expected = io.load_scene(path)
    rearranged(path, without_limits_of_colours)
    assert (io.load_scene(path).shs - expected.shs).abs().max() < 1e-5


@pytest.mark.parametrize(
    "change, message",
    [
        (lambda c, v, s: ply(Element("chunk", c.properties, c.rows[:1]), v, s), "a chunk for every 256 of 300 vertices, got 1"),
        (lambda c, v, s: ply(c, v, Element("sh", s.properties, s.rows[:7])), "harmonics of 300 vertices in bytes, got 7"),
        (lambda c, v, s: ply(c, Element("vertex", v.properties[:3], [row[:3] for row in v.rows]), s), "packed_color once"),
        (lambda c, v, s: ply(c, v, s)[:-1], "cut short"),
        (lambda c, v, s: ply(c, v, s).replace(b"vertex 300", b"vertex 4000000000"), "that fits"),
    ],
)  # fmt: skip
def test_compressed_scenes_that_cannot_be_read(tmp_path, change, message):
    """More vertices than chunks were read from beyond the end of the memory."""
    path = tmp_path / "a.compressed.ply"
    io.save_scene(path, random_scene(count=300, degree=1))
    rearranged(path, change)
    with pytest.raises(io.SceneError, match=message) as caught:
        io.load_scene(path)
    assert str(caught.value).startswith(f"{path}: ")
