"""The hard cases of hard_cases.py in the order along rays: finite, and as good in float32 as their condition allows.

The tolerance is that of test_stability.py. Besides thresholds, rounding may decide which of two splats is nearer in a
pixel. A depth z + g . d has less than ten roundings, each of at most eps (|z| + |g| |d|): pixels with two splats that
show and whose depths are nearer than ORDER_ROUNDINGS times this are left out, as those at a threshold are.
"""

from dataclasses import replace

import hard_cases
import pytest
import ray_reference
import reference
import scenes
import torch
from hard_cases import CASES, EPS
from scenes import name_of
from test_order import ALONG_RAYS

import analytic_rasterizer as ar
from analytic_rasterizer.render.order import RAY

ORDER_ROUNDINGS = 20  # ten of each of the two depths
# Whose layers are nearer to each other than float32 can tell. In float64 the test behind compares such a stack.
NOT_COMPARED = {"stack_opaque", "stack_faint", "stack_mixed"}
SPACED = hard_cases.Case(
    "stack_spaced", "300 layers", hard_cases.stack(lambda n: torch.full((n,), 0.05), 300), layers=300
)


def along_rays(case):
    """The case with the order along rays among its effects."""
    return replace(case, effects=replace(case.effects or ar.Effects(), order=RAY))


def has_clear_order(settings, scene):
    """(H, W) bool: no two splats that may show have depths that rounding in float32 may swap, in float64."""
    splats = ar.project(settings._replace(footprint="point"), **{k: v for k, v in scene.items() if k != "means2D"})
    pixels = ray_reference.pixels_of(settings)
    offsets = pixels - splats.means2d[:, None, None]
    depths = splats.depths[:, None, None] + (offsets * splats.slopes[:, None, None]).sum(-1)
    size = splats.depths.abs()[:, None, None] + splats.slopes.norm(dim=-1)[:, None, None] * offsets.norm(dim=-1)
    wider = reference.add_variance(splats.cov2d, 1.0)[:, None, None]
    may_show = (
        reference.quadratic(offsets, wider) < 2 * (255 * splats.opacities.clamp_min(1e-30)).log()[:, None, None] + 1
    )
    depths = torch.where(may_show, depths, torch.inf).sort(dim=0)
    size = torch.where(may_show, size, 0).amax(0)
    gaps = depths.values.diff(dim=0)
    ties = gaps == 0  # equal depths keep their order in both precisions
    gaps = torch.where(ties | gaps.isnan(), torch.inf, gaps)
    smallest = gaps.amin(0) if len(gaps) else torch.full_like(size, torch.inf)
    return smallest > ORDER_ROUNDINGS * EPS[torch.float32] * size


@pytest.mark.parametrize("case", [*CASES, SPACED], ids=lambda case: case.name)
@pytest.mark.parametrize("variant", ALONG_RAYS, ids=name_of)
def test_hard_case(device, case, variant, monkeypatch):
    plain = hard_cases.clear_pixels

    def clear(settings, scene, margin):
        return plain(settings, scene, margin) & has_clear_order(settings, scene)

    if case.name not in NOT_COMPARED:
        monkeypatch.setattr(hard_cases, "clear_pixels", clear)
    report = hard_cases.measure(along_rays(case), variant, device, torch.float32)
    assert report.finite, report.describe()
    if case.name in NOT_COMPARED:
        return
    assert report.unclear <= 0.5, report.describe()
    assert not report.failures(), report.describe()


@pytest.mark.parametrize("variant", [("box", {"samples": 1}), ("moment", {"samples": 4})], ids=name_of)
def test_thousands_of_layers(variant):
    """In float64, against the reference: 3,000 layers, of which 2,000 show before their pixels are opaque."""
    camera, scene = hard_cases.stack(lambda n: torch.full((n,), 0.006), 3000)()
    settings = hard_cases.settings_of(camera, torch.float64, torch.float64, variant)
    settings = settings._replace(effects=ar.Effects(order=RAY))
    ours, theirs = scenes.leaves(scene), scenes.leaves(scene)
    color = ar.GaussianRasterizer(settings)(**ours)[0]
    expected, order = ray_reference.render(settings, **theirs, footprint=variant[0], window=24, **variant[1])
    assert order.margin.min() > 1e-13 and expected.pixel_margin.min() > 1e-9, "unlucky scene"
    assert (color - expected.color).abs().max() < 1e-9
    color.sum().backward()
    expected.color.sum().backward()
    assert 1500 < (theirs["opacities"].grad != 0).sum() < 3000
    for name, leaf in ours.items():
        wanted = theirs[name].grad
        assert (leaf.grad - wanted).abs().max() <= 1e-8 * wanted.abs().max() + 1e-14, name


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
def test_bad_numbers_harm_nobody_else(device, bad):
    """A Gaussian with a number that is not finite is culled; the others are drawn as without it."""
    scene = scenes.cast(scenes.random_scene(3, 30), torch.float32, device)
    camera = scenes.Camera(image_height=19, image_width=23)
    kept = {name: value[1:] for name, value in scene.items()}
    expected = camera.render(kept, footprint="box:samples=1", effects=ar.Effects(order=RAY))[0]
    for name in ("means3D", "scales", "rotations", "opacities"):
        broken = dict(scene)
        broken[name] = scene[name].clone()
        broken[name][0] = bad
        found = camera.render(broken, footprint="box:samples=1", effects=ar.Effects(order=RAY))[0]
        assert torch.equal(found, expected), name


@pytest.mark.parametrize(
    "lens",
    [ar.Lens.perspective([0.1, -0.05]), ar.Lens.fisheye([0.05]), ar.Lens.fov(0.8)],
    ids=lambda lens: lens.model,
)
@pytest.mark.parametrize("footprint", ["point", "moment:samples=4"])
def test_lenses(device, best, lens, footprint):
    """Rays through a lens: image and gradients are finite, and splats apart keep the order of their depths.

    The depth is that of the lens, for a fisheye the distance; its slope is the derivative of this depth.
    """
    scene = scenes.cast(scenes.random_scene(4, 40), best, device)
    camera = scenes.Camera(image_height=19, image_width=23)
    effects = ar.Effects(order=RAY, lens=lens)
    leaves = scenes.leaves(scene)
    color = camera.render(leaves, footprint=footprint, effects=effects)[0]
    color.sum().backward()
    assert all(leaf.grad.isfinite().all() for leaf in leaves.values()) and (color > 0.1).any()
    if device == "cuda":
        return  # test_slopes_on_cuda compares slopes with those of the CPU
    settings = camera.settings(footprint=footprint, effects=effects)
    given = {name: value for name, value in scene.items() if name != "means2D"}
    splats = ar.project(settings, **given)
    # The slope by differences: a point of the Gaussian that is seen a little further along is as much deeper.
    chosen = splats.gaussian_ids.long()
    generator = torch.Generator().manual_seed(1)
    covariance = reference.covariance_3d(scene["scales"][chosen], scene["rotations"][chosen], 1.0)
    factor = torch.linalg.cholesky(covariance)
    steps = 1e-5 * torch.randn(len(chosen), 4000, 3, generator=generator, dtype=torch.float64) @ factor.mT
    moved = {"opacities": torch.ones(1, 1, dtype=torch.float64), "rotations": scene["rotations"][:1]}
    for k in (0, len(chosen) // 2):
        points = scene["means3D"][chosen[k]] + steps[k]
        rows = ar.project(
            settings,
            points,
            moved["opacities"].expand(len(points), 1),
            scales=torch.full((len(points), 3), 0.1, dtype=torch.float64),
            rotations=moved["rotations"].expand(len(points), 4),
        )
        du, dz = rows.means2d - splats.means2d[k], rows.depths - splats.depths[k]
        spread = du.T @ du / len(points)
        slope = torch.linalg.solve(spread, du.T @ dz / len(points))
        # v = 1e-4 px^2 is small beside Sigma_uv, and 4000 samples know a covariance to a few percent.
        assert (slope - splats.slopes[k]).norm() < 0.1 * (splats.slopes[k].norm() + 0.02)


@pytest.mark.parametrize("length, kept", [(1e16, True), (1e17, False)])
def test_the_slope_of_a_needle_seen_end_on(length, kept):
    """Beyond 1e18 world units per px, where depths could overflow, it is zero.

    The needle ends d px beside its centre in the picture. Its variance there is d^2 + v: with d^2 = v = 1e-4 px^2, the
    steepest tilt, the slope is length d / (2 v) = 50 length.
    """
    camera = scenes.Camera(image_height=19, image_width=23).facing_z()
    distance = 4.0
    tilt = 0.01 * distance / (camera.image_height / (2 * camera.tanfovy) * length)
    scene = {
        "means3D": torch.tensor([[0, 0, distance]]),
        "scales": torch.tensor([[0.05, 1e-5, length]]),
        "rotations": torch.tensor([[1, tilt / 2, 0, 0]]),
        "opacities": torch.tensor([[0.9]]),
        "colors_precomp": torch.ones(1, 3),
    }
    settings = camera.settings(torch.float32, variant=("point", {}), effects=ar.Effects(order=RAY))
    slope = ar.project(settings, **scene).slopes[0]
    assert slope[0] == 0
    assert slope[1] == pytest.approx(-50 * length, rel=0.01) if kept else slope[1] == 0
    assert ar.GaussianRasterizer(settings)(means2D=None, **scene)[0].max() > 0.8
