"""Folders as runs leave them, without the runs; other tests of the report use them."""

from __future__ import annotations

import copy
import json
from pathlib import Path

import numpy as np
from omegaconf import OmegaConf

from torchrl_osr.lab.data.scores import REFERENCE_RETURNS
from torchrl_osr.lab.report import RunTables, read_runs

IDS = {
    "hopper": "Hopper-v5",
    "walker2d": "Walker2d-v5",
    "halfcheetah": "HalfCheetah-v5",
}
LOSSES = {
    "cql": {"recovery_weight": 0.0},
    "cql_noisy_bc": {"recovery_target": "data"},
    "osr": {},
    "osr_v": {"_target_": "torchrl_osr.OSRVLoss"},
}
CONFIG = {
    "env": {"name": "hopper", "id": "Hopper-v5"},
    "data": {"source": "medium-replay", "num_transitions": 1000, "random_share": 0.0,
             "path": None},
    "network": {"layer_norm": True},
    "perturbation": {"std": 0.001, "noise": "gaussian"},
    "inverse_dynamics": {"shuffle_next": False},
    "loss": {
        "_target_": "torchrl_osr.OSRLoss", "recovery_weight": 0.5,
        "recovery_target": "inverse_dynamics",
    },
    "optim": {"gamma": 0.99},
    "trainer": {
        "steps": 8000, "eval_interval": 1000, "num_threads": 1, "device": "cpu",
        "progress": False,
    },
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
    quality: str = "medium-replay",
    seed: int = 0,
    loss: dict | None = None,
    changes: dict | None = None,
    choice: str = "osr",
    overrides: list[str] | None = None,
    versions: dict | None = None,
    data_score: float = 20.0,
    status: str = "done",
) -> Path:
    """Write a run whose evaluations at the given steps have these episode scores."""
    folder.mkdir(parents=True, exist_ok=True)
    config = OmegaConf.create(copy.deepcopy(CONFIG))
    config.env = {"name": env, "id": IDS[env]}
    config.data.source, config.seed = quality, seed
    config.loss.update(loss or {})
    config.trainer.steps = max(scores, default=8000)
    for key, value in (changes or {}).items():
        OmegaConf.update(config, key, value)
    OmegaConf.save(config, folder / "config.yaml")
    write_json(folder / "status.json", {"status": status})
    (folder / ".hydra").mkdir(exist_ok=True)
    OmegaConf.save(config, folder / ".hydra" / "config.yaml")
    hydra = {
        "overrides": {"task": overrides or []},
        "runtime": {"choices": {"loss": choice}},
    }
    OmegaConf.save({"hydra": hydra}, folder / ".hydra" / "hydra.yaml")
    low, high = REFERENCE_RETURNS[env]
    evaluations = [
        {
            "step": step,
            "score": float(np.mean(row)),
            "returns": [low + value * (high - low) / 100 for value in row],
            "lengths": [1000] * len(row),
            "seeds": list(range(10_000, 10_000 + len(row))),
        }
        for step, row in scores.items()
    ]
    content = {
        "versions": VERSIONS if versions is None else versions,
        "data_score": data_score,
        "evaluations": evaluations,
    }
    write_json(folder / "returns.json", content)
    return folder


def write_experiment(
    folder: Path,
    *,
    data: tuple[str, ...] = ("hopper-medium-replay", "walker2d-medium-expert"),
    seeds: tuple[int, ...] = (0, 1, 2),
) -> Path:
    """Write runs of all methods, laid out as results/oos/run.py does."""
    for number, name in enumerate(data):
        env, quality = name.split("-", 1)
        for place, (method, loss) in enumerate(LOSSES.items()):
            for seed in seeds:
                rng = np.random.default_rng([number, place, seed])
                curve = {
                    step: rng.normal(50 + 5 * place, 5, 10).tolist()
                    for step in range(1000, 8001, 1000)
                }
                rows = []
                for step in (7000, 8000):
                    clean = curve[step]
                    levels = [
                        hand_level("mass", [0.7 * score for score in clean]),
                        knock("torque-20", [0.5 * score for score in clean]),
                        knock("push-small", [0.9 * score for score in clean]),
                    ]
                    # Every checkpoint has episodes of its own.
                    rows.append((step, list(range(step, step + 10)), clean, levels))
                write_hand(
                    folder / name / method / f"seed{seed}", curve, env=env,
                    quality=quality, seed=seed, loss=loss, suite=hand_suite(*rows),
                )  # fmt: skip
    return folder


def write_hand(folder: Path, curve: dict, *, suite: dict | None = None, **options):
    """Write a run, and a robustness file made by hand."""
    write_run(folder, curve, **options)
    if suite:
        write_json(folder / "robustness-hand.json", suite)


def hand_level(name: str, scores: list[float], **entries) -> dict:
    """Return a disturbance that does not end."""
    level = {"name": name, "kind": "dynamics", "strength": 1.0, "scores": scores}
    return level | {"recovery_steps": None, "distance": None} | entries


def knock(name: str, scores: list[float], **entries) -> dict:
    """Return a disturbance that ends, after which every episode is back at once."""
    size = len(scores)
    ends = {
        "disturbed_at": [7] * size,
        "survived_knock": [True] * size,
        "alive_after": [True] * size,
        "clean_alive_after": [True] * size,
        "recovery_steps": [0] * size,
        "distance": {"offset": [0, 1], "mean": [2.0, 0.5], "count": [size] * 2},
    }
    return hand_level(name, scores, **(ends | entries))


def hand_suite(*evaluations: tuple) -> dict:
    """Return a file's content from steps, seeds, clean scores and levels."""
    rows = [
        {"step": step, "clean": {"scores": clean, "seeds": seeds}, "levels": levels}
        for step, seeds, clean, levels in evaluations
    ]
    return {"format": 1, "versions": VERSIONS, "suite": "hand", "evaluations": rows}


def read_all(folder: Path) -> RunTables:
    """Return the runs below a folder, none of them left out."""
    tables = read_runs([folder])
    assert not tables.left_out
    return tables
