"""``torchrl-osr train`` with the simulator itself in the place of the dynamics model.

    python results/recovery/simulated.py env=walker2d loss=td3_bc dynamics=ensemble ...

What imagination could give with a model that is right: an arm of ``imagination.py``.
An ensemble is trained all the same, so that nothing else of the run differs.

Shapes: ``B`` states, ``S`` observation, ``A`` action.
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torchrl.envs import ObservationNorm
from torchrl_osr.commands import train
from torchrl_osr.experiment import phases
from torchrl_osr.experiment.dynamics import dynamics_model
from torchrl_osr.modules.dynamics import Prediction
from world import World

CONTROL_COST = {"hopper": 1e-3, "walker2d": 1e-3, "halfcheetah": 0.1}


class Simulator(nn.Module):
    """What :func:`~torchrl_osr.imagination.imagine` asks of a model, by MuJoCo.

    Velocities beyond those that the observation clips start from the clipped ones.

    Args:
        system: Hopper, Walker2d or HalfCheetah.
        norm: how the data were standardised.
        model: whose sizes it has.
    """

    def __init__(self, system: str, norm: ObservationNorm, model: nn.Module) -> None:
        super().__init__()
        self.world, self.norm = World(system), norm
        self.observation_dim, self.action_dim = model.observation_dim, model.action_dim

    def predict(self, observation: Tensor, action: Tensor) -> Prediction:
        """Change of the state and reward, ``[1, B, S + 1]``, without a doubt."""
        world, scale = self.world, self.norm.scale
        state = (observation * scale + self.norm.loc).double().numpy()
        before = np.hstack([np.zeros((len(state), 2)), state])  # time and x: unseen
        after = world.step(before, action.numpy())
        change = torch.from_numpy(world.observe(after) - state).float() / scale
        reward = after[:, 1:2] / world.seconds - CONTROL_COST[world.system] * (
            np.clip(action.numpy(), -1, 1) ** 2
        ).sum(1, keepdims=True)
        if world.system != "halfcheetah":
            reward += world.standing(after)[:, None]
        mean = torch.cat([change, torch.from_numpy(reward).float()], -1).unsqueeze(0)
        return Prediction(mean, torch.zeros_like(mean))

    def sample(self, prediction: Prediction) -> Tensor:
        """The prediction itself, ``[B, S + 1]``."""
        return prediction.mean[0]

    def disagreement(self, mean: Tensor) -> Tensor:
        """None, ``[B]``."""
        return torch.zeros(mean.shape[1])


def simulator(cfg: Any, data: Any, *rest: Any) -> Simulator:
    """In the place of ``dynamics_model``."""
    return Simulator(cfg.env.name, data.norm, dynamics_model(cfg, data, *rest))


if __name__ == "__main__":
    phases.dynamics_model = simulator
    sys.argv[0] = "torchrl-osr"
    train.main()
