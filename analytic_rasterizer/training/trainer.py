"""One training: the Gaussians, their optimizer, and what a step does."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from .. import _C
from ..captures.extent import extent_of
from ..captures.loading import WHITE
from ..captures.pictures import Pictures
from ..density import GradientDensity
from ..distributed.ranks import ALONE, Ranks
from ..filters import apply_3d_filter, compute_3d_filter
from ..gaussians import Gaussians
from ..render.arguments import camera_arguments
from ..render.seam import turn_of
from ..render.settings import GaussianRasterizationSettings
from .control import make_density, regularizers_of
from .corrections import Corrections
from .counting import Counting, no_rows
from .depth_targets import Targets
from .health import check_left, check_visible, drop_broken
from .optimizer import TrainingAdam
from .options import TrainingOptions
from .rendering import enlarged
from .schedule import (
    PictureOrder,
    Progress,
    depth_weight_at,
    footprint_at,
    means_rate_at,
    rates_factor_at,
    sh_degree_at,
)

_picture_gradients = _C.Call("picture_gradients")

SH_REST_SHARE = 1 / 20  # of the learning rate of the constant
FILTER_PERIOD = 100  # steps between two 3D filters, while Gaussians move
CHECK_PERIOD = 100  # steps between looks at the numbers of the Gaussians, each of which waits for the device
ADAM_EPS = 1e-15


class Shown(NamedTuple):
    """A picture that a step renders."""

    scale: int
    view: int
    settings: GaussianRasterizationSettings
    background: Tensor | None  # (3,) that was drawn for it


@contextmanager
def deterministic_mode() -> Iterator[None]:
    """torch's deterministic mode, in which CUDA frames count their pairs. One that is on already stays as it is.

    Operators without a deterministic algorithm warn. Not by `use_deterministic_algorithms`, which imports the compiler.
    """
    before = torch.get_deterministic_debug_mode()
    torch.set_deterministic_debug_mode(before or "warn")
    try:
        yield
    finally:
        torch.set_deterministic_debug_mode(before)


class Trainer:
    """Trains Gaussians on pictures, step by step.

    On CUDA nothing in a step waits for the device, but one step in 100, and those that change the number of Gaussians.
    The same seed gives the same bits (on CUDA see `deterministic` of the options); so does a training that goes on from
    `state_dict`, in another process as well.

    Args:
        options: Of the training.
        start: Parameters, on any device; they are copied.
        pictures: To train with; with alpha where the background is random.
        background: Behind the pictures, 0 to 1; None: random.
        device: To train on, that of the pictures.
        ranks: See `ShardedTrainer`; this class trains in one process.
        extent: Of the capture, world units; None: that of the pictures and the starting Gaussians, see `extent_of`.
        depths: What `options.depth` compares pictures with, by scale and view; None: nothing.

    Attributes:
        gaussians: The parameters at present.
        progress: Steps taken, and the share of the training that is over.
        losses: Of the steps since they were last taken away, one-element tensors.
        dropped: Gaussians that were taken away because a number of theirs had left float32.
        warnings: Sentences for the user; who has told them empties the list.
    """

    def __init__(
        self,
        options: TrainingOptions,
        start: Gaussians,
        pictures: Pictures,
        background: tuple[float, float, float] | None,
        device: str | torch.device,
        ranks: Ranks = ALONE,
        extent: float | None = None,
        depths: Targets | None = None,
    ):
        self.options, self.pictures, self.device, self.ranks = options, pictures, torch.device(device), ranks
        self.random_background, self.depths = background is None, depths
        self.extent = extent_of(pictures.views, start.means.cpu()) if extent is None else extent
        gaussians = start.map(lambda field: field.detach().to(self.device, torch.float32, copy=True).contiguous())
        gaussians = gaussians.map(Tensor.requires_grad_)
        self.rates = {
            "means": options.means_rate * self.extent,
            "log_scales": options.scale_rate,
            "rotations": options.rotation_rate,
            "logit_opacities": options.opacity_rate,
            "shs": options.color_rate * SH_REST_SHARE,
        }
        groups = [{"params": [getattr(gaussians, name)], "lr": self.rates[name]} for name in Gaussians._fields]
        groups[-1] |= {"head": 1, "head_lr": options.color_rate}  # the constant
        self.optimizer = TrainingAdam(groups, eps=ADAM_EPS)
        self.order = PictureOrder(len(pictures.views), options)
        self.counting = Counting(len(self.order.pairs)) if Counting.called_for(options, pictures) else None
        extra = None if self.counting is None else no_rows(gaussians)
        self.density = make_density(options, gaussians, self.optimizer, self.extent, background == WHITE, ranks, extra)
        self.generator = torch.Generator(self.device).manual_seed(options.seed + 1)
        self.progress = Progress(options.iterations if options.seconds == 0 else None, options.seconds)
        self.corrections = Corrections(options, pictures.views, self.device)
        self.filter_3d: Tensor | None = None
        share = 1 / options.pictures_per_step  # of a picture's loss in that of the step
        self.dL_dloss = torch.full((), share, dtype=torch.float32, device=self.device)
        self.losses: list[Tensor] = []
        self._last: tuple[Tensor, Tensor, Tensor | None] | None = None  # picture, target and mask of the last step
        self.dropped, self.warnings = 0, []
        # Footprint and degree of the harmonics, and the settings with them.
        self._resolved: tuple[tuple[str, int], dict] | None = None
        self._cameras: dict[tuple[int, int], dict[str, Any]] = {}  # by scale and view, of the same settings
        if options.filter_3d:
            self._compute_filter()

    @property
    def gaussians(self) -> Gaussians:
        """The parameters at present."""
        return self.density.gaussians

    @property
    def count(self) -> int:
        """How many Gaussians there are, of all ranks."""
        return len(self.gaussians.means)

    @property
    def last(self) -> tuple[Tensor, Tensor, Tensor | None] | None:
        """Picture, target (`Pictures.target`) and mask (`Pictures.mask`) of the last step."""
        return self._last

    def step(self) -> None:
        """Takes one step of the optimizer.

        Raises:
            FloatingPointError: At a look, every 100 steps: most Gaussians have left float32.
            RuntimeError: There is no Gaussian any more, or none that a picture shows.
        """
        with deterministic_mode() if self.options.deterministic else nullcontext():
            self._step()

    def _step(self) -> None:
        progress, optimizer = self.progress, self.optimizer
        stride = self.stride
        self._set_rates()
        loss, rows = self._differentiate()
        self.losses.append(loss)
        if self.counting is not None:
            self.counting.observe(self)
        optimizer.update(rows)
        optimizer.zero_grad(set_to_none=True)
        progress.advance(stride)
        if progress.passed(CHECK_PERIOD):
            self.check()
        elif self._may_change():
            drop_broken(self)  # before they multiply
        if self.counting is not None and self._may_change():
            self.counting.drop(self)
        before = self.count
        changed = self.density.after_step(progress.step, progress.share, stride)
        if changed:
            self._rebalance()
            check_left(self, before)
        if self.options.filter_3d and (changed or progress.passed(FILTER_PERIOD)):
            self._compute_filter()

    def _may_change(self) -> bool:
        """Whether density control may change the number of Gaussians after this step."""
        if self.options.density == "none":
            return False
        progress, told = self.progress, self.density.options
        grows = progress.step > told.densify_from and progress.share < told.densify_until
        return grows and progress.passed(told.densify_every)

    def measure(self, elapsed: float) -> None:
        """Corrects a training by the clock by the seconds `elapsed`: the share that is over, and the times of growth.

        In a training by steps nothing changes.
        """
        self.progress.measure(elapsed)
        if self.options.seconds and self.options.density != "none":
            times = self.options.growth.times(self.progress.expected(self.options.iterations))
            self.density.options = replace(self.density.options, **times)

    def change_length(self, factor: float) -> None:
        """Recomputes the schedules where the steps or seconds in all are no longer those of the state that was loaded.

        Args:
            factor: Their number in the state over that of the options.
        """
        self.progress.rescale(factor)
        if isinstance(self.density, GradientDensity):  # which had ended, or has to end now
            self.density.growing = self.progress.share < self.density.options.densify_until

    def check(self) -> None:
        """Takes away Gaussians of which a number has left float32, and raises what `step` does. Collective."""
        drop_broken(self)
        check_visible(self)

    def keep(self, kept: Tensor) -> None:
        """Takes away all Gaussians but those of the mask `kept` (P,). Collective."""
        self.density.keep(kept)
        self._rebalance()
        if self.filter_3d is not None:
            self._compute_filter()

    @property
    def stride(self) -> int:
        """Steps of one process that the next step stands for."""
        return 1

    def _set_rates(self) -> None:
        """Gives the optimizer the learning rates of the next step."""
        options, over = self.options, self.progress.share
        factor = rates_factor_at(self.progress.step, options, self.progress.expected(options.iterations))
        for group, rate in zip(self.optimizer.param_groups, self.rates.values()):
            group["lr"] = rate * factor
        self.optimizer.param_groups[-1]["head_lr"] = options.color_rate * factor
        self.optimizer.param_groups[0]["lr"] = self.extent * means_rate_at(self.progress.step, over, options)

    def _next(self) -> list[Shown]:
        """The pictures of the next step."""
        count, settings = self.options.pictures_per_step, self._settings()
        first = self.progress.step * count
        self._expect(first)
        shown = []
        for n in range(first, first + self.stride * count):
            view, scale = self.order(n)
            chosen, background = settings[scale][view], None
            if self.random_background:
                background = torch.rand(3, generator=self.generator, dtype=torch.float32, device=self.device)
                chosen = chosen._replace(bg=background)
            shown.append(Shown(scale, view, chosen, background))
        return shown

    def _expect(self, first: int) -> None:
        """Has the pictures fetched that this process shows from the picture number `first` on."""
        if self.pictures.horizon:
            world, shown = self.ranks.world, self.stride * self.options.pictures_per_step
            numbers = range(first + self.ranks.rank, first + shown + world * self.pictures.horizon, world)
            self.pictures.expect(map(self.order, numbers))

    @torch.no_grad()
    def _differentiate(self) -> tuple[Tensor, Tensor | None]:
        """The loss of the next step, and with `sparse_adam` the rows that the optimizer updates: what a picture shows.

        Gradients of the loss are those of the parameters, and density control and the corrections have seen theirs.
        """
        fields, losses = list(self.gaussians), []
        visible: Tensor | None = None
        for shown in self._next():
            loss, radii, gradients = self._differentiate_picture(shown)
            if losses:
                torch._foreach_add_([field.grad for field in fields], gradients[: len(fields)])
            else:
                for field, gradient in zip(fields, gradients):
                    field.grad = gradient
            losses.append(loss)
            if self._watches(shown.scale):
                self.density.observe_gradients(gradients[len(fields)], radii)
            self.corrections.observe(shown.view, gradients)
            if self.options.sparse_adam:
                visible = radii > 0 if visible is None else visible | (radii > 0)
        self.corrections.update(self.progress.share)
        return losses[0] if len(losses) == 1 else torch.stack(losses).mean(), visible

    def _differentiate_picture(self, shown: Shown) -> tuple[Tensor, Tensor, list[Tensor]]:
        """The loss of a picture with the regularizers, its radii, and gradients in the order of `picture_gradients`."""
        options = self.options
        opacity_weight, scale_weight = regularizers_of(options, self.extent)
        compared = self._comparison(shown)
        given = {
            "mean_columns": self.density.columns if self._watches(shown.scale) else 0,
            "dL_dloss": self.dL_dloss,
            "filter_3d": self.filter_3d,
            "opacity_weight": opacity_weight,
            "scale_weight": scale_weight,
        }
        given |= compared | self._depth(shown) | self._camera(shown)
        made = _picture_gradients(*self.gaussians, bg=shown.settings.bg, **given)
        loss, image, radii, gradients = made
        self._last = image, compared["target"], compared["mask"]
        return loss, radii, gradients

    def _comparison(self, shown: Shown) -> dict[str, Any]:
        """How a rendering becomes a loss, by the names of the ops."""
        target = self.pictures.target(shown.scale, shown.view, shown.background)
        return self.corrections.arguments(shown.view, target) | {
            "target": target,
            "mask": self.pictures.mask(shown.scale, shown.view),
            "ssim_weight": self.options.ssim_weight,
            "supersampling": self.options.supersampling,
        }

    def _depth(self, shown: Shown) -> dict[str, Any]:
        """What the depths of a picture are compared with, by the names of the op; nothing where they are not."""
        weight = depth_weight_at(self.progress.share, self.options)
        target = self.depths(shown.scale, shown.view) if self.depths is not None and weight else None
        return {} if target is None else target.arguments(weight)

    def _camera(self, shown: Shown) -> dict[str, Any]:
        """Camera and footprint of a picture by the names of the ops; made once for every picture and degree."""
        camera = self._cameras.get((shown.scale, shown.view))
        if camera is None:
            larger = enlarged(shown.settings, self.options.supersampling)
            camera = camera_arguments(larger, self.gaussians.means, None, with_seam=True) | {"turn": turn_of(larger)}
            self._cameras[shown.scale, shown.view] = camera
        return camera

    def _watches(self, scale: int) -> bool:
        """Whether density control sees the gradients of pictures of this scale."""
        options = self.options
        return self.density.watches and (options.gradient_scales != "finest" or scale == min(options.scales))

    def _rebalance(self) -> None:
        """Called when the number of Gaussians has changed; there is nothing to do in one process."""

    @property
    def footprint(self) -> str:
        """That of the next step."""
        return footprint_at(self.progress.step, self.progress.share, self.options)

    def _settings(self) -> dict:
        """Settings of all pictures, with the footprint and the degree of the harmonics that are due."""
        due = self.footprint, sh_degree_at(self.progress.step, self.progress.share, self.options)
        if self._resolved is None or self._resolved[0] != due:
            if self._resolved is not None and self._resolved[0][0] != due[0] and self.device.type == "cuda":
                torch.cuda.empty_cache()  # buffers of another footprint have other sizes
            self._resolved = due, self.pictures.resolve(self.options.order, footprint=due[0], sh_degree=due[1])
            self._cameras = {}
        return self._resolved[1]

    def _compute_filter(self) -> None:
        self.filter_3d = compute_3d_filter(self.gaussians.means.detach(), self._settings()[min(self.options.scales)])

    @torch.no_grad()
    def warm_up(self) -> None:
        """Renders and differentiates a picture of each scale and footprint without a step, so that no step loads
        kernels."""
        for footprint in {self.footprint, self.options.footprint}:
            for scale, settings in self._settings().items():
                background = settings[0].bg if self.random_background else None
                self._differentiate_picture(Shown(scale, 0, settings[0]._replace(footprint=footprint), background))
            self._cameras = {}
        self._last = None

    def take_losses(self) -> list[float]:
        """The losses of the steps since the last call. Waits for the device.

        Raises:
            FloatingPointError: One is not finite.
        """
        if not self.losses:
            return []
        values = torch.stack(self.losses).tolist()
        self.losses = []
        for i, value in enumerate(values):
            if not math.isfinite(value):
                step = self.progress.step - (len(values) - i - 1) * self.progress.stride
                raise FloatingPointError(f"the loss of step {step} is {value}; lower learning rates may help")
        return values

    @torch.no_grad()
    def scene(self) -> Gaussians:
        """The Gaussians without gradients, with the 3D filter applied where there is one."""
        scene = self.gaussians.map(Tensor.detach)
        if self.filter_3d is None:
            return scene
        return scene.with_activated(*apply_3d_filter(scene.scales, scene.opacities, self.filter_3d))

    def state_dict(self) -> dict[str, Any]:
        """All that decides how the training goes on. Tensors are those of the training, not copies."""
        return {
            "gaussians": {name: field.detach() for name, field in self.gaussians._asdict().items()},
            "optimizer": self.optimizer.state_dict(),
            "density": self.density.state_dict(),
            "progress": self.progress.state_dict(),
            "generator": self.generator.get_state(),
            "filter_3d": self.filter_3d,
            "counting": None if self.counting is None else self.counting.state_dict(self.density),
            "extent": self.extent,
            "dropped": self.dropped,
        } | self.corrections.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Goes on from the `state` that `state_dict` gave."""
        gaussians = Gaussians(**state["gaussians"]).map(lambda field: field.to(self.device, copy=True).requires_grad_())
        for group, field in zip(self.optimizer.param_groups, gaussians):
            group["params"] = [field]
        self.optimizer.state.clear()
        self.optimizer.load_state_dict(state["optimizer"])
        self.density.gaussians = gaussians
        self.density.load_state_dict(state["density"])
        self.progress.load_state_dict(state["progress"])
        self.generator.set_state(state["generator"].cpu())
        self.filter_3d = None if state["filter_3d"] is None else state["filter_3d"].to(self.device)
        self.corrections.load_state_dict(state)
        if self.counting is not None and state.get("counting") is not None:  # earlier versions did not count
            self.counting.load_state_dict(self.density, state["counting"])
        self.losses, self._last = [], None
        # Checkpoints of earlier versions have neither.
        self.extent = self.density.extent = state.get("extent", self.extent)
        self.dropped = state.get("dropped", 0)
