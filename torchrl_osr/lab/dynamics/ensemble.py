"""Ensemble of probabilistic dynamics models, and its loss.

Shapes: ``B`` batch (any leading dimensions), ``S`` observation, ``A`` action, ``E``
networks, ``D = S + 1`` predicted entries: the change of the state, and the reward.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase, TensorDictParams
from torch import Tensor, nn
from torch.nn.functional import softplus

from torchrl_osr._entries import column, entry, nested
from torchrl_osr.objectives import ActorCriticLoss
from torchrl_osr.objectives.actor_critic import Losses
from torchrl_osr.objectives.transitions import Transitions, check_single_steps

LOG_VARIANCE_BOUNDS = (-10.0, 0.5)
"""Initial values of the learned bounds, as in PETS and MOPO."""

WEIGHT_DECAY = (2.5e-5, 5e-5, 7.5e-5, 7.5e-5)
OUTPUT_WEIGHT_DECAY = 1e-4
"""Of MOPO's four hidden layers and its last one; further layers use the fourth's."""


class DynamicsEnsemble(nn.Module):
    r"""Networks that predict Gaussians of the state's change and the reward.

    .. math::
        \big(s' - s,\, r\big) \sim
        \mathcal N\big(\mu_i(s, a), \operatorname{diag} \sigma_i^2(s, a)\big),
        \quad i = 1 \dots E

    as in PETS (https://arxiv.org/abs/1805.12114) and MOPO
    (https://arxiv.org/abs/2005.13239), which sets the defaults. Inputs and
    targets are standardised: the entries' units do not matter.

    Roll-outs use the ``num_elites`` best networks, see :meth:`calibrate_`.

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
    layers: Any

    def __init__(
        self,
        observation_dim: int,
        action_dim: int,
        *,
        num_networks: int = 7,
        num_elites: int = 5,
        num_cells: Sequence[int] = (200, 200, 200, 200),
        observation_key: NestedKey = "observation",
        action_key: NestedKey = "action",
    ) -> None:
        super().__init__()
        if not 1 <= num_elites <= num_networks:
            limits = f"between 1 and num_networks={num_networks}"
            raise ValueError(f"num_elites must be {limits}, got {num_elites}.")
        self.observation_dim, self.action_dim = observation_dim, action_dim
        self.num_networks, self.num_elites = num_networks, num_elites
        self.num_cells = list(num_cells)
        self.in_keys = [observation_key, action_key]
        inputs, outputs = observation_dim + action_dim, observation_dim + 1
        widths = [inputs, *num_cells, 2 * outputs]
        layers = [_StackedLinear(num_networks, *sizes) for sizes in pairwise(widths)]
        self.layers = nn.ModuleList(layers)
        self.activation = nn.SiLU()
        lowest, highest = LOG_VARIANCE_BOUNDS
        self.lowest_log_variance = nn.Parameter(torch.full([outputs], lowest))
        self.highest_log_variance = nn.Parameter(torch.full([outputs], highest))
        for name, size in (("input", inputs), ("target", outputs)):
            self.register_buffer(f"{name}_loc", torch.zeros(size))
            self.register_buffer(f"{name}_scale", torch.ones(size))
        self.register_buffer("elites", torch.arange(num_elites))

    def standardized(self, inputs: Tensor) -> tuple[Tensor, Tensor]:
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
        below = highest - softplus(highest - free)
        return mean, lowest + softplus(below - lowest)

    def predict(self, observation: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and scale of all networks, in the data's units, ``[E, B, D]``."""
        batch = observation.shape[:-1]
        inputs = torch.cat([observation, action], -1).flatten(0, -2)
        mean, log_variance = self.standardized(inputs)
        mean = mean * self.target_scale + self.target_loc
        scale = log_variance.mul(0.5).exp() * self.target_scale
        shape = self.num_networks, *batch, -1
        return mean.view(shape), scale.view(shape)

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
        distance: Tensor = (mean - mean.mean(0)).norm(dim=-1)
        return distance.amax(0)

    def inputs_and_targets(self, data: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Return ``[B, S + A]`` and ``[B, D]`` of transitions ``[B]``."""
        key, action_key = self.in_keys
        observation, action = entry(data, key), entry(data, action_key)
        change = entry(data, nested("next", key)) - observation
        reward = column(data, ("next", "reward")).unsqueeze(-1)
        inputs = torch.cat([observation, action.to(observation.dtype)], -1)
        return inputs, torch.cat([change, reward.to(change.dtype)], -1)

    @torch.no_grad()
    def standardize_(self, data: TensorDictBase) -> None:
        """Take mean and standard deviation of inputs and targets from rows ``[N]``."""
        rows = data[has_next_state(data, self.in_keys[0])]
        inputs, targets = self.inputs_and_targets(rows)
        copy_statistics(inputs, self.input_loc, self.input_scale)
        copy_statistics(targets, self.target_loc, self.target_scale)

    @torch.no_grad()
    def calibrate_(self, held_out: TensorDictBase) -> None:
        """Choose the networks with the smallest error on held-out rows as elites."""
        rows = held_out[has_next_state(held_out, self.in_keys[0])]
        inputs, targets = self.inputs_and_targets(rows)
        mean, _ = self.standardized(inputs)
        wanted = (targets - self.target_loc) / self.target_scale
        error = (mean - wanted).square().mean((-2, -1))
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


def has_next_state(data: TensorDictBase, key: NestedKey = "observation") -> Tensor:
    """Return which of the transitions ``[B]`` have a next state, bool ``[B]``.

    Readers repeat the state where a recording lacks the next one of a terminated row.
    """
    same = (entry(data, nested("next", key)) == entry(data, key)).all(-1)
    return ~(same & column(data, ("next", "terminated")).bool())


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
    :math:`v` of the log-variance, as in MOPO's code (tianheyu927/mopo), whose weight
    decay is in :meth:`DynamicsEnsemble.parameter_groups`. The batch is divided among
    the networks, where MOPO draws bootstrap samples. Rows without a next state do not
    count.

    Args:
        dynamics_network: to be trained, standardised already.

    Keyword Args:
        bound_weight: ``w``. Default 0.01, MOPO's.
    """

    dynamics_network: DynamicsEnsemble
    dynamics_network_params: TensorDictParams
    target_dynamics_network_params: TensorDictParams

    def __init__(
        self, dynamics_network: DynamicsEnsemble, *, bound_weight: float = 0.01
    ) -> None:
        super().__init__(use_prioritized_weights=False)
        self.convert_to_functional(dynamics_network, "dynamics_network")
        self.bound_weight = bound_weight
        self.declare(["loss_dynamics", "loss_bounds"], [])

    def input_keys(self) -> list[NestedKey]:
        key, action = self.dynamics_network.in_keys
        following = [nested("next", each) for each in (key, "reward", "terminated")]
        return [key, action, *following]

    def losses(self, batch: Transitions) -> Losses:
        check_single_steps(batch, "the model of the dynamics")
        rows, model = batch.one_step, self.dynamics_network
        number = model.num_networks
        if len(rows) % number:
            raise ValueError(
                f"{len(rows)} rows cannot be divided among {number} networks."
            )
        with self.dynamics_network_params.to_module(model):
            inputs, targets = model.inputs_and_targets(rows)
            targets = (targets - model.target_loc) / model.target_scale
            inputs = inputs.reshape(number, -1, inputs.shape[-1])
            targets = targets.reshape(number, -1, targets.shape[-1])
            mean, log_variance = model.standardized(inputs)
            width = model.highest_log_variance - model.lowest_log_variance
            bounds = self.bound_weight * width.sum()
        # Of the mean over E times as many rows as each network has.
        error = number * gaussian_error(mean, log_variance, targets).flatten()
        valid = has_next_state(rows, model.in_keys[0])
        loss = self.reduce(error, batch, valid)
        return {"loss_dynamics": loss, "loss_bounds": bounds}, {}
