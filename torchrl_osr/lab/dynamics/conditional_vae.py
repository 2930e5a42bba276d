"""Conditional variational autoencoder of one entry given another, and its loss.

Shapes: ``B`` batch, ``C`` condition, ``T`` target, ``Z`` latent.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase, TensorDictParams, unravel_key
from torch import Tensor, nn
from torchrl.modules import MLP

from torchrl_osr._entries import entry, is_next, nested
from torchrl_osr.functional import gaussian_kl
from torchrl_osr.lab.dynamics.ensemble import (
    UNWEIGHTED,
    copy_statistics,
    has_next_state,
)
from torchrl_osr.modules.inverse_dynamics import LATENT_LOG_SCALE_BOUNDS
from torchrl_osr.objectives import ActorCriticLoss
from torchrl_osr.objectives.actor_critic import Losses
from torchrl_osr.objectives.transitions import Transitions, check_single_steps


class ConditionalVAE(nn.Module):
    r"""Generate one entry given another, as BCQ does (https://arxiv.org/abs/1812.02900).

    .. math::
        z \sim q(z \mid c, t) = \mathcal N(\mu, \sigma^2) \text{ in training}, \quad
        z \sim \mathcal N(0, 1) \text{ in use}, \quad
        t = \tanh f(c, z) \;\text{ or }\; t = c + m + w\, f(c, z)

    The first form is for actions in [-1, 1]. The second, ``change=True``, is for next
    states, with mean :math:`m` and standard deviation :math:`w` of the change.

    Keyword Args:
        latent_dim: ``Z``. Default ``2 * T``, BCQ's.
        latent_bound: largest magnitude of a sampled latent; BCQ's is 0.5.
    """

    target_loc: Tensor
    target_scale: Tensor

    def __init__(
        self,
        condition_dim: int,
        target_dim: int,
        condition_key: NestedKey,
        target_key: NestedKey,
        *,
        change: bool = False,
        num_cells: Sequence[int] = (750, 750),
        latent_dim: int | None = None,
        latent_bound: float = math.inf,
    ) -> None:
        super().__init__()
        self.in_keys, self.out_keys = [condition_key], [target_key]
        self.change, self.latent_bound = change, latent_bound
        self.latent_dim = latent_dim or 2 * target_dim
        options = {"num_cells": list(num_cells), "activation_class": nn.ReLU}
        self.encoder = MLP(condition_dim + target_dim, 2 * self.latent_dim, **options)
        self.decoder = MLP(condition_dim + self.latent_dim, target_dim, **options)
        self.register_buffer("target_loc", torch.zeros(target_dim))
        self.register_buffer("target_scale", torch.ones(target_dim))

    def decode(self, condition: Tensor, latent: Tensor) -> Tensor:
        """Return the predicted standardised target, ``[B, T]``."""
        output: Tensor = self.decoder(condition, latent)
        return output if self.change else output.tanh()

    def sample(self, condition: Tensor) -> Tensor:
        """Draw a target for each condition, ``[B, T]``."""
        size = *condition.shape[:-1], self.latent_dim
        latent = torch.randn(size, dtype=condition.dtype, device=condition.device)
        latent = latent.clamp(-self.latent_bound, self.latent_bound)
        output = self.decode(condition, latent)
        if not self.change:
            return output
        return condition + self.target_loc + self.target_scale * output

    @torch.no_grad()
    def standardize_(self, data: TensorDictBase) -> None:
        """Take mean and standard deviation of the change from rows ``[N]``."""
        rows = data[has_next_state(data, self.in_keys[0])]
        change = entry(rows, self.out_keys[0]) - entry(rows, self.in_keys[0])
        copy_statistics(change, self.target_loc, self.target_scale)


class ConditionalVAELoss(ActorCriticLoss):
    r"""Squared error of the target, and the latent's divergence from its prior.

    .. math::
        L = \mathbb E_D\Big[ \frac1T \|f(c, z) - t\|^2
            + w\,\frac1Z \sum_i KL(q_i(z \mid c, t) \,\|\, N(0, 1)) \Big], \quad
            z \sim q

    as in BCQ's code. Rows without a next state do not count.

    Keyword Args:
        latent_weight: ``w``. Default 0.5, BCQ's.
        options: of every loss, see :class:`~torchrl_osr.objectives.ActorCriticLoss`.
    """

    vae_network: ConditionalVAE
    vae_network_params: TensorDictParams
    target_vae_network_params: TensorDictParams

    def __init__(
        self,
        vae_network: ConditionalVAE,
        *,
        latent_weight: float = 0.5,
        **options: Any,
    ) -> None:
        super().__init__(**(UNWEIGHTED | options))
        self.convert_to_functional(vae_network, "vae_network")
        self.latent_weight = latent_weight
        # The entry whose next one is read or written, or else the condition.
        keys = [*vae_network.in_keys, *vae_network.out_keys]
        after = (unravel_key(key[1:]) for key in keys if is_next(key))
        self.state_key = next(after, keys[0])
        self.declare(["loss_vae"], [])

    def input_keys(self) -> list[NestedKey]:
        rows = [self.state_key, nested("next", self.state_key), ("next", "terminated")]
        return [*self.vae_network.in_keys, *self.vae_network.out_keys, *rows]

    def losses(self, batch: Transitions) -> Losses:
        check_single_steps(batch, "the autoencoder")
        tensordict, model = batch.one_step, self.vae_network
        condition = entry(tensordict, model.in_keys[0])
        target = entry(tensordict, model.out_keys[0])
        with self.vae_network_params.to_module(model):
            if model.change:
                target = (target - condition - model.target_loc) / model.target_scale
            loc, log_scale = model.encoder(condition, target).chunk(2, -1)
            scale = log_scale.clamp(*LATENT_LOG_SCALE_BOUNDS).exp()
            output = model.decode(condition, loc + scale * torch.randn_like(scale))
        prior = torch.zeros_like(loc), torch.ones_like(scale)
        divergence = gaussian_kl(loc, scale, *prior).mean(-1)
        value = (output - target).square().mean(-1) + self.latent_weight * divergence
        valid = has_next_state(tensordict, self.state_key)
        return {"loss_vae": self.reduce(value, batch, valid)}, {}
