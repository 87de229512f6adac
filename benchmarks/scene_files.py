"""Scenes for the benchmarks, from machines with and without the library that reads .ply.

    python benchmarks/scene_files.py SCENE.ply SCENE.npz

turns what `analytic_rasterizer.io.load_scene` reads into an .npz that numpy alone reads: float32 arrays
`means` (P, 3), `scales` (P, 3) standard deviations, `rotations` (P, 4) quaternions (w, x, y, z),
`opacities` (P,) or (P, 1) in [0, 1], `shs` (P, K, 3) spherical harmonics with K = 1, 4, 9 or 16.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import numpy as np
import torch

from analytic_rasterizer import io


def load_scene(path: str) -> io.Scene:
    """The scene of an .npz as above, or of anything else that `io.load_scene` reads, on the CPU.

    Raises io.SceneError for an .npz without these arrays or with other shapes.
    """
    return _load_npz(path) if Path(path).suffix == ".npz" else io.load_scene(path)


def save_npz(path: str, scene: io.Scene) -> None:
    """Writes what `load_scene` reads."""
    np.savez(path, **{name: field.cpu().numpy() for name, field in zip(scene._fields[:-1], scene[:-1])})


def _load_npz(path: str) -> io.Scene:
    names = io.Scene._fields[:-1]
    with np.load(path) as file:
        missing = [name for name in names if name not in file]
        if missing:
            raise io.SceneError(f"{path}: expected arrays {', '.join(names)}; missing {', '.join(missing)}")
        arrays = {name: torch.from_numpy(file[name].astype(np.float32)) for name in names}
    count, coefficients = arrays["shs"].shape[:2]
    if coefficients not in (1, 4, 9, 16):
        raise io.SceneError(f"{path}: shs must have 1, 4, 9 or 16 coefficients, got {coefficients}")
    widths = {"means": (3,), "scales": (3,), "rotations": (4,), "opacities": (1,), "shs": (coefficients, 3)}
    for name, width in widths.items():
        if arrays[name].numel() != count * math.prod(width):
            raise io.SceneError(f"{path}: {name} must have shape {(count, *width)}, got {tuple(arrays[name].shape)}")
        arrays[name] = arrays[name].reshape(count, *width).contiguous()
    return io.Scene(**arrays, sh_degree=math.isqrt(coefficients) - 1)


def main() -> None:
    parser = argparse.ArgumentParser(description="Turn a scene into an .npz.")
    parser.add_argument("scene", help="trained scene: .ply, compressed .ply or .spz")
    parser.add_argument("npz", help="file to write")
    args = parser.parse_args()
    save_npz(args.npz, load_scene(args.scene))


if __name__ == "__main__":
    main()
