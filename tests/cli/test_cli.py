"""The command line: what it writes, what it prints, and how it fails."""

import argparse
import errno
import importlib
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import replace

import numpy as np
import pytest
import torch
from cli_extra import image
from commands import refused, words_of
from gaussians import EYE, make_scene, make_view, of_inputs
from places import SHARED
from processes import DEADLINE, python_path, run_program

import analytic_rasterizer as ar
from analytic_rasterizer import cli, io
from analytic_rasterizer.cli import arguments as arguments_of_commands
from analytic_rasterizer.io.scenes import WRITTEN_IN_WORDS

FOOTPRINT_ARGUMENTS = {
    "default": ([], {"footprint": "point"}),  # what a file wants that says nothing
    "point": (["--footprint", "point"], {"footprint": "point"}),
    "dilation": (["--footprint", "point:dilation=0"], {"footprint": "point", "dilation": 0.0}),
    "box": (["--footprint", "box:samples=1"], {"footprint": "box", "samples": 1}),
    "samples": (["--footprint", "box", "--samples", "16"], {"footprint": "box", "samples": 16}),
}


@pytest.fixture
def files(tmp_path):
    """A small scene and two views of it, one with its principal point off centre."""
    views = [make_view(), io.View("off centre", 50, 40, 60.0, 65.0, EYE, cx=20.0, cy=25.0)]
    io.save_scene(tmp_path / "scene.ply", make_scene())
    io.save_views(tmp_path / "views.json", views)
    return tmp_path


def arguments(files, *extra):
    scene, views, out = files / "scene.ply", files / "views.json", files / "out"
    return words_of("render", scene, "--views", views, "--out", out, "--device cpu", *extra)


def run(*args, **options):
    """`python -m analytic_rasterizer` in its own process."""
    command = [sys.executable, "-m", "analytic_rasterizer", *map(str, args)]
    options |= {"capture_output": True, "text": True, "timeout": DEADLINE}
    return subprocess.run(command, env=os.environ | {"PYTHONPATH": python_path()}, **options)


@pytest.mark.parametrize("which", FOOTPRINT_ARGUMENTS)
def test_render_writes_what_the_library_renders(files, which, capsys):
    flags, options = FOOTPRINT_ARGUMENTS[which]
    extra = ["--scales", "2", "--background", "0.2", "0.4", "1"]
    assert cli.main(arguments(files, *flags, *extra)) == 0
    scene = io.load_scene(files / "scene.ply")
    views = io.load_views(files / "views.json")
    rows = [line.split() for line in capsys.readouterr().out.splitlines()]
    for view, name, row in zip(views, ["front", "off_centre"], rows[1:]):
        settings = view.settings(0.5, (0.2, 0.4, 1.0), scene.sh_degree, **options)
        color, _ = ar.GaussianRasterizer(settings)(means2D=None, **scene.arguments())
        expected = (color.clamp(0, 1) * 255).round().permute(1, 2, 0).numpy()
        written = np.asarray(image.open(files / "out" / f"{name}.png")).astype(float)
        # The two calls may differ in the last bit of float32, and so at a rounding boundary.
        assert written.shape == expected.shape
        assert np.abs(written - expected).max() <= 1
        assert (written != expected).mean() < 1e-3
        stages = ar.render_stages(settings, **scene.arguments())
        counts = [len(scene.means), len(stages.ids), len(stages.pairs)]
        size = f"{view.size(0.5)[0]}x{view.size(0.5)[1]}"
        assert row[:5] == [name, size, *map(str, counts)]
        project, bin_, blend, total = map(float, row[5:])
        assert total == pytest.approx(project + bin_ + blend, rel=1e-2)
    assert rows[0][:5] == ["view", "size", "Gaussians", "visible", "pairs"]
    assert rows[3][:2] == ["mean", "30"]
    assert len(rows) == 4


def test_render_in_a_process(files):
    done = run(*arguments(files, "--threads", "1"))
    assert done.returncode == 0
    hint = f"right at the size of the training, for others: bake {files / 'scene.ply'} --out FILE"
    chosen = f"footprint point:dilation=0.3: scene.ply names none, and 3DGS trains with it; {hint}"
    assert done.stderr.splitlines() == [chosen, "pictures of 50x40 to 64x48"]
    assert [line.split()[0] for line in done.stdout.splitlines()] == [*("view", "front", "off_centre", "mean")]


def test_render_says_the_size_of_pictures(files, capsys):
    assert cli.main(arguments(files, "--scales", "0.5,4")) == 0
    said = capsys.readouterr().err.splitlines()[-1]
    assert said == "pictures of 100x80 to 128x96, 12x10 to 16x12: 2 times, 1/4 of the 50x40 to 64x48 of the views"


def test_a_closed_stderr_changes_no_result(files, capsys, monkeypatch):
    monkeypatch.setattr("sys.stderr", None)
    assert cli.main(arguments(files)) == 0
    assert capsys.readouterr().out.startswith("view ")
    assert cli.main(["render", "nosuch", "--out", "a"]) == 2
    assert capsys.readouterr().out == ""


def test_size_for_views_that_state_none(files):
    frame = {"file_path": "a", "transform_matrix": torch.diag(torch.tensor([1, -1, -1, 1])).tolist()}
    (files / "views.json").write_text(json.dumps({"camera_angle_x": 0.8, "frames": [frame]}))
    assert cli.main(arguments(files, "--size", "40", "30")) == 0
    assert image.open(files / "out" / "a.png").size == (40, 30)


def unwritable(files):
    (files / "out").write_text("a file where the folder should be")


def scene_text(text):
    return lambda files: (files / "scene.ply").write_text(text)


def views_text(text):
    return lambda files: (files / "views.json").write_text(text)


def check_error(args, capsys, message):
    """One line says so, and nothing is printed."""
    assert message in refused(capsys, cli.main, args, prints=False)


PLY_OF_X = "ply\nformat binary_little_endian 1.0\nelement vertex 0\nproperty float x\nend_header\n"


@pytest.mark.parametrize(
    ("prepare", "extra", "message"),
    [
        (lambda files: (files / "scene.ply").unlink(), [], "scene.ply: no such file"),
        (scene_text("ply\nformat"), [], "scene.ply: the PLY header has no end_header"),
        (scene_text("jpeg"), [], "scene.ply: not a PLY file"),
        (scene_text(PLY_OF_X), [], "scene.ply: missing vertex properties y, z, f_dc_0"),
        (lambda files: (files / "views.json").unlink(), [], "views.json: No such file"),
        (views_text("[]"), [], "views.json: the list of views must be a list with at least one"),
        (views_text("{"), [], "views.json: not valid JSON"),
        (unwritable, [], "out: expected a folder for the results, got a file"),
        (None, "--footprint circle", "circle"),
        (None, "--footprint box:samples=3", "samples"),
        (None, "--footprint box:colour=3", "colour"),
        (None, "--footprint box:samples", "samples"),
        (None, "--footprint mip --samples 4", "samples"),
        (None, "--samples 4", "--samples is an option of a footprint, which --footprint names"),
        (None, "--samples x", "argument --samples: invalid int value: 'x'"),
        (None, "--scales 0", "argument --scales: must be reductions, positive numbers (2 is half the size), with"),
        (None, "--scales 2,nan", "with commas between them, got 2,nan"),
        (None, "--scales 1/2", "with commas between them, got 1/2"),
        (None, "--scales 1 2", "unrecognized arguments: 2; lists have commas and no spaces: 1,2,4"),
        (None, "--scale 0.5", "use --scales, which takes reductions: 2 is half the size; got 0.5"),
        (None, "--scales 1e-5", "6400000 x 4800000 px are too large, a side may have 1048576 px; larger numbers"),
        (None, "--scales 1e-4", "pictures of 640000 x 480000 px need 1.97e+04 GB, and "),
        (None, "--background 0 0", "must be black, white or three numbers from 0 to 1, as R,G,B, got 0 ("),
        (
            None,
            "--background 0 0 2",
            "must be black, white or three numbers from 0 to 1, as R,G,B, got 0,0,2",
        ),
        (None, "--background -1 0 0", "as R,G,B, got -1,0,0"),
        (None, "--background green", "as R,G,B, got green"),
        (None, "--background 1 1 1 --alpha", "--alpha leaves the background out"),
        (None, "--frames 3", "--frames is the number of pictures along a path: give --path"),
        (None, "--fps 3", "--fps is for a film: give --out FILE.mp4"),
        (None, "--path spiral", "argument --path: invalid choice: 'spiral'"),
        (None, "--out film.gif", "--out must be a folder, or a film that ends in .mp4, got film.gif"),
        (None, "--out film.mp4 --depth", "--depth is for pictures: give --out DIR, got film.mp4"),
        (None, "--out film.mp4 --scales 1,2", "a film has one size: give one number to --scales, got 2"),
        (None, "--out ", "expected the name of a folder for the results, got ''"),
        (None, "--threads 0", "must be a positive whole number, got 0"),
        (None, "--size 3 -3", "must be a positive whole number, got -3"),
        (None, "--device abacus", "argument --device: invalid choice: 'abacus'"),
        (None, "--frobnicate", "unrecognized arguments: --frobnicate"),
    ],
)
def test_errors_are_one_line(files, capsys, prepare, extra, message):
    if prepare:
        prepare(files)
    check_error(arguments(files, extra) if extra else arguments(files), capsys, message)


@pytest.mark.parametrize(
    ("args", "message"),
    [
        ("paint", "invalid choice: 'paint'"),
        ("render", "the following arguments are required: SCENE, --out"),
        ("render {} --out {}/out", "a folder without a scene: expected scene.ply with options.json, which"),
        ("evaluate {}/nosuch", "nosuch: no such file or folder"),
        ("bake {}/nosuch --out a.ply", "nosuch: no such file or folder"),
        ("tables", "tables has moved: in a clone of the repository, run python benchmarks/paper_tables.py"),
        ("tables 360-stst --data {}", "run python benchmarks/paper_tables.py"),
        ("errors --out {}", "errors has moved: in a clone of the repository, run python benchmarks/paper_err"),
        ("errors --help", "run python benchmarks/paper_errors.py"),
        ("view a.ply --footprint exact", "; with --server every footprint can be shown"),
        ("view a.ply --export ", "--export must end in .html, got"),
    ],
)
def test_wrong_commands_are_one_line(tmp_path, capsys, args, message):
    check_error(words_of(args.replace("{}", str(tmp_path))), capsys, message)


@pytest.mark.parametrize(
    ("args", "message"),
    [
        ("trian SCENE", "argument COMMAND: invalid choice: 'trian' (choose from"),
        ("trian SCENE", "; did you mean train? (see python -m analytic_rasterizer --help)"),
        ("--versoin", "unrecognized arguments: --versoin; did you mean --version? (see python -m"),
        ("train SCENE --ouut DIR", "arguments: --ouut; did you mean --out? (see python -m"),
        ("train SCENE --out DIR --max_gaussians=3", "; did you mean --max-gaussians? (see"),
        ("train SCENE --out DIR --iter 3", "arguments: --iter; did you mean --iterations? (see"),
        ("train SCENE --out DIR --iter 3", "(see python -m analytic_rasterizer train --help)"),
        ("train SCENE --picture-memory 1", "; did you mean --picture-memory-gpu or --picture-memory-host? (see"),
        ("train SCENE --out DIR --steps 3", "arguments: --steps; did you mean --iterations? (see"),
        ("render a.ply --model_path DIR", "; did you mean --out? (see"),
        ("train SCENE --out DIR --preset quik", "; did you mean quick? (see"),
        ("train SCENE --out DIR --xyzzy", "unrecognized arguments: --xyzzy (see"),
        ("render a.ply -out DIR", "unrecognized arguments: -out; did you mean --out? (see"),
        ("render a.ply --out DIR --scle 2", "; did you mean --scales? (see"),
        ("evaluate DIR --pictuers 1", "; did you mean --pictures? (see"),
        ("view a.ply --sever", "; did you mean --server? (see"),
        ("view a.ply --no-brows", "; did you mean --no-browser? (see"),
        ("bake a.ply --outt b.ply", "; did you mean --out? (see"),
        ("inspect a.ply --toleranse 1", "; did you mean --tolerance? (see"),
        ("pareto a.ply --vews v.json", "; did you mean --views? (see"),
    ],
)
def test_what_is_misspelt_or_cut_short_is_said_in_one_line(capsys, args, message):
    check_error(words_of(args), capsys, message)


def test_no_command_takes_parts_of_names(capsys):
    """Nor does any of its options: `--out` of `--output` would be another one day."""
    whole = cli.build_parser()
    commands = next(action for action in whole._actions if action.dest == argparse.SUPPRESS and action.choices).choices
    assert len(commands) == len(cli.COMMANDS)
    for name, parser in commands.items():
        for option in [option for action in parser._actions for option in action.option_strings if len(option) > 3]:
            if option[:-1] not in parser._option_string_actions:
                with pytest.raises(SystemExit):
                    whole.parse_args([name, option[:-1]])
                said = capsys.readouterr().err
                assert f"unrecognized arguments: {option[:-1]}" in said and said.count("\n") == 1
                assert option in said or option in ("--scale", "--picture")  # former names


def test_values_that_begin_like_options(capsys):
    """Negative numbers are values, and what follows -- is a name."""
    check_error(["train", "SCENE", "--out", "DIR", "--seconds", "-inf"], capsys, "--seconds: expected one argument")
    args = cli.build_parser().parse_args(["train", "--out", "DIR", "--seed", "-3", "--", "--scene"])
    assert (args.scene, args.seed) == ("--scene", -3)


def test_errors_of_a_process(tmp_path):
    done = run("render", "none.ply", "--views", "none.json", "--out", ".", cwd=tmp_path)
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr == "error: none.ply: no such file or folder\n"


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_folder_without_permission(files, capsys):
    (files / "out").mkdir(mode=0o500)
    assert cli.main(arguments(files)) == 2
    assert "Permission denied" in capsys.readouterr().err


def test_a_folder_that_cannot_be_written_is_named_and_no_file_in_it(files, capsys, monkeypatch):
    def read_only(dir):
        raise OSError(errno.EROFS, "Read-only file system", str(dir / "tmp12345"))

    monkeypatch.setattr(tempfile, "TemporaryFile", read_only)
    assert cli.main(arguments(files)) == 2
    said = "the folder for the results cannot be written to (Read-only file system)"
    assert capsys.readouterr().err == f"error: {files / 'out'}: {said}\n"


@pytest.mark.skipif(torch.cuda.is_available(), reason="needs a machine without CUDA")
def test_device_that_is_not_there(files, capsys):
    assert cli.main(arguments(files, "--device", "cuda")) == 2
    assert "no CUDA device" in capsys.readouterr().err


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
def test_render_on_cuda_agrees_with_the_cpu(files):
    assert cli.main(arguments(files)) == 0
    pictures = [np.asarray(image.open(path)) for path in sorted((files / "out").glob("*.png"))]
    assert cli.main(arguments(files, "--device", "cuda")) == 0
    for left, path in zip(pictures, sorted((files / "out").glob("*.png"))):
        right = np.asarray(image.open(path))
        # Thresholds (alpha < 1/255) may flip by the last bit of float32.
        assert np.abs(left.astype(int) - right).max() <= 2


@pytest.mark.parametrize("module", ["PIL.Image", "tqdm"])
def test_missing_library_names_the_extra(files, capsys, monkeypatch, module):
    monkeypatch.setitem(sys.modules, module, None)
    assert cli.main(arguments(files)) == 2
    assert 'pip install "analytic_rasterizer[cli]"' in capsys.readouterr().err


def test_a_warning_is_one_line(files):
    """In a process of its own: pytest keeps warnings from stderr."""
    scene = io.load_scene(files / "scene.ply")
    scene.means[3, 1] = float("nan")
    io.save_scene(files / "scene.ply", scene)
    code = "import sys; from analytic_rasterizer import cli; print(cli.main(sys.argv[1:]), file=sys.stderr)"
    done = run_program(code, *arguments(files), environment=os.environ | {"PYTHONPATH": python_path()})
    told = f"warning: {files / 'scene.ply'}: 1 of 30 Gaussians are left out: means of 1 are not finite"
    assert told in done.stderr.splitlines() and "UserWarning" not in done.stderr
    assert done.stderr.splitlines()[-1] == "0"


def test_interrupt_is_quiet(files, capsys, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(io, "load_scene", interrupted)
    assert cli.main(arguments(files)) == 130
    assert capsys.readouterr() == ("", "")


@pytest.mark.skipif(os.name != "posix", reason="sends a POSIX signal")
def test_interrupt_of_a_process_is_quiet(files):
    """A run of `render` over many views, of which the first is written when the signal comes."""
    view = io.load_views(files / "views.json")[0]
    io.save_views(files / "views.json", [replace(view, name=f"{i}") for i in range(3000)])
    process = subprocess.Popen(
        [sys.executable, "-m", "analytic_rasterizer", *arguments(files, "--scales", "0.125")],  # minutes
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": python_path()},
        # A job in the background of a script ignores SIGINT, and its children with it.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    deadline = time.monotonic() + DEADLINE
    while not (files / "out" / "0.png").exists() and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=DEADLINE)
    assert (process.returncode, out) == (130, "")
    choice, size = err.splitlines()
    assert choice.startswith("footprint point") and size == "pictures of 512x384: 8 times of the 64x48 of the views"
    assert not (files / "out" / "2999.png").exists()


def inspect_arguments(files, *extra):
    return words_of("inspect", files / "scene.ply", "--views", files / "views.json", "--device cpu", *extra)


def test_inspect_prints_the_report_and_writes_its_files(files, capsys):
    pytest.importorskip("matplotlib", reason="needs the analysis extra")
    out = files / "out"
    extra = ["--json", out / "report.json", "--picture", out / "report.png", "--scales 0.5 --tolerance 0.01"]
    assert cli.main(inspect_arguments(files, *extra, "--training-views", files / "views.json")) == 0
    text, report = capsys.readouterr().out, json.loads((out / "report.json").read_text())
    assert f"cheapest within the tolerance: footprint {report['recommendation']['footprint']}" in text
    assert report["tolerance"] == 0.01
    assert [(view["name"], view["width"], view["height"]) for view in report["views"]] == [
        ("front", 128, 96),
        ("off_centre", 100, 80),
    ]
    assert report["views"][0]["finest"] == pytest.approx(2)  # --scales leaves the training views as they are
    assert image.open(out / "report.png").width > 900


def test_inspect_prints_json_alone(files, capsys):
    assert cli.main(inspect_arguments(files, "--json", "-", "--max-views", "1")) == 0
    report = json.loads(capsys.readouterr().out)
    assert [view["name"] for view in report["views"]] == ["front"]
    assert report["gaussians"] == 30 and report["sh_degree"] == 2


@pytest.mark.parametrize(
    ("extra", "message"),
    [
        ("--tolerance -1", "argument --tolerance: must be a number that is not negative, got -1"),
        ("--max-views 0", "argument --max-views: must be a positive whole number, got 0"),
        ("--training-views none.json", "none.json: No such file"),
        ("--plot a.gif", "--plot must end in .png, .svg or .pdf, got a.gif"),
        ("--json views.json/report.json", "views.json: expected a folder for the results, got a file"),
        ("--json .", ".: expected a file for the results, got a folder"),
    ],
)
def test_errors_of_inspect_are_one_line(files, capsys, monkeypatch, extra, message):
    monkeypatch.chdir(files)
    check_error(inspect_arguments(files, extra), capsys, message)


def test_inspect_without_matplotlib_names_the_extra(files, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    check_error(inspect_arguments(files, "--plot", "a.png"), capsys, 'pip install "analytic_rasterizer[analysis]"')


def bake_arguments(files, *extra):
    scene, views, out = files / "scene.ply", files / "views.json", files / "new" / "baked.ply"
    return words_of("bake", scene, "--views", views, "--out", out, "--device cpu", *extra)


@pytest.mark.parametrize(("extra", "dilation"), [([], 0.3), (["--dilation", "0.5"], 0.5)])
def test_bake_writes_what_the_library_bakes(files, capsys, extra, dilation):
    baked = files / "new" / "baked.ply"
    scene = io.load_scene(files / "scene.ply")
    assert cli.main(bake_arguments(files, *extra)) == 0
    seen = "30 of 30 Gaussians, which are seen in 2 pictures of 50x40 to 64x48, are baked"
    assert capsys.readouterr().out == f"{baked}: {seen}\n"
    found = io.load_scene(baked)
    cameras = [view.settings() for view in io.load_views(files / "views.json")]
    gaussians = scene.means, scene.scales, scene.rotations, scene.opacities
    scales, opacities = ar.bake_dilation(*gaussians, cameras, dilation)
    assert torch.allclose(found.scales, scales, rtol=1e-5)
    assert torch.allclose(found.opacities, opacities, rtol=1e-5, atol=2e-6)  # files keep them off 0 and 1 by 1e-6
    assert torch.equal(found.means, scene.means) and torch.equal(found.shs, scene.shs)
    assert b"comment SplatRenderMode: mip\n" in baked.read_bytes()


@pytest.mark.parametrize("name", ["baked.PLY", "baked.compressed.ply", "baked.spz"])
def test_a_baked_scene_says_so_in_every_format(files, capsys, name):
    baked = files / "new" / name
    assert cli.main(bake_arguments(files, "--out", str(baked))) == 0
    assert io.read_metadata(baked).footprint == "moment:samples=4"
    capsys.readouterr()
    twice = ["bake", str(baked), "--views", str(files / "views.json"), "--out", str(files / "twice.ply")]
    check_error(twice, capsys, "no dilation to bake: it says that pixels are to be integrated")


def test_bake_takes_the_scale_of_the_training(files):
    baked = files / "new" / "baked.ply"
    assert cli.main(bake_arguments(files, "--dilation", "0.5")) == 0
    plain = baked.read_bytes()
    io.save_views(files / "views.json", [view.scaled(4) for view in io.load_views(files / "views.json")])
    assert cli.main(bake_arguments(files, "--dilation", "0.5", "--scales", "4")) == 0
    assert baked.read_bytes() == plain


def test_bake_refuses_what_has_nothing_to_bake(files, capsys):
    assert cli.main(bake_arguments(files)) == 0
    capsys.readouterr()
    twice = ["bake", str(files / "new" / "baked.ply"), "--views", str(files / "views.json"), "--out"]
    message = "baked.ply: no dilation to bake: it says that pixels are to be integrated"
    check_error([*twice, str(files / "twice.ply")], capsys, message)
    away = torch.diag(torch.tensor([1.0, -1, -1, 1], dtype=torch.float64))
    io.save_views(files / "views.json", [replace(view, w2c=away) for view in io.load_views(files / "views.json")])
    check_error(bake_arguments(files), capsys, "views.json: no view sees any Gaussian of")


@pytest.mark.parametrize(
    ("extra", "message"),
    [
        ("--out {}/baked.obj", f"baked.obj: expected a {WRITTEN_IN_WORDS} name, got '.obj'"),
        ("--out {}/baked.json", f"baked.json: expected a {WRITTEN_IN_WORDS} name, got '.json'"),
        ("--out {}/scene.ply/baked.ply", "scene.ply: expected a folder for the results, got a file"),
        ("--out {}/scene.ply", "scene.ply: expected another file than the scene, which is not overwritten"),
        ("--dilation 0.05", "argument --dilation: must be a number from 1/12, got 0.05"),
        ("--dilation x", "argument --dilation: must be a number from 1/12, got x"),
        ("--scales 0", "argument --scales: must be a reduction, a positive number (2 is half the size), got 0"),
        ("--scales 1,2", "argument --scales: must be a reduction, a positive number (2 is half the size), got 1,2"),
        ("--footprint point:dilation=0", "no dilation to bake: it was trained with point:dilation=0.0, "),
        ("--views {}/none.json", "none.json: No such file"),
    ],
)
def test_errors_of_bake_are_one_line(files, capsys, extra, message):
    before = sorted(files.rglob("*"))
    check_error(bake_arguments(files, extra.format(files)), capsys, message)
    assert sorted(files.rglob("*")) == before


def test_version_and_help(capsys):
    with pytest.raises(SystemExit, match=r"^0$"):
        cli.main(["--version"])
    assert capsys.readouterr().out == f"analytic_rasterizer {ar.__version__}\n"


def test_without_a_command_it_says_what_is_installed(capsys):
    """And which wheels fit this torch."""
    assert cli.main([]) == 0
    first, second, _, line, last = capsys.readouterr().out.splitlines()
    assert first.startswith(f"analytic_rasterizer {ar.__version__}, built for torch {torch.__version__}, for the CPU")
    assert second.startswith(f"torch {torch.__version__} with ")
    assert re.fullmatch(r"    pip install --index-url INDEX/pt\d+(cpu|cu\d+) analytic-rasterizer", line)
    assert "--help" in last
    for args in ([], ["render"], ["pareto"], ["inspect"]):
        args = [*args, "--help"]
        with pytest.raises(SystemExit, match=r"^0$"):
            cli.main(args)
        text = capsys.readouterr().out
        assert text.startswith("usage: python -m analytic_rasterizer")
        if args[0] in ("render", "pareto"):
            assert all(footprint in text for footprint in ar.FOOTPRINTS)


def test_shared_views(tmp_path, plant):
    inputs, _ = plant
    scene = of_inputs(inputs)
    io.save_scene(tmp_path / "scene.ply", scene)
    views = SHARED / "data" / "plant_sh3_lo.json"
    args = ["render", str(tmp_path / "scene.ply"), "--views", str(views), "--out", str(tmp_path)]
    assert cli.main([*args, "--footprint", "box"]) == 0
    names = sorted(path.name for path in tmp_path.glob("*.png"))
    assert names == ["view_000.png", "view_001.png", "view_002.png"]
    for name in names:
        picture = np.asarray(image.open(tmp_path / name))
        assert picture.shape == (135, 240, 3)
        # The mean radiance of the integrated plant is 0.0300, averaged over the views.
    mean = np.mean([np.asarray(image.open(tmp_path / name)).mean() for name in names]) / 255
    assert mean == pytest.approx(0.0300, abs=0.002)


@pytest.mark.parametrize(
    "version, name", [("2.4.1", "PYTORCH_CUDA_ALLOC_CONF"), ("2.9.1+cu128", "PYTORCH_CUDA_ALLOC_CONF"),
                      ("2.10.0", "PYTORCH_ALLOC_CONF"), ("2.14.0.dev2026", "PYTORCH_ALLOC_CONF")],
)  # fmt: skip
def test_memory_of_cuda_is_mapped_by_pages_unless_the_user_has_said_how(version, name, monkeypatch):
    for other in arguments_of_commands.ALLOCATOR_VARIABLES:
        monkeypatch.setenv(other, "")  # so that it is as before in the end
        monkeypatch.delenv(other)
    monkeypatch.setattr(torch, "__version__", version)
    monkeypatch.setattr(torch.cuda, "is_initialized", lambda: True)
    arguments_of_commands.use_expandable_segments()
    assert name not in os.environ
    monkeypatch.setattr(torch.cuda, "is_initialized", lambda: False)
    monkeypatch.setattr(sys, "platform", "linux")
    for given in arguments_of_commands.ALLOCATOR_VARIABLES:
        with monkeypatch.context() as said:
            said.setenv(given, "expandable_segments:False")
            arguments_of_commands.use_expandable_segments()
            assert [v for v in arguments_of_commands.ALLOCATOR_VARIABLES if v in os.environ] == [given]
    arguments_of_commands.use_expandable_segments()
    assert os.environ[name] == "expandable_segments:True"
    assert sum(other in os.environ for other in arguments_of_commands.ALLOCATOR_VARIABLES) == 1


@pytest.mark.parametrize("command", ["train", "view", "evaluate"])
def test_commands_that_run_for_long_map_memory_by_pages(command, monkeypatch):
    """Before they do anything else; the library never does."""
    module = importlib.import_module(f"analytic_rasterizer.cli.{command}")

    def stop():
        raise KeyboardInterrupt

    monkeypatch.setattr(module, "use_expandable_segments", stop)
    with pytest.raises(KeyboardInterrupt):
        module.run(argparse.Namespace())
