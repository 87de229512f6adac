"""Trains 3D Gaussians at several resolutions with one footprint after another, and compares them.

    python examples/train_lego.py DATA --out DIR [--footprints point mip analytic ...] [--steps 3000]

DATA is a scene of the NeRF-synthetic set: transforms_train.json, transforms_test.json and the RGBA PNGs
they name. It needs pillow and tqdm (`pip install analytic_rasterizer[cli]`); with torchmetrics the SSIM
of the table is its, otherwise the one of the loss.

Data at several scales are made as the multi-scale Blender set makes them: the stored straight RGBA
values are averaged over 2x2 px again and again, then composited on white; the field of view stays. Every
step renders a random training view at a random scale. All footprints start from the same random
Gaussians and see the same views in the same order. Learning rates are those of 3DGS; its densification
is left out, so that what differs is the footprint alone: PSNR is well below that of a full trainer.

DIR receives results.json, with the loss of every step, and pictures/FOOTPRINT_SCALE_VIEW.png, each the
rendering on the left and the truth on the right.
"""

from __future__ import annotations

import argparse
import json
import math
import re
import statistics
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from PIL import Image
from torch import Tensor
from torch.nn import functional
from tqdm import tqdm

import analytic_rasterizer as ar
from analytic_rasterizer import io
from analytic_rasterizer.cli import format_table

try:
    from torchmetrics.functional.image import structural_similarity_index_measure as metric_ssim
except ImportError:
    metric_ssim = None

FOOTPRINTS = ["point", "mip", "analytic", "cumulant", "box:samples=1", "box:samples=4"]
WHITE = (1.0, 1.0, 1.0)
HALF_EDGE = 1.3  # of the cube of random points; NeRF-synthetic objects fit in it
SH_C0 = 0.28209479177387814  # value of the constant spherical harmonic
SH_PERIOD = 500  # steps between degrees
CHECK_PERIOD = 100  # steps between looks at the loss, each of which waits for the device
MEANS_RATE, FINAL_MEANS_RATE = 1.6e-4, 1.6e-6  # per unit of the scene's extent
RATES = {"sh_dc": 2.5e-3, "sh_rest": 1.25e-4, "logit_opacities": 0.05, "log_scales": 5e-3, "rotations": 1e-3}


def main() -> None:
    args = parse_arguments()
    torch.backends.cudnn.allow_tf32 = False  # the variances of SSIM are small differences
    out = Path(args.out)
    (out / "pictures").mkdir(parents=True, exist_ok=True)
    train_set = load_split(args.data, "train", args.scales, args.device)
    test_set = load_split(args.data, "test", args.scales, args.device)
    start = random_gaussians(args.gaussians, args.sh_degree, args.seed, args.device)
    schedule = random_schedule(len(train_set.views), args.scales, args.steps, args.seed)

    report = {
        "device": describe_device(args.device),
        "torch": torch.__version__,
        "arguments": vars(args),
        "ssim": "own" if metric_ssim is None else "torchmetrics",
        "results": {},
    }
    for footprint in args.footprints:
        gaussians, result = train(start, train_set, schedule, footprint, args)
        result.update(evaluate(gaussians, test_set, footprint, args.sh_degree))
        save_pictures(out / "pictures", gaussians, test_set, footprint, args)
        report["results"][footprint] = result
        (out / "results.json").write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    print(f"{args.gaussians} Gaussians, {args.steps} steps, {report['device']}, torch {torch.__version__}")
    print(format_results(report["results"], args.scales))


def parse_arguments() -> argparse.Namespace:
    has_cuda = torch.cuda.is_available() and ar._C.has_cuda
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("data", metavar="DATA", help="folder of a NeRF-synthetic scene")
    parser.add_argument("--out", required=True, metavar="DIR", help="folder for the results")
    parser.add_argument("--footprints", nargs="+", default=FOOTPRINTS, metavar="NAME[:k=v]")
    parser.add_argument("--steps", type=int, default=3000)
    parser.add_argument("--gaussians", type=int, default=100_000)
    parser.add_argument(
        "--scales", type=int, nargs="+", default=[1, 2, 4, 8], help="reductions, powers of two (default: 1 2 4 8)"
    )
    parser.add_argument("--sh-degree", type=int, choices=range(4), default=3)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--pictures", type=int, default=2, help="views to draw per footprint and scale (default: 2)")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cuda" if has_cuda else "cpu")
    args = parser.parse_args()
    if args.device == "cuda" and not has_cuda:
        parser.error("--device cuda: no CUDA device, or analytic_rasterizer was built without CUDA")
    if min(args.steps, args.scales[0]) < 1 or args.gaussians < 4:
        parser.error("--steps must be at least 1, --gaussians at least 4")
    if any(scale < 1 or scale & (scale - 1) for scale in args.scales):
        parser.error(f"--scales must be powers of two, got {args.scales}")
    return args


def describe_device(device: str) -> str:
    return torch.cuda.get_device_name() if device == "cuda" else f"CPU, {torch.get_num_threads()} threads"


def format_results(results: dict[str, dict], scales: list[int]) -> str:
    header = ["footprint", *(f"PSNR 1/{scale}" for scale in scales), "mean", "SSIM mean", "training s", "ms/step"]
    rows = [
        [
            name,
            *(f"{psnr:.2f}" for psnr in r["psnr"].values()),
            f"{statistics.mean(r['psnr'].values()):.2f}",
            f"{statistics.mean(r['ssim'].values()):.4f}",
            f"{r['seconds']:.1f}",
            f"{r['ms_per_step']:.2f}",
        ]
        for name, r in results.items()
    ]
    return format_table(header, rows)


# ---------------------------------------------------------------------------------------- data


class Split(NamedTuple):
    """Views and their pictures, all of them on the device."""

    views: list[io.View]
    settings: dict[int, list[ar.GaussianRasterizationSettings]]  # by scale; made once, they hold tensors
    pictures: dict[int, Tensor]  # by scale: (views, 3, height, width) uint8

    def truth(self, scale: int, view: int) -> Tensor:
        """(3, height, width) float32 in [0, 1]."""
        return self.pictures[scale][view].float() / 255


def load_split(folder: str, name: str, scales: list[int], device: str) -> Split:
    """The views and pictures of transforms_NAME.json."""
    path = Path(folder) / f"transforms_{name}.json"
    views = io.load_views(path)
    frames = json.loads(path.read_text(encoding="utf-8"))["frames"]
    with ThreadPoolExecutor() as pool:
        rgba = list(pool.map(read_rgba, (picture_path(path.parent, frame["file_path"]) for frame in frames)))
    levels = [reduce(picture.to(device), scales) for picture in rgba]
    pictures = {scale: torch.stack([level[scale] for level in levels]) for scale in scales}
    settings = {scale: [view.settings(1 / scale, WHITE, device=device) for view in views] for scale in scales}
    for scale in scales:
        height, width = pictures[scale].shape[2:]
        if any((s.image_height, s.image_width) != (height, width) for s in settings[scale]):
            raise io.SceneError(f"{path}: pictures must all have the size of their views and halve evenly")
    return Split(views, settings, pictures)


def picture_path(folder: Path, name: str) -> Path:
    path = folder / name
    return path if path.suffix else path.with_suffix(".png")


def read_rgba(path: Path) -> Tensor:
    """(height, width, 4) uint8, straight alpha."""
    with Image.open(path) as image:
        return torch.from_numpy(np.array(image.convert("RGBA")))


def reduce(rgba: Tensor, scales: list[int]) -> dict[int, Tensor]:
    """The picture at each scale on white, (3, height, width) uint8."""
    level = rgba.permute(2, 0, 1).float() / 255
    made = {}
    for halvings in range(int(math.log2(max(scales))) + 1):
        if halvings:
            level = functional.avg_pool2d(level, 2)
        color, alpha = level[:3], level[3:]
        made[2**halvings] = (255 * (color * alpha + 1 - alpha)).round().to(torch.uint8)
    return {scale: made[scale] for scale in scales}


def random_schedule(views: int, scales: list[int], steps: int, seed: int) -> list[tuple[int, int]]:
    """The view and scale of each step."""
    generator = torch.Generator().manual_seed(seed)
    chosen_views = torch.randint(views, (steps,), generator=generator).tolist()
    chosen_scales = torch.randint(len(scales), (steps,), generator=generator).tolist()
    return [(view, scales[scale]) for view, scale in zip(chosen_views, chosen_scales)]


def extent_of(views: list[io.View]) -> float:
    """The radius around the cameras that 3DGS scales the learning rate of the means by."""
    centers = torch.stack([torch.linalg.inv(view.w2c)[:3, 3] for view in views])
    return 1.1 * (centers - centers.mean(0)).norm(dim=1).max().item()


# ----------------------------------------------------------------------------------- Gaussians


class Gaussians(NamedTuple):
    """What is trained: unconstrained parameters, one row each."""

    means: Tensor  # (P, 3)
    log_scales: Tensor  # (P, 3)
    rotations: Tensor  # (P, 4)
    logit_opacities: Tensor  # (P, 1)
    sh_dc: Tensor  # (P, 1, 3)
    sh_rest: Tensor  # (P, K - 1, 3)

    def render(self, settings: ar.GaussianRasterizationSettings) -> Tensor:
        """(3, height, width)."""
        color, _ = ar.GaussianRasterizer(settings)(
            means3D=self.means,
            means2D=None,
            opacities=self.logit_opacities.sigmoid(),
            shs=torch.cat([self.sh_dc, self.sh_rest], dim=1),
            scales=self.log_scales.exp(),
            rotations=self.rotations,
        )
        return color


def random_gaussians(count: int, sh_degree: int, seed: int, device: str) -> Gaussians:
    """Round Gaussians of random colours, about as large as the gaps between them."""
    generator = torch.Generator().manual_seed(seed)
    means = (HALF_EDGE * (2 * torch.rand(count, 3, generator=generator) - 1)).to(device)
    colors = torch.rand(count, 1, 3, generator=generator).to(device)
    return Gaussians(
        means,
        neighbour_distance(means).log()[:, None].repeat(1, 3),
        torch.tensor([[1.0, 0, 0, 0]], device=device).repeat(count, 1),
        torch.full((count, 1), 0.1, device=device).logit(),
        (colors - 0.5) / SH_C0,
        torch.zeros(count, (sh_degree + 1) ** 2 - 1, 3, device=device),
    )


def neighbour_distance(points: Tensor, neighbours: int = 3, rows: int = 1024) -> Tensor:
    """Mean distance of each point to its nearest neighbours, (P,)."""
    means, points = [], points.double()  # cdist multiplies matrices: float32 would lose near neighbours
    for chunk in points.split(rows):
        distances = torch.cdist(chunk, points)
        nearest = distances.topk(neighbours + 1, largest=False).values
        means.append(nearest[:, 1:].mean(1))  # the nearest is the point itself
    return torch.cat(means).float().clamp_min(1e-7)


# ------------------------------------------------------------------------------------ training


def train(
    start: Gaussians, split: Split, schedule: list[tuple[int, int]], footprint: str, args: argparse.Namespace
) -> tuple[Gaussians, dict]:
    """Trains a copy of `start`.

    Nothing in a step waits for the device; losses stay on it until they are looked at.

    Raises FloatingPointError when the loss is not finite.
    """
    gaussians = Gaussians(*(field.clone().requires_grad_() for field in start))
    extent = extent_of(split.views)
    optimizer = torch.optim.Adam(
        [{"params": [gaussians.means], "lr": MEANS_RATE * extent}]
        + [{"params": [getattr(gaussians, name)], "lr": rate} for name, rate in RATES.items()],
        eps=1e-15,
        fused=args.device == "cuda",
    )
    losses = torch.zeros(len(schedule), device=args.device)
    degree, settings = None, {}
    clock = StepClock(args.device)
    with tqdm(total=len(schedule), desc=footprint, unit="step", disable=None) as progress:
        for step, (view, scale) in enumerate(schedule):
            if degree != (wanted := min(step // SH_PERIOD, args.sh_degree)):
                degree, settings = wanted, resolve_settings(split, footprint, wanted)
            optimizer.param_groups[0]["lr"] = extent * decayed_rate(step / len(schedule))
            image = gaussians.render(settings[scale][view])
            truth = split.truth(scale, view)
            loss = 0.8 * (image - truth).abs().mean() + 0.2 * (1 - ssim(image, truth))
            optimizer.zero_grad(set_to_none=True)
            loss.backward()
            optimizer.step()
            losses[step] = loss.detach()
            clock.tick()
            done = step + 1
            if done % CHECK_PERIOD == 0 or done == len(schedule):
                checked = (done - 1) // CHECK_PERIOD * CHECK_PERIOD
                check_losses(losses[checked:done], checked, footprint)
                progress.update(done - progress.n)
    seconds, ms_per_step = clock.read()
    trained = Gaussians(*(field.detach() for field in gaussians))
    return trained, {"seconds": seconds, "ms_per_step": ms_per_step, "loss": losses.tolist()}


def resolve_settings(split: Split, footprint: str, sh_degree: int) -> dict[int, list]:
    """The split's settings with this footprint and degree, by scale and view."""
    return {
        scale: [s._replace(footprint=footprint, sh_degree=sh_degree) for s in of_scale]
        for scale, of_scale in split.settings.items()
    }


def decayed_rate(progress: float) -> float:
    """Learning rate of the means, falling exponentially as `progress` goes from 0 to 1."""
    return MEANS_RATE * (FINAL_MEANS_RATE / MEANS_RATE) ** progress


def check_losses(losses: Tensor, first: int, footprint: str) -> None:
    bad = losses.isfinite().logical_not().nonzero()
    if len(bad):
        raise FloatingPointError(f"{footprint}: the loss is not finite from step {first + bad[0].item()} on")


class StepClock:
    """Wall time of all steps and the median of one, on CUDA by events, which do not wait."""

    def __init__(self, device: str):
        self.cuda = device == "cuda"
        self.marks = []
        self._wait()
        self.start = time.perf_counter()
        self.tick()

    def tick(self) -> None:
        if self.cuda:
            event = torch.cuda.Event(enable_timing=True)
            event.record()
            self.marks.append(event)
        else:
            self.marks.append(time.perf_counter())

    def read(self) -> tuple[float, float]:
        """Seconds in all, milliseconds of the median step."""
        self._wait()
        seconds = time.perf_counter() - self.start
        pairs = zip(self.marks, self.marks[1:])
        return seconds, statistics.median(a.elapsed_time(b) if self.cuda else 1e3 * (b - a) for a, b in pairs)

    def _wait(self) -> None:
        if self.cuda:
            torch.cuda.synchronize()


# --------------------------------------------------------------------------------- comparison


def ssim(image: Tensor, truth: Tensor) -> Tensor:
    """Structural similarity of two (3, H, W) images in [0, 1]: Gaussian window of 11 px, zeros outside,
    as in the loss of 3DGS."""
    moments = torch.stack([image, truth, image * image, truth * truth, image * truth])
    mean_x, mean_y, xx, yy, xy = blur(moments)
    variance_x, variance_y, covariance = xx - mean_x**2, yy - mean_y**2, xy - mean_x * mean_y
    c1, c2 = 0.01**2, 0.03**2
    similarity = (2 * mean_x * mean_y + c1) * (2 * covariance + c2)
    return (similarity / ((mean_x**2 + mean_y**2 + c1) * (variance_x + variance_y + c2))).mean()


def blur(images: Tensor, radius: int = 5, sigma: float = 1.5) -> Tensor:
    """(N, 3, H, W) convolved with a Gaussian, rows and columns in turn."""
    x = torch.arange(-radius, radius + 1, device=images.device, dtype=images.dtype)
    weights = torch.softmax(-(x**2) / (2 * sigma**2), dim=0).repeat(3, 1)
    images = functional.conv2d(images, weights[:, None, None, :], padding=(0, radius), groups=3)
    return functional.conv2d(images, weights[:, None, :, None], padding=(radius, 0), groups=3)


@torch.no_grad()
def evaluate(gaussians: Gaussians, split: Split, footprint: str, sh_degree: int) -> dict:
    """PSNR [dB] and SSIM by scale, means over views."""
    psnr, similarity = {}, {}
    for scale, of_scale in resolve_settings(split, footprint, sh_degree).items():
        errors, similarities = [], []
        for view, settings in enumerate(of_scale):
            image = gaussians.render(settings).clamp(0, 1)
            truth = split.truth(scale, view)
            errors.append((image - truth).square().mean())
            similarities.append(
                ssim(image, truth) if metric_ssim is None else metric_ssim(image[None], truth[None], data_range=1.0)
            )
        psnr[scale] = (-10 * torch.stack(errors).log10()).mean().item()
        similarity[scale] = torch.stack(similarities).mean().item()
    return {"psnr": psnr, "ssim": similarity}


@torch.no_grad()
def save_pictures(folder: Path, gaussians: Gaussians, split: Split, footprint: str, args: argparse.Namespace) -> None:
    """The rendering beside the truth, for views spread over the split."""
    count = min(args.pictures, len(split.views))
    name = re.sub(r"\W+", "_", footprint)
    for scale, of_scale in resolve_settings(split, footprint, args.sh_degree).items():
        for view in (i * len(split.views) // count for i in range(count)):
            pair = torch.cat([gaussians.render(of_scale[view]), split.truth(scale, view)], dim=2)
            io.to_image(pair).save(folder / f"{name}_{scale}_{split.views[view].name}.png")


if __name__ == "__main__":
    main()
