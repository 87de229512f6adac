"""The same bits every time, for any number of threads, and for images and scenes of odd shape; and which bits
depend on the instruction set.
"""

import pytest
import scenes
import torch
from marks import each_path, each_precision, every_footprint
from processes import run_python
from scenes import KINDS, REFERENCE_FOOTPRINTS, RENDERED, Camera, name_of
from threads import assert_identical, same_on_threads

import analytic_rasterizer as ar

each_weight = pytest.mark.parametrize("variant", [*KINDS, *((name, {}) for name in REFERENCE_FOOTPRINTS)], ids=name_of)
each_dtype = pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)

# Large enough that several threads get tiles, several tiles share splats, and partial sums matter.
CAMERA = Camera(image_width=203, image_height=151, bg=(0.1, 0.5, 0.3), sh_degree=2)


def everything(camera, scene, variant, dtype, device="cpu"):
    """Image, radii, all gradients, and the stages, computed on `device`."""
    settings = camera.settings(dtype, device, variant)
    leaves = scenes.leaves(scenes.cast(scene, dtype, device))
    color, radii = ar.GaussianRasterizer(settings)(**leaves)
    (color * scenes.probe(color, seed=1)).sum().backward()
    inputs = {name: value.detach() for name, value in leaves.items() if name != "means2D"}
    stages = ar.render_stages(settings, **inputs)
    results = [color.detach(), radii, *(leaf.grad for leaf in leaves.values()), *stages[:-1]]
    assert all(result.device.type == device for result in results)
    return [result.cpu() for result in results]


@each_path
@each_dtype
def test_thread_count_changes_no_bit(variant, dtype):
    scene = scenes.random_scene(1, 400, degree=2, sigma=(0.01, 0.4))
    scene["means2D"] = torch.zeros(400, 4, dtype=torch.float64)
    same_on_threads(lambda: everything(CAMERA, scene, variant, dtype))


@pytest.mark.parametrize("size", [(600, 400), (3, 50000), (50000, 3)], ids=str)
def test_thread_count_changes_no_bit_of_the_gradient_of_one_background(size):
    """A single number, of which torch's threads would each add up a part."""
    width, height = size
    camera = Camera(image_width=width, image_height=height)
    scene = scenes.without(scenes.cast(scenes.random_scene(1, 40), torch.float32), "shs")
    weights = torch.randn(1, height, width, generator=torch.Generator().manual_seed(1))

    def gradient():
        bg = torch.zeros(1, requires_grad=True)
        settings = camera.settings(torch.float32)._replace(bg=bg)
        color, _ = ar.GaussianRasterizer(settings)(**scene, colors_precomp=torch.ones(40, 1))
        return torch.autograd.grad(color, bg, weights)

    same_on_threads(gradient, (1, 2, 3, 4, 7))


@each_path
def test_repeated_runs_are_identical(device, variant):
    torch.set_num_threads(7)
    scene = scenes.random_scene(2, 300, degree=2, sigma=(0.01, 0.4))
    first = everything(CAMERA, scene, variant, torch.float32, device)
    for _ in range(3):
        assert_identical(first, everything(CAMERA, scene, variant, torch.float32, device))


@each_weight
def test_weight_function_is_deterministic(device, variant):
    """20000 weights, more than one thread's worth; each alone gives the same as in the batch."""
    footprint, options = variant
    g = torch.Generator().manual_seed(3)
    cov2d = scenes.random_cov2d(g, 20000, (0.1, 5.0)).float()
    offset = scenes.random_offsets(g, cov2d.double()).float()

    def weights():
        d, c = (tensor.to(device, copy=True).requires_grad_() for tensor in (offset, cov2d))
        value = ar.footprint_weight(d, c, footprint=footprint, **options)
        return value.detach(), *torch.autograd.grad(value.sum(), (d, c))

    same_on_threads(weights)


@each_path
def test_other_gaussians_do_not_change_a_gradient_by_a_bit(device, variant):
    """Far-away Gaussians change the partition of the work, not the sums of the others."""
    near = scenes.random_scene(4, 50, degree=2)
    far = scenes.random_scene(5, 500, degree=2)
    far["means3D"] = far["means3D"] + torch.tensor([0.0, 0.0, -50.0])  # behind the camera
    both = {name: torch.cat([near[name], far[name]]) for name in near}
    alone = everything(CAMERA, near, variant, torch.float32, device)
    together = everything(CAMERA, both, variant, torch.float32, device)
    assert torch.equal(alone[0], together[0])
    for a, b in zip(alone[1:8], together[1:8], strict=True):
        assert torch.equal(a, b[:50])
        assert (b[50:] == 0).all()


# --- instruction sets --------------------------------------------------------------------------
#
# float64 runs the baseline's code at every level: not a bit differs. In float32 what is done once per Gaussian (radii,
# means, depths, lists) is scalar code without contraction: not a bit differs either. What is
# done per pixel runs on packs. AVX2 and AVX-512 fuse multiply and add, the baseline does not; so the image has the same
# bits on both of them and is rounded otherwise on the baseline. Gradients are sums over the lanes of a pack and differ
# between all three.

LEVELS = ("baseline", "avx2", "avx512")

EVERY_RESULT = """
import os
import sys
import torch
import scenes, threads, test_determinism as determinism
import analytic_rasterizer as ar

if ar.instruction_set() != os.environ["ANALYTIC_RASTERIZER_ISA"]:
    sys.exit()  # the machine does not have it: what it took in its place has a run of its own
results, dtype32 = {}, torch.float32
for variant in scenes.RENDERED:
    for dtype in (dtype32, torch.float64):
        torch.set_num_threads(1)
        results[scenes.name_of(variant), dtype] = determinism.of_levels(variant, dtype)
    torch.set_num_threads(3)
    threads.assert_identical(results[scenes.name_of(variant), dtype32], determinism.of_levels(variant, dtype32))
torch.save(results, sys.argv[1])
print(ar.instruction_set(), end="")
"""


def of_levels(variant, dtype):
    """What is compared: image, radii, gradients and stages of a scene with needles and splats of all sizes."""
    scene = scenes.random_scene(1, 300, degree=2, sigma=(0.01, 0.4))
    scene["means2D"] = torch.zeros(300, 4, dtype=torch.float64)
    return everything(CAMERA, scene, variant, dtype)


@pytest.fixture(scope="module")
def levels(tmp_path_factory):
    """Results of a process at each level that this machine has."""
    folder = tmp_path_factory.mktemp("levels")
    found = {}
    for level in LEVELS:
        if run_python(EVERY_RESULT, str(folder / level), ANALYTIC_RASTERIZER_ISA=level) == level:
            found[level] = torch.load(folder / level)
    assert "baseline" in found
    return found


def differences(first, second):
    """Pixels that differ by more than rounding does, RMS of the image's others, relative L2 of the gradients."""
    image, gradients = (first[0] - second[0]).abs().amax(0), slice(2, 8)
    flips = image > ROUNDING
    pairs = list(zip(first[gradients], second[gradients], strict=True))
    assert not any(torch.isnan(a).any() or torch.isnan(b).any() for a, b in pairs)
    worst = max(((a - b).norm() / a.norm()).item() for a, b in pairs)
    return int(flips.sum()), image.max().item(), image[~flips].square().mean().sqrt().item(), worst


# Off by more than this, one of the two sums has a term that the other has not: its alpha is 1/255 give or take
# rounding. A fused operation leaves out a rounding of 6e-8 of coordinates up to 23 px from the tile's corner; before
# a splat of 1 px that changes alpha by 1.4e-6 of itself, and the colours of a pixel add up to 2 at most.
ROUNDING = 1e-5
# A term that comes or goes weighs 1/255 of a difference of colours, which are below 2.
FLIP = 2 / 255 + ROUNDING
# Signs of roundings are random: what is left of them over the image are a few units in the last place of 1.
TYPICAL = 4 * 2.0**-24
# n terms that are added up in another order differ by sqrt(n) eps of their size, n = 1000 for a splat that fills four
# tiles: 2e-6; the terms are some four times as large as their sum. A flip adds 1/255 of one of the terms.
GRADIENT, GRADIENT_OF_FLIP = 8e-6, 1e-4


@every_footprint
def test_instruction_sets(levels, variant):
    """Measured: baseline against the others 5e-7 in the image where nothing flips, 4e-8 RMS, 1.4e-6 of the gradients;
    AVX2 against AVX-512 8e-7 of the gradients."""
    name = name_of(variant)
    baseline = levels["baseline"]
    for level, results in levels.items():
        assert_identical(results[name, torch.float64], baseline[name, torch.float64])
        ours, theirs = results[name, torch.float32], baseline[name, torch.float32]
        assert torch.equal(ours[1], theirs[1]), "radii"
        assert_identical(ours[9:], theirs[9:])
        flips, largest, typical, gradients = differences(theirs, ours)
        print(f"{level}: {flips} flips, image {largest:.1e}, RMS {typical:.1e}, gradients {gradients:.1e}")
        assert flips <= theirs[0][0].numel() / 1000
        assert largest < FLIP
        assert typical < TYPICAL
        assert gradients < GRADIENT + flips * GRADIENT_OF_FLIP
    if "avx512" in levels:
        first, second = levels["avx2"][name, torch.float32], levels["avx512"][name, torch.float32]
        assert torch.equal(first[0], second[0]), "image"
        *_, gradients = differences(first, second)
        assert gradients < GRADIENT


@each_dtype
def test_another_process_gives_the_same_bits(levels, dtype):
    for variant in RENDERED:
        expected = levels[ar.instruction_set()][name_of(variant), dtype]
        assert_identical(of_levels(variant, dtype), expected)


def test_an_unknown_level_is_the_best(levels):
    """A variable left over from another machine must not break a program."""
    code = "import analytic_rasterizer as ar; print(ar.instruction_set(), end='')"
    assert run_python(code, ANALYTIC_RASTERIZER_ISA="avx1024") == list(levels)[-1]


# --- odd shapes --------------------------------------------------------------------------------


@each_path
@each_precision
def test_no_gaussians(variant, device, dtype):
    """P = 0 renders the background; the backward pass runs and gives empty gradients."""
    scene = scenes.random_scene(6, 0, degree=2)
    color, radii, *rest = everything(CAMERA, scene, variant, dtype, device)
    background = torch.tensor(CAMERA.bg, dtype=dtype)[:, None, None]
    assert torch.equal(color, background.expand_as(color))
    assert radii.shape == (0,)
    assert all(gradient.shape[0] == 0 for gradient in rest[: len(scene)])


@each_path
@pytest.mark.parametrize("size", [(1, 1), (4000, 1), (1, 4000), (31, 17)], ids=str)
def test_odd_image_shapes(device, variant, size):
    """Few rows and many tiles, or the reverse. (Their values: test_render_reference.py.)"""
    camera = Camera(image_width=size[0], image_height=size[1], sh_degree=2)
    scene = scenes.random_scene(7, 60, degree=2, sigma=(0.05, 0.8), spread=1.0)
    color, *_ = same_on_threads(lambda: everything(camera, scene, variant, torch.float32, device))
    assert color.shape == (3, size[1], size[0])
    assert (color > 0).any()


@each_path
def test_all_culled(device, variant):
    """Behind the camera, or with no opacity: background, radii where due, zero gradients."""
    scene = scenes.random_scene(8, 20, degree=2)
    behind = dict(scene, means3D=scene["means3D"] + torch.tensor([0.0, 0.0, -50.0]))
    invisible = dict(scene, opacities=torch.zeros_like(scene["opacities"]))
    background = torch.tensor(CAMERA.bg, dtype=torch.float32)[:, None, None]
    for case in (behind, invisible):
        color, radii, *grads = everything(CAMERA, case, variant, torch.float32, device)
        assert torch.equal(color, background.expand_as(color))
        for gradient in grads[: len(scene)]:
            assert (gradient == 0).all()
        if case is behind:
            assert (radii == 0).all()


@each_path
def test_empty_tiles(device, variant):
    """One small splat in a large image: every other tile is plain background."""
    camera = Camera(image_width=200, image_height=120, bg=(0.2, 0.4, 0.8)).facing_z()
    scene = scenes.splat_scene(camera, [[100.0, 60.0]], [2.0, 0.3, 1.0], [0.9], [2.0])
    color, *_ = everything(camera, scene, variant, torch.float32, device)
    background = torch.tensor(camera.bg)[:, None, None]
    changed = (color != background).any(0)
    assert changed[60, 100]
    rows, columns = torch.nonzero(changed, as_tuple=True)
    assert (rows - 60).abs().max() < 12
    assert (columns - 100).abs().max() < 12
