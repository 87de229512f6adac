"""Pictures of docs/gallery.md: test photographs of a capture beside renderings of a scene that was trained on it.

    python benchmarks/gallery.py TRAINING --name maryrose --views IMG_9685 IMG_9733

TRAINING is the folder that `train` wrote. Each photograph and each rendering is a file, at each of `--scales`; coarse
ones have their pixels enlarged, so that all have one size. What masks leave out is white in both, and what is
transparent too. It prints the PSNR of each pair, dB, over what counts.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import torch
from torch import Tensor

from analytic_rasterizer import io
from analytic_rasterizer.distributed.ranks import ALONE
from analytic_rasterizer.training import CaptureSource, Pictures, load_pictures
from analytic_rasterizer.training.evaluation import psnr, rendered

IMAGES = Path(__file__).resolve().parents[1] / "docs" / "images" / "gallery"
SCALES = (1, 4, 8)
QUALITY = 86  # of WebP at the full size; enlarged pixels are lossless
WHITE = 1.0


def capture_of(training: Path):
    """The capture of a training, read as it was."""
    return CaptureSource.from_dict(json.loads((training / "options.json").read_text())["source"]).settled().load()


def on_white(image: Tensor, mask: Tensor | None) -> Tensor:
    return image if mask is None else image * mask + WHITE * (1 - mask)


def save(image: Tensor, scale: int, path: Path) -> None:
    """Writes a picture (3, H, W), with each pixel enlarged to scale x scale."""
    picture = io.to_image(image)
    if scale == 1:
        picture.save(path, quality=QUALITY, method=6)
    else:
        nearest = io.optional_import("PIL.Image").Resampling.NEAREST
        picture.resize((scale * picture.width, scale * picture.height), nearest).save(path, lossless=True, method=6)


@torch.no_grad()
def draw(scene, pictures: Pictures, footprint: str, out: Path, name: str) -> list[tuple[str, int, float]]:
    """Writes NAME_VIEW_SCALE_photograph.webp and _rendering.webp; names, scales and PSNR of all pairs, dB."""
    measured = []
    for scale, settings in pictures.resolve(footprint=footprint, sh_degree=scene.sh_degree).items():
        for view, image in rendered(scene.arguments(), settings, 1, ALONE):
            truth, mask = pictures.truth(scale, view), pictures.mask(scale, view)
            stem = Path(pictures.views[view].name).stem
            measured.append((stem, scale, psnr(image, truth, mask).item()))
            for kind, shown in (("photograph", truth), ("rendering", image.clamp(0, 1))):
                save(on_white(shown, mask), scale, out / f"{name}_{stem}_{scale}_{kind}.webp")
    return measured


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("training", type=Path, help="folder that `train` wrote")
    add("--name", required=True, help="of the files")
    add("--views", nargs="*", default=[], metavar="NAME", help="test photographs (default: all)")
    add("--scales", nargs="+", type=int, default=SCALES, metavar="N")
    add("--footprint", metavar="NAME[:k=v]", help="(default: that of the training)")
    add("--out", type=Path, default=IMAGES, metavar="DIR")
    args = parser.parse_args()
    found = io.find_scene(args.training)
    capture, scene = capture_of(args.training), io.load_scene(found.path)
    footprint = str(found.choose_footprint(args.footprint).footprint)
    chosen = [item for item in capture.test if not args.views or Path(item.view.name).stem in args.views]
    args.out.mkdir(parents=True, exist_ok=True)
    pictures = load_pictures(chosen, tuple(args.scales), (WHITE,) * 3, "cpu")
    for stem, scale, value in draw(scene, pictures, footprint, args.out, args.name):
        print(f"{stem} 1/{scale}: {value:.2f} dB")


if __name__ == "__main__":
    main()
