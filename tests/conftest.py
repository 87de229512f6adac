"""Fixtures shared by the suite."""

import importlib.util
import os
import pathlib
import threading

import pytest
import torch
from processes import run_program

from analytic_rasterizer import _C

# gsply compiles its loops when they first run, which takes a minute; as plain Python they do the same.
os.environ["NUMBA_DISABLE_JIT"] = "1"

ROOT = pathlib.Path(__file__).resolve().parent.parent
SHARED = ROOT.parent / "shared"
WORKERS_PER_DEVICE = 4
"""Processes of a test run that share a CUDA device, at most."""

needs_cuda = pytest.mark.skipif(
    not (_C.has_cuda and torch.cuda.is_available()),
    reason="needs a CUDA device and an extension that was built for CUDA",
)

# The compiler of torch 2.4 knows no types of the members of settings, and no ops that change lists of tensors.
needs_newer_compiler = pytest.mark.skipif(
    torch.__version__.startswith("2.4."), reason="torch 2.4 cannot compile or export these calls (docs/install.md)"
)

# For tests of both dtypes, in place of the fixture `device`: the rasterizer has no float64 on CUDA.
each_precision = pytest.mark.parametrize(
    "device, dtype",
    [
        pytest.param("cpu", torch.float32, id="torch.float32"),
        pytest.param("cpu", torch.float64, id="torch.float64"),
        pytest.param("cuda", torch.float32, id="cuda-torch.float32", marks=needs_cuda),
    ],
)


def pytest_collection_modifyitems(items):
    """Files whose fixtures take longest come first, so that none of them is what all wait for in the end."""
    first = ("test_train_ranks.py", "test_distributed.py", "test_distributed_parts.py")
    items.sort(key=lambda item: item.path.name not in first)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers():
    """What `-n auto` in pyproject.toml means: every core that this process may use."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return min(cores, WORKERS_PER_DEVICE) if _C.has_cuda and torch.cuda.is_available() else cores


def python_path():
    """PYTHONPATH of processes that find what the tests find, in whatever folder they run: their own path, and ROOT."""
    given = [os.path.abspath(path) for path in os.environ.get("PYTHONPATH", "").split(os.pathsep) if path]
    return os.pathsep.join([*given, str(ROOT)])


def run_python(code, *arguments, **environment):
    """Output of a process of its own that runs `code` among the tests; fails where it hangs."""
    done = run_program(code, *arguments, environment=os.environ | {"PYTHONPATH": python_path()} | environment)
    assert done.returncode == 0, (done.returncode, done.stderr[-4000:])
    return done.stdout


def in_threads(count, work):
    """Calls work(0) ... work(count - 1) side by side, waits for all, and raises what the first of them raised."""
    errors = [None] * count

    def guarded(i):
        try:
            work(i)
        except BaseException as error:  # also what pytest raises for `fail` and `skip`
            errors[i] = error

    threads = [threading.Thread(target=guarded, args=(i,)) for i in range(count)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for error in errors:
        if error is not None:
            raise error


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


def shared_scene(name):
    """A trained scene that does not ship with the project: (inputs float32, list of views)."""
    data, reader = SHARED / "data", SHARED / "tools" / "qsplat.py"
    if not (reader.exists() and (data / f"{name}.npz").exists()):
        pytest.skip("needs the optional ../shared scenes next to the project")
    import json

    spec = importlib.util.spec_from_file_location("qsplat", reader)
    qsplat = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(qsplat)
    stored = {k: torch.from_numpy(v) for k, v in qsplat.load(str(data / f"{name}.npz")).items()}
    inputs = {
        "means3D": stored["means"],
        "means2D": torch.zeros_like(stored["means"]),
        "opacities": torch.sigmoid(stored["logit_opacity"])[:, None],
        "shs": stored["sh"],
        "scales": torch.exp(stored["log_scales"]),
        "rotations": stored["quats"],
    }
    views = json.loads((data / f"{name}_lo.json").read_text())
    return {name: value.float().contiguous() for name, value in inputs.items()}, views


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
    from capture_files import circle, g, write_colmap, write_pictures

    folder = tmp_path_factory.mktemp("capture")
    views = circle(9, (35, 33))
    points, colors = g.random_points(60, seed=5)
    write_pictures(folder / "photographs", views, opaque=True)
    write_colmap(folder / "sparse" / "0", views, points, (255 * colors).to(torch.uint8))
    return folder
