"""The reference against things that are even more basic than it is.

The rest of the suite trusts reference.py; this file says why. None of it imports the library.
"""

import math

import reference
import scenes
import torch


def generic_splats(seed, count=200, sigma=(0.1, 5.0), ratio=(1.2, 50.0)):
    g = torch.Generator().manual_seed(seed)
    cov2d = scenes.random_cov2d(g, count, sigma, ratio)
    return scenes.random_offsets(g, cov2d), cov2d


def test_exact_weight_against_plain_quadrature():
    """The definition, by a 2D product rule that knows neither erf nor conditional variances.

    32 panels of 12 nodes per axis: panels of 1/32 px against deviations >= 0.04 px.
    """
    nodes, weights = reference.legendre(12)
    grid = (torch.arange(32)[:, None] + (nodes + 1) / 2).reshape(-1) / 32 - 0.5
    measure = weights.repeat(32) / 64
    points = torch.stack(torch.meshgrid(grid, grid, indexing="ij"), -1)
    offset, cov2d = generic_splats(0, count=20, sigma=(0.04, 3.0))
    for d, c in zip(offset, cov2d, strict=True):
        values = reference.gaussian(d + points, c)
        truth = torch.einsum("xy,x,y->", values, measure, measure)
        assert (reference.exact_weight(d, c) - truth).abs() < 1e-13


def test_exact_weight_has_converged():
    """Doubling the nodes changes nothing down to deviations of 0.02 px and ratios of 100."""
    offset, cov2d = generic_splats(1, sigma=(0.02, 5.0), ratio=(1.0, 100.0))
    once = reference.exact_weight(offset, cov2d)
    twice = reference.exact_weight(offset, cov2d, panels=128)
    assert (once - twice).abs().max() < 1e-13


def test_exact_weight_derivatives_are_heat_equation():
    """NUMERICS: dI/dSigma = (Sigma^-1 I + Hessian I)/2, a fact about the integral alone."""
    offset, cov2d = generic_splats(2, count=20, sigma=(0.3, 2.0), ratio=(1.2, 4.0))
    offset.requires_grad_()
    cov2d.requires_grad_()
    value = reference.exact_weight(offset, cov2d)
    first, by_cov = torch.autograd.grad(value.sum(), (offset, cov2d), create_graph=True)
    hess_x = torch.autograd.grad(first[:, 0].sum(), offset, retain_graph=True)[0]
    hess_y = torch.autograd.grad(first[:, 1].sum(), offset, retain_graph=True)[0]
    xx, xy, yy = cov2d.unbind(-1)
    det = reference.determinant(cov2d)
    by_xx, by_yy = (yy / det * value + hess_x[:, 0]) / 2, (xx / det * value + hess_y[:, 1]) / 2
    by_xy = -xy / det * value + hess_x[:, 1]  # S12 stands for both off-diagonal entries
    expected = torch.stack([by_xx, by_xy, by_yy], -1)
    assert (by_cov - expected).abs().max() < 1e-10


def test_frozen_window_is_the_integral_over_a_window_that_stays():
    """With the exact CDF, the frozen derivative is that of a bivariate integral.

    The window is the pixel turned by the eigenframe of the *unperturbed* Sigma; in that frame the
    pixel is axis-aligned and the perturbed Sigma correlated: exactly exact_weight.
    """
    offset, cov2d = generic_splats(3)
    cov2d.requires_grad_()
    offset.requires_grad_()
    frozen = reference.rotated_window(offset, cov2d, "frozen", reference.normal_window, reference.normal_pdf)
    matrix = torch.stack([cov2d[:, [0, 1]], cov2d[:, [1, 2]]], -2)
    axes = torch.linalg.eigh(matrix.detach()).eigenvectors
    turned = axes.transpose(-1, -2) @ matrix @ axes
    inside = torch.stack([turned[:, 0, 0], turned[:, 0, 1], turned[:, 1, 1]], -1)
    truth = reference.exact_weight((axes.transpose(-1, -2) @ offset[..., None])[..., 0], inside)
    assert (frozen - truth).abs().max() < 1e-13
    gradients = (torch.autograd.grad(total.sum(), (offset, cov2d)) for total in (frozen, truth))
    for ours, theirs in zip(*gradients, strict=True):
        assert (ours - theirs).abs().max() < 1e-11 * max(1, theirs.abs().max())


def test_frozen_window_by_finite_differences_of_the_correlated_integral():
    """The same once more without autograd: perturb S12 in the eigenframe, integrate, subtract."""
    offset = torch.tensor([0.4, -0.7], dtype=torch.float64)
    cov2d = torch.tensor([0.81, 0.0, 0.25], dtype=torch.float64, requires_grad=True)
    frozen = reference.rotated_window(offset, cov2d, "frozen", reference.normal_window, reference.normal_pdf)
    slope = torch.autograd.grad(frozen, cov2d)[0][1].item()
    step = torch.tensor([0.0, 1e-4, 0.0], dtype=torch.float64)
    plus = reference.exact_weight(offset, cov2d.detach() + step)
    minus = reference.exact_weight(offset, cov2d.detach() - step)
    # Central differences: truncation ~ step^2 * third derivative ~ 1e-8 * 30.
    assert abs((plus - minus).item() / 2e-4 - slope) < 1e-6


def test_logistic_cdf_is_within_the_papers_error():
    """|S - Phi| stays below 4e-4, the figure the project documents."""
    x = torch.linspace(-12, 12, 200001, dtype=torch.float64)
    assert (reference.logistic_cdf(x) - reference.normal_cdf(x)).abs().max() < 4e-4
    slope = torch.autograd.grad(reference.logistic_cdf(x.requires_grad_()).sum(), x)[0]
    assert (slope - reference.logistic_pdf(x)).abs().max() < 1e-14


def test_logistic_window_is_the_difference_of_the_cdf():
    g = torch.Generator().manual_seed(4)
    sigma = torch.exp(scenes.rand(g, 2000, low=-3.0, high=2.0))
    u = scenes.rand(g, 2000, low=-4.0, high=4.0) * (sigma + 0.5)
    plain = reference.logistic_cdf((u + 0.5) / sigma) - reference.logistic_cdf((u - 0.5) / sigma)
    assert (reference.logistic_window(u, sigma) - plain).abs().max() < 1e-15


def test_spherical_harmonics_are_orthonormal():
    """Integral of Y_i Y_j over the sphere, by a product rule exact for degree 6."""
    nodes, weights = reference.legendre(8)
    angle = torch.arange(16, dtype=torch.float64) * (2 * math.pi / 16)
    z = nodes[:, None].expand(8, 16)
    r = torch.sqrt(1 - z * z)
    direction = torch.stack([r * torch.cos(angle), r * torch.sin(angle), z], -1).reshape(-1, 3)
    measure = (weights[:, None] * (2 * math.pi / 16)).expand(8, 16).reshape(-1)
    basis = reference.spherical_harmonics(3, direction)
    gram = torch.einsum("ni,nj,n->ij", basis, basis, measure)
    assert (gram - torch.eye(16, dtype=torch.float64)).abs().max() < 1e-13


def test_rotation_matrix():
    """(w, x, y, z): a quarter turn about z takes x to y; unnormalised input; zero is identity."""
    q = torch.tensor([[2.0, 0, 0, 2.0], [0, 0, 0, 0]], dtype=torch.float64, requires_grad=True)
    turn, identity = reference.rotation_matrix(q)
    x = torch.tensor([1.0, 0, 0], dtype=torch.float64)
    assert (turn @ x - torch.tensor([0.0, 1.0, 0.0])).abs().max() < 1e-15
    assert torch.equal(identity, torch.eye(3, dtype=torch.float64))
    turn.sum().backward()
    assert torch.equal(q.grad[1], torch.zeros(4, dtype=torch.float64))


def test_projection_is_the_linearised_pinhole():
    """cov2d = D cov3d D^T with D the numerical derivative of the pixel position (no clamp)."""
    camera = scenes.Camera(shift=(3.0, -2.0))
    settings = SettingsView(camera)
    g = torch.Generator().manual_seed(0)
    means = scenes.rand(g, 5, 3, low=-0.5, high=0.5)
    covariance = reference.covariance_3d(scenes.rand(g, 5, 3), scenes.rand(g, 5, 4), 1.0)
    projection = reference.project(settings, means, covariance)

    def position(mean):
        return reference.project(settings, mean[None], covariance[:1]).means2d[0]

    for i in range(5):
        derivative = torch.autograd.functional.jacobian(position, means[i])
        full = derivative @ covariance[i] @ derivative.T
        expected = torch.stack([full[0, 0], full[0, 1], full[1, 1]])
        assert (projection.cov2d[i] - expected).abs().max() < 1e-11 * full.abs().max()


def test_pixel_convention():
    """The optical axis lands at ((W - 1)/2, (H - 1)/2), plus the shift of the principal point."""
    camera = scenes.Camera(shift=(3.0, -2.0))
    target = torch.tensor([camera.target], dtype=torch.float64)
    mean = reference.project(SettingsView(camera), target, torch.zeros(1, 3, 3).double()).means2d
    assert (mean - torch.tensor([[22.0 + 3, 18.0 - 2]])).abs().max() < 1e-12


class SettingsView:
    """The settings of a camera as attributes, without the library."""

    def __init__(self, camera):
        self.__dict__.update(camera.fields())
