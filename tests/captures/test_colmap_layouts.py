"""Captures with a reconstruction of COLMAP, in its binary files and as text."""

import json
import math
import shutil
from dataclasses import replace

import commands
import numpy as np
import pytest
import torch
import train_extra  # noqa: F401
from capture_files import circle, looking_at_origin, write_colmap, write_colmap_text, write_pictures
from field_captures import COLORS, POINTS, write

from analytic_rasterizer import io, training
from analytic_rasterizer.captures import colmap, loading
from analytic_rasterizer.training import files

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


def test_colmap_folder(capture):
    found = training.load_capture(capture, "photographs")
    assert [item.view.name for item in found.test] == ["r_0", "r_8"]
    assert len(found.train) == 7 and found.background == loading.BLACK and found.points[0].shape == (60, 3)
    assert len(training.load_capture(capture, "photographs", test_every=0).train) == 9


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
