"""Bands of one camera, and gsplat's `distributed=True`: what ranks make together is what one process makes.

One set of processes runs everything, first two of them and then all three, and leaves its results in files.
"""

import dataclasses
import datetime
import random
from itertools import pairwise

import gsplat_calls
import pytest
import scenes
import torch
import torch.distributed as dist
from processes import DEADLINE, start_processes
from scenes import Camera
from test_distributed import COUNT, DIFFERENCE, error_of, scene_of, with_camera_gradients
from weights import weights as weights_of

import analytic_rasterizer as ar
from analytic_rasterizer import distributed
from analytic_rasterizer.dialects.gsplat import rasterization
from analytic_rasterizer.distributed.bands import _touched, balanced_bands

WORLDS = (2, 3)
FOOTPRINTS = ("box:samples=4", "box:samples=16", "moment:samples=4", "exact")
SHARDS = {1: (60,), 2: (41, 19), 3: (0, 45, 15)}
LOW = Camera(image_width=40, image_height=14)  # one row of tiles: most ranks have no band
VARIANTS = {
    "packed": {"render_mode": "RGB+ED", "absgrad": True},
    "table": {"packed": False, "rasterize_mode": "antialiased", "absgrad": True},
    "depth": {"render_mode": "D"},
    "harmonics": {"sh_degree": 1, "footprint": "box:samples=16"},
    "lens": {"camera_model": "fisheye", "render_mode": "RGB-Ed", "return_normals": True, "extra_signals_sh_degree": 1},
}
PER_RANK = 2  # cameras of gsplat's


def rows_of(scene, sizes, rank):
    first = sum(sizes[:rank])
    return {name: value[first : first + sizes[rank]] for name, value in scene.items()}


def weights(height, width):
    return torch.rand(4, height, width, generator=torch.Generator().manual_seed(5))


# --- bands ------------------------------------------------------------------------------------------


def settings_of(footprint, dtype, camera=None):
    camera = camera or Camera(image_width=27, image_height=87, tanfovx=0.3, bg=(0.1, 0.3, 0.2))
    return dataclasses.replace(camera, sh_degree=1).settings(dtype, "cpu", footprint=footprint)


def band_of(footprint, dtype, sizes, rank, group=None, camera=None):
    """What a rank makes of its shard, by name."""
    (settings,), (view,), (bg,) = with_camera_gradients([settings_of(footprint, dtype, camera)])
    leaves = scenes.leaves(rows_of(scene_of(dtype, "cpu"), sizes, rank))
    band = distributed.rasterize_bands(settings, **leaves, means2d_abs=True, group=group)
    first, end = band.rows[rank]
    of_band = weights(settings.image_height, settings.image_width)[:, first:end].to(dtype)
    (band.anchor + (torch.cat([band.image, band.alpha]) * of_band).sum()).backward()
    made = {"rows": band.rows, "image": band.image.detach(), "alpha": band.alpha.detach(), "whole": band.whole()}
    made |= {"gradients": {name: leaf.grad for name, leaf in leaves.items()}, "means2d": band.shard.means2d.grad}
    made |= {"absolute": band.means2d_abs.grad, "ids": band.shard.gaussian_ids + band.first_id, "view": view.grad}
    made |= {"bg": torch.zeros_like(bg) if bg.grad is None else bg.grad, "count": band.count}
    return made


def background_alone(sizes, rank):
    """Rows of the bands, and the gradient of the background, which on rank 0 is all that requires one."""
    settings = settings_of(FOOTPRINTS[0], torch.float32)
    bg = settings.bg.clone().requires_grad_(rank == 0)
    gaussians = rows_of(scene_of(torch.float32, "cpu"), sizes, rank)
    band = distributed.rasterize_bands(settings._replace(bg=bg), **gaussians)
    first, end = band.rows[rank]
    of_band = weights(settings.image_height, settings.image_width)[:, first:end]
    (band.anchor + (torch.cat([band.image, band.alpha]) * of_band).sum()).backward()
    return band.rows, bg.grad


def of_one_process(footprint, dtype, rows):
    """The whole image, and of every band the gradient with respect to splats; and that of Gaussians of their sum."""
    (settings,), (view,), (bg,) = with_camera_gradients([settings_of(footprint, dtype)])
    leaves = scenes.leaves(scene_of(dtype, "cpu"))
    splats = ar.project(settings, **leaves)
    absolute = torch.zeros_like(splats.means2d, requires_grad=True)
    lists = ar.list_tiles(splats)
    image, alpha = ar.blend(splats, lists, background=bg, means2d_abs=absolute)
    both = torch.cat([image[0], alpha[0]])
    of_splats = [splats.means2d, splats.cov2d, splats.opacities, splats.colors]
    parts = []
    for first, end in rows:
        loss = (both * weights(*both.shape[1:]).to(dtype))[:, first:end].sum()
        parts.append(torch.autograd.grad(loss, [*of_splats, absolute, bg], retain_graph=True))
    sums = [sum(of_band) for of_band in zip(*parts)]
    found = torch.autograd.grad(of_splats, [*leaves.values(), view], sums[:4])
    made = {"image": image[0].detach(), "alpha": alpha[0].detach(), "means2d": [part[0] for part in parts]}
    made |= {"absolute": [part[4] for part in parts], "bg": [part[5] for part in parts]}
    made |= {"gradients": dict(zip(leaves, found)), "view": found[-1]}
    return made


def band_along_rays():
    """Slopes of splats are not sent: a band of others would be a wrong picture."""
    settings = settings_of(FOOTPRINTS[0], torch.float32)._replace(effects=ar.Effects(order="ray"))
    return error_of(lambda: distributed.rasterize_bands(settings, **scene_of(torch.float32, "cpu")))


def band_mistake(rank):
    bad = {"means3D": torch.zeros(5, 2), "opacities": torch.zeros(5), "shs": torch.zeros(5, 1, 3)}
    scene = bad if rank == 1 else scene_of(torch.float32, "cpu")
    settings = settings_of(FOOTPRINTS[0], torch.float32)
    return error_of(lambda: distributed.rasterize_bands(settings, **scene))


# --- gsplat -----------------------------------------------------------------------------------------


def gaussians_of(variant):
    degree = VARIANTS[variant].get("sh_degree", 0)
    scene = gsplat_calls.scene_of(torch.float64, "cpu", degree, count=COUNT)
    if variant == "lens":
        scene["extra_signals"] = weights_of((COUNT, 4, 2), torch.float64, "cpu")
    return scene


def cameras_of(world, variant=None):
    """Those of all ranks."""
    eyes = [(0.3 + 0.4 * k, -0.2, -4.0 + 0.1 * k) for k in range(world * PER_RANK)]
    cameras = gsplat_calls.cameras_of(torch.float64, "cpu", 1)
    views = torch.stack([Camera(eye=eye).world_to_camera() for eye in eyes])
    lenses = {}
    if variant == "lens":
        lenses["radial_coeffs"] = torch.linspace(-0.05, 0.05, 4 * len(eyes), dtype=torch.float64).reshape(-1, 4)
    return {"viewmats": views, "Ks": cameras["Ks"].expand(len(eyes), 3, 3).clone()} | lenses


def gsplat_of(variant, scene, cameras, options=None):
    """Images, alphas, what is in meta, and the gradients."""
    leaves = scenes.leaves(scene | cameras)
    options = VARIANTS[variant] | (options or {})
    with_color = "RGB" in options.get("render_mode", "RGB")
    backgrounds = torch.linspace(0.1, 0.9, 3, dtype=torch.float64).expand(len(cameras["Ks"]), 3) if with_color else None
    images, alphas, meta = rasterization(
        **leaves, width=gsplat_calls.WIDTH, height=gsplat_calls.HEIGHT, backgrounds=backgrounds, **options
    )
    meta["means2d"].retain_grad()
    weight = weights(*images.shape[1:3]).double()
    images = torch.cat([images, *(meta[name] for name in ("render_extra_signals", "normals") if name in meta)], -1)
    (images * weight[0, :, :, None]).sum().add((alphas * weight[1, :, :, None]).sum()).backward()
    return {
        "images": images.detach(),
        "alphas": alphas.detach(),
        "meta": {name: value.detach() if torch.is_tensor(value) else value for name, value in meta.items()},
        "means2d": meta["means2d"].grad,
        "absgrad": getattr(meta["means2d"], "absgrad", None),
        "gradients": {name: leaf.grad for name, leaf in leaves.items()},
    }


def gsplat_mistakes(rank):
    scene, cameras = rows_of(gaussians_of("packed"), (30, 30), rank), cameras_of(2)
    own = {name: value[rank * PER_RANK :][:PER_RANK] for name, value in cameras.items()}
    fewer = {name: value[:1] for name, value in own.items()}

    def call(of_rank_1, cameras=own):
        changed = of_rank_1 if rank == 1 else {}
        given = scene | cameras | {"width": gsplat_calls.WIDTH, "height": gsplat_calls.HEIGHT, "distributed": True}
        return error_of(lambda: rasterization(**given | changed))

    return {
        "shape": call({"quats": torch.zeros(3, 4)}),
        "width": call({"width": 7}),
        "cameras": call({}, fewer if rank == 1 else own),
        "refused": call({"sparse_grad": True}),
        "batch": call({name: value[None] for name, value in (scene | own).items()}),
    }


# --- the processes ----------------------------------------------------------------------------------


def work(rank, folder):
    torch.set_num_threads(1)
    for world in WORLDS:
        if rank >= world:
            continue
        init, timeout = f"file://{folder}/rendezvous-{world}", datetime.timedelta(seconds=DEADLINE / 2)
        dist.init_process_group("gloo", init_method=init, rank=rank, world_size=world, timeout=timeout)
        made = {f: band_of(f, torch.float32, SHARDS[world], rank) for f in FOOTPRINTS}
        made["float64"] = band_of(FOOTPRINTS[0], torch.float64, SHARDS[world], rank)
        made["again"] = band_of(FOOTPRINTS[0], torch.float32, SHARDS[world], rank)
        made["low"] = band_of(FOOTPRINTS[0], torch.float32, SHARDS[world], rank, camera=LOW)
        made["background"] = background_alone(SHARDS[world], rank)
        for variant in VARIANTS:
            cameras = {name: t[rank * PER_RANK :][:PER_RANK] for name, t in cameras_of(world, variant).items()}
            scene = rows_of(gaussians_of(variant), SHARDS[world], rank)
            made[variant] = gsplat_of(variant, scene, cameras, {"distributed": True})
        if world == 2:
            made["mistakes"] = gsplat_mistakes(rank) | {"bands": band_mistake(rank), "order": band_along_rays()}
        torch.save(made, f"{folder}/{world}-{rank}.pt")
        dist.destroy_process_group()


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """What every rank made, by number of ranks."""
    folder = tmp_path_factory.mktemp("ranks")
    start_processes(work, (folder,), max(WORLDS))
    return {world: [torch.load(folder / f"{world}-{rank}.pt") for rank in range(world)] for world in WORLDS}


CASES = [*((footprint, torch.float32) for footprint in FOOTPRINTS), ("float64", torch.float64)]


@pytest.mark.parametrize("world", WORLDS)
@pytest.mark.parametrize("name, dtype", CASES, ids=[name for name, _ in CASES])
def test_bands_are_the_image_of_one_process(made, world, name, dtype):
    """Bit for bit; and so is the whole that rank 0 puts together."""
    parts = [of_rank[name] for of_rank in made[world]]
    rows = parts[0]["rows"]
    assert rows[0][0] == 0 and rows[-1][1] == 87 and all(part["rows"] == rows for part in parts)
    assert all(end == first for (_, end), (first, _) in pairwise(rows)) and len({*rows}) > 1
    expected = of_one_process(FOOTPRINTS[0] if name == "float64" else name, dtype, rows)
    for image in ("image", "alpha"):
        assert torch.equal(torch.cat([part[image] for part in parts], 1), expected[image])
    assert torch.equal(parts[0]["whole"][0], expected["image"]) and torch.equal(parts[0]["whole"][1], expected["alpha"])
    assert [part["whole"] for part in parts[1:]] == [None] * (world - 1)


@pytest.mark.parametrize("world", WORLDS)
@pytest.mark.parametrize("name, dtype", CASES, ids=[name for name, _ in CASES])
def test_gradients_of_bands_are_those_of_one_process(made, world, name, dtype):
    """A sum over B bands has B - 1 roundings in any order: with two bands it has the same bits, and so has the rest."""
    parts = [of_rank[name] for of_rank in made[world]]
    expected = of_one_process(FOOTPRINTS[0] if name == "float64" else name, dtype, parts[0]["rows"])
    eps = torch.finfo(dtype).eps
    for kind in ("means2d", "absolute"):
        whole, terms = sum(expected[kind]), sum(term.abs() for term in expected[kind])
        error = (torch.cat([part[kind] for part in parts]) - whole).abs()
        assert whole.abs().max() > 0 and (error <= (world - 2) * eps * terms).all(), kind
    for part, bg in zip(parts, expected["bg"]):  # n terms, none of them negative, in another order
        n = expected["alpha"].numel()
        assert ((part["bg"] - bg).abs() <= (n - 1) * eps * bg).all() and (bg > 0).all()
    if world == 2:
        for leaf, whole in expected["gradients"].items():
            assert torch.equal(torch.cat([part["gradients"][leaf] for part in parts]), whole), leaf
    assert torch.equal(torch.cat([part["ids"] for part in parts]).sort()[0], torch.cat([p["ids"] for p in parts]))
    assert {part["count"] for part in parts} == {COUNT}


@pytest.mark.parametrize("world", WORLDS)
def test_every_rank_runs_the_backward_pass_of_one_background(made, world):
    """Where nothing else on any rank requires a gradient."""
    (rows, bg), *others = (of_rank["background"] for of_rank in made[world])
    expected = of_one_process(FOOTPRINTS[0], torch.float32, rows)
    n, [whole, *_] = expected["alpha"].numel(), expected["bg"]
    assert ((bg - whole).abs() <= (n - 1) * torch.finfo(torch.float32).eps * whole).all() and (whole > 0).all()
    assert others == [(rows, None)] * (world - 1)


@pytest.mark.parametrize("world", WORLDS)
def test_bands_have_the_same_bits_again(made, world):
    for of_rank in made[world]:
        torch.testing.assert_close(of_rank[FOOTPRINTS[0]], of_rank["again"], rtol=0, atol=0)


@pytest.mark.parametrize("world", WORLDS)
def test_ranks_may_have_no_band(made, world):
    parts = [of_rank["low"] for of_rank in made[world]]
    assert sorted(end - first for first, end in parts[0]["rows"]) == [0] * (world - 1) + [14]
    assert [part["image"].shape[1] for part in parts] == [end - first for first, end in parts[0]["rows"]]
    assert parts[0]["whole"][0].shape == (3, 14, 40) and any((part["means2d"] != 0).any() for part in parts)


def test_one_process_has_one_band():
    made = band_of(FOOTPRINTS[0], torch.float32, SHARDS[1], 0)
    expected = of_one_process(FOOTPRINTS[0], torch.float32, [(0, 87)])
    assert made["rows"] == ((0, 87),) and torch.equal(made["whole"][0], expected["image"])
    for name, gradient in expected["gradients"].items():
        assert torch.equal(made["gradients"][name], gradient), name


@pytest.mark.parametrize("size", [(512, 512), (201, 150)], ids=["large", "small"])
@pytest.mark.parametrize(
    "footprint", ["mip", "box:samples=4", "box:samples=16", *(f"moment:samples={cells}" for cells in (1, 4, 16))]
)
def test_rows_of_tiles_that_splats_touch(footprint, size, device):
    """Whatever the size of tiles: every pair is in one of the rows, and a splat in those between its first and last."""
    camera = Camera(image_width=size[0], image_height=size[1])
    scene = scenes.cast(scenes.random_scene(3, 500, degree=1), torch.float32, device)
    del scene["means2D"]
    settings = scenes.settings_to(settings_of(footprint, torch.float32, camera), device)
    splats = ar.project(settings, **scene)
    touched = _touched(splats)
    lists = ar.list_tiles(splats, keep=False).of_camera()
    rows = -(-camera.image_height // touched.side)
    tiles = rows * -(-camera.image_width // touched.side)
    assert len(lists["tile_offsets"]) == tiles + 1 and len(touched.pairs) == rows
    assert sum(touched.pairs) == int(lists["tile_offsets"][-1]) > 500
    row_of_mean = ((splats.means2d[:, 1] + 0.5) / touched.side).floor().clamp(0, rows - 1)
    seen = touched.first <= touched.last
    assert seen.sum() > 100
    assert ((touched.first <= row_of_mean) & (row_of_mean <= touched.last))[seen].all()


def test_bands_are_balanced():
    """A cut is next to where it should be, so that no band has more than its share and the longest row."""
    generator = random.Random(3)
    for world in (1, 2, 3, 8):
        for _ in range(50):
            pairs = [generator.choice((0, 1, 10, 500)) for _ in range(generator.randrange(1, 30))]
            bands = balanced_bands(pairs, world)
            assert len(bands) == world and bands[0][0] == 0 and bands[-1][1] == len(pairs)
            assert all(end == first for (_, end), (first, _) in pairwise(bands))
            most = max(sum(pairs[first:end]) for first, end in bands)
            assert most <= sum(pairs) / world + max(pairs)
    assert balanced_bands([0] * 6, 3) == [(0, 2), (2, 4), (4, 6)]


# --- gsplat -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("world", WORLDS)
@pytest.mark.parametrize("variant", VARIANTS)
def test_gsplats_ranks_make_what_one_process_makes(made, world, variant):
    """Images, and gradients of Gaussians, bit for bit; those of cameras are sums over the ranks."""
    parts = [of_rank[variant] for of_rank in made[world]]
    expected = gsplat_of(variant, gaussians_of(variant), cameras_of(world, variant))
    for name in ("images", "alphas"):
        assert torch.equal(torch.cat([part[name] for part in parts]), expected[name])
    assert expected["images"].abs().max() > 0
    for name, whole in expected["gradients"].items():
        if whole is None:  # colours, of depth alone
            continue
        whole_of_ranks = torch.cat([part["gradients"][name] for part in parts])
        if name in ("viewmats", "Ks", "radial_coeffs"):
            error = (whole_of_ranks - whole).norm()
            assert error <= gsplat_calls.gradient_tolerance(torch.float64) * whole.norm() and whole.norm() > 0
        else:
            assert torch.equal(whole_of_ranks, whole), name


@pytest.mark.parametrize("world", WORLDS)
@pytest.mark.parametrize("variant", VARIANTS)
def test_gsplats_meta_is_of_the_own_gaussians_in_all_cameras(made, world, variant):
    expected = gsplat_of(variant, gaussians_of(variant), cameras_of(world, variant))
    first = 0
    for of_rank, count in zip(made[world], SHARDS[world]):
        part, own = of_rank[variant], slice(first, first + count)
        meta, whole = part["meta"], expected["meta"]
        assert (meta["n_cameras"], meta["n_batches"]) == (PER_RANK, 1)
        if whole["gaussian_ids"] is None:
            rows = (slice(None), own)
        else:
            rows = (whole["gaussian_ids"] >= own.start) & (whole["gaussian_ids"] < own.stop)
            assert torch.equal(meta["gaussian_ids"] + first, whole["gaussian_ids"][rows])
            assert torch.equal(meta["camera_ids"], whole["camera_ids"][rows])
        for name in ("means2d", "radii", "depths", "conics", "opacities"):
            assert torch.equal(meta[name], whole[name][rows]), name
        assert torch.equal(part["means2d"], expected["means2d"][rows])
        if VARIANTS[variant].get("absgrad"):
            assert torch.equal(part["absgrad"], expected["absgrad"][rows]) and expected["absgrad"].max() > 0
        first += count


def test_gsplats_distributed_in_one_process_changes_nothing():
    scene, cameras = gaussians_of("packed"), cameras_of(1)
    made, expected = gsplat_of("packed", scene, cameras, {"distributed": True}), gsplat_of("packed", scene, cameras)
    torch.testing.assert_close(made, expected, rtol=0, atol=0)


MISTAKES = {
    "shape": ("ValueError", "on rank 1: quats must have shape (30, 4), got (3, 4)"),
    "width": ("ValueError", f"all arguments but tensors must be the same on every rank, {DIFFERENCE}"),
    "cameras": ("ValueError", f"viewmats must hold as many cameras on every rank, {DIFFERENCE}: 2 and 1"),
    "refused": ("RuntimeError", "on rank 1: sparse_grad is not supported: gradients are dense tensors"),
    "batch": ("ValueError", "on rank 1: means must have no leading dimensions where distributed is True, got (1,)"),
    "bands": ("ValueError", "on rank 1: means3D must have shape (P, 3), got (5, 2)"),
    "order": ("ValueError", "on rank 0: order must be 'center' where Gaussians are distributed, got 'ray'"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_of_one_rank_raises_on_all(made, mistake):
    for of_rank in made[2]:
        assert of_rank["mistakes"][mistake] == MISTAKES[mistake]


def test_colors_per_camera_are_refused():
    scene, cameras = gaussians_of("packed"), cameras_of(1)
    scene["colors"] = scene["colors"].expand(PER_RANK, *scene["colors"].shape)
    with pytest.raises(ValueError, match="colors must be shared by the cameras where distributed is True"):
        gsplat_of("packed", scene, cameras, {"distributed": True})
