"""The data's next action, from memory and from disk, held-out rows or not."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from numbered_episodes import LENGTHS, episodes
from property_settings import tried

from torchrl_osr.lab.data import (
    check_order,
    make_replay_buffer,
    next_action,
    write_memmap,
)


@tried(20)
@given(LENGTHS)
def test_it_is_what_the_episode_did_next(lengths) -> None:
    data = episodes(lengths)
    check_order(data)
    wanted, row = [], 0
    for length in lengths:
        wanted += [data["action"][row + step].item() for step in range(1, length)] + [0]
        row += length
    assert next_action(data).squeeze(-1).tolist() == wanted


@tried(20)
@given(LENGTHS, st.randoms(use_true_random=False))
def test_drawn_from_disk_it_is_the_same(tmp_path_factory, lengths, random) -> None:
    data = episodes([*lengths, 3])
    chosen = random.sample(range(len(data)), k=random.randrange(len(data)))
    left_out = torch.tensor(sorted(chosen), dtype=torch.long)
    stored, _ = write_memmap([data], tmp_path_factory.mktemp("set") / "data")

    def read(data, rows):
        batch = data[rows]
        batch["next", "action"] = next_action(data, rows)
        return batch

    options = {"batch_size": 64, "seed": 0, "read": read}
    buffer = make_replay_buffer(stored, left_out=left_out, **options)
    data["next", "action"] = next_action(data)
    batch = buffer.sample()
    rows = (batch["observation"] == data["observation"].squeeze(-1)).int().argmax(-1)
    assert not set(rows.tolist()) & set(chosen)
    assert (batch == data[rows]).all()


def test_rows_in_no_order_are_refused_by_number() -> None:
    data = episodes([4, 5])
    for wrong in (data[[0, 2, 3, 4, 5, 6, 7, 8]], data[[0, 2, 1, 3]]):
        with pytest.raises(ValueError, match="row 0 the first, end no episode"):
            check_order(wrong)
    with pytest.raises(ValueError, match="1 of the 8 rows, row 7 the first"):
        check_order(data[:-1])
    check_order(data[4:])


def test_rows_in_memory_are_not_read_anew() -> None:
    with pytest.raises(ValueError, match="give the rows as they are"):
        make_replay_buffer(episodes([3]), batch_size=1, seed=0, read=next_action)
