"""Folders as runs leave them, without the runs; other tests of the report use them."""

from __future__ import annotations

import copy
import json
from pathlib import Path

import numpy as np
from omegaconf import OmegaConf

from torchrl_osr.data import REFERENCE_RETURNS
from torchrl_osr.report import RunTables, read_runs

IDS = {
    "hopper": "Hopper-v5",
    "walker2d": "Walker2d-v5",
    "halfcheetah": "HalfCheetah-v5",
}
# Final score, share lost at strength 1, share that recovers.
METHODS = {
    "cql": (70, 0.5, 0.4),
    "cql_noisy_bc": (74, 0.35, 0.6),
    "osr": (78, 0.25, 0.8),
    "osr_v": (60, 0.3, 0.7),
}
LOSSES = {
    "cql": {"recovery_weight": 0.0},
    "cql_noisy_bc": {"recovery_target": "data"},
    "osr": {},
    "osr_v": {"_target_": "torchrl_osr.OSRVLoss"},
}
# Name, kind, strength and what it does to the score; the first four end.
LEVELS = [
    ("knock-official-15", "knock", 15.0, 0.3),
    ("torque-10", "knock", 10.0, 0.6),
    ("torque-20", "knock", 20.0, 1.0),
    ("push-small", "push", 0.5, 0.5),
    ("push-large", "push", 1.0, 0.9),
    ("observation-noise", "observation", 0.1, 0.4),
    ("mass", "dynamics", 1.5, 0.7),
]
CONFIG = {
    "env": {"name": "hopper", "id": "Hopper-v5"},
    "data": {"level": "medium-replay", "num_transitions": 1000, "random_share": 0.0,
             "path": None},
    "network": {"num_cells": [128, 128], "layer_norm": True},
    "perturbation": {"std": 0.001, "noise": "gaussian"},
    "inverse_dynamics": {"shuffle_next": False},
    "loss": {
        "_target_": "torchrl_osr.OSRLoss", "recovery_weight": 0.5, "min_q_weight": 5.0,
        "recovery_target": "inverse_dynamics", "recovery_states": "both",
        "recovery_direction": "forward", "num_qvalue_nets": 2, "adversary": None,
    },
    "optim": {"gamma": 0.99},
    "trainer": {
        "steps": 8000, "eval_interval": 1000, "num_threads": 1, "device": "cpu",
        "progress": False,
    },
    "seed": 0,
}  # fmt: skip
TRANSIENT = (
    "survived_knock", "alive_after", "clean_alive_after", "recovery_steps", "distance",
)  # fmt: skip
VERSIONS = {"torchrl_osr": "0.1.0", "torch": "2.13.0", "mujoco": "4.0.0"}


def write_json(path: Path, value: object) -> None:
    path.write_text(json.dumps(value))


def write_run(
    folder: Path,
    scores: dict[int, list[float]],
    *,
    env: str = "hopper",
    level: str = "medium-replay",
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
    config.data.level, config.seed = level, seed
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


def episodes(rng, score: float, size: int = 10) -> list[float]:
    """Most episodes near the score, some that fell."""
    fell = rng.random(size) < 0.2
    return (score * np.where(fell, rng.uniform(0.2, 0.7, size), 1.05)
            + rng.normal(size=size)).tolist()  # fmt: skip


def robustness(
    rng, env: str, level: str, steps: list[int], clean: float, lost: float, back: float
) -> dict:
    """Return what a robustness file holds."""
    evaluations = []
    for number, step in enumerate(steps):
        # Every checkpoint has episodes of its own.
        first = 20_000 + 1000 * number
        seeds = list(range(first, first + 10))
        before = np.array(episodes(rng, clean))
        rows = []
        for name, kind, strength, size in LEVELS:
            hit = rng.random(10) < min(1.5 * size * lost, 0.95)
            scores = before * np.where(hit, rng.uniform(0.1, 0.6, 10), 1)
            rows.append(
                {
                    "name": name, "kind": kind, "strength": strength,
                    "scores": scores.tolist(), "returns": scores.tolist(),
                    "lengths": [900] * 10, **recovery(rng, kind, hit, size, back),
                }
            )  # fmt: skip
        part = {"scores": before.tolist(), "returns": before.tolist(), "seeds": seeds}
        evaluations.append({"step": step, "clean": part, "levels": rows})
    return {
        "format": 1, "versions": VERSIONS, "env": env, "data": level, "suite": "oos",
        "episodes": 10, "seed": 20_000, "threshold": 1.7, "evaluations": evaluations,
        "summary": [],
    }  # fmt: skip


def recovery(rng, kind: str, hit, size: float, back: float) -> dict:
    """Return the way back after a knock or a push, nulls after others."""
    if kind not in ("knock", "push"):
        return {"disturbed_at": [0] * 10} | dict.fromkeys(TRANSIENT)
    reached = rng.random(10) < 0.9
    recovered = reached & (rng.random(10) < back)
    steps = rng.geometric(0.06, 10)
    offset, rate = np.arange(-10, 101), back * rng.uniform(0.7, 1.4)
    curve = np.where(offset < -5, 0.8, 0.8 + 3 * size * np.exp(-rate * offset / 30))
    return {
        "disturbed_at": [100 if each else None for each in reached],
        "survived_knock": [True if each else None for each in reached],
        "alive_after": [
            not bool(h) if r else None for r, h in zip(reached, hit, strict=True)
        ],
        "clean_alive_after": [True if each else None for each in reached],
        "recovery_steps": [
            int(s) if r else None for r, s in zip(recovered, steps, strict=True)
        ],
        "distance": {
            "offset": offset.tolist(),
            "mean": curve.clip(max=0.8 + 3 * size).tolist(),
            "count": np.linspace(reached.sum(), hit.sum(), 111).astype(int).tolist(),
            "clean_mean": [0.8] * 111,
            "clean_count": [int(reached.sum())] * 111,
        },
    }


def write_experiment(
    folder: Path,
    *,
    data: tuple[str, ...] = ("hopper-medium-replay", "walker2d-medium-expert"),
    seeds: tuple[int, ...] = (0, 1, 2),
    versions: dict | None = None,
) -> Path:
    """Write runs of all methods, laid out as results/oos/run.py does."""
    for number, name in enumerate(data):
        env, level = name.split("-", 1)
        for method, (final, lost, back) in METHODS.items():
            for seed in seeds:
                rng = np.random.default_rng([number, final, seed])
                final_here = final + 20 * number + 6 * rng.normal()
                curve = {
                    step: episodes(rng, final_here * (1 - np.exp(-step / 2500)))
                    for step in range(1000, 8001, 1000)
                }
                run = write_run(
                    folder / name / method / f"seed{seed}", curve, env=env, level=level,
                    seed=seed, loss=LOSSES[method], versions=versions,
                    data_score=15.6 + 30 * number,
                    overrides=[f"env={env}", f"data={level}", f"loss={method}"],
                )  # fmt: skip
                content = robustness(
                    rng, env, level, [7000, 8000], final_here, lost, back
                )
                write_json(run / "robustness-oos.json", content)
    return folder


def write_hand(folder: Path, curve: dict, *, suite: dict | None = None, **options):
    """Write a run, and a robustness file made by hand."""
    write_run(folder, curve, **options)
    if suite:
        write_json(folder / "robustness-hand.json", suite)


def hand_level(name, scores, kind="dynamics", strength=1.0, **entries) -> dict:
    base = {"name": name, "kind": kind, "strength": strength, "scores": scores}
    return (
        base | {"disturbed_at": [0] * len(scores)} | dict.fromkeys(TRANSIENT) | entries
    )


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
