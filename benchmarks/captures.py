"""The command line and the pictures of a capture, for benchmarks that train."""

from __future__ import annotations

import argparse
import statistics
from pathlib import Path
from typing import Any

from tqdm import tqdm

from analytic_rasterizer.analysis.timing import describe_machine
from analytic_rasterizer.training import Capture, Pictures, Trainer, TrainingOptions, load_pictures
from analytic_rasterizer.training.schedule import Clock
from analytic_rasterizer.training.start import background_of

LOOK_PERIOD = 100  # steps between looks at loss and clock


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


def train_to_end(trainer: Trainer) -> tuple[float, list[list]]:
    """Takes all steps. Returns their seconds, and a row per look: step, seconds, mean loss since then, Gaussians."""
    options, progress, history = trainer.options, trainer.progress, []
    trainer.warm_up()
    clock = Clock(trainer.device)
    clock.start()
    with tqdm(total=options.iterations if options.seconds == 0 else None, unit="step", disable=None) as bar:
        while progress.share < 1:
            trainer.step()
            if progress.step % LOOK_PERIOD == 0 or progress.step == 10 or progress.share >= 1:
                losses, seconds, count = trainer.take_losses(), clock.read(), len(trainer.gaussians.means)
                history.append([progress.step, seconds, statistics.mean(losses), count])
                progress.measure(seconds)
                bar.update(progress.step - bar.n)
    clock.stop()
    return clock.read(), history
