"""Logs of your own: files, columns by name, order by step."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pyarrow
import pytest
import torch
from pyarrow import parquet
from recorded_logs import make_columns, save

from torchrl_osr.lab.data import load_dataset, transitions_from_columns
from torchrl_osr.lab.data.table import find_columns

NAMED = {"observation": ["x", "theta", "v"], "action": ["u", "w"], "episode": "run"}
WANTED = NAMED | {"reward": "cost", "terminated": "fell"}


def flat(columns):
    """Return a frame with one column for each number."""
    frame = {}
    for name, column in columns.items():
        wide = column.reshape(len(column), -1)
        names = (
            [f"{name}_{i}" for i in range(wide.shape[1])] if column.ndim > 1 else [name]
        )
        frame |= dict(zip(names, wide.T, strict=True))
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


@pytest.mark.parametrize("ending", ["npz", "hdf5", "parquet"])
def test_all_kinds_of_files_hold_the_same(tmp_path, ending):
    expected, about = transitions_from_columns(make_columns())
    path = save(tmp_path / f"log.{ending}", make_columns())
    data, manifest = load_dataset(path=path)
    assert (data == expected).all()
    assert about.items() <= (manifest | {"data_sha256": []}).items()
    path.write_bytes(path.read_bytes()[:2000])
    with pytest.raises(ValueError, match=r"log\.\w+"):
        load_dataset(path=path)


def test_usual_names_need_no_word(write):
    data, manifest = load_dataset(path=write(flat(make_columns())))
    assert (data == transitions_from_columns(make_columns())[0]).all()
    names = ["observation_0", "observation_1", "observation_2"]
    assert manifest["columns"]["observation"] == names


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("log.csv", {"sep": ";", "encoding": "utf-8-sig"}),
        ("log.csv.gz", {"sep": ";", "decimal": ","}),
        ("log.csv", {"sep": "\t", "decimal": ","}),
    ],
)
def test_separators_and_decimals_are_detected(tmp_path, name, options):
    robot().to_csv(tmp_path / name, index=False, **options)
    robot().to_csv(tmp_path / "plain.csv", index=False)
    data, expected = (
        load_dataset(path=tmp_path / each, columns=WANTED)[0]
        for each in (name, "plain.csv")
    )
    assert (data == expected).all()


def test_columns_are_taken_by_their_names(write):
    frame = robot()
    columns = {
        "observation": frame[["theta", "x", "v"]].to_numpy(),
        "action": frame[["u", "w"]].to_numpy(),
        "reward": frame["cost"].to_numpy(),
        "terminated": frame["fell"].to_numpy(),
        "episode": np.arange(120) // 40,
    }
    wanted = WANTED | {"observation": ["theta", "x", "v"]}
    data, manifest = load_dataset(path=write(frame), columns=wanted)
    assert (data == transitions_from_columns(columns)[0]).all()
    assert manifest["unused_columns"] == ["tick"]


def stamps(ticks):
    times = pd.Timestamp("2026-03-29T01:59:59+01:00") + pd.to_timedelta(ticks / 50, "s")
    return [time.isoformat() for time in times]


@pytest.mark.parametrize("clock", [lambda ticks: ticks, lambda t: t / 50, stamps])
def test_steps_bring_the_rows_of_an_episode_into_order(write, clock):
    expected, _ = load_dataset(path=write(robot()), columns=WANTED)
    ordered = robot().assign(tick=clock(robot()["tick"]))
    shuffled = ordered.sample(frac=1, random_state=0)
    wanted = WANTED | {"step": "tick"}
    data, _ = load_dataset(path=write(shuffled), columns=wanted)
    # Episodes in the order in which they come up in the file.
    order = {name: i for i, name in enumerate(shuffled["run"].unique())}
    parts = np.argsort([order[f"monday {number}"] for number in range(3)])
    ends = expected["next", "done"][:, 0].nonzero()[:, 0] + 1
    episodes = expected.split(np.diff(ends.numpy(), prepend=0).tolist())
    assert (data == torch.cat([episodes[part] for part in parts])).all()
    with pytest.raises(ValueError, match="where steps are .* a next state is missing"):
        load_dataset(path=write(ordered.drop(index=17)), columns=wanted)
    with pytest.raises(ValueError, match="the rows in another order"):
        load_dataset(path=write(shuffled), columns=WANTED)
    ordered.loc[17, "tick"] = ordered.loc[16, "tick"]
    with pytest.raises(ValueError, match="where steps are"):
        load_dataset(path=write(ordered), columns=wanted)


def test_several_files_are_one_log(tmp_path):
    columns = make_columns(120)
    halves = [
        {n: c[part] for n, c in columns.items()} for part in (slice(60), slice(60, 120))
    ]
    paths = [str(save(tmp_path / f"{i}.npz", half)) for i, half in enumerate(halves)]
    parts = [transitions_from_columns(half)[0] for half in halves]
    for path in (paths, str(tmp_path / "*.npz")):
        data, manifest = load_dataset(path=path)
        assert (data == torch.cat(parts)).all()
        assert manifest["path"] == paths
    # Episodes are numbered anew in each file.
    numbered = [half | {"episode": np.arange(60) // 40} for half in halves]
    for path, half in zip(paths, numbered, strict=True):
        del half["truncated"]
        save(tmp_path / path, half | {"terminated": np.zeros(60)})
    _, manifest = load_dataset(path=paths)
    lengths = manifest["episode_lengths"] + manifest["incomplete_lengths"]
    assert sorted(lengths) == [20, 20, 40, 40]


def test_rows_without_ends_and_values(write):
    frame = robot(theta=[np.nan, *robot()["theta"][1:]]).drop(columns="fell")
    wanted = WANTED | {"terminated": False}
    with pytest.raises(ValueError, match="'observation' has no value in row 0"):
        load_dataset(path=write(frame), columns=wanted)
    data, manifest = load_dataset(path=write(frame), columns=wanted, missing="row")
    assert not data["next", "terminated"].any()
    assert (len(data), manifest["missing_rows"]) == (120 - 3 - 1, 1)
    assert manifest["unmarked_ends"] == 3


@pytest.mark.parametrize(
    ("changes", "columns", "message"),
    [
        ({"u": "fast"}, {}, "'u' holds other than numbers: .*fast"),
        ({"fell": [0.0] * 119 + [0.5]}, {}, "'terminated' holds 0.5 in row 119"),
        (
            {},
            {"action": "force"},
            r"columns\.action=force names 0 columns; there are x",
        ),
        ({}, {"action": "x"}, "column 'x' is read twice"),
        ({}, {"episode": None}, "the data lack truncated or episode; there"),
        ({}, {"terminated": None}, "lack terminated; .*terminated=false if noth"),
    ],
)
def test_a_wrong_log_is_one_sentence(write, changes, columns, message):
    wanted = WANTED | columns
    with pytest.raises(ValueError, match=message):
        load_dataset(path=write(robot(**changes)), columns=wanted)


def test_unknown_columns_are_refused_unless_some_are_named(write):
    with pytest.raises(ValueError, match="unknown columns note"):
        load_dataset(path=write(flat(make_columns()).assign(note=1)))


def test_entries_are_in_the_order_of_their_numbers():
    names = [f"q{number}" for number in (10, 2, 0, 11)]
    others = ["action_x", "reward", "terminated", "episode"]
    columns = find_columns([*others, *names], {"observation": "q*"})
    assert columns["observation"] == ["q0", "q2", "q10", "q11"]
    asked = find_columns([*others, *names], {"observation": names})
    assert asked["observation"] == names


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ("obs_0,action,reward,reward\n1,2,3,4\n", "lack terminated"),
        ("obs_0,action,reward,terminated,episode\n1,.2,3,0,0,9\n", "more values than"),
        ("obs_0,action,reward,terminated,episode\n1,.2,3\n", "no value in row 0"),
    ],
)
def test_wrong_csv_files_are_refused(tmp_path, rows, message):
    (tmp_path / "log.csv").write_text(rows)
    with pytest.raises(ValueError, match=message):
        load_dataset(path=tmp_path / "log.csv")


def test_rows_of_other_shapes_are_refused(tmp_path):
    columns = {k: list(v) if v.ndim > 1 else v for k, v in make_columns(60).items()}
    columns["action"] = [[0.1], [0.2, 0.3, 0.1]] * 30
    parquet.write_table(pyarrow.table(columns), tmp_path / "log.parquet")
    with pytest.raises(ValueError, match="must have the same shape"):
        load_dataset(path=tmp_path / "log.parquet")
    columns = {name: np.stack([c] * 2) for name, c in make_columns(60).items()}
    with pytest.raises(ValueError, match=r"'observation' has shape \[2, 60, 3\]"):
        load_dataset(path=save(tmp_path / "log.npz", columns))
    columns = make_columns(60) | {"action": make_columns(50)["action"]}
    with pytest.raises(ValueError, match="expected equally many"):
        load_dataset(path=save(tmp_path / "log.npz", columns))
