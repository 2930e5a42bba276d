"""Conditional variational autoencoder of one entry given another.

Shapes: ``B`` batch (any leading dimensions), ``C`` condition, ``T`` target, ``Z``
latent.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor, nn
from torchrl.modules import MLP

from torchrl_osr._entries import entry
from torchrl_osr.lab.dynamics.ensemble import has_next_state, loc_and_scale
from torchrl_osr.modules.cvae_inverse_dynamics import LATENT_LOG_SCALE_BOUNDS


class ConditionalVAE(nn.Module):
    r"""Generate one entry given another, as BCQ does (https://arxiv.org/abs/1812.02900).

    .. math::
        z \sim q(z \mid c, t) = \mathcal N(\mu, \sigma^2) \text{ in training}, \quad
        z \sim \mathcal N(0, 1) \text{ in use}, \quad
        t = \tanh f(c, z) \;\text{ or }\; t = c + m + w\, f(c, z)

    The first form is for actions in [-1, 1]. The second, ``change=True``, is for next
    states, with mean :math:`m` and standard deviation :math:`w` of the change.

    Args:
        condition_dim, target_dim: ``C`` and ``T``; equal with ``change=True``.

    Keyword Args:
        condition_key, target_key: entries of a batch.
        change: see above.
        num_cells: width of each hidden layer. Default: BCQ's.
        latent_dim: ``Z``. Default ``2 * T``, BCQ's.
        latent_bound: largest magnitude of a sampled latent; BCQ's is 0.5.

    Examples:
        >>> import torch
        >>> from torchrl_osr.lab.dynamics import ConditionalVAE
        >>> model = ConditionalVAE(
        ...     11, 3, condition_key=("next", "observation"), target_key="action",
        ...     num_cells=[32])
        >>> model.sample(torch.zeros(4, 11)).shape
        torch.Size([4, 3])
    """

    target_loc: Tensor
    target_scale: Tensor

    def __init__(
        self,
        condition_dim: int,
        target_dim: int,
        *,
        condition_key: NestedKey,
        target_key: NestedKey,
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

    def encode(self, condition: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and scale ``[B, Z]`` of the latent, for a standardised target."""
        loc, log_scale = self.encoder(condition, target).chunk(2, -1)
        return loc, log_scale.clamp(*LATENT_LOG_SCALE_BOUNDS).exp()

    def decode(self, condition: Tensor, latent: Tensor) -> Tensor:
        """Return the predicted standardised target, ``[B, T]``."""
        output: Tensor = self.decoder(condition, latent)
        return output if self.change else output.tanh()

    def standardized(self, condition: Tensor, target: Tensor) -> Tensor:
        """Return the target as :meth:`decode` predicts it, ``[B, T]``."""
        if not self.change:
            return target
        return (target - condition - self.target_loc) / self.target_scale

    def sample(self, condition: Tensor) -> Tensor:
        """Draw a target for each condition, ``[B, T]``."""
        size = *condition.shape[:-1], self.latent_dim
        latent = torch.randn(size, dtype=condition.dtype, device=condition.device)
        bound = self.latent_bound
        output = self.decode(condition, latent.clamp(-bound, bound))
        if not self.change:
            return output
        return condition + self.target_loc + self.target_scale * output

    @torch.no_grad()
    def standardize_(self, data: TensorDictBase) -> None:
        """Take mean and standard deviation of the change from rows ``[N]``."""
        rows = data[has_next_state(data, self.in_keys[0])]
        loc, scale = loc_and_scale(
            entry(rows, self.out_keys[0]) - entry(rows, self.in_keys[0])
        )
        self.target_loc.copy_(loc)
        self.target_scale.copy_(scale)
