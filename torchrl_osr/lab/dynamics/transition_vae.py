"""Variational autoencoder of the next state given the state, and its loss.

Shapes: ``B`` batch (any leading dimensions), ``S`` observation, ``Z`` latent.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import NestedKey, TensorDictBase, TensorDictParams
from torch import Tensor, nn
from torchrl.modules import MLP

from torchrl_osr._entries import entry, nested
from torchrl_osr.functional import gaussian_kl
from torchrl_osr.lab.dynamics.ensemble import copy_statistics, has_next_state
from torchrl_osr.modules.inverse_dynamics import LATENT_LOG_SCALE_BOUNDS
from torchrl_osr.objectives import ActorCriticLoss
from torchrl_osr.objectives.actor_critic import Losses
from torchrl_osr.objectives.transitions import Transitions, check_single_steps


class TransitionVAE(nn.Module):
    r"""Generate the states that follow a state in the data, whatever the action.

    .. math::
        z \sim q(z \mid s, s') = \mathcal N(\mu, \sigma^2) \text{ in training}, \quad
        z \sim \mathcal N(0, 1) \text{ in use}, \quad
        s' = s + m + w\, f(s, z)

    with mean :math:`m` and standard deviation :math:`w` of the change. Sizes are those
    of BCQ (https://arxiv.org/abs/1812.02900): ``Z`` is ``2 * S``.
    """

    target_loc: Tensor
    target_scale: Tensor

    def __init__(
        self,
        observation_dim: int,
        *,
        num_cells: Sequence[int] = (750, 750),
        observation_key: NestedKey = "observation",
    ) -> None:
        super().__init__()
        self.observation_key = observation_key
        self.latent_dim = 2 * observation_dim
        options = {"num_cells": list(num_cells), "activation_class": nn.ReLU}
        self.encoder = MLP(2 * observation_dim, 2 * self.latent_dim, **options)
        inputs = observation_dim + self.latent_dim
        self.decoder = MLP(inputs, observation_dim, **options)
        self.register_buffer("target_loc", torch.zeros(observation_dim))
        self.register_buffer("target_scale", torch.ones(observation_dim))

    def sample(self, state: Tensor) -> Tensor:
        """Draw a next state for each state, ``[B, S]``."""
        size = *state.shape[:-1], self.latent_dim
        latent = torch.randn(size, dtype=state.dtype, device=state.device)
        change: Tensor = self.decoder(state, latent)
        return state + self.target_loc + self.target_scale * change

    @torch.no_grad()
    def standardize_(self, data: TensorDictBase) -> None:
        """Take mean and standard deviation of the change from rows ``[N]``."""
        key = self.observation_key
        rows = data[has_next_state(data, key)]
        change = entry(rows, nested("next", key)) - entry(rows, key)
        copy_statistics(change, self.target_loc, self.target_scale)


class TransitionVAELoss(ActorCriticLoss):
    r"""Squared error of the next state, and the latent's divergence from its prior.

    .. math::
        L = \mathbb E_D\Big[ \frac1S \|f(s, z) - y\|^2
            + w\,\frac1Z \sum_i KL(q_i(z \mid s, s') \,\|\, N(0, 1)) \Big], \quad
            z \sim q

    with the standardised change :math:`y`, as in BCQ's code, whose ``latent_weight``
    :math:`w` is 0.5. Rows without a next state do not count.
    """

    vae_network: TransitionVAE
    vae_network_params: TensorDictParams
    target_vae_network_params: TensorDictParams

    def __init__(
        self, vae_network: TransitionVAE, *, latent_weight: float = 0.5
    ) -> None:
        super().__init__(use_prioritized_weights=False)
        self.convert_to_functional(vae_network, "vae_network")
        self.latent_weight = latent_weight
        self.declare(["loss_vae"], [])

    def input_keys(self) -> list[NestedKey]:
        key = self.vae_network.observation_key
        return [key, nested("next", key), ("next", "terminated")]

    def losses(self, batch: Transitions) -> Losses:
        check_single_steps(batch, "the autoencoder")
        rows, model = batch.one_step, self.vae_network
        state = entry(rows, model.observation_key)
        target = entry(rows, nested("next", model.observation_key))
        with self.vae_network_params.to_module(model):
            target = (target - state - model.target_loc) / model.target_scale
            loc, log_scale = model.encoder(state, target).chunk(2, -1)
            scale = log_scale.clamp(*LATENT_LOG_SCALE_BOUNDS).exp()
            output = model.decoder(state, loc + scale * torch.randn_like(scale))
        prior = torch.zeros_like(loc), torch.ones_like(scale)
        divergence = gaussian_kl(loc, scale, *prior).mean(-1)
        value = (output - target).square().mean(-1) + self.latent_weight * divergence
        valid = has_next_state(rows, model.observation_key)
        return {"loss_vae": self.reduce(value, batch, valid)}, {}
