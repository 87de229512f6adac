"""Functions of the originals beside the rasterizer: relocation, and those of the compiled module."""

import math

import pytest
import scenes
import torch
from originals import CAMERA, COUNT, plain, probe, scene_of

import analytic_rasterizer as ar

pytestmark = pytest.mark.usefixtures("nothing_chosen")


# --- relocation ---------------------------------------------------------------------------------


def test_relocation_against_the_paper(device):
    """[MCMC, Eq. 9] summed term by term with exact integers, for opacities up to the largest below 1."""
    opacity = torch.tensor([0.0, 1e-6, 0.005, 0.3, 0.7, 0.97, 1 - 2.0**-20, 1.0], dtype=torch.float64)
    scales = torch.full((8, 3), 2.0, dtype=torch.float64, device=device)
    for n in (1, 2, 7, 50):
        new, scale = ar.compute_relocation(opacity.to(device), scales, torch.full((8,), n, device=device))
        for i, o in enumerate(opacity.clamp(max=1 - 2.0**-24).tolist()):
            o_new = -math.expm1(math.log1p(-o) / n)
            places = [(i, k) for i in range(1, n + 1) for k in range(i)]
            terms = [math.comb(i - 1, k) * (-1) ** k / math.sqrt(k + 1) * o_new ** (k + 1) for i, k in places]
            factor = 1.0 if o == 0 else o / math.fsum(terms)
            # The terms cancel: up to (1 + o_new)^n of them for a sum of about o.
            tolerance = 1e-15 * n * (1 + o_new) ** n / max(o, o_new, 1e-300) if o else 0
            assert math.isclose(new[i], o_new, rel_tol=1e-13, abs_tol=1e-300)
            assert all(math.isclose(s, 2 * factor, rel_tol=1e-13 + tolerance * 10) for s in scale[i].tolist())


def test_relocation_keeps_the_centre(device):
    """N Gaussians of the new opacity let as much light through their centre as the old one."""
    opacity = torch.linspace(0.01, 0.99, 20, device=device)[:, None]
    count = torch.arange(1, 21, device=device)[:, None]
    scale = torch.rand(20, 3, device=device)
    new_opacity, new_scale = ar.compute_relocation(opacity, scale, count, torch.zeros(51, 51, device=device), 51)
    assert new_opacity.shape == (20, 1) and new_scale.shape == (20, 3) and new_scale.dtype == torch.float32
    assert torch.allclose((1 - new_opacity) ** count, 1 - opacity, atol=2e-6)
    assert torch.equal(new_scale[0], scale[0]) and torch.equal(new_opacity[0], opacity[0].clamp(max=1))
    clamped = ar.compute_relocation(opacity, scale, count * 0, None, 51)
    assert torch.equal(clamped[1], scale)


def test_relocation_of_wrong_inputs():
    opacity, scale, count = torch.rand(4), torch.rand(4, 3), torch.ones(4, dtype=torch.int64)
    for wrong, error, message in [
        ((opacity, scale[:3], count), ValueError, r"scale_old must have shape \(4, 3\), got \(3, 3\)"),
        ((opacity, scale, count[:3]), ValueError, r"N must have shape \(4,\) or \(4, 1\), got \(3,\)"),
        ((opacity, scale, count.float()), TypeError, "N must be of integers, got torch.float32"),
        ((opacity.tolist(), scale, count), TypeError, "opacity_old must be a tensor, got list"),
        ((opacity, scale, count, None, 0), ValueError, "n_max must be at least 1, got 0"),
        ((opacity, scale, count, None, 1001), ValueError, "n_max must be at most 1000, got 1001"),
        ((opacity, scale, count, None, 2.5), ValueError, "n_max must be a whole number, got 2.5"),
        ((opacity.long(), scale, count), TypeError, "opacity_old must have a floating-point dtype, got torch.int64"),
        ((opacity, scale.int(), count), TypeError, "scale_old must have a floating-point dtype, got torch.int32"),
        ((opacity, scale, count + 0j), TypeError, "N must be of integers, got torch.complex64"),
    ]:
        with pytest.raises(error, match=message):
            ar.compute_relocation(*wrong)
    assert [len(t) for t in ar.compute_relocation(opacity[:0], scale[:0], count[:0])] == [0, 0]


# --- the compiled module's functions ------------------------------------------------------------


def native_arguments(device, scene, fields):
    empty = torch.Tensor([])
    pick = lambda name: scene.get(name, empty)  # noqa: E731
    f = fields
    return (
        f["bg"], scene["means3D"], pick("colors_precomp"), scene["opacities"], pick("scales"), pick("rotations"),
        f["scale_modifier"], pick("cov3D_precomp"), f["viewmatrix"], f["projmatrix"], f["tanfovx"], f["tanfovy"],
        f["image_height"], f["image_width"], pick("shs"), f["sh_degree"], f["campos"], False, False,
    )  # fmt: skip


@pytest.mark.parametrize("inputs", ["harmonics", "precomputed"])
def test_native_functions(device, inputs):
    from diff_gaussian_rasterization import _C

    scene = scenes.random_scene(1, COUNT, 1)
    if inputs == "precomputed":
        scene = scenes.with_precomputed(scene)
    scene = scenes.cast(scene, torch.float32, device)
    fields = CAMERA.fields(torch.float32, device)
    arguments = native_arguments(device, scenes.without(scene, "means2D"), fields)
    count, color, radii, *buffers = _C.rasterize_gaussians(*arguments)
    leaves = scenes.leaves(scene)
    expected, expected_radii, _ = plain(device, scene=leaves)
    assert torch.equal(color, expected) and torch.equal(radii, expected_radii)
    assert count >= (radii > 0).sum() and isinstance(count, int) and all(torch.is_tensor(b) for b in buffers)
    weights = probe(color)
    (expected * weights).sum().backward()
    ar.set_default_footprint("point")  # the backward pass is of what was rendered
    bg, means3D, colors, _, scales, rotations, modifier, cov, view, proj, tx, ty, _, _, sh, degree, campos, *_ = (
        arguments
    )
    made = _C.rasterize_gaussians_backward(
        bg, means3D, radii, colors, scales, rotations, modifier, cov, view, proj, tx, ty, weights, sh, degree, campos,
        buffers[0], count, buffers[1], buffers[2], False,
    )  # fmt: skip
    names = ("means2D", "colors_precomp", "opacities", "means3D", "cov3D_precomp", "shs", "scales", "rotations")
    for name, gradient in zip(names, made):
        if name in leaves:
            assert torch.equal(gradient, leaves[name].grad), name
        else:
            assert len(gradient) == COUNT and (gradient == 0).all()
    assert _C.mark_visible(means3D, view, proj).all() and not _C.mark_visible(means3D * 0 - 10, view, proj).any()


def test_native_functions_without_gaussians(device):
    from diff_gaussian_rasterization import _C

    scene = {name: value[:0] for name, value in scene_of(device).items()}
    fields = CAMERA.fields(torch.float32, device)
    count, color, radii, *buffers = _C.rasterize_gaussians(*native_arguments(device, scene, fields))
    assert count == 0 and len(radii) == 0 and (color[0] == fields["bg"][0]).all()
    empty, f = torch.Tensor([]), fields
    made = _C.rasterize_gaussians_backward(
        f["bg"], scene["means3D"], radii, empty, scene["scales"], scene["rotations"], 1.0, empty, f["viewmatrix"],
        f["projmatrix"], 0.6, 0.5, probe(color), scene["shs"], 1, f["campos"], buffers[0], 0, buffers[1], buffers[2],
        False,
    )  # fmt: skip
    assert [tuple(g.shape) for g in made] == [(0, 3), (0, 3), (0, 1), (0, 3), (0, 6), (0, 4, 3), (0, 3), (0, 4)]
