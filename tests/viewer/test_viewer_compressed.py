"""Scenes of exported files: how far numbers and pictures are off, bytes, and the page's decoder against Python's."""

import json

import numpy as np
import pytest
import torch
from gaussians import make_view, of_inputs, random_gaussians
from node import run_node
from pages import gaussians_of, psnr, random_scene, rendered, turned_view

import demo
from analytic_rasterizer import io, viewer
from analytic_rasterizer.cameras.rotations import rotation_matrices
from analytic_rasterizer.gaussians import Gaussians
from analytic_rasterizer.viewer import compressed

PSNR = 50
BYTES = 45
"""Of the file, for a Gaussian of degree 3."""
HALF_ULP = 2.0**-24


def extreme_scene(degree=3):
    """Scales of 0 and from 1e-12 to 1e9, far outliers, turns of all lengths, opacities of 0 and 1, huge harmonics."""
    scene = random_gaussians(64, degree)
    generator = torch.Generator().manual_seed(1)
    scales = 10 ** (21 * torch.rand(64, 3, generator=generator) - 12)
    scales[0], scales[1, 0], scales[2] = 0, 0, 1
    means, opacities, rotations = scene.means.clone(), scene.opacities.clone(), scene.rotations.clone()
    means[3], means[4], means[5] = torch.tensor([3e9, -2e7, 1e-9]), -1e-20, 0
    opacities[:2] = torch.tensor([[0.0], [1.0]])
    rotations[6], rotations[7] = 0, torch.tensor([0.0, 0.0, 3e-8, 0.0])
    shs = scene.shs.clone()
    shs[8], shs[9], shs[10] = 60000, -1e-7, 3e-5
    return Gaussians.from_activated(means, scales, rotations, opacities, shs)


def round_trip(scene):
    """What is packed, in the order of the compressed scene, and what comes back; as `Gaussians`."""
    packed = viewer.pack_scene(scene, [make_view()])
    given = gaussians_of(packed)
    order = torch.from_numpy(compressed._morton_order(given.means.double().numpy()))
    back = gaussians_of(compressed.decompress(packed.meta, *compressed.compress(packed)))
    return Gaussians(*(field[order] for field in given)), back


def covariance_roots(scene):
    """R S of every Gaussian, (N, 3, 3): their products with their transposes are the covariances."""
    return rotation_matrices(scene.rotations.double()) * scene.scales.double()[:, None]


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_no_number_is_off_by_more_than_its_step(degree):
    given, back = round_trip(random_gaussians(3000, degree))
    assert back.shs.shape == given.shs.shape
    middle = given.scales.sort(dim=1).values[:, 1:2]
    # Half a step, which is at most a 64th of the rounded middle scale.
    assert ((back.means - given.means).abs() <= 2 ** (1 / 64) * middle / 128 + HALF_ULP * given.means.abs()).all()
    assert (back.opacities - given.opacities).abs().max() <= 0.5 / 255 + 2 * HALF_ULP
    # Seen from a Gaussian: scales are off by 1/64 octave. Of the quaternion three components are off by half a step,
    # 2^-7 / 2 by the ratio of scales rounded down to a power of two (and w follows, at most half as much): angles by
    # 2 sqrt(3) of it, and their effect grows by the ratio. 2^(1/32) is for the rounding of the ratio. Ratios beyond 64
    # have no finer step.
    roots, others = covariance_roots(given), covariance_roots(back)
    scales = given.scales.sort(dim=1).values
    fits = scales[:, 2] < 2**5 * scales[:, 0]
    assert fits.sum() > 2900
    ratios = torch.linalg.svdvals(torch.linalg.solve(roots[fits], others[fits]))
    turned = 2 * 3**0.5 * 2 ** (1 / 32) * 2 * 2**-8 * 1.2
    assert ratios.log().abs().max() <= np.log(2) / 64 + turned
    # The colour in any direction: harmonics are off by half a step each, of three mixtures.
    step = 1 / 112 / given.opacities.clamp_min(64 / 255)[:, :, None]
    off = ((back.shs - given.shs).abs() - 2**-11 * given.shs.abs()) / step
    assert off.max() <= 0.5 * 3**0.5 * (1 + 0.5 / 64)


@pytest.mark.parametrize("degree", [0, 3])
def test_numbers_of_any_size_survive(degree):
    given, back = round_trip(extreme_scene(degree))
    assert all(bool(getattr(back, name).isfinite().all()) for name in ("means", "scales", "rotations", "shs"))
    assert torch.equal(back.opacities[given.opacities == 1], torch.ones(1))
    assert torch.equal(back.opacities[given.opacities == 0], torch.zeros(1))
    assert (back.rotations.norm(dim=1) - 1).abs().max() <= 4 * HALF_ULP
    middle = given.scales.sort(dim=1).values[:, 1:2]
    finest = 2.0**-44 * 2 * given.means.abs().max()
    bound = 2 ** (1 / 64) * (middle / 128).clamp_min(finest) + HALF_ULP * given.means.abs()
    assert ((back.means - given.means).abs() <= bound).all()


def assert_near(given, views, footprint, background=(0.0, 0.0, 0.0)):
    packed = viewer.pack_scene(given, views, footprint=footprint)
    back = gaussians_of(compressed.decompress(packed.meta, *compressed.compress(packed)))
    for view in views:
        ours, expected = (rendered(scene, view, footprint, background) for scene in (back, given))
        assert psnr(ours, expected) >= PSNR, (view.name, view.width)


@pytest.mark.parametrize("footprint", ["analytic", "point", "moment", "box"])
def test_pictures_of_the_demo(footprint):
    scene, view = demo.make_target()
    assert_near(scene, [view, view.scaled(0.25)], footprint, demo.PAPER)


def test_pictures_of_random_gaussians():
    assert_near(random_scene(), [turned_view(), turned_view().scaled(0.25)], "analytic")


def test_bytes_of_random_gaussians():
    scene = random_scene(20_000)
    scene.shs[:, 1:] *= 0.4  # as strong as those of the potted plant, in no order
    _, data = compressed.compress(viewer.pack_scene(scene))
    assert 4 / 3 * len(data) <= BYTES * len(scene.means)


def test_bytes_and_pictures_of_a_trained_scene(tmp_path, plant):
    inputs, cameras = plant
    scene, views = of_inputs(inputs), []
    for k, camera in enumerate(cameras):
        w2c = torch.tensor(camera["w2c"], dtype=torch.float64).reshape(4, 4)
        views.append(io.View(str(k), camera["width"], camera["height"], camera["fx"], camera["fy"], w2c))
    size = viewer.export_page(tmp_path / "scene.html", viewer.pack_scene(scene, views))
    assert size <= BYTES * len(scene.means)
    assert_near(scene, [views[0], *(view.scaled(0.25) for view in views)], "analytic")


DECODE = """
import { readFileSync, writeFileSync } from 'node:fs';
import { decompress } from './compressed.js';
const meta = JSON.parse(readFileSync('meta.json', 'utf8'));
const bytes = await new Response(
  new Blob([readFileSync('columns')]).stream().pipeThrough(new DecompressionStream('gzip'))).arrayBuffer();
const { geometry, harmonics } = decompress(meta, bytes);
writeFileSync('geometry', geometry);
writeFileSync('harmonics', harmonics);
console.log(JSON.stringify(geometry.length));
"""


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("make", [random_scene, extreme_scene])
def test_the_page_decodes_as_python_does(tmp_path, make, degree):
    packed = viewer.pack_scene(make(degree=degree), [make_view()])
    made, data = compressed.compress(packed)
    (tmp_path / "columns").write_bytes(data)
    (tmp_path / "meta.json").write_text(json.dumps(packed.meta | {"compressed": made}))
    run_node(tmp_path, ["compressed.js"], DECODE)
    back = compressed.decompress(packed.meta, made, data)
    ours, theirs = (
        np.frombuffer(b, "<f4").reshape(-1, 12) for b in ((tmp_path / "geometry").read_bytes(), back.geometry)
    )
    np.testing.assert_array_equal(np.delete(ours, [4, 5, 6], axis=1), np.delete(theirs, [4, 5, 6], axis=1))
    # Powers that are no whole ones may be rounded differently.
    np.testing.assert_allclose(ours[:, 4:7], theirs[:, 4:7], rtol=2 * HALF_ULP, atol=0)
    assert (tmp_path / "harmonics").read_bytes() == back.harmonics
