"""``torchrl-osr train`` with a dynamics model whose next states are another row's.

    python results/recovery/permuted.py env=walker2d loss=td3_bc dynamics=ensemble ...

A falsifier of ``imagination.py``: states, actions and rewards of the imagined rows stay
as they are, and so does the distribution of the next states; what is gone is which
state follows from which.

Shapes: ``B`` states, ``S`` observation, ``A`` action, ``E`` networks.
"""

from __future__ import annotations

import sys
from typing import Any

import torch
from torch import Tensor, nn
from torchrl_osr.commands import train
from torchrl_osr.experiment import phases
from torchrl_osr.experiment.dynamics import dynamics_model
from torchrl_osr.modules.dynamics import DynamicsEnsemble, Prediction


class Permuted(nn.Module):
    """What :func:`~torchrl_osr.imagination.imagine` asks of a model, by another one."""

    def __init__(self, model: DynamicsEnsemble) -> None:
        super().__init__()
        self.model = model
        self.observation_dim, self.action_dim = model.observation_dim, model.action_dim
        self.disagreement = model.disagreement

    def predict(self, observation: Tensor, action: Tensor) -> Prediction:
        """Change of the state and reward, ``[E, B, S + 1]``."""
        self.state = observation
        return self.model.predict(observation, action)

    def sample(self, prediction: Prediction) -> Tensor:
        """Changes that lead to other rows' next states, and rewards, ``[B, S + 1]``."""
        change, reward = self.model.sample(prediction).split(
            [self.observation_dim, 1], -1
        )
        following = (self.state + change)[torch.randperm(len(change))]
        return torch.cat([following - self.state, reward], -1)


def permuted(*arguments: Any) -> Permuted:
    """In the place of ``dynamics_model``."""
    return Permuted(dynamics_model(*arguments))


if __name__ == "__main__":
    phases.dynamics_model = permuted
    sys.argv[0] = "torchrl-osr"
    train.main()
