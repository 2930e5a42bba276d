"""A rough description of the body, identified from the log: does it judge policies?

python grey.py ROBOT SEED OUT.json RUN...   # RUN: folders of trained runs
"""

import json
import sys
import time
from pathlib import Path

import gymnasium
import mujoco
import numpy as np
import torch
from mujoco import rollout

from torchrl_osr.lab.data import load_dataset
from torchrl_osr.lab.data.rows import episode_of
from torchrl_osr.lab.evaluation import fitted_task
from torchrl_osr.lab.evaluation.recoverable import load_recoverable_states
from torchrl_osr.policy import load_policy

torch.set_num_threads(1)
WINDOW, SKIP = 20, 4
ENV_IDS = {"walker2d": "Walker2d-v5", "hopper": "Hopper-v5"}


class Body:
    """A MuJoCo model with factors for masses, gears, damping and friction."""

    def __init__(self, env_id):
        self.env = gymnasium.make(env_id).unwrapped
        self.model, self.data = self.env.model, mujoco.MjData(self.env.model)
        m = self.model
        self.true = {
            n: getattr(m, n).copy()
            for n in (
                "body_mass",
                "body_inertia",
                "actuator_gear",
                "dof_damping",
                "geom_friction",
            )
        }
        self.bodies, self.size = range(1, m.nbody), (m.nbody - 1) + m.nu + 2

    def set(self, factors):
        m, t = self.model, self.true
        b, g, (d, f) = factors[: m.nbody - 1], factors[m.nbody - 1 : -2], factors[-2:]
        m.body_mass[1:] = t["body_mass"][1:] * b
        m.body_inertia[1:] = t["body_inertia"][1:] * b[:, None]
        m.actuator_gear[:, 0] = t["actuator_gear"][:, 0] * g
        m.dof_damping[:] = t["dof_damping"] * d
        m.geom_friction[:, 0] = t["geom_friction"][:, 0] * f
        mujoco.mj_setConst(m, self.data)

    def full(self, obs):
        """States for rollouts from observations: time, qpos, qvel."""
        n, nq, nv = len(obs), self.model.nq, self.model.nv
        state = np.zeros(
            (n, mujoco.mj_stateSize(self.model, mujoco.mjtState.mjSTATE_FULLPHYSICS))
        )
        state[:, 2 : 1 + nq] = obs[:, : nq - 1]
        state[:, 1 + nq : 1 + nq + nv] = obs[:, nq - 1 :]
        return state

    def obs(self, state):
        nq, nv = self.model.nq, self.model.nv
        return np.concatenate(
            [state[..., 2 : 1 + nq], state[..., 1 + nq : 1 + nq + nv].clip(-10, 10)], -1
        )

    def predict(self, obs, actions):
        """Observations ``[n, T, S]`` under logged actions ``[n, T, A]``."""
        control = np.repeat(actions, SKIP, 1).astype(np.float64)
        states, _ = rollout.rollout(self.model, self.data, self.full(obs), control)
        return self.obs(states[:, SKIP - 1 :: SKIP])

    def healthy(self, obs):
        z, angle = obs[..., 0], obs[..., 1]
        if "Hopper" in type(self.env).__name__:
            return (z > 0.7) & (np.abs(angle) < 0.2)
        return (z > 0.8) & (z < 2) & (np.abs(angle) < 1)

    def survival(self, qpos, qvel, policy, steps):
        """Steps until a fall, of one policy from each state."""
        obs = np.concatenate([qpos[:, 1:], qvel.clip(-10, 10)], 1)
        state = self.full(obs)
        state[:, 1 + self.model.nq : 1 + self.model.nq + self.model.nv] = qvel
        lived, going = np.zeros(len(obs), int), np.ones(len(obs), bool)
        for _ in range(steps):
            index = np.flatnonzero(going)
            action = policy(obs[index])[:, None]
            states, _ = rollout.rollout(
                self.model,
                self.data,
                state[index],
                np.repeat(action, SKIP, 1).astype(np.float64),
            )
            state[index], obs[index] = states[:, -1], self.obs(states[:, -1])
            lived[index] += 1
            going[index] = self.healthy(obs[index])
            if not going.any():
                break
        return lived


def windows(data, number, seed):
    """Windows inside episodes, without clipped velocities."""
    rng = np.random.default_rng(seed)
    ep = episode_of(data).numpy()
    start = rng.permutation(len(data) - WINDOW)
    start = start[ep[start] == ep[start + WINDOW - 1]]
    rows = start[:, None] + np.arange(WINDOW)
    s, a, n = (
        data[k].numpy() for k in ("observation", "action", ("next", "observation"))
    )
    good = (np.abs(s[rows[: 4 * number]]).max((1, 2)) < 9.99) & (
        np.abs(n[rows[: 4 * number]]).max((1, 2)) < 9.99
    )
    rows = rows[: 4 * number][good][:number]
    return s[rows[:, 0]].astype(np.float64), a[rows], n[rows].astype(np.float64)


def error(found, wanted, scale):
    """Median over windows of the error of each step, in standard deviations."""
    return np.median(np.sqrt((((found - wanted) / scale) ** 2).mean(-1)), 0)


def identify(body, data, scale, rng, iterations=25, population=48, steps=10):
    """Cross-entropy search for the factors; nominal: all 1."""
    s, a, n = windows(data, 120, 1)
    mean, std = np.zeros(body.size), np.full(body.size, 0.25)
    for _ in range(iterations):
        tried = mean + std * rng.standard_normal((population, body.size))
        tried[0] = mean
        cost = []
        for each in tried:
            body.set(body.guess * np.exp(each))
            e = np.abs((body.predict(s, a[:, :steps]) - n[:, :steps]) / scale)
            cost.append(np.minimum(e, 1).mean())
        best = tried[np.argsort(cost)[: population // 6]]
        mean, std = (
            0.2 * mean + 0.8 * best.mean(0),
            0.3 * std + 0.7 * best.std(0) + 1e-3,
        )
    return body.guess * np.exp(mean), min(cost)


def auc(score, truth):
    """Area under the curve: survivors above fallers; ties count half."""
    a, b = score[truth], score[~truth]
    return (
        float(((a[:, None] > b[None]) + 0.5 * (a[:, None] == b[None])).mean())
        if len(a) and len(b)
        else None
    )


if __name__ == "__main__":
    robot, seed, out, *runs = (
        sys.argv[1],
        int(sys.argv[2]),
        sys.argv[3],
        *map(Path, sys.argv[4:]),
    )
    rng = np.random.default_rng(seed)
    body = Body(ENV_IDS[robot])
    data, _ = load_dataset(robot, "medium-replay", num_transitions=200_000)
    scale = data["observation"].numpy().std(0)
    s, a, n = windows(data, 400, 2)
    wrong = 1 + 0.3 * rng.uniform(-1, 1, body.size)
    results, factors = {}, {"true": np.ones(body.size), "wrong by 30 %": wrong}
    body.guess, t = (
        wrong,
        time.time(),
    )  # the user's description; the log is the true robot's
    factors["identified"], cost = identify(body, data, scale, rng)
    print(
        "identified",
        round(time.time() - t),
        "s, cost",
        cost,
        "largest error of a factor",
        np.abs(factors["identified"] - 1).max().round(3),
        "mean",
        np.abs(factors["identified"] - 1).mean().round(3),
        "was",
        np.abs(wrong - 1).mean().round(3),
        flush=True,
    )
    for name, each in factors.items():
        body.set(each)
        results[name] = {"error": error(body.predict(s, a), n, scale).tolist()}
    task = fitted_task(data, progress=False)
    model, state = task.dynamics, torch.from_numpy(s).float().expand(5, -1, -1)
    track = []
    for k in range(WINDOW):
        with torch.no_grad():
            act = torch.from_numpy(a[:, k]).expand(5, -1, -1)
            mean, _ = model.standardized(torch.cat([state, act], -1))
        state = state + (mean * model.target_scale + model.target_loc)[..., :-1]
        track.append(state.mean(0).numpy())
    results["ensemble"] = {"error": error(np.stack(track, 1), n, scale).tolist()}
    for name, each in results.items():
        print(name, [round(each["error"][k], 4) for k in (0, 4, 9, 19)], flush=True)

    states = load_recoverable_states(robot, "public")
    hard = states.group == "recoverable"
    qpos, qvel, walk = states.qpos[hard], states.qvel[hard], states.walk[hard]
    policies = [load_policy(run) for run in runs]
    lived = {}
    for name, each in factors.items():
        body.set(each)
        lived[name] = np.stack(
            [
                body.survival(
                    qpos,
                    qvel,
                    lambda o, p=p: p.act(torch.from_numpy(o).float()).numpy(),
                    300,
                )
                for p in policies
            ],
            1,
        )
    ended = lambda o: ~torch.from_numpy(body.healthy(o.numpy()))  # noqa: E731
    found = []
    for p in policies:
        obs = torch.from_numpy(
            np.concatenate([qpos[:, 1:], qvel.clip(-10, 10)], 1)
        ).float()
        state, going = obs.expand(5, -1, -1), torch.ones(5, len(obs))
        steps = torch.zeros(5, len(obs))
        for _ in range(100):
            with torch.no_grad():
                act = p.act(state.flatten(0, 1)).view(5, len(obs), -1)
                mean, _ = model.standardized(torch.cat([state, act], -1))
            state = (
                state + (mean * model.target_scale + model.target_loc)[..., :-1]
            ).nan_to_num(0)
            steps += going
            going = going * ~ended(state)
        found.append(steps.mean(0).numpy())
    lived["ensemble"] = np.stack(found, 1)
    truth = lived["true"] == 300
    print(
        "each policy %",
        (100 * truth.mean(0)).round(1),
        "any",
        round(100 * truth.any(1).mean(), 1),
        "best",
        round(100 * truth.mean(0).max(), 1),
    )
    order = np.argsort(-truth.mean(0))
    for name, steps in lived.items():
        # ties go to the policy that survives most often
        choice = order[np.argmax(steps[:, order], 1)]
        saved = truth[np.arange(len(truth)), choice]
        draw = np.random.default_rng(0)
        names = np.unique(walk)
        boot = [
            np.concatenate(
                [saved[walk == w] for w in draw.choice(names, len(names))]
            ).mean()
            for _ in range(1000)
        ]
        results[name] = results.get(name, {}) | {
            "auc": auc(steps.ravel(), truth.ravel()),
            "saved": float(saved.mean()),
            "low": float(np.quantile(boot, 0.025)),
            "high": float(np.quantile(boot, 0.975)),
        }
        low, high = results[name]["low"], results[name]["high"]
        print(f"{name}: AUC {results[name]['auc']:.2f}, the choice saves", end=" ")
        print(f"{saved.mean():.3f} [{low:.2f}, {high:.2f}]", flush=True)
    Path(out).write_text(
        json.dumps(
            results
            | {
                "policies": truth.mean(0).tolist(),
                "any": float(truth.any(1).mean()),
                "states": len(truth),
                "factors": {k: v.tolist() for k, v in factors.items()},
            },
            indent=1,
        )
    )
