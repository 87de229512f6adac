"""Captures that can be read and cannot be right, or are spelt in another way."""

import json
from dataclasses import replace

import numpy as np
import torch
from capture_files import circle, draw_picture, opengl_pose, write_colmap
from cli_extra import image

from analytic_rasterizer.captures.colmap import BY_NAME

SIZE = (48, 36)
POINTS = torch.rand(60, 3, generator=torch.Generator().manual_seed(0)) - 0.5
COLORS = torch.full((60, 3), 128, dtype=torch.int32)
POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a21\nsize 12345\n"
MATRIX = [[36.0, 0.0, 24.0], [0.0, 36.0, 18.0], [0.0, 0.0, 1.0]]


def write(folder, model="PINHOLE", coefficients=None, writer=write_colmap, names=None):
    """A reconstruction of nine photographs."""
    views = circle(9, SIZE)
    names = [f"{view.name}.png" for view in views] if names is None else names
    named = [replace(view, name=name) for view, name in zip(views, names)]
    writer(folder / "sparse" / "0", named, POINTS, COLORS, BY_NAME[model].number, coefficients)
    draw(folder / "images", names)


def draw(folder, names):
    for view, name in zip(circle(9, SIZE), names):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        image.fromarray(draw_picture(view, opaque=True)).save(folder / name)


def transforms(folder, change=lambda content: None, name="transforms.json"):
    """A nerfstudio capture of nine photographs."""
    names = [f"r_{i}.png" for i in range(9)]
    draw(folder / "images", names)
    poses = [opengl_pose(view) for view in circle(9, SIZE)]
    frames = [{"file_path": f"images/{n}", "transform_matrix": pose} for n, pose in zip(names, poses)]
    content = {"w": 48, "h": 36, "fl_x": 36.0, "fl_y": 36.0, "frames": frames}
    change(content)
    (folder / name).write_text(json.dumps(content))


def masks(folder, name, level=255, files="{}.png", count=9):
    """Masks of one level, whose files have the name of the photograph in them."""
    for i in range(count):
        path = folder / name / files.format(f"r_{i}.png")
        path.parent.mkdir(parents=True, exist_ok=True)
        image.fromarray(np.full(SIZE[::-1], level, np.uint8)).save(path)


def spoil(folder, *names, keep=200):
    for name in names:
        path = folder / name
        path.write_bytes(path.read_bytes()[:keep])


def each_frame(**values):
    return lambda content: [frame.update(values) for frame in content["frames"]]


def resize(folder, box, size=None):
    for path in (folder / "images").iterdir():
        picture = image.open(path).crop(box)
        (picture if size is None else picture.resize(size)).save(path)


def points_of_a_ply(folder):
    rows = "\n".join(" ".join(map(str, row)) for row in POINTS.tolist())
    header = "".join(f"property float {axis}\n" for axis in "xyz")
    text = f"ply\nformat ascii 1.0\nelement vertex {len(POINTS)}\n{header}end_header\n{rows}\n"
    (folder / "own.ply").write_text(text)


def mirrored(pose):
    return [[-number for number in pose[0]], *pose[1:]]
