"""Intervals that cover as often as they say."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from torchrl_osr.lab.evaluation import (
    interquartile_mean,
    mean_interval,
    nested_resamples,
    performance_profile,
    stratified_resamples,
    wilson_interval,
)

FINITE = st.floats(-1e6, 1e6)


@given(st.lists(FINITE, min_size=1, max_size=20))
def test_interval_lies_within_the_values_and_holds_the_mean_of_resamples(values):
    mean, low, high = mean_interval(values)
    slack = 1e-9 * (1 + max(map(abs, values)))
    assert min(values) - slack <= low <= high <= max(values) + slack
    assert mean == pytest.approx(np.mean(values), abs=slack)


def test_coverage_of_a_normal_sample():
    # The percentile bootstrap of 30 normal values covers slightly less than it says;
    # 0.93 is what its theory gives here. 400 trials: standard error 0.013.
    rng = np.random.default_rng(0)
    hits = 0
    for _ in range(400):
        _, low, high = mean_interval(rng.normal(size=30))
        hits += low <= 0 <= high
    assert hits / 400 == pytest.approx(0.93, abs=0.04)


@pytest.mark.parametrize("values", [[], [1.0, np.nan], [np.inf]])
@pytest.mark.parametrize(
    "statistic",
    [mean_interval, interquartile_mean, lambda each: performance_profile(each, [0])],
)
def test_no_or_non_finite_values_are_an_error(statistic, values):
    with pytest.raises(ValueError, match="finite"):
        statistic(values)


def test_interquartile_mean_is_that_of_the_sorted_middle():
    # By hand: of eight values two go at each end, of nine two as well.
    assert interquartile_mean([9, 1, 100, 2, 3, -50, 4, 8]) == (2 + 3 + 4 + 8) / 4
    assert (
        interquartile_mean([9, 1, 100, 2, 3, -50, 4, 8, 5]) == (2 + 3 + 4 + 5 + 8) / 5
    )
    assert interquartile_mean([7.0]) == 7
    rows = np.random.default_rng(0).normal(size=(5, 12))
    wanted = [sum(sorted(row)[3:9]) / 6 for row in rows.tolist()]
    np.testing.assert_allclose(interquartile_mean(rows), wanted)


def test_profile_of_a_known_sample():
    # Strictly above, so a score counts for no threshold that equals it.
    scores = [[0.0, 10.0, 10.0, 40.0], [50.0, 60.0, 70.0, 80.0]]
    profile = performance_profile(scores, [-1, 0, 10, 39, 45, 80])
    np.testing.assert_array_equal(
        profile, [[1, 0.75, 0.25, 0.25, 0, 0], [1, 1, 1, 1, 1, 0]]
    )


def test_strata_keep_their_places_and_sizes():
    resamples = stratified_resamples([[1, 2], [10, 20, 30]])
    assert set(np.unique(resamples[:, :2])) == {1, 2}
    assert set(np.unique(resamples[:, 2:])) == {10, 20, 30}


def many_resamples(runs) -> np.ndarray:
    return np.concatenate([nested_resamples(runs, seed=seed) for seed in range(5)])


def test_nested_resamples_spread_as_theory_says():
    # Of S runs of E episodes with unit variances between and within: resampling runs
    # and then episodes has the variance (between + within / E) / S of the sample.
    rng = np.random.default_rng(0)
    runs = [rng.normal(loc, 1, size=(25, 1)) for loc in rng.normal(size=12)]
    means = np.array([run.mean() for run in runs])
    within = np.mean([run.var() for run in runs]) / 25
    resamples = many_resamples(runs)
    assert resamples.mean() == pytest.approx(means.mean(), abs=0.02)
    assert resamples.var() == pytest.approx((means.var() + within) / 12, rel=0.06)


def test_nested_resamples_are_those_of_a_loop_over_draws():
    # An independent restatement: draw a run, then its episodes one by one.
    runs = [np.array([[0.0], [1.0], [5.0]]), np.array([[10.0], [12.0]])]
    rng = np.random.default_rng(1)
    loop = [
        np.mean([
            np.mean([run[rng.integers(len(run)), 0] for _ in run])
            for run in (runs[rng.integers(2)] for _ in runs)
        ])
        for _ in range(8000)
    ]  # fmt: skip
    ours = many_resamples(runs)[:, 0]
    below, wanted = (
        np.searchsorted(np.sort(each), np.unique(loop) + 1e-9) / len(each)
        for each in (ours, loop)
    )
    # Kolmogorov and Smirnov's distance at the level 0.01.
    assert np.abs(below - wanted).max() < 1.63 * (1 / len(ours) + 1 / len(loop)) ** 0.5


def test_numbers_of_an_episode_stay_together():
    first = np.random.default_rng(0).normal(size=(30, 1))
    resamples = nested_resamples([np.hstack([first, 3 - first])] * 2)
    np.testing.assert_allclose(resamples.sum(1), 3)


@pytest.mark.parametrize("runs", [[], [np.ones((0, 2))], [np.ones(3)]])
def test_no_episodes_are_an_error(runs):
    with pytest.raises(ValueError, match="episodes"):
        nested_resamples(runs)


@pytest.mark.parametrize("strata", [[], [[1.0], []]])
def test_an_empty_stratum_is_an_error(strata):
    with pytest.raises(ValueError, match="every stratum"):
        stratified_resamples(strata)


def test_wilson_interval_is_that_of_the_formula():
    # p = 0.5, n = 4, z^2 = 3.8415: 0.5 -+ 1.95996 * sqrt(1 + 0.96036) / 7.84146.
    low, high = wilson_interval(2, 4)
    assert (low, high) == pytest.approx((0.15004, 0.84996), abs=1e-5)
    assert wilson_interval(0, 20)[0] == pytest.approx(0, abs=1e-12)
    with pytest.raises(ValueError, match="3 of 2"):
        wilson_interval(3, 2)
