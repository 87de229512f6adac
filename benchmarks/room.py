"""Makes a capture indoors: photographs of a textured room with furniture, as nerfstudio's files.

    python benchmarks/room.py room
    python benchmarks/capture_effects.py room --out effects --device cuda

Rays are followed to the walls and to boxes, whose faces have random textures; a pixel is the mean of its rays. Colours
do not depend on the direction. The points are those where rays of the cameras end. Needs `pip install ".[train]"`.
"""

from __future__ import annotations

import argparse
import json
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from common import parse_size
from lens_training import write_points
from PIL import Image
from torch import from_numpy

ROOM = np.array([[0.0, 0.0, 0.0], [6.0, 5.0, 2.8]])  # m: lowest and highest corner, z is up
FURNITURE = 12  # boxes on the floor
TEXELS = 150  # per m
OCTAVES = (0.5, 0.12, 0.03)  # m, patches of the textures
EYES = (1.0, 1.9)  # m, heights of cameras
FREE = 0.4  # m between cameras and everything
RAYS = 3  # along a pixel


def make_boxes(random: np.random.Generator) -> np.ndarray:
    """(FURNITURE + 1, 2, 3) corners. The first is the room, of which the inside is seen."""
    sizes = random.uniform((0.4, 0.4, 0.3), (1.4, 1.0, 1.6), (FURNITURE, 3))
    lowest = random.uniform(0, 1, (FURNITURE, 3)) * (ROOM[1] - sizes)
    lowest[:, 2] = 0
    return np.concatenate([ROOM[None], np.stack([lowest, lowest + sizes], 1)])


def make_textures(boxes: np.ndarray, random: np.random.Generator) -> dict[tuple[int, int], np.ndarray]:
    """Colours in [0, 1] of the faces (box, 2 * axis + side): (.., .., 3), along the other two axes."""
    textures = {}
    for place, (low, high) in enumerate(boxes):
        for axis in range(3):
            lengths = np.delete(high - low, axis)
            rows, columns = (max(round(TEXELS * length), 4) for length in lengths)
            for side in range(2):
                found = np.zeros((rows, columns, 1), np.float32)
                for patch in OCTAVES:
                    shape = [int(length / patch) + 3 for length in lengths]
                    coarse = Image.fromarray(random.integers(0, 256, shape, np.uint8))
                    found += np.asarray(coarse.resize((columns, rows), Image.BICUBIC), np.float32)[:, :, None] / 255
                paint = random.uniform(0.25, 0.5) + random.uniform(-0.15, 0.15, 3)
                textures[place, 2 * axis + side] = (paint * (0.3 + 1.4 * found / len(OCTAVES))).clip(0.02, 0.98)
    return textures


def trace(origins: np.ndarray, rays: np.ndarray, boxes: np.ndarray, textures: dict) -> tuple[np.ndarray, np.ndarray]:
    """Where rays (N, 3) from origins (N, 3) or (3,) end, and the colours there, both (N, 3)."""
    nearest = np.full(len(rays), np.inf)
    faces = np.zeros((len(rays), 2), int)
    with np.errstate(divide="ignore"):
        inverse = 1 / rays
    for place, (low, high) in enumerate(boxes):
        begins, ends = (low - origins) * inverse, (high - origins) * inverse
        entry, leaving = np.minimum(begins, ends), np.maximum(begins, ends)
        distances = leaving if place == 0 else entry
        axis = distances.argmin(1) if place == 0 else distances.argmax(1)
        distance = np.take_along_axis(distances, axis[:, None], 1)[:, 0]
        hit = distance < nearest
        if place:
            hit &= (distance > 0) & (entry.max(1) < leaving.min(1))
        side = (np.take_along_axis(rays, axis[:, None], 1)[:, 0] > 0) == (place == 0)
        nearest[hit] = distance[hit]
        faces[hit] = np.stack([np.full(len(rays), place), 2 * axis + side], 1)[hit]
    points = origins + nearest[:, None] * rays
    colors = np.zeros_like(points)
    for (place, face), texture in textures.items():
        here = (faces == (place, face)).all(1)
        low, high = (np.delete(corner, face // 2) for corner in boxes[place])
        share = (np.delete(points[here], face // 2, 1) - low) / (high - low)
        row, column = (share * texture.shape[:2]).astype(int).clip(0, np.array(texture.shape[:2]) - 1).T
        colors[here] = texture[row, column]
    return points, colors


def make_poses(count: int, boxes: np.ndarray, random: np.random.Generator) -> list[np.ndarray]:
    """4x4 camera to world with the axes of OpenGL: right, up, back."""
    poses = []
    while len(poses) < count:
        eye = random.uniform((FREE, FREE, EYES[0]), (*(ROOM[1, :2] - FREE), EYES[1]))
        if ((eye > boxes[1:, 0] - FREE) & (eye < boxes[1:, 1] + FREE)).all(1).any():
            continue
        # Towards the middle, so that photographs see the same things.
        towards = ROOM.mean(0) + random.uniform(-1, 1, 3) * (1.5, 1.2, 0.6) - eye
        back = -towards / np.linalg.norm(towards)
        right = np.cross([0.0, 0.0, 1.0], back)
        if np.linalg.norm(right) < 0.3:
            continue
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3] = np.stack([right, np.cross(back, right), back, eye], 1)
        poses.append(pose)
    return poses


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    add = parser.add_argument
    add("folder", type=Path, help="is made")
    add("--count", type=int, default=160, help="photographs (default: %(default)s)")
    add("--size", type=parse_size, default="720x480", help="px (default: %(default)s)")
    add("--points", type=int, default=20000, help="to start from (default: %(default)s)")
    args = parser.parse_args()
    random = np.random.default_rng(0)
    boxes = make_boxes(random)
    textures = make_textures(boxes, random)
    poses = make_poses(args.count, boxes, random)
    width, height = args.size
    focal = 0.6 * width
    (args.folder / "images").mkdir(parents=True)

    def rays_of(x: np.ndarray, y: np.ndarray, pose: np.ndarray) -> np.ndarray:
        """Directions in the world of pixels, whose middle is half a pixel off."""
        return np.stack([(x - width / 2) / focal, -(y - height / 2) / focal, -np.ones_like(x)], -1) @ pose[:3, :3].T

    def photograph(place: int) -> dict:
        x, y = ((np.arange(RAYS * length) + 0.5) / RAYS for length in (width, height))
        rays = rays_of(*np.meshgrid(x, y), poses[place]).reshape(-1, 3)
        colors = trace(poses[place][:3, 3], rays, boxes, textures)[1]
        picture = colors.reshape(height, RAYS, width, RAYS, 3).mean((1, 3))
        name = f"images/{place:04}.png"
        Image.fromarray((255 * picture).round().astype(np.uint8)).save(args.folder / name)
        return {"file_path": name, "transform_matrix": poses[place].tolist()}

    with ThreadPoolExecutor() as pool:
        frames = list(pool.map(photograph, range(args.count)))
    camera = {"w": width, "h": height, "fl_x": focal, "fl_y": focal, "cx": width / 2, "cy": height / 2}
    (args.folder / "transforms.json").write_text(
        json.dumps({**camera, "ply_file_path": "points.ply", "frames": frames})
    )
    chosen = np.array(poses)[random.integers(0, args.count, args.points)]
    corners = random.uniform(0, 1, (args.points, 2)) * (width, height)
    rays = np.stack([rays_of(x, y, pose) for (x, y), pose in zip(corners, chosen)])
    points, colors = trace(chosen[:, :3, 3], rays, boxes, textures)
    write_points(args.folder / "points.ply", from_numpy(points), from_numpy(colors))


if __name__ == "__main__":
    main()
