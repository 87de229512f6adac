"""Scenes for exported files: whole numbers whose errors are hard to see, in an order in which gzip makes them small.

`compress` and `decompress` are inverse but for the rounding. `page/compressed.js` decodes as `decompress` does.

The Gaussians are in the order of a Morton curve. Every number is rounded to a multiple of a step:

- *Scales* to 1/32 of an octave, so that they are off by 1.1% at most. Order and signs of a Gaussian's axes are free:
  of the 24 rotations that turn its axes into each other, the one nearest to the identity is taken. Its w is the largest
  component and left out.
- *Means* to 1/64 of their middle scale, or down to half of that, and given as the difference from the Gaussian before.
  So an error does not grow where the camera comes closer.
- *Rotations* to 1/128, and a finer power of two where one scale is much larger than another.
- *Opacities* to 1/255.
- *Harmonics* to 1/112 over the opacity, in three mixtures of the colours, of which the second and third are small. A
  rounding has a root mean square of 1/sqrt(12) step; that of a colour of degree 3 is sqrt(16 / (4 pi)) of it. So one
  layer of Gaussians is off by 0.0029: 50.7 dB. Layers behind each other average.

Steps of means and rotations are powers of two that follow from rounded scales. So both decoders have the same numbers.
"""

from __future__ import annotations

import math
import zlib
from itertools import product
from typing import Any

import numpy as np
import torch

from ..cameras.rotations import rotation_matrices
from ..io.morton import morton_order
from .compact import LARGEST_HALF
from .packing import GEOMETRY_WIDTH, PackedScene

OCTAVE = 32
"""Steps of the scales in a factor of 2."""
SMALLEST_SCALE = 2.0**-100
MEAN_BITS = 6
"""The step of a mean is the middle scale, rounded down to a power of two, by this one."""
FINEST_MEAN_BITS = 44
"""No step is below the largest coordinate by this power of two, so that all multiples are exact."""
ROTATION_BITS, MOST_ROTATION_BITS = 7, 12
OPAQUE = 255
HARMONICS = 112
FAINT = 64
"""Harmonics of Gaussians with less opacity, of 255, have the step of this one."""
MIXTURES = ((3**-0.5,) * 3, (2**-0.5, 0.0, -(2**-0.5)), (6**-0.5, -2 * 6**-0.5, 6**-0.5))
"""Orthonormal rows: grey, red against blue, green against both."""


def compress(scene: PackedScene) -> tuple[dict[str, Any], bytes]:
    """What a page needs to decode the scene, as JSON, and the gzip of its numbers.

    These are columns of whole numbers of all Gaussians: scales x, y, z less their median; differences of means x, y, z;
    opacity less 128; x, y, z of the quaternion; and for each coefficient the three mixtures. A number n from 0 is
    stored as 2 n, one below as -2 n - 1. Of a column all lowest bytes come first, then all second ones, up to its
    width.

    Args:
        scene: What `pack_scene` returned, not compact.
    """
    geometry = np.frombuffer(scene.geometry, "<f4").reshape(-1, GEOMETRY_WIDTH).astype(np.float64)
    geometry = geometry[order := _morton_order(geometry[:, :3])]
    means, scales = geometry[:, :3], geometry[:, 4:7]
    turned, quaternions = _nearest_to_identity(scales, geometry[:, 8:12])
    steps = np.rint(OCTAVE * np.log2(turned.clip(SMALLEST_SCALE))).astype(np.int64)
    opacities = np.rint(OPAQUE * geometry[:, 3]).astype(np.int64)
    largest = max(np.abs(means).max(), SMALLEST_SCALE)
    made: dict[str, Any] = {
        "median": int(np.median(steps)),
        "octave": OCTAVE,
        "mean": MEAN_BITS,
        "finest": int(np.ceil(np.log2(largest))) - FINEST_MEAN_BITS,
        "rotation": [ROTATION_BITS, MOST_ROTATION_BITS],
        "opaque": OPAQUE,
        "faint": FAINT,
        "harmonics": HARMONICS,
        "mixtures": MIXTURES,
    }
    mean_step, rotation_step, harmonics_step = _steps(made, steps, opacities)
    at = _rounded(means / mean_step)
    before = np.zeros_like(at)
    before[1:] = _rounded((at * mean_step)[:-1] / mean_step[1:])
    columns = _Writer()
    columns.add(steps - made["median"])
    columns.add(at - before)
    columns.add(opacities[:, None] - 128)
    columns.add(_rounded(quaternions[:, 1:] / rotation_step))
    harmonics = np.frombuffer(scene.harmonics, "<f2").reshape(len(means), -1)[order]
    for k in range((scene.meta["sh_degree"] + 1) ** 2):
        mixed = harmonics[:, 3 * k : 3 * k + 3].astype(np.float64) @ np.transpose(MIXTURES)
        columns.add(_rounded(mixed / harmonics_step))
    made["widths"] = columns.widths
    return made, columns.end()


def decompress(meta: dict[str, Any], made: dict[str, Any], data: bytes) -> PackedScene:
    """The scene that `compress` took, rounded and in another order. The reference of `page/compressed.js`."""
    count, read = meta["count"], _Reader(zlib.decompress(data, 31), meta["count"], made["widths"])
    steps = read.next(3) + made["median"]
    differences, opacities = read.next(3), read.next(1)[:, 0] + 128
    mean_step, rotation_step, harmonics_step = _steps(made, steps, opacities)
    geometry = np.zeros((count, GEOMETRY_WIDTH))
    for axis in range(3):
        mean = 0.0
        for i, (step, difference) in enumerate(zip(mean_step[:, 0].tolist(), differences[:, axis].tolist())):
            geometry[i, axis] = mean = (math.floor(mean / step + 0.5) + difference) * step
    geometry[:, 3] = opacities / made["opaque"]
    geometry[:, 4:7] = 2.0 ** (steps / made["octave"])
    x, y, z = (read.next(3) * rotation_step).T
    geometry[:, 8:12] = np.stack([np.sqrt((1 - (x * x + y * y + z * z)).clip(0)), x, y, z], axis=1)
    used = (meta["sh_degree"] + 1) ** 2
    harmonics = np.zeros((count, -(-3 * used // 4) * 4), "<f2")
    grey, red, green = np.asarray(made["mixtures"])
    for k in range(used):
        mixed = read.next(3) * harmonics_step
        # In this order and by way of float32, so that the page rounds alike.
        sums = mixed[:, :1] * grey + mixed[:, 1:2] * red + mixed[:, 2:] * green
        harmonics[:, 3 * k : 3 * k + 3] = sums.astype("<f4").clip(-LARGEST_HALF, LARGEST_HALF)
    return PackedScene(meta, geometry.astype("<f4").tobytes(), harmonics.tobytes())


def _steps(made: dict[str, Any], scales: np.ndarray, opacities: np.ndarray) -> tuple[np.ndarray, ...]:
    """Steps of means, rotations and harmonics, (N, 1), by rounded scales (N, 3) and opacities (N,)."""
    small, middle, large = np.sort(scales, axis=1).T
    mean = np.maximum(middle // made["octave"] - made["mean"], made["finest"])
    fewest, most = made["rotation"]
    rotation = np.minimum(fewest + (large - small) // made["octave"], most)
    harmonics = made["opaque"] / np.maximum(opacities, made["faint"]) / made["harmonics"]
    return np.ldexp(1.0, mean)[:, None], np.ldexp(1.0, -rotation)[:, None], harmonics[:, None]


def _rounded(numbers: np.ndarray) -> np.ndarray:
    """To the nearest whole number; of two the larger, as JavaScript does."""
    return np.floor(numbers + 0.5)


def _morton_order(means: np.ndarray) -> np.ndarray:
    """Indices that sort points (N, 3) along a Morton curve through the cube that holds 99% of every coordinate."""
    bits = 20
    low, high = np.quantile(means, [0.005, 0.995], axis=0)
    side = max((high - low).max(), SMALLEST_SCALE)
    places = ((means - low) / side * (2**bits - 1)).clip(0, 2**bits - 1)
    return morton_order(places, bits)


def _nearest_to_identity(scales: np.ndarray, quaternions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same Gaussians with their axes in another order: of 24 unit quaternions that with the largest w."""
    turns = np.array([turn for turn in product((-1.0, 0.0, 1.0), repeat=4) if np.count_nonzero(turn) in (1, 2, 4)])
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    best, largest = np.zeros(len(scales), np.int64), np.full(len(scales), -1.0)
    for k, turn in enumerate(turns):
        w = quaternions @ (turn * (1, -1, -1, -1))
        better = w > largest
        best[better], largest[better] = k, w[better]
    axes = rotation_matrices(torch.from_numpy(turns), unit=True).abs().argmax(dim=1).numpy()
    turned = np.empty_like(quaternions)
    for k, (w, x, y, z) in enumerate(turns):
        # The product of quaternions, with the turn on the right.
        rows = np.array([[w, -x, -y, -z], [x, w, z, -y], [y, -z, w, x], [z, y, -x, w]])
        turned[best == k] = quaternions[best == k] @ rows.T
    return np.take_along_axis(scales, axes[best], axis=1), turned


class _Writer:
    """Columns of whole numbers, compressed.

    Attributes:
        widths: Bytes of a number, by column.
    """

    def __init__(self):
        self.widths: list[int] = []
        # Numbers that look random repeat little: this strategy is the smallest, and level 9 is 3% below at 9 times the
        # time.
        self._gzip = zlib.compressobj(6, zlib.DEFLATED, 31, 9, zlib.Z_FILTERED)
        self._parts: list[bytes] = []

    def add(self, numbers: np.ndarray) -> None:
        """Columns (N, K) of whole numbers below 2^52."""
        for column in numbers.astype(np.int64).T:
            folded = np.where(column < 0, -2 * column - 1, 2 * column).astype("<u8")
            width = max(1, -(-int(folded.max()).bit_length() // 8))
            planes = folded.view("u1").reshape(-1, 8)[:, :width].T
            self._parts.append(self._gzip.compress(np.ascontiguousarray(planes).tobytes()))
            self.widths.append(width)

    def end(self) -> bytes:
        return b"".join([*self._parts, self._gzip.flush()])


class _Reader:
    """What a `_Writer` wrote, column by column."""

    def __init__(self, data: bytes, count: int, widths: list[int]):
        self._bytes, self._count, self._widths = np.frombuffer(data, "u1"), count, iter(widths)

    def next(self, columns: int) -> np.ndarray:
        """The next columns, int64 (N, K)."""
        made = np.empty((self._count, columns), np.int64)
        for k in range(columns):
            width = next(self._widths)
            planes = np.zeros((self._count, 8), "u1")
            planes[:, :width] = self._bytes[: width * self._count].reshape(width, -1).T
            self._bytes = self._bytes[width * self._count :]
            folded = planes.view("<u8")[:, 0].astype(np.int64)
            made[:, k] = np.where(folded & 1, -((folded + 1) >> 1), folded >> 1)
        return made
