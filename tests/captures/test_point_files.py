"""Files of points to start from, and their colours."""

import math

import commands
import pytest
import torch
import train_extra  # noqa: F401
from commands import refused
from ply_files import Element, ply, write_points

from analytic_rasterizer import io, training


@pytest.mark.parametrize("layout", ["binary_little_endian", "ascii"])
def test_points_of_a_ply(tmp_path, layout):
    kinds = [("double", "x"), ("float", "y"), ("float", "z"), ("uchar", "n"), ("uchar", "red")]
    content = ply(Element("vertex", kinds, [[1, 2, 3, 0, 255], [4, 5, 6, 7, 51]]), layout=layout)
    (tmp_path / "p.ply").write_bytes(content)
    points, colors = training.load_points(tmp_path / "p.ply")
    assert points.tolist() == [[1, 2, 3], [4, 5, 6]] and (colors == 0.5).all()  # no green: no colours
    body = content.index(b"end_header\n") + len(b"end_header\n")
    (tmp_path / "p.ply").write_bytes(content[: (body + len(content)) // 2])
    with pytest.raises(io.SceneError, match=r"cut short|expected 2 finite points"):
        training.load_points(tmp_path / "p.ply")


def points_with_colors(path, kind: str, colors) -> torch.Tensor:
    """The colours of a .ply with points of these colours, (P, 3)."""
    write_points(path, [[0, 1, i, *color] for i, color in enumerate(colors)], colors=kind)
    return training.load_points(path)[1]


@pytest.mark.parametrize(
    "kind, largest", [("uchar", 255), ("int", 255), ("ushort", 65535), ("float", 255), ("float", 1), ("double", 1)]
)
def test_colors_of_points_in_every_type(tmp_path, kind, largest):
    """Those that are fractions were taken for black, and NaN came to the training."""
    colors = [(0, largest, largest), (largest, 0, 0)]
    assert points_with_colors(tmp_path / "p.ply", kind, colors).tolist() == [[0, 1, 1], [1, 0, 0]]


OUT_OF_RANGE, NOT_HELD = "expected colours from 0 to 255, got ", "expected 6 numbers in every row"


@pytest.mark.parametrize(
    "kind, color, message",
    [
        *((kind, color, OUT_OF_RANGE) for kind, color in (("float", math.nan), ("float", 256), ("float", -0.5))),
        *((kind, color, OUT_OF_RANGE) for kind, color in (("char", -1), ("int", 256))),
        *(("uchar", color, NOT_HELD) for color in (10**30, -(10**30))),  # NumPy keeps some bits of smaller ones
    ],
)
def test_colors_of_points_out_of_range(tmp_path, kind, color, message):
    """Those that their type does not hold were a traceback."""
    with pytest.raises(io.SceneError, match=rf"p\.ply: {message}"):
        points_with_colors(tmp_path / "p.ply", kind, [(0, 1, color)])


def test_a_ply_that_is_none_is_named(synthetic, tmp_path, capsys):
    (tmp_path / "p.ply").write_text("nothing")
    error = refused(capsys, commands.train, synthetic, tmp_path / "out", "--points", tmp_path / "p.ply")
    assert error.startswith(f"error: {tmp_path / 'p.ply'}: not a PLY file")
