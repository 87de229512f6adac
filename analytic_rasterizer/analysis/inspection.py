"""What the planner reports about a scene and its views, as text, JSON and a picture."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import torch

from ..footprints import ADVICE_IN_WORDS
from ..io import write_safely
from ..render.effects import Effects
from . import tables

NARROW = 0.5  # px
BINS = tuple(2.0 ** (i / 4) for i in range(-40, 41))  # edges of the histogram of standard deviations, px
DRAWN = 8  # views in the histogram


@dataclass(frozen=True)
class EffectFinding:
    """What was found about one effect."""

    name: str
    needed: bool | None  # whether these views call for it; None: not examined
    change: float | None  # what leaving it out changes at most, in units of colour; None: nothing to leave out
    kind: str | None  # of the change: "bound" on every pixel, or "measured", the largest RMS over a view
    cost: float | None  # time of a forward pass with it over that without it; None: not measured
    recommendation: str
    reason: str  # a sentence


@dataclass(frozen=True)
class Candidate:
    """A footprint that was tried with the recommended effects."""

    footprint: str  # its name with options
    rms: float  # largest RMS over a view, in units of colour; not rendered any further after a view in which it fails
    fits: bool  # whether that is within the tolerance
    cost: float | None  # time of a forward pass over that of one sample; None: not measured, since it does not fit


@dataclass(frozen=True, eq=False)
class ViewReport:
    """What one view shows."""

    name: str
    width: int  # px
    height: int
    shown: int  # Gaussians that touch a tile
    narrow: float  # share of them whose smaller standard deviation in the image is below NARROW
    sigmas: tuple[int, ...]  # how many of them lie between BINS, by that deviation; the outer bins hold the rest
    finer: float | None  # share of those seen in training that are sampled FINER times as finely; None: no training
    finest: float | None  # largest ratio of sampling intervals, training over this view; None: as above, or no such
    rms: float  # of the recommendation against everything switched on, in units of colour


@dataclass(frozen=True, eq=False)
class SceneReport:
    """What `inspect_scene` found: the cheapest effects and footprint, and what the choice is based on.

    Attributes:
        gaussians: How many the scene has.
        sh_degree: Degree of its spherical harmonics.
        tolerance: RMS in units of colour, as given to `inspect_scene`.
        machine: On which times were measured.
        effects: The cheapest `Effects` within the tolerance.
        footprint: The cheapest footprint within the tolerance, as `GaussianRasterizationSettings` takes it.
        findings: What was found about every effect.
        candidates: The footprints that were tried: name, RMS, whether that fits, and time over that of one sample.
        views: What every view shows.
        shown: (P,) bool, on the scene's device: touches a tile of some view. The others change no pixel.
    """

    gaussians: int
    sh_degree: int
    tolerance: float
    machine: str
    effects: Effects
    footprint: str
    findings: tuple[EffectFinding, ...]
    candidates: tuple[Candidate, ...]
    views: tuple[ViewReport, ...]
    shown: torch.Tensor

    def to_json(self) -> dict:
        """Everything as numbers, strings, lists and dicts; for the mask `shown` its count."""
        data = asdict(self)
        effects = data.pop("effects")
        data["recommendation"] = {"footprint": data.pop("footprint"), "filter_3d": effects["filter_3d"] is not None}
        data["recommendation"] |= {name: effects[name] for name in ("sh_degree", "orthographic", "off_center")}
        return data | {"shown": int(self.shown.sum()), "sigma_edges": list(BINS)}

    def to_text(self) -> str:
        """Tables and sentences. Changes and RMS in units of 1/255."""
        shown = {None: None, True: "yes", False: "no"}
        effects = [
            [f.name, shown[f.needed], in_255(f.change), f.kind, _ratio(f.cost), f.recommendation] for f in self.findings
        ]
        tried = [[c.footprint, in_255(c.rms), shown[c.fits], _ratio(c.cost)] for c in self.candidates]
        header = ["view", "size", "shown", "< 1/2 px", "RMS [1/255]", "finer than trained", "at most"]
        views = [
            [v.name, f"{v.width}x{v.height}", v.shown]
            + [percent(v.narrow), in_255(v.rms), percent(v.finer), _ratio(v.finest)]
            for v in self.views
        ]
        options = [f"sh_degree={self.effects.sh_degree}"] if self.effects.sh_degree is not None else []
        options += [f"{name}=True" for name in ("orthographic", "off_center") if getattr(self.effects, name)]
        options += ["filter_3d=..."] if self.effects.filter_3d is not None else []
        return "\n\n".join([
            f"{self.gaussians} Gaussians of SH degree {self.sh_degree}; {self.machine}\n"
            f"tolerance: RMS of {in_255(self.tolerance)}/255 in every view",
            f"cheapest within the tolerance: footprint {self.footprint}, Effects({', '.join(options)})\n"
            f"in general, for {ADVICE_IN_WORDS}",
            tables.format_table(["effect", "needed", "change [1/255]", "", "cost", "recommendation"], effects),
            "\n".join(f"{f.name}: {f.reason}" for f in self.findings),
            tables.format_table(["footprint", "RMS [1/255]", "fits", "cost"], tried),
            tables.format_table(header, views),
        ])  # fmt: skip

    def save_picture(self, path) -> None:
        """Writes a histogram of standard deviations in the image to `path`.

        Raises:
            ImportError: There is no matplotlib.
            OSError: The file cannot be written.
            ValueError: matplotlib does not know the suffix.
        """
        figure, axes = tables.new_figure(7, 3.8)
        ax, occupied = axes[0, 0], [BINS.index(NARROW)]
        for view in self.views[:DRAWN]:
            ax.stairs([100 * count / max(1, view.shown) for count in view.sigmas], BINS, label=view.name, linewidth=1.4)
            occupied += [i for i, count in enumerate(view.sigmas) if count > 1e-3 * view.shown]
        ax.axvline(NARROW, color="black", linewidth=0.9, linestyle=":")
        ax.set_xscale("log", base=2)
        ax.set_xlim(BINS[min(occupied)], BINS[max(occupied) + 1])
        ax.xaxis.set_major_formatter(lambda value, _: f"{value:g}" if value >= 1 else f"1/{1 / value:g}")
        ax.set(xlabel="smaller standard deviation in the image [px]", ylabel="Gaussians shown [%]")
        ax.legend(frameon=False, fontsize=8)
        write_safely(path, lambda temporary: figure.savefig(temporary, dpi=140))


def _ratio(value: float | None) -> str | None:
    return None if value is None else f"{value:.2f}"


def in_255(value: float | None) -> str | None:
    return None if value is None else f"{255 * value:.3g}"


def percent(value: float | None) -> str | None:
    return None if value is None else f"{100 * value:.1f}%"


def share(which: torch.Tensor) -> float:
    """Share of a bool tensor that is True; 0 of an empty one."""
    return which.sum().item() / max(1, which.numel())
