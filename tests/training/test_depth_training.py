"""Trainings that are constrained by measured depths."""

import numpy as np
import pytest
import torch
from cli_extra import image
from depth_maps import deep_wall, depth_of, save_16, write_transforms
from runs import make_run, trained
from training_step import check_next_step
from wall import COUNT, SIZE, cameras, write_wall

import analytic_rasterizer as ar
from analytic_rasterizer import io
from analytic_rasterizer.captures.depth import SeenPoints, points_in
from analytic_rasterizer.captures.reduction import reduced_depths
from analytic_rasterizer.distributed.ranks import Ranks
from analytic_rasterizer.training import PictureMemory, TrainingOptions, files, load_capture, load_pictures
from analytic_rasterizer.training.depth_targets import MARGIN, PointTargets, depths_of
from analytic_rasterizer.training.schedule import depth_weight_at

SMALL = {"iterations": 40, "scales": (4,), "random_points": 150, "max_gaussians": 300, "effects": "none"}


@pytest.mark.parametrize(
    "weights, expected",
    [
        ((0.4, 0.1), (0.4, 0.2, 0.1)),
        ((0.4, 0.0), (0.4, 0.2, 0.0)),
        ((0.0, 0.4), (0.0, 0.2, 0.4)),
        ((0.0, 0.0), (0, 0, 0)),
    ],
)
def test_the_weight_changes_exponentially_or_evenly(weights, expected):
    options = TrainingOptions(depth="points", depth_weight=weights[0], depth_weight_end=weights[1])
    assert [depth_weight_at(share, options) for share in (0, 0.5, 1)] == pytest.approx(expected)
    assert depth_weight_at(0.5, TrainingOptions(depth_weight=1)) == 0


def test_points_in_one_pixel_count_together(tmp_path):
    pictures = load_pictures(load_capture(write_wall(tmp_path)).train, (1, 4), (0, 0, 0), "cpu")
    pixels = torch.tensor([[0.5, 0.5], [3.5, 3.9], [159.99, 119.99], [80.2, 40.7]], dtype=torch.float64)
    seen = SeenPoints(pixels, torch.tensor([0.2, 0.4, 0.5, 0.25], dtype=torch.float64))
    none = SeenPoints(pixels[:0], seen.inverse[:0])
    targets = PointTargets(pictures, [seen, none], torch.device("cpu"))
    fine, coarse = targets(1, 0), targets(4, 0)
    assert targets(1, 1) is None
    assert fine.inverse.shape == (120, 160) and coarse.inverse.shape == (30, 40)
    assert fine.shares.sum() == coarse.shares.sum() == fine.total == 4
    assert fine.inverse[40, 80] == 0.25 and fine.shares[40, 80] == 1 and coarse.inverse[10, 20] == 0.25
    assert coarse.inverse[0, 0] == pytest.approx(0.3) and coarse.shares[0, 0] == 2
    assert fine.reference == coarse.reference == 4.0, "the lower of two in the middle"
    given = fine.arguments(0.5)
    assert given["depth_weight"] == 0.5 and given["depth_margin"] == MARGIN / 4


def test_masks_hide_points(tmp_path):
    folder = write_wall(tmp_path)
    (folder / "masks").mkdir()
    for view in cameras():
        image.fromarray(np.repeat(np.uint8([0, 255]), 80)[None].repeat(120, 0)).save(
            folder / "masks" / f"{view.name}.png"
        )
    capture = load_capture(folder)
    pictures = load_pictures(capture.train, (2,), (0, 0, 0), "cpu")
    targets = PointTargets(pictures, points_in(pictures.views, capture.points[0], {}), torch.device("cpu"))
    shares = targets(2, 3).shares
    assert (shares[:, :40] == 0).all() and shares[:, 40:].sum() > 20


def test_coarse_depths_are_means_of_what_counts():
    planes = torch.tensor([[[0.2, 0.4, 0.0, 0.0], [0.6, 0.0, 0.0, 0.9]], [[1.0, 1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 1.0]]])
    made = reduced_depths(planes, 2, None)
    assert made.dtype == torch.float16
    torch.testing.assert_close(made.float(), torch.tensor([[[0.4, 0.9]], [[0.75, 0.25]]]), rtol=1e-3, atol=0)
    masked = reduced_depths(planes, 2, torch.tensor([[255, 0, 255, 255], [0, 255, 255, 0]], dtype=torch.uint8))
    torch.testing.assert_close(masked.float(), torch.tensor([[[0.2, 0]], [[0.25, 0]]]), rtol=1e-3, atol=0)


@pytest.mark.parametrize("size", [None, (80, 60)], ids=["as large", "smaller"])
def test_maps_are_cut_and_reduced_as_their_photographs(tmp_path, size):
    """160 x 120 px are cut to 154 x 119 for a scale of 7."""
    capture = load_capture(deep_wall(tmp_path, size=size))
    options = TrainingOptions(depth="maps", depth_fit="none")
    found = depths_of(options, capture)
    pictures = load_pictures(capture.train, (1, 7), (0, 0, 0), "cpu", maps=found.maps)
    targets = found.targets(pictures, torch.device("cpu"))
    for scale in (1, 7):
        target, view = targets(scale, 2), pictures.views[2]
        assert target.inverse.shape == (119 // scale, 154 // scale) and (target.shares == 1).all()
        expected = 1 / depth_of(view)
        tops = expected.reshape(119 // scale, scale, 154 // scale, scale).mean((1, 3))
        # Float16 has 2^-11, and pixels of the smaller map are a pixel wider: 0.4 / 180 of a depth.
        np.testing.assert_allclose(target.inverse.numpy(), tops, rtol=2**-11 + (0 if size is None else 0.4 / 180))
        assert target.total == pytest.approx(target.shares.sum().item())


def test_maps_that_wait_in_files_are_the_same(tmp_path):
    capture = load_capture(deep_wall(tmp_path))
    maps = depths_of(TrainingOptions(depth="maps"), capture).maps
    kept = load_pictures(capture.train, (2, 4), (0, 0, 0), "cpu", maps=maps)
    waiting = load_pictures(capture.train, (2, 4), (0, 0, 0), "cpu", memory=PictureMemory(host=0.0), maps=maps)
    assert kept.store.plan.ahead == 0 and waiting.store.plan.ahead > 0
    for scale in (2, 4):
        for view in range(len(maps)):
            assert torch.equal(kept.depth(scale, view), waiting.depth(scale, view))
    assert kept.depth_sums == waiting.depth_sums
    assert sum(kept.store.plan.taken.values()) == 8 * (80 * 60 + 40 * 30) * (3 + 4)
    waiting.close()


@pytest.mark.parametrize(
    "options", [{"depth": "points"}, {"depth": "maps"}, {"depth": "maps", "density": "mcmc"}], ids=str
)
@pytest.mark.parametrize("more", [{}, {"pictures_per_step": 2, "supersampling": 2, "filter_3d": True}], ids=str)
def test_a_step_has_the_gradients_of_autograd(tmp_path, options, more):
    run = make_run(deep_wall(tmp_path / "wall"), tmp_path / "out", **{**SMALL, "scales": (4, 8)}, **options, **more)
    for _ in range(3):
        run.trainer.step()
    assert run.trainer._depth(run.trainer._next()[0])["depth_weight"] > 0
    check_next_step(run.trainer)


def depth_error(run) -> float:
    """The median relative error of median depths, over what is opaque in all views."""
    errors, scene = [], run.trainer.scene().arguments()
    for view in cameras():
        small = view.resized(40, 30)
        settings = small.settings(effects=ar.Effects(median_depth=True), footprint=run.options.footprint)
        with torch.no_grad():
            _, _, outputs = ar.GaussianRasterizer(settings)(means2D=None, **scene)
        shown, truth = outputs.median_depth[0], torch.from_numpy(depth_of(small))
        errors.append(((shown - truth).abs() / truth)[shown > 0])
    return torch.cat(errors).median().item()


def test_depths_get_geometry_right(tmp_path):
    """Of three photographs from nearly one place, and random points. The sign of a difference, its scale, or a wrong
    pixel would leave the geometry as it is, or spoil it."""
    folder = deep_wall(tmp_path / "wall", views=cameras()[4:7])
    options = {**SMALL, "iterations": 150, "test_every": 0, "points": None}
    (folder / "sparse" / "0" / "points3D.bin").unlink()
    errors = {
        depth: depth_error(trained(folder, tmp_path / depth, depth=depth, **options)) for depth in ("none", "maps")
    }
    assert errors["maps"] < 0.5 * errors["none"], errors  # 0.18 against 0.59


def test_the_same_bits_where_a_training_is_resumed(tmp_path):
    folder = deep_wall(tmp_path / "wall")
    options = {**SMALL, "depth": "maps"}
    whole = trained(folder, tmp_path / "whole", **options)
    part = make_run(folder, tmp_path / "part", **options)
    for _ in range(17):
        part.trainer.step()
    part.save()
    resumed = make_run(folder, tmp_path / "part", resume=True)
    assert resumed.train() and resumed.options.depth == "maps"
    scenes = [(tmp_path / name / files.SCENE).read_bytes() for name in ("whole", "part")]
    assert scenes[0] == scenes[1]
    assert any("8 of 8 photographs have a depth map" in note for note in whole.notes)


def refused(folder, tmp_path, **given) -> io.SceneError:
    with pytest.raises(io.SceneError) as caught:
        make_run(folder, tmp_path / "out", **{**SMALL, "depth": "maps", **given})
    return caught.value


def test_what_is_refused(tmp_path):
    bare = write_wall(tmp_path / "bare")
    error = refused(bare, tmp_path)
    assert f"{bare}/sparse/0: none of 8 photographs has a depth map: expected depths/NAME.png" in error.message
    assert error.advice == ("--depth points takes the points of the reconstruction", "--depth none does without")
    no_points = refused(write_wall(tmp_path / "no", points=False), tmp_path, depth="points")
    assert "the capture has no points" in no_points.message and "--depth maps" in no_points.advice[0]
    unscaled = deep_wall(tmp_path / "unscaled", parameters=False)
    (unscaled / "sparse" / "0" / "points3D.bin").unlink()
    error = refused(unscaled, tmp_path)
    assert "of 8 depth maps 8 have no scale, the first is " in error.message
    assert error.message.endswith(".png: expected its scale in depth_params.json, or 20 points in it, got 0")
    assert refused(unscaled, tmp_path, depth_fit="none").message.endswith("depth_params.json (--depth-fit none)")
    assert error.advice[0].startswith("depth_params.json beside the cameras, or points")
    wrong = deep_wall(tmp_path / "wrong", change=lambda i, levels: levels / 3)
    error = refused(wrong, tmp_path, depth_fit="none")
    assert "8 do not fit the points, the first is " in error.message and "by " in error.message
    assert error.advice[0] == "--depth-fit auto fits scales to the points"
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "spoil, message",
    [
        (lambda path: path.unlink(), "1 are missing, the first is {}"),
        (lambda path: path.write_bytes(b"no"), "1 cannot be used, the first is {}: unreadable or cut short"),
        (
            lambda path: save_16(path, np.ones((60, 120))),
            "1 cannot be used, the first is {}: expected a depth map of the shape of its camera's picture, "
            "160 x 120 px, got 120 x 60",
        ),
        (lambda path: save_16(path, np.zeros(SIZE[::-1])), "1 hold no depth anywhere, the first is {}"),
    ],
    ids=["missing", "broken", "shape", "zero"],
)
@pytest.mark.parametrize("folder, write", [("deep", write_transforms), ("depths", deep_wall)])
def test_a_map_that_is_missing_or_broken_is_an_error(tmp_path, folder, write, spoil, message):
    write(tmp_path / "wall")
    path = tmp_path / "wall" / folder / "p_3.png"
    spoil(path)
    if folder == "depths" and not path.exists():  # which nothing names
        assert depths_of(TrainingOptions(depth="maps"), load_capture(tmp_path / "wall")).maps.count(None) == 1
        return
    error = refused(tmp_path / "wall", tmp_path)
    assert "of 8 depth maps " + message.format(path) in error.message
    assert error.advice == ("--missing skip leaves them out",) and not (tmp_path / "out").exists()


def test_a_confidence_that_is_missing_is_an_error(tmp_path):
    write_transforms(tmp_path / "wall", frames=lambda i, frame: frame | {"confidence_file_path": f"deep/c_{i}.png"})
    error = refused(tmp_path / "wall", tmp_path)
    assert f"8 are missing, the first is {tmp_path}/wall/deep/c_" in error.message


def test_maps_that_are_missing_or_broken_are_left_out(tmp_path):
    write_transforms(tmp_path / "wall")
    (tmp_path / "wall" / "deep" / "p_3.png").unlink()
    (tmp_path / "wall" / "deep" / "p_4.png").write_bytes(b"no")
    save_16(tmp_path / "wall" / "deep" / "p_5.png", np.zeros(SIZE[::-1]))
    run = make_run(tmp_path / "wall", tmp_path / "out", depth="maps", missing="skip", **SMALL)
    said = "\n".join(run.notes)
    assert f"{COUNT - 2 - 3} of {COUNT - 2} photographs have a depth map" in said
    assert "of 8 depth maps 3 are left out: 1 are missing, the first is" in said
    assert "1 cannot be used, the first is" in said and "1 hold no depth anywhere, the first is" in said


def test_a_lens_that_is_undistorted_has_no_maps(tmp_path):
    views = cameras(lens=ar.Lens.perspective([-0.02]))[:4]
    folder = write_wall(tmp_path / "wall", views, model=4, coefficients=(-0.02, 0.0, 0.0, 0.0))
    for view in views:
        save_16(folder / "depths" / f"{view.name}.png", 2**16 / depth_of(view))
    assert "depth maps cannot be undistorted" in refused(folder, tmp_path, lens="undistort").message
    kept = make_run(folder, tmp_path / "out", depth="maps", **SMALL)
    assert any("have a depth map" in note for note in kept.notes)


@pytest.mark.parametrize(
    "given, reason",
    [
        ({"depth_weight": 0.3}, "--depth-weight has no effect: depth is none"),
        ({"depth_weight_end": 0.3}, "--depth-weight-end has no effect: depth is none"),
        (
            {"depth_unit": 1.0, "depth": "points"},
            "--depth-unit has no effect: it is for depth maps, and depth is points",
        ),
        ({"depth_fit": "none"}, "--depth-fit has no effect: it is for depth maps, and depth is none"),
    ],
    ids=str,
)
def test_options_without_effect(tmp_path, given, reason):
    with pytest.raises(ValueError, match=reason):
        make_run(write_wall(tmp_path / "wall"), tmp_path / "out", chosen=list(given), **SMALL, **given)


def test_inverse_depths_have_no_unit(tmp_path):
    given = {**SMALL, "depth": "maps", "depth_unit": 1.0}
    folder = deep_wall(tmp_path / "wall")
    with pytest.raises(ValueError, match="--depth-unit has no effect: all depth maps hold inverse depths"):
        make_run(folder, tmp_path / "out", chosen=["depth_unit"], **given)
    make_run(folder, tmp_path / "out", **given)
    write_transforms(tmp_path / "metric", ".npy", 1.0)
    make_run(tmp_path / "metric", tmp_path / "other", chosen=["depth_unit"], **given)


def test_several_processes_take_no_depths(tmp_path):
    with pytest.raises(ValueError, match="depth must be none for 2 processes, got points"):
        make_run(write_wall(tmp_path / "wall"), tmp_path / "out", ranks=Ranks(0, 2), depth="points", **SMALL)
