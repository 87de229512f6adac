"""Scenes for the benchmarks, from machines with and without the library that reads .ply.

    python benchmarks/scene_files.py SCENE.ply SCENE.npz

turns what `analytic_rasterizer.io.load_scene` reads into an .npz that numpy alone reads: float32 arrays
`means` (P, 3), `scales` (P, 3) standard deviations, `rotations` (P, 4) quaternions (w, x, y, z),
`opacities` (P,) or (P, 1) in [0, 1], `shs` (P, K, 3) spherical harmonics with K = 1, 4, 9 or 16.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch

from analytic_rasterizer import io
from analytic_rasterizer.gaussians import Gaussians

NAMES = ("means", "scales", "rotations", "opacities", "shs")


def load_scene(path: str) -> Gaussians:
    """The scene of an .npz as above, or of anything else that `io.load_scene` reads, on the CPU."""
    if Path(path).suffix != ".npz":
        return io.load_scene(path)
    with np.load(path) as file:
        fields = {name: torch.from_numpy(file[name].astype(np.float32)) for name in NAMES}
    return Gaussians.from_activated(**fields)


def save_npz(path: str, scene: Gaussians) -> None:
    """Writes what `load_scene` reads."""
    np.savez(path, **{name: getattr(scene, name).cpu().numpy() for name in NAMES})


def load_padded(path: str, degree: int | None) -> Gaussians:
    """The scene of `load_scene`, padded to a degree if there is one. Ends the program where that is below its own."""
    scene = load_scene(path)
    if degree is None:
        return scene
    if degree < scene.sh_degree:
        raise SystemExit(f"--sh-degree {degree} is below the scene's, {scene.sh_degree}")
    return scene.with_sh_degree(degree)


def main() -> None:
    parser = argparse.ArgumentParser(description="Turn a scene into an .npz.")
    parser.add_argument("scene", help="trained scene: .ply, compressed .ply or .spz")
    parser.add_argument("npz", help="file to write")
    args = parser.parse_args()
    save_npz(args.npz, load_scene(args.scene))


if __name__ == "__main__":
    main()
