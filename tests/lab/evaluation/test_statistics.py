"""Intervals, shares and differences against hand calculations."""

from __future__ import annotations

import numpy as np
import pytest

from torchrl_osr.lab.evaluation.statistics import (
    estimate,
    mean_interval,
    mean_of_networks,
    nested_mean,
    nested_resamples,
    recovered_share,
    scores_and_decreases,
    wilson,
)


@pytest.mark.parametrize("values", [[], [1.0, np.nan], [np.inf]])
def test_no_or_non_finite_values_are_an_error(values):
    with pytest.raises(ValueError, match="finite"):
        mean_interval(values)


def test_nested_resamples_are_those_of_a_loop_over_draws():
    # An independent restatement: draw a run, then its episodes one by one.
    runs = [np.array([[0.0], [1.0], [5.0]]), np.array([[10.0], [12.0]])]
    rng = np.random.default_rng(1)
    loop = []
    for _ in range(8000):
        drawn = {len(run): rng.integers(len(run), size=len(run)) for run in runs}
        both = [runs[rng.integers(2)] for _ in runs]
        loop.append(np.mean([run[drawn[len(run)]].mean() for run in both]))
    ours = np.ravel([nested_resamples(runs, seed=seed) for seed in range(5)])
    below, wanted = (
        np.searchsorted(np.sort(each), np.unique(loop) + 1e-9) / len(each)
        for each in (ours, loop)
    )
    # Kolmogorov and Smirnov's distance at the level 0.01.
    assert np.abs(below - wanted).max() < 1.63 * (1 / len(ours) + 1 / len(loop)) ** 0.5


def test_an_interval_says_what_it_is_over():
    for runs, over in (1, "episodes"), (2, "two seeds"), (3, "seeds"):
        scores = [np.array([1.0, 3.0]) + run for run in range(runs)]
        assert estimate(scores).over == nested_mean([scores]).over == over
        assert estimate(scores).mean == pytest.approx(2 + (runs - 1) / 2)
        assert nested_mean([scores, scores * 2]).mean == estimate(scores).mean
        # Data sets are drawn apart, runs of one data set alike.
        assert nested_mean([scores] * 4).low > nested_mean([scores]).low


def test_the_interval_of_networks_contains_the_truth():
    # 0, 1 and 2 have a deviation of 1: Student's 4.303 times the root of 4 / 3.
    # Of the 50 episodes, 1.96 times 8 / sqrt(50), at a right angle.
    found = mean_of_networks(np.arange(3.0)[:, None] + [-8.0, 8.0] * 25)
    assert found[:3] == pytest.approx((1, -4.44, 6.44), abs=0.15)
    draws = np.random.default_rng(1).normal(size=(2000, 4, 1))
    inside = [(x := mean_of_networks(n)).low <= truth <= x.high for truth, *n in draws]
    assert np.mean(inside) == pytest.approx(0.95, abs=0.02)


def test_decreases_of_several_runs_by_hand():
    # Clean 10 and 30, disturbed half of it in every episode: no doubt about the half.
    clean = np.array([10.0, 30.0])
    run = np.stack([clean, clean / 2], axis=1)
    (_, none), (score, lost) = scores_and_decreases([run, 3 * run])
    assert none[:3] == (0, 0, 0)
    assert score.mean == pytest.approx(20)
    assert lost[:3] == pytest.approx((50, 50, 50))
    assert scores_and_decreases([-run])[1][1] is None
    assert scores_and_decreases([[[-1, 1], [3, 1]]])[1][1] is None


def test_the_saved_share_of_known_tables():
    back, walk = [[1, 1, 0, 0], [1, 0, 0, 0]], [0, 0, 1, 1]
    # All walks alike: with one of them the seeds alone vary, from 1 / 4 to 2 / 4.
    assert recovered_share(back, [7] * 4)[:3] == pytest.approx((37.5, 25, 50))
    # With one seed the walks alone vary, from none of a walk to all.
    assert recovered_share(back[:1], walk) == (50, 0, 100, "walks")
    # Newcombe 1998, Statistics in Medicine 17:857, Table I.
    assert wilson(81, 263) == pytest.approx((0.2553, 0.3662), abs=5e-5)
    # Nothing varies where all come back: Wilson's interval of two walks, 2 / (2 + z^2).
    all_of_them = recovered_share(np.ones((3, 4)), walk)
    assert all_of_them[:3] == pytest.approx((100, 34.2380, 100), abs=1e-4)
    none = recovered_share(np.zeros((3, 4)), walk)
    assert none[:3] == pytest.approx((0, 0, 65.7620), abs=1e-4)
    one = recovered_share([[0.6]], [3])  # of five checkpoints
    assert one[:3] == pytest.approx((60, *[100 * x for x in wilson(0.6, 1)]))
    # A walk with more states counts for more.
    assert recovered_share([[1, 1, 1, 0]], [0, 0, 0, 1]).mean == 75


def test_the_share_of_a_baselines_failures_of_known_tables():
    baseline = [[1, 0, 0, 0, 0, 0, 0, 0], [0, 0, 1, 0, 0, 0, 0, 0]]
    method = [[1, 1, 0, 0, 0, 0, 0, 0], [1, 1, 1, 0, 0, 0, 0, 0]]
    walk = [0, 0, 1, 1, 2, 2, 3, 3]
    assert recovered_share(np.ones((2, 8)), walk, baseline)[:3] == (100, 100, 100)
    assert recovered_share(baseline, walk, baseline)[:3] == (0, 0, 0)
    # With one walk the seeds alone vary: (2 - 1) / 7, (3 - 1) / 7, or between.
    one = recovered_share(method, [7] * 8, baseline)
    assert one[:3] == pytest.approx((300 / 14, 100 / 7, 200 / 7))
    with pytest.raises(ValueError, match="saves all states"):
        recovered_share([[1, 0]], [0, 1], [[1, 1]])
