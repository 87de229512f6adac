"""Data that can be read and cannot be right: what commands say of it. The next case is a row of CASES."""

import re
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import commands
import pytest
from capture_files import write_colmap_text
from spoiled_captures import (
    MATRIX,
    POINTER,
    each_frame,
    masks,
    mirrored,
    resize,
    spoil,
    transforms,
    write,
)

from analytic_rasterizer import io, training


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
        inspect=COUNTED + r"100\.0%, so that train has nothing to learn from; --masks none ignores them\n",
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
