"""Data that can be read and cannot be right: what commands say of it. The next case is a row of CASES."""

import json
import re
import sys
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import commands
import numpy as np
import pytest
import torch
from capture_files import circle, draw_picture, opengl_pose, write_colmap, write_colmap_text
from cli_extra import image

from analytic_rasterizer import Lens, io, training
from analytic_rasterizer.training import extent, photographs, pictures
from analytic_rasterizer.training.colmap import BY_NAME

SIZE = (48, 36)
POINTS = torch.rand(60, 3, generator=torch.Generator().manual_seed(0)) - 0.5
COLORS = torch.full((60, 3), 128, dtype=torch.int32)
POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a21\nsize 12345\n"


# ------------------------------------------------------------------------------------ captures


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


class Case(NamedTuple):
    """A capture, and what is said of it.

    Attributes:
        make: Writes it to a folder.
        train: Pattern of what `train` says on stderr.
        fails: Whether it ends with an error; then the pattern is of this error.
        inspect: Pattern of what `inspect` says; an error begins with "error:".
        options: Of `train`.
    """

    make: Callable[[Path], object]
    train: str
    fails: bool = False
    inspect: str = ""
    options: str = ""


REFUSE = "--missing refuse"
EXPECTED_MASK = r"expected masks/r_0.png.png or masks/r_0.png for the photograph r_0.png; --masks none ignores them"
MISSING_MASKS = lambda f: transforms(f, each_frame(mask_path="masks/none.png"))  # noqa: E731
FOLDED = r"the lens of 9 photographs folds back inside the picture, and shows \d+% of r_\d.png, so that nothing is"
COUNTED = r"masks +yes +9 photographs of 9 have a mask; of the pixels that were looked at they leave out "

CASES = {
    # masks
    "masks are missing": Case(
        MISSING_MASKS,
        "1 of 1 masks that mask_path names are missing, the first is .*none.png; --masks none ignores masks; "
        "--missing skip lets all pixels count where a mask is missing",
        fails=True,
        inspect=r"missing pictures yes +1 files are not there; masks/none.png; --missing skip",
        options=f"--effects none {REFUSE}",
    ),
    "masks are missing and ignored": Case(MISSING_MASKS, "", options="--masks none"),
    "masks are missing and skipped": Case(
        MISSING_MASKS, "the masks of 9 of 9 pictures are missing: all of their pixels count", options="--missing skip"
    ),
    "a mask is broken and skipped": Case(
        lambda f: (write(f), masks(f, "masks"), spoil(f, "masks/r_3.png.png", keep=60)),
        "the masks of 1 of 9 pictures cannot be read: all of their pixels count",
        inspect="missing pictures yes +1 files are not there, or cannot be read; masks/r_3.png.png",
        options="--missing skip",
    ),
    "masks leave nothing": Case(
        lambda f: (write(f), masks(f, "masks", 0)),
        r"expected pixels that count, got none in all 7 photographs, whose masks are black .*; --masks none ignores",
        fails=True,
        inspect=COUNTED + r"100\.0%, so that train has nothing to learn from",
    ),
    "masks leave some photographs nothing": Case(
        lambda f: (write(f), masks(f, "masks", 255), masks(f, "masks", 0, count=4)),
        r"masks leave out 42\.9% of the pixels; nothing counts in 3 photographs: r_1, r_2, r_3",
        inspect=COUNTED + r"44\.4%",
    ),
    **{
        f"masks as {place}/{files}": Case(
            lambda f, place=place, files=files: (write(f), masks(f, place, files=files)),
            rf"9 masks are ignored, all pixels count: .*: found \S*/{re.escape(first)}, {EXPECTED_MASK}",
            inspect=rf"masks +no .*9 files of masks .* ignored \(found \S*/{re.escape(first)}, expected masks/r_0.png",
        )
        for place, files, first in (
            ("images", "{}.mask.png", "r_0.png.mask.png"),  # RealityScan
            ("images", "mask_{}", "mask_r_0.png"),
            ("segmentation", "{}", "segmentation/r_0.png"),
            ("masks", "mask of {}", "masks/mask of r_0.png"),
        )
    },
    "flat masks of pictures in folders": Case(
        lambda f: (write(f, names=[f"cam/r_{i}.png" for i in range(9)]), masks(f, "masks")),
        r"found \S*/masks/r_0.png.png, expected masks/cam/r_0.png.png or masks/cam/r_0.png for the photograph cam/r_0",
    ),
    # lenses and cameras
    "a lens folds": Case(lambda f: write(f, "OPENCV", [0.3, -59, 0, 0]), FOLDED, inspect=f"lens +yes .*{FOLDED}"),
    "a width of many digits": Case(
        lambda f: (
            write(f, writer=write_colmap_text),
            (f / "sparse/0/cameras.txt").write_text(f"1 PINHOLE {'9' * 29} 36 36 36 24 18\n"),
            (f / "sparse/0/images.txt").write_text("".join(f"{i} 1 0 0 0 0 0 {i} 1 r_{i}.png\n\n" for i in range(9))),
        ),
        r"cameras: camera 1: width must be a whole number from 1 to 2\^20, got 9{29}",
        fails=True,
        inspect=r"error: .*width must be a whole number from 1 to 2\^20",
    ),
    "mirrored poses": Case(
        lambda f: transforms(
            f, lambda c: [frame.update(transform_matrix=mirrored(frame["transform_matrix"])) for frame in c["frames"]]
        ),
        r"frame 0: transform_matrix must hold a rotation, got a mirrored one \(determinant -1\): .*; one axis of the",
        fails=True,
        inspect="error: .*got a mirrored one",
    ),
    # files of reconstructions
    "images.bin is missing": Case(
        lambda f: (write(f), (f / "sparse/0/images.bin").unlink()),
        "sparse/0: expected COLMAP's cameras and images, both .bin or both .txt, got cameras.bin, points3D.bin",
        fails=True,
        inspect="error: .*sparse/0: expected COLMAP's cameras and images, .*, got cameras.bin, points3D.bin",
    ),
    "a part of a reconstruction beside a transforms.json": Case(
        lambda f: (write(f), (f / "sparse/0/images.bin").unlink(), transforms(f)),
        r"passed over: \S*sparse/0: expected COLMAP's cameras and images, .*, got cameras.bin, points3D.bin",
    ),
    **{
        f"{name} is a pointer of Git LFS": Case(
            lambda f, name=name, make=make: (make(f), (f / name).write_bytes(POINTER)),
            rf"{name}: expected the content of the file, got a pointer of Git LFS; `git lfs pull` fetches it",
            fails=True,
            inspect=rf"error: .*{name}: expected the content of the file, got a pointer of Git LFS" if seen else "",
            options=f"--effects none {REFUSE}",
        )
        for name, make, seen in (
            ("sparse/0/cameras.bin", write, True),
            ("sparse/0/images.bin", write, True),
            ("sparse/0/points3D.bin", write, True),
            ("sparse/0/images.txt", lambda f: write(f, writer=write_colmap_text), True),
            ("transforms.json", transforms, True),
            ("images/r_2.png", write, False),
            ("own.ply", lambda f: transforms(f, lambda c: c.update(ply_file_path="own.ply")), True),
        )
    },
    "points of a transforms_train.json": Case(
        lambda f: transforms(f, lambda c: c.update(ply_file_path="none.ply"), "transforms_train.json"),
        "transforms_train.json: ply_file_path must name a file beside it, got 'none.ply'",
        fails=True,
    ),
    # transforms.json
    "some frames have a size": Case(
        lambda f: transforms(
            f, lambda c: (c.pop("w"), c.pop("h"), [frame.update(w=48, h=36) for frame in c["frames"][::2]])
        ),
        "",
    ),
    "a matrix K in each frame": Case(
        lambda f: transforms(f, lambda c: (c.pop("fl_x"), c.pop("fl_y"), each_frame(K=MATRIX)(c))), ""
    ),
    "camera_model in lower case": Case(lambda f: transforms(f, lambda c: c.update(camera_model="opencv")), ""),
    # pictures
    "pictures are broken": Case(
        lambda f: (write(f), spoil(f, "images/r_3.png", "images/r_5.png")),
        r"2 of 7 pictures cannot be read, the first is .*r_3.png: unreadable or cut short .*; --missing skip",
        fails=True,
        inspect=r"missing pictures yes +2 files are not there, or cannot be read; images/r_3.png, images/r_5.png; --m",
        options=f"--effects none {REFUSE}",
    ),
    "pictures are none": Case(
        lambda f: (write(f), spoil(f, "images/r_3.png", "images/r_5.png", keep=3)),
        r"2 of 7 pictures cannot be read, the first is .*r_3.png: unreadable or cut short .*; --missing skip",
        fails=True,
        options=f"--effects none {REFUSE}",
    ),
    "pictures are broken and skipped": Case(
        lambda f: (write(f), spoil(f, "images/r_3.png", "images/r_5.png")),
        "2 of 9 pictures cannot be read and left out",
        options="--missing skip",
    ),
    "pictures are broken and nothing is said": Case(
        lambda f: (write(f), spoil(f, "images/r_3.png")), "--effects auto takes --missing skip"
    ),
    "pictures are cut": Case(
        lambda f: (write(f), resize(f, (0, 4, 48, 31))),
        r"7 of 7 pictures are taken as cut about the principal point, .* the first is .*png, 48 x 27 px of a camera of "
        r"48 x 36: photographs and cameras have different proportions; take the photographs for which",
        inspect=r"wrong sizes +yes +9 photographs .* it takes 9 for cut about the principal point",
    ),
    "pictures are squeezed": Case(
        lambda f: (write(f), resize(f, (0, 0, 48, 36), (24, 24))),
        r"7 of 7 pictures are taken as squeezed, .*, 24 x 24 px of a camera of 48 x 36",
    ),
    "another suffix of a newer format": Case(
        lambda f: (write(f), [path.rename(path.with_suffix(".avif")) for path in (f / "images").iterdir()]), ""
    ),
    # results
    "results in the capture": Case(
        write, "--out must be another folder than the capture and those of its pictures", fails=True, options="--out ."
    ),
    "results among the pictures": Case(
        write, "--out must be another folder than the capture and", fails=True, options="--out images"
    ),
}
MATRIX = [[36.0, 0.0, 24.0], [0.0, 36.0, 18.0], [0.0, 0.0, 1.0]]


@pytest.mark.parametrize("name", CASES)
def test_what_is_said_of_a_capture(tmp_path, capsys, monkeypatch, name):
    case, folder = CASES[name], tmp_path / "scene"
    case.make(folder)
    monkeypatch.chdir(folder)
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*")}
    options = case.options if "--out" in case.options else f"--out {tmp_path / 'out'} {case.options}"
    with warnings.catch_warnings():  # pytest keeps them, and does not print them
        warnings.simplefilter("always")
        monkeypatch.setattr(warnings, "showwarning", lambda *said, **_: sys.stderr.write(warnings.formatwarning(*said)))
        code = commands.command("train", folder, f"{options.strip()} --device cpu --iterations 2 --sh-degree 0")
    said = capsys.readouterr().err
    assert code == (2 if case.fails else 0), said
    lines = [line for line in said.splitlines() if re.search(case.train, line)]
    assert lines, said
    if case.fails:
        assert said.startswith("error: ") and said.count("\n") == 1
        assert {path: path.stat().st_mtime_ns for path in folder.rglob("*")} == before
    elif not case.train:
        assert "warning" not in said
    if case.inspect:
        code = commands.command("inspect", folder)
        shown = capsys.readouterr()
        assert code == (2 if case.inspect.startswith("error") else 0), shown.err
        assert re.search(case.inspect, shown.err + shown.out), shown.err + shown.out


# --------------------------------------------------------------------------------- what is read

TOP = np.s_[:3]  # of masks: what counts


def levels(value, shape=(6, 8), dtype=np.uint8):
    found = np.zeros(shape, dtype)
    found[TOP] = value
    return found


def with_alpha(colors, alpha):
    return image.fromarray(np.concatenate([colors, alpha[..., None]], 2), "RGBA")


def labels():
    found = levels(1)
    found[TOP, 4:] = 2
    return found


ALL, NONE = np.full((6, 8, 3), 255, np.uint8), np.zeros((6, 8, 3), np.uint8)
MASKS = {
    "white": image.fromarray(levels(255)),
    "a label": image.fromarray(levels(1)),
    "labels": image.fromarray(labels()),
    "labels beside a bright one": image.fromarray(np.where(np.eye(6, 8) > 0, 255 * np.sign(labels()), labels())),
    "16 bits": image.fromarray(levels(3, dtype=np.uint16)),
    "1 bit": image.fromarray(levels(255)).convert("1"),
    "dark blue": image.fromarray(np.stack([levels(0), levels(0), levels(2)], 2)),
    "alpha over white": with_alpha(ALL, levels(255)),
    "alpha over black": with_alpha(NONE, levels(255)),
    "alpha over the same colours": with_alpha(np.stack([levels(200)] * 3, 2), levels(255)),
    "opaque": with_alpha(np.stack([levels(255)] * 3, 2), np.full((6, 8), 255, np.uint8)),
    "grey and alpha": image.merge("LA", [image.new("L", (8, 6), 255), image.fromarray(levels(255))]),
}


@pytest.mark.parametrize("name", MASKS)
def test_what_counts_in_a_mask(tmp_path, name):
    """What is neither black nor transparent, as COLMAP and nerfstudio have it."""
    MASKS[name].save(tmp_path / "mask.png")
    found = photographs.read_mask(tmp_path / "mask.png", 8, 6)
    assert found.tolist() == levels(255).tolist()


def test_what_counts_in_a_mask_that_loses_something(tmp_path):
    noise = np.random.default_rng(0).integers(0, 12, (64, 64)).astype(np.uint8)
    noise[:32] += 240
    for suffix in ("jpg", "webp"):
        image.fromarray(noise).convert("RGB").save(tmp_path / f"mask.{suffix}", quality=80)
        found = photographs.read_mask(tmp_path / f"mask.{suffix}", 64, 64)
        assert (found[:28] == 255).all() and (found[36:] == 0).all()


VIEWS = {
    "sizes": lambda c: (c.pop("w"), c.pop("h"), [frame.update(w=48, h=36) for frame in c["frames"][::2]]),
    "a matrix in each frame": lambda c: (c.pop("fl_x"), c.pop("fl_y"), each_frame(K=MATRIX)(c)),
    "a matrix by rows": lambda c: (c.pop("fl_x"), c.pop("fl_y"), each_frame(K=[*MATRIX[0], *MATRIX[1], *MATRIX[2]])(c)),
    "a matrix for all": lambda c: (c.pop("fl_x"), c.pop("fl_y"), c.update(K=MATRIX)),
    "a matrix before what all have": lambda c: (c.update(fl_x=9.0, camera_angle_x=1.0), each_frame(K=MATRIX)(c)),
    "a focal length before a matrix": lambda c: c.update(K=[[9.0, 0, 24], [0, 9, 18], [0, 0, 1]]),
    "lower case": lambda c: c.update(camera_model="opencv"),
}


@pytest.mark.parametrize("name", VIEWS)
def test_cameras_that_are_spelt_in_another_way(tmp_path, name):
    transforms(tmp_path / "plain")
    transforms(tmp_path / "other", VIEWS[name])
    plain, other = (io.load_views(tmp_path / folder / "transforms.json") for folder in ("plain", "other"))
    for one, two in zip(plain, other, strict=True):
        assert replace(one, cx=24.0, cy=18.0) == replace(two, cx=24.0, cy=18.0) and two.middle == (24.0, 18.0)


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        ([[36, 1, 24], [0, 36, 18], [0, 0, 1]], "frame 0: K must be fx 0 cx, 0 fy cy, 0 0 1 by rows, got .*36, 1, 24"),
        ([[36, 0], [0, 36]], "frame 0: K must hold 3 x 3 finite numbers"),
        ([[-36, 0, 24], [0, 36, 18], [0, 0, 1]], "frame 0: fl_x must be a positive finite number, got -36"),
    ],
)
def test_matrices_that_are_none(tmp_path, matrix, message):
    transforms(tmp_path, each_frame(K=matrix))
    with pytest.raises(io.SceneError, match=message):
        io.load_views(tmp_path / "transforms.json")


def test_points_that_a_transforms_train_names(tmp_path):
    transforms(tmp_path, lambda c: c.update(ply_file_path="own.ply"), "transforms_train.json")
    points_of_a_ply(tmp_path)
    assert torch.allclose(training.load_capture(tmp_path).points[0], POINTS)


@pytest.mark.parametrize("center", [(24.0, 18.0), (23.0, 19.5)], ids=str)
@pytest.mark.parametrize("size", [(48, 27), (32, 36)], ids=str)
def test_a_cut_picture_keeps_its_pixels(tmp_path, size, center):
    """About the principal point: what was there is in the middle, and as large as before."""
    view = replace(circle(1, SIZE)[0], cx=center[0], cy=center[1])
    image.new("RGB", size).save(tmp_path / "a.png")
    found = pictures.load_pictures([training.Photograph(view, {1: tmp_path / "a.png"})], (1,), (0.0,) * 3, "cpu")
    (cut,) = found.views
    kept = [SIZE[axis] == size[axis] for axis in (0, 1)]
    expected = [center[axis] if kept[axis] else size[axis] / 2 for axis in (0, 1)]
    assert (cut.width, cut.height, cut.fx, cut.fy) == (*size, view.fx, view.fy) and list(cut.middle) == expected


@pytest.mark.parametrize(
    ("lens", "low", "high"),
    [
        (None, 1, 1),
        (Lens.perspective([-0.1]), 1, 1),
        (Lens.fisheye([0.01]), 1, 1),
        (Lens.perspective([0.3, -59.0]), 0.05, 0.2),
        (Lens.equirectangular(), 1, 1),
    ],
    ids=str,
)
def test_how_much_a_lens_shows(lens, low, high):
    view = replace(circle(1, SIZE)[0], lens=lens)
    if lens is not None and lens.model == "equirectangular":
        view = replace(view, **io.lenses.sphere_of(*SIZE))
    assert low <= extent.shown_share(view) <= high


def test_all_of_a_pictures_pixels_count_once_in_what_masks_leave_out(tmp_path):
    write(tmp_path)
    masks(tmp_path, "masks", 255)
    masks(tmp_path, "masks", 0, count=2)
    capture = training.load_capture(tmp_path, test_every=0)
    for scales in ((1,), (1, 2)):
        shares = training.load_pictures(capture.train, scales, (0.0,) * 3, "cpu").shares
        assert shares == [0, 0, *[1] * 7]


def test_commands_make_the_folders_of_their_files(tmp_path):
    """And say that they cannot before the scene is read."""
    write(tmp_path / "capture")
    start = training.starting_gaussians(training.TrainingOptions(random_points=9, sh_degree=0), None)
    io.save_scene(tmp_path / "scene.ply", start)
    written = [tmp_path / "new" / "plan.json", tmp_path / "newer" / "page.html"]
    assert commands.command("inspect", tmp_path / "capture", "--json", written[0]) == 0
    assert commands.command("view", tmp_path / "scene.ply", "--export", written[1]) == 0
    assert all(path.is_file() for path in written)
    (tmp_path / "file").write_text("")
    assert commands.command("view", tmp_path / "none.ply", "--export", tmp_path / "file" / "page.html") == 2
