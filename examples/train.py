"""Trains a capture at four scales and prints how good the scene is on the test pictures.

    python examples/train.py FOLDER OUT [FOOTPRINT ...]

FOLDER holds a NeRF-synthetic scene, a COLMAP reconstruction or a nerfstudio capture. With several footprints each
trains a scene of its own, in OUT/FOOTPRINT, from the same start; without any, `analytic`, `box:samples=4` and
`moment:samples=4` do, 7,000 steps each. What is in these folders is overwritten. Needs `pip install ".[train]"`.
`python -m analytic_rasterizer train` does the same with more options.
"""

import sys
from pathlib import Path

import torch

from analytic_rasterizer.training import Run, TrainingOptions

if len(sys.argv) < 3:
    sys.exit(__doc__)
folder, out, *footprints = sys.argv[1:]
for footprint in footprints or ["analytic", "box:samples=4", "moment:samples=4"]:
    options = TrainingOptions(footprint=footprint, scales=(1, 2, 4, 8), iterations=7000)
    name = footprint.replace(":", "_").replace("=", "_")
    run = Run(folder, Path(out) / name, options, device="cuda" if torch.cuda.is_available() else "cpu")
    if not run.train():
        sys.exit(f"stopped after {run.progress.step} steps and saved to {run.out}")
    metrics = run.evaluate()
    if "test" not in metrics:
        sys.exit(f"{folder} has no test pictures; {run.out} has the scene")
    measured = metrics["test"]["mean"]
    print(f"{footprint}: PSNR {measured['psnr']:.2f} dB, SSIM {measured['ssim']:.4f}, mean over scales")
