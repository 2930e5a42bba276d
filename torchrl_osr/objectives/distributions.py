"""What the losses must know of a network's distribution before they trust it."""

from __future__ import annotations

import torch
from tensordict import NestedKey
from tensordict.nn import ProbabilisticTensorDictModule, TensorDictModuleBase
from torch import Tensor
from torchrl.modules import TanhNormal


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
    heads = [
        module
        for module in network.modules()
        if isinstance(module, ProbabilisticTensorDictModule)
    ]
    distribution = heads[-1].distribution_class if heads else None
    if not (isinstance(distribution, type) and issubclass(distribution, TanhNormal)):
        raise TypeError(
            f"{name} must end in a TanhNormal distribution, got "
            f"{getattr(distribution, '__name__', distribution)}: the recovery term is "
            "the divergence of two tanh-Gaussians. torchrl_osr.modules builds such "
            "networks."
        )
    kwargs = heads[-1].distribution_kwargs
    default = torch.get_default_dtype()
    low = torch.as_tensor(kwargs.get("low", -1.0), dtype=default)
    high = torch.as_tensor(kwargs.get("high", 1.0), dtype=default)
    return low, high


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
