"""Differences between methods: of pairs, or refused; and a verdict, or none."""

from __future__ import annotations

import pytest
from lab.report import fakes

from torchrl_osr.lab.report.comparisons import (
    ALL_DATA,
    MIN_SEEDS,
    compare,
    compare_all,
    quantities,
    verdict,
)

SEEDS = range(MIN_SEEDS)
TWO_SEEDS = f"too few seeds (2 of {MIN_SEEDS})"


def both(folder, shift, *, seeds=SEEDS, env="hopper"):
    """Write two methods that differ by a shift in every episode, and lose 10 and 4.

    At the first of two checkpoints they differ by one less, at the second by one more.
    """
    for seed in seeds:
        for name, more, lost in (("cql", 0, 10), ("osr", shift, 4)):
            scores = [20.0 + seed + more, 60.0 + more]
            low = fakes.level("x", [each - lost for each in scores])
            more_at = {4: -1, 5: 1} if name == "osr" else {4: 0, 5: 0}
            curve = {at: [each + by for each in scores] for at, by in more_at.items()}
            fakes.write_run(
                folder / f"{env}-{name}{seed}", curve, seed=seed, env=env,
                suite=fakes.suite_of((5, [1, 2], scores, [low])), choice=name,
            )  # fmt: skip


@pytest.mark.parametrize(
    ("shift", "seeds", "wanted"),
    [
        (2, SEEDS, "better"),
        (-2, SEEDS, "worse"),
        (0, SEEDS, "no significant difference"),
        (2, SEEDS[:2], TWO_SEEDS),
    ],
)
def test_a_known_shift_is_found_without_spread(tmp_path, shift, seeds, wanted):
    both(tmp_path, shift, seeds=seeds)
    tables = fakes.read_all(tmp_path)
    score, under, lost = quantities(tables)
    (found,) = compare(tables, "osr", "cql", score)
    assert found.estimate[:3] == pytest.approx((shift,) * 3, abs=1e-9)
    assert (found.verdict, found.seeds, found.note) == (wanted, len(seeds), "")
    (found,) = compare(tables, "osr", "cql", under)
    assert found.estimate.mean == pytest.approx(shift + 6)
    (found,) = compare(tables, "osr", "cql", lost)
    assert found.estimate.mean == pytest.approx(-6)
    assert found.verdict == ("better" if len(seeds) == MIN_SEEDS else TWO_SEEDS)
    sentences = verdict(compare_all(tables, "cql"), "cql")
    if wanted in ("better", "worse"):
        number = f"{shift:+.1f} [".replace("-", "\N{MINUS SIGN}")
        place = "undisturbed score on hopper medium-replay"
        assert sentences[0].startswith(f"osr is {wanted} than cql in {place}: {number}")
    else:
        assert f"Undisturbed score, {wanted}: osr against cql." in sentences


def test_data_sets_have_equal_weight_and_come_last_together(tmp_path):
    both(tmp_path, 2, seeds=(0,))
    both(tmp_path, 8, seeds=(0, 1, 2), env="walker2d")
    tables = fakes.read_all(tmp_path)
    found = compare(tables, "osr", "cql", quantities(tables)[0])
    sets = ["hopper medium-replay", "walker2d medium-replay", ALL_DATA]
    assert [each.data for each in found] == sets
    assert [each.estimate.mean for each in found] == pytest.approx([2, 8, 5])
    overs = [each.estimate.over for each in found]
    assert overs == ["episodes", "seeds", "episodes"], "one has a single seed"
    assert [each.seeds for each in found] == [1, 3, 1]
    for file in tmp_path.glob("hopper-*/robustness-hand.json"):
        file.unlink()  # played on one data set
    tables = fakes.read_all(tmp_path)
    name = quantities(tables)[1].name.capitalize()
    assert any(name in each for each in verdict(compare_all(tables, "cql"), "cql"))


def test_what_cannot_be_paired_is_refused_or_noted(tmp_path):
    both(tmp_path, 2, seeds=(0, 1))
    fakes.write_run(tmp_path / "alone", {5: [1.0, 2.0]}, seed=7)
    fakes.write_run(tmp_path / "clean", {5: [1.0, 2.0]}, choice="clean")
    fakes.write_run(tmp_path / "z", {5: [1.0, 2.0]}, choice="seedless", seed=8)
    fakes.write_run(tmp_path / "m", {5: [30.0, 70.0], 6: [0.0] * 2}, choice="more")
    tables = fakes.read_all(tmp_path)
    score, under, _ = quantities(tables)
    (found,) = compare(tables, "more", "cql", score)
    assert found.estimate[:3] == pytest.approx((10,) * 3), "of the same checkpoint"
    (found,) = compare(tables, "osr", "cql", score)
    assert (found.seeds, found.note) == (2, "only episodes that both have")
    (found,) = compare(tables, "seedless", "cql", score)
    assert found.verdict == "not compared"
    assert found.note.startswith("they have no episode in common")
    assert compare(tables, "clean", "cql", under) == []


def test_disturbances_that_were_not_met_enter_no_verdict(tmp_path):
    never = {"disturbed_at": [None, None]}
    for seed in SEEDS:
        for name, met in (("cql", {}), ("falls", never)):
            scores = [20.0 + seed, 60.0]
            levels = [
                fakes.knock("early", [each - 5 for each in scores]),
                fakes.knock("late", [each - 8 * (not met) for each in scores], **met),
            ]
            fakes.write_run(
                tmp_path / f"{name}{seed}", {5: scores}, seed=seed, choice=name,
                suite=fakes.suite_of((5, [1, 2], scores, levels)),
            )  # fmt: skip
    tables = fakes.read_all(tmp_path)
    _, _, lost = quantities(tables)
    (found,) = compare(tables, "falls", "cql", lost)
    assert found.estimate.mean == pytest.approx(0), "of the early one alone"
    assert found.note == "without late, not met by both"
    rows = lost.rows[lost.rows["disturbance"] == "late"]
    (found,) = compare(tables, "falls", "cql", lost._replace(rows=rows))
    assert found.verdict == "not compared"
    assert found.note.startswith("no disturbance was met by both")
