"""Loading trained policies from the folders of their runs."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import torch
from tensordict.nn import ProbabilisticTensorDictSequential
from torch import Tensor
from torch.optim.swa_utils import AveragedModel
from torchrl.checkpoint import CheckpointError
from torchrl.envs import ObservationNorm
from torchrl.objectives import LossModule

from torchrl_osr.lab.dynamics import EliteNetworks, SwitchingPolicy
from torchrl_osr.lab.dynamics.rollouts import termination
from torchrl_osr.lab.dynamics.training import MODEL, load_dynamics
from torchrl_osr.lab.run.build import Learner, make_learner
from torchrl_osr.lab.run.config import CONFIG, read_run
from torchrl_osr.lab.run.schema import TrainConfig
from torchrl_osr.policy import Policy, load_policy, policy_from_loss
from torchrl_osr.policy.policy import SUFFIX
from torchrl_osr.trainers.checkpoints import find_damage, safe_checkpoint

CHECKPOINTS = Path("checkpoint") / "policy"
"""Folder of the policy's checkpoints, in the run's folder."""

POLICY = "policy.safetensors"
"""The exported policy, in the run's folder."""


class TrainedRun(NamedTuple):
    """One checkpoint of a run, on the CPU."""

    config: TrainConfig
    actor: ProbabilisticTensorDictSequential  # with the average of its weights
    inverse_dynamics: ProbabilisticTensorDictSequential | None  # frozen
    loss: LossModule  # holds the critics, too
    observation_norm: ObservationNorm
    step: int
    path: Path


def run_folder_of(path: Path | str) -> Path:
    """Return the folder of the run that a checkpoint, or the folder itself, is of."""
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"there is no run and no checkpoint at {path}.")
    folder = path if path.is_dir() else path.absolute().parent.parent.parent
    if not (folder / CONFIG).exists():
        raise FileNotFoundError(
            f"there is no {CONFIG} in {folder}: give a run's folder or checkpoint."
        )
    return folder


def checkpoints_of(folder: Path | str) -> list[Path]:
    """Return the checkpoints that a run has kept, oldest first, without the best."""
    found = sorted((run_folder_of(folder) / CHECKPOINTS).glob("checkpoint-*.torchrl"))
    if not found:
        raise FileNotFoundError(f"the run in {folder} has no checkpoint: train on.")
    return found


def load_trained(path: Path | str, *, trust: Sequence[str] = ()) -> TrainedRun:
    """Load a checkpoint, or the newest of a run's folder; no code from it is run.

    No environment is made, and torch's global generator is left as it was. ``trust``
    has the modules of your own that the run's configuration may name.
    """
    config = read_run(run_folder_of(path), trust)
    path = checkpoints_of(path)[-1] if Path(path).is_dir() else Path(path)
    if damage := find_damage(path):
        raise CheckpointError(f"{path} is damaged: {damage}. Take another .torchrl.")
    with torch.random.fork_rng(devices=[]):
        learner = make_learner(config)
    shape = [config.env.observation_size or 0] if config.data.standardize else []
    norm = ObservationNorm(
        torch.zeros(shape), torch.ones(shape), in_keys=["observation"],
        standard_normal=True,
    )  # fmt: skip
    return restore(path, config, learner, norm)


def restore(
    path: Path, config: TrainConfig, learner: Learner, norm: ObservationNorm
) -> TrainedRun:
    """Load a checkpoint's averaged policy, critics and statistics into networks."""
    average = AveragedModel(learner.actor)
    checkpoint = safe_checkpoint(
        loss_module=learner.objective, observation_norm=norm, policy_average=average
    )
    manifest = checkpoint.load(path, map_location="cpu").manifest
    learner.actor.load_state_dict(average.module.state_dict())
    numbered = re.fullmatch(r"checkpoint-(\d+)\.torchrl", path.name)
    step = int(numbered[1]) if numbered else int(manifest["metadata"]["step"])
    return TrainedRun(config, *learner[:3], norm, step, path)


def load_run_policy(path: Path | str, trust: Sequence[str] = ()) -> Policy:
    """Load the policy from a run's folder, a checkpoint in it, or a saved file.

    A finished run has exported its policy: nothing is built from its configuration.
    """
    path = Path(path)
    if path.suffix == SUFFIX or (path / POLICY).exists():
        return load_policy(path)
    return policy_of(load_trained(path, trust=trust))


def policy_of(run: TrainedRun) -> Policy:
    """Copy the policy of a run, in the units of its environment."""
    config, env = run.config, run.config.env
    source: dict[str, Any] = {"env_id": env.id, "seed": config.seed, "step": run.step}
    source |= {"checkpoint": run.path.name, "discount": config.optim.gamma}
    # Without the place of a log on this machine.
    source |= {"data": asdict(config.data) | {"path": None}}
    bounds: Any = {"low": env.action_low or -1.0, "high": env.action_high or 1.0}
    return policy_from_loss(run.loss, run.observation_norm, source=source, **bounds)


def load_switching_policy(
    runs: Sequence[Path | str],
    *,
    critics_only: bool = False,
    trust: Sequence[str] = (),
    **options: Any,
) -> SwitchingPolicy:
    """Combine runs of a task to one policy, in the environment's units, on the CPU.

    Each run's policy is rolled out in the models of all runs that have one, 20 steps
    every 4, or in the first grey box among them, 40 steps every 10. The mean of all
    runs' critics values its last state. Several seeds of ``loss=rim`` have all parts.

    They are folders, or checkpoints in them. With ``critics_only`` no model is used.
    ``options`` are those of :class:`~torchrl_osr.lab.dynamics.SwitchingPolicy`.
    """
    trained = [load_trained(each, trust=trust) for each in runs]
    policies, configs = [*map(policy_of, trained)], [run.config for run in trained]
    for run, policy in zip(runs, policies, strict=True):
        if policy.discrete or not policy.critics:
            raise ValueError(f"{run} needs continuous actions and critics to switch.")
    shared = {
        (each.env.id, each.optim.gamma, each.data.reward_scale, each.data.reward_shift)
        for each in configs
    }
    if len(shared) > 1:
        raise ValueError(
            "The runs differ in task, discount, reward scale or reward shift: "
            f"{sorted(shared, key=str)}. Choose runs in which they are equal."
        )

    def value(state: Tensor, action: Tensor) -> Tensor:
        values = [each.smallest_value(state, action) for each in policies]
        return torch.stack(values).mean(0)

    models = None
    if not critics_only:
        parts = []
        for run, each in zip(runs, policies, strict=True):
            if (file := run_folder_of(run) / MODEL).exists():
                units = each.loc, each.scale, each.low, each.high
                parts.append(EliteNetworks(load_dynamics(file), *units))
        if not parts:
            raise ValueError(f"None of the runs has a model, {MODEL}: train loss=rim.")
        grey = [each for each in parts if each.body is not None]
        models = grey[0] if grey else EliteNetworks.join(parts)
        known = {"terminated": termination(configs[0].env.id, models.limits)}
        options = ({"steps": 40, "hold": 10} if grey else {}) | known | options
    options = {"gamma": configs[0].optim.gamma} | options
    return SwitchingPolicy(policies, models, value, **options)
