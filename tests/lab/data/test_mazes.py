"""What leads a point and an ant through the mazes."""

from __future__ import annotations

from contextlib import closing

import gymnasium
import mujoco
import numpy as np
import pytest

from torchrl_osr.lab.data import make_environment
from torchrl_osr.lab.data.mazes import point_sampler, shortest_path, turned


def test_the_controller_by_hand():
    with closing(make_environment("gymnasium_robotics:PointMaze_UMaze-v3")) as env:
        assert not env.unwrapped.continuing_task  # however its id is written
        sample = point_sampler(env.unwrapped.maze)

    class Silent:
        def standard_normal(self, size):
            return np.zeros(size)

    # From the upper left cell to the lower left one, whose centres are (-1, 1) and
    # (-1, -1), the way leads through (0, 1): 2 * (0 - -1.2) - 0.4 * 1 = 2, at most 1.
    # Across it 2 * (1 - 1.1) - 0.4 * -0.25 = -0.1.
    observation = np.array([-1.2, 1.1, -1, -1, -1.2, 1.1, 1, -0.25])
    assert sample(observation, Silent()) == pytest.approx([1, -0.1])
    # In the cell before the goal's it goes straight to the goal, here 0.2 away.
    observation = np.array([0.4, 1, 0.6, 1, 0.4, 1, 0, 0])
    assert sample(observation, Silent()) == pytest.approx([0.4, 0])


def test_the_shortest_of_two_ways_is_taken():
    ring = {(row, column) for row in range(3) for column in range(4)}
    ring -= {(1, 1), (1, 2)}
    way = shortest_path(ring, (0, 1), (2, 1))
    assert way == [(0, 1), (0, 0), (1, 0), (2, 0), (2, 1)]
    with pytest.raises(KeyError):
        shortest_path(ring, (0, 0), (9, 9))


@pytest.mark.filterwarnings("ignore:.*Ant-v4 is out of date")
@pytest.mark.parametrize("angle", [0.3, 2.0, 3.1, -2.5])
def test_an_ant_that_mujoco_turns_has_the_turned_observation(angle):
    generator = np.random.default_rng(0)
    with closing(gymnasium.make("Ant-v4").unwrapped) as env:
        env.reset(seed=0)
        orientation = generator.standard_normal(4)
        orientation /= np.linalg.norm(orientation)
        position = np.r_[1, 2, 0.6, orientation, env.init_qpos[7:]]
        velocity, action = generator.standard_normal(14), generator.uniform(-1, 1, 8)

        def observed(position, velocity):
            env.set_state(position, velocity)
            return env._get_obs(), env.step(action)[0]

        before = observed(position, velocity)
        # MuJoCo's own functions, with the quaternion's first entry the real part.
        axis, of_z = np.array([0.0, 0, 1]), np.empty(4)
        mujoco.mju_axisAngle2Quat(of_z, axis, angle)
        mujoco.mju_mulQuat(position[3:7], of_z, orientation)
        mujoco.mju_rotVecQuat(velocity[:3], velocity[:3].copy(), of_z)
        after = observed(position, velocity)
    for ant, expected in zip(before, after, strict=True):
        expected[1:5] *= np.sign(expected[1])
        np.testing.assert_allclose(turned(ant, angle), expected, atol=1e-10)
