"""What the repositories' own rasterizers take and export, and scenes as each of them takes them."""

import scenes
import torch
from scenes import Camera

import analytic_rasterizer as ar
from analytic_rasterizer import dialects

BASE = [
    "image_height", "image_width", "tanfovx", "tanfovy", "bg", "scale_modifier", "viewmatrix", "projmatrix",
    "sh_degree", "campos", "prefiltered", "debug",
]  # fmt: skip
FORWARD = ["means3D", "means2D", "opacities", "shs", "colors_precomp", "scales", "rotations", "cov3D_precomp"]
CAMERA = Camera(bg=(0.2, 0.5, 0.9), sh_degree=1, image_width=40, image_height=30)
COUNT = 25


def after(names, where, *new):
    """A list of names with others after one of them."""
    at = names.index(where) + 1
    return [*names[:at], *new, *names[at:]]


# What the repositories' own modules have: settings, arguments of forward, and further exports.
ORIGINALS = {
    "gs2023": (BASE, FORWARD, set()),
    "gs2024": ([*BASE, "antialiasing"], FORWARD, set()),
    "accel": ([*BASE, "antialiasing"], after(FORWARD, "opacities", "dc"), {"SparseGaussianAdam"}),
    "mip": (after(BASE, "tanfovy", "kernel_size", "subpixel_offset"), FORWARD, set()),
    "analytic": (BASE, FORWARD, set()),
    "depth": (BASE, [*FORWARD, "means2D_densify"], set()),
    "depth_alpha": (BASE, [*FORWARD], set()),
    "luiten": (BASE[:-1], FORWARD, set()),
    "monogs": (after(BASE, "projmatrix", "projmatrix_raw"), [*FORWARD, "theta", "rho"], set()),
    "scaffold": (BASE, FORWARD, set()),
    "langsplat": ([*BASE, "include_feature"], after(FORWARD, "colors_precomp", "language_feature_precomp"), set()),
    "grouping": (BASE, after(FORWARD, "shs", "sh_objs"), set()),
    "feature3dgs": (BASE, after(FORWARD, "colors_precomp", "semantic_feature"), set()),
    "mcmc": (BASE, FORWARD, {"compute_relocation"}),
    "lightgaussian": ([*BASE, "f_count"], FORWARD, set()),
    "mini": (BASE, FORWARD, set()),
}
THEIR_FILTER = {
    **dict.fromkeys(ORIGINALS, "point:dilation=0.3"),
    **dict.fromkeys(("gs2023", "gs2024", "accel", "analytic"), "analytic:frame_gradient=frozen"),
    "mip": "mip:variance=0.25",
}


def scene_of(device="cpu", dtype=torch.float32, seed=1, count=COUNT):
    return scenes.cast(scenes.random_scene(seed, count, 1), dtype, device)


def fields_of(name, device="cpu", dtype=torch.float32, camera=CAMERA, **changed):
    """Settings of a dialect by name."""
    fields = camera.fields(dtype, device)
    further = {
        "antialiasing": False,
        "kernel_size": 0.25,
        "subpixel_offset": torch.zeros(camera.image_height, camera.image_width, 2, device=device),
        "projmatrix_raw": camera.perspective().T.contiguous().to(device, dtype),
        "include_feature": False,
        "f_count": False,
    }
    return {key: {**fields, **further, **changed}[key] for key in ORIGINALS[name][0]}


def settings_of(name, device="cpu", dtype=torch.float32, **changed):
    keywords = {key: changed.pop(key) for key in ("footprint", "effects") if key in changed}
    settings = dialects.dialect_module(name).GaussianRasterizationSettings
    return settings(**fields_of(name, device, dtype, **changed), **keywords)


def arguments_of(name, device="cpu", dtype=torch.float32, **scene):
    """A scene as the rasterizer of a dialect takes it."""
    scene = {**scene_of(device, dtype), **scene}
    if name == "accel":
        scene["dc"], scene["shs"] = scene["shs"][:, :1], scene["shs"][:, 1:]
    if name == "feature3dgs":
        scene["semantic_feature"] = torch.linspace(0, 1, 5 * COUNT, device=device, dtype=dtype).reshape(COUNT, 1, 5)
    return scene


def render(name, device="cpu", dtype=torch.float32, scene=None, **changed):
    module = dialects.dialect_module(name)
    rasterizer = module.GaussianRasterizer(settings_of(name, device, dtype, **changed))
    return rasterizer(**(arguments_of(name, device, dtype) if scene is None else scene))


def plain(device="cpu", dtype=torch.float32, footprint=None, scene=None, camera=CAMERA, **effects):
    """(color, radii, Outputs) by the library."""
    effects = ar.Effects(**effects) if effects else None
    settings = camera.settings(dtype, device, footprint=footprint, effects=effects)
    made = ar.GaussianRasterizer(settings)(**(scene_of(device, dtype) if scene is None else scene))
    return (*made, None)[:3]


def probe(image):
    generator = torch.Generator().manual_seed(4)
    return torch.rand(image.shape, generator=generator, dtype=torch.float64).to(image) - 0.3


def relative_error(actual, expected):
    return ((actual - expected).norm() / expected.norm()).item()
