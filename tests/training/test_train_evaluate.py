"""The test of what was trained: the command, the measures, and the example."""

import json
import math
import re
import shutil
import subprocess
import sys

import commands
import numpy as np
import pytest
import torch
from capture_files import circle, looking_at_origin, truth_gaussians, write_nerf_synthetic
from commands import refused
from places import ROOT
from processes import DEADLINE
from runs import cpu_test_pictures
from train_extra import image

from analytic_rasterizer import cli, io, training
from analytic_rasterizer.captures import loading, pictures
from analytic_rasterizer.losses import l1_ssim, ssim
from analytic_rasterizer.training import TrainingOptions, files
from analytic_rasterizer.training.evaluation import evaluate, psnr


def test_evaluate_supersamples_as_the_training_did(synthetic, tmp_path, capsys):
    coarse = "--footprint point --supersampling 4 --scales 4"  # pixels so large that it matters
    assert commands.train(synthetic, tmp_path, "--iterations 3 --random-points 60 --sh-degree 0", coarse) == 0
    expected = json.loads((tmp_path / files.METRICS).read_text())["test"]["mean"]["psnr"]
    measured = []
    for extra in ([], ["--supersampling 4"], ["--supersampling 1"]):
        assert commands.evaluate(tmp_path, *extra) == 0
        results = json.loads((tmp_path / "evaluation.json").read_text())
        measured.append(results["results"]["point:dilation=0.3"]["mean"]["psnr"])
    assert measured[0] == measured[1] == pytest.approx(expected, abs=1e-2)  # the .ply rounds a little
    assert abs(measured[2] - expected) > 0.05
    error = refused(capsys, commands.train, synthetic, tmp_path / "no", "--supersampling 0")
    assert "supersampling must be at least 1, got 0" in error


def test_evaluate_compares_footprints(trained, capsys):
    assert commands.evaluate(trained, "--footprint box:samples=4 point --scales 1,2,4 --pictures 1") == 0
    table = capsys.readouterr().out.splitlines()
    assert table[0].split() == ["footprint", "1/1", "1/2", "1/4", "mean"]
    footprints, measures = ("box:samples=4", "point:dilation=0.3"), ("PSNR", "SSIM", "PSNR,")
    names = [line.split()[:2] for line in table[1:] if line.split()[0] in footprints]
    assert names == [[name, measure] for name in footprints for measure in measures]
    results = json.loads((trained / "evaluation.json").read_text())["results"]
    metrics = json.loads((trained / files.METRICS).read_text())["test"]
    for scale in ("1", "2"):  # the .ply rounds a little
        assert results["box:samples=4"][scale]["psnr"] == pytest.approx(metrics[scale]["psnr"], abs=1e-2)
    drawn = image.open(trained / "evaluation" / "box_samples_4_2_r_0.png")
    assert drawn.size == (3 * 16, 16)
    truth = np.array(drawn)[:, :16]
    assert np.array_equal(truth, cpu_test_pictures_at(trained).colors[2][0].permute(1, 2, 0).numpy())


def refuse_constant(name):
    raise AssertionError(f"{name} is no JSON")


def test_a_picture_without_error_has_a_psnr_that_json_can_hold(tmp_path):
    """Of a camera that looks away from everything: its picture is the background and nothing else."""
    away = looking_at_origin(0.0)
    away[2, 3] = -40
    seen, empty = circle(4), [io.View("away", 32, 32, 36.0, 36.0, away), io.View("seen", 32, 32, 36.0, 36.0, away)]
    write_nerf_synthetic(tmp_path / "scene", seen, empty)
    (tmp_path / "scene" / "test" / "seen.png").unlink()
    shutil.copy(tmp_path / "scene" / "train" / "r_0.png", tmp_path / "scene" / "test" / "seen.png")
    small = "--iterations 1 --sh-degree 0 --random-points 50"
    assert commands.train(tmp_path / "scene", tmp_path / "out", small) == 0
    assert commands.evaluate(tmp_path / "out") == 0
    metrics = json.loads((tmp_path / "out" / files.METRICS).read_text(), parse_constant=refuse_constant)
    evaluation = (tmp_path / "out" / "evaluation.json").read_text()
    of_evaluation = json.loads(evaluation, parse_constant=refuse_constant)["results"]["moment:samples=4"]
    for measured in (metrics["test"], of_evaluation):
        views = measured["1"]["views"]
        assert views[0] == {"psnr": None, "ssim": pytest.approx(1), "psnr_color_corrected": None}
        assert 0 < views[1]["psnr"] < 99
        assert measured["1"]["psnr"] is None and measured["mean"]["psnr"] is None
    files.write_log(tmp_path / files.LOG, [{"step": 10, "psnr": math.inf}, {"step": 20, "psnr": 30.5}])
    assert (tmp_path / files.LOG).read_text() == '{"step": 10, "psnr": null}\n{"step": 20, "psnr": 30.5}\n'


@pytest.mark.parametrize("scales, got", [("1,0", "(1, 0)"), ("-1", "(-1,)")])
def test_evaluate_refuses_scales_that_are_none(trained, capsys, scales, got):
    message = f"scales must be whole numbers of at least 1, got {got}"
    assert refused(capsys, commands.evaluate, trained, f"--scales={scales}") == f"error: {message}\n"
    with pytest.raises(ValueError, match=re.escape(message)):
        training.load_pictures([], tuple(map(int, scales.split(","))), loading.WHITE, "cpu")
    with pytest.raises(ValueError, match=re.escape("got (1.5,)")):
        TrainingOptions(scales=(1.5,))


def cpu_test_pictures_at(trained):
    return cpu_test_pictures(json.loads((trained / files.OPTIONS).read_text())["source"]["scene"])


def test_evaluate_says_how_to_get_the_weights_of_lpips(trained, capsys, monkeypatch, tmp_path):
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    assert cli.main(["evaluate", str(trained), "--pictures", "0"]) == 0
    captured = capsys.readouterr()
    assert "LPIPS is left out" in captured.err and "vgg16-397923af.pth" in captured.err
    assert "LPIPS" not in captured.out


@pytest.mark.parametrize("content", [None, "[]", "{}", '{"source": {}, "options": {}}', '{"source": 3, "options": {}}'])
def test_evaluate_of_another_folder_is_one_line(tmp_path, capsys, content):
    if content is not None:
        (tmp_path / files.OPTIONS).write_text(content)
    assert "options.json" in refused(capsys, commands.evaluate, tmp_path)


def test_evaluate_finds_the_capture_from_another_folder(synthetic, tmp_path, capsys, monkeypatch):
    shutil.copytree(synthetic, tmp_path / "scene")
    monkeypatch.chdir(tmp_path)
    assert commands.train("scene", "out", "--iterations 2 --random-points 50 --no-evaluate") == 0
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert commands.evaluate(tmp_path / "out", "--device cpu") == 0
    # Another capture is named where it is the one without test pictures.
    untested(synthetic, tmp_path / "untested")
    error = refused(capsys, commands.evaluate, tmp_path / "out", "--device cpu --data ../untested")
    assert error == "error: ../untested: there are no test pictures\n"


def untested(synthetic, folder):
    """The capture without test pictures."""
    shutil.copytree(synthetic, folder)
    (folder / "transforms_test.json").unlink()
    return folder


def test_example_trains(synthetic, tmp_path):
    source = (ROOT / "examples" / "train.py").read_text()
    assert "iterations=7000" in source and "(1, 2, 4, 8)" in source
    source = source.replace("iterations=7000", "iterations=3, random_points=50").replace("(1, 2, 4, 8)", "(1, 2)")
    (tmp_path / "train.py").write_text(source)

    def run(folder):
        command = [sys.executable, "train.py", str(folder), "out", "mip"]
        return subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=DEADLINE)

    done = run(synthetic)
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stdout.startswith("mip: PSNR ") and (tmp_path / "out" / "mip" / files.SCENE).exists()
    done = run(untested(synthetic, tmp_path / "untested"))
    assert done.returncode == 1 and done.stderr.endswith("has no test pictures; out/mip has the scene\n")


def test_evaluate_needs_pictures():
    empty = pictures.Pictures([], {1: []}, {1: []}, {1: []})
    with pytest.raises(ValueError, match="pictures must have at least one view, got none"):
        evaluate(truth_gaussians().map(torch.Tensor.detach), empty, "box")


def test_ssim_is_that_of_torchmetrics():
    """Inside, where windows are whole: torchmetrics reflects at the edges, 3DGS's loss has zeros there."""
    functional = pytest.importorskip("torchmetrics.functional", reason="needs the train extra")
    generator = torch.Generator().manual_seed(0)
    truth = torch.rand(3, 40, 48, generator=generator)
    picture = (truth + 0.1 * torch.randn(3, 40, 48, generator=generator)).clamp(0, 1)
    assert ssim(truth, truth).item() == pytest.approx(1, abs=1e-6)
    assert l1_ssim(picture, truth, 0.0).item() == pytest.approx((picture - truth).abs().mean().item())
    assert psnr(truth + 0.1, truth + 0.0) < psnr(picture * 0.5 + truth * 0.5, truth)
    # Zeros around: the same as torchmetrics on pictures with a black frame, but for the frame's own windows.
    pad = torch.nn.functional.pad
    framed = functional.structural_similarity_index_measure(
        pad(picture, [11] * 4)[None], pad(truth, [11] * 4)[None], data_range=1.0, return_full_image=True
    )[1][0, :, 11:-11, 11:-11]
    assert ssim(picture, truth).item() == pytest.approx(framed.mean().item(), abs=1e-5)
