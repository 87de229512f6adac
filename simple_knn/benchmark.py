"""Time and memory of distCUDA2 on points of several kinds.

    python benchmark.py [--device cuda] [--sizes 100000 1000000 10000000] [--rounds 5] [--threads 16] [--kinds cube ...]

Times are medians over rounds, after one that does not count, from the call until the result is there. "extra" is the
memory that a call allocates beyond the points, result included, in bytes per point, as torch's allocator counts it;
on the CPU it is not measured (README.md states it).
"""

import argparse
import statistics
import time

import torch
from analytic_simple_knn import distCUDA2


def random(n: int, *shape: int) -> torch.Tensor:
    return torch.rand(n, *shape, generator=torch.Generator().manual_seed(0))


def normal(n: int, seed: int = 1) -> torch.Tensor:
    return torch.randn(n, 3, generator=torch.Generator().manual_seed(seed))


def cube(n: int) -> torch.Tensor:
    return random(n, 3)


def sphere(n: int) -> torch.Tensor:
    return torch.nn.functional.normalize(normal(n), dim=1)


def plane(n: int) -> torch.Tensor:
    """A square that lies askew, 1e-4 thick."""
    flat = random(n, 3) * torch.tensor([1.0, 1.0, 1e-4])
    turn = torch.linalg.qr(normal(3)).Q
    return flat @ turn


def line(n: int) -> torch.Tensor:
    return random(n, 1) * torch.tensor([[0.3, -0.5, 0.7]])


def clusters(n: int) -> torch.Tensor:
    """1,000 clusters, from 1e-6 to 1 wide, in a cube of 100."""
    which = (1000 * random(n)).long()
    return 100 * cube(1000)[which] + 10 ** (-6 * random(1000)[which, None]) * normal(n)


def colmap(n: int) -> torch.Tensor:
    """Surfaces with noise, most points near the middle, one in a thousand far out, up to 1e6."""
    near = sphere(n) * (1 + 0.01 * normal(n, 2)) * (0.2 + 5 * random(n, 1) ** 4)
    far = 10 ** (6 * random(n, 1)) * normal(n, 3)
    return torch.where(random(n, 1).roll(n // 2, 0) < 1e-3, far, near)


def outlier(n: int) -> torch.Tensor:
    """A cube, and one point at 1e30."""
    points = cube(n)
    points[n // 2] = 1e30
    return points


def equal(n: int) -> torch.Tensor:
    return torch.ones(n, 3)


def nine_in_ten_equal(n: int) -> torch.Tensor:
    return torch.where(random(n, 1) < 0.9, torch.full((1, 3), 0.5), cube(n).flip(0))


def lattice(n: int) -> torch.Tensor:
    """Whole coordinates: equal distances and equal coordinates everywhere."""
    side = int(n ** (1 / 3))
    return (cube(n) * side).floor()


def half_nan(n: int) -> torch.Tensor:
    return torch.where(random(n, 1) < 0.5, torch.nan, cube(n).flip(0))


def shell_with_centre(n: int) -> torch.Tensor:
    """A sphere whose centre is a point as well: all others are equally far from that one."""
    points = sphere(n)
    points[0] = 0
    return points


KINDS = [cube, sphere, plane, line, clusters, colmap, outlier, equal, nine_in_ten_equal, lattice, half_nan]
KINDS += [shell_with_centre]


def seconds(points: torch.Tensor) -> float:
    start = time.perf_counter()
    distCUDA2(points)
    if points.is_cuda:
        torch.cuda.synchronize()
    return time.perf_counter() - start


def bytes_per_point(points: torch.Tensor) -> float:
    before = torch.cuda.memory_allocated()
    torch.cuda.reset_peak_memory_stats()
    distCUDA2(points)
    return (torch.cuda.max_memory_allocated() - before) / len(points)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--sizes", type=int, nargs="+", default=[10**5, 10**6, 10**7])
    parser.add_argument("--kinds", nargs="+", choices=[k.__name__ for k in KINDS], default=[k.__name__ for k in KINDS])
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    on_cuda = torch.device(args.device).type == "cuda"
    where = torch.cuda.get_device_name(args.device) if on_cuda else f"CPU, {args.threads} threads"
    print(f"torch {torch.__version__}, {where}\n")
    print(
        f"| {'points':17} |"
        + "".join(f" {n:>9,} [ms] |" for n in args.sizes)
        + (" extra [B/point] |" if on_cuda else "")
    )
    print("|---|" + "---:|" * (len(args.sizes) + on_cuda))
    for kind in KINDS:
        if kind.__name__ not in args.kinds:
            continue
        row = f"| {kind.__name__:17} |"
        for n in args.sizes:
            points = kind(n).to(args.device)
            seconds(points)
            row += f" {1e3 * statistics.median(seconds(points) for _ in range(args.rounds)):14.2f} |"
        print(row + (f" {bytes_per_point(points):15.1f} |" if on_cuda else ""), flush=True)


if __name__ == "__main__":
    main()
