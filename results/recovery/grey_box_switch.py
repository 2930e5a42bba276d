"""Switch between policies by simulating each in the identified body.

python grey_box_switch.py ROBOT FILE RUN...   # FILE: of grey_box.py
"""

import json
import sys
from functools import partial
from pathlib import Path

import gymnasium
import numpy as np
import torch
from grey_box import ENV_IDS, SKIP, Body
from mujoco import rollout

from torchrl_osr.lab.data import reference_returns
from torchrl_osr.lab.evaluation.recoverable import load_recoverable_states
from torchrl_osr.policy import load_policy

HOLD, HORIZON = 10, 100


def act(policy, obs):
    """Return the actions of a policy."""
    return policy.act(torch.from_numpy(obs).float()).numpy()


def choose(judge, acts, qpos, qvel, present):
    """Return the policy that stands longest; among equals, the present one."""
    lived = [judge.survival(qpos, qvel, each, HORIZON) for each in acts]
    lived = np.stack(lived, 1).astype(float)
    if present is not None:
        lived[np.arange(len(lived)), present] += 0.5
    return lived.argmax(1)


def recovered(env_id, judge, acts, states):
    """Return the share of the states after which the policies stand 300 steps."""
    real, hard = Body(env_id), states.group == "recoverable"
    nq, nv = real.model.nq, real.model.nv
    obs = np.concatenate([states.qpos[hard][:, 1:], states.qvel[hard]], 1)
    state, chosen = real.full(obs), np.zeros(len(obs), int)
    going = np.ones(len(obs), bool)
    for step in range(300):
        index = np.flatnonzero(going)
        if step % HOLD == 0:
            now = state[index, 1 : 1 + nq], state[index, 1 + nq : 1 + nq + nv]
            chosen[index] = choose(judge, acts, *now, chosen[index] if step else None)
        obs, action = real.obs(state[index]), np.zeros((len(index), real.model.nu))
        for each in np.unique(chosen[index]):
            rows = chosen[index] == each
            action[rows] = acts[each](obs[rows])
        control = np.repeat(action[:, None], SKIP, 1)
        states, _ = rollout.rollout(real.model, real.data, state[index], control)
        state[index] = states[:, -1]
        going[index] = real.healthy(real.obs(state[index]))
    return going.mean()


def undisturbed(robot, env_id, judge, acts, episodes=10):
    """Return the score of undisturbed episodes."""
    returns = []
    for seed in range(80_000, 80_000 + episodes):
        env, total, chosen = gymnasium.make(env_id), 0.0, None
        obs, _ = env.reset(seed=seed)
        for step in range(1000):
            if step % HOLD == 0:
                data = env.unwrapped.data
                now = data.qpos[None].copy(), data.qvel[None].copy()
                chosen = choose(judge, acts, *now, chosen)
            action = acts[chosen[0]](obs[None])[0]
            obs, reward, terminated, truncated, _ = env.step(action)
            total += reward
            if terminated or truncated:
                break
        returns.append(total)
    return reference_returns(robot).score(returns).mean()


if __name__ == "__main__":
    robot, file, *runs = sys.argv[1:]
    found, judge = json.loads(Path(file).read_text()), Body(ENV_IDS[robot])
    judge.set(np.array(found["factors"]["identified"]))
    order = np.argsort(-np.array(found["policies"]))
    acts = [partial(act, load_policy(Path(runs[each]))) for each in order]
    states = load_recoverable_states(robot, "public")
    print(robot, "recovered", recovered(ENV_IDS[robot], judge, acts, states))
    print(robot, "undisturbed", undisturbed(robot, ENV_IDS[robot], judge, acts))
