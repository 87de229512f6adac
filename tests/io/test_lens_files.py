"""Lenses in files: COLMAP's cameras, nerfstudio's frames, our own views; and what commands make of them."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from ply_files import ply, vertices

import analytic_rasterizer as ar
from analytic_rasterizer import io
from analytic_rasterizer.io import lenses

EYE = torch.eye(4, dtype=torch.float64)
# Focal lengths, principal point and coefficients for a picture of 640 x 480 px, by COLMAP's names.
PARAMETERS = {
    "SIMPLE_PINHOLE": [400.0, 321.0, 239.0],
    "PINHOLE": [400.0, 410.0, 321.0, 239.0],
    "SIMPLE_RADIAL": [400.0, 321.0, 239.0, -0.12],
    "RADIAL": [400.0, 321.0, 239.0, -0.12, 0.03],
    "OPENCV": [400.0, 410.0, 321.0, 239.0, -0.12, 0.03, 0.002, -0.003],
    "FULL_OPENCV": [400.0, 410.0, 321.0, 239.0, -0.12, 0.03, 0.002, -0.003, 0.01, 0.05, -0.02, 0.004],
    "SIMPLE_FISHEYE": [200.0, 321.0, 239.0],
    "FISHEYE": [200.0, 210.0, 321.0, 239.0],
    "SIMPLE_RADIAL_FISHEYE": [200.0, 321.0, 239.0, 0.02],
    "RADIAL_FISHEYE": [200.0, 321.0, 239.0, 0.02, -0.004],
    "OPENCV_FISHEYE": [200.0, 210.0, 321.0, 239.0, 0.02, -0.004, 0.001, -1e-5],
    "THIN_PRISM_FISHEYE": [200.0, 210.0, 321.0, 239.0, 0.02, -0.004, 0.002, -0.003, 0.001, -1e-5, 0.004, -0.005],
    "RAD_TAN_THIN_PRISM_FISHEYE": [
        200.0, 210.0, 321.0, 239.0, 0.02, -0.004, 0.001, -1e-5, 4e-6, -3e-7, 0.002, -0.003, 0.004, 0.001, -0.005, 2e-4
    ],
    "FOV": [300.0, 310.0, 321.0, 239.0, 0.9],
    "EQUIRECTANGULAR": [640.0, 480.0],
}  # fmt: skip
REFUSED = {
    "SIMPLE_DIVISION": [400.0, 321.0, 239.0, -0.1],
    "DIVISION": [400.0, 410.0, 321.0, 239.0, -0.1],
    "EUCM": [400.0, 410.0, 321.0, 239.0, 0.5, 1.0],
}


def test_every_model_is_read_or_refused():
    assert set(PARAMETERS) == set(lenses.NAMES) and set(REFUSED) == set(lenses.REFUSED)


def view_of(model):
    pinhole, lens = lenses.lens_of_colmap(model, PARAMETERS[model], "a camera")
    return io.View("a", 640, 480, w2c=EYE, lens=lens, **pinhole)


@pytest.mark.parametrize("model", PARAMETERS)
def test_pixels_are_those_of_pycolmap(model):
    """To 1e-9 px, in front of the camera: behind it COLMAP has no answer."""
    pycolmap = pytest.importorskip("pycolmap", reason="compares with COLMAP")
    camera = pycolmap.Camera(model=model, width=640, height=480, params=PARAMETERS[model])
    points = np.random.default_rng(0).uniform((-0.8, -0.6, 1.0), (0.8, 0.6, 2.0), (500, 3))
    got = view_of(model).pixels_of(torch.from_numpy(points)).numpy()
    assert np.abs(got - camera.img_from_cam(points)).max() < 1e-9


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("model", ["perspective", "fisheye"])
def test_positions_are_those_of_opencv(model, sign):
    """To 1e-9 focal lengths, in front of the camera, with all of OpenCV's coefficients; also next to the axis."""
    cv2 = pytest.importorskip("cv2", reason="compares with OpenCV")
    points = np.random.default_rng(0).uniform((-0.8, -0.6, 1.0), (0.8, 0.6, 2.0), (500, 3))
    points[::5, :2] *= 1e-6
    zero, one = np.zeros(3), np.eye(3)
    if model == "perspective":
        radial, tangential, prism = (0.1, -0.05, 0.02, 0.03, 0.02, -0.01), (0.01, -0.02), (0.01, 0.02, -0.01, 0.005)
        lens = ar.Lens.perspective(*([sign * k for k in part] for part in (radial, tangential, prism)))
        k = np.array(lens.coefficients)[[0, 1, 6, 7, 2, 3, 4, 5, 8, 9, 10, 11]]
        expected = cv2.projectPoints(points, zero, zero, one, k)[0]
    else:
        points[:, :2] *= 3
        lens = ar.Lens.fisheye([sign * k for k in (0.05, 0.01, -0.001, 0.0003)])
        expected = cv2.fisheye.projectPoints(points[:, None], zero, zero, one, np.array(lens.coefficients[:4]))[0]
    got = lens.project(torch.from_numpy(points))[0].numpy()
    assert np.abs(got - expected.reshape(-1, 2)).max() < 1e-9


@pytest.mark.parametrize("model", PARAMETERS)
def test_rays_are_what_pixels_show(model):
    view = view_of(model)
    x, y = torch.meshgrid(torch.linspace(5, 635, 20), torch.linspace(5, 475, 15), indexing="xy")
    pixels = torch.stack([x, y], 2).reshape(-1, 2).double()
    rays = view.rays_of(pixels)
    assert (rays.norm(dim=1) - 1).abs().max() < 1e-12
    assert (view.pixels_of(rays) - pixels).abs().max() < 1e-6


def test_rays_beyond_90_degrees():
    view = io.View("a", 640, 640, 160.0, 160.0, EYE, lens=ar.Lens.fisheye())
    pixels = torch.tensor([[320.0, 320.0], [320 + 160 * 2.0, 320.0], [320.0, 320 - 160 * 1.8]])
    rays = view.rays_of(pixels)
    angles = torch.tensor([0.0, 2.0, 1.8], dtype=torch.float64)
    assert (torch.acos(rays[:, 2]) - angles).abs().max() < 1e-7
    assert (view.rays_of(torch.tensor([[320 + 160 * 3.2, 320.0]]))).isnan().all()  # nothing is there


def write_reconstruction(folder, models, suffix):
    """One picture for each model, by COLMAP's own library."""
    pycolmap = pytest.importorskip("pycolmap", reason="writes COLMAP's files")
    reconstruction = pycolmap.Reconstruction()
    for number, (model, parameters) in enumerate(models.items(), 1):
        camera = pycolmap.Camera(model=model, width=640, height=480, params=parameters, camera_id=number)
        reconstruction.add_camera_with_trivial_rig(camera)
        image = pycolmap.Image(name=f"{model}.png", camera_id=number, image_id=number)
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d([0, 0, 0, 1]), [0.1 * number, 0.0, 0.0])
        reconstruction.add_image_with_trivial_frame(image, pose)
    folder.mkdir(parents=True)
    write = reconstruction.write_binary if suffix == ".bin" else reconstruction.write_text
    write(str(folder))


@pytest.mark.parametrize("suffix", [".bin", ".txt"])
def test_reconstructions_of_every_model(tmp_path, suffix):
    colmap = pytest.importorskip("analytic_rasterizer.captures.colmap", reason="needs the train extra")
    write_reconstruction(tmp_path / "all", PARAMETERS, suffix)
    found = {item.name.removesuffix(".png"): item.view for item in colmap.load_views(tmp_path / "all")}
    assert set(found) == set(PARAMETERS)
    for model, view in found.items():
        expected = view_of(model)
        assert view.lens == expected.lens and (view.lens is None) == ("PINHOLE" in model)
        for name in ("width", "height", "fx", "fy", "cx", "cy"):
            assert getattr(view, name) == pytest.approx(getattr(expected, name), rel=1e-15), name
    for model, parameters in REFUSED.items():
        write_reconstruction(tmp_path / model, {model: parameters}, suffix)
        with pytest.raises(io.SceneError, match=rf"cameras: camera 1 is {model}; rendered are SIMPLE_PINHOLE, .*FOV"):
            colmap.load_views(tmp_path / model)


def frame(**members):
    return {"file_path": "a.png", "transform_matrix": EYE.tolist(), **members}


def write_transforms(path, frames, **shared):
    data = {"w": 640, "h": 480, "fl_x": 400.0, "fl_y": 410.0, "cx": 321.0, "cy": 239.0, **shared, "frames": frames}
    path.write_text(json.dumps(data))
    return path


def test_lenses_of_nerfstudio(tmp_path):
    perspective, fisheye, sphere = ar.Lens.perspective, ar.Lens.fisheye, ar.Lens.equirectangular()
    expected = [
        ({}, None),
        (
            {"camera_model": "OPENCV", "k1": -0.1, "k2": 0.02, "k3": 0.01, "p1": 0.001, "p2": 0.002},
            perspective((-0.1, 0.02, 0.01), (0.001, 0.002)),
        ),
        (
            {"camera_model": "OPENCV_FISHEYE", "k1": 0.01, "k2": 0.0, "k3": -0.02, "k4": 0.003},
            fisheye((0.01, 0.0, -0.02, 0.003)),
        ),
        ({"camera_model": "OPENCV_FISHEYE", "k1": 0, "k2": 0, "k3": 0, "k4": 0}, fisheye()),
        ({"camera_model": "PINHOLE", "k1": 0.0}, None),
        ({"is_fisheye": True, "k1": 0.01}, fisheye((0.01,))),
        ({"camera_model": "FULL_OPENCV", "k1": -0.1, "k4": 0.01}, perspective((-0.1, 0, 0, 0.01))),
        ({"camera_model": "EQUIRECTANGULAR"}, sphere),
        ({"camera_model": "OPENCV_FISHEYE", "is_fisheye": True, "k1": 0.01}, fisheye((0.01,))),
        ({"camera_model": "EQUIRECTANGULAR", "is_fisheye": False}, sphere),
    ]
    frames = [frame(**members) for members, _ in expected]
    views = io.load_views(write_transforms(tmp_path / "transforms.json", frames))
    assert [view.lens for view in views] == [lens for _, lens in expected]
    assert views[-1].fx == pytest.approx(640 / (2 * math.pi)) and views[-1].middle == (320, 240)
    shared = write_transforms(tmp_path / "shared.json", [frame(), frame(k1=0.2)], camera_model="OPENCV", k1=-0.1)
    assert [view.lens.coefficients[0] for view in io.load_views(shared)] == [-0.1, 0.2]


@pytest.mark.parametrize(
    "members, match",
    [
        ({"camera_model": "FTHETA"}, "frame 0: camera_model must be one of SIMPLE_PINHOLE, .*, got 'FTHETA'"),
        ({"camera_model": "FOV", "k1": 1.0}, "frame 0: camera_model FOV is not one of nerfstudio's"),
        ({"camera_model": "EQUIRECTANGULAR", "k1": 1.0}, "frame 0: EQUIRECTANGULAR must have no coefficients, got k1"),
        (
            {"k4": 0.1},
            "frame 0: a lens of OPENCV must have no coefficients but k1, k2, k3, p1, p2, got k4 = 0.1; .* 8th power, "
            "which OpenCV's lens does not have: undistort the pictures first, or fit FULL_OPENCV",
        ),
        ({"camera_model": "OPENCV", "is_fisheye": True}, "a lens of OPENCV must have no .*, got is_fisheye = True"),
        ({"distortion_params": [0.0, 0.1]}, r"got distortion_params = \[0.0, 0.1\]; undistort the pictures first"),
        ({"camera_model": "OPENCV_FISHEYE", "p1": 0.1}, "OPENCV_FISHEYE must have no coefficients but k1, k2, k3, k4"),
        ({"k1": math.nan}, "frame 0: every number of radial must be finite, got nan"),
        ({"k1": "much"}, "frame 0: every number of radial must be a number, got 'much'"),
        ({"k1": 10**400}, "frame 0: every number of radial must be finite, got 1000"),
        ({"k1": True}, "frame 0: every number of radial must be a number, got True"),
    ],
)
def test_frames_that_are_refused(tmp_path, members, match):
    with pytest.raises(io.SceneError, match=match):
        io.load_views(write_transforms(tmp_path / "transforms.json", [frame(**members)]))


LENSES = [None, ar.Lens.perspective((-0.1, 0.02), (0.001, 0.002), (0.003,)), ar.Lens.fisheye((0.02,)), ar.Lens.fov(0.9)]
LENSES += [ar.Lens.fisheye(), ar.Lens.rad_tan_fisheye((0.1,), (0.01, 0.02), (0.0, 0.0, 0.0, 0.3))]


def test_files_of_views_keep_lenses(tmp_path):
    files = pytest.importorskip("analytic_rasterizer.training.files", reason="needs the train extra")
    views = [io.View(f"v{k}", 64, 48, 40.0, 41.0, EYE, 31.0, 25.0, lens=lens) for k, lens in enumerate(LENSES)]
    io.save_views(tmp_path / "views.json", views)
    assert io.load_views(tmp_path / "views.json") == views
    files.write_cameras(tmp_path / "cameras.json", views)
    assert io.load_views(tmp_path / "cameras.json") == views
    entries = json.loads((tmp_path / "views.json").read_text())
    assert "lens" not in entries[0] and entries[3]["lens"] == {"model": "fov", "coefficients": [0.9]}
    for wrong in ("wide", {"model": "wide", "coefficients": []}, {"model": "fisheye", "coefficients": ["a"]}, {}):
        entries[1]["lens"] = wrong
        (tmp_path / "wrong.json").write_text(json.dumps(entries))
        with pytest.raises(io.SceneError, match=r"wrong\.json: view 1: lens"):
            io.load_views(tmp_path / "wrong.json")


@pytest.mark.parametrize("lens", LENSES[1:])
def test_a_view_with_a_lens_makes_settings(lens):
    """At any scale and in any crop the same direction is at the same point of the picture."""
    view = io.View("v", 64, 48, 30.0, 31.0, EYE, 31.0, 25.0, lens=lens)
    settings = view.settings()
    assert replace(settings.effects.lens, reach=None) == lens and settings.effects.lens.reach > 0
    assert view.settings(effects="auto").effects.lens is not None
    assert view.settings(effects=ar.Effects(alpha=True)).effects.alpha
    with pytest.raises(ValueError, match=r"effects\.lens must be None where the camera has a lens"):
        view.settings(effects=ar.Effects(lens=ar.Lens.fov(0.5)))
    half = view.scaled(0.5)
    points = torch.tensor([[0.3, 0.2, 1.0], [-0.4, 0.1, 1.5]])
    assert torch.allclose(half.pixels_of(points), view.pixels_of(points) / 2)
    # A small Gaussian is drawn where the view says.
    mean = torch.tensor([[0.2, -0.1, 1.0]])
    gaussian = {"means3D": mean, "means2D": None, "opacities": torch.ones(1, 1), "scales": torch.full((1, 3), 0.01)}
    gaussian |= {"rotations": torch.tensor([[1.0, 0, 0, 0]]), "colors_precomp": torch.ones(1, 3)}
    image, _ = ar.GaussianRasterizer(view.settings(sh_degree=0, footprint="box"))(**gaussian)
    weight = image[0] / image[0].sum()
    y, x = torch.meshgrid(torch.arange(48) + 0.5, torch.arange(64) + 0.5, indexing="ij")
    seen = torch.stack([(weight * x).sum(), (weight * y).sum()])
    assert (seen - view.pixels_of(mean)[0]).abs().max() < 0.05


def test_sampling_intervals_of_lenses():
    """The inverse of the smaller derivative of the picture by world units, by differences."""
    means = torch.tensor([[0.3, 0.2, 2.0], [-0.4, 0.1, 1.5], [9.0, 0.0, 1.0], [0.0, 0.0, -1.0]], dtype=torch.float64)
    pinhole = io.View("v", 64, 48, 30.0, 30.0, EYE)
    plain = ar.compute_3d_filter(means[:2], [pinhole.settings(dtype=torch.float64)])
    exact = replace(pinhole, lens=ar.Lens.perspective()).settings(dtype=torch.float64)
    assert torch.allclose(ar.compute_3d_filter(means[:2], [exact]), plain, rtol=1e-10)
    for lens in LENSES[1:]:
        view = replace(pinhole, lens=lens)
        got = ar.compute_3d_filter(means, [view.settings(dtype=torch.float64)], variance=1.0)
        step = 1e-6
        slopes = [(view.pixels_of(means[:2] + step * axis) - view.pixels_of(means[:2])) / step for axis in torch.eye(3)]
        smaller = torch.linalg.svdvals(torch.stack(slopes, 2))[:, 1]
        assert torch.allclose(got[:2], 1 / smaller, rtol=1e-4), lens
        assert (got[2:] == got[:2].max()).all()  # seen by no camera


@pytest.mark.parametrize(
    "lens", [ar.Lens.perspective((-0.15, 0.03)), ar.Lens.fisheye((0.03,)), ar.Lens.equirectangular()]
)
def test_training_with_lenses(tmp_path, lens):
    """Pictures of a scene through a lens make the scene again, on the way of the trainer that the lens has."""
    image = pytest.importorskip("PIL.Image", reason="needs the train extra")
    training = pytest.importorskip("analytic_rasterizer.training", reason="needs the train extra")
    from capture_files import circle, opengl_pose, truth_gaussians
    from training_step import check_next_step

    truth = truth_gaussians()
    points = truth.means.detach()
    sphere = lens.model == "equirectangular"
    size = {"w": 96, "h": 48} if sphere else {"w": 40, "h": 32}
    names = {"perspective": "OPENCV", "fisheye": "OPENCV_FISHEYE", "equirectangular": "EQUIRECTANGULAR"}
    given = dict(zip(("k1", "k2"), lens.coefficients)) if not sphere else {}
    frames = []
    for view in circle(9):
        frames.append(frame(camera_model=names[lens.model], fl_x=40.0, **given, **size))
        frames[-1] |= {"file_path": f"{view.name}.png", "transform_matrix": opengl_pose(view)}
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": frames}))
    for frame_of, name in ((f, f["file_path"]) for f in frames):
        image.new("RGB", (frame_of["w"], frame_of["h"])).save(tmp_path / name)
    for view, frame_of in zip(io.load_views(tmp_path / "transforms.json"), frames):
        assert view.lens.model == lens.model
        with torch.no_grad():
            shown, _ = ar.GaussianRasterizer(view.settings(sh_degree=0, footprint="box:samples=16"))(
                means2D=None, **truth.arguments()
            )
        levels = (255 * shown.clamp(0, 1)).round().byte().permute(1, 2, 0).numpy()
        image.fromarray(levels).save(tmp_path / frame_of["file_path"])
    (tmp_path / "sparse_pc.ply").write_bytes(ply(vertices("xyz", points), layout="ascii"))
    options = training.TrainingOptions(iterations=400, density="none", sh_degree=0)
    run = training.Run(tmp_path, tmp_path / "out", options)
    before = run.evaluate()["test"]["mean"]["psnr"]
    run.train()
    assert run.evaluate()["test"]["mean"]["psnr"] > before + 3
    check_next_step(run.trainer)


@pytest.mark.parametrize("lens", [*LENSES, ar.Lens.equirectangular()])
def test_random_points_are_in_the_pictures_of_lenses(lens):
    placement = pytest.importorskip("analytic_rasterizer.captures.placement", reason="needs the train extra")
    from capture_files import circle

    sphere = {"width": 64, "height": 32, "fx": 64 / (2 * math.pi), "fy": 32 / math.pi}
    changed = sphere if lens is not None and lens.model == "equirectangular" else {"fx": 30.0, "fy": 30.0}
    views = [replace(view, lens=lens, **changed) for view in circle(6, (64, 48))]
    points, _ = placement.points_in_view(views, 300, seed=0)
    assert points.isfinite().all()
    shown = torch.zeros(300, dtype=torch.bool)
    for view in views:
        pixels = view.pixels_of(points.double() @ view.w2c[:3, :3].T + view.w2c[:3, 3])
        shown |= ((pixels >= -0.01) & (pixels <= torch.tensor([view.width, view.height]) + 0.01)).all(1)
    assert shown.all()
