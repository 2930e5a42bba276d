r"""The loss that trains the inverse dynamics model, section 4.2.

Shapes: ``B`` batch (any leading dimensions), ``S`` observation, ``A`` action, ``n``
number of discrete actions, ``D`` sets of states (2 for D_tot, 1 for the data).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import (
    InteractionType,
    ProbabilisticTensorDictSequential,
    set_interaction_type,
)
from torch import Tensor

from torchrl_osr._checks import check_literals, check_weight
from torchrl_osr._entries import column, entry, nested, state_keys
from torchrl_osr.functional import gaussian_kl
from torchrl_osr.objectives.base import BaseLoss, Terms
from torchrl_osr.objectives.distributions import (
    action_bounds,
    action_index,
    check_action,
    is_categorical,
)
from torchrl_osr.objectives.mixed_states import first_step, transitions
from torchrl_osr.objectives.step import distribution_params

LATENT_KEYS = ("latent_loc", "latent_scale")
"""What a model with a latent variable writes besides its distribution."""


class InverseDynamicsLoss(BaseLoss):
    r"""Negative log-likelihood of the data's action given both states, in nats.

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
        inverse_dynamics_network: reads states and next states. Ends in a
            :class:`~torchrl.modules.TanhNormal` (see
            :func:`~torchrl_osr.modules.tanh_gaussian_inverse_dynamics`); or, for
            discrete actions, in a :class:`~torchrl.modules.OneHotCategorical`, and
            then reads one-hot actions ``[B, n]`` from the batch, or in a
            :class:`torch.distributions.Categorical`, and reads indices ``[B]`` or
            ``[B, 1]`` (see
            :func:`~torchrl_osr.modules.categorical_inverse_dynamics`).

    Keyword Args:
        states: ``"both"`` (default) for D_tot, which needs the ``"perturbed"`` entry
            of :class:`~torchrl_osr.StatePerturbation`; ``"clean"`` for the data alone.
        loss_function: ``"nll"`` (default), in nats and summed over the action's
            dimensions; ``"mse"``, for a ``TanhNormal`` alone: the squared error of one
            reparametrised action, in squared units of the action and averaged over its
            dimensions. It punishes the model's own noise as well: the scale shrinks to
            its floor whatever the data's is, and a policy pulled to the model learns to
            be as sure.
        latent_weight: ``w``. Default 0.5, the authors'. Ignored for a network without
            a latent.
        reduction: ``"mean"`` (default), ``"sum"`` or ``"none"``.

    Raises:
        TypeError: if the network ends in another distribution.
        ValueError: if an option is out of its range; in the call, if the batch is
            empty, holds several steps a row or actions that are not the network's.
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
            perturbed: where the perturbed states are. Defaults to ``"perturbed"``.
        """

        action: NestedKey = "action"
        done: NestedKey = "done"
        perturbed: NestedKey = "perturbed"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys

    def __init__(
        self,
        inverse_dynamics_network: ProbabilisticTensorDictSequential,
        *,
        states: Literal["both", "clean"] = "both",
        loss_function: Literal["nll", "mse"] = "nll",
        latent_weight: float = 0.5,
        reduction: Literal["none", "mean", "sum"] | None = None,
    ) -> None:
        check_literals(InverseDynamicsLoss.__init__, locals())
        check_weight("latent_weight", latent_weight)
        # A likelihood of data, not of what a sampler found important.
        super().__init__(
            reduction=reduction,
            use_prioritized_weights=False,
            scalar_output_mode="exclude",
        )
        self.is_discrete = is_categorical(inverse_dynamics_network)
        if not self.is_discrete:
            action_bounds(inverse_dynamics_network, "inverse_dynamics_network")
        elif loss_function == "mse":
            raise ValueError("loss_function='mse' needs actions with a distance.")
        self.convert_to_functional(inverse_dynamics_network, "inverse_dynamics_network")
        self.states = states
        self.action_error = loss_function
        self.latent_weight = latent_weight
        self.has_latent = set(LATENT_KEYS) <= set(inverse_dynamics_network.out_keys)

    def _input_keys(self) -> list[NestedKey]:
        network_keys, keys = self.inverse_dynamics_network.in_keys, self.tensor_keys
        in_keys = [*network_keys, keys.action, *self._next_keys("done")]
        if self.states != "clean":
            in_keys += [nested(keys.perturbed, key) for key in state_keys(network_keys)]
        return in_keys

    def _output_keys(self) -> tuple[list[NestedKey], list[NestedKey]]:
        return ["loss_inverse_dynamics"], []

    def _terms(self, tensordict: TensorDictBase) -> Terms:
        tensordict = first_step(tensordict)
        done = column(tensordict, nested("next", self.tensor_keys.done)).bool()
        batch = transitions(
            tensordict,
            self.inverse_dynamics_network.in_keys,
            done=done,
            perturbed=self.tensor_keys.perturbed,
            states=self.states,
        )
        network = self.inverse_dynamics_network
        # A latent is drawn whatever the ambient interaction type.
        with set_interaction_type(InteractionType.RANDOM):
            output = distribution_params(
                network, self.inverse_dynamics_network_params, batch
            )
        value = self._action_error(output, tensordict)
        if self.has_latent:
            value = value + self.latent_weight * self._latent_kl(output)
        loss = self._reduce(value.mean(0), tensordict, ~done)
        return {"loss_inverse_dynamics": loss}, {}

    def _action_error(
        self, output: TensorDictBase, tensordict: TensorDictBase
    ) -> Tensor:
        """Negative log-likelihood, or squared error, of the action, ``[D, B]``."""
        distribution = self.inverse_dynamics_network.build_dist_from_params(output)
        key = self.tensor_keys.action
        action = entry(tensordict, key)
        if self.is_discrete:
            index = action_index(action, distribution, tensordict.batch_size, key)
            index = index.expand(output.batch_size).unsqueeze(-1)
            log_prob: Tensor = distribution.logits.gather(-1, index).squeeze(-1)
            return -log_prob
        check_action(action, distribution.loc.shape[-1], key)
        action = action.expand_as(distribution.loc)
        if self.action_error == "mse":
            sample: Tensor = distribution.rsample()
            return (sample - action).square().mean(-1)
        log_prob = distribution.log_prob(action)
        return -log_prob

    def _latent_kl(self, output: TensorDictBase) -> Tensor:
        """Mean divergence of the latent from its prior, ``[D, B]``."""
        loc, scale = (entry(output, key) for key in LATENT_KEYS)
        prior = torch.zeros_like(loc), torch.ones_like(scale)
        return gaussian_kl(loc, scale, *prior).mean(-1)
