"""What is said of a log before anything is trained on it."""

from __future__ import annotations

import numpy as np
import pytest
from recorded_logs import make_columns

from torchrl_osr.lab.cli.data import overview
from torchrl_osr.lab.data import transitions_from_columns
from torchrl_osr.lab.data.overview import findings, recorded_columns


def make_log(**changes):
    """Return episodes of 40 steps that give no reason to complain."""
    columns = make_columns(1200)
    columns["observation"] = columns["observation"][:, :2]
    columns["action"] = 0.9 * columns["action"][:, :1]
    columns["truncated"] |= columns["terminated"]
    return columns | {"terminated": np.zeros(1200, bool)} | changes


def said(columns, **options):
    data, manifest = transitions_from_columns(columns, **options)
    entries = recorded_columns(data, manifest).agg(["min", "max"]).T
    return [*findings(data, manifest, entries)]


def test_sound_logs_give_no_reason_to_complain():
    assert said(make_log()) == said(machine()) == []


LOG = make_log()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"reward": np.full(1200, 2.0)}, "reward is 2 in every row: all policies"),
        ({"action": np.sign(LOG["action"])}, "at one of its bounds in 100%"),
        ({"action": LOG["action"] / 100}, "stays within 0.9% of its bounds"),
        ({n: LOG[n].repeat(2, 0)[:1200] for n in LOG}, "repeat an earlier"),
        ({"observation": LOG["observation"].repeat(5, 0)[:1200]}, "does not change"),
        (
            {"observation": 1.7e9 + np.c_[np.zeros(1200), np.arange(1200)] / 50},
            "1,199 changes of observation[1] from row to row",
        ),
        (
            {"terminated": LOG["truncated"], "truncated": np.zeros(1200)},
            "all 30 episodes are terminated after 40 steps, like at a time limit",
        ),
        ({"next_observation": LOG["observation"] + 1}, "after 100% of the rows the"),
    ],
)
def test_findings_name_what_looks_wrong(changes, message):
    assert any(message in found for found in said(make_log(**changes)))


def test_columns_are_in_the_units_of_the_recording():
    log = make_log(action=np.array([5.0, 10.0]) * make_log()["action"])
    log["next_observation"] = log["observation"] + 1
    data, manifest = transitions_from_columns(log, action_bounds=([-5, -10], [5, 10]))
    manifest["columns"] = {"observation": ["x", "y"]}
    columns = recorded_columns(data, manifest)
    names = ["x", "y", "action[0]", "action[1]", "reward"]
    assert [name for _, name in columns] == names
    recorded = np.c_[log["observation"], log["action"], log["reward"]]
    np.testing.assert_allclose(columns, recorded, atol=1e-5)


def test_discrete_actions_are_not_measured_by_bounds():
    columns = make_log(action=np.arange(1200) % 2)
    assert said(columns, num_actions=2) == []
    data, manifest = transitions_from_columns(columns, num_actions=2)
    text = overview(data, manifest, ["action"])
    assert "actions   discrete, 2; shares of the rows: 51.3% 0, 48.7% 1" in text
    recorded = recorded_columns(data, manifest)
    assert set(recorded["action"].to_numpy().ravel()) == {0, 1}


def machine(shift=0, rows=3000):
    """A point that is pushed; its actions are recorded so many rows late."""
    rng = np.random.default_rng(0)
    forces, state, states = rng.uniform(-0.9, 0.9, rows), np.zeros(2), []
    for row in range(rows):
        if row % 100 == 0:
            state = rng.uniform(-10, 10, 2) * [1, 0]
        states.append(state)
        change = [0.1 * state[1], 0.3 * forces[row] - 0.1 * state[1]]
        state = np.add(state, change)
    return {
        "observation": np.array(states),
        "action": np.roll(forces, shift)[:, None],
        "reward": rng.normal(size=rows),
        "terminated": np.zeros(rows),
        "truncated": np.arange(rows) % 100 == 99,
    }


def test_actions_and_flags_of_another_row_are_found():
    late = machine(1)
    late["observation"] = np.c_[late["observation"], np.ones(3000)]
    assert any("in reverse order" in each for each in said(late))
    assert any("the row before explains" in each for each in said(machine(-1)))
    late = machine() | {"truncated": np.arange(3000) % 100 == 0}
    assert any("the state jumps" in each for each in said(late))
