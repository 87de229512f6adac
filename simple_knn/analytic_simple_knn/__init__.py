"""Mean squared distance to the three nearest neighbours, on the CPU and with CUDA: `distCUDA2`."""

import torch

try:
    from . import _C
except ImportError as error:
    from .installation import why_not_loaded

    raise ImportError(why_not_loaded(error)) from error

__all__ = ["distCUDA2", "has_cuda"]

has_cuda: bool = _C.has_cuda
"""Whether this package was built with CUDA."""


def distCUDA2(points: torch.Tensor) -> torch.Tensor:
    """Mean squared distance from every point to the three nearest others.

    `points`: float32 (N, 3), on the CPU or on a CUDA device, contiguous or not, N < 2^31.
    Returns float32 (N,) on the same device, in the squared unit of `points`, without gradient.

    The result is within 1e-6 of the exact mean, relatively, or within two of the smallest positive float32 (1.4e-45),
    however the points are distributed. It is the same, bit for bit, for any number of threads, on both devices, and in
    every run. On CUDA it is computed on the current stream, and nothing waits for the device.

    - Points at the same place are neighbours at distance 0. No point is its own neighbour.
    - Where there are fewer than three others the mean is over those that there are, and 0 where there is none.
    - A point with a coordinate that is NaN or infinite is nobody's neighbour. Its own result is 0, like that of a point
      without neighbours.
    - The result is infinite where one of the three squared distances is larger than the largest float32 (3.4e38).

    Raises TypeError where `points` is no tensor or has another dtype. Raises ValueError where it has another shape or
    layout, has too many rows, or is on a device that this package does not serve or was not built for.
    """
    check_points(points)
    return mean_squared_distances(points.detach().resolve_neg().contiguous())


def check_points(points: torch.Tensor) -> None:
    """Raises what `distCUDA2` says it does."""
    if not isinstance(points, torch.Tensor):
        raise TypeError(f"points must be a torch.Tensor, got {type(points).__name__}")
    if points.dtype != torch.float32:
        raise TypeError(f"points must have dtype torch.float32, got {points.dtype}")
    if points.layout != torch.strided:
        raise ValueError(f"points must have layout torch.strided, got {points.layout}")
    if points.dim() != 2 or points.shape[1] != 3:
        raise ValueError(f"points must have shape (N, 3), got {tuple(points.shape)}")
    if points.shape[0] > _C.MAX_POINTS:
        raise ValueError(f"points must have at most {_C.MAX_POINTS} rows, got {points.shape[0]}")
    if points.device.type not in ("cpu", "cuda"):
        raise ValueError(f"points must be on the CPU or on a CUDA device, got {points.device}")
    if points.is_cuda and not has_cuda:
        raise ValueError(
            f"points must be on the CPU, because analytic_simple_knn was built without CUDA, got {points.device}"
        )


# An operator, because what has no memory (torch.compile traces with such tensors) must not reach the pointers.
@torch.library.custom_op("analytic_simple_knn::mean_squared_distances", mutates_args=())
def mean_squared_distances(points: torch.Tensor) -> torch.Tensor:
    """`distCUDA2` of points that have been checked and are contiguous."""
    n = len(points)
    out = points.new_empty(n)
    if n == 0:
        return out
    if points.is_cuda:
        # The device of the points, which need not be the current one, and its current stream.
        with torch.cuda.device(points.device):
            scratch = points.new_empty(_C.scratch_bytes_cuda(n), dtype=torch.uint8)
            stream = torch.cuda.current_stream().cuda_stream
            _C.mean_distances_cuda(points.data_ptr(), n, scratch.data_ptr(), out.data_ptr(), stream)
    else:
        scratch = points.new_empty(_C.scratch_bytes_cpu(n), dtype=torch.uint8)
        _C.mean_distances_cpu(points.data_ptr(), n, scratch.data_ptr(), out.data_ptr(), torch.get_num_threads())
    return out


@mean_squared_distances.register_fake
def _(points: torch.Tensor) -> torch.Tensor:
    return points.new_empty(points.shape[0])
