"""`convert`: any format to any, turned, cut and thinned out, with what the scene says of itself."""

import gzip
import json
import struct

import pytest
import torch
from commands import command
from gaussians import random_gaussians

from analytic_rasterizer import io

NAMES = ["a.ply", "a.compressed.ply", "a.spz", "a.splat", "a.glb", "a.gltf", "a.sog", "meta.json"]


def test_any_format_to_any(tmp_path, capsys):
    """Round the circle of formats, the scene is where it was and of the colour that it had."""
    scene = random_gaussians(degree=0)
    io.save_scene(tmp_path / "start.ply", scene, io.SceneMetadata(footprint="box", background=(1, 1, 1)))
    last = tmp_path / "start.ply"
    for name in [name for name in NAMES if name != "a.splat"] + NAMES[:1]:  # which say their footprint
        target = tmp_path / "circle" / name
        assert command("convert", last, target) == 0
        assert io.read_metadata(target).footprint == "box:samples=4"
        assert io.read_metadata(target).background == (1, 1, 1)
        last = target
    found = io.load_scene(last)
    found, scene = (each.rows(each.means[:, 0].argsort()) for each in (found, scene))  # a .sog has another order
    assert (found.means - scene.means).abs().max() < 0.01
    assert (found.shs - scene.shs).abs().max() < 0.06
    out = capsys.readouterr().out.splitlines()
    assert (
        out[2] == f"{tmp_path / 'circle/a.spz'}: 40 Gaussians, harmonics of degree 0, axes rdf, footprint box:samples=4"
    )


@pytest.mark.parametrize("options, said", [("--sh-degree 0", 1), ("--scene-axes rdf", 0)])
def test_an_spz_that_says_no_axes(tmp_path, capsys, options, said):
    """Its format's documents say one thing, and SuperSplat does another."""
    scene, path = random_gaussians(degree=1), tmp_path / "a.spz"
    io.save_scene(path, scene)
    assert command("convert", path, tmp_path / "b.ply") == 0
    assert "says no axes" not in capsys.readouterr().out
    content = gzip.decompress(path.read_bytes())
    path.write_bytes(gzip.compress(content.replace(struct.pack("<III", 0xADBE0003, 4, 6), b"")))
    assert command("convert", path, tmp_path / "c.ply", options) == 0
    line = f"{path}: says no axes: read as rub; --scene-axes rdf if SuperSplat wrote it"
    assert capsys.readouterr().out.count(line) == said
    found = [io.load_scene(tmp_path / name).means[:, 1] for name in ("b.ply", "c.ply")]
    assert torch.equal(found[0], -found[1] if said else found[1])


@pytest.mark.parametrize("name", NAMES)
def test_gaussians_that_are_kept(tmp_path, capsys, name):
    """Those in the box, that are opaque enough: the row numbers are those of their harmonics."""
    scene = random_gaussians(degree=1)
    scene.shs[:, 0] = torch.linspace(-1.5, 1.5, scene.count)[:, None]
    io.save_scene(tmp_path / "scene.ply", scene)
    box = "-0.5,-inf,-0.75,2,1,inf"
    out = tmp_path / name
    with pytest.warns(UserWarning) if name == "a.splat" else pytest.MonkeyPatch.context():
        assert command("convert", tmp_path / "scene.ply", out, "--crop", box, "--min-opacity 0.25") == 0
    x, y, z = scene.means.T
    kept = (x >= -0.5) & (x <= 2) & (y <= 1) & (z >= -0.75) & (scene.opacities[:, 0] >= 0.25)
    assert 4 < kept.sum() < 36
    found = io.load_scene(out)
    found = found.rows(found.shs[:, 0, 0].argsort())  # as they were
    torch.testing.assert_close(found.shs[:, 0], scene.shs[kept, 0], rtol=0, atol=0.02)
    assert f"{name}: {int(kept.sum())} of 40 Gaussians, harmonics of degree" in capsys.readouterr().out


def test_degrees_and_axes(tmp_path):
    scene = random_gaussians(degree=4)
    io.save_scene(tmp_path / "scene.ply", scene)
    assert command("convert", tmp_path / "scene.ply", tmp_path / "a.glb", "--sh-degree 2 --axes RUB") == 0
    found = io.load_scene(tmp_path / "a.glb")
    assert torch.equal(found.shs, scene.shs[:, :9]) and torch.equal(found.means, scene.means)
    turned = io.load_scene(tmp_path / "a.glb", axes="rdf")
    assert torch.equal(turned.means, scene.means * torch.tensor([1.0, -1, -1]))
    # Not more than there are, and a file that does not say its axes.
    assert command("convert", tmp_path / "a.glb", tmp_path / "b.ply", "--sh-degree 3 --scene-axes rdf") == 0
    assert torch.equal(io.load_scene(tmp_path / "b.ply").means, turned.means)
    assert io.load_scene(tmp_path / "b.ply").sh_degree == 2


def test_what_lies_beside_a_scene_goes_along(tmp_path):
    record = {"options": {"footprint": "moment", "scales": [1]}, "background": [1, 1, 1]}
    (tmp_path / "options.json").write_text(json.dumps(record))
    io.save_scene(tmp_path / "scene.ply", random_gaussians(), io.SceneMetadata(footprint="moment"))
    assert command("convert", tmp_path, tmp_path / "out" / "a.spz") == 0
    assert io.read_metadata(tmp_path / "out" / "a.spz").background == (1, 1, 1)
    (tmp_path / "model").mkdir()
    (tmp_path / "model" / "cfg_args").write_text("Namespace(kernel_size=0.2, white_background=True)")
    io.save_scene(tmp_path / "model" / "a.ply", random_gaussians())
    assert command("convert", tmp_path / "model" / "a.ply", tmp_path / "b.glb") == 0
    found = io.read_metadata(tmp_path / "b.glb")
    assert (found.footprint, found.background) == ("mip:variance=0.2", (1, 1, 1))
    (tmp_path / "alone").mkdir()
    io.save_scene(tmp_path / "alone" / "c.ply", random_gaussians(), io.SceneMetadata(antialiased=True))
    assert command("convert", tmp_path / "alone" / "c.ply", tmp_path / "d.spz") == 0
    assert io.read_metadata(tmp_path / "d.spz") == io.SceneMetadata(antialiased=True)  # not which filter, as before


@pytest.mark.parametrize(
    "given, message",
    [
        ("{0}/a.ply {0}/b.obj", "b.obj: expected a .ply, "),
        ("{0}/none.ply {0}/b.ply", "none.ply: no such file"),
        ("{0}/a.ply {0}/b.ply --crop 5,5,5,6,6,6", "none of 40 Gaussians is left by --crop and --min-opacity"),
        ("{0}/a.ply {0}/b.ply --crop 1,1,1,0,2,2", "must be x0,y0,z0,x1,y1,z1, the lower corner first, got 1,1,1,0"),
        ("{0}/a.ply {0}/b.ply --crop -1,2", "must be x0,y0,z0,x1,y1,z1, the lower corner first, got -1,2"),
        ("{0}/a.ply {0}/b.ply --crop 0,0,0,1,1,nan", "must be x0,y0,z0,x1,y1,z1"),
        ("{0}/a.ply {0}/b.ply --min-opacity 2", "must be a number from 0 to 1, got 2"),
        ("{0}/a.ply {0}/b.ply --axes xyz", "invalid choice: 'xyz'"),
        ("{0}/a.ply {0}/b.spz", "b.spz: harmonics of degree 4 have no place"),
    ],
)
def test_errors_are_one_line(tmp_path, capsys, given, message):
    io.save_scene(tmp_path / "a.ply", random_gaussians(degree=4))
    try:
        assert command("convert", given.format(tmp_path)) == 2
    except SystemExit as ended:
        assert ended.code == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["a.ply"]


def test_bake_points_to_convert(tmp_path, capsys):
    io.save_scene(tmp_path / "a.ply", random_gaussians(), io.SceneMetadata(footprint="moment"))
    assert command("bake", tmp_path / "a.ply", "--out", tmp_path / "b.spz") == 2
    assert f"to write it as it is: convert {tmp_path / 'a.ply'} {tmp_path / 'b.spz'}" in capsys.readouterr().err


def test_the_scene_is_not_overwritten(tmp_path, capsys):
    io.save_scene(tmp_path / "a.ply", random_gaussians(degree=3))
    before = (tmp_path / "a.ply").read_bytes()
    (tmp_path / "b.ply").symlink_to("a.ply")
    for name in ("a.ply", "b.ply"):
        assert command("convert", tmp_path / "a.ply", tmp_path / name, "--sh-degree 0") == 2
        assert f"{name}: expected another file than the scene, which is not overwritten\n" in capsys.readouterr().err
    assert (tmp_path / "a.ply").read_bytes() == before
