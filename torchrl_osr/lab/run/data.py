"""Training data: rows in memory, prepared once."""

from __future__ import annotations

import gc
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any, NamedTuple

import numpy as np
import torch
from tensordict import NestedKey, TensorDict
from torchrl.data import ReplayBuffer
from torchrl.envs import ObservationNorm

from torchrl_osr.lab.data import (
    ReferenceReturns,
    load_dataset,
    make_replay_buffer,
    observation_statistics,
    reference_returns,
)
from torchrl_osr.lab.data.columns import NO_REWARDS, has_rewards
from torchrl_osr.lab.data.rows import multi_step, next_action, split_held_out
from torchrl_osr.lab.run.config import read_columns
from torchrl_osr.lab.run.schema import DataConfig, EnvConfig, TrainConfig

OF_TRAINING = (
    *("held_out", "standardize", "reward_scale", "reward_shift"),
    *("checksum", "observation_names"),
)
"""Options of the data that do not decide which rows there are."""


class TrainingData(NamedTuple):
    """The rows to train on and to judge by, prepared and on the device."""

    buffer: ReplayBuffer  # samples batches; the trainer seeds it
    held_out: TensorDict  # rows that are not in the buffer
    norm: ObservationNorm  # standardises observations
    largest_reward: float  # the largest absolute one, held-out rows included
    data_mean: float | None  # score of the behaviour, else return, if known


def references_of(env: EnvConfig) -> ReferenceReturns | None:
    """Return what returns are normalised by, ``None`` if they stay as they are."""
    return reference_returns(env.name, env.random_return, env.expert_return)


def load_data(
    env: EnvConfig | None, options: DataConfig, *, progress: bool = True
) -> tuple[TensorDict, dict[str, Any]]:
    """Load data set and manifest; rewards are the task's own.

    Without a task, recorded data are not compared with it. Without a simulator, the
    actions' bounds are those of the options, of the run, or else of the log. A
    ValueError reports data that have changed since the run began.
    """
    reading = asdict(options)
    reading["columns"] = read_columns(reading["columns"])
    for name in OF_TRAINING:
        del reading[name]
    gc.collect()  # an earlier job's trainer is a reference cycle, and holds its rows
    if env is not None:
        reading |= {"env_name": env.name, "env_id": env.id}
        reading["references"] = references_of(env)
        if env.id is None and env.discrete:
            reading["num_actions"] = env.action_size
        elif env.id is None and options.source in ("file", "lerobot", "d4rl"):
            known = env.action_low and (env.action_low, env.action_high)
            usual = None if options.source == "d4rl" else "log"
            reading["action_bounds"] = options.action_bounds or known or usual
    elif options.source in ("file", "lerobot"):
        reading["action_bounds"] = options.action_bounds or "log"
    data, manifest = load_dataset(**reading, progress=progress)
    if options.checksum not in (None, manifest["checksum"]):
        place, cure = "", "install the package versions that its train.log names, "
        if options.path is not None:
            place = f" data.path={options.path}"
            cure = "give data.path=<place of these> (evaluate-offline: --data), "
        raise ValueError(
            f"data={options.source}{place} has other contents than those that the run "
            f"began with: {cure}begin another run in another folder, or train on with "
            "'torchrl-osr train resume=<its folder> force=true trainer.steps=<more>'."
        )
    return data, manifest


def set_sizes_from_log(config: TrainConfig) -> None:
    """Set sizes and action bounds of a configuration without a simulator."""
    env = config.env
    data, manifest = load_data(env, config.data, progress=config.trainer.progress)
    env.observation_size = data["observation"].shape[-1]
    env.action_size = data["action"].shape[-1]
    if manifest.get("num_actions") is None:
        low, high = manifest.get("action_bounds") or (-1.0, 1.0)
        env.action_low = np.broadcast_to(low, env.action_size).tolist()
        env.action_high = np.broadcast_to(high, env.action_size).tolist()


@torch.random.fork_rng(devices=[])
def load_training_data(
    config: TrainConfig,
    device: torch.device | str = "cpu",
    in_keys: Sequence[NestedKey] = (),
) -> TrainingData:
    """Load a run's data, split and prepared; torch's global generator is left alone.

    Their checksum and the names of a log's observation are kept in the configuration.

    Rewards become ``reward_scale * r + reward_shift``; the mean is of the task's own.
    ``in_keys`` are the keys that the loss reads. If rewards are among them, or by
    default, a log without rewards is refused. With ``("next", "action")``, batches have
    the data's next action, and the rows must be in order of time.
    """
    env, options, optim = config.env, config.data, config.optim
    data, manifest = load_data(env, options, progress=config.trainer.progress)
    options.checksum = manifest["checksum"]
    options.observation_names = manifest.get("columns", {}).get("observation")
    rewarded = not in_keys or ("next", "reward") in in_keys or config.dynamics.use
    if rewarded and not has_rewards(manifest):
        raise ValueError(NO_REWARDS)
    if not rewarded and ("next", "done") in in_keys and data["next", "done"].all():
        raise ValueError(
            "every row ends an episode, and a recovery term skips such rows: choose "
            "loss=bc."
        )
    loc, scale = observation_statistics(data) if options.standardize else (0.0, 1.0)
    reward = options.reward_scale * data["next", "reward"] + options.reward_shift

    def norm(*keys: NestedKey) -> ObservationNorm:
        return ObservationNorm(loc, scale, in_keys=list(keys), standard_normal=True)

    states = "observation", ("next", "observation")
    rows = data.set(("next", "reward"), reward)
    if ("next", "action") in in_keys:
        rows["next", "action"] = next_action(rows)
    if optim.n_steps > 1:  # what follows a row, before some are held out
        steps = multi_step(rows, n_steps=optim.n_steps, gamma=optim.gamma)
        rows["multi_step"] = norm("observation")(steps)
    rows = norm(*states)(rows)
    rows, held_out = split_held_out(rows, options.held_out, seed=options.seed)
    size = config.trainer.batch_size
    buffer = make_replay_buffer(rows, batch_size=size, seed=0, device=device)
    mean = manifest["mean_return" if references_of(env) is None else "normalized_score"]
    largest = reward.abs().max().item()
    return TrainingData(
        buffer, held_out.to(device), norm(*states).to(device), largest, mean
    )
