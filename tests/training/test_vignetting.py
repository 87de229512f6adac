"""Vignetting that a capture was made with is found, and nothing else is taken for it."""

from dataclasses import replace

import numpy as np
import pytest
from capture_files import looking_at_origin
from places import SHARED
from wall import COUNT, SIZE, cameras, write_wall

from analytic_rasterizer import io
from analytic_rasterizer.captures.vignetting import cameras_of
from analytic_rasterizer.training.plan import NO, NOT_KNOWN, YES, plan_capture

SQUARE, FOURTH = -0.5, -0.3  # stops


def near_and_far() -> list:
    """Cameras at several distances, so that a point is at several radii."""
    poses = [looking_at_origin(0.05 * (i - COUNT / 2), 3 + 0.4 * (i % 4)) for i in range(COUNT)]
    return [io.View(f"p_{i}", *SIZE, 180.0, 180.0, pose) for i, pose in enumerate(poses)]


def darker(x, y):
    squares = x**2 + y**2
    return 2 ** (SQUARE * squares + FOURTH * squares**2)


def vignetting_of(folder):
    return next(finding for finding in plan_capture(folder).findings if finding.effect == "vignetting")


@pytest.mark.parametrize("tracked", [True, False])
def test_vignetting_is_measured(tmp_path, tracked):
    """To 0.03 stops: stored values are whole 255ths, and a point is the mean of 5x5 pixels."""
    folder = write_wall(tmp_path / "wall", near_and_far(), tracked=tracked, falloff=darker)
    found = vignetting_of(folder)
    radius = float(found.reason.split(" at ")[1].split("%")[0]) / 100
    assert found.verdict == (YES if tracked else NOT_KNOWN) and found.unit == "stops"
    assert found.options == ({"vignetting": "polynomial"} if tracked else {})
    assert found.number == pytest.approx(-np.log2(darker(radius, 0.0)), abs=0.03)
    exposure = next(finding for finding in plan_capture(folder).findings if finding.effect == "exposure")
    assert exposure.verdict == NO


def test_exposures_are_no_vignetting(tmp_path):
    found = vignetting_of(write_wall(tmp_path / "wall", near_and_far(), gains=lambda i: (2 ** (0.5 - i % 2),) * 3))
    assert found.verdict == NO and abs(found.number) < 0.05


def test_what_is_dark_on_one_side_is_no_vignetting(tmp_path):
    found = vignetting_of(
        write_wall(tmp_path / "wall", near_and_far(), falloff=lambda x, y: 2.0 ** (np.minimum(3 * x, 0) + 0 * y))
    )
    assert found.verdict in (NO, NOT_KNOWN)


def test_cameras_are_told_apart():
    first = cameras()[0]
    turned = replace(first, width=SIZE[1], height=SIZE[0])
    nearly, longer = (replace(first, fx=180.0 * f, fy=180.0 * f) for f in (1.03, 2.0))
    assert cameras_of([first, longer, turned, nearly]) == [[0, 2, 3], [1]]


@pytest.mark.parametrize("name, least, most", [("mouse", 0.2, 0.5), ("bonsai", 0.3, 0.7)])
def test_real_captures(name, least, most):
    """Points of mouse are near the middle of its photographs. Those of bonsai have no tracks."""
    folder = SHARED / "data" / name
    if not folder.is_dir():
        pytest.skip(f"needs {folder}")
    found = vignetting_of(folder)
    assert least < found.number < most and found.verdict == NOT_KNOWN
