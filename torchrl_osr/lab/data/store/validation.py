"""What a transition data set is, and the check that every one passes before training.

The check exists because a broken data set does not crash a training run, it only spoils
it. TorchRL 0.11 to 0.14.1, for instance, returns Minari sets whose fields are all zero.

Shapes: ``N`` transitions, ``S`` observation, ``A`` action.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from numpy.typing import NDArray
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor

VECTOR_KEYS: tuple[NestedKey, ...] = ("observation", ("next", "observation"), "action")
FLAG_KEYS: tuple[NestedKey, ...] = tuple(
    ("next", name) for name in ("done", "terminated", "truncated")
)
REWARD_KEY: NestedKey = ("next", "reward")
DATASET_KEYS: tuple[NestedKey, ...] = (*VECTOR_KEYS, REWARD_KEY, *FLAG_KEYS)
"""Keys that every transition data set of this package has."""

# A tanh-Gaussian density is needed at the data's actions, and atanh(1) is infinite;
# float32 tanh reaches exactly 1. At 0.999 the pre-tanh action is 3.8.
ACTION_LIMIT = 0.999


def as_transitions(columns: Mapping[str, NDArray[Any]]) -> TensorDict:
    """Transitions ``[N]`` of arrays, which are not copied.

    Args:
        columns: ``observation`` and ``next_observation`` ``[N, S]``, ``action``
            ``[N, A]``, ``reward``, ``terminated`` and ``truncated`` ``[N]`` or
            ``[N, 1]``.
    """
    size = [len(columns["reward"])]
    tensors = {name: torch.from_numpy(array) for name, array in columns.items()}
    reward, terminated, truncated = (
        tensors[name].reshape(*size, 1)
        for name in ("reward", "terminated", "truncated")
    )
    after = {
        "observation": tensors["next_observation"],
        "reward": reward,
        "done": terminated | truncated,
        "terminated": terminated,
        "truncated": truncated,
    }
    return TensorDict(
        {
            "observation": tensors["observation"],
            "action": tensors["action"],
            "next": TensorDict(after, size),
        },
        size,
    )


def check_dataset(data: TensorDictBase) -> None:
    """Raise if a flat transition data set cannot be trained on.

    Args:
        data: transitions ``[N]`` with ``observation`` ``[N, S]``, ``action``
            ``[N, A]`` and, under ``next``, ``observation`` ``[N, S]``, ``reward``
            ``[N, 1]``, and boolean ``done``, ``terminated``, ``truncated``
            ``[N, 1]``.

    Raises:
        ValueError: a key is missing, has the wrong shape or type, holds a NaN or an
            infinity, or an observation, next observation or action is zero
            everywhere. The message names the key, what came and what was expected.
    """
    check_rows(data)
    check_filled(filled_keys(data), len(data))


def check_rows(data: TensorDictBase) -> None:
    """Raise if rows cannot be those of a data set, see :func:`check_dataset`.

    In a few rows of a data set, a field may well be zero.
    """
    _check_keys(data)
    _check_shapes(data)
    for key in (*VECTOR_KEYS, REWARD_KEY):
        _check_finite(key, data.get(key))
    terminated, truncated = data["next", "terminated"], data["next", "truncated"]
    wrong = int((data["next", "done"] != (terminated | truncated)).sum())
    if wrong:
        raise ValueError(
            f"('next', 'done') differs from terminated | truncated in {wrong} rows."
        )


def filled_keys(data: TensorDictBase) -> set[NestedKey]:
    """Those of ``VECTOR_KEYS`` that are not zero in all rows."""
    return {key for key in VECTOR_KEYS if bool((data.get(key) != 0).any())}


def check_filled(filled: set[NestedKey], rows: int) -> None:
    """Raise if one of ``VECTOR_KEYS`` is not among those that are somewhere filled."""
    for key in VECTOR_KEYS:
        if key not in filled:
            raise ValueError(
                f"{key!r} is zero in all {rows} rows; expected real data. "
                "TorchRL 0.11 to 0.14.1 is known to do this to Minari sets "
                "(MinariExperienceReplay)."
            )


def _check_keys(data: TensorDictBase) -> None:
    present = set(data.keys(include_nested=True, leaves_only=True))
    missing = [repr(key) for key in DATASET_KEYS if key not in present]
    if missing:
        raise ValueError(
            f"the data set lacks {', '.join(missing)}; "
            f"it has {', '.join(sorted(map(repr, present)))}."
        )


def _check_shapes(data: TensorDictBase) -> None:
    if data.ndim != 1 or data.shape[0] == 0:
        raise ValueError(
            f"the data set has batch size {list(data.shape)}; "
            "expected a flat [N] with at least one row."
        )
    rows = data.shape[0]
    for key in VECTOR_KEYS:
        if data.get(key).ndim != 2:
            raise ValueError(
                f"{key!r} has shape {list(data.get(key).shape)}; expected [{rows}, D]."
            )
    size = data["observation"].shape[-1]
    expected: dict[NestedKey, list[int]] = {("next", "observation"): [rows, size]}
    expected |= {key: [rows, 1] for key in (REWARD_KEY, *FLAG_KEYS)}
    for key, shape in expected.items():
        if list(data.get(key).shape) != shape:
            raise ValueError(
                f"{key!r} has shape {list(data.get(key).shape)}; expected {shape}."
            )
    for key in FLAG_KEYS:
        if data.get(key).dtype != torch.bool:
            raise ValueError(
                f"{key!r} has type {data.get(key).dtype}; expected torch.bool."
            )


def _check_finite(key: NestedKey, values: Tensor) -> None:
    bad_rows = int((~torch.isfinite(values)).any(dim=-1).sum())
    if bad_rows:
        raise ValueError(
            f"{key!r} holds NaN or infinity in {bad_rows} of {len(values)} rows; "
            "expected finite numbers."
        )
