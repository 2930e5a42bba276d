"""Train and disturb every run of the experiment; what is finished is skipped.

    python results/oos/run.py outputs/oos                        everything
    python results/oos/run.py outputs/oos --data hopper-medium-replay --methods osr cql

Each run is one process with one torch thread. Stop it at any time and start it again:
runs continue from their last checkpoint.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

# In the order in which they are trained: a prefix of the list is a fair comparison.
METHODS = {
    "cql": ["loss=cql"],
    "cql_bc": ["loss=cql_bc"],
    "cql_noisy_bc": ["loss=cql_noisy_bc"],
    "osr": ["loss=osr"],
    "osr_shuffled": ["loss=osr", "inverse_dynamics.shuffle_next=true"],
    "osr_v": ["loss=osr_v"],
    "osr_beta_0": ["loss=osr", "perturbation.std=0"],
    "osr_beta_1e-2": ["loss=osr", "perturbation.std=0.01"],
    "osr_beta_1e-1": ["loss=osr", "perturbation.std=0.1"],
    "osr_beta_1e-1_clean_model": [
        "loss=osr",
        "perturbation.std=0.1",
        "inverse_dynamics.loss.states=clean",
    ],
    "cql_noisy_bc_beta_1e-1": ["loss=cql_noisy_bc", "perturbation.std=0.1"],
}
DATA = [
    f"{env}-{quality}"
    for env in ("hopper", "walker2d")
    for quality in ("medium-replay", "medium-expert")
]


def finished(file: Path, key: str, value: object) -> bool:
    """Return whether a JSON file is there and says so."""
    return file.exists() and json.loads(file.read_text()).get(key) == value


def run(folder: Path, data: str, method: str, seed: int) -> None:
    """Train one run, then disturb its last five policies."""
    env, quality = data.split("-", 1)
    if not finished(folder / "status.json", "status", "done"):
        train = [
            "train", f"env={env}", f"data={quality}", f"seed={seed}",
            *METHODS[method], "trainer.progress=false", f"hydra.run.dir={folder}",
        ]  # fmt: skip
        call(train, folder / "train.txt")
    if not (folder / "robustness-oos.json").exists():
        call(["evaluate", f"checkpoint={folder}"], folder / "evaluate.txt")
    print(folder, flush=True)


def call(command: list[str], log: Path) -> None:
    """Run a command; keep what it prints."""
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("w") as file:
        subprocess.run(
            [sys.executable, "-m", "torchrl_osr", *command],
            stdout=file, stderr=subprocess.STDOUT, check=True,
        )  # fmt: skip


def main() -> None:
    """Go through the grid, seed by seed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--data", nargs="+", default=DATA, choices=DATA)
    parser.add_argument("--methods", nargs="+", default=METHODS, choices=METHODS)
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--jobs", type=int, default=2, help="runs at once")
    options = parser.parse_args()
    grid = [
        (options.folder / data / method / f"seed{seed}", data, method, seed)
        for seed in options.seeds
        for data in options.data
        for method in options.methods
    ]
    with ThreadPoolExecutor(options.jobs) as pool:
        for done in [pool.submit(run, *each) for each in grid]:
            error = done.exception()
            if error is not None:
                print(error, file=sys.stderr, flush=True)


if __name__ == "__main__":
    main()
