"""What is read of captures that are spelt in another way, or are not as they should be. The next case is a row."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from capture_files import circle
from cli_extra import image
from spoiled_captures import (
    MATRIX,
    POINTS,
    SIZE,
    each_frame,
    masks,
    points_of_a_ply,
    transforms,
    write,
)

from analytic_rasterizer import Lens, io, training
from analytic_rasterizer.captures import extent, photographs, pictures

TOP = np.s_[:3]  # of masks: what counts


def levels(value, shape=(6, 8), dtype=np.uint8):
    found = np.zeros(shape, dtype)
    found[TOP] = value
    return found


def with_alpha(colors, alpha):
    return image.fromarray(np.concatenate([colors, alpha[..., None]], 2), "RGBA")


def labels():
    found = levels(1)
    found[TOP, 4:] = 2
    return found


ALL, NONE = np.full((6, 8, 3), 255, np.uint8), np.zeros((6, 8, 3), np.uint8)
MASKS = {
    "white": image.fromarray(levels(255)),
    "a label": image.fromarray(levels(1)),
    "labels": image.fromarray(labels()),
    "labels beside a bright one": image.fromarray(np.where(np.eye(6, 8) > 0, 255 * np.sign(labels()), labels())),
    "16 bits": image.fromarray(levels(3, dtype=np.uint16)),
    "1 bit": image.fromarray(levels(255)).convert("1"),
    "dark blue": image.fromarray(np.stack([levels(0), levels(0), levels(2)], 2)),
    "alpha over white": with_alpha(ALL, levels(255)),
    "alpha over black": with_alpha(NONE, levels(255)),
    "alpha over the same colours": with_alpha(np.stack([levels(200)] * 3, 2), levels(255)),
    "opaque": with_alpha(np.stack([levels(255)] * 3, 2), np.full((6, 8), 255, np.uint8)),
    "grey and alpha": image.merge("LA", [image.new("L", (8, 6), 255), image.fromarray(levels(255))]),
}


@pytest.mark.parametrize("name", MASKS)
def test_what_counts_in_a_mask(tmp_path, name):
    """What is neither black nor transparent, as COLMAP and nerfstudio have it."""
    MASKS[name].save(tmp_path / "mask.png")
    found = photographs.read_mask(tmp_path / "mask.png", 8, 6)
    assert found.tolist() == levels(255).tolist()


def test_what_counts_in_a_mask_that_loses_something(tmp_path):
    noise = np.random.default_rng(0).integers(0, 12, (64, 64)).astype(np.uint8)
    noise[:32] += 240
    for suffix in ("jpg", "webp"):
        image.fromarray(noise).convert("RGB").save(tmp_path / f"mask.{suffix}", quality=80)
        found = photographs.read_mask(tmp_path / f"mask.{suffix}", 64, 64)
        assert (found[:28] == 255).all() and (found[36:] == 0).all()


VIEWS = {
    "sizes": lambda c: (c.pop("w"), c.pop("h"), [frame.update(w=48, h=36) for frame in c["frames"][::2]]),
    "a matrix in each frame": lambda c: (c.pop("fl_x"), c.pop("fl_y"), each_frame(K=MATRIX)(c)),
    "a matrix by rows": lambda c: (c.pop("fl_x"), c.pop("fl_y"), each_frame(K=[*MATRIX[0], *MATRIX[1], *MATRIX[2]])(c)),
    "a matrix for all": lambda c: (c.pop("fl_x"), c.pop("fl_y"), c.update(K=MATRIX)),
    "a matrix before what all have": lambda c: (c.update(fl_x=9.0, camera_angle_x=1.0), each_frame(K=MATRIX)(c)),
    "a focal length before a matrix": lambda c: c.update(K=[[9.0, 0, 24], [0, 9, 18], [0, 0, 1]]),
    "lower case": lambda c: c.update(camera_model="opencv"),
}


@pytest.mark.parametrize("name", VIEWS)
def test_cameras_that_are_spelt_in_another_way(tmp_path, name):
    transforms(tmp_path / "plain")
    transforms(tmp_path / "other", VIEWS[name])
    plain, other = (io.load_views(tmp_path / folder / "transforms.json") for folder in ("plain", "other"))
    for one, two in zip(plain, other, strict=True):
        assert replace(one, cx=24.0, cy=18.0) == replace(two, cx=24.0, cy=18.0) and two.middle == (24.0, 18.0)


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        ([[36, 1, 24], [0, 36, 18], [0, 0, 1]], "frame 0: K must be fx 0 cx, 0 fy cy, 0 0 1 by rows, got .*36, 1, 24"),
        ([[36, 0], [0, 36]], "frame 0: K must hold 3 x 3 finite numbers"),
        ([[-36, 0, 24], [0, 36, 18], [0, 0, 1]], "frame 0: fl_x must be a positive finite number, got -36"),
    ],
)
def test_matrices_that_are_none(tmp_path, matrix, message):
    transforms(tmp_path, each_frame(K=matrix))
    with pytest.raises(io.SceneError, match=message):
        io.load_views(tmp_path / "transforms.json")


def test_points_that_a_transforms_train_names(tmp_path):
    transforms(tmp_path, lambda c: c.update(ply_file_path="own.ply"), "transforms_train.json")
    points_of_a_ply(tmp_path)
    assert torch.allclose(training.load_capture(tmp_path).points[0], POINTS)


@pytest.mark.parametrize("center", [(24.0, 18.0), (23.0, 19.5)], ids=str)
@pytest.mark.parametrize("size", [(48, 27), (32, 36)], ids=str)
def test_a_cut_picture_keeps_its_pixels(tmp_path, size, center):
    """About the principal point: what was there is in the middle, and as large as before."""
    view = replace(circle(1, SIZE)[0], cx=center[0], cy=center[1])
    image.new("RGB", size).save(tmp_path / "a.png")
    found = pictures.load_pictures([training.Photograph(view, {1: tmp_path / "a.png"})], (1,), (0.0,) * 3, "cpu")
    (cut,) = found.views
    kept = [SIZE[axis] == size[axis] for axis in (0, 1)]
    expected = [center[axis] if kept[axis] else size[axis] / 2 for axis in (0, 1)]
    assert (cut.width, cut.height, cut.fx, cut.fy) == (*size, view.fx, view.fy) and list(cut.middle) == expected


@pytest.mark.parametrize(
    ("lens", "low", "high"),
    [
        (None, 1, 1),
        (Lens.perspective([-0.1]), 1, 1),
        (Lens.fisheye([0.01]), 1, 1),
        (Lens.perspective([0.3, -59.0]), 0.05, 0.2),
        (Lens.equirectangular(), 1, 1),
    ],
    ids=str,
)
def test_how_much_a_lens_shows(lens, low, high):
    view = replace(circle(1, SIZE)[0], lens=lens)
    if lens is not None and lens.model == "equirectangular":
        view = replace(view, **io.lenses.sphere_of(*SIZE))
    assert low <= extent.shown_share(view) <= high


def test_all_of_a_pictures_pixels_count_once_in_what_masks_leave_out(tmp_path):
    write(tmp_path)
    masks(tmp_path, "masks", 255)
    masks(tmp_path, "masks", 0, count=2)
    capture = training.load_capture(tmp_path, test_every=0)
    for scales in ((1,), (1, 2)):
        shares = training.load_pictures(capture.train, scales, (0.0,) * 3, "cpu").shares
        assert shares == [0, 0, *[1] * 7]
