"""Policies of one observation: tanh-Gaussian, deterministic, Gaussian and categorical.

All take ``observation_dim`` (``S``), ``action_dim`` (``A``) and these keywords:

- ``num_cells``: width of each hidden layer. Default 256 and 256.
- ``activation_class``: activation between the layers. Default ReLU.
- ``low``, ``high``: action bounds, a number or ``[A]``. Default -1 and 1.
- ``observation_key``: the state that they read. Default ``"observation"``.
- ``action_key``: the action that they write. Default ``"action"``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

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

from torchrl_osr._checks import check_positive

SCALE_MAPPING = "biased_softplus_1.0_0.01"
"""Standard deviation before the tanh, of policy and inverse dynamics alike: a softplus
that is 1 at 0 and never below 0.01.

The forward KL divides by the policy's variance: without a floor one confident,
wrong state owns the whole gradient.
"""


def mlp(
    inputs: int,
    outputs: int,
    num_cells: Sequence[int],
    activation_class: type[nn.Module],
    *,
    layer_norm: bool = False,
) -> MLP:
    """Return an MLP; with ``layer_norm``, each hidden layer is normalised."""
    norm: dict[str, Any] = {}
    if layer_norm:
        widths = [{"normalized_shape": width} for width in num_cells]
        norm = {"norm_class": nn.LayerNorm, "norm_kwargs": widths}
    return MLP(
        inputs,
        outputs,
        num_cells=list(num_cells),
        activation_class=activation_class,
        **norm,
    )


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

    Returns:
        An actor that writes ``"loc"``, ``"scale"`` (before the tanh) and the action,
        each ``[B, A]``, and ``"action_log_prob"``, ``[B]``.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> actor = tanh_gaussian_actor(11, 3, num_cells=[32])
        >>> actor(TensorDict({"observation": torch.zeros(4, 11)}, [4]))["action"].shape
        torch.Size([4, 3])
    """
    network = nn.Sequential(
        mlp(observation_dim, 2 * action_dim, num_cells, activation_class),
        NormalParamExtractor(SCALE_MAPPING),
    )
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

    Returns:
        An actor that writes ``"param"`` (before the tanh, which
        :class:`~torchrl.modules.TanhDelta` takes of its sum with the center of the
        bounds) and the action, each ``[B, A]``.
    """
    network = mlp(observation_dim, action_dim, num_cells, activation_class)
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
    scale: float | None = None,
    observation_key: NestedKey = "observation",
    action_key: NestedKey = "action",
) -> ProbabilisticActor:
    r"""Return a Gaussian actor: IQL's.

    Its mean ends in a tanh, between -1 and 1; its samples do not. So the density is
    moderate at actions on the bounds, of which data have many.

    Keyword Args:
        scale: fixed standard deviation. With :math:`1 / \sqrt 2` the log-density is
            minus the squared distance from the mean, up to a constant: that of a
            deterministic policy. Default: learned, the same for all states, 1 at first.

    Returns:
        An actor that writes ``"loc"`` (the mean), ``"scale"`` and the action, each
        ``[B, A]``.
    """
    if scale is not None:
        check_positive("scale", scale)
    spread = AddStateIndependentNormalScale(
        action_dim, make_param=scale is None, init_value=math.log(scale or 1.0)
    )
    network = nn.Sequential(
        mlp(observation_dim, action_dim, num_cells, activation_class), nn.Tanh(), spread
    )
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

    Its actions are one-hot, as :class:`~torchrl.envs.GymEnv` gives and takes them
    unless it was made with ``categorical_action_encoding=True``.

    Returns:
        An actor that writes ``"logits"`` and the action, each ``[B, n]``, and
        ``"action_log_prob"``, ``[B]``.
    """
    network = mlp(observation_dim, num_actions, num_cells, activation_class)
    return one_hot(network, [observation_key], action_key)
