"""Behaviour cloning."""

from __future__ import annotations

from typing import Any

from tensordict import NestedKey
from tensordict.nn import TensorDictModuleBase

from torchrl_osr._entries import state_keys
from torchrl_osr.objectives.actor_critic import ActorCriticLoss, Losses
from torchrl_osr.objectives.networks import squashing_bounds
from torchrl_osr.objectives.state_recovery import cloning_distance, policy_at
from torchrl_osr.objectives.transitions import Transitions


class BCLoss(ActorCriticLoss):
    r"""Behaviour cloning (BC).

    .. math::
        L_\pi = -\mathbb E_D \log\pi(a \mid s)

    and :math:`\mathbb E_D \|\pi(s) - a\|^2` of a deterministic actor. The actor may
    have discrete actions. Noisy behaviour cloning, on D_tot, is
    :class:`~torchrl_osr.StateRecoveryLoss` with ``recovery_target="data"``.

    Keyword Args:
        options: of every loss, see :class:`~torchrl_osr.objectives.ActorCriticLoss`.

    Examples:
        >>> from torchrl_osr.lab.losses import BCLoss
        >>> from torchrl_osr.modules import tanh_gaussian_actor
        >>> BCLoss(tanh_gaussian_actor(11, 3)).in_keys
        ['observation', 'action']
    """

    def __init__(self, actor_network: TensorDictModuleBase, **options: Any) -> None:
        super().__init__(**options)
        self.convert_to_functional(actor_network, "actor_network")
        self.register_bounds(squashing_bounds(actor_network))
        self.declare(["loss_actor"], [])

    def input_keys(self) -> list[NestedKey]:
        return [*state_keys(self.actor_network.in_keys), self.tensor_keys.action]

    def losses(self, batch: Transitions) -> Losses:
        network, key = self.actor_network, self.tensor_keys.action
        states = batch.states_of(state_keys(network.in_keys), "clean")
        pi = policy_at(network, self.actor_network_params, states, key)
        distance = cloning_distance(pi, batch.a, key).mean(0)
        self.check_actions(batch, batch.a.shape)
        return {"loss_actor": self.reduce(distance, batch, batch.is_data)}, {}
