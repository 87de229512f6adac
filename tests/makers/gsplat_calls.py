"""Scenes and cameras as gsplat's call takes them, and the same pictures by our own rasterizer."""

import scenes
import torch
from scenes import Camera
from weights import weights

import analytic_rasterizer as ar
from analytic_rasterizer.dialects.gsplat import rasterization

WIDTH, HEIGHT = 45, 37
NEAR, FAR = 0.01, 1e10


def tolerance(dtype):
    """Of an image. In float32 a splat moves by the rounding of adding and removing half a pixel, twice 2^-19 px at
    45 px, which is 7e-6 of a weight with a standard deviation of 0.55 px; a pixel's weights add up to 1."""
    return 1e-12 if dtype == torch.float64 else 2e-5


def gradient_tolerance(dtype):
    """Of the norm of a gradient: those of two orders of summation, through a covariance in between."""
    return 1e-9 if dtype == torch.float64 else 2e-3


def as_gsplat_has_it(scene):
    """Inputs of our rasterizer by gsplat's names, but for colours."""
    names = {"means": "means3D", "quats": "rotations", "scales": "scales"}
    return {ours: scene[name] for ours, name in names.items()} | {"opacities": scene["opacities"][:, 0].contiguous()}


def smooth_call(channels):
    """Scene and cameras of a small call for gradcheck: no alpha is near a threshold."""
    cameras = cameras_of(torch.float64, "cpu")
    cameras["Ks"][:, :2] *= 0.2
    colors = weights((6, channels), torch.float64, "cpu")
    return as_gsplat_has_it(scenes.smooth_scene(5)) | {"colors": colors} | cameras


def scene_of(dtype, device, degree=0, count=40, seed=1):
    """In float64 any scene; in float32 one without an alpha so near to a threshold that rounding decides."""
    make = scenes.random_scene if dtype == torch.float64 else scenes.smooth_scene
    scene = scenes.cast(make(seed, count if dtype == torch.float64 else 6, degree), dtype, device)
    colors = scene["shs"] if degree else scene["shs"][:, 0].abs().contiguous()
    return as_gsplat_has_it(scene) | {"colors": colors}


def cameras_of(dtype, device, count=2):
    """viewmats and Ks, with a principal point beside the centre."""
    eyes = [(0.3, -0.2, -4.0), (1.2, 0.5, -3.4), (-0.8, 0.1, -3.8)][:count]
    viewmats = torch.stack([Camera(eye=eye).world_to_camera() for eye in eyes])
    K = torch.tensor([[37.5, 0, 20.0], [0, 36.0, 19.5], [0, 0, 1]], dtype=torch.float64)
    return {"viewmats": viewmats.to(device, dtype), "Ks": K.expand(count, 3, 3).to(device, dtype).contiguous()}


def render(scene, cameras, **options):
    return rasterization(**{**scene, **cameras, "width": WIDTH, "height": HEIGHT, **options})


def drop_in(scene, view, K, degree, footprint, means2D=None, background=None, **effects):
    """The same Gaussians in one camera by our own rasterizer."""
    settings = ar.camera_settings(
        view,
        WIDTH,
        HEIGHT,
        *(K[0, 0], K[1, 1], K[0, 2], K[1, 2]),
        sh_degree=degree or 0,
        bg=background,
        dtype=view.dtype,
        effects=ar.Effects(camera_gradients=True, off_center=True, near=NEAR, far=FAR, **effects),
        footprint=footprint,
    )
    colors = {"colors_precomp": scene["colors"]} if degree is None else {"shs": scene["colors"]}
    return ar.GaussianRasterizer(settings)(
        means3D=scene["means"],
        means2D=means2D,
        opacities=scene["opacities"],
        scales=scene["scales"],
        rotations=scene["quats"],
        **colors,
    )


def assert_gradients_close(actual, expected, dtype):
    for name in expected:
        error = (actual[name] - expected[name]).norm() / expected[name].norm().clamp_min(1e-30)
        assert error <= gradient_tolerance(dtype), (name, error.item())


def gradients(value, inputs):
    return dict(zip(inputs, torch.autograd.grad(value, list(inputs.values()))))
