"""How far pictures are from the truth."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from statistics import mean
from typing import Any

import torch
from torch import Tensor

from .. import io
from ..losses import ssim
from .model import Activated
from .pictures import Pictures

LPIPS_WEIGHTS = {"vgg": "vgg16-397923af.pth", "alex": "alexnet-owt-7be5be79.pth"}  # of torchvision
ERROR_GAIN = 4  # of the pictures of errors
MEASURES = ("psnr", "ssim", "lpips")

Perceptual = Callable[[Tensor, Tensor], Tensor]


def psnr(image: Tensor, target: Tensor) -> Tensor:
    """Peak signal-to-noise ratio of two images in [0, 1], dB, after clamping the first."""
    return -10 * (image.clamp(0, 1) - target).square().mean().log10()


def load_lpips(network: str, device: str | torch.device, like_3dgs: bool = False) -> Perceptual:
    """LPIPS of two (3, H, W) images in [0, 1], by torchmetrics, whose weights of the network must be there already.

    Args:
        network: One of LPIPS_WEIGHTS.
        like_3dgs: Hand the network values in [0, 1], as 3DGS's program does, whose numbers papers compare with. The
            network was made for [-1, 1], to which values are scaled otherwise.

    Raises:
        ImportError: No torchmetrics or torchvision.
        io.SceneError: The weights are missing; the message says how to get them.
    """
    file = Path(torch.hub.get_dir()) / "checkpoints" / LPIPS_WEIGHTS[network]
    if not file.is_file():
        raise io.SceneError(
            f"LPIPS needs weights that are not there: download https://download.pytorch.org/models/{file.name} to "
            f"{file}"
        )
    try:
        import torchvision  # noqa: F401  (of torchmetrics; no extra names it, as its version must fit torch's)
    except (ImportError, RuntimeError) as error:  # a version for another torch raises RuntimeError
        raise ImportError(f"LPIPS needs torchvision, in the version that fits torch {torch.__version__}") from error
    module = io.optional_import("torchmetrics.image.lpip", "train")
    metric = module.LearnedPerceptualImagePatchSimilarity(network, normalize=not like_3dgs).to(device).eval()
    return lambda image, truth: metric(image[None].clamp(0, 1), truth[None])


@torch.no_grad()
def evaluate(
    scene: io.Scene,
    pictures: Pictures,
    footprint: str,
    lpips: Perceptual | None = None,
    *,
    supersampling: int = 1,
    **options: Any,
) -> dict[str, dict]:
    """PSNR [dB], SSIM and LPIPS of a scene against pictures, means over views.

    Args:
        scene: On the device of the pictures.
        lpips: From `load_lpips`; None: left out.
        supersampling: As in `TrainingOptions`.
        **options: Further settings.

    Returns:
        By scale, as text, and "mean" over scales: {"psnr", "ssim", "lpips"}; scales also have "views", a list with
        the same for each view.
    """
    gaussians = Activated(*scene[:5])
    results: dict[str, dict] = {}
    for scale, settings in pictures.resolve(footprint=footprint, sh_degree=scene.sh_degree, **options).items():
        measured = []
        for view, chosen in enumerate(settings):
            image = gaussians.render(chosen, supersampling=supersampling)[0].clamp(0, 1)
            truth = pictures.truth(scale, view)
            values = [psnr(image, truth), ssim(image, truth)]
            if lpips is not None:
                values.append(lpips(image, truth).reshape(()))
            measured.append(torch.stack(values))
        views = [dict(zip(MEASURES, values)) for values in torch.stack(measured).tolist()]
        results[str(scale)] = _means(views) | {"views": views}
    results["mean"] = _means([{k: v for k, v in of_scale.items() if k != "views"} for of_scale in results.values()])
    return results


def _means(rows: list[dict[str, float]]) -> dict[str, float]:
    return {key: mean(row[key] for row in rows) for key in rows[0]}


@torch.no_grad()
def save_pictures(
    folder: Path,
    scene: io.Scene,
    pictures: Pictures,
    footprint: str,
    count: int,
    *,
    supersampling: int = 1,
    **options: Any,
) -> list[Path]:
    """Truth, rendering, and their difference times ERROR_GAIN side by side, for `count` views spread over all.

    Returns:
        The files, FOOTPRINT_SCALE_VIEW.png.
    """
    gaussians, name = Activated(*scene[:5]), re.sub(r"\W+", "_", footprint)
    count, files = min(count, len(pictures.views)), []
    for scale, settings in pictures.resolve(footprint=footprint, sh_degree=scene.sh_degree, **options).items():
        for view in (i * len(pictures.views) // count for i in range(count)):
            image = gaussians.render(settings[view], supersampling=supersampling)[0].clamp(0, 1)
            truth = pictures.truth(scale, view)
            row = torch.cat([truth, image, ERROR_GAIN * (image - truth).abs()], dim=2)
            files.append(folder / f"{name}_{scale}_{pictures.views[view].name}.png")
            io.to_image(row).save(files[-1])
    return files
