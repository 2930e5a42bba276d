"""Networks for discrete actions: actor, critics and inverse dynamics model."""

from __future__ import annotations

from collections.abc import Sequence

from tensordict import NestedKey
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.modules import MLP, OneHotCategorical, ProbabilisticActor

from torchrl_osr._entries import nested
from torchrl_osr.modules.initial_weights import remember_weights


def categorical_actor(
    observation_dim: int,
    num_actions: int,
    *,
    num_cells: Sequence[int] = (256, 256),
    activation_class: type[nn.Module] = nn.ReLU,
    observation_key: NestedKey = "observation",
    action_key: NestedKey = "action",
) -> ProbabilisticActor:
    """Return an actor of one observation that chooses one of ``n`` actions.

    Its actions are one-hot, as :class:`~torchrl.envs.GymEnv` gives and takes them
    unless it was made with ``categorical_action_encoding=True``.

    Args:
        observation_dim: size of the observation, ``S``.
        num_actions: number of actions, ``n``.
        num_cells: width of each hidden layer.
        activation_class: activation between the layers.
        observation_key: the state it reads. Default ``"observation"``.
        action_key: the action it writes. Default ``"action"``.

    Returns:
        An actor that writes ``"logits"`` and the action, each ``[B, n]``, and
        ``"action_log_prob"``, ``[B]``.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> actor = categorical_actor(4, 2, num_cells=[32])
        >>> actor(TensorDict({"observation": torch.zeros(3, 4)}, [3]))["action"].shape
        torch.Size([3, 2])
    """
    network = MLP(
        in_features=observation_dim,
        out_features=num_actions,
        num_cells=list(num_cells),
        activation_class=activation_class,
    )
    logits = TensorDictModule(network, [observation_key], ["logits"])
    return _categorical(logits, action_key)


def categorical_inverse_dynamics(
    observation_dim: int,
    num_actions: int,
    *,
    num_cells: Sequence[int] = (256, 256),
    activation_class: type[nn.Module] = nn.ReLU,
    observation_key: NestedKey = "observation",
    action_key: NestedKey = "action",
) -> ProbabilisticActor:
    r"""Return a categorical model of :math:`I(a \mid s, s')`.

    Args:
        observation_dim: size of the observation, ``S``.
        num_actions: number of actions, ``n``.
        num_cells: width of each hidden layer.
        activation_class: activation between the layers.
        observation_key: the state it reads, and the next state below ``"next"``.
            Default ``"observation"``.
        action_key: the action it writes. Default ``"action"``.

    Returns:
        A module that reads ``"observation"`` and ``("next", "observation")`` and
        writes ``"logits"`` and one-hot ``"action"``, each ``[B, n]``, and
        ``"action_log_prob"``, ``[B]``.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> model = categorical_inverse_dynamics(4, 2, num_cells=[32])
        >>> s = torch.zeros(3, 4)
        >>> batch = TensorDict({"observation": s, "next": {"observation": s + 1}}, [3])
        >>> model.get_dist(batch).probs.shape
        torch.Size([3, 2])
    """
    network = MLP(
        in_features=2 * observation_dim,
        out_features=num_actions,
        num_cells=list(num_cells),
        activation_class=activation_class,
    )
    keys = [observation_key, nested("next", observation_key)]
    logits = TensorDictModule(network, keys, ["logits"])
    return remember_weights(_categorical(logits, action_key))


def _categorical(logits: TensorDictModule, action_key: NestedKey) -> ProbabilisticActor:
    return ProbabilisticActor(
        logits,
        in_keys=["logits"],
        out_keys=[action_key],
        distribution_class=OneHotCategorical,
        return_log_prob=True,
    )


def discrete_critic_ensemble(
    observation_dim: int,
    num_actions: int,
    *,
    num_qvalue_nets: int = 2,
    num_cells: Sequence[int] = (256, 256),
    activation_class: type[nn.Module] = nn.ReLU,
    observation_key: NestedKey = "observation",
) -> list[TensorDictModule]:
    """Return Q networks of one observation that value all actions at once.

    A list, for the reason that :func:`~torchrl_osr.modules.critic_ensemble` gives.

    Args:
        observation_dim: size of the observation, ``S``.
        num_actions: number of actions, ``n``.
        num_qvalue_nets: number of critics, ``N``.
        num_cells: width of each hidden layer.
        activation_class: activation between the layers.
        observation_key: the state they read. Default ``"observation"``.

    Returns:
        ``N`` modules that write ``"action_value"``, ``[B, n]``.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> critic, _ = discrete_critic_ensemble(4, 2, num_cells=[32])
        >>> batch = TensorDict({"observation": torch.zeros(3, 4)}, [3])
        >>> critic(batch)["action_value"].shape
        torch.Size([3, 2])
    """
    return [
        TensorDictModule(
            MLP(
                in_features=observation_dim,
                out_features=num_actions,
                num_cells=list(num_cells),
                activation_class=activation_class,
            ),
            [observation_key],
            ["action_value"],
        )
        for _ in range(num_qvalue_nets)
    ]
