"""Writing: what was there stays until the new file is complete, and a full disk says so with the file's name."""

import errno
import json
import os
import re
import stat
from contextlib import contextmanager

import pytest
import torch
from cli_extra import image
from places import ROOT

from analytic_rasterizer import Gaussians, io, viewer
from analytic_rasterizer.analysis import tables
from analytic_rasterizer.io import writing
from analytic_rasterizer.training import files

resource = pytest.importorskip("resource", reason="needs limits of POSIX")

BEFORE = b"what was there"


def scene(count=200):
    g = torch.Generator().manual_seed(0)
    shapes = [(count, 3), (count, 3), (count, 4), (count, 1), (count, 1, 3)]
    return Gaussians(*(torch.randn(*shape, generator=g) for shape in shapes))


def views():
    return [io.View(f"v{i}", 40, 30, 50.0, 51.0, torch.eye(4, dtype=torch.float64)) for i in range(20)]


def figure(path):
    pytest.importorskip("matplotlib", reason="needs the analysis extra")
    tables.save_figure(tables.new_figure(3, 2)[0], path.parent, path.stem)


def film(path):
    """One whose pictures the writer takes all before it writes them: it fails at its end."""
    pytest.importorskip("imageio_ffmpeg", reason="needs the video extra")
    io.save_video(path, torch.rand(3, 3, 64, 64), (64, 64))


WRITERS = {
    "a.ply": lambda path: io.save_scene(path, scene()),
    "a.compressed.ply": lambda path: io.save_scene(path, scene()),
    "a.spz": lambda path: io.save_scene(path, scene(), io.SceneMetadata(footprint="moment")),
    "a.sog": lambda path: io.save_scene(path, scene()),
    "a.glb": lambda path: io.save_scene(path, scene()),
    "a.splat": lambda path: io.save_scene(path, scene()),
    "views.json": lambda path: io.save_views(path, views()),
    "picture.png": lambda path: io.save_image(path, torch.rand(3, 64, 64)),
    "picture.jpg": lambda path: io.save_image(path, image.effect_noise((300, 300), 90), quality=95),
    "film.mp4": film,
    "results.json": lambda path: io.write_json(path, list(range(1000))),
    "page.html": lambda path: viewer.export_page(path, viewer.pack_scene(scene(), footprint="point")),
    "checkpoint.pt": lambda path: files.write_checkpoint(path, {"a": torch.rand(5000)}),
    "cameras.json": lambda path: files.write_cameras(path, views()),
    "log.jsonl": lambda path: files.write_log(path, [{"step": i} for i in range(1000)]),
    "scene.ply": lambda path: files.write_scene(path, scene(), "moment"),
    "table.csv": lambda path: tables.save_csv(path, [{"a": i, "b": None} for i in range(1000)]),
    "figure.png": figure,
}


@contextmanager
def small_files(size=300):
    """No file may become larger: the system refuses the rest, as a full disk does."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.parametrize("there", [True, False])
@pytest.mark.parametrize("name", WRITERS)
def test_a_file_that_does_not_fit_leaves_the_one_before(tmp_path, name, there):
    path = tmp_path / name
    WRITERS[name](path)  # what is imported on first use may write files too
    for written in tmp_path.iterdir():
        written.unlink()
    if there:
        path.write_bytes(BEFORE)
    expected = re.escape(f"{path}: cannot be written (File too large); an earlier file of this name is unchanged")
    with small_files(), pytest.raises(OSError, match=expected):
        WRITERS[name](path)
    assert [found.read_bytes() for found in tmp_path.iterdir()] == [BEFORE] * there


def raising(error):
    def write(temporary):
        temporary.write_bytes(b"half of it")
        raise error

    return write


def without_a_reason(temporary):
    """As PyTorch, which does not say why."""
    os.symlink("/dev/full", temporary)
    raise RuntimeError("[enforce fail at inline_container.cc:672] . unexpected pos 704 vs 598")


needs_dev_full = pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs /dev/full")
FULL = [
    raising(OSError(errno.ENOSPC, "No space left on device")),
    raising(OSError(errno.EDQUOT, "Disk quota exceeded")),
]


@pytest.mark.parametrize("write", [*FULL, pytest.param(without_a_reason, marks=needs_dev_full)])
def test_a_full_disk_is_called_so(tmp_path, write):
    (tmp_path / "a.pt").write_bytes(BEFORE)
    expected = f"{tmp_path / 'a.pt'}: the disk is full; an earlier file of this name is unchanged"
    with pytest.raises(OSError, match=f"^{re.escape(expected)}$"):
        io.write_safely(tmp_path / "a.pt", write)
    assert [found.read_bytes() for found in tmp_path.iterdir()] == [BEFORE]


def test_other_reasons_are_those_of_the_system(tmp_path):
    for write, reason in (
        (raising(OSError(errno.EROFS, "Read-only file system")), "Read-only file system"),
        (raising(RuntimeError("no idea\nand more")), "no idea"),
    ):
        with pytest.raises(OSError, match=rf"a\.txt: cannot be written \({reason}\)"):
            io.write_safely(tmp_path / "a.txt", write)
    with pytest.raises(OSError, match=r"missing/a\.txt: cannot be written \(No such file or directory\)"):
        io.write_text(tmp_path / "missing" / "a.txt", "a")
    with pytest.raises(OSError, match=rf"{tmp_path.name}: cannot be written \(Is a directory\)"):
        io.write_text(tmp_path, "a")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("error", [KeyboardInterrupt, ValueError, SystemExit])
def test_an_interrupted_writer_leaves_the_file_before(tmp_path, error):
    (tmp_path / "a.txt").write_bytes(BEFORE)
    with pytest.raises(error):
        io.write_safely(tmp_path / "a.txt", raising(error()))
    assert [found.read_bytes() for found in tmp_path.iterdir()] == [BEFORE]


def test_the_file_is_complete_before_it_has_its_name(tmp_path, monkeypatch):
    """An interruption between writing and naming leaves the earlier file, and the disk has all of the new one."""
    (tmp_path / "a.txt").write_bytes(BEFORE)
    synced = []
    monkeypatch.setattr(writing.os, "fsync", lambda file: synced.append(os.fstat(file).st_size))

    def replace(source, target):
        assert synced == [3]
        raise KeyboardInterrupt

    monkeypatch.setattr(writing.os, "replace", replace)
    with pytest.raises(KeyboardInterrupt):
        io.write_text(tmp_path / "a.txt", "new")
    assert [found.read_bytes() for found in tmp_path.iterdir()] == [BEFORE]


def test_two_writers_of_one_file_do_not_meet(tmp_path):
    def write(temporary):
        temporary.write_text("outer")
        io.write_text(tmp_path / "a.txt", "inner")
        assert temporary.read_text() == "outer"

    io.write_safely(tmp_path / "a.txt", write)
    assert [found.read_text() for found in tmp_path.iterdir()] == ["outer"]


@pytest.mark.parametrize("name", ["a.compressed.ply", "a", ".hidden", "ü" * 120 + ".json", "n" * 250 + ".json"])
def test_the_temporary_name_ends_as_the_name(tmp_path, name):
    seen = []
    io.write_safely(tmp_path / name, lambda temporary: (seen.append(temporary), temporary.write_text("x")))
    assert seen[0].parent == tmp_path and seen[0].name.endswith(name[-15:]) and not seen[0].exists()
    assert (tmp_path / name).read_text() == "x"


def test_permissions_are_those_of_the_file_before_or_the_usual_ones(tmp_path):
    mask = os.umask(0o027)
    try:
        io.write_text(tmp_path / "new", "x")
        assert stat.S_IMODE((tmp_path / "new").stat().st_mode) == 0o640
        (tmp_path / "new").chmod(0o604)
        io.write_text(tmp_path / "new", "y")
        assert stat.S_IMODE((tmp_path / "new").stat().st_mode) == 0o604
    finally:
        os.umask(mask)


def test_a_file_that_may_not_be_written_is_not_replaced(tmp_path, monkeypatch):
    (tmp_path / "a").write_bytes(BEFORE)
    (tmp_path / "a").chmod(0o444)
    monkeypatch.setattr(writing.os, "access", lambda *_: False)  # root may write everything
    with pytest.raises(OSError, match=r"a: cannot be written \(Permission denied\)"):
        io.write_text(tmp_path / "a", "new")
    assert [found.read_bytes() for found in tmp_path.iterdir()] == [BEFORE]


@pytest.mark.parametrize("there", [True, False])
def test_the_target_of_a_link_is_written(tmp_path, there):
    (tmp_path / "folder").mkdir()
    target, link = tmp_path / "folder" / "target.json", tmp_path / "link.json"
    if there:
        target.write_bytes(BEFORE)
    link.symlink_to(target)
    io.write_json(link, [1.5, float("nan")])
    assert link.is_symlink() and json.loads(target.read_text()) == [1.5, None]
    assert len(list(tmp_path.rglob("*.json"))) == 2


def test_what_is_no_file_is_written_directly(tmp_path):
    reading, writer = os.pipe()
    with os.fdopen(reading) as file:
        io.write_text(f"/dev/fd/{writer}", "hello")
        os.close(writer)
        assert file.read() == "hello"
    if os.path.exists("/dev/full"):
        with pytest.raises(OSError, match="/dev/full: the disk is full"):
            io.write_text("/dev/full", "hello")


DIRECT = re.compile(r"\.write_(text|bytes)\(|savefig\(|\.tofile\(|\.save\(|open\([^)]*\"(r?[wax]b?|rb?\+)\"")
SAFE = re.compile(r"temporary|in_memory|\bio\.write_|self\.save\(|/proc/self/clear_refs")


def test_every_writer_of_the_package_is_safe():
    """A line that writes a file is within `write_safely`, whose writers call their path `temporary`.

    Logs, which grow line by line, are the files that are opened to be added to: of a training, and of COLMAP.
    """
    logs = (
        'with self.path.open("a", encoding="utf-8") as file:',
        'with log.open("ab") as said, Stages(what) as display:',
    )
    found = []
    for path in [*(ROOT / "analytic_rasterizer").rglob("*.py"), *(ROOT / "examples").rglob("*.py")]:
        for number, line in enumerate(path.read_text().splitlines(), 1):
            if DIRECT.search(line) and not SAFE.search(line) and line.strip() not in logs:
                found.append(f"{path.relative_to(ROOT)}:{number}: {line.strip()}")
    assert found == []
