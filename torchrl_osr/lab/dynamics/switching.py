"""A policy that lets the best of several policies act.

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
from torchrl_osr.lab.dynamics.elite_networks import EliteNetworks
from torchrl_osr.lab.dynamics.rollout import expect
from torchrl_osr.lab.dynamics.termination import Termination, never


class SwitchingPolicy:
    r"""Of several policies, the one acts whose predicted return is the largest.

    .. math::
        \hat R_n(s) = \operatorname*{mean}_i \Big(
        \sum_{t<T} \gamma^t r^{i,n}_t + \gamma^T Q(s^{i,n}_T, \pi_n(s^{i,n}_T)) \Big),
        \qquad a = \pi_{n^*}(s), \quad n^* = \arg\max_n \hat R_n(s)

    Each network :math:`i` of the dynamics is rolled out by itself with its mean
    prediction, from :math:`s` on and with the policy :math:`\pi_n`; where the task ends
    in it, no reward and no value follow. Policies of several seeds fail in different
    states: between them there is more to choose from than in one.

    It is policy switching (Chang, Givan and Chong, "Parallel Rollout for Online
    Solution of Partially Observable Markov Decision Processes", 2004) with learned
    dynamics and a learned value; without a model it is generalized policy improvement
    (https://arxiv.org/abs/1606.05312, theorem 1) over whole policies.

    A choice holds for several calls, so that what happened before matters: call
    :meth:`reset` at the start of an episode. Another number of states is chosen for
    anew.

    Args:
        policies: each maps observations ``[n, S]`` to actions ``[n, A]``, without
            randomness of its own.
        networks: of the dynamics, in the policies' units, of one model or of several
            (:meth:`~torchrl_osr.lab.dynamics.EliteNetworks.join`). ``None``: the values
            alone choose, at hardly any cost.
        value: of observations ``[n, S]`` and actions ``[n, A]``, ``[n]``.

    Keyword Args:
        terminated: of next observations, see
            :func:`~torchrl_osr.lab.dynamics.termination`. Default: never.
        steps: ``T``. Default 20.
        gamma: discount of the rewards and of the value. Default 0.99.
        hold: for how many calls the chosen policy acts. Default 4.

    Attributes:
        chosen: which policy acts in each state, ``[B]``; ``None`` before the first
            call.

    Raises:
        ValueError: there is no policy, or a number is out of its range.

    Examples:
        >>> import torch
        >>> from torchrl_osr.lab.dynamics import SwitchingPolicy, termination
        >>> from torchrl_osr.lab.dynamics import DynamicsEnsemble, EliteNetworks
        >>> rest = lambda state: torch.zeros(len(state), 3)
        >>> push = lambda state: torch.ones(len(state), 3)
        >>> switching = SwitchingPolicy(
        ...     [rest, push], EliteNetworks(DynamicsEnsemble(11, 3)),
        ...     value=lambda state, action: action.sum(-1) * state[:, 1].sign(),
        ...     terminated=termination("Hopper-v5"), steps=1, gamma=1.0)
        >>> state = torch.zeros(2, 11)
        >>> state[:, 0], state[0, 1], state[1, 1] = 1.2, 0.15, -0.15
        >>> switching(state).shape, switching.returns(state).shape
        (torch.Size([2, 3]), torch.Size([2, 2]))

    :func:`~torchrl_osr.lab.run.switching.load_switching_policy` makes one of finished
    runs.
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
        if not policies:
            raise ValueError("there is no policy to choose from.")
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
        """Actions for observations as an environment gives them, ``[S]`` or ``[B, S]``.

        Returns:
            ``[A]`` or ``[B, A]``.
        """
        rows = torch.as_tensor(np.asarray(observation, np.float32))
        action = self(rows.view(-1, rows.shape[-1]))
        found: NDArray[np.float32] = action.view(*rows.shape[:-1], -1).numpy()
        return found

    @torch.no_grad()
    def __call__(self, observation: Tensor) -> Tensor:
        """Actions ``[B, A]`` for observations ``[B, S]``."""
        holds = self.chosen is not None and len(self.chosen) == len(observation)
        if not holds or self._calls == self.hold:
            self.chosen, self._calls = self.returns(observation).argmax(1), 0
        self._calls += 1
        actions = torch.stack([policy(observation) for policy in self.policies], 1)
        return actions[torch.arange(len(observation)), self.chosen]

    @torch.no_grad()
    def returns(self, observation: Tensor) -> Tensor:
        """Predicted return of each policy, ``[B, N]``, for observations ``[B, S]``."""
        starts = observation.repeat_interleave(len(self.policies), 0)
        if self.networks is None:
            found = self._values(starts)
        else:
            way = expect(
                self.networks,
                lambda state, step: self._actions(state),
                starts,
                steps=self.steps,
                terminated=self.terminated,
            )
            discount = self.gamma ** torch.arange(self.steps, device=starts.device)
            value = self._values(way.state).where(way.alive[-1], 0.0)
            found = discount @ way.reward + self.gamma**self.steps * value
            found = found.view(-1, len(starts)).mean(0)
        return found.view(-1, len(self.policies))

    def _actions(self, state: Tensor) -> Tensor:
        """What the first policy does in the first of ``[n N, S]``, and so on."""
        rows = state.view(-1, len(self.policies), state.shape[-1]).unbind(1)
        pairs = zip(self.policies, rows, strict=True)
        return torch.stack([policy(each) for policy, each in pairs], 1).flatten(0, 1)

    def _values(self, state: Tensor) -> Tensor:
        """The values of these actions, ``[n N]``."""
        return self.value(state, self._actions(state))
