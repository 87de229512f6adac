"""The example that trains: its data, and what it reports."""

import json
import math
import struct
from dataclasses import replace

import numpy as np
import pytest
import torch
from conftest import SHARED

from analytic_rasterizer import io, render_stages

image = pytest.importorskip("PIL.Image", reason="needs the cli extra")
pytest.importorskip("tqdm", reason="needs the cli extra")

import colmap  # noqa: E402
import dataset  # noqa: E402
import gaussians as g  # noqa: E402
import train  # noqa: E402

# ---------------------------------------------------------------------------------------- data


def write_colmap(folder, views, points, colors, model=1) -> None:
    """A reconstruction with one camera per view, observations and tracks included."""
    folder.mkdir(parents=True)
    cameras, images = [struct.pack("<Q", len(views))], [struct.pack("<Q", len(views))]
    for i, view in enumerate(views):
        parameters = {0: [view.fx], 1: [view.fx, view.fy]}.get(model, [view.fx] * 2)
        parameters += [view.width / 2 if view.cx is None else view.cx, view.height / 2 if view.cy is None else view.cy]
        cameras.append(struct.pack(f"<iiQQ{len(parameters)}d", i + 1, model, view.width, view.height, *parameters))
        turn = quaternion(view.w2c[:3, :3])
        images.append(struct.pack("<i7di", i + 7, *turn, *view.w2c[:3, 3].tolist(), i + 1))
        images.append(f"{view.name}.png".encode() + b"\0" + struct.pack("<Qddqddq", 2, 1, 2, -1, 3, 4, 5))
    (folder / "cameras.bin").write_bytes(b"".join(cameras))
    (folder / "images.bin").write_bytes(b"".join(images))
    records = [struct.pack("<Q", len(points))]
    for i, (point, color) in enumerate(zip(points.tolist(), colors.tolist())):
        track = [1, 2] * (i % 3)
        records.append(struct.pack(f"<Q3d3BdQ{len(track)}i", i, *point, *color, 0.5, len(track) // 2, *track))
    (folder / "points3D.bin").write_bytes(b"".join(records))


def quaternion(rotation) -> list[float]:
    """(w, x, y, z) of a rotation of less than half a turn."""
    w = 0.5 * math.sqrt(1 + rotation.trace())
    skew = rotation - rotation.T
    return [w, *(skew[i, j].item() / (4 * w) for i, j in ((2, 1), (0, 2), (1, 0)))]


def looking_at_origin(angle: float, distance: float = 4.0) -> torch.Tensor:
    """World to camera from a place on a circle around y."""
    c, s = math.cos(angle), math.sin(angle)
    w2c = torch.eye(4, dtype=torch.float64)
    w2c[:3, :3] = torch.tensor([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    w2c[2, 3] = distance
    return w2c


@pytest.mark.parametrize("model", [0, 1])
def test_colmap_files(tmp_path, model):
    views = [
        io.View(name, 40 + i, 30, 50.0, 50.0 + model, looking_at_origin(0.7 * i), 20.5, 14.0)
        for i, name in enumerate("cab")
    ]
    points = torch.randn(5, 3)
    colors = torch.arange(15).reshape(5, 3)
    write_colmap(tmp_path / "0", views, points, colors, model)
    read = colmap.load_views(tmp_path / "0")
    assert [name for name, _ in read] == ["a.png", "b.png", "c.png"]
    for expected, (_, view) in zip(sorted(views, key=lambda v: v.name), read):
        assert replace(view, w2c=None) == replace(expected, w2c=None)
        torch.testing.assert_close(view.w2c, expected.w2c)
    read_points, read_colors = colmap.load_points(tmp_path / "0")
    assert torch.equal(read_points, points)
    torch.testing.assert_close(read_colors, colors / 255)


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
def test_colmap_files_cut_short(tmp_path, name):
    view = io.View("a", 40, 30, 50.0, 50.0, looking_at_origin(0.1))
    write_colmap(tmp_path / "0", [view], torch.zeros(2, 3), torch.zeros(2, 3, dtype=torch.int32))
    path = tmp_path / "0" / f"{name}.bin"
    whole = path.read_bytes()
    for size in range(0, len(whole), 3):
        path.write_bytes(whole[:size])
        with pytest.raises(io.SceneError, match=rf"{name}.bin: cut short"):
            colmap.load_points(tmp_path / "0") if name == "points3D" else colmap.load_views(tmp_path / "0")


def test_colmap_cameras_with_distortion(tmp_path):
    view = io.View("a", 40, 30, 50.0, 50.0, looking_at_origin(0.1))
    write_colmap(tmp_path / "0", [view], torch.zeros(2, 3), torch.zeros(2, 3, dtype=torch.int32), model=4)
    with pytest.raises(io.SceneError, match=r"cameras.bin: cameras must be pinholes"):
        colmap.load_views(tmp_path / "0")


@pytest.mark.parametrize("name, pictures, points", [("bonsai", 292, 82_641), ("fox", 50, None)])
def test_capture_is_read_as_it_was_taken(name, pictures, points):
    """Points have the colours of the pixels that they project to: cameras, cut and pictures belong together."""
    folder = SHARED / "data" / name
    if not folder.exists():
        pytest.skip("needs the optional ../shared scenes next to the project")
    views = colmap.load_views(folder / "sparse" / "0")
    means, colors = colmap.load_points(folder / "sparse" / "0")
    assert len(views) == pictures and len(means) == (points or len(means))
    view, rgba = dataset.load_picture(folder / "images" / views[9][0], views[9][1], 16)
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


def test_cut_pictures_see_the_same(tmp_path):
    """What is left of a picture shows a point where it did, in px of the cut; at half the intrinsics' size too."""
    pixels = torch.randint(256, (29, 45, 3), dtype=torch.uint8, generator=torch.Generator().manual_seed(0)).numpy()
    image.fromarray(pixels).save(tmp_path / "a.png")
    view = io.View("a", 45, 29, 50.0, 51.0, looking_at_origin(0.3), cx=20.0)
    cut, rgba = dataset.load_picture(tmp_path / "a.png", view, 8)
    assert np.array_equal(rgba[..., :3].numpy(), pixels[2:26, 2:42])
    point = torch.tensor([[0.2, -0.3, 0.4]])
    whole, part = (render_stages(v.settings(), **point_inputs(point)).means2d for v in (view, cut))
    torch.testing.assert_close(part, whole - 2, rtol=0, atol=1e-4)
    double = replace(view, width=90, height=58, fx=100.0, fy=102.0, cx=40.0)
    again, _ = dataset.load_picture(tmp_path / "a.png", double, 8)
    assert again == replace(cut, w2c=again.w2c)
    with pytest.raises(io.SceneError, match="45 x 29 px are too few"):
        dataset.load_picture(tmp_path / "a.png", view, 32)


def test_reduced_pictures_average_straight_colors():
    rgba = torch.tensor([[[255, 0, 0, 255], [0, 255, 0, 0]]], dtype=torch.uint8).repeat(2, 1, 1)
    levels = dataset.reduce(rgba, (1.0, 1.0, 1.0), [1, 2])
    assert levels[1][:, 0].T.tolist() == [[255, 0, 0], [255, 255, 255]]
    assert levels[2][:, 0, 0].tolist() == [191, 191, 128]  # 255 (0.5 * 0.5 + 0.5), 128 where there is no blue


# ------------------------------------------------------------------------------------ training


def test_schedule_shows_every_pair_in_turn():
    schedule = train.endless_schedule(3, [1, 4], seed=1)
    rounds = [[next(schedule) for _ in range(6)] for _ in range(3)]
    assert all(sorted(pairs) == [(v, s) for v in range(3) for s in (1, 4)] for pairs in rounds)
    assert rounds[0] != rounds[1]


def test_progress_by_seconds_grows_at_the_last_pace():
    progress = train.Progress(None, seconds=10.0)
    for elapsed in (1.0, 3.0):
        for _ in range(100):
            progress.advance()
        progress.measure(elapsed)
        assert progress.share == elapsed / 10
    progress.advance()
    assert progress.share == pytest.approx(0.302)
    steps = train.Progress(3, None)
    for share in (1 / 3, 2 / 3, 1.0):
        steps.advance()
        steps.measure(99.0)
        assert steps.share == share


def write_pictures(folder, view, opaque: bool) -> None:
    """A few coloured Gaussians, rendered on transparent or on black."""
    points, colors = g.random_points(12, seed=5)
    truth = g.gaussians_at(points, colors, 0)._replace(log_scales=torch.full((12, 3), 0.25).log())
    truth = truth._replace(logit_opacities=torch.full((12, 1), 3.0))
    color, _ = truth.render(view.settings(1, sh_degree=0, footprint="exact"))
    alpha, _ = truth._replace(sh_dc=torch.full((12, 1, 3), 0.5 / g.SH_C0)).render(
        view.settings(1, sh_degree=0, footprint="exact")
    )
    pixels = torch.cat([color if opaque else color / alpha.clamp_min(1e-3), alpha[:1]])[: 3 if opaque else 4]
    pixels = (255 * pixels.clamp(0, 1)).round().to(torch.uint8).permute(1, 2, 0).contiguous().numpy()
    folder.mkdir(parents=True, exist_ok=True)
    image.fromarray(pixels).save(folder / f"{view.name}.png")


def circle(count: int, size=(32, 32)) -> list[io.View]:
    return [io.View(f"r_{i}", *size, 36.0, 36.0, looking_at_origin(0.3 * (i - count / 2))) for i in range(count)]


@pytest.fixture(scope="module")
def synthetic(tmp_path_factory):
    """A scene in the files of NeRF-synthetic."""
    folder = tmp_path_factory.mktemp("synthetic")
    for split, views in (("train", circle(10)), ("test", circle(3))):
        frames = []
        for view in views:
            write_pictures(folder / split, view, opaque=False)
            c2w = torch.linalg.inv(view.w2c)
            c2w[:3, 1:3] *= -1
            frames.append({"file_path": f"./{split}/{view.name}", "transform_matrix": c2w.tolist()})
        content = {"camera_angle_x": 2 * math.atan(32 / 72), "frames": frames}
        (folder / f"transforms_{split}.json").write_text(json.dumps(content))
    return folder


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """A scene in the files of COLMAP, whose sizes do not halve evenly."""
    folder = tmp_path_factory.mktemp("capture")
    views = circle(9, (35, 33))
    points, colors = g.random_points(60, seed=5)
    for view in views:
        write_pictures(folder / "photographs", view, opaque=True)
    write_colmap(folder / "sparse" / "0", views, points, (255 * colors).to(torch.uint8))
    return folder


COMMON = ["--device", "cpu", "--sh-degree", "1", "--scales", "1", "2", "--pictures", "1"]
GROWTH = ["--densify-from", "20", "--densify-every", "20", "--reset-every", "500", "--max-gaussians", "400"]


def test_training_lowers_the_loss_and_reports_it(synthetic, tmp_path, capsys):
    args = [str(synthetic), "--out", str(tmp_path), "--steps", "120", "--gaussians", "150", "--seeds", "0", "1"]
    args += ["--footprints", "mip", "box:samples=2", "--evaluate-every", "50", *COMMON, *GROWTH]
    assert train.main(args) == 0
    report = json.loads((tmp_path / "results.json").read_text())
    assert report.keys() == {"device", "torch", "arguments", "runs"}
    runs = report["runs"]
    names = ["mip", "box:samples=2"]
    assert [(run["footprint"], run["seed"]) for run in runs] == [(name, seed) for seed in (0, 1) for name in names]
    for run in runs:
        assert [point["steps"] for point in run["checkpoints"]] == [50, 100, 120]
        assert run["steps"] == 120 and len(run["loss"]) == 12
        assert run["loss"][-1] < 0.5 * run["loss"][0]
        assert run["checkpoints"][-1].items() <= run.items()
        assert run["psnr"].keys() == run["ssim"].keys() == {"1", "2"}
        assert run["psnr"]["1"] > run["checkpoints"][0]["psnr"]["1"] > 10
        assert 0 < run["ssim"]["1"] < 1
        assert 150 < run["gaussians"] <= 400
        assert run["seconds"] == pytest.approx(0.120 * run["ms_per_step"])
        seconds = [point["seconds"] for point in run["checkpoints"]]
        assert seconds == sorted(seconds)
    assert runs[0]["loss"] != runs[2]["loss"]
    assert len(list((tmp_path / "pictures").iterdir())) == 4
    assert image.open(tmp_path / "pictures" / "mip_2_r_0.png").size == (32, 16)
    table = capsys.readouterr().out.splitlines()
    assert table[1].split()[:5] == ["footprint", "PSNR", "1/1", "PSNR", "1/2"]
    assert [line.split()[0] for line in table[2:]] == names and all("±" in line for line in table[2:])


def test_training_repeats_to_the_bit(synthetic, tmp_path):
    args = [str(synthetic), "--steps", "60", "--gaussians", "50", "--footprints", "analytic", *COMMON, *GROWTH]
    losses = []
    for name in "ab":
        assert train.main([*args, "--out", str(tmp_path / name)]) == 0
        losses.append(json.loads((tmp_path / name / "results.json").read_text())["runs"][0]["loss"])
    assert losses[0] == losses[1]


def test_training_on_a_capture_for_some_time(capture, tmp_path):
    args = [str(capture), "--images", "photographs", "--out", str(tmp_path), "--seconds", "0.6", *COMMON]
    assert train.main([*args, "--footprints", "cumulant", "--no-densify"]) == 0
    run = json.loads((tmp_path / "results.json").read_text())["runs"][0]
    assert 0.6 <= run["seconds"] < 6 and run["steps"] >= 10
    assert run["gaussians"] == 60
    assert run["loss"][-1] < run["loss"][0]
    assert image.open(tmp_path / "pictures" / "cumulant_1_r_0.png").size == (2 * 34, 32)


@pytest.mark.parametrize(
    "extra, message",
    [
        (["--footprints", "bx"], "footprint must be one of"),
        (["--footprints", "box:samples=3"], "samples must be one of"),
        (["--steps", "0"], "argument --steps: must be at least 1, got 0"),
        (["--seconds", "nan"], "argument --seconds: must be positive and finite, got nan"),
        (["--steps", "9", "--seconds", "9"], "not allowed with argument"),
        (["--gaussians", "3"], "--gaussians must be at least 4, got 3"),
        (["--scales", "1", "0"], "argument --scales: must be at least 1, got 0"),
        (["--scales", "64"], "32 x 32 px are too few for these scales"),
    ],
)
def test_bad_arguments_are_one_line(synthetic, tmp_path, capsys, extra, message):
    assert leave([str(synthetic), "--out", str(tmp_path), "--device", "cpu", *extra]) == 2
    error = capsys.readouterr().err
    assert message in error and error.startswith("error: ") and error.count("\n") == 1


def test_a_folder_without_a_scene_is_one_line(tmp_path, capsys):
    assert leave([str(tmp_path), "--out", str(tmp_path / "out"), "--device", "cpu"]) == 2
    assert capsys.readouterr().err == f"error: {tmp_path}: holds neither transforms_train.json nor sparse/0\n"


def leave(args) -> int:
    """The exit code of a command line."""
    try:
        return train.main(args)
    except SystemExit as stop:
        return stop.code
