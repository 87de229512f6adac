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

NAMES = io.Scene._fields[:-1]


def load_scene(path: str) -> io.Scene:
    """The scene of an .npz as above, or of anything else that `io.load_scene` reads, on the CPU."""
    if Path(path).suffix != ".npz":
        return io.load_scene(path)
    with np.load(path) as file:
        fields = {name: torch.from_numpy(file[name].astype(np.float32)) for name in NAMES}
    return io.Scene(**fields, sh_degree=math.isqrt(fields["shs"].shape[1]) - 1)


def save_npz(path: str, scene: io.Scene) -> None:
    """Writes what `load_scene` reads."""
    np.savez(path, **{name: getattr(scene, name).cpu().numpy() for name in NAMES})


def pad_sh(scene: io.Scene, degree: int) -> io.Scene:
    """The scene with zeros for the coefficients that it lacks up to `degree`, which is at least its own."""
    missing = (degree + 1) ** 2 - scene.shs.shape[1]
    return scene._replace(shs=torch.nn.functional.pad(scene.shs, (0, 0, 0, missing)), sh_degree=degree)


def load_padded(path: str, degree: int | None) -> io.Scene:
    """The scene of `load_scene`, padded to a degree if there is one. Ends the program where that is below its own."""
    scene = load_scene(path)
    if degree is None:
        return scene
    if degree < scene.sh_degree:
        raise SystemExit(f"--sh-degree {degree} is below the scene's, {scene.sh_degree}")
    return pad_sh(scene, degree)


def main() -> None:
    parser = argparse.ArgumentParser(description="Turn a scene into an .npz.")
    parser.add_argument("scene", help="trained scene: .ply, compressed .ply or .spz")
    parser.add_argument("npz", help="file to write")
    args = parser.parse_args()
    save_npz(args.npz, load_scene(args.scene))


if __name__ == "__main__":
    main()
