"""Film one recoverable state: a clone falls, the planner and another policy do not.

    python results/recovery/film.py <run of noisy cloning> <run of ours>

Both runs have been played from the public half (``suite=recoverable``). The film shows
the first state after a push from which all of our checkpoints came back and none of the
clone's; the share of all states, in its title, is what counts.
"""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

os.environ.setdefault("MUJOCO_GL", "egl")

import numpy as np
import torch
from check import Policy, planner, played, row_of
from torchrl_osr.data import make_environment
from torchrl_osr.evaluation import deterministic_policy
from torchrl_osr.evaluation.recoverable import (
    RecoverableStates,
    load_recoverable_states,
)
from torchrl_osr.experiment.trained_run import TrainedRun, load_trained
from torchrl_osr.film import Camera, Take, film_gif, film_strip
from world import World

FIGURES = Path(__file__).parents[2] / "docs" / "figures"
COLUMNS = (0, 10, 20, 40, 60, 80, 110, 150, 220, 300)
MOVING = 200
"""Steps of the moving film."""


def came_back(run: Path) -> np.ndarray:
    """Whether each checkpoint came back from each public state, ``[N, M]``."""
    found = json.loads((run / "recoverable-public.json").read_text())
    return np.array([each["back"] for each in found["evaluations"]])


def policy_of(trained: TrainedRun) -> Policy:
    """Its checkpoint's action."""
    act = deterministic_policy(trained.actor, trained.observation_norm)

    def policy(observation: np.ndarray, step: int) -> np.ndarray:
        return act(torch.from_numpy(observation).float()[None])[0].numpy()

    return policy


def take(
    world: World, states: RecoverableStates, number: int, name: str, policy: Policy
) -> Take:
    """What a policy does from a state."""
    seen = [world.observe(row_of(states, number)[None])[0]]
    poses, fell = [states.qpos[number]], False
    for observation, terminated, _ in played(world, states, number, policy):
        seen.append(observation)
        poses.append(world.simulation.data.qpos.copy())
        fell = terminated
    return Take(name, np.stack(seen), np.stack(poses), -1, 0, bool(fell))


def main() -> None:
    """Choose the state, play it three times, draw."""
    clone, ours = map(Path, sys.argv[1:])
    policies = {
        "noisy cloning": load_trained(clone),
        "recovery by imagination": (trained := load_trained(ours)),
    }
    env = trained.config.env
    states, world = load_recoverable_states(env.name), World(env.name)
    theirs, mine = came_back(clone), came_back(ours)
    recoverable = states.group == "recoverable"
    tells = recoverable & (states.kind == "push") & mine.all(0) & ~theirs.any(0)
    number = int(np.flatnonzero(tells)[0])
    controllers = {name: policy_of(each) for name, each in policies.items()}
    controllers["planner, simulator"] = planner(world, states, number)
    takes = [
        take(world, states, number, name, policy)
        for name, policy in controllers.items()
    ]
    shares = [100 * each[:, recoverable].mean() for each in (theirs, mine)]
    title = f"After a push ({states.strength[number]:g} body weights): who comes back?"
    share = (
        f"Of all {recoverable.sum()} recoverable states noisy cloning comes back from "
        f"{shares[0]:.0f} %, recovery by imagination from {shares[1]:.0f} %, the "
        "planner from all."
    )
    chosen = f"State {number} of {env.name}'s public half, which tells them apart."
    camera = Camera(make_environment(env.id), 224)
    options = {"title": title, "event": "push"}
    film_strip(
        takes, camera, FIGURES / "recovery.png",
        offsets=COLUMNS, note=f"{chosen}\n{share}", **options,
    )  # fmt: skip
    film_gif(
        takes, camera, FIGURES / "recovery.gif",
        offsets=range(MOVING + 1), note=chosen, **options,
    )  # fmt: skip
    camera.close()
    print(number, [each.last for each in takes], shares)


if __name__ == "__main__":
    main()
