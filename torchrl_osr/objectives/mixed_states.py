"""The mixed data set D_tot: every clean state together with its perturbed twin.

The twin lies beside the clean state under ``("perturbed", key)``, as the next state
lies under ``("next", key)``, so the batch size never changes; the losses stack the
two where an expectation over D_tot is meant (section 4.1). Shapes: ``B`` batch.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Literal

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from torch import Tensor
from torchrl.objectives import LossModule

States = Literal["both", "clean", "perturbed"]
"""Which states of D_tot a term is taken on."""


def nested(prefix: NestedKey, key: NestedKey) -> NestedKey:
    """Return ``key`` below ``prefix``: ``("next", "observation")``, for instance."""
    return unravel_key((prefix, key))


def is_next(key: NestedKey) -> bool:
    """Return whether ``key`` lies below ``"next"``."""
    return isinstance(key, tuple) and key[0] == "next"


def entry(tensordict: TensorDictBase, key: NestedKey) -> Tensor:
    """Return an entry that must be there.

    Raises:
        KeyError: naming the missing entry and those that are there.
    """
    value: Tensor | None = tensordict.get(key, None)
    if value is None:
        there = sorted(map(str, tensordict.keys(True, True)))
        raise KeyError(f"The batch has no entry {key!r}; it has {there}.")
    return value


def column(tensordict: TensorDictBase, key: NestedKey) -> Tensor:
    """Return an entry with one number a row, ``[B, 1]``, as ``[B]``.

    Raises:
        KeyError: if it is missing.
        ValueError: if it has another shape.
    """
    value = entry(tensordict, key)
    expected = (*tensordict.batch_size, 1)
    if value.shape != expected:
        raise ValueError(
            f"{key!r} has shape {tuple(value.shape)}, expected {expected}: the batch "
            "size and a last dimension of 1."
        )
    return value.squeeze(-1)


def select(tensordict: TensorDictBase, keys: Sequence[NestedKey]) -> TensorDictBase:
    """Return the entries ``keys``, all of which must be there (see :func:`entry`)."""
    for key in keys:
        entry(tensordict, key)
    return tensordict.select(*keys)


def state_keys(in_keys: Iterable[NestedKey], *exclude: NestedKey) -> list[NestedKey]:
    """Return the current-state entries of ``in_keys``, once each and in order."""
    keys = dict.fromkeys(unravel_key(key) for key in in_keys)
    return [key for key in keys if not is_next(key) and key not in exclude]


def perturbed_twin(
    tensordict: TensorDictBase, keys: Sequence[NestedKey], perturbed: NestedKey
) -> TensorDictBase:
    """Return the entries ``keys`` with every perturbed one in place of the clean.

    Args:
        tensordict: a batch ``[B]``.
        keys: the state entries that a network reads.
        perturbed: where :class:`~torchrl_osr.StatePerturbation` wrote the twins.

    Raises:
        KeyError: if no entry has a twin.
        ValueError: if a twin has another shape than its clean state.
    """
    twin = select(tensordict, keys)
    twins = {key: tensordict.get(nested(perturbed, key), None) for key in keys}
    if all(value is None for value in twins.values()):
        wanted = [nested(perturbed, key) for key in keys]
        raise KeyError(
            f"No perturbed state in the batch: expected one of {wanted}, the batch has "
            f"{sorted(map(str, tensordict.keys(True, True)))}. Append "
            "StatePerturbation(std=...) to the replay buffer, or do without the "
            "perturbed states: recovery_weight=0 makes OSRLoss CQL, states='clean' "
            "trains InverseDynamicsLoss on the data alone."
        )
    for key, value in twins.items():
        if value is None:
            continue
        if value.shape != tensordict.get(key).shape:
            raise ValueError(
                f"{nested(perturbed, key)!r} has shape {tuple(value.shape)}, but "
                f"{key!r} has {tuple(tensordict.get(key).shape)}."
            )
        twin.set(key, value)
    return twin


def replace_next(tensordict: TensorDictBase, key: NestedKey, flag: Tensor) -> Tensor:
    """Return ``("next", key)`` with the current state wherever ``flag`` is set.

    What a loader left as the next state of an ended trajectory may be zeros, the first
    state of the next episode or NaN. Selecting before the networks run, rather than
    masking after, keeps such values out of the gradient too (``0 * nan`` is ``nan``).

    Args:
        tensordict: a batch ``[B]`` with ``key`` and ``("next", key)``, ``[B, ...]``.
        key: a state entry.
        flag: bool ``[B]``.
    """
    state, next_state = entry(tensordict, key), entry(tensordict, nested("next", key))
    if state.shape != next_state.shape:
        raise ValueError(
            f"{nested('next', key)!r} has shape {tuple(next_state.shape)}, but "
            f"{key!r} has {tuple(state.shape)}."
        )
    flag = flag.reshape(flag.shape + (1,) * (state.ndim - flag.ndim))
    return torch.where(flag, state, next_state)


def transitions(
    tensordict: TensorDictBase,
    in_keys: Sequence[NestedKey],
    *,
    done: Tensor,
    perturbed: NestedKey,
    states: States = "both",
) -> TensorDictBase:
    """Return what an inverse dynamics model reads, on D_tot or a half of it.

    Args:
        tensordict: a batch ``[B]``.
        in_keys: the model's inputs, some of them below ``"next"``.
        done: bool ``[B]``; such rows get their own state as the next one.
        perturbed: where the twins are.
        states: ``"both"`` (default), ``"clean"`` or ``"perturbed"``.

    Returns:
        ``[2, B]``, clean then perturbed, or ``[1, B]``. The next state is never
        perturbed: it is where the agent shall return to.
    """
    keys = state_keys(in_keys)
    stack = []
    if states != "perturbed":
        stack.append(select(tensordict, keys))
    if states != "clean":
        stack.append(perturbed_twin(tensordict, keys, perturbed))
    for key in in_keys:
        if is_next(key):
            next_state = replace_next(tensordict, unravel_key(key[1:]), done)
            for half in stack:
                half.set(key, next_state)
    return torch.stack(stack)


def reduce_transitions(
    loss: LossModule,
    value: Tensor,
    done: Tensor,
    tensordict: TensorDictBase,
    weights: Tensor | None = None,
    reduction: str | None = None,
) -> Tensor:
    """Reduce ``value`` over the rows that are true transitions.

    Args:
        loss: the module whose ``reduction`` and masks apply.
        value: one number a row, ``[B]``.
        done: bool ``[B]``; such rows do not count, and are 0 under ``"none"``.
        tensordict: the batch ``[B]``, for the masks in it.
        weights: importance weights of the rows, ``[B]``.
        reduction: in place of the module's.
    """
    reduction = reduction or loss.reduction
    value = torch.where(done, torch.zeros_like(value), value)
    # A mask handed to _reduce_loss would compact the result under "none".
    mask = None if reduction == "none" else ~done
    reduced: Tensor = loss._reduce_loss(
        value, tensordict, mask=mask, weights=weights, reduction=reduction
    )
    return reduced
