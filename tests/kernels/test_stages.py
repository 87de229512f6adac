"""The public stages make what the rasterizer makes, with gradients, for any number of channels and cameras."""

import dataclasses
import weakref

import pytest
import scenes
import torch
from gsplat_calls import assert_gradients_close, gradients
from marks import each_kind, each_precision
from scenes import KINDS, Camera, name_of
from weights import weighted_sums, weights

import analytic_rasterizer as ar

CAMERA = Camera(image_width=27, image_height=21, bg=(0.1, 0.3, 0.2))


def scene_of(dtype, device, seed=3, count=30, degree=1):
    return scenes.without(scenes.cast(scenes.random_scene(seed, count, degree), dtype, device), "means2D")


def settings_of(dtype, device, variant=("box", {"samples": 4}), camera=CAMERA, **more):
    return dataclasses.replace(camera, sh_degree=1).settings(dtype, device, variant)._replace(**more)


def tolerances(dtype):
    """Of values and of gradients: rounding, through one more matrix of a covariance than the rasterizer needs."""
    return (1e-12, 1e-9) if dtype == torch.float64 else (2e-6, 2e-3)


@each_precision
@each_kind
def test_stages_make_the_picture_of_the_rasterizer(device, dtype, variant):
    settings = settings_of(dtype, device, variant)
    scene, again = (scenes.leaves(scene_of(dtype, device)) for _ in range(2))
    color, radii = ar.GaussianRasterizer(settings)(means2D=None, **scene)
    splats = ar.project(settings, **again)
    image, alpha = ar.blend(splats, ar.list_tiles(splats), background=settings.bg)
    assert image.shape == (1, 3, 21, 27) and alpha.shape == (1, 1, 21, 27)
    assert (image[0] - color).abs().max() <= tolerances(dtype)[0]
    assert torch.equal(radii[splats.gaussian_ids.long()], splats.radii) and len(splats.radii) == (radii > 0).sum()

    g = weights(color.shape, dtype, device)
    assert_gradients_close(gradients((image[0] * g).sum(), again), gradients((color * g).sum(), scene), dtype)


@each_precision
def test_several_cameras_are_each_of_them(device, dtype):
    cameras = [CAMERA, dataclasses.replace(CAMERA, eye=(1.5, 0.4, -3.2)), dataclasses.replace(CAMERA, tanfovx=0.3)]
    settings = [settings_of(dtype, device, camera=camera) for camera in cameras]
    scene = scenes.leaves(scene_of(dtype, device))
    splats = ar.project(settings, **scene)
    assert splats.cameras == 3 and splats.row_splits[-1] == len(splats.means2d)
    image, alpha = ar.blend(splats, ar.list_tiles(splats))
    g = weights(image.shape, dtype, device)
    together = gradients((image * g).sum(), scene)
    total = {name: torch.zeros_like(value) for name, value in scene.items()}
    for c, of_camera in enumerate(settings):
        alone = ar.project(of_camera, **scene)
        rows = slice(int(splats.row_splits[c]), int(splats.row_splits[c + 1]))
        assert torch.equal(splats.means2d[rows], alone.means2d) and (splats.camera_ids[rows] == c).all()
        assert torch.equal(splats.gaussian_ids[rows], alone.gaussian_ids)
        own, own_alpha = ar.blend(alone, ar.list_tiles(alone))
        assert torch.equal(image[c], own[0]) and torch.equal(alpha[c], own_alpha[0])
        for name, grad in gradients((own[0] * g[c]).sum(), scene).items():
            total[name] += grad
    assert_gradients_close(together, total, dtype)


@each_precision
def test_cameras_in_a_batch_have_gradients(device, dtype):
    effects = ar.Effects(camera_gradients=True, defocus=ar.Defocus(0.05, 3.0))
    scene = scene_of(dtype, device)

    def image_of(views):
        settings = [settings_of(dtype, device, effects=effects)._replace(viewmatrix=view) for view in views]
        splats = ar.project(settings, **scene)
        return ar.blend(splats, ar.list_tiles(splats))[0]

    views = [CAMERA.fields(dtype, device)["viewmatrix"].requires_grad_() for _ in range(2)]
    image = image_of(views)
    g = weights(image.shape, dtype, device)
    together = torch.autograd.grad((image * g).sum(), views)
    for c, view in enumerate(views):
        alone = torch.autograd.grad((image_of([view])[0] * g[c]).sum(), view)[0]
        torch.testing.assert_close(together[c], alone, rtol=tolerances(dtype)[1], atol=0)


def pad(tensor, dim):
    """With zeros up to three of dimension `dim`."""
    shape = list(tensor.shape)
    shape[dim] = 3 - shape[dim]
    return torch.cat([tensor, tensor.new_zeros(shape)], dim)


# --- channels ----------------------------------------------------------------------------------------


@each_precision
@pytest.mark.parametrize("channels", [1, 2, 4, 5, 32, 33, 70])
def test_channels_are_blended_like_colours(device, dtype, channels):
    """Any number in one pass: the image and the gradients of three at a time."""
    settings = settings_of(dtype, device)
    scene = scene_of(dtype, device)
    del scene["shs"]
    features = weights((30, channels), dtype, device)
    background = weights((channels,), dtype, device, seed=1)
    g = weights((channels, 21, 27), dtype, device, seed=2)

    leaves = scenes.leaves(scene | {"colors_precomp": features})
    color, radii = ar.GaussianRasterizer(settings._replace(bg=background))(means2D=None, **leaves)
    actual = gradients((color * g).sum(), leaves)

    total = {name: torch.zeros_like(value) for name, value in leaves.items()}
    for first in range(0, channels, 3):
        part = slice(first, min(first + 3, channels))
        width = part.stop - part.start
        three = scenes.leaves(scene | {"colors_precomp": pad(features[:, part], 1)})
        of_three = settings._replace(bg=pad(background[part], 0))
        own, own_radii = ar.GaussianRasterizer(of_three)(means2D=None, **three)
        assert torch.equal(own_radii, radii)
        assert (own[:width] - color[part]).abs().max() <= tolerances(dtype)[0]
        for name, grad in gradients((own[:width] * g[part]).sum(), three).items():
            if name == "colors_precomp":
                total[name][:, part] = grad[:, :width]
            else:
                total[name] += grad
    assert_gradients_close(actual, total, dtype)


def count_calls(call, name):
    """How often an op of ours runs."""
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CPU]) as profiler:
        call()
    return sum(event.count for event in profiler.key_averages() if event.key == f"analytic_rasterizer::{name}")


def test_many_channels_take_one_backward_pass(device):
    settings = settings_of(torch.float32, device, effects=ar.Effects(alpha=True, depth=True, inverse_depth=True))
    scene = scene_of(torch.float32, device)
    del scene["shs"]
    leaves = scenes.leaves(scene | {"colors_precomp": weights((30, 64), torch.float32, device)})
    settings = settings._replace(bg=torch.zeros(64, device=device))

    def forward_backward():
        color, _, outputs = ar.GaussianRasterizer(settings)(means2D=None, **leaves)
        (color.sum() + outputs.alpha.sum() + outputs.depth.sum() + outputs.inverse_depth.sum()).backward()

    assert count_calls(forward_backward, "rasterize_vjp") == 1
    assert count_calls(forward_backward, "rasterize") == 1


@each_precision
@pytest.mark.parametrize("channels", [3, 40])
def test_depth_is_a_channel(device, dtype, channels):
    """Depth and inverse depth, as extra channels of z, of colours from harmonics and of many features."""
    effects = ar.Effects(alpha=True, depth=True, inverse_depth=True)
    settings = settings_of(dtype, device, effects=effects)._replace(bg=torch.full((channels,), 0.2).to(device, dtype))
    scene = scene_of(dtype, device)
    if channels != 3:
        del scene["shs"]
        scene["colors_precomp"] = weights((30, channels), dtype, device)
    leaves, again = scenes.leaves(scene), scenes.leaves(scene)
    color, _, outputs = ar.GaussianRasterizer(settings)(means2D=None, **leaves)
    planes = torch.cat([color, outputs.depth, outputs.inverse_depth, outputs.alpha])
    g = weights(planes.shape, dtype, device)
    actual = gradients((planes * g).sum(), leaves)

    plain = settings_of(dtype, device)
    features = again.get("colors_precomp")
    splats = ar.project(plain, **scenes.without(again, "colors_precomp"))
    features = splats.colors if features is None else features[splats.gaussian_ids.long()]
    table = torch.cat([features, splats.depths[:, None], 1 / splats.depths[:, None]], 1)
    background = torch.cat([settings.bg, settings.bg.new_zeros(2)])
    image, alpha = ar.blend(splats, ar.list_tiles(splats), table, background)
    expected_planes = torch.cat([image[0], alpha[0]])
    assert (planes - expected_planes).abs().max() <= 5 * tolerances(dtype)[0]
    assert_gradients_close(actual, gradients((expected_planes * g).sum(), again), dtype)


@each_precision
@pytest.mark.parametrize("channels", [3, 5, 40])
def test_absolute_gradients_are_of_all_channels(device, dtype, channels):
    """means2D (P, 4): sums over pixels of |dL/dmean|, where a pixel's gradient is that of all its channels."""
    camera = Camera(image_width=6, image_height=5)
    background = torch.zeros(channels, dtype=dtype, device=device)
    settings = camera.settings(dtype, device, footprint="box", samples=4)._replace(bg=background)
    scene = scenes.without(scenes.cast(scenes.random_scene(4, 8), dtype, device), "shs", "means2D")
    scene["colors_precomp"] = weights((8, channels), dtype, device)
    g = weights((channels, 5, 6), dtype, device, seed=1) - 0.5
    means2D = torch.zeros(8, 4, dtype=dtype, device=device, requires_grad=True)
    color, _ = ar.GaussianRasterizer(settings)(means2D=means2D, **scene)
    (color * g).sum().backward()
    expected = torch.zeros(8, 2, dtype=dtype, device=device)
    for y in range(5):
        for x in range(6):
            single = torch.zeros(8, 3, dtype=dtype, device=device, requires_grad=True)
            color, _ = ar.GaussianRasterizer(settings)(means2D=single, **scene)
            (color[:, y, x] * g[:, y, x]).sum().backward()
            expected += single.grad[:, :2].abs()
    close = {"rtol": tolerances(dtype)[1], "atol": 1e-5 * expected.max().item()}
    torch.testing.assert_close(means2D.grad[:, 2:], expected, **close)

    splats = ar.project(settings, **scenes.without(scene, "colors_precomp"))
    absolute = torch.zeros_like(splats.means2d, requires_grad=True)
    features = scene["colors_precomp"][splats.gaussian_ids.long()]
    image, _ = ar.blend(splats, ar.list_tiles(splats), features, means2d_abs=absolute)
    (image[0] * g).sum().backward()
    half = torch.tensor([3.0, 2.5], dtype=dtype, device=device)
    torch.testing.assert_close(absolute.grad * half, expected[splats.gaussian_ids.long()], **close)


@pytest.mark.parametrize("variant", [("moment", {"samples": 4}), ("moment", {"samples": 16})], ids=name_of)
@each_precision
def test_three_channels_in_rows_are_as_in_splats(device, dtype, variant):
    """Lists are so long that kernels cut them into segments; rows of three channels have other sums than colours."""
    camera = Camera(image_width=20, image_height=15)
    settings = settings_of(dtype, device, variant, camera)
    scene = scenes.random_scene(5, 3000, degree=1, opacity=(0.004, 0.05), spread=0.3)
    scene = scenes.cast(scenes.without(scene, "means2D"), dtype, device)
    g = weights((3, 15, 20), dtype, device, seed=2) - 0.5
    grads = []
    for in_rows in (False, True):
        leaves = scenes.leaves(scene)
        splats = ar.project(settings, **leaves)
        image, _ = ar.blend(splats, ar.list_tiles(splats), splats.colors if in_rows else None)
        (image[0] * g).sum().backward()
        grads.append({"image": image.detach(), **{name: leaf.grad for name, leaf in leaves.items()}})
    assert_gradients_close(grads[1], grads[0], dtype)


@each_precision
def test_a_depth_of_minus_zero_is_zero(device, dtype):
    """The caller's depths may have either sign of zero. Both are nearer than all others, and equal to each other."""
    splats = ar.project(settings_of(dtype, device), **scene_of(dtype, device))
    depths, mixed = splats.depths.clone(), splats.depths.clone()
    depths[::2] = mixed[::2] = 0.0
    mixed[::4] = -0.0
    pictures = []
    for given in (splats.depths, depths, mixed):
        rows = dataclasses.replace(splats, depths=given)
        pictures.append(ar.blend(rows, ar.list_tiles(rows))[0])
    in_order, zeros, signed = pictures
    assert torch.equal(signed, zeros)
    assert not torch.equal(zeros, in_order)  # the depths of zero do change the order


def test_a_channel_that_is_not_finite_culls_its_gaussian(device):
    settings = settings_of(torch.float32, device)._replace(bg=torch.zeros(8, device=device))
    scene = scene_of(torch.float32, device)
    del scene["shs"]
    features = weights((30, 8), torch.float32, device)
    bad = features.clone()
    bad[7, 5] = torch.nan
    color, radii = ar.GaussianRasterizer(settings)(means2D=None, colors_precomp=bad, **scene)
    kept = torch.arange(30, device=device) != 7
    others = {name: value[kept] for name, value in scene.items()}
    expected, others_radii = ar.GaussianRasterizer(settings)(means2D=None, colors_precomp=features[kept], **others)
    assert radii[7] == 0 and torch.equal(radii[kept], others_radii) and torch.equal(color, expected)


# --- gradients ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("precomputed", [False, True])
def test_gradcheck_of_project(precomputed):
    settings = [settings_of(torch.float64, "cpu"), settings_of(torch.float64, "cpu", camera=CAMERA.shifted(2, -3))]
    scene = scenes.smooth_scene(5, degree=1)
    del scene["means2D"]
    if precomputed:
        scene = scenes.with_precomputed(scene)
    leaves = scenes.leaves(scene)

    def rows(*values):
        s = ar.project(settings, **dict(zip(leaves, values)))
        return s.means2d, s.cov2d, s.opacities, s.depths, s.colors

    assert torch.autograd.gradcheck(rows, tuple(leaves.values()))


@pytest.mark.parametrize("variant", [v for v in KINDS if v[0] not in ("analytic", "erf")], ids=name_of)
def test_gradcheck_of_blend(variant):
    """`analytic` and `erf` hold the pixel's frame while they differentiate: their gradient is not the formula's."""
    settings = settings_of(torch.float64, "cpu", variant)
    scene = scenes.smooth_scene(5, degree=1)
    del scene["means2D"]
    with torch.no_grad():
        splats = ar.project(settings, **scene)
    leaves = [splats.means2d, splats.cov2d, splats.opacities, weights((len(splats.means2d), 5), torch.float64, "cpu")]
    leaves = [t.detach().clone().requires_grad_() for t in (*leaves, torch.ones(5, dtype=torch.float64))]

    def sums(means2d, cov2d, opacities, features, background):
        xx, xy, yy = cov2d.detach().unbind(1)
        rows = dataclasses.replace(splats, means2d=means2d, cov2d=cov2d, opacities=opacities, dets=xx * yy - xy * xy)
        return weighted_sums(ar.blend(rows, ar.list_tiles(rows), features, background))

    # Noise of the difference quotient: 1e-16 * |sum| (~1000) / 1e-6.
    assert torch.autograd.gradcheck(sums, leaves, eps=1e-6, atol=1e-6, rtol=1e-6)


def test_backgrounds_and_matrices_that_require_a_gradient_get_one(device):
    """Without any effect asked for."""
    dtype = torch.float64 if device == "cpu" else torch.float32
    scene = scene_of(dtype, device)
    plain = settings_of(dtype, device)
    bg, view = plain.bg.clone().requires_grad_(), plain.viewmatrix.clone().requires_grad_()
    color, _ = ar.GaussianRasterizer(plain._replace(bg=bg, viewmatrix=view))(means2D=None, **scene)
    g = weights(color.shape, dtype, device)
    grads = torch.autograd.grad((color * g).sum(), (bg, view))
    _, _, outputs = ar.GaussianRasterizer(plain._replace(effects=ar.Effects(alpha=True)))(means2D=None, **scene)
    torch.testing.assert_close(grads[0], ((1 - outputs.alpha) * g).sum((1, 2)), rtol=1e-5, atol=0)
    asked = plain._replace(effects=ar.Effects(camera_gradients=True), viewmatrix=view)
    color, _ = ar.GaussianRasterizer(asked)(means2D=None, **scene)
    torch.testing.assert_close(grads[1], torch.autograd.grad((color * g).sum(), view)[0])


# --- errors ------------------------------------------------------------------------------------------


def test_a_batch_is_split_into_its_cameras(device):
    """The rows of each, as if it had been projected alone, and gradients through them."""
    settings = [settings_of(torch.float32, device, camera=dataclasses.replace(CAMERA, eye=(x, 0, -4))) for x in (0, 1)]
    leaves = scenes.leaves(scene_of(torch.float32, device))
    batch = ar.project(settings, **leaves)
    for camera, splats in zip(settings, batch.split()):
        alone = ar.project(camera, **leaves)
        for name, value in vars(alone).items():
            found = getattr(splats, name)
            assert torch.equal(found, value) if torch.is_tensor(value) else found == value
        sums = (s.means2d.sum() for s in (splats, alone))
        got, expected = (torch.autograd.grad(total, leaves["means3D"], retain_graph=True)[0] for total in sums)
        assert torch.equal(got, expected) and expected.abs().max() > 0
    assert alone.split() == [alone]
    bare = scenes.without(leaves, "shs")
    assert [s.colors.shape for s in ar.project(settings, **bare).split()] == [(0, 3)] * 2


def test_gradients_of_cameras_are_added_up_in_blocks(device):
    """More Gaussians than a block has (kGradientBlock): the sum of two cameras' gradients has one rounding."""
    count = 2**18 + 5
    generator = torch.Generator().manual_seed(0)
    scene = {
        "means3D": torch.rand(count, 3, generator=generator) - 0.5,
        "scales": 0.01 + 0.01 * torch.rand(count, 3, generator=generator),
        "rotations": torch.randn(count, 4, generator=generator),
        "opacities": torch.rand(count, generator=generator),
        "colors_precomp": torch.rand(count, 3, generator=generator),
    }
    leaves = scenes.leaves({name: value.to(device) for name, value in scene.items()})
    settings = [settings_of(torch.float32, device, camera=dataclasses.replace(CAMERA, eye=(x, 0, -4))) for x in (0, 1)]

    def gradients_of(cameras):
        splats = ar.project(cameras, **leaves)
        rows = [splats.means2d, splats.cov2d, splats.opacities, splats.colors]
        ids = splats.gaussian_ids.float() / count  # rows of a Gaussian count differently from those of another
        total = sum((t.flatten(1) if t.dim() > 1 else t[:, None]).sum(1) @ ids for t in rows)
        return gradients(total, leaves).values()

    parts = [gradients_of([camera]) for camera in settings]
    for both, first, second in zip(gradients_of(settings), *parts):
        assert torch.equal(both, first + second) and first.abs().max() > 0


def test_lists_are_freed_as_soon_as_their_gradient_is_made(device):
    """Also while the loss is kept, as a training does until its optimizer has taken a step."""
    splats = ar.project(settings_of(torch.float32, device), **scenes.leaves(scene_of(torch.float32, device)))
    lists = ar.list_tiles(splats)
    held = weakref.ref(lists.tensors[0])
    loss = ar.blend(splats, lists)[0].sum()
    del lists
    assert held() is not None
    loss.backward()
    assert held() is None and loss.grad_fn is not None


def test_settings_of_a_batch_must_agree():
    scene = scene_of(torch.float32, "cpu")
    settings = settings_of(torch.float32, "cpu")
    with pytest.raises(ValueError, match="settings must agree in image_width, got 27 and 28 of camera 1"):
        ar.project([settings, settings._replace(image_width=28)], **scene)
    with pytest.raises(ValueError, match="at least one camera"):
        ar.project([], **scene)


def test_a_3d_filter_is_that_of_all_cameras():
    """It widens the Gaussians, which all cameras share."""
    scene = scene_of(torch.float32, "cpu")
    settings = settings_of(torch.float32, "cpu")
    width = torch.full((len(scene["means3D"]),), 0.1)
    filtered, again = (settings._replace(effects=ar.Effects(filter_3d=w)) for w in (width, width.clone()))
    assert torch.equal(ar.project([filtered, again], **scene).cov2d, ar.project([filtered] * 2, **scene).cov2d)
    other = settings._replace(effects=ar.Effects(filter_3d=2 * width))
    for cameras in ([settings, filtered], [filtered, settings], [filtered, again, other]):
        with pytest.raises(ValueError, match=f"settings must agree in filter_3d, but camera {len(cameras) - 1} has"):
            ar.project(cameras, **scene)


def test_stages_of_a_picture_before_an_image(device):
    settings = settings_of(torch.float32, device)
    settings = settings._replace(bg=torch.rand(3, settings.image_height, settings.image_width).to(device))
    scene = scene_of(torch.float32, device)
    color, _ = ar.GaussianRasterizer(settings)(means2D=None, **scene)
    assert torch.equal(ar.render_stages(settings, **scene).color, color)
    with pytest.raises(ValueError, match=r"bg must have shape \(3, "):
        ar.render_stages(settings._replace(bg=settings.bg[:, 1:]), **scene)


def test_another_default_device_changes_nothing():
    """ "meta" stands for any other device."""
    scene, settings = scene_of(torch.float32, "cpu"), settings_of(torch.float32, "cpu")

    def pictures():
        splats = ar.project([settings, settings], **scene)
        return [ar.blend(part, ar.list_tiles(part))[0] for part in splats.split()]

    expected = pictures()
    with torch.device("meta"):
        made = pictures()
    assert all(torch.equal(a, b) for a, b in zip(made, expected))


@pytest.mark.parametrize(
    "change, message",
    [
        ({"features": torch.zeros(3, 4)}, r"features must have shape \(N, K\) with N = \d+"),
        ({"features": torch.zeros(5)}, r"features must have shape \(\d+, K\), got \(5,\)"),
        ({"background": torch.zeros(2)}, r"background must have shape \(3,\) or \(1, 3\), got \(2,\)"),
        ({"means2d_abs": torch.zeros(2, 2)}, r"means2d_abs must have shape \(N, 2\)"),
    ],
    ids=["rows", "vector", "background", "absolute"],
)
def test_blend_says_what_is_wrong(change, message):
    splats = ar.project(settings_of(torch.float32, "cpu"), **scene_of(torch.float32, "cpu"))
    with pytest.raises(ValueError, match=message):
        ar.blend(splats, ar.list_tiles(splats), **change)


def test_what_is_no_tensor_and_no_camera_is_named():
    splats = ar.project(settings_of(torch.float32, "cpu"), **scene_of(torch.float32, "cpu"))
    lists = ar.list_tiles(splats)
    with pytest.raises(TypeError, match="background must be a tensor, got list"):
        ar.blend(splats, lists, background=[0, 0, 0])
    with pytest.raises(TypeError, match="means2d_abs must be a tensor, got list"):
        ar.blend(splats, lists, means2d_abs=[0, 0])
    for camera in (-1, 1):
        with pytest.raises(IndexError, match=f"camera must be 0 to 0, got {camera}"):
            lists.of_camera(camera)


@pytest.mark.parametrize("op", ["project", "count_rows"])
def test_a_number_in_place_of_means_is_named(op):
    settings, scene = settings_of(torch.float32, "cpu"), scene_of(torch.float32, "cpu")
    gaussians, cameras = ar.stages.project_arguments([settings], **scene, colors_precomp=None, cov3D_precomp=None)
    gaussians["means3D"] = torch.tensor(1.0)
    with pytest.raises(ValueError, match=r"means3D must have shape \(P, 3\)"):
        getattr(torch.ops.analytic_rasterizer, op)(**gaussians, **cameras)


def test_lists_of_other_splats_are_refused(device):
    settings, scene = settings_of(torch.float32, device), scene_of(torch.float32, device)
    splats = ar.project(settings, **scene)
    fewer = ar.project(settings, **{name: value[:9] for name, value in scene.items()})
    with pytest.raises(ValueError, match="lists must be the output of list_tiles for these splats"):
        ar.blend(splats, ar.list_tiles(fewer))
    larger = ar.project(settings._replace(image_width=99), **scene)
    with pytest.raises(ValueError, match="must be what the forward pass saved"):
        ar.blend(larger, ar.TileLists(ar.list_tiles(splats).tensors, 1))


def test_no_gaussians_no_splats(device):
    settings = settings_of(torch.float32, device)
    scene = {name: value[:0] for name, value in scene_of(torch.float32, device).items()}
    splats = ar.project(settings, **scenes.leaves(scene))
    image, alpha = ar.blend(splats, ar.list_tiles(splats), background=settings.bg)
    assert len(splats.means2d) == 0 and (alpha == 0).all()
    assert torch.equal(image[0], settings.bg[:, None, None].expand(3, 21, 27))
    image.sum().backward()
