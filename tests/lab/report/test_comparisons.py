"""Differences between methods: of pairs, or refused; and a verdict, or none."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from lab.report import fakes

from torchrl_osr.lab.report import compare, quantities
from torchrl_osr.lab.report.comparisons import (
    ALL_DATA,
    MIN_SEEDS,
    compare_all,
    pair,
    suite_quantities,
    verdict,
)

SEEDS = range(MIN_SEEDS)


def test_pairs_are_of_one_checkpoint_and_episode():
    steps = [(1, 10), (1, 11), (2, 10), (2, 11)]
    numbers = {"osr": [5.0, 7.0, 1.0, 2.0], "cql": [4.0, 4.0, 0.0, 0.0]}
    values = pd.Series(
        {
            (method, 0, *at): value
            for method, row in numbers.items()
            for at, value in zip(steps, row, strict=True)
        }
    ).rename_axis(["method", "seed", "step", "episode"])
    (found,), note = pair(values, "osr", "cql")
    np.testing.assert_array_equal(found, [(1 + 1) / 2, (3 + 2) / 2])
    assert not note
    found, note = pair(values.drop(("cql", 0, 2, 11)), "osr", "cql")
    assert not found
    assert "1 episode without a partner, the first of seed 0 at step 2 with" in note


def both(folder, shift, *, seeds=SEEDS, env="hopper", **options):
    """Write two methods that differ by a shift in every episode, and lose 10 and 4."""
    for seed in seeds:
        for name, more, lost in (("cql", 0, 10), ("osr", shift, 4)):
            scores = [20.0 + seed + more, 60.0 + more]
            low = fakes.hand_level("x", [each - lost for each in scores])
            fakes.write_hand(
                folder / f"{env}-{name}{seed}", {5: scores}, seed=seed, env=env,
                suite=fakes.hand_suite((5, [1, 2], scores, [low])),
                loss=fakes.LOSSES[name], choice=name, **options,
            )  # fmt: skip


@pytest.mark.parametrize(
    ("shift", "seeds", "told"),
    [
        (2, SEEDS, "better"),
        (-2, SEEDS, "worse"),
        (0, SEEDS, "not told apart"),
        (2, SEEDS[1:], f"cannot be told: {MIN_SEEDS - 1} seeds"),
        (2, [0], "cannot be told: 1 seed"),
    ],
)
def test_a_known_shift_is_found_without_the_spread_of_seeds(
    tmp_path, shift, seeds, told
):
    both(tmp_path, shift, seeds=seeds)
    tables = fakes.read_all(tmp_path)
    score, under, lost = quantities(tables)
    (found,) = compare(tables, "osr", "cql", score)
    assert found.estimate[:3] == pytest.approx((shift,) * 3, abs=1e-9)
    assert (found.verdict, found.seeds, found.note) == (told, len(seeds), "")
    (found,) = compare(tables, "osr", "cql", under)
    assert found.estimate.mean == pytest.approx(shift + 6)
    (found,) = compare(tables, "osr", "cql", lost)
    assert found.estimate.mean == pytest.approx(-6)
    assert found.verdict == ("better" if len(seeds) == MIN_SEEDS else told)  # fewer are
    (each,) = suite_quantities(tables, "hand")
    (found,) = compare(tables, "osr", "cql", each)
    assert found.estimate.mean == pytest.approx(shift + 6)
    sentences = verdict(compare_all(tables, "cql", [score]), "cql")
    first = "osr is {} than cql in undisturbed score on hopper medium-replay: {}"
    if told in ("better", "worse"):
        number = f"{shift:+.1f} [".replace("-", "\N{MINUS SIGN}")
        assert sentences[0].startswith(first.format(told, number))
    else:
        assert sentences[0] == f"osr against cql in undisturbed score: {told}."
    assert ("A verdict needs" in sentences[-1]) == told.startswith("cannot")


def test_an_interval_with_zero_tells_nothing_apart(tmp_path):
    for seed, more in enumerate((-4.0, 0.0, 5.0, -3.0, 4.0)):
        fakes.write_run(tmp_path / f"cql{seed}", {5: [1.0, 2.0]}, seed=seed,
                        choice="cql")  # fmt: skip
        fakes.write_run(tmp_path / f"osr{seed}", {5: [1 + more, 2 + more]}, seed=seed)
    tables = fakes.read_all(tmp_path)
    (found,) = compare(tables, "osr", "cql", quantities(tables)[0])
    assert found.verdict == "not told apart"
    assert found.estimate.low < 0 < found.estimate.mean < found.estimate.high


def test_data_sets_count_the_same_and_come_last_together(tmp_path):
    both(tmp_path, 2, seeds=(0,))
    both(tmp_path, 8, seeds=(0, 1, 2), env="walker2d")
    tables = fakes.read_all(tmp_path)
    found = compare(tables, "osr", "cql", quantities(tables)[0])
    assert [each.data for each in found] == [
        "hopper medium-replay", "walker2d medium-replay", ALL_DATA,
    ]  # fmt: skip
    assert [each.estimate.mean for each in found] == pytest.approx([2, 8, 5])
    overs = [each.estimate.over for each in found]
    assert overs == ["episodes", "seeds", "episodes"], "one has a single seed"
    assert [each.seeds for each in found] == [1, 3, 1]


def test_what_does_not_match_is_refused_or_said(tmp_path):
    both(tmp_path, 2, seeds=(0, 1))

    def more(name, scores, **options):
        fakes.write_run(tmp_path / name, scores, choice=name, **options)

    fakes.write_run(tmp_path / "alone", {5: [1.0, 2.0]}, seed=7)
    more("later", {9: [1.0, 2.0]})
    more("clean", {5: [1.0, 2.0]})
    more("seedless", {5: [1.0, 2.0]}, seed=8)
    tables = fakes.read_all(tmp_path)
    score, under, _ = quantities(tables)
    (found,) = compare(tables, "osr", "cql", score)
    assert (found.seeds, found.note) == (2, "only seeds that both have")
    (found,) = compare(tables, "later", "cql", score)
    assert found.verdict == "not paired"
    assert "4 episodes without a partner, the first of seed 0 at step 5" in found.note
    (found,) = compare(tables, "seedless", "cql", score)
    assert found.note == "they have no seed in common"
    assert compare(tables, "clean", "cql", under) == []
