"""The mean predictions of a dynamics model's elites, to roll each out by itself.

Shapes: ``E`` networks, ``n`` rows of each, ``S`` observation, ``A`` action, ``D = S +
1`` predicted entries.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy

import torch
from torch import Tensor

from torchrl_osr.lab.dynamics.ensemble import DynamicsEnsemble


class EliteNetworks:
    """Mean changes of the state and mean rewards, ``[E, n, D]``, of frozen networks.

    The elites of a :class:`DynamicsEnsemble` without their variances: states and
    actions in an environment's units, rewards in those that the model has learned. All
    standardisation is folded into the first and the last layer: what is left to compute
    is one batched product a layer.

    Args:
        model: is copied.
        loc, scale: what was subtracted from the environment's states, and what they
            were divided by, before the model has learned from them, ``[S]``. Default 0
            and 1.
        low, high: of the environment's actions, for the data's -1 and 1, ``[A]``.
            Default -1 and 1.

    Attributes:
        num_networks, action_dim: ``E`` and ``A``.

    Examples:
        >>> import torch
        >>> from torchrl_osr.lab.dynamics import DynamicsEnsemble, EliteNetworks
        >>> networks = EliteNetworks(DynamicsEnsemble(11, 3, num_elites=5))
        >>> networks(torch.zeros(5, 4, 11), torch.zeros(5, 4, 3)).shape
        torch.Size([5, 4, 12])
    """

    @torch.no_grad()
    def __init__(
        self,
        model: DynamicsEnsemble,
        loc: Tensor | float = 0.0,
        scale: Tensor | float = 1.0,
        low: Tensor | float = -1.0,
        high: Tensor | float = 1.0,
    ) -> None:
        ones = model.target_loc.new_ones
        states, actions = ones(model.observation_dim), ones(model.action_dim)
        center = torch.cat([loc * states, (low + high) / 2 * actions]).double()
        unit = torch.cat([scale * states, (high - low) / 2 * actions]).double()
        layers = [dict(each.named_parameters()) for each in model.layers]
        weights = [each["weight"][model.elites].double() for each in layers]
        biases = [each["bias"][model.elites].double() for each in layers]
        weights[0] /= (unit * model.input_scale).unsqueeze(-1)
        shift = (center + unit * model.input_loc) @ weights[0]
        biases[0] -= shift.unsqueeze(1)
        size = len(model.target_loc)  # what follows are log-variances
        out = torch.cat([scale * states, ones(1)]).double()
        weights[-1] = weights[-1][..., :size] * model.target_scale * out
        biases[-1] = biases[-1][..., :size] * model.target_scale * out
        biases[-1] += model.target_loc * out
        self.weights = [each.float() for each in weights]
        self.biases = [each.float() for each in biases]
        self.activation = model.activation
        self.num_networks, self.action_dim = len(model.elites), model.action_dim

    @classmethod
    def join(cls, parts: Sequence[EliteNetworks]) -> EliteNetworks:
        """All networks of several in one, those of the first one first.

        Raises:
            ValueError: their layers differ.
        """
        kinds = {
            (type(each.activation), *(tuple(layer.shape[1:]) for layer in each.weights))
            for each in parts
        }
        if len(kinds) != 1:
            raise ValueError(
                f"models can be joined if their layers are alike, got {len(kinds)} "
                f"kinds: {kinds}."
            )
        joined = copy(parts[0])
        weights, biases = zip(*((p.weights, p.biases) for p in parts), strict=True)
        joined.weights = [torch.cat(layer) for layer in zip(*weights, strict=True)]
        joined.biases = [torch.cat(layer) for layer in zip(*biases, strict=True)]
        joined.num_networks = sum(each.num_networks for each in parts)
        return joined

    def __call__(self, observation: Tensor, action: Tensor) -> Tensor:
        """Changes and rewards at ``[E, n, S]`` and ``[E, n, A]``."""
        hidden = torch.cat([observation, action], -1)
        *layers, last = zip(self.biases, self.weights, strict=True)
        for bias, weight in layers:
            hidden = self.activation(torch.baddbmm(bias, hidden, weight))
        return torch.baddbmm(last[0], hidden, last[1])
