"""Values that diverge are warned of once, where they first exceed their limit."""

from __future__ import annotations

import math

import pytest

from torchrl_osr.trainers import largest_value
from torchrl_osr.trainers.value_limits import ValueLimits


def warnings(caplog) -> list[str]:
    return [each.message for each in caplog.records if each.levelname == "WARNING"]


def test_each_name_is_warned_of_once(caplog):
    limits = ValueLimits({"a": 1.0, "b": 2.0, "absent": 0.0})
    limits.check({"a": -1.0, "b": 2.0, "c": 1e9}, "step 1")
    assert not warnings(caplog)
    for step in (2, 3):
        limits.check({"a": -1.5, "b": 2.0}, f"step {step}")
    limits.check({"b": math.inf, "a": 9.0}, "step 4")
    first, second = warnings(caplog)
    assert first.startswith("step 2: the mean a is -1.5; a magnitude above 1 means")
    assert second.startswith("step 4: the mean b is inf; a magnitude above 2 means")


def test_largest_value_is_ten_times_the_largest_return():
    # The reward for ever: 3 + 3/2 + 3/4 + ... = 6.
    assert largest_value(3.0, 0.5) == 60.0
    assert largest_value(3.0, 1.0) == math.inf


@pytest.mark.parametrize("limits", [None, {"pred_value": 1e-9, "loss_qvalue": 1e9}])
def test_trainer_warns_of_a_mean_that_it_logs(tmp_path, runs, caplog, limits):
    runs.make(tmp_path, value_limits=limits).train()
    said = warnings(caplog)
    assert len(said) == bool(limits)
    for message in said:
        assert message.startswith("train, step 4: the mean pred_value is")
        assert "optim.qvalue_lr" in message
