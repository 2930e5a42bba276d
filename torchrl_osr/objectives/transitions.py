"""A batch as the losses see it: named tensors, unpacked once.

Shapes: ``B`` batch (any leading dimensions), ``R`` rows (all of ``B`` in one), ``A``
action, ``D`` sets of states: 2 for D_tot (clean and perturbed), 1 for either alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor

from torchrl_osr._entries import column, entry, nested

States = Literal["both", "clean", "perturbed"]
"""The states of D_tot on which a term is taken."""

SETS = {
    "both": slice(0, None, 2),
    "clean": slice(0, 1),
    "perturbed": slice(2, 3),
    "next": slice(1, 2),
    "recorded": slice(0, 2),
    "perturbed_and_next": slice(1, 3),
}
"""Sets of states in the stack ``[s, s', s^]``; ``"recorded"`` is ``s`` and ``s'``."""


@dataclass
class TransitionKeys:
    """The entries of a batch that a loss reads or writes; ``set_keys`` renames them.

    ``reward``, ``done`` and ``terminated`` are below ``"next"``. The last three entries
    are optional. ``is_synthetic`` marks rows with an action that is not the data's,
    ``[B, 1]``. ``one_step`` is the single step of a row of several, like ``"next"``.
    ``steps_to_next_obs`` counts a row's steps.
    """

    action: NestedKey = "action"
    value: NestedKey = "state_value"
    reward: NestedKey = "reward"
    done: NestedKey = "done"
    terminated: NestedKey = "terminated"
    priority: NestedKey = "td_error"
    priority_weight: NestedKey = "priority_weight"
    perturbed: NestedKey = "perturbed"
    state_action_value: NestedKey = "state_action_value"
    action_value: NestedKey = "action_value"
    is_synthetic: NestedKey = "is_synthetic"
    one_step: NestedKey = "one_step"
    steps_to_next_obs: NestedKey = "steps_to_next_obs"


class Transitions:
    """A batch, unpacked once for everything downstream.

    Rows are flattened. Flags become bool. Floating-point entries have the networks'
    ``dtype``. Rows that one of ``masks`` leaves out may hold NaN and become zeros.

    Attributes:
        tensordict: the batch as it was given.
        rows: what the loss reads of it, ``[R]``.
        unmasked: rows that count, bool ``[R]``; ``None`` if all do.
        one_step: the same rows with the single step as ``"next"``, see
            :class:`TransitionKeys`.
        states: ``[s, s']`` or ``[s, s', s^]``, ``[2 or 3, R]``; only with critics.
    """

    states: TensorDictBase

    def __init__(
        self,
        tensordict: TensorDictBase,
        read: Sequence[NestedKey],
        keys: TransitionKeys,
        masks: Sequence[NestedKey],
        dtype: torch.dtype,
    ) -> None:
        self.tensordict, self.keys = tensordict, keys
        optional = {keys.is_synthetic, keys.one_step, keys.steps_to_next_obs, *masks}
        rows = tensordict.select(*read, *optional, strict=False).copy()
        if rows.ndim != 1:
            rows = rows.reshape(-1)
        rows = _in_dtype(rows, dtype)
        self.unmasked: Tensor | None = None
        for mask in (rows.get(key, None) for key in masks):
            if mask is not None:
                mask = mask.reshape(-1).bool()
                rows = rows.where(mask, torch.zeros_like(rows))
                self.unmasked = self.counted(mask)
        for prefix in ("next", keys.one_step):
            for key in (nested(prefix, keys.done), nested(prefix, keys.terminated)):
                if rows.get(key, None) is not None:
                    rows.set(key, column(rows, key).bool().unsqueeze(-1))
        self.rows = self.one_step = rows
        if keys.one_step in rows.keys(include_nested=True):
            own = rows.exclude(keys.steps_to_next_obs)
            self.one_step = own.set("next", rows.get(keys.one_step))

    def stack_states(self, keys: Sequence[NestedKey], *, perturbed: bool) -> None:
        """Stack the states that actor and critics read, see ``states``."""
        ended = column(self.rows, nested("next", self.keys.terminated))
        sets = self.states_of(keys, "both" if perturbed else "clean")
        clean, *others = sets.unbind(0)
        self.states = torch.stack([clean, next_states(self.rows, keys, ended), *others])

    def states_of(self, keys: Sequence[NestedKey], states: States) -> TensorDictBase:
        """Return the entries ``keys`` of D_tot or a half of it, ``[D, R]``.

        An entry without a perturbed one is the same in both halves.
        """
        rows = self.rows
        for key in keys:
            entry(self.tensordict, key)  # an error lists the whole batch
        clean = TensorDict({key: entry(rows, key) for key in keys}, rows.batch_size)
        if states == "clean":
            return clean.unsqueeze(0)
        perturbed, names = clean.copy(), [nested(self.keys.perturbed, k) for k in keys]
        if all(rows.get(name, None) is None for name in names):
            there = sorted(map(str, self.tensordict.keys(True, True)))
            raise KeyError(
                f"No perturbed state in the batch: expected one of {names}, the batch "
                f"has {there}. Append StatePerturbation(std=...) to the replay buffer."
            )
        for key, name in zip(keys, names, strict=True):
            value = rows.get(name, None)
            if value is not None:
                perturbed.set(key, _same_shape(clean, key, name, value))
        halves = {"both": [clean, perturbed], "perturbed": [perturbed]}
        return torch.stack(halves[states])

    @property
    def s(self) -> TensorDictBase:
        """The clean states, ``[R]``."""
        return self.states[0]

    @property
    def s_next(self) -> TensorDictBase:
        """The next states, ``[R]``; after a termination the state stands in."""
        return self.states[1]

    @property
    def a(self) -> Tensor:
        """The data's actions, ``[R, A]``."""
        return entry(self.rows, self.keys.action)

    @property
    def done(self) -> Tensor:
        """Ends of trajectories after a single step, bool ``[R]``."""
        return column(self.one_step, nested("next", self.keys.done))

    @property
    def is_data(self) -> Tensor | None:
        """Rows with an action of the data, bool ``[R]``; ``None`` if all have."""
        if self.rows.get(self.keys.is_synthetic, None) is None:
            return None
        return ~column(self.rows, self.keys.is_synthetic).bool()

    @property
    def has_next(self) -> Tensor:
        """Rows of the data whose next state is one, bool ``[R]``."""
        data = self.is_data
        return ~self.done if data is None else ~self.done & data

    def of_data(self, value: Tensor) -> Tensor:
        """Return ``value``, ``[R]``, with 0 where the action is not the data's."""
        data = self.is_data
        return value if data is None else torch.where(data, value, 0.0)

    def counted(self, valid: Tensor | None) -> Tensor | None:
        """Return the unmasked rows that are ``valid``; ``None`` stands for all."""
        if valid is None or self.unmasked is None:
            return self.unmasked if valid is None else valid
        return valid & self.unmasked


def next_states(
    rows: TensorDictBase, keys: Sequence[NestedKey], absent: Tensor
) -> TensorDictBase:
    """Return ``("next", key)`` for each key, the current state where ``absent``.

    A loader may leave zeros, the first state of the next episode or NaN as the next
    state of an ended trajectory. Selecting before the networks run keeps such values
    out of the gradient, too (``0 * nan`` is ``nan``).
    """
    found = {}
    for key in keys:
        state, name = entry(rows, key), nested("next", key)
        after = _same_shape(rows, key, name, entry(rows, name))
        where = absent.reshape(absent.shape + (1,) * (state.ndim - absent.ndim))
        found[key] = torch.where(where, state, after)
    return TensorDict(found, rows.batch_size)


def check_single_steps(batch: Transitions, reader: str) -> None:
    """Raise a ValueError where a next state is not the one that an action led to."""
    steps = batch.one_step.get(batch.keys.steps_to_next_obs, None)
    # Tracing cannot branch on a number; the first, eager call has looked.
    if steps is not None and not torch.compiler.is_compiling() and (steps > 1).any():
        raise ValueError(
            f"The batch holds multi-step transitions ({int(steps.max())} steps), but "
            f"{reader} reads the state one step ahead: leave MultiStep out of the "
            "buffer, or keep the single step in the entry 'one_step'."
        )


def _same_shape(
    rows: TensorDictBase, key: NestedKey, name: NestedKey, value: Tensor
) -> Tensor:
    if value.shape != rows.get(key).shape:
        raise ValueError(
            f"{name!r} has shape {tuple(value.shape)}, but {key!r} has "
            f"{tuple(rows.get(key).shape)}."
        )
    return value


def _in_dtype(rows: TensorDictBase, dtype: torch.dtype) -> TensorDictBase:
    floats = [each for each in rows.values(True, True) if each.is_floating_point()]
    if all(each.dtype == dtype for each in floats):
        return rows
    return rows.apply(lambda each: each.to(dtype) if each.is_floating_point() else each)
