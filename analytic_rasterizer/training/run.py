"""A training from a folder of pictures to a folder of results."""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Collection, Iterator, Mapping
from contextlib import closing, contextmanager
from pathlib import Path
from statistics import mean
from typing import TYPE_CHECKING, Any

import torch

from .. import io
from ..captures.loading import Photograph
from ..captures.pictures import Pictures, load_pictures
from ..captures.source import CaptureSource
from ..captures.store import PictureMemory, processes_here
from ..distributed.ranks import ALONE, Ranks
from ..filters import bake_pixel
from ..footprints import UNFILTERED
from ..gaussians import Gaussians
from ..render.order import CENTER
from .automatic import LEARNED_ALONE, Settled, said_first, settle, start_corrections
from .depth_targets import depths_of
from .evaluation import evaluate, psnr
from .files import (
    CAMERAS,
    CHECKPOINT,
    LOG,
    METRICS,
    MIP_SCENE,
    OPTIONS,
    SCENE,
    Log,
    check_results_folder,
    read_checkpoint,
    results_folder,
    write_cameras,
    write_checkpoint,
    write_json,
    write_scene,
)
from .health import finite_rows, look_at_pictures
from .interruption import interruption
from .options import TrainingOptions
from .reports import Display, TensorBoard, describe
from .schedule import Clock, describe_change
from .sharded import ShardedTrainer, shards_of
from .start import background_of, background_shown, begin, of_length
from .trainer import Trainer

if TYPE_CHECKING:
    from ..viewer import LiveViewer

LOOK_PERIOD = 100  # steps between looks at the loss and the clock, each of which waits for the device
FIRST_LOOK = 10  # steps, for the pace of a training by seconds


class Run:
    """A training with its files.

    On several ranks every rank makes one, with the same arguments but for the device, and calls its methods; both wait
    for the others. All of them read the pictures and the checkpoint, and rank 0 alone writes and shows progress.

    Args:
        scene: A `CaptureSource`: the capture and how it is read; with `resume` as when the training began, but for what
            is None. Or the folder of a capture, whose `reading` follows by the names of attributes of `CaptureSource`.
        out: Folder for the results, made if it is missing. Those of another training there are overwritten.
        options: None: the defaults, or with `resume` those of the checkpoint. With their `effects` "auto", the default,
            a training that begins has what the capture calls for in `Run.options`, and says so on stderr. Options that
            differ from their defaults stay as they are.
        device: "cpu", "cuda" or "cuda:N".
        save_every: Steps between checkpoints, besides the last; 0: none.
        resume: Go on from the checkpoint in `out`, which may be that of another number of ranks.
        iterations, seconds: With `resume`: how long to train in all, where that is not what the checkpoint says.
            Schedules are computed anew; None: as in the checkpoint, with the same bits.
        memory: How much of it pictures may take, see `PictureMemory`; the bits are the same. None: shares of what is
            free. The test gets what the training has left of limits.
        tensorboard: Write the numbers of the log for TensorBoard too, to the folder "tensorboard" in `out`.
        chosen: Names of options that somebody chose, for whom one without effect is an error. The effects leave them as
            they are.
        ranks: The processes that train together, each with a part of the Gaussians.

    Attributes:
        notes: Sentences for the user: what was chosen among what the capture holds, and what another length with
            `resume` means for the schedules.
        points_found: How many points there are in the capture or the .ply that the training starts from, of which it
            takes at most `max_gaussians`; None where it starts from a scene, a checkpoint, or random points.
        phases: Seconds of wall time by what they were spent on: "look" (at what the capture calls for), "load",
            "warm up", "steps", "write" and "evaluate".

    Raises:
        io.SceneError, OSError, ImportError, ValueError: Before anything is written.
    """

    def __init__(
        self,
        scene: CaptureSource | str | Path,
        out,
        options: TrainingOptions | None = None,
        *,
        device: str = "cpu",
        save_every: int = 5000,
        resume: bool = False,
        iterations: int | None = None,
        seconds: float | None = None,
        memory: PictureMemory | None = None,
        tensorboard: bool = False,
        chosen: Collection[str] = (),
        ranks: Ranks = ALONE,
        **reading: Any,
    ):
        source = CaptureSource.of(scene, **reading)
        if save_every < 0:
            raise ValueError(f"save_every must be at least 0, got {save_every}")
        if not resume and (iterations is not None or seconds is not None):
            raise ValueError("iterations and seconds of Run are for resume; otherwise they are among the options")
        self.memory = (memory or PictureMemory())._replace(processes=processes_here(ranks))
        self.memory.check(torch.device(device))  # raises before anything is read
        check_results_folder(out)
        if not resume:
            source.check_out(out)  # before the look at the capture, which takes seconds
        began = time.perf_counter()
        torch.backends.cudnn.allow_tf32 = False  # the variances of SSIM are small differences
        self.scene, self.out = source.folder, Path(out)
        self.device, self.save_every, self.ranks = torch.device(device), save_every, ranks
        state = read_checkpoint(self.out / CHECKPOINT, mapped=ranks.world > 1) if resume else None
        stored = None
        if state is not None:
            stored = TrainingOptions.from_dict(state["options"])
            options = of_length(stored, iterations, seconds, state["progress"]["step"], state["seconds"])
        self.options = options or TrainingOptions()
        for name, value in (dict.fromkeys((*LEARNED_ALONE, "depth"), "none") | {"order": CENTER}).items():
            given = getattr(self.options, name)
            if ranks.world > 1 and given != value:
                raise ValueError(f"{name} must be {value} for {ranks.world} processes, got {given}")
        if tensorboard:
            io.optional_import("tensorboard", "tensorboard")  # raises before the capture is looked at
        self.phases = dict.fromkeys(("look", "load", "warm up", "steps", "write", "evaluate"), 0.0)
        if state is None:
            found = self._begin(source, chosen)
            with self._phase("look"):
                files = [item.files[1] for item in self.capture.train]
                start_corrections(self.trainer.corrections, source, files, found)
        else:
            self._continue(source, state)
        self.clock, self.history = Clock(self.device), []
        if state is not None:
            self._load_state(state, stored)
        self.log = Log(self.out / LOG, self.history)
        self.board = TensorBoard(self.out, self.progress.step) if tensorboard else None
        results_folder(self.out)
        self.phases["load"] = time.perf_counter() - began - self.phases["look"]

    def _begin(self, source: CaptureSource, chosen: Collection[str]) -> Settled:
        """Looks at the capture, loads it, and makes the trainer. Returns what `settle` has found."""
        found = Settled(self.options, source)
        if self.options.effects == "auto":
            with self._phase("look"):
                found = settle(source, self.options, chosen, self.ranks)
        self.options = found.options
        with said_first(found.lines):
            self._load_capture(found.source.settled(), found.taken)
            found.source.check_effect(self.capture, chosen)  # raises before the pictures are read
            found.source.check_out(self.out, self.capture)
            start, self.points_found, self.options, said = begin(self.options, self.capture, source.points, chosen)
            self.notes = [*found.notes, *self.capture.notes, *said]
            self._make_trainer(start, None)  # an error of its pictures is one line, too
        return found

    def _continue(self, source: CaptureSource, state: dict[str, Any]) -> None:
        """Loads the capture of a training that is resumed, in its coordinates, and makes the trainer."""
        before = state["source"]
        offset = tuple(before.get("offset") or (0.0, 0.0, 0.0))  # earlier versions had none
        self._load_capture(source.settled(before), before.get("taken", {}), offset=offset)
        self.notes, self.points_found = list(self.capture.notes), None
        self._make_trainer(Gaussians(**state["gaussians"]), shards_of(state, self.ranks))

    def _load_capture(self, source: CaptureSource, taken: Mapping[str, Any], **offset: Any) -> None:
        self.capture = source.load(**offset)
        self.source = {**source.to_dict(), "taken": dict(taken), "offset": self.capture.offset}

    def _make_trainer(self, start: Gaussians, counts: list[int] | None) -> None:
        """Reads the pictures, and gives them to a trainer.

        Args:
            counts: Of a training that is resumed on several ranks, see `ShardedTrainer`.
        """
        background = background_of(self.options, self.capture.background)
        depths = depths_of(self.options, self.capture, self.source["missing"] == "skip")
        pictures = self._load(self.capture.train, background, self.memory, depths.maps)
        self.notes += [*depths.notes, *look_at_pictures(self.scene, pictures, self.device)]
        if self.ranks.world == 1:
            targets = depths.targets(pictures, self.device)
            self.trainer = Trainer(self.options, start, pictures, background, self.device, depths=targets)
        else:
            self.trainer = ShardedTrainer(self.options, start, pictures, background, self.device, self.ranks, counts)

    def _load_state(self, state: dict[str, Any], stored: TrainingOptions) -> None:
        """Goes on from a checkpoint, which has the options `stored`."""
        count = len(self.trainer.pictures.views)
        if state["pictures"] != count:
            before = state["pictures"]
            raise io.SceneError(f"{self.scene}: the checkpoint was trained with {before} pictures, got {count}")
        self.trainer.load_state_dict(state)
        self.clock.total, self.history = state["seconds"], state["history"]
        if self.options != stored:
            self._change_length(stored)

    @property
    def progress(self):
        """Steps taken, and the share of the training that is over."""
        return self.trainer.progress

    def train(self, viewer: LiveViewer | None = None) -> bool:
        """Trains to the end, or until Ctrl-C or SIGTERM, and writes everything. Returns whether it came to the end.

        Shows progress: a bar in a terminal, lines elsewhere.

        Args:
            viewer: Is shown the scene, between steps; no step waits for its frames. It is left running.

        Raises:
            FloatingPointError: The loss is not finite, or most Gaussians have left float32.
            RuntimeError: There is no Gaussian any more, or none that a picture shows.
            OSError: Results cannot be written. A periodic checkpoint that cannot be is only reported.

        After an error the files are those of the last checkpoint. Only the log is longer.
        """
        self.ranks.exchange(None)  # no rank writes before all are here
        with self._phase("write"):
            if self.ranks.is_first:
                write_json(self.out / OPTIONS, self.describe())
                write_cameras(self.out / CAMERAS, self.trainer.pictures.views)
                self.log.begin()
        trainer, progress = self.trainer, self.progress
        if self.clock.total == 0:
            with self._phase("warm up"):
                trainer.warm_up()
        figures = ""
        if viewer is not None:
            viewer.update(trainer.scene, step=progress.step)
        self.clock.start()
        steps = self.options.iterations if self.options.seconds == 0 else None
        display = Display(steps, self.options.seconds, progress.step, self.ranks.is_first)
        with self._phase("steps"), interruption() as stopped, display, closing(trainer.pictures):
            ended = False
            while progress.share < 1 and not ended:
                footprint = trainer.footprint
                trainer.step()
                ended = self.ranks.any_of(stopped.is_set())  # on which all ranks have to agree
                last = progress.share >= 1 or ended
                first_look = progress.step - progress.stride < FIRST_LOOK <= progress.step
                if progress.passed(LOOK_PERIOD) or first_look or last:
                    figures = describe(self._look(display, last, footprint))
                if viewer is not None:
                    viewer.update(trainer.scene, step=progress.step, text=figures, force=last)
                if self.save_every and progress.passed(self.save_every) and not last:
                    self._save_or_say(display)
            self.clock.stop()
        self._write()
        return progress.share >= 1

    def _look(self, display: Display, last: bool, footprint: str) -> dict[str, Any]:
        """Reads the losses and the clock, and notes what they say: in the log, on the screen, for TensorBoard.

        `footprint` is that of the last step.

        Waits for the device. Returns the entry of the log.
        """
        losses = self.trainer.take_losses()
        if last:
            self.trainer.check()
        shown = self.trainer.last  # which other ranks than the first may lack
        quality = psnr(*shown).item() if shown else math.nan
        seconds, quality = self.ranks.from_first((self.clock.read(), quality))
        self.trainer.measure(seconds)
        entry = {
            "step": self.progress.step,
            "seconds": round(seconds, 3),
            "loss": mean(losses),
            "psnr": None if math.isnan(quality) else quality,  # where nothing counts there is none
            "gaussians": self.count(),
            "dropped": self.trainer.dropped,
            **({"footprint": footprint} if self.options.begins_with else {}),
        }
        self.history.append(entry)
        if self.ranks.is_first:
            try:
                self.log.add(entry)
            except OSError as error:
                display.warn(f"{error}; training goes on")
            if self.board is not None:
                self.board.add(entry)
        display.show(entry, last)
        self._warn(display)
        return entry

    def _warn(self, display: Display) -> None:
        """Tells the user what the trainer has to say."""
        for text in self.trainer.warnings:
            display.warn(text)
        self.trainer.warnings.clear()

    def _save_or_say(self, display: Display) -> None:
        """A checkpoint on the way. That the disk is full now need not end the training."""
        self.clock.stop()
        try:
            self.save()
        except OSError as error:
            display.warn(f"{error}; training goes on")
        self.clock.start()

    def _write(self) -> None:
        """The scene, and the checkpoint, which is much larger: that of a full disk costs no scene."""
        with self._phase("write"):
            scene = self._whole(self.trainer.scene(), SCENE)
            if self.ranks.is_first:
                write_scene(self.out / SCENE, scene, self.options.footprint, self.capture.offset, self.options.order)
                self.trainer.corrections.write(self.out)
        self.save()
        if self.board is not None:
            self.board.close()

    @contextmanager
    def _phase(self, name: str) -> Iterator[None]:
        """Counts the time in its block as spent on `name`, and not on the phase around it."""
        began, others = time.perf_counter(), sum(self.phases.values())
        try:
            yield
        finally:
            self.phases[name] += time.perf_counter() - began - (sum(self.phases.values()) - others)

    def _whole(self, scene: Gaussians, name: str) -> Gaussians:
        """The scene of all ranks, of which `scene` is this one's: on rank 0, on the CPU, without rows on the others.

        Warns of Gaussians that the file `name` cannot hold, and leaves them out: a filter may leave float32 where
        parameters have not.
        """
        kept = finite_rows(scene)
        if not kept.all():
            warnings.warn(f"{int((~kept).sum()):,} Gaussians outside of float32 are left out of {name}", stacklevel=3)
            scene = scene.rows(kept)
        return scene.map(self.ranks.gather_rows)

    def export_mip(self) -> Path:
        """Writes and returns point_cloud_mip.ply: the scene for viewers that do not integrate, see `bake_pixel`.

        The pixels are those of the training pictures at the finest scale. Raises OSError.
        """
        scene = self.trainer.scene()
        cameras = self.trainer.pictures.settings[min(self.options.scales)]
        scales, opacities = bake_pixel(scene.means, scene.scales, scene.rotations, scene.opacities, cameras)
        baked = self._whole(scene.with_activated(scales, opacities), MIP_SCENE)
        if self.ranks.is_first:
            # Its pixels are in the Gaussians.
            write_scene(self.out / MIP_SCENE, baked, UNFILTERED, self.capture.offset, self.options.order)
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
            order=self.options.order,
            background=background_shown(self.options, self.capture.background),
            name=Path(self.source["scene"]).name,
        )

    def describe(self) -> dict[str, Any]:
        """What options.json holds."""
        name = torch.cuda.get_device_name(self.device) if self.device.type == "cuda" else "CPU"
        background = background_shown(self.options, self.capture.background)
        described = {"source": self.source, "background": list(background), "device": name}
        return described | {"torch": torch.__version__, "options": self.options.to_dict()}

    def save(self) -> None:
        """Writes the checkpoint. Raises OSError, on all ranks, if that cannot be done."""
        self.trainer.check()
        state = self.trainer.state_dict() | {
            "options": self.options.to_dict(),
            "source": self.source,
            "pictures": len(self.trainer.pictures.views),
            "seconds": self.clock.read(),
            "history": self.history,
        }
        error = None
        with self._phase("write"):
            if self.ranks.is_first:
                try:
                    write_checkpoint(self.out / CHECKPOINT, state)
                except OSError as raised:
                    error = raised
        reason = self.ranks.from_first(None if error is None else str(error))
        if reason is not None:
            raise error or OSError(reason)

    def summary(self) -> dict[str, Any]:
        """Steps, seconds, milliseconds per step and Gaussians so far."""
        steps, seconds = self.progress.step, self.ranks.from_first(self.clock.read())
        pace = 1e3 * seconds / max(steps, 1)
        return {"steps": steps, "seconds": seconds, "ms_per_step": pace, "gaussians": self.count()}

    def evaluate(self) -> dict[str, Any]:
        """Writes and returns metrics.json: `summary`, and `evaluate` on the test views, if any."""
        metrics = self.summary()
        if self.capture.test:
            with self._phase("evaluate"):
                background = background_shown(self.options, self.capture.background)
                memory = self.memory.less(self.trainer.pictures.store.plan, self.device)
                pictures = self._load(self.capture.test, background, memory)
                common = {"supersampling": self.options.supersampling, "ranks": self.ranks, "color_corrected": True}
                common |= {"order": self.options.order, "falloffs": self.trainer.corrections.known()}
                metrics["test"] = evaluate(self.trainer.scene(), pictures, self.options.footprint, **common)
        phases = {name: round(seconds, 3) for name, seconds in self.phases.items()}
        metrics["phases"] = self.ranks.from_first(phases)
        if self.ranks.is_first:
            write_json(self.out / METRICS, metrics)
        return metrics

    def _change_length(self, before: TrainingOptions) -> None:
        """Where the options have another length than those of the checkpoint."""
        by_clock = self.options.seconds != 0
        factor = before.seconds / self.options.seconds if by_clock else before.iterations / self.options.iterations
        self.trainer.change_length(factor)
        self.notes.append(describe_change(before, self.options, self.progress.step, self.progress.share))

    def _load(self, photographs: list[Photograph], background, memory: PictureMemory, maps=None) -> Pictures:
        """Their pictures at the scales of the training."""
        options = self.options
        return load_pictures(photographs, options.scales, background, self.device, options.downsampling, memory, maps)

    def count(self) -> int:
        """Gaussians of all ranks."""
        return self.trainer.count
