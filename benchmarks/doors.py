"""What a frame costs by the door through which it is rendered: drop-in, effects, stages, gsplat's call; and gsplat.

    python benchmarks/doors.py SCENE --views VIEWS [--footprint box:samples=1] [--doors plain stages ...]
    python benchmarks/doors.py --tiny

A row is a door. The doors take turns in every round. A call that is not timed precedes a timed one, so that no door
pays for another. Numbers are medians over rounds, averaged over views. "forward" is without gradient. "f+b" also
computes the gradient of sum(image * w), for fixed random w, with respect to all inputs. "/base" is the ratio to the row
"plain". Defocus and motion are compared with plain frames of Gaussians enlarged until there are as many pairs. Rows
with * are gsplat's own `rasterization`, where gsplat is installed and there is a CUDA device. "/gsplat" is the ratio of
our row to gsplat's row of the same call. With "4 cameras" a call renders this view and the three that follow.

With CUDA "ms" is between two events around a call on an idle device, and "host" until the call returns, without
waiting. "events" are kernels, copies and fills on the device by torch's profiler. "used" and "reserved" are the peaks
of torch's allocator over a few passes of the row alone, from an emptied cache, scene included.

--tiny is for the host's share: 10 random Gaussians of degree 1 in 32x32 pixels, on one thread of the CPU.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import torch
from common import (
    CLOCKS,
    add_measuring,
    mean_of,
    measure,
    parse,
    peaks_of_memory,
    print_setup,
    save_json,
    start_peaks,
)
from effects import EffectCase, effect, lens
from peers import find_peers
from scene_files import load_scene

import analytic_rasterizer as ar
from analytic_rasterizer import io
from analytic_rasterizer.analysis.tables import markdown_table
from analytic_rasterizer.analysis.timing import WARM_UP, Case, fixed_weights, seconds_of
from analytic_rasterizer.cli.arguments import add_scales, reduction
from analytic_rasterizer.dialects import gsplat
from analytic_rasterizer.gaussians import Gaussians
from analytic_rasterizer.render.effects import NEAR

PASSES = ("forward", "forward_backward")
TINY_ROUNDS = 500
MEMORY_PASSES = 3
RADIAL, TANGENTIAL = (-0.1, 0.02, 0.0, 0.0, 0.0, 0.0), (1e-3, 1e-3)  # OpenCV's coefficients


class Door(NamedTuple):
    make: Callable[[Gaussians, list[io.View], int, str], Case]
    """Of a scene, views, the number of one of them, and a footprint."""
    base: str = "plain"
    peer: str | None = None
    """The row of gsplat's own call."""


def main() -> None:
    args = parse_arguments()
    if args.tiny:
        scene, views = tiny_scene()
    else:
        views = [view.scaled(1 / args.scales) for view in io.load_views(args.views)[: args.limit_views]]
        scene = load_scene(args.scene).to(args.device)
    print_setup(scene, views, args.device)
    doors = DOORS | (PEERS if find_peers(["gsplat"], args.device) else {})
    chosen = {name: door for name, door in doors.items() if name == "plain" or is_chosen(name, doors, args.doors)}
    cases = {
        name: [door.make(scene, views, i, args.footprint) for i in range(len(views))] for name, door in chosen.items()
    }
    measured = measure(cases, partial(time_round, device=args.device), args.device, args.rounds)
    results = {name: mean_of(per_view) for name, per_view in measured.items()}
    if args.device == "cuda":
        for name, of_door in cases.items():
            results[name] |= count_events(of_door) | peak_memory(of_door)
    print(f"\n`{args.footprint}`\n\n{format_results(results, chosen, args.device)}")
    save_json(args, {"results": results})


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    add = parser.add_argument
    add("scene", nargs="?", help="trained scene: .ply, compressed .ply, .spz, or .npz (see scene_files.py)")
    add("--views", help="file of views")
    add("--limit-views", type=int, help="use only so many of them")
    add_scales(parser, reduction, "of the views: 2 is half the size (default: 1)", 1.0)
    add("--tiny", action="store_true", help="a tiny random scene on one thread of the CPU instead")
    add("--footprint", default="box:samples=1", metavar="NAME[:k=v]", help="not of gsplat's call (%(default)s)")
    add("--doors", nargs="+", choices=list(DOORS), default=list(DOORS), metavar="ROW", help=", ".join(DOORS))
    add_measuring(parser)
    given = parser.parse_args()
    if given.tiny == (given.scene is not None) or given.tiny == (given.views is not None):
        parser.error("either a scene and --views, or --tiny")
    if given.tiny:
        parser.set_defaults(device="cpu", threads=1, rounds=TINY_ROUNDS)
        if parser.parse_args().device == "cuda":
            parser.error("--tiny: runs on the CPU")
    return parse(parser)


def is_chosen(name: str, doors: dict[str, Door], chosen: list[str]) -> bool:
    """Whether a row is asked for, or another needs it."""
    return name in chosen or any(name in (doors[other].base, doors[other].peer) for other in chosen)


def tiny_scene() -> tuple[Gaussians, list[io.View]]:
    generator = torch.Generator().manual_seed(0)
    rand = partial(torch.rand, generator=generator)
    scene = Gaussians.from_activated(
        means=2 * rand(10, 3) - 1 + torch.tensor([0.0, 0.0, 4.0]),
        scales=0.05 + 0.2 * rand(10, 3),
        rotations=rand(10, 4) - 0.5,
        opacities=0.5 + 0.4 * rand(10, 1),
        shs=rand(10, 4, 3) - 0.5,
    )
    return scene, [io.View("tiny", 32, 32, 32.0, 32.0, torch.eye(4))]


# ------------------------------------------------------------------------------------------ what is measured


def time_round(case: Case, device: str) -> dict[str, float]:
    """Seconds of both passes; with CUDA also until their calls return."""
    result = {}
    for name in PASSES:
        call = getattr(case, name)
        call()
        if device == "cuda":
            torch.cuda.synchronize()
        result[name] = CLOCKS[device](call)
        if device == "cuda":
            result[f"host_{name}"] = seconds_of(call)
            torch.cuda.synchronize()
    return result


def count_events(cases: list[Case]) -> dict[str, float]:
    """Kernels, copies and fills on the device in a pass, over the cases."""
    activities = [torch.profiler.ProfilerActivity.CUDA]
    result = {}
    for name in PASSES:
        for case in cases:  # what follows other doors may wait for the device, and copies then
            for _ in range(WARM_UP):
                getattr(case, name)()
        torch.cuda.synchronize()
        with torch.profiler.profile(activities=activities) as profiler:
            for case in cases:
                getattr(case, name)()
            torch.cuda.synchronize()
        on_device = [e for e in profiler.events() if e.device_type == torch.autograd.DeviceType.CUDA]
        result[f"events_{name}"] = len(on_device) / len(cases)
    return result


def peak_memory(cases: list[Case]) -> dict[str, float | None]:
    start_peaks("cuda")
    for _ in range(MEMORY_PASSES):
        for case in cases:
            case.forward()
            case.forward_backward()
    return peaks_of_memory("cuda")


def format_results(results: dict[str, dict], doors: dict[str, Door], device: str) -> str:
    on_cuda = device == "cuda"
    header = ["door", "forward ms", "/base", "/gsplat", "f+b ms", "/base", "/gsplat"]
    header += ["host ms", "f+b", "events", "f+b", "used MiB", "reserved MiB"] if on_cuda else []
    rows = []
    for name, result in results.items():
        row, base, peer = [name], results[doors[name].base], results.get(doors[name].peer)
        for key in PASSES:
            row += [1e3 * result[key], result[key] / base[key], result[key] / peer[key] if peer else None]
        if on_cuda:
            row += [1e3 * result[f"host_{key}"] for key in PASSES] + [result[f"events_{key}"] for key in PASSES]
            row += [result["used_mib"], result["reserved_mib"]]
        rows.append(row)
    return markdown_table(header, rows)


# -------------------------------------------------------------------------------------------------- doors


def drop_in(change: Callable[[EffectCase], EffectCase]) -> Callable:
    return lambda scene, views, i, footprint: change(EffectCase(scene, views, views[i], footprint))


class StagesCase(Case):
    """Three calls in place of one."""

    def __init__(self, scene: Gaussians, views: list[io.View], i: int, footprint: str):
        super().__init__(scene, views[i], footprint)
        del self.inputs["means2D"]  # which `project` does not take

    def image(self, means3D, means2D=None, **gaussians) -> torch.Tensor:
        splats = ar.project(self.settings, means3D, **gaussians)
        return ar.blend(splats, ar.list_tiles(splats, keep=torch.is_grad_enabled()))[0][0]


class CallCase(Case):
    """gsplat's call, of this package or of gsplat."""

    def __init__(
        self,
        scene: Gaussians,
        views: list[io.View],
        i: int,
        _: str,
        own: bool,
        cameras: int = 1,
        coefficients: bool = False,
        **options: Any,
    ):
        super().__init__(scene, views[i], "point")
        del self.inputs["means2D"]
        self.rasterization = gsplat.rasterization
        if not own:
            from gsplat import rasterization

            self.rasterization = rasterization
        of_size = [v for v in views[i:] + views[:i] if (v.width, v.height) == (views[i].width, views[i].height)]
        used = [of_size[k % len(of_size)] for k in range(cameras)]
        intrinsics = [[[v.fx, 0.0, v.middle[0]], [0.0, v.fy, v.middle[1]], [0.0, 0.0, 1.0]] for v in used]
        self.fixed = {
            "viewmats": torch.stack([v.w2c for v in used]).to(scene.means),
            "Ks": torch.tensor(intrinsics).to(scene.means),
            "width": views[i].width,
            "height": views[i].height,
            "sh_degree": scene.sh_degree,
            "near_plane": NEAR,
            "packed": False,
            **options,
        }
        if coefficients:
            rows = {"radial_coeffs": RADIAL, "tangential_coeffs": TANGENTIAL}
            self.fixed |= {name: scene.means.new_tensor([row] * cameras) for name, row in rows.items()}
            self.fixed["with_ut"] = True  # which gsplat demands

    def image(self, means3D, opacities, shs, scales, rotations, means2D=None) -> torch.Tensor:
        return self.rasterization(means3D, rotations, scales, opacities[:, 0], shs, **self.fixed)[0]

    def forward_backward(self) -> list[torch.Tensor]:
        images = self.image(**self.inputs)
        c, h, w, channels = images.shape
        weights = fixed_weights(w, channels, images.device, c * h).view(images.shape)
        gradients = torch.autograd.grad(images, list(self.inputs.values()), weights, allow_unused=True)
        return [images, *(g for g in gradients if g is not None)]  # with_ut has none of some of gsplat's own


def as_large(changed: Callable[[EffectCase], EffectCase]) -> Callable[[EffectCase], EffectCase]:
    """A plain frame whose Gaussians are enlarged, all alike, until it has as many pairs as the changed one."""

    def change(case: EffectCase) -> EffectCase:
        def pairs(of: EffectCase) -> int:
            return len(ar.render_stages(of.settings, **of.gaussians).pairs)

        make = partial(EffectCase, case.scene, case.views, case.view, str(case.settings.footprint))
        wanted, low, high = pairs(changed(make())), 0.0, 6.0  # octaves
        for _ in range(10):
            middle = (low + high) / 2
            few = pairs(make().change({"scale_modifier": 2**middle})) < wanted
            low, high = (middle, high) if few else (low, middle)
        return case.change({"scale_modifier": 2 ** ((low + high) / 2)})

    return change


CALLS = {
    "": {},
    " packed": {"packed": True},
    " antialiased": {"rasterize_mode": "antialiased"},
    " RGB+ED": {"render_mode": "RGB+ED"},
    " packed RGB+ED": {"packed": True, "render_mode": "RGB+ED"},
    " 4 cameras": {"cameras": 4},
    " 4 cameras packed": {"cameras": 4, "packed": True},
    " 4 cameras RGB+ED": {"cameras": 4, "render_mode": "RGB+ED"},
    " OpenCV": {"coefficients": True},
    " fisheye": {"camera_model": "fisheye"},
}
"""What follows "gsplat" in the name of a row, and options of `CallCase`."""

DOORS = {
    "plain": Door(drop_in(EffectCase.plain)),
    "alpha": Door(drop_in(effect(alpha=True))),
    "depth": Door(drop_in(effect(depth=True))),
    "near": Door(drop_in(effect(near=1.001 * NEAR))),
    "camera_gradients": Door(drop_in(EffectCase.camera_gradients)),
    "off_center": Door(drop_in(effect(off_center=True))),
    "lens:perspective": Door(drop_in(lens(ar.Lens.perspective(RADIAL[:2], TANGENTIAL)))),
    "lens:fisheye": Door(drop_in(lens(ar.Lens.fisheye((0.02,))))),
    "plain, as defocus": Door(drop_in(as_large(EffectCase.defocus))),
    "defocus": Door(drop_in(EffectCase.defocus), "plain, as defocus"),
    "plain, as motion": Door(drop_in(as_large(EffectCase.motion))),
    "motion": Door(drop_in(EffectCase.motion), "plain, as motion"),
    "median_depth": Door(drop_in(effect(median_depth=True))),
    "stages": Door(StagesCase),
    **{
        f"gsplat{name}": Door(partial(CallCase, own=True, **options), peer=f"gsplat*{name}")
        for name, options in CALLS.items()
    },
}
PEERS = {f"gsplat*{name}": Door(partial(CallCase, own=False, **options)) for name, options in CALLS.items()}


if __name__ == "__main__":
    main()
