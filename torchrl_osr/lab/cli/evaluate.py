"""Disturb a trained policy: score lost, survival, and time back to the data.

    torchrl-osr evaluate checkpoint=outputs/hopper-medium-replay/osr-seed0-...
    torchrl-osr evaluate checkpoint=<run's folder> suite=torque episodes=20
    torchrl-osr evaluate checkpoint=<run's folder> suite=recoverable
    torchrl-osr evaluate checkpoint=<run's folder>/checkpoint/policy/best.torchrl
    torchrl-osr evaluate sweep=multirun/20260101-120000 jobs=4
    torchrl-osr evaluate sweep=<folder above runs> switching=true suite=recoverable

Each of the run's last checkpoints plays pairs of episodes, one of each pair disturbed.
The run's folder gets ``robustness-<suite>.json`` with all raw results, and a figure of
the same name. A killed evaluation continues after its last finished checkpoint. With
``suite=recoverable`` they play from states that others fail from, and the folder gets
``recoverable-<half>.json``. ``sweep=`` does this for every run below a folder; with
``switching=true`` all of them are one policy instead, of which the best run acts. See
``docs/robustness.md``.
"""

from __future__ import annotations

import functools
import json
import multiprocessing
import signal
from concurrent.futures import ProcessPoolExecutor, as_completed
from itertools import count
from pathlib import Path
from typing import Any, TypeGuard

import hydra
import numpy as np
import torch
from numpy.typing import NDArray
from omegaconf import DictConfig, OmegaConf
from torchrl import torchrl_logger

from torchrl_osr._files import (
    CHECKSUM,
    check_checksum,
    checksummed,
    read_json,
    sha256_of,
    write_json,
)
from torchrl_osr.lab.cli import CONF
from torchrl_osr.lab.cli.console import sentence, single_job
from torchrl_osr.lab.data import observation_statistics
from torchrl_osr.lab.evaluation import (
    DataDistance,
    Policy,
    deterministic_policy,
    evaluate_paired,
    measure_of,
    summarize_disturbances,
)
from torchrl_osr.lab.evaluation.figures import robustness_figure
from torchrl_osr.lab.evaluation.recoverable import GROUPS
from torchrl_osr.lab.evaluation.robustness import (
    aligned_columns,
    impossible_disturbances,
    robustness_table,
)
from torchrl_osr.lab.report.runs import find_runs
from torchrl_osr.lab.run import run_folder
from torchrl_osr.lab.run.build import load_data, references_of
from torchrl_osr.lab.run.limits import check_values
from torchrl_osr.lab.run.recoverable import play_states, recoverable_table, shares
from torchrl_osr.lab.run.run_config import flatten
from torchrl_osr.lab.run.suite import (
    impossible_attacks,
    make_disturbances,
    register,
)
from torchrl_osr.lab.run.switching import load_switching_policy
from torchrl_osr.lab.run.trained_run import (
    TrainedRun,
    checkpoints_of,
    load_trained,
    run_folder_of,
)
from torchrl_osr.trainers.progress import Progress

JSON_FORMAT = 1
SEED_STRIDE = 1000  # between checkpoints: no two of them play the same episodes

register()


@hydra.main(f"{CONF}/evaluation", "evaluate", version_base="1.3")
@single_job
def main(cfg: DictConfig) -> None:
    """Evaluate, unless the results are there already, and print the table."""
    check_values(flatten(OmegaConf.to_container(cfg, resolve=True)))
    if min(cfg.last, cfg.jobs, cfg.episodes - 1) < 1:
        raise ValueError(
            f"last and jobs must be at least 1 and episodes at least 2, got "
            f"last={cfg.last}, jobs={cfg.jobs}, episodes={cfg.episodes}: one pair of "
            "episodes has no interval."
        )
    if (cfg.checkpoint is None) == (cfg.sweep is None):
        raise ValueError(
            "give either checkpoint=<a run's folder> or sweep=<a folder above runs>."
        )
    if cfg.switching and cfg.sweep is None:
        raise ValueError("switching=true is for sweep=<a folder above runs>.")
    if cfg.sweep is not None and not cfg.switching:
        evaluate_sweep(cfg)
        return
    path, results = evaluate_switching(cfg) if cfg.switching else evaluate_run(cfg)
    print("\n" + table(cfg, results))
    print(f"  files  {path}")
    if cfg.suite.half is None:
        print(f"         {path.with_suffix('.png')}")


def evaluate_run(cfg: DictConfig) -> tuple[Path, dict[str, Any]]:
    """Evaluate one run or checkpoint: the file of the results, and what is in it."""
    folder, name, files = run_folder_of(cfg.checkpoint), "", [Path(cfg.checkpoint)]
    if files[0].is_dir():
        files = checkpoints_of(folder)[-cfg.last :]
    else:
        name = f"{files[0].stem}-"  # beside the one of the whole run
    return evaluate_files(cfg, folder / f"{name}{file_name(cfg)}", files)


def evaluate_switching(cfg: DictConfig) -> tuple[Path, dict[str, Any]]:
    """The same for the runs of a sweep as one policy, each with its last checkpoint."""
    files = [checkpoints_of(run)[-1] for run in finished_runs(cfg)]
    path = Path(cfg.sweep) / f"switching-{file_name(cfg)}"
    return evaluate_files(cfg, path, files)


def file_name(cfg: DictConfig) -> str:
    """How the names of the results' files end."""
    if cfg.suite.half is None:
        return f"robustness-{cfg.suite.name}.json"
    return f"recoverable-{cfg.suite.half}.json"


def evaluate_files(
    cfg: DictConfig, path: Path, files: list[Path]
) -> tuple[Path, dict[str, Any]]:
    """Evaluate checkpoints, unless ``path`` has the results; return these, too."""
    torchrl_logger.setLevel("WARNING")
    torch.set_num_threads(cfg.num_threads)
    request = requested(cfg, files, path.parent)
    results = results_in(path)
    # Hidden: a part is no result.
    partial = path.with_name(f".{path.stem}.partial.json")
    if cfg.force or not answers(results, request):
        if not cfg.force:
            check_replaced(path, results, request)
        play = evaluate if cfg.suite.half is None else evaluate_states
        together = None
        if cfg.switching:
            together = load_switching_policy(files, trust=cfg.trust)
        results = request | play(cfg, files, partial, request, together)
        write_json(path, results)
    else:
        print(f"{path} is there already; force=true repeats it.")
    partial.unlink(missing_ok=True)
    if cfg.suite.half is not None:
        return path, results
    for name, reason in results.get("left_out", {}).items():
        print(f"left out: {name}: {reason}")
    robustness_figure(
        results["summary"],
        path.with_suffix(".png"),
        title=title(results),
    )
    return path, results


def title(results: dict[str, Any]) -> str:
    """What was played."""
    return (
        f"{results['env']} {results['data']}, suite {results['suite']}: "
        f"{len(results['evaluations'])} x {results['episodes']} pairs of episodes"
    )


def table(cfg: DictConfig, results: dict[str, Any]) -> str:
    """Text table of the results."""
    if cfg.suite.half is None:
        return robustness_table(title(results), results["summary"])
    return recoverable_table(results)


def finished_runs(cfg: DictConfig) -> list[Path]:
    """Folders of a sweep's finished runs; the others are named.

    Raises:
        ValueError: there is none.
    """
    top = Path(cfg.sweep)
    runs = []
    for folder in find_runs([top]):
        try:
            status = run_folder.read_status(folder)["status"]
        except (OSError, ValueError, KeyError):
            status = "unknown"
        if status == "done":
            runs.append(folder)
        else:
            print(f"left out: {folder}: not finished, its status is {status}")
    if not runs:
        raise ValueError(f"there is no finished run in or below {top}.")
    return runs


def evaluate_sweep(cfg: DictConfig) -> None:
    """Evaluate every finished run below a folder, ``jobs`` at once; print a table.

    Raises:
        ValueError: if there is no finished run, or, when all others are done, if some
            could not be evaluated.
    """
    runs = finished_runs(cfg)
    rows: dict[Path, dict[str, str]] = {}
    failed = []
    # Spawned, for torch's threads do not survive a fork. Ctrl-C ends them in silence.
    workers = ProcessPoolExecutor(
        min(cfg.jobs, len(runs)),
        multiprocessing.get_context("spawn"),
        functools.partial(signal.signal, signal.SIGINT, signal.SIG_DFL),
    )
    jobs = {workers.submit(evaluate_one_of_many, cfg, run): run for run in runs}
    try:
        for number, job in enumerate(as_completed(jobs), start=1):
            folder = jobs[job]
            try:
                rows[folder] = job.result()
            except Exception as error:
                failed.append(folder)
                outcome = f"failed: {sentence(error)}"
            else:
                outcome = ", ".join(map(" ".join, rows[folder].items()))
            print(f"{number} of {len(runs)}: {folder}: {outcome}", flush=True)
    finally:
        workers.shutdown(cancel_futures=True)
    done = [(str(run), *rows[run].values()) for run in runs if run in rows]
    if done:
        header = ("run", *next(iter(rows.values())))
        what = "score, or return, mean over its disturbances that were met"
        if cfg.suite.half is not None:
            what = f"percent of the {cfg.suite.half} states that it comes back from"
        print(f"\nsuite {cfg.suite.name}: {what}")
        print("\n".join(aligned_columns([header, *done])))
    if failed:
        names = ", ".join(map(str, failed))
        raise ValueError(f"{len(failed)} of {len(runs)} runs failed: {names}.")
    print(f"  next   torchrl-osr report {cfg.sweep}")


def evaluate_one_of_many(cfg: DictConfig, folder: Path) -> dict[str, str]:
    """Evaluate one run of a sweep: its row of the table."""
    one = cfg.copy()
    one.checkpoint, one.progress = str(folder), False
    _, results = evaluate_run(one)
    if cfg.suite.half is not None:
        found = shares(results)
        return {name: f"{100 * found[name][1]:.0f}" for name in GROUPS if name in found}
    rows = results["summary"]
    measure = measure_of(rows[0])
    # A disturbance that came in no episode says nothing.
    met = [row[measure] for row in rows if row["disturbed_share"]]
    disturbed = f"{np.mean(met):.1f}" if met else "never met"
    clean = np.mean([row[f"clean_{measure}"] for row in rows])
    return {"undisturbed": f"{clean:.1f}", "disturbed": disturbed}


def requested(cfg: DictConfig, files: list[Path], folder: Path) -> dict[str, Any]:
    """Everything that decides the results: settings, checkpoints' digests, versions.

    Checkpoints are named as seen from a folder.
    """
    folder = folder.absolute()
    names = [each.absolute().relative_to(folder).as_posix() for each in files]
    request = {
        "format": JSON_FORMAT,
        "versions": run_folder.package_versions(),
        "suite": cfg.suite.name,
        "checkpoints": dict(zip(names, map(sha256_of, files), strict=True)),
    }
    if cfg.suite.half is not None:  # each state is played once
        return request
    disturbances = OmegaConf.to_container(cfg.suite.disturbances, resolve=True)
    return request | {
        "levels": disturbances,
        "episodes": cfg.episodes,
        "seed": cfg.seed,
    }


def check_replaced(
    path: Path, old: dict[str, Any] | None, request: dict[str, Any]
) -> None:
    """Raise a ValueError if a file has results of other settings, naming these.

    So it does if it has more checkpoints. Results of other checkpoints or versions are
    out of date, and may be replaced.
    """
    settings = {"levels", "episodes", "seed"} & request.keys() & (old or {}).keys()
    other = [
        each for each in sorted(settings) if not answers(old, {each: request[each]})
    ]
    if other:
        raise ValueError(
            f"{path} has results of other settings ({', '.join(other)}): force=true "
            "replaces them; or rename the file."
        )
    kept = (old or {}).get("checkpoints", {})
    if request["checkpoints"].items() < kept.items():
        raise ValueError(
            f"{path} has results of {len(kept)} checkpoints, these "
            f"{len(request['checkpoints'])} among them: force=true replaces them; or "
            "give the same last=, or rename the file."
        )


def results_in(path: Path) -> dict[str, Any] | None:
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


def answers(
    results: dict[str, Any] | None, request: dict[str, Any]
) -> TypeGuard[dict[str, Any]]:
    """Whether results are there, and of this request."""
    if results is None:
        return False
    # Through JSON, like the file: it has no tuples.
    wanted: dict[str, Any] = json.loads(json.dumps(request))
    return wanted.items() <= results.items()


def evaluate(
    cfg: DictConfig,
    files: list[Path],
    partial: Path,
    request: dict[str, Any],
    together: Policy | None,
) -> dict[str, Any]:
    """Play all checkpoints, except those that ``partial`` has already.

    Data, spread and disturbances are those of the first one's run.
    """
    first = load_trained(files[0], trust=cfg.trust)
    run = first.config
    data, _ = load_data(run, progress=cfg.progress)
    distance = DataDistance(data, seed=run.data.seed)
    _, scale = observation_statistics(data)
    begun = results_in(partial)
    evaluations = begun["evaluations"] if answers(begun, request) else []
    if evaluations:
        print(f"{partial} has {len(evaluations)} of {len(files)} checkpoints already.")
    references = references_of(run)
    left_out = impossible(cfg, first, scale.numpy(), together)
    suite = {
        name: config
        for name, config in cfg.suite.disturbances.items()
        if name not in left_out
    }
    if together is not None:
        files = files[:1]
    plays = 1 + len(suite)  # the clean episodes first
    progress = Progress(
        cfg.suite.name, len(files) * plays, bar=cfg.progress, unit="play"
    )
    played = count(len(evaluations) * plays + 1)
    with progress.shown(len(evaluations) * plays):
        for number in range(len(evaluations), len(files)):
            trained = load_trained(files[number], trust=cfg.trust)
            seed = cfg.seed + SEED_STRIDE * number
            alone = deterministic_policy(trained.actor, trained.observation_norm)
            paired = evaluate_paired(
                together or alone,
                run.env.id,
                make_disturbances(suite, trained, scale.numpy(), seed=seed),
                distance,
                num_episodes=cfg.episodes,
                seed=seed,
                references=references,
                advance=lambda: progress.update(next(played)),
            )
            evaluations.append({"step": trained.step} | paired)
            write_json(partial, checksummed(request | {"evaluations": evaluations}))
    return {
        "env": run.env.name,
        "data": run.data.source,
        "threshold": distance.threshold,
        "left_out": left_out,
        "evaluations": evaluations,
        "summary": summarize_disturbances(evaluations),
    }


def evaluate_states(
    cfg: DictConfig,
    files: list[Path],
    partial: Path,
    request: dict[str, Any],
    together: Policy | None,
) -> dict[str, Any]:
    """Play all checkpoints from the recoverable states; takes seconds."""
    del partial, request
    plays = len(files) if together is None else 1
    progress = Progress(cfg.suite.name, plays, bar=cfg.progress, unit="play")
    played = count(1)
    with progress.shown(0):
        return play_states(
            files,
            cfg.suite.half,
            together=together,
            trust=cfg.trust,
            advance=lambda: progress.update(next(played)),
        )


def impossible(
    cfg: DictConfig,
    trained: TrainedRun,
    scale: NDArray[np.floating],
    together: Policy | None = None,
) -> dict[str, str]:
    """Say which disturbances environment or policy lack what it takes for, and why."""
    env_id, configs = trained.config.env.id, cfg.suite.disturbances
    if together is None:
        left_out = impossible_attacks(configs, trained)
    else:
        attacks = (name for name, each in configs.items() if each.attack is not None)
        left_out = dict.fromkeys(attacks, "nobody attacks a choice between policies")
    others = {name: each for name, each in configs.items() if name not in left_out}
    made = make_disturbances(others, trained, scale)
    left_out |= impossible_disturbances(env_id, made)
    if len(left_out) == len(configs):
        raise ValueError(
            f"no disturbance of suite={cfg.suite.name} is possible for {env_id}, "
            f"{'; '.join(sorted(set(left_out.values())))}: choose another suite."
        )
    return left_out


if __name__ == "__main__":
    main()
