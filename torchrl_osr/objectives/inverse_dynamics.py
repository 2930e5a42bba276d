r"""The loss that trains the inverse dynamics model, section 4.2.

Shapes: ``B`` batch (any leading dimensions), ``S`` observation, ``A`` action.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import (
    InteractionType,
    ProbabilisticTensorDictSequential,
    TensorDictParams,
    dispatch,
    set_interaction_type,
)
from torch import Tensor

from torchrl_osr._checks import check_choice, check_weight
from torchrl_osr.functional import gaussian_kl
from torchrl_osr.objectives.base import BaseLoss, Reduction
from torchrl_osr.objectives.distributions import action_bounds, check_action
from torchrl_osr.objectives.frozen_model import full_precision
from torchrl_osr.objectives.mixed_states import (
    column,
    entry,
    nested,
    reduce_transitions,
    state_keys,
    transitions,
)

LATENT_KEYS = ("latent_loc", "latent_scale")
"""What a model with a latent variable writes besides its distribution."""


class InverseDynamicsLoss(BaseLoss):
    r"""Negative log-likelihood of the data's action given both states.

    .. math::
        L = -\mathbb E_{(\tilde s, a, s') \sim D_{tot}} \log I(a \mid \tilde s, s')

    on clean and perturbed states alike. Rows that are ``done`` are left out: their
    ``s'`` may not be a next state. Presented in "Recovering from Out-of-sample States
    via Inverse Dynamics in Offline Reinforcement Learning",
    https://openreview.net/forum?id=4gLWjSaw4o.

    The authors' released code trains a
    :func:`~torchrl_osr.modules.cvae_inverse_dynamics` on clean states and on the
    squared error of a sampled action: ``states="clean"``, ``loss_function="mse"``.

    A network that writes ``"latent_loc"`` and ``"latent_scale"`` has a latent ``z``:
    it is drawn for each row and state set, whatever the ambient interaction type, and
    its divergence from the prior is added,

    .. math::
        L + w\,\frac1Z \sum_{i=1}^{Z} KL(q_i(z \mid \tilde s, s') \,\|\, N(0, 1)).

    With ``"nll"`` and ``latent_weight=Z`` that is a conditional VAE's negative evidence
    lower bound, estimated from one ``z``. Smaller weights, such as the authors', loosen
    the hold on the prior: they average over the latent's dimensions instead of summing.

    Args:
        inverse_dynamics_network: reads states and next states, ends in a
            :class:`~torchrl.modules.TanhNormal`; see
            :func:`~torchrl_osr.modules.tanh_gaussian_inverse_dynamics`.

    Keyword Args:
        states: ``"both"`` (default) for D_tot, which needs the ``"perturbed"`` entry
            of :class:`~torchrl_osr.StatePerturbation`; ``"clean"`` for the data alone.
        loss_function: ``"nll"`` (default), in nats and summed over the action's
            dimensions; ``"mse"``, the squared error of one reparametrised action, in
            squared units of the action and averaged over its dimensions. The latter
            punishes the model's own noise as well: the scale shrinks to its floor
            whatever the data's is, and a policy pulled to the model learns to be as
            sure.
        latent_weight: ``w``. Default 0.5, the authors'. Ignored for a network without
            a latent.
        reduction: ``"mean"`` (default), ``"sum"`` or ``"none"``.

    Raises:
        TypeError: if the network does not end in a ``TanhNormal``.
        ValueError: if an option is unknown or ``latent_weight`` is negative.
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
        loss_function: Literal["nll", "mse"] = "nll",
        latent_weight: float = 0.5,
        reduction: Reduction = None,
    ) -> None:
        check_choice("states", states, ("both", "clean"))
        check_choice("loss_function", loss_function, ("nll", "mse"))
        check_weight("latent_weight", latent_weight)
        super().__init__(reduction)
        self._check_distribution(inverse_dynamics_network)
        self.convert_to_functional(inverse_dynamics_network, "inverse_dynamics_network")
        self.states = states
        self.loss_function = loss_function
        self.latent_weight = latent_weight
        self.has_latent = set(LATENT_KEYS) <= set(inverse_dynamics_network.out_keys)

    def _check_distribution(self, network: ProbabilisticTensorDictSequential) -> None:
        """Raise unless the network's distribution is what the loss computes with."""
        action_bounds(network, "inverse_dynamics_network")

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

    def _network(self, tensordict: TensorDictBase, done: Tensor) -> TensorDictBase:
        """Run the network, a latent drawn: distribution parameters, ``[1 or 2, B]``."""
        batch = transitions(
            tensordict,
            self.inverse_dynamics_network.in_keys,
            done=done,
            perturbed=self.tensor_keys.perturbed,
            states=self.states,
        )
        with (
            self.inverse_dynamics_network_params.to_module(
                self.inverse_dynamics_network, preserve_module_state=False
            ),
            set_interaction_type(InteractionType.RANDOM),
        ):
            return full_precision(self.inverse_dynamics_network.get_dist_params(batch))

    def _action_loss(self, output: TensorDictBase, action: Tensor) -> Tensor:
        """Return how badly the network tells the data's action, ``[1 or 2, B]``."""
        distribution = self.inverse_dynamics_network.build_dist_from_params(output)
        check_action(action, distribution.loc.shape[-1], self.tensor_keys.action)
        action = action.expand_as(distribution.loc)
        if self.loss_function == "mse":
            sample: Tensor = distribution.rsample()
            return (sample - action).square().mean(-1)
        log_prob: Tensor = distribution.log_prob(action)
        return -log_prob

    def _latent_kl(self, output: TensorDictBase) -> Tensor:
        """Return the latent's mean divergence from the prior, ``[1 or 2, B]``."""
        loc, scale = (entry(output, key) for key in LATENT_KEYS)
        prior = torch.zeros_like(loc), torch.ones_like(scale)
        return gaussian_kl(loc, scale, *prior).mean(-1)

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return ``"loss_inverse_dynamics"``.

        Args:
            tensordict: a batch ``[B]`` with the entries of :attr:`in_keys`.
        """
        done = column(tensordict, nested("next", self.tensor_keys.done))
        output = self._network(tensordict, done)
        value = self._action_loss(output, entry(tensordict, self.tensor_keys.action))
        if self.has_latent:
            value = value + self.latent_weight * self._latent_kl(output)
        loss = reduce_transitions(self, value.mean(0), done, tensordict)
        return self._output(tensordict, {"loss_inverse_dynamics": loss}, {})
