"""The demo: its target, its reference, and the files it writes."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from cli_extra import image

import demo
from analytic_rasterizer import cli, render_stages
from analytic_rasterizer.analysis import reference

SIZE = (96, 64)


@pytest.fixture(scope="module")
def demo_run(tmp_path_factory):
    """(folder, results) of one demo at a small size, without the repeats that steady its times."""
    out = tmp_path_factory.mktemp("demo")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(demo, "REPEATS", 1)
        return out, demo.run(out, SIZE)


def small_view():
    scene, view = demo.make_target()
    zoom = SIZE[0] / view.width
    return scene, replace(view, width=SIZE[0], height=SIZE[1], fx=view.fx * zoom, fy=view.fy * zoom)


def test_target_is_always_the_same():
    (left, _), (right, _) = demo.make_target(), demo.make_target()
    assert all(torch.equal(a, b) for a, b in zip(left[:-1], right[:-1]))
    assert all(field.isfinite().all() for field in left)
    assert 0 < left.opacities.min() <= left.opacities.max() < 1


def test_stamps_land_where_they_are_drawn():
    brush = demo.Brush()
    brush.stamp(torch.tensor([100.0, 300.0]), 60.0, 6.0, 2.0, 0.5, torch.tensor([3.0, 5.0]), (0, 0, 0), 0.9)
    scene, view = brush.scene(), demo.make_target()[1]
    stages = render_stages(view.settings(1, (1, 1, 1), 0, "point"), **scene.arguments())
    # The canvas spans [0, W], pixel centres are at integers.
    expected = torch.tensor([[99.5, 59.5], [299.5, 59.5]])
    torch.testing.assert_close(stages.means2d, expected, rtol=0, atol=1e-3)
    torch.testing.assert_close(stages.depths, torch.tensor([3.0, 5.0]))
    assert stages.radii.tolist() == [19, 19]  # ceil(3 sqrt(6^2 + 0.3))
    dark = 1 - stages.color[0]
    rows, columns = torch.meshgrid(torch.arange(256.0), torch.arange(384.0), indexing="ij")
    columns, rows = columns - 99.5, rows - 59.5
    weight = dark * (columns.abs() < 40)
    products = columns * columns, columns * rows, rows * rows
    sxx, sxy, syy = (((product * weight).sum() / weight.sum()).item() for product in products)
    turn = 0.5 * np.arctan2(2 * sxy, sxx - syy)
    assert turn == pytest.approx(0.5, abs=0.02)  # x towards y


def test_reference_of_a_reduction_is_aligned_with_its_render():
    scene, view = small_view()
    half = replace(view, width=SIZE[0] // 2, height=SIZE[1] // 2, fx=view.fx / 2, fy=view.fy / 2)
    direct = reference.supersampled(scene, half, 8, background=demo.PAPER)
    reduced = demo._reduced(reference.supersampled(scene, view, 4, background=demo.PAPER))[2]
    assert (direct - reduced).abs().max() < 2 / 255
    assert (direct - reduced).abs().mean() < 1e-5


def test_reference_is_converged(demo_run):
    _, results = demo_run
    for reduction, residual in results["reference"]["residual_rmse"].items():
        errors = [p["rmse"] for p in results["pictures"] if str(p["reduction"]) == reduction]
        assert residual <= reference.RMSE_SHARE * min(errors)


def test_errors_are_those_of_the_written_pictures(demo_run):
    out, results = demo_run
    assert json.loads((out / "results.json").read_text()) == results
    assert len(results["pictures"]) == len(demo.COLUMNS) * len(demo.REDUCTIONS)
    for entry in results["pictures"]:
        reduction = entry["reduction"]
        name = entry["footprint"].replace(":samples=", "")
        files = (out / f"{stem}_{reduction}.png" for stem in (name, "reference"))
        picture, truth = (np.asarray(image.open(file)) / 255.0 for file in files)
        assert picture.shape == (SIZE[1] // reduction, SIZE[0] // reduction, 3)
        rounding = 1 / 255  # of both pictures, half a step each
        assert np.sqrt(np.square(picture - truth).mean()) == pytest.approx(entry["rmse"], abs=rounding)
        assert np.abs(picture - truth).max() == pytest.approx(entry["max"], abs=rounding)
        assert entry["psnr"] == pytest.approx(-20 * np.log10(entry["rmse"]))
        assert entry["seconds"] > 0


def test_footprints_rank_as_they_should():
    """Dilation is worst, one weight per splat stops at a floor, `box` goes beyond it, and `moment` beyond that.

    That holds where the pixels resolve the target; far below (1/8) four samples alias.
    """
    scene, view = demo.make_target()
    truth = demo._reduced(reference.supersampled(scene, view, 8, background=demo.PAPER))
    for reduction in (1, 2):
        pictures = {name: demo._render(scene, view, 1 / reduction, name)[0] for name in demo.COLUMNS}
        psnr = {name: demo._errors(picture, truth[reduction])[0] for name, picture in pictures.items()}
        single = {psnr[name] for name in ("mip", "analytic", "cumulant", "box:samples=1")}
        assert psnr["point"] < min(single) - 10
        assert psnr["box:samples=4"] > max(single) + 5
        assert psnr["moment:samples=4"] > psnr["box:samples=4"] + 5


def test_sheet_shows_every_picture(demo_run):
    out, _ = demo_run
    sheet = image.open(out / "contact_sheet.png")
    assert sheet.width > (len(demo.COLUMNS) + 1) * SIZE[0]
    assert sheet.height > len(demo.REDUCTIONS) * SIZE[1]


def test_render_command_repeats_the_demo(demo_run, tmp_path):
    out, _ = demo_run
    background = [str(value) for value in demo.PAPER]
    args = ["render", out / "target.ply", "--views", out / "views.json", "--out", tmp_path]
    args += ["--footprint", "box:samples=4", "--scales", "4", "--device", "cpu", "--background", *background]
    assert cli.main([str(value) for value in args]) == 0
    again = np.asarray(image.open(tmp_path / "target.png")).astype(int)
    first = np.asarray(image.open(out / "box4_4.png"))
    assert np.abs(again - first).max() <= 1  # scales are stored as logarithms, and so rounded


def test_table_of_the_command(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(reference, "MAX_DENSITY", 8)
    monkeypatch.setattr(demo, "REPEATS", 1)
    assert demo.main(["--out", str(tmp_path / "new"), "--size", "48", "32"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split() == [*("scale", "footprint", "PSNR", "[dB]", "RMSE", "max", "time", "[s]")]
    assert len(lines) == 1 + len(demo.COLUMNS) * len(demo.REDUCTIONS) + 2
    assert lines[-1] == f"see {tmp_path / 'new' / 'contact_sheet.png'}"


def test_wrong_arguments_are_one_line(tmp_path, capsys):
    assert demo.main(["--out", str(tmp_path), "--size", "30", "20"]) == 2
    assert capsys.readouterr() == ("", "error: size must be positive multiples of 8, got 30 x 20\n")


@pytest.mark.parametrize("size", [(0, 8), (100, 64), (96, 60), (-8, 8)])
def test_sizes_that_do_not_halve_three_times(tmp_path, size):
    with pytest.raises(ValueError, match="size must be positive multiples of 8, got"):
        demo.run(tmp_path, size)


def test_error_colors_run_from_white_to_dark():
    error = torch.tensor([0.0, demo.ERROR_SPAN, 1.0]).expand(3, 1, 3)
    colors = demo._error_colors(error, 0)[:, 0].T
    assert colors[0].tolist() == [1, 1, 1]
    assert torch.equal(colors[1], colors[2])
    assert colors[1].tolist() == pytest.approx(demo.ERROR_RAMP[-1])
