"""Tables of scores, robustness and recoverable states, against numbers by hand."""

from __future__ import annotations

import numpy as np
import pytest
from lab.report import fakes

from torchrl_osr.lab.evaluation.statistics import Estimate
from torchrl_osr.lab.report import read_runs
from torchrl_osr.lab.report.tables import (
    by_run,
    recovery_table,
    robustness_table,
    score_table,
)

PLACE = "hopper medium-replay"


def test_scores_are_means_of_the_last_evaluations(tmp_path):
    curve = {step: [10.0 * step, 20.0 * step] for step in range(1, 8)}
    fakes.write_run(tmp_path / "a", curve)
    double = {step: [2 * value for value in row] for step, row in curve.items()}
    fakes.write_run(tmp_path / "b", double, seed=1)
    row = score_table(fakes.read_all(tmp_path)).loc[PLACE, "osr"]
    # Of run a: 15 a step; the last five steps are 3 to 7, on average 5.
    assert row["mean of the last 5"].mean == pytest.approx(5 * (15 + 30) / 2)
    # Two seeds: resamples are both, or one of them twice with chance 1/4 each.
    assert row["last"][:3] == pytest.approx((7 * 22.5, 7 * 15, 7 * 30))
    assert str(row["last"]).endswith("²")
    assert (row["seeds"], row["updates"], row["data mean"]) == ("2 (0, 1)", "7", 20)


def test_the_untrained_policy_is_in_no_mean(tmp_path):
    fakes.write_run(tmp_path / "a", {0: [90.0], 1: [10.0], 2: [20.0]})
    row = score_table(fakes.read_all(tmp_path)).loc[PLACE, "osr"]
    assert row["mean of the last 5"].mean == pytest.approx(15)


def test_a_start_state_that_comes_again_is_no_new_episode(tmp_path):
    once, again = [fakes.level("x", [1.0, 2.0])], [fakes.level("x", [3.0, 6.0])]
    for name, seeds, wanted in (("same", [1, 2], 2), ("other", [3, 4], 4)):
        last = 9, seeds, [30.0, 40.0], again
        content = fakes.suite_of((8, [1, 2], [10.0, 20.0], once), last)
        fakes.write_run(tmp_path / name, {9: [1.0]}, suite=content)
        rows = fakes.read_all(tmp_path / name).episodes
        (scores,) = by_run(rows[rows["disturbance"] == "x"])
        assert len(scores) == wanted
        assert scores[0] == ((1 + 3) / 2 if name == "same" else 1)


def test_robustness_counts_those_that_met_the_disturbance(tmp_path):
    clean = [50.0, 50.0, 50.0, 9.0]
    # The last ended before it; the second ran out of time.
    met = fakes.knock(
        "knock", [30.0, 40.0, 5.0, 9.0], disturbed_at=[7, 7, 7, None],
        survived_knock=[True, True, False, None],
        alive_after=[True, None, False, None], clean_alive_after=[None] * 4,
        recovery_steps=[0, 2, None, None],
    )  # fmt: skip
    names = "survived_knock", "alive_after", "recovery_steps"
    none = dict.fromkeys(names, [None] * 4)
    late = fakes.knock("late", clean, disturbed_at=[None] * 4, **none)
    half = fakes.level("half", [each / 2 for each in clean])
    content = fakes.suite_of((5, [1, 2, 3, 4], clean, [met, late, half]))
    fakes.write_run(tmp_path / "a", {5: [1.0]}, suite=content)
    rows = fakes.read_all(tmp_path).episodes
    table = robustness_table(rows[rows["suite"] == "hand"]).loc[PLACE]
    knock, late, half = (table.loc[name, "osr"] for name in ("knock", "late", "half"))
    assert (knock["met %"], late["met %"], half["met %"]) == (75, 0, 100)
    assert late["lost %"] is None, "nothing is known about it"
    assert half["lost %"][:3] == pytest.approx((50, 50, 50))
    assert knock["clean"].mean == pytest.approx(159 / 4)
    assert knock["stood %"] == pytest.approx(200 / 3)
    assert knock["stood +100 %"] == 50  # not known of the second
    assert knock["median steps"] == 2
    assert np.isnan(half["stood %"])
    # Of three, one is back at once, one after two steps, and one never.
    assert knock["recovered %"].mean == pytest.approx(200 / 3)
    assert knock["recovered %"][1:3] == pytest.approx((0, 100))


GROUP = ["easy", "contested", *["recoverable"] * 4]
STATES = {
    "versions": {},
    "half": "public",
    "group": GROUP,
    "disturbance": ["push 1", "push 1", "kick 2", "kick 10", "kick 2", "kick 10"],
    "walk": [0, 0, 1, 1, 2, 2],
}


def write_states(top, method, seed, *back, **entries):
    evaluations = [{"step": 8000, "back": each} for each in back]
    states = STATES | {"evaluations": evaluations} | entries
    folder = top / method / f"seed{seed}"
    fakes.write_run(folder, {8000: [50.0]}, seed=seed, states=states)


def test_shares_of_recoverable_states(tmp_path):
    # Two checkpoints of each: the easy state always, a hard one in half of them.
    for seed in (0, 1):
        write_states(tmp_path, "cql", seed, [1, 0, 0, 0, 0, 0], [1, 0, 0, 0, 0, 0])
        both = [1, 1, 1, 1, 0, 0], [1, 1, 1, 0, 0, seed]
        write_states(tmp_path, "osr", seed, *both)
    other = {"group": [*GROUP[:-1], "easy"]}
    write_states(tmp_path, "cql", 2, [1, 0, 0, 0, 0, 1], **other)
    table = recovery_table(fakes.read_all(tmp_path).saved, "cql")
    assert table["seeds"].tolist() == [2, 2, 1], "other states have their own rows"
    cql, osr, alone = (row for _, row in table.iterrows())
    assert cql["easy %"].mean == osr["contested %"].mean == 100
    assert cql["recoverable %"].mean == 0
    # 3 of 8 and 4 of 8, over two checkpoints each.
    assert osr["recoverable %"].mean == pytest.approx(43.75)
    # "kick 2" is the third and the fifth state: one of two, in all checkpoints.
    assert osr["kick 2 %"].mean == pytest.approx(50)
    assert osr["kick 10 %"].mean == pytest.approx(37.5)
    assert osr["R %"].mean == pytest.approx(43.75), "the reference saves nothing"
    assert osr["R %"].over == "two seeds"
    assert not isinstance(cql["R %"], Estimate), "it is the reference itself"
    assert alone["easy %"].over == "walks"


def test_nothing_is_recovered_where_the_reference_saves_all(tmp_path):
    write_states(tmp_path, "cql", 0, [1] * 6)
    write_states(tmp_path, "osr", 0, [1] * 6)
    table = recovery_table(read_runs([tmp_path]).saved, "cql")
    assert not any(isinstance(cell, Estimate) for cell in table["R %"])
