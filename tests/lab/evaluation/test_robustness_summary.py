"""What is said about pairs of episodes, against numbers made by hand."""

from __future__ import annotations

import json

import numpy as np
import pytest

from torchrl_osr.lab.data import reference_returns
from torchrl_osr.lab.evaluation import (
    Disturbance,
    DisturbanceResults,
    EpisodeResults,
    PairedResults,
    Recovery,
    decrease_interval,
    distance_curves,
    evaluation_json,
    robustness_figure,
    robustness_table,
    summarize_disturbances,
)


def test_decrease_by_hand():
    # Two pairs: a resample is (1, 1), (2, 2) or, half of the time, both.
    # Decreases: 100 (1 - 10/20) = 50; 100 (1 - 60/80) = 25; 100 (1 - 70/100) = 30.
    assert decrease_interval([20, 80], [10, 60]) == pytest.approx((30, 25, 50))
    # An equal factor in every pair leaves no doubt, however the episodes differ.
    clean = np.array([1.0, 10.0, 100.0, 55.0])
    assert decrease_interval(clean, 0.8 * clean) == pytest.approx((20, 20, 20))
    # Unpaired, the same numbers in another order say much less.
    _, low, high = decrease_interval(clean, 0.8 * clean[::-1])
    assert low < 0 < high


def test_nothing_to_lose_is_no_number():
    assert decrease_interval([1.0], [1.0]) == (None, None, None)
    assert decrease_interval([-1, 0.5], [3, 3]) == (None, None, None)
    decrease, low, high = decrease_interval([-1, 2], [-1, 1])
    assert decrease == pytest.approx(100)
    assert low is high is None


def episodes(*scores: float) -> EpisodeResults:
    """Returns of hopper with these normalised scores."""
    low, high = -20.272305, 3234.3
    returns = low + np.array(scores) / 100 * (high - low)
    size = len(scores)
    return EpisodeResults(returns, np.full(size, 300), np.arange(size))


def around(*curve: float) -> np.ndarray:
    """Distances from one step before the disturbance's end on."""
    distances = np.full(111, np.nan)
    distances[9 : 9 + len(curve)] = curve
    return distances


@pytest.fixture
def evaluations():
    """Two checkpoints of three pairs, a knock and a change that does not end."""
    knock, mass = (
        Disturbance("knock", "knock", 5.0),
        Disturbance("mass", "dynamics", 1.5),
    )

    def evaluation(step, clean, knocked, heavy, moments, steps, alive):
        curves = [around(1, 3, 1), around(), around(2, 4)]
        recovery = [
            Recovery(
                at, None if at is None else True, up, True if at else None, late,
                curve, around(0.5, 0.5, 0.5) if curve is curves[0] else around(),
            )
            for at, up, late, curve in zip(moments, alive, steps, curves, strict=True)
        ]  # fmt: skip
        disturbed = [
            DisturbanceResults(knock, episodes(*knocked), moments, recovery),
            DisturbanceResults(mass, episodes(*heavy), [0, 0, 0], None),
        ]
        paired = PairedResults(episodes(*clean), disturbed)
        return evaluation_json(step, paired, reference_returns("hopper"))

    return [
        evaluation(
            10, [40, 60, 50], [20, 30, 50], [10, 10, 10],
            [7, 8, None], [4, None, None], [True, False, None],
        ),
        evaluation(
            20, [50, 50, 80], [40, 50, 80], [20, 20, 20],
            [9, None, 6], [0, None, 12], [None, None, True],
        ),
    ]  # fmt: skip


def test_json_has_every_entry_and_no_nan(evaluations):
    text = json.dumps(evaluations, allow_nan=False)
    knock, mass = json.loads(text)[0]["levels"]
    assert json.loads(text)[0]["clean"]["scores"] == pytest.approx([40, 60, 50])
    assert knock["disturbed_at"] == [7, 8, None]
    assert knock["recovery_steps"] == [4, None, None]
    assert knock["alive_after"] == [True, False, None]
    assert knock["distance"]["offset"][0] == -10
    assert knock["distance"]["offset"][-1] == 100
    assert knock["distance"]["mean"][9:13] == [1.5, 3.5, 1, None]
    assert knock["distance"]["count"][9:13] == [2, 2, 1, 0]
    assert knock["distance"]["clean_mean"][9:13] == [0.5, 0.5, 0.5, None]
    for entry in ("survived_knock", "alive_after", "recovery_steps", "distance"):
        assert mass[entry] is None
    assert mass["disturbed_at"] == [0, 0, 0]


def test_summary_is_over_all_checkpoints(evaluations):
    knock, mass = summarize_disturbances(evaluations)
    assert knock["clean_score"] == pytest.approx(55)
    assert knock["score"] == pytest.approx(45)
    assert knock["decrease"] == pytest.approx(100 * 10 / 55)
    assert knock["decrease_low"] < knock["decrease"] < knock["decrease_high"]
    assert knock["disturbed_share"] == pytest.approx(4 / 6)
    # Those who met it: 40, 60, 50, 80 and 20, 30, 40, 80.
    assert knock["clean_score_disturbed"] == pytest.approx(57.5)
    assert knock["score_disturbed"] == pytest.approx(42.5)
    assert knock["decrease_disturbed"] == pytest.approx(100 * 15 / 57.5)
    assert knock["survived"] == 1
    assert knock["survival"] == pytest.approx(2 / 3)  # one is not known
    assert knock["recovered_share"] == pytest.approx(3 / 4)
    assert knock["recovery_median"] == 8  # of 0, 4, 12 and never
    assert mass["decrease"] == pytest.approx(100 * 40 / 55)
    assert (
        mass["survival"] is mass["recovered_share"] is mass["recovery_median"] is None
    )


def test_without_scores_it_is_returns(evaluations, tmp_path):
    for played in evaluations:
        for each in (played["clean"], *played["levels"]):
            each["returns"] = [score - 1000 for score in each.pop("scores")]
    knock, mass = summary = summarize_disturbances(evaluations)
    assert knock["clean_return"] == pytest.approx(-945)
    assert knock["return"] == pytest.approx(-955)
    assert mass["decrease"] is None, "no percentage of what is below 0"
    assert not [key for key in knock if "score" in key]
    table = robustness_table("t", summary).splitlines()
    assert table[1].split()[:3] == ["disturbance", "clean", "return"]
    assert table[2].split()[:4] == ["knock", "-945.0", "-955.0", "-"]
    path = tmp_path / "figure.png"
    robustness_figure(summary, evaluations, path, title="t")
    assert path.read_bytes().startswith(b"\x89PNG")


def test_nobody_met_it(evaluations):
    for each in evaluations:
        each["levels"][0]["disturbed_at"] = [None] * 3
        each["levels"][0]["recovery_steps"] = [None] * 3
        each["levels"][0]["alive_after"] = [None] * 3
    knock, _ = summarize_disturbances(evaluations)
    assert knock["disturbed_share"] == 0
    assert knock["survival"] is knock["recovered_share"] is None
    assert knock["score_disturbed"] is knock["decrease_disturbed"] is None
    assert "0 %" in robustness_table("title", [knock])


def test_table_names_every_disturbance(evaluations):
    lines = robustness_table("hopper", summarize_disturbances(evaluations)).splitlines()
    assert lines[0] == "hopper"
    assert len({len(line) for line in lines[1:]}) == 1, "columns are aligned"
    assert lines[2].split()[:4] == ["knock", "55.0", "45.0", "18.2"]
    assert lines[3].split()[-4:] == ["-"] * 4


def test_curves_are_weighted_by_episodes(evaluations):
    distance = evaluations[1]["levels"][0]["distance"]
    distance["mean"][10], distance["count"][10] = 7.5, 6
    curves = distance_curves(evaluations)
    assert curves == {
        "knock": ([-1, 0, 1], [1.5, 6.5, 1.0]),  # (2 * 3.5 + 6 * 7.5) / 8
        "undisturbed": ([-1, 0, 1], [0.5, 0.5, 0.5]),
    }


@pytest.mark.parametrize("sweep", [False, True])
def test_figure_is_drawn(evaluations, tmp_path, sweep):
    summary = summarize_disturbances(evaluations)
    if sweep:  # every kind at several strengths
        summary = [row | {"strength": s} for row in summary for s in (1.0, 2.0)]
    path = tmp_path / "figure.png"
    robustness_figure(summary, evaluations, path, title="hopper")
    assert path.read_bytes().startswith(b"\x89PNG")
