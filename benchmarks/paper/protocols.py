"""What each table of the paper trains on, how, and what it tests.

A *table* trains every scene of its *data* once for each of its *rows*: a footprint with the options of a training. Two
tables may test the same trainings, at other scales or on other pictures. docs/tables.md explains the choices.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

from analytic_rasterizer.captures.loading import RECONSTRUCTIONS
from analytic_rasterizer.footprints import COMPENSATED, DILATED, FOUR_SAMPLES, PAPER, RECOMMENDED

FOUR_SCALES = (1, 2, 4, 8)
# Of four pictures in ten the full size, of two each of the other scales [Mip-Splatting, Sec. 5.1].
MULTI_SCALE = {"scales": FOUR_SCALES, "scale_repeats": (2, 1, 1, 1)}
# Coarse pictures of NeRF-synthetic scenes are made as those of the multi-scale Blender set were.
AS_BLENDER = {"downsampling": "blender"}


class Row(NamedTuple):
    """A way to train: a row of a table.

    Attributes:
        name: On the command line, and of the folder.
        published: The method that the paper calls so; "" where it is ours alone.
        options: Of `TrainingOptions`.
        bicubic: Whether the full size is the photographs, reduced with a bicubic kernel, instead of the reduced
            pictures that come with the data: the starred rows of Tab. 2.
    """

    name: str
    published: str
    options: dict[str, Any]
    bicubic: bool = False


ROWS = (
    Row("3dgs", "3DGS", {"footprint": DILATED}),
    Row("3dgs-ss", "3DGS-SS", {"footprint": DILATED, "supersampling": 2}),
    Row("mip-splatting", "Mip-Splatting", {"footprint": COMPENSATED, "filter_3d": True}),
    Row("analytic", "Ours", {"footprint": PAPER}),
    Row("analytic-filter", "Ours + 3D filter", {"footprint": PAPER, "filter_3d": True}),
    Row("box", "", {"footprint": FOUR_SAMPLES}),
    Row("box-filter", "", {"footprint": FOUR_SAMPLES, "filter_3d": True}),
    Row("moment", "", {"footprint": RECOMMENDED}),
    Row("moment-filter", "", {"footprint": RECOMMENDED, "filter_3d": True}),
)
"""Ways to train, of every table but the starred rows."""
STARRED_ROWS = tuple(
    Row(f"{row.name}-bicubic", f"{row.published}*" if row.published else "", row.options, bicubic=True)
    for row in ROWS
    if row.name != "3dgs-ss"
)
"""The rows whose photographs are reduced with a bicubic kernel."""


class Data(NamedTuple):
    """A set of scenes.

    Attributes:
        scenes: Name, and how many times smaller than the photographs the pictures are that come with the data and that
            the paper calls the full size: 4 are in the folder images_4, 1 in the folder images.
        folders: Where a scene may be in the folder of the data: as the sets unpack, or beside each other.
        views: How many views of which size a scene is tested on, where it is the same for all scenes.
    """

    scenes: dict[str, int]
    folders: tuple[str, ...]
    views: str = ""

    def find(self, data: Path, scene: str) -> Path | None:
        """The folder of a `scene` in the folder `data`, or None where there is none."""
        known = ("transforms_train.json", "metadata.json", *RECONSTRUCTIONS)
        places = [data / folder / scene for folder in self.folders]
        return next((place for place in places if any((place / name).exists() for name in known)), None)


BLENDER_SCENES = ("chair", "drums", "ficus", "hotdog", "lego", "materials", "mic", "ship")
OUTDOOR = ("bicycle", "flowers", "garden", "stump", "treehill")
INDOOR = ("room", "counter", "kitchen", "bonsai")

BLENDER = Data(dict.fromkeys(BLENDER_SCENES, 1), (".", "multiscale", "nerf_synthetic"), "200 of 800x800 px")
MIPNERF360 = Data(dict.fromkeys(OUTDOOR, 4) | dict.fromkeys(INDOOR, 2), (".", "360_v2", "360_extra_scenes"))
TANKS = Data(dict.fromkeys(("truck", "train", "drjohnson", "playroom"), 1), (".", "tandt", "db"))


class Table(NamedTuple):
    """A table of the paper, or one like it.

    Attributes:
        name: On the command line, and of the files.
        title: What is measured.
        training: Name of the trainings, and of their folder; tables of the same name share them.
        data: What is trained on.
        options: Of `TrainingOptions`, for all rows.
        scales: To test at, relative to the full size.
        rows: To train.
        enlarged: How many times larger than the full size the pictures are that are tested, from another folder.
    """

    name: str
    title: str
    training: str
    data: Data
    options: dict[str, Any]
    scales: tuple[int, ...]
    rows: tuple[Row, ...] = ROWS
    enlarged: int = 1

    def training_options(self, row: Row, scene: str) -> dict[str, Any]:
        """What the `row` sets among `TrainingOptions` for this `scene`."""
        bicubic = {"scales": (self.data.scenes[scene],), "downsampling": "bicubic"} if row.bicubic else {}
        return self.options | row.options | bicubic

    def test_scales(self, row: Row, scene: str) -> tuple[int, ...]:
        """Reductions of the pictures in `test_images`, for a `row` and a `scene`."""
        return self.training_options(row, scene)["scales"] if row.bicubic else self.scales

    def images(self, row: Row, scene: str) -> str:
        """The folder in the `scene` whose pictures the `row` trains on."""
        return images_folder(1 if row.bicubic else self.data.scenes[scene])

    def test_images(self, row: Row, scene: str) -> str:
        """The folder in the `scene` whose pictures are tested, for a `row`."""
        return images_folder(self.data.scenes[scene] // self.enlarged) if self.enlarged > 1 else self.images(row, scene)


def images_folder(reduction: int) -> str:
    """How Mip-NeRF 360 calls the folder of pictures that are so many times smaller than the photographs."""
    return "images" if reduction == 1 else f"images_{reduction}"


TABLES = {
    table.name: table
    for table in (
        Table(
            "tanks-deep-blending",
            "Tanks & Temples and Deep Blending, trained and tested at one scale",
            "tanks-deep-blending",
            TANKS,
            {"scales": (1,)},
            (1,),
        ),
        Table(
            "360-stst",
            "Mip-NeRF 360, trained and tested at one scale",
            "360-single",
            MIPNERF360,
            {"scales": (1,)},
            (1,),
            ROWS + STARRED_ROWS,
        ),
        Table(
            "blender-mtmt",
            "Blender, trained and tested at four scales",
            "blender-multi",
            BLENDER,
            MULTI_SCALE | AS_BLENDER,
            FOUR_SCALES,
        ),
        Table(
            "blender-stst",
            "Blender, trained and tested at the full size",
            "blender-single",
            BLENDER,
            {"scales": (1,)} | AS_BLENDER,
            (1,),
        ),
        Table(
            "blender-stmt",
            "Blender, trained at the full size, tested at four scales",
            "blender-single",
            BLENDER,
            {"scales": (1,)} | AS_BLENDER,
            FOUR_SCALES,
        ),
        Table(
            "360-mtmt",
            "Mip-NeRF 360, trained and tested at four scales",
            "360-multi",
            MIPNERF360,
            MULTI_SCALE | {"downsampling": "bicubic"},
            FOUR_SCALES,
        ),
        Table(
            "360-super-resolution",
            "Mip-NeRF 360, trained at four scales, tested at twice the full size",
            "360-multi",
            MIPNERF360,
            MULTI_SCALE | {"downsampling": "bicubic"},
            (1,),
            enlarged=2,
        ),
    )
}
"""The tables, by name."""
