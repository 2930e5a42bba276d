"""Train every method for two minutes of a core each, then disturb the last policy.

    python results/paper/run.py outputs/paper
    python results/paper/run.py outputs/paper --methods osr cql --seeds 0
    python results/paper/run.py outputs/paper --pack new

Each run is one process with one torch thread. Stop the script at any time and start it
again: finished runs are skipped, others resume. ``--pack`` writes the tables that
``results/tables.py`` reads into a folder.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from itertools import product
from pathlib import Path

from torchrl_osr.lab.report import read_runs

HERE = Path(__file__).parent
CORE_SECONDS = 120  # for the updates of a policy; models are trained beside it

# In the order in which they are trained: a prefix of the list is a fair comparison.
METHODS = {
    name: [f"loss={name}"]
    for name in (
        *("osr", "noisy_bc", "cql_noisy_bc", "cql", "iql", "td3_bc", "rebrac", "bc"),
        *("osr_v", "osr_10", "sac_10", "edac_10", "rorl", "mopo", "rambo"),
        *("scas", "sdc", "osr_v_data", "rim"),
    )
} | {
    "iql+osr": ["loss=iql", "recovery=osr"],
    "rebrac+osr": ["loss=rebrac", "recovery=osr"],
    "cql_both": ["loss=cql", "loss.actor_states=both"],
}
SUITES = {
    "oos": "robustness-oos.json",
    "push": "robustness-push.json",
    "observation_noise": "robustness-observation_noise.json",
    "recoverable": "recoverable-public.json",
}
"""And the file that each writes."""

ENVS = ("hopper", "walker2d", "halfcheetah")
DATA = [f"{env}-{data}" for data in ("medium-replay", "medium-expert") for env in ENVS]


def command(log: Path, *arguments: str) -> None:
    """Run a command of the package, and keep what it prints."""
    with log.open("w") as file:
        subprocess.run(
            [sys.executable, "-m", "torchrl_osr.lab", *arguments],
            stdout=file, stderr=subprocess.STDOUT, check=True,
            env=os.environ | {"OMP_NUM_THREADS": "1"},
        )  # fmt: skip


def run(folder: Path, data: str, method: str, seed: int) -> None:
    """Train one run, then disturb its last policy."""
    env, source = data.split("-", 1)
    folder.mkdir(parents=True, exist_ok=True)
    status = folder / "status.json"
    if not status.exists() or json.loads(status.read_text())["status"] != "done":
        ms = json.loads((HERE / "update_ms.json").read_text())["quick"][method]
        steps = round(CORE_SECONDS / ms) * 1000
        command(
            folder / "train.txt", "train", f"env={env}", f"data={source}",
            f"seed={seed}", *METHODS[method], f"trainer.steps={steps}",
            f"trainer.eval_interval={steps // 10}", "trainer.eval_episodes=5",
            f"trainer.checkpoint_interval={steps // 10}", "trainer.progress=false",
            f"hydra.run.dir={folder}",
        )  # fmt: skip
    for suite, file in SUITES.items():
        if not (folder / file).exists():
            command(
                folder / f"{suite}.txt", "evaluate", f"checkpoint={folder}",
                f"suite={suite}", "episodes=4", "last=1", "progress=false",
            )  # fmt: skip
    print(folder, flush=True)


def pack(folder: Path, to: Path) -> None:
    """Write the tables of the finished runs."""
    tables = read_runs([folder])
    to.mkdir(parents=True, exist_ok=True)
    runs = tables.runs.rename(columns={"steps": "updates"})
    columns = ["data", "method", "seed", "updates", "data_score", "overrides"]
    runs[columns].to_csv(to / "runs.csv.xz", index_label="run")
    columns = ["run", "suite", "disturbance", "step", "episode", "score"]
    columns += ["disturbed_at", "recovery_steps"]
    episodes = tables.episodes[columns].round({"score": 2})
    episodes.to_csv(to / "episodes.csv.xz", index=False)
    saved = tables.saved
    saved[["half", "states"]] = saved["states"].str.split(" ", expand=True)
    of_each = ["half", "states", "group", "disturbance", "walk"]
    first = saved.groupby("states")["run"].transform("first") == saved["run"]
    saved.loc[first, of_each].to_csv(to / "states.csv.xz", index=False)
    back = saved.groupby(["run", "half", "states"], sort=False)["back"]
    bits = back.agg(lambda rows: "".join(str(int(bit)) for bit in rows))
    bits.reset_index().assign(checkpoints=1).to_csv(
        to / "recoverable.csv.xz", index=False
    )


def main() -> None:
    """Go through the grid seed by seed, or pack what is there."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--pack", type=Path, metavar="FOLDER", help="run nothing")
    parser.add_argument("--data", nargs="+", default=DATA, choices=DATA)
    parser.add_argument("--methods", nargs="+", default=list(METHODS), choices=METHODS)
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--jobs", type=int, default=2, help="runs at once")
    options = parser.parse_args()
    if options.pack:
        pack(options.folder, options.pack)
        return
    with ThreadPoolExecutor(options.jobs) as pool:
        jobs = [
            pool.submit(
                run, options.folder / data / method / f"seed{seed}", data, method, seed
            )
            for seed, data, method in product(
                options.seeds, options.data, options.methods
            )
        ]
        for job in jobs:
            if job.exception():
                print(job.exception(), file=sys.stderr, flush=True)


if __name__ == "__main__":
    main()
