"""From recorded steps to transitions: what ends, what stays, what is refused."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from torchrl_osr.lab.data import (
    check_dataset,
    transitions_from_episodes,
    transitions_from_rows,
)

NEXT = ("next", "observation")


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


def test_the_next_observation_is_the_following_rows():
    data, manifest = transitions_from_rows(log())
    check_dataset(data)
    assert data["observation"].tolist() == log()["observation"][:5].tolist()
    # Row 2 fell: nobody reads its next state. Row 5 is cut, and has none: dropped.
    assert data[NEXT].tolist() == [[3, 4], [5, 6], [5, 6], [9, 10], [11, 12]]
    assert flags(data, "terminated") == [0, 0, 1, 0, 0]
    assert flags(data, "truncated") == [0, 0, 0, 0, 1]
    assert (manifest["dropped_rows"], manifest["terminal_rows_filled"]) == (1, 1)
    assert manifest["episode_returns"] == [7.0, 56.0]
    assert manifest["return"] == {"mean": 31.5, "std": 24.5, "min": 7.0, "max": 56.0}
    assert manifest["episode_lengths"] == [3, 3]


def test_a_recorded_next_observation_keeps_every_row():
    following = log()["observation"] + 0.5
    data, manifest = transitions_from_rows(log(next_observation=following))
    assert data[NEXT].tolist() == following.tolist()
    assert flags(data, "truncated") == [0, 0, 0, 0, 0, 1]
    assert (len(data), manifest["dropped_rows"]) == (6, 0)
    # These rows do not follow one another, so that no sum of rewards is a return.
    assert manifest["num_complete_episodes"] == 0
    assert manifest["return"] is None


def test_returns_leave_out_an_episode_with_a_hole():
    observation = log()["observation"]
    following = np.r_[observation[1:], [[99.0, 99.0]]]
    following[4] = 0.0
    _, manifest = transitions_from_rows(log(next_observation=following))
    assert manifest["episode_returns"] == [7.0]


def test_episode_numbers_are_ends_and_cuts_become_truncated():
    rows = log(truncated=None, episode=[7, 7, 7, 3, 3, 4])
    data, manifest = transitions_from_rows(rows)
    # Row 4 is the last of episode 3 and row 5 of episode 4: neither has a next state.
    assert data["observation"][:, 0].tolist() == [1, 3, 5, 7]
    assert flags(data, "truncated") == [0, 0, 0, 1]
    assert (manifest["dropped_rows"], manifest["episode_returns"]) == (2, [7.0])
    following = rows["observation"] + 1
    data, manifest = transitions_from_rows(rows | {"next_observation": following})
    assert flags(data, "truncated") == [0, 0, 0, 0, 1, 1]
    assert manifest["episode_returns"] == [7.0]


def test_actions_are_mapped_and_clipped_by_a_stated_amount():
    action = np.array([[-2.0, 0], [2.0, 10], [0, 5], [1, 5], [1, 5], [1, 5]])
    bounds = (np.array([-2.0, 0.0]), np.array([2.0, 10.0]))
    data, manifest = transitions_from_rows(log(action=action), action_bounds=bounds)
    limit = torch.tensor(0.999)
    expected = torch.tensor([[-1.0, -1], [1, 1], [0, 0], [0.5, 0], [0.5, 0]])
    assert data["action"].tolist() == (expected.clamp(-limit, limit)).tolist()
    assert (manifest["clipped_actions"], manifest["action_limit"]) == (2, 0.999)


def test_actions_beyond_their_bounds_are_refused_unless_told():
    action = log()["action"]
    action[3] = -1.5
    with pytest.raises(ValueError, match=r"1 of 6 rows, first in row 3: \[-1.5\]"):
        transitions_from_rows(log(action=action))
    data, manifest = transitions_from_rows(log(action=action), clip_actions=True)
    assert data["action"][3].item() == np.float32(-0.999)
    assert manifest["clipped_actions"] == 1
    assert manifest["warnings"][0].startswith("1 rows had an action outside")
    for bounds in ((-np.inf, np.inf), (1, -1), ([-1, -1], 1)):
        with pytest.raises(ValueError, match=r"action.bounds"):
            transitions_from_rows(log(), action_bounds=bounds)


def test_whole_numbers_are_forces_where_their_bounds_say_so():
    action = np.array([[0], [1], [1], [0], [1], [0]])
    data, _ = transitions_from_rows(log(action=action), action_bounds=(0, 1))
    limit = np.float32(0.999)
    assert data["action"][:, 0].tolist() == [-limit, limit, limit, -limit, limit]
    data, _ = transitions_from_rows(log(action=2 * action - 1))
    assert data["action"][:, 0].tolist() == [-limit, limit, limit, -limit, limit]


def test_a_mask_that_hides_nothing_is_no_obstacle():
    masked = np.ma.masked_equal(log()["observation"], -9999.0)
    data, _ = transitions_from_rows(log(observation=masked))
    assert (data == transitions_from_rows(log())[0]).all()


def test_what_float32_makes_equal_is_said():
    clock = 1.7e9 + 0.02 * np.arange(6)
    observation = np.c_[log()["observation"][:, 0], clock]
    _, manifest = transitions_from_rows(log(observation=observation))
    (warning,) = manifest["warnings"]
    assert "entry 1 of 'observation' changes 5 times" in warning
    assert "5 of these changes vanish in float32" in warning
    assert transitions_from_rows(log())[1]["warnings"] == []


def test_rows_are_copied_and_columns_may_be_tall():
    rows = log(**{name: log()[name][:, None] for name in ("reward", "terminated")})
    rows["observation"].setflags(write=False)
    data, _ = transitions_from_rows(rows)
    data["observation"].zero_()
    assert rows["observation"][0, 0] == 1.0
    assert data["next", "reward"].shape == (5, 1)


def with_value(name, row, value):
    column = log()[name].astype(float)
    column[row] = value
    return {name: column}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (with_value("observation", 4, np.nan), "'observation' holds nan in row 4 of 6"),
        (with_value("observation", 1, 1e300), r"'observation' holds 1e\+300 in row 1"),
        (with_value("reward", 2, -np.inf), "'reward' holds -inf in row 2 of 6"),
        (with_value("action", 0, np.nan), "'action' holds nan in row 0 of 6"),
        (with_value("terminated", 3, 2), "'terminated' holds 2.0 in row 3 of 6"),
        (with_value("truncated", 3, np.nan), "'truncated' holds nan in row 3"),
        ({"observation": np.zeros((6, 2))}, r"'observation' is zero in all 5 rows"),
        ({"observation": np.ones(6)}, r"'observation' has shape \[6\]; .*\[6, D\]"),
        ({"observation": np.ones((6, 0))}, r"'observation' has shape \[6, 0\]"),
        ({"observation": np.ones((0, 2))}, "hold no rows"),
        ({"action": np.ones((5, 1))}, r"'action' has shape \[5, 1\]; expected \[6, D"),
        ({"reward": np.ones((6, 2))}, r"'reward' has shape \[6, 2\]; expected \[6\]"),
        ({"reward": ["much"] * 6}, "'reward' has type <U4; expected numbers"),
        ({"reward": np.array([None] * 6)}, "'reward' has type object"),
        ({"action": [[0.1], [0.2, 0.3]] * 3}, "'action' has rows of unequal length"),
        ({"next_observation": np.ones((6, 3))}, r"\[6, 3\]; expected that of 'obs"),
        ({"next_observations": np.ones((6, 2))}, "unknown columns 'next_observations'"),
        ({"truncated": None}, "lack truncated or episode"),
        ({"reward": None}, "lack reward"),
        ({"episode": [0, 0, 1, 1, 0, 0]}, "'episode' 0 comes back in row 4"),
        (
            {"episode": np.linspace(0, 1, 6)},
            "'episode' holds 0.2 in row 1 of 6",
        ),
        ({"terminated": None, "dones": [0] * 6}, "unknown columns 'dones'"),
        (
            {"observation": np.ma.masked_equal(log()["observation"], 7.0)},
            "'observation' is masked in row 3 of 6, and in 1 rows",
        ),
        (
            {"action": np.array([[0], [1], [1], [0], [1], [0]])},
            r"only the whole numbers 0 to 1, where .* \[-1.0\] and \[1.0\]: .*discrete",
        ),
        ({"action": np.eye(3)[[0, 1, 2, 0, 1, 1]]}, "look like numbers of discrete"),
        (
            {"terminated": [0] * 6, "truncated": [1] * 6},
            "none of the 6 rows has a true next state",
        ),
    ],
)
def test_deviations_are_named(changes, message):
    with pytest.raises(ValueError, match=message):
        transitions_from_rows(log(**changes))


def episode(steps=3, size=2, **changes):
    return {
        "observation": np.arange(1.0, 1 + (steps + 1) * size).reshape(-1, size),
        "action": np.full((steps, 1), 0.5),
        "reward": np.ones(steps),
        "terminated": np.zeros(steps, bool),
        "truncated": np.arange(steps) == steps - 1,
    } | changes


def test_episodes_keep_their_last_observation():
    fallen = episode(2, terminated=[False, True], truncated=[False, False])
    cut = episode(2, truncated=[False, False])
    read = iter([episode(), episode(0), fallen, cut])
    data, manifest = transitions_from_episodes(read)
    assert data["observation"][:, 0].tolist() == [1, 3, 5, 1, 3, 1, 3]
    assert data[NEXT][:, 0].tolist() == [3, 5, 7, 3, 5, 3, 5]
    assert flags(data, "terminated") == [0, 0, 0, 0, 1, 0, 0]
    assert flags(data, "truncated") == [0, 0, 1, 0, 0, 0, 1]
    assert manifest["episode_lengths"] == [3, 2]  # the last was not played to its end
    assert manifest["dropped_rows"] == 0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"action": np.ones((2, 1))}, r"episode 1 has shapes .*'action': \[2, 1\]"),
        ({"observation": np.ones((3, 2))}, "episode 1 has shapes .* T \\+ 1 obs"),
        (
            {"observation": np.ones((4, 5))},
            r"1: a row of 'observation' has shape \[5\]",
        ),
        (
            {"observation": [[1.0], [2.0, 3.0]] * 2},
            "episode 1: 'observation' has rows of unequal",
        ),
        ({"reward": 1.0}, "episode 1 has shapes"),
    ],
)
def test_deviations_of_an_episode_name_it(changes, message):
    with pytest.raises(ValueError, match=message):
        transitions_from_episodes([episode(), episode(**changes)])


def test_no_episodes_are_no_data():
    with pytest.raises(ValueError, match="none of the 2 episodes has a step"):
        transitions_from_episodes([episode(0), episode(0)])
    with pytest.raises(ValueError, match="episode 0 lacks truncated"):
        transitions_from_episodes([{k: v for k, v in episode().items() if k[1] != "r"}])
