"""The holder of Gaussians: the numbers that files hold and that training changes."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from . import _C
from .activations import activate
from .checks import check_tensors, check_value, plain_value

SH_C0 = 0.28209479177387814  # value of the constant spherical harmonic
NEIGHBOURS = 3  # whose distances make the scale of a Gaussian at a point

# What `trainable` keeps parameters within: a scale of 0 and an opacity of 0 or 1 have infinite ones.
LOWEST_LOG_SCALE = math.log(1e-12)
HIGHEST_LOGIT = math.log((1 - 1e-6) / 1e-6)


class Gaussians(NamedTuple):
    """Gaussians by their unconstrained parameters, one row each, of one dtype and on one device.

    These are the numbers of a 3DGS .ply and those that an optimizer changes. `arguments` gives what the rasterizer
    takes. A scale of 0 is the logarithm -inf; opacities of 0 and 1 are the logits -inf and inf.

    Attributes:
        means: (N, 3) centres, world units.
        log_scales: (N, 3) natural logarithms of the standard deviations in world units.
        rotations: (N, 4) quaternions (w, x, y, z) of any length.
        logit_opacities: (N, 1) logits.
        shs: (N, K, 3) spherical harmonics, K = (sh_degree + 1)^2.
    """

    means: Tensor
    log_scales: Tensor
    rotations: Tensor
    logit_opacities: Tensor
    shs: Tensor

    @classmethod
    def from_activated(
        cls, means: Tensor, scales: Tensor, rotations: Tensor, opacities: Tensor, shs: Tensor
    ) -> Gaussians:
        """Gaussians by what the rasterizer takes.

        Args:
            means, rotations, shs: The fields of the same names.
            scales: (N, 3) standard deviations, world units.
            opacities: (N, 1) in [0, 1].
        """
        return cls(means, scales.log(), rotations, opacities.logit(), shs)

    @classmethod
    def from_points(
        cls,
        points: Tensor,
        colors: Tensor | None = None,
        sh_degree: int = 3,
        opacity: float = 0.1,
        scale: float = 1.0,
        dtype: torch.dtype = torch.float32,
    ) -> Gaussians:
        """Round Gaussians at points, of the size of the gaps between the points: what a training starts from.

        Args:
            points: (N, 3) world units, of a floating-point dtype, at least two. On any device; the neighbours are found
                on the CPU.
            colors: (N, 3) in [0, 1], of a floating-point dtype, on the device of points; None: grey, which is the
                quickest to unlearn.
            sh_degree: Degree of the spherical harmonics, 0 to 3. All but the constant are 0.
            opacity: Of every Gaussian, above 0 and below 1.
            scale: Standard deviations, in root mean square distances of a point to its three nearest neighbours.
            dtype: Of the result: float32, or on the CPU also float64.

        Raises:
            ImportError: SciPy is missing.
            TypeError: Something is not a tensor or a number, or a tensor is of integers.
            ValueError: A shape, a device or a number does not fit, or points are not finite.

        Source: Kerbl et al., 3D Gaussian Splatting for Real-Time Radiance Field Rendering, 2023, section 5.1.
        """
        if colors is None and isinstance(points, Tensor):
            colors = torch.full_like(points, 0.5)
        check_tensors(None, points=points, colors=colors)
        for name, tensor in (("points", points), ("colors", colors)):
            if not tensor.is_floating_point():
                raise TypeError(f"{name} must have a floating-point dtype, got {tensor.dtype}")
            if tensor.dim() != 2 or tensor.shape[1] != 3 or len(tensor) != len(points) or len(tensor) < 2:
                expected = "(N, 3) with N at least 2, both of the same N"
                raise ValueError(f"{name} must have shape {expected}, got {tuple(tensor.shape)}")
            if tensor.device != points.device:
                raise ValueError(f"{name} must be on the device of points, {points.device}, got {tensor.device}")
        check_value("points", bool(points.isfinite().all()), "finite", "NaN or infinity")
        if not ((colors >= 0) & (colors <= 1)).all():
            raise ValueError(f"colors must be in [0, 1], got {colors.min().item():g} to {colors.max().item():g}")
        sh_degree = plain_value("sh_degree", sh_degree, int)
        check_value("sh_degree", 0 <= sh_degree <= 3, "0 to 3", sh_degree)
        check_value("opacity", 0 < plain_value("opacity", opacity, float) < 1, "above 0 and below 1", opacity)
        check_value("scale", 0 < plain_value("scale", scale, float) < math.inf, "positive and finite", scale)
        check_value("dtype", dtype in (torch.float32, torch.float64), "float32 or float64", dtype)
        count, distances = len(points), neighbour_distance(points)
        points, colors, distances = (tensor.detach().to(points.device, dtype) for tensor in (points, colors, distances))
        return cls(
            points,
            (scale * distances).log()[:, None].repeat(1, 3),
            points.new_tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
            points.new_full((count, 1), opacity).logit(),
            torch.cat([(colors[:, None] - 0.5) / SH_C0, points.new_zeros(count, (sh_degree + 1) ** 2 - 1, 3)], dim=1),
        )

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
        """Some of the Gaussians: `index` is a mask (N,), their numbers, or a slice."""
        return self.map(lambda field: field[index])

    def to(self, device) -> Gaussians:
        """The same on another `device`."""
        return self.map(lambda field: field.to(device))

    def leaves(self) -> Gaussians:
        """Contiguous copies that require gradients, for an optimizer."""
        return self.map(lambda field: field.detach().clone(memory_format=torch.contiguous_format).requires_grad_())

    def with_activated(self, scales: Tensor | None = None, opacities: Tensor | None = None) -> Gaussians:
        """The same with other scales (N, 3) in world units, or other opacities (N, 1) in [0, 1]."""
        return self._replace(
            log_scales=self.log_scales if scales is None else scales.log(),
            logit_opacities=self.logit_opacities if opacities is None else opacities.logit(),
        )

    def with_sh_degree(self, degree: int) -> Gaussians:
        """The same with harmonics of another degree, 0 to 4: cut, or filled with zeros.

        Raises:
            TypeError: No whole number.
            ValueError: Another degree.
        """
        degree = plain_value("degree", degree, int)
        check_value("degree", 0 <= degree <= _C.MAX_SH_DEGREE, f"0 to {_C.MAX_SH_DEGREE}", degree)
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


def neighbour_distance(points: Tensor) -> Tensor:
    """Root mean square distance of each of the (N, 3) points to its three nearest others, at least 1e-7.

    (N,) float64 on the CPU. Of fewer than four points all others count.

    Raises:
        ImportError: SciPy is missing.
    """
    from .io.errors import optional_import  # which imports this module with its package

    positions = points.detach().double().cpu().numpy()
    tree = optional_import("scipy.spatial", "train").cKDTree(positions)
    neighbours = min(NEIGHBOURS, len(points) - 1)
    distances, _ = tree.query(positions, k=neighbours + 1)
    nearest = torch.from_numpy(distances).reshape(len(points), -1)[:, 1:]  # the first is the point itself
    return nearest.square().mean(1).sqrt().nan_to_num(0).clamp_min(1e-7)
