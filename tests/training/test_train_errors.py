"""What a training refuses before it begins: captures and folders for results."""

import json
import math
import re
import shutil
import struct
import zlib

import commands
import numpy as np
import pytest
from commands import refused
from train_extra import image


def png_of_size(width: int, height: int) -> bytes:
    """The start of a black PNG, which says its size."""
    header = b"IHDR" + struct.pack(">2I5B", width, height, 1, 0, 0, 0, 0)
    rest = b"IDAT" + zlib.compress(b"")
    parts = [struct.pack(">I", len(part) - 4) + part + struct.pack(">I", zlib.crc32(part)) for part in (header, rest)]
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


def nan_picture(folder) -> None:
    """A floating-point picture where the PNG was: Pillow tells formats by their content."""
    pixels = np.zeros((32, 32), np.float32)
    pixels[3, 7] = np.nan
    image.fromarray(pixels).save(folder / "train" / "r_4.png", format="TIFF")


def of_picture(change):
    """A change of the bytes of one picture."""

    def write(folder):
        path = folder / "train" / "r_1.png"
        path.write_bytes(change(path.read_bytes()))

    return write


def of_transforms(change):
    """A change of what the transforms file of the training says."""

    def write(folder):
        path = folder / "transforms_train.json"
        content = json.loads(path.read_text())
        change(content)
        path.write_text(json.dumps(content))

    return write


BROKEN = {
    "no folder": (lambda f: f.rename(f.with_name("elsewhere")), "no such folder"),
    "nothing in it": (
        lambda f: [shutil.rmtree(f / "train"), shutil.rmtree(f / "test"), (f / "transforms_train.json").unlink()],
        "expected transforms_train.json, metadata.json",
    ),
    "missing pictures": (
        lambda f: [(f / "train" / f"r_{i}.png").unlink() for i in (2, 5)],
        r"2 of 13 pictures are missing, the first is .*r_2",
    ),
    "nan": (nan_picture, r"r_4.png: pixels must be finite, got nan at x 7, y 3"),
    "cut short": (of_picture(lambda content: content[:200]), "r_1.png: unreadable or cut short"),
    "too large for Pillow": (
        of_picture(lambda content: png_of_size(20000, 10000)),
        r"r_1.png: unreadable or cut short \(Image size \(200000000 pixels\) exceeds limit",
    ),
    "broken header": (of_picture(lambda content: b"P6 3x2 255\n"), "r_1.png: unreadable or cut short"),
    "one camera": (
        of_transforms(lambda c: c.update(frames=c["frames"][:1])),
        "training needs at least 2 pictures, got 1",
    ),
    "one place": (
        of_transforms(lambda c: c.update(frames=[c["frames"][0]] * 3)),
        "cameras at different places, got all 3 at one",
    ),
    "bad pose": (
        of_transforms(lambda c: c["frames"][1].update(transform_matrix=[[math.nan] * 4] * 4)),
        "frame 1: transform_matrix must hold 4 x 4 finite numbers",
    ),
}


@pytest.mark.parametrize("case", BROKEN)
def test_broken_captures_are_one_line_and_leave_no_results(synthetic, tmp_path, capsys, case):
    folder = tmp_path / "scene"
    shutil.copytree(synthetic, folder)
    breaks, message = BROKEN[case]
    breaks(folder)
    error = refused(capsys, commands.train, folder, tmp_path / "out", "--missing refuse --iterations 1")
    assert re.search(message, error)
    assert not (tmp_path / "out").exists()


def test_a_folder_for_results_that_is_none_is_known_before_the_capture_is_read(
    synthetic, tmp_path, capsys, monkeypatch
):
    monkeypatch.setattr("analytic_rasterizer.training.run.settle", None)  # who looks at the capture
    (tmp_path / "a").write_text("a file")
    for out in (tmp_path / "a", tmp_path / "a" / "b" / "c"):
        error = refused(capsys, commands.train, synthetic, out, "--iterations 1")
        assert error == f"error: {tmp_path / 'a'}: expected a folder for the results, got a file\n"
    monkeypatch.setattr("os.access", lambda path, mode: False)
    error = refused(capsys, commands.train, synthetic, tmp_path / "b" / "c", "--iterations 1")
    assert error.startswith(f"error: {tmp_path}: the folder for the results cannot be written to (Permission denied")
    assert [path.name for path in tmp_path.iterdir()] == ["a"]
