"""Writing .sog, bundled and not: what comes back is what the format can hold, for other programs too."""

import json
import math
import zipfile
from io import BytesIO

import numpy as np
import pytest
import torch
from cli_extra import image
from gaussians import random_gaussians

from analytic_rasterizer import io
from analytic_rasterizer.io import sog_writer
from analytic_rasterizer.io.codebooks import codebook, nearest, palette


def in_its_order(scene):
    return scene.rows(torch.from_numpy(sog_writer._order(scene.means.numpy())))


def pictures_of(path):
    """The pixels by their files' names, and meta.json."""
    with zipfile.ZipFile(path) as archive:
        assert archive.namelist()[0] == "meta.json"
        pictures = {name: archive.read(name) for name in archive.namelist()[1:]}
        meta = json.loads(archive.read("meta.json"))
    return {name: np.asarray(image.open(BytesIO(content))) for name, content in pictures.items()}, meta


@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize("name", ["a.sog", "folder/meta.json"])
def test_what_is_written_comes_back(tmp_path, name, degree):
    """Every number is the nearest that the file holds: within half a step, or the nearest of the codebook."""
    scene, path = random_gaussians(900, degree=degree), tmp_path / name
    path.parent.mkdir(exist_ok=True)
    io.save_scene(path, scene)
    found, wanted = io.load_scene(path, strict=True), in_its_order(scene)
    assert found.sh_degree == degree
    logs = wanted.means.double().sign() * wanted.means.double().abs().log1p()
    half = (logs.max(0)[0] - logs.min(0)[0]) / 65535 / 2 + 2**-22 * logs.abs().max()  # and roundings of float32
    assert ((found.means - wanted.means).abs() <= (wanted.means.abs() + 1) * half.expm1()).all()
    assert (found.opacities - wanted.opacities).abs().max() <= 1.001 / 255 / 2
    unit = torch.nn.functional.normalize(wanted.rotations.double(), dim=1)
    # The three smaller components err by half of sqrt(2) / 255, and the largest by at most twice as much as all three.
    apart = torch.minimum((found.rotations - unit).norm(dim=1), (found.rotations + unit).norm(dim=1))
    assert apart.max() <= 1.05 * math.sqrt(5 * 3) * math.sqrt(2) / 255 / 2
    for got, asked in ((found.log_scales, wanted.log_scales), (found.shs[:, 0], wanted.shs[:, 0])):
        book = got.unique()
        assert 200 < len(book) <= 256
        best = (asked.reshape(-1, 1) - book).abs().min(1)[0].reshape(asked.shape)
        torch.testing.assert_close((got - asked).abs(), best, rtol=0, atol=1e-6)
        # The best for 256 entries is sqrt(sqrt(3) pi / 2) / 256 = 0.0064 of a Gaussian's deviation (see below).
        assert (got - asked).square().mean().sqrt() < 1.5 * 0.0064 * asked.std()
    if degree:  # so few Gaussians have a row of the palette each
        assert (found.shs[:, 1:] - wanted.shs[:, 1:]).square().mean().sqrt() < 1.5 * 0.0064 * wanted.shs[:, 1:].std()


def test_the_files_of_a_bundle(tmp_path):
    scene = random_gaussians(70, degree=2)
    io.save_scene(tmp_path / "a.sog", scene, io.SceneMetadata(footprint="moment"))
    pictures, meta = pictures_of(tmp_path / "a.sog")
    assert (meta["version"], meta["count"], meta["antialias"]) == (2, 70, True)
    assert [len(meta[name]["codebook"]) for name in ("scales", "sh0", "shN")] == [256] * 3
    assert (meta["shN"]["count"], meta["shN"]["bands"]) == (70, 2)
    assert pictures["shN_centroids.webp"].shape == (2, 64 * 8, 3)
    shapes = {pixels.shape[:2] for name, pixels in pictures.items() if name != "shN_centroids.webp"}
    assert shapes == {(6, 12)}  # of 70 pixels and more
    assert set(np.unique(pictures["quats.webp"].reshape(-1, 4)[:70, 3])) <= {252, 253, 254, 255}
    io.save_scene(tmp_path / "meta.json", scene, io.SceneMetadata(footprint="moment"))
    assert json.loads((tmp_path / "meta.json").read_text()) == meta
    assert {path.name for path in tmp_path.iterdir()} == {"a.sog", "meta.json", *pictures}
    assert io.read_metadata(tmp_path / "meta.json") == io.read_metadata(tmp_path / "a.sog")
    for field, same in zip(io.load_scene(tmp_path / "meta.json"), io.load_scene(tmp_path / "a.sog")):
        assert torch.equal(field, same)


def test_one_gaussian_and_extreme_numbers(tmp_path):
    io.save_scene(tmp_path / "one.sog", random_gaussians(1, degree=1))
    torch.testing.assert_close(io.load_scene(tmp_path / "one.sog").means, random_gaussians(1, degree=1).means)
    scene = random_gaussians(50, degree=0)
    scene.log_scales[0, 1] = -math.inf
    scene.rotations[1] = 0
    scene.means[2] = 1e6
    scene.logit_opacities[:2, 0] = torch.tensor([math.inf, -math.inf])
    io.save_scene(tmp_path / "a.sog", scene)
    found, wanted = io.load_scene(tmp_path / "a.sog", strict=True), in_its_order(scene)
    assert (found.scales - wanted.scales).abs().max() < 0.03
    assert (found.means / wanted.means)[wanted.means[:, 0] == 1e6].sub(1).abs().max() < 1e-3
    assert found.rotations[(wanted.rotations == 0).all(1)].tolist()[0][0] > 0.99


@pytest.mark.parametrize("change", ["gone", "above"])
def test_a_broken_folder(tmp_path, change):
    io.save_scene(tmp_path / "meta.json", random_gaussians(degree=0))
    meta = json.loads((tmp_path / "meta.json").read_text())
    if change == "gone":
        (tmp_path / "scales.webp").unlink()
    else:
        meta["scales"]["files"] = ["../scales.webp"]
        (tmp_path / "meta.json").write_text(json.dumps(meta))
    with pytest.raises(io.SceneError, match=r"meta\.json: (unreadable|expected the name of a file beside it)"):
        io.load_scene(tmp_path / "meta.json")


def test_what_a_sog_does_not_hold(tmp_path):
    with pytest.raises(io.SceneError, match=r"a\.sog: harmonics of degree 4"):
        io.save_scene(tmp_path / "a.sog", random_gaussians(degree=4))
    with pytest.raises(io.SceneError, match=r"a\.sog: a \.sog has no place for a scene without Gaussians"):
        io.save_scene(tmp_path / "a.sog", random_gaussians(0))
    assert not list(tmp_path.iterdir())


def test_codebooks():
    few = np.float32([3, 1, 2, 1])
    assert codebook(few).tolist() == [1, 2, 3]
    values = np.random.default_rng(0).normal(size=20_000).astype(np.float32)
    book = codebook(values)
    assert len(book) == 256 and (np.diff(book) >= 0).all()
    error = np.square(book[nearest(book, values)] - values).mean()
    # Panter and Dite: the best error is (integral of the density's cube root)^3 / (12 n^2), here of a Gaussian.
    best = math.sqrt(3) * math.pi / 2 / 256**2
    assert 0.8 * best < error < 1.2 * best


def test_palettes():
    """Clusters that lie apart are found; of many rows an index is that of a neighbour."""
    random = np.random.default_rng(0)
    centres = random.normal(size=(40, 9)).astype(np.float32)
    rows = (centres[random.integers(40, size=4000)] + 1e-3 * random.normal(size=(4000, 9))).astype(np.float32)
    found, labels = palette(rows, 1024)
    assert len(found) <= 1024
    assert np.abs(found[labels] - rows).max() < 6e-3
    wide = random.normal(size=(4000, 9)).astype(np.float32)
    found, labels = palette(wide, 1024)
    assert np.square(found[labels] - wide).mean() < 0.35  # of 1; four rows share an entry
    same, labels = palette(wide[:100], 1024)
    assert np.array_equal(same[labels], wide[:100])
