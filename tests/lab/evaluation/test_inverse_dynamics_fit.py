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


def make_model(offset: float = 0.0, scale: float = SCALE) -> ProbabilisticActor:
    """A model that knows: the pre-tanh action is s' - s, up to noise of SCALE."""
    return ProbabilisticActor(
        TensorDictModule(
            lambda s, s_next: (s_next - s + offset, torch.full_like(s, scale)),
            ["observation", ("next", "observation")],
            ["loc", "scale"],
        ),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
    )


def make_data(rows: int = 20_000) -> TensorDict:
    state = torch.randn(rows, 2)
    loc = torch.randn(rows, 2)
    action = torch.tanh(loc + SCALE * torch.randn(rows, 2))
    next_state = {
        "observation": state + loc,
        "done": torch.zeros(rows, 1, dtype=torch.bool),
    }
    batch = {"observation": state, "action": action, "next": next_state}
    return TensorDict(batch, [rows])


def test_report_of_the_true_model():
    data = make_data()
    report = inverse_dynamics_report(make_model(), data)
    assert report["rows"] == len(data)
    assert report["coverage_90"] == pytest.approx(0.9, abs=0.005)
    # Entropy of the Gaussian plus the mean log-derivative of the tanh, by definition.
    gaussian = 2 * (0.5 * math.log(2 * math.pi * math.e) + math.log(SCALE))
    squash = (1 - data["action"].square()).clamp_min(1e-12).log().sum(-1).mean().item()
    assert report["nll"] == pytest.approx(gaussian + squash, abs=0.03)
    assert all(0.8 < value < 1 for value in report["r2"])


def test_overconfident_model_covers_too_little():
    # Half the scale: P(|z| < 1.645 / 2) = 0.589 by the normal distribution.
    report = inverse_dynamics_report(make_model(scale=SCALE / 2), make_data())
    assert report["coverage_90"] == pytest.approx(0.589, abs=0.01)


def test_ended_rows_do_not_count():
    data = make_data(100)
    expected = inverse_dynamics_report(make_model(), data[10:])
    data["next", "done"][:10] = True
    data["next", "observation"][:10] = float("nan")
    assert inverse_dynamics_report(make_model(), data) == expected
