"""Policies: a tanh-Gaussian actor, a Gaussian and a deterministic one."""

from __future__ import annotations

import math
from collections.abc import Sequence

from tensordict import NestedKey
from tensordict.nn import AddStateIndependentNormalScale, TensorDictModule
from torch import Tensor, nn
from torchrl.modules import (
    MLP,
    IndependentNormal,
    NormalParamExtractor,
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
    """Return a tanh-Gaussian actor of one observation.

    Args:
        observation_dim: size of the observation, ``S``.
        action_dim: size of the action, ``A``.
        num_cells: width of each hidden layer.
        activation_class: activation between the layers.
        low, high: action bounds, a number or ``[A]``.
        observation_key: the state it reads. Default ``"observation"``.
        action_key: the action it writes. Default ``"action"``.

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
        MLP(
            in_features=observation_dim,
            out_features=2 * action_dim,
            num_cells=list(num_cells),
            activation_class=activation_class,
        ),
        NormalParamExtractor(SCALE_MAPPING),
    )
    return ProbabilisticActor(
        TensorDictModule(network, [observation_key], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        out_keys=[action_key],
        distribution_class=TanhNormal,
        distribution_kwargs={"low": low, "high": high},
        return_log_prob=True,
    )


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
    """Deterministic actor of one observation; its action ends in a tanh.

    Args:
        observation_dim: size of the observation, ``S``.
        action_dim: size of the action, ``A``.
        num_cells: width of each hidden layer.
        activation_class: activation between the layers.
        low, high: action bounds, a number or ``[A]``.
        observation_key: the state it reads. Default ``"observation"``.
        action_key: the action it writes. Default ``"action"``.

    Returns:
        An actor that writes ``"param"`` (before the tanh, which
        :class:`~torchrl.modules.TanhDelta` takes of its sum with the center of the
        bounds) and the action, each ``[B, A]``.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> actor = deterministic_actor(11, 3, num_cells=[32])
        >>> actor(TensorDict({"observation": torch.zeros(4, 11)}, [4]))["action"].shape
        torch.Size([4, 3])
    """
    network = MLP(
        in_features=observation_dim,
        out_features=action_dim,
        num_cells=list(num_cells),
        activation_class=activation_class,
    )
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
    r"""Gaussian actor of one observation: IQL's.

    Its mean ends in a tanh, between -1 and 1; its samples do not. So the density is
    moderate at actions on the bounds, of which data have many.

    Args:
        observation_dim: size of the observation, ``S``.
        action_dim: size of the action, ``A``.
        num_cells: width of each hidden layer.
        activation_class: activation between the layers.
        scale: fixed standard deviation. With :math:`1 / \sqrt 2` the log-density is
            minus the squared distance from the mean, up to a constant: that of a
            deterministic policy. Default: learned, the same for all states, 1 at first.
        observation_key: the state it reads. Default ``"observation"``.
        action_key: the action it writes. Default ``"action"``.

    Returns:
        An actor that writes ``"loc"`` (the mean), ``"scale"`` and the action, each
        ``[B, A]``.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> actor = gaussian_actor(11, 3, num_cells=[32])
        >>> actor(TensorDict({"observation": torch.zeros(4, 11)}, [4]))["action"].shape
        torch.Size([4, 3])
    """
    if scale is not None:
        check_positive("scale", scale)
    spread = AddStateIndependentNormalScale(
        action_dim, make_param=scale is None, init_value=math.log(scale or 1.0)
    )
    network = nn.Sequential(
        MLP(
            in_features=observation_dim,
            out_features=action_dim,
            num_cells=list(num_cells),
            activation_class=activation_class,
        ),
        nn.Tanh(),
        spread,
    )
    return ProbabilisticActor(
        TensorDictModule(network, [observation_key], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        out_keys=[action_key],
        distribution_class=IndependentNormal,
    )
