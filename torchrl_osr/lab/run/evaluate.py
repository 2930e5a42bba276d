"""Evaluating trained runs: under disturbances, and from recoverable states.

Each of a run's last checkpoints plays pairs of episodes, one of each pair disturbed.
The results are kept as JSON beside the run; a killed evaluation continues after its
last finished checkpoint.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import torch
from hydra.utils import instantiate
from numpy.typing import NDArray
from tensordict import TensorDict
from torchrl import torchrl_logger
from torchrl.modules import TanhNormal

from torchrl_osr._files import (
    CHECKSUM,
    check_checksum,
    checksummed,
    read_json,
    sha256_of,
    write_json,
)
from torchrl_osr.lab.data import observation_statistics
from torchrl_osr.lab.data.environment import environment_id
from torchrl_osr.lab.envs import attacked_policy, critics_of
from torchrl_osr.lab.evaluation import (
    DataDistance,
    Disturbance,
    Policy,
    deterministic_policy,
    evaluate_paired,
    summarize_disturbances,
)
from torchrl_osr.lab.evaluation.figures import robustness_figure
from torchrl_osr.lab.evaluation.recoverable import load_recoverable_states, recovers
from torchrl_osr.lab.evaluation.robustness import impossible_disturbances
from torchrl_osr.lab.run.build import read_environment
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
from torchrl_osr.objectives.networks import CATEGORICAL
from torchrl_osr.trainers.progress import Progress

JSON_FORMAT = 1
SEED_STRIDE = 1000  # between checkpoints: no two of them play the same episodes
DATA_UNIT = "data"
"""As a wrapper's ``unit``: the data's standard deviations."""


def evaluate_run(config: EvaluateConfig) -> tuple[Path, dict[str, Any]]:
    """Evaluate one run or checkpoint: the file of the results, and what is in it."""
    assert config.checkpoint is not None
    path = Path(config.checkpoint)
    folder, name, files = run_folder_of(path), "", [path]
    if path.is_dir():
        files = checkpoints_of(folder)[-config.last :]
    else:
        name = f"{path.stem}-"  # beside the one of the whole run
    return evaluate_files(config, folder / f"{name}{file_name(config.suite)}", files)


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
    found = _results_in(path)
    # Hidden: a part is no result.
    partial_path = path.with_name(f".{path.stem}.partial.json")
    if found is None or config.force or not request.items() <= found.items():
        if found is not None and not config.force:
            _check_replaced(path, found, request)
        together = None
        if config.switching:
            together = load_switching_policy(files, trust=config.trust)
        if config.suite.half is not None:
            played = play_states(config, files, together)
        else:
            played = play_suite(config, files, partial_path, request, together)
        found = request | played
        write_json(path, found)
    else:
        print(f"{path} is there already; force=true repeats it.")
    partial_path.unlink(missing_ok=True)
    for name, reason in found.get("left_out", {}).items():
        print(f"left out: {name}: {reason}")
    if config.suite.half is None:
        figure = path.with_suffix(".png")
        robustness_figure(found["summary"], figure, title=title_of(found))
    return path, found


def title_of(results: Mapping[str, Any]) -> str:
    """Return what was played, for tables and figures."""
    return (
        f"{results['env']} {results['data']}, suite {results['suite']}: "
        f"{len(results['evaluations'])} x {results['episodes']} pairs of episodes"
    )


def play_suite(
    config: EvaluateConfig,
    files: list[Path],
    partial_path: Path,
    request: dict[str, Any],
    together: Policy | None = None,
) -> dict[str, Any]:
    """Play all checkpoints, except those that ``partial_path`` has already.

    Data, spread and disturbances are those of the first one's run. With ``together``,
    one policy of all of them plays.
    """
    first = _opened(files[0], config.trust)
    run = first.config
    data, _ = load_data(run.env, run.data, progress=config.progress)
    distance = DataDistance(data, seed=run.data.seed)
    scale = observation_statistics(data)[1].numpy()
    begun = _results_in(partial_path) or {}
    evaluations = begun["evaluations"] if request.items() <= begun.items() else []
    if evaluations:
        print(f"{partial_path} has {len(evaluations)} of {len(files)} checkpoints.")
    left_out = impossible(config.suite, first, scale, attacks=together is None)
    suite = {
        name: each
        for name, each in config.suite.disturbances.items()
        if name not in left_out
    }
    files = files if together is None else files[:1]
    plays = 1 + len(suite)  # the clean episodes first
    progress = Progress(
        config.suite.name, len(files) * plays, bar=config.progress, unit="play"
    )
    played = count(len(evaluations) * plays + 1)
    with progress.shown(len(evaluations) * plays):
        for number in range(len(evaluations), len(files)):
            trained = load_trained(files[number], trust=config.trust)
            seed = config.seed + SEED_STRIDE * number
            alone = deterministic_policy(trained.actor, trained.observation_norm)
            paired = evaluate_paired(
                together or alone,
                run.env.id,
                make_disturbances(suite, trained, scale, seed=seed),
                distance,
                num_episodes=config.episodes,
                seed=seed,
                references=references_of(run.env),
                advance=lambda: progress.update(next(played)),
            )
            evaluations.append({"step": trained.step} | paired)
            write_json(
                partial_path, checksummed(request | {"evaluations": evaluations})
            )
    return {
        "env": run.env.name,
        "data": run.data.source,
        "threshold": distance.threshold,
        "left_out": left_out,
        "evaluations": evaluations,
        "summary": summarize_disturbances(evaluations),
    }


def play_states(
    config: EvaluateConfig, files: list[Path], together: Policy | None = None
) -> dict[str, Any]:
    """Play all checkpoints from every recoverable state of a task.

    ``back`` of an evaluation has 1 for each state that it came back from, and 0 for
    others.
    """
    half = config.suite.half
    assert half is not None
    run = _opened(files[0], config.trust).config
    states, evaluations = load_recoverable_states(run.env.name, half), []
    if run.env.id != (of := environment_id(run.env.name)):
        raise ValueError(
            f"the recoverable states of {run.env.name} are of {of}, and the run is of "
            f"{run.env.id}."
        )
    for file in files if together is None else files[:1]:
        trained = load_trained(file, trust=config.trust)
        alone = deterministic_policy(trained.actor, trained.observation_norm)
        back = recovers(states, together or alone)
        evaluations.append({"step": trained.step, "back": back.astype(int).tolist()})
    return {
        "env": run.env.name,
        "data": run.data.source,
        "half": half,
        "group": states.group.tolist(),
        "disturbance": states.disturbance,
        "walk": states.walk.tolist(),
        "evaluations": evaluations,
    }


def _opened(file: Path, trust: Sequence[str]) -> TrainedRun:
    """A checkpoint whose environment may be made, and is as it was in training."""
    trained = load_trained(file, trust=trust)
    check_environment(trained.config.env.id, trust)
    read_environment(trained.config.env)
    return trained


# -- disturbances --------------------------------------------------------------------


def make_disturbances(
    configs: Mapping[str, DisturbanceConfig],
    trained: TrainedRun,
    scale: NDArray[np.floating],
    *,
    seed: int = 0,
) -> list[Disturbance]:
    """Build the wrappers and attacks of a suite.

    Args:
        configs: by name.
        trained: its networks are attacked.
        scale: standard deviation of each observation entry in the data, ``[S]``; takes
            the place of a wrapper's ``unit: data``.

    Keyword Args:
        seed: of the attacks' draws. Default 0.
    """
    made = []
    for name, config in configs.items():
        if (config.wrap is None) == (config.attack is None):
            raise ValueError(f"disturbance {name!r} needs either wrap or attack.")
        wrap = policy = None
        if config.wrap is not None:
            wrap = instantiate(config.wrap)
            if wrap.keywords.get("unit") == DATA_UNIT:
                wrap = partial(wrap, unit=scale)
        else:
            policy = attacked_policy(
                trained.actor.get_dist,
                critics_of(trained.loss),
                trained.observation_norm,
                **config.attack,
                seed=seed,
            )
        made.append(Disturbance(name, config.kind, config.strength, wrap, policy))
    return made


def impossible(
    suite: SuiteConfig,
    trained: TrainedRun,
    scale: NDArray[np.floating],
    *,
    attacks: bool = True,
) -> dict[str, str]:
    """Return the disturbances that environment or policy rule out, and why, by name."""
    configs, left_out = suite.disturbances, {}
    for name, config in configs.items():
        if config.attack is None:
            continue
        why = _obstacle(config.attack["kind"], trained) if attacks else ""
        if why or not attacks:
            left_out[name] = why or "attacks do not support switching policies"
    others = {name: each for name, each in configs.items() if name not in left_out}
    made = make_disturbances(others, trained, scale)
    left_out |= impossible_disturbances(trained.config.env.id, made)
    if len(left_out) == len(configs):
        raise ValueError(
            f"no disturbance of suite={suite.name} is possible, "
            f"{'; '.join(sorted(set(left_out.values())))}: choose another suite."
        )
    return left_out


def _obstacle(kind: str, trained: TrainedRun) -> str:
    """Reason why a run's policy cannot be attacked, or nothing."""
    if not trained.config.data.standardize:
        return "attacks need data.standardize=true"
    observation = torch.zeros_like(trained.observation_norm.loc)
    distribution = trained.actor.get_dist(TensorDict({"observation": observation}))
    if isinstance(distribution, CATEGORICAL):
        return "attacks need real actions, and the run's are discrete"
    if kind == "min_Q" and not hasattr(trained.loss, "qvalue_network"):
        return f"min_Q needs critics, and {type(trained.loss).__name__} has none"
    if kind == "action_diff" and not isinstance(distribution, TanhNormal):
        return (
            "action_diff compares tanh-Gaussian distributions, and the policy's is a "
            f"{type(distribution).__name__}"
        )
    return ""


# -- results -------------------------------------------------------------------------


def _requested(
    config: EvaluateConfig, files: list[Path], folder: Path
) -> dict[str, Any]:
    """Everything that decides the results: settings, checkpoints' digests, versions."""
    folder = folder.absolute()
    names = [each.absolute().relative_to(folder).as_posix() for each in files]
    request: dict[str, Any] = {
        "format": JSON_FORMAT,
        "versions": package_versions(),
        "suite": config.suite.name,
        "checkpoints": dict(zip(names, map(sha256_of, files), strict=True)),
    }
    if config.suite.half is None:  # each recoverable state is played once
        levels = asdict(config.suite)["disturbances"]
        request |= {"levels": levels, "episodes": config.episodes, "seed": config.seed}
    made: dict[str, Any] = json.loads(json.dumps(request))  # as the file has it
    return made


def _check_replaced(path: Path, old: dict[str, Any], request: dict[str, Any]) -> None:
    """Raise a ValueError if a file has results of other settings or more checkpoints.

    Results of other checkpoints or versions are out of date, and may be replaced.
    """
    settings = {"levels", "episodes", "seed"} & request.keys() & old.keys()
    if other := sorted(key for key in settings if old[key] != request[key]):
        raise ValueError(
            f"{path} has results of other settings ({', '.join(other)}): force=true "
            "replaces them; or rename the file."
        )
    kept = old.get("checkpoints", {})
    if request["checkpoints"].items() < kept.items():
        raise ValueError(
            f"{path} has results of {len(kept)} checkpoints, these "
            f"{len(request['checkpoints'])} among them: force=true replaces them; or "
            "give the same last=, or rename the file."
        )


def _results_in(path: Path) -> dict[str, Any] | None:
    """Results of an earlier evaluation, if there are any and they are whole."""
    if not path.exists():
        return None
    try:
        results: dict[str, Any] = read_json(path)
        if CHECKSUM in results:
            check_checksum(results, path.name)
    except ValueError as error:
        print(f"{path} is ignored: {error}.")
        return None
    return results
