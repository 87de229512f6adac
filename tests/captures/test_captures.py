"""What can be trained on: the layouts of captures, and what is found in the field."""

import json
import math
import re
import shutil
import struct
import warnings
from dataclasses import replace

import commands
import numpy as np
import pytest
import torch
from capture_files import (
    circle,
    draw_picture,
    looking_at_origin,
    opengl_pose,
    write_colmap,
    write_colmap_text,
    write_nerf_synthetic,
    write_pictures,
)
from commands import refused
from places import SHARED
from ply_files import Element, ply
from train_extra import image

import analytic_rasterizer as ar
from analytic_rasterizer import io, render_stages, training
from analytic_rasterizer.captures import colmap, loading, photographs, pictures, placement, undistortion
from analytic_rasterizer.training import files
from analytic_rasterizer.training.start import first_gaussians

WRITERS = pytest.mark.parametrize("write", [write_colmap, write_colmap_text])


@WRITERS
@pytest.mark.parametrize("model", [0, 1])
def test_colmap_files(tmp_path, write, model):
    views = [
        io.View(name, 40 + i, 30, 50.0, 50.0 + model, looking_at_origin(0.7 * i), 20.5, 14.0)
        for i, name in enumerate(["c", "a", "b c"])
    ]
    points = torch.randn(5, 3, generator=torch.Generator().manual_seed(0))
    colors = torch.arange(15).reshape(5, 3)
    write(tmp_path / "0", views, points, colors, model)
    assert colmap.is_reconstruction(tmp_path / "0")
    read = colmap.load_views(tmp_path / "0")
    assert [item.name for item in read] == ["a.png", "b c.png", "c.png"]
    for expected, item in zip(sorted(views, key=lambda v: v.name), read):
        assert replace(item.view, w2c=None) == replace(expected, w2c=None)
        torch.testing.assert_close(item.view.w2c, expected.w2c)
    read_points, read_colors = colmap.load_points(tmp_path / "0")
    assert torch.equal(read_points, points.double())
    torch.testing.assert_close(read_colors, colors / 255)


@WRITERS
def test_colmap_pictures_of_the_same_name_in_several_folders(tmp_path, capsys, write):
    """Each has a name and a picture of its own in the results."""
    folders = ["cam2/", "cam1/", "", "cam3/"]
    views = [replace(v, name=f"{folders[i % 4]}{i // 4:04d}") for i, v in enumerate(circle(12))]
    points, colors = training.random_points(60, seed=5)
    write(tmp_path / "scene" / "sparse" / "0", views, points, (255 * colors).to(torch.uint8))
    for folder in folders:
        (tmp_path / "scene" / "images" / folder).mkdir(parents=True, exist_ok=True)
    write_pictures(tmp_path / "scene" / "images", views, opaque=True)
    read = colmap.load_views(tmp_path / "scene" / "sparse" / "0")
    assert [item.name for item in read[:5]] == [*(f"000{i}.png" for i in range(3)), "cam1/0000.png", "cam1/0001.png"]
    expected = [f"000{i}{end}" for end in ("", "_2", "_3", "_4") for i in range(3)]
    assert [item.view.name for item in read] == expected
    for item in read:
        (of_file,) = (v for v in views if f"{v.name}.png" == item.name)
        torch.testing.assert_close(item.view.w2c, of_file.w2c)
    small = "--no-evaluate --iterations 1 --sh-degree 0 --test-every 3"
    assert commands.train(tmp_path / "scene", tmp_path / "out", small) == 0
    assert commands.evaluate(tmp_path / "out", "--pictures 4") == 0
    tested = expected[::3]
    cameras = io.load_views(tmp_path / "out" / files.CAMERAS)
    assert [view.name for view in cameras] == [name for name in expected if name not in tested]
    assert json.loads((tmp_path / "out" / "evaluation.json").read_text())["views"] == tested
    drawn = (tmp_path / "out" / "evaluation").glob("*.png")
    assert sorted(path.stem for path in drawn) == [f"moment_samples_4_1_{name}" for name in tested]


def one_view(folder, write, change=lambda view: None):
    """A reconstruction of one picture and two points."""
    view = io.View("a", 40, 30, 50.0, 50.0, looking_at_origin(0.1))
    change(view)
    write(folder, [view], torch.zeros(2, 3), torch.zeros(2, 3, dtype=torch.int32))


def read_part(folder, name):
    return colmap.load_points(folder) if name == "points3D" else colmap.load_views(folder)


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
def test_colmap_files_cut_short(tmp_path, name):
    one_view(tmp_path / "0", write_colmap)
    path = tmp_path / "0" / f"{name}.bin"
    whole = path.read_bytes()
    for size in range(0, len(whole), 3):
        path.write_bytes(whole[:size])
        with pytest.raises(io.SceneError, match=rf"{name}.bin: cut short"):
            read_part(tmp_path / "0", name)


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
def test_colmap_text_cut_short(tmp_path, name):
    """A last line with words missing, as many as make it useless."""
    one_view(tmp_path / "0", write_colmap_text)
    path = tmp_path / "0" / f"{name}.txt"
    words = path.read_text().splitlines()[1].split()
    for count in range(1, min(len(words), 7)):
        path.write_text(" ".join(words[:count]) + "\n")
        with pytest.raises(io.SceneError, match="cut short"):
            read_part(tmp_path / "0", name)


@pytest.mark.parametrize(
    "camera, message",
    [
        ("1 PINHOLE 100 80 50 51 49 40 7", "expected 6 numbers of a PINHOLE camera, got 7"),
        ("1 PINHOLE nan 80 50 51 49 40", "expected width and height in pixels, got nan 80"),
        ("1 PINHOLE 100.7 80 50 51 49 40", "expected width and height in pixels, got 100.7 80"),
    ],
)
def test_wrong_cameras_of_a_colmap_text(tmp_path, camera, message):
    one_view(tmp_path / "0", write_colmap_text)
    (tmp_path / "0" / "cameras.txt").write_text(camera + "\n")
    with pytest.raises(io.SceneError, match=message):
        colmap.load_views(tmp_path / "0")


@WRITERS
def test_colmap_poses_that_are_not_finite(tmp_path, write):
    one_view(tmp_path / "0", write, lambda view: view.w2c[0, 3].fill_(math.nan))
    with pytest.raises(io.SceneError, match=r"the pose of a.png must be finite"):
        colmap.load_views(tmp_path / "0")


@pytest.mark.parametrize("name, count, points", [("bonsai", 292, 82_641), ("fox", 50, None)])
def test_capture_is_read_as_it_was_taken(name, count, points):
    """Points have the colours of the pixels that they project to: cameras, cut and pictures belong together."""
    folder = SHARED / "data" / name
    if not folder.exists():
        pytest.skip("needs the optional ../shared scenes next to the project")
    capture = training.load_capture(folder)
    means, colors = capture.points
    assert len(capture.train) + len(capture.test) == count and len(means) == (points or len(means))
    item = capture.train[8]
    view, rgba, _ = pictures.fitted(photographs.read_picture(item.files[1]), item, 16)
    assert rgba.shape == (view.height, view.width, 4) and view.height % 16 == view.width % 16 == 0
    stages = render_stages(view.settings(), **point_inputs(means))
    colors = colors[stages.ids.long()]

    def error(shift) -> float:
        """Median over the points; those hidden by others are in it too."""
        x, y = (stages.means2d + torch.tensor(shift)).round().long().unbind(1)
        inside = (x >= 0) & (x < view.width) & (y >= 0) & (y < view.height)
        assert inside.sum() > 2000
        return (rgba[y[inside], x[inside], :3] / 255 - colors[inside]).abs().mean(1).median().item()

    for shift in ([2.0, 0.0], [-2.0, 0.0], [0.0, 2.0], [0.0, -2.0]):
        assert error([0.0, 0.0]) < 0.85 * error(shift)


def point_inputs(means) -> dict:
    count = len(means)
    return {
        "means3D": means,
        "opacities": torch.ones(count, 1),
        "colors_precomp": torch.ones(count, 3),
        "scales": torch.full((count, 3), 1e-3),
        "rotations": torch.eye(4)[:1].repeat(count, 1),
    }


def test_nerf_synthetic_folder(synthetic):
    found = training.load_capture(synthetic)
    assert (len(found.train), len(found.test), found.background, found.points) == (10, 3, loading.WHITE, None)
    for item, expected in zip(found.train, circle(10)):
        assert item.files == {1: synthetic / "train" / f"{expected.name}.png"}
        torch.testing.assert_close(item.view.w2c, expected.w2c)
        assert item.view.fx == pytest.approx(36.0)


def test_colmap_folder(capture):
    found = training.load_capture(capture, "photographs")
    assert [item.view.name for item in found.test] == ["r_0", "r_8"]
    assert len(found.train) == 7 and found.background == loading.BLACK and found.points[0].shape == (60, 3)
    assert len(training.load_capture(capture, "photographs", test_every=0).train) == 9


def write_nerfstudio(folder, change=lambda content: None) -> None:
    views = circle(9, (35, 33))
    write_pictures(folder / "images", views, opaque=True)
    frames = [{"file_path": f"images/{v.name}.png", "transform_matrix": opengl_pose(v)} for v in views]
    content = {"w": 35, "h": 33, "fl_x": 36.0, "fl_y": 36.0, "cx": 17.0, "cy": 16.0, "frames": frames}
    change(content)
    (folder / "transforms.json").write_text(json.dumps(content))


def write_points(path, rows, kind="float", colors=None):
    """A .ply in ASCII of rows of x, y, z, and where their type is given of red, green, blue."""
    columns = [(kind, axis) for axis in "xyz"] + [(colors, name) for name in ("red", "green", "blue") if colors]
    path.write_bytes(ply(Element("vertex", columns, rows), layout="ascii"))


def test_nerfstudio_folder(tmp_path):
    # As nerfstudio writes it for pictures without distortion.
    zeros = {"camera_model": "OPENCV", "k1": 0.0, "k2": 0, "p1": 0.0, "p2": -0.0, "distortion_params": [0.0] * 6}
    write_nerfstudio(tmp_path, lambda content: content.update(zeros, is_fisheye=False))
    write_points(tmp_path / "sparse_pc.ply", [[0, 1, 2, 255, 0, 51], [3, 4, 5, 0, 255, 0]], colors="uchar")
    found = training.load_capture(tmp_path)
    assert [item.view.name for item in found.test] == ["r_0", "r_8"] and len(found.train) == 7
    assert found.train[0].view.cx == 17.0
    points, colors = found.points
    assert points.tolist() == [[0, 1, 2], [3, 4, 5]]
    torch.testing.assert_close(colors, torch.tensor([[1.0, 0.0, 0.2], [0.0, 1.0, 0.0]]))


def test_nerfstudio_names_its_points(tmp_path):
    write_points(tmp_path / "sparse_pc.ply", [[9, 9, 9]])
    (tmp_path / "points").mkdir()
    write_points(tmp_path / "points" / "of_colmap.ply", [[0, 1, 2]])
    write_nerfstudio(tmp_path, lambda content: content.update(ply_file_path="points/of_colmap.ply"))
    assert training.load_capture(tmp_path).points[0].tolist() == [[0, 1, 2]]
    for wrong in ("points/others.ply", 3):
        write_nerfstudio(tmp_path, lambda content, wrong=wrong: content.update(ply_file_path=wrong))
        with pytest.raises(io.SceneError, match=f"ply_file_path must name a file beside it, got {wrong!r}"):
            training.load_capture(tmp_path)
    without = loading.load_photographs(tmp_path)  # which reads no points
    assert (len(without.train), len(without.test), without.points) == (7, 2, None)


@pytest.mark.parametrize(
    "lists, train, test",
    [
        ({"train": (1, 2, 3), "val": (4, 5), "test": (0, 8)}, (1, 2, 3), (0, 8)),
        ({"train": (7, 6, 5), "val": (0,), "test": ()}, (5, 6, 7), (0,)),
        ({"val": (3,), "test": (4, 5)}, (0, 1, 2, 6, 7, 8), (4, 5)),
        ({"train": (0, 2)}, (0, 2), ()),
        ({"train": (), "test": ()}, (1, 2, 3, 4, 5, 6, 7), (0, 8)),
    ],
)
def test_nerfstudio_lists_of_pictures(tmp_path, lists, train, test):
    """Written with and without ./ before them, for the frames are too, and in any order."""
    names = {f"{split}_filenames": [f"./images/r_{i}.png" for i in chosen] for split, chosen in lists.items()}
    write_nerfstudio(tmp_path, lambda content: content.update(names))
    found = training.load_capture(tmp_path)
    assert [item.view.name for item in found.train] == [f"r_{i}" for i in train]
    assert [item.view.name for item in found.test] == [f"r_{i}" for i in test]


@pytest.mark.parametrize(
    "lists, message",
    [
        (
            {"train_filenames": ["images/r_1.png", "r_2.png"]},
            "train_filenames must name pictures of the frames, got r_2.png",
        ),
        ({"test_filenames": "images/r_1.png"}, "test_filenames must be a list of names, got 'images/r_1.png'"),
        ({"val_filenames": [1]}, "val_filenames must be a list of names, got [1]"),
    ],
)
def test_nerfstudio_lists_of_other_things(tmp_path, lists, message):
    write_nerfstudio(tmp_path, lambda content: content.update(lists))
    with pytest.raises(io.SceneError) as raised:
        training.load_capture(tmp_path)
    assert str(raised.value) == f"{tmp_path / 'transforms.json'}: {message}"


def test_masks_of_nerfstudio(tmp_path):
    def add_masks(content, name="masks/r.png"):
        for frame in content["frames"][::3]:
            frame["mask_path"] = name

    write_nerfstudio(tmp_path, add_masks)
    with pytest.raises(io.SceneError, match=r"1 of 1 masks that mask_path names are missing, .*r\.png; --masks none"):
        training.load_capture(tmp_path)
    write_grey(tmp_path / "masks", circle(1, (35, 33)), ["r.png"])
    found = training.load_capture(tmp_path)
    assert found.notes == ("3 of 9 photographs have a mask, whose black pixels do not count",)
    masked = [item.view.name for item in (*found.train, *found.test) if item.mask == tmp_path / "masks" / "r.png"]
    assert sorted(masked) == ["r_0", "r_3", "r_6"]
    assert training.load_capture(tmp_path, masks="none").notes == ()
    write_nerfstudio(tmp_path / "other", lambda content: add_masks(content, 3))
    with pytest.raises(io.SceneError, match="frame 0: mask_path must name a picture beside the file, got 3"):
        training.load_capture(tmp_path / "other")


@pytest.mark.parametrize(
    "change, message",
    [
        (
            lambda content: content["frames"][8].update(distortion_params=[0.0, 0.1]),
            "frame 8: a lens of OPENCV must have no coefficients but k1, k2, k3, p1, p2, got distortion_params = [0.0, "
            "0.1];",
        ),
        (lambda content: content.update(k4=0.1), "frame 0: a lens of OPENCV must have no coefficients but"),
        (lambda content: content.update(k1=math.nan), "frame 0: every number of radial must be finite, got nan"),
        (lambda content: content.update(camera_model="FTHETA"), "frame 0: camera_model must be one of SIMPLE_PINHOLE,"),
    ],
)
def test_nerfstudio_cameras_with_other_lenses(tmp_path, capsys, change, message):
    write_nerfstudio(tmp_path / "scene", change)
    error = refused(capsys, commands.train, tmp_path / "scene", tmp_path / "out")
    assert error.startswith(f"error: {tmp_path / 'scene' / 'transforms.json'}: {message}")
    assert not (tmp_path / "out").exists()


def test_multi_scale_blender_folder(tmp_path):
    """Pictures of coarse scales are those that are stored, not those that the finest would give."""
    metadata = {}
    for split, views in (("train", circle(3)), ("test", circle(2))):
        keys = ("file_path", "cam2world", "width", "height", "focal")
        rows = {key: [] for key in keys}
        (tmp_path / split).mkdir()
        for view in views:
            for level in range(3):
                size, name = 32 >> level, f"{split}/{view.name}_d{level}.png"
                values = name, opengl_pose(view), float(size), float(size), view.fx / 2**level
                for key, value in zip(keys, values):
                    rows[key].append(value)
                image.new("RGBA", (size, size), (10 + level, 20, 30, 255)).save(tmp_path / name)
        metadata[split] = rows
    (tmp_path / "metadata.json").write_text(json.dumps(metadata))
    found = training.load_capture(tmp_path)
    assert (len(found.train), len(found.test)) == (3, 2)
    assert [sorted(item.files) for item in found.train] == [[1, 2, 4]] * 3
    loaded = training.load_pictures(found.train, (1, 2, 4), loading.WHITE, "cpu")
    assert [loaded.colors[scale][1][0, 0, 0].item() for scale in (1, 2, 4)] == [10, 11, 12]
    assert [loaded.settings[scale][1].image_width for scale in (1, 2, 4)] == [32, 16, 8]


@pytest.mark.parametrize(
    "key, value, message",
    [
        ("file_path", 3, "file_path must be names of pictures, got 3"),
        ("cam2world", "x", 'cam2world of train/a.png must hold 4 x 4 finite numbers, got "x"'),
        ("width", 0, "width of train/a.png must be a whole number from 1 to 2^20, got 0"),
        ("height", math.inf, "height of train/a.png must be a whole number from 1 to 2^20, got Infinity"),
        ("focal", "far", 'focal of train/a.png must be a positive finite number, got "far"'),
    ],
)
def test_metadata_with_other_things_than_numbers(tmp_path, capsys, key, value, message):
    """Some of them were tracebacks, others named no file."""
    pose = opengl_pose(circle(1)[0])
    rows = {"file_path": ["train/a.png"], "cam2world": [pose], "width": [32.0], "height": [32.0], "focal": [36.0]}
    metadata = {"train": rows | {key: [value]}, "test": rows}
    (tmp_path / "metadata.json").write_text(json.dumps(metadata))
    assert commands.train(tmp_path, tmp_path / "out") == 2
    assert capsys.readouterr().err == f"error: {tmp_path / 'metadata.json'}: {message}\n"


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


@pytest.mark.parametrize("content", ["{}", "[1, 2]", "3", "no JSON"])
def test_metadata_of_another_program_is_passed_over(synthetic, tmp_path, content):
    shutil.copytree(synthetic, tmp_path / "scene")
    (tmp_path / "scene" / "metadata.json").write_text(content)
    assert len(loading.load_capture(tmp_path / "scene").train) == 10
    (tmp_path / "scene" / "transforms_train.json").unlink()
    with pytest.raises(io.SceneError, match=r"metadata\.json: not the metadata of the multi-scale Blender set"):
        loading.load_capture(tmp_path / "scene")


def test_a_list_of_cameras_is_no_capture(tmp_path):
    view = io.View("a", 40, 30, 50.0, 50.0, looking_at_origin(0.1))
    io.save_views(tmp_path / "transforms_train.json", [view])
    io.save_views(tmp_path / "transforms_test.json", [view])
    with pytest.raises(io.SceneError, match=r"transforms_\w+.json: expected a transforms file, .* got a list of"):
        loading.load_capture(tmp_path)


def test_a_ply_that_is_none_is_named(synthetic, tmp_path, capsys):
    (tmp_path / "p.ply").write_text("nothing")
    error = refused(capsys, commands.train, synthetic, tmp_path / "out", "--points", tmp_path / "p.ply")
    assert error.startswith(f"error: {tmp_path / 'p.ply'}: not a PLY file")


def fitted(path, view, multiple):
    return pictures.fitted(photographs.read_picture(path), training.Photograph(view, {1: path}), multiple)[:2]


def test_cut_pictures_see_the_same(tmp_path):
    """What is left of a picture shows a point where it did, in px of the cut; at half the intrinsics' size too."""
    pixels = torch.randint(256, (29, 45, 3), dtype=torch.uint8, generator=torch.Generator().manual_seed(0)).numpy()
    image.fromarray(pixels).save(tmp_path / "a.png")
    view = io.View("a", 45, 29, 50.0, 51.0, looking_at_origin(0.3), cx=20.0)
    cut, rgba = fitted(tmp_path / "a.png", view, 8)
    assert np.array_equal(rgba[..., :3].numpy(), pixels[2:26, 2:42])
    point = torch.tensor([[0.2, -0.3, 0.4]])
    whole, part = (render_stages(v.settings(), **point_inputs(point)).means2d for v in (view, cut))
    torch.testing.assert_close(part, whole - 2, rtol=0, atol=1e-4)
    double = replace(view, width=90, height=58, fx=100.0, fy=102.0, cx=40.0)
    again, _ = fitted(tmp_path / "a.png", double, 8)
    assert again == replace(cut, w2c=again.w2c)
    with pytest.raises(io.SceneError, match="45 x 29 px are too few"):
        fitted(tmp_path / "a.png", view, 32)


def test_pictures_that_were_turned_are_refused(tmp_path):
    """Their cameras were scaled by another factor in x than in y."""
    view = io.View("a", 99, 66, 50.0, 50.0, torch.eye(4, dtype=torch.float64))
    for size in ((66, 99), (33, 49), (17, 25)):
        image.new("RGB", size).save(tmp_path / "a.png")
        with pytest.raises(io.SceneError, match=rf"camera, 99 x 66 px, got {size[0]} x {size[1]}"):
            fitted(tmp_path / "a.png", view, 1)
    for size in ((99, 66), (50, 33), (25, 17), (2, 2), (64, 64), (150, 80)):  # squeezed ones have oblong pixels
        image.new("RGB", size).save(tmp_path / "a.png")
        cut, _ = fitted(tmp_path / "a.png", view, 1)
        assert (cut.width, cut.height) == size


@pytest.mark.parametrize("downsampling", ["box", "blender", "bicubic"])
def test_colors_of_reduced_pictures(downsampling):
    """They count by their alpha, but in the files of the multi-scale Blender set."""
    rgba = torch.tensor([[[255, 0, 0, 255], [0, 255, 0, 0]]], dtype=torch.uint8).repeat(2, 1, 1)
    plain = pictures.reduce(rgba, 1, loading.WHITE, downsampling)[0]
    assert plain[:, 0].T.tolist() == [[255, 0, 0], [255, 255, 255]]
    on_white = pictures.reduce(rgba, 2, loading.WHITE, downsampling)[0][:, 0, 0].tolist()
    premultiplied = pictures.reduce(rgba, 2, None, downsampling)[0][:, 0, 0].tolist()
    if downsampling == "blender":
        assert on_white == [191, 191, 128] and premultiplied == [64, 64, 0, 128]  # 255 (0.5 * 0.5 + 0.5), 128
    else:
        assert on_white == [255, 128, 128] and premultiplied == [128, 0, 0, 128]


@pytest.mark.parametrize("downsampling", ["box", "bicubic"])
@pytest.mark.parametrize("scale", [2, 4])
def test_reduced_pictures_of_one_color_keep_it(downsampling, scale):
    """Whatever the mask: on a background of the same colour nothing is to be seen of it."""
    alpha = torch.randint(256, (16, 24), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    rgba = torch.stack([*torch.full((3, 16, 24), 255, dtype=torch.uint8), alpha], 2)
    rgba[..., :3][alpha == 0] = 0  # as programs store what nobody sees
    assert (pictures.reduce(rgba, scale, loading.WHITE, downsampling)[0] == 255).all()


@pytest.mark.parametrize("scale", [2, 4])
def test_bicubic_reduction_is_that_of_pillow(scale):
    """Within the level of 255 by which Pillow's own rounding between rows and columns may differ."""
    pixels = torch.randint(256, (16, 24, 3), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    rgba = torch.cat([pixels, torch.full((16, 24, 1), 255, dtype=torch.uint8)], dim=2)
    expected = image.fromarray(pixels.numpy()).resize((24 // scale, 16 // scale), image.Resampling.BICUBIC)
    got = pictures.reduce(rgba, scale, loading.BLACK, "bicubic")[0].permute(1, 2, 0)
    assert (got.int() - torch.from_numpy(np.array(expected)).int()).abs().max() <= 1


def test_sixteen_bits_are_rounded_to_eight(tmp_path):
    image.fromarray(np.array([[0, 257 * 100, 65535]], np.uint16)).save(tmp_path / "a.png")
    assert photographs.read_picture(tmp_path / "a.png")[0, :, 0].tolist() == [0, 100, 255]


# ------------------------------------------------------------------------ captures of the field: one row each

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
RESAMPLED = r"9 of 9 photographs \(%s\) are resampled to pinholes, for tests too, and lose \d+\.\d"
IN_VIEW = {"starts_in_view": True, "points": None}
FUTURE = b"77 HYPERBOLIC 9 9 1 2 3 4 5 6 7\n"
WINDOWS = {"frames": frames("images\\{}.png"), "test_filenames": [".\\images\\r_4.png"]}
PLACE = (500000.0, 4200000.0, 120.0)

# What a capture is like, and how it is written. Nothing is said of these.
PLAIN = {
    "pinholes": write,
    "one focal length": lambda f: write(f, "SIMPLE_PINHOLE"),
    "opencv without distortion": lambda f: write(f, "OPENCV"),
    "a distorted camera that no picture uses": lambda f: with_unused(f, "OPENCV"),
    "a model that is refused, which no picture uses": lambda f: with_unused(f, "EUCM"),
    "a model of the future that no picture uses": lambda f: as_text(f, lambda text: text + FUTURE, "cameras"),
    "byte order marks": lambda f: as_text(f, lambda text: b"\xef\xbb\xbf" + text.split(b"\n", 1)[1]),
    "line ends of Windows": lambda f: as_text(f, lambda text: text.replace(b"\n", b"\r\n")),
    "a text without lines of observations": lambda f: as_text(f, lines_of_pictures, "images"),
    "spaces in names": lambda f: named(f, "IMG {0} 2 3.png", writer=write_colmap_text),
    "names in other scripts": lambda f: named(f, "猫 é {0}.png"),
    "another spelling of a letter": lambda f: named(f, "\u00e9{0}.png", "e\u0301{0}.png"),
    "names that are no UTF-8": lambda f: named(f, "\udce9{0}.png"),
    "upper-case suffixes": lambda f: named(f, "DSC{0}.JPG"),
    "suffixes in another case": lambda f: named(f, "DSC{0}.JPG", "dsc{0}.jpg"),
    "other suffixes": lambda f: named(f, "{0}.jpg", "{0}.png"),
    "pictures in folders": lambda f: named(f, "cam{1}/{2}.png"),
    "folders with backslashes": lambda f: named(f, "cam{1}\\{2}.png", "cam{1}/{2}.png"),
    "a capture just large enough": lambda f: smaller(f, 0.1),
    "other files beside a model": lambda f: [write(f), spoilt(f, "rigs.bin", "frames.bin", "project.ini")],
    "a transforms.json of Windows": lambda f: only_transforms(f, **WINDOWS),
    "a transforms.json of another machine": lambda f: only_transforms(f, frames=frames("D:\\scans\\images\\{}.png")),
}
# The cameras of these are rendered with the lens that they have.
LENSES = {
    "simple radial": lambda f: write(f, "SIMPLE_RADIAL", [-0.1]),
    "radial": lambda f: write(f, "RADIAL", [0.1, -0.05]),
    "opencv": lambda f: write(f, "OPENCV", [0.05, -0.02, 1e-3, -1e-3]),
    "full opencv": lambda f: write(f, "FULL_OPENCV", [0.1, 0, 1e-3, 0, 0.1, 0.2, 0, 0], write_colmap_text),
    "a camera per picture, of two sizes": of_two_sizes,
    "wild distortion": lambda f: write(f, "OPENCV", [0.3, -59, 0, 0]),
    "a transforms.json of a lens": lambda f: only_transforms(f, camera_model="OPENCV", k1=0.1, k2=-0.02, p1=1e-3),
    "a transforms.json of another program": lambda f: only_transforms(f, k1=0.1, k2=0.01),
}
# Something else is noted of these.
NOTED = {
    "a fisheye": (lambda f: write(f, "OPENCV_FISHEYE", [0.01, 0, 0, 0]), EXACT % "fisheye"),
    "masks": (masked, "9 of 9 photographs have a mask, whose black pixels do not count"),
    "several models": (
        lambda f: models(f, [3, 9, 5]),
        "cameras are those of sparse/1; --cameras takes sparse/0 or sparse/2 instead",
    ),
    "models of the same size": (lambda f: models(f, [9, 9]), "those of sparse/0; --cameras takes sparse/1"),
    "a broken model beside a good one": (
        lambda f: [models(f, [9, 9]), spoilt(f, "images.bin")],
        "cameras are those of sparse/1; --cameras takes sparse/0 instead",
    ),
    "a transforms.json beside pinholes": (
        lambda f: [write(f), beside(f)],
        "cameras are those of sparse/0; --cameras takes transforms.json instead",
    ),
    "a pinhole transforms.json beside a lens": (
        lambda f: [write(f, "OPENCV", [0.1, 0, 0, 0]), beside(f)],
        "cameras are those of transforms.json; --cameras takes sparse/0 instead",
    ),
    "a pinhole transforms.json beside a model that is refused": (
        lambda f: [write(f, "EUCM"), beside(f)],
        "passed over: .*sparse/0/cameras: camera 1 is EUCM",
    ),
    "two descriptions of one lens": (
        lambda f: [write(f, "OPENCV", [0.1, 0, 0, 0]), beside(f, k1=0.1)],
        "cameras are those of sparse/0; --cameras takes transforms.json instead",
    ),
    "a broken transforms.json beside pinholes": (
        lambda f: [write(f), (f / "transforms.json").write_text("{")],
        "passed over: .*transforms.json: not valid JSON",
    ),
}
ALL_MODELS = {model.name: write_colmap_text if model.name == "EUCM" else write_colmap for model in colmap.MODELS}
FEW = "training needs at least 2 pictures, got 1 of 2, .*; --test-every 0 trains with all"
# What comes of others: an error as text, or what has to hold: "notes" and "warns" are patterns, other words members of
# the Capture.
FOUND = {
    **{name: (writes, {"notes": ()}) for name, writes in PLAIN.items()},
    **{name: (writes, {"notes": EXACT % "perspective"}) for name, writes in LENSES.items()},
    **{name: (writes, {"notes": note}) for name, (writes, note) in NOTED.items()},
    "not finite distortion": (
        lambda f: write(f, "SIMPLE_RADIAL", [math.nan]),
        r"sparse/0/cameras: camera 1 \(SIMPLE_RADIAL\): every number of radial must be finite, got nan",
    ),
    **{
        name: (
            lambda f, name=name, writer=writer: write(f, name, writer=writer),
            f"sparse/0/cameras: camera 1 is {name}; rendered are SIMPLE_PINHOLE, .*image_undistorter",
        )
        for name, writer in ALL_MODELS.items()
        if name not in io.lenses.NAMES
    },
    "a model of the future": (
        lambda f: with_unused(f, "OPENCV", number=99),
        "cameras.bin: camera 77 has a model that is not known here, number 99",
    ),
    "missing pictures": (
        lambda f: without(f, "images/r_3.png", "images/r_5.png"),
        r"2 of 9 pictures are missing, the first is .*r_3.png; --missing skip leaves them out",
    ),
    "no folder of pictures": (
        lambda f: [write(f), moved(f, "images", "input")],
        r"images: no such folder; --images NAME takes another folder \(input with pictures\)",
    ),
    "no points": (lambda f: without(f, "sparse/0/points3D.bin"), IN_VIEW),
    "no points as text": (lambda f: without(f, "sparse/0/points3D.txt", writer=write_colmap_text), IN_VIEW),
    "empty points": (lambda f: [write(f), spoilt(f, "points3D.bin", content=bytes(8))], IN_VIEW),
    "a capture in kilometres": (
        lambda f: smaller(f, 1e-2),
        {"warns": r"points are 0\.0\d+ from their cameras.*nearer than 0\.2 nothing is drawn.*model_transformer"},
    ),
    "empty points as text": (lambda f: as_text(f, lambda text: b"# none\n", "points3D"), IN_VIEW),
    "a transforms.json without points": (only_transforms, IN_VIEW),
    "two pictures": (lambda f: write(f, views=circle(2, SIZE)), FEW),
    "two pictures in a transforms.json": (lambda f: only_transforms(f, frames=frames("images/{}.png", 2)), FEW),
    **{
        f"masks in {name}": (
            lambda f, name=name: masked(f, name),
            {"ignored_masks": 9, "warns": "9 masks are ignored, all pixels count: masks of photographs belong in"},
        )
        for name in ("images/masks", "images_mask", "dynamic-MASKS/cam0")
    },
    "pictures that are no masks": (lambda f: masked(f, "unmasked"), {"ignored_masks": 0, "notes": ()}),
    "masks of a transforms.json": (
        lambda f: [masked(f), beside(f), shutil.rmtree(f / "sparse")],
        {"ignored_masks": 9, "warns": "9 masks are ignored"},
    ),
    "a model elsewhere": (
        lambda f: [write(f), moved(f, "sparse", "distorted/sparse"), moved(f, "images", "input")],
        r"expected transforms_train.json.*there is a reconstruction in distorted/sparse/0 "
        r"\(--cameras distorted/sparse/0, --images FOLDER\)",
    ),
    "nothing": (lambda f: f.mkdir(), r"expected transforms_train.json, .* in sparse/0$"),
    "models that are refused in both": (
        lambda f: [write(f, "EUCM"), beside(f, camera_model="EUCM")],
        "camera 1 is EUCM",
    ),
    "geographic coordinates": (
        far,
        {"offset": PLACE, "notes": r"positions are stored relative to \(500000, 4200000, 120\)"},
    ),
    "geographic coordinates as text": (lambda f: far(f, writer=write_colmap_text), {"offset": PLACE}),
    "a scene beside zero": (lambda f: far(f, (20.0, 100.0, -30.0)), {"offset": None, "notes": ()}),
    "a half turn": (lambda f: with_exif(f, 3), {"warns": r"EXIF says to turn or mirror 4 pictures.*\.png, \.\.$"}),
    "a quarter turn": (lambda f: with_exif(f, 6, (48, 32)), {}),
    "a quarter turn of a square": (
        lambda f: with_exif(f, 8, (32, 32)),
        {"warns": "EXIF says to turn or mirror 4 pict"},
    ),
    "upright": (lambda f: with_exif(f, 1), {}),
}


@pytest.mark.parametrize("case", FOUND)
def test_captures_of_the_field(tmp_path, case):
    """Every capture is read and can be trained on, or a sentence says why not."""
    writes, expected = FOUND[case]
    folder = tmp_path / "scene"
    writes(folder)
    if isinstance(expected, str):
        with pytest.raises(io.SceneError, match=expected) as raised:
            training.load_capture(folder)
        assert str(folder) in str(raised.value)
        return
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        found = training.load_capture(folder)
        photographs = [*found.train, *found.test]
        loaded = training.load_pictures(photographs, (1,), found.background, "cpu")
    told = [str(warning.message) for warning in told]
    pattern = expected.get("warns")
    assert bool(told) == (pattern is not None) and all(re.search(pattern, text) for text in told), told
    assert len(photographs) == 9 and len(found.test) >= 1
    for view, settings in zip(loaded.views, loaded.settings[1]):
        assert (settings.image_width, settings.image_height) == (view.width, view.height)
    # In the world the cameras are where they were written.
    written = {view.name: view for view in circle(9, SIZE)}
    for item in photographs:
        if item.view.name in written and found.offset is None and "zero" not in case:
            torch.testing.assert_close(item.view.w2c, written[item.view.name].w2c, rtol=0, atol=1e-6)
    for name in ("notes", "offset", "ignored_masks", "starts_in_view"):
        if name == "notes" and isinstance(expected.get(name), str):
            assert any(re.search(expected[name], note) for note in found.notes), found.notes
        elif name in expected:
            assert getattr(found, name) == expected[name]
    if "points" in expected:
        assert found.points is None
    elif "transforms" not in case:
        assert found.points[0].shape == (40, 3) and found.points[0].dtype == torch.float32


def test_cameras_and_pictures_that_are_chosen(tmp_path):
    """What a message offers is there."""
    write(tmp_path, "OPENCV", [0.1, 0, 0, 0])
    beside(tmp_path)
    models(tmp_path / "several", [3, 9])
    moved(tmp_path, "several/sparse/0", "distorted/sparse/0")
    assert training.load_capture(tmp_path, cameras="sparse/0").train[0].view.lens is not None
    assert training.load_capture(tmp_path, cameras="transforms.json").train[0].view.lens is None
    few = training.load_capture(tmp_path, cameras="distorted/sparse/0")
    assert len(few.train) == 2 and few.notes == ()
    for wrong in ("sparse/7", "distorted"):
        with pytest.raises(io.SceneError, match=f"{wrong}: (no such file|expected COLMAP's cameras)"):
            training.load_capture(tmp_path, cameras=wrong)


def test_of_a_part_of_a_capture_the_whole_is_named(tmp_path):
    without(tmp_path)
    for name in ("sparse", "sparse/0"):
        with pytest.raises(io.SceneError, match=f"{name}: expected .*; {re.escape(str(tmp_path))} is a capture: name"):
            training.load_capture(tmp_path / name)


def test_too_few_pictures_that_are_there(tmp_path):
    without(tmp_path, *(f"images/r_{i}.png" for i in range(9)))
    counted = r"got 0: 9 of 9 pictures are missing or cannot be read, the first is .*r_\d\.png; --images NAME takes"
    with pytest.raises(io.SceneError, match=rf"training needs at least 2 pictures, {counted}"):
        training.load_capture(tmp_path, missing="skip")


def test_missing_pictures_can_be_left_out(tmp_path):
    without(tmp_path, "images/r_0.png", "images/r_5.png")
    found = training.load_capture(tmp_path, missing="skip")
    assert [item.view.name for item in found.train] == [f"r_{i}" for i in (1, 2, 3, 4, 6, 7)]
    assert [item.view.name for item in found.test] == ["r_8"]
    assert found.notes == ("2 of 9 pictures are missing and left out",)
    with pytest.raises(ValueError, match="missing must be one of refuse, skip, got draw"):
        training.load_capture(tmp_path, missing="draw")


def test_lenses_of_smaller_pictures(tmp_path):
    """Cameras are scaled to their pictures, and lenses are those of directions, which stay."""
    views = [replace(view, fx=150.0, fy=150.0) for view in circle(9, (140, 132))]
    write(tmp_path, "SIMPLE_RADIAL", [-0.1], views=views)
    smaller = [replace(view, width=70, height=66) for view in views]
    write_grey(tmp_path / "images_2", smaller, [f"{view.name}.png" for view in views])
    whole, half = (
        training.load_pictures(
            training.load_capture(tmp_path, images, lens="undistort").train, (1,), loading.BLACK, "cpu"
        ).views[0]
        for images in ("images", "images_2")
    )
    assert whole.lens is half.lens is None
    assert half.fx == whole.fx / 2 and abs(half.width - whole.width / 2) <= 1 and whole.width > 140
    assert abs(half.cx - whole.cx / 2) <= 1
    found = training.load_capture(tmp_path, "images_2").train
    (exact,) = training.load_pictures(found[:1], (1,), loading.BLACK, "cpu").views
    assert (exact.width, exact.height, exact.fx) == (70, 66, 75.0) and exact.lens == ar.Lens.perspective((-0.1,))


def test_lenses_can_be_refused(tmp_path):
    write(tmp_path, "SIMPLE_RADIAL", [-0.1])
    with pytest.raises(io.SceneError, match=r"9 of 9 photographs have a lens, .*\(perspective\)"):
        training.load_capture(tmp_path, lens="refuse")
    with pytest.raises(ValueError, match="lens must be one of keep, undistort, refuse, got exact"):
        training.load_capture(tmp_path, lens="exact")


def test_a_lens_that_cannot_be_undistorted(tmp_path):
    write(tmp_path, "OPENCV", [0.3, -59, 0, 0])
    with pytest.raises(
        io.SceneError, match=r"r_\d.png: the perspective lens is too wide: \d+% .*leave out --lens undi"
    ):
        training.load_capture(tmp_path, lens="undistort")


def test_reconstructions_of_new_versions_of_colmap(tmp_path):
    """With rigs and frames beside cameras and images, as its own program writes them."""
    pycolmap = pytest.importorskip("pycolmap", reason="writes a reconstruction")
    write(tmp_path, "SIMPLE_RADIAL", [-0.1], lambda f, v, *rest: write_colmap_text(f, v, POINTS[:0], COLORS, *rest[2:]))
    before = training.load_capture(tmp_path)
    model = tmp_path / "sparse" / "0"
    reconstruction = pycolmap.Reconstruction(str(model))
    for point, color in zip(POINTS.double().numpy(), COLORS.numpy()):
        reconstruction.add_point3D(point, pycolmap.Track(), color.astype(np.uint8))
    shutil.rmtree(model)
    for written in (reconstruction.write_binary, reconstruction.write_text):
        model.mkdir()
        written(str(model))
        assert any(path.name.startswith("rigs") for path in model.iterdir())
        again = training.load_capture(tmp_path)
        for a, b in zip(before.train, again.train):
            assert a.view.lens == b.view.lens and a.files == b.files
            torch.testing.assert_close(a.view.w2c, b.view.w2c, rtol=0, atol=1e-9)
        torch.testing.assert_close(again.points[0].sort(0).values, POINTS.sort(0).values)
        shutil.rmtree(model)


def test_far_captures_are_those_at_zero(tmp_path):
    """In float64 until the offset is off: views and points are those of the same capture at the origin."""
    far(tmp_path / "far")
    write(tmp_path / "near")
    there, here = training.load_capture(tmp_path / "far"), training.load_capture(tmp_path / "near")
    for a, b in zip(there.train, here.train):
        torch.testing.assert_close(a.view.w2c, b.view.w2c, rtol=0, atol=1e-8)
        assert a.view.offset == (500000.0, 4200000.0, 120.0)
    torch.testing.assert_close(there.points[0], here.points[0], rtol=0, atol=1e-6)
    # An offset that is given is taken, that of the world too.
    given = training.load_capture(tmp_path / "far", offset=(500001.0, 4200000.0, 120.0))
    torch.testing.assert_close(given.points[0], here.points[0] - torch.tensor([1.0, 0, 0]), rtol=0, atol=1e-6)
    world = training.load_capture(tmp_path / "far", offset=(0.0, 0.0, 0.0))
    assert world.offset is None and world.points[0][0, 0] > 4e5


def train(folder, out, *extra) -> int:
    return commands.train(folder, out, "--sh-degree 0 --no-evaluate", *extra)


def test_files_of_a_far_training_have_one_frame(tmp_path, capsys):
    """Scene and cameras name their offset, a resumed training and the test take it, and the result is that at zero."""
    scenes = {}
    for name, writes in (("far", far), ("near", write)):
        writes(tmp_path / name)
        write_pictures(tmp_path / name / "images", circle(9, SIZE), opaque=True)
        out = tmp_path / f"{name}_out"
        assert train(tmp_path / name, out, "--iterations", "30") == 0
        assert commands.evaluate(out, "--data", tmp_path / name) == 0
        scenes[name] = io.load_scene(out / files.SCENE), io.load_views(out / files.CAMERAS)
        result = json.loads((out / "evaluation.json").read_text())["results"]["moment:samples=4"]["mean"]["psnr"]
        scenes[name] += (result,)
    offset = (500000.0, 4200000.0, 120.0)
    out = tmp_path / "far_out"
    assert io.read_metadata(out / files.SCENE).offset == offset
    assert io.read_metadata(tmp_path / "near_out" / files.SCENE).offset is None
    torch.testing.assert_close(scenes["far"][0].means, scenes["near"][0].means, rtol=0, atol=1e-5)
    assert scenes["far"][2] == pytest.approx(scenes["near"][2], abs=0.1)
    for a, b in zip(scenes["far"][1], scenes["near"][1]):
        assert a.offset == offset and b.offset is None
        torch.testing.assert_close(a.w2c, b.w2c, rtol=0, atol=1e-6)
    assert "relative to (500000, 4200000, 120)" in capsys.readouterr().err
    assert train(tmp_path / "far", out, "--resume") == 0
    # A start from a scene or from points in the world comes to the same places.
    write_points(tmp_path / "world.ply", [[500000.25, 4200000.5, 120.125], [500001, 4200000, 119]], "double")
    capture = training.load_capture(tmp_path / "far")
    first, _ = first_gaussians(training.TrainingOptions(), capture, tmp_path / "world.ply")
    assert first.means.tolist() == [[0.25, 0.5, 0.125], [1, 0, -1]]
    again, _ = first_gaussians(training.TrainingOptions(), capture, out / files.SCENE)
    assert torch.equal(again.means, scenes["far"][0].means)
    moved_capture = capture._replace(offset=(500001.0, 4200000.0, 120.0))
    again, _ = first_gaussians(training.TrainingOptions(), moved_capture, out / files.SCENE)
    torch.testing.assert_close(again.means, scenes["far"][0].means - torch.tensor([1.0, 0, 0]), rtol=0, atol=1e-6)


def test_a_checkpoint_without_an_offset_stays_in_the_world(tmp_path):
    """Earlier versions had none."""
    far(tmp_path / "far", (20.0, 100.0, -30.0))
    assert train(tmp_path / "far", tmp_path / "out", "--iterations", "2") == 0
    path = tmp_path / "out" / files.CHECKPOINT
    state = torch.load(path, weights_only=True)
    assert state["source"].pop("offset") is None and state["source"].pop("lens") == "keep"
    assert state["source"].pop("cameras") is None
    torch.save(state, path)
    assert train(tmp_path / "far", tmp_path / "out", "--resume") == 0
    resumed = training.Run(tmp_path / "far", tmp_path / "out", resume=True)
    assert resumed.source["offset"] is None and resumed.source["lens"] == "keep"
    with pytest.raises(ValueError, match="lens must be keep or None where a training is resumed, got refuse"):
        training.Run(tmp_path / "far", tmp_path / "out", resume=True, lens="refuse")


def notes_of(said: str) -> list[str]:
    """What a training says after the lines of its effects and before those of its steps."""
    lines = [line for line in said.splitlines() if "step" not in line]
    last = next(place for place, line in enumerate(lines) if line.startswith("--effects auto takes"))
    return lines[last + 1 :]


def test_what_was_chosen_is_said(tmp_path, capsys):
    """Each in a line, by the training and by the test."""
    write(tmp_path / "scene", "SIMPLE_RADIAL", [-0.1])
    (tmp_path / "scene" / "sparse" / "0" / "points3D.bin").unlink()
    assert train(tmp_path / "scene", tmp_path / "kept", "--iterations", "1", "--random-points", "50") == 0
    said = notes_of(capsys.readouterr().err)
    assert re.search(EXACT % "perspective", "\n".join(said))
    assert said[-1] == "no points in the capture: starts from 50 random ones in the views (--points)"
    assert said[-2].startswith("at most 1,000 Gaussians, one for 16 pixels of ") and len(said) == 3
    assert all(view.lens is not None for view in io.load_views(tmp_path / "kept" / "cameras.json"))
    assert commands.evaluate(tmp_path / "kept") == 0
    assert json.loads((tmp_path / "kept" / "evaluation.json").read_text())["resampled"] == 0
    assert re.search(EXACT % "perspective", capsys.readouterr().err)
    options = ["--lens", "undistort", "--iterations", "1", "--random-points", "50"]
    assert train(tmp_path / "scene", tmp_path / "out", *options) == 0
    said = notes_of(capsys.readouterr().err)
    assert re.search(RESAMPLED % "perspective", "\n".join(said)) and len(said) == 3
    assert commands.evaluate(tmp_path / "out") == 0
    assert re.search(RESAMPLED % "perspective", capsys.readouterr().err)
    assert json.loads((tmp_path / "out" / "evaluation.json").read_text())["resampled"] == 2
    options = ["--lens", "refuse", "--random-points", "50"]
    assert train(tmp_path / "scene", tmp_path / "other", *options) == 2
    assert capsys.readouterr().err.count("\n") == 1 and not (tmp_path / "other").exists()


@pytest.mark.parametrize("where", [(0, 0, 0), (300, -200, 100)])
def test_random_points_are_where_the_cameras_look(where):
    """For cameras around a place, side by side, and at one place, whatever the origin and the unit."""
    around = circle(12)
    beside = [io.View(f"{i}", 32, 32, 36.0, 36.0, looking_at_origin(0.0)) for i in range(9)]
    for i, view in enumerate(beside):
        view.w2c[0, 3] = 0.02 * i
    one_place = [io.View(f"{i}", 32, 32, 36.0, 36.0, looking_at_origin(0.5 * i, 0.0)) for i in range(9)]
    for views, farthest in ((around, 20.0), (beside, 20.0), (one_place, 10.0)):
        views = [view.in_frame(tuple(-float(number) for number in where)) for view in views]
        points, colors = placement.points_in_view(views, 500, seed=0)
        assert points.shape == colors.shape == (500, 3) and points.dtype == torch.float32
        w2c = torch.stack([view.w2c for view in views])
        seen = points.double() @ w2c[:, :3, :3].mT + w2c[:, None, :3, 3]
        x, y, z = seen.unbind(2)
        inside = (z > 0) & ((36 * x / z).abs() <= 16.01) & ((36 * y / z).abs() <= 16.01)
        assert inside.any(0).all()
        distances = (points.double() - torch.tensor(where, dtype=torch.float64)).norm(dim=1)
        assert distances.max() < farthest
        assert torch.equal(points, placement.points_in_view(views, 500, seed=0)[0])
    near = placement.points_in_view(around, 500, seed=0)[0].norm(dim=1)
    assert near.median() < 6  # the place that they look at is at zero, 4 from each


def test_the_pictures_of_a_lens_are_those_of_its_pinhole(tmp_path):
    """What is trained on is what a pinhole with the same pose would have seen: the truth, drawn at the cut."""
    lens = ar.Lens.perspective((-0.2,))
    view = io.View("a", 240, 180, 230.0, 230.0, looking_at_origin(0.2), 118.0, 92.0, lens=lens)
    wide = replace(view, lens=None, width=1000, height=800, fx=690.0, fy=690.0, cx=500.0, cy=400.0)
    drawn = torch.from_numpy(draw_picture(wide, opaque=True)).permute(2, 0, 1)[None].double()
    # The photograph: directions of its pixels by inverting the map, colours from a larger picture of the pinhole.
    y, x = np.mgrid[0.5:180, 0.5:240]
    rays = view.rays_of(torch.from_numpy(np.stack([x, y], -1).reshape(-1, 2))).numpy().reshape(180, 240, 3)
    a, b = rays[..., 0] / rays[..., 2], rays[..., 1] / rays[..., 2]
    places = torch.from_numpy(np.stack([2 * (690 * a + 500) / 1000 - 1, 2 * (690 * b + 400) / 800 - 1], -1))[None]
    photograph = torch.nn.functional.grid_sample(drawn, places, align_corners=False)[0].round().to(torch.uint8)
    rgba = torch.cat([photograph, torch.full_like(photograph[:1], 255)]).permute(1, 2, 0)
    found, resampled = undistortion.without_lens(rgba, view)
    expected = draw_picture(found, opaque=True)
    error = (resampled[..., :3].double() - torch.from_numpy(expected)) / 255
    assert -10 * error.square().mean().log10() > 45
    # Half a pixel to the side it is far from that.
    beside = draw_picture(replace(found, cx=found.cx + 0.5), opaque=True)
    assert (resampled[..., :3].double() - torch.from_numpy(beside)).square().mean() > 4 * (255 * error).square().mean()


def test_random_points_of_a_far_nerf_synthetic_scene_are_where_it_is(tmp_path):
    """The cube is where the cameras look, and there the offset is, to a twentieth of their distance."""
    place = (500123.46, 4200456.78, 99.9)
    moved_views = [replace(view.in_frame(tuple(-number for number in place)), offset=None) for view in circle(10)]
    write_nerf_synthetic(tmp_path, circle(10), circle(3))
    for split, views in (("train", moved_views), ("test", moved_views[:3])):
        path = tmp_path / f"transforms_{split}.json"
        content = json.loads(path.read_text())
        for frame, view in zip(content["frames"], views):
            frame["transform_matrix"] = opengl_pose(view)
        path.write_text(json.dumps(content))
    found = training.load_capture(tmp_path)
    assert found.offset == (500123.5, 4200456.8, 99.9) and not found.starts_in_view
    options = training.TrainingOptions(random_points=50)
    start, _ = first_gaussians(options, found, None)
    expected = training.random_points(50, 0)[0].double() + torch.tensor(place, dtype=torch.float64)
    in_world = start.means.double() + torch.tensor(found.offset, dtype=torch.float64)
    torch.testing.assert_close(in_world, expected, rtol=0, atol=1e-5)
    for item, expected in zip(found.train, circle(10)):
        torch.testing.assert_close(item.view.w2c, expected.w2c, rtol=0, atol=0.1)


@pytest.mark.parametrize("background", [None, loading.WHITE, loading.BLACK])
def test_pictures_without_alpha_stay_as_they_are_stored(background):
    """They are not computed; pictures of which one pixel is not opaque are."""
    rgba = torch.randint(0, 256, (7, 9, 4), generator=torch.Generator().manual_seed(0), dtype=torch.uint8)
    rgba[:, :, 3] = 255
    computed = rgba.clone()
    computed[0, 0, 3] = 254
    for downsampling in ("box", "bicubic", "blender"):
        kept, other = (pictures.reduce(picture, 1, background, downsampling)[0] for picture in (rgba, computed))
        assert torch.equal(kept, rgba.permute(2, 0, 1)[: 4 if background is None else 3]) and kept.is_contiguous()
        assert torch.equal(kept[:, 1:], other[:, 1:]) and torch.equal(kept[:, 0, 1:], other[:, 0, 1:])
