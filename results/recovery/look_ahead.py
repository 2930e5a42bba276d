"""Step 4: does a dynamics model, at action time, bring back what its base loses?

    python results/recovery/look_ahead.py --seeds 0 --arms base look-ahead shuffled
    python results/recovery/look_ahead.py --run outputs/look/<data>/<arm>/seed300

The base is the clone outside the jury, or a run's policy. Models and values of a seed
are trained where they are not in the cache yet. One line for each arm, seed and group
of states is appended to ``parts/<system>/look-ahead-<half>.jsonl``: a bit for each
state, in the order of the file of states; what is there is not played again. Beside
easy states the undisturbed score is measured, with a plan in every step.
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
from clones import JURORS, load_clone
from cloning import undisturbed
from search import read_jsonl
from states import PARTS, PLAYERS, generator, normal, walk
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl_osr.data import load_local_dataset, make_replay_buffer, split_held_out
from torchrl_osr.data.collect.behavior import BehaviorPolicy
from torchrl_osr.data.collect.environment import environment_id
from torchrl_osr.data.store.cache import cache_root
from torchrl_osr.evaluation import (
    DataDistance,
    describe_dynamics,
    deterministic_policy,
    dynamics_report,
)
from torchrl_osr.evaluation.recoverable import (
    STATES,
    RecoverableStates,
    read_recoverable_states,
)
from torchrl_osr.experiment.trained_run import load_trained
from torchrl_osr.imagination import LookAheadPolicy, termination
from world import Policy, World

from torchrl_osr import DynamicsLoss
from torchrl_osr._files import sha256_of
from torchrl_osr.modules import DynamicsEnsemble, EliteNetworks
from torchrl_osr.policy.tensor_file import read_tensors, write_tensors

QUALITIES = "medium-replay", "medium-expert"
ROWS = 200_000
"""Of each of them, from which the value is learned, and the small model."""

EXPERT_ROWS = 20_000
"""Of the base's own data, from which the gate measures the distance."""

NETWORKS, BATCH = 4, 256
MODELS: dict[str, dict[str, Any]] = {
    "small": {"rows": ROWS, "num_cells": [200, 200], "updates": 10_000},
    "large": {"rows": 1_000_000, "num_cells": [256] * 3, "updates": 60_000},
    "pushed": {"rows": ROWS, "num_cells": [256] * 3, "updates": 60_000, "pushed": 2000},
}
"""Rows of each quality, sizes and training of the model, and steps of
:func:`pushed_rows`."""

WALKERS = 256
BURST, KICK = 0.02, 0.01
"""Chances in each step of :func:`pushed_rows`."""

VALUE_UPDATES = 5_000
CAP = 100
"""Steps: a value says how many of the next so many an average policy stands."""

PLANS: dict[str, dict[str, Any]] = {
    "20": {"planning_horizon": 20},
    "80": {"planning_horizon": 80, "num_offsets": 10},
    "20v": {"planning_horizon": 20, "value": True},
    "40v": {"planning_horizon": 40, "num_offsets": 10, "value": True},
    "20v anew": {"planning_horizon": 20, "value": True, "every": 1},
}
"""What is tried on the public half: horizons, with the value of the last state or not.

All with 48 candidates, three times, and a new plan every four steps, for which an
offset is held anyway; ``anew``, in every step.
"""

SEARCH = {"num_candidates": 48, "top_k": 6, "optim_steps": 3}
ARMS = ("base", "look-ahead", "shuffled", "random", "always", "nearest", "simulator",
        "least", "margin", "both", "two")  # fmt: skip
OTHERS: dict[str, list[tuple[str, int]]] = {
    "both": [("pushed", 0)],
    "two": [("large", 1)],
}
"""Arms that take the mean of several models: the others' kinds, and how many more than
the arm's own their seeds are."""


class Counted:
    """A gate that counts the states that it was asked about, and those it was open for.

    Args:
        gate: which rows are far, bool ``[B]``.
    """

    def __init__(self, gate: Callable[[Tensor], Tensor]) -> None:
        self.gate, self.asked, self.open = gate, 0, 0

    def __call__(self, observation: Tensor) -> Tensor:
        far = self.gate(observation)
        self.asked, self.open = self.asked + len(far), self.open + int(far.sum())
        return far


class Shuffled(LookAheadPolicy):
    """Each candidate gets the prediction of another one."""

    chance = torch.Generator().manual_seed(0)

    def scores(self, observation: Tensor, offsets: Tensor) -> Tensor:
        scores = super().scores(observation, offsets)
        order = torch.rand(scores.shape, generator=self.chance).argsort(1)
        return scores.gather(1, order)


class Least(LookAheadPolicy):
    """What the elite expects that expects least."""

    def scores(self, observation: Tensor, offsets: Tensor) -> Tensor:
        return self.elite_scores(observation, offsets).amin(0)


class Margin(LookAheadPolicy):
    """The policy alone has five steps more: what is hardly better is not done."""

    def scores(self, observation: Tensor, offsets: Tensor) -> Tensor:
        scores = super().scores(observation, offsets)
        return scores + 5 * (offsets == 0).all(-1).all(-1)


class Mean(LookAheadPolicy):
    """The mean of several models; ``others`` are set."""

    others: list[LookAheadPolicy]

    def scores(self, observation: Tensor, offsets: Tensor) -> Tensor:
        total = super().scores(observation, offsets)
        for other in self.others:
            total = total + other.scores(observation, offsets)
        return total / (1 + len(self.others))


class Random(LookAheadPolicy):
    """Scores drawn at random, but for the policy alone: the others plan there, too."""

    chance = torch.Generator().manual_seed(0)

    def scores(self, observation: Tensor, offsets: Tensor) -> Tensor:
        if offsets.shape[1] == 1:
            return super().scores(observation, offsets)
        return torch.rand(offsets.shape[:2], generator=self.chance)


class Simulated(LookAheadPolicy):
    """The simulator itself in the model's place; ``world`` and ``base`` are set."""

    world: World
    base: Policy

    def scores(self, observation: Tensor, offsets: Tensor) -> Tensor:
        batch, world = offsets.shape[:2], self.world
        state = observation.repeat_interleave(batch[1], 0).double().numpy()
        rows = np.hstack([np.zeros((len(state), 2)), state])  # time and x: nobody sees
        given = offsets.flatten(0, 1).repeat_interleave(self.hold, 1).numpy()
        steps = self.planning_horizon
        played = world.play(rows, self.base, steps, given)
        score = torch.from_numpy(played.alive).float()
        if self.value is not None:
            end = torch.from_numpy(world.observe(played.rows)).float()
            score += torch.from_numpy(played.success) * self.value(end)
        return score.view(batch)


def trained(system: str, name: str, make: Callable[[], nn.Module], train: Any) -> Any:
    """A module from the cache, or trained and put there."""
    path = cache_root() / "recovery" / f"{system}-{name}.safetensors"
    module = make()
    if not path.exists():
        start = time.process_time()
        print(json.dumps(train(module) | {"module": str(path.stem)}), flush=True)
        path.parent.mkdir(parents=True, exist_ok=True)
        seconds = {"seconds": time.process_time() - start}
        write_tensors(path, module.state_dict(), seconds)
    module.load_state_dict(read_tensors(path)[0])
    return module.requires_grad_(False)


def rows_of(system: str, count: int = ROWS) -> list[Any]:
    """The data, a table for each quality."""
    return [
        load_local_dataset(system, each, num_transitions=count, progress=False)[0]
        for each in QUALITIES
    ]


def pushed_rows(world: World, steps: int) -> TensorDict:
    """What a robot records that is pushed all the time, ``[WALKERS * steps]`` rows.

    The policies of the data walk; now and then random torques at their bounds take
    over for 1 to 15 steps, or all velocities change by up to two standard deviations
    of normal walking. A walk begins anew where it falls.
    """
    rng, std = generator(world.system, 8), normal(world)["std"]
    names = sorted(set(PLAYERS[world.system]))
    policies = [world.policy(name) for name in names]
    start, seconds = walk(world, "expert", 2 * 10**6, 1)[:1], world.seconds
    begin = np.where(np.arange(world.nq + world.nv) == 0, 0.0, 5e-3)
    rows = world.changed(start.repeat(WALKERS, 0), begin, rng)
    burst = np.zeros(WALKERS, int)
    tables = []
    for _ in range(steps):
        kicked = rng.random(WALKERS) < KICK
        size = np.where(kicked, rng.uniform(0, 2, WALKERS), 0)[:, None] * std
        size[:, : world.nq] = 0
        after = world.changed(rows, size, rng)
        rows = np.where(world.standing(after)[:, None], after, rows)
        state = world.observe(rows)
        action = np.empty((WALKERS, world.nu), np.float32)
        for number, policy in enumerate(policies):
            action[number :: len(policies)] = policy(state[number :: len(policies)])
        torque = rng.choice([-1.0, 1.0], action.shape)
        action = np.where(burst[:, None] > 0, torque, action)
        begins = rng.random(WALKERS) < BURST
        burst = np.where(begins, rng.integers(1, 16, WALKERS), np.maximum(burst - 1, 0))
        after = world.step(rows, action)
        fell = ~world.standing(after)
        speed = (after[:, 1] - rows[:, 1]) / seconds
        reward = speed + ~fell - 1e-3 * np.square(action).sum(1)
        columns = state, action, world.observe(after), reward, fell
        tables.append([torch.from_numpy(each) for each in columns])
        again = world.changed(start.repeat(WALKERS, 0), begin, rng)
        rows = np.where(fell[:, None], again, after)
    columns = (torch.cat(column) for column in zip(*tables, strict=True))
    state, action, following, reward, fell = columns
    after = {"observation": following.float(), "reward": reward.float().unsqueeze(1)}
    after["terminated"] = fell.unsqueeze(1)
    table = {"observation": state.float(), "action": action.float(), "next": after}
    return TensorDict(table, [len(state)])


def ensemble(world: World, model_size: str, seed: int) -> DynamicsEnsemble:
    """The package's model of the data, trained by its loss."""
    system, settings = world.system, MODELS[model_size]
    updates = settings["updates"]
    sizes = {"halfcheetah": (17, 6), "hopper": (11, 3), "walker2d": (17, 6)}[system]

    def make() -> nn.Module:
        torch.manual_seed(seed)
        options = {"num_networks": NETWORKS, "num_elites": NETWORKS}
        return DynamicsEnsemble(*sizes, num_cells=settings["num_cells"], **options)

    def train(model: DynamicsEnsemble) -> dict[str, Any]:
        rows = torch.cat(rows_of(system, settings["rows"]))
        if "pushed" in settings:
            more = pushed_rows(world, settings["pushed"])
            rows = torch.cat([rows.select(*more.keys(True, True)), more])
        rows, held_out = split_held_out(rows, 0.02, seed=seed)
        model.standardize_(rows)
        loss = DynamicsLoss(model)
        buffer = make_replay_buffer(rows, batch_size=NETWORKS * BATCH, seed=seed)
        optimizer = torch.optim.Adam(list(model.parameter_groups()), lr=1e-3)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, updates)
        for _ in range(updates):
            sum(loss(buffer.sample()).values()).backward()
            optimizer.step()
            optimizer.zero_grad()
            schedule.step()
        model.calibrate_(held_out)
        return {"report": describe_dynamics(dynamics_report(model, held_out))}

    name = "dynamics" if model_size == "small" else f"dynamics-{model_size}"
    return trained(system, f"{name}-{seed}", make, train)


class SurvivalValue(nn.Module):
    """How many of the next 100 steps the policies of the data stand, ``[n]``."""

    def __init__(self, size: int) -> None:
        super().__init__()
        self.net = nn.Sequential(
            nn.Linear(size, 128), nn.ReLU(), nn.Linear(128, 128), nn.ReLU(),
            nn.Linear(128, 1), nn.Sigmoid(),
        )  # fmt: skip
        self.register_buffer("loc", torch.zeros(size))
        self.register_buffer("scale", torch.ones(size))

    def forward(self, observation: Tensor) -> Tensor:
        return CAP * self.net((observation - self.loc) / self.scale).squeeze(-1)


def steps_left(data: Any) -> Tensor:
    """Steps until the fall, at most 100; NaN where the recording ends before."""
    ended = data["next", "done"].flatten().numpy()
    fell = data["next", "terminated"].flatten().numpy()
    left, count = np.empty(len(data), np.float32), np.nan
    for row in range(len(data) - 1, -1, -1):
        if ended[row] or row == len(data) - 1:
            count, sure = 0.0, fell[row]
        count += 1
        left[row] = min(count, CAP) if sure or count >= CAP else np.nan
    return torch.from_numpy(left)


def survival(system: str, seed: int) -> SurvivalValue:
    """Fitted to what became of the rows of the data."""
    tables = rows_of(system)
    size = tables[0]["observation"].shape[-1]

    def make() -> nn.Module:
        torch.manual_seed(seed)
        return SurvivalValue(size)

    def train(value: SurvivalValue) -> dict[str, Any]:
        state = torch.cat([each["observation"] for each in tables])
        left = torch.cat([steps_left(each) for each in tables])
        known = left.isfinite()
        state, left = state[known], left[known]
        value.loc.copy_(state.mean(0))
        value.scale.copy_(state.std(0))
        optimizer = torch.optim.Adam(value.parameters(), 1e-3)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, VALUE_UPDATES)
        for _ in range(VALUE_UPDATES):
            rows = torch.randint(len(state), (BATCH,))
            loss = ((value(state[rows]) - left[rows]) / CAP).square().mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
        with torch.no_grad():
            rows = torch.randint(len(state), (20_000,))
            error = (value(state[rows]) - left[rows]).square().mean()
        return {"explained": float(1 - error / left.var()), "rows": len(state)}

    return trained(system, f"survival-{seed}", make, train)


def in_torch(policy: BehaviorPolicy) -> nn.Module:
    """The same network in torch: it acts for thousands of rows at once."""
    layers = []
    for each in (policy.hidden0, policy.hidden1, policy.mean):
        layer = nn.Linear(*each.weight.shape[::-1])
        layer.weight.data, layer.bias.data = map(torch.from_numpy, each)
        layers.append(layer)
    first, second, last = layers
    net = nn.Sequential(first, nn.ReLU(), second, nn.ReLU(), last, nn.Tanh())
    return net.requires_grad_(False)


def in_numpy(policy: Callable[[Tensor], Tensor]) -> Policy:
    """The same for the simulator's rows."""
    return lambda state: policy(torch.from_numpy(state).float()).numpy()


def base_of(
    system: str, run: Path | None
) -> tuple[Callable[[Tensor], Tensor], TensorDict]:
    """The policy that is planned around, and its data."""
    if run is None:
        base = in_torch(load_clone(system, JURORS[system]))
        quality, count = "expert", EXPERT_ROWS
    else:
        trained_run = load_trained(run)
        actor, norm = trained_run.actor, trained_run.observation_norm
        base = deterministic_policy(actor, norm)
        quality, count = run.parent.parent.name.removeprefix(f"{system}-"), ROWS
    own, _ = load_local_dataset(system, quality, num_transitions=count, progress=False)
    return base, own


def policy_of(
    arm: str, plan: str, model: str, seed: int, world: World, run: Path | None = None
) -> tuple[Callable[[Tensor], Tensor], Counted]:
    """An arm's policy, and its gate."""
    base, own = base_of(world.system, run)
    distance = DataDistance(own)
    gate = Counted(lambda state: distance(state) > distance.threshold)
    if arm == "base":
        return base, gate
    if arm == "always":
        gate = Counted(lambda state: torch.ones(len(state), dtype=torch.bool))
    if arm == "nearest":
        state, scale = own["observation"], own["observation"].std(0)

        def nearest(observation: Tensor) -> Tensor:
            action, far = base(observation), gate(observation)
            found = torch.cdist(observation[far] / scale, state / scale).argmin(1)
            action[far] = own["action"][found]
            return action

        return nearest, gate
    options = PLANS[plan] | SEARCH
    options.pop("every", None)
    if options.pop("value", False):
        options["value"] = survival(world.system, seed)
    kinds = {
        "shuffled": Shuffled, "random": Random, "simulator": Simulated,
        "least": Least, "margin": Margin,
    } | dict.fromkeys(OTHERS, Mean)  # fmt: skip
    policy = kinds.get(arm, LookAheadPolicy)(
        base,
        EliteNetworks(ensemble(world, model, seed)),
        gate,
        terminated=termination(environment_id(world.system)),
        generator=torch.Generator().manual_seed(seed),
        **options,
    )
    if isinstance(policy, Mean):
        policy.others = []
        for kind, more in OTHERS[arm]:
            other, _ = policy_of("look-ahead", plan, kind, seed + more, world, run)
            assert isinstance(other, LookAheadPolicy)
            policy.others.append(other)
    if isinstance(policy, Simulated):
        policy.world, policy.base = world, in_numpy(base)
    return policy, gate


def play(
    states: RecoverableStates,
    chosen: np.ndarray,
    world: World,
    policy: Any,
    every: int,
) -> dict[str, Any]:
    """Which of the chosen states it comes back from, and how long it stands.

    A plan is made ``every`` so many steps.
    """
    count = len(chosen)
    rows = np.hstack([np.zeros((count, 1)), states.qpos[chosen], states.qvel[chosen]])
    plans = isinstance(policy, LookAheadPolicy)
    base, every = (policy.policy, every) if plans else (policy, states.steps)
    active, alive = np.arange(count), np.full(count, states.steps)

    act = in_numpy(base)
    for step in range(0, states.steps, every):
        offsets = None
        if plans:
            observation = torch.from_numpy(world.observe(rows[active])).float()
            far = policy.far(observation)
            offset = torch.zeros(len(active), world.nu)
            if far.any():
                offset[far] = policy.plan(observation[far])[:, 0]
            offsets = offset.unsqueeze(1).expand(-1, every, -1).numpy()
        length = min(every, states.steps - step)
        played = world.play(rows[active], act, length, offsets)
        rows[active] = played.rows
        alive[active[~played.success]] = step + played.alive[~played.success]
        active = active[played.success]
        if not len(active):
            break
    saved = np.isin(np.arange(count), active)
    return {"saved": "".join(map(str, saved.astype(int))), "alive": alive.tolist()}


def main() -> None:
    """Play what was not yet."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--system", default="walker2d", choices=("hopper", "walker2d"))
    parser.add_argument("--half", default="public", choices=("public", "held-out"))
    parser.add_argument("--run", type=Path, help="<data>/<arm>/seed<number>")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--arms", nargs="+", default=list(ARMS), choices=ARMS)
    parser.add_argument("--plans", nargs="+", default=["20"], choices=list(PLANS))
    parser.add_argument("--model", default="small", choices=list(MODELS))
    parser.add_argument("--groups", nargs="+", default=["recoverable"])
    given = parser.parse_args()
    torch.set_num_threads(1)
    path = STATES / f"{given.system}-{given.half}.npz"
    states, digest = read_recoverable_states(path), sha256_of(path)
    world = World(given.system)
    normal(world)
    log = PARTS / given.system / f"look-ahead-{given.half}.jsonl"
    names = ("arm", "plan", "seed", "group", "states", "model", "run")
    run = None if given.run is None else "/".join(given.run.parts[-3:])
    there = {tuple(line.get(name) for name in names) for line in read_jsonl(log)}
    size = None if given.model == "small" else given.model
    for seed in given.seeds:
        for group in given.groups:
            chosen = np.flatnonzero(states.group == group)
            for plan in given.plans:
                for arm in given.arms:
                    unplanned = arm in ("base", "nearest")
                    used = ("", None) if unplanned else (plan, size)
                    key = arm, used[0], seed, group, digest, used[1], run
                    if key in there:
                        continue
                    there.add(key)
                    policy, gate = policy_of(
                        arm, plan, given.model, seed, world, given.run
                    )
                    start = time.process_time()
                    line = dict(zip(names, key, strict=True))
                    every = PLANS[plan].get("every", 4)
                    line |= play(states, chosen, world, policy, every)
                    line["planned"] = gate.open
                    if group == "easy":
                        line["undisturbed"] = round(undisturbed(world, policy), 2)
                    line["seconds"] = round(time.process_time() - start, 1)
                    with log.open("a") as file:
                        file.write(json.dumps(line, separators=(",", ":")) + "\n")
                    alive = round(float(np.mean(line["alive"])), 1)
                    shown = {name: line[name] for name in names[:4]}
                    shown |= {"saved": line["saved"].count("1"), "of": len(chosen)}
                    shown |= {"alive": alive, "seconds": line["seconds"]}
                    print(json.dumps(shown | {"planned": gate.open}), flush=True)


if __name__ == "__main__":
    main()
