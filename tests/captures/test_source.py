"""`CaptureSource`: where a training gets its pictures from, and that a resumed one goes on with them."""

import json
import re

import pytest

pytest.importorskip("PIL.Image", reason="needs the train extra")

from capture_files import circle, write_nerf_synthetic

from analytic_rasterizer import training
from analytic_rasterizer.training import CaptureSource, TrainingOptions, files

TINY = {"iterations": 2, "random_points": 30, "sh_degree": 0, "density": "none", "effects": "none"}


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("source") / "scene"
    write_nerf_synthetic(folder, circle(4), circle(2))
    return folder


def test_what_is_usual_is_in_place_of_none(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    usual = CaptureSource("lego", points="a.ply", masks="none").settled()
    assert usual == CaptureSource("lego", "images", 8, "a.ply", None, "keep", "refuse", "none", "background")
    described = usual.to_dict()
    assert list(described)[:5] == ["scene", "images", "test_every", "points", "cameras"]
    assert described["scene"] == str(tmp_path / "lego") and described["points"] == str(tmp_path / "a.ply")
    assert CaptureSource.from_dict(json.loads(json.dumps(described))).to_dict() == described
    with pytest.raises(KeyError):
        CaptureSource.from_dict({"scene": "lego"})


def test_a_resumed_training_has_the_source_of_its_start():
    began = CaptureSource("lego", images="photographs", lens="undistort").settled().to_dict()
    again = CaptureSource("elsewhere").settled(began)
    assert (again.folder, again.images, again.lens, again.test_every) == ("elsewhere", "photographs", "undistort", 8)
    assert CaptureSource("lego", images="photographs").settled(began).images == "photographs"
    for name, value, expected in (("lens", "keep", "undistort or None"), ("cameras", "sparse/1", "None")):
        message = f"{name} must be {expected} where a training is resumed, got {value}"
        with pytest.raises(ValueError, match=re.escape(message)):
            CaptureSource("lego", **{name: value}).settled(began)
    earlier = {name: began[name] for name in ("scene", "images", "test_every")}  # of versions that had no more
    assert CaptureSource("lego").settled(earlier).lens == "keep"
    assert CaptureSource("lego", points="/a.ply").settled(earlier).points == "/a.ply"


def test_a_training_takes_a_source_or_a_folder_with_the_same_names(scene, tmp_path):
    described = []
    ways = [(CaptureSource(scene, alpha="mask", test_every=4), {}), (scene, {"alpha": "mask", "test_every": 4})]
    for number, (source, reading) in enumerate(ways):
        run = training.Run(source, tmp_path / str(number), TrainingOptions(**TINY), **reading)
        run.train()
        described.append(json.loads((tmp_path / str(number) / files.OPTIONS).read_text())["source"])
        assert all(item.alpha_is_mask for item in run.capture.train)
    assert described[0] == described[1] and described[0]["alpha"] == "mask" and described[0]["taken"] == {}
    resumed = training.Run(scene, tmp_path / "0", resume=True)
    assert resumed.source["alpha"] == "mask" and all(item.alpha_is_mask for item in resumed.capture.train)


def test_what_says_nothing_of_a_source_is_refused(scene, tmp_path):
    with pytest.raises(TypeError, match="unexpected keyword argument 'speed'"):
        training.Run(scene, tmp_path, speed=1)
    with pytest.raises(TypeError, match="lens must be in the CaptureSource, and not beside it"):
        training.Run(CaptureSource(scene), tmp_path, lens="keep")


@pytest.mark.parametrize("way", ["the same", "a slash", "a link"])
def test_results_in_the_capture_are_refused_before_it_is_looked_at(scene, tmp_path, monkeypatch, way):
    monkeypatch.setattr(CaptureSource, "load", lambda *_, **__: pytest.fail("the capture was read"))
    (tmp_path / "link").symlink_to(scene, target_is_directory=True)
    out = {"the same": scene, "a slash": f"{scene}/", "a link": tmp_path / "link"}[way]
    before = sorted(scene.rglob("*"))
    with pytest.raises(ValueError, match="--out must be another folder than the capture"):
        training.Run(scene, out, TrainingOptions(iterations=2))
    assert sorted(scene.rglob("*")) == before
