"""One look at a half: look.py ROBOT HALF OUT.npz; everything for one robot."""

import sys
import time
from contextlib import closing
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import torch

torch.set_num_threads(1)
from torchrl_osr.lab.data import reference_returns
from torchrl_osr.lab.evaluation import EpisodeEvaluator
from torchrl_osr.lab.evaluation.recoverable import load_recoverable_states, recovers
from torchrl_osr.lab.run.load import load_switching_policy
from torchrl_osr.policy import load_policy

robot, half, out = sys.argv[1:4]
E, S, V = Path("outputs"), "outputs/six", "outputs/osr_v"
R = robot
NINE = [
    f"{S}/{R}-medium-expert/td3_bc/seed0",
    f"{S}/{R}-medium-expert/iql/seed0",
    *(f"{V}/{R}-medium-expert/osr_v/seed{n}" for n in range(3)),
    *(f"{S}/{R}-medium-replay/{m}/seed0" for m in ("osr", "cql", "td3_bc", "iql")),
]
done = lambda top: sorted(
    str(d) for d in (E / top).glob(f"{R}-?") if (d / "policy.safetensors").exists()
)
RIM, REF = done("rim"), done("ref")
states = load_recoverable_states(robot, half)


def group(name):
    rows = states.group == name
    return replace(
        states,
        **{
            f.name: getattr(states, f.name)[rows]
            for f in fields(states)
            if isinstance(getattr(states, f.name), np.ndarray)
        },
    )


env_id = {"walker2d": "Walker2d-v5", "hopper": "Hopper-v5"}[robot]


def score(policy, episodes=10):
    with closing(EpisodeEvaluator(env_id, num_episodes=episodes, seed=90_000)) as ev:
        return reference_returns(robot).score(ev(policy).returns).mean()


rows = {}
draw = np.random.default_rng(0)


def played(name, policy, reset=lambda: None, scored=True, controls=True):
    t, row = time.time(), {}
    for g in ("recoverable", "contested", "easy"):
        if g != "recoverable" and not (scored and controls):
            continue
        part = group(g)
        reset()
        row[g] = recovers(part, policy)
    reset()
    row["score"] = score(policy) if scored else np.nan
    rows[name] = row
    hard, walk = row["recoverable"], group("recoverable").walk
    names = np.unique(walk)
    boot = [
        np.concatenate([hard[walk == w] for w in draw.choice(names, len(names))]).mean()
        for _ in range(1000)
    ]
    print(
        robot,
        half,
        name,
        "%.1f [%.1f, %.1f]"
        % (100 * hard.mean(), *100 * np.quantile(boot, [0.025, 0.975])),
        {g: round(100 * row[g].mean(), 1) for g in row if g != "score"},
        "score %.1f" % row["score"],
        round(time.time() - t),
        "s",
        flush=True,
    )
    np.savez(
        out, **{f"{n}/{k}": v for n, r in rows.items() for k, v in r.items()}, walk=walk
    )


def one(path):
    p = load_policy(path)
    return lambda s: p.act(s)


for p in REF:
    played("reference " + p[-1], one(p))
for p in RIM:
    played("grey rim " + p[-1], one(p))
d = E / "distil" / robot / "round1"
if d.exists():
    played("distilled", one(d))
for p in NINE:
    played("/".join(p.split("/")[-3:]), one(p), scored=False)
sw = load_switching_policy([*RIM, *NINE], steps=40, hold=10)
played("choice", sw, sw.reset, controls=robot == "walker2d")
