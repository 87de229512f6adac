"""Captures like those found in the field: nine grey pictures and what may be odd about them."""

import json
import shutil
import struct
from dataclasses import replace

import commands
import torch
from capture_files import circle, opengl_pose, write_colmap, write_colmap_text
from cli_extra import image

from analytic_rasterizer.captures import colmap

SIZE = (35, 33)
POINTS = torch.rand(40, 3, generator=torch.Generator().manual_seed(0)) - 0.5
COLORS = torch.arange(120).reshape(40, 3)


def write(folder, model="PINHOLE", coefficients=None, writer=write_colmap, views=None, names=None, files=None):
    """A COLMAP capture of nine grey pictures.

    Args:
        names: Of the pictures in the reconstruction; None: those of the views.
        files: Their names on the disk; None: the same.
    """
    views = circle(9, SIZE) if views is None else views
    names = [f"{view.name}.png" for view in views] if names is None else names
    views = [replace(view, name=name) for view, name in zip(views, names)]
    writer(folder / "sparse" / "0", views, POINTS, COLORS, colmap.BY_NAME[model].number, coefficients)
    write_grey(folder / "images", views, names if files is None else files)


def write_grey(folder, views, names) -> None:
    for view, name in zip(views, names):
        file = folder / name
        file.parent.mkdir(parents=True, exist_ok=True)
        image.new("RGB", (view.width, view.height), (90, 120, 150)).save(file)


def as_text(folder, change, *names) -> None:
    """A reconstruction as text, of which files of these names, or all, are changed."""
    write(folder, writer=write_colmap_text)
    for name in names or ("cameras", "images", "points3D"):
        path = folder / "sparse" / "0" / f"{name}.txt"
        path.write_bytes(change(path.read_bytes()))


def named(folder, pattern, stored=None, **options) -> None:
    """Pictures of such names, of their number, its remainder and its half; on the disk perhaps of others."""
    numbers = [(i, i % 2, i // 2) for i in range(9)]
    names, files = ([text.format(*n) for n in numbers] for text in (pattern, stored or pattern))
    write(folder, names=names, files=files, **options)


def lines_of_pictures(text: bytes) -> bytes:
    return b"\n".join(line for line in text.split(b"\n") if b"png" in line)


def spoilt(folder, *names, content=b"x") -> None:
    for name in names:
        (folder / "sparse" / "0" / name).write_bytes(content)


def frames(pattern, count=9) -> list[dict]:
    """Of a transforms.json, with these names of pictures."""
    views = circle(9, SIZE)[:count]
    return [{"file_path": pattern.format(view.name), "transform_matrix": opengl_pose(view)} for view in views]


def beside(folder, **transforms) -> None:
    """A transforms.json beside a reconstruction of the same pictures."""
    content = {"w": 35, "h": 33, "fl_x": 36.0, "fl_y": 36.0, "frames": frames("images/{}.png")}
    (folder / "transforms.json").write_text(json.dumps(content | transforms))


def only_transforms(folder, **transforms) -> None:
    write_grey(folder / "images", circle(9, SIZE), [f"r_{i}.png" for i in range(9)])
    beside(folder, **transforms)


def with_unused(folder, model, number=None) -> None:
    """A last camera that no picture was taken by."""
    write(folder)
    path = folder / "sparse" / "0" / "cameras.bin"
    parameters = colmap.BY_NAME[model].parameters
    record = struct.pack(f"<iiQQ{parameters}d", 77, number or colmap.BY_NAME[model].number, 9, 9, *[1.0] * parameters)
    path.write_bytes(struct.pack("<Q", 10) + path.read_bytes()[8:] + record)


def models(folder, counts) -> None:
    """Several reconstructions of so many pictures each."""
    write(folder)
    shutil.rmtree(folder / "sparse" / "0")
    for i, count in enumerate(counts):
        write_colmap(folder / "sparse" / str(i), circle(9, SIZE)[:count], POINTS, COLORS)
    for name in ("project.ini", ".DS_Store"):
        (folder / "sparse" / name).write_text("x")


def moved(folder, source, target) -> None:
    (folder / target).parent.mkdir(parents=True, exist_ok=True)
    (folder / source).rename(folder / target)


def without(folder, *paths, **options) -> None:
    write(folder, **options)
    for path in paths:
        (folder / path).unlink()


def masked(folder, name="masks") -> None:
    write(folder)
    write_grey(folder / name, circle(9, SIZE), [f"r_{i}.png.png" for i in range(9)])


def far(folder, place=(5e5, 4.2e6, 120.0), writer=write_colmap) -> None:
    views = [view.in_frame(tuple(-number for number in place)) for view in circle(9, SIZE)]
    views = [replace(view, offset=None) for view in views]
    points = POINTS.double() + torch.tensor(place, dtype=torch.float64)
    write(folder, views=views, writer=lambda folder, views, _, *rest: writer(folder, views, points, *rest))


def smaller(folder, factor) -> None:
    """The capture in larger units."""
    views = [replace(view, name=f"small_{view.name}", w2c=view.w2c.clone()) for view in circle(9, SIZE)]
    for view in views:
        view.w2c[:3, 3] *= factor
    write(folder, views=views)
    write_colmap(folder / "other", views, POINTS * factor, COLORS)
    shutil.rmtree(folder / "sparse" / "0")
    (folder / "other").rename(folder / "sparse" / "0")


def of_two_sizes(folder) -> None:
    """A camera per picture, some upright, all with their own lens."""
    views = circle(9, (48, 32))
    views = [replace(v, width=v.height, height=v.width) if i % 3 == 0 else v for i, v in enumerate(views)]
    write(folder, "SIMPLE_RADIAL", [-0.1], views=views)


def with_exif(folder, orientation, size=SIZE) -> None:
    write(folder, views=circle(9, size))
    for path in list((folder / "images").iterdir())[:4]:
        exif = image.Exif()
        exif[0x0112] = orientation
        picture = image.open(path)
        picture.save(path, exif=exif)


EXACT = r"9 of 9 photographs have a lens \(%s\), with which they are rendered"


def train(folder, out, *extra) -> int:
    return commands.train(folder, out, "--sh-degree 0 --no-evaluate", *extra)
