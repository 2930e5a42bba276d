"""Does the precision of the products change the score? Collect the runs.

    python results/precision/summarize.py outputs/*/*/

Writes beside itself ``scores.csv`` (a line a run) and ``episodes.csv`` (the raw return
of every evaluation episode), and prints means over seeds with their intervals.
"""

from __future__ import annotations

import csv
import json
import sys
from collections import defaultdict
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf
from torchrl_osr.evaluation.summary import recent_score

from torchrl_osr.evaluation import mean_interval

HERE = Path(__file__).parent


def read_run(folder: Path) -> dict[str, Any]:
    """Return one finished run: its precision, seed and everything it evaluated."""
    cfg = OmegaConf.load(folder / "config.yaml")
    returns = json.loads((folder / "returns.json").read_text())
    precision = f"{cfg.trainer.precision} {cfg.trainer.matmul_precision}"
    return {"precision": precision, "seed": cfg.seed, **returns}


def write_csv(name: str, rows: list[dict[str, Any]]) -> None:
    """Write rows of equal keys."""
    with (HERE / name).open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0].keys(), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def main(folders: list[Path]) -> None:
    """Write the tables, print the means."""
    runs = [read_run(each) for each in folders if (each / "returns.json").exists()]
    runs.sort(key=lambda run: (run["precision"], run["seed"]))
    scores, episodes = [], []
    for run in runs:
        which = {name: run[name] for name in ("precision", "seed")}
        scores.append(
            which
            | {
                "last": round(run["last"]["score"], 1),
                "mean_of_last_5": round(recent_score(run["evaluations"]), 1),
                "best": round(run["best"]["score"], 1),
                "best_step": run["best"]["step"],
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
    for score in scores:
        groups[score["precision"]].append(score)
    for precision, members in groups.items():
        cells = []
        for column in ("last", "mean_of_last_5"):
            values = [member[column] for member in members]
            mean, low, high = mean_interval(values)
            each = ", ".join(f"{value:.1f}" for value in values)
            cells.append(f"{each}: {mean:.1f} [{low:.1f}, {high:.1f}]")
        print(f"| {precision} | {cells[0]} | {cells[1]} |")


if __name__ == "__main__":
    main([Path(each) for each in sys.argv[1:]])
