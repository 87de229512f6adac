"""Launches every CUDA kernel on scenes so small that compute-sanitizer ends within minutes.

    python tests/every_kernel.py [PART ...]
    PYTORCH_NO_CUDA_MEMORY_CACHING=1 compute-sanitizer [--tool racecheck] python tests/every_kernel.py [PART ...]

The parts are the footprints, and the others at the end of this file. Each footprint is rendered forward and backward
in images of several kinds, which have different kernels. With all parts the program fails if the library has an
operator that was not called, or a kernel that was not launched; the names of kernels are in the file of the library.
For a new operator, write a part that calls it, with all that chooses between its kernels. Without torch's cache of
memory every tensor is its own allocation, so that memcheck notices accesses beyond it. Nothing is compared here: the
other tests do that.
"""

from __future__ import annotations

import argparse
import re
import sys
import tempfile
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import torch
from torch.utils._python_dispatch import TorchDispatchMode

import analytic_rasterizer as ar
from analytic_rasterizer import _C
from analytic_rasterizer.activations import activate
from analytic_rasterizer.dialects.gsplat import rasterization
from analytic_rasterizer.losses import l1_ssim, ssim
from analytic_rasterizer.optim import FusedAdam
from analytic_rasterizer.render.order import footprints_along_rays

sys.path[:0] = [str(Path(__file__).parent / folder) for folder in ("makers", "distributed")]

import scenes  # noqa: E402


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
# after the front, and several segments; lists of kLongList pairs or more (csrc/cuda/moment/policy.h) are cut in large
# images too, and alone in small ones with 16 cells, and have their own layout. Where Gaussians are opaque, pixels
# close (so little light is left that 3DGS stops) before their lists end.
# test_every_kernel_has_images_that_need_it in test_benchmarks.py asserts all this.
IMAGES = {
    "large": Image(512, 512, 600),
    "large, few tiles": Image(520, 520, 7000, opacity=(0.004, 0.2), sigma=(0.001, 0.01), spread=0.005, around=900),
    "large, opaque": Image(512, 512, 1500, opacity=(0.3, 0.99), sigma=(0.02, 0.1), spread=0.3),
    "small": Image(20, 15, 7000, spread=0.2),
    "small, opaque": Image(24, 18, 1000, opacity=(0.3, 0.99), sigma=(0.1, 0.5)),
    "pixel": Image(1, 1, 300),
}
LARGEST = Image(1024, 1024, 600)


def render(
    device: str, channels: int = 3, images: Sequence[str] = tuple(IMAGES), absolute: bool = False, **settings
) -> None:
    """Pictures of random scenes and all of their gradients; with `absolute` also sums of absolute gradients."""
    for image in map((IMAGES | {"largest": LARGEST}).get, images):
        leaves = scenes.leaves(image.scene(device))
        if channels != 3:
            del leaves["shs"]
            count = len(leaves["means3D"])
            leaves["colors_precomp"] = torch.rand(count, channels, device=device, requires_grad=True)
        if absolute:
            leaves["means2D"] = torch.zeros(len(leaves["means3D"]), 4, device=device, requires_grad=True)
        fields = image.camera().fields(torch.float32, device)
        fields |= {"sh_degree": 3, "bg": torch.zeros(channels, device=device)}
        rasterizer = ar.GaussianRasterizer(ar.GaussianRasterizationSettings(**fields, **settings))
        with torch.no_grad():
            rasterizer(**leaves)
        color, _, *outputs = rasterizer(**leaves)
        made = [color, *(v for v in (outputs[0] if outputs else ()) if torch.is_tensor(v) and v.requires_grad)]
        sum(of_output.sum() for of_output in made).backward()


# Lists that are cut and lists that are not, in large and in small images.
FEW_IMAGES = ("large, few tiles", "small", "small, opaque")


def footprint(device: str, images: Sequence[str] = FEW_IMAGES, **settings) -> None:
    """Every number of channels that has its own kernels, with and without sums of absolute gradients, and all looks."""
    render(device, images=IMAGES if images is FEW_IMAGES else images, **settings)
    for channels in (1, 40):
        render(device, channels=channels, images=images, **settings)
    for channels in (3, 1, 70):  # 32, 32 and 8: with these sums later groups have their own kernels
        render(device, channels=channels, images=images[-2:], absolute=True, **settings)
    for name in _C.SUMMARIES:
        render(device, images=images, effects=ar.Effects(**{name: True}), **settings)


def many_channels(device: str) -> None:
    for count in (1, 5, 32, 70):
        for name in ("box:samples=4", "box:samples=16", "analytic"):
            render(device, channels=count, images=FEW_IMAGES, footprint=name)


def sorts(device: str) -> None:
    """Numbers of tiles that are sorted in one pass and in two, by digits of 7 and of 8 bits."""
    for side in (64, 240, 1024, 2400):
        image = Image(side, side, 300)
        settings = image.camera().settings(torch.float32, device, footprint="point")._replace(sh_degree=3)
        leaves = scenes.leaves(image.scene(device))
        with torch.no_grad():
            ar.GaussianRasterizer(settings)(**leaves)
        ar.GaussianRasterizer(settings)(**leaves)[0].sum().backward()


def weights(device: str) -> None:
    for name, options in scenes.VARIANTS:
        for dtype in (torch.float32, torch.float64):
            offset = torch.rand(300, 2, dtype=dtype, device=device, requires_grad=True)
            cov2d = torch.tensor([1.0, 0.2, 0.7], dtype=dtype, device=device).repeat(300, 1).requires_grad_()
            ar.footprint_weight(offset, cov2d, name, **options).sum().backward()


def stages(device: str) -> None:
    """Two cameras in a batch, plain ones and others, each stage by itself; three channels in splats and in rows."""
    image = IMAGES["small"]
    for footprint, effects in (
        ("box:samples=1", None),
        ("box:samples=1", ar.Effects(defocus=ar.Defocus(aperture=0.1, focus=3.0))),
        ("moment:samples=16", None),
    ):
        settings = image.camera().settings(torch.float32, device, footprint=footprint, effects=effects)
        leaves = scenes.leaves(image.scene(device))
        del leaves["means2D"]
        ar.render_stages(settings._replace(sh_degree=3), **leaves)
        splats = ar.project([settings._replace(sh_degree=3)] * 2, **leaves)
        for features in (
            None,
            torch.rand(len(splats.depths), 3, device=device, requires_grad=True),
            torch.rand(len(splats.depths), 6, device=device),
        ):
            ar.blend(splats, ar.list_tiles(splats), features)[0].sum().backward(retain_graph=True)
        one, looks = splats.split()[0], dict.fromkeys(_C.SUMMARIES, True)
        lists = list(ar.list_tiles(one, keep=False).tensors)
        torch.ops.analytic_rasterizer.inspect(lists, one.depths.detach(), **one.size, **looks)


def gsplat(device: str) -> None:
    """Rows of both layouts to images, of few channels and of many."""
    means, quats, scales = (torch.rand(300, n, device=device).requires_grad_() for n in (3, 4, 3))
    opacities, harmonics = torch.rand(300, device=device), torch.rand(300, 4, 3, device=device).requires_grad_()
    poses = torch.eye(4, device=device).repeat(2, 1, 1)
    poses[:, 2, 3] = 3
    intrinsics = torch.tensor([[40.0, 0, 24], [0, 40, 20], [0, 0, 1]], device=device).repeat(2, 1, 1)
    for colors, options in (
        (harmonics, {"sh_degree": 1, "render_mode": "RGB+ED"}),
        (harmonics, {"sh_degree": 1, "absgrad": True}),
        (torch.rand(300, 40, device=device), {"camera_model": "fisheye"}),
    ):
        for packed in (True, False):
            given = (means, quats, 0.1 * scales, opacities, colors, poses, intrinsics, 48, 40)
            rasterization(*given, packed=packed, **options)[0].sum().backward()


def rows(device: str) -> None:
    """Packed rows, which ranks send to each other, of plain cameras and others."""
    from test_distributed import CAMERAS, UNSEEING, calls_of

    for camera in range(len(CAMERAS)):
        for name, arguments in calls_of(device, camera).items() if camera != UNSEEING else ():
            getattr(torch.ops.analytic_rasterizer, name)(**arguments)


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
        ar.Effects(lens=ar.Lens.equirectangular()),
    ):
        render(device, footprint="box:samples=4", effects=each)
        render(device, footprint="moment:samples=4", effects=each)


def rays(device: str) -> None:
    """The order along rays, with a pinhole and a lens, three channels in splats and in rows, and by stages."""
    for footprint in footprints_along_rays():
        for effects in (
            ar.Effects(order="ray"),
            ar.Effects(order="ray", depth=True, lens=ar.Lens.fisheye([0.05])),
        ):
            render(device, images=("small", "small, opaque", "pixel"), footprint=footprint, effects=effects)
    image = IMAGES["small"]
    for effects in (ar.Effects(order="ray"), ar.Effects(order="ray", lens=ar.Lens.fisheye([0.05]))):
        settings = image.camera().settings(torch.float32, device, footprint="box:samples=1", effects=effects)
        leaves = scenes.without(scenes.leaves(image.scene(device)), "means2D")
        splats = ar.project(settings._replace(sh_degree=3), **leaves)
        ar.blend(splats, ar.list_tiles(splats))[0].sum().backward()


def cameras(device: str) -> None:
    """Prepared and differentiated, with limits of lenses found on the device."""
    ops = torch.ops.analytic_rasterizer
    for dtype in (torch.float32, torch.float64):
        views, intrinsics = (torch.eye(n, dtype=dtype, device=device).repeat(2, 1, 1).requires_grad_() for n in (4, 3))
        coefficients = torch.zeros(2, 12, dtype=dtype, device=device).requires_grad_()
        made = ops.prepare_cameras(views, intrinsics, coefficients, 60, 50, "fisheye", 0.2, 9.0)
        sum(t[..., :26].sum() for t in made).backward()
        numbers = made[3][0].tolist()
        numbers[-3:-1] = [0.0, 0.0]  # reach and fold, to be found
        leaves = [t[0].detach().requires_grad_() for t in made[:2]]
        for lens in (None, coefficients[0].detach().requires_grad_()):
            ops.prepare_lens(*leaves, *[None] * 7, lens, numbers, 50, True).sum().backward()


def losses(device: str) -> None:
    for size in ((3, 70, 90), (1, 5, 3)):
        for dtype in (torch.float32, torch.float64):
            image = torch.rand(size, dtype=dtype, device=device, requires_grad=True)
            for target in (torch.rand_like(image).detach(), (255 * torch.rand(size, device=device)).to(torch.uint8)):
                (l1_ssim(image, target) + ssim(image, target, "none").mean()).backward()


def steps(device: str) -> None:
    """What a training step has besides pictures, in both precisions."""
    for dtype in (torch.float32, torch.float64):
        numbers = {"dtype": dtype, "device": device}
        leaves = [torch.rand(300, width, **numbers).requires_grad_() for width in (3, 4, 1)]
        sum(made.sum() for made in activate(*leaves)).backward()
        sum(made.sum() for made in torch.ops.analytic_rasterizer.activate(*leaves, 0.1, 0.2)).backward()
        FusedAdam(leaves).step()
        ops, count = torch.ops.analytic_rasterizer, len(leaves[0])
        filtered = ops.apply_3d_filter(leaves[0], leaves[2], torch.rand(count, **numbers))
        sum(made.sum() for made in filtered).backward()
        log_scales, quats, logits = (leaf.detach() for leaf in leaves)
        ops.add_noise_(
            torch.zeros(count, 3, **numbers), log_scales, quats, logits, torch.rand(count, 3, **numbers), 0.1
        )
        matrix = torch.eye(3, 4, **numbers).requires_grad_()
        torch.ops.analytic_rasterizer.correct_colors(torch.rand(3, 50, 60, **numbers), matrix).sum().backward()
        dark = {"vignetting": torch.zeros(2, **numbers).requires_grad_(), "center": [30.0, 25.0]}
        torch.ops.analytic_rasterizer.correct_colors(torch.rand(3, 50, 60, **numbers), matrix, **dark).sum().backward()
        sums, views = torch.zeros(300, **numbers), torch.zeros(300, dtype=torch.int32, device=device)
        radii = torch.ones(300, dtype=torch.int32, device=device)
        torch.ops.analytic_rasterizer.observe_(sums, views, torch.rand(300, 3, **numbers), radii, 0)


def training(device: str) -> None:
    """Steps in one op, which activate, observe and move the parameters."""
    from capture_files import circle, write_nerf_synthetic

    from analytic_rasterizer.training import Run, TrainingOptions

    options = {"iterations": 25, "densify_every": 10, "densify_from": 5, "random_points": 500, "scales": (1, 2)}
    with tempfile.TemporaryDirectory() as folder:
        write_nerf_synthetic(Path(folder) / "capture", circle(3), circle(1))
        Run(f"{folder}/capture", f"{folder}/out", TrainingOptions(**options), device=device).train()


PARTS = {scenes.name_of(variant): partial(footprint, footprint=variant[0], **variant[1]) for variant in scenes.VARIANTS}
PARTS |= {"largest": partial(footprint, images=("large", "largest"), footprint="box:samples=4")}
PARTS |= {"channels": many_channels, "pairs": too_many_pairs, "sorts": sorts, "stages": stages, "weights": weights}
PARTS |= {"cameras": cameras, "effects": effects, "gsplat": gsplat, "losses": losses, "rays": rays, "rows": rows}
PARTS |= {"steps": steps, "training": training}


def kernels_of_library() -> set[str]:
    """Mangled names of the kernels in the library, which registers them with CUDA by these names."""
    names = re.findall(rb"(?<=\0)_ZN2ar4cuda[A-Za-z0-9_]*kernel[A-Za-z0-9_]*(?=\0)", Path(_C.__file__).read_bytes())
    return {name.decode() for name in names}


class OpsCalled(TorchDispatchMode):
    """Names of the operators of this package that are called."""

    def __init__(self):
        super().__init__()
        self.names = set()

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        if func.namespace == "analytic_rasterizer":
            self.names.add(func._schema.name.split("::")[1])
        return func(*args, **(kwargs or {}))


def registered_ops() -> set[str]:
    names = (name.split(".")[0].split("::") for name in torch._C._dispatch_get_all_op_names())
    return {name for namespace, name in names if namespace == "analytic_rasterizer"}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("parts", nargs="*", default=list(PARTS), metavar="PART", help=", ".join(PARTS))
    parser.add_argument("--device", default="cuda")
    args = parser.parse_args()
    on_cuda = args.device == "cuda"
    if on_cuda:
        _C.record_kernels(True)
    called = OpsCalled()
    for name in args.parts:
        with called:
            PARTS[name](args.device)
        if on_cuda:
            torch.cuda.synchronize()
        print(name, flush=True)
    everything = set(args.parts) == set(PARTS)
    if everything and registered_ops() - called.names:
        sys.exit("\n".join(["not called:", *sorted(registered_ops() - called.names)]))
    if not on_cuda:
        return
    known, launched = kernels_of_library(), set(_C.launched_kernels())
    _C.record_kernels(False)
    print(f"{len(launched & known)} of {len(known)} kernels were launched")
    if launched - known or (known - launched and everything):
        sys.exit("\n".join(["not launched:", *sorted(known - launched), "unknown:", *sorted(launched - known)]))


if __name__ == "__main__":
    main()
