"""Writing in chunks: the same bytes however it was cut, killed and continued."""

from __future__ import annotations

import hashlib
import json
import shutil
import signal
import subprocess
import sys
from collections import namedtuple
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl import torchrl_logger

from torchrl_osr.data import write_on_disk

ROWS = 60


def transitions(rows: int = ROWS, offset: float = 0.0) -> TensorDict:
    generator = torch.Generator().manual_seed(0)
    state = torch.randn(rows, 3, generator=generator) + offset
    ended = torch.rand(rows, 1, generator=generator) < 0.2
    following = {
        "observation": state + 1,
        "reward": torch.randn(rows, 1, generator=generator),
        "done": ended,
        "terminated": ended,
        "truncated": torch.zeros_like(ended),
    }
    action = torch.rand(rows, 2, generator=generator)
    root = {"observation": state, "action": action}
    return TensorDict(root | {"next": TensorDict(following, [rows])}, [rows])


def cut(data: TensorDict, size: int, asked: list[int] | None = None, stop: int = -1):
    """Return a source of chunks that notes what it is asked for, and may fail."""

    def chunks(done):
        for number in range(len(done), -(-len(data) // size)):
            if number == stop:
                raise KeyboardInterrupt
            if asked is not None:
                asked.append(number)
            yield data[number * size : (number + 1) * size], {"number": number}

    return chunks


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@settings(max_examples=15, deadline=None, database=None, derandomize=True)
@given(size=st.integers(1, ROWS + 1), offset=st.sampled_from([0.0, 1e4]))
def test_rows_and_statistics_do_not_depend_on_chunks(tmp_path_factory, size, offset):
    folder = tmp_path_factory.mktemp("written") / "set"
    data = transitions(offset=offset)
    stored = write_on_disk(cut(data, size), folder, progress=False)
    assert len(stored) == ROWS
    assert (stored[torch.arange(ROWS)] == data).all()
    mean, std = stored.observation_moments()
    observation = data["observation"].numpy().astype(np.float64)
    assert np.allclose(mean, observation.mean(0), rtol=1e-13, atol=1e-13)
    assert np.allclose(std, observation.std(0), rtol=1e-9)
    reward = data["next", "reward"]
    assert stored.reward_range() == (reward.min().item(), reward.max().item())
    content = (folder / "rows.bin").read_bytes()
    assert stored.manifest["sha256"] == hashlib.sha256(content).hexdigest()
    assert contents(folder).keys() == {"rows.bin", "manifest.json"}


@pytest.mark.parametrize("torn", [b"", b'{"rows": 7, "no'])
@pytest.mark.parametrize("stop", [0, 1, 4, 8])
def test_an_interrupted_conversion_goes_on(tmp_path, stop, torn):
    data, folder, asked = transitions(), tmp_path / "set", []
    with pytest.raises(KeyboardInterrupt):
        write_on_disk(cut(data, 7, asked, stop), folder, progress=False)
    partial = tmp_path / ".set.partial"
    for name in ("rows.bin", "chunks.jsonl"):
        with (partial / name).open("ab") as file:
            file.write(torn)
    assert not folder.exists()
    write_on_disk(cut(data, 7, asked), folder, progress=False)
    assert asked == list(range(9))  # each chunk once
    write_on_disk(cut(data, 7), tmp_path / "unbroken", progress=False)
    assert contents(folder) == contents(tmp_path / "unbroken")
    assert not partial.exists()


def test_rows_that_did_not_reach_the_disk_are_written_again(tmp_path):
    data, asked = transitions(), []
    with pytest.raises(KeyboardInterrupt):
        write_on_disk(cut(data, 10, asked, 4), tmp_path / "set", progress=False)
    with (tmp_path / ".set.partial" / "rows.bin").open("r+b") as file:
        file.truncate(25 * 44)
    stored = write_on_disk(cut(data, 10, asked), tmp_path / "set", progress=False)
    assert asked == [0, 1, 2, 3, 2, 3, 4, 5]
    assert (stored[torch.arange(ROWS)] == data).all()


KILLED = """
import importlib.util, os, signal, sys
spec = importlib.util.spec_from_file_location("writer_tests", sys.argv[1])
tests = importlib.util.module_from_spec(spec)
spec.loader.exec_module(tests)
def chunks(done):
    for number, chunk in enumerate(tests.cut(tests.transitions(), 7)(done)):
        if number == 5:
            os.kill(os.getpid(), signal.SIGKILL)
        yield chunk
tests.write_on_disk(chunks, sys.argv[2], progress=False)
"""


def test_a_killed_process_leaves_what_another_continues(tmp_path):
    folder, asked = tmp_path / "set", []
    command = [sys.executable, "-c", KILLED, __file__, str(folder)]
    killed = subprocess.run(command, capture_output=True, text=True, check=False)
    assert killed.returncode == -signal.SIGKILL, killed.stderr
    assert not folder.exists()
    write_on_disk(cut(transitions(), 7, asked), folder, progress=False)
    assert asked == [5, 6, 7, 8]
    write_on_disk(cut(transitions(), 7), tmp_path / "unbroken", progress=False)
    assert contents(folder) == contents(tmp_path / "unbroken")


def test_a_whole_set_is_not_written_again_unless_the_request_differs(tmp_path):
    data, folder, asked = transitions(), tmp_path / "set", []
    write_on_disk(cut(data, 30), folder, request={"a": (1, 2)}, progress=False)
    write_on_disk(cut(data, 30, asked), folder, request={"a": (1, 2)}, progress=False)
    assert asked == []
    changed = write_on_disk(
        cut(data[:40], 20, asked), folder, request={"a": 3}, progress=False
    )
    assert (asked, len(changed)) == ([0, 1], 40)


def test_a_partial_set_of_another_request_is_not_continued(tmp_path):
    data, asked = transitions(), []
    options = {"request": {"a": 1}, "progress": False}
    with pytest.raises(KeyboardInterrupt):
        write_on_disk(cut(transitions(40), 10, stop=3), tmp_path / "set", **options)
    options["request"] = {"a": 2}
    stored = write_on_disk(cut(data, 10, asked), tmp_path / "set", **options)
    assert asked == list(range(6))
    assert (stored[torch.arange(ROWS)] == data).all()


def test_a_set_of_the_wrong_size_is_written_again(tmp_path):
    data, folder = transitions(), tmp_path / "set"
    write_on_disk(cut(data, 30), folder, progress=False)
    with (folder / "rows.bin").open("ab") as file:
        file.write(b"more")
    stored = write_on_disk(cut(data, 30), folder, progress=False)
    assert (stored[torch.arange(ROWS)] == data).all()


def test_the_source_describes_itself(tmp_path):
    stored = write_on_disk(
        cut(transitions(), 20),
        tmp_path / "set",
        describe=lambda notes: {"numbers": [each["number"] for each in notes]},
        progress=False,
    )
    assert stored.manifest["numbers"] == [0, 1, 2]


def spoilt(key, value):
    data = transitions()
    column = data[key].clone()
    column[37] = value
    return data.set(key, column)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (spoilt("observation", float("nan")), "'observation' holds NaN"),
        (spoilt(("next", "done"), True), r"'done'\) differs from terminated"),
        (
            spoilt("observation", 0.0).set("observation", torch.ones(ROWS, 3).double()),
            "'observation' has type torch.float64; expected torch.float32",
        ),
        (transitions().exclude("action"), "lacks 'action'"),
        (transitions()[:0], "there is no row to write"),
        (transitions().set("action", torch.zeros(ROWS, 2)), "'action' is zero in all"),
    ],
)
def test_what_is_no_data_set_is_refused(tmp_path, data, message):
    # A flag that is spoilt may be what it was.
    if message.startswith("'done'") or "done" in message:
        data["next", "terminated"] = torch.zeros(ROWS, 1, dtype=torch.bool)
    with pytest.raises(ValueError, match=message):
        write_on_disk(cut(data, 10), tmp_path / "set", progress=False)
    assert not (tmp_path / "set").exists()


def test_a_chunk_of_another_size_is_refused(tmp_path):
    other = transitions()
    other["action"] = torch.rand(ROWS, 5)
    chunks = [(transitions(), {}), (other, {})]
    with pytest.raises(ValueError, match=r"chunk 1 .*action_size=5.*action_size=2"):
        write_on_disk(lambda done: chunks, tmp_path / "set", progress=False)


def test_a_field_may_be_zero_in_one_chunk(tmp_path):
    data = transitions()
    data["action"][:20] = 0
    assert len(write_on_disk(cut(data, 10), tmp_path / "set", progress=False)) == ROWS


def test_room_is_looked_for_before_the_work(tmp_path, monkeypatch):
    usage = namedtuple("usage", "free")
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage(10_000 * 44 - 1))
    options = {"total": 10_000, "progress": False}
    with pytest.raises(OSError, match="not enough disk space"):
        write_on_disk(cut(transitions(), 10), tmp_path / "set", **options)
    options["total"] = ROWS
    assert len(write_on_disk(cut(transitions(), 10), tmp_path / "set", **options))


def test_the_log_is_json_a_line(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        write_on_disk(cut(transitions(), 20, stop=2), tmp_path / "set", progress=False)
    text = (tmp_path / ".set.partial" / "chunks.jsonl").read_text()
    first, *lines = map(json.loads, text.splitlines())
    assert first["request"] == {}
    assert [line["rows"] for line in lines] == [20, 20]


@pytest.mark.parametrize(
    "damage",
    [
        lambda content: content.replace(b'"mean": [', b'"mean": [1', 1),
        lambda content: content[: len(content) // 2],
        lambda content: b"",
        lambda content: b"\xff" + content[1:],
        lambda content: b"[]\n" + content,
    ],
)
def test_a_damaged_log_is_said_and_not_gone_on_from(tmp_path, monkeypatch, damage):
    messages: list[str] = []
    monkeypatch.setattr(torchrl_logger, "warning", messages.append)
    right = write_on_disk(cut(transitions(), 20), tmp_path / "right", progress=False)
    with pytest.raises(KeyboardInterrupt):
        write_on_disk(cut(transitions(), 20, stop=2), tmp_path / "set", progress=False)
    log = tmp_path / ".set.partial" / "chunks.jsonl"
    log.write_bytes(damage(log.read_bytes()))
    stored = write_on_disk(cut(transitions(), 20), tmp_path / "set", progress=False)
    assert stored.manifest == right.manifest
    assert len(messages) == 1
    assert "chunks.jsonl" in messages[0]
