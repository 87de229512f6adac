"""Under torch.autocast inputs of 16 bits are used in float32, as torch's own operators do that need it; elsewhere they
are refused with the way out."""

import pytest
import torch
from marks import needs_newer_compiler
from originals import CAMERA, COUNT, ORIGINALS, arguments_of, fields_of, scene_of
from scenes import to, without

import analytic_rasterizer as ar
from analytic_rasterizer import dialects, distributed
from analytic_rasterizer.dialects.gsplat import rasterization

pytestmark = pytest.mark.usefixtures("nothing_chosen")

each_half = pytest.mark.parametrize("half", [torch.bfloat16, torch.float16])
SIZE = CAMERA.image_height, CAMERA.image_width
CAMERA_TENSORS = ("bg", "viewmatrix", "projmatrix", "campos", "projmatrix_raw")


def settings_with(given, **options):
    """Those of the camera, with the tensors of `given` that have names of theirs, which are taken out of it."""
    fields = {key: given.pop(key) for key in CAMERA_TENSORS if key in given}
    return CAMERA.settings(torch.float32, next(iter(given.values())).device, **options)._replace(**fields)


def scene(device):
    return scene_of(device) | {"means2D": torch.zeros(COUNT, 3, device=device)}


def with_camera(device):
    fields = CAMERA.fields(torch.float32, device)
    return scene(device) | {key: fields[key] for key in CAMERA_TENSORS if key in fields}


def rasterizer(given):
    return ar.GaussianRasterizer(settings_with(given))(**given)


def effects(given):
    """What Python computes with inputs itself: the filter, the lens, the depths."""
    width, aperture = given.pop("width"), given.pop("aperture")
    flags = dict.fromkeys(("depth", "median_depth", "gaussian_stats", "camera_gradients", "off_center"), True)
    some = ar.Effects(**flags, filter_3d=width, defocus=ar.Defocus(aperture, 3.0))
    color, radii, outputs = ar.GaussianRasterizer(settings_with(given, effects=some))(**given)
    return color, radii, outputs.depth, outputs.median_depth, *outputs.gaussian_stats


def function(given):
    settings = settings_with(given)
    names = "means3D", "means2D", "shs", "colors_precomp", "opacities", "scales", "rotations", "cov3D_precomp"
    return ar.rasterize_gaussians(*(given.get(name) for name in names), settings)


def stages(given):
    features, behind = given.pop("features"), given.pop("behind")
    settings = settings_with(given, footprint="box:samples=16")
    splats = ar.project(settings, **without(given, "means2D"))
    lists = ar.list_tiles(splats)
    features = features[splats.gaussian_ids.long()]
    return (*ar.blend(splats, lists, features, behind), splats.means2d, splats.cov2d)


def timed_stages(given):
    return ar.render_stages(settings_with(given), **without(given, "means2D"))[:5]


def gsplat(given):
    given["quats"], given["means"] = given.pop("rotations"), given.pop("means3D")
    given["colors"], given["opacities"] = given.pop("shs"), given["opacities"][:, 0]
    del given["means2D"]
    images, alphas, meta = rasterization(**given, width=40, height=30, sh_degree=1, render_mode="RGB+ED", packed=False)
    return images, alphas, meta["depths"], meta["conics"]


def cameras_of_gsplat(device):
    intrinsics = torch.tensor([[[33.0, 0.0, 20.0], [0.0, 31.0, 15.0], [0.0, 0.0, 1.0]]], device=device)
    view, behind = CAMERA.world_to_camera().to(device, torch.float32)[None], torch.tensor([[0.2, 0.4, 0.6]])
    return {"viewmats": view, "Ks": intrinsics, "backgrounds": behind.to(device)}


def of_one_rank(given):
    batch = distributed.rasterize([settings_with(given)], **without(given, "means2D"))
    return batch.renderings[0].image, batch.renderings[0].alpha


def bands(given):
    band = distributed.rasterize_bands(settings_with(given), **without(given, "means2D"))
    return band.image, band.alpha


def pictures(device):
    generator = torch.Generator().manual_seed(3)
    return {name: torch.rand(3, 13, 17, generator=generator).to(device) for name in ("image", "target")}


def parameters(device):
    generator = torch.Generator().manual_seed(3)
    sizes = {"log_scales": 3, "quats": 4, "logit_opacities": 1}
    return {name: torch.randn(9, size, generator=generator).to(device) for name, size in sizes.items()}


def splats(device):
    given = {"offset": [[0.3, -0.2], [0.1, 0.7]], "cov2d": [[0.7, 0.1, 0.9]]}
    return {name: torch.tensor(values, device=device) for name, values in given.items()}


def with_blur(device):
    return to(with_camera(device) | {"width": torch.full((COUNT,), 0.01), "aperture": torch.tensor(0.1)}, device)


def with_features(device):
    return to(with_camera(device) | {"features": torch.rand(COUNT, 3), "behind": torch.rand(3)}, device)


def filtered(given):
    return ar.apply_3d_filter(given["scales"], given["opacities"], given["width"])


# A call of a dictionary of inputs, and the inputs by device.
CALLS = {
    "rasterizer": (rasterizer, with_camera),
    "effects": (effects, with_blur),
    "image behind": (rasterizer, lambda d: scene(d) | {"bg": torch.rand(3, *SIZE, device=d)}),
    "function": (function, with_camera),
    "stages": (stages, with_features),
    "timed stages": (timed_stages, with_camera),
    "gsplat": (gsplat, lambda d: scene(d) | cameras_of_gsplat(d)),
    "one rank": (of_one_rank, with_camera),
    "bands": (bands, with_camera),
    "l1_ssim": (lambda given: (ar.losses.l1_ssim(given["image"], given["target"].detach()),), pictures),
    "ssim": (lambda given: (ar.losses.ssim(given["image"], given["target"].detach(), "none"),), pictures),
    "activations": (lambda given: ar.activations.activate(**given), parameters),
    "weight": (lambda given: (ar.footprint_weight(**given),), splats),
    "filter": (filtered, lambda d: scene_of(d) | {"width": torch.rand(COUNT, device=d) / 9}),
    "visible": (lambda given: [ar.GaussianRasterizer(settings_with(given)).markVisible(given["means3D"])], with_camera),
}


def in_full(given, value):
    return {name: value(tensor) for name, tensor in given.items()}


def made_of(call, leaves):
    """What a call makes, and the gradients that its inputs get where there are any."""
    made = [t for t in call(dict(leaves)) if t is not None]
    sums = [(t * torch.linspace(0.5, 1.5, t.numel(), device=t.device).reshape(t.shape)).sum()
            for t in made if t.requires_grad]  # fmt: skip
    found = torch.autograd.grad(sum(sums), list(leaves.values()), allow_unused=True) if sums else ()
    return [t.detach() for t in made], found


def assert_same_as_in_float32(call, given, device, half):
    leaves = in_full(given, lambda t: t.to(half).requires_grad_())
    wide = in_full(leaves, lambda t: t.detach().float().requires_grad_())
    expected, expected_gradients = made_of(call, wide)
    with torch.autocast(device, dtype=half):
        made, gradients = made_of(call, leaves)
    assert len(made) == len(expected) > 0
    for a, b in zip(made, expected):
        assert a.dtype == b.dtype != half and torch.equal(a, b)
    for a, b in zip(gradients, expected_gradients, strict=True):
        assert (a is None) == (b is None)
        assert a is None or (a.dtype == half and torch.equal(a, b.to(half)))
    return gradients


@each_half
@pytest.mark.parametrize("name", CALLS)
def test_inputs_of_16_bits_are_those_in_float32(device, half, name):
    """The same results, and gradients that are rounded to what the inputs have."""
    call, inputs = CALLS[name]
    gradients = assert_same_as_in_float32(call, inputs(device), device, half)
    if name not in ("visible", "timed stages"):
        assert any((g != 0).any() for g in gradients if g is not None)


@pytest.mark.parametrize("name", ORIGINALS)
def test_every_dialect(device, name):
    module = dialects.dialect_module(name)
    fields = fields_of(name, device, subpixel_offset=torch.full((*SIZE, 2), 0.25, device=device))
    fields |= {key: True for key in ("include_feature", "f_count") if key in fields}
    tensors = [key for key in CAMERA_TENSORS if key in fields]
    inputs = arguments_of(name, device, means2D=torch.zeros(COUNT, 3, device=device))
    further = {
        "langsplat": {"language_feature_precomp": torch.rand(COUNT, 3, device=device)},
        "grouping": {"sh_objs": torch.rand(COUNT, 1, 16, device=device)},
        "monogs": {"theta": torch.zeros(3, device=device), "rho": torch.zeros(3, device=device)},
        "depth": {"means2D_densify": torch.zeros(COUNT, 3, device=device)},
    }

    def call(given):
        camera = {key: given.pop(key) for key in tensors}
        settings = module.GaussianRasterizationSettings(**fields | camera)
        rasterizer = module.GaussianRasterizer(raster_settings=settings)
        made = [*rasterizer(**given), rasterizer.visible_filter(given["means3D"], given["scales"], given["rotations"])]
        return [*made, *rasterizer.render_depth(**given).values()] if name == "mini" else made

    given = inputs | further.get(name, {}) | {key: fields[key] for key in tensors}
    assert_same_as_in_float32(call, given, device, torch.bfloat16)


@pytest.mark.parametrize("name", ["rasterizer", "gsplat", "weight", "activations", "filter"])
def test_inputs_of_several_dtypes(device, name):
    """As networks under autocast make them: some of 16 bits, others not."""
    call, inputs = CALLS[name]
    given = inputs(device)
    for kept in range(2):
        mixed = {key: t.bfloat16() if k % 2 == kept else t for k, (key, t) in enumerate(given.items())}
        expected = call({key: t.float() for key, t in mixed.items()})
        with torch.autocast(device, dtype=torch.bfloat16):
            made = call(dict(mixed))
        assert all(a is None or torch.equal(a, b) for a, b in zip(made, expected, strict=True))


def test_dc_of_16_bits_beside_other_harmonics(device):
    settings = dialects.dialect_module("accel").GaussianRasterizationSettings(**fields_of("accel", device))
    rasterizer = dialects.dialect_module("accel").GaussianRasterizer(settings)
    given = arguments_of("accel", device)
    given["dc"] = given["dc"].bfloat16()
    expected = rasterizer(**given | {"dc": given["dc"].float()})[0]
    with torch.autocast(device, dtype=torch.bfloat16):
        assert torch.equal(rasterizer(**given)[0], expected)
    with pytest.raises(TypeError, match=r"dc must have the dtype of shs.*bfloat16: call .float\(\) .*autocast"):
        rasterizer(**given)


def test_photographs_of_8_bits_and_float64_stay_what_they_are():
    image = torch.rand(3, 9, 9)
    photograph = (255 * torch.rand(3, 9, 9)).byte()
    expected = ar.losses.l1_ssim(image, photograph)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert torch.equal(ar.losses.l1_ssim(image, photograph), expected)
        assert ar.losses.ssim(image.double(), image.double()).dtype == torch.float64
        with pytest.raises(TypeError, match="target must have the dtype of image, Float, or uint8, got Double"):
            ar.losses.ssim(image, image.double())


@each_half
@pytest.mark.parametrize("name", [name for name in CALLS if name not in ("filter", "visible")])
def test_elsewhere_they_are_refused_with_the_way_out(device, half, name):
    call, inputs = CALLS[name]
    given = in_full(inputs(device), lambda t: t.to(half))
    with pytest.raises(TypeError, match=r"got .*(Half|BFloat16|float16).*: call \.float\(\) on it, or use torch\.auto"):
        call(given)
    if device == "cuda":  # autocast of another device is none
        with torch.autocast("cpu", dtype=half), pytest.raises(TypeError, match=r"call \.float"):
            call(in_full(inputs(device), lambda t: t.to(half)))


@needs_newer_compiler
def test_torch_compile_traces_the_casts(device):
    """Without a break, and for autocast that is on as for one that is off."""
    given = scene(device)
    rasterizer = ar.GaussianRasterizer(CAMERA.settings(torch.float32, device))

    def picture(leaves):
        with torch.autocast(device, dtype=torch.bfloat16):
            return 2 * rasterizer(**leaves)[0]

    compiled = torch.compile(picture, backend="aot_eager", fullgraph=True)
    leaves = in_full(given, lambda t: t.bfloat16().requires_grad_())
    made = compiled(leaves)
    assert torch.equal(made, picture(leaves))
    made.sum().backward()
    assert leaves["means3D"].grad.dtype == torch.bfloat16 and (leaves["means3D"].grad != 0).any()
