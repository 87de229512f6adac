"""The operators behind gsplat's call: few, known to torch, and differentiable."""

import pytest
import scenes
import torch
from gsplat_calls import cameras_of, render, scene_of
from torch.utils._python_dispatch import TorchDispatchMode


class OurOps(TorchDispatchMode):
    """Records the calls of our operators, with their arguments, and counts those of torch's."""

    def __init__(self):
        super().__init__()
        self.ours, self.others = [], []

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        if func.namespace == "analytic_rasterizer":
            self.ours.append((func, args, kwargs or {}))
        else:
            self.others.append(func._schema.name)
        return func(*args, **(kwargs or {}))


@pytest.mark.parametrize("packed", [True, False])
@pytest.mark.parametrize("render_mode", ["RGB", "RGB+ED", "D"])
def test_a_call_is_few_operators(device, packed, render_mode):
    """Cameras, rows, images: nothing of a picture is computed between them."""
    scene, cameras = scene_of(torch.float32, device, degree=1), cameras_of(torch.float32, device, count=1)
    with OurOps() as mode:
        render(scene, cameras, sh_degree=1, packed=packed, render_mode=render_mode)
    assert [func._schema.name.split("::")[1] for func, *_ in mode.ours] == ["prepare_cameras", "project", "composite"]
    assert len(mode.others) <= (10 if packed else 7), mode.others  # on the CPU a look at Ks; ids of meta


@pytest.mark.parametrize("packed", [True, False])
def test_opcheck_of_rows(device, packed):
    """Of a table, and with given values, which the stages do not ask for."""
    scene, cameras = scenes.leaves(scene_of(torch.float32, device)), cameras_of(torch.float32, device)
    with OurOps() as mode:
        images, _, meta = render(scene, cameras, packed=packed, render_mode="RGB-Ed", rasterize_mode="antialiased")
        (images.sum() + meta["depths"].sum()).backward()
    checks = ["test_schema", "test_faketensor"]
    found = {func._schema.name.split("::")[1]: (func, args, kwargs) for func, args, kwargs in mode.ours}
    assert {"project", "project_vjp", "composite", "composite_vjp"} <= found.keys()
    for func, args, kwargs in found.values():
        torch.library.opcheck(func, args, kwargs, test_utils=checks)


@pytest.mark.parametrize("packed", [True, False])
@pytest.mark.parametrize("kinds", [("z", "distance"), ("distance", "z"), ("model", "none")])
def test_gradcheck_of_rows(packed, kinds):
    """All that a row has, of several cameras, by differences: both kinds of depth, colours and given values."""
    scene, cameras = scene_of(torch.float64, "cpu", degree=1, count=5), cameras_of(torch.float64, "cpu")
    with OurOps() as mode:
        render(scene, cameras, sh_degree=1)
    (_, args, kwargs), = [call for call in mode.ours if call[0]._schema.name.endswith("::project")]  # fmt: skip
    op = torch.ops.analytic_rasterizer.project
    names = [argument.name for argument in op.default._schema.arguments]
    named = dict(zip(names, args)) | kwargs
    named |= {"order": kinds[0], "shown": kinds[1], "table": [] if packed else [2, 5]}
    named["values"] = torch.rand(2, 5, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    moved = ("means3D", "opacities", "shs", "scales", "rotations", "viewmatrix", "campos", "values")
    leaves = [named[name].detach().clone().requires_grad_() for name in moved]

    def rows(*tensors):
        return op(**named | dict(zip(moved, tensors)))[:5]

    torch.autograd.gradcheck(rows, leaves, atol=1e-6, rtol=1e-4)
