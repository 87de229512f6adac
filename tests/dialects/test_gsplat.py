"""gsplat's call: its signature, its semantics by its own torch reference, our rasterizer's pictures and gradients, and
what its filter does to splats."""

import inspect
import math

import pytest
import scenes
import torch
from gsplat_calls import (
    BOTH_LAYOUTS,
    HEIGHT,
    WIDTH,
    alphas_of,
    assert_gradients_close,
    cameras_of,
    composited,
    drop_in,
    gradient_tolerance,
    gradients,
    projected,
    render,
    scene_of,
    smooth_call,
    tolerance,
)
from marks import each_kind, each_precision
from weights import weighted_sums, weights

import analytic_rasterizer as ar
from analytic_rasterizer.dialects import gsplat as dialect
from analytic_rasterizer.dialects.gsplat import rasterization


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
