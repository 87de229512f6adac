"""Arguments of gsplat's call: batches, layouts, modes, planes, none at all, and what is refused."""

import math

import pytest
import scenes
import torch
from gsplat_calls import (
    BOTH_LAYOUTS,
    HEIGHT,
    WIDTH,
    assert_gradients_close,
    cameras_of,
    gradients,
    render,
    scene_of,
    tolerance,
)
from marks import each_precision
from weights import weights

from analytic_rasterizer.dialects import gsplat as dialect


@each_precision
def test_covariances_in_place_of_scales(device, dtype):
    scene, cameras = scene_of(dtype, device), cameras_of(dtype, device)
    covars, _ = dialect.quat_scale_to_covar_preci(scene["quats"], scene["scales"])
    expected, *_ = render(scene, cameras)
    lower = torch.ones(3, 3, dtype=dtype, device=device).tril(-1)  # is not read
    actual, *_ = render(scene | {"quats": None, "scales": None}, cameras, covars=covars + lower)
    assert (actual - expected).abs().max() <= 10 * tolerance(dtype)


@each_precision
@BOTH_LAYOUTS
@pytest.mark.parametrize("per_camera", [False, True], ids=["shared", "per-camera"])
@pytest.mark.parametrize("degree", [None, 1])
def test_a_batch_is_each_of_its_scenes(device, dtype, packed, per_camera, degree):
    """Two by one scenes of two cameras: images, gradients and meta; colours of a camera are used in that camera."""
    single, cameras = [], []
    for seed in (1, 2):
        scene = scene_of(dtype, device, degree=degree or 0, seed=seed)
        if per_camera:
            scene["colors"] = torch.stack([scene["colors"], scene["colors"].flip(0)])
        single.append(scene)
        cameras.append(cameras_of(dtype, device))
    cameras[1]["viewmats"] = cameras[1]["viewmats"].flip(0)
    together = scenes.leaves({k: torch.stack([scene[k] for scene in single])[:, None] for k in single[0]})
    views = {k: torch.stack([c[k] for c in cameras])[:, None] for k in cameras[0]}
    background = weights((2, 1, 2, 3), dtype, device)
    options = {"sh_degree": degree, "packed": packed, "render_mode": "RGB+ED"}
    images, alphas, meta = render(together, views, backgrounds=background, **options)
    assert images.shape == (2, 1, 2, HEIGHT, WIDTH, 4) and alphas.shape == (2, 1, 2, HEIGHT, WIDTH, 1)
    assert meta["n_batches"] == 2 and meta["n_cameras"] == 2
    g = weights(images.shape, dtype, device)
    actual = gradients((images * g).sum(), together)
    for b in range(2):
        leaves = scenes.leaves(single[b])
        own, own_alphas, own_meta = render(leaves, cameras[b], backgrounds=background[b, 0], **options)
        assert torch.equal(images[b, 0], own) and torch.equal(alphas[b, 0], own_alphas)
        expected = gradients((own * g[b, 0]).sum(), leaves)
        assert_gradients_close({k: v[b, 0] for k, v in actual.items()}, expected, dtype)
        rows = meta["batch_ids"] == b if packed else (b, 0)
        for name in ("means2d", "radii", "depths", "conics", "opacities"):
            assert torch.equal(meta[name][rows], own_meta[name]), name
        for name in ("camera_ids", "gaussian_ids"):
            assert own_meta[name] is None if not packed else torch.equal(meta[name][rows], own_meta[name])
        if per_camera:
            for c in range(2):
                of_camera = {k: v[c : c + 1] for k, v in cameras[b].items()}
                colors = {"colors": single[b]["colors"][c]}
                alone, *_ = render(single[b] | colors, of_camera, backgrounds=background[b, 0, c : c + 1], **options)
                assert torch.equal(images[b, 0, c], alone[0])


@each_precision
def test_layouts_agree(device, dtype):
    """Packed rows are those of the table that are not culled; the images are the same."""
    scene, cameras = scene_of(torch.float64, "cpu", count=100), cameras_of(torch.float64, "cpu")
    scene["means"] *= 2
    scene, cameras = ({k: v.to(device, dtype) for k, v in part.items()} for part in (scene, cameras))
    dense_images, dense_alphas, dense = render(scene, cameras, packed=False)
    images, alphas, packed = render(scene, cameras, packed=True)
    assert torch.equal(images, dense_images) and torch.equal(alphas, dense_alphas)
    kept = (dense["radii"] > 0).all(-1)
    assert 0 < kept.sum() < kept.numel()
    for name in ("means2d", "radii", "depths", "conics", "opacities"):
        assert torch.equal(dense[name][kept], packed[name]), name


@each_precision
@pytest.mark.parametrize("channels", [1, 2, 40])
def test_render_modes(device, dtype, channels):
    """Depth is a channel like a feature of z; expected depth is depth by alpha."""
    scene, cameras = scene_of(dtype, device), cameras_of(dtype, device)
    scene["colors"] = weights((len(scene["means"]), channels), dtype, device)
    background = weights((2, channels), dtype, device, seed=1)
    images, alphas, meta = render(scene, cameras, backgrounds=background, packed=False)
    assert images.shape == (2, HEIGHT, WIDTH, channels)
    z = meta["depths"][..., None]
    depth, *_ = render(scene | {"colors": z}, cameras)
    modes = {mode: render(scene, cameras, backgrounds=background, render_mode=mode) for mode in dialect.RENDER_MODES}
    close = {"rtol": 0, "atol": 10 * tolerance(dtype)}
    expected = depth / alphas.clamp(min=1e-10)
    torch.testing.assert_close(modes["RGB"][0], images, **close)
    torch.testing.assert_close(modes["D"][0], depth, **close)
    torch.testing.assert_close(modes["ED"][0], expected, rtol=1e-4 if dtype == torch.float32 else 1e-9, atol=1e-9)
    torch.testing.assert_close(modes["RGB+D"][0], torch.cat([images, depth], -1), **close)
    torch.testing.assert_close(modes["RGB+ED"][0][..., :-1], images, **close)
    torch.testing.assert_close(modes["RGB+ED"][0][..., -1:], modes["ED"][0], rtol=1e-4, atol=1e-9)
    for image, alpha, _ in modes.values():
        assert torch.equal(alpha, alphas) and image.is_contiguous()


@each_precision
@BOTH_LAYOUTS
def test_small_splats_are_clipped(device, dtype, packed):
    """As if they were not there, and with no radius."""
    scene, cameras = scene_of(torch.float64, "cpu", count=60), cameras_of(torch.float64, "cpu", 1)
    scene, cameras = ({k: v.to(device, dtype) for k, v in part.items()} for part in (scene, cameras))
    _, _, meta = render(scene, cameras, packed=False)
    large = (meta["radii"][0] > 8).any(-1)
    assert 5 < large.sum() < 55
    images, _, clipped = render(scene, cameras, packed=packed, radius_clip=8.0)
    expected, *_ = render({k: v[large] for k, v in scene.items()}, cameras)
    assert torch.equal(images, expected)
    if packed:
        assert torch.equal(clipped["gaussian_ids"], large.nonzero()[:, 0])
    else:
        assert torch.equal((clipped["radii"][0] > 0).all(-1), large)


def test_planes_cut_depths(device):
    scene, cameras = scene_of(torch.float32, device), cameras_of(torch.float32, device, 1)
    z = render(scene, cameras, packed=False)[2]["depths"][0]
    near, far = z.sort().values[[1, 4]].tolist()
    _, _, meta = render(scene, cameras, near_plane=near, far_plane=far)
    assert torch.equal(meta["gaussian_ids"], ((z > near) & (z < far)).nonzero()[:, 0]) and len(meta["depths"]) == 2


@BOTH_LAYOUTS
def test_no_gaussians(device, packed):
    scene = {k: v[:0] for k, v in scene_of(torch.float32, device).items()}
    background = weights((2, 3), torch.float32, device)
    leaves = scenes.leaves(scene)
    images, alphas, meta = render(
        leaves, cameras_of(torch.float32, device), packed=packed, backgrounds=background, absgrad=True
    )
    assert torch.equal(images, background[:, None, None].expand(2, HEIGHT, WIDTH, 3)) and (alphas == 0).all()
    assert meta["means2d"].shape == ((0, 2) if packed else (2, 0, 2))
    images.sum().backward()
    assert leaves["means"].grad.shape == (0, 3)


def test_gaussians_behind_every_camera(device):
    scene, cameras = scene_of(torch.float32, device), cameras_of(torch.float32, device)
    scene["means"] = scene["means"] - 50 * cameras["viewmats"][0, 2, :3]
    leaves = scenes.leaves(scene)
    images, _, meta = render(leaves, cameras, absgrad=True)
    images.sum().backward()
    assert (images == 0).all() and len(meta["means2d"]) == 0 and (leaves["means"].grad == 0).all()


REFUSED = [
    {"sparse_grad": True},
    {"with_ut": True},
    {"with_eval3d": True},
    {"ftheta_coeffs": object()},
    {"viewmats_rs": torch.eye(4).expand(2, 4, 4)},
    {"rolling_shutter": "ROLLING_TOP_TO_BOTTOM"},
    {"camera_model": "ftheta"},
]


@pytest.mark.parametrize("asked", REFUSED, ids=lambda asked: next(iter(asked)))
def test_what_is_not_served_is_refused_by_name(asked):
    with pytest.raises(NotImplementedError, match=f"^{next(iter(asked))} .*not supported: "):
        render(scene_of(torch.float32, "cpu"), cameras_of(torch.float32, "cpu"), **asked)


def test_2dgs_is_refused_by_name():
    with pytest.raises(NotImplementedError, match=r"^rasterization_2dgs is not supported: "):
        dialect.rasterization_2dgs(torch.zeros(1, 3), render_mode="RGB")


NO_POSE = torch.eye(4).repeat(2, 1, 1)
NO_POSE[1, 2, 3] = math.nan
MIRRORED = torch.tensor([[-5.0, 0, 4], [0, 5, 4], [0, 0, 1]])
MANY = {"colors": torch.ones(6, 512), "render_mode": "RGB+D"}


@pytest.mark.parametrize(
    "change, error, message",
    [
        ({"means": torch.zeros(6, 2)}, ValueError, r"means must have shape \(\.\.\., N, 3\), got \(6, 2\)"),
        ({"means": None}, TypeError, "means must be a tensor, got NoneType"),
        ({"quats": None}, TypeError, "quats must be a tensor, got NoneType"),
        ({"quats": torch.zeros(5, 4)}, ValueError, r"quats must have shape \(6, 4\), got \(5, 4\)"),
        ({"scales": torch.ones(6, 3).double()}, TypeError, "scales must have the dtype of means, torch.float32"),
        ({"opacities": torch.ones(6, 1)}, ValueError, r"opacities must have shape \(6,\), got \(6, 1\)"),
        ({"covars": torch.ones(6, 6)}, ValueError, r"covars must have shape \(6, 3, 3\), got \(6, 6\)"),
        ({"viewmats": torch.eye(4)}, ValueError, r"viewmats must have shape \(\.\.\., C, 4, 4\), got \(4, 4\)"),
        ({"viewmats": torch.zeros(0, 4, 4)}, ValueError, "viewmats must hold at least one camera"),
        ({"viewmats": torch.eye(4)[None, None]}, ValueError, r"viewmats must have shape \(1, 4, 4\), got \(1, 1, 4, 4"),
        ({"Ks": torch.eye(3)[None]}, ValueError, r"Ks must have shape \(2, 3, 3\), got \(1, 3, 3\)"),
        ({"Ks": MIRRORED.expand(2, 3, 3)}, ValueError, "Ks must have positive focal lengths, got -5.0"),
        ({"colors": torch.ones(5, 3)}, ValueError, r"colors must have shape \(6, 3\) or \(2, 6, 3\), got \(5, 3\)"),
        ({"colors": torch.ones(3, 6, 3)}, ValueError, r"colors must have shape \(6, 3\) or \(2, 6, 3\), got \(3, 6"),
        ({"colors": torch.ones(6, 3).long()}, TypeError, "colors must have the dtype of means, torch.float32, got"),
        ({"colors": torch.ones(6, 3, device="meta")}, ValueError, "colors must be on the device of means, cpu, got me"),
        ({"colors": torch.ones(6, 513)}, ValueError, "colors must have 1 to 512 channels in render_mode RGB, got 513"),
        (MANY, ValueError, "colors must have 1 to 511 channels in render_mode RGB.D, got 512"),
        ({"colors": torch.ones(6, 0)}, ValueError, "colors must have 1 to 512 channels in render_mode RGB, got 0"),
        ({"viewmats": NO_POSE}, ValueError, r"viewmats must be finite, got nan at \(1, 2, 3\)"),
        ({"Ks": torch.full((2, 3, 3), math.inf)}, ValueError, r"Ks must be finite, got inf at \(0, 0, 0\)"),
        ({"sh_degree": 1}, ValueError, r"colors must have shape \(6, K, 3\) or \(2, 6, K, 3\) of K.*, got \(6, 3\)"),
        ({"sh_degree": 1, "colors": torch.ones(6, 3, 3)}, ValueError, "colors must have 4 harmonics of degree 1, got"),
        ({"sh_degree": 0.5, "colors": torch.ones(6, 9, 3)}, ValueError, "sh_degree must be 0 to 4, got 0.5"),
        ({"sh_degree": 5, "colors": torch.ones(6, 36, 3)}, ValueError, "sh_degree must be 0 to 4, got 5"),
        ({"backgrounds": torch.ones(3)}, ValueError, r"backgrounds must have shape \(2, 3\), got \(3,\)"),
        ({"width": 0}, ValueError, "width must be a positive integer, got 0"),
        ({"width": math.nan}, ValueError, "width must be a whole number, got nan"),
        ({"height": None}, TypeError, "height must be a whole number, got None"),
        ({"near_plane": None}, TypeError, "near_plane must be a number, got None"),
        ({"radius_clip": "small"}, TypeError, "radius_clip must be a number, got 'small'"),
        ({"near_plane": 0.0}, ValueError, "near_plane must be above 0 and below far_plane, got 0.0"),
        ({"far_plane": 0.001}, ValueError, "near_plane must be above 0 and below far_plane"),
        ({"eps2d": -1.0}, ValueError, "eps2d must be finite and not negative, got -1.0"),
        ({"radius_clip": math.nan}, ValueError, "radius_clip must be finite and not negative, got nan"),
        ({"render_mode": "rgb"}, ValueError, r"render_mode must be one of RGB, D, .*, RGB-Ed, got 'rgb'"),
        ({"rasterize_mode": "mip"}, ValueError, "rasterize_mode must be one of classic, antialiased, got 'mip'"),
        ({"camera_model": "lens"}, ValueError, "camera_model must be one of pinhole, ortho, fisheye, got 'lens'"),
        ({"footprint": "disc"}, ValueError, "footprint must be one of"),
    ],
)
def test_errors_name_what_is_wrong(change, error, message):
    with pytest.raises(error, match=message):
        render(scene_of(torch.float32, "cpu"), cameras_of(torch.float32, "cpu"), **change)
