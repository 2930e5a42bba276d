"""Step 5: does it help to imagine what follows a disturbance?

    python results/recovery/imagination.py outputs/imagination --seeds 0 1
    python results/recovery/imagination.py outputs/imagination --pack imagination
    sh results/recovery/look.sh

Each run is ``torchrl-osr train`` in a process with one torch thread, then its last
checkpoints play from the recoverable states. What is there is not done again; what is
finished is packed into a table beside this file, and all of them are printed:
``imagination.jsonl.gz``; ``imagination-look.jsonl.gz``, the look at the held-out half;
``imagination-choice.jsonl.gz``, the runs of the look at a choice; and
``imagination-pilots.jsonl.gz``, of arms that are not made any more.
"""

from __future__ import annotations

import argparse
import gzip
import json
import os
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

from tables import table
from torchrl_osr.evaluation.recoverable import (
    GROUPS,
    recovered_share,
    saved_difference,
    saved_share,
)
from torchrl_osr.report import read_records, read_runs
from torchrl_osr.report.runs import read_record
from torchrl_osr.report.saved import came_back, percent, saved_states
from torchrl_osr.report.scores import by_run, estimate, recent

HERE = Path(__file__).parent
LOOKS = "imagination-look", "imagination-choice"
TABLES = "imagination", *LOOKS, "imagination-pilots"
STEPS = 60_000
MODEL = [
    *("dynamics=ensemble", "dynamics.real_ratio=0.5", "dynamics.rollout_steps=30"),
    *("dynamics.num_cells=[200,200,200]", "dynamics.steps=40_000"),
    *("dynamics.action_noise=0.2", "dynamics.generations=20"),
]
HALT = ["dynamics.unknown=halt", "dynamics.known_share=0.99"]
DISTURBED = "dynamics.disturbed_steps=10"
REFERENCE = "noisy cloning"
BASE = ["loss=td3_bc", "optim.actor_lr=1e-3"]  # the preset's, but for medium-expert
ARMS = {
    REFERENCE: [*BASE, "recovery=noisy_bc"],
    "base": BASE,
    "disturbed starts": [*BASE, *MODEL, *HALT, DISTURBED],
    "undisturbed starts": [*BASE, *MODEL, *HALT],
    "disturbed starts, no halt": [*BASE, *MODEL, DISTURBED],
    "simulator, disturbed starts": [*BASE, *MODEL, DISTURBED],
    "simulator, undisturbed starts": [*BASE, *MODEL],
    "permuted, disturbed starts": [*BASE, *MODEL, *HALT, DISTURBED],
    "CQL(H)": ["loss=cql"],
    "OSR": ["loss=osr"],
    "CQL(H), disturbed starts": ["loss=cql", *MODEL, *HALT, DISTURBED],
}
"""The base is TD3+BC: the preset quick, larger batches and twice its updates.

With disturbed starts and the halt it is ``loss=rim`` with a longer trained model.
"""
IN_PLACE = {
    "simulator, disturbed starts": "simulated.py",
    "simulator, undisturbed starts": "simulated.py",
    "permuted, disturbed starts": "permuted.py",
}
"""Arms that have something else in the model's place."""


def python(*arguments: str, log: Path) -> None:
    """Run Python with one thread; keep what it prints."""
    with log.open("w") as file:
        subprocess.run(
            [sys.executable, *arguments],
            stdout=file, stderr=subprocess.STDOUT, check=True,
            env=os.environ | {"OMP_NUM_THREADS": "1"},
        )  # fmt: skip


def run(folder: Path, arm: str, data: str, seed: int, half: str) -> None:
    """Train one run, and play its last checkpoints from the states."""
    env, quality = data.split("-", 1)
    quality, _, random = quality.partition("+random")  # expert+random0.5: half of it
    folder.mkdir(parents=True, exist_ok=True)
    status = folder / "status.json"
    if not status.exists() or json.loads(status.read_text())["status"] != "done":
        train = ["-m", "torchrl_osr", "train"]
        if arm in IN_PLACE:
            train = [str(HERE / IN_PLACE[arm])]
        python(
            *train, f"env={env}", f"data={quality}", f"seed={seed}",
            f"data.random_share={random or 0}",
            *ARMS[arm], f"trainer.steps={STEPS}", "trainer.batch_size=256",
            f"trainer.eval_interval={STEPS // 20}", "trainer.progress=false",
            f"hydra.run.dir='{folder}'",
            log=folder / "train.txt",
        )  # fmt: skip
    python(
        "-m", "torchrl_osr", "evaluate", f"checkpoint='{folder}'", "suite=recoverable",
        f"suite.half={half}", "progress=false", log=folder / "recoverable.txt",
    )  # fmt: skip
    print(folder, flush=True)


def pack(folder: Path, path: Path) -> None:
    """Add the finished runs below a folder to a table, called by their arms."""
    records = {}
    if path.exists():
        records = {each["folder"]: each for each in read_records(path)}
    for run in {each.parent for each in folder.glob("*/*/*/recoverable-*.json")}:
        name = run.relative_to(folder).as_posix()
        records[name] = read_record(run) | {"folder": name, "method": run.parent.name}
    lines = [json.dumps(records[each]) + "\n" for each in sorted(records)]
    path.write_bytes(gzip.compress("".join(lines).encode(), mtime=0))


def described(path: Path) -> str:
    """Markdown: undisturbed score and shares of the states, by data, half and arm."""
    tables = read_runs([path])
    groups = GROUPS[::-1]
    rows = []
    for each in saved_states(tables, REFERENCE):
        mine = (tables.episodes["data"] == each.data) & (
            tables.episodes["method"] == each.method
        )
        score = estimate(by_run(recent(tables.episodes[mine])))
        row = {"arm": f"{each.method}, {each.data}", "half": each.states.split()[0]}
        row |= {"seeds": len(each.seeds), "score": score}
        row |= {f"{name} %": each.shares[name] for name in groups}
        rows.append(row | {"R %": each.recovered or ""})
    return table(rows)


def by_kind(path: Path) -> str:
    """Markdown: disturbed starts against the two others, by kind of disturbance.

    In percent: what they save; points more than undisturbed starts; and R against noisy
    cloning, each over the seeds that both have.
    """
    first, second = list(ARMS)[2:4]
    gained, rows = f"points more than {second}", []
    for data, states, of_each, back in came_back(read_runs([path])):
        hard = of_each["group"] == GROUPS[-1]
        kind = of_each["disturbance"].str.extract(r"^(\w+)", expand=False)
        for name in ("all", *sorted(set(kind[hard]))):
            of = hard & ((kind == name) | (name == "all"))
            walk, mine = of_each["walk"][of], back.loc[:, of]
            ours, theirs = (
                mine.loc[first],
                mine[mine.index.get_level_values(0) == REFERENCE],
            )
            theirs = theirs.droplevel(0)
            row = {"kind": f"{name}, {data}, {states.split()[0]}", "states": of.sum()}
            row |= {first: percent(saved_share(ours, walk), len(ours))}
            row |= {gained: "", "R %": ""}
            if second in mine.index:
                pair = ours.align(mine.loc[second], "inner", axis=0)
                row[gained] = percent(saved_difference(*pair, walk), len(pair[0]))
            both = theirs.index.intersection(ours.index)
            share = ours.loc[both], theirs.loc[both]
            if len(both):
                with suppress(ValueError):  # cloning saves all, at least in a resample
                    row["R %"] = percent(recovered_share(*share, walk), len(both))
            rows.append(row)
    return table(rows)


def main() -> None:
    """Train and play what was not yet, or pack and print."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--data", nargs="+", default=["walker2d-medium-expert"])
    parser.add_argument("--arms", nargs="+", default=list(ARMS), choices=ARMS)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--half", default="public", choices=("public", "held-out"))
    parser.add_argument("--pack", choices=TABLES[:3], help="the table; run nothing")
    given = parser.parse_args()
    if given.pack:
        pack(given.folder, HERE / f"{given.pack}.jsonl.gz")
        for name in TABLES:
            path = HERE / f"{name}.jsonl.gz"
            if not path.exists():
                continue
            print(f"\n{name}\n\n{described(path)}")
            if name in TABLES[:3]:
                print("", by_kind(path), sep="\n")
        return
    for seed in given.seeds:
        for data in given.data:
            for arm in given.arms:
                folder = given.folder / data / arm / f"seed{seed}"
                run(folder, arm, data, seed, given.half)


if __name__ == "__main__":
    main()
