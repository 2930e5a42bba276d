"""Compare ``world.py`` with the Gymnasium environments: states, observations, ends.

python results/recovery/check.py
"""

from __future__ import annotations

import numpy as np
from clones import SYSTEMS
from world import World


def put(world: World, row: np.ndarray) -> None:
    """Set the environment's state, as a fresh one would have it."""
    world.env.reset(seed=1)
    if world.is_maze:
        world.env.unwrapped.goal = row[world.size :].copy()
    simulation = world.simulation
    simulation.data.qacc_warmstart[:] = 0
    simulation.set_state(row[1 : 1 + world.nq], row[1 + world.nq : world.size])


def main() -> None:
    """Play each system with random actions, from states a little off its start."""
    for system in SYSTEMS:
        world = World(system)
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
                assert ended == terminated, (system, episode)
                steps += 1
                if terminated:
                    ends += 1
                    break
        print(
            f"{system}: {steps} steps, {ends} ends alike, largest difference "
            f"{worst:.1e}"
        )


if __name__ == "__main__":
    main()
