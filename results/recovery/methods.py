"""What came of steps 3, 4 and of a choice: shares saved, with intervals.

    python results/recovery/methods.py

Reads ``parts/<system>/{cloning,ways,look-ahead,choice}-<half>.jsonl`` and, for noisy
cloning beside a choice, step 5's tables; writes ``methods.md``.
Lines of an older file of states are left out: their bits are of other states.
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from choice import JUDGES
from imagination import LOOKS, REFERENCE
from numpy.typing import NDArray
from search import read_jsonl
from states import PARTS
from tables import table
from torchrl_osr.evaluation.recoverable import (
    GROUPS,
    HALVES,
    STATES,
    RecoverableStates,
    read_recoverable_states,
    recovered_share,
    saved_difference,
    saved_share,
)
from torchrl_osr.report import read_runs
from torchrl_osr.report.saved import came_back

from torchrl_osr._files import sha256_of, write_atomically

FOLDER = Path(__file__).parent
STUDIES = "cloning", "ways", "look-ahead"
EPISODES = 20
"""Of an arm that does not name them."""

NOISY = {"pointmaze-medium": "noisy 0.3", "walker2d": "noisy 0.1"}
"""Of whose losses R is the share: the better width of the pilot."""

MATCHED = "noisy 0.1, 100 episodes"
"""The same for ``ways`` and look-ahead: its undisturbed score is more like theirs."""

TWINS = {
    "osr": "noisy",
    "osr-clean": "noisy",
    "expert": "noisy",
    "corrective": "corrective-row",
    "corrective-flipped": "corrective-row",
    "ways": "ways-expert",
    "look-ahead": "shuffled",
}


CHOICE, SHUFFLED = "models 20", "shuffled 20"
"""The choice that was looked at, and what it owes to chance."""


def name_of(line: dict) -> str:
    """Of an arm, with what was chosen for it."""
    chosen = [line["arm"]]
    if line.get("plan"):
        chosen.append(line["plan"])
        if line["arm"] != "simulator":
            chosen.append(line.get("model") or "small")
    if line.get("width"):
        chosen.append(f"{line['width']:g}")
    if line.get("steps"):
        chosen.append(f"x {line['steps']}")
    name = " ".join(chosen) + around(line)
    episodes = line.get("episodes", EPISODES)
    return name if episodes == EPISODES else f"{name}, {episodes} episodes"


def around(line: dict) -> str:
    """Whose policy it is that is planned around; nothing for the clone."""
    run = line.get("run")
    return f", {run.split('/')[1]}" if run else ""


def bits_of(line: dict, states: RecoverableStates) -> NDArray[np.float64]:
    """Whether each state was saved, ``[M]``; NaN where it was not played."""
    bits = np.full(len(states), np.nan)
    group = line.get("group")
    played = states.group == group if group else np.ones(len(states), dtype=bool)
    bits[played] = [int(bit) for bit in line["saved"]]
    return bits


TITLE = """# Which method saves any?

Written by `methods.py`: share of the states saved, mean over seeds, with 95 %
percentile intervals over seeds and walks; with one seed, over walks alone. *less its
twin*: points more than the same states with the row's action as their label, or, for
the planner's ways, with the expert's, or for look-ahead with shuffled predictions.
*R*: what is saved of the losses of noisy cloning of as many episodes and the better
width, or, for ways and look-ahead, of 100 episodes (the ways' study). Demonstrations
are of 20 episodes but where it says otherwise. A *choice* is among the policies of
several runs, as many *sets* of them as were played: *less one of them*, the mean of
the set; *less shuffled*, the same chosen between by shuffled predictions; intervals
resample sets (of *one*, the policies) and walks, with one set walks alone, so that
another set may differ by more. R is against step 5's noisy cloning, whose seeds are
resampled, too."""


def told(share: tuple[float, float, float]) -> str:
    """``0.12 [0.05, 0.20]``."""
    value, low, high = share
    return f"{value:.2f} [{low:.2f}, {high:.2f}]"


def twin(name: str) -> str:
    """The arm whose states these are, with another label."""
    arm, _, step = name.partition(" ")
    return f"{TWINS.get(arm, '')} {step}"


def reference(name: str, study: str, env_name: str) -> str:
    """The arm of whose losses R is the share."""
    if study != "cloning":
        return MATCHED
    return ", ".join([NOISY[env_name], *name.split(", ")[1:]])


def rows_of(
    lines: list[dict],
    states: RecoverableStates,
    study: str,
    elsewhere: NDArray[np.float64] | None = None,
) -> list[dict]:
    """A row for each arm; comparisons are over the seeds that both have.

    R is against ``elsewhere`` if given: how often noisy cloning comes back from each
    state in another study, ``[M]``.
    """
    runs: dict[str, dict[int, NDArray[np.float64]]] = {}
    extra: dict[str, list[dict]] = {}
    for line in lines:
        bits, name = bits_of(line, states), name_of(line)
        seed = line["seed"], line.get("run")
        old = runs.setdefault(name, {}).get(seed, bits)
        runs[name][seed] = np.where(np.isnan(bits), old, bits)
        extra.setdefault(name, []).append(line)
    hard = states.group == GROUPS[-1]
    others = dict(runs)
    if elsewhere is not None:
        others[MATCHED] = {seed: elsewhere for each in runs.values() for seed in each}

    found = []
    for name, seeds in runs.items():
        row: dict = {"arm": name, "seeds": len(seeds)}
        for group in reversed(GROUPS):
            inside = states.group == group
            bits = np.array([each[inside] for each in seeds.values()])
            known = not np.isnan(bits).any()
            row[group] = told(saved_share(bits, states.walk[inside])) if known else ""
        for column, other in (
            ("less its twin", twin(name)),
            ("less base", "base" + around(extra[name][0])),
            ("R", reference(name, study, states.env_name)),
        ):
            row[column] = ""
            common = [seed for seed in seeds if seed in others.get(other, {})]
            if name == other or not common:
                continue
            ours, theirs = (
                np.array([others[each][seed][hard] for seed in common])
                for each in (name, other)
            )
            walk = states.walk[hard]
            if column == "R":
                share = recovered_share(ours, theirs, walk)
            else:
                share = saved_difference(ours, theirs, walk)
            row[column] = told(share)
        values = [x["undisturbed"] for x in extra[name] if "undisturbed" in x]
        row["undisturbed"] = f"{np.mean(values):.2f}" if values else ""
        of = [x for x in extra[name] if x.get("group", GROUPS[-1]) == GROUPS[-1]]
        alive = [x["alive"] for x in of if "alive" in x]
        row["steps alive"] = f"{np.mean(alive):.0f}" if alive else ""
        row["core seconds"] = f"{np.mean([x['seconds'] for x in of]):.0f}"
        found.append(row)
    used = {column for row in found for column, cell in row.items() if cell != ""}
    return [{name: row[name] for name in row if name in used} for row in found]


def rows_of_choice(
    lines: list[dict], states: RecoverableStates, noisy: NDArray[np.float64]
) -> list[dict]:
    """A row for each arm of ``choice.py``.

    R is against ``noisy``: how often each seed of noisy cloning comes back from each of
    the recoverable states, ``[N, m]``.
    """
    found: dict[tuple[str, str, int], dict[str, list[dict]]] = {}
    for line in lines:
        kind = line["runs"].partition(", ")[2]
        count = len(line["seeds"]) * line.get("last", 1)
        groups = found.setdefault((line["arm"], kind, count), {})
        groups.setdefault(line["group"], []).append(line)
    walks = {group: states.walk[states.group == group] for group in GROUPS}
    hard = GROUPS[-1]

    def bits(
        key: tuple[str, str, int], group: str, sets: list[list]
    ) -> NDArray[np.float64]:
        """How often each set's policies save each state of a group, ``[sets, m]``."""
        played = found.get(key, {}).get(group, [])
        mine = [
            [line["saved"] for line in played if {*each}.issuperset(line["seeds"])]
            for each in sets
        ]
        return np.array(
            [np.mean([[*map(int, bits)] for bits in each], 0) for each in mine if each]
        )

    rows = []
    for key, groups in found.items():
        arm, kind, count = key
        row: dict = {"arm": arm, "policies": f"{count} of {kind}"}
        row["sets"] = len(groups[hard])
        sets = [line["seeds"] for line in groups[hard]]
        for group in reversed(GROUPS):
            mine = bits(key, group, sets)
            row[group] = told(saved_share(mine, walks[group])) if mine.size else ""
        mine = bits(key, hard, sets)
        others = {"one of them": ("one", kind, 1), "shuffled": (SHUFFLED, kind, count)}
        for name, other in others.items():
            theirs, row[f"less {name}"] = bits(other, hard, sets), ""
            if key != other and len(theirs) == len(mine):
                row[f"less {name}"] = told(saved_difference(mine, theirs, walks[hard]))
        share = recovered_share(mine, noisy, walks[hard], paired=False)
        row["R"] = told(share)
        values = [x["undisturbed"] for x in groups.get("easy", [])]
        row["undisturbed"] = f"{np.mean(values):.1f}" if values else ""
        seconds = [x["seconds"] for x in groups[hard]]
        rows.append(row | {"core seconds": f"{np.mean(seconds):.0f}"})
    return rows


def kinds_of_choice(
    lines: list[dict], states: RecoverableStates, noisy: NDArray[np.float64]
) -> list[dict]:
    """A row for each kind of disturbance: the models' choice among five, and one.

    R has no interval where noisy cloning saves all in a resample.
    """
    hard = states.group == GROUPS[-1]
    bits = {
        arm: np.array(
            [
                [int(bit) for bit in line["saved"]]
                for line in lines
                if (line["arm"], line["group"], len(line["seeds"]))
                == (arm, GROUPS[-1], count)
                and "last" not in line
            ],
            float,
        )
        for arm, count in (("one", 1), (CHOICE, 5))
    }
    rows = []
    kinds = np.array([each.partition("-")[0] for each in states.kind[hard]])
    for kind in sorted(set(kinds)):
        of = kinds == kind
        walk = states.walk[hard][of]
        one, mine = (table[:, of] for table in bits.values())
        row = {"kind": kind, "states": of.sum()}
        row |= {"noisy cloning": told(saved_share(noisy[:, of], walk))}
        row |= {"one": told(saved_share(one, walk))}
        row |= {CHOICE: told(saved_share(mine, walk)), "R": ""}
        with suppress(ValueError):
            row["R"] = told(recovered_share(mine, noisy[:, of], walk, paired=False))
        rows.append(row)
    return rows


def noisy_cloning(states: RecoverableStates, half: str) -> NDArray[np.float64]:
    """How often each seed of step 5's noisy cloning comes back, ``[N, m]``."""
    sources = ["imagination"] if half == "public" else LOOKS
    tables = read_runs([FOLDER / f"{source}.jsonl.gz" for source in sources])
    wanted = f"{states.env_name} medium-expert", half
    for data, name, of_each, back in came_back(tables):
        if (data, name.split()[0]) == wanted:
            hard = (of_each["group"] == GROUPS[-1]).to_numpy()
            return back.loc[REFERENCE].to_numpy()[:, hard]
    raise ValueError(f"{sources}: nothing of the {half} half of {states.env_name}.")


def mean_bits(lines: list[dict], states: RecoverableStates, name: str) -> Any:
    """How often an arm comes back from each state, ``[M]``; None without it."""
    bits = [bits_of(line, states) for line in lines if name_of(line) == name]
    return np.mean(bits, axis=0) if bits else None


def main() -> None:
    """Write everything."""
    pages = [TITLE]
    for path in sorted(STATES.glob("*.npz")):
        states, digest = read_recoverable_states(path), sha256_of(path)
        half = next(each for each in HALVES if path.stem.endswith(each))
        studies = {}
        for study in STUDIES:
            lines = read_jsonl(PARTS / states.env_name / f"{study}-{half}.jsonl")
            studies[study] = [line for line in lines if line["states"] == digest]
        for study, lines in studies.items():
            elsewhere = None
            if study == "look-ahead":
                elsewhere = mean_bits(studies["ways"], states, MATCHED)
            for updates in sorted({line.get("updates") for line in lines}):
                chosen = [line for line in lines if line.get("updates") == updates]
                title = f"## {study}, {states.env_name}, {half} half"
                title += f", {updates} updates" if updates else ""
                pages += [title, table(rows_of(chosen, states, study, elsewhere))]
        lines = read_jsonl(PARTS / states.env_name / f"choice-{half}.jsonl")
        if lines := [line for line in lines if line["states"] == digest]:
            noisy = noisy_cloning(states, half)
            rows = rows_of_choice(lines, states, noisy)
            pages += [f"## choice, {states.env_name}, {half} half", table(rows)]
            of_starts = [x for x in lines if x["runs"].endswith(JUDGES)]
            if of_starts:
                rows = kinds_of_choice(of_starts, states, noisy)
                pages += [f"### {CHOICE}, by kind of disturbance", table(rows)]
    write_atomically(FOLDER / "methods.md", "\n\n".join(pages) + "\n")


if __name__ == "__main__":
    main()
