"""The Gaussians of gsplat's `rasterization` in its cameras: their splats, and what each carries into the images."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import torch

from ...rotations import rotation_matrices
from ...settings import GaussianRasterizationSettings
from ...stages import Splats, project
from .arguments import Mode, Signal, Sizes
from .meta import ROWS

_AT_ONCE = 3  # channels of harmonics that `project` evaluates


@dataclass(frozen=True)
class Scene:
    """Gaussians and cameras. The cameras of batch index b are b * C to b * C + C - 1.

    Attributes:
        gaussians: Arguments of `project` by their names, with leading dimensions.
        viewmats: (..., C, 4, 4).
        settings: One per camera.
        camera_model: One of `CAMERA_MODELS`.
        by_z: Whether splats are drawn in the order of z, and not of the distance.
    """

    sizes: Sizes
    gaussians: dict[str, torch.Tensor]
    viewmats: torch.Tensor
    settings: list[GaussianRasterizationSettings]
    camera_model: str
    by_z: bool

    def project(self, shs: Signal | None) -> Splats:
        """Splats of all Gaussians in all cameras, with colours where there are harmonics of three channels.

        One `project` serves the cameras that see the same Gaussians: those of a batch index, unless harmonics are per
        camera.
        """
        dims = len(self.sizes.batch)
        flat = {name: _table(value, value.dim() - dims) for name, value in self.gaussians.items()}
        settings, per_camera = self.settings, shs is not None and shs.per_camera
        if shs is not None:
            harmonics = _table(shs.values, 3)
            settings = [s._replace(sh_degree=shs.degree) for s in settings]
        together = 1 if per_camera else self.sizes.cameras
        parts = []
        for first in range(0, len(settings), together):
            batch = first // self.sizes.cameras
            of_batch = {name: value[batch] for name, value in flat.items()}
            if shs is not None:
                of_batch["shs"] = harmonics[first if per_camera else batch]
            parts.append(project(settings[first : first + together], **of_batch))
        return _join(parts)

    def ordered(self, splats: Splats) -> Splats:
        """The splats with the depths by which they are drawn. `project` gives those of the camera model."""
        if self.by_z != (self.camera_model == "fisheye"):
            return splats
        return dataclasses.replace(splats, depths=self.depths(splats, not self.by_z).clamp(min=0))

    def depths(self, splats: Splats, distance: bool) -> torch.Tensor:
        """(R,) camera-space z of the splats' means, or their distance from the camera, world units. Differentiable."""
        parts = []
        for view, means in zip(self.viewmats.reshape(-1, 4, 4), self._by_camera(splats, self.gaussians["means3D"])):
            axes = view[:3] if distance else view[2:3]
            of_camera = (means[:, None] * axes[:, :3]).sum(-1) + axes[:, 3]
            parts.append(of_camera.norm(dim=1) if distance else of_camera[:, 0])
        return torch.cat(parts)

    def features(
        self, splats: Splats, mode: Mode, colors: Signal | None, extra: Signal | None, normals: bool
    ) -> dict[str, torch.Tensor]:
        """(R, D) by what they are, in the order of the channels: "colors", "extra", "normals", "depth"."""
        made = {}
        if mode.colors:
            made["colors"] = splats.colors if colors.degree is not None else self._values(splats, colors)
        if extra is not None:
            made["extra"] = self._values(splats, extra) if extra.degree is None else self._harmonics(splats, extra)
        if normals:
            made["normals"] = self._normals(splats)
        if mode.depth:
            distance = mode.distance and self.camera_model != "ortho"  # whose rays go along z
            as_drawn = not mode.distance or distance != self.by_z
            made["depth"] = (splats.depths if as_drawn else self.depths(splats, distance))[:, None]
        return made

    def _values(self, splats: Splats, signal: Signal) -> torch.Tensor:
        """(R, D) of a signal without harmonics."""
        table = splats.camera_ids.long()
        if not signal.per_camera:
            table = table // self.sizes.cameras
        rows = table * self.sizes.gaussians + splats.gaussian_ids.long()
        return signal.values.flatten(0, -2).index_select(0, rows)

    def _harmonics(self, splats: Splats, signal: Signal) -> torch.Tensor:
        """(R, D) sums of harmonics plus 1/2, which colours clamp at zero and extra signals do not.

        They are put together from colours, so that the harmonics are those of csrc/core/sh.h: where a colour is
        clamped, its value is 1 minus the colour of the negated coefficients. Gaussians whose coefficients are not
        finite are missing among the colours; they get NaN.
        """
        keys, parts = self._keys(splats), []
        for values in signal.values.split(_AT_ONCE, -1):
            count = values.shape[-1]
            values = torch.nn.functional.pad(values, (0, _AT_ONCE - count))
            above, below = (self.project(dataclasses.replace(signal, values=v)) for v in (values, -values))
            sums = torch.where(above.colors > 0, above.colors, 1 - below.colors)[:, :count]
            found, last = self._keys(above), len(sums)
            places = torch.searchsorted(found, keys)
            there = torch.nn.functional.pad(found, (0, 1), value=-1)[places] == keys
            with_missing = torch.cat([sums, sums.new_full((1, count), torch.nan)])
            parts.append(with_missing.index_select(0, torch.where(there, places, last)))
        return torch.cat(parts, 1)

    def _normals(self, splats: Splats) -> torch.Tensor:
        """(R, 3) third axes of the Gaussians in the world; of the two opposite ones that which faces the camera."""
        axes = self._by_camera(splats, rotation_matrices(self.gaussians["rotations"])[..., 2])
        means = self._by_camera(splats, self.gaussians["means3D"].detach())
        parts = []
        for settings, normals, positions in zip(self.settings, axes, means):
            if self.camera_model == "ortho":
                rays = settings.viewmatrix.detach()[:3, 2]
            else:
                rays = positions - settings.campos.detach()
            parts.append(torch.where((normals * rays).sum(1, keepdim=True) > 0, -normals, normals))
        return torch.cat(parts)

    def _keys(self, splats: Splats) -> torch.Tensor:
        """(R,) ascending, one number for each camera and Gaussian."""
        return splats.camera_ids.long() * self.sizes.gaussians + splats.gaussian_ids.long()

    def _by_camera(self, splats: Splats, values: torch.Tensor) -> list[torch.Tensor]:
        """The splats' rows of (..., N, D), for each camera. Each is there once, so that gradients have one order."""
        flat = _table(values, 2)
        ids = splats.gaussian_ids.long().split(splats.row_splits.diff().tolist())
        return [flat[camera // self.sizes.cameras].index_select(0, rows) for camera, rows in enumerate(ids)]


def _table(values: torch.Tensor, dims: int) -> torch.Tensor:
    """All but the last dimensions in one, which may be a product of none."""
    return values.reshape(math.prod(values.shape[:-dims]), *values.shape[-dims:])


def _join(parts: list[Splats]) -> Splats:
    """Splats of several projections as of one, camera after camera."""
    if len(parts) == 1:
        return parts[0]
    cameras = [0]
    splits = [parts[0].row_splits[:1]]
    for part in parts:
        cameras.append(cameras[-1] + part.cameras)
        splits.append(splits[-1][-1] + part.row_splits[1:])
    rows = {name: torch.cat([getattr(part, name) for part in parts]) for name in ROWS}
    rows["camera_ids"] = torch.cat([part.camera_ids + first for part, first in zip(parts, cameras)])
    return dataclasses.replace(parts[0], row_splits=torch.cat(splits), **rows)
