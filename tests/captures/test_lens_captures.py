"""Captures whose cameras have a lens: kept, undistorted or refused, and what is said of it."""

import json
import re
from dataclasses import replace

import commands
import numpy as np
import pytest
import torch
import train_extra  # noqa: F401
from capture_files import circle, draw_picture, looking_at_origin
from field_captures import EXACT, train, write, write_grey

import analytic_rasterizer as ar
from analytic_rasterizer import io, training
from analytic_rasterizer.captures import loading, undistortion

RESAMPLED = r"9 of 9 photographs \(%s\) are resampled to pinholes, for tests too, and lose \d+\.\d"


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
