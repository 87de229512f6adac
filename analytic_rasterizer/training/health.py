"""What a training must not become in silence: without Gaussians, without anything to see, or without numbers."""

from __future__ import annotations

import warnings
from statistics import mean
from typing import Protocol

import torch
from torch import Tensor

from ..captures.pictures import Pictures
from ..captures.store import described
from ..density import FixedDensity
from ..distributed.ranks import Ranks
from ..gaussians import Gaussians
from ..io.errors import SceneError
from ..io.scenes import numbers_of
from .options import TrainingOptions, flag
from .rendering import render
from .schedule import Progress

NAMED = 3  # photographs in a sentence
FAINTEST = 1 / 255  # the rasterizer draws nothing of a lower opacity
MOST_BROKEN = 0.5  # of the Gaussians: a training that loses more at once diverges
LEAST_SIDE = 11  # px, that of the window of SSIM
SUDDEN_LOSS = 0.9  # of the Gaussians at once: a training that goes on, with a warning

OPTION_OF = {
    "means": "means_rate",
    "log_scales": "scale_rate",
    "rotations": "rotation_rate",
    "logit_opacities": "opacity_rate",
    "shs": "color_rate",
}


class Trainer(Protocol):
    """What checks during a training look at of a `training.Trainer`."""

    options: TrainingOptions
    pictures: Pictures
    ranks: Ranks
    density: FixedDensity
    progress: Progress
    gaussians: Gaussians
    count: int
    extent: float
    last: tuple[Tensor, Tensor, Tensor | None] | None
    dropped: int
    warnings: list[str]

    def keep(self, kept: Tensor) -> None: ...

    def take_losses(self) -> list[float]: ...

    def scene(self) -> Gaussians: ...


def finite_rows(gaussians: Gaussians) -> Tensor:
    """Which Gaussians a scene file can hold: all numbers are finite, the scales themselves too. (N,) bool."""
    return torch.stack([field.flatten(1).isfinite().all(1) for field in numbers_of(gaussians).values()]).all(0)


@torch.no_grad()
def drop_broken(trainer: Trainer) -> int:
    """Takes away the Gaussians of which a number has left float32, and returns how many of all ranks. Collective.

    Waits for the device.

    Raises:
        FloatingPointError: They are more than half; names the parameters and their learning rates.
    """
    gaussians = trainer.gaussians
    kept = finite_rows(gaussians)
    count = len(kept)
    lost = count - int(kept.sum())
    fields = [] if lost == 0 else _broken_fields(gaussians)
    of_ranks = trainer.ranks.exchange((lost, count, fields))
    lost_of_all = sum(lost for lost, _, _ in of_ranks)
    count_of_all = sum(count for _, count, _ in of_ranks)
    if lost_of_all == 0:
        return 0
    names = sorted({name for _, _, fields in of_ranks for name in fields}, key=list(OPTION_OF).index)
    text = (
        f"{lost_of_all:,} of {count_of_all:,} Gaussians have {' and '.join(names)} outside of float32 "
        f"by step {trainer.progress.step:,}"
    )
    options = " or ".join(flag(OPTION_OF[name]) for name in names)
    if lost_of_all > MOST_BROKEN * count_of_all:
        trainer.take_losses()  # which raises where they say earlier that the training diverges
        raise FloatingPointError(f"{text}: the training diverges; a lower {options} may help")
    if trainer.dropped == 0:
        trainer.warnings.append(f"{text}, and are taken away; a lower {options} may help")
    trainer.dropped += lost_of_all
    trainer.keep(kept)
    return lost_of_all


def _broken_fields(gaussians: Gaussians) -> list[str]:
    """The parameters that have left float32."""
    fields = zip(Gaussians._fields, numbers_of(gaussians).values())
    return [name for name, field in fields if not field.isfinite().all()]


@torch.no_grad()
def check_visible(trainer: Trainer) -> None:
    """Raises RuntimeError if no picture shows a Gaussian, so that nothing can be learned any more. Collective.

    Waits for the device.
    """
    step, count = trainer.progress.step, trainer.count
    clearest = trainer.gaussians.logit_opacities.sigmoid().amax().item() if len(trainer.gaussians.means) else 0.0
    if max(trainer.ranks.exchange(clearest)) < FAINTEST:
        options = ["opacity_rate"] + (["opacity_weight"] if trainer.options.regularizers[0] else [])
        raise RuntimeError(
            f"all {count:,} Gaussians are transparent after step {step:,} (opacities below 1/255), so that nothing can "
            f"be learned any more; a lower {' or '.join(map(flag, options))} may help{_about_pictures(trainer)}"
        )
    last = trainer.last if trainer.ranks.world == 1 else None
    if last is not None and not _any_shown(trainer, last[0]):
        raise RuntimeError(
            f"no picture shows any of the {count:,} Gaussians after step {step:,}, so that nothing can be learned any "
            f"more; a lower {flag('means_rate')} or {flag('scale_rate')} may help"
        )


def _any_shown(trainer: Trainer, image: Tensor) -> bool:
    """Whether the last picture, `image`, is more than background, or another picture would show a Gaussian."""
    if bool((image != image[:, :1, :1]).any()):
        return True
    arguments = trainer.scene().arguments()
    options = trainer.options
    of_scales = trainer.pictures.resolve(options.order, footprint=options.footprint, sh_degree=0)
    arguments["shs"] = arguments["shs"][:, :1]
    return any(bool((render(arguments, of_view)[1] > 0).any()) for of_view in of_scales[min(options.scales)])


def check_left(trainer: Trainer, before: int) -> None:
    """Looks at what density control has left of `before` Gaussians: a warning if it is next to nothing. Collective.

    Raises:
        RuntimeError: Nothing is left; says why, and names the options that decide it.
    """
    after, step = trainer.count, trainer.progress.step
    if after > (1 - SUDDEN_LOSS) * before:
        return
    causes = _causes(trainer)
    if after == 0:
        raise RuntimeError(f"no Gaussians are left after step {step:,}: {causes}")
    trainer.warnings.append(f"step {step:,} has left {after:,} of {before:,} Gaussians: {causes}")


def _causes(trainer: Trainer) -> str:
    """What was pruned, and the options that decide it. Collective; waits for the device."""
    options, extent = trainer.options, trainer.extent
    of_ranks = trainer.ranks.exchange({cause: int(count) for cause, count in trainer.density.pruned.items()})
    opacity, size = (sum(of_rank.get(cause, 0) for of_rank in of_ranks) for cause in ("opacity", "size"))
    return (
        f"{opacity:,} were pruned for opacities below {options.prune_opacity:g} ({flag('prune_opacity')}, "
        f"{flag('reset_every')}, {flag('opacity_rate')}), {size:,} for scales above "
        f"{options.prune_above * extent:.3g}, {options.prune_above:g} extents of the capture ({flag('prune_above')})"
        f"{_about_pictures(trainer)}"
    )


def look_at_pictures(scene, pictures: Pictures, device: torch.device) -> list[str]:
    """What there is to say of the pictures of a training for a device: where they are, whether they are small, and what
    masks leave out.

    Warns of pictures of one colour. Raises as `check_masks`.
    """
    waiting = [described(pictures.store.plan, device)] if pictures.store.plan.ahead else []
    masks = check_masks(scene, pictures)
    warn_of_one_color(scene, pictures)
    return [*waiting, *small_pictures(pictures), *masks]


def check_masks(scene, pictures: Pictures) -> list[str]:
    """What there is to say of how much masks leave out, in at most one sentence.

    Args:
        scene: Where the pictures are from.

    Raises io.SceneError where nothing counts in any picture.
    """
    shares = pictures.shares
    if not shares or min(shares) == 1:
        return []
    empty = [view.name for view, share in zip(pictures.views, shares) if share == 0]
    if len(empty) == len(shares):
        got = f"none in all {len(shares)} photographs, whose masks are black or transparent everywhere"
        raise SceneError.of(scene, "pixels that count", got, "--masks none ignores masks")
    left_out = f"masks leave out {1 - mean(shares):.1%} of the pixels"
    named = f"{', '.join(empty[:NAMED])}{', ..' * (len(empty) > NAMED)}"
    return [f"{left_out}; nothing counts in {len(empty)} photographs: {named}" if empty else left_out]


def warn_of_one_color(scene, pictures: Pictures) -> None:
    """Warns if each of the finest pictures has one colour.

    Args:
        scene: Where they are from.
    """
    finest = pictures.colors[min(pictures.colors)]
    if all(torch.equal(picture, picture[:, :1, :1].expand_as(picture)) for picture in finest):
        told = f"{scene}: all {len(finest)} photographs are of one colour, nothing can be learned"
        warnings.warn(told, stacklevel=6)  # where the training is made


def small_pictures(pictures: Pictures) -> list[str]:
    """A sentence about scales at which pictures are too small to learn from; none where they are not."""
    smallest = {
        scale: min(((s.image_width, s.image_height) for s in settings), key=min)
        for scale, settings in pictures.settings.items()
    }
    small = {scale: size for scale, size in smallest.items() if min(size) < LEAST_SIDE}
    if not small:
        return []
    sizes = ", ".join(f"{width}x{height} px at 1/{scale}" for scale, (width, height) in small.items())
    told = f"pictures are small ({sizes}), and below {LEAST_SIDE} px there is little to learn"
    return [f"warning: {told}; {flag('scales')} takes smaller numbers"]


def _about_pictures(trainer: Trainer) -> str:
    """What is wrong with the pictures, if nothing is in any of them."""
    pictures = trainer.pictures
    truths = (pictures.truth(min(pictures.colors), view) for view in range(len(pictures.views)))
    empty = all(bool((truth == truth[:, :1, :1]).all()) for truth in truths)
    return "; there is nothing in the pictures, each of which has one colour" if empty else ""
