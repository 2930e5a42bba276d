"""What step 4's model and value know of the states: against the simulator.

    python results/recovery/model_error.py > results/recovery/model_error.txt

For each model and each group of the public half of Walker2d: steps of the next 100
that the base stands, in the simulator and as predicted (mean over networks); the value;
and the error of one predicted step, mean of the networks, in standard deviations of the
data's steps (the small model's data), root of the mean square over entries.
"""

from __future__ import annotations

import numpy as np
import torch
from cloning import rows_of
from look_ahead import MODELS, LookAheadPolicy, ensemble, policy_of, survival
from states import normal
from torchrl_osr.evaluation.recoverable import (
    GROUPS,
    STATES,
    read_recoverable_states,
)
from world import World

STEPS = 100


def describe(model: str) -> None:
    """Print a line for each group, of seed 0."""
    torch.set_num_threads(1)
    world = World("walker2d")
    normal(world)
    path = STATES / "walker2d-public.npz"
    states = read_recoverable_states(path)
    rows = rows_of(states, slice(None))
    observation = torch.from_numpy(world.observe(rows)).float()
    policy, _ = policy_of("look-ahead", "80", model, 0, world)
    assert isinstance(policy, LookAheadPolicy)
    policy.planning_horizon = STEPS
    nothing = torch.zeros(len(rows), 1, 1, world.nu)
    predicted = policy.scores(observation, nothing)[:, 0].numpy()
    value = survival("walker2d", 0)(observation).numpy()

    def act(given: np.ndarray) -> np.ndarray:
        return policy.policy(torch.from_numpy(given).float()).numpy()

    alive = world.play(rows, act, STEPS).alive
    action = policy.policy(observation)
    after = torch.from_numpy(world.observe(world.step(rows, action.numpy()))).float()
    mean, _ = policy.model.predict(observation, action)
    difference = observation + mean[..., :-1].mean(0) - after
    error = difference / ensemble(world, "small", 0).target_scale[:-1]
    for group in GROUPS:
        of = states.group == group
        one = error[of].square().mean().sqrt().item()
        print(
            f"{model}, {group}: {of.sum()} states, stands {alive[of].mean():.0f} of "
            f"{STEPS} steps, predicted {predicted[of].mean():.0f}, value "
            f"{value[of].mean():.0f}; error of one step {one:.2f}",
            flush=True,
        )


if __name__ == "__main__":
    for size in MODELS:
        describe(size)
