"""Gradients of the camera, other projections, the lens and the shutter, on every device."""

import math

import numpy as np
import pytest
import reference
import scenes
import torch
from marks import each_kind
from scenes import KINDS, Camera

import analytic_rasterizer as ar

CAMERA = Camera(image_height=27, image_width=35, sh_degree=1, shift=(2.3, -1.4))
LENS = ar.Defocus(aperture=0.15, focus=3.1)
SHUTTER = ar.Motion(0.1, velocity=(0.9, -0.6, 1.1), angular_velocity=(0.3, 0.5, -0.8), screen_velocity=(6.0, -9.0))
# Each alone, then together: the chain rule of one meets that of the others.
EFFECTS = {
    "gradients": {},
    "off_center": {"off_center": True},
    "orthographic": {"orthographic": True},
    "near_far": {"near": 3.0, "far": 4.2},
    "defocus": {"defocus": LENS},
    "motion": {"motion": SHUTTER},
    "both_blurs": {"defocus": LENS, "motion": SHUTTER},
    "orthographic_blurs": {"orthographic": True, "defocus": ar.Defocus(0.07, 3.1), "motion": SHUTTER},
}
CAMERA_INPUTS = ("viewmatrix", "projmatrix", "campos", "tanfovx", "tanfovy")


def settings_of(effects, footprint, options, dtype=torch.float64, device="cpu", camera=CAMERA, **fields):
    """Settings with gradients to the camera, and its tensors, which are leaves."""
    settings = camera.settings(dtype, "cpu", footprint=footprint, **options)._replace(**fields)
    if effects.get("orthographic"):
        settings = orthographic(settings, camera)
    tensors = {name: getattr(settings, name) for name in CAMERA_INPUTS}
    leaves = {k: torch.as_tensor(v, dtype=dtype).to(device).requires_grad_() for k, v in tensors.items()}
    settings = scenes.settings_to(settings, device)._replace(**leaves)
    return settings._replace(effects=ar.Effects(camera_gradients=True, **effects)), leaves


def orthographic(settings, camera):
    """The same view without perspective, as large at a depth of 3."""
    half = (3 * camera.tanfovx, 3 * camera.tanfovy)
    projection = torch.diag(torch.tensor([1 / half[0], 1 / half[1], 0.01, 1], dtype=torch.float64))
    projection[0, 3], projection[1, 3] = 2 * camera.shift[0] / camera.image_width, -0.1
    matrix = (projection @ camera.world_to_camera()).T.contiguous().to(settings.projmatrix)
    return settings._replace(tanfovx=half[0], tanfovy=half[1], projmatrix=matrix)


def render_both(scene, settings, variant, dtype, device):
    """Images by the library and by the reference, from leaves of their own: (image, reference), (leaves, ...)."""
    footprint, options = variant
    leaves = scenes.leaves(scenes.to(scenes.cast(scene, dtype), device))
    image, radii = ar.GaussianRasterizer(settings)(**leaves)
    exact = scenes.leaves(scene)
    fields = {name: getattr(settings, name).detach().cpu().double().requires_grad_() for name in CAMERA_INPUTS}
    theirs = settings._replace(bg=settings.bg.cpu().double(), **fields)
    expected = reference.render(theirs, **exact, footprint=footprint, **options)
    return (image, expected), (leaves, exact), fields, radii


@each_kind
@pytest.mark.parametrize("name", EFFECTS)
def test_matches_the_reference(device, best, variant, name):
    """The image, and the gradient by everything, against autograd through the plain formulas."""
    scene = scenes.random_scene(21, 24, degree=1, sigma=(0.02, 0.4))
    scene["shs"] = scene["shs"] * 0.3  # colours away from the clamp at zero
    settings, camera = settings_of(EFFECTS[name], *variant, dtype=best, device=device)
    (image, expected), (leaves, exact), theirs, radii = render_both(scene, settings, variant, best, device)
    if name == "near_far":
        z = expected.projection.depths
        assert (radii.cpu()[(z < 3) | (z > 4.2)] == 0).all() and (radii > 0).sum() > 5
    compare_images(image, expected, best)
    for pair in ((leaves, exact), (camera, theirs)):
        for key in pair[0]:
            if key == "means2D":
                continue
            ours, want = pair[0][key].grad.cpu().double(), pair[1][key].grad
            want = torch.zeros_like(ours) if want is None else want
            scale = want.abs().max() + 1e-3
            # Gradients of a camera are sums over all Gaussians, of both signs.
            assert (ours - want).abs().max() < scale * (1e-8 if best == torch.float64 else 3e-3), key


def compare_images(image, expected, dtype):
    """And makes the gradients of both, of the same loss."""
    # Pixels that are near a threshold may fall to its other side in float32.
    clear = expected.pixel_margin > (1e-4 if dtype == torch.float32 else 1e-9)
    tolerance = {torch.float64: 1e-10, torch.float32: 2e-5}[dtype]
    assert ((image.detach().cpu() - expected.color.detach()).abs() * clear).max() < tolerance
    g = torch.rand(image.shape, generator=torch.Generator().manual_seed(3), dtype=torch.float64) * clear
    (image * g.to(image)).sum().backward()
    (expected.color * g).sum().backward()


# --- pose and focal lengths -----------------------------------------------------------------------


def pinhole(tangent, fx, fy, cx, cy, effects, dtype=torch.float64, footprint="cumulant", size=(35, 27), **options):
    view = ar.moved(CAMERA.world_to_camera(), tangent)
    options |= {"dtype": dtype, "footprint": footprint}
    return ar.camera_settings(view, *size, fx, fy, cx, cy, sh_degree=1, effects=effects, **options)


@pytest.mark.parametrize("orthographic", [False, True], ids=["perspective", "orthographic"])
@each_kind
def test_gradcheck_of_the_pose_and_the_focal_lengths(variant, orthographic):
    """Finite differences through `moved` and `camera_settings`, and by lens, shutter and one Gaussian input."""
    footprint, options = variant
    if footprint == "analytic":
        options = {"frame_gradient": "paper"}
    scene = scenes.smooth_scene(40, degree=1)
    scene["shs"] = scene["shs"] * 0.3
    scale = 1 if not orthographic else 1 / 4

    def run(tangent, fx, fy, cx, cy, aperture, focus, exposure, velocity, turn, screen, means):
        blurs = {"defocus": ar.Defocus(aperture, focus), "motion": ar.Motion(exposure, velocity, turn, screen)}
        flags = dict.fromkeys(("camera_gradients", "off_center", "depth", "inverse_depth"), True)
        effects = ar.Effects(**flags, **blurs, orthographic=orthographic)
        settings = pinhole(tangent, fx, fy, cx, cy, effects, footprint=footprint, **options)
        color, _, outputs = ar.GaussianRasterizer(settings)(**{**scene, "means3D": means, "means2D": None})
        return color, outputs.depth, outputs.inverse_depth

    values = [torch.zeros(6), 30.0 * scale, 28.0 * scale, 17.9, 13.1, 0.1, 2.9, 0.1, [0.3, -0.2, 0.5],
              [0.1, 0.2, -0.3], [2.0, -3.0]]  # fmt: skip
    inputs = [torch.as_tensor(v, dtype=torch.float64).clone().requires_grad_() for v in values]
    inputs.append(scene["means3D"].clone().requires_grad_())
    assert torch.autograd.gradcheck(run, inputs, eps=1e-6, atol=1e-6, rtol=1e-5, nondet_tol=0, fast_mode=True)


def test_a_focal_length_that_requires_a_gradient_switches_gradients_of_the_camera_on():
    """All of its gradient: that through projmatrix, and that through the tangents of the projected covariances."""
    scene = scenes.smooth_scene(40, degree=1) | {"means2D": None}
    focal = torch.tensor([30.0, 28.0], dtype=torch.float64, requires_grad=True)

    def picture(fx, fy):
        settings = pinhole(torch.zeros(6), fx, fy, 17.9, 13.1, None)
        return ar.GaussianRasterizer(settings)(**scene)[0]

    assert torch.autograd.gradcheck(picture, tuple(focal.detach().clone().requires_grad_()), atol=1e-6, fast_mode=True)

    def stages(fx, fy):
        settings = pinhole(torch.zeros(6), fx, fy, 17.9, 13.1, None)
        splats = ar.project(settings, **scenes.without(scene, "means2D"))
        return ar.blend(splats, ar.list_tiles(splats))[0]

    assert torch.autograd.gradcheck(stages, tuple(focal.detach().clone().requires_grad_()), atol=1e-6, fast_mode=True)
    # By itself, in settings of the program's own, and where nobody wants it.
    settings = pinhole(torch.zeros(6), 30.0, 28.0, 17.9, 13.1, None)
    tangent = torch.tensor(settings.tanfovx, requires_grad=True)
    assert ar.GaussianRasterizer(settings._replace(tanfovx=tangent))(**scene)[0].requires_grad
    with torch.no_grad():
        assert torch.equal(picture(*focal), picture(30.0, 28.0))


def test_gradcheck_where_the_clamp_holds():
    """Wide splats outside the picture: x/z is clamped, and tan(fov) and the principal point move the clamp."""
    scene = scenes.smooth_scene(41, degree=1, count=3)
    # Beside the picture, and large enough to reach into it.
    scene["means3D"] = torch.tensor([[2.9, 0.2, 0.1], [-2.8, 0.3, 0.2], [0.3, 2.4, -0.1]], dtype=torch.float64)
    scene["scales"] = torch.full_like(scene["scales"], 0.9)

    def run(fx, fy, cx, cy):
        effects = ar.Effects(camera_gradients=True, off_center=True)
        settings = pinhole(torch.zeros(6, dtype=torch.float64), fx, fy, cx, cy, effects)
        return ar.GaussianRasterizer(settings)(**{**scene, "means2D": None})[0]

    inputs = [torch.tensor(v, dtype=torch.float64, requires_grad=True) for v in (40.0, 38.0, 19.0, 12.0)]
    assert run(*inputs).detach().abs().max() > 0.01
    both = (pinhole(torch.zeros(6).double(), 40.0, 38.0, 19.0, 12.0, e) for e in (ar.Effects(off_center=True), None))
    assert not torch.equal(*(ar.GaussianRasterizer(settings)(**scene)[0] for settings in both))
    assert torch.autograd.gradcheck(run, inputs, eps=1e-6, atol=1e-7, rtol=1e-5, fast_mode=True)


def test_camera_settings_are_those_of_3dgs(device, best):
    """The same tensors as the plain way of putting them together, and the same picture."""
    camera = Camera(image_height=27, image_width=35, shift=(2.3, -1.4), sh_degree=1)
    plain = camera.settings(best)
    intrinsics = 35 / 1.2, 27.0, 35 / 2 + 2.3, 27 / 2 - 1.4
    made = ar.camera_settings(camera.world_to_camera(), 35, 27, *intrinsics, sh_degree=1, dtype=best)
    for name in ("viewmatrix", "campos", "tanfovx", "tanfovy"):
        assert torch.allclose(torch.as_tensor(getattr(made, name)), torch.as_tensor(getattr(plain, name)), atol=1e-6)
    assert torch.allclose(made.projmatrix[:, [0, 1, 3]], plain.projmatrix[:, [0, 1, 3]], atol=1e-6)
    scene = scenes.to(scenes.cast(scenes.random_scene(5, 30, degree=1), best), device)
    images = [ar.GaussianRasterizer(scenes.settings_to(s, device))(**scene)[0] for s in (plain, made)]
    assert (images[0] - images[1]).abs().max() < (1e-4 if best == torch.float32 else 1e-6)


@pytest.mark.parametrize("orthographic", [False, True], ids=["perspective", "orthographic"])
@pytest.mark.parametrize("factor", [0.2, 3.0, 20.0])
def test_a_view_that_scales_shows_the_same(device, best, factor, orthographic):
    """The upper left 3x3 of the view need not be a rotation: no Gaussian is lost that reaches into the picture."""
    scene = scenes.to(scenes.cast(scenes.random_scene(1, 300, degree=1, spread=3.0, sigma=(0.05, 0.5)), best), device)

    def picture(factor):
        view = CAMERA.world_to_camera()
        view[:3] *= factor
        focal = 8 / factor if orthographic else 30.0
        effects = ar.Effects(orthographic=orthographic, near=0.2 * factor)
        options = {"dtype": best, "device": device, "footprint": "box", "effects": effects}
        return ar.GaussianRasterizer(ar.camera_settings(view, 35, 27, focal, focal, sh_degree=1, **options))(**scene)

    (expected, radii), (made, made_radii) = picture(1.0), picture(factor)
    assert (radii > 0).sum() > 100
    assert torch.equal(made_radii > 0, radii > 0)
    # The factor is rounded away: in float32 some 100 operations from a mean to its pixel, 1e-5 of 35 px.
    assert (made - expected).abs().max() < (1e-10 if best == torch.float64 else 1e-3)


def test_a_pose_is_found_from_a_picture(device):
    """Descent on the six numbers of the tangent space brings a displaced camera back."""
    scene = scenes.to(scenes.cast(scenes.random_scene(8, 60, degree=1, sigma=(0.1, 0.4)), torch.float32), device)
    effects = ar.Effects(camera_gradients=True)

    def render(tangent):
        settings = pinhole(tangent, 29.0, 27.0, None, None, effects, torch.float32, footprint="box")
        return ar.GaussianRasterizer(scenes.settings_to(settings, device))(**scene)[0]

    target = render(torch.zeros(6)).detach()
    start = torch.tensor([0.05, -0.04, 0.06, 0.02, -0.02, 0.03])
    tangent = start.clone().requires_grad_()
    optimizer = torch.optim.LBFGS([tangent], max_iter=40, line_search_fn="strong_wolfe", tolerance_change=1e-12)

    def closure():
        optimizer.zero_grad()
        loss = ((render(tangent) - target) ** 2).sum()
        loss.backward()
        return loss

    optimizer.step(closure)
    assert tangent.detach().norm() < 1e-3 * start.norm()


# --- projections ----------------------------------------------------------------------------------


def test_a_far_camera_is_orthographic():
    """A pinhole at a distance D sees what an orthographic camera sees, up to the scene's depth over D."""
    scene = scenes.random_scene(13, 40, degree=1, sigma=(0.05, 0.3))
    scene["shs"][:, 1:] = 0  # seen from one point or from none, harmonics differ by as much
    distance = 1e5  # in float64, which is to say on the CPU
    view = torch.eye(4, dtype=torch.float64)
    view[2, 3] = distance

    def picture(focal, effects=None):
        options = {"dtype": torch.float64, "sh_degree": 1, "effects": effects}
        return ar.GaussianRasterizer(ar.camera_settings(view, 40, 30, focal, focal, **options))(**scene)[0]

    parallel, pinhole = picture(10.0, ar.Effects(orthographic=True)), picture(10.0 * distance)
    assert parallel.max() > 0.3
    assert (parallel - pinhole).abs().max() < 1e-2  # a threshold may fall the other way; most pixels:
    assert (parallel - pinhole).abs().mean() < 1e-4


def test_a_crop_is_a_part_of_the_picture(device, best):
    """With the clamp where the crop is. With that of 3DGS, around the axis, splats of a crop beside it are wrong."""
    scene = scenes.random_scene(15, 80, degree=1, sigma=(0.1, 0.5), spread=5.0)
    scene["means3D"][:, 2] *= 0.3
    scene = scenes.to(scenes.cast(scene, best), device)
    whole_size, crop_size, left = (96, 32), (16, 32), 80
    zero = torch.zeros(6, dtype=torch.float64)

    def render(size, cx, effects):
        settings = pinhole(zero, 30.0, 30.0, cx, 16.0, effects, best, size=size, footprint="box")
        return ar.GaussianRasterizer(scenes.settings_to(settings, device))(**scene)[0]

    expected = render(whole_size, 48.0, None)[:, :, left:]
    assert expected.max() > 0.05
    error = (render(crop_size, 48.0 - left, ar.Effects(off_center=True)) - expected).abs().max()
    plain = (render(crop_size, 48.0 - left, None) - expected).abs().max()
    # Only what is beyond 1.3 half pictures from the crop's middle is taken otherwise.
    assert error < 0.02 and plain > 5 * error


def test_near_and_far(device, best):
    """What lies outside is not drawn, has no gradient, and leaves the rest as it is to the bit."""
    scene = scenes.cast(scenes.random_scene(17, 50, degree=1), best)
    z = scenes.to(scene, "cpu")["means3D"].double() @ CAMERA.world_to_camera()[2, :3] + CAMERA.world_to_camera()[2, 3]
    kept = (z > 3.7) & (z < 4.3)
    settings = CAMERA.settings(best, device, effects=ar.Effects(near=3.7, far=4.3), footprint="box")
    inputs = scenes.leaves(scenes.to(scene, device))
    color, radii = ar.GaussianRasterizer(settings)(**inputs)
    color.sum().backward()
    assert (radii.cpu()[~kept] == 0).all() and kept.any() and not kept.all()
    assert (inputs["means3D"].grad.cpu()[~kept] == 0).all()
    some = {k: v[kept] for k, v in scene.items()}
    # Training both times: on CUDA colours of inference may differ in the last bit.
    alone, _ = ar.GaussianRasterizer(settings._replace(effects=None))(**scenes.leaves(scenes.to(some, device)))
    assert torch.equal(color, alone)
    assert torch.equal(ar.GaussianRasterizer(settings).markVisible(scenes.to(scene, device)["means3D"]).cpu(), z > 3.7)


# --- lens and shutter -------------------------------------------------------------------------------


def plate(seed, count, z, dtype, sigma=(0.02, 0.3)):
    """Gaussians all at one depth before an upright camera, and its settings without effects."""
    scene = scenes.random_scene(seed, count, sigma=sigma)
    scene["means3D"][:, 2] = z
    return scenes.cast(scene, dtype)


EYE = torch.eye(4, dtype=torch.float64)


def facing(effects, dtype, device, footprint="box:samples=1", size=(40, 32), view=EYE):
    options = {"dtype": dtype, "device": device, "effects": effects, "footprint": footprint}
    return ar.camera_settings(view, *size, 30.0, 30.0, sh_degree=0, **options)


def test_defocus_is_a_wider_pixel(device, best):
    """At one depth the disc is one variance, and `mip` knows what a variance does: the same image."""
    scene = scenes.to(plate(3, 30, 4.0, best), device)
    lens = ar.Defocus(aperture=0.8, focus=2.5)
    variance = (30 * 0.8 * (1 / 2.5 - 1 / 4.0)) ** 2 / 16
    ours, _ = ar.GaussianRasterizer(facing(ar.Effects(defocus=lens), best, device))(**scene)
    wide, _ = ar.GaussianRasterizer(facing(None, best, device, f"mip:variance={1 / 12 + variance}"))(**scene)
    assert variance > 0.5 and ours.max() > 0.2
    assert (ours - wide).abs().max() < (1e-5 if best == torch.float32 else 1e-12)
    sharp, _ = ar.GaussianRasterizer(facing(ar.Effects(defocus=ar.Defocus(0.8, 4.0)), best, device))(**scene)
    plain, _ = ar.GaussianRasterizer(facing(None, best, device))(**scene)
    assert torch.equal(sharp, plain)


@pytest.mark.parametrize("moves", ["sideways", "towards", "rolling", "screen"])
def test_motion_is_the_mean_over_the_exposure(moves, device, best):
    """A splat alone, which hides nothing: the picture is the mean of instants along the path.

    A segment is taken as the Gaussian of its variance. For a streak of 3 px, and splats with 2 px of standard
    deviation, their fourth cumulants, -3^4 / 120 and 0, make half a percent of the peak: 3^4 / 120 / 8 / (2^2 +
    3^2 / 12)^2.
    """
    scene = plate(7, 1, 4.0, best, sigma=(0.2, 0.4))
    scene["means3D"][0, :2] = torch.tensor([1.8, 1.2], dtype=best)
    scene["opacities"][:] = 0.9
    scene["shs"][:] = 1.0
    scene = scenes.to(scene, device)
    exposure, speed = 0.2, 2.0
    motion = {
        "sideways": {"velocity": (speed, -0.4 * speed, 0.0)},
        "towards": {"velocity": (0.0, 0.0, speed)},
        "rolling": {"angular_velocity": (0.1, 0.2, 0.8)},
        "screen": {"screen_velocity": (15.0, 8.0)},
    }[moves]
    shutter = ar.Effects(motion=ar.Motion(exposure, **motion))
    blurred, _ = ar.GaussianRasterizer(facing(shutter, best, device))(**scene)
    still, _ = ar.GaussianRasterizer(facing(None, best, device))(**scene)
    mean, steps = torch.zeros_like(still), 32
    for step in range(steps):
        t = ((step + 0.5) / steps - 0.5) * exposure
        settings = facing(None, best, device)
        if moves == "screen":
            shift = torch.tensor(motion["screen_velocity"], dtype=torch.float64) * t
            projection = settings.projmatrix.clone()
            projection[2, :2] += (2 * shift / torch.tensor([40.0, 32.0])).to(projection)
            settings = settings._replace(projmatrix=projection)
        else:
            # The world moves against the camera.
            speeds = [*motion.get("velocity", (0, 0, 0)), *motion.get("angular_velocity", (0, 0, 0))]
            twist = -t * torch.tensor(speeds, dtype=torch.float64)
            settings = facing(None, best, device, view=ar.moved(EYE, twist))
        mean += ar.GaussianRasterizer(settings)(**scene)[0] / steps
    changed = (mean - still).abs().max()
    assert changed > 2 / 255
    # Half a percent, and what is skipped below 1/255.
    assert (blurred - mean).abs().max() < 0.005 * still.max() + 1 / 255


def test_integers_of_a_motion_are_numbers_like_others():
    scene = scenes.random_scene(1, 30, degree=1)

    def blurred(exposure, velocity):
        effects = ar.Effects(motion=ar.Motion(exposure, velocity))
        return ar.GaussianRasterizer(CAMERA.settings(torch.float64, "cpu", effects=effects))(**scene)[0]

    for exposure, velocity in ((torch.tensor(1), (0.5, 0.0, 0.0)), (torch.tensor(0.5), torch.tensor([1, 0, 0]))):
        numbers = blurred(float(exposure), [float(v) for v in velocity])
        assert torch.allclose(blurred(exposure, velocity), numbers, rtol=0, atol=1e-14)
        assert (numbers - blurred(0.0, (0.0, 0.0, 0.0))).abs().max() > 1e-3


@pytest.mark.parametrize("exposure", [0.5, torch.tensor(0.5)], ids=["number", "tensor"])
def test_numbers_of_a_velocity_may_be_tensors(exposure):
    """Each gets the gradient that the same number of a whole tensor gets."""
    scene = scenes.random_scene(1, 30, degree=1)

    def gradient(speed, velocity):
        effects = ar.Effects(motion=ar.Motion(exposure, velocity))
        color, _ = ar.GaussianRasterizer(CAMERA.settings(torch.float64, "cpu", effects=effects))(**scene)
        return torch.autograd.grad(color.square().sum(), speed)[0]

    speed = torch.tensor(0.7, dtype=torch.float64, requires_grad=True)
    whole = torch.tensor([0.7, 0.0, 0.1], dtype=torch.float64, requires_grad=True)
    expected = gradient(whole, whole)[0]
    assert expected.abs() > 1e-3
    assert torch.allclose(gradient(speed, (speed, 0.0, 0.1)), expected, rtol=1e-12)


def test_motions_with_tensors_can_be_compared():
    def motion(speed, exposure=0.5):
        return ar.Motion(exposure, velocity=torch.tensor([speed, 0.0, 0.1]), screen_velocity=[1.0, 2.0])

    assert motion(1.0) == motion(1.0) and hash(motion(1.0)) == hash(motion(1.0))
    assert motion(1.0) != motion(2.0) and motion(1.0) != motion(1.0, exposure=0.6)
    assert motion(1.0) != ar.Motion(0.5, velocity=(1.0, 0.0, 0.1), screen_velocity=[1.0, 2.0])
    assert motion(1.0) != 0.5 and ar.Motion(0.5) != motion(1.0)
    assert motion(1.0, torch.tensor(0.5)) == motion(1.0, torch.tensor(0.5))
    assert len({ar.Effects(motion=motion(1.0)), ar.Effects(motion=motion(1.0))}) == 1


def test_effects_with_tensors_can_be_compared():
    one, same, other = (ar.Effects(filter_3d=torch.full((3,), size)) for size in (0.1, 0.1, 0.2))
    assert one == same and hash(one) == hash(same)
    assert one != other and one != ar.Effects() and ar.Effects() != one
    assert ar.Effects(near=torch.tensor(0.5)) == ar.Effects(near=0.5) and ar.Effects() != "auto"


def test_numbers_of_numpy_are_numbers():
    lens = ar.Defocus(np.float32(0.5), np.int64(3))
    effects = ar.Effects(near=np.float32(0.5), far=np.float32(8), sh_degree=np.int64(1), defocus=lens)
    same = ar.Effects(near=0.5, far=8.0, sh_degree=1, defocus=ar.Defocus(0.5, 3))
    scene = scenes.random_scene(1, 30, degree=1)
    images = [ar.GaussianRasterizer(CAMERA.settings(effects=e))(**scene)[0] for e in (effects, same)]
    assert torch.equal(*images)


def test_blur_keeps_the_light(device, best):
    """The mass of a faint splat, opacity times the integral of its Gaussian, is the same with any blur."""
    scene = plate(9, 1, 4.0, best, sigma=(0.15, 0.3))
    scene["means3D"][:, :2] = 0.1
    scene["opacities"][:] = 0.9
    scene["shs"][:] = 0.5 / 0.28209479177387814
    scene = scenes.to(scene, device)
    total = []
    lens, shutter = {"defocus": ar.Defocus(0.5, 2.5)}, {"motion": ar.Motion(0.1, screen_velocity=(30, 20))}
    for effects in (None, ar.Effects(**lens), ar.Effects(**shutter), ar.Effects(**lens, **shutter)):
        color, _ = ar.GaussianRasterizer(facing(effects, best, device, size=(64, 64)))(**scene)
        total.append(color[0].sum().item())
    # What is below 1/255 is not drawn: a tail of the level 2 ln(255 amp), share 1/(255 amp) of the mass.
    assert all(abs(t / total[0] - 1) < 0.02 for t in total), total


@pytest.mark.parametrize("footprint", [name for name, _ in KINDS])
@pytest.mark.parametrize("ratio", [1e2, 1e4])
def test_blurred_needles_have_gradients_in_float32(device, footprint, ratio):
    """Against float64, with streaks along and across needles and a lens nearly in focus."""
    count = 24
    scene = scenes.random_scene(31, count, sigma=(0.05, 0.06))
    scene["scales"] = scene["scales"] * torch.tensor([ratio, 1.0, 1.0], dtype=torch.float64)
    single = scenes.cast(scene, torch.float32)
    gradients = []
    for dtype, where in ((torch.float32, device), (torch.float64, "cpu")):
        leaves = scenes.leaves(scenes.to(scenes.cast(single, dtype), where))
        effects = ar.Effects(defocus=ar.Defocus(0.02, 4.0), motion=ar.Motion(0.1, screen_velocity=(9.0, 4.0)))
        settings = CAMERA.settings(torch.float32, effects=effects, footprint=footprint)._replace(sh_degree=0)
        exact = {k: getattr(settings, k).to(dtype) for k in ("bg", "viewmatrix", "projmatrix", "campos")}
        settings = settings._replace(**exact)
        color, _ = ar.GaussianRasterizer(scenes.settings_to(settings, where))(**leaves)
        weights = torch.sin(torch.arange(color.numel(), dtype=torch.float64)).reshape(color.shape)
        (color * weights.to(color)).sum().backward()
        gradients.append({k: v.grad.cpu().double() for k, v in leaves.items()})
    for name, ours in gradients[0].items():
        exact = gradients[1][name]
        assert ours.isfinite().all()
        scale = exact.reshape(count, -1).abs().amax(1, keepdim=True).expand(count, exact[0].numel()).reshape(ours.shape)
        assert ((ours - exact).abs() / (scale + 1e-2 * exact.abs().max())).max() < 2e-2, name


# --- harmonics of the fourth degree, and how many are used -------------------------------------------


@pytest.mark.parametrize("degree", range(5))
def test_harmonics_match_scipy(degree):
    """The reference's constants, so that what is compared with them is right."""
    special = pytest.importorskip("scipy.special")
    g = torch.Generator().manual_seed(degree)
    d = torch.nn.functional.normalize(torch.randn(50, 3, generator=g, dtype=torch.float64), dim=1)
    theta, phi = torch.acos(d[:, 2]).numpy(), torch.atan2(d[:, 1], d[:, 0]).numpy()
    basis = reference.spherical_harmonics(degree, d)
    for m in range(-degree, degree + 1):
        y = special.sph_harm_y(degree, abs(m), theta, phi)
        expected = y.real if m == 0 else 2**0.5 * (y.real if m > 0 else y.imag)
        got = basis[:, degree**2 + degree + m].numpy()
        assert abs(got - expected).max() < 1e-12, m


@each_kind
def test_degree_four(device, best, variant):
    """Colours and gradients against the reference; and a scene of fewer coefficients says what is missing."""
    footprint, options = variant
    scene = scenes.random_scene(19, 20, degree=4, sigma=(0.1, 0.4))
    scene["shs"][:, 1:] *= 0.3
    camera = Camera(image_height=27, image_width=35, sh_degree=4)
    settings = camera.settings(best, device, footprint=footprint, **options)
    leaves, exact = scenes.leaves(scenes.to(scenes.cast(scene, best), device)), scenes.leaves(scene)
    image, _ = ar.GaussianRasterizer(settings)(**leaves)
    expected = reference.render(camera.settings(), **exact, footprint=footprint, **options)
    compare_images(image, expected, best)
    for name in ("shs", "means3D") if footprint != "analytic" else ("shs",):
        ours, want = leaves[name].grad.cpu().double(), exact[name].grad
        assert (ours - want).abs().max() < want.abs().max() * (1e-4 if best == torch.float32 else 1e-9), name
    less = {**leaves, "shs": leaves["shs"].detach()[:, :16]}
    with pytest.raises(ValueError, match=r"M >= 25 for sh_degree 4"):
        ar.GaussianRasterizer(settings)(**less)


def test_auto_leaves_out_what_does_not_show(device, best):
    """As many bands as the scene needs, found again when it changes; all of them while they are trained."""
    scene = scenes.to(scenes.cast(scenes.random_scene(23, 30, degree=3), best), device)
    scene["shs"][:, 4:] *= 1e-5
    camera = Camera(image_height=27, image_width=35, sh_degree=3)
    settings = camera.settings(best, device, footprint="box")
    degrees = {d: ar.GaussianRasterizer(settings._replace(sh_degree=d))(**scene)[0] for d in range(4)}
    auto = ar.GaussianRasterizer(settings._replace(effects="auto"))
    assert torch.equal(auto(**scene)[0], degrees[1]) and not torch.equal(degrees[1], degrees[3])
    assert (degrees[1] - degrees[3]).abs().max() < 1 / 255
    scene["shs"][:, 1:] *= 1e-5  # in place: another version of the same tensor
    flat = ar.GaussianRasterizer(settings._replace(sh_degree=0))(**scene)[0]
    assert torch.equal(auto(**scene)[0], flat)
    leaf = scene["shs"].clone().requires_grad_()
    auto(**{**scene, "shs": leaf})[0].sum().backward()
    assert (leaf.grad[:, 9:] != 0).any()
    with torch.inference_mode():
        assert auto(**{k: v.clone() for k, v in scene.items()})[0].shape == flat.shape
    fixed = ar.GaussianRasterizer(settings._replace(effects=ar.Effects(sh_degree=0)))
    assert torch.equal(fixed(**scene)[0], flat)


# --- filter, arguments ------------------------------------------------------------------------------


def test_the_filter_of_the_effects_is_apply_3d_filter(device, best):
    scene = scenes.to(scenes.cast(scenes.random_scene(25, 30, degree=1), best), device)
    width = torch.rand(30, generator=torch.Generator().manual_seed(0), dtype=best).to(device) * 0.2
    settings = CAMERA.settings(best, device, footprint="box")._replace(scale_modifier=1.5)
    inputs = scenes.leaves(scene)
    color, _ = ar.GaussianRasterizer(settings._replace(effects=ar.Effects(filter_3d=width)))(**inputs)
    color.sum().backward()
    by_hand = scenes.leaves(scene)
    scales, opacities = ar.apply_3d_filter(by_hand["scales"], by_hand["opacities"], width / 1.5)
    expected, _ = ar.GaussianRasterizer(settings)(**{**by_hand, "scales": scales, "opacities": opacities})
    expected.sum().backward()
    assert torch.equal(color, expected)
    for name in ("scales", "opacities"):
        assert (inputs[name].grad - by_hand[name].grad).abs().max() <= 1e-5 * by_hand[name].grad.abs().max()
    with pytest.raises(ValueError, match="filter_3d needs scales and rotations, got cov3D_precomp"):
        flat = scenes.with_precomputed({k: v.cpu().double() for k, v in scene.items()})
        ar.GaussianRasterizer(CAMERA.settings(effects=ar.Effects(filter_3d=width.cpu().double())))(**flat)


def pose_with(number):
    """Settings of a pose with a number that is none."""
    pose = torch.eye(4).requires_grad_()
    pose.data[0, 3] = number
    return ar.camera_settings(pose, 4, 4, 1, 1)


@pytest.mark.parametrize(
    "error, message, make",
    [
        (ValueError, "near must be finite and above 0, got 0", lambda: ar.Effects(near=0)),
        (ValueError, "near must be finite and at least 0, got -1", lambda: ar.Effects(near=-1, orthographic=True)),
        (ValueError, "far must be above near, 0.2, got 0.1", lambda: ar.Effects(far=0.1)),
        (ValueError, "sh_degree must be 0 to 4, got 5", lambda: ar.Effects(sh_degree=5)),
        (ValueError, "far must be finite, got nan", lambda: ar.Effects(far=float("nan"))),
        (ValueError, r"far must be one number, got a tensor of shape \(2,\)", lambda: ar.Effects(far=torch.ones(2))),
        (TypeError, "far must be a number, got None", lambda: ar.Effects(far=None)),
        (TypeError, "sh_degree must be a whole number or None, got True", lambda: ar.Effects(sh_degree=True)),
        (TypeError, "defocus must be a Defocus or None, got 0.1", lambda: ar.Effects(defocus=0.1)),
        (TypeError, "orthographic must be a bool, got 1", lambda: ar.Effects(orthographic=1)),
        (ValueError, "aperture must be finite and at least 0, got -0.1", lambda: ar.Defocus(-0.1, 1)),
        (ValueError, "focus must be finite and above 0, got 0", lambda: ar.Defocus(0.1, 0)),
        (ValueError, "exposure must be finite and at least 0, got nan", lambda: ar.Motion(float("nan"))),
        (ValueError, "velocity must have 3 finite numbers", lambda: ar.Motion(0.1, velocity=(1, 2))),
        (TypeError, "velocity must be a tuple or a tensor of 3 numbers, got 1", lambda: ar.Motion(0.1, velocity=1)),
        (TypeError, "of velocity must be a number, got None", lambda: ar.Motion(0.1, velocity=(1, 2, None))),
        (ValueError, "of velocity must be finite, got inf", lambda: ar.Motion(0.1, velocity=(1, 2, float("inf")))),
        (ValueError, r"world_to_camera must have shape \(4, 4\)", lambda: ar.camera_settings(torch.eye(3), 4, 4, 1, 1)),
        (TypeError, "world_to_camera must be a tensor, got list", lambda: ar.camera_settings([1.0], 4, 4, 1, 1)),
        (TypeError, "fy must be a number, got None", lambda: ar.camera_settings(torch.eye(4), 4, 4, 1, None)),
        (TypeError, "cx must be a number, got 'left'", lambda: ar.camera_settings(torch.eye(4), 4, 4, 1, 1, "left")),
        (ValueError, r"fx must be one number", lambda: ar.camera_settings(torch.eye(4), 4, 4, torch.ones(2), 1)),
        (TypeError, "bg must be a tensor, got int", lambda: ar.camera_settings(torch.eye(4), 4, 4, 1, 1, bg=0)),
        (TypeError, "tangent must be a tensor, got list", lambda: ar.moved(torch.eye(4), [0.0] * 6)),
        (TypeError, "floating-point dtype, got torch.int64", lambda: ar.moved(torch.eye(4).long(), torch.ones(6))),
        (ValueError, "fx must be positive and finite, got -1", lambda: ar.camera_settings(torch.eye(4), 4, 4, -1, 1)),
        (ValueError, "fy must be positive and finite, got inf", lambda: ar.camera_settings(EYE, 4, 4, 1, math.inf)),
        (ValueError, "cx must be finite, got nan", lambda: ar.camera_settings(torch.eye(4), 4, 4, 1, 1, math.nan)),
        (ValueError, r"world_to_camera must be finite, got nan at \(0, 3\)", lambda: pose_with(math.nan)),
        (ValueError, r"world_to_camera must be finite, got -inf at \(0, 3\)", lambda: pose_with(-math.inf)),
        (ValueError, r"tangent \(6,\), got \(4, 4\) and \(3,\)", lambda: ar.moved(torch.eye(4), torch.zeros(3))),
        (TypeError, 'effects must be an Effects or "auto", got', lambda: CAMERA.settings(effects="all")),
    ],
)
def test_wrong_arguments(error, message, make):
    with pytest.raises(error, match=message):
        make()


@pytest.mark.parametrize(
    "tangent, error, message",
    [
        (torch.tensor(-0.5), ValueError, "tanfovx must be positive and finite, got -0.5"),
        (torch.tensor(0.0, requires_grad=True), ValueError, "tanfovx must be positive and finite, got 0.0"),
        (-0.5, ValueError, "tanfovx must be positive and finite, got -0.5"),
        (torch.ones(2), TypeError, "tanfovx must be a number, got tensor"),
        (None, TypeError, "tanfovx must be a number, got None"),
    ],
)
def test_tangents_of_a_camera_with_gradients_are_checked(tangent, error, message):
    """As those of one without; on the CPU, because on CUDA a tensor would have to be waited for."""
    settings = CAMERA.settings(effects=ar.Effects(camera_gradients=True))._replace(tanfovx=tangent)
    with pytest.raises(error, match=message):
        ar.GaussianRasterizer(settings)(**scenes.random_scene(1, 5, degree=1))


def test_a_lens_that_is_not_finite_raises():
    """As a camera does; on CUDA only with debug, because it would have to be waited for."""
    scene = scenes.random_scene(1, 5, degree=1)
    effects = ar.Effects(defocus=ar.Defocus(torch.tensor(float("nan")), 3.0))
    with pytest.raises(ValueError, match=r"lens must be finite, got nan at \(4,\)"):
        ar.GaussianRasterizer(CAMERA.settings(effects=effects))(**scene)


def test_settings_with_effects_copy_and_pickle():
    import copy
    import pickle

    effects = ar.Effects(defocus=LENS, motion=SHUTTER, near=0.5, sh_degree=2)
    settings = CAMERA.settings(effects=effects)
    assert pickle.loads(pickle.dumps(settings)).effects == effects == copy.deepcopy(settings).effects
    assert settings._replace(effects="auto")._replace(sh_degree=0).effects == "auto"
