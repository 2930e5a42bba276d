"""Critics: ensembles of Q networks, and a value network of states alone."""

from __future__ import annotations

from typing import Any

from tensordict import NestedKey
from tensordict.nn import TensorDictModule
from torchrl.modules import ValueOperator

from torchrl_osr.modules.actor import mlp


def critic_ensemble(
    observation_dim: int,
    action_dim: int,
    *,
    num_qvalue_nets: int = 2,
    observation_key: NestedKey = "observation",
    action_key: NestedKey = "action",
    **layers: Any,
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
    return [
        ValueOperator(
            mlp(observation_dim + action_dim, 1, **layers),
            in_keys=[observation_key, action_key],
            # ValueOperator knows an action by the name "action" alone.
            out_keys=["state_action_value"],
        )
        for _ in range(num_qvalue_nets)
    ]


def discrete_critic_ensemble(
    observation_dim: int,
    num_actions: int,
    *,
    num_qvalue_nets: int = 2,
    observation_key: NestedKey = "observation",
    **layers: Any,
) -> list[TensorDictModule]:
    """Return Q networks that value all ``n`` discrete actions of a state at once.

    As :func:`critic_ensemble`; each writes ``"action_value"``, ``[B, n]``.
    """
    networks = (
        mlp(observation_dim, num_actions, **layers) for _ in range(num_qvalue_nets)
    )
    return [TensorDictModule(n, [observation_key], ["action_value"]) for n in networks]


def state_value(
    observation_dim: int,
    *,
    observation_key: NestedKey = "observation",
    **layers: Any,
) -> ValueOperator:
    """Return a value network of one observation, without an action.

    Arguments as of :func:`critic_ensemble`; it writes ``"state_value"``, ``[B, 1]``.
    """
    network = mlp(observation_dim, 1, **layers)
    return ValueOperator(network, in_keys=[observation_key])
