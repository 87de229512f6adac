"""How a scene wants to be seen: one table of scenes and what lies around them, and what commands make of it."""

import json
import math
import shutil
import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch
from cli_extra import image
from gaussians import make_scene

import analytic_rasterizer as ar
from analytic_rasterizer import cli, io
from analytic_rasterizer.cli.arguments import use_machine
from analytic_rasterizer.io.models import CfgArgs, read_cfg_args
from analytic_rasterizer.training.options import TrainingOptions

UNMARKED = "point:dilation=0.3"
MIP = "mip:variance=0.1"
DEEP = "MODEL/point_cloud/iteration_30000/point_cloud.ply"


def make_views(width=64, height=48):
    focal = 1.1 * width
    moved = torch.eye(4, dtype=torch.float64)
    moved[0, 3] = 0.3
    poses = {"left": torch.eye(4, dtype=torch.float64), "right": moved}
    return [io.View(name, width, height, focal, focal, w2c) for name, w2c in poses.items()]


def options_json(footprint, scales=(1,), background=None, **described):
    """What a training writes; without a background, what one of an earlier version wrote."""
    options = TrainingOptions(footprint=footprint, scales=scales).to_dict()
    described |= {} if background is None else {"background": background}
    source = {"scene": "/none", "images": "images", "test_every": 8}
    return json.dumps({"source": source, "options": options} | described)


FILTERED = {"filter_3D": 0.02}  # a scene as Mip-Splatting and Analytic-Splatting write it


def add_column(path, name, value):
    """Another float32 in every row of a .ply that `save_scene` wrote."""
    header, end, rows = path.read_bytes().partition(b"end_header\n")
    rows = np.frombuffer(rows, np.uint8).reshape(make_scene(degree=0).count, -1)
    column = np.full((len(rows), 1), value, np.float32).view(np.uint8)
    path.write_bytes(header + f"property float {name}\n".encode() + end + np.hstack([rows, column]).tobytes())


def write(folder, contents):
    """Files by their paths. A scene is `None`, what `SceneMetadata` says, or FILTERED; views are a size; other files
    are text."""
    for name, content in contents.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.name == "cameras.json":
            io.save_views(path, make_views(*content))
        elif isinstance(content, str):
            path.write_text(content)
        elif content is FILTERED:
            io.save_scene(path, make_scene(degree=0))
            add_column(path, "filter_3D", 0.02)
        else:
            io.save_scene(path, make_scene(degree=0), io.SceneMetadata(**(content or {})))


MOMENT, BOX = {"footprint": "moment:samples=4"}, {"footprint": "box:samples=16"}
MARKED, POINT = {"antialiased": True}, {"footprint": "point"}
BLACK = [0, 0, 0]


def training(scene, footprint, name="scene.ply", **described):
    """A scene beside the options of a training."""
    return {name: scene, "options.json": options_json(footprint, **described)}


def choice(contents, footprint, reason, scene=None, environment=None, given=None):
    """Files, what is chosen with a part of the reason, SCENE (the first of the files), the environment, --footprint."""
    return contents, scene or next(iter(contents)), environment, given, footprint, reason


def beside_args(name, content, kernel_size):
    """A scene beside cfg_args."""
    return {name: content, "cfg_args": f"Namespace(kernel_size={kernel_size})"}


CHOICES = {
    "nothing said": choice({"a.ply": None}, UNMARKED, "a.ply names none, and 3DGS trains with it"),
    "baking is named": choice({"a.ply": None}, UNMARKED, "for others: bake "),
    "the user": choice(
        {"a.ply": MOMENT}, "point:dilation=0.0", "as given", environment="mip", given="point:dilation=0"
    ),
    "the environment": choice({"a.ply": MOMENT}, MIP, "ANALYTIC_RASTERIZER_FOOTPRINT says so", environment="mip"),
    "an empty environment": choice({"a.ply": MOMENT}, "moment:samples=4", "a.ply says so", environment=""),
    "thin Gaussians": choice(
        {"a.ply": None}, "moment:samples=4", "too thin for moment, so first", environment="moment"
    ),
    "thin by the tag": choice({"a.ply": POINT}, "box:samples=4", "its Gaussians are too thin", given="box"),
    "own tag": choice({"a.ply": BOX}, "box:samples=16", "a.ply says so"),
    "own tag of point": choice({"a.ply": POINT}, UNMARKED, "a.ply says so; right at the size of"),
    "tag of others": choice({"a.ply": MARKED}, MIP, "antialiasing filter, and not which"),
    "beside an unbaked one": choice({"b.ply": BOX, "a.ply": None}, "box:samples=16", "b.ply says so"),
    "compressed": choice({"a.compressed.ply": BOX}, "box:samples=16", "says so"),
    "spz": choice({"a.spz": BOX}, "box:samples=16", "a.spz says so"),
    "unmarked spz": choice({"a.spz": None}, UNMARKED, "a.spz names none"),
    "flag of spz": choice({"a.spz": MARKED}, MIP, "antialiasing filter, and not which"),
    "suffix in capitals": choice({"a.PLY": BOX}, "box:samples=16", "says so"),
    "a training": choice(
        training(MOMENT, "moment", background=[1, 1, 1]), "moment:samples=4", "scene.ply says so", "."
    ),
    "a training before tags": choice(
        training(MARKED, "box:samples=1"), "box:samples=1", "options.json beside scene.ply says so"
    ),
    "point, before tags": choice(
        training(None, "point:dilation=0.1"),
        "point:dilation=0.1",
        "options.json beside scene.ply says so; right at",
    ),
    "the environment and a training": choice(training(MARKED, "box"), MIP, "ANALYTIC", environment="mip"),
    "another name": choice(training(MARKED, "box", "other.ply"), MIP, "and not which"),
    "a foreign scene over it": choice(training(None, "moment"), UNMARKED, "names none"),
    "a foreign one over point": choice(training(MARKED, "point"), MIP, "and not which"),
    "a foreign marked one": choice(training(MARKED, "moment", background=BLACK), MIP, "and not which"),
    "a baked one over it": choice(training(BOX, "point", background=BLACK), "box:samples=16", "scene.ply says so"),
    "options of another program": choice({"scene.ply": MARKED, "options.json": "[3]"}, MIP, "and not which"),
    "the mip of a training": choice(
        training({"footprint": "point:dilation=0"}, "moment", "point_cloud_mip.ply"),
        "point:dilation=0.0",
        "point_cloud_mip.ply says so",
    ),
    "without dilation": choice({"a.ply": None}, "point:dilation=0.0", "too thin", given="point:dilation=0"),
    "a name with spaces": choice({"a b.ply": None}, UNMARKED, "a b.ply' --out FILE"),
    "a model": choice({DEEP: None}, UNMARKED, "point_cloud.ply names none", "MODEL"),
    "a model of Mip-Splatting": choice(
        {DEEP: FILTERED, "MODEL/cfg_args": "Namespace(kernel_size=0.1)"},
        MIP,
        "cfg_args says kernel_size 0.1, the variance of Mip-Splatting's filter",
        "MODEL",
    ),
    "its fused file": choice(beside_args("fused.ply", None, 0.3), "mip:variance=0.3", "cfg_args says kernel_size 0.3"),
    "one of its kin": choice(beside_args("a.ply", FILTERED, 0.0), "mip:variance=0.0", "cfg_args says kernel_size 0,"),
    "its file alone": choice({"a.ply": FILTERED}, MIP, "column filter_3D of Mip-Splatting"),
    "Analytic-Splatting": choice(
        {DEEP: FILTERED, "MODEL/cfg_args": "Namespace(load_allres=False)"},
        MIP,
        "Analytic-Splatting writes it too, then give --footprint analytic",
        "MODEL",
    ),
    "a baked file beside kernel_size": choice(beside_args("a.ply", MOMENT, 0.1), "moment:samples=4", "a.ply says so"),
    "the width of a blur": choice(beside_args("a.ply", None, 9), UNMARKED, "names none"),
    "a baked model": choice({DEEP: MOMENT}, "moment:samples=4", "point_cloud.ply says so"),
}


@pytest.mark.filterwarnings("ignore:.*it is not what `train` writes", "ignore:.*kernel_size is ignored, got 9")
@pytest.mark.parametrize("case", CHOICES)
def test_footprint_of_a_scene(tmp_path, monkeypatch, case):
    contents, scene, environment, given, footprint, reason = CHOICES[case]
    write(tmp_path, contents)
    if environment is None:
        monkeypatch.delenv("ANALYTIC_RASTERIZER_FOOTPRINT", raising=False)
    else:
        monkeypatch.setenv("ANALYTIC_RASTERIZER_FOOTPRINT", environment)
    choice = io.find_scene(tmp_path / scene).choose_footprint(given)
    assert (str(choice.footprint), reason in choice.reason) == (footprint, True), choice.reason
    assert "\n" not in choice.reason


@pytest.mark.parametrize("footprint", ["moment:samples=16", "box:samples=1", "mip:variance=0.2", "point:dilation=0.1"])
@pytest.mark.parametrize(
    "first, second", [("a.ply", "b.spz"), ("a.spz", "b.compressed.ply"), ("a.compressed.ply", "b.ply")]
)
def test_a_scene_comes_back_as_it_is_from_every_format(tmp_path, footprint, first, second):
    """Written, renamed, copied to another folder beside an unbaked one, and written anew in another format."""
    write(tmp_path, {first: {"footprint": footprint}, "away/a.ply": None})
    copy = tmp_path / "away" / f"renamed_{first}"
    shutil.copy(tmp_path / first, copy)
    found = io.find_scene(copy)
    assert str(found.choose_footprint().footprint) == footprint
    io.save_scene(tmp_path / second, io.load_scene(copy), found.metadata)
    assert str(io.find_scene(tmp_path / second).choose_footprint().footprint) == footprint


# ------------------------------------------------------------------ folders: views, size, background

CFG = "Namespace(sh_degree=3, source_path='/data/garden', model_path='./output/1', {}, data_device='cuda', eval=True)"
WHITE_CFG = CFG.format("images='images_4', resolution=-1, white_background=True")
MODEL = {"MODEL/cameras.json": (64, 48), "MODEL/cfg_args": WHITE_CFG}
ITERATION, BAKED = "MODEL/point_cloud/iteration_30000", "MODEL/point_cloud/iteration_7/b.ply"
BESIDE = {"a.ply": None, "cameras.json": (64, 48), "cfg_args": WHITE_CFG}
TRAINED = training(MOMENT, "moment", scales=(2, 4), background=[1, 1, 1])
OTHER = training(None, "moment", "b.ply", background=[0, 0.5, 1])
# Files, SCENE, the size of the views, the background.
FOLDERS = {
    "a model": ({DEEP: None} | MODEL, "MODEL", (16, 12), "white"),
    "its file": ({DEEP: None} | MODEL, DEEP, (16, 12), "white"),
    "its iteration": ({DEEP: None} | MODEL, ITERATION, (16, 12), "white"),
    "its point_cloud": ({DEEP: None} | MODEL, "MODEL/point_cloud", (16, 12), "white"),
    "baked in it": ({BAKED: MOMENT} | MODEL, BAKED, (16, 12), "white"),
    "beside": (BESIDE, "a.ply", (16, 12), "white"),
    "beside goes first": (
        {DEEP: None, "MODEL/cameras.json": (64, 48), f"{ITERATION}/cameras.json": (32, 24)},
        "MODEL",
        (32, 24),
        None,
    ),
    "without cfg_args": ({DEEP: None, "MODEL/cameras.json": (64, 48)}, "MODEL", (64, 48), None),
    "a training": (TRAINED | {"cameras.json": (64, 48)}, ".", (32, 24), "white"),
    "another scene beside a training": (OTHER | {"cameras.json": (64, 48)}, "b.ply", (64, 48), "0,0.5,1"),
    "not two folders up": ({"MODEL/x/y/a.ply": None, "MODEL/cameras.json": (64, 48)}, "MODEL/x/y/a.ply", None, None),
}


@pytest.mark.parametrize("case", FOLDERS)
def test_views_size_and_background_of_a_scene(tmp_path, case):
    contents, scene, size, background = FOLDERS[case]
    write(tmp_path, contents)
    found = io.find_scene(tmp_path / scene)
    if size is None:
        with pytest.raises(io.SceneError, match=r"a\.ply: no views: there is no cameras\.json in .*\(--views\)"):
            found.load_views()
    else:
        views = found.load_views()
        assert {(view.width, view.height) for view in views} == {size}
        assert views[0].fx == pytest.approx(1.1 * size[0])
        assert [view.name for view in views] == ["left", "right"]
    named = {None: None, "white": io.WHITE, "black": io.BLACK}
    expected = named[background] if background in named else tuple(map(float, background.split(",")))
    assert (found.background and found.background[0]) == expected


@pytest.mark.parametrize(
    ("images", "resolution", "size"),
    [
        ("images", 1, (4946, 3286)),
        ("images", 2, (2473, 1643)),
        ("images", 8, (618, 411)),
        ("images", -1, (1600, 1063)),
        ("images_4", -1, (1237, 822)),
        ("images_2", -1, (1600, 1063)),
        ("images_4", 2, (618, 411)),
        ("images", 800, (800, 531)),
        ("images", 1.5, (1, 1)),
        ("some/images_8/", 1, (618, 411)),
        ("images_2024", 1, (4946, 3286)),
        ("my_images_4x", 1, (4946, 3286)),
        (None, None, (4946, 3286)),
    ],
)
def test_size_of_the_pictures_of_a_training_of_3dgs(images, resolution, size):
    """Of the garden of Mip-NeRF 360, whose photographs have 4946 x 3286 px."""
    found = CfgArgs(images=images, resolution=resolution).trained_size(4946, 3286)
    assert all(abs(a - b) <= 1 for a, b in zip(found, size)), found  # 3DGS rounds down what division leaves


def test_views_are_in_the_frame_of_the_scene(tmp_path):
    """Of a capture in map coordinates the scene has an offset; views say theirs, or are in the world."""
    offset = (500000.0, 4200000.0, 100.0)
    io.save_scene(tmp_path / "scene.ply", make_scene(degree=0), io.SceneMetadata(footprint="moment", offset=offset))
    here = make_views()
    io.save_views(tmp_path / "cameras.json", [replace(view, offset=offset) for view in here])
    io.save_views(tmp_path / "world.json", [replace(view, offset=offset).in_frame(None) for view in here])
    found = io.find_scene(tmp_path / "scene.ply")
    for path in (None, tmp_path / "world.json"):
        for view, expected in zip(found.load_views(path), here):
            torch.testing.assert_close(view.w2c, expected.w2c, rtol=0, atol=1e-8)  # float64 at 4.2e6: 1e-9


@pytest.mark.parametrize("scene", ["../iteration_30000/point_cloud.ply", "..", "link.ply", "cut/../../iteration_30000"])
def test_a_model_is_found_through_dots_and_links(tmp_path, monkeypatch, scene):
    write(tmp_path, {DEEP: None} | MODEL)
    here = tmp_path / "MODEL" / "point_cloud" / "iteration_7"
    (here / "cut").mkdir(parents=True)
    (here / "link.ply").symlink_to(tmp_path / DEEP)
    monkeypatch.chdir(here)
    found = io.find_scene(scene)
    assert found.cameras is not None and found.cameras.samefile(tmp_path / "MODEL" / "cameras.json")
    assert found.background[0] == io.WHITE


def test_a_link_elsewhere_leads_to_its_model(tmp_path):
    write(tmp_path, {DEEP: None, "MODEL/cameras.json": (64, 48)})
    (tmp_path / "link.ply").symlink_to(tmp_path / DEEP)
    assert io.find_scene(tmp_path / "link.ply").cameras.samefile(tmp_path / "MODEL" / "cameras.json")


def test_the_last_iteration_is_a_number(tmp_path):
    names = [f"MODEL/point_cloud/iteration_{n}/point_cloud.ply" for n in (7000, 30000, 9)]
    write(tmp_path, dict.fromkeys(names))
    (tmp_path / "MODEL" / "point_cloud" / "iteration_40000").mkdir()
    (tmp_path / "MODEL" / "point_cloud" / "iteration_last").mkdir()
    shutil.copy(tmp_path / names[0], tmp_path / "MODEL" / "point_cloud" / "iteration_last")
    assert io.find_scene(tmp_path / "MODEL").path == tmp_path / names[1]


def test_a_folder_with_two_scenes_is_a_question(tmp_path):
    write(tmp_path, {"MODEL/scene.ply": None, DEEP: None})
    with pytest.raises(io.SceneError, match=r"holds scene\.ply and point_cloud/.*; name one of them"):
        io.find_scene(tmp_path / "MODEL")


HOSTILE = {
    "code": "__import__('pathlib').Path({!r}).touch()",
    "code in a value": "Namespace(white_background=__import__('pathlib').Path({!r}).touch(), resolution=4)",
    "code in a name": "Namespace(white_background=True, resolution=4)[__import__('pathlib').Path({!r}).touch()]",
    "another call": "open({!r}, 'w')",
    "nothing": "",
    "no python": "white_background: true",
    "two lines": "Namespace(resolution=4)\nopen({!r}, 'w')",
    "nested": "(" * 5000,
    "signs": "Namespace(resolution=" + "-" * 30000 + "1)",
    "huge": "Namespace(resolution=" + "9" * 100_000 + ")",
    "many digits": "Namespace(resolution=" + "9" * 6000 + ")",
    "a power": "Namespace(resolution=9**9**9)",
    "wrong kinds": "Namespace(resolution='4', white_background=1, images=7, eval='no')",
    "numbers out of range": "Namespace(resolution=0, white_background=None)",
    "infinity": "Namespace(resolution=1e999)",
    "null bytes": "Namespace(\0)",
    "a list": "[1, 2]",
}


@pytest.mark.parametrize("case", HOSTILE)
def test_cfg_args_is_never_evaluated(tmp_path, case):
    touched = tmp_path / "touched"
    path = tmp_path / "cfg_args"
    path.write_text(HOSTILE[case].format(str(touched)) if "{!r}" in HOSTILE[case] else HOSTILE[case])
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = read_cfg_args(path)
    assert not touched.exists()
    assert caught and all("ignored" in str(w.message) and "\n" not in str(w.message) for w in caught)
    assert all(len(str(w.message)) < 300 for w in caught)
    assert found.white_background is None and found.resolution in (None, 4)


def test_cfg_args_of_other_versions(tmp_path):
    (tmp_path / "cfg_args").write_text(
        "Namespace(sh_degree=3, source_path='/a b/c', model_path='x', images='images', depths='', resolution=1.6e3,"
        " white_background=False, train_test_exp=False, data_device='cuda', eval=False, kernel_size=0.1, far=inf)\n"
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = read_cfg_args(tmp_path / "cfg_args")
    assert found == CfgArgs(False, 1600.0, "images", "/a b/c", False, 0.1)


@pytest.mark.parametrize("value", ["-0.1", "9", "1e999", "True", "'0.1'"])
def test_a_kernel_size_that_is_no_variance_is_ignored(tmp_path, value):
    (tmp_path / "cfg_args").write_text(f"Namespace(kernel_size={value})")
    with pytest.warns(UserWarning, match=r"cfg_args: kernel_size is ignored, got "):
        assert read_cfg_args(tmp_path / "cfg_args").kernel_size is None


def test_cfg_args_that_is_no_file_is_ignored(tmp_path):
    write(tmp_path, {"a.ply": None, "cfg_args/b.ply": None})
    assert io.find_scene(tmp_path / "a.ply").cfg_args is None


# ------------------------------------------------------------------------------------- commands


def run(arguments):
    """The exit code of a command on the CPU, also where there is a GPU."""
    return cli.main([*arguments, "--device", "cpu"])


@pytest.fixture
def model(tmp_path):
    """A model of 3DGS whose pictures had a quarter of the size in cameras.json."""
    args = CFG.format("images='images', resolution=4, white_background=True")
    write(tmp_path, {DEEP: None, "MODEL/cameras.json": (256, 192), "MODEL/cfg_args": args})
    return tmp_path / "MODEL"


def picture(path):
    return np.asarray(image.open(path)).astype(int)


def shown(scene, view, footprint, background):
    settings = view.settings(1, background, scene.sh_degree, footprint)
    color = ar.render_stages(settings, **scene.arguments()).color
    return (color.clamp(0, 1) * 255).round().permute(1, 2, 0).numpy()


def test_render_shows_a_model_as_it_was_trained(model, tmp_path, capsys):
    assert run(["render", str(model), "--out", str(tmp_path / "out")]) == 0
    for view in make_views():
        expected = shown(io.load_scene(model.parent / DEEP), view, "point", io.WHITE)
        assert np.abs(picture(tmp_path / "out" / f"{view.name}.png") - expected).max() <= 1
    where, choice, size = capsys.readouterr().err.splitlines()
    assert size == "pictures of 64x48"
    assert where == (
        f"from {model}: {model.parent / DEEP}; 2 views of {model / 'cameras.json'}, 64x48; the size of the training "
        "(cfg_args: resolution 4); background white (cfg_args)"
    )
    assert choice.startswith("footprint point:dilation=0.3: point_cloud.ply names none, and 3DGS trains with it; right")


def test_what_is_given_wins(model, tmp_path, capsys):
    io.save_views(tmp_path / "views.json", make_views(20, 16))
    given = ["--views", str(tmp_path / "views.json"), "--background", "black", "--footprint", "box"]
    assert run(["render", str(model), "--out", str(tmp_path / "out"), *given]) == 0
    expected = shown(io.load_scene(model.parent / DEEP), make_views(20, 16)[0], "box", io.BLACK)
    assert np.abs(picture(tmp_path / "out" / "left.png") - expected).max() <= 1
    assert "cfg_args" not in capsys.readouterr().err


def test_bake_takes_the_size_of_the_training(model, tmp_path, capsys):
    ways = {"known": [], "named": ["--views", str(model / "cameras.json")], "given": ["--scales", "4"]}
    for name, given in ways.items():
        assert run(["bake", str(model), "--out", str(tmp_path / f"{name}.ply"), *given]) == 0
        assert "2 pictures of 64x48" in capsys.readouterr().out
    contents = {(tmp_path / f"{name}.ply").read_bytes() for name in ways}
    assert len(contents) == 1
    baked, scene = io.load_scene(tmp_path / "known.ply"), make_scene(degree=0)
    cameras = [view.settings() for view in make_views()]
    scales, _ = ar.bake_dilation(scene.means, scene.scales, scene.rotations, scene.opacities, cameras)
    torch.testing.assert_close(baked.scales, scales, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("name", ["b.ply", "b.compressed.ply", "b.spz"])
def test_a_baked_scene_is_shown_with_moment_and_not_baked_again(model, tmp_path, capsys, name):
    (tmp_path / "away").mkdir()
    baked = tmp_path / "away" / name
    assert run(["bake", str(model), "--out", str(baked)]) == 0
    views = ["--views", str(model / "cameras.json"), "--scales", "4"]
    assert run(["render", str(baked), *views, "--out", str(tmp_path / "out")]) == 0
    said = "pictures of 64x48: 1/4 of the 256x192 of the views\n"
    assert capsys.readouterr().err.endswith(f"footprint moment:samples=4: {name} says so\n{said}")
    expected = shown(io.load_scene(baked), make_views()[0], "moment:samples=4", io.BLACK)
    assert np.abs(picture(tmp_path / "out" / "left.png") - expected).max() <= 1
    assert run(["bake", str(baked), *views, "--out", str(tmp_path / "twice.ply")]) == 2
    assert f"{name}: no dilation to bake" in capsys.readouterr().err
    assert run(["bake", str(baked), *views, "--footprint", "point", "--out", str(tmp_path / "twice.ply")]) == 0


@pytest.mark.filterwarnings("ignore:.*the column filter_3D, a 3D filter, is not applied")
def test_a_scene_of_mip_splatting_is_shown_with_its_filter_and_not_baked(tmp_path, capsys):
    write(tmp_path, {DEEP: FILTERED, "MODEL/cameras.json": (64, 48), "MODEL/cfg_args": "Namespace(kernel_size=0.2)"})
    model = tmp_path / "MODEL"
    assert run(["render", str(model), "--out", str(tmp_path / "out")]) == 0
    reason = "cfg_args says kernel_size 0.2, the variance of Mip-Splatting's filter"
    assert capsys.readouterr().err.endswith(f"footprint mip:variance=0.2: {reason}\npictures of 64x48\n")
    expected = shown(make_scene(degree=0), make_views()[0], "mip:variance=0.2", io.BLACK)
    assert np.abs(picture(tmp_path / "out" / "left.png") - expected).max() <= 1
    assert run(["bake", str(model), "--out", str(tmp_path / "b.ply")]) == 2
    assert f"no dilation to bake: it says that pixels are to be integrated (footprint mip:variance=0.2: {reason})" in (
        capsys.readouterr().err
    )
    assert not (tmp_path / "b.ply").exists()
    assert run(["inspect", str(model), "--json", "-"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["trained_with"], found["bake"]) == ("mip:variance=0.2", None)


def test_bake_takes_the_dilation_of_the_training(model, tmp_path):
    write(tmp_path, {"a.ply": {"footprint": "point:dilation=0.5"}})
    views = ["--views", str(model / "cameras.json"), "--scales", "4"]
    assert run(["bake", str(tmp_path / "a.ply"), *views, "--out", str(tmp_path / "b.ply")]) == 0
    assert run(["bake", str(model), "--dilation", "0.5", "--out", str(tmp_path / "c.ply")]) == 0
    assert (tmp_path / "b.ply").read_bytes() == (tmp_path / "c.ply").read_bytes()


def test_inspect_says_what_bake_gains(model, capsys, monkeypatch):
    monkeypatch.setenv("ANALYTIC_RASTERIZER_FOOTPRINT", "moment")  # says nothing of the training
    assert run(["inspect", str(model), "--json", "-"]) == 0
    captured = capsys.readouterr()
    found = json.loads(captured.out)
    assert found["trained_with"] == UNMARKED and found["views"][0]["width"] == 64
    gain = found["bake"]
    assert gain["reductions"] == [1, 2, 4] and gain["footprint"] == UNMARKED
    # By hand: what the training showed, averaged, against `point` and the baked scene at half the size.
    scene, views = io.load_scene(model.parent / DEEP), make_views()
    cameras = [view.settings() for view in views]
    baked = scene.with_activated(
        *ar.bake_dilation(scene.means, scene.scales, scene.rotations, scene.opacities, cameras)
    )
    for kind, of, footprint in (("unbaked", scene, "point"), ("baked", baked, "moment")):
        squares = []
        for view in views:
            large = ar.render_stages(view.settings(1, io.WHITE, 0, "point"), **scene.arguments()).color.clamp(0, 1)
            half = io.View("half", 32, 24, view.fx / 2, view.fy / 2, view.w2c).settings(1, io.WHITE, 0, footprint)
            small = ar.render_stages(half, **of.arguments()).color.clamp(0, 1)
            squares.append((large.reshape(3, 24, 2, 32, 2).mean((2, 4)) - small).square().mean().item())
        assert gain[kind][1] == pytest.approx(-10 * math.log10(sum(squares) / 2), abs=0.05)
    assert gain["unbaked"][0] == 300 and gain["baked"][2] > gain["unbaked"][2] + 3
    assert captured.err.count("\n") == 2 and "trained with point:dilation=0.3: point_cloud.ply names" in captured.err


def test_inspect_names_bake(model, capsys):
    assert run(["inspect", str(model), "--max-views", "1"]) == 0
    text = capsys.readouterr().out
    assert "how near pictures come to what the training showed: point:dilation=0.3 at the size of these views" in text
    assert f"what follows is for the baked scene: bake {model} --out FILE\n" in text
    assert run(["inspect", str(model), "--max-views", "1", "--footprint", "moment"]) == 0
    assert "baked scene" not in capsys.readouterr().out  # the general advice names bake


def test_pareto_measures_some_views_of_a_model(model, tmp_path, capsys):
    pytest.importorskip("matplotlib", reason="needs the analysis extra")
    pytest.importorskip("torchmetrics", reason="needs the analysis extra")
    io.save_views(model / "cameras.json", [v for i in range(3) for v in make_views(256, 192)])
    options = ["--footprints", "box:samples=1", "--scales", "4", "--rounds", "1", "--max-density", "8"]
    assert run(["pareto", str(model), "--out", str(tmp_path / "out"), *options]) == 0
    results = json.loads((tmp_path / "out" / "pareto.json").read_text())
    assert (len(results["views"]), results["background"]) == (4, [1, 1, 1])
    assert results["scales"][0]["sizes"][0] == [16, 12]
    error = capsys.readouterr().err
    assert "4 of the views are measured (--limit-views)" in error and "measure what bake makes of it" in error


def test_views_are_those_of_a_scene_far_from_zero(tmp_path):
    """Cameras of the world, or relative to the offset of the scene or to another, show the same."""
    offset, other = (5e5, 4.2e6, 300.0), (5e5, 4.2e6, 0.0)
    write(tmp_path, {"a.ply": {"footprint": "box", "offset": offset}})
    near = [replace(view, offset=offset) for view in make_views()]
    pictures = []
    for name, to in (("near", offset), ("other", other), ("world", None)):
        io.save_views(tmp_path / f"{name}.json", [view.in_frame(to) for view in near])
        views = ["--views", str(tmp_path / f"{name}.json"), "--out", str(tmp_path / name)]
        assert run(["render", str(tmp_path / "a.ply"), *views]) == 0
        pictures.append(picture(tmp_path / name / "right.png"))
    expected = shown(make_scene(degree=0), make_views()[1], "box", io.BLACK)
    assert expected.max() > 100 and np.abs(pictures[0] - expected).max() <= 1
    for found in pictures[1:]:
        assert np.abs(found - pictures[0]).max() <= 1
    bake = ["bake", str(tmp_path / "a.ply"), "--footprint", "point", "--views", str(tmp_path / "world.json")]
    assert run([*bake, "--out", str(tmp_path / "b.spz")]) == 0
    assert io.read_metadata(tmp_path / "b.spz").offset == offset


@pytest.mark.parametrize("cuda", [True, False])
@pytest.mark.parametrize(
    "arguments",
    [["render", "--out", "b"], ["inspect"], ["pareto"], ["bake", "--out", "b.ply"], ["view", "--server"], ["evaluate"]],
    ids=lambda arguments: arguments[0],
)
def test_commands_take_the_gpu_where_there_is_one(monkeypatch, arguments, cuda):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: cuda)
    monkeypatch.setattr("analytic_rasterizer._C.has_cuda", True)
    args = cli.build_parser().parse_args([arguments[0], "a.ply", *arguments[1:]])
    use_machine(args)
    assert args.device == ("cuda" if cuda else "cpu")
