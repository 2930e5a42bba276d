"""Reading from disk, compared with the same rows in memory."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from torchrl_osr.data import (
    TransitionsOnDisk,
    make_replay_buffer,
    observation_statistics,
    replay_buffer,
    split_held_out,
    split_on_disk,
    write_on_disk,
)
from torchrl_osr.data.manifest import sealed
from torchrl_osr.data.on_disk import observations

ROWS, ROW_BYTES = 200, 44  # 3 + 2 + 3 + 1 numbers, flags and the checksum


def transitions() -> TensorDict:
    generator = torch.Generator().manual_seed(0)
    state = torch.randn(ROWS, 3, generator=generator) * torch.tensor([1.0, 1e-5, 9.0])
    ended = torch.rand(ROWS, 1, generator=generator) < 0.2
    following = {
        "observation": torch.randn(ROWS, 3, generator=generator),
        "reward": torch.randn(ROWS, 1, generator=generator),
        "done": ended,
        "terminated": ended,
        "truncated": torch.zeros_like(ended),
    }
    action = torch.rand(ROWS, 2, generator=generator)
    root = {"observation": state, "action": action}
    return TensorDict(root | {"next": TensorDict(following, [ROWS])}, [ROWS])


@pytest.fixture
def folder(tmp_path):
    folder = tmp_path / "set"
    write_on_disk(lambda done: [(transitions(), {})], folder, progress=False)
    return folder


@pytest.fixture(params=[0, 70, ROWS + 1], ids=lambda rows: f"{rows} held")
def stored(folder, request):
    """Return the set with none, some or all of its rows in memory."""
    stored = TransitionsOnDisk(folder)
    stored.hold(request.param * ROW_BYTES)
    assert stored.held == min(request.param, ROWS)
    return stored


def test_any_rows_in_any_order(stored):
    data = transitions()
    for index in ([5], [], [3, 199, 0, 3], list(range(ROWS))):
        rows = torch.tensor(index, dtype=torch.long)
        assert (stored[rows] == data[rows]).all()
        assert stored[rows].shape == rows.shape


@pytest.mark.parametrize("index", [[-1], [0, 200], [2**40]])
def test_rows_that_are_not_there(stored, index):
    with pytest.raises(IndexError, match=r"there are 200, counted from 0"):
        stored[torch.tensor(index)]


@pytest.mark.parametrize("index", [3, slice(4), [1, 2], torch.zeros(2, 2)])
def test_other_indices_are_refused(stored, index):
    with pytest.raises(IndexError, match=r"expected row numbers, a tensor \[B\]"):
        stored[index]


@pytest.mark.parametrize("left_out", [[0], [199], [0, 1, 2, 198, 199], [7, 70, 71]])
def test_rows_that_are_left_out(stored, left_out):
    data, rows = transitions(), torch.tensor(left_out)
    mask = torch.ones(ROWS, dtype=torch.bool)
    mask[rows] = False
    rest = stored.without(rows)
    assert len(rest) == ROWS - len(rows)
    assert (rest[torch.arange(len(rest))] == data[mask]).all()
    with pytest.raises(IndexError, match="there are"):
        rest[torch.tensor([len(rest)])]
    with pytest.raises(ValueError, match="left out already"):
        rest.without(rows)


def test_the_same_seed_draws_the_same_rows(stored):
    here = make_replay_buffer(transitions(), batch_size=32, seed=3)
    there = make_replay_buffer(stored, batch_size=32, seed=3)
    for _ in range(10):
        assert (here.sample() == there.sample()).all()
    assert len(there) == ROWS
    with pytest.raises(RuntimeError):
        there.extend(transitions())


@pytest.mark.parametrize("held_out", [7, 0.2])
def test_the_split_is_that_of_memory(stored, held_out):
    train, rest = split_held_out(transitions(), held_out, seed=1)
    train_there, rest_there = split_on_disk(stored, held_out, seed=1)
    assert (rest_there == rest).all()
    assert len(train_there) == len(train)
    assert (train_there[torch.arange(len(train))] == train).all()
    with pytest.raises(ValueError, match="at least one row on each side"):
        split_on_disk(stored, ROWS, seed=1)


def test_of_many_held_out_rows_some_are_read(stored, monkeypatch):
    monkeypatch.setattr(replay_buffer, "MAX_HELD_OUT", 10)
    train, rest = split_on_disk(stored, 0.2, seed=1)
    _, all_of_them = split_held_out(transitions(), 0.2, seed=1)
    assert (len(train), len(rest)) == (160, 10)
    for row in rest["observation"]:
        assert (all_of_them["observation"] == row).all(1).any()


def test_statistics_are_those_of_memory(stored):
    for here, there in zip(
        observation_statistics(transitions()),
        observation_statistics(stored),
        strict=True,
    ):
        torch.testing.assert_close(there, here, rtol=1e-6, atol=1e-9)
        assert there.dtype == torch.float32


def test_some_observations(stored):
    assert torch.equal(observations(transitions()), transitions()["observation"])
    assert torch.equal(observations(stored), transitions()["observation"])
    assert len(observations(stored, 9)) == 9


def test_a_flipped_byte_is_found_when_its_row_is_read(folder):
    content = bytearray((folder / "rows.bin").read_bytes())
    content[100 * ROW_BYTES + 5] ^= 1
    (folder / "rows.bin").write_bytes(content)
    for held in (0, ROWS * ROW_BYTES):
        stored = TransitionsOnDisk(folder)
        stored.hold(held)
        rows = torch.tensor([0, 99, 101, 199])
        assert (stored[rows] == transitions()[rows]).all()
        with pytest.raises(ValueError, match=r"is damaged: the checksum.*row 100\."):
            stored[torch.tensor([99, 100])]
        with pytest.raises(ValueError, match=r"row 100\. Delete .* write it again"):
            stored.without(torch.tensor([3, 5]))[torch.tensor([98])]


def test_a_short_file_is_refused(folder):
    stored = TransitionsOnDisk(folder)
    with (folder / "rows.bin").open("r+b") as file:
        file.truncate(ROWS * ROW_BYTES - 1)
    with pytest.raises(ValueError, match=r"has 8,799 bytes; 200 rows have 8,800"):
        TransitionsOnDisk(folder)
    with pytest.raises(ValueError, match="has become shorter"):
        stored[torch.tensor([ROWS - 1])]
    with pytest.raises(ValueError, match="has become shorter"):
        stored.hold()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"format_version": 99}, "format_version is 99; this version reads 1"),
        ({"num_transitions": "200"}, "num_transitions .* is '200'; expected a number"),
        ({"num_transitions": True}, "num_transitions"),
        ({"num_transitions": 201}, "has 8,800 bytes; 201 rows have"),
        ({"observation_size": 4}, "no mean of the observation: expected 4 numbers"),
        ({"observation_size": 10**9}, "observation_size"),
        ({"action_size": -1}, "action_size"),
        ({"action_size": 3}, "has 8,800 bytes; 200 rows have"),
        ({"observation": {"mean": [0.0] * 3}}, "no std of the observation"),
        ({"observation": {"mean": ["0"] * 3, "std": [1.0] * 3}}, "no mean of the"),
        ({"observation": {"mean": [np.nan] * 3, "std": [1.0] * 3}}, "no mean of the"),
        ({"reward": None}, "no min of the reward"),
    ],
)
def test_a_wrong_manifest_is_refused(folder, changes, message):
    path = folder / "manifest.json"
    path.write_text(json.dumps(sealed(json.loads(path.read_text()) | changes)))
    with pytest.raises(ValueError, match=message):
        TransitionsOnDisk(folder)


def test_a_changed_manifest_is_refused(folder):
    path = folder / "manifest.json"
    path.write_text(path.read_text().replace('"max": ', '"max": 1'))
    with pytest.raises(ValueError, match="the seal of its manifest.json is wrong"):
        TransitionsOnDisk(folder)


def test_what_is_no_set_is_refused(folder, tmp_path):
    with pytest.raises(FileNotFoundError, match="that write_on_disk has written"):
        TransitionsOnDisk(tmp_path)
    (folder / "manifest.json").write_text("[]")
    with pytest.raises(ValueError, match="holds no object"):
        TransitionsOnDisk(folder)
