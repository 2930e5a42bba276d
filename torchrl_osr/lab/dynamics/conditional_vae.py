"""A conditional variational autoencoder: draws of one entry, given another.

Shapes: ``B`` batch (any leading dimensions), ``C`` condition, ``T`` target, ``Z``
latent.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.modules import MLP

from torchrl_osr._entries import entry
from torchrl_osr.lab.dynamics.ensemble import has_next_state, loc_and_scale
from torchrl_osr.modules.cvae_inverse_dynamics import LATENT_LOG_SCALE_BOUNDS


class ConditionalVAE(TensorDictModuleBase):
    r"""BCQ's generative model (https://arxiv.org/abs/1812.02900), of any two entries.

    .. math::
        z \sim q(z \mid c, t) = \mathcal N(\mu, \sigma^2) \text{ in training}, \quad
        z \sim \mathcal N(0, 1) \text{ in use}, \quad
        t = \tanh f(c, z) \;\text{ or }\; t = c + m + w\, f(c, z)

    The first is for actions, between -1 and 1; the second, with ``change=True``, for
    states that follow others, with the mean :math:`m` and the standard deviation
    :math:`w` of the change from :meth:`standardize_`.

    Args:
        condition_dim: size of the condition, ``C``.
        target_dim: size of the target, ``T``.

    Keyword Args:
        condition_key, target_key: the entries that it reads and writes.
        change: see above. Default ``False``.
        num_cells: width of each hidden layer. Default two of 750, BCQ's.
        latent_dim: ``Z``. Default ``2 * T``, BCQ's.
        latent_bound: largest magnitude of a drawn latent's entry. Default infinity; 0.5
            is BCQ's.

    Raises:
        ValueError: with ``change=True``, condition and target are of two sizes.

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
        if change and condition_dim != target_dim:
            raise ValueError(
                f"change=True needs a condition of the target's size, {target_dim}, "
                f"got {condition_dim}."
            )
        self.in_keys, self.out_keys = [condition_key], [target_key]
        self.change, self.latent_bound = change, latent_bound
        self.latent_dim = latent_dim or 2 * target_dim
        options = {"num_cells": list(num_cells), "activation_class": nn.ReLU}
        self.encoder = MLP(condition_dim + target_dim, 2 * self.latent_dim, **options)
        self.decoder = MLP(condition_dim + self.latent_dim, target_dim, **options)
        self.register_buffer("target_loc", torch.zeros(target_dim))
        self.register_buffer("target_scale", torch.ones(target_dim))

    def encode(self, condition: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation of the latent, ``[B, Z]``.

        Args:
            condition: ``[B, C]``.
            target: as :meth:`standardized` returns it, ``[B, T]``.
        """
        loc, log_scale = self.encoder(condition, target).chunk(2, -1)
        return loc, log_scale.clamp(*LATENT_LOG_SCALE_BOUNDS).exp()

    def decode(self, condition: Tensor, latent: Tensor) -> Tensor:
        """What the decoder says of the standardised target, ``[B, T]``."""
        output: Tensor = self.decoder(condition, latent)
        return output if self.change else output.tanh()

    def standardized(self, condition: Tensor, target: Tensor) -> Tensor:
        """The target as :meth:`decode` returns it, ``[B, T]``."""
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

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write a drawn target."""
        return tensordict.set(
            self.out_keys[0], self.sample(entry(tensordict, self.in_keys[0]))
        )

    @torch.no_grad()
    def standardize_(self, data: TensorDictBase) -> None:
        """Take mean and standard deviation of the change from rows ``[N]``.

        Rows without a next state are left out. An entry that does not vary keeps a
        standard deviation of 1.
        """
        rows = data[has_next_state(data, self.in_keys[0])]
        condition, target = (
            entry(rows, key) for key in (*self.in_keys, *self.out_keys)
        )
        loc, scale = loc_and_scale(target - condition)
        self.target_loc.copy_(loc)
        self.target_scale.copy_(scale)
