"""Score by processor time: the quick preset beside published settings, same data.

    python benchmarks/time_to_score.py                       what is missing
    python benchmarks/time_to_score.py --methods OSR CQL --envs hopper --seeds 0 1
    python benchmarks/time_to_score.py --draw                table and figure

Each run is ``torchrl-osr train`` in a process of its own with one torch thread. Its
time is the processor's, from when the data are there, without the evaluations. Runs are
added to ``results/time_to_score/runs.csv.xz``; those that are there are not repeated.
Published settings are CORL's for ``medium-replay`` (tinkoff-ai/CORL,
``configs/offline``), and IQL's own for MuJoCo, with the data and evaluations of the
quick runs and for about as much time.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any

import pandas as pd

RESULTS = Path(__file__).parents[1] / "results" / "time_to_score"
ENVS = ("hopper", "walker2d", "halfcheetah")
PUBLISHED = ["preset=paper", "data.num_transitions=200_000", "trainer.eval_episodes=10"]
METHODS = {
    "OSR": [],
    "CQL": [
        *PUBLISHED, "loss=cql", "network.num_cells=[256,256,256]",
        "loss.min_q_weight=10", "optim.actor_lr=3e-5",
        "trainer.steps=2_400", "trainer.eval_interval=300",
    ],
    "TD3+BC": [
        *PUBLISHED, "loss=td3_bc", "optim.actor_lr=3e-4",
        "trainer.steps=24_000", "trainer.eval_interval=3_000",
    ],
    "IQL": [
        *PUBLISHED, "loss=iql", "optim.actor_lr=3e-4",
        "trainer.steps=20_000", "trainer.eval_interval=2_500",
    ],
}  # fmt: skip
COLORS = dict(zip(METHODS, ("#0072B2", "#D55E00", "#009E73", "#E69F00"), strict=True))


def train_here(overrides: Sequence[str]) -> list[dict[str, float]]:
    """Train in this process; return step, processor seconds and scores."""
    from torchrl_osr.lab.__main__ import main as start
    from torchrl_osr.lab.evaluation import EpisodeEvaluator
    from torchrl_osr.trainers import OfflineTrainer

    began: float | None = None
    paused, seconds = 0.0, []
    build, play = OfflineTrainer.__init__, EpisodeEvaluator.__call__

    def timed_build(self: Any, *arguments: Any, **options: Any) -> None:
        nonlocal began  # the first trainer is the inverse dynamics model's
        began = time.process_time() if began is None else began
        build(self, *arguments, **options)

    def timed_play(self: Any, *arguments: Any, **options: Any) -> Any:
        nonlocal paused
        before = time.process_time()
        seconds.append(before - (before if began is None else began) - paused)
        results = play(self, *arguments, **options)
        paused += time.process_time() - before
        return results

    OfflineTrainer.__init__, EpisodeEvaluator.__call__ = timed_build, timed_play
    with tempfile.TemporaryDirectory() as folder:
        start(["train", *overrides, f"hydra.run.dir={folder}/run"])
        record = json.loads((Path(folder) / "run" / "returns.json").read_text())
    rows = record["evaluations"]
    each = len(seconds) // len(rows)  # the average and the last weights are both played
    kept = ("step", "score", "score_of_last_weights")
    return [
        {key: round(row[key], 2) for key in kept if key in row} | {"seconds": second}
        for row, second in zip(rows, seconds[::each], strict=True)
    ]


def finished() -> pd.DataFrame:
    """Return the runs that are there, a row for each evaluation."""
    return pd.read_csv(RESULTS / "runs.csv.xz")


def run_missing(options: argparse.Namespace) -> None:
    """Do each run that is not there, in a process of its own."""
    done = set(finished()[["method", "env", "seed"]].itertuples(index=False, name=None))
    for seed, env, method in product(options.seeds, options.envs, options.methods):
        if (method, env, seed) in done:
            continue
        overrides = [f"env={env}", f"seed={seed}", *METHODS[method]]
        overrides += ["trainer.progress=false"]
        with tempfile.NamedTemporaryFile("r") as answer:
            command = [sys.executable, __file__, "--train", answer.name, *overrides]
            environment = os.environ | {"OMP_NUM_THREADS": "1"}
            subprocess.run(command, check=True, env=environment, stdout=sys.stderr)
            rows = pd.DataFrame(json.load(answer))
        of = {"method": method, "env": env, "seed": seed, "load": os.getloadavg()[0]}
        runs = pd.concat([finished(), rows.assign(**of)])
        runs.to_csv(RESULTS / "runs.csv.xz", index=False)
        print(method, env, seed, f"{rows['score'].tail(5).mean():.1f}", flush=True)


def table(runs: pd.DataFrame) -> str:
    """Return the mean of the last five evaluations over seeds, in Markdown."""
    from torchrl_osr.lab.evaluation import mean_interval

    lines = [
        "| task | method | seeds | last five, median | mean [95 %] "
        "| standard deviation | processor minutes | ms an update |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for (env, method), rows in runs.groupby(["env", "method"], sort=False):
        by_seed = rows.groupby("seed")
        scores = by_seed["score"].apply(lambda score: score.tail(5).mean())
        mean, low, high = mean_interval(scores)
        ends = by_seed.last()
        update = (ends["seconds"] - by_seed["seconds"].first()) / ends["step"]
        lines.append(
            f"| {env} | {method} | {', '.join(map(str, scores.index))} "
            f"| {scores.median():.1f} | {mean:.1f} [{low:.1f}, {high:.1f}] "
            f"| {scores.std():.1f} | {ends['seconds'].mean() / 60:.1f} "
            f"| {1000 * update.median():.1f} |"
        )
    return "\n".join(lines)


def draw(runs: pd.DataFrame, path: Path) -> None:
    """Draw score over processor minutes: each seed, and the mean over seeds."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 3.9), layout="constrained")
    FigureCanvasAgg(figure)
    runs = runs.assign(minutes=runs["seconds"] / 60)
    for axes, env in zip(figure.subplots(1, len(ENVS)), ENVS, strict=True):
        for method, color in COLORS.items():
            rows = runs[(runs["env"] == env) & (runs["method"] == method)]
            for _, run in rows.groupby("seed"):
                axes.plot(run["minutes"], run["score"], color=color, lw=0.6, alpha=0.4)
            mean = rows.groupby("step")[["minutes", "score"]].mean()
            label = f"{method} ({rows['seed'].nunique()} seeds)"
            axes.plot(*mean.to_numpy().T, color=color, marker="o", ms=3, label=label)
        axes.set_title(f"{env} medium-replay", fontsize=10, loc="left")
        axes.spines[["top", "right"]].set_visible(False)
        axes.set_xlabel("minutes of one core")
        axes.legend(frameon=False, fontsize=8)
    figure.supylabel("normalised score", fontsize=10)
    figure.suptitle(
        "OSR with settings tuned for minutes; CQL, TD3+BC and IQL with published "
        "settings, made for a million updates",
        fontsize=10,
    )
    figure.savefig(path, dpi=130)


def main() -> None:
    """Run, or draw what is there."""
    if sys.argv[1:2] == ["--train"]:
        answer, *overrides = sys.argv[2:]
        Path(answer).write_text(json.dumps(train_here(overrides)))
        return
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--methods", nargs="+", default=list(METHODS), choices=METHODS)
    parser.add_argument("--envs", nargs="+", default=ENVS, choices=ENVS)
    parser.add_argument("--seeds", nargs="+", type=int, default=range(5))
    parser.add_argument("--draw", action="store_true", help="run nothing")
    options = parser.parse_args()
    if not options.draw:
        run_missing(options)
    print(table(finished()))
    draw(finished(), RESULTS / "curves.png")


if __name__ == "__main__":
    main()
