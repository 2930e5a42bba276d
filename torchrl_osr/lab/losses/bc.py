r"""Behaviour cloning, on clean or on perturbed states.

Shapes: ``B`` batch (any leading dimensions), ``A`` action.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase

from torchrl_osr._checks import check_literals
from torchrl_osr._entries import entry, nested, select, state_keys
from torchrl_osr.objectives.base import BaseLoss, Terms
from torchrl_osr.objectives.cloning import cloning_distance, policy_at
from torchrl_osr.objectives.mixed_states import States, of_data, perturbed_state


class BCLoss(BaseLoss):
    r"""Behaviour cloning (BC), and noisy behaviour cloning.

    .. math::
        L_\pi = -\mathbb E_{\tilde s, a} \log\pi(a \mid \tilde s)

    and :math:`\mathbb E \|\pi(\tilde s) - a\|^2` of a deterministic actor. There are no
    critics. With ``states="both"`` it is noisy behaviour cloning, on D_tot; so is
    :class:`~torchrl_osr.StateRecoveryLoss` with ``recovery_target="data"``, which goes
    with other losses and leaves out the ends of trajectories. Here all rows
    of the data count; imagined ones do not.

    Args:
        actor_network: any with a density, or a deterministic one.

    Keyword Args:
        states: of the policy: ``"clean"`` (default), ``"perturbed"``, or ``"both"`` for
            D_tot. All but the first need
            :class:`~torchrl_osr.StatePerturbation`'s entries.
        options: of every loss, of which ``reduction`` and ``use_prioritized_weights``
            matter here, see :class:`~torchrl_osr.objectives.BaseLoss`.

    Raises:
        ValueError: if an option is unknown; in the call, if the batch is empty or its
            actions are of another size.
        KeyError: in the call, if the batch has no perturbed entry.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_osr.lab.losses import BCLoss
        >>> from torchrl_osr.modules import tanh_gaussian_actor
        >>> loss = BCLoss(tanh_gaussian_actor(11, 3))
        >>> batch = TensorDict({
        ...     "observation": torch.randn(4, 11), "action": torch.rand(4, 3)}, [4])
        >>> [*loss(batch).keys()]
        ['loss_actor']
    """

    @dataclass
    class _AcceptedKeys:
        """The tensordict entries that :meth:`set_keys` can rename.

        Attributes:
            action: the data's action, and what an actor writes. Defaults to
                ``"action"``.
            priority_weight: importance weight of a row. Defaults to
                ``"priority_weight"``.
            perturbed: where the perturbed states are. Defaults to ``"perturbed"``.
        """

        action: NestedKey = "action"
        priority_weight: NestedKey = "priority_weight"
        perturbed: NestedKey = "perturbed"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys

    def __init__(
        self,
        actor_network: TensorDictModuleBase,
        *,
        states: States = "clean",
        **options: Any,
    ) -> None:
        check_literals(BCLoss.__init__, locals())
        super().__init__(**({"scalar_output_mode": "exclude"} | options))
        self.convert_to_functional(actor_network, "actor_network")
        self.states = states

    def _input_keys(self) -> list[NestedKey]:
        states = state_keys(self.actor_network.in_keys)
        keys = [*states, self.tensor_keys.action]
        if self.states != "clean":
            keys += [nested(self.tensor_keys.perturbed, key) for key in states]
        return keys

    def _output_keys(self) -> tuple[list[NestedKey], list[NestedKey]]:
        return ["loss_actor"], []

    def _terms(self, tensordict: TensorDictBase) -> Terms:
        keys, stack = state_keys(self.actor_network.in_keys), []
        if self.states != "perturbed":
            stack.append(select(tensordict, keys))
        if self.states != "clean":
            perturbed = self.tensor_keys.perturbed
            stack.append(perturbed_state(tensordict, keys, perturbed))
        key, states = self.tensor_keys.action, torch.stack(stack)
        pi = policy_at(self.actor_network, self.actor_network_params, states, key)
        distance = cloning_distance(pi, entry(tensordict, key), key).mean(0)
        loss = self._reduce(distance, tensordict, of_data(tensordict))
        return {"loss_actor": loss}, {}
