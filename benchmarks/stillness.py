"""What moves in a picture though nothing moves in the scene: popping and aliasing, when the camera goes sideways.

    python benchmarks/stillness.py SCENE --views VIEWS [--view 0] [--scales 1,4] [--crop 64 64] [--film FILE.png]

Renders the middle of a view from a path of small steps, with every footprint and in every order of splats
(`Effects.order`). The error of a picture has a standard deviation in time at every pixel; the table has its root mean
square over pixels and channels, and that of the error itself, in 1/255:

- popping: the error against the same footprint in exact order, in which every pixel sorts its splats by the depth at
  which its own ray is densest in them. It is computed in float64, by the code of this file.
- aliasing: that of the footprint in exact order, against the integral over the pixel in exact order, which is taken
  from samples x samples unfiltered samples in a pixel.

--film writes an animated PNG of the first footprint and scale: on the left in the order of centres, on the right along
rays.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass, replace

import torch
from approximations import ALPHA_MAX, TRANSMITTANCE_MIN, Splats, Variant, weights
from approximations import render as render_samples
from common import save_json
from scene_files import load_scene

import analytic_rasterizer as ar
from analytic_rasterizer import _C, io
from analytic_rasterizer.analysis.tables import markdown_table
from analytic_rasterizer.cli.arguments import add_scales, whole_reductions
from analytic_rasterizer.footprints import DILATED, FASTEST, RECOMMENDED, resolve_footprint
from analytic_rasterizer.gaussians import Gaussians
from analytic_rasterizer.render.order import CENTER, ORDERS, RAY

FOOTPRINTS = (DILATED, FASTEST, RECOMMENDED)
FLATTEST = 1e-3  # of the largest scale: a flatter Gaussian has no depth along a ray in its plane
BLOCK = 16  # px; the splats of a block are looked for once


@dataclass(frozen=True)
class Filter:
    """A footprint of one Gaussian, or of square cells whose nodes move.

    Attributes:
        variance: Added to covariances, px^2.
        compensated: Whether the amplitude keeps the integral.
        cells: Along an edge of the pixel; 0: one sample that stays.
    """

    variance: float
    compensated: bool
    cells: int = 0

    @classmethod
    def of(cls, name: str) -> Filter:
        """Of a footprint's name. Raises ValueError for others than `point`, `mip`, `box` with one sample, `moment`."""
        footprint = resolve_footprint(name)
        if footprint.name == DILATED:
            return cls(footprint.option, False)
        if footprint.name == "mip":
            return cls(footprint.option, True)
        if footprint.name == "box" and footprint.samples == 1:
            return cls(1 / 12, True)
        if footprint.name == "moment":
            return cls(1 / (12 * footprint.samples), True, math.isqrt(footprint.samples))
        raise ValueError(f"footprints must be among point, mip, box:samples=1 and moment, got {name}")


def along_path(view: io.View, steps: int, step: float) -> list[io.View]:
    """The view, moved sideways by multiples of `step`, world units."""
    moved = []
    for k in range(steps):
        w2c = view.w2c.clone()
        w2c[0, 3] += k * step
        moved.append(replace(view, name=f"{view.name}_{k}", w2c=w2c))
    return moved


def near(s: Splats, low: torch.Tensor, high: torch.Tensor, by: Filter) -> torch.Tensor:
    """Indices of the splats that may show in pixels whose centres lie between `low` and `high` (2,)."""
    level = 2 * (s.opacity / _C.ALPHA_MIN).clamp_min(1).log()
    reach = (level[:, None] * (s.cov[:, ::2] + by.variance)).sqrt() + 0.5
    return ((s.mean + reach > low) & (s.mean - reach < high)).all(1).nonzero()[:, 0]


def exact_order(s: Splats, ids: torch.Tensor, pixels: torch.Tensor) -> torch.Tensor:
    """(M, N) places in `ids`, front to back for every pixel."""
    scales = torch.maximum(s.scales[ids], FLATTEST * s.scales[ids].amax(1, keepdim=True))
    whiten = s.axes[ids].mT / scales[:, :, None]
    ray = torch.einsum("nij,mj->mni", whiten, s.rays(pixels))
    centre = (whiten @ s.centre[ids, :, None])[..., 0]
    return ((ray * centre).sum(-1) / (ray * ray).sum(-1)).sort(dim=1, stable=True).indices


def only_shown(s: Splats, order: torch.Tensor, pixels: torch.Tensor, by: Filter) -> torch.Tensor:
    """`order` (M, N) without splats that cannot show in a pixel, wherever in it they are looked at.

    From the middle of a pixel to anywhere in it are at most sqrt(1/2) px, by which the Mahalanobis distance changes by
    no more than over the smallest standard deviation.
    """
    xx, xy, yy = (s.cov[:, k][order] for k in range(3))
    xx, yy = xx + by.variance, yy + by.variance
    x, y = (pixels[:, k, None] - s.mean[order, k] for k in range(2))
    det = xx * yy - xy * xy
    distance = ((yy * x * x - 2 * xy * x * y + xx * y * y) / det).clamp_min(0).sqrt()
    narrowest = ((xx + yy) / 2 - torch.hypot((xx - yy) / 2, xy)).clamp_min(by.variance or 1e-12).sqrt()
    level = 2 * (s.opacity[order] / _C.ALPHA_MIN).clamp_min(1).log()
    hidden = (distance - math.sqrt(0.5) / narrowest).clamp_min(0).square() > level
    most = int((~hidden).sum(1).amax())
    return order.gather(1, hidden.byte().sort(dim=1, stable=True).indices[:, :most])


def shaded(s: Splats, ids: torch.Tensor, pixels: torch.Tensor, by: Filter) -> torch.Tensor:
    """(M, 3) colours of pixels (M, 2) in exact order, over black."""
    order = only_shown(s, ids[exact_order(s, ids, pixels)], pixels, by)  # (M, N)
    xx, xy, yy = (s.cov[:, k][order] for k in range(3))
    xx, yy = xx + by.variance, yy + by.variance
    det = s.det[order] + by.variance * (xx + yy) - by.variance**2
    peak = s.opacity[order] * (s.det[order] / det).sqrt() if by.compensated else s.opacity[order]
    x, y = (pixels[:, k, None] - s.mean[order, k] for k in range(2))
    if by.cells == 0:
        alpha = peak * torch.exp(-(yy * x * x - 2 * xy * x * y + xx * y * y) / det / 2)
        return (weights(alpha, Variant())[..., None] * s.color[order]).sum(1)
    edges = (torch.arange(by.cells, dtype=torch.float64) + 0.5) / by.cells - 0.5
    nodes = torch.cartesian_prod(edges, edges).flip(1)
    color = torch.zeros(len(pixels), 3, dtype=torch.float64)
    for node in nodes:
        through, stopped = torch.ones(len(pixels), dtype=torch.float64), torch.zeros(len(pixels), dtype=torch.bool)
        moved = torch.zeros(len(pixels), 2, dtype=torch.float64)
        for k in range(order.shape[1]):
            u, v = x[:, k] + node[0] + moved[:, 0], y[:, k] + node[1] + moved[:, 1]
            pull = torch.stack([yy[:, k] * u - xy[:, k] * v, xx[:, k] * v - xy[:, k] * u], 1) / det[:, k, None]
            alpha = (peak[:, k] * torch.exp(-(pull[:, 0] * u + pull[:, 1] * v) / 2)).clamp(max=ALPHA_MAX)
            shown = (alpha >= _C.ALPHA_MIN) & ~stopped
            stopped |= shown & (through * (1 - alpha) < TRANSMITTANCE_MIN)
            alpha = torch.where(shown & ~stopped, alpha, 0)
            color += (through * alpha / len(nodes))[:, None] * s.color[order[:, k]]
            through = through * (1 - alpha)
            step = (by.variance * alpha / (1 - alpha))[:, None] * pull
            moved = (moved + step).clamp(-0.5 / by.cells, 0.5 / by.cells)
    return color


def in_exact_order(s: Splats, corner: tuple[int, int], size: tuple[int, int], by: Filter) -> torch.Tensor:
    """(3, height, width) of the rectangle of `size` whose first pixel is `corner`."""
    width, height = size
    image = torch.zeros(height, width, 3, dtype=torch.float64)
    for top in range(0, height, BLOCK):
        for left in range(0, width, BLOCK):
            w, h = min(BLOCK, width - left), min(BLOCK, height - top)
            low = torch.tensor([corner[0] + left, corner[1] + top], dtype=torch.float64)
            ids = near(s, low, low + torch.tensor([w, h]) - 1, by)
            pixels = low + torch.cartesian_prod(*(torch.arange(n, dtype=torch.float64) for n in (h, w))).flip(1)
            image[top : top + h, left : left + w] = shaded(s, ids, pixels, by).view(h, w, 3)
    return image.permute(2, 0, 1)


@torch.no_grad()
def library_picture(
    scene: Gaussians, view: io.View, corner: tuple[int, int], size: tuple[int, int], footprint: str, order: str
) -> torch.Tensor:
    """(3, height, width), float64, of the rectangle of `size` whose first pixel is `corner`, by the stages."""
    settings = view.settings(
        1.0, sh_degree=scene.sh_degree, footprint=footprint, device=scene.means.device, effects=ar.Effects(order=order)
    )
    splats = ar.project(settings, **scene.arguments())
    means2d = splats.means2d - splats.means2d.new_tensor(corner)
    splats = replace(splats, means2d=means2d, width=size[0], height=size[1])
    return ar.blend(splats, ar.list_tiles(splats, keep=False))[0][0].double().cpu()


def middle_of(view: io.View, size: tuple[int, int]) -> tuple[int, int]:
    """The first pixel of the rectangle of `size` in the middle, at multiples of BLOCK."""
    return (view.width - size[0]) // 2 // BLOCK * BLOCK, (view.height - size[1]) // 2 // BLOCK * BLOCK


def moves(errors: list[torch.Tensor]) -> tuple[float, float]:
    """Root mean square of errors at several times, and of their standard deviations in time, in 1/255."""
    of_time = torch.stack(errors)
    return tuple(255 * value.mean().sqrt().item() for value in (of_time.square(), of_time.var(0, unbiased=False)))


def measure(
    scene: Gaussians,
    views: list[io.View],
    size: tuple[int, int],
    footprints: list[str],
    orders: list[str],
    samples: int,
) -> dict[str, dict]:
    """Of every footprint: "aliasing", and by order "popping", each (error, standard deviation in time)."""
    size = min(size[0], views[0].width), min(size[1], views[0].height)
    corner = middle_of(views[0], size)
    aliasing, popping = {}, {}
    for view in views:
        splats = Splats(scene, view)
        integral = render_samples(splats, corner, size, samples, Variant(central_order=False))
        for footprint in footprints:
            exact = in_exact_order(splats, corner, size, Filter.of(footprint))
            aliasing.setdefault(footprint, []).append(exact - integral)
            for order in orders:
                picture = library_picture(scene, view, corner, size, footprint, order)
                popping.setdefault((footprint, order), []).append(picture - exact)
    return {
        footprint: {
            "aliasing": moves(aliasing[footprint]),
            "popping": {order: moves(popping[footprint, order]) for order in orders},
        }
        for footprint in footprints
    }


def save_film(path: str, scene: Gaussians, views: list[io.View], size: tuple[int, int], footprint: str) -> None:
    """An animated PNG, there and back: the order of centres on the left, along rays on the right."""
    image = io.optional_import("PIL.Image")
    frames = []
    for view in views:
        pair = [library_picture(scene, view, middle_of(view, size), size, footprint, o) for o in (CENTER, RAY)]
        pixels = torch.cat(pair, 2).clamp(0, 1).mul(255).round().byte().permute(1, 2, 0).contiguous().numpy()
        frames.append(image.fromarray(pixels))
    there_and_back = frames + frames[-2:0:-1]
    there_and_back[0].save(path, save_all=True, append_images=there_and_back[1:], duration=80, loop=0)


def main() -> None:
    args = parse_arguments()
    torch.set_num_threads(args.threads)
    scene, results = load_scene(args.scene), []
    middle = scene.means.median(0).values
    step = args.step * (scene.means - middle).abs().median().item()
    view = io.load_views(args.views)[args.view]
    names = [f"{what} {order}" for order in args.orders for what in ("popping", "in time,")]
    print(markdown_table(["scale", "footprint", "aliasing", "in time", *names], []), flush=True)
    for scale in args.scales:
        views = along_path(view.framed(scale), args.steps, step)
        measured = measure(scene, views, tuple(args.crop), args.footprints, args.orders, args.samples)
        results.append({"scale": scale, "footprints": measured})
        for footprint, found in measured.items():
            numbers = [*found["aliasing"], *(value for order in args.orders for value in found["popping"][order])]
            print(f"| 1/{scale} | {footprint} | {' | '.join(f'{value:.2f}' for value in numbers)} |", flush=True)
    if args.film:
        views = along_path(view.framed(args.scales[0]), args.film_frames, step)
        save_film(args.film, scene, views, tuple(args.film_size), args.footprints[0])
    save_json(args, {"step": step, "results": results})


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    add = parser.add_argument
    add("scene", help="trained scene: .ply, compressed .ply, .spz, or .npz (see scene_files.py)")
    add("--views", required=True, help="file of views")
    add("--view", type=int, default=0, metavar="N", help="which of them (default: 0)")
    add("--footprints", nargs="+", default=list(FOOTPRINTS), metavar="NAME[:k=v]")
    add("--orders", nargs="+", default=list(ORDERS), choices=ORDERS)
    add_scales(parser, whole_reductions, "reductions of the view: 2 is half the size (default: 1,4)", (1, 4))
    add("--crop", nargs=2, type=int, default=[64, 64], metavar=("W", "H"), help="the middle of it (default: 64 64)")
    add("--steps", type=int, default=8, metavar="N", help="pictures (default: 8)")
    add(
        "--step",
        type=float,
        default=0.004,
        help="between them, in sizes of the scene, the median distance from its middle along an axis (default: 0.004)",
    )
    add("--samples", type=int, default=4, metavar="N", help="of the integral, along a pixel's side (default: 4)")
    add("--film", metavar="FILE.png", help="also write an animated PNG")
    add("--film-frames", type=int, default=8, metavar="N")
    add("--film-size", nargs=2, type=int, default=[240, 160], metavar=("W", "H"))
    add("--threads", type=int, default=torch.get_num_threads(), help="of the CPU")
    add("--json", help="also write everything measured to this file")
    return argparse.Namespace(device="cpu", **vars(parser.parse_args()))


if __name__ == "__main__":
    main()
