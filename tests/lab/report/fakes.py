"""Folders as runs leave them, without the runs."""

from __future__ import annotations

import itertools
import json
from pathlib import Path

from omegaconf import OmegaConf

from torchrl_osr.lab.data.statistics import REFERENCE_RETURNS
from torchrl_osr.lab.report import RunTables, read_runs
from torchrl_osr.lab.run.config import FORMAT

IDS = {"hopper": "Hopper-v5", "walker2d": "Walker2d-v5"}
CONFIG = {
    "data": {"source": "medium-replay", "num_transitions": 1000, "random_share": 0.0,
             "path": None},
    "perturbation": {"std": 0.001},
    "loss": {"_target_": "torchrl_osr.OSRLoss", "recovery_weight": 0.5},
    "optim": {"gamma": 0.99},
    "trainer": {"steps": 8000, "num_threads": 1},
    "seed": 0,
}  # fmt: skip
VERSIONS = {"torchrl_osr": "0.1.0", "torch": "2.13.0", "mujoco": "4.0.0"}


def write_json(path: Path, value: object) -> None:
    path.write_text(json.dumps(value))


def write_run(
    folder: Path,
    scores: dict[int, list[float]],
    *,
    env: str = "hopper",
    seed: int = 0,
    changes: dict | None = None,
    choice: str = "osr",
    overrides: list[str] | None = None,
    versions: dict = VERSIONS,
    data_score: float = 20.0,
    status: str = "done",
    suite: dict | None = None,
    states: dict | None = None,
) -> Path:
    """Write a run whose evaluations at the given steps have these episode scores."""
    (folder / ".hydra").mkdir(parents=True, exist_ok=True)
    config = OmegaConf.create(CONFIG)
    config.env = {"name": env, "id": IDS[env]}
    config.seed, config.trainer.steps = seed, max(scores, default=8000)
    for key, value in (changes or {}).items():
        OmegaConf.update(config, key, value)
    config.format = FORMAT
    OmegaConf.save(config, folder / "config.yaml")
    hydra = {"overrides": {"task": overrides or []}}
    hydra |= {"runtime": {"choices": {"loss": choice}}}
    OmegaConf.save({"hydra": hydra}, folder / ".hydra" / "hydra.yaml")
    write_json(folder / "status.json", {"status": status})
    low, high = REFERENCE_RETURNS[env]
    evaluations = [
        {
            "step": step,
            "returns": [low + value * (high - low) / 100 for value in row],
            "seeds": list(range(10_000, 10_000 + len(row))),
        }
        for step, row in scores.items()
    ]
    content = {"versions": versions, "data_score": data_score}
    write_json(folder / "returns.json", content | {"evaluations": evaluations})
    if suite:
        write_json(folder / "robustness-hand.json", suite)
    if states:
        write_json(folder / "recoverable-public.json", states)
    return folder


def level(name: str, scores: list[float], **entries) -> dict:
    """Return a disturbance that does not end."""
    base = {"name": name, "kind": "dynamics", "scores": scores}
    return base | {"disturbed_at": [0] * len(scores), "recovery_steps": None} | entries


def knock(name: str, scores: list[float], **entries) -> dict:
    """Return a disturbance that ends, after which every episode is back at once."""
    size = len(scores)
    names = ("survived_knock", "alive_after", "clean_alive_after")
    ends = dict.fromkeys(names, [True] * size)
    ends |= {"disturbed_at": [7] * size, "recovery_steps": [0] * size}
    return level(name, scores, **(ends | entries))


def suite_of(*evaluations: tuple) -> dict:
    """Return a file's content from steps, seeds, clean scores and levels."""
    rows = [
        {"step": step, "clean": {"scores": clean, "seeds": seeds}, "levels": levels}
        for step, seeds, clean, levels in evaluations
    ]
    return {"versions": VERSIONS, "suite": "hand", "levels": {}, "evaluations": rows}


def write_experiment(folder: Path) -> Path:
    """Write two runs of three methods on two data sets, with a suite."""
    cases = itertools.product(IDS, enumerate(("cql", "osr", "iql")), (0, 1))
    for env, (place, method), seed in cases:
        scores = [50.0 + 5 * place + seed, 60.0 + 5 * place]
        levels = [
            level("mass", [0.7 * score for score in scores]),
            knock("torque-20", [0.5 * score for score in scores]),
        ]
        # Every checkpoint has episodes of its own.
        rows = [(step, [step, step + 1], scores, levels) for step in (7000, 8000)]
        write_run(
            folder / env / method / f"seed{seed}",
            dict.fromkeys((0, 7000, 8000), scores), env=env, seed=seed,
            suite=suite_of(*rows),
        )  # fmt: skip
    return folder


def read_all(folder: Path) -> RunTables:
    """Return the runs below a folder, none of them left out."""
    tables = read_runs([folder])
    assert not tables.left_out
    return tables
