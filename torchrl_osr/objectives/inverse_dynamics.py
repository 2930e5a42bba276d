r"""The loss that trains the inverse dynamics model, section 4.2.

Shapes: ``R`` rows, ``A`` action, ``D`` sets of states (2 for D_tot, 1 for the data).
"""

from __future__ import annotations

from typing import Literal

from tensordict import NestedKey
from tensordict.nn import (
    InteractionType,
    ProbabilisticTensorDictSequential,
    set_interaction_type,
)

from torchrl_osr import functional as F
from torchrl_osr._checks import check_choice, check_weight
from torchrl_osr._entries import entry, nested, state_keys
from torchrl_osr.objectives.actor_critic import ActorCriticLoss, Losses
from torchrl_osr.objectives.networks import (
    action_bounds,
    distribution_params,
    is_categorical,
)
from torchrl_osr.objectives.state_recovery import cloning_distance
from torchrl_osr.objectives.transitions import Transitions

LATENT_KEYS = ("latent_loc", "latent_scale")
"""What a model with a latent variable writes besides its distribution."""


class InverseDynamicsLoss(ActorCriticLoss):
    r"""Negative log-likelihood of the data's action given both states, in nats.

    .. math::
        L = -\mathbb E_{(\tilde s, a, s') \sim D_{tot}} \log I(a \mid \tilde s, s')

    on clean and perturbed states alike. Rows that are ``done`` are left out: their
    ``s'`` may not be a next state. From the paper of :class:`~torchrl_osr.OSRLoss`.

    The authors' released code trains a
    :func:`~torchrl_osr.modules.cvae_inverse_dynamics` on clean states and on the
    squared error of a sampled action: ``states="clean"``, ``loss_function="mse"``.

    If a network writes ``"latent_loc"`` and ``"latent_scale"``, its latent ``z`` is
    drawn under every interaction type. The loss adds ``latent_weight`` times the mean
    divergence of its entries from ``N(0, 1)``. With ``"nll"`` and the weight ``Z`` this
    is the negative evidence lower bound of a conditional VAE, from one ``z``.

    Args:
        inverse_dynamics_network: reads states and next states. Ends in a
            :class:`~torchrl.modules.TanhNormal`
            (:func:`~torchrl_osr.modules.tanh_gaussian_inverse_dynamics`) or, for
            discrete actions, in a categorical distribution
            (:func:`~torchrl_osr.modules.categorical_inverse_dynamics`).

    Keyword Args:
        states: ``"both"`` (default) for D_tot, which needs the ``"perturbed"`` entry
            of :class:`~torchrl_osr.StatePerturbation`; ``"clean"`` for the data alone.
        loss_function: ``"nll"`` (default), in nats and summed over the action's
            dimensions; ``"mse"``: the squared error of one reparametrised action,
            averaged over its dimensions. It punishes the model's own noise as well:
            the scale shrinks to its floor.
        latent_weight: weight of a latent's divergence. Default 0.5, the authors'.
        reduction: ``"mean"`` (default), ``"sum"`` or ``"none"``.
        use_prioritized_weights: weigh rows by ``"priority_weight"``, if there.
            Default true.

    Examples:
        >>> from torchrl_osr import InverseDynamicsLoss
        >>> from torchrl_osr.modules import tanh_gaussian_inverse_dynamics
        >>> loss = InverseDynamicsLoss(tanh_gaussian_inverse_dynamics(11, 3))
        >>> loss.in_keys[-1], loss.out_keys
        (('perturbed', 'observation'), ['loss_inverse_dynamics'])
    """

    def __init__(
        self,
        inverse_dynamics_network: ProbabilisticTensorDictSequential,
        *,
        states: Literal["both", "clean"] = "both",
        loss_function: Literal["nll", "mse"] = "nll",
        latent_weight: float = 0.5,
        reduction: Literal["none", "mean", "sum"] = "mean",
        use_prioritized_weights: bool = True,
    ) -> None:
        check_weight("latent_weight", latent_weight)
        check_choice("loss_function", loss_function, ("nll", "mse"))
        super().__init__(
            reduction=reduction, use_prioritized_weights=use_prioritized_weights
        )
        if not is_categorical(inverse_dynamics_network):
            name = "inverse_dynamics_network"
            self.register_bounds(action_bounds(inverse_dynamics_network, name))
        elif loss_function == "mse":
            raise ValueError("loss_function='mse' needs continuous actions: use 'nll'.")
        self.convert_to_functional(inverse_dynamics_network, "inverse_dynamics_network")
        self.states: Literal["both", "clean"] = states
        self.loss_function, self.latent_weight = loss_function, latent_weight
        self.has_latent = set(LATENT_KEYS) <= set(inverse_dynamics_network.out_keys)
        self.declare(["loss_inverse_dynamics"], [])

    def input_keys(self) -> list[NestedKey]:
        network_keys, keys = self.inverse_dynamics_network.in_keys, self.tensor_keys
        in_keys = [*network_keys, keys.action, nested("next", keys.done)]
        if self.states != "clean":
            in_keys += [nested(keys.perturbed, key) for key in state_keys(network_keys)]
        return in_keys

    def losses(self, batch: Transitions) -> Losses:
        network = self.inverse_dynamics_network
        inputs = self.model_inputs(batch, network.in_keys, self.states)
        # A latent is drawn whatever the ambient interaction type.
        with set_interaction_type(InteractionType.RANDOM):
            params = self.inverse_dynamics_network_params
            output = distribution_params(network, params, inputs)
        model = network.build_dist_from_params(output)
        if not is_categorical(network):
            self.check_actions(batch, model.loc.shape[1:])
        if self.loss_function == "mse":
            value = (model.rsample() - batch.a).square().mean(-1)
        else:
            value = cloning_distance(model, batch.a, self.tensor_keys.action)
        if self.has_latent:
            loc, scale = (entry(output, key) for key in LATENT_KEYS)
            value = value + self.latent_weight * F.gaussian_kl(loc, scale).mean(-1)
        loss = self.reduce(value.mean(0), batch, ~batch.done)
        return {"loss_inverse_dynamics": loss}, {}
