"""What a run's model says of its policy in recoverable states, and the simulator.

    python results/recovery/model_survival.py <run of loss=rim> > model_survival.txt

Share that stands 100 steps, by group of the public states; of the model's roll-outs
also with the drawn network's distance from the mean of all exaggerated. And the
one-step error along the simulator's way, in standard deviations of the states.

Shapes: ``M`` states, ``S`` observation.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torchrl_osr.evaluation import deterministic_policy
from torchrl_osr.evaluation.recoverable import GROUPS, load_recoverable_states
from torchrl_osr.experiment.dynamics import FILE, load_dynamics
from torchrl_osr.experiment.trained_run import load_trained
from torchrl_osr.imagination import termination
from torchrl_osr.modules.dynamics import Prediction
from world import World

STEPS, TIMES, FACTORS = 100, 8, (1, 2, 3)


@torch.no_grad()
def main() -> None:
    """Play each group in both."""
    run = Path(sys.argv[1])
    trained = load_trained(run)
    act = deterministic_policy(trained.actor, trained.observation_norm)
    norm, model = trained.observation_norm, load_dynamics(run / FILE)
    env = trained.config.env
    states, world = load_recoverable_states(env.name), World(env.name)
    ends = termination(env.id)
    torch.manual_seed(0)
    print(f"{env.name} {trained.config.data.source}, seed {trained.config.seed}")

    def imagined(state: Tensor, factor: float) -> Tensor:
        """Share of the roll-outs from each state that stand, ``[M]``."""
        state = state.repeat(TIMES, 1)
        up = torch.ones(len(state), dtype=torch.bool)
        for _ in range(STEPS):
            mean, scale = model.predict(state, act(state * norm.scale + norm.loc))
            middle = mean[model.elites].mean(0)
            mean = middle + factor * (mean - middle)
            state = state + model.sample(Prediction(mean, scale))[:, :-1]
            finite = state.isfinite().all(-1)
            up &= finite & ~ends(state * norm.scale + norm.loc)
            state = torch.where(finite[:, None], state, 0).clamp(-20, 20)
        return up.reshape(TIMES, -1).float().mean(0)

    for group in GROUPS[::-1]:
        mine = np.flatnonzero(states.group == group)
        start = np.hstack(
            [np.zeros((len(mine), 1)), states.qpos[mine], states.qvel[mine]]
        )
        rows, up, errors = start, np.ones(len(mine), dtype=bool), []
        for _ in range(STEPS):
            seen = torch.from_numpy(world.observe(rows)).float()
            state, action = (seen - norm.loc) / norm.scale, act(seen)
            prediction = model.predict(state, action)
            rows = world.step(rows, action.numpy())
            after = (
                torch.from_numpy(world.observe(rows)).float() - norm.loc
            ) / norm.scale
            error = state + prediction.mean[model.elites].mean(0)[:, :-1] - after
            errors.append(error.norm(dim=-1).median().item())
            up &= world.standing(rows)
        state = (torch.from_numpy(world.observe(start)).float() - norm.loc) / norm.scale
        print(
            f"{group}, {len(mine)} states: {up.mean():.2f} stand in the simulator; "
            f"one-step error {errors[0]:.2f} at first, {errors[10]:.2f} after 10 steps"
        )
        for factor in FACTORS:
            share = imagined(state, factor).numpy()
            fell = f"{share[~up].mean():.2f}" if (~up).any() else "-"
            print(
                f"  {share.mean():.2f} in the model, disagreement times {factor}; of "
                f"those that fall {fell}, of the others {share[up].mean():.2f}"
            )


if __name__ == "__main__":
    main()
