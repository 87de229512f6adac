"""The holder of Gaussians: the numbers that files hold and that training changes."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from .activations import activate

# What `trainable` keeps parameters within: a scale of 0 and an opacity of 0 or 1 have infinite ones.
LOWEST_LOG_SCALE = math.log(1e-12)
HIGHEST_LOGIT = math.log((1 - 1e-6) / 1e-6)


class Gaussians(NamedTuple):
    """Gaussians by their unconstrained parameters, one row each, of one dtype and on one device.

    These are the numbers of a 3DGS .ply and those that an optimizer changes. `arguments` gives what the rasterizer
    takes. A scale of 0 is the logarithm -inf; opacities of 0 and 1 are the logits -inf and inf.
    """

    means: Tensor  # (N, 3) world units
    log_scales: Tensor  # (N, 3) natural logarithms of the standard deviations in world units
    rotations: Tensor  # (N, 4) quaternions (w, x, y, z) of any length
    logit_opacities: Tensor  # (N, 1)
    shs: Tensor  # (N, K, 3) spherical harmonics, K = (sh_degree + 1)^2

    @classmethod
    def from_activated(
        cls, means: Tensor, scales: Tensor, rotations: Tensor, opacities: Tensor, shs: Tensor
    ) -> Gaussians:
        """Gaussians with these standard deviations (N, 3) in world units and opacities (N, 1) in [0, 1]."""
        return cls(means, scales.log(), rotations, opacities.logit(), shs)

    @property
    def count(self) -> int:
        """N; len() is that of the tuple."""
        return len(self.means)

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics."""
        return math.isqrt(self.shs.shape[1]) - 1

    @property
    def scales(self) -> Tensor:
        """(N, 3) standard deviations, world units; a new tensor."""
        return self.log_scales.exp()

    @property
    def opacities(self) -> Tensor:
        """(N, 1) in [0, 1]; a new tensor."""
        return self.logit_opacities.sigmoid()

    def arguments(self) -> dict[str, Tensor]:
        """The keywords that `GaussianRasterizer` and `render_stages` take, activated. Differentiable."""
        scales, rotations, opacities = activate(self.log_scales, self.rotations, self.logit_opacities)
        return {
            "means3D": self.means,
            "opacities": opacities,
            "shs": self.shs,
            "scales": scales,
            "rotations": rotations,
        }

    def map(self, function: Callable[[Tensor], Tensor]) -> Gaussians:
        """The Gaussians with `function` applied to each of the five tensors."""
        return Gaussians(*map(function, self))

    def rows(self, index: Tensor | slice) -> Gaussians:
        """Some of the Gaussians: by a mask (N,), by their numbers, or by a slice."""
        return self.map(lambda field: field[index])

    def to(self, device) -> Gaussians:
        """The same on another device."""
        return self.map(lambda field: field.to(device))

    def with_activated(self, scales: Tensor | None = None, opacities: Tensor | None = None) -> Gaussians:
        """The same with other scales (N, 3) in world units, or other opacities (N, 1) in [0, 1]."""
        return self._replace(
            log_scales=self.log_scales if scales is None else scales.log(),
            logit_opacities=self.logit_opacities if opacities is None else opacities.logit(),
        )

    def with_sh_degree(self, degree: int) -> Gaussians:
        """The same with harmonics of another degree: cut, or filled with zeros."""
        wanted = (degree + 1) ** 2
        kept = self.shs[:, :wanted]
        return self._replace(shs=torch.cat([kept, kept.new_zeros(self.count, wanted - kept.shape[1], 3)], dim=1))

    @torch.no_grad()
    def trainable(self) -> Gaussians:
        """The same with finite parameters: scales of at least 1e-12, opacities from 1e-6 to 1 - 1e-6."""
        return self._replace(
            log_scales=self.log_scales.clamp_min(LOWEST_LOG_SCALE),
            logit_opacities=self.logit_opacities.clamp(-HIGHEST_LOGIT, HIGHEST_LOGIT),
        )
