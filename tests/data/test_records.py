"""Records, taken apart with nothing but ``struct``."""

from __future__ import annotations

import struct

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from torchrl_osr.data.records import RecordLayout

RECORD = struct.Struct("<2f f 2f f 2? 2x I")


def transitions(rows: int, observations: int = 2, actions: int = 1) -> TensorDict:
    generator = torch.Generator().manual_seed(rows)
    numbers = torch.randn(rows, 2 * observations + actions + 1, generator=generator)
    sizes = (observations, actions, observations, 1)
    state, action, after, reward = torch.split(numbers, sizes, dim=1)
    flags = torch.rand(rows, 2, generator=generator) < 0.3
    following = {
        "observation": after,
        "reward": reward,
        "done": flags.any(1, keepdim=True),
        "terminated": flags[:, :1],
        "truncated": flags[:, 1:],
    }
    root = {"observation": state, "action": action}
    return TensorDict(root | {"next": TensorDict(following, [rows])}, [rows])


def test_a_record_is_these_bytes() -> None:
    data = transitions(9)
    layout = RecordLayout.of(data)
    content = layout.pack(data).tobytes()
    assert layout.dtype.itemsize == RECORD.size == 32
    weights = [int(each) for each in np.random.PCG64(0).random_raw(8)]
    for row, record in zip(data, RECORD.iter_unpack(content), strict=True):
        expected = torch.cat([
            row["observation"], row["action"],
            row["next", "observation"], row["next", "reward"],
        ]).tolist()  # fmt: skip
        assert list(record[:6]) == expected
        assert record[6] == row["next", "terminated"].item()
        assert record[7] == row["next", "truncated"].item()
        words = struct.unpack("<7I", RECORD.pack(*record)[:28])
        total = weights[0] + sum(a * w for a, w in zip(weights[1:], words, strict=True))
        assert record[8] == total % 2**64 >> 32


@pytest.mark.parametrize("sizes", [(1, 1), (11, 3), (17, 6)])
def test_what_is_packed_comes_back(sizes: tuple[int, int]) -> None:
    data = transitions(50, *sizes)
    layout = RecordLayout.of(data)
    again = layout.unpack(layout.pack(data))
    assert (again == data).all()
    assert all(again[key].is_contiguous() for key in again.keys(True, True))
    assert again["next", "terminated"].dtype == torch.bool


def test_every_flipped_bit_is_found() -> None:
    data = transitions(3)
    layout = RecordLayout.of(data)
    content = layout.pack(data).tobytes()
    for bit in range(8 * RECORD.size):
        damaged = bytearray(content)
        damaged[RECORD.size + bit // 8] ^= 1 << bit % 8
        with pytest.raises(ValueError, match="checksum") as caught:
            layout.unpack(np.frombuffer(bytes(damaged), layout.dtype))
        assert caught.value.args[1] == 1  # the row


def test_rows_of_zeros_are_not_rows() -> None:
    layout = RecordLayout(2, 1)
    with pytest.raises(ValueError, match="checksum"):
        layout.unpack(np.zeros(4, layout.dtype))
