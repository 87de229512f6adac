"""gsplat's call: its signature, its semantics by its own torch reference, our rasterizer's pictures and gradients, and
its strategies on our meta."""

import inspect
import math

import pytest
import scenes
import torch
from gsplat_calls import (
    FAR,
    HEIGHT,
    NEAR,
    WIDTH,
    as_gsplat_has_it,
    assert_gradients_close,
    cameras_of,
    drop_in,
    gradient_tolerance,
    gradients,
    render,
    scene_of,
    smooth_call,
    tolerance,
)
from marks import each_kind, each_precision
from processes import run_python
from torch.utils._python_dispatch import TorchDispatchMode
from weights import weighted_sums, weights

import analytic_rasterizer as ar
from analytic_rasterizer.dialects import gsplat as dialect
from analytic_rasterizer.dialects.gsplat import rasterization
from analytic_rasterizer.relocation import compute_relocation

BOTH_LAYOUTS = pytest.mark.parametrize("packed", [False, True], ids=["dense", "packed"])


# --- gsplat's own reference --------------------------------------------------------------------------


@pytest.fixture
def reference():
    """gsplat's torch implementation."""
    return pytest.importorskip("gsplat.cuda._torch_impl", reason="needs gsplat, of the extra test")


def test_the_signature_is_gsplats():
    gsplat = pytest.importorskip("gsplat", reason="needs gsplat, of the extra test")
    expected = list(inspect.signature(gsplat.rendering.rasterization).parameters.values())
    actual = list(inspect.signature(rasterization).parameters.values())
    for ours, theirs in zip(actual, expected):
        assert (ours.name, ours.kind) == (theirs.name, theirs.kind)
        if ours.name != "rolling_shutter":  # gsplat's default is a value of an enumeration of its own
            assert ours.default == theirs.default, ours.name
    assert all(p.kind is inspect.Parameter.KEYWORD_ONLY for p in actual[len(expected) :])
    scene, cameras = scene_of(torch.float32, "cpu"), cameras_of(torch.float32, "cpu")
    shutter = next(theirs.default for theirs in expected if theirs.name == "rolling_shutter")
    image, *_ = render(scene, cameras, rolling_shutter=shutter)
    assert image.shape == (2, HEIGHT, WIDTH, 3)


def projected(reference, scene, cameras, mode, model="pinhole"):
    """What gsplat's reference says of every Gaussian in every camera; radii by the rule of gsplat's kernels."""
    covars, _ = reference._quat_scale_to_covar_preci(scene["quats"], scene["scales"], True, False)
    given = scene["means"], covars, cameras["viewmats"], cameras["Ks"], WIDTH, HEIGHT
    options = {"near_plane": NEAR, "far_plane": FAR, "camera_model": model}
    _, means2d, depths, conics, amplitudes = reference._fully_fused_projection(
        *given, **options, calc_compensations=mode == "antialiased"
    )
    opacities = scene["opacities"].expand(len(means2d), -1)
    opacities = opacities if amplitudes is None else opacities * amplitudes
    a, b, c = conics.unbind(-1)
    variances = torch.stack([c, a], -1) / (a * c - b * b)[..., None]  # of the inverse of the conic
    extent = (2 * (255 * opacities).log()).clamp(min=0).sqrt().clamp(max=3.33)
    radii = (extent[..., None] * variances.sqrt()).ceil()
    size = means2d.new_tensor([WIDTH, HEIGHT])
    drawn = ((radii > 0) & (means2d + radii > 0) & (means2d - radii < size)).all(-1)
    drawn &= (depths > NEAR) & (depths < FAR)
    radii = torch.where(drawn[..., None], radii, 0).int()
    names = ("means2d", "depths", "conics", "opacities", "radii")
    return dict(zip(names, (means2d, depths, conics, opacities, radii)))


@pytest.mark.parametrize("model", ["pinhole", "ortho"])
def test_the_last_row_of_a_view_is_not_read(device, model):
    scene, cameras = scene_of(torch.float32, device), cameras_of(torch.float32, device)
    views = cameras["viewmats"]
    other = views.clone()
    other[:, 3] = torch.tensor([0.1, -0.2, 0.3, 1.5])
    other.requires_grad_()
    made = render(scene, cameras | {"viewmats": other}, camera_model=model)[0]
    assert torch.equal(made, render(scene, cameras, camera_model=model)[0])
    made.square().sum().backward()
    assert (other.grad[:, 3] == 0).all() and (other.grad[:, :3] != 0).any()


@each_precision
@BOTH_LAYOUTS
@pytest.mark.parametrize("mode", dialect.RASTERIZE_MODES)
@pytest.mark.parametrize("model", ["pinhole", "ortho"])
def test_meta_is_that_of_gsplats_reference(device, dtype, packed, mode, model, reference):
    scene, cameras = scene_of(torch.float64, "cpu", count=200), cameras_of(torch.float64, "cpu")
    scene["opacities"][::7] = 0.003
    scene["means"] *= 2  # some lie outside the images
    expected = projected(reference, scene, cameras, mode, model)
    kept = (expected["radii"] > 0).all(-1)
    assert 20 < kept.sum() < 0.9 * kept.numel()
    scene, cameras = ({k: v.to(device, dtype) for k, v in part.items()} for part in (scene, cameras))
    _, _, meta = render(scene, cameras, packed=packed, rasterize_mode=mode, camera_model=model)
    # Our projection looks at the ellipse and not at the rectangle around it: it culls a few at corners, unseen.
    found = torch.zeros_like(kept)
    if packed:
        found[meta["camera_ids"].cpu(), meta["gaussian_ids"].cpu()] = True
    else:
        found = (meta["radii"].cpu() > 0).all(-1)
    missing = (kept & ~found).nonzero()
    assert len(missing) <= 0.05 * kept.sum()
    assert all(alphas_of(expected, camera, i).max() < 1 / 255 for camera, i in missing)
    kept[tuple(missing.T)] = False
    expected["radii"][tuple(missing.T)] = 0
    if packed:
        cameras_of_rows, ids = kept.nonzero().unbind(1)
        assert torch.equal(meta["camera_ids"].cpu(), cameras_of_rows)
        assert torch.equal(meta["gaussian_ids"].cpu(), ids)
        assert (meta["batch_ids"] == 0).all() and meta["batch_ids"].dtype == torch.int64
        expected = {name: value[kept] for name, value in expected.items()}
    else:
        assert meta["camera_ids"] is None and meta["gaussian_ids"] is None and meta["batch_ids"] is None
    assert meta["radii"].dtype == torch.int32 and torch.equal(meta["radii"].cpu(), expected["radii"])
    drawn = (expected["radii"] > 0).all(-1)  # where the rest means something
    rtol = 1e-9 if dtype == torch.float64 else 1e-3  # of conics and amplitudes of splats 50 times longer than wide
    for name in ("means2d", "depths", "conics", "opacities"):
        assert meta[name].shape == expected[name].shape and meta[name].dtype == dtype
        actual = meta[name].cpu().double()[drawn]
        torch.testing.assert_close(actual, expected[name][drawn], rtol=rtol, atol=1e-5 * (rtol > 1e-5))
    assert (meta["width"], meta["height"], meta["n_cameras"], meta["n_batches"]) == (WIDTH, HEIGHT, 2, 1)
    assert (meta["tile_size"], meta["tile_width"], meta["tile_height"]) == (16, 3, 3)


def pixel_centres():
    """Rows and columns of all pixels (H, W), px."""
    return torch.meshgrid(*(torch.arange(n, dtype=torch.float64) + 0.5 for n in (HEIGHT, WIDTH)), indexing="ij")


def alphas_of(rows, camera, i):
    """(H, W) of one splat of what `projected` returns."""
    y, x = pixel_centres()
    (mean_x, mean_y), (a, b, c) = rows["means2d"][camera, i], rows["conics"][camera, i]
    dx, dy = x - mean_x, y - mean_y
    return rows["opacities"][camera, i] * torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)


def composited(rows, colors):
    """Images and alphas of what `projected` returns, by definition: splat after splat over all pixels."""
    images = torch.zeros(len(colors), HEIGHT, WIDTH, colors.shape[-1], dtype=torch.float64)
    rest = torch.ones(len(colors), HEIGHT, WIDTH, 1, dtype=torch.float64)
    for camera in range(len(colors)):
        open_ = torch.ones(HEIGHT, WIDTH, 1, dtype=torch.bool)
        for i in rows["depths"][camera].argsort():
            if rows["radii"][camera, i].min() == 0:
                continue
            alpha = alphas_of(rows, camera, i)[..., None]
            alpha = torch.where(alpha >= 1 / 255, alpha, 0)
            open_ = open_ & (rest[camera] * (1 - alpha) > 1e-4)
            alpha = torch.where(open_, alpha, 0)
            images[camera] += rest[camera] * alpha * colors[camera, i]
            rest[camera] *= 1 - alpha
    return images, 1 - rest


@each_precision
@pytest.mark.parametrize("mode", dialect.RASTERIZE_MODES)
@pytest.mark.parametrize("degree", [None, 0, 3, 4])
def test_images_are_gsplats_by_definition(device, dtype, mode, degree, reference):
    """With gsplat's projection and its harmonics; opacities are below our cap of alpha, 0.99."""
    scene, cameras = scene_of(dtype, device, degree=degree or 0), cameras_of(dtype, device)
    if degree == 0:
        scene["colors"] = scene["colors"][:, None] - 0.4  # one harmonic
    background = weights((2, 3), dtype, device)
    images, alphas, _ = render(scene, cameras, sh_degree=degree, rasterize_mode=mode, backgrounds=background)
    double, views = ({k: v.cpu().double() for k, v in part.items()} for part in (scene, cameras))
    colors = double["colors"].expand(2, *double["colors"].shape)
    if degree is not None:
        directions = double["means"] - torch.inverse(views["viewmats"])[:, None, :3, 3]
        colors = (reference._spherical_harmonics(degree, directions, colors) + 0.5).clamp(min=0)
    expected, expected_alphas = composited(projected(reference, double, views, mode), colors)
    expected = expected + (1 - expected_alphas) * background.cpu().double()[:, None, None]
    assert (images.cpu() - expected).abs().max() <= 2 * tolerance(dtype)
    assert (alphas.cpu() - expected_alphas).abs().max() <= tolerance(dtype)


# --- our rasterizer ----------------------------------------------------------------------------------


@each_precision
@BOTH_LAYOUTS
@each_kind
def test_images_and_gradients_are_the_rasterizers(device, dtype, packed, variant):
    """Of every input and of the cameras, with harmonics, alpha and depth, whatever the footprint."""
    footprint = str(ar.resolve_footprint(variant[0], **variant[1]))
    scene = scenes.leaves(scene_of(dtype, device, degree=1))
    cameras = scenes.leaves(cameras_of(dtype, device))
    again, views = scenes.leaves(scene), scenes.leaves(cameras)
    images, alphas, _ = render(
        scene, cameras, sh_degree=1, packed=packed, footprint=footprint, render_mode="RGB+D", backgrounds=None
    )
    g = weights((2, HEIGHT, WIDTH, 5), dtype, device)
    actual = gradients((torch.cat([images, alphas], -1) * g).sum(), scene | cameras)
    total = 0
    for camera, (view, K) in enumerate(zip(views["viewmats"], views["Ks"])):
        color, _, outputs = drop_in(again, view, K, 1, footprint, alpha=True, depth=True)
        planes = torch.cat([color, outputs.depth, outputs.alpha]).permute(1, 2, 0)
        shown = torch.cat([images[camera], alphas[camera]], -1)
        assert (shown - planes).abs().max() <= 6 * tolerance(dtype)  # depths are up to 6
        total = total + (planes * g[camera]).sum()
    assert_gradients_close(actual, gradients(total, again | views), dtype)


@each_precision
@BOTH_LAYOUTS
def test_means2d_has_the_gradients_that_density_control_reads(device, dtype, packed):
    """The rasterizer gives them per half an image; absgrad are sums over pixels of absolute values."""
    scene, cameras = scenes.leaves(scene_of(dtype, device)), cameras_of(dtype, device)
    images, _, meta = render(scene, cameras, packed=packed, absgrad=True)
    meta["means2d"].retain_grad()
    g = weights(images.shape, dtype, device) - 0.5
    (images * g).sum().backward()
    half = torch.tensor([WIDTH / 2, HEIGHT / 2], dtype=dtype, device=device)
    for camera in range(2):
        means2D = torch.zeros(len(scene["means"]), 4, dtype=dtype, device=device, requires_grad=True)
        view, K = cameras["viewmats"][camera], cameras["Ks"][camera]
        color, _, *_ = drop_in(scene, view, K, None, "point:dilation=0.3", means2D)
        (color.permute(1, 2, 0) * g[camera]).sum().backward()
        rows = camera if not packed else meta["camera_ids"] == camera
        ids = slice(None) if not packed else meta["gaussian_ids"][rows]
        for name, expected in (("grad", means2D.grad[:, :2]), ("absgrad", means2D.grad[:, 2:])):
            actual = getattr(meta["means2d"], name)[rows] * half
            torch.testing.assert_close(
                actual, expected[ids], rtol=gradient_tolerance(dtype), atol=1e-5 * expected.abs().max().item()
            )


def test_absolute_gradients_come_with_gradients_of_anything(device):
    """Also where torch.autograd.grad asks for the means alone, and none where nothing requires a gradient."""
    dtype = torch.float32
    scene, cameras = scenes.leaves(scene_of(dtype, device)), cameras_of(dtype, device)
    images, _, meta = render(scene, cameras, absgrad=True)
    torch.autograd.grad(images.sum(), scene["means"])
    assert meta["means2d"].absgrad.shape == meta["means2d"].shape and (meta["means2d"].absgrad > 0).any()
    plain, _, meta = render(scene_of(dtype, device), cameras, absgrad=True)
    assert not plain.requires_grad and not hasattr(meta["means2d"], "absgrad")
    with torch.no_grad():
        inferred, *_ = render(scene, cameras, absgrad=True)
    assert torch.equal(plain, images) and torch.equal(inferred, images)


@pytest.mark.parametrize("options", [{}, {"packed": False, "rasterize_mode": "antialiased", "absgrad": True}])
@pytest.mark.parametrize("model", ["pinhole", "ortho"])
def test_gradcheck(options, model):
    leaves = scenes.leaves(smooth_call(channels=2) | {"backgrounds": torch.rand(2, 2, dtype=torch.float64)})
    size = {"width": 9, "height": 7}

    def images(*values):
        given = dict(zip(leaves, values)) | size
        shown, alphas, meta = rasterization(**given, render_mode="RGB+ED", camera_model=model, **options)
        return shown, alphas, meta["means2d"], meta["depths"]

    def sums(*values):
        return weighted_sums(images(*values))

    with torch.no_grad():
        assert (images(*leaves.values())[1] > 1 / 255).all()
    # Noise of the difference quotient: 1e-16 * |sum| (~1000) / 1e-6.
    assert torch.autograd.gradcheck(sums, tuple(leaves.values()), eps=1e-6, atol=1e-6, rtol=1e-6)


def test_gradcheck_of_covariances():
    given = smooth_call(channels=1) | {"width": 9, "height": 7}
    given |= {name: given[name][:1] for name in ("viewmats", "Ks")}
    covars, _ = dialect.quat_scale_to_covar_preci(given.pop("quats"), given.pop("scales"))

    def image(matrices):
        symmetric = (matrices + matrices.mT) / 2  # what is a covariance stays one
        return rasterization(**given, quats=None, scales=None, covars=symmetric)[0]

    assert torch.autograd.gradcheck(image, (covars.detach().requires_grad_(),))


# --- arguments ---------------------------------------------------------------------------------------


@each_precision
def test_covariances_in_place_of_scales(device, dtype):
    scene, cameras = scene_of(dtype, device), cameras_of(dtype, device)
    covars, _ = dialect.quat_scale_to_covar_preci(scene["quats"], scene["scales"])
    expected, *_ = render(scene, cameras)
    lower = torch.ones(3, 3, dtype=dtype, device=device).tril(-1)  # is not read
    actual, *_ = render(scene | {"quats": None, "scales": None}, cameras, covars=covars + lower)
    assert (actual - expected).abs().max() <= 10 * tolerance(dtype)


@each_precision
@BOTH_LAYOUTS
@pytest.mark.parametrize("per_camera", [False, True], ids=["shared", "per-camera"])
@pytest.mark.parametrize("degree", [None, 1])
def test_a_batch_is_each_of_its_scenes(device, dtype, packed, per_camera, degree):
    """Two by one scenes of two cameras: images, gradients and meta; colours of a camera are used in that camera."""
    single, cameras = [], []
    for seed in (1, 2):
        scene = scene_of(dtype, device, degree=degree or 0, seed=seed)
        if per_camera:
            scene["colors"] = torch.stack([scene["colors"], scene["colors"].flip(0)])
        single.append(scene)
        cameras.append(cameras_of(dtype, device))
    cameras[1]["viewmats"] = cameras[1]["viewmats"].flip(0)
    together = scenes.leaves({k: torch.stack([scene[k] for scene in single])[:, None] for k in single[0]})
    views = {k: torch.stack([c[k] for c in cameras])[:, None] for k in cameras[0]}
    background = weights((2, 1, 2, 3), dtype, device)
    options = {"sh_degree": degree, "packed": packed, "render_mode": "RGB+ED"}
    images, alphas, meta = render(together, views, backgrounds=background, **options)
    assert images.shape == (2, 1, 2, HEIGHT, WIDTH, 4) and alphas.shape == (2, 1, 2, HEIGHT, WIDTH, 1)
    assert meta["n_batches"] == 2 and meta["n_cameras"] == 2
    g = weights(images.shape, dtype, device)
    actual = gradients((images * g).sum(), together)
    for b in range(2):
        leaves = scenes.leaves(single[b])
        own, own_alphas, own_meta = render(leaves, cameras[b], backgrounds=background[b, 0], **options)
        assert torch.equal(images[b, 0], own) and torch.equal(alphas[b, 0], own_alphas)
        expected = gradients((own * g[b, 0]).sum(), leaves)
        assert_gradients_close({k: v[b, 0] for k, v in actual.items()}, expected, dtype)
        rows = meta["batch_ids"] == b if packed else (b, 0)
        for name in ("means2d", "radii", "depths", "conics", "opacities"):
            assert torch.equal(meta[name][rows], own_meta[name]), name
        for name in ("camera_ids", "gaussian_ids"):
            assert own_meta[name] is None if not packed else torch.equal(meta[name][rows], own_meta[name])
        if per_camera:
            for c in range(2):
                of_camera = {k: v[c : c + 1] for k, v in cameras[b].items()}
                colors = {"colors": single[b]["colors"][c]}
                alone, *_ = render(single[b] | colors, of_camera, backgrounds=background[b, 0, c : c + 1], **options)
                assert torch.equal(images[b, 0, c], alone[0])


@each_precision
def test_layouts_agree(device, dtype):
    """Packed rows are those of the table that are not culled; the images are the same."""
    scene, cameras = scene_of(torch.float64, "cpu", count=100), cameras_of(torch.float64, "cpu")
    scene["means"] *= 2
    scene, cameras = ({k: v.to(device, dtype) for k, v in part.items()} for part in (scene, cameras))
    dense_images, dense_alphas, dense = render(scene, cameras, packed=False)
    images, alphas, packed = render(scene, cameras, packed=True)
    assert torch.equal(images, dense_images) and torch.equal(alphas, dense_alphas)
    kept = (dense["radii"] > 0).all(-1)
    assert 0 < kept.sum() < kept.numel()
    for name in ("means2d", "radii", "depths", "conics", "opacities"):
        assert torch.equal(dense[name][kept], packed[name]), name


@each_precision
@pytest.mark.parametrize("channels", [1, 2, 40])
def test_render_modes(device, dtype, channels):
    """Depth is a channel like a feature of z; expected depth is depth by alpha."""
    scene, cameras = scene_of(dtype, device), cameras_of(dtype, device)
    scene["colors"] = weights((len(scene["means"]), channels), dtype, device)
    background = weights((2, channels), dtype, device, seed=1)
    images, alphas, meta = render(scene, cameras, backgrounds=background, packed=False)
    assert images.shape == (2, HEIGHT, WIDTH, channels)
    z = meta["depths"][..., None]
    depth, *_ = render(scene | {"colors": z}, cameras)
    modes = {mode: render(scene, cameras, backgrounds=background, render_mode=mode) for mode in dialect.RENDER_MODES}
    close = {"rtol": 0, "atol": 10 * tolerance(dtype)}
    expected = depth / alphas.clamp(min=1e-10)
    torch.testing.assert_close(modes["RGB"][0], images, **close)
    torch.testing.assert_close(modes["D"][0], depth, **close)
    torch.testing.assert_close(modes["ED"][0], expected, rtol=1e-4 if dtype == torch.float32 else 1e-9, atol=1e-9)
    torch.testing.assert_close(modes["RGB+D"][0], torch.cat([images, depth], -1), **close)
    torch.testing.assert_close(modes["RGB+ED"][0][..., :-1], images, **close)
    torch.testing.assert_close(modes["RGB+ED"][0][..., -1:], modes["ED"][0], rtol=1e-4, atol=1e-9)
    for image, alpha, _ in modes.values():
        assert torch.equal(alpha, alphas) and image.is_contiguous()


@each_precision
@BOTH_LAYOUTS
def test_small_splats_are_clipped(device, dtype, packed):
    """As if they were not there, and with no radius."""
    scene, cameras = scene_of(torch.float64, "cpu", count=60), cameras_of(torch.float64, "cpu", 1)
    scene, cameras = ({k: v.to(device, dtype) for k, v in part.items()} for part in (scene, cameras))
    _, _, meta = render(scene, cameras, packed=False)
    large = (meta["radii"][0] > 8).any(-1)
    assert 5 < large.sum() < 55
    images, _, clipped = render(scene, cameras, packed=packed, radius_clip=8.0)
    expected, *_ = render({k: v[large] for k, v in scene.items()}, cameras)
    assert torch.equal(images, expected)
    if packed:
        assert torch.equal(clipped["gaussian_ids"], large.nonzero()[:, 0])
    else:
        assert torch.equal((clipped["radii"][0] > 0).all(-1), large)


def test_planes_cut_depths(device):
    scene, cameras = scene_of(torch.float32, device), cameras_of(torch.float32, device, 1)
    z = render(scene, cameras, packed=False)[2]["depths"][0]
    near, far = z.sort().values[[1, 4]].tolist()
    _, _, meta = render(scene, cameras, near_plane=near, far_plane=far)
    assert torch.equal(meta["gaussian_ids"], ((z > near) & (z < far)).nonzero()[:, 0]) and len(meta["depths"]) == 2


def test_the_footprint_is_gsplats_filter_unless_one_was_chosen(device, monkeypatch):
    scene, cameras = scene_of(torch.float32, device), cameras_of(torch.float32, device)

    def image(**options):
        return render(scene, cameras, **options)[0]

    monkeypatch.delenv("ANALYTIC_RASTERIZER_FOOTPRINT", raising=False)
    classic, antialiased = image(eps2d=0.2), image(eps2d=0.2, rasterize_mode="antialiased")
    assert torch.equal(classic, image(footprint="point:dilation=0.2"))
    assert torch.equal(antialiased, image(footprint="mip:variance=0.2"))
    box = image(footprint=ar.resolve_footprint("box", samples=16))
    assert not torch.equal(box, classic) and not torch.equal(antialiased, classic)
    monkeypatch.setenv("ANALYTIC_RASTERIZER_FOOTPRINT", "box:samples=16")
    assert torch.equal(image(), box) and torch.equal(image(footprint="point:dilation=0.2"), classic)
    monkeypatch.delenv("ANALYTIC_RASTERIZER_FOOTPRINT")
    try:
        ar.set_default_footprint("box", samples=16)
        assert torch.equal(image(), box)
    finally:
        ar.set_default_footprint(None)
    assert torch.equal(image(eps2d=0.2), classic)


def test_meta_of_other_footprints_has_the_variance_of_a_pixel(device, best):
    scene, cameras = scene_of(best, device), cameras_of(best, device)
    _, _, box = render(scene, cameras, footprint="box:samples=4")
    _, _, point = render(scene, cameras, footprint="point", eps2d=5.0)
    _, _, expected = render(scene, cameras, eps2d=1 / 12)
    assert torch.equal(box["gaussian_ids"], expected["gaussian_ids"])
    torch.testing.assert_close(box["conics"], expected["conics"])
    assert torch.equal(box["radii"], expected["radii"]) and torch.equal(box["opacities"], expected["opacities"])
    assert not torch.allclose(point["conics"][: len(box["conics"])], box["conics"][: len(point["conics"])])


@pytest.mark.parametrize("footprint", ar.footprints.footprint_variants())
@pytest.mark.parametrize("sigma", [(0.3, 0.3), (1.5, 0.4), (4.0, 4.0)])
def test_meta_adds_the_variance_that_the_weight_has(footprint, sigma):
    """The second moments of the weight around the mean, by sums over a fine grid. That of `analytic` uses a logistic
    curve in place of the normal one, whose variance is 0.24% smaller."""
    a, b = sigma
    c, s = math.cos(0.4), math.sin(0.4)
    cov = torch.tensor([c * c * a * a + s * s * b * b, c * s * (a * a - b * b), s * s * a * a + c * c * b * b]).double()
    side = torch.arange(-8 * a - 2, 8 * a + 2, b / 8, dtype=torch.float64)
    y, x = torch.meshgrid(side, side, indexing="ij")
    weight = ar.footprint_weight(torch.stack([x, y], -1), cov, footprint)
    xx, yy = ((weight * d * d).sum() / weight.sum() for d in (x, y))
    xy = (weight * x * y).sum() / weight.sum()
    K = torch.tensor([[[1.0, 0, 8], [0, 1, 8], [0, 0, 1]]], dtype=torch.float64)
    covars = 1e-6 * torch.eye(3, dtype=torch.float64)
    covars[0, 0], covars[0, 1], covars[1, 0], covars[1, 1] = cov[0], cov[1], cov[1], cov[2]
    means, one = torch.tensor([[0.0, 0, 1]], dtype=torch.float64), torch.ones(1, dtype=torch.float64)
    view = torch.eye(4, dtype=torch.float64)[None]
    _, _, meta = rasterization(
        means, None, None, one, one[:, None], view, K, 16, 16, covars=covars[None], footprint=footprint
    )
    p, q, r = meta["conics"][0]
    det = p * r - q * q
    rtol = {"analytic": 5e-3, "cumulant": 0.02}.get(footprint, 1e-3)
    expected = torch.stack([r / det, -q / det, p / det])
    torch.testing.assert_close(torch.stack([xx, xy, yy]), expected, rtol=rtol, atol=rtol * 0.01)


@each_kind
def test_radii_leave_out_nothing_that_shows(variant):
    """Of splats at the border of the image, the rasterizer's picture has no more."""
    footprint = str(ar.resolve_footprint(variant[0], **variant[1]))
    g = torch.Generator().manual_seed(3)
    count = 400
    edge = torch.rand(count, generator=g, dtype=torch.float64) * 2 - 1
    out = 1 + 0.5 * torch.rand(count, generator=g, dtype=torch.float64)
    side = torch.randint(4, (count,), generator=g)
    x = torch.where(side < 2, edge, torch.where(side == 2, out, -out)) * 0.6 * 4
    y = torch.where(side < 2, torch.where(side == 0, out, -out), edge) * 0.5 * 4
    scene = {
        "means": torch.stack([x, y, torch.full_like(x, 4)], 1),
        "quats": torch.randn(count, 4, generator=g, dtype=torch.float64),
        "scales": torch.exp(torch.rand(count, 3, generator=g, dtype=torch.float64) * 4 - 4),
        "opacities": torch.rand(count, generator=g, dtype=torch.float64),
        "colors": torch.rand(count, 3, generator=g, dtype=torch.float64),
    }
    view = torch.eye(4, dtype=torch.float64)
    K = torch.tensor([[37.5, 0, 22.5], [0, 37, 18.5], [0, 0, 1]], dtype=torch.float64)
    cameras = {"viewmats": view[None], "Ks": K[None]}
    images, _, meta = render(scene, cameras, footprint=footprint)
    assert 50 < len(meta["radii"]) < 350
    color, *_ = drop_in(scene, view, K, None, footprint)
    assert (images[0] - color.permute(1, 2, 0)).abs().max() <= 1e-12


def test_the_longest_splat_has_a_radius_that_fits(device):
    """8e8 px of standard deviation are drawn; the radius is cut to what an int32 holds."""
    scene = {name: value[:1] for name, value in scene_of(torch.float32, device).items()} | {
        "means": torch.tensor([[0.0, 0, 4]], device=device),
        "quats": torch.tensor([[1.0, 0, 0, 0]], device=device),
        "scales": torch.tensor([[9e7, 1, 1]], device=device),
    }
    cameras = cameras_of(torch.float32, device, 1) | {"viewmats": torch.eye(4, device=device)[None]}
    images, _, meta = render(scene, cameras)
    assert meta["radii"][0, 0] == 10**9 and 0 < meta["radii"][0, 1] < 40
    assert images.isfinite().all() and images.max() > 0


@BOTH_LAYOUTS
def test_no_gaussians(device, packed):
    scene = {k: v[:0] for k, v in scene_of(torch.float32, device).items()}
    background = weights((2, 3), torch.float32, device)
    leaves = scenes.leaves(scene)
    images, alphas, meta = render(
        leaves, cameras_of(torch.float32, device), packed=packed, backgrounds=background, absgrad=True
    )
    assert torch.equal(images, background[:, None, None].expand(2, HEIGHT, WIDTH, 3)) and (alphas == 0).all()
    assert meta["means2d"].shape == ((0, 2) if packed else (2, 0, 2))
    images.sum().backward()
    assert leaves["means"].grad.shape == (0, 3)


def test_gaussians_behind_every_camera(device):
    scene, cameras = scene_of(torch.float32, device), cameras_of(torch.float32, device)
    scene["means"] = scene["means"] - 50 * cameras["viewmats"][0, 2, :3]
    leaves = scenes.leaves(scene)
    images, _, meta = render(leaves, cameras, absgrad=True)
    images.sum().backward()
    assert (images == 0).all() and len(meta["means2d"]) == 0 and (leaves["means"].grad == 0).all()


REFUSED = [
    {"sparse_grad": True},
    {"with_ut": True},
    {"with_eval3d": True},
    {"ftheta_coeffs": object()},
    {"viewmats_rs": torch.eye(4).expand(2, 4, 4)},
    {"rolling_shutter": "ROLLING_TOP_TO_BOTTOM"},
    {"camera_model": "ftheta"},
]


@pytest.mark.parametrize("asked", REFUSED, ids=lambda asked: next(iter(asked)))
def test_what_is_not_served_is_refused_by_name(asked):
    with pytest.raises(NotImplementedError, match=f"^{next(iter(asked))} .*not supported: "):
        render(scene_of(torch.float32, "cpu"), cameras_of(torch.float32, "cpu"), **asked)


def test_2dgs_is_refused_by_name():
    with pytest.raises(NotImplementedError, match=r"^rasterization_2dgs is not supported: "):
        dialect.rasterization_2dgs(torch.zeros(1, 3), render_mode="RGB")


NO_POSE = torch.eye(4).repeat(2, 1, 1)
NO_POSE[1, 2, 3] = math.nan
MIRRORED = torch.tensor([[-5.0, 0, 4], [0, 5, 4], [0, 0, 1]])
MANY = {"colors": torch.ones(6, 512), "render_mode": "RGB+D"}


@pytest.mark.parametrize(
    "change, error, message",
    [
        ({"means": torch.zeros(6, 2)}, ValueError, r"means must have shape \(\.\.\., N, 3\), got \(6, 2\)"),
        ({"means": None}, TypeError, "means must be a tensor, got NoneType"),
        ({"quats": None}, TypeError, "quats must be a tensor, got NoneType"),
        ({"quats": torch.zeros(5, 4)}, ValueError, r"quats must have shape \(6, 4\), got \(5, 4\)"),
        ({"scales": torch.ones(6, 3).double()}, TypeError, "scales must have the dtype of means, torch.float32"),
        ({"opacities": torch.ones(6, 1)}, ValueError, r"opacities must have shape \(6,\), got \(6, 1\)"),
        ({"covars": torch.ones(6, 6)}, ValueError, r"covars must have shape \(6, 3, 3\), got \(6, 6\)"),
        ({"viewmats": torch.eye(4)}, ValueError, r"viewmats must have shape \(\.\.\., C, 4, 4\), got \(4, 4\)"),
        ({"viewmats": torch.zeros(0, 4, 4)}, ValueError, "viewmats must hold at least one camera"),
        ({"viewmats": torch.eye(4)[None, None]}, ValueError, r"viewmats must have shape \(1, 4, 4\), got \(1, 1, 4, 4"),
        ({"Ks": torch.eye(3)[None]}, ValueError, r"Ks must have shape \(2, 3, 3\), got \(1, 3, 3\)"),
        ({"Ks": MIRRORED.expand(2, 3, 3)}, ValueError, "Ks must have positive focal lengths, got -5.0"),
        ({"colors": torch.ones(5, 3)}, ValueError, r"colors must have shape \(6, 3\) or \(2, 6, 3\), got \(5, 3\)"),
        ({"colors": torch.ones(3, 6, 3)}, ValueError, r"colors must have shape \(6, 3\) or \(2, 6, 3\), got \(3, 6"),
        ({"colors": torch.ones(6, 3).long()}, TypeError, "colors must have the dtype of means, torch.float32, got"),
        ({"colors": torch.ones(6, 3, device="meta")}, ValueError, "colors must be on the device of means, cpu, got me"),
        ({"colors": torch.ones(6, 513)}, ValueError, "colors must have 1 to 512 channels in render_mode RGB, got 513"),
        (MANY, ValueError, "colors must have 1 to 511 channels in render_mode RGB.D, got 512"),
        ({"colors": torch.ones(6, 0)}, ValueError, "colors must have 1 to 512 channels in render_mode RGB, got 0"),
        ({"viewmats": NO_POSE}, ValueError, r"viewmats must be finite, got nan at \(1, 2, 3\)"),
        ({"Ks": torch.full((2, 3, 3), math.inf)}, ValueError, r"Ks must be finite, got inf at \(0, 0, 0\)"),
        ({"sh_degree": 1}, ValueError, r"colors must have shape \(6, K, 3\) or \(2, 6, K, 3\) of K.*, got \(6, 3\)"),
        ({"sh_degree": 1, "colors": torch.ones(6, 3, 3)}, ValueError, "colors must have 4 harmonics of degree 1, got"),
        ({"sh_degree": 0.5, "colors": torch.ones(6, 9, 3)}, ValueError, "sh_degree must be 0 to 4, got 0.5"),
        ({"sh_degree": 5, "colors": torch.ones(6, 36, 3)}, ValueError, "sh_degree must be 0 to 4, got 5"),
        ({"backgrounds": torch.ones(3)}, ValueError, r"backgrounds must have shape \(2, 3\), got \(3,\)"),
        ({"width": 0}, ValueError, "width must be a positive integer, got 0"),
        ({"width": math.nan}, ValueError, "width must be a whole number, got nan"),
        ({"height": None}, TypeError, "height must be a whole number, got None"),
        ({"near_plane": None}, TypeError, "near_plane must be a number, got None"),
        ({"radius_clip": "small"}, TypeError, "radius_clip must be a number, got 'small'"),
        ({"near_plane": 0.0}, ValueError, "near_plane must be above 0 and below far_plane, got 0.0"),
        ({"far_plane": 0.001}, ValueError, "near_plane must be above 0 and below far_plane"),
        ({"eps2d": -1.0}, ValueError, "eps2d must be finite and not negative, got -1.0"),
        ({"radius_clip": math.nan}, ValueError, "radius_clip must be finite and not negative, got nan"),
        ({"render_mode": "rgb"}, ValueError, r"render_mode must be one of RGB, D, .*, RGB-Ed, got 'rgb'"),
        ({"rasterize_mode": "mip"}, ValueError, "rasterize_mode must be one of classic, antialiased, got 'mip'"),
        ({"camera_model": "lens"}, ValueError, "camera_model must be one of pinhole, ortho, fisheye, got 'lens'"),
        ({"footprint": "disc"}, ValueError, "footprint must be one of"),
    ],
)
def test_errors_name_what_is_wrong(change, error, message):
    with pytest.raises(error, match=message):
        render(scene_of(torch.float32, "cpu"), cameras_of(torch.float32, "cpu"), **change)


# --- gsplat's own programs ---------------------------------------------------------------------------


@pytest.fixture
def patched(monkeypatch):
    """gsplat with our functions in it, for one test."""
    gsplat = pytest.importorskip("gsplat", reason="needs gsplat, of the extra test")
    for module, names in (
        (gsplat, ("rasterization", "quat_scale_to_covar_preci")),
        (gsplat.rendering, ("rasterization",)),
        (gsplat.relocation, ("compute_relocation",)),
        (gsplat.strategy.ops, ("compute_relocation", "quat_scale_to_covar_preci")),
    ):
        for name in names:
            monkeypatch.setattr(module, name, getattr(module, name))  # puts it back in the end
    dialect.patch()
    return gsplat


def trained(device, count=60, seed=0):
    """Parameters as gsplat's strategies expect them, and an optimiser for each."""
    scene = scenes.cast(scenes.random_scene(seed, count, degree=1, sigma=(0.05, 0.5)), torch.float32, device)
    params = as_gsplat_has_it(scene) | {"colors": scene["shs"]}
    params |= {"scales": params["scales"].log(), "opacities": params["opacities"].logit()}
    params = torch.nn.ParameterDict({name: torch.nn.Parameter(value) for name, value in params.items()})
    return params, {name: torch.optim.Adam([value], lr=1e-3) for name, value in params.items()}


def activated(params):
    """What `rasterization` renders of them."""
    scales, opacities = params["scales"].exp(), params["opacities"].sigmoid().reshape(-1)
    return {name: params[name] for name in ("means", "quats", "colors")} | {"scales": scales, "opacities": opacities}


def step_once(params, optimizers, cameras, before=lambda meta: None, **options):
    """One step of training towards grey; what `rasterization` returned."""
    images, alphas, meta = render(activated(params), cameras, sh_degree=1, **options)
    before(meta)
    (images - 0.5).square().mean().backward()
    for optimizer in optimizers.values():
        optimizer.step()
        optimizer.zero_grad(set_to_none=True)
    return images, alphas, meta


@BOTH_LAYOUTS
@pytest.mark.parametrize("absgrad", [False, True], ids=["grad", "absgrad"])
def test_default_strategy_runs_on_our_meta(device, packed, absgrad, patched):
    """Statistics, growth, pruning and reset: the numbers of Gaussians are those that the rules give."""
    params, optimizers = trained(device)
    cameras = cameras_of(torch.float32, device)
    strategy = patched.DefaultStrategy(
        refine_start_iter=1, refine_every=4, grow_grad2d=0.0, prune_opa=0.2, absgrad=absgrad, refine_scale2d_stop_iter=3
    )
    strategy.check_sanity(params, optimizers)
    state = strategy.initialize_state()
    norms, counts = torch.zeros(60, device=device), torch.zeros(60, device=device)
    for step in range(5):

        def before(meta, step=step):
            strategy.step_pre_backward(params, optimizers, state, step, meta)

        _, _, meta = step_once(params, optimizers, cameras, before, packed=packed, absgrad=absgrad)
        scaled = meta["means2d"].absgrad if absgrad else meta["means2d"].grad
        scaled = scaled * torch.tensor([WIDTH, HEIGHT], device=device)  # half of each, and two cameras
        if packed:
            ids = meta["gaussian_ids"]
        else:
            drawn = (meta["radii"] > 0).all(-1)
            ids, scaled = drawn.nonzero()[:, 1], scaled[drawn]
        norms.index_add_(0, ids, scaled.norm(dim=-1))
        counts.index_add_(0, ids, torch.ones(len(ids), device=device))
        if step == 4:
            grown = (norms > 0).sum().item()
            faint = params["opacities"].sigmoid() < 0.2
            expected = 60 + grown - faint.sum() - (faint & (norms > 0)).sum()
        strategy.step_post_backward(params, optimizers, state, step, meta, packed=packed)
        if step < 4:
            torch.testing.assert_close(state["grad2d"], norms)
            assert torch.equal(state["count"], counts)
    assert grown > 30 and faint.sum() > 0
    assert len(params["means"]) == expected and (params["opacities"].sigmoid() >= 0.2).all()
    assert all(len(optimizers[name].state[value]["exp_avg"]) == expected for name, value in params.items())

    patched.strategy.ops.reset_opa(params, optimizers, state, value=0.4)
    assert params["opacities"].sigmoid().max() <= 0.4 + 1e-6
    images, _, _ = step_once(params, optimizers, cameras, packed=packed, absgrad=absgrad)
    assert images.isfinite().all()


@BOTH_LAYOUTS
@pytest.mark.parametrize("column", [False, True], ids=["vector", "column"])
def test_mcmc_strategy_runs_on_our_meta(device, packed, column, patched):
    """With our relocation: dead Gaussians move to living ones, whose places they share, and 5% are added."""
    params, optimizers = trained(device)
    if column:  # as nerfstudio has them
        params["opacities"] = torch.nn.Parameter(params["opacities"].detach()[:, None])
        optimizers["opacities"] = torch.optim.Adam([params["opacities"]], lr=1e-3)
    with torch.no_grad():
        params["opacities"][:10] = -8.0  # sigmoid 3.4e-4
    cameras = cameras_of(torch.float32, device)
    strategy = patched.MCMCStrategy(cap_max=65, refine_start_iter=0, refine_every=1, noise_lr=1e3)
    strategy.check_sanity(params, optimizers)
    state = strategy.initialize_state()
    torch.manual_seed(0)
    for step, expected in enumerate((60, 63, 65, 65)):

        def before(meta, step=step):
            strategy.step_pre_backward(params, optimizers, state, step, meta)

        _, _, meta = step_once(params, optimizers, cameras, before, packed=packed)
        strategy.step_post_backward(params, optimizers, state, step, meta, lr=1e-4)
        assert len(params["means"]) == expected
        assert all(value.isfinite().all() for value in params.values())
    assert (params["opacities"].sigmoid() >= 0.0049).all()


def test_splatfactos_call(patched, device):
    """The keywords that nerfstudio calls with, and what it does with the results."""
    params, _ = trained(device)
    cameras = cameras_of(torch.float32, device, 1)
    options = {"near_plane": 0.01, "far_plane": 1e10, "render_mode": "RGB+ED", "sh_degree": 0, "packed": False}
    options |= {"sparse_grad": False, "absgrad": True, "rasterize_mode": "classic", "width": WIDTH, "height": HEIGHT}
    render_, alpha, info = patched.rendering.rasterization(**activated(params), **cameras, **options)
    rgb = (render_[:, ..., :3] + (1 - alpha) * torch.ones(3, device=device)).clamp(0, 1)
    assert rgb.squeeze(0).shape == (HEIGHT, WIDTH, 3) and render_[:, ..., 3:4].squeeze(0).shape == (HEIGHT, WIDTH, 1)
    info["means2d"].retain_grad()
    rgb.sum().backward()
    assert info["means2d"].grad.shape == info["means2d"].absgrad.shape == (1, 60, 2)


def test_patching_puts_ours_in_the_place_of_gsplats():
    """Before 1.5 a splat had one radius, which the strategies of that time read."""
    pytest.importorskip("gsplat", reason="needs gsplat, of the extra test")
    code = """
        import sys, torch
        import gsplat as theirs
        from analytic_rasterizer.dialects import gsplat
        theirs.__version__ = sys.argv[1]
        gsplat.patch()
        from gsplat import rasterization
        from gsplat.rendering import rasterization as again
        from gsplat.strategy import ops
        assert rasterization is again and ops.compute_relocation is gsplat.compute_relocation
        assert theirs.relocation.compute_relocation is gsplat.compute_relocation
        assert ops.quat_scale_to_covar_preci is gsplat.quat_scale_to_covar_preci
        K = torch.tensor([[9.0, 0, 4], [0, 9, 4], [0, 0, 1]])[None]
        scene = torch.tensor([[0, 0, 3.0]]), torch.eye(4)[:1], torch.tensor([[1.0, 0.1, 0.1]])
        _, _, meta = rasterization(*scene, torch.ones(1), torch.ones(1, 3), torch.eye(4)[None], K, 8, 8, packed=False)
        print(meta["radii"].tolist())
    """
    # 3.33 sqrt(9 + 0.3) and 3.33 sqrt(0.09 + 0.3) px
    assert run_python(code, "1.5.3").strip() == "[[[11, 3]]]"
    assert run_python(code, "1.4.0").strip() == "[[11]]"


def test_gsplat_need_not_be_installed():
    code = """
        import sys
        sys.modules["gsplat"] = None
        from analytic_rasterizer.dialects import gsplat
        try:
            gsplat.patch()
        except ImportError:
            print("missing")
    """
    assert run_python(code).strip() == "missing"


@each_precision
def test_covariances_and_their_inverses(device, dtype, reference):
    scene = scene_of(torch.float64, "cpu")
    quats, scales = scene["quats"].reshape(2, 20, 4), scene["scales"].reshape(2, 20, 3)
    for triu in (False, True):
        expected = reference._quat_scale_to_covar_preci(quats, scales, triu=triu)
        actual = dialect.quat_scale_to_covar_preci(quats.to(device, dtype), scales.to(device, dtype), triu=triu)
        for a, e in zip(actual, expected):
            rounding = 20 * torch.finfo(dtype).eps * e.abs().amax(-1, keepdim=True).amax()
            assert a.shape == e.shape and (a.cpu() - e).abs().max() <= rounding
    assert dialect.quat_scale_to_covar_preci(quats, scales, compute_preci=False)[1] is None
    assert dialect.quat_scale_to_covar_preci(quats, scales, compute_covar=False)[0] is None
    identity, _ = dialect.quat_scale_to_covar_preci(torch.zeros(4), torch.tensor([1.0, 2.0, 3.0]))
    assert torch.equal(identity, torch.diag(torch.tensor([1.0, 4.0, 9.0])))
    with pytest.raises(ValueError, match=r"quats must have shape \(\.\.\., 4\) and scales \(\.\.\., 3\)"):
        dialect.quat_scale_to_covar_preci(torch.zeros(3), torch.zeros(3))


def test_autocast_does_not_round_covariances():
    scene = scene_of(torch.float32, "cpu")
    expected = dialect.quat_scale_to_covar_preci(scene["quats"], scene["scales"])
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert all(map(torch.equal, dialect.quat_scale_to_covar_preci(scene["quats"], scene["scales"]), expected))


BINOMS = torch.tensor([[math.comb(n, k) for k in range(51)] for n in range(51)], dtype=torch.float64)


def relocated(opacity, scale, copies):
    """The formula of the paper, term by term, in exact integers and float64."""
    new = 1 - (1 - opacity) ** (1 / copies)
    terms = (
        math.comb(i - 1, k) * (-1) ** k * new ** (k + 1) / math.sqrt(k + 1)
        for i in range(1, copies + 1)
        for k in range(i)
    )
    return new, opacity / math.fsum(terms) * scale


@each_precision
@pytest.mark.parametrize("column", [False, True], ids=["vector", "column"])
def test_relocation_is_the_papers_formula(device, dtype, column):
    opacities, copies = torch.meshgrid(
        *(torch.tensor(v, dtype=torch.float64) for v in ([0.005, 0.1, 0.5, 0.9, 0.999], [1, 2, 5, 51])), indexing="ij"
    )
    opacities, copies = opacities.flatten().to(dtype), copies.flatten().long()
    scales = torch.rand(20, 3, dtype=torch.float64).to(dtype)
    given = opacities[:, None] if column else opacities
    on_device = (t.to(device) for t in (given, scales, copies, BINOMS.to(dtype)))
    new, new_scales = compute_relocation(*on_device, 51)
    assert new.shape == given.shape and new.dtype == dtype
    rtol = 1e-6 if dtype == torch.float32 else 1e-11
    for i in range(20):
        opacity, factor = relocated(opacities[i].item(), 1.0, copies[i].item())
        assert new.reshape(-1)[i].item() == pytest.approx(opacity, rel=rtol)
        # For an opacity of 0.999 alternating terms of up to e^7 / sqrt(7) leave a sum of 0.3.
        torch.testing.assert_close(new_scales[i].cpu(), factor * scales[i], rtol=rtol, atol=0)


def test_relocation_checks_shapes():
    copies = torch.ones(4, dtype=torch.int64)
    with pytest.raises(ValueError, match=r"scale_old must have shape \(4, 3\), got \(3, 3\)"):
        compute_relocation(torch.ones(4), torch.ones(3, 3), copies, BINOMS, 51)
    with pytest.raises(TypeError, match="N must be a tensor, got int"):
        compute_relocation(torch.ones(4), torch.ones(4, 3), 2, BINOMS, 51)


# --- the operators ------------------------------------------------------------------------------------


class OurOps(TorchDispatchMode):
    """Records the calls of our operators, with their arguments, and counts those of torch's."""

    def __init__(self):
        super().__init__()
        self.ours, self.others = [], []

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        if func.namespace == "analytic_rasterizer":
            self.ours.append((func, args, kwargs or {}))
        else:
            self.others.append(func._schema.name)
        return func(*args, **(kwargs or {}))


@pytest.mark.parametrize("packed", [True, False])
@pytest.mark.parametrize("render_mode", ["RGB", "RGB+ED", "D"])
def test_a_call_is_few_operators(device, packed, render_mode):
    """Cameras, rows, images: nothing of a picture is computed between them."""
    scene, cameras = scene_of(torch.float32, device, degree=1), cameras_of(torch.float32, device, count=1)
    with OurOps() as mode:
        render(scene, cameras, sh_degree=1, packed=packed, render_mode=render_mode)
    assert [func._schema.name.split("::")[1] for func, *_ in mode.ours] == ["prepare_cameras", "project", "composite"]
    assert len(mode.others) <= (10 if packed else 7), mode.others  # on the CPU a look at Ks; ids of meta


@pytest.mark.parametrize("packed", [True, False])
def test_opcheck_of_rows(device, packed):
    """Of a table, and with given values, which the stages do not ask for."""
    scene, cameras = scenes.leaves(scene_of(torch.float32, device)), cameras_of(torch.float32, device)
    with OurOps() as mode:
        images, _, meta = render(scene, cameras, packed=packed, render_mode="RGB-Ed", rasterize_mode="antialiased")
        (images.sum() + meta["depths"].sum()).backward()
    checks = ["test_schema", "test_faketensor"]
    found = {func._schema.name.split("::")[1]: (func, args, kwargs) for func, args, kwargs in mode.ours}
    assert {"project", "project_vjp", "composite", "composite_vjp"} <= found.keys()
    for func, args, kwargs in found.values():
        torch.library.opcheck(func, args, kwargs, test_utils=checks)


@pytest.mark.parametrize("packed", [True, False])
@pytest.mark.parametrize("kinds", [("z", "distance"), ("distance", "z"), ("model", "none")])
def test_gradcheck_of_rows(packed, kinds):
    """All that a row has, of several cameras, by differences: both kinds of depth, colours and given values."""
    scene, cameras = scene_of(torch.float64, "cpu", degree=1, count=5), cameras_of(torch.float64, "cpu")
    with OurOps() as mode:
        render(scene, cameras, sh_degree=1)
    (_, args, kwargs), = [call for call in mode.ours if call[0]._schema.name.endswith("::project")]  # fmt: skip
    op = torch.ops.analytic_rasterizer.project
    names = [argument.name for argument in op.default._schema.arguments]
    named = dict(zip(names, args)) | kwargs
    named |= {"order": kinds[0], "shown": kinds[1], "table": [] if packed else [2, 5]}
    named["values"] = torch.rand(2, 5, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    moved = ("means3D", "opacities", "shs", "scales", "rotations", "viewmatrix", "campos", "values")
    leaves = [named[name].detach().clone().requires_grad_() for name in moved]

    def rows(*tensors):
        return op(**named | dict(zip(moved, tensors)))[:5]

    torch.autograd.gradcheck(rows, leaves, atol=1e-6, rtol=1e-4)
