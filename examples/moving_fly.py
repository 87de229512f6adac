"""A moving picture of the fruit fly from afar: the same path as the mesh, as `point` and as `moment` show it.

    python examples/fruit_fly.py --out DIR --views 60 --size 256 --steps 1500 --gaussians 20000
    python examples/moving_fly.py DIR --out docs/images/moving.png

The first line trains the scenes. Every frame has the mesh, rendered by MuJoCo with 4x4 samples in a pixel, the scene
trained and drawn with `point` (3DGS), and the scene trained and drawn with `moment`. The size is a fraction of the
training's, and pixels are enlarged. `--out` is an animated PNG. It prints the PSNR of both against the mesh.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import torch

import analytic_rasterizer as ar
import fruit_fly
from analytic_rasterizer import io

TITLES = ("mesh", "point (3DGS)", "moment")
SWING = 14, 5  # degrees, of azimuth and elevation
LABEL, GAP, FONT = 44, 6, 34  # px
PAPER, INK = (255, 255, 255), (40, 40, 45)
MILLISECONDS = 70  # of a frame
COLORS = 128


def path(frames: int) -> list[tuple[float, float]]:
    """Azimuth and elevation, degrees: a closed ellipse around the view that fruit_fly.png shows."""
    turns = [2 * math.pi * i / frames for i in range(frames)]
    azimuth, elevation = fruit_fly.AZIMUTH, -fruit_fly.ELEVATION
    return [(azimuth + SWING[0] * math.sin(t), elevation + SWING[1] * math.cos(t)) for t in turns]


def frame(pictures: list[torch.Tensor], box: tuple[int, int, int, int], zoom: int):
    """Pictures (3, H, W) beside each other, cut to box (left, top, right, bottom), enlarged, under their titles."""
    image, draw_module, fonts = (io.optional_import(f"PIL.{name}") for name in ("Image", "ImageDraw", "ImageFont"))
    left, top, right, bottom = box
    width, height = zoom * (right - left), zoom * (bottom - top)
    sheet = image.new("RGB", (len(pictures) * (width + GAP) - GAP, LABEL + height), PAPER)
    draw, font = draw_module.Draw(sheet), fonts.load_default(FONT)
    for k, (title, picture) in enumerate(zip(TITLES[-len(pictures) :], pictures)):
        x = k * (width + GAP)
        draw.text((x + width / 2, 0), title, INK, font, anchor="ma")
        sheet.paste(io.to_image(picture).crop(box).resize((width, height), image.NEAREST), (x, LABEL))
    return sheet


def covered(pictures: list[torch.Tensor]) -> tuple[int, int, int, int]:
    """(left, top, right, bottom) of what is not white in any picture, and a pixel around it."""
    dark = torch.stack([(picture < 0.97).any(0) for picture in pictures]).any(0)
    rows, columns = dark.any(1).nonzero(), dark.any(0).nonzero()
    height, width = dark.shape
    return (
        max(int(columns[0]) - 1, 0),
        max(int(rows[0]) - 1, 0),
        min(int(columns[-1]) + 2, width),
        min(int(rows[-1]) + 2, height),
    )


def film(rows: list[list[torch.Tensor]], zoom: int) -> list:
    """A frame for every index of the rows, which have equally many pictures; the last two are `point` and `moment`."""
    box = covered([picture for row in rows for picture in row])
    return [frame(list(pictures), box, zoom) for pictures in zip(*rows)]


def write_film(frames: list, out: Path, colors: int = COLORS) -> None:
    """An animated PNG with one palette for all frames."""
    width, height = frames[0].size
    every = io.optional_import("PIL.Image").new("RGB", (width, height * len(frames)))
    for k, picture in enumerate(frames):
        every.paste(picture, (0, k * height))
    palette = every.quantize(colors)
    first, *rest = [picture.quantize(palette=palette, dither=0) for picture in frames]
    options = {"save_all": True, "append_images": rest, "duration": MILLISECONDS, "loop": 0, "optimize": True}
    io.write_safely(out, lambda temporary: first.save(temporary, **options))


def drawn(scene: ar.Gaussians, views: list[ar.View], footprint: str) -> list[torch.Tensor]:
    return [fruit_fly.render(scene, view, 1, footprint) for view in views]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, metavar="DIR", help="that examples/fruit_fly.py wrote")
    parser.add_argument("--out", type=Path, default=Path("moving.png"))
    parser.add_argument("--frames", type=int, default=48, metavar="N")
    parser.add_argument("--size", type=int, default=56, metavar="PX", help="of a picture before it is cut")
    parser.add_argument("--zoom", type=int, default=6, metavar="N", help="side of a pixel")
    args = parser.parse_args()
    truth = fruit_fly.photograph(path(args.frames), args.size, reductions=(1,))
    rows = [[pictures[1] for pictures in truth.pictures]]
    for name, footprint in (("point", fruit_fly.TRAINED), ("moment", fruit_fly.RECOMMENDED)):
        rows.append(drawn(io.load_scene(args.folder / f"fruit_fly_{name}.ply"), truth.views, footprint))
        errors = [fruit_fly.psnr(*pair) for pair in zip(rows[-1], rows[0])]
        print(f"{name}: {sum(errors) / len(errors):.1f} dB")
    write_film(film(rows, args.zoom), args.out)


if __name__ == "__main__":
    main()
