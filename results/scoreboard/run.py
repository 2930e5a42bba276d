"""Train every method for as long as the others, then disturb what it learned.

    python results/scoreboard/run.py --measure quick       milliseconds of an update
    python results/scoreboard/run.py --measure paper       at the paper's sizes
    python results/scoreboard/run.py outputs/scoreboard    what is missing
    python results/scoreboard/run.py outputs/scoreboard --methods osr cql --seeds 0
    python results/scoreboard/run.py outputs/scoreboard --pack

Each run has one torch thread. Stop it at any time and start it again:
runs continue from their last checkpoint, and what is in the tables beside this file,
``<data>.jsonl.gz``, is not done again. ``--pack`` adds to them what is finished.
"""

from __future__ import annotations

import argparse
import gzip
import json
import multiprocessing
import os
import resource
import sys
import tempfile
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

# All commands are forks of this process: each takes seconds to import.
import torchrl_osr.commands.evaluate
import torchrl_osr.commands.train
from torchrl_osr.__main__ import main as start
from torchrl_osr.report import pack_runs, read_records

HERE = Path(__file__).parent
CORE_SECONDS = 120
"""Of one core, for the updates of a policy; models are trained beside it."""

# In the order in which they are trained: a prefix of the list is a fair comparison.
METHODS = {
    "osr": [],
    "noisy_bc": ["loss=noisy_bc"],
    "cql_noisy_bc": ["loss=cql_noisy_bc"],
    "cql": ["loss=cql"],
    "iql": ["loss=iql"],
    "td3_bc": ["loss=td3_bc"],
    "rebrac": ["loss=rebrac"],
    "bc": ["loss=bc"],
    "iql+osr": ["loss=iql", "recovery=osr"],
    "rebrac+osr": ["loss=rebrac", "recovery=osr"],
    "osr_v": ["loss=osr_v"],
    "osr_10": ["loss=osr_10"],
    "sac_10": ["loss=sac_10"],
    "edac_10": ["loss=edac_10"],
    "rorl": ["loss=rorl"],
    "mopo": ["loss=mopo"],
    "rambo": ["loss=rambo"],
    "romi": ["loss=romi"],
    "scas": ["loss=scas"],
    "sdc": ["loss=sdc"],
    "osr_v_data": ["loss=osr_v_data"],
    "cql_both": ["loss=cql", "loss.actor_states=both"],
    "rim": ["loss=rim"],
}
SUITES = {
    "oos": "robustness-oos.json",
    "push": "robustness-push.json",
    "observation_noise": "robustness-observation_noise.json",
    "recoverable": "recoverable-public.json",
}
"""And the file that each leaves."""

ENVS = ("hopper", "walker2d", "halfcheetah")
DATA = [f"{env}-{data}" for data in ("medium-replay", "medium-expert") for env in ENVS]


def torchrl_osr(*arguments: str, log: Path | None = None) -> None:
    """Run a command of the package in a fork of this process; keep what it prints."""
    child = multiprocessing.get_context("fork").Process(
        target=command, args=(arguments, log)
    )
    child.start()
    child.join()
    if child.exitcode:
        raise RuntimeError(f"torchrl-osr {' '.join(arguments)} failed, see {log}")


def command(arguments: Sequence[str], log: Path | None) -> None:
    """Run it in this process."""
    with (log or Path(os.devnull)).open("w") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    start(arguments)


def steps_of(method: str) -> int:
    """Return the updates that fit in the time, in tenths that are evaluated."""
    ms = json.loads((HERE / "update_ms.json").read_text())["quick"][method]
    return round(CORE_SECONDS / ms) * 1000


def measure(methods: list[str], preset: str) -> None:
    """Write the processor's milliseconds of an update of each method, on Hopper.

    Those of the others are within some percent: their inputs alone are wider.
    """
    path = HERE / "update_ms.json"
    found = json.loads(path.read_text()) if path.exists() else {}
    here = found.setdefault(preset, {})
    for method in methods:
        if method in here:
            continue
        seconds = []
        # The first one fills the caches; the others both record the update, once. A
        # generation of roll-outs is between them.
        for steps in (500, 500, 1500):
            with tempfile.TemporaryDirectory() as folder:
                before = resource.getrusage(resource.RUSAGE_CHILDREN)
                torchrl_osr(
                    "train", "env=hopper", *METHODS[method], f"preset={preset}",
                    "data.num_transitions=200_000", f"trainer.steps={steps}",
                    f"trainer.eval_interval={steps}", "trainer.eval_episodes=1",
                    "trainer.inverse_dynamics_steps=100", "dynamics.steps=100",
                    "dynamics.vae_steps=100", f"hydra.run.dir={folder}/run",
                )  # fmt: skip
                after = resource.getrusage(resource.RUSAGE_CHILDREN)
            seconds.append(
                after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
            )
        here[method] = round(seconds[2] - seconds[1], 2)
        path.write_text(json.dumps(found, indent=2) + "\n")
        print(method, here[method], "ms", flush=True)


def run(folder: Path, data: str, method: str, seed: int) -> None:
    """Train one run, then disturb its last policy."""
    env, quality = data.split("-", 1)
    folder.mkdir(parents=True, exist_ok=True)
    status = folder / "status.json"
    if not status.exists() or json.loads(status.read_text())["status"] != "done":
        steps = steps_of(method)
        torchrl_osr(
            "train", f"env={env}", f"data={quality}", f"seed={seed}", *METHODS[method],
            f"trainer.steps={steps}", f"trainer.eval_interval={steps // 10}",
            f"trainer.checkpoint_interval={steps // 10}", "trainer.eval_episodes=5",
            "trainer.progress=false",
            f"hydra.run.dir={folder}", log=folder / "train.txt",
        )  # fmt: skip
    for suite, file in SUITES.items():
        if not (folder / file).exists():
            torchrl_osr(
                "evaluate", f"checkpoint={folder}", f"suite={suite}", "episodes=4",
                "last=1", "progress=false", log=folder / f"{suite}.txt",
            )  # fmt: skip
    print(folder, flush=True)


def packed(data: str) -> dict[str, dict[str, Any]]:
    """Return the runs in the table of a data set, by their folders."""
    table = HERE / f"{data}.jsonl.gz"
    found = read_records(table) if table.exists() else []
    return {record["folder"]: record for record in found}


def pack(folder: Path) -> None:
    """Add the finished runs below a folder to the tables, one for each data set."""
    *_, last = SUITES.values()
    for data in DATA:
        finished = [path.parent for path in folder.glob(f"{data}/*/*/{last}")]
        if not finished:
            continue
        records = packed(data)
        with tempfile.TemporaryDirectory() as here:
            new = Path(here) / "new.jsonl.gz"
            pack_runs(finished, new)
            for record in read_records(new):
                run = f"{data}/{record['method']}/seed{record['config']['seed']}"
                records[run] = record | {"folder": run}
        lines = [json.dumps(records[each]) + "\n" for each in sorted(records)]
        content = gzip.compress("".join(lines).encode(), mtime=0)
        (HERE / f"{data}.jsonl.gz").write_bytes(content)
        print(f"{data}: {len(finished)} runs here, {len(records)} in the table")


def main() -> None:
    """Measure, or go through the grid seed by seed."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", type=Path, nargs="?")
    parser.add_argument(
        "--measure", metavar="PRESET", help="run nothing else; of quick or paper"
    )
    parser.add_argument("--pack", action="store_true", help="run nothing")
    parser.add_argument("--data", nargs="+", default=DATA, choices=DATA)
    parser.add_argument("--methods", nargs="+", default=list(METHODS), choices=METHODS)
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--jobs", type=int, default=2, help="runs at once")
    options = parser.parse_args()
    if options.measure:
        measure(options.methods, options.measure)
        return
    if options.pack:
        pack(options.folder)
        return
    done = set().union(*map(packed, options.data))
    grid = [
        (options.folder / data / method / f"seed{seed}", data, method, seed)
        for seed in options.seeds
        for data in options.data
        for method in options.methods
        if f"{data}/{method}/seed{seed}" not in done
    ]
    fork = multiprocessing.get_context("fork")
    with ProcessPoolExecutor(options.jobs, fork) as pool:
        for done in [pool.submit(run, *each) for each in grid]:
            error = done.exception()
            if error is not None:
                print(error, file=sys.stderr, flush=True)


if __name__ == "__main__":
    main()
