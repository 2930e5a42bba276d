"""Logs whose columns have names of their own: found, named, refused."""

from __future__ import annotations

import gzip

import numpy as np
import pandas as pd
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from property_settings import tried
from recorded_logs import make_columns

from torchrl_osr.lab.data import load_dataset, load_file, transitions_from_rows
from torchrl_osr.lab.data.read import csv_table, recording
from torchrl_osr.lab.data.read.table import find_columns

NAMED = {"observation": ["x", "theta", "v"], "action": ["u", "w"], "episode": "run"}


def flat(columns, *, vectors=None):
    """Return a frame with one column for each number."""
    vectors = vectors or {"observation": "obs_{}", "action": "action_{}"}
    frame = {}
    for name, column in columns.items():
        if column.ndim == 1:
            frame[name] = column
        for entry in range(column.shape[1] if column.ndim > 1 else 0):
            frame[vectors[name].format(entry)] = column[:, entry]
    return pd.DataFrame(frame)


def robot(**changes):
    """Return a robot's log, whose columns are called as its driver calls them."""
    columns = make_columns(120)
    entries = [*columns["observation"].T, *columns["action"].T]
    frame = pd.DataFrame(dict(zip(["x", "theta", "v", "u", "w"], entries, strict=True)))
    frame["cost"] = columns["reward"]
    frame["fell"] = columns["terminated"].astype(int)
    frame["run"] = [f"monday {number}" for number in np.arange(120) // 40]
    frame["tick"] = np.arange(120) % 40
    return frame.assign(**changes)


WANTED = NAMED | {"reward": "cost", "terminated": "fell"}


@pytest.fixture(params=[".csv", ".parquet"])
def write(request, tmp_path):
    def write(frame):
        path = tmp_path / f"log{request.param}"
        if path.suffix == ".parquet":
            frame.to_parquet(path)
        else:
            frame.to_csv(path, index=False)
        return path

    return write


def test_usual_names_need_no_word(write):
    columns = make_columns()
    expected, about = transitions_from_rows(columns)
    data, manifest = load_file(write(flat(columns)))
    assert (data == expected).all()
    assert about.items() <= manifest.items()
    assert manifest["columns"]["observation"] == ["obs_0", "obs_1", "obs_2"]


def test_columns_are_taken_by_their_names(write):
    frame = robot()
    columns = {
        "observation": frame[["theta", "x", "v"]].to_numpy(),
        "action": frame[["u", "w"]].to_numpy(),
        "reward": frame["cost"].to_numpy(),
        "terminated": frame["fell"].to_numpy(),
        "episode": np.arange(120) // 40,
    }
    expected, _ = transitions_from_rows(columns)
    wanted = WANTED | {"observation": ["theta", "x", "v"]}
    data, manifest = load_file(write(frame), columns=wanted)
    assert (data == expected).all()
    assert manifest["unused_columns"] == ["tick"]


def test_steps_bring_the_rows_of_an_episode_into_order(write):
    expected, _ = load_file(write(robot()), columns=WANTED)
    shuffled = robot().sample(frac=1, random_state=0)
    # By the order in which they come up in the file.
    order = {name: i for i, name in enumerate(shuffled["run"].unique())}
    data, _ = load_file(write(shuffled), columns=WANTED | {"step": "tick"})
    parts = np.argsort([order[f"monday {number}"] for number in range(3)])
    episodes = expected.split(episode_lengths(expected))
    assert (data == torch.cat([episodes[part] for part in parts])).all()
    with pytest.raises(ValueError, match="comes back in row"):
        load_file(write(shuffled), columns=WANTED)


def episode_lengths(data):
    ends = data["next", "done"][:, 0].nonzero()[:, 0] + 1
    return np.diff(ends.numpy(), prepend=0).tolist()


def test_a_step_that_is_missing_or_doubled_is_refused(write):
    wanted = WANTED | {"step": "tick"}
    with pytest.raises(ValueError, match=r"from 'tick' 16 to 18, where steps are 1"):
        load_file(write(robot().drop(index=17)), columns=wanted)
    with pytest.raises(ValueError, match="'tick' has no (number|value) in row 3"):
        load_file(write(robot(tick=[*[0.0] * 3, None, *range(116)])), columns=wanted)
    doubled = robot()
    doubled.loc[17, "tick"] = 16
    with pytest.raises(ValueError, match=r"has 'tick' 16 twice"):
        load_file(write(doubled), columns=wanted)


def test_a_task_that_never_ends(write):
    frame = robot().drop(columns="fell")
    with pytest.raises(
        ValueError, match=r"lack terminated; .*terminated=false if noth"
    ):
        load_file(write(frame), columns=NAMED | {"reward": "cost"})
    data, manifest = load_file(write(frame), columns=WANTED | {"terminated": False})
    assert not data["next", "terminated"].any()
    assert manifest["unmarked_ends"] == 3
    assert manifest["dropped_rows"] == 3


@pytest.mark.parametrize(
    ("changes", "columns", "message"),
    [
        ({"u": "fast"}, WANTED, "'u' holds 'fast' in row 0 of 120; expected numbers"),
        ({"cost": [*[1.0] * 7, "?", *[1.0] * 112]}, WANTED, "'cost' holds .* in row 7"),
        (
            {"theta": [np.nan] + [1.0] * 119},
            WANTED,
            "holds nan in row 0|has no value in row 0",
        ),
        ({"fell": [None] + [True] * 119}, WANTED, "'fell' has no value in row 0"),
        (
            {"walk": [0.0] * 60 + [np.nan] * 2 + [1.0] * 58},
            WANTED | {"episode": "walk"},
            "'episode' holds nan in row 60 of 120; exp|'walk' has no value in row 60",
        ),
        (
            {"walk": ["a"] * 60 + [None] * 2 + ["b"] * 58},
            WANTED | {"episode": "walk"},
            "'walk' has no value in (2 rows, the first of them|row) 60",
        ),
        ({"fell": 0.5}, WANTED, "'terminated' holds 0.5 in row 0"),
        (
            {"w": 7.0},
            WANTED,
            r"'action' leaves its bounds in 120 .*data\.action_bounds",
        ),
        ({}, WANTED | {"action": "force"}, "no column 'force', named for action; the "),
        (
            {},
            WANTED | {"action": "x"},
            "column 'x' is named for observation and action",
        ),
        ({}, WANTED | {"reward": "*"}, r"columns.reward='\*' .* names 9 columns; exp"),
        ({}, WANTED | {"observation": 3}, "observation=3 .*expected the name of a col"),
        ({}, WANTED | {"speed": "v"}, "columns has no entry speed; it has observation"),
        (
            {},
            WANTED | {"episode": None},
            "the data lack truncated or episode; the file",
        ),
        ({}, WANTED | {"episode": None, "step": "tick"}, "lack truncated or episode"),
        ({}, {}, r"lack observation, action, reward, .*data\.columns\.observation="),
        (
            {"done": 0},
            {k: v for k, v in WANTED.items() if k != "terminated"},
            r"'done' does not say whether the task ended \(data\.columns\.terminated",
        ),
    ],
)
def test_what_is_wrong_with_a_log_is_one_sentence(write, changes, columns, message):
    frame = robot()
    for name, value in changes.items():
        text = isinstance(value, list) and any(isinstance(each, str) for each in value)
        frame[name] = [each and str(each) for each in value] if text else value
    with pytest.raises(ValueError, match=message):
        load_file(write(frame), columns=columns)


def test_an_entry_that_is_missing_is_named(write):
    frame = flat(make_columns()).drop(columns="obs_1")
    with pytest.raises(ValueError, match="obs_0, obs_2, but none with the number 1"):
        load_file(write(frame))
    data, _ = load_file(write(frame), columns={"observation": ["obs_0", "obs_2"]})
    assert data["observation"].shape[1] == 2


@tried(50)
@given(st.permutations([f"q{number}" for number in range(12)]), st.booleans())
def test_entries_are_in_the_order_of_their_numbers(names, named):
    others = ["action_x", "reward", "terminated", "episode"]
    others += [] if named else ["tail_1", "tail_0"]
    wanted = {"observation": "q*"}
    layout = find_columns([*others, *names], wanted)
    assert layout.columns["observation"] == [f"q{number}" for number in range(12)]
    asked = {"observation": list(names)}
    assert find_columns([*names, *others], asked).columns["observation"] == names


def test_numbers_of_entries_may_be_huge():
    names = ["act", "reward", "terminal", "timeout", "obs_1", f"obs_{10**18}"]
    with pytest.raises(ValueError, match="but none with the number 2:"):
        find_columns(names, {})


def test_columns_of_unequal_length_are_refused(tmp_path):
    columns = make_columns(60) | {"episode": np.arange(60) // 40, "t": np.arange(50)}
    np.savez(tmp_path / "log.npz", **columns)
    with pytest.raises(ValueError, match=r"columns have .*'step': \(50,\).* equally"):
        load_file(tmp_path / "log.npz", columns={"step": "t"})


def test_entries_without_a_common_numbering_stay_in_the_files_order():
    names = ["obs_pos_1", "obs_vel_1", "obs_pos_0", "obs_vel_0", "act"]
    names += ["reward", "terminal", "timeout"]
    assert find_columns(names, {}).columns["observation"] == names[:4]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "is no CSV file, or damaged"),
        (b"\xff\xfe\x00", "is no CSV file, or damaged"),
        (b"a;b;c\n1;2;3\n", "expected the names of at least two columns, separated by"),
        (b",obs_0,action\n0,1,2\n", "column 1 has no name. pandas writes one"),
        (b"0.1,0.2,0.3\n1,2,3\n", "the first line holds numbers, 0.1, 0.2, 0.3"),
        (b"obs_0,action,reward,reward\n1,2,3,4\n", "two columns are called 'reward'"),
        (b"obs_0,action,reward,terminated,episode\n", "the data hold no rows"),
        (
            b"obs_0,action,reward,terminated,episode\n1,.2,3,0,0\n1,.2,3,0,0,9\n",
            "is no CSV file, or damaged: .*line 3",
        ),
        (
            b"obs_0,action,reward,terminated,episode\n1,.2,3,0,0,9\n1,.2,3,0,0,9\n",
            "is no CSV file, or damaged",
        ),
        (
            b"obs_0,action,reward,terminated,episode\n1,.2,3\n",
            "holds nan|has type float",
        ),
    ],
)
@pytest.mark.parametrize("packed", [False, True])
def test_deviating_csv_files_are_refused(tmp_path, content, message, packed):
    path = tmp_path / ("log.csv.gz" if packed else "log.csv")
    path.write_bytes(gzip.compress(content) if packed else content)
    with pytest.raises(ValueError, match=message):
        load_file(path)


def test_a_small_file_that_unpacks_to_a_large_one_is_refused(tmp_path, monkeypatch):
    path = tmp_path / "log.csv.gz"
    path.write_bytes(gzip.compress(b"a,b\n" + bytes(10_000_000)))
    monkeypatch.setattr("torchrl_osr._files.MAX_UNPACKED_BYTES", 1_000_000)
    with pytest.raises(ValueError, match=r"log\.csv\.gz would unpack to [\d,]+ bytes"):
        load_file(path)
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(ValueError, match="is no CSV file, or damaged"):
        load_file(path)


@tried(10)
@given(part=st.integers(1, 200), chunk=st.integers(1, 200))
def test_a_csv_file_in_parts_of_any_size(tmp_path_factory, part, chunk):
    folder = tmp_path_factory.mktemp("csv")
    columns = make_columns(150)
    path = folder / "log.csv.gz"
    flat(columns).to_csv(path, index=False)
    expected, _ = transitions_from_rows(columns)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TORCHRL_OSR_CACHE", str(folder / "cache"))
        patch.setattr(csv_table, "ROWS_AT_A_TIME", part)
        patch.setattr(recording, "CHUNK_ROWS", chunk)
        stored, _ = load_file(path, on_disk=True, progress=False)
    assert (stored == expected).all()


@pytest.mark.parametrize("part", [3, 8, 12, 100])
def test_episodes_may_be_called_by_numbers_and_by_texts(tmp_path, monkeypatch, part):
    """Whichever parts the file is read in, in memory and on disk."""
    monkeypatch.setenv("TORCHRL_OSR_CACHE", str(tmp_path / "cache"))
    frame = flat(make_columns(24)).drop(columns="truncated")
    frame["episode"] = ["007"] * 10 + ["0"] * 4 + ["a"] * 10
    frame.to_csv(tmp_path / "log.csv", index=False)
    monkeypatch.setattr(csv_table, "ROWS_AT_A_TIME", part)
    monkeypatch.setattr(recording, "CHUNK_ROWS", part)
    for on_disk in (False, True):
        options = {"on_disk": on_disk, "progress": False}
        _, manifest = load_file(tmp_path / "log.csv", **options)
        lengths = manifest["episode_lengths"] + manifest["incomplete_lengths"]
        assert sorted(lengths) == [4, 10, 10]


def test_bounds_come_from_the_environment_unless_they_are_given(tmp_path):
    columns = make_columns()
    columns["action"] = 2 * columns["action"][:, :1]
    path = str(tmp_path / "log.csv")
    flat(columns).to_csv(path, index=False)
    data, _ = load_dataset("pendulum", "file", path=path, env_id="Pendulum-v1")
    expected, _ = transitions_from_rows(columns, action_bounds=(-2, 2))
    assert (data == expected).all()
    data, manifest = load_dataset(
        "pendulum",
        "file",
        path=path,
        env_id="Pendulum-v1",
        action_bounds=[[-4.0], [4.0]],
    )
    assert manifest["action_bounds"] == [[-4.0], [4.0]]
    assert (data == transitions_from_rows(columns, action_bounds=(-4, 4))[0]).all()
    with pytest.raises(ValueError, match=r"action_bounds=\[1.0\]; expected the lowest"):
        load_dataset("pendulum", "file", path=path, action_bounds=[1.0])
    with pytest.raises(ValueError, match=r"leaves its bounds .*data\.clip_actions=tr"):
        load_dataset("pendulum", "file", path=path)
    _, manifest = load_dataset("pendulum", "file", path=path, clip_actions=True)
    assert "rows had an action outside of its bounds" in manifest["warnings"][0]


def test_options_without_a_use_are_refused(tmp_path):
    named = {"observation": ["x"]}
    with pytest.raises(ValueError, match=r"data\.columns=.* has no use with data=med"):
        load_dataset("hopper", "medium", columns=named)
    with pytest.raises(ValueError, match=r"data\.clip_actions=True has no use"):
        load_dataset("hopper", "medium", clip_actions=True)
    with pytest.raises(ValueError, match=r"data\.columns has no use with data=d4rl"):
        load_dataset("hopper", "d4rl", path="x.hdf5", columns=named)
    with pytest.raises(
        ValueError, match=r"data\.columns\.action has no use with data=m"
    ):
        load_dataset("hopper", "minari", path="x", columns={"action": "u"})
