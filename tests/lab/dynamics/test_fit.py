"""The report on a dynamics model, of worlds whose answer is known."""

from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict
from uneven_dynamics import linear_dynamics

from torchrl_osr.lab.data.rows import consecutive_rows
from torchrl_osr.lab.dynamics import DynamicsEnsemble
from torchrl_osr.lab.dynamics.fit import dynamics_report, rollout_errors

NOISE = 0.3


def make_model(*, offset: float = 0.0, scale: float = NOISE) -> DynamicsEnsemble:
    """s' = s + a up to noise, reward = s up to noise; two networks that agree."""
    model = linear_dynamics((1, 1), {(1, 0): 1, (0, 1): 1}, (2, 2), 2 * math.log(scale))
    model.layers[0].bias[:, 0, 0] = offset
    return model


def make_data(rows: int = 20_000, noise: float = NOISE) -> TensorDict:
    """One trajectory."""
    action = torch.randn(rows, 1)
    steps = action + noise * torch.randn(rows, 1)
    path = torch.cat([torch.zeros(1, 1), steps.cumsum(0)])
    no = torch.zeros(rows, 1, dtype=torch.bool)
    reward = path[:-1] + noise * torch.randn(rows, 1)
    after = {"observation": path[1:].clone(), "reward": reward, "done": no}
    after["terminated"] = no.clone()
    found = {"observation": path[:-1], "action": action, "next": after}
    return TensorDict(found, [rows])


def test_report_of_the_true_model() -> None:
    report = dynamics_report(make_model(), make_data())
    entropy = 2 * (0.5 * math.log(2 * math.pi * math.e) + math.log(NOISE))
    assert report["nll"] == pytest.approx(entropy, abs=0.02)
    assert report["within_1_sigma"] == pytest.approx(0.6827, abs=0.01)
    assert report["within_2_sigma"] == pytest.approx(0.9545, abs=0.01)
    assert report["mse"] == pytest.approx(NOISE**2, abs=2e-3)
    # The change has a variance of 1 + .09, of which the noise is .09.
    assert report["r2"][0] == pytest.approx(1 / 1.09, abs=0.01)


def test_disagreement_that_knows_the_error_has_rank_one() -> None:
    model, data = make_model(), make_data(500, noise=0.0)
    model.layers[0].weight[0, 1, 0] = 1.5  # one network errs with the action's size
    data["next", "reward"].zero_()
    data["observation"].zero_()
    data["next", "observation"] = data["action"].clone()
    report = dynamics_report(model, data)
    assert report["disagreement_rank"] == pytest.approx(1.0)


def test_rollout_errors_of_a_constant_error() -> None:
    data = make_data(300, noise=0.0)
    pieces = consecutive_rows(data, torch.arange(0, 280, 7), 20)
    assert len(pieces) == 40
    exact = rollout_errors(make_model(), pieces)
    assert [each["steps"] for each in exact] == [1, 2, 5, 10, 20]
    assert all(each["rmse"] < 1e-4 for each in exact)
    model = make_model(offset=0.25)
    model.input_scale[0] = 2.0  # the unit of the errors
    model.layers[0].weight[:, 0, 1] = 0
    off = rollout_errors(model, pieces, (1, 4))
    assert [each["rmse"] for each in off] == pytest.approx([0.125, 0.5], abs=1e-4)
    moved = pieces["next", "observation"][:, 3] - pieces["observation"][:, 0]
    wanted = (moved / 2).square().mean().sqrt().item()
    assert off[1]["standing_still"] == pytest.approx(wanted, rel=1e-5)
