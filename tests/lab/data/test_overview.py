"""What is said of a log before anything is trained on it."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from torchrl_osr.lab.cli.data import overview
from torchrl_osr.lab.data import transitions_from_columns
from torchrl_osr.lab.data.overview import describe_entries, findings
from torchrl_osr.lab.evaluation.figures import data_figure


def make_log(rows=1200, **changes):
    """Return episodes of 40 steps that give no reason to complain."""
    rng = np.random.default_rng(3)
    ends = np.arange(rows) % 40 == 39
    columns = {
        "observation": rng.normal(size=(rows, 2)),
        "action": rng.uniform(-0.9, 0.9, (rows, 1)),
        "reward": rng.normal(size=rows),
        "terminated": np.zeros(rows, bool),
        "truncated": ends,
    }
    return columns | changes


def said(columns, **options):
    data, manifest = transitions_from_columns(columns, **options)
    return [*findings(data, manifest, describe_entries([columns], {}))]


def test_a_sound_log_gives_no_reason_to_complain():
    assert said(make_log()) == []


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"reward": np.full(1200, 2.0)}, "reward is 2 in every row: all policies"),
        ({"action": np.sign(make_log()["action"])}, "at one of its bounds in 100%"),
        (
            {"terminated": make_log()["truncated"], "truncated": np.zeros(1200)},
            "all 30 episodes are terminated after 40 steps, like at a time limit",
        ),
        (
            {"next_observation": make_log()["observation"] + 1},
            "after 100% of the rows the next row",
        ),
    ],
)
def test_findings_name_what_looks_wrong(changes, message):
    (found,) = said(make_log(**changes))
    assert message in found


def test_ranges_are_those_that_pandas_finds():
    columns = make_log(observation=make_log()["observation"] * 1e-3 + [1e6, -3])
    columns["observation"][5, 1] = np.nan
    columns["observation"][6:9, 1] = np.inf
    parts = [{k: v[i : i + 500] for k, v in columns.items()} for i in (0, 500, 1000)]
    entries = describe_entries(parts, {"observation": ["x", "y"]})
    assert [entry.name for entry in entries] == ["x", "y", "action[0]", "reward"]
    assert [entry.missing for entry in entries] == [0, 4, 0, 0]
    table = np.c_[columns["observation"], columns["action"], columns["reward"]]
    frame = pd.DataFrame(table).replace(np.inf, np.nan)
    expected = frame.agg(["min", "max", "mean", "std"]).T.to_numpy()
    found = np.array([[e.low, e.high, e.mean, e.deviation] for e in entries])
    np.testing.assert_allclose(found, expected, rtol=1e-3)
    np.testing.assert_allclose(found[:, :2], expected[:, :2], rtol=1e-12)


def test_discrete_actions_are_not_measured_by_bounds(tmp_path):
    columns = make_log(action=np.arange(1200) % 2)
    data, manifest = transitions_from_columns(columns, num_actions=2)
    assert [*findings(data, manifest, describe_entries([columns], {}))] == []
    assert "actions   discrete, 2; shares of the rows: 51.3% 0, 48.7% 1" in overview(
        data, manifest, ["action"]
    )
    names = {"observation": ["x", "y"], "action": ["action"]}
    data_figure(data, manifest, names, tmp_path / "log.png", title="log")
    assert (tmp_path / "log.png").stat().st_size > 10_000


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


def test_actions_of_another_row_are_found():
    assert said(machine()) == []
    assert any("the row after explains" in each for each in said(machine(1)))
    assert any("the row before explains" in each for each in said(machine(-1)))


def test_flags_that_are_a_row_late_are_found():
    late = machine() | {"truncated": np.arange(3000) % 100 == 0}
    assert any("the state jumps" in each for each in said(late))
