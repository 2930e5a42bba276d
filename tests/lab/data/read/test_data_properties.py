"""Any recorded episodes: the transitions are right, or there is an error by name.

The reference walks through the episodes step by step in plain Python. How many examples
are tried is read from ``TORCHRL_OSR_PROPERTY_EXAMPLES``, for
``benchmarks/data_properties.py``, which also counts what came of them.
"""

from __future__ import annotations

import os
import tempfile
from collections import Counter
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from unittest import mock

import minari
import numpy as np
import property_settings
import pytest
from gymnasium import spaces
from hypothesis import assume, given
from hypothesis import strategies as st
from minari.data_collector import EpisodeBuffer
from recorded_logs import save

from torchrl_osr.lab.data import (
    check_dataset,
    export_minari,
    load_file,
    load_minari,
    transitions_from_episodes,
    transitions_from_rows,
)

OUTCOMES: Counter[str] = Counter()

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning:minari")
tried = property_settings.tried(40)

DTYPES = ["float16", "float32", "float64", "int32", ">f4"]
SCALES = [1.0, 1.0, 1.0, 1e-3, 1e3, 1e-30, 1e-300, 1e30, 0.0]
FLAWS = {
    "nan": ("observation", np.nan),
    "infinity": ("reward", -np.inf),
    "too large": ("observation", 1e300),
    "action out of bounds": ("action", 1.5),
    "nan action": ("action", np.nan),
    "no flag": ("terminated", 0.5),
}
SHAPES = ["short", "wide", "deep", "text", "objects"]


@st.composite
def recordings(draw, flawed=True, shortest=0):
    """Return episodes, and the name of what is wrong with them, or ``None``."""
    observations, actions = draw(st.integers(1, 3)), draw(st.integers(1, 2))
    dtype, scale = draw(st.sampled_from(DTYPES)), draw(st.sampled_from(SCALES))
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    episodes = []
    for steps in draw(st.lists(st.integers(shortest, 5), min_size=1, max_size=4)):
        end = draw(st.sampled_from(["terminated", "truncated", "neither", "both"]))
        last = np.arange(steps) == steps - 1
        numbers = rng.normal(size=(steps + 1, observations)) * scale
        with np.errstate(over="ignore", invalid="ignore"):
            numbers = numbers.astype(dtype)
        episodes.append(
            {
                "observation": numbers,
                "action": rng.uniform(-1, 1, (steps, actions)),
                "reward": rng.normal(size=steps) * min(scale, 1e30),
                "terminated": last & (end in ("terminated", "both")),
                "truncated": last & (end in ("truncated", "both")),
            }
        )
    flaw = None
    if flawed and draw(st.booleans()):
        flaw = draw(st.sampled_from([*FLAWS, *SHAPES]))
    long = [each for each in episodes if len(each["reward"])]
    if flaw and long:
        spoil(draw(st.sampled_from(long)), flaw, rng)
    return episodes, flaw if long else None


def spoil(episode, flaw, rng):
    if flaw in FLAWS:
        name, value = FLAWS[flaw]
        column = episode[name].astype(np.float64)
        column[rng.integers(len(episode["reward"]))] = value
        episode[name] = column
        return
    action = episode["action"]
    episode["action"] = {
        "short": action[:-1],
        "wide": np.concatenate([action, action[:, :1]], 1)[:, :, None],
        "deep": action[..., None, None],
        "text": action.astype(str),
        "objects": action.astype(object),
    }[flaw]


def reference(episodes, *, last_known):
    """Step by step; ``last_known``: whether the observation after the last is read."""
    out = SimpleNamespace(rows=[], dropped=0, returns=[])
    for episode in episodes:
        steps = len(episode["reward"])
        kept = []
        for step in range(steps):
            fell, cut = episode["terminated"][step], episode["truncated"][step]
            end = step == steps - 1
            after = episode["observation"][step + 1]
            if end and not last_known:
                if not fell:
                    out.dropped += 1
                    break
                after = episode["observation"][step]
            row = [episode["observation"][step], episode["action"][step], after]
            kept.append([*row, episode["reward"][step], fell, cut])
        if kept and not kept[-1][4]:
            kept[-1][5] = True
        out.rows += kept
        if steps and (episode["terminated"][-1] or episode["truncated"][-1]):
            out.returns.append(sum(map(float, episode["reward"])))
    return out


def compare(what, load, episodes, flaw, *, last_known=True):
    """Require the reference's numbers, or a named error where there is a reason."""
    wanted = None if flaw else reference(episodes, last_known=last_known)
    if wanted:
        with np.errstate(over="ignore"):
            columns = [
                np.array([row[i] for row in wanted.rows], np.float32) for i in (0, 1, 2)
            ]
            columns[1] = np.clip(columns[1], -0.999, 0.999)
        finite = all(np.isfinite(column).all() for column in columns)
        if not wanted.rows or not finite or not all(c.any() for c in columns):
            flaw = "nothing, not finite or all zero"
    refusal = None
    try:
        data, manifest = load()
    except ValueError as error:
        refusal = str(error)
    if refusal is not None:
        assert flaw, f"refused without a reason: {refusal}"
        assert refusal
        OUTCOMES[f"{what}: refused, {flaw}"] += 1
        return
    assert not flaw, f"accepted in spite of {flaw}"
    check_dataset(data)
    for key, column in zip(
        ("observation", "action", ("next", "observation")), columns, strict=True
    ):
        assert np.array_equal(data[key].numpy(), column), key
    for index, key in ((3, "reward"), (4, "terminated"), (5, "truncated")):
        got = data["next", key][:, 0].numpy()
        assert np.array_equal(got, np.array([r[index] for r in wanted.rows], got.dtype))
    assert manifest["dropped_rows"] == wanted.dropped
    assert np.allclose(manifest["episode_returns"], wanted.returns, rtol=1e-9, atol=0)
    OUTCOMES[f"{what}: right"] += 1


@tried
@given(recordings())
def test_episodes(recording):
    episodes, flaw = recording
    compare(
        "episodes",
        lambda: transitions_from_episodes(episodes),
        episodes,
        flaw,
    )


def flat(episodes, *, with_next):
    """One array a column, and the number of its episode beside each row."""
    long = [each for each in episodes if len(each["reward"])]
    rows = {
        name: np.concatenate([each[name] for each in long])
        for name in ("action", "reward", "terminated", "truncated")
    }
    observations = [each["observation"] for each in long]
    rows["observation"] = np.concatenate([each[:-1] for each in observations])
    if with_next:
        rows["next_observation"] = np.concatenate([each[1:] for each in observations])
    steps = [len(each["reward"]) for each in long]
    rows["episode"] = np.repeat(np.arange(len(long)), steps)
    return rows


@tried
@given(
    recordings(shortest=1),
    st.sampled_from([None, ".npz", ".hdf5", ".parquet"]),
    st.booleans(),
)
def test_rows_and_files(recording, kind, with_next):
    episodes, flaw = recording
    # Such arrays cannot be put together, or into such a file.
    assume(flaw not in SHAPES or (not kind and flaw not in ("wide", "deep")))
    rows = flat(episodes, with_next=with_next)
    with tempfile.TemporaryDirectory() as folder:
        load = lambda: transitions_from_rows(rows)  # noqa: E731
        if kind:
            path = Path(folder) / f"log{kind}"
            save(path, rows)
            load = lambda: load_file(path)  # noqa: E731
        what = f"{kind or 'rows'}{' with next' if with_next else ''}"
        compare(what, load, episodes, flaw, last_known=with_next)


def boxes(array):
    return spaces.Box(-np.inf, np.inf, array.shape[1:], array.dtype.type)


@tried
@given(
    recordings(flawed=False, shortest=1),
    st.sampled_from(["hdf5", "arrow", "parquet"]),
    st.booleans(),
)
def test_minari(recording, data_format, dictionary):
    episodes, _ = recording
    for each in episodes:
        each["observation"] = each["observation"].astype(np.float64)
        each["action"] = each["action"].astype(np.float32)
    first = episodes[0]
    space = boxes(first["observation"])
    if dictionary:
        space = spaces.Dict(b=space, a=spaces.Dict(d=space, c=space))
    buffers = [
        EpisodeBuffer(
            observations=in_dictionary(each["observation"], dictionary),
            actions=each["action"],
            rewards=each["reward"],
            terminations=each["terminated"],
            truncations=each["truncated"],
        )
        for each in episodes
    ]
    if dictionary:
        for each in episodes:
            numbers = each["observation"]
            each["observation"] = np.concatenate([-numbers, 2 * numbers, numbers], 1)
    with minari_folder():
        minari.create_dataset_from_buffers(
            "any/set-v0",
            buffers,
            observation_space=space,
            action_space=spaces.Box(-1, 1, first["action"].shape[1:]),
            data_format=data_format,
        )
        load = lambda: load_minari("any/set-v0", progress=False)  # noqa: E731
        compare(f"minari {data_format}", load, episodes, None)


def in_dictionary(numbers, dictionary):
    if not dictionary:
        return numbers
    return {"b": numbers, "a": {"d": 2 * numbers, "c": -numbers}}


@contextmanager
def minari_folder():
    """A home of its own for Minari's sets."""
    with (
        tempfile.TemporaryDirectory() as folder,
        mock.patch.dict(os.environ, MINARI_DATASETS_PATH=folder),
    ):
        yield


@tried
@given(recordings(flawed=False, shortest=1), st.sampled_from(["hdf5", "arrow"]))
def test_export_and_back(recording, data_format):
    episodes, _ = recording
    try:
        data, _ = transitions_from_episodes(episodes)
    except ValueError:
        OUTCOMES["export: no data"] += 1
        return
    with minari_folder():
        export_minari(data, "any/set-v0", data_format=data_format)
        again, _ = load_minari("any/set-v0", progress=False)
    assert (again == data).all()
    OUTCOMES[f"export {data_format}: right"] += 1
