"""Scenes and cameras as gsplat's call takes them, and the same pictures by our own rasterizer."""

import pytest
import scenes
import torch
from scenes import Camera
from weights import weights

import analytic_rasterizer as ar
from analytic_rasterizer.dialects.gsplat import rasterization

WIDTH, HEIGHT = 45, 37
NEAR, FAR = 0.01, 1e10
BOTH_LAYOUTS = pytest.mark.parametrize("packed", [False, True], ids=["dense", "packed"])


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


def projected(reference, scene, cameras, mode, model="pinhole"):
    """What gsplat's reference says of every Gaussian in every camera; radii by the rule of gsplat's kernels."""
    covars, _ = reference._quat_scale_to_covar_preci(scene["quats"], scene["scales"], True, False)
    given = scene["means"], covars, cameras["viewmats"], cameras["Ks"], WIDTH, HEIGHT
    options = {"near_plane": NEAR, "far_plane": FAR, "camera_model": model}
    _, means2d, depths, conics, amplitudes = reference._fully_fused_projection(
        *given, **options, calc_compensations=mode == "antialiased"
    )
    opacities = scene["opacities"].expand(len(means2d), -1)
    opacities = opacities if amplitudes is None else opacities * amplitudes
    a, b, c = conics.unbind(-1)
    variances = torch.stack([c, a], -1) / (a * c - b * b)[..., None]  # of the inverse of the conic
    extent = (2 * (255 * opacities).log()).clamp(min=0).sqrt().clamp(max=3.33)
    radii = (extent[..., None] * variances.sqrt()).ceil()
    size = means2d.new_tensor([WIDTH, HEIGHT])
    drawn = ((radii > 0) & (means2d + radii > 0) & (means2d - radii < size)).all(-1)
    drawn &= (depths > NEAR) & (depths < FAR)
    radii = torch.where(drawn[..., None], radii, 0).int()
    names = ("means2d", "depths", "conics", "opacities", "radii")
    return dict(zip(names, (means2d, depths, conics, opacities, radii)))


def pixel_centres():
    """Rows and columns of all pixels (H, W), px."""
    return torch.meshgrid(*(torch.arange(n, dtype=torch.float64) + 0.5 for n in (HEIGHT, WIDTH)), indexing="ij")


def alphas_of(rows, camera, i):
    """(H, W) of one splat of what `projected` returns."""
    y, x = pixel_centres()
    (mean_x, mean_y), (a, b, c) = rows["means2d"][camera, i], rows["conics"][camera, i]
    dx, dy = x - mean_x, y - mean_y
    return rows["opacities"][camera, i] * torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)


def composited(rows, colors):
    """Images and alphas of what `projected` returns, by definition: splat after splat over all pixels."""
    images = torch.zeros(len(colors), HEIGHT, WIDTH, colors.shape[-1], dtype=torch.float64)
    rest = torch.ones(len(colors), HEIGHT, WIDTH, 1, dtype=torch.float64)
    for camera in range(len(colors)):
        open_ = torch.ones(HEIGHT, WIDTH, 1, dtype=torch.bool)
        for i in rows["depths"][camera].argsort():
            if rows["radii"][camera, i].min() == 0:
                continue
            alpha = alphas_of(rows, camera, i)[..., None]
            alpha = torch.where(alpha >= 1 / 255, alpha, 0)
            open_ = open_ & (rest[camera] * (1 - alpha) > 1e-4)
            alpha = torch.where(open_, alpha, 0)
            images[camera] += rest[camera] * alpha * colors[camera, i]
            rest[camera] *= 1 - alpha
    return images, 1 - rest


def trained(device, count=60, seed=0):
    """Parameters as gsplat's strategies expect them, and an optimiser for each."""
    scene = scenes.cast(scenes.random_scene(seed, count, degree=1, sigma=(0.05, 0.5)), torch.float32, device)
    params = as_gsplat_has_it(scene) | {"colors": scene["shs"]}
    params |= {"scales": params["scales"].log(), "opacities": params["opacities"].logit()}
    params = torch.nn.ParameterDict({name: torch.nn.Parameter(value) for name, value in params.items()})
    return params, {name: torch.optim.Adam([value], lr=1e-3) for name, value in params.items()}


def activated(params):
    """What `rasterization` renders of them."""
    scales, opacities = params["scales"].exp(), params["opacities"].sigmoid().reshape(-1)
    return {name: params[name] for name in ("means", "quats", "colors")} | {"scales": scales, "opacities": opacities}


def step_once(params, optimizers, cameras, before=lambda meta: None, **options):
    """One step of training towards grey; what `rasterization` returned."""
    images, alphas, meta = render(activated(params), cameras, sh_degree=1, **options)
    before(meta)
    (images - 0.5).square().mean().backward()
    for optimizer in optimizers.values():
        optimizer.step()
        optimizer.zero_grad(set_to_none=True)
    return images, alphas, meta
