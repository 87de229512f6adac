"""Camera paths against geometry, and films."""

import math
import sys

import numpy as np
import pytest
import torch
from cli_extra import image

import analytic_rasterizer as ar
from analytic_rasterizer import cli, io
from analytic_rasterizer.cameras.focus import focus, position
from analytic_rasterizer.cameras.path import looking_at, orbit, through
from analytic_rasterizer.cameras.rotations import quaternion, rotation_matrices
from analytic_rasterizer.cameras.up import level_up
from analytic_rasterizer.gaussians import Gaussians

UP = torch.tensor([0.1, -0.2, 1.0], dtype=torch.float64)
CENTER = torch.tensor([1.0, 2.0, -3.0], dtype=torch.float64)


def vector(*numbers):
    return torch.tensor(numbers, dtype=torch.float64)


def view_from(place, target=CENTER, up=UP, **options):
    given = {"width": 64, "height": 48, "fx": 70.0, "fy": 72.0} | options
    return io.View("v", w2c=looking_at(place, target, up), **given)


def ring(count, elevation=0.4, distance=4.0, **options):
    """Views on a circle around CENTER, level, in no even steps."""
    up = torch.nn.functional.normalize(UP, dim=0)
    first = torch.nn.functional.normalize(torch.linalg.cross(up, vector(1, 0, 0)), dim=0)
    second = torch.linalg.cross(up, first)
    angles = [0.3 + 5 * (i / count) ** 2 for i in range(count)]
    level = [math.cos(a) * first + math.sin(a) * second for a in angles]
    rays = [math.cos(elevation) * v + math.sin(elevation) * up for v in level]
    return [view_from(CENTER + distance * ray, **options) for ray in rays]


def side_by_side(count):
    """Views on a line that all look the same way."""
    return [view_from(vector(x, 0, 0), target=vector(x, 0, 1), up=vector(0, -1, 0)) for x in range(count)]


def test_a_camera_looks_at_its_target_and_is_level():
    view = view_from(vector(4, 1, 2))
    seen = view.w2c[:3, :3] @ CENTER + view.w2c[:3, 3]
    assert torch.allclose(seen, vector(0, 0, (CENTER - vector(4, 1, 2)).norm()))
    assert torch.linalg.det(view.w2c[:3, :3]) == pytest.approx(1)
    assert (view.w2c[:3, :3] @ UP)[0] == pytest.approx(0, abs=1e-12)  # the horizon is level
    assert (view.w2c[:3, :3] @ UP)[1] < 0  # y is down


def test_an_orbit_keeps_distance_elevation_and_horizon():
    views = ring(9)
    frames = orbit(views, CENTER, 3 * UP, 12)
    assert len(frames) == 12 and len({frame.name for frame in frames}) == 12
    up = UP / UP.norm()
    for frame in frames:
        offset = position(frame) - CENTER
        assert offset.norm() == pytest.approx(4) and offset @ up == pytest.approx(4 * math.sin(0.4))
        assert torch.allclose(frame.w2c, looking_at(position(frame), CENTER, UP))
        assert (frame.width, frame.height, frame.fx, frame.fy) == (64, 48, 70, 72)
    assert torch.allclose(position(frames[0]), position(views[0]))
    steps = [(position(a) - position(b)).norm().item() for a, b in zip(frames, [*frames[1:], frames[0]])]
    assert steps == pytest.approx([2 * 4 * math.cos(0.4) * math.sin(math.pi / 12)] * 12)


def test_an_orbit_of_views_from_above_does_not_look_straight_down():
    up = UP / UP.norm()
    frames = orbit([view_from(CENTER + 5 * up, up=vector(1, 0, 0))], CENTER, UP, 4)
    for frame in frames:
        assert frame.w2c.isfinite().all()
        assert (position(frame) - CENTER) @ up == pytest.approx(5 * math.sin(math.radians(80)))


def test_an_orbit_needs_a_distance():
    with pytest.raises(ValueError, match="needs views that are away from its centre"):
        orbit([view_from(CENTER, target=CENTER + 1)], CENTER, UP, 3)


@pytest.mark.parametrize("frames", [0, -1])
def test_a_path_has_frames(frames):
    for make in (lambda: orbit(ring(3), CENTER, UP, frames), lambda: through(ring(3), frames)):
        with pytest.raises(ValueError, match=f"frames must be at least 1, got {frames}"):
            make()


def test_a_path_passes_through_its_views():
    views = ring(5, fx=60.0) + [view_from(vector(3, 3, 1), fx=90.0, cx=30.0)]
    frames = through(views, 4 * 5 + 1)
    for view, frame in zip(views, frames[::4]):
        assert torch.allclose(frame.w2c, view.w2c, atol=1e-9)
        assert frame.fx == pytest.approx(view.fx) and frame.cx == pytest.approx(view.cx or 32)
    for frame in frames:
        rotation = frame.w2c[:3, :3]
        assert torch.allclose(rotation @ rotation.T, torch.eye(3, dtype=torch.float64), atol=1e-12)
    # No jump, and no corner: steps and their changes shrink with the number of frames.
    places = torch.stack([position(frame) for frame in through(views, 501)])
    steps = places.diff(dim=0)
    assert steps.norm(dim=1).max() < 0.2 and steps.diff(dim=0).norm(dim=1).max() < 0.004


def test_a_path_of_views_on_a_line_is_the_line():
    frames = through(side_by_side(4), 31)
    assert torch.allclose(torch.stack([position(frame) for frame in frames])[:, 0], torch.linspace(0, 3, 31).double())


def test_a_path_turns_evenly_and_the_short_way():
    first, second = io.View("a", 8, 8, 9, 9, torch.eye(4).double()), torch.eye(4).double()
    angle = 3.0  # more than a quarter: the quaternions of both may have any sign
    second[0, 0] = second[1, 1] = math.cos(angle)
    second[0, 1], second[1, 0] = -math.sin(angle), math.sin(angle)
    frames = through([first, io.View("b", 8, 8, 9, 9, second)], 7)
    angles = [math.atan2(frame.w2c[1, 0], frame.w2c[0, 0]) for frame in frames]
    assert angles == pytest.approx([angle * i / 6 for i in range(7)])


def test_a_path_turns_a_portrait_into_a_landscape_without_oblong_pixels():
    places = vector(4, 1, 2), vector(4, 2, 2)
    views = [view_from(places[0], fx=80.0, fy=80.0), view_from(places[1], width=48, height=64, fx=80.0, fy=80.0)]
    for frame in through(views, 5):
        assert (frame.width, frame.height) == (64, 48) and frame.fx == pytest.approx(frame.fy) == pytest.approx(80)


def test_a_path_needs_two_views():
    with pytest.raises(ValueError, match="needs at least 2 of them, got 1"):
        through(ring(1), 5)


@pytest.mark.parametrize("seed", range(6))
def test_quaternion_of_a_rotation(seed):
    rotation = rotation_matrices(torch.randn(4, generator=torch.Generator().manual_seed(seed), dtype=torch.float64))
    assert torch.allclose(rotation_matrices(quaternion(rotation)), rotation, atol=1e-12)
    half_turn = rotation @ torch.diag(vector(1, -1, -1)) @ rotation.T
    assert torch.allclose(rotation_matrices(quaternion(half_turn)), half_turn, atol=1e-12)


def test_views_of_an_object_converge_on_it():
    assert torch.allclose(focus(ring(6)), CENTER, atol=1e-9)
    outwards = [view_from(2 * position(view) - CENTER, target=3 * position(view) - 2 * CENTER) for view in ring(6)]
    assert focus(side_by_side(3)) is None and focus(outwards) is None and focus(ring(1)) is None


@pytest.mark.parametrize("count", [2, 3, 8])
def test_up_is_across_the_horizons_of_level_cameras(count):
    """Views of one side look down, so that the mean of what is up in their pictures leans to the other side."""
    assert torch.allclose(level_up(ring(count, elevation=0.7)), UP / UP.norm(), atol=1e-6)


def test_up_of_views_without_a_horizon_is_that_of_their_pictures():
    assert torch.allclose(level_up(side_by_side(3)), vector(0, -1, 0))
    rolled = []
    for i, view in enumerate(ring(9)):
        w2c = view.w2c.clone()
        w2c[:3, :3] = rotation_matrices(vector(math.cos(i), 0, 0, math.sin(i))) @ w2c[:3, :3]
        rolled.append(io.View("v", 8, 8, 9.0, 9.0, w2c))
    assert level_up(rolled).isfinite().all() and level_up(rolled).norm() == pytest.approx(1)


# -------------------------------------------------------------------------------- the command


@pytest.fixture
def files(tmp_path):
    g = torch.Generator().manual_seed(0)
    means = CENTER.float() + 0.3 * torch.randn(40, 3, generator=g)
    scales, opacities = torch.full((40, 3), 0.1), torch.full((40, 1), 0.8)
    shs = torch.randn(40, 1, 3, generator=g)
    scene = Gaussians.from_activated(means, scales, torch.eye(4)[:1].repeat(40, 1), opacities, shs)
    io.save_scene(tmp_path / "scene.ply", scene, io.SceneMetadata(footprint="box"))
    io.save_views(tmp_path / "cameras.json", ring(4, width=33, height=25))
    return tmp_path


def render(files, *options):
    return cli.main(["render", str(files / "scene.ply"), "--device", "cpu", *map(str, options)])


@pytest.mark.parametrize("path", ["orbit", "views"])
def test_frames_of_a_path_are_pictures(files, capsys, path):
    out = files / "out"
    assert render(files, "--path", path, "--frames", 3, "--out", out) == 0
    assert sorted(file.name for file in out.iterdir()) == [f"frame_0000{i}.png" for i in range(3)]
    views, scene = io.load_views(files / "cameras.json"), io.load_scene(files / "scene.ply")
    frames = orbit(views, CENTER, UP, 3) if path == "orbit" else through(views, 3)
    for frame in frames:
        color = ar.render_stages(frame.settings(1, io.BLACK, 0, "box"), **scene.arguments()).color
        expected = (255 * color.clamp(0, 1)).round().permute(1, 2, 0).numpy()
        assert np.abs(np.asarray(image.open(out / f"{frame.name}.png")).astype(int) - expected).max() <= 1
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 2 and lines[1].startswith("mean")


def test_a_film_has_the_frames(files, capsys):
    ffmpeg = pytest.importorskip("imageio_ffmpeg", reason="needs the video extra")
    out = files / "new" / "film.MP4"
    assert render(files, "--path", "orbit", "--frames", 6, "--fps", 12, "--scales", 0.5, "--out", out) == 0
    assert capsys.readouterr().out == f"{out}: 6 pictures of 66x50, 0.5 s\n"
    reader = ffmpeg.read_frames(str(out))
    about = next(reader)
    frames = [np.frombuffer(frame, np.uint8).reshape(50, 66, 3) for frame in reader]
    assert (about["size"], about["fps"], about["codec"], len(frames)) == ((66, 50), 12, "h264", 6)
    assert render(files, "--path", "orbit", "--frames", 6, "--scales", 0.5, "--out", files / "out") == 0
    for i, frame in enumerate(frames):
        exact = np.asarray(image.open(files / "out" / f"frame_{i:05d}.png")).astype(int)
        assert np.abs(frame.astype(int) - exact).mean() < 6  # its colours have half the resolution
    assert sorted(file.name for file in out.parent.iterdir()) == ["film.MP4"]


def test_a_film_of_odd_pictures_leaves_out_a_row_and_a_column(files):
    ffmpeg = pytest.importorskip("imageio_ffmpeg", reason="needs the video extra")
    assert render(files, "--out", files / "film.mp4") == 0  # its frames are the views
    reader = ffmpeg.read_frames(str(files / "film.mp4"))
    assert next(reader)["size"] == (32, 24) and len(list(reader)) == 4


def test_what_goes_wrong_in_a_film_is_not_called_writing(files, monkeypatch, capsys):
    pytest.importorskip("imageio_ffmpeg", reason="needs the video extra")

    def fail(*_, **__):
        raise RuntimeError("out of memory")

    monkeypatch.setattr("analytic_rasterizer.cli.render.render_stages", fail)
    assert render(files, "--out", files / "film.mp4") == 2
    assert capsys.readouterr().err.endswith("error: out of memory\n")
    assert not (files / "film.mp4").exists()


def test_a_film_needs_its_library(files, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    assert render(files, "--out", files / "film.mp4") == 2
    assert 'this needs imageio_ffmpeg: pip install "analytic_rasterizer[video]"' in capsys.readouterr().err


def test_a_film_has_one_size(files, capsys):
    pytest.importorskip("imageio_ffmpeg", reason="needs the video extra")
    io.save_views(files / "cameras.json", [*ring(2), *ring(2, width=32)])
    assert render(files, "--out", files / "film.mp4") == 2
    assert "a film has one size, and the views have several: give --path views" in capsys.readouterr().err


def test_without_a_background_none_is_said(files, capsys):
    (files / "cfg_args").write_text("Namespace(white_background=True)")
    assert render(files, "--out", files / "out") == 0 and "background white" in capsys.readouterr().err
    assert render(files, "--alpha", "--out", files / "out") == 0 and "; background" not in capsys.readouterr().err


def test_alpha_and_depth(files):
    out = files / "out"
    assert render(files, "--alpha", "--depth", "--out", out, "--scales", "1,0.5") == 0
    scene, views = io.load_scene(files / "scene.ply"), io.load_views(files / "cameras.json")
    for folder, scale in (("scale_1", 1), ("scale_0.5", 2)):
        for view in views:
            settings = view.settings(scale, io.BLACK, 0, "box", effects=ar.Effects(alpha=True, depth=True))
            with torch.no_grad():
                color, _, found = ar.GaussianRasterizer(settings)(means2D=None, **scene.arguments())
            picture = np.asarray(image.open(out / folder / f"{view.name}.png")) / 255
            alpha = found.alpha.clamp(0, 1)
            assert np.abs(picture[..., 3] - alpha[0].numpy()).max() <= 0.5 / 255 + 1e-6
            # Laid over a background, it is the picture with this background.
            over = picture[..., :3] * picture[..., 3:] + 1 - picture[..., 3:]
            assert np.abs(over - (color + 1 - alpha).permute(1, 2, 0).clamp(0, 1).numpy()).max() < 3 / 255
            depth = np.load(out / folder / "depth" / f"{view.name}.npy")
            assert depth.dtype == np.float32
            covered = alpha[0].numpy() > 0.5
            assert (depth[~covered] == 0).all() and covered.mean() > 0.02
            assert depth[covered] == pytest.approx((found.depth / alpha)[0].numpy()[covered], rel=1e-5)
            near = np.asarray(image.open(out / folder / "depth" / f"{view.name}.png"))[..., 0]
            assert ((near > 0) == covered).all()
