"""Collect finished runs of ``examples/offline_osr.py`` into raw CSV files and a figure.

    python results/first_run/summarize.py multirun/*/*/ outputs/*/*/

Writes beside itself ``episodes.csv`` (the raw return of every evaluation episode),
``scores.csv`` (a line a run) and ``curves.png``; prints means over seeds.
"""

from __future__ import annotations

import csv
import json
import sys
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from omegaconf import OmegaConf
from torchrl_osr.evaluation.figures import BLUE, ORANGE
from torchrl_osr.evaluation.summary import recent_score

from torchrl_osr.evaluation import mean_interval

HERE = Path(__file__).parent


def read_run(folder: Path) -> dict[str, Any]:
    """Return one finished run: its configuration and everything it evaluated."""
    cfg = OmegaConf.load(folder / "config.yaml")
    returns = json.loads((folder / "returns.json").read_text())
    return {
        "env": cfg.env.name,
        "data": cfg.data.level,
        "seed": cfg.seed,
        "recovery_weight": cfg.loss.recovery_weight,
        "steps": cfg.trainer.steps,
        **returns,
    }


def write_csv(name: str, rows: list[dict[str, Any]]) -> None:
    """Write rows of equal keys."""
    with (HERE / name).open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0].keys(), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def main(folders: list[Path]) -> None:
    """Write the tables and the figure of all runs."""
    runs = [read_run(each) for each in folders if (each / "returns.json").exists()]
    runs.sort(key=lambda run: (run["env"], run["data"], run["seed"]))
    names = ("env", "data", "seed", "recovery_weight", "steps")
    scores, episodes = [], []
    for run in runs:
        which = {name: run[name] for name in names}
        last, best = run["last"], run["best"]
        scores.append(
            which
            | {
                "data_score": round(run["data_score"], 2),
                "last": round(last["score"], 2),
                "last_low": round(last["score_low"], 2),
                "last_high": round(last["score_high"], 2),
                "mean_of_last_5": round(recent_score(run["evaluations"]), 2),
                "best": round(best["score"], 2),
                "best_step": best["step"],
            }
        )
        episodes += [
            which | {"step": row["step"], "episode_seed": seed, "return": value}
            for row in run["evaluations"]
            for seed, value in zip(row["seeds"], row["returns"], strict=True)
        ]
    write_csv("scores.csv", scores)
    write_csv("episodes.csv", episodes)
    groups = defaultdict(list)
    for run, score in zip(runs, scores, strict=True):
        groups[run["env"], run["data"]].append((run, score))
    for (env, data), members in groups.items():
        for column in ("last", "mean_of_last_5", "best"):
            mean, low, high = mean_interval([score[column] for _, score in members])
            print(
                f"{env} {data}: {column} {mean:.1f} [{low:.1f}, {high:.1f}] over "
                f"{len(members)} seeds; data {members[0][1]['data_score']}"
            )
    draw(groups)


def draw(groups: dict[tuple[str, str], list[Any]]) -> None:
    """Draw one panel an environment: every seed thin, their mean thick."""
    figure = Figure(figsize=(4.2 * len(groups), 3.4), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(1, len(groups), squeeze=False)[0]
    for axes, ((env, data), members) in zip(panels, groups.items(), strict=True):
        steps = [row["step"] for row in members[0][0]["evaluations"]]
        curves = [[row["score"] for row in run["evaluations"]] for run, _ in members]
        for curve in curves:
            axes.plot(steps, curve, color=BLUE, alpha=0.35, linewidth=1)
        label = f"policy, mean of {len(curves)} seeds" if len(curves) > 1 else "policy"
        axes.plot(steps, np.mean(curves, 0), color=BLUE, linewidth=2, label=label)
        data_score = members[0][1]["data_score"]
        axes.axhline(data_score, color=ORANGE, linestyle="--", label="data")
        axes.set(title=f"{env} {data}", xlabel="gradient steps", ylim=(0, None))
        axes.spines[["top", "right"]].set_visible(False)
        axes.legend(frameon=False, fontsize=8)
    panels[0].set_ylabel("normalised score")
    figure.savefig(HERE / "curves.png", dpi=150)


if __name__ == "__main__":
    main([Path(each) for each in sys.argv[1:]])
