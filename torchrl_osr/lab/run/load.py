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
from torchrl_osr.lab.dynamics.training import FILE, load_dynamics
from torchrl_osr.lab.run.build import Learner, make_learner
from torchrl_osr.lab.run.config import CONFIG, read_run
from torchrl_osr.lab.run.schema import TrainConfig
from torchrl_osr.policy import Policy, load_policy, policy_from_loss
from torchrl_osr.trainers.checkpoints import find_damage, safe_checkpoint

CHECKPOINTS = Path("checkpoint") / "policy"
"""Folder of the policy's checkpoints, in the run's folder."""

POLICY = "policy.safetensors"
"""The exported policy, in the run's folder."""


class TrainedRun(NamedTuple):
    """One checkpoint of a run, on the CPU.

    Attributes:
        config: the run's configuration.
        actor: the policy, with the average of its weights (``optim.policy_average``).
        inverse_dynamics: the frozen model that taught the policy, or ``None``.
        loss: holds the critics, too.
        observation_norm: standardisation of the networks' observations.
        step: gradient steps of the checkpoint.
        path: of the checkpoint's file.
    """

    config: TrainConfig
    actor: ProbabilisticTensorDictSequential
    inverse_dynamics: ProbabilisticTensorDictSequential | None
    loss: LossModule
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
            f"{path} is not of a run: there is no {CONFIG} in {folder}. Give the "
            f"folder of a run, or a file in its {CHECKPOINTS}."
        )
    return folder


def checkpoints_of(folder: Path | str) -> list[Path]:
    """Return the checkpoints that a run has kept, oldest first, without the best."""
    found = sorted((run_folder_of(folder) / CHECKPOINTS).glob("checkpoint-*.torchrl"))
    if not found:
        raise FileNotFoundError(f"the run in {folder} has no checkpoint yet.")
    return found


def load_trained(path: Path | str, *, trust: Sequence[str] = ()) -> TrainedRun:
    """Load one checkpoint, weights only: no code from the file is run.

    No environment is made, and torch's global generator is left as it was.

    Args:
        path: a checkpoint's file in its run's folder, or the folder for the newest.

    Keyword Args:
        trust: modules of your own that the run's configuration may name, see
            :func:`~torchrl_osr.lab.run.config.check_targets`. Default: none.

    Raises:
        FileNotFoundError: if there is no run or no checkpoint.
        CheckpointError: if the file is damaged, or does not fit the run's
            configuration; tensors of another shape are named.
        ValueError: if the configuration is refused.
    """
    config = read_run(run_folder_of(path), trust)
    path = checkpoints_of(path)[-1] if Path(path).is_dir() else Path(path)
    if damage := find_damage(path):
        raise CheckpointError(
            f"checkpoint {path} is damaged: {damage}. Take another one of the run."
        )
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
    try:
        manifest = checkpoint.load(path, map_location="cpu").manifest
    except CheckpointError as error:
        raise CheckpointError(
            f"{path} does not fit the {CONFIG} of its run: {error} Take both from one "
            "run.",
            error.result,
        ) from error
    learner.actor.load_state_dict(average.module.state_dict())
    numbered = re.fullmatch(r"checkpoint-(\d+)\.torchrl", path.name)
    step = int(numbered[1]) if numbered else int(manifest["metadata"]["step"])
    actor, model, loss, _ = learner
    return TrainedRun(config, actor, model, loss, norm, step, path)


def load_run_policy(path: Path | str, trust: Sequence[str] = ()) -> Policy:
    """Load the policy of a run's folder, of a checkpoint in it, or of a saved file.

    A finished run has exported its policy: nothing is built from its configuration.
    """
    path = Path(path)
    if path.is_dir() and (path / POLICY).exists():
        path = path / POLICY
    if path.suffix == Path(POLICY).suffix:
        return load_policy(path)
    return policy_of(load_trained(path, trust=trust))


def policy_of(run: TrainedRun) -> Policy:
    """Copy the policy of a run, in the units of its environment."""
    config = run.config
    low, high = config.env.action_low, config.env.action_high
    return policy_from_loss(
        run.loss,
        run.observation_norm,
        low=-1.0 if low is None else low,
        high=1.0 if high is None else high,
        source={
            "env_id": config.env.id,
            "step": run.step,
            "checkpoint": run.path.name,
            "seed": config.seed,
            "discount": config.optim.gamma,
            # Without the place of a log on this machine.
            "data": asdict(config.data) | {"path": None},
        },
    )


def load_switching_policy(
    runs: Sequence[Path | str],
    *,
    critics_only: bool = False,
    trust: Sequence[str] = (),
    **options: Any,
) -> SwitchingPolicy:
    """Combine runs of a task to one policy, in the environment's units, on the CPU.

    Each run's policy is rolled out in the models of all runs, and the mean of all runs'
    critics values its last state. Several seeds of ``loss=rim`` have all parts.

    Args:
        runs: folders, or checkpoints in them.

    Keyword Args:
        critics_only: use no models.
        trust: modules of your own that a run may name.
        options: ``steps`` and ``hold`` of
            :class:`~torchrl_osr.lab.dynamics.SwitchingPolicy`.

    Raises:
        FileNotFoundError: there is no such run, or it has no model.
        ValueError: the runs differ in task, discount or units of reward, have discrete
            actions, or lack critics.
    """
    trained = [load_trained(each, trust=trust) for each in runs]
    policies = [policy_of(run) for run in trained]
    configs = [run.config for run in trained]
    for run, policy in zip(runs, policies, strict=True):
        if policy.discrete or not policy.critics:
            raise ValueError(
                f"{run} has discrete actions or no critics: choose other runs."
            )
    numbers: dict[str, set[Any]] = {
        "env.id": {each.env.id for each in configs},
        "optim.gamma": {each.optim.gamma for each in configs},
        "data.reward_scale": {each.data.reward_scale for each in configs},
        "data.reward_shift": {each.data.reward_shift for each in configs},
    }
    for name, found in numbers.items():
        if len(found) > 1:
            raise ValueError(
                f"The runs differ in {name}: {sorted(found)}. Choose runs of one task, "
                "with the same discount and units of reward."
            )

    def value(state: Tensor, action: Tensor) -> Tensor:
        values = [each.smallest_value(state, action) for each in policies]
        return torch.stack(values).mean(0)

    def networks(run: Path | str, policy: Policy) -> EliteNetworks:
        file = run_folder_of(run) / FILE
        if not file.exists():
            raise FileNotFoundError(
                f"{file} does not exist: train with loss=rim or dynamics=ensemble, or "
                "choose with critics_only=True."
            )
        model = load_dynamics(file)
        return EliteNetworks(model, policy.loc, policy.scale, policy.low, policy.high)

    models = None
    if not critics_only:
        models = EliteNetworks.join([*map(networks, runs, policies)])
    config = configs[0]
    return SwitchingPolicy(
        policies,
        models,
        value,
        terminated=config.dynamics.termination(config.env.id),
        gamma=config.optim.gamma,
        **options,
    )
