"""Compare estimates from data alone with the scores of 20 fresh episodes.

python results/offline_evaluation/run.py table.csv CHECKPOINT...
"""

import sys
from contextlib import closing
from pathlib import Path

import numpy as np
import pandas as pd

from torchrl_osr.lab.data import reference_returns
from torchrl_osr.lab.evaluation import (
    EpisodeEvaluator,
    deterministic_policy,
    summarize,
)
from torchrl_osr.lab.run.evaluate_offline import STEPS, OfflineEvaluator
from torchrl_osr.lab.run.load import load_trained, run_folder_of

path, *checkpoints = map(Path, sys.argv[1:])
evaluators = {each: OfflineEvaluator(each) for each in STEPS}
rows = []
for each in checkpoints:
    trained, run = load_trained(each), run_folder_of(each).absolute()
    found = {name: evaluate(each) for name, evaluate in evaluators.items()}
    env = trained.config.env
    policy = deterministic_policy(trained.actor, trained.observation_norm)
    with closing(EpisodeEvaluator(env.id, num_episodes=20, seed=50_000)) as episodes:
        played = summarize(episodes(policy), reference_returns(env.name))
    row = {
        "data": f"{env.name}-{trained.config.data.source}",
        "run": "/".join(run.parts[-2:]),
        "step": trained.step,
        "score": played["score"],
        "data_value": found["fqe"]["data_value"],
    }
    rows.append(row | {name: each["value"] for name, each in found.items()})
    pd.DataFrame(rows).round(2).to_csv(path, index=False)


def spearman(table: pd.DataFrame, name: str) -> float:
    """Return the rank correlation of an estimate with the score."""
    return float(table[name].rank().corr(table["score"].rank()))


groups = [table for _, table in pd.read_csv(path).groupby("data")]
for table in groups:
    score = table["score"]
    usual = score.max() - score.mean()
    print(
        f"{table['data'].iloc[0]}: {len(table)} policies, regret of chance {usual:.0f}"
    )
    print(f"  scores {score.min():.0f} to {score.max():.0f}")
    for name in evaluators:
        regret = score.max() - score[table[name].idxmax()]
        print(f"  {name}: Spearman {spearman(table, name):.2f}, regret {regret:.0f}")
for name in evaluators:
    draws = [
        np.mean(
            [
                spearman(g.sample(frac=1, replace=True, random_state=seed), name)
                for g in groups
            ]
        )
        for seed in range(500)
    ]
    low, high = np.quantile(draws, [0.025, 0.975])
    mean = np.mean([spearman(table, name) for table in groups])
    print(f"{name}: mean Spearman {mean:.2f} [{low:.2f}, {high:.2f}]")
