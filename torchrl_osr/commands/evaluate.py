"""Disturb a trained policy: score lost, survival, and time back to the data.

    torchrl-osr evaluate checkpoint=outputs/hopper-medium-replay/seed0-...
    torchrl-osr evaluate checkpoint=<run's folder> suite=torque episodes=20
    torchrl-osr evaluate checkpoint=<run's folder>/checkpoint/policy/best.torchrl

Each of the run's last checkpoints plays pairs of episodes, one of each pair disturbed.
The run's folder gets ``robustness-<suite>.json`` with all raw results, and a figure of
the same name. A killed evaluation continues after its last finished checkpoint. See
``docs/robustness.md``.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import hydra
import torch
from omegaconf import DictConfig, OmegaConf
from torchrl import torchrl_logger
from tqdm.auto import tqdm

from torchrl_osr._files import (
    CHECKSUM,
    check_checksum,
    checksummed,
    read_json,
    sha256_of,
    write_json,
)
from torchrl_osr.commands import CONF
from torchrl_osr.data import observation_statistics
from torchrl_osr.evaluation import (
    DataDistance,
    deterministic_policy,
    evaluate_paired,
    evaluation_json,
    robustness_figure,
    robustness_table,
    summarize_disturbances,
)
from torchrl_osr.experiment import run_folder
from torchrl_osr.experiment.build import load_data
from torchrl_osr.experiment.limits import check_values
from torchrl_osr.experiment.run_config import flatten
from torchrl_osr.experiment.suite import make_disturbances, register
from torchrl_osr.experiment.trained_run import (
    checkpoints_of,
    load_trained,
    run_folder_of,
)

JSON_FORMAT = 1
SEED_STRIDE = 1000  # between checkpoints: no two of them play the same episodes

register()


@hydra.main(f"{CONF}/evaluation", "evaluate", version_base="1.3")
def main(cfg: DictConfig) -> None:
    """Evaluate, unless the result is there already, and print the table."""
    check_values(flatten(OmegaConf.to_container(cfg, resolve=True)))
    torchrl_logger.setLevel("WARNING")
    torch.set_num_threads(cfg.num_threads)
    if min(cfg.last, cfg.episodes - 1) < 1:
        raise ValueError(
            f"last must be at least 1 and episodes at least 2, got last={cfg.last}, "
            f"episodes={cfg.episodes}: one pair of episodes has no interval."
        )
    folder = run_folder_of(cfg.checkpoint)
    files, name = [Path(cfg.checkpoint)], f"robustness-{cfg.suite.name}"
    if files[0].is_dir():
        files = checkpoints_of(folder)[-cfg.last :]
    else:
        name = f"{files[0].stem}-{name}"  # beside the one of the whole run
    path = folder / f"{name}.json"
    request = requested(cfg, files)
    results = results_in(path, request)
    # Hidden: a part is no result.
    partial = path.with_name(f".{name}.partial.json")
    if cfg.force or results is None:
        results = request | evaluate(cfg, files, partial, request)
        write_json(path, results)
    else:
        print(f"{path} is there already; force=true repeats it.")
    partial.unlink(missing_ok=True)
    figure = path.with_suffix(".png")
    title = (
        f"{results['env']} {results['data']}, suite {cfg.suite.name}: "
        f"{len(files)} x {cfg.episodes} pairs of episodes"
    )
    robustness_figure(results["summary"], results["evaluations"], figure, title=title)
    print("\n" + robustness_table(title, results["summary"]))
    print(f"  files  {path}\n         {figure}")


def requested(cfg: DictConfig, files: list[Path]) -> dict[str, Any]:
    """Everything that decides the results: settings, checkpoints' digests, versions."""
    return {
        "format": JSON_FORMAT,
        "versions": run_folder.package_versions(),
        "suite": cfg.suite.name,
        "levels": OmegaConf.to_container(cfg.suite.disturbances, resolve=True),
        "episodes": cfg.episodes,
        "seed": cfg.seed,
        "checkpoints": {file.name: sha256_of(file) for file in files},
    }


def results_in(path: Path, request: dict[str, Any]) -> dict[str, Any] | None:
    """Results of an earlier evaluation with the same request, if there are any."""
    if not path.exists():
        return None
    try:
        results = read_json(path)
        if CHECKSUM in results:
            check_checksum(results, path.name)
    except ValueError as error:
        print(f"{path} is ignored: {error}.")
        return None
    # Through JSON, like the file: it has no tuples.
    same = json.loads(json.dumps(request)).items() <= results.items()
    return results if same else None


def evaluate(
    cfg: DictConfig, files: list[Path], partial: Path, request: dict[str, Any]
) -> dict[str, Any]:
    """Play all checkpoints of one run, except those that ``partial`` has already."""
    run = load_trained(files[0], trust=cfg.trust).config
    data, _ = load_data(run, progress=cfg.progress)
    distance = DataDistance(data, seed=run.data.seed)
    _, scale = observation_statistics(data)
    begun = results_in(partial, request) or {"evaluations": []}
    evaluations = begun["evaluations"]
    if evaluations:
        print(f"{partial} has {len(evaluations)} of {len(files)} checkpoints already.")
    plays = 1 + len(cfg.suite.disturbances)  # the clean episodes first
    bar = tqdm(
        initial=len(evaluations) * plays,
        total=len(files) * plays,
        desc=cfg.suite.name,
        unit="play",
        disable=None if cfg.progress else True,  # None: silent off a terminal
    )
    with bar:
        for number in range(len(evaluations), len(files)):
            trained = load_trained(files[number], trust=cfg.trust)
            seed = cfg.seed + SEED_STRIDE * number
            paired = evaluate_paired(
                deterministic_policy(trained.actor, trained.observation_norm),
                run.env.id,
                make_disturbances(
                    cfg.suite.disturbances, trained, scale.numpy(), seed=seed
                ),
                distance,
                num_episodes=cfg.episodes,
                seed=seed,
                advance=bar.update,
            )
            evaluations.append(evaluation_json(trained.step, paired, run.env.name))
            begun = checksummed(request | {"evaluations": evaluations})
            write_json(partial, begun)
    return {
        "env": run.env.name,
        "data": run.data.quality,
        "threshold": distance.threshold,
        "evaluations": evaluations,
        "summary": summarize_disturbances(evaluations),
    }


if __name__ == "__main__":
    main()
