"""benchmarks/paper_tables.py: the paper's numbers, the protocols, and that a table is trained, tested,
resumed and written.
"""

import json
import shutil
import signal
import sys
from dataclasses import replace

import pytest
import torch
from capture_files import circle, write_colmap, write_nerf_synthetic, write_pictures
from commands import refused, words_of
from places import ROOT
from processes import run_python
from runs import around_steps
from train_extra import image

from analytic_rasterizer import io, training
from analytic_rasterizer.captures import loading
from analytic_rasterizer.training import TrainingOptions, evaluate, files

sys.path.append(str(ROOT / "benchmarks"))
import paper_tables
from paper import PUBLISHED, ROWS, TABLES, Number, Results, as_dict, markdown, run_table, text
from paper.published import AVERAGE, FOUR_SCALES, parse

# ------------------------------------------------------------------------------- the paper's numbers


def printed_rows():
    """(table, measure, method, scale, numbers by scene) of everything that is printed."""
    for table, published in PUBLISHED.items():
        for measure, methods in published.numbers.items():
            for method, scales in methods.items():
                for scale, numbers in scales.items():
                    yield table, measure, method, scale, numbers


def is_doubtful(numbers) -> bool:
    return any(number.doubtful for number in numbers)


def unit(measure: str) -> float:
    """Of the last digit that is printed."""
    return 0.01 if measure == "psnr" else 0.001


def test_printed_means_are_those_of_their_rows_or_marked():
    """Within half a unit for the rounding of the scenes and half of one for that of the mean."""
    checked, marked = 0, []
    for table, measure, method, scale, numbers in printed_rows():
        if AVERAGE not in numbers:
            continue
        scenes = [number.value for scene, number in numbers.items() if scene != AVERAGE]
        checked += 1
        if abs(sum(scenes) / len(scenes) - numbers[AVERAGE].value) > 1.001 * unit(measure):
            assert is_doubtful(numbers.values()), (table, measure, method, scale)
            marked.append((table, measure, method, scale))
    assert checked == 3 * (12 + 12 + 4 + 4)  # Tab. 2, 4, 3, 6
    # As the notes say, which quote the means.
    assert marked == [
        ("360-stst", "psnr", "3DGS*", "mean"),
        ("360-stst", "lpips", "Mip-NeRF 360", "mean"),
        ("blender-mtmt", "ssim", "Ours", "4"),
        ("blender-mtmt", "lpips", "NeRF w/o Larea", "mean"),
        ("blender-mtmt", "lpips", "NeRF", "mean"),
        ("blender-mtmt", "lpips", "MipNeRF", "mean"),
    ]


def test_single_scales_of_blender_have_the_means_of_the_other_table():
    """So Tab. 3, whose caption names another experiment, shows the row Ours of Tab. 4, but for the marked numbers."""
    differing = []
    for measure, methods in PUBLISHED["blender-mtmt"].numbers.items():
        ours = methods["Ours"]
        for scene, printed in ours["mean"].items():
            numbers = [ours[scale][scene] for scale in FOUR_SCALES]
            if abs(sum(number.value for number in numbers) / 4 - printed.value) > 1.001 * unit(measure):
                assert is_doubtful(numbers), (measure, scene)
                differing.append((measure, scene))
    assert differing == [("ssim", "drums"), ("ssim", "ficus"), ("ssim", "hotdog")]


def test_printed_numbers_are_in_range_and_doubt_has_a_note():
    ranges = {"psnr": (15, 45), "ssim": (0.4, 1), "lpips": (0, 0.6)}
    doubtful = set()
    for table, measure, method, scale, numbers in printed_rows():
        scenes = set(numbers) - {AVERAGE}
        assert scenes <= set(TABLES[table].data.scenes), (table, method)
        low, high = ranges[measure]
        assert all(low < n.value < high for n in numbers.values() if n.value is not None), (table, method, scale)
        if is_doubtful(numbers.values()):
            doubtful.add(table)
    assert doubtful == {table for table, published in PUBLISHED.items() if published.notes}


def test_rows_of_the_paper_that_ours_repeat_exist():
    for name, published in PUBLISHED.items():
        methods = {method for of_measure in published.numbers.values() for method in of_measure}
        repeated = {row.published for row in TABLES[name].rows}
        assert {"3DGS", "Mip-Splatting", "Ours"} <= methods & repeated
        stars = {method for method in methods if method.endswith("*")}
        assert stars <= repeated and len(stars) == (4 if name == "360-stst" else 0)


def test_a_row_with_too_few_numbers_is_refused():
    assert parse("SSIM a b\nX | 0.1 0.2?\nY? @4 | - 0.3") == {
        "ssim": {
            "X": {"mean": {"a": Number(0.1), "b": Number(0.2, True)}},
            "Y": {"4": {"a": Number(None), "b": Number(0.3, True)}},
        }
    }
    with pytest.raises(ValueError, match=r"X \| 1 2 3: expected 2 or 8 numbers, got 3"):
        parse("SSIM a b\nX | 1 2 3")


# --------------------------------------------------------------------------------------- protocols


def test_protocols_are_those_of_the_paper():
    blender, single, multi, larger = (
        TABLES[name] for name in ("blender-mtmt", "360-stst", "360-mtmt", "360-super-resolution")
    )
    plain, starred = ROWS[3], next(row for row in single.rows if row.published == "Ours*")
    assert plain.published == "Ours" and plain.options == starred.options == {"footprint": "analytic"}
    options = TrainingOptions(**blender.training_options(plain, "lego"))
    assert (options.scales, options.scale_repeats, options.downsampling) == ((1, 2, 4, 8), (2, 1, 1, 1), "blender")
    assert options == TrainingOptions(**(multi.training_options(plain, "room") | {"downsampling": "blender"}))
    assert multi.training_options(plain, "room")["downsampling"] == "bicubic"
    assert multi.training == larger.training and TABLES["blender-stst"].training == TABLES["blender-stmt"].training

    def pictures(table, row, scene):
        """Trained on, at which scales, tested on, at which scales."""
        scales = table.training_options(row, scene)["scales"]
        return table.images(row, scene), scales, table.test_images(row, scene), table.test_scales(row, scene)

    assert pictures(single, plain, "bicycle") == ("images_4", (1,), "images_4", (1,))
    assert pictures(single, plain, "bonsai") == ("images_2", (1,), "images_2", (1,))
    assert pictures(single, starred, "bicycle") == ("images", (4,), "images", (4,))
    assert pictures(single, starred, "bonsai") == ("images", (2,), "images", (2,))
    assert pictures(multi, plain, "bicycle") == ("images_4", (1, 2, 4, 8), "images_4", (1, 2, 4, 8))
    assert pictures(larger, plain, "bicycle") == ("images_4", (1, 2, 4, 8), "images_2", (1,))
    assert pictures(larger, plain, "bonsai") == ("images_2", (1, 2, 4, 8), "images", (1,))
    assert TABLES["blender-stmt"].test_scales(plain, "lego") == (1, 2, 4, 8)
    for table in TABLES.values():
        for row in table.rows:
            TrainingOptions(**table.training_options(row, next(iter(table.data.scenes))))  # raises for a bad one


# ----------------------------------------------------------------------------------------- trainings

TINY = {"iterations": 3, "random_points": 50, "sh_degree": 0}


@pytest.fixture(scope="module")
def blender(tmp_path_factory):
    """Two scenes, at two of the places where a data folder may have them."""
    folder = tmp_path_factory.mktemp("blender")
    write_nerf_synthetic(folder / "lego", circle(4), circle(2))
    write_nerf_synthetic(folder / "nerf_synthetic" / "chair", circle(5), circle(3))
    return folder


@pytest.fixture(scope="module")
def photographs(tmp_path_factory):
    """Bonsai with photographs and their halves, as the data set comes, and flowers with the wrong folder."""
    folder = tmp_path_factory.mktemp("360") / "360_v2"
    views = circle(9, (48, 32))
    points, colors = training.random_points(50, seed=5)
    for scene, halves in (("bonsai", "images_2"), ("flowers", "images_8")):
        write_pictures(folder / scene / "images", views, opaque=True)
        (folder / scene / halves).mkdir()
        for view in views:
            whole = image.open(folder / scene / "images" / f"{view.name}.png")
            whole.resize((24, 16), image.Resampling.NEAREST).save(folder / scene / halves / f"{view.name}.png")
        write_colmap(folder / scene / "sparse" / "0", views, points, (255 * colors).to(torch.uint8))
    return folder.parent


def run(name, data, out, **options) -> Results:
    return run_table(TABLES[name], data, out, **{"say": lambda line: None, **TINY, **options})


def test_a_table_is_trained_tested_and_written(blender, tmp_path):
    said = []
    rows = ["analytic", "3dgs-ss", "moment"]
    results = run_table(TABLES["blender-mtmt"], blender, tmp_path, rows=rows, say=said.append, **TINY)
    names = [f"{row}, {scene}" for row in ("3dgs-ss", "analytic", "moment") for scene in ("chair", "lego")]
    assert [line for line in said if line.startswith("[")] == [f"[{k}/6] {name}" for k, name in enumerate(names, 1)]
    assert "skipped: drums is not there (nor in multiscale, nerf_synthetic)" in said
    # The test is `evaluate` on the pictures of the scene, with the options of the row.
    for row, options in (("3dgs-ss", {"footprint": "point", "supersampling": 2}), ("moment", {"footprint": "moment"})):
        scene = io.load_scene(tmp_path / "blender-multi" / row / "lego" / files.SCENE)
        test = training.load_capture(blender / "lego").test
        test = training.load_pictures(test, (1, 2, 4, 8), loading.WHITE, "cpu", "blender")
        expected = evaluate(scene, test, **options)
        for scale in ("1", "2", "4", "8", "mean"):
            measured = results.tests[row]["lego"]["test"][scale]
            assert measured == {key: pytest.approx(expected[scale][key]) for key in ("psnr", "ssim")}
    measured = results.tests["analytic"]["chair"]
    assert (measured["steps"], measured["gaussians"], measured["views"], measured["size"]) == (3, 50, 3, [32, 32])
    written = json.loads((tmp_path / "blender-mtmt.json").read_text())
    assert written == json.loads(json.dumps(as_dict(results))) and written["results"]["analytic"]["chair"] == measured
    assert written["published"]["numbers"]["psnr"]["Ours"]["8"]["lego"] == {"value": 34.93, "doubtful": False}
    assert (tmp_path / "blender-mtmt.md").read_text() == markdown(results)
    assert not list(tmp_path.rglob(files.CHECKPOINT))


def block(printed: str, heading: str) -> dict[str, list[str]]:
    """The rows under a heading, by their names."""
    lines = printed.split(f"{heading}\n")[1].split("\n\n")[0].splitlines()
    widths = [line.rsplit(maxsplit=len(lines[0].split())) for line in lines[1:]]
    return {name.strip(): cells for name, *cells in widths} | {"": lines[0].split()}


def test_our_rows_stand_above_the_papers(blender, tmp_path):
    results = run("blender-mtmt", blender, tmp_path, rows=["analytic", "moment"])
    printed = text(results)
    rows = block(printed, "PSNR [dB], mean over scales")
    assert list(rows)[:4] == ["analytic", "paper: Ours", "moment", "paper: NeRF w/o Larea"] and len(rows) == 2 + 12 + 1
    assert rows[""] == ["chair", "lego", "mean"]
    # Means are over the scenes that are there, the paper's too.
    assert rows["paper: Ours"] == ["38.26", "35.75", f"{(38.26 + 35.75) / 2:.2f}"]
    ours = [results.tests["analytic"][scene]["test"]["mean"]["psnr"] for scene in ("chair", "lego")]
    assert rows["analytic"] == [f"{value:.2f}" for value in (*ours, sum(ours) / 2)]
    assert list(block(printed, "PSNR [dB], scale 1/8")) == ["analytic", "paper: Ours", "moment", ""]
    for remark in (
        "Departs from the protocol: iterations = 3, random_points = 50, sh_degree = 0.",
        "Means, the paper's too, are over 2 of 8 scenes.",
        "Views that were tested: chair 3 of 32x32 px, lego 2 of 32x32 px.",
        "The paper tests 200 of 800x800 px of every scene.",
        "LPIPS is left out.",
        "Skipped: ship is not there (nor in multiscale, nerf_synthetic).",
        "The caption of Tab. 3 describes super-resolution",
    ):
        assert remark in printed and remark in markdown(results)
    assert "| paper: Ours | 38.26 | 35.75 |" in markdown(results)


def test_what_is_complete_is_not_trained_again(blender, tmp_path, monkeypatch):
    first = run("blender-stst", blender, tmp_path, rows=["box"])
    before = (tmp_path / "blender-stst.md").read_text()
    monkeypatch.setattr(training.Trainer, "step", lambda trainer: pytest.fail("trains"))
    again = run("blender-stst", blender, tmp_path, rows=["box"])
    assert again.tests == first.tests and (tmp_path / "blender-stst.md").read_text() == before
    # Another table on the same trainings tests them, and more scales of them.
    other = run("blender-stmt", blender, tmp_path, rows=["box"])
    of_scales = other.tests["box"]["lego"]["test"]
    assert of_scales.keys() == {"1", "2", "4", "8", "mean"}
    assert of_scales["1"] == first.tests["box"]["lego"]["test"]["1"]
    assert "The paper's supplement has no such table." in text(other) and "paper: " not in text(other)


def test_an_interrupted_table_goes_on_with_the_same_bits(blender, tmp_path, monkeypatch):
    run("blender-stst", blender, tmp_path / "whole", rows=["box"], iterations=6)
    steps = []

    def interrupted(trainer):
        steps.append(trainer.progress.step)
        if len(steps) == 9:  # in the second scene
            signal.raise_signal(signal.SIGINT)

    around_steps(monkeypatch, interrupted)
    said = []
    with pytest.raises(KeyboardInterrupt):
        run("blender-stst", blender, tmp_path / "part", rows=["box"], iterations=6, say=said.append)
    assert said[-1] == "stopped and saved: the same call goes on with box, lego"
    assert "chair" in (tmp_path / "part" / "blender-stst.md").read_text()
    assert steps[6:] == [0, 1, 2]
    run("blender-stst", blender, tmp_path / "part", rows=["box"], iterations=6)
    assert steps[9:] == [3, 4, 5]
    for scene in ("chair", "lego"):
        whole, part = (tmp_path / name / "blender-single" / "box" / scene / files.SCENE for name in ("whole", "part"))
        assert whole.read_bytes() == part.read_bytes()


def test_a_table_that_ended_after_the_last_step_is_finished(blender, tmp_path, monkeypatch):
    """Between the checkpoint of the last step and what says that all is complete."""
    fails = pytest.MonkeyPatch()
    fails.setattr(training.Run, "summary", lambda run: pytest.fail("killed"))
    with pytest.raises(pytest.fail.Exception, match="killed"):
        run("blender-stst", blender, tmp_path, rows=["box"], scenes=["lego"])
    fails.undo()
    monkeypatch.setattr(training.Trainer, "step", lambda trainer: pytest.fail("trains"))
    results = run("blender-stst", blender, tmp_path, rows=["box"], scenes=["lego"])
    assert results.tests["box"]["lego"]["steps"] == 3


def test_lpips_is_measured_where_it_was_not(blender, tmp_path):
    """Without another training; and not again where it was."""
    calls = []

    def lpips(picture, truth):
        calls.append(truth.shape)
        return (picture - truth).abs().mean()

    first = run("blender-stst", blender, tmp_path, rows=["box"], scenes=["lego"])
    with_lpips = run("blender-stst", blender, tmp_path, rows=["box"], scenes=["lego"], lpips=lpips)
    assert first.measures == ["psnr", "ssim"] and with_lpips.measures == ["psnr", "ssim", "lpips"]
    assert calls == [(3, 32, 32)] * 2
    assert "LPIPS is left out" not in text(with_lpips) and "\nLPIPS\n" in text(with_lpips)
    run("blender-stst", blender, tmp_path, rows=["box"], scenes=["lego"], lpips=lpips)
    assert len(calls) == 2


def test_mip_nerf_360_takes_the_folders_of_the_paper(photographs, tmp_path):
    """What is trained and tested is measured on the pictures of the right folder, at the right size."""
    rows = ["analytic", "analytic-bicubic"]
    single = run("360-stst", photographs, tmp_path, rows=rows)
    multi = run("360-mtmt", photographs, tmp_path, rows=["analytic"])
    larger = run("360-super-resolution", photographs, tmp_path, rows=["analytic"])
    for results, row, folder, images, scales, downsampling, size in (
        (single, "analytic", "360-single", "images_2", (1,), "box", [24, 16]),
        (single, "analytic-bicubic", "360-single", "images", (2,), "bicubic", [24, 16]),
        (multi, "analytic", "360-multi", "images_2", (1, 2, 4, 8), "bicubic", [24, 16]),
        (larger, "analytic", "360-multi", "images", (1,), "box", [48, 32]),
    ):
        place = photographs / "360_v2" / "bonsai"
        test = training.load_capture(place, images).test
        assert len(test) == 2
        pictures = training.load_pictures(test, scales, loading.BLACK, "cpu", downsampling)
        scene = io.load_scene(tmp_path / folder / row / "bonsai" / files.SCENE)
        measured = results.tests[row]["bonsai"]
        assert measured["test"]["mean"]["psnr"] == pytest.approx(evaluate(scene, pictures, "analytic")["mean"]["psnr"])
        assert measured["size"] == size
    described = json.loads((tmp_path / "360-single" / "analytic-bicubic" / "bonsai" / files.OPTIONS).read_text())
    assert described["source"]["images"] == "images" and described["options"]["downsampling"] == "bicubic"
    assert "flowers has no folder images_4" in single.skipped and "stump is not there" in single.skipped[3]
    # The starred row of flowers needs no reduced pictures.
    assert set(single.tests["analytic"]) == {"bonsai"}
    assert set(single.tests["analytic-bicubic"]) == {"bonsai", "flowers"}
    rows = block(text(single), "SSIM")
    assert rows[""] == ["flowers", "bonsai", "mean"] and rows["analytic"][0] == rows["analytic"][2] == "-"
    assert rows["paper: Ours*"][1] == "0.943?" and rows["paper: Ours"][1] == "0.943"


def test_means_of_the_paper_are_the_printed_ones_where_all_scenes_are(blender, tmp_path):
    measured = run("blender-stst", blender, tmp_path, rows=["box"], scenes=["lego"]).tests["box"]["lego"]
    table, scenes = TABLES["360-stst"], TABLES["360-stst"].data.scenes
    results = Results(table, "a machine", "quick", {}, [], {"3dgs-bicubic": dict.fromkeys(scenes, measured)})
    assert block(text(results), "PSNR [dB]")["paper: 3DGS*"][-1] == "27.76?"  # printed, and not that of its scenes
    assert "Departs from the protocol: preset quick." in text(results) and "The paper tests" not in text(results)
    del results.tests["3dgs-bicubic"]["bicycle"]
    assert block(text(results), "PSNR [dB]")["paper: 3DGS*"][-1] == f"{(9 * 27.70444 - 25.63) / 8:.2f}"
    # Where only scales are printed, means over scales are means of those, and unknown where one is.
    table = replace_scenes(TABLES["360-mtmt"], ("room", "bonsai"))
    test = {"test": {scale: measured["test"]["mean"] for scale in (*FOUR_SCALES, "mean")}}
    tests = {"box": {scene: measured | test for scene in ("room", "bonsai")}}
    results = Results(table, "a machine", "3dgs", {}, [], tests)
    rows = block(text(results), "PSNR [dB], mean over scales")
    room, bonsai = (31.26 + 32.23 + 32.92 + 33.07) / 4, (32.12 + 32.92 + 33.60 + 33.39) / 4
    assert rows["paper: Ours"] == [f"{value:.2f}" for value in (room, bonsai, (room + bonsai) / 2)]
    assert rows["paper: 3DGS-SS"][1].endswith("?") and rows["paper: 3DGS-SS"][2].endswith("?")
    assert block(text(results), "SSIM, mean over scales")["paper: Mip-NeRF 360"][0] == "-"


def replace_scenes(table, scenes):
    return table._replace(data=table.data._replace(scenes={scene: table.data.scenes[scene] for scene in scenes}))


# -------------------------------------------------------------------------------------------- errors


def test_results_of_other_options_or_pictures_are_left_alone(blender, tmp_path, tmp_path_factory):
    run("blender-stst", blender, tmp_path, rows=["box"], scenes=["lego"])
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    with pytest.raises(ValueError, match=r"box/lego was trained with other iterations, seed; choose another --out"):
        run("blender-stst", blender, tmp_path, rows=["box"], iterations=4, seed=1)
    elsewhere = tmp_path_factory.mktemp("elsewhere")
    shutil.copytree(blender / "lego", elsewhere / "lego")
    with pytest.raises(ValueError, match=r"box/lego was trained on .*blender.*/lego; choose another --out"):
        run("blender-stst", elsewhere, tmp_path, rows=["box"])
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


def test_a_folder_of_something_else_is_named(blender, tmp_path):
    folder = tmp_path / TABLES["blender-stst"].training / "box" / "lego"
    folder.mkdir(parents=True)
    for described in ({}, [], {"source": "lego"}, {"source": {"scene": "lego", "images": None}, "options": {"a": 1}}):
        (folder / "options.json").write_text(json.dumps(described))
        with pytest.raises(io.SceneError, match=r"lego.options\.json: not what `train` writes"):
            run("blender-stst", blender, tmp_path, rows=["box"], scenes=["lego"])


def test_a_broken_scene_is_found_before_any_is_trained(blender, tmp_path):
    shutil.copytree(blender, tmp_path / "data")
    (tmp_path / "data" / "lego" / "train" / "r_1.png").unlink()
    with pytest.raises(io.SceneError, match="1 of 6 pictures are missing"):
        run("blender-stst", tmp_path / "data", tmp_path / "out")
    (tmp_path / "data" / "lego" / "transforms_test.json").unlink()
    shutil.copy(blender / "lego" / "train" / "r_1.png", tmp_path / "data" / "lego" / "train")
    with pytest.raises(io.SceneError, match="lego: there are no test pictures"):
        run("blender-stst", tmp_path / "data", tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "arguments, message",
    [
        ("blender-stst", "blender-stst needs --data FOLDER and --out DIR"),
        ("blender", "argument NAME: invalid choice: 'blender'"),
        ("blender-stst --scenes room", "scenes must be among chair, drums,"),
        ("blender-stst --rows ours", "rows must be among 3dgs, 3dgs-ss,"),
        ("blender-stst --scenes ship", "nothing of blender-stst is there: ship is not there"),
        ("blender-stst --iterations 0", "must be a positive whole number, got 0"),
    ],
)
def test_errors_are_one_line(blender, tmp_path, capsys, arguments, message):
    folders = ["--data", blender, "--out", tmp_path / "out", "--no-lpips"] if " " in arguments else []
    assert message in refused(capsys, paper_tables.main, words_of(arguments, *folders))
    assert not (tmp_path / "out").exists()


def test_what_makes_a_row_cannot_be_changed(blender, tmp_path):
    with pytest.raises(ValueError, match="footprint is set by the rows of blender-stst and cannot be changed"):
        run("blender-stst", blender, tmp_path, footprint="box")


# ------------------------------------------------------------------------------------------- program


def test_the_program_lists_the_tables():
    printed = run_python(ROOT / "benchmarks" / "paper_tables.py")
    assert all(f"{name} (" in printed for name in TABLES)
    assert "360-super-resolution (paper, Tab. 6)" in printed and "tests at 2 times the full size" in printed
    assert "full size 1/2: room, counter, kitchen, bonsai" in printed and "blender-stmt (ours only)" in printed


def test_the_program_prints_the_table_and_measures_lpips_as_the_paper_did(blender, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    quick = "--scenes lego --rows box --iterations 1 --preset quick --seed 4 --device cpu"
    arguments = words_of("blender-stst --data", blender, "--out", tmp_path / "out", quick)
    assert paper_tables.main(arguments) == 0
    captured = capsys.readouterr()
    assert "LPIPS is left out: " in captured.err and "vgg16-397923af.pth" in captured.err
    assert "[1/1] box, lego" in captured.err
    assert "Departs from the protocol: preset quick, iterations = 1, seed = 4." in captured.out
    options = json.loads((tmp_path / "out" / "blender-single" / "box" / "lego" / files.OPTIONS).read_text())["options"]
    protocol = {"footprint": "box:samples=4", "downsampling": "blender", "effects": "none"}
    protocol |= {"pixels_per_gaussian": 0.0}
    quick = replace(TrainingOptions.preset("quick"), iterations=1, seed=4, **protocol)
    assert TrainingOptions.from_dict(options) == quick
    # With the network there, another call measures it, and trains nothing.
    asked = []

    def load_lpips(*arguments, **options):
        asked.append((arguments, options))
        return lambda picture, truth: (picture - truth).abs().mean()

    monkeypatch.setattr("paper_tables.load_lpips", load_lpips)
    monkeypatch.setattr(training.Trainer, "step", lambda trainer: pytest.fail("trains"))
    assert paper_tables.main(arguments) == 0
    assert asked == [(("vgg", "cpu"), {"like_3dgs": True})]
    assert "\nLPIPS\n" in capsys.readouterr().out
