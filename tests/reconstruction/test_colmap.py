"""Cameras that COLMAP finds, through pycolmap: they are those that photographs were taken with."""

import json
from dataclasses import replace

import commands
import numpy as np
import pytest
import torch
from places import SHARED
from train_extra import image
from unposed import SIZE, disagreement, draw, places, walk, write_photographs

from analytic_rasterizer import io
from analytic_rasterizer.captures import colmap, loading
from analytic_rasterizer.reconstruction import films, process, reconstruct
from analytic_rasterizer.training import load_capture

pytestmark = pytest.mark.skipif(not process.is_installed(), reason="needs the colmap extra")

NEAR = 0.01  # of the scene's size
QUICK = "--max-gaussians 3000 --scales 2 --sh-degree 0 --seconds"


def placed(folder) -> dict[str, torch.Tensor]:
    found = load_capture(folder)
    return places([item.view for item in (*found.train, *found.test)])


def test_photographs_become_a_scene_by_one_command(tmp_path, capsys):
    """Of two sizes, some of them in a format that COLMAP does not read, under names with spaces."""
    views = walk(10)
    write_photographs(tmp_path / "my photographs", views[:7])
    write_photographs(
        tmp_path / "my photographs", [replace(view, name=f"q {view.name}") for view in views[7:]], ".webp"
    )
    assert (
        commands.command("train", tmp_path / "my photographs", "--out", tmp_path / "out", "--device cpu", f"{QUICK} 2")
        == 0
    )
    said = capsys.readouterr()
    assert "COLMAP found the cameras of 10 of 10 photographs" in said.err
    assert "photographs placed: 10 of 10 (100%)" in said.err and "cameras " in said.err.splitlines()[-1]
    assert io.load_scene(tmp_path / "out" / "scene.ply").means.shape[0] > 0
    found = {name.removeprefix("q "): place for name, place in placed(tmp_path / "out" / "capture").items()}
    assert disagreement(found, places(views)) < NEAR
    _, colors = colmap.load_points(tmp_path / "out" / "capture" / "sparse" / "0")
    assert colors.std() > 0.05  # those of the photographs
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert metrics["phases"]["cameras"] > 0 and metrics["test"]["mean"]["psnr"] > 10


def test_masks_have_no_features(tmp_path):
    views = walk(8)
    write_photographs(tmp_path / "images", views)
    (tmp_path / "masks").mkdir()
    half = np.full(SIZE[::-1], 255, np.uint8)
    half[:, : SIZE[0] // 2] = 0
    for view in views:
        image.fromarray(half).save(tmp_path / "masks" / f"{view.name}.png")
    found = reconstruct(tmp_path, tmp_path / "capture")
    capture = load_capture(found.folder)
    assert all(item.mask is not None for item in (*capture.train, *capture.test))
    observed = columns_of(found.folder / "sparse" / "0" / "images.bin")
    assert len(observed) > 100 and observed.min() > SIZE[0] // 2 - 1


def columns_of(path) -> np.ndarray:
    """x of all observations, px."""
    records, columns = colmap._Records(path), []
    for _ in range(records.count):
        records.take("i7di")
        records.text()
        (count,) = records.take("Q")
        start = records.skip(colmap.OBSERVATION.itemsize * count)
        columns.append(np.frombuffer(records.data, colmap.OBSERVATION, count, start)["x"])
    return np.concatenate(columns)


def test_photographs_that_show_nothing_in_common(tmp_path, capsys):
    (tmp_path / "photographs").mkdir()
    for i in range(4):
        noise = np.random.default_rng(i).integers(0, 255, (*SIZE[::-1], 3), dtype=np.uint8)
        image.fromarray(noise).save(tmp_path / "photographs" / f"p_{i}.png")
    assert commands.train(tmp_path / "photographs", tmp_path / "out") == 2
    said = capsys.readouterr().err.splitlines()[-1]
    assert "error: " in said and "COLMAP placed none of 4 photographs, no two show the same" in said
    assert not (tmp_path / "out" / "capture").exists()


def test_a_film_becomes_a_capture(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(films, "LEAST", 6)
    pytest.importorskip("imageio_ffmpeg", reason="needs the video extra")
    views = walk(24)
    frames = (torch.from_numpy(draw(view)).permute(2, 0, 1) / 255 for view in views)
    io.save_video(tmp_path / "film.mp4", frames, SIZE, fps=6)
    assert commands.command("inspect", tmp_path / "film.mp4") == 0
    assert "a film of 4.0 s: 8 photographs, of each 0.5 s the sharpest of 3 pictures" in capsys.readouterr().out
    found = reconstruct(tmp_path / "film.mp4", tmp_path / "capture")
    names = sorted(path.name for path in (tmp_path / "capture" / "images").iterdir())
    assert len(names) == 8 and names[0].startswith("frame_0000")
    true = {f"frame_{i + 1:05}": place for i, place in enumerate(places(views).values())}
    assert disagreement(placed(found.folder), true) < NEAR
    assert reconstruct(tmp_path / "film.mp4", tmp_path / "capture").notes[0].startswith("cameras are those that")


def real(name, folder, size, every=1):
    """Photographs of a real capture, reduced to a longer side of so many px; and where their cameras are."""
    data = SHARED / "data" / name
    if not data.is_dir():
        pytest.skip(f"needs {data}")
    folder.mkdir()
    for path in sorted((data / "images").iterdir())[::every]:
        with image.open(path) as opened:
            opened.thumbnail((size, size))
            opened.save(folder / path.name, quality=95)
    return places([item.view for item in loading.load_photographs(data, test_every=0).train])


def test_16_real_photographs_become_a_scene(tmp_path):
    """The whole way, as somebody without a GPU goes it."""
    true = real("fox", tmp_path / "photographs", 640, every=3)
    for path in sorted((tmp_path / "photographs").iterdir())[16:]:
        path.unlink()
    assert (
        commands.train(tmp_path / "photographs", tmp_path / "out", "--scales 4 --max-gaussians 5000 --seconds 20") == 0
    )
    found = placed(tmp_path / "out" / "capture")
    assert len(found) == 16 and disagreement(found, true) < NEAR
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert metrics["gaussians"] > 1000
