"""What an effect costs where it is off, nothing, and what it changes besides itself, nothing.

The plain path, three colours of a fixed pinhole, calls the same ops, launches the same kernels and allocates the same
bytes whether effects are left out, given without any that is on, or were on in the frame before; and what it allocates
per pixel and per Gaussian is written down here. An effect that is switched on, and adds an output or by its numbers
leaves the picture as it is, leaves every bit of all else as it is.
"""

import collections
import dataclasses
import functools
import itertools
import json
from dataclasses import MISSING
from typing import NamedTuple

import pytest
import scenes
import torch
from marks import each_path, each_precision, needs_cuda
from scenes import PATHS, Camera

import analytic_rasterizer as ar
from analytic_rasterizer import _C

# --- what the plain path calls, launches and allocates -----------------------------------------------

# Tensors are known by their sizes: pixels, Gaussians and what either has are numbers without a common factor.
SMALL = Camera(image_height=29, image_width=37, sh_degree=1)
PIXELS, GAUSSIANS = 29 * 37, 61
FRAME_PAIRS = 1 << 12  # room for pairs on CUDA, which would else follow the frames before
PASSES = ("inference", "forward", "forward_backward")
each_pass = pytest.mark.parametrize("pass_", PASSES)


class Cost(NamedTuple):
    """What one call does, for comparison with another."""

    outermost: list  # ops that are not called by another, in order
    ops: list  # all ops, in order
    allocated: dict  # how many allocations of so many bytes
    launched: dict  # on CUDA: how many kernels, memsets and copies, by name
    requested: tuple  # on CUDA: bytes before rounding, and in how many allocations


def frame(variant, pass_, device, effects=None):
    """A function that renders the fixed scene, all of whose inputs are there."""
    settings = SMALL.settings(torch.float32, device, variant, effects=effects)
    scene = scenes.cast(scenes.random_scene(11, GAUSSIANS, degree=1), torch.float32, device)
    rasterizer = ar.GaussianRasterizer(settings)
    if pass_ == "inference":
        return torch.no_grad()(lambda: rasterizer(**scene))
    leaves = scenes.leaves(scene)
    weights = torch.ones(3, SMALL.image_height, SMALL.image_width, device=device)

    def forward_backward():
        color, *_ = rasterizer(**leaves)
        return torch.autograd.grad(color, list(leaves.values()), weights)

    return forward_backward if pass_ == "forward_backward" else lambda: rasterizer(**leaves)


def cost_of(call, device, tmp_path):
    """Of the second call: what happens once is no cost of a frame."""
    call()
    events = trace(call, device, tmp_path)
    spans = [e for e in events if e.get("cat") == "cpu_op"]
    ends, outermost = {}, []  # spans of a thread nest
    for event in spans:
        if event["ts"] >= ends.get(event["tid"], -1):
            outermost.append(event["name"])
            ends[event["tid"]] = event["ts"] + event["dur"]
    sizes = [e["args"]["Bytes"] for e in events if e["name"] == "[memory]" and e["args"]["Bytes"] > 0]
    launched = [e["name"] for e in events if e.get("cat") in ("kernel", "gpu_memset", "gpu_memcpy")]
    requested = ()
    if device == "cuda":
        assert any("ar::" in name for name in launched), "torch's profiler saw no kernel: CUPTI is missing, or refused"
        names = ("requested_bytes.all.allocated", "allocation.all.allocated")
        before = torch.cuda.memory_stats()
        results = call()
        after = torch.cuda.memory_stats()
        del results
        requested = tuple(after[name] - before[name] for name in names)
    names = [event["name"] for event in spans]
    return Cost(outermost, names, collections.Counter(sizes), collections.Counter(launched), requested)


def trace(call, device, tmp_path):
    """What torch's profiler saw of a call: events of its trace, by time."""
    activities = [torch.profiler.ProfilerActivity.CPU]
    if device == "cuda":
        activities.append(torch.profiler.ProfilerActivity.CUDA)
        torch.cuda.synchronize()
        torch.cuda.empty_cache()  # a large block that is found there may be handed out whole
    with torch.profiler.profile(activities=activities, profile_memory=True) as profiler:
        call()
        if device == "cuda":
            torch.cuda.synchronize()
    path = tmp_path / "trace.json"
    profiler.export_chrome_trace(str(path))
    events = json.loads(path.read_text())["traceEvents"]
    return sorted((e for e in events if e.get("ph") in ("X", "i")), key=lambda e: (e["ts"], -e.get("dur", 0)))


@pytest.fixture
def room_for_pairs(same_room):
    """On CUDA, enough and always the same. After `same_room`, which makes more."""
    if _C.has_cuda and torch.cuda.is_available():
        _C.force_pair_capacity(FRAME_PAIRS)


@each_path
@each_pass
def test_effects_that_are_off_cost_nothing(device, variant, pass_, tmp_path, room_for_pairs):
    """The same ops, allocations and kernels as without effects; after a frame with effects too."""
    plain = cost_of(frame(variant, pass_, device), device, tmp_path)
    defaults = {f.name: f.default for f in dataclasses.fields(ar.Effects) if f.default is not MISSING}
    assert defaults, "Effects has no fields with defaults"
    for off in (ar.Effects(), ar.Effects(**defaults)):
        assert cost_of(frame(variant, pass_, device, off), device, tmp_path) == plain
    frame(variant, pass_, device, ar.Effects(**ALL_OUTPUTS, near=0.15))()
    assert cost_of(frame(variant, pass_, device), device, tmp_path) == plain


@each_path
@pytest.mark.parametrize("pass_", ["inference", "forward"])
def test_the_plain_path_is_one_op(device, variant, pass_, tmp_path):
    """Python calls nothing of torch beside it."""
    (op,) = cost_of(frame(variant, pass_, device), device, tmp_path).outermost
    assert op.startswith("analytic_rasterizer::")


def test_the_plain_path_makes_no_effects(device, monkeypatch):
    """No profiler shows it, but the host needs 50 us for all of a small picture."""
    call, made = frame(("box", {}), "inference", device), []
    monkeypatch.setattr(ar.Effects, "__post_init__", lambda self: made.append(self))
    call()
    assert not made


# Bytes on the CPU. Per pixel: three colours; for a backward pass, of each sample the transmittance that is left and
# the number of splats that it has seen. Per Gaussian: its splat, and its radius, its id and its number of pairs; from a
# backward pass the gradients with respect to the inputs, which are as large as those.
COLOR, SAMPLE = 3 * 4, 4 + 4
SPLAT, NUMBERS = 48, 3 * 4
GRADIENTS = 4 * (3 + 3 + 1 + 12 + 3 + 4)
SAMPLES = {"box": 4, "moment": 4}


@each_path
@each_pass
def test_memory_of_the_plain_path(variant, pass_, tmp_path):
    """Nothing per pixel or per Gaussian but what a picture without effects needs."""
    allocated = cost_of(frame(variant, pass_, "cpu"), "cpu", tmp_path).allocated
    of_pixels = sum(size * count for size, count in allocated.items() if size % PIXELS == 0)
    of_gaussians = sum(size * count for size, count in allocated.items() if size % GAUSSIANS == 0 and size % PIXELS)
    samples = 0 if pass_ == "inference" else SAMPLES.get(variant[0], 1)
    assert COLOR * PIXELS <= of_pixels <= (COLOR + SAMPLE * samples) * PIXELS
    gradients = GRADIENTS if pass_ == "forward_backward" else 0
    assert gradients * GAUSSIANS < of_gaussians <= (SPLAT + NUMBERS + gradients) * GAUSSIANS


@needs_cuda
def test_a_full_camera_shows_in_the_names_of_kernels(tmp_path):
    """And only where there is one."""
    for effects, there in ((None, False), (ar.Effects(near=0.1), True)):
        launched = cost_of(frame(("box", {}), "inference", "cuda", effects), "cuda", tmp_path).launched
        assert any("FullCamera" in name for name in launched) == there


# --- what an effect changes --------------------------------------------------------------------------

# Off the middle of the picture, so that its two kinds of clamp differ.
CAMERA = Camera(image_height=29, image_width=37, sh_degree=1, bg=(0.2, 0.5, 0.3), shift=(2.3, -1.4))
MOVING = {"velocity": (0.9, -0.6, 1.1), "angular_velocity": (0.3, 0.5, -0.8), "screen_velocity": (6.0, -9.0)}
COUNT = 100
OUTPUTS = ar.effects.OUTPUTS
ALL_OUTPUTS = dict.fromkeys(OUTPUTS, True)


def tensor(value, dtype, device):
    """A number with a gradient."""
    return torch.tensor(value, dtype=dtype, device=device, requires_grad=True)


# Of the dtype and device: fields of Effects that change the camera and not the picture.
CAMERA_EFFECTS = {
    "camera_gradients": lambda *_: {"camera_gradients": True},
    "off_center": lambda *_: {"off_center": True},
    "near_far": lambda *_: {"near": 0.15, "far": 1e6},
    "defocus": lambda *_: {"defocus": ar.Defocus(0.0, 3.1)},
    "motion": lambda *_: {"motion": ar.Motion(0.0, **MOVING)},
    "together": lambda *of: {
        "camera_gradients": True,
        "near": 0.15,
        "far": 1e6,
        "defocus": ar.Defocus(tensor(0.0, *of), tensor(3.1, *of)),
        "motion": ar.Motion(tensor(0.0, *of), **MOVING),
    },
}
OTHER_EFFECTS = {
    "none": lambda *_: {},
    "filter_3d": lambda dtype, device: {"filter_3d": torch.zeros(COUNT, dtype=dtype, device=device)},
    "sh_degree": lambda *_: {"sh_degree": 1},
}
OUTPUT_EFFECTS = {name: lambda *_, name=name: {name: True} for name in OUTPUTS}
OUTPUT_EFFECTS["all_outputs"] = lambda *_: ALL_OUTPUTS
each_camera_effect = pytest.mark.parametrize("name", CAMERA_EFFECTS)


@pytest.fixture(autouse=True)
def same_room():
    """On CUDA room for pairs follows earlier frames, and the order of some sums that."""
    on_cuda = _C.has_cuda and torch.cuda.is_available()
    if on_cuda:
        _C.force_pair_capacity(1 << 14)
    yield
    if on_cuda:
        _C.force_pair_capacity(0)


@functools.cache
def scenes_of(effect):
    """Scenes in which the effect leaves the picture alone: Gaussians of every fate, with both kinds of inputs."""
    if effect == "off_center":
        scene = scenes.random_scene(31, COUNT, degree=1)
        assert not clamped(scene).any()
    else:  # some of them clamped, outside the picture or behind the camera
        scene = scenes.random_scene(31, COUNT, degree=1, sigma=(0.01, 0.9), spread=3.5)
        scene["means3D"][:3] *= 20
    precomputed = scenes.with_precomputed(scene)
    scene["means2D"] = torch.zeros(COUNT, 4, dtype=torch.float64)  # gradients of both widths
    return [scene] if effect in ("filter_3d", "sh_degree") else [scene, precomputed]


def clamped(scene):
    """Which Gaussians have x/z or y/z where one of the two kinds of clamp takes hold."""
    x, y, z = (scene["means3D"] @ CAMERA.world_to_camera()[:3, :3].T + CAMERA.world_to_camera()[:3, 3]).unbind(1)
    sides = ((x / z, CAMERA.tanfovx, CAMERA.shift[0] / CAMERA.image_width),
             (y / z, CAMERA.tanfovy, CAMERA.shift[1] / CAMERA.image_height))  # fmt: skip
    beyond = [ratio.abs() > (1.3 - 2 * abs(shift)) * tangent for ratio, tangent, shift in sides]
    return beyond[0] | beyond[1]


def render(scene, variant, effects, dtype, device, loss=("color",)):
    """Everything that comes of it by name; with gradients by the Gaussians of a loss on the images named, if any."""
    settings = CAMERA.settings(dtype, device, variant, effects=effects)
    if effects is not None and effects.camera_gradients:
        matrices = {name: getattr(settings, name) for name in ("viewmatrix", "projmatrix", "campos")}
        tangents = {name: tensor(getattr(settings, name), dtype, device) for name in ("tanfovx", "tanfovy")}
        settings = settings._replace(**scenes.leaves(matrices), **tangents)
    inputs = scenes.leaves(scenes.cast(scene, dtype, device))
    with torch.set_grad_enabled(bool(loss)):
        color, radii, *rest = ar.GaussianRasterizer(settings)(**inputs)
    results = {"color": color, "radii": radii}
    for name, value in rest[0]._asdict().items() if rest else ():
        fields = value._asdict() if isinstance(value, ar.GaussianStats) else {name: value}
        results |= {field: image for field, image in fields.items() if image is not None}
    if loss:
        g = torch.Generator().manual_seed(3)
        total = sum((results[name] * scenes.rand(g, *results[name].shape, low=-1.0).to(color)).sum() for name in loss)
        grads = torch.autograd.grad(total, list(inputs.values()), allow_unused=True)
        results |= {f"gradient of {name}": grad for name, grad in zip(inputs, grads)}
    return {name: value if value is None else value.detach() for name, value in results.items()}


def bits(tensor):
    """As whole numbers, of which a zero has two."""
    return tensor.contiguous().view({2: torch.int16, 4: torch.int32, 8: torch.int64}[tensor.element_size()])


def rounds_differently(device, *effects):
    """Whether one of them blends depth on CUDA: as further channels, in a kernel whose sums have another order."""
    return device == "cuda" and any(e is not None and (e.depth or e.inverse_depth) for e in effects)


def assert_same_bits(found, expected, rounding=False):
    """Of all that both have; with `rounding` to 1e-5 of the largest number, 80 roundings."""
    for name in found.keys() & expected.keys():
        a, b = found[name], expected[name]
        assert (a is None) == (b is None), name
        if a is not None and rounding and a.is_floating_point():
            assert (a - b).abs().max() <= 1e-5 * b.abs().max(), name
        elif a is not None:
            assert torch.equal(bits(a), bits(b)), (name, (a.double() - b.double()).abs().max().item())


@functools.cache
def plain(scene_index, effect_scenes, variant_index, dtype, device, with_loss):
    scene = scenes_of(effect_scenes)[scene_index]
    return render(scene, PATHS[variant_index], None, dtype, device, ("color",) if with_loss else ())


@each_precision
@each_path
@pytest.mark.parametrize("name", [*OTHER_EFFECTS, *CAMERA_EFFECTS, *OUTPUT_EFFECTS])
def test_an_effect_changes_nothing_else(variant, device, dtype, name):
    """Colours, radii and gradients of a loss on colours, with a backward pass to come and without."""
    effects = ar.Effects(**(OTHER_EFFECTS | CAMERA_EFFECTS | OUTPUT_EFFECTS)[name](dtype, device))
    which = name if name in ("off_center", "filter_3d", "sh_degree") else ""
    for index, scene in enumerate(scenes_of(which)):
        for loss in (("color",), ()):
            expected = plain(index, which, PATHS.index(variant), dtype, device, bool(loss))
            found = render(scene, variant, effects, dtype, device, loss)
            assert_same_bits(found, expected, rounds_differently(device, effects))


@each_precision
@each_path
@each_camera_effect
def test_a_camera_changes_no_output(variant, device, dtype, name):
    """All outputs, and the gradients of a loss on all of them."""
    scene = scenes_of(name if name == "off_center" else "")[0]
    loss = ("color", "alpha", "depth", "inverse_depth")
    expected = render(scene, variant, ar.Effects(**ALL_OUTPUTS), dtype, device, loss)
    effects = ar.Effects(**ALL_OUTPUTS, **CAMERA_EFFECTS[name](dtype, device))
    assert_same_bits(render(scene, variant, effects, dtype, device, loss), expected)


@each_precision
@each_path
def test_outputs_do_not_see_each_other(variant, device, dtype):
    """Each alone, in pairs, and with all others: values, and gradients of a loss on it alone."""
    scene = scenes_of("")[0]
    together = [*itertools.combinations(OUTPUTS, 2), OUTPUTS]
    for output in OUTPUTS:
        loss = (output if output in ("alpha", "depth", "inverse_depth") else "color",)
        own = ar.Effects(**{output: True})
        alone = render(scene, variant, own, dtype, device, loss)
        for names in together:
            if output in names:
                effects = ar.Effects(**dict.fromkeys(names, True))
                found = render(scene, variant, effects, dtype, device, loss)
                assert_same_bits(found, alone, rounds_differently(device, own, effects))


@each_precision
@each_path
def test_a_band_of_zeros_changes_nothing_else(variant, device, dtype):
    """Harmonics of degree 4 that are zero, used or left out."""
    scene = scenes.random_scene(31, COUNT, degree=4)
    scene["shs"][:, 16:] = 0
    results = []
    for degree in (3, 4):
        inputs = scenes.leaves(scenes.cast(scene, dtype, device))
        settings = CAMERA.settings(dtype, device, variant, effects=ar.Effects(sh_degree=degree))
        color, radii = ar.GaussianRasterizer(settings._replace(sh_degree=4))(**inputs)
        color.square().sum().backward()
        grads = {name: leaf.grad for name, leaf in inputs.items()}
        used = grads.pop("shs")
        results.append({"color": color.detach(), "radii": radii, "shs": used[:, :16], **grads})
        assert (used[:, 16:] != 0).any() == (degree == 4)
    assert_same_bits(*results)
