"""Files of PlayCanvas' splat-transform and of this package: each reads what the other writes, and finds the same scene.

No number is further off than half a step of the format, in the same axes, for every degree of harmonics.
"""

import math

import numpy as np
import pytest
import torch
from cli_extra import image  # noqa: F401  (skips without the extra)
from gaussians import random_gaussians
from npm import splat_transform
from test_axes import covariance, glb_parts
from test_formats import ROUNDED, smallest_three, steps_of

from analytic_rasterizer import io

DEGREES = pytest.mark.parametrize("degree", range(4))
COUNT = 512
"""Two chunks of a .compressed.ply; a power of two, so that a .sog has an entry of its palette for each Gaussian."""


@pytest.fixture(scope="module")
def convert():
    return splat_transform()


def in_order_of(scene, found):
    """The Gaussians in the order of those that are near."""
    index = torch.cdist(found.means.double(), scene.means.double()).argmin(1)
    assert len(index.unique()) == scene.count
    return scene.rows(index)


def errors(found, scene):
    """Of numbers by their names; of rotations the angle in radians."""
    unit, other = (torch.nn.functional.normalize(s.rotations.double(), dim=1) for s in (found, scene))
    apart = torch.minimum((unit - other).norm(dim=1), (unit + other).norm(dim=1))
    shs = (found.shs - scene.shs).abs()
    return {
        "means": (found.means - scene.means).abs(),
        "log_scales": (found.log_scales - scene.log_scales).abs(),
        "rotations": 4 * torch.asin(apart / 2),
        "opacities": (found.opacities - scene.opacities).abs(),
        "base": shs[:, 0],
        "rest": shs[:, 1:],
    }


def check(found, scene, bounds):
    assert found.count == scene.count and found.sh_degree == scene.sh_degree
    for name, error in errors(found, scene).items():
        if error.numel():
            assert (error / bounds[name]).max() <= ROUNDED, name


def written(tmp_path, degree):
    scene = random_gaussians(COUNT, degree)
    io.save_scene(tmp_path / "scene.ply", scene)
    return scene, tmp_path / "scene.ply"


def reads_alike(convert, path, axes=None, **bounds):
    """What both programs read from a file, which must be the same; `bounds` are those of numbers that are not."""
    found = io.load_scene(path, axes=axes)
    theirs = io.load_scene(convert(path, path.with_name("back.ply")))
    float32 = {"means": 2e-6, "log_scales": 2e-6, "rotations": 2e-6, "base": 1e-6, "rest": 1e-6}
    # Opacities of 8 bits become logits of float32. Those of 0 and 1 have none; we keep them off by 1e-6, they by less
    # than half a step, or do not.
    check(in_order_of(theirs, found), found, float32 | {"opacities": 5e-5} | bounds)
    return found


@DEGREES
def test_a_compressed_ply_that_it_writes(tmp_path, convert, degree):
    scene, path = written(tmp_path, degree)
    found = reads_alike(convert, convert(path, tmp_path / "a.compressed.ply"))
    scene = in_order_of(scene, found)  # its chunks are of neighbours
    check(found, scene, steps_of("a.compressed.ply", scene))


@DEGREES
@pytest.mark.parametrize("version", [3, 4])
def test_an_spz_that_it_writes(tmp_path, convert, degree, version):
    """From version 3 on its files have the axes of a .ply, and do not say so. LichtFeld's and Scaniverse's do not."""
    scene, path = written(tmp_path, degree)
    target = convert(path, tmp_path / "a.spz", "--spz-version", str(version))
    found = reads_alike(convert, target, axes="rdf")
    bounds = steps_of("a.spz", scene)
    # Niantic's library keeps 5 bits of degree 1 and 4 bits of others, after it rounded to 8.
    kept = torch.tensor([5] * 3 + [4] * 12)[: found.shs.shape[1] - 1, None]
    check(found, scene, bounds | {"rest": (2.0**-kept + 2**-8)})


@DEGREES
def test_a_sog_that_it_writes(tmp_path, convert, degree):
    scene, path = written(tmp_path, degree)
    found = reads_alike(convert, convert(path, tmp_path / "a.sog"))
    if degree == 3:
        (tmp_path / "folder").mkdir()
        again = io.load_scene(convert(path, tmp_path / "folder" / "meta.json"))
        check(again, found, dict.fromkeys(errors(again, found), 1e-6) | {"rest": math.inf})  # by chance
    scene = in_order_of(scene, found)
    bounds = steps_of("a.sog", scene)
    # It cuts positions, opacities and quaternions off, where we round: a step, not half of one.
    bounds |= {"means": 2 * bounds["means"], "opacities": 1 / 255, "rotations": smallest_three(math.sqrt(2) / 255)}
    book = lambda values: torch.from_numpy(np.unique(values.numpy()))  # noqa: E731
    for name, values, wanted in (
        ("log_scales", found.log_scales, scene.log_scales),
        ("base", found.shs[:, 0], scene.shs[:, 0]),
        ("rest", found.shs[:, 1:], scene.shs[:, 1:]),
    ):
        if values.numel():  # the nearest of its codebook
            bounds[name] = (wanted.reshape(-1, 1) - book(values)).abs().min(1)[0].reshape(wanted.shape) + 1e-6
    check(found, scene, bounds)


@DEGREES
def test_a_glb_that_it_writes(tmp_path, convert, degree):
    """A quaternion may name the axes of a Gaussian in other directions; all else has the numbers of our file."""
    scene, path = written(tmp_path, degree)
    found = io.load_scene(convert(path, tmp_path / "a.glb"))
    torch.testing.assert_close(covariance(found), covariance(scene), rtol=1e-6, atol=1e-9)
    same = scene._replace(rotations=found.rotations)
    float32 = dict.fromkeys(errors(found, scene), 1e-6)
    check(found, same, float32)
    io.save_scene(tmp_path / "ours.glb", scene)
    (theirs, numbers), (ours, our_numbers) = glb_parts(tmp_path / "a.glb"), glb_parts(tmp_path / "ours.glb")
    names = theirs["meshes"][0]["primitives"][0]["attributes"].keys()
    assert names <= ours["meshes"][0]["primitives"][0]["attributes"].keys()
    for name in names:
        if not name.endswith(("ROTATION", "COLOR_0")):
            torch.testing.assert_close(numbers(name), our_numbers(name), rtol=1e-6, atol=1e-6)


def test_a_ply_that_it_writes(tmp_path, convert):
    scene, path = written(tmp_path, 3)
    for field, wanted in zip(io.load_scene(convert(path, tmp_path / "a.ply")), scene):
        assert torch.equal(field, wanted)


@pytest.mark.parametrize(
    "name, degree",
    [
        *((name, degree) for name in ("a.compressed.ply", "a.spz", "a.sog") for degree in range(4)),
        ("folder/meta.json", 3),
        ("a.splat", 0),
    ],
)
def test_what_we_write(tmp_path, convert, name, degree):
    """Also with a footprint, background and comments, which it passes over."""
    scene = random_gaussians(COUNT, degree)
    (tmp_path / "folder").mkdir()
    io.save_scene(tmp_path / name, scene)
    if name == "a.splat":
        # For it a byte b is (b - 127.5) / 127.5, for the format's first viewer and us (b - 128) / 128: four components
        # of vectors of length 127 and more are 0.5 apart.
        reads_alike(convert, tmp_path / name, rotations=4 * math.asin(1 / 127 / 2))
    else:
        plain = reads_alike(convert, tmp_path / name)
        metadata = io.SceneMetadata(footprint="moment", background=(1, 0.5, 0), comments=("by hand",))
        io.save_scene(tmp_path / name, scene, metadata)
        for field, same in zip(reads_alike(convert, tmp_path / name), plain):
            assert torch.equal(field, same)
