"""What gsplat 1.6 added to its call, and lenses: against formulas in torch, and against compositions of plain calls."""

import inspect
import math

import pytest
import scenes
import torch
from camera_reference import textbook
from gsplat_calls import (
    BOTH_LAYOUTS,
    HEIGHT,
    WIDTH,
    assert_gradients_close,
    cameras_of,
    composited,
    drop_in,
    gradients,
    projected,
    render,
    scene_of,
    smooth_call,
    step_once,
    tolerance,
    trained,
)
from marks import each_precision
from processes import run_python
from reference import spherical_harmonics
from weights import weighted_sums, weights

import analytic_rasterizer as ar
from analytic_rasterizer.dialects import gsplat as dialect
from analytic_rasterizer.dialects.gsplat import rasterization

# --- the signature -----------------------------------------------------------------------------------

SHARED = [
    "means", "quats", "scales", "opacities", "colors", "viewmats", "Ks", "width", "height", "near_plane", "far_plane",
    "radius_clip", "eps2d", "sh_degree", "packed", "tile_size", "backgrounds", "render_mode", "sparse_grad", "absgrad",
    "rasterize_mode", "channel_chunk", "distributed", "camera_model", "segmented", "covars", "with_ut", "with_eval3d",
]  # fmt: skip
OF_1_5_3 = [
    "radial_coeffs", "tangential_coeffs", "thin_prism_coeffs", "ftheta_coeffs", "rolling_shutter", "viewmats_rs",
]  # fmt: skip
OF_1_6 = [
    "return_normals", "global_z_order", "rays", "radial_coeffs", "tangential_coeffs", "thin_prism_coeffs",
    "ftheta_coeffs", "lidar_coeffs", "external_distortion_coeffs", "rolling_shutter", "viewmats_rs", "ut_params",
    "extra_signals", "extra_signals_sh_degree", "renderer_config",
]  # fmt: skip
MODES_OF_1_6 = ("RGB", "D", "ED", "RGB+D", "RGB+ED", "d", "Ed", "RGB-d", "RGB-Ed")


def test_names_are_those_of_both_versions():
    """Positions are those of 1.5.3, and of 1.6 up to with_eval3d; what 1.6 put in between is named."""
    parameters = inspect.signature(rasterization).parameters
    positional = [name for name, p in parameters.items() if p.kind is p.POSITIONAL_OR_KEYWORD]
    assert positional == SHARED + OF_1_5_3
    assert set(parameters) == {*SHARED, *OF_1_6, "footprint", "order"}
    defaults = {name: parameters[name].default for name in OF_1_6}
    assert defaults == {name: None for name in OF_1_6} | {"return_normals": False, "global_z_order": True}
    assert dialect.RENDER_MODES == MODES_OF_1_6


def test_a_position_of_1_6_is_no_coefficient_of_1_5_3():
    scene, cameras = scene_of(torch.float32, "cpu"), cameras_of(torch.float32, "cpu")
    given = scene | cameras | {"width": WIDTH, "height": HEIGHT}
    parameters = inspect.signature(rasterization).parameters
    values = [given.get(name, parameters[name].default) for name in SHARED]
    image = rasterization(*values)[0]
    assert torch.equal(image, render(scene, cameras)[0])
    with pytest.raises(TypeError, match="radial_coeffs must be a tensor, got bool"):
        rasterization(*values, False)  # return_normals in 1.6


def test_what_chooses_an_implementation_changes_nothing():
    scene, cameras = scene_of(torch.float32, "cpu"), cameras_of(torch.float32, "cpu")
    image = render(scene, cameras)[0]
    options = {"tile_size": None, "segmented": True, "channel_chunk": 2, "renderer_config": object()}
    for name, value in options.items():
        assert torch.equal(render(scene, cameras, **{name: value})[0], image)


@pytest.mark.parametrize(
    "asked",
    [
        {"with_ut": True},
        {"with_eval3d": True},
        {"rays": torch.zeros(2, HEIGHT, WIDTH, 6)},
        {"lidar_coeffs": object()},
        {"external_distortion_coeffs": object()},
        {"ut_params": object()},
        {"camera_model": "lidar"},
        {"camera_model": "fisheye", "with_eval3d": True, "with_ut": True},
        {"camera_model": "fisheye", "rolling_shutter": "ROLLING_LEFT_TO_RIGHT", "with_ut": True},
    ],
    ids=lambda asked: "-".join(asked),
)
def test_what_is_not_served_is_refused_by_name(asked):
    name = next(name for name in reversed(asked) if name != "with_ut" or len(asked) == 1)
    name = "with_eval3d" if "with_eval3d" in asked else name
    with pytest.raises(NotImplementedError, match=f"^{name} .*not supported: "):
        render(scene_of(torch.float32, "cpu"), cameras_of(torch.float32, "cpu"), **asked)


# --- lenses ------------------------------------------------------------------------------------------

PERSPECTIVE = ([0.1, -0.05, 0.02, 0.03, 0.02, -0.01], [0.01, -0.02], [0.01, 0.02, -0.01, 0.005])
FISHEYE = ([0.05, 0.01, -0.001, 0.0003], [0.01, -0.005], [0.004, 0.002, -0.003, 0.001])
NAMES = ("radial_coeffs", "tangential_coeffs", "thin_prism_coeffs")
LENSES = {  # camera_model, and which coefficients there are
    "radial": ("pinhole", (0,)),
    "tangential": ("pinhole", (1,)),
    "opencv": ("pinhole", (0, 1, 2)),
    "equidistant": ("fisheye", ()),
    "fisheye": ("fisheye", (0,)),
    "thin prism fisheye": ("fisheye", (0, 1, 2)),
}
each_lens = pytest.mark.parametrize("name", LENSES)


def coefficients_of(name, dtype, device, count=2):
    """Arguments of the call; the second camera has the other sign."""
    model, parts = LENSES[name]
    values = PERSPECTIVE if model == "pinhole" else FISHEYE
    signs = torch.tensor([1.0, -1.0, 0.5][:count], dtype=torch.float64)
    return {NAMES[i]: (signs[:, None] * torch.tensor(values[i]).double()).to(device, dtype) for i in parts}


def lenses_of(name, coefficients, count=2):
    """`ar.Lens` of each camera, through its own interface."""
    model, parts = LENSES[name]
    make = ar.Lens.perspective if model == "pinhole" else ar.Lens.fisheye
    given = [[coefficients[NAMES[i]][c].tolist() if i in parts else [] for i in range(3)] for c in range(count)]
    return [make(*of_camera) for of_camera in given]


def projected_by_formula(scene, cameras, lenses, eps2d=0.3, by_z=True):
    """What the formulas of OpenCV and COLMAP say of every Gaussian in every camera, in float64: the map of the mean,
    and its derivative by autograd. Radii are 1: whatever has an alpha counts."""
    made = {name: [] for name in ("means2d", "depths", "conics", "opacities", "radii")}
    R = torch.nn.functional.normalize(scene["quats"], dim=-1)
    covars, _ = dialect.quat_scale_to_covar_preci(R, scene["scales"])
    for view, K, lens in zip(cameras["viewmats"], cameras["Ks"], lenses):
        p = (scene["means"] @ view[:3, :3].T + view[:3, 3]).requires_grad_()
        pixels = textbook(lens, p) * torch.stack([K[0, 0], K[1, 1]]) + K[:2, 2]
        jacobian = torch.stack([torch.autograd.grad(pixels[:, i].sum(), p, retain_graph=True)[0] for i in (0, 1)], 1)
        jacobian = jacobian @ view[:3, :3]
        cov = jacobian @ covars @ jacobian.mT + eps2d * torch.eye(2, dtype=p.dtype)
        inverse = torch.linalg.inv(cov)
        made["means2d"].append(pixels.detach())
        made["depths"].append((p[:, 2] if by_z else p.norm(dim=1)).detach())
        made["conics"].append(torch.stack([inverse[:, 0, 0], inverse[:, 0, 1], inverse[:, 1, 1]], 1).detach())
        made["opacities"].append(scene["opacities"])
        made["radii"].append(torch.ones(len(p), 2, dtype=torch.int32))
    return {name: torch.stack(values) for name, values in made.items()}


@each_precision
@BOTH_LAYOUTS
@each_lens
@pytest.mark.parametrize("by_z", [True, False], ids=["z", "distance"])
def test_a_lens_is_that_of_the_formulas(device, dtype, packed, name, by_z):
    """Positions, covariances, depths, and the composited image; with_ut, which gsplat demands, changes nothing."""
    scene, cameras = scene_of(dtype, device), cameras_of(dtype, device)
    coefficients = coefficients_of(name, dtype, device)
    options = {"camera_model": LENSES[name][0], "global_z_order": by_z, "packed": packed}
    images, alphas, meta = render(scene, cameras, **coefficients, **options)
    double, views, given = ({k: v.cpu().double() for k, v in part.items()} for part in (scene, cameras, coefficients))
    rows = projected_by_formula(double, views, lenses_of(name, given), by_z=by_z)
    drawn = torch.zeros(rows["depths"].shape, dtype=torch.bool)
    if packed:
        drawn[meta["camera_ids"].cpu(), meta["gaussian_ids"].cpu()] = True
    else:
        drawn = (meta["radii"] > 0).all(-1).cpu()
    assert drawn.sum() > 0.7 * drawn.numel()
    close = {"rtol": 1e-9, "atol": 1e-9} if dtype == torch.float64 else {"rtol": 1e-3, "atol": 1e-4}
    for key in ("means2d", "depths", "conics"):
        actual = (meta[key] if packed else meta[key][drawn.to(device)]).cpu().double()
        torch.testing.assert_close(actual, rows[key][drawn], **close)
    expected, expected_alphas = composited(rows, double["colors"].expand(2, -1, -1))
    assert (images.cpu() - expected).abs().max() <= 2 * tolerance(dtype)
    assert (alphas.cpu() - expected_alphas).abs().max() <= tolerance(dtype)
    plain = render(scene, cameras, packed=packed)[0]
    assert (plain - images).abs().max() > 1e-3
    asked = render(scene, cameras, **coefficients, **options, with_ut=True)[0]
    assert torch.equal(asked, images)


@pytest.mark.parametrize("mode", dialect.RASTERIZE_MODES)
def test_a_fisheye_is_that_of_gsplats_reference(reference, mode):
    """Without coefficients, where gsplat does not clamp and neither does this inside the image."""
    scene, cameras = scene_of(torch.float64, "cpu", count=200), cameras_of(torch.float64, "cpu")
    expected = projected(reference, scene, cameras, mode, "fisheye")
    _, _, meta = render(scene, cameras, packed=False, camera_model="fisheye", rasterize_mode=mode)
    size = torch.tensor([WIDTH, HEIGHT])
    means2d = expected["means2d"]
    drawn = (meta["radii"] > 0).all(-1) & ((means2d > 0) & (means2d < size)).all(-1)
    assert drawn.sum() > 200
    # The reference adds 1e-7 to lengths and to z.
    for key in ("means2d", "depths", "conics", "opacities"):
        torch.testing.assert_close(meta[key][drawn], expected[key][drawn], rtol=1e-4, atol=1e-5)


@each_precision
@each_lens
def test_images_and_gradients_of_a_lens_are_the_rasterizers(device, dtype, name):
    """With harmonics, of every input and of the cameras; the rasterizer draws a fisheye by distance."""
    model, _ = LENSES[name]
    scene, cameras = scenes.leaves(scene_of(dtype, device, degree=1)), scenes.leaves(cameras_of(dtype, device))
    again, views = scenes.leaves(scene), scenes.leaves(cameras)
    coefficients = coefficients_of(name, dtype, device)
    options = {
        "sh_degree": 1,
        "footprint": "box:samples=4",
        "camera_model": model,
        "global_z_order": model == "pinhole",
    }
    images, _, _ = render(scene, cameras, **coefficients, **options)
    g = weights(images.shape, dtype, device)
    total = 0
    for camera, lens in enumerate(lenses_of(name, coefficients)):
        view, K = views["viewmats"][camera], views["Ks"][camera]
        color, _ = drop_in(again, view, K, 1, "box:samples=4", lens=lens)
        color = color.permute(1, 2, 0)
        assert (color - images[camera]).abs().max() <= 6 * tolerance(dtype)
        total = total + (color * g[camera]).sum()
    actual = gradients((images * g).sum(), scene | cameras)
    assert_gradients_close(actual, gradients(total, again | views), dtype)


@pytest.mark.parametrize(
    "name, by_z, mode",
    [("opencv", True, "RGB-d"), ("thin prism fisheye", True, "RGB+D"), ("thin prism fisheye", False, "RGB+D")],
)
def test_gradcheck_of_lenses(name, by_z, mode):
    """Of everything, the coefficients included, and through either depth."""
    leaves = scenes.leaves(smooth_call(channels=1) | coefficients_of(name, torch.float64, "cpu"))
    options = {"camera_model": LENSES[name][0], "global_z_order": by_z, "render_mode": mode}

    def sums(*values):
        given = dict(zip(leaves, values)) | {"width": 9, "height": 7}
        images, alphas, meta = rasterization(**given, **options)
        return weighted_sums((images, alphas, meta["means2d"], meta["depths"]))

    # Noise of the difference quotient: 1e-16 * |sum| (~1000) / 1e-6.
    assert torch.autograd.gradcheck(sums, tuple(leaves.values()), eps=1e-6, atol=1e-6, rtol=1e-6)


@each_lens
def test_lenses_of_a_batch_are_each_of_them(name):
    scene, cameras = scene_of(torch.float64, "cpu"), cameras_of(torch.float64, "cpu")
    coefficients = coefficients_of(name, torch.float64, "cpu")
    other = {key: 0.5 * value for key, value in coefficients.items()}
    model = LENSES[name][0]
    both = {key: torch.stack([value, other[key]]) for key, value in coefficients.items()}
    batch = {key: torch.stack([value, value]) for key, value in (scene | cameras).items()}
    images = rasterization(**batch, **both, width=WIDTH, height=HEIGHT, camera_model=model)[0]
    for b, given in enumerate((coefficients, other)):
        assert torch.equal(images[b], render(scene, cameras, **given, camera_model=model)[0])


def test_a_fisheye_sees_behind_itself_in_the_order_of_distance():
    """Beyond 90 degrees; by z there is nothing, as in gsplat, which culls what is behind."""
    a = math.radians(110)
    scene = {
        "means": 3 * torch.tensor([[0.8 * math.sin(a), 0.6 * math.sin(a), math.cos(a)]]),
        "quats": torch.tensor([[1.0, 0, 0, 0]]),
        "scales": torch.full((1, 3), 0.05),
        "opacities": torch.ones(1),
        "colors": torch.ones(1, 1),
        "viewmats": torch.eye(4)[None],
        "Ks": torch.tensor([[[9.0, 0, 24], [0, 9, 18], [0, 0, 1]]]),
    }
    options = {"width": 48, "height": 36, "camera_model": "fisheye"}
    _, alphas, meta = rasterization(**scene, **options, global_z_order=False, near_plane=2.9, far_plane=3.1)
    torch.testing.assert_close(meta["means2d"], torch.tensor([[24 + 9 * a * 0.8, 18 + 9 * a * 0.6]]))
    torch.testing.assert_close(meta["depths"], torch.tensor([3.0]))
    assert alphas.max() > 0.1
    for limits in ({"near_plane": 3.1}, {"far_plane": 2.9}):
        assert len(rasterization(**scene, **options, global_z_order=False, **limits)[2]["depths"]) == 0
    for packed in (True, False):
        _, alphas, meta = rasterization(**scene, **options, packed=packed)
        assert (alphas == 0).all() and (meta["radii"] == 0).all()


@BOTH_LAYOUTS
def test_planes_cut_a_fisheye_by_z(packed):
    scene, cameras = scene_of(torch.float64, "cpu"), cameras_of(torch.float64, "cpu", 1)
    options = {"camera_model": "fisheye", "packed": False}
    everything = render(scene, cameras, **options)[2]
    z = everything["depths"][0]
    near, far = z.sort().values[[4, 30]].tolist()
    kept = (z > near) & (z < far) & (everything["radii"][0] > 0).all(-1)
    options |= {"packed": packed, "near_plane": near, "far_plane": far}
    images, _, meta = render(scene, cameras, **options)
    found = meta["gaussian_ids"] if packed else (meta["radii"][0] > 0).all(-1).nonzero()[:, 0]
    assert torch.equal(found, kept.nonzero()[:, 0]) and 0 < len(found) < 40
    expected = render({k: v[kept] for k, v in scene.items()}, cameras, camera_model="fisheye")[0]
    torch.testing.assert_close(images, expected, rtol=0, atol=1e-12)


def radial(*shape, **more):
    return {"radial_coeffs": torch.zeros(*shape)} | more


@pytest.mark.parametrize(
    "change, error, message",
    [
        (radial(2, 4), ValueError, r"radial_coeffs must have shape \(2, 6\), got \(2, 4\)"),
        (radial(2, 6, camera_model="fisheye"), ValueError, r"radial_coeffs must have shape \(2, 4\), got \(2, 6\)"),
        (radial(1, 6), ValueError, r"radial_coeffs must have shape \(2, 6\), got \(1, 6\)"),
        ({"tangential_coeffs": torch.zeros(2, 3)}, ValueError, r"tangential_coeffs must have shape \(2, 2\), got"),
        ({"thin_prism_coeffs": torch.zeros(2)}, ValueError, r"thin_prism_coeffs must have shape \(2, 4\), got"),
        ({"radial_coeffs": torch.zeros(2, 6).double()}, TypeError, "radial_coeffs must have the dtype of means"),
        ({"radial_coeffs": [0.0] * 6}, TypeError, "radial_coeffs must be a tensor, got list"),
        (radial(2, 6, camera_model="ortho"), ValueError, "radial_coeffs must be None where camera_model is 'ortho'"),
        ({"radial_coeffs": torch.full((2, 6), math.nan)}, ValueError, "every number of coefficients must be finite"),
    ],
)
def test_errors_of_lenses(change, error, message):
    with pytest.raises(error, match=message):
        render(scene_of(torch.float32, "cpu"), cameras_of(torch.float32, "cpu"), **change)


# --- what is rendered --------------------------------------------------------------------------------


def distances_of(scene, cameras):
    """(C, N) of the means from the cameras."""
    positions = torch.linalg.inv(cameras["viewmats"].double())[:, :3, 3].to(scene["means"].dtype)
    return (scene["means"] - positions[:, None]).norm(dim=-1)


@each_precision
def test_depth_needs_no_colors(device, dtype):
    scene, cameras = scene_of(dtype, device), cameras_of(dtype, device)
    for mode in ("D", "ED", "d", "Ed"):
        expected, alphas, _ = render(scene, cameras, render_mode=mode)
        actual, of_depth, _ = render(scene | {"colors": None}, cameras, render_mode=mode)
        assert torch.equal(actual, expected) and torch.equal(of_depth, alphas)
    with pytest.raises(TypeError, match="colors must be a tensor, got NoneType"):
        render(scene | {"colors": None}, cameras, render_mode="RGB+D")


@each_precision
@BOTH_LAYOUTS
@pytest.mark.parametrize("model", ["pinhole", "fisheye", "ortho"])
@pytest.mark.parametrize("by_z", [True, False], ids=["z", "distance"])
def test_modes_of_distance(device, dtype, packed, model, by_z):
    """Like a feature of the centres' distance; rays of an orthographic camera go along z."""
    scene, cameras = scene_of(dtype, device), cameras_of(dtype, device)
    options = {"camera_model": model, "global_z_order": by_z, "packed": packed}
    background = weights((2, 3), dtype, device, seed=1)
    distances = distances_of(scene, cameras)
    if model == "ortho":
        views = cameras["viewmats"]
        distances = (scene["means"] @ views[:, 2, :3].T + views[:, 2, 3]).T
    images, alphas, _ = render(scene, cameras, backgrounds=background, **options)
    feature = {"colors": distances[..., None].contiguous()}
    distance = render(scene | feature, cameras, **options)[0]
    expected = distance / alphas.clamp(min=1e-10)
    made = {m: render(scene, cameras, backgrounds=background, render_mode=m, **options) for m in MODES_OF_1_6[5:]}
    close = {"rtol": 1e-5 if dtype == torch.float32 else 1e-9, "atol": 10 * tolerance(dtype)}
    torch.testing.assert_close(made["d"][0], distance, **close)
    torch.testing.assert_close(made["Ed"][0], expected, rtol=1e-4 if dtype == torch.float32 else 1e-9, atol=1e-9)
    torch.testing.assert_close(made["RGB-d"][0], torch.cat([images, distance], -1), **close)
    torch.testing.assert_close(made["RGB-Ed"][0][..., :-1], images, **close)
    torch.testing.assert_close(made["RGB-Ed"][0][..., -1:], made["Ed"][0], rtol=1e-4, atol=1e-9)
    assert all(torch.equal(alpha, alphas) and image.is_contiguous() for image, alpha, _ in made.values())


@BOTH_LAYOUTS
@pytest.mark.parametrize("model", ["pinhole", "fisheye"])
def test_the_order_is_by_z_or_by_distance(model, packed):
    """A splat beside the axis, nearer by z and further away, under one on the axis: who is in front decides."""
    scene = {
        "means": torch.tensor([[3.0, 0, 3.0], [1.2, 0, 3.2]]).double(),
        "quats": torch.tensor([[1.0, 0, 0, 0]]).double().expand(2, 4),
        "scales": torch.tensor([[1.0, 1, 1], [1, 1, 1]]).double(),
        "opacities": torch.tensor([0.9, 0.8]).double(),
        "colors": torch.eye(2).double(),
        "viewmats": torch.eye(4)[None].double(),
        "Ks": torch.tensor([[[10.0, 0, 10], [0, 10, 10], [0, 0, 1]]]).double(),
    }
    depths = {True: scene["means"][:, 2], False: scene["means"].norm(dim=1)}
    for by_z, of_order in depths.items():
        options = {"global_z_order": by_z, "camera_model": model, "packed": packed}
        images, _, meta = rasterization(**scene, width=24, height=20, **options)
        torch.testing.assert_close(meta["depths"].reshape(-1), of_order)
        depth, *_ = rasterization(**scene, width=24, height=20, render_mode="D", **options)
        torch.testing.assert_close(depth[..., 0], images @ of_order)
        first = int(of_order.argmin())
        alone = {k: v if k in ("viewmats", "Ks") else v[first : first + 1] for k, v in scene.items()}
        expected = rasterization(**alone, width=24, height=20, **options)[0][..., first]
        torch.testing.assert_close(images[..., first], expected)
    assert depths[True].argmin() != depths[False].argmin()


@each_precision
@BOTH_LAYOUTS
@pytest.mark.parametrize("per_camera", [False, True], ids=["shared", "per-camera"])
@pytest.mark.parametrize("mode", ["RGB", "RGB+ED", "D", "RGB-d"])
def test_extra_signals_are_rendered_like_colors(device, dtype, packed, per_camera, mode):
    """Apart from colours and depth, without a background; their gradients too."""
    scene, cameras = scene_of(dtype, device), cameras_of(dtype, device)
    count = len(scene["means"])
    signals = weights((2, count, 5) if per_camera else (count, 5), dtype, device, seed=3) - 0.5
    background = weights((2, 3), dtype, device, seed=1)
    leaves = scenes.leaves(scene | {"extra_signals": signals})
    options = {"packed": packed, "render_mode": mode, "backgrounds": background}
    images, alphas, meta = render(leaves, cameras, **options)
    extra = meta["render_extra_signals"]
    again = scenes.leaves(scene | {"signals": signals})
    signals = again.pop("signals")
    plain, plain_alphas, _ = render(again, cameras, **options)
    apart, *_ = render(again | {"colors": signals}, cameras, packed=packed)
    assert extra.shape == (2, HEIGHT, WIDTH, 5) and extra.is_contiguous() and images.is_contiguous()
    torch.testing.assert_close(images, plain, rtol=1e-5, atol=10 * tolerance(dtype))
    torch.testing.assert_close(extra, apart, rtol=0, atol=10 * tolerance(dtype))
    assert torch.equal(alphas, plain_alphas)
    g, h = weights(images.shape, dtype, device), weights(extra.shape, dtype, device, seed=2)
    if mode == "D":
        leaves.pop("colors"), again.pop("colors")
    actual = gradients((images * g).sum() + (extra * h).sum(), leaves)
    expected = gradients((plain * g).sum() + (apart * h).sum(), again | {"extra_signals": signals})
    assert_gradients_close(actual, expected, dtype)


@each_precision
@pytest.mark.parametrize("degree", [0, 3, 4])
@pytest.mark.parametrize("per_camera", [False, True], ids=["shared", "per-camera"])
def test_extra_signals_of_harmonics(device, dtype, degree, per_camera):
    """Their sum plus 1/2, which is not clamped, for any number of channels: values and gradients by the formula."""
    scene, cameras = scene_of(dtype, device), cameras_of(dtype, device)
    count = len(scene["means"])
    shape = (2, count, 25, 4) if per_camera else (count, 25, 4)
    harmonics = 8 * (weights(shape, dtype, device, seed=3) - 0.5)
    leaves = scenes.leaves(scene | {"extra_signals": harmonics})
    _, _, meta = render(leaves, cameras, extra_signals_sh_degree=degree)
    extra = meta["render_extra_signals"]
    again = scenes.leaves(scene | {"extra_signals": harmonics})
    positions = torch.linalg.inv(cameras["viewmats"].double())[:, :3, 3].to(device, dtype)
    directions = torch.nn.functional.normalize(again["means"] - positions[:, None], dim=-1)
    basis = torch.stack([spherical_harmonics(degree, of_camera) for of_camera in directions])
    used = again["extra_signals"][..., : (degree + 1) ** 2, :]
    values = 0.5 + (basis[..., None] * used).sum(-2)
    assert (values < -0.1).any() and (values > 1).any()
    expected, *_ = render(again | {"colors": values, "extra_signals": None}, cameras)
    assert (extra - expected).abs().max() <= 100 * tolerance(dtype)
    leaves.pop("colors"), again.pop("colors")
    g = weights(extra.shape, dtype, device)
    assert_gradients_close(gradients((extra * g).sum(), leaves), gradients((expected * g).sum(), again), dtype)


def test_extra_harmonics_that_are_not_finite_reach_their_own_splat():
    """As features do. The Gaussian of harmonics that are not finite is missing where they are evaluated."""
    scene, cameras = scene_of(torch.float64, "cpu"), cameras_of(torch.float64, "cpu")
    scene["scales"] = 0.3 * scene["scales"]
    harmonics = weights((40, 4, 2), torch.float64, "cpu")
    harmonics[2, 1, 1] = math.inf
    images, _, meta = render(scene, cameras, extra_signals=harmonics, extra_signals_sh_degree=1)
    assert torch.equal(images, render(scene, cameras)[0])
    other = torch.ones(40, 1, dtype=torch.float64)
    other[2] = math.nan
    expected = render(scene | {"colors": other}, cameras)[0].isnan()
    assert torch.equal(meta["render_extra_signals"].isnan().any(-1), expected.any(-1))
    assert expected.any() and not expected.all()
    _, _, meta = render(scene, cameras, extra_signals=harmonics * math.nan, extra_signals_sh_degree=1)
    assert meta["render_extra_signals"].isnan().any()


@pytest.mark.parametrize("which", ["colors", "extra_signals"])
def test_harmonics_without_leading_dimensions_serve_the_whole_batch(which):
    """As in gsplat 1.6."""
    scene, cameras = scene_of(torch.float64, "cpu", degree=3), cameras_of(torch.float64, "cpu")
    batch = {k: torch.stack([v, v.flip(0)]) for k, v in scene.items()}
    batch |= {k: torch.stack([v, v]) for k, v in cameras.items()} | {"width": WIDTH, "height": HEIGHT}
    batch |= {"extra_signals": batch["colors"], "sh_degree": 3, "extra_signals_sh_degree": 3}
    repeated = torch.stack([scene["colors"], scene["colors"]])
    images, _, meta = rasterization(**batch | {which: scene["colors"]})
    expected, _, expected_meta = rasterization(**batch | {which: repeated})
    assert torch.equal(images, expected)
    assert torch.equal(meta["render_extra_signals"], expected_meta["render_extra_signals"])


@each_precision
@BOTH_LAYOUTS
@pytest.mark.parametrize("model", ["pinhole", "fisheye", "ortho"])
def test_normals_are_third_axes_that_face_the_camera(device, dtype, packed, model):
    scene, cameras = scene_of(dtype, device), cameras_of(dtype, device)
    leaves, again = scenes.leaves(scene), scenes.leaves(scene)
    images, _, meta = render(leaves, cameras, packed=packed, camera_model=model, return_normals=True)
    w, x, y, z = torch.nn.functional.normalize(again["quats"], dim=-1).unbind(-1)
    axes = torch.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], -1)
    positions = torch.linalg.inv(cameras["viewmats"].double())[:, :3, 3].to(device, dtype)
    rays = scene["means"] - positions[:, None]
    if model == "ortho":
        rays = cameras["viewmats"][:, None, 2, :3]
    away = (axes * rays).sum(-1, keepdim=True) > 0
    assert away.any() and not away.all()
    normals = torch.where(away, -axes, axes)
    expected, *_ = render(again | {"colors": normals}, cameras, packed=packed, camera_model=model)
    assert meta["normals"].is_contiguous() and images.shape[-1] == 3
    assert (meta["normals"] - expected).abs().max() <= 10 * tolerance(dtype)
    g = weights(expected.shape, dtype, device)
    leaves.pop("colors"), again.pop("colors")
    actual = gradients((meta["normals"] * g).sum(), leaves)
    assert_gradients_close(actual, gradients((expected * g).sum(), again), dtype)


def test_everything_at_once():
    """In one pass: colours, extra signals, normals and depth, each as alone; covariances have no normals."""
    scene, cameras = scene_of(torch.float64, "cpu"), cameras_of(torch.float64, "cpu")
    signals = weights((len(scene["means"]), 2), torch.float64, "cpu")
    options = {"render_mode": "RGB-Ed", "camera_model": "fisheye"}
    images, _, meta = render(scene, cameras, extra_signals=signals, return_normals=True, **options)
    of_signals = render(scene | {"colors": signals}, cameras, camera_model="fisheye")[0]
    alone = {
        "images": (images, render(scene, cameras, **options)[0]),
        "extra": (meta["render_extra_signals"], of_signals),
        "normals": (meta["normals"], render(scene, cameras, return_normals=True, camera_model="fisheye")[2]["normals"]),
    }
    for name, (actual, expected) in alone.items():
        torch.testing.assert_close(actual, expected, rtol=0, atol=1e-11, msg=name)
    assert {"render_extra_signals", "normals"}.isdisjoint(render(scene, cameras)[2])
    covars, _ = dialect.quat_scale_to_covar_preci(scene["quats"], scene["scales"])
    with pytest.raises(ValueError, match="covars must be None where return_normals is True"):
        render(scene, cameras, covars=covars, return_normals=True)


@BOTH_LAYOUTS
@pytest.mark.parametrize("count", [0, 6], ids=["none", "behind"])
@pytest.mark.parametrize("by_z", [True, False], ids=["z", "distance"])
def test_without_splats_everything_is_empty(packed, count, by_z):
    scene, cameras = scene_of(torch.float32, "cpu", degree=1), cameras_of(torch.float32, "cpu")
    scene["means"] = scene["means"] - 50 * cameras["viewmats"][0, 2, :3]
    leaves = scenes.leaves({k: v[:count] for k, v in scene.items()})
    options = {"return_normals": True, "render_mode": "RGB-Ed", "camera_model": "fisheye", "absgrad": True}
    options |= {"radial_coeffs": torch.zeros(2, 4), "sh_degree": 1, "extra_signals_sh_degree": 1, "packed": packed}
    options |= {"global_z_order": by_z, "near_plane": 0.1, "far_plane": 40.0}
    images, _, meta = render(leaves, cameras, extra_signals=leaves["colors"], **options)
    total = images.sum() + meta["render_extra_signals"].sum() + meta["normals"].sum()
    total.backward()
    assert images.shape == (2, HEIGHT, WIDTH, 4) and meta["normals"].shape == (2, HEIGHT, WIDTH, 3)
    assert total == 0 and all((leaf.grad == 0).all() for leaf in leaves.values())


def signals(*shape, degree=None, **more):
    return {"extra_signals": torch.ones(*shape), "extra_signals_sh_degree": degree} | more


MORE = {"render_mode": "RGB+D", "return_normals": True}
COLORS = {"colors": torch.ones(6, 511), "return_normals": True}
DEGREE = {"extra_signals_sh_degree": 3}


@pytest.mark.parametrize(
    "change, error, message",
    [
        (signals(5, 2), ValueError, r"extra_signals must have shape \(6, 2\) or \(2, 6, 2\), got"),
        ({"extra_signals": torch.ones(6, 2).double()}, TypeError, "extra_signals must have the dtype of means"),
        ({"extra_signals": 1.0}, TypeError, "extra_signals must be a tensor, got float"),
        (signals(6, 0), ValueError, "extra_signals must have 1 to 509 channels beside the others"),
        (
            signals(6, 508, **MORE),
            ValueError,
            "extra_signals must have 1 to 505 channels beside the others, got 508",
        ),
        (COLORS, ValueError, "channels must be at most 512, depth and normals included, got 514"),
        (DEGREE, ValueError, "extra_signals_sh_degree must be None without extra_signals, got 3"),
        (signals(6, 4, 2, degree=5), ValueError, "extra_signals_sh_degree must be 0 to 4, got 5"),
        (signals(6, 4, 2, degree=3), ValueError, "extra_signals must have 16 harmonics of degree 3, got 4"),
    ],
)
def test_errors_of_what_is_rendered(change, error, message):
    with pytest.raises(error, match=message):
        render(scene_of(torch.float32, "cpu"), cameras_of(torch.float32, "cpu"), **change)


# --- gsplat's own programs ---------------------------------------------------------------------------


@BOTH_LAYOUTS
@pytest.mark.parametrize("model", ["pinhole", "fisheye"])
def test_default_strategy_runs_on_the_meta_of_a_lens(packed, model, patched):
    params, optimizers = trained("cpu")
    cameras = cameras_of(torch.float32, "cpu")
    strategy = patched.DefaultStrategy(refine_start_iter=0, refine_every=2, grow_grad2d=0.0, prune_opa=0.01)
    state = strategy.initialize_state()
    radial = torch.full((2, 6 if model == "pinhole" else 4), 0.01)
    for step in range(3):

        def before(meta, step=step):
            strategy.step_pre_backward(params, optimizers, state, step, meta)

        options = {"packed": packed, "camera_model": model, "radial_coeffs": radial, "with_ut": True}
        _, _, meta = step_once(params, optimizers, cameras, before, **options)
        strategy.step_post_backward(params, optimizers, state, step, meta, packed=packed)
    assert len(params["means"]) > 60 and all(value.isfinite().all() for value in params.values())


def test_patching_keeps_1_6_from_compiling():
    """Its noise takes torch where a flag of its module is set, and a CUDA extension otherwise."""
    pytest.importorskip("gsplat", reason="needs gsplat, of the extra test")
    code = """
        import sys
        import gsplat as theirs
        from gsplat.strategy import ops
        from analytic_rasterizer.dialects import gsplat
        theirs.__version__ = sys.argv[1]
        if sys.argv[1] == "1.6.0":
            ops._force_torch_backend = False
        gsplat.patch()
        print(getattr(ops, "_force_torch_backend", None), theirs.rasterization is gsplat.rasterization)
    """
    assert run_python(code, "1.6.0").strip() == "True True"
    assert run_python(code, "1.5.3").strip() == "None True"
