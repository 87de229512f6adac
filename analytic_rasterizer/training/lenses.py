"""Lenses of perspective cameras, and photographs resampled to the pinholes without them.

A pinhole maps a point (x, y, z) in front of the camera to (a, b) = (x/z, y/z). A lens moves that to
(a', b') = `Lens.distorted`(a, b), and the photograph has the point at (fx a' + cx, fy b' + cy), in pixels of an image
that spans [0, width] x [0, height]. The formulas are those of OpenCV and COLMAP
(https://colmap.github.io/cameras.html).

The same map makes the picture of a pinhole: for every pixel of the pinhole it gives the position in the photograph that
has the colour. So the map is never inverted. The pinhole keeps focal lengths and principal point; the middle of the
picture stays as it is. Its picture is the largest rectangle about the principal point whose pixels are all in the
photograph.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from .. import io

# Names of the coefficients of a model, in COLMAP's order, after focal lengths and principal point.
MODELS = {
    "SIMPLE_RADIAL": ("k1",),
    "RADIAL": ("k1", "k2"),
    "OPENCV": ("k1", "k2", "p1", "p2"),
    "FULL_OPENCV": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
}
RATIONAL = "FULL_OPENCV"  # k4, k5, k6 divide; elsewhere k4 goes on the polynomial of k1, k2, k3, as in nerfstudio

MOST_GROWTH = 2.0  # of width and height, where a lens sees more than its pinhole
# How far neighbouring pixels of the pinhole may be apart in the photograph, beside those in the middle. Where it is
# less or more, the polynomial folds back or runs away: it was fitted to points, of which none is there.
LEAST_SPACING, MOST_SPACING = 0.1, 10.0
LEAST_KEPT = 0.25  # of the photograph
RADII = 4096  # where the spacing is looked at
BORDER = 129  # points on each side of a rectangle that have to be in the photograph
HALVINGS = 18  # of the step by which sides grow: below a pixel in every photograph
STRIP = 1 << 20  # pixels that are resampled at a time
SAME_SPACING = 1e-3  # px by which neighbours may be farther apart than in the middle before a mean is taken


class Lens(NamedTuple):
    """What a camera has beyond a pinhole. All zeros are a pinhole, for which there is no Lens."""

    model: str  # its name in messages
    radial: tuple[float, ...]  # k1, k2, ...: factors of r^2, r^4, ...
    divisor: tuple[float, ...] = ()  # k4, k5, k6 of FULL_OPENCV, likewise
    tangential: tuple[float, float] = (0.0, 0.0)  # p1, p2

    def distorted(self, a: Tensor | np.ndarray, b: Tensor | np.ndarray) -> tuple:
        """Where the lens moves (a, b), of any shape."""
        r2 = a * a + b * b
        factor = self.factor(r2)
        p1, p2 = self.tangential
        return (
            a * factor + 2 * p1 * a * b + p2 * (r2 + 2 * a * a),
            b * factor + 2 * p2 * a * b + p1 * (r2 + 2 * b * b),
        )

    def factor(self, r2: Tensor | np.ndarray) -> Tensor | np.ndarray:
        """By which the radius grows, without the tangential part, at the square of the radius."""
        factor = _polynomial(self.radial, r2)
        return factor / _polynomial(self.divisor, r2) if self.divisor else factor


def _polynomial(coefficients: tuple[float, ...], r2):
    total = 0.0
    for coefficient in reversed(coefficients):
        total = (total + coefficient) * r2
    return 1 + total


def lens_of(model: str, coefficients: Mapping[str, float], where: str) -> Lens | None:
    """The lens with these k1, k2, ..., p1, p2, or None for that of a pinhole.

    Raises io.SceneError, which begins with `where`, for what is no finite number.
    """
    numbers = {name: value for name, value in coefficients.items() if value}
    for name, value in numbers.items():
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
            raise io.SceneError(f"{where}: {name} must be a finite number, got {value!r}")
    if not numbers:
        return None
    k1, k2, k3, k4, k5, k6 = (float(numbers.get(f"k{i}", 0)) for i in range(1, 7))
    rational = model == RATIONAL
    return Lens(
        model,
        radial=(k1, k2, k3) if rational else (k1, k2, k3, k4),
        divisor=(k4, k5, k6) if rational and any((k4, k5, k6)) else (),
        tangential=(float(numbers.get("p1", 0)), float(numbers.get("p2", 0))),
    )


class Window(NamedTuple):
    """The pinhole's picture, in pixels of the photograph's camera without its lens."""

    left: int
    top: int
    width: int
    height: int
    kept: float  # which share of the photograph is in it


def window_of(lens: Lens, view: io.View) -> Window:
    """The largest rectangle about the principal point whose pixels are all in the photograph.

    Args:
        view: The photograph's camera without its lens.

    Raises:
        io.SceneError: The principal point is not in the photograph, or the lens folds back so near to it that less than
            LEAST_KEPT of the photograph is left.
    """
    cx = view.width / 2 if view.cx is None else view.cx
    cy = view.height / 2 if view.cy is None else view.cy
    if not (0 < cx < view.width and 0 < cy < view.height):
        expected = f"in the picture of {view.width} x {view.height} px where a lens is distorted"
        raise io.SceneError(f"the principal point must be {expected}, got {cx:g}, {cy:g}")
    window = _window(lens, view.width, view.height, view.fx, view.fy, cx, cy)
    if window.kept < LEAST_KEPT:
        raise io.SceneError(
            f"the distortion of {lens.model} folds back inside the picture: {window.kept:.0%} of it can be undistorted"
        )
    return window


@lru_cache(maxsize=4096)
def _window(lens: Lens, width: int, height: int, fx: float, fy: float, cx: float, cy: float) -> Window:
    # The sides of the photograph as seen from the principal point: left, right, top, bottom.
    sides = np.array([cx / fx, (width - cx) / fx, cy / fy, (height - cy) / fy])
    farthest = MOST_GROWTH * math.hypot(max(sides[:2]), max(sides[2:]))
    end = _end_of(lens, farthest)

    def border(grown: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Points on the border of a rectangle with so many times these sides, in its order."""
        left, right, top, bottom = grown * sides
        x, y = np.linspace(-left, right, BORDER), np.linspace(-top, bottom, BORDER)
        a = np.concatenate([x, np.full(BORDER, right), x[::-1], np.full(BORDER, -left)])
        b = np.concatenate([np.full(BORDER, -top), y, np.full(BORDER, bottom), y[::-1]])
        return a, b

    def fits(grown: np.ndarray) -> bool:
        """Whether the border is in the photograph. Then what is inside of it is too."""
        a, b = border(grown)
        u, v = lens.distorted(a, b)
        u, v = fx * u + cx, fy * v + cy
        inside = (u >= -1e-6) & (u <= width + 1e-6) & (v >= -1e-6) & (v <= height + 1e-6)
        return bool((inside & (np.hypot(a, b) <= end)).all())

    grown = np.zeros(4)
    # All sides together first, then what is left for each of them.
    for which in ([0, 1, 2, 3], [0], [1], [2], [3]):
        step = MOST_GROWTH / 2
        for _ in range(HALVINGS):
            larger = grown.copy()
            larger[which] = np.minimum(larger[which] + step, MOST_GROWTH)
            if fits(larger):
                grown = larger
            step /= 2
    # Whole pixels. Where a side stays within rounding, it is that of the photograph.
    first = np.ceil([cx - grown[0] * sides[0] * fx - 0.01, cy - grown[2] * sides[2] * fy - 0.01])
    last = np.floor([cx + grown[1] * sides[1] * fx + 0.01, cy + grown[3] * sides[3] * fy + 0.01])
    u, v = lens.distorted(*border(grown))
    area = 0.5 * abs(np.dot(u, np.roll(v, -1)) - np.dot(v, np.roll(u, -1))) * fx * fy
    kept = area / (width * height) if (last > first).all() else 0.0
    return Window(int(first[0]), int(first[1]), int(last[0] - first[0]), int(last[1] - first[1]), min(kept, 1.0))


def _end_of(lens: Lens, farthest: float) -> float:
    """The radius up to which the radial part keeps neighbouring rays apart, at most `farthest`."""
    radii = np.linspace(0, farthest, RADII)
    with np.errstate(all="ignore"):  # a divisor that is zero, and large numbers behind it
        spacing = np.diff(radii * lens.factor(radii**2)) / np.diff(radii)
        good = (spacing >= LEAST_SPACING) & (spacing <= MOST_SPACING)
    return farthest if good.all() else float(radii[np.argmin(good)])


def without_lens(rgba: Tensor, view: io.View, lens: Lens) -> tuple[io.View, Tensor]:
    """The picture of the pinhole that `window_of` finds, and its view.

    The photograph is interpolated between its pixels, at positions that are right to 1e-3 px. Where neighbours of the
    pinhole are farther apart in the photograph than a pixel, the mean is taken over the area between them, and colours
    count by their alpha. The numbers are those of the file (in general not linear in the light), as those of all
    reduced pictures are.

    Args:
        rgba: (H, W, 4) uint8 of straight alpha; the result is on its device.
        view: The photograph's camera without its lens, of the size of the picture.

    Raises io.SceneError as `window_of` does.
    """
    window = window_of(lens, view)
    cx = view.width / 2 if view.cx is None else view.cx
    cy = view.height / 2 if view.cy is None else view.cy
    planes = rgba.permute(2, 0, 1)[None].float()
    opaque = bool((rgba[..., 3] == 255).all())
    planes = planes[:, :3] if opaque else torch.cat([planes[:, :3] * (planes[:, 3:] / 255), planes[:, 3:]], 1)
    found = torch.full((window.height, window.width, 4), 255, dtype=torch.uint8, device=rgba.device)
    rows = max(1, STRIP // window.width)
    for top in range(0, window.height, rows):
        bottom = min(top + rows, window.height)
        # With a pixel more on every side, for derivatives.
        y = torch.arange(top - 1, bottom + 1, dtype=torch.float32, device=rgba.device) + (0.5 + window.top - cy)
        x = torch.arange(-1, window.width + 1, dtype=torch.float32, device=rgba.device) + (0.5 + window.left - cx)
        u, v = lens.distorted(x / view.fx, y[:, None] / view.fy)
        strip = _averages(planes, view.fx * u + cx, view.fy * v + cy)
        if not opaque:
            strip[:3] = torch.where(strip[3:] > 0, strip[:3] / (strip[3:] / 255), 0.0)
        found[top:bottom, :, : len(strip)] = strip.round().clamp(0, 255).to(torch.uint8).permute(1, 2, 0)
    view = replace(view, width=window.width, height=window.height, cx=cx - window.left, cy=cy - window.top)
    return view, found


def _averages(planes: Tensor, u: Tensor, v: Tensor) -> Tensor:
    """Means of planes (1, C, H, W) around positions (u, v) in their pixels, (h + 2, w + 2) each; (C, h, w).

    Where neighbouring positions are s > 1 pixels apart, the mean over an area s pixels wide is wanted. A pixel is a
    mean over its own width already. In variances, s^2 / 12 is wanted and 1 / 12 is there; a mean over sqrt(s^2 - 1)
    pixels adds what is missing. This width falls to zero smoothly where s falls to 1.
    """
    inner = slice(1, -1)
    along_x = [(of[inner, 2:] - of[inner, :-2]) / 2 for of in (u, v)]
    along_y = [(of[2:, inner] - of[:-2, inner]) / 2 for of in (u, v)]
    spacings = [torch.hypot(*steps) for steps in (along_x, along_y)]
    samples = math.ceil(max(spacing.max().item() for spacing in spacings) - SAME_SPACING)
    widths = [(1 - spacing.clamp_min(1).square().reciprocal()).sqrt() for spacing in spacings]
    size = planes.shape[3], planes.shape[2]
    total = 0
    for i in range(samples):
        for j in range(samples):
            dx, dy = (((k + 0.5) / samples - 0.5) * width for k, width in zip((i, j), widths))
            moved = (of[inner, inner] + dx * x + dy * y for of, x, y in zip((u, v), along_x, along_y))
            # grid_sample has a picture span [-1, 1].
            positions = torch.stack([2 * of / length - 1 for of, length in zip(moved, size)], 2)
            total = total + functional.grid_sample(planes, positions[None], "bilinear", "border", align_corners=False)
    return total[0] / samples**2
