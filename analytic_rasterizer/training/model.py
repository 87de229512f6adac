"""The Gaussians that are trained: how they start, and how they become a scene."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from .. import distributed, io
from ..activations import activate
from ..rasterizer import rasterize_gaussians
from ..settings import GaussianRasterizationSettings

if TYPE_CHECKING:
    from torch.distributed import ProcessGroup

HALF_EDGE = 1.3  # of the cube of random points; NeRF-synthetic objects fit in it
SH_C0 = 0.28209479177387814  # value of the constant spherical harmonic
NEIGHBOURS = 3  # whose distances make the first scale


class Gaussians(NamedTuple):
    """What is trained: unconstrained float32 parameters, one row each."""

    means: Tensor  # (P, 3) world units
    log_scales: Tensor  # (P, 3) logarithms of standard deviations in world units
    rotations: Tensor  # (P, 4) quaternions (w, x, y, z) of any length
    logit_opacities: Tensor  # (P, 1)
    shs: Tensor  # (P, K, 3) spherical harmonics

    def render(
        self, settings: GaussianRasterizationSettings, means2D: Tensor | None = None, supersampling: int = 1
    ) -> tuple[Tensor, Tensor]:
        """As `Activated.render`."""
        return self.activated().render(settings, means2D, supersampling)

    def activated(self) -> Activated:
        """What the rasterizer takes. Differentiable."""
        scales, rotations, opacities = activate(self.log_scales, self.rotations, self.logit_opacities)
        return Activated(self.means, scales, rotations, opacities, self.shs)

    @torch.no_grad()
    def to_scene(self) -> io.Scene:
        """The scene on the same device, without gradients."""
        means, scales, rotations, opacities, shs = (t.detach() for t in self.activated())
        return io.Scene(means, scales, rotations, opacities, shs, round(shs.shape[1] ** 0.5) - 1)

    @staticmethod
    @torch.no_grad()
    def from_scene(scene: io.Scene, sh_degree: int) -> Gaussians:
        """Parameters that give this scene; harmonics are cut or filled with zeros to the degree."""
        shs = scene.shs[:, : (sh_degree + 1) ** 2]
        missing = (sh_degree + 1) ** 2 - shs.shape[1]
        # Scales of 0 and opacities of 0 or 1 have no finite parameter.
        return Gaussians(
            scene.means,
            scene.scales.clamp_min(1e-12).log(),
            scene.rotations,
            scene.opacities.logit(eps=1e-6),
            torch.cat([shs, shs.new_zeros(len(shs), missing, 3)], dim=1),
        )


class Activated(NamedTuple):
    """Gaussians as the rasterizer takes them, one row each, with a graph back to the parameters."""

    means: Tensor  # (P, 3) world units
    scales: Tensor  # (P, 3) standard deviations, world units
    rotations: Tensor  # (P, 4) quaternions (w, x, y, z)
    opacities: Tensor  # (P, 1) in (0, 1)
    shs: Tensor  # (P, K, 3)

    def render(
        self, settings: GaussianRasterizationSettings, means2D: Tensor | None = None, supersampling: int = 1
    ) -> tuple[Tensor, Tensor]:
        """The picture (3, H, W), and the radii (P,) int32 in px, 0 for what is not seen.

        Args:
            means2D: Receives the gradient with respect to the projected means.
            supersampling: Render so many times larger, and average over squares of pixels. Radii, and the pixels of
                the footprint, are those of the larger picture.
        """
        picture, radii = rasterize_gaussians(
            self.means,
            means2D,
            self.shs,
            None,
            self.opacities,
            self.scales,
            self.rotations,
            None,
            enlarged(settings, supersampling),
        )
        return averaged(picture, supersampling), radii

    def render_together(
        self,
        settings: list[GaussianRasterizationSettings],
        supersampling: int = 1,
        means2d_abs: bool = False,
        group: ProcessGroup | None = None,
    ) -> distributed.Batch:
        """The pictures of several ranks, each of which has a part of the Gaussians: see `distributed.rasterize`.

        Args:
            supersampling: As in `render`. The splats are those of the larger pictures, and alpha is.
        """
        batch = distributed.rasterize(
            [enlarged(of_camera, supersampling) for of_camera in settings],
            self.means,
            self.opacities,
            shs=self.shs,
            scales=self.scales,
            rotations=self.rotations,
            means2d_abs=means2d_abs,
            group=group,
        )
        views = (view._replace(image=averaged(view.image, supersampling)) for view in batch.views)
        return replace(batch, views=tuple(views))


def enlarged(settings: GaussianRasterizationSettings, times: int) -> GaussianRasterizationSettings:
    """Those of a picture so many times as large."""
    if times == 1:
        return settings  # as they are: making others takes longer than all checks of a step
    return settings._replace(image_height=times * settings.image_height, image_width=times * settings.image_width)


def averaged(picture: Tensor, times: int) -> Tensor:
    """Means over squares of so many pixels, (3, H / times, W / times)."""
    return avg_pool2d(picture, times) if times > 1 else picture


def random_points(count: int, seed: int) -> tuple[Tensor, Tensor]:
    """Positions (count, 3) in the cube of NeRF-synthetic scenes, and grey, (count, 3) of colours in [0, 1].

    Random colours, of which nothing is known, would only have to be unlearned.
    """
    generator = torch.Generator().manual_seed(seed)
    uniform = torch.rand(count, 3, generator=generator, dtype=torch.float32, device="cpu")
    return HALF_EDGE * (2 * uniform - 1), torch.full_like(uniform, 0.5)


def gaussians_at(points: Tensor, colors: Tensor, sh_degree: int, opacity: float = 0.1, scale: float = 1.0) -> Gaussians:
    """Round Gaussians at (P, 3) points on the CPU, `scale` times as large as the gaps between them.

    Raises ImportError without SciPy.
    """
    count = len(points)
    return Gaussians(
        points,
        (scale * neighbour_distance(points)).log()[:, None].repeat(1, 3),
        points.new_tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
        points.new_full((count, 1), opacity).logit(),
        torch.cat([(colors[:, None] - 0.5) / SH_C0, points.new_zeros(count, (sh_degree + 1) ** 2 - 1, 3)], dim=1),
    )


def neighbour_distance(points: Tensor) -> Tensor:
    """Root mean square distance of each of the (P, 3) points to its nearest neighbours, (P,), at least 1e-7."""
    tree = io.optional_import("scipy.spatial", "train").cKDTree(points.double().numpy())
    neighbours = min(NEIGHBOURS, len(points) - 1)
    distances, _ = tree.query(points.double().numpy(), k=neighbours + 1)
    nearest = torch.from_numpy(distances).reshape(len(points), -1)[:, 1:]  # the first is the point itself
    return nearest.square().mean(1).sqrt().nan_to_num(0).float().clamp_min(1e-7)
