"""`exact` against the integral in 20 digits, and `erf` against `exact`.

The truth here shares nothing with the library: its value is a product of mpmath's erfc and a
quadrature that resolves every scale of the integrand, its gradients are edge integrals in closed form.
"""

import itertools
import math

import mpmath as mp
import pytest
import scenes
import torch
from mpmath.calculus.quadrature import GaussLegendre

import analytic_rasterizer as ar

EPS = {torch.float64: 2.0**-53, torch.float32: 2.0**-24}
SIGMAS = (1e-4, 0.02, 0.1, 0.36, 0.5, 1.01, 1.45, 5.0, 1e3, 1e6)
RATIOS = (1.0, 3.0, 10.0, 100.0)


def interval(a, b):
    """Integral of exp(-z^2/2) over [a, b], on the side where both values of erfc are small."""
    if a + b < 0:
        a, b = -b, -a
    return mp.sqrt(mp.pi / 2) * (mp.erfc(a / mp.sqrt(2)) - mp.erfc(b / mp.sqrt(2)))


def panels(low, high, *marks):
    """[low, high] cut into pieces of at most two deviations of each (centre, deviation) within 12 of them."""
    inner = [centre + 2 * k * deviation for centre, deviation in marks for k in range(-6, 7)]
    ends = [low, *sorted(m for m in inner if low < m < high), high]
    return itertools.pairwise(ends)


def integrate(f, pieces):
    """24 Gauss-Legendre nodes per piece: 1e-20 of a function that varies over two deviations."""
    nodes = gauss_legendre()
    return mp.fsum((b - a) / 2 * w * f((a + b) / 2 + (b - a) / 2 * x) for a, b in pieces for x, w in nodes)


def gauss_legendre():
    """Nodes and weights on [-1, 1]: 24 of them, to the working precision."""
    return GaussLegendre(mp.mp).get_nodes(-1, 1, degree=4, prec=mp.mp.prec)


def truth(offset, cov2d):
    """I, dI/doffset (2) and dI/dcov2d (3), from floats taken as exact."""
    (x, y), (xx, xy, yy) = map(mp.mpf, offset), map(mp.mpf, cov2d)
    if yy > xx:
        value, (gx, gy), (gxx, gxy, gyy) = truth((offset[1], offset[0]), (cov2d[2], cov2d[1], cov2d[0]))
        return value, (gy, gx), (gyy, gxy, gxx)
    det, half = xx * yy - xy * xy, mp.mpf(1) / 2
    ends_x, ends_y = (x - half, x + half), (y - half, y + half)
    given_x, given_y = mp.sqrt(det / xx), mp.sqrt(det / yy)  # deviations of the other coordinate

    def on_column(u):  # integral along y
        ends = [(v - xy / xx * u) / given_x for v in ends_y]
        return mp.exp(-u * u / (2 * xx)) * given_x * interval(*ends)

    def on_row(v):  # integral along x
        ends = [(u - xy / yy * v) / given_y for u in ends_x]
        return mp.exp(-v * v / (2 * yy)) * given_y * interval(*ends)

    marks = [(mp.mpf(0), mp.sqrt(xx))]
    if xy != 0:
        marks += [(v * xx / xy, given_x * xx / abs(xy)) for v in ends_y]
    value = integrate(on_column, panels(*ends_x, *marks))

    a, b, c = yy / det, -xy / det, xx / det

    def f(u, v):
        return mp.exp(-(a * u * u + 2 * b * u * v + c * v * v) / 2)

    def across_column(u):  # integral of df/dx along y, of which -(b u + c v) f integrates to f at the ends
        moment = -(f(u, ends_y[1]) - f(u, ends_y[0]) + b * u * on_column(u)) / c
        return -(a * u * on_column(u) + b * moment)

    def across_row(v):
        moment = -(f(ends_x[1], v) - f(ends_x[0], v) + b * v * on_row(v)) / a
        return -(c * v * on_row(v) + b * moment)

    def change(g, ends):
        return g(ends[1]) - g(ends[0])

    hess_xy = change(lambda u: f(u, ends_y[1]) - f(u, ends_y[0]), ends_x)
    # f without a normalising amplitude: dI/dSigma = (Sigma^-1 I + Hessian I) / 2
    hess_xx, hess_yy = change(across_column, ends_x), change(across_row, ends_y)
    by_cov = (a * value + hess_xx) / 2, b * value + hess_xy, (c * value + hess_yy) / 2
    return value, (change(on_column, ends_x), change(on_row, ends_y)), by_cov


def test_truth_is_the_integral():
    """The definition in two dimensions, and its differences."""
    with mp.workdps(20):
        offset, cov2d = (0.3, -0.7), (0.4, 0.19, 0.15)

        def plain(x, y, xx, xy, yy):
            det = xx * yy - xy * xy

            def f(u, v):
                return mp.exp(-(yy * u * u - 2 * xy * u * v + xx * v * v) / (2 * det))

            nodes = gauss_legendre()
            points = [(piece + u / 4, w / 4) for piece in (-mp.mpf(1) / 4, mp.mpf(1) / 4) for u, w in nodes]
            return mp.fsum(w1 * w2 * f(x + u, y + v) for u, w1 in points for v, w2 in points)

        value, by_offset, by_cov = truth(offset, cov2d)
        exact = [mp.mpf(v) for v in (*offset, *cov2d)]
        assert abs(plain(*exact) - value) < 1e-17
        for k, derivative in enumerate((*by_offset, *by_cov)):
            h = mp.mpf("1e-5")
            moved = [plain(*(v + s * h * (j == k) for j, v in enumerate(exact))) for s in (1, -1)]
            assert abs((moved[0] - moved[1]) / (2 * h) - derivative) < 1e-7  # h^2 f''' / 6


def case(sigma, ratio, seed):
    """One covariance and six offsets, as float32 numbers: three anywhere in reach, three within two
    deviations of a corner or an edge, where a small splat's gradient is."""
    g = torch.Generator().manual_seed(seed)
    small = torch.tensor(sigma, dtype=torch.float64)
    cov2d = scenes.covariance_2d(small * ratio, small, scenes.rand(g, 1, high=math.pi)[0]).float().double()
    anywhere = scenes.random_offsets(g, cov2d.expand(3, 3), 3.0)
    matrix = torch.stack([cov2d[[0, 1]], cov2d[[1, 2]]])
    corners = torch.tensor([[0.5, -0.5], [0.5, 0.5], [0.5, 0.0]], dtype=torch.float64)
    near = corners + torch.randn(3, 2, dtype=torch.float64, generator=g) @ torch.linalg.cholesky(matrix).T
    return torch.cat([anywhere, near]).float().double(), cov2d


def errors(dtype, offset, cov2d, expected):
    """Largest errors of the weight, and of both gradients relative to the largest of them."""
    d = offset.to(dtype).requires_grad_()
    c = cov2d.to(dtype).expand(len(d), 3).clone().requires_grad_()
    value = ar.footprint_weight(d, c, "exact")
    by_offset, by_cov = torch.autograd.grad(value.sum(), (d, c))
    results = []
    for ours, column in ((value[:, None], 0), (by_offset, 1), (by_cov, 2)):
        rows = [row[column] if column else (row[column],) for row in expected]
        theirs = torch.tensor([[float(v) for v in row] for row in rows], dtype=torch.float64)
        error = (ours.detach().double() - theirs).norm(dim=-1).max()
        results.append((error / (theirs.norm(dim=-1).max() if column else 1)).item())
    return results


@pytest.mark.parametrize("ratio", RATIOS)
@pytest.mark.parametrize("sigma", SIGMAS)
def test_accuracy(sigma, ratio):
    """The bounds that docs/internals/numerics.md derives, eps = 2^-24 or 2^-53 being one rounding.

    Weight: 12 eps (I + |dI/dd| (|d| + 1/2)) <= 12 eps (3 + .74 s1/s2). Gradient, relative to the
    largest: 12 eps (3 + 2 s1/s2). Up to 10 they are within the promised 1e-10 and 5e-5.
    """
    offset, cov2d = case(sigma, ratio, seed=int(1000 * ratio) + SIGMAS.index(sigma))
    with mp.workdps(40):  # Hessians of wide needles cancel half of them
        expected = [truth(d.tolist(), cov2d.tolist()) for d in offset]
    for dtype, promised in ((torch.float64, 1e-10), (torch.float32, 5e-5)):
        weight, by_offset, by_cov = errors(dtype, offset, cov2d, expected)
        print(f"{dtype} {sigma} {ratio}: {weight:.1e} {by_offset:.1e} {by_cov:.1e}")
        assert weight < 12 * EPS[dtype] * (3 + 0.74 * ratio)
        assert max(by_offset, by_cov) < 12 * EPS[dtype] * (3 + 2 * ratio)
        if ratio <= 10:
            assert max(weight, by_offset, by_cov) < promised


@pytest.mark.parametrize("sigma", [1e-3, 0.03, 0.2, 0.6, 2.0])
@pytest.mark.parametrize("ratio", [1.0, 7.0, 50.0])
def test_mass_is_conserved(sigma, ratio):
    """The pixels tile the plane, so the weights add up to the Gaussian's integral, at any size."""
    g = torch.Generator().manual_seed(0)
    small = torch.tensor(sigma, dtype=torch.float64)
    cov2d = scenes.covariance_2d(small * ratio, small, scenes.rand(g, 1, high=math.pi)[0])
    reach = math.ceil(9 * sigma * ratio) + 2  # exp(-40) beyond
    axis = torch.arange(-reach, reach + 1, dtype=torch.float64)
    offset = torch.stack(torch.meshgrid(axis, axis, indexing="ij"), -1).reshape(-1, 2) - scenes.rand(g, 2)
    expected = 2 * math.pi * sigma**2 * ratio
    total = ar.footprint_weight(offset, cov2d, "exact").sum().item()
    # Rounding of det, by which the sum is scaled, and of the entries: eps (s1/s2)^2.
    assert abs(total / expected - 1) < 16 * EPS[torch.float64] * (ratio**2 + 16)


@pytest.mark.parametrize("dtype", EPS, ids=str)
def test_erf_is_exact_along_the_axes(dtype):
    """Where the window is not turned `erf` is the integral itself: value and, but for the sign of
    zero, every gradient. From needles to 1e6 px, so no digit is lost however wide the splat is."""
    g = torch.Generator().manual_seed(1)
    s = 10 ** scenes.rand(g, 500, 2, low=-2.0, high=6.0)
    cov2d = torch.stack([s[:, 0] ** 2, torch.zeros(500).double(), s[:, 1] ** 2], -1).to(dtype)
    offset = scenes.random_offsets(g, cov2d.double()).to(dtype)
    results = []
    for footprint in ("erf", "exact"):
        d, c = offset.clone().requires_grad_(), cov2d.clone().requires_grad_()
        value = ar.footprint_weight(d, c, footprint)
        results.append([value, *torch.autograd.grad(value.sum(), (d, c))])
    s = s.to(dtype)
    # In units of 1/s and 1/(s s), where gradients are of order one; both footprints err by 12 eps (3 + .74).
    units = (1, s, torch.stack([s[:, 0] ** 2, s[:, 0] * s[:, 1], s[:, 1] ** 2], -1))
    for ours, theirs, unit in zip(*results, units, strict=True):
        # erf's edges are rounded at u/s; 1/2 px is 50 deviations of 0.01.
        assert ((ours - theirs) * unit).abs().max() < 2 * 12 * EPS[dtype] * (3 + 0.74 + 50)
