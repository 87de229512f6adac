"""The density control of the example that trains: what grows, what goes, and that the optimizer follows."""

import math

import pytest
import torch

import densify
import gaussians as g
from analytic_rasterizer import io

EXTENT = 10.0
SMALL, LARGE, HUGE = 0.05, 0.5, 2.0  # scales that are cloned, split, and pruned once opacities were reset
STEP = 600  # one of growth


def make_gaussians(scales, opacities) -> g.Gaussians:
    """Gaussians at random places; scales and opacities are lists of P numbers."""
    generator = torch.Generator().manual_seed(3)
    count = len(scales)
    fields = g.Gaussians(
        torch.randn(count, 3, generator=generator),
        torch.tensor(scales).log()[:, None].repeat(1, 3),
        torch.randn(count, 4, generator=generator),
        torch.tensor(opacities).logit()[:, None],
        torch.randn(count, 1, 3, generator=generator),
        torch.randn(count, 8, 3, generator=generator),
    )
    return g.Gaussians(*(field.requires_grad_() for field in fields))


def make_control(scales, opacities, white_background=False, **options) -> densify.DensityControl:
    """A control whose optimizer has taken a step."""
    gaussians = make_gaussians(scales, opacities)
    optimizer = g.make_optimizer(gaussians, EXTENT)
    for field in gaussians:
        field.grad = torch.randn(field.shape, generator=torch.Generator().manual_seed(4))
    optimizer.step()
    return densify.DensityControl(gaussians, optimizer, EXTENT, densify.DensityOptions(**options), white_background)


def after_step(control, norms, step=STEP, progress=0.1, radii=None) -> None:
    """As if a step's gradients by the projected means had these norms."""
    control.means2D.grad = torch.tensor(norms)[:, None] * torch.tensor([0.6, -0.8, 0.0])
    control.after_step(step, progress, torch.ones(len(norms), dtype=torch.int32) if radii is None else radii)


def moments(control) -> dict[str, g.Gaussians]:
    state = control.optimizer.state
    return {
        name: g.Gaussians(*(state[field][name] for field in control.gaussians)) for name in ("exp_avg", "exp_avg_sq")
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
    left, right = densify.select(after, slice(3, 4)), densify.select(after, slice(4, 5))
    parent = densify.select(before, slice(2, 3))
    for half in (left, right):
        torch.testing.assert_close(half.log_scales.exp(), parent.log_scales.exp() / 1.6)
        assert 0 < (half.means - parent.means).norm() < 5 * LARGE
        for name in ("rotations", "logit_opacities", "sh_dc", "sh_rest"):
            assert torch.equal(getattr(half, name), getattr(parent, name))
    assert not torch.equal(left.means, right.means)

    for name, fields in moments_after.items():
        for old, new in zip(moments_before[name], fields):
            assert torch.equal(new[:2], old[:2])
            assert (new[:2] != 0).all() and (new[2:] == 0).all()
    parameters = [group["params"] for group in control.optimizer.param_groups]
    assert all(len(held) == 1 and held[0] is field for held, field in zip(parameters, after))
    assert len(control.optimizer.state) == len(after)
    assert control.means2D.shape == (5, 3)
    assert (control.gradient_sums == 0).all() and (control.views == 0).all()


def test_optimizer_goes_on_with_the_new_rows():
    control = make_control([SMALL, LARGE], [0.5, 0.5])
    after_step(control, [1.0, 1.0])
    before = densify.Gaussians(*(field.detach().clone() for field in control.gaussians))
    sum(field.sum() for field in control.gaussians).backward()
    control.optimizer.step()
    assert all((new != old).all() for old, new in zip(before, control.gaussians))


def test_gradients_are_averaged_over_the_views_that_saw_them():
    control = make_control([SMALL, SMALL], [0.5, 0.5])
    seen = torch.tensor([1, 0], dtype=torch.int32)
    after_step(control, [3e-4, 3e-4], step=STEP - 2, radii=seen)
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
    assert (control.means2D is None) == (progress >= 0.5)


def test_cap_lets_the_largest_gradients_grow():
    control = make_control([SMALL] * 4, [0.5] * 4, most=6)
    before = control.gaussians.means
    after_step(control, [3e-4, 5e-4, 4e-4, 1e-4])
    assert torch.equal(control.gaussians.means, before[[0, 1, 2, 3, 1, 2]])
    after_step(control, [1.0] * 6, step=STEP + 100)
    assert len(control.gaussians.means) == 6


@pytest.mark.parametrize("step, kept", [(3000, [SMALL, HUGE]), (3100, [SMALL])])
def test_large_gaussians_go_after_the_first_reset(step, kept):
    control = make_control([SMALL, HUGE], [0.5, 0.5])
    after_step(control, [0.0, 0.0], step)
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
    parent = densify.select(make_gaussians([1.0], [0.5]), slice(0, 1))
    parent = parent._replace(rotations=3 * turn[None], log_scales=scales.log()[None])
    parents = g.Gaussians(*(field.detach().repeat(count, *[1] * (field.dim() - 1)) for field in parent))
    halves = densify.split(parents, torch.Generator().manual_seed(0))
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


@pytest.mark.parametrize("footprint", ["point:dilation=0", "analytic", "box:samples=4"])
def test_gradient_that_grows_does_not_depend_on_the_scale(footprint):
    """A splat of many pixels: dL/d(means2D) of a mean over the picture, at full and half size."""
    view = io.View("", 64, 48, 60.0, 60.0, torch.eye(4, dtype=torch.float64))
    gradients = []
    for scale in (1, 2):
        gaussian = g.gaussians_at(torch.tensor([[0.1, 0.2, 3.0]] * 4), torch.rand(4, 3), 0)
        gaussian = gaussian._replace(log_scales=torch.full((4, 3), 0.3).log())
        means2D = torch.zeros(4, 3, requires_grad=True)
        settings = view.settings(1 / scale, sh_degree=0, footprint=footprint)
        picture, _ = gaussian._replace(sh_dc=torch.ones(4, 1, 3)).render(settings, means2D)
        (picture * torch.linspace(0, 1, picture.shape[2])).mean().backward()
        gradients.append(means2D.grad[0, 0].item())
    assert gradients[1] == pytest.approx(gradients[0], rel=0.05)
