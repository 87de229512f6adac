"""The drop-in interface of diff_gaussian_rasterization: `GaussianRasterizer`, and the function `rasterize_gaussians`.

Both end in `render`, which checks the arguments, completes them by those of the camera, and calls one operator
(csrc/torch/rasterize.cpp). The dialects call `render` too.
"""

from __future__ import annotations

from typing import Any

import torch

from .. import _C
from ..checks import check_tensors
from ..ops import Op
from . import advice
from .arguments import camera_arguments, gaussian_arguments
from .autocast import way_out_of, widened
from .effects import NEAR, Effects, Outputs
from .outputs import before_background, depths, named_summary, split_background
from .seam import has_seam
from .settings import GaussianRasterizationSettings
from .sphere import render_sphere

NOTHING = Effects()
"""Asks for no output."""

_op = Op("rasterize")


def _rasterize(settings: GaussianRasterizationSettings, **arguments: Any) -> tuple:
    """The operator. Advice is no matter of torch.compile."""
    results = _op(**arguments)
    if not torch.compiler.is_compiling() and advice.is_due and settings.footprint is None:
        advice.give(settings)
    return results


def rasterize_gaussians(
    means3D: torch.Tensor,
    means2D: torch.Tensor | None,
    sh: torch.Tensor | None,
    colors_precomp: torch.Tensor | None,
    opacities: torch.Tensor,
    scales: torch.Tensor | None,
    rotations: torch.Tensor | None,
    cov3Ds_precomp: torch.Tensor | None,
    raster_settings: GaussianRasterizationSettings,
) -> tuple[torch.Tensor, ...]:
    """Renders Gaussians with `raster_settings`, as a function, in the order of arguments of 3DGS.

    `sh` is `shs` and `cov3Ds_precomp` is `cov3D_precomp`. The other arguments, what is returned and errors are those of
    `GaussianRasterizer.forward`.
    """
    return render(
        raster_settings,
        NOTHING,
        means3D,
        means2D,
        opacities,
        sh,
        colors_precomp,
        scales,
        rotations,
        cov3Ds_precomp,
    )


def render(
    settings: GaussianRasterizationSettings,
    outputs: Effects,
    means3D: torch.Tensor,
    means2D: torch.Tensor | None,
    opacities: torch.Tensor,
    shs: torch.Tensor | None = None,
    colors_precomp: torch.Tensor | None = None,
    scales: torch.Tensor | None = None,
    rotations: torch.Tensor | None = None,
    cov3D_precomp: torch.Tensor | None = None,
    features: torch.Tensor | None = None,
) -> tuple:
    """Renders: (color, radii), and `Outputs` where `outputs` or the effects of the settings ask for some.

    Args:
        outputs: An `Effects` of which only the outputs are read: what a dialect returns whatever the settings say.
        features: (P, K), K up to 509, blended with a background of zero beside three colours, which they follow in
            `color` (3 + K, H, W).

    The other arguments, what is returned, and errors are those of `GaussianRasterizer.forward`.
    """
    if has_seam(settings):
        given = means3D, means2D, opacities, shs, colors_precomp, scales, rotations, cov3D_precomp, features
        return render_sphere(settings, outputs, *given)
    gaussians = gaussian_arguments(
        settings,
        means3D,
        opacities,
        means2D=means2D,
        shs=shs,
        colors_precomp=colors_precomp,
        scales=scales,
        rotations=rotations,
        cov3D_precomp=cov3D_precomp,
    )
    bg = settings.bg
    check_tensors(means3D.device, bg=bg)
    if features is not None:
        check_tensors(means3D.device, features=features)
        gaussians["features"] = features
    camera = camera_arguments(settings, means3D, gaussians["shs"])
    if settings.means2d_z != "zero":
        camera["means2d_z"] = settings.means2d_z
    if isinstance(settings.effects, Effects) and settings.effects.has_outputs:
        outputs = settings.effects if outputs is NOTHING else outputs.with_outputs_of(settings.effects)
    debug = bool(settings.debug)
    if outputs is NOTHING and bg.dim() < 3:
        return _rasterize(settings, **gaussians, **camera, bg=bg, debug=debug)[:3:2]
    return _render_with_outputs(settings, gaussians, camera, outputs)


def _render_with_outputs(
    settings: GaussianRasterizationSettings, gaussians: dict[str, Any], camera: dict[str, Any], effects: Effects
) -> tuple:
    """(color, radii), and `Outputs` where `effects` asks for some. `settings.bg` may be an image (C, H, W)."""
    bg, debug = settings.bg, bool(settings.debug)
    size = camera["image_height"], camera["image_width"]
    bg, bg_image = split_background(bg, gaussians["colors_precomp"], size, debug)
    blended = {name: getattr(effects, name) for name in _C.IMAGES}
    blended["alpha"] |= bg_image is not None
    summarized = {name: getattr(effects, name) for name in _C.SUMMARIES}
    options = {"bg": bg, **blended, **summarized, "debug": debug}
    color, images, radii, summary, _ = _rasterize(settings, **gaussians, **camera, **options)
    outputs = dict(zip((name for name in _C.IMAGES if blended[name]), (image[None] for image in images)))
    if bg_image is not None:
        color = before_background(color, outputs["alpha"], bg_image)
        if not effects.alpha:
            del outputs["alpha"]
    if not effects.has_outputs:
        return color, radii
    return color, radii, Outputs(**outputs, **named_summary(effects, summary))


class GaussianRasterizer(torch.nn.Module):
    """Renders 3D Gaussians with the settings it holds.

    Args:
        raster_settings: How to render. They may be replaced between two calls.
    """

    def __init__(self, raster_settings: GaussianRasterizationSettings):
        super().__init__()
        self.raster_settings = raster_settings

    def markVisible(self, positions: torch.Tensor) -> torch.Tensor:
        """Which positions lie beyond the near plane: depth above 0.2, or above `Effects.near` if that is set.

        The depth is camera-space z; with a fisheye or an equirectangular lens it is the distance from the camera.

        Args:
            positions: (P, 3) world units.

        Returns:
            (P,) bool.

        Raises:
            TypeError: Not a tensor, or not of the dtype of the settings' viewmatrix.
            ValueError: Wrong shape or device.
        """
        check_tensors(None, positions=positions)
        view = self.raster_settings.viewmatrix
        check_tensors(None, viewmatrix=view)
        positions, view = widened(positions), widened(view)
        if view.shape not in ((4, 4), (1, 4, 4)):
            raise ValueError(f"viewmatrix must have shape (4, 4) or (1, 4, 4), got {tuple(view.shape)}")
        if positions.device != view.device:
            raise ValueError(f"positions must be on the device of viewmatrix, {view.device}, got {positions.device}")
        if positions.dim() != 2 or positions.shape[1] != 3:
            raise ValueError(f"positions must have shape (P, 3), got {tuple(positions.shape)}")
        if positions.dtype != view.dtype:
            got = f"{positions.dtype}{way_out_of(positions.dtype)}"
            raise TypeError(f"positions must have dtype {view.dtype}, got {got}")
        effects = getattr(self.raster_settings, "effects", None)  # settings of a class of the program have none
        near = effects.near if isinstance(effects, Effects) else NEAR
        with torch.no_grad():
            return depths(positions, view, effects) > near

    def forward(
        self,
        means3D: torch.Tensor,
        means2D: torch.Tensor | None,
        opacities: torch.Tensor,
        shs: torch.Tensor | None = None,
        colors_precomp: torch.Tensor | None = None,
        scales: torch.Tensor | None = None,
        rotations: torch.Tensor | None = None,
        cov3D_precomp: torch.Tensor | None = None,
    ) -> tuple[torch.Tensor, ...]:
        """Renders an image. Differentiable in all eight inputs.

        All floating tensors share one dtype (float32; float64 on the CPU) and device. Under torch.autocast those of 16
        bits are used in float32, and get gradients of 16 bits. Missing inputs are None or empty tensors. On CUDA the
        work is queued on the current stream; when the host waits for it is in docs/library.md, "Waiting for the
        device".

        Args:
            means3D: (P, 3) centres, world units.
            means2D: (P, 3) or (P, 4), or None. Its values are ignored; it is there for its gradient, which density
                control reads. The first two columns of the gradient are dL/d(projected mean) per (0.5 W, 0.5 H) px.
                The third column of a (P, 3) tensor is zero. Columns 2 and 3 of a (P, 4) tensor are the sums over
                pixels of the absolute values of what each pixel adds to columns 0 and 1.
            opacities: (P, 1) or (P,).
            shs: (P, M, 3) spherical harmonics, M >= (sh_degree + 1)^2; or colors_precomp.
            colors_precomp: (P, 3) RGB, or (P, C) features of 1 to 512 channels, blended in one pass.
            scales: (P, 3) standard deviations, world units, with rotations; or cov3D_precomp.
            rotations: (P, 4) quaternions (w, x, y, z) of any length; zero is the identity.
            cov3D_precomp: (P, 6) covariances (xx, xy, xz, yy, yz, zz).

        Returns:
            color: (3, H, W) image; (C, H, W) of C channels.
            radii: (P,) int32, 3 standard deviations of the projected Gaussian in px, rounded up; 0 for
                a Gaussian that was culled.
            outputs: `Outputs`, only where the settings ask for effects.

        Raises:
            TypeError: Not a tensor, or a wrong dtype.
            ValueError: Wrong shape, device or value. The message names the argument, what was expected
                and what came.
            RuntimeError: CUDA tensors, and an extension without CUDA; or an error of CUDA.
            torch.OutOfMemoryError: No room for splats, pairs or gradients, on the CPU as on CUDA.
        """
        return rasterize_gaussians(
            means3D,
            means2D,
            shs,
            colors_precomp,
            opacities,
            scales,
            rotations,
            cov3D_precomp,
            self.raster_settings,
        )
