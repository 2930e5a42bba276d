"""Differences between methods: of pairs, or refused."""

from __future__ import annotations

import re
import runpy
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from torchrl_osr.report.figures import all_methods
from torchrl_osr.report.paired import ALL_DATA, compare, difference, pair
from torchrl_osr.report.quantities import level_quantities, quantities
from torchrl_osr.report.sections_paired import paired_section

fakes = SimpleNamespace(**runpy.run_path(str(Path(__file__).with_name("fakes.py"))))
write, level, suite, read = (
    fakes.write_hand,
    fakes.hand_level,
    fakes.hand_suite,
    fakes.read_all,
)


def test_pairs_are_of_one_checkpoint_and_episode():
    own = {(1, 10): 5.0, (1, 11): 7.0, (2, 10): 1.0, (2, 11): 2.0}
    reference = {(1, 10): 4.0, (1, 11): 4.0, (2, 10): 0.0, (2, 11): 0.0}
    np.testing.assert_array_equal(pair(own, reference), [(1 + 1) / 2, (3 + 2) / 2])
    del reference[2, 11]
    with pytest.raises(ValueError, match=r"1 episodes .* step 2 with episode seed 11"):
        pair(own, reference)


def test_interval_of_a_known_shift_contains_it_as_often_as_it_says():
    # 8 seeds of 10 episodes, shifted by 3. The percentile bootstrap over 8 values holds
    # the truth in about 0.88 of the cases, a little more for the resampled episodes;
    # 80 cases: standard error 0.04.
    rng = np.random.default_rng(0)
    hits = 0
    for _ in range(80):
        runs = [3 + rng.normal() + rng.normal(size=10) for _ in range(8)]
        found = difference([runs])
        hits += found.low <= 3 <= found.high
    assert 0.78 <= hits / 80 <= 0.98


def both(folder, shift, *, seeds=(0, 1, 2), env="hopper", **options):
    """Write two methods that differ by a shift in every episode, and lose 10 and 4."""
    for seed in seeds:
        for name, more, lost in (("cql", 0, 10), ("osr", shift, 4)):
            scores = [20.0 + seed + more, 60.0 + more]
            low = level("x", [each - lost for each in scores])
            write(
                folder / f"{env}-{name}{seed}", {5: scores}, seed=seed, env=env,
                suite=suite((5, [1, 2], scores, [low])), loss=fakes.LOSSES[name],
                **options,
            )  # fmt: skip


@pytest.mark.parametrize(
    ("shift", "verdict"), [(2, "better"), (-2, "worse"), (0, "not told apart")]
)
def test_a_known_shift_is_found_without_the_spread_of_seeds(tmp_path, shift, verdict):
    both(tmp_path, shift)
    runs = read(tmp_path)
    score, under, lost = quantities(runs)
    (found,) = compare(runs, "osr", "cql", score)
    assert found.difference[:3] == pytest.approx((shift,) * 3, abs=1e-9)
    assert found.verdict == verdict
    assert (found.seeds, found.note) == (3, "")
    (found,) = compare(runs, "osr", "cql", under)
    assert found.difference.mean == pytest.approx(shift + 6)
    (found,) = compare(runs, "osr", "cql", lost)
    assert found.difference.mean == pytest.approx(-6)
    assert found.verdict == "better"  # fewer are
    (each,) = level_quantities(runs, "hand")
    assert compare(runs, "osr", "cql", each)[0].difference.mean == pytest.approx(
        shift + 6
    )


def test_an_interval_with_zero_tells_nothing_apart(tmp_path):
    for seed, more in enumerate((-4.0, 0.0, 5.0)):
        write(
            tmp_path / f"cql{seed}",
            {5: [1.0, 2.0]},
            seed=seed,
            loss=fakes.LOSSES["cql"],
        )
        write(tmp_path / f"osr{seed}", {5: [1 + more, 2 + more]}, seed=seed)
    runs = read(tmp_path)
    (found,) = compare(runs, "osr", "cql", quantities(runs)[0])
    assert found.verdict == "not told apart"
    assert found.difference.low < 0 < found.difference.mean < found.difference.high


@pytest.mark.parametrize(("seeds", "marked"), [((0,), True), ((0, 1), False)])
def test_the_tables_mark_an_interval_of_one_seed(tmp_path, seeds, marked):
    both(tmp_path, 2, seeds=seeds)
    runs = read(tmp_path)
    page = paired_section(runs, "cql", all_methods(runs), tmp_path)
    # Three quantities, and the score under the one disturbance.
    intervals = re.findall(r"<small>(\[.*?)</small>", page)
    assert len(intervals) == 4
    assert all(each.endswith("] ᵉ") == marked for each in intervals)


def test_data_sets_count_the_same_and_come_last_together(tmp_path):
    both(tmp_path, 2, seeds=(0,))
    both(tmp_path, 8, env="walker2d")
    runs = read(tmp_path)
    found = compare(runs, "osr", "cql", quantities(runs)[0])
    assert [each.data for each in found] == [
        "hopper medium-replay", "walker2d medium-replay", ALL_DATA,
    ]  # fmt: skip
    assert [each.difference.mean for each in found] == pytest.approx([2, 8, 5])
    overs = [each.difference.over for each in found]
    assert overs == ["episodes", "seeds", "episodes"], "one has a single seed"
    assert found[2].seeds == 4


def test_what_does_not_match_is_refused_or_said(tmp_path):
    both(tmp_path, 2, seeds=(0, 1))
    fakes.write_run(tmp_path / "alone", {5: [1.0, 2.0]}, seed=7)
    changes = {"network.layer_norm": False}
    fakes.write_run(tmp_path / "later", {9: [1.0, 2.0]}, loss={"_target_": "x.Later"})
    fakes.write_run(tmp_path / "unlike", {5: [1.0, 2.0]}, loss={"_target_": "x.Unlike"},
                    changes=changes, versions={"torch": "1"})  # fmt: skip
    fakes.write_run(tmp_path / "seedless", {5: [1.0, 2.0]}, seed=8,
                    loss={"_target_": "x.Seedless"})  # fmt: skip
    runs = read(tmp_path)
    score, under, _ = quantities(runs)
    (found,) = compare(runs, "osr", "cql", score)
    assert (found.seeds, found.note) == (2, "only seeds that both have")
    (found,) = compare(runs, "Later", "cql", score)
    assert found.verdict == "not paired"
    assert "4 episodes have no partner, the first at step 5" in found.note
    (found,) = compare(runs, "Seedless", "cql", score)
    assert found.note == "they have no seed in common"
    (found,) = compare(runs, "Unlike", "cql", score)
    assert found.difference is not None
    assert "they differ in network.layer_norm, versions" in found.note
    assert compare(runs, "Unlike", "cql", under) == []
