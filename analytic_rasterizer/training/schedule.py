"""What happens when: the share of a training that is over, the order of the pictures, and the learning rates."""

from __future__ import annotations

import math
import time

import torch

from ..density.control import passes
from .options import TrainingOptions
from .parts import steps_at

SH_SHARE = 0.1  # of the training, after which another degree is due at the latest
PASSES = 8  # that are known at a time: who fetches pictures looks ahead


class Progress:
    """The share of the training that is over, by steps or else by seconds.

    By seconds, the share grows in steps at the last measured pace; `measure` corrects it. A step of the optimizer on
    several ranks stands for several steps here, its `stride`: one for each rank's pictures.
    """

    def __init__(self, steps: int | None, seconds: float | None):
        self.steps, self.seconds = steps, seconds
        self.step, self.share, self.stride = 0, 0.0, 1
        self.measured = (0, 0.0)  # step and share where the clock was last read
        self.pace = 0.0  # share per step, by the clock

    def advance(self, stride: int = 1) -> None:
        self.step += stride
        self.stride = stride
        self.share = self.step / self.steps if self.steps else self.share + stride * self.pace

    def passed(self, period: int) -> bool:
        """Whether there was a multiple of `period` among the steps of the last advance."""
        return passes(self.step, period, self.stride)

    def expected(self, usual: int) -> float:
        """Steps of the whole training, by the clock those at the mean pace so far; `usual` before there is one."""
        return self.steps or (self.step / self.share if self.share else usual)

    def measure(self, elapsed: float) -> None:
        """Corrects the share by the seconds of training so far."""
        if self.seconds and self.step > self.measured[0]:
            step, share = self.measured
            self.share = elapsed / self.seconds
            self.pace = (self.share - share) / (self.step - step)
            self.measured = (self.step, self.share)

    def rescale(self, factor: float) -> None:
        """To be called where the whole training has become 1 / `factor` as long."""
        self.share = self.step / self.steps if self.steps else self.share * factor
        self.measured, self.pace = (self.measured[0], self.measured[1] * factor), self.pace * factor

    def state_dict(self) -> dict:
        return {"step": self.step, "share": self.share, "measured": self.measured, "pace": self.pace}

    def load_state_dict(self, state: dict) -> None:
        self.step, self.share, self.pace = state["step"], state["share"], state["pace"]
        self.measured = tuple(state["measured"])


class Clock:
    """Wall time of training in seconds, work on the device included. Runs from `start`."""

    def __init__(self, device: torch.device, total: float = 0.0):
        self.device, self.total, self.since = device, total, None

    def start(self) -> None:
        self.since = self._now()

    def stop(self) -> None:
        self.total, self.since = self.read(), None

    def read(self) -> float:
        """Seconds so far. Waits for the device."""
        return self.total + (0.0 if self.since is None else self._now() - self.since)

    def _now(self) -> float:
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)
        return time.perf_counter()


class PictureOrder:
    """View and scale of the n-th picture of a training: all pairs in random order, again and again.

    A pass is drawn from the seed and its number, so that a training can go on from any place.
    """

    def __init__(self, views: int, options: TrainingOptions):
        self.seed = options.seed
        repeats = zip(options.scales, options.scale_repeats)
        self.pairs = [(view, scale) for scale, times in repeats for _ in range(times) for view in range(views)]
        self.drawn: dict[int, list[int]] = {}  # by number of the pass, its order; those that were asked for last

    def __call__(self, n: int) -> tuple[int, int]:
        number, place = divmod(n, len(self.pairs))
        if number not in self.drawn:
            if len(self.drawn) == PASSES:
                del self.drawn[min(self.drawn)]
            generator = torch.Generator().manual_seed((self.seed << 24) + number)
            self.drawn[number] = torch.randperm(len(self.pairs), generator=generator, device="cpu").tolist()
        return self.pairs[self.drawn[number][place]]


def footprint_at(step: int, share: float, options: TrainingOptions) -> str:
    """The footprint in use after so many steps."""
    time = options.footprint_from
    over = step >= time if time > 1 else share >= time
    return options.footprint if over or options.begins_with is None else options.begins_with


def sh_degree_at(step: int, share: float, options: TrainingOptions) -> int:
    """Degree of the harmonics in use after so many steps."""
    return min(options.sh_degree, max(step // options.sh_every, int(share / SH_SHARE)))


def means_rate_at(step: int, share: float, options: TrainingOptions) -> float:
    """Learning rate of the means, per unit of the scene's extent."""
    over = min(step / options.means_rate_steps, 1) if options.means_rate_steps else share
    return options.means_rate * (options.means_rate_end / options.means_rate) ** over


def depth_weight_at(share: float, options: TrainingOptions) -> float:
    """Weight of differences of depths in the loss."""
    first, last = options.depth_weight, options.depth_weight_end
    if options.depth == "none" or first == last == 0:
        return 0.0
    return first * (last / first) ** share if first and last else first + (last - first) * share


def rates_factor_at(step: int, options: TrainingOptions, steps: float | None = None) -> float:
    """Factor of the learning rates other than that of the means; `steps` in all, None: as the options say."""
    over = max(step - steps_at(options.rates_from, steps or options.iterations), 0)
    return 0.5 ** (over / options.rates_half_life) if options.rates_half_life else 1.0


def changes_at(options: TrainingOptions, steps: int) -> range:
    """The steps at which density control changes the number of Gaussians, in a training of so many in one process."""
    times = options.growth.times(steps)
    period = times["densify_every"]
    first = (times["densify_from"] // period + 1) * period
    return range(first, math.ceil(times["densify_until"] * steps), period)


def describe_change(before: TrainingOptions, after: TrainingOptions, step: int, share: float) -> str:
    """What it means that a training goes on to another length.

    Args:
        step, share: What is over of the training, of the new length.
    """
    if after.seconds:
        lengths, longer = f"{after.seconds:g} s in all instead of {before.seconds:g}", after.seconds / before.seconds
    else:
        lengths = f"{after.iterations:,} steps in all instead of {before.iterations:,}"
        longer = after.iterations / before.iterations
    rates = [means_rate_at(step, over, options) for over, options in ((share, after), (share * longer, before))]
    text = f"goes on after step {step:,} to {lengths}: the learning rate of the means is {rates[0]:.2g} extents of the "
    text += f"scene, and was {rates[1]:.2g}"
    if footprint_at(step, share, after) != after.footprint:
        time = after.footprint_from
        text += f"; pictures have {after.begins_with} until {f'{time:.0%}' if time <= 1 else f'step {time:,.0f}'}"
    if after.density == "none":
        return text
    if after.seconds:
        return f"{text}; the number of Gaussians changes for {after.densify_until:g} of it"
    ends = [round(min(steps_at(o.densify_until, o.iterations), o.iterations)) for o in (after, before)]
    return f"{text}; the number of Gaussians changes until step {ends[0]:,}, where that was {ends[1]:,}"
