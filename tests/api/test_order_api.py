"""The order along rays in every interface: what it renders, what it refuses, and what files and commands say of it."""

from dataclasses import replace

import pytest
import scenes
import torch
from gaussians import of_inputs
from scenes import Camera

import analytic_rasterizer as ar
from analytic_rasterizer import io
from analytic_rasterizer.dialects.gsplat import rasterization
from analytic_rasterizer.footprints import resolve_footprint
from analytic_rasterizer.render.order import CENTER, ORDERS, RAY, RAY_WIDE, can_be_in, footprints_along_rays

RAYS = ar.Effects(order=RAY)
SMALL = Camera(image_height=19, image_width=23)


def crossed(device="cpu", seed=3, count=60):
    """Gaussians through each other, float32."""
    scene = scenes.random_scene(seed, count)
    generator = torch.Generator().manual_seed(seed)
    flat = torch.rand(count, 3, generator=generator, dtype=torch.float64)
    scene["scales"] = torch.where(flat < 0.3, 0.05, 0.6) * (0.5 + flat)
    return scenes.cast(scene, torch.float32, device)


def test_names():
    assert (CENTER, RAY, RAY_WIDE) == ORDERS
    assert ar.Effects().order == CENTER
    assert ar.Effects() != RAYS
    with pytest.raises(ValueError, match="order must be one of center, ray, ray:32, got 'z'"):
        ar.Effects(order="z")
    for wrong in (None, 24, ["ray"], torch.zeros(2)):
        with pytest.raises(TypeError, match="order must be one of center, ray, ray:32, got "):
            ar.Effects(order=wrong)
    for name in ("median_depth", "dominant_index", "gaussian_stats"):
        with pytest.raises(ValueError, match=f"{name} must be False with order 'ray'"):
            ar.Effects(order=RAY, **{name: True})
    with pytest.raises(ValueError, match="lens must not be equirectangular with order 'ray'"):
        ar.Effects(order=RAY, lens=ar.Lens.equirectangular())


def test_footprints():
    """Those of the issue can be combined, all others are refused by name."""
    named = footprints_along_rays()
    assert named == (
        "point",
        "mip",
        "analytic",
        "box:samples=1",
        "box:samples=4",
        "moment:samples=1",
        "moment:samples=4",
    )
    scene = crossed()
    more = "box:samples=16", "moment:samples=16", "analytic:frame_gradient=paper"
    for footprint in ("cumulant", "erf", "exact", *more):
        assert not can_be_in(resolve_footprint(footprint), RAY)
        with pytest.raises(ValueError, match=f"footprint must be one of {', '.join(named)} with order 'ray'"):
            SMALL.render(scene, footprint=footprint, effects=RAYS)


def test_the_op_refuses_by_name(device):
    """Whoever calls the operators with keys of their own."""
    scene = crossed(device)
    optional = dict.fromkeys(("means2D", "shs", "colors_precomp", "scales", "rotations", "cov3D_precomp"))
    from analytic_rasterizer.render.arguments import camera_arguments, gaussian_arguments

    settings = SMALL.settings(torch.float32, device, footprint="point")
    arguments = gaussian_arguments(settings, **(optional | scene)) | {"bg": settings.bg}
    camera = camera_arguments(settings, scene["means3D"], scene["shs"])
    for key, message in (
        ("cumulant:ray24", "order 'ray' cannot be combined with footprint cumulant"),
        ("point:ray0", "the window of order 'ray' must be 1 to 64, got '0'"),
        ("point:ray65", "the window of order 'ray' must be 1 to 64, got '65'"),
        ("point:rays", "the window of order 'ray' must be 1 to 64, got 's'"),
    ):
        with pytest.raises(ValueError, match=message):
            torch.ops.analytic_rasterizer.rasterize(**arguments, **(camera | {"footprint": key}))
    with pytest.raises(ValueError, match="gaussian_stats cannot be combined with order 'ray'"):
        torch.ops.analytic_rasterizer.rasterize(
            **arguments, **(camera | {"footprint": "point:ray24"}), gaussian_stats=True
        )


def test_channels(device):
    """Up to four, of which depth is one; more are refused by name."""
    scene = crossed(device)
    effects = ar.Effects(order=RAY, alpha=True, depth=True)
    color, _, outputs = SMALL.render(scene, footprint="box:samples=1", effects=effects)
    assert torch.equal(color, SMALL.render(scene, footprint="box:samples=1", effects=RAYS)[0])
    assert (outputs.depth > 0).any() and (outputs.alpha > 0.5).any()
    with pytest.raises(ValueError, match="order 'ray' can blend at most 4 channels, got 5"):
        SMALL.render(scene, footprint="point", effects=ar.Effects(order=RAY, depth=True, inverse_depth=True))
    for count in (1, 2, 4):
        features = dict(scene, shs=None, colors_precomp=scene["shs"][:, 0, :1].expand(-1, count).contiguous())
        fields = SMALL.fields(torch.float32, device) | {"bg": torch.zeros(count, device=device)}
        settings = ar.GaussianRasterizationSettings(**fields, footprint="point", effects=RAYS)
        leaves = scenes.leaves({name: value for name, value in features.items() if value is not None})
        image = ar.GaussianRasterizer(settings)(**leaves)[0]
        assert image.shape == (count, SMALL.image_height, SMALL.image_width)
        assert all(torch.equal(image[0], channel) for channel in image)
        image.sum().backward()
        grad = leaves["colors_precomp"].grad
        assert (grad > 0).any() and all(torch.equal(grad[:, 0], grad[:, k]) for k in range(count))


@pytest.mark.parametrize("footprint", ["box:samples=1", "moment:samples=4"])
def test_stages(device, footprint):
    """project, list_tiles and blend, one and several cameras, give what the rasterizer does, and its gradients."""
    scene = crossed(device)
    cameras = [SMALL, Camera(image_height=19, image_width=23, eye=(-3.0, 1.5, -3.0))]
    settings = [camera.settings(torch.float32, device, footprint=footprint, effects=RAYS) for camera in cameras]
    leaves = scenes.leaves({name: value for name, value in scene.items() if name != "means2D"})
    splats = ar.project(settings, **leaves)
    assert splats.slopes.shape == (len(splats.means2d), 2)
    image, _ = ar.blend(splats, ar.list_tiles(splats))
    image.square().sum().backward()
    single = torch.stack([ar.blend(s, ar.list_tiles(s))[0][0] for s in splats.split()])
    assert torch.equal(image, single)
    theirs = scenes.leaves(dict(scene))
    expected = torch.stack([ar.GaussianRasterizer(s)(**theirs)[0] for s in settings])
    expected.square().sum().backward()
    assert (image - expected).abs().max() < 2e-5
    for name, leaf in leaves.items():
        assert (leaf.grad - theirs[name].grad).abs().max() <= 2e-4 * theirs[name].grad.abs().max(), name
    center = ar.project([s._replace(effects=None) for s in settings], **leaves)
    assert center.slopes is None
    assert (ar.blend(center, ar.list_tiles(center))[0] - image).abs().max() > 1 / 255
    with pytest.raises(ValueError, match=r"slopes must have shape \(N, 2\) in order 'ray', got none"):
        ar.list_tiles(replace(splats, slopes=None))


def test_gsplat(device):
    """The call, packed and as a table, gives what the rasterizer does."""
    scene = crossed(device)
    view = SMALL.world_to_camera().float()[None]
    focal = SMALL.image_width / (2 * SMALL.tanfovx), SMALL.image_height / (2 * SMALL.tanfovy)
    intrinsics = torch.tensor([[[focal[0], 0, 11.5], [0, focal[1], 9.5], [0, 0, 1]]])
    given = {
        "means": scene["means3D"],
        "quats": scene["rotations"],
        "scales": scene["scales"],
        "opacities": scene["opacities"][:, 0],
        "colors": scene["shs"],
        "sh_degree": 0,
        "viewmats": view.to(device),
        "Ks": intrinsics.to(device),
        "width": SMALL.image_width,
        "height": SMALL.image_height,
        "near_plane": 0.2,
        "footprint": "box:samples=1",
    }
    made = [rasterization(**given, packed=packed, order=RAY)[0][0].permute(2, 0, 1) for packed in (True, False)]
    assert torch.equal(*made)
    expected = SMALL.render(scene, footprint="box:samples=1", effects=RAYS)[0]
    assert (made[0] - expected).abs().max() < 1e-4
    assert (rasterization(**given)[0][0].permute(2, 0, 1) - expected).abs().max() > 1 / 255
    with pytest.raises(ValueError, match="order must be one of"):
        rasterization(**given, order="front")
    with pytest.raises(NotImplementedError, match="order must be 'center' with distributed=True"):
        rasterization(**given, order=RAY, distributed=True)


def test_opcheck(device):
    """Fake kernels know the rows and lists of the order."""
    scene = crossed(device, count=20)
    settings = SMALL.settings(torch.float32, device, footprint="moment:samples=4", effects=RAYS)
    gaussians = {name: value for name, value in scene.items() if name != "means2D"}
    compiled = torch.compile(
        lambda **tensors: ar.GaussianRasterizer(settings)(means2D=None, **tensors)[0], backend="eager", fullgraph=True
    )
    assert torch.equal(compiled(**gaussians), ar.GaussianRasterizer(settings)(means2D=None, **gaussians)[0])


@pytest.mark.parametrize("suffix", [".ply", ".spz", ".glb", ".sog"])
def test_files_say_the_order(tmp_path, suffix):
    """The tag of a training, in every format that holds comments; "center" leaves files as they were."""
    scene, path = of_inputs(crossed()), tmp_path / f"scene{suffix}"
    io.save_scene(path, scene, io.SceneMetadata(footprint="box:samples=1", order=RAY))
    assert io.read_metadata(path).order == RAY
    found = io.find_scene(path)
    assert found.choose_order(resolve_footprint("box:samples=1")).order == RAY
    other = found.choose_order(resolve_footprint("cumulant"))
    assert (other.order, other.reason) == (CENTER, f"scene{suffix} says ray, which cumulant cannot have")
    assert found.choose_order(resolve_footprint("box:samples=1"), CENTER).order == CENTER
    with pytest.raises(ValueError, match="footprint must be one of"):
        found.choose_order(resolve_footprint("cumulant"), RAY)
    io.save_scene(path, scene, io.SceneMetadata(footprint="box:samples=1", order=CENTER))
    tagged = path.read_bytes()
    io.save_scene(path, scene, io.SceneMetadata(footprint="box:samples=1"))
    assert tagged == path.read_bytes()
    assert io.read_metadata(path).order is None
