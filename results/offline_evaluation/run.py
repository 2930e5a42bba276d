"""Compare fitted Q evaluation with the scores that training measured.

python results/offline_evaluation/run.py table.csv CHECKPOINT...
"""

import sys
from pathlib import Path

import pandas as pd

from torchrl_osr._files import read_json
from torchrl_osr.lab.run.evaluate_offline import evaluate_offline
from torchrl_osr.lab.run.load import run_folder_of

path, *checkpoints = map(Path, sys.argv[1:])
rows = []
for each in checkpoints:
    found, run = evaluate_offline(each, steps=4000), run_folder_of(each).absolute()
    played = read_json(run / "returns.json")["evaluations"]
    score = next(row["score"] for row in played if row["step"] == found["step"])
    data, name = f"{found['env']}-{found['source']}", "/".join(run.parts[-4:])
    values = found["value"], found["data_value"]
    rows.append((data, name, found["step"], score, *values))
if rows:
    columns = ["data", "run", "step", "score", "value", "data_value"]
    pd.DataFrame(rows, columns=columns).to_csv(path, index=False)
for data, table in pd.read_csv(path).groupby("data"):
    value, score = table["value"], table["score"]
    regret, usual = score.max() - score[value.idxmax()], score.max() - score.mean()
    print(f"{data}: {len(table)} policies, {score.min():.0f} to {score.max():.0f},")
    print(f"  Spearman {value.rank().corr(score.rank()):.2f}, regret {regret:.1f},")
    print(f"  regret of a random choice {usual:.1f}")
