"""Undisturbed and disturbed scores and the way back, against numbers made by hand."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from lab.report import fakes

from torchrl_osr.lab.report import read_runs
from torchrl_osr.lab.report.scores import (
    Estimate,
    by_run,
    disturbed,
    estimate,
    iqm,
    profile,
    recent,
    score_curve,
    way_back,
)

write, level, suite = fakes.write_hand, fakes.hand_level, fakes.hand_suite
MINUS = "\N{MINUS SIGN}"


def episodes(folder) -> pd.DataFrame:
    return fakes.read_all(folder).episodes


def suite_rows(folder) -> pd.DataFrame:
    rows = episodes(folder)
    return rows[rows["suite"] == "hand"]


def test_scores_are_means_of_the_last_evaluations(tmp_path):
    curve = {step: [10.0 * step, 20.0 * step] for step in range(1, 8)}
    write(tmp_path / "a", curve)
    write(tmp_path / "b", {s: [2 * v for v in row] for s, row in curve.items()}, seed=1)
    found = episodes(tmp_path)
    # Of run a: 15 a step; the last five steps are 3 to 7, on average 5.
    last = estimate(by_run(recent(found, 1)))
    assert last.mean == pytest.approx(7 * (15 + 30) / 2)
    assert estimate(by_run(recent(found))).mean == pytest.approx(5 * (15 + 30) / 2)
    # Two seeds: resamples are both, or one of them twice with chance 1/4 each.
    assert last[1:3] == pytest.approx((7 * 15, 7 * 30))
    assert last.over == "two seeds"
    assert str(last).endswith("²")
    band = score_curve(found)
    np.testing.assert_allclose(band.mean, 22.5 * np.arange(1, 8))
    assert (band.low < band.mean).all()
    alone = score_curve(found[found["seed"] == 0])
    assert np.isnan(alone.low).all(), "the band is over seeds"


def test_one_seed_gives_an_interval_over_episodes_that_says_so():
    found = estimate([np.array([1.0, 1.0, 4.0])])
    assert (found.mean, found.low) == (2, 1)
    assert found.high in (3, 4)
    assert str(found).endswith("ᵉ")
    assert str(estimate([np.array([value]) for value in (1.0, 2, 3)])).endswith("]")
    assert str(Estimate(-1.25, -2.0, 3.0)) == "-1.2 [-2.0, 3.0]".replace("-", MINUS)


def test_profile_and_interquartile_mean_pool_data_sets(tmp_path):
    scores = {("hopper", 0): 10, ("hopper", 1): 20, ("walker2d", 0): 40,
              ("walker2d", 1): 90}  # fmt: skip
    for (env, seed), score in scores.items():
        curve = {1: [score - 5.0, score + 5.0]}
        write(tmp_path / f"{env}{seed}", curve, env=env, seed=seed)
    found = episodes(tmp_path)
    mean = iqm(found)
    assert (mean.mean, mean.over) == (pytest.approx((20 + 40) / 2), "two seeds")
    # Stratified: the middle two are at least 10 and 40, at most 20 and 90.
    assert (10 + 40) / 2 <= mean.low < 30 < mean.high <= (20 + 90) / 2
    alone = iqm(found[(found["seed"] == 0) | (found["data"] == "hopper medium-replay")])
    assert alone.mean == pytest.approx(70 / 3)
    assert alone.over == "episodes", "walker2d has a single seed"
    assert alone.low < 70 / 3 < alone.high
    band = profile(found, np.array([0.0, 15.0, 30.0, 87.0, 100.0]))
    np.testing.assert_allclose(band.mean, [1, 0.75, 0.5, 0.25, 0])
    assert (band.low <= band.mean).all()
    assert (band.mean <= band.high).all()


def test_decrease_is_that_of_the_means(tmp_path):
    def loses(clean, *shares):
        levels = [
            level(f"x{share}", [share * each for each in clean]) for share in shares
        ]
        return suite((5, [1, 2], clean, levels))

    first, other = (loses(clean, 1, 0.5) for clean in ([40.0, 60.0], [100.0] * 2))
    write(tmp_path / "a", {5: [1.0]}, suite=first)
    write(tmp_path / "b", {5: [1.0]}, suite=other, seed=1)
    found = disturbed(suite_rows(tmp_path))
    assert list(found) == ["", "x1", "x0.5"]
    scores, decreases = zip(*found.values(), strict=True)
    assert [each.mean for each in scores] == [75, 75, 37.5]
    assert scores[0].low < 75 < scores[0].high
    # Every pair of episodes loses the same share: the interval has no width.
    for each, lost in zip(decreases, (0, 0, 50), strict=True):
        assert each[:3] == pytest.approx((lost, lost, lost))


def test_there_is_no_percentage_of_nothing(tmp_path):
    content = suite((5, [1, 2], [-1.0, 2.0], [level("x", [1.0, 1.0])]))
    write(tmp_path / "a", {5: [1.0]}, suite=content)
    assert disturbed(suite_rows(tmp_path))["x"][1] is None


def test_a_start_state_that_comes_again_is_no_new_episode(tmp_path):
    once, again = [level("x", [1.0, 2.0])], [level("x", [3.0, 6.0])]
    for name, seeds, wanted in (("same", [1, 2], 2), ("other", [3, 4], 4)):
        content = suite(
            (8, [1, 2], [10.0, 20.0], once), (9, seeds, [30.0, 40.0], again)
        )
        write(tmp_path / name, {9: [1.0]}, suite=content)
        rows = suite_rows(tmp_path / name)
        (scores,) = by_run(rows[rows["disturbance"] == "x"])
        assert len(scores) == wanted
        assert scores[0] == ((1 + 3) / 2 if name == "same" else 1)
        assert disturbed(rows)[""][0].mean == 25


def transient(**entries):
    """Return a level of four episodes, of which the last ended before it."""
    base = {
        "disturbed_at": [7, 7, 7, None],
        "survived_knock": [True, True, False, None],
        "alive_after": [True, None, False, None],
        "clean_alive_after": [None] * 4,
        "recovery_steps": [0, 2, None, None],
        "distance": {
            "offset": [-1, 0, 1, 2], "mean": [0.5, 2.0, 1.5, None],
            "count": [3, 3, 1, 0],
        },
    }  # fmt: skip
    return fakes.knock("knock", [30.0, 40.0, 5.0, 9.0], **(base | entries))


def came_back(folder, name="knock"):
    curves = read_runs([folder]).distances
    return way_back(suite_rows(folder), curves[curves["disturbance"] == name], name)


def test_recovery_counts_those_that_the_disturbance_came_to(tmp_path):
    content = suite((5, [1, 2, 3, 4], [50.0, 50.0, 50.0, 9.0],
                     [level("mass", [1.0] * 4), transient()]))  # fmt: skip
    write(tmp_path / "a", {5: [1.0]}, suite=content)
    found = came_back(tmp_path)
    assert (found.num_episodes, found.reached) == (4, 0.75)
    assert found.stood == pytest.approx(2 / 3)
    assert found.alive_after == 0.5  # the second ran out of time: not known
    assert np.isnan(found.undisturbed_alive)
    assert found.median == 2
    assert found.decrease.mean == pytest.approx(50)
    # Of three, one is back at once, one after two steps, and one never.
    np.testing.assert_array_equal(found.recovered.x, [0, 1, 2])
    np.testing.assert_allclose(found.recovered.mean, [1 / 3, 1 / 3, 2 / 3])
    np.testing.assert_array_equal(found.distance.mean, [0.5, 2, 1.5, np.nan])
    assert np.isnan(found.distance.low).all()


def test_distances_are_weighted_by_episodes_then_by_seeds(tmp_path):
    def curve(mean, count):
        return {"distance": {"offset": [0, 1], "mean": mean, "count": count}}

    for seed, parts in enumerate([
        (curve([1.0, 2.0], [3, 1]), curve([5.0, 4.0], [1, 1])),
        (curve([4.0, None], [2, 0]), curve([4.0, None], [2, 0])),
    ]):  # fmt: skip
        rows = [
            (step, [1, 2, 3, 4], [9.0] * 4, [transient(**part)])
            for step, part in zip((8, 9), parts, strict=True)
        ]
        write(tmp_path / str(seed), {9: [1.0]}, suite=suite(*rows), seed=seed)
    found = came_back(tmp_path)
    # First seed: (3 * 1 + 1 * 5) / 4 = 2, then (2 + 4) / 2 = 3, the other has none.
    np.testing.assert_allclose(found.distance.mean, [(2 + 4) / 2, 3])
    np.testing.assert_allclose(found.distance.low, [2, np.nan])
    np.testing.assert_allclose(found.distance.high, [4, np.nan])


def test_nobody_disturbed_and_nobody_recovered_are_no_numbers(tmp_path):
    none = {"disturbed_at": [None] * 4}
    never = {
        "recovery_steps": [None] * 4,
        "clean_alive_after": [True, False, None, None],
    }
    content = suite((5, [1, 2, 3, 4], [9.0] * 4, [
        transient(**none) | {"name": "late"}, transient(**never)]))  # fmt: skip
    write(tmp_path / "a", {5: [1.0]}, suite=content)
    assert came_back(tmp_path, "late") is None
    found = came_back(tmp_path)
    assert found.median == np.inf
    assert found.undisturbed_alive == 0.5
    assert not found.recovered.mean.any()
