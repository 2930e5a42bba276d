"""Play policies undisturbed and disturbed, and compare scores for the monitor.

    python results/monitor/measure.py outputs/monitor RUN...

Plays are kept in the first folder. Writes ``summary.csv`` and ``curve.csv`` beside this
file. HalfCheetah cannot fall: its falls are to lie on the back.
"""

import itertools
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from tensordict import TensorDict
from torch import nn

from torchrl_osr.lab import envs
from torchrl_osr.lab.evaluation import EpisodeEvaluator
from torchrl_osr.lab.run.config import read_run
from torchrl_osr.lab.run.data import load_data
from torchrl_osr.lab.run.load import load_run_policy, load_trained
from torchrl_osr.lab.run.monitor import rows_of
from torchrl_osr.policy import fit_monitor
from torchrl_osr.policy.monitor import conformal_threshold

RATE, FALL_STEPS, UNDISTURBED, DISTURBED = 0.05, 100, 60, 16
AT = {"at": (50, 250)}


def play(policy, file):
    """Play fresh seeds; keep observations, and when disturbances and falls are."""
    push, knock = envs.ExternalPush, partial(envs.ActionKnock, **AT)
    noise = partial(envs.ObservationNoise, unit=policy.scale.numpy())
    wraps = {"clean": None, "mass-1.5": partial(envs.DynamicsChange, mass=1.5)}
    wraps |= {f"push-{n}": partial(push, force=n, duration=5, **AT) for n in (1, 2, 3)}
    wraps |= {f"torque-{n}": partial(knock, steps=n, mode="torque") for n in (10, 20)}
    wraps |= {"limp-15": partial(knock, steps=15, mode="official")}
    wraps |= {f"noise-{std}": partial(noise, std=std) for std in (0.1, 0.2)}
    kept = {}
    for name, wrap in wraps.items():
        number, seed = (DISTURBED, 710_000) if wrap else (UNDISTURBED, 700_000)
        rows = [[] for _ in range(number)]

        def watch(episode, state, fell, info, rows=rows):
            row = state.astype(np.float32), info.get("disturbed", False), fell
            rows[episode].append(row)

        env_id = policy.record["source"]["env_id"]
        EpisodeEvaluator(env_id, num_episodes=number, seed=seed, wrap=wrap)(
            policy.act, watch
        )
        kept[f"{name}.len"] = [len(each) for each in rows]
        columns = zip(*itertools.chain(*rows), strict=True)
        keys = (f"{name}.{key}" for key in ("obs", "dist", "fell"))
        kept |= zip(keys, columns, strict=True)
    np.savez_compressed(file, **{key: np.array(each) for key, each in kept.items()})


def episodes(file):
    """Return disturbance, states, and steps of disturbance and fall of each episode."""
    plays = np.load(file)
    for name in (each[:-4] for each in plays.files if each.endswith(".len")):
        lengths = plays[f"{name}.len"]
        parts = [np.split(plays[f"{name}.{key}"], lengths.cumsum()[:-1])
                 for key in ("obs", "dist", "fell")]  # fmt: skip
        for states, disturbed, fell in zip(*parts, strict=True):
            if "halfcheetah" in file.name:
                fell = np.abs(states[:, 1]) > 1.5
            fall = int(fell.argmax()) if fell.any() else None
            yield name, torch.from_numpy(states), int(disturbed.argmax()), fall


@torch.enable_grad()
def distillation(rows):
    """Train a network to match a random one; return their squared distance."""
    torch.manual_seed(0)
    target, learner = (
        nn.Sequential(nn.Linear(rows.shape[1], 64), nn.ReLU(), nn.Linear(64, 32))
        for _ in range(2)
    )
    optimizer = torch.optim.Adam(learner.parameters(), 1e-3)
    for _ in range(2000):
        batch = rows[torch.randint(len(rows), (256,))]
        optimizer.zero_grad()
        (learner(batch) - target(batch).detach()).square().mean().backward()
        optimizer.step()
    return lambda state: (learner(state) - target(state)).square().mean(-1)


def candidates(run, policy, states, episode, counts, seen):
    """Return scores of state, action and next state, by name."""
    monitor, every = fit_monitor(states, episode, counts), fit_monitor(states, episode)
    standard = lambda rows: (rows - policy.loc) / policy.scale  # noqa: E731
    random = distillation(standard(states[seen & counts]))
    found = {
        "distance": lambda s, *_: monitor(s)[0],
        "distance, falls kept": lambda s, *_: every(s)[0],
        "random network": lambda s, *_: random(standard(s)),
    }
    if policy.critics:
        found["critics' disagreement"] = lambda s, *_: torch.stack(
            [critic(standard(s), policy(s)) for critic in policy.critics]
        ).std(0)[:, 0]
    if (model := load_trained(run).inverse_dynamics) is not None:

        def surprise(state, action, after):
            rows = TensorDict({"s_tilde": standard(state)}, len(state))
            rows["observation"] = rows["s_tilde"]
            rows["next", "observation"] = standard(after)
            value = -model.get_dist(rows).log_prob(action.clamp(-0.999, 0.999))
            return torch.cat([torch.full([1], -torch.inf), value[:-1]])  # known later

        found["inverse dynamics"] = surprise
    return found


def steps_ahead(falls, limit):
    """Return steps from the first alarm since the disturbance to the fall; 0: none."""
    alarms = [score[begin:fall] > limit for score, begin, fall in falls]
    return np.array([len(a) - int(a.argmax()) if a.any() else 0 for a in alarms])


def judge(run, file):
    """Return a run's rows of the summary and of the curve."""
    policy, config = load_run_policy(run), read_run(run)
    config.data.checksum = None  # other versions of MuJoCo collect other data
    data, _ = load_data(config.env, config.data, progress=False)
    episode, counts = rows_of(data, FALL_STEPS)
    numbers = episode.unique()  # the halves of fit_monitor
    order = torch.randperm(len(numbers), generator=torch.Generator().manual_seed(0))
    held_out = order[len(order) // 2 :]
    seen = ~torch.isin(episode, held_out)
    scores = candidates(run, policy, data["observation"], episode, counts, seen)
    for name, score in scores.items():
        log, quiet, falls = [], [], []
        for number in held_out:
            part = data[rows := (episode == number).nonzero()[:, 0]]
            found = score(
                part["observation"], part["action"], part["next"]["observation"]
            )
            log.append(max(found[counts[rows]].tolist(), default=-np.inf))
        for disturbance, states, begin, fall in episodes(file):
            after = torch.cat([states[1:], states[-1:]])
            found = score(states, policy(states), after).nan_to_num(torch.inf).numpy()
            if disturbance == "clean":
                end = len(found) if fall is None else max(fall - FALL_STEPS + 1, 0)
                quiet.append(max(found[:end], default=-np.inf))
            elif fall is not None and fall > begin:
                falls.append((found, begin, fall))
        about = {"run": file.stem, "score": name, "falls": len(falls)}
        about["possible_20"] = np.mean([fall - begin >= 20 for _, begin, fall in falls])
        log, quiet = np.array(log), np.array(quiet)
        half, again = len(quiet) // 2, []
        for seed in range(200):  # does the promise hold for the log itself?
            other = np.random.default_rng(seed).permutation(log)
            limit = conformal_threshold(torch.tensor(other[::2]), RATE)
            again.append(np.mean(other[1::2] > limit))
        for source, those in (("log", log), ("policy", quiet[:half])):
            limit = conformal_threshold(torch.tensor(those), RATE)
            ahead, false = steps_ahead(falls, limit), np.mean(quiet[half:] > limit)
            row = about | {"calibrated": source, "false": false, "log": np.mean(again)}
            row |= {f"ahead_{n}": np.mean(ahead >= n) for n in (1, 20)}
            row |= {f"q{q}": np.percentile(ahead, q) for q in (25, 50, 75)}
            yield "summary", row
        for share in np.arange(0, 1.01, 0.05).round(2):
            limit = np.quantile(quiet, 1 - share, method="higher")
            ahead = steps_ahead(falls, limit)
            row = about | {"false": share}
            yield (
                "curve",
                row | {f"ahead_{n}": np.mean(ahead >= n) for n in (1, 10, 20, 50)},
            )


if __name__ == "__main__":
    torch.set_num_threads(1)
    folder, *runs = map(Path, sys.argv[1:])
    folder.mkdir(parents=True, exist_ok=True)
    tables = {"summary": [], "curve": []}
    with torch.no_grad():
        for run in runs:
            file = folder / f"{'.'.join(run.parts[-3:])}.npz"
            if not file.exists():
                play(load_run_policy(run), file)
            for table, row in judge(run, file):
                tables[table].append(row)
            for table, rows in tables.items():
                path = Path(__file__).with_name(f"{table}.csv")
                pd.DataFrame(rows).round(3).to_csv(path, index=False)
            print(file.stem, flush=True)
