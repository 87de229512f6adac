"""Depth maps of the wall of wall.py, in the files of 3DGS and of nerfstudio."""

import json
import shutil

import numpy as np
import torch
from capture_files import opengl_pose
from cli_extra import image
from ply_files import ply, vertices
from wall import cameras, wall_points, write_wall

SCALE, SHIFT = 0.8, -0.05  # inverse depth = SCALE * stored / 2^16 + SHIFT


def depth_of(view, size=None) -> np.ndarray:
    """(H, W) float64: depth of the wall z = 0 at the centres of pixels, or of a map of another `size`, (W, H) px."""
    width, height = size or (view.width, view.height)
    x, y = (
        (torch.arange(n, dtype=torch.float64) + 0.5) * of / n for n, of in ((width, view.width), (height, view.height))
    )
    pixels = torch.stack(torch.meshgrid(x, y, indexing="xy"), 2).reshape(-1, 2)
    c2w = torch.linalg.inv(view.w2c)
    rays = view.rays_of(pixels)
    along = -c2w[2, 3] / (rays @ c2w[:3, :3].T)[:, 2]
    return view.depths_of(rays * along[:, None]).reshape(height, width).numpy()


def save_16(path, levels) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    image.fromarray(np.clip(np.round(levels), 0, 65535).astype(np.uint16)).save(path)


def write_inverse(folder, views=None, size=None, parameters=True, change=lambda i, levels: levels) -> list:
    """Maps of 3DGS beside the wall, with depth_params.json. Returns the views."""
    views = cameras() if views is None else views
    for i, view in enumerate(views):
        levels = 2**16 * (1 / depth_of(view, size) - SHIFT) / SCALE
        save_16(folder / "depths" / f"{view.name}.png", change(i, levels))
    told = {view.name: {"scale": SCALE, "offset": SHIFT} for view in views}
    if parameters:
        (folder / "sparse" / "0" / "depth_params.json").write_text(json.dumps(told | {"med_scale": SCALE}))
    return views


def deep_wall(folder, views=None, **how):
    """A capture of the wall with maps of 3DGS."""
    write_wall(folder, views)
    write_inverse(folder, views, **how)
    return folder


def write_transforms(folder, suffix=".png", unit=1e-3, frames=lambda i, frame: frame) -> list:
    """The wall as a nerfstudio capture, with maps of depths in `unit`. Returns the views."""
    views = cameras()
    write_wall(folder / "colmap", views)
    (folder / "colmap" / "images").rename(folder / "images")
    shutil.rmtree(folder / "colmap")
    listed = []
    for i, view in enumerate(views):
        path = folder / "deep" / f"{view.name}{suffix}"
        path.parent.mkdir(exist_ok=True)
        depth = depth_of(view) / unit
        np.save(path, depth.astype(np.float32)) if suffix == ".npy" else save_16(path, depth)
        frame = {"file_path": f"images/{view.name}.png", "depth_file_path": f"deep/{view.name}{suffix}"}
        listed.append(frames(i, frame | {"transform_matrix": opengl_pose(view)}))
    (folder / "transforms.json").write_text(
        json.dumps({"w": 160, "h": 120, "fl_x": 180.0, "fl_y": 180.0, "frames": listed})
    )
    points, _ = wall_points()
    (folder / "sparse_pc.ply").write_bytes(ply(vertices("xyz", points), layout="ascii"))
    return views
