"""Ensemble of probabilistic dynamics models, autoencoder of next states; their losses.

Shapes: ``B`` batch (any leading dimensions), ``S`` observation, ``A`` action, ``E``
networks, ``Z`` latent, ``D = S + 1`` predicted entries: change of the state and reward.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase, TensorDictParams
from torch import Tensor, nn
from torch.nn.functional import softplus

from torchrl_osr._entries import column, entry
from torchrl_osr.functional import gaussian_kl
from torchrl_osr.lab.data.transitions import has_next_state
from torchrl_osr.lab.dynamics.body import Body
from torchrl_osr.modules.actor import mlp
from torchrl_osr.modules.inverse_dynamics import LATENT_LOG_SCALE_BOUNDS
from torchrl_osr.objectives import ActorCriticLoss
from torchrl_osr.objectives.actor_critic import Losses
from torchrl_osr.objectives.transitions import Transitions, check_single_steps

LEAST_RESIDUAL = 1e-3  # of a body, in standard deviations of the state
LOG_VARIANCE_BOUNDS = (-10.0, 0.5)  # at first, as in PETS and MOPO
BOUND_WEIGHT, LATENT_WEIGHT = 0.01, 0.5  # as in MOPO's and BCQ's code

# Of MOPO's four hidden layers and its last one; further layers use the fourth's.
WEIGHT_DECAY, OUTPUT_WEIGHT_DECAY = (2.5e-5, 5e-5, 7.5e-5, 7.5e-5), 1e-4


class DynamicsEnsemble(nn.Module):
    r"""Networks that predict Gaussians of the state's change and the reward.

    .. math::
        \big(s' - s,\, r\big) \sim
        \mathcal N\big(\mu_i(s, a), \operatorname{diag} \sigma_i^2(s, a)\big),
        \quad i = 1 \dots E

    as in PETS (https://arxiv.org/abs/1805.12114) and MOPO
    (https://arxiv.org/abs/2005.13239), which sets the defaults. Inputs and targets are
    standardised. Rollouts use the ``num_elites`` best networks, see
    :meth:`calibrate_`.

    With a :attr:`body`, a grey box, they predict :math:`s' - b(s, a)` instead: what the
    simulated body leaves over. Beyond :attr:`limits` ``[2, S]`` the task ends.

    Examples:
        >>> model = DynamicsEnsemble(11, 3, num_networks=3, num_elites=2)
        >>> mean, scale = model.predict(torch.zeros(4, 11), torch.zeros(4, 3))
        >>> mean.shape
        torch.Size([3, 4, 12])
    """

    input_loc: Tensor
    input_scale: Tensor
    target_loc: Tensor
    target_scale: Tensor
    elites: Tensor
    limits: Tensor
    layers: Any

    def __init__(
        self,
        observation_dim: int,
        action_dim: int,
        *,
        num_networks: int = 7,
        num_elites: int = 5,
        num_cells: Sequence[int] = (200, 200, 200, 200),
    ) -> None:
        super().__init__()
        self.observation_dim, self.action_dim = observation_dim, action_dim
        self.num_networks, self.num_elites = num_networks, num_elites
        self.num_cells = list(num_cells)
        inputs, outputs = observation_dim + action_dim, observation_dim + 1
        widths = [inputs, *num_cells, 2 * outputs]
        self.layers = nn.ModuleList(
            _StackedLinear(num_networks, *sizes) for sizes in pairwise(widths)
        )
        self.activation = nn.SiLU()
        lowest, highest = LOG_VARIANCE_BOUNDS
        self.lowest_log_variance = nn.Parameter(torch.full([outputs], lowest))
        self.highest_log_variance = nn.Parameter(torch.full([outputs], highest))
        for name, size in (("input", inputs), ("target", outputs)):
            self.register_buffer(f"{name}_loc", torch.zeros(size))
            self.register_buffer(f"{name}_scale", torch.ones(size))
        self.register_buffer("elites", torch.arange(num_elites))
        infinite = torch.full([observation_dim], torch.inf)
        self.register_buffer("limits", torch.stack([-infinite, infinite]))
        self.body: Body | None = None

    def predict_standardized(self, inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and log-variance ``[E, B, D]`` of the standardised targets.

        ``inputs`` are states and actions, ``[B, S + A]`` or ``[E, B, S + A]``.
        """
        hidden = (inputs - self.input_loc) / self.input_scale
        if hidden.ndim == 2:
            hidden = hidden.expand(self.num_networks, -1, -1)
        *hidden_layers, last = self.layers
        for layer in hidden_layers:
            hidden = self.activation(layer(hidden))
        mean, free = last(hidden).chunk(2, -1)
        # Smoothly between the learned bounds: PETS, appendix A.1.
        lowest, highest = self.lowest_log_variance, self.highest_log_variance
        return mean, lowest + softplus(highest - softplus(highest - free) - lowest)

    def predict(self, observation: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and scale of all networks, in the data's units, ``[E, B, D]``."""
        batch = observation.shape[:-1]
        inputs = torch.cat([observation, action], -1).flatten(0, -2)
        mean, log_variance = self.predict_standardized(inputs)
        mean = mean * self.target_scale + self.target_loc
        scale = log_variance.mul(0.5).exp() * self.target_scale
        shape = self.num_networks, *batch, -1
        mean, scale = mean.view(shape), scale.view(shape)
        if self.body is not None:
            change = self.body(observation, action) - observation
            mean = torch.cat([mean[..., :-1] + change, mean[..., -1:]], -1)
        return mean, scale

    def observed(self, state: Tensor) -> Tensor:
        """Return what a policy sees of states ``[B, S]``."""
        return state if self.body is None else self.body.observed(state)

    def sample(self, mean: Tensor, scale: Tensor) -> Tensor:
        """Draw an elite for each row, and from its Gaussian, ``[B, D]``."""
        batch, device = mean.shape[1:-1], self.elites.device
        drawn = self.elites[torch.randint(len(self.elites), batch, device=device)]
        drawn = drawn.unsqueeze(-1).expand_as(mean[:1])
        mean, scale = (each.gather(0, drawn).squeeze(0) for each in (mean, scale))
        return mean + scale * torch.randn_like(mean)

    def disagreement(self, mean: Tensor) -> Tensor:
        r"""Return the elites' :math:`\max_i \lVert \mu_i - \bar\mu \rVert_2`, ``[B]``.

        In standard deviations of the targets.
        """
        mean = mean[self.elites] / self.target_scale
        return (mean - mean.mean(0)).norm(dim=-1).amax(0)

    def inputs_and_targets(self, data: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Return ``[B, S + A]`` and ``[B, D]`` of transitions ``[B]``.

        Changes are those since ``"simulated"``, the body's prediction, if it is there.
        """
        observation, action = entry(data, "observation"), entry(data, "action")
        before = data.get("simulated", observation)
        change = entry(data, ("next", "observation")) - before
        reward = column(data, ("next", "reward")).unsqueeze(-1)
        inputs = torch.cat([observation, action.to(observation.dtype)], -1)
        return inputs, torch.cat([change, reward.to(change.dtype)], -1)

    def is_whole(self, data: TensorDictBase) -> Tensor:
        """Return which transitions ``[B]`` can be predicted, bool ``[B]``.

        They have a next state, and no number at a limit of the body's sensors.
        """
        whole = has_next_state(data)
        return whole if self.body is None else whole & self.body.shows(data)

    @torch.no_grad()
    def standardize_(self, data: TensorDictBase) -> None:
        """Take mean and standard deviation of inputs and targets from rows ``[N]``."""
        inputs, targets = self.inputs_and_targets(data[has_next_state(data)])
        copy_statistics(inputs, self.input_loc, self.input_scale)
        copy_statistics(targets, self.target_loc, self.target_scale)
        if self.body is not None:  # a good body leaves rounding errors
            least = LEAST_RESIDUAL * self.input_scale[: self.observation_dim]
            self.target_scale[:-1].clamp_(min=least)

    @torch.no_grad()
    def calibrate_(self, held_out: TensorDictBase) -> None:
        """Choose the networks with the smallest error on held-out rows as elites."""
        rows = held_out[self.is_whole(held_out)]
        _, targets = self.inputs_and_targets(rows)
        mean, _ = self.predict(rows["observation"], rows["action"])
        error = ((mean - targets) / self.target_scale).square().mean((-2, -1))
        self.elites.copy_(error.argsort()[: len(self.elites)].sort().values)

    def parameter_groups(self) -> Iterator[dict[str, Any]]:
        """Yield groups for :class:`torch.optim.Adam`, with MOPO's weight decay."""
        *hidden, last = (layer.weight for layer in self.layers)
        for number, weight in enumerate(hidden):
            decay = WEIGHT_DECAY[min(number, len(WEIGHT_DECAY) - 1)]
            yield {"params": [weight], "weight_decay": decay}
        yield {"params": [last], "weight_decay": OUTPUT_WEIGHT_DECAY}
        weights = {*hidden, last}
        yield {"params": [each for each in self.parameters() if each not in weights]}


class _StackedLinear(nn.Module):
    """The same layer of every network, drawn as in PETS."""

    def __init__(self, number: int, inputs: int, outputs: int) -> None:
        super().__init__()
        std = 1 / (2 * inputs**0.5)
        weight = torch.empty(number, inputs, outputs)
        nn.init.trunc_normal_(weight, std=std, a=-2 * std, b=2 * std)
        self.weight = nn.Parameter(weight)
        self.bias = nn.Parameter(torch.zeros(number, 1, outputs))

    def forward(self, value: Tensor) -> Tensor:
        return torch.baddbmm(self.bias, value, self.weight)


def copy_statistics(values: Tensor, loc: Tensor, scale: Tensor) -> None:
    """Copy mean and standard deviation of ``[N, D]``; 1 for constant entries."""
    std, mean = torch.std_mean(values.double(), 0, correction=0)
    loc.copy_(mean)
    scale.copy_(torch.where(std > 1e-8, std, torch.ones_like(std)))


def gaussian_error(mean: Tensor, log_variance: Tensor, target: Tensor) -> Tensor:
    """Return twice the negative log-likelihood, a mean without constant, ``[B]``."""
    return ((mean - target).square() * (-log_variance).exp() + log_variance).mean(-1)


class DynamicsLoss(ActorCriticLoss):
    r"""Negative log-likelihood of next state and reward, and bounds of the variance.

    .. math::
        L = \sum_{i=1}^{E} \frac1{D} \sum_d \mathbb E \Big[
            \frac{(\mu_{i,d} - y_d)^2}{\sigma_{i,d}^2} + \log \sigma_{i,d}^2 \Big]
            + w \sum_d \big( v^{max}_d - v^{min}_d \big)

    with the standardised targets :math:`y = (s' - s, r)` and the learned bounds
    :math:`v` of the log-variance, and :math:`w = 0.01`, as in MOPO's code
    (tianheyu927/mopo). The batch is divided among the networks, where
    MOPO draws bootstrap samples. Rows without a next state do not count.
    """

    dynamics_network: DynamicsEnsemble
    dynamics_network_params: TensorDictParams
    target_dynamics_network_params: TensorDictParams

    def __init__(self, dynamics_network: DynamicsEnsemble) -> None:
        super().__init__(use_prioritized_weights=False)
        self.convert_to_functional(dynamics_network, "dynamics_network")
        self.declare(["loss_dynamics", "loss_bounds"], [])

    def input_keys(self) -> list[NestedKey]:
        following = [("next", key) for key in ("observation", "reward", "terminated")]
        simulated = [] if self.dynamics_network.body is None else ["simulated"]
        return ["observation", "action", *following, *simulated]

    def losses(self, batch: Transitions) -> Losses:
        check_single_steps(batch, "the model of the dynamics")
        rows, model = batch.one_step, self.dynamics_network
        number = model.num_networks
        if len(rows) % number:
            raise ValueError(
                f"{len(rows)} rows cannot be divided among {number} networks."
            )
        with self.dynamics_network_params.to_module(model):
            inputs, targets = model.inputs_and_targets(rows.reshape(number, -1))
            targets = (targets - model.target_loc) / model.target_scale
            mean, log_variance = model.predict_standardized(inputs)
            width = model.highest_log_variance - model.lowest_log_variance
            bounds = BOUND_WEIGHT * width.sum()
        # Each network has 1/E of the rows over which reduce() takes the mean.
        error = number * gaussian_error(mean, log_variance, targets).flatten()
        loss = self.reduce(error, batch, has_next_state(rows))
        return {"loss_dynamics": loss, "loss_bounds": bounds}, {}


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
        self, observation_dim: int, *, num_cells: Sequence[int] = (750, 750)
    ) -> None:
        super().__init__()
        self.latent_dim = 2 * observation_dim
        self.encoder = mlp(2 * observation_dim, 2 * self.latent_dim, num_cells)
        inputs = observation_dim + self.latent_dim
        self.decoder = mlp(inputs, observation_dim, num_cells)
        self.register_buffer("target_loc", torch.zeros(observation_dim))
        self.register_buffer("target_scale", torch.ones(observation_dim))

    def sample(self, state: Tensor) -> Tensor:
        """Draw a next state for each state, ``[B, S]``."""
        size = *state.shape[:-1], self.latent_dim
        latent = torch.randn(size, dtype=state.dtype, device=state.device)
        return state + self.target_loc + self.target_scale * self.decoder(state, latent)

    @torch.no_grad()
    def standardize_(self, data: TensorDictBase) -> None:
        """Take mean and standard deviation of the change from rows ``[N]``."""
        rows = data[has_next_state(data)]
        change = entry(rows, ("next", "observation")) - entry(rows, "observation")
        copy_statistics(change, self.target_loc, self.target_scale)


class TransitionVAELoss(ActorCriticLoss):
    r"""Squared error of the next state, and the latent's divergence from its prior.

    .. math::
        L = \mathbb E_D\Big[ \frac1S \|f(s, z) - y\|^2
            + w\,\frac1Z \sum_i KL(q_i(z \mid s, s') \,\|\, N(0, 1)) \Big], \quad
            z \sim q

    with the standardised change :math:`y` and :math:`w = 0.5`, as in BCQ's code. Rows
    without a next state do not count.
    """

    vae_network: TransitionVAE
    vae_network_params: TensorDictParams
    target_vae_network_params: TensorDictParams

    def __init__(self, vae_network: TransitionVAE) -> None:
        super().__init__(use_prioritized_weights=False)
        self.convert_to_functional(vae_network, "vae_network")
        self.declare(["loss_vae"], [])

    def input_keys(self) -> list[NestedKey]:
        return ["observation", ("next", "observation"), ("next", "terminated")]

    def losses(self, batch: Transitions) -> Losses:
        check_single_steps(batch, "the autoencoder")
        rows, model = batch.one_step, self.vae_network
        state = entry(rows, "observation")
        target = entry(rows, ("next", "observation"))
        with self.vae_network_params.to_module(model):
            target = (target - state - model.target_loc) / model.target_scale
            loc, log_scale = model.encoder(state, target).chunk(2, -1)
            scale = log_scale.clamp(*LATENT_LOG_SCALE_BOUNDS).exp()
            output = model.decoder(state, loc + scale * torch.randn_like(scale))
        divergence = gaussian_kl(loc, scale).mean(-1)
        value = (output - target).square().mean(-1) + LATENT_WEIGHT * divergence
        return {"loss_vae": self.reduce(value, batch, has_next_state(rows))}, {}
