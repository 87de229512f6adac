"""Makes a capture (transforms.json) of a data set in LLFF's format, as docs/gallery.md does.

    git clone https://github.com/vork/maryRose
    python benchmarks/llff.py maryRose maryrose --reduce 4

SOURCE has `images`, `poses_bounds.npy` with a camera for each in the order of their names, and if there are masks
`masks/NAME_mask.*`, white where a photograph counts. Pictures are averaged over squares of `--reduce` pixels. With
`--alpha` masks become the alpha of the pictures: what they leave out is empty, where otherwise nothing is said of it.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np

from analytic_rasterizer.io import optional_import

SUFFIXES = (".jpg", ".jpeg", ".png")


def cameras(file: Path) -> tuple[np.ndarray, np.ndarray]:
    """Camera-to-world matrices (N, 4, 4) with the axes right, up, back; and height, width and focal length (N, 3), px.

    A row of the file is a matrix of 3 rows: the axes down, right and back, the position, and the three numbers; then
    the nearest and the farthest depth.
    """
    rows = np.load(file)[:, :15].reshape(-1, 3, 5)
    down, right, back, position, size = (rows[:, :, i] for i in range(5))
    matrices = np.tile(np.eye(4), (len(rows), 1, 1))
    matrices[:, :3] = np.stack([right, -down, back, position], axis=2)
    return matrices, size


def pictures_in(folder: Path) -> list[Path]:
    return sorted(path for path in folder.glob("*") if path.suffix.lower() in SUFFIXES)


def convert(source: Path, out: Path, reduce: int, alpha: bool = False) -> int:
    """Writes the capture; returns the number of its photographs."""
    Image = optional_import("PIL.Image")
    names, masks = pictures_in(source / "images"), pictures_in(source / "masks")
    of_name = {mask.stem.removesuffix("_mask"): mask for mask in masks}
    matrices, sizes = cameras(source / "poses_bounds.npy")
    if len(names) != len(matrices):
        raise SystemExit(f"{source}: {len(matrices)} cameras for {len(names)} pictures in images")
    for folder in ("images",) if alpha or not masks else ("images", "masks"):
        (out / folder).mkdir(parents=True, exist_ok=True)
    frames = []
    for path, matrix, (_, before, focal) in zip(names, matrices, sizes):
        picture = Image.open(path).convert("RGB").reduce(reduce)
        focal *= picture.width / before
        width, height = picture.size
        camera = {"w": width, "h": height, "fl_x": focal, "fl_y": focal, "cx": width / 2, "cy": height / 2}
        frames.append({"file_path": f"images/{path.stem}.png", "transform_matrix": matrix.tolist(), **camera})
        if path.stem in of_name:
            mask = Image.open(of_name[path.stem]).convert("L").reduce(reduce)
            if alpha:
                picture.putalpha(mask)
            else:
                frames[-1]["mask_path"] = f"masks/{path.stem}.png"
                mask.save(out / frames[-1]["mask_path"])
        picture.save(out / "images" / f"{path.stem}.png")
    text = json.dumps({"camera_model": "PINHOLE", "frames": frames}, indent=1)
    (out / "transforms.json").write_text(text)
    return len(frames)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("source", type=Path, help="folder with images, masks and poses_bounds.npy")
    add("out", type=Path, help="folder to write")
    add("--reduce", type=int, default=1, metavar="N", help="side of the squares of pixels (default: 1)")
    add("--alpha", action="store_true", help="masks become the alpha of the pictures")
    args = parser.parse_args()
    print(f"{args.out}: {convert(args.source, args.out, args.reduce, args.alpha)} photographs")


if __name__ == "__main__":
    main()
