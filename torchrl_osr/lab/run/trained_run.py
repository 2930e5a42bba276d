"""Loading a trained policy from the folder of its run."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from omegaconf import DictConfig
from tensordict.nn import ProbabilisticTensorDictSequential
from torch.optim.swa_utils import AveragedModel
from torchrl.checkpoint import CheckpointError
from torchrl.envs import ObservationNorm
from torchrl.objectives import LossModule

from torchrl_osr.lab.run.build import Learner, make_learner
from torchrl_osr.lab.run.run_config import read_config, read_run
from torchrl_osr.lab.run.run_folder import CONFIG
from torchrl_osr.trainers.checkpoints import find_damage, safe_checkpoint

CHECKPOINTS = Path("checkpoint") / "policy"
"""Folder of the policy's checkpoints, in the run's folder."""


class TrainedRun(NamedTuple):
    """One checkpoint of a run, on the CPU.

    Attributes:
        config: the run's configuration.
        actor: the policy, with the average of its weights (``optim.policy_average``).
        inverse_dynamics: the model that taught the policy, with its frozen
            parameters; ``None`` if there was none, as in CQL and SAC-N.
        loss: holds the critics, too.
        observation_norm: standardisation of the networks' observations.
        step: gradient steps of the checkpoint.
        path: of the checkpoint's file.
        folder: of the run.
    """

    config: DictConfig
    actor: ProbabilisticTensorDictSequential
    inverse_dynamics: ProbabilisticTensorDictSequential | None
    loss: LossModule
    observation_norm: ObservationNorm
    step: int
    path: Path
    folder: Path


def run_folder_of(path: Path | str) -> Path:
    """Folder of the run that a checkpoint, or the folder itself, belongs to.

    Raises:
        FileNotFoundError: if nothing is there, or no run.
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"there is no run and no checkpoint at {path}.")
    folder = path if path.is_dir() else path.absolute().parent.parent.parent
    if not (folder / CONFIG).exists():
        raise FileNotFoundError(
            f"{path} is no run's: there is no {CONFIG} in {folder}. Give the folder of "
            f"a run, or a file in its {CHECKPOINTS}."
        )
    return folder


def checkpoints_of(folder: Path | str) -> list[Path]:
    """Checkpoints of the policy that a run has kept, oldest first.

    Without ``best.torchrl``, which was saved besides them.

    Raises:
        FileNotFoundError: if there is no run, or it has no checkpoint yet.
    """
    folder = run_folder_of(folder)
    found = sorted((folder / CHECKPOINTS).glob("checkpoint-*.torchrl"))
    if not found:
        raise FileNotFoundError(
            f"the run in {folder} has no checkpoint of its policy in {CHECKPOINTS}."
        )
    return found


def load_trained(
    path: Path | str,
    *,
    sizes: tuple[int, int] | None = None,
    trust: Sequence[str] = (),
) -> TrainedRun:
    """Load one checkpoint, weights only: no code from the file is run.

    torch's global generator is left as it was.

    Args:
        path: a checkpoint's file in its run's folder, or the folder for the newest.

    Keyword Args:
        sizes: of observation and action. Default: those of the run's environment,
            which is made for that.
        trust: modules of your own that the run's configuration may name, see
            :func:`~torchrl_osr.lab.run.run_config.check_targets`. Default: none.

    Raises:
        FileNotFoundError: if there is no run or no checkpoint.
        CheckpointError: if the file is damaged, or does not fit the run's
            configuration; tensors of another shape are named.
        ValueError: if :func:`~torchrl_osr.lab.run.run_config.read_run` refuses the
            configuration, or no policy can be built from it.
    """
    folder = run_folder_of(path)
    path = checkpoints_of(path)[-1] if Path(path).is_dir() else Path(path)
    _check_whole(path)
    config = read_run(folder / CONFIG, trust)
    observation_size, action_size = sizes or _environment_sizes(config.env.id)
    with torch.random.fork_rng(devices=[]):
        actor, model, loss, objective = _learner(
            config, observation_size, action_size, folder
        )
    shape = (observation_size,) if config.data.standardize else ()
    norm = ObservationNorm(
        torch.zeros(shape), torch.ones(shape), in_keys=["observation"],
        standard_normal=True,
    )  # fmt: skip
    average = AveragedModel(actor)
    checkpoint = safe_checkpoint(
        loss_module=objective, observation_norm=norm, policy_average=average
    )
    try:
        manifest = checkpoint.load(path, map_location="cpu").manifest
    except CheckpointError as error:
        raise CheckpointError(
            f"{path} does not fit {folder / CONFIG}: {error} Take both from one run.",
            error.result,
        ) from error
    actor.load_state_dict(average.module.state_dict())
    numbered = re.fullmatch(r"checkpoint-(\d+)\.torchrl", path.name)
    step = int(numbered[1]) if numbered else int(manifest["metadata"]["step"])
    # The objective's parameters of actor and model are their own tensors.
    return TrainedRun(config, actor, model, loss, norm, step, path, folder)


def _learner(
    config: DictConfig, observation_size: int, action_size: int, folder: Path
) -> Learner:
    try:
        return make_learner(config, observation_size, action_size)
    # The file may name any of our functions in the place of any other.
    except Exception as error:
        raise ValueError(
            f"no policy can be built from {folder / CONFIG} "
            f"({type(error).__name__}: {error}). Take the file that torchrl-osr train "
            "has written."
        ) from error


def saved_sizes(path: Path) -> tuple[int, int]:
    """Sizes of observation and action that a checkpoint's networks were trained for.

    Raises:
        CheckpointError: it is damaged, holds no actor, or tells no size of actions.
    """
    _check_whole(path)
    state = _State()
    safe_checkpoint(loss_module=state).load(path, map_location="cpu")
    weights = {
        name: [
            each for key, each in state.tensors.items()
            # Where a recovery term was added, the loss is a part of what was trained.
            if key.removeprefix("loss.").startswith(f"{name}_network_params.")
            and key.endswith(".weight")
        ]
        for name in ("actor", "qvalue")
    }  # fmt: skip
    if not weights["actor"]:
        raise CheckpointError(f"{path} holds no actor.")
    observation_size = weights["actor"][0].shape[-1]
    if not weights["qvalue"]:  # as in behaviour cloning
        low = read_config(run_folder_of(path) / CONFIG).env.action_low
        if low is None:
            raise CheckpointError(f"{path} holds no critics, and its run no bounds.")
        return observation_size, len(low)
    values, read = weights["qvalue"][-1].shape[-2], weights["qvalue"][0].shape[-1]
    # Critics of discrete actions read none, and value all of them.
    return observation_size, read - observation_size or values


class _State:
    """A component of a checkpoint as it was saved, of any shapes."""

    def state_dict(self) -> dict[str, Any]:
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.tensors = state


def _check_whole(path: Path) -> None:
    damage = find_damage(path)
    if damage is not None:
        raise CheckpointError(
            f"checkpoint {path} is damaged: {damage}. Take another one of the run, or "
            "a whole copy."
        )


def _environment_sizes(env_id: str) -> tuple[int, int]:
    from torchrl_osr.lab.data import environment_spec  # needs Gymnasium

    spec = environment_spec(env_id)
    return spec.observation_size, spec.action_size
