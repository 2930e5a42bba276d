"""Common properties: off is the bare environment, random streams, flags, suites."""

from __future__ import annotations

from contextlib import closing

import gymnasium
import numpy as np
import pytest
import torch
from torchrl.envs import GymWrapper
from torchrl.envs.utils import check_env_specs

from torchrl_osr.lab.data import make_environment
from torchrl_osr.lab.envs import (
    ActionDelay,
    ActionKnock,
    DynamicsChange,
    ExternalPush,
    NotPossible,
    ObservationNoise,
    StartStateNoise,
)

MAZE = "PointMaze_UMaze-v3"

OFF = {
    "knock": lambda env: ActionKnock(env, 5, mode="torque", at=10**6),
    "push": lambda env: ExternalPush(env, 0.0, duration=5, at=3),
    "sensors": lambda env: ObservationNoise(env, 0.0),
    "delay": lambda env: ActionDelay(env, 0),
    "dynamics": lambda env: DynamicsChange(env, mass=1.0, friction=1.0, gravity=1.0),
    "start": lambda env: StartStateNoise(env, 0.0),
}
ON = {
    "knock": lambda env: ActionKnock(env, 5, mode="torque", at=(2, 9)),
    "knock, paper": lambda env: ActionKnock(env, 5, mode="paper", at=3),
    "knock, official": lambda env: ActionKnock(env, 5, mode="official", at=3),
    "push": lambda env: ExternalPush(env, 0.2, duration=5, at=(2, 9)),
    "sensors": lambda env: ObservationNoise(env, 0.1),
    "delay": lambda env: ActionDelay(env, 2),
    "dynamics": lambda env: DynamicsChange(env, mass=1.3, friction=0.7, gravity=1.1),
    "start": lambda env: StartStateNoise(env, 0.02),
}
ALWAYS = {"sensors", "delay", "dynamics"}

each_on = pytest.mark.parametrize("wrap", ON.values(), ids=ON.keys())


def trajectory(env, *, steps, seed=3, seeds=()):
    """Return all that ``steps`` steps show, over as many episodes as they take.

    The first is seeded by ``seed``, the others by ``seeds`` and then not at all.
    Actions depend on the observations and on the step, and leave the box.
    """
    seeds, out = iter(seeds), []
    observation, _ = env.reset(seed=seed)
    size = env.action_space.shape[0]
    for step in range(steps):
        out.append(observation)
        action = (np.tanh(observation[:size] * 3) * 1.2 + np.sin(step)).astype("f4")
        observation, reward, terminated, truncated, info = env.step(action)
        out.append([reward, terminated, truncated, info["x_velocity"]])
        if terminated or truncated:
            observation, _ = env.reset(seed=next(seeds, None))
    return np.concatenate(out)


@pytest.fixture(scope="module")
def bare():
    return trajectory(make_environment("Hopper-v5"), steps=400)


@pytest.mark.parametrize("wrap", OFF.values(), ids=OFF.keys())
def test_off_is_the_bare_environment_bit_for_bit(wrap, bare):
    env = wrap(make_environment("Hopper-v5"))
    assert (trajectory(env, steps=400) == bare).all()
    _, info = env.reset(seed=0)
    assert not info["disturbed"]
    assert not env.step(env.action_space.low)[-1]["disturbed"]


@each_on
def test_same_seeds_give_the_same_trajectory(wrap, bare):
    env = wrap(make_environment("Hopper-v5"))
    seeds = range(10, 50)
    once = trajectory(env, steps=100, seeds=seeds)
    assert not np.array_equal(once, bare[: len(once)])
    # A fresh one, with another past, and with the globals seeded otherwise.
    other = wrap(make_environment("Hopper-v5"))
    trajectory(other, steps=30, seed=8)
    np.random.seed(1)  # noqa: NPY002
    torch.manual_seed(1)
    assert (trajectory(other, steps=100, seeds=seeds) == once).all()
    assert not np.array_equal(trajectory(env, steps=100, seed=4), once)


@each_on
def test_environment_draws_as_the_bare_one(wrap):
    env, other = wrap(make_environment("Hopper-v5")), make_environment("Hopper-v5")
    for seed in (5, None, None):
        env.reset(seed=seed)
        other.reset(seed=seed)
        for _ in range(12):
            env.step(env.action_space.high)
        states = [each.np_random.bit_generator.state for each in (env, other)]
        assert states[0] == states[1]


@pytest.mark.parametrize("name", ON)
def test_info_says_whether_the_disturbance_acted(name):
    env = ON[name](make_environment("HalfCheetah-v5"))
    _, info = env.reset(seed=0)
    flags = [info["disturbed"]]
    flags += [env.step(env.action_space.high)[-1]["disturbed"] for _ in range(20)]
    assert all(type(each) is np.bool_ for each in flags)
    if name in ALWAYS:
        # Delayed actions begin with the first action, the others with the state.
        assert all(flags)
    elif name == "start":
        assert flags == [True] + [False] * 20
    else:
        assert sum(flags) == (1 if "official" in name else 5)


def test_torchrl_reads_the_flags():
    knock = ActionKnock(make_environment("HalfCheetah-v5"), 3, mode="official", at=4)
    env = GymWrapper(knock).auto_register_info_dict()
    check_env_specs(env)
    env.set_seed(0)
    rollout = env.rollout(6)
    assert rollout["next", "disturbed"].flatten().tolist() == [0, 0, 0, 1, 0, 0]


def test_the_official_knock_fits_a_maze():
    env = ActionKnock(make_environment(MAZE), 5, mode="official", at=3)
    with closing(env):
        env.reset(seed=0)
        for _ in range(5):
            observation, *_ = env.step(np.zeros(2, np.float32))
            # As the environment lies now, also right after the knock.
            inside = env.unwrapped.point_env.data
            assert np.array_equal(observation[:2], inside.qpos)
            assert np.array_equal(observation[-2:], inside.qvel)


@pytest.mark.parametrize(
    ("env_id", "names"),
    [
        (MAZE, ["push", "dynamics", "start"]),
        ("CartPole-v1", ["knock, official", "knock, paper", "delay"]),
    ],
)
def test_what_the_environment_lacks_is_not_possible(env_id, names):
    with closing(gymnasium.make(env_id)) as env:
        for name in names:
            with pytest.raises(NotPossible, match=r"MuJoCo tasks|expected a Box"):
                ON[name](env)


def test_all_are_possible_in_any_mujoco_task():
    for wrap in ON.values():
        assert "disturbed" in wrap(make_environment("InvertedPendulum-v5")).reset()[1]


@pytest.mark.parametrize(
    ("wrapper", "options"),
    [
        (ActionKnock, {"steps": 5, "mode": "official", "at": 0}),
        (ExternalPush, {"force": 1.0, "duration": 1, "at": (9, 9)}),
        (ObservationNoise, {"std": -0.1}),
    ],
)
def test_values_that_would_silently_do_nothing_are_refused(wrapper, options):
    with pytest.raises(ValueError, match="must be"):
        wrapper(make_environment("Hopper-v5"), **options)
