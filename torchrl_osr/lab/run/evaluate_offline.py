"""Evaluating runs on their data, without a simulator."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torchrl import torchrl_logger

from torchrl_osr._files import read_json, sha256_of, write_json
from torchrl_osr.lab.data.recording import NO_REWARDS, has_rewards
from torchrl_osr.lab.evaluation import deterministic_policy
from torchrl_osr.lab.evaluation.offline import episode_values, fitted_values
from torchrl_osr.lab.evaluation.statistics import interval, nested_resamples
from torchrl_osr.lab.run.data import load_data
from torchrl_osr.lab.run.folder import package_versions
from torchrl_osr.lab.run.load import load_trained, run_folder_of

FILE = "offline_evaluation.json"
"""Result of a run's last checkpoint, in its folder; others have the name in front."""


def evaluate_offline(
    path: Path,
    *,
    steps: int,
    discount: float | None = None,
    seed: int = 0,
    data: str | None = None,
    trust: Sequence[str] = (),
) -> dict[str, Any]:
    """Estimate the value of a run's policy by fitted Q evaluation on the run's data.

    The run's folder keeps the result, which the same call then returns at once.

    Args:
        path: a run's folder, which stands for its last checkpoint, or a checkpoint.

    Keyword Args:
        steps, seed: of the training of the critics.
        discount: default: that of the run.
        data: place of the data, if they have been moved.
        trust: modules of yours that the run may name.
    """
    torchrl_logger.setLevel("WARNING")
    trained = load_trained(path, trust=trust)
    # Without its simulator: the run knows sizes and bounds.
    env, options = replace(trained.config.env, id=None), trained.config.data
    options.path = data or options.path
    gamma = trained.config.optim.gamma if discount is None else discount
    request = {
        "versions": package_versions(),
        "checkpoint": sha256_of(trained.path),
        "data": options.checksum,
        "discount": gamma,
        "steps": steps,
        "seed": seed,
    }
    name = FILE if path.is_dir() else f"{path.stem}-{FILE}"
    file = run_folder_of(path) / name
    if file.exists() and request.items() <= (known := read_json(file)).items():
        return known
    rows, manifest = load_data(env, options)
    if not has_rewards(manifest):
        raise ValueError(f"{path} cannot be evaluated on its data. {NO_REWARDS}")
    policy = deterministic_policy(trained.actor, trained.observation_norm)
    torch.set_num_threads(trained.config.trainer.num_threads)
    values = fitted_values(rows, policy, gamma=gamma, steps=steps, seed=seed)
    recorded = episode_values(rows, gamma)
    found = interval(values.mean(), nested_resamples([*values[..., None]])[:, 0])
    results = request | {
        "env": env.name,
        "source": options.source,
        "step": trained.step,
        "episodes": len(recorded),
        "value": found.mean,
        "value_low": found.low,
        "value_high": found.high,
        "value_of_critics": values.mean(1).tolist(),
        "data_value": recorded.mean(),
    }
    write_json(file, results)
    return results
