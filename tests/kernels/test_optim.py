"""A step of Adam on many tensors at once: it is torch's, whichever rows, tensors and devices it runs on."""

import copy
import io

import pytest
import torch
from marks import needs_cuda, needs_newer_compiler
from threads import same_on_threads
from torch.optim import Adam

import analytic_rasterizer as ar
from analytic_rasterizer.optim import FusedAdam

SHAPES = [(40, 3), (40, 1), (0, 3), (40, 15, 3), (0,), (1,), (40,), (), (20_000, 3)]
LISTS = ("params", "grads", "exp_avgs", "exp_avg_sqs")
adam_ = torch.ops.analytic_rasterizer.adam_.default


def draw(shapes, seed, dtype=torch.float64, device="cpu"):
    g = torch.Generator().manual_seed(seed)
    return [torch.randn(shape, generator=g, dtype=torch.float64).to(dtype).to(device) for shape in shapes]


def make_state(shapes, dtype=torch.float32, device="cpu"):
    """Arguments of the op, as in the middle of a training."""
    params, grads, means, squares = (draw(shapes, seed, dtype, device) for seed in range(4))
    return [params, grads, means, [0.1 + square.abs() for square in squares]]


def op_step(state, steps=5, rows=None, eps=1e-8, bias_correction=True):
    """The step of the op on copies; params, exp_avgs and exp_avg_sqs afterwards."""
    params, grads, means, squares = ([t.clone() for t in tensors] for tensors in state)
    rates = [1e-2 * (i + 1) for i in range(len(params))]
    adam_(params, grads, means, squares, rates, [steps] * len(params), 0.9, 0.999, eps, rows, bias_correction)
    return params, means, squares


def groups_of(tensors):
    """Each tensor in a group of its own, with a learning rate of its own."""
    return [{"params": [t.clone().requires_grad_()], "lr": 10.0 ** -(k % 5)} for k, t in enumerate(tensors)]


def parameters_of(optimizer):
    return [parameter for group in optimizer.param_groups for parameter in group["params"]]


def take_step(optimizer, seed, without=(), **options):
    parameters = parameters_of(optimizer)
    for k, (parameter, gradient) in enumerate(zip(parameters, draw([p.shape for p in parameters], seed))):
        parameter.grad = None if k in without else gradient.to(parameter)
    optimizer.step(**options)


def assert_bits(a, b):
    assert all(torch.equal(x, y) for xs, ys in zip(a, b, strict=True) for x, y in zip(xs, ys, strict=True))


@pytest.mark.parametrize("count", [1, len(SHAPES), 40])  # more than one launch takes, too
@pytest.mark.parametrize("betas, eps", [((0.9, 0.999), 1e-15), ((0.5, 0.9), 1e-3), ((0.0, 0.0), 1e-8)])
def test_float64_is_that_of_torch(device, count, betas, eps):
    start = draw([SHAPES[k % len(SHAPES)] for k in range(count)], 0, device=device)
    ours, theirs = FusedAdam(groups_of(start), betas=betas, eps=eps), Adam(groups_of(start), betas=betas, eps=eps)
    for step in range(6):
        without = {3, 8} if step in (0, 3) else {}  # these have taken fewer steps
        take_step(ours, 10 + step, without)
        take_step(theirs, 10 + step, without)
    for a, b in zip(parameters_of(ours), parameters_of(theirs), strict=True):
        # Of the gradients that count in m each has at least an eighth of the weight in v: the terms of m are at most
        # 3 sqrt(v). Rates are at most 1, and a step has at most 16 roundings: 6 steps * 3 * 16 * 1.1e-16 = 3.2e-14.
        torch.testing.assert_close(a, b, rtol=1e-12, atol=4e-14)
        for moment in ("exp_avg", "exp_avg_sq"):
            torch.testing.assert_close(ours.state[a][moment], theirs.state[b][moment], rtol=1e-12, atol=1e-14)
        assert ours.state[a]["step"] == int(theirs.state[b]["step"])


@pytest.mark.parametrize("step", [1, 2, 1000])
def test_float32_is_within_its_roundings(device, step):
    state = make_state(SHAPES, device=device)
    results = op_step(state, step, eps=1e-6)
    exact = op_step([[t.cpu().double() for t in tensors] for tensors in state], step, eps=1e-6)
    u = torch.finfo(torch.float32).eps / 2
    for k, (grad, before) in enumerate(zip(state[1], state[2])):
        (param, mean, square), (exact_param, exact_mean, exact_square) = (
            [tensors[k].cpu().double() for tensors in result] for result in (results, exact)
        )
        # b m + (1 - b) g: the constants and the products are rounded, then the sum.
        terms = 0.1 * grad.cpu().double().abs() + 0.9 * before.cpu().double().abs()
        mean_error = 1.01 * u * (2 * terms + exact_mean.abs())
        assert ((mean - exact_mean).abs() <= mean_error).all()
        # Positive terms: a constant, two products at most, and the sum.
        assert ((square - exact_square).abs() <= 4.01 * u * exact_square).all()
        # rate m / (sqrt(v) s + eps). Denominator: 2 from v, the root, s, the product, eps or the sum, one each. The
        # quotient, the rate, and the product: 9 in all, beside the error of m. Then the difference.
        rate = 1e-2 * (k + 1) / (1 - 0.9**step)
        denominator = exact_square.sqrt() / (1 - 0.999**step) ** 0.5 + 1e-6
        moved = rate / denominator * exact_mean.abs()
        bound = 1.01 * u * (9 * moved + exact_param.abs()) + 1.01 * rate / denominator * mean_error
        assert ((param - exact_param).abs() <= bound).all()


@pytest.mark.parametrize("bias_correction", [True, False])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("mask", [torch.bool, torch.uint8])
def test_rows(device, dtype, mask, bias_correction):
    """Chosen rows have the bits of a step on all rows, others keep theirs."""
    count = 7001  # several work items, which end within rows
    state = make_state([(count, 3), (count,), (count, 5, 3), (count, 1), (count, 4), (count, 0)], dtype, device)
    chosen = torch.rand(count, generator=torch.Generator().manual_seed(9)) < 0.3
    rows = (chosen * (1 if mask is torch.bool else 200)).to(mask).to(device)
    everything = op_step(state, bias_correction=bias_correction)
    some = op_step(state, rows=rows, bias_correction=bias_correction)
    before = state[0], state[2], state[3]
    chosen = chosen.to(device)
    for old, new, full in zip(before, some, everything):
        for k in range(len(new)):
            assert torch.equal(new[k][chosen], full[k][chosen])
            assert torch.equal(new[k][~chosen], old[k][~chosen])
            assert new[k].numel() == 0 or (new[k][chosen] != old[k][chosen]).any()
    assert_bits(op_step(state, rows=torch.ones_like(rows), bias_correction=bias_correction), everything)
    assert_bits(op_step(state, rows=torch.zeros_like(rows), bias_correction=bias_correction), before)


HEADS = [1, 0, 6, 1, 2]  # of rows of 3, 1, 15, 1 and 4 numbers


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_heads_of_rows_have_learning_rates_of_their_own(device, dtype, masked):
    """Each part of a row has the bits of a step with its rate."""
    count = 7001  # several work items, which end within rows
    state = make_state([(count, 3), (count,), (count, 5, 3), (count, 1), (count, 4)], dtype, device)
    rows = torch.arange(count, device=device) % 3 > 0 if masked else None
    rates, head_rates = ([scale * (i + 1) for i in range(5)] for scale in (1e-2, 0.3))

    def step(rates, *heads):
        params, grads, means, squares = ([t.clone() for t in tensors] for tensors in state)
        adam_(params, grads, means, squares, rates, [5] * 5, 0.9, 0.999, 1e-8, rows, True, *heads)
        return params, means, squares

    both, tails, heads = step(rates, HEADS, head_rates), step(rates), step(head_rates)
    for result, of_tail, of_head in zip(both, tails, heads):
        for k, head in enumerate(HEADS):
            row, tail_row, head_row = (tensors[k].reshape(count, -1) for tensors in (result, of_tail, of_head))
            assert torch.equal(row[:, :head], head_row[:, :head])
            assert torch.equal(row[:, head:], tail_row[:, head:])
    assert not torch.equal(both[0][0], tails[0][0]) and not torch.equal(both[0][0], heads[0][0])
    assert_bits(step(rates, [0] * 5, [0.0] * 5), tails)


@needs_cuda
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_cuda_has_the_bits_of_the_cpu_with_heads(dtype):
    results = []
    for device in ("cpu", "cuda"):
        state = make_state([(7001, 16, 3), (7001, 3)], dtype, device)
        adam_(*state, [1e-2, 1e-2], [5, 5], 0.9, 0.999, 1e-8, None, True, [3, 0], [0.2, 0.0])
        results.append([[t.cpu() for t in tensors] for tensors in (state[0], state[2], state[3])])
    assert_bits(*results)


def test_head_of_a_group_is_like_a_parameter_of_its_own(device):
    """And survives a state_dict."""
    (value,) = draw([(40, 16, 3)], 0, torch.float32, device)
    joined = FusedAdam([{"params": [value.clone().requires_grad_()], "lr": 0.01, "head": 1, "head_lr": 0.2}])
    again = FusedAdam([value.clone().requires_grad_()])
    again.load_state_dict(joined.state_dict())
    first, rest = value[:, :1].clone().requires_grad_(), value[:, 1:].clone().requires_grad_()
    apart = FusedAdam([{"params": [first], "lr": 0.2}, {"params": [rest], "lr": 0.01}])
    for step in range(3):
        for optimizer in (joined, again):
            take_step(optimizer, step)
        gradient = parameters_of(joined)[0].grad
        first.grad, rest.grad = gradient[:, :1], gradient[:, 1:]
        apart.step()
    for optimizer in (joined, again):
        assert torch.equal(parameters_of(optimizer)[0], torch.cat([first, rest], dim=1))


@pytest.mark.parametrize("head, shape", [(3, (4, 2)), (1, (4,)), (-1, (4, 2))])
def test_head_that_is_larger_than_a_row(head, shape):
    value = torch.ones(shape, requires_grad=True)
    value.grad = torch.ones_like(value)
    with pytest.raises(ValueError, match=f"head is {head}, but a parameter has shape"):
        FusedAdam([{"params": [value], "head": head, "head_lr": 0.1}]).step()
    assert torch.equal(value, torch.ones(shape))


def test_no_rows_at_all(device):
    state = make_state([(0, 3), (0,)], device=device)
    op_step(state, rows=torch.zeros(0, dtype=torch.bool, device=device))


def test_without_correction_of_bias(device):
    state = make_state([(50, 3)], torch.float64, device)
    (param,), (mean,), (square,) = op_step(state, bias_correction=False)
    expected = 0.9 * state[2][0] + 0.1 * state[1][0], 0.999 * state[3][0] + 0.001 * state[1][0] ** 2
    torch.testing.assert_close((mean, square), expected, rtol=1e-12, atol=1e-15)
    torch.testing.assert_close(param, state[0][0] - 1e-2 * mean / (square.sqrt() + 1e-8), rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("masked", [False, True])
def test_alignment_changes_no_bit(device, dtype, masked):
    """Views that begin anywhere, of any length, as for tensors with memory of their own."""
    rows = torch.arange(1027, device=device) % 3 == 0 if masked else None
    state = make_state([(1027,), (1027, 3)], dtype, device)
    expected = op_step(state, rows=rows)
    for shifted in range(4):
        placed = [[t.clone() for t in tensors] for tensors in state]
        for k in range(2):
            t = placed[shifted][k]
            placed[shifted][k] = torch.empty(t.numel() + 1, dtype=dtype, device=device)[1:].view(t.shape).copy_(t)
        adam_(*placed, [1e-2, 2e-2], [5, 5], 0.9, 0.999, 1e-8, rows)
        assert_bits((placed[0], placed[2], placed[3]), expected)


def test_strided_and_missing_gradients(device):
    (value,) = draw([(30, 4)], 0, device=device)
    (wide,) = draw([(30, 8)], 1, device=device)
    results = []
    for gradient in (wide[:, ::2], wide[:, ::2].contiguous()):
        parameter, other = value.clone().requires_grad_(), value.clone().requires_grad_()
        parameter.grad = gradient
        optimizer = FusedAdam([parameter, other])
        optimizer.step()
        assert torch.equal(other, value) and not optimizer.state[other]
        results.append(parameter.detach())
    assert torch.equal(*results) and not torch.equal(results[0], value)
    FusedAdam([value.clone().requires_grad_()]).step()  # nobody has a gradient


def columns_of_a_matrix(t):
    return t.new_full((*t.shape[:-1], 2 * t.shape[-1] + 1), 7.0)[..., 1::2].copy_(t)


def reversed_strides(t):
    order = range(t.dim() - 1, -1, -1)
    return t.permute(*order).clone(memory_format=torch.contiguous_format).permute(*order)


def every_third_row(t):
    return t.new_full((3 * len(t), *t.shape[1:]), 7.0)[::3].copy_(t)


LAYOUTS = [columns_of_a_matrix, reversed_strides, every_third_row]


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_tensors_of_any_strides_have_the_bits_of_contiguous_ones(device, layout, masked):
    """And what lies in their memory between their numbers stays what it was."""
    count = 7001
    state = make_state([(count, 3), (count, 5, 3), (count, 1)], device=device)
    arguments = [1e-2, 2e-2, 3e-2], [5] * 3, 0.9, 0.999, 1e-8
    arguments += (torch.arange(count, device=device) % 3 > 0 if masked else None, True, [1, 6, 0], [0.2, 0.1, 0.0])
    expected = [[t.clone() for t in tensors] for tensors in state]
    adam_(*expected, *arguments)
    for strided in range(4):  # parameters, gradients, or moments
        placed = [[t.clone() for t in tensors] for tensors in state]
        placed[strided] = [layout(t) for t in placed[strided]]
        assert not placed[strided][1].is_contiguous()
        adam_(*placed, *arguments)
        assert_bits(placed, expected)
        for t in placed[strided]:
            size = t.untyped_storage().nbytes() // t.element_size()
            whole = t.as_strided((size,), (1,), 0)
            assert whole.numel() == t.numel() or (whole == 7).sum() == whole.numel() - t.numel()


def test_parameters_may_be_columns_of_one_matrix(device):
    """Their memory is interleaved, and none of it is shared: as with memory of their own."""
    (matrix,) = draw([(50, 11)], 0, torch.float32, device)
    whole = matrix.clone()
    together, apart = (
        FusedAdam([{"params": [t[:, first:end].detach().requires_grad_()]} for first, end in ((0, 3), (3, 4), (4, 11))])
        for t in (whole, matrix)
    )
    for group in apart.param_groups:
        group["params"] = [p.detach().clone().requires_grad_() for p in group["params"]]
    for step in range(2):
        take_step(together, step)
        take_step(apart, step)
    assert torch.equal(whole, torch.cat([p.detach() for p in parameters_of(apart)], 1))
    assert not torch.equal(whole, matrix)


def sparse_step(optimizer, seed):
    first = parameters_of(optimizer)[0]
    take_step(optimizer, seed, visibility=torch.arange(len(first), device=first.device) % 3 > 0, N=len(first))


def densify(optimizer):
    """Rows are added and removed as 3DGS does it, by new parameters with moments that are joined and cut."""
    for group in optimizer.param_groups:
        (old,) = group["params"]
        state = optimizer.state.pop(old)
        for name in ("exp_avg", "exp_avg_sq"):
            state[name] = torch.cat((state[name], torch.zeros_like(old[:4])), dim=0)[2:]
        new = torch.cat((old, old[:4]), dim=0)[2:].detach().requires_grad_()
        group["params"], optimizer.state[new] = [new], state


@pytest.mark.parametrize("kind", [FusedAdam, ar.optim.SparseGaussianAdam])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_the_life_of_a_parameter_of_any_strides(device, kind, layout):
    """Steps, densification, and a state_dict in between: the bits of a contiguous one. 3DGS makes its means from a
    transposed array."""
    step = sparse_step if kind is ar.optim.SparseGaussianAdam else take_step
    starts = draw([(40, 3), (40, 1), (40, 15, 3)], 0, torch.float32, device)
    results = []
    for place in (layout, torch.clone):
        parameters = [place(t).requires_grad_() for t in starts]
        groups = [{"params": [p], "lr": 0.01 * (k + 1)} for k, p in enumerate(parameters)]
        optimizer = kind(groups, lr=0.0, eps=1e-15)
        step(optimizer, 1)
        assert [p.data_ptr() for p in parameters_of(optimizer)] == [p.data_ptr() for p in parameters]
        again = kind([{"params": [place(p.detach()).requires_grad_()]} for p in parameters], lr=0.0, eps=1e-15)
        again.load_state_dict(optimizer.state_dict())
        step(again, 2)
        densify(again)
        step(again, 3)
        moments = [[again.state[p][name] for p in parameters_of(again)] for name in ("exp_avg", "exp_avg_sq")]
        results.append([[p.detach() for p in parameters_of(again)], *moments])
    assert_bits(*results)


def test_a_parameter_of_any_strides_against_torch(device):
    (start,) = draw([(30, 4)], 0, device=device)
    ours, theirs = (kind([reversed_strides(start).requires_grad_()], lr=0.1) for kind in (FusedAdam, Adam))
    for step in range(4):
        take_step(ours, step)
        take_step(theirs, step)
    (found,), (expected,) = parameters_of(ours), parameters_of(theirs)
    assert found.stride() == (1, 30)
    assert ours.state[found]["exp_avg"].stride() == theirs.state[expected]["exp_avg"].stride()
    torch.testing.assert_close(found, expected, rtol=1e-12, atol=1e-12)
    assert found._version == expected._version


def test_an_expanded_parameter_is_refused():
    value = torch.ones(3).expand(5, 3).requires_grad_()
    value.grad = torch.ones(5, 3)
    with pytest.raises(ValueError, match=r"params\[0\] must have memory of its own .* \(clone\(\) has\)"):
        FusedAdam([value]).step()
    assert torch.equal(value, torch.ones(5, 3))


def test_thread_count_changes_no_bit():
    state = make_state([(30_000, 3), (70_001,), (5,)])
    same_on_threads(lambda: [t for tensors in op_step(state) for t in tensors])


@needs_cuda
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_cuda_has_the_bits_of_the_cpu(dtype):
    state = make_state(SHAPES, dtype)
    on_device = op_step([[t.cuda() for t in tensors] for tensors in state])
    assert_bits([[t.cpu() for t in tensors] for tensors in on_device], op_step(state))


def test_numbers_that_are_not_finite_stay_where_they_are(device):
    state = make_state([(50,)], device=device)
    expected = op_step(state)
    state[1][0][7], state[1][0][9] = torch.nan, torch.inf
    for new, old in zip(op_step(state), expected):
        assert (~new[0].isfinite()).nonzero()[:, 0].tolist() == [7, 9]
        kept = torch.ones(50, dtype=torch.bool, device=device).index_fill_(0, torch.tensor([7, 9], device=device), 0)
        assert torch.equal(new[0][kept], old[0][kept])


def test_a_gradient_that_was_always_zero_moves_nothing(device):
    value = torch.ones(5, device=device, requires_grad=True)
    value.grad = torch.zeros_like(value)
    FusedAdam([value], eps=1e-15).step()
    assert torch.equal(value, torch.ones(5, device=device))


def test_resuming_changes_no_bit(device):
    """Through a file, and from a state of torch.optim.Adam."""
    start = draw(SHAPES, 0, torch.float32, device)
    whole = FusedAdam(groups_of(start), eps=1e-15)
    for step in range(3):
        take_step(whole, step)
    file = io.BytesIO()
    torch.save(whole.state_dict(), file)
    file.seek(0)
    resumed, translated, from_torch = (
        kind([{"params": [p.detach().clone().requires_grad_()]} for p in parameters_of(whole)])
        for kind in (FusedAdam, FusedAdam, Adam)
    )
    resumed.load_state_dict(torch.load(file))
    stored = copy.deepcopy(whole.state_dict())
    for state in stored["state"].values():
        state["step"] = torch.tensor(float(state["step"]))
    groups = from_torch.state_dict()["param_groups"]
    for group, ours in zip(groups, stored["param_groups"]):
        group |= ours
    from_torch.load_state_dict({"state": stored["state"], "param_groups": groups})
    translated.load_state_dict(from_torch.state_dict())
    for step in range(3, 5):
        for optimizer in (whole, resumed, translated):
            take_step(optimizer, step)
    for other in (resumed, translated):
        assert_bits([parameters_of(other)], [parameters_of(whole)])
        assert all(type(other.state[p]["step"]) is int for p in parameters_of(other))


def test_a_state_of_torch_keeps_the_heads_of_the_groups():
    parameter = torch.ones(3, 4, requires_grad=True)
    theirs = Adam([{"params": [parameter], "lr": 1e-4}])
    ours = FusedAdam([{"params": [parameter], "lr": 1e-4, "head": 1, "head_lr": 2.5e-3}])
    ours.load_state_dict(theirs.state_dict())
    assert (ours.param_groups[0]["head"], ours.param_groups[0]["head_lr"]) == (1, 2.5e-3)
    other = FusedAdam([{"params": [parameter], "lr": 1e-4, "head": 2, "head_lr": 1e-3}])
    other.load_state_dict(ours.state_dict())  # a state that has them goes before
    assert (other.param_groups[0]["head"], other.param_groups[0]["head_lr"]) == (1, 2.5e-3)


@pytest.mark.parametrize("option", [{"weight_decay": 0.1}, {"amsgrad": True}, {"maximize": True}])
def test_a_state_of_another_rule_is_refused(option):
    theirs = Adam([torch.ones(3, requires_grad=True)], **option)
    ours = FusedAdam([torch.ones(3, requires_grad=True)], lr=0.5)
    with pytest.raises(ValueError, match=f"FusedAdam has no {next(iter(option))}"):
        ours.load_state_dict(theirs.state_dict())
    assert ours.param_groups[0]["lr"] == 0.5


def test_closure_scheduler_and_zero_grad(device):
    value = torch.full((4,), 3.0, device=device, requires_grad=True)
    optimizer = FusedAdam([value], lr=0.5)
    schedule = torch.optim.lr_scheduler.ExponentialLR(optimizer, 0.1)

    def closure():
        optimizer.zero_grad()
        loss = value.square().sum()
        loss.backward()
        return loss

    assert optimizer.step(closure) == 36
    # The first step is lr in every direction.
    torch.testing.assert_close(value.detach(), torch.full((4,), 2.5, device=device))
    schedule.step()
    assert optimizer.param_groups[0]["lr"] == 0.05
    optimizer.zero_grad(set_to_none=False)
    assert (value.grad == 0).all()
    optimizer.zero_grad()
    assert value.grad is None


@pytest.mark.parametrize(
    "group, message",
    [
        ({"head": 1}, "a group with head needs head_lr, the learning rate of the head, got head 1 alone"),
        ({"head": 6, "head_lr": 0.1}, r"head is 6, but a parameter has shape \(4, 5, 3\)"),
    ],
)
def test_heads_that_cannot_be(group, message):
    value = torch.ones(4, 5, 3, requires_grad=True)
    value.grad = torch.ones_like(value)
    with pytest.raises(ValueError, match=message):
        FusedAdam([{"params": [value], **group}]).step()
    assert torch.equal(value, torch.ones_like(value))


def test_autograd_notices_that_parameters_have_changed(device):
    value = torch.ones(3, device=device, requires_grad=True)
    loss = value.square().sum()
    value.grad = torch.ones_like(value)
    FusedAdam([value]).step()
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        loss.backward()


def test_the_op_changes_no_parameter_under_autograd():
    state = make_state([(3,)])
    state[0][0].requires_grad_()
    with pytest.raises(RuntimeError, match="leaf Variable that requires grad"):
        adam_(*state, [0.1], [1], 0.9, 0.999, 1e-8)


def good_arguments(device="cpu"):
    state = dict(zip(LISTS, make_state([(4, 1), (4, 3)], device=device)))
    return state | {"rates": [0.1, 0.1], "steps": [1, 1], "beta1": 0.9, "beta2": 0.999, "eps": 1e-8}


def shared(lists):
    """The first moments are the second ones."""
    lists["exp_avgs"][1] = lists["exp_avg_sqs"][1]


def half_of_a_parameter(lists):
    """The first moments are columns of the matrix whose other columns, and one of theirs, are the parameter."""
    matrix = torch.ones(4, 5)
    lists["params"][1], lists["exp_avgs"][1] = matrix[:, :3], matrix[:, 2:]


def in_the_gradient(lists):
    lists["grads"][0] = lists["params"][1].view(-1)[:4].view(4, 1)


def replaced(name, k, tensor):
    return lambda arguments: arguments[name].__setitem__(k, tensor)


def given(**options):
    return lambda arguments: arguments.update(options)


DOUBLE, TURNED, SHARED = torch.ones(4, 3).double(), torch.ones(3, 4), torch.ones(6).as_strided((4, 3), (1, 1))


@pytest.mark.parametrize(
    "change, error, message",
    [
        (lambda a: a["grads"].pop(), ValueError, "grads must have as many members as params, 2, got 1"),
        (lambda a: a["rates"].append(1.0), ValueError, "rates must have as many members as params, 2, got 3"),
        (replaced("rates", 1, float("nan")), ValueError, r"rates\[1\] must be finite and not negative, got nan"),
        (replaced("rates", 1, -1.0), ValueError, r"rates\[1\] must be finite and not negative, got -1"),
        (replaced("steps", 1, 0), ValueError, r"steps\[1\] must be at least 1, got 0"),
        (given(beta1=1.0), ValueError, r"beta1 must be in \[0, 1\), got 1"),
        (given(beta2=-0.1), ValueError, r"beta2 must be in \[0, 1\), got -0.1"),
        (given(eps=float("inf")), ValueError, "eps must be finite and not negative, got inf"),
        (given(heads=[1, 1]), ValueError, "head_rates must have as many members as params, 2, got 0"),
        (given(heads=[1, 4], head_rates=[0.1, 0.1]), ValueError, r"heads\[1\] must be 0 to the size of a row"),
        (given(heads=[0, 1], head_rates=[0.1, -1.0]), ValueError, r"head_rates\[1\] must be finite"),
        (replaced("params", 0, torch.ones(4, 1).half()), TypeError, "params must have dtype float32 or float64"),
        (replaced("params", 1, DOUBLE), TypeError, r"params\[1\] must have the dtype of params\[0\]"),
        (replaced("exp_avgs", 1, DOUBLE), TypeError, r"exp_avgs\[1\] must have the dtype of params"),
        (replaced("grads", 1, TURNED), ValueError, r"grads\[1\] must have the shape .* \(4, 3\), got \(3, 4\)"),
        (replaced("params", 1, torch.ones(3).expand(4, 3)), ValueError, r"params\[1\] must have memory of its own"),
        (
            replaced("exp_avg_sqs", 1, SHARED),
            ValueError,
            r"exp_avg_sqs\[1\] must have memory .* \(4, 3\) with strides \(1, 1\)",
        ),
        (half_of_a_parameter, ValueError, "must not share memory"),
        (given(rows=torch.ones(4)), TypeError, "rows must have dtype bool or uint8, got Float"),
        (given(rows=torch.ones(3).bool()), ValueError, r"params\[0\] must have a row for each of rows, 3"),
        (given(rows=torch.ones(4, 1).bool()), ValueError, r"rows must have shape \(P,\), got \(4, 1\)"),
        (shared, ValueError, "must not share memory"),
        (in_the_gradient, ValueError, "must not share memory"),
        (lambda a: [a[name].append(a[name][0]) for name in (*LISTS, "rates", "steps")], ValueError, "must not share"),
    ],
)
def test_errors_are_raised_before_anything_is_touched(change, error, message):
    arguments = good_arguments()
    change(arguments)
    before = [[t.clone() for t in arguments[name]] for name in LISTS]
    with pytest.raises(error, match=message):
        adam_(**arguments)
    for name, tensors in zip(LISTS, before):
        assert all(torch.equal(a, b) for a, b in zip(arguments[name], tensors, strict=True))


def test_gradients_may_share_memory():
    """They are only read."""
    params, _, means, squares = make_state([(4,), (4,)])
    grad = torch.ones(4)
    adam_(params, [grad, grad], means, squares, [0.1, 0.1], [1, 1], 0.9, 0.999, 1e-8)


@pytest.mark.parametrize(
    "options, message",
    [
        ({"lr": -1.0}, "lr must be finite and not negative, got -1.0"),
        ({"lr": float("nan")}, "lr must be finite and not negative, got nan"),
        ({"betas": (0.9, 1.0)}, r"betas must be two numbers in \[0, 1\), got \(0.9, 1.0\)"),
        ({"betas": (0.9,)}, "betas must be two numbers"),
        ({"eps": -1e-8}, "eps must be finite and not negative, got -1e-08"),
    ],
)
def test_options_out_of_range(options, message):
    with pytest.raises(ValueError, match=message):
        FusedAdam([torch.ones(3, requires_grad=True)], **options)


def test_what_a_step_refuses():
    first, second = (torch.ones(3, requires_grad=True) for _ in range(2))
    first.grad, second.grad = torch.ones(3), torch.ones(3)
    with pytest.raises(ValueError, match=r"eps must be the same in all groups, got 1e-08 and 0.1"):
        FusedAdam([{"params": [first]}, {"params": [second], "eps": 0.1}]).step()
    with pytest.raises(ValueError, match=r"betas must be the same in all groups, got \(0.9, 0.999\) and \(0.5, 0.9\)"):
        FusedAdam([{"params": [first]}, {"params": [second], "betas": (0.5, 0.9)}]).step()
    optimizer = FusedAdam([first, second])
    with pytest.raises(TypeError, match="rows must be a tensor, got list"):
        optimizer.step(rows=[True, False, True])
    with pytest.raises(ValueError, match=r"params\[0\] must have a row for each of rows, 2, got shape \(3,\)"):
        optimizer.step(rows=torch.ones(2).bool())
    second.grad = torch.ones(3).to_sparse()
    with pytest.raises(ValueError, match="gradients must be dense, got layout"):
        optimizer.step()
    assert all(optimizer.state[p]["step"] == 0 and torch.equal(p, torch.ones(3)) for p in (first, second))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@needs_newer_compiler
def test_opcheck(device, dtype):
    state = make_state([(6, 3), (6,)], dtype, device)
    numbers = [0.1, 0.2], [1, 2], 0.9, 0.999, 1e-8
    rows = torch.tensor([1, 0, 1, 1, 0, 0], dtype=torch.bool, device=device)
    torch.library.opcheck(adam_, (*state, *numbers))
    torch.library.opcheck(adam_, (*state, *numbers, rows, False))
    torch.library.opcheck(adam_, ([reversed_strides(t) for t in state[0]], *state[1:], *numbers))


@needs_cuda
@pytest.mark.parametrize("name, k", [("grads", 1), ("exp_avgs", 0), ("params", 1)])
def test_cuda_tensors_beside_those_of_the_host(name, k):
    arguments = good_arguments("cuda")
    with pytest.raises(ValueError, match="rows must be on the device of params, got cpu"):
        adam_(**arguments, rows=torch.ones(4, dtype=torch.bool))
    arguments[name][k] = arguments[name][k].cpu()
    with pytest.raises(ValueError, match=rf"{name}\[{k}\] must be on the device of params\[0\], cuda:0, got cpu"):
        adam_(**arguments)


@needs_cuda
def test_cuda_launches_one_kernel():
    optimizer = FusedAdam(groups_of(draw(SHAPES, 0, torch.float32, "cuda")))
    take_step(optimizer, 1)
    for parameter, gradient in zip(parameters_of(optimizer), draw(SHAPES, 2, torch.float32, "cuda")):
        parameter.grad = gradient
    torch.cuda.synchronize()
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CUDA]) as profile:
        optimizer.step()
        torch.cuda.synchronize()
    kernels = [e.name for e in profile.events() if e.device_type == torch.autograd.DeviceType.CUDA]
    if not kernels:
        pytest.skip("the profiler sees no kernels on this machine")
    assert len(kernels) == 1 and "adam_kernel" in kernels[0], kernels


def test_it_is_found_from_the_package():
    assert ar.optim.FusedAdam is FusedAdam
