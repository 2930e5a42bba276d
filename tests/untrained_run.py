"""A run's folder as the trainer leaves it, with networks that nothing has trained."""

from __future__ import annotations

from pathlib import Path

import torch
from composed import composed
from torch.optim.swa_utils import AveragedModel
from torchrl.checkpoint import CheckpointRotation
from torchrl.envs import ObservationNorm

from torchrl_osr.lab.evaluation import deterministic_policy
from torchrl_osr.lab.run.build import make_learner
from torchrl_osr.lab.run.config import checked, write_config
from torchrl_osr.lab.run.load import CHECKPOINTS
from torchrl_osr.trainers.checkpoints import safe_checkpoint


def make_run(folder: Path, *overrides: str, sizes: tuple[int, int] = (11, 3)):
    """Save two checkpoints and the best of an untrained policy, as the trainer does.

    The sizes of observation and action are hopper's unless given.
    """
    config = checked(composed("train", "network.num_cells=[8]", *overrides))
    env = config.env
    env.observation_size, env.action_size = sizes
    if "loss=discrete_osr" not in overrides and env.action_low is None:
        env.action_low, env.action_high = [-1.0] * sizes[1], [1.0] * sizes[1]
    folder.mkdir()
    write_config(folder, config)
    actor, _, loss, objective = make_learner(config)
    norm = ObservationNorm(
        torch.full(sizes[:1], 2.0), torch.full(sizes[:1], 3.0), in_keys=["observation"],
        standard_normal=True,
    )  # fmt: skip
    parts = {"loss_module": objective, "observation_norm": norm}
    parts["policy_average"] = AveragedModel(actor)
    checkpoint = safe_checkpoint(**parts, history=[])
    rotation = CheckpointRotation(folder / CHECKPOINTS, keep_last=2)
    for step in (5, 10, 900):
        rotation.save(checkpoint, step=step)
    best = folder / CHECKPOINTS / "best.torchrl"
    checkpoint.save(best, components=[*parts], metadata={"step": 10, "score": 1.0})
    return deterministic_policy(actor, norm), loss
