"""What `bake` gains for a scene that was trained with `point`, measured without photographs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch

from ..cameras.camera import View
from ..filters import bake_dilation
from ..footprints import RECOMMENDED, Footprint
from ..gaussians import Gaussians
from ..render.rasterizer import GaussianRasterizer
from . import tables
from .reference import LARGEST_PSNR, finite_decibels

REDUCTIONS = (1, 2, 4, 8)
SMALLEST = 8  # px: smaller pictures say nothing


@dataclass(frozen=True)
class BakeGain:
    """PSNR [dB] by reduction of the views, against the pictures of the training averaged over squares of pixels.

    Attributes:
        footprint: What the scene was trained with.
        reductions: 1 is the size of the views, 2 half of it.
        unbaked: Of the scene as it is, with this footprint; at reduction 1 these are the pictures of the training.
        baked: Of the baked scene, with RECOMMENDED.
    """

    footprint: str
    reductions: tuple[int, ...]
    unbaked: tuple[float, ...]
    baked: tuple[float, ...]

    def to_text(self) -> str:
        """A sentence and a table."""
        header = ["PSNR [dB]", *("1" if n == 1 else f"1/{n}" for n in self.reductions)]
        rows = [
            [f"as it is, {self.footprint}", *(_decibels(value) for value in self.unbaked)],
            [f"baked, {RECOMMENDED}", *(_decibels(value) for value in self.baked)],
        ]
        return (
            f"how near pictures come to what the training showed: {self.footprint} at the size of these views, "
            f"averaged over squares of pixels:\n{tables.format_table(header, rows)}"
        )


@torch.no_grad()
def bake_gain(
    scene: Gaussians,
    views: Sequence[View],
    training_views: Sequence[View],
    footprint: Footprint,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    progress: Callable[[str], object] = lambda what: None,
) -> tuple[Gaussians, BakeGain]:
    """Bakes a scene, and measures what that gains.

    A training compares its pictures, `point` at the size of its photographs, with these. Photographs of half the size
    are means over 2 x 2 pixels of the large ones; likewise the picture that the scene stands for at half the size is
    the mean over 2 x 2 pixels of the training's picture. That is what both are compared with.

    Args:
        scene: Trained with `footprint`.
        views: What is compared, at the size of the training's pictures.
        training_views: Those that the scene was trained from, at the size of its pictures.
        footprint: `point`, with its dilation.
        background: RGB.
        progress: Called with what begins, once for a view.

    Returns:
        The baked scene, and what it gains.

    Raises:
        ValueError: As `bake_dilation`.
    """
    device = scene.means.device
    cameras = [view.settings(device=device) for view in training_views]
    gaussians = scene.means, scene.scales, scene.rotations, scene.opacities
    baked = scene.with_activated(*bake_dilation(*gaussians, cameras, footprint.option))
    side = min(min(view.width, view.height) for view in views)
    reductions = tuple(n for n in REDUCTIONS if n == 1 or side // n >= SMALLEST)
    errors = {"unbaked": [0.0] * len(reductions), "baked": [0.0] * len(reductions)}
    counts = [0] * len(reductions)

    def picture(of: Gaussians, view: View, named) -> torch.Tensor:
        settings = view.settings(1, background, of.sh_degree, named, device=device)
        return GaussianRasterizer(settings)(means2D=None, **of.arguments())[0].clamp(0, 1).double()

    for view in views:
        progress("bake")
        shown = picture(scene, view, footprint)
        for i, n in enumerate(reductions):
            framed = view.framed(n)
            truth = torch.nn.functional.avg_pool2d(shown[None], n)[0]
            unbaked = truth if n == 1 else picture(scene, framed, footprint)
            for kind, found in (("unbaked", unbaked), ("baked", picture(baked, framed, RECOMMENDED))):
                errors[kind][i] += (found - truth).square().sum().item()
            counts[i] += truth.numel()
    psnr = {
        kind: tuple(finite_decibels(squares / count) for squares, count in zip(of_kind, counts))
        for kind, of_kind in errors.items()
    }
    return baked, BakeGain(str(footprint), reductions, **psnr)


def _decibels(value: float) -> str:
    return "the same" if value >= LARGEST_PSNR else f"{value:.1f}"
