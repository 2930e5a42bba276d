"""Reading in parts gives the rows of reading at once, whatever the parts are."""

from __future__ import annotations

import itertools
import os
from unittest import mock

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from property_settings import tried
from recorded_logs import make_columns, save

from torchrl_osr.lab.data import load_dataset, recording, transitions_from_columns
from torchrl_osr.lab.data.store import is_memory_mapped
from torchrl_osr.lab.data.transitions import Reading

pytestmark = pytest.mark.usefixtures("cache")


NUMBERS = itertools.count()


@st.composite
def recordings(draw):
    """Return columns of some steps, one in ten with a flaw."""
    count = draw(st.integers(1, 30))
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    rows = {
        "observation": rng.normal(size=(count, 2)).astype(draw(st.sampled_from("fd"))),
        "action": rng.uniform(-1, 1, (count, 1)),
        "reward": rng.normal(size=count),
        "terminated": rng.random(count) < draw(st.sampled_from([0, 0.1, 0.5])),
    }
    kinds = draw(st.sampled_from(["truncated", "episode", "both"]))
    if kinds != "episode":
        rows["truncated"] = rng.random(count) < draw(st.sampled_from([0, 0.2, 1]))
    if kinds != "truncated":
        ends = rows["terminated"] | rows.get("truncated", False)
        ends = ends | (rng.random(count) < 0.2)
        rows["episode"] = np.r_[0, np.cumsum(ends)[:-1]]
        if draw(st.integers(0, 9)) == 0:
            rows["episode"] %= 2  # some come back
    if draw(st.booleans()):
        rows["next_observation"] = rng.normal(size=(count, 2))
        after = np.roll(rows["next_observation"], 1, axis=0)
        resets = rng.random(count) < 0.2
        rows["observation"][resets] = after[resets]
        rows["reward"][resets] = 0
    if draw(st.integers(0, 9)) == 0:
        rows["reward"][rng.integers(count)] = np.nan
    return rows


@tried(80)
@given(columns=recordings(), size=st.integers(1, 40), rows=st.integers(1, 40))
def test_parts_of_any_size_give_the_same(columns, size, rows):
    count = len(columns["reward"])
    starts = range(0, count, size)
    chunks = [{n: c[i : i + size] for n, c in columns.items()} for i in starts]

    def parts():
        return recording.whole_trajectories(chunks)

    about = {"source": "test", "number": next(NUMBERS)}
    in_parts = recording.Recording(parts, Reading(), about, total=count)
    try:
        data, manifest = transitions_from_columns(columns)
    except ValueError:
        data = None
    with mock.patch.object(recording, "CHUNK_ROWS", rows):
        if data is None:
            with pytest.raises(ValueError, match="no value|comes back|true next state"):
                in_parts.load()
            return
        stored, described = in_parts.load(on_disk=True)
    assert is_memory_mapped(stored)
    assert (stored == data).all()
    assert manifest.items() <= described.items()


def test_options_and_the_file_are_part_of_the_cached_set(tmp_path, cache):
    path = save(tmp_path / "log.npz", make_columns())
    for bounds in ((-1, 1), (-2, 2), (-1, 1)):
        data, _ = load_dataset(path=path, action_bounds=bounds, on_disk=True)
        expected, _ = transitions_from_columns(make_columns(), action_bounds=bounds)
        assert (data == expected).all()
    assert len(list((cache / "recorded").glob("file-*/"))) == 2
    save(path, make_columns(100))
    os.utime(path, ns=(0, 0))  # clocks may be coarse
    assert len(load_dataset(path=path, on_disk=True)[0]) < 100
