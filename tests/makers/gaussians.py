"""Scenes as `Gaussians` and cameras as `io.View`, for what reads, writes and shows them."""

import torch

from analytic_rasterizer import io
from analytic_rasterizer.gaussians import Gaussians

EYE = torch.eye(4, dtype=torch.float64)


def random_gaussians(count=40, degree=3, seed=3):
    """All over space, as they are stored; rotations are normalised."""
    g = torch.Generator().manual_seed(seed)
    means, log_scales, rotations, logits = (torch.randn(count, n, generator=g) for n in (3, 3, 4, 1))
    rotations = torch.nn.functional.normalize(rotations.double(), dim=1).float()
    shs = 0.2 * torch.randn(count, (degree + 1) ** 2, 3, generator=g)
    return Gaussians(means, 0.5 * log_scales - 3, rotations, 2 * logits, shs)


def make_scene(count=30, degree=2):
    """In front of `make_view()`."""
    g = torch.Generator().manual_seed(0)
    return Gaussians.from_activated(
        2 * torch.rand(count, 3, generator=g) + torch.tensor([-1.0, -1.0, 3.0]),
        0.3 * torch.rand(count, 3, generator=g) + 0.01,
        torch.randn(count, 4, generator=g),
        torch.rand(count, 1, generator=g),
        0.5 * torch.randn(count, (degree + 1) ** 2, 3, generator=g),
    )


def make_view(name="front", **options):
    return io.View(name, 64, 48, 70.0, 71.0, EYE, **options)


def of_inputs(inputs):
    """Gaussians of what a rasterizer takes, such as `scenes.random_scene`."""
    return Gaussians.from_activated(*(inputs[name] for name in ("means3D", "scales", "rotations", "opacities", "shs")))
