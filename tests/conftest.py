"""Fixtures shared by the suite."""

import os

import pytest
import torch
from marks import needs_cuda
from shared_scenes import shared_scene

from analytic_rasterizer import _C

# gsply compiles its loops when they first run, which takes a minute; as plain Python they do the same.
os.environ["NUMBA_DISABLE_JIT"] = "1"

WORKERS_PER_DEVICE = 4
"""Processes of a test run that share a CUDA device, at most."""


def pytest_collection_modifyitems(items):
    """Files whose fixtures take longest come first, so that none of them is what all wait for in the end."""
    first = ("test_train_ranks.py", "test_distributed.py", "test_distributed_parts.py")
    items.sort(key=lambda item: item.path.name not in first)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers():
    """What `-n auto` in pyproject.toml means: every core that this process may use."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return min(cores, WORKERS_PER_DEVICE) if _C.has_cuda and torch.cuda.is_available() else cores


@pytest.fixture
def nothing_chosen(monkeypatch):
    """No footprint and no dialect, and nothing learnt about offsets of pixels."""
    import analytic_rasterizer as ar
    from analytic_rasterizer import dialects
    from analytic_rasterizer.dialects import _base, mip
    from analytic_rasterizer.dialects._later import LaterFlags

    monkeypatch.delenv("ANALYTIC_RASTERIZER_FOOTPRINT", raising=False)
    ar.set_default_footprint(None)
    monkeypatch.setattr(_base, "_companion_filter", None)
    monkeypatch.setattr(mip, "_looks_left", mip._LOOKS)
    monkeypatch.setattr(mip, "_not_zero", LaterFlags())
    dialects.set_dialect("gs2023")
    yield
    ar.set_default_footprint(None)
    dialects.set_dialect(None)


@pytest.fixture(params=["cpu", pytest.param("cuda", marks=needs_cuda)])
def device(request):
    """A test that takes it runs once per device."""
    return request.param


@pytest.fixture
def best(device):
    """The most precise dtype in which the device renders."""
    return torch.float64 if device == "cpu" else torch.float32


@pytest.fixture(autouse=True)
def one_thread():
    """Tests run on one thread unless they say otherwise; test_determinism.py proves that this decides
    no bit. Small tensors on waiting threads make the suite ten times slower on a busy machine."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="session")
def plant():
    return shared_scene("plant_sh3")


@pytest.fixture(scope="session")
def hqgarden():
    return shared_scene("hqgarden_lod1_sh0")


@pytest.fixture(scope="module")
def synthetic(tmp_path_factory):
    """The folder of a capture in the files of NeRF-synthetic."""
    from capture_files import circle, write_nerf_synthetic  # which needs Pillow

    folder = tmp_path_factory.mktemp("synthetic")
    write_nerf_synthetic(folder, circle(10), circle(3))
    return folder


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """The folder of a capture in the files of COLMAP, whose sizes do not halve evenly."""
    from capture_files import circle, random_points, write_colmap, write_pictures

    folder = tmp_path_factory.mktemp("capture")
    views = circle(9, (35, 33))
    points, colors = random_points(60, seed=5)
    write_pictures(folder / "photographs", views, opaque=True)
    write_colmap(folder / "sparse" / "0", views, points, (255 * colors).to(torch.uint8))
    return folder


@pytest.fixture(scope="module")
def trained(synthetic, tmp_path_factory):
    """A folder of results."""
    import commands

    out = tmp_path_factory.mktemp("trained")
    assert commands.train(synthetic, out, "--iterations 40 --random-points 80 --sh-degree 1 --scales 1,2") == 0
    return out
