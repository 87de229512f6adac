"""What a scene loses in a file: writes it in every format, reads it again, and compares.

    python benchmarks/formats.py plant.ply --views plant_hd.json [--also plant.sog]

Prints for each file its size, and the largest error / the root of the mean square error of

- means, in the scene's unit; logarithms of scales, which are relative errors; opacities, from 0 to 1; harmonics;
- rotations, in degrees: the angle of the rotation from one to the other. A round Gaussian looks the same however it is
  turned.

The last column is the PSNR [dB] between pictures of what was read and of the scene, over all views. A format without
harmonics beyond degree 0 is compared in those that it has; its pictures are compared with those of the whole scene.

`--also` are files of the same scene that other programs wrote. They may have another order, so that only their size and
pictures are compared.
"""

from __future__ import annotations

import argparse
import math
import tempfile
import warnings
from pathlib import Path

import torch
from common import has_cuda, print_setup, save_json
from scene_files import load_scene

from analytic_rasterizer import footprints, io
from analytic_rasterizer.analysis.reference import image_errors
from analytic_rasterizer.analysis.tables import markdown_table
from analytic_rasterizer.analysis.timing import Case
from analytic_rasterizer.gaussians import Gaussians

FORMATS = ("ply", "compressed.ply", "spz", "splat", "glb")
HEADER = ("file", "MB", "means", "log scales", "rotations, degrees", "opacities", "harmonics", "PSNR, dB")


def angles(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """(N,) angles in degrees between the rotations of quaternions (N, 4), of any lengths and signs."""
    a, b = (torch.nn.functional.normalize(q.double(), dim=1) for q in (a, b))
    apart = torch.minimum((a - b).norm(dim=1), (a + b).norm(dim=1))  # unlike the cosine exact for small angles
    return torch.rad2deg(4 * torch.asin((apart / 2).clamp(max=1)))


def errors(found: Gaussians, wanted: Gaussians) -> dict[str, torch.Tensor]:
    """Absolute errors in float64, Gaussian by Gaussian."""
    harmonics = min(found.shs.shape[1], wanted.shs.shape[1])
    pairs = {
        "means": (found.means, wanted.means),
        "log_scales": (found.log_scales, wanted.log_scales),
        "opacities": (found.opacities, wanted.opacities),
        "shs": (found.shs[:, :harmonics], wanted.shs[:, :harmonics]),
    }
    measured = {name: (a.double() - b.double()).abs() for name, (a, b) in pairs.items()}
    return measured | {"rotations": angles(found.rotations, wanted.rotations)}


def largest_and_rms(error: torch.Tensor) -> list[float]:
    return [error.max().item(), error.square().mean().sqrt().item()]


def pictures(scene: Gaussians, views: list[io.View], footprint: str, device: str) -> torch.Tensor:
    """All values of the pictures of all views, one after the other."""
    return torch.cat([Case(scene.to(device), view, footprint).forward().cpu().flatten() for view in views])


def measure(scene: Gaussians, args: argparse.Namespace) -> list[dict]:
    """The results of all files, in the order of FORMATS and of --also."""
    views, results = io.load_views(args.views), []
    print_setup(scene, views, args.device)
    wanted = pictures(scene, views, args.footprint, args.device)
    with tempfile.TemporaryDirectory() as folder:
        for path in [Path(folder) / f"scene.{suffix}" for suffix in FORMATS] + [Path(name) for name in args.also]:
            written = path.parent == Path(folder)
            if written:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")  # of what a .splat does not hold
                    io.save_scene(path, scene)
            found = io.load_scene(path)
            result = {name: largest_and_rms(e) for name, e in errors(found, scene).items()} if written else {}
            result["psnr"] = image_errors(pictures(found, views, args.footprint, args.device), wanted)["psnr"]
            results.append({"file": path.name, "bytes": path.stat().st_size, **result})
    return results


def row(result: dict) -> list:
    """A row of the table for HEADER."""
    pairs = [result.get(name) for name in ("means", "log_scales", "rotations", "opacities", "shs")]
    cells = [pair and " / ".join(f"{value:.2g}" for value in pair) for pair in pairs]
    psnr = result["psnr"] if result["psnr"] < 300 else math.inf
    return [result["file"].removeprefix("scene"), f"{result['bytes'] / 1e6:.1f}", *cells, f"{psnr:.1f}"]


def main() -> None:
    args = parse_arguments()
    results = measure(load_scene(args.scene), args)
    print(markdown_table(list(HEADER), [row(result) for result in results]))
    save_json(args, {"results": results})


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    add = parser.add_argument
    add("scene", help="trained scene: .ply, compressed .ply, .spz, or .npz (see scene_files.py)")
    add("--views", required=True, help="file of views")
    add("--also", nargs="+", default=[], metavar="FILE", help="files of the same scene by other programs")
    add("--footprint", default=footprints.RECOMMENDED, metavar="NAME[:k=v]", help="(default: %(default)s)")
    add("--device", choices=("cpu", "cuda"), default="cuda" if has_cuda() else "cpu")
    add("--json", help="also write everything measured to this file")
    return parser.parse_args()


if __name__ == "__main__":
    main()
