"""A moving picture of what the order of splats does: the order of centres beside the order along rays.

    python examples/popping.py --out docs/images/popping.png

The scene is made here: three sheets of wide flat splats that cross. A camera moves around them in small steps. On the
left all pixels draw the splats in the order of their centres, on the right each pixel in that along its own ray
(`Effects.order`). Below is what changed since the picture before. `--out` is an animated PNG.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import torch

import analytic_rasterizer as ar
import moving_fly
from analytic_rasterizer import io

ORDERS = {"center": "order of centres (3DGS)", "ray": "order along rays"}
SPLATS = 4  # along each edge of a sheet
SPACING, JITTER = 0.45, 0.08  # world units
WIDE, FLAT, OPACITY = 0.28, 0.005, 0.95  # standard deviations, world units
SHEETS = (0.86, 0.27, 0.22), (0.98, 0.74, 0.2), (0.2, 0.45, 0.75)  # their colours
DISTANCE, FIELD_OF_VIEW = 7, 26  # world units; degrees
AZIMUTH, ELEVATION, SWING = 38, 27, 14  # degrees; the swing to either side
AMPLIFIED = 4
LABEL, GAP, FONT = 26, 8, 17  # px
PAPER, INK = (255, 255, 255), (40, 40, 45)
COLORS = 256


def sheets() -> dict[str, torch.Tensor]:
    """What the rasterizer takes: three sheets of flat splats, one in each plane of the axes, each of one colour."""
    middles = SPACING * (torch.arange(SPLATS) - (SPLATS - 1) / 2)
    count, means, scales, generator = SPLATS**2, [], [], torch.Generator().manual_seed(0)
    for axis in range(3):
        plane = torch.cartesian_prod(middles, middles) + JITTER * torch.randn(count, 2, generator=generator)
        means.append(torch.stack([plane[:, 0], plane[:, 1], torch.zeros(count)], 1).roll(axis, 1))
        scales.append(torch.tensor([WIDE, WIDE, FLAT]).roll(axis).repeat(count, 1))
    return {
        "means3D": torch.cat(means),
        "opacities": torch.full((3 * count,), OPACITY),
        "colors_precomp": torch.tensor(SHEETS).repeat_interleave(count, 0),
        "scales": torch.cat(scales),
        "rotations": torch.tensor([[1.0, 0, 0, 0]]).repeat(3 * count, 1),
    }


def path(frames: int) -> list[torch.Tensor]:
    """World-to-camera matrices of a closed path; the sheets' middle is ahead."""
    poses = []
    for i in range(frames):
        t = 2 * math.pi * i / frames
        a, b = math.radians(AZIMUTH + SWING * math.sin(t)), math.radians(ELEVATION + SWING / 2 * math.cos(t))
        about_y = [[math.cos(a), 0, math.sin(a)], [0, 1, 0], [-math.sin(a), 0, math.cos(a)]]
        about_x = [[1, 0, 0], [0, math.cos(b), -math.sin(b)], [0, math.sin(b), math.cos(b)]]
        pose = torch.eye(4)
        pose[:3, :3] = torch.tensor(about_x) @ torch.tensor(about_y)
        pose[2, 3] = DISTANCE
        poses.append(pose)
    return poses


def rendered(poses: list[torch.Tensor], size: int, order: str) -> list[torch.Tensor]:
    """Pictures (3, size, size) in [0, 1] of the sheets on white."""
    focal = size / 2 / math.tan(math.radians(FIELD_OF_VIEW) / 2)
    pictures = []
    for pose in poses:
        options = {"bg": torch.ones(3), "footprint": "moment", "samples": 4, "effects": ar.Effects(order=order)}
        settings = ar.camera_settings(pose, size, size, focal, focal, **options)
        pictures.append(ar.GaussianRasterizer(settings)(means2D=None, **sheets())[0].clamp(0, 1))
    return pictures


def changes(pictures: list[torch.Tensor]) -> list[torch.Tensor]:
    """(3, H, W) of what changed since the picture before; that before the first is the last."""
    return [(now - before).abs() for now, before in zip(pictures, pictures[-1:] + pictures[:-1])]


def frame(columns: list[tuple[str, torch.Tensor, torch.Tensor]]):
    """Columns of a title, a picture (3, H, W) and its change (3, H, W), amplified."""
    image, draw_module, fonts = (io.optional_import(f"PIL.{name}") for name in ("Image", "ImageDraw", "ImageFont"))
    height, width = columns[0][1].shape[1:]
    sheet = image.new("RGB", (len(columns) * (width + GAP) - GAP, 2 * (LABEL + height)), PAPER)
    draw, font = draw_module.Draw(sheet), fonts.load_default(FONT)
    for k, (title, picture, change) in enumerate(columns):
        x, below = k * (width + GAP), LABEL + height
        draw.text((x + width / 2, 0), title, INK, font, anchor="ma")
        sheet.paste(io.to_image(picture), (x, LABEL))
        draw.text((x + width / 2, below), f"change, amplified {AMPLIFIED} times", INK, font, anchor="ma")
        sheet.paste(io.to_image((AMPLIFIED * change).clamp(0, 1)), (x, below + LABEL))
    return sheet


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("popping.png"))
    parser.add_argument("--frames", type=int, default=60, metavar="N")
    parser.add_argument("--size", type=int, default=240, metavar="PX", help="of a picture")
    args = parser.parse_args()
    poses, columns = path(args.frames), []
    for order, title in ORDERS.items():
        pictures = rendered(poses, args.size, order)
        columns.append([(title, *pair) for pair in zip(pictures, changes(pictures))])
    moving_fly.write_film([frame(list(column)) for column in zip(*columns)], args.out, COLORS)


if __name__ == "__main__":
    main()
