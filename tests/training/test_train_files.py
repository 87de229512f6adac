"""What a training writes: the scene, its copy for viewers, and the cameras."""

import commands
import pytest
import torch
import train_extra  # noqa: F401
from capture_files import circle, truth_gaussians

from analytic_rasterizer import io
from analytic_rasterizer.filters import bake_pixel
from analytic_rasterizer.footprints import resolve_footprint
from analytic_rasterizer.gaussians import Gaussians
from analytic_rasterizer.training import files


def test_the_ply_holds_what_was_trained(trained):
    state = files.read_checkpoint(trained / files.CHECKPOINT)
    expected = Gaussians(**state["gaussians"])
    read = io.load_scene(trained / files.SCENE)
    assert read.sh_degree == 1
    for field, wanted in zip(read, expected):
        assert torch.equal(field, wanted)


@pytest.mark.parametrize("footprint, integrated", [("point", False), ("box:samples=4", True), ("mip", True)])
def test_the_ply_says_how_pixels_were_integrated(tmp_path, footprint, integrated):
    scene = truth_gaussians().map(torch.Tensor.detach)
    files.write_scene(tmp_path / "s.ply", scene, footprint)
    assert io.read_metadata(tmp_path / "s.ply").footprint == str(resolve_footprint(footprint))
    assert bool(io.read_metadata(tmp_path / "s.ply").antialiased) == integrated
    assert torch.equal(io.load_scene(tmp_path / "s.ply").means, scene.means)


@pytest.mark.parametrize("filter_3d", [False, True])
def test_the_exported_scene_has_the_pixel_in_it(synthetic, tmp_path, capsys, device, filter_3d):
    small = f"--device {device} --iterations 3 --random-points 60 --sh-degree 1 --no-evaluate --scales 2,1"
    assert commands.train(synthetic, tmp_path, small, "--export mip", *["--filter-3d"] * filter_3d) == 0
    assert f"{tmp_path / files.MIP_SCENE}: for viewers" in capsys.readouterr().out
    said = [io.read_metadata(tmp_path / name) for name in (files.SCENE, files.MIP_SCENE)]
    assert [found.footprint for found in said] == ["moment:samples=4", "point:dilation=0.0"]
    assert said[0].antialiased and not said[1].antialiased  # viewers would account for the pixel a second time
    scene, baked = (io.load_scene(tmp_path / name) for name in (files.SCENE, files.MIP_SCENE))
    cameras = [view.settings() for view in circle(10)]  # of the finest scale
    scales, opacities = bake_pixel(scene.means, scene.scales, scene.rotations, scene.opacities, cameras)
    assert torch.equal(baked.means, scene.means) and torch.equal(baked.shs, scene.shs)
    torch.testing.assert_close(baked.scales, scales, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(baked.opacities, opacities, rtol=1e-4, atol=1e-6)
    assert (baked.scales > scene.scales).all() and (baked.opacities < scene.opacities).all()


def test_cameras_json_gives_the_training_views(trained):
    views = io.load_views(trained / files.CAMERAS)
    assert [view.name for view in views] == [view.name for view in circle(10)]
    for view, expected in zip(views, circle(10)):
        # `looking_at_origin` rounds its rotation to float32, and a file that holds rotations is read as if exact.
        torch.testing.assert_close(view.w2c, expected.w2c, rtol=0, atol=4 * 2**-22)
        assert (view.width, view.height) == (32, 32) and view.fx == pytest.approx(36.0)
