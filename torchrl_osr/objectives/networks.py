"""Evaluate the networks of a loss, and check their distributions.

Shapes: ``R`` rows, ``A`` action.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import (
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModuleBase,
    TensorDictParams,
)
from torch import Tensor, nn
from torch.distributions import Categorical
from torch.distributions import OneHotCategorical as TorchOneHotCategorical
from torchrl.modules import (
    MaskedOneHotCategorical,
    OneHotCategorical,
    TanhDelta,
    TanhModule,
    TanhNormal,
)

ONE_HOT = (OneHotCategorical, MaskedOneHotCategorical, TorchOneHotCategorical)
"""Distributions whose actions are one-hot vectors."""

CATEGORICAL = (Categorical, *ONE_HOT)
"""Distributions over finitely many actions; those not in ``ONE_HOT`` are of indices."""


def head_of(network: TensorDictModuleBase) -> tuple[Any, dict[str, Any]]:
    """Return the class of a network's distribution, or ``None``, and its options."""
    kind = ProbabilisticTensorDictModule
    heads = [each for each in network.modules() if isinstance(each, kind)]
    if not heads:
        return None, {}
    return heads[-1].distribution_class, heads[-1].distribution_kwargs


def is_categorical(network: TensorDictModuleBase) -> bool:
    """Return whether a network chooses among finitely many actions."""
    head, _ = head_of(network)
    return isinstance(head, type) and issubclass(head, CATEGORICAL)


def squashing_bounds(network: TensorDictModuleBase) -> tuple[Tensor, ...]:
    """Return ``low`` and ``high`` of a network that ends in a tanh, or nothing."""
    head, options = head_of(network)
    tanh = [each for each in network.modules() if isinstance(each, TanhModule)]
    if head is None and tanh:
        options = dict(zip(("low", "high"), tanh[-1].buffers(), strict=False))
    elif head not in (TanhNormal, TanhDelta):
        return ()
    device, dtype = next(network.parameters()).device, torch.get_default_dtype()
    low = torch.as_tensor(options.get("low", -1.0), dtype=dtype, device=device)
    return low, torch.as_tensor(options.get("high", 1.0), dtype=dtype, device=device)


def action_bounds(network: TensorDictModuleBase, name: str) -> tuple[Tensor, ...]:
    """Return the bounds of a tanh-Gaussian; a TypeError names other networks."""
    head, _ = head_of(network)
    if head is not TanhNormal:
        cure = "torchrl_osr.modules builds such networks."
        if is_categorical(network):
            cure = "For discrete actions use DiscreteOSRLoss."
        raise TypeError(
            f"{name} must end in a TanhNormal distribution, got "
            f"{getattr(head, '__name__', head)}. {cure}"
        )
    return squashing_bounds(network)


def check_same_bounds(policy: Sequence[Tensor], model: Sequence[Tensor]) -> None:
    """Raise a ValueError unless policy and model squash to the same interval.

    The pre-tanh divergence is that of the actions only for one and the same bijection.
    """
    pairs = zip(policy, model, strict=True)
    if not all(bool((a.cpu() == b.cpu()).all()) for a, b in pairs):
        ours, theirs = ([bound.tolist() for bound in each] for each in (policy, model))
        raise ValueError(
            "actor_network and inverse_dynamics_network must share their action "
            f"bounds: the actor has {ours}, the inverse dynamics model {theirs}. Pass "
            "the same low= and high= to both."
        )


def check_action(action: Tensor, shape: torch.Size, key: NestedKey) -> None:
    """Raise a ValueError unless a batch's actions have the shape of the network's."""
    if action.shape != shape:
        raise ValueError(
            f"{key!r} has shape {tuple(action.shape)}, but the network's actions have "
            f"{tuple(shape)}."
        )


def check_num_actions(name: str, actions: Tensor, policy: Tensor) -> None:
    """Raise a ValueError unless a network's actions have the policy's size."""
    number, wanted = actions.shape[-1], policy.shape[-1]
    if number != wanted:
        raise ValueError(
            f"{name} has {number} actions, but actor_network has {wanted}: build both "
            "with the same number (of action dimensions, if actions are continuous)."
        )


def check_networks(**networks: nn.Module | Sequence[nn.Module] | None) -> None:
    """Raise a ValueError unless networks can be held by one loss.

    Each needs parameters of its own: TorchRL 0.14.1 keeps what critics share as an
    expanded tensor that ``.to()`` and ``copy.deepcopy`` cut off from its source. The
    critics of a list must be alike: the first one's ``forward`` computes all.
    """
    owners: dict[Tensor, str] = {}
    for name, network in networks.items():
        modules = list(network) if isinstance(network, Sequence) else [network]
        kinds = set()
        for module in (each for each in modules if each is not None):
            parameters = tuple(module.parameters())
            for parameter in parameters:
                if parameter in owners:
                    raise ValueError(
                        f"{owners[parameter]} and {name} share a parameter of shape "
                        f"{tuple(parameter.shape)}: give each network, and each critic "
                        "of a list, parameters of its own (copy.deepcopy the encoder)."
                    )
            owners |= dict.fromkeys(parameters, name)
            kinds.add((repr(module), tuple(each.requires_grad for each in parameters)))
        if len(kinds) > 1:
            raise ValueError(
                f"the networks of {name} differ in layers or frozen parameters, and "
                "all are computed by the first one's: build them alike."
            )


def distribution_params(
    network: ProbabilisticTensorDictSequential,
    params: TensorDictParams,
    states: TensorDictBase,
) -> TensorDictBase:
    """Return the parameters of a network's distribution at states ``[..., R]``."""
    with params.to_module(network, preserve_module_state=False):
        output = full_precision(network.get_dist_params(states.copy().reshape(-1)))
    return output.reshape(states.batch_size)


def distribution(
    network: ProbabilisticTensorDictSequential,
    params: TensorDictParams,
    states: TensorDictBase,
) -> Any:
    """Return a network's distribution at states ``[..., R]``."""
    return network.build_dist_from_params(distribution_params(network, params, states))


def written_entry(
    network: TensorDictModuleBase,
    params: TensorDictParams,
    states: TensorDictBase,
    key: NestedKey,
) -> Tensor:
    """Return what a deterministic network writes, ``[..., R, A]``."""
    with params.to_module(network, preserve_module_state=False):
        output = full_precision(network(states.copy().reshape(-1)))
    value: Tensor | None = output.get(key, None)
    if value is None:
        raise KeyError(f"The network writes no {key!r}: call set_keys().")
    return value.reshape(*states.batch_size, *value.shape[1:])


def full_precision(output: TensorDictBase) -> TensorDictBase:
    """Return what layers wrote in half precision, under autocast, as float32.

    Densities, divergences and log-sum-exps are differences of large numbers.
    """
    if not (torch.is_autocast_enabled("cpu") or torch.is_autocast_enabled("cuda")):
        return output
    half = (torch.bfloat16, torch.float16)
    return output.apply(lambda value: value.float() if value.dtype in half else value)
