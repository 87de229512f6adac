"""The hard cases (hard_cases.py), the policy for bad numbers, and a few seconds of fuzzing.

docs/internals/testing.md is the table of what is asserted here and how large the errors were.
"""

import math
import pathlib
import re

import fuzz
import hard_cases
import mpmath
import pytest
import reference
import scenes
import torch
from hard_cases import CASES, EPS
from hypothesis import HealthCheck, given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from marks import each_kind, each_path, each_precision, every_footprint
from places import ROOT
from scenes import REFERENCE_FOOTPRINTS, VARIANTS, Camera, name_of

import analytic_rasterizer as ar

DOCS = ROOT / "docs"
STACKS = ("stack_opaque", "stack_faint", "stack_mixed")
# A case of another name would not be looked at more closely, and no test would say so.
assert {case.name for case in CASES}.issuperset(STACKS)


# --- the battery -------------------------------------------------------------------------------


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
@every_footprint
def test_hard_case(case, variant, device):
    """Float32 and float64 are finite, and float32 is within the tolerance of its condition of float64's result for the
    same numbers. How good float64 is, the next test says."""
    report = hard_cases.measure(case, variant, device, torch.float32)
    assert report.finite, report.describe()
    assert report.unclear <= 0.25, "too many pixels are at a threshold for the case to say anything"
    assert all(torch.isfinite(tolerance).all() for tolerance in report.tolerance.values())
    assert report.error, "nothing was compared"
    assert not report.failures(), report.describe()
    if case.name in STACKS:
        check_layers(case.name, report)


def check_layers(name, report):
    """Of 10,000 layers, whose gradients have been compared one by one: the first is seen, and how many are behind it.

    T loses a rounding per blended layer on the way there and on the way back, of which there are at most
    ln(1e4) / (1/255) = 2350.
    """
    seen = torch.nonzero(report.size["shs"]).flatten()
    assert seen[0] == 0
    assert seen[-1] <= 2400
    assert name == "stack_opaque" or seen[-1] > 100


@pytest.mark.parametrize("footprint", REFERENCE_FOOTPRINTS)
@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_hard_case_of_a_reference(case, footprint):
    """Image and gradients are finite."""
    camera, scene = case.build()
    settings = hard_cases.settings_of(camera, torch.float32, torch.float32, (footprint, {}), effects=case.effects)
    loss = torch.ones(3, camera.image_height, camera.image_width)
    color, _, grads = hard_cases.run(settings, scenes.cast(scene, torch.float32), loss)
    assert all(torch.isfinite(t).all() for t in (color, *grads.values()))


@pytest.mark.parametrize("case", [case for case in CASES if case.reference], ids=lambda case: case.name)
@each_kind
def test_hard_case_against_the_reference(case, variant):
    """Image and gradients in float64 against the renderer of reference.py, which shares no code with ours.

    Its conics and determinants cancel: eps r^2 more for splats of ratio r, here at most 1e3
    but where a lens widens them.
    """
    camera, scene = case.build()
    settings = hard_cases.settings_of(camera, torch.float64, torch.float64, variant, effects=case.effects)
    footprint, options = variant
    ours, theirs = scenes.leaves(scene), scenes.leaves(scene)
    color, _ = ar.GaussianRasterizer(settings)(**ours)
    expected = reference.render(settings, **theirs, footprint=footprint, **options)
    clear = expected.pixel_margin > 1e-6
    assert clear.float().mean() > 0.9
    g = torch.Generator().manual_seed(6)
    loss = scenes.rand(g, *color.shape, low=-1.0) * clear
    size = max(1.0, expected.color.abs().max().item())
    assert (color - expected.color)[:, clear].abs().max() <= 1e-9 * size
    (color * loss).sum().backward()
    (expected.color * loss).sum().backward()
    for name, leaf in ours.items():
        known = torch.isfinite(theirs[name].grad)  # at the camera it is 0/0 there; here it is culled
        assert (leaf.grad[~known] == 0).all()
        there = torch.where(known, theirs[name].grad, 0)
        actual, wanted = hard_cases.rows(leaf.grad), hard_cases.rows(there)
        error = hard_cases.rows(leaf.grad - there)
        # The reference's quaternions: a difference of terms of the size of the scales' gradient.
        floor = 0
        if name == "rotations":
            floor = hard_cases.rows(theirs["scales"].grad.nan_to_num()) * hard_cases.rows(scene["scales"])
        assert (error <= 1e-8 * (wanted + floor) + 1e-14 * size).all(), (name, error, actual, wanted)


def test_a_colour_of_exactly_zero_has_a_gradient(device, best):
    """Clamped is what is below zero, as in 3DGS: a black point, of coefficient -1/2 / C0, can still brighten."""
    camera, scene = hard_cases.axis_aligned()
    scene = scenes.cast(scene, best, device)
    scene["shs"][:] = 0
    zero = torch.tensor(0.28209479177387814, dtype=best)
    candidates = torch.nextafter(-0.5 / zero, torch.zeros_like(zero)) * torch.tensor([1.0, 1.0], dtype=best)
    black = next(c for c in (-0.5 / zero, *candidates) if c * zero + 0.5 == 0)
    scene["shs"][1, 0] = black.to(device)
    leaves = scenes.leaves(scene)
    camera.render(leaves, footprint="mip")[0].sum().backward()
    assert (leaves["shs"].grad[1, 0] > 0).all()


def test_equal_depths_keep_their_order(device):
    """As given: the image of two splats at one depth changes when they are swapped, and only then."""
    camera, scene = hard_cases.equal_depths()
    scene = scenes.cast(scene, torch.float32, device)
    image = camera.render(scene, footprint="mip")[0]
    # Behind one another by as little as float32 can tell, in that order.
    spread = dict(scene, means3D=scene["means3D"].clone())
    for i in range(4):
        spread["means3D"][i] *= 1 + i * 2.0**-22
    assert (camera.render(spread, footprint="mip")[0] - image).abs().max() < 1e-4
    swapped = {name: value.flip(0) for name, value in scene.items()}
    assert (camera.render(swapped, footprint="mip")[0] - image).abs().max() > 1e-2


def available_memory():
    """Bytes, or 0 where nobody knows."""
    try:
        text = pathlib.Path("/proc/meminfo").read_text()
    except OSError:
        return 0
    return 1024 * int(re.search(r"MemAvailable:\s+(\d+)", text)[1])


def test_image_of_16384_x_16384():
    """3.2 GB: indices of pixels beyond 2^31, and splats at the far corner where they belong. CPU only."""
    if available_memory() < 8 * 2**30:
        pytest.skip("needs 8 GiB of free memory")
    n = 16384
    camera = hard_cases.replace(hard_cases.CAMERA, image_width=n, image_height=n, tanfovx=0.5, tanfovy=0.5)
    means = [[0.0, 0.0], [n - 1.0, n - 1.0], [n - 1.0, 0.0], [8191.5, 8192.25]]
    scene = hard_cases.splats(means, [[1.5, 1.5]] * 4, 0.0, 0.8, 2.0, camera)
    with torch.no_grad():
        image, radii = camera.render(scenes.cast(scene, torch.float32), footprint="mip")
    assert image.shape == (3, n, n)
    assert (radii > 0).all()
    exact = hard_cases.settings_of(camera, torch.float64, torch.float32, ("mip", {}))
    covariance = reference.covariance_3d(scene["scales"], scene["rotations"], 1.0)
    means2d, cov2d, _ = reference.project(exact, scene["means3D"], covariance)
    colors = reference.sh_color(0, scene["shs"], scene["means3D"] - exact.campos)
    for i in range(4):
        x0, y0 = (min(max(int(v) - 4, 0), n - 9) for v in means[i])
        ys, xs = torch.meshgrid(torch.arange(y0, y0 + 9.0), torch.arange(x0, x0 + 9.0), indexing="ij")
        offset = torch.stack([xs, ys], -1) - means2d[i]
        alpha = 0.8 * reference.weight(offset, cov2d[i], "mip")
        alpha = torch.where(alpha < 1 / 255, 0, alpha)
        expected = alpha * colors[i][:, None, None] + (1 - alpha) * exact.bg[:, None, None]
        # A mean is known to a few eps n = 1e-3 px, alpha changes by less than 0.5 per px, and may flip at 1/255.
        error = (image[:, y0 : y0 + 9, x0 : x0 + 9] - expected).abs()
        assert alpha.max() > 0.5
        assert (error < 4 * n * EPS[torch.float32]).float().mean() > 0.9
        assert error.max() < 1.1 / 255


# --- one weight, 40 digits ---------------------------------------------------------------------


def weight_in_40_digits(offset, cov2d, footprint, options):
    """The formulas of docs/internals/numerics.md as they stand there, with mpmath."""
    mp = mpmath.mp
    x, y = offset
    xx, xy, yy = cov2d

    def gaussian(x, y, v, compensated=True):
        det = (xx + v) * (yy + v) - xy * xy
        amplitude = mp.sqrt((xx * yy - xy * xy) / det) if compensated else 1
        return amplitude * mp.exp(-((yy + v) * x * x - 2 * xy * x * y + (xx + v) * y * y) / det / 2)

    if footprint == "point":
        return gaussian(x, y, mp.mpf(options.get("dilation", 0.3)), False)
    if footprint == "mip":
        return gaussian(x, y, mp.mpf(options.get("variance", 0.1)))
    if footprint in ("box", "moment"):
        samples = options["samples"]
        v = mp.mpf(1) / (24 * samples if footprint == "box" and samples > 1 else 12 * samples)
        nodes = reference.box_nodes(samples) if footprint == "box" else reference.cell_nodes(samples)
        return sum(gaussian(x + mp.mpf(a), y + mp.mpf(b), v) for a, b in nodes.tolist()) / samples
    if footprint == "cumulant":
        v = mp.mpf(1) / 12
        det = (xx + v) * (yy + v) - xy * xy
        a, b, c = (yy + v) / det, -xy / det, (xx + v) / det

        def axis(p, t):
            s = t / 12
            c4 = 1 + mp.mpf(20) / 7 * s + mp.mpf("0.4366") * s * s
            k2 = 1 + mp.mpf(10) / 7 * s + mp.mpf("0.6240") * s * s
            k0 = 1 + mp.mpf(20) / 21 * s + mp.mpf("0.6975") * s * s
            c6 = max(1 - s, mp.mpf("1e-6")) / 63
            square = min(p * p, (c4 + mp.sqrt(c4 * c4 - 18 * c6 * t * k2)) / (3 * c6))
            return square * (square * (c4 - c6 * square) - 6 * t * k2) + 3 * t * t * k0

        h = (axis(a * x + b * y, a) + axis(b * x + c * y, c)) / 2880
        return gaussian(x, y, v) * mp.exp(-h)
    # The eigenframe.
    gap = mp.sqrt((xx - yy) ** 2 + 4 * xy * xy)
    angle = mp.atan2(2 * xy, xx - yy) / 2
    l1 = (xx + yy + gap) / 2
    s1, s2 = mp.sqrt(l1), mp.sqrt((xx * yy - xy * xy) / l1)
    if footprint == "exact":
        if yy > xx:
            x, y, xx, yy = y, x, yy, xx
        wide, rate = mp.sqrt(xx), xy / xx
        narrow = mp.sqrt((xx * yy - xy * xy) / xx)
        root = mp.sqrt(2) * narrow

        def strip(t):
            low, high = (y - mp.mpf(1) / 2 - rate * t) / root, (y + mp.mpf(1) / 2 - rate * t) / root
            if low + high < 0:
                low, high = -high, -low
            return mp.exp(-t * t / (2 * xx)) * (mp.erfc(low) - mp.erfc(high))

        begin, end = x - mp.mpf(1) / 2, x + mp.mpf(1) / 2
        # Where the integrand turns: at its peak, and where an edge crosses the ridge.
        turns = [mp.mpf(0)] + ([(y - 0.5) / rate, (y + 0.5) / rate] if rate else [])
        width = min(wide, narrow / abs(rate)) if rate else wide
        turns = [t + k * width for t in turns for k in (-8, -3, -1, 0, 1, 3, 8)]
        points = sorted({begin, end, *(t for t in turns if begin < t < end)})
        return mp.quad(strip, points) * mp.sqrt(mp.pi / 2) * narrow
    u, v = x * mp.cos(angle) + y * mp.sin(angle), y * mp.cos(angle) - x * mp.sin(angle)

    def window(u, s):
        low, high = (abs(u) - mp.mpf(1) / 2) / s, (abs(u) + mp.mpf(1) / 2) / s
        if footprint == "erf":
            return (mp.erfc(low / mp.sqrt(2)) - mp.erfc(high / mp.sqrt(2))) / 2

        def upper(z):  # 1 - S
            f = mp.mpf("1.6") * z + mp.mpf("0.07") * z**3
            return 1 / (1 + mp.exp(min(f, mp.mpf(10) ** 6)))

        return upper(low) - upper(high)

    return 2 * mp.pi * s1 * s2 * window(u, s1) * window(v, s2)


def hard_weights():
    """Covariances (n, 3) [px^2] and offsets (n, 2) [px]: every size, ratio and angle of the battery."""
    shapes = [(s, s, 0.0) for s in (1e-6, 1e-3, 0.05, 0.3, 1.0, 30.0, 1e3, 1e6)]
    shapes += [(1.0, 1 + 1e-7, 0.7), (0.2, 0.2 * (1 + 1e-7), 1.9), (3, 1, 0), (1, 3, 0), (0.3, 0.05, 0.4)]
    shapes += [(30, 0.03, angle) for angle in (0, 0.4, math.pi / 2)]
    shapes += [(300, 1e-3, 1.2), (1e3, 1, 2.5), (30, 3e-5, 0.9)]
    long, across, angle = torch.tensor(shapes, dtype=torch.float64).unbind(-1)
    cov2d = scenes.covariance_2d(long, across, angle)
    axes = torch.stack([torch.cos(angle), torch.sin(angle)], -1)
    offsets = torch.tensor([[0.0, 0.0], [0.5, 0.5], [0.31, -0.22], [1.7, 0.6]], dtype=torch.float64)
    offsets = offsets.expand(len(shapes), 4, 2)
    along = torch.stack([2 * axes * long[:, None].clamp(max=1e3), axes * long[:, None].clamp(max=20) + 0.2], 1)
    offsets = torch.cat([offsets, along], 1)
    return offsets.reshape(-1, 2), cov2d.repeat_interleave(6, 0)


@pytest.mark.parametrize("variant", VARIANTS, ids=name_of)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
def test_weight_in_40_digits(variant, device, dtype):
    """footprint_weight of hard covariances: within 40 roundings of its condition (hard_cases.py)."""
    if variant[0] not in reference.DEFAULT_OPTIONS:
        pytest.skip(f"no independent formula of {variant[0]}")
    report = measure_weights(variant, device, dtype)
    worst = (report["error"] / report["tolerance"]).argmax()
    assert torch.isfinite(report["weight"]).all()
    assert (report["error"] <= report["tolerance"]).all(), {k: v[worst].tolist() for k, v in report.items()}


def condition_of(cov2d):
    """Ratio of the eigenvalues (n,); infinite where the determinant is not positive."""
    values = torch.linalg.eigvalsh(torch.stack([cov2d[:, [0, 1]], cov2d[:, [1, 2]]], -2))
    return torch.where(values[:, 0] > 0, values[:, 1] / values[:, 0], math.inf)


def measure_weights(variant, device, dtype, operations=40):
    """Error of the weight and its tolerance, both relative to the peak of 1."""
    footprint, options = variant
    offsets, cov2d = (t.to(dtype) for t in hard_weights())
    if footprint == "exact":  # 40-digit quadrature takes long: only what test_exact.py leaves out, needles above 100
        needles = condition_of(cov2d.double()) > 1e5
        offsets, cov2d = offsets[needles][::3], cov2d[needles][::3]
    weight = ar.footprint_weight(offsets.to(device), cov2d.to(device), footprint, **options).cpu().double()
    g = torch.Generator().manual_seed(1)
    errors, tolerances = [], []
    with mpmath.workdps(40):
        for i in range(len(weight)):
            d, c = ([mpmath.mpf(v) for v in row.tolist()] for row in (offsets[i].double(), cov2d[i].double()))
            exact = weight_in_40_digits(d, c, footprint, options)
            errors.append(float(abs(mpmath.mpf(weight[i].item()) - exact)))
            moved = 0.0
            for _ in range(2):
                sign = (torch.randint(0, 2, (5,), generator=g) * 2 - 1).tolist()
                eps = mpmath.mpf(EPS[dtype])
                size_d, size_c = max(map(abs, d)), [max(map(abs, c)) if c[1] else abs(v) for v in c]
                near_d = [v + s * eps * size_d for v, s in zip(d, sign)]
                near_c = [v + s * eps * size for v, s, size in zip(c, sign[2:], size_c)]
                if near_c[0] * near_c[2] <= near_c[1] ** 2:  # not a covariance any more: anything goes
                    moved = 1.0
                    continue
                moved = max(moved, float(abs(weight_in_40_digits(near_d, near_c, footprint, options) - exact)))
            tolerances.append(operations * (moved + EPS[dtype]))
    return {
        "weight": weight,
        "error": torch.tensor(errors, dtype=torch.float64),
        "tolerance": torch.tensor(tolerances, dtype=torch.float64),
        "offset": offsets.double(),
        "cov2d": cov2d.double(),
    }


# --- the policy for bad numbers ----------------------------------------------------------------


@hypothesis_settings(max_examples=60, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(seed=st.integers(0, 2**40))
def test_fuzz(device, seed):
    """What is culled leaves no trace, nothing spreads. `make fuzz` does it for as long as you like."""
    fuzz.check(seed, device, torch.float32)
    if device == "cpu":
        fuzz.check(seed, device, torch.float64)


def visible(dtype=torch.float32, device="cpu", precomputed=False):
    """A camera and five large splats that it sees."""
    camera, scene = hard_cases.axis_aligned()
    return camera, scenes.cast(hard_cases.flat(scene) if precomputed else scene, dtype, device)


@each_path
@each_precision
@pytest.mark.parametrize("column", range(4))
def test_a_quaternion_of_zeros_and_a_nan_is_culled(variant, device, dtype, column):
    """Not the identity, which a zero quaternion stands for: max() may drop a NaN."""
    camera, scene = visible(dtype, device)
    scene["rotations"][2] = 0.0
    scene["rotations"][2, column] = math.nan
    assert camera.render(scene, variant)[1].tolist()[2] == 0


BLURS = ar.Effects(defocus=ar.Defocus(0.1, 1.0), motion=ar.Motion(1.0, screen_velocity=(7.0, 5.0)))


@each_path
@each_precision
@pytest.mark.parametrize("effects", [None, BLURS], ids=["plain", "blurred"])
@pytest.mark.parametrize("variance", [-1.0, -0.05, -1e-4])
def test_a_negative_covariance_is_culled(variant, device, dtype, variance, effects):
    """Its projection is negative definite, so that its determinant is positive, but no Gaussian; nor does a blur make
    it one, whose variance outweighs it."""
    camera, scene = visible(dtype, device, precomputed=True)
    scene["means3D"][2, :2] = 0.0  # straight ahead, where the variance along the line of sight adds nothing
    size = (2.0 / hard_cases.FOCAL) ** 2  # 1 px^2
    scene["cov3D_precomp"][2] = torch.tensor([variance, 0, 0, variance, 0, 9.0]) * size
    assert camera.render(scene, variant, effects=effects)[1].tolist()[2] == 0


@each_path
@each_precision
@pytest.mark.parametrize("precomputed", [False, True], ids=["scales", "cov3d"])
def test_a_flat_covariance_has_no_mass_under_a_blur(variant, device, dtype, precomputed):
    """A line and a sheet seen from its edge: det Sigma is zero, so the amplitude is. Culled, with zero gradients, and
    the rest the same to the bit."""
    camera, scene = visible(torch.float64, "cpu")
    for i, scales in ((1, (0.5, 0.0, 0.0)), (2, (0.5, 0.0, 0.25))):
        scene["means3D"][i, 1] = 0.0  # in the sheet
        scene["scales"][i] = torch.tensor(scales)
        scene["rotations"][i] = torch.tensor([1.0, 0, 0, 0])
    if precomputed:
        scene = hard_cases.flat(scene)
        line = torch.tensor([1.0, 2.0, 0.0], dtype=torch.float64)
        scene["cov3D_precomp"][3] = torch.outer(line, line)[tuple(torch.triu_indices(3, 3))] / 64
    else:
        scene["scales"][3] = 0.0
    scene = scenes.cast(scene, dtype, device)

    def gradients(some):
        leaves = scenes.leaves(some)
        color, radii = camera.render(leaves, variant, effects=BLURS)
        (color**2).sum().backward()
        return color.detach(), radii.tolist(), {name: leaf.grad for name, leaf in leaves.items()}

    color, radii, grads = gradients(scene)
    rest = [0, 4]
    expected, rest_radii, rest_grads = gradients({name: value[rest] for name, value in scene.items()})
    assert radii[1:4] == [0, 0, 0] and [radii[i] for i in rest] == rest_radii and min(rest_radii) > 0
    assert torch.equal(color, expected)
    for name, grad in grads.items():
        assert (grad[1:4] == 0).all() and torch.equal(grad[rest], rest_grads[name]), name


def test_a_needle_given_by_its_covariance_is_kept(device, best):
    """Of ratio 1e4 and more its entries, in float32, often have a negative determinant: `point` draws it."""
    angles = torch.linspace(0.1, 3.0, 20, dtype=torch.float64)
    scene = hard_cases.splats([[20.3, 11.6]], torch.tensor([[30.0, 30.0e-5]]).expand(20, 2), angles, 0.9)
    camera = hard_cases.CAMERA
    for i in range(20):
        one = {name: value[i : i + 1].float() for name, value in scene.items()}
        entries = scenes.cast(hard_cases.flat(scenes.cast(one, torch.float64)), torch.float32)
        one = scenes.without(one, "shs") | {"colors_precomp": entries["colors_precomp"]}
        expected, _ = camera.render(scenes.cast(one, best, device), footprint="point")
        image, radii = camera.render(scenes.cast(entries, best, device), footprint="point")
        assert radii[0] > 0
        # Rounding moves Sigma by 2^-24 30^2 = 5e-5 px^2 across, of 0.3: alpha by 2e-4 of itself; 1/255 where it flips.
        assert (image - expected).abs().max() < 1.1 / 255
        assert ((image - expected).abs() > 1e-3).float().mean() < 0.02


BAD = [
    ("means3D", (3, 1), math.nan, "be finite"),
    ("opacities", (1, 0), math.inf, "be finite"),
    ("opacities", (4, 0), 1.5, r"be in \[0, 1\]"),
    ("opacities", (4, 0), -0.25, r"be in \[0, 1\]"),
    ("shs", (2, 0, 1), -math.inf, "be finite"),
    ("scales", (0, 2), math.nan, "be finite"),
    ("scales", (0, 2), -0.5, "not be negative"),
    ("rotations", (4, 3), math.nan, "be finite"),
    ("colors_precomp", (2, 1), math.nan, "be finite"),
    ("cov3D_precomp", (1, 4), math.inf, "be finite"),
    ("cov3D_precomp", (1, 3), -2.0, "not have negative variances"),
]


@pytest.mark.parametrize("name, index, value, expectation", BAD, ids=lambda v: str(v) if isinstance(v, str) else None)
def test_debug_names_the_bad_number(device, name, index, value, expectation, tmp_path, monkeypatch):
    """Tensor, first index and value; without debug nothing is raised, and the image is finite."""
    monkeypatch.chdir(tmp_path)
    camera, scene = visible(torch.float32, device, name in ("colors_precomp", "cov3D_precomp"))
    settings = camera.settings(torch.float32, device, footprint="box", samples=1)
    ar.GaussianRasterizer(settings._replace(debug=True))(**scene)
    scene[name][index] = value
    if name != "opacities":
        scene[name][-1] = scene[name][-1]
    pattern = rf"{name} must {expectation}, got {value:g} at \({', '.join(map(str, index))}\)"
    with pytest.raises(ValueError, match=pattern):
        ar.GaussianRasterizer(settings._replace(debug=True))(**scene)
    assert [path.name for path in tmp_path.iterdir()] == ["snapshot_fw.dump"]
    assert torch.isfinite(ar.GaussianRasterizer(settings)(**scene)[0]).all()


CAMERA_TENSORS = {"viewmatrix": (2, 1), "projmatrix": (0, 3), "campos": (1,), "bg": (2,)}


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("name", CAMERA_TENSORS)
def test_a_camera_that_is_not_finite_raises(device, name, value, tmp_path, monkeypatch):
    """Always on the CPU; on CUDA, where looking at it would wait for the device, with debug."""
    monkeypatch.chdir(tmp_path)
    camera, scene = visible(torch.float32, device)
    settings = camera.settings(torch.float32, device)._replace(debug=device == "cuda")
    broken = getattr(settings, name).clone()
    broken[CAMERA_TENSORS[name]] = value
    index = re.escape(str(CAMERA_TENSORS[name]))
    with pytest.raises(ValueError, match=rf"{name} must be finite, got {value:g} at {index}"):
        ar.GaussianRasterizer(settings._replace(**{name: broken}))(**scene)


@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf, 1e-60, 1e60])
@pytest.mark.parametrize("name", ["tanfovx", "tanfovy", "scale_modifier"])
def test_a_number_that_makes_no_camera_raises(device, name, value):
    """On every device: they are numbers of Python. 1e-60 is zero, and 1e60 infinite, in float32."""
    camera, scene = visible(torch.float32, device)
    with pytest.raises(ValueError, match=f"{name} must be positive and finite"):
        ar.GaussianRasterizer(camera.settings(torch.float32, device)._replace(**{name: value}))(**scene)


@pytest.mark.parametrize("value", [0, -3, 2**21])
@pytest.mark.parametrize("name", ["image_width", "image_height"])
def test_a_size_that_makes_no_image_raises(device, name, value):
    camera, scene = visible(torch.float32, device)
    with pytest.raises(ValueError, match=rf"{name} must be in \[1, \d+\], got {value}"):
        ar.GaussianRasterizer(camera.settings(torch.float32, device)._replace(**{name: value}))(**scene)


def test_a_camera_that_sees_nothing_is_no_error(device):
    """A singular projection, every Gaussian behind: the background, and zero gradients."""
    camera, scene = visible(torch.float32, device)
    settings = camera.settings(torch.float32, device)
    away = Camera(image_width=9, image_height=7, eye=(0.0, 0.0, 50.0), target=(0.0, 0.0, 60.0))
    for s in (settings._replace(projmatrix=torch.zeros(4, 4, device=device)), away.settings(torch.float32, device)):
        leaves = scenes.leaves(scene)
        color, radii = ar.GaussianRasterizer(s)(**leaves)
        assert torch.equal(color, s.bg[:, None, None].expand_as(color))
        assert (radii == 0).all()
        color.sum().backward()
        assert all((leaf.grad == 0).all() for leaf in leaves.values())


# --- the document ------------------------------------------------------------------------------


def test_the_document_has_every_case():
    text = (DOCS / "internals" / "testing.md").read_text()
    for case in CASES:
        assert f"`{case.name}`" in text, f"docs/internals/testing.md has no row for {case.name}"


@pytest.mark.parametrize("document", ["reliability.md", "internals/testing.md"])
def test_a_document_names_tests_that_exist(document):
    files = sorted((ROOT / "tests").rglob("test_*.py"))
    sources = "".join(path.read_text() for path in files)
    names = set(re.findall(r"\btest_\w+", (DOCS / document).read_text()))
    assert names
    for name in names:
        known = f"def {name}(" in sources or name in {path.stem for path in files}
        assert known, f"docs/{document} names {name}, which does not exist"
