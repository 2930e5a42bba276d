"""A replay buffer where TorchRL's trainers ask for a collector."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.collectors import BaseCollector
from torchrl.data import ReplayBuffer


class ReplayBufferCollector(BaseCollector):
    """The batches of a replay buffer, as a collector's frames.

    TorchRL 0.14.1's trainers take every frame from an environment. With this collector
    they train on recorded data alone: every batch is one ``replay_buffer.sample()``,
    and ``total_frames`` count its rows. Such a trainer gets ``optim_steps_per_batch=1``
    and no ``replay_buffer`` of its own, see ``examples/torchrl_trainer.py``.
    """

    init_random_frames = 0

    def __init__(self, replay_buffer: ReplayBuffer, *, total_frames: int) -> None:
        super().__init__()
        self.replay_buffer = replay_buffer
        self.total_frames = total_frames
        self._frames = 0
        self._generator: torch.Generator | None = None

    def iterator(self) -> Iterator[TensorDictBase]:
        """Yield batches ``[B]`` until ``total_frames`` rows were drawn."""
        while self._frames < self.total_frames:
            batch = self.replay_buffer.sample()
            self._frames += len(batch)
            yield batch

    def set_seed(self, seed: int, static_seed: bool = False) -> int:
        """Seed the draws; return the seed."""
        device = self.replay_buffer.storage.device  # where the draws are made
        self._generator = torch.Generator(device).manual_seed(seed)
        self.replay_buffer.set_rng(self._generator)
        return seed

    def update_policy_weights_(self, *_: Any, **__: Any) -> None:
        """Do nothing: no policy acts here."""

    def shutdown(self, *_: Any, **__: Any) -> None:
        """Do nothing: no environment runs."""

    def state_dict(self) -> OrderedDict[str, Any]:
        """Return the number of rows that were drawn and, once seeded, the draws."""
        state: OrderedDict[str, Any] = OrderedDict(frames=self._frames)
        if self._generator is not None:
            state["generator"] = self._generator.get_state()
        return state

    def load_state_dict(self, state_dict: OrderedDict[str, Any]) -> None:
        """Continue after the saved rows; if seeded, call :meth:`set_seed` first."""
        self._frames = int(state_dict["frames"])
        if self._generator is not None and "generator" in state_dict:
            self._generator.set_state(state_dict["generator"])
