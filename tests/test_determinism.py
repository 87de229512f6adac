"""The same bits every time, for any number of threads, and for images and scenes of odd shape."""

import pytest
import scenes
import torch
from conftest import each_precision
from scenes import KINDS, Camera, name_of

import analytic_rasterizer as ar

each_kind = pytest.mark.parametrize("variant", KINDS, ids=name_of)
each_dtype = pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)

# Large enough that several threads get tiles, several tiles share splats, and partial sums matter.
CAMERA = Camera(image_width=203, image_height=151, bg=(0.1, 0.5, 0.3), sh_degree=2)


def everything(camera, scene, variant, dtype, device="cpu"):
    """Image, radii, all gradients, and the stages, computed on `device`."""
    footprint, options = variant
    settings = camera.settings(dtype, device, footprint=footprint, **options)
    leaves = scenes.leaves(scenes.cast(scene, dtype, device))
    color, radii = ar.GaussianRasterizer(settings)(**leaves)
    g = torch.Generator().manual_seed(1)
    loss = scenes.rand(g, *color.shape, low=-1.0).to(color)
    (color * loss).sum().backward()
    inputs = {name: value.detach() for name, value in leaves.items() if name != "means2D"}
    stages = ar.render_stages(settings, **inputs)
    results = [color.detach(), radii, *(leaf.grad for leaf in leaves.values()), *stages[:-1]]
    assert all(result.device.type == device for result in results)
    return [result.cpu() for result in results]


def assert_identical(first, second):
    for a, b in zip(first, second, strict=True):
        assert torch.equal(a, b)


@each_kind
@each_dtype
def test_thread_count_changes_no_bit(variant, dtype):
    scene = scenes.random_scene(1, 400, degree=2, sigma=(0.01, 0.4))
    scene["means2D"] = torch.zeros(400, 4, dtype=torch.float64)
    results = []
    for threads in (1, 2, 7):
        torch.set_num_threads(threads)
        results.append(everything(CAMERA, scene, variant, dtype))
    assert_identical(results[0], results[1])
    assert_identical(results[0], results[2])


@each_kind
def test_repeated_runs_are_identical(device, variant):
    torch.set_num_threads(7)
    scene = scenes.random_scene(2, 300, degree=2, sigma=(0.01, 0.4))
    first = everything(CAMERA, scene, variant, torch.float32, device)
    for _ in range(3):
        assert_identical(first, everything(CAMERA, scene, variant, torch.float32, device))


@each_kind
def test_weight_function_is_deterministic(device, variant):
    """20000 weights, more than one thread's worth; each alone gives the same as in the batch."""
    footprint, options = variant
    g = torch.Generator().manual_seed(3)
    cov2d = scenes.random_cov2d(g, 20000, (0.1, 5.0)).float()
    offset = scenes.random_offsets(g, cov2d.double()).float()
    results = []
    for threads in (1, 2, 7):
        torch.set_num_threads(threads)
        d, c = (tensor.to(device, copy=True).requires_grad_() for tensor in (offset, cov2d))
        value = ar.footprint_weight(d, c, footprint=footprint, **options)
        results.append((value.detach(), *torch.autograd.grad(value.sum(), (d, c))))
    assert_identical(results[0], results[1])
    assert_identical(results[0], results[2])


@each_kind
def test_other_gaussians_do_not_change_a_gradient_by_a_bit(device, variant):
    """Far-away Gaussians change the partition of the work, not the sums of the others."""
    near = scenes.random_scene(4, 50, degree=2)
    far = scenes.random_scene(5, 500, degree=2)
    far["means3D"] = far["means3D"] + torch.tensor([0.0, 0.0, -50.0])  # behind the camera
    both = {name: torch.cat([near[name], far[name]]) for name in near}
    alone = everything(CAMERA, near, variant, torch.float32, device)
    together = everything(CAMERA, both, variant, torch.float32, device)
    assert torch.equal(alone[0], together[0])
    for a, b in zip(alone[1:8], together[1:8], strict=True):
        assert torch.equal(a, b[:50])
        assert (b[50:] == 0).all()


# --- odd shapes --------------------------------------------------------------------------------


@each_kind
@each_precision
def test_no_gaussians(variant, device, dtype):
    """P = 0 renders the background; the backward pass runs and gives empty gradients."""
    scene = scenes.random_scene(6, 0, degree=2)
    color, radii, *rest = everything(CAMERA, scene, variant, dtype, device)
    background = torch.tensor(CAMERA.bg, dtype=dtype)[:, None, None]
    assert torch.equal(color, background.expand_as(color))
    assert radii.shape == (0,)
    assert all(gradient.shape[0] == 0 for gradient in rest[: len(scene)])


@each_kind
@pytest.mark.parametrize("size", [(1, 1), (4000, 1), (1, 4000), (31, 17)], ids=str)
def test_odd_image_shapes(device, variant, size):
    """Few rows and many tiles, or the reverse. (Their values: test_render_reference.py.)"""
    camera = Camera(image_width=size[0], image_height=size[1], sh_degree=2)
    scene = scenes.random_scene(7, 60, degree=2, sigma=(0.05, 0.8), spread=1.0)
    results = []
    for threads in (1, 2, 7):
        torch.set_num_threads(threads)
        results.append(everything(camera, scene, variant, torch.float32, device))
    assert results[0][0].shape == (3, size[1], size[0])
    assert (results[0][0] > 0).any()
    assert_identical(results[0], results[1])
    assert_identical(results[0], results[2])


@each_kind
def test_all_culled(device, variant):
    """Behind the camera, or with no opacity: background, radii where due, zero gradients."""
    scene = scenes.random_scene(8, 20, degree=2)
    behind = dict(scene, means3D=scene["means3D"] + torch.tensor([0.0, 0.0, -50.0]))
    invisible = dict(scene, opacities=torch.zeros_like(scene["opacities"]))
    background = torch.tensor(CAMERA.bg, dtype=torch.float32)[:, None, None]
    for case in (behind, invisible):
        color, radii, *grads = everything(CAMERA, case, variant, torch.float32, device)
        assert torch.equal(color, background.expand_as(color))
        for gradient in grads[: len(scene)]:
            assert (gradient == 0).all()
        if case is behind:
            assert (radii == 0).all()


@each_kind
def test_empty_tiles(device, variant):
    """One small splat in a large image: every other tile is plain background."""
    camera = Camera(image_width=200, image_height=120, bg=(0.2, 0.4, 0.8)).facing_z()
    scene = scenes.splat_scene(
        camera,
        torch.tensor([[100.0, 60.0]]).double(),
        torch.tensor([[2.0, 0.3, 1.0]]).double(),
        torch.tensor([0.9]).double(),
        torch.tensor([2.0]).double(),
    )
    color, *_ = everything(camera, scene, variant, torch.float32, device)
    background = torch.tensor(camera.bg)[:, None, None]
    changed = (color != background).any(0)
    assert changed[60, 100]
    rows, columns = torch.nonzero(changed, as_tuple=True)
    assert (rows - 60).abs().max() < 12
    assert (columns - 100).abs().max() < 12
