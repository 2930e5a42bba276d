"""Collect one run of each loss: raw returns, a table and a figure.

    python results/family/summarize.py multirun/*/*/ outputs/*/*/

Writes beside itself ``episodes.csv`` (the raw return of every evaluation episode),
``scores.csv`` (a line a run) and ``curves.png``.
"""

from __future__ import annotations

import csv
import json
import sys
from pathlib import Path
from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from omegaconf import OmegaConf
from torchrl_osr.evaluation.summary import recent_score

HERE = Path(__file__).parent
# In the order of the table, by what the configuration says of them.
LOSSES = {
    "cql": "CQL(H)",
    "osr": "OSR",
    "osr_v": "OSR-v",
    "osr_official": "OSR, official variant",
    "osr_adversarial": "OSR, adversarial twins",
    "sac_10": "SAC-N, N = 10",
    "osr_10": "OSR-10",
    "edac_10": "EDAC, N = 10",
}


def read_run(folder: Path) -> dict[str, Any]:
    """Return one finished run: which loss it was and everything it evaluated."""
    overrides = OmegaConf.load(folder / ".hydra" / "overrides.yaml")
    (loss,) = [o.removeprefix("loss=") for o in overrides if o.startswith("loss=")]
    cfg = OmegaConf.load(folder / "config.yaml")
    returns = json.loads((folder / "returns.json").read_text())
    return {"loss": loss, "seed": cfg.seed, "steps": cfg.trainer.steps, **returns}


def write_csv(name: str, rows: list[dict[str, Any]]) -> None:
    """Write rows of equal keys."""
    with (HERE / name).open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0].keys(), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def main(folders: list[Path]) -> None:
    """Write the tables and the figure of all runs."""
    runs = [read_run(each) for each in folders if (each / "returns.json").exists()]
    runs.sort(key=lambda run: (list(LOSSES).index(run["loss"]), run["seed"]))
    scores, episodes = [], []
    for run in runs:
        which = {name: run[name] for name in ("loss", "seed", "steps")}
        last, best = run["last"], run["best"]
        score = which | {
            "data_score": round(run["data_score"], 1),
            "last": round(last["score"], 1),
            "last_low": round(last["score_low"], 1),
            "last_high": round(last["score_high"], 1),
            "mean_of_last_5": round(recent_score(run["evaluations"]), 1),
            "best": round(best["score"], 1),
            "best_step": best["step"],
        }
        scores.append(score)
        print(
            f"| {LOSSES[run['loss']]} | {score['last']} [{score['last_low']}, "
            f"{score['last_high']}] | {score['mean_of_last_5']} | {score['best']} "
            f"({best['step']:,}) |"
        )
        episodes += [
            which | {"step": row["step"], "episode_seed": seed, "return": value}
            for row in run["evaluations"]
            for seed, value in zip(row["seeds"], row["returns"], strict=True)
        ]
    write_csv("scores.csv", scores)
    write_csv("episodes.csv", episodes)
    draw(runs)


def draw(runs: list[dict[str, Any]]) -> None:
    """Draw one small panel a loss, with the data's score."""
    columns = 4
    rows = -(-len(runs) // columns)
    figure = Figure(figsize=(3 * columns, 2.4 * rows), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    for axes in panels.flat[len(runs) :]:
        axes.set_visible(False)
    for axes, run in zip(panels.flat, runs, strict=False):
        table = run["evaluations"]
        steps = [row["step"] / 1000 for row in table]
        low, high = ([row[f"score_{end}"] for row in table] for end in ("low", "high"))
        axes.fill_between(steps, low, high, alpha=0.25, linewidth=0)
        axes.plot(steps, [row["score"] for row in table], linewidth=2)
        axes.axhline(run["data_score"], color="grey", linestyle="--", linewidth=1)
        axes.set_title(LOSSES[run["loss"]], fontsize=10)
        axes.spines[["top", "right"]].set_visible(False)
    figure.supxlabel("thousand gradient steps", fontsize=9)
    figure.supylabel("normalised score (dashed: data)", fontsize=9)
    figure.savefig(HERE / "curves.png", dpi=130)


if __name__ == "__main__":
    main([Path(each) for each in sys.argv[1:]])
