"""A guard that every data set passes before training.

It exists because a broken data set does not crash a training run, it only spoils it.
TorchRL 0.11 to 0.14.1, for instance, returns Minari sets whose fields are all zero.
"""

from __future__ import annotations

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

VECTOR_KEYS: tuple[NestedKey, ...] = ("observation", ("next", "observation"), "action")
FLAG_KEYS: tuple[NestedKey, ...] = tuple(
    ("next", name) for name in ("done", "terminated", "truncated")
)
REWARD_KEY: NestedKey = ("next", "reward")
DATASET_KEYS: tuple[NestedKey, ...] = (*VECTOR_KEYS, REWARD_KEY, *FLAG_KEYS)
"""Keys that every transition data set of this package has."""


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

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_osr.data import check_dataset
        >>> data = TensorDict({"observation": torch.ones(5, 3)}, batch_size=[5])
        >>> check_dataset(data)
        Traceback (most recent call last):
            ...
        ValueError: the data set lacks ('next', 'observation'), 'action', ...
    """
    check_rows(data)
    for key in VECTOR_KEYS:
        if not bool((data.get(key) != 0).any()):
            raise zero_everywhere(key, data.shape[0])


def check_rows(data: TensorDictBase) -> None:
    """Raise if rows cannot be those of a data set, see :func:`check_dataset`.

    In a few rows of one, a field may well be zero.
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


def zero_everywhere(key: NestedKey, rows: int) -> ValueError:
    """Return the error of a field that was never filled."""
    return ValueError(
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
