"""How far a policy is from the data's actions, for every kind of policy.

Shapes: ``B`` batch (any leading dimensions), ``A`` action, ``D`` sets of states.
"""

from __future__ import annotations

from typing import Any

from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictParams
from torch import Tensor
from torchrl.modules import TanhDelta

from torchrl_osr import functional
from torchrl_osr.objectives.distributions import check_action, head_of
from torchrl_osr.objectives.step import distribution, written_action


def is_deterministic(network: TensorDictModuleBase) -> bool:
    """Whether an actor has no density: it ends in a delta, or writes the action."""
    return head_of(network)[0] in (None, TanhDelta)


def policy_at(
    network: TensorDictModuleBase,
    params: TensorDictParams,
    states: TensorDictBase,
    key: NestedKey,
) -> Any:
    """An actor's distribution, or the action that it writes where it has none.

    Args:
        network: the actor.
        params: its parameters.
        states: what it reads, ``[D, B]``.
        key: of the action.

    Raises:
        KeyError: if it writes no such action.
    """
    if head_of(network)[0] is not None:
        return distribution(network, params, states)
    return written_action(network, params, states, key)


def cloning_distance(policy: Any, data_action: Tensor, key: NestedKey) -> Tensor:
    r"""What behaviour cloning minimises, ``[D, B]``.

    :math:`-\log\pi(a \mid s)`; for a policy without a density the squared distance
    :math:`\|\pi(s) - a\|^2`.

    Args:
        policy: what :func:`policy_at` returns.
        data_action: ``[B, A]``.
        key: what to call the data's action in an error.

    Raises:
        ValueError: if the actions are of another size than the policy's.
    """
    density = not isinstance(policy, (Tensor, TanhDelta))
    action = policy if isinstance(policy, Tensor) else policy.deterministic_sample
    check_action(data_action, action.shape[-1], key)
    if not density:
        return functional.action_distance(action, data_action)
    log_prob: Tensor = policy.log_prob(data_action.expand_as(action))
    return -log_prob
