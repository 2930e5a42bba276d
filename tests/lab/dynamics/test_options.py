"""Options of dynamics models that contradict each other."""

from __future__ import annotations

import pytest

from torchrl_osr.lab.dynamics import DynamicsOptions


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"num_elites": 9}, "num_elites=. must be between 1 and num_networks=7"),
        ({"real_ratio": 0.01}, "real_ratio=0.01: 0 of 8 rows"),
        ({"unknown": "halt"}, "needs optim.gamma below 1"),
        ({"unknown": "halts"}, "dynamics.unknown must be one of"),
        ({"adversarial_steps": 9, "batch_size": 1}, "batch_size must be at least 2"),
    ],
)
def test_options_that_contradict_each_other_are_refused(options, message) -> None:
    options = {"real_ratio": 0.25} | options
    with pytest.raises(ValueError, match=message):
        DynamicsOptions(**options).check("Hopper-v5", batch_size=8, gamma=1.0)
