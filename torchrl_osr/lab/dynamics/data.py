"""Transitions that dynamics models learn from, and their units."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.data import ImmutableDatasetWriter, ReplayBuffer, Storage

from torchrl_osr.lab.data.transitions import DATASET_KEYS
from torchrl_osr.lab.dynamics.rollouts import reverse_transitions


@dataclass(frozen=True)
class ModelData:
    """Transitions that dynamics models learn from, and their units.

    Attributes:
        storage: rows to train on.
        held_out: rows to evaluate models on.
        pieces: of trajectories, ``[n, L]``, to evaluate roll-outs on.
        loc, scale: observations are ``(s - loc) / scale``.
        reward_scale, reward_shift: rewards are ``scale * r + shift``.
        backward: exchange state and next state.
    """

    storage: Storage
    held_out: TensorDict
    pieces: TensorDict | None
    loc: Tensor
    scale: Tensor
    reward_scale: float
    reward_shift: float
    env_id: str
    backward: bool = False

    def buffer(self, batch_size: int | None = None) -> ReplayBuffer:
        """Return a buffer of the rows to train on, without other transforms."""
        return ReplayBuffer(
            storage=self.storage,
            writer=ImmutableDatasetWriter(),
            collate_fn=lambda batch: batch,
            batch_size=batch_size,
            transform=reverse_transitions if self.backward else None,
        )

    def reverse(self) -> ModelData:
        """Return the same transitions against the direction of time."""
        held_out, pieces = reverse_transitions(self.held_out), self.pieces
        if pieces is not None:
            pieces = reverse_transitions(pieces.flip(1))
        return replace(self, held_out=held_out, pieces=pieces, backward=True)

    def facts(self) -> dict[str, Any]:
        """Return what a model shares with its data, JSON-compatible."""
        digest = hashlib.sha256()
        for key in DATASET_KEYS:
            values = self.held_out[key].cpu().contiguous().view(torch.uint8)
            digest.update(values.numpy().tobytes())
        return {
            "environment": self.env_id,
            "rows": len(self.storage),
            "observation mean": self.loc.tolist(),
            "observation scale": self.scale.tolist(),
            "reward scale": self.reward_scale,
            "reward shift": self.reward_shift,
            "held-out rows": digest.hexdigest(),
            "direction of time": "backward" if self.backward else "forward",
        }
