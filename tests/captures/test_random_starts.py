"""Random starts of captures without points: about what the cameras look at, and where photographs count."""

import numpy as np
import pytest
import torch
from capture_files import circle, looking_at_origin, tripod
from train_extra import image

import analytic_rasterizer as ar
from analytic_rasterizer import io
from analytic_rasterizer.captures import placement
from analytic_rasterizer.captures.photographs import MASK_SIZE, counted_pixels

RING = circle(20)  # at 4 from zero, all around, and looking there


def disc(size, radius):
    """(size, size) bool: a disc in the middle."""
    row, column = torch.meshgrid(*2 * [torch.arange(size) + 0.5 - size / 2], indexing="ij")
    return row.square() + column.square() < radius**2


def pixels(view, points):
    w2c = view.w2c.double()
    return view.pixels_of(points.double() @ w2c[:3, :3].T + w2c[:3, 3])


def share_counted(points, masks):
    """The mean over views that show a point of whether they count it."""
    counted, shown = 0, 0
    for view, mask in zip(RING, masks):
        found = pixels(view, points)
        inside = ((found >= 0) & (found < 32)).all(1)
        column, row = (found * mask.shape[0] / 32).long().clamp(0, mask.shape[0] - 1).unbind(1)
        counted, shown = counted + (inside & mask[row, column]), shown + inside.long()
    return (counted / shown.clamp_min(1)).mean().item()


def test_points_are_within_the_visual_hull():
    masks = [disc(64, 12)] * len(RING)
    with_masks, _ = placement.points_in_view(RING, 2000, 0, masks)
    without, _ = placement.points_in_view(RING, 2000, 0)
    # 0.78 and 0.17; not 1, as a depth is drawn from a whole part.
    assert share_counted(with_masks, masks) > 0.7 > 0.3 > share_counted(without, masks)


def test_a_photograph_that_counts_nothing_does_not_stop_it():
    masks = [torch.zeros(8, 8, dtype=torch.bool), *[None] * (len(RING) - 1)]
    points, _ = placement.points_in_view(RING, 500, 0, masks)
    assert points.isfinite().all()
    nothing = [torch.zeros(8, 8, dtype=torch.bool)] * len(RING)
    assert placement.points_in_view(RING, 500, 0, nothing)[0].isfinite().all()


def test_few_points_are_just_before_a_camera():
    points, _ = placement.points_in_view(RING, 4000, 0)
    depths = torch.stack([(points.double() @ v.w2c[:3, :3].double().T + v.w2c[:3, 3].double())[:, 2] for v in RING])
    inside = torch.stack([((found := pixels(v, points)) >= 0).all(1) & (found < 32).all(1) for v in RING])
    nearest = torch.where(inside & (depths > 0), depths, torch.inf).amin(0)
    assert (nearest < 2).double().mean() < 0.15


def test_cameras_at_one_place():
    """Nothing says how far things are: all depths have points."""
    views = tripod(9)
    center = torch.linalg.inv(views[0].w2c.double())[:3, 3]
    points, _ = placement.points_in_view(views, 4000, 0)
    distances = (points.double() - center).norm(dim=1)
    assert (distances.quantile(0.9) / distances.quantile(0.1)).item() > 4


@pytest.mark.parametrize("count", [1, 7, placement.MOST_RAYS, 2 * placement.MOST_RAYS + 3])
def test_every_number_of_points(count):
    points, colors = placement.points_in_view(RING, count, 3)
    assert points.shape == colors.shape == (count, 3) and len(points.unique(dim=0)) == count
    assert torch.equal(points, placement.points_in_view(RING, count, 3)[0])
    assert not torch.equal(points, placement.points_in_view(RING, count, 4)[0])


def save(path, *planes):
    image.fromarray(np.stack(planes, -1) if len(planes) > 1 else planes[0]).save(path)


def test_pixels_that_count(tmp_path):
    half = np.zeros((600, 500), np.uint8)
    half[:, :250] = 255
    full = np.full_like(half, 255)
    save(tmp_path / "alpha.png", full, full, full, half)
    save(tmp_path / "opaque.png", full, full, full, full)
    save(tmp_path / "mask.png", half.T.copy().T)
    files = {name: tmp_path / f"{name}.png" for name in ("alpha", "opaque", "mask")}
    by_alpha = counted_pixels(files["alpha"], None)
    by_mask = counted_pixels(files["opaque"], files["mask"])
    assert max(by_alpha.shape) <= MASK_SIZE and torch.equal(by_alpha, by_mask)
    assert by_alpha[:, : by_alpha.shape[1] // 2].all() and not by_alpha[:, by_alpha.shape[1] // 2 + 1 :].any()
    assert counted_pixels(files["opaque"], None) is None
    assert counted_pixels(tmp_path / "gone.png", None) is None


def test_views_through_a_lens():
    """Where a lens shows nothing, points are ahead of the camera."""
    views = [io.View(view.name, 32, 32, 9.0, 9.0, view.w2c, lens=ar.Lens.perspective((-0.4,))) for view in circle(8)]
    assert placement.points_in_view(views, 800, 0)[0].isfinite().all()


@pytest.mark.parametrize("where", [(0, 0, 0), (300, -200, 100)])
def test_random_points_are_where_the_cameras_look(where):
    """For cameras around a place, side by side, and at one place, whatever the origin and the unit."""
    around = circle(12)
    beside = [io.View(f"{i}", 32, 32, 36.0, 36.0, looking_at_origin(0.0)) for i in range(9)]
    for i, view in enumerate(beside):
        view.w2c[0, 3] = 0.02 * i
    one_place = [io.View(f"{i}", 32, 32, 36.0, 36.0, looking_at_origin(0.5 * i, 0.0)) for i in range(9)]
    for views, farthest in ((around, 20.0), (beside, 20.0), (one_place, 10.0)):
        views = [view.in_frame(tuple(-float(number) for number in where)) for view in views]
        points, colors = placement.points_in_view(views, 500, seed=0)
        assert points.shape == colors.shape == (500, 3) and points.dtype == torch.float32
        w2c = torch.stack([view.w2c for view in views])
        seen = points.double() @ w2c[:, :3, :3].mT + w2c[:, None, :3, 3]
        x, y, z = seen.unbind(2)
        inside = (z > 0) & ((36 * x / z).abs() <= 16.01) & ((36 * y / z).abs() <= 16.01)
        assert inside.any(0).all()
        distances = (points.double() - torch.tensor(where, dtype=torch.float64)).norm(dim=1)
        assert distances.max() < farthest
        assert torch.equal(points, placement.points_in_view(views, 500, seed=0)[0])
    near = placement.points_in_view(around, 500, seed=0)[0].norm(dim=1)
    assert near.median() < 6  # the place that they look at is at zero, 4 from each
