"""Scenes too large for 32-bit numbers or for memory: they raise, and never overflow.

The tensors here are one number that is repeated without memory, so what is refused must be refused before
anybody copies it.
"""

import json
import os
import sys

import pytest
import scenes
import torch
from processes import run_python
from scenes import Camera

import analytic_rasterizer as ar
from analytic_rasterizer import _C

OPS = torch.ops.analytic_rasterizer
ROWS = {"cpu": 2**31, "cuda": 2**30}  # the first number of Gaussians that cannot be numbered

limits_memory = pytest.mark.skipif(
    sys.platform != "linux" or "libasan" in os.environ.get("LD_PRELOAD", ""),
    reason="limits the address space as Linux does, where no sanitizer ends the process for it",
)


def repeated(rows, *shape, device="cpu"):
    """A tensor (rows, *shape) that takes the memory of one number."""
    return torch.zeros((), device=device).expand(rows, *shape)


def gaussians(rows, coefficients=1, device="cpu"):
    widths = {"means3D": (3,), "opacities": (1,), "shs": (coefficients, 3), "scales": (3,), "rotations": (4,)}
    return {name: repeated(rows, *shape, device=device) for name, shape in widths.items()}


def rasterizer(device="cpu"):
    return ar.GaussianRasterizer(Camera(sh_degree=0).settings(torch.float32, device))


@pytest.mark.parametrize("more", [0, 1, 2**31, 2**32])
def test_too_many_gaussians(device, more):
    """Also those whose number is small in 32 bits."""
    rows = ROWS[device] + more
    with pytest.raises(ValueError, match=rf"means3D must have fewer than {ROWS[device]} rows on {device}, got {rows}"):
        rasterizer(device)(means2D=None, **gaussians(rows, device=device))
    settings = Camera(sh_degree=0).settings(torch.float32, device)
    with pytest.raises(ValueError, match=rf"means3D must have fewer than {ROWS[device]} rows on {device}, got {rows}"):
        ar.project(settings, **gaussians(rows, device=device))


@pytest.mark.parametrize("coefficients", [2**20 + 1, 2**31 + 16, 2**32 + 16])
def test_too_many_coefficients(device, coefficients):
    with pytest.raises(ValueError, match=rf"shs must have at most {2**20} .*got shape \(1, {coefficients}, 3\)"):
        rasterizer(device)(means2D=None, **gaussians(1, coefficients, device))


@pytest.mark.parametrize("op", ["bin", "blend"])
@pytest.mark.parametrize("rows", [2**31, 2**32 + 5])
def test_too_many_splats(device, op, rows):
    """Rows of all cameras are numbered together."""
    splats = {"means2d": (2,), "cov2d": (3,), "dets": (), "opacities": ()}
    arguments = {name: repeated(rows, *shape, device=device) for name, shape in splats.items()}
    arguments |= {"row_splits": torch.tensor([0, rows]), "image_height": 8, "image_width": 8}
    mip = ar.resolve_footprint("mip")
    arguments |= {"footprint": mip.key, "option": mip.option}
    if op == "bin":
        arguments |= {"depths": repeated(rows, device=device)}
    else:
        features, background = repeated(rows, 3, device=device), torch.zeros(1, 3, device=device)
        arguments |= {"features": features, "background": background, "means2d_abs": None, "lists": []}
    with pytest.raises(ValueError, match=rf"means2d must have fewer than {2**31} rows, got {rows}"):
        getattr(OPS, op)(**arguments)


def test_pixels_of_a_gaussian_that_cannot_be_counted(device):
    scene = scenes.to(scenes.cast(scenes.random_scene(0, 3), torch.float32), device)
    settings = Camera(sh_degree=0).settings(torch.float32, device, footprint="mip")
    footprint = {"footprint": settings.footprint.key, "option": settings.footprint.option}
    given = {**scene, **settings._asdict(), **footprint, "gaussian_stats": True, "keep": True}
    names = [argument.name for argument in OPS.rasterize.default._schema.arguments]
    defaults = {"lens": None, "colors_precomp": None, "cov3D_precomp": None, "shs": None}
    arguments = {name: value for name, value in (defaults | given).items() if name in names}
    lists, z = OPS.rasterize(**arguments)[-1][: len(_C.LISTS)], scene["means3D"][:, 2]
    OPS.inspect(lists, z, settings.image_height, settings.image_width, **footprint, gaussian_stats=True)
    with pytest.raises(ValueError, match=rf"fewer than {2**31} pixels, got 65536 x 32768"):
        OPS.inspect(lists, z, 2**16, 2**15, **footprint, gaussian_stats=True)
    with pytest.raises(ValueError, match=rf"fewer than {2**31} pixels, got 65536 x 32768"):
        OPS.rasterize(**arguments | {"image_height": 2**16, "image_width": 2**15})


def test_too_many_images_for_a_loss(device):
    images = torch.zeros(1, device=device).expand(2**16, 2**15, 1, 1)
    with pytest.raises(ValueError, match=rf"image must have at most {2**30} rows, columns and channels"):
        OPS.ssim_map(images, images)


# Address space is limited to what is in use and some more, by steps from nothing to more than enough.
RENDER_WITH_LITTLE_MEMORY = """
    import ctypes, json, resource, torch
    import scenes
    import analytic_rasterizer as ar
    from pathlib import Path

    libc = ctypes.CDLL(None)
    libc.mallopt(-3, 1 << 16)  # M_MMAP_THRESHOLD: every larger block is asked of the system, and given back
    torch.set_num_threads(1)
    scene = scenes.cast(scenes.random_scene(1, 30_000, sigma=(0.01, 0.02)), torch.float32)
    rasterizer = ar.GaussianRasterizer(scenes.Camera(64, 48).settings(torch.float32, "cpu"))
    expected, _ = rasterizer(**scene)
    libc.malloc_trim(0)
    outcomes = []
    for step in range(1, 40):
        used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        limits = resource.getrlimit(resource.RLIMIT_AS)
        resource.setrlimit(resource.RLIMIT_AS, (used + step * 2**18, limits[1]))
        try:
            color, _ = rasterizer(**scene)
            outcome = "the same" if torch.equal(color, expected) else "another picture"
        except Exception as error:
            outcome = f"{type(error).__name__}: {error}"
        resource.setrlimit(resource.RLIMIT_AS, limits)
        outcomes.append(outcome.splitlines()[0])
    print(json.dumps(outcomes))
"""


@limits_memory
def test_without_memory_the_error_is_that_of_torch():
    """On the CPU, wherever memory ends: in one of torch's tensors or in a vector of ours."""
    outcomes = json.loads(run_python(RENDER_WITH_LITTLE_MEMORY).splitlines()[-1])
    # Python's own objects need memory as well.
    failed = [outcome for outcome in outcomes if outcome != "the same" and not outcome.startswith("MemoryError")]
    assert all(outcome.startswith("OutOfMemoryError: ") for outcome in failed), failed
    assert any("Not enough memory on the CPU" in outcome for outcome in failed), failed
    assert any("DefaultCPUAllocator" in outcome for outcome in failed), failed
    assert outcomes[-1] == "the same"


@limits_memory
def test_a_hundred_million_gaussians_are_not_refused_but_need_memory():
    """The copies of 1e8 rows do not fit into 1 GiB; the checks let them pass."""
    code = """
        import resource, torch
        from pathlib import Path
        from test_limits import gaussians, rasterizer

        used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + 2**30, resource.getrlimit(resource.RLIMIT_AS)[1]))
        try:
            rasterizer()(means2D=None, **gaussians(10**8))
        except torch.OutOfMemoryError:
            print("out of memory")
    """
    assert run_python(code).strip() == "out of memory"
