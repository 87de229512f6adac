"""What examples/fruit_fly.py does with its pictures, on pictures of a few Gaussians: it needs no MuJoCo."""

import json

import torch
from torch.nn.functional import avg_pool2d

import analytic_rasterizer as ar
import fruit_fly
import moving_fly
from analytic_rasterizer import io


def test_training_and_sheet(tmp_path):
    size = 64
    points = 0.2 * torch.randn(40, 3, generator=torch.Generator().manual_seed(0))
    truth = ar.Gaussians.from_points(points, points.sigmoid(), opacity=0.9, scale=0.3)
    views, pictures = [], []
    for i in range(4):
        pose = torch.eye(4, dtype=torch.float64)
        pose[2, 3] = 2 + 0.1 * i
        views.append(ar.View(f"{i}", size, size, 60.0, 60.0, pose))
        picture = fruit_fly.render(truth, views[-1], 1, "box:samples=16")
        pictures.append({n: avg_pool2d(picture, n) for n in fruit_fly.REDUCTIONS})
    fruit_fly.compare(fruit_fly.Photographs(views, pictures, points), tmp_path, steps=30, limit=100)
    measured = json.loads((tmp_path / "fruit_fly.json").read_text())
    assert len(measured) == 3 and all(set(scores) == {"1", "2", "4", "8"} for scores in measured.values())
    assert io.load_scene(tmp_path / "fruit_fly_moment.ply").count == 40
    with io.optional_import("PIL.Image").open(tmp_path / "fruit_fly.png") as sheet:
        assert sheet.width == 994


def test_directions_are_spread():
    azimuths, elevations = zip(*fruit_fly.directions(50))
    assert len(set(azimuths)) == 50 and min(elevations) > -75 and max(elevations) < 20


def test_film(tmp_path):
    white = torch.ones(3, 20, 24)
    rows = []
    for color in (0.2, 0.6):
        rows.append([])
        for i in range(4):
            picture = white.clone()
            picture[:, 5 + i : 9 + i, 6:12] = color
            rows[-1].append(picture)
    assert moving_fly.covered(rows[0]) == (5, 4, 13, 13)  # what any frame covers, and a pixel around it
    moving_fly.write_film(moving_fly.film(rows, zoom=3), tmp_path / "moving.png")
    with io.optional_import("PIL.Image").open(tmp_path / "moving.png") as moving:
        assert moving.n_frames == 4 and moving.size == (2 * 3 * 8 + moving_fly.GAP, moving_fly.LABEL + 3 * 9)
        moving.seek(3)  # the square is where the last frame has it
        shown = moving.convert("RGB")
    row = moving_fly.LABEL + 3 * (8 - 4) + 1
    assert max(shown.getpixel((10, row))) < 80 and min(shown.getpixel((10, row - 3))) > 240


def test_the_path_is_closed():
    path = moving_fly.path(40)
    assert len(set(path)) == 40
    steps = [abs(a[0] - b[0]) + abs(a[1] - b[1]) for a, b in zip(path, path[1:] + path[:1])]
    assert max(steps) < 3 and abs(steps[-1] - steps[0]) < 0.5
