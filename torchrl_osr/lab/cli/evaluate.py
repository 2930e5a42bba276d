"""Disturb a trained policy; ``conf/evaluation/evaluate.yaml`` has the help."""

from __future__ import annotations

import multiprocessing
import shlex
import signal
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import replace
from pathlib import Path
from typing import Any

import hydra
from omegaconf import DictConfig, OmegaConf

from torchrl_osr.lab.cli.console import sentence, single_job
from torchrl_osr.lab.evaluation.tables import aligned_columns
from torchrl_osr.lab.report.runs import find_runs, saved_states, suite_episodes
from torchrl_osr.lab.report.tables import recovery_table, robustness_table, text
from torchrl_osr.lab.run import CONF
from torchrl_osr.lab.run.evaluate import evaluate_files, evaluate_run, file_name
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
            "last and jobs must be at least 1, and episodes at least 2: a single pair "
            "of episodes has no interval."
        )
    if (config.checkpoint is None) == (config.sweep is None):
        raise ValueError(
            "give either checkpoint=<a run's folder> or sweep=<a folder above runs>."
        )
    if config.switching:
        if config.sweep is None:
            raise ValueError("switching=true needs sweep=<a folder above runs>.")
        files = [checkpoints_of(run)[-1] for run in finished_runs(config.sweep)]
        path = Path(config.sweep) / f"switching-{file_name(config.suite)}"
        path, results = evaluate_files(config, path, files)
    elif config.sweep is not None:
        evaluate_sweep(config)
        return
    else:
        path, results = evaluate_run(config)
    table = disturbance_table if config.suite.half is None else recoverable_table
    print(f"\n{table(results)}\n  files  {path}")


def finished_runs(sweep: str) -> list[Path]:
    """Return folders of a sweep's finished runs; print the others."""
    runs = []
    for folder in find_runs([Path(sweep)]):
        if (status := read_status(folder)["status"]) == "done":
            runs.append(folder)
        else:
            print(f"left out: {folder}: not finished, its status is {status}")
    if not runs:
        raise ValueError(f"there is no finished run in or below {sweep}.")
    return runs


def evaluate_sweep(config: EvaluateConfig) -> None:
    """Evaluate every finished run below a folder, ``jobs`` at once."""
    runs = finished_runs(str(config.sweep))
    failed = []
    # Spawned: torch's threads do not survive a fork. Ctrl-C ends them in silence.
    spawn = multiprocessing.get_context("spawn")
    ends = signal.SIGINT, signal.SIG_DFL
    pool = ProcessPoolExecutor(min(config.jobs, len(runs)), spawn, signal.signal, ends)
    jobs = {}
    for run in runs:
        one = replace(config, checkpoint=str(run), progress=False)
        jobs[pool.submit(evaluate_run, one)] = run
    try:
        for number, job in enumerate(as_completed(jobs), start=1):
            try:
                outcome = str(job.result()[0])
            except Exception as error:
                failed.append(str(jobs[job]))
                outcome = f"failed: {sentence(error)}"
            print(f"{number} of {len(runs)}: {jobs[job]}: {outcome}", flush=True)
    finally:
        pool.shutdown(cancel_futures=True)
    if failed:
        raise ValueError(
            f"{len(failed)} of {len(runs)} runs failed: {', '.join(failed)}."
        )
    print(
        f"  next   torchrl-osr report {shlex.quote(Path(str(config.sweep)).as_posix())}"
    )


def plain(cell: Any) -> str:
    """Format a cell in characters that every terminal has."""
    return text(cell).removesuffix(" ᵉ").replace("\N{MINUS SIGN}", "-")


def disturbance_table(results: Mapping[str, Any]) -> str:
    """Return the report's table of a suite as text, of these results alone."""
    played, evaluations = suite_episodes(results), results["evaluations"]
    table = robustness_table(played.assign(data="", run=0, method=""))
    table = table.droplevel(["data", "method"])
    table = table.drop(columns=["seeds", "stood %"], errors="ignore")
    for name in ("clean", "disturbed"):  # an interval of each would be too wide
        table[name] = [estimate.mean for estimate in table[name]]
    cells = table.map(plain).reset_index()
    clean = evaluations[0]["clean"]
    title = (
        f"{results['env']} {results['data']}, suite {results['suite']}: "
        f"{len(evaluations)} x {len(clean['seeds'])} pairs of episodes, mean "
        f"{'scores' if 'scores' in clean else 'returns'} [95 %]"
    )
    rows = [list(cells), *cells.to_numpy().tolist()]
    return "\n".join([title, *aligned_columns(rows)])


def recoverable_table(results: Mapping[str, Any]) -> str:
    """Return the report's table of recovery rates as text, of these results alone."""
    rows = saved_states(results).assign(data="", run=0, method="", seed=0)
    rates = recovery_table(rows).drop(columns="seeds").iloc[0]
    lines = [*rates.map(plain).items()]
    number = len(results["evaluations"])
    title = f"{results['env']} {results['data']}, {results['half']} recoverable states"
    return "\n".join([f"{title}, each played {number} x", *aligned_columns(lines)])
