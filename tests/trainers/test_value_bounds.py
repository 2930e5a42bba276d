"""Values that run away are named once, where they first are."""

from __future__ import annotations

import math

import pytest

from torchrl_osr.trainers.value_bounds import ValueBounds, largest_value


def warnings(caplog) -> list[str]:
    return [each.message for each in caplog.records if each.levelname == "WARNING"]


def test_each_name_is_warned_of_once(caplog):
    bounds = ValueBounds({"a": 1.0, "b": 2.0, "absent": 0.0})
    bounds.check({"a": -1.0, "b": 2.0, "c": 1e9}, "step 1")
    assert not warnings(caplog)
    for step in (2, 3):
        bounds.check({"a": -1.5, "b": 2.0}, f"step {step}")
    bounds.check({"b": math.inf, "a": 9.0}, "step 4")
    first, second = warnings(caplog)
    assert first.startswith("step 2: the mean a is -1.5, more than 1 in magnitude")
    assert second.startswith("step 4: the mean b is inf, more than 2")


def test_largest_value_is_ten_times_the_largest_return():
    # The reward for ever: 3 + 3/2 + 3/4 + ... = 6.
    assert largest_value(3.0, 0.5) == 60.0
    assert largest_value(3.0, 1.0) == math.inf


def test_trainer_warns_of_a_mean_that_it_logs(tmp_path, runs, caplog):
    bounds = {"pred_value": 1e-9, "loss_qvalue": 1e9}
    runs.make(tmp_path, bounds=bounds).train()
    (said,) = warnings(caplog)
    assert said.startswith("train, step 4: the mean pred_value is")
    assert "optim.qvalue_lr" in said


@pytest.mark.parametrize("bounds", [None, {}])
def test_without_bounds_nothing_is_said(tmp_path, runs, caplog, bounds):
    runs.make(tmp_path, bounds=bounds).train()
    assert not warnings(caplog)
