"""Transition data sets: their keys and their check."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from numpy.typing import NDArray
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor

from torchrl_osr._entries import column, entry

VECTOR_KEYS: tuple[NestedKey, ...] = ("observation", ("next", "observation"), "action")
FLAG_KEYS: tuple[NestedKey, ...] = tuple(
    ("next", name) for name in ("done", "terminated", "truncated")
)
DATASET_KEYS: tuple[NestedKey, ...] = (*VECTOR_KEYS, ("next", "reward"), *FLAG_KEYS)
"""Keys that every transition data set of this package has."""

# A tanh-Gaussian density is needed at the data's actions, and atanh(1) is infinite;
# float32 tanh reaches exactly 1. At 0.999 the pre-tanh action is 3.8.
ACTION_LIMIT = 0.999

# Two recordings of one state may differ by rounding, relative to its entries.
SAME_STATE = 1e-6

Array = NDArray[Any]


def as_transitions(columns: Mapping[str, Array]) -> TensorDict:
    """Return transitions ``[N]`` from arrays by name, which are not copied."""
    tensors = {name: torch.from_numpy(array) for name, array in columns.items()}
    after = {n: tensors[n][:, None] for n in ("reward", "terminated", "truncated")}
    after["done"] = after["terminated"] | after["truncated"]
    after["observation"] = tensors["next_observation"]
    rows = {name: tensors[name] for name in ("observation", "action")}
    return TensorDict(rows | {"next": after}, [len(columns["reward"])])


def has_next_state(data: TensorDictBase) -> Tensor:
    """Return which of the transitions ``[B]`` have a next state, bool ``[B]``.

    Readers repeat the state where a recording lacks the next one of a terminated row.
    """
    same = (entry(data, ("next", "observation")) == entry(data, "observation")).all(-1)
    return ~(same & column(data, ("next", "terminated")).bool())


def check_dataset(data: TensorDictBase) -> None:
    """Raise unless ``data``, transitions ``[N]``, can be trained on.

    Keys, shapes, types and flags must be right, all numbers finite, and observations,
    next observations and actions not zero everywhere.
    """
    rows = len(data) if data.ndim == 1 else 0
    for key in DATASET_KEYS:
        values = data[key]
        size = data["action" if key == "action" else "observation"].shape[-1]
        shape = [rows, size if key in VECTOR_KEYS else 1]
        dtype = torch.bool if key in FLAG_KEYS else torch.float32
        if not rows or [*values.shape] != shape or values.dtype != dtype:
            raise ValueError(
                f"{key!r} has shape {[*values.shape]} and type {values.dtype}; "
                f"expected {shape} and {dtype}, in a flat set with at least one row."
            )
        extremes = torch.stack(values.aminmax())  # without a copy of the column
        if not extremes.isfinite().all():
            raise ValueError(f"{key!r} holds NaN or infinity.")
        if key in VECTOR_KEYS and not extremes.any():
            # TorchRL 0.11 to 0.14.1 does this to Minari sets.
            raise ValueError(f"{key!r} is zero in all {rows} rows.")
    done, *ends = (data[key] for key in FLAG_KEYS)
    if wrong := int((done != (ends[0] | ends[1])).sum()):
        raise ValueError(f"done differs from terminated | truncated in {wrong} rows.")
