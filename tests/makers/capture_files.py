"""Captures of a few coloured Gaussians, in the files of NeRF-synthetic and of COLMAP."""

import json
import math
import struct

import numpy as np
import torch
from cli_extra import image

from analytic_rasterizer import io
from analytic_rasterizer.captures import colmap
from analytic_rasterizer.gaussians import SH_C0, Gaussians
from analytic_rasterizer.training import random_points
from analytic_rasterizer.training import rendering as g


def write_colmap(folder, views, points, colors, model=1, coefficients=None) -> None:
    """A reconstruction with one camera per view, observations and tracks included.

    Views are named after their files; a name without a suffix is that of a .png.
    """
    folder.mkdir(parents=True)
    cameras, images = [struct.pack("<Q", len(views))], [struct.pack("<Q", len(views))]
    for i, view in enumerate(views):
        parameters = camera_parameters(view, model, coefficients)
        cameras.append(struct.pack(f"<iiQQ{len(parameters)}d", i + 1, model, view.width, view.height, *parameters))
        turn = quaternion(view.w2c[:3, :3])
        images.append(struct.pack("<i7di", i + 7, *turn, *view.w2c[:3, 3].tolist(), i + 1))
        images.append(
            file_name(view).encode("utf-8", "surrogateescape") + b"\0" + struct.pack("<Qddqddq", 2, 1, 2, -1, 3, 4, 5)
        )
    (folder / "cameras.bin").write_bytes(b"".join(cameras))
    (folder / "images.bin").write_bytes(b"".join(images))
    records = [struct.pack("<Q", len(points))]
    for i, (point, color) in enumerate(zip(points.tolist(), colors.tolist())):
        track = [1, 2] * (i % 3)
        records.append(struct.pack(f"<Q3d3BdQ{len(track)}i", i, *point, *color, 0.5, len(track) // 2, *track))
    (folder / "points3D.bin").write_bytes(b"".join(records))


def write_colmap_text(folder, views, points, colors, model=1, coefficients=None) -> None:
    """The same as text."""
    folder.mkdir(parents=True)
    name = colmap.BY_NUMBER[model].name
    cameras, images, rows = ["# comment"], ["# comment"], ["# comment"]
    for i, view in enumerate(views):
        parameters = camera_parameters(view, model, coefficients)
        cameras.append(" ".join(map(str, [i + 1, name, view.width, view.height, *parameters])))
        pose = [*quaternion(view.w2c[:3, :3]), *view.w2c[:3, 3].tolist()]
        images.append(" ".join(map(str, [i + 7, *pose, i + 1, file_name(view)])))
        images.append("1.0 2.0 -1" if i % 2 else "")  # a picture may have no observations
    for i, (point, color) in enumerate(zip(points.tolist(), colors.tolist())):
        rows.append(" ".join(map(str, [i, *point, *color, 0.5, 1, 2])))
    for file, lines in (("cameras", cameras), ("images", images), ("points3D", rows)):
        (folder / f"{file}.txt").write_text("\n".join(lines) + "\n", encoding="utf-8", errors="surrogateescape")


def file_name(view) -> str:
    return view.name if "." in view.name else f"{view.name}.png"


def camera_parameters(view, model, coefficients=None) -> list[float]:
    """Of a camera of this number in COLMAP; without coefficients all of them are zero."""
    model = colmap.BY_NUMBER[model]
    focal = [view.fx] if model.name.startswith(("SIMPLE_", "RADIAL")) else [view.fx, view.fy]
    center = [view.width / 2 if view.cx is None else view.cx, view.height / 2 if view.cy is None else view.cy]
    known = [*focal, *center][: model.parameters]
    return [*known, *(coefficients or [0.0] * (model.parameters - len(known)))]


def quaternion(rotation) -> list[float]:
    """(w, x, y, z) of a rotation of less than half a turn."""
    w = 0.5 * math.sqrt(1 + rotation.trace())
    skew = rotation - rotation.T
    return [w, *(skew[i, j].item() / (4 * w) for i, j in ((2, 1), (0, 2), (1, 0)))]


def looking_at_origin(angle: float, distance: float = 4.0) -> torch.Tensor:
    """World to camera from a place on a circle around y."""
    c, s = math.cos(angle), math.sin(angle)
    w2c = torch.eye(4, dtype=torch.float64)
    w2c[:3, :3] = torch.tensor([[c, 0, s], [0, 1, 0], [-s, 0, c]], dtype=torch.float64)
    w2c[2, 3] = distance
    return w2c


def circle(count: int, size=(32, 32)) -> list[io.View]:
    return [io.View(f"r_{i}", *size, 36.0, 36.0, looking_at_origin(0.3 * (i - count / 2))) for i in range(count)]


def tripod(count: int, baseline: float = 0.0) -> list[io.View]:
    """Cameras that look around from one place 4 before the origin, or from places around it within `baseline`."""
    views = []
    for i in range(count):
        across, up = 0.5 * (i / (count - 1) - 0.5), 0.2 * math.sin(2.1 * i)
        w2c = torch.eye(4, dtype=torch.float64)
        w2c[:3, :3] = turn(0, up) @ turn(1, across)
        place = [baseline * math.sin(5 * i), baseline * math.cos(3 * i), -4.0]
        w2c[:3, 3] = -w2c[:3, :3] @ torch.tensor(place, dtype=torch.float64)
        views.append(io.View(f"r_{i}", 32, 32, 36.0, 36.0, w2c))
    return views


def turn(axis: int, angle: float) -> torch.Tensor:
    """A rotation (3, 3) about a coordinate axis."""
    c, s = math.cos(angle), math.sin(angle)
    one, other = (axis + 1) % 3, (axis + 2) % 3
    rotation = torch.eye(3, dtype=torch.float64)
    rotation[one, one], rotation[one, other], rotation[other, one], rotation[other, other] = c, -s, s, c
    return rotation


def truth_gaussians() -> Gaussians:
    """A few coloured Gaussians."""
    generator = torch.Generator().manual_seed(5)
    points, _ = random_points(12, seed=5)
    gaussians = Gaussians.from_points(points, torch.rand(12, 3, generator=generator), 0)
    gaussians = gaussians._replace(log_scales=torch.full((12, 3), 0.25).log())
    return gaussians._replace(logit_opacities=torch.full((12, 1), 3.0))


def draw_picture(view, opaque: bool) -> np.ndarray:
    """The Gaussians on transparent, (H, W, 4) uint8 of straight alpha, or on black, (H, W, 3)."""
    truth = truth_gaussians()
    settings = view.settings(1, sh_degree=0, footprint="exact")
    color, _ = g.render(truth.arguments(), settings)
    if not opaque:
        white = truth._replace(shs=torch.full((12, 1, 3), 0.5 / SH_C0))
        alpha, _ = g.render(white.arguments(), settings)
        color = torch.cat([color / alpha[:1].clamp_min(1e-3), alpha[:1]])
    return (255 * color.clamp(0, 1)).round().to(torch.uint8).permute(1, 2, 0).contiguous().numpy()


def write_pictures(folder, views, opaque: bool) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for view in views:
        image.fromarray(draw_picture(view, opaque)).save(folder / f"{view.name}.png")


def opengl_pose(view) -> list:
    c2w = torch.linalg.inv(view.w2c)
    c2w[:3, 1:3] *= -1
    return c2w.tolist()


def write_nerf_synthetic(folder, train, test) -> None:
    """A scene of two lists of views of 32x32 px."""
    for split, views in (("train", train), ("test", test)):
        write_pictures(folder / split, views, opaque=False)
        frames = [{"file_path": f"./{split}/{v.name}", "transform_matrix": opengl_pose(v)} for v in views]
        content = {"camera_angle_x": 2 * math.atan(32 / 72), "frames": frames}
        (folder / f"transforms_{split}.json").write_text(json.dumps(content))
