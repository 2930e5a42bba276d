"""Do policies of several seeds come back more often if one is chosen at each moment?

    python results/recovery/choice.py outputs/imagination --seeds 0 1 2 3 4
    sh results/recovery/look.sh

``torchrl_osr.imagination.SwitchingPolicy``: every four steps each run's policy is
rolled out in all runs' models, the mean of all runs' critics values the end, and the
best one acts. All of it comes of the runs' own data. One line for each arm and group of
states is appended to ``parts/<system>/choice-<half>.jsonl``: a bit for each state; what
is there is not played again. Beside easy states the undisturbed score of twenty
episodes is measured.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from cloning import undisturbed
from search import read_jsonl
from states import PARTS
from torch import Tensor
from torchrl_osr.evaluation.recoverable import (
    GROUPS,
    STATES,
    RecoverableStates,
    read_recoverable_states,
    recovers,
)
from torchrl_osr.policy.switching import load_switching_policy
from world import World

from torchrl_osr._files import sha256_of
from torchrl_osr.policy import load_policy

JUDGES = "disturbed starts"
"""Runs whose models and critics predict."""

ARMS = {
    "one": {},
    "mean": {},
    "random": {},
    "critics": {"critics_only": True},
    "models 20": {"steps": 20},
    "models 20, anew": {"steps": 20, "hold": 1},
    "models 20, ten steps": {"steps": 20, "hold": 10},
    "models 20, one judge": {"steps": 20},
    "models 20, ten steps, one judge": {"steps": 20, "hold": 10},
    "models 60": {"steps": 60},
    "shuffled 20": {"steps": 20},
}
"""What :func:`load_switching_policy` is given; in some something else chooses."""


def policy_of(arm: str, runs: list[Path], judges: list[Path]) -> Callable[..., Tensor]:
    """Of an arm."""
    if arm == "one":
        return load_policy(runs[0])
    if arm.endswith("one judge"):
        judges = judges[:1]
    policy = load_switching_policy(runs, judges=judges, **ARMS[arm])
    chance = torch.Generator().manual_seed(0)
    predicted = policy.returns

    def shuffled(state: Tensor) -> Tensor:
        """Each policy is predicted what another one is."""
        found = predicted(state)
        order = torch.rand(found.shape, generator=chance).argsort(1)
        return found.gather(1, order)

    def anything(state: Tensor) -> Tensor:
        return torch.rand(len(state), len(runs), generator=chance)

    def mean(state: Tensor) -> Tensor:
        return torch.stack([each(state) for each in policy.policies]).mean(0)

    if arm == "mean":
        return mean
    policy.returns = {"shuffled 20": shuffled, "random": anything}.get(arm, predicted)
    return policy


def play(
    states: RecoverableStates, group: str, policy: Callable[[Tensor], Tensor]
) -> np.ndarray:
    """Which states of a group it comes back from."""
    chosen, of_each = states.group == group, vars(states)
    mine = {
        name: value[chosen]
        for name, value in of_each.items()
        if isinstance(value, np.ndarray)
    }
    return recovers(RecoverableStates(**of_each | mine), policy)


def main() -> None:
    """Play what was not yet."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", type=Path, help="of imagination.py")
    parser.add_argument("--data", default="walker2d-medium-expert")
    parser.add_argument("--policies", default=JUDGES, help="the runs they are of")
    parser.add_argument("--among", type=Path, nargs="+", help="of these runs instead")
    parser.add_argument("--half", default="public", choices=("public", "held-out"))
    parser.add_argument("--seeds", type=int, nargs="+", required=True)
    parser.add_argument("--arms", nargs="+", default=list(ARMS), choices=ARMS)
    parser.add_argument("--groups", nargs="+", default=["recoverable"], choices=GROUPS)
    given = parser.parse_args()
    torch.set_num_threads(1)
    world = World(given.data.split("-")[0])
    path = STATES / f"{world.system}-{given.half}.npz"
    states, digest = read_recoverable_states(path), sha256_of(path)
    log = PARTS / world.system / f"choice-{given.half}.jsonl"
    names = ("arm", "runs", "seeds", "group", "states")
    there = [[line[name] for name in names] for line in read_jsonl(log)]
    top = given.folder / given.data
    judges = [top / JUDGES / f"seed{seed}" for seed in given.seeds]
    runs = [top / given.policies / f"seed{seed}" for seed in given.seeds]
    labels: list[Any] = given.seeds
    if given.among:
        runs = given.among
        labels = ["/".join(each.parts[-2:]) for each in runs]
    for group in given.groups:
        for arm in given.arms:
            for first in range(len(runs)) if arm == "one" else [None]:
                mine = slice(None) if first is None else slice(first, first + 1)
                of = f"{given.data}, {given.policies}"
                key = [arm, of, labels[mine], group, digest]
                if key in there:
                    continue
                start = time.process_time()
                policy = policy_of(arm, runs[mine], judges)
                line: dict[str, Any] = dict(zip(names, key, strict=True))
                back = play(states, group, policy)
                line["saved"] = "".join(map(str, back.astype(int)))
                if group == "easy":
                    line["undisturbed"] = round(undisturbed(world, policy), 2)
                line["seconds"] = round(time.process_time() - start, 1)
                with log.open("a") as file:
                    file.write(json.dumps(line, separators=(",", ":")) + "\n")
                shown = f"{arm} {key[2]} {group}: {back.sum()} of {len(back)}"
                print(shown, line.get("undisturbed", ""), line["seconds"], flush=True)


if __name__ == "__main__":
    main()
