"""Loss of a conditional variational autoencoder.

Shapes: ``B`` batch (any leading dimensions), ``T`` target, ``Z`` latent.
"""

from __future__ import annotations

from typing import Literal

import torch
from tensordict import NestedKey, TensorDictParams, unravel_key

from torchrl_osr._checks import check_weight
from torchrl_osr._entries import entry, is_next, nested
from torchrl_osr.functional import gaussian_kl
from torchrl_osr.lab.dynamics.conditional_vae import ConditionalVAE
from torchrl_osr.lab.dynamics.ensemble import has_next_state
from torchrl_osr.objectives import ActorCriticLoss
from torchrl_osr.objectives.actor_critic import Losses
from torchrl_osr.objectives.transitions import Transitions, check_single_steps


class ConditionalVAELoss(ActorCriticLoss):
    r"""Squared error of the target, and the latent's divergence from its prior.

    .. math::
        L = \mathbb E_D\Big[ \frac1T \|f(c, z) - t\|^2
            + w\,\frac1Z \sum_i KL(q_i(z \mid c, t) \,\|\, N(0, 1)) \Big], \quad
            z \sim q

    as in BCQ's code. Rows without a next state do not count.

    Args:
        vae_network: to be trained.

    Keyword Args:
        latent_weight: ``w``. Default 0.5, BCQ's.
        reduction: ``"mean"`` (default), ``"sum"`` or ``"none"``.
    """

    vae_network: ConditionalVAE
    vae_network_params: TensorDictParams
    target_vae_network_params: TensorDictParams

    def __init__(
        self,
        vae_network: ConditionalVAE,
        *,
        latent_weight: float = 0.5,
        reduction: Literal["none", "mean", "sum"] | None = None,
    ) -> None:
        check_weight("latent_weight", latent_weight)
        super().__init__(
            reduction=reduction,
            use_prioritized_weights=False,
            scalar_output_mode="exclude",
        )
        self.convert_to_functional(vae_network, "vae_network")
        self.latent_weight = latent_weight
        self.declare(["loss_vae"], [])

    @property
    def _state(self) -> NestedKey:
        """The entry whose next one is read or written, or else the condition."""
        keys = [*self.vae_network.in_keys, *self.vae_network.out_keys]
        after = (unravel_key(key[1:]) for key in keys if is_next(key))
        return next(after, keys[0])

    def input_keys(self) -> list[NestedKey]:
        model, state = self.vae_network, self._state
        rows = [state, nested("next", state), ("next", "terminated")]
        return [*model.in_keys, *model.out_keys, *rows]

    def losses(self, batch: Transitions) -> Losses:
        check_single_steps(batch, "the autoencoder")
        tensordict, model = batch.one_step, self.vae_network
        condition, target = (
            entry(tensordict, key) for key in (*model.in_keys, *model.out_keys)
        )
        with self.vae_network_params.to_module(model):
            target = model.standardized(condition, target)
            loc, scale = model.encode(condition, target)
            output = model.decode(condition, loc + scale * torch.randn_like(scale))
        prior = torch.zeros_like(loc), torch.ones_like(scale)
        divergence = gaussian_kl(loc, scale, *prior).mean(-1)
        value = (output - target).square().mean(-1) + self.latent_weight * divergence
        loss = self.reduce(value, batch, has_next_state(tensordict, self._state))
        return {"loss_vae": loss}, {}
