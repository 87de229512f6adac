"""Lenses: the map is that of the formulas, and the picture shows Gaussians where it says. See test_lens_hard.py too."""

import math

import pytest
import reference
import scenes
import torch
from camera_reference import textbook

import analytic_rasterizer as ar
from analytic_rasterizer import _C

EYE = torch.eye(4, dtype=torch.float64)
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
SPHERE = ar.Lens.equirectangular()
each_lens = pytest.mark.parametrize(
    "lens",
    [pytest.param(make(s), id=f"{name}{'+' if s > 0 else '-'}") for name, make in LENSES.items() for s in SIGNS]
    + [pytest.param(SPHERE, id="equirectangular")],
)
BEHIND = ("fisheye", "rad_tan_fisheye", "equirectangular")  # models that see behind the camera


@each_lens
def test_map_is_that_of_the_formulas(lens):
    """Everywhere, near the axis, and behind the camera if the lens sees that."""
    generator = torch.Generator().manual_seed(0)
    points = torch.randn(2000, 3, dtype=torch.float64, generator=generator)
    if lens.model not in BEHIND:
        points[:, 2] = points[:, 2].abs() + 0.5
    points[::5, :2] *= 1e-4
    seen, slopes = _C.lens_points(lens.model, list(lens.coefficients), points)
    expected = textbook(lens, points)
    torch.testing.assert_close(seen, expected, rtol=1e-11, atol=1e-12)
    leaf = points.clone().requires_grad_()
    for k in range(2):
        (by_points,) = torch.autograd.grad(textbook(lens, leaf)[:, k].sum(), leaf)
        torch.testing.assert_close(slopes[:, k], by_points, rtol=1e-7, atol=1e-7 * by_points.abs().max().item())


def settings_of(lens, dtype=torch.float64, device="cpu", w2c=EYE, fx=40.0, fy=42.0, cx=25.0, cy=19.0, **effects):
    options = {"sh_degree": 1, "dtype": dtype, "device": device, "footprint": "box:samples=4"}
    return ar.camera_settings(w2c, 48, 36, fx, fy, cx, cy, effects=ar.Effects(lens=lens, **effects), **options)


@each_lens
@pytest.mark.parametrize("angle", [5, 25, 110])
def test_a_gaussian_is_seen_where_the_map_says(lens, angle):
    """Also more than 90 degrees from the axis."""
    if angle > 90 and lens.model not in BEHIND:
        pytest.skip("this model sees less than a half space")
    a = math.radians(angle)
    mean = 3 * torch.tensor([[0.8 * math.sin(a), 0.6 * math.sin(a), math.cos(a)]], dtype=torch.float64)
    focal = 40.0 if angle < 90 else 8.0
    splats = ar.project(settings_of(lens, fx=focal, fy=focal, cx=24.0, cy=18.0), **scenes.balls(mean, 0.01))
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
    _, radii = ar.GaussianRasterizer(settings)(means2D=None, **scenes.balls(means, 0.01))
    assert radii[0] > 0 and radii[1] == 0


def loss_of(inputs, settings, g):
    """A weighted sum of the picture, its depth, and its inverse depth if that is asked for."""
    color, _, outputs = ar.GaussianRasterizer(settings)(**{"means2D": None} | inputs)
    loss = (color * g[:3]).sum() + 0.1 * (outputs.depth * g[3]).sum()
    return loss if outputs.inverse_depth is None else loss + (outputs.inverse_depth * g[3]).sum()


@each_lens
def test_devices_and_precisions_agree(device, lens):
    scene = scenes.random_scene(4, 60, degree=1, spread=0.6)
    g = torch.rand(4, 36, 48, generator=torch.Generator().manual_seed(1)).double() - 0.5
    results = []
    for dtype, where in ((torch.float64, "cpu"), (torch.float32, device)):
        leaves = scenes.leaves(scenes.cast(scene, dtype, where))
        k = torch.tensor(lens.coefficients, dtype=torch.float64).requires_grad_()
        bent = lens if lens == SPHERE else ar.Lens(lens.model, k)
        settings = settings_of(bent, dtype, where, camera_gradients=True, depth=True, inverse_depth=True)
        loss_of(leaves, settings, g.to(where, dtype)).backward()
        grads = {name: leaf.grad for name, leaf in leaves.items() if name != "means2D"}
        grads |= {} if lens == SPHERE else {"coefficients": k.grad}
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
        (lambda: ar.Lens("equirectangular", (0.1,)), "coefficients of an equirectangular lens must be zero"),
        (lambda: ar.Lens("equirectangular", torch.zeros(12)), "coefficients of an equirectangular lens must be zero"),
        (lambda: ar.Lens("equirectangular", (), 1.6), "reach of an equirectangular lens must be below pi/2"),
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


def around(seed, count, sigma=(0.02, 0.5)):
    """Gaussians in all directions from the camera, 1 to 4 world units away; two of them almost on the poles."""
    generator = torch.Generator().manual_seed(seed)
    scene = scenes.cast(scenes.random_scene(seed, count, degree=1, sigma=sigma), torch.float64, "cpu")
    direction = torch.nn.functional.normalize(torch.randn(count, 3, dtype=torch.float64, generator=generator), dim=1)
    direction[0], direction[1] = torch.tensor([[1e-3, 1, -2e-3], [-1e-9, -1, 0]], dtype=torch.float64)
    direction[2], direction[3] = torch.tensor([[0.0, 0, -1], [-1e-9, 0.3, -1]], dtype=torch.float64)  # on the seam
    distance = 1 + 3 * torch.rand(count, 1, dtype=torch.float64, generator=generator)
    return scene | {"means3D": distance * direction}


OF_CAMERA = ("dtype", "device", "footprint", "cx", "cy", "bg")


def sphere(width=64, height=32, w2c=EYE, tan=1.0, **more):
    """Settings of a picture of the whole sphere; `tan`: a factor of the focal lengths. What is no option of
    `camera_settings` is an effect."""
    options = {"sh_degree": 1, "dtype": torch.float64, "footprint": "box:samples=4"}
    options |= {name: more.pop(name) for name in OF_CAMERA if name in more}
    fx, fy = tan * width / (2 * math.pi), tan * height / math.pi
    return ar.camera_settings(w2c, width, height, fx, fy, effects=ar.Effects(lens=SPHERE, **more), **options)


QUARTER = torch.tensor([[0.0, 0, -1, 0], [0, 1, 0, 0], [1, 0, 0, 0], [0, 0, 0, 1]], dtype=torch.float64)  # to the left


@pytest.mark.parametrize("footprint", ["point", "analytic", "box:samples=16", "moment:samples=4"])
def test_a_turn_about_the_vertical_rolls_the_picture(footprint):
    """So the seam is nowhere to be seen, in no output."""
    scene = around(1, 150)
    images = {"alpha": True, "depth": True, "inverse_depth": True, "median_depth": True, "dominant_index": True}
    pictures = []
    for w2c in (EYE, QUARTER, QUARTER @ QUARTER):
        color, radii, outputs = ar.GaussianRasterizer(sphere(w2c=w2c, footprint=footprint, **images))(**scene)
        assert (radii > 0).all()
        pictures.append([color, *(getattr(outputs, name).double() for name in images)])
    for turns in (1, 2):
        for straight, turned in zip(pictures[0], pictures[turns]):
            torch.testing.assert_close(turned.roll(16 * turns, 2), straight, rtol=1e-9, atol=1e-9)


def by_the_formulas(scene, settings):
    """Colour (3, H, W) and alpha (H, W) of `point` with a dilation of 0.3, every splat in every pixel."""
    height, width = settings.image_height, settings.image_width
    fx, fy = width / (2 * settings.tanfovx), height / (2 * settings.tanfovy)
    view = torch.cat([scene["means3D"], torch.ones(len(scene["means3D"]), 1)], 1) @ settings.viewmatrix
    p, turn = view[:, :3], 2 * math.pi * fx
    distance, across = p.norm(dim=1), torch.hypot(p[:, 0], p[:, 2])
    # The Jacobian: nearer than half a pixel to a pole that at half a pixel.
    limit = math.sin(0.5 / fy)
    polar = across < limit * distance
    longitude = torch.atan2(p[:, 0], p[:, 2])
    height_of_edge = math.sqrt(1 - limit**2) * torch.where(p[:, 1] < 0, -1.0, 1.0)
    edge = torch.stack([limit * longitude.sin(), height_of_edge, limit * longitude.cos()], 1)
    q = torch.where(polar[:, None], distance[:, None] * edge, p)
    leaf = q.clone().requires_grad_()
    seen = textbook(SPHERE, leaf)
    focal = torch.tensor([fx, fy], dtype=torch.float64)
    slopes = [torch.autograd.grad(seen[:, k].sum(), leaf, retain_graph=True)[0] for k in (0, 1)]
    jacobian = torch.stack([fx * slopes[0], fy * slopes[1]], 1)
    to_pixel = jacobian @ settings.viewmatrix[:3, :3].T
    cov = to_pixel @ reference.covariance_3d(scene["scales"], scene["rotations"], 1.0) @ to_pixel.transpose(1, 2)
    means = textbook(SPHERE, p) * focal + torch.tensor([width, height]) / 2 - 0.5
    # Splats wider than 3/4 of a turn are narrowed, and the copies of a splat are together as opaque as it is.
    narrowing = (0.75 * turn / cov[:, 0, 0].sqrt()).clamp(max=1)
    cov2d = torch.stack([cov[:, 0, 0] * narrowing**2, cov[:, 0, 1] * narrowing, cov[:, 1, 1]], 1)
    falloff = [torch.exp(-((k * turn) ** 2) / (2 * cov2d[:, 0])) for k in range(-4, 5)]
    low, high = torch.zeros(2, len(p), dtype=torch.float64)
    high = high + 1
    for _ in range(60):
        opacities = (low + high) / 2
        opaque = 1 - math.prod(1 - opacities * w for w in falloff) > scene["opacities"][:, 0]
        low, high = torch.where(opaque, low, opacities), torch.where(opaque, opacities, high)
    colors = reference.sh_color(1, scene["shs"], scene["means3D"] - settings.campos)
    y, x = torch.meshgrid(torch.arange(height).double(), torch.arange(width).double(), indexing="ij")
    color, light = torch.zeros(3, height, width, dtype=torch.float64), torch.ones(height, width, dtype=torch.float64)
    for i in distance.argsort().tolist():
        for k in range(-8, 9):
            offset = torch.stack([x - means[i, 0] - k * turn, y - means[i, 1]], -1)
            alpha = (opacities[i] * reference.weight(offset, cov2d[i], "point")).clamp(max=0.99)
            alpha = torch.where((alpha >= 1 / 255) & (light * (1 - alpha) >= 1e-4), alpha, 0.0)
            color += light * alpha * colors[i][:, None, None]
            light = light * (1 - alpha)
    return color, 1 - light


@pytest.mark.parametrize("size", [(64, 32), (50, 40)])
def test_no_pixel_of_the_sphere_is_missed(size):
    """Against all splats in all pixels, with all of their copies. Opacities are low: no pixel is full."""
    scene = around(2, 120)
    scene["opacities"] *= 0.3
    settings = sphere(*size, moved_quarter(), footprint="point", alpha=True)
    color, _, outputs = ar.GaussianRasterizer(settings)(**scene)
    expected, alpha = by_the_formulas(scene, settings)
    torch.testing.assert_close(outputs.alpha[0], alpha, rtol=0, atol=1e-9)
    torch.testing.assert_close(color, expected, rtol=0, atol=1e-9)


def moved_quarter():
    """A pose with every angle and shift."""
    return ar.moved(EYE, torch.tensor([0.1, -0.2, 0.15, 0.4, -0.7, 0.2]).double())


@pytest.mark.parametrize("axis", [1, -1])
@pytest.mark.parametrize("opacity, tolerance", [(0.1, 2 / 255), (0.7, 0.07)])
def test_a_splat_on_a_pole_is_a_cap(axis, opacity, tolerance):
    """As opaque in every column as a disc about the pole is, and once: copies do not add up, but for second powers of
    the opacity, away from the pole, and for what a copy below 1/255 leaves out. Without a correction the poles would be
    at 0.17 and 0.9."""
    sigma = 0.25
    ball = scenes.balls(torch.tensor([[0.0, 2.0 * axis, 0]], dtype=torch.float64), 2 * sigma, opacity)
    settings = sphere(96, 48, footprint="point:dilation=0", alpha=True)
    _, _, outputs = ar.GaussianRasterizer(settings)(means2D=None, **ball)
    rows = (torch.arange(48) + 0.5) * math.pi / 48
    from_pole = rows if axis < 0 else math.pi - rows
    expected = opacity * torch.exp(-0.5 * (from_pole / sigma) ** 2)
    shown = (expected > 0.02).nonzero()[:, 0]
    at_pole = outputs.alpha[0, 0 if axis < 0 else -1]
    torch.testing.assert_close(at_pole, torch.full_like(at_pole, opacity), rtol=0.01, atol=1.5 / 255)
    everywhere = expected[shown, None].expand(-1, 96).double()
    torch.testing.assert_close(outputs.alpha[0, shown], everywhere, rtol=0, atol=tolerance)


def test_gradients_at_the_poles_are_finite():
    """Also when a Gaussian is on the axis, where the longitude has no derivative, and with motion and defocus."""
    scene = around(3, 8)
    tiny = torch.tensor([0.0, 1e-300, 1e-30, 1e-12, 1e-4], dtype=torch.float64)
    means = torch.stack([tiny, torch.full_like(tiny, 2), -tiny], 1)
    scene = {name: value[:5].clone() for name, value in scene.items()} | {"means3D": means}
    lens, shutter = ar.Defocus(0.05, 3.0), ar.Motion(1.0, (0.1, 0.05, 0.1), (0.02, 0.0, 0.01))
    for dtype in (torch.float64, torch.float32):
        leaves = scenes.leaves(scenes.cast(scene, dtype, "cpu"))
        tangent = torch.zeros(6, dtype=torch.float64).requires_grad_()
        blurs = {"depth": True, "defocus": lens, "motion": shutter, "camera_gradients": True}
        settings = sphere(w2c=ar.moved(EYE, tangent), dtype=dtype, **blurs)
        color, radii, outputs = ar.GaussianRasterizer(settings)(**leaves)
        weights = torch.linspace(-1, 1, color.numel(), dtype=dtype).reshape(color.shape)
        ((color * weights).sum() + outputs.depth.square().sum()).backward()
        assert (radii > 0).all() and color.isfinite().all()
        for name, leaf in (leaves | {"tangent": tangent}).items():
            assert leaf.grad.isfinite().all(), name
        # No derivative of a pixel by a mean is larger than at half a pixel from the pole, 2 fx fy / distance.
        assert leaves["means3D"].grad.abs().max() < 1e6


def test_gradients_around_the_sphere_are_derivatives():
    """Of splats across the seam, and of splats so wide that they overlap themselves."""
    generator = torch.Generator().manual_seed(3)
    scene = around(4, 30, sigma=(0.1, 0.6))
    del scene["means2D"]
    scene["means3D"][:2] += torch.tensor([0.2, 0, 0.1])  # the derivative on a pole itself is bounded, and another
    g = torch.rand(4, 32, 64, dtype=torch.float64, generator=generator) - 0.5
    values = scene | {
        "tangent": torch.zeros(6, dtype=torch.float64),
        "camera": torch.tensor([64 / (2 * math.pi) * 1.1, 32 / math.pi, 33.0, 15.0], dtype=torch.float64),
        "blur": torch.tensor([0.05, 2.5, 0.1, -0.2, 0.1, 0.02, 0.03, -0.02], dtype=torch.float64),
    }

    def loss(values):
        w2c, blur = ar.moved(EYE, values["tangent"]), values["blur"]
        blurs = {"defocus": ar.Defocus(blur[0], blur[1]), "motion": ar.Motion(1.0, blur[2:5], blur[5:])}
        lens = ar.Lens("equirectangular", (), 1.5)
        effects = ar.Effects(lens=lens, camera_gradients=True, depth=True, **blurs)
        options = {"sh_degree": 1, "dtype": torch.float64, "footprint": "box:samples=4"}
        settings = ar.camera_settings(w2c, 64, 32, *values["camera"], effects=effects, **options)
        return loss_of({name: values[name] for name in scene}, settings, g)

    leaves = {name: value.clone().requires_grad_() for name, value in values.items()}
    grads = dict(zip(leaves, torch.autograd.grad(loss(leaves), list(leaves.values()))))
    for name, value in values.items():
        direction = torch.randn(value.shape, dtype=torch.float64, generator=generator)
        h = 1e-7
        with torch.no_grad():
            up, down = (loss(values | {name: value + sign * h * direction}) for sign in (1, -1))
        expected, actual = (up - down) / (2 * h), (grads[name] * direction).sum()
        assert abs(actual - expected) <= 1e-5 * abs(expected) + 1e-4, (name, actual.item(), expected.item())


def test_gradients_of_means2d_count_every_copy():
    """Their sum is the derivative by the principal point. The sums of absolute values are those of single pixels."""
    scene = around(5, 40)
    principal = torch.tensor([32.0, 16.0], dtype=torch.float64).requires_grad_()
    settings = sphere(cx=principal[0], cy=principal[1], camera_gradients=True)
    rasterize = ar.GaussianRasterizer(settings)
    g = torch.rand(3, 32, 64, dtype=torch.float64, generator=torch.Generator().manual_seed(1)) - 0.5
    half = torch.tensor([32.0, 16.0], dtype=torch.float64)
    gradients = {}
    for columns in (3, 4):
        scene["means2D"] = torch.full((40, columns), math.nan, dtype=torch.float64).requires_grad_()  # is not read
        color, _ = rasterize(**scene)
        loss, inputs = (color * g).sum(), [scene["means2D"], principal]
        gradients[columns], by_principal = torch.autograd.grad(loss, inputs, retain_graph=True)
        torch.testing.assert_close(gradients[columns][:, :2].sum(0) / half, by_principal, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(gradients[3][:, :2], gradients[4][:, :2])
    assert (gradients[3][:, 2] == 0).all()

    one = {name: value[3:4].detach() for name, value in scene.items()}  # on the seam
    one["means2D"] = torch.zeros(1, 4, dtype=torch.float64).requires_grad_()
    color, _ = rasterize(**one)
    (sums,) = torch.autograd.grad((color * g).sum(), one["means2D"], retain_graph=True)
    expected = torch.zeros(2, dtype=torch.float64)
    for row, column in (color.detach() > 0).any(0).nonzero().tolist():
        (of_pixel,) = torch.autograd.grad((color * g)[:, row, column].sum(), one["means2D"], retain_graph=True)
        expected += of_pixel[0, :2].abs()
    assert (color.detach()[:, :, 0] > 0).any() and (color.detach()[:, :, -1] > 0).any()
    torch.testing.assert_close(sums[0, 2:], expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("where", ["behind", "seam"])
def test_a_crop_is_a_part_of_the_picture(where):
    """Also across the seam: the longitude is that which the picture shows."""
    scene = around(6, 100)
    whole = ar.GaussianRasterizer(sphere())(**scene)[0]
    left = {"behind": 3, "seam": 50}[where]
    fx, fy = 64 / (2 * math.pi), 32 / math.pi
    settings = ar.camera_settings(
        EYE, 24, 20, fx, fy, 32.0 - left, 16.0 - 5, sh_degree=1, dtype=torch.float64,
        footprint="box:samples=4", effects=ar.Effects(lens=ar.Lens("equirectangular", (), SPHERE_REACH)),
    )  # fmt: skip
    color, _ = ar.GaussianRasterizer(settings)(**scene)
    torch.testing.assert_close(color, whole.roll(-left, 2)[:, 5:25, :24], rtol=1e-9, atol=1e-9)


SPHERE_REACH = math.pi / 2 - math.pi / 64  # of a picture of 32 rows


@pytest.mark.parametrize("lens", [ar.Lens.fisheye(), ar.Lens.rad_tan_fisheye(), SPHERE], ids=lambda lens: lens.model)
@pytest.mark.parametrize("angle", [89.9, 90.0, 90.1, 140])
def test_the_nearest_is_in_front(lens, angle):
    """By the distance: behind the camera, camera-space z has the opposite order. Depths are distances, too."""
    a = math.radians(angle)
    direction = torch.tensor([[math.sin(a), 0, math.cos(a)]], dtype=torch.float64)
    distance = torch.tensor([[3.0], [1], [2]], dtype=torch.float64)
    settings = settings_of(lens, fx=8.0, fy=8.0, cx=24.0, cy=18.0, depth=True, median_depth=True, alpha=True)
    rasterize = ar.GaussianRasterizer(settings)
    balls = scenes.balls(distance * direction, 0.3 * distance, colors=torch.eye(3, dtype=torch.float64))
    color, _, outputs = rasterize(means2D=None, **balls)
    full = (outputs.alpha[0] > 0.99).nonzero()
    assert len(full)
    for row, column in full.tolist():
        assert color[:, row, column].argmax() == 1
        assert outputs.median_depth[0, row, column] == pytest.approx(1)
        assert 1 <= outputs.depth[0, row, column] / outputs.alpha[0, row, column] < 1.5
    assert rasterize.markVisible(distance * direction).all()
    assert not rasterize.markVisible(0.1 * direction).any()


def test_stages_and_features_show_the_seam_too():
    """The public stages give the picture of the rasterizer, and further channels are blended like colours."""
    scene, bg = around(7, 60), torch.rand(3, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    settings = sphere(bg=bg)
    expected, radii = ar.GaussianRasterizer(settings)(**scene)
    inputs = scenes.without(scene, "means2D")
    splats = ar.project([settings, sphere(w2c=QUARTER)], **inputs)
    assert (splats.gaussian_ids.bincount() > 2).any()  # copies
    image, _ = ar.blend(splats, ar.list_tiles(splats), background=torch.stack([bg, 0 * bg]))
    torch.testing.assert_close(image[0], expected)
    for camera, of_camera in enumerate(splats.split()):
        assert (of_camera.gaussian_ids.diff() >= 0).all()
        assert (splats.camera_ids == camera).sum() == len(of_camera.radii)
    channels = torch.rand(60, 5, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    channels[7, 2] = math.nan
    picture = bg[:, None, None].expand(3, 32, 64)
    behind = ar.GaussianRasterizer(sphere(bg=picture))(**scene)[0]
    torch.testing.assert_close(behind, expected)
    del scene["shs"]
    settings = sphere(bg=torch.zeros(5, dtype=torch.float64))
    color, radii = ar.GaussianRasterizer(settings)(**scene, colors_precomp=channels)
    assert radii[7] == 0 and color.isfinite().all() and color.shape == (5, 32, 64)
    first, _ = ar.GaussianRasterizer(sphere())(
        **scene | {"opacities": scene["opacities"] * (torch.arange(60) != 7)[:, None]},
        colors_precomp=channels[:, 3:].repeat(1, 2)[:, :3].contiguous(),
    )
    torch.testing.assert_close(color[3:], first[:2])


def test_copies_at_the_seam_have_the_gradients_of_differences():
    """Of splats that do not overlap themselves, that do, and that are wider than the turn; one camera has no seam."""
    generator = torch.Generator().manual_seed(0)
    width, deviations = 24, torch.tensor([0.5, 2, 4, 8, 12, 16, 17, 19, 25, 40, 3], dtype=torch.float64)
    n = len(deviations)
    means2d = 30 * torch.rand(n, 2, generator=generator, dtype=torch.float64) - 3
    cov2d = torch.stack([deviations**2, 0.3 * deviations, torch.full_like(deviations, 2.0)], 1)
    opacities = torch.linspace(0.1, 0.95, n, dtype=torch.float64)
    depths, colors, beside = (torch.rand(n, *k, generator=generator, dtype=torch.float64) for k in ((), (3,), (2,)))
    turns = torch.tensor([float(width), math.inf], dtype=torch.float64)
    splits, ints = torch.tensor([0, 8, n]), torch.arange(n, dtype=torch.int32)
    cameras = (ints >= 8).int()

    def repeated(*tensors):
        image = (12, width, "point", 0.3)
        *made, saved = torch.ops.analytic_rasterizer.repeat_at_seam(
            *tensors, ints + 1, ints, cameras, tensors[1][:, 2].detach(), splits, *image
        )
        assert torch.equal(made[6] - 1, made[7]) and made[10][-1] == len(made[0]) > n and not saved[0].requires_grad
        return made[:6]

    given = [t.requires_grad_() for t in (means2d, cov2d, opacities, depths, colors, turns, beside)]
    assert torch.autograd.gradcheck(repeated, given)


def test_directions_of_pixels_of_the_sphere():
    view = ar.View("v", 64, 32, 64 / (2 * math.pi), 32 / math.pi, EYE, lens=SPHERE)
    points = torch.randn(100, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    points = torch.nn.functional.normalize(points, dim=1)
    torch.testing.assert_close(view.rays_of(view.pixels_of(points)), points, rtol=0, atol=1e-12)
    assert view.rays_of(torch.tensor([[3.0, -0.1], [3.0, 32.1]])).isnan().all()  # beyond the poles


def test_the_sphere_in_single_precision(device):
    """Also next to the poles and at the seam, in the picture and in gradients."""
    scene, results = around(9, 100), []
    g = torch.rand(4, 32, 64, dtype=torch.float64, generator=torch.Generator().manual_seed(1)) - 0.5
    for dtype, where in ((torch.float64, "cpu"), (torch.float32, device)):
        leaves = scenes.leaves(scenes.cast(scene, dtype, where))
        settings = sphere(w2c=moved_quarter(), dtype=dtype, device=where, depth=True)
        loss = loss_of(leaves, settings, g.to(where, dtype))
        grads = torch.autograd.grad(loss, list(leaves.values()))
        results.append({name: grad.double().cpu() for name, grad in zip(leaves, grads)} | {"loss": loss.double().cpu()})
    for name, expected in results[0].items():
        error = (results[1][name] - expected).norm() / expected.norm()
        assert error < 1e-4, (name, error.item())


def test_filters_and_the_drop_in_go_around_the_sphere():
    drop_in = pytest.importorskip("diff_gaussian_rasterization")
    scene = around(10, 30)
    filter_3d = torch.linspace(0, 0.3, 30, dtype=torch.float64)
    settings = sphere(filter_3d=filter_3d)
    filtered = dict(zip(("scales", "opacities"), ar.apply_3d_filter(scene["scales"], scene["opacities"], filter_3d)))
    expected, _ = ar.GaussianRasterizer(sphere())(**scene | filtered)
    for rasterizer in (ar.GaussianRasterizer, drop_in.GaussianRasterizer):
        torch.testing.assert_close(rasterizer(settings)(**scene)[0], expected)


def test_what_the_sphere_refuses():
    scene = around(8, 10)
    rasterize = ar.GaussianRasterizer
    for settings, match in (
        (sphere(gaussian_stats=True), "gaussian_stats must be False with an equirectangular lens"),
        (sphere()._replace(debug=True), "debug must be False with an equirectangular lens"),
        (sphere(tan=0.9), "tanfovx of an equirectangular picture must be at most pi"),
        (sphere(bg=torch.zeros(2, dtype=torch.float64)), r"bg must have shape \(3,\), got \(2,\)"),
    ):
        with pytest.raises(ValueError, match=match):
            rasterize(settings)(**scene)
    with pytest.raises(ValueError, match=r"means2D must have shape \(P, 3\) or \(P, 4\) with P = 10"):
        rasterize(sphere())(**scene | {"means2D": torch.zeros(10, 2, dtype=torch.float64)})
    with pytest.raises(TypeError, match="means2D must have the dtype of means3D"):
        rasterize(sphere())(**scene | {"means2D": torch.zeros(10, 3)})
    features = {"shs": None, "colors_precomp": torch.rand(10, 5, dtype=torch.float64)}
    settings = sphere(bg=torch.zeros(5, dtype=torch.float64))
    for wrong, error in ((torch.ones(11, 1, dtype=torch.float64), ValueError), (None, TypeError)):
        with pytest.raises(error, match="opacities must "):
            rasterize(settings)(**scene | features | {"opacities": wrong})
    with pytest.raises(ValueError, match="exactly one of shs and colors_precomp must be given, got both"):
        rasterize(sphere())(**scene, colors_precomp=scene["means3D"])
    with pytest.raises(ValueError, match="cameras must have no equirectangular lens"):
        ar.compute_3d_filter(scene["means3D"], [sphere()])
    del scene["means2D"]
    with pytest.raises(ValueError, match="lens must not be equirectangular here"):
        ar.render_stages(sphere(), **scene)
    with pytest.raises(ValueError, match="lens must not be equirectangular, which is not distributed"):
        ar.distributed.rasterize([sphere()], **scene)
