"""Compare estimates of policies with 20 fresh episodes.

python results/offline_evaluation/run.py table.csv walker.xml 4 CHECKPOINT...
"""

import sys
from contextlib import closing
from pathlib import Path

import pandas as pd
from gymnasium.wrappers import TransformReward

from torchrl_osr.lab.data import reference_returns
from torchrl_osr.lab.evaluation import EpisodeEvaluator, deterministic_policy
from torchrl_osr.lab.run.evaluate_offline import OfflineEvaluator
from torchrl_osr.lab.run.load import load_trained, run_folder_of


def discounted(env):
    """Discount rewards from the first step of an episode on."""
    get, step = env.get_wrapper_attr, "_elapsed_steps"
    return TransformReward(env, lambda reward: 0.99 ** (get(step) - 1) * reward)


def played(trained, wrap=None):
    """Return the mean return of 20 episodes."""
    policy = deterministic_policy(trained.actor, trained.observation_norm)
    options = {"num_episodes": 20, "seed": 50_000, "wrap": wrap}
    with closing(EpisodeEvaluator(trained.config.env.id, **options)) as episodes:
        return episodes(policy).returns.mean()


def ranks(table):
    """Return each estimate's rank correlation with the score."""
    return table[list(evaluators)].rank().corrwith(table["score"].rank())


path, xml, skip, *checkpoints = sys.argv[1:]
body = OfflineEvaluator(xml=xml, frame_skip=int(skip))
evaluators = {"fqe": OfflineEvaluator(), "body": body}
rows = []
for each in map(Path, checkpoints):
    trained, run = load_trained(each), run_folder_of(each).absolute()
    found = {name: evaluate(each) for name, evaluate in evaluators.items()}
    env = trained.config.env
    row = {
        "data": f"{env.name}-{trained.config.data.source}",
        "run": "/".join(run.parts[-2:]),
        "step": trained.step,
        "score": reference_returns(env.name).score(played(trained)),
        "discounted": played(trained, discounted),
    }
    rows.append(row | {name: each["value"] for name, each in found.items()})
    pd.DataFrame(rows).round(2).to_csv(path, index=False)
tables = dict(list(pd.read_csv(path).groupby("data")))
for data, table in tables.items():
    score, truth = table["score"], table["discounted"]
    found = pd.DataFrame({"Spearman": ranks(table)})
    found["regret"] = [score.max() - score[table[each].idxmax()] for each in evaluators]
    found.loc["chance", "regret"] = score.max() - score.mean()
    print(f"{data}: {len(table)} policies, {score.min():.0f} to {score.max():.0f},")
    print(f"discounted return {truth.mean():.0f} +- {truth.std():.0f}")
    print(found.round(2))
draws = [
    sum(ranks(t.sample(frac=1, replace=True, random_state=n)) for t in tables.values())
    for n in range(500)
]
print((pd.DataFrame(draws) / len(tables)).quantile([0.025, 0.5, 0.975]).round(2))
