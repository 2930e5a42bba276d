"""What all disturbances promise: off is the bare environment, streams of their own."""

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
    ActionNoise,
    DynamicsChange,
    ExternalPush,
    ObservationNoise,
    StartStateNoise,
    StickyAction,
)

OFF = {
    "knock": lambda env: ActionKnock(env, 5, mode="torque", at=10**6),
    "push": lambda env: ExternalPush(env, 0.0, duration=5, at=3),
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
    "action noise": lambda env: ActionNoise(env, 0.1),
    "delay": lambda env: ActionDelay(env, 2),
    "sticky": lambda env: StickyAction(env, 0.5),
    "dynamics": lambda env: DynamicsChange(env, mass=1.3, friction=0.7, gravity=1.1),
    "start": lambda env: StartStateNoise(env, 0.02),
}
ALWAYS = {"sensors", "action noise", "delay", "dynamics"}

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
    before, state = np.random.get_state(), torch.get_rng_state()  # noqa: NPY002
    assert (trajectory(other, steps=100, seeds=seeds) == once).all()
    after = np.random.get_state()  # noqa: NPY002
    assert torch.equal(state, torch.get_rng_state())
    assert all(map(np.array_equal, before, after))
    assert not np.array_equal(trajectory(env, steps=100, seed=4), once)


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


MAZE = "PointMaze_UMaze-v3"


@pytest.mark.parametrize("mode", ["official", "paper", "torque"])
def test_knocks_fit_a_maze(mode):
    with closing(ActionKnock(make_environment(MAZE), 5, mode=mode, at=3)) as env:
        observation, _ = env.reset(seed=0)
        for _ in range(10):
            observation, *_, info = env.step(np.zeros(2, np.float32))
            assert observation.shape == (8,)
            # As the environment lies now, also right after the official knock.
            inside = env.unwrapped.point_env.data
            assert np.array_equal(observation[:2], inside.qpos)
            assert np.array_equal(observation[-2:], inside.qvel)
        assert info["knock_steps"] == 0


@pytest.mark.parametrize("env_id", [MAZE, "Pendulum-v1"])
@pytest.mark.parametrize("name", ["push", "dynamics", "start"])
def test_another_simulation_is_refused_by_name(env_id, name):
    with (
        closing(gymnasium.make(env_id)) as env,
        pytest.raises(TypeError, match="acts on the simulation .*'Hopper-v5'"),
    ):
        ON[name](env)


@pytest.mark.parametrize(
    "name", ["knock, official", "knock, paper", "action noise", "delay"]
)
def test_actions_must_be_a_box(name):
    with pytest.raises(TypeError, match="expected a Box"):
        ON[name](gymnasium.make("CartPole-v1"))


KNOCK = {"steps": 5, "mode": "official"}
PUSH = {"force": 1.0, "duration": 1}


@pytest.mark.parametrize(
    ("wrapper", "arguments", "message"),
    [
        (ActionKnock, KNOCK | {"mode": "hard"}, "mode must be one of .* got 'hard'"),
        (ActionKnock, KNOCK | {"steps": 0}, "steps must be .*, at least 1; got 0"),
        (ActionKnock, KNOCK | {"steps": 2.5}, "steps must be an integer.* got 2.5"),
        (ActionKnock, KNOCK | {"at": 0}, "at, unless 'random', must be .* 1; got 0"),
        (ActionKnock, KNOCK | {"at": "later"}, "at, unless 'random', .*got 'later'"),
        (ActionKnock, KNOCK | {"window": (9, 9)}, "end of window must .* 10; got 9"),
        (ActionKnock, KNOCK | {"window": (0, 9)}, "start of window must .* 1; got 0"),
        (ExternalPush, PUSH | {"force": -1.0}, "force must be a finite number"),
        (ExternalPush, PUSH | {"force": float("nan")}, "force must be"),
        (ExternalPush, PUSH | {"duration": 0}, "duration must be .* least 1; got 0"),
        (ExternalPush, PUSH | {"unit": "pounds"}, "unit must be .* got 'pounds'"),
        (ActionNoise, {"std": -0.1}, "std must be a finite number, at least 0"),
        (ActionDelay, {"steps": -1}, "steps must be an integer, at least 0; got -1"),
        (ActionDelay, {"steps": True}, "steps must be an integer"),
        (StickyAction, {"probability": 1.1}, r"probability must be in \[0, 1\]"),
        (StickyAction, {"probability": float("nan")}, "probability must be"),
        (ObservationNoise, {"std": float("inf")}, "std must be"),
        (ObservationNoise, {"std": 1, "unit": [1.0]}, r"shape \(1,\), .* have \(11,\)"),
        (ObservationNoise, {"std": 1, "unit": [-1.0] * 11}, "unit must be finite"),
        (StartStateNoise, {"std": -0.1}, "std must be a finite number, at least 0"),
        (DynamicsChange, {"mass": 0.0}, "mass must be above 0"),
        (DynamicsChange, {"friction": -1.0}, "friction must be a finite .* got -1.0"),
    ],
)
def test_wrong_arguments_are_named(wrapper, arguments, message):
    with pytest.raises(ValueError, match=message):
        wrapper(make_environment("Hopper-v5"), **arguments)


def test_strengths_in_units_of_the_action_need_bounds(recorder):
    for wrap in (ON["action noise"], ON["knock"]):
        with pytest.raises(ValueError, match="RescaleAction or ClipAction"):
            wrap(recorder(high=np.inf))
