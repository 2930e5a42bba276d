"""D4RL's files, compared with a plain reading, and the one way to the network."""

from __future__ import annotations

import functools
import http.server
import threading

import h5py
import numpy as np
import pytest
from recorded_logs import make_columns, save_d4rl
from torchrl.data.datasets.d4rl_infos import D4RL_DATASETS

from torchrl_osr.lab.data import load_d4rl, transitions_from_rows

NAME = "hopper-medium-v2"


@pytest.mark.parametrize("with_next", [True, False], ids=["v2", "v0"])
def test_the_columns_have_other_names(tmp_path, with_next):
    columns = make_columns(with_next=with_next)
    expected, about = transitions_from_rows(columns)
    data, manifest = load_d4rl(save_d4rl(tmp_path / "set.hdf5", columns))
    assert (data == expected).all()
    assert about.items() <= manifest.items()
    assert len(manifest["data_sha256"]) == 64


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"reward": None}, "is no D4RL file: it lacks rewards"),
        ({"truncated": None}, "is no D4RL file: it lacks timeouts"),
        ({"reward": np.full(300, np.nan)}, "'reward' holds nan in row 0 of 300"),
        ({"action": np.ones((299, 3))}, r"'action' has shape \[299, 3\]"),
        ({"observation": np.zeros((300, 3))}, "'observation' is zero in all"),
    ],
)
def test_deviations_are_named(tmp_path, changes, message):
    columns = make_columns() | changes
    save_d4rl(
        tmp_path / "set.hdf5", {k: v for k, v in columns.items() if v is not None}
    )
    with pytest.raises(ValueError, match=message):
        load_d4rl(tmp_path / "set.hdf5")


def test_other_files_and_names_are_refused(tmp_path):
    path = tmp_path / "set.hdf5"
    with pytest.raises(FileNotFoundError, match="there is no file"):
        load_d4rl(path)
    path.write_bytes(b"not HDF5")
    with pytest.raises(ValueError, match="is no HDF5 file, or damaged"):
        load_d4rl(path)
    with pytest.raises(ValueError, match="nor a D4RL set, such as hopper-medium-v2"):
        load_d4rl("hopper-media-v2")
    with h5py.File(path, "w") as file:
        file.create_group("observations")
    with pytest.raises(ValueError, match="'observations' is no array with rows"):
        load_d4rl(path)


@pytest.fixture
def server(tmp_path, monkeypatch):
    """A server in place of D4RL's; returns its folder and what it was asked for."""
    (tmp_path / "served").mkdir()
    asked = []

    class Quiet(http.server.SimpleHTTPRequestHandler):
        def log_message(self, *_):
            asked.append(self.path)

    handler = functools.partial(Quiet, directory=str(tmp_path / "served"))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as running:
        serve = functools.partial(running.serve_forever, poll_interval=0.01)
        threading.Thread(target=serve, daemon=True).start()
        address = f"http://127.0.0.1:{running.server_port}/hopper_medium-v2.hdf5"
        monkeypatch.setitem(D4RL_DATASETS, NAME, address)
        monkeypatch.setenv("no_proxy", "*")
        monkeypatch.setenv("TORCHRL_OSR_CACHE", str(tmp_path / "cache"))
        yield tmp_path / "served", asked
        running.shutdown()


def cached(tmp_path):
    return [p.name for p in (tmp_path / "cache").rglob("*") if p.suffix == ".hdf5"]


def test_a_named_set_is_fetched_once_and_only_when_told(tmp_path, server):
    folder, asked = server
    save_d4rl(folder / "hopper_medium-v2.hdf5", make_columns())
    with pytest.raises(FileNotFoundError, match=r"fetch it with download=True"):
        load_d4rl(NAME)
    assert asked == []
    data, manifest = load_d4rl(NAME, download=True)
    assert len(asked) == 1
    again, other = load_d4rl(NAME)
    load_d4rl(NAME, download=True)
    assert len(asked) == 1
    assert (again == data).all()
    own, _ = load_d4rl(folder / "hopper_medium-v2.hdf5")
    assert (own == data).all()
    assert manifest == other


def test_a_wrong_or_missing_file_is_not_kept(tmp_path, server):
    folder, _ = server
    with pytest.raises(OSError, match="404"):
        load_d4rl(NAME, download=True)
    save_d4rl(folder / "hopper_medium-v2.hdf5", make_columns())
    content = (folder / "hopper_medium-v2.hdf5").read_bytes()
    (folder / "hopper_medium-v2.hdf5").write_bytes(content[:-1000])
    with pytest.raises(ValueError, match="is no HDF5 file, or damaged"):
        load_d4rl(NAME, download=True)
    (folder / "hopper_medium-v2.hdf5").write_text("<html>moved</html>")
    with pytest.raises(ValueError, match="is no HDF5 file"):
        load_d4rl(NAME, download=True)
    columns = make_columns()
    del columns["terminated"]
    save_d4rl(folder / "hopper_medium-v2.hdf5", columns)
    with pytest.raises(ValueError, match="lacks terminals"):
        load_d4rl(NAME, download=True)
    assert cached(tmp_path) == []
