"""The command line and the pictures of a capture, for benchmarks that train."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from analytic_rasterizer.analysis.timing import describe_machine
from analytic_rasterizer.training import Capture, Pictures, TrainingOptions, load_pictures
from analytic_rasterizer.training.start import background_of


def add_capture(parser: argparse.ArgumentParser) -> None:
    """Adds a capture."""
    parser.add_argument("scene", type=Path, help="folder of a capture")
    parser.add_argument("--images", default="images", help="folder in it of a reconstruction's photographs")


def load_train_and_test(
    args: argparse.Namespace, capture: Capture, options: TrainingOptions
) -> tuple[Any, Pictures, Pictures]:
    """The background of the capture, and its pictures for training and for the test. Says how many there are."""
    background = background_of(options, capture.background)
    train, test = (
        load_pictures(items, options.scales, background, args.device, options.downsampling)
        for items in (capture.train, capture.test)
    )
    print(f"{args.scene}, {len(train.views)} pictures, {len(test.views)} for the test, {describe_machine(args.device)}")
    return background, train, test
