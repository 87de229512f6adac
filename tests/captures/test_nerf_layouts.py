"""Captures of NeRF-synthetic, of nerfstudio and of the multi-scale Blender set."""

import json
import math
import shutil

import commands
import pytest
import torch
from capture_files import circle, looking_at_origin, opengl_pose, write_pictures
from commands import refused
from field_captures import write_grey
from ply_files import write_points
from train_extra import image

from analytic_rasterizer import io, training
from analytic_rasterizer.captures import loading


def test_nerf_synthetic_folder(synthetic):
    found = training.load_capture(synthetic)
    assert (len(found.train), len(found.test), found.background, found.points) == (10, 3, loading.WHITE, None)
    for item, expected in zip(found.train, circle(10)):
        assert item.files == {1: synthetic / "train" / f"{expected.name}.png"}
        torch.testing.assert_close(item.view.w2c, expected.w2c)
        assert item.view.fx == pytest.approx(36.0)


def write_nerfstudio(folder, change=lambda content: None) -> None:
    views = circle(9, (35, 33))
    write_pictures(folder / "images", views, opaque=True)
    frames = [{"file_path": f"images/{v.name}.png", "transform_matrix": opengl_pose(v)} for v in views]
    content = {"w": 35, "h": 33, "fl_x": 36.0, "fl_y": 36.0, "cx": 17.0, "cy": 16.0, "frames": frames}
    change(content)
    (folder / "transforms.json").write_text(json.dumps(content))


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
