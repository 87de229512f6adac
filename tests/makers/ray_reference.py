"""The order along rays written down a second time, for reference.render: slow, plain, float64.

Every pixel has an order of its own: that of the depths at which its ray meets the Gaussians (`exact_depths`, the
truth), or that of the library, csrc/core/order.h: a window over depths that are linear in the picture
(`linear_depths`). Gradients come from torch.autograd, which takes the order as given.
"""

import heapq
import math

import reference
import torch

RAY_VARIANCE = 1e-4  # px^2
LEVEL_SLACK = 5e-3
SMALLEST_SCALE = 1e-3  # of the largest of a Gaussian: a flatter one has no depth along a ray in its plane


def pixels_of(settings):
    """(H, W, 2) pixel centres."""
    sizes = settings.image_height, settings.image_width
    rows, columns = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) for n in sizes), indexing="ij")
    return torch.stack([columns, rows], -1)


def rays_of(settings):
    """Origins and directions (H, W, 3) of the pixels' rays in camera space; z of a direction is 1. Without a lens."""
    size = torch.tensor([settings.image_width, settings.image_height], dtype=torch.float64)
    projection = torch.linalg.solve(settings.viewmatrix.double(), settings.projmatrix.double())  # transposed
    ndc = (2 * pixels_of(settings) + 1) / size - 1
    scale, zero, one = projection.diagonal()[:2], torch.zeros_like(ndc), torch.ones_like(ndc[..., :1])
    if reference.effects_of(settings).orthographic:
        return torch.cat([(ndc - projection[3, :2]) / scale, 0 * one], -1), torch.cat([zero, one], -1)
    return torch.cat([zero, 0 * one], -1), torch.cat([(ndc - projection[2, :2]) / scale, one], -1)


def exact_depths(settings, means, scales, rotations):
    """(P, H, W) z of the point of every ray at which a Gaussian is densest: nearest to its mean in its whitened frame.

    P Gaussians as the rasterizer takes them, float64.
    """
    turn, shift = settings.viewmatrix.double()[:3, :3], settings.viewmatrix.double()[3, :3]  # for row vectors
    sigma = settings.scale_modifier * scales
    sigma = torch.maximum(sigma, SMALLEST_SCALE * sigma.amax(1, keepdim=True))
    whiten = (turn.T @ reference.rotation_matrix(rotations)).mT / sigma[:, :, None]
    origins, directions = rays_of(settings)
    ray = torch.einsum("pij,hwj->phwi", whiten, directions)
    to_mean = torch.einsum("pij,phwj->phwi", whiten, (means @ turn + shift)[:, None, None] - origins)
    return (ray * to_mean).sum(-1) / (ray * ray).sum(-1)


def linear_depths(settings, means, covariance, projection):
    """(P, H, W) z + Sigma_zu (Sigma_uv + v I)^-1 (pixel - mean): what the affine projection has for these depths.

    covariance (P, 3, 3) in the world; projection as reference.project has it, perhaps with the blur of a camera.
    """
    means2d, cov2d, depths = (t.detach() for t in projection)
    axis = settings.viewmatrix.double()[:3, 2]
    along = (reference.image_rows(settings, means) @ covariance @ axis).detach()
    xx, xy, yy = (cov2d + RAY_VARIANCE * cov2d.new_tensor([1.0, 0.0, 1.0])).unbind(-1)
    slopes = torch.linalg.solve(torch.stack([xx, xy, xy, yy], -1).reshape(-1, 2, 2), along)
    return depths[:, None, None] + ((pixels_of(settings) - means2d[:, None, None]) * slopes[:, None, None]).sum(-1)


def may_show(offset, cov2d, opacity, samples):
    """(H, W) bool: whether `moment` may show a splat in a pixel, in which its nodes may be anywhere.

    The Mahalanobis distance of the pixel's nearest point, which is the mean, or on an edge.
    """
    xx, xy, yy = reference.add_variance(cov2d, 1 / (12 * samples)).tolist()
    det = xx * yy - xy * xy
    peak = opacity * math.sqrt(max(reference.determinant(cov2d).item(), 0) / det)
    if peak <= reference.ALPHA_MIN:  # nowhere
        return torch.zeros(offset.shape[:-1], dtype=torch.bool)
    level = 2 * math.log(peak / reference.ALPHA_MIN) + LEVEL_SLACK

    def nearest(fixed, free, of_fixed, of_free):
        """Least distance in which one coordinate is `fixed` and the other within a half of `free`."""
        best = xy / of_fixed * fixed  # the mean of the free one, given the fixed one
        best = torch.minimum(torch.maximum(best, free - 0.5), free + 0.5)
        return (of_free * fixed**2 - 2 * xy * fixed * best + of_fixed * best**2) / det

    x, y = offset.unbind(-1)
    edges = [nearest(x + side, y, xx, yy) for side in (-0.5, 0.5)]
    edges += [nearest(y + side, x, yy, xx) for side in (-0.5, 0.5)]
    return (torch.stack(edges).amin(0) <= level) | (torch.maximum(x.abs(), y.abs()) <= 0.5)


def leaving(depths, window):
    """The places of splats in the order in which they leave a window that they enter in the order of the list.

    Also the smallest difference of two depths that were compared.
    """
    held, left, margin = [], [], math.inf

    def leave():
        nearest = heapq.heappop(held)
        nonlocal margin
        margin = min([margin, *(abs(depth - nearest[0]) for depth, _ in held)])
        left.append(nearest[1])

    for place, depth in enumerate(depths):
        heapq.heappush(held, (depth, place))
        if len(held) > window:
            leave()
    while held:
        leave()
    return left, margin


class RayOrder:
    """An `order` of reference.render.

    Args:
        depths: (P, H, W) of all Gaussians.
        window: Splats that a pixel sorts at a time; None: all.

    Attributes:
        margin: (H, W), smallest difference of two depths that a pixel compared, world units. Set by a rendering.
        shown: (H, W), how many splats entered.
    """

    def __init__(self, settings, depths, footprint, window=None, **options):
        self.settings, self.depths, self.window = settings, depths.detach(), window
        self.footprint, self.options = footprint, options
        self.margin = self.shown = None

    def __call__(self, drawn, projection, opacities):
        pixels, shape = pixels_of(self.settings), self.depths.shape[1:]
        shows = torch.stack(
            [self._shows(pixels - projection.means2d[i], projection.cov2d[i], opacities[i]) for i in drawn]
        )
        depths = self.depths[drawn].flatten(1).T.tolist()
        window = len(drawn) if self.window is None else self.window
        sequences, margins = [], []
        for of_pixel, here in zip(depths, shows.flatten(1).T.tolist()):
            entering = [place for place, shown in enumerate(here) if shown]
            left, margin = leaving([of_pixel[place] for place in entering], window)
            sequences.append([drawn[entering[place]] for place in left])
            margins.append(margin)
        length = max(map(len, sequences))
        padded = [sequence + [-1] * (length - len(sequence)) for sequence in sequences]
        self.margin = torch.tensor(margins, dtype=torch.float64).reshape(shape)
        self.shown = torch.tensor([len(sequence) for sequence in sequences]).reshape(shape)
        return torch.tensor(padded).reshape(*shape, length).movedim(-1, 0).unbind(0)

    def _shows(self, offset, cov2d, opacity):
        offset, cov2d, opacity = offset.detach(), cov2d.detach(), opacity.detach()
        if self.footprint == "moment":
            samples = reference.settled(self.footprint, self.options)["samples"]
            return may_show(offset, cov2d, opacity.item(), samples)
        weights = reference.sample_weights(offset, cov2d, self.footprint, **self.options)
        return (opacity * weights >= reference.ALPHA_MIN).any(0)


def render(settings, means3D, means2D, opacities, *, footprint, window=None, exact=False, **given):
    """As reference.render, in the order along rays. Returns what that returns, and the `RayOrder`.

    Args:
        window: As RayOrder has it.
        exact: By exact_depths(), which need scales and rotations; else by linear_depths().
    """
    options = {name: given[name] for name in given if name in ("samples", "dilation", "variance", "frame_gradient")}
    if given.get("cov3D_precomp") is None:
        covariance = reference.covariance_3d(given["scales"], given["rotations"], settings.scale_modifier)
    else:
        covariance = reference.unpack_covariance(given["cov3D_precomp"])
    if exact:
        depths = exact_depths(settings, means3D, given["scales"], given["rotations"])
    else:
        projection, effects = reference.project(settings, means3D, covariance), reference.effects_of(settings)
        if effects.defocus is not None or effects.motion is not None:
            view = settings.viewmatrix.double()
            in_camera = means3D @ view[:3, :3] + view[3, :3]
            projection = projection._replace(cov2d=reference.blur(settings, projection, in_camera)[0])
        depths = linear_depths(settings, means3D, covariance, projection)
    order = RayOrder(settings, depths, footprint, window, **options)
    return reference.render(settings, means3D, means2D, opacities, footprint=footprint, order=order, **given), order
