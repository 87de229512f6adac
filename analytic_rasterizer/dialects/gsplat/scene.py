"""gsplat's `rasterization` by two operators (csrc/torch/): prepares their arguments, and calls them.

`Scene.project` makes rows of splats from Gaussians and cameras, `composite` makes images from rows.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch.autograd.function import once_differentiable
from torch.nn import functional

from ...cameras.rotations import rotation_matrices
from ...footprints import COMPENSATED, DILATED, Footprint
from ...ops import Op
from ...render.order import CENTER, key_of
from .arguments import Mode, Signal, Sizes

_AT_ONCE = 3  # channels of harmonics that `project` evaluates
# px^2, of a square pixel. The weight of every footprint but `point` and `mip` is an integral over the pixel, whatever
# its samples. Around the mean its covariance is that of the Gaussian plus this (test_gsplat.py measures it). Its peak
# is below 1, which the radii leave out: they are bounds.
_PIXEL_VARIANCE = 1 / 12
_CENTER = 0.5  # px, where gsplat has the centre of the first pixel
_project, _composite = Op("project"), Op("composite")


@dataclass(frozen=True)
class Scene:
    """Gaussians and cameras. The cameras of batch index b are b * C to b * C + C - 1.

    Attributes:
        gaussians: Arguments of `project` by their names, with leading dimensions.
        cameras: viewmatrix, projmatrix, campos and lens of all cameras, as `prepare_cameras` returns them.
        width, height: Of the images, px.
        camera_model: One of `CAMERA_MODELS`.
        by_z: Whether splats are drawn in the order of z, and not of the distance.
        planes: Between which depths splats are drawn, where `project` has not looked at it.
        radius_clip, order: As in `rasterization`.
    """

    sizes: Sizes
    gaussians: dict[str, torch.Tensor]
    cameras: dict[str, torch.Tensor]
    width: int
    height: int
    camera_model: str
    by_z: bool
    planes: tuple[float, float]
    radius_clip: float
    footprint: Footprint
    order: str

    def rows(
        self, mode: Mode, colors: Signal | None, extra: Signal | None, normals: bool, packed: bool
    ) -> tuple[dict[str, torch.Tensor], dict[str, int]]:
        """The rows that `composite` takes, and the numbers of their features: "colors", "extra", "normals", "depth"."""
        given, channels, harmonics = [], {}, None
        if mode.colors:
            channels["colors"] = colors.channels
            harmonics = colors if colors.degree is not None else None
            given += [] if harmonics else [colors]
        if extra is not None:
            channels["extra"] = extra.channels
            given.append(extra if extra.degree is None else self._harmonics(extra))
        if normals:
            channels["normals"] = 3
            given.append(self._normals())
        if mode.depth:
            channels["depth"] = 1
        return self.project(harmonics, self._joined(given), self._shown(mode), packed), channels

    def project(
        self, shs: Signal | None, values: torch.Tensor | None, shown: str, packed: bool
    ) -> dict[str, torch.Tensor]:
        """Results of the operator, by name. A table has the sizes (..., C, N)."""
        dims, count = len(self.sizes.batch), math.prod(self.sizes.batch) * self.sizes.cameras
        filters = self.footprint.name in (DILATED, COMPENSATED)
        flat = {name: flattened(value, value.dim() - dims) for name, value in self.gaussians.items()}
        made = _project(
            **{name: flat.get(name) for name in ("means3D", "opacities", "scales", "rotations", "cov3D_precomp")},
            shs=None if shs is None else self._by_group(shs, 3),
            colors_precomp=None,
            values=values,
            **self.cameras,
            image_height=self.height,
            image_width=self.width,
            tanfovx=[1.0] * count,  # the lenses have them
            tanfovy=[1.0] * count,
            scale_modifier=1.0,
            sh_degree=0 if shs is None else shs.degree,
            footprint=key_of(self.footprint, self.order),
            option=self.footprint.option,
            table=[] if packed else [*self.sizes.batch, self.sizes.cameras, self.sizes.gaussians],
            measured=True,
            order="z" if self.by_z else "distance",
            shown=shown,
            center=_CENTER,
            variance=self.footprint.option if filters else _PIXEL_VARIANCE,
            compensated=self.footprint.name == COMPENSATED,
            near=self.planes[0],
            far=self.planes[1],
            radius_clip=self.radius_clip,
        )
        return dict(zip(_project.results, made))

    def _shown(self, mode: Mode) -> str:
        """The kind of depth that is rendered."""
        if not mode.depth:
            return "none"
        distance = mode.distance and self.camera_model != "ortho"  # whose rays go along z
        return "distance" if distance or not (mode.distance or self.by_z) else "z"

    def _by_group(self, signal: Signal, dims: int) -> torch.Tensor:
        """Values with one dimension before the last `dims`, for batch indices or cameras; without, where all share
        them."""
        if signal.values.dim() == dims:
            return signal.values
        return flattened(signal.values, dims)

    def _joined(self, given: list[Signal]) -> torch.Tensor | None:
        """The values of signals without harmonics beside each other."""
        parts = [self._by_group(signal, 2) for signal in given]
        if len(parts) < 2:
            return parts[0] if parts else None
        if len({part.shape[:-1] for part in parts}) > 1:  # some are per camera
            parts = [self._by_camera(signal) for signal in given]
        return torch.cat(parts, -1)

    def _by_camera(self, signal: Signal) -> torch.Tensor:
        """(B * C, N, D) values of a signal without harmonics."""
        dims, values = len(self.sizes.batch), signal.values
        if not signal.per_camera:
            values = values.unsqueeze(dims).expand(*values.shape[:dims], self.sizes.cameras, -1, -1)
        return values.flatten(0, dims)

    def _harmonics(self, signal: Signal) -> Signal:
        """(..., C, N, D) sums of harmonics plus 1/2, which colours clamp at zero and extra signals do not.

        They are put together from colours, so that the harmonics are those of csrc/core/sh.h: where a colour is
        clamped, its value is 1 minus the colour of the negated coefficients. Gaussians whose coefficients are not
        finite have no row; they get NaN.
        """
        parts = []
        for values in signal.values.split(_AT_ONCE, -1):
            count = values.shape[-1]
            values = functional.pad(values, (0, _AT_ONCE - count))
            above, below = (
                self.project(Signal(v, signal.degree, signal.per_camera), None, "none", packed=False)
                for v in (values, -values)
            )
            sums = torch.where(above["features"] > 0, above["features"], 1 - below["features"])[:, :count]
            found = above["radii"].reshape(-1, 2)[:, :1] > 0
            parts.append(torch.where(found, sums, torch.nan))
        shape = (*self.sizes.batch, self.sizes.cameras, self.sizes.gaussians)
        return Signal(torch.cat(parts, 1).unflatten(0, shape), None, per_camera=True)

    def _normals(self) -> Signal:
        """(..., C, N, 3) third axes of the Gaussians in the world; of the two opposite ones that which faces the
        camera."""
        axes, means = rotation_matrices(self.gaussians["rotations"])[..., 2], self.gaussians["means3D"].detach()
        orthographic = self.camera_model == "ortho"
        of_cameras = self.cameras["viewmatrix"][:, :3, 2] if orthographic else self.cameras["campos"]
        of_cameras = of_cameras.detach().unflatten(0, (*self.sizes.batch, self.sizes.cameras))
        parts = []
        for of_camera in of_cameras.unbind(-2):  # one by one: gradients are added in this order
            rays = of_camera[..., None, :] if orthographic else means - of_camera[..., None, :]
            parts.append(torch.where((axes * rays).sum(-1, keepdim=True) > 0, -axes, axes))
        return Signal(torch.stack(parts, -3), None, True)


def composite(
    rows: dict[str, torch.Tensor],
    scene: Scene,
    background: torch.Tensor | None,
    means2d_abs: torch.Tensor | None,
    expected: bool,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Images (B * C, H, W, K) and alphas (B * C, H, W, 1) of rows.

    Args:
        rows: By the names of the operator's arguments, and others.
        background: (..., C, D) behind the first D channels, or None.
        means2d_abs: Takes sums of absolute gradients, as in `blend`; or None.
        expected: Whether the last channel, depth, is divided by alpha.
    """
    names = ("means2d", "cov2d", "opacities", "features", "dets", "depths", "row_splits")
    image, alpha, _ = _composite(
        **{name: rows[name] for name in names},
        background=background,
        means2d_abs=means2d_abs,
        image_height=scene.height,
        image_width=scene.width,
        footprint=key_of(scene.footprint, scene.order),
        option=scene.footprint.option,
        center=_CENTER,
        expected=expected,
        slopes=None if scene.order == CENTER else rows["slopes"],
    )
    return image, alpha


def flattened(values: torch.Tensor, dims: int) -> torch.Tensor:
    """All but the last `dims` dimensions in one; none, where there are no others."""
    return values if values.dim() == dims else values.flatten(0, -dims - 1)


def upper_triangle(matrices: torch.Tensor) -> torch.Tensor:
    """(..., 6) of (..., 3, 3)."""
    return torch.stack([matrices[..., row, column] for row in range(3) for column in range(row, 3)], -1)


def named(rows: dict[str, Any], sizes: Sizes, packed: bool) -> dict[str, torch.Tensor | None]:
    """The tensors of `meta`."""
    ids: dict[str, torch.Tensor | None] = {"batch_ids": None, "camera_ids": None, "gaussian_ids": None}
    if packed:
        cameras = rows["camera_ids"].long()
        ids = {
            "batch_ids": cameras // sizes.cameras if sizes.batch else torch.zeros_like(cameras),
            "camera_ids": cameras % sizes.cameras if sizes.batch else cameras,
            "gaussian_ids": rows["gaussian_ids"].long(),
        }
    shown = rows["shown_opacities"]
    own = {name: rows[name] for name in ("radii", "means2d", "depths", "conics")}
    return ids | own | {"opacities": shown if shown.numel() else rows["opacities"]}


class KeepAbsolute(torch.autograd.Function):
    """Passes means2d on, with a second tensor that takes the sums of absolute gradients for `means2d.absgrad`."""

    @staticmethod
    def forward(ctx: Any, means2d: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """means2d, and a tensor like it, of any numbers."""
        ctx.means2d = means2d
        return means2d.view_as(means2d), torch.empty_like(means2d)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, dL_dmeans2d: torch.Tensor, absolute: torch.Tensor) -> torch.Tensor:
        """The gradient of means2d as it came; the other one becomes the attribute."""
        ctx.means2d.absgrad = absolute
        return dL_dmeans2d
