"""A policy that copies the networks of a loss."""

from __future__ import annotations

from collections.abc import Mapping
from copy import deepcopy
from importlib.metadata import version
from typing import Any

import torch
from numpy.typing import ArrayLike
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl.envs import ObservationNorm
from torchrl.modules import MLP
from torchrl.objectives import LossModule

from torchrl_osr.objectives.networks import distribution, head_of, written_entry
from torchrl_osr.policy.policy import DISTRIBUTIONS, Policy

PACKAGES = ("torchrl-osr", "torch", "torchrl", "tensordict")


def policy_from_loss(
    loss: LossModule,
    observation_norm: ObservationNorm | None = None,
    *,
    low: ArrayLike = -1.0,
    high: ArrayLike = 1.0,
    source: Mapping[str, Any] | None = None,
) -> Policy:
    """Copy actor and critics of a loss into a policy.

    Args:
        loss: with networks as :mod:`torchrl_osr.modules` builds them: one
            :class:`~torchrl.modules.MLP` each, actions in [-1, 1] or one-hot. Of a
            Gaussian actor the mean is taken alone.
        observation_norm: how the training data were standardised
            (``standard_normal=True``). Default: not at all.

    Keyword Args:
        low, high: bounds of the environment's actions, which the networks' -1 and 1
            stand for; a number or ``[A]``. Default -1 and 1.
        source: JSON-compatible, kept in ``policy.record["source"]``. Default: the name
            of the loss's class.

    Raises:
        ValueError: the networks are of another kind, or the bounds are no interval.

    Examples:
        >>> import numpy as np
        >>> from torchrl_osr import CQLLoss
        >>> from torchrl_osr.modules import critic_ensemble, tanh_gaussian_actor
        >>> loss = CQLLoss(tanh_gaussian_actor(3, 1), critic_ensemble(3, 1))
        >>> policy = policy_from_loss(loss, low=-2.0, high=2.0)
        >>> policy.act(np.zeros((4, 3))).shape, policy.value(np.zeros((4, 3))).shape
        ((4, 1), (4,))
    """
    network = loss.actor_network
    kind = getattr(head_of(network)[0], "__name__", "")
    # A policy acts by the mean of a Gaussian actor, which ends in a tanh.
    head = {"IndependentNormal": "TanhDelta"}.get(kind, kind)
    if head not in DISTRIBUTIONS:
        raise ValueError(
            f"the actor of a policy ends in one of {DISTRIBUTIONS}, as those of "
            f"torchrl_osr.modules; this one has {kind or 'no distribution'}."
        )
    if observation_norm is not None and not observation_norm.standard_normal:
        raise ValueError(
            "a policy standardises as ObservationNorm(standard_normal=True) does, "
            "(observation - loc) / scale; this transform is the other way round."
        )
    actor, prefix = _mlp(network)
    inputs, size = actor.in_features, actor.out_features
    if head == "TanhNormal":
        size //= 2
    tensors = _weights(loss.actor_network_params, prefix, "actor")
    critics = {"number": 0} | _sizes(actor)
    if hasattr(loss, "qvalue_network"):
        critic, prefix = _mlp(loss.qvalue_network)
        each = loss.qvalue_network_params.unbind(0)
        critics = {"number": len(each)} | _sizes(critic)
        for number, params in enumerate(each):
            tensors |= _weights(params, prefix, f"critics.{number}")
    loc = getattr(observation_norm, "loc", 0.0)
    scale = getattr(observation_norm, "scale", 1.0)
    bounded = 0 if head == "OneHotCategorical" else size
    record = {
        "distribution": head,
        "observation_size": inputs,
        "action_size": size,
        "actor": _sizes(actor),
        "critics": critics,
        "source": {"loss": type(loss).__name__} | dict(source or {}),
        "versions": {name.replace("-", "_"): version(name) for name in PACKAGES},
    }
    try:
        for name, x in {"loc": loc, "scale": scale, "low": low, "high": high}.items():
            length = bounded if name in ("low", "high") else inputs
            tensors[name] = torch.as_tensor(x).cpu().float().expand(length).clone()
        policy = Policy(record, tensors)
        _check_same(policy, loss)
    except (KeyError, RuntimeError, TypeError) as error:  # names, sizes, activations
        raise ValueError(
            "a network has layers that no policy has, or norm or bounds have another "
            f"length: {error}"
        ) from error
    width = policy.high - policy.low
    if not (width > 0).all() or width.isinf().any():
        raise ValueError(f"low={low!r} must be below high={high!r}, and both finite.")
    return policy


def _mlp(network: nn.Module) -> tuple[MLP, str]:
    """Return the only MLP in a network, and how its parameters' names begin."""
    modules = network.named_modules()
    found = [(each, f"{name}.") for name, each in modules if isinstance(each, MLP)]
    if len(found) != 1:
        raise ValueError(
            "a network of a policy has one torchrl.modules.MLP, as those of "
            f"torchrl_osr.modules; this one has {len(found)}."
        )
    return found[0]


def _sizes(mlp: MLP) -> dict[str, Any]:
    return {
        "num_cells": list(mlp.num_cells),
        "activation": getattr(mlp.activation_class, "__name__", ""),
        "layer_norm": mlp.norm_class is nn.LayerNorm,
    }


def _weights(params: TensorDict, prefix: str, name: str) -> dict[str, Tensor]:
    return {
        f"{name}.{key.removeprefix(prefix)}": value.cpu().float().clone()
        for key, value in params.detach().flatten_keys(".").items()
        if key.startswith(prefix)
    }


@torch.no_grad()
def _check_same(policy: Policy, loss: LossModule) -> None:
    """Raise unless the copies compute what the networks do.

    Anything around an MLP would be left out: other layers and other bounds.
    """
    place = next(loss.parameters()).device
    # A GPU may round float32 to ten bits (TF32); Apple's have no float64.
    dtype = torch.float32 if place.type == "mps" else torch.float64
    policy, generator = deepcopy(policy).to(dtype), torch.Generator().manual_seed(0)
    rows = policy.loc.repeat(16, 1).normal_(generator=generator)
    rows *= torch.logspace(0, 1.5, 16).to(rows).unsqueeze(1)  # some beyond a clip
    states = TensorDict({}, [len(rows)], device=place)
    states.set(loss.actor_network.in_keys[0], rows.to(place))
    params = loss.actor_network_params.detach().to(dtype)
    theirs = distribution(loss.actor_network, params, states)
    raw = policy.actor(rows)
    pairs = [(policy.mode(raw), theirs.deterministic_sample)]
    if policy.discrete:
        pairs = [(raw.softmax(-1), theirs.probs)]
    states.set(loss.tensor_keys.action, theirs.deterministic_sample)
    given = (rows,) if policy.discrete else (rows, policy.mode(raw))
    for number, critic in enumerate(policy.critics):
        network = loss.qvalue_network
        params = loss.qvalue_network_params[number].detach().to(dtype)
        value = written_entry(network, params, states, network.out_keys[-1])
        pairs.append((critic(*given), value))
    for ours, wanted in pairs:
        if not torch.allclose(ours, wanted.cpu().to(dtype), rtol=1e-4, atol=1e-5):
            raise ValueError(
                f"the networks of this {type(loss).__name__} compute something else "
                "than their MLPs and a distribution with bounds -1 and 1. Build them "
                "with low=-1 and high=1, train on actions of that range, and give the "
                "environment's bounds here."
            )
