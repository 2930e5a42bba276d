"""The push is the stated force, on the stated body, for the stated time."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from torchrl_osr.data import make_environment
from torchrl_osr.envs import DynamicsChange, ExternalPush

ROBOTS = ["Hopper-v5", "Walker2d-v5", "HalfCheetah-v5"]


def spy(env):
    """Note the applied forces ``[bodies, 6]`` of every step of the simulation."""
    bare, seen = env.unwrapped, []
    step = bare.step
    bare.step = lambda a: seen.append(bare.data.xfrc_applied.copy()) or step(a)
    return seen


def momentum(bare) -> float:
    """Horizontal momentum of the whole robot, in newton seconds."""
    mujoco.mj_subtreeVel(bare.model, bare.data)
    return float(bare.data.subtree_linvel[0, 0] * bare.model.body_mass.sum())


@pytest.mark.parametrize("name", ROBOTS)
def test_force_is_applied_and_removed(name, play):
    env = ExternalPush(make_environment(name), 25.0, duration=3, at=2)
    seen = spy(env)
    forces = [step[-1]["push_force"] for step in play(env, 7)]
    sign = np.sign(forces[2])
    assert forces == [0, 0, 25 * sign, 25 * sign, 25 * sign, 0, 0]
    torso = mujoco.mj_name2id(env.unwrapped.model, mujoco.mjtObj.mjOBJ_BODY, "torso")
    for number, applied in enumerate(seen):
        expected = np.zeros_like(applied)
        expected[torso, 0] = forces[number]
        assert (applied == expected).all()
    assert not env.unwrapped.data.xfrc_applied.any()


@pytest.mark.parametrize("name", ROBOTS)
def test_momentum_grows_by_force_times_time(name, play):
    env = ExternalPush(make_environment(name), 40.0, duration=4, at=0, body="torso")
    bare = env.unwrapped
    env.reset(seed=0)
    # High above the ground: nothing but the push acts horizontally.
    qpos = bare.data.qpos.copy()
    qpos[1] += 100
    bare.set_state(qpos, bare.data.qvel.copy())
    before = momentum(bare)
    for _ in range(6):
        force = env.step(np.zeros(env.action_space.shape, np.float32))[-1]["push_force"]
        if force:
            sign = np.sign(force)
    # The integrator's error in the joints' inner forces is what is left.
    assert momentum(bare) - before == pytest.approx(sign * 40 * 4 * bare.dt, rel=1e-3)


def test_both_directions_occur_and_the_seed_decides(recorder):
    env = ExternalPush(make_environment("Hopper-v5"), 1.0, duration=1, at=0)
    action, signs = env.action_space.low, []
    for seed in [*range(40), *range(40)]:
        env.reset(seed=seed)
        signs.append(env.step(action)[-1]["push_force"])
    assert signs[:40] == signs[40:]
    # 40 fair coins, 4 standard errors of 3.2.
    assert abs(signs[:40].count(1.0) - 20) < 13


def test_a_reset_within_the_push_ends_it():
    env = ExternalPush(make_environment("Hopper-v5"), 5.0, duration=9, at=0)
    env.reset(seed=0)
    env.step(env.action_space.low)
    env.reset(seed=0)
    assert not env.unwrapped.data.xfrc_applied.any()
    assert env.step(env.action_space.low)[-1]["push_force"] in (-5.0, 5.0)


def test_pushes_at_the_same_time_add_up(play):
    inner = ExternalPush(make_environment("Hopper-v5"), 0.1, duration=3, at=0)
    env = ExternalPush(inner, 0.7, duration=2, at=1)
    seen = spy(env)
    play(env, 4)
    totals = [np.abs(applied).sum() for applied in seen]
    assert totals[0] == 0.1
    assert totals[1] == pytest.approx(0.8) or totals[1] == pytest.approx(0.6)
    assert totals[3] == 0


def test_units_of_body_weight():
    # Gymnasium's models, weighed: their masses times 9.81 m/s².
    for name, weight in zip(ROBOTS, (155.19, 232.27, 137.34), strict=True):
        env = make_environment(name)
        push = ExternalPush(env, 2.0, duration=1, unit="body_weight")
        assert push.force == pytest.approx(2 * weight, abs=0.01)
    heavy = DynamicsChange(make_environment("Hopper-v5"), mass=3.0)
    push = ExternalPush(heavy, 1.0, duration=1, unit="body_weight")
    assert push.force == pytest.approx(3 * 155.19, abs=0.05)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"force": -1.0}, "force must be a finite number, at least 0, got -1.0"),
        ({"force": float("nan")}, "force must be"),
        ({"duration": 0}, "duration must be an integer, at least 1; got 0"),
        ({"unit": "pounds"}, "unit must be one of .*body_weight.* got 'pounds'"),
        ({"body": "head"}, r"body must be one of \['torso', .*'foot'\], got 'head'"),
        ({"at": 1.5}, "at must be an integer"),
        ({"window": (5, 4)}, "the end of window"),
    ],
)
def test_wrong_arguments(arguments, message):
    arguments = {"force": 1.0, "duration": 1} | arguments
    with pytest.raises(ValueError, match=message):
        ExternalPush(make_environment("Hopper-v5"), **arguments)
