"""`affine_error`: the number of its definition, what it does not depend on, and what is not seen."""

import math

import pytest
import torch

import analytic_rasterizer as ar
from analytic_rasterizer.analysis import affine
from analytic_rasterizer.analysis.affine import LIMIT, affine_error, bends
from analytic_rasterizer.cameras.rotations import rotation_matrices
from analytic_rasterizer.gaussians import Gaussians


def gaussians(means, scales, seed=0):
    generator = torch.Generator().manual_seed(seed)
    means = torch.as_tensor(means, dtype=torch.float64).reshape(-1, 3)
    turns = torch.randn(len(means), 4, dtype=torch.float64, generator=generator)
    ones = torch.ones(len(means), 1, dtype=torch.float64)
    scales = torch.as_tensor(scales, dtype=torch.float64).expand(len(means), 3)
    return Gaussians.from_activated(means, scales, turns, 0.5 * ones, ones[:, None].expand(-1, 1, 3))


def settings_of(lens=None, w2c=None, **options):
    w2c = torch.eye(4, dtype=torch.float64) if w2c is None else w2c
    effects = ar.Effects(lens=lens, **options)
    return ar.camera_settings(w2c, 64, 48, 50.0, 45.0, 30.0, 25.0, dtype=torch.float64, effects=effects)


def scattered(count=20, ahead=True):
    generator = torch.Generator().manual_seed(1)
    means = 4 * torch.randn(count, 3, dtype=torch.float64, generator=generator)
    if ahead:
        means[:, 2] = means[:, 2].abs() + 2
    return gaussians(means, 10 ** (-2 * torch.rand(count, 3, dtype=torch.float64, generator=generator)) / 2)


def pinhole(p):
    return torch.stack([50 * p[0] / p[2], 45 * p[1] / p[2]])


def fisheye(p):
    rho = torch.hypot(p[0], p[1])
    theta = torch.atan2(rho, p[2])
    return (theta * (1 + 0.05 * theta**2) / rho) * p[:2] * torch.tensor([50.0, 45.0], dtype=torch.float64)


@pytest.mark.parametrize(
    "lens, textbook", [(None, pinhole), (ar.Lens.fisheye([0.05]), fisheye)], ids=["pinhole", "fisheye"]
)
def test_definition(lens, textbook):
    """Jacobians by autograd of the formulas, the root of the inverse by eigenvectors."""
    scene = scattered(ahead=lens is None)
    found = affine_error(scene, settings_of(lens))
    for i, (mean, turn, scale) in enumerate(zip(scene.means, scene.rotations, scene.scales)):
        axes = rotation_matrices(turn) @ torch.diag(scale)
        at_centre = torch.autograd.functional.jacobian(textbook, mean)
        values, vectors = torch.linalg.eigh(at_centre @ axes @ axes.T @ at_centre.T + torch.eye(2).double() / 12)
        root = vectors @ torch.diag(values**-0.5) @ vectors.T
        changes = []
        for step in (*axes.T, *-axes.T):
            change = torch.autograd.functional.jacobian(textbook, mean + step) - at_centre
            changes.append((root @ change @ axes).norm().item() / math.sqrt(2))
        behind = lens is None and any(mean[2] + step[2] <= 0 for step in (*axes.T, *-axes.T))
        assert found[i].item() == (math.inf if behind else pytest.approx(max(changes), rel=1e-8))


def times(a, b):
    """Hamilton's product of quaternions (..., 4): the rotation b, then a."""
    (w, x, y, z), (p, q, r, s) = a.unbind(-1), b.unbind(-1)
    parts = w * p - x * q - y * r - z * s, w * q + x * p + y * s - z * r, w * r - x * s + y * p + z * q
    return torch.stack([*parts, w * s + x * r - y * q + z * p], -1)


def test_what_it_does_not_depend_on(monkeypatch):
    """World units, the frame of the world, how many rows are computed at a time."""
    scene, lens = scattered(ahead=False), ar.Lens.fisheye()
    expected = affine_error(scene, settings_of(lens))
    assert expected.isfinite().all() and (expected > 1e-6).all()
    larger = scene._replace(means=3 * scene.means, log_scales=scene.log_scales + math.log(3))
    torch.testing.assert_close(affine_error(larger, settings_of(lens)), expected, rtol=1e-9, atol=0)
    turn, shift = torch.tensor([0.5, -0.4, 0.7, 0.2]).double(), torch.tensor([1.0, -2.0, 0.5]).double()
    back = rotation_matrices(turn).T
    moved = scene._replace(
        means=scene.means @ back.T + shift, rotations=times(turn * torch.tensor([1, -1, -1, -1]), scene.rotations)
    )
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3], pose[:3, 3] = back.T, -back.T @ shift
    torch.testing.assert_close(affine_error(moved, settings_of(lens, pose)), expected, rtol=1e-9, atol=0)
    monkeypatch.setattr(affine, "_ROWS", 7)
    torch.testing.assert_close(affine_error(scene, settings_of(lens)), expected, rtol=1e-12, atol=0)


def test_small_splats_of_an_orthographic_camera_and_modified():
    """In proportion to the size of small splats. Zero where the map itself is affine. `scale_modifier` counts."""
    scene, settings = scattered(), settings_of()
    sizes = [scene._replace(log_scales=scene.log_scales + math.log(s)) for s in (1e-4, 1e-3)]
    # As small splats disappear in the pixel, the change of S is the pixel's alone: the number falls by size squared.
    small, larger = (affine_error(s, settings) for s in sizes)
    torch.testing.assert_close(larger / small, torch.full_like(small, 100.0), rtol=0.05, atol=0)
    parallel = ar.camera_settings(
        torch.eye(4).double(), 64, 48, 50.0, 45.0, dtype=torch.float64, effects=ar.Effects(orthographic=True)
    )
    assert (affine_error(scene, parallel) == 0).all()
    doubled = affine_error(scene, settings._replace(scale_modifier=2.0))
    same = affine_error(scene._replace(log_scales=scene.log_scales + math.log(2)), settings)
    torch.testing.assert_close(doubled, same, rtol=1e-9, atol=0)


@pytest.mark.parametrize("lens", [None, ar.Lens.perspective([-0.2]), ar.Lens.fisheye()], ids=["none", "fold", "wide"])
def test_what_is_not_seen(lens):
    """NaN behind the camera or the fold, or nearer than `near`; infinite where a step of the size ends there."""
    fold = math.atan(math.sqrt(1 / 0.6))  # of 1 - 0.2 r^2
    means = [[0, 0, 3.0], [1.0, 0, -3.0], [0, 0, 0.1], [3 * math.sin(fold + 0.02), 0, 3 * math.cos(fold + 0.02)]]
    error = affine_error(gaussians(means, 1e-3), settings_of(lens))
    wide = lens is not None and lens.model == "fisheye"
    folds = lens is not None and not wide
    assert error.isnan().tolist() == [False, not wide, True, folds]
    assert affine_error(gaussians([[0, 0, 3.0]], 8.0), settings_of(lens)).isfinite().item() == wide
    assert len(affine_error(gaussians([], 1.0), settings_of(lens))) == 0
    assert affine_error(gaussians([[0, 0, 0.1]], 1e-3), settings_of(lens, near=0.05)).isfinite().all()


@pytest.mark.parametrize("lens", [None, ar.Lens.perspective(), ar.Lens.fisheye(), "flat"], ids=str)
def test_what_bends_is_above_the_limit(lens, monkeypatch):
    """From tiny Gaussians to larger than their depth; with a pinhole the small ones are not looked at."""
    generator = torch.Generator().manual_seed(2)
    scales = scattered(3000).scales * 10 ** (2 * torch.rand(3000, 1, dtype=torch.float64, generator=generator))
    scene = gaussians(scattered(3000, ahead=False).means, scales)
    settings = settings_of(lens) if lens != "flat" else settings_of(orthographic=True)
    expected, looked_at = affine_error(scene, settings) > LIMIT, []
    monkeypatch.setattr(affine, "affine_error", lambda s, c: looked_at.append(len(s.means)) or affine_error(s, c))
    assert torch.equal(bends(scene, settings), expected)
    assert expected.any() == (lens != "flat") and not expected.all()
    is_pinhole = lens is None or lens == ar.Lens.perspective()
    assert (looked_at[0] < 2800) == is_pinhole


def test_the_bound_of_small_gaussians_holds():
    """What `bends` does not look at is below the limit, as far from the axis as it may be, with and without near."""
    generator = torch.Generator().manual_seed(3)
    rays = torch.randn(20000, 3, dtype=torch.float64, generator=generator)
    rays[:, 2] = 1
    rays[:, :2] *= 10 ** (2 * torch.rand(20000, 1, dtype=torch.float64, generator=generator) - 1)
    rays = rays[rays[:, :2].norm(dim=1) < affine._AHEAD]
    widths = torch.rand(len(rays), 3, dtype=torch.float64, generator=generator) ** 3
    widths[:, 0] = 1
    for size in (1.0, 1e4):
        scene = gaussians(size * rays, affine._SMALL * size * widths)
        assert (affine_error(scene, settings_of()) < LIMIT).all()
    assert math.sqrt(5 / 2) * affine._SMALL / (1 - affine._SMALL) ** 2 < LIMIT


def test_wrong_arguments():
    scene, settings = scattered(), settings_of()
    with pytest.raises(TypeError, match="scene must be Gaussians, got list"):
        affine_error([1], settings)
    with pytest.raises(TypeError, match="settings must be GaussianRasterizationSettings, got Lens"):
        affine_error(scene, ar.Lens.fisheye())
