"""Draw which share of a robot's disturbed states is survived, by strength.

    python results/recovery/dose.py walker2d
    python results/recovery/dose.py hopper

A disturbance leads to easy, contested, recoverable and not saved states; ``tables.md``
counts them. A policy survives its share of each group, of the recoverable ones by
disturbance, public half; the planner survives all but those that it did not save, of
which nobody here is given any.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import pandas as pd
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from tables import by_disturbance, gather
from world import World

from torchrl_osr.report import read_runs

HERE = Path(__file__).parent
FIGURES = HERE.parents[1] / "docs" / "figures"
LINES = {
    "disturbed starts": ("recovery by imagination", "#D55E00"),
    "undisturbed starts": ("from undisturbed starts", "#E69F00"),
    "osr": ("OSR", "#0072B2"),
    "noisy cloning": ("noisy cloning", "0.45"),
}
KINDS = ("torque", "rest", "push", "kick", "kick-root", "kick-joints")
LEAST = 50
"""States of a strength, both halves together, below which it is left out."""


def survived(counts: pd.DataFrame, saved: pd.DataFrame) -> pd.DataFrame:
    """Share survived ``[disturbance, seed]`` of one method."""
    controls = saved[saved["group"] != "recoverable"]
    share = controls.groupby(["seed", "group"])["back"].mean().unstack()
    hard = saved[saved["group"] == "recoverable"]
    back = hard.groupby(["seed", "disturbance"])["back"].mean().unstack()
    back = back.reindex(columns=counts.index).fillna(0)
    found = {
        name: sum(counts.at[name, each] * share[each] for each in ("easy", "contested"))
        + counts.at[name, "recoverable"] * back[name]
        for name in counts.index
    }
    return pd.DataFrame(found).T.div(counts.sum(axis=1), axis=0)


def draw(counts: pd.DataFrame, shares: dict[str, pd.DataFrame], path: Path) -> None:
    """A panel for each kind of disturbance."""
    figure = Figure(figsize=(10, 5.6), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(2, 3, sharey=True).ravel()
    for axes, kind in zip(panels, KINDS, strict=True):
        names = [name for name in counts.index if name.split()[0] == kind]
        strength = [float(name.split()[1]) for name in names]
        mine = counts.loc[names]
        oracle = 1 - mine["not saved"] / mine.sum(axis=1)
        axes.plot(strength, oracle, color="black", linestyle=":", label="planner")
        for method, (label, colour) in LINES.items():
            if method not in shares:
                continue
            of = shares[method].loc[names]
            axes.plot(strength, of.mean(axis=1), "o-", ms=3, color=colour, label=label)
            if of.shape[1] > 1:
                low, high = of.min(axis=1), of.max(axis=1)
                axes.fill_between(strength, low, high, color=colour, alpha=0.15, lw=0)
        axes.set_title(kind, loc="left", fontsize=10)
        axes.set_xticks(strength)
        axes.spines[["top", "right"]].set_visible(False)
        axes.set_ylim(0, 1)
    panels[0].legend(frameon=False, fontsize=8)
    figure.supxlabel("strength", fontsize=10)
    figure.supylabel("share survived", fontsize=10)
    figure.savefig(path, dpi=130)


def main() -> None:
    """Read, draw and print."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("system", choices=("walker2d", "hopper"))
    system = parser.parse_args().system
    world = World(system)
    counts = pd.DataFrame(by_disturbance(world, gather(world)))
    counts = counts.set_index("disturbance").drop(columns="not searched yet")
    counts = counts[counts.sum(axis=1) >= LEAST]
    scores = HERE.parent / "scoreboard" / f"{system}-medium-expert.jsonl.gz"
    saved = read_runs([HERE / "imagination-look.jsonl.gz", scores]).saved
    saved = saved[saved["data"] == f"{system} medium-expert"]
    # OSR has played from this half alone.
    saved = saved[saved["states"].str.startswith("public")].astype({"back": float})
    shares = {
        method: survived(counts, of)
        for method, of in saved.groupby("method")
        if method in LINES
    }
    draw(counts, shares, FIGURES / f"dose-{system}.png")
    oracle = 1 - counts["not saved"] / counts.sum(axis=1)
    means = {name: of.mean(axis=1) for name, of in shares.items()}
    print(pd.DataFrame({"planner": oracle} | means).round(2).to_string())


if __name__ == "__main__":
    main()
