"""Gradients of the camera, other projections, the lens and the shutter, on every device."""

import pytest
import reference
import scenes
import torch
from scenes import KINDS, Camera, name_of

import analytic_rasterizer as ar

each_kind = pytest.mark.parametrize("variant", KINDS, ids=name_of)
CAMERA = Camera(image_height=27, image_width=35, sh_degree=1, shift=(2.3, -1.4))
LENS = ar.Defocus(aperture=0.15, focus=3.1)
SHUTTER = ar.Motion(0.1, velocity=(0.9, -0.6, 1.1), angular_velocity=(0.3, 0.5, -0.8), screen_velocity=(6.0, -9.0))
# Each alone, then together: the chain rule of one meets that of the others.
EFFECTS = {
    "gradients": {},
    "off_center": {"off_center": True},
    "orthographic": {"orthographic": True},
    "near_far": {"near": 3.0, "far": 4.2},
    "defocus": {"defocus": LENS},
    "motion": {"motion": SHUTTER},
    "both_blurs": {"defocus": LENS, "motion": SHUTTER},
    "orthographic_blurs": {"orthographic": True, "defocus": ar.Defocus(0.07, 3.1), "motion": SHUTTER},
}
CAMERA_INPUTS = ("viewmatrix", "projmatrix", "campos", "tanfovx", "tanfovy")


def settings_of(effects, footprint, options, dtype=torch.float64, device="cpu", camera=CAMERA, **fields):
    """Settings with gradients to the camera, and its tensors, which are leaves."""
    settings = camera.settings(dtype, "cpu", footprint=footprint, **options)._replace(**fields)
    if effects.get("orthographic"):
        settings = orthographic(settings, camera)
    tensors = {name: getattr(settings, name) for name in CAMERA_INPUTS}
    leaves = {k: torch.as_tensor(v, dtype=dtype).to(device).requires_grad_() for k, v in tensors.items()}
    settings = scenes.settings_to(settings, device)._replace(**leaves)
    return settings._replace(effects=ar.Effects(camera_gradients=True, **effects)), leaves


def orthographic(settings, camera):
    """The same view without perspective, as large at a depth of 3."""
    half = (3 * camera.tanfovx, 3 * camera.tanfovy)
    projection = torch.diag(torch.tensor([1 / half[0], 1 / half[1], 0.01, 1], dtype=torch.float64))
    projection[0, 3], projection[1, 3] = 2 * camera.shift[0] / camera.image_width, -0.1
    matrix = (projection @ camera.world_to_camera()).T.contiguous().to(settings.projmatrix)
    return settings._replace(tanfovx=half[0], tanfovy=half[1], projmatrix=matrix)


def render_both(scene, settings, variant, dtype, device):
    """Images by the library and by the reference, from leaves of their own: (image, reference), (leaves, ...)."""
    footprint, options = variant
    leaves = scenes.leaves(scenes.to(scenes.cast(scene, dtype), device))
    image, radii = ar.GaussianRasterizer(settings)(**leaves)
    exact = scenes.leaves(scene)
    fields = {name: getattr(settings, name).detach().cpu().double().requires_grad_() for name in CAMERA_INPUTS}
    theirs = settings._replace(bg=settings.bg.cpu().double(), **fields)
    kwargs = dict(options)
    if footprint == "adaptive":
        kwargs["tile_samples"] = torch.full((2, 3), 16)
    expected = reference.render(theirs, **exact, footprint=footprint, **kwargs)
    return (image, expected), (leaves, exact), fields, radii


@each_kind
@pytest.mark.parametrize("name", EFFECTS)
def test_matches_the_reference(device, best, variant, name):
    """The image, and the gradient by everything, against autograd through the plain formulas."""
    if variant[0] == "adaptive":
        variant = ("adaptive", {"tolerance": 1e-9})  # 16 samples everywhere
    smooth = variant[1].get("frame_gradient") != "frozen" and variant[0] != "analytic"
    scene = scenes.random_scene(21, 24, degree=1, sigma=(0.02, 0.4))
    scene["shs"] = scene["shs"] * 0.3  # colours away from the clamp at zero
    settings, camera = settings_of(EFFECTS[name], *variant, dtype=best, device=device)
    (image, expected), (leaves, exact), theirs, radii = render_both(scene, settings, variant, best, device)
    if name == "near_far":
        z = expected.projection.depths
        assert (radii.cpu()[(z < 3) | (z > 4.2)] == 0).all() and (radii > 0).sum() > 5
    # Pixels that are near a threshold may fall to its other side in float32.
    clear = expected.pixel_margin > (1e-4 if best == torch.float32 else 1e-9)
    tolerance = {torch.float64: 1e-10, torch.float32: 2e-5}[best]
    assert ((image.detach().cpu() - expected.color.detach()).abs() * clear).max() < tolerance
    if not smooth:
        return
    g = torch.rand(image.shape, generator=torch.Generator().manual_seed(3), dtype=torch.float64) * clear
    (image * g.to(image)).sum().backward()
    (expected.color * g).sum().backward()
    for pair in ((leaves, exact), (camera, theirs)):
        for key in pair[0]:
            if key == "means2D":
                continue
            ours, want = pair[0][key].grad.cpu().double(), pair[1][key].grad
            want = torch.zeros_like(ours) if want is None else want
            scale = want.abs().max() + 1e-3
            # Gradients of a camera are sums over all Gaussians, of both signs.
            assert (ours - want).abs().max() < scale * (1e-8 if best == torch.float64 else 3e-3), key
