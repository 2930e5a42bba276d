"""A run that is killed or interrupted, and started again: the same bits."""

from __future__ import annotations

import json
import os
import random
import signal
import time
from contextlib import suppress
from pathlib import Path

import pytest
from processes import files_of

KILLED = 128 + signal.SIGKILL
CODES = {signal.SIGINT: 130, signal.SIGTERM: 75, signal.SIGHUP: 75}


class Runs:
    """Starts commands; ``output`` is what the last one printed."""

    def __init__(self, server, path: Path, sizes: list[str]) -> None:
        self.server, self.path, self.sizes = server, path, sizes

    @property
    def output(self) -> str:
        return self.path.read_text()

    def start(self, *arguments: str) -> int:
        self.path.unlink(missing_ok=True)
        place = {"output": self.path, "folder": self.path.parent}
        return self.server.start("train", *arguments, **place)

    def train(self, folder: Path, *more: str) -> int:
        self.start(*self.sizes, f"hydra.run.dir={folder}", *more)
        return self.server.ended()

    def stopped(self, folder: Path, number: int, seconds: float) -> int:
        """Send a signal some seconds after the run has begun; the exit code."""
        process = self.start(*self.sizes, f"hydra.run.dir={folder}")
        with suppress(ProcessLookupError):  # it has come to its end
            while status(folder).get("pid") != process:
                os.kill(process, 0)  # it lives
                time.sleep(0.001)
            time.sleep(seconds)
            os.kill(process, number)
        return self.server.ended()


def status(folder: Path) -> dict:
    with suppress(OSError):
        return json.loads((folder / "status.json").read_text())
    return {}


def results(folder: Path) -> dict:
    names = sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))
    return files_of(folder) | {"names": names}


def assert_same_results(folder: Path, undisturbed: Path) -> None:
    """Compare results without log entries: a continued run repeats some."""
    found, wanted = results(folder), results(undisturbed)
    for name in [each for each in wanted if each.endswith(".csv")]:
        del found[name], wanted[name]
    assert found == wanted


@pytest.fixture(scope="module")
def runs(tmp_path_factory, server, tiny) -> Runs:
    sizes = tiny(steps=20, eval_interval=20, checkpoints_kept=1)
    sizes += ["optim.policy_average=0.1"]  # has a state of its own
    return Runs(server, tmp_path_factory.mktemp("outputs") / "output.txt", sizes)


@pytest.fixture(scope="module")
def undisturbed(runs, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("undisturbed") / "run"
    assert runs.train(folder) == 0, runs.output
    return folder


def test_killed_at_any_moment_it_ends_with_the_same_bits(runs, undisturbed, tmp_path):
    folder, seed = tmp_path / "run", random.randrange(10**6)
    rng = random.Random(seed)
    for _ in range(8):
        code = runs.stopped(folder, signal.SIGKILL, rng.uniform(0, 0.6))
        assert code in (0, KILLED), (seed, runs.output)
    assert runs.train(folder) == 0, runs.output
    assert_same_results(folder, undisturbed)


def test_interrupted_it_ends_in_order_and_continues(runs, undisturbed, tmp_path):
    folder, seed = tmp_path / "run", random.randrange(10**6)
    rng = random.Random(seed)
    for number in (*CODES, *CODES):
        code = runs.stopped(folder, number, rng.uniform(0, 0.4))
        if status(folder)["status"] == "done":
            assert code in (0, 128 + number), (seed, runs.output)
            break
        assert status(folder)["status"] == "preempted", (seed, runs.output)
        assert code == CODES[number], (seed, runs.output)
        assert f"resume={folder}" in runs.output
    assert runs.train(folder) == 0, runs.output
    assert_same_results(folder, undisturbed)


def test_second_sweep_continues_what_is_not_done(runs, tiny, tmp_path):
    sizes = tiny(steps=100, eval_interval=100, checkpoint_interval=25, record="false")
    sweep = [*sizes, "loss=cql", "seed=0,1", f"hydra.sweep.dir={tmp_path}", "-m"]
    process = runs.start(*sweep)
    pattern = "*/checkpoint/policy/checkpoint-*"
    while not list(tmp_path.glob(f"{pattern}25.torchrl")):
        os.kill(process, 0)  # it lives
        time.sleep(0.001)
    os.kill(process, signal.SIGTERM)
    assert runs.server.ended() == 75, runs.output
    found = [status(x.parent)["status"] for x in sorted(tmp_path.glob("*/status.json"))]
    assert found in (["preempted"], ["done", "preempted"])
    for _ in range(2):  # the second time all is done, and nothing is trained
        runs.start(*sweep)
        assert runs.server.ended() == 0, runs.output
        written = {path: path.stat().st_mtime_ns for path in tmp_path.glob(pattern)}
        assert len(list(tmp_path.glob("*/returns.json"))) == 2
    assert "goes on from" not in runs.output
    assert all(path.stat().st_mtime_ns == at for path, at in written.items())
