"""Captures as they are found in the field: each is read, or a sentence says why not."""

import math
import re
import shutil
import warnings

import pytest
import torch
import train_extra  # noqa: F401
from capture_files import circle, write_colmap, write_colmap_text
from field_captures import (
    EXACT,
    SIZE,
    as_text,
    beside,
    far,
    frames,
    lines_of_pictures,
    masked,
    models,
    moved,
    named,
    of_two_sizes,
    only_transforms,
    smaller,
    spoilt,
    with_exif,
    with_unused,
    without,
    write,
)

from analytic_rasterizer import io, training
from analytic_rasterizer.captures import colmap

IN_VIEW = {"starts_in_view": True, "points": None}
FUTURE = b"77 HYPERBOLIC 9 9 1 2 3 4 5 6 7\n"
WINDOWS = {"frames": frames("images\\{}.png"), "test_filenames": [".\\images\\r_4.png"]}
PLACE = (500000.0, 4200000.0, 120.0)

# What a capture is like, and how it is written. Nothing is said of these.
PLAIN = {
    "pinholes": write,
    "one focal length": lambda f: write(f, "SIMPLE_PINHOLE"),
    "opencv without distortion": lambda f: write(f, "OPENCV"),
    "a distorted camera that no picture uses": lambda f: with_unused(f, "OPENCV"),
    "a model that is refused, which no picture uses": lambda f: with_unused(f, "EUCM"),
    "a model of the future that no picture uses": lambda f: as_text(f, lambda text: text + FUTURE, "cameras"),
    "byte order marks": lambda f: as_text(f, lambda text: b"\xef\xbb\xbf" + text.split(b"\n", 1)[1]),
    "line ends of Windows": lambda f: as_text(f, lambda text: text.replace(b"\n", b"\r\n")),
    "a text without lines of observations": lambda f: as_text(f, lines_of_pictures, "images"),
    "spaces in names": lambda f: named(f, "IMG {0} 2 3.png", writer=write_colmap_text),
    "names in other scripts": lambda f: named(f, "猫 é {0}.png"),
    "another spelling of a letter": lambda f: named(f, "\u00e9{0}.png", "e\u0301{0}.png"),
    "names that are no UTF-8": lambda f: named(f, "\udce9{0}.png"),
    "upper-case suffixes": lambda f: named(f, "DSC{0}.JPG"),
    "suffixes in another case": lambda f: named(f, "DSC{0}.JPG", "dsc{0}.jpg"),
    "other suffixes": lambda f: named(f, "{0}.jpg", "{0}.png"),
    "pictures in folders": lambda f: named(f, "cam{1}/{2}.png"),
    "folders with backslashes": lambda f: named(f, "cam{1}\\{2}.png", "cam{1}/{2}.png"),
    "a capture just large enough": lambda f: smaller(f, 0.1),
    "other files beside a model": lambda f: [write(f), spoilt(f, "rigs.bin", "frames.bin", "project.ini")],
    "a transforms.json of Windows": lambda f: only_transforms(f, **WINDOWS),
    "a transforms.json of another machine": lambda f: only_transforms(f, frames=frames("D:\\scans\\images\\{}.png")),
}
# The cameras of these are rendered with the lens that they have.
LENSES = {
    "simple radial": lambda f: write(f, "SIMPLE_RADIAL", [-0.1]),
    "radial": lambda f: write(f, "RADIAL", [0.1, -0.05]),
    "opencv": lambda f: write(f, "OPENCV", [0.05, -0.02, 1e-3, -1e-3]),
    "full opencv": lambda f: write(f, "FULL_OPENCV", [0.1, 0, 1e-3, 0, 0.1, 0.2, 0, 0], write_colmap_text),
    "a camera per picture, of two sizes": of_two_sizes,
    "wild distortion": lambda f: write(f, "OPENCV", [0.3, -59, 0, 0]),
    "a transforms.json of a lens": lambda f: only_transforms(f, camera_model="OPENCV", k1=0.1, k2=-0.02, p1=1e-3),
    "a transforms.json of another program": lambda f: only_transforms(f, k1=0.1, k2=0.01),
}
# Something else is noted of these.
NOTED = {
    "a fisheye": (lambda f: write(f, "OPENCV_FISHEYE", [0.01, 0, 0, 0]), EXACT % "fisheye"),
    "masks": (masked, "9 of 9 photographs have a mask, whose black pixels do not count"),
    "several models": (
        lambda f: models(f, [3, 9, 5]),
        "cameras are those of sparse/1; --cameras takes sparse/0 or sparse/2 instead",
    ),
    "models of the same size": (lambda f: models(f, [9, 9]), "those of sparse/0; --cameras takes sparse/1"),
    "a broken model beside a good one": (
        lambda f: [models(f, [9, 9]), spoilt(f, "images.bin")],
        "cameras are those of sparse/1; --cameras takes sparse/0 instead",
    ),
    "a transforms.json beside pinholes": (
        lambda f: [write(f), beside(f)],
        "cameras are those of sparse/0; --cameras takes transforms.json instead",
    ),
    "a pinhole transforms.json beside a lens": (
        lambda f: [write(f, "OPENCV", [0.1, 0, 0, 0]), beside(f)],
        "cameras are those of transforms.json; --cameras takes sparse/0 instead",
    ),
    "a pinhole transforms.json beside a model that is refused": (
        lambda f: [write(f, "EUCM"), beside(f)],
        "passed over: .*sparse/0/cameras: camera 1 is EUCM",
    ),
    "two descriptions of one lens": (
        lambda f: [write(f, "OPENCV", [0.1, 0, 0, 0]), beside(f, k1=0.1)],
        "cameras are those of sparse/0; --cameras takes transforms.json instead",
    ),
    "a broken transforms.json beside pinholes": (
        lambda f: [write(f), (f / "transforms.json").write_text("{")],
        "passed over: .*transforms.json: not valid JSON",
    ),
}
ALL_MODELS = {model.name: write_colmap_text if model.name == "EUCM" else write_colmap for model in colmap.MODELS}
FEW = "training needs at least 2 pictures, got 1 of 2, .*; --test-every 0 trains with all"
# What comes of others: an error as text, or what has to hold: "notes" and "warns" are patterns, other words members of
# the Capture.
FOUND = {
    **{name: (writes, {"notes": ()}) for name, writes in PLAIN.items()},
    **{name: (writes, {"notes": EXACT % "perspective"}) for name, writes in LENSES.items()},
    **{name: (writes, {"notes": note}) for name, (writes, note) in NOTED.items()},
    "not finite distortion": (
        lambda f: write(f, "SIMPLE_RADIAL", [math.nan]),
        r"sparse/0/cameras: camera 1 \(SIMPLE_RADIAL\): every number of radial must be finite, got nan",
    ),
    **{
        name: (
            lambda f, name=name, writer=writer: write(f, name, writer=writer),
            f"sparse/0/cameras: camera 1 is {name}; rendered are SIMPLE_PINHOLE, .*image_undistorter",
        )
        for name, writer in ALL_MODELS.items()
        if name not in io.lenses.NAMES
    },
    "a model of the future": (
        lambda f: with_unused(f, "OPENCV", number=99),
        "cameras.bin: camera 77 has a model that is not known here, number 99",
    ),
    "missing pictures": (
        lambda f: without(f, "images/r_3.png", "images/r_5.png"),
        r"2 of 9 pictures are missing, the first is .*r_3.png; --missing skip leaves them out",
    ),
    "no folder of pictures": (
        lambda f: [write(f), moved(f, "images", "input")],
        r"images: no such folder; --images NAME takes another folder \(input with pictures\)",
    ),
    "no points": (lambda f: without(f, "sparse/0/points3D.bin"), IN_VIEW),
    "no points as text": (lambda f: without(f, "sparse/0/points3D.txt", writer=write_colmap_text), IN_VIEW),
    "empty points": (lambda f: [write(f), spoilt(f, "points3D.bin", content=bytes(8))], IN_VIEW),
    "a capture in kilometres": (
        lambda f: smaller(f, 1e-2),
        {"warns": r"points are 0\.0\d+ from their cameras.*nearer than 0\.2 nothing is drawn.*model_transformer"},
    ),
    "empty points as text": (lambda f: as_text(f, lambda text: b"# none\n", "points3D"), IN_VIEW),
    "a transforms.json without points": (only_transforms, IN_VIEW),
    "two pictures": (lambda f: write(f, views=circle(2, SIZE)), FEW),
    "two pictures in a transforms.json": (lambda f: only_transforms(f, frames=frames("images/{}.png", 2)), FEW),
    **{
        f"masks in {name}": (
            lambda f, name=name: masked(f, name),
            {"ignored_masks": 9, "warns": "9 masks are ignored, all pixels count: masks of photographs belong in"},
        )
        for name in ("images/masks", "images_mask", "dynamic-MASKS/cam0")
    },
    "pictures that are no masks": (lambda f: masked(f, "unmasked"), {"ignored_masks": 0, "notes": ()}),
    "masks of a transforms.json": (
        lambda f: [masked(f), beside(f), shutil.rmtree(f / "sparse")],
        {"ignored_masks": 9, "warns": "9 masks are ignored"},
    ),
    "a model elsewhere": (
        lambda f: [write(f), moved(f, "sparse", "distorted/sparse"), moved(f, "images", "input")],
        r"expected transforms_train.json.*there is a reconstruction in distorted/sparse/0 "
        r"\(--cameras distorted/sparse/0, --images FOLDER\)",
    ),
    "nothing": (lambda f: f.mkdir(), r"expected transforms_train.json, .* in sparse/0$"),
    "models that are refused in both": (
        lambda f: [write(f, "EUCM"), beside(f, camera_model="EUCM")],
        "camera 1 is EUCM",
    ),
    "geographic coordinates": (
        far,
        {"offset": PLACE, "notes": r"positions are stored relative to \(500000, 4200000, 120\)"},
    ),
    "geographic coordinates as text": (lambda f: far(f, writer=write_colmap_text), {"offset": PLACE}),
    "a scene beside zero": (lambda f: far(f, (20.0, 100.0, -30.0)), {"offset": None, "notes": ()}),
    "a half turn": (lambda f: with_exif(f, 3), {"warns": r"EXIF says to turn or mirror 4 pictures.*\.png, \.\.$"}),
    "a quarter turn": (lambda f: with_exif(f, 6, (48, 32)), {}),
    "a quarter turn of a square": (
        lambda f: with_exif(f, 8, (32, 32)),
        {"warns": "EXIF says to turn or mirror 4 pict"},
    ),
    "upright": (lambda f: with_exif(f, 1), {}),
}


@pytest.mark.parametrize("case", FOUND)
def test_captures_of_the_field(tmp_path, case):
    """Every capture is read and can be trained on, or a sentence says why not."""
    writes, expected = FOUND[case]
    folder = tmp_path / "scene"
    writes(folder)
    if isinstance(expected, str):
        with pytest.raises(io.SceneError, match=expected) as raised:
            training.load_capture(folder)
        assert str(folder) in str(raised.value)
        return
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        found = training.load_capture(folder)
        photographs = [*found.train, *found.test]
        loaded = training.load_pictures(photographs, (1,), found.background, "cpu")
    told = [str(warning.message) for warning in told]
    pattern = expected.get("warns")
    assert bool(told) == (pattern is not None) and all(re.search(pattern, text) for text in told), told
    assert len(photographs) == 9 and len(found.test) >= 1
    for view, settings in zip(loaded.views, loaded.settings[1]):
        assert (settings.image_width, settings.image_height) == (view.width, view.height)
    # In the world the cameras are where they were written.
    written = {view.name: view for view in circle(9, SIZE)}
    for item in photographs:
        if item.view.name in written and found.offset is None and "zero" not in case:
            torch.testing.assert_close(item.view.w2c, written[item.view.name].w2c, rtol=0, atol=1e-6)
    for name in ("notes", "offset", "ignored_masks", "starts_in_view"):
        if name == "notes" and isinstance(expected.get(name), str):
            assert any(re.search(expected[name], note) for note in found.notes), found.notes
        elif name in expected:
            assert getattr(found, name) == expected[name]
    if "points" in expected:
        assert found.points is None
    elif "transforms" not in case:
        assert found.points[0].shape == (40, 3) and found.points[0].dtype == torch.float32


def test_cameras_and_pictures_that_are_chosen(tmp_path):
    """What a message offers is there."""
    write(tmp_path, "OPENCV", [0.1, 0, 0, 0])
    beside(tmp_path)
    models(tmp_path / "several", [3, 9])
    moved(tmp_path, "several/sparse/0", "distorted/sparse/0")
    assert training.load_capture(tmp_path, cameras="sparse/0").train[0].view.lens is not None
    assert training.load_capture(tmp_path, cameras="transforms.json").train[0].view.lens is None
    few = training.load_capture(tmp_path, cameras="distorted/sparse/0")
    assert len(few.train) == 2 and few.notes == ()
    for wrong in ("sparse/7", "distorted"):
        with pytest.raises(io.SceneError, match=f"{wrong}: (no such file|expected COLMAP's cameras)"):
            training.load_capture(tmp_path, cameras=wrong)


def test_of_a_part_of_a_capture_the_whole_is_named(tmp_path):
    without(tmp_path)
    for name in ("sparse", "sparse/0"):
        with pytest.raises(io.SceneError, match=f"{name}: expected .*; {re.escape(str(tmp_path))} is a capture: name"):
            training.load_capture(tmp_path / name)


def test_too_few_pictures_that_are_there(tmp_path):
    without(tmp_path, *(f"images/r_{i}.png" for i in range(9)))
    counted = r"got 0: 9 of 9 pictures are missing or cannot be read, the first is .*r_\d\.png; --images NAME takes"
    with pytest.raises(io.SceneError, match=rf"training needs at least 2 pictures, {counted}"):
        training.load_capture(tmp_path, missing="skip")


def test_missing_pictures_can_be_left_out(tmp_path):
    without(tmp_path, "images/r_0.png", "images/r_5.png")
    found = training.load_capture(tmp_path, missing="skip")
    assert [item.view.name for item in found.train] == [f"r_{i}" for i in (1, 2, 3, 4, 6, 7)]
    assert [item.view.name for item in found.test] == ["r_8"]
    assert found.notes == ("2 of 9 pictures are missing and left out",)
    with pytest.raises(ValueError, match="missing must be one of refuse, skip, got draw"):
        training.load_capture(tmp_path, missing="draw")
