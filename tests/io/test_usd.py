"""OpenUSD: files come back, turn as their prims say, and usd-core finds what the schema asks for."""

import math

import numpy as np
import pytest
import torch
from gaussians import random_gaussians
from test_axes import FRONT, covariance, one_gaussian
from test_gltf import turn

from analytic_rasterizer import io

pxr = pytest.importorskip("pxr", reason="needs the usd extra")
Gf = pytest.importorskip("pxr.Gf")
Usd = pytest.importorskip("pxr.Usd")
UsdGeom = pytest.importorskip("pxr.UsdGeom")
UsdVol = pytest.importorskip("pxr.UsdVol")


@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize("name", ["a.usd", "a.USDA", "a.usdc"])
def test_a_scene_comes_back_to_float32(tmp_path, name, degree):
    scene = random_gaussians(degree=degree)
    io.save_scene(tmp_path / name, scene, io.SceneMetadata(footprint="moment", comments=("by hand",)))
    found = io.load_scene(tmp_path / name, strict=True)
    assert torch.equal(found.means, scene.means) and torch.equal(found.shs, scene.shs)
    torch.testing.assert_close(found.rotations, scene.rotations, rtol=0, atol=1.2e-7)
    torch.testing.assert_close(found.log_scales, scene.log_scales, rtol=2e-7, atol=2e-7)
    torch.testing.assert_close(found.opacities, scene.opacities, rtol=2e-7, atol=1.2e-7)
    wanted = io.SceneMetadata(footprint="moment:samples=4", antialiased=True, comments=("by hand",))
    assert io.read_metadata(tmp_path / name) == wanted
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_the_stage_by_hand(tmp_path):
    """y-up, with x to the right: y and z change their signs. A quaternion's real part is its first argument."""
    io.save_scene(tmp_path / "a.usda", one_gaussian())
    stage = Usd.Stage.Open(str(tmp_path / "a.usda"))
    assert UsdGeom.GetStageUpAxis(stage) == "Y"
    prim = stage.GetDefaultPrim()
    assert prim.GetTypeName() == "ParticleField3DGaussianSplat"
    splat = UsdVol.ParticleField3DGaussianSplat(prim)
    assert splat.GetPositionsAttr().Get()[0] == Gf.Vec3f(1, -2, -3)
    quaternion = splat.GetOrientationsAttr().Get()[0]
    assert quaternion.real == pytest.approx(12 / 13)
    assert list(quaternion.imaginary) == pytest.approx([0, -3 / 13, -4 / 13])
    assert list(splat.GetScalesAttr().Get()[0]) == pytest.approx([math.exp(-1), math.exp(-2), math.exp(-3)])
    assert splat.GetOpacitiesAttr().Get()[0] == 0.5
    assert splat.GetRadianceSphericalHarmonicsDegreeAttr().Get() == 1
    found = [row[0] for row in splat.GetRadianceSphericalHarmonicsCoefficientsAttr().Get()]
    assert found == [0.5, -0.5, -FRONT, 0.125]


@pytest.mark.parametrize("up", ["Y", "Z"])
def test_prims_are_placed(tmp_path, up):
    """Turned, moved and made larger by the prim above; of a z-up stage y points forward and z up."""
    scene = random_gaussians(degree=0)
    io.save_scene(tmp_path / "a.usda", scene, axes="rdf")  # the numbers of the file are those of the scene
    stage = Usd.Stage.Open(str(tmp_path / "a.usda"))
    UsdGeom.SetStageUpAxis(stage, up)
    rotation, (x, y, z, w) = turn(2)
    prim = UsdGeom.Xformable(stage.GetDefaultPrim())
    prim.AddTranslateOp().Set(Gf.Vec3d(0.3, -0.2, 0.5))
    prim.AddOrientOp().Set(Gf.Quatf(w, x, y, z))
    prim.AddScaleOp().Set(Gf.Vec3f(2, 2, 2))
    stage.Save()
    found = io.load_scene(tmp_path / "a.usda", axes="rub")
    to_memory = np.diag([1.0, -1, -1]) if up == "Y" else np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    linear = torch.tensor(to_memory @ rotation)
    shift = torch.tensor(to_memory @ [0.3, -0.2, 0.5])
    wanted = 2 * scene.means.double() @ linear.T + shift
    torch.testing.assert_close(found.means.double(), wanted, rtol=0, atol=2e-6)
    torch.testing.assert_close(covariance(found), 4 * linear @ covariance(scene) @ linear.T, rtol=1e-4, atol=1e-6)


def test_numbers_of_half_precision(tmp_path):
    io.save_scene(tmp_path / "a.usda", one_gaussian())
    stage = Usd.Stage.Open(str(tmp_path / "a.usda"))
    splat = UsdVol.ParticleField3DGaussianSplat(stage.GetDefaultPrim())
    splat.GetPrim().RemoveProperty("positions")
    splat.CreatePositionshAttr([Gf.Vec3h(1, -2, -3)])
    stage.Save()
    assert io.load_scene(tmp_path / "a.usda").means.tolist() == [[1, 2, 3]]


@pytest.mark.parametrize(
    "change, message",
    [
        (lambda stage: stage.RemovePrim("/Splat"), "has no ParticleField3DGaussianSplat"),
        (lambda stage: stage.GetDefaultPrim().RemoveProperty("scales"), "/Splat: missing attribute scales"),
        (lambda stage: stage.GetDefaultPrim().GetAttribute("opacities").Set([0.5, 0.5]), "must have one length"),
        (lambda stage: stage.GetDefaultPrim().GetAttribute("radiance:sphericalHarmonicsDegree").Set(3), "unreadable"),
    ],
)
def test_what_is_refused(tmp_path, change, message):
    io.save_scene(tmp_path / "a.usda", one_gaussian())
    stage = Usd.Stage.Open(str(tmp_path / "a.usda"))
    change(stage)
    stage.Save()
    with pytest.raises(io.SceneError, match=rf"a\.usda: .*{message}"):
        io.load_scene(tmp_path / "a.usda")


def test_a_broken_file(tmp_path):
    (tmp_path / "a.usda").write_text("#usda 1.0\n(")
    for read in (io.load_scene, io.read_metadata):
        with pytest.raises(io.SceneError, match=r"a\.usda: unreadable"):
            read(tmp_path / "a.usda")
    with pytest.raises(io.SceneError, match="harmonics of degree 4"):
        io.save_scene(tmp_path / "b.usd", random_gaussians(degree=4))
    with pytest.raises(io.SceneError, match="a USD has no place for a scene without Gaussians"):
        io.save_scene(tmp_path / "b.usd", random_gaussians(0))
