"""Policies of one observation: tanh-Gaussian, deterministic, Gaussian and categorical.

All take ``observation_dim`` (``S``), ``action_dim`` (``A``; or ``num_actions``) and:

- ``num_cells``: width of each hidden layer. Default 256 and 256.
- ``activation_class``: activation between the layers. Default ReLU.
- ``low``, ``high``: action bounds, a number or a tensor ``[A]`` of the network's type.
  Default -1 and 1. Of the first two alone.
- ``observation_key``: the state that they read. Default ``"observation"``.
- ``action_key``: the action that they write. Default ``"action"``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import NestedKey
from tensordict.nn import AddStateIndependentNormalScale, TensorDictModule
from torch import Tensor, nn
from torchrl.modules import (
    MLP,
    IndependentNormal,
    NormalParamExtractor,
    OneHotCategorical,
    ProbabilisticActor,
    TanhDelta,
    TanhNormal,
)

SCALE_MAPPING = "biased_softplus_1.0_0.01"
"""Standard deviation before the tanh, of policy and inverse dynamics alike.

A softplus that is 1 at 0 and never below 0.01: the forward KL divides by the policy's
variance, and without a floor one confident, wrong state owns the whole gradient.
"""


def mlp(
    inputs: int,
    outputs: int,
    num_cells: Sequence[int] = (256, 256),
    activation_class: type[nn.Module] = nn.ReLU,
    *,
    layer_norm: bool = False,
) -> MLP:
    """Return an MLP; with ``layer_norm``, each hidden layer is normalised."""
    cells = list(num_cells)
    options: dict[str, Any] = {"activation_class": activation_class}
    if layer_norm:
        options["norm_class"] = nn.LayerNorm
        options["norm_kwargs"] = [{"normalized_shape": width} for width in cells]
    return MLP(inputs, outputs, num_cells=cells, **options)


def tanh_normal(
    network: TensorDictModule, action_key: NestedKey, low: Any, high: Any
) -> ProbabilisticActor:
    """Return a tanh-Gaussian over what a network writes as ``loc`` and ``scale``."""
    return ProbabilisticActor(
        network,
        in_keys=["loc", "scale"],
        out_keys=[action_key],
        distribution_class=TanhNormal,
        distribution_kwargs={"low": low, "high": high},
        return_log_prob=True,
    )


def one_hot(
    network: nn.Module, in_keys: Sequence[NestedKey], action_key: NestedKey
) -> ProbabilisticActor:
    """Return a one-hot categorical over what a network writes as ``logits``."""
    return ProbabilisticActor(
        TensorDictModule(network, in_keys, ["logits"]),
        in_keys=["logits"],
        out_keys=[action_key],
        distribution_class=OneHotCategorical,
        return_log_prob=True,
    )


def tanh_gaussian_actor(
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
    """Return a tanh-Gaussian actor; see the module for the arguments.

    It writes ``"loc"``, ``"scale"`` (before the tanh) and the action, each ``[B, A]``,
    and ``"action_log_prob"``, ``[B]``.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> actor = tanh_gaussian_actor(11, 3, num_cells=[32])
        >>> actor(TensorDict({"observation": torch.zeros(4, 11)}, [4]))["action"].shape
        torch.Size([4, 3])
    """
    layers = mlp(observation_dim, 2 * action_dim, num_cells, activation_class)
    network = nn.Sequential(layers, NormalParamExtractor(SCALE_MAPPING))
    module = TensorDictModule(network, [observation_key], ["loc", "scale"])
    return tanh_normal(module, action_key, low, high)


def deterministic_actor(
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
    """Return a deterministic actor, whose action ends in a tanh.

    It writes ``"param"`` (before the tanh, which :class:`~torchrl.modules.TanhDelta`
    takes of its sum with the center of the bounds) and the action, each ``[B, A]``.
    """
    network = mlp(observation_dim, action_dim, num_cells, activation_class)
    with torch.no_grad():  # actions begin at the center
        network[-1].bias -= (torch.as_tensor(low) + torch.as_tensor(high)) / 2
    return ProbabilisticActor(
        TensorDictModule(network, [observation_key], ["param"]),
        in_keys=["param"],
        out_keys=[action_key],
        distribution_class=TanhDelta,
        distribution_kwargs={"low": low, "high": high, "safe": False},
    )


def gaussian_actor(
    observation_dim: int,
    action_dim: int,
    *,
    num_cells: Sequence[int] = (256, 256),
    activation_class: type[nn.Module] = nn.ReLU,
    observation_key: NestedKey = "observation",
    action_key: NestedKey = "action",
) -> ProbabilisticActor:
    """Return a Gaussian actor: IQL's.

    Its mean ends in a tanh, between -1 and 1; its samples do not. The density is
    therefore moderate at the bounds, where data have many actions. The standard
    deviation is learned, the same for all states. It writes ``"loc"`` (the mean),
    ``"scale"`` and the action, each ``[B, A]``.
    """
    mean = mlp(observation_dim, action_dim, num_cells, activation_class)
    network = nn.Sequential(mean, nn.Tanh(), AddStateIndependentNormalScale(action_dim))
    return ProbabilisticActor(
        TensorDictModule(network, [observation_key], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        out_keys=[action_key],
        distribution_class=IndependentNormal,
    )


def categorical_actor(
    observation_dim: int,
    num_actions: int,
    *,
    num_cells: Sequence[int] = (256, 256),
    activation_class: type[nn.Module] = nn.ReLU,
    observation_key: NestedKey = "observation",
    action_key: NestedKey = "action",
) -> ProbabilisticActor:
    """Return an actor that chooses one of ``n`` discrete actions.

    It writes ``"logits"`` and the action, one-hot as :class:`~torchrl.envs.GymEnv`
    takes it by default, each ``[B, n]``, and ``"action_log_prob"``, ``[B]``.
    """
    network = mlp(observation_dim, num_actions, num_cells, activation_class)
    return one_hot(network, [observation_key], action_key)
