"""Density control: what grows, what moves, what goes, and that the optimizer follows."""

import math

import pytest
import torch
from marks import needs_cuda

from analytic_rasterizer import density, io
from analytic_rasterizer.cameras.rotations import rotation_matrices
from analytic_rasterizer.density import gradient, monte_carlo
from analytic_rasterizer.gaussians import Gaussians
from analytic_rasterizer.optim import FusedAdam
from analytic_rasterizer.training import TrainingOptions
from analytic_rasterizer.training import control as of_training
from analytic_rasterizer.training import rendering as g

observe = torch.ops.analytic_rasterizer.observe_.default
add_noise = torch.ops.analytic_rasterizer.add_noise_.default

EXTENT = 10.0
SMALL, LARGE, HUGE = 0.05, 0.5, 2.0  # scales that are cloned, split, and pruned once opacities were reset
STEP = 600  # one of growth


def make_gaussians(scales, opacities) -> Gaussians:
    """Gaussians at random places; scales and opacities are lists of P numbers."""
    generator = torch.Generator().manual_seed(3)
    count = len(scales)
    fields = Gaussians(
        torch.randn(count, 3, generator=generator),
        torch.tensor(scales).log()[:, None].repeat(1, 3),
        torch.randn(count, 4, generator=generator),
        torch.tensor(opacities).logit()[:, None],
        torch.randn(count, 9, 3, generator=generator),
    )
    return fields.map(torch.Tensor.requires_grad_)


def make_control(sizes, opacities, white_background=False, device="cpu", **options) -> density.FixedDensity:
    """A control whose optimizer has taken a step."""
    gaussians = make_gaussians(sizes, opacities).map(lambda field: field.detach().to(device).requires_grad_())
    optimizer = FusedAdam([{"params": [field]} for field in gaussians], lr=1e-3, eps=1e-15)
    for field in gaussians:
        field.grad = torch.randn(field.shape, generator=torch.Generator().manual_seed(4)).to(device)
    optimizer.step()
    options = TrainingOptions.preset("3dgs", **options)
    return of_training.make_density(options, gaussians, optimizer, EXTENT, white_background)


def after_step(control, norms, step=STEP, progress=0.1, radii=None) -> None:
    """As if a step's gradients by the projected means had these norms."""
    if control.watches:
        gradients = torch.zeros(len(norms), control.columns)
        columns = slice(2, 4) if control.columns == 4 else slice(0, 2)
        gradients[:, columns] = torch.tensor(norms)[:, None] * torch.tensor([0.6, -0.8])
        control.observe_gradients(gradients, torch.ones(len(norms), dtype=torch.int32) if radii is None else radii)
    control.after_step(step, progress)


def moments(control) -> dict[str, Gaussians]:
    state = control.optimizer.state
    return {
        name: control.gaussians.map(lambda field, name=name: state[field][name]) for name in ("exp_avg", "exp_avg_sq")
    }


def test_growth_and_pruning_of_a_few():
    """Kept as it is; cloned; split; pruned for its opacity."""
    control = make_control([SMALL, SMALL, LARGE, SMALL], [0.5, 0.6, 0.7, 0.004])
    before, moments_before = control.gaussians, moments(control)
    after_step(control, [1e-4, 3e-4, 3e-4, 1e-4])
    after, moments_after = control.gaussians, moments(control)

    assert all(len(field) == 5 and field.requires_grad and field.is_leaf for field in after)
    for old, new in zip(before, after):
        assert torch.equal(new[:3], old[[0, 1, 1]])  # the clone equals its original
    left, right = after.rows(slice(3, 4)), after.rows(slice(4, 5))
    parent = before.rows(slice(2, 3))
    for half in (left, right):
        torch.testing.assert_close(half.log_scales.exp(), parent.log_scales.exp() / 1.6)
        assert 0 < (half.means - parent.means).norm() < 5 * LARGE
        for name in ("rotations", "logit_opacities", "shs"):
            assert torch.equal(getattr(half, name), getattr(parent, name))
    assert not torch.equal(left.means, right.means)

    for name, fields in moments_after.items():
        for old, new in zip(moments_before[name], fields):
            assert torch.equal(new[:2], old[:2])
            assert (new[:2] != 0).all() and (new[2:] == 0).all()
    parameters = [group["params"] for group in control.optimizer.param_groups]
    assert all(len(held) == 1 and held[0] is field for held, field in zip(parameters, after))
    assert len(control.optimizer.state) == len(after)
    assert control.leaf().shape == (5, 3)
    assert (control.gradient_sums == 0).all() and (control.views == 0).all()


def test_optimizer_goes_on_with_the_new_rows():
    control = make_control([SMALL, LARGE], [0.5, 0.5])
    after_step(control, [1.0, 1.0])
    before = control.gaussians.map(lambda field: field.detach().clone())
    sum(field.sum() for field in control.gaussians).backward()
    control.optimizer.step()
    assert all((new != old).all() for old, new in zip(before, control.gaussians))


def test_gradients_are_averaged_over_the_views_that_saw_them():
    control = make_control([SMALL, SMALL], [0.5, 0.5])
    seen = torch.tensor([1, 0], dtype=torch.int32)
    after_step(control, [3e-4, 0.0], step=STEP - 2, radii=seen)  # what is not seen has no gradient
    after_step(control, [0.5e-4, 0.0], step=STEP - 1, radii=seen)
    torch.testing.assert_close(control.gradient_sums, torch.tensor([3.5e-4, 0.0]))
    assert control.views.tolist() == [2, 0]
    after_step(control, [0.0, 3e-4], radii=1 - seen)
    assert len(control.gaussians.means) == 3  # 1.75e-4 is below the threshold, 3e-4 above
    assert torch.equal(control.gaussians.means[2], control.gaussians.means[1])


@pytest.mark.parametrize("step, progress, count", [(500, 0.1, 1), (650, 0.1, 1), (600, 0.1, 2), (600, 0.5, 1)])
def test_growth_keeps_to_its_times(step, progress, count):
    control = make_control([SMALL], [0.5])
    after_step(control, [1.0], step, progress)
    assert len(control.gaussians.means) == count
    assert (control.leaf() is None) == (progress >= 0.5)


def test_limit_rises_evenly_and_lets_the_largest_gradients_grow():
    """From 4 to 8 in the first half of the training: to 6 after a quarter."""
    control = make_control([SMALL] * 4, [0.5] * 4, max_gaussians=8)
    before = control.gaussians.means
    after_step(control, [3e-4, 5e-4, 4e-4, 1e-4], progress=0.25)
    assert torch.equal(control.gaussians.means, before[[0, 1, 2, 3, 1, 2]])
    after_step(control, [1.0] * 6, step=STEP + 100, progress=0.25)
    assert len(control.gaussians.means) == 6
    after_step(control, [1.0] * 6, step=STEP + 200, progress=0.49)
    assert len(control.gaussians.means) == 7


@pytest.mark.parametrize("step, kept", [(3000, [SMALL, LARGE, HUGE]), (3100, [SMALL, LARGE])])
def test_large_gaussians_go_after_the_first_reset(step, kept):
    control = make_control([SMALL, LARGE, HUGE], [0.5] * 3)
    after_step(control, [0.0] * 3, step)
    assert control.gaussians.log_scales[:, 0].exp().tolist() == pytest.approx(kept, rel=0.02)


@pytest.mark.parametrize("step, white, lowered", [(3000, False, True), (500, False, False), (500, True, True)])
def test_opacities_are_lowered(step, white, lowered):
    control = make_control([SMALL, SMALL], [0.5, 0.007], white_background=white)
    before = control.gaussians.logit_opacities.sigmoid().tolist()
    after_step(control, [0.0, 0.0], step)
    after = control.gaussians.logit_opacities.sigmoid().tolist()
    assert after[0] == pytest.approx([0.01 if lowered else before[0][0]])
    assert after[1] == pytest.approx(before[1])
    for fields in moments(control).values():
        assert (fields.logit_opacities == 0).all() == lowered
        assert (fields.means != 0).all()


def test_halves_are_drawn_from_their_parent():
    """Mean and covariance of many halves' means, against five standard deviations of their estimates."""
    count = 20_000
    turn = torch.tensor([math.cos(0.4), 0.0, 0.0, math.sin(0.4)])  # 0.8 rad about z
    scales = torch.tensor([1.0, 0.2, 0.1])
    parent = make_gaussians([1.0], [0.5]).rows(slice(0, 1))
    parent = parent._replace(rotations=3 * turn[None], log_scales=scales.log()[None])
    parents = parent.map(lambda field: field.detach().repeat(count, *[1] * (field.dim() - 1)))
    halves = gradient.split(parents, torch.Generator().manual_seed(0))
    offsets = halves.means - parent.means
    c, s = math.cos(0.8), math.sin(0.8)
    axes = torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    along = offsets @ axes  # in the parent's frame
    assert (along.mean(0).abs() < 5 * scales / math.sqrt(2 * count)).all()
    covariance = along.T @ along / (2 * count)
    spread = torch.outer(scales, scales) * math.sqrt(2 / (2 * count))
    assert ((covariance - scales.square().diag()).abs() < 5 * spread).all()
    # The mass of a picture of a Gaussian is its opacity times the product of two scales.
    mass = halves.logit_opacities.sigmoid()[:, 0] * halves.log_scales[:, :2].exp().prod(1)
    assert mass.sum() / count == pytest.approx(2 / 1.6**2 * 0.5 * 0.2, rel=1e-5)


def test_absolute_gradients_are_read_from_their_own_columns():
    control = make_control([SMALL, SMALL], [0.5, 0.5], density="absgrad")
    assert control.leaf().shape == (2, 4)
    after_step(control, [2e-4, 4e-4])  # one below the threshold of 3e-4
    assert len(control.gaussians.means) == 3
    assert torch.equal(control.gaussians.means[2], control.gaussians.means[1])


def observed(count=300, columns=4, dtype=torch.float32, device="cpu"):
    """Arguments of the op: sums and views as they were, gradients and radii of a picture."""
    generator = torch.Generator().manual_seed(1)
    sums = torch.rand(count, generator=generator, dtype=torch.float64)
    gradients = torch.randn(count, columns, generator=generator, dtype=torch.float64)
    views, radii = (torch.randint(0, 3, (count,), generator=generator, dtype=torch.int32) for _ in range(2))
    return [sums.to(device, dtype), views.to(device), gradients.to(device, dtype), radii.to(device)]


@pytest.mark.parametrize("columns, first", [(3, 0), (4, 0), (4, 2)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_what_is_observed_of_a_picture(device, dtype, columns, first):
    sums, views, gradients, radii = observed(5000, columns, dtype, device)  # several work items
    lengths = gradients[:, first : first + 2].double().norm(dim=1)
    expected, seen = sums.double() + lengths, views + (radii > 0)
    observe(sums, views, gradients, radii, first)
    # Two squares, their sum and its root, 5 roundings at most, and the sum.
    u = torch.finfo(dtype).eps / 2
    assert ((sums.double() - expected).abs() <= 1.01 * u * (5 * lengths + expected)).all()
    assert torch.equal(views, seen) and views.dtype == torch.int32


@needs_cuda
def test_cuda_observes_the_bits_of_the_cpu():
    on_cpu, on_device = observed(), observed(device="cuda")
    for arguments in (on_cpu, on_device):
        observe(*arguments, 2)
    assert torch.equal(on_device[0].cpu(), on_cpu[0]) and torch.equal(on_device[1].cpu(), on_cpu[1])


def test_opcheck_of_observe(device):
    torch.library.opcheck(observe, (*observed(7, device=device), 2))


@pytest.mark.parametrize(
    "place, wrong, error, message",
    [
        (0, torch.zeros(7, 1), ValueError, r"gradient_sums must have shape \(P,\), contiguous, got \(7, 1\)"),
        (0, torch.zeros(7).half(), TypeError, "gradient_sums must have dtype float32 or float64"),
        (1, torch.zeros(7), TypeError, "views must have dtype int32, got Float"),
        (1, torch.zeros(6, dtype=torch.int32), ValueError, r"views must have shape \(P,\) with P = 7, got \(6,\)"),
        (2, torch.zeros(7, 2), ValueError, r"gradients must have shape \(P, 3\) or \(P, 4\) with P = 7, got \(7, 2\)"),
        (2, torch.zeros(7, 4).double(), TypeError, "gradients must have the dtype of gradient_sums"),
        (3, torch.zeros(8, dtype=torch.int32), ValueError, "radii must have shape"),
        (4, 3, ValueError, "first_column must be 0 to 2, got 3"),
        (4, -1, ValueError, "first_column must be 0 to 2, got -1"),
        (4, 2**63 - 1, ValueError, "first_column must be 0 to 2, got 9223372036854775807"),
    ],
)
def test_errors_of_observe(place, wrong, error, message):
    arguments = [*observed(7), 2]
    arguments[place] = wrong
    before = [arguments[0].clone(), arguments[1].clone()]
    with pytest.raises(error, match=message):
        observe(*arguments)
    assert torch.equal(arguments[0], before[0]) and torch.equal(arguments[1], before[1])


@pytest.mark.parametrize("written, read", [(0, 2), (1, 3), (0, 3), (0, 1)])
def test_what_observe_writes_to_is_apart_from_all_else(written, read):
    arguments = [*observed(7), 2]
    arguments[written] = arguments[read].view(-1)[:7].view(arguments[written].dtype)
    before = [argument.clone() for argument in arguments[:4]]
    with pytest.raises(ValueError, match="gradient_sums and views must not share memory"):
        observe(*arguments)
    assert all(map(torch.equal, arguments, before))


def noisy(count=300, dtype=torch.float32, device="cpu"):
    """Arguments of the op but the strength: Gaussians of all opacities and sizes, and normal numbers."""
    generator = torch.Generator().manual_seed(2)
    means, log_scales, quats, logits, normals = (
        torch.randn(count, width, generator=generator, dtype=torch.float64) for width in (3, 3, 4, 1, 3)
    )
    return [t.to(device, dtype) for t in (means, log_scales - 1, 3 * quats, 2 * logits - 5, normals)]


def with_noise(means, log_scales, quats, logits, normals, strength):
    """[MCMC, Eq. 8], and a bound of what its products add up."""
    strength = strength * torch.sigmoid(100 * (0.005 - logits.sigmoid()))
    axes, variances = rotation_matrices(quats), (2 * log_scales).exp()
    covariances = (axes * variances[:, None]) @ axes.transpose(1, 2)
    size = strength * variances.sum(1, keepdim=True) * normals.abs().sum(1, keepdim=True)
    return means + strength * (covariances @ normals[:, :, None])[:, :, 0], size


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_noise_is_that_of_its_formula(device, dtype):
    given = noisy(10_000, dtype, device)
    expected, size = with_noise(*(t.double().cpu() for t in given), 0.7)
    before = given[0].clone()
    add_noise(*given, 0.7)
    # 100 times an opacity, which is below 1 and good to 5 roundings, is in an exponent; 40 more are in the products.
    # The formula in float64 has no more.
    u = torch.finfo(dtype).eps / 2
    assert ((given[0].double().cpu() - expected).abs() <= 2 * u * (540 * size + expected.abs())).all()
    assert (given[0] != before).any(1).float().mean() > 0.5


def test_noise_of_strided_means_and_of_a_quaternion_of_zero(device):
    given = noisy(50, torch.float64, device)
    given[2][7] = 0  # the identity, as in rendering
    expected, _ = with_noise(*given, 0.5)
    rows = torch.zeros(50, 7, dtype=torch.float64, device=device)
    rows[:, 2:5] = given[0]
    add_noise(rows[:, 2:5], *given[1:], 0.5)
    torch.testing.assert_close(rows[:, 2:5], expected)
    assert (rows[:, [0, 1, 5, 6]] == 0).all()


def test_opcheck_of_noise(device):
    torch.library.opcheck(add_noise, (*noisy(7, device=device), 0.5))


@pytest.mark.parametrize(
    "place, wrong, error, message",
    [
        (0, torch.zeros(7, 2), ValueError, r"means must have shape \(N, 3\), got \(7, 2\)"),
        (0, torch.zeros(7, 3).half(), TypeError, "means must have dtype float32 or float64"),
        (0, torch.zeros(1, 3).expand(7, 3), ValueError, "means must not share memory"),
        (1, torch.zeros(6, 3), ValueError, r"log_scales must have shape \(N, 3\) with N = 7, got \(6, 3\)"),
        (2, torch.zeros(7, 4).double(), TypeError, "quats must have the dtype of means"),
        (3, torch.zeros(7), ValueError, "logit_opacities must have shape"),
        (4, torch.zeros(7, 4), ValueError, "normals must have shape"),
        (5, math.nan, ValueError, "strength must be finite and not negative, got nan"),
    ],
)
def test_errors_of_noise(place, wrong, error, message):
    arguments = [*noisy(7), 0.5]
    arguments[place] = wrong
    before = arguments[0].clone()
    with pytest.raises(error, match=message):
        add_noise(*arguments)
    assert torch.equal(arguments[0], before)


def test_noise_is_not_read_from_where_it_is_written():
    arguments = [*noisy(7), 0.5]
    arguments[4] = arguments[0]
    with pytest.raises(ValueError, match="means must not share memory with the others"):
        add_noise(*arguments)


def picture_of(gaussians) -> torch.Tensor:
    """Of means at the origin, with constant colours; exact where splats lie at the same place and depth."""
    view = io.View("", 48, 48, 60.0, 60.0, torch.eye(4, dtype=torch.float64))
    view.w2c[2, 3] = 3.0
    count = len(gaussians.means)
    constant = gaussians._replace(shs=torch.ones(count, 1, 3))
    with torch.no_grad():
        return g.render(constant.arguments(), view.settings(sh_degree=0, footprint="point:dilation=0"))[0]


def test_relocation_leaves_the_middle_of_a_splat_as_it_was():
    """What dies goes to what lives. In the middle of a splat k of opacity o' make the o of one [MCMC, Eq. 8]."""
    control = make_control([0.3, 0.3, 0.3], [0.6, 0.001, 0.002], density="mcmc", noise=0.0, max_gaussians=3)
    with torch.no_grad():
        control.gaussians.means.zero_()
        control.gaussians.rotations.copy_(torch.tensor([[1.0, 0, 0, 0]]).expand(3, 4))
    alone = picture_of(control.gaussians.rows(slice(0, 1)))
    assert control.after_step(STEP, 0.1)
    after = control.gaussians
    opacities = after.logit_opacities.sigmoid()[:, 0]
    torch.testing.assert_close(opacities, torch.full((3,), 1 - (1 - 0.6) ** (1 / 3)), atol=2e-3, rtol=0)
    assert all(torch.equal(field, field[:1].expand_as(field)) for field in after)
    # The step that the optimizer took before moves the opacity by 1e-3 and colours are shared: 3 levels of 255.
    assert (picture_of(after) - alone)[:, 23:25, 23:25].abs().max() < 3 / 255
    assert all((fields.means == 0).all() for fields in moments(control).values())


def test_addition_stops_at_the_limit():
    control = make_control([SMALL] * 40, [0.5] * 40, density="mcmc", max_gaussians=43, noise=0.0)
    assert control.after_step(STEP, 0.1) and len(control.gaussians.means) == 42  # 5% more
    sum(field.sum() for field in control.gaussians).backward()
    control.optimizer.step()
    assert control.after_step(STEP + 100, 0.1) and len(control.gaussians.means) == 43
    assert control.after_step(STEP + 200, 0.1) and len(control.gaussians.means) == 43
    assert not control.after_step(STEP + 300, 0.6)  # growth is over


def test_noise_follows_the_covariance_and_spares_the_opaque():
    """Along every axis of a Gaussian the standard deviation of its noise is the axis's variance times a constant."""
    count, rate = 20_000, 1e-3
    control = make_control([1.0] * count, [0.001] * count, density="mcmc", noise=5.0, max_gaussians=count)
    control.optimizer.param_groups[0]["lr"] = rate
    scales, turn = torch.tensor([1.0, 0.5, 0.2]), torch.tensor([0.3, -0.5, 0.7, 0.2])
    with torch.no_grad():
        control.gaussians.log_scales.copy_(scales.log().expand(count, 3))
        control.gaussians.rotations.copy_(turn.expand(count, 4))
        control.gaussians.logit_opacities[count // 2 :] = 5.0  # opaque
    before = control.gaussians.means.detach().clone()
    control.after_step(1, 0.0)
    moved = (control.gaussians.means.detach() - before) @ rotation_matrices(turn)  # in the Gaussian's frame
    transparent, opaque = moved.split(count // 2)
    strength = 5.0 * rate * (5 / EXTENT) ** 2 * torch.sigmoid(torch.tensor(100 * (0.005 - 0.001)))
    # 2.5% is five standard deviations of the estimate from 10,000; the step before moved opacities by 0.1%.
    torch.testing.assert_close(transparent.std(0), strength * scales**2, rtol=0.03, atol=0)
    assert opaque.abs().max() < 1e-6


def test_mcmc_trains_alike_in_other_units():
    """Millimetres in place of metres: noise and gradients of the regularizers, as shares of the lengths."""
    moved, weights = [], []
    for unit in (1.0, 1000.0):
        gaussians = make_gaussians([0.3 * unit] * 50, [0.1] * 50)
        optimizer = FusedAdam([{"params": [field]} for field in gaussians], lr=1e-3 * unit, eps=1e-15)
        options = TrainingOptions(density="mcmc")
        control = of_training.make_density(options, gaussians, optimizer, 2.0 * unit)
        before = control.gaussians.means.detach().clone()
        control.after_step(1, 0.0)
        moved.append((control.gaussians.means.detach() - before) / unit)
        opacity_weight, scale_weight = of_training.regularizers_of(options, 2.0 * unit)
        weights.append((opacity_weight, scale_weight * unit))  # times a mean scale in metres
    assert moved[0].norm() > 0.1
    torch.testing.assert_close(*moved, rtol=1e-4, atol=1e-5)
    assert weights[0] == pytest.approx(weights[1]) == (0.01, 0.025)


def test_draws_follow_the_weights(device):
    """Frequencies of rows, against five standard deviations; rows of weight 0 are never drawn."""
    weights = torch.tensor([0.5, 0.0, 0.25, 1.0, 0.0], device=device)
    rows = monte_carlo.draw(weights, 70_000, torch.Generator(device).manual_seed(1))
    counts = rows.bincount(minlength=5).cpu()
    expected = 70_000 * weights.cpu() / weights.sum().cpu()
    assert ((counts - expected).abs() <= 5 * expected.sqrt()).all()
    again = monte_carlo.draw(weights, 70_000, torch.Generator(device).manual_seed(1))
    assert torch.equal(rows, again)


@pytest.mark.parametrize("kind", ["3dgs", "absgrad", "mcmc"])
def test_all_kinds_grow_on_the_device(device, kind):
    control = make_control([SMALL, LARGE, SMALL], [0.5, 0.5, 0.001], device=device, density=kind, max_gaussians=20)
    for step in range(590, 601):
        if control.watches:
            count = len(control.gaussians.means)
            control.observe_gradients(
                torch.ones(count, control.columns, device=device), torch.ones(count, dtype=torch.int32, device=device)
            )
        control.after_step(step, 0.1)
    assert len(control.gaussians.means) == (3 if kind == "mcmc" else 4)  # 5% of three is none
    assert all(field.device.type == device and field.isfinite().all() for field in control.gaussians)


@pytest.mark.parametrize("footprint", ["point:dilation=0", "analytic", "box:samples=4"])
def test_gradient_that_grows_does_not_depend_on_the_scale(footprint):
    """A splat of many pixels: dL/d(means2D) of a mean over the picture, at full and half size."""
    view = io.View("", 64, 48, 60.0, 60.0, torch.eye(4, dtype=torch.float64))
    gradients = []
    for scale in (1, 2):
        gaussian = make_gaussians([0.3] * 4, [0.1] * 4)._replace(means=torch.tensor([[0.1, 0.2, 3.0]] * 4))
        means2D = torch.zeros(4, 3, requires_grad=True)
        settings = view.settings(1 / scale, sh_degree=0, footprint=footprint)
        picture, _ = g.render(gaussian._replace(shs=torch.ones(4, 1, 3)).arguments(), settings, means2D)
        (picture * torch.linspace(0, 1, picture.shape[2])).mean().backward()
        gradients.append(means2D.grad[0, 0].item())
    assert gradients[1] == pytest.approx(gradients[0], rel=0.05)
