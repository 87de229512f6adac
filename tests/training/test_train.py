"""Training: what it reads, what it writes, that it learns, and that nothing is lost where it ends early."""

import functools
import json
import math
import re
import shutil
import signal
import struct
import subprocess
import sys
import zlib
from dataclasses import fields, replace

import commands
import numpy as np
import pytest
import runs
import torch
from capture_files import circle, looking_at_origin, truth_gaussians, write_nerf_synthetic
from commands import refused
from marks import needs_cuda
from places import ROOT
from ply_files import ply, vertices
from processes import DEADLINE
from runs import around_steps, rows_shown, scatter
from train_extra import image
from training_step import TOLERANCE, check_next_step, compared, widened

from analytic_rasterizer import cli, io, optim, training
from analytic_rasterizer.cameras.lens import Lens
from analytic_rasterizer.captures import loading, pictures
from analytic_rasterizer.filters import bake_pixel
from analytic_rasterizer.footprints import resolve_footprint
from analytic_rasterizer.gaussians import Gaussians
from analytic_rasterizer.losses import l1_ssim, ssim
from analytic_rasterizer.render.arguments import camera_arguments
from analytic_rasterizer.render.seam import turn_of
from analytic_rasterizer.training import TrainingOptions, files, schedule
from analytic_rasterizer.training import rendering as g
from analytic_rasterizer.training.evaluation import evaluate, psnr

# -------------------------------------------------------------------------------------- errors


def png_of_size(width: int, height: int) -> bytes:
    """The start of a black PNG, which says its size."""
    header = b"IHDR" + struct.pack(">2I5B", width, height, 1, 0, 0, 0, 0)
    rest = b"IDAT" + zlib.compress(b"")
    parts = [struct.pack(">I", len(part) - 4) + part + struct.pack(">I", zlib.crc32(part)) for part in (header, rest)]
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


def nan_picture(folder) -> None:
    """A floating-point picture where the PNG was: Pillow tells formats by their content."""
    pixels = np.zeros((32, 32), np.float32)
    pixels[3, 7] = np.nan
    image.fromarray(pixels).save(folder / "train" / "r_4.png", format="TIFF")


def of_picture(change):
    """A change of the bytes of one picture."""

    def write(folder):
        path = folder / "train" / "r_1.png"
        path.write_bytes(change(path.read_bytes()))

    return write


def of_transforms(change):
    """A change of what the transforms file of the training says."""

    def write(folder):
        path = folder / "transforms_train.json"
        content = json.loads(path.read_text())
        change(content)
        path.write_text(json.dumps(content))

    return write


BROKEN = {
    "no folder": (lambda f: f.rename(f.with_name("elsewhere")), "no such folder"),
    "nothing in it": (
        lambda f: [shutil.rmtree(f / "train"), shutil.rmtree(f / "test"), (f / "transforms_train.json").unlink()],
        "expected transforms_train.json, metadata.json",
    ),
    "missing pictures": (
        lambda f: [(f / "train" / f"r_{i}.png").unlink() for i in (2, 5)],
        r"2 of 13 pictures are missing, the first is .*r_2",
    ),
    "nan": (nan_picture, r"r_4.png: pixels must be finite, got nan at x 7, y 3"),
    "cut short": (of_picture(lambda content: content[:200]), "r_1.png: unreadable or cut short"),
    "too large for Pillow": (
        of_picture(lambda content: png_of_size(20000, 10000)),
        r"r_1.png: unreadable or cut short \(Image size \(200000000 pixels\) exceeds limit",
    ),
    "broken header": (of_picture(lambda content: b"P6 3x2 255\n"), "r_1.png: unreadable or cut short"),
    "one camera": (
        of_transforms(lambda c: c.update(frames=c["frames"][:1])),
        "training needs at least 2 pictures, got 1",
    ),
    "one place": (
        of_transforms(lambda c: c.update(frames=[c["frames"][0]] * 3)),
        "cameras at different places, got all 3 at one",
    ),
    "bad pose": (
        of_transforms(lambda c: c["frames"][1].update(transform_matrix=[[math.nan] * 4] * 4)),
        "frame 1: transform_matrix must hold 4 x 4 finite numbers",
    ),
}


@pytest.mark.parametrize("case", BROKEN)
def test_broken_captures_are_one_line_and_leave_no_results(synthetic, tmp_path, capsys, case):
    folder = tmp_path / "scene"
    shutil.copytree(synthetic, folder)
    breaks, message = BROKEN[case]
    breaks(folder)
    error = refused(capsys, commands.train, folder, tmp_path / "out", "--missing refuse --iterations 1")
    assert re.search(message, error)
    assert not (tmp_path / "out").exists()


def test_a_folder_for_results_that_is_none_is_known_before_the_capture_is_read(
    synthetic, tmp_path, capsys, monkeypatch
):
    monkeypatch.setattr("analytic_rasterizer.training.run.settle", None)  # who looks at the capture
    (tmp_path / "a").write_text("a file")
    for out in (tmp_path / "a", tmp_path / "a" / "b" / "c"):
        error = refused(capsys, commands.train, synthetic, out, "--iterations 1")
        assert error == f"error: {tmp_path / 'a'}: expected a folder for the results, got a file\n"
    monkeypatch.setattr("os.access", lambda path, mode: False)
    error = refused(capsys, commands.train, synthetic, tmp_path / "b" / "c", "--iterations 1")
    assert error.startswith(f"error: {tmp_path}: the folder for the results cannot be written to (Permission denied")
    assert [path.name for path in tmp_path.iterdir()] == ["a"]


@pytest.mark.parametrize(
    "extra, message",
    [
        ("--footprint bx", "footprint must be one of"),
        ("--first-footprint bx", "first_footprint: footprint must be one of"),
        ("--footprint box:samples=3", "samples must be one of"),
        ("--iterations 0", "iterations must be at least 1, got 0"),
        ("--seconds nan", "seconds must be finite and not negative, got nan"),
        ("--scales 1,0", "scales must be whole numbers of at least 1, got (1, 0)"),
        ("--scales 1,1", "scales must be different from each other"),
        ("--scales 1,2 --scale-repeats 1", "scale_repeats must be 2 numbers"),
        ("--scales one", "must be whole numbers with commas between them, got one"),
        ("--scales 64 --effects none", "32 x 32 px are too few for these scales, expected at least 64"),
        ("--density more", "density must be one of 3dgs, absgrad, mcmc, none, got more"),
        ("--densify-until 1.5", "densify_until must be 0 to 1, got 1.5 (a share of the training; above 1 it is a "),
        ("--densify-from -2", "densify_from must be 0 to 1, got -2"),
        ("--rates-from nan", "rates_from must be 0 to 1, got nan"),
        ("--sh-degree 4", "sh_degree must be 0 to 3, got 4"),
        ("--background green", "background must be one of black, white, random, got green"),
        ("--preset quick --opacity-rate 0", "opacity_rate must be positive and finite, got 0.0"),
        ("--density mcmc --max-gaussians 0", 'max_gaussians must be at least 1 with density "mcmc"'),
        ("--points none.ply", "--points none.ply: no such file"),
        ("--seed 99999999999999", "seed must be -2^39 to 2^40 - 1, got 99999999999999"),
        ("--random-points -1", "random_points must be at least 0, got -1"),
        (
            "--random-points 500 --max-gaussians 300 --density mcmc",
            "random_points must be at most max_gaussians, 300, got 500",
        ),
        ("--max-gaussians 1", "training needs at least 2 points to start from, got 1"),
        ("--preset slow", "argument --preset: invalid choice: 'slow'"),
        ("--port 8000", "--port is for --watch"),
        ("--watch --port 65536", "must be a port from 0 to 65535, got 65536"),
        ("--export mip --footprint point", "--export mip is for footprints that integrate over pixels"),
        ("--save-every -1", "save_every must be at least 0, got -1"),
        ("--seconds 5 --iterations 10", "--seconds is instead of --iterations: leave out one of them"),
        ("--test-every 1", "test_every must be 0 or at least 2, got 1"),
        ("--resume", "checkpoint.pt: no such file; there is no training to resume"),
    ],
)
def test_bad_arguments_are_one_line(synthetic, tmp_path, capsys, extra, message):
    assert message in refused(capsys, commands.train, synthetic, tmp_path / "out", extra)
    assert not (tmp_path / "out").exists()


def help_of_options(capsys) -> dict[str, tuple[str, str]]:
    """Metavar and text of every option of a training."""
    with pytest.raises(SystemExit):
        cli.main(["train", "--help"])
    entries = re.findall(r"^  --([\w-]+)((?:.*\n)(?:   .*\n)*)", capsys.readouterr().out + "\n", re.MULTILINE)
    shown = {name.replace("-", "_"): " ".join(text.split()) for name, text in entries}
    found = {}
    for field in fields(TrainingOptions):
        text = shown[field.name]
        metavar = "" if isinstance(field.default, bool) else text.split()[0]
        found[field.name] = metavar, text.removeprefix(metavar).strip()
    return found


def test_help_of_train_has_every_default(capsys):
    """Those that are 0 were left out."""
    options = help_of_options(capsys)
    for field in fields(TrainingOptions):
        default = field.default
        if default not in ((), "") and default is not False and field.name not in ("scales", "random_points"):
            shown = f"{default:g}" if isinstance(default, float) else default
            assert f"(default: {shown})" in options[field.name][1], field.name


def test_help_of_train_says_what_every_option_is(capsys):
    """As it is declared; options of one density control say so."""
    options = help_of_options(capsys)
    for name, (_, text) in options.items():
        assert len(text.split("(default:")[0]) > 4, name
    assert options["ssim_weight"] == (
        "SHARE",
        "share of 1 - SSIM in the loss, next to the mean absolute error (default: 0.2)",
    )
    assert options["noise"] == (
        "FACTOR",
        'of "mcmc": strength of the noise on the means, in learning rates of the means; 0: none (default: 500000)',
    )
    assert "not more than --max-gaussians" in options["random_points"][1]


def test_help_of_train_says_what_values_are(capsys):
    """Not X for all of them."""
    metavars = {name: metavar for name, (metavar, _) in help_of_options(capsys).items()}
    assert "X" not in metavars.values()
    expected = {"iterations": "N", "scales": "N,N,..", "densify_until": "T", "means_rate": "RATE", "density": "NAME"}
    assert expected.items() <= metavars.items()


# ------------------------------------------------------------------------------------ training


make_run = functools.partial(runs.make_run, images="photographs", iterations=120, scales=(1, 2), **runs.TINY)


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"density": "3dgs", "gradient_scales": "all"},
        {"density": "mcmc"},
        {"density": "none"},
        {"supersampling": 2, "footprint": "point"},
    ],
    ids=str,
)
def test_psnr_rises_and_the_results_say_so(device, synthetic, tmp_path, options):
    run = make_run(synthetic, tmp_path, device, **options)
    assert run.train()
    metrics = run.evaluate()
    log = [json.loads(line) for line in (tmp_path / files.LOG).read_text().splitlines()]
    assert [entry["step"] for entry in log] == [10, 100, 120]
    assert log[-1]["loss"] < 0.5 * log[0]["loss"]
    start = evaluate(Gaussians.from_points(*training.random_points(150, 0), 1), cpu_test_pictures(synthetic), "box")
    assert metrics["test"]["mean"]["psnr"] > start["mean"]["psnr"] + 3
    assert metrics["steps"] == 120 and metrics == json.loads((tmp_path / files.METRICS).read_text())
    assert {"1", "2", "mean"} == metrics["test"].keys() and len(metrics["test"]["1"]["views"]) == 3
    if options.get("density") != "none":
        assert 150 < metrics["gaussians"] <= 400


@torch.no_grad()
def state_of(trainer) -> list[torch.Tensor]:
    """Copies of parameters and moments, a row for each Gaussian."""
    moments = [trainer.optimizer.state[field].get(m) for field in trainer.gaussians for m in optim.MOMENTS]
    return [t.detach().clone() for t in (*trainer.gaussians, *(m for m in moments if m is not None))]


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"pictures_per_step": 3},
        {"supersampling": 2, "footprint": "point"},
        {"filter_3d": True},
        {"opacity_weight": 0.1, "scale_weight": 0.1},
        {"density": "mcmc", "noise": 0.0},
    ],
    ids=str,
)
def test_a_sparse_step_moves_what_its_pictures_show(device, synthetic, tmp_path, options):
    """The first step as one on all Gaussians does; the others keep parameters and moments in every step."""
    common = {"density": "none", "densify_from": 1000, **options}
    dense, sparse = (make_run(synthetic, tmp_path, device, sparse_adam=s, **common).trainer for s in (False, True))
    for trainer in (dense, sparse):
        scatter(trainer.gaussians)
    # Of Gaussians that this step's pictures do not show, some have been moved before.
    had_moments = False
    for step in range(8):
        shown = rows_shown(sparse)
        rows, before = torch.stack(shown).any(0), state_of(sparse)
        assert 0 < rows.sum() < 100 and (len(shown) == 1 or not torch.equal(rows, shown[0]))
        sparse.step()
        after = state_of(sparse)
        if step == 0:
            start = before[0].new_zeros(())
            dense.step()
            for expected, got in zip(state_of(dense), after):
                assert torch.equal(expected[rows], got[rows])
            assert all((moment[~rows] == start).all() for moment in after[5:])
            moved = [not torch.equal(new[~rows], old[~rows]) for new, old in zip(dense.gaussians, before)]
            assert any(moved) == any(sparse.options.regularizers)
        for old, new in zip(before, after):
            assert torch.equal(old[~rows], new[~rows])
        assert not torch.equal(before[0][rows], after[0][rows]) and not torch.equal(before[3][rows], after[3][rows])
        had_moments = had_moments or (step > 0 and bool((before[-1][~rows] != 0).any()))
    assert had_moments


def test_supersampled_pictures_are_means_of_larger_ones(device):
    """With the gradient of the mean; within what the two cameras' roundings to float32 differ by."""
    view = circle(3)[0]
    pictures, gradients = [], []
    for scale, supersampling in ((3, 1), (1, 3)):
        gaussians = truth_gaussians().map(lambda field: field.to(device).requires_grad_())
        settings = view.settings(scale, sh_degree=0, footprint="point", device=device)
        picture, radii = g.render(gaussians.arguments(), settings, supersampling=supersampling)
        pictures.append(torch.nn.functional.avg_pool2d(picture, 3 // supersampling))
        pictures[-1].square().sum().backward()
        gradients.append(gaussians.means.grad)
        assert radii.max() > 20  # px of the large picture
    assert pictures[1].shape == (3, 32, 32)
    torch.testing.assert_close(pictures[1], pictures[0], rtol=0, atol=1e-4)
    torch.testing.assert_close(gradients[1], gradients[0], rtol=1e-3, atol=1e-3 * gradients[0].abs().max().item())


def test_a_step_renders_supersampled_pictures(device, synthetic, tmp_path):
    run = make_run(synthetic, tmp_path, device, supersampling=4, footprint="point")
    view, scale = run.trainer.order(0)
    settings = run.trainer.pictures.settings[scale][view]._replace(sh_degree=0, footprint="point")
    with torch.no_grad():
        expected, plain = (g.render(run.trainer.gaussians.arguments(), settings, supersampling=n)[0] for n in (4, 1))
    run.trainer.step()
    torch.testing.assert_close(run.trainer.last[0], expected, rtol=0, atol=1e-6)
    assert (plain - expected).abs().max() > 1e-3


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


def cpu_test_pictures(folder):
    return training.load_pictures(training.load_capture(folder).test, (1, 2), loading.WHITE, "cpu")


@pytest.mark.parametrize(
    "options",
    [
        {"density": "3dgs", "gradient_scales": "all"},
        {"density": "absgrad", "gradient_scales": "finest", "filter_3d": True, "scale_repeats": (2, 1)},
        {"density": "mcmc", "background": "random", "pictures_per_step": 2},
        {"density": "3dgs", "sh_degree": 0},
        {"footprint_from": 0.8},
        {"sh_degree": 0, "density": "mcmc"},
        {"sparse_adam": True},
        {"sparse_adam": True, "density": "mcmc", "pictures_per_step": 2},
    ],
    ids=["3dgs", "absgrad", "mcmc", "3dgs-constant-colors", "cheap", "mcmc-constant-colors", "sparse", "sparse-mcmc"],
)
def test_resumed_training_gives_the_same_bits(device, synthetic, tmp_path, options):
    """Through a file, at a step between two changes of density, and against a run without a break."""
    common = {"iterations": 75, "densify_until": 0.9, **options}  # changes after steps 40 and 60
    whole, part = (make_run(synthetic, tmp_path / name, device, **common) for name in ("whole", "part"))
    if whole.options.sparse_adam:
        for run in (whole, part):
            scatter(run.trainer.gaussians)
    whole.train()
    for _ in range(47):
        part.trainer.step()
    part.save()
    again = make_run(synthetic, tmp_path / "part", device, resume=True)
    assert again.options == whole.options and again.progress.step == 47
    again.train()
    assert len(part.trainer.gaussians.means) != 150 and len(again.trainer.gaussians.means) != 150
    for name, expected, got in zip(Gaussians._fields, whole.trainer.gaussians, again.trainer.gaussians):
        assert torch.equal(expected, got), name
    assert (tmp_path / "whole" / files.SCENE).read_bytes() == (tmp_path / "part" / files.SCENE).read_bytes()


@pytest.mark.filterwarnings("error:.*deterministic")
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"density": "3dgs", "supersampling": 2, "filter_3d": True},
        {"density": "mcmc", "background": "random", "pictures_per_step": 2, "sparse_adam": True},
    ],
    ids=["absgrad", "3dgs", "mcmc"],
)
def test_a_deterministic_training_counts_every_frame(device, synthetic, tmp_path, monkeypatch, options):
    """In torch's deterministic mode, without operators that would break it, and with the bits of other trainings."""
    common = {"iterations": 75, "densify_until": 0.9, **options}  # changes after steps 40 and 60
    runs = [make_run(synthetic, tmp_path / str(on), device, deterministic=on, **common) for on in (False, True)]
    modes, following = [], schedule.PictureOrder.__call__
    note = lambda order, n: (modes.append(torch.get_deterministic_debug_mode()), following(order, n))[1]  # noqa: E731
    monkeypatch.setattr(schedule.PictureOrder, "__call__", note)
    for run, mode in zip(runs, (0, 1)):
        modes.clear()
        run.train()
        assert len(modes) >= 75 and set(modes) == {mode}
        assert torch.get_deterministic_debug_mode() == 0
    assert len(runs[0].trainer.gaussians.means) != 150
    for name, one, other in zip(Gaussians._fields, *(run.trainer.gaussians for run in runs)):
        assert torch.equal(one, other), name


def test_a_deterministic_step_leaves_the_mode_of_the_program(synthetic, tmp_path, monkeypatch):
    """A stricter one stays on in the step, and an error ends what the step has switched on."""
    run = make_run(synthetic, tmp_path, deterministic=True)
    modes = []
    monkeypatch.setattr(run.trainer, "_set_rates", lambda: modes.append(torch.get_deterministic_debug_mode()) or 1 / 0)
    for before in (0, 2):
        torch.set_deterministic_debug_mode(before)
        try:
            with pytest.raises(ZeroDivisionError):
                run.trainer.step()
            assert torch.get_deterministic_debug_mode() == before
        finally:
            torch.set_deterministic_debug_mode(0)
    assert modes == [1, 2]


def test_the_command_takes_deterministic(synthetic, tmp_path, capsys):
    error = refused(capsys, commands.train, synthetic, tmp_path, "--deterministic --seconds 5")
    assert "--deterministic has no effect: by the clock, every run has another number" in error
    small = "--iterations 3 --random-points 50 --no-evaluate"
    assert commands.train(synthetic, tmp_path, "--deterministic", small) == 0
    assert json.loads((tmp_path / files.OPTIONS).read_text())["options"]["deterministic"] is True


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"density": "3dgs", "gradient_scales": "all"},
        {"density": "none", "sh_degree": 0},
        {"background": "random"},
        {"density": "mcmc"},
        {"pictures_per_step": 5, "gradient_scales": "all"},
        {"supersampling": 2},
        {"filter_3d": True},
        {"exposure": "affine"},
        {"vignetting": "polynomial"},
        {"exposure": "affine", "vignetting": "polynomial", "supersampling": 2, "scales": (1, 2)},
        {"opacity_weight": 0.1, "scale_weight": 0.2, "filter_3d": True, "supersampling": 3, "pictures_per_step": 3},
    ],
    ids=str,
)
def test_a_step_has_the_gradients_of_autograd(device, synthetic, tmp_path, options):
    run = make_run(synthetic, tmp_path, device, **options)
    for _ in range(3):  # Balls have no gradient by their rotation.
        run.trainer.step()
    check_next_step(run.trainer)


FIELDS = ("means", "log_scales", "quats", "logit_opacities", "shs")
PARTS = ("", "mask", "exposure", "vignetting", "filter", "supersampling", "regularizers", "depth", "all")


def settings_of(lens, device, dtype=torch.float32):
    view = circle(1)[0]
    if lens is SPHERE:
        view = replace(view, lens=lens, fx=view.width / (2 * math.pi), fy=view.height / math.pi)
    return replace(view, lens=lens).settings(sh_degree=0, footprint="box:samples=4", device=device, dtype=dtype)


def picture_arguments(device, parts="", lens=None, dtype=torch.float32, **changed):
    """Of the op `picture_gradients`, with some of `PARTS`."""
    view, generator = replace(circle(1)[0], lens=lens), torch.Generator().manual_seed(1)
    gaussians = truth_gaussians().map(torch.Tensor.detach)
    log_scales = gaussians.log_scales + 0.5 * torch.rand(gaussians.log_scales.shape, generator=generator)
    times = 2 if parts in ("supersampling", "all") else 1
    size = view.height // times, view.width // times
    of_parts = {
        "mask": {"mask": torch.rand(size, generator=generator)},
        "exposure": {"exposure": torch.eye(3, 4) + 0.1 * torch.rand(3, 4, generator=generator)},
        "vignetting": {"vignetting": torch.tensor([-0.4, 0.1]), "center": [0.4 * size[1], 0.55 * size[0]]},
        "filter": {"filter_3d": 0.3 * torch.rand(len(log_scales), generator=generator)},
        "regularizers": {"opacity_weight": 0.3, "scale_weight": 0.2},
        "depth": {
            "depth_target": 0.2 + 0.2 * torch.rand(size, generator=generator),
            "depth_shares": torch.rand(size, generator=generator),
            "depth_weight": 0.01,
            "depth_margin": 0.05,
        },
    }
    given = dict(zip(FIELDS, gaussians._replace(log_scales=log_scales)))
    given |= {"dL_dloss": torch.tensor(0.75), "bg": torch.full((3,), 0.2), "exposure": None, "mask": None}
    given |= {"supersampling": times, "vignetting": None, "center": []}
    for name, more in of_parts.items():
        given |= more if parts in (name, "all") else {}
    moved = {name: v.to(device, dtype) if isinstance(v, torch.Tensor) else v for name, v in given.items()}
    target = torch.rand(3, *size, generator=generator).mul(255).byte().to(device)
    settings = settings_of(lens, device, dtype)
    camera = camera_arguments(settings, moved["means"], None, with_seam=True) | {"turn": turn_of(settings)}
    return moved | {"mean_columns": 4, "target": target, "ssim_weight": 0.2} | camera | changed


SPHERE = Lens.equirectangular()


@pytest.mark.parametrize("lens", [None, SPHERE], ids=["pinhole", "sphere"])
@pytest.mark.parametrize("parts, columns", [*((parts, 4) for parts in PARTS), ("", 0), ("all", 0), ("all", 3)])
def test_gradients_of_a_picture_are_those_of_autograd(device, lens, parts, columns):
    given = picture_arguments(device, parts, lens, mean_columns=columns)
    loss, picture, radii, gradients = torch.ops.analytic_rasterizer.picture_gradients(**given)
    times, weights = given["supersampling"], (given.get("opacity_weight", 0), given.get("scale_weight", 0))
    parameters = Gaussians(*(given[name] for name in FIELDS)).map(lambda field: field.clone().requires_grad_())
    means2D = torch.zeros(len(radii), max(columns, 3), device=device, requires_grad=True)
    arguments = parameters.arguments()
    shown = widened(arguments, given.get("filter_3d"))
    exposure = given["exposure"] if given["exposure"] is None else given["exposure"].clone().requires_grad_()
    vignetting = None if given["vignetting"] is None else given["vignetting"].clone().requires_grad_()
    how = {"times": times, "exposure": exposure, "mask": given["mask"], "ssim_weight": given["ssim_weight"]}
    how |= {"vignetting": vignetting, "center": given["center"]}
    if "depth_target" in given:
        how["depth"] = {name: value for name, value in given.items() if name.startswith("depth_")}
    settings = settings_of(lens, device)._replace(bg=given["bg"])
    expected, image, expected_radii = compared(settings, shown, means2D, given["target"], **how)
    expected = expected + weights[0] * arguments["opacities"].mean() + weights[1] * arguments["scales"].mean()
    wanted = [*parameters, *([means2D] if columns else []), *(t for t in (exposure, vignetting) if t is not None)]
    made = torch.autograd.grad(expected, wanted, given["dL_dloss"])
    torch.testing.assert_close(picture, image.detach(), rtol=0, atol=1e-6)
    assert torch.equal(radii, expected_radii)
    for found, of_autograd in zip((*gradients, loss), (*made, expected), strict=True):
        assert of_autograd.norm() > 0 and (found - of_autograd).norm() <= TOLERANCE * of_autograd.norm()


@pytest.mark.parametrize("options", [{}, {"density": "mcmc"}, {"background": "random", "filter_3d": True}], ids=str)
def test_another_default_dtype_changes_nothing(synthetic, tmp_path, options):
    measured = []
    for name, dtype in (("single", torch.float32), ("double", torch.float64)):
        torch.set_default_dtype(dtype)
        try:
            run = make_run(synthetic, tmp_path / name, iterations=60, **options)
            run.train()
            measured.append(run.evaluate()["test"])
        finally:
            torch.set_default_dtype(torch.float32)
    assert measured[0] == measured[1]
    scenes = [(tmp_path / name / files.SCENE).read_bytes() for name in ("single", "double")]
    assert scenes[0] == scenes[1]


@pytest.mark.parametrize("options", [{}, {"density": "mcmc"}], ids=str)
def test_training_where_gradients_are_switched_off(synthetic, tmp_path, options):
    with torch.no_grad():
        run = make_run(synthetic, tmp_path / "off", iterations=40, **options)
        run.train()
    make_run(synthetic, tmp_path / "on", iterations=40, **options).train()
    scenes = [(tmp_path / name / files.SCENE).read_bytes() for name in ("off", "on")]
    assert scenes[0] == scenes[1]


def test_opcheck_of_picture_gradients(device):
    op = torch.ops.analytic_rasterizer.picture_gradients.default
    for columns in (0, 3, 4):
        torch.library.opcheck(op, (), picture_arguments(device, mean_columns=columns))
    torch.library.opcheck(op, (), picture_arguments(device, "all"))


LENSES = {
    "pinhole": None,
    "perspective": Lens.perspective([-0.1, 0.03], [0.01, -0.02]),
    "fisheye": Lens.fisheye([0.05, -0.01]),
    "rad_tan_fisheye": Lens.rad_tan_fisheye([-0.05], [0.01]),
    "fov": Lens.fov(0.9),
}


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("parts", PARTS)
def test_picture_gradients_of_devices_and_precisions_agree(device, lens, parts):
    results = []
    for dtype, where in ((torch.float64, "cpu"), (torch.float32, device)):
        arguments = picture_arguments(where, parts, LENSES[lens], dtype)
        loss, image, _, gradients = torch.ops.analytic_rasterizer.picture_gradients(**arguments)
        results.append([t.double().cpu() for t in (loss, image, *gradients)])
    assert len(results[0]) == 8 + (parts in ("exposure", "vignetting")) + 2 * (parts == "all")
    for number, (expected, found) in enumerate(zip(*results)):
        assert expected.norm() > 0 and (found - expected).norm() < TOLERANCE * expected.norm(), number


def test_threads_change_no_bit_of_the_regularizers():
    """Of more Gaussians than a thread takes at a time."""
    generator = torch.Generator().manual_seed(2)
    given = [torch.randn(20_000, width, generator=generator) for width in (3, 4, 1)]
    penalties = []
    for threads in (1, 2, 7):
        torch.set_num_threads(threads)
        penalties.append(torch.ops.analytic_rasterizer.activate(*given, 0.3, 0.2)[3])
    assert all(torch.equal(penalty, penalties[0]) for penalty in penalties)


@pytest.mark.parametrize(
    "changed, error, message",
    [
        ({"mean_columns": 2}, ValueError, "mean_columns must be 0, 3 or 4, got 2"),
        ({"quats": torch.zeros(12, 3)}, ValueError, r"quats must have shape \(N, 4\) with N = 12, got \(12, 3\)"),
        ({"means": torch.zeros(11, 3)}, ValueError, r"log_scales must have shape \(N, 3\) with N = 11, got \(12, 3\)"),
        ({"means": torch.zeros(12, 2)}, ValueError, r"means must have shape \(N, 3\), got \(12, 2\)"),
        ({"target": torch.zeros(3, 5, 5)}, ValueError, r"target must have shape \(3, .*\), got \(3, 5, 5\)"),
        ({"target": torch.zeros(3, 5, 5, dtype=torch.int32)}, TypeError, "target must have the dtype of means"),
        ({"ssim_weight": 1.5}, ValueError, r"ssim_weight must be in \[0, 1\], got 1.5"),
        ({"dL_dloss": torch.zeros(2)}, ValueError, "dL_dloss must have shape"),
        ({"mask": torch.zeros(5, 5)}, ValueError, r"mask must have shape \(.*\), got \(5, 5\)"),
        ({"mask": torch.zeros(5, 5, dtype=torch.uint8)}, TypeError, "mask must have the dtype of means"),
        ({"exposure": torch.zeros(4, 3)}, ValueError, r"exposure must have shape \(3, 4\), got \(4, 3\)"),
        ({"vignetting": torch.zeros(2)}, ValueError, "center must have two numbers with vignetting, and none .* got 0"),
        ({"center": [1.0, 2.0]}, ValueError, "center must have two numbers with vignetting, and none without, got 2"),
        (
            {"vignetting": torch.zeros(3), "center": [1.0, 2.0]},
            ValueError,
            r"vignetting must have shape \(2,\), got \(3,\)",
        ),
        (
            {"vignetting": torch.zeros(2), "center": [1.0, math.inf]},
            ValueError,
            "center must be finite, got 1 and inf",
        ),
        ({"filter_3d": torch.zeros(11)}, ValueError, r"filter_3d must have shape \(N,\) with N = 12, got \(11,\)"),
        ({"filter_3d": torch.zeros(12).double()}, TypeError, "filter_3d must have the dtype of means"),
        ({"supersampling": 3}, ValueError, "supersampling must be at least 1 and divide .*, 32 and 32, got 3"),
        ({"supersampling": 0}, ValueError, "supersampling must be at least 1 and divide"),
        ({"supersampling": 2}, ValueError, r"target must have shape \(3, 16, 16\), got \(3, 32, 32\)"),
        ({"scale_weight": math.nan}, ValueError, "opacity_weight and scale_weight must be finite, got 0 and nan"),
        ({"depth_target": torch.zeros(32, 32)}, ValueError, "depth_target and depth_shares must be given together"),
        ({"depth_shares": torch.zeros(32, 32)}, ValueError, "depth_target and depth_shares must be given together"),
        ({"depth_weight": -1.0}, ValueError, "depth_weight must be finite and not negative, got -1"),
        ({"depth_margin": 0.0}, ValueError, "depth_margin must be finite and positive, got 0"),
        (
            {"depth_target": torch.zeros(16, 32), "depth_shares": torch.zeros(32, 32)},
            ValueError,
            r"depth_target must have shape \(32, 32\), got \(16, 32\)",
        ),
        (
            {"depth_target": torch.zeros(32, 32), "depth_shares": torch.zeros(32, 32).double()},
            TypeError,
            "depth_shares must have the dtype of means",
        ),
    ],
)
def test_errors_of_picture_gradients(changed, error, message):
    with pytest.raises(error, match=message):
        torch.ops.analytic_rasterizer.picture_gradients(**picture_arguments("cpu", **changed))


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_and_sigterm_save_and_training_resumes(synthetic, tmp_path, capsys, monkeypatch, number):
    """The step that runs is completed; the end is the same as without the interruption."""
    whole, part, small = tmp_path / "whole", tmp_path / "part", "--iterations 60 --random-points 50 --sh-degree 0"
    assert commands.train(synthetic, whole, small) == 0

    def interrupt(trainer):
        if trainer.progress.step == 33:
            signal.raise_signal(number)

    around_steps(monkeypatch, interrupt)
    before = signal.getsignal(number)
    assert commands.train(synthetic, part, small) == 130
    assert signal.getsignal(number) is before
    assert "stopped after 34 steps and saved; go on with --resume" in capsys.readouterr().out
    assert (part / files.SCENE).exists()
    monkeypatch.undo()
    assert "go on with --resume" in refused(capsys, commands.train, synthetic, part, small)
    error = refused(capsys, commands.train, synthetic, part, small, "--seed 3 --resume")
    assert "--seed: a resumed training keeps the options of its checkpoint" in error
    assert commands.train(synthetic, part, small, "--resume") == 0
    assert (whole / files.SCENE).read_bytes() == (part / files.SCENE).read_bytes()


def test_a_second_ctrl_c_ends_at_once(synthetic, tmp_path, monkeypatch):
    run = make_run(synthetic, tmp_path)
    around_steps(monkeypatch, after=lambda trainer: [signal.raise_signal(signal.SIGINT) for _ in range(2)])
    with pytest.raises(KeyboardInterrupt):
        run.train()


def test_a_second_sigterm_kills(synthetic, tmp_path, monkeypatch):
    run, handlers = make_run(synthetic, tmp_path, iterations=3), []

    def kill(trainer):
        signal.raise_signal(signal.SIGTERM)
        handlers.append(signal.getsignal(signal.SIGTERM))

    around_steps(monkeypatch, after=kill)
    assert not run.train() and handlers == [signal.SIG_DFL]


def test_a_handler_of_the_program_for_sigterm_stays(synthetic, tmp_path, monkeypatch):
    run, received = make_run(synthetic, tmp_path, iterations=3), []
    around_steps(monkeypatch, after=lambda trainer: signal.raise_signal(signal.SIGTERM))
    before = signal.signal(signal.SIGTERM, lambda number, _: received.append(number))
    try:
        assert run.train() and len(received) == 3
    finally:
        signal.signal(signal.SIGTERM, before)


def test_a_folder_that_became_read_only_is_reported_by_the_name_of_the_file(tmp_path, monkeypatch):
    def read_only(path, **_):
        raise OSError(30, "Read-only file system", str(path))

    monkeypatch.setattr(type(tmp_path), "unlink", read_only)
    with pytest.raises(OSError, match=r"options\.json: cannot be written \(Read-only file system\)"):
        files.write_safely(tmp_path / files.OPTIONS, read_only)


def full_disk(state, path) -> None:
    path.write_bytes(b"half of it")
    raise OSError(28, "No space left on device")


def test_full_disk_on_the_way_is_reported_and_at_the_end_keeps_what_was_there(synthetic, tmp_path, capsys, monkeypatch):
    run = make_run(synthetic, tmp_path, iterations=30)
    run.save_every = 10
    save, calls = torch.save, []

    def fails_after_the_first(state, path):
        calls.append(state["progress"]["step"])
        (save if len(calls) == 1 else full_disk)(state, path)

    monkeypatch.setattr(torch, "save", fails_after_the_first)
    with pytest.raises(OSError, match=r"checkpoint.pt: the disk is full; an earlier file of this name is unchanged"):
        run.train()
    assert calls == [10, 20, 30]
    assert "checkpoint.pt: the disk is full" in capsys.readouterr().err
    assert files.read_checkpoint(tmp_path / files.CHECKPOINT)["progress"]["step"] == 10
    assert not [path for path in tmp_path.iterdir() if "partial" in path.name]


def test_a_loss_that_is_not_finite_ends_with_an_error(synthetic, tmp_path, capsys, monkeypatch):
    run = make_run(synthetic, tmp_path)
    for _ in range(3):
        run.trainer.step()
    run.save()

    def without_loss(*fields, op=training.trainer._picture_gradients, **others):
        loss, *results = op(*fields, **others)
        return math.nan * loss, *results

    monkeypatch.setattr(training.trainer, "_picture_gradients", without_loss)
    with pytest.raises(FloatingPointError, match=r"the loss of step 4 is nan"):
        run.train()
    assert commands.train(synthetic, tmp_path, "--resume") == 2
    assert capsys.readouterr().err.endswith("error: the loss of step 4 is nan; lower learning rates may help\n")
    assert files.read_checkpoint(tmp_path / files.CHECKPOINT)["progress"]["step"] == 3


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 nonsense", b"\x80\x04K\x01."])
def test_a_broken_checkpoint_is_one_line(synthetic, tmp_path, capsys, content):
    (tmp_path / files.CHECKPOINT).write_bytes(content)
    assert "checkpoint.pt: " in refused(capsys, commands.train, synthetic, tmp_path, "--resume")


def test_a_checkpoint_of_an_earlier_format(tmp_path):
    torch.save({"format": 1}, tmp_path / files.CHECKPOINT)
    with pytest.raises(io.SceneError, match="expected a checkpoint of format 3, got 1"):
        files.read_checkpoint(tmp_path / files.CHECKPOINT)


def test_training_by_time_on_a_capture(capture, tmp_path, monkeypatch):
    """By a clock on which every step takes 0.02 s, for how many a machine does in a given time is not known."""
    run = make_run(capture, tmp_path, seconds=0.59, density="none", footprint="cumulant")
    monkeypatch.setattr(schedule.Clock, "_now", lambda clock: 0.02 * run.progress.step)
    assert run.train()
    assert run.clock.total >= 0.59 and run.progress.share >= 1 and run.progress.step == 30
    assert len(run.trainer.gaussians.means) == 60
    assert run.trainer.pictures.settings[2][0].image_width == 17


@pytest.mark.parametrize(
    "kind", [pytest.param(k, id=f"cuda-{k}", marks=needs_cuda) for k in ("3dgs", "absgrad", "mcmc")]
)
@pytest.mark.parametrize("sparse", [pytest.param(False, id="dense"), pytest.param(True, id="sparse")])
def test_steps_do_not_wait_for_the_device(synthetic, tmp_path, kind, sparse):
    """Outside of the steps that change the number of Gaussians, once the frames of every size are known."""
    run = make_run(synthetic, tmp_path, "cuda", iterations=1000, density=kind, densify_from=900, sparse_adam=sparse)
    for _ in range(100):
        run.trainer.step()
    torch.cuda.set_sync_debug_mode("error")
    try:
        for _ in range(20):
            run.trainer.step()
    finally:
        torch.cuda.set_sync_debug_mode("default")


# ------------------------------------------------------------------------------------- watching


def watched(monkeypatch, *given) -> list[tuple]:
    """Runs the command with a viewer that wants every scene; returns what it was shown: (scene, step, text, force)."""
    pytest.importorskip("viser", reason="needs the view extra")
    from analytic_rasterizer.viewer import LiveViewer

    shown, update = [], LiveViewer.update

    def note(viewer, scene, *, step, text="", force=False):
        shown.append((scene(), step, text, force))
        return update(viewer, scene, step=step, text=text, force=force)

    monkeypatch.setattr(LiveViewer, "update", note)
    assert commands.train(*given, "--watch") == 0
    return shown


def test_watching_shows_the_scene_and_changes_no_bit(synthetic, tmp_path, monkeypatch, capsys, device):
    common = f"--device {device} --iterations 12 --random-points 60 --sh-degree 0 --no-evaluate"
    assert commands.train(synthetic, tmp_path / "alone", common) == 0
    capsys.readouterr()
    shown = watched(monkeypatch, synthetic, tmp_path / "watched", common)
    assert re.search(r"^watch at http://127\.0\.0\.1:\d+/[\w-]+/$", capsys.readouterr().out, re.M)
    assert [step for _, step, *_ in shown] == list(range(13))
    assert [force for *_, force in shown] == [False] * 12 + [True]
    last = r"loss [\d.]+, PSNR [\d.]+, Gaussians 60, footprint moment:samples=4"
    assert shown[9][2] == "" and re.fullmatch(last, shown[10][2])
    written = io.load_scene(tmp_path / "watched" / files.SCENE)
    torch.testing.assert_close(shown[-1][0].scales.cpu(), written.scales, rtol=1e-5, atol=1e-6)
    alone, together = ((tmp_path / name / files.SCENE).read_bytes() for name in ("alone", "watched"))
    assert alone == together


def test_a_viewer_starts_with_what_is_trained(synthetic, tmp_path):
    pytest.importorskip("viser", reason="needs the view extra")
    with make_run(synthetic, tmp_path, footprint="moment:samples=4", background="random").start_viewer() as viewer:
        assert [view.name for view in viewer.views] == [view.name for view in circle(10)]
        assert (viewer.footprint, viewer.background) == ("moment:samples=4", loading.WHITE)
        assert viewer.name == synthetic.name


def test_watching_without_viser_names_the_extra(synthetic, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "viser", None)
    error = refused(capsys, commands.train, synthetic, tmp_path / "out", "--watch")
    assert 'needs viser: pip install "analytic_rasterizer[view]"' in error
    assert not (tmp_path / "out").exists()


# ------------------------------------------------------------------------------------- results


@pytest.fixture(scope="module")
def trained(synthetic, tmp_path_factory):
    """A folder of results."""
    out = tmp_path_factory.mktemp("trained")
    assert commands.train(synthetic, out, "--iterations 40 --random-points 80 --sh-degree 1 --scales 1,2") == 0
    return out


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


@pytest.mark.parametrize("density", ["absgrad", "mcmc"])
def test_random_points_keep_to_the_limit(synthetic, tmp_path, density):
    """By default there are as many as it allows, and those of a start with so many."""
    run = make_run(synthetic, tmp_path, density=density, max_gaussians=130, random_points=0, iterations=75)
    assert run.options.random_points == 130 and run.points_found is None
    assert torch.equal(run.trainer.gaussians.means.detach(), training.random_points(130, 0)[0])
    counts = []
    while run.progress.share < 1:
        run.trainer.step()
        counts.append(run.count())
    assert counts[0] == max(counts) == 130


def test_number_of_random_points():
    def number(**given):
        return TrainingOptions(**given).random_points

    assert number() == number(max_gaussians=0) == TrainingOptions.preset("3dgs").random_points == 100_000
    assert number(max_gaussians=99_999) == 99_999 and number(random_points=200_000) == 200_000
    # As files of trainings have it that began before this was refused; they can still be evaluated and resumed.
    earlier = TrainingOptions.from_dict({"random_points": 500, "max_gaussians": 300})
    assert earlier.random_points == 500
    with pytest.raises(ValueError, match="random_points must be at most max_gaussians, 300, got 500"):
        training.starting_gaussians(earlier, None)


@pytest.mark.parametrize("given", [False, True], ids=["of the capture", "given"])
def test_of_more_points_than_the_limit_some_are_drawn(capture, tmp_path, capsys, given):
    fixed = ["--images photographs --iterations 1 --sh-degree 0 --no-evaluate"]
    fixed += ["--means-rate 1e-30 --means-rate-end 1e-30"]
    points, _ = training.random_points(60, seed=5)
    if given:
        points = points + 1
        (tmp_path / "p.ply").write_bytes(ply(vertices("xyz", points, "double"), layout="ascii"))
        fixed += ["--points", tmp_path / "p.ply"]

    def start(name, *extra):
        assert commands.train(capture, tmp_path / name, *fixed, *extra) == 0
        state = files.read_checkpoint(tmp_path / name / files.CHECKPOINT)
        return state["gaussians"]["means"], "drawn at random" in capsys.readouterr().err

    everything, said = start("60", "--max-gaussians 60")
    assert torch.equal(everything, points) and not said
    some, said = start("40", "--max-gaussians 40")
    assert len(some) == 40 and said
    places = [torch.where((points == row).all(1))[0].item() for row in some]
    assert places == sorted(set(places)) and places != list(range(40))
    assert torch.equal(start("again", "--max-gaussians 40")[0], some)
    assert not torch.equal(start("seed", "--max-gaussians 40 --seed 1")[0], some)


def test_a_scene_of_more_gaussians_than_the_limit_is_refused(synthetic, trained, tmp_path, capsys):
    count, path = len(io.load_scene(trained / files.SCENE).means), trained / files.SCENE
    error = refused(capsys, commands.train, synthetic, tmp_path / "out", "--max-gaussians 30 --points", path)
    assert error == f"error: max_gaussians must be at least {count}, the Gaussians of {path}, or 0, got 30\n"
    assert not (tmp_path / "out").exists()


def test_training_starts_from_a_scene(synthetic, trained, tmp_path):
    options = TrainingOptions(iterations=1, sh_degree=2, density="none")
    run = training.Run(synthetic, tmp_path / "out", options, points=trained / files.SCENE)
    expected = io.load_scene(trained / files.SCENE)
    torch.testing.assert_close(run.trainer.gaussians.means.detach(), expected.means)
    torch.testing.assert_close(run.trainer.gaussians.shs[:, :4].detach(), expected.shs)
    assert run.trainer.gaussians.shs.shape[1] == 9 and (run.trainer.gaussians.shs[:, 4:] == 0).all()


def test_training_does_not_start_from_a_scene_without_gaussians(synthetic, trained, tmp_path, capsys):
    scene = io.load_scene(trained / files.SCENE)
    io.save_scene(tmp_path / "none.ply", scene.rows(slice(0)))
    error = refused(capsys, commands.train, synthetic, tmp_path / "out", "--points", tmp_path / "none.ply")
    assert error == f"error: {tmp_path / 'none.ply'}: the scene has no Gaussians\n"


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


# -------------------------------------------------------------------------- schedules, measures


def test_order_shows_every_pair_in_turn():
    options = TrainingOptions(scales=(1, 4), scale_repeats=(2, 1), seed=1)
    order = schedule.PictureOrder(3, options)
    rounds = [[order(9 * k + i) for i in range(9)] for k in range(3)]
    pairs = sorted([(v, 1) for v in range(3)] * 2 + [(v, 4) for v in range(3)])
    assert all(sorted(shown) == pairs for shown in rounds)
    assert rounds[0] != rounds[1]
    assert schedule.PictureOrder(3, options)(13) == rounds[1][4]  # without what came before
    assert [schedule.PictureOrder(3, replace(options, seed=2))(i) for i in range(9)] != rounds[0]


def test_seeds_reach_to_where_no_order_can_be_drawn():
    for seed in (-(2**39), -1, 2**40 - 1):
        options = TrainingOptions(seed=seed)
        for number in (0, 2**24 - 1):  # of a pass
            assert schedule.PictureOrder(20, options)(20 * number)[1] == 1
        assert len(training.random_points(2, seed)[0]) == 2
    for seed in (-(2**39) - 1, 2**40):
        with pytest.raises(ValueError, match=rf"seed must be -2\^39 to 2\^40 - 1, got {seed}"):
            TrainingOptions(seed=seed)
        with pytest.raises((ValueError, RuntimeError)):  # which one depends on the version of torch
            torch.Generator().manual_seed(seed << 24)


def test_progress_by_seconds_grows_at_the_last_pace():
    progress = schedule.Progress(None, seconds=10.0)
    for elapsed in (1.0, 3.0):
        for _ in range(100):
            progress.advance()
        progress.measure(elapsed)
        assert progress.share == elapsed / 10
    progress.advance()
    assert progress.share == pytest.approx(0.302)
    steps = schedule.Progress(3, None)
    for share in (1 / 3, 2 / 3, 1.0):
        steps.advance()
        steps.measure(99.0)
        assert steps.share == share


def test_rate_of_the_means_falls_over_the_training_or_over_steps():
    whole, fixed = (TrainingOptions(means_rate=1.6e-4, means_rate_steps=steps) for steps in (0, 30_000))
    assert schedule.means_rate_at(3500, 0.5, whole) == pytest.approx(1.6e-5)  # the geometric mean of the ends
    assert schedule.means_rate_at(15_000, 0.9, fixed) == pytest.approx(1.6e-5)
    assert schedule.means_rate_at(60_000, 0.9, fixed) == pytest.approx(1.6e-6)


def test_other_rates_fall_after_a_while():
    options = TrainingOptions(rates_from=100, rates_half_life=10)
    assert [schedule.rates_factor_at(step, options) for step in (0, 100, 110, 130)] == [1, 1, 0.5, 0.125]
    assert schedule.rates_factor_at(10**6, TrainingOptions(rates_half_life=0)) == 1


def test_degrees_of_the_harmonics_come_after_steps_or_shares():
    options = TrainingOptions()
    assert [schedule.sh_degree_at(step, 0.0, options) for step in (999, 1000, 5000)] == [0, 1, 3]
    assert [schedule.sh_degree_at(9, share, options) for share in (0.09, 0.11, 0.9)] == [0, 1, 3]


def test_options_survive_a_file():
    options = TrainingOptions(scales=[1, 2], density="mcmc", footprint="box")
    assert options.footprint == "box:samples=4" and options.scale_repeats == (2, 1)
    assert TrainingOptions.from_dict(json.loads(json.dumps(options.to_dict()))) == options
    older = {name: value for name, value in options.to_dict().items() if name != "sparse_adam"}
    assert TrainingOptions.from_dict(older) == options and not options.sparse_adam
    with pytest.raises(ValueError, match="among those of TrainingOptions, got speed"):
        TrainingOptions.from_dict({"speed": 1})


def test_numbers_of_numpy_are_those_of_python(synthetic, tmp_path):
    """A checkpoint with a number of NumPy in its options could not be read again."""
    given = {"iterations": np.int64(3), "scales": np.array([1, 2]), "opacity_rate": np.float64(0.04)}
    given |= {"color_rate": np.float32(0.5), "seed": torch.tensor(3), "sh_degree": 1.0, "sparse_adam": np.bool_(True)}
    run = make_run(synthetic, tmp_path, **given)
    plain = {"iterations": 3, "scales": (1, 2), "opacity_rate": 0.04, "color_rate": 0.5, "seed": 3, "sh_degree": 1}
    for name, value in (plain | {"sparse_adam": True, "scale_repeats": (2, 1)}).items():
        assert getattr(run.options, name) == value and type(getattr(run.options, name)) is type(value)
    assert {type(scale) for scale in run.options.scales} == {int}
    run.train()
    assert make_run(synthetic, tmp_path, resume=True).options == run.options


@pytest.mark.parametrize(
    "name, value, error, message",
    [
        ("iterations", 40.5, ValueError, "iterations must be a whole number, got 40.5"),
        ("iterations", "40", TypeError, "iterations must be a whole number, got '40'"),
        ("max_gaussians", math.inf, ValueError, "max_gaussians must be a whole number, got inf"),
        ("seed", 1.5, ValueError, "seed must be a whole number, got 1.5"),
        ("scales", 4, TypeError, "scales must be a sequence of whole numbers, got 4"),
        ("scales", "12", TypeError, "scales must be a sequence of whole numbers, got '12'"),
        ("scales", (1, 2.5), ValueError, "scales must be whole numbers, got (1, 2.5)"),
        ("opacity_rate", "fast", TypeError, "opacity_rate must be a number, got 'fast'"),
        ("filter_3d", "no", TypeError, "filter_3d must be a bool, got 'no'"),
        ("density", None, TypeError, "density must be a string, got None"),
    ],
)
def test_options_of_a_wrong_type(name, value, error, message):
    with pytest.raises(error, match=re.escape(message)):
        TrainingOptions(**{name: value})


def test_presets_give_way_to_what_is_given():
    assert TrainingOptions.preset("quick") == TrainingOptions(iterations=7000)
    assert TrainingOptions(scales=(4, 1, 2)).scale_repeats == (1, 2, 1)  # the finest twice
    as_there = TrainingOptions.preset("3dgs")
    assert (as_there.density, as_there.growth_gradient, as_there.gaussian_limit) == ("3dgs", 2e-4, math.inf)
    assert TrainingOptions.preset("3dgs", scales=(4, 1, 2)).scale_repeats == (1, 1, 1)
    given = {"scales": (1, 2), "scale_repeats": (1, 3), "iterations": 9, "scale_rate": 1e-2}
    chosen = TrainingOptions.preset("3dgs", **given)
    assert {name: getattr(chosen, name) for name in given} == given
    assert replace(chosen, iterations=30_000, scale_rate=5e-3, scales=(1,), scale_repeats=()) == as_there
    with pytest.raises(ValueError, match="preset must be one of quick, 3dgs, got slow"):
        TrainingOptions.preset("slow")


def test_the_command_takes_a_preset_and_resumes_with_it(synthetic, tmp_path, capsys):
    arguments = synthetic, tmp_path, "--iterations 3 --random-points 50 --sh-degree 0 --no-evaluate --preset 3dgs"
    assert commands.train(*arguments, "--scales 1,2 --color-rate 0.001") == 0
    stored = TrainingOptions.from_dict(json.loads((tmp_path / files.OPTIONS).read_text())["options"])
    given = {"scales": (1, 2), "color_rate": 1e-3, "iterations": 3, "random_points": 50, "sh_degree": 0}
    assert stored == TrainingOptions.preset("3dgs", **given) and stored.scale_repeats == (1, 1)
    # The same options once more are no contradiction, with or without the scales; others are.
    assert commands.train(*arguments, "--color-rate 0.001 --resume") == 0
    error = refused(capsys, commands.train, *arguments, "--resume")
    assert error == "error: --color-rate: a resumed training keeps the options of its checkpoint\n"


def older_checkpoint(folder, part, name) -> None:
    """One from before it held something."""
    state = files.read_checkpoint(folder / files.CHECKPOINT)
    del state[part][name]
    files.write_checkpoint(folder / files.CHECKPOINT, state)


def test_the_command_takes_sparse_adam_and_resumes_with_it(synthetic, tmp_path, capsys):
    start = Gaussians.from_points(*training.random_points(60, 0), 0)
    scatter(start)
    io.save_scene(tmp_path / "start.ply", start)
    small = ["--points", tmp_path / "start.ply", "--iterations 12 --sh-degree 0 --no-evaluate"]
    dense, sparse = ((synthetic, tmp_path / name, *small) for name in ("dense", "sparse"))
    assert commands.train(*dense) == 0 and commands.train(*sparse, "--sparse-adam") == 0
    for name in ("dense", "sparse"):
        stored = json.loads((tmp_path / name / files.OPTIONS).read_text())["options"]
        assert stored["sparse_adam"] is (name == "sparse")
    scenes = [(tmp_path / name / files.SCENE).read_bytes() for name in ("dense", "sparse")]
    assert scenes[0] != scenes[1]
    # Whether or not it is given once more; a dense training does not become a sparse one.
    assert commands.train(*sparse, "--resume") == 0 and commands.train(*sparse, "--resume --sparse-adam") == 0
    error = refused(capsys, commands.train, *dense, "--resume --sparse-adam")
    assert error == "error: --sparse-adam: a resumed training keeps the options of its checkpoint\n"
    # A checkpoint from before there was the option.
    older_checkpoint(tmp_path / "dense", "options", "sparse_adam")
    assert commands.train(*dense, "--resume") == 0
    assert (tmp_path / "dense" / files.SCENE).read_bytes() == scenes[0]


def test_resuming_takes_the_points_of_the_start_or_none(synthetic, trained, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shutil.copy(trained / files.SCENE, "a.ply")
    shutil.copy(trained / files.SCENE, "b.ply")
    small = "--iterations 2 --sh-degree 1 --no-evaluate"
    began, alone = ((synthetic, name, small) for name in ("began", "alone"))
    assert commands.train(*began, "--points a.ply") == 0
    assert commands.train(*alone, "--random-points 50") == 0
    assert json.loads((tmp_path / "began" / files.OPTIONS).read_text())["source"]["points"] == str(tmp_path / "a.ply")
    for again in ([], ["--points", tmp_path / "a.ply"], ["--points a.ply"]):
        assert commands.train(*began, "--resume", *again) == 0
    written = {path: path.read_bytes() for folder in ("began", "alone") for path in (tmp_path / folder).iterdir()}
    for arguments, expected in ((began, f"{tmp_path / 'a.ply'} or None"), (alone, "None")):
        error = refused(capsys, commands.train, *arguments, "--resume --points b.ply")
        wrong = f"points must be {expected} where a training is resumed, got {tmp_path / 'b.ply'}"
        assert error == f"error: {wrong}\n"
    assert all(path.read_bytes() == content for path, content in written.items())
    # A checkpoint from before they were noted.
    older_checkpoint(tmp_path / "alone", "source", "points")
    assert commands.train(*alone, "--resume --points b.ply") == 0


def test_resuming_takes_the_pictures_of_the_start_or_none(capture, tmp_path, capsys):
    """A training that was resumed without its --images went on with the pictures of another folder."""
    folder, out = tmp_path / "scene", tmp_path / "out"
    shutil.copytree(capture, folder)
    shutil.copytree(folder / "photographs", folder / "images")
    command = folder, out, "--iterations 2 --no-evaluate"
    chosen = ["--images photographs --test-every 4"]
    assert commands.train(*command, *chosen) == 0
    for again in ([], chosen):
        assert commands.train(*command, "--resume", *again) == 0
        source = json.loads((out / files.OPTIONS).read_text())["source"]
        assert (source["images"], source["test_every"]) == ("photographs", 4)
    written = {path: path.read_bytes() for path in out.iterdir()}
    wrong = {"--images": ("images", "photographs", "images"), "--test-every": ("test_every", "4", "8")}
    for option, (name, before, given) in wrong.items():
        error = refused(capsys, commands.train, *command, "--resume", option, given)
        assert error == f"error: {name} must be {before} or None where a training is resumed, got {given}\n"
    assert {path: path.read_bytes() for path in out.iterdir()} == written


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
