"""Crafted files: what would fill the memory, write elsewhere or run code is refused."""

from __future__ import annotations

import io
import json
import os
import socket
import stat
import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays, scalar_dtypes

from torchrl_osr._files import (
    check_unpacked_size,
    read_arrays,
    read_json,
    read_text,
    refuse_archive,
)
from torchrl_osr.lab.data import load_behavior_policy, load_dataset

TEN_GIGABYTES = 10 * 10**9


class Marker:
    """Unpickling it makes a file."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        return os.mkdir, (str(self.path),)


def announce(content: bytes, size: int) -> bytes:
    """Change the size that an archive's table of contents has of each member."""
    patched, start = bytearray(content), 0
    while (start := content.find(b"PK\x01\x02", start) + 1) > 0:
        patched[start + 23 : start + 27] = struct.pack("<I", size)
    return bytes(patched)


def archive_of(*names: str, mode: int = 0) -> bytes:
    array, buffer = io.BytesIO(), io.BytesIO()
    np.save(array, np.zeros(3))
    with zipfile.ZipFile(buffer, "w") as archive:
        for name in names:
            member = zipfile.ZipInfo(name)
            member.external_attr = mode << 16
            archive.writestr(member, array.getvalue(), zipfile.ZIP_DEFLATED)
    return buffer.getvalue()


@given(
    st.dictionaries(
        st.text("abc/._", min_size=1).filter(
            lambda name: ".." not in name and not name.startswith("/")
        ),
        arrays(scalar_dtypes(), array_shapes(max_side=4)),
        max_size=3,
    ),
    st.booleans(),
)
def test_sound_archives_are_read_as_numpy_reads_them(
    tmp_path_factory, columns, compressed
):
    path = tmp_path_factory.mktemp("archives") / "any.npz"
    (np.savez_compressed if compressed else np.savez)(path, **columns)
    ours = read_arrays(path)
    with np.load(path) as theirs:
        assert ours.keys() == set(theirs)
        for name in theirs:
            np.testing.assert_array_equal(ours[name], theirs[name])
            assert ours[name].dtype == theirs[name].dtype


@pytest.mark.parametrize(
    "name", ["../x.npy", "a/../../x.npy", "/etc/x.npy", "a\\..\\..\\x", "C:\\x", "C:x"]
)
def test_paths_that_lead_out_are_refused(name):
    with (
        zipfile.ZipFile(io.BytesIO(archive_of(name))) as archive,
        pytest.raises(ValueError, match="leads out of the archive"),
    ):
        refuse_archive(archive)


def test_symbolic_links_are_refused():
    content = archive_of("link", mode=stat.S_IFLNK | 0o777)
    with (
        zipfile.ZipFile(io.BytesIO(content)) as archive,
        pytest.raises(ValueError, match="'link' is a symbolic link"),
    ):
        refuse_archive(archive)


def test_announced_sizes_are_looked_at_before_anything_is_read(tmp_path, monkeypatch):
    # Three times as much as a field of 32 bits can say.
    content = announce(archive_of("a.npy", "b.npy", "c.npy"), 2**32 - 2)
    (tmp_path / "log.npz").write_bytes(content)
    monkeypatch.setattr(zipfile.ZipFile, "open", None)
    with pytest.raises(ValueError, match=r"would unpack to 12,884,901,882"):
        load_dataset(path=tmp_path / "log.npz")


def test_a_file_may_be_as_large_as_it_is(tmp_path):
    path = tmp_path / "large"
    path.touch()
    os.truncate(path, TEN_GIGABYTES)
    check_unpacked_size(path, TEN_GIGABYTES)
    os.truncate(path, 10)
    check_unpacked_size(path, 4 * 2**30)
    with pytest.raises(ValueError, match=r"10,000,000,000 bytes; at most 4,294,967"):
        check_unpacked_size(path, TEN_GIGABYTES)


def test_an_array_that_announces_more_rows_than_it_has(tmp_path):
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        header, {"descr": "<f4", "fortran_order": False, "shape": (10**17,)}
    )
    with zipfile.ZipFile(tmp_path / "log.npz", "w") as archive:
        archive.writestr("reward.npy", header.getvalue() + b"1234")
    with pytest.raises(ValueError, match="no NumPy archive of plain arrays"):
        load_dataset(path=tmp_path / "log.npz")


def policy_with(folder: Path, **arrays) -> Path:
    (folder / "mine").mkdir(parents=True)
    card = {"mine": {"env": "Hopper-v5", "policies": {"medium": {}}}}
    (folder / "card.json").write_text(json.dumps(card))
    np.savez(folder / "mine" / "medium.npz", **arrays)
    return folder


def test_objects_are_not_unpickled(tmp_path):
    marker = tmp_path / "marker"
    objects = np.array([Marker(marker)] * 3, dtype=object)
    np.savez(tmp_path / "log.npz", reward=objects)
    with pytest.raises(ValueError, match="no NumPy archive of plain arrays"):
        load_dataset(path=tmp_path / "log.npz")
    folder = policy_with(tmp_path / "policies", **{"hidden0.weight": objects})
    with pytest.raises(ValueError, match=r"medium\.npz is no NumPy archive"):
        load_behavior_policy("mine", "medium", folder=folder)
    assert not marker.exists()
    with np.load(tmp_path / "log.npz", allow_pickle=True) as arrays:
        arrays["reward"]
    assert marker.exists(), "the crafted file works"


def test_a_manifest_of_a_gigabyte_is_not_read(tmp_path, monkeypatch):
    path = tmp_path / "manifest.json"
    path.touch()
    os.truncate(path, 10**9)
    for read in (read_json, read_text):
        with pytest.raises(ValueError, match=r"manifest\.json has more than 256,000"):
            read(path, max_bytes=256_000)
    path.write_bytes(b"\xff{}")
    with pytest.raises(ValueError, match=r"manifest\.json is no text"):
        read_json(path)
    path.write_text("[1]")
    with pytest.raises(ValueError, match=r"manifest\.json holds no object"):
        read_json(path)
    path.write_text("[" * 100_000)
    with pytest.raises(ValueError, match=r"manifest\.json is no JSON"):
        read_json(path)


def test_no_loading_touches_the_network(tmp_path, monkeypatch):
    def refuse(*_):
        raise AssertionError("the network was asked for")

    monkeypatch.setattr(socket.socket, "connect", refuse)
    monkeypatch.setattr(socket, "getaddrinfo", refuse)
    monkeypatch.setenv("TORCHRL_OSR_CACHE", str(tmp_path))
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    recipe = {"random_share": 0.0, "num_transitions": 50, "progress": False}
    load_dataset("hopper", "random", **recipe)
    for quality, path in (("minari", "mujoco/a/medium-v0"),):
        with pytest.raises(FileNotFoundError, match="download"):
            load_dataset("hopper", quality, path=path)


def test_nobody_waits_for_the_other_end_of_a_pipe(tmp_path):
    path = tmp_path / "status.json"
    os.mkfifo(path)
    with pytest.raises(
        ValueError, match=r"status\.json is a folder, a pipe or a device"
    ):
        read_json(path)
    with pytest.raises(ValueError, match="is a folder, a pipe or a device"):
        read_arrays(path)
