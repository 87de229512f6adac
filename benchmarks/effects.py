"""What each effect costs: time and memory with it off and on, on any scene and views, on the CPU or with CUDA.

    python benchmarks/effects.py SCENE --views VIEWS [--footprints box:samples=1 ...] [--effects depth motion ...]

Off is the plain path, three colours of a fixed pinhole: from the scene's harmonics, but for `channels` from random
colours, and for `sh_degree:4` from as many coefficients (zeros where the scene has none), of which degree 3 uses 16.
Every effect is timed against a plain rendering of its own, in turn, round after round, so that a machine that slows
down slows both; `off_twice` has two plain ones, and shows what is noise. Medians over rounds, averaged over views.
"forward" is without gradient; "forward+backward" computes the gradient of sum(image * w) for fixed random w, over all
channels and differentiable outputs, with respect to all inputs, those of the effect among them (camera, background).
"extra" is the memory that a forward and backward pass needs beyond inputs, outputs and gradients.

Numbers come from the scene: a lens focused on the median depth whose median disc has 2 px, a camera that moves sideways
by 4 px at the median depth, an orthographic one that shows as much as the other there, planes that cut nothing,
`filter_3d` of the given views.

With CUDA times are between two events around a call on an idle device, and memory is what torch's allocator handed out.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable

import torch
from common import CLOCKS, make_parser, mean_of, measure, parse, print_setup, save_json
from scene_files import load_scene

import analytic_rasterizer as ar
from analytic_rasterizer import effects, io
from analytic_rasterizer.analysis.tables import markdown_table
from analytic_rasterizer.analysis.timing import Case, fixed_weights
from analytic_rasterizer.cameras.camera import view_center
from analytic_rasterizer.cli.arguments import add_scales, reduction
from analytic_rasterizer.gaussians import Gaussians
from analytic_rasterizer.render.outputs import depths

FOOTPRINTS = ["box:samples=1", "box:samples=4"]
DISC, STREAK = 2.0, 4.0  # px
CAMERA = ("viewmatrix", "projmatrix", "campos", "tanfovx", "tanfovy")


def main() -> None:
    args = parse_arguments()
    scene = load_scene(args.scene).to(args.device)
    views = [view.scaled(1 / args.scales) for view in io.load_views(args.views)[: args.limit_views]]
    print_setup(scene, views, args.device)
    clock, results = CLOCKS[args.device], {}

    def time_round(case: EffectCase) -> dict:
        return {"forward": clock(case.forward), "forward_backward": clock(case.forward_backward)}

    for footprint in args.footprints:
        results[footprint] = {}
        for name in args.effects:
            cases = {
                side: [change(EffectCase(scene, views, view, footprint)) for view in views]
                for side, change in zip(("off", "on"), ROWS[name])
            }
            measured = measure(cases, time_round, args.device, args.rounds)
            results[footprint][name] = {side: mean_of(per_view) for side, per_view in measured.items()}
        print(f"\n`{footprint}`\n\n{format_results(results[footprint])}")
    save_json(args, {"results": results})


def parse_arguments() -> argparse.Namespace:
    parser = make_parser(__doc__.split("\n")[0], FOOTPRINTS)
    parser.add_argument("--limit-views", type=int, help="use only so many of them")
    add_scales(parser, reduction, "of the views: 2 is half the size (default: 1)", 1.0)
    parser.add_argument(
        "--effects", nargs="+", default=list(ROWS), choices=list(ROWS), metavar="ROW", help=", ".join(ROWS)
    )
    return parse(parser)


def format_results(results: dict[str, dict]) -> str:
    header = ["effect", "forward ms: off", "on", "ratio", "forward+backward ms: off", "on", "ratio"]
    header += ["extra MiB: off", "on"]
    rows = []
    for name, result in results.items():
        row = [name]
        for key in ("forward", "forward_backward"):
            off, on = result["off"][key], result["on"][key]
            row += [1e3 * off, 1e3 * on, on / off]
        rows.append([*row, *(side["extra_bytes"] / 2**20 for side in result.values())])
    return markdown_table(header, rows)


# -------------------------------------------------------------------------------------- what is rendered


class EffectCase(Case):
    """One view of a scene, rendered plainly until it is changed, and the numbers that effects take from it."""

    def __init__(self, scene: Gaussians, views: list[io.View], view: io.View, footprint: str):
        super().__init__(scene, view, footprint)
        self.scene, self.views, self.view = scene, views, view
        self.leaves = []  # what has a gradient besides the Gaussians: fields of the settings

    def change(self, settings: dict, gaussians: dict | None = None, leaves: tuple | list = ()) -> EffectCase:
        """Itself, with other settings, other Gaussians (None: without), and further tensors that have a gradient."""
        self.settings = self.settings._replace(**settings)
        self.rasterizer = ar.GaussianRasterizer(self.settings)
        self.gaussians = {k: v for k, v in (self.gaussians | (gaussians or {})).items() if v is not None}
        means2D = self.inputs["means2D"]
        self.inputs = {k: v.detach().requires_grad_() for k, v in self.gaussians.items()} | {"means2D": means2D}
        self.leaves = list(leaves)
        return self

    def images(self, **gaussians) -> list[torch.Tensor]:
        """All that comes of it but the radii."""
        color, _, *outputs = self.rasterizer(**gaussians)
        found = [color]
        for value in outputs[0] if outputs else ():
            found += value if isinstance(value, ar.GaussianStats) else [value]
        return [image for image in found if image is not None]

    @torch.no_grad()
    def forward(self) -> list[torch.Tensor]:
        return self.images(means2D=None, **self.gaussians)

    def forward_backward(self) -> list[torch.Tensor]:
        images = self.images(**self.inputs)
        with_gradient = [image for image in images if image.requires_grad]
        weights = [fixed_weights(*image.shape[1:], image.device, len(image)) for image in with_gradient]
        return [*images, *torch.autograd.grad(with_gradient, [*self.inputs.values(), *self.leaves], weights)]

    # The effects. Each changes the case and returns it.

    def plain(self) -> EffectCase:
        return self

    def with_effects(self, **fields) -> EffectCase:
        return self.change({"effects": ar.Effects(**fields)})

    def seen_depths(self) -> torch.Tensor:
        """z of the Gaussians whose centres are in the picture, world units; 1 where there are none."""
        z, clip = depths(self.scene.means, self.settings.viewmatrix), self.settings.projmatrix
        projected = self.scene.means @ clip[:3] + clip[3]
        seen = z[(z > effects.NEAR) & (projected[:, :2].abs() <= projected[:, 3:]).all(1)]
        return seen if len(seen) else z.new_ones(1)

    def channels(self, count: int) -> EffectCase:
        """Random colours in place of the harmonics."""
        means = self.scene.means
        colors = torch.rand(len(means), count, generator=torch.Generator().manual_seed(0)).to(means)
        return self.change({"bg": means.new_zeros(count)}, {"shs": None, "colors_precomp": colors})

    def background(self) -> EffectCase:
        bg = self.dL_dcolor.clone().requires_grad_()
        return self.change({"bg": bg}, leaves=[bg])

    def camera_gradients(self) -> EffectCase:
        given = {name: torch.as_tensor(getattr(self.settings, name)).to(self.scene.means) for name in CAMERA}
        leaves = {name: value.detach().clone().requires_grad_() for name, value in given.items()}
        return self.change(leaves | {"effects": ar.Effects(camera_gradients=True)}, leaves=leaves.values())

    def orthographic(self) -> EffectCase:
        z, view = self.seen_depths().median().item(), self.view
        camera = ar.camera_settings(
            view.w2c.to(self.scene.means.device), view.width, view.height, view.fx / z, view.fy / z, view.cx, view.cy,
            effects=ar.Effects(orthographic=True),
        )  # fmt: skip
        return self.change({name: getattr(camera, name) for name in (*CAMERA, "effects")})

    def near_far(self) -> EffectCase:
        z = depths(self.scene.means, self.settings.viewmatrix)
        return self.with_effects(far=2 * z.abs().max().item())

    def filter_3d(self) -> EffectCase:
        cameras = [view.settings(device=self.scene.means.device) for view in self.views]
        return self.with_effects(filter_3d=ar.compute_3d_filter(self.scene.means, cameras))

    def defocus(self) -> EffectCase:
        z = self.seen_depths()
        focus = z.median()
        disc = self.view.fx * (1 / focus - 1 / z).abs().median().item()  # px for an aperture of 1
        return self.with_effects(defocus=ar.Defocus(DISC / disc if disc > 0 else 0.1, focus.item()))

    def motion(self) -> EffectCase:
        speed = STREAK * self.seen_depths().median().item() / self.view.fx
        return self.with_effects(motion=ar.Motion(1.0, velocity=(speed, 0.0, 0.0)))

    def with_degree(self, degree: int) -> EffectCase:
        """Harmonics up to `degree` of coefficients for degree 4, zero where the scene has none."""
        return self.change({"sh_degree": degree}, {"shs": self.scene.with_sh_degree(4).shs})


def lens(of: ar.Lens):
    """A change to the same camera with a lens."""

    def change(case: EffectCase) -> EffectCase:
        settings = case.settings
        middle = view_center(settings.viewmatrix, settings.projmatrix)
        found = of.with_reach((settings.tanfovx, settings.tanfovy), middle)  # once, as `camera_settings` does
        return case.change({"effects": ar.Effects(lens=found)})

    return change


def effect(**fields) -> Callable[[EffectCase], EffectCase]:
    return lambda case: case.with_effects(**fields)


def channels(count: int) -> tuple:
    return (lambda case: case.channels(3), lambda case: case.channels(count))


# Off and on, by row.
ROWS = {
    "off_twice": (EffectCase.plain, EffectCase.plain),
    **{name: (EffectCase.plain, effect(**{name: True})) for name in effects.OUTPUTS},
    "alpha+depth+inverse_depth": (EffectCase.plain, effect(alpha=True, depth=True, inverse_depth=True)),
    "all_outputs": (EffectCase.plain, effect(**dict.fromkeys(effects.OUTPUTS, True))),
    "channels:8": channels(8),
    "channels:32": channels(32),
    "channels:64": channels(64),
    "background": (EffectCase.plain, EffectCase.background),
    "camera_gradients": (EffectCase.plain, EffectCase.camera_gradients),
    "orthographic": (EffectCase.plain, EffectCase.orthographic),
    "off_center": (EffectCase.plain, effect(off_center=True)),
    "lens:perspective": (EffectCase.plain, lens(ar.Lens.perspective((-0.1, 0.02), (1e-3, 1e-3)))),
    "lens:fisheye": (EffectCase.plain, lens(ar.Lens.fisheye((0.02,)))),
    "near_far": (EffectCase.plain, EffectCase.near_far),
    "order": (EffectCase.plain, effect(order="ray")),
    "filter_3d": (EffectCase.plain, EffectCase.filter_3d),
    "defocus": (EffectCase.plain, EffectCase.defocus),
    "motion": (EffectCase.plain, EffectCase.motion),
    "order:ray": (EffectCase.plain, effect(order="ray")),
    "sh_degree:0": (EffectCase.plain, effect(sh_degree=0)),
    "sh_degree:4": (lambda case: case.with_degree(3), lambda case: case.with_degree(4)),
}


if __name__ == "__main__":
    main()
