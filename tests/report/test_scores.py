"""Undisturbed and disturbed scores, against numbers made by hand."""

from __future__ import annotations

import runpy
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from torchrl_osr.report.published import TABLE
from torchrl_osr.report.robustness import (
    Level,
    area,
    disturbed,
    episode_table,
    series_of,
)
from torchrl_osr.report.scores import (
    Estimate,
    episode_profile,
    estimate,
    interquartile_means,
    last_score,
    learning_curve,
    recent_score,
    run_profile,
    thresholds_of,
)

fakes = SimpleNamespace(**runpy.run_path(str(Path(__file__).with_name("fakes.py"))))
write, level, suite, read = (
    fakes.write_hand,
    fakes.hand_level,
    fakes.hand_suite,
    fakes.read_all,
)
MINUS = "\N{MINUS SIGN}"


def test_scores_are_means_of_the_last_evaluations(tmp_path):
    curve = {step: [10.0 * step, 20.0 * step] for step in range(1, 8)}
    write(tmp_path / "a", curve)
    write(tmp_path / "b", {s: [2 * v for v in row] for s, row in curve.items()}, seed=1)
    runs = read(tmp_path)
    # Of run a: 15 a step; the last five steps are 3 to 7, on average 5.
    assert last_score(runs).mean == pytest.approx(7 * (15 + 30) / 2)
    assert recent_score(runs).mean == pytest.approx(5 * (15 + 30) / 2)
    # Two seeds: resamples are both, or one of them twice with chance 1/4 each.
    assert last_score(runs)[1:3] == pytest.approx((7 * 15, 7 * 30))
    assert last_score(runs).over == "seeds"
    curve = learning_curve(runs)
    np.testing.assert_allclose(curve.mean, 22.5 * np.arange(1, 8))
    assert curve.over == "seeds"


def test_one_seed_gives_an_interval_over_episodes_that_says_so():
    found = estimate([np.array([1.0, 1.0, 4.0])])
    assert found.mean == 2
    assert found.low == 1
    assert found.high in (3, 4)
    assert str(found).endswith("ᵉ")
    assert str(Estimate(-1.25, -2.0, 3.0)) == "-1.2 [-2.0, 3.0]".replace("-", MINUS)


def test_profile_and_interquartile_mean_pool_data_sets(tmp_path):
    scores = {
        ("hopper", 0): 10,
        ("hopper", 1): 20,
        ("walker2d", 0): 40,
        ("walker2d", 1): 90,
    }
    for (env, seed), score in scores.items():
        write(
            tmp_path / f"{env}{seed}",
            {1: [score - 5.0, score + 5.0]},
            env=env,
            seed=seed,
        )
    runs = read(tmp_path)
    assert interquartile_means(runs)["osr"].mean == pytest.approx((20 + 40) / 2)
    # Stratified: the middle two are at least 10 and 40, at most 20 and 90.
    low, high = interquartile_means(runs)["osr"][1:3]
    assert (10 + 40) / 2 <= low < 30 < high <= (20 + 90) / 2
    assert interquartile_means(runs)["osr"].over == "seeds"
    alone = interquartile_means(
        [run for run in runs if run.seed == 0 or run.env[0] == "h"]
    )
    assert alone["osr"].mean == pytest.approx(70 / 3)
    assert alone["osr"].over == "episodes", "walker2d has a single seed"
    assert alone["osr"].low < 70 / 3 < alone["osr"].high
    tau = np.array([0.0, 15.0, 30.0, 87.0, 100.0])
    profile = run_profile(runs, "osr", tau)
    np.testing.assert_allclose(profile.mean, [1, 0.75, 0.5, 0.25, 0])
    assert (profile.low <= profile.mean).all()
    assert (profile.mean <= profile.high).all()
    # Episodes: 5 and 15, 15 and 25, 35 and 45, 85 and 95; 15 is not above 15.
    profile = episode_profile(runs, "osr", np.array([0.0, 15.1, 30.0, 87.0, 100.0]))
    np.testing.assert_allclose(profile.mean, [1, 5 / 8, 0.5, 1 / 8, 0])
    assert thresholds_of(runs)[-1] == pytest.approx(95)


def test_kinds_are_the_names_without_their_sizes():
    for name, kind, wanted in (
        ("torque-20", "knock", "knock: torque"),
        ("knock-official-15", "knock", "knock-official"),
        ("push-small", "push", "push"),
        ("push-1.5", "push", "push"),
        ("observation-noise", "observation", "observation-noise"),
        ("action_diff-0.05", "action_diff attack", "action_diff attack"),
        ("sticky-action-0.1", "sticky action", "sticky-action"),
        ("mass", "dynamics", "dynamics: mass"),
    ):
        assert Level(name, kind, 1.0).series == wanted
    levels = [Level("a-3", "a", 3), Level("b", "b", 1), Level("a-1", "a", 1)]
    assert series_of(levels) == {"a": [2, 0], "b": [1]}


def test_decrease_is_that_of_the_means(tmp_path):
    def loses(clean, *shares):
        levels = [
            level(f"x-{strength}", [share * each for each in clean], strength=strength)
            for strength, share in zip((1, 3), shares, strict=True)
        ]
        return suite((5, [1, 2], clean, levels))

    first, other = (loses(clean, 0.75, 0.5) for clean in ([40.0, 60.0], [100.0] * 2))
    write(tmp_path / "a", {5: [1.0]}, suite=first)
    write(tmp_path / "b", {5: [1.0]}, suite=other, seed=1)
    found = disturbed(read(tmp_path), "hand")
    assert found.clean.mean == 75
    assert [each.mean for each in found.scores] == [56.25, 37.5]
    # Every pair of episodes loses the same share: the interval has no width.
    for each, lost in zip(found.decreases, (25, 50), strict=True):
        assert each[:3] == pytest.approx((lost, lost, lost))
    assert found.clean.low < 75 < found.clean.high
    # Trapezoid over 1 to 3: half of each end.
    assert area(found, [0, 1])[:3] == pytest.approx((62.5,) * 3)
    assert area(found, [0]) is None


def test_there_is_no_percentage_of_nothing(tmp_path):
    content = suite((5, [1, 2], [-1.0, 2.0], [level("x", [1.0, 1.0])]))
    write(tmp_path / "a", {5: [1.0]}, suite=content)
    assert disturbed(read(tmp_path), "hand").decreases == [None]


def test_a_start_state_that_comes_again_is_no_new_episode(tmp_path):
    def rows(*evaluations):
        write(tmp_path / "a", {9: [1.0]}, suite=suite(*evaluations))
        return episode_table(read(tmp_path)[0], "hand").tolist()

    once, again = [level("x", [1.0, 2.0])], [level("x", [3.0, 6.0])]
    same = rows((8, [1, 2], [10.0, 20.0], once), (9, [1, 2], [30.0, 40.0], again))
    assert same == [[20, 2], [30, 4]]
    other = rows((8, [1, 2], [10.0, 20.0], once), (9, [3, 4], [30.0, 40.0], again))
    assert other == [[10, 1], [20, 2], [30, 3], [40, 6]]


def test_paper_is_quoted_as_printed():
    assert TABLE["halfcheetah"]["SDC"][2] == (83.3, 17.8)
    assert TABLE["hopper"]["OSR"][2] == (106.1, 6.2)
    # All rows but the misprint imply one clean score each: Table 1's.
    for env, methods in TABLE.items():
        for method, row in methods.items():
            implied = [c.score / (1 - c.decrease / 100) for c in row]
            if (env, method) == ("walker2d", "CQL"):
                assert implied.pop(0) == pytest.approx(153.9, abs=0.1)
                assert implied[0] * (1 - 0.178) == pytest.approx(81.1, abs=0.1)
            assert max(implied) - min(implied) < 0.7, (env, method)
