"""Policy selection by predicted return.

Shapes: ``B`` states, ``S`` observation, ``A`` action, ``N`` policies, ``E`` networks.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy

import torch
from torch import Tensor

from torchrl_osr.lab.dynamics.models import DynamicsEnsemble
from torchrl_osr.lab.dynamics.rollouts import Termination, never


class EliteNetworks:
    """Predict mean changes of the state and rewards with a model's frozen elites.

    States and actions are in the environment's units: the model's states are
    ``(s - loc) / scale``, its actions -1 and 1 are ``low`` and ``high``. All scaling is
    folded into two layers, for speed at action time. Of a grey box, one elite alone
    adds to what the body does.
    """

    @torch.no_grad()
    def __init__(
        self,
        model: DynamicsEnsemble,
        loc: Tensor | float = 0.0,
        scale: Tensor | float = 1.0,
        low: Tensor | float = -1.0,
        high: Tensor | float = 1.0,
    ) -> None:
        ones = model.target_loc.new_ones
        states, actions = ones(model.observation_dim), ones(model.action_dim)
        center = torch.cat([loc * states, (low + high) / 2 * actions]).double()
        unit = torch.cat([scale * states, (high - low) / 2 * actions]).double()
        elites = model.elites if model.body is None else model.elites[:1]
        weights = [each.weight[elites].double() for each in model.layers]
        biases = [each.bias[elites].double() for each in model.layers]
        weights[0] /= (unit * model.input_scale).unsqueeze(-1)
        biases[0] -= ((center + unit * model.input_loc) @ weights[0]).unsqueeze(1)
        size = len(model.target_loc)  # log-variances follow
        out = torch.cat([scale * states, ones(1)]).double()
        weights[-1] = weights[-1][..., :size] * model.target_scale * out
        biases[-1] = biases[-1][..., :size] * model.target_scale * out
        biases[-1] += model.target_loc * out
        self.weights = [each.float() for each in weights]
        self.biases = [each.float() for each in biases]
        self.activation = model.activation
        self.limits = model.limits * scale + loc
        self.body = model.body and model.body.in_own_units()

    def observed(self, state: Tensor) -> Tensor:
        """Return what a policy sees of states ``[n, S]``."""
        return state if self.body is None else self.body.observed(state)

    @classmethod
    def join(cls, parts: Sequence[EliteNetworks]) -> EliteNetworks:
        """Return the networks of several models as one; their layers must be alike."""
        joined = copy(parts[0])
        if len({tuple(w.shape[1:] for w in each.weights) for each in parts}) > 1:
            raise ValueError(
                "The models differ in layers: choose runs of equal dynamics.num_cells."
            )
        weights, biases = zip(*((p.weights, p.biases) for p in parts), strict=True)
        joined.weights = [torch.cat(layer) for layer in zip(*weights, strict=True)]
        joined.biases = [torch.cat(layer) for layer in zip(*biases, strict=True)]
        low, high = torch.stack([each.limits for each in parts], 1)
        joined.limits = torch.stack([low.amax(0), high.amin(0)])  # the narrowest
        return joined

    def __call__(self, observation: Tensor, action: Tensor) -> Tensor:
        """Return ``[E, n, S + 1]`` at ``[E, n, S]`` and ``[E, n, A]``."""
        hidden = torch.cat([observation, action], -1).to(self.weights[0].dtype)
        *layers, last = zip(self.biases, self.weights, strict=True)
        for bias, weight in layers:
            hidden = self.activation(torch.baddbmm(bias, hidden, weight))
        found = torch.baddbmm(last[0], hidden, last[1])
        if self.body is not None:
            found[0, :, :-1] += self.body(observation[0], action[0]) - observation[0]
        return found


class SwitchingPolicy:
    r"""Act with the policy that has the largest predicted return.

    .. math::
        \hat R_n(s) = \operatorname*{mean}_i \Big(
        \sum_{t<T} \gamma^t r^{i,n}_t + \gamma^T Q(s^{i,n}_T, \pi_n(s^{i,n}_T)) \Big),
        \qquad a = \pi_{n^*}(s), \quad n^* = \arg\max_n \hat R_n(s)

    Each network :math:`i` of the dynamics is rolled out from :math:`s` with its mean
    predictions and the policy :math:`\pi_n`; no reward and no value follow after an
    end. This is policy switching (Chang, Givan and Chong, "Parallel Rollout", 2004)
    with learned dynamics and values. Call :meth:`reset` at the start of an episode.

    Args:
        policies: each maps observations ``[n, S]`` to actions ``[n, A]``.
        networks: of one or several models; ``None``: the values alone choose.
        value: of observations and actions, ``[n]``.

    Keyword Args:
        terminated: of next observations.
        steps, gamma: :math:`T` and :math:`\gamma`, default 20 and 0.99.
        hold: number of calls until the next choice, default 4.
    """

    def __init__(
        self,
        policies: Sequence[Callable[[Tensor], Tensor]],
        networks: EliteNetworks | None,
        value: Callable[[Tensor, Tensor], Tensor],
        *,
        terminated: Termination = never,
        steps: int = 20,
        gamma: float = 0.99,
        hold: int = 4,
    ) -> None:
        self.policies, self.value, self.terminated = list(policies), value, terminated
        self.networks = networks
        self.steps, self.gamma, self.hold = steps, gamma, hold
        self.reset()

    def reset(self) -> None:
        """Choose a policy at the next call."""
        self.chosen: Tensor | None = None
        self._calls = 0

    @torch.no_grad()
    def __call__(self, observation: Tensor) -> Tensor:
        """Return actions ``[B, A]`` for ``[B, S]``; a change of ``B`` is a reset."""
        holds = self.chosen is not None and len(self.chosen) == len(observation)
        if not holds or self._calls == self.hold:
            self.chosen, self._calls = self.returns(observation).argmax(1), 0
        self._calls += 1
        actions = torch.stack([policy(observation) for policy in self.policies], 1)
        return actions[torch.arange(len(observation)), self.chosen]

    @torch.no_grad()
    def returns(self, observation: Tensor) -> Tensor:
        """Return each policy's predicted return, ``[B, N]``, for ``[B, S]``."""
        starts = observation.repeat_interleave(len(self.policies), 0)
        networks = self.networks
        if networks is None:
            value = self.value(starts, self._actions(starts))
            return value.view(-1, len(self.policies))
        number = len(networks.weights[0])
        rows, state = (number, len(starts), -1), starts.repeat(number, 1)
        going = torch.ones_like(state[:, 0], dtype=torch.bool)
        reward = torch.zeros(self.steps, len(going), device=starts.device)
        for step in range(self.steps):
            action = self._actions(networks.observed(state)).reshape(rows)
            change = networks(state.view(rows), action).flatten(0, 1)
            # A prediction that is not finite ends the task without a reward.
            going = going & change.isfinite().all(-1)
            reward[step] = change[:, -1].where(going, 0.0)
            following = state + change[:, :-1]
            going = going & ~self.terminated(following)
            # States after the end must not grow until they overflow.
            state = torch.where(going.unsqueeze(-1), following, state)
            if not going.any():
                break
        discount = self.gamma ** torch.arange(self.steps, device=starts.device)
        seen = networks.observed(state)
        value = self.value(seen, self._actions(seen)).where(going, 0.0)
        found = discount @ reward + self.gamma**self.steps * value
        return found.view(number, len(starts)).mean(0).view(-1, len(self.policies))

    def _actions(self, state: Tensor) -> Tensor:
        """Return actions for ``[n N, S]``, by each policy in turn."""
        number = len(self.policies)
        found = [policy(state[i::number]) for i, policy in enumerate(self.policies)]
        return torch.stack(found, 1).flatten(0, 1)
