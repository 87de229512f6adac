"""`report` and --plot: pages and pictures of a training, a test and a capture."""

import html.parser
import json
import re
import sys
from unittest import mock

import pytest
import torch
from capture_files import circle, truth_gaussians, write_colmap, write_nerf_synthetic, write_pictures
from commands import command, evaluate, refused, train
from train_extra import image

from analytic_rasterizer.analysis.plots import capture_plots, evaluation_plots, log_plots, save_plots, to_svg

pytest.importorskip("matplotlib", reason="needs the analysis extra")


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    folder, views, points = tmp_path_factory.mktemp("capture"), circle(9), truth_gaussians().means
    write_colmap(folder / "sparse" / "0", views, points, torch.zeros(len(points), 3, dtype=torch.int32))
    (folder / "images").mkdir()
    write_pictures(folder / "images", views, opaque=True)
    return folder


@pytest.fixture(scope="module")
def training(capture, tmp_path_factory):
    out = tmp_path_factory.mktemp("training") / "a&b"
    options = "--iterations 3 --effects none --scales 1,2 --sh-degree 0 --threads 1"
    assert train(capture, out, options) == 0
    return out


class Page(html.parser.HTMLParser):
    """Counts what a page holds, and finds whatever it would load."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.links, self.open = [], [], []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.links += [value for name, value in attrs if name in ("src", "href", "xlink:href")]
        if tag not in ("meta", "img"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def page_of(folder, *options) -> tuple[str, Page]:
    assert command("report", folder, *options) == 0
    text = (folder / "report.html").read_text()
    return text, Page(text)


def test_a_page_of_a_training(training, capsys):
    text, page = page_of(training)
    assert capsys.readouterr().out == f"{training / 'report.html'}\n"
    assert page.open == [] and page.tags.count("svg") >= 5
    assert all(link.startswith(("data:", "#")) for link in page.links)
    metrics = json.loads((training / "metrics.json").read_text())
    assert "<h1>a&amp;b</h1>" in text and f"{metrics['gaussians']:,} Gaussians after 3 steps" in text
    for scale in ("1", "2", "mean"):
        assert f"<td>{metrics['test'][scale]['psnr']:.2f}</td>" in text
    assert "<td>iterations</td><td>3</td>" in text and "<td>seed</td>" not in text
    assert "<td>blur</td>" in text
    assert "<td>blur</td>" not in page_of(training, "--no-capture")[0]


def test_pictures_of_evaluate_are_on_the_page(training):
    assert evaluate(training, "--pictures 1 --footprint moment box:samples=1 --device cpu") == 0
    text, page = page_of(training, "--no-capture")
    assert page.tags.count("img") == 4  # a view, two scales, two footprints
    assert "box:samples=1" in text


def test_a_capture_that_is_gone_is_said(training, tmp_path):
    options = json.loads((training / "options.json").read_text())
    options["source"]["scene"] = str(tmp_path / "gone")
    for name in ("log.jsonl", "metrics.json"):
        (tmp_path / name).write_bytes((training / name).read_bytes())
    (tmp_path / "options.json").write_text(json.dumps(options))
    assert "It cannot be looked at: " in page_of(tmp_path)[0]


@pytest.mark.parametrize("suffix", ["png", "svg", "pdf"])
def test_plots_alone(training, capture, tmp_path, suffix):
    for words in (
        ("report", training, "--out"),
        ("evaluate", training, "--lpips none --pictures 0 --device cpu --out", tmp_path, "--plot"),
        ("inspect", capture, "--plot"),
    ):
        path = tmp_path / f"{words[0]}.{suffix}"
        assert command(*words, path) == 0
        start = {"png": b"\x89PNG", "svg": b"<?xml", "pdf": b"%PDF"}[suffix]
        assert path.read_bytes().startswith(start)
    if suffix == "png":
        assert image.open(tmp_path / "report.png").width > image.open(tmp_path / "evaluate.png").width


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("report gone", "gone: no training, log.jsonl is missing; give the folder that `train` wrote"),
        ("report gone --out a.gif", "--out must end in .html, .png, .svg or .pdf, got a.gif"),
        ("evaluate gone --plot a.html", "--plot must end in .png, .svg or .pdf, got a.html"),
        ("inspect gone --plot a.html", "--plot must end in .png, .svg or .pdf, got a.html"),
    ],
)
def test_errors_are_one_line(tmp_path, monkeypatch, capsys, words, message):
    monkeypatch.chdir(tmp_path)
    assert message in refused(capsys, command, words)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("log.jsonl", "", "the training has not logged anything yet"),
        ("log.jsonl", '{"step": 1}\n', "line 1 is not what `train` writes"),
        ("log.jsonl", "[1]\n", "line 1 is not what `train` writes"),
        ("options.json", "{", "options.json: not what `train` writes"),
        ("options.json", "{}", "options.json: not what `train` writes"),
        ("metrics.json", "{", "metrics.json: not what `train` writes"),
    ],
)
def test_broken_files_are_named(training, tmp_path, capsys, name, content, message):
    for each in ("log.jsonl", "options.json", "metrics.json"):
        (tmp_path / each).write_bytes((training / each).read_bytes())
    (tmp_path / name).write_text(content)
    assert message in refused(capsys, command, "report", tmp_path)


def test_without_matplotlib_the_extra_is_named(training, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    assert 'pip install "analytic_rasterizer[analysis]"' in refused(capsys, command, "report", training)


ENTRY = {"step": 10, "seconds": 1.0, "loss": 0.5, "psnr": 20.0, "gaussians": 5}


def texts_of(plot):
    return re.findall(r"<text[^>]*>([^<]*)</text>", to_svg(plot))


def test_a_change_of_the_footprint_is_drawn_where_it_happens():
    history = [ENTRY | {"footprint": "box:samples=1"}, ENTRY | {"step": 20, "footprint": "moment:samples=4"}]
    plot, drawn = log_plots(history)[0], mock.MagicMock()
    assert "step (dotted: another footprint from there on)" in texts_of(plot)
    plot(drawn)
    assert [call.args for call in drawn.axvline.call_args_list] == [(10,)]
    assert "step" in texts_of(log_plots([ENTRY, ENTRY | {"step": 20}])[0])


def test_what_is_not_known_is_left_out(tmp_path):
    assert len(log_plots([ENTRY | {"psnr": None}])) == 2
    nothing, nan = {"psnr": None}, float("nan")
    assert len(evaluation_plots({"point": {"1": {"psnr": nan, "views": [nothing]}, "mean": {}}})) == 1
    assert capture_plots({"a": [nan] * 3}, [], {"a": 1.0}) == []
    with pytest.raises(ValueError, match="nothing to plot"):
        save_plots(tmp_path / "a.png", [])


def test_the_worst_views_are_the_worst():
    views = [{"psnr": float(value)} for value in range(20, 40)]
    names = [f"view_{'long' * 5}_{i}" for i in range(20)]
    (_, worst) = evaluation_plots({"point": {"4": {"psnr": 30.0, "views": views}, "mean": {}}}, names)
    shown = texts_of(worst)
    assert "worst of 20 test views, 1/4" in shown
    assert [text for text in shown if text.startswith("…")] == [f"…{names[i][-13:]}" for i in range(7, -1, -1)]


def test_a_capture_without_plots_says_so(tmp_path, capsys):
    write_nerf_synthetic(tmp_path, circle(3), circle(1))
    assert "there is nothing to plot" in refused(capsys, command, "inspect", tmp_path, "--plot", tmp_path / "a.png")
