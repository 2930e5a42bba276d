"""What all disturbances promise: off is the bare environment, streams of their own."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
import torch
from torchrl.envs import GymWrapper
from torchrl.envs.utils import check_env_specs

from torchrl_osr.data import make_environment
from torchrl_osr.envs import (
    ActionDelay,
    ActionKnock,
    ActionNoise,
    DynamicsChange,
    ExternalPush,
    ObservationNoise,
    StartStateNoise,
    StickyAction,
)

OFF = {
    "knock": lambda env: ActionKnock(env, 5, mode="torque", at=10**6),
    "knock, official": lambda env: ActionKnock(env, 5, mode="official", at=10**6),
    "push": lambda env: ExternalPush(env, 0.0, duration=5, at=3),
    "push, random": lambda env: ExternalPush(env, 0.0, duration=5, window=(0, 9)),
    "sensors": lambda env: ObservationNoise(env, 0.0),
    "action noise": lambda env: ActionNoise(env, 0.0),
    "delay": lambda env: ActionDelay(env, 0),
    "sticky": lambda env: StickyAction(env, 0.0),
    "dynamics": lambda env: DynamicsChange(env, mass=1.0, friction=1.0, gravity=1.0),
    "start": lambda env: StartStateNoise(env, 0.0),
}
ON = {
    "knock": lambda env: ActionKnock(env, 5, mode="torque", at="random", window=(2, 9)),
    "knock, paper": lambda env: ActionKnock(env, 5, mode="paper", at=3),
    "knock, official": lambda env: ActionKnock(env, 5, mode="official", at=3),
    "push": lambda env: ExternalPush(env, 30.0, duration=5, window=(2, 9)),
    "sensors": lambda env: ObservationNoise(env, 0.1),
    "sensors, uniform": lambda env: ObservationNoise(env, 0.1, kind="uniform"),
    "action noise": lambda env: ActionNoise(env, 0.1),
    "delay": lambda env: ActionDelay(env, 2),
    "sticky": lambda env: StickyAction(env, 0.5),
    "dynamics": lambda env: DynamicsChange(env, mass=1.3, friction=0.7, gravity=1.1),
    "start": lambda env: StartStateNoise(env, 0.02),
}
ALWAYS = {"sensors", "sensors, uniform", "action noise", "delay", "dynamics"}

each_off = pytest.mark.parametrize("wrap", OFF.values(), ids=OFF.keys())
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
    return {
        name: trajectory(make_environment(name), steps=400)
        for name in ("Hopper-v5", "HalfCheetah-v5")
    }


@each_off
@pytest.mark.parametrize("name", ["Hopper-v5", "HalfCheetah-v5"])
def test_off_is_the_bare_environment_to_the_last_bit(wrap, name, bare):
    env = wrap(make_environment(name))
    assert (trajectory(env, steps=400) == bare[name]).all()
    _, info = env.reset(seed=0)
    assert not info["disturbed"]
    assert not env.step(env.action_space.low)[-1]["disturbed"]


def test_all_off_at_once_is_the_bare_environment(bare):
    env = make_environment("Hopper-v5")
    for wrap in OFF.values():
        env = wrap(env)
    assert (trajectory(env, steps=400) == bare["Hopper-v5"]).all()


@each_on
def test_on_is_another_trajectory_and_the_same_for_the_same_seeds(wrap, bare):
    env = wrap(make_environment("Hopper-v5"))
    seeds = range(10, 50)
    once = trajectory(env, steps=100, seeds=seeds)
    assert not np.array_equal(once, bare["Hopper-v5"][: len(once)])
    # A fresh one, with another past, and with the globals seeded otherwise.
    other = wrap(make_environment("Hopper-v5"))
    trajectory(other, steps=30, seed=8)
    np.random.seed(1)  # noqa: NPY002
    torch.manual_seed(1)
    assert (trajectory(other, steps=100, seeds=seeds) == once).all()
    assert not np.array_equal(trajectory(env, steps=100, seed=4), once)


@each_on
def test_global_generators_are_left_alone(wrap):
    before, state = np.random.get_state(), torch.get_rng_state()  # noqa: NPY002
    trajectory(wrap(make_environment("Hopper-v5")), steps=20)
    assert torch.equal(state, torch.get_rng_state())
    after = np.random.get_state()  # noqa: NPY002
    assert all(map(np.array_equal, before, after))


@each_on
def test_the_environments_own_random_stream_is_that_of_the_bare_one(wrap):
    env, other = wrap(make_environment("Hopper-v5")), make_environment("Hopper-v5")
    for seed in (5, None, None):
        env.reset(seed=seed)
        other.reset(seed=seed)
        for _ in range(12):
            env.step(env.action_space.high)
        states = [each.np_random.bit_generator.state for each in (env, other)]
        assert states[0] == states[1]


@each_on
def test_a_reset_without_a_seed_continues_the_disturbances_generator(wrap):
    env = wrap(make_environment("Hopper-v5"))
    env.reset(seed=5)
    generator, state = env._generator, env._generator.bit_generator.state
    env.reset()
    assert env._generator is generator
    env.reset(seed=5)
    assert env._generator.bit_generator.state == state


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
    elif name == "sticky":
        assert 0 < sum(flags) < 20
    else:
        assert sum(flags) == (1 if "official" in name else 5)


def test_flags_of_nested_disturbances_are_joined(play, recorder):
    knock = ActionKnock(recorder(), 2, mode="paper", at=1)
    env = ActionKnock(knock, 1, mode="paper", at=4)
    flags = [step[-1]["disturbed"] for step in play(env, 6)]
    assert flags == [False, True, True, False, True, False]


def test_two_of_a_kind_draw_differently(recorder):
    env = ObservationNoise(ObservationNoise(recorder(sensors=3), 1.0), 1.0)
    env.reset(seed=0)
    assert env._generator.random() != env.env._generator.random()


@each_on
def test_they_are_torchrl_environments(wrap):
    env = GymWrapper(wrap(make_environment("HalfCheetah-v5")))
    check_env_specs(env)
    env.set_seed(0)
    rollout = env.rollout(10)
    assert rollout["observation"].shape == (10, 17)
    env.close()


def test_torchrl_reads_the_flags():
    knock = ActionKnock(make_environment("HalfCheetah-v5"), 3, mode="official", at=4)
    env = GymWrapper(knock).auto_register_info_dict()
    env.set_seed(0)
    rollout = env.rollout(6)
    assert rollout["next", "disturbed"].flatten().tolist() == [0, 0, 0, 1, 0, 0]
    assert rollout["next", "knock_steps"].flatten().tolist() == [0, 0, 0, 3, 0, 0]


def test_no_mujoco_model_is_an_error():
    env = gymnasium.make("Pendulum-v1")
    for wrap in (
        lambda: ExternalPush(env, 1.0, duration=1),
        lambda: DynamicsChange(env, mass=2.0),
        lambda: StartStateNoise(env, 0.1),
    ):
        with pytest.raises(TypeError, match="MuJoCo simulation, but .*Pendulum"):
            wrap()


def test_actions_must_be_a_box():
    env = gymnasium.make("CartPole-v1")
    for wrap in (
        lambda: ActionKnock(env, 5, mode="paper"),
        lambda: ActionNoise(env, 0.1),
        lambda: ActionDelay(env, 1),
    ):
        with pytest.raises(TypeError, match="expected a Box"):
            wrap()
