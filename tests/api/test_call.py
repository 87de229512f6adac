"""`_C.Call`, the quick way from Python to an op: the same results, gradients and errors as by torch.ops."""

import re
from typing import ClassVar

import pytest
import scenes
import torch
from marks import needs_newer_compiler
from torch._subclasses import FakeTensorMode

import analytic_rasterizer as ar
from analytic_rasterizer import _C
from analytic_rasterizer.render.arguments import camera_arguments, gaussian_arguments

CAMERA = scenes.Camera()


def scene_on(device, count=20):
    return scenes.cast(scenes.random_scene(1, count, degree=1), torch.float32, device)


def arguments_of_op(device):
    settings, scene = CAMERA.settings(torch.float32, device), scene_on(device)
    optional = {**scenes.leaves(scene), "colors_precomp": None, "cov3D_precomp": None}
    gaussians = gaussian_arguments(settings, optional.pop("means3D"), optional.pop("opacities"), **optional)
    return {**gaussians, **camera_arguments(settings, gaussians["means3D"], gaussians["shs"]), "bg": settings.bg}


def results_and_gradients(op, arguments):
    color, images, radii, summary, saved = op(**arguments)
    gradients = [t for t in arguments.values() if torch.is_tensor(t) and t.requires_grad]
    return [color, *images, radii, *summary, *torch.autograd.grad(color.square().sum(), gradients)], len(saved)


def test_it_is_the_op(device):
    arguments = arguments_of_op(device)
    arguments |= {"alpha": True, "depth": True, "median_depth": True, "gaussian_stats": True}
    made, saved = results_and_gradients(_C.Call("rasterize"), arguments)
    expected, expected_saved = results_and_gradients(torch.ops.analytic_rasterizer.rasterize, arguments)
    assert len(made) == len(expected)
    assert all(torch.equal(a, b) for a, b in zip(made, expected))
    assert saved == expected_saved > 0
    with torch.no_grad():
        color, images, _, summary, saved = _C.Call("rasterize")(**arguments)
    assert torch.equal(color, expected[0])
    assert (len(images), len(summary)) == (2, 6)
    assert saved == []
    assert not color.requires_grad


def test_arguments_by_place(device):
    generator = torch.Generator().manual_seed(0)
    given = [torch.rand(4, n, generator=generator).to(device) for n in (3, 4, 1)]
    made = _C.Call("activate")(given[0], given[1], logit_opacities=given[2])
    assert all(torch.equal(a, b) for a, b in zip(made, torch.ops.analytic_rasterizer.activate(*given)))


CHANGES = {
    "missing": ({"bg": ...}, TypeError, "analytic_rasterizer::rasterize needs the argument bg"),
    "unknown": ({"background": 1}, TypeError, "rasterize got background, which it does not have"),
    "no tensor": ({"shs": [1.0]}, TypeError, "shs must be a tensor, got list"),
    "none": ({"opacities": None}, TypeError, "opacities must be a tensor, got NoneType"),
    "no int": ({"image_height": "16"}, TypeError, "image_height must be an int, got str"),
    "too large an int": ({"image_height": 2**70}, ValueError, f"image_height must fit in 64 bits, got {2**70}"),
    "too large a float": ({"tanfovx": 10**400}, ValueError, f"tanfovx must fit in 64 bits, got {10**400}"),
    "no float": ({"tanfovx": None}, TypeError, "tanfovx must be a float, got NoneType"),
    "no string": ({"footprint": 3}, TypeError, "footprint must be a string, got int"),
    "of the op, ValueError": ({"image_height": -1}, ValueError, "image_height must be in"),
    "of the op, TypeError": ({"bg": torch.zeros(3, dtype=torch.int32)}, TypeError, "bg must have the dtype"),
}


@pytest.mark.parametrize("case", CHANGES)
def test_errors(case):
    change, error, message = CHANGES[case]
    arguments = {name: value for name, value in {**arguments_of_op("cpu"), **change}.items() if value is not ...}
    with pytest.raises(error, match=re.escape(message)):
        _C.Call("rasterize")(**arguments)


def test_wrong_calls():
    with pytest.raises(RuntimeError, match="analytic_rasterizer::nothing"):
        _C.Call("nothing")
    three = [torch.zeros(4, n) for n in (3, 4, 1)]
    with pytest.raises(TypeError, match="activate got log_scales, which it does not have, or has by its place"):
        _C.Call("activate")(*three, log_scales=three[0])
    with pytest.raises(TypeError, match="apply_3d_filter takes 3 arguments, got 4"):
        _C.Call("apply_3d_filter")(*three, three[0])
    with pytest.raises(TypeError, match="is of a type that Call does not take"):  # lists
        _C.Call("rasterize_vjp")([None])


def test_fake_tensors():
    """What looks into the dispatcher sees the op: here modes that trace shapes."""
    with FakeTensorMode(allow_non_fake_inputs=True) as mode:
        arguments = arguments_of_op("cpu")
        fake = {name: mode.from_tensor(v.detach()) if torch.is_tensor(v) else v for name, v in arguments.items()}
        color, _, radii, _, _ = _C.Call("rasterize")(**fake)
    assert type(color).__name__ == "FakeTensor"
    assert color.shape == (3, CAMERA.image_height, CAMERA.image_width)
    assert radii.shape == (20,)


class Logged(torch.Tensor):
    """A tensor that sees the functions of torch that it goes through."""

    seen: ClassVar[list] = []

    @classmethod
    def __torch_function__(cls, function, types, args=(), kwargs=None):
        cls.seen.append(function)
        return super().__torch_function__(function, types, args, kwargs)


def test_what_overrides_functions_of_torch_sees_the_op(device):
    scene = scene_on(device) | {"means2D": None}
    rasterizer = ar.GaussianRasterizer(CAMERA.settings(torch.float32, device))
    expected, _ = rasterizer(**scene)
    made, _ = rasterizer(**scene | {"means3D": scene["means3D"].as_subclass(Logged)})
    assert isinstance(made, Logged)
    assert torch.equal(made.as_subclass(torch.Tensor), expected)
    assert any("rasterize" in str(function) for function in Logged.seen)


@needs_newer_compiler
def test_torch_compile(device):
    """It traces through the rasterizer without a break, by torch.ops."""
    scene, rasterizer = scene_on(device), ar.GaussianRasterizer(CAMERA.settings(torch.float32, device))

    def picture(gaussians):
        return 2 * rasterizer(**gaussians)[0]

    leaves = scenes.leaves(scene)
    made = torch.compile(picture, backend="eager", fullgraph=True)(leaves)
    assert torch.equal(made, picture(scene))
    made.sum().backward()
    assert leaves["means3D"].grad.abs().max() > 0


class Pictures(torch.nn.Module):
    """A rasterizer as torch.export takes it."""

    def __init__(self, settings):
        super().__init__()
        self.rasterizer = ar.GaussianRasterizer(settings)

    def forward(self, means3D, opacities, shs, scales, rotations):
        color, radii, *outputs = self.rasterizer(means3D, None, opacities, shs, None, scales, rotations)
        stats = outputs[0].gaussian_stats if outputs else None
        return color, radii, *(stats or ())


@pytest.mark.parametrize(
    "effects",
    [None, ar.Effects(alpha=True, depth=True), ar.Effects(median_depth=True, gaussian_stats=True)],
    ids=["plain", "images", "summaries"],
)
@needs_newer_compiler
def test_torch_export_for_any_number_of_gaussians(device, effects):
    names = "means3D", "opacities", "shs", "scales", "rotations"
    module = Pictures(CAMERA.settings(torch.float32, device, effects=effects))
    few, many = (tuple(map(scene_on(device, count).get, names)) for count in (20, 33))
    count = torch.export.Dim("count", min=2, max=1000)
    exported = torch.export.export(module, few, dynamic_shapes=({0: count},) * len(names)).module()
    for scene in (few, many):
        assert all(map(torch.equal, exported(*scene), module(*scene)))
