"""What is recommended for a scene and its views, and what is said about them."""

import json
import math
from dataclasses import replace

import pytest
import reference
import scenes
import torch
from gaussians import of_inputs
from places import SHARED
from scenes import Camera

import analytic_rasterizer as ar
from analytic_rasterizer import io
from analytic_rasterizer.analysis import planner

TOLERANCE = 1 / 255
CAMERAS = [Camera(image_height=61, image_width=83), Camera(image_height=52, image_width=40, eye=(-3.0, 1.5, -3.0))]
BANDS = {"none": [1], "tiny": [1, 1e-4, 1e-4, 1e-4], "large": [1, 0.3, 0.3, 0.3], "falling": [1, 0.3, 0.005, 1e-4]}
SIZES = {"fine": (0.001, 0.02), "mixed": (0.003, 0.5), "large": (0.3, 0.8)}


def random_scene(device, seed=0, count=800, sizes="mixed", bands="none"):
    factors = torch.cat([torch.full((2 * band + 1,), scale) for band, scale in enumerate(BANDS[bands])])
    inputs = scenes.random_scene(seed, count, len(BANDS[bands]) - 1, sigma=SIZES[sizes])
    inputs["shs"] = inputs["shs"] * factors[:, None]
    return of_inputs(scenes.cast(inputs, torch.float32, device))


def settings(device, *cameras):
    return [camera.settings(torch.float32, device) for camera in cameras or CAMERAS]


def at(view, scale):
    """An `io.View` of other size over the same field of view."""
    return replace(view, width=scale * view.width, height=scale * view.height, fx=scale * view.fx, fy=scale * view.fy)


def find(found, name):
    return next(finding for finding in found.findings if finding.name == name)


def picture(scene, view, footprint, sh_degree=None, filter_3d=None):
    gaussians = scene.arguments()
    if filter_3d is not None:
        gaussians["scales"], gaussians["opacities"] = ar.apply_3d_filter(scene.scales, scene.opacities, filter_3d)
    degree = scene.sh_degree if sh_degree is None else sh_degree
    with torch.no_grad():
        return ar.GaussianRasterizer(view._replace(footprint=footprint, sh_degree=degree))(means2D=None, **gaussians)[0]


def check_recommendation(scene, views, found, filter_3d=None):
    """Within the tolerance of everything on, in every view, and as near as the report says."""
    effects = found.effects
    for view, reported in zip(views, found.views):
        recommended = picture(scene, view, found.footprint, effects.sh_degree, effects.filter_3d)
        everything = picture(scene, view, planner.REFERENCE, filter_3d=filter_3d)
        rms = (recommended.double() - everything).square().mean().sqrt().item()
        assert rms <= found.tolerance
        assert rms == pytest.approx(reported.rms, rel=1e-3, abs=1e-7)


@pytest.fixture
def clock(monkeypatch):
    """Times that grow with the number of footprints or passes tried before."""

    def seconds(passes, scene, rounds):
        return {name: 1.0 + i for i, name in enumerate(passes)}

    monkeypatch.setattr(planner, "_seconds", seconds)


@pytest.mark.parametrize("sizes", SIZES)
@pytest.mark.parametrize("bands", BANDS)
def test_recommendation_is_within_the_tolerance_of_everything_on(device, sizes, bands):
    scene = random_scene(device, len(sizes), sizes=sizes, bands=bands)
    views = settings(device)
    for tolerance in (TOLERANCE / 4, TOLERANCE, 6 * TOLERANCE):
        found = ar.inspect_scene(scene, views, tolerance, rounds=1)
        check_recommendation(scene, views, found)
        for candidate in found.candidates:
            assert candidate.fits == (candidate.rms <= tolerance)
            assert candidate.cost > 0 if candidate.fits else candidate.cost in (None, 1)
        assert found.footprint in {candidate.footprint for candidate in found.candidates if candidate.fits}


def test_splats_larger_than_a_pixel_need_one_sample(device, clock):
    found = ar.inspect_scene(random_scene(device, sizes="large"), settings(device))
    assert found.footprint == "box:samples=1" and not find(found, "footprint").needed
    assert all(view.narrow == 0 for view in found.views)
    costs = {candidate.footprint: candidate.cost for candidate in found.candidates}
    assert (costs["box:samples=1"], costs["moment:samples=1"]) == (1, 2)


def test_moment_is_tried_and_measured_against(device):
    """The reference is the footprint that is nearest to the integral over the pixel, and every other way of being
    nearer than one sample is a candidate, so that what is recommended is what measures best."""
    assert planner.REFERENCE == "moment:samples=16"
    found = ar.inspect_scene(random_scene(device, sizes="fine", count=4000), settings(device), TOLERANCE, rounds=1)
    rms = {candidate.footprint: candidate.rms for candidate in found.candidates}
    assert set(rms) == {f"{name}:samples={n}" for name in ("box", "moment") for n in (1, 4, 16)}
    assert rms["moment:samples=4"] < min(rms["box:samples=4"], rms["box:samples=1"])


def test_splats_finer_than_a_pixel_need_more(device, clock):
    scene = random_scene(device, sizes="fine", count=4000)
    found = ar.inspect_scene(scene, settings(device))
    assert found.footprint != "box:samples=1" and find(found, "footprint").needed
    assert find(found, "footprint").change > TOLERANCE
    assert all(view.narrow > 0.5 and sum(view.sigmas) == view.shown for view in found.views)


@pytest.mark.parametrize(("bands", "degree"), [("none", None), ("tiny", 0), ("falling", None), ("large", None)])
def test_tiny_bands_are_left_out(device, bands, degree):
    """Of "falling" the bound of band 2 exceeds half of the tolerance; of twice as much it does not."""
    scene = random_scene(device, bands=bands, count=100)
    found = ar.inspect_scene(scene, settings(device), TOLERANCE, rounds=1)
    harmonics = find(found, "spherical harmonics")
    expected = {"falling": 2}.get(bands, degree)
    assert found.effects.sh_degree == expected
    assert harmonics.needed == (bands in ("falling", "large"))
    assert (harmonics.kind, harmonics.cost is None) == ("measured" if bands == "large" else "bound", bands == "none")
    if expected is not None:
        assert harmonics.change <= TOLERANCE / 2
    assert ar.plan(scene, settings(device), 100).sh_degree == (None if bands == "none" else 0)


def test_filter_is_called_for_by_views_finer_than_those_of_training(device):
    scene = random_scene(device, sizes="fine")
    view = io.View("a", 64, 48, 60.0, 60.0, CAMERAS[0].world_to_camera())
    for training, needed in ((None, None), ([view], False), ([at(view, 2)], False), ([at(view, 0.25)], True)):
        found = ar.inspect_scene(scene, [view], TOLERANCE, training, rounds=1)
        finding = find(found, "3D filter")
        assert finding.needed is needed
        assert (found.effects.filter_3d is not None) == bool(needed)
        assert (finding.change is None) == (not needed)
    expected = ar.compute_3d_filter(scene.means, [at(view, 0.25).settings(device=device)])
    assert torch.equal(found.effects.filter_3d, expected)
    assert found.views[0].finer == 1 and found.views[0].finest == pytest.approx(4)
    assert finding.change > TOLERANCE / 4
    check_recommendation(scene, [view.settings(device=device)], found, expected)


def test_filter_that_changes_little_is_left_out(device):
    scene = random_scene(device, sizes="large", count=30)
    view = io.View("a", 64, 48, 60.0, 60.0, CAMERAS[0].world_to_camera())
    training = [at(view, 0.5)]
    found = ar.inspect_scene(scene, [view], 0.5, training, rounds=1)
    assert found.views[0].finer == 1
    finding = find(found, "3D filter")
    assert not finding.needed and found.effects.filter_3d is None and 0 < finding.change <= 0.5 / 4
    filter_3d = ar.compute_3d_filter(scene.means, [training[0].settings(device=device)])
    check_recommendation(scene, [view.settings(device=device)], found, filter_3d)


def test_hidden_gaussians_change_nothing(device):
    scene = random_scene(device, count=300)
    behind, beside, faint = scene.means.clone(), scene.means.clone(), scene.opacities.clone()
    forward = CAMERAS[0].world_to_camera()[2, :3].to(behind)
    behind[:40] = -20 * forward + 0.1 * behind[:40]
    beside[40:100] = torch.tensor([0.0, 1000.0, 0.0], device=device)
    faint[100:110] = 0.9 / 255
    means = torch.cat([behind[:40], beside[40:100], scene.means[100:]])
    scene = scene._replace(means=means).with_activated(opacities=faint)
    view = settings(device, CAMERAS[0])
    found = ar.inspect_scene(scene, view, rounds=1)
    assert not found.shown[:110].any()
    hidden = find(found, "hidden Gaussians")
    count = 300 - int(found.shown.sum())
    assert hidden.recommendation == f"drop {count}" and hidden.change == 0
    assert "40 behind every camera" in hidden.reason and "60 beside every picture" in hidden.reason
    assert f"{count - 100} too faint" in hidden.reason
    left = scene.rows(found.shown)
    for footprint in (planner.REFERENCE, found.footprint):
        assert torch.equal(picture(scene, view[0], footprint), picture(left, view[0], footprint))


@pytest.mark.parametrize(("shift", "needed"), [((0, 0), False), ((0.29, -0.29), False), ((0.31, 0), True)])
def test_off_center_views(shift, needed):
    """A principal point 0.3 half pictures from the middle puts an edge 1.3 of them away."""
    camera = replace(CAMERAS[0], shift=(shift[0] * 83 / 2, shift[1] * 61 / 2))
    scene = random_scene("cpu", count=5)
    assert ar.plan(scene, settings("cpu", CAMERAS[1], camera)).off_center is needed
    view = io.View("a", 80, 60, 70.0, 70.0, torch.eye(4).double(), cx=40 * (1 + shift[0]), cy=30 * (1 + shift[1]))
    assert ar.plan(scene, [view]).off_center is needed


def test_orthographic_views():
    camera = Camera().settings(torch.float32)
    flat = torch.diag(torch.tensor([1 / camera.tanfovx, 1 / camera.tanfovy, 0.01, 1]))
    orthographic = camera._replace(projmatrix=camera.viewmatrix @ flat)
    scene = random_scene("cpu", count=5)
    effects = ar.plan(scene, [orthographic])
    assert effects.orthographic and not effects.off_center
    assert not ar.plan(scene, [camera]).orthographic
    with pytest.raises(ValueError, match="all perspective or all orthographic, got 1 of 2 orthographic"):
        ar.plan(scene, [camera, orthographic])


def test_histogram_is_that_of_the_reference_projection():
    scene, camera = random_scene("cpu"), CAMERAS[0].settings()
    found = ar.inspect_scene(scene, settings("cpu", CAMERAS[0]), rounds=1)
    inputs = {name: value.double() for name, value in scene.arguments().items()}
    covariance = reference.covariance_3d(inputs["scales"], inputs["rotations"], 1.0)
    projection = reference.project(camera, inputs["means3D"], covariance)
    xx, xy, yy = projection.cov2d.unbind(-1)
    sigma = torch.linalg.eigvalsh(torch.stack([xx, xy, xy, yy], -1).reshape(-1, 2, 2))[:, 0].clamp_min(0).sqrt()
    edges = torch.tensor(found.to_json()["sigma_edges"]).double()
    expected = torch.histogram(sigma[found.shown], edges).hist
    assert (torch.tensor(found.views[0].sigmas) - expected).abs().sum() <= 4  # at an edge, by rounding
    assert found.views[0].narrow == pytest.approx((sigma[found.shown] < 0.5).double().mean().item(), abs=3e-3)


def test_report_in_words_and_json(device):
    scene = random_scene(device, bands="tiny")
    views = [io.View("a", 64, 48, 60.0, 60.0, CAMERAS[0].world_to_camera()), settings(device)[1]]
    found = ar.inspect_scene(scene, views, TOLERANCE, views, scale=0.5, background=(0.1, 0.2, 0.3), rounds=1)
    text = found.to_text()
    assert f"cheapest within the tolerance: footprint {found.footprint}, Effects(sh_degree=0)" in text
    for name in (*(finding.name for finding in found.findings), "a", "view_001", "32x24", "40x52"):
        assert name in text
    data = json.loads(json.dumps(found.to_json(), allow_nan=False))
    assert data["recommendation"] == {
        "footprint": found.footprint, "sh_degree": 0, "filter_3d": False, "orthographic": False, "off_center": False,
    }  # fmt: skip
    assert [finding["name"] for finding in data["findings"]] == [finding.name for finding in found.findings]
    assert find(found, "outputs").cost > 0
    assert ar.plan(scene, views, TOLERANCE, views) == found.effects


@pytest.mark.parametrize("tolerance", [0, TOLERANCE])
def test_bad_numbers(device, tolerance):
    """Gaussians that are not finite are culled, and do not hide what the others call for."""
    scene = random_scene(device, count=200, bands="large")
    scene.means[3], scene.shs[5, 12], scene.logit_opacities[7] = (math.nan,) * 3
    scene.log_scales[9] = math.inf
    found = ar.inspect_scene(scene, settings(device), tolerance, settings(device), rounds=1)
    check_recommendation(scene, settings(device), found)
    assert not found.shown[[3, 5, 7, 9]].any() and found.effects.sh_degree is None
    json.dumps(found.to_json(), allow_nan=False)
    if tolerance == 0:
        assert found.footprint == planner.REFERENCE


def test_empty_scene(device):
    full = random_scene(device, bands="large")
    scene = full.rows(slice(0))
    found = ar.inspect_scene(scene, settings(device), training_views=settings(device), rounds=1)
    assert found.effects.sh_degree == 0 and found.shown.shape == (0,)
    assert all(view.shown == 0 and view.rms == 0 for view in found.views)
    json.dumps(found.to_json(), allow_nan=False)
    assert found.to_text()


@pytest.mark.parametrize(
    ("changed", "error", "message"),
    [
        ({"scene": {}}, TypeError, "scene must be Gaussians, got dict"),
        ({"views": []}, ValueError, "views must hold at least one view, got none"),
        ({"views": [3]}, TypeError, "views must hold io.View or GaussianRasterizationSettings, got int"),
        ({"views": settings("cpu")[0]}, TypeError, "views must hold io.View or GaussianRasterizationSettings, got int"),
        ({"views": None}, TypeError, "views must be a list of views, got NoneType"),
        ({"training_views": []}, ValueError, "training_views must hold at least one view, got none"),
        ({"tolerance": -1}, ValueError, "tolerance must be finite and not negative, got -1"),
        ({"tolerance": math.nan}, ValueError, "tolerance must be finite and not negative, got nan"),
        ({"tolerance": "1"}, TypeError, "tolerance must be a number, got '1'"),
        ({"rounds": 0}, ValueError, "rounds must be a positive whole number, got 0"),
    ],
)
def test_errors_come_before_anything_is_rendered(monkeypatch, changed, error, message):
    monkeypatch.setattr(planner, "render_stages", None)
    arguments = {"scene": random_scene("cpu", count=3), "views": settings("cpu")} | changed
    with pytest.raises(error, match=message):
        ar.inspect_scene(**arguments)
    if "rounds" not in changed:
        with pytest.raises(error, match=message):
            ar.plan(**arguments)


@pytest.mark.parametrize("name", ["plant", "hqgarden"])
def test_trained_scenes(name, request):
    inputs, _ = request.getfixturevalue(name)
    scene = of_inputs(inputs)
    stored = {"plant": "plant_sh3_lo.json", "hqgarden": "hqgarden_lod1_sh0_lo.json"}[name]
    view = io.load_views(SHARED / "data" / stored)[0]
    torch.set_num_threads(2)
    found = ar.inspect_scene(scene, [view], TOLERANCE, [at(view, 8)], rounds=1)
    check_recommendation(scene, [view.settings()], found)
    assert found.footprint != "box:samples=1" and found.effects.filter_3d is None
    assert found.views[0].narrow > 0.9
    assert found.shown.sum() > 0.9 * len(scene.means) or name == "hqgarden"


def test_a_lens_belongs_to_the_camera():
    """What is recommended is measured in its pictures."""
    scene = random_scene("cpu", count=100)
    pose = torch.eye(4, dtype=torch.float64)
    pose[2, 3] = 4.0
    view = io.View("v", 83, 61, 60.0, 60.0, pose, lens=ar.Lens.fisheye((0.05,)))
    settings = view.settings()
    got = planner._stages(scene, settings, "box:samples=1", ar.Effects())
    expected = ar.render_stages(settings._replace(footprint="box:samples=1", sh_degree=0), **scene.arguments())
    assert torch.equal(got.color, expected.color)
    assert planner.inspect_scene(scene, [view], rounds=1).views[0].shown > 0


@pytest.mark.parametrize("count", [1, 3])
def test_progress_is_told_as_often_as_announced(clock, count):
    views, told = (settings("cpu") * 2)[:count], []
    ar.inspect_scene(random_scene("cpu", count=30), views, progress=told.append)
    assert len(told) == planner.steps_of(views)
    assert list(dict.fromkeys(told)) == ["compare footprints", "time footprints", "look at views", "time effects"]


def test_splats_that_are_no_picture_of_their_gaussians():
    """Large Gaussians right before a camera bend; small ones do not."""
    pose = torch.eye(4, dtype=torch.float64)
    pose[2, 3] = 4.0
    view = io.View("wide", 83, 61, 30.0, 30.0, pose, lens=ar.Lens.fisheye())
    for sizes, needed in (("fine", False), ("large", True)):
        scene = random_scene("cpu", count=200, sizes=sizes)
        (finding,) = (f for f in planner.inspect_scene(scene, [view], rounds=1).findings if f.name == "affine picture")
        assert finding.needed is needed and "wide shows" in finding.reason
        assert finding.recommendation == ("pictures of narrower views" if needed else "as it is")
