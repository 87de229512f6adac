"""The programs that make the pictures of docs/gallery.md, on a capture so small that its pictures show nothing."""

import importlib

import numpy as np
import pytest
import torch
from capture_files import circle, write_pictures
from places import ROOT

from analytic_rasterizer import cli
from analytic_rasterizer.training import load_capture

for name, extra in (("PIL.Image", "cli"), ("tqdm", "train")):
    pytest.importorskip(name, reason=f"needs the {extra} extra")
from PIL import Image  # noqa: E402


@pytest.fixture
def programs(monkeypatch):
    """llff and gallery."""
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    return tuple(map(importlib.import_module, ("llff", "gallery")))


def write_llff(folder, views):
    """As LLFF's program does: axes down, right and back. Masks count a square in the middle."""
    write_pictures(folder / "images", views, opaque=True)
    (folder / "masks").mkdir()
    rows = []
    for view in views:
        mask = np.zeros((view.height, view.width), np.uint8)
        mask[8:-8, 8:-8] = 255
        Image.fromarray(mask).save(folder / "masks" / f"{view.name}_mask.png")
        c2w = torch.linalg.inv(view.w2c).numpy()
        right, down, ahead, position = c2w[:3].T
        size = np.array([view.height, view.width, view.fx])
        rows.append([*np.stack([down, right, -ahead, position, size], axis=1).ravel(), 1.0, 9.0])
    np.save(folder / "poses_bounds.npy", np.array(rows))


def test_gallery(tmp_path, monkeypatch, capsys, programs):
    """Cameras arrive as they were; a pair for each view and scale, white where masks leave out."""
    llff, gallery = programs
    views = circle(9)
    write_llff(tmp_path / "llff", views)

    def run(program, *arguments):
        monkeypatch.setattr("sys.argv", [program.__name__, *map(str, arguments)])
        program.main()
        return capsys.readouterr().out

    assert "9 photographs" in run(llff, tmp_path / "llff", tmp_path / "capture", "--reduce", 2)
    capture = load_capture(tmp_path / "capture")
    read = {item.view.name.split(".")[0]: item for item in (*capture.train, *capture.test)}
    for view in views:
        item = read[view.name]
        assert (item.view.width, item.view.fx) == (16, 18.0)
        torch.testing.assert_close(item.view.w2c, view.w2c, rtol=0, atol=1e-12)
    assert "9 photographs" in run(llff, tmp_path / "llff", tmp_path / "cut out", "--alpha")
    assert not (tmp_path / "cut out" / "masks").exists()
    with Image.open(tmp_path / "cut out" / "images" / "r_3.png") as picture:
        assert picture.mode == "RGBA" and np.asarray(picture)[:, :, 3].mean() == pytest.approx(255 / 4)
    training = ["--iterations", "2", "--random-points", "300", "--device", "cpu", "--no-evaluate", "--threads", "1"]
    cli.main(["train", str(tmp_path / "capture"), "--out", str(tmp_path / "out"), *training])
    capsys.readouterr()
    shown = tmp_path / "pictures"
    options = ["--name", "a", "--views", "r_0", "--scales", 1, 2, "--out", shown]
    said = run(gallery, tmp_path / "out", *options)
    assert said.count("r_0 1/") == 2 == said.count(" dB")
    files = sorted(path.name for path in shown.iterdir())
    assert files == [f"a_r_0_{scale}_{kind}.webp" for scale in (1, 2) for kind in ("photograph", "rendering")]
    for name in files:
        pixels = np.asarray(Image.open(shown / name))
        assert pixels.shape == (16, 16, 3)
        assert pixels[:3].min() > 245 and pixels[5:-5, 5:-5].min() < 200
