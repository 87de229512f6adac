"""Order along a Morton curve: neighbours in it are mostly neighbours in space, so that files take less room."""

from __future__ import annotations

import numpy as np


def morton_order(cells: np.ndarray, bits: int) -> np.ndarray:
    """(N,) indices that sort cells (N, 3), whole numbers from 0 to 2^bits - 1 with at most 20 bits, along the curve.

    Those of one cell keep their order.
    """
    cells, key = cells.astype(np.int64), np.zeros(len(cells), np.int64)
    for bit in range(bits):
        for axis in range(3):
            key |= (cells[:, axis] >> bit & 1) << 3 * bit + axis
    return np.argsort(key, kind="stable")
