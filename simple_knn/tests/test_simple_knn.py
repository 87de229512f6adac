"""distCUDA2 against brute force, on points of every kind that breaks grids, trees and floating-point numbers."""

import os
import pathlib
import shutil
import subprocess
import sys
import sysconfig
import textwrap

import analytic_simple_knn
import pytest
import torch
from analytic_simple_knn import distCUDA2
from torch.utils import cpp_extension

ROOT = pathlib.Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))
import benchmark  # noqa: E402  (the kinds of points are the same)

NVCC = shutil.which("nvcc") or shutil.which("nvcc", path="/usr/local/cuda/bin")
MAX = torch.finfo(torch.float32).max
TINY = 2.0**-149
"""The smallest positive float32."""
RELATIVE = 6 * 2.0**-24
"""Of a squared distance: the difference rounds once, which the square doubles, the square once, the sum of three twice.
Then the mean, added up in float64, rounds once. Second-order terms are below the factor 1.00001 in `assert_close`."""
DEADLINE = 900
"""Seconds after which something counts as hanging."""

needs_cuda = pytest.mark.skipif(
    not (analytic_simple_knn.has_cuda and torch.cuda.is_available()),
    reason="needs a CUDA device and an extension that was built for CUDA",
)


@pytest.fixture(params=["cpu", pytest.param("cuda", marks=needs_cuda)])
def device(request):
    return request.param


@pytest.fixture(autouse=True)
def threads():
    """Two threads: the CPU builds and searches in parallel, on no more cores than a small machine has."""
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


def brute_force(points, dtype, queries=None):
    """The definition: results of the points at the indices `queries`, computed in `dtype`. Squared distances beyond
    float32 are infinite, as documented."""
    queries = torch.arange(len(points)) if queries is None else queries
    values, is_good = points.to("cpu", dtype), points.cpu().isfinite().all(dim=1)
    others = min(3, max(0, int(is_good.sum()) - 1))
    out = []
    for rows in queries.split(256):
        x, y, z = (values[rows, None] - values).unbind(-1)
        squared = x * x + y * y + z * z
        squared[squared > MAX] = torch.inf
        squared[:, ~is_good] = torch.inf
        squared[torch.arange(len(rows)), rows] = torch.inf
        nearest = squared.topk(min(3, len(values)), largest=False).values[:, :others]
        mean = nearest.double().sum(1) / max(others, 1)
        out.append(torch.where(is_good[rows], mean, 0))
    return torch.cat(out)


def assert_close(actual, expected):
    """Within RELATIVE of float64, or within what four roundings to multiples of TINY make."""
    assert actual.dtype == torch.float32
    actual, is_finite = actual.double().cpu(), expected.isfinite()
    assert torch.equal(actual[~is_finite], expected[~is_finite])
    error = (actual - expected)[is_finite].abs()
    assert (error <= 1.00001 * RELATIVE * expected[is_finite] + 2 * TINY).all(), error.max()


def tiny(n):
    """Denormal distances, in part of coordinates that are normal."""
    return benchmark.cube(n) * 1e-19 + torch.tensor([0.0, 1e-25, 1e-38])


def denormal(n):
    return benchmark.cube(n) * 1e-39


def huge(n):
    """Distances between 1e-3 and the largest float, whose squares overflow from 1.8e19 on."""
    return 10 ** (41 * benchmark.random(n, 1) - 3) * benchmark.normal(n).clamp(-0.9, 0.9)


def two_scales(n):
    """Two cubes of width 1e-6 that are 1e6 apart: a grid over both has one point per cell or all in two."""
    return benchmark.cube(n) * 1e-6 + 1e6 * (benchmark.random(n, 1).flip(0) < 0.5) * torch.tensor([[0.0, 1.0, 0.0]])


def scales_of_one_axis(n):
    """Coordinates of both signs and all magnitudes."""
    sign = torch.where(benchmark.random(n, 3).flip(0) < 0.5, -1, 1)
    return sign * 10 ** (24 * benchmark.random(n, 3) - 12)


def pairs(n):
    """Every point twice: one neighbour at distance 0, two elsewhere."""
    return benchmark.cube(n // 2 + 1).repeat(2, 1)[:n]


KINDS = [*benchmark.KINDS, tiny, denormal, huge, two_scales, scales_of_one_axis, pairs]
each_kind = pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)


@each_kind
def test_accuracy(device, kind):
    """The bound that the documentation states, at sizes around those at which the tree gets another level."""
    assert RELATIVE < 1e-6
    for n in (1, 2, 3, 4, 5, 8, 9, 16, 17, 1025, 1500):
        points = kind(n)
        assert_close(distCUDA2(points.to(device)), brute_force(points, torch.float64))


@each_kind
def test_every_bit(device, kind):
    """The tree skips nothing that matters, by not so much as a rounding: brute force in float32 gives the same bits."""
    points = kind(1500)
    assert torch.equal(distCUDA2(points.to(device)).cpu(), brute_force(points, torch.float32).float())


@each_kind
def test_many_points(device, kind):
    """Large enough for tasks on the CPU and for many blocks on CUDA."""
    points = kind(60_000)
    queries = torch.arange(0, len(points), 599)
    result = distCUDA2(points.to(device)).cpu()
    assert torch.equal(result[queries], brute_force(points, torch.float32, queries).float())


def test_equal_points_are_not_compared_with_one_another(device):
    """Of 2 million in one place, among others, each looks at a few: otherwise this would take hours."""
    points = torch.cat([torch.full((2_000_000, 3), 0.5), benchmark.cube(1000)]).to(device)
    result = distCUDA2(points)
    assert (result[:2_000_000] == 0).all() and (result[2_000_000:] > 0).all()


@each_kind
def test_the_order_of_the_points_does_not_matter(device, kind):
    points = kind(20_000).to(device)
    order = torch.randperm(len(points), generator=torch.Generator().manual_seed(5)).to(device)
    assert torch.equal(distCUDA2(points[order]), distCUDA2(points)[order])


def test_the_number_of_threads_does_not_matter():
    points = benchmark.colmap(100_000)
    results = []
    for count in (1, 2, 5):
        torch.set_num_threads(count)
        results.append(distCUDA2(points))
    assert torch.equal(results[0], results[1]) and torch.equal(results[0], results[2])


def test_points_that_are_not_finite_are_nobodys_neighbours(device):
    """Wherever they are and however many; their own result is 0."""
    good = benchmark.clusters(5000)
    expected = distCUDA2(good)
    for bad_count in (1, 5000, 200_000):
        is_bad = torch.zeros(len(good) + bad_count, dtype=torch.bool)
        is_bad[torch.randperm(len(is_bad), generator=torch.Generator().manual_seed(bad_count))[:bad_count]] = True
        points = torch.empty(len(is_bad), 3)
        points[~is_bad] = good
        values = torch.tensor([[torch.nan, 0, 0], [0, torch.inf, 0], [0, 0, -torch.inf], [torch.nan] * 3])
        points[is_bad] = values[torch.arange(bad_count) % 4]
        result = distCUDA2(points.to(device)).cpu()
        assert torch.equal(result[~is_bad], expected)
        assert (result[is_bad] == 0).all()


def test_nothing_but_nan(device):
    assert torch.equal(distCUDA2(torch.full((1000, 3), torch.nan, device=device)).cpu(), torch.zeros(1000))


def test_few_points(device):
    """The mean is over the neighbours that there are."""
    points = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3], [9, 9, 9]], device=device)
    assert distCUDA2(points[:0]).shape == (0,)
    assert distCUDA2(points[:1]).tolist() == [0]
    assert distCUDA2(points[:2]).tolist() == [1, 1]
    assert distCUDA2(points[:3]).tolist() == [2.5, 3, 4.5]
    # (1 + 4 + 9) / 3, (1 + 5 + 10) / 3, (4 + 5 + 13) / 3, (9 + 10 + 13) / 3
    expected = torch.tensor([14, 16, 22, 32]) / 3
    assert torch.equal(distCUDA2(points[:4]).cpu(), expected)
    with_nan = torch.cat([points[:2], points[:2] * torch.nan])
    assert distCUDA2(with_nan).tolist() == [1, 1, 0, 0]


def test_duplicates(device):
    """A point at the same place is a neighbour at distance 0, but no point is its own neighbour."""
    places = torch.tensor([[0.0, 0, 0], [3, 0, 0]], device=device)
    assert distCUDA2(places[[0, 0, 1]]).tolist() == [4.5, 4.5, 9]
    assert distCUDA2(places[[0, 0, 0, 1]]).tolist() == [3, 3, 3, 9]
    assert distCUDA2(places[[0, 0, 0, 0, 1]]).tolist() == [0, 0, 0, 0, 9]


def test_overflow(device):
    """A squared distance beyond float32 makes the result infinite; a sum of three that is beyond does not."""
    side = 1.8e19  # its square is 3.24e38, of at most 3.40e38
    corners = torch.tensor([[0.0, 0, 0], [side, 0, 0], [0, side, 0], [0, 0, side]], device=device)
    centre, *others = distCUDA2(corners).tolist()
    assert centre == pytest.approx(side**2, rel=RELATIVE)
    assert others == [torch.inf] * 3  # two of the three are at side * sqrt(2)
    ends = torch.tensor([[MAX, 0, 0], [-MAX, 0, 0]], device=device)
    assert distCUDA2(ends).tolist() == [torch.inf] * 2


def test_what_it_accepts(device):
    """Layouts and kinds of tensors; the input stays as it is."""
    points = benchmark.cube(1000).to(device)
    expected = distCUDA2(points)
    copy = points.clone()
    assert torch.equal(distCUDA2(points.t().contiguous().t()), expected)
    assert torch.equal(distCUDA2(torch.cat([points, points], 1)[:, :3]), expected)
    assert torch.equal(distCUDA2(points.repeat_interleave(2, 0)[::2]), expected)
    assert torch.equal(distCUDA2(torch._neg_view(-points)), expected)
    assert torch.equal(distCUDA2(points=points), expected)
    assert distCUDA2(points[:1].expand(100, 3)).tolist() == [0] * 100
    parameter = torch.nn.Parameter(points)
    result = distCUDA2(parameter)
    assert torch.equal(result, expected) and not result.requires_grad
    with torch.inference_mode():
        assert torch.equal(distCUDA2(points), expected)
    assert result.dtype == torch.float32 and result.device == points.device and result.shape == (1000,)
    assert torch.equal(points, copy)


@pytest.mark.parametrize(
    "points, error, message",
    [
        ([[0.0, 0, 0]], TypeError, "points must be a torch.Tensor, got list"),
        (None, TypeError, "points must be a torch.Tensor, got NoneType"),
        (torch.zeros(5, 3, dtype=torch.float64), TypeError, "points must have dtype torch.float32, got torch.float64"),
        (torch.zeros(5, 3, dtype=torch.float16), TypeError, "points must have dtype torch.float32, got torch.float16"),
        (torch.zeros(5, 3, dtype=torch.int32), TypeError, "points must have dtype torch.float32, got torch.int32"),
        (torch.zeros(5, 2), ValueError, r"points must have shape \(N, 3\), got \(5, 2\)"),
        (torch.zeros(3), ValueError, r"points must have shape \(N, 3\), got \(3,\)"),
        (torch.zeros(1, 5, 3), ValueError, r"points must have shape \(N, 3\), got \(1, 5, 3\)"),
        (torch.zeros(0), ValueError, r"points must have shape \(N, 3\), got \(0,\)"),
        (torch.zeros(5, 3, device="meta"), ValueError, "points must be on the CPU or on a CUDA device, got meta"),
        (torch.zeros(5, 3).to_sparse(), ValueError, "points must have layout torch.strided, got torch.sparse_coo"),
        (torch.zeros(1, 3).expand(2**31, 3), ValueError, "points must have at most 2147483647 rows, got 2147483648"),
    ],
    ids=["list", "None", "float64", "float16", "int32", "columns", "1d", "3d", "empty", "meta", "sparse", "rows"],
)
def test_errors(points, error, message):
    with pytest.raises(error, match=message):
        distCUDA2(points)


def test_torch_compile(device):
    """Traced as one operator, without a break of the graph."""
    points = benchmark.cube(1000).to(device)
    compiled = torch.compile(lambda p: distCUDA2(2 * p) + 1, backend="eager", fullgraph=True)
    assert torch.equal(compiled(points), distCUDA2(2 * points) + 1)
    torch.library.opcheck(analytic_simple_knn.mean_squared_distances, (points,))


def test_tensors_without_memory():
    """What traces a program gets the shape of the result, and nothing looks for numbers."""
    with torch._subclasses.FakeTensorMode():
        result = distCUDA2(torch.rand(5, 3))
    assert result.shape == (5,) and result.dtype == torch.float32


def test_the_name_that_repositories_import():
    import simple_knn._C

    assert simple_knn._C.distCUDA2 is distCUDA2


def run_python(code):
    """Output of a fresh interpreter that finds the same packages; fails where it hangs."""
    path = os.pathsep.join([str(ROOT), *filter(None, sys.path)])
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(code)],
        env=os.environ | {"PYTHONPATH": path},
        capture_output=True,
        text=True,
        timeout=DEADLINE,
    )
    assert done.returncode == 0, done.stderr[-4000:]
    return done.stdout


def test_the_first_import_may_be_ours():
    """The libraries of torch are loaded although nobody has imported torch before."""
    code = "from simple_knn._C import distCUDA2; import torch; print(distCUDA2(torch.eye(3)).tolist())"
    assert run_python(code) == "[2.0, 2.0, 2.0]\n"


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_a_forked_child():
    """It does not wait for OpenMP's threads, which its parent has started and it does not have."""
    code = """
    import os, torch
    from simple_knn._C import distCUDA2
    torch.set_num_threads(2)
    points = torch.rand(50_000, 3)
    expected = distCUDA2(points).tolist()
    child = os.fork()
    if child == 0:
        os._exit(0 if distCUDA2(points).tolist() == expected else 1)
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
    """
    assert run_python(code) == "0\n"


def test_the_benchmark_runs(device, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["benchmark.py", "--device", device, "--sizes", "100", "1000", "--rounds", "1"])
    benchmark.main()
    lines = capsys.readouterr().out.splitlines()
    assert [line.split("|")[1].strip() for line in lines[4:]] == [kind.__name__ for kind in benchmark.KINDS]


@needs_cuda
def test_cuda_streams():
    """Work is ordered by the current stream: the points are there only after a long time."""
    points = benchmark.cube(100_000)
    expected = distCUDA2(points)
    source, later = points.cuda(), torch.zeros(100_000, 3, device="cuda")
    torch.cuda.synchronize()
    stream = torch.cuda.Stream()
    with torch.cuda.stream(stream):
        torch.cuda._sleep(100_000_000)
        later.copy_(source)
        result = distCUDA2(later)
        later.zero_()
    stream.synchronize()
    assert torch.equal(result.cpu(), expected)


@needs_cuda
def test_cuda_graphs():
    """A captured call waits for nothing and remembers nothing of its points, not even how many are finite."""
    held = benchmark.cube(30_000).cuda()
    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        distCUDA2(held)
    torch.cuda.current_stream().wait_stream(stream)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        result = distCUDA2(held)
    for kind in (benchmark.half_nan, benchmark.equal, benchmark.colmap):
        points = kind(30_000)
        held.copy_(points)
        graph.replay()
        assert torch.equal(result.cpu(), distCUDA2(points))


@needs_cuda
def test_cuda_memory():
    """README.md says how much a call allocates, and that nothing of it stays."""
    points = benchmark.cube(1_000_000).cuda()
    distCUDA2(points)
    assert benchmark.bytes_per_point(points) <= 48
    before = torch.cuda.memory_allocated()
    distCUDA2(points)
    assert torch.cuda.memory_allocated() == before


@needs_cuda
@pytest.mark.skipif(torch.cuda.device_count() < 2, reason="needs two CUDA devices")
def test_cuda_second_device():
    points = benchmark.cube(1000)
    with torch.cuda.device(0):
        result = distCUDA2(points.to("cuda:1"))
    assert result.device == torch.device("cuda:1") and torch.equal(result.cpu(), distCUDA2(points))


@pytest.mark.skipif(analytic_simple_knn.has_cuda, reason="was built for CUDA")
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_cuda_tensors_need_a_build_for_cuda():
    with pytest.raises(
        ValueError, match="points must be on the CPU, because analytic_simple_knn was built without CUDA"
    ):
        distCUDA2(torch.zeros(5, 3, device="cuda"))


@pytest.mark.skipif(NVCC is None, reason="needs nvcc")
def test_the_cuda_source_compiles(tmp_path):
    """Without a warning; also where torch has no CUDA and there is no GPU."""
    flags = ["-std=c++17", "--fmad=false", "--expt-relaxed-constexpr", "-Werror", "all-warnings", "-arch=compute_80"]
    command = [NVCC, *flags, "-ptx", ROOT / "csrc" / "cuda.cu", "-o", tmp_path / "cuda.ptx"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-4000:]
    # Its binding, which says no more than this: that the functions exist and what they take.
    flags = ["-std=c++17", "-fsyntax-only", "-DSIMPLE_KNN_WITH_CUDA", "-DTORCH_EXTENSION_NAME=_C"]
    include = [f"-I{path}" for path in (*cpp_extension.include_paths(), sysconfig.get_path("include"))]
    command = [os.environ.get("CXX", "c++"), *flags, *include, ROOT / "csrc" / "binding.cpp"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-4000:]
