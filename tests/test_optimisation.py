"""Optimisation from hard starts: 500 steps of Adam on one target at three scales, float32 against float64.

The starts are those where a renderer's gradients go wrong: isotropic Gaussians, whose eigenvectors are undefined;
needles, whose covariance is singular in float32; and Gaussians most of which are finer than a pixel.
"""

import math

import pytest
import scenes
import torch
from scenes import VARIANTS, Camera, name_of

import analytic_rasterizer as ar

STEPS = 500
COUNT = 40
SIZES = ((32, 24), (16, 12), (8, 6))
CAMERAS = [Camera(image_width=width, image_height=height, bg=(0.1, 0.2, 0.3)) for width, height in SIZES]
# How fast each part of a Gaussian moves, per step of Adam: mean, log scales, quaternion, opacity's logit, colour.
RATES = {"means3D": 0.01, "log_scales": 0.02, "rotations": 0.02, "logits": 0.03, "colors": 0.02}
WIDTHS = {"means3D": 3, "log_scales": 3, "rotations": 4, "logits": 1, "colors": 3}

# World units; a pixel of the three images is 0.15, 0.3 and 0.6 across where the Gaussians are.
STARTS = {"isotropic": (0.15, 0.15), "needles": (0.6, 0.003), "sub-pixel": (0.06, 0.015)}


def start(kind):
    """Parameters (COUNT, 14) float64, rounded to float32 so that both precisions start alike."""
    g = torch.Generator().manual_seed(11)
    longest, shortest = STARTS[kind]
    rotations = torch.tensor([[1.0, 0.0, 0.0, 0.0]], dtype=torch.float64).repeat(COUNT, 1)
    scales = torch.full((COUNT, 3), math.log(longest), dtype=torch.float64)
    means = scenes.rand(g, COUNT, 3, low=-1.2, high=1.2)
    if kind == "needles":
        scales[:, 1:] = math.log(shortest)
        rotations = scenes.rand(g, COUNT, 4, low=-1.0, high=1.0)
    elif kind == "sub-pixel":
        scales = scenes.rand(g, COUNT, 3, low=math.log(shortest), high=math.log(longest))
    logits = torch.zeros(COUNT, 1, dtype=torch.float64)
    colors = torch.full((COUNT, 3), 0.5, dtype=torch.float64)
    return torch.cat([means, scales, rotations, logits, colors], -1).float().double()


def target():
    """A scene of large and small Gaussians, as sixteen samples per pixel see it at each size."""
    scene = scenes.random_scene(12, 30, opacity=(0.4, 0.95), sigma=(0.03, 0.5), spread=1.2)
    with torch.no_grad():
        return [ar.GaussianRasterizer(camera.settings(footprint="box", samples=16))(**scene)[0] for camera in CAMERAS]


def optimise(parameters, images, variant, dtype, device, steps):
    """The loss, averaged over the three sizes, before and after; asserts that all numbers on the way are finite."""
    footprint, options = variant
    rasterizers = [
        ar.GaussianRasterizer(camera.settings(dtype, device, footprint=footprint, **options)) for camera in CAMERAS
    ]
    images = [image.to(dtype=dtype, device=device) for image in images]
    parameters = parameters.to(dtype=dtype, device=device).requires_grad_()
    rates = torch.cat([torch.full((WIDTHS[name],), rate) for name, rate in RATES.items()]).to(parameters)
    means2D = torch.zeros(COUNT, 3, dtype=dtype, device=device)

    def loss_of(k):
        means, log_scales, rotations, logits, colors = parameters.split(tuple(WIDTHS.values()), -1)
        image, _ = rasterizers[k](
            means3D=means,
            means2D=means2D,
            opacities=torch.sigmoid(logits),
            colors_precomp=colors,
            scales=torch.exp(log_scales),
            rotations=rotations,
        )
        return ((image - images[k]) ** 2).mean()

    def total():
        with torch.no_grad():
            return sum(loss_of(k).item() for k in range(len(SIZES))) / len(SIZES)

    before = total()
    first, second = torch.zeros_like(parameters), torch.zeros_like(parameters)
    for step in range(1, steps + 1):
        (gradient,) = torch.autograd.grad(loss_of(step % len(SIZES)), parameters)
        assert torch.isfinite(gradient).all(), f"step {step}"
        with torch.no_grad():
            first.lerp_(gradient, 0.1)
            second.mul_(0.99).addcmul_(gradient, gradient, value=0.01)
            scale = math.sqrt(1 - 0.99**step) / (1 - 0.9**step)
            parameters.sub_(rates * scale * first / (second.sqrt() + 1e-12))
    assert torch.isfinite(parameters).all()
    return before, total()


@pytest.fixture(scope="module")
def images():
    return target()


def steps_for(variant):
    """`exact` in float64 takes ten times as long as any other."""
    return 150 if variant[0] == "exact" else STEPS


# PLACEHOLDER
@pytest.mark.parametrize("kind", STARTS)
@pytest.mark.parametrize("variant", VARIANTS, ids=name_of)
def test_from_a_hard_start(device, variant, kind, images):
    before, after = optimise(start(kind), images, variant, torch.float32, device, steps_for(variant))
    _, expected = optimise(start(kind), images, variant, torch.float64, "cpu", steps_for(variant))
    print(f"loss {before:.2e} -> {after:.2e}, float64 {expected:.2e}")
