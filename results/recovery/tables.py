"""Pack what the searches found, and print how much of it there is.

    python results/recovery/tables.py                 # tables alone
    python results/recovery/tables.py --pack          # and states/<system>-<half>.npz

The tables go into ``tables.json``; ``states/checksums.json`` has the SHA-256 of each
packed file.
"""

from __future__ import annotations

import argparse
from collections import Counter
from pathlib import Path

import numpy as np
import torch
from clones import OUTSIDE, SYSTEMS
from search import HOLD, STAGES, read_lines
from states import DISTURBANCES, PARTS, generator, hard, load_clone, normal
from tensordict import TensorDict
from world import World

from torchrl_osr._files import read_arrays, sha256_of, whole_file, write_json
from torchrl_osr.data import collect_quality
from torchrl_osr.evaluation import DataDistance

FOLDER = Path(__file__).parent
HALVES = ("public", "held-out")
GROUPS = ("easy", "contested", "recoverable", "not saved")
CONTROLS = 100
"""Easy and contested states of each half that are kept."""

KNOTS = max(stage.knots for stage in STAGES)
NEAR = (1.0, 2.0)
"""Thresholds of the distance to the data, between strata."""


def gather(world: World) -> dict[str, np.ndarray]:
    """All judged states of a system, with their group and witness.

    ``group`` indexes GROUPS, or is -1: hard, and not searched yet.
    """
    folder = PARTS / world.system
    lines = {(x["part"], x["index"], x["stage"]): x for x in read_lines(folder)}
    columns: dict[str, list[np.ndarray]] = {}
    for path in sorted(folder.glob("states-*.npz")):
        part = int(path.stem.removeprefix("states-"))
        arrays = read_arrays(path)
        jury = arrays["jury"]
        judged = (jury >= 0).all(1)
        is_hard = hard(world.is_maze, jury)
        members = jury[:, 2:] if world.is_maze else jury
        count = len(jury)
        group = np.where((members == 1).all(1), 0, 1)
        group[is_hard] = -1
        offsets = np.zeros((count, KNOTS, world.nu), np.float32)
        for index in np.flatnonzero(is_hard):
            for number in range(len(STAGES)):
                line = lines.get((part, int(index), number))
                if line is None:
                    break
                group[index] = 2 if line["saved"] else 3
                if line["saved"]:
                    knots = np.array(line["offsets"], np.float32)
                    offsets[index, : len(knots)] = knots
        for name, value in (arrays | {"group": group, "offsets": offsets}).items():
            columns.setdefault(name, []).append(value[judged])
    return {name: np.concatenate(value) for name, value in columns.items()}


def distances(world: World, states: np.ndarray) -> np.ndarray:
    """Distance to the expert's data, in units of its threshold, ``[M]``."""
    quality = "play" if world.is_maze else "expert"
    rows = collect_quality(world.system, quality, 20_000, seed=8_000, progress=False)
    observation = torch.from_numpy(world.observe(states)).float()
    data = rows.data.select("observation")
    if world.is_maze:  # not the position twice, nor the goal: they do not change
        data = TensorDict({"observation": data["observation"][:, 4:]}, [len(data)])
        observation = observation[:, 4:]
    distance = DataDistance(data)
    return (distance(observation) / distance.threshold).numpy()


def curve(world: World) -> list[dict]:
    """Share of the hard states saved, by stages, of those that have all of them.

    A state that was saved has no need of the later stages; of the others a fixed part
    was tried in all.
    """
    lines = read_lines(PARTS / world.system)
    by_state: dict[tuple, dict[int, dict]] = {}
    for line in lines:
        key = line["part"], line["index"]
        by_state.setdefault(key, {})[line["stage"]] = line
    entries, left, saved = [], 1.0, 0.0
    for number, stage in enumerate(STAGES):
        tried = [x[number] for x in by_state.values() if number in x]
        if not tried:
            break
        share = float(np.mean([x["saved"] for x in tried]))
        saved += left * share
        left *= 1 - share
        entries.append(
            {
                "rollouts": stage.candidates * stage.iterations,
                "tried": len(tried),
                "saved_of_tried": round(share, 4),
                "saved_of_hard": round(saved, 4),
                "core_seconds": round(sum(x["seconds"] for x in tried)),
            }
        )
    return entries


def summary(world: World, found: dict[str, np.ndarray]) -> dict:
    """Numbers of states by half, and by disturbance and strength.

    A legged robot's state that the expert survives stands for four, see ``states.py``.
    """
    kinds = list(DISTURBANCES[world.system])
    half = found["walk"] % 2
    groups = [*GROUPS, "not searched"]  # which is -1
    weight = np.where((found["jury"][:, 1] == 1) & (not world.is_maze), 4, 1)
    by_half: Counter = Counter()
    table: Counter = Counter()
    for number, (side, kind, strength, group) in enumerate(
        zip(half, found["kind"], found["strength"], found["group"], strict=True)
    ):
        by_half[side, groups[group]] += int(weight[number])
        table[kinds[kind], float(strength), groups[group]] += int(weight[number])
    counts = {
        name: {group: by_half[side, group] for group in groups}
        for side, name in enumerate(HALVES)
    }
    disturbances = [
        {"kind": kind, "strength": strength}
        | {name: table[kind, strength, name] for name in groups}
        for kind in kinds
        for strength in sorted({each[1] for each in table if each[0] == kind})
    ]
    walks = {
        name: len(np.unique(found["walk"][(half == h) & (found["group"] == 2)]))
        for h, name in enumerate(HALVES)
    }
    return {
        "states": counts,
        "walks with recoverable states": walks,
        "saved by a clone outside the jury": outside(world, found),
        "disturbances": disturbances,
        "budget": curve(world),
    }


def outside(world: World, found: dict[str, np.ndarray]) -> dict[str, list[int]]:
    """States of each group of the public half that a fifth clone does not fail from.

    Their number, and that of all.
    """
    policy = load_clone(world.system, OUTSIDE).deterministic
    shares = {}
    for number, name in enumerate(GROUPS):
        rows = found["state"][(found["walk"] % 2 == 0) & (found["group"] == number)]
        back = world.play(rows, policy, world.steps).success if len(rows) else rows
        shares[name] = [int(np.sum(back)), len(rows)]
    return shares


def pack(world: World, found: dict[str, np.ndarray]) -> dict:
    """Write both halves; return the number of recoverable states by distance."""
    rng = generator(world.system, 3)
    kinds = np.array(list(DISTURBANCES[world.system]))
    half = found["walk"] % 2
    strata = {}
    for number, name in enumerate(HALVES):
        chosen = [np.flatnonzero((half == number) & (found["group"] == 2))]
        for control in (0, 1):
            there = np.flatnonzero((half == number) & (found["group"] == control))
            count = min(CONTROLS, len(there))
            chosen.append(np.sort(rng.choice(there, count, replace=False)))
        rows = np.concatenate(chosen)
        states = found["state"][rows]
        distance = distances(world, states)
        recoverable = distance[: len(chosen[0])]
        strata[name] = {
            "within the data": int((recoverable <= NEAR[0]).sum()),
            "up to twice the threshold": int(
                ((recoverable > NEAR[0]) & (recoverable <= NEAR[1])).sum()
            ),
            "further": int((recoverable > NEAR[1]).sum()),
        }
        arrays = {
            "env_name": np.array(world.system),
            "qpos": states[:, 1 : 1 + world.nq],
            "qvel": states[:, 1 + world.nq : world.size],
            "goal": states[:, world.size :],
            "group": np.array(GROUPS)[found["group"][rows]],
            "walk": found["walk"][rows].astype(np.int32),
            "moment": found["moment"][rows].astype(np.int32),
            "kind": kinds[found["kind"][rows]],
            "strength": found["strength"][rows],
            "distance": distance.astype(np.float32),
            "offsets": found["offsets"][rows],
            "hold": np.array(HOLD),
            "steps": np.array(world.steps),
            "least_speed": np.array(world.least_speed or -np.inf),
        }
        path = FOLDER / "states" / f"{world.system}-{name}.npz"
        path.parent.mkdir(exist_ok=True)
        with whole_file(path) as file:
            np.savez_compressed(file, **arrays)
    return strata


def main() -> None:
    """Print, and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--pack", action="store_true")
    given = parser.parse_args()
    tables = {}
    for system in SYSTEMS:
        if not list((PARTS / system).glob("states-*.npz")):
            continue
        world = World(system)
        normal(world)  # sets the least speed
        found = gather(world)
        tables[system] = summary(world, found)
        if given.pack:
            tables[system]["distance to the data"] = pack(world, found)
        print(system)
        for name, counts in tables[system]["states"].items():
            print(f"  {name}: {counts}")
        for entry in tables[system]["budget"]:
            print(f"  {entry}")
    if given.pack:
        files = sorted((FOLDER / "states").glob("*.npz"))
        sums = {path.name: sha256_of(path) for path in files}
        write_json(FOLDER / "states" / "checksums.json", sums)
    write_json(FOLDER / "tables.json", tables)


if __name__ == "__main__":
    main()
