"""Where the affine picture of a Gaussian is not enough: how much the camera's Jacobian varies over each of them.

Every splat is the picture of its Gaussian under the derivative of the camera's map at the Gaussian's centre [EWA]. The
derivative itself changes over a Gaussian that fills a large angle, and with it the picture. docs/accuracy.md says how
this number and the error of a weight go together; benchmarks/lens_accuracy.py measures it.
"""

from __future__ import annotations

import torch

from ..cameras.camera import is_orthographic
from ..cameras.lens import Lens
from ..cameras.rotations import product, rotation_matrices
from ..filters import PIXEL_VARIANCE
from ..gaussians import Gaussians
from ..render.effects import NEAR, Effects
from ..render.settings import GaussianRasterizationSettings

LIMIT = 0.3  # of `affine_error`: there a weight is off by 0.1 to 0.3 at most
_ROWS = 2**18  # that are computed at a time
# A Gaussian whose largest standard deviation is W depths has, with a pinhole, an error of at most sqrt(5 / 2) W /
# (1 - W)^2, below LIMIT for this W: with q_j the columns of J A, w_j = a_j,z / z and r = 1 +- w_k, column j of D A is
# -+ (w_k q_j / r + w_j q_k / r^2); |w| <= W, r >= 1 - W, and of q^T S^-1 q one is at most 1 and the sum of three 2.
_SMALL = 0.13
_AHEAD = 50.0  # tangent of the angle from the axis: from there a step of _SMALL depths leaves nothing that is seen


@torch.no_grad()
def affine_error(scene: Gaussians, settings: GaussianRasterizationSettings) -> torch.Tensor:
    """How much the derivative of a camera's map changes over one standard deviation of each Gaussian.

    J is the derivative at the centre, A = (a_1, a_2, a_3) the Gaussian's axes times its standard deviations, and S the
    covariance that the splat has in the picture, J A A^T J^T, plus that of a pixel. A step of one standard deviation
    along an axis changes J by D. The number is the largest |S^(-1/2) D A| / sqrt(2) (Frobenius) over the six steps: 1
    where the change is as large as the splat. The splat's weight is off by at most about as much, mostly by a third.

    A pinhole counts as a lens without coefficients. The clamp of J beside the picture (`Lens.reach`) is left out.

    Args:
        scene: P Gaussians, on any device; they are copied to the CPU.
        settings: The camera: a pinhole, one with `Effects.lens`, or an orthographic one, all of whose numbers are 0.

    Returns:
        (P,) float64 on the CPU, not negative. Infinite where a step leaves what the camera sees, NaN where the centre
        is not seen: nearer than `Effects.near`, or beyond the angle at which the map folds back. What is beside the
        picture counts as seen.

    Raises:
        TypeError: scene or settings has a wrong type.

    Source: Zwicker et al., EWA splatting, 2002, for the affine picture.
    """
    for name, value, kind in (("scene", scene, Gaussians), ("settings", settings, GaussianRasterizationSettings)):
        if not isinstance(value, kind):
            raise TypeError(f"{name} must be {kind.__name__}, got {type(value).__name__}")
    effects = settings.effects if isinstance(settings.effects, Effects) else None
    if is_orthographic(settings):
        return torch.zeros(len(scene.means), dtype=torch.float64)
    lens = effects.lens if effects and effects.lens else Lens.perspective()
    near = effects.near if effects else NEAR
    view = settings.viewmatrix.detach().double().cpu().T
    sizes = zip((settings.image_width, settings.image_height), (settings.tanfovx, settings.tanfovy))
    focal = torch.tensor([size / (2 * float(tangent)) for size, tangent in sizes], dtype=torch.float64)
    errors = []
    for first in range(0, len(scene.means), _ROWS):
        rows = scene.rows(slice(first, first + _ROWS)).map(lambda field: field.detach().double().cpu())
        axes = product(view[:3, :3], rotation_matrices(rows.rotations)) * rows.scales[:, None, :]
        centres = product(rows.means, view[:3, :3].T) + view[:3, 3]
        errors.append(_errors(lens, focal, near, centres, settings.scale_modifier * axes))
    return torch.cat(errors) if errors else torch.zeros(0, dtype=torch.float64)


@torch.no_grad()
def bends(scene: Gaussians, settings: GaussianRasterizationSettings) -> torch.Tensor:
    """(P,) bool on the CPU: whether `affine_error`, which has the same arguments and errors, is above LIMIT.

    With a pinhole it is known of most Gaussians without computing it.
    """
    effects = settings.effects if isinstance(settings.effects, Effects) else None
    lens, bent = effects and effects.lens, torch.ones(len(scene.means), dtype=torch.bool)
    is_pinhole = not lens or (lens.model == "perspective" and not any(lens.numbers()))
    if is_pinhole and not is_orthographic(settings):
        view = settings.viewmatrix.to(scene.means)
        x, y, z = (product(scene.means, view[:3, :3]) + view[3, :3]).unbind(1)
        largest = settings.scale_modifier * scene.log_scales.amax(1).exp()
        small = (z > (effects.near if effects else NEAR)) & (largest <= _SMALL * z) & (torch.hypot(x, y) <= _AHEAD * z)
        bent = ~small.cpu()
    bent[bent.clone()] = affine_error(scene.rows(bent.to(scene.means.device)), settings) > LIMIT
    return bent


def _errors(lens: Lens, focal: torch.Tensor, near: float, centres: torch.Tensor, axes: torch.Tensor) -> torch.Tensor:
    """(P,) `affine_error` of Gaussians in camera space: centres (P, 3), axes (P, 3, 3) in columns."""
    slopes, seen = _slopes(lens, focal, near, centres)
    splat = product(slopes, axes)
    covariance = product(splat, splat.mT) + PIXEL_VARIANCE * torch.eye(2, dtype=torch.float64)
    xx, xy, yy = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    # |S^(-1/2) M|^2 = tr(M^T S^-1 M), and S^-1 is (yy, -xy; -xy, xx) / det.
    determinant = xx * yy - xy * xy
    worst = torch.zeros_like(xx)
    for step in (*axes.unbind(2), *(-axes).unbind(2)):
        moved, inside = _slopes(lens, focal, 0.0, centres + step)
        x, y = product(moved - slopes, axes).unbind(1)
        square = yy * (x * x).sum(1) - 2 * xy * (x * y).sum(1) + xx * (y * y).sum(1)
        change = (square / (2 * determinant)).clamp_min(0).sqrt()
        worst = worst.maximum(torch.where(inside & change.isfinite(), change, torch.inf))
    return torch.where(seen, worst, torch.nan)


def _slopes(lens: Lens, focal: torch.Tensor, near: float, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """(P, 2, 3) px by world units, the derivative at points (P, 3) in camera space, and (P,) whether they are seen."""
    positions, slopes = lens.project(points)
    return focal[:, None] * slopes, (lens.depths(points) > near) & ~positions.isnan().any(1)
