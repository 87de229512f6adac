"""Gradients of single dialects: means2D, the harmonics of accel with its optimiser, and MonoGS's pose."""

import dataclasses

import pytest
import scenes
import torch
from marks import each_precision
from originals import CAMERA, COUNT, arguments_of, plain, probe, render, scene_of

import analytic_rasterizer as ar
import diff_gaussian_rasterization as drop_in
from analytic_rasterizer import dialects

pytestmark = pytest.mark.usefixtures("nothing_chosen")


# --- means2D ------------------------------------------------------------------------------------


def gradient_of_means2d(name, device, dtype, columns=3, key="means2D", **further):
    points = torch.zeros(COUNT, columns, dtype=dtype, device=device, requires_grad=True)
    scene = {**arguments_of(name, device, dtype), key: points, **further}
    color = render(name, device, dtype, scene=scene)[0]
    (color * probe(color)).sum().backward()
    return points.grad


@each_precision
def test_third_column_of_mip_is_the_sum_of_absolute_values(device, dtype):
    """|gx| + |gy| over pixels: the sum of the two columns that a (P, 4) means2D has."""
    three = gradient_of_means2d("mip", device, dtype)
    four = gradient_of_means2d("mip", device, dtype, columns=4)
    # The same numbers, added up in another order: a few roundings per pixel of the picture.
    tolerance = 1e-12 if dtype == torch.float64 else 1e-4
    assert torch.allclose(three[:, 2], four[:, 2:].sum(1), rtol=tolerance, atol=0)
    assert (three[:, 2] > 0).any() and torch.equal(three[:, :2], four[:, :2])


def test_third_column_of_analytic_is_the_sum_of_norms():
    """Per pixel, by definition: the gradient of a loss of that pixel alone, its length, and the sum over pixels."""
    camera = dataclasses.replace(CAMERA, image_width=9, image_height=7)
    scene = scenes.random_scene(5, 4, 1)
    settings = dialects.dialect_module("analytic").GaussianRasterizationSettings(**camera.fields())
    points = torch.zeros(4, 3, dtype=torch.float64, requires_grad=True)
    color = drop_in.GaussianRasterizer(settings)(**scene | {"means2D": points})[0]
    dL_dcolor = probe(color)
    expected = torch.zeros(4, dtype=torch.float64)
    for y in range(7):
        for x in range(9):
            of_pixel = torch.zeros_like(dL_dcolor)
            of_pixel[:, y, x] = dL_dcolor[:, y, x]
            (grad,) = torch.autograd.grad(color, points, of_pixel, retain_graph=True)
            expected += grad[:, :2].norm(dim=1)
    (grad,) = torch.autograd.grad(color, points, dL_dcolor)
    assert torch.allclose(grad[:, 2], expected, rtol=1e-10, atol=0) and (expected > 0).sum() == 3


@pytest.mark.parametrize("name", ["gs2023", "gs2024", "depth_alpha", "luiten", "monogs", "scaffold", "mcmc"])
def test_third_column_of_the_others_is_zero(device, name):
    grad = gradient_of_means2d(name, device, torch.float32)
    assert (grad[:, 2] == 0).all() and (grad[:, :2] != 0).any()


def test_densify_receives_what_means2d_receives(device):
    means2D = torch.zeros(COUNT, 3, device=device, requires_grad=True)
    grad = gradient_of_means2d("depth", device, torch.float32, key="means2D_densify", means2D=means2D)
    assert torch.equal(grad, means2D.grad) and (grad[:, :2] != 0).any()
    alone = gradient_of_means2d("depth", device, torch.float32, key="means2D_densify", means2D=None)
    assert torch.equal(grad, alone)


# --- dialect by dialect -------------------------------------------------------------------------


def test_accel_has_the_gradient_of_dc(device):
    """The same rows of harmonics, in one tensor or in two."""
    scene = scenes.leaves(arguments_of("accel", device))
    whole = scenes.leaves(scene_of(device))
    for made in (render("accel", device, scene=scene)[0], plain(device, scene=whole)[0]):
        (made * probe(made)).sum().backward()
    assert torch.equal(torch.cat([scene["dc"].grad, scene["shs"].grad], 1), whole["shs"].grad)
    only = scene_of(device) | {"shs": None, "dc": scene["dc"].detach()}
    flat = dataclasses.replace(CAMERA, sh_degree=0)
    expected = plain(device, scene=scene_of(device) | {"shs": only["dc"]}, camera=flat)
    assert torch.equal(render("accel", device, scene=only, sh_degree=0)[0], expected[0])


def test_sparse_adam_against_its_definition(device):
    drop_in.set_dialect("accel")
    generator = torch.Generator().manual_seed(0)
    draw = lambda *shape: torch.randn(*shape, generator=generator, dtype=torch.float64)  # noqa: E731
    parameters = [torch.nn.Parameter(draw(6, 2, 3).to(device)), torch.nn.Parameter(draw(6).to(device))]
    groups = [{"params": [parameters[0]], "lr": 0.1, "name": "a"}, {"params": [parameters[1]], "name": "b"}]
    assert drop_in.SparseGaussianAdam is ar.optim.SparseGaussianAdam
    optimizer = drop_in.SparseGaussianAdam(groups, lr=0.02, eps=1e-15)
    zeros = lambda p: torch.zeros(p.shape).double()  # noqa: E731
    states = [[p.detach().cpu().clone(), zeros(p), zeros(p)] for p in parameters]
    for visible in ([1, 0, 1, 0, 1, 1], [0, 0, 1, 1, 0, 1], [0, 0, 0, 0, 0, 0]):
        for p, lr, (value, m, v) in zip(parameters, (0.1, 0.02), states):
            p.grad = draw(*p.shape).to(device)
            for row in range(6):
                if visible[row]:
                    g = p.grad[row].cpu()
                    m[row], v[row] = 0.9 * m[row] + 0.1 * g, 0.999 * v[row] + 0.001 * g * g
                    value[row] -= lr * m[row] / (v[row].sqrt() + 1e-15)
        optimizer.step(torch.tensor(visible, dtype=torch.bool, device=device), 6)
        for p, (value, m, v) in zip(parameters, states):
            assert torch.allclose(p.detach().cpu(), value, rtol=1e-12)
            assert torch.allclose(optimizer.state[p]["exp_avg"].cpu(), m, rtol=1e-12)
            assert torch.allclose(optimizer.state[p]["exp_avg_sq"].cpu(), v, rtol=1e-12)
    with pytest.raises(ValueError, match=r"visibility must have shape \(6,\), got \(5,\)"):
        optimizer.step(torch.ones(5, dtype=torch.bool, device=device), 6)
    with pytest.raises(TypeError, match="visibility must be a tensor, got list"):
        optimizer.step([True] * 6, 6)
    with pytest.raises(ValueError, match=rf"rows must be on the device of the parameters, {device}.*, got meta"):
        optimizer.step(torch.ones(6, dtype=torch.bool, device="meta"), 6)


@pytest.mark.parametrize("shape", [(3,), (1, 3)])
def test_gradient_of_the_pose_is_that_of_a_small_motion(shape):
    """MonoGS's theta and rho against `ar.moved`, in float64: the same derivative, by another way."""
    scene = scene_of(dtype=torch.float64)
    theta, rho = (torch.zeros(shape, dtype=torch.float64, requires_grad=True) for _ in range(2))
    color, _, depth, *_ = render("monogs", dtype=torch.float64, scene=scene | {"theta": theta, "rho": rho})
    loss = (color * probe(color)).sum() + (depth * probe(depth)).sum()
    loss.backward()

    tangent = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    view = ar.moved(CAMERA.world_to_camera(), tangent)
    settings = CAMERA.settings(footprint="point", effects=ar.Effects(depth=True))._replace(
        viewmatrix=view.T, projmatrix=(CAMERA.perspective() @ view).T, campos=-view[:3, :3].T @ view[:3, 3]
    )
    color, _, outputs = ar.GaussianRasterizer(settings)(**scene)
    ((color * probe(color)).sum() + (outputs.depth * probe(outputs.depth)).sum()).backward()
    assert theta.grad.shape == rho.grad.shape == shape
    expected = torch.cat([tangent.grad[3:], tangent.grad[:3]])
    assert torch.allclose(torch.cat([theta.grad.flatten(), rho.grad.flatten()]), expected, rtol=1e-9)


def test_pose_of_monogs_in_single_precision(device):
    theta, rho = (torch.zeros(1, 3, device=device, requires_grad=True) for _ in range(2))
    made = render("monogs", device, scene=scene_of(device) | {"theta": theta, "rho": rho})
    made[0].square().sum().backward()
    assert theta.grad.shape == (1, 3) and (theta.grad != 0).all() and (rho.grad != 0).all()
    with pytest.raises(ValueError, match=r"rho must hold 3 numbers, got shape \(2,\)"):
        render("monogs", device, scene=scene_of(device) | {"theta": theta, "rho": torch.zeros(2, device=device)})


@pytest.mark.parametrize("missing", [None, torch.empty(0)], ids=["none", "empty"])
def test_densify_without_means2d(missing):
    """What is missing may be None or an empty tensor, here as elsewhere."""
    probe_at = torch.zeros(COUNT, 3, requires_grad=True)
    render("depth", scene=scene_of() | {"means2D": missing, "means2D_densify": probe_at})[0].sum().backward()
    expected = torch.zeros(COUNT, 3, requires_grad=True)
    render("depth", scene=scene_of() | {"means2D": expected, "means2D_densify": missing})[0].sum().backward()
    assert probe_at.grad.abs().max() > 0 and torch.equal(probe_at.grad, expected.grad)
