"""Captures far from zero, which are trained relative to an offset."""

import json
from dataclasses import replace

import commands
import pytest
import torch
import train_extra  # noqa: F401
from capture_files import circle, opengl_pose, write_nerf_synthetic, write_pictures
from field_captures import SIZE, far, train, write
from ply_files import write_points

from analytic_rasterizer import io, training
from analytic_rasterizer.training import files
from analytic_rasterizer.training.start import first_gaussians


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
