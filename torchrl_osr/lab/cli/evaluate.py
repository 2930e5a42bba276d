"""Disturb a trained policy: score lost, survival, and time back to the data.

    torchrl-osr evaluate checkpoint=outputs/hopper-medium-replay/osr-seed0-...
    torchrl-osr evaluate checkpoint=<run's folder> suite=torque episodes=20
    torchrl-osr evaluate checkpoint=<run's folder> suite=recoverable
    torchrl-osr evaluate checkpoint=<run's folder>/checkpoint/policy/best.torchrl
    torchrl-osr evaluate sweep=multirun/20260101-120000 jobs=4
    torchrl-osr evaluate sweep=<folder above runs> switching=true suite=recoverable

The run's folder gets ``robustness-<suite>.json`` with all raw results, and a figure of
the same name; with ``suite=recoverable`` it gets ``recoverable-<half>.json``.
``sweep=`` does this for every run below a folder. With ``switching=true`` these runs
form one policy: the run with the largest predicted return acts. See
``docs/robustness.md``.
"""

from __future__ import annotations

import functools
import multiprocessing
import signal
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import replace
from pathlib import Path
from typing import Any

import hydra
import numpy as np
from omegaconf import DictConfig, OmegaConf

from torchrl_osr.lab.cli.console import sentence, single_job
from torchrl_osr.lab.evaluation import measure_of
from torchrl_osr.lab.evaluation.recoverable import GROUPS, disturbances_of
from torchrl_osr.lab.evaluation.robustness import aligned_columns, robustness_table
from torchrl_osr.lab.evaluation.statistics import saved_share
from torchrl_osr.lab.report.runs import find_runs
from torchrl_osr.lab.run import CONF
from torchrl_osr.lab.run.evaluate import (
    evaluate_files,
    evaluate_run,
    file_name,
    title_of,
)
from torchrl_osr.lab.run.folder import read_status
from torchrl_osr.lab.run.load import checkpoints_of
from torchrl_osr.lab.run.schema import EvaluateConfig, register

register()


@hydra.main(f"{CONF}/evaluation", "evaluate", version_base="1.3")
@single_job
def main(cfg: DictConfig) -> None:
    """Evaluate, unless the results are there already, and print the table."""
    config: Any = OmegaConf.to_object(cfg)
    if config.episodes < 2 or min(config.last, config.jobs) < 1:
        raise ValueError(
            "last and jobs must be at least 1, and episodes at least 2: one pair of "
            "episodes has no interval."
        )
    if (config.checkpoint is None) == (config.sweep is None):
        raise ValueError(
            "give either checkpoint=<a run's folder> or sweep=<a folder above runs>."
        )
    if config.switching and config.sweep is None:
        raise ValueError("switching=true needs sweep=<a folder above runs>.")
    if config.sweep is not None and not config.switching:
        evaluate_sweep(config)
        return
    if config.switching:
        files = [checkpoints_of(run)[-1] for run in finished_runs(config.sweep)]
        path = Path(config.sweep) / f"switching-{file_name(config.suite)}"
        path, results = evaluate_files(config, path, files)
    else:
        path, results = evaluate_run(config)
    if config.suite.half is None:
        print("\n" + robustness_table(title_of(results), results["summary"]))
    else:
        print("\n" + recoverable_table(results))
    print(f"  files  {path}")


def finished_runs(sweep: str) -> list[Path]:
    """Return folders of a sweep's finished runs; print the others."""
    runs = []
    for folder in find_runs([Path(sweep)]):
        try:
            status = read_status(folder)["status"]
        except (OSError, ValueError, KeyError):
            status = "unknown"
        if status == "done":
            runs.append(folder)
        else:
            print(f"left out: {folder}: not finished, its status is {status}")
    if not runs:
        raise ValueError(f"there is no finished run in or below {sweep}.")
    return runs


def evaluate_sweep(config: EvaluateConfig) -> None:
    """Evaluate every finished run below a folder, ``jobs`` at once; print a table."""
    runs = finished_runs(str(config.sweep))
    rows: dict[Path, dict[str, str]] = {}
    failed = []
    # Spawned, for torch's threads do not survive a fork. Ctrl-C ends them in silence.
    workers = ProcessPoolExecutor(
        min(config.jobs, len(runs)),
        multiprocessing.get_context("spawn"),
        functools.partial(signal.signal, signal.SIGINT, signal.SIG_DFL),
    )
    jobs = {workers.submit(evaluate_one_of_many, config, run): run for run in runs}
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
        what = "score, or return, mean over its disturbances that were met"
        if config.suite.half is not None:
            what = f"recovery rate from the {config.suite.half} states, in percent"
        print(f"\nsuite {config.suite.name}: {what}")
        header = ("run", *next(iter(rows.values())))
        print("\n".join(aligned_columns([header, *done])))
    if failed:
        names = ", ".join(map(str, failed))
        raise ValueError(f"{len(failed)} of {len(runs)} runs failed: {names}.")
    print(f"  next   torchrl-osr report {config.sweep}")


def evaluate_one_of_many(config: EvaluateConfig, folder: Path) -> dict[str, str]:
    """Evaluate one run of a sweep: its row of the table."""
    _, results = evaluate_run(replace(config, checkpoint=str(folder), progress=False))
    if config.suite.half is not None:
        found = shares(results)
        return {name: f"{100 * found[name][1]:.0f}" for name in GROUPS if name in found}
    rows = results["summary"]
    measure = measure_of(rows[0])
    # A disturbance that came in no episode says nothing.
    met = [row[measure] for row in rows if row["disturbed_share"]]
    clean = np.mean([row[f"clean_{measure}"] for row in rows])
    disturbed = f"{np.mean(met):.1f}" if met else "never met"
    return {"undisturbed": f"{clean:.1f}", "disturbed": disturbed}


def shares(results: Mapping[str, Any]) -> dict[str, tuple[int, float, float, float]]:
    """Return number of states and recovery rate with interval, by group of states.

    For the recoverable ones they are also by disturbance.
    """
    of_each = "group", "disturbance", "walk"
    group, disturbance, walk = (np.array(results[key]) for key in of_each)
    back = np.mean([each["back"] for each in results["evaluations"]], axis=0)[None]
    rows = {name: group == name for name in GROUPS}
    hard = rows[GROUPS[-1]]
    for name in disturbances_of(disturbance[hard]):
        rows[f"  {name}"] = hard & (disturbance == name)
    return {
        name: (int(chosen.sum()), *saved_share(back[:, chosen], walk[chosen]))
        for name, chosen in rows.items()
        if chosen.any()
    }


def recoverable_table(results: Mapping[str, Any]) -> str:
    """Return the text table of :func:`shares`."""
    header = ("states", "number", "comes back %", "[95 %]")
    rows = [
        (name, str(number), f"{100 * mean:.0f}", f"[{100 * low:.0f}, {100 * high:.0f}]")
        for name, (number, mean, low, high) in shares(results).items()
    ]
    number = len(results["evaluations"])
    title = f"{results['env']} {results['data']}, {results['half']} recoverable states"
    if number > 1:
        title += f": mean of {number} checkpoints"
    return "\n".join([title, *aligned_columns([header, *rows])])


if __name__ == "__main__":
    main()
