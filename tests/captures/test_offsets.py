"""What photographs add to what they show of the same points, where the truth is known."""

import math

import pytest
import torch
from wall import cameras, write_wall

from analytic_rasterizer.captures.offsets import offsets_of
from analytic_rasterizer.training.plan import NO, YES, plan_capture

COUNT, POINTS, SEEN_BY = 48, 2000, 3
NOISE = 0.05


def ring(seed: int, shining: float) -> tuple:
    """Values of points on a ring, each in the nearest photographs alone, and what the photographs add: (COUNT, 3)."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    place = COUNT * torch.rand(POINTS, generator=generator, dtype=torch.float64)
    nearest = place.long()[:, None] + torch.arange(SEEN_BY) - SEEN_BY // 2
    photograph, point = (nearest % COUNT).flatten(), torch.arange(POINTS).repeat_interleave(SEEN_BY)
    drift = 0.14 * torch.sin(2 * math.pi * torch.arange(COUNT, dtype=torch.float64) / COUNT)
    added = torch.stack([drift, 0 * drift, -drift], 1)
    values = normal(POINTS, 3)[point] + added[photograph] + NOISE * normal(len(point), 3)
    spoiled = torch.rand(len(point), generator=generator, dtype=torch.float64) < shining
    values[spoiled] += 1 + normal(int(spoiled.sum()), 1).abs()
    return values, photograph, point, added


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("shining", [0.0, 0.1])
def test_a_drift_round_a_ring(seed, shining):
    """The largest error is that of the slowest waves round the ring. Photographs have 125 values each, so steps between
    neighbours are known to about NOISE / sqrt(60), and half a ring of 24 steps to sqrt(24) of it, 0.03; a tenth of
    spoiled values has as much to say as the noise."""
    values, photograph, point, added = ring(seed, shining)
    fit = offsets_of(values, photograph, point, COUNT)
    errors = fit.offsets - added
    assert (errors - errors.mean(0)).abs().max() < 4 * 0.03
    assert fit.offsets.median(0).values.abs().max() < 1e-12
    assert (fit.deviations.abs().median() < NOISE) and fit.deviations.shape == values.shape


def test_without_noise_offsets_are_exact():
    _, photograph, point, added = ring(0, 0.0)
    levels = torch.arange(POINTS, dtype=torch.float64)[:, None] / 100
    fit = offsets_of(levels[point] + added[photograph], photograph, point, COUNT)
    assert torch.allclose(fit.offsets, added - added.median(0).values, atol=1e-6)


def test_photographs_that_share_no_points():
    """Each half has its own zero; who observes nothing is not known."""
    photograph, point = torch.tensor([0, 1, 2, 3]), torch.tensor([0, 0, 1, 1])
    values = torch.tensor([[1.0], [3.0], [10.0], [11.0]], dtype=torch.float64)
    offsets = offsets_of(values, photograph, point, 5).offsets[:, 0]
    assert offsets[1] - offsets[0] == pytest.approx(2, abs=1e-6)
    assert offsets[3] - offsets[2] == pytest.approx(1, abs=1e-6)
    assert offsets[4].isnan()
    assert offsets_of(values[:0], photograph[:0], point[:0], 2).offsets.isnan().all()


@pytest.mark.parametrize("tracked", [True, False])
def test_one_dark_photograph(tmp_path, tracked):
    def gains(i):
        return (2**-1.5,) * 3 if i == 5 else (1.0, 1.0, 1.0)

    folder = write_wall(tmp_path / "wall", cameras(count=24), tracked=tracked, gains=gains)
    found = {finding.effect: finding for finding in plan_capture(folder).findings}
    exposure = found["exposure"]
    assert (exposure.verdict, exposure.photographs, exposure.options) == (YES, ("p_5.png",), {"exposure": "affine"})
    assert exposure.number < 0.15 and "1 by up to 1.5 stops" in exposure.reason
    assert found["white balance"].verdict == found["blur"].verdict == NO
