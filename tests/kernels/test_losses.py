"""The loss of a training step and its similarity: values and gradients against the plain formula, on both devices."""

import functools

import pytest
import torch
from marks import each_precision, needs_cuda
from processes import run_python
from threads import assert_identical, same_on_threads
from torch.nn import functional

import analytic_rasterizer as ar
from analytic_rasterizer import losses

U32 = 2.0**-24
"""Largest relative error of a rounding to float32."""
SIZES = [(1, 1), (1, 40), (5, 300), (11, 11), (10, 12), (32, 33), (65, 129), (97, 41)]
"""Smaller than the window, as large, and around the blocks of both devices."""


# --- the plain formula ---------------------------------------------------------------------------


def blur(images):
    """Of (N, H, W), zeros outside: 11 x 11 pixels, a standard deviation of 1.5 px."""
    x = torch.arange(-5, 6, dtype=images.dtype)
    line = torch.exp(-(x**2) / (2 * 1.5**2))
    line /= line.sum()
    along_rows = functional.conv2d(images[:, None], line[None, None, None], padding=(0, 5))
    return functional.conv2d(along_rows, line[None, None, :, None], padding=(5, 0))[:, 0]


def moments_of(x, y):
    """x, y, xx, yy, xy under the window, of (N, H, W)."""
    return [blur(product) for product in (x, y, x * x, y * y, x * y)]


def similarity_of(x, y, xx, yy, xy):
    a, b = 2 * x * y + 0.01**2, 2 * (xy - x * y) + 0.03**2
    return a * b / ((x * x + y * y + 0.01**2) * (xx - x * x + yy - y * y + 0.03**2))


def plain_ssim(image, target):
    flat = (t.reshape(-1, *t.shape[-2:]) for t in (image, target))
    return similarity_of(*moments_of(*flat)).reshape(image.shape)


def plain_loss(image, target, weight=0.2):
    return (1 - weight) * (image - target).abs().mean() + weight * (1 - plain_ssim(image, target).mean())


def value_and_gradient(function, image):
    leaf = image.detach().clone().requires_grad_()
    value = function(leaf)
    return value.detach(), torch.autograd.grad(value, leaf)[0]


# --- how far float32 may be from it --------------------------------------------------------------

MOMENT_ROUNDINGS = 26
"""Of a moment: a product, and twice a sum of eleven numbers whose weights are rounded too."""
FORMULA_ROUNDINGS = 8
"""Of what the formula makes of the moments."""


def spread_of(function, moments):
    """Bound of the error of function(*moments) in float32, by pixel, to first order.

    Every moment is off by its roundings, and the products of means that are subtracted from it, which are no larger, by
    those of the formula; the slopes of the function say what becomes of both. Its own roundings come on top.
    """
    leaves = [moment.detach().clone().requires_grad_() for moment in moments]
    value = function(*leaves)
    slopes = torch.autograd.grad(value.sum(), leaves, materialize_grads=True)
    first = sum(slope.abs() * moment for slope, moment in zip(slopes, moments))
    return U32 * ((MOMENT_ROUNDINGS + FORMULA_ROUNDINGS) * first + FORMULA_ROUNDINGS * value.detach().abs())


def partial_of(place, *moments):
    """Of the similarity with respect to the moment at `place`."""
    return torch.autograd.grad(similarity_of(*moments).sum(), moments[place], create_graph=True)[0]


def bounds32(image, target, dL_dmap):
    """Bounds of the errors of the map, and of the gradient of (map * dL_dmap).sum(), of float64 (N, H, W)."""
    moments = moments_of(image, target)
    of_gradient = torch.zeros_like(image)
    for place, factor in ((0, torch.ones_like(image)), (2, 2 * image), (4, target)):
        leaves = [moment.detach().clone().requires_grad_() for moment in moments]
        size = partial_of(place, *leaves).detach().abs()
        spread = spread_of(functools.partial(partial_of, place), moments)
        of_gradient += factor * blur((spread + (MOMENT_ROUNDINGS + 4) * U32 * size) * dL_dmap.abs())
    return spread_of(similarity_of, moments), of_gradient


# --- data ----------------------------------------------------------------------------------------


def pair(*shape, seed=0, noise=0.1):
    """A picture of smooth parts and edges in [0, 1], and a noisy version of it, float64 on the CPU."""
    g = torch.Generator().manual_seed(seed)
    coarse = torch.rand(*shape[:-2], -(-shape[-2] // 7), -(-shape[-1] // 7), generator=g, dtype=torch.float64)
    target = coarse.repeat_interleave(7, -2).repeat_interleave(7, -1)[..., : shape[-2], : shape[-1]]
    image = target + noise * torch.randn(shape, generator=g, dtype=torch.float64)
    return image.clamp(0, 1), target.contiguous()


def assert_within(actual, expected, bound, slack=1e-30):
    error = (actual.cpu().double() - expected).abs()
    worst = (error / (bound + slack)).max().item()
    assert worst <= 1, f"{worst} times the bound"


# --- values and gradients ------------------------------------------------------------------------


@each_precision
@pytest.mark.parametrize("size", SIZES, ids=str)
def test_map_is_that_of_the_plain_formula(device, dtype, size):
    image, target = pair(3, *size)
    g = torch.rand(image.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64) - 0.3
    # What float32 is given, so that only the arithmetic differs.
    image, target, g = (t.to(dtype).double() for t in (image, target, g))
    _, expected_gradient = value_and_gradient(lambda x: (plain_ssim(x, target) * g).sum(), image)
    given = [t.to(device, dtype) for t in (image, target, g)]
    _, gradient = value_and_gradient(lambda x: (losses.ssim(x, given[1], "none") * given[2]).sum(), given[0])
    of_map, of_gradient = (1e-12, 1e-12) if dtype == torch.float64 else bounds32(image, target, g)
    assert_within(losses.ssim(given[0], given[1], "none"), plain_ssim(image, target), of_map)
    # Slopes of the similarity reach 2 / (0.03^2): 1e-12 is a few roundings of them.
    assert_within(gradient, expected_gradient, of_gradient * (2 / 0.03**2) if dtype == torch.float64 else of_gradient)


@each_precision
@pytest.mark.parametrize(
    "size, weight", [*((size, 0.2) for size in SIZES), ((400, 400), 0.2), ((97, 41), 0), ((97, 41), 1)]
)
def test_loss_is_that_of_the_plain_formula(device, dtype, size, weight):
    image, target = (t.to(dtype).double() for t in pair(3, *size))
    expected, expected_gradient = value_and_gradient(lambda x: plain_loss(x, target, weight), image)
    given = [t.to(device, dtype) for t in (image, target)]
    actual, gradient = value_and_gradient(lambda x: losses.l1_ssim(x, given[1], weight), given[0])
    assert actual.shape == () and actual.dtype == dtype and gradient.dtype == dtype
    n = image.numel()
    if dtype == torch.float64:
        assert abs(actual.item() - expected.item()) <= 1e-12
        assert (gradient.cpu() - expected_gradient).abs().max() <= 1e-12 * (2 / 0.03**2)
        return
    of_map, of_gradient = bounds32(image, target, torch.full_like(image, weight / n))
    # Sums in blocks, and that of a thread's pixels: 32 roundings cover the longest chain of additions in float32.
    assert abs(actual.item() - expected.item()) <= weight * of_map.mean() + 32 * U32
    assert_within(gradient, expected_gradient, of_gradient + 8 * U32 * ((1 - weight) / n))


@each_precision
def test_mean_similarity(device, dtype):
    image, target = (t.to(dtype).double() for t in pair(2, 3, 40, 50))
    expected, expected_gradient = value_and_gradient(lambda x: plain_ssim(x, target).mean(), image)
    given = [t.to(device, dtype) for t in (image, target)]
    actual, gradient = value_and_gradient(lambda x: losses.ssim(x, given[1]), given[0])
    flat = [t.reshape(-1, 40, 50) for t in (image, target)]
    if dtype == torch.float64:
        assert abs(actual.item() - expected.item()) <= 1e-12
        assert (gradient.cpu() - expected_gradient).abs().max() <= 1e-12
    else:
        of_map, of_gradient = bounds32(*flat, torch.full_like(flat[0], 1 / image.numel()))
        assert abs(actual.item() - expected.item()) <= of_map.mean() + 32 * U32
        assert_within(gradient.reshape(flat[0].shape), expected_gradient.reshape(flat[0].shape), of_gradient)


@needs_cuda
@pytest.mark.parametrize("size", SIZES, ids=str)
def test_cuda_in_float64(size):
    image, target = pair(2, *size)
    expected, expected_gradient = value_and_gradient(lambda x: plain_loss(x, target), image)
    actual, gradient = value_and_gradient(lambda x: losses.l1_ssim(x, target.cuda()), image.cuda())
    assert abs(actual.item() - expected.item()) <= 1e-12
    assert (gradient.cpu() - expected_gradient).abs().max() <= 1e-12 * (2 / 0.03**2)


@pytest.mark.parametrize("shape", [(1, 3, 4), (2, 7, 13), (2, 3, 12, 5)], ids=str)
def test_gradcheck(device, shape):
    image, target = (t.to(device) for t in pair(*shape, seed=2))
    # Steps of gradcheck must not cross the corner of |x|.
    image = torch.where((image - target).abs() < 1e-3, target + 1e-2, image).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: losses.l1_ssim(x, target), image)
    assert torch.autograd.gradcheck(lambda x: losses.ssim(x, target, "none"), image)
    assert torch.autograd.gradcheck(lambda x: losses.ssim(x, (target * 255).byte()), image)


@each_precision
def test_uint8_is_the_share_of_255_to_the_bit(device, dtype):
    image = pair(3, 50, 70)[0].to(device, dtype)
    target = torch.randint(0, 256, image.shape, generator=torch.Generator().manual_seed(3), dtype=torch.uint8)
    target.view(-1)[:256] = torch.arange(256, dtype=torch.uint8)
    share = (target.to(dtype) / 255).to(device)  # on CUDA torch multiplies by the rounded 1 / 255 instead
    target = target.to(device)
    for function in (losses.l1_ssim, losses.ssim, lambda x, y: losses.ssim(x, y, "none").square().sum()):
        results = [value_and_gradient(lambda x, y=y, f=function: f(x, y), image) for y in (target, share)]
        assert torch.equal(results[0][0], results[1][0]) and torch.equal(results[0][1], results[1][1])


@pytest.mark.parametrize("brightness", [0.5, 0.9, 1.0])
@pytest.mark.parametrize("noise", [1e-4, 1e-3, 1e-2, 3e-2])
def test_flat_images_in_float32(device, brightness, noise):
    """The worst case of float32. Of 300 x 300 pixels the largest error was 7e-4, and 2e-5 in the mean."""
    g = torch.Generator().manual_seed(0)
    x, y = (
        (brightness + noise * torch.randn(3, 100, 100, generator=g, dtype=torch.float64)).clamp(0, 1).float().double()
        for _ in range(2)
    )
    exact = plain_ssim(x, y)
    given = [t.to(device, torch.float32) for t in (x, y)]
    similarity = losses.ssim(*given, "none")
    assert_within(similarity, exact, bounds32(x, y, x)[0])
    assert (similarity.cpu() - exact).abs().max() <= 2e-3
    assert (losses.ssim(*given).cpu() - exact.mean()).abs() <= 1e-4


def test_equal_images(device):
    image = pair(3, 30, 30)[0].float()
    on_device = image.to(device)
    value, gradient = value_and_gradient(lambda x: losses.l1_ssim(x, on_device), on_device)
    ones = losses.ssim(on_device, on_device, "none")
    # Numerator and denominator are the same numbers up to the last two divisions.
    assert (ones - 1).abs().max() <= 4 * U32 and value.abs() <= 4 * U32
    bound = bounds32(image.double(), image.double(), torch.full((3, 30, 30), 0.2 / image.numel()).double())[1]
    assert_within(gradient, torch.zeros(3, 30, 30), bound)  # the derivative of |x| at 0 is 0


def test_batches_and_channels_are_means_of_each(device):
    image, target = (t.to(device) for t in pair(2, 5, 20, 45))
    together = losses.l1_ssim(image, target)
    each = [losses.l1_ssim(image[b, c : c + 1], target[b, c : c + 1]) for b in range(2) for c in range(5)]
    assert abs(together - torch.stack(each).mean()) <= 1e-14
    maps = torch.stack([losses.ssim(image[b], target[b], "none") for b in range(2)])
    assert torch.equal(losses.ssim(image, target, "none"), maps)


def test_layout_of_the_tensors_does_not_matter(device):
    image, target = (t.to(device, torch.float32) for t in pair(2, 3, 20, 45))
    expected = value_and_gradient(lambda x: losses.l1_ssim(x, target), image)
    last = target.to(memory_format=torch.channels_last)
    strided = torch.stack([image, image], -1)[..., 0]
    assert not strided.is_contiguous() and not last.is_contiguous()
    leaf = strided.detach().requires_grad_()
    value = losses.l1_ssim(leaf, last)
    assert torch.equal(value, expected[0]) and torch.equal(torch.autograd.grad(value, leaf)[0], expected[1])


def test_nothing_is_kept_without_a_gradient(device):
    image, target = (t.to(device) for t in pair(1, 12, 12))
    op = torch.ops.analytic_rasterizer.l1_ssim
    assert op(image, target, 0.8, -0.2, 0.2)[1] == []
    (partials,) = op(image.requires_grad_(), target, 0.8, -0.2, 0.2)[1]
    assert partials.shape == (3, 1, 12, 12) and not partials.requires_grad


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_thread_count_changes_no_bit(dtype):
    image, target = (t.to(dtype) for t in pair(3, 300, 200))

    def results():
        of_loss = value_and_gradient(lambda x: losses.l1_ssim(x, target), image)
        return *of_loss, losses.ssim(image, target, "none")

    same_on_threads(results)


def test_repeated_runs_are_identical(device):
    torch.set_num_threads(7)
    image, target = (t.to(device, torch.float32) for t in pair(3, 300, 200))
    first = value_and_gradient(lambda x: losses.l1_ssim(x, target), image)
    for _ in range(5):
        assert_identical(first, value_and_gradient(lambda x: losses.l1_ssim(x, target), image))


@pytest.mark.parametrize("name", ["image", "target"])
def test_nan_is_not_hidden(device, name):
    """In the loss, in the map as far as the window reaches, and in the gradient of what the pixel changes."""
    images = dict(zip(("image", "target"), (t.to(device, torch.float32) for t in pair(1, 40, 50))))
    images[name][0, 20, 30] = torch.nan
    value, gradient = value_and_gradient(lambda x: losses.l1_ssim(x, images["target"]), images["image"])
    assert value.isnan() and losses.ssim(**images).isnan()
    expected = torch.zeros(1, 40, 50, dtype=torch.bool, device=device)
    expected[:, 15:26, 25:36] = True
    assert torch.equal(losses.ssim(**images, reduction="none").isnan(), expected)
    assert gradient[expected].isnan().all() and gradient[0, 20, 30].isnan()
    far = torch.ones_like(expected)
    far[:, 10:31, 20:41] = False
    assert gradient[far].isfinite().all()


# --- errors --------------------------------------------------------------------------------------


def image(*shape):
    return torch.zeros(*(shape or (3, 8, 9)))


@pytest.mark.parametrize("function", [losses.l1_ssim, losses.ssim, lambda x, y: losses.ssim(x, y, "none")])
@pytest.mark.parametrize(
    "arguments, error, message",
    [
        (([1.0], image()), TypeError, "image must be a tensor, got list"),
        ((image(), None), TypeError, "target must be a tensor, got NoneType"),
        ((image().half(), image()), TypeError, "image must have dtype float32 or float64, got Half"),
        ((image().byte(), image()), TypeError, "image must have dtype float32 or float64, got Byte"),
        ((image(), image().double()), TypeError, "target must have the dtype of image, Float, or uint8, got D"),
        ((image(), image().int()), TypeError, "target must have the dtype of image, Float, or uint8, got Int"),
        ((image(8, 9), image(8, 9)), ValueError, r"image must have shape \(C, H, W\) or \(B, C, H, W\), got \(8, 9\)"),
        ((image(1, 1, 1, 8, 9),) * 2, ValueError, "image must have shape"),
        ((image(), image(3, 8, 8)), ValueError, r"target must have shape that of image, \(3, 8, 9\), got \(3, 8, 8\)"),
        ((image(), image(1, 8, 9)), ValueError, "target must have shape"),
        ((image(0, 3, 8, 9),) * 2, ValueError, r"image must have at least one pixel, got shape \(0, 3, 8, 9\)"),
        ((image(3, 8, 0),) * 2, ValueError, "image must have at least one pixel"),
        ((image(), image().requires_grad_()), ValueError, r"target must not require a gradient.*target.detach\(\)"),
    ],
)
def test_errors(function, arguments, error, message):
    with pytest.raises(error, match=message):
        function(*arguments)


@pytest.mark.parametrize(
    "function, option, error, message",
    [
        (losses.l1_ssim, 1.5, ValueError, r"ssim_weight must be in \[0, 1\], got 1.5"),
        (losses.l1_ssim, float("nan"), ValueError, r"ssim_weight must be in \[0, 1\], got nan"),
        (losses.l1_ssim, "0.2", TypeError, "ssim_weight must be a number, got str"),
        (losses.ssim, "sum", ValueError, r"reduction must be one of .*, got 'sum'"),
    ],
)
def test_errors_of_options(function, option, error, message):
    with pytest.raises(error, match=message):
        function(image(), image(), option)


@needs_cuda
def test_images_on_different_devices_cuda():
    with pytest.raises((ValueError, RuntimeError), match="device"):
        losses.l1_ssim(image().cuda(), image())


def test_a_target_with_gradient_is_fine_where_none_is_asked_for():
    with torch.no_grad():
        losses.l1_ssim(image(), image().requires_grad_())


def test_there_is_no_second_derivative(device):
    leaf = image().to(device).requires_grad_()
    (gradient,) = torch.autograd.grad(losses.l1_ssim(leaf, torch.ones_like(leaf)), leaf, create_graph=True)
    with pytest.raises(RuntimeError, match="not implemented"):
        gradient.sum().backward()


# --- as operators --------------------------------------------------------------------------------


def opcheck(name, arguments):
    torch.library.opcheck(getattr(torch.ops.analytic_rasterizer, name).default, arguments)


@pytest.mark.parametrize("dtype", [torch.float32, torch.uint8])
def test_opcheck(device, dtype):
    x, y = (t.to(device, torch.float32) for t in pair(2, 3, 9, 14))
    y = (y * 255).byte() if dtype == torch.uint8 else y
    g = torch.ones_like(x)
    _, (partials,) = torch.ops.analytic_rasterizer.ssim_map(x, y, True)
    opcheck("ssim_map", (x.clone().requires_grad_(), y))
    opcheck("ssim_map", (x, y, True))
    opcheck("ssim_map_vjp", ([g], x, y, True, [partials], [True, False]))
    opcheck("l1_ssim", (x.clone().requires_grad_(), y, 0.8, -0.2, 0.2))
    opcheck("l1_ssim_vjp", ([g.mean()], x, y, 0.8, -0.2, 0.2, True, [partials], [True, False]))


def test_adjoints_check_what_they_are_given():
    x, partials, wanted = image(), torch.zeros(3, 3, 8, 9), [True, False]
    for given, saved, wants, message in (
        (x, [partials[:2]], wanted, "saved must be what the op saved"),
        (x, [], wanted, "saved must be what the op saved"),
        (x, [partials], [True, True], "target has no gradient"),
        (x[:1], [partials], wanted, "dL_dmap must have shape"),
        (None, [partials], wanted, "got none"),
    ):
        with pytest.raises(ValueError, match=message):
            torch.ops.analytic_rasterizer.ssim_map_vjp([given], x, image(), True, saved, wants)


@needs_cuda
def test_a_step_is_captured_in_a_cuda_graph():
    x, y = (t.cuda().float() for t in pair(3, 60, 70))
    leaf = x.clone().requires_grad_()
    stream = torch.cuda.Stream()
    with torch.cuda.stream(stream):
        torch.autograd.grad(losses.l1_ssim(leaf, y), leaf)
    torch.cuda.synchronize()
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        value = losses.l1_ssim(leaf, y)
        (gradient,) = torch.autograd.grad(value, leaf)
    with torch.no_grad():
        leaf.copy_(x.flip(-1))
    graph.replay()
    expected = value_and_gradient(lambda image: losses.l1_ssim(image, y), x.flip(-1).contiguous())
    assert torch.equal(value, expected[0]) and torch.equal(gradient, expected[1])


@needs_cuda
def test_a_cuda_step_does_not_wait():
    x, y = (t.cuda().float().requires_grad_(i == 0) for i, t in enumerate(pair(3, 60, 70)))
    torch.cuda.set_sync_debug_mode("error")
    try:
        losses.l1_ssim(x, y).backward()
    finally:
        torch.cuda.set_sync_debug_mode("default")


def test_after_a_fork():
    """Threads do not survive a fork; a child must not wait for those of its parent."""
    code = """
        import os, sys, torch
        from analytic_rasterizer import losses
        x, y = torch.rand(3, 200, 200), torch.rand(3, 200, 200)
        torch.set_num_threads(2)
        before = losses.l1_ssim(x, y)
        pid = os.fork()
        if pid == 0:
            os._exit(0 if torch.equal(losses.l1_ssim(x, y), before) else 1)
        print(os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]))
    """
    assert run_python(code).strip() == "0"


def test_it_is_found_from_the_package():
    assert ar.losses.l1_ssim is losses.l1_ssim
