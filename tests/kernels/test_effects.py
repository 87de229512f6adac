"""Channels, backgrounds and outputs beside the colours, on every device."""

import math
import pickle
from dataclasses import replace

import pytest
import reference
import scenes
import torch
from marks import each_kind, each_path
from scenes import Camera
from threads import same_on_threads
from torch.nn.functional import pad

import analytic_rasterizer as ar

CAMERA = Camera(image_height=29, image_width=37, sh_degree=1)
ALL = ar.Effects(alpha=True, depth=True, inverse_depth=True)


def render(scene, settings, device):
    """What the rasterizer returns, on the device."""
    return ar.GaussianRasterizer(scenes.settings_to(settings, device))(**scenes.to(scene, device))


def colored(scene, channels, seed=0):
    """The scene with random colours of so many channels in place of harmonics."""
    g = torch.Generator().manual_seed(seed)
    colors = torch.rand(len(scene["means3D"]), channels, generator=g, dtype=scene["means3D"].dtype)
    return scenes.without(scene, "shs") | {"colors_precomp": colors}


def depths(scene, camera=CAMERA):
    view = camera.fields(torch.float64)["viewmatrix"].reshape(4, 4)
    return scene["means3D"].double() @ view[:3, 2] + view[3, 2]


# --- values ---------------------------------------------------------------------------------------


@each_path
@pytest.mark.parametrize("channels", [1, 2, 4, 8])
def test_channels_are_colors_three_at_a_time(device, best, variant, channels):
    """What rendering those three colours alone gives: bit for bit on the CPU, where any number of channels takes the
    same steps; on CUDA, whose kernel for many channels adds up samples in another order, to rounding."""
    scene = scenes.cast(colored(scenes.random_scene(3, 50), channels), best)
    bg = torch.linspace(0.1, 0.9, channels, dtype=best)
    settings = CAMERA.settings(best, variant=variant)._replace(bg=bg)
    color, radii = render(scenes.leaves(scene), settings, device)
    assert color.shape == (channels, 29, 37)
    for i in range(0, channels, 3):
        colors, behind = (pad(t[..., i : i + 3], (0, max(0, i + 3 - channels))) for t in (scene["colors_precomp"], bg))
        single = scenes.leaves(scene | {"colors_precomp": colors})
        expected, expected_radii = render(single, settings._replace(bg=behind), device)
        # A pixel is a sum of products of at most 1 whose weights add up to 1.
        assert (color[i : i + 3] - expected[: channels - i]).abs().max() <= (0 if device == "cpu" else 1e-6)
        assert torch.equal(radii, expected_radii)


@each_kind
def test_outputs_match_the_reference(device, best, variant):
    """alpha, depth and 1/depth are colours that the reference blends too."""
    footprint, options = variant
    scene = scenes.random_scene(5, 30, degree=1)
    z = depths(scene)
    colors = torch.stack([torch.ones_like(z), z, 1 / z], 1)
    on_device = scenes.cast(scene, best, device)
    color, radii, outputs = CAMERA.render(on_device, variant, effects=ALL)
    plain = CAMERA.render(on_device, variant)
    assert torch.equal(radii, plain[1])
    assert (color - plain[0]).abs().max() <= (1e-6 if device == "cuda" else 0)  # one is ready for a backward pass
    shown = scenes.without(scene, "shs") | {"colors_precomp": torch.where(z[:, None] > 0.2, colors, 1)}
    expected = reference.render(CAMERA.settings(variant=variant), **shown, footprint=footprint, **options).color
    # Rounding of the dtype times what adds up in a pixel; depths here are below 8.
    bound = {torch.float64: 1e-11, torch.float32: 2e-5}[best]
    for name, plane in zip(("alpha", "depth", "inverse_depth"), expected):
        assert (getattr(outputs, name)[0].cpu() - plane).abs().max() < 8 * bound, name


def test_alpha_is_what_the_background_does_not_show(device, best):
    scene = scenes.cast(scenes.random_scene(6, 30, degree=1), best, device)
    black = CAMERA.render(scene, footprint="box:samples=4")[0]
    white, _, outputs = replace(CAMERA, bg=(1, 1, 1)).render(scene, footprint="box:samples=4", effects=ALL)
    assert torch.allclose(1 - outputs.alpha.expand_as(black), white - black, atol=4e-6)


def test_normalized_depth_lies_between_the_nearest_and_the_farthest(device, best):
    scene = scenes.cast(scenes.random_scene(7, 60, degree=1, sigma=(0.2, 0.5)), best)
    _, radii, outputs = CAMERA.render(scenes.to(scene, device), effects=ALL)
    mean = ar.normalized(outputs.depth, outputs.alpha)
    z = depths(scene)[radii.cpu() > 0]
    seen = mean[outputs.alpha > 1e-3]
    assert len(seen) > 100
    assert z.min() - 1e-4 < seen.min() and seen.max() < z.max() + 1e-4
    assert (mean[outputs.alpha <= 1e-6] == 0).all()


def test_background_image(device, best):
    """Every pixel sees its own background through what the splats leave."""
    scene = scenes.cast(scenes.random_scene(8, 40, degree=1), best)
    image = torch.rand(3, 29, 37, generator=torch.Generator().manual_seed(1), dtype=best)
    settings = CAMERA.settings(best, footprint="box:samples=4")
    color, _ = render(scene, settings._replace(bg=image), device)
    for value in (image.new_tensor([0.2, 0.5, 0.7]), image.new_zeros(3)):
        constant = value[:, None, None].expand(3, 29, 37).contiguous()
        one, other = (render(scene, settings._replace(bg=bg), device)[0] for bg in (value, constant))
        assert torch.allclose(one, other, atol=1e-6)
    black = render(scene, settings._replace(effects=ar.Effects(alpha=True)), device)
    assert torch.allclose(color, black[0] + (1 - black[2].alpha) * image.to(device), atol=1e-6)


# --- gradients ------------------------------------------------------------------------------------


@each_path
def test_gradients_add_up_over_the_groups(device, best, variant):
    """d/d(all channels) is the sum of what each group of three gives alone."""
    scene = scenes.cast(colored(scenes.random_scene(9, 60), 7), best)
    settings = CAMERA.settings(best, variant=variant)._replace(bg=torch.linspace(0, 1, 7, dtype=best))
    g = torch.rand(7, 29, 37, generator=torch.Generator().manual_seed(2), dtype=best)
    whole = scenes.leaves(scenes.to(scene, device))
    render(whole, settings, device)[0].backward(g.to(device))
    parts, total, size = scenes.leaves(scenes.to(scene, device)), {}, {}
    for i in range(0, 7, 3):
        colors, bg = (pad(t[..., i : i + 3], (0, max(0, i - 4))) for t in (parts["colors_precomp"], settings.bg))
        image, _ = render(parts | {"colors_precomp": colors}, settings._replace(bg=bg), device)
        (image[: 7 - i] * g[i : i + 3].to(device)).sum().backward()
        for name, leaf in parts.items():
            if leaf.grad is not None:
                total[name] = total.get(name, 0) + leaf.grad
                size[name] = size.get(name, 0) + leaf.grad.abs().max()
                leaf.grad = None
    for name, expected in total.items():
        # A gradient of seven channels has a product of seven terms where its parts have three: 10 roundings, of numbers
        # that may be larger than what they add up to.
        assert (whole[name].grad - expected).abs().max() <= 16 * torch.finfo(best).eps * size[name], name


@each_kind
@pytest.mark.parametrize("count", [60, 3000], ids=["few", "several chunks"])
def test_gradients_of_alpha(device, best, variant, count):
    """Those of what a white background shows more than a black one; with lists of more than a chunk of a tile too."""
    scene = scenes.cast(scenes.random_scene(10, count, opacity=(0.02, 0.2), sigma=(0.05, 0.3)), best)
    camera = Camera(image_height=21, image_width=23)
    g = torch.rand(1, 21, 23, generator=torch.Generator().manual_seed(4), dtype=best).to(device)
    leaves = scenes.leaves(scenes.to(scene, device))
    settings = camera.settings(best, device, variant)
    _, _, outputs = ar.GaussianRasterizer(settings._replace(effects=ar.Effects(alpha=True)))(**leaves)
    (outputs.alpha * g).sum().backward()
    others = scenes.leaves(scenes.to(scene, device))
    for value, sign in ((1.0, -1), (0.0, 1)):
        bg = torch.full((3,), value, dtype=best, device=device)
        color, _ = ar.GaussianRasterizer(settings._replace(bg=bg))(**others)
        (sign * color[:1] * g).sum().backward()
    for name in ("means3D", "opacities", "scales", "rotations"):
        expected = others[name].grad
        # Both add and subtract the colours, which alpha has not.
        bound = {torch.float64: 1e-11, torch.float32: 2e-4}[best]
        assert (leaves[name].grad - expected).abs().max() <= bound * expected.abs().max(), name
    assert (leaves["shs"].grad == 0).all()


@pytest.mark.parametrize("footprint", ["cumulant", "box:samples=4"])
def test_gradcheck(footprint):
    camera = Camera(image_height=9, image_width=11, bg=(0.3, 0.6, 0.1))
    scene = scenes.with_precomputed(scenes.smooth_scene(2, 4))
    scene = {**scene, "colors_precomp": torch.rand(4, 5, dtype=torch.float64)}
    bg = torch.rand(5, 9, 11, dtype=torch.float64, requires_grad=True)
    names = ["means3D", "opacities", "colors_precomp", "cov3D_precomp"]
    settings = camera.settings(footprint=footprint, effects=ALL)

    def run(bg, *values):
        given = dict(zip(names, values))
        color, _, outputs = ar.GaussianRasterizer(settings._replace(bg=bg))(means2D=None, **given)
        return (color, *outputs[:3])

    inputs = [scene[name].clone().requires_grad_() for name in names]
    assert torch.autograd.gradcheck(run, (bg, *inputs), eps=1e-6, atol=1e-7, rtol=1e-5, nondet_tol=0, fast_mode=True)


def test_depth_gradient_of_a_culled_gaussian_is_zero(device, best):
    """One on the camera, where 1/z is infinite, and one behind it."""
    scene = scenes.cast(scenes.random_scene(10, 12, degree=1), best)
    camera = CAMERA.facing_z()
    scene["means3D"][:, 2] += 5
    scene["means3D"][3] = 0
    scene["means3D"][4, 2] = -3
    leaves = scenes.leaves(scenes.to(scene, device))
    color, _, outputs = camera.render(leaves, footprint="box", effects=ALL)
    (color.sum() + sum(output.sum() for output in outputs[:3])).backward()
    for name, leaf in leaves.items():
        assert leaf.grad.isfinite().all(), name
    assert (leaves["means3D"].grad[3:5] == 0).all()


# --- what must not change, and what must be refused -------------------------------------------------


@each_path
def test_asking_for_outputs_changes_no_bit_of_the_colors(device, best, variant):
    """On CUDA depth takes a kernel of more channels, whose sums round differently."""
    scene = scenes.cast(scenes.random_scene(11, 60, degree=1), best)
    results = []
    asked = (None, ar.Effects(), ar.Effects(alpha=True), ar.Effects(depth=True), ALL)
    for effects in asked:
        leaves = scenes.leaves(scenes.to(scene, device))
        color, radii, *outputs = CAMERA.render(leaves, variant, effects=effects)
        assert len(outputs) == (effects is not None and effects.has_outputs)
        color.square().sum().backward()
        results.append([color.detach(), radii, *(leaf.grad for leaf in leaves.values())])
    for effects, other in zip(asked[1:], results[1:]):
        for a, b in zip(results[0], other):
            bound = 1e-5 * a.abs().max() if device == "cuda" and effects.depth else 0
            assert (a - b).abs().max() <= bound, effects


def test_a_feature_that_is_not_finite_culls_its_gaussian_alone(device, best):
    scene = scenes.cast(colored(scenes.random_scene(13, 30), 6), best)
    settings = CAMERA.settings(best, footprint="box")._replace(bg=torch.zeros(6, dtype=best))
    without = {k: torch.cat([v[:4], v[5:]]) for k, v in scene.items()}
    scene["colors_precomp"][4, 5] = torch.nan
    leaves = scenes.leaves(scenes.to(scene, device))
    color, radii = render(leaves, settings, device)
    expected, _ = render(scenes.leaves(without), settings, device)
    assert torch.equal(color, expected)
    assert radii[4] == 0
    color.sum().backward()
    for name, leaf in leaves.items():
        assert leaf.grad.isfinite().all(), name
        assert (leaf.grad[4] == 0).all(), name


def test_debug_names_the_channel_that_is_not_finite(device, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # where the snapshot goes
    scene = colored(scenes.cast(scenes.random_scene(13, 30), torch.float32), 6)
    scene["colors_precomp"][4, 5] = torch.nan
    settings = CAMERA.settings(torch.float32, footprint="box")._replace(debug=True, bg=torch.zeros(6))
    with pytest.raises(ValueError, match=r"colors_precomp must be finite, got nan at \(4, 5\)"):
        render(scene, settings, device)


@pytest.mark.parametrize(
    "colors, bg, message",
    [
        ((30, 0), (0,), r"colors_precomp must have shape \(P, C\) with P = 30 and C from 1 to 512, got \(30, 0\)"),
        ((30, 513), (513,), r"colors_precomp must have shape \(P, C\) .* C from 1 to 512, got \(30, 513\)"),
        ((29, 4), (4,), r"colors_precomp must have shape \(P, C\) with P = 30 and C from 1 to 512, got \(29, 4\)"),
        ((30, 4), (3,), r"bg must have shape \(4,\) or \(1, 4\), got \(3,\)"),
        ((30, 3), (3, 29, 36), r"bg must have shape \(3, 29, 37\), got \(3, 29, 36\)"),
    ],
)
def test_wrong_shapes(device, colors, bg, message):
    scene = scenes.cast(scenes.random_scene(1, 30), torch.float32)
    scene |= {"shs": None, "colors_precomp": torch.rand(*colors)}
    with pytest.raises(ValueError, match=message):
        render(scene, CAMERA.settings(torch.float32)._replace(bg=torch.zeros(bg)), device)


@pytest.mark.parametrize("number", [math.nan, -math.inf])
def test_a_background_image_that_is_not_finite_is_refused(device, number):
    """As a colour is; on CUDA only with debug, because it would have to be waited for."""
    image = torch.zeros(3, 29, 37, device=device)
    image[1, 2, 3] = number
    settings = CAMERA.settings(torch.float32, device)._replace(bg=image, debug=device == "cuda")
    with pytest.raises(ValueError, match=rf"bg must be finite, got {number} at \(1, 2, 3\)"):
        ar.GaussianRasterizer(settings)(**scenes.cast(scenes.random_scene(1, 5), torch.float32, device))


def test_effects_and_settings():
    settings = CAMERA.settings(effects=ALL, footprint="box")
    assert settings._replace(sh_degree=0).effects == ALL
    assert pickle.loads(pickle.dumps(settings)).effects == ALL
    assert "inverse_depth=True" in repr(settings)
    assert not ar.Effects().has_outputs and ALL.has_outputs
    with pytest.raises(TypeError, match="depth must be a bool, got 1"):
        ar.Effects(depth=1)
    with pytest.raises(TypeError, match=r"effects must be an Effects or .auto., got 'depth'"):
        CAMERA.settings(effects="depth")


# --- what pixels show ------------------------------------------------------------------------------


@each_kind
def test_looks_match_the_weights(device, best, variant):
    """Weights of all Gaussians from one channel each: the largest, the one at half of the light, sums over pixels."""
    count = 24
    scene = scenes.cast(colored(scenes.random_scene(14, count, opacity=(0.3, 0.98), sigma=(0.15, 0.6)), 3), best)
    scene["colors_precomp"] = torch.eye(count, dtype=best)
    looks = ar.Effects(median_depth=True, dominant_index=True, gaussian_stats=True)
    settings = CAMERA.settings(best, variant=variant, effects=looks)._replace(bg=torch.zeros(count, dtype=best))
    weights, _, outputs = render(scene, settings, device)
    weights, eps = weights.cpu(), 32 * torch.finfo(best).eps
    assert outputs.alpha is outputs.depth is None

    dominant = outputs.dominant_index[0].cpu()
    assert dominant.dtype == torch.int32
    largest = weights.amax(0)
    assert torch.equal(dominant < 0, largest == 0)
    seen = dominant >= 0
    of_dominant = weights.gather(0, dominant.clamp_min(0).long()[None])[0]
    assert (largest - of_dominant)[seen].max() <= eps

    stats = outputs.gaussian_stats
    assert torch.equal(stats.pixels.cpu().long(), (weights > 0).sum((1, 2)))
    assert torch.equal(stats.pixels_dominated.cpu().long(), dominant[seen].long().bincount(minlength=count))
    assert (stats.max_weight.cpu() - weights.amax((1, 2))).abs().max() <= max(eps, 1e-7)
    total = weights.double().sum((1, 2))
    assert (stats.sum_weight.cpu().double() - total).abs().max() <= 29 * 37 * (eps + 2**-33)

    z = depths(scene)
    order = torch.argsort(z)
    through = 1 - weights[order].double().cumsum(0)  # behind each, front to back
    median = outputs.median_depth[0].cpu().double()
    below = (through < 0.5) & (weights[order] > 0)
    first = below.double().argmax(0)
    expected = torch.where(below.any(0), z[order][first], 0)
    clear = ((through - 0.5).abs() > 1e-5).all(0)  # rounding may decide the others
    assert clear.double().mean() > 0.98 and below.any(0).double().mean() > 0.2
    assert (median - expected)[clear].abs().max() < 1e-5

    seen_here = weights[order] > 0
    in_front = (seen_here & (through > 0.5)).sum((1, 2))
    undecided = (seen_here & ((through - 0.5).abs() <= 1e-5)).sum((1, 2))
    found = stats.pixels_in_front.cpu().long()[order]
    assert ((found - in_front).abs() <= undecided).all()
    assert (in_front > 0).any() and (in_front < stats.pixels.cpu()[order]).any()


@each_kind
def test_looks_do_not_depend_on_each_other(device, best, variant):
    """What is left out lets a pixel be closed earlier, and changes no bit."""
    scene = scenes.cast(scenes.random_scene(16, 300, degree=1, sigma=(0.05, 0.6)), best, device)
    looks = ("median_depth", "dominant_index", "gaussian_stats")

    def outputs(*names):
        return CAMERA.render(scene, variant, effects=ar.Effects(**dict.fromkeys(names, True)))[2]

    together = outputs(*looks)
    assert (together.median_depth > 0).any() and (together.median_depth == 0).any()
    for some in (*((name,) for name in looks), looks[:2], looks[1:]):
        found = outputs(*some)
        for name in some:
            a, b = getattr(found, name), getattr(together, name)
            assert all(map(torch.equal, a, b)) if name == "gaussian_stats" else torch.equal(a, b), name


def test_looks_do_not_depend_on_threads_or_runs():
    scene = scenes.random_scene(15, 200, degree=1)
    looks = ar.Effects(median_depth=True, dominant_index=True, gaussian_stats=True)

    def results():
        _, _, outputs = CAMERA.render(scene, footprint="box:samples=4", effects=looks)
        return outputs.median_depth, outputs.dominant_index, *outputs.gaussian_stats

    same_on_threads(results, (1, 2, 5, 2))


def test_looks_of_an_empty_picture(device, best):
    scene = scenes.cast(scenes.random_scene(1, 0, degree=1), best, device)
    looks = ar.Effects(median_depth=True, dominant_index=True, gaussian_stats=True, alpha=True, depth=True)
    color, _, outputs = CAMERA.render(scene, effects=looks)
    assert color.abs().max() == 0 and outputs.alpha.abs().max() == 0 and outputs.median_depth.abs().max() == 0
    assert (outputs.dominant_index == -1).all()
    assert all(len(field) == 0 for field in outputs.gaussian_stats)
