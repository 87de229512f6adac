"""Pictures of captures: read, cut so that they halve evenly, and reduced."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from capture_files import looking_at_origin
from places import SHARED
from train_extra import image

from analytic_rasterizer import io, render_stages, training
from analytic_rasterizer.captures import loading, photographs, pictures


@pytest.mark.parametrize("name, count, points", [("bonsai", 292, 82_641), ("fox", 50, None)])
def test_capture_is_read_as_it_was_taken(name, count, points):
    """Points have the colours of the pixels that they project to: cameras, cut and pictures belong together."""
    folder = SHARED / "data" / name
    if not folder.exists():
        pytest.skip("needs the optional ../shared scenes next to the project")
    capture = training.load_capture(folder)
    means, colors = capture.points
    assert len(capture.train) + len(capture.test) == count and len(means) == (points or len(means))
    item = capture.train[8]
    view, rgba, _ = pictures.fitted(photographs.read_picture(item.files[1]), item, 16)
    assert rgba.shape == (view.height, view.width, 4) and view.height % 16 == view.width % 16 == 0
    stages = render_stages(view.settings(), **point_inputs(means))
    colors = colors[stages.ids.long()]

    def error(shift) -> float:
        """Median over the points; those hidden by others are in it too."""
        x, y = (stages.means2d + torch.tensor(shift)).round().long().unbind(1)
        inside = (x >= 0) & (x < view.width) & (y >= 0) & (y < view.height)
        assert inside.sum() > 2000
        return (rgba[y[inside], x[inside], :3] / 255 - colors[inside]).abs().mean(1).median().item()

    for shift in ([2.0, 0.0], [-2.0, 0.0], [0.0, 2.0], [0.0, -2.0]):
        assert error([0.0, 0.0]) < 0.85 * error(shift)


def point_inputs(means) -> dict:
    count = len(means)
    return {
        "means3D": means,
        "opacities": torch.ones(count, 1),
        "colors_precomp": torch.ones(count, 3),
        "scales": torch.full((count, 3), 1e-3),
        "rotations": torch.eye(4)[:1].repeat(count, 1),
    }


def fitted(path, view, multiple):
    return pictures.fitted(photographs.read_picture(path), training.Photograph(view, {1: path}), multiple)[:2]


def test_cut_pictures_see_the_same(tmp_path):
    """What is left of a picture shows a point where it did, in px of the cut; at half the intrinsics' size too."""
    pixels = torch.randint(256, (29, 45, 3), dtype=torch.uint8, generator=torch.Generator().manual_seed(0)).numpy()
    image.fromarray(pixels).save(tmp_path / "a.png")
    view = io.View("a", 45, 29, 50.0, 51.0, looking_at_origin(0.3), cx=20.0)
    cut, rgba = fitted(tmp_path / "a.png", view, 8)
    assert np.array_equal(rgba[..., :3].numpy(), pixels[2:26, 2:42])
    point = torch.tensor([[0.2, -0.3, 0.4]])
    whole, part = (render_stages(v.settings(), **point_inputs(point)).means2d for v in (view, cut))
    torch.testing.assert_close(part, whole - 2, rtol=0, atol=1e-4)
    double = replace(view, width=90, height=58, fx=100.0, fy=102.0, cx=40.0)
    again, _ = fitted(tmp_path / "a.png", double, 8)
    assert again == replace(cut, w2c=again.w2c)
    with pytest.raises(io.SceneError, match="45 x 29 px are too few"):
        fitted(tmp_path / "a.png", view, 32)


def test_pictures_that_were_turned_are_refused(tmp_path):
    """Their cameras were scaled by another factor in x than in y."""
    view = io.View("a", 99, 66, 50.0, 50.0, torch.eye(4, dtype=torch.float64))
    for size in ((66, 99), (33, 49), (17, 25)):
        image.new("RGB", size).save(tmp_path / "a.png")
        with pytest.raises(io.SceneError, match=rf"camera, 99 x 66 px, got {size[0]} x {size[1]}"):
            fitted(tmp_path / "a.png", view, 1)
    for size in ((99, 66), (50, 33), (25, 17), (2, 2), (64, 64), (150, 80)):  # squeezed ones have oblong pixels
        image.new("RGB", size).save(tmp_path / "a.png")
        cut, _ = fitted(tmp_path / "a.png", view, 1)
        assert (cut.width, cut.height) == size


@pytest.mark.parametrize("downsampling", ["box", "blender", "bicubic"])
def test_colors_of_reduced_pictures(downsampling):
    """They count by their alpha, but in the files of the multi-scale Blender set."""
    rgba = torch.tensor([[[255, 0, 0, 255], [0, 255, 0, 0]]], dtype=torch.uint8).repeat(2, 1, 1)
    plain = pictures.reduce(rgba, 1, loading.WHITE, downsampling)[0]
    assert plain[:, 0].T.tolist() == [[255, 0, 0], [255, 255, 255]]
    on_white = pictures.reduce(rgba, 2, loading.WHITE, downsampling)[0][:, 0, 0].tolist()
    premultiplied = pictures.reduce(rgba, 2, None, downsampling)[0][:, 0, 0].tolist()
    if downsampling == "blender":
        assert on_white == [191, 191, 128] and premultiplied == [64, 64, 0, 128]  # 255 (0.5 * 0.5 + 0.5), 128
    else:
        assert on_white == [255, 128, 128] and premultiplied == [128, 0, 0, 128]


@pytest.mark.parametrize("downsampling", ["box", "bicubic"])
@pytest.mark.parametrize("scale", [2, 4])
def test_reduced_pictures_of_one_color_keep_it(downsampling, scale):
    """Whatever the mask: on a background of the same colour nothing is to be seen of it."""
    alpha = torch.randint(256, (16, 24), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    rgba = torch.stack([*torch.full((3, 16, 24), 255, dtype=torch.uint8), alpha], 2)
    rgba[..., :3][alpha == 0] = 0  # as programs store what nobody sees
    assert (pictures.reduce(rgba, scale, loading.WHITE, downsampling)[0] == 255).all()


@pytest.mark.parametrize("scale", [2, 4])
def test_bicubic_reduction_is_that_of_pillow(scale):
    """Within the level of 255 by which Pillow's own rounding between rows and columns may differ."""
    pixels = torch.randint(256, (16, 24, 3), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    rgba = torch.cat([pixels, torch.full((16, 24, 1), 255, dtype=torch.uint8)], dim=2)
    expected = image.fromarray(pixels.numpy()).resize((24 // scale, 16 // scale), image.Resampling.BICUBIC)
    got = pictures.reduce(rgba, scale, loading.BLACK, "bicubic")[0].permute(1, 2, 0)
    assert (got.int() - torch.from_numpy(np.array(expected)).int()).abs().max() <= 1


def test_sixteen_bits_are_rounded_to_eight(tmp_path):
    image.fromarray(np.array([[0, 257 * 100, 65535]], np.uint16)).save(tmp_path / "a.png")
    assert photographs.read_picture(tmp_path / "a.png")[0, :, 0].tolist() == [0, 100, 255]


@pytest.mark.parametrize("background", [None, loading.WHITE, loading.BLACK])
def test_pictures_without_alpha_stay_as_they_are_stored(background):
    """They are not computed; pictures of which one pixel is not opaque are."""
    rgba = torch.randint(0, 256, (7, 9, 4), generator=torch.Generator().manual_seed(0), dtype=torch.uint8)
    rgba[:, :, 3] = 255
    computed = rgba.clone()
    computed[0, 0, 3] = 254
    for downsampling in ("box", "bicubic", "blender"):
        kept, other = (pictures.reduce(picture, 1, background, downsampling)[0] for picture in (rgba, computed))
        assert torch.equal(kept, rgba.permute(2, 0, 1)[: 4 if background is None else 3]) and kept.is_contiguous()
        assert torch.equal(kept[:, 1:], other[:, 1:]) and torch.equal(kept[:, 0, 1:], other[:, 0, 1:])
