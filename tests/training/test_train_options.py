"""Options of a training: of which types, in files, presets, and what the command says of them."""

import functools
import json
import math
import re
from dataclasses import fields, replace

import commands
import numpy as np
import pytest
import runs
import torch
import train_extra  # noqa: F401
from commands import refused

from analytic_rasterizer import cli
from analytic_rasterizer.training import TrainingOptions

make_run = functools.partial(runs.make_run, **runs.SHORT)


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
