"""Depth maps beside photographs: what is read of them, and what is found of their scale."""

import json
import math

import numpy as np
import pytest
import torch
from cli_extra import image
from depth_maps import deep_wall, depth_of, save_16, write_transforms
from wall import COUNT, SIZE, cameras, wall_points, write_wall

from analytic_rasterizer import Lens, io
from analytic_rasterizer.captures import depth
from analytic_rasterizer.captures.depth import fitted_scale, measure_maps, points_in, seen_points
from analytic_rasterizer.captures.depth_files import DepthFile, read_depth
from analytic_rasterizer.captures.loading import read_cameras
from analytic_rasterizer.training import plan
from analytic_rasterizer.training.plan import NO, YES, plan_capture

STEEP = cameras()[:4]  # which see the wall aslant, so that there is a shift
# Points are compared with the pixel that they are in, whose middle is half a pixel off at most: of a slope of 0.4, of
# 180 px in a depth of 4 and depths up to 4.7, so much of a depth.
OF_PIXELS = 0.5 * 0.4 * 1.2 / 180 / 0.6


def photographs(folder, cameras=None) -> tuple[list, torch.Tensor]:
    found = read_cameras(folder, "images", 0, cameras, "refuse")
    return sorted(found.train, key=lambda item: item.view.name), found.points[0]


def measured(folder, **how) -> list:
    items, points = photographs(folder)
    return measure_maps(items, points, {}, **how)


def check_depths(found, views, tolerance) -> None:
    """Inverse depths of the maps are those of the wall, but for a part of them."""
    for one, view in zip(found, views, strict=True):
        assert one.map is not None, (one.problem, one.about)
        raw, shares = read_depth(one.map.file, view)
        inverse = one.map.file.scale * raw + one.map.file.shift
        assert (shares == 1).all()
        expected = 1 / depth_of(view, raw.shape[::-1])
        np.testing.assert_allclose(inverse.numpy(), expected, rtol=tolerance)
        assert one.map.reference == pytest.approx(1 / torch.from_numpy(expected).median().item(), rel=tolerance)


@pytest.mark.parametrize("size", [None, (80, 60), (320, 240)], ids=["as large", "smaller", "larger"])
def test_inverse_depths_with_their_scale(tmp_path, size):
    found = measured(deep_wall(tmp_path, size=size), fit=False)
    check_depths(found, cameras(), 2e-4)  # half a level of 2^-16, of an inverse depth of a quarter
    assert not any(one.fitted for one in found)
    assert all(one.difference < 2 * OF_PIXELS for one in found)  # pixels of the smaller maps are twice as wide


@pytest.mark.parametrize("parameters", [False, True])
def test_a_scale_that_is_wrong_or_missing_is_fitted(tmp_path, parameters):
    def halved(i, levels):
        return levels * (0.5 + 0.05 * i)

    folder = deep_wall(tmp_path, STEEP, change=halved, parameters=parameters)
    found = measured(folder)
    check_depths(found, STEEP, OF_PIXELS)
    assert all(one.fitted for one in found)
    wrong = measured(folder, fit=False)
    assert {one.problem for one in wrong} == {depth.WRONG if parameters else depth.UNSCALED}


@pytest.mark.parametrize("mode", ["L", "RGB"])
def test_inverse_depths_of_8_bits(tmp_path, mode):
    """As Depth Anything writes them: from black to white, alike in all channels."""
    folder = deep_wall(tmp_path, STEEP, parameters=False)
    for view in STEEP:
        inverse = 1 / depth_of(view)
        levels = np.round(255 * (inverse - inverse.min()) / np.ptp(inverse)).astype(np.uint8)
        image.fromarray(levels).convert(mode).save(folder / "depths" / f"{view.name}.png")
    ranges = [np.ptp(1 / depth_of(view)) * depth_of(view).max() for view in STEEP]
    check_depths(measured(folder), STEEP, OF_PIXELS + max(ranges) / 255)


def test_depths_need_more_than_8_bits(tmp_path):
    views = write_transforms(tmp_path)
    image.new("L", SIZE, 9).save(tmp_path / "deep" / "p_0.png")
    items, _ = photographs(tmp_path)
    with pytest.raises(
        io.SceneError, match=r"expected a depth map: a grey picture of 16 bits, or \.npy, got one of mode L"
    ):
        read_depth(items[0].depth, views[0])


def test_a_fit_bears_wrong_depths(tmp_path):
    def spoilt(i, levels):
        levels = levels.copy()
        levels[:, :48] = 60_000  # three tenths of the map are far too near
        return levels

    for one, view in zip(measured(deep_wall(tmp_path, STEEP, change=spoilt)), STEEP, strict=True):
        raw = read_depth(one.map.file, view)[0][:, 48:]
        inverse = (one.map.file.scale * raw + one.map.file.shift).numpy()
        np.testing.assert_allclose(inverse, 1 / depth_of(view)[:, 48:], rtol=OF_PIXELS)


def test_the_fit_is_that_of_most_points():
    generator = torch.Generator().manual_seed(0)
    raw = torch.rand(400, generator=generator, dtype=torch.float64)
    inverse = 0.7 * raw + 0.2
    inverse[:150] = 3 * torch.rand(150, generator=generator, dtype=torch.float64)
    assert fitted_scale(raw, inverse) == pytest.approx((0.7, 0.2), abs=1e-6)
    assert fitted_scale(raw, -inverse) is None, "a scale that turns near and far round"
    flat = 0.5 + 0.01 * raw
    assert fitted_scale(flat, 0.7 * flat) == pytest.approx((0.7, 0), abs=1e-3), "nothing tells a shift from a scale"


@pytest.mark.parametrize("suffix, unit", [(".png", 1e-3), (".npy", 1e-3), (".npy", 1.0)])
def test_depths_of_nerfstudio(tmp_path, suffix, unit):
    views = write_transforms(tmp_path, suffix, unit)
    check_depths(measured(tmp_path, unit=unit, fit=False), views, 2e-4)
    check_depths(measured(tmp_path)[:4], views[:4], OF_PIXELS)


def test_what_was_not_measured_counts_nothing(tmp_path):
    def frame(i, told):
        (tmp_path / "sure").mkdir(exist_ok=True)
        image.fromarray(np.full(SIZE[::-1], 2, np.uint8) * (np.arange(160) < 80)).save(tmp_path / "sure" / f"{i}.png")
        return told | {"confidence_file_path": f"sure/{i}.png"}

    views = write_transforms(tmp_path, ".npy", 1.0, frame)
    for view, bad in zip(views, (0, -1, math.nan, math.inf)):
        depths = depth_of(view)
        depths[:60] = bad
        np.save(tmp_path / "deep" / f"{view.name}.npy", depths)
    items, points = photographs(tmp_path)
    for item in items[:4]:
        raw, shares = read_depth(item.depth, item.view)
        assert (shares[60:, :80] == 1).all() and shares.sum() == 60 * 80
        assert (raw[:60] == 0).all() and raw.isfinite().all()
    check = measure_maps(items, points, {}, unit=1.0, fit=False)
    assert all(one.map is not None for one in check)


def test_inverse_depths_beyond_infinity_are_at_infinity_and_count(tmp_path):
    save_16(tmp_path / "a.png", np.zeros((4, 4)))
    view = io.View("a", 4, 4, 4.0, 4.0, torch.eye(4, dtype=torch.float64))
    raw, shares = read_depth(DepthFile(tmp_path / "a.png", True, 1.0), view)
    assert (raw == 0).all() and (shares == 1).all()


def spoil(path) -> None:
    path.write_bytes(path.read_bytes()[:60])


@pytest.mark.parametrize(
    "change, message",
    [
        (spoil, "unreadable or cut short"),
        (
            lambda path: image.new("RGB", SIZE, (9, 8, 9)).save(path),
            "expected a depth map: a grey picture of 16 bits, got one of mode RGB in colours",
        ),
        (
            lambda path: save_16(path, np.ones((60, 120))),
            "expected a depth map of the shape of its camera's picture, 1",
        ),
        (lambda path: path.write_bytes(b"version https://git-lfs.github.com/spec/v1"), "expected the content"),
    ],
    ids=["cut", "colours", "shape", "lfs"],
)
def test_maps_that_cannot_be_used_are_named(tmp_path, change, message):
    folder = deep_wall(tmp_path)
    path = folder / "depths" / "p_3.png"
    change(path)
    found = measured(folder)
    assert [one.problem for one in found] == [depth.BROKEN if i == 3 else "" for i in range(COUNT)]
    assert found[3].about.startswith(f"{path}: {message}")


@pytest.mark.parametrize(
    "write, message",
    [
        (lambda path: np.save(path, np.ones((120, 160, 2))), r"expected a depth map of shape \(H, W\), got"),
        (lambda path: np.save(path, np.array([{}], dtype=object)), "unreadable or cut short"),
        (lambda path: path.write_bytes(b"no"), "unreadable or cut short"),
        (lambda path: np.save(path, np.ones((160, 120))), "expected a depth map of the shape"),
    ],
    ids=["channels", "objects", "text", "turned"],
)
def test_arrays_that_cannot_be_used_are_named(tmp_path, write, message):
    views = write_transforms(tmp_path, ".npy")
    write(tmp_path / "deep" / "p_0.npy")
    items, _ = photographs(tmp_path)
    with pytest.raises(io.SceneError, match=message):
        read_depth(items[0].depth, views[0])


def test_other_problems_are_told_apart(tmp_path):
    folder = deep_wall(tmp_path, parameters=False)
    save_16(folder / "depths" / "p_1.png", np.random.default_rng(0).uniform(1, 65535, SIZE[::-1]))
    (folder / "depths" / "p_2.png").unlink()
    items, points = photographs(folder)
    items[3] = items[3]._replace(depth=items[3].depth._replace(path=folder / "depths" / "none.png"))
    items[4] = items[4]._replace(depth=items[4].depth._replace(scale=-1.0))
    found = measure_maps(items[:4], points, {}) + measure_maps(items[4:], points[:5], {})
    assert [one.problem for one in found[:5]] == ["", depth.WRONG, "", depth.MISSING, depth.EMPTY]
    assert {one.problem for one in found[5:]} == {depth.UNSCALED} and found[2].map is None
    about = f"{items[5].depth.path}: expected its scale in depth_params.json, or 20 points in it, got 5"
    assert found[5].about == about


def test_transforms_that_name_no_file(tmp_path):
    write_transforms(tmp_path, frames=lambda i, frame: frame | {"depth_file_path": 7})
    with pytest.raises(io.SceneError, match="frame 0: depth_file_path must name a file, got 7"):
        photographs(tmp_path)


@pytest.mark.parametrize("content", ['{"p_0": {"scale": 1}}', "no", "[1]", '{"p_0": {"scale": "x", "offset": 0}}'])
def test_parameters_that_are_none(tmp_path, content):
    folder = deep_wall(tmp_path)
    (folder / "sparse" / "0" / "depth_params.json").write_text(content)
    with pytest.raises(io.SceneError, match='expected an object with "scale" and "offset" for each'):
        photographs(folder)


def test_scales_that_cannot_be_right_are_not_taken(tmp_path):
    folder = deep_wall(tmp_path)
    told = {"p_0": {"scale": 0, "offset": 0}, "p_1": {"scale": math.nan, "offset": 0}, "p_2": {"scale": 2, "offset": 1}}
    (folder / "sparse" / "0" / "depth_params.json").write_text(json.dumps(told))
    items, _ = photographs(folder)
    assert [(item.depth.scale, item.depth.shift) for item in items[:4]] == [(None, 0), (None, 0), (2, 1), (None, 0)]


LENSES = {"pinhole": None, "fisheye": Lens.fisheye([0.02]), "sphere": Lens.equirectangular()}


@pytest.mark.parametrize("lens", LENSES)
def test_depths_of_points_are_those_of_the_camera_model(lens):
    """z, or the distance from the camera; a point behind another one is not seen."""
    view = cameras(lens=LENSES[lens])[0]
    points, _ = wall_points()
    seen = seen_points(view, torch.cat([points, points * 0.5 + torch.tensor([0.0, 0, 3])]), torch.arange(len(points)))
    in_camera = points @ view.w2c[:3, :3].T + view.w2c[:3, 3]
    expected = in_camera[:, 2] if lens == "pinhole" else in_camera.norm(dim=1)
    shown = ((view.pixels_of(in_camera) >= 0) & (view.pixels_of(in_camera) < torch.tensor(SIZE))).all(1)
    torch.testing.assert_close(seen.inverse, 1 / expected[shown])
    torch.testing.assert_close(seen.pixels, view.pixels_of(in_camera)[shown])
    place = torch.linalg.inv(view.w2c)[:3, 3]
    all_points = seen_points(view, torch.cat([points, place + 1.5 * (points - place)]), None)
    assert all_points.inverse.min() > 1 / expected.max() * 0.999
    assert len(all_points.inverse) > 0.7 * int(shown.sum())  # of an aslant wall some are taken for hidden


def test_tracks_say_what_a_photograph_shows(tmp_path):
    items, points = photographs(write_wall(tmp_path))
    rows = torch.arange(0, len(points), 7)
    found = points_in([item.view for item in items[:2]], points, {items[0].view.name: rows})
    assert 0 < len(found[0].inverse) <= len(rows) and len(found[1].inverse) == 0


def depth_row(folder) -> plan.Finding:
    return {finding.effect: finding for finding in plan_capture(folder).findings}["depth"]


def test_inspect_says_how_well_maps_fit_the_points(tmp_path):
    folder = deep_wall(tmp_path)
    (folder / "depths" / "p_0.png").unlink()
    spoil(folder / "depths" / "p_1.png")
    found = depth_row(folder)
    assert (found.number, found.unit, found.verdict) == (COUNT - 1, "maps", NO)
    assert f"in {COUNT} photographs; after the best scale and shift they differ from the points by 0." in found.reason
    assert f"1 cannot be used, the first is {folder / 'depths' / 'p_1.png'}: unreadable" in found.reason
    assert f"the median point is in {COUNT} photographs" in found.reason


def test_inspect_calls_for_depths_where_few_photographs_show_most_points(tmp_path):
    found = depth_row(write_wall(tmp_path / "few", views=cameras()[3:8]))
    assert (found.number, found.verdict) == (0, YES)
    assert found.reason.endswith("in 5 photographs; train --depth points takes what is known of depths")
    untracked = depth_row(write_wall(tmp_path / "untracked", views=cameras()[3:8], tracked=False))
    assert (untracked.verdict, untracked.reason) == (YES, found.reason)
    none = depth_row(write_wall(tmp_path / "none", points=False))
    assert (none.number, none.verdict) == (0, plan.NOT_KNOWN) and "the capture has no points" in none.reason
