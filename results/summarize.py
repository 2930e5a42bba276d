"""Print the scores of an experiment's runs, one by one and over seeds.

    python results/summarize.py results/precision/runs.jsonl.gz

An interval of a run is over its episodes (of successes: Wilson's), one of a method over
its seeds.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import pandas as pd
from torchrl_osr.evaluation import mean_interval, measure_of, wilson_interval
from torchrl_osr.report import read_records, read_runs
from torchrl_osr.report.scores import by_run, estimate, recent, undisturbed


def row(episodes: pd.DataFrame, record: dict[str, Any]) -> dict[str, Any]:
    """Return the scores of one run, and how good its inverse dynamics model is."""
    scores = undisturbed(episodes).groupby("step")["score"]
    means, last = scores.mean(), record["returns"]["evaluations"][-1]
    low, high = mean_interval(scores.get_group(last["step"]))[1:]
    if "successes" in last:
        total = len(last["successes"])
        low, high = (
            100 * end for end in wilson_interval(sum(last["successes"]), total)
        )
    model = record["inverse_dynamics"] or {}
    return {
        "data's own": record["returns"][f"data_{measure_of(last)}"],
        "last": f"{means.iloc[-1]:.1f} [{low:.1f}, {high:.1f}]",
        "mean of the last five": means.iloc[-5:].mean(),
        "best (step)": f"{means.max():.1f} ({means.idxmax():,})",
        "model: nats": model.get("nll"),
        "R²": model.get("r2_mean"),
        "in 90 %": model.get("coverage_90"),
    }


def main(path: Path) -> None:
    """Print both tables."""
    tables = read_runs([path])
    records = {record["folder"]: record for record in read_records(path)}
    rows = {
        (run.data, run.method, run.seed): row(
            tables.episodes[tables.episodes["run"] == run.Index], records[run.folder]
        )
        for run in tables.runs.itertuples()
    }
    frame = pd.DataFrame.from_dict(rows, orient="index").dropna(axis=1, how="all")
    print(frame.to_string(float_format="{:.2f}".format))
    means = {
        key: {
            "seeds": str(group["run"].nunique()),
            "last": str(estimate(by_run(recent(group, 1)))),
            "mean of the last five": str(estimate(by_run(recent(group)))),
        }
        for key, group in tables.episodes.groupby(["data", "method"], sort=False)
    }
    print("\n" + pd.DataFrame.from_dict(means, orient="index").to_string())


if __name__ == "__main__":
    main(Path(sys.argv[1]))
