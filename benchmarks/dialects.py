"""What a dialect of diff_gaussian_rasterization adds to a frame: the time of its call over that of the library.

    python benchmarks/dialects.py

The scene is tiny (10 Gaussians of degree 1 in 32x32 pixels, one thread), so that what is left is what the host does per
call. Timed is `GaussianRasterizer(settings)(...)` without gradients: of the dialect, and of the library with the same
footprint and the same outputs, as `Effects`; where there are features, with the same features, by the function that
renders them. The two take turns, call by call, and of the times of each the 10th percentile is taken: what another
program takes of the processor only ever adds time. Making the settings is timed apart, for programs that make them in
every frame, against those of the library.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import torch

import analytic_rasterizer as ar
from analytic_rasterizer import dialects
from analytic_rasterizer.analysis.timing import describe_machine
from analytic_rasterizer.render.rasterizer import NOTHING, render

GAUSSIANS, SIZE, DEGREE = 10, 32, 1
PERCENTILE = 10
FEATURES = {
    "langsplat": ("language_feature_precomp", (GAUSSIANS, 3)),
    "grouping": ("sh_objs", (GAUSSIANS, 1, 16)),
    "feature3dgs": ("semantic_feature", (GAUSSIANS, 1, 16)),
}
"""Name and shape of the argument that holds features."""
FURTHER = {
    "antialiasing": False,
    "kernel_size": 0.1,
    "subpixel_offset": torch.zeros(SIZE, SIZE, 2),
    "include_feature": True,
    "f_count": True,
}
"""Settings that 3DGS 2023 does not have."""


def make_scene(seed: int = 0) -> dict[str, torch.Tensor]:
    """Arguments of the library's rasterizer, in front of `make_fields`'s camera."""
    generator = torch.Generator().manual_seed(seed)
    rand = lambda *shape: torch.rand(shape, generator=generator)  # noqa: E731
    return {
        "means3D": 2 * rand(GAUSSIANS, 3) - 1 + torch.tensor([0.0, 0.0, 4.0]),
        "means2D": torch.zeros(GAUSSIANS, 3),
        "opacities": 0.5 + 0.4 * rand(GAUSSIANS, 1),
        "shs": rand(GAUSSIANS, (DEGREE + 1) ** 2, 3) - 0.5,
        "scales": 0.05 + 0.2 * rand(GAUSSIANS, 3),
        "rotations": rand(GAUSSIANS, 4) - 0.5,
    }


def make_fields() -> dict[str, Any]:
    """The settings of 3DGS 2023 by name."""
    projection = torch.tensor([[2.0, 0, 0, 0], [0, 2.0, 0, 0], [0, 0, 1.0, -0.01], [0, 0, 1.0, 0]]).T.contiguous()
    return {
        "image_height": SIZE,
        "image_width": SIZE,
        "tanfovx": 0.5,
        "tanfovy": 0.5,
        "bg": torch.zeros(3),
        "scale_modifier": 1.0,
        "viewmatrix": torch.eye(4),
        "projmatrix": projection,
        "sh_degree": DEGREE,
        "campos": torch.zeros(3),
        "prefiltered": False,
        "debug": False,
        "projmatrix_raw": projection,
        **FURTHER,
    }


class WithFeatures(ar.GaussianRasterizer):
    """The library's rasterizer with features, for which it has a function only."""

    def forward(self, **arguments) -> tuple:
        return render(self.raster_settings, NOTHING, **arguments, colors_precomp=None, cov3D_precomp=None)


def calls_of(name: str) -> dict[str, Callable[[], object]]:
    """What is timed: rendering and making the settings, by the dialect and by the library."""
    module, fields = dialects.dialect_module(name), make_fields()
    scene = make_scene()
    own_fields = {field: fields[field] for field in module.GaussianRasterizationSettings._fields}
    library_fields = {field: fields[field] for field in ar.GaussianRasterizationSettings._fields}
    settings = module.GaussianRasterizationSettings(**own_fields)
    rasterizer = module.GaussianRasterizer(settings)
    arguments, features = dict(scene), None
    if name in FEATURES:
        argument, shape = FEATURES[name]
        arguments[argument] = torch.ones(shape)
        features = arguments[argument].flatten(1)
    if name == "accel":
        arguments["dc"], arguments["shs"] = scene["shs"][:, :1], scene["shs"][:, 1:]
    effects = settings.outputs if settings.outputs.has_outputs else None
    options = {"footprint": str(settings.footprint_in_use()), "effects": effects}
    library_settings = ar.GaussianRasterizationSettings(**library_fields, **options)
    library = ar.GaussianRasterizer(library_settings)
    if features is not None:
        library, scene["features"] = WithFeatures(library_settings), features
    return {
        "dialect": partial(rasterizer, **arguments),
        "library": partial(library, **scene),
        "dialect's settings": lambda: module.GaussianRasterizationSettings(**own_fields),
        "library's settings": lambda: ar.GaussianRasterizationSettings(**library_fields),
    }


@torch.no_grad()
def measure(calls: dict[str, Callable[[], object]], rounds: int) -> dict[str, float]:
    """Microseconds of each call: the 10th percentile of `rounds` of them, made in turn."""
    times: dict[str, list[int]] = {name: [] for name in calls}
    for call in [*calls.values()] * 20:  # warm up
        call()
    for _ in range(rounds):
        for name, call in calls.items():
            start = time.perf_counter_ns()
            call()
            times[name].append(time.perf_counter_ns() - start)
    return {name: sorted(taken)[len(taken) * PERCENTILE // 100] / 1e3 for name, taken in times.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--dialects", nargs="+", choices=dialects.DIALECTS, default=dialects.DIALECTS, metavar="NAME")
    parser.add_argument("--rounds", type=int, default=3000, help="calls of each (default: %(default)s)")
    args = parser.parse_args()
    torch.set_num_threads(1)
    print(f"{GAUSSIANS} Gaussians, {SIZE}x{SIZE} pixels, one thread; {describe_machine('cpu')}\n")
    print("| dialect | render, us | over the library, us | make settings, us | over the library, us |")
    print("|---|---|---|---|---|")
    for name in args.dialects:
        found = measure(calls_of(name), args.rounds)
        own, library, own_settings, library_settings = found.values()
        print(
            f"| {name} | {own:.1f} | {own - library:.1f} | {own_settings:.1f} | {own_settings - library_settings:.1f} |"
        )


if __name__ == "__main__":
    main()
