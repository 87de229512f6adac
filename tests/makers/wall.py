"""A capture of a wall of known light, with an effect or without."""

import struct
from functools import lru_cache

import numpy as np
import torch
from capture_files import looking_at_origin, quaternion
from cli_extra import image

from analytic_rasterizer import io
from analytic_rasterizer.captures import evidence

COUNT, SIZE, HALF = 10, (160, 120), 3.0  # photographs, px, half the width of the wall that they show


def texture(x, y) -> np.ndarray:
    """(.., 3) colours of a wall at (x, y) in linear light, of several octaves, smooth enough to be measured."""
    x, y = (np.asarray(value, dtype=np.float64)[..., None] for value in (x, y))
    phase = np.array([0.0, 0.3, 0.6])
    found = 0.25 + 0.02 * np.sin(3 * x + phase) * np.cos(2 * y + phase)
    for frequency in (17, 37, 61, 83):
        found = found + 0.05 * np.sin(frequency * x + phase) * np.cos(0.9 * frequency * y - phase)
    return found


def stored(light) -> np.ndarray:
    light = np.clip(light, 0, 1)
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 1e-9) ** (1 / 2.4) - 0.055)


def photograph(view, gain=(1.0, 1.0, 1.0), blur=0, falloff=None) -> np.ndarray:
    """(H, W, 3) uint8 of the wall, whose light has a factor falloff(x, y) at halves of the diagonal from the middle."""
    light = light_of(view) * np.array(gain)
    if falloff is not None:
        x, y = ((np.arange(size) + 0.5 - middle) for size, middle in zip((view.width, view.height), view.middle))
        half = np.hypot(view.width, view.height) / 2
        light = light * falloff(x / half, y[:, None] / half)[:, :, None]
    planes = torch.from_numpy(stored(light)).permute(2, 0, 1)[:, None]
    for _ in range(blur):
        planes = evidence._blurred(planes)
    return (255 * planes[:, 0].permute(1, 2, 0)).round().to(torch.uint8).numpy()


@lru_cache(maxsize=256)
def light_of(view) -> np.ndarray:
    """(H, W, 3) light of the wall z = 0, averaged over 3x3 samples of a pixel."""
    samples = 3
    x, y = ((torch.arange(samples * size, dtype=torch.float64) + 0.5) / samples for size in (view.width, view.height))
    pixels = torch.stack(torch.meshgrid(x, y, indexing="xy"), 2).reshape(-1, 2)
    c2w = torch.linalg.inv(view.w2c)
    rays = view.rays_of(pixels) @ c2w[:3, :3].T
    hit = c2w[:3, 3] - rays * (c2w[2, 3] / rays[:, 2])[:, None]
    shape = view.height, samples, view.width, samples, 3
    return texture(*hit[:, :2].T.numpy()).reshape(shape).mean((1, 3))


def cameras(distance=lambda i: 4.0, lens=None, count=COUNT) -> list:
    angles = [0.08 * COUNT / count * (i - count / 2) for i in range(count)]
    poses = [looking_at_origin(angle, distance(i)) for i, angle in enumerate(angles)]
    return [io.View(f"p_{i}", *SIZE, 180.0, 180.0, pose, lens=lens) for i, pose in enumerate(poses)]


def wall_points(count=600) -> tuple[torch.Tensor, torch.Tensor]:
    xy = 2 * torch.rand(count, 2, generator=torch.Generator().manual_seed(3), dtype=torch.float64) - 1
    points = torch.cat([HALF / 2 * xy, torch.zeros(count, 1, dtype=torch.float64)], 1)
    return points, torch.from_numpy(255 * stored(texture(*points[:, :2].T.numpy()))).round().to(torch.uint8)


def write_tracked(folder, views, points, colors, tracked=True, model=1, coefficients=()) -> None:
    """A reconstruction of which every photograph observes every point that it shows, or none."""
    folder.mkdir(parents=True)
    files = {name: [struct.pack("<Q", len(rows))] for name, rows in (("cameras", views), ("images", views))}
    for i, view in enumerate(views):
        numbers = (view.fx, view.fy, *view.middle, *coefficients)
        files["cameras"].append(struct.pack(f"<iiQQ{len(numbers)}d", i, model, view.width, view.height, *numbers))
        pose = (*quaternion(view.w2c[:3, :3]), *view.w2c[:3, 3].tolist())
        pixels = view.pixels_of(points @ view.w2c[:3, :3].T + view.w2c[:3, 3])
        shown = ((pixels >= 0) & (pixels < torch.tensor(SIZE))).all(1) & tracked
        seen = shown.nonzero()[:, 0].tolist()
        rows = [struct.pack("<ddq", *pixels[row].tolist(), 5 * row + 2) for row in seen] + [
            struct.pack("<ddq", 1, 1, -1)
        ]
        files["images"].append(struct.pack("<i7di", i, *pose, i) + f"{view.name}.png".encode() + b"\0")
        files["images"].append(struct.pack("<Q", len(rows)) + b"".join(rows))
    files["points3D"] = [struct.pack("<Q", len(points))]
    for row, (point, color) in enumerate(zip(points.tolist(), colors.tolist())):
        files["points3D"].append(struct.pack("<Q3d3BdQ", 5 * row + 2, *point, *color, 0.5, 0))
    for name, parts in files.items():
        (folder / f"{name}.bin").write_bytes(b"".join(parts))


def write_wall(
    folder, views=None, tracked=True, gains=None, blurred=(), shift=(0, 0, 0), points=True, falloff=None, **camera
):
    """A capture of the wall. Pictures are those of `views`, whose world is then shifted."""
    views = cameras() if views is None else views
    (folder / "images").mkdir(parents=True)
    for i, view in enumerate(views):
        gain = (1, 1, 1) if gains is None else gains(i)
        picture = photograph(view, gain, 1 if i in blurred else 0, falloff)
        image.fromarray(picture).save(folder / "images" / f"{view.name}.png")
    xyz, colors = wall_points() if points else (torch.zeros(0, 3, dtype=torch.float64), torch.zeros(0, 3))
    world = [view.in_frame(tuple(-float(s) for s in shift)) for view in views]
    write_tracked(folder / "sparse" / "0", world, xyz + torch.tensor(shift), colors, tracked, **camera)
    return folder
