"""Watching a training in the viewer."""

import functools
import re
import sys

import commands
import pytest
import runs
import torch
import train_extra  # noqa: F401
from capture_files import circle
from commands import refused

from analytic_rasterizer import io
from analytic_rasterizer.captures import loading
from analytic_rasterizer.training import files

make_run = functools.partial(runs.make_run, **runs.SHORT)


def watched(monkeypatch, *given) -> list[tuple]:
    """Runs the command with a viewer that wants every scene; returns what it was shown: (scene, step, text, force)."""
    pytest.importorskip("viser", reason="needs the view extra")
    from analytic_rasterizer.viewer import LiveViewer

    shown, update = [], LiveViewer.update

    def note(viewer, scene, *, step, text="", force=False):
        shown.append((scene(), step, text, force))
        return update(viewer, scene, step=step, text=text, force=force)

    monkeypatch.setattr(LiveViewer, "update", note)
    assert commands.train(*given, "--watch") == 0
    return shown


def test_watching_shows_the_scene_and_changes_no_bit(synthetic, tmp_path, monkeypatch, capsys, device):
    common = f"--device {device} --iterations 12 --random-points 60 --sh-degree 0 --no-evaluate"
    assert commands.train(synthetic, tmp_path / "alone", common) == 0
    capsys.readouterr()
    shown = watched(monkeypatch, synthetic, tmp_path / "watched", common)
    assert re.search(r"^watch at http://127\.0\.0\.1:\d+/[\w-]+/$", capsys.readouterr().out, re.M)
    assert [step for _, step, *_ in shown] == list(range(13))
    assert [force for *_, force in shown] == [False] * 12 + [True]
    last = r"loss [\d.]+, PSNR [\d.]+, Gaussians 60, footprint moment:samples=4"
    assert shown[9][2] == "" and re.fullmatch(last, shown[10][2])
    written = io.load_scene(tmp_path / "watched" / files.SCENE)
    torch.testing.assert_close(shown[-1][0].scales.cpu(), written.scales, rtol=1e-5, atol=1e-6)
    alone, together = ((tmp_path / name / files.SCENE).read_bytes() for name in ("alone", "watched"))
    assert alone == together


def test_a_viewer_starts_with_what_is_trained(synthetic, tmp_path):
    pytest.importorskip("viser", reason="needs the view extra")
    with make_run(synthetic, tmp_path, footprint="moment:samples=4", background="random").start_viewer() as viewer:
        assert [view.name for view in viewer.views] == [view.name for view in circle(10)]
        assert (viewer.footprint, viewer.background) == ("moment:samples=4", loading.WHITE)
        assert viewer.name == synthetic.name


def test_watching_without_viser_names_the_extra(synthetic, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "viser", None)
    error = refused(capsys, commands.train, synthetic, tmp_path / "out", "--watch")
    assert 'needs viser: pip install "analytic_rasterizer[view]"' in error
    assert not (tmp_path / "out").exists()
