"""Errors of trained dynamics models on new episodes of the simulator.

    python results/dynamics/errors.py <folders of runs> > results/dynamics/errors.json

Each run has a ``dynamics.safetensors``. The behaviour that made its data is played
again with another seed: no row of these episodes was trained on. The models are rolled
out with the recorded actions and compared with what has happened.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import torch
from torchrl_osr.data import consecutive_rows, load_dataset
from torchrl_osr.evaluation import dynamics_report
from torchrl_osr.experiment.dynamics import FILE, REPORT, load_dynamics
from torchrl_osr.experiment.run_config import read_run
from torchrl_osr.experiment.run_folder import CONFIG

from torchrl_osr._files import finite_or_none
from torchrl_osr.policy.tensor_file import read_tensors

SEED, ROWS, EVERY, LENGTH = 1, 20_000, 20, 20


def new_episodes(folder: Path):
    """Transitions ``[N]`` that the run has not seen, as its model reads them."""
    cfg = read_run(folder / CONFIG)
    data, _ = load_dataset(
        cfg.env.name, cfg.data.source, num_transitions=ROWS, seed=SEED, progress=False
    )
    _, record = read_tensors(folder / FILE)
    loc, scale = (
        torch.tensor(record["data"][f"observation {name}"])
        for name in ("mean", "scale")
    )
    for key in ("observation", ("next", "observation")):
        data[key] = (data[key] - loc) / scale
    return cfg, data


def main(folders: list[str]) -> None:
    """Print a JSON list with an entry for each run."""
    found = []
    for folder in map(Path, folders):
        cfg, data = new_episodes(folder)
        pieces = consecutive_rows(data, torch.arange(0, ROWS, EVERY), LENGTH)
        found.append(
            {
                "data": f"{cfg.env.name}-{cfg.data.source}",
                "rows": cfg.data.num_transitions,
                "seed": cfg.seed,
                "held_out": json.loads((folder / REPORT).read_text()),
                "simulator": dynamics_report(
                    load_dynamics(folder / FILE), data, pieces
                ),
            }
        )
    print(json.dumps(finite_or_none(found), indent=1))


if __name__ == "__main__":
    main(sys.argv[1:])
