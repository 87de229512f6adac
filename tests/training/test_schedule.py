"""Which picture a step shows, how far a training is, and what follows from that."""

from dataclasses import replace

import pytest
import torch

from analytic_rasterizer import training
from analytic_rasterizer.training import TrainingOptions, schedule


def test_order_shows_every_pair_in_turn():
    options = TrainingOptions(scales=(1, 4), scale_repeats=(2, 1), seed=1)
    order = schedule.PictureOrder(3, options)
    rounds = [[order(9 * k + i) for i in range(9)] for k in range(3)]
    pairs = sorted([(v, 1) for v in range(3)] * 2 + [(v, 4) for v in range(3)])
    assert all(sorted(shown) == pairs for shown in rounds)
    assert rounds[0] != rounds[1]
    assert schedule.PictureOrder(3, options)(13) == rounds[1][4]  # without what came before
    assert [schedule.PictureOrder(3, replace(options, seed=2))(i) for i in range(9)] != rounds[0]


def test_seeds_reach_to_where_no_order_can_be_drawn():
    for seed in (-(2**39), -1, 2**40 - 1):
        options = TrainingOptions(seed=seed)
        for number in (0, 2**24 - 1):  # of a pass
            assert schedule.PictureOrder(20, options)(20 * number)[1] == 1
        assert len(training.random_points(2, seed)[0]) == 2
    for seed in (-(2**39) - 1, 2**40):
        with pytest.raises(ValueError, match=rf"seed must be -2\^39 to 2\^40 - 1, got {seed}"):
            TrainingOptions(seed=seed)
        with pytest.raises((ValueError, RuntimeError)):  # which one depends on the version of torch
            torch.Generator().manual_seed(seed << 24)


def test_progress_by_seconds_grows_at_the_last_pace():
    progress = schedule.Progress(None, seconds=10.0)
    for elapsed in (1.0, 3.0):
        for _ in range(100):
            progress.advance()
        progress.measure(elapsed)
        assert progress.share == elapsed / 10
    progress.advance()
    assert progress.share == pytest.approx(0.302)
    steps = schedule.Progress(3, None)
    for share in (1 / 3, 2 / 3, 1.0):
        steps.advance()
        steps.measure(99.0)
        assert steps.share == share


def test_rate_of_the_means_falls_over_the_training_or_over_steps():
    whole, fixed = (TrainingOptions(means_rate=1.6e-4, means_rate_steps=steps) for steps in (0, 30_000))
    assert schedule.means_rate_at(3500, 0.5, whole) == pytest.approx(1.6e-5)  # the geometric mean of the ends
    assert schedule.means_rate_at(15_000, 0.9, fixed) == pytest.approx(1.6e-5)
    assert schedule.means_rate_at(60_000, 0.9, fixed) == pytest.approx(1.6e-6)


def test_other_rates_fall_after_a_while():
    options = TrainingOptions(rates_from=100, rates_half_life=10)
    assert [schedule.rates_factor_at(step, options) for step in (0, 100, 110, 130)] == [1, 1, 0.5, 0.125]
    assert schedule.rates_factor_at(10**6, TrainingOptions(rates_half_life=0)) == 1


def test_degrees_of_the_harmonics_come_after_steps_or_shares():
    options = TrainingOptions()
    assert [schedule.sh_degree_at(step, 0.0, options) for step in (999, 1000, 5000)] == [0, 1, 3]
    assert [schedule.sh_degree_at(9, share, options) for share in (0.09, 0.11, 0.9)] == [0, 1, 3]
