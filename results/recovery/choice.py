"""Do policies of several seeds come back more often if one is chosen at each moment?

    python results/recovery/choice.py outputs/imagination --seeds 0 1 2 3 4

Every few steps the return of each run's policy is predicted, and the best one acts:
roll-outs in all runs' models, and the mean of all runs' critics at their end. All of it
comes of the runs' own data. One line for each arm and group of states is appended to
``parts/<system>/choice-<half>.jsonl``: a bit for each state; what is there is not
played again. Beside easy states the undisturbed score is measured.

Shapes: ``B`` states, ``n`` rows.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from cloning import rows_of, undisturbed
from look_ahead import in_numpy
from search import read_jsonl
from states import PARTS, normal
from torch import Tensor
from world import World

from torchrl_osr._files import sha256_of
from torchrl_osr.data.collect.environment import environment_id
from torchrl_osr.evaluation.recoverable import (
    STATES,
    RecoverableStates,
    read_recoverable_states,
)
from torchrl_osr.experiment.dynamics import FILE, load_dynamics
from torchrl_osr.experiment.trained_run import checkpoints_of
from torchrl_osr.imagination import termination
from torchrl_osr.policy import Policy, load_policy

GAMMA = 0.99
"""Of the runs."""


class Arm(NamedTuple):
    """How a policy is chosen.

    Attributes:
        steps: of the roll-outs.
        least: the least hopeful network of all models, with the least hopeful of all
            critics, and not their means.
        alive: steps alive alone, without rewards and critics.
        every: steps for which the chosen policy acts.
    """

    steps: int = 0
    least: bool = False
    alive: bool = False
    every: int = 4


ARMS = {
    "one": Arm(),
    "mean": Arm(),
    "random": Arm(),
    "critics": Arm(),
    "critics, least": Arm(least=True),
    "models 20": Arm(20),
    "models 20, least": Arm(20, least=True),
    "models 20, anew": Arm(20, every=1),
    "models 60": Arm(60),
    "models 100, alive": Arm(100, alive=True),
    "shuffled 20": Arm(20),
    "simulator 20": Arm(20),
}


class Choice:
    """Predicts what each of several policies would return.

    Args:
        runs: their folders.
        world: of the simulator's arm.
        arm: of :data:`ARMS`.
        last: how many of each run's last checkpoints are chosen from; models and
            critics are those of its end.
    """

    def __init__(self, runs: list[Path], world: World, arm: str, last: int = 1) -> None:
        paths = [path for run in runs for path in checkpoints_of(run)[-last:]]
        self.policies: list[Policy] = [load_policy(path) for path in paths]
        self.ends = self.policies[last - 1 :: last]
        self.models = [load_dynamics(run / FILE).elite_networks() for run in runs]
        self.world, self.arm = world, arm
        self.steps, self.least, self.alive, self.every = ARMS[arm]
        self.terminated = termination(environment_id(world.system))
        self.chance = torch.Generator().manual_seed(0)

    def value(self, state: Tensor, policy: Policy) -> Tensor:
        """What the critics of all runs say of a policy's action, ``[n]``."""
        if self.alive:
            return torch.zeros(len(state))
        action = policy(state)
        values = [each.smallest_value(state, action) for each in self.ends]
        return self.one_of(torch.stack(values))

    def one_of(self, values: Tensor) -> Tensor:
        """The mean over the first dimension, or the least."""
        return values.amin(0) if self.least else values.mean(0)

    def predicted(self, state: Tensor, policy: Policy) -> Tensor:
        """Return of a policy in all networks of all models, ``[B]``."""
        if not self.steps:
            return self.value(state, policy)
        found = []
        for run, model in zip(self.ends, self.models, strict=True):
            networks = model.num_networks
            now = state.repeat(networks, 1)
            alive, total = torch.ones(len(now)), torch.zeros(len(now))
            for step in range(self.steps):
                action = policy(now)
                inputs = torch.cat([(now - run.loc) / run.scale, action], -1)
                mean, _ = model.standardized(inputs.view(networks, len(state), -1))
                change = (mean * model.target_scale + model.target_loc).flatten(0, 1)
                after = now + change[:, :-1] * run.scale
                reward = change[:, -1]
                finite = after.isfinite().all(-1)
                stands = alive * (finite & ~self.terminated(after))
                total += stands if self.alive else GAMMA**step * alive * reward
                alive = stands
                # What has fallen must not grow until it overflows.
                now = torch.where(alive.bool().unsqueeze(-1), after, now)
            total += GAMMA**self.steps * alive * self.value(now, policy)
            found.append(total.view(networks, -1))
        return self.one_of(torch.cat(found))

    def simulated(self, rows: np.ndarray, policy: Policy) -> Tensor:
        """The same by the simulator, of rows of ``world.py``."""
        world = self.world
        played = world.play(rows, in_numpy(policy), self.steps)
        way = (played.rows[:, 1] - rows[:, 1]) / world.seconds
        end = torch.from_numpy(world.observe(played.rows)).float()
        stands = torch.from_numpy(played.success)
        total = torch.from_numpy(way + played.alive).float()
        return total + GAMMA**self.steps * stands * self.value(end, policy)

    @torch.no_grad()
    def choose(self, rows: np.ndarray) -> np.ndarray:
        """Number of the policy that acts in each state, ``[B]``."""
        state = torch.from_numpy(self.world.observe(rows)).float()
        if self.arm == "random":
            size = (len(rows),)
            return torch.randint(
                len(self.policies), size, generator=self.chance
            ).numpy()
        if self.arm.startswith("simulator"):
            scores = [self.simulated(rows, each) for each in self.policies]
        else:
            scores = [self.predicted(state, each) for each in self.policies]
        table = torch.stack(scores, 1)
        if self.arm.startswith("shuffled"):
            order = torch.rand(table.shape, generator=self.chance).argsort(1)
            table = table.gather(1, order)
        return table.argmax(1).numpy()

    def __call__(self, state: Tensor) -> Tensor:
        """The mean action, or the chosen policy's, chosen anew in every step."""
        actions = torch.stack([policy(state) for policy in self.policies])
        if self.arm == "mean":
            return actions.mean(0)
        seen = state.double().numpy()
        rows = np.hstack([np.zeros((len(seen), 2)), seen])  # time and x: nobody sees
        return actions[self.choose(rows), torch.arange(len(state))]


def play(states: RecoverableStates, chosen: np.ndarray, choice: Choice) -> np.ndarray:
    """Which of the chosen states it comes back from."""
    world = choice.world
    rows, count = rows_of(states, chosen), len(chosen)
    if choice.arm == "mean":
        return world.play(rows, in_numpy(choice), states.steps).success
    active = np.arange(count)
    for _ in range(0, states.steps, choice.every):
        number, stands = choice.choose(rows[active]), []
        for index, policy in enumerate(choice.policies):
            mine = active[number == index]
            played = world.play(rows[mine], in_numpy(policy), choice.every)
            rows[mine] = played.rows
            stands.append(mine[played.success])
        active = np.sort(np.concatenate(stands))
    return np.isin(np.arange(count), active)


def main() -> None:
    """Play what was not yet."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--data", default="walker2d-medium-expert")
    parser.add_argument("--runs", default="disturbed starts")
    parser.add_argument("--half", default="public", choices=("public", "held-out"))
    parser.add_argument("--seeds", type=int, nargs="+", required=True)
    parser.add_argument("--last", type=int, default=1, help="checkpoints of each run")
    parser.add_argument("--arms", nargs="+", default=list(ARMS), choices=ARMS)
    parser.add_argument(
        "--groups", nargs="+", default=["recoverable", "easy", "contested"]
    )
    given = parser.parse_args()
    torch.set_num_threads(1)
    world = World(given.data.split("-")[0])
    normal(world)
    path = STATES / f"{world.system}-{given.half}.npz"
    states, digest = read_recoverable_states(path), sha256_of(path)
    log = PARTS / world.system / f"choice-{given.half}.jsonl"
    names = ("arm", "runs", "seeds", "group", "states", "last")
    there = [[line.get(name, 1) for name in names] for line in read_jsonl(log)]
    folders = [given.folder / given.data / given.runs / f"seed{n}" for n in given.seeds]
    of = f"{given.data}, {given.runs}"
    for group in given.groups:
        chosen = np.flatnonzero(states.group == group)
        for arm in given.arms:
            alone = [[seed] for seed in given.seeds]
            for seeds in alone if arm == "one" else [given.seeds]:
                key = [arm, of, seeds, group, digest, given.last]
                if key in there:
                    continue
                start = time.process_time()
                runs = [folders[given.seeds.index(seed)] for seed in seeds]
                kind = "mean" if arm == "one" else arm
                choice = Choice(runs, world, kind, given.last)
                line: dict[str, Any] = dict(zip(names, key, strict=True))
                back = play(states, chosen, choice)
                line["saved"] = "".join(map(str, back.astype(int)))
                if group == "easy":
                    line["undisturbed"] = round(undisturbed(world, choice), 2)
                line["seconds"] = round(time.process_time() - start, 1)
                with log.open("a") as file:
                    file.write(json.dumps(line, separators=(",", ":")) + "\n")
                shown = f"{arm} {seeds} {group}: {back.sum()} of {len(back)}"
                print(shown, line.get("undisturbed", ""), line["seconds"], flush=True)


if __name__ == "__main__":
    main()
