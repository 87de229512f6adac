"""Axes of files: the same scene is in them turned as other programs expect it, and comes back.

Numbers of one asymmetric Gaussian are derived by hand. It lies right, below and in front: (1, 2, 3) in memory, where x
points to the right, y down and z forward. Each axis has its own scale. Its colours are brighter seen from above.
"""

import gzip
import json
import math
import shutil
import struct
import subprocess

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


def test_an_spz_is_right_up_back(tmp_path):
    """The file, byte by byte: y points up and z back, so that both change their signs, x does not."""
    io.save_scene(tmp_path / "a.spz", one_gaussian())
    content = gzip.decompress((tmp_path / "a.spz").read_bytes())
    assert content[:4] == b"NGSP" and content[12] == 1 and len(content) == 16 + 9 + 1 + 3 + 3 + 4 + 9
    positions = [int.from_bytes(content[16 + 3 * i : 19 + 3 * i], "little", signed=True) for i in range(3)]
    assert positions == [1 * 4096, -2 * 4096, -3 * 4096]
    # The axis (0, 3, 4) / 5 is (0, -3, -4) / 5. Version 3: the index of the largest component, w, is 3 in the highest
    # bits. Then x, y and z have a sign and 9 bits each.
    (packed,) = struct.unpack_from("<I", content, 16 + 9 + 1 + 3 + 3)
    code = lambda value: (value < 0) << 9 | round(abs(value) * math.sqrt(2) * 511)  # noqa: E731
    assert packed == 3 << 30 | code(0) << 20 | code(-3 / 13) << 10 | code(-4 / 13)
    # Above is y > 0 there and in front z < 0: the first two harmonics change their signs. The third, of x, does not.
    assert list(content[-9:]) == [128 - 64] * 3 + [128 - 32] * 3 + [128 + 16] * 3
    assert io.read_axes(tmp_path / "a.spz") == "rub"


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


def test_an_spz_of_another_program(tmp_path):
    """As it stands in its bytes: up, in front, and brighter from above."""
    header = struct.pack("<4sIIBBBB", b"NGSP", 3, 1, 1, 12, 0, 0)
    position = b"".join((4096 * value).to_bytes(3, "little", signed=True) for value in (1, 2, -3))
    harmonics = bytes([128 - 64] * 3 + [128] * 6)  # -y < 0 is y > 0, which is above
    rest = bytes([128, 128, 128, 128, 144, 128, 112]) + struct.pack("<I", 3 << 30) + harmonics
    (tmp_path / "a.spz").write_bytes(gzip.compress(header + position + rest))
    scene = io.load_scene(tmp_path / "a.spz")
    assert scene.means.tolist() == [[1, -2, 3]]
    assert scene.shs[0, 1:, 0].tolist() == [0.5, 0, 0]
    assert io.load_scene(tmp_path / "a.spz", axes="RDF").means.tolist() == [[1, 2, -3]]


def as_before(path, scene, metadata=None):
    """A file as this package wrote it before it wrote axes."""
    axes = "rdf" if path.suffix == ".spz" else "rub"
    io.save_scene(path, scene, metadata, axes=axes)
    line = f"analytic_rasterizer axes {axes}".encode()
    content = path.read_bytes()
    if path.suffix == ".spz":
        content = gzip.decompress(content)
        start = content.index(struct.pack("<I", 0x41520001))
        text = content[start + 8 :].replace(line, b"").strip()
        path.write_bytes(gzip.compress(content[: start + 4] + struct.pack("<I", len(text)) + text))
    elif path.suffix == ".gltf":
        found = json.loads(content)
        found["asset"]["extras"]["analytic_rasterizer"].remove(line.decode())
        path.write_text(json.dumps(found))
    content = path.read_bytes()
    assert b"axes" not in (gzip.decompress(content) if path.suffix == ".spz" else content)


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
    assert io.read_axes(tmp_path / f"b{name}") == ("rub" if name == "a.spz" else "luf")
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


def test_splat_transform_agrees(tmp_path):
    """PlayCanvas' converter makes the same of our .ply, .spz and .glb."""
    program = shutil.which("splat-transform")
    if program is None:
        pytest.skip("needs splat-transform (npm install --global @playcanvas/splat-transform)")
    scene = one_gaussian()
    for name in ("a.ply", "a.spz"):
        io.save_scene(tmp_path / name, scene)

    def convert(source, target):
        command = [program, "--quiet", "--overwrite", "--gpu", "cpu", tmp_path / source, tmp_path / target]
        subprocess.run(command, check=True, capture_output=True)
        return io.load_scene(tmp_path / target)

    for source, target in (("a.ply", "b.spz"), ("a.ply", "b.glb"), ("a.spz", "b.ply")):
        found = convert(source, target)
        torch.testing.assert_close(found.means, scene.means, rtol=0, atol=2e-4)
        # Quaternions may name axes in other directions: the Gaussian is the same.
        torch.testing.assert_close(covariance(found), covariance(scene), rtol=0, atol=0.01)
        torch.testing.assert_close(found.shs[:, 1:], scene.shs[:, 1:], rtol=0, atol=0.04)
