"""How far pictures are from the truth."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from statistics import mean
from typing import Any

import torch
from torch import Tensor

from .. import io
from ..analysis.reference import decibels
from ..captures.pictures import Pictures
from ..distributed.ranks import ALONE, Ranks
from ..gaussians import Gaussians
from ..losses import counted, ssim
from ..render.settings import GaussianRasterizationSettings
from .exposure import best_exposure, corrected
from .falloff import Known, falloff_of
from .rendering import render, render_together

LPIPS_WEIGHTS = {"vgg": "vgg16-397923af.pth", "alex": "alexnet-owt-7be5be79.pth"}  # of torchvision
ERROR_GAIN = 4  # of the pictures of errors
MEASURES = ("psnr", "ssim", "lpips")
COLOR_CORRECTED = "psnr_color_corrected"

Perceptual = Callable[[Tensor, Tensor], Tensor]


def psnr(image: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    """() peak signal-to-noise ratio, dB, of two images (C, H, W); of equal ones it is infinite.

    Args:
        image: Floats, which are clamped to [0, 1].
        target: In [0, 1], of the same dtype, or uint8, which is read as target / 255.
        mask: (H, W) in [0, 1]: the error of each pixel counts by it, and NaN is returned where nothing counts.
    """
    if target.dtype == torch.uint8:
        target = target.to(image.dtype) / 255
    return decibels(_mean((image.clamp(0, 1) - target).square(), mask))


def load_lpips(network: str, device: str | torch.device, like_3dgs: bool = False) -> Perceptual:
    """LPIPS of two (3, H, W) images in [0, 1], by torchmetrics, whose weights of the network must be there already.

    Args:
        network: "vgg" or "alex".
        device: Of the images.
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
    scene: Gaussians,
    pictures: Pictures,
    footprint: str,
    lpips: Perceptual | None = None,
    *,
    supersampling: int = 1,
    color_corrected: bool = False,
    falloffs: Sequence[Known] = (),
    ranks: Ranks = ALONE,
    **options: Any,
) -> dict[str, dict]:
    """PSNR [dB], SSIM and LPIPS of a scene against pictures, means over views.

    Args:
        scene: On the device of the pictures; of several ranks each has its part.
        pictures: From `load_pictures`.
        footprint: To render with.
        lpips: From `load_lpips`; None: left out.
        supersampling: As in `TrainingOptions`.
        color_corrected: Also measure "psnr_color_corrected", after the affine map of colours that is best for each
            picture, by least squares.
        falloffs: Cameras whose vignetting is known. Pictures of views of one of them have it before that map.
        ranks: Those that share the scene and the views. All of them get all results.
        **options: Further settings.

    Returns:
        Over what counts where pictures have masks; LPIPS of pictures times their masks. By scale, as text, and "mean"
        over scales: {"psnr", "ssim", "lpips"}. Scales also have "views", a list with the same for each view, and
        "measured", the number of views that the means are over: views of which nothing counts have NaN, and are left
        out. The mean of no view is NaN.

    Raises:
        ValueError: There are no pictures.
    """
    if not pictures.views:
        raise ValueError("pictures must have at least one view, got none")
    names = [*MEASURES[: 2 if lpips is None else 3], *([COLOR_CORRECTED] if color_corrected else [])]
    gaussians = scene.arguments()
    results: dict[str, dict] = {}
    for scale, settings in pictures.resolve(footprint=footprint, sh_degree=scene.sh_degree, **options).items():
        measured = {}
        for view, image in rendered(gaussians, settings, supersampling, ranks):
            pictures.expect((later, scale) for later in range(view, len(settings), ranks.world))
            mask = pictures.mask(scale, view)
            image, truth = image.clamp(0, 1), pictures.truth(scale, view)
            values = [psnr(image, truth, mask), _mean_ssim(image, truth, mask)]
            if lpips is not None:
                values.append(lpips(*counted(image, truth, mask)).reshape(()))
            if color_corrected:
                dark = vignetted(image, pictures.views[view], falloffs)
                values.append(psnr(corrected(dark, best_exposure(dark, truth, mask)), truth, mask))
            measured[view] = torch.stack(values)
            if mask is not None:
                measured[view] = torch.where(mask.any(), measured[view], math.nan)
        own = dict(zip(measured, torch.stack(list(measured.values())).tolist() if measured else []))
        of_views = {view: values for of_rank in ranks.exchange(own) for view, values in of_rank.items()}
        views = [dict(zip(names, of_views[view])) for view in range(len(settings))]
        known = sum(not math.isnan(of_view[names[0]]) for of_view in views)
        results[str(scale)] = _means(views, names) | {"measured": known, "views": views}
    pictures.close()
    results["mean"] = _means(list(results.values()), names)
    return results


def vignetted(image: Tensor, view: io.View, falloffs: Sequence[Known]) -> Tensor:
    """A rendered picture (3, H, W) as the camera of its view would show it; as it is where that is not known."""
    found = falloff_of(view, falloffs)
    if found is None:
        return image
    center = [c * n / length for c, n, length in zip(view.middle, image.shape[:0:-1], (view.width, view.height))]
    return corrected(image, None, image.new_tensor(found), center)


def _mean_ssim(image: Tensor, target: Tensor, mask: Tensor | None) -> Tensor:
    """Of the pixels that count, by their masks; where nothing counts both pictures are black for its windows."""
    if mask is None:
        return ssim(image, target)
    shown = (mask > 0).to(image.dtype)
    return _mean(ssim(*counted(image, target, shown), "none"), mask)


def _mean(values: Tensor, mask: Tensor | None) -> Tensor:
    """The mean of values (C, H, W), to which each pixel counts by its mask, once."""
    return values.mean() if mask is None else (values * mask).sum() / (len(values) * mask.sum())


def _means(rows: list[dict[str, Any]], names: list[str]) -> dict[str, float]:
    """Of the rows that have a value."""
    known = {name: [row[name] for row in rows if not math.isnan(row[name])] for name in names}
    return {name: mean(values) if values else math.nan for name, values in known.items()}


def measured_in_words(of_scale: dict[str, Any]) -> str:
    """How many views the means of a scale are over: "12 pictures", or "11 of 12 pictures, nothing counts in the
    others"."""
    known, count = of_scale["measured"], len(of_scale["views"])
    pictures = f"{count} picture{'s' * (count != 1)}"
    return pictures if known == count else f"{known} of {pictures}, nothing counts in the others"


def about_correction(exposures_vary: bool, vignetted: bool = False) -> str:
    """Why there are two numbers, in a line; the corrected one comes first where the training corrected photographs."""
    if vignetted:
        return (
            "test photographs keep exposure and vignetting, which no scene has: the number after the vignetting of "
            "their cameras and the best affine colour of each picture counts"
        )
    if exposures_vary:
        return (
            "test photographs keep their own exposures, which no scene has: the number after the best affine colour of "
            "each picture counts"
        )
    return (
        "the number after the best affine colour of each picture leaves out differences of exposure: it compares with "
        "trainings that correct them"
    )


def rendered(
    gaussians: dict[str, Tensor], settings: list[GaussianRasterizationSettings], supersampling: int, ranks: Ranks
) -> Iterator[tuple[int, Tensor]]:
    """Places in `settings` and pictures (3, H, W) of them; of several ranks they take turns.

    Args:
        gaussians: `Gaussians.arguments` of this rank.
    """
    if ranks.world == 1:
        for place, chosen in enumerate(settings):
            yield place, render(gaussians, chosen, supersampling=supersampling)[0]
        return
    for first in range(0, len(settings), ranks.world):
        batch = render_together(gaussians, settings[first : first + ranks.world], supersampling, group=ranks.group)
        for rendering in batch.renderings:
            yield first + rendering.camera, rendering.image


@torch.no_grad()
def save_pictures(
    folder: Path,
    scene: Gaussians,
    pictures: Pictures,
    footprint: str,
    count: int,
    *,
    supersampling: int = 1,
    ranks: Ranks = ALONE,
    **options: Any,
) -> list[Path]:
    """Truth, rendering, and their difference times ERROR_GAIN side by side, for `count` views spread over all. The
    difference counts by the mask.

    Args:
        folder: To write to.
        count: Of views, at most.
        scene, pictures, footprint, supersampling, ranks, options: As in `evaluate`. Each rank writes pictures of its
            own.

    Returns:
        The files, FOOTPRINT_SCALE_VIEW.png.
    """
    gaussians, name = scene.arguments(), re.sub(r"\W+", "_", footprint)
    count, files = min(count, len(pictures.views)), []
    chosen = [i * len(pictures.views) // count for i in range(count)]
    for scale, settings in pictures.resolve(footprint=footprint, sh_degree=scene.sh_degree, **options).items():
        of_scale = [folder / f"{name}_{scale}_{pictures.views[view].name}.png" for view in chosen]
        for place, image in rendered(gaussians, [settings[view] for view in chosen], supersampling, ranks):
            image, truth = image.clamp(0, 1), pictures.truth(scale, chosen[place])
            mask, error = pictures.mask(scale, chosen[place]), ERROR_GAIN * (image - truth).abs()
            row = torch.cat([truth, image, error if mask is None else error * mask], dim=2)
            io.save_image(of_scale[place], row)
        files += of_scale
    return files
