"""Values of policies on data alone, where the truth is known in closed form."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from torchrl_osr.lab.evaluation import offline
from torchrl_osr.lab.evaluation.offline import episode_values, fitted_values

GAMMA, STEPS, EPISODES = 0.8, 20, 150
A, B, NOISE = 0.9, 0.5, 0.1  # s' = A s + B a + noise, r = -s^2 - 0.1 a^2


def rolled_out(gain: float, spread: float, seed: int = 0) -> TensorDict:
    """Episodes of the policy a = gain s and exploration, cut after some steps."""
    rng = np.random.default_rng(seed)
    state, rows = rng.uniform(-1, 1, EPISODES), []
    for step in range(STEPS):
        action = (gain * state + spread * rng.uniform(-1, 1, EPISODES)).clip(-1, 1)
        following = A * state + B * action + NOISE * rng.normal(size=EPISODES)
        cut = np.full(EPISODES, step == STEPS - 1)
        rows.append((state, action, following, -(state**2) - 0.1 * action**2, cut))
        state = following
    columns = (np.stack(each, 1).reshape(-1, 1) for each in zip(*rows, strict=True))
    state, action, following, reward, cut = map(torch.from_numpy, columns)
    after = {"observation": following.float(), "reward": reward.float(), "done": cut}
    after |= {"truncated": cut, "terminated": torch.zeros_like(cut)}
    given = {"observation": state.float(), "action": action.float(), "next": after}
    return TensorDict(given, [len(state)])


def true_value(gain: float, start: torch.Tensor) -> float:
    """V(s) = -p s^2 - c of a = gain s, with p and c from Bellman's equation."""
    closed = A + B * gain
    p = (1 + 0.1 * gain**2) / (1 - GAMMA * closed**2)
    c = GAMMA * p * NOISE**2 / (1 - GAMMA)
    return float(-p * (start.double() ** 2).mean() - c)


@pytest.mark.parametrize("gain", [-1.0, 0.0])
def test_the_value_of_a_linear_policy_is_the_closed_forms(gain):
    data = rolled_out(-0.3, 0.7)
    options = {"gamma": GAMMA, "steps": 800}
    found = fitted_values(data, lambda s: gain * s, progress=False, **options)
    assert found.shape == (3, EPISODES)
    truth = true_value(gain, data["observation"][::STEPS])
    assert found.mean() == pytest.approx(truth, rel=0.1)


def test_the_datas_own_value_is_that_of_its_episodes():
    data = rolled_out(-1.0, 0.0)
    truth = true_value(-1.0, data["observation"][::STEPS])
    assert episode_values(data, GAMMA).mean() == pytest.approx(truth, rel=0.05)


def test_critics_learn_from_whole_episodes_and_the_policys_choices(monkeypatch):
    data, given = rolled_out(-0.3, 0.7), []
    monkeypatch.setattr(offline, "fit", lambda *each, **_: given.extend(each))
    data["action"] = data["action"].expand(-1, 2)
    data["next", "reward"] = 1 + data["action"][:, :1] ** 2
    fitted_values(data, lambda s: (s[:, 0] > 0).long(), gamma=GAMMA)
    update, rows, *_ = given
    drawn = rows["bootstrap"].reshape(EPISODES, STEPS, 3)
    assert (drawn == drawn[:, :1]).all()
    assert {0, 1, 2} <= {*drawn.flatten().tolist()}
    assert update.loss_module.value_bounds == (0, 1)
    choice = data["next", "observation"][:, 0] > 0
    assert torch.equal(rows["next", "action"].argmax(-1), choice.long())
