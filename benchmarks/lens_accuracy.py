"""How accurate pictures through a lens are: the affine picture of every Gaussian, beside two alternatives.

    python benchmarks/lens_accuracy.py [SCENE --views VIEWS] [--fovs 60 90 120] [--sigmas 0.5 3 20] [--out FOLDER]

Renders random scenes, or a trained one, by brute force in float64. The truth follows samples x samples rays in every
pixel, backwards through the exact map of the lens. The weight of a Gaussian on a ray is its largest density there.
Splats are blended in the library's order, with its thresholds. Harmonics are cut to degree 0.

- affine: what the library approximates, exact Jacobian at the centre, at the same samples as the truth.
- unscented: mean and covariance of seven points through the exact map, at the same samples: (a) alpha 1, beta 0,
  points sqrt(3) standard deviations away, (b) alpha 0.1, beta 2, points a tenth as far.
- box, moment, analytic: the library's own pictures.
- undistorted: the truth through the lens in 8 bits, resampled to a pinhole by `train --lens undistort`, against the
  truth of this pinhole, of the same splats in the same order. Rounding alone costs 59 dB. kept: the share of the
  picture left.
- above: the share of the splats drawn whose `affine_error` is above its limit.

Pinholes have the same horizontal field of view, and are compared with their own truth. All numbers are PSNR [dB], of
mean squares over several scenes of large splats. Random splats have standard deviations of --sigmas px in the middle of
a fisheye's picture, in geometric mean over the axes. All cameras of a field of view see the same scene. --out saves
pictures. A second table has the errors of the weights of single Gaussians by `affine_error`.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import approximations
import torch
from approximations import Variant, affine_alphas, alphas_and_depths, render
from common import save_json
from scene_files import load_scene

import analytic_rasterizer as ar
from analytic_rasterizer import _C, io
from analytic_rasterizer.analysis.affine import LIMIT, PIXEL_VARIANCE, affine_error
from analytic_rasterizer.analysis.reference import UNFILTERED, finite_decibels, image_errors
from analytic_rasterizer.analysis.tables import markdown_table
from analytic_rasterizer.cameras.lens import WIDE, Lens
from analytic_rasterizer.cameras.rotations import rotation_matrices
from analytic_rasterizer.captures.undistortion import window_of, without_lens
from analytic_rasterizer.gaussians import SH_C0, Gaussians
from analytic_rasterizer.render.effects import NEAR

SIZE = 128, 96
FOVS, SIGMAS = (60, 90, 120, 150, 180), (0.5, 3.0, 20.0)  # degrees from the left to the right edge; px
FOOTPRINTS = ("analytic", "box:samples=4", "moment:samples=4")
LARGEST = {"fisheye": 180, "perspective": 90, "pinhole": 120}  # degrees
SHARES = ("kept", "above")  # in columns that are no PSNR
BLOCK = 8  # px; as in approximations.py
COVERED = 2.0  # splats over every pixel, each as large as a disc of sqrt(2) standard deviations
DISTANCES = 2.0, 6.0  # world units
STRETCH = 2.0  # the longest axis is at most STRETCH^2 times the shortest
BARREL = (-0.28, 0.09)  # k1, k2 of the perspective lens
CAMERAS = {"fisheye": Lens.fisheye(), "perspective": Lens.perspective(BARREL), "pinhole": Lens.perspective()}
UNSCENTED = {"unscented (a)": (1.0, 0.0), "unscented (b)": (0.1, 2.0)}  # alpha, beta
COLUMNS = ("affine", *UNSCENTED, *FOOTPRINTS, "above", "undistorted", "kept")
NOWHERE = 1e9  # px, of splats that the library does not draw
EDGES = (0.0, 0.01, 0.03, 0.1, 0.3, 1.0, math.inf)  # of `affine_error`, in the last table
FOCAL = 100.0  # px, of the last table, as the three below
WIDEST = {"fisheye": 110, "perspective": 45, "pinhole": 60}  # degrees from the axis
ANGLES = 1e-3, 0.6  # of the largest standard deviation over the distance
THINNEST = 1 / 30  # of the other standard deviations over the largest


def seen(lens: Lens, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Where points (..., 3) in camera space are seen, (..., 2) in focal lengths, and the derivatives (..., 2, 3)."""
    u, slopes = _C.lens_points(lens.model, list(lens.coefficients), points.reshape(-1, 3))
    return u.reshape(*points.shape[:-1], 2), slopes.reshape(*points.shape[:-1], 2, 3)


def camera(kind: str, fov: float, size: tuple[int, int] = SIZE, pose: torch.Tensor | None = None) -> io.View:
    """The view of a camera of CAMERAS whose picture is `fov` degrees wide."""
    half = math.radians(fov) / 2
    edge = torch.tensor([[math.sin(half), 0, math.cos(half)]], dtype=torch.float64)
    focal = size[0] / 2 / seen(CAMERAS[kind], edge)[0][0, 0].item()
    return io.View(kind, *size, focal, focal, torch.eye(4, dtype=torch.float64) if pose is None else pose.double())


def random_scene(seed: int, fov: float, sigma: float, size: tuple[int, int] = SIZE) -> Gaussians:
    """Splats all over a fisheye's picture of a field of view and beyond, of degree 0. Float64."""
    generator = torch.Generator().manual_seed(seed)
    view, margin = camera("fisheye", fov, size), 2 * sigma
    sides = torch.tensor([view.width, view.height], dtype=torch.float64) + 2 * margin
    count = max(1, round(COVERED * sides.prod().item() / (2 * math.pi * sigma**2)))

    def rand(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, dtype=torch.float64, generator=generator)

    rays = CAMERAS["fisheye"].unproject((rand(count, 2) - 0.5) * sides / view.fx)
    known = ~rays[:, 0].isnan()  # the picture of a fisheye is a disc
    distance = DISTANCES[0] + (DISTANCES[1] - DISTANCES[0]) * rand(count, 1)
    stretch = STRETCH ** (2 * rand(count, 3) - 1)
    scales = sigma / view.fx * distance * stretch / stretch.log().mean(1, keepdim=True).exp()
    turns = torch.randn(count, 4, dtype=torch.float64, generator=generator)
    shs = (rand(count, 1, 3) - 0.5) / SH_C0
    fields = (rays.nan_to_num() * distance, scales, turns, 0.1 + 0.89 * rand(count, 1), shs)
    return Gaussians.from_activated(*(field[known] for field in fields))


class LensSplats(approximations.Splats):
    """What a camera with a lens may show, also beside its picture, in the library's order: see `Splats`.

    mean and conic are those that the library projects; what it does not draw has no weight there. `like` is the lens
    whose order this is, and that decides which centres are seen; None: the same lens.
    """

    def __init__(self, scene: Gaussians, view: io.View, lens: Lens, like: Lens | None = None):
        self.lens, self.view = lens, view
        middle = [n / 2 if c is None else c for c, n in ((view.cx, view.width), (view.cy, view.height))]
        self.focal, self.principal = torch.tensor([[view.fx, view.fy], middle], dtype=torch.float64)
        turn, shift = view.w2c[:3, :3].double(), view.w2c[:3, 3].double()
        centre = scene.means @ turn.T + shift
        like = like or lens
        depth = centre.norm(dim=1) if like.model in WIDE else centre[:, 2]
        angle = torch.atan2(centre[:, :2].norm(dim=1), centre[:, 2])
        may_show = (depth > NEAR) & (angle <= like.fold) & (scene.opacities[:, 0] > _C.ALPHA_MIN)
        ids = may_show.nonzero()[:, 0]
        ids = ids[depth[ids].argsort(stable=True)]
        self.scene, self.centre, self.opacity = scene.rows(ids), centre[ids], scene.opacities[ids, 0]
        self.color = colors(self.scene)
        self.axes = turn @ rotation_matrices(self.scene.rotations) * self.scene.scales[:, None]
        self.whiten = torch.linalg.inv(self.axes)
        # Half of the angle under which everything above the threshold is seen, if the Gaussian were a ball.
        reach = self.scene.scales.amax(1) * (2 * torch.log(self.opacity / _C.ALPHA_MIN)).sqrt()
        self.half_angle = torch.asin((reach / self.centre.norm(dim=1)).clamp_max(1))
        self.half_angle[reach >= self.centre.norm(dim=1)] = math.pi
        self.project()

    def project(self) -> None:
        """Sets mean and conic to those of the library."""
        opaque = self.scene.arguments() | {"opacities": torch.ones_like(self.scene.opacities)}
        rows = ar.project(settings_of(self.view, self.lens, UNFILTERED), **opaque)
        self.mean = torch.full((len(self), 2), NOWHERE, dtype=torch.float64)
        covariance = torch.eye(2, dtype=torch.float64).repeat(len(self), 1, 1)
        ids, (xx, xy, yy) = rows.gaussian_ids.long(), rows.cov2d.unbind(1)
        self.mean[ids] = rows.means2d
        covariance[ids] = torch.stack([xx, xy, xy, yy], 1).unflatten(1, (2, 2))
        self.set_covariance(covariance)

    def transform_unscented(self, alpha: float, beta: float) -> None:
        """Sets mean and conic to those of seven points through the map, with kappa = 0: Wan and van der Merwe, 2000.

        Splats of which a point is not seen stay as they are.
        """
        steps = alpha * math.sqrt(3) * torch.cat([self.axes, -self.axes], 2).mT
        points = torch.cat([self.centre[:, None], self.centre[:, None] + steps], 1)
        u = self.focal * seen(self.lens, points)[0] + self.principal - 0.5
        share = 1 / (6 * alpha**2)
        of_mean = 1 - 6 * share
        mean = of_mean * u[:, 0] + share * u[:, 1:].sum(1)
        away = u - mean[:, None]
        weights = torch.tensor([of_mean + 1 - alpha**2 + beta, *[share] * 6], dtype=torch.float64)
        covariance = (weights[:, None] * away).mT @ away
        angle = torch.atan2(points[..., :2].norm(dim=2), points[..., 2])
        good = (angle <= self.lens.fold).all(1) & (self.mean[:, 0] < NOWHERE)
        good &= covariance.isfinite().all(2).all(1) & (torch.linalg.det(covariance) > 0)
        self.mean = torch.where(good[:, None], mean, self.mean)
        self.set_covariance(torch.where(good[:, None, None], covariance, self.covariance))

    def set_covariance(self, covariance: torch.Tensor) -> None:
        """Sets covariance (N, 2, 2) px^2, conic, and how far above the threshold, extent."""
        self.covariance = covariance
        xx, xy, yy = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
        self.conic = torch.stack([yy, -xy, xx], 1) / (xx * yy - xy * xy)[:, None]
        level = 2 * torch.log(self.opacity / _C.ALPHA_MIN)
        self.extent = (level[:, None] * torch.stack([xx, yy], 1)).clamp_min(0).sqrt()

    def rays(self, pixels: torch.Tensor) -> torch.Tensor:
        rays = self.lens.unproject((pixels + 0.5 - self.principal) / self.focal)
        if rays.isnan().any():
            raise SystemExit(f"the picture of {self.view.name} is wider than what its lens sees")
        return rays

    def near(self, low: torch.Tensor, high: torch.Tensor) -> torch.Tensor:
        edge = torch.linspace(0, 1, 5, dtype=torch.float64)
        rays = self.rays(low + (high - low) * torch.cartesian_prod(edge, edge))
        axis = torch.nn.functional.normalize(rays.mean(0), dim=0)
        # A tenth for what bulges between the points.
        half = 1.1 * torch.acos((rays @ axis).clamp(-1, 1)).max()
        away = torch.acos((torch.nn.functional.normalize(self.centre, dim=1) @ axis).clamp(-1, 1))
        in_picture = ((self.mean + self.extent > low) & (self.mean - self.extent < high)).all(1)
        return (in_picture | (away <= half + self.half_angle)).nonzero()[:, 0]


def colors(scene: Gaussians) -> torch.Tensor:
    """(N, 3) of the constant harmonic."""
    return (0.5 + SH_C0 * scene.shs[:, 0]).clamp_min(0)


def settings_of(view: io.View, lens: Lens, footprint: str):
    """Of float64. Coefficients that are all zero are a pinhole."""
    effects = ar.Effects(lens=lens) if lens != CAMERAS["pinhole"] else None
    return view.settings(sh_degree=0, footprint=footprint, effects=effects, dtype=torch.float64)


def library_picture(scene: Gaussians, view: io.View, lens: Lens, footprint: str) -> torch.Tensor:
    """(3, H, W) of the library over black, in float64."""
    arguments = scene.arguments()
    del arguments["shs"]
    rasterizer = ar.GaussianRasterizer(settings_of(view, lens, footprint))
    return rasterizer(means2D=None, colors_precomp=colors(scene), **arguments)[0]


def undistort(scene: Gaussians, view: io.View, lens: Lens, truth: torch.Tensor, samples: int):
    """The pinhole's picture out of the lens's (3, H, W), the pinhole's truth, and the share of the picture kept."""
    bent = replace(view, lens=lens)
    rgba = torch.cat([truth, torch.ones_like(truth[:1])]).clamp(0, 1).mul(255).round().to(torch.uint8).permute(1, 2, 0)
    pinhole, resampled = without_lens(rgba, bent)
    straight = render_whole(LensSplats(scene, pinhole, CAMERAS["pinhole"], lens), "ahead", samples)
    kept = float(window_of(bent).kept)
    return resampled[..., :3].permute(2, 0, 1).double() / 255, straight, kept


def render_whole(splats: LensSplats, projection: str, samples: int) -> torch.Tensor:
    """(3, H, W)."""
    size = splats.view.width, splats.view.height
    return render(splats, (0, 0), size, samples, Variant(projection=projection), BLOCK)


def measure(scene: Gaussians, view: io.View, kind: str, samples: int, footprints=FOOTPRINTS) -> tuple[dict, dict]:
    """Mean squares by column, and pictures by name."""
    lens, splats = CAMERAS[kind], LensSplats(scene, view, CAMERAS[kind])
    truth = render_whole(splats, "ahead", samples)
    pictures = {"affine": render_whole(splats, "affine", samples)}
    if kind != "pinhole":
        for name, options in UNSCENTED.items():
            splats.project()
            splats.transform_unscented(*options)
            pictures[name] = render_whole(splats, "affine", samples)
    pictures |= {name: library_picture(scene, view, lens, name) for name in footprints}
    squares = {name: image_errors(picture, truth)["rmse"] ** 2 for name, picture in pictures.items()}
    error = affine_error(splats.scene, settings_of(view, lens, UNFILTERED))[splats.mean[:, 0] < NOWHERE]
    squares["above"] = (error > LIMIT).double().mean().item()
    if kind != "pinhole":  # of which there is none at 180 degrees
        resampled, straight, squares["kept"] = undistort(scene, view, lens, truth, samples)
        squares["undistorted"] = image_errors(resampled, straight)["rmse"] ** 2
        pictures |= {"undistorted": resampled, "of the pinhole": straight}
    return squares, {"truth": truth} | pictures


def picture_table(args: argparse.Namespace) -> list[dict]:
    """A row for every camera, field of view and size of splats, printed as it is measured."""
    rows, trained = [], None
    if args.scene:
        trained = load_scene(args.scene).map(torch.Tensor.double).with_sh_degree(0)
        view = io.load_views(args.views)[0]
        if args.limit:
            widest = camera("fisheye", max(args.fovs), tuple(args.size), view.w2c)
            trained = most_seen(trained, replace(widest, lens=CAMERAS["fisheye"]), args.limit)
    print(markdown_table(["camera", "field of view", "splats", *COLUMNS], []), flush=True)
    for sigma in [None] if trained else args.sigmas:
        for fov in args.fovs:
            if trained:
                scenes, pose = [trained], view.w2c
            else:
                count, pose = args.scenes or max(1, round(3 * min(1, sigma / 20))), None
                scenes = [random_scene(seed, fov, sigma, tuple(args.size)) for seed in range(count)]
            for kind in (kind for kind in CAMERAS if fov <= LARGEST[kind]):
                seen_from, found = camera(kind, fov, tuple(args.size), pose), []
                for i, scene in enumerate(scenes):
                    numbers, pictures = measure(scene, seen_from, kind, args.samples)
                    found.append(numbers)
                    if i == 0:
                        save_pictures(args.out, f"{kind}_{fov:g}_{sigma or 0:g}", pictures)
                size = f"{sigma:g} px" if sigma else "the scene"
                row = {"camera": kind, "field of view": f"{fov:g}", "splats": size} | averaged(found)
                print(
                    "| " + " | ".join(in_words(name, row.get(name)) for name in [*list(row)[:3], *COLUMNS]) + " |",
                    flush=True,
                )
                rows.append(row)
    return rows


def most_seen(scene: Gaussians, view: io.View, count: int) -> Gaussians:
    """The Gaussians that a picture shows most of."""
    settings = view.settings(
        sh_degree=0, footprint=FOOTPRINTS[1], dtype=torch.float64, effects=ar.Effects(gaussian_stats=True)
    )
    stats = ar.GaussianRasterizer(settings)(means2D=None, **scene.arguments())[2].gaussian_stats
    return scene.rows(stats.sum_weight.argsort(descending=True, stable=True)[:count].sort().values)


def in_words(name: str, value: str | float | None) -> str:
    if value is None or isinstance(value, str):
        return value or "-"
    return f"{value:.0%}" if name in SHARES else f"{value:.1f}"


def weight_errors(kind: str, count: int, samples: int) -> tuple[torch.Tensor, torch.Tensor]:
    """(count,) `affine_error` of random Gaussians, and how far the weight of each is off at most, its peak being 1.

    Weights are means over samples x samples rays in a pixel, for pixels out to where a weight is 1/255.
    """
    generator = torch.Generator().manual_seed(0)

    def rand(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, dtype=torch.float64, generator=generator)

    lens, view = CAMERAS[kind], io.View(kind, *SIZE, FOCAL, FOCAL, torch.eye(4, dtype=torch.float64))
    angle, turn = math.radians(WIDEST[kind]) * rand(count), 2 * math.pi * rand(count)
    centre = DISTANCES[0] * torch.stack([angle.sin() * turn.cos(), angle.sin() * turn.sin(), angle.cos()], 1)
    largest = ANGLES[0] * (ANGLES[1] / ANGLES[0]) ** rand(count, 1)
    scales = DISTANCES[0] * largest * torch.cat([torch.ones(count, 1), THINNEST ** rand(count, 2)], 1)
    turns = torch.randn(count, 4, dtype=torch.float64, generator=generator)
    ones = torch.ones(count, 1, dtype=torch.float64)
    scene = Gaussians.from_activated(centre, scales, turns, ones, ones[:, None].expand(-1, 1, 3))
    error = affine_error(scene, settings_of(view, lens, UNFILTERED))

    axes = rotation_matrices(turns) * scales[:, None]
    u, slopes = seen(lens, centre)
    covariance = FOCAL**2 * (slopes @ axes) @ (slopes @ axes).mT
    xx, xy, yy = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    conic = torch.stack([yy, -xy, xx], 1) / (xx * yy - xy * xy)[:, None]
    splats = SimpleNamespace(
        mean=FOCAL * u, conic=conic, opacity=ones[:, 0], whiten=torch.linalg.inv(axes), centre=centre
    )
    side = torch.linspace(-1, 1, 15, dtype=torch.float64)
    disc = torch.cartesian_prod(side, side)
    disc = math.sqrt(2 * math.log(1 / _C.ALPHA_MIN)) * disc[disc.norm(dim=1) <= 1]
    inside = (torch.arange(samples, dtype=torch.float64) + 0.5) / samples - 0.5
    inside = torch.cartesian_prod(inside, inside)
    widths = torch.linalg.cholesky(covariance + PIXEL_VARIANCE * torch.eye(2, dtype=torch.float64))
    worst = torch.zeros(count, dtype=torch.float64)
    for i in range(count):
        pixels = (splats.mean[i] + disc @ widths[i].T)[:, None] + inside
        rays, ids = lens.unproject(pixels.reshape(-1, 2) / FOCAL), torch.tensor([i])
        true = alphas_and_depths(splats, ids, rays, "ahead")[0].view(len(disc), -1).mean(1)
        affine = affine_alphas(splats, ids, pixels.reshape(-1, 2)).view(len(disc), -1).mean(1)
        worst[i] = (true - affine).abs().nan_to_num().max()  # NaN where the lens sees nothing
    return error, worst


def weight_table(args: argparse.Namespace) -> list[dict]:
    """A row for every range of `affine_error`, printed: median, 95% and largest error of a weight by camera."""
    rows = [{"from": low, "to": high} for low, high in pairwise(EDGES)]
    for kind in CAMERAS:
        error, worst = weight_errors(kind, args.gaussians, args.samples)
        for row in rows:
            of_row = worst[(error >= row["from"]) & (error < row["to"])]
            if len(of_row):
                shares = torch.tensor([0.5, 0.95, 1.0], dtype=torch.float64)
                row[kind] = [len(of_row), *of_row.quantile(shares).tolist()]
    print(markdown_table(["affine_error", *(f"{kind}: median, 95%, largest" for kind in CAMERAS)], []), flush=True)
    for row in rows:
        cells = [", ".join(f"{v:.3f}" for v in row[kind][1:]) if kind in row else "-" for kind in CAMERAS]
        print(f"| {row['from']:g} to {row['to']:g} | {' | '.join(cells)} |", flush=True)
    return rows


def averaged(found: list[dict]) -> dict[str, float]:
    """PSNR [dB] of mean squares, and means of shares."""
    means = {name: sum(numbers[name] for numbers in found) / len(found) for name in found[0]}
    return {k: v if k in SHARES else finite_decibels(v) for k, v in means.items()}


def save_pictures(out: str | None, name: str, pictures: dict[str, torch.Tensor]) -> None:
    """Into a folder, if there is one: pictures, and ten times the differences to the truth about grey."""
    if out is None:
        return
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    truth = pictures["truth"]
    differences = {f"{k} x10": 0.5 + 10 * (v - truth) for k, v in pictures.items() if v.shape == truth.shape}
    for label, picture in (pictures | differences).items():
        stem = f"{name}_{label}".replace(":", "_").replace(" ", "_")
        pixels = (255 * picture.clamp(0, 1)).round().to(torch.uint8).permute(1, 2, 0).numpy()
        io.optional_import("PIL.Image").fromarray(pixels).save(folder / f"{stem}.png")


def main() -> None:
    args = parse_arguments()
    torch.set_num_threads(args.threads)
    results = {"pictures": picture_table(args), "weights": weight_table(args)}
    save_json(args, results)


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    add = parser.add_argument
    add("scene", nargs="?", help="trained scene in place of random ones: .ply, or .npz (see scene_files.py)")
    add(
        "--limit",
        type=int,
        metavar="N",
        help="of a trained scene only the N Gaussians that the widest fisheye shows most of",
    )
    add("--views", help="file of views of the scene, of which the first gives the pose")
    add("--fovs", nargs="+", type=float, default=FOVS, help="degrees from the left to the right edge")
    add("--sigmas", nargs="+", type=float, default=SIGMAS, help="px")
    add("--size", nargs=2, type=int, default=SIZE, metavar=("W", "H"))
    add("--scenes", type=int, help="random scenes per row (default: 1 to 4, more of large splats)")
    add("--gaussians", type=int, default=600, help="of the table of weights (default: %(default)s)")
    add("--samples", type=int, default=4, metavar="N", help="rays along a pixel's side (default: 4)")
    add("--threads", type=int, default=torch.get_num_threads(), help="of the CPU")
    add("--out", help="folder for pictures")
    add("--json", help="also write everything measured to this file")
    args = argparse.Namespace(device="cpu", **vars(parser.parse_args()))
    if (args.scene is None) != (args.views is None):
        parser.error("a scene needs --views, and --views a scene")
    return args


if __name__ == "__main__":
    main()
