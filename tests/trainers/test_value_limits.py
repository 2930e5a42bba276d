"""Values that diverge are warned of once, where they first exceed their limit."""

from __future__ import annotations

import math

import pytest

from torchrl_osr.trainers import largest_value


def test_largest_value_is_ten_times_the_largest_return():
    # The reward for ever: 3 + 3/2 + 3/4 + ... = 6.
    assert largest_value(3.0, 0.5) == 60.0
    assert largest_value(3.0, 1.0) == math.inf


@pytest.mark.parametrize("limits", [None, {"pred_value": 1e-9, "loss_qvalue": 1e9}])
def test_trainer_warns_once_of_a_mean_that_it_logs(tmp_path, runs, caplog, limits):
    runs.make(tmp_path, value_limits=limits).train()
    said = [each.message for each in caplog.records if each.levelname == "WARNING"]
    assert len(said) == bool(limits)
    for message in said:
        assert message.startswith("train, step 4: the mean pred_value is")
        assert "optim.qvalue_lr" in message
