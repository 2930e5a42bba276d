"""Intervals that cover as often as they say."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from torchrl_osr.evaluation import mean_interval

FINITE = st.floats(-1e6, 1e6)


@given(st.lists(FINITE, min_size=1, max_size=20))
def test_interval_lies_within_the_values_and_holds_the_mean_of_resamples(values):
    mean, low, high = mean_interval(values, num_resamples=200)
    slack = 1e-9 * (1 + max(map(abs, values)))
    assert min(values) - slack <= low <= high <= max(values) + slack
    assert mean == pytest.approx(np.mean(values), abs=slack)


def test_coverage_of_a_normal_sample():
    # The percentile bootstrap of 30 normal values covers slightly less than it says;
    # 0.93 is what its theory gives here. 400 trials: standard error 0.013.
    rng = np.random.default_rng(0)
    hits = 0
    for trial in range(400):
        _, low, high = mean_interval(rng.normal(size=30), num_resamples=500, seed=trial)
        hits += low <= 0 <= high
    assert hits / 400 == pytest.approx(0.93, abs=0.04)


def test_width_is_that_of_the_standard_error():
    values = np.random.default_rng(0).normal(size=400)
    _, low, high = mean_interval(values)
    assert high - low == pytest.approx(2 * 1.96 * values.std() / 20, rel=0.1)


def test_single_value_is_its_own_interval():
    assert mean_interval([3.0]) == (3.0, 3.0, 3.0)


@pytest.mark.parametrize("values", [[], [1.0, np.nan], [np.inf]])
def test_no_or_non_finite_values_are_an_error(values):
    with pytest.raises(ValueError, match="finite"):
        mean_interval(values)
