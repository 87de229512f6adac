"""The programs in benchmarks/ run, on a scene so small that their numbers mean nothing: what they draw and compare."""

import importlib
import math
import re

import pytest
import scenes
import torch
from benchmark_files import files_of, written
from places import ROOT

import analytic_rasterizer as ar
from analytic_rasterizer import _C, io
from analytic_rasterizer.dialects import DIALECTS
from analytic_rasterizer.gaussians import Gaussians

pytestmark = pytest.mark.usefixtures("imports_of_benchmarks")


def test_effects(device, small_scene, run):
    """Every row, with numbers in all of its columns."""
    effects = importlib.import_module("effects")
    options = ["--footprints", "box:samples=4", "--rounds", "1", "--scales", "2", "--threads", "1", "--device", device]
    table = run(effects, *files_of(small_scene), *options)
    results = written(small_scene)["results"]["box:samples=4"]
    assert list(results) == list(effects.ROWS)
    for name, result in results.items():
        assert f"| {name} |" in table
        for side in ("off", "on"):
            assert all(math.isfinite(value) for value in result[side].values())
            assert min(result[side]["forward"], result[side]["forward_backward"]) > 0


def test_footprint_figure(tmp_path, run):
    """It is drawn, and what it draws of moving samples is what the library blends (the program compares)."""
    pytest.importorskip("matplotlib", reason="needs the analysis extra")
    figure = importlib.import_module("footprint_figure")
    run(figure, "--out", tmp_path)
    for name in ("one", "two"):
        assert 10_000 < (tmp_path / f"footprints_{name}.png").stat().st_size < 80_000
    moment, one_weight = map(figure.shares, ("moment:samples=4", "exact"))
    truth = figure.shares(figure.UNFILTERED, figure.FINE)
    assert (moment - truth).abs().max() < 0.02 < (one_weight - truth).abs().max()


def test_accuracy_figure(tmp_path, run):
    """The figures have the numbers of the documents' tables: a row that is renamed, or gone, is missed here."""
    pytest.importorskip("matplotlib", reason="needs the analysis extra")
    figure = importlib.import_module("accuracy_figure")
    run(figure, "--out", tmp_path)
    assert all((tmp_path / name).stat().st_size > 10_000 for name in ("accuracy_time.png", "errors_weight.png"))
    for psnr_column, time_column, _ in figure.SCENES:
        shown = {name: (time, psnr) for name, time, psnr in figure.points(psnr_column, time_column)}
        assert len(shown) == 10 and shown["moment, 4"][1] > shown["box, 1"][1] + 10 > shown["point"][1] + 20
    text = (figure.DOCS / "performance.md").read_text()
    assert f"{shown['moment, 4'][0]} / " in text  # of a cell with two numbers the first
    assert set(figure.LINES) <= set(figure.table(figure.DOCS / "accuracy.md", "The weight"))


def test_dialects(run):
    """A row for every dialect, and both calls of each make the same images."""
    benchmark = importlib.import_module("dialects")
    rows = run(benchmark, "--rounds", "2").splitlines()[4:]
    assert [row.split()[1] for row in rows] == list(DIALECTS)
    assert all(float(cell) < math.inf for row in rows for cell in row.strip("|").split("|")[1:])
    for name in DIALECTS:
        calls = benchmark.calls_of(name)
        own, library = calls["dialect"](), calls["library"]()
        color = own[2] if name == "lightgaussian" else own[0]
        assert torch.equal(color, library[0][:3]) and (color > 0).any()
        if len(library) == 3 and library[2].gaussian_stats is None:  # the others are arranged in many ways
            made = [image for image in library[2] if image is not None]
            assert name == "luiten" or all(any(torch.equal(image, value) for value in own) for image in made)


def test_formats(small_scene, run):
    """A row for every format and for the file of another program; what rounds less shows less."""
    benchmark, scene_files = importlib.import_module("formats"), importlib.import_module("scene_files")
    io.save_scene(small_scene / "other.ply", scene_files.load_scene(small_scene / "scene.npz"))
    options = ["--also", str(small_scene / "other.ply"), "--device", "cpu", "--footprint", "box:samples=1"]
    table = run(benchmark, *files_of(small_scene), *options)
    results = {row["file"]: row for row in written(small_scene)["results"]}
    assert list(results) == [*(f"scene.{suffix}" for suffix in benchmark.FORMATS), "other.ply"]
    assert all(f"| {name.removeprefix('scene')} |" in table for name in results)
    assert results["scene.ply"]["psnr"] == results["other.ply"]["psnr"] == 300
    assert results["scene.glb"]["psnr"] > 100 > results["scene.spz"]["psnr"] > results["scene.splat"]["psnr"] > 10
    assert results["scene.glb"]["rotations"][0] < 1e-4 < 0.01 < results["scene.spz"]["rotations"][0] < 0.3


def test_approximations(small_scene, run):
    """The program's first picture is the library's, and what is approximated changes it (no ray of it is dark)."""
    benchmark = importlib.import_module("approximations")
    options = ["--scales", "1", "--crop", "24", "20", "--samples", "2", "--limit-views", "1", "--threads", "1"]
    assert "| a | 1/1 |" in run(benchmark, *files_of(small_scene), *options)
    [result] = written(small_scene)["results"]
    # One of the 1920 samples on the other side of a threshold by rounding: 1/255/4 in one of 480 pixels.
    assert result["library"] > -20 * math.log10(1 / 255 / 4 / math.sqrt(480))
    changed = [name for name in benchmark.VARIANTS if name != "0.9999"]
    assert all(0 < result[name] < 0.9 * result["library"] for name in changed)


def test_perspective_is_that_of_sampling_along_rays(small_scene):
    """Maximum and integral of a Gaussian along a ray, by their closed forms and at 1,001 points of the ray."""
    benchmark = importlib.import_module("approximations")
    scene = importlib.import_module("scene_files").load_scene(small_scene / "scene.npz")
    splats = benchmark.Splats(scene, io.load_views(small_scene / "views.json")[0])
    ids = torch.arange(8)
    rays = torch.tensor([[0.0, 0.0, 1.0], [0.2, -0.3, 1.0], [-0.5, 0.4, 1.0]], dtype=torch.float64)
    straight = splats.centre[ids] / splats.centre[ids, 2:]  # through the centre of each

    def along(rays):
        """(M, N, 1001) density relative to the peak, and distances of the points from the camera."""
        at = torch.linspace(-1, 1, 1001, dtype=torch.float64)
        whitened = (splats.whiten[ids] @ rays.T).permute(2, 0, 1)
        centre = (splats.whiten[ids] @ splats.centre[ids, :, None])[..., 0]
        square = whitened.square().sum(-1)
        t = (whitened * centre).sum(-1)[..., None] / square[..., None] + 8 * at / square[..., None].sqrt()
        d = t[..., None] * whitened[:, :, None] - centre[None, :, None]
        return torch.exp(-d.square().sum(-1) / 2), t * rays.norm(dim=1)[:, None, None]

    density, distance = along(rays)
    through_centres = torch.trapezoid(*along(straight), dim=-1).diagonal()
    expected = {"maximum": density.amax(-1), "integral": torch.trapezoid(density, distance, dim=-1) / through_centres}
    for projection, sampled in expected.items():
        alpha, depth = benchmark.alphas_and_depths(splats, ids, rays, projection)
        front = depth > 0
        assert front.any() and (alpha[~front] == 0).all()
        torch.testing.assert_close(alpha[front], (splats.opacity[ids] * sampled)[front], rtol=1e-9, atol=1e-15)


def test_order_of_each_ray(small_scene):
    """Two plates that cross: on each side another one is in front, whichever has the nearer centre."""
    benchmark = importlib.import_module("approximations")
    turn = math.pi / 8  # half of the angle between plate and picture
    scene = Gaussians.from_activated(
        means=torch.tensor([[0.0, 0.0, 4.0], [0.0, 0.0, 4.01]]),
        scales=torch.tensor([[1.0, 1.0, 0.01]]).repeat(2, 1),
        rotations=torch.tensor([[math.cos(turn), 0, math.sin(turn), 0], [math.cos(turn), 0, -math.sin(turn), 0]]),
        opacities=torch.full((2, 1), 0.99),
        shs=torch.tensor([[[1.5, -1.5, -1.5]], [[-1.5, 1.5, -1.5]]]),
    )
    view = io.View("a", 32, 16, 30.0, 30.0, torch.eye(4, dtype=torch.float64))
    splats = benchmark.Splats(scene, view)
    by_center, by_ray = (
        benchmark.render(splats, (0, 0), (32, 16), 2, benchmark.Variant(central_order=central))
        for central in (True, False)
    )
    left, right = (slice(None), 8, 11), (slice(None), 8, 20)
    assert by_center[left][0] > by_center[left][1] and by_center[right][0] > by_center[right][1]
    assert (by_ray[left][0] > by_ray[left][1]) != (by_ray[right][0] > by_ray[right][1])


def test_stillness(small_scene, run):
    """Its exact order is that of the library for windows as long as lists, and its film is small."""
    image = pytest.importorskip("PIL.Image", reason="needs the train extra")
    benchmark = importlib.import_module("stillness")
    options = ["--scales", "1", "--crop", "24", "20", "--samples", "2", "--steps", "2", "--threads", "1"]
    film = ["--film", str(small_scene / "film.png"), "--film-frames", "3", "--film-size", "24", "16"]
    table = run(benchmark, *files_of(small_scene), *options, *film)
    [result] = written(small_scene)["results"]
    assert all(f"| 1/1 | {name} |" in table for name in benchmark.FOOTPRINTS)
    for found in result["footprints"].values():
        error, moves = zip(*(found["popping"][order] for order in benchmark.ORDERS))
        assert all(math.isfinite(value) for value in (*error, *moves, *found["aliasing"]))
        assert error[1] <= error[0] and max(error[1:]) < 1
        assert all(of <= all_of for of, all_of in zip(moves, error))  # a deviation is at most the error itself
    with image.open(small_scene / "film.png") as shown:
        assert shown.n_frames == 4 and shown.size == (48, 16)
    with pytest.raises(ValueError, match="footprints must be among point, mip, box:samples=1 and moment"):
        benchmark.Filter.of("cumulant")


def test_lens_accuracy(tmp_path, small_scene, run):
    """Rows with numbers; the library's samples are the program's; pictures; the number predicts errors of weights."""
    benchmark = importlib.import_module("lens_accuracy")
    sizes = ["--size", "24", "16", "--samples", "2", "--gaussians", "60", "--threads", "1", "--fovs", "90", "150"]
    options = ["--sigmas", "2", "--scenes", "1", "--out", str(tmp_path / "out"), "--json", str(tmp_path / "out.json")]
    run(benchmark, *sizes, *options)
    results = written(tmp_path)
    rows = {(row["camera"], row["field of view"]): row for row in results["pictures"]}
    assert list(rows) == [("fisheye", "90"), ("perspective", "90"), ("pinhole", "90"), ("fisheye", "150")]
    assert all(math.isfinite(row[name]) for row in rows.values() for name in ("affine", *benchmark.FOOTPRINTS, "above"))
    assert rows["fisheye", "90"]["affine"] > rows["fisheye", "150"]["affine"] + 3
    assert 1 >= rows["fisheye", "90"]["kept"] > rows["fisheye", "150"]["kept"] > 0.5
    assert sum(row[kind][0] for row in results["weights"] for kind in benchmark.CAMERAS if kind in row) <= 180
    assert (tmp_path / "out" / "fisheye_150_2_affine_x10.png").exists()
    files = [str(small_scene / "scene.npz"), "--views", str(small_scene / "views.json"), "--fovs", "100"]
    assert "| fisheye | 100 | the scene |" in run(benchmark, *files, *sizes[:-3])


def test_lens_accuracy_approximates_what_the_library_renders(small_scene):
    """Its affine picture is that of the library's own unfiltered samples, in the library's order."""
    benchmark = importlib.import_module("lens_accuracy")
    view = benchmark.camera("fisheye", 100, (24, 16))
    scene = benchmark.random_scene(1, 100, 2.0, (24, 16))
    splats = benchmark.LensSplats(scene, view, benchmark.CAMERAS["fisheye"])
    affine = benchmark.render_whole(splats, "affine", 1)
    own = benchmark.library_picture(scene, view, benchmark.CAMERAS["fisheye"], "point:dilation=0")
    # One of the 384 samples may be on the other side of a threshold by rounding.
    assert (affine - own).abs().flatten().sort().values[:-6].max() < 1e-6 and (affine - own).abs().max() < 2 / 255


def test_unscented_of_a_linear_map_is_affine(small_scene):
    """Far away and small Gaussians: all three pictures of a splat are the same."""
    benchmark = importlib.import_module("lens_accuracy")
    view, lens = benchmark.camera("fisheye", 100, (24, 16)), benchmark.CAMERAS["fisheye"]
    scene = benchmark.random_scene(1, 100, 2.0, (24, 16))
    scene = scene._replace(log_scales=scene.log_scales - math.log(1e4))
    splats = benchmark.LensSplats(scene, view, lens)
    mean, covariance = splats.mean, splats.covariance
    drawn = mean[:, 0] < benchmark.NOWHERE
    for options in benchmark.UNSCENTED.values():
        splats.project()
        splats.transform_unscented(*options)
        torch.testing.assert_close(splats.mean[drawn], mean[drawn], rtol=0, atol=1e-6)
        torch.testing.assert_close(splats.covariance[drawn], covariance[drawn], rtol=1e-3, atol=1e-12)


def test_affine_error_predicts_errors_of_weights(small_scene):
    """For every camera: the error is no more than the number, and mostly a quarter of it or more."""
    benchmark = importlib.import_module("lens_accuracy")
    for kind in benchmark.CAMERAS:
        error, worst = benchmark.weight_errors(kind, 60, 2)
        wide = (error > 0.03) & (error < 1)
        assert wide.sum() > 10
        assert (worst[wide] < 1.1 * error[wide]).all()
        assert (worst[wide] / error[wide]).median() > 0.25


def test_every_kernel(device, monkeypatch, run):
    """The program for compute-sanitizer ends; the parts that render footprints are alike, so that one will do here."""
    program = importlib.import_module("every_kernel")
    of_footprints = [scenes.name_of(variant) for variant in scenes.VARIANTS if scenes.name_of(variant) != "box-4"]
    for name in (*of_footprints, "largest"):
        monkeypatch.delitem(program.PARTS, name)
    parts = list(program.PARTS)  # so that it is an error if one of the operators is not called
    if device == "cuda":  # where kernels of the parts that are left out must be launched as well
        monkeypatch.setattr(program, "kernels_of_library", lambda: set(_C.launched_kernels()))
    lines = run(program, *parts, "--device", device).splitlines()
    assert [line for line in lines if line in parts] == parts
    assert device == "cpu" or lines[-1].endswith(" kernels were launched")


@pytest.mark.parametrize("footprint, options", scenes.PATHS, ids=map(scenes.name_of, scenes.PATHS))
def test_every_kernel_has_images_that_need_it(footprint, options):
    """What its comment says of lists and of pixels that close."""
    program = importlib.import_module("every_kernel")
    long_list = re.search(r"kLongList = (\d+);", (ROOT / "csrc" / "cuda" / "moment" / "policy.h").read_text())[1]
    longest, most_in_tile, closed, short = {}, {}, {}, {}
    for name, image in program.IMAGES.items():
        settings = image.camera().settings(torch.float32, footprint=footprint, **options)._replace(sh_degree=3)
        leaves = scenes.leaves(image.scene("cpu"))
        del leaves["means2D"]
        splats = ar.project(settings, **leaves)
        lists = ar.list_tiles(splats)
        of_camera = lists.of_camera()
        ar.blend(splats, lists)[0].sum().backward()
        lists = of_camera["tile_offsets"].diff()
        longest[name], short[name] = int(lists.max()), int(((lists > 0) & (lists < int(long_list))).sum())
        # With its mean in a tile, of the smallest that there are, a splat that has pairs has one with that tile.
        side = 8 if name.startswith("large") else 4
        listed = splats.means2d.detach()[of_camera["pairs"].long().unique()]
        tiles = ((listed + 0.5) / side).floor()
        most_in_tile[name] = int(tiles.unique(dim=0, return_counts=True)[1].max())
        # Splats as large as a pixel, of opacities of 0.3 and above, that have a pixel and no gradient: all are closed.
        inside = ((splats.means2d > 0) & (splats.means2d < torch.tensor([image.width - 1, image.height - 1]))).all(1)
        closed[name] = int((inside & (leaves["opacities"].grad[splats.gaussian_ids.long(), 0] == 0)).sum())
    large = [image for name, image in program.IMAGES.items() if name.startswith("large")]
    assert all((image.width // 8) * (image.height // 8) >= 4096 for image in large)
    assert (program.LARGEST.width // 16) * (program.LARGEST.height // 16) >= 4096
    assert most_in_tile["small"] > int(long_list) and longest["small"] > int(long_list)
    assert most_in_tile["large, few tiles"] > int(long_list) and short["large, few tiles"] > 100
    assert closed["large, opaque"] > 100 and closed["small, opaque"] > 100
