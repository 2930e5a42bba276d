"""RAMBO: a dynamics model that is trained against the policy's value.

Shapes: ``B`` states, ``S`` observation, ``E`` elites.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDict
from tensordict.nn import InteractionType, ProbabilisticTensorDictSequential
from torch import Tensor
from torch.distributions import Normal

from torchrl_osr.lab.dynamics.models import DynamicsEnsemble, DynamicsLoss
from torchrl_osr.lab.dynamics.options import DynamicsOptions, ModelData
from torchrl_osr.lab.dynamics.rollouts import action_of, termination
from torchrl_osr.objectives import ActorCriticLoss

SEED = 2**40
"""Added to a seed, so that rollouts with the same one draw other numbers."""


class ModelAdversary:
    r"""Train a model to predict the data, and to be bad for the policy elsewhere.

    .. math::
        L = L_{NLL} + \lambda\, \mathbb E \Big[ \bar A(s, a, s', r)\,
            \log \frac1E \sum_{i=1}^{E} p_i(s', r \mid s, a) \Big], \quad
        A = r + \gamma\,(1 - \text{terminated}) \min_j Q_j(s', \pi(s'))
            - \min_j Q_j(s, a)

    The first term is :class:`DynamicsLoss` on the data. The second is a policy gradient
    with the model as the policy, on rollouts of the actor: transitions to worse states
    than expected become more likely. Rollouts go on after an end of the task, as in
    RAMBO's code (https://arxiv.org/abs/2204.12581, marc-rigter/rambo).

    ``loss`` has the critics; the model is trained already.
    """

    def __init__(
        self,
        options: DynamicsOptions,
        data: ModelData,
        model: DynamicsEnsemble,
        loss: ActorCriticLoss,
        actor: ProbabilisticTensorDictSequential,
    ) -> None:
        self.options, self.data, self.loss, self.actor = options, data, loss, actor
        self.model = model.requires_grad_(True)
        groups, rate = model.parameter_groups(), options.adversarial_lr
        self.optimizer = torch.optim.Adam(groups, lr=rate, fused=True)
        self.terminated = termination(data.env_id, model.limits, data.loc, data.scale)
        self.real, self.likelihood = data.buffer(), DynamicsLoss(model)

    def __call__(self, number: int) -> None:
        """Train the model; the buffer's generator draws rows, the number the rest."""
        options, device = self.options, self.model.elites.device
        with torch.random.fork_rng([device] if device.type == "cuda" else []):
            torch.manual_seed((SEED + (self.data.seed << 20) + number) % 2**63)
            for step in range(options.adversarial_steps):
                if step % options.rollout_steps == 0:
                    state = self.real.sample(options.batch_size)["observation"]
                rows = self.real.sample(self.model.num_networks * options.batch_size)
                likelihood = sum(self.likelihood(rows).values())
                objective, state = self.objective(state)
                (likelihood + options.adversarial_weight * objective.mean()).backward()
                self.optimizer.step()
                self.optimizer.zero_grad()

    def objective(self, state: Tensor) -> tuple[Tensor, Tensor]:
        r"""Return the term with :math:`\lambda`, ``[B]``, and next states."""
        model = self.model
        with torch.no_grad():
            action = action_of(self.actor, state, InteractionType.RANDOM)
        mean, scale = model.predict(state, action)
        with torch.no_grad():
            sample = model.sample(mean, scale)
            following, reward = state + sample[..., :-1], sample[..., -1]
            goes_on = ~self.terminated(following)
            after = action_of(self.actor, following, InteractionType.DETERMINISTIC)
            value = self._value(following, after)
            advantage = reward + self.data.gamma * goes_on * value
            advantage = advantage - self._value(state, action)
        density = Normal(mean[model.elites], scale[model.elites])
        log_prob = density.log_prob(sample).sum(-1)  # type: ignore[no-untyped-call]
        log_density = log_prob.logsumexp(0) - math.log(len(log_prob))
        # Equation (9), standardised as in the code.
        standardized = (advantage - advantage.mean()) / (advantage.std() + 1e-6)
        return standardized * log_density, following

    def _value(self, state: Tensor, action: Tensor) -> Tensor:
        batch = TensorDict({"observation": state}, state.shape[:-1])
        return self.loss.q(batch, action).amin(0)

    def state_dict(self) -> dict[str, Any]:
        model, optimizer = self.model.state_dict(), self.optimizer.state_dict()
        return {"model": model, "optimizer": optimizer}

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        self.model.load_state_dict(state_dict["model"])
        self.optimizer.load_state_dict(state_dict["optimizer"])
