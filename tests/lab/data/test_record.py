"""A log that is recorded here is read back as what was played."""

from __future__ import annotations

from contextlib import closing

import gymnasium
import numpy as np
import pytest

from torchrl_osr.lab.data import load_dataset
from torchrl_osr.lab.data.environment import open_environment
from torchrl_osr.lab.data.record import record_episodes, write_log


def record(env_id, act=None, episodes=2, **options):
    with closing(open_environment(env_id)) as env:
        return record_episodes(env, act, episodes, progress=False, **options)


def forwards(observation):
    observation[:] = 0  # the log has a copy
    return [1.5]


def test_columns_are_what_the_environment_was_given_and_gave():
    columns = record("Pendulum-v1", forwards)
    with closing(open_environment("Pendulum-v1")) as env:
        observation, _ = env.reset(seed=1)  # of the second episode
        for row in range(200, 400):
            following, reward, *ends, _ = env.step(np.float32([1.5]))
            assert (columns["observation"][row] == observation).all()
            assert (columns["next_observation"][row] == following).all()
            assert columns["reward"][row] == np.float32(reward)
            assert [columns["terminated"][row], columns["truncated"][row]] == ends
            observation = following
    assert (columns["action"] == 1.5).all()
    assert columns["episode"].tolist() == [0] * 200 + [1] * 200


def test_what_is_written_is_read_in_the_units_of_the_losses(tmp_path):
    columns, path = record("Pendulum-v1"), tmp_path / "new" / "log.npz"
    write_log(path, columns)
    data, manifest = load_dataset(env_id="Pendulum-v1", path=path)
    assert np.abs(columns["action"]).max() > 1
    expected = (columns["action"] / 2).clip(-0.999, 0.999)
    np.testing.assert_allclose(data["action"], expected, atol=1e-7)
    np.testing.assert_array_equal(data["observation"], columns["observation"])
    assert (manifest["episode_lengths"], manifest["dropped_rows"]) == ([200, 200], 0)
    assert list(path.parent.iterdir()) == [path], "nothing is left beside it"
    with pytest.raises(FileExistsError, match="exists"):
        write_log(path, columns)


def test_noise_stays_within_the_bounds():
    noisy, again = (record("Pendulum-v1", forwards, noise=0.25) for _ in range(2))
    noisy = noisy["action"]
    np.testing.assert_array_equal(noisy, again["action"])
    assert noisy.max() == 2, "clipped at the bound"
    # 0.25 half-widths of 2: a Gaussian about 1.5, cut off one deviation above. Half of
    # it is below 1.5, and by the error function 0.1587 at the bound; 400 draws.
    assert np.mean(noisy < 1.5) == pytest.approx(0.5, abs=0.1)
    assert np.mean(noisy == 2) == pytest.approx(0.1587, abs=0.08)


@pytest.mark.parametrize(
    ("env_id", "act", "options", "message"),
    [
        ("Pendulum-v1", lambda _: [2.5], {}, r"action \[2.5\] is not in"),
        ("CartPole-v1", forwards, {"noise": 1.5}, "from 0 to 1"),
        ("CartPole-v1", None, {"noise": 0.5}, "noise=0.5 has no effect with policy=ra"),
    ],
)
def test_bad_input_is_named(env_id, act, options, message):
    with pytest.raises(ValueError, match=message):
        record(env_id, act, **options)


def test_a_step_without_finite_numbers_is_an_error():
    env = open_environment("Pendulum-v1")
    strange = gymnasium.wrappers.TransformReward(env, lambda _: np.nan)
    with closing(strange), pytest.raises(ValueError, match="step 1 .* expected finite"):
        record_episodes(strange, None, 1, progress=False)
