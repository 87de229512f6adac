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
import statistics
from collections.abc import Callable

import torch
from common import UNITS, WARM_UP, make_parser, median_of, parse, print_setup, save_json
from scene_files import load_scene

import analytic_rasterizer as ar
from analytic_rasterizer import effects, io
from analytic_rasterizer.analysis.tables import markdown_table
from analytic_rasterizer.analysis.timing import (
    Case,
    event_seconds,
    fixed_weights,
    in_turn,
    seconds_of,
    warm_up_cuda,
)

FOOTPRINTS = ["box:samples=1", "box:samples=4"]
DISC, STREAK = 2.0, 4.0  # px
CAMERA = ("viewmatrix", "projmatrix", "campos", "tanfovx", "tanfovy")


def main() -> None:
    args = parse_arguments()
    scene = load_scene(args.scene).to(args.device)
    views = [view.scaled(args.scale) for view in io.load_views(args.views)[: args.limit_views]]
    print_setup(scene, views, args.device)
    results = {}
    for footprint in args.footprints:
        setups = [Setup(scene, views, view, footprint) for view in views]
        rows = {name: ROWS[name] for name in args.effects}
        results[footprint] = {name: measure(setups, *row, args.device, args.rounds) for name, row in rows.items()}
        print(f"\n`{footprint}`\n\n{format_results(results[footprint], args.device)}")
    save_json(args, {"results": results})


def parse_arguments() -> argparse.Namespace:
    parser = make_parser(__doc__.split("\n")[0], FOOTPRINTS)
    parser.add_argument("--limit-views", type=int, help="use only so many of them")
    parser.add_argument("--scale", type=float, default=1.0, help="of the views' size")
    parser.add_argument(
        "--effects", nargs="+", default=list(ROWS), choices=list(ROWS), metavar="ROW", help=", ".join(ROWS)
    )
    return parse(parser)


def format_results(results: dict[str, dict], device: str) -> str:
    unit, per_second = UNITS[device]
    header = ["effect", f"forward {unit}: off", "on", "ratio", f"forward+backward {unit}: off", "on", "ratio"]
    header += ["extra MiB: off", "on"]
    rows = []
    for name, result in results.items():
        row = [name]
        for key in ("forward", "forward_backward"):
            off, on = result["off"][key], result["on"][key]
            row += [f"{off * per_second:.3f}", f"{on * per_second:.3f}", f"{on / off:.2f}"]
        rows.append([*row, *(f"{result[which]['extra_bytes'] / 2**20:.1f}" for which in ("off", "on"))])
    return markdown_table(header, rows)


# -------------------------------------------------------------------------------------- what is rendered


class Setup:
    """A plain rendering of one view, and the numbers that effects take from it."""

    def __init__(self, scene: io.Scene, views: list[io.View], view: io.View, footprint: str):
        self.scene, self.views, self.view, self.footprint = scene, views, view, footprint
        self.device = scene.means.device
        self.settings = view.settings(1.0, (0.0, 0.0, 0.0), scene.sh_degree, footprint, device=self.device)

    def plain(self) -> PlainCase:
        return PlainCase(self.scene, self.view, self.footprint)

    def with_effects(self, **fields) -> PlainCase:
        return self.plain().change(settings={"effects": ar.Effects(**fields)})

    def depths(self) -> torch.Tensor:
        """z of the Gaussians whose centres are in the picture, world units; 1 where there are none."""
        z, clip = self.all_depths(), self.settings.projmatrix
        projected = self.scene.means @ clip[:3] + clip[3]
        seen = z[(z > effects.NEAR) & (projected[:, :2].abs() <= projected[:, 3:]).all(1)]
        return seen if len(seen) else z.new_ones(1)

    def all_depths(self) -> torch.Tensor:
        """z of all Gaussians, world units."""
        view = self.settings.viewmatrix
        return self.scene.means @ view[:3, 2] + view[3, 2]

    def channels(self, count: int) -> PlainCase:
        """Random colours in place of the harmonics."""
        g = torch.Generator().manual_seed(0)
        colors = torch.rand(len(self.scene.means), count, generator=g).to(self.device)
        background = torch.zeros(count, device=self.device)
        return self.plain().change(gaussians={"shs": None, "colors_precomp": colors}, settings={"bg": background})

    def background(self) -> PlainCase:
        bg = fixed_weights(self.view.height, self.view.width, self.device).clone().requires_grad_()
        return self.plain().change(settings={"bg": bg}, inputs={"bg": bg})

    def camera_gradients(self) -> PlainCase:
        leaves = {
            name: torch.as_tensor(getattr(self.settings, name), dtype=torch.float32, device=self.device)
            for name in CAMERA
        }
        leaves = {name: value.detach().clone().requires_grad_() for name, value in leaves.items()}
        asked = {"effects": ar.Effects(camera_gradients=True)}
        return self.plain().change(settings=leaves | asked, inputs=leaves)

    def orthographic(self) -> PlainCase:
        z, view = self.depths().median().item(), self.view
        camera = ar.camera_settings(
            view.w2c.to(self.device), view.width, view.height, view.fx / z, view.fy / z, view.cx, view.cy,
            effects=ar.Effects(orthographic=True),
        )  # fmt: skip
        names = (*CAMERA, "effects")
        return self.plain().change(settings={name: getattr(camera, name) for name in names})

    def near_far(self) -> PlainCase:
        return self.with_effects(far=2 * self.all_depths().abs().max().item())

    def filter_3d(self) -> PlainCase:
        cameras = [view.settings(device=self.device) for view in self.views]
        return self.with_effects(filter_3d=ar.compute_3d_filter(self.scene.means, cameras))

    def defocus(self) -> PlainCase:
        z = self.depths()
        focus = z.median()
        disc = self.view.fx * (1 / focus - 1 / z).abs().median().item()  # px for an aperture of 1
        return self.with_effects(defocus=ar.Defocus(DISC / disc if disc > 0 else 0.1, focus.item()))

    def motion(self) -> PlainCase:
        speed = STREAK * self.depths().median().item() / self.view.fx
        return self.with_effects(motion=ar.Motion(1.0, velocity=(speed, 0.0, 0.0)))

    def with_degree(self, degree: int, stored: int) -> PlainCase:
        """Harmonics up to `degree` of coefficients for those up to `stored`, zero where the scene has none."""
        missing = (stored + 1) ** 2 - self.scene.shs.shape[1]
        shs = torch.nn.functional.pad(self.scene.shs, (0, 0, 0, missing))
        return self.plain().change(gaussians={"shs": shs}, settings={"sh_degree": degree})


class PlainCase(Case):
    """A case that can be given effects."""

    def __init__(self, scene: io.Scene, view: io.View, footprint: str):
        super().__init__(scene, view, footprint)
        self.of_settings = []  # inputs with a gradient that are fields of the settings

    def change(
        self, gaussians: dict | None = None, settings: dict | None = None, inputs: dict | None = None
    ) -> PlainCase:
        """Itself, with other Gaussians (None: without), fields of the settings, and inputs that have a gradient."""
        self.gaussians = {k: v for k, v in (self.gaussians | (gaussians or {})).items() if v is not None}
        self.settings = self.settings._replace(**settings or {})
        self.rasterizer = ar.GaussianRasterizer(self.settings)
        means2D = self.inputs["means2D"]
        self.inputs = {k: v.detach().requires_grad_() for k, v in self.gaussians.items()} | {"means2D": means2D}
        self.of_settings = list(inputs.values()) if inputs else []
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
        inputs = [*self.inputs.values(), *self.of_settings]
        return [*images, *torch.autograd.grad(with_gradient, inputs, weights)]


def effect(**fields) -> Callable[[Setup], PlainCase]:
    return lambda setup: setup.with_effects(**fields)


def channels(count: int) -> tuple:
    return (lambda setup: setup.channels(3), lambda setup: setup.channels(count))


# Off and on, by row.
ROWS = {
    "off_twice": (Setup.plain, Setup.plain),
    **{name: (Setup.plain, effect(**{name: True})) for name in effects.OUTPUTS},
    "alpha+depth+inverse_depth": (Setup.plain, effect(alpha=True, depth=True, inverse_depth=True)),
    "all_outputs": (Setup.plain, effect(**dict.fromkeys(effects.OUTPUTS, True))),
    "channels:8": channels(8),
    "channels:32": channels(32),
    "channels:64": channels(64),
    "background": (Setup.plain, Setup.background),
    "camera_gradients": (Setup.plain, Setup.camera_gradients),
    "orthographic": (Setup.plain, Setup.orthographic),
    "off_center": (Setup.plain, effect(off_center=True)),
    "near_far": (Setup.plain, Setup.near_far),
    "filter_3d": (Setup.plain, Setup.filter_3d),
    "defocus": (Setup.plain, Setup.defocus),
    "motion": (Setup.plain, Setup.motion),
    "sh_degree:0": (Setup.plain, effect(sh_degree=0)),
    "sh_degree:4": (lambda setup: setup.with_degree(3, 4), lambda setup: setup.with_degree(4, 4)),
}

# -------------------------------------------------------------------------------------- what is measured


def measure(setups: list[Setup], off: Callable, on: Callable, device: str, rounds: int) -> dict[str, dict]:
    """Seconds and bytes off and on: medians over rounds, means over views."""
    cases = {"off": [off(setup) for setup in setups], "on": [on(setup) for setup in setups]}
    if device == "cuda":
        each = [case for of_name in cases.values() for case in of_name]
        warm_up_cuda([call for case in each for call in (case.forward, case.forward_backward)], WARM_UP)
    clock = event_seconds if device == "cuda" else seconds_of
    samples = in_turn(cases, lambda case: time_round(case, clock), rounds + 1)
    results = {}
    for name, of_name in cases.items():
        per_view = [
            median_of(taken[1:]) | {"extra_bytes": case.extra_bytes()} for case, taken in zip(of_name, samples[name])
        ]
        results[name] = {key: statistics.mean(view[key] for view in per_view) for key in per_view[0]}
    return results


def time_round(case: PlainCase, clock: Callable) -> dict:
    return {"forward": clock(case.forward), "forward_backward": clock(case.forward_backward)}


if __name__ == "__main__":
    main()
