"""Placing and turning Gaussians: quaternions (w, x, y, z), and harmonics up to degree 3 with them, in float64."""

from __future__ import annotations

import numpy as np
import torch

from ..cameras.rotations import quaternion, rotation_matrices
from .errors import SceneError

TOLERANCE = 1e-4  # relative, of a node's matrix from a rotation with one scale
Z_UP_TO_Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
SAMPLES = 64  # directions, more than the 16 harmonics


def placed(fields: dict[str, np.ndarray], matrix: np.ndarray) -> dict[str, np.ndarray]:
    """Gaussians where the (4, 4) matrix puts them. Raises SceneError where they would be Gaussians no more."""
    linear = matrix[:3, :3]
    scale = np.cbrt(np.linalg.det(linear))
    if not (np.isfinite(matrix).all() and scale > 0):
        raise SceneError("a node mirrors its Gaussians, or has a scale of 0: not read")
    error = np.abs(linear.T @ linear / scale**2 - np.eye(3)).max()
    if not error < TOLERANCE or not np.array_equal(matrix[3], [0, 0, 0, 1]):
        raise SceneError("a node scales its Gaussians differently along axes, or shears them: not read")
    quaternion = quaternion_of(linear / scale)
    with np.errstate(over="ignore", invalid="ignore"):  # rows that are not finite are left out later
        means = fields["means"] @ linear.T + matrix[:3, 3]
    return {
        "means": means,
        "log_scales": fields["log_scales"] + np.log(scale),
        "rotations": turned_quaternions(quaternion, fields["rotations"]),
        "logit_opacities": fields["logit_opacities"],
        "shs": turned_harmonics(quaternion, fields["shs"]),
    }


def joined(parts: list[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Gaussians of several parts, with harmonics of the highest of their degrees."""
    bands = max(part["shs"].shape[1] for part in parts)
    for part in parts:
        part["shs"] = np.pad(part["shs"], ((0, 0), (0, bands - part["shs"].shape[1]), (0, 0)))
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def quaternion_of(rotation: np.ndarray) -> np.ndarray:
    """The unit quaternion of a (3, 3) rotation, the nearest one where it is only nearly that: always of one sign."""
    found = quaternion(torch.from_numpy(rotation)).numpy()
    return found * np.sign(found[np.abs(found).argmax()])


def turned_quaternions(by: np.ndarray, rotations: np.ndarray) -> np.ndarray:
    """The products of `by` (4,) with `rotations` (N, 4)."""
    w, x, y, z = by
    product = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    return rotations @ product.T


def turned_harmonics(by: np.ndarray, shs: np.ndarray) -> np.ndarray:
    """Harmonics (N, K, 3) whose colour in a turned direction is that of `shs` in the direction before."""
    rotation = rotation_matrices(torch.from_numpy(by), unit=True).numpy()
    directions = np.random.default_rng(0).normal(size=(SAMPLES, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    wanted, basis = _basis(directions @ rotation), _basis(directions)
    turned = shs.astype(np.float64)
    for degree in range(1, int(np.sqrt(shs.shape[1]))):  # a rotation mixes only those of one degree
        band = slice(degree**2, (degree + 1) ** 2)
        matrix = np.linalg.lstsq(basis[:, band], wanted[:, band], rcond=None)[0]
        rounded = matrix.round()  # half turns only change signs: then to the bit
        if np.abs(matrix - rounded).max() < 1e-12:
            matrix = rounded
        turned[:, band] = np.einsum("ij,njc->nic", matrix, shs[:, band])
    return turned


def _basis(directions: np.ndarray) -> np.ndarray:
    """The (M, 16) harmonics of 3DGS, each but for a factor that all of its degree share."""
    x, y, z = directions.T
    root = np.sqrt
    return np.stack(
        [
            np.ones_like(x),
            *(-y, z, -x),
            *(
                2 * root(3) * x * y,
                -2 * root(3) * y * z,
                3 * z * z - 1,
                -2 * root(3) * x * z,
                root(3) * (x * x - y * y),
            ),
            -root(10) / 4 * y * (3 * x * x - y * y),
            root(15) * x * y * z,
            -root(6) / 4 * y * (5 * z * z - 1),
            z * (5 * z * z - 3) / 2,
            -root(6) / 4 * x * (5 * z * z - 1),
            root(15) / 2 * z * (x * x - y * y),
            -root(10) / 4 * x * (x * x - 3 * y * y),
        ],
        1,
    )
