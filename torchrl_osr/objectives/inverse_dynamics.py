r"""The loss that trains the inverse dynamics model, section 4.2.

Shapes: ``B`` batch (any leading dimensions), ``S`` observation, ``A`` action.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from tensordict import NestedKey, TensorDictBase
from tensordict.nn import (
    ProbabilisticTensorDictSequential,
    TensorDictParams,
    dispatch,
)
from torch import Tensor

from torchrl_osr.objectives.base import BaseLoss, Reduction, check_choice
from torchrl_osr.objectives.distributions import action_bounds, check_action
from torchrl_osr.objectives.mixed_states import (
    column,
    entry,
    nested,
    reduce_transitions,
    state_keys,
    transitions,
)


class InverseDynamicsLoss(BaseLoss):
    r"""Negative log-likelihood of the data's action given both states.

    .. math::
        L = -\mathbb E_{(\tilde s, a, s') \sim D_{tot}} \log I(a \mid \tilde s, s')

    on clean and perturbed states alike (the authors' released code trains on clean
    states only, and on the squared error of a sampled action). Rows that are ``done``
    are left out: their ``s'`` may not be a next state. Presented in "Recovering from
    Out-of-sample States via Inverse Dynamics in Offline Reinforcement Learning",
    https://openreview.net/forum?id=4gLWjSaw4o.

    Args:
        inverse_dynamics_network: reads states and next states, ends in a
            :class:`~torchrl.modules.TanhNormal`; see
            :func:`~torchrl_osr.modules.tanh_gaussian_inverse_dynamics`.

    Keyword Args:
        states: ``"both"`` (default) for D_tot, which needs the ``"perturbed"`` entry
            of :class:`~torchrl_osr.StatePerturbation`; ``"clean"`` for the data alone.
        reduction: ``"mean"`` (default), ``"sum"`` or ``"none"``.

    Raises:
        TypeError: if the network does not end in a ``TanhNormal``.
        KeyError: in the call, if no perturbed entry is there, unless
            ``states="clean"``.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_osr import InverseDynamicsLoss, StatePerturbation
        >>> from torchrl_osr.modules import tanh_gaussian_inverse_dynamics
        >>> loss = InverseDynamicsLoss(tanh_gaussian_inverse_dynamics(11, 3))
        >>> batch = TensorDict({
        ...     "observation": torch.randn(4, 11), "action": torch.rand(4, 3),
        ...     "next": {"observation": torch.randn(4, 11),
        ...              "done": torch.zeros(4, 1, dtype=torch.bool)}}, [4])
        >>> batch = StatePerturbation(std=1e-3)(batch)
        >>> loss(batch)["loss_inverse_dynamics"].shape
        torch.Size([])
    """

    @dataclass
    class _AcceptedKeys:
        """The tensordict entries that :meth:`set_keys` can rename.

        Attributes:
            action: the data's action. Defaults to ``"action"``.
            done: end of a trajectory, below ``"next"``. Defaults to ``"done"``.
            perturbed: where the perturbed twins are. Defaults to ``"perturbed"``.
        """

        action: NestedKey = "action"
        done: NestedKey = "done"
        perturbed: NestedKey = "perturbed"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys

    inverse_dynamics_network: ProbabilisticTensorDictSequential
    inverse_dynamics_network_params: TensorDictParams
    target_inverse_dynamics_network_params: TensorDictParams

    def __init__(
        self,
        inverse_dynamics_network: ProbabilisticTensorDictSequential,
        *,
        states: Literal["both", "clean"] = "both",
        reduction: Reduction = None,
    ) -> None:
        check_choice("states", states, ("both", "clean"))
        super().__init__(reduction)
        action_bounds(inverse_dynamics_network, "inverse_dynamics_network")
        self.convert_to_functional(inverse_dynamics_network, "inverse_dynamics_network")
        self.states = states

    def _input_keys(self) -> list[NestedKey]:
        network_keys = self.inverse_dynamics_network.in_keys
        keys = [
            *network_keys,
            self.tensor_keys.action,
            nested("next", self.tensor_keys.done),
        ]
        if self.states != "clean":
            keys += [
                nested(self.tensor_keys.perturbed, key)
                for key in state_keys(network_keys)
            ]
        return keys

    def _output_keys(self) -> tuple[list[NestedKey], list[NestedKey]]:
        return ["loss_inverse_dynamics"], []

    def _log_prob(self, tensordict: TensorDictBase, done: Tensor) -> Tensor:
        """Return the log-density of the data's action, ``[1 or 2, B]``."""
        batch = transitions(
            tensordict,
            self.inverse_dynamics_network.in_keys,
            done=done,
            perturbed=self.tensor_keys.perturbed,
            states=self.states,
        )
        with self.inverse_dynamics_network_params.to_module(
            self.inverse_dynamics_network, preserve_module_state=False
        ):
            distribution = self.inverse_dynamics_network.get_dist(batch)
        action = entry(tensordict, self.tensor_keys.action)
        check_action(action, distribution.loc.shape[-1], self.tensor_keys.action)
        log_prob: Tensor = distribution.log_prob(action.expand_as(distribution.loc))
        return log_prob

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return ``"loss_inverse_dynamics"``.

        Args:
            tensordict: a batch ``[B]`` with the entries of :attr:`in_keys`.
        """
        done = column(tensordict, nested("next", self.tensor_keys.done))
        negative_log_prob = -self._log_prob(tensordict, done).mean(0)
        loss = reduce_transitions(self, negative_log_prob, done, tensordict)
        return self._output(tensordict, {"loss_inverse_dynamics": loss}, {})
