"""Step 3: few demonstrations, and what a state beside them is labelled with.

    python results/recovery/cloning.py walker2d --episodes 20 --seeds 0 1 2
    python results/recovery/cloning.py walker2d --study ways --arms ways:0:100

Every arm clones the same rows with the same network, half of each batch being states
displaced from them; arms differ in these states and their labels, of which a table is
drawn beforehand. One line for each arm and seed is appended to
``parts/<system>/<study>-<half>.jsonl``, with a bit for each state in the order of the
file of states; what is there is not trained again.

Shapes: ``N`` rows, ``S`` observation, ``X`` state, ``A`` action.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from functools import cache, cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from search import HOLD, hard_states, read_jsonl, read_lines
from states import PARTS, generator, normal
from torch import Tensor, nn
from torchrl_osr.data import collect_quality, load_behavior_policy, normalized_score
from torchrl_osr.data.collect.environment import environment_id
from torchrl_osr.data.collect.mazes import waypoint_sampler
from torchrl_osr.evaluation import EpisodeEvaluator
from torchrl_osr.evaluation.recoverable import (
    STATES,
    RecoverableStates,
    read_recoverable_states,
)
from world import NoNoise, World

from torchrl_osr._files import read_arrays, sha256_of

WIDTH, BATCH, RATE = 256, 256, 1e-3
TABLE = 50_000
"""Displaced states, at least one for each row."""

CHANGES = 8
"""Of a witness's first state, 1e-3 standard deviations each; the first is none."""

TOLERANCE, FARTHEST = 0.03, 1.0
"""Of corrective labels: how well the model leads from the displaced state to the next
one, and how far it may lie from its row; in standard deviations, averaged over
entries."""


class Displaced(NamedTuple):
    """States ``[n, S]`` with their labels ``[n, A]``."""

    state: Tensor
    label: Tensor


class Back(NamedTuple):
    """States from which displaced actions lead back.

    Attributes:
        state: ``[n, S]``.
        action: of the data's row at that moment, ``[n, A]``.
        offset: its displacement.
        kept: share of the states that were tried.
        moved: median distance from the row, in standard deviations.
    """

    state: Tensor
    action: Tensor
    offset: Tensor
    kept: float
    moved: float


class Demonstrations:
    """Episodes of the expert, and what the arms make of them.

    Args:
        world: of the system.
        episodes: how many.
        seed: of everything.
        updates: of each network.
    """

    def __init__(self, world: World, episodes: int, seed: int, updates: int) -> None:
        self.world, self.seed, self.updates = world, seed, updates
        quality = "play" if world.is_maze else "expert"
        rows = collect_quality(
            world.system, quality, 1000 * episodes, seed=seed, progress=False
        ).data
        ends = rows["next", "done"].flatten().nonzero().flatten()
        rows = rows[: int(ends[episodes - 1]) + 1 if len(ends) >= episodes else None]
        self.observation, self.action = rows["observation"], rows["action"]
        self.following = self.state_of(rows["next", "observation"])
        scale = self.observation.std(0)
        self.unit = self.state_of(scale.clamp_min(1e-6))
        chance = torch.Generator().manual_seed(seed)
        count = max(TABLE, len(rows))
        done = rows["next", "done"].flatten()
        self.episode = done.cumsum(0) - done.long()
        self.row = torch.randint(len(rows), [count], generator=chance)
        self.noise = torch.randn(count, len(self.unit), generator=chance)
        self.found: dict[
            tuple[float, int], tuple[Tensor, Tensor, Tensor, dict[str, float]]
        ] = {}
        self.push = torch.randn(count, rows["action"].shape[-1], generator=chance)

    # -- states: in the maze the point's own, which it observes twice ----------------

    def state_of(self, observation: Tensor) -> Tensor:
        """What can be displaced, ``[..., X]``: not the goal."""
        return observation[..., 4:] if self.world.is_maze else observation

    def observed(self, state: Tensor, row: Tensor) -> Tensor:
        """Observations ``[n, S]`` of states ``[n, X]``, with the goals of the rows."""
        if not self.world.is_maze:
            return state
        goal = self.observation[row][:, 2:4]
        return torch.cat([state[:, :2], goal, state], -1)

    # -- models ----------------------------------------------------------------------

    def fit(
        self, inputs: Tensor, targets: Tensor, extra: Displaced | None = None
    ) -> nn.Sequential:
        """Least squares; half of each batch from ``extra``. Inputs standardised."""
        torch.manual_seed(self.seed)
        sizes = inputs.shape[-1], WIDTH, WIDTH, targets.shape[-1]
        layers = [nn.Linear(*pair) for pair in pairwise(sizes)]
        net = nn.Sequential(
            layers[0], nn.ReLU(), layers[1], nn.ReLU(), layers[2], nn.Tanh()
        )
        if targets is not self.action:
            net = net[:-1]
        loc, scale = inputs.mean(0), inputs.std(0).clamp_min(1e-6)
        inputs = (inputs - loc) / scale
        optimizer = torch.optim.Adam(net.parameters(), RATE, fused=True)
        falls = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, self.updates)
        if extra is not None:
            extra = Displaced((extra.state - loc) / scale, extra.label)
        for _ in range(self.updates):
            rows = torch.randint(len(inputs), [BATCH if extra is None else BATCH // 2])
            state, label = inputs[rows], targets[rows]
            if extra is not None:
                rows = torch.randint(len(extra.state), [BATCH // 2])
                state = torch.cat([state, extra.state[rows]])
                label = torch.cat([label, extra.label[rows]])
            loss = (net(state) - label).square().mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            falls.step()
        with torch.no_grad():  # fold the standardisation in
            layers[0].weight /= scale
            layers[0].bias -= layers[0].weight @ loc
        return net.requires_grad_(False)

    @cached_property
    def dynamics(self) -> nn.Sequential:
        """Change of the state, in its unit; from clean rows."""
        inputs = torch.cat([self.observation, self.action], -1)
        change = (self.following - self.state_of(self.observation)) / self.unit
        return self.fit(inputs, change)

    # -- arms ------------------------------------------------------------------------

    def noisy(self, width: float) -> Displaced:
        """Noise on the state, the row's action: noisy cloning."""
        state = self.state_of(self.observation)[self.row]
        state = self.observed(state + width * self.unit * self.noise, self.row)
        return Displaced(state, self.action[self.row])

    def osr(self, width: float, clean: bool) -> Displaced:
        """The same states, labelled by an inverse dynamics model.

        Gaussians of one variance: their divergence is the distance of the means.

        Args:
            width: of the noise, in standard deviations.
            clean: fit the model to the rows alone; else, as the paper does, to the rows
                and their displaced twins.
        """
        state, label = self.noisy(width)
        pairs = torch.cat([self.observation, self.following], -1)
        displaced = torch.cat([state, self.following[self.row]], -1)
        twins = None if clean else Displaced(displaced, label)
        return Displaced(state, self.fit(pairs, self.action, twins)(displaced))

    def corrective(self, push: float, steps: int, label: str) -> Displaced:
        """The states of :meth:`back` with a label.

        Args:
            push, steps: of them.
            label: ``"displaced"``, ``"row"`` or ``"flipped"``: the action that leads
                back, the row's, or the row's less the displacement.
        """
        if (push, steps) not in self.found:
            self.found[push, steps] = self.back(push, steps)
        state, action, offset, *_ = self.found[push, steps]
        sign = {"displaced": 1, "row": 0, "flipped": -1}[label]
        return Displaced(state, (action + sign * offset).clamp(-1, 1))

    def back(self, push: float, steps: int) -> Back:
        """States from which displaced actions lead back to a state of the data.

        From a row's next state, up to ``steps`` rows are gone back by the model, with
        their actions and one displacement of all of them; the earliest state is taken.

        Args:
            push: standard deviation of the displacement.
            steps: from 1 to so many, at random.
        """
        chance = torch.Generator().manual_seed(self.seed)
        count = torch.randint(1, steps + 1, [len(self.row)], generator=chance)
        first = (self.row - count + 1).clamp_min(0)
        inside = self.episode[first] == self.episode[self.row]
        state, offset = self.following[self.row], push * self.push
        there = torch.ones_like(inside)
        for back in range(steps):
            row = (self.row - back).clamp_min(0)
            before, hit = self._before(
                state, (self.action[row] + offset).clamp(-1, 1), row
            )
            going = back < count
            there &= hit | ~going
            state = torch.where(going.unsqueeze(1), before, state)
        data = self.state_of(self.observation)[first]
        moved = ((state - data) / self.unit).square().mean(1).sqrt()
        kept = inside & there & (moved < FARTHEST)
        if kept.sum() < BATCH:
            raise ValueError(f"{int(kept.sum())} corrective labels: too few to learn.")
        state = self.observed(state, first)
        share, far = float(kept.float().mean()), float(moved[kept].median())
        return Back(state[kept], self.action[first][kept], offset[kept], share, far)

    def _before(
        self, following: Tensor, action: Tensor, row: Tensor
    ) -> tuple[Tensor, Tensor]:
        """States from which the model leads to others by an action, and whether so."""

        def change(state: Tensor) -> Tensor:
            inputs = torch.cat([self.observed(state, row), action], -1)
            return self.dynamics(inputs) * self.unit

        state = following
        for _ in range(4):  # half of each step, so that it settles
            state = (state + following - change(state)) / 2
        miss = (state + change(state) - following) / self.unit
        return state, miss.square().mean(1).sqrt() < TOLERANCE

    def expert(self, width: float) -> Displaced:
        """The states of noisy cloning, with the expert's action there: an oracle."""
        state, _ = self.noisy(width)
        if not self.world.is_maze:
            policy = load_behavior_policy(self.world.system, "expert").deterministic
            return Displaced(state, torch.from_numpy(policy(state.numpy())))
        maze, rows = self.world.maze, state.double().numpy()
        cells = [tuple(maze.cell_xy_to_rowcol(row[:2])) for row in rows]
        free = torch.tensor([maze.maze_map[i][j] != 1 for i, j in cells])
        sample = waypoint_sampler(maze)
        label = np.stack([sample(row, NoNoise()) for row in rows[free]])
        return Displaced(state[free], torch.from_numpy(label).float())

    def ways(self, source: str, count: int = 0, label: str = "played") -> Displaced:
        """What is done on ways back, and after them.

        Args:
            source, count: of :func:`ways_back`.
            label: ``"played"``, or ``"expert"``: what the expert does in these states.
        """
        state, action = ways_back(self.world, source, count)
        if label == "expert":
            policy = self.world.policy("expert")
            action = torch.from_numpy(policy(state.numpy())).float()
        return Displaced(state, action)


def benchmark(world: World) -> tuple[np.ndarray, np.ndarray]:
    """Recoverable states of the public half ``[n, N]``, and the planner's ways.

    States are rows of ``world.py``; a way is offsets ``[K, A]`` on the expert's
    actions, each held for HOLD steps.
    """
    states = read_recoverable_states(STATES / f"{world.system}-public.npz")
    chosen = states.group == "recoverable"
    return rows_of(states, chosen), states.offsets[chosen]


def planned(world: World) -> tuple[np.ndarray, np.ndarray]:
    """The same from the walks that are for training, in a random order."""
    folder = PARTS / world.system / "ways"
    rows = {(part, index): row for part, index, row in hard_states(world, folder)}
    found = [line for line in read_lines(folder) if line["saved"]]
    found.sort(key=lambda line: (line["part"], line["index"]))
    order = generator(world.system, 6).permutation(len(found))
    chosen = [found[number] for number in order]
    row = np.stack([rows[line["part"], line["index"]] for line in chosen])
    return row, np.array([line["offsets"] for line in chosen], np.float32)


def survived(world: World) -> tuple[np.ndarray, np.ndarray]:
    """States of these walks that the expert survives by itself, but not all jurors."""
    paths = sorted((PARTS / world.system / "ways").glob("states-*.npz"))
    rows = []
    for arrays in map(read_arrays, paths):
        jury = arrays["jury"]
        rows.append(arrays["state"][(jury[:, 1] == 1) & (jury == 0).any(1)])
    row = generator(world.system, 7).permutation(np.concatenate(rows))
    return row, np.zeros((len(row), 0, world.nu), np.float32)


SOURCES = {"benchmark": benchmark, "planned": planned, "survived": survived}


@cache
def ways_back(world: World, source: str, count: int) -> Displaced:
    """Observations and actions on ways back from states, and from changes of them.

    Args:
        world: whose.
        source: of SOURCES.
        count: from the first so many states; 0 are all.
    """
    rows, knots = SOURCES[source](world)
    if len(rows) < count:
        raise ValueError(f"{count} ways {source} are wanted, there are {len(rows)}.")
    rows, knots = (each[: count or None] for each in (rows, knots))
    rows, rng = rows.repeat(CHANGES, axis=0), generator(world.system, 5)
    change = np.where(np.arange(len(rows)) % CHANGES, 1e-3, 0.0)[:, None]
    rows = world.changed(rows, change * normal(world)["std"], rng)
    offsets = knots.repeat(CHANGES, axis=0).repeat(HOLD, axis=1)
    length = 2 * world.steps // 5  # 120 steps: until it walks again
    expert, seen, done = world.policy("expert"), [], []
    standing = np.arange(len(rows))
    for step in range(length):
        if world.is_maze:
            standing = standing[~world.at_goal(rows[standing])]
        if not len(standing):
            break
        now = rows[standing]
        observation = world.observe(now)
        action = expert(observation)
        if step < offsets.shape[1]:
            action = np.clip(action + offsets[standing, step], -1, 1)
        seen.append(observation)
        done.append(action)
        rows[standing] = world.step(now, action)
        standing = standing[world.standing(rows[standing])]
    pair = (np.concatenate(each).astype(np.float32) for each in (seen, done))
    return Displaced(*map(torch.from_numpy, pair))


ARMS: dict[str, Callable[[Demonstrations, float, int], Displaced | None]] = {
    "cloning": lambda data, width, _: None,
    "noisy": lambda data, width, _: data.noisy(width),
    "osr": lambda data, width, _: data.osr(width, clean=False),
    "osr-clean": lambda data, width, _: data.osr(width, clean=True),
    "corrective": lambda data, *step: data.corrective(*step, "displaced"),
    "corrective-row": lambda data, *step: data.corrective(*step, "row"),
    "corrective-flipped": lambda data, *step: data.corrective(*step, "flipped"),
    "witnesses": lambda data, *_: data.ways("benchmark"),
    "ways": lambda data, _, count: data.ways("planned", count),
    "ways-expert": lambda data, _, count: data.ways("planned", count, "expert"),
    "survived": lambda data, _, count: data.ways("survived", count),
    "expert": lambda data, width, _: data.expert(width),
}
PILOT = (
    "cloning", "noisy:.03", "noisy:.1", "noisy:.3", "osr:.1", "osr-clean:.1",
    "corrective:.3:1", "corrective-row:.3:1", "corrective-flipped:.3:1",
    "corrective:.3:20", "corrective-row:.3:20", "corrective-flipped:.3:20",
    "witnesses", "expert:.1",
)  # fmt: skip
"""Arm, width of its noise on states or actions, steps; of ways, how many."""


def rows_of(states: RecoverableStates, chosen: np.ndarray | slice) -> np.ndarray:
    """Rows of ``world.py``."""
    parts = states.qpos[chosen], states.qvel[chosen], states.goal[chosen]
    return np.hstack([np.zeros((len(parts[0]), 1)), *parts])


def undisturbed(world: World, policy: Callable[[Tensor], Tensor]) -> float:
    """Mean score of twenty episodes; in the maze the share that reach the goal."""
    env_id = environment_id(world.system)
    evaluator = EpisodeEvaluator(env_id, num_episodes=20, seed=100)
    results = evaluator(policy)
    evaluator.close()
    if results.successes is not None:
        return float(results.successes.mean())
    return float(normalized_score(world.system, results.returns).mean())


def main() -> None:
    """Train and play what was not yet."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("system", choices=("walker2d", "pointmaze-medium"))
    parser.add_argument("--half", default="public", choices=("public", "held-out"))
    parser.add_argument("--study", default="cloning", choices=("cloning", "ways"))
    parser.add_argument("--episodes", type=int, nargs="+", default=[20])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--updates", type=int, default=8000)
    parser.add_argument("--arms", nargs="+", default=list(PILOT))
    given = parser.parse_args()
    torch.set_num_threads(1)
    world = World(given.system)
    normal(world)
    path = STATES / f"{given.system}-{given.half}.npz"
    states, digest = read_recoverable_states(path), sha256_of(path)
    rows = rows_of(states, slice(None))
    log = PARTS / given.system / f"{given.study}-{given.half}.jsonl"
    names = ("arm", "width", "steps", "episodes", "seed", "updates", "states")
    there = {tuple(line[name] for name in names) for line in read_jsonl(log)}
    for seed in given.seeds:
        for episodes in given.episodes:
            data = None
            for each in given.arms:
                arm, width, steps = [*each.split(":"), "0", "0"][:3]
                step = float(width), int(steps)
                key = arm, *step, episodes, seed, given.updates, digest
                if key in there:
                    continue
                start = time.process_time()
                data = data or Demonstrations(world, episodes, seed, given.updates)
                extra = ARMS[arm](data, *step)
                net = data.fit(data.observation, data.action, extra)

                def act(observation: np.ndarray, net: nn.Module = net) -> np.ndarray:
                    return net(torch.from_numpy(observation).float()).numpy()

                played = world.play(rows, act, states.steps)
                line = dict(zip(names, key, strict=True)) | {
                    "saved": "".join(str(int(bit)) for bit in played.success),
                    "undisturbed": round(undisturbed(world, net), 2),
                    "rows": len(data.action),
                }
                if step in data.found:
                    back = data.found[step]
                    line |= {"kept": round(back.kept, 3), "moved": round(back.moved, 3)}
                line["seconds"] = round(time.process_time() - start, 1)
                with log.open("a") as file:
                    file.write(json.dumps(line, separators=(",", ":")) + "\n")
                shown = {name: line[name] for name in line if name != "saved"}
                for group in ("recoverable", "contested", "easy"):
                    share = played.success[states.group == group].mean()
                    shown[group] = round(float(share), 3)
                print(json.dumps(shown), flush=True)


if __name__ == "__main__":
    main()
