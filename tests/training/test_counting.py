"""What no photograph counts is pruned where there are masks, and nothing else changes."""

import commands
import numpy as np
import pytest
import runs
import torch
from capture_files import circle, draw_picture, write_colmap
from cli_extra import image

from analytic_rasterizer import training
from analytic_rasterizer.training import files
from analytic_rasterizer.training.counting import COUNTED, Counting

SIZE, VIEWS, FIRST_ROW = (40, 36), 8, 14  # the first row that counts
INSIDE, OUTSIDE = 60, 25  # points: of the object, and of what masks leave out in every photograph
OPTIONS = {"iterations": 80, "densify_every": 5, "densify_from": 5, "max_gaussians": 400, "effects": "none"}


def write_capture(folder, masked=True):
    """Photographs whose middle counts; of the points some are above, where no pixel does."""
    views, generator = circle(VIEWS, SIZE), torch.Generator().manual_seed(0)
    points = torch.rand(INSIDE + OUTSIDE, 3, generator=generator) - 0.5
    points[INSIDE:] = points[INSIDE:] * torch.tensor([0.5, 0.1, 0.5]) - torch.tensor([0.0, 1.0, 0.0])
    for part in ("images", "masks"):
        (folder / part).mkdir(parents=True)
    for view in views:
        mask = np.zeros((SIZE[1], SIZE[0]), np.uint8)
        mask[FIRST_ROW:] = 255
        pixels = view.pixels_of(points.double() @ view.w2c[:3, :3].double().T + view.w2c[:3, 3].double())
        assert (pixels[INSIDE:, 1] < FIRST_ROW - 4).all()
        image.fromarray(draw_picture(view, opaque=True)).save(folder / "images" / f"{view.name}.png")
        if masked:
            image.fromarray(mask).save(folder / "masks" / f"{view.name}.png.png")
    write_colmap(folder / "sparse" / "0", views, points, torch.full((len(points), 3), 128, dtype=torch.int32))
    return folder


@pytest.fixture(scope="module")
def masked(tmp_path_factory):
    return write_capture(tmp_path_factory.mktemp("masked") / "scene")


def above(gaussians) -> int:
    """How many Gaussians are where masks leave out everything."""
    return int((gaussians.means[:, 1] < -0.75).sum())


@pytest.mark.parametrize("density", ["3dgs", "absgrad", "mcmc"])
def test_what_no_photograph_counts_is_pruned(masked, tmp_path, monkeypatch, density):
    run = runs.trained(masked, tmp_path / "out", density=density, noise=0.0, **OPTIONS)
    assert above(run.trainer.gaussians) == 0 and run.trainer.counting.pruned >= OUTSIDE
    assert len(run.trainer.density.extra[COUNTED]) == run.count() >= INSIDE
    monkeypatch.setattr(Counting, "called_for", staticmethod(lambda *given: False))
    without = runs.trained(masked, tmp_path / "without", density=density, noise=0.0, **OPTIONS)
    assert density == "mcmc" or above(without.trainer.gaussians) >= OUTSIDE


def test_nothing_is_pruned_within_a_pass(masked, tmp_path):
    """The first look begins with the first pass, and is over with it; the others hold a whole pass."""
    run = runs.make_run(masked, tmp_path, **OPTIONS)
    trainer, counted = run.trainer, []
    drop = trainer.counting.drop
    trainer.counting.drop = lambda of: (drop(of), counted.append((of.progress.step, trainer.counting.begun)))
    while run.progress.share < 0.7:
        trainer.step()
    per_pass = trainer.counting.per_pass
    assert per_pass == len(trainer.pictures.views) == VIEWS - 1
    # Changes are after 10, 15, .. steps. A look that begins at 10 has its first whole pass from 14 to 21.
    assert counted[:5] == [(10, 10), (15, 10), (20, 10), (25, 25), (30, 25)]


def test_without_masks_there_is_nothing_to_count(tmp_path):
    run = runs.make_run(write_capture(tmp_path / "scene", masked=False), tmp_path / "out", **OPTIONS)
    assert run.trainer.counting is None and run.trainer.density.extra == {}
    for _ in range(30):
        run.trainer.step()
    assert above(run.trainer.gaussians) >= OUTSIDE and run.trainer.state_dict()["counting"] is None


def test_without_density_control_the_number_stays(masked, tmp_path):
    run = runs.trained(masked, tmp_path, **OPTIONS | {"density": "none", "iterations": 20})
    assert run.trainer.counting is None and run.count() == INSIDE + OUTSIDE


def test_a_resumed_training_has_the_same_bits(masked, tmp_path):
    """With a break within a look."""
    runs.trained(masked, tmp_path / "whole", **OPTIONS)
    run = runs.make_run(masked, tmp_path / "parts", **OPTIONS)
    for _ in range(7):
        run.trainer.step()
    assert run.trainer.density.extra[COUNTED].any()
    run.save()
    again = training.Run(masked, tmp_path / "parts", resume=True)
    assert torch.equal(again.trainer.density.extra[COUNTED], run.trainer.density.extra[COUNTED])
    again.train()
    assert (tmp_path / "whole" / files.SCENE).read_bytes() == (tmp_path / "parts" / files.SCENE).read_bytes()


def test_a_training_that_counts_nothing_ends(masked, tmp_path):
    run = runs.make_run(masked, tmp_path, **OPTIONS)
    with torch.no_grad():
        run.trainer.gaussians.means[:, 1] -= 2
    with pytest.raises(RuntimeError, match="masks leave out all that the 85 Gaussians show by step 10"):
        run.train()


def test_the_command_says_how_many(masked, tmp_path, capsys):
    words = "--iterations 80 --densify-every 5 --densify-from 5 --max-gaussians 400 --effects none --no-evaluate"
    assert commands.train(masked, tmp_path / "out", words) == 0
    assert "Gaussians were taken away because masks leave out all that they show" in capsys.readouterr().out
