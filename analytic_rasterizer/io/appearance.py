"""How a scene wants to be seen: its footprint, views, size and background, from its file and from what lies around it.

Every command asks here. A scene comes from a training of this package, whose folder holds options.json and
cameras.json; from the program of 3DGS, whose model folder holds cfg_args and cameras.json; or alone.
"""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..cameras.camera import View
from ..filters import PIXEL_VARIANCE
from ..footprints import (
    COMPENSATED,
    DILATED,
    ENVIRONMENT_VARIABLE,
    PAPER,
    Footprint,
    chosen_footprint,
    resolve_footprint,
)
from ..render.order import CENTER, can_be_in, check_order, key_of
from . import ply
from .errors import SceneError
from .images import BLACK, WHITE
from .metadata import SceneMetadata, read_metadata
from .models import CFG_ARGS, CfgArgs, latest_ply, model_root, read_cfg_args
from .scenes import FILTER_3D
from .trained import CAMERAS, OPTIONS, SCENE, TrainingRecord, read_record
from .views import load_views

UNMARKED = resolve_footprint(DILATED)  # what a file wants that says nothing: 3DGS trains with it
ANTIALIASED = resolve_footprint(COMPENSATED)  # and one that says only that pixels are to be integrated


@dataclass(frozen=True)
class Choice:
    """A footprint, and why it was chosen.

    Attributes:
        footprint: With its options.
        reason: A clause, such as "scene.ply says so".
    """

    footprint: Footprint
    reason: str


@dataclass(frozen=True)
class OrderChoice:
    """An `Effects.order`, and why it was chosen, as in `Choice`; "" where that needs no word."""

    order: str
    reason: str


@dataclass(frozen=True)
class FoundScene:
    """A scene, and what its file and its folders say.

    Attributes:
        path: The file of the Gaussians.
        metadata: What this file says.
        training: What a training of this package says beside it; None where there is none.
        cfg_args: What cfg_args of 3DGS says, beside it or in the folder of the model; None where there is none.
        model: That folder.
        cameras: cameras.json, beside it or in the folder of the model; None where there is none.
        has_filter_3d: Whether the file is a .ply with the column filter_3D, which Mip-Splatting and its kin write.
    """

    path: Path
    metadata: SceneMetadata
    training: TrainingRecord | None = None
    cfg_args: CfgArgs | None = None
    model: Path | None = None
    cameras: Path | None = None
    has_filter_3d: bool = False

    @property
    def options(self) -> dict[str, Any] | None:
        """All that options.json of that training holds."""
        return None if self.training is None else self.training.content

    @property
    def is_trained_here(self) -> bool:
        """Whether the training of options.json wrote this file: by its name, and by what it says of its footprint.

        Another scene may have been copied over it, whose training had nothing to do with these options.
        """
        if self.training is None or self.path.name != SCENE:
            return False
        trained = self.training.footprint
        if self.metadata.footprint is not None:
            return resolve_footprint(self.metadata.footprint) == trained
        # Trainings before files named their footprint; these marked whether pixels are integrated.
        return self.training.is_early and bool(self.metadata.antialiased) == (trained.name != UNMARKED.name)

    @property
    def trained_with(self) -> Choice | None:
        """The footprint that the scene was trained with, or baked for, and who says so. None where nothing does."""
        if self.metadata.footprint is not None:
            return Choice(resolve_footprint(self.metadata.footprint), f"{self.path.name} says so")
        if self.is_trained_here:
            return Choice(self.training.footprint, f"{OPTIONS} beside {self.path.name} says so")
        if self.cfg_args is not None and self.cfg_args.kernel_size is not None:
            size = self.cfg_args.kernel_size
            reason = f"{CFG_ARGS} says kernel_size {size:g}, the variance of Mip-Splatting's filter"
            return Choice(resolve_footprint(COMPENSATED, variance=size), reason)
        if self.has_filter_3d:
            reason = (
                f"{self.path.name} has the column {FILTER_3D} of Mip-Splatting; Analytic-Splatting writes it too, "
                f"then give --footprint {PAPER}"
            )
            return Choice(ANTIALIASED, reason)
        if self.metadata.antialiased:
            reason = f"{self.path.name} says that it was trained with an antialiasing filter, and not which"
            return Choice(ANTIALIASED, reason)
        return None

    @property
    def is_dilated(self) -> bool:
        """Whether the scene was trained with the dilation of `point`, as far as known: `bake` is for such scenes."""
        trained = self.trained_with
        return trained is None or is_dilated(trained.footprint)

    @property
    def background(self) -> tuple[tuple[float, float, float], str] | None:
        """The colour behind the scene, in its training, and who says so; None where nothing does."""
        if self.metadata.background is not None:
            return self.metadata.background, self.path.name
        if self.training is not None and self.training.background is not None:
            return self.training.background, OPTIONS
        if self.cfg_args is not None and self.cfg_args.white_background is not None:
            return (WHITE if self.cfg_args.white_background else BLACK), CFG_ARGS
        return None

    def trained_view(self, view: View) -> View:
        """A view of `cameras` with pixels as large as in the training's finest pictures."""
        if self.training is not None:
            return view.scaled(1 / self.training.finest)
        return view if self.cfg_args is None else self.cfg_args.trained_view(view)

    @property
    def size_reason(self) -> str:
        """What says that the training's pictures were smaller than `cameras` states; "" where nothing does."""
        if self.training is not None:
            return f"{OPTIONS}: scales from {self.training.finest}" if self.training.finest > 1 else ""
        said = "" if self.cfg_args is None else self.cfg_args.size_in_words
        return said and f"{CFG_ARGS}: {said}"

    def load_views(self, path=None, size: tuple[int, int] | None = None, trained_size: bool = True) -> list[View]:
        """The views of a file, by default of `cameras`, in the frame of the scene. Those of `cameras` have the size of
        the training's pictures.

        Args:
            path: Another file of views.
            size: As in `load_views`.
            trained_size: False leaves the views as the file has them.

        Raises:
            SceneError: There is no file of views, or it is not one.
        """
        if path is None and self.cameras is None:
            where = self.path.parent if self.model is None else self.model
            lacking = f"{self.path}: no views: there is no {CAMERAS} in {where}"
            raise SceneError(lacking, "give a file of views (--views)")
        views = load_views(self.cameras if path is None else path, size)
        if self.path.suffix.lower() != ".splat":  # which holds no offset, and is beside views of its own frame
            views = [view.in_frame(self.metadata.offset) for view in views]
        own = path is None or self.is_cameras(path)
        return [self.trained_view(view) for view in views] if own and trained_size else views

    def is_cameras(self, path) -> bool:
        """Whether the file of views `path` is `cameras`."""
        return self.cameras is not None and Path(path).samefile(self.cameras)

    def training_footprint(self, given: str | Footprint | None = None) -> Choice:
        """What the scene was trained with: `given`, else what is said, else `point`, with which 3DGS trains.

        Raises ValueError where `given` is no footprint.
        """
        if given is not None:
            return Choice(resolve_footprint(given), "as given")
        return self.trained_with or Choice(UNMARKED, f"{self.path.name} names none, and 3DGS trains with it")

    def choose_footprint(self, given: str | Footprint | None = None) -> Choice:
        """How to show the scene: `given`, else the choice of the process (the environment variable), else
        `training_footprint`. The reason says where the scene should be baked.

        Raises:
            ValueError: `given` or the environment variable holds no footprint.
        """
        choice, chosen = self.training_footprint(given), chosen_footprint()
        if given is None and chosen is not None:
            choice = Choice(chosen, f"{ENVIRONMENT_VARIABLE} says so")
        return Choice(choice.footprint, choice.reason + self._bake_hint(choice.footprint))

    def choose_order(self, footprint: Footprint, given: str | None = None) -> OrderChoice:
        """In which order to show the scene with a footprint: `given`, else that of its training where the footprint can
        have it, else "center".

        Raises ValueError where `given` is no order, or none of this footprint.
        """
        if given is not None:
            check_order(given)
            key_of(footprint, given)
            return OrderChoice(given, "" if given == CENTER else "as given")
        own = self.metadata.order
        if own in (None, CENTER):
            return OrderChoice(CENTER, "")
        if not can_be_in(footprint, own):
            return OrderChoice(CENTER, f"{self.path.name} says {own}, which {footprint} cannot have")
        return OrderChoice(own, f"{self.path.name} says so")

    def _bake_hint(self, footprint: Footprint) -> str:
        """What to do about a scene that was trained with `point`; "" for others."""
        command = f"bake {shlex.quote(str(self.path))} --out FILE"
        if not self.is_dilated:
            return ""
        if is_dilated(footprint):
            return f"; right at the size of the training, for others: {command}"
        known = "" if self.trained_with else f"{self.path.name} names no footprint: if 3DGS trained it, "
        return f"; {known}its Gaussians are too thin for {footprint.name}, so first: {command}"


def is_dilated(footprint: Footprint) -> bool:
    """Whether a footprint adds a dilation that can be baked: one as wide as a pixel, or more."""
    return footprint.name == UNMARKED.name and footprint.option >= PIXEL_VARIANCE


def find_scene(path) -> FoundScene:
    """Finds a scene, and what is said about it.

    Args:
        path: A file of Gaussians; the folder of a training of this package; or the folder of a model of 3DGS, of which
            the last iteration is taken.

    Raises:
        SceneError: There is no scene.
    """
    given = Path(path)
    path = _file_in(given) if given.is_dir() else given
    if not path.exists():
        raise SceneError(f"{path}: no such file or folder")
    metadata, root = read_metadata(path), model_root(path)
    folders = [path.parent, *([] if root is None else [root])]
    cameras, cfg_args = (
        next((folder / name for folder in folders if (folder / name).is_file()), None) for name in (CAMERAS, CFG_ARGS)
    )
    return FoundScene(
        path,
        metadata,
        training=read_record(path.parent / OPTIONS),
        cfg_args=None if cfg_args is None else read_cfg_args(cfg_args),
        model=root,
        cameras=cameras,
        has_filter_3d=_has_filter_3d(path),
    )


def _has_filter_3d(path: Path) -> bool:
    """Whether a file that is there is a .ply with this column."""
    vertex = ply.read_header(path).element("vertex") if path.suffix.lower() == ".ply" else None
    return vertex is not None and FILTER_3D in vertex.names


def holds_scene(folder: Path) -> bool:
    """Whether `find_scene` finds something in a folder."""
    return (folder / SCENE).is_file() or latest_ply(folder) is not None


def _file_in(folder: Path) -> Path:
    """The scene that a folder stands for."""
    own, model = folder / SCENE, latest_ply(folder)
    if own.is_file() and model is not None:
        raise SceneError(f"{folder}: holds {SCENE} and {model.relative_to(folder)}; name one of them")
    if own.is_file():
        return own
    if model is not None:
        return model
    raise SceneError(
        f"{folder}: a folder without a scene: expected {SCENE} with {OPTIONS}, which `train` writes, or "
        "point_cloud/iteration_N/point_cloud.ply of 3DGS"
    )
