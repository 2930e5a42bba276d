"""The cache: made once, made anew where it does not fit, one maker at a time."""

from __future__ import annotations

import json

import pytest
from torchrl import torchrl_logger

from torchrl_osr.lab.data.store import cache as cache_module
from torchrl_osr.lab.data.store.cache import load_or_write


@pytest.fixture
def warnings_logged(monkeypatch):
    messages: list[str] = []
    monkeypatch.setattr(torchrl_logger, "warning", messages.append)
    return messages


@pytest.fixture
def load(tmp_path, make_transitions):
    """Load a set of 60 rows; ``load.made`` counts how often it was made."""

    def chunks():
        load.made += 1
        return make_transitions().split(25)

    def load(**request):
        return load_or_write(tmp_path / "set", request, chunks, progress=False)

    load.made = 0
    return load


def test_a_set_is_made_once_for_a_request(load, make_transitions, warnings_logged):
    data, manifest = load(seed=(1, 2))
    again, same = load(seed=(1, 2))
    assert (load.made, warnings_logged) == (1, [])
    assert (again == data).all()
    assert (again == make_transitions()).all()
    assert manifest == same
    load(seed=3)
    assert load.made == 2
    assert "its seed is [1, 2], wanted 3" in warnings_logged[0]


@pytest.mark.parametrize(
    ("name", "damage"),
    [
        ("action.memmap", lambda content: content[:100] + b"?" + content[101:]),
        ("action.memmap", lambda content: content[:100]),
        ("action.memmap", lambda content: b""),
        ("manifest.json", lambda content: content[:50]),
        ("manifest.json", lambda content: b"[]"),
        ("manifest.json", lambda content: content.replace(b"60", b"61")),
    ],
)
def test_a_damaged_set_is_made_anew(load, tmp_path, warnings_logged, name, damage):
    first, _ = load()
    rows, path = first.clone(), tmp_path / "set" / name
    # Not into the file that is mapped.
    content = path.read_bytes()
    path.unlink()
    path.write_bytes(damage(content))
    second, _ = load()
    assert load.made == 2
    assert (second == rows).all()
    (message,) = warnings_logged
    assert name in message


def test_a_whole_set_is_read_without_writing(load, monkeypatch):
    load()

    def refuse(*_, **__):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(cache_module, "FileLock", refuse)
    load()
    with pytest.raises(PermissionError, match=r"free space.*TORCHRL_OSR_CACHE="):
        load(another="request")


def test_a_full_disk_leaves_nothing_behind(load, tmp_path, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr("torchrl_osr.lab.data.store.memmap.os.fsync", full)
        with pytest.raises(OSError, match=r"No space left.*TORCHRL_OSR_CACHE="):
            load()
    assert [path.name for path in tmp_path.iterdir()] in ([], ["set.lock"])
    load()
    assert json.loads((tmp_path / "set" / "manifest.json").read_text())
