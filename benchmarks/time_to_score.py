"""Score by processor time: the quick preset beside published settings, same data.

    python benchmarks/time_to_score.py                       what is missing of it
    python benchmarks/time_to_score.py --methods OSR CQL --envs hopper --seeds 0 1
    python benchmarks/time_to_score.py --draw                table and figure

Each run is ``torchrl-osr train`` in a process of its own, with one torch thread. Time
is that of the processor from when the data are there, without the evaluations'. A run
adds one line to ``results/time_to_score/runs.jsonl``; those that are there are not done
again. Published settings are CORL's for ``medium-replay`` (tinkoff-ai/CORL,
``configs/offline``), and of IQL its authors' for MuJoCo, with the data and evaluations
of the quick runs and for about as much time.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

RESULTS = Path(__file__).parents[1] / "results" / "time_to_score"
ENVS = ("hopper", "walker2d", "halfcheetah")
SEEDS = (0, 1, 2, 3, 4)

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
"""Overrides of each method; the published ones have steps for about as much time."""

COLORS = dict(zip(METHODS, ("#0072B2", "#D55E00", "#009E73", "#E69F00"), strict=True))


def train_here(overrides: Sequence[str]) -> list[dict[str, float]]:
    """Train in this process; steps, processor seconds and scores of its evaluations."""
    from torchrl_osr.lab.cli import train
    from torchrl_osr.lab.evaluation import EpisodeEvaluator
    from torchrl_osr.lab.run import phases

    began, paused = 0.0, 0.0
    seconds: list[float] = []
    load = train.load_training_data

    def load_training_data(*arguments: Any) -> Any:
        nonlocal began
        data = load(*arguments)
        began = time.process_time()
        return data

    class Paused(EpisodeEvaluator):
        def __call__(self, *arguments: Any, **options: Any) -> Any:
            nonlocal paused
            before = time.process_time()
            seconds.append(before - began - paused)
            results = super().__call__(*arguments, **options)
            paused += time.process_time() - before
            return results

    train.load_training_data, phases.EpisodeEvaluator = load_training_data, Paused
    with tempfile.TemporaryDirectory() as folder:
        sys.argv = ["train", *overrides, f"hydra.run.dir={folder}/run"]
        train.main()
        record = json.loads((Path(folder) / "run" / "returns.json").read_text())
    rows = record["evaluations"]
    each = len(seconds) // len(rows)  # the average and the last weights are both played
    return [
        {key: row[key] for key in row if key == "step" or key.startswith("score")}
        | {"seconds": second}
        for row, second in zip(rows, seconds[::each], strict=True)
    ]


def finished() -> list[dict[str, Any]]:
    """The runs that are there."""
    path = RESULTS / "runs.jsonl"
    lines = path.read_text().splitlines() if path.exists() else []
    return [json.loads(line) for line in lines]


def run_missing(options: argparse.Namespace) -> None:
    """Do each run that is not there, in a process of its own."""
    done = {(run["method"], run["env"], run["seed"]) for run in finished()}
    wanted = [
        (method, env, seed)
        for seed in options.seeds
        for env in options.envs
        for method in options.methods
    ]
    for method, env, seed in wanted:
        if (method, env, seed) in done:
            continue
        overrides = [f"env={env}", f"seed={seed}", *METHODS[method]]
        overrides += ["trainer.progress=false"]
        with tempfile.NamedTemporaryFile("r") as answer:
            command = [sys.executable, __file__, "--train", answer.name, *overrides]
            environment = os.environ | {"OMP_NUM_THREADS": "1"}
            subprocess.run(command, check=True, env=environment, stdout=sys.stderr)
            run = {"method": method, "env": env, "seed": seed, "overrides": overrides}
            run |= {"load": os.getloadavg()[0], "evaluations": json.load(answer)}
        RESULTS.mkdir(exist_ok=True)
        with (RESULTS / "runs.jsonl").open("a") as file:
            file.write(json.dumps(run) + "\n")
        print(method, env, seed, f"{last_five(run):.1f}", flush=True)


def last_five(run: dict[str, Any]) -> float:
    """Mean score of the last five evaluations."""
    return statistics.fmean(row["score"] for row in run["evaluations"][-5:])


def table(runs: list[dict[str, Any]]) -> str:
    """Markdown: last five evaluations over seeds, and the minutes that they took."""
    from torchrl_osr.lab.evaluation import mean_interval

    rows = defaultdict(list)
    for run in runs:
        rows[run["env"], run["method"]].append(run)
    lines = [
        "| task | method | seeds | last five, median | mean [95 %] "
        "| standard deviation | processor minutes | ms an update |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for (env, method), group in sorted(rows.items(), key=lambda row: row[0][0]):
        scores = [last_five(run) for run in group]
        mean, low, high = mean_interval(scores)
        spread = f"{statistics.stdev(scores):.1f}" if len(scores) > 1 else ""
        ends = [run["evaluations"][-1] for run in group]
        minutes = statistics.fmean(end["seconds"] for end in ends) / 60
        starts = [run["evaluations"][0]["seconds"] for run in group]
        update = statistics.median(
            (end["seconds"] - start) / end["step"]
            for end, start in zip(ends, starts, strict=True)
        )
        seeds = ", ".join(str(run["seed"]) for run in group)
        lines.append(
            f"| {env} | {method} | {seeds} | {statistics.median(scores):.1f} "
            f"| {mean:.1f} [{low:.1f}, {high:.1f}] | {spread} | {minutes:.1f} "
            f"| {1000 * update:.1f} |"
        )
    return "\n".join(lines)


def draw(runs: list[dict[str, Any]], path: Path) -> None:
    """Draw score over processor minutes: each seed, and the mean over seeds."""
    import numpy as np
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 3.6), layout="constrained")
    FigureCanvasAgg(figure)
    for axes, env in zip(figure.subplots(1, len(ENVS)), ENVS, strict=True):
        for method, color in COLORS.items():
            group = [r for r in runs if (r["env"], r["method"]) == (env, method)]
            if not group:
                continue
            rows = np.array(
                [
                    [(row["seconds"] / 60, row["score"]) for row in run["evaluations"]]
                    for run in group
                ]
            )
            for run in rows:
                axes.plot(*run.T, color=color, linewidth=0.6, alpha=0.4)
            label = f"{method} ({len(group)} seeds)"
            axes.plot(*rows.mean(0).T, color=color, marker="o", ms=3, label=label)
        axes.set_title(f"{env} medium-replay", fontsize=10, loc="left")
        axes.spines[["top", "right"]].set_visible(False)
        axes.set_xlabel("minutes of one core")
        axes.legend(frameon=False, fontsize=8)
    figure.supylabel("normalised score", fontsize=10)
    figure.savefig(path, dpi=130)


def main() -> None:
    """Run, or draw what is there."""
    if sys.argv[1:2] == ["--train"]:
        answer, *overrides = sys.argv[2:]
        rows = train_here(overrides)
        Path(answer).write_text(json.dumps(rows))
        return
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--methods", nargs="+", default=list(METHODS), choices=METHODS)
    parser.add_argument("--envs", nargs="+", default=ENVS, choices=ENVS)
    parser.add_argument("--seeds", nargs="+", type=int, default=SEEDS)
    parser.add_argument("--draw", action="store_true", help="run nothing")
    options = parser.parse_args()
    if not options.draw:
        run_missing(options)
    print(table(finished()))
    draw(finished(), RESULTS / "curves.png")


if __name__ == "__main__":
    main()
