"""Optimisation from hard starts: 500 steps of Adam on one target at three sizes, float32 against float64.

The starts are those where a renderer's gradients go wrong: isotropic Gaussians, whose eigenvectors are undefined;
needles, whose covariance is singular in float32; and Gaussians most of which are finer than a pixel.

Two runs that differ by rounding part: even in float64 the losses at the end differ by up to 20% where the starts
differ by 1e-7, and by 40% where the start is needles. So the ends are compared with that in mind, and the gradients
along the way, which do not drift apart, closely.
"""

import math

import pytest
import scenes
import torch
from scenes import VARIANTS, Camera, name_of

import analytic_rasterizer as ar

COUNT = 40
SIZES = ((32, 24), (16, 12), (8, 6))
CAMERAS = [Camera(image_width=width, image_height=height, bg=(0.1, 0.2, 0.3)) for width, height in SIZES]
# Columns of the parameters, and how far a step of Adam moves each: mean, log scales, quaternion, logit of the
# opacity, colour.
PARTS = (3, 3, 4, 1, 3)
RATES = torch.cat([torch.full((n,), rate) for n, rate in zip(PARTS, (0.01, 0.02, 0.02, 0.03, 0.02), strict=True)])

# Longest and shortest scale in world units; a pixel of the three images is 0.15, 0.3 and 0.6 across at the target.
STARTS = {"isotropic": (0.15, 0.15), "needles": (0.6, 0.003), "sub-pixel": (0.06, 0.015)}


def start(kind):
    """Parameters (COUNT, 14) float64, rounded to float32 so that both precisions start alike."""
    g = torch.Generator().manual_seed(11)
    longest, shortest = map(math.log, STARTS[kind])
    means = scenes.rand(g, COUNT, 3, low=-1.2, high=1.2)
    scales = torch.full((COUNT, 3), longest, dtype=torch.float64)
    rotations = torch.tensor([[1.0, 0.0, 0.0, 0.0]], dtype=torch.float64).repeat(COUNT, 1)
    if kind == "needles":
        scales[:, 1:] = shortest
        rotations = scenes.rand(g, COUNT, 4, low=-1.0, high=1.0)
    elif kind == "sub-pixel":
        scales = scenes.rand(g, COUNT, 3, low=shortest, high=longest)
    logits = torch.zeros(COUNT, 1, dtype=torch.float64)
    colors = torch.full((COUNT, 3), 0.5, dtype=torch.float64)
    return torch.cat([means, scales, rotations, logits, colors], -1).float().double()


@pytest.fixture(scope="module")
def images():
    """Large and small Gaussians as sixteen samples per pixel see them at each size."""
    scene = scenes.random_scene(12, 30, opacity=(0.4, 0.95), sigma=(0.03, 0.5), spread=1.2)
    with torch.no_grad():
        return [ar.GaussianRasterizer(camera.settings(footprint="box", samples=16))(**scene)[0] for camera in CAMERAS]


class Problem:
    """The loss at each size, for one footprint, in one precision."""

    def __init__(self, variant, images, dtype, device):
        footprint, options = variant
        settings = [camera.settings(dtype, device, footprint=footprint, **options) for camera in CAMERAS]
        self.rasterizers = [ar.GaussianRasterizer(s) for s in settings]
        self.images = [image.to(device, dtype) for image in images]

    def loss(self, parameters, k):
        means, log_scales, rotations, logits, colors = parameters.split(PARTS, -1)
        image, _ = self.rasterizers[k](
            means3D=means,
            means2D=torch.zeros_like(means),
            opacities=torch.sigmoid(logits),
            colors_precomp=colors,
            scales=torch.exp(log_scales),
            rotations=rotations,
        )
        return ((image - self.images[k]) ** 2).mean()

    def total(self, parameters):
        with torch.no_grad():
            return sum(self.loss(parameters, k).item() for k in range(len(SIZES))) / len(SIZES)

    def gradient(self, parameters, k):
        leaf = parameters.detach().to(self.images[k]).requires_grad_()
        return torch.autograd.grad(self.loss(leaf, k), leaf)[0]

    def optimise(self, parameters, steps, look):
        """Parameters after so many steps of Adam over the sizes in turn; look(step, parameters, gradient)."""
        parameters = parameters.to(self.images[0])
        rates = RATES.to(parameters)
        first, second = torch.zeros_like(parameters), torch.zeros_like(parameters)
        for step in range(1, steps + 1):
            gradient = self.gradient(parameters, step % len(SIZES))
            assert torch.isfinite(gradient).all(), f"step {step}"
            look(step, parameters, gradient)
            first.lerp_(gradient, 0.1)
            second.mul_(0.99).addcmul_(gradient, gradient, value=0.01)
            unbiased = math.sqrt(1 - 0.99**step) / (1 - 0.9**step)
            parameters = parameters - unbiased * rates * first / (second.sqrt() + 1e-12)
        assert torch.isfinite(parameters).all()
        return parameters


def steps_for(variant):
    """`exact` takes ten times as long in float64 as the others: fewer."""
    return 150 if variant[0] == "exact" else 500


def distance_for(variant, kind):
    """Largest ratio of the two losses: twice the largest difference, in logarithms, that was measured.

    Over all footprints, starts moved by 1e-7, in float64 and in float32 against float64: 0.18 and 0.21, from needles
    0.34 and 0.34. `point` without dilation sees nothing of a needle between the centres: 0.74 and 0.8.
    """
    measured = 0.21 if kind != "needles" else 0.8 if variant == ("point", {"dilation": 0.0}) else 0.34
    return math.exp(2 * measured)


# A needle's gradient is conditioned like its aspect ratio, 200; with some 100 roundings of 6e-8 that makes 1.2e-3.
# Measured: up to 3e-4 for the scales of needles, 3e-5 for everything else.
GRADIENT_ERROR = 1e-3


@pytest.mark.parametrize("kind", STARTS)
@pytest.mark.parametrize("variant", VARIANTS, ids=name_of)
def test_from_a_hard_start(device, variant, kind, images):
    """Everything is finite; gradients are float64's along the way; the loss falls as far as in float64."""
    ours, exact = Problem(variant, images, torch.float32, device), Problem(variant, images, torch.float64, "cpu")
    steps = steps_for(variant)
    errors = []

    def compare(step, parameters, gradient):
        if step % 25:
            return
        expected = exact.gradient(parameters.cpu(), step % len(SIZES))
        parts = zip(gradient.cpu().split(PARTS, -1), expected.split(PARTS, -1), strict=True)
        errors.append([((a - b).norm() / b.norm()).item() for a, b in parts])

    first = start(kind)
    before = ours.total(first.to(device, torch.float32))
    after = ours.total(ours.optimise(first, steps, compare))
    expected = exact.total(exact.optimise(first, steps, lambda *_: None))
    # The median step: at some an alpha crosses 1/255, which takes a term from one of the two sums.
    typical = torch.tensor(errors).median(0).values
    print(f"loss {before:.2e} -> {after:.2e}, float64 {expected:.2e}", [f"{e:.1e}" for e in typical])
    assert typical.max() < GRADIENT_ERROR
    assert after < before / 5
    assert 1 / distance_for(variant, kind) < after / expected < distance_for(variant, kind)
