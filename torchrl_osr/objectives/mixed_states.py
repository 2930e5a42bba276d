"""The mixed data set D_tot: every clean state together with its perturbed state.

The perturbed state is the entry ``("perturbed", key)`` of the same row, as the next
state is ``("next", key)``, so the batch size never changes; the losses stack the two
where an expectation over D_tot is meant (section 4.1). Shapes: ``B`` batch.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from torch import Tensor

from torchrl_osr._entries import column, entry, is_next, nested, select, state_keys

States = Literal["both", "clean", "perturbed"]
"""The states of D_tot on which a term is taken."""


def perturbed_state(
    tensordict: TensorDictBase, keys: Sequence[NestedKey], perturbed: NestedKey
) -> TensorDictBase:
    """The entries ``keys``, each perturbed one in place of the clean.

    Args:
        tensordict: a batch ``[B]``.
        keys: the state entries that a network reads.
        perturbed: where :class:`~torchrl_osr.StatePerturbation` wrote them.

    Raises:
        KeyError: if no entry has a perturbed one.
        ValueError: if a perturbed entry has another shape than its clean one.
    """
    state = select(tensordict, keys)
    found = {key: tensordict.get(nested(perturbed, key), None) for key in keys}
    if all(value is None for value in found.values()):
        wanted = [nested(perturbed, key) for key in keys]
        raise KeyError(
            f"No perturbed state in the batch: expected one of {wanted}, the batch has "
            f"{sorted(map(str, tensordict.keys(True, True)))}. Append "
            "StatePerturbation(std=...) to the replay buffer, or ask for the clean "
            "states alone: actor_states='clean' and recovery_states='clean' (or "
            "recovery_weight=0) in OSRLoss, states='clean' in InverseDynamicsLoss."
        )
    for key, value in found.items():
        if value is None:
            continue
        if value.shape != tensordict.get(key).shape:
            raise ValueError(
                f"{nested(perturbed, key)!r} has shape {tuple(value.shape)}, but "
                f"{key!r} has {tuple(tensordict.get(key).shape)}."
            )
        state.set(key, value)
    return state


def next_state(tensordict: TensorDictBase, key: NestedKey, absent: Tensor) -> Tensor:
    """``("next", key)``, with the current state wherever ``absent`` is set.

    What a loader left as the next state of an ended trajectory may be zeros, the first
    state of the next episode or NaN. Selecting before the networks run, rather than
    masking after, keeps such values out of the gradient too (``0 * nan`` is ``nan``).

    Args:
        tensordict: a batch ``[B]`` with ``key`` and ``("next", key)``, ``[B, ...]``.
        key: a state entry.
        absent: rows without a true next state, bool ``[B]``.
    """
    state, after = entry(tensordict, key), entry(tensordict, nested("next", key))
    if state.shape != after.shape:
        raise ValueError(
            f"{nested('next', key)!r} has shape {tuple(after.shape)}, but "
            f"{key!r} has {tuple(state.shape)}."
        )
    absent = absent.reshape(absent.shape + (1,) * (state.ndim - absent.ndim))
    return torch.where(absent, state, after)


def first_step(tensordict: TensorDictBase) -> TensorDictBase:
    """A batch whose ``"next"`` is that of single steps.

    Of multi-step transitions it is their entry ``"one_step"``, where they keep it.
    """
    if "one_step" not in tensordict:
        return tensordict
    return tensordict.exclude("steps_to_next_obs").set("next", tensordict["one_step"])


def check_single_steps(tensordict: TensorDictBase, reader: str) -> None:
    """Raise where a next state is not the one that an action has led to.

    Args:
        tensordict: a batch ``[B]``, see :func:`first_step`.
        reader: what reads it.

    Raises:
        ValueError: if some next states are several steps ahead.
    """
    steps = tensordict.get("steps_to_next_obs", None)
    # Tracing cannot branch on a number; the first, eager call has looked.
    if steps is not None and not torch.compiler.is_compiling() and (steps > 1).any():
        raise ValueError(
            f"The batch holds multi-step transitions (steps_to_next_obs up to "
            f"{int(steps.max())}), but {reader} reads the state one step ahead: leave "
            "MultiStep out of the buffer, or that term out of the loss "
            "(recovery_weight=0, correction_weight=0)."
        )


def of_data(tensordict: TensorDictBase) -> Tensor | None:
    """Which rows have an action of the data, bool ``[B]``; ``None`` if all have.

    The others are marked by an entry ``"imagined"``: there the policy itself has acted,
    so that there is nothing to clone.
    """
    if tensordict.get("imagined", None) is None:
        return None
    return ~column(tensordict, "imagined").bool()


def transitions(
    tensordict: TensorDictBase,
    in_keys: Sequence[NestedKey],
    *,
    done: Tensor,
    perturbed: NestedKey,
    states: States = "both",
) -> TensorDictBase:
    """What an inverse dynamics model reads, on D_tot or a half of it.

    Args:
        tensordict: a batch ``[B]`` of single steps, see :func:`first_step`.
        in_keys: the model's inputs, some of them below ``"next"``.
        done: bool ``[B]``; such rows get their own state as the next one.
        perturbed: where the perturbed states are.
        states: ``"both"`` (default), ``"clean"`` or ``"perturbed"``.

    Returns:
        ``[2, B]``, clean then perturbed, or ``[1, B]``. The next state is never
        perturbed: it is where the agent shall return to.

    Raises:
        ValueError: if next states are read, and are several steps ahead.
    """
    if any(map(is_next, in_keys)):
        check_single_steps(tensordict, "the inverse dynamics model")
    keys = state_keys(in_keys)
    stack = []
    if states != "perturbed":
        stack.append(select(tensordict, keys))
    if states != "clean":
        stack.append(perturbed_state(tensordict, keys, perturbed))
    for key in in_keys:
        if is_next(key):
            value = next_state(tensordict, unravel_key(key[1:]), done)
            for half in stack:
                half.set(key, value)
    return torch.stack(stack)
