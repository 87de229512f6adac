"""`evaluate` of scenes that were trained elsewhere: files with --data, and models of 3DGS."""

import json
import shutil
from dataclasses import replace

import commands
import numpy as np
import pytest
import torch
from capture_files import circle, truth_gaussians, write_colmap, write_nerf_synthetic, write_pictures
from commands import refused
from train_extra import image

from analytic_rasterizer import cli, io, render_stages

QUIET = ["--lpips", "none", "--device", "cpu"]


@pytest.fixture(scope="module")
def photographs(tmp_path_factory):
    """A COLMAP capture of 9 photographs of 32x32 px, of which 2 are for the test, and the same at half the size."""
    folder = tmp_path_factory.mktemp("photographs")
    views = circle(9)
    write_colmap(folder / "sparse" / "0", views, torch.randn(9, 3), torch.zeros(9, 3, dtype=torch.int32))
    (folder / "images").mkdir()
    (folder / "images_2").mkdir()
    write_pictures(folder / "images", views, opaque=True)
    for path in (folder / "images").iterdir():
        image.open(path).reduce(2).save(folder / "images_2" / path.name)
    return folder


def psnr_of(scene, views, pictures, footprint, background=io.BLACK):
    """By hand: the mean over views of the PSNR of pictures that are files."""
    found = []
    for view, path in zip(views, pictures):
        truth = torch.from_numpy(np.asarray(image.open(path).convert("RGB")).copy()).permute(2, 0, 1) / 255
        color = render_stages(view.settings(1, background, scene.sh_degree, footprint), **scene.arguments()).color
        found.append(-10 * (color.clamp(0, 1) - truth).square().mean().log10().item())
    return sum(found) / len(found)


def evaluation(folder):
    return json.loads((folder / "evaluation.json").read_text())


@pytest.fixture
def scene(tmp_path):
    """The scene that the photographs show, a little wrong."""
    found = truth_gaussians().map(torch.Tensor.detach)
    found = found._replace(means=found.means + 0.05)
    io.save_scene(tmp_path / "a.ply", found)
    return tmp_path / "a.ply"


def test_a_file_is_compared_with_the_capture_that_is_named(photographs, scene, capsys):
    assert cli.main(["evaluate", str(scene), "--data", str(photographs), *QUIET]) == 0
    out = scene.parent / "a_evaluation"
    found, tested = evaluation(out), circle(9)[::8]
    assert found["views"] == [view.name for view in tested] and found["scene"] == str(scene)
    files = [photographs / "images" / f"{view.name}.png" for view in tested]
    measured = found["results"]["point:dilation=0.3"]["1"]["psnr"]
    assert measured == pytest.approx(psnr_of(io.load_scene(scene), tested, files, "point"), abs=1e-3)
    captured = capsys.readouterr()
    assert "point:dilation=0.3  PSNR" in captured.out
    protocol, choice = captured.err.splitlines()
    assert protocol == f"{scene}: 2 test pictures of {photographs}, reduced by 1; background black"
    assert choice.startswith("footprint point:dilation=0.3: a.ply names none, and 3DGS trains with it")
    assert sorted(path.name for path in (out / "evaluation").iterdir())[0].startswith("point_dilation_0_3_1_")


def test_what_is_given_is_measured(photographs, scene, tmp_path):
    given = ["--test-every", "3", "--images", "images_2", "--footprint", "moment", "box", "--scales", "2"]
    arguments = ["evaluate", str(scene), "--data", str(photographs), "--out", str(tmp_path / "out"), *given, *QUIET]
    assert cli.main([*arguments, "--background", "1", "0", "0"]) == 0
    found = evaluation(tmp_path / "out")
    assert found["views"] == [view.name for view in circle(9)[::3]]
    assert list(found["results"]) == ["moment:samples=4", "box:samples=4"]
    assert list(found["results"]["box:samples=4"]) == ["2", "mean"]
    assert not (scene.parent / "a_evaluation").exists()


def test_the_file_says_its_footprint(photographs, scene, tmp_path):
    io.save_scene(tmp_path / "b.ply", io.load_scene(scene), io.SceneMetadata(footprint="moment:samples=16"))
    assert cli.main(["evaluate", str(tmp_path / "b.ply"), "--data", str(photographs), *QUIET]) == 0
    assert list(evaluation(tmp_path / "b_evaluation")["results"]) == ["moment:samples=16"]


def test_a_capture_with_other_cameras_is_told(photographs, tmp_path, capsys):
    """A copy under other names, with less pictures, or farther from zero has the same ones."""
    out, copy, other = tmp_path / "out", tmp_path / "copy", tmp_path / "other"
    assert commands.train(photographs, out, "--iterations 1 --sh-degree 0 --no-evaluate") == 0
    views = [replace(view, name=f"copy_{view.name}") for view in circle(9)[1:]]
    turn = torch.tensor([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]).double()
    for folder, cameras in ((copy, views), (other, [replace(view, w2c=view.w2c @ turn) for view in circle(9)])):
        write_colmap(folder / "sparse" / "0", cameras, torch.randn(9, 3), torch.zeros(9, 3, dtype=torch.int32))
        (folder / "images").mkdir()
        write_pictures(folder / "images", cameras, opaque=True)
    for folder, told in ((None, 0), (photographs, 0), (copy, 0), (other, 1)):
        capsys.readouterr()
        data = [] if folder is None else ["--data", str(folder)]
        assert cli.main(["evaluate", str(out), *data, "--pictures", "0", *QUIET]) == 0
        note = f"note: no camera of this capture has the pose of one in {out / 'cameras.json'}"
        assert capsys.readouterr().err.count(note) == told


def model_of(scene, tmp_path, **values):
    """A model of 3DGS that holds the scene."""
    folder = tmp_path / "model" / "point_cloud" / "iteration_30000"
    folder.mkdir(parents=True)
    shutil.copy(scene, folder / "point_cloud.ply")
    said = {"source_path": "/data/garden", "white_background": False, "eval": True} | values
    text = ", ".join(f"{key}={value!r}" for key, value in said.items())
    (tmp_path / "model" / "cfg_args").write_text(f"Namespace({text})")
    return tmp_path / "model"


@pytest.mark.parametrize(
    ("values", "given", "scales", "size"),
    [
        ({"resolution": 2}, [], ["2"], 16),
        ({"resolution": -1, "images": "images_2"}, [], ["1"], 16),
        ({"resolution": 2, "images": "images_2"}, [], ["2"], 8),
        ({"resolution": 1, "images": "images_2"}, ["--images", "images"], ["2"], 16),
        ({"resolution": 1, "images": "images_2"}, ["--scales", "1,2"], ["1", "2"], 16),
        ({"resolution": 1, "images": "../images"}, [], ["1"], 32),
        ({"resolution": 4, "images": "not_there"}, [], ["4"], 8),
    ],
)
def test_a_model_of_3dgs_is_tested_at_the_size_of_its_training(
    photographs, scene, tmp_path, values, given, scales, size
):
    model = model_of(scene, tmp_path, **values)
    assert cli.main(["evaluate", str(model), "--data", str(photographs), *given, "--pictures", "1", *QUIET]) == 0
    found = evaluation(model)["results"]["point:dilation=0.3"]
    assert [key for key in found if key != "mean"] == scales
    drawn = next((model / "evaluation").glob(f"point_dilation_0_3_{scales[0]}_*.png"))
    assert image.open(drawn).size == (3 * size, size)


def test_differences_from_the_training_are_said(photographs, scene, tmp_path, capsys):
    model = model_of(scene, tmp_path, resolution=20, eval=False)
    assert cli.main(["evaluate", str(model), "--data", str(photographs), "--pictures", "0", *QUIET]) == 0
    error = capsys.readouterr().err
    assert "cfg_args: eval=False: the training saw these test pictures\n" in error
    assert "cfg_args: the training's pictures were 20 px wide, these are 32 (--scales)\n" in error


@pytest.mark.parametrize(
    ("white", "given", "background"),
    [(True, [], "white"), (False, [], "black"), (None, [], "white"), (False, ["--background", "white"], "white")],
)
def test_background_of_a_model(scene, tmp_path, capsys, white, given, background):
    """Without a word that of the capture, which is white for NeRF-synthetic ones."""
    write_nerf_synthetic(tmp_path / "capture", circle(3), circle(2))
    model = model_of(scene, tmp_path, white_background=white)
    assert cli.main(["evaluate", str(model), "--data", str(tmp_path / "capture"), *given, *QUIET]) == 0
    assert f"background {background}\n" in capsys.readouterr().err
    drawn = np.asarray(image.open(next((model / "evaluation").glob("*.png"))))
    assert np.abs(drawn[0, 0].astype(int) - (255 if background == "white" else 0)).max() < 20


def test_a_scene_without_a_capture_says_what_is_needed(scene, tmp_path, capsys):
    for given, known in (
        (scene, ", nor does an options.json of `train` beside it: give --data FOLDER"),
        (model_of(scene, tmp_path), ": give --data FOLDER; "),
    ):
        error = refused(capsys, cli.main, ["evaluate", str(given)])
        assert "does not name its capture" + known in error
    assert "was trained on /data/garden" in error


def test_a_scene_beside_a_training_is_tested_as_the_training(tmp_path, capsys):
    """With the capture, the scales and the background of options.json, and the footprint of the file."""
    write_nerf_synthetic(tmp_path / "capture", circle(3), circle(2))
    out = tmp_path / "out"
    small = "--iterations 2 --random-points 40 --scales 2 --sh-degree 0 --no-evaluate"
    assert commands.train(tmp_path / "capture", out, small) == 0
    io.save_scene(out / "b.ply", io.load_scene(out / "scene.ply"), io.SceneMetadata(footprint="box:samples=1"))
    for given, folder, footprint in (("", out, "moment:samples=4"), ("b.ply", out / "b_evaluation", "box:samples=1")):
        assert cli.main(["evaluate", str(out / given), *QUIET]) == 0
        found = evaluation(folder)
        assert list(found["results"]) == [footprint] and list(found["results"][footprint]) == ["2", "mean"]
    described = json.loads((out / "options.json").read_text())
    assert described["background"] == [1, 1, 1]
    # What 3DGS trained does not become a scene of this training by its name.
    io.save_scene(out / "scene.ply", io.load_scene(out / "b.ply"))
    assert cli.main(["evaluate", str(out), *QUIET]) == 0
    assert list(evaluation(out)["results"]) == ["point:dilation=0.3"]


def test_a_scene_far_from_zero_is_tested_where_it_lies(photographs, scene, tmp_path):
    """The capture has coordinates of the world, and the file the positions without an offset, and the offset."""
    offset = (3e5, 5e6, 100.0)
    shutil.copytree(photographs / "images", tmp_path / "far" / "images")
    far = [replace(view.in_frame(tuple(-x for x in offset)), offset=None) for view in circle(9)]
    points = torch.randn(9, 3, dtype=torch.float64) + torch.tensor(offset, dtype=torch.float64)
    write_colmap(tmp_path / "far" / "sparse" / "0", far, points, torch.zeros(9, 3, dtype=torch.int32))
    io.save_scene(tmp_path / "b.ply", io.load_scene(scene), io.SceneMetadata(offset=offset))
    for file, data in ((scene, photographs), (tmp_path / "b.ply", tmp_path / "far")):
        assert cli.main(["evaluate", str(file), "--data", str(data), "--pictures", "0", *QUIET]) == 0
    near, moved = (evaluation(tmp_path / f"{name}_evaluation")["results"] for name in "ab")
    found = [of["point:dilation=0.3"]["1"]["psnr"] for of in (near, moved)]
    assert found[0] == pytest.approx(found[1], abs=0.02)
