"""Mini-Splatting: (color, radii, sum of weights, pixels seen, pixels dominated), and `GaussianRasterizer.render_depth`.

Repositories: fatPeter/mini-splatting, which imports it as diff_gaussian_rasterization_ms beside
diff_gaussian_rasterization (3DGS 2023). The second module is always this dialect.

[MS] Fang & Wang, Mini-Splatting: Representing Scenes with a Constrained Number of Gaussians, 2024.
"""

from __future__ import annotations

import torch

from ..cameras.rotations import rotation_matrices
from ..footprints import DILATED
from ..render.autocast import widened, widened_settings
from ..render.effects import Effects
from ..render.outputs import depths
from ..render.rasterizer import render
from ._base import GaussianRasterizationSettings as Settings
from ._base import GaussianRasterizer as Rasterizer
from ._base import as_settings, rasterize_gaussians
from ._further import given

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer", "rasterize_gaussians"]


class GaussianRasterizationSettings(Settings):
    """Those of 3DGS 2023."""

    dialect = "mini"
    repositories = ()  # the repository imports it by the name of its own module
    filter = DILATED
    outputs = Effects(gaussian_stats=True)

    def returned(self, color, radii, outputs):
        stats = outputs.gaussian_stats
        return color, radii, stats.sum_weight, stats.pixels, stats.pixels_dominated


class GaussianRasterizer(Rasterizer):
    """Renders 3D Gaussians, or where a ray meets them."""

    @torch.no_grad()
    def render_depth(
        self,
        means3D: torch.Tensor,
        means2D: torch.Tensor | None,
        opacities: torch.Tensor,
        shs: torch.Tensor | None = None,
        colors_precomp: torch.Tensor | None = None,
        scales: torch.Tensor | None = None,
        rotations: torch.Tensor | None = None,
        cov3D_precomp: torch.Tensor | None = None,
    ) -> dict[str, torch.Tensor]:
        """Where each pixel's ray passes through the Gaussian that it shows most of. Without gradient.

        The point is the one of highest density along the ray, the middle of its way through the ellipsoid [MS].
        Arguments and errors are those of `forward`.

        Returns:
            render: (3, H, W) the image.
            radii: (P,) int32, px.
            gidx: (1, H, W) int32, the Gaussian that the pixel shows most of; -1 for none.
            out_pts: (3, H, W) the point, world units; 0 where there is none.
            depth: (1, H, W) camera-space z of the point.
            accum_alpha: (1, H, W) how much light is left, 1 - alpha.
        """
        settings = widened_settings(as_settings(self.raster_settings))
        means3D, scales, rotations, cov3D_precomp = map(widened, (means3D, scales, rotations, cov3D_precomp))
        color, radii, outputs = render(
            settings,
            Effects(alpha=True, dominant_index=True),
            means3D,
            means2D,
            opacities,
            shs,
            colors_precomp,
            scales,
            rotations,
            cov3D_precomp,
        )
        seen = outputs.dominant_index[0] >= 0
        gaussian = outputs.dominant_index[0][seen].long()
        points = color.new_zeros(*color.shape[1:], 3)
        axes, lengths = _ellipsoids(scales, rotations, cov3D_precomp, gaussian)
        origin = settings.campos.reshape(3)
        rays = _rays(settings, color)[seen]
        center = _in_frame(means3D[gaussian] - origin, axes) / lengths
        direction = _in_frame(rays, axes) / lengths
        along = (center * direction).sum(1) / direction.square().sum(1)
        points[seen] = origin + along[:, None] * rays
        depth = torch.where(seen, depths(points.reshape(-1, 3), settings.viewmatrix).reshape(seen.shape), 0)
        return {
            "render": color,
            "radii": radii,
            "gidx": outputs.dominant_index,
            "out_pts": points.permute(2, 0, 1).contiguous(),
            "depth": depth[None],
            "accum_alpha": 1 - outputs.alpha,
        }


def _rays(settings: Settings, like: torch.Tensor) -> torch.Tensor:
    """(H, W, 3) directions of the rays through the centres of the pixels, world units, of any length and sign.

    The points of a column of pixels lie in one plane, clip_x = x clip_w, those of a row in another: the ray is where
    the two meet.
    """
    height, width = like.shape[1:]
    proj = settings.projmatrix.reshape(4, 4)
    x = (2 * torch.arange(width, dtype=like.dtype, device=like.device) + 1) / width - 1
    y = (2 * torch.arange(height, dtype=like.dtype, device=like.device) + 1) / height - 1
    columns = (proj[:3, 0] - x[:, None] * proj[:3, 3])[None].expand(height, width, 3)
    rows = (proj[:3, 1] - y[:, None] * proj[:3, 3])[:, None].expand(height, width, 3)
    return torch.linalg.cross(columns, rows)


def _in_frame(vectors: torch.Tensor, axes: torch.Tensor) -> torch.Tensor:
    """(N, 3) coordinates of vectors (N, 3) along the columns of axes (N, 3, 3); not by `@`, which autocast rounds."""
    x, y, z = vectors[:, :, None].unbind(1)
    return x * axes[:, 0] + y * axes[:, 1] + z * axes[:, 2]


def _ellipsoids(scales, rotations, cov3D_precomp, gaussian: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Axes (N, 3, 3), as columns, and their lengths (N, 3) of some Gaussians, up to a common factor of the lengths."""
    if given(cov3D_precomp):
        xx, xy, xz, yy, yz, zz = cov3D_precomp[gaussian].unbind(1)
        matrices = torch.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], 1).reshape(-1, 3, 3)
        variances, axes = torch.linalg.eigh(matrices)
        lengths = variances.clamp_min(0).sqrt()
    else:
        axes = rotation_matrices(rotations[gaussian])
        lengths = scales[gaussian]
    # A flat one is a little thick, so that a ray that lies in it has a middle.
    return axes, lengths.clamp_min(1e-6 * lengths.amax(1, keepdim=True).clamp_min(1e-30))
