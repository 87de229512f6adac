"""Tiles: nothing that is visible is missed, every list is ordered, and the stages agree.

The brute force evaluates the reference weight of every splat in every pixel. It knows nothing of
extents, ellipses or radii: a splat must be in the list of every tile that holds a pixel (for `box`,
a sample) with opacity * weight >= 1/255.
"""

import math

import pytest
import reference
import scenes
import torch
from marks import each_kind, each_path, each_precision
from scenes import RENDERED, Camera, name_of

import analytic_rasterizer as ar
from analytic_rasterizer import _C
from analytic_rasterizer.footprints import resolve_footprint

# The brute force takes as long as there are pixels. Six by four tiles, the last of them cut off at both edges.
CAMERA = Camera(image_width=86, image_height=54, tanfovx=0.7, tanfovy=0.44).facing_z()

# "paper" bins exactly as "frozen" does.
BINNED = [v for v in RENDERED if v[1].get("frame_gradient") != "paper"]


def splats(seed, count, sigma, ratio=(1.0, 1000.0), opacity=(0.005, 1.0)):
    """Splats of any size, shape and opacity in and around the image, some axis-aligned."""
    g = torch.Generator().manual_seed(seed)
    small = torch.exp(scenes.rand(g, count, low=math.log(sigma[0]), high=math.log(sigma[1])))
    stretch = torch.exp(scenes.rand(g, count, low=math.log(ratio[0]), high=math.log(ratio[1])))
    large = torch.clamp(small * stretch, max=100.0)
    angle = scenes.rand(g, count, high=math.pi)
    angle[::4] = (angle[::4] * 2 / math.pi).round() * math.pi / 2
    cov2d = scenes.covariance_2d(large, small, angle)
    size = torch.tensor([CAMERA.image_width, CAMERA.image_height], dtype=torch.float64)
    means = scenes.rand(g, count, 2, low=-0.1, high=1.1) * size
    means[1::4] = means[1::4].round()  # on pixel centres
    means[2::4] = (means[2::4] / 16).round() * 16 - 0.5  # on tile edges
    low, high = math.log(opacity[0]), math.log(opacity[1])
    opacities = torch.exp(scenes.rand(g, count, low=low, high=high))
    opacities[::7] = 1.0
    depths = scenes.rand(g, count, low=1.0, high=9.0)
    return scenes.splat_scene(CAMERA, means, cov2d, opacities, depths)


def stages(scene, variant, dtype=torch.float64, device="cpu"):
    """(stages on `device`, copied to the CPU; the settings on the CPU)."""
    settings = CAMERA.settings(dtype, variant=variant)
    inputs = scenes.without(scenes.cast(scene, dtype, device), "means2D")
    result = ar.render_stages(scenes.settings_to(settings, device), **inputs)
    assert all(value.device.type == device for value in result[:-1])
    return result._replace(**scenes.to(result._asdict(), "cpu")), settings


def tile_size(variant, device):
    """Tiles on CUDA of samples that move, or that are spread over lanes, are smaller in an image as small as this."""
    smaller = {("moment", 1): 8, ("moment", 4): 8, ("moment", 16): 4, ("box", 4): 8, ("box", 16): 4}
    return smaller.get((variant[0], variant[1].get("samples")), ar.TILE) if device == "cuda" else ar.TILE


def tile_grid(size):
    return math.ceil(CAMERA.image_height / size), math.ceil(CAMERA.image_width / size)


def tile_of_pair(result):
    """Row-major tile index of each pair."""
    counts = result.tile_offsets[1:] - result.tile_offsets[:-1]
    return torch.repeat_interleave(torch.arange(len(counts)), counts)


def in_tile(result, count, size=ar.TILE):
    """(P, tiles_y, tiles_x) bool: is Gaussian i listed in that tile."""
    rows, columns = tile_grid(size)
    listed = torch.zeros(count, rows * columns, dtype=torch.bool)
    listed[result.ids[result.pairs.long()].long(), tile_of_pair(result)] = True
    return listed.reshape(count, rows, columns)


def largest_alpha_per_tile(settings, scene, variant, size=ar.TILE, block=4):
    """(P, tiles_y, tiles_x): max over pixels and samples of opacity * weight, in float64."""
    footprint, options = variant
    covariance = reference.unpack_covariance(scene["cov3D_precomp"].double())
    means, cov2d, _ = reference.project(settings, scene["means3D"].double(), covariance)
    rows, columns = tile_grid(size)
    padded = torch.meshgrid(torch.arange(rows * size), torch.arange(columns * size), indexing="ij")
    inside = (padded[0] < CAMERA.image_height) & (padded[1] < CAMERA.image_width)
    pixels = torch.stack([padded[1], padded[0]], -1).double()
    out = []
    for mean, cov, opacity in zip(*(t.split(block) for t in (means, cov2d, scene["opacities"].double())), strict=True):
        weights = reference.sample_weights(pixels - mean[:, None, None], cov[:, None, None], footprint, **options)
        alpha = torch.where(inside, opacity[:, :, None] * weights.amax(0), 0.0)
        tiles = alpha.reshape(len(mean), rows, size, columns, size)
        out.append(tiles.amax((2, 4)))
    return torch.cat(out)


SIZES = {"tiny": (0.01, 0.3), "small": (0.1, 2.0), "medium": (1.0, 10.0), "large": (5.0, 100.0)}


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("variant", BINNED, ids=name_of)
def test_no_visible_pixel_is_missed(variant, size):
    """Float64; 1e-9 absorbs rounding at the threshold itself."""
    scene = splats(list(SIZES).index(size), 25, SIZES[size])
    result, settings = stages(scene, variant)
    alpha = largest_alpha_per_tile(settings, scene, variant)
    missed = (alpha >= (1 + 1e-9) / 255) & ~in_tile(result, len(alpha))
    worst = alpha[missed].max() * 255 if missed.any() else 0
    assert not missed.any(), f"{missed.sum()} tiles missed, up to {worst:.2f}/255"
    # The brute force has something to find, and the lists are not simply everything.
    assert (alpha >= 1 / 255).any()
    if size in ("tiny", "small"):
        assert in_tile(result, len(alpha)).float().mean() < 0.5


@pytest.mark.parametrize("size", SIZES)
@each_path
def test_no_visible_pixel_is_missed_float32(device, variant, size):
    """Float32, against the exact alpha of the same float32 numbers.

    Anisotropy up to 30: cond(Sigma) <= 900, so the float32 alpha itself may be off by
    16 eps cond = 1.7e-3 relative to the peak (and the 1/255 threshold by the same factor of q):
    alphas within 2 % of the threshold may be on either side.
    """
    scene = scenes.cast(splats(20 + list(SIZES).index(size), 50, SIZES[size], (1.0, 30.0)), torch.float32)
    result, settings = stages(scene, variant, torch.float32, device)
    tile = tile_size(variant, device)
    alpha = largest_alpha_per_tile(settings, scene, variant, tile)
    missed = (alpha >= 1.02 / 255) & ~in_tile(result, len(alpha), tile)
    assert not missed.any(), f"up to {alpha[missed].max() * 255:.3f}/255"


@pytest.mark.parametrize("variant", BINNED, ids=name_of)
def test_lists_are_not_wasteful(device, best, variant):
    """Every list entry costs 256 weights: most must be worth it.

    Splats of ordinary size and shape. A conservative bounding box of the true level set may cover
    corner tiles that the ellipse misses, at most (4/pi) of the area plus a rim; three times the
    needed pairs would mean that the extent is not that of the level set.
    """
    scene = splats(40, 100, (1.0, 10.0), (1.0, 3.0))
    result, settings = stages(scene, variant, best, device)
    alpha = largest_alpha_per_tile(settings, scene, variant, tile_size(variant, device))
    needed = (alpha >= 1 / 255).sum()
    assert needed <= len(result.pairs) + 1
    assert len(result.pairs) < 2 * needed, (len(result.pairs), needed)


@each_precision
@each_kind
def test_lists_are_consistent(variant, device, dtype):
    scene = splats(50, 300, (0.5, 20.0))
    result, settings = stages(scene, variant, dtype, device)
    rows, columns = tile_grid(tile_size(variant, device))
    assert ar.TILE == 16
    assert result.color.shape == (3, CAMERA.image_height, CAMERA.image_width)
    assert result.ids.dtype == result.pairs.dtype == result.radii.dtype == torch.int32
    assert result.tile_offsets.dtype == torch.int64
    assert set(result.seconds) == {"project", "list_tiles", "blend"}
    assert all(value >= 0 for value in result.seconds.values())
    assert (result.ids[1:] > result.ids[:-1]).all()
    # A radius for everything that is listed, and a splat for everything with a radius.
    listed = result.ids[result.pairs.unique().long()].long()
    assert (result.radii[listed] > 0).all()
    assert torch.isin(torch.nonzero(result.radii).flatten(), result.ids.long()).all()
    assert result.depths.shape == (len(result.ids),)
    assert result.means2d.shape == (len(result.ids), 2)

    offsets = result.tile_offsets
    assert offsets.shape == (rows * columns + 1,)
    assert offsets[0] == 0
    assert offsets[-1] == len(result.pairs)
    assert (offsets[1:] >= offsets[:-1]).all()
    assert (result.pairs >= 0).all()
    assert (result.pairs < len(result.ids)).all()
    key = tile_of_pair(result) * len(result.ids) + result.pairs
    assert len(key.unique()) == len(key), "a splat appears twice in a tile"

    # Values against the reference, to the rounding of the dtype within 1.2 * 86 px and at depth 9.
    covariance = reference.unpack_covariance(scene["cov3D_precomp"])
    means, _, depths = reference.project(settings, scene["means3D"], covariance)
    ids = result.ids.long()
    eps = torch.finfo(dtype).eps
    assert (result.depths.double() - depths[ids]).abs().max() < 9 * 4 * eps
    assert (result.means2d.double() - means[ids]).abs().max() < 1.2 * CAMERA.image_width * 16 * eps

    # The same image and radii as the rasterizer proper, to the last bit.
    rasterizer = ar.GaussianRasterizer(scenes.settings_to(settings, device))
    color, radii = rasterizer(**scenes.cast(scene, dtype, device))
    assert torch.equal(color.cpu(), result.color)
    assert torch.equal(radii.cpu(), result.radii)


@each_precision
@each_kind
def test_depth_order_with_stable_ties(variant, device, dtype):
    """Front to back in every tile; among equal depths the input order. Four depths, 300 splats."""
    scene = splats(60, 300, (2.0, 20.0), (1.0, 5.0))
    z = (torch.arange(300) * 7919 % 4 + 1).double()
    scene["means3D"] = scene["means3D"] / scene["means3D"][:, 2:] * z[:, None]
    result, _ = stages(scene, variant, dtype, device)
    tile = tile_of_pair(result)
    same = tile[1:] == tile[:-1]
    splat = result.pairs.long()
    depth = result.depths[splat]
    assert (depth[1:] >= depth[:-1])[same].all()
    tie = same & (depth[1:] == depth[:-1])
    assert tie.sum() > 100
    assert (splat[1:] > splat[:-1])[tie].all()


def test_the_peak_of_a_cumulant_weight_is_not_its_centre(device, best):
    """Below 0.3 px it dips in the middle (like the flat top it stands for), so opacity * weight(0)
    is no bound for the alpha of a pixel: here 0.96/255 at the centre and 1.02/255 beside it."""
    cov2d = torch.tensor([[0.0025, 0.0, 0.0025]], dtype=torch.float64)
    weights = reference.cumulant(torch.tensor([[0.0, 0.0], [0.0, 0.3]], dtype=torch.float64), cov2d)
    assert weights[1] > 1.05 * weights[0]
    opacity = 1 / (255 * weights.prod().sqrt())
    scene = scenes.splat_scene(CAMERA, [[40.0, 40.3]], cov2d, opacity.reshape(1), [2.0])
    result, _ = stages(scene, ("cumulant", {}), best, device)
    assert (result.color[0] > 0).sum() == 1
    # In float32 a position is off by four roundings of 40 px, and the weight has a slope of 1/0.29 px.
    tolerance = 1e-12 if best == torch.float64 else 4 * 40 * 6e-8 / 0.29 / 255
    assert abs(result.color[0, 40, 40] - opacity * weights[1]) < tolerance


def test_depths_that_differ_in_the_last_bit(device):
    """Sorting keys must keep all the precision of the depth."""
    for dtype in (torch.float32, torch.float64) if device == "cpu" else (torch.float32,):
        depths = torch.tensor([2.0, 2.0, 2.0], dtype=dtype)
        depths[0] = torch.nextafter(depths[0], torch.tensor(3.0, dtype=dtype))
        depths[2] = torch.nextafter(depths[2], torch.tensor(1.0, dtype=dtype))
        scene = scenes.splat_scene(CAMERA, [[40.0, 40.0]] * 3, [25.0, 0.0, 25.0], [0.5] * 3, depths)
        result, _ = stages(scene, ("mip", {}), dtype, device)
        first = result.pairs[: result.tile_offsets[result.tile_offsets > 0][0]]
        assert first.tolist() == [2, 1, 0], dtype


@pytest.mark.parametrize(
    "footprint, side, samples, large, small",
    [
        *(("moment", 8, *sizes) for sizes in [(1, 16, 8), (4, 8, 8), (16, 8, 4)]),
        *(("box", 16, *sizes) for sizes in [(1, 16, 16), (4, 16, 8), (16, 4, 4)]),
    ],
)
def test_tiles_depend_on_the_image(footprint, side, samples, large, small):
    """On CUDA, where an image is large from 4096 tiles of 8x8 px on for samples that move, and of 16x16 px for samples
    that lanes share: four of them in small images, and sixteen in all. On the CPU all tiles have 16x16 px."""
    key = resolve_footprint(footprint, samples=samples).key
    height = 64 * side
    assert [_C.tile_size(key, 1.0, width, height, True) for width in (height, height - side)] == [large, small]
    assert [_C.tile_size(key, 1.0, width, height, False) for width in (height, height - side)] == [16, 16]


@each_kind
@pytest.mark.parametrize("opacity", [0.0039, 0.0035])
def test_faint_splats_cost_nothing(device, best, variant, opacity):
    """opacity * weight < 1/255 = 0.00392 everywhere: no contribution, no gradient, no tile.

    Extents may be generous, so the lists are held to it only 10 % below the threshold.
    """
    scene = splats(70, 40, (1.0, 5.0), opacity=(0.5, 0.9))
    scene["opacities"][::2] = opacity
    result, settings = stages(scene, variant, best, device)
    if opacity < 0.9 / 255:
        assert not in_tile(result, 40, tile_size(variant, device))[::2].any()
    rasterizer = ar.GaussianRasterizer(scenes.settings_to(settings, device))
    leaves = scenes.leaves(scenes.cast(scene, best, device))
    color, _ = rasterizer(**leaves)
    bright = {name: value[1::2] for name, value in scene.items()}
    assert torch.equal(color, rasterizer(**scenes.leaves(scenes.cast(bright, best, device)))[0])
    color.sum().backward()
    for name in ("means3D", "cov3D_precomp", "opacities", "colors_precomp", "means2D"):
        assert (leaves[name].grad[::2] == 0).all(), name


@each_kind
def test_radius_at_the_edge_of_the_image(device, best, variant):
    """Positive while the 3-sigma circle or any visible pixel is on screen, zero further out.

    sigma 4 px above the top row: ceil(3 sigma) >= 12 px reaches row 0 from y = -11.5, and an opaque
    splat is visible (alpha >= 1/255) from sqrt(2 ln 255) sigma = 13.3 px. Pruning relies on both.
    """
    footprint, options = variant
    cov2d = torch.tensor([16.0, 0.0, 16.0], dtype=torch.float64)
    size = math.ceil(reference.three_sigma(cov2d, footprint, **options))
    for y, opacity in [(-11.5, 1.0), (-11.5, 0.05), (-13.25, 1.0), (-14.5, 1.0), (-40.0, 1.0)]:
        scene = scenes.splat_scene(CAMERA, [[70.0, y]], cov2d, [opacity], [2.0])
        result, _ = stages(scene, variant, best, device)
        visible = result.color.max() > 0
        assert visible == (y > -13.3 and opacity == 1)
        assert result.radii.item() == (0 if y < -14 else size)
