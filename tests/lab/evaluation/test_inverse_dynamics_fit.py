"""The report of the inverse dynamics model, on a problem whose answer is known."""

from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.modules import ProbabilisticActor, TanhNormal

from torchrl_osr.lab.evaluation import inverse_dynamics_report

SCALE = 0.3

# It knows the answer: the pre-tanh action is s' - s, up to noise of SCALE.
MODEL = ProbabilisticActor(
    TensorDictModule(
        lambda s, s_next: (s_next - s, torch.full_like(s, SCALE)),
        ["observation", ("next", "observation")],
        ["loc", "scale"],
    ),
    in_keys=["loc", "scale"],
    distribution_class=TanhNormal,
)


def make_data(rows: int) -> TensorDict:
    state, loc = torch.randn(2, rows, 2)
    action = torch.tanh(loc + SCALE * torch.randn(rows, 2))
    after = {"observation": state + loc, "done": torch.zeros(rows, 1).bool()}
    return TensorDict({"observation": state, "action": action, "next": after}, [rows])


def test_report_of_the_true_model():
    data = make_data(20_000)
    report = inverse_dynamics_report(MODEL, data)
    assert report["rows"] == len(data)
    # Entropy of the Gaussian plus the mean log-derivative of the tanh, by definition.
    gaussian = 2 * (0.5 * math.log(2 * math.pi * math.e) + math.log(SCALE))
    squash = (1 - data["action"].square()).clamp_min(1e-12).log().sum(-1).mean().item()
    assert report["nll"] == pytest.approx(gaussian + squash, abs=0.03)
    assert all(0.8 < value < 1 for value in report["r2"])


def test_ended_rows_do_not_count():
    data = make_data(100)
    expected = inverse_dynamics_report(MODEL, data[10:])
    data["next", "done"][:10] = True
    data["next", "observation"][:10] = float("nan")
    assert inverse_dynamics_report(MODEL, data) == expected
    with pytest.raises(ValueError, match=r"hold out more rows \(data\.held_out="):
        inverse_dynamics_report(MODEL, data[:10])
