"""D4RL's files, compared with a plain reading, and the one way to the network."""

from __future__ import annotations

import functools
import http.server
import threading

import pytest
from recorded_logs import make_columns, save_d4rl
from torchrl.data.datasets.d4rl_infos import D4RL_DATASETS

from torchrl_osr.lab.data import load_dataset, transitions_from_columns

NAME = "hopper-medium-v2"


def load(path, **options):
    return load_dataset(None, "d4rl", path=path, progress=False, **options)


@pytest.mark.parametrize("with_next", [True, False], ids=["v2", "v0"])
def test_columns_have_d4rls_names(tmp_path, with_next):
    columns = make_columns(with_next=with_next)
    expected, _ = transitions_from_columns(columns)
    data, manifest = load(save_d4rl(tmp_path / "set.hdf5", columns))
    assert (data == expected).all()
    assert len(manifest["data_sha256"]) == 64


def test_other_files_and_names_are_refused(tmp_path):
    path = tmp_path / "set.hdf5"
    with pytest.raises(FileNotFoundError, match="there is no file"):
        load(path)
    path.write_bytes(b"not HDF5")
    with pytest.raises(ValueError, match="cannot be read"):
        load(path)
    with pytest.raises(ValueError, match="nor a D4RL set, such as hopper-medium-v2"):
        load("hopper-media-v2")
    columns = make_columns()
    del columns["truncated"]
    with pytest.raises(ValueError, match="truncated=timeouts"):
        load(save_d4rl(path, columns))


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
        yield tmp_path / "served" / "hopper_medium-v2.hdf5", asked
        running.shutdown()


def test_a_named_set_is_fetched_once_and_only_when_asked_for(server):
    path, asked = server
    save_d4rl(path, make_columns())
    with pytest.raises(FileNotFoundError, match=r"data.download=true"):
        load(NAME)
    assert asked == []
    data, _ = load(NAME, download=True)
    again, _ = load(NAME, download=True)
    assert len(asked) == 1
    assert (again == data).all()
    assert (load(path)[0] == data).all()


def test_a_damaged_download_is_not_kept(tmp_path, server):
    path, _ = server
    with pytest.raises(OSError, match="404"):
        load(NAME, download=True)
    path.write_text("<html>moved</html>")
    with pytest.raises(ValueError, match="cannot be read"):
        load(NAME, download=True)
    assert not [*(tmp_path / "cache").rglob("*.hdf5")]
