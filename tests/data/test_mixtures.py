"""Mixtures: exact shares, every row from where it says, the number fixed."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tensordict import TensorDict

from torchrl_osr.data import load_local_dataset, load_mixture, mix_datasets


def numbered(rows: int, start: int = 0) -> TensorDict:
    return TensorDict({"row": torch.arange(start, start + rows)}, [rows])


@given(rows=st.integers(1, 50), share=st.floats(0, 1), seed=st.integers(0, 1000))
def test_rows_are_drawn_without_replacement_in_exact_shares(rows, share, seed) -> None:
    mixed = mix_datasets(
        numbered(rows), numbered(60, start=100), random_share=share, seed=seed
    )["row"].tolist()
    number = round(share * rows)
    assert len(mixed) == len(set(mixed)) == rows
    assert sum(row >= 100 for row in mixed) == number
    assert all(row < rows for row in mixed[: rows - number])
    again = mix_datasets(
        numbered(rows), numbered(60, start=100), random_share=share, seed=seed
    )
    assert again["row"].tolist() == mixed


def test_each_row_has_its_chance() -> None:
    counts = torch.zeros(10)
    for seed in range(1000):
        mixed = mix_datasets(
            numbered(10), numbered(10, start=100), random_share=0.7, seed=seed
        )["row"]
        counts[mixed[:3]] += 1
    # Binomial, 1000 draws with probability 0.3: 300 +- 14.5; five of them.
    assert (counts - 300).abs().max() < 73


@pytest.mark.parametrize("share", [-0.1, 1.1])
def test_a_share_out_of_range_is_refused(share) -> None:
    with pytest.raises(ValueError, match=rf"in \[0, 1\], got {share}"):
        mix_datasets(numbered(10), numbered(10), random_share=share, seed=0)


def test_too_few_random_rows_are_refused() -> None:
    expected = r"random_share=0.5 of 10 rows is 5, but the random set has 4"
    with pytest.raises(ValueError, match=expected):
        mix_datasets(numbered(10), numbered(4), random_share=0.5, seed=0)


def test_a_local_mixture_says_what_it_is_made_of(tmp_path) -> None:
    request = {"num_transitions": 2000, "seed": 3, "cache_dir": tmp_path}
    valuable, _ = load_local_dataset("hopper", "medium", **request)
    random, _ = load_local_dataset("hopper", "random", **request)
    data, manifest = load_mixture("hopper", "medium", random_share=0.9, **request)
    assert manifest["rows"] == {"medium": 200, "random": 1800}
    for rows, source in ((data[:200], valuable), (data[200:], random)):
        known = {tuple(row.tolist()) for row in source["observation"]}
        assert all(tuple(row.tolist()) in known for row in rows["observation"])
    scores = {
        name: source["normalized_score"] for name, source in manifest["sources"].items()
    }
    expected = 0.1 * scores["medium"] + 0.9 * scores["random"]
    assert manifest["normalized_score"] == pytest.approx(expected)


def test_without_random_rows_it_is_the_level_itself(tmp_path) -> None:
    request = {"num_transitions": 50, "seed": 3, "cache_dir": tmp_path}
    data, manifest = load_mixture("hopper", "random", random_share=0.0, **request)
    level, wanted = load_local_dataset("hopper", "random", **request)
    assert manifest == wanted
    assert bool((data == level).all())
