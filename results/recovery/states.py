"""Disturb walks, and let the jury play from every state: easy, contested or hard.

    python results/recovery/states.py walker2d --walks 64
    python results/recovery/states.py walker2d --ways 128 150

Walk after walk is appended to ``parts/<system>/``, a file for eight of them; files that
are there are kept. Everything of a walk is decided by its number. Files below ``ways``
never enter the benchmark: how to get back from their states is for training.
"""

from __future__ import annotations

import argparse
import json
import zlib
from pathlib import Path

import numpy as np
from clones import JURORS, load_clone
from torchrl_osr.data import load_behavior_policy
from torchrl_osr.data.collect.mazes import PLAY_CELLS, waypoint_sampler
from world import SPEED_STEPS, Policy, Rows, World

from torchrl_osr._files import read_json, whole_file, write_json

PARTS = Path(__file__).parent / "parts"
WALKS_A_FILE = 8
MOMENTS = {"pointmaze-medium": 6}
"""Random steps of each walk at which it is disturbed, in every way; elsewhere 2."""

WINDOW = 20, 400
"""Steps of a walk among which they are drawn."""

PLAYERS = {
    "hopper": ("expert", "medium", "expert", "replay_8", "expert", "replay_7"),
    "walker2d": ("expert", "medium", "expert", "replay_8", "expert", "replay_6"),
    "halfcheetah": ("expert", "medium", "expert", "replay_8", "expert", "replay_4"),
    "pointmaze-medium": ("controller",),
}
"""Who walks, in turn; the walks ``2n`` and ``2n + 1`` have the same player."""

LEGGED: dict[str, tuple[float, ...]] = {
    "torque": (5, 10, 12),
    "rest": (15, 20),
    "push": (1, 2, 3),
    "kick": (0.5, 1, 1.5),
    "kick-root": (1, 2),
    "kick-joints": (1, 2),
    "start": (0.1, 0.15),
}
DISTURBANCES: dict[str, dict[str, tuple[float, ...]]] = {
    # Hopper's from walk 128 and HalfCheetah's from walk 80 on, see PLAN.md; kinds after
    # which hardly a state was saved have no strength left. What is there twice is drawn
    # twice.
    "hopper": {
        "torque": (5,),
        "rest": (),
        "push": (0.5, 1, 1.5),
        "kick": (0.25, 0.5, 0.75, 1),
        "kick-root": (0.5, 1, 1.5),
        "kick-joints": (0.5, 1, 1.5, 2),
        "start": (0.12, 0.15, 0.15, 0.18),
    },
    "walker2d": LEGGED,
    "halfcheetah": {
        "torque": (20,),
        "rest": (),
        "push": (2, 3, 4, 6),
        "kick": (1.5, 2, 3),
        "kick-root": (2, 3, 4, 6),
        "kick-joints": (2, 3, 4),
        "start": (),
    },
    "pointmaze-medium": {
        "torque": (100, 200),
        "push": (100, 200),
        "kick": (4, 8),
        "start": (0, 1, 2),
    },
}
"""Kinds and strengths.

``torque k``: k steps with each motor at a random bound; ``rest k``: k steps without
torque, the paper's knock as its code has it; ``push x``: a force of x body weights on
the torso along x for 5 steps (in the maze: x steps of full force in one direction);
``kick x``: x standard deviations of noise on all velocities, on the root's three or on
the joints'; ``start x``: noise of standard deviation x on the start pose, rad or m (in
the maze: a random free place, with x standard deviations of velocity).
"""

PUSH_STEPS = 5


def generator(system: str, *numbers: int) -> np.random.Generator:
    """Random numbers of one thing."""
    return np.random.default_rng([zlib.crc32(system.encode()), *numbers])


def walk(world: World, player: str, number: int, steps: int) -> Rows:
    """States of an undisturbed walk, the start first, ``[T, N]``."""
    rng = generator(world.system, number)
    options = {}
    if world.is_maze:
        pairs = PLAY_CELLS[world.system]
        start, goal = pairs[rng.integers(len(pairs))]
        options = {"reset_cell": np.array(start), "goal_cell": np.array(goal)}
        sample = waypoint_sampler(world.maze)
    else:
        sample = load_behavior_policy(world.system, player).sample
    world.env.reset(seed=int(rng.integers(2**31)), options=options or None)
    rows = [world.current()[None]]
    for _ in range(steps):
        action = sample(world.observe(rows[-1])[0], rng)
        after = world.step(rows[-1], action[None])
        if not world.standing(after)[0] or (world.is_maze and world.at_goal(after)[0]):
            break
        rows.append(after)
    return np.concatenate(rows)


def normal(world: World) -> dict[str, Rows]:
    """Deviations of the expert's undisturbed states, and its speed, from four walks."""
    path = PARTS / world.system / "normal.json"
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        walks = [
            walk(world, PLAYERS[world.system][0], 10**6 + number, 1000)
            for number in range(4 if not world.is_maze else 40)
        ]
        rows = np.concatenate(walks)[:, 1 : world.size]
        ends = [(each[-1, 1] - each[-1 - SPEED_STEPS, 1]) for each in walks]
        speed = float(np.mean(ends) / SPEED_STEPS / world.seconds)
        write_json(path, {"std": rows.std(0).tolist(), "speed": speed})
    record = read_json(path)
    if world.system == "halfcheetah":
        world.least_speed = record["speed"] / 2
    return {"std": np.array(record["std"])}


def disturb(
    world: World, row: Rows, kind: str, strength: float, std: Rows, rng
) -> Rows | None:
    """State after a disturbance ``[N]``; None if it has fallen."""
    rows, nv = row[None].copy(), world.nv
    first = 1 + world.nq
    if kind.startswith("kick"):
        noise = strength * std[world.nq :] * rng.standard_normal(nv)
        root = np.arange(nv) < 3
        keep = {"kick": root | True, "kick-root": root, "kick-joints": ~root}[kind]
        rows[0, first : world.size] += noise * keep
    elif kind == "start" and world.is_maze:
        free = world.maze.unique_reset_locations
        place = free[rng.integers(len(free))] + rng.uniform(-0.3, 0.3, 2)
        speed = strength * std[world.nq :] * rng.standard_normal(nv)
        rows[0, 1 : world.size] = np.concatenate([place, speed])
    elif kind == "start":
        rows = world.changed(rows, np.full(world.nq + nv, strength), rng)
    elif kind == "push" and not world.is_maze:
        weight = world.model.body_mass.sum() * 9.81
        force = np.array([strength * weight * rng.choice([-1.0, 1.0])])
        policy = world.policy("expert")
        for _ in range(PUSH_STEPS):
            rows = world.step(rows, policy(world.observe(rows)), force)
            if not world.standing(rows)[0]:
                return None
    else:
        angle = rng.uniform(0, 2 * np.pi)
        for _ in range(int(strength)):
            action = np.where(rng.random(world.nu) < 0.5, 1.0, -1.0)
            if kind == "rest":
                action = 1e-3 * rng.random(world.nu)
            if kind == "push":
                action = np.array([np.cos(angle), np.sin(angle)])
            rows = world.step(rows, action[None])
            if not world.standing(rows)[0]:
                return None
            if world.is_maze and world.at_goal(rows)[0]:
                return None
    return rows[0] if world.standing(rows)[0] else None


def states_of(world: World, number: int, std: Rows) -> list[tuple]:
    """``(kind, strength, moment, before, after)``; after is None if it has fallen."""
    players = PLAYERS[world.system]
    rows = walk(world, players[number // 2 % len(players)], number, WINDOW[1])
    rng = generator(world.system, number, 1)
    last = len(rows) - 10
    moments = []
    if last > WINDOW[0]:
        count = min(MOMENTS.get(world.system, 2), last - WINDOW[0])
        moments = rng.choice(np.arange(WINDOW[0], last), count, replace=False)
    found = []
    for kind, strengths in DISTURBANCES[world.system].items():
        starts = kind == "start" and not world.is_maze
        for moment in [0] if starts else sorted(moments):
            for strength in strengths:
                before = rows[moment]
                after = disturb(world, before, kind, strength, std, rng)
                found.append((kind, strength, int(moment), before, after))
    return found


def judge(world: World, walks: range, std: Rows) -> dict[str, np.ndarray]:
    """Everything about the states of some walks.

    ``jury`` ``[M, J]`` is whether the player, the expert and the clones did not fail;
    ``-1`` if that was not asked: all of them for what is no state, because it has
    fallen already (``state`` is NaN) or the expert fails without the disturbance; all
    but the expert for three of four states, at random, that the expert survives: they
    are not hard whatever the others do.
    """
    players = PLAYERS[world.system]
    jurors = range(JURORS[world.system])
    clones = [load_clone(world.system, number).deterministic for number in jurors]
    expert = world.policy("expert")
    columns: dict[str, list] = {
        name: [] for name in ("walk", "moment", "kind", "strength", "state", "jury")
    }
    kinds = list(DISTURBANCES[world.system])
    for number in walks:
        found = states_of(world, number, std)
        if not found:
            continue
        before = np.stack([each[3] for each in found])
        unique, where = np.unique(before, axis=0, return_inverse=True)
        fine = world.play(unique, expert, world.steps).success[where.ravel()]
        standing = [each[4] is not None for each in found]
        there = fine & np.array(standing)
        rows = np.stack([before[0] if x[4] is None else x[4] for x in found])
        jury = np.full((len(found), 2 + len(clones)), -1, np.int8)

        def ask(member: Policy, which: np.ndarray, rows: Rows = rows) -> np.ndarray:
            return world.play(rows[which], member, world.steps).success

        asked = np.flatnonzero(there)
        jury[asked, 1] = ask(expert, asked)
        if not world.is_maze:
            fourth = generator(world.system, number, 2).random(len(asked)) < 0.25
            asked = asked[(jury[asked, 1] == 0) | fourth]
        player = players[number // 2 % len(players)]
        if player in ("expert", "controller"):
            jury[asked, 0] = jury[asked, 1]
        else:
            jury[asked, 0] = ask(world.policy(player), asked)
        for who, clone in enumerate(clones, 2):
            jury[asked, who] = ask(clone, asked)
        nothing = np.full(before.shape[1], np.nan)
        for each, bit in zip(found, jury, strict=True):
            columns["walk"].append(number)
            columns["moment"].append(each[2])
            columns["kind"].append(kinds.index(each[0]))
            columns["strength"].append(each[1])
            columns["state"].append(nothing if each[4] is None else each[4])
            columns["jury"].append(bit)
    return {name: np.array(column) for name, column in columns.items()}


def hard(world_is_maze: bool, jury: np.ndarray) -> np.ndarray:
    """Whether nobody of the jury is left, ``[M]``; in the maze, none of the clones."""
    judged = jury[:, 2:] if world_is_maze else jury
    return (judged == 0).all(1)


def main() -> None:
    """Judge the walks that were not yet."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("system", choices=list(DISTURBANCES))
    parser.add_argument("--walks", type=int, default=64)
    parser.add_argument("--ways", type=int, nargs=2, help="these files, for training")
    given = parser.parse_args()
    world = World(given.system)
    std = normal(world)["std"]
    folder, parts = PARTS / given.system, range(given.walks // WALKS_A_FILE)
    if given.ways:
        folder, parts = folder / "ways", range(*given.ways)
        folder.mkdir(exist_ok=True)
    for part in parts:
        path = folder / f"states-{part:03d}.npz"
        if path.exists():
            continue
        walks = range(part * WALKS_A_FILE, (part + 1) * WALKS_A_FILE)
        arrays = judge(world, walks, std)
        with whole_file(path) as file:
            np.savez_compressed(file, **arrays)
        there = arrays["jury"][:, 1] >= 0
        count = int(hard(world.is_maze, arrays["jury"]).sum())
        line = {"part": part, "states": int(there.sum()), "hard": count}
        print(json.dumps(line), flush=True)


if __name__ == "__main__":
    main()
