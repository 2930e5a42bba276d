"""What the losses must know of a network's distribution before they trust it.

Shapes: ``B`` batch (any leading dimensions), ``A`` action, ``n`` number of discrete
actions.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import NestedKey
from tensordict.nn import ProbabilisticTensorDictModule, TensorDictModuleBase
from torch import Tensor, nn
from torch.distributions import Categorical
from torch.distributions import OneHotCategorical as TorchOneHotCategorical
from torchrl.data import Bounded, Composite, TensorSpec
from torchrl.modules import (
    MaskedOneHotCategorical,
    OneHotCategorical,
    TanhNormal,
)

ONE_HOT = (OneHotCategorical, MaskedOneHotCategorical, TorchOneHotCategorical)
"""Distributions whose actions are one-hot vectors."""

CATEGORICAL = (Categorical, *ONE_HOT)
"""Distributions over finitely many actions; those not in ``ONE_HOT`` are of indices."""


def head_of(network: TensorDictModuleBase) -> tuple[Any, dict[str, Any]]:
    """Return the class of the distribution that a network ends in, and its options."""
    heads = [
        module
        for module in network.modules()
        if isinstance(module, ProbabilisticTensorDictModule)
    ]
    if not heads:
        return None, {}
    return heads[-1].distribution_class, heads[-1].distribution_kwargs


def _is_a(distribution: Any, *families: type) -> bool:
    return isinstance(distribution, type) and issubclass(distribution, families)


def action_bounds(network: TensorDictModuleBase, name: str) -> tuple[Tensor, Tensor]:
    """Return the bounds of a network's tanh-Gaussian, each a number or ``[A]``.

    Args:
        network: a probabilistic TorchRL module, such as
            :class:`~torchrl.modules.ProbabilisticActor`.
        name: what to call it in an error.

    Raises:
        TypeError: if the network's distribution is not a
            :class:`~torchrl.modules.TanhNormal`.
    """
    distribution, kwargs = head_of(network)
    if not _is_a(distribution, TanhNormal):
        cure = "torchrl_osr.modules builds such networks."
        if _is_a(distribution, *CATEGORICAL):
            cure = "For discrete actions use DiscreteOSRLoss."
        raise TypeError(
            f"{name} must end in a TanhNormal distribution, got "
            f"{getattr(distribution, '__name__', distribution)}: the recovery term is "
            f"the divergence of two tanh-Gaussians. {cure}"
        )
    return bounds_of(kwargs)


def bounds_of(kwargs: dict[str, Any]) -> tuple[Tensor, Tensor]:
    """Return the bounds among a squashing distribution's options, -1 and 1 by default.

    Args:
        kwargs: see :func:`head_of`; of a :class:`~torchrl.modules.TanhNormal` or a
            :class:`~torchrl.modules.TanhDelta`.
    """
    default = torch.get_default_dtype()
    low = torch.as_tensor(kwargs.get("low", -1.0), dtype=default)
    high = torch.as_tensor(kwargs.get("high", 1.0), dtype=default)
    return low, high


def is_categorical(network: TensorDictModuleBase) -> bool:
    """Whether a network chooses among finitely many actions."""
    return _is_a(head_of(network)[0], *CATEGORICAL)


def check_categorical(network: TensorDictModuleBase, name: str) -> None:
    """Raise unless a network chooses among finitely many actions.

    Args:
        network: a probabilistic TorchRL module.
        name: what to call it in an error.

    Raises:
        TypeError: if its distribution is not in :data:`CATEGORICAL`.
    """
    if not is_categorical(network):
        distribution, _ = head_of(network)
        cure = "torchrl_osr.modules builds such networks."
        if _is_a(distribution, TanhNormal):
            cure = "For continuous actions use OSRLoss."
        raise TypeError(
            f"{name} must end in a categorical distribution, such as "
            "torchrl.modules.OneHotCategorical or torch.distributions.Categorical, "
            f"got {getattr(distribution, '__name__', distribution)}. {cure}"
        )


def check_action(action: Tensor, action_dim: int, key: NestedKey) -> None:
    """Raise unless the batch's actions are of the network's size.

    Raises:
        ValueError: naming the entry and both sizes.
    """
    if action.shape[-1] != action_dim:
        raise ValueError(
            f"{key!r} has shape {tuple(action.shape)}, but the network's actions have "
            f"{action_dim} dimensions."
        )


def check_num_actions(name: str, number: int, policy: int) -> None:
    """Raise unless a network's actions are of the policy's size.

    The size is the number of actions, or of an action's dimensions. Broadcasting would
    compare a size of 1 with any other without a word.

    Raises:
        ValueError: naming the network and both numbers.
    """
    if number != policy:
        raise ValueError(
            f"{name} has {number} actions, but actor_network has {policy}: build both "
            "with the same number (of action dimensions, if actions are continuous)."
        )


def action_index(
    action: Tensor, distribution: Any, batch_size: torch.Size, key: NestedKey
) -> Tensor:
    """Return a batch's discrete actions as indices, int64 ``[B]``.

    Args:
        action: what the batch has: one-hot ``[B, n]`` of any type if ``distribution``
            is in :data:`ONE_HOT`, or else integer indices ``[B]`` or ``[B, 1]``.
        distribution: of the network that acts; its ``logits`` end in ``n``.
        batch_size: ``B``.
        key: what to call the entry in an error.

    Raises:
        ValueError: naming the entry, its shape and what was expected.
    """
    one_hot, index = (*batch_size, distribution.logits.shape[-1]), tuple(batch_size)
    if isinstance(distribution, ONE_HOT):
        fits, expected = action.shape == one_hot, f"one-hot actions {one_hot}"
    else:
        fits = action.shape in (index, (*index, 1)) and not action.is_floating_point()
        expected = f"integer indices {index} or {(*index, 1)}"
    if not fits:
        raise ValueError(
            f"{key!r} has shape {tuple(action.shape)} and type {action.dtype}; "
            f"expected {expected}, the actions of a {type(distribution).__name__}."
        )
    if isinstance(distribution, ONE_HOT):
        # In floating point: torch has no argmax of booleans.
        return action.to(distribution.logits.dtype).argmax(-1)
    return action.long().reshape(batch_size)


def check_same_bounds(
    policy: tuple[Tensor, Tensor], inverse_dynamics: tuple[Tensor, Tensor]
) -> None:
    """Raise unless policy and inverse dynamics model squash to the same interval.

    The pre-tanh divergence is the divergence of the actions only for one and the same
    bijection.

    Raises:
        ValueError: if the bounds differ.
    """
    same = all(
        bool((ours.cpu() == theirs.cpu()).all())
        for ours, theirs in zip(policy, inverse_dynamics, strict=True)
    )
    if not same:
        low, high = policy
        other_low, other_high = inverse_dynamics
        raise ValueError(
            "actor_network and inverse_dynamics_network must share their action "
            f"bounds: the actor has low={low.tolist()}, high={high.tolist()}, the "
            f"inverse dynamics model low={other_low.tolist()}, "
            f"high={other_high.tolist()}. Pass the same low= and high= to both."
        )


def check_action_spec(policy: tuple[Tensor, Tensor], action_spec: TensorSpec) -> None:
    """Raise unless an environment's actions have the policy's bounds.

    Args:
        policy: bounds of the policy's distribution.
        action_spec: of the environment; a :class:`~torchrl.data.Composite` must hold
            one entry.

    Raises:
        ValueError: naming both bounds, or saying that the spec has none.
    """
    spec = action_spec
    if isinstance(spec, Composite):
        leaves = list(spec.values(True, True))
        if len(leaves) != 1:
            raise ValueError(
                f"action_spec holds {len(leaves)} entries, expected the action alone: "
                "pass env.action_spec."
            )
        spec = leaves[0]
    if not isinstance(spec, Bounded):
        raise ValueError(
            f"action_spec must be a Bounded spec, as a TanhNormal needs, got {spec}."
        )
    for name, ours, theirs in zip(
        ("low", "high"), policy, (spec.space.low, spec.space.high), strict=True
    ):
        if not bool((ours == theirs.to(ours)).all()):
            raise ValueError(
                f"the actor's {name} is {ours.tolist()}, but that of action_spec is "
                f"{theirs.tolist()}: build actor and inverse dynamics model with "
                f"{name}=env.action_spec.space.{name}."
            )


def check_apart(**networks: nn.Module | Sequence[nn.Module] | None) -> None:
    """Raise unless every network has parameters of its own.

    TorchRL 0.14.1 keeps what critics share as an expanded tensor that ``.to()`` and
    ``copy.deepcopy`` cut off from its source without a word.

    Raises:
        ValueError: naming the two networks that share a parameter.
    """
    owners: dict[Tensor, str] = {}
    for name, network in networks.items():
        modules = network if isinstance(network, Sequence) else [network]
        for module in modules:
            parameters = () if module is None else tuple(module.parameters())
            for parameter in parameters:
                if parameter in owners:
                    raise ValueError(
                        f"{owners[parameter]} and {name} share a parameter of shape "
                        f"{tuple(parameter.shape)}: give each network, and each critic "
                        "of a list, parameters of its own (copy.deepcopy the encoder)."
                    )
            owners |= dict.fromkeys(parameters, name)
