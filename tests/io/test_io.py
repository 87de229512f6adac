"""Scenes and views: what is read is what the file's own conventions say, and faults are named."""

import errno
import json
import math
import os
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from cli_extra import image
from gaussians import random_gaussians
from places import SHARED

from analytic_rasterizer import io
from analytic_rasterizer.gaussians import Gaussians

# ------------------------------------------------------------------------------------- scenes


def ply_columns(degree, extra=()):
    """Vertex properties in the order that 3DGS training writes them."""
    rest = 3 * ((degree + 1) ** 2 - 1)
    return [
        *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"),
        *(f"f_rest_{i}" for i in range(rest)),
        *("opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
        *extra,
    ]


def write_ply(path, columns, rows, kinds=None, form="binary_little_endian", after=""):
    """A .ply by hand. `kinds` maps a column to its type where that is not float."""
    kinds = kinds or {}
    types = {"float": "<f4", "double": "<f8", "uchar": "u1"}
    data = np.zeros(len(rows), [(name, types[kinds.get(name, "float")]) for name in columns])
    for i, name in enumerate(columns):
        data[name] = rows[:, i]
    properties = "".join(f"property {kinds.get(name, 'float')} {name}\n" for name in columns)
    header = f"ply\nformat {form} 1.0\nelement vertex {len(rows)}\n{properties}{after}end_header\n"
    path.write_bytes(header.encode() + data.tobytes())
    return path


def random_rows(columns, count=5, seed=0):
    return np.random.default_rng(seed).normal(size=(count, len(columns))).astype(np.float32)


@pytest.mark.parametrize("degree", range(4))
def test_ply_by_hand(tmp_path, degree):
    columns = ply_columns(degree)
    rows = random_rows(columns)
    scene = io.load_scene(write_ply(tmp_path / "scene.ply", columns, rows))
    column = {name: torch.from_numpy(rows[:, i]) for i, name in enumerate(columns)}

    def stack(*names):
        return torch.stack([column[name] for name in names], 1)

    bands = (degree + 1) ** 2 - 1
    assert scene.sh_degree == degree
    assert scene.shs.shape == (5, bands + 1, 3)
    assert all(field.dtype == torch.float32 and field.is_contiguous() for field in scene)
    torch.testing.assert_close(scene.means, stack("x", "y", "z"), rtol=0, atol=0)
    torch.testing.assert_close(scene.scales, stack("scale_0", "scale_1", "scale_2").exp())
    torch.testing.assert_close(scene.rotations, stack("rot_0", "rot_1", "rot_2", "rot_3"))
    torch.testing.assert_close(scene.opacities, stack("opacity").sigmoid())
    torch.testing.assert_close(scene.shs[:, 0], stack("f_dc_0", "f_dc_1", "f_dc_2"))
    for channel in range(3):  # f_rest runs through all bands of red, then of green, then of blue
        for band in range(bands):
            expected = column[f"f_rest_{channel * bands + band}"]
            torch.testing.assert_close(scene.shs[:, 1 + band, channel], expected)


@pytest.mark.parametrize("name", ["scene.ply", "scene.compressed.ply", "scene.spz"])
def test_scene_without_gaussians(tmp_path, name):
    io.save_scene(tmp_path / name, random_gaussians(degree=0).rows(slice(0)))
    loaded = io.load_scene(tmp_path / name)
    assert [tuple(f.shape) for f in loaded] == [(0, 3), (0, 3), (0, 4), (0, 1), (0, 1, 3)]


def test_save_scene_keeps_opaque_gaussians_finite(tmp_path):
    scene = random_gaussians(degree=0, count=3)
    scene = scene.with_activated(opacities=torch.tensor([[0.0], [1.0], [0.5]]))
    io.save_scene(tmp_path / "scene.ply", scene)
    loaded = io.load_scene(tmp_path / "scene.ply")
    torch.testing.assert_close(loaded.opacities, scene.opacities, rtol=0, atol=2e-6)


def test_harmonics_of_degree_four_go_where_they_can_be_read(tmp_path):
    shs = torch.rand(5, 25, 3, generator=torch.Generator().manual_seed(0))
    scene = Gaussians.from_activated(torch.ones(5, 3), torch.ones(5, 3), torch.ones(5, 4), torch.full((5, 1), 0.5), shs)
    with pytest.raises(io.SceneError, match=r"a\.spz: harmonics of degree 4 have no place in this format"):
        io.save_scene(tmp_path / "a.spz", scene)
    assert not (tmp_path / "a.spz").exists()
    io.save_scene(tmp_path / "a.compressed.ply", scene)
    assert io.load_scene(tmp_path / "a.compressed.ply").sh_degree == 4
    io.save_scene(tmp_path / "a.ply", scene)
    assert torch.equal(io.load_scene(tmp_path / "a.ply").shs, shs)


@pytest.mark.parametrize("name", ["a.ply", "a.compressed.ply", "a.spz"])
def test_what_cannot_be_saved_leaves_the_file(tmp_path, name):
    """An .spz of fields of different lengths could not be read, and NaN became a place or an opacity."""
    scene = io.load_scene(hand_written(tmp_path))
    path, count = tmp_path / "saved" / name, len(scene.means)
    path.parent.mkdir()
    path.write_bytes(b"before")
    wrong = [
        (
            scene._replace(log_scales=scene.log_scales[1:]),
            rf"log_scales must have shape \({count}, 3\), got \({count - 1}, 3\)",
        ),
        (scene._replace(logit_opacities=scene.logit_opacities[1:]), r"logit_opacities must have shape"),
        (scene._replace(shs=scene.shs[:, :1].repeat(1, 5, 1)), r"shs must have shape"),
    ]
    if name != "a.ply":  # which holds what it is given
        for field in scene._fields:
            broken = getattr(scene, field).clone()
            broken[1] = math.nan
            shown = field.removeprefix("log_").removeprefix("logit_")
            wrong.append((scene._replace(**{field: broken}), f"{shown} must be finite, got 1 of {count} rows not"))
        infinite = scene._replace(log_scales=torch.full_like(scene.log_scales, math.inf))
        wrong.append((infinite, "scales must be finite"))
    for given, message in wrong:
        with pytest.raises(io.SceneError, match=message):
            io.save_scene(path, given)
    assert path.read_bytes() == b"before" and list(path.parent.iterdir()) == [path]


@pytest.mark.parametrize("largest, step", [(2000.0, 2**-12), (3000.0, 2**-11), (4e6, 0.5)])
def test_spz_holds_distant_gaussians(tmp_path, largest, step):
    """They were moved to 2,048 units."""
    scene = io.load_scene(hand_written(tmp_path))
    scene.means[1] = torch.tensor([largest, -largest, 1.0])
    io.save_scene(tmp_path / "a.spz", scene)
    torch.testing.assert_close(io.load_scene(tmp_path / "a.spz").means, scene.means, rtol=0, atol=step / 2)
    scene.means[0, 2] = -5e6
    with pytest.raises(io.SceneError, match=r"a\.spz: an \.spz holds means up to 2\^22, got 5e\+06"):
        io.save_scene(tmp_path / "a.spz", scene)


def test_scenes_with_gradients_are_saved(tmp_path):
    scene = io.load_scene(hand_written(tmp_path))
    io.save_scene(tmp_path / "b.ply", scene.map(lambda field: field.clone().requires_grad_()))
    assert torch.equal(io.load_scene(tmp_path / "b.ply").means, scene.means)


def test_save_scene_refuses_what_is_no_scene(tmp_path):
    for given in (random_gaussians()._asdict(), tuple(random_gaussians()), None):
        with pytest.raises(TypeError, match=f"scene must be Gaussians, got {type(given).__name__}"):
            io.save_scene(tmp_path / "a.ply", given)
    assert not list(tmp_path.iterdir())


def test_save_scene_refuses_other_suffixes(tmp_path):
    with pytest.raises(io.SceneError, match=r"expected a \.ply, \.compressed\.ply, .* or meta\.json name, got '\.obj'"):
        io.save_scene(tmp_path / "scene.obj", random_gaussians())


def cut(path, keep):
    path.write_bytes(path.read_bytes()[:keep])
    return path


def hand_written(tmp_path, **change):
    columns = change.pop("columns", ply_columns(0))
    rows = change.pop("rows", random_rows(columns))
    return write_ply(tmp_path / "scene.ply", columns, rows, **change)


def with_value(tmp_path, column, value):
    columns = ply_columns(1)
    rows = random_rows(columns)
    rows[[1, 3], columns.index(column)] = value
    return hand_written(tmp_path, columns=columns, rows=rows)


def saved(tmp_path, name):
    io.save_scene(tmp_path / name, random_gaussians())
    return tmp_path / name


def text_file(tmp_path, name, text):
    (tmp_path / name).write_text(text)
    return tmp_path / name


@pytest.mark.parametrize(
    ("write", "message"),
    [
        (lambda d: d / "none.ply", "no such file"),
        (
            lambda d: text_file(d, "a.obj", "ply\n"),
            "expected a .ply, .spz, .sog, .splat, .glb, .gltf, .usd file or a meta.json, got",
        ),
        (lambda d: hand_written(d, form="ascii"), "cut short|17 numbers in every row"),
        (
            lambda d: hand_written(d, columns=[c for c in ply_columns(0) if c != "opacity"]),
            "missing vertex properties opacity;",
        ),
        (lambda d: cut(saved(d, "a.compressed.ply"), 3000), "cut short"),
        (lambda d: cut(saved(d, "a.spz"), -20), "cut short .Could not gunzip"),
        (lambda d: text_file(d, "a.spz", "not a scene"), "Not an SPZ file"),
    ],
)
def test_scenes_that_cannot_be_used(tmp_path, write, message):
    path = write(tmp_path)
    with pytest.raises(io.SceneError, match=message) as caught:
        io.load_scene(path, strict=True)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("logit", "opacity"), [(np.inf, 1.0), (-np.inf, 0.0)])
def test_infinite_logits_are_opacities(tmp_path, logit, opacity):
    scene = io.load_scene(with_value(tmp_path, "opacity", logit))
    assert scene.opacities[1] == opacity


def test_missing_library_names_the_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "gsply", None)
    scene = io.load_scene(hand_written(tmp_path))  # which nothing is needed for
    for name in ("a.spz", "a.compressed.ply"):
        with pytest.raises(ImportError, match=r'gsply: pip install "analytic_rasterizer\[cli\]"'):
            io.save_scene(tmp_path / name, scene)
    (tmp_path / "a.spz").write_bytes(b"")
    with pytest.raises(ImportError, match=r'gsply: pip install "analytic_rasterizer\[cli\]"'):
        io.load_scene(tmp_path / "a.spz")


# -------------------------------------------------------------------------------------- views

ROTATION = torch.linalg.matrix_exp(
    torch.tensor([[0.0, -0.3, 0.5], [0.3, 0.0, 0.2], [-0.5, -0.2, 0.0]], dtype=torch.float64)
)  # camera to world
POSITION = torch.tensor([0.4, -1.2, 2.5], dtype=torch.float64)
OPENGL = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))


def world_to_camera():
    w2c = torch.eye(4, dtype=torch.float64)
    w2c[:3, :3], w2c[:3, 3] = ROTATION.T, -ROTATION.T @ POSITION
    return w2c


def opengl_to_world():
    c2w = torch.eye(4, dtype=torch.float64)
    c2w[:3, :3], c2w[:3, 3] = ROTATION @ OPENGL, POSITION
    return c2w


LISTED = {"width": 120, "height": 80, "fx": 110.0, "fy": 105.0, "w2c": world_to_camera().tolist()}
CAMERA = {"id": 0, "img_name": "left/0001.jpg", "width": 120, "height": 80, "position": POSITION.tolist()}
CAMERA |= {"rotation": ROTATION.tolist(), "fx": 110.0, "fy": 105.0}
FRAME = {"file_path": "./train/r_0", "transform_matrix": opengl_to_world().tolist()}
TRANSFORMS = {"w": 120, "h": 80, "fl_x": 110.0, "fl_y": 105.0, "frames": [FRAME]}


def write_json(tmp_path, data):
    path = tmp_path / "views.json"
    path.write_text(data if isinstance(data, str) else json.dumps(data))
    return path


def without(entry, *keys):
    return {key: value for key, value in entry.items() if key not in keys}


@pytest.mark.parametrize(
    ("data", "name"),
    [
        ([LISTED], "view_000"),
        ([LISTED | {"w2c": world_to_camera().flatten().tolist()}], "view_000"),
        ([LISTED | {"name": "front"}], "front"),
        ([CAMERA], "0001"),
        (TRANSFORMS, "r_0"),
        ({"frames": [without(TRANSFORMS, "frames") | FRAME]}, "r_0"),
        (TRANSFORMS | {"w": 7, "fl_x": 3, "frames": [FRAME | {"w": 120, "fl_x": 110}]}, "r_0"),
        (
            without(TRANSFORMS, "fl_x", "fl_y")
            | {"camera_angle_x": 2 * math.atan(120 / 2 / 110), "camera_angle_y": 2 * math.atan(80 / 2 / 105)},
            "r_0",
        ),
    ],
)
def test_every_form_gives_the_same_view(tmp_path, data, name):
    (view,) = io.load_views(write_json(tmp_path, data))
    assert (view.name, view.width, view.height) == (name, 120, 80)
    assert (view.fx, view.fy) == pytest.approx((110.0, 105.0), rel=1e-12)
    assert (view.cx, view.cy) == (None, None)
    assert view.w2c.dtype == torch.float64
    torch.testing.assert_close(view.w2c, world_to_camera(), rtol=0, atol=1e-12)


@pytest.mark.parametrize("data", [[LISTED], [CAMERA], TRANSFORMS])
def test_principal_point_is_read(tmp_path, data):
    centre = {"cx": 50.5, "cy": 44}
    data = [data[0] | centre] if isinstance(data, list) else data | centre
    (view,) = io.load_views(write_json(tmp_path, data))
    assert (view.cx, view.cy) == (50.5, 44)


def test_focal_length_of_one_angle_serves_both_axes(tmp_path):
    data = without(TRANSFORMS, "fl_x", "fl_y") | {"camera_angle_x": 0.7}
    (view,) = io.load_views(write_json(tmp_path, data))
    assert view.fx == view.fy == pytest.approx(60 / math.tan(0.35))


@pytest.mark.parametrize("picture", ["train/r_0", "train/r_0.png"])
def test_size_from_the_first_picture_there_is(tmp_path, picture):
    (tmp_path / "train").mkdir()
    image.new("RGBA", (31, 17)).save(tmp_path / picture, format="PNG")
    frames = [FRAME | {"file_path": "./train/missing"}, FRAME]
    data = {"camera_angle_x": 0.7, "frames": frames}
    views = io.load_views(write_json(tmp_path, data))
    assert [(view.width, view.height) for view in views] == [(31, 17)] * 2
    views = io.load_views(write_json(tmp_path, data), size=(62, 34))
    assert [(view.width, view.height, view.fx) for view in views] == [(62, 34, pytest.approx(31 / math.tan(0.35)))] * 2


def test_every_picture_has_its_own_size(tmp_path):
    """The angle spans the width of each: pixels of a portrait beside a landscape were oblong."""
    sizes = [(40, 20), (20, 40)]
    for i, size in enumerate(sizes):
        image.new("RGB", size).save(tmp_path / f"{i}.png")
    frames = [FRAME | {"file_path": f"{i}.png"} for i in range(2)]
    views = io.load_views(write_json(tmp_path, {"camera_angle_x": 0.7, "frames": frames}))
    assert [(view.width, view.height) for view in views] == sizes
    for view in views:
        assert view.fx == view.fy == pytest.approx(view.width / 2 / math.tan(0.35))


def test_stated_size_goes_before_the_callers(tmp_path):
    (view,) = io.load_views(write_json(tmp_path, TRANSFORMS), size=(7, 5))
    assert (view.width, view.height) == (120, 80)


def test_names_are_safe_and_distinct(tmp_path):
    names = ["a/b.png", "b.JPG", "..", "../..\\x y.png", "", None, 3, "frame.0001", "b"]
    views = io.load_views(write_json(tmp_path, [LISTED | {"name": name} for name in names]))
    assert [view.name for view in views] == [
        *("b", "b_2", "view_002", "x_y", "view_004", "view_005", "view_006", "frame.0001", "b_3")
    ]


def test_a_byte_order_mark_is_passed_over(tmp_path):
    views = [io.View("a", 40, 30, 50.0, 51.0, torch.eye(4, dtype=torch.float64))]
    io.save_views(tmp_path / "v.json", views)
    text = (tmp_path / "v.json").read_text()
    (tmp_path / "v.json").write_text(text, encoding="utf-8-sig")
    assert [view.name for view in io.load_views(tmp_path / "v.json")] == ["a"]


def test_another_default_device_changes_nothing(tmp_path):
    """Files are read to the CPU. "meta" stands for any other device."""
    io.save_scene(tmp_path / "a.ply", scene := io.load_scene(hand_written(tmp_path)))
    io.save_views(tmp_path / "v.json", [io.View("a", 40, 30, 50.0, 51.0, torch.eye(4, dtype=torch.float64))])
    with torch.device("meta"):
        again, (view,) = io.load_scene(tmp_path / "a.ply"), io.load_views(tmp_path / "v.json")
    assert again.means.device.type == view.w2c.device.type == "cpu"
    assert torch.equal(again.means, scene.means)


def test_views_with_numbers_of_numpy_are_saved(tmp_path):
    pose = torch.eye(4, dtype=torch.float64)
    view = io.View("a", np.int64(40), np.uint16(30), np.float32(50.5), np.float64(51), pose, cx=np.float32(3.5))
    io.save_views(tmp_path / "v.json", [view])
    assert io.load_views(tmp_path / "v.json") == [view] == [io.View("a", 40, 30, 50.5, 51.0, pose, cx=3.5)]


def test_views_are_equal_by_their_values():
    """Comparing two views raised an error of torch about the truth of a tensor."""
    view, again, moved = (io.View("a", 40, 30, 50.0, 51.0, torch.eye(4, dtype=torch.float64)) for _ in range(3))
    moved.w2c[0, 3] = 1
    assert view == again and hash(view) == hash(again) and view in [moved, again]
    assert view != moved and view != replace(view, cx=3.0) and view != "a" and {view, again} == {view}


def test_views_round_trip(tmp_path):
    views = io.load_views(write_json(tmp_path, [CAMERA, LISTED | {"cx": 3.25, "cy": 80}]))
    io.save_views(tmp_path / "again.json", views)
    for left, right in zip(views, io.load_views(tmp_path / "again.json")):
        assert torch.equal(left.w2c, right.w2c)
        fields = [f for f in left.__dataclass_fields__ if f != "w2c"]
        assert [getattr(left, f) for f in fields] == [getattr(right, f) for f in fields]


@pytest.mark.parametrize("scale", [1.0, 0.5, 2.0, 1 / 3])
@pytest.mark.parametrize("centre", [(None, None), (47.0, 51.5)])
def test_settings_project_as_the_pinhole_does(scale, centre):
    view = io.View("v", 120, 80, 110.0, 105.0, world_to_camera(), *centre)
    settings = view.settings(scale, (0.1, 0.2, 0.3), 2, "box", samples=1)
    width, height = settings.image_width, settings.image_height
    assert (width, height) == (round(120 * scale), round(80 * scale))
    assert settings.bg.tolist() == pytest.approx([0.1, 0.2, 0.3])
    assert settings.sh_degree == 2
    assert settings.campos.tolist() == pytest.approx(POSITION.tolist(), rel=1e-6)

    camera = torch.tensor([[0.3, -0.2, 4.0], [-1.0, 0.7, 3.0], [0.0, 0.0, 2.0]]).double()
    world = camera @ ROTATION.T + POSITION
    world = torch.cat([world, torch.ones(3, 1).double()], 1)
    clip = world @ settings.projmatrix.double()
    assert torch.allclose(clip[:, 3], camera[:, 2], rtol=1e-5)
    assert torch.allclose((world @ settings.viewmatrix.double())[:, :3], camera, atol=1e-5)
    size = torch.tensor([width, height]).double()
    pixel = ((clip[:, :2] / clip[:, 3:] + 1) * size - 1) / 2  # 3DGS: centres at integers
    full = torch.tensor([120.0, 80.0]).double()
    focal = torch.tensor([110.0, 105.0]).double()
    principal = full / 2 if centre[0] is None else torch.tensor(centre).double()
    spanned = (focal * camera[:, :2] / camera[:, 2:] + principal) * size / full  # in [0, size]
    assert torch.allclose(pixel, spanned - 0.5, atol=1e-3)


def test_settings_never_vanish():
    view = io.View("v", 120, 80, 110.0, 105.0, world_to_camera())
    assert view.size(1e-6) == (1, 1)
    for scale in (0, -1, math.nan, math.inf):
        with pytest.raises(ValueError, match="scale must be positive and finite"):
            view.settings(scale)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ("{", "not valid JSON: Expecting"),
        ("", "not valid JSON"),
        ("[" * 100_000, "not valid JSON"),
        ("1" * 10_000, "not valid JSON|expected a list"),  # a limit of Python's since 3.11
        ("3", "expected a list of views or an object with 'frames', got 3"),
        ("{}", "expected a list of views or an object with 'frames', got an object"),
        ("[]", "must be a list with at least one view, got an empty list"),
        ({"frames": []}, "frames must be a list with at least one view, got an empty list"),
        ({"frames": 3}, "frames must be a list with at least one view, got 3"),
        ([LISTED, [1]], "view 1 must be an object, got a list"),
        ([{"width": 3}], "view 0: expected 'w2c', or 'rotation' and 'position', got width"),
        ([without(CAMERA, "position")], "view 0: missing 'position', got id, img_name"),
        ([without(LISTED, "fy")], "view 0: missing 'fy'"),
        ([LISTED, without(LISTED, "width")], "view 1: missing 'width'"),
        ([LISTED | {"width": 0}], "view 0: width must be a whole number from 1 to 2.20, got 0"),
        ([LISTED | {"height": 80.5}], "height must be a whole number from 1 to 2.20, got 80.5"),
        ([LISTED | {"height": "80"}], 'height must be a whole number from 1 to 2.20, got "80"'),
        ([LISTED | {"height": True}], "height must be a whole number from 1 to 2.20, got true"),
        ([LISTED | {"fx": 0}], "fx must be a positive finite number, got 0"),
        ([LISTED | {"fx": math.nan}], "fx must be a positive finite number, got NaN"),
        ([LISTED | {"fy": math.inf}], "fy must be a positive finite number, got Infinity"),
        ([LISTED | {"fy": 1e-320}], "fy must be a positive finite number, got 1e-320"),
        ([LISTED | {"fy": 10**400}], "fy must be a positive finite number, got 1000"),
        ([LISTED | {"width": 10**400}], "width must be a whole number from 1 to 2.20, got 1000"),
        ([LISTED | {"cx": math.nan}], "cx must be a finite number, got NaN"),
        ([LISTED | {"w2c": [1.0] * 15}], "w2c must hold 4 x 4 finite numbers"),
        ([LISTED | {"w2c": [[1.0] * 4] * 3}], "w2c must hold 4 x 4 finite numbers"),
        ([LISTED | {"w2c": [math.nan] * 16}], "w2c must hold 16 finite numbers"),
        ([LISTED | {"w2c": [None] * 16}], "w2c must hold 16 finite numbers, got .null, "),
        ([LISTED | {"w2c": [1.0] * 16}], "w2c: the last row must be 0 0 0 1"),
        ([LISTED | {"w2c": [0.0] * 15 + [1.0]}], "w2c must hold a rotation"),
        ([LISTED | {"w2c": torch.diag(torch.tensor([1.0, 1, -1, 1])).tolist()}], "a rotation"),
        ([CAMERA | {"rotation": [1, 2, 3]}], "rotation must hold 3 x 3 finite numbers, got .1, 2"),
        ([CAMERA | {"rotation": [[2, 0, 0], [0, 2, 0], [0, 0, 2]]}], "must hold a rotation"),
        ([CAMERA | {"position": [1, 2]}], "position must hold 3 finite numbers, got .1, 2"),
        (without(TRANSFORMS, "fl_x"), "frame 0: expected 'fl_x', 'camera_angle_x' or 'K'"),
        (without(TRANSFORMS, "fl_x") | {"camera_angle_x": 4}, "below pi .radians., got 4"),
        (without(TRANSFORMS, "h"), "frame 0: missing 'h'"),
        (without(TRANSFORMS, "w", "h"), "no image size: expected 'w' and 'h', a picture at"),
        (TRANSFORMS | {"camera_model": "FTHETA"}, "frame 0: camera_model must be one of .*, got 'FTHETA'"),
        (TRANSFORMS | {"frames": [FRAME, {}]}, "frame 1: missing 'transform_matrix'"),
        (TRANSFORMS | {"frames": [{"transform_matrix": 1}]}, "must hold 4 x 4 finite numbers"),
    ],
)
def test_views_that_cannot_be_used(tmp_path, data, message):
    path = write_json(tmp_path, data)
    with pytest.raises(io.SceneError, match=message) as caught:
        io.load_views(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


def test_views_file_that_is_not_there(tmp_path):
    with pytest.raises(io.SceneError, match=r"none\.json: No such file"):
        io.load_views(tmp_path / "none.json")
    with pytest.raises(io.SceneError, match="expected a file of views, got a folder"):
        io.load_views(tmp_path)


def test_size_of_an_unreadable_picture(tmp_path):
    (tmp_path / "train").mkdir()
    (tmp_path / "train" / "r_0.png").write_text("no picture")
    with pytest.raises(io.SceneError, match=r"r_0\.png: unreadable or cut short \(cannot identify image file"):
        io.load_views(write_json(tmp_path, {"camera_angle_x": 0.7, "frames": [FRAME]}))


def test_picture_that_the_system_refuses(tmp_path, monkeypatch):
    """Said to be cut short, of which it says nothing. The superuser, as whom tests may run, may read everything."""
    pillow = pytest.importorskip("PIL.Image")

    def refuse(path):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))

    monkeypatch.setattr(pillow, "open", refuse)
    (tmp_path / "train").mkdir()
    (tmp_path / "train" / "r_0.png").touch()
    with pytest.raises(io.SceneError, match=r"r_0\.png: unreadable \(Permission denied\)$"):
        io.load_views(write_json(tmp_path, {"camera_angle_x": 0.7, "frames": [FRAME]}))


def test_views_of_the_shared_data():
    files = sorted((SHARED / "data").glob("*.json"))
    files += sorted((SHARED / "data").glob("*/transforms_*.json"))
    if not files:
        pytest.skip("needs the optional ../shared data next to the project")
    for file in files:
        data = json.loads(file.read_text())
        views = io.load_views(file)
        assert len(views) == len(data if isinstance(data, list) else data["frames"])
        assert len({view.name for view in views}) == len(views)


# ----------------------------------------------------------------------------------- pictures


def test_pictures_are_clamped_and_rounded():
    color = torch.tensor([-1.0, 0.0, 0.49 / 255, 0.51 / 255, 1.0, 7.0]).expand(3, 2, 6)
    picture = np.asarray(io.to_image(color))
    assert picture.shape == (2, 6, 3)
    assert picture[1, :, 2].tolist() == [0, 0, 0, 1, 255, 255]


@pytest.mark.parametrize(
    "color, error, message",
    [
        (torch.rand(3, 7, 5).numpy(), TypeError, "color must be a tensor, got ndarray"),
        (
            (torch.rand(3, 7, 5) * 255).byte(),
            TypeError,
            "color must have a floating-point dtype, with colours from 0 to 1",
        ),
        (torch.rand(7, 5, 3), ValueError, r"color must have shape \(3, H, W\), or .*, got \(7, 5, 3\)$"),
        (torch.rand(1, 3, 7, 5), ValueError, r"got \(1, 3, 7, 5\)$"),
        (torch.rand(1, 7, 5), ValueError, r"got \(1, 7, 5\): expand\(3, -1, -1\) makes it grey"),
    ],
)
def test_pictures_that_are_none_are_refused(tmp_path, color, error, message):
    for write in (io.to_image, lambda picture: io.save_image(tmp_path / "a.png", picture)):
        with pytest.raises(error, match=message):
            write(color)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name, got", [("a.xyz", "'.xyz'"), ("a.psd", "'.psd'"), ("a", "''")])
def test_pictures_have_the_suffix_of_a_format(tmp_path, name, got):
    with pytest.raises(
        ValueError, match=rf"{name}: expected the suffix of a picture, such as .png or .jpg, got {got}$"
    ):
        io.save_image(tmp_path / name, torch.rand(3, 7, 5))
    io.save_image(tmp_path / name, torch.rand(3, 7, 5), format="PNG")
    assert [path.name for path in tmp_path.iterdir()] == [name]


@pytest.mark.parametrize("channels", [3, 4])
def test_a_png_needs_no_pillow(tmp_path, monkeypatch, channels):
    color = torch.rand(channels, 7, 5, generator=torch.Generator().manual_seed(0))
    expected = np.asarray(io.to_image(color))
    with monkeypatch.context() as without:
        without.setitem(sys.modules, "PIL.Image", None)
        io.save_image(tmp_path / "a.png", color)
        with pytest.raises(ImportError):
            io.save_image(tmp_path / "a.jpg", color)
    with image.open(tmp_path / "a.png") as opened:
        assert np.array_equal(np.asarray(opened), expected) and opened.mode == ("RGB", "RGBA")[channels - 3]


def test_views_may_be_relative_to_an_offset(tmp_path):
    """Both lists keep it, and the same camera can be had in the frame of another."""
    training = pytest.importorskip("analytic_rasterizer.training", reason="needs the train extra")
    w2c = torch.eye(4, dtype=torch.float64)
    w2c[:3, :3] = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    view = io.View("a", 40, 30, 50.0, 51.0, w2c, offset=(5e5, 4.2e6, 100.0))
    io.save_views(tmp_path / "plain.json", [view])
    training.files.write_cameras(tmp_path / "cameras.json", [view])
    for name in ("plain.json", "cameras.json"):
        (read,) = io.load_views(tmp_path / name)
        assert read.offset == view.offset and torch.equal(read.w2c, w2c)
    world = view.in_frame(None)
    assert world.offset is None
    point = torch.tensor([5e5 + 1, 4.2e6 - 2, 103.0, 1], dtype=torch.float64)
    near = torch.tensor([1.0, -2, 3, 1], dtype=torch.float64)
    torch.testing.assert_close(world.w2c @ point, view.w2c @ near)
    back = world.in_frame((5e5, 4.2e6, 100.0))
    torch.testing.assert_close(back.w2c, w2c, rtol=0, atol=1e-8)
    assert view.in_frame(view.offset) is view and world.in_frame((0.0, 0.0, 0.0)) is world
    for wrong in ("far", [1, 2], [1, 2, math.nan]):
        entry = {"width": 4, "height": 3, "fx": 5, "fy": 5, "offset": wrong, "w2c": w2c.flatten().tolist()}
        (tmp_path / "wrong.json").write_text(json.dumps([entry]))
        with pytest.raises(io.SceneError, match=r"wrong\.json: view 0: offset must hold 3 finite numbers"):
            io.load_views(tmp_path / "wrong.json")


@pytest.mark.parametrize("name", [r"pictures\A.PNG", "./Pictures/a.png", "pictures/a", "/elsewhere/pictures/a.jpg"])
def test_sizes_come_from_pictures_however_they_are_spelled(tmp_path, name):
    (tmp_path / "pictures").mkdir()
    pytest.importorskip("PIL.Image").new("RGB", (12, 9)).save(tmp_path / "pictures" / "a.png")
    frames = [{"file_path": name, "transform_matrix": torch.eye(4).tolist()}]
    (tmp_path / "transforms.json").write_text(json.dumps({"camera_angle_x": 0.7, "frames": frames}))
    (view,) = io.load_views(tmp_path / "transforms.json")
    assert (view.width, view.height) == (12, 9)
