"""Lenses in hard cases: random lenses of every model against formulas in all pixels, odd numbers, and every op."""

import math

import pytest
import reference
import scenes
import torch
from op_calls import Calls
from scenes import rand as uniform
from test_lens import EYE, LENSES, SPHERE, each_lens, settings_of

import analytic_rasterizer as ar
from analytic_rasterizer import _C

BENT = tuple(LENSES)  # models with coefficients
WIDE = ("fisheye", "rad_tan_fisheye")
TRACED = LENSES["fisheye"](1)  # what tracing makes of an op does not depend on the model


def random_lens(model, seed, size=0.1):
    """Coefficients of both signs, up to `size`; of a fov lens anything that it may have."""
    generator = torch.Generator().manual_seed(seed)
    numbers = uniform(generator, 12, low=-size, high=size)
    if model == "fov":
        return ar.Lens.fov(0.05 + 2.8 * torch.rand((), generator=generator).item())
    parts = (numbers[:6] if model != "fisheye" else numbers[:4], numbers[6:8] / 5, numbers[8:] / 5)
    return getattr(ar.Lens, model)(*(part.tolist() for part in parts))


def at_reach(lens, points):
    """Points as they are, or if farther from the axis than `reach` at this angle: where Jacobians are taken."""
    x, y, z = points.unbind(1)
    rho, size = torch.hypot(x, y), points.norm(dim=1)
    if lens.model in WIDE:
        far, across, ahead = torch.atan2(rho, z) > lens.reach, size * math.sin(lens.reach), size * math.cos(lens.reach)
    else:
        far, across, ahead = rho > math.tan(lens.reach) * z, math.tan(lens.reach) * z, z
    turned = torch.stack([across * x / rho, across * y / rho, ahead], 1)
    return torch.where(far[:, None], turned, points)


def in_all_pixels(scene, settings, width, height):
    """Alpha (H, W) of `point` with a dilation of 0.3, every Gaussian that the lens sees in every pixel."""
    lens = settings.effects.lens
    view = torch.cat([scene["means3D"], torch.ones(len(scene["means3D"]), 1)], 1) @ settings.viewmatrix
    points = view[:, :3]
    seen, _ = lens.project(points)
    shown = (lens.depths(points) > settings.effects.near) & ~seen[:, 0].isnan()
    points, seen = points[shown], seen[shown]
    focal = torch.tensor([width / (2 * settings.tanfovx), height / (2 * settings.tanfovy)], dtype=torch.float64)
    slopes = _C.lens_points(lens.model, list(lens.numbers()), at_reach(lens, points))[1]
    to_pixel = focal[:, None] * slopes @ settings.viewmatrix[:3, :3].T
    spread = reference.covariance_3d(scene["scales"][shown], scene["rotations"][shown], 1.0)
    cov = to_pixel @ spread @ to_pixel.mT
    cov2d = torch.stack([cov[:, 0, 0], cov[:, 0, 1], cov[:, 1, 1]], 1)
    center = torch.tensor([25.0, 19.0], dtype=torch.float64)
    means, opacities = focal * seen + center - 0.5, scene["opacities"][shown, 0]
    y, x = torch.meshgrid(torch.arange(height).double(), torch.arange(width).double(), indexing="ij")
    light = torch.ones(height, width, dtype=torch.float64)
    for i in lens.depths(points).argsort(stable=True).tolist():
        offset = torch.stack([x - means[i, 0], y - means[i, 1]], -1)
        alpha = (opacities[i] * reference.weight(offset, cov2d[i], "point")).clamp(max=0.99)
        alpha = torch.where((alpha >= 1 / 255) & (light * (1 - alpha) >= 1e-4), alpha, 0.0)
        light = light * (1 - alpha)
    return 1 - light


def towards(generator, count, lens, scene):
    """The scene in all directions that the lens sees and some beyond, half of it about the edge of the picture."""
    angle = uniform(generator, count) * min(1.2 * lens.fold, math.pi)
    angle[: count // 2] = lens.reach / 1.3 * uniform(generator, count // 2, low=0.85, high=1.35)
    turn = 2 * math.pi * uniform(generator, count)
    rays = torch.stack([angle.sin() * turn.cos(), angle.sin() * turn.sin(), angle.cos()], 1)
    return scene | {"means3D": rays * torch.exp(uniform(generator, count, 1, low=math.log(0.15), high=math.log(20)))}


@pytest.mark.parametrize("model", BENT)
@pytest.mark.parametrize("seed", range(6))
def test_no_pixel_of_a_lens_is_missed(model, seed):
    """Random lenses, tiny and huge splats near the border of the field of view and beyond, against all splats in all
    pixels. Opacities are low: most pixels are not full."""
    lens = random_lens(model, seed, size=(0.02, 0.1, 0.3)[seed % 3])
    focal = (10.0, 40.0)[seed % 2]
    w2c = ar.moved(EYE, torch.tensor([0.1, -0.2, 0.15, 0.4, -0.7, 0.2]).double())
    settings = settings_of(lens, w2c=w2c, fx=focal, fy=1.1 * focal)._replace(footprint="point")
    generator = torch.Generator().manual_seed(seed)
    scene = scenes.random_scene(seed, 150, degree=1, opacity=(0.01, 0.2), sigma=(1e-3, 5.0))
    scene = towards(generator, 150, settings.effects.lens, scene)
    scene["means3D"] = (scene["means3D"] - w2c[:3, 3]) @ w2c[:3, :3]
    settings = settings._replace(effects=ar.Effects(lens=settings.effects.lens, alpha=True))
    _, _, outputs = ar.GaussianRasterizer(settings)(**scene)
    expected = in_all_pixels(scene, settings, 48, 36)
    assert (expected > 0.1).double().mean() > 0.05
    torch.testing.assert_close(outputs.alpha[0], expected, rtol=0, atol=1e-9)


# --- the map in Python -------------------------------------------------------------------------------


@pytest.mark.parametrize("lens", [*(make(1) for make in LENSES.values()), ar.Lens.fisheye(), SPHERE])
def test_points_that_are_no_direction_are_nowhere(lens):
    inf, nan = math.inf, math.nan
    nowhere = [[0, 0, 0], [nan, 0, 1], [0, 0, nan], [inf, 0, 1], [0, inf, inf], [0, 0, -inf]]
    seen, slopes = lens.project(torch.tensor(nowhere, dtype=torch.float64))
    assert seen.isnan().all() and slopes.isnan().all()
    positions = torch.tensor([[nan, 0], [0, nan], [nan, nan], [inf, 0], [0, -inf]], dtype=torch.float64)
    assert lens.unproject(positions).isnan().all()


@pytest.mark.parametrize("lens", [*(make(1) for make in LENSES.values()), SPHERE])
@pytest.mark.parametrize("size", [1e-300, 1e-160, 1e160, 1e300])
def test_only_the_direction_of_a_point_counts(lens, size):
    """Also where squares overflow or vanish."""
    points = torch.tensor([[0.3, -0.2, 1.0], [0, 0, 1], [1e-9, 0, 1]], dtype=torch.float64)
    near, slopes = lens.project(points)
    far, slopes_there = lens.project(points * size)
    torch.testing.assert_close(far, near, rtol=1e-14, atol=1e-14)
    torch.testing.assert_close(slopes_there * size, slopes, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("k1", [-0.2, -1e3, -1e5, -1e7])
@pytest.mark.parametrize("model", ["perspective", "fisheye"])
def test_folds_of_narrow_lenses(model, k1):
    """d(r + k1 r^3)/dr = 0, also where r + k1 r^3 < 0 follows within one of the first steps of the search."""
    fold = math.sqrt(-1 / (3 * k1))
    fold = math.atan(fold) if model == "perspective" else fold
    assert getattr(ar.Lens, model)([k1]).fold == pytest.approx(fold, rel=0.1, abs=1.5e-5)


@pytest.mark.parametrize("lens", [ar.Lens("fov", torch.tensor([4.0] + 11 * [0])), ar.Lens.fisheye([-1e200])])
def test_what_turns_the_picture_about_is_no_lens(lens):
    with pytest.raises(ValueError, match="is no map at its axis"):
        lens.fold  # noqa: B018


@pytest.mark.parametrize("model", BENT)
@pytest.mark.parametrize("crop", [(600, 2, -50, -10), (2, 300, 20, -30), (4, 4, -80, -60), (90, 70, 45, 35)])
def test_no_direction_in_the_picture_is_beyond_its_reach(model, crop):
    """So that inside of the picture every Jacobian is exact; also in strips and corners of a picture."""
    width, height, cx, cy = crop
    lens = LENSES[model](1)
    view = ar.View("v", width, height, 300.0, 300.0, EYE, cx, cy, lens=lens)
    reach = view.settings().effects.lens.reach
    x, y = torch.linspace(0, width, 40), torch.linspace(0, height, 40)
    rays = view.rays_of(torch.cartesian_prod(x, y))
    angles = torch.atan2(rays[:, :2].norm(dim=1), rays[:, 2])
    angles = angles[angles.isfinite()]
    assert len(angles) and angles.max() <= reach


@pytest.mark.parametrize(
    "make, error, match",
    [
        (
            lambda: ar.Lens("fisheye", (0, 0, 0, 0, 1)),
            ValueError,
            "coefficients 4 and 5 of a fisheye lens must be zero",
        ),
        (lambda: ar.Lens("fov", (1.0, 5.0)), ValueError, "coefficients from 1 on of a fov lens must be zero"),
        (lambda: ar.Lens.fisheye([10**400]), ValueError, "every number of radial must be finite, got 1000"),
        (lambda: ar.Lens.fov(10**400), ValueError, "every number of coefficients must be finite"),
        (lambda: ar.Lens("fisheye", (), "wide"), TypeError, "reach must be a number, got 'wide'"),
        (lambda: ar.Lens("fisheye", (), torch.tensor(1.0)), TypeError, "reach must be a number, got tensor"),
        (lambda: ar.Lens("fisheye", (), True), TypeError, "reach must be a number, got True"),
        (lambda: ar.Lens("fisheye", (), math.nan), ValueError, "reach must be finite and above 0"),
    ],
)
def test_numbers_that_are_refused(make, error, match):
    with pytest.raises(error, match=match):
        make()


# --- gradients and ops -------------------------------------------------------------------------------


def turned_to(angle):
    """A turn of the z axis by `angle` towards x and y."""
    x, y = 0.8 * angle, 0.6 * angle
    zero = torch.zeros(())
    return ar.moved(EYE, torch.stack([zero, zero, zero, -y, x, zero]).double())


@each_lens
@pytest.mark.parametrize("angle", [0.03, 0.6, 1.9])
@pytest.mark.parametrize("clamped", [False, True], ids=["exact", "clamped"])
def test_gradcheck(lens, angle, clamped):
    """By Gaussians, pose, focal lengths, principal point, coefficients, defocus and motion: near the axis, away from
    it and behind the camera, also where the Jacobian is that at `reach`. Splats are so large that no weight is near a
    threshold."""
    if angle >= lens.fold:
        pytest.skip("the model sees less")
    if clamped and lens == SPHERE:
        pytest.skip("next to a pole its gradients are bounded ones: docs/internals/numerics.md")
    turn = turned_to(torch.tensor(angle))
    scene = scenes.random_scene(5, 4, degree=1, opacity=(0.15, 0.6), sigma=(0.7, 1.1), spread=0.2)
    scene["means3D"] = (scene["means3D"] + torch.tensor([0, 0, 2.0])) @ turn[:3, :3].T
    del scene["means2D"]
    middle = 100 * lens.project(turn[:3, 2:3].T)[0][0]
    reach = 0.8 * angle if clamped else lens.with_reach([0.24, 0.18], (middle / 100).tolist(), 36).reach
    # High powers of the angle move the picture by more than a difference quotient stands.
    units = torch.tensor([max(1, angle) ** (-2 * i) for i in range(1, 7)] + 6 * [1.0], dtype=torch.float64)
    values = scene | {
        "coefficients": torch.tensor(lens.coefficients, dtype=torch.float64) / units,
        "tangent": torch.zeros(6, dtype=torch.float64),
        "camera": torch.stack([torch.tensor(100.0), torch.tensor(101.0), 24 - middle[0], 18 - middle[1]]).double(),
        "blur": torch.tensor([0.05, 2.5, 0.1, -0.2, 0.1, 0.02, 0.03, -0.02], dtype=torch.float64),
    }
    if lens == SPHERE:
        del values["coefficients"]
    if lens.model == "fov":  # it has one
        values["coefficients"] = values["coefficients"][:1]
    leaves = scenes.leaves(values)
    weights = torch.rand(5, 36, 48, dtype=torch.float64, generator=torch.Generator().manual_seed(3)) - 0.5

    def sums(*numbers):
        given = dict(zip(leaves, numbers))
        k, blur = given.get("coefficients", ()), given["blur"]
        k = torch.nn.functional.pad(k, (0, 12 - len(k))) * units if len(k) else k
        blurs = {"defocus": ar.Defocus(blur[0], blur[1]), "motion": ar.Motion(1.0, blur[2:5], blur[5:])}
        effects = ar.Effects(camera_gradients=True, alpha=True, depth=True, **blurs)
        options = {"dtype": torch.float64, "footprint": "box:samples=4", "lens": ar.Lens(lens.model, k, reach)}
        w2c, camera = ar.moved(EYE, given["tangent"]), given["camera"]
        settings = ar.camera_settings(w2c, 48, 36, *camera, sh_degree=1, effects=effects, **options)
        color, _, outputs = ar.GaussianRasterizer(settings)(means2D=None, **{name: given[name] for name in scene})
        images = torch.cat([color, outputs.alpha, outputs.depth])
        return tuple((images * weights).sum((1, 2)))

    # Noise of the difference quotient: 1e-16 * |sum| (~1000) / 1e-6.
    assert torch.autograd.gradcheck(sums, tuple(leaves.values()), eps=1e-6, atol=1e-5, rtol=1e-5)


@each_lens
def test_opcheck(device, lens):
    """Schema, fake kernel, autograd registration and tracing of the ops that take a lens."""
    ops = torch.ops.analytic_rasterizer
    scene = scenes.cast(scenes.random_scene(6, 20, degree=1, spread=0.6), torch.float32, device)
    bent = ar.Lens(lens.model, lens.coefficients if lens == SPHERE else torch.tensor(lens.coefficients))
    settings = settings_of(bent, torch.float32, device, camera_gradients=True)
    with Calls() as mode:
        leaves = scenes.leaves(scene)
        if lens != SPHERE:  # which is drawn by stages
            ar.GaussianRasterizer(settings)(**leaves)[0].sum().backward()
        del leaves["means2D"]
        sum(t.sum() for t in (lambda s: (s.means2d, s.cov2d, s.depths))(ar.project(settings, **leaves))).backward()
    expected = {"project", "project_vjp"} | ({"rasterize", "rasterize_vjp"} if lens != SPHERE else set())
    assert expected <= set(mode.first)
    for name in expected:
        function, arguments = mode.first[name]
        differentiable = hasattr(ops, f"{name}_vjp")

        def copied(value, differentiable=differentiable):
            if not torch.is_tensor(value):
                return value
            return value.detach().clone().requires_grad_(differentiable and value.is_floating_point())

        checks = ["test_schema", "test_autograd_registration", "test_faketensor"]
        if lens in (TRACED, SPHERE) and not (device == "cuda" and name == "rasterize"):  # see test_api.py
            checks.append("test_aot_dispatch_dynamic")
        torch.library.opcheck(function, torch.utils._pytree.tree_map(copied, arguments), test_utils=checks)


@each_lens
@pytest.mark.parametrize("angle", [0.0, 0.7, 2.0])
def test_defocus_and_motion_through_a_lens(lens, angle):
    """A point's streak is that which the lens shows, and its disc depends on the depth by which the lens orders."""
    if angle >= lens.fold:
        pytest.skip("the model sees less")
    mean = 3 * turned_to(torch.tensor(angle))[:3, 2:3].T
    velocity, turn = torch.tensor([0.1, -0.2, 0.15]).double(), torch.tensor([0.05, 0.03, -0.04]).double()
    defocus, motion = ar.Defocus(0.4, 1.5), ar.Motion(0.5, velocity, turn, (3.0, -2.0))
    gaussian = scenes.balls(mean, 0.02)
    middle = 10 * lens.project(mean)[0][0]
    camera = {"fx": 10.0, "fy": 12.0, "cx": 24 - middle[0].item(), "cy": 18 - 1.2 * middle[1].item()}
    plain = ar.project(settings_of(lens, **camera), **gaussian)
    blurred = ar.project(settings_of(lens, **camera, defocus=defocus, motion=motion), **gaussian)
    seen_from = -(velocity + torch.linalg.cross(turn, mean[0]))  # of the point, from the camera
    ends, _ = lens.project(torch.stack([mean[0] - 1e-5 * seen_from, mean[0] + 1e-5 * seen_from]))
    focal, screen = torch.tensor([10.0, 12.0]).double(), torch.tensor([3.0, -2.0]).double()
    streak = 0.5 * (focal * (ends[1] - ends[0]) / 2e-5 + screen)
    disc = 0.4 * (1 / 1.5 - 1 / lens.depths(mean)[0])
    added = torch.stack([streak[0] ** 2, streak[0] * streak[1], streak[1] ** 2]) / 12
    added = added + 10 * 12 * disc**2 / 16 * torch.tensor([1, 0, 1])
    torch.testing.assert_close(blurred.cov2d[0] - plain.cov2d[0], added, rtol=1e-8, atol=1e-8)
    torch.testing.assert_close(blurred.means2d, plain.means2d)
