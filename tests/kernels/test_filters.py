"""The 3D smoothing filter."""

import math

import pytest
import scenes
import torch
from marks import each_precision
from scenes import Camera, ParallelCamera
from threads import same_on_threads

import analytic_rasterizer as ar
from analytic_rasterizer import filters
from analytic_rasterizer.cameras.rotations import rotation_matrices

F64 = torch.float64


def camera(distance, size=(64, 48), tan=0.5):
    """Settings of a camera on the z axis that looks at the origin."""
    angles = {"tanfovx": tan, "tanfovy": tan * size[1] / size[0]}
    return Camera(image_width=size[0], image_height=size[1], eye=(0, 0, -distance), **angles).settings(F64)


def test_filter_is_the_finest_interval_of_the_cameras_that_see_a_point():
    points = torch.tensor([[0.0, 0, 0], [0, 0, 4.0], [100.0, 0, 0]], dtype=F64)
    near, far = camera(8), camera(20, size=(640, 480))
    focal = {"near": 64 / (2 * 0.5), "far": 640 / (2 * 0.5)}
    intervals = torch.tensor([min(8 / focal["near"], 20 / focal["far"]), min(12 / focal["near"], 24 / focal["far"])])
    both = ar.compute_3d_filter(points, [near, far])
    assert torch.allclose(both[:2], intervals.to(F64) * math.sqrt(0.2))
    assert both[2] == both[:2].max()  # seen by none
    alone = ar.compute_3d_filter(points, [near])
    assert torch.allclose(alone[:2], torch.tensor([8, 12], dtype=F64) / focal["near"] * math.sqrt(0.2))


def test_points_behind_and_beside_a_camera_do_not_count():
    front, behind = [0.0, 0, 0], [0, 0, -9.0]
    right = camera(8).viewmatrix[:3, 0]  # the camera is tilted
    edge = 8 * 0.5 * 1.29 * right  # within the margin of 15% of the width on either side
    beside = 8 * 0.5 * 1.32 * right
    points = torch.stack([torch.tensor(front, dtype=F64), torch.tensor(behind, dtype=F64), edge, beside])
    wide = camera(80)  # sees all of them, coarsely
    filters = ar.compute_3d_filter(points, [camera(8), wide])
    fine, coarse = 8 / 64 * math.sqrt(0.2), 80 / 64 * math.sqrt(0.2)
    assert torch.allclose(filters, torch.tensor([fine, 71 / 64 * math.sqrt(0.2), fine, coarse], dtype=F64))


def test_a_view_may_scale():
    """Twice as large camera coordinates make the same picture, and sample the world at the same intervals."""
    points = torch.randn(20, 3, dtype=F64, generator=torch.Generator().manual_seed(0))
    settings = camera(8)
    larger = torch.diag(torch.tensor([2.0, 2, 2, 1], dtype=F64))  # of row vectors, behind the view
    perspective = torch.linalg.inv(settings.viewmatrix) @ settings.projmatrix
    scaled = settings._replace(viewmatrix=settings.viewmatrix @ larger)
    scaled = scaled._replace(projmatrix=scaled.viewmatrix @ perspective)
    expected = ar.compute_3d_filter(points, [settings])
    assert expected.unique().numel() > 10
    assert torch.allclose(ar.compute_3d_filter(points, [scaled]), expected)


def test_filtered_gaussians_keep_their_mass_and_gain_variance():
    scene = scenes.random_scene(1, 50)
    width = torch.rand(50, dtype=F64) * 0.2
    scales, opacities = ar.apply_3d_filter(scene["scales"], scene["opacities"], width)
    assert torch.allclose(scales**2, scene["scales"] ** 2 + width[:, None] ** 2)
    assert torch.allclose(opacities[:, 0] * scales.prod(1), scene["opacities"][:, 0] * scene["scales"].prod(1))
    same = ar.apply_3d_filter(scene["scales"], scene["opacities"], torch.zeros(50, dtype=F64))
    assert torch.equal(same[0], scene["scales"]) and torch.equal(same[1], scene["opacities"])


def test_gradients_are_right_and_finite_where_scales_vanish():
    scene = scenes.random_scene(2, 6)
    width = torch.tensor([0.1, 0, 0.3, 1e-6, 0, 2.0], dtype=F64)
    inputs = (scene["scales"].clone().requires_grad_(), scene["opacities"].clone().requires_grad_())
    assert torch.autograd.gradcheck(lambda s, o: ar.apply_3d_filter(s, o, width), inputs)
    scales = torch.zeros(6, 3, requires_grad=True)
    opacities = torch.full((6,), 0.5, requires_grad=True)
    width[3] = 1e-40  # which has no inverse in float32
    filtered, faded = ar.apply_3d_filter(scales, opacities, width.float())
    (filtered.sum() + faded.sum()).backward()
    assert scales.grad.isfinite().all() and opacities.grad.isfinite().all()
    assert (filtered[0] == 0.1).all() and faded[0] == 0


def by_formula(scales, opacities, width):
    """[Mip-Splatting, Eq. 9] of torch's functions, for scales and widths above 0, without differences in gradients."""
    share = torch.rsqrt(1 + (width[:, None] / scales) ** 2).prod(1)
    return torch.hypot(scales, width[:, None]), opacities * share.reshape(opacities.shape)


def filter_inputs(count, flat=False):
    """Of sizes from 1e-3 to 1e3; and weights of the results in a loss."""
    generator = torch.Generator().manual_seed(5)
    scales, width = (10 ** (6 * torch.rand(count, n, generator=generator, dtype=F64) - 3) for n in (3, 1))
    opacities = torch.rand(count, 1, generator=generator, dtype=F64)
    weights = [torch.randn(t.shape, generator=generator, dtype=F64) for t in (scales, opacities)]
    columns = [t[:, 0] if flat else t for t in (opacities, weights[1])]
    return [scales, columns[0], width[:, 0]], [weights[0], columns[1]]


@each_precision
@pytest.mark.parametrize("count, flat", [(0, False), (1, True), (10_000, False)])
def test_values_and_gradients_are_those_of_the_formula(device, dtype, count, flat):
    given, weights = filter_inputs(count, flat)
    given, weights = ([t.to(dtype).double() for t in tensors] for tensors in (given, weights))
    made = []
    for function, where, precision in ((by_formula, "cpu", F64), (ar.apply_3d_filter, device, dtype)):
        leaves = [t.to(where, precision).requires_grad_() for t in given]
        results = function(*leaves)
        total = sum((r * w.to(where, precision)).sum() for r, w in zip(results, weights))
        made.append([t.detach().double().cpu() for t in (*results, *torch.autograd.grad(total, leaves))])
    scales, opacities, width = given[0], given[1].reshape(-1), given[2]
    by_scales, by_opacity = weights[0].abs(), weights[1].abs().reshape(-1)
    filtered = torch.hypot(scales, width[:, None])
    shares, of_width = scales / filtered, width[:, None] / filtered
    share = shares.prod(1)
    # What the gradients add up, as absolute values.
    by_share = (by_opacity * opacities * share)[:, None] / shares / filtered
    terms = [by_scales * shares + by_share * of_width**2, by_opacity * share]
    terms.append((by_scales * of_width + by_share * shares * of_width).sum(1))
    # hypot within 3 ulp and a division are 7 roundings of each axis' share; a product has at most 7 such factors. The
    # formula in float64 has no more.
    sizes = [(8, filtered), (24, opacities * share), (64, terms[0]), (32, terms[1]), (64, terms[2])]
    u = torch.finfo(dtype).eps / 2
    for expected, found, (roundings, size) in zip(*made, sizes, strict=True):
        assert ((found - expected).abs() <= 2 * roundings * u * size.reshape(expected.shape)).all()


def test_threads_change_no_bit_of_a_filter():
    given = [t.float() for t in filter_inputs(20_000)[0]]
    same_on_threads(lambda: ar.apply_3d_filter(*given))


def test_opcheck(device):
    given, weights = ([t.float().to(device) for t in tensors] for tensors in filter_inputs(6))
    ops = torch.ops.analytic_rasterizer
    torch.library.opcheck(ops.apply_3d_filter.default, tuple(t.clone().requires_grad_() for t in given))
    torch.library.opcheck(ops.apply_3d_filter_vjp.default, (weights, *given, [], [True, True, True]))
    torch.library.opcheck(ops.apply_3d_filter_vjp.default, ([weights[0], None], *given, [], [True, False, False]))


@pytest.mark.parametrize("wrong", [math.nan, -0.1])
def test_a_gaussian_whose_filter_makes_no_sense_is_culled(wrong, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # for the file that debug leaves
    scene = scenes.without(scenes.random_scene(1, 20), "means2D")
    width = torch.full((20,), 0.05, dtype=F64)
    width[3] = wrong
    settings = scenes.Camera().settings(F64, "cpu")
    filtered = settings._replace(effects=ar.Effects(filter_3d=width))
    color, radii = ar.GaussianRasterizer(filtered)(means2D=None, **scene)
    assert radii[3] == 0 and color.isfinite().all()
    others = [k for k in range(20) if k != 3]
    without = settings._replace(effects=ar.Effects(filter_3d=width[others]))
    expected, _ = ar.GaussianRasterizer(without)(means2D=None, **{name: v[others] for name, v in scene.items()})
    # torch rounds the same number differently at other places of a tensor, by a few of 1.1e-16.
    assert torch.allclose(color, expected, rtol=0, atol=1e-13)
    with pytest.raises(ValueError, match="must be finite, got nan at"):
        ar.GaussianRasterizer(filtered._replace(debug=True))(means2D=None, **scene)


def test_filter_removes_what_only_a_finer_camera_could_show():
    """From twice as near a filtered splat is as wide as the training view could tell."""
    point = torch.zeros(1, 3, dtype=F64)
    width = ar.compute_3d_filter(point, [camera(8)])
    scales, opacities = ar.apply_3d_filter(torch.full((1, 3), 1e-4, dtype=F64), torch.ones(1, 1, dtype=F64), width)
    pixels = scales[0, 0] / (8 / 64)
    assert abs(pixels - math.sqrt(0.2)) < 1e-3 and opacities < 1e-6


@pytest.mark.parametrize("bake", [None, ar.bake_pixel, ar.bake_dilation])
def test_autocast_rounds_nothing(bake):
    """Under autocast matrix products have 8 bits: which points a camera sees must not be found with them."""
    generator = torch.Generator().manual_seed(1)
    settings = Camera(eye=(0, 0, -8)).settings(torch.float32)
    means = torch.rand(4000, 3, generator=generator) * 16 - 8  # on both sides of every border of the picture
    scales, rotations = torch.rand(4000, 3, generator=generator), torch.randn(4000, 4, generator=generator)
    opacities = torch.rand(4000, 1, generator=generator)

    def made():
        if bake:
            return bake(means, scales, rotations, opacities, [settings])
        return [filters.sampling_interval(means, settings)]

    expected = made()
    assert 400 < filters.sampling_interval(means, settings).isfinite().sum() < 3600
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert all(map(torch.equal, made(), expected))


def test_errors():
    with pytest.raises(ValueError, match=r"cameras must hold .* got none"):
        ar.compute_3d_filter(torch.zeros(2, 3), [])
    with pytest.raises(ValueError, match=r"means3D must have shape \(P, 3\), got \(2, 2\)"):
        ar.compute_3d_filter(torch.zeros(2, 2), [camera(8)])
    with pytest.raises(ValueError, match=r"filter_3d \(P,\), got \(2, 3\) and \(3,\)"):
        ar.apply_3d_filter(torch.ones(2, 3), torch.ones(2, 1), torch.ones(3))
    with pytest.raises(ValueError, match=r"opacities must have shape \(P, 1\) or \(P,\), got \(3, 1\)"):
        ar.apply_3d_filter(torch.ones(2, 3), torch.ones(3, 1), torch.ones(2))
    with pytest.raises(ValueError, match=r"opacities must have shape \(P, 1\) or \(P,\), got \(2, 3\)"):
        ar.apply_3d_filter(torch.ones(6, 3), torch.ones(2, 3), torch.ones(6))
    with pytest.raises(TypeError, match=r"filter_3d must have the dtype of scales, torch.float32, got torch.float64"):
        ar.apply_3d_filter(torch.ones(2, 3), torch.ones(2), torch.ones(2).double())
    with pytest.raises(TypeError, match=r"scales must be a tensor, got list"):
        ar.apply_3d_filter([1.0], torch.ones(2), torch.ones(2))
    with pytest.raises(TypeError, match=r"means3D must be a tensor, got list"):
        ar.compute_3d_filter([1.0], [camera(8)])
    with pytest.raises(TypeError, match=r"cameras must be a sequence .*, got those of one view"):
        ar.compute_3d_filter(torch.zeros(2, 3), camera(8))
    with pytest.raises(TypeError, match=r"cameras must hold GaussianRasterizationSettings, got str"):
        ar.compute_3d_filter(torch.zeros(2, 3), ["view"])
    with pytest.raises(ValueError, match=r"variance must be finite and not negative, got -1"):
        ar.compute_3d_filter(torch.zeros(2, 3), [camera(8)], variance=-1)


def test_cameras_may_be_an_iterator():
    """bake_pixel goes through them twice."""
    generator = torch.Generator().manual_seed(1)
    means, scales, rotations = (torch.rand(5, n, generator=generator, dtype=F64) for n in (3, 3, 4))
    gaussians = means, scales, rotations, torch.ones(5, 1, dtype=F64)
    expected = ar.bake_pixel(*gaussians, [camera(8), camera(3)])
    assert (expected[0] > scales).all()
    assert all(map(torch.equal, ar.bake_pixel(*gaussians, map(camera, (8, 3))), expected))


def test_a_baked_pixel_widens_by_its_variance_and_keeps_what_the_camera_sees():
    """Against projections made with explicit bases of the plane across the line of sight."""
    scene, view = scenes.random_scene(3, 40), camera(8)
    rotations = torch.nn.functional.normalize(scene["rotations"], dim=1)
    scene["scales"][0] = torch.tensor([0.0, 0.1, 0.2])  # flat
    scales, opacities = ar.bake_pixel(scene["means3D"], scene["scales"], rotations, scene["opacities"], [view])
    width = ar.compute_3d_filter(scene["means3D"], [view], 1 / 12)
    seen = filters.sampling_interval(scene["means3D"], view).isfinite()
    assert seen.sum() > 20
    assert torch.allclose(scales[seen] ** 2, (scene["scales"] ** 2 + width[:, None] ** 2)[seen])
    sight = scene["means3D"] - view.campos
    masses = []
    for sizes, opacity in ((scene["scales"], scene["opacities"]), (scales, opacities)):
        shaped = rotation_matrices(rotations) * sizes[:, None]
        across = torch.linalg.svd(sight[:, None])[2][:, 1:]  # (P, 2, 3) orthonormal, across the line of sight
        flat = across @ shaped @ shaped.mT @ across.mT
        masses.append(opacity[:, 0] * torch.linalg.det(flat).clamp_min(0).sqrt())
    assert torch.allclose(masses[0][seen], masses[1][seen], rtol=1e-6, atol=1e-12)


def test_a_baked_pixel_averages_over_the_cameras_that_see_a_gaussian():
    means, rotations = torch.tensor([[0.0, 0, 0], [1e4, 0, 0]], dtype=F64), torch.tensor([[1.0, 0, 0, 0]] * 2).to(F64)
    scales, opacities = torch.full((2, 3), 0.05, dtype=F64), torch.tensor([0.8, 0.7], dtype=F64)
    near, far = camera(8), camera(16)
    baked, faded = ar.bake_pixel(means, scales, rotations, opacities, [near, far])
    variance = (8 / 64) ** 2 / 12  # of the nearer one, for a ball the same from all sides
    assert torch.allclose(baked[0] ** 2, torch.tensor(0.05**2 + variance, dtype=F64))
    assert faded[0].item() == pytest.approx(0.8 * 0.05**2 / (0.05**2 + variance))
    assert torch.equal(baked[1], scales[1]) and faded[1] == opacities[1]  # seen by none
    # A stick, seen by one camera along its axis and by one of the same distance across it.
    stick = torch.tensor([[0.02, 0.02, 0.5]] * 2, dtype=F64)
    size = {"image_width": 64, "image_height": 48, "tanfovx": 0.5, "tanfovy": 0.375}
    along, across = (Camera(**size, eye=eye).settings(F64) for eye in ((0, 0, -8), (8, 0, 0)))
    kept = [ar.bake_pixel(means, stick, rotations, opacities, views)[1][0] for views in ([along], [across])]
    short, long = (length**2 / (length**2 + variance) for length in (0.02, 0.5))
    assert kept[0].item() == pytest.approx(0.8 * short)
    assert kept[1].item() == pytest.approx(0.8 * math.sqrt(short * long))
    both = ar.bake_pixel(means, stick, rotations, opacities, [along, across])[1][0]
    assert both.item() == pytest.approx(sum(kept).item() / 2)
    none = ar.bake_pixel(*(t[:0] for t in (means, scales, rotations, opacities)), [near])
    assert [tuple(t.shape) for t in none] == [(0, 3), (0,)]


@pytest.mark.parametrize("orthographic", [False, True])
def test_matrices_with_a_leading_dimension_bake_the_same(orthographic):
    scene = scenes.random_scene(3, 40)
    kind, tangents = (ParallelCamera, {"tanfovx": 4.0, "tanfovy": 3.0}) if orthographic else (Camera, {})
    view = kind(eye=(0, 0, -8), **tangents).settings(F64)._replace(effects=ar.Effects(orthographic=orthographic))
    batched = view._replace(viewmatrix=view.viewmatrix[None], projmatrix=view.projmatrix[None])
    inputs = [scene[name] for name in ("means3D", "scales", "rotations", "opacities")]
    one, other = (ar.bake_pixel(*inputs, [camera]) for camera in (view, batched))
    assert not torch.equal(one[0], inputs[1])
    assert torch.equal(one[0], other[0]) and torch.equal(one[1], other[1])


@pytest.mark.parametrize("bake", [ar.bake_pixel, ar.bake_dilation])
def test_bad_arguments_are_refused_before_baking(bake):
    means, scales, rotations, opacities = torch.zeros(2, 3), torch.ones(2, 3), torch.ones(2, 4), torch.ones(2, 1)
    with pytest.raises(ValueError, match="cameras must hold"):
        bake(means, scales, rotations, opacities, [])
    with pytest.raises(TypeError, match="rotations must be a tensor, got list"):
        bake(means, scales, [1.0], opacities, [camera(8)])
    for bad, message in (
        ((means[:, :2], scales, rotations, opacities), "means3D must have shape"),
        ((means, scales[:1], rotations, opacities), "scales must have shape"),
        ((means, scales, rotations[:, :3], opacities), "rotations must have shape"),
        ((means, scales, rotations, opacities[:1]), "opacities must have shape"),
    ):
        with pytest.raises(ValueError, match=message):
            bake(*bad, [camera(8)])


def test_a_baked_dilation_keeps_the_variance_and_the_mass_that_point_showed():
    """A splat on the optical axis, whose projection is that of the covariance over the square of the interval."""
    settings = camera(8)
    interval = 8 / 64
    means, rotations = torch.zeros(1, 3, dtype=F64), torch.tensor([[1.0, 0, 0, 0]], dtype=F64)
    scales, opacities = torch.tensor([[0.05, 0.1, 0.2]], dtype=F64), torch.tensor([[0.3]], dtype=F64)
    for dilation in (0.3, 0.5, 1 / 12):
        widened, stronger = ar.bake_dilation(means, scales, rotations, opacities, [settings], dilation)
        in_pixels = (scales[0, :2] / interval) ** 2
        assert torch.allclose((widened[0, :2] / interval) ** 2 + 1 / 12, in_pixels + dilation)
        # `box` and `moment` have the mass opacity * area; `point` has that of the dilated area.
        mass = opacities * (in_pixels + dilation).prod().sqrt()
        assert torch.allclose(stronger * (widened[0, :2] / interval).prod(), mass)
    assert torch.allclose(widened, scales) and stronger > opacities  # the pixel itself is as wide as that dilation


def test_a_baked_dilation_takes_the_mean_density_of_samples():
    means, rotations = torch.tensor([[0.0, 0, 0], [1e4, 0, 0]], dtype=F64), torch.tensor([[1.0, 0, 0, 0]] * 2).to(F64)
    scales, opacities = torch.full((2, 3), 0.05, dtype=F64), torch.tensor([0.5, 0.7], dtype=F64)
    widened, stronger = ar.bake_dilation(means, scales, rotations, opacities, map(camera, (8, 16)))
    square = 1 / ((64 / 8) ** 2 / 2 + (64 / 16) ** 2 / 2)  # of the interval
    assert torch.allclose(widened[0] ** 2, 0.05**2 + (0.3 - 1 / 12) * torch.full((3,), square, dtype=F64))
    share = (0.05**2 + 0.3 * square) / (0.05**2 + (0.3 - 1 / 12) * square)
    assert stronger[0].item() == pytest.approx(0.5 * share)
    assert torch.equal(widened[1], scales[1]) and stronger[1] == opacities[1]  # seen by none
    opaque = torch.tensor([0.9, 0.7], dtype=F64)  # times 1.22
    assert ar.bake_dilation(means, scales, rotations, opaque, [camera(8)])[1][0] == 1
    flat = torch.tensor([[0.0, 0.1, 0], [0.1, 0.1, 0.1]], dtype=F64)
    for opacity in (0.5, 0.0):
        _, found = ar.bake_dilation(means, flat, rotations, torch.full((2,), opacity, dtype=F64), [camera(8)], 1 / 12)
        assert found[0] == (opacity > 0)  # the factor is infinite


def test_a_baked_dilation_shows_with_moment_what_point_showed():
    """At the resolution of the camera the pictures agree far better than without; at a quarter of it `moment` shows the
    mean of what `point` showed, which `point` itself does not."""
    scene = scenes.random_scene(3, 300)
    scene["opacities"] = scene["opacities"] * 0.3
    scene["scales"] = scene["scales"] * 0.2

    def picture(footprint, gaussians, scale=1):
        settings = camera(8)._replace(image_width=64 // scale, image_height=48 // scale, footprint=footprint)
        return ar.GaussianRasterizer(settings)(**gaussians)[0]

    shown = picture("point", scene)
    rotations = torch.nn.functional.normalize(scene["rotations"], dim=1)
    scales, opacities = ar.bake_dilation(scene["means3D"], scene["scales"], rotations, scene["opacities"], [camera(8)])
    baked = scene | {"scales": scales, "opacities": opacities}

    def error(image, truth):
        return (image - truth).square().mean().sqrt().item()

    assert error(picture("moment:samples=4", baked), shown) < 0.2 * error(picture("moment:samples=4", scene), shown)
    mean = torch.nn.functional.avg_pool2d(shown[None], 4)[0]
    coarse = error(picture("moment:samples=4", baked, 4), mean)
    assert coarse < 0.2 * error(picture("point", scene, 4), mean)
    assert coarse < 0.2 * error(picture("moment:samples=4", scene, 4), mean)


@pytest.mark.parametrize("dilation", [0.05, math.inf, math.nan])
def test_bad_dilations_are_refused(dilation):
    means, scales, rotations, opacities = torch.zeros(2, 3), torch.ones(2, 3), torch.ones(2, 4), torch.ones(2, 1)
    with pytest.raises(ValueError, match="dilation must be finite and at least 1/12"):
        ar.bake_dilation(means, scales, rotations, opacities, [camera(8)], dilation)
