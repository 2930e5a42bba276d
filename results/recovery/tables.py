"""Pack what the searches found, and say how much of it there is.

    python results/recovery/tables.py

Writes ``torchrl_osr/evaluation/states/<system>-<half>.npz`` where it is not there yet,
their SHA-256 beside them,
and ``tables.md``.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from clones import JURORS, SYSTEMS, load_clone
from cloning import rows_of
from search import HOLD, STAGES, read_jsonl, read_lines
from states import DISTURBANCES, PARTS, PLAYERS, generator, hard, normal
from tensordict import TensorDict
from torchrl_osr.data import collect_quality
from torchrl_osr.evaluation import DataDistance, wilson_interval
from torchrl_osr.evaluation.recoverable import (
    HALVES,
    STATES,
    read_recoverable_states,
)
from world import World

from torchrl_osr._files import (
    read_arrays,
    sha256_of,
    whole_file,
    write_atomically,
    write_json,
)

FOLDER = Path(__file__).parent
GROUPS = ("easy", "contested", "recoverable", "not saved")
CONTROLS = 100
"""Easy and contested states of each half that are kept."""

KNOTS = max(stage.knots for stage in STAGES)


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
    """Share of the hard states saved, by the rollouts of a search.

    All are tried with the first stage; a random sample of those it does not save with
    the others. Wilson intervals at 95 %.
    """
    folder = PARTS / world.system
    first = [line for line in read_lines(folder) if not line["stage"]]
    saved = sum(line["saved"] for line in first)
    by_state: dict[tuple, list[dict]] = {}
    for line in read_jsonl(folder / "curve.jsonl"):
        by_state.setdefault((line["part"], line["index"]), []).append(line)
    # An interrupted search has a last state that did not get to its end.
    sample = [
        lines
        for lines in by_state.values()
        if lines[-1]["saved"] or lines[-1]["stage"] == len(STAGES) - 1
    ]
    rate = saved / max(len(first), 1)
    entries = [
        {
            "rollouts": STAGES[0].candidates * STAGES[0].iterations,
            "tried": len(first),
            "saved": saved,
            "of the sample, all stages so far": "",
            "share of hard states saved so far": f"{rate:.2f}",
            "core seconds each": f"{np.mean([x['seconds'] for x in first]):.1f}",
        }
    ]
    found = 0
    for number, stage in enumerate(STAGES[1:] if sample else (), 1):
        tried = [x for lines in sample for x in lines if x["stage"] == number]
        new = sum(x["saved"] for x in tried)
        found += new
        low, high = wilson_interval(found, len(sample))
        share, low, high = (
            rate + (1 - rate) * each for each in (found / len(sample), low, high)
        )
        entries.append(
            {
                "rollouts": stage.candidates * stage.iterations,
                "tried": len(tried),
                "saved": new,
                "of the sample, all stages so far": f"{found} of {len(sample)}",
                "share of hard states saved so far": f"{share:.2f} "
                f"[{low:.2f}, {high:.2f}]",
                "core seconds each": f"{np.mean([x['seconds'] for x in tried]):.1f}",
            }
        )
    return entries


def table(rows: list[dict]) -> str:
    """Markdown table of rows with the same entries."""
    names = list(rows[0])
    lines = [
        names,
        ["---"] * len(names),
        *([row[each] for each in names] for row in rows),
    ]
    return "\n".join("| " + " | ".join(map(str, line)) + " |" for line in lines)


def by_disturbance(world: World, found: dict[str, np.ndarray]) -> list[dict]:
    """Numbers of states of each group after each disturbance.

    A legged robot's state that the expert survives stands for four, see ``states.py``.
    """
    kinds = list(DISTURBANCES[world.system])
    weight = np.where((found["jury"][:, 1] == 1) & (not world.is_maze), 4, 1)
    rows = []
    for number, kind in enumerate(kinds):
        of_kind = found["kind"] == number
        for strength in np.unique(found["strength"][of_kind]):
            here = of_kind & (found["strength"] == strength)
            counts = {
                name: int(weight[here & (found["group"] == group)].sum())
                for group, name in [*enumerate(GROUPS), (-1, "not searched yet")]
            }
            rows.append({"disturbance": f"{kind} {strength:g}"} | counts)
    return rows


def pack(world: World, found: dict[str, np.ndarray]) -> None:
    """Write both halves; one that is there is not made again, results name its sum."""
    rng = generator(world.system, 3)
    kinds = np.array(list(DISTURBANCES[world.system]))
    for number, half in enumerate(HALVES):
        inside = found["walk"] % 2 == number
        chosen = [np.flatnonzero(inside & (found["group"] == 2))]
        for control in (0, 1):
            there = np.flatnonzero(inside & (found["group"] == control))
            count = min(CONTROLS, len(there))
            chosen.append(np.sort(rng.choice(there, count, replace=False)))
        rows = np.concatenate(chosen)
        path = STATES / f"{world.system}-{half}.npz"
        if path.exists():
            continue
        states = found["state"][rows]
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
            "distance": distances(world, states).astype(np.float32),
            "offsets": found["offsets"][rows],
            "hold": np.array(HOLD),
            "steps": np.array(world.steps),
            "least_speed": np.array(world.least_speed or -np.inf),
        }
        path.parent.mkdir(exist_ok=True)
        with whole_file(path) as file:
            np.savez_compressed(file, **arrays)


def contents(world: World) -> list[dict]:
    """What is in the two files."""
    entries = []
    for half in HALVES:
        states = read_recoverable_states(STATES / f"{world.system}-{half}.npz")
        there = states.group == "recoverable"
        entry: dict = {"half": half, "recoverable": int(there.sum())}
        entry["of walks"] = len(np.unique(states.walk[there]))
        far = states.distance[there]
        for low, high, name in (
            (0, 1, "in the data"), (1, 2, "up to 2"), (2, np.inf, "further"),
        ):  # fmt: skip
            entry[name] = int(((far > low) & (far <= high)).sum())
        for control in GROUPS[:2]:
            entry[control] = int((states.group == control).sum())
        entries.append(entry)
    return entries


def comes_back(world: World) -> list[dict]:
    """Who comes back from the public half; the other one is not looked at.

    Of who walked: a state's own walker and the expert are of its jury.
    """
    states = read_recoverable_states(STATES / f"{world.system}-public.npz")
    clone = load_clone(world.system, JURORS[world.system]).deterministic
    policies = {name: world.policy(name) for name in sorted(set(PLAYERS[world.system]))}
    rows = rows_of(states, slice(None))
    entries = []
    for name, policy in (policies | {"a clone outside the jury": clone}).items():
        back = world.play(rows, policy, world.steps).success
        entry = {"policy": name}
        for group in ("recoverable", "contested", "easy"):
            of = states.group == group
            entry[group] = f"{back[of].sum()} of {of.sum()}"
        entries.append(entry)
    return entries


def main() -> None:
    """Write everything."""
    pages = ["# What is there", "Written by `tables.py`; the columns are explained in "
             "[README.md](README.md#the-states)."]  # fmt: skip
    for system in SYSTEMS:
        if not list((PARTS / system).glob("states-*.npz")):
            continue
        world = World(system)
        normal(world)  # sets the least speed
        found = gather(world)
        pack(world, found)
        pages += [
            f"## {system}",
            table(contents(world)),
            table(comes_back(world)),
            table(curve(world) or [{"rollouts": 0}]),
            table(by_disturbance(world, found)),
        ]
    files = sorted(STATES.glob("*.npz"))
    sums = {path.name: sha256_of(path) for path in files}
    write_json(STATES / "checksums.json", sums)
    write_atomically(FOLDER / "tables.md", "\n\n".join(pages) + "\n")


if __name__ == "__main__":
    main()
