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
from check import put
from world import World

from torchrl_osr.data import make_environment
from torchrl_osr.evaluation import deterministic_policy
from torchrl_osr.evaluation.recoverable import (
    RecoverableStates,
    load_recoverable_states,
)
from torchrl_osr.experiment.trained_run import load_trained
from torchrl_osr.film import Camera, Take, film_gif, film_strip

FIGURES = Path(__file__).parents[2] / "docs" / "figures"
COLUMNS = (0, 10, 20, 40, 60, 80, 110, 150, 220, 300)
MOVING = 200
"""Steps of the moving film."""


def came_back(run: Path) -> np.ndarray:
    """Whether each checkpoint came back from each public state, ``[N, M]``."""
    found = json.loads((run / "recoverable-public.json").read_text())
    return np.array([each["back"] for each in found["evaluations"]])


def policy_of(run: Path):
    """The last checkpoint's action for an observation."""
    trained = load_trained(run)
    act = deterministic_policy(trained.actor, trained.observation_norm)

    def policy(observation: np.ndarray, step: int) -> np.ndarray:
        return act(torch.from_numpy(observation).float()[None])[0].numpy()

    return policy


def planner(world: World, states: RecoverableStates, number: int):
    """The expert, and what the search added to its actions."""
    expert = world.policy("expert")
    offsets = np.repeat(states.offsets[number], states.hold, axis=0)

    def policy(observation: np.ndarray, step: int) -> np.ndarray:
        action = expert(observation[None])[0]
        return action + offsets[step] if step < len(offsets) else action

    return policy


def take(world: World, states: RecoverableStates, number: int, name: str, policy):
    """What a policy does from a state."""
    row = [[0.0], states.qpos[number], states.qvel[number], states.goal[number]]
    observation = put(world, np.concatenate(row))
    seen, poses, fell = [observation], [states.qpos[number]], False
    for step in range(states.steps):
        action = np.clip(policy(observation, step), -1, 1)
        observation, _, fell, _, _ = world.env.step(action)
        seen.append(observation)
        poses.append(world.simulation.data.qpos.copy())
        if fell:
            break
    return Take(name, np.stack(seen), np.stack(poses), -1, 0, bool(fell))


def main() -> None:
    """Choose the state, play it three times, draw."""
    clone, ours = map(Path, sys.argv[1:])
    system = load_trained(ours).config.env.name
    states, world = load_recoverable_states(system), World(system)
    theirs, mine = came_back(clone), came_back(ours)
    recoverable = states.group == "recoverable"
    tells = recoverable & (states.kind == "push") & mine.all(0) & ~theirs.any(0)
    number = int(np.flatnonzero(tells)[0])
    takes = [
        take(world, states, number, "noisy cloning", policy_of(clone)),
        take(world, states, number, "recovery by imagination", policy_of(ours)),
        take(
            world, states, number, "planner, simulator", planner(world, states, number)
        ),
    ]
    shares = [100 * each[:, recoverable].mean() for each in (theirs, mine)]
    title = f"After a push ({states.strength[number]:g} body weights): who comes back?"
    share = (
        f"Of all {recoverable.sum()} recoverable states noisy cloning comes back from "
        f"{shares[0]:.0f} %, recovery by imagination from {shares[1]:.0f} %, the "
        "planner from all."
    )
    chosen = f"State {number} of {system}'s public half, which tells them apart."
    camera = Camera(make_environment(load_trained(ours).config.env.id), 224)
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
