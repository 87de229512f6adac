"""Photographs resampled to those of pinholes, for who wants pictures without a lens (`--lens undistort`).

The lens shows the direction of the pinhole's (a, b) = (x/z, y/z) at (a', b') (`Lens.project`). The photograph has it at
(fx a' + cx, fy b' + cy), in pixels of an image that spans [0, width] x [0, height].

The same map makes the picture of a pinhole: for every pixel of the pinhole it gives the position in the photograph that
has the colour. So the map is never inverted. The pinhole keeps focal lengths and principal point; the middle of the
picture stays as it is. Its picture is the largest rectangle about the principal point whose pixels are all in the
photograph.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from .. import io
from ..cameras.lens import Lens

MOST_GROWTH = 2.0  # of width and height, where a lens sees more than its pinhole
# How far neighbouring pixels of the pinhole may be apart in the photograph, beside those in the middle. Where it is
# less or more, the polynomial folds back or runs away: it was fitted to points, of which none is there.
LEAST_SPACING, MOST_SPACING = 0.1, 10.0
LEAST_KEPT = 0.25  # of the photograph
RADII, DIRECTIONS = 4096, 8  # where the spacing is looked at
BORDER = 129  # points on each side of a rectangle that have to be in the photograph
HALVINGS = 18  # of the step by which sides grow: below a pixel in every photograph
STRIP = 1 << 20  # pixels that are resampled at a time
SAME_SPACING = 1e-3  # px by which neighbours may be farther apart than in the middle before a mean is taken


class Window(NamedTuple):
    """The pinhole's picture, in pixels of the photograph's camera without its lens."""

    left: int
    top: int
    width: int
    height: int
    kept: float  # which share of the photograph is in it


def window_of(view: io.View) -> Window:
    """The largest rectangle about the principal point whose pixels are all in the photograph of a camera with a lens.

    Raises:
        io.SceneError: The principal point is not in the photograph, or the lens folds back so near to it that less than
            LEAST_KEPT of the photograph is left.
    """
    cx, cy = view.middle
    if not (0 < cx < view.width and 0 < cy < view.height):
        expected = f"in the picture of {view.width} x {view.height} px where a lens is undistorted"
        raise io.SceneError(f"the principal point must be {expected}, got {cx:g}, {cy:g}")
    window = _window(view.lens, view.width, view.height, view.fx, view.fy, cx, cy)
    if window.kept < LEAST_KEPT:
        raise io.SceneError(
            f"the {view.lens.model} lens is too wide: {window.kept:.0%} of the picture can be undistorted"
        )
    return window


def _seen_at(lens: Lens, a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where the lens shows (a, b) of a pinhole, (N,) each; NaN where nowhere."""
    points = torch.from_numpy(np.stack([a, b, np.ones_like(a)], 1))
    return tuple(lens.project(points)[0].numpy().T)


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
        u, v = _seen_at(lens, a, b)
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
    u, v = _seen_at(lens, *border(grown))
    area = 0.5 * abs(np.dot(u, np.roll(v, -1)) - np.dot(v, np.roll(u, -1))) * fx * fy
    kept = area / (width * height) if (last > first).all() else 0.0
    return Window(int(first[0]), int(first[1]), int(last[0] - first[0]), int(last[1] - first[1]), min(kept, 1.0))


def _end_of(lens: Lens, farthest: float) -> float:
    """The radius up to which the lens keeps neighbouring rays apart, at most `farthest`."""
    radii = np.linspace(0, farthest, RADII)
    end = farthest
    for turn in np.arange(DIRECTIONS) * (2 * math.pi / DIRECTIONS):
        with np.errstate(all="ignore"):  # a divisor that is zero, and large numbers behind it
            shown = np.hypot(*_seen_at(lens, radii * math.cos(turn), radii * math.sin(turn)))
            spacing = np.diff(shown) / np.diff(radii)
            good = (spacing >= LEAST_SPACING) & (spacing <= MOST_SPACING)
        end = end if good.all() else min(end, float(radii[np.argmin(good)]))
    return end


def without_lens(rgba: Tensor, view: io.View) -> tuple[io.View, Tensor]:
    """The picture of the pinhole that `window_of` finds, and its view.

    The photograph is interpolated between its pixels, at positions that are right to 1e-3 px. Where neighbours of the
    pinhole are farther apart in the photograph than a pixel, the mean is taken over the area between them, and colours
    count by their alpha. The numbers are those of the file (in general not linear in the light), as those of all
    reduced pictures are.

    Args:
        rgba: (H, W, 4) uint8 of straight alpha; the result is on its device.
        view: The photograph's camera, with its lens and of the size of the picture.

    Raises io.SceneError as `window_of` does.
    """
    window = window_of(view)
    cx, cy = view.middle
    planes = rgba.permute(2, 0, 1)[None].float()
    opaque = bool((rgba[..., 3] == 255).all())
    planes = planes[:, :3] if opaque else torch.cat([planes[:, :3] * (planes[:, 3:] / 255), planes[:, 3:]], 1)
    found = torch.full((window.height, window.width, 4), 255, dtype=torch.uint8, device=rgba.device)
    rows = max(1, STRIP // window.width)
    for top in range(0, window.height, rows):
        bottom = min(top + rows, window.height)
        # With a pixel more on every side, for derivatives.
        y = torch.arange(top - 1, bottom + 1, dtype=torch.float64) + (0.5 + window.top - cy)
        x = torch.arange(-1, window.width + 1, dtype=torch.float64) + (0.5 + window.left - cx)
        a, b = torch.meshgrid(x / view.fx, y / view.fy, indexing="xy")
        seen = view.lens.project(torch.stack([a, b, torch.ones_like(a)], 2).reshape(-1, 3))[0].reshape(*a.shape, 2)
        u, v = (view.fx * seen[..., 0] + cx, view.fy * seen[..., 1] + cy)
        strip = _averages(planes, *(of.to(rgba.device, torch.float32) for of in (u, v)))
        if not opaque:
            strip[:3] = torch.where(strip[3:] > 0, strip[:3] / (strip[3:] / 255), 0.0)
        found[top:bottom, :, : len(strip)] = strip.round().clamp(0, 255).to(torch.uint8).permute(1, 2, 0)
    view = replace(view, width=window.width, height=window.height, cx=cx - window.left, cy=cy - window.top, lens=None)
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
