"""Clones of the experts: a jury for each system, and one that stays outside.

    python results/recovery/clones.py walker2d

Each has rows, network and order of its own seed. They are stored as behaviour policies
are, in ``clones/<system>/<number>.npz``; the last is outside. ``scores.json`` beside
them has the undisturbed D4RL scores of ten episodes each; of the maze, successes.
"""

from __future__ import annotations

import json
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from torch import nn
from torchrl_osr.data import collect_quality, normalized_score, save_behavior_policy
from torchrl_osr.data.collect.behavior import Affine, BehaviorPolicy
from torchrl_osr.data.collect.environment import environment_id
from torchrl_osr.evaluation import EpisodeEvaluator

from torchrl_osr._files import read_arrays, write_json

FOLDER = Path(__file__).parent / "clones"
JURORS = {"hopper": 4, "walker2d": 4, "halfcheetah": 4, "pointmaze-medium": 8}
"""The maze's clones differ more, and are its whole jury."""

SYSTEMS = tuple(JURORS)
ROWS, UPDATES, WIDTH = 50_000, 8_000, 256
MAZE_EPISODES = 100


def rows_of(system: str, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Observations and actions of the expert; of the maze, 100 episodes."""
    if system.startswith("pointmaze"):
        rows = collect_quality(system, "play", 60_000, seed=seed, progress=False).data
        ends = (rows["next", "done"]).flatten().nonzero().flatten()
        rows = rows[: int(ends[MAZE_EPISODES - 1]) + 1]
    else:
        rows = collect_quality(system, "expert", ROWS, seed=seed, progress=False).data
    return rows["observation"].numpy(), rows["action"].numpy()


def clone(observation: np.ndarray, action: np.ndarray, seed: int) -> BehaviorPolicy:
    """Least squares on the squashed mean, Adam; inputs standardised, then folded in."""
    torch.manual_seed(seed)
    loc, scale = observation.mean(0), observation.std(0) + 1e-6
    inputs = torch.from_numpy((observation - loc) / scale)
    target = torch.from_numpy(action)
    sizes = observation.shape[1], WIDTH, WIDTH, action.shape[1]
    layers = [nn.Linear(a, b) for a, b in pairwise(sizes)]
    net = nn.Sequential(
        layers[0], nn.ReLU(), layers[1], nn.ReLU(), layers[2], nn.Tanh()
    )
    optimizer = torch.optim.Adam(net.parameters(), 1e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, UPDATES)
    for _ in range(UPDATES):
        rows = torch.randint(len(inputs), (256,))
        loss = (net(inputs[rows]) - target[rows]).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    weights = [
        [x.detach().numpy().astype(np.float32) for x in (layer.weight, layer.bias)]
        for layer in layers
    ]
    first, bias = weights[0]
    weights[0] = [(first / scale).astype(np.float32), bias - first @ (loc / scale)]
    head = Affine(*weights[2])
    silent = Affine(np.zeros_like(head.weight), np.full_like(head.bias, -20))
    hidden0, hidden1 = (Affine(w, b.astype(np.float32)) for w, b in weights[:2])
    return BehaviorPolicy(hidden0, hidden1, head, silent)


def load_clone(system: str, number: int) -> BehaviorPolicy:
    """One of them."""
    arrays = read_arrays(FOLDER / system / f"{number}.npz")
    names = ("hidden0", "hidden1", "mean", "log_std")
    layers = (
        (arrays[f"{name}.{part}"].astype(np.float32) for part in ("weight", "bias"))
        for name in names
    )
    return BehaviorPolicy(*(Affine(*layer) for layer in layers))


def score(system: str, number: int) -> list[float]:
    """Of ten undisturbed episodes."""
    policy = load_clone(system, number).deterministic
    evaluator = EpisodeEvaluator(environment_id(system), num_episodes=10, seed=100)
    results = evaluator(lambda rows: torch.from_numpy(policy(rows.numpy())))
    evaluator.close()
    if results.successes is not None:
        return results.successes.astype(float).tolist()
    return np.round(normalized_score(system, results.returns), 1).tolist()


def main() -> None:
    """Train and play what is not there yet."""
    torch.set_num_threads(1)
    for system in sys.argv[1:] or SYSTEMS:
        for number in range(JURORS[system] + 1):
            path = FOLDER / system / f"{number}.npz"
            if path.exists():
                continue
            seed = 9_000 + number
            policy = clone(*rows_of(system, seed), seed)
            save_behavior_policy(path, policy, half=True)
            print(json.dumps({"clone": f"{system}/{number}", "seed": seed}), flush=True)
        path = FOLDER / system / "scores.json"
        if not path.exists():
            everyone = range(JURORS[system] + 1)
            write_json(path, {each: score(system, each) for each in everyone})


if __name__ == "__main__":
    main()
