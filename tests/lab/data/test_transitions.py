"""From recorded columns to transitions: what ends, what stays, what is refused."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from torchrl_osr.lab.data import check_dataset, transitions_from_columns

NEXT = ("next", "observation")
DISCRETE = "only the whole numbers 0 to 1, which look like discrete"


def log(**changes):
    """Two episodes: rows 0-2 fall, rows 3-5 run into the time limit."""
    rows = {
        "observation": np.arange(1.0, 13.0).reshape(6, 2),
        "action": np.linspace(-0.9, 0.9, 6)[:, None],
        "reward": np.array([1.0, 2.0, 4.0, 8.0, 16.0, 32.0]),
        "terminated": np.array([0, 0, 1, 0, 0, 0]),
        "truncated": np.array([0, 0, 0, 0, 0, 1]),
    } | changes
    return {name: column for name, column in rows.items() if column is not None}


def flags(data, name):
    return data["next", name][:, 0].long().tolist()


def test_next_observation_is_the_following_row():
    data, manifest = transitions_from_columns(log())
    check_dataset(data)
    assert data["observation"].tolist() == log()["observation"][:5].tolist()
    # Row 2 fell: nothing reads its next state. Row 5 is cut, and has none: dropped.
    assert data[NEXT].tolist() == [[3, 4], [5, 6], [5, 6], [9, 10], [11, 12]]
    assert flags(data, "terminated") == [0, 0, 1, 0, 0]
    assert flags(data, "truncated") == [0, 0, 0, 0, 1]
    assert (manifest["dropped_rows"], manifest["episode_lengths"]) == (1, [3, 3])
    assert manifest["episode_returns"] == [7.0, 56.0]


def test_recorded_next_observation_keeps_every_row():
    following = log()["observation"] + 0.5
    data, manifest = transitions_from_columns(log(next_observation=following))
    assert data[NEXT].tolist() == following.tolist()
    assert flags(data, "truncated") == [0, 0, 0, 0, 0, 1]
    assert (len(data), manifest["dropped_rows"]) == (6, 0)
    # These rows do not follow one another, so that no sum of rewards is a return.
    assert manifest["episode_returns"] == []
    # Nothing reads the next state of a fall.
    following[2] = np.nan
    data, _ = transitions_from_columns(log(next_observation=following))
    assert data[NEXT][2].tolist() == log()["observation"][2].tolist()


def test_episode_numbers_are_ends_and_cuts_become_truncated():
    rows = log(truncated=None, episode=[7, 7, 7, 3, 3, 4])
    data, manifest = transitions_from_columns(rows)
    # Row 4 is the last of episode 3 and row 5 of episode 4: neither has a next state.
    assert data["observation"][:, 0].tolist() == [1, 3, 5, 7]
    assert flags(data, "truncated") == [0, 0, 0, 1]
    assert (manifest["dropped_rows"], manifest["episode_returns"]) == (2, [7.0])


def test_actions_are_mapped_to_the_unit_box_and_clipped():
    action = np.array([[-2.0, 0], [2.0, 10], [0, 5], [1, 5], [1, 5], [1, 5]])
    bounds = (np.array([-2.0, 0.0]), np.array([2.0, 10.0]))
    data, _ = transitions_from_columns(log(action=action), action_bounds=bounds)
    limit = torch.tensor(0.999)
    expected = torch.tensor([[-1.0, -1], [1, 1], [0, 0], [0.5, 0], [0.5, 0]])
    assert data["action"].tolist() == (expected.clamp(-limit, limit)).tolist()
    # Whole numbers are forces within bounds from zero.
    action = np.array([[0], [1], [1], [0], [1], [0]])
    data, _ = transitions_from_columns(log(action=action), action_bounds=(0, 1))
    assert data["action"].flatten().sign().tolist() == [-1, 1, 1, -1, 1]


def test_actions_out_of_bounds_are_refused_or_clipped():
    action = log()["action"]
    action[3] = -1.5
    with pytest.raises(ValueError, match=r"1 of 6 rows, first in row 3: \[-1.5\]"):
        transitions_from_columns(log(action=action))
    data, manifest = transitions_from_columns(log(action=action), clip_actions=True)
    assert data["action"][3].item() == np.float32(-0.999)
    assert manifest["warnings"][0].startswith("1 rows had actions outside")
    for bounds in ((1, -1), 2, (1, 2, 3), ((-1, -2), (1, 2))):
        with pytest.raises(ValueError, match=r"action.bounds=.* expected"):
            transitions_from_columns(log(), action_bounds=bounds)


def test_missing_rows_cut_their_trajectory():
    observation, reward = log()["observation"], log()["reward"].copy()
    reward[4] = np.nan
    missing = "'reward' has no value in row 4 .*missing=row"
    with pytest.raises(ValueError, match=missing):
        transitions_from_columns(log(reward=reward))
    data, manifest = transitions_from_columns(log(reward=reward), missing="row")
    # Row 3 has lost its next state, and row 5 never had one.
    assert data["observation"][:, 0].tolist() == [1, 3, 5]
    assert (manifest["missing_rows"], manifest["dropped_rows"]) == (1, 2)
    assert manifest["episode_returns"] == [7.0], "the second is recorded in part"
    following = np.r_[observation[1:], [[13.0, 14.0]]]
    rows = log(reward=reward, next_observation=following)
    data, manifest = transitions_from_columns(rows, missing="row")
    assert data["observation"][:, 0].tolist() == [1, 3, 5, 7, 11]
    assert flags(data, "truncated") == [0, 0, 0, 1, 1]
    data, manifest = transitions_from_columns(rows, missing="episode")
    assert data["observation"][:, 0].tolist() == [1, 3, 5]
    assert manifest["missing_rows"] == 3
    rows = log(episode=np.array([0, np.nan, 0, 1, 1, 1]))
    data, _ = transitions_from_columns(rows, missing="row")
    assert data["observation"][:, 0].tolist() == [5, 7, 9]


def test_resets_of_a_vector_environment_are_left_out():
    # Row 3 begins where row 2 ended, and leads to the first state of an episode.
    observation = np.array([[1.0], [2], [3], [4], [7], [8]])
    following = np.array([[2.0], [3], [4], [7], [8], [9]])
    rows = log(observation=observation, next_observation=following)
    rows["reward"][3] = 0
    data, manifest = transitions_from_columns(rows)
    assert data["observation"][:, 0].tolist() == [1, 2, 3, 7, 8]
    assert (manifest["reset_rows"], manifest["episode_lengths"]) == (1, [3, 2])
    assert "1 rows were left out" in manifest["warnings"][0]


def with_value(name, row, value):
    column = log()[name].astype(float)
    column[row] = value
    return {name: column}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (with_value("observation", 1, 1e300), r"'observation' holds 1e\+300 in row 1"),
        (with_value("reward", 2, -np.inf), "'reward' holds -inf in row 2 of 6"),
        (with_value("terminated", 3, 2), "'terminated' holds 2.0 in row 3 of 6"),
        ({"observation": np.ones(6)}, r"'observation' has shape \[6\]"),
        ({"next_observations": np.ones((6, 2))}, "an unknown 'next_observations'"),
        ({"truncated": None}, "neither truncated nor episode"),
        ({"episode": [0, 0, 0, 1, 1, 0], "terminated": [0] * 6}, "'episode' 0 comes b"),
        ({"episode": [0, 0, 0, 0, 1, 1]}, r"row 2 ends its episode, and row 3 .*late"),
        ({"action": np.eye(6)[:, :1]}, DISCRETE),
        ({"terminated": [0] * 6, "truncated": [1] * 6}, "all values and a next state"),
    ],
)
def test_bad_columns_are_named(changes, message):
    with pytest.raises((ValueError, KeyError), match=message):
        transitions_from_columns(log(**changes))


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        (("next", "reward"), torch.ones(5), r"'reward'\) has shape \[5\]"),
        (("next", "done"), torch.ones(5, 1) > 0, r"terminated \| truncated in 3 rows"),
        ("action", torch.full((5, 1), torch.nan), "holds NaN or infinity"),
        (NEXT, torch.zeros(5, 2), "zero in all 5 rows"),
    ],
)
def test_bad_data_sets_are_refused(key, value, message):
    data, _ = transitions_from_columns(log())
    data.set(key, value)
    with pytest.raises(ValueError, match=message):
        check_dataset(data)
