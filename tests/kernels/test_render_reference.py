"""Whole images and all gradients against the reference renderer, in float64 (on CUDA in float32).

The two share no code and take their gradients in different ways, so agreement to rounding means
that both follow the equations. What remains is float64 rounding times the condition of the scene:
the projected covariances of random_scene have condition numbers up to (0.6/0.005)^2 = 1.4e4, a
weight errs by 16 eps cond = 5e-11, and a gradient by another factor of ten. (Seen: 1e-14 and
6e-14.) In float32 the same bounds would say nothing, eps being 5e8 times larger; what was seen would
be 7e-6 and 4e-5. Five times that is asked there, of pixels that are clear of every threshold.
"""

import math

import pytest
import reference
import scenes
import torch
from marks import each_kind, each_path, every_footprint
from scenes import KINDS, RENDERED, VARIANTS, Camera, name_of

import analytic_rasterizer as ar
from analytic_rasterizer.render.arguments import camera_arguments, gaussian_arguments

IMAGE_TOLERANCE = {torch.float64: 1e-10, torch.float32: 4e-5}
GRADIENT_TOLERANCE = {torch.float64: 1e-9, torch.float32: 2e-4}  # of the largest entry
# Rounding must not decide a comparison with a threshold: distance to it, relative.
MARGIN = {torch.float64: 1e-10, torch.float32: 1e-3}

# On CUDA, sums of absolute values over many samples have kernels of their own.
each_sum_of_absolute_values = pytest.mark.parametrize("variant", [*KINDS, ("box", {"samples": 16})], ids=name_of)


def render(camera, scene, variant):
    """(color, radii) of the library, on the scene's device and in its dtype."""
    return camera.render(scene, variant)


def rasterize_op(settings, scene, **chosen):
    """What the op returns for a scene, with arguments of the op that settings do not have."""
    optional = dict.fromkeys(("means2D", "shs", "colors_precomp", "scales", "rotations", "cov3D_precomp"))
    gaussians = gaussian_arguments(settings, **(optional | scene))
    camera = camera_arguments(settings, scene["means3D"], gaussians["shs"])
    return torch.ops.analytic_rasterizer.rasterize(**gaussians, **camera, bg=settings.bg, **chosen)


def exact_settings(camera, dtype, variant):
    """Settings in float64 whose numbers are those of settings in `dtype`."""
    fields = camera.fields(dtype)
    fields = {name: value.double() if torch.is_tensor(value) else value for name, value in fields.items()}
    footprint, options = variant
    return ar.GaussianRasterizationSettings(**fields, footprint=footprint, **options)


def render_reference(camera, scene, variant, dtype=torch.float64, **kwargs):
    """The scene must be float64; the camera's matrices are rounded to `dtype`."""
    return reference_of(exact_settings(camera, dtype, variant), scene, variant, **kwargs)


def reference_of(settings, scene, variant, **kwargs):
    footprint, options = variant
    return reference.render(settings, **scene, footprint=footprint, **kwargs, **options)


def both_leaves(scene, dtype, device):
    """Leaves for the library, and for the reference the same numbers in float64 on the CPU."""
    ours = scenes.cast(scene, dtype, device)
    return scenes.leaves(ours), scenes.leaves(scenes.cast(ours, torch.float64))


def probe(camera):
    """Weights of the scalar loss whose gradient is compared."""
    return scenes.probe(torch.zeros(3, camera.image_height, camera.image_width, dtype=torch.float64), seed=99)


def clear_probe(camera, rendered, dtype):
    """The same, zero in pixels where rounding in `dtype` may decide a comparison with a threshold."""
    return probe(camera) * (rendered.pixel_margin > MARGIN[dtype])


def relative_error(actual, expected):
    actual = actual.to(expected)
    scale = expected.abs().max().clamp_min(1e-30)
    return ((actual - expected).abs().max() / scale).item()


def compare(camera, scene, variant, device, dtype):
    """Assert that image, radii and every gradient agree; in float32 but for pixels at a threshold."""
    ours, theirs = both_leaves(scene, dtype, device)
    color, radii = render(camera, ours, variant)
    expected = render_reference(camera, theirs, variant, dtype)
    clear = expected.pixel_margin > MARGIN[dtype]
    if dtype == torch.float64:
        assert clear.all(), "unlucky scene: choose another seed"
    assert color.shape == (3, camera.image_height, camera.image_width)
    assert color.dtype == dtype
    difference = (color.cpu() - expected.color).detach().abs().amax(0)
    errors = {"image": difference[clear].max().item()}
    assert difference.max() < 8 / 255  # a flipped alpha is 1/255 of a colour

    loss = clear_probe(camera, expected, dtype)
    (color * loss.to(color)).sum().backward()
    (expected.color * loss).sum().backward()
    for name in scene:
        assert ours[name].grad is not None, f"no gradient for {name}"
        assert ours[name].grad.shape == scene[name].shape
        errors[name] = relative_error(ours[name].grad, theirs[name].grad)
        assert theirs[name].grad.abs().max() > 0, f"the scene does not exercise {name}"
    print(name_of(variant), {name: f"{error:.1e}" for name, error in errors.items()})
    assert errors.pop("image") < IMAGE_TOLERANCE[dtype]
    for name, error in errors.items():
        assert error < GRADIENT_TOLERANCE[dtype], (name, error)
    assert_radii(camera, radii.cpu(), expected, variant, dtype)
    return expected


def assert_radii(camera, radii, expected, variant, dtype):
    """ceil(3 sigma) wherever a pixel is touched; 0 behind the camera and far off screen."""
    footprint, options = variant
    assert radii.dtype == torch.int32
    means2d, cov2d, depths = (t.detach() for t in expected.projection)
    size = reference.three_sigma(cov2d, footprint, **options)
    touched = expected.radii > 0
    decided = (size - size.round()).abs() > (1e-9 if dtype == torch.float64 else 1e-3)
    assert torch.equal(radii[touched & decided], torch.ceil(size).int()[touched & decided])
    assert touched.any()
    # Four radii outside the image no alpha reaches exp(-72).
    limits = torch.tensor([camera.image_width, camera.image_height])
    far = ((means2d < -4 * size[:, None] - 1) | (means2d > limits + 4 * size[:, None])).any(-1)
    assert (radii[(depths <= reference.NEAR) | far] == 0).all()
    # Where it is not 0 it is the one value it may have.
    shown = (radii > 0) & decided
    assert torch.equal(radii[shown], torch.ceil(size).int()[shown])


def hard_scene(seed=11, degree=0):
    """Opaque and faint, small and large, behind, off screen, beyond the frustum clamp."""
    scene = scenes.random_scene(seed, count=44, degree=degree, sigma=(0.005, 0.6))
    scene["opacities"][::5] = 1.0  # capped at 0.99 near their centres
    scene["opacities"][1::9] = 0.003  # below 1/255 everywhere
    # Beside the camera: behind it, in front of the near plane, and far outside the frustum but
    # large.
    means, scales = scene["means3D"], scene["scales"]
    means[0] = torch.tensor([0.3, 0.1, -5.0])
    means[1] = torch.tensor([0.3, -0.2, -3.9])
    means[2] = torch.tensor([40.0, 0.0, 0.0])
    means[3], scales[3] = torch.tensor([3.6, 0.4, -1.0]), torch.tensor([0.9, 1.1, 0.8])
    means[4], scales[4] = torch.tensor([-0.2, -3.4, -1.2]), torch.tensor([0.8, 0.9, 1.3])
    scene["opacities"][3:5] = 0.8
    return scene


CAMERA = Camera(bg=(0.2, 0.5, 0.9), scale_modifier=1.15, shift=(2.3, -4.1))


@pytest.mark.parametrize("variant", VARIANTS, ids=name_of)
def test_everything_at_once(device, best, variant):
    """44 Gaussians, 45x37 px, off-centre projection, background, scale modifier, clamp, cap."""
    expected = compare(CAMERA, hard_scene(), variant, device, best)
    view = torch.cat([hard_scene()["means3D"], torch.ones(44, 1).double()], -1)
    view = view @ CAMERA.settings().viewmatrix
    slope = (view[:, :2] / view[:, 2:3]).abs()
    limit = reference.FRUSTUM_CLAMP * torch.tensor([CAMERA.tanfovx, CAMERA.tanfovy])
    clamped = (slope > limit).any(-1) & (expected.radii > 0)
    assert clamped.any(), "no visible splat beyond the frustum clamp"


@pytest.mark.parametrize("variant", [("point", {})], ids=name_of)
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_spherical_harmonics(device, best, variant, degree):
    compare(Camera(sh_degree=degree), scenes.random_scene(20 + degree, 20, degree), variant, device, best)


def test_spherical_harmonics_below_the_stored_degree(device, best):
    """M = 16 rows, degree 1 in use: the other rows change nothing and get zero gradient."""
    scene = scenes.random_scene(30, 20, degree=3)
    camera = Camera(sh_degree=1)
    compare(camera, scene, ("point", {}), device, best)
    scene = scenes.cast(scene, best, device)
    ours = scenes.leaves(scene)
    render(camera, ours, ("point", {}))[0].sum().backward()
    assert (ours["shs"].grad[:, 4:] == 0).all()
    truncated = dict(scene, shs=scene["shs"][:, :4].contiguous())
    assert torch.equal(render(camera, scene, ("point", {}))[0], render(camera, truncated, ("point", {}))[0])


@each_path
def test_precomputed(device, best, variant):
    """colors_precomp (negative and above one too: they are not clamped) and cov3D_precomp."""
    scene = scenes.with_precomputed(hard_scene(12))
    scene["colors_precomp"] = scene["colors_precomp"] * 3 - 1
    compare(CAMERA, scene, variant, device, best)


def test_scale_modifier_acts_on_scales_only(device, best):
    plain = scenes.cast(scenes.random_scene(31), best, device)
    scaled = dict(plain, scales=plain["scales"] * 1.7)
    by_modifier = render(Camera(scale_modifier=1.7), plain, ("mip", {}))[0]
    difference = (by_modifier - render(Camera(), scaled, ("mip", {}))[0]).abs().max()
    assert difference < (1e-12 if best == torch.float64 else IMAGE_TOLERANCE[best])
    fixed = scenes.cast(scenes.with_precomputed(scenes.random_scene(31)), best, device)
    with_modifier, plain = (render(Camera(scale_modifier=s), fixed, ("mip", {}))[0] for s in (1.7, 1.0))
    assert torch.equal(with_modifier, plain)


@each_path
@pytest.mark.parametrize("size", [(1, 1), (16, 16), (17, 15), (33, 48), (4000, 1), (1, 4000)], ids=str)
def test_image_sizes(device, best, variant, size):
    camera = Camera(image_width=size[0], image_height=size[1], bg=(0.1, 0.2, 0.3))
    scene = scenes.random_scene(32, 15, opacity=(0.3, 0.9), sigma=(0.3, 0.9), spread=0.5)
    compare(camera, scene, variant, device, best)


@each_kind
def test_deep_stack(device, best, variant):
    """Opaque layers: samples stop; the splat that would pass 1e-4 is not blended, T stays."""
    camera = Camera(bg=(1.0, 0.0, 0.5))
    scene = scenes.random_scene(33, 60, opacity=(0.5, 1.0), sigma=(0.4, 1.5), spread=0.6)
    expected = compare(camera, scene, variant, device, best)
    # The scene does stop: without the last Gaussians (in depth order) the image is the same
    # somewhere.
    order = torch.argsort(expected.projection.depths)
    fewer = {name: value[order[:40]] for name, value in scene.items()}
    fewer = both_leaves(fewer, best, "cpu")[1]
    assert (render_reference(camera, fewer, variant, best).color == expected.color).any()


def test_unnormalised_and_zero_quaternions(device, best):
    """Normalised inside, with gradient; zero is the identity with zero gradient."""
    scene = scenes.random_scene(34, 20)
    scene["rotations"] = scene["rotations"] * torch.logspace(-3, 3, 20).double()[:, None]
    scene["rotations"][7] = 0
    # Gradients scale with 1/|q|: compare them times |q|.
    ours, theirs = both_leaves(scene, best, device)
    expected = render_reference(Camera(), theirs, ("mip", {}), best)
    loss = clear_probe(Camera(), expected, best)
    (render(Camera(), ours, ("mip", {}))[0] * loss.to(device, best)).sum().backward()
    (expected.color * loss).sum().backward()
    size = scene["rotations"].norm(dim=-1, keepdim=True)
    error = relative_error(ours["rotations"].grad.cpu() * size, theirs["rotations"].grad * size)
    assert error < GRADIENT_TOLERANCE[best]
    assert (ours["rotations"].grad[7] == 0).all()
    assert ours["scales"].grad[7].abs().max() > 0


@pytest.mark.parametrize("length", [1e-30, 1e-23, 1e15])
def test_extreme_quaternions_float32(device, length):
    """The direction counts, whatever the length (whose square leaves the range of float32)."""
    scene = scenes.cast(scenes.random_scene(35, 10), torch.float32, device)
    scene["rotations"] = scene["rotations"] / scene["rotations"].norm(dim=-1, keepdim=True)
    expected, _ = render(Camera(), scene, ("mip", {}))
    scene["rotations"] = scene["rotations"] * length
    ours = scenes.leaves(scene)
    color, _ = render(Camera(), ours, ("mip", {}))
    assert (color - expected).abs().max() < 1e-5
    color.sum().backward()
    assert torch.isfinite(ours["scales"].grad).all()


@pytest.mark.parametrize("columns, means2d_z", [(4, None), (3, "sum_abs"), (3, "sum_norm")])
@each_sum_of_absolute_values
def test_sums_over_pixels_beside_gradients_of_means2d(device, best, variant, columns, means2d_z):
    """means2D (P, 4): columns 0:2 as ever, 2:4 the sum over pixels of |gx|, |gy|. means2D (P, 3): column 2 the sum over
    pixels of |gx| + |gy|, or of the length of (gx, gy)."""
    scene = dict(hard_scene(13), means2D=torch.zeros(44, columns).double())
    ours, theirs = both_leaves(scene, best, device)
    expected = render_reference(CAMERA, theirs, variant, best, keep_offsets=True)
    loss = clear_probe(CAMERA, expected, best)
    if means2d_z is None:
        color, _ = render(CAMERA, ours, variant)
    else:
        color = rasterize_op(CAMERA.settings(best, device, variant), ours, means2d_z=means2d_z)[0]
    (color * loss.to(device, best)).sum().backward()
    (expected.color * loss).sum().backward()
    actual = ours["means2D"].grad.cpu()
    assert relative_error(actual[:, :2], theirs["means2D"].grad[:, :2]) < GRADIENT_TOLERANCE[best]
    if means2d_z == "sum_norm":
        sums = reference.norm_gradient(expected, 44, CAMERA.settings())[:, None]
    else:
        sums = reference.absolute_gradient(expected, 44, CAMERA.settings())
        sums = sums if columns == 4 else sums.sum(1, keepdim=True)
    assert relative_error(actual[:, 2:], sums) < GRADIENT_TOLERANCE[best]


@pytest.mark.parametrize("means2d_z", ["zero", "sum_abs", "sum_norm"])
def test_four_columns_of_means2d_are_the_same_whatever_the_third_is(device, best, means2d_z):
    scene = scenes.cast(scenes.random_scene(36, 25), best, device)
    results = []
    for choice in ("zero", means2d_z):
        ours = scenes.leaves(dict(scene, means2D=torch.zeros(25, 4, dtype=best, device=device)))
        color = rasterize_op(Camera().settings(best, device), ours, means2d_z=choice)[0]
        (color * probe(Camera()).to(color)).sum().backward()
        results.append(ours["means2D"].grad)
    assert torch.equal(*results)


def test_unknown_third_column_of_means2d(device, best):
    scene = scenes.cast(scenes.random_scene(36, 25), best, device)
    with pytest.raises(ValueError, match="means2d_z must be zero, sum_abs or sum_norm, got norm"):
        rasterize_op(Camera().settings(best, device), scene, means2d_z="norm")


@each_kind
def test_means2d_forms_agree(device, best, variant):
    """None, (P, 3) and (P, 4) change nothing else; the third column of (P, 3) stays 0."""
    scene = scenes.cast(scenes.random_scene(36, 25), best, device)
    results = []
    for means2d in (None, torch.zeros(25, 3).double(), torch.full((25, 4), 7.0).double()):
        ours = scenes.leaves({k: v for k, v in scene.items() if k != "means2D"})
        leaf = None if means2d is None else means2d.to(device, best).requires_grad_()
        color, radii = render(Camera(), ours | {"means2D": leaf}, variant)
        (color * probe(Camera()).to(color)).sum().backward()
        results.append((color, radii, ours["means3D"].grad, leaf))
    for color, radii, by_mean, _ in results[1:]:
        assert torch.equal(color, results[0][0])
        assert torch.equal(radii, results[0][1])
        assert torch.equal(by_mean, results[0][2])
    three, four = results[1][3].grad, results[2][3].grad
    assert (three[:, 2] == 0).all()
    assert torch.equal(three[:, :2], four[:, :2])
    assert (four[:, 2:] >= three[:, :2].abs() * (1 - 4500 * torch.finfo(best).eps)).all()


def test_cap_has_zero_gradient(device, best):
    """One splat with opacity 1 over its centre pixel: alpha = 0.99 whatever the input does."""
    camera = Camera(image_height=1, image_width=1).facing_z()
    scene = scenes.splat_scene(camera, [[0.0, 0.0]], [25.0, 3.0, 16.0], [1.0], [2.0])
    ours = scenes.leaves(scenes.cast(scene, best, device))
    color, _ = render(camera, ours, ("point", {}))
    cap = torch.tensor(0.99, dtype=best, device=device)
    assert (color == cap).all()
    color.sum().backward()
    for name in ("means3D", "means2D", "opacities", "cov3D_precomp"):
        assert (ours[name].grad == 0).all(), name
    # The backward pass gets alpha T back as alpha T (1 - alpha) / (1 - alpha): on CUDA with a division to 2 ulp.
    slack = 0 if device == "cpu" else 3 * torch.finfo(best).eps
    assert (ours["colors_precomp"].grad - cap).abs().max() <= slack


@each_kind
def test_near_plane(device, best, variant):
    """z <= 0.2 is culled, z just beyond is not, whatever it covers."""
    camera = Camera().facing_z()
    depths = torch.tensor([-1.0, 1e-3, 0.199, 0.2, 0.201], dtype=torch.float64)
    count = len(depths)
    g = torch.Generator().manual_seed(0)
    means = torch.tensor([22.0, 18.0]) + scenes.rand(g, count, 2, low=-9.0, high=9.0)
    cov2d = scenes.random_cov2d(g, count, (2.0, 5.0), (1.0, 2.0))
    opacities = torch.full((count,), 0.5, dtype=torch.float64)
    scene = scenes.splat_scene(camera, means, cov2d, opacities, depths)
    if best == torch.float64:
        expected = compare(camera, scene, variant, device, best)
        assert expected.radii.tolist()[:4] == [0] * 4
    else:  # 0.2 in float32 is beyond 0.2
        compare(camera, {name: value[[0, 1, 2, 4]] for name, value in scene.items()}, variant, device, best)
    scene = scenes.cast(scene, best, device)
    assert render(camera, scene, variant)[1].tolist()[:4] == [0] * 4
    last = {name: value[4:] for name, value in scene.items()}
    assert torch.equal(render(camera, scene, variant)[0], render(camera, last, variant)[0])


# --- gradcheck ---------------------------------------------------------------------------------


@pytest.mark.parametrize("variant", [v for v in RENDERED if v[1].get("frame_gradient") != "frozen"], ids=name_of)
@pytest.mark.parametrize("precomputed", [False, True], ids=["scales-sh", "precomputed"])
def test_gradcheck(variant, precomputed):
    """Finite differences of the whole rasterizer, in a scene that no threshold touches.

    means2D is left out: its value is ignored by definition, so its gradient is no derivative (it is
    compared with the reference above). Step 1e-6 against the margin asserted below.
    """
    camera = Camera(image_width=19, image_height=17, sh_degree=1, shift=(1.2, -0.7))
    scene = scenes.smooth_scene(40, degree=1)
    scene["shs"] = scene["shs"] * 0.3  # colours away from the clamp at zero
    if precomputed:
        scene = scenes.with_precomputed(scene)
    assert render_reference(camera, scene, variant).margin > 1e-2
    del scene["means2D"]
    weights = probe(camera)

    def loss(*values):
        inputs = dict(zip(scene, values, strict=True), means2D=None)
        return (render(camera, inputs, variant)[0] * weights).sum()

    leaves = tuple(scenes.leaves(scene).values())
    # Noise of the difference quotient: 1e-16 * |loss| (~100) / 1e-6.
    assert torch.autograd.gradcheck(loss, leaves, eps=1e-6, atol=1e-6, rtol=1e-6)


def test_gradcheck_of_the_frozen_default_where_it_is_a_derivative():
    """Opacity, colour: `frozen` differs from `paper` only in how Sigma turns."""
    camera = Camera(image_width=19, image_height=17)
    scene = scenes.smooth_scene(41)
    fixed = {name: scene.pop(name) for name in ("means3D", "scales", "rotations", "means2D")}

    def loss(opacities, shs):
        inputs = fixed | {"opacities": opacities, "shs": shs}
        return (render(camera, inputs, ("analytic", {}))[0] * probe(camera)).sum()

    leaves = scenes.leaves(scene)
    assert torch.autograd.gradcheck(loss, (leaves["opacities"], leaves["shs"]), atol=1e-6)


# --- one footprint through another -------------------------------------------------------------


@pytest.mark.parametrize("samples", [1, 4, 16])
def test_box_is_the_average_of_shifted_renders(device, best, samples):
    """S renders with `mip` of variance 1/(12 S^2), the principal point moved by each node.

    A sample at pixel + n sees the splat at offset d + n, as the pixel does when every splat moves
    by -n. Image, and gradients of all inputs (of means2D too: both divide by the same image size).
    """
    camera = Camera(bg=(0.3, 0.1, 0.8), shift=(1.7, -2.2), sh_degree=2)
    scene = hard_scene(14, degree=2)
    box = ("box", {"samples": samples})
    clear = torch.ones(camera.image_height, camera.image_width, dtype=torch.bool)
    if best == torch.float32:
        rounded = scenes.cast(scenes.cast(scene, best), torch.float64)
        clear = render_reference(camera, rounded, box, best).pixel_margin > MARGIN[best]
    scene, clear = scenes.cast(scene, best, device), clear.to(device)
    weights = probe(camera).to(device, best) * clear
    ours = scenes.leaves(scene)
    color, _ = render(camera, ours, box)
    (color * weights).sum().backward()

    theirs = scenes.leaves(scene)
    mip = ("mip", {"variance": reference.box_variance(samples)})
    renders = [render(camera.shifted(-x, -y), theirs, mip)[0] for x, y in reference.box_nodes(samples).tolist()]
    average = torch.stack(renders).mean(0)
    (average * weights).sum().backward()
    # 60 additions of numbers below 1 on either side, plus 1e-15 px of projection rounding.
    image, gradient = (1e-12, 1e-10) if best == torch.float64 else (IMAGE_TOLERANCE[best], GRADIENT_TOLERANCE[best])
    assert (color - average)[:, clear].abs().max() < image
    for name in scene:
        assert relative_error(ours[name].grad, theirs[name].grad) < gradient, name


@each_kind
def test_depth_order_not_input_order(device, best, variant):
    """Shuffled input, same image and shuffled gradients, up to the order of additions."""
    scene = scenes.cast(scenes.random_scene(42, 30), best, device)
    order = torch.randperm(30, generator=torch.Generator().manual_seed(0))
    shuffled = {name: value[order] for name, value in scene.items()}
    ours, theirs = scenes.leaves(scene), scenes.leaves(shuffled)
    loss = probe(Camera()).to(device, best)
    color, radii = render(Camera(), ours, variant)
    other, other_radii = render(Camera(), theirs, variant)
    assert torch.equal(color, other)
    assert torch.equal(radii[order], other_radii)
    (color * loss).sum().backward()
    (other * loss).sum().backward()
    for name in scene:
        assert relative_error(ours[name].grad[order], theirs[name].grad) < 450 * torch.finfo(best).eps, name


def test_equal_depths_keep_input_order(device, best):
    camera = Camera(image_height=1, image_width=1).facing_z()
    scene = scenes.splat_scene(camera, [[0.0, 0.0]] * 3, [25.0, 0, 25.0], [0.5] * 3, [2.0] * 3, torch.eye(3).double())
    color, _ = render(camera, scenes.cast(scene, best, device), ("point", {}))
    expected = torch.tensor([0.5, 0.25, 0.125]).double()
    assert (color[:, 0, 0].cpu() - expected).abs().max() < 4.5 * torch.finfo(best).eps


# --- float32 -----------------------------------------------------------------------------------


@every_footprint
def test_float32_image(device, variant):
    """Float32 against float64 of the same float32 numbers; pixels at a threshold counted apart.

    Budget, unit roundoff 6e-8: a position is rounded four times at 45 px, 1.1e-5 px, where a splat
    of deviation 0.47 px (0.05 units at 9.4 px per unit, the smallest) changes by 0.6/0.47 per px:
    1.4e-5. The 3D scales span a factor of 10, so cond(Sigma) <= 100 and the exponent errs by 8 *
    6e-8 * 100, the weight by 0.37 of that: 1.8e-5. Together 3.2e-5, times colours below 2.
    """
    camera = Camera(bg=(0.2, 0.5, 0.9))
    scene = scenes.random_scene(50, 40, sigma=(0.05, 0.5))
    single = scenes.cast(scene, torch.float32, device)
    color, radii = (value.cpu() for value in render(camera, single, variant))
    assert color.dtype == torch.float32
    # The matrices are the same float32 numbers too.
    expected = render_reference(camera, scenes.cast(single, torch.float64), variant, torch.float32)
    footprint, options = variant
    clear = expected.pixel_margin > 1e-3
    error = (color - expected.color).abs().amax(0)
    print(name_of(variant), f"max {error[clear].max():.1e}, {(~clear).sum()} pixels at a threshold")
    assert error[clear].max() < 2 * 3.2e-5
    assert (~clear).float().mean() < 0.1
    # A flipped alpha is 1/255 of a colour; a flipped stop loses what was left, 1e-4.
    assert error.max() < 2 * 2 / 255
    size = reference.three_sigma(expected.projection.cov2d, footprint, **options)
    decided = ((size - size.round()).abs() > 1e-3) & (expected.radii > 0)
    assert torch.equal(radii[decided], expected.radii[decided])


@every_footprint
def test_float32_gradients(device, variant):
    """In a scene that no threshold touches. Well-conditioned splats: 64 eps cond (9) ~ 1e-4."""
    camera = Camera(image_width=33, image_height=21, sh_degree=1)
    scene = scenes.smooth_scene(51, degree=1)
    scene["shs"] = scene["shs"] * 0.3
    assert render_reference(camera, scene, variant).margin > 1e-2
    grads = []
    for dtype, where in ((torch.float32, device), (torch.float64, "cpu")):
        ours = scenes.leaves(scenes.cast(scenes.cast(scene, torch.float32), dtype, where))
        color, _ = render(camera, ours, variant)
        (color * probe(camera).to(color)).sum().backward()
        grads.append({name: value.grad.double().cpu() for name, value in ours.items()})
    errors = {name: relative_error(grads[0][name], grads[1][name]) for name in scene}
    print(name_of(variant), {name: f"{error:.1e}" for name, error in errors.items()})
    for name, error in errors.items():
        assert error < 64 * torch.finfo(torch.float32).eps * 9, (name, error)


@pytest.mark.parametrize("ratio", [100, 1000])
@each_kind
def test_needles_float32(device, variant, ratio):
    """One needle of `ratio` with the area of a pixel-sized splat, in float32 against float64.

    The numerics notes state 2e-6 for the weight and 9e-3 for the gradient of the shape of the
    cumulant and its kin, whose amplitude avoids det and Sigma^-1. `analytic` divides by the small
    deviation in a frame that is known to eps * ratio: its shape gradient errs by eps * ratio^2, and
    so do those of `erf` and `exact`, which divide by the small deviation too.
    """
    camera = Camera(image_width=64, image_height=48, tanfovx=0.5, tanfovy=0.4)
    footprint, _ = variant
    settings = exact_settings(camera, torch.float32, variant)
    long = ratio**0.5
    drawn = 0
    for seed in range(6):
        scene = scenes.random_scene(seed, 1, spread=0.3)
        # 16 px per unit at the centre of the scene.
        scene["scales"] = torch.tensor([[long, 1 / long, 1 / long]], dtype=torch.float64) / 16
        scene["opacities"][:], scene["shs"][:] = 0.9, 1.0
        single, double = both_leaves(scene, torch.float32, device)
        color = render(camera, single, variant)[0].cpu()
        expected, _ = ar.GaussianRasterizer(settings)(**double)
        # A threshold crossed by rounding is 1/255 and no matter of precision.
        if ((color > 0) != (expected > 0)).any() or not (expected > 0).any():
            continue
        drawn += 1
        # Beside the weight's 2e-6: 4 roundings of 64 px at a slope of 0.6/0.29 per px and peak.
        assert (color - expected).abs().max() < 2e-6 + 3.2e-5 * expected.max()
        loss = probe(camera)
        (color * loss.float()).sum().backward()
        (expected * loss).sum().backward()
        limit = 9e-3
        if footprint in ("analytic", "erf", "exact"):
            limit = max(limit, torch.finfo(torch.float32).eps * ratio**2)
        for name in scene:
            error = relative_error(single[name].grad, double[name].grad)
            assert error < limit, (seed, name, error)
    assert drawn >= 4


# --- a trained scene (optional) ----------------------------------------------------------------


@pytest.mark.parametrize("variant", [("analytic", {}), ("box", {"samples": 4})], ids=name_of)
def test_trained_scene(plant, variant):
    """1500 Gaussians of a trained plant, 48x27 px: real scales, opacities and SH, float64."""
    inputs, (view, *_) = plant
    g = torch.Generator().manual_seed(0)
    chosen = torch.randperm(len(inputs["means3D"]), generator=g)[:1500]
    scene = {name: value[chosen].double() for name, value in inputs.items()}
    scene["scales"] = scene["scales"] * 4  # fewer Gaussians, so larger ones
    settings = scenes.of_view(view, variant, size=(48, 27))
    color, _ = ar.GaussianRasterizer(settings)(**scene)
    expected = reference_of(settings, scene, variant)
    clear = expected.pixel_margin > 1e-10
    assert clear.float().mean() > 0.99
    error = (color - expected.color).abs().amax(0)[clear].max()
    print(f"trained scene, {name_of(variant)}: {error:.1e}")
    assert error < IMAGE_TOLERANCE[torch.float64]
    assert math.isfinite(error)
