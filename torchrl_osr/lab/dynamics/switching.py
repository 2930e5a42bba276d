"""Policy selection by predicted return.

Shapes: ``B`` states, ``S`` observation, ``A`` action, ``N`` policies, ``E`` networks of
the dynamics, ``T`` steps of a roll-out.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from torchrl_osr._checks import check_positive
from torchrl_osr.lab.dynamics.ensemble import EliteNetworks
from torchrl_osr.lab.dynamics.rollouts import Termination, mean_rollout, never


class SwitchingPolicy:
    r"""Act with the policy that has the largest predicted return.

    .. math::
        \hat R_n(s) = \operatorname*{mean}_i \Big(
        \sum_{t<T} \gamma^t r^{i,n}_t + \gamma^T Q(s^{i,n}_T, \pi_n(s^{i,n}_T)) \Big),
        \qquad a = \pi_{n^*}(s), \quad n^* = \arg\max_n \hat R_n(s)

    Each network :math:`i` of the dynamics is rolled out from :math:`s` with its mean
    predictions and the policy :math:`\pi_n`; no reward and no value follow after an
    end. This is policy switching (Chang, Givan and Chong, "Parallel Rollout for Online
    Solution of Partially Observable Markov Decision Processes", 2004) with learned
    dynamics and values. Without a model it is generalised policy improvement
    (https://arxiv.org/abs/1606.05312) over policies.

    A choice holds for several calls. Call :meth:`reset` at the start of an episode.

    Args:
        policies: each maps observations ``[n, S]`` to actions ``[n, A]``.
        networks: of one or several models, in the policies' units. ``None``: the
            values alone choose.
        value: of observations ``[n, S]`` and actions ``[n, A]``, ``[n]``.

    Keyword Args:
        terminated: of next observations. Default: never.
        steps: ``T``. Default 20.
        gamma: discount factor. Default 0.99.
        hold: calls for which the chosen policy acts. Default 4.

    Attributes:
        chosen: number of the acting policy in each state, ``[B]``; ``None`` at first.

    Examples:
        >>> import torch
        >>> from torchrl_osr.lab.dynamics import SwitchingPolicy
        >>> rest = lambda state: torch.zeros(len(state), 3)
        >>> push = lambda state: torch.ones(len(state), 3)
        >>> policy = SwitchingPolicy(
        ...     [rest, push], None, lambda state, action: action.sum(-1) * state[:, 0])
        >>> policy(torch.tensor([[0.5], [-0.5]]))
        tensor([[1., 1., 1.],
                [0., 0., 0.]])
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
        check_positive("steps", steps, minimum=1)
        check_positive("hold", hold, minimum=1)
        self.policies, self.value, self.terminated = list(policies), value, terminated
        self.networks = networks
        self.steps, self.gamma, self.hold = steps, gamma, hold
        self.reset()

    def reset(self) -> None:
        """Choose anew at the next call."""
        self.chosen: Tensor | None = None
        self._calls = 0

    def act(self, observation: ArrayLike) -> NDArray[np.float32]:
        """Return actions ``[A]`` or ``[B, A]`` for ``[S]`` or ``[B, S]``."""
        rows = torch.as_tensor(np.asarray(observation, np.float32))
        action = self(rows.view(-1, rows.shape[-1]))
        found: NDArray[np.float32] = action.view(*rows.shape[:-1], -1).numpy()
        return found

    @torch.no_grad()
    def __call__(self, observation: Tensor) -> Tensor:
        """Return actions ``[B, A]`` for ``[B, S]``; another ``B`` chooses anew."""
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
        if self.networks is None:
            return self._values(starts).view(-1, len(self.policies))
        reward, alive, last = mean_rollout(
            self.networks,
            self._actions,
            starts,
            steps=self.steps,
            terminated=self.terminated,
        )
        discount = self.gamma ** torch.arange(self.steps, device=starts.device)
        value = self._values(last).where(alive[-1], 0.0)
        found = discount @ reward + self.gamma**self.steps * value
        return found.view(-1, len(starts)).mean(0).view(-1, len(self.policies))

    def _actions(self, state: Tensor) -> Tensor:
        """Return actions for ``[n N, S]``, by each policy in turn."""
        rows = state.view(-1, len(self.policies), state.shape[-1]).unbind(1)
        pairs = zip(self.policies, rows, strict=True)
        return torch.stack([policy(each) for policy, each in pairs], 1).flatten(0, 1)

    def _values(self, state: Tensor) -> Tensor:
        """Return the values of these actions, ``[n N]``."""
        return self.value(state, self._actions(state))
