"""One call of a loss for several members: their tensors stacked, their noise apart.

Shapes: ``K`` members, ``B`` batch.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import is_dataclass
from enum import Enum
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictParams
from torch import Tensor, nn
from torchrl.objectives import LossModule

from torchrl_osr.trainers.member_noise import MemberNoise


def _places(module: nn.Module) -> Iterator[tuple[dict[str, Any], str]]:
    """Yield the mappings that hold a module's tensors, and their keys."""
    for name, child in module._modules.items():
        if isinstance(child, TensorDictParams):
            yield module._modules, name
        elif child is not None:
            yield from _places(child)
    for holder in (module._parameters, module._buffers):
        for name, tensor in holder.items():
            if tensor is not None:
                yield holder, name


def _flat(value: Tensor | TensorDictParams) -> dict[Any, Tensor]:
    """Return a tensor, or those of a network, by key."""
    return {(): value} if isinstance(value, Tensor) else dict(value.items(True, True))


def _unflat(tensors: dict[Any, Tensor], like: Any) -> Any:
    """Return what :func:`_flat` made flat, of other tensors."""
    if isinstance(like, Tensor):
        return tensors[()]
    # Not TensorDictParams, which keep what was derived from them for the next call.
    return TensorDict(tensors, batch_size=like.batch_size)


@contextmanager
def _swapped(loss: LossModule, tensors: Sequence[dict[Any, Tensor]]) -> Iterator[None]:
    """Give a loss other tensors, and no chunks, which are a CPU's and of one run."""
    places = list(_places(loss))
    kept = [holder[name] for holder, name in places]
    chunk_size = getattr(loss, "chunk_size", None)
    try:
        for (holder, name), flat, like in zip(places, tensors, kept, strict=True):
            holder[name] = _unflat(flat, like)
        if chunk_size is not None:
            loss.chunk_size = None
        yield
    finally:
        for (holder, name), value in zip(places, kept, strict=True):
            holder[name] = value
        if chunk_size is not None:
            loss.chunk_size = chunk_size


def vectorized_loss(
    losses: Sequence[LossModule],
    batches: Sequence[TensorDictBase],
    generators: Sequence[torch.Generator],
) -> TensorDict:
    """Return the losses and metrics of all members, ``[K]``, from one call.

    The gradient of a member's losses reaches that member's own parameters. What a loss
    writes into its batch, a priority, is lost.

    Args:
        losses: the members', alike up to the values in their tensors
            (:func:`differences`).
        batches: one for each, ``[B]``.
        generators: in the place of torch's default one, one for each.

    Raises:
        ValueError: if the batches are of different sizes.
    """
    sizes = {batch.batch_size for batch in batches}
    if len(sizes) != 1:
        raise ValueError(
            f"members' batches must be of one size, got {[*map(tuple, sizes)]}."
        )
    held = [[_flat(holder[name]) for holder, name in _places(each)] for each in losses]
    tensors = [
        {key: torch.stack([each[key] for each in flats]) for key in flats[0]}
        for flats in zip(*held, strict=True)
    ]
    keys = list(batches[0].keys(True, True))
    rows = {key: torch.stack([batch.get(key) for batch in batches]) for key in keys}
    (size,) = sizes

    def one(
        member: Tensor, tensors: list[dict[Any, Tensor]], rows: dict[Any, Tensor]
    ) -> dict[str, Tensor]:
        batch = TensorDict(rows, batch_size=size)
        with _swapped(losses[0], tensors), MemberNoise(member, generators):
            return dict(losses[0](batch).items())

    # On the device: under a CUDA graph nothing may come from the host.
    members = torch.arange(len(losses), device=rows[keys[0]].device)
    out = torch.vmap(one, randomness="error")(members, tensors, rows)
    return TensorDict(out, batch_size=[len(losses)])


def differences(first: LossModule, other: LossModule) -> list[str]:
    """Return in what two losses differ besides the values in their tensors."""
    here, there = _description(first), _description(other)
    return [
        f"{key}: {here.get(key)} and {there.get(key)}"
        for key in here | there
        if here.get(key) != there.get(key)
    ]


def _description(loss: LossModule) -> dict[str, Any]:
    """Return all that members must have in common; first what tells most."""
    description: dict[str, Any] = {"class": type(loss).__name__}
    networks: dict[str, Any] = {}
    plain = (bool, int, float, str, tuple, Enum, type(None))
    for prefix, module in loss.named_modules():
        for name, value in vars(module).items():
            if name.startswith("_"):
                continue
            key = f"{prefix}.{name}" if prefix else name
            if isinstance(value, plain) or is_dataclass(value):
                description[key] = value
            elif isinstance(value, nn.Module):
                # A network that TorchRL keeps apart from its parameters.
                networks |= _layers(key, value)
    for name, value in loss.state_dict().items():
        if isinstance(value, Tensor):
            description[name] = f"{tuple(value.shape)} {value.dtype} {value.device}"
    keys = getattr(loss, "tensor_keys", None)
    return description | {"tensor_keys": keys} | networks


def _layers(prefix: str, network: nn.Module) -> dict[str, Any]:
    """Return a network's layers and the options of its distributions, by name."""
    layers: dict[str, Any] = {}
    for name, module in network.named_modules():
        key = f"{prefix}.{name}" if name else prefix
        if not any(module.children()):
            layers[key] = str(module)
        for option, value in getattr(module, "distribution_kwargs", {}).items():
            text = value.tolist() if isinstance(value, Tensor) else value
            layers[f"{key}.{option}"] = text
    return layers
