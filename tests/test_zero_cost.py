"""What an effect costs where it is off, nothing, and what it changes besides itself, nothing.

The plain path calls, launches and allocates what it did before the full camera was compiled in (record_plain_path.py
says how that is known). An effect that is switched on, and adds an output or by its numbers leaves the picture as it
is, leaves every bit of all else as it is.
"""

import functools
import itertools
import json
import pathlib
import re

import pytest
import record_plain_path as record
import scenes
import torch
from conftest import each_precision, needs_cuda
from scenes import KINDS, Camera, name_of

import analytic_rasterizer as ar
from analytic_rasterizer import _C

each_kind = pytest.mark.parametrize("variant", KINDS, ids=name_of)
RECORD = json.loads((pathlib.Path(__file__).parent / "data" / "plain_path.json").read_text())

# --- what the plain path calls, launches and allocates -----------------------------------------------

each_pass = pytest.mark.parametrize(
    "footprint, pass_", list(itertools.product(record.FOOTPRINTS, record.PASSES)), ids=lambda value: value
)
measured = functools.cache(record.measure)


def recorded(footprint, pass_, device, of_torch=False):
    """What was recorded; `of_torch`: of this version of it."""
    if device not in RECORD:
        pytest.skip(f"tests/data/plain_path.json has no record of {device}: tests/record_plain_path.py makes one there")
    version = RECORD[device]["torch"]
    if of_torch and version != torch.__version__:
        pytest.skip(f"recorded with torch {version}, whose own ops and allocations may be others")
    return RECORD[device]["passes"][footprint][pass_]


@each_pass
def test_plain_path_makes_the_same_tensors(device, footprint, pass_):
    """Ours that take memory, in order, with their bytes."""

    def tensors(found):
        return [call for call in " ".join(found["calls"]).split() if re.search(r":\d+$", call)]

    expected = tensors(recorded(footprint, pass_, device))
    assert expected and tensors(measured(footprint, pass_, device)) == expected


@each_pass
def test_plain_path_allocates_the_same(device, footprint, pass_):
    """Inside of torch too."""
    expected = recorded(footprint, pass_, device, of_torch=True)["allocated"]
    assert measured(footprint, pass_, device)["allocated"] == expected


@each_pass
def test_plain_path_makes_the_same_calls(device, footprint, pass_):
    """Of ours to torch."""
    expected = recorded(footprint, pass_, device)["calls"]
    assert measured(footprint, pass_, device)["calls"] == expected


@each_pass
def test_plain_path_runs_the_same_ops(device, footprint, pass_):
    """Inside of torch too."""
    expected = recorded(footprint, pass_, device, of_torch=True)["everything"]
    assert measured(footprint, pass_, device)["everything"] == expected


def test_plain_path_makes_no_effects(device, monkeypatch):
    """No profiler shows it, but the host needs 50 us for all of a small picture."""
    call, made = record.prepare("box", "inference", device), []
    monkeypatch.setattr(ar.Effects, "__post_init__", lambda self: made.append(self))
    call()
    assert not made


@needs_cuda
@each_pass
def test_plain_path_launches_the_same_kernels(footprint, pass_):
    """And asks the device for as many bytes."""
    found = measured(footprint, pass_, "cuda")
    assert not any("FullCamera" in name for name in found["kernels"])
    expected = recorded(footprint, pass_, "cuda")
    assert found["kernels"] == expected["kernels"]
    for count in ("memsets", "memcpys", "others", "bytes", "allocations"):
        assert found[count] == expected[count], count


@needs_cuda
def test_a_full_camera_shows_in_the_names_of_kernels():
    settings = CAMERA.settings(torch.float32, "cuda", effects=ar.Effects(near=0.1))
    scene = scenes.cast(scenes.random_scene(1, degree=1), torch.float32, "cuda")
    events = record.profile(lambda: ar.GaussianRasterizer(settings)(**scene), "cuda")
    assert any("project_kernel" in event["name"] and "FullCamera" in event["name"] for event in events)


def test_kernels_are_compared_by_the_names_of_before():
    before = "void ar::cuda::project_kernel<ar::Analytic<(ar::FrameGradient)0> >(ar::cuda::ProjectTask)"
    plain = (
        "void ar::cuda::project_kernel<ar::Analytic<(ar::FrameGradient)0>, ar::Camera<float> >(ar::cuda::ProjectTask)"
    )
    assert record.kernel_name(plain) == record.kernel_name(before)
    full = plain.replace("Camera", "FullCamera")
    assert record.kernel_name(full) != record.kernel_name(before) and "FullCamera" in record.kernel_name(full)


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
OUTPUT_EFFECTS = {name: lambda *_, name=name: {name: True} for name in OUTPUTS} | {
    "all_outputs": lambda *_: ALL_OUTPUTS,
}
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
    footprint, options = variant
    settings = CAMERA.settings(dtype, device, footprint=footprint, effects=effects, **options)
    if effects is not None and effects.camera_gradients:
        leaves = {
            name: getattr(settings, name).clone().requires_grad_() for name in ("viewmatrix", "projmatrix", "campos")
        }
        tangents = {name: tensor(getattr(settings, name), dtype, device) for name in ("tanfovx", "tanfovy")}
        settings = settings._replace(**leaves, **tangents)
    inputs = scenes.leaves(scenes.cast(scene, dtype, device))
    with torch.set_grad_enabled(bool(loss)):
        color, radii, *rest = ar.GaussianRasterizer(settings)(**inputs)
    results = {"color": color, "radii": radii}
    for name, value in rest[0]._asdict().items() if rest else ():
        fields = value._asdict() if isinstance(value, ar.effects.GaussianStats) else {name: value}
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


def assert_same_bits(found, expected):
    """Of all that both have."""
    for name in found.keys() & expected.keys():
        a, b = found[name], expected[name]
        assert (a is None) == (b is None), name
        if a is not None:
            assert torch.equal(bits(a), bits(b)), (name, (a.double() - b.double()).abs().max().item())


@functools.cache
def plain(scene_index, effect_scenes, variant_index, dtype, device, with_loss):
    scene = scenes_of(effect_scenes)[scene_index]
    return render(scene, KINDS[variant_index], None, dtype, device, ("color",) if with_loss else ())


@each_precision
@each_kind
@pytest.mark.parametrize("name", [*OTHER_EFFECTS, *CAMERA_EFFECTS, *OUTPUT_EFFECTS])
def test_an_effect_changes_nothing_else(variant, device, dtype, name):
    """Colours, radii and gradients of a loss on colours, with a backward pass to come and without."""
    effects = ar.Effects(**(OTHER_EFFECTS | CAMERA_EFFECTS | OUTPUT_EFFECTS)[name](dtype, device))
    which = name if name in ("off_center", "filter_3d", "sh_degree") else ""
    for index, scene in enumerate(scenes_of(which)):
        for loss in (("color",), ()):
            if device == "cuda" and not loss and effects.has_outputs:
                continue  # outputs keep what a backward pass takes, whose sum over samples has another order
            expected = plain(index, which, KINDS.index(variant), dtype, device, bool(loss))
            assert_same_bits(render(scene, variant, effects, dtype, device, loss), expected)


@each_precision
@each_kind
@each_camera_effect
def test_a_camera_changes_no_output(variant, device, dtype, name):
    """All outputs, and the gradients of a loss on all of them."""
    scene = scenes_of(name if name == "off_center" else "")[0]
    loss = ("color", "alpha", "depth", "inverse_depth")
    expected = render(scene, variant, ar.Effects(**ALL_OUTPUTS), dtype, device, loss)
    effects = ar.Effects(**ALL_OUTPUTS, **CAMERA_EFFECTS[name](dtype, device))
    assert_same_bits(render(scene, variant, effects, dtype, device, loss), expected)


@each_precision
@each_kind
def test_outputs_do_not_see_each_other(variant, device, dtype):
    """Each alone, in pairs, and with all others: values, and gradients of a loss on it alone."""
    scene = scenes_of("")[0]
    together = [*itertools.combinations(OUTPUTS, 2), OUTPUTS]
    for output in OUTPUTS:
        loss = (output if output in ("alpha", "depth", "inverse_depth") else "color",)
        alone = render(scene, variant, ar.Effects(**{output: True}), dtype, device, loss)
        for names in together:
            if output in names:
                effects = ar.Effects(**dict.fromkeys(names, True))
                assert_same_bits(render(scene, variant, effects, dtype, device, loss), alone)


@each_precision
@each_kind
def test_a_band_of_zeros_changes_nothing_else(variant, device, dtype):
    """Harmonics of degree 4 that are zero, used or left out."""
    scene = scenes.random_scene(31, COUNT, degree=4)
    scene["shs"][:, 16:] = 0
    footprint, options = variant
    results = []
    for degree in (3, 4):
        inputs = scenes.leaves(scenes.cast(scene, dtype, device))
        settings = CAMERA.settings(dtype, device, footprint=footprint, effects=ar.Effects(sh_degree=degree), **options)
        color, radii = ar.GaussianRasterizer(settings._replace(sh_degree=4))(**inputs)
        color.square().sum().backward()
        grads = {name: leaf.grad for name, leaf in inputs.items()}
        used = grads.pop("shs")
        results.append({"color": color.detach(), "radii": radii, "shs": used[:, :16], **grads})
        assert (used[:, 16:] != 0).any() == (degree == 4)
    assert_same_bits(*results)
