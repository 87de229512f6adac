"""Activations of Gaussians: values and gradients are torch's."""

import pytest
import torch
from marks import each_precision, needs_cuda
from threads import assert_identical, same_on_threads

import analytic_rasterizer as ar
from analytic_rasterizer.activations import activate

NAMES = ("log_scales", "quats", "logit_opacities")


def parameters(count, dtype=torch.float64, device="cpu", seed=0):
    g = torch.Generator().manual_seed(seed)
    values = [torch.randn(count, width, generator=g, dtype=torch.float64) for width in (3, 4, 1)]
    values[0] = 3 * values[0] - 4
    values[2] *= 4
    return [value.to(dtype).to(device) for value in values]


def plain(log_scales, quats, logit_opacities):
    return torch.exp(log_scales), torch.nn.functional.normalize(quats), torch.sigmoid(logit_opacities)


def outputs_and_gradients(function, given, weights):
    leaves = [t.detach().clone().requires_grad_() for t in given]
    outputs = function(*leaves)
    total = sum((output * weight).sum() for output, weight in zip(outputs, weights))
    return [*(o.detach() for o in outputs), *torch.autograd.grad(total, leaves)]


@each_precision
@pytest.mark.parametrize("count", [0, 1, 257, 10_000])
def test_values_and_gradients_are_those_of_torch(device, dtype, count):
    given, weights = parameters(count, dtype), parameters(count, dtype, seed=1)
    exact = outputs_and_gradients(plain, [t.double() for t in given], [t.double() for t in weights])
    actual = outputs_and_gradients(activate, [t.to(device) for t in given], [t.to(device) for t in weights])
    # exp and sqrt within 2 ulp, and at most 12 roundings after them, relative to the result, or to what cancels in it:
    # g - r (r . g), of at most 4 |g| / |q| together.
    g, q = weights[1].double(), given[1].double()
    cancels = 4 * g.norm(dim=1, keepdim=True) / q.norm(dim=1, keepdim=True)
    scale = [*(t.abs() for t in exact[:4]), cancels, weights[2].double().abs() * exact[2]]
    u = torch.finfo(dtype).eps / 2
    for result, expected, size in zip(actual, exact, scale):
        assert result.dtype == dtype and result.shape == expected.shape and result.device.type == device
        assert ((result.cpu().double() - expected).abs() <= 16 * u * size).all()


@each_precision
def test_extreme_parameters(device, dtype):
    """As torch has it: no overflow in the middle, zero and short quaternions, opacities that round to 0 and 1."""
    logs = torch.tensor([[-200.0, 0.0, 50.0], [-torch.inf, torch.inf, 200.0], [0.0, -1e30, -3.0]])
    quats = torch.tensor([[0.0, 0, 0, 0], [1e-13, 0, 0, 2e-13], [1e15, -1e15, 2e15, 3.0]])
    logits = torch.tensor([[-300.0], [300.0], [-torch.inf]])
    given = [t.to(dtype) for t in (logs, quats, logits)]
    weights = [torch.ones_like(t) * torch.arange(1, t.shape[1] + 1) for t in given]
    exact = outputs_and_gradients(plain, given, weights)
    actual = outputs_and_gradients(activate, [t.to(device) for t in given], [t.to(device) for t in weights])
    for result, expected in zip(actual, exact):
        torch.testing.assert_close(result.cpu(), expected, rtol=64 * torch.finfo(dtype).eps, atol=1e-30, equal_nan=True)


def test_gradcheck(device):
    given = [t.requires_grad_() for t in parameters(7, device=device)]
    assert torch.autograd.gradcheck(activate, given)
    short = (given[1].detach() * 1e-14).requires_grad_()  # far below the least length, where it is linear
    linear = torch.autograd.functional.jacobian(lambda q: activate(given[0], q, given[2])[1], short)
    assert torch.equal(linear.reshape(28, 28), torch.eye(28, dtype=torch.float64, device=device) / 1e-12)


@pytest.mark.parametrize("wanted", range(3), ids=NAMES.__getitem__)
def test_some_gradients_alone(device, wanted):
    """Of one parameter, and with only one of the outputs used."""
    given, weights = parameters(50, device=device), parameters(50, device=device, seed=1)
    expected = outputs_and_gradients(activate, given, weights)
    leaves = [t.clone().requires_grad_(k == wanted) for k, t in enumerate(given)]
    outputs = activate(*leaves)
    (alone,) = torch.autograd.grad((outputs[wanted] * weights[wanted]).sum(), leaves[wanted])
    assert torch.equal(alone, expected[3 + wanted])
    leaves = [t.clone().requires_grad_() for t in given]
    gradients = torch.autograd.grad((activate(*leaves)[wanted] * weights[wanted]).sum(), leaves)
    for k, gradient in enumerate(gradients):
        assert torch.equal(gradient, expected[3 + k] if k == wanted else torch.zeros_like(gradient))


@pytest.mark.parametrize("place", range(3), ids=NAMES.__getitem__)
def test_nan_stays_in_its_row(device, place):
    given = parameters(20, torch.float32, device)
    given[place][7, 0] = torch.nan
    results = outputs_and_gradients(activate, given, [torch.ones_like(t) for t in given])
    for k, result in enumerate(results):
        bad = result.isnan().any(1)
        assert bad[7] == (k % 3 == place) and bad.sum() == bad[7].int()


def test_thread_count_changes_no_bit():
    given, weights = parameters(20_000, torch.float32), parameters(20_000, torch.float32, seed=1)
    same_on_threads(lambda: outputs_and_gradients(activate, given, weights))


def test_strided_parameters(device):
    rows = torch.randn(30, 8, generator=torch.Generator().manual_seed(0), dtype=torch.float64).to(device)
    parts = rows.split((3, 4, 1), 1)
    assert_identical(activate(*parts), activate(*(part.contiguous() for part in parts)))


def test_only_the_parameters_are_kept(device):
    leaves = [t.requires_grad_() for t in parameters(20, torch.float32, device)]
    kept = []
    with torch.autograd.graph.saved_tensors_hooks(lambda t: kept.append(t) or t, lambda t: t):
        activate(*leaves)
    assert sorted(t.data_ptr() for t in kept) == sorted(t.data_ptr() for t in leaves)


@pytest.mark.parametrize(
    "change, error, message",
    [
        ({"log_scales": None}, TypeError, "log_scales must be a tensor, got NoneType"),
        ({"quats": [1.0]}, TypeError, "quats must be a tensor, got list"),
        ({"log_scales": torch.zeros(4, 3, dtype=torch.float16)}, TypeError, "log_scales must have dtype float32 or"),
        ({"quats": torch.zeros(4, 4, dtype=torch.float64)}, TypeError, "quats must have the dtype of log_scales"),
        ({"log_scales": torch.zeros(4, 2)}, ValueError, r"log_scales must have shape \(N, 3\), got \(4, 2\)"),
        ({"quats": torch.zeros(5, 4)}, ValueError, r"quats must have shape \(N, 4\) with N = 4, got \(5, 4\)"),
        ({"quats": torch.zeros(4, 3)}, ValueError, "quats must have shape"),
        ({"logit_opacities": torch.zeros(4)}, ValueError, r"logit_opacities must have shape \(N, 1\) with N = 4"),
    ],
)
def test_errors(change, error, message):
    good = {"log_scales": torch.zeros(4, 3), "quats": torch.zeros(4, 4), "logit_opacities": torch.zeros(4, 1)}
    with pytest.raises(error, match=message):
        activate(**(good | change))


def test_opcheck(device):
    given = parameters(6, torch.float32, device)
    ops = torch.ops.analytic_rasterizer
    torch.library.opcheck(ops.activate.default, tuple(t.clone().requires_grad_() for t in given))
    torch.library.opcheck(ops.activate.default, (*(t.clone().requires_grad_() for t in given), 0.3, 0.2))
    gradients, one = [torch.ones_like(t) for t in given], torch.ones((), device=device)
    some = [gradients[0], None, None, one]
    torch.library.opcheck(ops.activate_vjp.default, ([*gradients, None], *given, 0.0, 0.0, [], [True, True, True]))
    torch.library.opcheck(ops.activate_vjp.default, (some, *given, 0.3, 0.2, [], [True, False, True]))


@each_precision
@pytest.mark.parametrize("count", [0, 1, 257, 10_000])
@pytest.mark.parametrize("weights", [(0.3, 0.0), (0.0, 0.2), (0.3, 0.2)], ids=str)
def test_the_penalty_and_its_gradients(device, dtype, count, weights):
    """Weighted sums of opacities and scales, alone and beside gradients of the values themselves."""
    given, of_values = parameters(count, dtype), parameters(count, dtype, seed=1)

    def penalized(function, leaves):
        scales, rotations, opacities, *penalty = function(*leaves)
        penalty = penalty or [weights[0] * opacities.sum() + weights[1] * scales.sum()]
        return scales, rotations, opacities, penalty[0]

    def op(*leaves):
        return torch.ops.analytic_rasterizer.activate(*leaves, *weights)

    u = torch.finfo(dtype).eps / 2
    for use_values in (False, True):
        made = []
        for function, where, precision in ((plain, "cpu", torch.float64), (op, device, dtype)):
            leaves = [t.to(where, precision).requires_grad_() for t in given]
            *values, penalty = penalized(function, leaves)
            total = 1.5 * penalty
            if use_values:
                total = total + sum((v * w.to(where, precision)).sum() for v, w in zip(values, of_values))
            gradients = torch.autograd.grad(total, leaves, allow_unused=True)
            made.append([t.double().cpu() for t in (penalty.detach(), gradients[0], gradients[2])])
        # The sum is of positive numbers, 5 roundings and 2 ulp each, blocks of 256 in 9 roundings, the rest in double.
        expected, found = made
        assert (found[0] - expected[0]).abs() <= 20 * u * expected[0]
        scales, opacities = (t.double() for t in (given[0].exp(), given[2].sigmoid()))
        for k, size, weight, of_value in (
            (1, scales, weights[1], of_values[0]),
            (2, opacities, weights[0], of_values[2]),
        ):
            size = size * (1.5 * weight + (of_value.double().abs() if use_values else 0))
            assert ((found[k] - expected[k]).abs() <= 20 * u * size).all()
    assert op(*leaves)[3].shape == () and torch.ops.analytic_rasterizer.activate(*leaves)[3].shape == (0,)


@needs_cuda
def test_a_step_is_captured_in_a_cuda_graph():
    given = parameters(500, torch.float32, "cuda")
    leaves = [t.clone().requires_grad_() for t in given]
    with torch.cuda.stream(torch.cuda.Stream()):
        torch.autograd.grad(sum(t.sum() for t in activate(*leaves)), leaves)
    torch.cuda.synchronize()
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        outputs = activate(*leaves)
        gradients = torch.autograd.grad(sum(t.sum() for t in outputs), leaves)
    other = parameters(500, torch.float32, "cuda", seed=5)
    with torch.no_grad():
        for leaf, value in zip(leaves, other):
            leaf.copy_(value)
    graph.replay()
    expected = outputs_and_gradients(activate, other, [torch.ones_like(t) for t in other])
    assert all(torch.equal(a, b) for a, b in zip([*outputs, *gradients], expected))


def test_it_is_found_from_the_package():
    assert ar.activations.activate is activate
