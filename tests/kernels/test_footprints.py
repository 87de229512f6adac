"""The weight of one splat in one pixel: every footprint, through ar.footprint_weight."""

import math

import pytest
import reference
import scenes
import torch
from scenes import VARIANTS, name_of

import analytic_rasterizer as ar
from analytic_rasterizer import footprints

EPS64 = torch.finfo(torch.float64).eps
EPS32 = torch.finfo(torch.float32).eps

every_footprint = pytest.mark.parametrize("variant", VARIANTS, ids=name_of)
# "paper" is the derivative of the formula; "frozen", and with it erf, on purpose is not.
FROZEN = [("analytic", {"frame_gradient": "frozen"}), ("erf", {})]
every_true_derivative = pytest.mark.parametrize("variant", [v for v in VARIANTS if v not in FROZEN], ids=name_of)
GAUSSIANS = ("point", "mip", "box", "moment")
closed_form = pytest.mark.parametrize("variant", [v for v in VARIANTS if v[0] in GAUSSIANS], ids=name_of)


def weight(device, offset, cov2d, footprint, **options):
    """ar.footprint_weight computed on `device`, from and to tensors on the CPU; differentiable. The footprint may have
    its options with it."""
    if isinstance(footprint, tuple):
        footprint, options = footprint
    value = ar.footprint_weight(offset.to(device), cov2d.to(device), footprint, **options)
    assert value.device.type == device
    return value.cpu()


def expected_weight(offset, cov2d, variant):
    """The weight by the reference."""
    return reference.weight(offset, cov2d, variant[0], **variant[1])


def generator(seed):
    return torch.Generator().manual_seed(seed)


def splats(seed, count=400, sigma=(0.05, 20.0), ratio=(1.05, 100.0), reach=4.0):
    """Random offsets (count, 2) and covariances (count, 3)."""
    g = generator(seed)
    cov2d = scenes.random_cov2d(g, count, sigma, ratio)
    return scenes.random_offsets(g, cov2d, reach), cov2d


def eigenvalues(cov2d):
    """(larger, smaller)."""
    xx, xy, yy = cov2d.unbind(-1)
    larger = (xx + yy) / 2 + torch.hypot((xx - yy) / 2, xy)
    return larger, reference.determinant(cov2d) / larger


def condition(cov2d):
    larger, smaller = eigenvalues(cov2d)
    return larger / smaller


def added_variance(variant):
    """Variance the footprint adds to Sigma, nodes of `box` included."""
    footprint, options = variant
    options = reference.settled(footprint, options)
    if footprint == "point":
        return options["dilation"]
    return {"mip": options.get("variance")}.get(footprint, 1 / 12)


def rounding_bound(offset, cov2d, variant, eps):
    """What rounding may do to a weight whose inputs are exact.

    An entry of the conic, and det, cancel: their relative error is up to a few eps * condition
    number. q therefore errs by ~8 eps cond q and the weight by max(q/2 exp(-q/2)) = 0.37 of that;
    the amplitude by 1.5 eps cond(Sigma), times the weight. `analytic` takes the small eigenvalue
    from the same det; its angle errs by eps l1/(l1 - l2) < 11 eps at the ratios used here, which
    moves v by that times |u| <= 4 s1, that is by 44 eps sqrt(cond) deviations. `erf` does the same.
    `exact` has Sigma itself for a conic; the reference's quadrature adds 1e-13.
    """
    footprint, _ = variant
    value = expected_weight(offset, cov2d, variant)
    raw = condition(cov2d)
    if footprint in ("analytic", "erf"):
        return eps * (16 * raw + 44 * torch.sqrt(raw))
    if footprint == "exact":
        return 16 * eps * raw + 1e-13
    smallest_added = {
        "point": added_variance(variant),
        "mip": added_variance(variant),
        "cumulant": 1 / 12,
        "box": reference.box_variance(variant[1].get("samples", 4)),
        "moment": 1 / (12 * variant[1].get("samples", 4)),
    }[footprint]
    return 16 * eps * (condition(reference.add_variance(cov2d, smallest_added)) + value * raw)


# --- values and gradients -----------------------------------------------------------------------


def test_registry_holds_ours_and_all_options_are_tested():
    known = {"point", "mip", "analytic", "cumulant", "box", "moment", "erf", "exact"}
    assert known <= set(ar.FOOTPRINTS)
    assert set(scenes.OPTIONS) <= set(footprints.OPTIONS)
    assert set(footprints.OPTIONS) - set(scenes.OPTIONS) <= set(ar.FOOTPRINTS) - set(reference.DEFAULT_OPTIONS)


@every_footprint
def test_weight_matches_reference(device, variant):
    offset, cov2d = splats(0)
    actual = weight(device, offset, cov2d, variant)
    expected = expected_weight(offset, cov2d, variant)
    excess = (actual - expected).abs() / rounding_bound(offset, cov2d, variant, EPS64)
    assert excess.max() < 1, (actual - expected).abs().max()


@every_footprint
def test_default_options(device, variant):
    footprint, _ = variant
    offset, cov2d = splats(1, count=20)
    explicit = weight(device, offset, cov2d, footprint=footprint, **reference.settled(footprint, {}))
    assert torch.equal(weight(device, offset, cov2d, footprint=footprint), explicit)


@every_footprint
def test_options_in_the_name(device, variant):
    footprint, options = variant
    offset, cov2d = splats(1, count=20)
    spelled = ":".join([footprint, ",".join(f"{k}={v}" for k, v in options.items())]).rstrip(":")
    keywords = weight(device, offset, cov2d, variant)
    assert torch.equal(weight(device, offset, cov2d, footprint=spelled), keywords)


@every_footprint
def test_vjp_matches_autograd_of_reference(device, variant):
    """Includes `frozen`, whose reference is the window that does not turn."""
    offset, cov2d = splats(2, sigma=(0.1, 10.0), ratio=(1.1, 30.0))
    g = scenes.rand(generator(3), len(offset), low=-1.0)
    results = []
    for call in (
        lambda d, c: weight(device, d, c, variant),
        lambda d, c: expected_weight(d, c, variant),
    ):
        d, c = offset.clone().requires_grad_(), cov2d.clone().requires_grad_()
        results.append(torch.autograd.grad((call(d, c) * g).sum(), (d, c)))
    # Per splat, relative to that splat's gradient (whose natural size is 1/s2 and 1/l2), with a
    # floor where the gradient itself vanishes. Rounding: eps * cond (900) * l1/(l1 - l2) (6) ~
    # 1e-12.
    _, smaller = eigenvalues(cov2d)
    for ours, theirs, unit in zip(*results, (smaller**-0.5, 1 / smaller), strict=True):
        size = theirs.norm(dim=-1) + 1e-3 * unit * g.abs()
        assert ((ours - theirs).norm(dim=-1) / size).max() < 1e-9


@every_true_derivative
def test_vjp_matches_central_differences(variant):
    """The library against itself: step 1e-6, so 1e-12 * f''' + 1e-16/1e-6 ~ 1e-9 of noise."""
    offset, cov2d = splats(4, count=30, sigma=(0.4, 3.0), ratio=(1.2, 4.0), reach=2.5)
    assert torch.autograd.gradcheck(
        lambda d, c: ar.footprint_weight(d, c, variant[0], **variant[1]),
        (offset.requires_grad_(), cov2d.requires_grad_()),
        eps=1e-6,
        atol=1e-7,
        rtol=1e-6,
    )


def test_frozen_and_paper_share_value_and_mean_gradient(device):
    offset, cov2d = splats(5)
    results = []
    for frame_gradient in ("frozen", "paper"):
        d, c = offset.clone().requires_grad_(), cov2d.clone().requires_grad_()
        value = weight(device, d, c, footprint="analytic", frame_gradient=frame_gradient)
        results.append((value, *torch.autograd.grad(value.sum(), (d, c))))
    (value, by_offset, by_cov), (paper_value, paper_by_offset, paper_by_cov) = results
    assert torch.equal(value, paper_value)
    assert torch.equal(by_offset, paper_by_offset)
    # The derivative along the eigenvalues is the same; only the turn differs, which is off-diagonal
    # in the eigenframe and so has no trace with the projectors v1 v1^T and v2 v2^T.
    matrix = torch.stack([cov2d[:, [0, 1]], cov2d[:, [1, 2]]], -2)
    axes = torch.linalg.eigh(matrix).eigenvectors
    difference = by_cov - paper_by_cov
    size = by_cov.norm(dim=-1) + paper_by_cov.norm(dim=-1)
    for k in range(2):
        v = axes[..., k]
        along = difference[:, 0] * v[:, 0] ** 2 + difference[:, 2] * v[:, 1] ** 2
        along = along + difference[:, 1] * v[:, 0] * v[:, 1]
        assert (along.abs() <= 1e-9 * size + 1e-12).all()
    assert (difference.norm(dim=-1) > 1e-3 * size).any()


def test_frozen_gradient_is_near_the_true_derivative(device):
    """dI/dS12 in the frozen eigenframe against the bivariate integral itself.

    That derivative is 2 pi (s1 dF/du)(s2 dG/dv), each factor a difference of two densities. With
    e = max |S' - phi|, each factor errs by at most 2e, so the product by 2e(|A| + |B|) + 4e^2.
    """
    x = torch.linspace(-10, 10, 100001, dtype=torch.float64)
    e = (reference.logistic_pdf(x) - reference.normal_pdf(x)).abs().max()
    g = generator(6)
    s1, s2 = scenes.rand(g, 2, 200, low=0.2, high=4.0)
    cov2d = torch.stack([s1**2, torch.zeros_like(s1), s2**2], -1)
    offset = scenes.random_offsets(g, cov2d, 2.5)
    truth, ours = (cov2d.clone().requires_grad_() for _ in range(2))
    reference.exact_weight(offset, truth).sum().backward()
    weight(device, offset, ours, footprint="analytic").sum().backward()

    def factor(u, s):
        low, high = (u - 0.5) / s, (u + 0.5) / s
        return (reference.normal_pdf(high) - reference.normal_pdf(low)).abs()

    a, b = factor(offset[:, 0], s1), factor(offset[:, 1], s2)
    bound = 2 * math.pi * (2 * e * (a + b) + 4 * e**2)
    error = (ours.grad - truth.grad)[:, 1].abs()
    assert (error <= bound + 1e-12).all()
    # The bound says something: it is far below the derivative where that is large.
    assert bound.median() < 0.2 * truth.grad[:, 1].abs().max()


# --- what a weight must satisfy ----------------------------------------------------------------


def lattice(reach=32):
    axis = torch.arange(-reach, reach + 1, dtype=torch.float64)
    return torch.stack(torch.meshgrid(axis, axis, indexing="ij"), -1).reshape(-1, 2)


def lattice_splats(seed, count, sigma, ratio=(1.1, 4.0)):
    """Covariances and sub-pixel means."""
    g = generator(seed)
    return scenes.random_cov2d(g, count, sigma, ratio), scenes.rand(g, count, 2, low=-0.5, high=0.5)


@closed_form
def test_mass_is_conserved_exactly(device, variant):
    """Sum over all pixels, against Poisson's summation formula, aliasing terms included.

    sum_n exp(-q(n - mu)/2) = 2 pi sqrt(det) sum_k exp(-2 pi^2 k.Sigma k) cos(2 pi k.mu); the term
    k = 0 is the mass 2 pi sqrt(det) of the splat, undilated for all but `point`.
    """
    footprint, options = variant
    full = reference.settled(footprint, options)
    cov2d, means = lattice_splats(7, 12, (0.3, 0.9))
    if footprint == "box":
        samples = full["samples"]
        nodes, variance = reference.box_nodes(samples), reference.box_variance(samples)
    elif footprint == "moment":
        nodes, variance = reference.cell_nodes(full["samples"]), 1 / (12 * full["samples"])
    else:
        nodes, variance = torch.zeros(1, 2).double(), full.get("dilation", full.get("variance"))
    wider = reference.add_variance(cov2d, variance)
    mass_of = wider if footprint == "point" else cov2d
    k = lattice(8)
    xx, xy, yy = wider.unbind(-1)
    form = xx[:, None] * k[:, 0] ** 2 + 2 * xy[:, None] * k.prod(-1) + yy[:, None] * k[:, 1] ** 2
    phase = torch.cos(2 * math.pi * (means[:, None] - nodes) @ k.T).mean(1)
    aliased = (torch.exp(-2 * math.pi**2 * form) * phase).sum(-1)
    expected = 2 * math.pi * torch.sqrt(reference.determinant(mass_of)) * aliased
    pixels = lattice()
    weights = weight(device, pixels - means[:, None], cov2d[:, None], variant)
    assert ((weights.sum(-1) - expected).abs() / expected).max() < 1e-12


@pytest.mark.parametrize("frame_gradient", ["frozen", "paper"])
def test_analytic_mass(device, frame_gradient):
    """The paper's window tiles the plane only when it is axis-aligned.

    Rotated, the sum over pixels is again Poisson's: the transform of the logistic density S'
    replaces the Gaussian, and sinc(w/2) along both *rotated* axes the pixel.
    """
    x = torch.linspace(-14, 14, 2801, dtype=torch.float64)
    density = reference.logistic_pdf(x) * 0.01  # trapezoid rule, spectrally accurate

    def transform(w):
        pixel = torch.sinc(w / (2 * math.pi))
        return lambda s: (torch.cos((s[:, None] * w)[..., None] * x) * density).sum(-1) * pixel

    cov2d, means = lattice_splats(8, 8, (0.6, 1.2))
    matrix = torch.stack([cov2d[:, [0, 1]], cov2d[:, [1, 2]]], -2)
    values, axes = torch.linalg.eigh(matrix)
    k = lattice(4)
    w = 2 * math.pi * k @ axes  # (P, K, 2)
    factors = [transform(w[..., i])(torch.sqrt(values[:, i])) for i in range(2)]
    phase = torch.cos(2 * math.pi * means @ k.T)
    mass = 2 * math.pi * torch.sqrt(reference.determinant(cov2d))
    expected = mass * (factors[0] * factors[1] * phase).sum(-1)
    variant = "analytic", {"frame_gradient": frame_gradient}
    weights = weight(device, lattice() - means[:, None], cov2d[:, None], variant)
    assert ((weights.sum(-1) - expected).abs() / expected).max() < 1e-11


def test_analytic_mass_axis_aligned(device):
    """Without a turn the differences of S telescope, at any sigma."""
    s1 = torch.tensor([0.02, 0.1, 0.5, 1.0, 3.0], dtype=torch.float64)
    s2 = torch.tensor([0.5, 0.05, 0.02, 2.0, 0.3], dtype=torch.float64)
    cov2d = torch.stack([s1**2, torch.zeros_like(s1), s2**2], -1)
    mean = torch.tensor([0.2, -0.4], dtype=torch.float64)
    weights = weight(device, lattice() - mean, cov2d[:, None], footprint="analytic")
    expected = 2 * math.pi * s1 * s2
    assert ((weights.sum(-1) - expected).abs() / expected).max() < 1e-12


def test_cumulant_mass(device):
    """Exact weights conserve mass; Q6 differs from them by 1/(240000 l'^4) per pixel (NUMERICS)."""
    cov2d, means = lattice_splats(9, 12, (0.7, 2.0), ratio=(1.0, 2.0))
    offset = lattice() - means[:, None]
    weights = weight(device, offset, cov2d[:, None], footprint="cumulant")
    _, smaller = eigenvalues(cov2d)
    per_pixel = 1.05 / (240000 * (smaller + 1 / 12) ** 4)
    wider = reference.add_variance(cov2d, 1 / 12)
    reached = (reference.quadratic(offset, wider[:, None]) < 40).sum(-1)  # exp(-20) beyond
    expected = 2 * math.pi * torch.sqrt(reference.determinant(cov2d))
    assert ((weights.sum(-1) - expected).abs() <= per_pixel * reached + 1e-7).all()


@every_footprint
def test_moments(device, variant):
    """First moment zero; second moment Sigma plus what the footprint adds.

    This is how the pattern of `box` is checked without looking inside: nodes and their variance
    together must have mean 0 and second moment 1/12 for every S. Aliasing is exp(-2 pi^2 1.2^2).
    """
    footprint, options = variant
    cov2d, means = lattice_splats(10, 12, (1.2, 2.0), ratio=(1.1, 1.5))
    offset = lattice() - means[:, None]
    weights = weight(device, offset, cov2d[:, None], variant)
    weights = weights / weights.sum(-1, keepdim=True)
    first = (weights[..., None] * offset).sum(1)
    products = torch.stack([offset[..., 0] ** 2, offset.prod(-1), offset[..., 1] ** 2], -1)
    second = (weights[..., None] * products).sum(1)
    tolerance = 1e-10
    if footprint == "analytic":
        x = torch.linspace(-14, 14, 2801, dtype=torch.float64)
        logistic_variance = (reference.logistic_pdf(x) * 0.01 * x**2).sum()
        expected = reference.add_variance(cov2d * logistic_variance, 1 / 12)
        # A turned window does not tile: aliasing exp(-2.8 * 2 pi * 1.2) * r^2, r^2 ~ 10.
        tolerance = 1e-7
    else:
        expected = reference.add_variance(cov2d, added_variance(variant))
    if footprint == "box" and options["samples"] > 1:
        # The nodes have five digits: the squares of coordinates below 1/2 are off by 5e-6 at most.
        tolerance = 5e-6
    if footprint == "cumulant":
        # Per-pixel error 1/(240000 * 1.52^4) = 8e-7, times r^2 ~ 20 and ~60 pixels, over mass ~ 9.
        tolerance = 1e-4
    assert first.abs().max() < tolerance
    assert (second - expected).abs().max() < tolerance


@every_footprint
@pytest.mark.parametrize("sigma", [30.0, 1e3, 1e5])
def test_wide_splats_are_sampled(device, variant, sigma):
    """As sigma grows the weight becomes exp(-q/2).

    Added variance v changes q by at most v/l q and the amplitude by v/l: 0.74 v/l + v/l in all;
    averaging over the pixel changes it by the same with v = 1/12. `analytic` stops at the error of
    its density, (1 + e)^2 - 1 with e = max |S' sqrt(2 pi) - exp(-x^2/2)| = 2.7e-3 or so.
    """
    footprint, _ = variant
    g = generator(11)
    cov2d = scenes.random_cov2d(g, 200, (sigma, sigma * 1.001), (1.05, 10.0))
    offset = scenes.random_offsets(g, cov2d)
    actual = weight(device, offset, cov2d, variant)
    bound = 2 * max(added_variance(variant), 1 / 12) / sigma**2
    if footprint == "analytic":
        x = torch.linspace(-10, 10, 100001, dtype=torch.float64)
        e = reference.logistic_pdf(x) / reference.normal_pdf(torch.zeros(()).double())
        e = (e - torch.exp(-x * x / 2)).abs().max()
        bound += (1 + e) ** 2 - 1
    error = (actual - reference.gaussian(offset, cov2d)).abs().max()
    assert error < bound + 1e-11


# Largest error against the exact integral, from the numerics notes ("Accuracy"). They are maxima of
# 20000 random samples, and repeating that draw moves them by up to 20 %.
ACCURACY = {
    (0.02, 0.1): {"point": 0.94, "analytic": 5.9e-2, "box": 7.2e-2, "cumulant": 1.6e-2, "erf": 6.0e-2, "exact": 0},
    (0.1, 0.2): {"point": 0.84, "analytic": 6.4e-2, "box": 8.4e-2, "cumulant": 1.5e-2, "erf": 6.5e-2, "exact": 0},
    (0.2, 0.3): {"point": 0.69, "analytic": 4.9e-2, "box": 7.6e-2, "cumulant": 5.7e-3, "erf": 5.0e-2, "exact": 0},
    (0.3, 0.5): {"point": 0.41, "analytic": 2.2e-2, "box": 4.0e-2, "cumulant": 2.1e-3, "erf": 2.2e-2, "exact": 0},
    (0.5, 0.7): {"point": 0.21, "analytic": 4.8e-3, "box": 1.2e-2, "cumulant": 2.4e-4, "erf": 5.0e-3, "exact": 0},
    (0.7, 1.0): {"point": 0.12, "analytic": 4.3e-3, "box": 4.4e-3, "cumulant": 2.7e-5, "erf": 1.6e-3, "exact": 0},
    (1.0, 2.0): {"point": 0.06, "analytic": 5.0e-3, "box": 1.2e-3, "cumulant": 2.6e-6, "erf": 4.4e-4, "exact": 0},
    (2.0, 5.0): {"point": 1.6e-2, "analytic": 5.2e-3, "box": 8.7e-5, "cumulant": 1.2e-8, "erf": 2.4e-5, "exact": 0},
    (5.0, 20.0): {"point": 2.5e-3, "analytic": 5.3e-3, "box": 1.9e-6, "cumulant": 8.5e-12, "erf": 7e-7, "exact": 0},
}


@pytest.mark.parametrize("sigma", ACCURACY, ids=str)
def test_documented_accuracy(sigma):
    """The stated worst errors hold, and are not slack by more than a factor of four."""
    g = generator(12)
    cov2d = scenes.random_cov2d(g, 3000, sigma)
    offset = scenes.random_offsets(g, cov2d)
    truth = reference.exact_weight(offset, cov2d)
    options = {"point": {"dilation": 0.0}, "box": {"samples": 1}}
    for footprint, stated in ACCURACY[sigma].items():
        value = ar.footprint_weight(offset, cov2d, footprint=footprint, **options.get(footprint, {}))
        error = (value - truth).abs().max().item()
        # 2e-12: float64 quadrature and the conditioning of Sigma itself (ratio 100: cond 1e4).
        assert error < 1.25 * stated + 2e-12, (footprint, error, stated)
        assert error > stated / 4 - 2e-12, (footprint, error, stated)


# RMS relative error of the whitened dI/dSigma against the exact integral, from the numerics notes,
# by (standard deviation, s1/s2 - 1).
GRADIENT_ACCURACY = {
    (0.2, 1e-4): {"paper": 1400, "frozen": 0.13, "box": 0.21, "cumulant": 0.036},
    (0.2, 1.0): {"paper": 0.14, "frozen": 0.09, "box": 0.16, "cumulant": 0.024},
    (1.0, 1e-4): {"paper": 15, "frozen": 6e-3, "box": 4e-3, "cumulant": 3e-5},
    (1.0, 0.1): {"paper": 0.018, "frozen": 6e-3, "box": 3e-3, "cumulant": 2e-5},
}


@pytest.mark.parametrize("shape", GRADIENT_ACCURACY, ids=str)
def test_documented_gradient_accuracy(shape):
    """One digit is stated and the draw is random: within 20 %."""
    sigma, excess = shape
    g = generator(20)
    small = torch.full((2000,), sigma, dtype=torch.float64)
    angle = scenes.rand(g, 2000, high=math.pi)
    cov2d = scenes.covariance_2d(small * (1 + excess), small, angle)
    offset = scenes.random_offsets(g, cov2d)
    factor = torch.linalg.cholesky(torch.stack([cov2d[:, [0, 1]], cov2d[:, [1, 2]]], -2))

    def whitened(weight):
        c = cov2d.clone().requires_grad_()
        xx, xy, yy = torch.autograd.grad(weight(offset, c).sum(), c)[0].unbind(-1)
        rows = [torch.stack([xx, xy / 2], -1), torch.stack([xy / 2, yy], -1)]
        return factor.transpose(-1, -2) @ torch.stack(rows, -2) @ factor

    footprints = {
        "paper": {"footprint": "analytic", "frame_gradient": "paper"},
        "frozen": {"footprint": "analytic"},
        "box": {"footprint": "box", "samples": 1},
        "cumulant": {"footprint": "cumulant"},
    }
    truth = whitened(reference.exact_weight)
    for name, stated in GRADIENT_ACCURACY[shape].items():
        ours = whitened(lambda d, c, name=name: ar.footprint_weight(d, c, **footprints[name]))
        error = ((ours - truth).norm() / truth.norm()).item()
        assert stated / 1.2 < error < stated * 1.2, (name, error, stated)


@pytest.mark.parametrize(
    "variant, power, constant",
    [(("box", {"samples": 1}), 2, 480), (("cumulant", {}), 4, 240000)],
    ids=["box-1", "cumulant"],
)
def test_safe_bound(device, variant, power, constant):
    """|weight - exact| <= 1/(constant l'^power), the bounds offered for choosing a footprint."""
    offset, cov2d = splats(13, count=4000, sigma=(0.05, 3.0), ratio=(1.0, 100.0), reach=3.0)
    _, smaller = eigenvalues(cov2d)
    truth = reference.exact_weight(offset, cov2d)
    error = (weight(device, offset, cov2d, variant) - truth).abs()
    bound = 1 / (constant * (smaller + 1 / 12) ** power)
    assert (error <= 1.05 * bound + 2e-12).all(), (error / bound).max()


@pytest.mark.parametrize("samples", [1, 4, 16])
def test_box_is_the_mean_of_shifted_mips(device, samples):
    offset, cov2d = splats(14)
    variance = reference.box_variance(samples)
    shifted = [weight(device, offset + node, cov2d, "mip", variance=variance) for node in reference.box_nodes(samples)]
    actual = weight(device, offset, cov2d, "box", samples=samples)
    excess = (actual - torch.stack(shifted).mean(0)).abs()
    bound = rounding_bound(offset, cov2d, ("box", {"samples": samples}), EPS64)
    assert (excess / bound).max() < 1


# --- float32 and hard inputs --------------------------------------------------------------------


@every_footprint
def test_float32_weight(device, variant):
    """The same float32 inputs in both precisions; see rounding_bound."""
    offset, cov2d = splats(15, sigma=(0.05, 50.0), ratio=(1.1, 10.0))
    offset, cov2d = offset.float(), cov2d.float()
    single = weight(device, offset, cov2d, variant)
    assert single.dtype == torch.float32
    offset, cov2d = offset.double(), cov2d.double()
    double = weight(device, offset, cov2d, variant)
    excess = (single.double() - double).abs() / rounding_bound(offset, cov2d, variant, EPS32)
    assert excess.max() < 1, (single.double() - double).abs().max()


@every_footprint
def test_float32_vjp(device, variant):
    """Condition number below 9: rounding 64 eps cond = 7e-5 of the largest gradient."""
    offset, cov2d = splats(16, sigma=(0.3, 5.0), ratio=(1.3, 3.0))
    _, smaller = eigenvalues(cov2d)
    grads = []
    for dtype in (torch.float32, torch.float64):
        # The double computation starts from the same float32 numbers.
        d = offset.float().to(dtype).requires_grad_()
        c = cov2d.float().to(dtype).requires_grad_()
        value = weight(device, d, c, variant)
        grads.append([t.double() for t in torch.autograd.grad(value.sum(), (d, c))])
    for single, double, unit in zip(*grads, (smaller**-0.5, 1 / smaller), strict=True):
        assert ((single - double).abs() / unit[:, None]).max() < 64 * EPS32 * 9


HARD = {
    "isotropic": lambda s: (s, s, 0.0),
    "diagonal wide": lambda s: (2 * s, s, 0.0),
    "diagonal tall": lambda s: (s, 2 * s, math.pi / 2),
    "nearly isotropic": lambda s: (s * (1 + 1e-7), s, 0.6),
    "needle 0 deg": lambda s: (1e6 * s, s, 0.0),
    "needle 30 deg": lambda s: (1e6 * s, s, math.pi / 6),
    "needle 45 deg": lambda s: (1e6 * s, s, math.pi / 4),
    "needle 90 deg": lambda s: (1e6 * s, s, math.pi / 2),
}


@every_footprint
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
@pytest.mark.parametrize("case", HARD)
def test_hard_inputs_stay_finite(device, variant, dtype, case):
    """sigma 1e-6 .. 1e6 px; the weight is a weight, the gradient is finite ("paper" too: at exactly
    equal eigenvalues it takes no turn).

    A float32 covariance cannot hold every needle: rounding its entries may leave no positive
    determinant, and then the weight is documented as undefined.
    """
    footprint, _ = variant
    cov2d = []
    for exponent in range(-6, 7):
        s1, s2, angle = HARD[case](10.0**exponent)
        if s1 <= 1e6 * 1.1:
            numbers = (torch.tensor(v, dtype=torch.float64) for v in (s1, s2, angle))
            cov2d.append(scenes.covariance_2d(*numbers))
    cov2d = torch.stack(cov2d)[:, None].to(dtype)
    definite = reference.determinant(cov2d.double()) > 0
    cov2d = cov2d[definite].reshape(-1, 1, 3).requires_grad_()
    offset = torch.tensor(
        [[0, 0], [0.5, 0.5], [0.5, 0], [-0.3, 0.2], [3, -2], [1e3, 1e3], [-1e4, 7]], dtype=dtype
    ).requires_grad_()
    value = weight(device, offset, cov2d, variant)
    assert torch.isfinite(value).all()
    # analytic overshoots by its density error (5.3e-3), others by rounding alone.
    assert (value >= 0).all()
    assert (value <= (1.0054 if footprint == "analytic" else 1 + 1e-6)).all()
    by_offset, by_cov = torch.autograd.grad(value.sum(), (offset, cov2d))
    assert torch.isfinite(by_offset).all()
    assert torch.isfinite(by_cov).all()


@every_footprint
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
def test_hard_inputs_stay_accurate(device, variant, dtype):
    """Diagonal covariances are well conditioned whatever their size: full accuracy is due.

    Each eigenvalue is an input, so the weight errs by a few eps of its exponent's slope (0.74)
    plus, for `analytic`, a few eps of each window: 64 eps covers forty operations.
    """
    g = generator(17)
    s = 10 ** scenes.rand(g, 400, 2, low=-6.0, high=6.0)
    cov2d = torch.stack([s[:, 0] ** 2, torch.zeros(400).double(), s[:, 1] ** 2], -1).to(dtype)
    offset = scenes.random_offsets(g, cov2d.double()).to(dtype)
    value = weight(device, offset, cov2d, variant)
    expected = expected_weight(offset.double(), cov2d.double(), variant)
    assert (value.double() - expected).abs().max() < 64 * torch.finfo(dtype).eps


def test_isotropic_analytic_uses_the_pixel_axes(device):
    """Where the eigenvectors are arbitrary, the pixel's own axes are the only sensible choice."""
    cov2d = torch.tensor([0.09, 0.0, 0.09], dtype=torch.float64)
    offset = torch.tensor([[0.4, 0.1], [-0.2, 0.6]], dtype=torch.float64)
    value = weight(device, offset, cov2d, footprint="analytic")
    one = 0.3 * math.sqrt(2 * math.pi) * reference.logistic_window(offset, 0.3)
    assert (value - one.prod(-1)).abs().max() < 1e-14


# --- the function's contract --------------------------------------------------------------------


@every_footprint
def test_broadcasting(device, variant):
    offset, cov2d = splats(18, count=5)
    offset, cov2d = offset[:, None].requires_grad_(), cov2d[:4].requires_grad_()
    value = weight(device, offset, cov2d, variant)
    assert value.shape == (5, 4)
    value.sum().backward()
    assert offset.grad.shape == (5, 1, 2)
    assert cov2d.grad.shape == (4, 3)
    one = weight(device, offset[3, 0], cov2d[2], variant)
    assert one.shape == ()
    assert abs(one - value[3, 2]) < 1e-14


def test_empty_and_strided(device):
    empty = ar.footprint_weight(torch.zeros(0, 2, device=device), torch.ones(3, device=device))
    assert empty.shape == (0,)
    offset, cov2d = splats(19, count=10)
    offset, cov2d = offset.to(device), cov2d.to(device)
    packed = torch.cat([offset, cov2d], -1).T.contiguous().T
    assert not packed[:, :2].is_contiguous()
    strided = ar.footprint_weight(packed[:, :2], packed[:, 2:])
    assert torch.equal(strided, ar.footprint_weight(offset, cov2d))


@pytest.mark.parametrize(
    "error, pattern, call",
    [
        (ValueError, r"offset must .*2.*got \(5, 3\)", lambda f: f(t(5, 3), t(5, 3))),
        (ValueError, r"cov2d must .*3.*got \(5, 2\)", lambda f: f(t(5, 2), t(5, 2))),
        (ValueError, r"offset must .*got \(\)", lambda f: f(t(), t(3))),
        (ValueError, r"must .*got", lambda f: f(t(5, 2), t(4, 3))),
        (TypeError, r"offset must .*got (torch.int64|Long)", lambda f: f(t(5, 2).long(), t(5, 3))),
        (TypeError, r"must .*got (torch.float16|Half)", lambda f: f(t(5, 2).half(), t(5, 3).half())),
        (TypeError, r"must .*got (torch.float64|Double)", lambda f: f(t(5, 2), t(5, 3).double())),
        (ValueError, r"device", lambda f: f(t(5, 2), t(5, 3).to("meta"))),
        (ValueError, r"footprint must .*'cubic'", lambda f: f(t(5, 2), t(5, 3), footprint="cubic")),
        (ValueError, r"samples must .*3", lambda f: f(t(5, 2), t(5, 3), footprint="box:samples=3")),
        (ValueError, r"samples must .*3", lambda f: f(t(5, 2), t(5, 3), footprint="box", samples=3)),
        (ValueError, r"frame_gradient must .*'own'", lambda f: f(t(5, 2), t(5, 3), "analytic", frame_gradient="own")),
        (ValueError, r"dilation must .*-1", lambda f: f(t(5, 2), t(5, 3), "point", dilation=-1.0)),
        (ValueError, r"variance must .*-1", lambda f: f(t(5, 2), t(5, 3), "mip", variance=-1.0)),
        (ValueError, r"variance must .*nan", lambda f: f(t(5, 2), t(5, 3), "mip:variance=nan")),
        (ValueError, r"samples", lambda f: f(t(5, 2), t(5, 3), "mip", samples=4)),
        ((TypeError, ValueError), r"footprint must .*got 3", lambda f: f(t(5, 2), t(5, 3), footprint=3)),
    ],
)
def test_errors(error, pattern, call):
    """Name, expectation, actual."""
    with pytest.raises(error, match=pattern):
        call(ar.footprint_weight)


def t(*shape):
    return torch.ones(shape)
