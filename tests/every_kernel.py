"""Launches the CUDA kernels on scenes so small that compute-sanitizer ends within minutes.

    PYTORCH_NO_CUDA_MEMORY_CACHING=1 compute-sanitizer [--tool racecheck] python tests/every_kernel.py [PART ...]

The parts are the footprints, and those at the end of this file. Each is rendered forward and backward in images of
several kinds, which have different kernels. Without torch's cache of memory every tensor is an allocation of its own,
so that memcheck notices what reaches beyond one. Nothing is compared here: the other tests do that.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import scenes
import torch

import analytic_rasterizer as ar
from analytic_rasterizer import _C
from analytic_rasterizer.losses import l1_ssim, ssim


class Image(NamedTuple):
    """Of so many Gaussians, faint ones unless said otherwise; the others as for `scenes.random_scene`. With `around`
    so many more, all over the picture."""

    width: int
    height: int
    count: int
    opacity: tuple[float, float] = (0.004, 0.05)
    sigma: tuple[float, float] = (0.01, 0.5)
    spread: float = 1.5
    around: int = 0

    def camera(self) -> scenes.Camera:
        return scenes.Camera(image_width=self.width, image_height=self.height)

    def scene(self, device: str) -> dict[str, torch.Tensor]:
        numbers = {"opacity": self.opacity, "sigma": self.sigma, "spread": self.spread}
        scene = scenes.random_scene(1, self.count, degree=3, **numbers)
        around = scenes.random_scene(2, self.around, degree=3, opacity=self.opacity, spread=1.5)
        return scenes.cast({k: torch.cat([v, around[k]]) for k, v in scene.items()}, torch.float32, device)


# 512x512 pixels are 4096 tiles of 8x8: enough for the kernels of large images of `moment`. Those of `box` with four
# samples need 1024x1024, and only they are given so many. Lists of thousands of splats have chunks
# behind the front, and several segments; those of kLongList pairs or more (csrc/cuda/cut_lists.cuh) are cut in large
# images too, and alone in small ones with 16 cells, and have a layout of their own. Where Gaussians are opaque,
# pixels close (so little light is left that 3DGS stops) before their lists end.
# test_every_kernel_has_images_that_need_it in test_benchmarks.py asserts all this.
IMAGES = {
    "large": Image(512, 512, 600),
    "large, few tiles": Image(512, 512, 18000, opacity=(0.004, 0.2), sigma=(0.001, 0.02), spread=0.04, around=300),
    "large, opaque": Image(512, 512, 1500, opacity=(0.3, 0.99), sigma=(0.02, 0.1), spread=0.3),
    "small": Image(40, 30, 12000, spread=0.3),
    "small, opaque": Image(40, 30, 1000, opacity=(0.3, 0.99), sigma=(0.1, 0.5)),
    "pixel": Image(1, 1, 300),
}
LARGEST = Image(1024, 1024, 600)


def render(device: str, channels: int = 3, images: Sequence[str] = tuple(IMAGES), **settings) -> None:
    """Pictures of random scenes and all of their gradients."""
    for image in map((IMAGES | {"largest": LARGEST}).get, images):
        leaves = scenes.leaves(image.scene(device))
        if channels != 3:
            del leaves["shs"]
            count = len(leaves["means3D"])
            leaves["colors_precomp"] = torch.rand(count, channels, device=device, requires_grad=True)
        fields = image.camera().fields(torch.float32, device)
        fields |= {"sh_degree": 3, "bg": torch.zeros(channels, device=device)}
        rasterizer = ar.GaussianRasterizer(ar.GaussianRasterizationSettings(**fields, **settings))
        with torch.no_grad():
            rasterizer(**leaves)
        color, _, *outputs = rasterizer(**leaves)
        made = [color, *(v for v in (outputs[0] if outputs else ()) if torch.is_tensor(v) and v.requires_grad)]
        sum(of_output.sum() for of_output in made).backward()


def many_channels(device: str) -> None:
    for count in (1, 5, 32, 70):
        render(device, channels=count, images=(*IMAGES, "largest"), footprint="box:samples=4")
        render(device, channels=count, footprint="box:samples=16")
        render(device, channels=count, footprint="analytic")


def too_many_pairs(device: str) -> None:
    """On CUDA tiles share the lists of cells then."""
    if device == "cuda":
        _C.force_pair_capacity(64)
    try:
        for footprint, options in [*scenes.PATHS, ("moment", {"samples": 16}), ("box", {"samples": 16})]:
            render(device, images=("large", "small", "small, opaque"), footprint=footprint, **options)
    finally:
        if device == "cuda":
            _C.force_pair_capacity(0)


def effects(device: str) -> None:
    """Further images, and projections with more to them than a pinhole."""
    names = ("alpha", "depth", "inverse_depth", "median_depth", "dominant_index", "gaussian_stats")
    motion = ar.Motion(exposure=torch.tensor(0.1, device=device, requires_grad=True), velocity=(1.0, 0.0, 0.0))
    for each in (
        ar.Effects(**dict.fromkeys(names, True)),
        ar.Effects(defocus=ar.Defocus(aperture=0.1, focus=3.0), motion=motion, camera_gradients=True),
    ):
        render(device, footprint="box:samples=4", effects=each)
        render(device, footprint="moment:samples=4", effects=each)


def losses(device: str) -> None:
    for size in ((3, 70, 90), (1, 5, 3)):
        image = torch.rand(size, device=device, requires_grad=True)
        target = (255 * torch.rand(size, device=device)).to(torch.uint8)
        (l1_ssim(image, target) + ssim(image, target, "none").mean()).backward()


def training(device: str) -> None:
    """Steps in one op, which activate, observe and move the parameters."""
    from capture_files import circle, write_nerf_synthetic

    from analytic_rasterizer.training import Run, TrainingOptions

    options = {"iterations": 25, "densify_every": 10, "densify_from": 5, "random_points": 500, "scales": (1, 2)}
    with tempfile.TemporaryDirectory() as folder:
        write_nerf_synthetic(Path(folder) / "capture", circle(3), circle(1))
        Run(f"{folder}/capture", f"{folder}/out", TrainingOptions(**options), device=device).train()


PARTS = {scenes.name_of(variant): partial(render, footprint=variant[0], **variant[1]) for variant in scenes.RENDERED}
PARTS |= {"largest": partial(render, images=("largest",), footprint="box:samples=4")}
PARTS |= {"channels": many_channels, "pairs": too_many_pairs}
PARTS |= {"effects": effects, "losses": losses, "training": training}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("parts", nargs="*", default=list(PARTS), metavar="PART", help=", ".join(PARTS))
    parser.add_argument("--device", default="cuda")
    args = parser.parse_args()
    for name in args.parts:
        PARTS[name](args.device)
        if args.device == "cuda":
            torch.cuda.synchronize()
        print(name, flush=True)


if __name__ == "__main__":
    main()
