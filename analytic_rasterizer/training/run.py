"""A training from a folder of pictures to a folder of results."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from statistics import mean
from typing import TYPE_CHECKING, Any

import torch

from .. import io
from ..distributed.ranks import ALONE, Ranks
from ..filters import bake_pixel
from ..gaussians import Gaussians
from .captures import IMAGES, TEST_PERIOD, Capture, Photograph, load_capture
from .evaluation import evaluate, psnr
from .files import (
    CAMERAS,
    CHECKPOINT,
    LOG,
    METRICS,
    MIP_SCENE,
    OPTIONS,
    SCENE,
    read_checkpoint,
    results_folder,
    write_cameras,
    write_checkpoint,
    write_json,
    write_log,
    write_scene,
)
from .options import TrainingOptions
from .pictures import Pictures, load_pictures
from .schedule import Clock
from .sharded import ShardedTrainer, shards_of
from .trainer import Trainer, background_of, starting_gaussians

if TYPE_CHECKING:
    from ..viewer import LiveViewer

LOOK_PERIOD = 100  # steps between looks at the loss and the clock, each of which waits for the device
FIRST_LOOK = 10  # steps, for the pace of a training by seconds


class Run:
    """A training with its files.

    On several ranks every rank makes one, with the same arguments but for the device, and calls its methods; both wait
    for the others. All of them read the pictures and the checkpoint, and rank 0 alone writes and shows progress.

    Args:
        scene: Folder of a capture, see `load_capture`.
        out: Folder for the results, made if it is missing. Those of another training there are overwritten.
        options: None: the defaults, or with `resume` those of the checkpoint.
        device: "cpu", "cuda" or "cuda:N".
        images, test_every: As `load_capture`; None: "images" and 8. With `resume` None, or the same as when the
            training began.
        points: A .ply to start from: a 3DGS scene, or points with colours. None: what the capture has. Of more points
            than `max_gaussians`, so many are drawn at random. With `resume` None, or the same as when the training
            began.
        save_every: Steps between checkpoints, besides the last; 0: none.
        resume: Go on from the checkpoint in `out`, which may be that of another number of ranks.
        ranks: The processes that train together, each with a part of the Gaussians.

    Attributes:
        points_found: How many points there are in the capture or the .ply that the training starts from, of which it
            takes at most `max_gaussians`; None where it starts from a scene, a checkpoint, or random points.

    Raises:
        io.SceneError, OSError, ImportError, ValueError: Before anything is written.
    """

    def __init__(
        self,
        scene,
        out,
        options: TrainingOptions | None = None,
        *,
        device: str = "cpu",
        images: str | None = None,
        test_every: int | None = None,
        points=None,
        save_every: int = 5000,
        resume: bool = False,
        ranks: Ranks = ALONE,
    ):
        if save_every < 0:
            raise ValueError(f"save_every must be at least 0, got {save_every}")
        torch.backends.cudnn.allow_tf32 = False  # the variances of SSIM are small differences
        self.out, self.device, self.save_every, self.ranks = Path(out), torch.device(device), save_every, ranks
        state = read_checkpoint(self.out / CHECKPOINT, mapped=ranks.world > 1) if resume else None
        if state is not None:
            options = TrainingOptions.from_dict(state["options"])
        self.options = options or TrainingOptions()
        # Where the scene is, from wherever `evaluate` is called.
        self.source = {"scene": os.path.abspath(scene), **source_of(images, test_every, points, state)}
        self.capture = load_capture(scene, self.source["images"], self.source["test_every"])
        if state is None:  # raises before the pictures are read
            start, self.points_found = first_gaussians(self.options, self.capture, points)
        else:
            start, self.points_found = Gaussians(**state["gaussians"]), None
        background = background_of(self.options, self.capture.background)
        pictures = self._load(self.capture.train, background)
        if ranks.world == 1:
            self.trainer = Trainer(self.options, start, pictures, background, self.device)
        else:
            counts = None if state is None else shards_of(state, ranks)
            self.trainer = ShardedTrainer(self.options, start, pictures, background, self.device, ranks, counts)
        self.clock, self.history = Clock(self.device), []
        if state is not None:
            if state["pictures"] != len(pictures.views):
                raise io.SceneError(
                    f"{scene}: the checkpoint was trained with {state['pictures']} pictures, got {len(pictures.views)}"
                )
            self.trainer.load_state_dict(state)
            self.clock.total, self.history = state["seconds"], state["history"]
        results_folder(self.out)

    @property
    def progress(self):
        return self.trainer.progress

    def train(self, viewer: LiveViewer | None = None) -> bool:
        """Trains to the end, or until Ctrl-C or SIGTERM, and writes everything. Returns whether it came to the end.

        Args:
            viewer: Is shown the scene, between steps; no step waits for its frames. It is left running.

        Raises:
            FloatingPointError: The loss is not finite; files are then those of the last checkpoint.
            OSError: Results cannot be written. A periodic checkpoint that cannot be is only reported.
        """
        tqdm = io.optional_import("tqdm", "train").tqdm
        self.ranks.exchange(None)  # no rank writes before all are here
        if self.ranks.is_first:
            write_json(self.out / OPTIONS, self.describe())
            write_cameras(self.out / CAMERAS, self.trainer.pictures.views)
        trainer, progress = self.trainer, self.trainer.progress
        if self.clock.total == 0:
            trainer.warm_up()
        figures = ""
        if viewer is not None:
            viewer.update(trainer.scene, step=progress.step)
        self.clock.start()
        total = self.options.iterations if self.options.seconds == 0 else None
        hidden = None if self.ranks.is_first else True  # None: where stderr is no terminal
        with interruption() as stopped, tqdm(total=total, initial=progress.step, unit="step", disable=hidden) as bar:
            ended = False
            while progress.share < 1 and not ended:
                trainer.step()
                ended = self.ranks.any_of(stopped.is_set())  # on which all ranks have to agree
                last = progress.share >= 1 or ended
                first_look = progress.step - progress.stride < FIRST_LOOK <= progress.step
                if progress.passed(LOOK_PERIOD) or first_look or last:
                    bar.update(progress.step - bar.n)
                    look = self._look()
                    bar.set_postfix(look)
                    figures = ", ".join(f"{name} {value}" for name, value in look.items())
                if viewer is not None:
                    viewer.update(trainer.scene, step=progress.step, text=figures, force=last)
                if self.save_every and progress.passed(self.save_every) and not last:
                    self._save_or_say(bar)
        self.clock.stop()
        self.save()
        scene = self._whole(trainer.scene())
        if self.ranks.is_first:
            write_scene(self.out / SCENE, scene, self.options.footprint)
        return progress.share >= 1

    def _whole(self, scene: Gaussians) -> Gaussians:
        """The scene of all ranks, of which `scene` is this one's: on rank 0, on the CPU, without rows on the others."""
        return scene.map(self.ranks.gather_rows)

    def export_mip(self) -> Path:
        """Writes and returns point_cloud_mip.ply: the scene for viewers that do not integrate, see `bake_pixel`.

        The pixels are those of the training pictures at the finest scale. Raises OSError.
        """
        scene = self.trainer.scene()
        cameras = self.trainer.pictures.settings[min(self.options.scales)]
        scales, opacities = bake_pixel(scene.means, scene.scales, scene.rotations, scene.opacities, cameras)
        baked = self._whole(scene.with_activated(scales, opacities))
        if self.ranks.is_first:
            write_scene(self.out / MIP_SCENE, baked, "point")
        return self.out / MIP_SCENE

    def start_viewer(self, port: int = 0) -> LiveViewer:
        """A viewer for `train`, with the training views, footprint and background. The caller stops it.

        Args:
            port: To listen on; 0 takes any free one.

        Raises:
            ImportError: viser is missing; names the extra that installs it.
            ValueError: A port that cannot be used.
        """
        from ..viewer import LiveViewer

        return LiveViewer(
            port,
            views=self.trainer.pictures.views,
            footprint=self.options.footprint,
            background=background_of(self.options, self.capture.background) or self.capture.background,
            name=Path(self.source["scene"]).name,
        )

    def describe(self) -> dict[str, Any]:
        """What options.json holds."""
        name = torch.cuda.get_device_name(self.device) if self.device.type == "cuda" else "CPU"
        return {"source": self.source, "device": name, "torch": torch.__version__, "options": self.options.to_dict()}

    def save(self) -> None:
        """Writes the checkpoint and the log. Raises OSError, on all ranks, if that cannot be done."""
        state = self.trainer.state_dict() | {
            "options": self.options.to_dict(),
            "source": self.source,
            "pictures": len(self.trainer.pictures.views),
            "seconds": self.clock.read(),
            "history": self.history,
        }
        error = None
        if self.ranks.is_first:
            try:
                write_checkpoint(self.out / CHECKPOINT, state)
                write_log(self.out / LOG, self.history)
            except OSError as raised:
                error = raised
        reason = self.ranks.from_first(None if error is None else str(error))
        if reason is not None:
            raise error or OSError(reason)

    def summary(self) -> dict[str, Any]:
        """Steps, seconds, milliseconds per step and Gaussians so far."""
        steps, seconds = self.progress.step, self.ranks.from_first(self.clock.read())
        return {
            "steps": steps,
            "seconds": seconds,
            "ms_per_step": 1e3 * seconds / max(steps, 1),
            "gaussians": self.count(),
        }

    def evaluate(self) -> dict[str, Any]:
        """Writes and returns metrics.json: `summary`, and `evaluate` on the test views, if any."""
        metrics = self.summary()
        if self.capture.test:
            # A random background has no truth of its own to test against: the convention's has.
            background = background_of(self.options, self.capture.background) or self.capture.background
            pictures = self._load(self.capture.test, background)
            common = {"supersampling": self.options.supersampling, "ranks": self.ranks}
            metrics["test"] = evaluate(self.trainer.scene(), pictures, self.options.footprint, **common)
        if self.ranks.is_first:
            write_json(self.out / METRICS, metrics)
        return metrics

    def _load(self, photographs: list[Photograph], background: tuple[float, float, float] | None) -> Pictures:
        """Their pictures at the scales of the training."""
        options = self.options
        # Of several ranks each shows one in N of them: memory of the device is for Gaussians.
        on_host = self.ranks.world > 1
        return load_pictures(photographs, options.scales, background, self.device, options.downsampling, on_host)

    def count(self) -> int:
        """Gaussians of all ranks."""
        return sum(self.ranks.exchange(len(self.trainer.gaussians.means)))

    def _look(self) -> dict[str, str]:
        """Reads the losses and the clock, notes them in the history, and says what the bar shows."""
        losses = self.trainer.take_losses()
        shown = self.trainer.last  # which other ranks than the first may lack
        quality = psnr(*shown).item() if shown else None
        seconds, quality = self.ranks.from_first((self.clock.read(), quality))
        self.progress.measure(seconds)
        entry = {
            "step": self.progress.step,
            "seconds": round(seconds, 3),
            "loss": mean(losses),
            "psnr": quality,
            "gaussians": self.count(),
        }
        self.history.append(entry)
        return {
            "loss": f"{entry['loss']:.4f}",
            "PSNR": f"{entry['psnr']:.1f}",
            "Gaussians": f"{entry['gaussians']:,}",
        }

    def _save_or_say(self, bar) -> None:
        """A checkpoint on the way. That the disk is full now need not end the training."""
        self.clock.stop()
        try:
            self.save()
        except OSError as error:
            if self.ranks.is_first:
                bar.write(f"warning: {error}; training goes on", file=sys.stderr)
        self.clock.start()


def source_of(images: str | None, test_every: int | None, points, state: dict[str, Any] | None) -> dict[str, Any]:
    """Where pictures and points come from: as given or usual, or as in the checkpoint of a training that is resumed.

    Raises ValueError for another source than it began with: it would go on with other pictures, or points of no effect.
    """
    given = {"images": images, "test_every": test_every, "points": points and str(Path(points).resolve())}
    usual = {"images": IMAGES, "test_every": TEST_PERIOD, "points": None}
    if state is not None:
        usual = given | state["source"]  # which has no points in earlier versions: nobody knows them
    chosen = {name: usual[name] if value is None else value for name, value in given.items()}
    for name, value in chosen.items():
        if state is not None and value != usual[name]:
            expected = "None" if usual[name] is None else f"{usual[name]} or None"
            raise ValueError(f"{name} must be {expected} where a training is resumed, got {value}")
    return chosen


def first_gaussians(options: TrainingOptions, capture: Capture, points) -> tuple[Gaussians, int | None]:
    """From a .ply if one is given, a scene or points; otherwise from the capture's points, or at random places.

    Also returns how many points there were, of which `starting_gaussians` takes at most `max_gaussians`; None where the
    Gaussians are those of a scene, or random.

    Raises:
        ValueError: A scene without Gaussians, or with more than `max_gaussians`; what `starting_gaussians` raises.
    """
    if points is not None and io.is_scene(points):
        scene = io.load_scene(points)
        if not len(scene.means):  # from which nothing would ever grow
            raise io.SceneError(f"{points}: the scene has no Gaussians")
        if len(scene.means) > options.gaussian_limit:
            expected = f"at least {len(scene.means)}, the Gaussians of {points}, or 0"
            raise ValueError(f"max_gaussians must be {expected}, got {options.max_gaussians}")
        return scene.with_sh_degree(options.sh_degree).trainable(), None
    found = capture.points if points is None else io.load_points(points)
    return starting_gaussians(options, found), None if found is None else len(found[0])


@contextmanager
def interruption() -> Iterator[threading.Event]:
    """Ctrl-C or SIGTERM sets the event, so that the step that runs is completed; a second one ends the process at once.

    A second Ctrl-C raises KeyboardInterrupt. A handler of the program for SIGTERM is left in place.
    """
    stopped = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield stopped  # only the main thread may look at signals
        return
    usual = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: signal.SIG_DFL}
    if signal.getsignal(signal.SIGTERM) != signal.SIG_DFL:
        del usual[signal.SIGTERM]
    before = {number: signal.getsignal(number) for number in usual}

    def stop(number: int, _) -> None:
        stopped.set()
        signal.signal(number, usual[number])

    try:
        for number in usual:
            signal.signal(number, stop)
        yield stopped
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
