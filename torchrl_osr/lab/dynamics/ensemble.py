"""The dynamics model: an ensemble of networks that predict the next state and reward.

Shapes: ``B`` batch (any leading dimensions), ``S`` observation, ``A`` action, ``E``
networks, ``D`` predicted entries: ``S`` differences of the state, and the reward.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Any, NamedTuple, cast

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from torchrl_osr._checks import check_positive
from torchrl_osr._entries import column, entry, nested
from torchrl_osr.lab.dynamics.equations import bounded_log_variance, disagreement

LOG_VARIANCE_BOUNDS = (-10.0, 0.5)
"""Where the learned bounds of the log-variance begin, as in PETS and MOPO."""

WEIGHT_DECAY = (2.5e-5, 5e-5, 7.5e-5, 7.5e-5)
OUTPUT_WEIGHT_DECAY = 1e-4
"""Of MOPO's four hidden layers, and of its last one; a further one has the fourth's."""


class Prediction(NamedTuple):
    """Gaussians of all networks, in the units of the data.

    Attributes:
        mean: ``[E, B, D]``; the first ``S`` entries are added to the state.
        scale: standard deviations, likewise.
    """

    mean: Tensor
    scale: Tensor


class DynamicsEnsemble(TensorDictModuleBase):
    r"""Gaussians of the state's change and of the reward, of several networks.

    .. math::
        \big(s' - s,\, r\big) \sim
        \mathcal N\big(\mu_i(s, a), \operatorname{diag} \sigma_i^2(s, a)\big),
        \quad i = 1 \dots E

    as in PETS (https://arxiv.org/abs/1805.12114) and MOPO
    (https://arxiv.org/abs/2005.13239). All networks are stacked: each layer is one
    batched product. Log-variances are bounded smoothly, by bounds that are learned.

    Unlike there, the targets are standardised as well as the inputs (see
    :meth:`standardize_`), so that no entry outweighs the others because of its unit.

    Args:
        observation_dim: size of the observation, ``S``.
        action_dim: size of the action, ``A``; of discrete actions their number.

    Keyword Args:
        num_networks: ``E``. Default 7, MOPO's.
        num_elites: how many of them are rolled out, see :meth:`calibrate_`. Default 5,
            MOPO's.
        num_cells: width of each hidden layer. Default four of 200, MOPO's.
        activation_class: activation between the layers. Default
            :class:`torch.nn.SiLU`.
        observation_key, action_key: the entries it reads. Default ``"observation"``
            and ``"action"``.

    Raises:
        ValueError: there are no networks, or more elites than networks.

    Examples:
        >>> import torch
        >>> from torchrl_osr.lab.dynamics import DynamicsEnsemble
        >>> model = DynamicsEnsemble(11, 3, num_networks=3, num_elites=2)
        >>> mean, scale = model.predict(torch.zeros(4, 11), torch.zeros(4, 3))
        >>> mean.shape
        torch.Size([3, 4, 12])
    """

    elites: Tensor

    def __init__(
        self,
        observation_dim: int,
        action_dim: int,
        *,
        num_networks: int = 7,
        num_elites: int = 5,
        num_cells: Sequence[int] = (200, 200, 200, 200),
        activation_class: type[nn.Module] = nn.SiLU,
        observation_key: NestedKey = "observation",
        action_key: NestedKey = "action",
    ) -> None:
        super().__init__()
        check_positive("num_networks", num_networks, minimum=1)
        if not 1 <= num_elites <= num_networks:
            raise ValueError(
                f"num_elites must be between 1 and num_networks={num_networks}, got "
                f"{num_elites}."
            )
        self.observation_dim, self.action_dim = observation_dim, action_dim
        self.num_networks = num_networks
        self.in_keys = [observation_key, action_key]
        self.out_keys = ["loc", "scale"]
        inputs, outputs = observation_dim + action_dim, observation_dim + 1
        widths = [inputs, *num_cells, 2 * outputs]
        self.layers = nn.ModuleList(
            _StackedLinear(num_networks, *sizes) for sizes in pairwise(widths)
        )
        self.activation = activation_class()
        for name, bound in zip(("lowest", "highest"), LOG_VARIANCE_BOUNDS, strict=True):
            value = torch.full([outputs], bound)
            self.register_parameter(f"{name}_log_variance", nn.Parameter(value))
        for name, size in (("input", inputs), ("target", outputs)):
            self.register_buffer(f"{name}_loc", torch.zeros(size))
            self.register_buffer(f"{name}_scale", torch.ones(size))
        self.register_buffer("elites", torch.arange(num_elites))

    # -- predictions ------------------------------------------------------------

    def standardized(self, inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and log-variance ``[E, B, D]`` of the standardised targets.

        Args:
            inputs: states and actions in the data's units, joined: ``[B, S + A]`` for
                all networks, or ``[E, B, S + A]``, each network's own.
        """
        hidden = (inputs - self.input_loc) / self.input_scale
        if hidden.ndim == 2:
            hidden = hidden.expand(self.num_networks, -1, -1)
        *hidden_layers, last = self.layers
        for layer in hidden_layers:
            hidden = self.activation(layer(hidden))
        mean, free = last(hidden).chunk(2, -1)
        bounds = self.lowest_log_variance, self.highest_log_variance
        return mean, bounded_log_variance(free, *bounds)

    def predict(self, observation: Tensor, action: Tensor) -> Prediction:
        """Gaussians of all networks at ``[B, S]`` and ``[B, A]``."""
        batch = observation.shape[:-1]
        inputs = torch.cat([observation, action], -1).flatten(0, -2)
        mean, log_variance = self.standardized(inputs)
        return Prediction(
            (mean * self.target_scale + self.target_loc).unflatten(1, batch),
            (log_variance.mul(0.5).exp() * self.target_scale).unflatten(1, batch),
        )

    def sample(self, prediction: Prediction) -> Tensor:
        """Draw from the Gaussian of an elite that is drawn for each row, ``[B, D]``.

        Args:
            prediction: of :meth:`predict`; there are gradients by it.
        """
        batch = prediction.mean.shape[1:-1]
        drawn = torch.randint(len(self.elites), batch, device=self.elites.device)
        chosen = self.elites[drawn].unsqueeze(-1).expand_as(prediction.mean[:1])
        mean, scale = (each.gather(0, chosen).squeeze(0) for each in prediction)
        return mean + scale * torch.randn_like(mean)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``"loc"`` and ``"scale"``, ``[B, E, D]``, of a batch ``[B]``."""
        found = self.predict(*(entry(tensordict, key) for key in self.in_keys))
        for key, value in zip(self.out_keys, found, strict=True):
            tensordict.set(key, value.movedim(0, -2))
        return tensordict

    def disagreement(self, mean: Tensor) -> Tensor:
        """How far the elites' predictions lie apart, in units of the targets' spread.

        Args:
            mean: of :meth:`predict`, ``[E, B, D]``.

        Returns:
            ``[B]``, see :func:`~torchrl_osr.lab.dynamics.equations.disagreement`;
            every entry
            counts in units of its target's standard deviation.
        """
        return disagreement(mean[self.elites] / self.target_scale)

    # -- what data say ------------------------------------------------------------

    def inputs_and_targets(self, data: TensorDictBase) -> tuple[Tensor, Tensor]:
        """States and actions ``[B, S + A]``, and what follows from them, ``[B, D]``.

        Args:
            data: transitions ``[B]``.
        """
        key, action_key = self.in_keys
        observation, action = entry(data, key), entry(data, action_key)
        change = entry(data, nested("next", key)) - observation
        reward = column(data, ("next", "reward")).unsqueeze(-1)
        inputs = torch.cat([observation, action.to(observation.dtype)], -1)
        return inputs, torch.cat([change, reward.to(change.dtype)], -1)

    @torch.no_grad()
    def standardize_(self, data: TensorDictBase) -> None:
        """Take means and standard deviations of inputs and targets from data.

        An entry that does not vary keeps a standard deviation of 1.

        Args:
            data: transitions ``[N]``; rows without a next state are left out, see
                :func:`has_next_state`.
        """
        rows = data[has_next_state(data, self.in_keys[0])]
        names = ("input", "target")
        for name, values in zip(names, self.inputs_and_targets(rows), strict=True):
            loc, scale = loc_and_scale(values)
            getattr(self, f"{name}_loc").copy_(loc)
            getattr(self, f"{name}_scale").copy_(scale)

    @torch.no_grad()
    def calibrate_(self, held_out: TensorDictBase) -> None:
        """Choose the elites by their error on held-out rows.

        They are the networks with the smallest mean squared error of standardised
        targets.

        Args:
            held_out: transitions ``[N]``.
        """
        rows = held_out[has_next_state(held_out, self.in_keys[0])]
        inputs, targets = self.inputs_and_targets(rows)
        mean, _ = self.standardized(inputs)
        wanted = (targets - self.target_loc) / self.target_scale
        error = (mean - wanted).square().mean((-2, -1))
        self.elites.copy_(error.argsort()[: len(self.elites)].sort().values)

    def parameter_groups(self) -> Iterator[dict[str, Any]]:
        """Groups for an optimizer: weights with MOPO's decay, the rest without.

        With :class:`torch.optim.Adam` the decay is that of MOPO's code: half the
        squared norm of each layer's weights, times its factor, is added to the loss.
        """
        *hidden, last = (cast(_StackedLinear, layer) for layer in self.layers)
        for number, layer in enumerate(hidden):
            decay = WEIGHT_DECAY[min(number, len(WEIGHT_DECAY) - 1)]
            yield {"params": [layer.weight], "weight_decay": decay}
        yield {"params": [last.weight], "weight_decay": OUTPUT_WEIGHT_DECAY}
        weights = {id(layer.weight) for layer in (*hidden, last)}
        yield {
            "params": [each for each in self.parameters() if id(each) not in weights]
        }


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


def loc_and_scale(values: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation of each entry of ``[N, D]``, float64.

    An entry that does not vary has a standard deviation of 1: it is divided by.
    """
    scale, loc = torch.std_mean(values.double(), 0, correction=0)
    return loc, torch.where(scale > 1e-8, scale, torch.ones_like(scale))


def has_next_state(data: TensorDictBase, key: NestedKey = "observation") -> Tensor:
    """Which rows say where their action has led, bool ``[B]``.

    Where a recording ends with a terminated row that lacks its next state, the readers
    of this package repeat the state (see docs/your_data.md). Such rows say nothing
    about the dynamics; all others do, also the last ones of an episode.

    Args:
        data: transitions ``[B]``.
        key: of the state. Default ``"observation"``.
    """
    same = (entry(data, nested("next", key)) == entry(data, key)).all(-1)
    return ~(same & column(data, ("next", "terminated")).bool())
