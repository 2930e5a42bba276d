"""The critics: an ensemble of Q networks, and a value network of states alone."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from tensordict import NestedKey
from torch import nn
from torchrl.modules import MLP, ValueOperator


def critic_ensemble(
    observation_dim: int,
    action_dim: int,
    *,
    num_qvalue_nets: int = 2,
    num_cells: Sequence[int] = (256, 256),
    activation_class: type[nn.Module] = nn.ReLU,
    layer_norm: bool = False,
    observation_key: NestedKey = "observation",
    action_key: NestedKey = "action",
) -> list[ValueOperator]:
    """Return Q networks of one observation and the action.

    A list, not one network to be copied by the loss: TorchRL 0.14.1 re-draws copies
    uniformly between the smallest and the largest weight, which is another
    distribution than the one the layers were initialised from.

    Args:
        observation_dim: size of the observation, ``S``.
        action_dim: size of the action, ``A``.
        num_qvalue_nets: number of critics, ``N``.
        num_cells: width of each hidden layer.
        activation_class: activation between the layers.
        layer_norm: normalise each hidden layer before its activation, which bounds
            the values of actions far from the data ("Efficient Online Reinforcement
            Learning with Offline Data", https://arxiv.org/abs/2302.02948). Not in the
            paper; default ``False``.
        observation_key, action_key: the entries they read. Default ``"observation"``
            and ``"action"``.

    Returns:
        ``N`` modules that write ``"state_action_value"``, ``[B, 1]``.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> batch = {"observation": torch.zeros(4, 11), "action": torch.zeros(4, 3)}
        >>> critic, _ = critic_ensemble(11, 3, num_cells=[32])
        >>> critic(TensorDict(batch, [4]))["state_action_value"].shape
        torch.Size([4, 1])
    """
    norm = layer_norm_options(num_cells) if layer_norm else {}
    return [
        ValueOperator(
            MLP(
                in_features=observation_dim + action_dim,
                out_features=1,
                num_cells=list(num_cells),
                activation_class=activation_class,
                **norm,
            ),
            in_keys=[observation_key, action_key],
            # ValueOperator knows an action by the name "action" alone.
            out_keys=["state_action_value"],
        )
        for _ in range(num_qvalue_nets)
    ]


def state_value(
    observation_dim: int,
    *,
    num_cells: Sequence[int] = (256, 256),
    activation_class: type[nn.Module] = nn.ReLU,
    layer_norm: bool = False,
    observation_key: NestedKey = "observation",
) -> ValueOperator:
    """Return a value network of one observation, without an action.

    Args:
        observation_dim: size of the observation, ``S``.
        num_cells: width of each hidden layer.
        activation_class: activation between the layers.
        layer_norm: as in :func:`critic_ensemble`. Default ``False``.
        observation_key: the state it reads. Default ``"observation"``.

    Returns:
        A module that writes ``"state_value"``, ``[B, 1]``.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> value, batch = state_value(11), {"observation": torch.zeros(4, 11)}
        >>> value(TensorDict(batch, [4]))["state_value"].shape
        torch.Size([4, 1])
    """
    network = MLP(
        in_features=observation_dim,
        out_features=1,
        num_cells=list(num_cells),
        activation_class=activation_class,
        **(layer_norm_options(num_cells) if layer_norm else {}),
    )
    return ValueOperator(network, in_keys=[observation_key])


def layer_norm_options(num_cells: Sequence[int]) -> dict[str, Any]:
    """Options of :class:`~torchrl.modules.MLP` that normalise each hidden layer."""
    widths = [{"normalized_shape": width} for width in num_cells]
    return {"norm_class": nn.LayerNorm, "norm_kwargs": widths}
