"""Play from all disturbed states of a robot, and draw the share survived by strength.

    python results/recovery/dose.py outputs/imagination
    python results/recovery/dose.py outputs/imagination --arms "noisy cloning"

Not the recoverable states alone: those that every policy survives and those that the
planner did not save, too; public walks. What each policy survives is appended to
``parts/<system>/dose.jsonl``, a bit for each state in the order of ``tables.gather``;
what is there is not played again. ``dose-<system>.md`` has the figure's numbers.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from choice import JUDGES, policy_of
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from search import read_jsonl
from states import DISTURBANCES, PARTS
from tables import GROUPS, gather, table
from torchrl_osr.evaluation.recoverable import RecoverableStates, recovers
from world import World

from torchrl_osr._files import write_atomically

HERE = Path(__file__).parent
FIGURES = HERE.parents[1] / "docs" / "figures"
CHOICE = "choice"
LINES = {
    CHOICE: ("five by imagination, the best one acts", "#009E73"),
    JUDGES: ("recovery by imagination", "#D55E00"),
    "OSR": ("OSR", "#0072B2"),
    "noisy cloning": ("noisy cloning", "0.45"),
}
KINDS = ("torque", "rest", "push", "kick", "kick-root", "kick-joints")
LEAST = 20
"""States of a strength below which it is left out of the figure."""


def public(world: World) -> dict[str, np.ndarray]:
    """All judged states of the public walks, ``[M]`` each."""
    found = gather(world)
    inside = found["walk"] % 2 == 0
    return {name: value[inside] for name, value in found.items()}


def played_from(world: World, found: dict[str, np.ndarray]) -> RecoverableStates:
    """The same as a policy can be played from."""
    states, nothing = found["state"], np.zeros(len(found["walk"]))
    return RecoverableStates(
        env_name=world.system,
        qpos=states[:, 1 : 1 + world.nq],
        qvel=states[:, 1 + world.nq : world.size],
        goal=states[:, world.size :],
        group=np.array(GROUPS)[found["group"]],
        walk=found["walk"],
        moment=found["moment"],
        kind=np.array(list(DISTURBANCES[world.system]))[found["kind"]],
        strength=found["strength"],
        distance=nothing,
        offsets=found["offsets"],
        hold=0,
        steps=300,
        least_speed=-np.inf,
    )


def play(
    states: RecoverableStates, log: Path, folder: Path, arms: list[str], seeds: list
) -> None:
    """Play what was not yet."""
    there = {(line["arm"], *line["seeds"]) for line in read_jsonl(log)}
    for arm in arms:
        for mine in [seeds] if arm == CHOICE else [[seed] for seed in seeds]:
            if (arm, *mine) in there:
                continue
            name = JUDGES if arm == CHOICE else arm
            runs = [folder / name / f"seed{seed}" for seed in mine]
            start = time.process_time()
            policy = policy_of("models 20" if arm == CHOICE else "one", runs, runs)
            back = recovers(states, policy)
            line = {"arm": arm, "seeds": mine}
            line |= {"saved": "".join(map(str, back.astype(int)))}
            line |= {"seconds": round(time.process_time() - start, 1)}
            with log.open("a") as file:
                file.write(json.dumps(line, separators=(",", ":")) + "\n")
            print(arm, mine, f"{back.sum()} of {len(back)}", flush=True)


def played(log: Path) -> dict[str, np.ndarray]:
    """Whether each run of each method survived each state, ``[run, M]``."""
    bits: dict[str, list[list[int]]] = {}
    for line in read_jsonl(log):
        bits.setdefault(line["arm"], []).append([*map(int, line["saved"])])
    return {name: np.array(of, float) for name, of in bits.items()}


def survived(
    states: RecoverableStates, weight: np.ndarray, bits: dict[str, np.ndarray]
) -> dict[str, pd.DataFrame]:
    """Share survived ``[disturbance, run]`` of each method, and of the planner.

    A state that the expert survives stands for four, see ``states.py``.
    """
    planner = (states.group != GROUPS[-1]).astype(float)[None]
    shares = {}
    for name, of in ({"planner": planner} | bits).items():
        rows = pd.DataFrame(of.T * weight[:, None])
        sums = rows.assign(weight=weight).groupby(states.disturbance).sum()
        shares[name] = sums.drop(columns="weight").div(sums["weight"], axis=0)
    return shares


def draw(shares: dict[str, pd.DataFrame], path: Path) -> None:
    """A panel for each kind of disturbance."""
    figure = Figure(figsize=(10, 5.6), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(2, 3, sharey=True).ravel()
    for axes, kind in zip(panels, KINDS, strict=True):
        there = shares["planner"].index
        names = [name for name in there if name.rsplit(" ", 1)[0] == kind]
        names.sort(key=lambda name: float(name.split()[1]))
        strength = [float(name.split()[1]) for name in names]
        planner = shares["planner"].loc[names].mean(axis=1)
        axes.plot(strength, planner, color="black", linestyle=":", label="planner")
        for method, (label, colour) in LINES.items():
            of = shares[method].loc[names]
            axes.plot(strength, of.mean(axis=1), "o-", ms=3, color=colour, label=label)
            if of.shape[1] > 1:
                low, high = of.min(axis=1), of.max(axis=1)
                axes.fill_between(strength, low, high, color=colour, alpha=0.15, lw=0)
        axes.set_title(kind, loc="left", fontsize=10)
        axes.set_xticks(strength)
        axes.spines[["top", "right"]].set_visible(False)
        axes.set_ylim(0, 1)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="outside upper center", ncols=5, frameon=False, fontsize=9
    )
    figure.supxlabel("strength", fontsize=10)
    figure.supylabel("share survived", fontsize=10)
    figure.savefig(path, dpi=130)


def by_group(states: RecoverableStates, bits: dict[str, np.ndarray]) -> list[dict]:
    """Share survived of each group of states, all strengths together."""
    inside = {group: states.group == group for group in GROUPS}
    return [
        {"method": name, "runs": len(of)}
        | {
            f"{group} ({rows.sum()})": f"{of[:, rows].mean():.3f}"
            for group, rows in inside.items()
        }
        for name, of in bits.items()
    ]


def main() -> None:
    """Play, draw and write."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", type=Path, help="of imagination.py")
    parser.add_argument("--system", default="walker2d", choices=("walker2d", "hopper"))
    parser.add_argument("--arms", nargs="*", default=[], choices=LINES)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3, 4])
    given = parser.parse_args()
    torch.set_num_threads(1)
    world = World(given.system)
    found = public(world)
    states = played_from(world, found)
    log = PARTS / given.system / "dose.jsonl"
    top = given.folder / f"{given.system}-medium-expert"
    play(states, log, top, given.arms, given.seeds)
    weight = np.where(found["jury"][:, 1] == 1, 4, 1)
    bits = played(log)
    shares = survived(states, weight, bits)
    count = pd.Series(states.disturbance).value_counts()
    kept = count.index[count >= LEAST]
    shares = {name: of.loc[of.index.isin(kept)] for name, of in shares.items()}
    if set(LINES) <= set(shares):
        draw(shares, FIGURES / f"dose-{given.system}.png")
    means = pd.DataFrame({name: of.mean(axis=1) for name, of in shares.items()})
    rows = [
        {"disturbance": name, "states": count[name]}
        | {method: f"{share:.2f}" for method, share in row.items()}
        for name, row in means.iterrows()
    ]
    pages = [
        f"# Share of {given.system}'s disturbed states survived",
        "Written by `dose.py`: public walks, all judged states. A state that the "
        "expert survives stands for four in the first table, since one of four was "
        "kept.",
        table(rows),
        "By group, each state once:",
        table(by_group(states, bits)),
    ]
    write_atomically(HERE / f"dose-{given.system}.md", "\n\n".join(pages) + "\n")


if __name__ == "__main__":
    main()
