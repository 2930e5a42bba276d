"""One's own logs give the same transitions from all three kinds of file."""

from __future__ import annotations

import io
import pickle
import zipfile

import numpy as np
import pyarrow
import pytest
from pyarrow import parquet
from recorded_logs import make_columns, save

from torchrl_osr.lab.data import load_file, transitions_from_rows

EMPTY = pyarrow.list_(pyarrow.float32())


@pytest.fixture(params=[".npz", ".hdf5", ".parquet"])
def path(request, tmp_path):
    return tmp_path / f"log{request.param}"


def test_deviations_are_named_in_every_kind_of_file(path):
    rows = make_columns(60)
    rows["reward"][7] = np.inf
    with pytest.raises(ValueError, match="'reward' holds inf in row 7 of 60"):
        load_file(save(path, rows))
    with pytest.raises(ValueError, match="unknown columns 'return'"):
        load_file(save(path, make_columns(60) | {"return": rows["reward"]}))
    with pytest.raises(ValueError, match="lack action"):
        load_file(
            save(path, {k: v for k, v in make_columns(60).items() if k != "action"})
        )


def test_empty_files_are_refused(path):
    rows = make_columns(60)
    if path.suffix == ".parquet":
        pairs = pyarrow.array([], EMPTY)
        empty = {k: pairs if v.ndim > 1 else v[:0] for k, v in rows.items()}
        parquet.write_table(pyarrow.table(empty), path)
    else:
        save(path, {name: column[:0] for name, column in rows.items()})
    with pytest.raises(ValueError, match="the data hold no rows"):
        load_file(path)


def test_damaged_files_are_named(path):
    content = save(path, make_columns(60)).read_bytes()
    for damaged in (b"", b"nothing of the kind", content[: len(content) // 2]):
        path.write_bytes(damaged)
        with pytest.raises(ValueError, match=r"log\.\w+ is no .*, or damaged"):
            load_file(path)
    path.unlink()
    with pytest.raises(FileNotFoundError, match="there is no file"):
        load_file(path)


def test_nothing_is_unpickled(tmp_path):
    objects = np.array([{"a": 1}] * 60, dtype=object)
    np.savez(tmp_path / "log.npz", **(make_columns(60) | {"reward": objects}))
    with pytest.raises(ValueError, match="no NumPy archive of plain arrays"):
        load_file(tmp_path / "log.npz")
    (tmp_path / "log.npz").write_bytes(pickle.dumps(make_columns(60)))
    with pytest.raises(ValueError, match="no NumPy archive of plain arrays"):
        load_file(tmp_path / "log.npz")
    with (tmp_path / "log.npz").open("wb") as file:
        np.save(file, np.ones(3))
    with pytest.raises(ValueError, match="it is a single array"):
        load_file(tmp_path / "log.npz")
    with pytest.raises(
        ValueError, match=r"must end in one of \.csv, \.csv\.gz, \.parquet"
    ):
        load_file(tmp_path / "log.pkl")


def test_two_arrays_of_one_name_are_refused(tmp_path):
    path = tmp_path / "log.npz"
    np.savez(path, **make_columns(60))
    content = io.BytesIO()
    np.save(content, np.zeros(60))
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("reward", content.getvalue())
    with pytest.raises(ValueError, match="two arrays in it are called 'reward'"):
        load_file(path)


def test_two_parquet_columns_of_one_name_are_refused(tmp_path):
    columns = {k: list(v) if v.ndim > 1 else v for k, v in make_columns(60).items()}
    table = pyarrow.table(columns)
    table = table.append_column("reward", table["reward"])
    parquet.write_table(table, tmp_path / "log.parquet")
    with pytest.raises(ValueError, match="two columns are called 'reward'"):
        load_file(tmp_path / "log.parquet")


@pytest.mark.parametrize(
    ("name", "column", "message"),
    [
        ("action", [[0.1], [0.2, 0.3]] * 30, "1 numbers in row 0, 2 in row 1"),
        (
            "action",
            [[0.1, 0.2]] * 59 + [[0.1, None]],
            "'action' has no value in row 59",
        ),
        ("action", [[0.1, 0.2]] * 59 + [None], "'action' has no value in row 59"),
        ("reward", [1.0] * 59 + [None], "'reward' has no value in row 59"),
        ("reward", ["a"] * 60, "'reward' holds 'a' in row 0 of 60; expected"),
        ("action", [[]] * 60, r"'action' holds \[\] in row 0 of 60; expected numbers"),
        ("action", pyarrow.array([[]] * 60, EMPTY), r"'action' has shape \[60, 0\]"),
        ("action", [[["a"]]] * 60, r"'action' holds .* in row 0 of 60; expected numb"),
    ],
)
def test_what_only_parquet_can_hold_is_named(tmp_path, name, column, message):
    path = tmp_path / "log.parquet"
    columns = {k: list(v) if v.ndim > 1 else v for k, v in make_columns(60).items()}
    parquet.write_table(pyarrow.table(columns | {name: column}), path)
    with pytest.raises(ValueError, match=message):
        load_file(path)


def test_columns_that_are_not_read_do_not_count(tmp_path, monkeypatch):
    rows = make_columns(60)
    pictures = {"observation_image": np.zeros((60, 5000), np.float32)}
    path = save(tmp_path / "log.parquet", rows | pictures)
    monkeypatch.setattr("torchrl_osr._files.MAX_UNPACKED_BYTES", 10_000)
    names = {name: name for name in rows}
    assert len(load_file(path, columns=names)[0])


def test_one_value_is_no_column(tmp_path):
    path = tmp_path / "log.npz"
    for name, value in {"reward": 1.0, "episode": "first"}.items():
        np.savez(path, **(make_columns(60) | {name: np.array(value)}))
        with pytest.raises(ValueError, match=f"'{name}' is one value"):
            load_file(path)


def test_episodes_may_be_called_by_bytes(tmp_path):
    columns = make_columns(20)
    del columns["truncated"]
    columns["episode"] = np.array([b"first"] * 12 + [b"second"] * 8)
    np.savez(tmp_path / "log.npz", **columns)
    _, manifest = load_file(tmp_path / "log.npz")
    assert sorted(manifest["incomplete_lengths"]) == [8, 12]


def test_lists_of_a_fixed_size_are_read(tmp_path):
    columns = {k: v for k, v in make_columns(60).items() if v.ndim == 1}
    for name in ("observation", "action"):
        array = make_columns(60)[name]
        columns[name] = pyarrow.FixedSizeListArray.from_arrays(
            array.ravel(), array.shape[1]
        )
    parquet.write_table(pyarrow.table(columns), tmp_path / "log.parquet")
    data, _ = load_file(tmp_path / "log.parquet")
    assert (data == transitions_from_rows(make_columns(60))[0]).all()
