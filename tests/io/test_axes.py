"""Axes of files: the same scene is in them turned as other programs expect it, and comes back.

Numbers of one asymmetric Gaussian are derived by hand. It lies right, below and in front: (1, 2, 3) in memory, where x
points to the right, y down and z forward. Each axis has its own scale. Its colours are brighter seen from above.
"""

import gzip
import json
import math
import struct

import numpy as np
import pytest
import torch
from gaussians import random_gaussians
from test_gltf import picture

from analytic_rasterizer import Gaussians, io
from analytic_rasterizer.io.axes import AXES
from analytic_rasterizer.io.gltf import NAME

# A rotation by 2 atan(5 / 12), and about (0, 3, 4) / 5: down and forward.
QUATERNION = [12 / 13, 0, 3 / 13, 4 / 13]
# Harmonics of degree 1 are -y, z, -x times a positive number: a positive first one is bright for y < 0, above.
ABOVE, FRONT, LEFT = 0.5, 0.25, 0.125


def one_gaussian():
    row = lambda *values: torch.tensor([values])  # noqa: E731
    shs = torch.tensor([0.5, ABOVE, FRONT, LEFT])[None, :, None].repeat(1, 1, 3)
    return Gaussians(row(1.0, 2.0, 3.0), row(-1.0, -2.0, -3.0), torch.tensor([QUATERNION]), row(0.0), shs)


def glb_parts(path):
    """The JSON of a .glb, and the numbers of an attribute by its name."""
    content = path.read_bytes()
    size = struct.unpack_from("<I", content, 12)[0]
    found = json.loads(content[20 : 20 + size])

    def numbers(name):
        accessor = found["accessors"][found["meshes"][0]["primitives"][0]["attributes"][name]]
        view = found["bufferViews"][accessor["bufferView"]]
        return np.frombuffer(content, "<f4", view["byteLength"] // 4, 28 + size + view["byteOffset"]).tolist()

    return found, numbers


@pytest.mark.parametrize("axes, sign, code", [(None, 1, 6), ("rub", -1, 4)])
def test_an_spz_by_its_bytes(tmp_path, axes, sign, code):
    """Numbers as in a .ply, as viewers take them that look for no axes; or with y up and z back. It says which."""
    io.save_scene(tmp_path / "a.spz", one_gaussian(), axes=axes)
    content = gzip.decompress((tmp_path / "a.spz").read_bytes())
    assert content[:4] == b"NGSP" and content[12] == 1 and len(content) == 16 + 9 + 1 + 3 + 3 + 4 + 9 + 12
    positions = [int.from_bytes(content[16 + 3 * i : 19 + 3 * i], "little", signed=True) for i in range(3)]
    assert positions == [1 * 4096, sign * 2 * 4096, sign * 3 * 4096]
    # Version 3: the index of the largest component, w, is 3 in the highest bits. Then x, y and z have a sign and 9 bits
    # each. The axis (0, 3, 4) / 5 is (0, -3, -4) / 5 where y and z change their signs.
    (packed,) = struct.unpack_from("<I", content, 16 + 9 + 1 + 3 + 3)
    coded = lambda value: (value < 0) << 9 | round(abs(value) * math.sqrt(2) * 511)  # noqa: E731
    assert packed == 3 << 30 | coded(0) << 20 | coded(sign * 3 / 13) << 10 | coded(sign * 4 / 13)
    # The harmonics of y and z change their signs as these do. The third, of x, does not.
    assert list(content[-21:-12]) == [128 + sign * 64] * 3 + [128 + sign * 32] * 3 + [128 + 16] * 3
    # SPZ_ADOBE_coordinate_system: a number from LDB 1 to RUF 8 in 4 bytes.
    assert content[14] == 2 and struct.unpack("<III", content[-12:]) == (0xADBE0003, 4, code)
    assert io.read_axes(tmp_path / "a.spz") == (axes or "rdf")


@pytest.mark.parametrize("name", ["a.glb", "a.gltf"])
def test_a_gltf_is_left_up_front(tmp_path, name):
    """Its models face +z with y up, so that +x is at their left: x and y change their signs, z does not."""
    io.save_scene(tmp_path / name, one_gaussian())
    assert io.read_axes(tmp_path / name) == "luf"
    if name == "a.gltf":
        return
    _, numbers = glb_parts(tmp_path / name)
    assert numbers("POSITION") == [-1, -2, 3]
    assert numbers(f"{NAME}:ROTATION") == pytest.approx([0, -3 / 13, 4 / 13, 12 / 13])
    assert numbers(f"{NAME}:SCALE") == pytest.approx([math.exp(-1), math.exp(-2), math.exp(-3)])
    found = [numbers(f"{NAME}:SH_DEGREE_1_COEF_{i}")[0] for i in range(3)]
    assert found == [-ABOVE, FRONT, -LEFT]


@pytest.mark.parametrize("name", ["a.ply", "a.compressed.ply", "a.splat"])
def test_other_files_have_the_axes_of_memory(tmp_path, name):
    scene = one_gaussian()
    io.save_scene(tmp_path / name, scene._replace(shs=scene.shs[:, :1]))
    assert io.read_axes(tmp_path / name) == "rdf"
    assert io.load_scene(tmp_path / name).means.tolist() == [[1, 2, 3]]
    assert b"axes" not in (tmp_path / name).read_bytes()


def bare_spz(system=None):
    """One Gaussian at (1, 2, -3), brighter from y > 0; with a number of SPZ_ADOBE_coordinate_system."""
    header = struct.pack("<4sIIBBBB", b"NGSP", 3, 1, 1, 12, 2 * (system is not None), 0)
    position = b"".join((4096 * value).to_bytes(3, "little", signed=True) for value in (1, 2, -3))
    harmonics = bytes([128 - 64] * 3 + [128] * 6)  # -y < 0
    rest = bytes([128, 128, 128, 128, 144, 128, 112]) + struct.pack("<I", 3 << 30) + harmonics
    extension = b"" if system is None else struct.pack("<III", 0xADBE0003, 4, system)
    return gzip.compress(header + position + rest + extension)


def test_an_spz_of_another_program(tmp_path):
    """As it stands in its bytes: up, in front, and brighter from above."""
    (tmp_path / "a.spz").write_bytes(bare_spz())
    scene = io.load_scene(tmp_path / "a.spz")
    assert scene.means.tolist() == [[1, -2, 3]]
    assert scene.shs[0, 1:, 0].tolist() == [0.5, 0, 0]
    assert io.load_scene(tmp_path / "a.spz", axes="RDF").means.tolist() == [[1, 2, -3]]


@pytest.mark.parametrize(
    "system, axes, place",
    [
        (0, "rub", [1, -2, 3]),  # unspecified
        (1, "ldb", [-1, 2, 3]),
        (4, "rub", [1, -2, 3]),
        (5, "ldf", [-1, 2, -3]),
        (6, "rdf", [1, 2, -3]),
        (8, "ruf", [1, -2, -3]),
        (10, "rfd", [1, -3, 2]),
        (12, "rfu", [1, 3, 2]),
        (15, "lbu", [-1, 3, -2]),
        (16, "rbu", [1, 3, -2]),
        (17, "rub", [1, -2, 3]),  # of the future
    ],
)
def test_an_spz_that_says_its_axes(tmp_path, system, axes, place):
    """Also with z up. By hand: of RFU z = -3 is 3 downwards, y = 2 is 2 forward."""
    (tmp_path / "a.spz").write_bytes(bare_spz(system))
    assert io.read_axes(tmp_path / "a.spz") == axes
    scene = io.load_scene(tmp_path / "a.spz")
    assert scene.means.tolist() == [place]
    # Where the y of the file is: the Gaussian is brighter seen from there, and its deviation is exp(-2) along it.
    direction = torch.tensor(place) * torch.tensor([0, *(abs(value) == 2 for value in place[1:])])
    seen = (scene.shs[0, 1:, 0] * torch.tensor([-1, 1, -1]))[[2, 0, 1]]
    torch.testing.assert_close(seen, 0.25 * direction, rtol=0, atol=1e-6)
    variances = covariance(scene)[0].diagonal()
    torch.testing.assert_close(variances[direction != 0], torch.tensor([math.exp(-4)], dtype=torch.float64))
    assert variances[0].log().item() == pytest.approx(-2)


def as_before(path, scene, metadata=None):
    """A file as this package wrote it before it wrote axes."""
    axes = "rdf" if path.suffix == ".spz" else "rub"
    io.save_scene(path, scene, metadata, axes=axes)
    if path.suffix == ".spz":
        content = gzip.decompress(path.read_bytes())
        path.write_bytes(gzip.compress(content.replace(struct.pack("<III", 0xADBE0003, 4, 6), b"")))
    elif path.suffix == ".gltf":
        found = json.loads(path.read_bytes())
        found["asset"]["extras"]["analytic_rasterizer"].remove(f"analytic_rasterizer axes {axes}")
        path.write_text(json.dumps(found))
    content = path.read_bytes()
    content = gzip.decompress(content) if path.suffix == ".spz" else content
    assert b"axes" not in content and struct.pack("<I", 0xADBE0003) not in content


@pytest.mark.parametrize("name", ["a.spz", "a.gltf"])
def test_files_that_this_package_wrote_before_come_back(tmp_path, name):
    as_before(tmp_path / name, one_gaussian(), io.SceneMetadata(footprint="moment"))
    assert io.read_axes(tmp_path / name) == ("rdf" if name == "a.spz" else "rub")
    found = io.load_scene(tmp_path / name)
    assert found.means.tolist() == [[1, 2, 3]]
    torch.testing.assert_close(found.rotations, one_gaussian().rotations, rtol=0, atol=2e-3)
    torch.testing.assert_close(found.shs[:, 1:], one_gaussian().shs[:, 1:])
    assert io.read_metadata(tmp_path / name).footprint == "moment:samples=4"
    # Written again, it has the axes of other programs, and looks the same.
    io.save_scene(tmp_path / f"b{name}", found, io.read_metadata(tmp_path / name))
    assert io.read_axes(tmp_path / f"b{name}") == ("rdf" if name == "a.spz" else "luf")
    assert io.load_scene(tmp_path / f"b{name}").means.tolist() == [[1, 2, 3]]


@pytest.mark.parametrize("axes", AXES)
@pytest.mark.parametrize("name", ["a.ply", "a.spz", "a.glb", "a.compressed.ply"])
def test_every_choice_comes_back(tmp_path, name, axes):
    scene = random_gaussians(8)
    io.save_scene(tmp_path / f"usual-{name}", scene)
    io.save_scene(tmp_path / name, scene, io.SceneMetadata(footprint="moment"), axes=axes.upper())
    assert io.read_axes(tmp_path / name) == axes
    assert io.read_metadata(tmp_path / name).comments == ()
    found, wanted = io.load_scene(tmp_path / name), io.load_scene(tmp_path / f"usual-{name}")
    # Steps of a format are at other places where coordinates have other signs.
    bound = {"a.ply": 0, "a.glb": 2e-7}.get(name, 5e-3)
    for field in ("means", "log_scales", "logit_opacities"):
        assert (getattr(found, field) - getattr(wanted, field)).abs().max() <= 4 * bound
    assert (found.rotations * wanted.rotations).sum(1).abs().min() > 1 - 1e-4
    assert (found.shs - wanted.shs).abs().max() <= 0.04 * (bound > 0)
    stored = io.load_scene(tmp_path / name, axes="rdf")  # the numbers of the file
    signs = torch.tensor([1.0 if letter in "rdf" else -1.0 for letter in axes])
    torch.testing.assert_close(stored.means, found.means * signs, rtol=0, atol=0)


def covariance(scene):
    w, x, y, z = torch.nn.functional.normalize(scene.rotations.double(), dim=1).T
    rows = [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)]
    rows += [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)]
    rows += [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]
    rotation = torch.stack(rows, 1).reshape(-1, 3, 3)
    return rotation @ torch.diag_embed(scene.scales.double() ** 2) @ rotation.mT


@pytest.mark.parametrize("axes", AXES)
def test_gaussians_of_other_axes_are_mirrored_with_their_colours(tmp_path, axes):
    """Their covariances are S C S; their pictures, from a mirrored camera, are those of before. Of degree 4."""
    scene = random_gaussians(200, degree=4)
    io.save_scene(tmp_path / "a.ply", scene, axes=axes)
    stored = io.load_scene(tmp_path / "a.ply", axes="rdf")
    signs = torch.tensor([1.0 if letter in "rdf" else -1.0 for letter in axes])
    mirror = torch.diag(signs.double())
    torch.testing.assert_close(covariance(stored), mirror @ covariance(scene) @ mirror)
    # A camera M = [1, t] sees before what S M S sees after, but for a picture that is mirrored where S mirrors it.
    camera = torch.eye(4)
    camera[:3, 3] = torch.tensor([0.2, -0.1, 6])
    turned = camera.clone()
    handed = signs.prod()
    turned[:3, :3] = torch.diag(signs * torch.tensor([handed, 1, 1]))  # a rotation: x is mirrored where S is one
    turned[:3, 3] = camera[:3, 3] * torch.tensor([handed, 1, 1])
    before, after = picture(scene, camera), picture(stored, turned)
    assert before.std() > 0.05
    after = after.flip(2) if handed < 0 else after
    assert (before - after).abs().max() < 2e-4
    if axes != "rdf":
        wrong = picture(stored._replace(shs=scene.shs), turned)
        assert (before - (wrong.flip(2) if handed < 0 else wrong)).abs().max() > 0.01


@pytest.mark.parametrize("axes", ["", "rd", "xyz", "fdr", 3])
def test_axes_that_there_are_none(tmp_path, axes):
    with pytest.raises(io.SceneError, match=r"a\.ply: axes must be three letters"):
        io.save_scene(tmp_path / "a.ply", one_gaussian(), axes=axes)
    io.save_scene(tmp_path / "a.ply", one_gaussian())
    with pytest.raises(ValueError, match="axes must be three letters"):
        io.load_scene(tmp_path / "a.ply", axes=axes)


def test_a_splat_does_not_say_its_axes(tmp_path):
    scene = one_gaussian()
    with pytest.warns(UserWarning, match=r"a \.splat does not hold its axes \(rub\); a \.ply does"):
        io.save_scene(tmp_path / "a.splat", scene._replace(shs=scene.shs[:, :1]), axes="rub")
    assert io.load_scene(tmp_path / "a.splat").means.tolist() == [[1, -2, -3]]
    assert io.load_scene(tmp_path / "a.splat", axes="rub").means.tolist() == [[1, 2, 3]]
