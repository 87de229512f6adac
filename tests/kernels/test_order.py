"""`Effects(order="ray")` against the second implementation of tests/makers/ray_reference.py, and its promises.

Tolerances of images and gradients are those of test_render_reference.py, whose derivation holds for every order. Only
the comparison of depths is new: pixels in which two depths that are compared differ by less than DEPTH_MARGIN are left
out, since rounding may decide them. A depth is z + g . d, in these scenes with |z| and |g . d| below 10 world units,
and has less than ten roundings: 20 * 10 * eps is 4e-14 in float64 and 2.4e-5 in float32.
"""

import math
from dataclasses import replace

import pytest
import ray_reference
import reference
import scenes
import torch
from marks import needs_cuda
from scenes import VARIANTS, Camera, name_of
from test_render_reference import (
    GRADIENT_TOLERANCE,
    IMAGE_TOLERANCE,
    MARGIN,
    exact_settings,
    probe,
    rasterize_op,
    relative_error,
)

import analytic_rasterizer as ar
from analytic_rasterizer.render.order import CENTER, RAY, WINDOWS

DEPTH_MARGIN = {torch.float64: 4e-14, torch.float32: 2.4e-5}
ALONG_RAYS = [
    ("point", {}),
    ("mip", {}),
    ("analytic", {"frame_gradient": "frozen"}),
    ("box", {"samples": 1}),
    ("box", {"samples": 4}),
    ("moment", {"samples": 1}),
    ("moment", {"samples": 4}),
]
each_along_rays = pytest.mark.parametrize("variant", ALONG_RAYS, ids=name_of)
each_dtype = pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=str)
each_place = pytest.mark.parametrize(
    "device, dtype",
    [("cpu", torch.float64), ("cpu", torch.float32), pytest.param("cuda", torch.float32, marks=needs_cuda)],
)
RAYS = ar.Effects(order=RAY)
SMALL = Camera(image_height=19, image_width=23)  # more than a tile: the reference is slow


@pytest.fixture
def with_window(monkeypatch):
    """A function that gives the order RAY another window, for the rest of the test."""
    return lambda window: monkeypatch.setitem(WINDOWS, RAY, window)


def tilted_scene(seed, count=60):
    """Wide and flat Gaussians through each other, so that orders differ."""
    scene = scenes.random_scene(seed, count)
    generator = torch.Generator().manual_seed(seed)
    flat = torch.rand(count, 3, generator=generator, dtype=torch.float64)
    scene["scales"] = torch.where(flat < 0.3, 0.05, 0.6) * (0.5 + flat)
    return scene


def both(camera, scene, variant, dtype, window, device="cpu", effects=RAYS):
    """The library's image, the reference's, its RayOrder, the pixels that rounding cannot change, and the leaves."""
    rounded = scenes.cast(scene, dtype)
    ours, theirs = (
        scenes.leaves(scenes.cast(rounded, dtype, device)),
        scenes.leaves(scenes.cast(rounded, torch.float64)),
    )
    settings = exact_settings(camera, dtype, variant)._replace(effects=effects)
    color = camera.render(ours, variant, effects=effects)[0].cpu()
    footprint, options = variant
    expected, order = ray_reference.render(settings, **theirs, footprint=footprint, window=window, **options)
    clear = (expected.pixel_margin > MARGIN[dtype]) & (order.margin > DEPTH_MARGIN[dtype])
    return color, expected, order, clear, ours, theirs


@each_along_rays
@each_place
@pytest.mark.parametrize("window", [1, 3, 24, 64])
def test_image_and_gradients(variant, device, dtype, window, with_window):
    """Windows that are too small, that of "ray", and one larger than all lists, with every input's gradient."""
    with_window(window)
    camera, scene = replace(SMALL, bg=(0.3, 0.1, 0.8)), tilted_scene(3)
    color, expected, order, clear, ours, theirs = both(camera, scene, variant, dtype, window, device)
    assert clear.double().mean() > (0.999 if dtype == torch.float64 else 0.9)
    assert order.shown.max() > 24  # else the windows would be alike
    error = (color - expected.color).detach().abs().amax(0)[clear].max()
    weights = probe(camera) * clear
    (color * weights.to(color)).sum().backward()
    (expected.color * weights).sum().backward()
    errors = {name: relative_error(ours[name].grad.cpu(), theirs[name].grad) for name in scene}
    print(name_of(variant), window, f"{error:.1e}", {name: f"{value:.1e}" for name, value in errors.items()})
    assert error < IMAGE_TOLERANCE[dtype]
    assert max(errors.values()) < GRADIENT_TOLERANCE[dtype], errors


def test_windows_differ():
    """The scene above tells orders and windows apart: a test that compares equal pictures would prove nothing."""
    camera, scene = SMALL, tilted_scene(3)
    settings = exact_settings(camera, torch.float64, ("point", {}))
    made = {
        window: ray_reference.render(settings, **scene, footprint="point", window=window)[0].color
        for window in (0, 3, 24, None)
    }
    center = reference.render(settings, **scene, footprint="point").color
    assert torch.equal(made[0], center)  # no window
    for one, other in ((0, 3), (3, 24)):
        assert (made[one] - made[other]).abs().max() > 1 / 255
    assert (made[24] - made[None]).abs().max() < 1 / 255


@pytest.mark.parametrize("scale", [1.0, 0.2])
def test_the_depth_is_where_the_ray_is_densest(scale):
    """The linear depth of the affine projection against b / a along exact rays.

    Under an orthographic camera both are the same but for v, which changes a slope by v / (smallest eigenvalue of
    Sigma_uv) of itself. Slopes are at most sigma_z over the smallest deviation in the picture.
    """
    camera = Camera().facing_z()
    scene = tilted_scene(5, 30)
    scene["means3D"][:, 2] += 4
    scene["scales"] = scene["scales"] * scale
    fields = camera.fields()
    flat = torch.eye(4, dtype=torch.float64)
    flat[0, 0], flat[1, 1], flat[2, 2] = 1 / 2.0, 1 / 2.0, 1e-2
    fields |= {"projmatrix": (flat @ camera.world_to_camera()).T, "tanfovx": 2.0, "tanfovy": 2.0}
    settings = ar.GaussianRasterizationSettings(**fields, effects=ar.Effects(orthographic=True))
    covariance = reference.covariance_3d(scene["scales"], scene["rotations"], 1.0)
    projection = reference.project(settings, scene["means3D"], covariance)
    linear = ray_reference.linear_depths(settings, scene["means3D"], covariance, projection)
    exact = ray_reference.exact_depths(settings, scene["means3D"], scene["scales"], scene["rotations"])
    xx, xy, yy = projection.cov2d.unbind(1)
    smallest = (xx + yy) / 2 - torch.hypot((xx - yy) / 2, xy)
    distance = (ray_reference.pixels_of(settings) - projection.means2d[:, None, None]).norm(dim=-1)
    steepest = scene["scales"].amax(1) / smallest.sqrt()
    bound = (ray_reference.RAY_VARIANCE / smallest * steepest)[:, None, None] * distance
    assert (linear - exact).abs().max() > 0
    assert ((linear - exact).abs() <= bound + 1e-9).all()
    assert (bound / (steepest[:, None, None] * distance + 1e-9)).max() < 0.05  # else it would say nothing


def test_the_exact_depth_is_the_densest_point():
    """b / a by plain search along the ray of one pixel."""
    camera, scene = Camera(), tilted_scene(7, 6)
    settings = exact_settings(camera, torch.float64, ("point", {}))
    depths = ray_reference.exact_depths(settings, scene["means3D"], scene["scales"], scene["rotations"])[:, 20, 11]
    view = settings.viewmatrix
    _, directions = ray_reference.rays_of(settings)
    inverse = torch.linalg.inv(reference.covariance_3d(scene["scales"], scene["rotations"], 1.0))
    for i, depth in enumerate(depths.tolist()):
        z = depth + torch.linspace(-1e-3, 1e-3, 2001, dtype=torch.float64)
        points = (z[:, None] * directions[20, 11] - view[3, :3]) @ view[:3, :3].T - scene["means3D"][i]
        density = -torch.einsum("ni,ij,nj->n", points, inverse[i], points)
        assert abs(z[density.argmax()].item() - depth) < 2e-6


@each_along_rays
def test_nothing_is_lost(device, best, variant, with_window):
    """Alpha does not depend on the order of splats that do not move nodes, whatever the window; none is left out."""
    camera, scene = Camera(), tilted_scene(9)
    scene["opacities"] = scene["opacities"] * 0.1  # so that no sample stops
    settings = exact_settings(camera, torch.float64, variant)
    margin = reference.render(settings, **scene, footprint=variant[0], **variant[1]).pixel_margin
    clear = margin > MARGIN[best]
    assert clear.double().mean() > 0.9
    scene = scenes.cast(scene, best, device)
    made = []
    for window in (1, 2, 24, 64):
        with_window(window)
        effects = ar.Effects(order=RAY, alpha=True)
        made.append(camera.render(scene, variant, effects=effects)[2].alpha.cpu())
    center = camera.render(scene, variant, effects=ar.Effects(alpha=True))[2].alpha.cpu()
    assert (center > 0.3).any()
    # Where nodes move, what a splat takes depends on those before it: by a few percent, and by far less than a splat.
    most = 0.1 if variant[0] == "moment" else 1e-12 if best == torch.float64 else IMAGE_TOLERANCE[best]
    assert max((alpha - center)[..., clear].abs().max() for alpha in made) < most


def layers(count=40):
    """A camera and thin splats, one behind the other and all facing it: every order is that of their centres."""
    camera, g = SMALL.facing_z(), torch.Generator().manual_seed(2)
    spots = scenes.rand(g, count, 2) * torch.tensor([camera.image_width, camera.image_height])
    cov2d = torch.tensor([9.0, 2.0, 4.0]) * (0.2 + scenes.rand(g, count, 1))
    depths = 1 + 0.05 * torch.randperm(count, generator=g)
    return camera, scenes.splat_scene(camera, spots, cov2d, [0.4] * count, depths, scenes.rand(g, count, 3))


@each_along_rays
@each_place
def test_splats_apart_have_one_order(variant, device, dtype):
    """The order of centres is that along every ray."""
    camera, scene = layers()
    settings = exact_settings(camera, torch.float64, variant)
    margin = reference.render(settings, **scene, footprint=variant[0], **variant[1]).pixel_margin
    scene = scenes.cast(scene, dtype, device)
    rays, center = (camera.render(scene, variant, effects=ar.Effects(order=o))[0].cpu() for o in (RAY, CENTER))
    assert center.max() > 0.2
    if device == "cpu":
        assert (rays - center).abs().max() < 30 * torch.finfo(dtype).eps  # sums in another order
    else:  # tiles of another size
        assert (rays - center)[:, margin > MARGIN[dtype]].abs().max() < IMAGE_TOLERANCE[dtype]


@each_along_rays
@pytest.mark.parametrize("columns, means2d_z", [(4, "zero"), (3, "sum_abs"), (3, "sum_norm")])
def test_sums_over_pixels_beside_gradients_of_means2d(variant, columns, means2d_z):
    """Where both orders are the same, so are these."""
    camera, scene = layers()
    scene["means2D"] = torch.zeros(len(scene["means3D"]), columns).double()
    made = []
    for order in (RAY, CENTER):
        leaves = scenes.leaves(scene)
        settings = camera.settings(variant=variant, effects=ar.Effects(order=order))
        color = rasterize_op(settings, leaves, means2d_z=means2d_z)[0]
        (color * probe(camera)).sum().backward()
        made.append(leaves["means2D"].grad)
    assert (made[1][:, 2:] > 0).any()
    assert relative_error(*made) < 1e-10


@each_along_rays
def test_covariances_of_the_caller(variant):
    """cov3D_precomp in place of scales and rotations: the same slopes, picture and gradients."""
    scene = tilted_scene(21)
    covariance = reference.covariance_3d(scene["scales"], scene["rotations"], 1.0)
    own = scenes.without(scene, "scales", "rotations")
    own["cov3D_precomp"] = covariance[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    settings, made = SMALL.settings(variant=variant, effects=RAYS), []
    for given in (scene, own):
        leaves = scenes.leaves(given)
        color = ar.GaussianRasterizer(settings)(**leaves)[0]
        (color * probe(SMALL)).sum().backward()
        slopes = ar.project(settings, **scenes.without(given, "means2D")).slopes
        made.append((slopes, color.detach(), leaves["opacities"].grad, leaves["means3D"].grad))
    assert made[0][0].abs().max() > 1e-3
    assert max(relative_error(*pair) for pair in zip(*made)) < 1e-8


@each_along_rays
def test_four_channels(variant):
    """As two pictures of two channels each, whose gradients add up."""
    scene = scenes.without(tilted_scene(23), "shs")
    channels, made = scenes.rand(torch.Generator().manual_seed(1), 60, 4), []
    for parts in ([channels], channels.split(2, 1)):
        images, by_channels, by_opacities = [], [], 0
        for part in parts:
            leaves = scenes.leaves(scene | {"colors_precomp": part})
            settings = SMALL.settings(variant=variant, effects=RAYS)._replace(bg=part.new_zeros(part.shape[1]))
            images.append(ar.GaussianRasterizer(settings)(**leaves)[0])
            images[-1].square().sum().backward()
            by_channels.append(leaves["colors_precomp"].grad)
            by_opacities = by_opacities + leaves["opacities"].grad
        made.append((torch.cat(images).detach(), torch.cat(by_channels, 1), by_opacities))
    assert max(relative_error(*pair) for pair in zip(*made)) < 1e-10


@pytest.mark.parametrize("window", [1, 2, 24])
def test_equal_depths_by_index(device, best, window, with_window):
    """Of equal splats the first is in front, also where a window is full."""
    with_window(window)
    camera = Camera(image_height=1, image_width=1).facing_z()
    scene = scenes.splat_scene(camera, [[0.0, 0.0]] * 3, [25.0, 0, 25.0], [0.5] * 3, [2.0] * 3, torch.eye(3).double())
    color, _ = camera.render(scenes.cast(scene, best, device), ("point", {}), effects=RAYS)
    expected = torch.tensor([0.5, 0.25, 0.125], dtype=torch.float64)
    assert (color[:, 0, 0].cpu() - expected).abs().max() < 4.5 * torch.finfo(best).eps


@each_along_rays
def test_the_same_bits_with_any_number_of_threads(variant):
    camera = Camera(image_height=150, image_width=130)
    scene, found = scenes.cast(tilted_scene(13, 300), torch.float32), []
    before = torch.get_num_threads()
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            leaves = scenes.leaves(scene)
            color = camera.render(leaves, variant, effects=RAYS)[0]
            (color * probe(camera).float()).sum().backward()
            found.append([color.detach(), *(leaf.grad for leaf in leaves.values())])
    finally:
        torch.set_num_threads(before)
    for others in found[1:]:
        assert all(torch.equal(a, b) for a, b in zip(found[0], others))


@each_along_rays
def test_the_same_bits_in_every_run(device, variant):
    """Backward too; with more than the log of a warp on CUDA has room for."""
    camera = Camera(image_height=75, image_width=90)
    scene, found = scenes.cast(tilted_scene(13, 900), torch.float32, device), []
    scene["opacities"] = scene["opacities"] * 0.05
    for _ in range(3):
        leaves = scenes.leaves(scene)
        color = camera.render(leaves, variant, effects=RAYS)[0]
        (color * probe(camera).to(color)).sum().backward()
        found.append([color.detach(), *(leaf.grad for leaf in leaves.values())])
    for others in found[1:]:
        assert all(torch.equal(a, b) for a, b in zip(found[0], others))


@each_along_rays
def test_pictures_do_not_depend_on_where_tiles_are(variant, with_window):
    """A picture cut out of a larger one, by other tiles, with a window that many pixels fill."""
    with_window(5)
    camera = Camera(image_height=64, image_width=80)
    scene = tilted_scene(15, 200)
    scene["means3D"] = 0.5 * scene["means3D"]  # not beyond the clamp of the smaller picture
    whole = camera.render(scene, variant, effects=RAYS)[0]
    x, y, width, height = 7, 5, 61, 40
    part = camera.__class__(
        image_height=height,
        image_width=width,
        tanfovx=camera.tanfovx * width / 80,
        tanfovy=camera.tanfovy * height / 64,
        shift=(40 - width / 2 - x, 32 - height / 2 - y),
    )
    cut = part.render(scene, variant, effects=RAYS)[0]
    assert whole.max() > 0.3
    assert (cut - whole[:, y : y + height, x : x + width]).abs().max() < 1e-9


@each_along_rays
def test_two_plates_that_cross(device, variant):
    """On each side another plate is in front; in the order of centres it is the same one everywhere."""
    turn = math.pi / 8  # half of the angle between plate and picture
    scene = {
        "means3D": torch.tensor([[0.0, 0.0, 4.0], [0.0, 0.0, 4.01]]),
        "means2D": None,
        "scales": torch.tensor([[1.0, 1.0, 0.01]]).repeat(2, 1),
        "rotations": torch.tensor([[math.cos(turn), 0, s * math.sin(turn), 0] for s in (1, -1)]),
        "opacities": torch.full((2, 1), 0.99),
        "colors_precomp": torch.tensor([[1.0, 0, 0], [0, 1, 0]]),
    }
    camera = Camera(image_height=16, image_width=32, tanfovx=16 / 30, tanfovy=8 / 30).facing_z()
    scene = scenes.to(scene, device)
    for order in (CENTER, RAY):
        color = camera.render(scene, variant, effects=ar.Effects(order=order))[0]
        left, right = color[:, 8, 11], color[:, 8, 20]
        assert min(left.max(), right.max()) > 0.5
        assert ((left[0] > left[1]) == (right[0] > right[1])) == (order == CENTER)


@needs_cuda
def test_slopes_on_cuda():
    """Of rows and tables, as on the CPU."""
    scene = scenes.without(scenes.cast(tilted_scene(3), torch.float32), "means2D")
    for effects in (RAYS, ar.Effects(order=RAY, lens=ar.Lens.fisheye([0.05]))):
        made = [
            ar.project(
                SMALL.settings(torch.float32, device, ("point", {}), effects=effects), **scenes.to(scene, device)
            )
            for device in ("cpu", "cuda")
        ]
        assert torch.equal(made[0].gaussian_ids, made[1].gaussian_ids.cpu())
        assert (made[0].slopes - made[1].slopes.cpu()).abs().max() < 1e-4 * made[0].slopes.abs().max()


@pytest.mark.parametrize("variant", VARIANTS, ids=name_of)
def test_the_truth_is_there_for_every_footprint(variant):
    """Image and gradients in exact order: finite, and another picture than in the order of centres."""
    camera, scene = Camera(image_height=5, image_width=6), tilted_scene(17, 12)
    footprint, options = variant
    settings = exact_settings(camera, torch.float64, ("point", {}))
    leaves = scenes.leaves(scene)
    expected, order = ray_reference.render(settings, **leaves, footprint=footprint, exact=True, **options)
    assert order.shown.max() > 4
    expected.color.sum().backward()
    assert all(leaf.grad.isfinite().all() and leaf.grad.abs().max() > 0 for leaf in leaves.values())
    center = reference.render(settings, **scene, footprint=footprint, **options).color
    assert (expected.color - center).abs().max() > 1 / 255


@each_along_rays
def test_pictures_come_near_to_the_truth(variant):
    """A tenth of the error of the order is left, of splats that are small beside their distance: depths are linear in
    the picture, as the projection of the affine approximation is."""
    scene = tilted_scene(3)
    scene |= {"scales": 0.25 * scene["scales"], "means3D": 0.4 * scene["means3D"]}
    camera = replace(SMALL, tanfovx=0.15, tanfovy=0.125, eye=(1.2, -0.8, -16.0))
    footprint, options = variant
    settings = exact_settings(camera, torch.float64, variant)
    truth = ray_reference.render(settings, **scene, footprint=footprint, exact=True, **options)[0].color
    rays, center = (
        (camera.render(scene, variant, effects=ar.Effects(order=order))[0] - truth).square().mean().sqrt()
        for order in (RAY, CENTER)
    )
    print(f"{rays:.1e} {center:.1e}")
    assert center > 0.5 / 255
    assert rays < center / 10
