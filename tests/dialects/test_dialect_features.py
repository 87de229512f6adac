"""What single dialects draw beside colours: features, counts, depths, and which Gaussians are visible."""

import dataclasses
import math

import pytest
import scenes
import torch
from marks import each_precision
from originals import CAMERA, COUNT, arguments_of, plain, probe, relative_error, render, scene_of, settings_of
from processes import run_python

import analytic_rasterizer as ar
import diff_gaussian_rasterization as drop_in
from analytic_rasterizer import dialects

pytestmark = pytest.mark.usefixtures("nothing_chosen")


@pytest.mark.parametrize("name", ["gs2023", "scaffold"])
def test_visible_filter_is_the_radii_of_a_picture(device, name):
    scene = scene_of(device)
    scene["means3D"][::3] *= 10  # outside
    rasterizer = drop_in.GaussianRasterizer(settings_of(name, device))
    geometry = {key: scene[key] for key in ("means3D", "scales", "rotations")}
    found = rasterizer.visible_filter(**geometry, cov3D_precomp=None)
    assert found.dtype == torch.int32 and (found == 0).any() and (found > 0).any()
    assert torch.equal(found, rasterizer(**scene | {"opacities": torch.ones(COUNT, 1, device=device)})[1])
    assert rasterizer.visible_filter(*(value[:0] for value in geometry.values())).shape == (0,)


FEATURES = {
    "langsplat": ("language_feature_precomp", 3),
    "grouping": ("sh_objs", 16),
    "feature3dgs": ("semantic_feature", 7),
}


@each_precision
@pytest.mark.parametrize("name, key, channels", [(name, *feature) for name, feature in FEATURES.items()])
@pytest.mark.parametrize("colors", ["shs", "colors_precomp"])
def test_features_are_blended_like_colors(device, dtype, name, key, channels, colors):
    """In one pass what two pictures show, and the gradients of both."""
    feature = torch.rand(COUNT, channels, dtype=dtype, device=device)
    scene = scene_of(device, dtype)
    if colors == "colors_precomp":
        scene |= {"shs": None, "colors_precomp": torch.rand(COUNT, 3, dtype=dtype, device=device)}
    ours, theirs = ({k: v if v is None else v.clone().requires_grad_() for k, v in scene.items()} for _ in range(2))
    of_ours, of_theirs = (feature.clone().requires_grad_() for _ in range(2))
    shaped = of_ours if name == "langsplat" else of_ours[:, None]
    made = render(name, device, dtype, scene=ours | {key: shaped}, include_feature=True)
    # color, and the other picture: after it, or after the radii
    color, image = made[0], made[2] if name == "grouping" else made[1]
    expected = plain(device, dtype, "point", scene=theirs)[0]
    of_features = scenes.without(theirs, "shs") | {"colors_precomp": of_theirs}
    black = CAMERA.settings(dtype, device, footprint="point")._replace(bg=expected.new_zeros(channels))
    expected_image = ar.GaussianRasterizer(black)(**of_features)[0]
    tolerance = 1e-12 if dtype == torch.float64 else 2e-6
    assert (color - expected).abs().max() <= tolerance and (image - expected_image).abs().max() <= tolerance
    ((color * probe(color)).sum() + (image * probe(image)).sum()).backward()
    ((expected * probe(color)).sum() + (expected_image * probe(image)).sum()).backward()
    assert relative_error(of_ours.grad, of_theirs.grad) < 10 * tolerance
    for name_of_input, leaf in ours.items():
        if leaf is not None:
            # Two passes add up rounded gradients, and the colour's direction passes through one more projection.
            assert relative_error(leaf.grad, theirs[name_of_input].grad) < 1000 * tolerance, name_of_input


def test_features_and_a_background_that_is_an_image():
    """The image lies behind the colours, nothing behind the features."""
    behind = torch.rand(3, 30, 40, generator=torch.Generator().manual_seed(3))
    objects = torch.rand(COUNT, 1, 16, generator=torch.Generator().manual_seed(4))
    scene = scene_of() | {"sh_objs": objects}
    over_black = render("grouping", scene=scene, bg=torch.zeros(3), effects=ar.Effects(alpha=True))
    made = render("grouping", scene=scene, bg=behind)
    expected = over_black[0] + (1 - over_black[3].alpha) * behind
    assert (made[0] - expected).abs().max() < 1e-6 and (made[2] - over_black[2]).abs().max() < 1e-6


def test_gaussians_whose_features_are_not_finite_are_culled(device):
    """As with colours that are not; the others are drawn as without them."""
    scene = scene_of(device)
    objects = torch.rand(COUNT, 1, 16, device=device)
    scene["sh_objs"] = objects.clone()
    scene["sh_objs"][[3, 11], 0, 15] = math.nan
    left = torch.ones(COUNT, dtype=torch.bool)
    left[[3, 11]] = False
    made = render("grouping", device, scene=scene)
    expected = render("grouping", device, scene={k: v[left] for k, v in scene.items()})
    assert (made[1][~left] == 0).all() and (render("grouping", device, scene=scene | {"sh_objs": objects})[1] > 0).all()
    assert all(map(torch.equal, (made[0], made[1][left], made[2]), expected))


def test_the_background_has_its_gradient_beside_features(device):
    bg = torch.rand(3, device=device, requires_grad=True)
    scene = arguments_of("grouping", device, sh_objs=torch.rand(COUNT, 1, 5, device=device))
    color, _, image = render("grouping", device, scene=scene, bg=bg)
    ((color * probe(color)).sum() + image.sum()).backward()
    expected = bg.detach().clone().requires_grad_()
    settings = CAMERA.settings(torch.float32, device, footprint="point")._replace(bg=expected)
    color = ar.GaussianRasterizer(settings)(**scene_of(device))[0]
    (color * probe(color)).sum().backward()
    assert torch.allclose(bg.grad, expected.grad, rtol=1e-5)


def test_wrong_features(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # where debug writes its dump
    with pytest.raises(ValueError, match=r"features must have shape \(P, K\) with P = 25 .*, got \(24, 3\)"):
        render("langsplat", scene=scene_of() | {"language_feature_precomp": torch.zeros(24, 3)}, include_feature=True)
    with pytest.raises(TypeError, match="features must be a tensor, got list"):
        render("langsplat", scene=scene_of() | {"language_feature_precomp": []}, include_feature=True)
    with pytest.raises(ValueError, match=r"features must come with shs or colors_precomp \(P, 3\), got \(P, 4\)"):
        given = {"shs": None, "colors_precomp": torch.zeros(COUNT, 4), "sh_objs": torch.zeros(COUNT, 1, 16)}
        render("grouping", scene=scene_of() | given, bg=torch.zeros(4))
    with pytest.raises(ValueError, match=r"features must be finite, got nan at \(2, 1\)"):
        nan = torch.zeros(COUNT, 3).index_put((torch.tensor(2), torch.tensor(1)), torch.tensor(math.nan))
        render("langsplat", scene=scene_of() | {"language_feature_precomp": nan}, include_feature=True, debug=True)
    with pytest.raises(ValueError, match="language_feature_precomp must be given"):
        render("langsplat", include_feature=True)
    with pytest.raises(ValueError, match=r"exactly one|shs"):
        both = {"colors_precomp": torch.zeros(COUNT, 3), "sh_objs": torch.zeros(COUNT, 1, 16)}
        render("grouping", scene=scene_of() | both)


@pytest.mark.parametrize(
    "name, further, error, message",
    [
        ("accel", {"dc": [1.0]}, TypeError, "dc must be a tensor, got list"),
        ("accel", {"dc": torch.zeros(5, 1, 3)}, ValueError, r"dc must have shape \(P, 1, 3\) .*, got \(5, 1, 3\) and"),
        ("accel", {"dc": torch.zeros(COUNT, 3)}, ValueError, r"dc must have shape \(P, 1, 3\) .*, got \(25, 3\) and"),
        ("accel", {"dc": torch.zeros(COUNT, 1, 3).double()}, TypeError, "dc must have the dtype of shs"),
        ("grouping", {"sh_objs": [1.0]}, TypeError, "sh_objs must be a tensor, got list"),
        ("grouping", {"sh_objs": torch.tensor(1.0)}, ValueError, r"sh_objs must have shape .*, got \(\)"),
        ("feature3dgs", {"semantic_feature": [1.0]}, TypeError, "semantic_feature must be a tensor, got list"),
        ("feature3dgs", {"semantic_feature": torch.zeros(COUNT)}, ValueError, r"semantic_feature must have shape"),
        ("depth", {"means2D_densify": [1.0]}, TypeError, "means2D_densify must be a tensor, got list"),
        ("depth", {"means2D_densify": torch.zeros(5, 3)}, ValueError, r"means2D_densify must have .*, got \(5, 3\)"),
        ("monogs", {"theta": [0.0, 0.0, 0.0]}, TypeError, "theta must be a tensor, got list"),
    ],
)
def test_wrong_further_arguments(name, further, error, message):
    with pytest.raises(error, match=message):
        render(name, scene=arguments_of(name) | further)


def test_lightgaussian_counts(device):
    counts, scores, color, radii = render("lightgaussian", device, f_count=True)
    expected = plain(device, footprint="point", gaussian_stats=True)
    stats = expected[2].gaussian_stats
    assert torch.equal(counts, stats.pixels) and torch.equal(scores, stats.sum_weight)
    assert torch.equal(color, expected[0]) and torch.equal(radii, expected[1])


# --- Mini-Splatting's second module -------------------------------------------------------------


def test_module_of_mini_splatting():
    import diff_gaussian_rasterization_ms as second

    settings = second.GaussianRasterizationSettings(**CAMERA.fields(torch.float32))
    made = second.GaussianRasterizer(settings)(**scene_of())
    assert all(map(torch.equal, made, render("mini")))


def test_minis_two_modules_have_one_filter():
    """It trains through one and evaluates through the other; a footprint that the user chose is that of both."""
    program = """
        import diff_gaussian_rasterization as evaluates
        made = lambda: evaluates.GaussianRasterizationSettings(*range(12)).footprint_in_use().name
        print(made())
        import diff_gaussian_rasterization_ms as trains
        print(made(), trains.GaussianRasterizationSettings(*range(12)).footprint_in_use().name)
        import analytic_rasterizer
        analytic_rasterizer.set_default_footprint("mip")
        print(made(), trains.GaussianRasterizationSettings(*range(12)).footprint_in_use().name)
    """
    assert run_python(program).split() == ["analytic", "point", "point", "mip", "mip"]
    # The module of 3DGS 2023 stays what it is.
    settings = drop_in.GaussianRasterizationSettings(**CAMERA.fields(torch.float32))
    assert len(drop_in.GaussianRasterizer(settings)(**scene_of())) == 2


@each_precision
def test_depth_where_a_ray_passes_through_a_gaussian(device, dtype):
    """The point of highest density along each pixel's ray, found by searching along the ray."""
    scene = scenes.cast(scenes.random_scene(9, 3, 1, opacity=(0.5, 0.9), sigma=(0.2, 0.6), spread=0.5), dtype, device)
    camera = dataclasses.replace(CAMERA, shift=(3.0, -2.0))
    settings = dialects.dialect_module("mini").GaussianRasterizationSettings(**camera.fields(dtype, device))
    found = dialects.dialect_module("mini").GaussianRasterizer(settings).render_depth(**scene)
    assert found["out_pts"].shape == (3, 30, 40) and found["accum_alpha"].shape == found["depth"].shape == (1, 30, 40)
    seen = found["gidx"][0] >= 0
    assert seen.any() and not seen.all()
    assert (found["out_pts"][:, ~seen] == 0).all() and (found["depth"][0, ~seen] == 0).all()
    # The points lie on the rays of their pixels.
    points = found["out_pts"].permute(1, 2, 0)[seen].cpu().double()
    fields = camera.fields()
    clip = torch.cat([points, torch.ones(len(points), 1)], 1).double() @ fields["projmatrix"]
    pixels = ((clip[:, :2] / clip[:, 3:] + 1) * torch.tensor([40.0, 30.0]) - 1) / 2
    y, x = seen.cpu().nonzero().T
    tolerance = 1e-9 if dtype == torch.float64 else 1e-3
    assert (pixels - torch.stack([x, y], 1)).abs().max() < tolerance
    assert torch.allclose(clip[:, 3], found["depth"][0, seen].cpu().double(), rtol=tolerance)
    # Along the ray the density falls off to both sides: its derivative is zero.
    import reference

    covariance = reference.covariance_3d(scene["scales"].cpu().double(), scene["rotations"].cpu().double(), 1.0)
    index = found["gidx"][0, seen].cpu().long()
    rays = torch.nn.functional.normalize(points - fields["campos"])
    from_center = points - scene["means3D"].cpu().double()[index]
    slope = (rays * torch.linalg.solve(covariance[index], from_center)).sum(1)
    scale = torch.linalg.solve(covariance[index], rays).norm(dim=1) * from_center.norm(dim=1).clamp_min(1e-3)
    assert (slope.abs() / scale).max() < tolerance
    precomputed = scenes.without(scene, "scales", "rotations")
    rows, columns = torch.triu_indices(3, 3)
    precomputed["cov3D_precomp"] = covariance[:, rows, columns].to(scene["means3D"])
    again = dialects.dialect_module("mini").GaussianRasterizer(settings).render_depth(**precomputed)
    same = again["gidx"] == found["gidx"]
    assert same.float().mean() > 0.99
    difference = (again["out_pts"] - found["out_pts"])[:, same[0]].abs().max()
    assert difference < (1e-9 if dtype == torch.float64 else 2e-3)
