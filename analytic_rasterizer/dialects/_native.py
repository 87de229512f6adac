"""diff_gaussian_rasterization._C: the functions of the original's compiled module, by position as there.

Those of 3DGS 2023, and the structural similarity that the accelerated rasterizer of 3DGS 2024 has besides.

The buffers that travel from `rasterize_gaussians` to `rasterize_gaussians_backward` are opaque to callers. Here they
hold what the backward pass is not given otherwise: the opacities, and the name of the footprint. It renders again.
"""

from __future__ import annotations

import math

import torch

from .. import _C
from ..checks import check_tensors
from ..losses import ssim
from ..render.arguments import camera_arguments, gaussian_arguments
from ..render.rasterizer import GaussianRasterizer
from ..render.settings import GaussianRasterizationSettings

_TILE_OFFSETS, _COUNTS = map(_C.LISTS.index, ("tile_offsets", "counts"))  # in what the op saves


def _settings(
    background,
    scale_modifier,
    viewmatrix,
    projmatrix,
    tan_fovx,
    tan_fovy,
    height,
    width,
    degree,
    campos,
    debug,
    footprint,
) -> GaussianRasterizationSettings:
    return GaussianRasterizationSettings(
        image_height=height,
        image_width=width,
        tanfovx=tan_fovx,
        tanfovy=tan_fovy,
        bg=background,
        scale_modifier=scale_modifier,
        viewmatrix=viewmatrix,
        projmatrix=projmatrix,
        sh_degree=degree,
        campos=campos,
        prefiltered=False,
        debug=debug,
        footprint=footprint,
    )


@torch.no_grad()
def rasterize_gaussians(
    background,
    means3D,
    colors,
    opacity,
    scales,
    rotations,
    scale_modifier,
    cov3D_precomp,
    viewmatrix,
    projmatrix,
    tan_fovx,
    tan_fovy,
    image_height,
    image_width,
    sh,
    degree,
    campos,
    prefiltered,
    debug,
):
    """Renders, without a graph.

    Shapes, units and errors are those of `GaussianRasterizer.forward`; missing inputs are empty tensors.

    Returns:
        num_rendered: int, pairs of a tile and a Gaussian. Counting them waits for the device.
        color: (3, H, W).
        radii: (P,) int32, px.
        geomBuffer, binningBuffer, imgBuffer: For `rasterize_gaussians_backward`.
    """
    settings = _settings(
        background, scale_modifier, viewmatrix, projmatrix, tan_fovx, tan_fovy, image_height, image_width, degree,
        campos, debug, None,
    )  # fmt: skip
    gaussians = gaussian_arguments(
        settings,
        means3D,
        opacity,
        means2D=None,
        shs=sh,
        colors_precomp=colors,
        scales=scales,
        rotations=rotations,
        cov3D_precomp=cov3D_precomp,
    )
    check_tensors(means3D.device, background=background)
    camera = camera_arguments(settings, means3D, gaussians["shs"])
    color, _, radii, _, saved = torch.ops.analytic_rasterizer.rasterize(
        **gaussians, **camera, bg=background, keep=True, debug=bool(debug)
    )
    # On CUDA tiles may share lists, which then have fewer pairs.
    num_rendered = int(saved[_COUNTS][0] if means3D.is_cuda else saved[_TILE_OFFSETS][-1])
    footprint = torch.frombuffer(bytearray(str(settings.footprint_in_use()).encode()), dtype=torch.uint8)
    return num_rendered, color, radii, opacity.detach(), footprint, color.new_empty(0)


def rasterize_gaussians_backward(
    background,
    means3D,
    radii,
    colors,
    scales,
    rotations,
    scale_modifier,
    cov3D_precomp,
    viewmatrix,
    projmatrix,
    tan_fovx,
    tan_fovy,
    dL_dout_color,
    sh,
    degree,
    campos,
    geomBuffer,
    num_rendered,
    binningBuffer,
    imgBuffer,
    debug,
):
    """Gradients of `rasterize_gaussians`; the size of the image is that of dL_dout_color.

    Returns:
        dL_dmeans2D (P, 3), dL_dcolors (P, 3), dL_dopacity (P, 1), dL_dmeans3D (P, 3), dL_dcov3D (P, 6), dL_dsh (P, M,
        3), dL_dscales (P, 3), dL_drotations (P, 4): of an input that was not given, zero.
    """
    footprint = bytes(binningBuffer.tolist()).decode()
    height, width = dL_dout_color.shape[-2:]
    settings = _settings(
        background.detach(), scale_modifier, viewmatrix.detach(), projmatrix.detach(), tan_fovx, tan_fovy, height,
        width, degree, campos.detach(), debug, footprint,
    )  # fmt: skip
    count = len(means3D)
    shapes = {
        "means2D": (count, 3),
        "colors_precomp": (count, 3),
        "opacities": (count, 1),
        "means3D": (count, 3),
        "cov3D_precomp": (count, 6),
        "shs": (count, sh.shape[1] if sh.dim() == 3 else 0, 3),
        "scales": (count, 3),
        "rotations": (count, 4),
    }
    inputs = {
        "means2D": means3D.new_zeros(count, 3),
        "colors_precomp": colors,
        "opacities": geomBuffer,
        "means3D": means3D,
        "cov3D_precomp": cov3D_precomp,
        "shs": sh,
        "scales": scales,
        "rotations": rotations,
    }
    leaves = {name: t.detach().requires_grad_() for name, t in inputs.items() if t is not None and len(t) == count}
    with torch.enable_grad():
        color, _ = GaussianRasterizer(settings)(**leaves)
        found = torch.autograd.grad(color, list(leaves.values()), dL_dout_color, allow_unused=True)
    gradients = dict(zip(leaves, found))
    return tuple(
        means3D.new_zeros(shape) if gradients.get(name) is None else gradients[name].reshape(shape)
        for name, shape in shapes.items()
    )


def mark_visible(means3D, viewmatrix, projmatrix):
    """(P,) bool: which means lie in front of the near plane."""
    zero = means3D.new_zeros(3)
    settings = _settings(zero, 1.0, viewmatrix, projmatrix, 1.0, 1.0, 1, 1, 0, zero, False, None)
    return GaussianRasterizer(settings).markVisible(means3D)


def fusedssim(C1, C2, img1, img2):
    """Structural similarity of two images (C, H, W) pixel by pixel, without a graph: `ar.losses.ssim`.

    Raises:
        ValueError: C1 and C2 are not 0.01^2 and 0.03^2. What `ssim` raises.
    """
    if not (math.isclose(C1, 0.01**2) and math.isclose(C2, 0.03**2)):
        raise ValueError(f"C1 and C2 must be 0.01^2 and 0.03^2, got {C1} and {C2}")
    with torch.no_grad():
        return ssim(img1, img2, "none")


def fusedssim_backward(C1, C2, img1, img2, opt_grad):
    """Gradient of `fusedssim` with respect to img1; opt_grad is that with respect to what it returned."""
    img1 = img1.detach().requires_grad_()
    with torch.enable_grad():
        return torch.autograd.grad(ssim(img1, img2, "none"), img1, opt_grad)[0]
