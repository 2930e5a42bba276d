"""Do corrective labels lead back in the maze's simulator itself?

    python results/recovery/corrective_error.py > results/recovery/corrective_error.txt

From displaced states, one true step with each label of ``cloning.py``; then the median
distance to the nearest next state of the data, in standard deviations.
"""

from __future__ import annotations

import numpy as np
import torch
from cloning import Demonstrations
from states import normal
from world import World

COUNT, PUSH = 3000, 0.3


def main() -> None:
    """Of 20 episodes, seed 0."""
    torch.set_num_threads(1)
    world = World("pointmaze-medium")
    normal(world)
    data = Demonstrations(world, episodes=20, seed=0, updates=2000)
    reference = data.following / data.unit
    rows = np.zeros(0)

    def describe(name: str, rows: np.ndarray) -> None:
        state = data.state_of(torch.from_numpy(world.observe(rows)).float())
        nearest = torch.cdist(state / data.unit, reference).min(1).values
        print(f"{name}: {nearest.median():.4f}", flush=True)

    for label in ("displaced", "row", "flipped"):
        state, action = data.corrective(PUSH, 1, label)
        if not len(rows):
            seen = state[:COUNT].double().numpy()
            rows = np.hstack([np.zeros((COUNT, 1)), seen[:, 4:], seen[:, 2:4]])
            describe("where they begin", rows)
        describe(label, world.step(rows, action[:COUNT].numpy()))


if __name__ == "__main__":
    main()
