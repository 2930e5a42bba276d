"""Files: what was written comes back, and what is damaged or foreign is refused."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from torchrl_osr import _files


def test_a_file_is_written_whole_or_stays_as_it_was(tmp_path):
    path = tmp_path / "file.json"
    _files.write_json(path, {"a": [1.0, float("nan")]})
    with pytest.raises(ZeroDivisionError), _files.whole_file(path) as file:
        _ = file.write(b"half") // 0
    assert _files.read_json(path) == {"a": [1.0, None]}
    assert list(tmp_path.iterdir()) == [path]
    with pytest.raises(OSError, match=r"cannot write the file.*nowhere"):
        _files.write_json(tmp_path / "nowhere" / "file.json", {})


def test_other_files_are_no_json(tmp_path):
    no, path = "is no JSON", tmp_path / "card.json"
    for content, message in ((b"\xff{}", no), (b"[1]", "holds no object"), (b"{", no)):
        path.write_bytes(content)
        with pytest.raises(ValueError, match=rf"card\.json {message}"):
            _files.read_json(path)


def test_archives_are_read_and_objects_are_not_unpickled(tmp_path):
    path, rows = tmp_path / "log.npz", np.arange(3)
    np.savez(path, reward=rows)
    assert (_files.read_arrays(path)["reward"] == rows).all()
    np.savez(path, reward=np.array([path], dtype=object))
    np.save(tmp_path / "one.npy", rows)
    for each in (path, tmp_path / "one.npy"):
        with pytest.raises(ValueError, match="no NumPy archive of plain arrays"):
            _files.read_arrays(each)


@given(st.data())
def test_no_damaged_tensors_are_used(tmp_path_factory, data):
    path = tmp_path_factory.mktemp("damaged") / "model.safetensors"
    tensors = {"a": torch.arange(6.0).reshape(2, 3), "empty": torch.zeros(0)}
    _files.write_tensors(path, tensors, {"sizes": [2, 3]})
    content = bytearray(path.read_bytes())
    if data.draw(st.booleans(), "cut"):
        del content[data.draw(st.integers(0, len(content) - 1), "end") :]
    else:
        place = data.draw(st.integers(len(content) - 24, len(content) - 1), "place")
        content[place] ^= data.draw(st.integers(1, 255), "bits")
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"model\.safetensors is"):
        _files.read_tensors(path)
