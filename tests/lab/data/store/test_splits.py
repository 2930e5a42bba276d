"""Held-out rows and mixtures: exact shares, every row once."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tensordict import TensorDict

from torchrl_osr.lab.data import mix_datasets, split_held_out


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


@pytest.mark.parametrize(("held_out", "expected"), [(7, 7), (0.2, 10)])
def test_split_keeps_every_row_once(held_out: int | float, expected: int) -> None:
    data = numbered(50)
    train, rest = split_held_out(data, held_out, seed=1)
    again, _ = split_held_out(data, held_out, seed=1)
    other, _ = split_held_out(data, held_out, seed=2)
    assert len(rest) == expected
    both = torch.cat([train["row"], rest["row"]])
    assert torch.equal(both.sort().values, torch.arange(50))
    assert torch.equal(train["row"], again["row"])
    assert not torch.equal(train["row"], other["row"])


@pytest.mark.parametrize("held_out", [0, 50, 0.0, 1.0, -1])
def test_split_with_an_empty_side_is_refused(held_out: int | float) -> None:
    with pytest.raises(ValueError, match="at least one row on each side"):
        split_held_out(numbered(50), held_out, seed=0)
