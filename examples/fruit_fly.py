"""A scene trained from data that is free: a fruit fly, drawn at reduced resolution by `point` and by `moment`.

    pip install "mujoco<4" etils absl-py pyopengl && pip install --no-deps dm_control
    python examples/fruit_fly.py --out DIR

The model is the fruit fly of dm_control (DeepMind Technologies, Apache-2.0), whose wheel ships its meshes. MuJoCo
(Apache-2.0) renders it, by EGL; a pixel is the mean of 4x4 samples. The scene is trained twice, with `point` as 3DGS
does and with `moment`. The first is drawn with `point`, and baked with `moment`. DIR gets fruit_fly.png: one test view
at 1/1, 1/4 and 1/8 of the size, with the PSNR of all test views against the mesh at that size. It also gets
fruit_fly.json and the scenes. Takes some minutes on two cores.
"""

from __future__ import annotations

import argparse
import importlib.util
import math
import os
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch.nn.functional import avg_pool2d

import analytic_rasterizer as ar
from analytic_rasterizer import io, training

MODEL = "locomotion/walkers/assets/fruitfly_v2/fruitfly.xml"
TRAINED, RECOMMENDED = "point", "moment:samples=4"
REDUCTIONS = (1, 2, 4, 8)
DRAWN = (1, 4, 8)
SAMPLES = 4  # of a photograph's pixel along each axis
FIELD_OF_VIEW = 45  # degrees
DISTANCE = 0.8  # of the cameras to the fly, units of the model: cm
AZIMUTH, ELEVATION = 140, 20  # degrees, of the view that is drawn
TEST_EVERY = 8
PAPER, INK, GAP, LABELS, PANEL = (255, 255, 255), (40, 40, 45), 8, 130, 280  # of the sheet, px


class Photographs(NamedTuple):
    """Views, their pictures by reduction, (3, H, W) in [0, 1], and points on the surface with colours."""

    views: list[ar.View]
    pictures: list[dict[int, torch.Tensor]]
    points: torch.Tensor


def directions(count: int) -> list[tuple[float, float]]:
    """Azimuth and elevation, degrees, of cameras spread evenly over a sphere without its south; the first is drawn."""
    rising = [-0.3 + 1.25 * (i + 0.5) / (count - 1) for i in range(count - 1)]
    golden = 180 * (3 - math.sqrt(5))
    return [(AZIMUTH, -ELEVATION), *((i * golden % 360, -math.degrees(math.asin(z))) for i, z in enumerate(rising))]


def photograph(angles: list[tuple[float, float]], size: int, reductions: tuple[int, ...] = REDUCTIONS) -> Photographs:
    """Renders the fly on white, from azimuth and elevation in degrees."""
    os.environ.setdefault("MUJOCO_GL", "egl")
    mujoco = io.optional_import("mujoco")
    found = importlib.util.find_spec("dm_control")  # of which only the file is read
    if found is None:
        raise ImportError("this needs the files of dm_control: pip install --no-deps dm_control")
    spec = mujoco.MjSpec.from_file(str(Path(found.submodule_search_locations[0]) / MODEL))
    white = {"rgb1": [1, 1, 1], "rgb2": [1, 1, 1], "width": 16, "height": 96}
    spec.add_texture(
        name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, builtin=mujoco.mjtBuiltin.mjBUILTIN_FLAT, **white
    )
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    model.vis.headlight.diffuse[:] = 0.15  # it moves with the camera
    model.vis.headlight.ambient[:] = 0.45
    model.vis.headlight.specular[:] = 0
    model.vis.global_.fovy = FIELD_OF_VIEW
    model.vis.global_.offwidth = model.vis.global_.offheight = SAMPLES * size
    renderer = mujoco.Renderer(model, SAMPLES * size, SAMPLES * size)
    camera = mujoco.MjvCamera()
    camera.type, camera.distance = mujoco.mjtCamera.mjCAMERA_FREE, DISTANCE
    camera.lookat[:] = model.stat.center
    focal = size / 2 / math.tan(math.radians(FIELD_OF_VIEW / 2))
    views, pictures = [], []
    for i, (camera.azimuth, camera.elevation) in enumerate(angles):
        renderer.update_scene(data, camera)
        samples = torch.from_numpy(renderer.render().copy()).permute(2, 0, 1) / 255
        pictures.append({n: avg_pool2d(samples, SAMPLES * n) for n in reductions})
        left, right = renderer.scene.camera
        forward, up = np.array(left.forward, float), np.array(left.up, float)
        axes = np.stack([np.cross(forward, up), -up, forward])  # right, down, forward
        pose = np.eye(4)
        pose[:3, :3] = axes
        pose[:3, 3] = -axes @ ((np.array(left.pos, float) + np.array(right.pos, float)) / 2)
        views.append(ar.View(f"{i:03d}", size, size, focal, focal, torch.from_numpy(pose)))
    return Photographs(views, pictures, surface(model, data))


def surface(model, data, count: int = 20_000) -> torch.Tensor:
    """Vertices of the visible meshes, (count, 3)."""
    points = []
    for geom in range(model.ngeom):
        mesh = model.geom_dataid[geom]
        if mesh >= 0 and model.geom_group[geom] < 3:
            first, number = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
            vertices = model.mesh_vert[first : first + number]
            points.append(vertices @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom])
    points = torch.from_numpy(np.concatenate(points)).float()
    return points[torch.randperm(len(points), generator=torch.Generator().manual_seed(0))[:count]]


def train(photographs: Photographs, footprint: str, steps: int, limit: int) -> ar.Gaussians:
    """Trains on all pictures of the full size but those for testing."""
    chosen = [i for i in range(len(photographs.views)) if i % TEST_EVERY]
    views = [photographs.views[i] for i in chosen]
    settings = [view.settings(background=io.WHITE) for view in views]
    colors = [(255 * photographs.pictures[i][1]).round().to(torch.uint8) for i in chosen]
    options = training.TrainingOptions(
        footprint=footprint, iterations=steps, max_gaussians=limit, background="white", sh_degree=2
    )
    start = training.starting_gaussians(options, (photographs.points, torch.full_like(photographs.points, 0.5)))
    pictures = training.Pictures(views, {1: settings}, {1: colors})
    trainer = training.Trainer(options, start, pictures, io.WHITE, "cpu")
    for step in range(steps):
        trainer.step()
        if step % 100 == 99:
            print(f"{footprint}: step {step + 1}, {trainer.count} Gaussians, loss {trainer.take_losses()[-1]:.4f}")
    return trainer.scene()


@torch.no_grad()
def render(scene: ar.Gaussians, view: ar.View, reduction: int, footprint: str) -> torch.Tensor:
    settings = view.settings(1 / reduction, io.WHITE, scene.sh_degree, footprint)
    return ar.GaussianRasterizer(settings)(means2D=None, **scene.arguments())[0].clamp(0, 1)


def psnr(color: torch.Tensor, truth: torch.Tensor) -> float:
    return -10 * (color - truth).square().mean().log10().item()


class Row(NamedTuple):
    """What the sheet shows beside each other: the pictures of one view, and the PSNR of all, by reduction."""

    title: str
    pictures: dict[int, torch.Tensor]
    psnr: dict[int, float]


def measure(title: str, scene: ar.Gaussians, footprint: str, photographs: Photographs) -> Row:
    tested = range(0, len(photographs.views), TEST_EVERY)
    scores = {}
    for reduction in REDUCTIONS:
        errors = [
            psnr(render(scene, photographs.views[i], reduction, footprint), photographs.pictures[i][reduction])
            for i in tested
        ]
        scores[reduction] = sum(errors) / len(errors)
    return Row(title, {n: render(scene, photographs.views[0], n, footprint) for n in DRAWN}, scores)


def draw_sheet(rows: list[Row]):
    """A row for every way to draw, a column for every reduction; small pictures have large pixels."""
    image, draw_module, fonts = (io.optional_import(f"PIL.{name}") for name in ("Image", "ImageDraw", "ImageFont"))
    # What the fly covers, in pixels of the smallest picture, and one around it.
    coarse = max(DRAWN)
    covered = (rows[0].pictures[coarse] < 1).any(0)
    top, left = (int(covered.any(axis).nonzero()[0]) - 1 for axis in (1, 0))
    bottom, right = (int(covered.any(axis).nonzero()[-1]) + 2 for axis in (1, 0))
    height = PANEL * (bottom - top) // (right - left)
    size = LABELS + len(DRAWN) * (PANEL + GAP), 24 + len(rows) * (height + GAP)
    sheet = image.new("RGB", size, PAPER)
    draw, font = draw_module.Draw(sheet), fonts.load_default(15)
    for k, reduction in enumerate(DRAWN):
        x = LABELS + k * (PANEL + GAP)
        pixels = rows[0].pictures[reduction].shape[2]
        draw.text((x + PANEL / 2, 4), f"{pixels} x {pixels} px", INK, font, anchor="ma")
        for i, row in enumerate(rows):
            y, scale = 24 + i * (height + GAP), coarse // reduction
            box = [scale * edge for edge in (left, top, right, bottom)]
            way = image.LANCZOS if box[2] - box[0] > PANEL else image.NEAREST
            sheet.paste(io.to_image(row.pictures[reduction]).crop(box).resize((PANEL, height), way), (x, y))
            if row.psnr:
                draw.text((x + PANEL - 4, y + height - 4), f"{row.psnr[reduction]:.1f} dB", INK, font, anchor="rd")
            if k == 0:
                draw.multiline_text((GAP, y + height / 2), row.title, INK, font, anchor="lm")
    return sheet


def compare(photographs: Photographs, out: Path, steps: int, limit: int) -> None:
    """Trains, measures and draws; `limit` is the most Gaussians."""
    point = train(photographs, TRAINED, steps, limit)
    cameras = [view.settings() for i, view in enumerate(photographs.views) if i % TEST_EVERY]
    parts = ar.bake_dilation(point.means, point.scales, point.rotations, point.opacities, cameras)
    baked = point.with_activated(*parts)
    moment = train(photographs, RECOMMENDED, steps, limit)
    rows = [Row("the mesh,\nrendered by\nMuJoCo", photographs.pictures[0], {})]
    for name, title, scene, footprint in (
        ("point", "trained and\ndrawn with\npoint (3DGS)", point, TRAINED),
        ("baked", "the same scene\nbaked, drawn\nwith moment", baked, RECOMMENDED),
        ("moment", "trained and\ndrawn with\nmoment", moment, RECOMMENDED),
    ):
        io.save_scene(out / f"fruit_fly_{name}.ply", scene, io.SceneMetadata(footprint))
        rows.append(measure(title, scene, footprint, photographs))
        print(name, scene.count, rows[-1].psnr)
    io.write_json(out / "fruit_fly.json", {row.title: row.psnr for row in rows[1:]})
    io.save_image(out / "fruit_fly.png", draw_sheet(rows).quantize(256), optimize=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out"))
    parser.add_argument("--views", type=int, default=120, metavar="N")
    parser.add_argument("--size", type=int, default=400, metavar="PX", help="a multiple of 8")
    parser.add_argument("--steps", type=int, default=3000, metavar="N")
    parser.add_argument("--gaussians", type=int, default=60_000, metavar="N", help="at most")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    compare(photograph(directions(args.views), args.size), args.out, args.steps, args.gaussians)


if __name__ == "__main__":
    main()
