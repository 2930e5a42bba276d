"""What each environment can be disturbed by: the suites on robots of all kinds."""

from __future__ import annotations

from contextlib import closing
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from omegaconf import OmegaConf

from torchrl_osr.lab.data import environment_spec, make_environment
from torchrl_osr.lab.envs import ActionKnock, ExternalPush
from torchrl_osr.lab.evaluation import impossible_disturbances
from torchrl_osr.lab.run.suite import SuiteConfig, make_disturbances

SUITES = Path(__file__).parents[3] / "conf" / "evaluation" / "suite"
ROBOTS = (
    *("InvertedPendulum-v5", "InvertedDoublePendulum-v5", "Swimmer-v5", "Ant-v5"),
    *("Pusher-v5", "Reacher-v5"),
)
NEEDS_MUJOCO = {"push-1.0", "push-2.0", "start-noise-0.2", "mass-1.5"}


def suite_of(name: str):
    loaded = OmegaConf.load(SUITES / f"{name}.yaml")
    return OmegaConf.merge(OmegaConf.structured(SuiteConfig), loaded).disturbances


def left_out(env_id: str, suite: str) -> dict[str, str]:
    configs = suite_of(suite)
    scale = np.ones(environment_spec(env_id).observation_size)
    made = make_disturbances(configs, SimpleNamespace(), scale)
    return impossible_disturbances(env_id, made)


@pytest.mark.parametrize("env_id", ROBOTS)
def test_the_default_suite_is_for_every_mujoco_robot(env_id):
    assert left_out(env_id, "oos") == {}
    with closing(make_environment(env_id)) as bare:
        bare.reset(seed=0)
        push = {"force": 1.0, "unit": "body_weight", "duration": 3, "at": 1}
        with closing(ExternalPush(make_environment(env_id), **push)) as env:
            env.reset(seed=0)
            still = np.zeros(env.action_space.shape, np.float32)
            for step in range(3):
                observation, *_, info = env.step(still)
                other, *_ = bare.step(still)
                assert info["disturbed"] == (step > 0)
                assert (observation != other).any() == (step > 0)
            model = env.unwrapped.model
    weight = 9.81 * model.body_mass.sum()
    assert abs(info["push_force"]) == pytest.approx(weight, rel=1e-6)


def test_what_is_pushed_is_the_torso_or_the_heaviest_body():
    for env_id, name in {"Ant-v5": "torso", "InvertedPendulum-v5": "cart"}.items():
        with closing(ExternalPush(make_environment(env_id), 1.0, duration=1)) as env:
            assert env.unwrapped.model.body(env._torso).name == name


def test_what_needs_a_simulation_is_left_out_elsewhere():
    reasons = left_out("Pendulum-v1", "oos")
    assert reasons.keys() == NEEDS_MUJOCO
    assert "MuJoCo" in reasons["push-1.0"]
    assert left_out("CartPole-v1", "oos").keys() == NEEDS_MUJOCO | {"knock-official-15"}
    assert left_out("Pendulum-v1", "action") == {}
    assert left_out("CartPole-v1", "action").keys() == {
        *("action-noise-0.1", "action-noise-0.3", "action-delay-1", "action-delay-2")
    }


def test_a_mistake_in_a_suite_is_not_left_out():
    configs = suite_of("start")
    configs["start-noise-0.05"].wrap.std = -1
    made = make_disturbances(configs, SimpleNamespace(), np.ones(11))
    with pytest.raises(ValueError, match="std must be"):
        impossible_disturbances("Hopper-v5", made)


def test_a_knock_draws_discrete_actions():
    knock = partial(ActionKnock, mode="torque")
    with closing(knock(make_environment("CartPole-v1"), 4, at=2)) as env:
        draws = []
        for seed in range(40):
            env.reset(seed=seed)
            infos = [env.step(0)[-1] for _ in range(3)]
            assert [int(each["knock_steps"]) for each in infos] == [0, 0, 1]
            # The cart is pushed to the right by 1, to the left by 0.
            draws.append(env.unwrapped.state[1] > -0.4)
        assert 5 < sum(draws) < 35
