"""The rasterizer written down a second time: slow, plain, float64, straight from the equations.

Nothing here is shared with the library. Gradients come from torch.autograd, so that what the
library derives by hand is compared with what is derived by machine. Pixels are vectorised,
Gaussians are a Python loop in depth order. Sources: [AS, Eq. n] is the supplement of
Analytic-Splatting; the cumulant weight, the box pattern and the frozen frame follow the project's
numerics notes; the rest is the published image formation of 3D Gaussian Splatting.

Conventions: pixel centres at integers; offset = pixel centre - projected mean [px]; a 2x2
covariance is (..., 3) = (xx, xy, yy) [px^2]; a 3x3 covariance is (..., 6) = (xx, xy, xz, yy, yz,
zz); view and projection matrices are transposed, as 3DGS passes them.
"""

import functools
import math
from typing import NamedTuple

import pytest
import torch

NEAR = 0.2
ALPHA_MIN = 1 / 255
ALPHA_MAX = 0.99
TRANSMITTANCE_MIN = 1e-4
FRUSTUM_CLAMP = 1.3

DEFAULT_OPTIONS = {
    "point": {"dilation": 0.3},
    "mip": {"variance": 0.1},
    "analytic": {"frame_gradient": "frozen"},
    "cumulant": {},
    "box": {"samples": 4},
    "moment": {"samples": 4},
    "erf": {},
    "exact": {},
}


def settled(footprint, options):
    """All options of a footprint. Skips the test where this file has no formula of it: it is somebody's own."""
    if footprint not in DEFAULT_OPTIONS:
        pytest.skip(f"tests/makers/reference.py has no formula of footprint {footprint!r}")
    return DEFAULT_OPTIONS[footprint] | options


# --- one splat, one pixel -----------------------------------------------------------------------


def determinant(cov2d):
    """Determinant of (..., 3) covariances, [px^4]."""
    xx, xy, yy = cov2d.unbind(-1)
    return xx * yy - xy * xy


def add_variance(cov2d, variance):
    """Sigma + variance * I."""
    return cov2d + variance * cov2d.new_tensor([1.0, 0.0, 1.0])


def quadratic(offset, cov2d):
    """d^T Sigma^-1 d."""
    x, y = offset.unbind(-1)
    xx, xy, yy = cov2d.unbind(-1)
    return (yy * x * x - 2 * xy * x * y + xx * y * y) / determinant(cov2d)


def gaussian(offset, cov2d):
    """exp(-q/2): the splat itself, peak 1."""
    return torch.exp(-quadratic(offset, cov2d) / 2)


def blurred(offset, cov2d, variance):
    """The splat convolved with a round Gaussian of the given variance: an exact convolution."""
    wider = add_variance(cov2d, variance)
    amplitude = torch.sqrt(determinant(cov2d) / determinant(wider))
    return amplitude * gaussian(offset, wider)


def cumulant(offset, cov2d):
    """The pixel box through its cumulants of order 2, 4 and 6 ("Q6" of the numerics notes)."""
    x, y = offset.unbind(-1)
    wider = add_variance(cov2d, 1 / 12)
    xx, xy, yy = wider.unbind(-1)
    det = determinant(wider)
    a, b, c = yy / det, -xy / det, xx / det

    def axis(p, t):
        square, x = p * p, t / 12
        c4 = 1 + (20 / 7) * x + 0.4366 * x * x
        k2 = 1 + (10 / 7) * x + 0.6240 * x * x
        k0 = 1 + (20 / 21) * x + 0.6975 * x * x
        c6 = torch.clamp(1 - x, min=1e-6) / 63
        capped = torch.minimum(square, c4 / (2 * c6))
        return square**2 * (c4 - c6 * capped) - 6 * square * t * k2 + 3 * t * t * k0

    correction = (axis(a * x + b * y, a) + axis(b * x + c * y, c)) / 2880
    amplitude = torch.sqrt(determinant(cov2d) / det)
    return amplitude * torch.exp(-quadratic(offset, wider) / 2 - correction)


def logistic_cdf(x):
    """S(x), the paper's stand-in for the normal CDF [AS, Eq. 5]."""
    return torch.sigmoid(1.6 * x + 0.07 * x**3)


def logistic_pdf(x):
    """dS/dx [AS, Eq. 10]."""
    s = logistic_cdf(-x.abs())
    return (1.6 + 0.21 * x * x) * s * (1 - s)


def normal_cdf(x):
    """The CDF that S stands in for."""
    return torch.special.ndtr(x)


def normal_pdf(x):
    """Its density."""
    return torch.exp(-x * x / 2) / math.sqrt(2 * math.pi)


def logistic_window(u, sigma):
    """S((u + 1/2)/sigma) - S((u - 1/2)/sigma), the paper's 1D window [AS, Eq. 7].

    With S(x) = sigmoid(f(x)): S(b) - S(a) = S(b) (1 - S(a)) (1 - exp(f(a) - f(b))), and f(b) - f(a)
    is expanded, so that nothing cancels however wide or narrow the Gaussian. test_reference.py
    compares it with the plain difference.
    """
    centre, half = u / sigma, 0.5 / sigma
    high, low = centre + half, centre - half
    rise = 3.2 * half + 0.07 * half * (6 * centre**2 + 2 * half**2)
    return logistic_cdf(high) * logistic_cdf(-low) * -torch.expm1(-rise)


def normal_window(u, sigma):
    """The same with the exact CDF.

    The difference of two values, on the side where both are small; and where it would cancel,
    beyond one pixel of deviation, eight Gauss-Legendre nodes on the density (error 3e-17).
    """
    u = -u.abs()
    if (sigma <= 1).all():
        return normal_cdf((u + 0.5) / sigma) - normal_cdf((u - 0.5) / sigma)
    wide = torch.clamp(sigma, min=1.0)  # keeps what is not selected harmless
    density = sum(w / 2 * normal_pdf((u + x / 2) / wide) / wide for x, w in zip(*legendre(8), strict=True))
    difference = normal_cdf((u + 0.5) / sigma) - normal_cdf((u - 0.5) / sigma)
    return torch.where(sigma > 1, density, difference)


def rotated_window(offset, cov2d, frame_gradient="paper", window=logistic_window, pdf=logistic_pdf):
    """The pixel turned into the splat's eigenframe, where the integral separates [AS, Eq. 2-9].

    The value does not depend on frame_gradient. "paper" differentiates the formula, so the pixel
    turns with the eigenvectors. "frozen" differentiates the integral over a window that stays where
    it is while Sigma changes. In that fixed frame Sigma gets an off-diagonal entry B (zero here),
    and because a Gaussian solves the heat equation, dI/dB = d2I/(du dv), which separates at B = 0.
    """
    xx, xy, yy = cov2d.unbind(-1)
    matrix = torch.stack([torch.stack([xx, xy], -1), torch.stack([xy, yy], -1)], -2)
    if frame_gradient == "paper":
        (l2, l1), axes = (t.movedim(-1, 0) for t in torch.linalg.eigh(matrix))
        v2, v1 = axes
        cross = None
    else:
        axes = torch.linalg.eigh(matrix.detach()).eigenvectors
        v2, v1 = axes[..., 0], axes[..., 1]

        def form(p, q):
            return torch.einsum("...i,...ij,...j->...", p, matrix, q)

        l1, l2, cross = form(v1, v1), form(v2, v2), form(v1, v2)
    u, v = (offset * v1).sum(-1), (offset * v2).sum(-1)
    s1, s2 = torch.sqrt(l1), torch.sqrt(l2)
    weight = 2 * math.pi * s1 * s2 * window(u, s1) * window(v, s2)
    if cross is not None:
        # s dF/du of each axis; only the derivative of `cross` matters, its value is zero.
        du = pdf((u + 0.5) / s1) - pdf((u - 0.5) / s1)
        dv = pdf((v + 0.5) / s2) - pdf((v - 0.5) / s2)
        weight = weight + (cross - cross.detach()) * (2 * math.pi * du * dv).detach()
    return weight


def box_nodes(samples):
    """Nodes (S, 2) [px] of the `box` footprint, from the numerics notes."""
    half = {
        4: [(-0.12083, -0.36226), (0.36226, -0.12083)],
        16: [
            (0.26975, -0.14597), (0.14427, -0.43939), (0.06200, -0.14646), (0.18749, 0.14720),
            (0.43551, -0.31294), (0.39499, 0.06396), (0.10473, 0.35640), (0.39573, 0.39912),
        ],
    }  # fmt: skip
    if samples == 1:
        return torch.zeros(1, 2, dtype=torch.float64)
    nodes = torch.tensor(half[samples], dtype=torch.float64)
    return torch.cat([nodes, -nodes])


def box_variance(samples):
    """Variance [px^2] of each of the S small Gaussians: 1/12 of one, else 1/(24 S)."""
    return 1 / 12 if samples == 1 else 1 / (24 * samples)


def cell_nodes(samples):
    """Centres (S, 2) [px] of the equal square cells of the pixel, row by row."""
    side = math.isqrt(samples)
    axis = (torch.arange(side, dtype=torch.float64) + 0.5) / side - 0.5
    y, x = torch.meshgrid(axis, axis, indexing="ij")
    return torch.stack([x, y], -1).reshape(-1, 2)


def moved_nodes(moved, offset, cov2d, samples, alpha):
    """Displacements (S, ..., 2) of the nodes of `moment` behind a splat, from those in front of it.

    The light of a cell is a round Gaussian of the cell's variance about its node, of which the splat
    passes 1 - alpha: the centroid of what is left, by the formula for the product of two Gaussians.
    offset (..., 2), alpha (S, ...) as composited.
    """
    xx, xy, yy = add_variance(cov2d, 1 / (12 * samples)).unbind(-1)
    x, y = (offset + cell_nodes(samples).reshape(samples, *[1] * (offset.dim() - 1), 2) + moved).unbind(-1)
    pull = torch.stack([yy * x - xy * y, xx * y - xy * x], -1) / (xx * yy - xy * xy)[..., None]
    taken = (alpha / (1 - alpha) / (12 * samples))[..., None]
    return moved + taken * pull


def sample_weights(offset, cov2d, footprint, moved=None, **options):
    """Weights (S, ...) of the samples that are composited on their own; S = 1 for all but `box` and `moment`.

    `moved` (S, ..., 2) is what moved_nodes() says, by default nothing.
    """
    options = settled(footprint, options)
    if footprint == "point":
        return gaussian(offset, add_variance(cov2d, options["dilation"]))[None]
    if footprint == "mip":
        return blurred(offset, cov2d, options["variance"])[None]
    if footprint == "analytic":
        return rotated_window(offset, cov2d, options["frame_gradient"])[None]
    if footprint == "cumulant":
        return cumulant(offset, cov2d)[None]
    if footprint == "erf":
        return rotated_window(offset, cov2d, "frozen", normal_window, normal_pdf)[None]
    if footprint == "exact":
        # As many panels per deviation as exact_weight() has by default at 0.01 px.
        xx, xy, yy = cov2d.detach().unbind(-1)
        larger = (xx + yy) / 2 + torch.hypot((xx - yy) / 2, xy)
        smallest = torch.sqrt(determinant(cov2d.detach()) / larger).min().item()
        # Beyond, the weight is below 10.5 exp(-50) (docs/internals/numerics.md, "Support").
        near = quadratic(offset.detach(), add_variance(cov2d.detach(), 1 / 12)) < 100
        value = offset.new_zeros(near.shape)
        if near.any():
            d, c = (t.expand(*near.shape, -1)[near] for t in (offset, cov2d))
            value = value.masked_scatter(near, exact_weight(d, c, panels=min(64, math.ceil(0.64 / smallest))))
        return value[None]
    if footprint == "moment":
        samples = options["samples"]
        moved = torch.zeros(samples, 2, dtype=torch.float64) if moved is None else moved
        nodes = cell_nodes(samples)
        return torch.stack(
            [blurred(offset + n + m, cov2d, 1 / (12 * samples)) for n, m in zip(nodes, moved, strict=True)]
        )
    if footprint == "box":
        variance = box_variance(options["samples"])
        nodes = box_nodes(options["samples"])
        return torch.stack([blurred(offset + node, cov2d, variance) for node in nodes])
    raise AssertionError(footprint)


def weight(offset, cov2d, footprint, **options):
    """Weight I (...) of one splat in one pixel: offset (..., 2), cov2d (..., 3), broadcast."""
    return sample_weights(offset, cov2d, footprint, **options).mean(0)


def exact_weight(offset, cov2d, panels=64, order=10):
    """Integral of exp(-q/2) over the unit pixel: composite Gauss-Legendre times the normal CDF.

    The outer axis is the one with the larger variance, so that nothing varies faster along it than
    the conditional deviation of the other axis; 64 panels of 10 nodes resolve deviations down to
    0.01 px to 1e-13. Differentiable in both arguments.
    """
    offset, cov2d = torch.broadcast_tensors(torch.nn.functional.pad(offset, (0, 1)), cov2d)  # (..., 3)
    x, y, _ = offset.unbind(-1)
    xx, xy, yy = cov2d.unbind(-1)
    swap = yy > xx
    x, y = torch.where(swap, y, x), torch.where(swap, x, y)
    wide = torch.where(swap, yy, xx)
    deviation = torch.sqrt(determinant(cov2d) / wide)

    reach = 9 * torch.sqrt(wide.detach())  # exp(-40) and less beyond
    low = torch.clamp(x.detach() - 0.5, -reach, reach)
    high = torch.clamp(x.detach() + 0.5, -reach, reach)
    nodes, node_weights = legendre(order)
    step = (high - low) / panels
    starts = low[..., None] + step[..., None] * torch.arange(panels, dtype=torch.float64)
    outer = starts[..., None] + step[..., None, None] * (nodes + 1) / 2
    # Nodes move with the pixel when x is differentiated: t is constant in x - t.
    outer = outer + (x - x.detach())[..., None, None]

    def expand(t):
        return t[..., None, None]

    strip = normal_window(expand(y) - expand(xy / wide) * outer, expand(deviation))
    values = torch.exp(-outer * outer / (2 * expand(wide))) * strip
    total = (values * node_weights / 2).sum((-1, -2)) * step
    return total * deviation * math.sqrt(2 * math.pi)


def legendre(order):
    """Gauss-Legendre nodes and weights on [-1, 1] (Golub-Welsch)."""
    k = torch.arange(1, order, dtype=torch.float64)
    off_diagonal = k / torch.sqrt(4 * k * k - 1)
    jacobi = torch.diag(off_diagonal, 1) + torch.diag(off_diagonal, -1)
    nodes, vectors = torch.linalg.eigh(jacobi)
    return nodes, 2 * vectors[0] ** 2


# --- from the Gaussian to the splat -------------------------------------------------------------


def rotation_matrix(quaternion):
    """(P, 3, 3) of quaternions (P, 4) = (w, x, y, z); normalised here, zero is identity."""
    norm = quaternion.detach().norm(dim=-1, keepdim=True)
    identity = quaternion.new_tensor([1.0, 0.0, 0.0, 0.0])
    safe = torch.where(norm > 0, quaternion, identity)
    w, x, y, z = (safe / safe.norm(dim=-1, keepdim=True)).unbind(-1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def covariance_3d(scales, rotations, scale_modifier):
    """R S S R^T (P, 3, 3) with S = scale_modifier * diag(scales)."""
    axes = rotation_matrix(rotations) * (scale_modifier * scales)[:, None, :]
    return axes @ axes.transpose(-1, -2)


def unpack_covariance(packed):
    """(P, 6) = (xx, xy, xz, yy, yz, zz) to (P, 3, 3)."""
    xx, xy, xz, yy, yz, zz = packed.unbind(-1)
    rows = [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def spherical_harmonics(degree, direction):
    """Real basis (P, (degree + 1)^2), signs and order of 3DGS; direction (P, 3) of unit length."""
    x, y, z = direction.unbind(-1)

    def factor(value):
        return math.sqrt(value / math.pi)

    basis = [torch.full_like(x, factor(1 / 4))]
    if degree >= 1:
        basis += [-factor(3 / 4) * y, factor(3 / 4) * z, -factor(3 / 4) * x]
    if degree >= 2:
        basis += [
            factor(15 / 4) * x * y,
            -factor(15 / 4) * y * z,
            factor(5 / 16) * (2 * z * z - x * x - y * y),
            -factor(15 / 4) * x * z,
            factor(15 / 16) * (x * x - y * y),
        ]
    if degree >= 3:
        basis += [
            -factor(35 / 32) * y * (3 * x * x - y * y),
            factor(105 / 4) * x * y * z,
            -factor(21 / 32) * y * (4 * z * z - x * x - y * y),
            factor(7 / 16) * z * (2 * z * z - 3 * x * x - 3 * y * y),
            -factor(21 / 32) * x * (4 * z * z - x * x - y * y),
            factor(105 / 16) * z * (x * x - y * y),
            -factor(35 / 32) * x * (x * x - 3 * y * y),
        ]
    if degree >= 4:
        basis += [
            factor(315 / 16) * x * y * (x * x - y * y),
            -factor(315 / 32) * y * z * (3 * x * x - y * y),
            factor(45 / 16) * x * y * (7 * z * z - 1),
            -factor(45 / 32) * y * z * (7 * z * z - 3),
            factor(9 / 256) * (35 * z**4 - 30 * z**2 + 3),
            -factor(45 / 32) * x * z * (7 * z * z - 3),
            factor(45 / 64) * (x * x - y * y) * (7 * z * z - 1),
            -factor(315 / 32) * x * z * (x * x - 3 * y * y),
            factor(315 / 256) * (x**4 - 6 * x**2 * y**2 + y**4),
        ]
    return torch.stack(basis, -1)


def sh_color(degree, shs, direction):
    """max(0, SH + 1/2) (P, 3) seen along direction (P, 3), of any length; shs (P, M, 3), M >= (degree + 1)^2."""
    direction = torch.nn.functional.normalize(direction, dim=-1)
    basis = spherical_harmonics(degree, direction)
    color = (basis[:, :, None] * shs[:, : basis.shape[1]]).sum(1) + 0.5
    return torch.clamp(color, min=0)


class Projection(NamedTuple):
    """Every Gaussian in the image plane: mean [px], covariance [px^2], depth [world units]."""

    means2d: torch.Tensor
    cov2d: torch.Tensor
    depths: torch.Tensor


def image_rows(settings, means):
    """(P, 2, 3) of means (P, 3) in the world: the affine projection [EWA] from the world to px."""
    effects = effects_of(settings)
    size = means.new_tensor([settings.image_width, settings.image_height])
    viewmatrix, projmatrix = settings.viewmatrix.double(), settings.projmatrix.double()
    view = torch.cat([means, torch.ones_like(means[:, :1])], -1) @ viewmatrix
    tangent = torch.stack([torch.as_tensor(t, dtype=torch.float64) for t in (settings.tanfovx, settings.tanfovy)])
    focal = size / (2 * tangent)
    z = view[:, 2]
    limit, center = FRUSTUM_CLAMP * tangent, torch.zeros_like(tangent)
    if effects.off_center:  # projmatrix is viewmatrix times the transposed projection
        projection = torch.linalg.solve(viewmatrix, projmatrix)
        center = -projection[2, :2] / torch.stack([projection[0, 0], projection[1, 1]])
    slope = torch.minimum(torch.maximum(view[:, :2] / z[:, None], center - limit), center + limit)
    if effects.orthographic:
        z, slope = torch.ones_like(z), torch.zeros_like(slope)
    zero = torch.zeros_like(z)
    jacobian = torch.stack(
        [
            torch.stack([focal[0] / z, zero, -focal[0] * slope[:, 0] / z], -1),
            torch.stack([zero, focal[1] / z, -focal[1] * slope[:, 1] / z], -1),
        ],
        -2,
    )
    return jacobian @ viewmatrix[:3, :3].T


def project(settings, means, covariance):
    """EWA projection of means (P, 3) and 3D covariances (P, 3, 3)."""
    size = means.new_tensor([settings.image_width, settings.image_height])
    viewmatrix, projmatrix = settings.viewmatrix.double(), settings.projmatrix.double()
    homogeneous = torch.cat([means, torch.ones_like(means[:, :1])], -1)
    view = homogeneous @ viewmatrix
    clip = homogeneous @ projmatrix
    means2d = ((clip[:, :2] / clip[:, 3:] + 1) * size - 1) / 2
    to_image = image_rows(settings, means)
    full = to_image @ covariance @ to_image.transpose(-1, -2)
    cov2d = torch.stack([full[:, 0, 0], full[:, 0, 1], full[:, 1, 1]], -1)
    return Projection(means2d, cov2d, view[:, 2])


class Plain(NamedTuple):
    """A camera without effects."""

    near: float = NEAR
    far: float = math.inf
    orthographic: bool = False
    off_center: bool = False
    defocus: None = None
    motion: None = None


def effects_of(settings):
    return getattr(settings, "effects", None) or Plain()


def blur(settings, projection, view):
    """What the lens and the shutter make of cov2d, and the amplitudes: (P, 3), (P,)."""
    effects, cov2d = effects_of(settings), projection.cov2d
    tangent = torch.stack([torch.as_tensor(t, dtype=torch.float64) for t in (settings.tanfovx, settings.tanfovy)])
    focal = torch.tensor([settings.image_width, settings.image_height]) / (2 * tangent)
    z, number = view[:, 2], functools.partial(torch.as_tensor, dtype=torch.float64)
    blurred_cov = cov2d
    if effects.defocus is not None:
        aperture, focus = (number(v) for v in (effects.defocus.aperture, effects.defocus.focus))
        distance = z - focus if effects.orthographic else 1 / focus - 1 / z
        diameter = focal.prod().sqrt() * aperture * distance
        blurred_cov = blurred_cov + (diameter**2 / 16)[:, None] * torch.tensor([1.0, 0.0, 1.0])
    if effects.motion is not None:
        m = effects.motion
        velocity, turn = (number([0.0] * 3 if v is None else v) for v in (m.velocity, m.angular_velocity))
        screen = number([0.0] * 2 if m.screen_velocity is None else m.screen_velocity)
        flow = -velocity - torch.linalg.cross(turn.expand_as(view), view)
        if effects.orthographic:
            speed = focal * flow[:, :2]
        else:
            speed = focal * (flow[:, :2] / z[:, None] - view[:, :2] * flow[:, 2:] / z[:, None] ** 2)
        u, v = ((speed + screen) * number(m.exposure)).unbind(-1)
        blurred_cov = blurred_cov + torch.stack([u * u, u * v, v * v], -1) / 12
    return blurred_cov, (determinant(cov2d) / determinant(blurred_cov)).sqrt()


# --- the image ----------------------------------------------------------------------------------


class Rendered(NamedTuple):
    """What render() returns. P Gaussians, image (3, H, W).

    `margin` is the smallest relative distance of any alpha or transmittance that was compared with
    a threshold from that threshold: finite differences and float32 are meaningful only well inside
    it. `pixel_margin` (H, W) is the same per pixel. `offsets` maps a Gaussian to its (H, W, 2)
    offsets, whose gradient (kept) is minus the gradient of the mean, pixel by pixel.
    """

    color: torch.Tensor
    radii: torch.Tensor
    projection: Projection
    margin: float
    pixel_margin: torch.Tensor
    offsets: dict


def radius_covariance(cov2d, footprint, **options):
    """The covariance whose largest eigenvalue decides the radius."""
    options = settled(footprint, options)
    added = {
        "point": options.get("dilation"),
        "mip": options.get("variance"),
        "analytic": 0.0,
        "cumulant": 1 / 12,
        "box": 1 / 12,
        "moment": 1 / 12,
        "erf": 0.0,
        "exact": 1 / 12,
    }[footprint]
    return add_variance(cov2d, added)


def three_sigma(cov2d, footprint, **options):
    """3 sqrt(largest eigenvalue) [px], before rounding up; of round splats a little more, as 3DGS has it."""
    xx, xy, yy = radius_covariance(cov2d, footprint, **options).unbind(-1)
    largest = (xx + yy) / 2 + torch.hypot((xx - yy) / 2, xy).clamp_min(math.sqrt(0.1))
    return 3 * torch.sqrt(largest)


def render(
    settings,
    means3D,
    means2D,
    opacities,
    shs=None,
    colors_precomp=None,
    scales=None,
    rotations=None,
    cov3D_precomp=None,
    *,
    footprint,
    keep_offsets=False,
    order=None,
    **options,
):
    """Render P Gaussians; arguments as the library's rasterizer takes them, all float64.

    means2D (P, 2 or more) or None: its value is ignored, its gradient is dL/d(mean in px) * (W, H)
    / 2. `order` makes an order of every pixel (ray_reference.py): of what is drawn, front to back by the centres, and
    the projection it makes steps, (H, W) indices of Gaussians, -1 for none; without it all pixels have that order.
    """
    height, width = settings.image_height, settings.image_width
    half = torch.tensor([width / 2, height / 2], dtype=torch.float64)
    if cov3D_precomp is None:
        covariance = covariance_3d(scales, rotations, settings.scale_modifier)
    else:
        covariance = unpack_covariance(cov3D_precomp)
    projection = project(settings, means3D, covariance)
    effects = effects_of(settings)
    view = (torch.cat([means3D, torch.ones_like(means3D[:, :1])], -1) @ settings.viewmatrix.double())[:, :3]
    if effects.defocus is not None or effects.motion is not None:
        cov2d, amplitudes = blur(settings, projection, view)
        projection, opacities = projection._replace(cov2d=cov2d), opacities.reshape(-1) * amplitudes
    means2d, cov2d, depths = projection
    if means2D is not None:
        means2d = means2d + (means2D[:, :2] - means2D[:, :2].detach()) * half
    if colors_precomp is None:
        seen_from = means3D - settings.campos.double()
        if effects.orthographic:
            seen_from = settings.viewmatrix.double()[:3, 2].expand_as(means3D)
        colors = sh_color(settings.sh_degree, shs, seen_from)
    else:
        colors = colors_precomp
    opacities = opacities.reshape(-1)

    rows, columns = torch.meshgrid(
        torch.arange(height, dtype=torch.float64), torch.arange(width, dtype=torch.float64), indexing="ij"
    )
    pixels = torch.stack([columns, rows], -1)
    samples = settled(footprint, options).get("samples", 1)
    transmittance = torch.ones(samples, height, width, dtype=torch.float64)
    stopped = torch.zeros(samples, height, width, dtype=torch.bool)
    color = torch.zeros(3, height, width, dtype=torch.float64)
    pixel_margin = torch.full((height, width), math.inf, dtype=torch.float64)
    moved = torch.zeros(samples, height, width, 2, dtype=torch.float64) if footprint == "moment" else None
    offsets, touched = {}, torch.zeros(len(means3D), dtype=torch.bool)

    def keep_away(value, threshold, where):
        distance = torch.where(where, (value.detach() / threshold - 1).abs(), math.inf)
        torch.minimum(pixel_margin, distance.amin(0), out=pixel_margin)

    drawn = [
        i
        for i in torch.argsort(depths.detach(), stable=True).tolist()
        if effects.near < depths[i] < effects.far and determinant(cov2d[i]) > 0
    ]
    steps = drawn if order is None else order(drawn, Projection(means2d, cov2d, depths), opacities)
    for i in steps:
        if order is not None:
            present, i = i >= 0, torch.where(i >= 0, i, drawn[0])
        offset = pixels - means2d[i]
        if keep_offsets and order is None and offset.requires_grad:
            offset.retain_grad()
            offsets[i] = offset
        response = opacities[i] * sample_weights(offset, cov2d[i], footprint, moved=moved, **options)
        if order is not None:
            response = torch.where(present, response, 0.0)
        keep_away(response, ALPHA_MIN, ~stopped)
        keep_away(response, ALPHA_MAX, ~stopped)
        alpha = torch.where(response < ALPHA_MAX, response, ALPHA_MAX)
        blended = (alpha >= ALPHA_MIN) & ~stopped
        if order is None:
            touched[i] = (alpha >= ALPHA_MIN).any()
        else:
            touched[i[(alpha >= ALPHA_MIN).any(0)]] = True
        alpha = torch.where(blended, alpha, 0.0)
        following = transmittance * (1 - alpha)
        keep_away(following, TRANSMITTANCE_MIN, blended)
        stopped = stopped | (following.detach() < TRANSMITTANCE_MIN)
        alpha = torch.where(stopped, 0.0, alpha)
        shown = colors[i][:, None, None] if order is None else colors[i].movedim(-1, 0)
        color = color + (transmittance * alpha).mean(0) * shown
        transmittance = transmittance * (1 - alpha)
        if moved is not None:
            half = 0.5 / math.isqrt(samples)  # nodes stay in their cells
            moved = moved_nodes(moved, offset, cov2d[i], samples, alpha)
            keep_away(moved.abs().amax(-1), half, blended & ~stopped)
            keep_away(moved.abs().amin(-1), half, blended & ~stopped)
            moved = moved.clamp(-half, half)
    color = color + transmittance.mean(0) * settings.bg.double()[:, None, None]
    radii = torch.ceil(three_sigma(cov2d.detach(), footprint, **options)) * touched
    return Rendered(color, radii.int(), projection, pixel_margin.min().item(), pixel_margin, offsets)


def absolute_gradient(rendered, count, settings):
    """Columns 2:4 of a (P, 4) means2D gradient: sum over pixels of |dL/d(mean)| * (W, H) / 2."""
    return _sum_over_pixels(rendered, count, settings, torch.abs)


def norm_gradient(rendered, count, settings):
    """The sum over pixels of the length of dL/d(mean) * (W, H) / 2."""
    return _sum_over_pixels(rendered, count, settings, lambda grad: grad.norm(dim=-1, keepdim=True))[:, 0]


def _sum_over_pixels(rendered, count, settings, of_pixel):
    out = torch.zeros(count, 2, dtype=torch.float64)
    scale = torch.tensor([settings.image_width / 2, settings.image_height / 2])
    for i, offset in rendered.offsets.items():
        if offset.grad is not None:
            out[i] += of_pixel(offset.grad * scale).sum((0, 1))
    return out
