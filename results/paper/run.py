"""Make the runs behind the paper's tables and figures.

    python results/paper/run.py table1                       # table2, figure4, d4
    python results/paper/run.py table1 --data hopper-medium --methods osr cql --seeds 0
    python results/paper/run.py mazes                        # the rest of Table 1
    python results/paper/run.py methods                      # all methods, six sets
    python results/paper/run.py tune                         # eight trials a method
    python results/paper/run.py table1 --pack                # and then page.py

Each run is one process with one torch thread. Stop the script at any time and start it
again: finished runs are skipped, others resume. ``--missing`` leaves out runs that are
in the tables of this folder with as many updates, ``--pack`` adds finished ones.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import product
from pathlib import Path
from typing import NamedTuple

import pandas as pd

from torchrl_osr.lab.report import read_runs

HERE = Path(__file__).parent
RESULTS = HERE.parent
ENVS = ("hopper", "walker2d", "halfcheetah")

METHODS = {
    name: [f"loss={name}"]
    for name in (
        *("osr", "noisy_bc", "cql_noisy_bc", "cql", "iql", "td3_bc", "rebrac", "bc"),
        *("osr_v", "osr_10", "sac_10", "edac_10", "rorl", "mopo", "rambo"),
        *("sdc", "osr_v_data", "osr_v_noisy_bc", "rim"),
    )
} | {
    "iql+osr": ["loss=iql", "recovery=osr"],
    "rebrac+osr": ["loss=rebrac", "recovery=osr"],
    "cql_both": ["loss=cql", "loss.actor_states=both"],
}
"""In the order in which they are trained."""

OWN = {
    **dict.fromkeys(("osr", "cql", "cql_noisy_bc"), ("loss.min_q_weight", 5, 20)),
    "td3_bc": ("loss.alpha", 2.5, 10),
    "iql": ("loss.temperature", 3, 10),
}
"""Two values of a weight of each method's own, to tune it by."""

TRIALS = {
    f"{name}-{number}": [
        *METHODS[name], f"optim.actor_lr={rate}", f"optim.tau={tau}", f"{key}={weight}"
    ]
    for name, (key, *weights) in OWN.items()
    for number, (rate, tau, weight) in enumerate(
        product((3e-4, 1e-3), (5e-3, 2e-2), weights)
    )
}  # fmt: skip
"""The same number of trials for every method."""

MUJOCO = {
    f"{env} {source}": [f"env={env}", f"data={source}"]
    for source in ("medium", "medium-replay", "medium-expert", "expert", "random")
    for env in ENVS
}
LIMITED = {
    f"{env} expert, {share} % random": [
        f"env={env}", "data=expert", f"data.random_share={share / 100}"
    ]
    for share in (50, 70, 90)
    for env in ENVS
}  # fmt: skip
MAZES = {
    f"antmaze-{maze} {source}": [
        f"env=antmaze-{maze}", f"data={source}", "preset=antmaze_quick",
        "trainer.eval_episodes=10",
    ]
    for maze, *sources in (
        ("umaze", "umaze", "diverse"),
        ("medium", "play", "diverse"),
        ("large", "play", "diverse"),
    )
    for source in sources
}  # fmt: skip
DATA = MUJOCO | LIMITED | MAZES
SIX = [data for data in MUJOCO if data.endswith(("-replay", "-expert"))]

SUITES = {
    "oos": "robustness-oos.json",
    "official": "robustness-official.json",
    "push": "robustness-push.json",
    "observation_noise": "robustness-observation_noise.json",
    "recoverable": "recoverable-public.json",
}
"""Suites that the last policy of a two-minute run on the six data sets plays, and the
file of each. ``official`` is for ``medium-expert`` alone, as in the paper."""


class Table(NamedTuple):
    """Runs of a table; ``seconds`` of a core go to the updates of each policy."""

    methods: Sequence[str]
    data: Sequence[str]
    suites: Sequence[str] = ()  # that the table shows
    seeds: Sequence[int] = (0, 1, 2)
    seconds: int = 120
    place: str = "paper"  # folder in results of its tables


PAPER = ("osr", "osr_v", "cql", "iql", "sdc", "mopo", "rambo")
TEN = (*PAPER, "td3_bc", "rebrac", "cql_noisy_bc")
EXPERTS = [f"{env} medium-expert" for env in ENVS]
TABLES = {
    "table1": Table(TEN, list(MUJOCO)),
    "mazes": Table(TEN, list(MAZES)),
    "table2": Table(("osr", "osr_v", "cql", "sdc"), EXPERTS, ("oos", "official")),
    "figure4": Table(("osr", "cql", "sdc"), list(LIMITED)),
    "d4": Table(
        ("osr_10", "sac_10", "edac_10", "rorl"),
        ("hopper medium-replay", "walker2d medium-replay"),
        seeds=(0, 1), seconds=600, place="paper/d4",
    ),
    "tune": Table(
        list(TRIALS), ("hopper medium-replay", "walker2d medium-expert"),
        seeds=(100,), place="paper/tune",
    ),
    "methods": Table(list(METHODS), SIX, ("oos", "push", "observation_noise")),
}  # fmt: skip


def folder_name(data: str) -> str:
    """Return a data set's name without spaces and signs."""
    return re.sub(r"[^\w-]+", "-", data)


def command(log: Path, *arguments: str) -> None:
    """Run a command of the package, and keep what it prints."""
    with log.open("w") as file:
        subprocess.run(
            [sys.executable, "-m", "torchrl_osr.lab", *arguments],
            stdout=file, stderr=subprocess.STDOUT, check=True,
            env=os.environ | {"OMP_NUM_THREADS": "1"},
        )  # fmt: skip


def updates(method: str, seconds: int) -> int:
    """Return how many updates fit into the time."""
    ms = json.loads((HERE / "update_ms.json").read_text())["quick"]
    ms = ms[method.partition("-")[0]]
    return round(seconds / ms) * 1000


def run(folder: Path, data: str, method: str, seed: int, table: Table) -> None:
    """Train one run, then disturb its last policy."""
    folder.mkdir(parents=True, exist_ok=True)
    status = folder / "status.json"
    if not status.exists() or json.loads(status.read_text())["status"] != "done":
        steps = updates(method, table.seconds)
        tenth = steps // 10
        length = [f"trainer.steps={steps}", f"trainer.eval_interval={tenth}"]
        length += [f"trainer.checkpoint_interval={tenth}", "trainer.eval_episodes=5"]
        command(
            folder / "train.txt", "train", *length, *DATA[data],
            *(METHODS | TRIALS)[method], f"seed={seed}",
            "trainer.progress=false", f"hydra.run.dir={folder}",
        )  # fmt: skip
    for suite, file in SUITES.items():
        sets = EXPERTS if suite == "official" else SIX
        if table.place == "paper" and data in sets and not (folder / file).exists():
            command(
                folder / f"{suite}.txt", "evaluate", f"checkpoint={folder}",
                f"suite={suite}", "episodes=4", "last=1", "progress=false",
            )  # fmt: skip
    print(folder, flush=True)


def packed(folder: Path, suites: Sequence[str]) -> set[tuple[str, str, int, int]]:
    """Return data, method, seed and updates of the runs that have the suites."""
    if not (folder / "runs.csv.xz").exists():
        return set()
    runs = pd.read_csv(folder / "runs.csv.xz", index_col="run")
    if suites:
        played = pd.read_csv(folder / "episodes.csv.xz").groupby("run")["suite"]
        runs = runs[played.agg(lambda names: set(suites) <= set(names))]
    columns = ["data", "method", "seed", "updates"]
    return set(runs[columns].itertuples(index=False, name=None))


def pack(folders: Sequence[Path], to: Path) -> None:
    """Add finished runs to the tables; a run replaces one of the same settings."""
    tables = read_runs(folders)
    for folder, reason in tables.left_out:
        print(f"{folder}: {reason}", file=sys.stderr)
    to.mkdir(parents=True, exist_ok=True)
    runs = tables.runs.rename(columns={"steps": "updates"}).rename_axis("run")
    columns = ["run", "data", "method", "seed", "updates", "data_score", "overrides"]
    new = {"runs": runs.reset_index()[columns].round({"data_score": 2})}
    columns = ["run", "suite", "disturbance", "step", "episode", "score"]
    columns += ["disturbed_at", "recovery_steps"]
    new["episodes"] = tables.episodes[columns].round({"score": 2})
    saved = tables.saved
    if len(saved):
        saved[["half", "states"]] = saved["states"].str.split(" ", expand=True)
        of_each = ["half", "states", "group", "disturbance", "walk"]
        first = saved.groupby("states")["run"].transform("first") == saved["run"]
        new["states"] = saved.loc[first, of_each]
        back = saved.groupby(["run", "half", "states"], sort=False)["back"]
        bits = back.agg(lambda rows: "".join(str(int(bit)) for bit in rows))
        new["recoverable"] = bits.reset_index().assign(checkpoints=1)
    old = {
        path.name.removesuffix(".csv.xz"): pd.read_csv(path, dtype={"back": str})
        for path in to.glob("*.csv.xz")
    }
    if old:
        key = ["data", "method", "seed"]
        again = old["runs"].merge(new["runs"][key])["run"]
        shift = old["runs"]["run"].max() + 1
        kept = old["runs"].query("run not in @again")
        scores = pd.concat([kept, new["runs"]]).groupby("data")["data_score"]
        if (two := scores.nunique() > 1).any():  # machines round in different ways
            names = ", ".join(two.index[two])
            sys.exit(f"The tables' runs on {names} had other data. Make all of them.")
    for name, rows in new.items():
        if name == "states" and name in old:  # a mark stands for a list of states
            rows = rows[~rows["states"].isin(old[name]["states"])]
            rows = pd.concat([old[name], rows])
        elif old and name != "states":
            kept = old.get(name, rows[:0])
            kept = kept[~kept["run"].isin(again)]
            rows = pd.concat([kept, rows.assign(run=rows["run"] + shift)])
        rows.convert_dtypes().to_csv(to / f"{name}.csv.xz", index=False)


def main() -> None:
    """Go through the grid seed by seed, or pack what is there."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("table", choices=TABLES)
    parser.add_argument("--folder", type=Path, default=Path("outputs"))
    parser.add_argument("--pack", action="store_true", help="run nothing")
    parser.add_argument("--data", nargs="+", help="such as hopper-medium")
    parser.add_argument("--methods", nargs="+")
    parser.add_argument("--seeds", nargs="+", type=int)
    parser.add_argument("--jobs", type=int, default=2, help="runs at once")
    parser.add_argument("--missing", action="store_true", help="only those not packed")
    options = parser.parse_args()
    table = TABLES[options.table]
    top, tables = options.folder / table.place, RESULTS / table.place
    folders = {data: top / folder_name(data) for data in table.data}
    names = [folder.name for folder in folders.values()]
    if options.pack:
        pack([folder for folder in folders.values() if folder.exists()], tables)
        return
    if unknown := {*(options.data or ())} - {*names}:
        parser.error(f"--data has {sorted(unknown)}; expected some of {names}.")
    done = packed(tables, table.suites) if options.missing else set()
    grid = product(
        options.seeds or table.seeds,
        [data for data in table.data if folder_name(data) in (options.data or names)],
        options.methods or table.methods,
    )
    with ThreadPoolExecutor(options.jobs) as pool:
        jobs = [
            pool.submit(
                run, folders[data] / method / f"seed{seed}",
                data, method, seed, table,
            )
            for seed, data, method in grid
            if (data, method, seed, updates(method, table.seconds)) not in done
        ]  # fmt: skip
        for job in jobs:
            if job.exception():
                print(job.exception(), file=sys.stderr, flush=True)


if __name__ == "__main__":
    main()
