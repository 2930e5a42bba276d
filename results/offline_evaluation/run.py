"""Compare estimates from data alone with the scores of 20 fresh episodes.

python results/offline_evaluation/run.py table.csv CHECKPOINT...
"""

import sys
from contextlib import closing
from pathlib import Path

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
for data, table in pd.read_csv(path).groupby("data"):
    score, usual = table["score"], table["score"].max() - table["score"].mean()
    print(f"{data}: {len(table)} policies, {score.min():.0f} to {score.max():.0f},")
    print(f"  regret of a random choice {usual:.1f}")
    for name in evaluators:
        rank, best = table[name].rank().corr(score.rank()), table[name].idxmax()
        print(f"  {name}: Spearman {rank:.2f}, regret {score.max() - score[best]:.1f}")
