"""What a run trains on: data in memory, standardised once, or on disk, batch by batch.

Both give the same batches for the same seed: the same rows, standardised by the same
numbers, but for the last digit in which a sum of chunks may differ.

Shapes: ``S`` observation, ``A`` action.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from omegaconf import DictConfig
from tensordict import TensorDict
from torchrl.data import ReplayBuffer, TensorStorage
from torchrl.envs import Compose, ObservationNorm, RewardScaling

from torchrl_osr.data import (
    TransitionsOnDisk,
    make_replay_buffer,
    observation_statistics,
    split_held_out,
    split_on_disk,
)
from torchrl_osr.data.replay_buffer import check_memory
from torchrl_osr.experiment.build import check_storage, load_data

STATES = ("observation", ("next", "observation"))


class TrainingData(NamedTuple):
    """The rows to train on and to judge by, shared by all members of a population.

    Attributes:
        rows: in memory standardised and on the device; on disk as they are.
        held_out: as they are trained on, on the device.
        norm: what standardises observations, on the device.
        reward: factor and addend of the rewards, which rows in memory have had.
        largest_reward: the largest absolute reward that is trained on.
        device: where the batches are.
        score: normalised score of the behaviour, if it is known.
    """

    rows: TensorDict | TransitionsOnDisk
    held_out: TensorDict
    norm: ObservationNorm
    reward: tuple[float, float]
    largest_reward: float
    device: torch.device
    score: float | None

    @property
    def sizes(self) -> tuple[int, int]:
        """Return ``S`` and ``A``."""
        return self.held_out["observation"].shape[-1], self.held_out["action"].shape[-1]

    def buffer(self, batch_size: int) -> ReplayBuffer:
        """Return a buffer over the rows, which are shared; its generator is not."""
        if isinstance(self.rows, TensorDict):
            return ReplayBuffer(storage=TensorStorage(self.rows), batch_size=batch_size)
        norm = _norm(self.norm.loc, self.norm.scale)  # one belongs to one buffer
        transform = Compose(norm.to(self.device))
        if self.reward != (1.0, 0.0):
            scale, shift = self.reward
            scaling = RewardScaling(shift, scale, in_keys=[("next", "reward")])
            transform.append(scaling.to(self.device))
        # The trainer brings a generator of its own.
        return make_replay_buffer(
            self.rows,
            batch_size=batch_size,
            seed=0,
            transform=transform,
            device=self.device,
        )


def load_training_data(cfg: DictConfig, device: torch.device) -> TrainingData:
    """Load a run's data, split and standardised, see ``data`` of its configuration.

    Args:
        cfg: a whole configuration of ``examples/offline_osr.py``.
        device: where batches and networks are.

    Raises:
        ValueError: an option cannot be had with the others.
        MemoryError: the data do not fit into the GPU.
    """
    check_storage(cfg)
    data, manifest = load_data(cfg, progress=cfg.trainer.progress)
    statistics = observation_statistics(data) if cfg.data.standardize else (0.0, 1.0)
    norm = _norm(*statistics)
    scale, shift = cfg.data.get("reward_scale", 1.0), cfg.data.get("reward_shift", 0.0)
    split = {"held_out": cfg.data.held_out, "seed": cfg.data.seed}
    rows: TensorDict | TransitionsOnDisk
    if isinstance(data, TransitionsOnDisk):
        rows, held_out = split_on_disk(data, **split)
        held_out = norm(held_out)
        held_out["next", "reward"] = scale * held_out["next", "reward"] + shift
        largest = max(abs(scale * reward + shift) for reward in data.reward_range())
    else:
        memory, held_out = split_held_out(norm(data), **split)
        check_memory(memory, device)
        rows = memory.to(device)
        largest = rows["next", "reward"].abs().max().item()
    return TrainingData(
        rows,
        held_out.to(device),
        norm.to(device),
        (scale, shift),
        largest,
        device,
        manifest.get("normalized_score"),
    )


def _norm(loc: torch.Tensor | float, scale: torch.Tensor | float) -> ObservationNorm:
    return ObservationNorm(loc, scale, in_keys=list(STATES), standard_normal=True)
