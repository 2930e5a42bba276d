"""What came of steps 3 and 4: shares saved, with intervals.

    python results/recovery/methods.py

Reads ``parts/<system>/{cloning,look-ahead}-<half>.jsonl`` and writes ``methods.md``.
Lines of an older file of states are left out: their bits are of other states.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from search import read_jsonl
from states import PARTS
from tables import table

from torchrl_osr._files import sha256_of, write_atomically
from torchrl_osr.evaluation import percentile_interval
from torchrl_osr.evaluation.recoverable import (
    GROUPS,
    HALVES,
    STATES,
    RecoverableStates,
    read_recoverable_states,
)

FOLDER = Path(__file__).parent
RESAMPLES = 10_000
STUDIES = {"cloning": "noisy 0.1", "look-ahead": "base"}
"""Files, and the arm that all others are compared with."""


def name_of(line: dict) -> str:
    """Of an arm, with what was chosen for it."""
    chosen = [line["arm"], line.get("plan", "")]
    if line.get("width"):
        chosen.append(f"{line['width']:g}")
    if line.get("steps"):
        chosen.append(f"x {line['steps']}")
    return " ".join(filter(None, chosen))


def bits_of(line: dict, states: RecoverableStates) -> NDArray[np.float64]:
    """Whether each state was saved, ``[M]``; NaN where it was not played."""
    bits = np.full(len(states), np.nan)
    group = line.get("group")
    played = states.group == group if group else np.ones(len(states), dtype=bool)
    bits[played] = [int(bit) for bit in line["saved"]]
    return bits


TITLE = """# Which method saves any?

Written by `methods.py`: share of the states saved, mean over seeds, with 95 %
percentile intervals over seeds and walks; with one seed, over walks alone."""


class Draws:
    """Resamples of seeds and, independently, of walks: the same for all arms.

    Args:
        walk: of each state, ``[M]``.
    """

    def __init__(self, walk: NDArray[np.int32]) -> None:
        self.walks, number = np.unique(walk, return_inverse=True)
        self.member = np.eye(len(self.walks))[number]

    def shares(self, bits: NDArray[np.float64]) -> NDArray[np.float64]:
        """Share saved ``[RESAMPLES]`` of a table of seeds and states ``[N, M]``."""
        rng = np.random.default_rng(0)
        weights = [
            rng.multinomial(size, np.full(size, 1 / size), RESAMPLES) * 1.0
            for size in (len(self.walks), len(bits))
        ]
        walks, seeds = weights
        saved = np.einsum("rn,nw,rw->r", seeds, bits @ self.member, walks)
        return saved / (walks @ self.member.sum(0)) / len(bits)

    def describe(
        self, bits: NDArray[np.float64], less: NDArray[np.float64] | None = None
    ) -> str:
        """``.12 [.05, .20]`` of a share, or of the difference of two."""
        value, draws = bits.mean(), self.shares(bits)
        if less is not None:
            value, draws = value - less.mean(), draws - self.shares(less)
        low, high = percentile_interval(draws)
        return f"{value:.2f} [{low:.2f}, {high:.2f}]"


def rows_of(lines: list[dict], states: RecoverableStates, reference: str) -> list[dict]:
    """A row for each arm; differences are of the seeds that both have."""
    runs: dict[str, dict[int, NDArray[np.float64]]] = {}
    extra: dict[str, list[dict]] = {}
    for line in lines:
        bits, name = bits_of(line, states), name_of(line)
        old = runs.setdefault(name, {}).get(line["seed"], bits)
        runs[name][line["seed"]] = np.where(np.isnan(bits), old, bits)
        extra.setdefault(name, []).append(line)
    found = []
    for name, seeds in runs.items():
        row: dict = {"arm": name, "seeds": len(seeds)}
        common = [seed for seed in seeds if seed in runs.get(reference, {})]
        for group in reversed(GROUPS):
            inside = states.group == group
            bits, ours, theirs = (
                np.array([runs[each][seed][inside] for seed in some])
                for each, some in ((name, seeds), (name, common), (reference, common))
            )
            draws = Draws(states.walk[inside])
            row[group] = "" if np.isnan(bits).any() else draws.describe(bits)
            if group == "recoverable":
                there = name != reference and common
                row[f"less {reference}"] = draws.describe(ours, theirs) if there else ""
        if "undisturbed" in extra[name][0]:
            values = [line["undisturbed"] for line in extra[name]]
            row["undisturbed"] = f"{np.mean(values):.2f}"
        if "alive" in extra[name][0]:
            of = [x for x in extra[name] if x["group"] == "recoverable"]
            row["steps alive"] = f"{np.mean([x['alive'] for x in of]):.0f}"
        row["core seconds"] = f"{np.mean([x['seconds'] for x in extra[name]]):.0f}"
        found.append(row)
    return found


def main() -> None:
    """Write everything."""
    pages = [TITLE]
    for path in sorted(STATES.glob("*.npz")):
        states, digest = read_recoverable_states(path), sha256_of(path)
        half = next(each for each in HALVES if path.stem.endswith(each))
        for study, reference in STUDIES.items():
            lines = read_jsonl(PARTS / states.env_name / f"{study}-{half}.jsonl")
            lines = [line for line in lines if line["states"] == digest]
            settings = sorted({(x.get("episodes"), x.get("updates")) for x in lines})
            for episodes, updates in settings:
                chosen = [
                    x
                    for x in lines
                    if (x.get("episodes"), x.get("updates")) == (episodes, updates)
                ]
                title = f"## {study}, {states.env_name}, {half} half"
                if episodes:
                    title += f", {episodes} episodes, {updates} updates"
                pages += [title, table(rows_of(chosen, states, reference))]
    write_atomically(FOLDER / "methods.md", "\n\n".join(pages) + "\n")


if __name__ == "__main__":
    main()
