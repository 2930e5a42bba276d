"""Critics: ensembles of Q networks, and a value network of states alone."""

from __future__ import annotations

from collections.abc import Sequence

from tensordict import NestedKey
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.modules import ValueOperator

from torchrl_osr.modules.actor import mlp


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

    They are a list, not one network that the loss copies: TorchRL 0.14.1 redraws copies
    uniformly between the smallest and the largest weight. That is not the distribution
    of the layers' initialisation.

    Each of the ``num_qvalue_nets`` writes ``"state_action_value"``, ``[B, 1]``. With
    ``layer_norm`` each hidden layer is normalised before its activation, which bounds
    the values of actions far from the data (https://arxiv.org/abs/2302.02948). Other
    arguments are those of :mod:`torchrl_osr.modules.actor`.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> batch = {"observation": torch.zeros(4, 11), "action": torch.zeros(4, 3)}
        >>> critic, _ = critic_ensemble(11, 3, num_cells=[32])
        >>> critic(TensorDict(batch, [4]))["state_action_value"].shape
        torch.Size([4, 1])
    """
    given = observation_dim + action_dim, 1, num_cells, activation_class
    networks = [mlp(*given, layer_norm=layer_norm) for _ in range(num_qvalue_nets)]
    # ValueOperator knows an action by the name "action" alone.
    keys = [observation_key, action_key], ["state_action_value"]
    return [ValueOperator(each, *keys) for each in networks]


def discrete_critic_ensemble(
    observation_dim: int,
    num_actions: int,
    *,
    num_qvalue_nets: int = 2,
    num_cells: Sequence[int] = (256, 256),
    activation_class: type[nn.Module] = nn.ReLU,
    observation_key: NestedKey = "observation",
    layer_norm: bool = False,
) -> list[TensorDictModule]:
    """Return Q networks that value all ``n`` discrete actions of a state at once.

    As :func:`critic_ensemble`; each writes ``"action_value"``, ``[B, n]``.
    """
    given = observation_dim, num_actions, num_cells, activation_class
    networks = [mlp(*given, layer_norm=layer_norm) for _ in range(num_qvalue_nets)]
    keys = [observation_key], ["action_value"]
    return [TensorDictModule(each, *keys) for each in networks]


def state_value(
    observation_dim: int,
    *,
    num_cells: Sequence[int] = (256, 256),
    activation_class: type[nn.Module] = nn.ReLU,
    layer_norm: bool = False,
    observation_key: NestedKey = "observation",
) -> ValueOperator:
    """Return a value network of one observation, without an action.

    Arguments as of :func:`critic_ensemble`; it writes ``"state_value"``, ``[B, 1]``.
    """
    value = mlp(observation_dim, 1, num_cells, activation_class, layer_norm=layer_norm)
    return ValueOperator(value, in_keys=[observation_key])
