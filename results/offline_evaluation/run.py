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


def ranks(table: pd.DataFrame) -> pd.Series:
    """Return each estimate's rank correlation with the score."""
    return table[list(evaluators)].rank().corrwith(table["score"].rank())


groups = dict(list(pd.read_csv(path).groupby("data")))
for data, table in groups.items():
    score = table["score"]
    found = pd.DataFrame({"Spearman": ranks(table)})
    found["regret"] = [score.max() - score[table[each].idxmax()] for each in evaluators]
    found.loc["chance", "regret"] = score.max() - score.mean()
    print(f"{data}: {len(table)} policies, {score.min():.0f} to {score.max():.0f}")
    print(found.round(2))
tables = list(groups.values())
draws = [
    sum(ranks(each.sample(frac=1, replace=True, random_state=n)) for each in tables)
    for n in range(500)
]
print((pd.DataFrame(draws) / len(groups)).quantile([0.025, 0.5, 0.975]).round(2))
