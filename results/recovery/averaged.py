"""Does the mean action of five seeds come back more often than one of them?

    python results/recovery/averaged.py outputs/look > results/recovery/averaged.txt

Last checkpoints of the looks' runs, public half, percent of the states of each group:
the mean over single policies, and the policy of their mean action.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import torch
from torchrl_osr.evaluation import deterministic_policy
from torchrl_osr.evaluation.recoverable import (
    GROUPS,
    load_recoverable_states,
    recovers,
)
from torchrl_osr.experiment.trained_run import load_trained

ARMS = "disturbed starts", "undisturbed starts", "noisy cloning"


def main() -> None:
    """Play all of them."""
    torch.set_num_threads(1)
    print("percent:", *GROUPS[::-1])
    for robot in ("walker2d", "hopper"):
        states = load_recoverable_states(robot)
        for arm in ARMS:
            folder = Path(sys.argv[1]) / f"{robot}-medium-expert" / arm
            runs = [load_trained(run) for run in sorted(folder.glob("seed*"))]
            singles = [
                deterministic_policy(run.actor, run.observation_norm) for run in runs
            ]

            def averaged(state: torch.Tensor, singles: list = singles) -> torch.Tensor:
                return torch.stack([policy(state) for policy in singles]).mean(0)

            back = [recovers(states, policy) for policy in (*singles, averaged)]
            shares = [
                [100 * each[states.group == group].mean() for group in GROUPS[::-1]]
                for each in back
            ]
            print(f"{robot}, {arm}, {len(singles)} seeds")
            print("  one of them   ", *np.mean(shares[:-1], 0).round(1))
            print("  their mean    ", *np.round(shares[-1], 1), flush=True)


if __name__ == "__main__":
    main()
