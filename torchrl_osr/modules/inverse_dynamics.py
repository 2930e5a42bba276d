r"""Inverse dynamics models :math:`I(a \mid s, s')`.

All read ``observation_key`` and the same key below ``"next"``; sizes and keywords are
those of the actors (:mod:`torchrl_osr.modules.actor`).

Shapes: ``B`` batch (any dimensions), ``S`` observation, ``A`` action, ``Z`` latent.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import NestedKey
from tensordict.nn import InteractionType, TensorDictModule, TensorDictSequential
from tensordict.nn.probabilistic import interaction_type
from torch import Tensor, nn
from torchrl.modules import NormalParamExtractor, ProbabilisticActor

from torchrl_osr._entries import nested
from torchrl_osr.modules.actor import SCALE_MAPPING, mlp, one_hot, tanh_normal

LATENT_LOG_SCALE_BOUNDS = (-4.0, 15.0)
"""Range of the latent's log standard deviation, BCQ's (https://arxiv.org/abs/1812.02900).

Unbounded, the KL to the prior would underflow to a logarithm of 0, or overflow. The
upper end is far out on purpose: beyond it no gradient leads back.
"""


def tanh_gaussian_inverse_dynamics(
    observation_dim: int,
    action_dim: int,
    *,
    num_cells: Sequence[int] = (256, 256),
    activation_class: type[nn.Module] = nn.ReLU,
    low: float | Tensor = -1.0,
    high: float | Tensor = 1.0,
    observation_key: NestedKey = "observation",
    action_key: NestedKey = "action",
) -> ProbabilisticActor:
    r"""Return a tanh-Gaussian model of :math:`I(a \mid s, s')`, section 4.2.

    It has the policy's distribution family and bounds, which makes the divergence
    between the two exact (:func:`~torchrl_osr.functional.gaussian_kl`). It writes
    ``"loc"``, ``"scale"`` (before the tanh), ``"action"`` and ``"action_log_prob"``.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> model = tanh_gaussian_inverse_dynamics(11, 3, num_cells=[32])
        >>> s = torch.zeros(4, 11)
        >>> batch = TensorDict({"observation": s, "next": {"observation": s + 1}}, [4])
        >>> model.get_dist(batch).loc.shape
        torch.Size([4, 3])
    """
    # MLP joins its two inputs; nn.Sequential, as the actor uses it, takes one only.
    layers = mlp(2 * observation_dim, 2 * action_dim, num_cells, activation_class)
    keys = [observation_key, nested("next", observation_key)]
    joint_mlp = TensorDictModule(layers, keys, ["param"])
    mapping = NormalParamExtractor(SCALE_MAPPING)
    extractor = TensorDictModule(mapping, ["param"], ["loc", "scale"])
    network = TensorDictSequential(joint_mlp, extractor)
    return tanh_normal(network, action_key, low, high)


def categorical_inverse_dynamics(
    observation_dim: int,
    num_actions: int,
    *,
    num_cells: Sequence[int] = (256, 256),
    activation_class: type[nn.Module] = nn.ReLU,
    observation_key: NestedKey = "observation",
    action_key: NestedKey = "action",
) -> ProbabilisticActor:
    """Return a model over ``n`` discrete actions, which writes what an actor does."""
    network = mlp(2 * observation_dim, num_actions, num_cells, activation_class)
    keys = [observation_key, nested("next", observation_key)]
    return one_hot(network, keys, action_key)


def cvae_inverse_dynamics(
    observation_dim: int,
    action_dim: int,
    *,
    latent_dim: int = 32,
    num_cells: Sequence[int] = (256, 256),
    activation_class: type[nn.Module] = nn.ReLU,
    low: float | Tensor = -1.0,
    high: float | Tensor = 1.0,
    observation_key: NestedKey = "observation",
    action_key: NestedKey = "action",
) -> ProbabilisticActor:
    r"""Return the conditional VAE of the OSR authors' released code.

    .. math::
        z \sim q(z \mid s, s') = \mathcal N(\mu_z, \sigma_z^2), \quad
        I(a \mid s, s', z) = \tanh \mathcal N(\mu, \sigma^2)

    It replaces :func:`tanh_gaussian_inverse_dynamics` and also writes the latent's
    parameters, ``"latent_loc"`` and ``"latent_scale"``, ``[B, latent_dim]``.
    :class:`~torchrl_osr.InverseDynamicsLoss` adds :math:`KL(q(z) \,\|\, N(0, 1))`.
    ``z`` is drawn under ``set_interaction_type(InteractionType.RANDOM)``, as in
    training. Otherwise, as in the policy's losses, it is the latent's mean.

    A known limit, also of the original: the encoder does not see the action, and ``z``
    tells the decoder nothing new. Training teaches the decoder to ignore it.

    Differences from the released code (https://github.com/Jack10843/OSR): the action's
    log standard deviation has columns of its own (there those of the mean), and the map
    and floor of the policy's, ``SCALE_MAPPING``. The latent's is kept in
    ``LATENT_LOG_SCALE_BOUNDS``. Default sizes are the authors'; the encoder has one
    layer more than the decoder's ``num_cells``.
    """
    pair = 2 * observation_dim
    encoder = mlp(pair, 2 * latent_dim, [*num_cells, *num_cells[-1:]], activation_class)
    decoder = mlp(pair + latent_dim, 2 * action_dim, num_cells, activation_class)
    keys = [observation_key, nested("next", observation_key)]
    written = ["loc", "scale", "latent_loc", "latent_scale"]
    network = TensorDictModule(_ConditionalVAE(encoder, decoder), keys, written)
    return tanh_normal(network, action_key, low, high)


class _ConditionalVAE(nn.Module):
    """Encoder of both states to ``[B, 2 * Z]``; decoder, of ``z`` too, to ``2 * A``."""

    def __init__(self, encoder: nn.Module, decoder: nn.Module) -> None:
        super().__init__()
        self.encoder, self.decoder = encoder, decoder
        self.extractor = NormalParamExtractor(SCALE_MAPPING)

    def forward(
        self, observation: Tensor, next_observation: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return loc and scale of the action, then loc and scale of the latent."""
        latent_loc, log_scale = self.encoder(observation, next_observation).chunk(2, -1)
        latent_scale = log_scale.clamp(*LATENT_LOG_SCALE_BOUNDS).exp()
        latent = latent_loc
        # Mode, median and mean of a Gaussian are one: no other type draws.
        if interaction_type() is InteractionType.RANDOM:
            latent = latent_loc + latent_scale * torch.randn_like(latent_scale)
        loc, scale = self.extractor(self.decoder(observation, next_observation, latent))
        return loc, scale, latent_loc, latent_scale
