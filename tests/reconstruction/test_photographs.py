"""Photographs without cameras: what is found of them, and what is said before and after COLMAP runs.

COLMAP itself does not run here (test_colmap.py): `pretend` stands for it.
"""

import json
import shutil
import sys
from pathlib import Path

import commands
import numpy as np
import pytest
from capture_files import circle, random_points, write_colmap
from commands import refused
from train_extra import image

from analytic_rasterizer import io
from analytic_rasterizer.captures import loading
from analytic_rasterizer.reconstruction import capture, process
from analytic_rasterizer.reconstruction.films import sharpness
from analytic_rasterizer.reconstruction.folder import FOCAL_LENGTH, PLACE, find_photographs
from analytic_rasterizer.reconstruction.forecast import groups_of
from analytic_rasterizer.reconstruction.pairs import MOST_EXHAUSTIVE, NEAREST, NEXT, in_order, pairs_of

SIZE = (32, 24)


def picture(path, level=128, size=SIZE, **more):
    path.parent.mkdir(parents=True, exist_ok=True)
    made = image.new("RGB", size, 3 * (level,))
    made.putpixel((0, 0), 3 * (255 - level,))  # pictures of one colour would be warned of
    made.save(path, **more)


def photographs(folder, *names):
    for name in names or [f"p_{i}.png" for i in range(12)]:
        picture(folder / name)
    return folder


def exif_of(focal=None, latitude=None, longitude=None):
    exif = image.Exif()
    if focal is not None:
        exif.get_ifd(0x8769)[FOCAL_LENGTH] = focal
    if latitude is not None:
        place = exif.get_ifd(PLACE)
        place[1], place[2] = "S" if latitude < 0 else "N", (abs(latitude), 30.0, 0.0)
        place[3], place[4], place[6] = "W" if longitude < 0 else "E", (abs(longitude), 0.0, 36.0), 250.0
    return exif


@pytest.fixture
def pretend(monkeypatch):
    """In place of COLMAP: cameras on a circle, of all photographs but the last `left`; returns the jobs that it got."""
    jobs = []

    def make(left=0, others=(), broken=False):
        def run(job, what):
            jobs.append(job)
            if broken:
                raise RuntimeError("COLMAP failed (features): it ended with signal 11")
            names = [job.names[file] for group in job.groups for file in group["names"]]
            names = sorted(names)[: len(names) - left]
            models = [names, *others] if names else []
            points, colors = random_points(60, seed=5)
            for number, placed in enumerate(models):
                views = [view for view in circle(len(placed), SIZE)]
                views = [io.View(name, *SIZE, 36.0, 36.0, view.w2c) for name, view in zip(placed, views)]
                write_colmap(Path(job.output) / str(number), views, points, (255 * colors).byte())
            return process.Found(models, len(job.pairs))

        monkeypatch.setattr(capture, "run_worker", run)
        monkeypatch.setattr(process, "is_installed", lambda: True)
        return jobs

    return make


# ------------------------------------------------------------------------------------ what is found


@pytest.mark.parametrize(
    ("files", "options", "found", "masks"),
    [
        (["a10.png", "a9.jpg", "text.txt", "._a9.jpg"], {}, ["a9.jpg", "a10.png"], None),
        (["images/b.png", "images/a.png", "images_2/a.png"], {}, ["a.png", "b.png"], None),
        (["images/b.png", "images_2/a.png"], {"images": "images_2"}, ["a.png"], None),
        (
            ["left/a.png", "right/a.png", ".thumbs/a.png", "masks/left/a.png"],
            {},
            ["left/a.png", "right/a.png"],
            "masks",
        ),
        (["a.png", "b.png", "masks/a.png.png"], {}, ["a.png", "b.png"], "masks"),
        (["a.png", "b.png", "masks/a.png.png"], {"masks": "none"}, ["a.png", "b.png"], None),
        (["images/a.png", "images/b.png", "masks/b.png"], {}, ["a.png", "b.png"], "masks"),
        (["a.png", "b.png", "masks/c.png"], {}, ["a.png", "b.png"], None),
        (["a.png", "a.mask.png"], {}, ["a.png"], None),
        (["mask_1.png", "mask_2.png"], {}, ["mask_1.png", "mask_2.png"], None),
    ],
)
def test_folders_of_photographs(tmp_path, files, options, found, masks):
    for name in files:
        picture(tmp_path / name) if Path(name).suffix != ".txt" else (tmp_path / name).write_text("")
    photographs = find_photographs(tmp_path, **options)
    assert list(photographs.names) == found
    assert photographs.masks == (masks and tmp_path / masks)
    assert all((photographs.folder / name).is_file() for name in found)


def test_captures_and_empty_folders_are_no_photographs(tmp_path, capture):
    assert find_photographs(tmp_path) is None and find_photographs(tmp_path / "none") is None
    assert find_photographs(capture) is None
    photographs(tmp_path / "elsewhere" / "images")
    shutil.copytree(capture / "sparse", tmp_path / "elsewhere" / "distorted" / "sparse")
    assert find_photographs(tmp_path / "elsewhere") is None  # an error of loaders says where the cameras are


def test_a_film_in_a_folder_is_named(tmp_path, capsys):
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "walk.MP4").write_bytes(b"")
    for command in (["inspect"], ["train", "--out", tmp_path / "out"]):
        assert commands.command(command[0], tmp_path / "photos", *command[1:]) == 2
        said = f"photos: expected photographs, got a film: give the file itself, {tmp_path / 'photos' / 'walk.MP4'}"
        assert said in capsys.readouterr().err


def test_exif_says_camera_and_position(tmp_path):
    for name, size, exif in (
        ("a.jpg", SIZE, exif_of(4.25, -47, 8)),
        ("b.jpg", SIZE, exif_of(4.25)),
        ("c.jpg", SIZE, exif_of(50.0)),
        ("d.jpg", SIZE[::-1], exif_of(4.25)),
        ("e.jpg", SIZE, exif_of()),
    ):
        picture(tmp_path / name, size=size, exif=exif)
    shots = find_photographs(tmp_path).shots()
    groups = [[shot.name for shot in group] for _, group in groups_of(shots)]
    assert groups == [["a.jpg", "b.jpg"], ["c.jpg"], ["d.jpg"], ["e.jpg"]]
    assert shots[0].position == pytest.approx((-47.5, 8.01, 250.0)) and shots[1].position is None


def test_broken_photographs_are_counted_before_anything_is_done(tmp_path, capsys, pretend):
    jobs = pretend()
    photographs(tmp_path / "photographs")
    (tmp_path / "photographs" / "p_3.png").write_bytes(b"no picture")
    said = refused(capsys, commands.train, tmp_path / "photographs", tmp_path / "out")
    assert "1 of 12 photographs cannot be read, the first is" in said and "p_3.png" in said
    assert not jobs and not (tmp_path / "out").exists()


# ---------------------------------------------------------------------------------- what is compared


def test_few_photographs_are_compared_with_each_other():
    names = [f"{i}.jpg" for i in range(MOST_EXHAUSTIVE)]
    pairs = pairs_of(names, [None] * len(names))
    assert len(pairs) == len(set(map(frozenset, pairs))) == MOST_EXHAUSTIVE * (MOST_EXHAUSTIVE - 1) // 2


def test_many_are_compared_with_neighbours_by_name_and_position():
    """Two walks along one path, the second one back: names do not say that its photographs are at the same places."""
    count = 400
    names = [f"{i}.jpg" for i in range(count)]
    along = [min(i, count - 1 - i) for i in range(count)]
    known = [(47.0, 8.0 + 1e-4 * metres, 0.0) for metres in along]
    by_name, by_both = (set(pairs_of(names, places)) for places in ([None] * count, known))
    assert by_name < by_both
    assert all((f"{i}.jpg", f"{i + step}.jpg") in by_name for i in range(count - NEXT) for step in range(1, NEXT + 1))
    back = {(f"{i}.jpg", f"{count - 1 - i}.jpg") for i in range(count // 2 - NEXT)}
    assert back <= by_both and not back <= by_name
    assert len(by_both) < count * (NEXT + NEAREST + 16) and all(first != second for first, second in by_both)


def test_names_are_in_the_order_of_their_numbers():
    """A digit that is no number, as in a², is a letter."""
    assert in_order(["b2", "a10", "a9", "a²", "10", "9"]) == ["9", "10", "a9", "a10", "a²", "b2"]


def test_inspect_says_what_train_would_do(tmp_path, capsys, pretend):
    pretend()
    folder = photographs(tmp_path / "photographs")
    for k in range(25):
        picture(folder / f"q_{k}.png", size=(64, 48))
    picture(folder / "masks" / "p_0.png", 0)
    assert commands.command("inspect", folder, "--threads 2") == 0
    said = capsys.readouterr().out
    for part in (
        "37 photographs without cameras, 25 of 64 x 48 px, 12 of 32 x 24 px",
        "cameras, one for each size and focal length: 2 (SIMPLE_RADIAL: 12, OPENCV: 25)",
        "masks: 1",
        "matching: each with each, 666 pairs",
        "COLMAP takes about ",
        "on 2 threads",
    ):
        assert part in said
    assert commands.command("inspect", folder, "--json -") == 0
    assert json.loads(capsys.readouterr().out)["pairs"] == 666
    assert "--scales is for scenes" in refused(capsys, commands.command, "inspect", folder, "--scales 2")


# ------------------------------------------------------------------------------ what becomes of them

TRAINING = "--iterations 3 --sh-degree 0 --effects none --no-evaluate"


def train(folder, out, *more):
    return commands.train(folder, out, TRAINING, *more)


def failure(capsys, *given) -> str:
    """The last line of a training that fails after COLMAP has begun, which is the error."""
    capsys.readouterr()
    assert train(*given) == 2
    last = capsys.readouterr().err.splitlines()[-1]
    assert last.startswith("error: ")
    return last


def test_a_capture_is_made_once(tmp_path, capsys, pretend):
    """A second training, --resume and evaluate take it up, also where the photographs have moved."""
    jobs = pretend(left=2)
    folder, out = photographs(tmp_path / "photographs"), tmp_path / "out"
    picture(folder / "masks" / "p_0.png", 255)
    assert train(folder, out) == 0
    said = capsys.readouterr().err
    assert "COLMAP found the cameras of 10 of 12 photographs" in said
    assert "2 photographs have no camera and are left out: p_8.png, p_9.png" in said
    (job,) = jobs
    assert job.masks is not None and len(job.pairs) == 66
    assert not (out / "capture" / "colmap").exists()
    found = loading.load_capture(out / "capture")
    assert len(found.train) + len(found.test) == 10 and sum(item.mask is not None for item in found.train) <= 1
    assert json.loads((out / "options.json").read_text())["source"]["scene"] == str(out / "capture")
    assert commands.train(folder, out, "--resume --no-evaluate") == 0
    moved = folder.rename(tmp_path / "moved")
    (out / "checkpoint.pt").unlink()
    assert train(moved, out) == 0
    assert "cameras are those that COLMAP found before" in capsys.readouterr().err
    assert commands.evaluate(out) == 0
    assert len(jobs) == 1


def test_other_photographs_are_refused(tmp_path, capsys, pretend):
    jobs = pretend()
    folder, out = photographs(tmp_path / "photographs"), tmp_path / "out"
    assert train(folder, out) == 0
    (out / "checkpoint.pt").unlink()
    picture(folder / "p_12.png")
    said = failure(capsys, folder, out)
    assert "got cameras of 12 others" in said and "choose another --out" in said
    (tmp_path / "foreign" / "capture").mkdir(parents=True)
    (tmp_path / "foreign" / "capture" / "mine.txt").write_text("")
    assert "expected a capture that train made" in failure(capsys, folder, tmp_path / "foreign")
    assert len(jobs) == 1 and (tmp_path / "foreign" / "capture" / "mine.txt").exists()


def test_what_was_begun_is_gone_on_with_and_other_photographs_begin_anew(tmp_path, capsys, pretend):
    folder, out = photographs(tmp_path / "photographs"), tmp_path / "out"
    pretend(broken=True)
    assert "signal 11" in failure(capsys, folder, out)
    begun = out / "capture" / "colmap" / "begun"
    begun.write_text("")
    assert "signal 11" in failure(capsys, folder, out)
    assert begun.exists()
    picture(folder / "p_12.png")
    assert "signal 11" in failure(capsys, folder, out)
    assert not begun.exists()
    pretend()
    assert train(folder, out) == 0


def test_few_cameras_are_an_error_unless_they_are_enough(tmp_path, capsys, pretend):
    jobs = pretend(left=8, others=[["p_8.png", "p_9.png", "p_7.png"]])
    folder, out = photographs(tmp_path / "photographs"), tmp_path / "out"
    said = failure(capsys, folder, out)
    for part in (
        "found the cameras of 4 of 12 photographs",
        "could not join 2 models: the largest is used, the others have 3",
        "8 photographs have no camera and are left out: p_2.png, p_3.png, p_4.png, p_5.png, p_6.png, ..",
        "--missing skip trains with these",
    ):
        assert part in said
    assert not (out / "scene.ply").exists()
    assert train(folder, out, "--missing skip") == 0
    assert len(jobs) == 1


def test_photographs_without_anything_in_common_leave_nothing(tmp_path, capsys, pretend):
    pretend(left=12)
    folder, out = photographs(tmp_path / "photographs"), tmp_path / "out"
    assert "COLMAP placed none of 12 photographs" in failure(capsys, folder, out)
    assert not (out / "capture").exists() and len(list(folder.iterdir())) == 12


@pytest.mark.parametrize(
    ("names", "out", "said"),
    [
        (["a.png", "b.png"], "out", "expected at least 3 photographs, got 2"),
        ([], "photographs", "--out must be another folder than the capture and those of its pictures"),
        (["images/a.png", "images/b.png", "images/c.png"], "photographs/images", "--out must be another folder"),
    ],
)
def test_mistakes_are_said_before_anything_is_touched(tmp_path, capsys, pretend, names, out, said):
    jobs = pretend()
    folder = photographs(tmp_path / "photographs", *names)
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")}
    assert said in refused(capsys, train, folder, tmp_path / out)
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")} == before and not jobs


def test_without_pycolmap_one_sentence_says_what_to_install(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(process, "find_spec", lambda name: None)
    folder = photographs(tmp_path / "photographs")
    said = refused(capsys, train, folder, tmp_path / "out")
    assert 'need pycolmap: pip install "analytic_rasterizer[colmap]", or find the cameras with COLMAP\'s' in said
    assert not (tmp_path / "out").exists()
    assert commands.command("inspect", folder) == 0
    assert 'pip install "analytic_rasterizer[colmap]"' in capsys.readouterr().out


def test_readers_of_captures_name_who_finds_cameras(tmp_path):
    with pytest.raises(io.SceneError, match="got 12 pictures without cameras; train SCENE --out DIR finds the cameras"):
        loading.load_capture(photographs(tmp_path / "photographs"))


# ------------------------------------------------------------------------------------- the process


@pytest.mark.parametrize(
    ("program", "said"),
    [
        ("import os, sys; sys.stdin.readline(); os.abort()", r"\(features\): it ended with signal 6"),
        ("raise SystemExit(3)", r"\(features\): it ended with code 3"),
        ('print(\'{"stage": "pairs", "done": 1, "of": 2}\'); print(\'{"error": "no"}\')', r"\(pairs comp.*: no;"),
    ],
)
def test_a_crash_is_a_message(tmp_path, monkeypatch, program, said):
    monkeypatch.setattr(process, "WORKER", tmp_path / "worker.py")
    (tmp_path / "worker.py").write_text(program)
    job = process.Job(str(tmp_path / "database.db"), "", "", [], {}, [], None, 1, 1, 1)
    with pytest.raises(RuntimeError, match=said):
        process.run_worker(job, "photographs")


def test_the_process_has_the_threads_that_are_asked_for(tmp_path, monkeypatch, capsys):
    """And its progress is shown in lines, of each stage the last one."""
    monkeypatch.setattr(process, "WORKER", tmp_path / "worker.py")
    (tmp_path / "worker.py").write_text(
        "import json, os, sys\n"
        "job = json.loads(sys.stdin.readline())\n"
        "for k in range(5): print(json.dumps({'stage': 'placed', 'done': k, 'of': 4}))\n"
        "print(json.dumps({'models': [[os.environ['OMP_NUM_THREADS'], str(job['threads'])]], 'matched': 7}))\n"
    )
    job = process.Job(str(tmp_path / "database.db"), "", "", [], {}, [], None, 3, 1, 1)
    assert process.run_worker(job, "photographs") == ([["3", "3"]], 7)
    assert capsys.readouterr().err == "photographs: photographs placed: 4 of 4 (100%)\n"


def test_the_worker_imports_nothing_of_the_package():
    """Pillow and torch in one process with pycolmap crash."""
    imported = {
        line.split()[1] for line in process.WORKER.read_text().splitlines() if line.startswith(("import", "from"))
    }
    assert imported - set(sys.stdlib_module_names) == {"pycolmap"}


# ----------------------------------------------------------------------------------------- films


def test_a_blurred_picture_is_less_sharp():
    sharp = np.random.default_rng(0).integers(0, 255, (20, 30, 3), dtype=np.uint8)
    blurred = ((sharp[:, :-1].astype(int) + sharp[:, 1:]) // 2).astype(np.uint8)
    assert sharpness(blurred) < sharpness(sharp)
