"""A policy that copies the networks of a run's checkpoint; no environment is made."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from omegaconf import OmegaConf

from torchrl_osr.lab.run.trained_run import (
    checkpoints_of,
    load_trained,
    run_folder_of,
    saved_sizes,
)
from torchrl_osr.policy import Policy, load_policy, policy_from_loss
from torchrl_osr.policy.policy import SUFFIX


def load_run_policy(path: Path | str, trust: Sequence[str] = ()) -> Policy:
    """Load the policy of a run's folder, of a checkpoint in it, or of a saved file."""
    path = Path(path)
    if path.suffix == SUFFIX:
        return load_policy(path)
    return policy_from_run(path, trust)


def policy_from_run(path: Path, trust: Sequence[str] = ()) -> Policy:
    """Policy of a run's folder or checkpoint, see :func:`load_run_policy`."""
    folder = run_folder_of(path)
    path = checkpoints_of(folder)[-1] if path.is_dir() else path
    trained = load_trained(path, sizes=saved_sizes(path), trust=trust)
    config = trained.config
    source = {
        "env_id": config.env.id,
        "step": trained.step,
        "checkpoint": f"{folder.name}/{path.name}",
        "seed": config.seed,
        "discount": config.optim.gamma,
        "data": OmegaConf.to_container(config.data),
    }
    low, high = config.env.get("action_low"), config.env.get("action_high")
    return policy_from_loss(
        trained.loss,
        trained.observation_norm,
        low=-1.0 if low is None else list(low),
        high=1.0 if high is None else list(high),
        source=source,
    )
