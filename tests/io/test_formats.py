"""Formats of scenes: what each holds comes back, among it what the scene says of itself.

Files are written by hand where another program writes them.
"""

import gzip
import io as memory
import json
import math
import struct
import sys
import zipfile

import numpy as np
import pytest
import torch
from cli_extra import image
from gaussians import random_gaussians
from ply_files import CAMERA, CODES, FLAGS, TRIANGLES, Element, ply

from analytic_rasterizer import io
from analytic_rasterizer.io.ply import TYPES, read_header, read_rows


def turned_by(a, b):
    """Largest 1 - |cos| between quaternions: their sign does not matter."""
    unit = [torch.nn.functional.normalize(scene.rotations, dim=1) for scene in (a, b)]
    return (1 - (unit[0] * unit[1]).sum(1).abs()).max().item()


def close(found, wanted, turned=1e-4):
    """Whether scenes agree as far as 8 bits a number allow; `turned` bounds `turned_by`."""
    assert found.count == wanted.count and found.sh_degree == wanted.sh_degree
    assert (found.means - wanted.means).abs().max() < 5e-3
    assert (found.log_scales - wanted.log_scales).abs().max() < 0.04
    assert (found.opacities - wanted.opacities).abs().max() < 3e-3
    assert turned_by(found, wanted) < turned
    assert (found.shs - wanted.shs).abs().max() < 0.04


def smallest_three(error):
    """By how many radians a rotation errs at most if each of the three smaller components errs by `error`.

    The largest follows from them: w = sqrt(1 - r^2) with r^2 <= 3/4, so that it errs by r / w times as much as r does,
    which is at most 2 (and a little more, for the r that was read may lie beyond). Quaternions that are d apart are
    rotations that are 4 asin(d / 2) apart.
    """
    three = math.sqrt(3) * error
    r = math.sqrt(3) / 2 + three
    return 4 * math.asin(math.hypot(three, three * r / math.sqrt(1 - r * r)) / 2)


def in_chunks(values, steps):
    """(N, 3) half a step of each axis, between the limits of every 256 Gaussians."""
    half = [torch.stack([chunk.min(0)[0], chunk.max(0)[0]]).diff(dim=0).expand_as(chunk) for chunk in values.split(256)]
    return torch.cat(half) / (2 * torch.tensor(steps))


def steps_of(name, scene):
    """The largest errors of a format for numbers within its limits: half a step between those that it holds.

    Bits and limits are those of its description. Rotations in radians; `base` is the harmonic of degree 0.
    """
    if name == "a.compressed.ply":  # 11, 10 and 11 bits between limits, 8 of colours; 10 from -1/sqrt(2) to 1/sqrt(2)
        made = {"means": in_chunks(scene.means, [2047, 1023, 2047])}
        made |= {"log_scales": in_chunks(scene.log_scales, [2047, 1023, 2047])}
        made |= {"rotations": smallest_three(math.sqrt(2) / 1023 / 2), "opacities": 1 / 255 / 2}
        made |= {"base": in_chunks(scene.shs[:, 0], [255, 255, 255]), "rest": 8 / 256 / 2}
        return made
    if name == "a.spz":  # version 3: 12 fractional bits; 9 bits from 0 to 1/sqrt(2)
        made = {"means": 2**-12 / 2, "log_scales": 1 / 16 / 2}
        made |= {"rotations": smallest_three(1 / math.sqrt(2) / 511 / 2), "opacities": 1 / 255 / 2}
        made |= {"base": 1 / (0.15 * 255) / 2, "rest": 1 / 128 / 2}
        return made
    if name == "a.sog":  # as sog_file writes it, with codebooks of equal steps
        logs = scene.means.sign() * scene.means.abs().log1p()
        span = lambda values: float(np.ptp(values.numpy())) if values.numel() else 0  # noqa: E731
        half = (logs.max(0)[0] - logs.min(0)[0]) / 65535 / 2
        half += 2**-22 * logs.abs().max()  # 16 bits are so many that four roundings of a logarithm in float32 count
        made = {"means": (scene.means.abs() + 1) * half.expm1(), "log_scales": span(scene.log_scales) / 255 / 2}
        made |= {"rotations": smallest_three(math.sqrt(2) / 255 / 2), "opacities": 1 / 255 / 2}
        made |= {"base": span(scene.shs[:, 0]) / 255 / 2, "rest": span(scene.shs[:, 1:]) / 255 / 2}
        return made
    # .splat: 4 components in steps of 1/128, each wrong by half of one, on a sphere.
    turned = 2 * math.asin(math.sqrt(4) / 128 / 2)
    return {"rotations": turned, "opacities": 1 / 255 / 2, "base": 1 / (255 * 0.28209479177387814) / 2}


ROUNDED = 1 + 2**-10
"""Half a step, and what float32 adds: a number of up to 2^11 steps, by four roundings of 2^-24, is 2^-11 steps off."""


@pytest.mark.parametrize(
    "name, degree",
    [*((name, degree) for name in ("a.compressed.ply", "a.spz", "a.sog") for degree in range(4)), ("a.splat", 0)],
)
def test_errors_are_half_a_step_of_the_format(tmp_path, name, degree):
    """And not much less, so that a step that is twice as large is noticed."""
    scene, path = random_gaussians(2000, degree), tmp_path / name
    if name == "a.sog":
        path.write_bytes(sog_file(scene))
    else:
        io.save_scene(path, scene)
    found = io.load_scene(path, strict=True)
    assert found.sh_degree == degree
    unit, other = (torch.nn.functional.normalize(s.rotations.double(), dim=1) for s in (found, scene))
    apart = torch.minimum((unit - other).norm(dim=1), (unit + other).norm(dim=1))
    errors = {field: (getattr(found, field) - getattr(scene, field)).abs() for field in ("means", "log_scales")}
    errors["rotations"] = 4 * torch.asin(apart / 2)
    errors["opacities"] = (found.opacities - scene.opacities).abs()
    errors["base"], errors["rest"] = (found.shs - scene.shs).abs()[:, 0], (found.shs - scene.shs).abs()[:, 1:]
    expected = {field: half for field, half in steps_of(name, scene).items() if errors[field].numel()}
    for field, half in expected.items():
        share = (errors[field] / half).max()
        assert 0.5 < share <= ROUNDED, f"{field}: {share:.4f} of half a step"
    for field in {"means", "log_scales"} - set(expected):  # float32, scales as they are
        torch.testing.assert_close(getattr(found, field), getattr(scene, field), rtol=1.2e-7, atol=1.2e-7)


@pytest.mark.parametrize("degree", range(4))
def test_a_ply_comes_back_to_the_bit(tmp_path, degree):
    """Parameters as they are: quaternions of any length, large logits, scales of 0."""
    scene = random_gaussians(degree=degree)
    scene = scene._replace(rotations=3 * scene.rotations, logit_opacities=20 * scene.logit_opacities)
    scene.log_scales[0, 1] = -math.inf
    scene.rotations[1] = 0
    scene.means[2] = torch.tensor([-0.0, 1e-42, 3e38])
    scene.shs[3] = torch.nextafter(torch.tensor(1.0), torch.tensor(2.0))
    for again in (1, 2):
        io.save_scene(tmp_path / f"{again}.ply", scene)
        found = io.load_scene(tmp_path / f"{again}.ply", strict=True)
        assert found.sh_degree == degree
        for field, wanted in zip(found, scene):
            assert field.numpy().tobytes() == wanted.contiguous().numpy().tobytes()
    assert (tmp_path / "1.ply").read_bytes() == (tmp_path / "2.ply").read_bytes()
    scene.logit_opacities[:2, 0] = torch.tensor([math.inf, -math.inf])  # other programs make NaN of them
    io.save_scene(tmp_path / "a.ply", scene)
    kept = io.load_scene(tmp_path / "a.ply").logit_opacities[:2, 0]
    torch.testing.assert_close(kept, torch.tensor([13.8155, -13.8155]), rtol=0, atol=1e-4)


@pytest.mark.parametrize("name", ["a.compressed.ply", "a.spz", "a.splat", "a.glb"])
def test_scales_of_zero_and_zero_quaternions_spoil_nothing(tmp_path, name):
    """In a compressed .ply a logarithm of -inf made NaN of the scales of 256 Gaussians."""
    scene = random_gaussians(degree=0)
    scene.log_scales[0, 1] = -math.inf
    scene.rotations[1] = 0
    io.save_scene(tmp_path / name, scene)
    found = io.load_scene(tmp_path / name, strict=True)
    assert found.scales[0, 1] < 1e-4
    assert found.rotations[1, 0] > 0.99 and found.rotations[1, 1:].abs().max() < 1e-2
    rest = torch.arange(scene.count) > 1
    assert (found.scales - scene.scales)[rest].abs().max() < 0.05


def test_a_splat_by_hand(tmp_path):
    """32 bytes: position, scales, colour with opacity, quaternion."""
    row = struct.pack("<6f8B", 1, -2, 3, 0.5, 0.25, 0.125, 255, 0, 51, 204, 128, 0, 192, 128)
    (tmp_path / "a.SPLAT").write_bytes(3 * row)
    scene = io.load_scene(tmp_path / "a.SPLAT")
    assert (scene.count, scene.sh_degree) == (3, 0)
    assert scene.means[0].tolist() == [1, -2, 3]
    torch.testing.assert_close(scene.scales[1], torch.tensor([0.5, 0.25, 0.125]))
    assert scene.rotations[2].tolist() == [0, -1, 0.5, 0]
    torch.testing.assert_close(scene.opacities[0], torch.tensor([0.8]))
    torch.testing.assert_close(0.5 + 0.28209479177387814 * scene.shs[0, 0], torch.tensor([1.0, 0.0, 0.2]))
    io.save_scene(tmp_path / "b.splat", scene)
    assert (tmp_path / "b.splat").stat().st_size == 96
    assert (tmp_path / "b.splat").read_bytes()[:28] == row[:28]
    again = io.load_scene(tmp_path / "b.splat")
    assert turned_by(again, scene) < 1e-4
    (tmp_path / "a.splat").write_bytes(3 * row + b"1")
    with pytest.raises(io.SceneError, match=r"a\.splat: cut short: expected a multiple of 32 bytes, got 97"):
        io.load_scene(tmp_path / "a.splat")
    broken = struct.pack("<6f8B", math.nan, -2, 3, 0.5, -0.25, 0.125, *[128] * 8)
    (tmp_path / "a.splat").write_bytes(row + broken)
    with pytest.warns(UserWarning, match="1 of 2 Gaussians are left out: means of 1, scales of 1 are not finite"):
        assert io.load_scene(tmp_path / "a.splat").count == 1


@pytest.mark.parametrize("name", ["a.ply", "a.compressed.ply", "a.spz"])
def test_a_file_of_another_format_is_no_splat(tmp_path, name):
    """Where its size is that of whole rows, it would be read as numbers of no meaning."""
    io.save_scene(tmp_path / name, random_gaussians(degree=0))
    content = (tmp_path / name).read_bytes()
    (tmp_path / "b.splat").write_bytes(content + bytes(-len(content) % 32))
    with pytest.raises(io.SceneError, match=rf"b\.splat: a {(tmp_path / name).suffix}, and no \.splat: rename it"):
        io.load_scene(tmp_path / "b.splat")


def test_a_folder_is_no_file_of_a_scene(tmp_path):
    (tmp_path / "a.ply").mkdir()
    with pytest.raises(io.SceneError, match=r"a\.ply: expected a file of a scene, got a folder"):
        io.load_scene(tmp_path / "a.ply")


def test_a_splat_round_trip(tmp_path):
    scene = random_gaussians(degree=0)
    io.save_scene(tmp_path / "a.splat", scene)
    close(io.load_scene(tmp_path / "a.splat"), scene)
    scene.shs[:2, 0] = torch.tensor([[9.0], [-9.0]])  # clamped, and not wrapped around
    scene.logit_opacities[:2, 0] = torch.tensor([math.inf, -math.inf])
    io.save_scene(tmp_path / "a.splat", scene)
    rgba = np.frombuffer((tmp_path / "a.splat").read_bytes(), "u1").reshape(-1, 32)[:2, 24:28]
    assert rgba.tolist() == [[255] * 4, [0] * 4]
    assert io.load_scene(tmp_path / "a.splat").logit_opacities.isfinite().all()


def spz_parts(scene, version):
    """The parts of an .spz, by the description of the format: 24, 8, 8, 8, 10 and 8 bits a number."""
    fixed = np.rint(scene.means.numpy().astype(np.float64) * 4096).astype("<i4")
    positions = fixed.reshape(-1, 3, 1).view("u1").reshape(-1, 3, 4)[:, :, :3]
    byte = lambda values: np.rint(values.numpy()).clip(0, 255).astype("u1")  # noqa: E731
    turned = torch.nn.functional.normalize(scene.rotations, dim=1)[:, [1, 2, 3, 0]].numpy()
    first_three = np.rint(127.5 * turned[:, :3] * np.where(turned[:, 3:] < 0, -1, 1) + 127.5).astype("u1")
    packed = []
    for q in turned:
        largest = int(np.abs(q).argmax())
        word = largest
        for i in range(4):
            if i != largest:
                value = q[i] * np.sign(q[largest])
                word = word << 10 | int(value < 0) << 9 | round(511 * abs(float(value)) * math.sqrt(2))
        packed.append(word)
    return [
        positions.tobytes(),
        byte(255 * scene.opacities).tobytes(),
        byte(38.25 * scene.shs[:, 0] + 127.5).tobytes(),
        byte(16 * (scene.log_scales + 10)).tobytes(),
        first_three.tobytes() if version == 2 else np.array(packed, "<u4").tobytes(),
        byte(128 * scene.shs[:, 1:] + 128).tobytes(),
    ]


def spz_file(scene, version, flags=0, records=b""):
    """An .spz with these flags and records of extensions."""
    header = struct.pack("<4sIIBBB", b"NGSP", version, scene.count, scene.sh_degree, 12, flags)
    parts = [part for part in spz_parts(scene, version) if part]
    if version < 4:
        return gzip.compress(header + b"\0" + b"".join(parts) + records)
    zstandard = pytest.importorskip("zstandard", reason="needs the cli extra")
    compressed = [zstandard.ZstdCompressor().compress(part) for part in parts]
    header += struct.pack("<BI12x", len(parts), 32 + len(records))
    sizes = b"".join(struct.pack("<QQ", len(small), len(part)) for small, part in zip(compressed, parts))
    return header + records + sizes + b"".join(compressed)


def record(kind, content):
    return struct.pack("<II", kind, len(content)) + content


OURS = record(0x41520001, b"analytic_rasterizer footprint moment:samples=16\nanalytic_rasterizer offset 1.5 -2.0 3.0")


@pytest.mark.parametrize("version", [2, 3, 4])
@pytest.mark.parametrize("degree", [0, 1, 3])
@pytest.mark.parametrize("flags, records", [(0, b""), (1, b""), (3, record(0xADBE0002, b"\1" * 12) + OURS)])
def test_an_spz_by_hand(tmp_path, version, degree, flags, records):
    scene = random_gaussians(degree=degree)
    (tmp_path / "a.Spz").write_bytes(spz_file(scene, version, flags, records))
    # Version 2 has 8 bits for x, y and z of a quaternion; w, which follows from them, may be small.
    # A file with lines of ours that names no axes is one of an earlier version, which wrote those of memory.
    found = io.load_scene(tmp_path / "a.Spz", axes="rdf" if not records else None)
    close(found, scene, turned=1e-2 if version == 2 else 1e-4)
    metadata = io.read_metadata(tmp_path / "a.Spz")
    assert metadata.antialiased is bool(flags & 1)
    assert metadata.footprint == ("moment:samples=16" if records else None)
    assert metadata.offset == ((1.5, -2.0, 3.0) if records else None)


@pytest.mark.parametrize("version", [3, 4])
def test_a_broken_spz(tmp_path, version):
    whole = spz_file(random_gaussians(), version)
    (tmp_path / "a.spz").write_bytes(whole)
    io.load_scene(tmp_path / "a.spz")
    for size in (0, 3, 10, 20, 33, 60, len(whole) // 2, len(whole) - 1):
        (tmp_path / "a.spz").write_bytes(whole[:size])
        with pytest.raises(io.SceneError, match=r"a\.spz: unreadable or cut short \("):
            io.load_scene(tmp_path / "a.spz")
        if size < 16:
            with pytest.raises(io.SceneError, match=r"a\.spz: "):
                io.read_metadata(tmp_path / "a.spz")
    if version == 4:
        (tmp_path / "a.spz").write_bytes(whole[:100] + bytes(byte ^ 0x55 for byte in whole[100:]))
        with pytest.raises(io.SceneError, match=r"a\.spz: unreadable or cut short \("):
            io.load_scene(tmp_path / "a.spz")


def test_a_library_that_is_missing_is_named_with_its_extra(tmp_path, monkeypatch):
    (tmp_path / "a.spz").write_bytes(spz_file(random_gaussians(degree=0), 4))
    (tmp_path / "a.sog").write_bytes(sog_file(random_gaussians(degree=0)))
    for module, name in (("zstandard", "a.spz"), ("PIL.Image", "a.sog")):
        monkeypatch.setitem(sys.modules, module, None)
        with pytest.raises(ImportError, match=rf'{module[:3]}\w*: pip install "analytic_rasterizer\[cli\]"'):
            io.load_scene(tmp_path / name)


def webp(pixels):
    """A lossless picture of (H, W, C) bytes."""
    file = memory.BytesIO()
    image.fromarray(pixels).save(file, "WEBP", lossless=True, exact=True)
    return file.getvalue()


def sog_file(scene, **meta):
    """A .sog of version 2, by its specification: pictures of one row, codebooks of 256 numbers."""
    count, files = scene.count, {}
    logs = (scene.means.sign() * scene.means.abs().log1p()).numpy().astype(np.float64)
    low, high = logs.min(0), logs.max(0)
    means = np.rint((logs - low) / (high - low) * 65535).astype(np.uint16)[None]

    def coded(values):
        book = np.linspace(values.min(), values.max(), 256)
        return book, np.rint((values - book[0]) / (book[-1] - book[0]) * 255).astype(np.uint8)

    scale_book, scales = coded(scene.log_scales.numpy())
    color_book, colors = coded(scene.shs[:, 0].numpy())
    quats = np.zeros((1, count, 4), np.uint8)
    for i, q in enumerate(torch.nn.functional.normalize(scene.rotations, dim=1).numpy()):
        largest = int(np.abs(q).argmax())
        rest = np.delete(q * np.sign(q[largest]), largest)
        quats[0, i] = [*np.rint((rest * math.sqrt(2) + 1) / 2 * 255), 252 + largest]
    alpha = np.rint(255 * scene.opacities.numpy()).astype(np.uint8)
    files["means_l.webp"], files["means_u.webp"] = ((means & 255).astype(np.uint8), (means >> 8).astype(np.uint8))
    files["scales.webp"], files["quats.webp"] = scales[None], quats
    files["sh0.webp"] = np.concatenate([colors, alpha], 1)[None]
    content = {
        "version": 2,
        "count": count,
        "means": {"mins": low.tolist(), "maxs": high.tolist(), "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": scale_book.tolist(), "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": color_book.tolist(), "files": ["sh0.webp"]},
    }
    if scene.sh_degree:  # every Gaussian has a centroid of its own
        rest = scene.shs[:, 1:].numpy()
        book, labels = coded(rest)
        bands = rest.shape[1]
        centroids = np.zeros((-(-count // 64), 64 * bands, 3), np.uint8)
        for i in range(count):
            centroids[i // 64, i % 64 * bands : (i % 64 + 1) * bands] = labels[i]
        files["shN_centroids.webp"] = centroids
        index = np.arange(count)
        files["shN_labels.webp"] = np.stack([index & 255, index >> 8, 0 * index], 1).astype(np.uint8)[None]
        content["shN"] = {"count": count, "bands": scene.sh_degree, "codebook": book.tolist()}
        content["shN"]["files"] = ["shN_centroids.webp", "shN_labels.webp"]
    archive = memory.BytesIO()
    with zipfile.ZipFile(archive, "w") as file:
        file.writestr("meta.json", json.dumps(content | meta))
        for name, pixels in files.items():
            file.writestr(name, webp(pixels))
    return archive.getvalue()


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_a_sog_by_hand(tmp_path, degree):
    scene = random_gaussians(count=80, degree=degree)
    (tmp_path / "a.SOG").write_bytes(sog_file(scene))
    close(io.load_scene(tmp_path / "a.SOG"), scene)


@pytest.mark.parametrize(
    "meta, antialiased",
    [({}, None), ({"antialias": True}, True), ({"antialias": False}, False), ({"model": "antialiased"}, True),
     ({"model": "2dgs"}, False), ({"antialias": "?"}, None)],
)  # fmt: skip
def test_the_tag_of_a_sog(tmp_path, meta, antialiased):
    (tmp_path / "a.sog").write_bytes(sog_file(random_gaussians(degree=0), **meta))
    assert io.read_metadata(tmp_path / "a.sog") == io.SceneMetadata(antialiased=antialiased)


@pytest.mark.parametrize(
    "meta",
    [{"version": 3}, {"count": 10**9}, {"count": "many"}, {"scales": {"codebook": [0.5]}}, {"sh0": 3}, {"means": {}}],
)
def test_a_broken_sog(tmp_path, meta):
    (tmp_path / "a.sog").write_bytes(sog_file(random_gaussians(degree=0), **meta))
    with pytest.raises(io.SceneError, match=r"a\.sog: (unreadable or cut short|expected )"):
        io.load_scene(tmp_path / "a.sog")
    for content in (b"", b"no archive", sog_file(random_gaussians(degree=0))[:-30]):
        (tmp_path / "a.sog").write_bytes(content)
        for read in (io.load_scene, io.read_metadata):
            with pytest.raises(io.SceneError, match=r"a\.sog: unreadable or cut short"):
                read(tmp_path / "a.sog")


def rearranged(path, change):
    """A compressed .ply as `change` makes it of its elements."""

    header = read_header(path)
    _, rows = read_rows(path, [element.name for element in header.elements])
    types = {code: kind for kind, code in TYPES.items() if kind in CODES}
    elements = []
    for element in header.elements:
        values = np.stack([rows[element.name].column(name) for name in element.names], 1)
        elements.append(
            Element(element.name, [(types[TYPES[p.kind]], p.name) for p in element.properties], values.tolist())
        )
    path.write_bytes(change(*elements))


def without_limits_of_colours(chunk, vertex, sh):
    """As earlier programs write it: colours are between 0 and 1."""
    return ply(cut(chunk, len(chunk.rows), 12), vertex, sh)


def cut(element, rows, columns=None):
    """The first rows and columns."""
    return Element(element.name, element.properties[:columns], [row[:columns] for row in element.rows[:rows]])


COMPRESSED = {
    "others before and behind": lambda c, v, s: ply(CAMERA, TRIANGLES, c, v, FLAGS, s, CAMERA),
    "another order": lambda c, v, s: ply(s, v, c),
    "big endian": lambda c, v, s: ply(c, v, s, layout="binary_big_endian"),
    "text": lambda c, v, s: ply(c, v, s, layout="ascii"),
    "comments": lambda c, v, s: ply(c, v, s, lines=["comment größe", "comment größe".encode("latin-1"), "obj_info ü"]),
    "other line ends": lambda c, v, s: ply(c, v, s, newline="\r\n"),
    "others beside": lambda c, v, s: ply(
        c, Element("vertex", [("uchar", "a"), *v.properties], [[1, *row] for row in v.rows]), s
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", COMPRESSED)
def test_compressed_scenes_whatever_the_file(tmp_path, name):
    """Elements are found by their names."""
    path = tmp_path / "a.compressed.ply"
    io.save_scene(path, random_gaussians(count=300, degree=1))
    expected = io.load_scene(path)
    rearranged(path, COMPRESSED[name])
    assert io.is_scene(path)
    for found, wanted in zip(io.load_scene(path), expected):
        assert torch.equal(found, wanted)


@pytest.mark.parametrize("degree", range(5))
def test_a_compressed_scene_is_what_gsply_reads_without_it(tmp_path, monkeypatch, degree):
    """It compiles for seconds, also before a broken file is refused."""
    path, scene = tmp_path / "a.compressed.ply", random_gaussians(count=3000, degree=degree)
    scene.logit_opacities[:2, 0] = torch.tensor([30.0, -30.0])  # bytes of 255 and 0
    io.save_scene(path, scene)
    expected = pytest.importorskip("gsply").decompress_from_bytes(path.read_bytes())
    monkeypatch.setitem(sys.modules, "gsply", None)
    found = io.load_scene(path)
    read = [(found.means, expected.means), (found.log_scales, expected.scales), (found.rotations, expected.quats)]
    read += [(found.shs[:, 0], expected.sh0), *([(found.shs[:, 1:], expected.shN)] if degree else [])]
    for own, other in read:
        assert own.shape == other.shape
        np.testing.assert_allclose(own, other, rtol=0, atol=2 * 4 * 8 * 2**-24)  # both: four roundings, below 8
    # Both: a share up to 1 - 1/255 is rounded, its inverse and the difference from 1 too, of which 1/255 is left.
    np.testing.assert_allclose(found.logit_opacities[:, 0], expected.opacities, rtol=0, atol=2 * 3 * 255 * 2**-24)


def test_a_compressed_scene_without_limits_of_colours(tmp_path):
    scene = random_gaussians(count=30, degree=1)
    scene = scene._replace(shs=scene.shs.clamp(-1.7, 1.7))
    scene.shs[:2, 0] = torch.tensor([[0.5], [-0.5]]) / 0.28209479177387814  # so that the limits are 0 and 1
    path = tmp_path / "a.ply"
    io.save_scene(tmp_path / "a.compressed.ply", scene)
    (tmp_path / "a.compressed.ply").rename(path)  # the header says what it is
    expected = io.load_scene(path)
    rearranged(path, without_limits_of_colours)
    assert (io.load_scene(path).shs - expected.shs).abs().max() < 1e-5


@pytest.mark.parametrize(
    "change, message",
    [
        (lambda c, v, s: ply(cut(c, 1), v, s), "a chunk for every 256 of 300 vertices, got 1"),
        (lambda c, v, s: ply(c, v, cut(s, 7)), "harmonics of 300 vertices in bytes, got 7"),
        (lambda c, v, s: ply(c, v, cut(s, 300, 7)), "0, 9, 24, 45 or 72 f_rest properties .*, got 7"),
        (lambda c, v, s: ply(c, cut(v, 300, 3), s), "packed_color once"),
        (lambda c, v, s: ply(c, v, s)[:-1], "cut short"),
        (lambda c, v, s: ply(c, v, s).replace(b"vertex 300", b"vertex 4000000000"), "that fits .* got 4000000000"),
    ],
)  # fmt: skip
def test_compressed_scenes_that_cannot_be_read(tmp_path, change, message):
    """More vertices than chunks were read from beyond the end of the memory."""
    path = tmp_path / "a.compressed.ply"
    io.save_scene(path, random_gaussians(count=300, degree=1))
    rearranged(path, change)
    with pytest.raises(io.SceneError, match=message) as caught:
        io.load_scene(path)
    assert str(caught.value).startswith(f"{path}: ")


# ------------------------------------------------------------------------ what a scene says of itself

HOLDING = ["a.ply", "a.compressed.ply", "a.spz", "a.sog", "a.glb", "a.gltf"]
METADATA = {
    "nothing": io.SceneMetadata(),
    "trained with moment": io.SceneMetadata(footprint="moment:samples=16"),
    "a default": io.SceneMetadata(footprint="box"),
    "as of 3DGS": io.SceneMetadata(footprint="point"),
    "another dilation": io.SceneMetadata(footprint="point:dilation=0.1"),
    "of another program": io.SceneMetadata(antialiased=True),
    "far away": io.SceneMetadata(footprint="moment", offset=(500000.123456789, -4.2e6, 1e-9)),
    "on paper": io.SceneMetadata(footprint="moment", background=(0.97, 0.96, 0.93)),
    "comments": io.SceneMetadata(comments=("made by hand", "  ", "a 'quoted' #1")),
}


@pytest.mark.parametrize("metadata", METADATA.values(), ids=METADATA)
@pytest.mark.parametrize("name", HOLDING)
def test_what_a_scene_says_comes_back(tmp_path, name, metadata):
    """Beside it lies one that says something else, and the file is copied away."""
    scene = random_gaussians(degree=1)
    io.save_scene(tmp_path / f"plain.{name}", scene)
    io.save_scene(tmp_path / name, scene, metadata)
    (tmp_path / "away").mkdir()
    copied = (tmp_path / name).rename(tmp_path / "away" / name)
    assert io.is_scene(copied)
    found, wanted = io.read_metadata(copied), metadata.checked()
    names = ("footprint", "offset", "background")
    assert [getattr(found, name) for name in names] == [getattr(wanted, name) for name in names]
    assert found.comments == tuple(comment.strip() for comment in wanted.comments)
    assert bool(found.antialiased) is bool(wanted.antialiased)
    plain = io.read_metadata(tmp_path / f"plain.{name}")
    assert plain == io.SceneMetadata(antialiased=False if name == "a.spz" else None)
    for field, same in zip(io.load_scene(copied), io.load_scene(tmp_path / f"plain.{name}")):
        assert torch.equal(field, same)
    io.save_scene(tmp_path / name, scene, found)  # what was read can be written, and is the same
    assert io.read_metadata(tmp_path / name) == found


def test_a_default_footprint_is_written_with_its_options(tmp_path):
    """Another version may have another default."""
    io.save_scene(tmp_path / "a.ply", random_gaussians(), io.SceneMetadata(footprint="box"))
    header = (tmp_path / "a.ply").read_bytes().partition(b"end_header")[0].decode().splitlines()
    assert header[2:4] == ["comment SplatRenderMode: mip", "comment analytic_rasterizer footprint box:samples=4"]
    io.save_scene(tmp_path / "a.ply", random_gaussians(), io.SceneMetadata(footprint="point"))
    assert b"SplatRenderMode" not in (tmp_path / "a.ply").read_bytes()


def test_other_programs_read_an_spz_with_an_extension(tmp_path):
    """The Gaussians come first, as in a file without one; then records that say their length."""
    scene = random_gaussians(degree=1)
    for name, metadata in (("a.spz", None), ("b.spz", io.SceneMetadata(footprint="moment"))):
        io.save_scene(tmp_path / name, scene, metadata)
    plain, tagged = (gzip.decompress((tmp_path / name).read_bytes()) for name in ("a.spz", "b.spz"))
    assert (plain[14], tagged[14]) == (2, 3)
    assert plain[:14] + plain[15:] == (tagged[:14] + tagged[15:])[: len(plain) - 1]
    kind, length = struct.unpack("<II", tagged[len(plain) : len(plain) + 8])
    assert kind >> 16 and len(tagged) == len(plain) + 8 + length


@pytest.mark.parametrize(
    "metadata, lost",
    [
        (io.SceneMetadata(footprint="moment"), r"the footprint \(`render --footprint moment:samples=4` shows"),
        (io.SceneMetadata(antialiased=True), r"the footprint \(`render --footprint mip` "),
        (io.SceneMetadata(footprint="point", offset=(1, 2, 3)), r"the offset \(1\.0, 2\.0, 3\.0\) of its positions"),
    ],
)
def test_a_splat_holds_no_metadata_and_saving_says_so(tmp_path, metadata, lost):
    with pytest.warns(UserWarning, match=rf"a\.splat: a \.splat does not hold {lost}"):
        io.save_scene(tmp_path / "a.splat", random_gaussians(degree=0), metadata)
    assert io.read_metadata(tmp_path / "a.splat") == io.SceneMetadata()


def test_a_splat_holds_no_harmonics_and_saving_says_so(tmp_path, recwarn):
    scene = random_gaussians(degree=2)
    with pytest.warns(UserWarning, match=r"not hold harmonics beyond degree 0 \(the scene has degree 2\)"):
        io.save_scene(tmp_path / "a.splat", scene)
    assert torch.equal(io.load_scene(tmp_path / "a.splat").means, scene.means)
    recwarn.clear()
    scene.shs[:, 1:] = 0
    io.save_scene(tmp_path / "a.splat", scene, io.SceneMetadata(footprint="point", offset=(0, 0, 0)))
    assert not recwarn.list  # nothing is lost


@pytest.mark.parametrize(
    "lines, expected",
    [
        (["SplatRenderMode: mip"], io.SceneMetadata(antialiased=True)),
        (["SplatRenderMode: default"], io.SceneMetadata(antialiased=False)),
        (["antialiased 1"], io.SceneMetadata(antialiased=True)),
        (["antialiased 0"], io.SceneMetadata(antialiased=False)),
        (["antialiased 0", "SplatRenderMode: mip"], io.SceneMetadata(antialiased=True)),  # the last one
        (["made for antialiased 1 screens"], io.SceneMetadata(comments=("made for antialiased 1 screens",))),
        (["analytic_rasterizer footprint point"], io.SceneMetadata("point:dilation=0.3", False)),
        (
            ["SplatRenderMode: mip", "analytic_rasterizer footprint box:samples=1"],
            io.SceneMetadata("box:samples=1", True),
        ),
        (["analytic_rasterizer  offset  1 -2e6   .5"], io.SceneMetadata(offset=(1.0, -2e6, 0.5))),
        (["größe"], io.SceneMetadata(comments=("größe",))),
    ],
)
@pytest.mark.parametrize("name", ["a.ply", "A.COMPRESSED.PLY"])
def test_comments_of_other_programs(tmp_path, name, lines, expected):
    path = tmp_path / name
    io.save_scene(path, random_gaussians())
    content = path.read_bytes()
    for newline in (b"\n", b"\r\n"):
        header, end, rows = content.partition(b"end_header\n")
        comments = "".join(f"comment {line}\n" for line in lines).encode()
        header = header.replace(b"element vertex", comments + b"element vertex")
        path.write_bytes((header + end).replace(b"\n", newline) + rows)
        assert io.read_metadata(path) == expected


@pytest.mark.parametrize(
    "line", ["footprint blob", "footprint", "footprint box:samples=3", "offset 1 2", "offset 1 2 x", "offset 1 2 nan"]
)
def test_lines_of_ours_that_make_no_sense_are_told(tmp_path, line):
    io.save_scene(tmp_path / "a.ply", random_gaussians(), io.SceneMetadata(antialiased=True, comments=("b",)))
    content = (tmp_path / "a.ply").read_bytes()
    (tmp_path / "a.ply").write_bytes(content.replace(b"comment b", b"comment analytic_rasterizer " + line.encode()))
    with pytest.warns(UserWarning, match=rf"a\.ply: 'analytic_rasterizer {line}' is not understood \("):
        assert io.read_metadata(tmp_path / "a.ply") == io.SceneMetadata(antialiased=True)
    assert io.load_scene(tmp_path / "a.ply").count == 40


@pytest.mark.parametrize(
    "metadata, message",
    [
        (io.SceneMetadata(footprint="blob"), "blob"),
        (io.SceneMetadata(footprint="box:samples=3"), "samples"),
        (io.SceneMetadata(offset=(1, 2)), "offset must be three finite numbers"),
        (io.SceneMetadata(offset=(1, 2, math.inf)), "offset must be three finite numbers"),
        (io.SceneMetadata(comments=("a\nb",)), "single lines of ASCII"),
        (io.SceneMetadata(comments=("ä",)), "single lines of ASCII"),
    ],
)
@pytest.mark.parametrize("name", [*HOLDING, "a.splat"])
def test_metadata_that_cannot_be_written(tmp_path, name, metadata, message):
    with pytest.raises(io.SceneError, match=rf"{name}: .*{message}"):
        io.save_scene(tmp_path / name, random_gaussians(degree=0), metadata)
    assert not list(tmp_path.iterdir())


def test_metadata_of_what_is_no_scene(tmp_path):
    with pytest.raises(io.SceneError, match=r"a\.ply: no such file"):
        io.read_metadata(tmp_path / "a.ply")
    for name, message in (("a.ply", "begin with 'ply'"), ("a.spz", "unreadable"), ("a.obj", r"expected a \.ply, ")):
        (tmp_path / name).write_bytes(b"nothing")
        with pytest.raises(io.SceneError, match=f"{name}: .*{message}"):
            io.read_metadata(tmp_path / name)


def test_a_column_with_a_3d_filter_is_named(tmp_path):
    """Mip-Splatting keeps its filter apart; without it the scene looks thinner."""
    io.save_scene(tmp_path / "plain.ply", random_gaussians(count=1, degree=0))
    content = (tmp_path / "plain.ply").read_bytes()
    content = content.replace(b"end_header", b"property float filter_3D\nend_header") + struct.pack("<f", 0.1)
    (tmp_path / "mip.ply").write_bytes(content)
    with pytest.warns(UserWarning, match=r"mip\.ply: the column filter_3D, a 3D filter, is not applied"):
        assert io.load_scene(tmp_path / "mip.ply").count == 1
