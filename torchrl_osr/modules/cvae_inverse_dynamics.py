"""An inverse dynamics model with a latent variable: the authors' conditional VAE.

Shapes: ``B`` batch (any leading dimensions), ``S`` observation, ``A`` action, ``Z``
latent.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import NestedKey
from tensordict.nn import InteractionType, TensorDictModule
from tensordict.nn.probabilistic import interaction_type
from torch import Tensor, nn
from torchrl.modules import MLP, NormalParamExtractor, ProbabilisticActor, TanhNormal

from torchrl_osr._entries import nested
from torchrl_osr.modules.actor import SCALE_MAPPING
from torchrl_osr.modules.initial_weights import remember_weights

LATENT_LOG_SCALE_BOUNDS = (-4.0, 15.0)
"""Range of the latent's log standard deviation, that of BCQ's VAE
(https://arxiv.org/abs/1812.02900).

The KL to the unit prior takes the logarithm and the square of the scale: unbounded,
the exponential underflows to a logarithm of 0 or overflows. A latent known to
``exp(-4) = 0.018`` is as good as noiseless beside a prior of 1, and the upper end is
far out on purpose, because outside the range the gradient that would lead back is 0.
"""


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

    It stands in for :func:`~torchrl_osr.modules.tanh_gaussian_inverse_dynamics` and
    writes the latent's parameters besides, from which
    :class:`~torchrl_osr.InverseDynamicsLoss` adds :math:`KL(q(z) \,\|\, N(0, 1))`.
    ``z`` is drawn anew in every call under
    ``set_interaction_type(InteractionType.RANDOM)``, as in training, and is its mean
    under every other type, hence by default and in the policy's losses.

    A known limit, of the original too: the encoder does not see the action. ``z``
    tells the decoder nothing that :math:`(s, s')` does not, so that its noise can only
    do harm: training teaches the decoder to ignore it and :math:`q` to be the prior.
    The action stays a single tanh-Gaussian.

    Departures from the released code (https://github.com/Jack10843/OSR):

    - There the action's log standard deviation is read from the columns of the mean,
      an affine function of it. Here it has columns of its own.
    - There it is unbounded in the divergence from the policy. Here it has the map and
      the floor of the policy's, ``SCALE_MAPPING``.
    - There the latent's is unbounded. Here it is kept in ``LATENT_LOG_SCALE_BOUNDS``.

    Args:
        observation_dim: size of the observation, ``S``.
        action_dim: size of the action, ``A``.
        latent_dim: size of the latent, ``Z``. Default 32, the authors'.
        num_cells: width of each hidden layer of the decoder. The encoder has one more,
            as wide as the last. By default both then match the authors'.
        activation_class: activation between the layers.
        low, high: action bounds, a number or ``[A]``.
        observation_key: the state it reads, and the next state below ``"next"``.
            Default ``"observation"``.
        action_key: the action it writes. Default ``"action"``.

    Returns:
        A module that reads ``"observation"`` and ``("next", "observation")`` and
        writes ``"loc"``, ``"scale"`` (before the tanh), ``"latent_loc"``,
        ``"latent_scale"``, ``[B, Z]``, ``"action"`` and ``"action_log_prob"`` (given
        ``z``).

    Raises:
        ValueError: if ``latent_dim`` is less than 1.

    Examples:
        >>> from tensordict import TensorDict
        >>> model = cvae_inverse_dynamics(11, 3, latent_dim=8, num_cells=[32])
        >>> s = torch.zeros(4, 11)
        >>> batch = TensorDict({"observation": s, "next": {"observation": s + 1}}, [4])
        >>> out = model(batch)
        >>> out["action"].shape, out["latent_loc"].shape
        (torch.Size([4, 3]), torch.Size([4, 8]))
    """
    if latent_dim < 1:
        raise ValueError(f"latent_dim must be at least 1, got {latent_dim}.")
    encoder = MLP(
        in_features=2 * observation_dim,
        out_features=2 * latent_dim,
        num_cells=[*num_cells, *num_cells[-1:]],
        activation_class=activation_class,
    )
    decoder = MLP(
        in_features=2 * observation_dim + latent_dim,
        out_features=2 * action_dim,
        num_cells=list(num_cells),
        activation_class=activation_class,
    )
    model = ProbabilisticActor(
        TensorDictModule(
            _ConditionalVAE(encoder, decoder),
            [observation_key, nested("next", observation_key)],
            ["loc", "scale", "latent_loc", "latent_scale"],
        ),
        in_keys=["loc", "scale"],
        out_keys=[action_key],
        distribution_class=TanhNormal,
        distribution_kwargs={"low": low, "high": high},
        return_log_prob=True,
    )
    return remember_weights(model)


class _ConditionalVAE(nn.Module):
    """Encoder, latent and decoder.

    Args:
        encoder: from both states, ``[B, S]`` each, to ``[B, 2 * Z]``.
        decoder: from both states and the latent to ``[B, 2 * A]``.
    """

    def __init__(self, encoder: nn.Module, decoder: nn.Module) -> None:
        super().__init__()
        self.encoder = encoder
        self.decoder = decoder
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
        param = self.decoder(observation, next_observation, latent)
        loc, scale = self.extractor(param)
        return loc, scale, latent_loc, latent_scale
