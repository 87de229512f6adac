"""How many Gaussians a training may have at most, where nobody said: as many as its pictures can show."""

import json

import pytest
import train_extra  # noqa: F401
from capture_files import circle, write_nerf_synthetic
from cli_extra import image
from wall import cameras, write_wall

from analytic_rasterizer import cli, training
from analytic_rasterizer.training import TrainingOptions, files, start


@pytest.mark.parametrize(
    "options, views, expected",
    [
        ({"scales": (8,)}, (43, 539, 960), 21_600),  # of a newcomer: 387,672 Gaussians for as many pixels
        ({}, (43, 539, 960), None),
        ({"scales": (8, 1)}, (43, 539, 960), None),
        ({"scales": (8, 4)}, (43, 539, 960), 86_400),
        ({}, (36, 160, 120), 43_200),
        ({}, (12, 800, 533), 319_800),
        ({}, (256, 800, 533), None),
        ({}, (100, 800, 800), None),
        ({}, (3, 8, 8), start.FEWEST),
        ({"density": "mcmc"}, (36, 160, 120), 43_200),
        ({"density": "none"}, (36, 160, 120), None),
        ({"pixels_per_gaussian": 0.0}, (36, 160, 120), None),
        ({"pixels_per_gaussian": 8.0}, (36, 160, 120), 86_400),
        ({"max_gaussians": 500}, (36, 160, 120), None),
        ({"max_gaussians": 0}, (36, 160, 120), None),
    ],
    ids=str,
)
def test_the_limit(options, views, expected):
    count, width, height = views
    of_size = [(width, height)] * count
    limit = start.pixel_limit(TrainingOptions(**options), of_size)
    assert limit == (None if expected is None else pytest.approx(expected, rel=0.02))
    assert start.pixel_limit(TrainingOptions(**options), of_size, ["max_gaussians"]) is None


def test_the_recipe_of_3dgs_has_no_limit():
    assert start.pixel_limit(TrainingOptions.preset("3dgs"), [(8, 8)] * 3) is None


def test_a_training_says_it_and_keeps_it(tmp_path, capsys):
    """Also where it is resumed, and in its files."""
    write_nerf_synthetic(tmp_path / "capture", circle(10), circle(2))  # of 32x32 pixels
    arguments = ["train", str(tmp_path / "capture"), "--out", str(tmp_path / "out"), "--device", "cpu"]
    arguments += ["--no-evaluate", "--densify-every", "5", "--densify-from", "5", "--gradient", "1e-9"]
    assert cli.main([*arguments, "--iterations", "30", "--random-points", "300"]) == 0
    said = "at most 1,000 Gaussians, one for 16 pixels of 10 pictures, or twice those of the start"
    assert said in capsys.readouterr().err
    options = json.loads((tmp_path / "out" / files.OPTIONS).read_text())["options"]
    assert (options["max_gaussians"], options["random_points"]) == (start.FEWEST, 300)
    assert cli.main([*arguments[:7], "--resume", "--iterations", "40"]) == 0
    assert said not in capsys.readouterr().err
    history = [json.loads(line) for line in (tmp_path / "out" / files.LOG).read_text().splitlines()]
    assert 0 < max(entry["gaussians"] for entry in history) <= start.FEWEST


def test_pixels_are_those_of_the_files(tmp_path):
    """Of images_4, for example, which has the cameras of the whole photographs."""
    write_nerf_synthetic(tmp_path / "capture", circle(10), circle(2))
    for path in (tmp_path / "capture" / "train").iterdir():
        image.open(path).resize((16, 16)).save(path)
    options = TrainingOptions(iterations=1, effects="none", random_points=4, pixels_per_gaussian=1.0)
    assert training.Run(tmp_path / "capture", tmp_path / "out", options).options.max_gaussians == 10 * 16 * 16


def test_random_points_of_the_start_stay(tmp_path):
    """Though the pictures show fewer: with fewer a short training on lego was 1.1 dB worse."""
    write_nerf_synthetic(tmp_path / "capture", circle(10), circle(2))
    run = training.Run(tmp_path / "capture", tmp_path / "out", TrainingOptions(iterations=1, effects="none"))
    assert run.trainer.gaussians.count == run.options.random_points == 100_000
    assert run.options.max_gaussians == 200_000


def test_points_of_the_start_stay(tmp_path):
    folder = write_wall(tmp_path / "wall", cameras())
    run = training.Run(folder, tmp_path / "out", TrainingOptions(iterations=3, scales=(64,), effects="none"))
    assert run.trainer.gaussians.count == 600 and run.options.max_gaussians == 1200
    few = training.Run(folder, tmp_path / "few", TrainingOptions(iterations=3, max_gaussians=300, effects="none"))
    assert few.trainer.gaussians.count == 300
    many = TrainingOptions(iterations=3, pixels_per_gaussian=1e9, effects="none")
    assert training.Run(folder, tmp_path / "many", many).options.max_gaussians == 1200
