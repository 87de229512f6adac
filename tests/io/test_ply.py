"""Whatever writes a .ply, its vertices are read, as Gaussians and as points. The next case is a row of a table."""

import math
import struct

import numpy as np
import pytest
import torch
from ply_files import CAMERA, FLAGS, NOTHING, ORDERS, POLYGONS, STRIPS, TRIANGLES, Element, ply, vertices

from analytic_rasterizer import Gaussians, io

SCENE_COLUMNS = [
    *("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", *(f"f_rest_{i}" for i in range(9)), "opacity"),
    *("scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
]
SHAPE = [name for name in SCENE_COLUMNS if not name.startswith("f_")]
POINT_COLUMNS = ["x", "y", "z", "red", "green", "blue"]


def table(columns, count=5):
    rows = np.random.default_rng(7).uniform(0.1, 0.9, (count, len(columns))).astype(np.float32)
    rows[0, 0] = struct.unpack("<f", b"\n\r\n\x41")[0]  # bytes that a reader of lines may trip over
    return rows


BESIDE = [(("uchar", "red8"), 200), (("int", "id"), -5), (("double", "time"), 1e300)]
LISTS = [(("uchar", "float", "weights"), [0.25, 0.5])]

CHUNKS = Element("chunk", [("float", "a")], [[0.5], [0.25]])
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
    "one other line end": lambda c, r: ply(vertices(c, r)).replace(b"end_header\n", b"end_header\r\n"),
    "spaces": lambda c, r: ply(vertices(c, r)).replace(b"property float x", b"  property   float\tx  "),
    "a byte order mark": lambda c, r: b"\xef\xbb\xbf" + ply(vertices(c, r)),
    "other chunks before": lambda c, r: ply(CHUNKS, vertices(c, r)),
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

    def stack(*names):
        return torch.stack([column[name] for name in names], 1)

    rest = [stack(f"f_dc_{k}", *(f"f_rest_{3 * k + i}" for i in range(3))) for k in range(3)]  # of each channel
    turns, sizes = stack("rot_0", "rot_1", "rot_2", "rot_3"), stack("scale_0", "scale_1", "scale_2")
    expected = Gaussians(stack(*"xyz"), sizes, turns, stack("opacity"), torch.stack(rest, 2))
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
    with pytest.warns(UserWarning, match=r"a\.ply: float32 moves 2 of 2 Gaussians, by up to 0\.25: subtract an offset"):
        scene = io.load_scene(tmp_path / "a.ply")
    assert torch.equal(scene.means, torch.tensor(far, dtype=torch.float32))


@pytest.mark.parametrize(
    "kind, whole", [("uchar", 255), ("ushort", 65535), ("float", 1), ("float", 255), ("double", 1)]
)
@pytest.mark.parametrize("layout", [*ORDERS, "ascii"])
def test_colours_of_a_scene_without_harmonics(tmp_path, kind, whole, layout):
    colors = [[whole, 0, whole], [0, whole, 0]]
    properties = [("float", name) for name in SHAPE] + [(kind, name) for name in ("red", "green", "blue")]
    rows = [[*table(SHAPE)[i].tolist(), *color] for i, color in enumerate(colors)]
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
TEXT, CUT = ply(SCENE, layout="ascii"), "that fits .* bytes, got "
BYTES = ply(vertices(SCENE_COLUMNS, table(SCENE_COLUMNS), more=[(("uchar", "c"), 255)]), layout="ascii")
TOO_BRIGHT = [(("float", name), 300) for name in ("red", "green", "blue")]
REFUSED = {
    "nothing": (b"", "does not begin with 'ply'"),
    "another file": (b"plyx\n", "does not begin with 'ply'"),
    "no end": (ply(SCENE).partition(b"end_header")[0], "no end_header"),
    "an endless header": (b"ply\n" + b"comment a\n" * 200_000, "no end_header"),
    "no format": (ply(SCENE).replace(b"format binary_little_endian 1.0\n", b""), "expected format ascii, .*, got none"),
    "another format": (ply(SCENE).replace(b"_little_", b"_middle_"), "binary_big_endian, got binary_middle_endian"),
    "no vertices": (ply(CAMERA), "expected vertices, but the .ply has none"),
    "one byte too few": (ply(SCENE)[:-1], CUT + "5"),
    "one line too few": (TEXT.rsplit(b"\n", 2)[0], "cut short: expected 5 vertices, got 4"),
    "one word too few": (TEXT.rsplit(b" ", 1)[0], "expected 23 numbers in every row"),
    "a word in Latin-1": (TEXT.rsplit(b" ", 1)[0] + b" \xff\n", "expected 23 numbers in every row"),
    "no number": (TEXT.replace(b"\n0.", b"\nfour 0."), "expected 23 numbers in every row"),
    "too large a number": (BYTES.replace(b" 255\n", b" 256\n"), "expected 24 numbers in every row"),
    "a huge number of vertices": (ply(SCENE).replace(b"vertex 5", b"vertex 4000000000"), CUT + "4000000000"),
    "a number that is none": (ply(SCENE).replace(b"vertex 5", b"vertex many"), "a number of vertices, got many"),
    "a negative number": (ply(SCENE).replace(b"vertex 5", b"vertex -5"), "expected a number of vertices, got -5"),
    "no number at all": (ply(SCENE).replace(b"vertex 5", b"vertex"), "expected a number of vertices, got none"),
    "endless digits": (ply(SCENE).replace(b"vertex 5", b"vertex " + b"9" * 6000), "a number of vertices, got 9999"),
    "huge lists before": (
        ply(TRIANGLES, SCENE).replace(b"list uchar", b"list uint"),
        "cut short: the file ends in rows of the element face",
    ),
    "negative lists before": (
        ply(Element("a", [("char", "float", "b")], [[[]]]), SCENE).replace(b"end_header\n\0", b"end_header\n\xff"),
        "expected lists of rows of the element a with whole lengths, got -1",
    ),
    "a huge element before": (ply(CAMERA, SCENE).replace(b"camera 2", b"camera 99999999"), CUT + "99999999"),
    "an unknown type": (ply(SCENE).replace(b"property float x", b"property half x"), "a type of PLY .*got half"),
    "an unknown type before": (ply(CAMERA, SCENE).replace(b"float radius", b"half radius"), "got half"),
    "a property without a name": (ply(SCENE).replace(b"float x", b"float"), "type and the name of a property"),
    "a property of nothing": (ply(SCENE, lines=["property float a"]), "expected an element in front of"),
    "x twice": (ply(SCENE).replace(b"float f_dc_0", b"float x"), "missing vertex properties f_dc_0|x once"),
    "opacity twice": (
        ply(vertices([*SCENE_COLUMNS, "opacity"], table([*SCENE_COLUMNS, "opacity"]))),
        "expected the property opacity once, got it 2 times",
    ),
    "points": (
        ply(vertices(["x", "y", "z"], table(["x", "y", "z"]))),
        "missing vertex properties f_dc_0, f_dc_1, f_dc_2, opacity, scale_0, .*rot_3",
    ),
    "surfels": (ply(vertices(["x"], table(["x"]))), "missing vertex properties y, z"),
    "too few harmonics": (
        ply(vertices([*SCENE_COLUMNS[:13], *SCENE_COLUMNS[15:]], table(range(21)))),
        "0, 9, 24, 45 or 72 f_rest properties .*got 7",
    ),
    "harmonics with a gap": (ply(SCENE).replace(b"f_rest_8", b"f_rest_9"), "expected the property f_rest_8 once"),
    "colours out of range": (ply(vertices(SHAPE, table(SHAPE), more=TOO_BRIGHT)), "expected colours from 0 to 255"),
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


@pytest.mark.parametrize(
    "word", ["nan", "-NaN", "-nan(ind)", "nan(0x8000)", "1.#QNAN", "-1.#IND00", "inf", "-1.#INF000", "1e999"]
)
def test_words_of_text_that_are_no_finite_number(tmp_path, word):
    """Programs write them as their system does."""
    rows = table(SCENE_COLUMNS)
    whole = ply(vertices(SCENE_COLUMNS, rows), layout="ascii")
    header, _, body = whole.partition(b"end_header\n")
    (tmp_path / "a.ply").write_bytes(header + b"end_header\n" + word.encode() + body[body.index(b" ") :])
    with pytest.warns(UserWarning, match=r"a\.ply: 1 of 5 Gaussians are left out: means of 1 are not finite"):
        assert torch.equal(io.load_scene(tmp_path / "a.ply").means, torch.from_numpy(rows[1:, :3].copy()))


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
