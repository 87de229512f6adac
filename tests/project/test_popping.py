"""examples/popping.py on few and small pictures."""

import torch

import popping
from analytic_rasterizer import io


def test_only_one_order_jumps():
    """In steps of a small part of a pixel whole splats jump in the order of centres, and single pixels along rays."""
    most = {}
    for order in popping.ORDERS:
        pictures = popping.rendered(popping.path(600)[:120], 48, order)
        most[order] = max(int((change > 0.06).any(0).sum()) for change in popping.changes(pictures)[1:])
    assert most["center"] > 5 * most["ray"], most


def test_film(tmp_path, monkeypatch):
    out = tmp_path / "popping.png"
    monkeypatch.setattr("sys.argv", ["popping", "--out", str(out), "--frames", "6", "--size", "48"])
    popping.main()
    with io.optional_import("PIL.Image").open(out) as film:
        assert film.n_frames == 6 and film.size == (2 * 48 + popping.GAP, 2 * (48 + popping.LABEL))


def test_sheets_and_path():
    sheets = popping.sheets()
    means, scales = sheets["means3D"].view(3, -1, 3), sheets["scales"].view(3, -1, 3)
    for axis in range(3):
        normal = (axis + 2) % 3  # the sheet lies in the plane across it
        assert not means[axis, :, normal].any() and (scales[axis, :, normal] == scales.min()).all()
    for pose in popping.path(5):
        torch.testing.assert_close(pose[:3, :3] @ pose[:3, :3].T, torch.eye(3), rtol=0, atol=1e-6)
        assert pose[2, 3] == popping.DISTANCE and not pose[:2, 3].any()


def test_changes_go_around():
    pictures = [torch.full((3, 1, 1), value) for value in (0.0, 0.5, 0.25)]
    assert [change.mean().item() for change in popping.changes(pictures)] == [0.25, 0.5, 0.25]
