"""Training scenes from photographs, and measuring how good they are.

    options = TrainingOptions(scales=(1, 2, 4, 8), iterations=7000)
    run = Run("lego", "out", options, device="cuda")
    run.train()
    print(run.evaluate()["test"]["mean"])

`Run(CaptureSource("lego", masks="none"), ..)` says how the capture is read.

Needs the libraries of `pip install "analytic_rasterizer[train]"`; they are imported on first use.
"""

from ..captures.extent import extent_of
from ..captures.loading import Capture, Photograph, load_capture
from ..captures.pictures import Pictures, load_pictures
from ..captures.placement import random_points
from ..captures.source import CaptureSource
from ..captures.store import PictureMemory
from ..io import load_points
from .evaluation import evaluate, load_lpips, save_pictures
from .options import PRESETS, TrainingOptions
from .plan import CapturePlan, Finding, plan_capture
from .run import Run
from .start import starting_gaussians
from .trainer import Trainer

__all__ = [
    "PRESETS",
    "Capture",
    "CapturePlan",
    "CaptureSource",
    "Finding",
    "Photograph",
    "PictureMemory",
    "Pictures",
    "Run",
    "Trainer",
    "TrainingOptions",
    "evaluate",
    "extent_of",
    "load_capture",
    "load_lpips",
    "load_pictures",
    "load_points",
    "plan_capture",
    "random_points",
    "save_pictures",
    "starting_gaussians",
]
