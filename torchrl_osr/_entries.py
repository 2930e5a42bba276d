"""Entries of a batch: their names, and errors that name them.

Shapes: ``B`` batch (any leading dimensions).
"""

from __future__ import annotations

from collections.abc import Iterable

from tensordict import NestedKey, TensorDictBase, unravel_key
from torch import Tensor


def nested(prefix: NestedKey, key: NestedKey) -> NestedKey:
    """Return ``key`` below ``prefix``: ``("next", "observation")``, for instance."""
    return unravel_key((prefix, key))


def is_next(key: NestedKey) -> bool:
    """Return whether ``key`` lies below ``"next"``."""
    return isinstance(key, tuple) and key[0] == "next"


def state_keys(in_keys: Iterable[NestedKey], *exclude: NestedKey) -> list[NestedKey]:
    """Return the current-state entries of ``in_keys``, once each and in order."""
    keys = dict.fromkeys(unravel_key(key) for key in in_keys)
    return [key for key in keys if not is_next(key) and key not in exclude]


def entry(tensordict: TensorDictBase, key: NestedKey) -> Tensor:
    """Return a required entry; a KeyError names it and the existing ones."""
    value: Tensor | TensorDictBase | None = tensordict.get(key, None)
    if value is None:
        there = sorted(map(str, tensordict.keys(True, True)))
        raise KeyError(f"The batch has no entry {key!r}; it has {there}.")
    if isinstance(value, TensorDictBase):
        each = unravel_key((key, next(iter(value.keys(True, True)), "name")))
        raise ValueError(f"{key!r} is a group, no tensor. Name a key in it: [{each}].")
    return value


def column(tensordict: TensorDictBase, key: NestedKey) -> Tensor:
    """Return an entry with one number a row, ``[B, 1]``, as ``[B]``."""
    value = entry(tensordict, key)
    expected = (*tensordict.batch_size, 1)
    if value.shape != expected:
        raise ValueError(
            f"{key!r} has shape {tuple(value.shape)}, expected {expected}: the batch "
            "size and a last dimension of 1."
        )
    return value.squeeze(-1)
