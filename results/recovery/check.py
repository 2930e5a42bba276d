"""Compare ``world.py`` with the Gymnasium environments, and replay the witnesses there.

    python results/recovery/check.py

States, observations and ends of random steps; then every packed witness, step by step
in the environment: those that fail there are listed, and are no witnesses. At last each
after eight changes that the search has not seen: it tried many ways on its own eight.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from clones import SYSTEMS
from search import CHANGES
from states import generator, normal
from torchrl_osr.evaluation.recoverable import (
    STATES,
    RecoverableStates,
    read_recoverable_states,
)
from world import SPEED_STEPS, Rows, World

Policy = Callable[[np.ndarray, int], np.ndarray]
"""Action for an observation and the number of the step."""


def put(world: World, row: np.ndarray) -> np.ndarray:
    """Set the environment's state, as a fresh one would have it; the observation."""
    world.env.reset(seed=1)
    if world.is_maze:
        world.env.unwrapped.goal = row[world.size :].copy()
    simulation = world.simulation
    simulation.data.qacc_warmstart[:] = 0
    simulation.set_state(row[1 : 1 + world.nq], row[1 + world.nq : world.size])
    return world.observe(world.current()[None])[0]


def compare(world: World) -> None:
    """Play with random actions, from states a little off the start."""
    rng = np.random.default_rng(0)
    worst, ends, steps = 0.0, 0, 0
    for episode in range(20):
        world.env.reset(seed=episode)
        row = world.current()
        row[1 + world.nq : world.size] += 0.3 * rng.standard_normal(world.nv)
        put(world, row)
        for _ in range(100):
            # From the environment's state: differences do not add up.
            row = world.current()[None]
            action = rng.uniform(-1, 1, world.nu).astype(np.float32)
            observation, _, terminated, _, _ = world.env.step(action)
            after = world.step(row, action[None])
            difference = world.observe(after)[0] - observation
            worst = max(worst, float(np.abs(difference).max()))
            stands = world.standing(after)[0]
            ended = world.at_goal(after)[0] if world.is_maze else not stands
            assert ended == terminated, (world.system, episode)
            steps += 1
            if terminated:
                ends += 1
                break
    print(
        f"{world.system}: {steps} steps, {ends} ends alike, largest difference "
        f"{worst:.1e}",
        flush=True,
    )


def row_of(states: RecoverableStates, number: int) -> np.ndarray:
    """A state as a row, at time 0."""
    parts = states.qpos[number], states.qvel[number], states.goal[number]
    return np.concatenate([[0.0], *parts])


def planner(world: World, states: RecoverableStates, number: int) -> Policy:
    """The expert, and what the search added to its actions, by state and step."""
    expert = world.policy("expert")
    offsets = np.repeat(states.offsets[number], states.hold, axis=0)

    def policy(observation: np.ndarray, step: int) -> np.ndarray:
        action = expert(observation[None])[0]
        return action + offsets[step] if step < len(offsets) else action

    return policy


def played(
    world: World, states: RecoverableStates, number: int, policy: Policy
) -> Iterator[tuple[np.ndarray, bool, dict[str, Any]]]:
    """Observation, end and info of each step in the environment from a state on."""
    observation = put(world, row_of(states, number))
    for step in range(states.steps):
        action = np.clip(policy(observation, step), -1, 1)
        observation, _, terminated, _, info = world.env.step(action)
        yield observation, terminated, info
        if terminated:
            return


def holds(world: World, states: RecoverableStates, number: int) -> bool:
    """Whether a witness succeeds in the environment."""
    speeds = []
    way = planner(world, states, number)
    for _, terminated, info in played(world, states, number, way):
        if terminated:
            return world.is_maze
        speeds.append(info.get("x_velocity", 0.0))
    return not world.is_maze and np.mean(speeds[-SPEED_STEPS:]) >= states.least_speed


def after_changes(world: World, states: RecoverableStates, numbers: np.ndarray) -> Rows:
    """Share of eight new changes after which each witness succeeds, ``[M]``."""
    goals = states.goal[numbers]
    time = np.zeros((len(numbers), 1))
    rows = np.hstack([time, states.qpos[numbers], states.qvel[numbers], goals])
    offsets = np.repeat(states.offsets[numbers], states.hold, axis=1)
    std, rng = normal(world)["std"], generator(world.system, 4)
    expert = world.policy("expert")
    back = [
        world.play(
            world.changed(rows, change * std, rng), expert, states.steps, offsets
        ).success
        for change in CHANGES
    ]
    return np.mean(back, axis=0)


def main() -> None:
    """Both, for all systems."""
    for system in SYSTEMS:
        world = World(system)
        normal(world)
        compare(world)
        for path in sorted(STATES.glob(f"{system}-*.npz")):
            states = read_recoverable_states(path)
            numbers = np.flatnonzero(states.group == "recoverable")
            if not len(numbers):
                continue
            failed = [int(each) for each in numbers if not holds(world, states, each)]
            shares = after_changes(world, states, numbers)
            print(
                f"{path.name}: {len(numbers)} witnesses, fail: {failed}; after new "
                f"changes {shares.mean():.3f} succeed, the worst {shares.min():.3f}",
                flush=True,
            )


if __name__ == "__main__":
    main()
