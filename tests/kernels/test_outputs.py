"""No memory reaches a caller as it was allocated: a device writes an output whole, or its op is refused."""

from dataclasses import replace

import pytest
import scenes
import torch
from scenes import PATHS, REFERENCE_FOOTPRINTS, Camera, name_of
from torch.utils._python_dispatch import TorchDispatchMode

import analytic_rasterizer as ar
from analytic_rasterizer import _C
from analytic_rasterizer.losses import l1_ssim, ssim

VARIANTS = [*PATHS, ("box", {"samples": 16}), ("moment", {"samples": 16}), *((f, {}) for f in REFERENCE_FOOTPRINTS)]
IMAGES = ar.Effects(**dict.fromkeys(_C.IMAGES, True))
EVERYTHING = replace(IMAGES, median_depth=True, dominant_index=True, gaussian_stats=True)
HANDED_ON = ("saved", "lists")
"""Results that ops make for each other. On CUDA they have room that nothing is written to."""


class Unwritten(TorchDispatchMode):
    """Results of our ops with a number that was never written, while new memory is NaN or the largest integer."""

    def __init__(self):
        super().__init__()
        self.ops, self.found = set(), []

    def __enter__(self):
        torch.use_deterministic_algorithms(True, warn_only=True)
        assert torch.empty(3).isnan().all()
        return super().__enter__()

    def __exit__(self, *exception):
        torch.use_deterministic_algorithms(False)
        return super().__exit__(*exception)

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        made = func(*args, **(kwargs or {}))
        if func.namespace == "analytic_rasterizer":
            name = func._schema.name.split("::")[1]
            self.ops.add(name)
            results = made if isinstance(made, tuple) else (made,)
            for result, value in zip(func._schema.returns, results, strict=True):
                if result.name in HANDED_ON:
                    continue
                for k, t in enumerate(value if isinstance(value, list) else [value]):
                    wrong = t.isnan() if t.is_floating_point() else t == torch.iinfo(t.dtype).max
                    if wrong.any():
                        self.found.append((name, result.name, k))
        return made


def rasterize(device, variant, count, full):
    """Everything that rasterization returns, and gradients of its outputs one by one and together."""
    effects = replace(EVERYTHING, camera_gradients=True, defocus=ar.Defocus(0.1, 2.0)) if full else EVERYTHING
    settings = Camera().settings(torch.float32, device, variant, effects=effects)
    if full:
        settings = settings._replace(viewmatrix=settings.viewmatrix.clone().requires_grad_())
    scene = scenes.cast(scenes.random_scene(1, count, degree=1), torch.float32, device)
    for looks in ({"median_depth": True}, {"dominant_index": True}, {"gaussian_stats": True}):
        some = settings._replace(effects=replace(effects, **(dict.fromkeys(_C.SUMMARIES, False) | looks)))
        ar.GaussianRasterizer(some)(**scene)
    for columns in (3, 4):
        leaves = scenes.leaves(scene | {"means2D": torch.zeros(count, columns, device=device)})
        color, _, outputs = ar.GaussianRasterizer(settings)(**leaves)
        images = [color, outputs.alpha, outputs.depth]
        for some in ([images[0]], [images[1]], [images[2]], images):
            sum(image.sum() for image in some).backward(retain_graph=True)
    del scene["means2D"]
    ar.render_stages(settings, **scene)


def stages(device, variant, count):
    settings = Camera().settings(torch.float32, device, variant)
    scene = scenes.leaves(scenes.cast(scenes.random_scene(1, count, degree=1), torch.float32, device))
    del scene["means2D"]
    splats = ar.project([settings, settings], **scene)
    n, one = len(splats.means2d), splats.split()[0]
    looks = dict.fromkeys(_C.SUMMARIES, True)
    torch.ops.analytic_rasterizer.inspect(list(ar.list_tiles(one).tensors), one.depths.detach(), **one.size, **looks)
    for channels in (2, 5, 40):
        features = torch.ones(n, channels, device=device, requires_grad=True)
        absolute = torch.zeros(n, 2, device=device, requires_grad=True)
        image, alpha = ar.blend(splats, ar.list_tiles(splats), features, means2d_abs=absolute)
        for some in ([image], [alpha], [image, alpha]):
            sum(t.sum() for t in some).backward(retain_graph=True)


@pytest.mark.parametrize("count", [0, 30])
@pytest.mark.parametrize("variant", VARIANTS, ids=name_of)
def test_rendering_writes_every_output(device, variant, count):
    with Unwritten() as mode:
        rasterize(device, variant, count, full=False)
        rasterize(device, variant, count, full=True)
        stages(device, variant, count)
    assert mode.found == []
    ops = {"rasterize", "rasterize_timed", "rasterize_vjp", "inspect", "project", "project_vjp", "blend", "blend_vjp"}
    assert ops <= mode.ops


@pytest.mark.parametrize("count", [0, 7])
def test_small_ops_write_every_output(device, count):
    with Unwritten() as mode:
        parameters = [torch.rand(count, columns, device=device, requires_grad=True) for columns in (3, 4, 1)]
        for k in range(3):
            torch.ops.analytic_rasterizer.activate(*parameters)[k].sum().backward()
        torch.ops.analytic_rasterizer.activate(*parameters, 0.3, 0.2)[3].backward()
        widths = torch.rand(count, device=device, requires_grad=True)
        sum(t.sum() for t in ar.apply_3d_filter(parameters[0], parameters[2], widths)).backward()
        offsets = torch.ones(count, 2, device=device, requires_grad=True)
        covs = torch.tensor([[2.0, 0.3, 1.0]], device=device).repeat(count, 1).requires_grad_()
        ar.footprint_weight(offsets, covs, "analytic").sum().backward()
        image = torch.rand(3, 20 + count, 70, device=device, requires_grad=True)
        target = torch.rand_like(image)
        (l1_ssim(image, target) + ssim(image, target, "none").sum()).backward()
    assert mode.found == []
    assert len(mode.ops) == 10


@pytest.fixture
def withhold():
    yield _C.withhold_output
    _C.withhold_output("")


@pytest.mark.parametrize("name", _C.IMAGES)
def test_an_image_that_the_device_does_not_write_is_refused(device, name, withhold):
    scene = scenes.cast(scenes.random_scene(1, 20), torch.float32, device)
    expected = Camera().render(scene, effects=IMAGES)[0]
    withhold(name)
    with pytest.raises(NotImplementedError, match=f"^{name} cannot be made on {device} yet"):
        Camera().render(scene, effects=IMAGES)
    assert torch.equal(Camera().render(scene, effects=replace(IMAGES, **{name: False}))[0], expected)


def test_stages_refuse_an_alpha_that_the_device_does_not_write(device, withhold):
    scene = scenes.without(scenes.cast(scenes.random_scene(1, 20), torch.float32, device), "means2D")
    splats = ar.project(Camera().settings(torch.float32, device), **scene)
    lists = ar.list_tiles(splats)
    withhold("alpha")
    with pytest.raises(NotImplementedError, match=f"^alpha cannot be made on {device} yet"):
        ar.blend(splats, lists)


@pytest.mark.parametrize("name", _C.SUMMARY)
def test_statistics_that_the_device_does_not_write_are_refused(device, name, withhold):
    scene = scenes.cast(scenes.random_scene(1, 20), torch.float32, device)
    withhold(name)
    with pytest.raises(NotImplementedError, match=f"^{name} cannot be made on {device} yet"):
        Camera().render(scene, effects=EVERYTHING)
