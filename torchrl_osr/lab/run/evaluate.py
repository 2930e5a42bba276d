"""Evaluating trained runs: under disturbances, and from recoverable states.

Each of a run's last checkpoints plays pairs of episodes, one of each pair disturbed.
The run's folder keeps the results as JSON, with the settings that decide them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from hydra.utils import instantiate
from numpy.typing import NDArray
from torch import Tensor
from torchrl import torchrl_logger

from torchrl_osr._files import check_writable, read_json, sha256_of, write_json
from torchrl_osr.lab.data import observation_statistics
from torchrl_osr.lab.data.environment import known_ids
from torchrl_osr.lab.dynamics import SwitchingPolicy
from torchrl_osr.lab.evaluation import (
    DataDistance,
    Disturbance,
    UnitPolicy,
    deterministic_policy,
    evaluate_paired,
)
from torchrl_osr.lab.evaluation.recoverable import load_recoverable_states, recovers
from torchrl_osr.lab.evaluation.robustness import impossible_disturbances
from torchrl_osr.lab.run.build import set_sizes_from_environment
from torchrl_osr.lab.run.config import check_environment
from torchrl_osr.lab.run.data import load_data, references_of
from torchrl_osr.lab.run.folder import package_versions
from torchrl_osr.lab.run.load import (
    TrainedRun,
    checkpoints_of,
    load_switching_policy,
    load_trained,
    run_folder_of,
)
from torchrl_osr.lab.run.schema import DisturbanceConfig, EvaluateConfig, SuiteConfig
from torchrl_osr.trainers.progress import progress_bar

SEED_STRIDE = 1000
"""Between checkpoints: no two of them play the same episodes."""

Player = tuple[TrainedRun, UnitPolicy]
"""A checkpoint, and the policy that plays."""


def evaluate_run(config: EvaluateConfig) -> tuple[Path, dict[str, Any]]:
    """Evaluate one run or checkpoint: the file of the results, and what is in it."""
    assert config.checkpoint is not None
    path = Path(config.checkpoint)
    name, files = file_name(config.suite), [path]
    if path.is_dir():
        files = checkpoints_of(path)[-config.last :]
    else:
        name = f"{path.stem}-{name}"  # another file than that of the whole run
    return evaluate_files(config, run_folder_of(path) / name, files)


def file_name(suite: SuiteConfig) -> str:
    """Return how the names of the results' files end."""
    if suite.half is None:
        return f"robustness-{suite.name}.json"
    return f"recoverable-{suite.half}.json"


def evaluate_files(
    config: EvaluateConfig, path: Path, files: list[Path]
) -> tuple[Path, dict[str, Any]]:
    """Evaluate checkpoints, unless ``path`` has the results; return these, too."""
    torchrl_logger.setLevel("WARNING")
    torch.set_num_threads(config.num_threads)
    request = _requested(config, files, path.parent)
    if path.exists() and not config.force:
        results = read_json(path)
        if other := [key for key in request if request[key] != results.get(key)]:
            raise ValueError(
                f"{path} has results of other {', '.join(other)}: force=true replaces "
                "them; or rename the file."
            )
        print(f"{path} is there already; force=true repeats it.")
    else:
        check_writable(path.parent)
        play = play_suite if config.suite.half is None else play_states
        results = request | play(config, players_of(config, files))
        write_json(path, results)
    for name, reason in results.get("left_out", {}).items():
        print(f"left out: {name}: {reason}")
    return path, results


def players_of(config: EvaluateConfig, files: list[Path]) -> list[Player]:
    """Load what plays: the policy of each checkpoint, or one that switches between all.

    The environment is checked: it may be made, and is as it was in training.
    """
    trained = [load_trained(file, trust=config.trust) for file in files]
    env = trained[0].config.env
    check_environment(env.id, config.trust)
    set_sizes_from_environment(env)
    if config.switching:
        policy = load_switching_policy(files, trust=config.trust)
        bounds = torch.tensor([env.action_low, env.action_high])
        return [(trained[0], UnitActions(policy, bounds))]
    return [
        (each, deterministic_policy(each.actor, each.observation_norm))
        for each in trained
    ]


class UnitActions:
    """A switching policy with actions from -1 to 1, which an evaluator expects."""

    def __init__(self, policy: SwitchingPolicy, bounds: Tensor) -> None:
        self.policy, self.reset = policy, policy.reset
        self.center, self.half = bounds.mean(0), bounds.diff(dim=0)[0] / 2

    def __call__(self, observation: Tensor) -> Tensor:
        return (self.policy(observation) - self.center) / self.half


def play_suite(config: EvaluateConfig, players: list[Player]) -> dict[str, Any]:
    """Play under all disturbances; data and task are those of the first player."""
    first, _ = players[0]
    run = first.config
    run.data.path = config.data.path or run.data.path
    data, _ = load_data(run.env, run.data, progress=config.progress)
    distance = DataDistance(data, seed=run.data.seed)
    scale = observation_statistics(data)[1].numpy()
    suite = make_disturbances(config.suite.disturbances, scale)
    left_out = impossible_disturbances(str(run.env.id), suite)
    suite = [each for each in suite if each.name not in left_out]
    if not suite:
        raise ValueError(
            f"no disturbance of suite={config.suite.name} is possible, "
            f"{'; '.join(sorted({*left_out.values()}))}: choose another suite."
        )
    plays = len(players) * (1 + len(suite))  # the clean episodes first
    shown = progress_bar(config.suite.name, plays, unit="play", bar=config.progress)
    evaluations = []
    play = partial(
        evaluate_paired, num_episodes=config.episodes, references=references_of(run.env)
    )
    with shown as bar:
        for n, (trained, policy) in enumerate(players):
            options = {"seed": config.seed + SEED_STRIDE * n, "advance": bar.update}
            paired = play(policy, str(run.env.id), suite, distance, **options)
            evaluations.append({"step": trained.step} | paired)
    return {
        "env": run.env.name,
        "data": run.data.source,
        "threshold": distance.threshold,
        "left_out": left_out,
        "evaluations": evaluations,
    }


def play_states(config: EvaluateConfig, players: list[Player]) -> dict[str, Any]:
    """Play from every recoverable state; ``back`` has 1 for each with a recovery."""
    run, half = players[0][0].config, config.suite.half
    assert half is not None
    states = load_recoverable_states(run.env.name, half)
    if run.env.id != (wanted := known_ids()[run.env.name]):
        raise ValueError(f"the states are of {wanted}, the run is of {run.env.id}.")
    evaluations, name = [], config.suite.name
    with progress_bar(name, len(players), unit="play", bar=config.progress) as bar:
        for each, policy in players:
            back = recovers(states, policy).astype(int).tolist()
            evaluations.append({"step": each.step, "back": back})
            bar.update()
    return {
        "env": run.env.name,
        "data": run.data.source,
        "half": half,
        "group": states.group.tolist(),
        "disturbance": states.disturbance,
        "walk": states.walk.tolist(),
        "evaluations": evaluations,
    }


def make_disturbances(
    configs: Mapping[str, DisturbanceConfig], scale: NDArray[np.floating]
) -> list[Disturbance]:
    """Build the wrappers of a suite.

    ``scale``, the deviation of each observation entry in the data ``[S]``, takes the
    place of a wrapper's ``unit: data``.
    """
    made = []
    for name, config in configs.items():
        wrap = instantiate(config.wrap)
        if wrap.keywords.get("unit") == "data":
            wrap = partial(wrap, unit=scale)
        made.append(Disturbance(name, config.kind, wrap))
    return made


def _requested(
    config: EvaluateConfig, files: list[Path], folder: Path
) -> dict[str, Any]:
    """Return all that decides the results: settings, checkpoints' digests, versions."""
    names = [each.absolute().relative_to(folder.absolute()) for each in files]
    digests = map(sha256_of, files)
    request: dict[str, Any] = {
        "versions": package_versions(),
        "suite": config.suite.name,
        "checkpoints": dict(zip(map(Path.as_posix, names), digests, strict=True)),
    }
    if config.suite.half is None:  # each recoverable state is played once
        levels = asdict(config.suite)["disturbances"]
        request |= {"levels": levels, "episodes": config.episodes, "seed": config.seed}
    return request
