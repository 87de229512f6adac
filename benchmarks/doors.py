"""What a frame costs by the way it is called: the drop-in, its effects, stages, gsplat's call, and gsplat's own.

    python benchmarks/doors.py SCENE --views VIEWS [--footprint box:samples=1] [--doors plain lens ...] [--cameras 1 4]

Every door renders the first view, or with 4 cameras the views in turn, forward alone and with the backward pass of
sum(image * w) for fixed random w. Medians over rounds in turn, in ms. On the CPU there are times only. With CUDA:

- forward, f+b: the time between two events around a call on an idle device;
- host: the time until the call has returned, which waits for nothing;
- events: kernels, copies and memsets;
- used, reserved: MiB of torch's allocator at the peak of forward and backward, above what the scene takes;
- plain: the ratio to the drop-in without effects;
- gsplat: the ratio to the same call of gsplat's own, where that is installed.

`--tiny` takes no scene: ten Gaussians in a picture of 16x16 px, where nothing counts but what the host does.
"""

from __future__ import annotations

import argparse
import functools
import importlib
import importlib.util
import statistics
import sys
import time
from collections.abc import Callable, Iterator

import torch
from common import CLOCKS, add_measuring, describe_machine, parse_size, save_json, settle
from scene_files import load_scene

import analytic_rasterizer as ar
from analytic_rasterizer import io
from analytic_rasterizer.analysis.tables import markdown_table
from analytic_rasterizer.analysis.timing import Case
from analytic_rasterizer.camera import view_center
from analytic_rasterizer.dialects import gsplat as dialect
from analytic_rasterizer.gaussians import Gaussians
from analytic_rasterizer.outputs import depths

DISC, STREAK = 2.0, 4.0  # px, at the median depth
WARM_UP = 40  # calls: the first 32 frames of a size wait for the device
RADIAL = {"pinhole": (0.02, -0.01, 0.0, 0.0, 0.0, 0.0), "fisheye": (0.02, 0.0, 0.0, 0.0)}


class Door:
    """A way to render: `image(with_gradient)` returns what it makes, `inputs` have the gradients."""

    def __init__(self, call: Callable[..., list[torch.Tensor]], inputs: dict[str, torch.Tensor], leaves=()):
        self.call = call
        self.plain = inputs
        self.inputs = {name: t.detach().clone().requires_grad_() for name, t in inputs.items()}
        self.leaves = list(leaves)

    @torch.no_grad()
    def forward(self) -> list[torch.Tensor]:
        return self.call(**self.plain)

    def forward_backward(self) -> tuple:
        images = [image for image in self.call(**self.inputs) if image.requires_grad]
        weights = [_weights(image.shape, image.device) for image in images]
        return torch.autograd.grad(images, [*self.inputs.values(), *self.leaves], weights, allow_unused=True)


@functools.cache
def _weights(shape: torch.Size, device: torch.device) -> torch.Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(0)).to(device)


class Doors:
    """All doors of a scene and its views."""

    def __init__(self, scene: Gaussians, views: list[io.View], footprint: str):
        self.scene, self.views, self.footprint = scene, views, footprint
        self.case = Case(scene, views[0], footprint)
        self.drop_in_inputs = scene.arguments()
        self.of_gsplat = {
            "means": scene.means,
            "quats": self.drop_in_inputs["rotations"],
            "scales": self.drop_in_inputs["scales"],
            "opacities": self.drop_in_inputs["opacities"][:, 0].contiguous(),
            "colors": scene.shs,
        }

    def rows(self, cameras: list[int]) -> dict[str, Callable[[], Door]]:
        """By name, what makes a door."""
        rows = {
            "drop-in": self.drop_in,
            **{name: functools.partial(self.drop_in, **{name: True}) for name in ("alpha", "depth")},
            "near": lambda: self.drop_in(near=0.3),
            "off_center": lambda: self.drop_in(off_center=True),
            "camera_gradients": self.camera_gradients,
            "lens: perspective": lambda: self.lens(ar.Lens.perspective((-0.1, 0.02), (1e-3, 1e-3))),
            "lens: fisheye": lambda: self.lens(ar.Lens.fisheye((0.02,))),
            "lens: coefficients as a tensor": lambda: self.lens(self._tensor_lens()),
            "defocus": self.defocus,
            "motion": self.motion,
            "median_depth": lambda: self.drop_in(median_depth=True),
            "dominant_index": lambda: self.drop_in(dominant_index=True),
            "gaussian_stats": lambda: self.drop_in(gaussian_stats=True),
            "stages": self.stages,
        }
        for count in cameras:
            rows |= {f"gsplat {name}": make for name, make in self._of_gsplat(count).items()}
        return rows

    def drop_in(self, leaves: dict | None = None, **fields) -> Door:
        settings = self.case.settings
        leaves = leaves or {}
        if fields:
            settings = settings._replace(effects=ar.Effects(**fields))
        rasterizer = ar.GaussianRasterizer(settings._replace(**leaves))

        def call(**gaussians):
            color, _, *outputs = rasterizer(means2D=None, **gaussians)
            found = [color]
            for value in outputs[0] if outputs else ():
                found += [] if value is None else value if isinstance(value, ar.GaussianStats) else [value]
            return found

        return Door(call, self.drop_in_inputs, leaves.values())

    def camera_gradients(self) -> Door:
        names = ("viewmatrix", "projmatrix", "campos", "tanfovx", "tanfovy")
        given = {name: torch.as_tensor(getattr(self.case.settings, name)).to(self.scene.means) for name in names}
        leaves = {name: value.detach().clone().requires_grad_() for name, value in given.items()}
        return self.drop_in(leaves, camera_gradients=True)

    def lens(self, lens: ar.Lens) -> Door:
        s = self.case.settings
        if not isinstance(lens.coefficients, torch.Tensor):
            lens = lens.with_reach((s.tanfovx, s.tanfovy), view_center(s.viewmatrix, s.projmatrix).tolist())
        return self.drop_in(lens=lens)

    def _tensor_lens(self) -> ar.Lens:
        numbers = ar.Lens.perspective((-0.1, 0.02), (1e-3, 1e-3)).coefficients
        return ar.Lens("perspective", torch.tensor(numbers).to(self.scene.means))

    def _seen(self) -> torch.Tensor:
        z = depths(self.scene.means, self.case.settings.viewmatrix)
        seen = z[z > ar.effects.NEAR]
        return seen if len(seen) else z.new_ones(1)

    def defocus(self) -> Door:
        z, fx = self._seen(), self.views[0].fx
        focus = z.median()
        disc = fx * (1 / focus - 1 / z).abs().median().item()
        return self.drop_in(defocus=ar.Defocus(DISC / disc if disc > 0 else 0.1, focus.item()))

    def motion(self) -> Door:
        speed = STREAK * self._seen().median().item() / self.views[0].fx
        return self.drop_in(motion=ar.Motion(1.0, velocity=(speed, 0.0, 0.0)))

    def stages(self) -> Door:
        def call(**gaussians):
            splats = ar.project(self.case.settings, **gaussians)
            lists = ar.list_tiles(splats, keep=torch.is_grad_enabled())
            return list(ar.blend(splats, lists)[:1])

        return Door(call, self.drop_in_inputs)

    def _of_gsplat(self, count: int) -> dict[str, Callable[[], Door]]:
        variants = {
            "packed": {},
            "table": {"packed": False},
            "antialiased": {"packed": False, "rasterize_mode": "antialiased"},
            "RGB+ED": {"packed": False, "render_mode": "RGB+ED"},
            "RGB+ED, packed": {"render_mode": "RGB+ED"},
        }
        if count == 1:
            variants |= {
                "OpenCV": {"packed": False, "radial": RADIAL["pinhole"], "tangential_coeffs": (1e-3, 1e-3)},
                "fisheye": {"packed": False, "radial": RADIAL["fisheye"], "camera_model": "fisheye"},
            }
        suffix = "" if count == 1 else f", {count} cameras"
        return {
            f"{name}{suffix}": functools.partial(self.gsplat, dialect.rasterization, count, **options)
            for name, options in variants.items()
        }

    def gsplat(self, rasterization: Callable, count: int, radial=None, **options) -> Door:
        views = [self.views[k % len(self.views)] for k in range(count)]
        like, size = self.scene.means, (views[0].width, views[0].height)
        intrinsics = [[[v.fx, 0.0, v.middle[0]], [0.0, v.fy, v.middle[1]], [0.0, 0.0, 1.0]] for v in views]
        poses = torch.stack([v.w2c for v in views]).to(like)
        fixed = {"viewmats": poses, "Ks": torch.tensor(intrinsics).to(like), "sh_degree": self.scene.sh_degree}
        fixed |= {"width": size[0], "height": size[1], "near_plane": 0.2} | options
        for name, numbers in (("radial_coeffs", radial), ("tangential_coeffs", options.get("tangential_coeffs"))):
            if numbers is not None:
                fixed[name] = torch.tensor([numbers] * count).to(like)
        if radial is not None and rasterization is not dialect.rasterization:
            fixed["with_ut"] = True  # without which gsplat has no lenses
        return Door(lambda **gaussians: [rasterization(**gaussians, **fixed)[0]], self.of_gsplat)


def own_of(name: str, doors: Doors, cameras: list[int]) -> Callable[[], Door] | None:
    """The same call of gsplat's own, where it is installed."""
    if not name.startswith("gsplat ") or importlib.util.find_spec("gsplat") is None:
        return None
    for count in cameras:
        made = doors._of_gsplat(count).get(name.removeprefix("gsplat "))
        if made is not None:
            own = importlib.import_module("gsplat").rasterization
            return functools.partial(doors.gsplat, own, *made.args[1:], **made.keywords)
    return None


def host_seconds(call: Callable[[], object]) -> float:
    """Until the call returns; what it queued is waited for outside."""
    start = time.perf_counter()
    result = call()
    taken = time.perf_counter() - start
    del result
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    return taken


def device_events(call: Callable[[], object]) -> int:
    """Kernels, copies and memsets of a call."""
    from torch.profiler import ProfilerActivity, profile

    torch.cuda.synchronize()
    with profile(activities=[ProfilerActivity.CUDA]) as profiled:
        call()
        torch.cuda.synchronize()
    return sum(event.device_type == torch.autograd.DeviceType.CUDA for event in profiled.events())


def memory_of(call: Callable[[], object]) -> tuple[float, float]:
    """MiB in use and reserved at the peak of some calls, above what is there before, in a cache that begins empty."""
    torch.cuda.synchronize()
    torch.cuda.empty_cache()
    torch.cuda.reset_peak_memory_stats()
    before = torch.cuda.memory_allocated()
    for _ in range(5):
        call()
    torch.cuda.synchronize()
    used, reserved = torch.cuda.max_memory_allocated() - before, torch.cuda.max_memory_reserved() - before
    return used / 2**20, reserved / 2**20


def measured(doors: dict[str, Door], device: str, rounds: int) -> dict[str, dict[str, float]]:
    """Medians by door."""
    found: dict[str, dict[str, float]] = {}
    for pass_ in ("forward", "forward_backward"):
        calls = {name: getattr(door, pass_) for name, door in doors.items()}
        for call in calls.values():
            for _ in range(WARM_UP if device == "cuda" else 3):
                call()
        samples: dict[str, list[tuple[float, float]]] = {name: [] for name in calls}
        for _ in range(rounds):
            for name, call in calls.items():
                call()  # alone: the room for pairs is of the frames of this door
                samples[name].append((CLOCKS[device](call), host_seconds(call) if device == "cuda" else 0.0))
        for name, taken in samples.items():
            ms, host = (1e3 * statistics.median(column) for column in zip(*taken))
            found.setdefault(name, {}).update({pass_: ms, f"{pass_} host": host})
            if device == "cuda":
                found[name][f"{pass_} events"] = device_events(calls[name])
    for name, door in doors.items() if device == "cuda" else ():
        found[name]["used"], found[name]["reserved"] = memory_of(door.forward_backward)
    return found


def format_table(found: dict[str, dict[str, float]], device: str) -> str:
    """As markdown."""
    columns = ["forward", "forward_backward"]
    if device == "cuda":
        columns = [f"{pass_}{of}" for pass_ in columns for of in ("", " host", " events")] + ["used", "reserved"]
    header = ["door", *(c.replace("forward_backward", "f+b") for c in columns), "plain", "plain f+b"]
    header += ["gsplat", "gsplat f+b"]
    base, rows = found.get("drop-in"), []
    for name, numbers in found.items():
        own = found.get(f"{name} (its own)")
        row = [name, *(numbers[c] for c in columns)]
        for other in (base, own):
            row += [numbers[p] / other[p] if other else "" for p in ("forward", "forward_backward")]
        rows.append(row)
    return markdown_table(header, rows)


def tiny_scene() -> tuple[Gaussians, list[io.View]]:
    """Ten Gaussians of degree 1, and a view of 16x16 px."""
    random = functools.partial(torch.randn, generator=torch.Generator().manual_seed(0))
    scene = Gaussians.from_activated(
        means=random(10, 3), scales=0.1 * random(10, 3).exp(), rotations=random(10, 4),
        opacities=random(10, 1).sigmoid(), shs=random(10, 4, 3),
    )  # fmt: skip
    pose = torch.eye(4, dtype=torch.float64)
    pose[2, 3] = 5.0
    return scene, [io.View("tiny", 16, 16, 20.0, 20.0, pose)]


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    add = parser.add_argument
    add("scene", nargs="?", help="trained scene, or an .npz (see scene_files.py)")
    add("--views", help="file of views")
    add("--tiny", action="store_true", help="ten Gaussians instead of a scene")
    add("--footprint", default="box:samples=1", help="of all doors but gsplat's (default: %(default)s)")
    add("--doors", nargs="+", metavar="NAME", help="whose names begin so (default: all)")
    add("--cameras", nargs="+", type=int, default=[1, 4], help="of gsplat's call (default: 1 4)")
    add("--size", type=parse_size, help="of the pictures, WIDTHxHEIGHT")
    add_measuring(parser)
    args = parser.parse_args()
    if not args.tiny and not (args.scene and args.views):
        parser.error("expected a scene and --views, or --tiny")
    settle(parser, args)
    torch.set_num_threads(args.threads)
    return args


def chosen(args: argparse.Namespace, doors: Doors) -> Iterator[tuple[str, Door]]:
    """The doors, and beside those of gsplat's call gsplat's own."""
    for name, make in doors.rows(args.cameras).items():
        if args.doors and not any(name.startswith(start) for start in args.doors):
            continue
        yield name, make()
        own = own_of(name, doors, args.cameras) if args.device == "cuda" else None
        if own is not None:
            yield f"{name} (its own)", own()


def main() -> None:
    args = parse_arguments()
    if args.tiny:
        scene, views = tiny_scene()
    else:
        scene, views = load_scene(args.scene), io.load_views(args.views)
    if args.size:
        views = [view.resized(*args.size) for view in views]
    doors = Doors(scene.to(args.device), views, args.footprint)
    print(f"{len(scene.means)} Gaussians, {views[0].width}x{views[0].height}, {describe_machine(args.device)}")
    made = dict(chosen(args, doors))
    for name, door in list(made.items()):  # what is not there is left out, not the rest of the table
        try:
            door.forward()
        except (NotImplementedError, AssertionError, TypeError, ValueError, RuntimeError) as error:
            print(f"{name}: left out: {error}", file=sys.stderr)
            del made[name]
    found = measured(made, args.device, args.rounds)
    print(format_table(found, args.device))
    save_json(args, {"doors": found})


if __name__ == "__main__":
    main()
