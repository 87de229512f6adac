"""The tutorials run: every block of docs/tutorials/*.md, in order, in a folder with tiny scenes.

A page is read as its reader types it. Blocks of `bash` are commands, run one by one; `cd` and `export` last until the
end of the page. The blocks of `python` of a page are one program, which runs where the last of them stands. What the
tutorials call `garden`, `desk`, `lego`, `data/garden` and `gaussian-splatting` is made here, with pictures of 40x32 px.
Four things differ from what a reader does:

- trainings are short: `shortened` appends options to commands, and SHORTER replaces numbers in Python;
- films have two frames (`shortened`);
- `view` opens no browser: a thread loads the page instead, and presses Ctrl-C;
- `pip` does not run: the folders and extras that it is given must exist. test_packaging.py builds the package.
"""

import json
import os
import re
import shlex
import textwrap

import capture_files as files
import numpy as np
import pytest
import torch
from places import ROOT
from processes import python_path, run_program
from train_extra import image

import analytic_rasterizer as ar
from analytic_rasterizer import io

pytest.importorskip("torchmetrics", reason="needs the train extra")
TUTORIALS = ROOT / "docs" / "tutorials"
CLONE = "path/to/analytic_rasterizer"
SIZE = 40, 32
VIEWS = files.circle(9, SIZE)
SHORTER = {  # in Python: what is replaced, once
    "train.md": {"iterations=7000": "iterations=40"},
    "loop.md": {"steps, scale = 7000, 2": "steps, scale = 1000, 1"},
    "poses.md": {"steps, scale = 3000, 2": "steps, scale = 600, 2"},
}

AS_TYPED = """
import os, runpy, sys
os.chdir(sys.argv[1])
_, kind, *sys.argv = sys.argv[1:]
if kind == "module":
    runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
elif kind == "file":
    sys.path[0] = os.getcwd()
    runpy.run_path(sys.argv[0], run_name="__main__")
else:
    exec(compile(sys.argv[0], "<tutorial>", "exec"), {"__name__": "__main__"})
"""
AT_THE_BROWSER = """
import _thread, signal, threading, urllib.request, webbrowser
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it
def look(url):
    try:
        with urllib.request.urlopen(url) as answer:
            print("the page has", len(answer.read()), "bytes", flush=True)
    finally:
        _thread.interrupt_main()
webbrowser.open = lambda url: threading.Thread(target=look, args=(url,)).start()
"""


def blocks_of(page):
    """(language, text) of every fenced block; one that stands in a list is indented."""
    found = re.findall(r"^( *)```(\w*)\n(.*?)^\1```$", (TUTORIALS / page).read_text(), flags=re.M | re.S)
    assert found and {language for _, language, _ in found} <= {"bash", "python"}
    return [(language, textwrap.dedent(text)) for _, language, text in found]


def shortened(words):
    """The words of a command, with options that let it end soon."""
    if words[:3] != ["python", "-m", "analytic_rasterizer"]:
        return words
    command, given = words[3], words[4:]
    more = []
    if command == "train" and "--seconds" in given:
        more = ["--seconds", "1"]
    elif command == "train" and "--export" not in given:
        more = ["--iterations", "60" if "--resume" in given else "40"]
    elif command == "render" and "--path" in given:
        more = ["--frames", "2"]
    return [*words, *more]


class Reader:
    """Who follows a page, in a folder."""

    def __init__(self, page, folder):
        self.page, self.folder = page, folder
        chosen = ("ANALYTIC_RASTERIZER_FOOTPRINT", "ANALYTIC_RASTERIZER_DIALECT")
        self.environment = {name: value for name, value in os.environ.items() if name not in chosen}
        self.environment |= {"PYTHONPATH": python_path(), "OMP_NUM_THREADS": "1"}
        self.output = {}  # of every command

    def follow(self):
        blocks = blocks_of(self.page)
        last = max((i for i, (language, _) in enumerate(blocks) if language == "python"), default=None)
        program = "\n".join(text for language, text in blocks if language == "python")
        for number, replacement in SHORTER.get(self.page, {}).items():
            assert program.count(number) == 1
            program = program.replace(number, replacement)
        for i, (language, text) in enumerate(blocks):
            if language == "bash":
                for line in text.splitlines():
                    self.type(line)
            elif i == last:
                self.output["python"] = self.run("code", program)

    def type(self, line):
        words = shlex.split(line)
        if words[0] == "cd":
            self.folder = self.folder / words[1]
        elif words[0] == "export":
            name, _, value = words[1].partition("=")
            self.environment[name] = value
        elif words[0] == "pip":
            check_installation(words[1:])
        else:
            words = shortened(words)
            assert words[0] == "python", line
            if words[1] == "-m":
                is_view = words[3] == "view" and "--export" not in words
                self.output[line] = self.run("module", *words[2:], before=AT_THE_BROWSER if is_view else "")
            elif words[1] == "-c":
                self.output[line] = self.run("code", words[2])
            else:
                self.output[line] = self.run("file", *words[1:])

    def run(self, *words, before=""):
        """What a process says on stdout and stderr; fails where the process does."""
        done = run_program(before + AS_TYPED, self.folder, *words, environment=self.environment)
        assert done.returncode == 0, (words, done.stdout[-1000:], done.stderr[-4000:])
        return done.stdout, done.stderr


def check_installation(words):
    """pip's folders are in this repository, with the extras."""
    assert words[0] in ("install", "uninstall")
    for target in words[1:] if words[0] == "install" else ():
        folder, _, extras = target.removesuffix("]").partition("[")
        assert folder.startswith(CLONE)
        assert (ROOT / folder[len(CLONE) :].lstrip("/") / "setup.py").exists()
        for extra in extras.split(",") if extras else ():
            assert re.search(rf"^{extra} = \[", (ROOT / "pyproject.toml").read_text(), flags=re.M)


def points_of_truth():
    """Points (P, 3) near the Gaussians of the pictures, and their colours, uint8."""
    truth, generator = files.truth_gaussians(), torch.Generator().manual_seed(3)
    near = truth.means.repeat(6, 1) + 0.2 * torch.randn(6 * truth.count, 3, generator=generator)
    return near, torch.full((len(near), 3), 128, dtype=torch.uint8)


def make_colmap(folder):
    files.write_pictures(folder / "images", VIEWS, opaque=True)
    files.write_colmap(folder / "sparse" / "0", VIEWS, *points_of_truth())


def write_points(path):
    """A .ply of points, as captures have it that come without a reconstruction."""
    points, colors = points_of_truth()
    names = [*(f"float {axis}" for axis in "xyz"), *(f"uchar {name}" for name in ("red", "green", "blue"))]
    header = ["ply", "format ascii 1.0", f"element vertex {len(points)}", *(f"property {name}" for name in names)]
    rows = [" ".join(map(str, [*p, *c])) for p, c in zip(points.tolist(), colors.tolist())]
    path.write_text("\n".join([*header, "end_header", *rows]) + "\n")


def make_nerfstudio(folder):
    files.write_pictures(folder / "images", VIEWS, opaque=True)
    frames = [{"file_path": f"images/{v.name}.png", "transform_matrix": files.opengl_pose(v)} for v in VIEWS]
    camera = {"w": SIZE[0], "h": SIZE[1], "fl_x": VIEWS[0].fx, "fl_y": VIEWS[0].fy}
    camera |= {"cx": SIZE[0] / 2, "cy": SIZE[1] / 2}
    (folder / "transforms.json").write_text(json.dumps(camera | {"frames": frames}))
    write_points(folder / "points3D.ply")


def make_nerf_synthetic(folder):
    files.write_nerf_synthetic(folder, files.circle(8), files.circle(3))
    write_points(folder / "points3d.ply")


def picture(path):
    return np.asarray(image.open(path)).astype(float)


# ------------------------------------------------------------------------------------- antialias.md

# A repository like 3DGS, written for this test: how it imports and calls its rasterizer is what matters.
RENDERER = '''
import math

import torch
from diff_gaussian_rasterization import GaussianRasterizationSettings, GaussianRasterizer


def render(camera, gaussians, background):
    """A picture, and what density control wants to know."""
    screen = torch.zeros_like(gaussians.means, requires_grad=True) + 0
    try:
        screen.retain_grad()
    except RuntimeError:
        pass
    raster_settings = GaussianRasterizationSettings(
        image_height=camera["height"],
        image_width=camera["width"],
        tanfovx=math.tan(camera["fovx"] / 2),
        tanfovy=math.tan(camera["fovy"] / 2),
        bg=background,
        scale_modifier=1.0,
        viewmatrix=camera["world_view_transform"],
        projmatrix=camera["full_proj_transform"],
        sh_degree=0,
        campos=camera["camera_center"],
        prefiltered=False,
        debug=False,
    )
    rendered_image, radii = GaussianRasterizer(raster_settings=raster_settings)(
        means3D=gaussians.means,
        means2D=screen,
        shs=gaussians.shs,
        colors_precomp=None,
        opacities=gaussians.opacities,
        scales=gaussians.scales,
        rotations=torch.nn.functional.normalize(gaussians.rotations),
        cov3D_precomp=None,
    )
    return {"render": rendered_image, "viewspace_points": screen, "visibility_filter": radii > 0, "radii": radii}
'''
TRAIN = """
import argparse, json, math, pathlib

import torch
from gaussian_renderer import render

from analytic_rasterizer import Gaussians, io, training  # only to read and write files

parser = argparse.ArgumentParser()
parser.add_argument("-s")
parser.add_argument("-m")
args = parser.parse_args()

capture = training.load_capture(args.s)
pictures = training.load_pictures(capture.train, (1,), capture.background, "cpu")
gaussians = Gaussians.from_points(*capture.points, sh_degree=0).leaves()
optimizer = torch.optim.Adam(list(gaussians), lr=0.02)
cameras = [
    dict(
        height=s.image_height, width=s.image_width, fovx=2 * math.atan(s.tanfovx), fovy=2 * math.atan(s.tanfovy),
        world_view_transform=s.viewmatrix, full_proj_transform=s.projmatrix, camera_center=s.campos,
    )
    for s in pictures.settings[1]
]
for step in range(80):
    i = step % len(cameras)
    loss = (render(cameras[i], gaussians, torch.zeros(3))["render"] - pictures.truth(1, i)).abs().mean()
    loss.backward()
    optimizer.step()
    optimizer.zero_grad()
out = pathlib.Path(args.m)
(out / "point_cloud" / "iteration_80").mkdir(parents=True)
io.save_scene(out / "point_cloud" / "iteration_80" / "point_cloud.ply", gaussians.map(torch.Tensor.detach))
io.save_views(out / "cameras.json", pictures.views)
(out / "cfg_args").write_text("Namespace(images='images', resolution=-1, white_background=False, eval=True)")
with torch.no_grad():
    torch.save(render(cameras[0], gaussians, torch.zeros(3))["render"], out / "last.pt")
"""


def test_antialias(tmp_path):
    repository = tmp_path / "gaussian-splatting"
    (repository / "gaussian_renderer").mkdir(parents=True)
    (repository / "gaussian_renderer" / "__init__.py").write_text(RENDERER)
    (repository / "train.py").write_text(TRAIN)
    make_colmap(repository / "data" / "garden")
    reader = Reader("antialias.md", tmp_path)
    reader.follow()
    asked = next(output for command, output in reader.output.items() if "get_dialect" in command)
    assert asked[0] == "gs2023\n"
    assert all("no footprint was chosen" not in stderr for _, stderr in reader.output.values())
    # The variable reached the renderer, whose code names no footprint.
    out = repository / "output" / "garden"
    found = io.find_scene(out)
    scene, view = io.load_scene(found.path), found.load_views()[0]
    settings = view.settings(sh_degree=0, footprint="moment:samples=4")
    expected, _ = ar.GaussianRasterizer(settings)(means2D=None, **scene.arguments())
    assert torch.allclose(torch.load(out / "last.pt"), expected, atol=1e-4)
    other, _ = ar.GaussianRasterizer(settings._replace(footprint="analytic"))(means2D=None, **scene.arguments())
    assert not torch.allclose(other, expected, atol=1e-3)
    names = "point", "box", "moment"
    assert len({picture(repository / f"{name}.png").tobytes() for name in names}) == len(names)
    results = json.loads((out / "evaluation.json").read_text())["results"]
    assert io.read_metadata(repository / "garden.ply").footprint == "moment:samples=4"
    ours, theirs = (results[name] for name in ("moment:samples=4", "point:dilation=0.3"))
    assert all(ours[scale]["psnr"] > theirs[scale]["psnr"] + 1 for scale in ("4", "8"))


def test_a_footprint_is_missed_where_none_is_chosen(tmp_path):
    """What step 4 of antialias.md promises: a program that only renders is told so."""
    reader = Reader("antialias.md", tmp_path)
    program = """
        import math, torch
        from gaussian_renderer import render
        import analytic_rasterizer as ar
        s = ar.camera_settings(torch.eye(4), width=32, height=24, fx=30.0, fy=30.0)
        camera = dict(height=24, width=32, fovx=2 * math.atan(s.tanfovx), fovy=2 * math.atan(s.tanfovy),
            world_view_transform=s.viewmatrix, full_proj_transform=s.projmatrix, camera_center=s.campos)
        scene = ar.Gaussians.from_points(torch.rand(9, 3) + 2, sh_degree=0)
        with torch.no_grad():
            render(camera, scene, torch.zeros(3))
    """
    (tmp_path / "gaussian_renderer.py").write_text(RENDERER)
    (tmp_path / "render.py").write_text(textwrap.dedent(program))
    assert "no footprint was chosen" in reader.run("file", "render.py")[1]
    reader.environment["ANALYTIC_RASTERIZER_FOOTPRINT"] = "point"
    assert "no footprint was chosen" not in reader.run("file", "render.py")[1]


# ------------------------------------------------------------------------------------- old-scene.md


def test_old_scene(tmp_path):
    """A scene of 3DGS whose photographs are what `point` shows of it, as if its training had left no error."""
    generator = torch.Generator().manual_seed(1)
    points = torch.rand(400, 3, generator=generator) * 2 - 1
    scene = ar.Gaussians.from_points(points, torch.rand(400, 3, generator=generator), 0, opacity=0.9, scale=0.1)
    model, capture = tmp_path / "garden", tmp_path / "data" / "garden"
    (model / "point_cloud" / "iteration_30000").mkdir(parents=True)
    io.save_scene(model / "point_cloud" / "iteration_30000" / "point_cloud.ply", scene)
    large = [view.scaled(4) for view in VIEWS]
    io.save_views(model / "cameras.json", large)
    (model / "cfg_args").write_text("Namespace(images='images_4', resolution=-1, white_background=False, eval=True)")
    files.write_colmap(capture / "sparse" / "0", large, *points_of_truth())
    (capture / "images_4").mkdir()
    for view in VIEWS:
        rasterizer = ar.GaussianRasterizer(view.settings(sh_degree=0, footprint="point"))
        color, _ = rasterizer(means2D=None, **scene.arguments())
        io.save_image(capture / "images_4" / f"{view.name}.png", color)
    reader = Reader("old-scene.md", tmp_path)
    reader.follow()

    bakings = [output for command, output in reader.output.items() if " bake " in command]
    assert len(bakings) == 2 and all("40x32" in stdout for stdout, _ in bakings)
    assert io.read_metadata(model / "baked.ply").footprint == "moment:samples=4"
    folders = [f"{when}/scale_{scale}" for when in ("before", "after") for scale in (1, 4)]
    shown = {name: picture(tmp_path / f"{name}/r_0.png") for name in folders}
    small = shown["before/scale_1"].reshape(8, 4, 10, 4, 3).mean((1, 3))
    off = {name: np.abs(shown[f"{name}/scale_4"] - small).mean() for name in ("before", "after")}
    assert off["after"] < 0.3 * off["before"]
    assert np.abs(shown["after/scale_1"] - shown["before/scale_1"]).mean() < 0.3 * off["before"]
    files_of_results = model / "evaluation.json", model / "baked_evaluation" / "evaluation.json"
    results = [json.loads(file.read_text())["results"] for file in files_of_results]
    before, after = results[0]["point:dilation=0.3"], results[1]["moment:samples=4"]
    assert all(after[scale]["psnr"] > before[scale]["psnr"] + 3 for scale in ("2", "4", "8"))
    assert any("PSNR" in stdout for command, (stdout, _) in reader.output.items() if " inspect " in command)
    assert_seen(reader)
    assert (tmp_path / "garden.html").stat().st_size > 10_000


def assert_seen(reader):
    """`view` served its page."""
    (command,) = (command for command in reader.output if " view " in command and "--export" not in command)
    assert re.search(r"the page has \d{4,} bytes", reader.output[command][0])


# ------------------------------------------------------------------------------------- train.md and loop.md


def test_train(tmp_path):
    pytest.importorskip("imageio_ffmpeg", reason="needs the video extra")
    make_colmap(tmp_path / "garden")
    make_nerfstudio(tmp_path / "desk")
    make_nerf_synthetic(tmp_path / "lego")
    reader = Reader("train.md", tmp_path)
    reader.follow()
    for name in ("garden", "desk", "lego", "small", "python"):
        written = {path.name for path in (tmp_path / "out" / name).iterdir()}
        assert {"scene.ply", "cameras.json", "metrics.json", "log.jsonl", "options.json", "checkpoint.pt"} <= written
    assert io.read_metadata(tmp_path / "out" / "garden" / "scene.ply").footprint == "moment:samples=4"
    assert (tmp_path / "out" / "garden" / "point_cloud_mip.ply").exists()
    assert len(list((tmp_path / "frames").glob("*.png"))) == 7  # of nine, two are for the test
    assert len(list((tmp_path / "layers" / "depth").glob("*.npy"))) == 7
    assert (tmp_path / "film.mp4").stat().st_size > 1000
    assert (tmp_path / "garden.html").stat().st_size > 10_000
    evaluated = json.loads((tmp_path / "out" / "garden" / "evaluation.json").read_text())
    assert len(evaluated["results"]) == 3
    assert "psnr" in reader.output["python"][0]
    assert_seen(reader)


def test_loop(tmp_path):
    make_colmap(tmp_path / "garden")
    reader = Reader("loop.md", tmp_path)
    reader.follow()
    stdout = reader.output["python"][0]
    losses = [float(loss) for loss in re.findall(r"loss (\d\.\d+)", stdout)]
    counts = {int(count) for count in re.findall(r"(\d+) Gaussians", stdout)}
    assert len(losses) == 10 and losses[-1] < losses[0]
    assert len(counts) > 1
    assert io.read_metadata(tmp_path / "scene.ply").footprint == "moment:samples=4"
    assert float(re.search(r"'psnr': ([\d.]+)", stdout)[1]) > 20


def test_every_tutorial_has_a_test():
    pages = {path.stem.replace("-", "_") for path in TUTORIALS.glob("*.md")}
    assert all(f"test_{page}" in globals() for page in pages)


# ------------------------------------------------------------------------------------- poses.md


def test_poses(tmp_path):
    make_colmap(tmp_path / "garden")
    reader = Reader("poses.md", tmp_path)
    reader.follow()
    before, after = (float(number) for number in re.findall(r"poses \w+: ([\d.]+)", reader.output["python"][0]))
    assert after < before / 5
    assert picture(tmp_path / "mended.png").shape == (SIZE[1] // 2, SIZE[0], 3)
