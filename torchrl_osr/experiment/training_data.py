"""What a run trains on: rows in memory, prepared once, or on disk, batch by batch.

Observations are standardised and rewards scaled by the same transform, applied to all
rows in memory or to each batch from disk: the same seed gives the same batches.

Shapes: ``S`` observation, ``A`` action.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from omegaconf import DictConfig
from tensordict import TensorDict
from torch import Tensor
from torchrl.data import ReplayBuffer, TensorStorage
from torchrl.envs import Compose, ObservationNorm, RewardScaling

from torchrl_osr.data import (
    check_memory,
    held_out_rows,
    make_replay_buffer,
    observation_statistics,
    split_held_out,
)
from torchrl_osr.experiment.build import check_storage, load_data

MAX_HELD_OUT = 50_000
"""Held-out rows of a set on disk that are read into memory, at most."""


class TrainingData(NamedTuple):
    """The rows to train on and to judge by, shared by all seeds of a run.

    Attributes:
        rows: in memory prepared and on the device; on disk as they are.
        left_out: of a set on disk, sorted numbers of the rows not to train on.
        held_out: as they are trained on, on the device.
        norm: what standardises observations, on the device.
        reward: factor and addend of the rewards.
        largest_reward: the largest absolute reward, held-out rows included.
        device: where the batches are.
        score: normalised score of the behaviour, if it is known.
    """

    rows: TensorDict
    left_out: Tensor | None
    held_out: TensorDict
    norm: ObservationNorm
    reward: tuple[float, float]
    largest_reward: float
    device: torch.device
    score: float | None

    @property
    def sizes(self) -> tuple[int, int]:
        """``S`` and ``A``."""
        return self.held_out["observation"].shape[-1], self.held_out["action"].shape[-1]

    def buffer(self, batch_size: int) -> ReplayBuffer:
        """Replay buffer over the rows, which are shared; its generator is not."""
        if self.left_out is None:
            return ReplayBuffer(storage=TensorStorage(self.rows), batch_size=batch_size)
        return make_replay_buffer(
            self.rows,
            batch_size=batch_size,
            seed=0,  # the trainer brings a generator of its own
            left_out=self.left_out,
            transform=_preparation(self.norm, self.reward).to(self.device),
            device=self.device,
        )


def load_training_data(cfg: DictConfig, device: torch.device) -> TrainingData:
    """Load a run's data, split and prepared, see ``data`` of its configuration.

    Rewards become ``data.reward_scale * r + data.reward_shift``; the manifest and the
    score are of the task's own.

    Args:
        cfg: a whole configuration of ``examples/offline_osr.py``.
        device: where batches and networks are.

    Raises:
        ValueError: an option cannot be had with the others.
        MemoryError: the data do not fit into the GPU.
    """
    on_disk = check_storage(cfg) == "disk"
    data, manifest = load_data(cfg, progress=cfg.trainer.progress)
    loc, scale = observation_statistics(data) if cfg.data.standardize else (0.0, 1.0)
    norm = _norm(loc, scale)
    reward = cfg.data.reward_scale, cfg.data.reward_shift
    extremes = torch.stack(data["next", "reward"].aminmax())
    largest = (reward[0] * extremes + reward[1]).abs().max().item()
    prepare = _preparation(norm, reward)
    left_out = None
    if on_disk:
        chosen = held_out_rows(len(data), cfg.data.held_out, seed=cfg.data.seed)
        left_out = chosen.sort().values
        rows, held_out = data, prepare(data[chosen[:MAX_HELD_OUT].sort().values])
    else:
        rows, held_out = split_held_out(
            prepare(data), cfg.data.held_out, seed=cfg.data.seed
        )
        check_memory(rows, device)
        rows = rows.to(device)
    return TrainingData(
        rows,
        left_out,
        held_out.to(device),
        norm.to(device),
        reward,
        largest,
        device,
        manifest["normalized_score"],
    )


def _preparation(norm: ObservationNorm, reward: tuple[float, float]) -> Compose:
    """Transform that standardises observations and scales rewards."""
    scale, shift = reward
    transform = Compose(_norm(norm.loc, norm.scale))  # one belongs to one buffer
    if reward != (1.0, 0.0):
        transform.append(RewardScaling(shift, scale, in_keys=[("next", "reward")]))
    return transform


def _norm(loc: Tensor | float, scale: Tensor | float) -> ObservationNorm:
    keys = ["observation", ("next", "observation")]
    return ObservationNorm(loc, scale, in_keys=keys, standard_normal=True)
