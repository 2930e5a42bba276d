"""Values by rollouts of a body, where the truth is a recursion."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from uneven_dynamics import linear_dynamics

from torchrl_osr.lab.dynamics import Body
from torchrl_osr.lab.evaluation import fitted_grey_box, rolled_out_values

STEP, GEAR, DAMPING = 0.05, 1.3, 0.8  # the file says 1 and 1
CART = """<mujoco><option timestep="0.05"/><worldbody><body>
<joint name="x" type="slide" axis="1 0 0" damping="1"/><geom size="0.1" mass="1"/>
</body></worldbody><actuator><motor joint="x" gear="1"/></actuator></mujoco>"""
EPISODES, STEPS = 40, 30


def moved(state, action):
    """A cart of 1 kg by MuJoCo's Euler steps, which are implicit in the damping."""
    velocity = (state[:, 1] + STEP * GEAR * action) / (1 + STEP * DAMPING)
    return np.stack([state[:, 0] + STEP * velocity, velocity], 1)


def reward(state):
    return -(state**2).sum(1)


def policy(state):
    return (-state[:, :1] - 0.5 * state[:, 1:]).clamp(-1, 1)


@pytest.fixture(scope="module")
def log() -> TensorDict:
    rng, rows = np.random.default_rng(0), []
    state = rng.uniform(-1, 1, (EPISODES, 2))
    for step in range(STEPS):
        action = rng.uniform(-1, 1, EPISODES)
        following = moved(state, action)
        cut = np.full((EPISODES, 1), step == STEPS - 1)
        rows.append((state, action[:, None], following, reward(state)[:, None], cut))
        state = following
    columns = (np.stack(each, 1) for each in zip(*rows, strict=True))
    state, action, following, rewards, cut = (
        torch.from_numpy(each.reshape(EPISODES * STEPS, -1)) for each in columns
    )
    after = {"observation": following.float(), "reward": rewards.float(), "done": cut}
    after |= {"truncated": cut, "terminated": torch.zeros_like(cut)}
    given = {"observation": state.float(), "action": action.float(), "next": after}
    return TensorDict(given, [EPISODES * STEPS])


def test_a_policys_value_is_that_of_the_recursion(log, tmp_path):
    (file := tmp_path / "cart.xml").write_text(CART)
    model = fitted_grey_box(log, Body(str(file), 1), steps=600, progress=False)
    mass, gear, damping, _ = model.body.factors
    assert gear / mass == pytest.approx(GEAR, rel=0.01)
    assert damping / mass == pytest.approx(DAMPING, rel=0.01)
    found = rolled_out_values(model, log, policy, gamma=0.95)
    state, wanted = log["observation"][::STEPS].double(), 0.0
    for step in range(60):
        wanted += 0.95**step * reward(state.numpy())
        state = torch.from_numpy(moved(state.numpy(), policy(state)[:, 0].numpy()))
    assert found.mean() == pytest.approx(wanted.mean(), rel=0.05)


def test_a_discount_of_1_has_no_finite_value(log):
    with pytest.raises(ValueError, match="The discount is 1; expected at least 0"):
        rolled_out_values(None, log, policy, gamma=1)


def test_returns_by_hand() -> None:
    world = linear_dynamics((1, 1), {(1, 0): 1.0, (0, 1): 1.0}, (1, 1))
    world.limits[1] = 2.5
    state, ended = torch.tensor([[0.0], [-20.0], [3e38]]), torch.ones(3, 1).bool()
    after = {"observation": state, "done": ended, "terminated": ended}
    after["reward"] = torch.tensor([[-1.0], [1.5], [0.0]])
    data = TensorDict({"observation": state, "action": state, "next": after}, [3])
    found = rolled_out_values(
        world, data, lambda s: torch.where(s > 9, 3e38, 1.0), gamma=0.5
    )
    assert sorted(found) == pytest.approx([-63 / 32, 0.5, 0.875])
