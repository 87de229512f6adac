"""Lenses: the map is that of the formulas, the picture shows Gaussians where it says, and gradients are derivatives."""

import math

import pytest
import scenes
import torch

import analytic_rasterizer as ar
from analytic_rasterizer import _C

SIGNS = (1, -1)
LENSES = {
    "perspective": lambda s: ar.Lens.perspective(
        [s * 0.1, s * -0.05, s * 0.02, s * 0.03, s * 0.02, s * -0.01],
        [s * 0.01, s * -0.02],
        [s * 0.01, 0.02, -0.01, s * 0.005],
    ),
    "fisheye": lambda s: ar.Lens.fisheye(
        [s * 0.05, s * 0.01, s * -0.001, s * 0.0003], [s * 0.01, s * -0.005], [s * 0.004, 0.002, s * -0.003, 0.001]
    ),
    "rad_tan_fisheye": lambda s: ar.Lens.rad_tan_fisheye(
        [s * 0.05, s * 0.01, s * -0.001, s * 0.0003, s * 1e-5, s * 1e-6],
        [s * 0.01, s * -0.005],
        [s * 0.004, 0.002, 0.003, 0.001],
    ),
    "fov": lambda s: ar.Lens.fov(1.1 if s > 0 else 0.3),
}
each_lens = pytest.mark.parametrize(
    "lens", [pytest.param(make(s), id=f"{name}{'+' if s > 0 else '-'}") for name, make in LENSES.items() for s in SIGNS]
)


def textbook(lens, points):
    """The formulas of OpenCV and COLMAP (https://colmap.github.io/cameras.html), for (N, 3) points."""
    x, y, z = points.unbind(1)
    k = lens.coefficients
    if lens.model in ("perspective", "fov"):
        a, b = x / z, y / z
    else:
        rho = torch.hypot(x, y)
        theta = torch.atan2(rho, z)
        a, b = theta * x / rho, theta * y / rho
    r2 = a * a + b * b
    if lens.model == "fov":
        r = r2.sqrt()
        scale = torch.atan(2 * r * math.tan(k[0] / 2)) / (k[0] * r)
        return torch.stack([scale * a, scale * b], 1)
    if lens.model == "rad_tan_fisheye":
        scale = 1 + sum(c * r2 ** (i + 1) for i, c in enumerate(k[:6]))
        u, v = scale * a, scale * b
        r2 = u * u + v * v
        p0, p1, s0, s1, s2, s3 = k[6:]
        return torch.stack(
            [
                u + 2 * (u * p0 + v * p1) * u + r2 * p0 + s0 * r2 + s1 * r2**2,
                v + 2 * (u * p0 + v * p1) * v + r2 * p1 + s2 * r2 + s3 * r2**2,
            ],
            1,
        )
    if lens.model == "perspective":
        scale = (1 + k[0] * r2 + k[1] * r2**2 + k[2] * r2**3) / (1 + k[3] * r2 + k[4] * r2**2 + k[5] * r2**3)
    else:
        scale = 1 + k[0] * r2 + k[1] * r2**2 + k[2] * r2**3 + k[3] * r2**4
    p1, p2, s1, s2, s3, s4 = k[6:]
    return torch.stack(
        [
            a * scale + 2 * p1 * a * b + p2 * (r2 + 2 * a * a) + s1 * r2 + s2 * r2**2,
            b * scale + p1 * (r2 + 2 * b * b) + 2 * p2 * a * b + s3 * r2 + s4 * r2**2,
        ],
        1,
    )


@each_lens
def test_map_is_that_of_the_formulas(lens):
    """Everywhere, near the axis, and for fisheyes behind the camera."""
    generator = torch.Generator().manual_seed(0)
    points = torch.randn(2000, 3, dtype=torch.float64, generator=generator)
    if lens.model not in ("fisheye", "rad_tan_fisheye"):
        points[:, 2] = points[:, 2].abs() + 0.5
    points[::5, :2] *= 1e-4
    seen, slopes = _C.lens_points(lens.model, list(lens.coefficients), points)
    expected = textbook(lens, points)
    torch.testing.assert_close(seen, expected, rtol=1e-11, atol=1e-12)
    leaf = points.clone().requires_grad_()
    for k in range(2):
        (by_points,) = torch.autograd.grad(textbook(lens, leaf)[:, k].sum(), leaf)
        torch.testing.assert_close(slopes[:, k], by_points, rtol=1e-7, atol=1e-7 * by_points.abs().max().item())


def settings_of(lens, dtype=torch.float64, device="cpu", w2c=None, fx=40.0, fy=42.0, cx=25.0, cy=19.0, **effects):
    w2c = torch.eye(4, dtype=torch.float64) if w2c is None else w2c
    options = {"sh_degree": 1, "dtype": dtype, "device": device, "footprint": "box:samples=4"}
    return ar.camera_settings(w2c, 48, 36, fx, fy, cx, cy, effects=ar.Effects(lens=lens, **effects), **options)


@each_lens
@pytest.mark.parametrize("angle", [5, 25, 110])
def test_a_gaussian_is_seen_where_the_map_says(lens, angle):
    """Also more than 90 degrees from the axis."""
    if angle > 90 and lens.model not in ("fisheye", "rad_tan_fisheye"):
        pytest.skip("this model sees less than a half space")
    a = math.radians(angle)
    mean = 3 * torch.tensor([[0.8 * math.sin(a), 0.6 * math.sin(a), math.cos(a)]], dtype=torch.float64)
    focal = 40.0 if angle < 90 else 8.0
    settings = settings_of(lens, fx=focal, fy=focal, cx=24.0, cy=18.0)
    splats = ar.project(
        settings,
        means3D=mean,
        scales=torch.full((1, 3), 0.01, dtype=torch.float64),
        rotations=torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64),
        opacities=torch.ones(1, 1, dtype=torch.float64),
        colors_precomp=torch.ones(1, 3, dtype=torch.float64),
    )
    u = textbook(lens, mean)[0]
    expected = focal * u + torch.tensor([24.0, 18.0], dtype=torch.float64) - 0.5  # pixel 0 has its centre at 0.5
    assert len(splats.means2d) == (a < lens.fold)  # beyond it is culled
    if a >= lens.fold:
        return
    torch.testing.assert_close(splats.means2d[0], expected, rtol=1e-10, atol=1e-10)


def test_no_coefficients_are_a_pinhole():
    scene = scenes.cast(scenes.random_scene(1, 40, degree=1, spread=0.2), torch.float64, "cpu")
    pinhole = ar.GaussianRasterizer(settings_of(None))(**scene)[0]
    through_lens = ar.GaussianRasterizer(settings_of(ar.Lens.perspective()))(**scene)[0]
    torch.testing.assert_close(through_lens, pinhole, rtol=1e-9, atol=1e-9)


def test_where_the_map_folds_back_nothing_is_drawn():
    lens = ar.Lens.perspective([-0.2])
    fold = math.atan(math.sqrt(1 / 0.6))  # d(r - 0.2 r^3)/dr = 0
    assert lens.fold == pytest.approx(fold, abs=1e-4)
    assert ar.Lens.fisheye().fold == pytest.approx(math.pi, abs=2e-3)
    angles = torch.tensor([fold - 0.02, fold + 0.02], dtype=torch.float64)
    means = torch.stack([angles.sin(), torch.zeros(2), angles.cos()], 1).double()
    settings = settings_of(lens, fx=10.0, fy=10.0, cx=24.0, cy=18.0)
    _, radii = ar.GaussianRasterizer(settings)(
        means3D=means,
        means2D=None,
        scales=torch.full((2, 3), 0.01, dtype=torch.float64),
        rotations=torch.tensor([[1.0, 0, 0, 0]] * 2, dtype=torch.float64),
        opacities=torch.ones(2, 1, dtype=torch.float64),
        colors_precomp=torch.ones(2, 3, dtype=torch.float64),
    )
    assert radii[0] > 0 and radii[1] == 0


def loss_of(inputs, settings, g):
    """A weighted sum of the picture and its depth."""
    color, _, outputs = ar.GaussianRasterizer(settings)(**{"means2D": None} | inputs)
    return (color * g[:3]).sum() + 0.1 * (outputs.depth * g[3]).sum()


@each_lens
def test_gradients_are_derivatives(lens):
    """By Gaussians, pose, focal lengths, principal point and coefficients, along random directions."""
    generator = torch.Generator().manual_seed(3)
    scene = scenes.cast(scenes.random_scene(2, 12, degree=1, sigma=(0.1, 0.3), spread=0.5), torch.float64, "cpu")
    del scene["means2D"]
    g = torch.rand(4, 36, 48, dtype=torch.float64, generator=generator) - 0.5
    values = scene | {
        "coefficients": torch.tensor(lens.coefficients, dtype=torch.float64),
        "tangent": torch.zeros(6, dtype=torch.float64),
        "camera": torch.tensor([40.0, 42.0, 25.0, 19.0], dtype=torch.float64),
    }
    reach = lens.with_reach([0.6, 0.45], [0.0, 0.0]).reach

    def loss(values):
        bent = ar.Lens(lens.model, values["coefficients"], reach)
        w2c = ar.moved(torch.eye(4, dtype=torch.float64), values["tangent"])
        fx, fy, cx, cy = values["camera"]
        settings = settings_of(bent, w2c=w2c, fx=fx, fy=fy, cx=cx, cy=cy, camera_gradients=True, depth=True)
        return loss_of({name: values[name] for name in scene}, settings, g)

    leaves = {name: value.clone().requires_grad_() for name, value in values.items()}
    grads = dict(zip(leaves, torch.autograd.grad(loss(leaves), list(leaves.values()))))
    for name, value in values.items():
        direction = torch.randn(value.shape, dtype=torch.float64, generator=generator)
        if name == "coefficients" and lens.model == "fov":
            direction[1:] = 0
        h = 1e-7
        with torch.no_grad():
            up, down = (loss(values | {name: value + sign * h * direction}) for sign in (1, -1))
        expected, actual = (up - down) / (2 * h), (grads[name] * direction).sum()
        # Rounding of the loss, 1e-13 of order 100, over h. So small a step rarely moves a pixel out of a support.
        assert abs(actual - expected) <= 1e-5 * abs(expected) + 1e-4, (name, actual.item(), expected.item())


@each_lens
def test_devices_and_precisions_agree(device, lens):
    scene = scenes.random_scene(4, 60, degree=1, spread=0.6)
    g = torch.rand(4, 36, 48, generator=torch.Generator().manual_seed(1)).double() - 0.5
    results = []
    for dtype, where in ((torch.float64, "cpu"), (torch.float32, device)):
        leaves = scenes.leaves(scenes.cast(scene, dtype, where))
        k = torch.tensor(lens.coefficients, dtype=torch.float64).requires_grad_()
        settings = settings_of(ar.Lens(lens.model, k), dtype, where, camera_gradients=True, depth=True)
        loss_of(leaves, settings, g.to(where, dtype)).backward()
        grads = {name: leaf.grad for name, leaf in leaves.items() if name != "means2D"} | {"coefficients": k.grad}
        results.append({name: grad.double().cpu() for name, grad in grads.items()})
    for name, expected in results[0].items():
        error = (results[1][name] - expected).norm() / expected.norm()
        assert error < 2e-3, (name, error.item())


@pytest.mark.parametrize(
    "make, match",
    [
        (lambda: ar.Lens("mirror", (0.0,)), "model must be one of perspective"),
        (lambda: ar.Lens.perspective([0.1] * 7), "radial must have at most 6 numbers, got 7"),
        (lambda: ar.Lens.fisheye([math.nan]), "every number of radial must be finite"),
        (lambda: ar.Lens("fov", ()), "w of a fov lens must be above 0"),
        (lambda: ar.Lens.fov(0.0), "w of a fov lens must be above 0"),
        (lambda: ar.Lens("fisheye", torch.zeros(3)), r"coefficients must have shape \(12,\), got \(3,\)"),
        (lambda: ar.Effects(lens=ar.Lens.fisheye(), orthographic=True), "lens must be None for an orthographic"),
    ],
)
def test_what_is_refused(make, match):
    with pytest.raises(ValueError, match=match):
        make()


def test_a_lens_must_be_one():
    with pytest.raises(TypeError, match="lens must be a Lens or None"):
        ar.Effects(lens="fisheye")
    with pytest.raises(TypeError, match="radial must be a sequence of numbers"):
        ar.Lens.fisheye(0.1)
    with pytest.raises(TypeError, match="radial must hold numbers, or coefficients be one tensor"):
        ar.Lens.fisheye([torch.tensor(0.1, requires_grad=True)])
