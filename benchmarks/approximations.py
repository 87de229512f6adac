"""What else errs, besides integrating over the pixel: how much a picture changes when another approximation is removed.

    python benchmarks/approximations.py SCENE --views VIEWS [--scales 1,4] [--crop 32 32] [--samples 4]

Renders the middle of every view by brute force, in float64: every splat in every sample, samples x samples unfiltered
samples in a pixel on a regular grid, averaged. The first picture is what every footprint approximates, the integral of
the picture of 3DGS over the pixel. Then one approximation after the other is taken away, each from the first picture,
and at last all of them:

- order: splats are composited in the order in which the ray of the sample meets them, each at the point of the ray
  where its density is largest, instead of in that of their centres.
- 1/255: splats are shown however faint they are (here: down to FAINTEST).
- 0.9999: a sample never stops, instead of where its transmittance would fall below 1e-4.
- projection: alpha is the opacity times exp(-q/2), q the smallest Mahalanobis distance, squared, of a point of the ray
  from the Gaussian in space. The affine projection [EWA] takes the rays near a Gaussian to be parallel.
- projection, integral: the same with the integral of the Gaussian along the ray, relative to that along the ray through
  its centre, in place of the maximum. For parallel rays both are what [EWA] has.
- all: order, both thresholds and projection (maximum) at once.

Prints the PSNR [dB] between each picture and the first (the lower, the larger the error of the approximation), and that
between the first picture and the library's own samples, which checks the program. It uses the library to project, so
its Gaussians, colours and clamps are those of the library.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass

import torch
from common import save_json
from scene_files import load_scene

import analytic_rasterizer as ar
from analytic_rasterizer import _C, io
from analytic_rasterizer.analysis.reference import UNFILTERED, image_errors, supersampled
from analytic_rasterizer.analysis.tables import markdown_table
from analytic_rasterizer.cameras.rotations import rotation_matrices
from analytic_rasterizer.cli.arguments import add_scales, whole_reductions
from analytic_rasterizer.gaussians import Gaussians

ALPHA_MAX, TRANSMITTANCE_MIN = 0.99, 1e-4
FAINTEST = 1e-5  # alphas below this are left out everywhere
REACH = 1.5  # splats are looked for so many times as far away, since their outlines are not those of [EWA]
BLOCK = 16  # px; the splats of a block are looked for once
ELEMENTS = 2**18  # of a tensor: samples times splats


@dataclass(frozen=True)
class Variant:
    """Which approximations of 3DGS are made."""

    central_order: bool = True
    alpha_min: float = _C.ALPHA_MIN
    transmittance_min: float = TRANSMITTANCE_MIN
    projection: str = "affine"  # or "maximum", "integral", "ahead"


VARIANTS = {
    "order": Variant(central_order=False),
    "1/255": Variant(alpha_min=FAINTEST),
    "0.9999": Variant(transmittance_min=0.0),
    "projection": Variant(projection="maximum"),
    "projection, integral": Variant(projection="integral"),
    "all": Variant(False, FAINTEST, 0.0, "maximum"),
}


class Splats:
    """What one view may show, front to back by the depth of the centres. All tensors float64, a row per splat.

    Attributes: mean (N, 2) px, conic (N, 3) of (xx, xy, yy) px^-2, extent (N, 2) px to alpha FAINTEST, opacity (N,),
    color (N, 3), whiten (N, 3, 3) camera space to units of the Gaussian's axes, centre (N, 3) camera space, cov (N, 3)
    of (xx, xy, yy) px^2, det (N,) px^4, axes (N, 3, 3) in camera space, in columns, scales (N, 3).
    """

    def __init__(self, scene: Gaussians, view: io.View):
        scene = scene.map(torch.Tensor.double)
        settings = view.settings(sh_degree=scene.sh_degree, footprint=UNFILTERED)
        doubles = {name: getattr(settings, name).double() for name in ("viewmatrix", "projmatrix", "campos", "bg")}
        # As opaque as can be, so that projection culls none for being faint.
        gaussians = scene.arguments() | {"opacities": torch.ones_like(scene.opacities)}
        rows = ar.project(settings._replace(**doubles), **gaussians)
        order = rows.depths.argsort(stable=True)
        ids = rows.gaussian_ids.long()[order]
        self.opacity = scene.opacities.reshape(-1)[ids]
        seen = self.opacity > FAINTEST
        order, ids, self.opacity = order[seen], ids[seen], self.opacity[seen]
        xx, xy, yy = rows.cov2d[order].unbind(1)
        self.mean, self.color = rows.means2d[order], rows.colors[order]
        self.cov, self.det = rows.cov2d[order], rows.dets[order]
        self.conic = torch.stack([yy, -xy, xx], 1) / self.det[:, None]
        level = 2 * torch.log(self.opacity / FAINTEST)
        self.extent = (level[:, None] * torch.stack([xx, yy], 1)).sqrt()
        turn, shift = view.w2c[:3, :3].double(), view.w2c[:3, 3].double()
        self.axes, self.scales = turn @ rotation_matrices(scene.rotations[ids]), scene.scales[ids]
        self.whiten = self.axes.mT / self.scales[:, :, None]
        self.centre = scene.means[ids] @ turn.T + shift
        middle = [n / 2 if c is None else c for c, n in ((view.cx, view.width), (view.cy, view.height))]
        self.focal, self.principal = torch.tensor([[view.fx, view.fy], middle], dtype=torch.float64)

    def __len__(self) -> int:
        return len(self.opacity)

    def rays(self, pixels: torch.Tensor) -> torch.Tensor:
        """(M, 3) directions in camera space, z = 1, of what is seen at `pixels` (M, 2)."""
        return torch.cat([(pixels + 0.5 - self.principal) / self.focal, torch.ones_like(pixels[:, :1])], 1)

    def near(self, low: torch.Tensor, high: torch.Tensor) -> torch.Tensor:
        """Indices of the splats that may reach the rectangle from `low` to `high` (2,), px."""
        reach = REACH * self.extent + 1
        return ((self.mean + reach > low) & (self.mean - reach < high)).all(1).nonzero()[:, 0]


def affine_alphas(s: Splats, ids: torch.Tensor, pixels: torch.Tensor) -> torch.Tensor:
    """(M, N) alpha of the projected splats at `pixels` (M, 2), not bounded by 0.99."""
    x, y = (pixels[:, k, None] - s.mean[ids, k] for k in range(2))
    xx, xy, yy = s.conic[ids].unbind(1)
    return s.opacity[ids] * torch.exp(-(xx * x * x + 2 * xy * x * y + yy * y * y) / 2)


def alphas_and_depths(s: Splats, ids: torch.Tensor, rays: torch.Tensor, projection: str):
    """(M, N) alpha in space, not bounded by 0.99, and the depth at which each ray meets each splat.

    `rays` (M, 3) are directions in camera space. Depths are in units of their lengths. What a ray meets behind the
    camera has no alpha, except that `projection` "ahead" is the largest density from the camera on.
    """
    ray = [sum(s.whiten[ids, i, k] * rays[:, k, None] for k in range(3)) for i in range(3)]
    centre = (s.whiten[ids] @ s.centre[ids, :, None])[..., 0].unbind(1)
    square = sum(r * r for r in ray)
    depth = sum(r * c for r, c in zip(ray, centre)) / square
    # |centre x ray|^2 / |ray|^2, which does not cancel: squared distance of the ray from the Gaussian in its own units.
    pairs = ((0, 1), (1, 2), (2, 0))
    q = sum((centre[i] * ray[j] - centre[j] * ray[i]) ** 2 for i, j in pairs) / square
    alpha = s.opacity[ids] * torch.exp(-q / 2)
    if projection == "integral":
        # Along a direction v the Gaussian has the standard deviation |v| / |whiten v|.
        across = s.centre[ids].norm(dim=1) / torch.stack(centre, 1).norm(dim=1)
        alpha = alpha * rays.norm(dim=1, keepdim=True) / square.sqrt() / across
    behind = 0.0
    if projection == "ahead":
        behind = s.opacity[ids] * torch.exp(-sum(c * c for c in centre) / 2)
    return torch.where(depth > 0, alpha, behind), depth


def weights(alpha: torch.Tensor, variant: Variant) -> torch.Tensor:
    """(M, N) what each splat adds to each sample, of alphas (M, N) front to back."""
    alpha = torch.where(alpha < variant.alpha_min, 0, alpha.clamp(max=ALPHA_MAX))
    behind = torch.cumprod(1 - alpha, 1)
    front = torch.cat([torch.ones_like(behind[:, :1]), behind[:, :-1]], 1)
    return torch.where(behind < variant.transmittance_min, 0, front * alpha)


def sample(s: Splats, ids: torch.Tensor, pixels: torch.Tensor, variant: Variant) -> torch.Tensor:
    """(M, 3) colours of samples at `pixels` (M, 2), over black."""
    if variant.projection == "affine":
        alpha = affine_alphas(s, ids, pixels)
    if variant.projection != "affine" or not variant.central_order:
        in_space, depth = alphas_and_depths(s, ids, s.rays(pixels), variant.projection)
        alpha = alpha if variant.projection == "affine" else in_space
    if variant.central_order:
        return weights(alpha, variant) @ s.color[ids]
    order = depth.sort(dim=1, stable=True).indices
    sorted_weights = weights(alpha.gather(1, order), variant)
    return torch.empty_like(alpha).scatter_(1, order, sorted_weights) @ s.color[ids]


def render(
    s: Splats, corner: tuple[int, int], size: tuple[int, int], samples: int, variant: Variant, block: int = BLOCK
) -> torch.Tensor:
    """(3, height, width) of the rectangle of `size` (width, height) whose first pixel is `corner`."""
    width, height = size
    grid = (torch.arange(samples, dtype=torch.float64) + 0.5) / samples - 0.5
    image = torch.zeros(height, width, 3, dtype=torch.float64)
    for y in range(0, height, block):
        for x in range(0, width, block):
            w, h = min(block, width - x), min(block, height - y)
            low = torch.tensor([corner[0] + x, corner[1] + y], dtype=torch.float64)
            ids = s.near(low - 0.5, low + torch.tensor([w, h]) - 0.5)
            columns, rows = ((torch.arange(n)[:, None] + grid).flatten() for n in (w, h))
            pixels = low + torch.cartesian_prod(rows, columns).flip(1)
            parts = pixels.split(max(1, ELEMENTS // max(1, len(ids))))
            colors = [sample(s, ids, part, variant) for part in parts]
            fine = torch.cat(colors).view(h, samples, w, samples, 3)
            image[y : y + h, x : x + w] = fine.mean((1, 3))
    return image.permute(2, 0, 1)


def measure(scene: Gaussians, view: io.View, size: tuple[int, int], samples: int) -> dict[str, float]:
    """PSNR [dB] against the first picture, of the library's samples and of every variant."""
    size = min(size[0], view.width), min(size[1], view.height)
    corner = (view.width - size[0]) // 2, (view.height - size[1]) // 2
    splats = Splats(scene, view)
    first = render(splats, corner, size, samples, Variant())
    own = supersampled(scene, view, samples)[:, corner[1] :, corner[0] :][:, : size[1], : size[0]]
    pictures = {"library": own}
    pictures |= {name: render(splats, corner, size, samples, variant) for name, variant in VARIANTS.items()}
    return {name: image_errors(picture, first)["psnr"] for name, picture in pictures.items()}


def main() -> None:
    args = parse_arguments()
    torch.set_num_threads(args.threads)
    scene, results = load_scene(args.scene), []
    print(markdown_table(["view", "scale", "library", *VARIANTS], []), flush=True)
    for view in io.load_views(args.views)[: args.limit_views]:
        for scale in args.scales:
            measured = measure(scene, view.framed(scale), tuple(args.crop), args.samples)
            results.append({"view": view.name, "scale": scale, **measured})
            numbers = " | ".join(f"{value:.1f}" for value in measured.values())
            print(f"| {view.name} | 1/{scale} | {numbers} |", flush=True)
    save_json(args, {"results": results})


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    add = parser.add_argument
    add("scene", help="trained scene: .ply, compressed .ply, .spz, or .npz (see scene_files.py)")
    add("--views", required=True, help="file of views")
    add("--limit-views", type=int, help="use only so many of them")
    add_scales(parser, whole_reductions, "reductions of the views: 2 is half the size (default: 1,4)", (1, 4))
    add("--crop", nargs=2, type=int, default=[32, 32], metavar=("W", "H"), help="the middle of it (default: 32 32)")
    add("--samples", type=int, default=4, metavar="N", help="along a pixel's side (default: 4)")
    add("--threads", type=int, default=torch.get_num_threads(), help="of the CPU")
    add("--json", help="also write everything measured to this file")
    return argparse.Namespace(device="cpu", **vars(parser.parse_args()))


if __name__ == "__main__":
    main()
